"""Composition of plant, design, solver and controller from a configuration, and the versions that made it."""

from __future__ import annotations

import math
import platform
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from uavctl import __version__
from uavctl.arithmetic import ARITHMETIC
from uavctl.arrays import SECOND_NS, Array
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
from uavctl.flight.risk_state import RiskParameters
from uavctl.flight.yaw import YawMode, YawParameters
from uavctl.records import Vec3
from uavctl.smpc.answer import Solver
from uavctl.smpc.conditioned.design import AnyDesign, ConditionedDesign, make_conditioned_id, make_conditioned_record
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.estimate import InnovationForm, add_bias, innovation_form
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import AXES, Plant, VelocityReferenceAxis, drag_lag, velocity_reference
from uavctl.smpc.sets import Polytope
from uavctl.wiring.cells import build_cell_rows
from uavctl.wiring.link import build_ages, build_delayed_link, compute_late_steps, compute_promised_probability
from uavctl.wiring.mission import build_mission, build_names, build_reference_limits
from uavctl.wiring.outside import build_outside_solver, compute_code_id, compute_controller_id
from uavctl.wiring.rest import build_state_bounds, build_weights, check_axes, compute_target_equilibrium

# The paper's scheme is loaded only if it flies: loading it takes a tenth of the time of all other imports.
if TYPE_CHECKING:
    from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec

Value = TypeVar("Value")

# Defaults of `[envelope]`; docs/soak.md has the figures of false alarms.
AT_REST_MPS = 0.1  # above the noise of a vehicle's velocity at rest
MIN_OUTSIDE_M = 0.5
MIN_UNEXPLAINED_MPS2, ENVELOPE_SIGMA = 1.5, 6.0
DISAGREEMENT_TIME_S = 0.17
MIN_WINDOW_S = 1.2


def build_plant(config: Config) -> Plant:
    """Build the plant (1).

    Raises:
        DesignError: The matrices are not those of a sampled continuous plant.
    """
    plant = config.plant
    if plant.model == "drag-lag":
        numbers = plant.drag_1ps, plant.lag_s, plant.gain, plant.wind_std_mps2
        return drag_lag(*numbers, plant.dt_s, plant.axes, plant.gust_mps2, plant.gust_s)
    if plant.model == "velocity-reference":
        columns = (getattr(plant, key) for key in VelocityReferenceAxis._fields)
        return velocity_reference(
            [VelocityReferenceAxis(*column) for column in zip(*columns, strict=True)], plant.dt_s, plant.axes
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


def make_start_state(config: Config, plant: Plant) -> Array:
    """Return the state (n_x,) in which the simulator starts."""
    if not plant.axes:
        return compute_target_equilibrium(config, plant)[0]
    state = plant.equilibrium(config.sim.start_position_m)
    for axis, index in zip(plant.axes, plant.velocity_index, strict=True):
        state[index] = config.sim.start_velocity_mps[AXES.index(axis)]
    return state


def build_spec(config: Config) -> DesignSpec:
    """Build the specification of a design.

    Raises:
        DesignError: A key of scheme `hahn-stursberg` is missing; see also `build_plant` and `build_delayed_link`.
    """
    from uavctl.smpc.hahn_stursberg.design import DesignSpec

    smpc, schedule, sets = config.smpc, config.schedule, config.sets
    tau, plant = require_value(smpc.tau, "smpc.tau"), build_plant(config)
    # Assumption 4.1 covers ages up to τ. One more loss covers the rarer gaps and earlier ones.
    form = None if config.risk.estimate == "exact" else _build_innovations(config, plant, tau + 1)
    return DesignSpec(
        plant=plant if form is None else form.plant,
        state_set=Polytope.from_box(sets.state_lower, sets.state_upper),
        input_set=_build_planned_inputs(config, plant),
        q_x=np.diag(config.cost.state),
        q_u=np.diag(config.cost.input),
        horizon=smpc.horizon,
        tau=tau,
        delta_x=smpc.delta_x,
        delta_u=require_value(smpc.delta_u, "smpc.delta_u"),
        delta_tau=require_value(smpc.delta_tau, "smpc.delta_tau"),
        k_tau=np.array(require_value(smpc.k_tau, "smpc.k_tau"), dtype=np.float64),
        link=build_delayed_link(config),
        target_m=config.target.position_m,
        rule=schedule.rule,
        delays=schedule.delays,
        gamma_max=schedule.gamma_max,
        search_states=np.array(schedule.search_states, dtype=np.float64),
        allocation=config.risk.allocation,
        slack_linear=smpc.slack_linear,
        slack_quadratic=smpc.slack_quadratic,
        offset_weight=require_value(smpc.offset_weight, "smpc.offset_weight"),
        terminal_weight=smpc.terminal_weight,
        max_iterations=config.solver.max_iterations,
        joint=schedule.joint,
        estimate_cov=None if form is None else form.estimate_cov,
    )


def require_value(value: Value | None, key: str) -> Value:
    """Return the value of a key that scheme `age-conditioned` does not need.

    Raises:
        DesignError: It is missing.
    """
    if value is None:
        raise DesignError(key, "is missing, and this request needs it", "add it, as the presets have it")
    return value


def build_problem(config: Config) -> ControlProblem:
    """Build the control problem of a configuration, without a scheme.

    Raises:
        DesignError: The plant is not valid, or cannot rest at the target.
    """
    plant = build_plant(config)
    q_x, q_u = build_weights(config.cost, plant)
    state_lower, state_upper = build_state_bounds(config.sets, plant)
    target, u_target = compute_target_equilibrium(config, plant)
    lower, upper = build_input_bounds(config, plant)
    return ControlProblem(
        plant=plant,
        state_set=Polytope.from_box(state_lower.tolist(), state_upper.tolist()),
        input_set=Polytope.from_box(lower.tolist(), upper.tolist()),
        q_x=q_x,
        q_u=q_u,
        target=target,
        u_target=u_target,
        horizon=config.smpc.horizon,
        slack_linear=config.smpc.slack_linear,
        slack_quadratic=config.smpc.slack_quadratic,
    )


def build_conditioned(config: Config, *, for_flight: bool = True, cov: Array | None = None) -> ConditionedDesign:
    """Build the design of the scheme with risk conditioned on the age.

    Args:
        for_flight: Whether the flight's filter estimates, biases included, and the setpoint limiter bounds the inputs'
            slew; a campaign has neither.
        cov: Covariance (n_x, n_x) of the estimate's error after a position without losses, in a campaign; None: as
            configured.

    Raises:
        DesignError: See `build_problem`, `build_ages`, `ConditionedSolver` and `innovation_form`.
    """
    problem = build_problem(config)
    problem = replace(problem, input_set=_build_planned_inputs(config, problem.plant))
    for_flight = for_flight and bool(config.plant.axes)
    link, max_risk = build_ages(config), 1.0 - config.smpc.delta_x
    slew_mps3 = config.limits.slew_mps3 if for_flight else math.inf
    plant, estimator, estimator_plant = problem.plant, config.estimator, None
    if for_flight and estimator.bias_drift:
        estimator_plant = add_bias(plant, estimator.bias_drift, force=estimator.inertial_std_mps2 > 0.0)
    if cov is None and for_flight:
        cov = compute_settled_covariance(config, plant)
    elif cov is None:
        exact = config.risk.estimate == "exact"
        cov = np.zeros((plant.n_x,) * 2) if exact else _build_innovations(config, plant, 0).estimate_cov
    adapts = for_flight and config.risk.budgets != "configured"
    bounds_slack = not (adapts and config.risk.adapt)
    solver = ConditionedSolver(
        problem,
        link,
        max_risk,
        slew_mps3=slew_mps3,
        cov=cov,
        filter_plant=estimator_plant,
        has_observed_levels=adapts,
        bounds_slack=bounds_slack,
    )
    design_id = make_conditioned_id(
        problem, link, max_risk, slew_mps3, cov, estimator_plant, adapts=adapts, bounds_slack=bounds_slack
    )
    return ConditionedDesign(solver, cov, design_id)


def _build_planned_inputs(config: Config, plant: Plant) -> Polytope:
    """Build the input set of the plans: the limits less bias_max, which is free for the compensation of a bias."""
    free = config.estimator.bias_max
    lower, upper = build_input_bounds(config, plant)
    return Polytope.from_box((lower + free).tolist(), (upper - free).tolist())


def _build_innovations(config: Config, plant: Plant, losses: int) -> InnovationForm:
    """Build the innovation form of the plant for the configured filter, and its error after `losses` in a row."""
    estimator = config.estimator
    age_s = _compute_position_age_s(config)
    return innovation_form(plant, estimator.position_std_m, age_s, losses, estimator.bias_drift)


def _compute_position_age_s(config: Config) -> float:
    """Return the age of a step's position at the end of the step, at most a step [s]."""
    link, dt_s = config.link, config.plant.dt_s
    # It may be captured at the beginning of the step, unless later ones follow.
    capture_age_s = 1.0 / config.source.rate_hz if config.source.rate_hz else dt_s
    if link.model == "scheduled":
        capture_age_s += link.wait_s
    return min(dt_s, capture_age_s + link.delay_s + link.jitter_s)


def compute_settled_covariance(config: Config, plant: Plant) -> Array:
    """Compute the filter's error covariance at the begin of a plan, with a position and inertial data in every step."""
    dt_ns = round(plant.dt_s * SECOND_NS)
    kalman = make_kalman(plant, build_estimator(config), dt_ns)
    dead_ns = round(config.plant.dead_time_s * SECOND_NS)
    return settle_covariance(kalman, dt_ns, round(_compute_position_age_s(config) * SECOND_NS), dead_ns)


def build_flight_design(config: Config) -> AnyDesign:
    """Build the design of a flight, by `smpc.scheme`.

    Raises:
        DesignError: There is none; the error has key, reason and advice.
    """
    return build_conditioned(config) if config.is_age_conditioned else build_design(config)


def build_design(config: Config) -> Design:
    """Build the design of scheme `hahn-stursberg`, and those for late positions, and check them against Assumption 4.

    The duration of a decision with its schedule is checked, too.

    Raises:
        DesignError: There is none; the error has key, reason and advice.
    """
    from uavctl.smpc.hahn_stursberg.design import make_design
    from uavctl.smpc.hahn_stursberg.exact import check_schedule, optimal_cost
    from uavctl.smpc.hahn_stursberg.late import add_late_designs

    spec = build_spec(config)
    design = make_design(spec, optimal_cost)
    check_schedule(design)
    return add_late_designs(design, spec, compute_late_steps(config))


def build_solver(design: AnyDesign, config: Config) -> Solver:
    """Build the solver of a design: `smpc.controller`, that of scheme `age-conditioned`, or by `solver.method`.

    Raises:
        DesignError: The design does not fit the solver.
    """
    if config.smpc.controller:
        return build_outside_solver(config, build_problem(config))
    if isinstance(design, ConditionedDesign):
        return design.solver
    if config.solver.method == "exact":
        from uavctl.smpc.hahn_stursberg.shortcut import ShortcutSolver

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


def compute_reference_limits(design: AnyDesign) -> Array:
    """Return the right sides (m_x,) of the state rows, less the back-offs of a plan at rest."""
    return design.reference_limits if isinstance(design, ConditionedDesign) else build_reference_limits(design)


def make_design_record(design: AnyDesign) -> dict[str, object]:
    """Return a design of either scheme as plain numbers."""
    if isinstance(design, ConditionedDesign):
        return make_conditioned_record(design)
    from uavctl.smpc.hahn_stursberg.design import design_record

    return design_record(design)


def _compute_min_probability(config: Config) -> float:
    """Return the least probability of a new position in a step that plans count on."""
    return (
        1.0 - build_ages(config).outage(1)
        if config.is_age_conditioned
        else compute_promised_probability(build_delayed_link(config))
    )


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
        bias_bounds=_compute_bias_bounds(config),
        inertial_std_mps2=estimator.inertial_std_mps2,
        inertial_bias_mps2=estimator.inertial_bias_mps2,
        inertial_bias_s=estimator.inertial_bias_s,
    )


def _compute_bias_bounds(config: Config) -> tuple[float, ...]:
    """Return the bound of each input's bias: a share of the input's half range, at least `bias_max`."""
    sets, estimator = config.sets, config.estimator
    half_ranges = [0.5 * (high - low) for low, high in zip(sets.input_lower, sets.input_upper, strict=True)]
    return tuple(max(estimator.bias_max, estimator.bias_share * half_range) for half_range in half_ranges)


def build_envelope(config: Config, plant: Plant) -> EnvelopeParameters:
    """Build the bounds of possible motion in flight, by the limits, the plant and the setpoint limiter."""
    envelope, position_limits = config.envelope, get_position_limits_m(config)
    lower, upper = map(list, zip(*(position_limits.get(axis, (-math.inf, math.inf)) for axis in AXES), strict=True))
    sizes_m = [high - low for low, high in zip(lower, upper, strict=True)]
    outside_m = [
        envelope.outside_m or max(0.1 * size if math.isfinite(size) else 0.0, MIN_OUTSIDE_M) for size in sizes_m
    ]
    # Velocity change by one step's disturbance, as an acceleration over the step: E W E' / dt²; and gusts
    velocity_cov = plant.e[list(plant.velocity_index)] @ plant.w @ plant.e[list(plant.velocity_index)].T
    std_mps2 = float(np.sqrt(np.diagonal(velocity_cov).max())) / plant.dt_s
    std_mps2 = math.hypot(std_mps2, max(plant.gust_mps2)) if plant.gust_mps2 else std_mps2
    unexplained_mps2 = envelope.unexplained_mps2 or max(ENVELOPE_SIGMA * std_mps2, MIN_UNEXPLAINED_MPS2)
    lags_s: dict[str, float] = {}
    if config.plant.lag_s:
        dead_time_s = config.plant.dead_time_s
        lags_s.update((axis, dead_time_s + lag_s) for axis, lag_s in zip(plant.axes, config.plant.lag_s, strict=True))
    return EnvelopeParameters(
        axes=tuple(axis in plant.axes for axis in AXES),
        lower_m=_make_vec3(lower),
        upper_m=_make_vec3(upper),
        outside_m=_make_vec3(outside_m),
        brake_mps2=build_limits(config).box_mps2,
        lag_s=_make_vec3([lags_s.get(axis, 0.0) for axis in AXES]),
        unexplained_mps2=unexplained_mps2,
        disagreement_mps=envelope.disagreement_mps or DISAGREEMENT_TIME_S * unexplained_mps2,
        window_ns=round(max(MIN_WINDOW_S, 4.0 * plant.dt_s) * SECOND_NS),
        begins_mps=config.estimator.initial_std,
    )


def _has_independent_velocity(config: Config) -> bool:
    """Return whether the vehicle's velocity is known to be independent of our positions."""
    return not config.relay.enabled and "LOCAL_POSITION_NED" not in config.source.messages


def _make_vec3(values: list[float]) -> Vec3:
    north, east, down = values
    return north, east, down


def build_limits(config: Config) -> LimitsParameters:
    """Return the parameters of the setpoint limiter.

    Raises:
        DesignError: The largest tilt leaves plans no acceleration.
    """
    limits, bias_max = config.limits, config.estimator.bias_max
    if limits.tilt_deg is None:
        return LimitsParameters(limits.accel_mps2, limits.slew_mps3)
    parameters = LimitsParameters(limits.accel_mps2, limits.slew_mps3, math.radians(limits.tilt_deg))
    left_mps2 = min(parameters.box_mps2[:2])
    if left_mps2 <= bias_max:
        raise DesignError(
            "limits.tilt_deg",
            f"{limits.tilt_deg:g} deg leaves {left_mps2:.2g} m/s² to each axis, and estimator.bias_max is {bias_max:g}",
            "give a larger tilt, or a smaller bias_max or limits.accel_mps2 of down",
        )
    return parameters


def build_input_bounds(config: Config, plant: Plant) -> tuple[Array, Array]:
    """Return the least and the largest input (n_u,): those of `sets`, within the largest tilt."""
    lower, upper = np.array(config.sets.input_lower), np.array(config.sets.input_upper)
    limits = build_limits(config)
    if not (limits.has_cone and plant.axes):
        return lower, upper
    box = plant.to_input(limits.box_mps2)
    return np.maximum(lower, -box), np.minimum(upper, box)


def _build_risk(config: Config, design: AnyDesign) -> RiskParameters | None:
    """Build the parameters of the risk in flight; None where the budgets of the design fly as they are."""
    risk = config.risk
    if not isinstance(design, ConditionedDesign) or risk.budgets == "configured":
        return None
    return RiskParameters(
        allowed=1.0 - config.smpc.delta_x,
        shares=design.solver.age_shares,
        rows=design.state_set.c,
        budgets=risk.budgets,
        adapts=risk.adapt,
    )


def build_controller(config: Config, design: AnyDesign | None = None) -> Controller:
    """Build the controller: all constants of a control tick; the design is built if it is not given.

    Raises:
        DesignError: There is no design.
    """
    check_axes(config)
    design = build_flight_design(config) if design is None else design
    estimator, fallback = config.estimator, config.fallback
    plant, outside, yaw_deg = build_plant(config), config.smpc.controller, config.mission.yaw_deg
    return Controller(
        plant=plant,  # the plant of the design may be the one of the estimator
        design_id=design.design_id,
        horizon=design.horizon,
        solver=build_solver(design, config),
        mission=build_mission(config, design, compute_reference_limits(design)),
        names=build_names(design),
        link=LinkEstimateParameters(promised=_compute_min_probability(config)),
        outside=outside,
        risk=_build_risk(config, design),
        late_steps=design.horizon if outside or isinstance(design, ConditionedDesign) else len(design.late),
        envelope=build_envelope(config, plant),
        yaw=YawParameters(
            mode=YawMode(config.mission.yaw),
            # Of a list, each waypoint has its own angle.
            angle_rad=0.0 if isinstance(yaw_deg, tuple) else math.radians(yaw_deg or 0.0),
            rate_rps=math.radians(config.mission.yaw_rate_dps),
        ),
        estimator=build_estimator(config),
        input_bounds=build_input_bounds(config, plant),
        fallback=FallbackParameters(
            brake_gain_1ps=fallback.brake_gain_1ps,
            brake_s=fallback.brake_s,
            hold_s=fallback.hold_s,
            blind_hold_s=fallback.blind_hold_s,
            land=fallback.land,
            recover_samples=fallback.recover_samples,
        ),
        limits=build_limits(config),
        position_gate=GateParameters(
            sigma=estimator.gate_sigma,
            margin_m=estimator.gate_m,
            jump_ns=round(fallback.jump_s * SECOND_NS),
            at_rest_mps=AT_REST_MPS if _has_independent_velocity(config) else 0.0,
        ),
        dt_ns=round(config.plant.dt_s * SECOND_NS),
        tick_ns=round(config.daemon.tick_s * SECOND_NS),
        dead_ns=round(config.plant.dead_time_s * SECOND_NS),
        cell_rows=build_cell_rows(config, design) if config.mission.cells else None,
    )


@dataclass(frozen=True, eq=False)
class Prepared:
    """Controller that is ready to fly, with its configuration and design."""

    config: Config
    design: AnyDesign
    controller: Controller

    def make_levels(self) -> None:
        """Make all levels of the budgets: for real time, where a tick that makes one takes up to 50 ms longer."""
        if isinstance(self.design, ConditionedDesign) and self.config.risk.budgets == "observed":
            self.design.solver.make_levels()


def prepare(config: Config, design: AnyDesign) -> Prepared:
    """Make the controller of a design.

    Raises:
        DesignError: The design does not fit the configuration.
    """
    return Prepared(config, design, build_controller(config, design))


CONTROLLER = "controller"  # name of another package's controller among the versions
ARITHMETIC_NAME = "arithmetic"
_LIBRARIES = ("numpy", "scipy", "clarabel", "daqp", "pymavlink", "msgspec", "mcap")


def collect_versions(controller: str) -> dict[str, str]:
    """Return the versions of code, libraries and arithmetic that decide the last bits of a flight.

    Args:
        controller: Controller of another package; empty without one.
    """
    libraries = {name: metadata.version(name) for name in _LIBRARIES}
    if controller:
        libraries[CONTROLLER] = compute_controller_id(controller)
    base = {"uavctl": __version__, "code": compute_code_id(), "python": platform.python_version()}
    return {**base, ARITHMETIC_NAME: ARITHMETIC, **libraries}


def read_cpu_model() -> str:
    """Read the CPU type: without portable arithmetic the last bits of decisions depend on it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
