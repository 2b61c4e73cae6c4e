"""Composition: a configuration's numbers become plant, design, solver and controller; and its provenance."""

from __future__ import annotations

import math
import platform
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from uavctl import __version__
from uavctl.arithmetic import ARITHMETIC
from uavctl.build.link import build_ages, build_delayed_link, late_steps, promised
from uavctl.build.mission import build_mission, build_names, build_rests
from uavctl.build.outside import controller_id, decider_id, flown_outside
from uavctl.build.rest import check_axes, resting_target
from uavctl.config.checks import get_position_limits_m
from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.flight.controller import Controller
from uavctl.flight.fallback import FallbackParameters
from uavctl.flight.kalman import EstimatorParameters, make_kalman, settle_covariance
from uavctl.flight.limits import LimitsParameters
from uavctl.flight.link_estimate import LinkEstimateParameters
from uavctl.flight.monitors.observation import EnvelopeParameters
from uavctl.flight.monitors.outliers import GateParameters
from uavctl.records import Vec3
from uavctl.smpc.answer import Solver
from uavctl.smpc.conditioned.planner import (
    AnyDesign,
    ConditionedDesign,
    ConditionedSolver,
    conditioned_id,
    conditioned_record,
)
from uavctl.smpc.estimate import InnovationForm, add_bias, innovation_form
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import AXES, Plant, VelocityReferenceAxis, drag_lag, velocity_reference
from uavctl.smpc.sets import Polytope

# The paper's scheme is loaded only where it is flown: loading it takes a tenth of the time of all else.
if TYPE_CHECKING:
    from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec

NANOSECONDS = 1e9

Value = TypeVar("Value")

# Where `[envelope]` says nothing; the figures of false alarms are in docs/soak.md.
AT_REST_MPS = 0.1  # noise of a vehicle's own velocity at rest, and a little
LEAST_OUTSIDE_M = 0.5
LEAST_UNEXPLAINED_MPS2, ENVELOPE_SIGMA = 1.5, 6.0
DISAGREES_S = 0.17
LEAST_WINDOW_S = 1.2


def build_plant(config: Config) -> Plant:
    """The plant (1).

    Raises:
        DesignError: The matrices are no sampled continuous plant.
    """
    plant = config.plant
    if plant.model == "drag-lag":
        return drag_lag(plant.drag_1ps, plant.lag_s, plant.gain, plant.wind_std_mps2, plant.dt_s, plant.axes)
    if plant.model == "velocity-reference":
        numbers = (getattr(plant, key) for key in VelocityReferenceAxis._fields)
        return velocity_reference(
            [VelocityReferenceAxis(*one) for one in zip(*numbers, strict=True)], plant.dt_s, plant.axes
        )
    a, b, e, w, accel = (
        np.array(rows, dtype=np.float64) for rows in (plant.a, plant.b, plant.e, plant.w, plant.accel_per_input)
    )
    if not plant.axes:
        accel = np.zeros((0, b.shape[1]))
    return Plant(
        a=a,
        b=b,
        e=e,
        w=w,
        dt_s=plant.dt_s,
        axes=plant.axes,
        position_index=plant.position_index,
        velocity_index=plant.velocity_index,
        accel_per_input=accel,
    )


def start_state(config: Config, plant: Plant) -> NDArray[np.float64]:
    """State (n_x,) in which the simulator starts."""
    if not plant.axes:
        return resting_target(config, plant)[0]
    state = plant.equilibrium(config.sim.start_position_m)
    for axis, index in zip(plant.axes, plant.velocity_index, strict=True):
        state[index] = config.sim.start_velocity_mps[AXES.index(axis)]
    return state


def build_spec(config: Config) -> DesignSpec:
    """Return the specification that the configuration gives for a design.

    Raises:
        DesignError: A key of scheme `hahn-stursberg` is missing; see also `build_plant` and `build_delayed_link`.
    """
    from uavctl.smpc.hahn_stursberg.design import DesignSpec

    smpc, schedule, sets = config.smpc, config.schedule, config.sets
    tau, plant = needed(smpc.tau, "smpc.tau"), build_plant(config)
    # Assumption 4.1 covers ages up to τ: one more, for the rarer gaps and for those that came before.
    form = None if config.risk.estimate == "exact" else _innovations(config, plant, tau + 1)
    return DesignSpec(
        plant=plant if form is None else form.plant,
        state_set=Polytope.from_box(sets.state_lower, sets.state_upper),
        input_set=_planned_inputs(config),
        q_x=np.diag(config.cost.state),
        q_u=np.diag(config.cost.input),
        horizon=smpc.horizon,
        tau=tau,
        delta_x=smpc.delta_x,
        delta_u=needed(smpc.delta_u, "smpc.delta_u"),
        delta_tau=needed(smpc.delta_tau, "smpc.delta_tau"),
        k_tau=np.array(needed(smpc.k_tau, "smpc.k_tau"), dtype=np.float64),
        link=build_delayed_link(config),
        target_m=config.target.position_m,
        rule=schedule.rule,
        delays=schedule.delays,
        gamma_max=schedule.gamma_max,
        search_states=np.array(schedule.search_states, dtype=np.float64),
        allocation=config.risk.allocation,
        slack_linear=smpc.slack_linear,
        slack_quadratic=smpc.slack_quadratic,
        offset_weight=needed(smpc.offset_weight, "smpc.offset_weight"),
        terminal_weight=smpc.terminal_weight,
        max_iterations=config.solver.max_iterations,
        joint=schedule.joint,
        estimate_cov=None if form is None else form.estimate_cov,
    )


def needed(value: Value | None, key: str) -> Value:
    """The value of a key that scheme `age-conditioned` does without.

    Raises:
        DesignError: It is not there.
    """
    if value is None:
        raise DesignError(key, "is missing, and what is asked for needs it", "add it, as the presets have it")
    return value


def build_problem(config: Config) -> ControlProblem:
    """The control problem of a configuration, without a scheme.

    Raises:
        DesignError: The plant is none, or cannot rest at the target.
    """
    plant, sets = build_plant(config), config.sets
    q_x, q_u = np.diag(config.cost.state), np.diag(config.cost.input)
    target, u_target = resting_target(config, plant)
    return ControlProblem(
        plant=plant,
        state_set=Polytope.from_box(sets.state_lower, sets.state_upper),
        input_set=Polytope.from_box(sets.input_lower, sets.input_upper),
        q_x=q_x,
        q_u=q_u,
        target=target,
        u_target=u_target,
        horizon=config.smpc.horizon,
        slack_linear=config.smpc.slack_linear,
        slack_quadratic=config.smpc.slack_quadratic,
    )


def build_conditioned(
    config: Config, *, flown: bool = True, cov: NDArray[np.float64] | None = None
) -> ConditionedDesign:
    """Return the design that flights of the scheme with risk conditioned on the age are planned with.

    Args:
        flown: Whether the flight's own filter estimates, biases included, and the last gate limits how fast what is
            planned may change; in a campaign neither is there.
        cov: Covariance (n_x, n_x) of the estimate's error after a position, where none is lost, if it is not flown;
            None: what the configuration says of it.

    Raises:
        DesignError: See `build_problem`, `build_ages`, `ConditionedSolver` and `innovation_form`.
    """
    problem = replace(build_problem(config), input_set=_planned_inputs(config))
    flown = flown and bool(config.plant.axes)
    link, allowed = build_ages(config), 1.0 - config.smpc.delta_x
    slew_mps3 = config.limits.slew_mps3 if flown else math.inf
    plant, estimator, filter_plant = problem.plant, config.estimator, None
    if flown and estimator.bias_drift:
        filter_plant = add_bias(plant, estimator.bias_drift, force=estimator.inertial_std_mps2 > 0.0)
    if cov is None and flown:
        cov = _settled(config, plant)
    elif cov is None:
        exact = config.risk.estimate == "exact"
        cov = np.zeros((plant.n_x,) * 2) if exact else _innovations(config, plant, 0).estimate_cov
    solver = ConditionedSolver(problem, link, allowed, slew_mps3=slew_mps3, cov=cov, filter_plant=filter_plant)
    return ConditionedDesign(solver, cov, conditioned_id(problem, link, allowed, slew_mps3, cov, filter_plant))


def _planned_inputs(config: Config) -> Polytope:
    """U of the plans: what is flown against a bias of up to bias_max stays free, and both together keep the limits."""
    free = config.estimator.bias_max
    lower, upper = (np.array(side) for side in (config.sets.input_lower, config.sets.input_upper))
    return Polytope.from_box((lower + free).tolist(), (upper - free).tolist())


def _innovations(config: Config, plant: Plant, losses: int) -> InnovationForm:
    """The plant as the configured filter sees it, and what that does not know after so many losses in a row."""
    estimator = config.estimator
    age_s = _position_age_s(config)
    return innovation_form(plant, estimator.position_std_m, age_s, losses, estimator.bias_drift)


def _position_age_s(config: Config) -> float:
    """Age of a step's position at its end, up to a step [s]."""
    link, dt_s = config.link, config.plant.dt_s
    # It may be from the very beginning of the step, unless others follow it.
    since_s = 1.0 / config.source.rate_hz if config.source.rate_hz else dt_s
    return min(dt_s, since_s + link.delay_s + link.jitter_s)


def _settled(config: Config, plant: Plant) -> NDArray[np.float64]:
    """Return the filter's error covariance where a plan begins, with a position and inertial data in every step."""
    dt_ns = round(plant.dt_s * NANOSECONDS)
    kalman = make_kalman(plant, build_estimator(config), dt_ns)
    dead_ns = round(config.plant.dead_time_s * NANOSECONDS)
    return settle_covariance(kalman, dt_ns, round(_position_age_s(config) * NANOSECONDS), dead_ns)


def design_of(config: Config) -> AnyDesign:
    """Return the design that a flight is planned with, by `smpc.scheme`.

    Raises:
        DesignError: There is none, naming key, reason and what to do.
    """
    return build_conditioned(config) if config.is_age_conditioned else build_design(config)


def build_design(config: Config) -> Design:
    """The design of scheme `hahn-stursberg`, and those for late positions, checked against Assumption 4.

    Its schedule is checked for being fast enough too.

    Raises:
        DesignError: There is none, naming key, reason and what to do.
    """
    from uavctl.smpc.hahn_stursberg.design import make_design
    from uavctl.smpc.hahn_stursberg.exact import check_schedule, optimal_cost
    from uavctl.smpc.hahn_stursberg.late import add_late_designs

    spec = build_spec(config)
    design = make_design(spec, optimal_cost)
    check_schedule(design)
    return add_late_designs(design, spec, late_steps(config))


def build_solver(design: AnyDesign, config: Config) -> Solver:
    """The solver of a design: `smpc.controller`, that of scheme `age-conditioned`, or the one of `solver.method`.

    Args:
        config: The configuration that it is made from.

    Raises:
        DesignError: The design does not fit the solver.
    """
    if config.smpc.controller:
        return flown_outside(config, build_problem(config))
    if isinstance(design, ConditionedDesign):
        return design.solver
    if config.solver.method == "exact":
        from uavctl.smpc.hahn_stursberg.frozen import ShortcutSolver

        return ShortcutSolver(design)
    if design.late or design.estimate_cov.any():
        raise DesignError(
            "solver.method",
            "the printed problem knows neither late positions nor an estimate with an error",
            "take `exact`; or risk.estimate = `exact`, schedule.late = 0 and delays below the step",
        )
    from uavctl.smpc.hahn_stursberg.printed import (
        PrintedSolver,  # CVXPY takes long to load, and nothing else here needs it
    )

    return PrintedSolver(design)


def resting(design: AnyDesign) -> NDArray[np.float64]:
    """Right sides (m_x,) of the state rows, less what a plan of the scheme keeps from them that rests."""
    return design.rest_limits if isinstance(design, ConditionedDesign) else build_rests(design)


def record_of(design: AnyDesign) -> dict[str, object]:
    """A design of either scheme as plain numbers."""
    if isinstance(design, ConditionedDesign):
        return conditioned_record(design)
    from uavctl.smpc.hahn_stursberg.design import design_record

    return design_record(design)


def _promised(config: Config) -> float:
    """The least probability of news in a step that plans count on."""
    return 1.0 - build_ages(config).outage(1) if config.is_age_conditioned else promised(build_delayed_link(config))


def build_estimator(config: Config) -> EstimatorParameters:
    """Return the parameters of the estimator."""
    estimator = config.estimator
    return EstimatorParameters(
        position_std_m=estimator.position_std_m,
        velocity_std_mps=estimator.velocity_std_mps,
        initial_std=estimator.initial_std,
        window_s=estimator.window_s,
        max_position_m=estimator.max_position_m,
        max_velocity_mps=estimator.max_velocity_mps,
        bias_drift=estimator.bias_drift,
        bias_max=estimator.bias_max,
        bias_bounds=_bias_bounds(config),
        inertial_std_mps2=estimator.inertial_std_mps2,
        inertial_bias_mps2=estimator.inertial_bias_mps2,
        inertial_bias_s=estimator.inertial_bias_s,
    )


def _bias_bounds(config: Config) -> tuple[float, ...]:
    """Return how much of each input may be spent against a bias: a share of its authority, at least `bias_max`."""
    sets, estimator = config.sets, config.estimator
    half = [0.5 * (high - low) for low, high in zip(sets.input_lower, sets.input_upper, strict=True)]
    return tuple(max(estimator.bias_max, estimator.bias_share * each) for each in half)


def build_envelope(config: Config, plant: Plant) -> EnvelopeParameters:
    """Return the bounds of what is possible in flight, by the limits, the plant and the last gate."""
    envelope, limits, walls = config.envelope, config.limits, get_position_limits_m(config)
    lower, upper = map(list, zip(*(walls.get(axis, (-math.inf, math.inf)) for axis in AXES), strict=True))
    room = [high - low for low, high in zip(lower, upper, strict=True)]
    outside = [envelope.outside_m or max(0.1 * size if math.isfinite(size) else 0.0, LEAST_OUTSIDE_M) for size in room]
    # What one step's disturbance does to a velocity, as an acceleration over the step.
    spread = plant.e[list(plant.velocity_index)] @ plant.w @ plant.e[list(plant.velocity_index)].T
    std_mps2 = float(np.sqrt(np.diagonal(spread).max())) / plant.dt_s
    unexplained = envelope.unexplained_mps2 or max(ENVELOPE_SIGMA * std_mps2, LEAST_UNEXPLAINED_MPS2)
    lags: dict[str, float] = {}
    if config.plant.lag_s:
        dead_s = config.plant.dead_time_s
        lags.update((axis, dead_s + lag_s) for axis, lag_s in zip(plant.axes, config.plant.lag_s, strict=True))
    return EnvelopeParameters(
        axes=tuple(axis in plant.axes for axis in AXES),
        lower_m=_vec3(lower),
        upper_m=_vec3(upper),
        outside_m=_vec3(outside),
        brake_mps2=limits.accel_mps2,
        lag_s=_vec3([lags.get(axis, 0.0) for axis in AXES]),
        unexplained_mps2=unexplained,
        disagreement_mps=envelope.disagreement_mps or DISAGREES_S * unexplained,
        window_ns=round(max(LEAST_WINDOW_S, 4.0 * plant.dt_s) * NANOSECONDS),
        begins_mps=config.estimator.initial_std,
    )


def _has_own_velocity(config: Config) -> bool:
    """Whether the vehicle's velocity is another witness than our positions, as far as we know."""
    return not config.relay.enabled and "LOCAL_POSITION_NED" not in config.source.messages


def _vec3(values: list[float]) -> Vec3:
    north, east, down = values
    return north, east, down


def build_controller(config: Config, design: AnyDesign | None = None) -> Controller:
    """Everything constant that a control tick needs; the design is made if it is not given.

    Raises:
        DesignError: There is no design.
    """
    check_axes(config)
    design = design_of(config) if design is None else design
    estimator, fallback, limits = config.estimator, config.fallback, config.limits
    plant, outside = build_plant(config), config.smpc.controller
    return Controller(
        plant=plant,  # the design's own may be the one that the estimator makes of it
        design_id=design.design_id,
        horizon=design.horizon,
        solver=build_solver(design, config),
        mission=build_mission(config, design, resting(design)),
        names=build_names(design),
        link=LinkEstimateParameters(promised=_promised(config)),
        outside=outside,
        late_steps=design.horizon if outside or isinstance(design, ConditionedDesign) else len(design.late),
        envelope=build_envelope(config, plant),
        estimator=build_estimator(config),
        inputs=(np.array(config.sets.input_lower), np.array(config.sets.input_upper)),
        fallback=FallbackParameters(
            brake_gain_1ps=fallback.brake_gain_1ps,
            brake_s=fallback.brake_s,
            hold_s=fallback.hold_s,
            blind_hold_s=fallback.blind_hold_s,
            land=fallback.land,
            recover_samples=fallback.recover_samples,
        ),
        limits=LimitsParameters(accel_mps2=limits.accel_mps2, slew_mps3=limits.slew_mps3),
        position_gate=GateParameters(
            sigma=estimator.gate_sigma,
            margin_m=estimator.gate_m,
            jump_ns=round(fallback.jump_s * NANOSECONDS),
            at_rest_mps=AT_REST_MPS if _has_own_velocity(config) else 0.0,
        ),
        dt_ns=round(config.plant.dt_s * NANOSECONDS),
        tick_ns=round(config.daemon.tick_s * NANOSECONDS),
        dead_ns=round(config.plant.dead_time_s * NANOSECONDS),
    )


@dataclass(frozen=True, eq=False)
class Prepared:
    """Controller that is ready to fly, and what it is made from."""

    config: Config  # the configuration
    design: AnyDesign  # its design
    controller: Controller  # the controller


def prepare(config: Config, design: AnyDesign) -> Prepared:
    """Make the controller of a design.

    Raises:
        DesignError: The configuration asks for what the design cannot do.
    """
    return Prepared(config, design, build_controller(config, design))


# What decides a flight's last bits beside its configuration: code, libraries, arithmetic.

CONTROLLER = "controller"  # under which the one of another package stands among the versions
ARITHMETIC_NAME = "arithmetic"
_LIBRARIES = ("numpy", "scipy", "clarabel", "daqp", "pymavlink", "msgspec", "mcap")


def versions(controller: str) -> dict[str, str]:
    """Return the versions of code and libraries that decisions depend on; `controller`: one of another package."""
    found = {name: metadata.version(name) for name in _LIBRARIES}
    if controller:
        found[CONTROLLER] = controller_id(controller)
    own = {"uavctl": __version__, "code": decider_id(), "python": platform.python_version()}
    return {**own, ARITHMETIC_NAME: ARITHMETIC, **found}


def cpu() -> str:
    """Return the CPU type: without portable arithmetic the last bits of decisions depend on it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
