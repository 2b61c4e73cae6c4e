"""The lanes of the timeline, and the flat picture of the path in three dimensions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from synthetic_flight import fly
from synthetic_scene import paper, room

from logs.recording.flight import FlightData
from logs.report.path_3d import compute_grid_m, draw_path_3d, outline_ellipsoid, project_3d
from logs.report.timeline import describe_lanes, list_hidden_texts, make_lanes
from uavctl.event_codes import EventCode
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, Event, Order, Severity, StepInput, VehicleStatus


@pytest.fixture(scope="module")
def flight() -> FlightData:
    return FlightData.from_records(fly(room(), 12.0, blackout=(4.0, 8.0)))


def lane(found: FlightData, name: str) -> list[tuple[float, float, str]]:
    (chosen,) = (lane for lane in make_lanes(found) if lane.name == name)
    return [(span.begun_s, span.ended_s, span.text) for span in chosen.spans]


def test_modes_follow_each_other_without_gaps(flight: FlightData) -> None:
    spans = lane(flight, "controller")
    assert [text for _, _, text in spans] == ["track", "brake", "track"]
    assert spans[0][0] == 0.0
    assert spans[-1][1] == pytest.approx(flight.duration_s)
    assert [end for _, end, _ in spans[:-1]] == [begin for begin, _, _ in spans[1:]]
    ((begun, ended),) = flight.spans(frozenset(d.mode for d in flight.decisions if d.mode.value == "brake"))
    assert spans[1][:2] == pytest.approx((begun, ended))


def enter_state(at_s: float, state: HandoverState, origin_ns: int) -> Event:
    at_ns = origin_ns + round(at_s * 1e9)
    return Event(at_ns=at_ns, severity=Severity.INFO, code=EventCode.HAND_OVER, text="", subject=state)


def test_hand_over_states_come_from_its_events(flight: FlightData) -> None:
    told = (
        enter_state(1.0, HandoverState.ARMING, flight.origin_ns),
        enter_state(3.0, HandoverState.ENGAGED, flight.origin_ns),
    )
    spans = lane(dataclasses.replace(flight, events=told), "hand-over")
    assert spans == [(0.0, 1.0, "waiting"), (1.0, 3.0, "arming"), (3.0, pytest.approx(flight.duration_s), "engaged")]


def test_what_the_vehicle_said(flight: FlightData) -> None:
    def status(at_s: float, mode: str, armed: bool) -> VehicleStatus:
        at_ns = flight.origin_ns + round(at_s * 1e9)
        return VehicleStatus(at_ns=at_ns, autopilot="px4", armed=armed, mode=mode, external=mode == "OFFBOARD")

    told = (status(0.0, "LAND", False), status(1.0, "LAND", False), status(2.0, "OFFBOARD", True))
    spans = lane(dataclasses.replace(flight, vehicles=told), "vehicle")
    assert [(begun, text) for begun, _, text in spans] == [(0.0, "LAND, disarmed"), (2.0, "OFFBOARD")]


def test_marks_are_where_things_happened(flight: FlightData) -> None:
    orders = (StepInput(tick=20, at_ns=flight.origin_ns + 1_000_000_000, commands=(Command(order=Order.HOLD),)),)
    found = dataclasses.replace(flight, step_inputs=(*flight.step_inputs, *orders))
    by_name = {lane.name: lane for lane in make_lanes(found)}
    _, times = by_name["orders"].marks
    assert times.tolist() == [1.0]
    silent = sum(bool(d.age_steps) for d in flight.decisions if d.boundary)
    assert len(by_name["no position"].marks[1]) == silent
    assert not {"relaxed", "no optimum", "outside", "input over", "refused"} & set(by_name)  # nothing of it happened


def test_bars_too_short_for_their_text_are_explained(flight: FlightData) -> None:
    told = (enter_state(3.0, HandoverState.ENGAGED, flight.origin_ns),)
    meanings = describe_lanes(dataclasses.replace(flight, events=told))
    assert "a step without a new position" in meanings and "an error" not in meanings
    short = list_hidden_texts(FlightData.from_records(fly(room(), 60.0, blackout=(4.0, 8.0))))
    assert any(mark.kind == "band" and mark.text == "brake" for mark in short)


def test_the_outline_holds_the_ellipsoid_and_touches_it() -> None:
    semi = np.array([0.3, 0.8, 0.5])
    width, height, tilt = outline_ellipsoid(semi)
    rng = np.random.default_rng(0)
    ball = rng.standard_normal((20000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    turned = project_3d(ball * semi) @ np.array([[c, -s], [s, c]])
    reach = (2.0 * turned[:, 0] / width) ** 2 + (2.0 * turned[:, 1] / height) ** 2
    assert reach.max() <= 1.0 + 1e-9
    assert reach.max() > 0.999


def test_up_is_up_on_the_page() -> None:
    low, high, east = project_3d(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
    assert high[1] > low[1] and high[0] == low[0]
    assert east[0] > low[0]


@pytest.mark.parametrize(
    ("lower", "upper", "lines"),
    [
        (-3.0, 3.0, [-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]),
        (-2.5, 2.5, [-2.0, -1.0, 0.0, 1.0, 2.0]),
        (0.2, 0.8, []),
        (-30.0, 50.0, [-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0]),
    ],
)
def test_the_floor_has_a_line_each_metre_or_so(lower: float, upper: float, lines: list[float]) -> None:
    assert compute_grid_m(lower, upper).tolist() == lines


@pytest.mark.parametrize("side", [10.5, 1e3, 1e7])
def test_a_floor_of_any_size_has_few_lines(side: float) -> None:
    assert 2 <= len(compute_grid_m(-side, 0.3 * side)) <= 21


def test_a_plant_of_two_axes_has_no_depth() -> None:
    assert not list(draw_path_3d(FlightData.from_records(fly(paper(), 5.0))))
