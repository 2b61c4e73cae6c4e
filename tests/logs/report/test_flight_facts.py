"""Facts of a flight by its records: cause of its end, fallbacks, delays, predicted places, orders."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from synthetic_flight import fly
from synthetic_scene import room

from logs.recording.flight import FlightData
from logs.recording.summary import describe_prediction, list_summary_rows, summarise
from logs.report.evidence import FlightEvidence
from logs.report.headline import derive_headline
from logs.report.verdict_link import judge_link
from logs.report.verdicts import judge_flight
from uavctl.cause import Cause
from uavctl.config import load_config
from uavctl.config.load import dump_config
from uavctl.event_codes import MISSION, EventCode
from uavctl.number_text import format_number
from uavctl.records import ControlMode, Decision, Event, LinkStats, Order, Record, Severity, StepInput, Truth

TICK_S = room().tick_s


def make_flight(
    modes: dict[int, ControlMode],
    stop_tick: int | None = None,
    order_tick: int | None = None,
    due_tick: int | None = None,
) -> FlightData:
    """A 4 s flight (ticks of 50 ms) whose modes change at the given ticks.

    The operator stops it at `stop_tick`, or orders the landing at `order_tick`; the mission is over at `due_tick`.
    """

    def change(record: Record) -> Record:
        if isinstance(record, StepInput) and stop_tick is not None:
            return msgspec.structs.replace(record, stop=record.tick >= stop_tick)
        if isinstance(record, Decision) and record.tick >= min(modes):
            mode = modes[max(tick for tick in modes if tick <= record.tick)]
            return msgspec.structs.replace(record, mode=mode, reason="why not")
        return record

    items = [(t, at, change(r)) for t, at, r in fly(room(), 4.0)]
    for tick, code, subject in (
        (order_tick, EventCode.ORDER_ACCEPTED, Order.LAND),
        (due_tick, EventCode.BRAKE, MISSION),
    ):
        at_ns = next((r.at_ns for _, _, r in items if isinstance(r, Decision) and r.tick == tick), None)
        if at_ns is not None:
            event = Event(at_ns=at_ns, severity=Severity.INFO, code=code, text="", subject=subject)
            items.append(("/uavctl/event", at_ns, event))
    return FlightData.from_records(items)


HAND_OVER = {40: ControlMode.BRAKE, 50: ControlMode.HOLD, 51: ControlMode.LAND, 52: ControlMode.STOPPED}
FALLBACK_BEFORE = {20: ControlMode.BRAKE, 24: ControlMode.TRACK, **HAND_OVER}


@pytest.mark.parametrize(
    ("flight", "cause", "fallbacks"),
    [
        (make_flight(HAND_OVER, stop_tick=40), Cause.ENDED_BY_OPERATOR, 0),
        (make_flight(FALLBACK_BEFORE, stop_tick=40), Cause.ENDED_BY_OPERATOR, 1),
        (make_flight({40: ControlMode.STOPPED}, stop_tick=40), Cause.ENDED_BY_OPERATOR, 0),
        (make_flight(HAND_OVER), Cause.FALLBACK_LANDED, 1),
        (make_flight(HAND_OVER, order_tick=40), Cause.LANDED_AS_ORDERED, 0),
        (make_flight(HAND_OVER, due_tick=40), Cause.LANDED_AFTER_MISSION, 0),
        (make_flight({40: ControlMode.WAIT}), Cause.WAITING, 0),
        (make_flight({40: ControlMode.TRACK}), Cause.IN_FLIGHT, 0),
        (make_flight({40: ControlMode.HOLD}), Cause.IN_FLIGHT, 1),
    ],
)
def test_a_recording_without_an_ending_tells_its_cause_and_its_fallbacks(
    flight: FlightData, cause: Cause, fallbacks: int
) -> None:
    summary = summarise(flight, wall_s=1.0)
    assert (summary.ending.code, summary.fallbacks) == (cause, fallbacks)


def test_the_fallback_before_the_operators_stop_has_its_span() -> None:
    assert make_flight(FALLBACK_BEFORE, stop_tick=40).fallback_spans == [pytest.approx((20 * TICK_S, 24 * TICK_S))]


@pytest.mark.parametrize(
    "flight", [make_flight({0: ControlMode.WAIT}), make_flight({0: ControlMode.STOPPED}, stop_tick=0)]
)
def test_a_flight_that_never_began_is_not_flown(flight: FlightData) -> None:
    evidence = FlightEvidence(flight, summarise(flight, wall_s=1.0), judge_flight(flight))
    assert evidence.summary.steps == 0 and derive_headline(evidence).cause is Cause.NOT_FLOWN


@pytest.mark.parametrize("latency_s", [0.0, 0.03])
def test_the_shortest_delay_is_what_the_configuration_takes_it_to_be(latency_s: float) -> None:
    config = load_config("room-hahn-stursberg", (f"clock.latency_s={latency_s}",))
    found = FlightData.from_records(fly(room(), 4.0, config_toml=dump_config(config)))
    stats = LinkStats(
        at_ns=1,
        link="mocap",
        datagrams=1,
        messages=1,
        samples=7,
        bad={},
        clock_offset_ns=0,
        clock_source="minimum",
        clock_rtt_ns=None,
        clock_drift_ppm=None,
        clock_rejected=0,
    )
    delay = judge_link(dataclasses.replace(found, links=(stats,)), config).delay
    assert delay is not None and delay.from_quickest
    assert delay.latency_ms == pytest.approx(1e3 * latency_s)


def flown_blind(age_s: float, *, truth: bool = False) -> FlightData:
    """A 4 s flight without positions for its last `age_s`, and, as a real one, without the truth."""
    items = [item for item in fly(room(), 4.0, blackout=(4.0 - age_s, 4.0)) if truth or not isinstance(item[2], Truth)]
    return FlightData.from_records(items)


@pytest.mark.parametrize(("age_s", "truth", "blind"), [(2.0, False, True), (2.0, True, False), (0.0, False, False)])
def test_a_place_that_is_predicted_only_is_not_told_as_one_that_was_seen(
    age_s: float, truth: bool, blind: bool
) -> None:
    flight = flown_blind(age_s, truth=truth)
    summary = summarise(flight, wall_s=1.0)
    last = flight.estimates[-1]
    assert summary.final_age_s == pytest.approx(last.age_s, abs=room().dt_s)
    text = describe_prediction(summary)
    assert bool(text) == blind
    assert any("predicted only" in value for _, value in list_summary_rows(summary)) == blind
    if blind:
        assert summary.final_age_s is not None and summary.final_std_m is not None
        assert format_number(summary.final_age_s) in text and format_number(summary.final_std_m) in text


def test_the_uncertainty_at_the_end_is_the_estimate_s_own() -> None:
    flight = flown_blind(2.0)
    steps = {decision.at_ns for decision in flight.steps.decisions}
    index = list(flight.design.position_index)
    cov = np.array(next(estimate for estimate in reversed(flight.estimates) if estimate.at_ns in steps).cov)[
        np.ix_(index, index)
    ]
    told = summarise(flight, wall_s=1.0).final_std_m
    assert told == pytest.approx(float(np.sqrt(np.linalg.eigvalsh(cov).max())))


def sent_to(places: list[float], waypoints: list[int | None]) -> FlightData:
    """A flight whose target's first coordinate, and waypoint, are these, one a second."""

    def change(record: Record) -> Record:
        if not isinstance(record, Decision):
            return record
        n = min(int(record.tick * TICK_S), len(places) - 1)
        target = (places[n], *room().target.tolist()[1:])
        return msgspec.structs.replace(record, target=target, waypoint=waypoints[n])

    return FlightData.from_records([(t, at, change(r)) for t, at, r in fly(room(), 4.0)])


def test_a_place_that_was_ordered_is_no_trajectory() -> None:
    flight = sent_to([0.5, 0.5, -0.7, -0.7], [0, 0, None, None])
    summary = summarise(flight, wall_s=1.0)
    assert not summary.trajectory
    assert [target[0] for _, target in flight.ordered_places] == [-0.7]


def test_waypoints_alone_are_no_orders_and_a_target_that_moves_is_a_trajectory() -> None:
    assert sent_to([0.5, 0.2, -0.7, -0.7], [0, 1, 2, 2]).ordered_places == ()

    def moving(record: Record) -> Record:
        if not isinstance(record, Decision):
            return record
        target = (0.1 * record.tick * TICK_S, *room().target.tolist()[1:])
        return msgspec.structs.replace(record, target=target, waypoint=None)

    flight = FlightData.from_records([(t, at, moving(r)) for t, at, r in fly(room(), 4.0)])
    assert flight.moving_target and flight.ordered_places == ()
