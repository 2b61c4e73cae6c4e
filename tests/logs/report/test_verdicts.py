"""Risk, link and clocks: counted by hand, and true of flights whose truth is known."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from synthetic_flight import Item, fly
from synthetic_scene import room
from verdict_rig import room as room_config
from verdict_rig import simulate_model

from logs.recording.flight import FlightData
from logs.report.statistics import estimate_share
from logs.report.verdict_clocks import compute_offset_residuals, judge_clocks, judge_stamps
from logs.report.verdict_link import judge_link
from logs.report.verdict_risk import judge_risk
from logs.report.verdict_room import judge_room
from logs.report.verdicts import Verdicts, judge_flight, read_flown_config
from uavctl.config import Config
from uavctl.records import Decision, Event, LinkStats, Plan, PositionSample, Record, Severity, StepInput, Truth


def flight(duration_s: float = 40.0, **changes: object) -> FlightData:
    return FlightData.from_records(fly(room(), duration_s, **changes))  # type: ignore[arg-type]


def moved(found: FlightData, places: set[int], by_m: float = 50.0) -> FlightData:
    """The truth of some boundaries far outside the room."""
    steps = [d.at_ns for d in found.steps.decisions]
    chosen = {steps[place] for place in places}

    def far(one: Truth) -> Truth:
        if one.at_ns not in chosen:
            return one
        return msgspec.structs.replace(one, state=(by_m, *one.state[1:]))

    return dataclasses.replace(found, truths=tuple(map(far, found.truths)))


def with_news(found: FlightData) -> list[int]:
    return [place for place, d in enumerate(found.steps.decisions) if d.age_steps == 0]


def test_violations_at_steps_with_news_are_trials() -> None:
    found = flight()
    news = with_news(found)
    silent = next(place for place, d in enumerate(found.steps.decisions) if d.age_steps == 2)
    verdict = judge_risk(moved(found, {news[5], news[9], silent}), room_config())
    states, inputs, first = verdict.limits[:3]
    assert (states.outside, states.steps) == (3, 200)
    assert (states.measured.hits, states.measured.trials) == (2, len(news) - 1)  # nothing was promised for the first
    assert states.promised == pytest.approx(0.05)
    assert inputs.promised == pytest.approx(0.1)
    assert (first.name, first.measured.hits) == ("upper limit of north position", 2)
    assert verdict.unpromised == 1
    assert not verdict.refuted
    assert verdict.source == "truth"


def test_steps_beyond_the_room_are_counted_beside_what_was_promised() -> None:
    found = flight()
    inside = judge_room(found)
    upper_m = found.design.state_box.upper[found.design.position_index[0]]
    assert (inside.promised, inside.outside, inside.source) == (None, 0, "truth")
    assert inside.beyond_m is not None and inside.beyond_m < 0.0
    left = judge_room(moved(found, {7, 8, 30}), "in 0 of 60")
    assert (left.promised, left.outside, left.steps) == ("in 0 of 60", 3, inside.steps)
    assert left.beyond_m == pytest.approx(50.0 - upper_m)


def test_a_prediction_without_a_position_in_reach_is_no_step_in_the_room() -> None:
    found = flight()
    states = [list(one.mean) for one in found.estimates]
    far = tuple(
        msgspec.structs.replace(one, mean=(50.0, *one.mean[1:])) if i < 20 else one
        for i, one in enumerate(found.estimates)
    )
    assert states and (seen := judge_room(dataclasses.replace(found, truths=(), estimates=far))).outside > 0
    old = tuple(msgspec.structs.replace(one, age_steps=found.design.horizon + 1) for one in found.decisions)
    unseen = judge_room(dataclasses.replace(found, truths=(), estimates=far, decisions=old))
    assert (seen.source, unseen.steps, unseen.outside, unseen.beyond_m) == ("estimate", 0, 0, None)


def test_too_many_violations_refute_the_promise() -> None:
    found = flight()
    verdict = judge_risk(moved(found, set(with_news(found)[10:40])), room_config())
    states = verdict.limits[0]
    assert states.refuted and states.p_value is not None and states.p_value < 1e-6
    assert states.measured.low > 0.05


def test_where_a_plan_gave_way_nothing_was_promised() -> None:
    found = flight()
    slack = tuple(msgspec.structs.replace(plan, slack=1.0) for plan in found.plans)
    verdict = judge_risk(dataclasses.replace(found, plans=slack), room_config())
    assert verdict.limits[0].measured.trials == 0
    assert verdict.unpromised == len(found.steps)
    assert not verdict.refuted


def test_the_fallback_promises_nothing() -> None:
    found = flight(blackout=(10.0, 15.0))
    fallen = [place for place, d in enumerate(found.steps.decisions) if d.mode.value == "brake"]
    assert fallen
    assert judge_risk(found, room_config()).unpromised > len(fallen)


def test_an_unknown_promise_is_said_to_be_unknown() -> None:
    verdict = judge_risk(flight(8.0), None)
    assert verdict.limits[0].promised is None
    assert not verdict.refuted


def link_config(**link: object) -> Config:
    config = room_config()
    return msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, **link))


def test_news_and_ages_by_hand() -> None:
    found = simulate_model(room_config(), 400, seed=1)
    ages = [d.age_steps or 0 for d in found.steps.decisions]
    verdict = judge_link(found, room_config())
    assert (verdict.news.hits, verdict.news.trials) == (ages.count(0), 400)
    assert verdict.news == estimate_share(ages.count(0), 400)
    assert verdict.ages == pytest.approx([ages.count(age) / 400 for age in range(max(ages) + 1)])
    assert verdict.promised_news == pytest.approx(0.7)
    # independent losses: P(age j) = 0.7 · 0.3^j
    assert verdict.promised_ages[:5] == pytest.approx([0.7 * 0.3**age for age in range(5)])
    assert not verdict.refuted and not verdict.bursts
    assert verdict.lost is None  # nobody knows how many were sent


def test_a_link_worse_than_promised_is_found() -> None:
    verdict = judge_link(simulate_model(room_config(), 600, seed=2, loss=0.5), room_config())
    assert verdict.refuted


def test_bursts_are_found_where_losses_are_taken_for_independent() -> None:
    found = simulate_model(room_config(), 600, seed=3, loss=0.0)
    blocks = [0 if (step // 12) % 4 else step % 12 + 1 for step in range(600)]
    held = tuple(msgspec.structs.replace(d, age_steps=blocks[d.step]) for d in found.decisions)
    verdict = judge_link(dataclasses.replace(found, decisions=held), room_config())
    assert verdict.bursts and verdict.refuted
    independent = estimate_share(verdict.news.hits, verdict.news.trials)
    assert verdict.news.high - verdict.news.low > 2.0 * (independent.high - independent.low)


def test_delays_against_those_configured() -> None:
    found = simulate_model(room_config(), 100, seed=4)  # 40 ms, configured are 30 to 70
    good = judge_link(found, room_config()).delay
    short = judge_link(found, link_config(delay_s=0.01, jitter_s=0.02)).delay
    assert good is not None and short is not None and good.late is not None and short.late is not None
    assert good.p50_ms == pytest.approx(40.0)
    assert (good.promised_low_ms, good.promised_high_ms) == pytest.approx((30.0, 70.0))
    assert (good.late.hits, short.late.hits) == (0, len(found.samples))
    assert not good.from_quickest


@pytest.mark.parametrize(("loss", "code", "said"), [(0.3, "link-bursts", 1), (0.3, "wind", 0), (0.5, "link-bursts", 0)])
def test_a_warning_in_flight_that_the_verdict_does_not_share_is_explained(loss: float, code: str, said: int) -> None:
    found = simulate_model(room_config(), 600, seed=2, loss=loss)
    event = Event(at_ns=0, severity=Severity.WARNING, code=code, text="")
    verdict = judge_link(dataclasses.replace(found, events=(event,)), room_config())
    assert verdict.refuted == (loss == 0.5)
    assert verdict.text.count("made in flight") == said


def stats(at_s: float, offset_s: float, **changes: object) -> LinkStats:
    one = LinkStats(
        at_ns=round(at_s * 1e9),
        link="mocap",
        datagrams=1,
        messages=1,
        samples=7,
        bad={},
        clock_offset_ns=round(offset_s * 1e9),
        clock_source="timesync",
        clock_rtt_ns=2_000_000,
        clock_drift_ppm=19.0,
        clock_rejected=3,
    )
    return msgspec.structs.replace(one, **changes)


def test_drift_and_residual_of_a_clock_by_hand() -> None:
    # 20 ppm, and ±5 µs that are orthogonal to a straight line
    wiggle = [5e-6, -5e-6, -5e-6, 5e-6] * 10
    rows = tuple(stats(float(k), 100.0 + 2e-5 * k + wiggle[k]) for k in range(40))
    found = dataclasses.replace(flight(8.0), links=(*rows, stats(1.0, 0.0, link="silent", clock_offset_ns=None)))
    (verdict,) = judge_clocks(found)
    assert verdict.drift_ppm == pytest.approx(20.0, abs=0.05)
    assert verdict.residual_us == pytest.approx(5.0, rel=0.02)
    assert (verdict.rtt_ms, verdict.rejected, verdict.counted, verdict.source) == (2.0, 3, 40, "timesync")
    assert len(compute_offset_residuals(found, "mocap")[1]) == 40


def test_an_offset_told_twice_is_not_judged() -> None:
    found = dataclasses.replace(flight(8.0), links=(stats(1.0, 1.0), stats(2.0, 1.0)))
    (verdict,) = judge_clocks(found)
    assert verdict.drift_ppm is None


def circling(late_ns: int) -> FlightData:
    """Truth on a circle at 1 m/s, and positions on it with stamps that are late."""
    base = [item for item in fly(room(), 8.0) if not isinstance(item[2], (Truth, StepInput))]
    begun_ns = base[0][1]
    items: list[Item] = list(base)
    for k in range(40):
        at_ns = begun_ns + k * 200_000_000
        t = 0.2 * k
        place, speed = (np.sin(t), -np.cos(t), 0.0), (np.cos(t), np.sin(t), 0.0)
        items.append(("", at_ns, truth(at_ns, place, speed)))
        if 0 < k < 39:
            taken = t - 0.07
            stamp_ns = at_ns - 70_000_000 + late_ns
            seen = (float(np.sin(taken)), float(-np.cos(taken)), 0.0)
            one = PositionSample(
                captured_ns=stamp_ns, received_ns=at_ns, position_m=seen, std_m=0.001, source="camera", seq=k
            )
            items.append(("", at_ns, StepInput(tick=4 * k, at_ns=at_ns, samples=(one,))))
    return FlightData.from_records(items)


def truth(at_ns: int, place: tuple[float, ...], speed: tuple[float, ...]) -> Truth:
    return Truth(
        at_ns=at_ns,
        position_m=tuple(map(float, place)),  # type: ignore[arg-type]
        velocity_mps=tuple(map(float, speed)),  # type: ignore[arg-type]
        state=(0.0,) * 9,
        input=(0.0,) * 3,
        sent=0,
        lost=0,
        mode="",
    )


@pytest.mark.parametrize("late_ms", [0.0, 25.0, -10.0])
def test_late_stamps_show_in_the_true_path(late_ms: float) -> None:
    verdict = judge_stamps(circling(round(late_ms * 1e6)))
    assert verdict is not None
    assert verdict.late_ms == pytest.approx(late_ms, abs=0.3)
    assert verdict.positions == 38


def test_without_truth_or_motion_stamps_are_not_judged() -> None:
    found = circling(0)
    assert judge_stamps(dataclasses.replace(found, truths=())) is None
    still = tuple(
        msgspec.structs.replace(truth, velocity_mps=(0.0, 0.0, 0.0), position_m=(1.0, 0.0, 0.0))
        for truth in found.truths
    )
    assert judge_stamps(dataclasses.replace(found, truths=still)) is None


def test_a_configuration_that_cannot_be_read_leaves_the_rest() -> None:
    found = flight(8.0)
    assert read_flown_config(found) is None
    verdicts = judge_flight(found).verdicts
    assert verdicts.model is None
    assert verdicts.risk.limits[0].steps == 40


def test_verdicts_survive_json() -> None:
    verdicts = judge_flight(simulate_model(room_config(), 100, seed=6)).verdicts
    assert msgspec.json.decode(msgspec.json.encode(verdicts), type=Verdicts) == verdicts


def test_plans_and_decisions_are_what_the_trials_are_made_from() -> None:
    def without(record: Record) -> bool:
        return not isinstance(record, Plan)

    items = [item for item in fly(room(), 8.0) if without(item[2])]
    found = FlightData.from_records(items)
    assert any(isinstance(decision, Decision) for decision in found.decisions)
    assert judge_risk(found, room_config()).limits[0].measured.trials == 0
