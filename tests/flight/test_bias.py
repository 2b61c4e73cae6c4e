"""An acceleration that stays and that nobody knows of: found by the filter, flown against by plans and fallback."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from envelope_rig import PARAMETERS
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
    make_inputs,
    make_motion_samples,
    run,
    sample,
    small_plant,
    stub_inputs,
    vehicle,
)
from msgspec import structs
from scipy.linalg import expm

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.errors import ConfigError
from uavctl.event_codes import EventCode
from uavctl.flight.controller import Controller
from uavctl.flight.estimator import absorb_samples, begin_history, estimate_at, note_input
from uavctl.flight.kalman import make_kalman
from uavctl.flight.tick import make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.records import ControlMode, PositionSample, StepInput, VehicleMotion
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.smpc.estimate import add_bias, innovation_form
from uavctl.wiring.controller import build_controller, build_design, build_spec

DRIFT, MOST = 0.03, 0.4


def test_the_larger_plant_is_the_matrix_exponential_of_input_and_bias_together() -> None:
    """(p, v, a, w, u, d, n): d acts beside u, and n carries it on a line through the step."""
    small = drag_lag_generator(0.3, 0.25)
    g = np.zeros((7, 7))
    g[:5, :5] = small
    g[:, 5] = g[:, 4]
    g[5, 6] = 1.0 / 0.2
    want = expm(0.2 * g)
    plant = add_bias(small_plant(), DRIFT)
    kept = [0, 1, 2, 5]
    np.testing.assert_allclose(plant.a, want[np.ix_(kept, kept)], atol=1e-12)
    np.testing.assert_allclose(plant.b[:, 0], want[kept, 4], atol=1e-12)
    np.testing.assert_allclose(plant.e, want[np.ix_(kept, [3, 6])], atol=1e-12)
    assert plant.w[1, 1] == pytest.approx(DRIFT**2 * 0.2)
    part = expm(0.07 * g)
    np.testing.assert_allclose(plant.transition(0.07)[0], part[np.ix_(kept, kept)], atol=1e-12)


def pushed(bias: float, steps: int) -> Array:
    """Positions at boundaries of the small plant at rest that nothing but a bias moves."""
    plant, x, places = small_plant(), np.zeros(3), []
    for _ in range(steps):
        places.append(x[0])
        x = plant.a @ x + plant.b[:, 0] * bias
    return np.array(places)


def found(bias: float, *, others_until: int = 0, order: int = 1, **changes: float) -> tuple[float, ...]:
    """The bias that the filter has found after 60 s; others fly up to a step, and samples come in either order."""
    kalman = make_kalman(small_plant(), estimator_parameters(bias_drift=DRIFT, bias_max=MOST, **changes), DT_NS)
    history = begin_history(kalman, START_NS, START_NS)
    places = pushed(bias, 300)
    for k in range(0, 300, 2):
        pair = [sample(START_NS + i * DT_NS, position_m=(float(places[i]), 0.0, 0.0)) for i in (k, k + 1)]
        history, _, _ = absorb_samples(kalman, history, START_NS + (k + 1) * DT_NS, pair[::order])
        history = note_input(history, START_NS + (k + 1) * DT_NS, None if k < others_until else np.zeros(1))
    now = estimate_at(kalman, history, START_NS + 299 * DT_NS)
    assert now is not None and len(now.mean) == 3
    return now.bias


def test_the_filter_finds_it_and_never_counts_on_more_than_allowed() -> None:
    assert found(0.2)[0] == pytest.approx(0.2, abs=0.005)
    assert found(-0.2)[0] == pytest.approx(-0.2, abs=0.005)
    assert found(0.6)[0] == MOST
    assert found(0.2) == found(0.2, order=-1)  # the same bits in any order


def test_what_happens_while_others_fly_is_no_bias() -> None:
    assert abs(found(0.2, others_until=300)[0]) < 0.15  # at most what one step tells of it
    assert found(0.2, others_until=150)[0] == pytest.approx(0.2, abs=0.01)


def test_the_real_filter_settles_at_the_design_s_covariance() -> None:
    plant, parameters = small_plant(), estimator_parameters(bias_drift=DRIFT, bias_max=MOST)
    kalman = make_kalman(plant, parameters, DT_NS)
    history = note_input(begin_history(kalman, START_NS, START_NS), START_NS, np.zeros(1))
    for k in range(1, 400):
        at_ns = START_NS + k * DT_NS
        history, _, _ = absorb_samples(kalman, history, at_ns, [sample(at_ns - 150 * MS, at_ns)])
    now = estimate_at(kalman, history, at_ns)
    assert now is not None
    form = innovation_form(plant, parameters.position_std_m, 0.15, 0, DRIFT)
    np.testing.assert_allclose(np.array(now.cov), form.estimate_cov, rtol=1e-6)
    assert form.plant.e.shape == (3, 1)
    without = innovation_form(plant, parameters.position_std_m, 0.15, 0)
    assert np.linalg.eigvalsh(form.estimate_cov - without.estimate_cov)[0] > -1e-12  # to find more takes more noise


class _Biased:
    """The small plant under a bias, sampled at each boundary, with the controller around it."""

    def __init__(self, controller: Controller, bias: Array, start: Array) -> None:
        self.controller, self.bias, self.x = controller, bias, start
        self.state = make_initial_state()
        self.places: list[Array] = []
        self.inputs: list[Array] = []
        self.events: list[str] = []
        self.flown = 0  # ticks

    def fly(self, steps: int) -> None:
        plant, ticks = self.controller.plant, self.controller.ticks_per_step
        a, b, _ = plant.transition(self.controller.tick_ns * 1e-9)
        for tick in range(self.flown, self.flown + steps * ticks):
            at_ns = START_NS + tick * self.controller.tick_ns
            samples: tuple[PositionSample, ...] = ()
            if tick % ticks == 0:
                # No camera tells the very same numbers twice: positions that stand still to the bit count as frozen.
                north, east, down = self.x[list(plant.position_index)] + 1e-6 * np.sin(tick + np.arange(3.0))
                samples = (sample(at_ns, position_m=(float(north), float(east), float(down))),)
                self.places.append(self.x[list(plant.position_index)])
            inp = StepInput(tick=tick, at_ns=at_ns, samples=samples, vehicle=vehicle())
            self.state, output = run_tick(self.state, inp, self.controller)
            self.events += [
                event.code for event in output.events if event.code in (EventCode.BIAS_AT_BOUND, EventCode.BIAS_FREE)
            ]
            u = np.zeros(plant.n_u) if output.setpoint is None else plant.to_input(output.setpoint.accel_mps2)
            self.inputs.append(u)
            self.x = a @ self.x + b @ (u + self.bias)
        self.flown += steps * ticks


@pytest.mark.long
@pytest.mark.parametrize("estimated", [True, False])
def test_a_steady_push_leaves_no_offset_from_the_target(estimated: bool) -> None:
    """Preset `room`, without noise; without the estimate the push shows, so the test could fail."""
    off = ["estimator.bias_drift=0.0", "estimator.bias_max=0.0"]
    config = load_config("room-hahn-stursberg", ["solver.method=exact", *([] if estimated else off)])
    controller = build_controller(config)
    target = np.array(config.target.position_m)
    world = _Biased(controller, np.array([0.2, -0.15, 0.15]), controller.plant.equilibrium(config.target.position_m))
    world.fly(60)
    away = np.abs(np.array(world.places[-20:]) - target).max(axis=0)
    assert np.all(away < 0.01) if estimated else np.all(away > 0.03)
    assert np.all(np.abs(world.inputs) <= np.array(config.sets.input_upper))


@pytest.mark.long
@pytest.mark.parametrize(("share", "most_m"), [(0.6, 0.02), (0.0, math.inf)])
def test_a_push_within_the_authority_is_flown_against_and_one_at_its_bound_is_told(share: float, most_m: float) -> None:
    """1 m/s of wind at PX4's own simulated vehicle pushes with 1 m/s², half of what may be sent."""
    config = load_config("room-hahn-stursberg", ["solver.method=exact", f"estimator.bias_share={share}"])
    controller = build_controller(config)
    bounds = controller.kalman.bias_bounds
    assert bounds == tuple(max(0.4, share * high) for high in config.sets.input_upper)
    start = controller.plant.equilibrium(config.target.position_m)
    world = _Biased(controller, np.array([1.0, 0.0, 0.0]), start)
    world.fly(75)
    away_m = abs(float(world.places[-1][0]) - config.target.position_m[0])
    told = share == 0.0
    assert (away_m > 0.05) == told and away_m < most_m
    assert world.events == [EventCode.BIAS_AT_BOUND] * told
    world.bias = np.zeros(3)
    world.fly(75)
    assert world.events == [EventCode.BIAS_AT_BOUND, EventCode.BIAS_FREE] * told


def test_plans_leave_room_for_it_and_what_is_flown_keeps_the_input_limits() -> None:
    config = load_config("room-hahn-stursberg")
    spec = build_spec(config)
    low, high = spec.input_set.bounds
    np.testing.assert_allclose(high, np.array(config.sets.input_upper) - config.estimator.bias_max)
    np.testing.assert_allclose(low, np.array(config.sets.input_lower) + config.estimator.bias_max)


def test_a_plan_is_shifted_by_it_and_says_so() -> None:
    controller = make_controller(bias_drift=0.3, bias_max=MOST)
    outputs = run(controller, make_inputs(range(8 * TICKS), make_motion_samples(7)))
    plans = [output.plan for output in outputs if output.plan is not None]
    assert any(abs(plan.bias[0]) > 1e-3 for plan in plans)
    for plan in plans:
        wanted = stub_inputs(plan.seq, HORIZON, 1)
        np.testing.assert_allclose(np.array(plan.inputs) + np.array(plan.bias), wanted, atol=1e-15)


class Steady(StubSolver):
    """Asks for the same all the time."""

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        answer = super().solve(seq, x, target, preview)
        return structs.replace(answer, inputs=np.full_like(answer.inputs, 0.2))


def test_the_fallback_brakes_and_holds_against_it() -> None:
    controller = make_controller(Steady(small_plant()), bias_drift=0.3, bias_max=MOST)
    outputs = run(
        controller, make_inputs(range(160), make_motion_samples(20))
    )  # 0.2 m/s² are asked for, and nothing comes of it
    seen = {ControlMode.BRAKE: 0, ControlMode.HOLD: 0}
    lately: list[float] = []  # of the last 3 s of positions: what has been there all the time
    for output in outputs:
        if output.decision.mode is ControlMode.TRACK and output.decision.boundary and output.estimate is not None:
            lately = [*lately, output.estimate.bias[0]][-16:] if output.decision.age_steps == 0 else lately
    assert min(lately) > 1e-3 or max(lately) < -1e-3
    bias = min(lately, key=abs)
    for output in outputs:
        mode = output.decision.mode
        if mode not in seen or output.setpoint is None or output.estimate is None:
            continue
        seen[mode] += 1
        brakes = mode is ControlMode.BRAKE and seen[mode] <= 40  # for 2 s
        want = (-1.5 * output.estimate.mean[1] if brakes else 0.0) - bias
        if not output.setpoint.limited:
            assert output.setpoint.accel_mps2[0] == pytest.approx(want, abs=1e-12)
    assert min(seen.values()) > 5


def test_without_it_nothing_is_estimated_shifted_or_left_free() -> None:
    controller = make_controller()
    outputs = run(controller, make_inputs(range(5 * TICKS), make_motion_samples(4)))
    assert all(output.estimate is None or output.estimate.bias == () for output in outputs)
    assert all(output.plan is None or output.plan.bias == () for output in outputs)
    config = load_config("paper")
    assert (config.estimator.bias_drift, config.estimator.bias_max) == (0.0, 0.0)
    assert build_controller(config, build_design(config)).kalman.n_bias == 0


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (("estimator.bias_max=0.0",), r"estimator\.bias_max: is 0, and the other one"),
        (("estimator.bias_drift=0.0",), r"estimator\.bias_drift: is 0, and the other one"),
        (("estimator.bias_max=1.5",), r"leaves nothing of input 2, -1\.5 to 1\.5"),
        (("estimator.bias_drift=-1.0",), r"bias_drift"),
    ],
)
def test_a_configuration_that_does_not_fit_is_refused(overrides: tuple[str, ...], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        load_config("room-hahn-stursberg", list(overrides))


def test_what_positions_that_are_taken_back_told_of_it_is_forgotten() -> None:
    """After 4 s positions go their own way, against the vehicle's word: it is let go, level, without what they told."""
    north = replace(PARAMETERS, axes=(True, False, False))
    controller = replace(make_controller(Steady(small_plant()), bias_drift=0.3, bias_max=MOST), envelope=north)
    state, lies = make_initial_state(), 20 * TICKS
    for n in range(2 * lies):
        at_ns = START_NS + n * TICK_NS
        place = 0.33 * max(n - lies, 0) * TICK_NS * 1e-9
        said = sample(at_ns, position_m=(place, 0.0, 0.0))
        own = VehicleMotion(velocity_mps=(0.0, 0.0, 0.0), velocity_ns=at_ns)
        before = state
        state, output = run_tick(
            state, StepInput(tick=n, at_ns=at_ns, samples=(said,), vehicle=vehicle(), motion=own), controller
        )
        if state.monitors.breach is not None:
            break
    assert state.monitors.breach is not None and n > lies + TICKS
    clean_ns = state.monitors.engaged.consistent_ns
    assert clean_ns is not None and lies * TICK_NS <= clean_ns - START_NS < n * TICK_NS
    assert any(at_ns > clean_ns for at_ns, _ in before.fallback.biases)
    assert state.fallback.biases == tuple(one for one in before.fallback.biases if one[0] <= clean_ns) != ()
    assert state.estimator.history is not None and state.estimator.history.captured_ns == clean_ns
    assert output.estimate is not None and output.estimate.captured_ns == clean_ns
    assert output.decision.mode is ControlMode.HOLD and output.setpoint is not None
    assert output.setpoint.accel_mps2 == (0.0, 0.0, 0.0)
