"""The vehicle's own inertial data in the filter and in the tick, and inputs that begin to act after a dead time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from envelope_rig import PARAMETERS, motion
from flight_rig import (
    DT_NS,
    HORIZON,
    MS,
    START_NS,
    TICK_NS,
    TICKS,
    StubSolver,
    drag_lag_generator,
    estimator_parameters,
    make_controller,
    make_step_samples,
    sample,
    small_plant,
    stub_inputs,
    vehicle,
)
from scipy.linalg import expm

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.event_codes import EventCode
from uavctl.flight.act import find_return_accel
from uavctl.flight.context import locate_on_grid, view_filter
from uavctl.flight.controller import Controller
from uavctl.flight.decide import carries_estimate
from uavctl.flight.estimator import (
    FilterHistory,
    PendingInputs,
    absorb_samples,
    apply_due_inputs,
    begin_history,
    distrust_inertial,
    estimate_at,
    find_newest_belief,
    note_input,
    predict_ahead,
    predict_belief,
    update_inertial,
)
from uavctl.flight.fallback import Fallback, FallbackReason
from uavctl.flight.kalman import (
    DRIFT_WITHOUT_INERTIAL,
    INERTIAL_LASTS_NS,
    Belief,
    Kalman,
    make_first_belief,
    make_kalman,
    predict,
    update_with_inertial,
)
from uavctl.flight.monitors.inertial import DISTRUST_NS, MOST_REFUSED, InertialTrust
from uavctl.flight.state import ControlState
from uavctl.flight.tick import TickOutput, make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.records import ControlMode, Decision, Estimate, InertialSample, PositionSample, StepInput, Vec3
from uavctl.wiring.controller import build_estimator, build_plant

DRAG, LAG = 0.3, 0.25
WIND, DRIFT, MOST = 0.15, 0.2, 0.4
FELT, OFF, OFF_S = 0.05, 0.1, 20.0
INERTIAL = {
    "bias_drift": DRIFT,
    "bias_max": MOST,
    "inertial_std_mps2": FELT,
    "inertial_bias_mps2": OFF,
    "inertial_bias_s": OFF_S,
}
DT_S = DT_NS * 1e-9


def make(**changes: float) -> Kalman:
    return make_kalman(small_plant(wind_std=WIND), estimator_parameters(**{**INERTIAL, **changes}), DT_NS)


def generator() -> Array:
    """Of (p, v, a, d, b; w, n, m; u): n carries the force d on a line through a step, m is what b goes to."""
    g = np.zeros((9, 9))
    g[0, 1] = 1.0
    g[1, [1, 2, 5]] = -DRAG, 1.0, 1.0
    g[2, [2, 3, 8, 6]] = -1.0 / LAG, 1.0 / LAG, 1.0 / LAG, 1.0 / DT_S
    g[3, 6] = 1.0 / DT_S
    g[4, [4, 7]] = -1.0 / OFF_S, 1.0 / OFF_S
    return g


def felt_at(at_ns: int, *accels_mps2: float) -> tuple[InertialSample, ...]:
    """Samples of one tick whose mean time is `at_ns`."""
    first_ns = at_ns - (len(accels_mps2) - 1) * MS // 2
    return tuple(
        InertialSample(at_ns=first_ns + i * MS, accel_mps2=(accel, 9.0, 9.0)) for i, accel in enumerate(accels_mps2)
    )


def conditioned(
    places: dict[int, float], accels: dict[int, float], inputs: dict[int, float], at_ns: int
) -> tuple[Array, Array]:
    """Mean and covariance of (p, v, a, d, b): the joint Gaussian of start and draws, conditioned on all at once."""
    g, first_ns = generator(), min(places)
    first = (first_ns - START_NS) // DT_NS
    draws = (at_ns - START_NS) // DT_NS - first + 1
    keep = math.exp(-DT_S / OFF_S)
    of_draw = [WIND**2, DRIFT**2 * DT_S, OFF**2 * (1.0 + keep) / (1.0 - keep)]
    # The last one is a push of the force where inertial data begin.
    prior = np.diag([0.005**2, 0.3**2, 0.3**2, (0.25 * MOST) ** 2, OFF**2, *of_draw * draws, MOST**2])
    offset, linear = np.array([places[first_ns], 0.0, 0.0, 0.0, 0.0]), np.eye(5, len(prior))
    grid = {START_NS + (first + n) * DT_NS for n in range(draws + 1)}
    times = sorted(t for t in {at_ns, *places, *accels, *inputs, *grid} if first_ns <= t <= at_ns)
    rows, off, variances = [], [], []
    for earlier, later in itertools.pairwise([*times, at_ns]):
        u = next((value for when, value in sorted(inputs.items(), reverse=True) if when <= earlier), 0.0)
        place = 5 + 3 * ((earlier - START_NS) // DT_NS - first)
        drawn = np.zeros((3, len(prior)))
        drawn[:, place : place + 3] = np.eye(3)
        if earlier in places and earlier != first_ns:
            rows.append(linear[0])
            off.append(places[earlier] - offset[0])
            variances.append(0.005**2)
        if earlier == min(accels):
            linear[:, -1] += [0.0, 0.0, 1.0, 1.0, 0.0]
        if earlier in accels:
            before = next((value for when, value in sorted(inputs.items(), reverse=True) if when < earlier), 0.0)
            rows.append(g[1, :5] @ linear + g[1, 5:8] @ drawn + linear[4])
            off.append(accels[earlier] - g[1, :5] @ offset - g[1, 8] * before - offset[4])
            variances.append(FELT**2)
        moved = expm(g * (later - earlier) * 1e-9)
        linear = moved[:5, :5] @ linear + moved[:5, 5:8] @ drawn
        offset = moved[:5, :5] @ offset + moved[:5, 8] * u
    h = np.array(rows)
    gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + np.diag(variances))
    return offset + linear @ gain @ np.array(off), linear @ (prior - gain @ h @ prior) @ linear.T


def known(kalman: Kalman, history: FilterHistory, at_ns: int) -> tuple[Array, Array]:
    belief = predict_belief(kalman, history, at_ns)
    assert belief is not None
    return belief.mean[: kalman.n_x], belief.cov[: kalman.n_x, : kalman.n_x]


def test_equals_conditioning_positions_and_accelerations_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("uavctl.flight.monitors.inertial.PLAUSIBLE_SIGMA", math.inf)  # all of them are to count
    monkeypatch.setattr("uavctl.flight.kalman.DRIFT_WITHOUT_INERTIAL", 1.0)  # one noise throughout
    kalman = make()
    places = {START_NS + t * MS: p for t, p in ((30, 0.10), (200, 0.14), (415, 0.13), (700, 0.2))}
    accels = {START_NS + t * MS: a for t, a in ((75, 0.1), (130, 0.12), (260, -0.1), (350, 0.3), (610, 0.2))}
    inputs = {START_NS + t * MS: u for t, u in ((0, 0.2), (150, -0.4), (500, 0.3))}
    history = begin_history(kalman, START_NS, START_NS)
    for tick in range(16):
        at_ns = START_NS + tick * TICK_NS
        samples = [sample(t, at_ns, (p, 0.0, 0.0)) for t, p in places.items() if at_ns - TICK_NS < t <= at_ns]
        history, taken, _ = absorb_samples(kalman, history, at_ns, samples)
        assert len(taken) == len(samples)
        for t, accel in accels.items():
            if at_ns - TICK_NS < t <= at_ns:
                history = update_inertial(kalman, history, felt_at(t, accel - 0.01, accel, accel + 0.01))
        if at_ns in inputs:
            history = note_input(history, at_ns, np.array([inputs[at_ns]]))
    mean, cov = known(kalman, history, at_ns)
    want_mean, want_cov = conditioned(places, accels, inputs, at_ns)
    np.testing.assert_allclose(mean, want_mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(cov, want_cov, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_late_positions_among_inertial_data_give_the_same_bits_as_positions_in_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kalman = make()
    captured = [START_NS + int(t) * MS for t in np.sort(rng.choice(np.arange(1, 900), size=12, replace=False))]
    places, late_ns = rng.normal(0.0, 0.02, size=12), rng.integers(0, 900, size=12) * MS
    accels, inputs = rng.normal(0.0, 0.1, size=40), rng.normal(0.0, 0.3, size=40)

    def flown(late: bool) -> Estimate | None:
        history = begin_history(kalman, START_NS, START_NS)
        samples = [
            sample(t, t + int(by) * late, (float(p), 0.0, 0.0))
            for t, by, p in zip(captured, late_ns, places, strict=True)
        ]
        for tick in range(40):
            at_ns = START_NS + tick * TICK_NS
            due = [one for one in samples if at_ns - TICK_NS < one.received_ns <= at_ns]
            history, _, _ = absorb_samples(kalman, history, at_ns, due)
            history = update_inertial(kalman, history, felt_at(at_ns - 20 * MS, accels[tick]))
            history = note_input(history, at_ns, inputs[tick : tick + 1])
        return estimate_at(kalman, history, at_ns)

    assert flown(late=False) is not None
    # What comes before the first position says nothing, and that one may come late: so the first is in time.
    late_ns[0] = 0
    assert repr(flown(late=True)) == repr(flown(late=False))


def blind(
    history: FilterHistory, kalman: Kalman, push_mps2: float, seconds: float, *, feels: bool
) -> tuple[float, float]:
    """Error of position and its deviation [m] after a time without positions under a force that began with it."""
    begin_ns = START_NS + 4 * 1_000_000_000
    v, p, at_ns = 0.0, 0.0, begin_ns
    for _ in range(round(seconds * 1e9) // TICK_NS):
        h = TICK_NS * 1e-9
        accel = push_mps2 - DRAG * v
        p, v, at_ns = p + h * v + 0.5 * h * h * accel, v + h * accel, at_ns + TICK_NS
        history, _, _ = absorb_samples(kalman, history, at_ns, ())
        if feels:
            history = update_inertial(kalman, history, felt_at(at_ns - TICK_NS // 2, accel))
    mean, cov = known(kalman, history, at_ns)
    return mean[0] - p, math.sqrt(cov[0, 0])


def test_a_force_that_begins_in_silence_is_felt_and_unfelt_is_not_known() -> None:
    kalman = make()
    history = note_input(begin_history(kalman, START_NS, START_NS), START_NS, np.zeros(1))
    for tick in range(81):
        at_ns = START_NS + tick * TICK_NS
        history, _, _ = absorb_samples(kalman, history, at_ns, [sample(at_ns)] if tick % 4 == 0 else [])
        history = update_inertial(kalman, history, felt_at(at_ns - TICK_NS // 2, 0.0))
    error_m, std_m = blind(history, kalman, 0.15, 2.0, feels=True)
    unfelt_m, unfelt_std_m = blind(history, kalman, 0.15, 2.0, feels=False)
    assert abs(unfelt_m) == pytest.approx(0.5 * 0.15 * 2.0**2, rel=0.2)  # it knows nothing of the force
    assert abs(error_m) < 0.1 * abs(unfelt_m) and abs(error_m) < 3.0 * std_m
    assert std_m < 0.5 * unfelt_std_m


def test_what_the_sensors_are_off_for_long_is_learnt_from_positions() -> None:
    kalman = make()
    history = note_input(begin_history(kalman, START_NS, START_NS), START_NS, np.zeros(1))
    for tick in range(20 * 40):
        at_ns = START_NS + tick * TICK_NS
        history, _, _ = absorb_samples(kalman, history, at_ns, [sample(at_ns)] if tick % 4 == 0 else [])
        history = update_inertial(kalman, history, felt_at(at_ns - TICK_NS // 2, 0.12))
    mean, cov = known(kalman, history, at_ns)
    assert mean[4] == pytest.approx(0.12, abs=0.02)
    assert abs(mean[3]) < 0.02 and math.sqrt(cov[4, 4]) < 0.05
    now = estimate_at(kalman, history, at_ns)
    assert now is not None and len(now.mean) == 3 and now.bias == (mean[3],)  # of the plant, and against what it flies


def followed(kalman: Kalman, seconds: float, told_mps2: Callable[[int], float], every: int = 4) -> list[Belief]:
    """Beliefs, tick by tick, of a vehicle at rest whose positions say so and whose inertial data say something."""
    history = note_input(begin_history(kalman, START_NS, START_NS), START_NS, np.zeros(1))
    beliefs = []
    for tick in range(round(seconds * 1e9) // TICK_NS):
        at_ns = START_NS + tick * TICK_NS
        history, _, _ = absorb_samples(kalman, history, at_ns, [sample(at_ns)] if tick % every == 0 else [])
        history = update_inertial(kalman, history, felt_at(at_ns + MS, told_mps2(tick)))
        belief = find_newest_belief(kalman, history)
        assert belief is not None
        beliefs.append(belief)
    return beliefs


def test_a_flight_that_begins_in_a_wind_does_not_doubt_what_it_feels_first_but_later() -> None:
    """A push of twice the largest bias that is counted on, from the first inertial data on, and all of a sudden."""
    first = followed(make(), 2.0, lambda tick: 2.0 * MOST)
    later = followed(make(), 2.0, lambda tick: 2.0 * MOST if tick >= 20 else 0.0)
    assert all(belief.inertial.distrusted_ns is None and not belief.inertial.refused for belief in first[:3])
    assert first[2].mean[3] > MOST
    assert later[20 + MOST_REFUSED - 1].inertial.distrusted_ns is not None


def test_data_that_cannot_be_are_doubted_and_believed_again_when_positions_agree_for_long() -> None:
    kalman = make()
    beliefs = followed(kalman, 12.0, lambda tick: 3.0 if 40 <= tick < 60 else 0.0)
    first = next(tick for tick, belief in enumerate(beliefs) if belief.inertial.distrusted_ns is not None)
    assert first == 40 + MOST_REFUSED - 1
    again = next(tick for tick in range(first, len(beliefs)) if beliefs[tick].inertial.distrusted_ns is None)
    assert DISTRUST_NS <= beliefs[again].at_ns - beliefs[first].at_ns <= DISTRUST_NS + 4 * TICK_NS
    assert all(
        belief.inertial.used_ns == beliefs[39].inertial.used_ns for belief in beliefs[first:again]
    )  # nothing of them is in it
    assert beliefs[-1].inertial.used_ns == beliefs[-1].at_ns
    assert max(abs(float(belief.mean[1])) for belief in beliefs) < 0.05


def test_one_that_cannot_be_is_left_out_and_no_reason_for_doubt() -> None:
    beliefs = followed(make(), 6.0, lambda tick: 3.0 if tick % 10 == 5 else 0.0)
    assert all(belief.inertial.distrusted_ns is None for belief in beliefs)
    assert max(abs(float(belief.mean[1])) for belief in beliefs) < 0.05


def test_a_doubt_outlives_positions_that_come_late_and_what_it_took_back_stays_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("uavctl.flight.kalman.DRIFT_WITHOUT_INERTIAL", 1.0)  # as fast in doubt as without
    kalman = make()

    def told(*, lies: bool, late: bool) -> Belief:
        history = note_input(begin_history(kalman, START_NS, START_NS), START_NS, np.zeros(1))
        for tick in range(20):
            at_ns = START_NS + tick * TICK_NS
            samples = [sample(at_ns)] if tick % 4 == 0 and tick <= 8 else []
            history, _, _ = absorb_samples(kalman, history, at_ns, samples)
            if tick < 8 or (lies and tick > 8):
                history = update_inertial(kalman, history, felt_at(at_ns + MS, 0.1 if tick > 8 else 0.0))
        history = distrust_inertial(history, at_ns + 2 * MS) if lies else history
        at_ns += TICK_NS
        if late:
            history, taken, _ = absorb_samples(kalman, history, at_ns, [sample(START_NS + 6 * TICK_NS, at_ns)])
            assert taken
        belief = predict_belief(kalman, update_inertial(kalman, history, felt_at(at_ns, 0.1) if lies else ()), at_ns)
        assert belief is not None
        return belief

    for late in (False, True):
        lied, silent = told(lies=True, late=late), told(lies=False, late=late)
        assert lied.inertial.distrusted_ns is not None and silent.inertial.distrusted_ns is None
        np.testing.assert_allclose(lied.mean, silent.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(lied.cov, silent.cov, rtol=0, atol=1e-12)


@pytest.mark.fault(59)
def test_positions_that_contradict_what_is_felt_make_it_doubted() -> None:
    kalman = make()
    beliefs = followed(kalman, 10.0, lambda tick: min(max(tick - 80, 0) * 0.02, 1.5), every=16)
    contradicted = [
        belief for belief in beliefs if belief.inertial.distrusted_ns is not None and not belief.inertial.refused
    ]
    assert contradicted and contradicted[0].inertial.distrusted_ns == contradicted[0].captured_ns
    off = [abs(float(belief.mean[0])) for belief in beliefs]
    believed = followed(make(), 10.0, lambda tick: 0.0, every=16)
    # It is less off once it is doubted than before, and hardly more than had nothing been said.
    assert max(off[-16:]) < 0.5 * max(off) + max(abs(float(belief.mean[0])) for belief in believed)


def test_what_cannot_be_or_says_nothing_is_not_believed() -> None:
    kalman = make()
    history, _, _ = absorb_samples(kalman, begin_history(kalman, START_NS, START_NS), START_NS, [sample(START_NS)])
    at_ns = START_NS + TICK_NS
    fine = update_inertial(kalman, history, felt_at(at_ns, 0.1))
    assert repr(known(kalman, fine, at_ns)) != repr(known(kalman, history, at_ns))
    for told in ((40.0,), (math.nan,), (math.inf, -math.inf), ()):
        unmoved = update_inertial(kalman, history, felt_at(at_ns, *told))
        assert repr(known(kalman, unmoved, at_ns)) == repr(known(kalman, history, at_ns))
    stuck = felt_at(at_ns, 0.1, 0.1, 0.1)
    assert repr(known(kalman, update_inertial(kalman, history, stuck), at_ns)) == repr(
        known(kalman, update_inertial(kalman, history, stuck[:1]), at_ns)
    )
    old_ns = START_NS - 3_000_000_000
    assert update_inertial(kalman, history, felt_at(old_ns, 0.1)) is history
    deaf = make_kalman(small_plant(), estimator_parameters(), DT_NS)
    assert update_inertial(deaf, history, felt_at(at_ns, 0.1)) is history
    belief = predict_belief(
        deaf, absorb_samples(deaf, begin_history(deaf, START_NS, START_NS), START_NS, [sample(START_NS)])[0], START_NS
    )
    assert belief is not None
    with pytest.raises(ValueError, match="inertial"):
        update_with_inertial(deaf, belief, np.zeros(1), None)


def no_inputs() -> PendingInputs:
    return ()


def test_an_input_acts_when_its_dead_time_is_over_and_counts_ahead_before() -> None:
    kalman = make_kalman(small_plant(wind_std=WIND), estimator_parameters(), DT_NS)
    rng = np.random.default_rng(1)
    dead_ns, inputs = 130 * MS, rng.normal(size=12)
    history, pending_inputs = begin_history(kalman, START_NS, START_NS), no_inputs()
    for tick, u in enumerate(inputs):
        at_ns = START_NS + tick * TICK_NS
        history, pending_inputs = apply_due_inputs(history, pending_inputs, at_ns)
        history, _, _ = absorb_samples(kalman, history, at_ns, [sample(START_NS)] if tick == 0 else [])
        ahead = predict_ahead(kalman, history, pending_inputs, predict_belief(kalman, history, at_ns), dead_ns)
        mean, cuts = np.zeros(3), [START_NS, *(START_NS + n * TICK_NS + dead_ns for n in range(tick)), at_ns + dead_ns]
        for n, (earlier, later) in enumerate(itertools.pairwise(cuts)):
            moved = expm(drag_lag_generator(DRAG, LAG) * (later - earlier) * 1e-9)
            mean = moved[:3, :3] @ mean + moved[:3, 4] * (inputs[n - 1] if n else 0.0)
        assert ahead is not None and ahead.at_ns == at_ns + dead_ns
        np.testing.assert_allclose(ahead.mean[:3], mean, rtol=0, atol=1e-11)
        pending_inputs = (*pending_inputs, (at_ns + dead_ns, np.array([u])))
    missed = predict_belief(kalman, history, at_ns - 3 * TICK_NS)  # at a boundary that was missed
    past = predict_ahead(kalman, history, pending_inputs, missed, dead_ns)
    then = predict_belief(kalman, history, at_ns - 20 * MS)
    assert past is not None and then is not None
    np.testing.assert_allclose(past.mean, then.mean, rtol=0, atol=1e-12)


# The tick


def controller_that_feels(dead_ns: int = 0, **changes: float) -> Controller:
    plant = small_plant()
    parameters = estimator_parameters(**{**INERTIAL, **changes})
    controller = make_controller(StubSolver(plant, HORIZON))
    return replace(controller, estimator=parameters, late_steps=HORIZON, dead_ns=dead_ns)


def ticks_of(controller: Controller, samples: list[PositionSample], *, feels: bool, count: int) -> list[TickOutput]:
    state, out = make_initial_state(), []
    for tick in range(count):
        at_ns = START_NS + tick * TICK_NS
        due = tuple(one for one in samples if at_ns - TICK_NS < one.received_ns <= at_ns)
        inertial = felt_at(at_ns - TICK_NS // 2, 0.001 * (tick % 7)) if feels else ()
        given = StepInput(tick=tick, at_ns=at_ns, samples=due, vehicle=vehicle(), inertial=inertial)
        state, told = run_tick(state, given, controller)
        out.append(told)
    return out


def boundaries(told: list[TickOutput]) -> list[Decision]:
    return [one.decision for one in told if one.decision.boundary]


def test_inertial_data_are_news_between_positions_and_the_age_goes_on() -> None:
    samples = make_step_samples(lost=(3, 4, 6, 7), steps=10)
    felt_ones = boundaries(ticks_of(controller_that_feels(), samples, feels=True, count=10 * TICKS))
    unfelt = boundaries(ticks_of(controller_that_feels(), samples, feels=False, count=10 * TICKS))
    assert [one.age_steps for one in felt_ones] == [one.age_steps for one in unfelt]
    assert [one.news for one in felt_ones] == [one.news for one in unfelt]
    silent = [one for one in unfelt if one.age_steps]
    assert len(silent) == 4 and all(one.plan_index for one in silent)
    assert all(one.plan_index == 0 for one in felt_ones if one.plan_seq is not None)


def test_a_solver_that_does_not_count_the_age_gets_no_plan_without_a_position() -> None:
    samples = make_step_samples(lost=(3, 4), steps=6)
    controller = replace(controller_that_feels(), late_steps=0)
    for one in boundaries(ticks_of(controller, samples, feels=True, count=6 * TICKS)):
        assert one.plan_index in (None, one.age_steps)


def test_a_plan_begins_where_its_first_input_acts() -> None:
    dead_ns = 80 * MS
    controller = controller_that_feels(dead_ns, bias_drift=0.0, bias_max=0.0)
    told = ticks_of(controller, make_step_samples(steps=6), feels=True, count=6 * TICKS)
    plans = [one.plan for one in told if one.plan is not None]
    assert [plan.seq for plan in plans] == list(range(6))
    for plan in plans:
        assert plan.base_ns == START_NS + plan.seq * DT_NS + dead_ns
        np.testing.assert_array_equal(plan.inputs, stub_inputs(plan.seq, HORIZON, 1))
    sent: Vec3 = (0.0, 0.0, 0.0)
    for tick, one in enumerate(told):
        if one.setpoint is not None:
            sent = one.setpoint.accel_mps2
        seq = one.decision.plan_seq
        if seq is not None:
            assert sent[0] == stub_inputs(seq, HORIZON, 1)[tick // TICKS - seq, 0]


# Without positions


def drifting(*, feels: bool, push_mps2: float = 0.2, seconds: float = 8.0) -> tuple[float, list[Decision]]:
    """How far a force carries the vehicle that held still when positions ended [m], and what was decided."""
    controller = controller_that_feels(bias_max=1.0)
    plant, state, at_rest = small_plant(), make_initial_state(), np.zeros(3)
    a, b, _ = plant.transition(TICK_NS * 1e-9)
    x, furthest, decided = at_rest, 0.0, []
    silent = 5 * TICKS
    for tick in range(silent + round(seconds * 1e9) // TICK_NS):
        at_ns = START_NS + tick * TICK_NS
        samples = (sample(at_ns, position_m=(0.0, 0.0, 0.0)),) if tick < silent else ()
        # The velocity's own slope is what the vehicle feels; the force acts through no lag.
        push = push_mps2 if tick >= silent else 0.0
        slope = float(x[2] - DRAG * x[1] + push)
        inertial = felt_at(at_ns - MS, slope) if feels else ()
        given = StepInput(tick=tick, at_ns=at_ns, samples=samples, vehicle=vehicle(), inertial=inertial)
        state, told = run_tick(state, given, controller)
        decided.append(told.decision)
        u = 0.0 if told.setpoint is None or tick < silent else told.setpoint.accel_mps2[0]
        h = TICK_NS * 1e-9
        x = a @ x + b @ np.array([u]) + np.array([0.5 * h * h, h, 0.0]) * push
        if told.setpoint is not None:  # until it lands
            furthest = max(furthest, abs(float(x[0])))
    return furthest, decided


def test_a_fallback_holds_by_inertial_data_against_a_force_that_it_would_not_know_of() -> None:
    carried_m, blindly = drifting(feels=False)
    held_m, felt_ones = drifting(feels=True)
    assert held_m < 0.5 * carried_m  # it leans against the force, and goes where leaning and force are equal
    # With them it is not blind: it holds for as long as it may, and then it lands all the same.
    for decided in (blindly, felt_ones):
        assert decided[-1].mode in ("land", "stopped")
    landed = [next(i for i, one in enumerate(d) if one.mode == "land") for d in (blindly, felt_ones)]
    assert landed[0] <= landed[1]


def swing(late_s: float) -> list[TickOutput]:
    """Ticks of a vehicle that swings; its positions, which are just back, are so late from 2 s on, two sources not."""
    envelope = replace(PARAMETERS, axes=(True, False, False), unexplained_mps2=1e3)
    controller = replace(controller_that_feels(bias_max=3.0, bias_drift=3.0), envelope=envelope)
    # a = A cos(ω t), v = A/ω sin(ω t), p = A/ω² (1 - cos(ω t))
    omega, accel_mps2 = 2.0, 2.0
    state, outputs = make_initial_state(), []
    for tick in range(3 * 20):
        at_ns, s = START_NS + tick * TICK_NS, tick * TICK_NS * 1e-9
        shown_s = s - (late_s if s >= 2.0 else 0.0)
        north_m = accel_mps2 / omega**2 * (1.0 - math.cos(omega * shown_s))
        given = StepInput(
            tick=tick,
            at_ns=at_ns,
            samples=(sample(at_ns, position_m=(north_m, 0.0, 0.0)),),
            vehicle=vehicle(),
            motion=motion((accel_mps2 / omega * math.sin(omega * s), 0.0, 0.0), at_ns),
            inertial=felt_at(at_ns - MS, accel_mps2 * math.cos(omega * s)),
        )
        state, one = run_tick(state, given, controller)
        if not tick:
            engaged = state.monitors.engaged
            engaged = msgspec.structs.replace(engaged, motion=msgspec.structs.replace(engaged.motion, resumed_ns=at_ns))
            state = msgspec.structs.replace(state, monitors=msgspec.structs.replace(state.monitors, engaged=engaged))
        outputs.append(one)
    return outputs


@pytest.mark.fault(94)
def test_positions_are_wrong_where_inertial_data_and_the_vehicle_s_own_velocity_change_alike() -> None:
    braked = {}
    for late_s in (0.0, 0.3):
        outputs = swing(late_s)
        braked[late_s] = [0.05 * tick for tick, one in enumerate(outputs) if one.decision.mode == "brake"]
        assert not any(event.code == EventCode.INERTIAL_DOUBTED for one in outputs for event in one.events)
    assert not braked[0.0]
    assert 2.0 < min(braked[0.3]) < 2.5


@pytest.mark.fault(94)
def test_nothing_leads_back_while_positions_that_came_back_are_compared() -> None:
    envelope = replace(PARAMETERS, axes=(True, False, False), unexplained_mps2=1e3)
    controller = replace(controller_that_feels(), envelope=envelope)
    state, held_mps2 = make_initial_state(), []
    for tick in range(5 * 20):
        at_ns, s = START_NS + tick * TICK_NS, tick * TICK_NS * 1e-9
        noise, is_back = 0.001 * (tick % 7), s > 4.0
        given = StepInput(
            tick=tick,
            at_ns=at_ns,
            samples=() if 1.0 < s <= 4.0 else (sample(at_ns, position_m=(noise + 0.4 * is_back, 0.0, 0.0)),),
            vehicle=vehicle(),
            motion=motion((noise, 0.0, 0.0), at_ns),
            inertial=felt_at(at_ns - MS, noise),
        )
        state, one = run_tick(state, given, controller)
        if one.decision.mode == "hold" and one.setpoint is not None and s > 4.5:
            held_mps2.append(abs(one.setpoint.accel_mps2[0]))
    # The way back would ask for 0.4 m/s² more than the estimated bias, which is flown against.
    assert len(held_mps2) > 5 and max(held_mps2) < 0.4


def blow(*, moves: bool = True, has_velocity: bool = True, left_m: float = 9.0) -> list[TickOutput]:
    """Ticks of a vehicle on which a wind of 1 m/s² sets in after 2 s, or whose inertial data say so, and positions end.

    Args:
        moves: Whether the vehicle moves as its inertial data say.
        has_velocity: Whether the vehicle sends its own velocity.
        left_m: Way to a limit in the direction of the wind.
    """
    envelope = replace(PARAMETERS, axes=(True, False, False), unexplained_mps2=1e3, upper_m=(left_m, 9.0, 9.0))
    controller = replace(controller_that_feels(), envelope=envelope)
    state, outputs = make_initial_state(), []
    for tick in range(3 * 20):
        at_ns, s = START_NS + tick * TICK_NS, tick * TICK_NS * 1e-9
        blown_s = max(s - 2.0, 0.0)
        accel_mps2 = 1.0 if blown_s > 0.0 else 0.001 * (tick % 7)
        blown_s = blown_s if moves else 0.0
        speed_mps, north_m = blown_s + 0.001 * (tick % 7), 0.5 * blown_s**2
        is_dark = 2.0 < s <= 2.6
        given = StepInput(
            tick=tick,
            at_ns=at_ns,
            samples=() if is_dark else (sample(at_ns, position_m=(north_m, 0.0, 0.0)),),
            vehicle=vehicle(),
            motion=motion((speed_mps, 0.0, 0.0), at_ns) if has_velocity else None,
            inertial=felt_at(at_ns - MS, accel_mps2),
        )
        state, one = run_tick(state, given, controller)
        outputs.append(one)
    return outputs


@pytest.mark.fault(71)
def test_a_wind_is_no_reason_to_brake_in_a_silence_where_the_vehicle_s_own_velocity_shows_it_too() -> None:
    outputs = blow()
    assert any(event.code == EventCode.INERTIAL_DOUBTED for one in outputs for event in one.events)
    assert all(one.decision.mode == "track" for one in outputs[2:])


@pytest.mark.fault(59)
@pytest.mark.parametrize(
    ("moves", "has_velocity", "left_m"), [(False, True, 9.0), (True, False, 9.0), (True, True, 0.6)]
)
def test_it_brakes_where_that_may_be_a_lie_or_a_wrong_response_before_a_limit(
    moves: bool, has_velocity: bool, left_m: float
) -> None:
    outputs = blow(moves=moves, has_velocity=has_velocity, left_m=left_m)
    assert any(one.decision.mode == "brake" for one in outputs)


def test_a_fallback_that_ends_holds_by_nothing() -> None:
    controller = controller_that_feels()
    kalman, plant = controller.kalman, controller.plant
    history, _, _ = absorb_samples(kalman, begin_history(kalman, START_NS, START_NS), START_NS, [sample(START_NS)])
    history = update_inertial(kalman, history, felt_at(START_NS + MS, 0.3))
    given = StepInput(tick=1, at_ns=START_NS + TICK_NS, vehicle=vehicle())
    view = view_filter(history, locate_on_grid(ControlState(), given, controller, is_climbing_or_landing=False))
    ended, origin = Fallback(ControlMode.HOLD, START_NS, FallbackReason.ENVELOPE), (0.0, 0.0, 0.0)
    assert view.estimate is not None and not carries_estimate(ended, view.belief)
    assert find_return_accel(ended, origin, view, plant) == (0.0, 0.0, 0.0)
    recover, point = Fallback(ControlMode.HOLD, START_NS), (1.0, 0.0, 0.0)
    assert find_return_accel(recover, point, view, plant)[0] > 0.5
    outputs = update_inertial(
        kalman, history, felt_at(START_NS + TICK_NS, 50.0)
    )  # cannot be, and so carries nothing on
    lied = msgspec.structs.replace(view, belief=predict_belief(kalman, outputs, START_NS + 300 * MS))
    assert find_return_accel(recover, point, lied, plant) == (0.0, 0.0, 0.0)
    later = msgspec.structs.replace(view, belief=predict_belief(kalman, history, START_NS + 300 * MS))
    assert find_return_accel(recover, point, later, plant) == (0.0, 0.0, 0.0)  # the data are too old


def test_a_bias_drifts_slowly_while_no_inertial_data_are_used() -> None:
    """A tenth as fast as configured: before the first of them, a second after the last, and in doubt."""
    config = load_config("room")
    believed, dt_ns = build_estimator(config), round(config.plant.dt_s * 1e9)
    kalman = make_kalman(build_plant(config), believed, dt_ns)
    first = make_first_belief(kalman, sample(0))
    step = believed.bias_drift**2 * config.plant.dt_s
    quiet, seconds = DRIFT_WITHOUT_INERTIAL**2 * step, INERTIAL_LASTS_NS // dt_ns

    def gained(steps: int, **known: int) -> float:
        """By the variance of a bias in whole steps; the first of them has no drift of its own yet."""
        belief = msgspec.structs.replace(first, inertial=InertialTrust(**known))
        after = predict(kalman, 0, belief, np.zeros(kalman.n_u), steps * dt_ns)
        return float(after.cov[kalman.bias.start, kalman.bias.start] - (0.25 * believed.bias_max) ** 2)

    assert gained(11) == pytest.approx(11 * quiet)
    assert gained(11, used_ns=0) == pytest.approx(quiet + 10 * step)
    assert gained(11, used_ns=0, distrusted_ns=0) == pytest.approx(11 * quiet)
    assert gained(3 * seconds, used_ns=0) == pytest.approx(quiet + seconds * step + (2 * seconds - 1) * quiet)
