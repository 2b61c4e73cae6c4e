"""Faults of the link, the messages and the clock, one test a row of the table of faults.

Each fault is injected, and the reaction asserted from the records of the ticks alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from flight_rig import (
    HORIZON,
    MS,
    START_NS,
    TICK_NS,
    TICKS,
    StubSolver,
    assert_sound,
    boundary_ns,
    find_boundaries,
    list_codes,
    list_plan_steps,
    make_controller,
    make_inputs,
    make_step_samples,
    run,
    sample,
    small_plant,
    stub_inputs,
    vehicle,
)

from uavctl.flight.estimator import LATEST_STAMP_NS
from uavctl.records import ControlMode, PositionSample, StepInput

TRACK = ControlMode.TRACK
FALLBACK = (ControlMode.BRAKE, ControlMode.HOLD)


@pytest.mark.fault(1)
def test_row_1_one_loss_is_played_out_in_the_same_tick() -> None:
    outputs = run(make_controller(), make_inputs(range(5 * TICKS), make_step_samples(lost=[3])))
    assert list_plan_steps(outputs) == [(0, 0), (1, 0), (2, 0), (2, 1), (4, 0)]
    lost = find_boundaries(outputs)[3]
    assert (lost.decision.age_steps, lost.decision.news, lost.decision.solve, lost.plan) == (1, False, None, None)
    assert lost.decision.input == tuple(stub_inputs(2, HORIZON, 1)[1])
    assert lost.setpoint is not None


@pytest.mark.fault(2)
def test_row_2_a_burst_shorter_than_the_horizon_is_played_out() -> None:
    burst = range(3, 3 + HORIZON - 1)
    outputs = run(make_controller(), make_inputs(range(8 * TICKS), make_step_samples(lost=burst)))
    assert list_plan_steps(outputs) == [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (2, 3), (6, 0), (7, 0)]
    assert [output.decision.age_steps for output in find_boundaries(outputs)] == [0, 0, 0, 1, 2, 3, 0, 0]
    assert {output.decision.mode for output in outputs} == {TRACK}
    for output in find_boundaries(outputs)[3:6]:
        assert output.decision.input == tuple(stub_inputs(2, HORIZON, 1)[output.decision.age_steps or 0])


@pytest.mark.fault(3)
def test_row_3_fallback_in_the_very_tick_in_which_the_age_reaches_the_horizon() -> None:
    outputs = run(make_controller(), make_inputs(range(8 * TICKS), make_step_samples(lost=range(3, 99))))
    entered = (2 + HORIZON) * TICKS
    assert all(output.decision.mode is TRACK for output in outputs[:entered])
    assert all(output.decision.mode in FALLBACK for output in outputs[entered:])
    assert outputs[entered].decision.age_steps == HORIZON


@pytest.mark.slow
@pytest.mark.fault(3)
def test_row_3_no_miss_in_20000_ticks_of_random_losses() -> None:
    rng = np.random.default_rng(30)
    steps = 5000
    arrives = rng.random(steps) < 0.6
    outputs = run(
        make_controller(land=False),
        make_inputs(range(steps * TICKS), make_step_samples(lost=np.flatnonzero(~arrives).tolist(), steps=steps)),
    )
    falls, misses, last, in_row, tracking = 0, 0, None, 0, False
    for number in range(steps):  # the rule in a few lines: age H is the fallback, 3 samples since then the way back
        if arrives[number]:
            last = number
        in_row += int(arrives[number])
        if last is None:
            continue
        if number - last >= HORIZON:
            falls += tracking
            tracking, in_row = False, 0
        elif not tracking and (in_row >= 3 or falls == 0):
            tracking = True
        for output in outputs[number * TICKS : (number + 1) * TICKS]:
            misses += (output.decision.mode is TRACK) != tracking
            misses += not tracking and output.decision.mode not in FALLBACK
    assert misses == 0
    assert falls > 50
    assert_sound(outputs)


@pytest.mark.fault(4)
def test_row_4_a_late_packet_ages_from_its_capture_and_the_plan_is_rebased() -> None:
    delayed_sample = sample(boundary_ns(3) - 50 * MS, boundary_ns(5) - 10 * MS, position_m=(0.1, 0.0, 0.0))
    samples = [*make_step_samples(lost=[3, 4, 5]), delayed_sample]
    solver = StubSolver(small_plant())
    outputs = run(make_controller(solver), make_inputs(range(7 * TICKS), samples))
    assert [output.decision.age_steps for output in find_boundaries(outputs)] == [0, 0, 0, 1, 2, 2, 0]
    assert list_plan_steps(outputs) == [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (5, 0), (6, 0)]
    rebased = find_boundaries(outputs)[5]
    assert rebased.plan is not None
    assert rebased.estimate is not None
    assert (rebased.plan.base_ns, rebased.plan.captured_ns) == (boundary_ns(5), boundary_ns(3) - 50 * MS)
    assert tuple(rebased.plan.states[0]) == rebased.estimate.mean  # predicted to the boundary, not as it was captured


@pytest.mark.fault(5)
def test_row_5_an_overtaken_packet_is_not_a_new_measurement_but_improves_the_estimate() -> None:
    older = sample(boundary_ns(2) - 50 * MS, boundary_ns(3) + 10 * MS, position_m=(0.05, 0.0, 0.0))
    newer = sample(boundary_ns(3) - 60 * MS, boundary_ns(3) - 55 * MS)
    ticks = range(5 * TICKS)
    overtaken = run(make_controller(), make_inputs(ticks, [*make_step_samples(steps=2), newer, older]))
    lost = run(make_controller(), make_inputs(ticks, [*make_step_samples(steps=2), newer]))
    assert list_plan_steps(overtaken) == list_plan_steps(lost) == [(0, 0), (1, 0), (1, 1), (3, 0), (3, 1)]
    arrival = 3 * TICKS + 1
    assert overtaken[arrival].decision.accepted == 1
    assert overtaken[arrival].estimate != lost[arrival].estimate
    assert [output.estimate for output in overtaken[:arrival]] == [output.estimate for output in lost[:arrival]]
    assert [output.decision.age_steps for output in overtaken] == [output.decision.age_steps for output in lost]


@pytest.mark.fault(5)
def test_row_5_a_packet_older_than_the_window_is_dropped_and_counted() -> None:
    old = sample(boundary_ns(0) - 50 * MS, boundary_ns(12), position_m=(5.0, 0.0, 0.0))
    plain = run(make_controller(), make_inputs(range(13 * TICKS), make_step_samples()))
    outputs = run(make_controller(), make_inputs(range(13 * TICKS), [*make_step_samples(), old]))
    last = outputs[12 * TICKS]
    assert last.decision.rejected == 1
    assert list_codes(last) == {"sample-too-old": 1}
    assert [output.estimate for output in outputs] == [output.estimate for output in plain]


@pytest.mark.fault(6)
def test_row_6_duplicates_are_dropped_and_counted() -> None:
    samples = make_step_samples()
    twice = [
        *samples,
        *(msgspec.structs.replace(sample, received_ns=sample.received_ns + 40 * MS) for sample in samples),
    ]
    plain = run(make_controller(), make_inputs(range(8 * TICKS), samples))
    outputs = run(make_controller(), make_inputs(range(8 * TICKS), twice))
    assert [output.setpoint for output in outputs] == [output.setpoint for output in plain]
    assert [output.estimate for output in outputs] == [output.estimate for output in plain]
    assert sum(output.decision.rejected for output in outputs) == 8
    assert sum(list_codes(output).get("sample-duplicate", 0) for output in outputs) == 8


@pytest.mark.fault(7)
def test_row_7_a_backlog_burst_is_one_solve_with_the_newest() -> None:
    at_ns = boundary_ns(4)
    backlog = [sample(at_ns - n * 20 * MS, at_ns) for n in range(140)]
    np.random.default_rng(7).shuffle(backlog)
    solver = StubSolver(small_plant())
    outputs = run(make_controller(solver), make_inputs(range(5 * TICKS), [*make_step_samples(steps=1), *backlog]))
    burst = outputs[4 * TICKS]
    assert [seq for seq, _ in solver.asked] == [0, 4]
    assert burst.plan is not None
    assert burst.plan.captured_ns == at_ns
    assert (burst.decision.accepted, burst.decision.rejected) == (100, 40)  # window_s = 2 s holds 100 of 20 ms
    assert list_codes(burst)["sample-too-old"] == 40
    assert (burst.decision.mode, burst.decision.plan_seq) == (TRACK, 4)


def make_bad_sample(**changes: object) -> Callable[[PositionSample], PositionSample]:
    return lambda position_sample: msgspec.structs.replace(position_sample, **changes)


BAD_SAMPLES = {
    "nan": make_bad_sample(position_m=(math.nan, 0.0, 0.0)),
    "inf": make_bad_sample(position_m=(0.0, math.inf, 0.0)),
    "minus inf": make_bad_sample(position_m=(0.0, 0.0, -math.inf)),
    "absurd": make_bad_sample(position_m=(1000.1, 0.0, 0.0)),
    "huge": make_bad_sample(position_m=(1e308, 0.0, 0.0)),
    "velocity nan": make_bad_sample(velocity_mps=(0.0, math.nan, 0.0)),
    "velocity absurd": make_bad_sample(velocity_mps=(0.0, 0.0, -100.1)),
    "std zero": make_bad_sample(std_m=0.0),
    "std negative": make_bad_sample(std_m=-1.0),
    "std nan": make_bad_sample(std_m=math.nan),
    "std inf": make_bad_sample(std_m=math.inf),
    "std huge": make_bad_sample(std_m=1e200),
}


@pytest.mark.fault(12)
@pytest.mark.parametrize("fault", BAD_SAMPLES)
def test_row_12_a_sample_that_is_not_finite_or_absurd_counts_as_lost(fault: str) -> None:
    spoil = BAD_SAMPLES[fault]
    samples = [spoil(sample) if number in (3, 4) else sample for number, sample in enumerate(make_step_samples())]
    lost = run(make_controller(), make_inputs(range(6 * TICKS), make_step_samples(lost=[3, 4])))
    outputs = run(make_controller(), make_inputs(range(6 * TICKS), samples))
    assert [output.setpoint for output in outputs] == [output.setpoint for output in lost]
    assert [output.estimate for output in outputs] == [output.estimate for output in lost]
    assert [output.decision.age_steps for output in find_boundaries(outputs)] == [0, 0, 0, 1, 2, 0]
    assert [output.decision.rejected for output in find_boundaries(outputs)] == [0, 0, 0, 1, 1, 0]
    assert list_codes(find_boundaries(outputs)[3]) == {"sample-invalid": 1}


@pytest.mark.fault(12)
def test_row_12_values_at_their_limits_count() -> None:
    edge = sample(START_NS, position_m=(1000.0, -1000.0, 1000.0), velocity_mps=(100.0, -100.0, 0.0), std_m=1000.0)
    output = run(make_controller(), make_inputs(range(1), [edge]))[0]
    assert (output.decision.accepted, output.decision.rejected) == (1, 0)


@pytest.mark.fault(18)
@pytest.mark.parametrize(
    ("captured_ns", "code"),
    [
        (boundary_ns(2) + LATEST_STAMP_NS + 1, "sample-future"),
        (boundary_ns(2) + 3600 * 10**9, "sample-future"),
        (2**32 * MS, "sample-future"),
        (2**63 - 1, "sample-future"),
        (2**64 + 5, "sample-future"),
        (0, "sample-too-old"),
        (-(2**32) * MS, "sample-too-old"),
        (boundary_ns(2) - 2**32 * MS, "sample-too-old"),
        (-(2**63), "sample-too-old"),
    ],
)
def test_row_18_impossible_stamps_are_refused_without_an_exception(captured_ns: int, code: str) -> None:
    odd = sample(captured_ns, boundary_ns(2))
    plain = run(make_controller(), make_inputs(range(4 * TICKS), make_step_samples()))
    outputs = run(make_controller(), make_inputs(range(4 * TICKS), [*make_step_samples(), odd]))
    assert list_codes(outputs[2 * TICKS]) == {code: 1}
    assert outputs[2 * TICKS].decision.rejected == 1
    assert [output.setpoint for output in outputs] == [output.setpoint for output in plain]
    assert [output.estimate for output in outputs] == [output.estimate for output in plain]


@pytest.mark.fault(18)
def test_row_18_a_sample_that_arrives_after_the_tick_is_refused() -> None:
    early = StepInput(tick=0, at_ns=START_NS, samples=(sample(START_NS, START_NS + 1),), vehicle=vehicle())
    output = run(make_controller(), [early])[0]
    assert list_codes(output) == {"sample-future": 1}


@pytest.mark.fault(18)
def test_row_18_flying_across_2_to_the_32_milliseconds_changes_nothing() -> None:
    shift = 2**32 * MS - boundary_ns(3)

    def shifted(position_sample: PositionSample) -> PositionSample:
        return msgspec.structs.replace(
            position_sample,
            captured_ns=position_sample.captured_ns + shift,
            received_ns=position_sample.received_ns + shift,
        )

    inputs = make_inputs(range(6 * TICKS), make_step_samples(lost=[2]))
    later = [
        msgspec.structs.replace(inp, at_ns=inp.at_ns + shift, samples=tuple(map(shifted, inp.samples)))
        for inp in inputs
    ]
    plain, wrapped = run(make_controller(), inputs), run(make_controller(), later)
    assert list_plan_steps(wrapped) == list_plan_steps(plain)
    means = [
        (a.estimate.mean, b.estimate.mean) for a, b in zip(plain, wrapped, strict=True) if a.estimate and b.estimate
    ]
    assert len(means) == len(plain)
    assert all(a == b for a, b in means)


@pytest.mark.fault(21)
def test_row_21_missed_ticks_are_counted_and_there_is_one_setpoint_a_tick() -> None:
    ticks = [tick for tick in range(6 * TICKS) if not 2 * TICKS + 2 <= tick < 4 * TICKS + 2]
    outputs = run(make_controller(), make_inputs(ticks, make_step_samples()))
    woken = next(output for output in outputs if output.decision.tick == 4 * TICKS + 2)
    assert woken.decision.missed_ticks == 2 * TICKS
    assert list_codes(woken)["missed-ticks"] == 2 * TICKS
    assert woken.decision.boundary
    assert (woken.decision.step, woken.decision.plan_seq, woken.decision.plan_index) == (4, 4, 0)
    assert woken.plan is not None
    assert woken.plan.base_ns == boundary_ns(4)
    stamps = [output.setpoint.at_ns for output in outputs if output.setpoint is not None]
    assert stamps == [START_NS + tick * TICK_NS for tick in ticks]


@pytest.mark.fault(21)
def test_row_21_a_missed_boundary_at_which_the_age_reaches_the_horizon_is_the_fallback_in_the_next_tick() -> None:
    delayed_sample = sample(
        boundary_ns(3) - 50 * MS, boundary_ns(5) - 10 * MS
    )  # so that the plan ends after the age has reached H
    after_the_boundary = sample(boundary_ns(7) + 10 * MS)
    samples = [*make_step_samples(steps=3), delayed_sample, after_the_boundary]
    ticks = [tick for tick in range(8 * TICKS) if tick != 7 * TICKS]
    punctual = run(make_controller(), make_inputs(range(8 * TICKS), samples))[7 * TICKS]
    woken = run(make_controller(), make_inputs(ticks, samples))[7 * TICKS]
    assert woken.decision.tick == 7 * TICKS + 1
    assert (woken.decision.boundary, woken.decision.accepted) == (True, 1)
    for decision in (punctual.decision, woken.decision):
        assert decision.mode in FALLBACK
        assert (decision.age_steps, decision.fresh) == (HORIZON, 0)


@pytest.mark.fault(21)
def test_row_21_oversleeping_past_the_horizon_is_the_fallback_in_the_tick_that_wakes() -> None:
    ticks = [*range(2 * TICKS), *range(4 * TICKS + 1, 5 * TICKS)]
    outputs = run(make_controller(), make_inputs(ticks, make_step_samples(steps=1)))
    assert outputs[2 * TICKS].decision.mode in FALLBACK
    assert outputs[2 * TICKS].decision.age_steps == HORIZON
