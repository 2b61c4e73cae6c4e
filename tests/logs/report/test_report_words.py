"""The page's words on how a flight ended: by the operator, by the fallback, or cut off."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from report_rig import read_page_text
from synthetic_flight import fly
from synthetic_scene import room

from logs.recording.flight import FlightData
from logs.recording.summary import Percentiles, describe_prediction, list_summary_rows, summarise
from logs.report.summary_text import describe_flight
from uavctl.config import load_config
from uavctl.config.load import dump_config
from uavctl.event_codes import MISSION, EventCode
from uavctl.number_text import format_number
from uavctl.records import ControlMode, Decision, Event, LinkStats, Order, Record, Severity, StepInput, Truth

TICK_S = room().tick_s


def ended_in(
    modes: dict[int, ControlMode],
    stop_tick: int | None = None,
    order_tick: int | None = None,
    due_tick: int | None = None,
) -> str:
    """Text of the page of a 4 s flight (ticks of 50 ms) whose modes change at the given ticks.

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
    return " ".join(read_page_text(FlightData.from_records(items)).text)


HAND_OVER = {40: ControlMode.BRAKE, 50: ControlMode.HOLD, 51: ControlMode.LAND, 52: ControlMode.STOPPED}


def test_the_operators_stop_is_no_fallback() -> None:
    text = ended_in(HAND_OVER, stop_tick=40)
    assert f"Ended by the operator after {40 * TICK_S:g} s" in text
    assert "handed over to its own landing" in text
    assert "Fell back" not in text


def test_a_fallback_before_the_operators_stop_is_told() -> None:
    text = ended_in({20: ControlMode.BRAKE, 24: ControlMode.TRACK, **HAND_OVER}, stop_tick=40)
    assert f"for {4 * TICK_S:.1f} s in all, from {20 * TICK_S:.1f} s on: why not" in text
    assert "Ended by the operator" in text


def test_a_hand_over_that_was_cut_off_is_told() -> None:
    cut_off = "recording ends before"
    assert cut_off in ended_in({40: ControlMode.BRAKE}, stop_tick=40)
    whole = ended_in({40: ControlMode.STOPPED}, stop_tick=40)
    assert "the vehicle was handed over" in whole and cut_off not in whole


def test_a_landing_is_told() -> None:
    text = ended_in(HAND_OVER)
    assert f"Landed by the fallback after {51 * TICK_S:g} s" in text
    assert "operator" not in text


@pytest.mark.slow
@pytest.mark.parametrize(("ordered", "told"), [(True, "Landed as ordered"), (False, "end of the mission")])
def test_a_landing_that_was_wanted_is_told_as_such(ordered: bool, told: str) -> None:
    text = ended_in(HAND_OVER, order_tick=40 if ordered else None, due_tick=None if ordered else 40)
    assert told in text and f"{51 * TICK_S:g} s" in text
    assert "by the fallback" not in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "told"),
    [
        (ControlMode.WAIT, "waiting: why not."),  # with its reason
        (ControlMode.TRACK, "a plan was being flown"),
        (ControlMode.HOLD, "held zero acceleration"),
    ],
)
def test_a_recording_that_ends_otherwise(mode: ControlMode, told: str) -> None:
    assert told in ended_in({40: mode})


def test_a_simulated_flight_that_never_began_has_a_page() -> None:
    nothing = "Nothing was flown: why not."  # with its reason
    assert nothing in " ".join(ended_in({0: ControlMode.WAIT}).split())
    assert nothing in " ".join(ended_in({0: ControlMode.STOPPED}, stop_tick=0).split())


def test_what_went_amiss_is_in_the_table_alone() -> None:
    flight = FlightData.from_records(fly(room(), 4.0))
    good = summarise(flight, wall_s=1.0)
    times = Percentiles(p50=100.0, p99=900.0, max=73_400.0)
    bad = msgspec.structs.replace(good, missed_ticks=3, tick_lateness_us=times, recorder_dropped=1)
    assert describe_flight(flight, bad) == describe_flight(flight, good)
    cells = " ".join(text for _, text in list_summary_rows(bad))
    assert "73.4 ms" in cells and "3 ticks" in cells and "1 record " in cells


@pytest.mark.slow
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
    text = " ".join(read_page_text(dataclasses.replace(found, links=(stats,))).text)
    taken = "30 ms (clock.latency_s)" in text
    short = "short of the quickest" in text
    assert (taken, short) == (latency_s > 0.0, latency_s == 0.0)


def test_the_ways_to_a_plan_and_slack_are_explained_where_they_stand() -> None:
    found = FlightData.from_records(fly(room(), 4.0))
    ways = ("frozen", "mixture", "exact")
    plans = tuple(msgspec.structs.replace(plan, method=ways[at % 2]) for at, plan in enumerate(found.plans))
    text = " ".join(read_page_text(dataclasses.replace(found, plans=plans)).text)
    assert [f"“{way}”: with " in text for way in ways] == [True, True, False]
    assert "Slack is" in text


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
    text = " ".join(describe_flight(flight, summary))
    assert "trajectory" not in text and "(-0.7, " in text
    assert not any("trajectory" in name for name, _ in list_summary_rows(summary))


def test_waypoints_alone_are_no_orders_and_a_target_that_moves_is_a_trajectory() -> None:
    assert sent_to([0.5, 0.2, -0.7, -0.7], [0, 1, 2, 2]).ordered_places == ()

    def moving(record: Record) -> Record:
        if not isinstance(record, Decision):
            return record
        target = (0.1 * record.tick * TICK_S, *room().target.tolist()[1:])
        return msgspec.structs.replace(record, target=target, waypoint=None)

    flight = FlightData.from_records([(t, at, moving(r)) for t, at, r in fly(room(), 4.0)])
    assert flight.moving_target and flight.ordered_places == ()
    assert "trajectory" in " ".join(describe_flight(flight, summarise(flight, wall_s=1.0)))
