"""Rehearsal of a mission before a flight: the closed loop of the planner's model, without noise or disturbance.

x(k+1) = A x(k) + B u(k), where u(k) is the first input of the plan from x(k). Each plan has the age of information that
the configured link gives: the ages of all steps together have the link's long-run shares. So a problem here has its
cause in the configuration: limits that leave a plan no room, or a motion that needs more than the inputs.

A trajectory is rehearsed a second time on a vehicle with more drag than the model: x(k+1) = A' x(k) + B' u(k). The
figure is the cost of a drag that was not identified. A figure of eight with drag 1.0 and a model of 0.24 1/s is
rehearsed 0.12 m off in the mean, and flown 0.13 m off without inertial data, 0.10 m with them.
"""

from __future__ import annotations

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.config.types import Config
from uavctl.flight.controller import Controller
from uavctl.flight.mission import Mission, advance_mission, make_question
from uavctl.flight.risk import set_risk
from uavctl.flight.risk_state import RiskGroup
from uavctl.records import Vector
from uavctl.smpc.answer import Preview
from uavctl.smpc.conditioned.adaptation import AgeRecord, LoopState, find_configured_level
from uavctl.smpc.conditioned.design import ConditionedDesign
from uavctl.smpc.plant import AXES, Plant
from uavctl.wiring.controller import build_plant, make_start_state
from uavctl.wiring.mission import sample_trajectory

MAX_STEPS = 2400  # two minutes at steps of 0.05 s; a step takes milliseconds
# Multiples of the golden ratio modulo 1 fill [0, 1) evenly in any number of steps (Weyl's equidistribution).
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
# Drag of PX4's own simulated vehicle (SIH) [1/s], four times that of the preset: the largest of any recorded flight.
LARGE_DRAG_1PS = 1.0
# Share of mission.accept_m above which the cost of a large drag is worth a note.
_NOTED_SHARE = 0.5


class RehearsalResult(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of a rehearsed mission; tracking figures are None where the mission has no trajectory."""

    seconds: float  # rehearsed time [s]
    plans: int
    allowed: float  # 1 - delta_x: a larger share of relaxed plans is a problem of the configuration
    relaxed: float  # share of plans with a relaxed constraint
    constraint: str  # the most relaxed one; empty if none is
    unit: str  # of this constraint
    amount: float  # largest relaxation
    ahead_s: float  # stage of that plan, with the age of its information [s]
    accept_m: float  # tracking error that is accepted
    tracking_m: float | None = None  # distance from where the trajectory is at the time, mean
    tracking_max_m: float | None = None
    tracking_max_s: float | None = None  # time of the largest [s]
    asked_mps2: float | None = None  # largest acceleration setpoint that the trajectory asks for, on the worst axis
    asked_s: float | None = None  # its time
    left_mps2: float | None = None  # that the inputs leave on this axis beside estimator.bias_max
    drag_1ps: float | None = None  # least drag of the model; None where none is modelled or it is large already
    large_drag_m: float | None = None  # distance from the trajectory if the drag is LARGE_DRAG_1PS, mean
    large_drag_max_m: float | None = None

    @property
    def relaxes(self) -> bool:
        """Whether more plans relax a constraint than states may be outside their limits."""
        return self.relaxed > self.allowed

    @property
    def leaves_trajectory(self) -> bool:
        """Whether the trajectory cannot be followed to the accepted distance."""
        return self.tracking_max_m is not None and self.tracking_max_m > self.accept_m

    @property
    def saturates(self) -> bool:
        """Whether the trajectory asks for more than the inputs leave."""
        return self.asked_mps2 is not None and self.left_mps2 is not None and self.asked_mps2 > self.left_mps2

    @property
    def depends_on_drag(self) -> bool:
        """Whether a large drag that was not identified costs a large part of the accepted distance."""
        return self.large_drag_max_m is not None and self.large_drag_max_m > _NOTED_SHARE * self.accept_m

    @property
    def sentences(self) -> tuple[str, ...]:
        """Problems, as sentences with figures; empty if there is none."""
        texts = []
        if self.relaxes:
            texts.append(
                f"{self.relaxed:.0%} of the plans relax a constraint without any disturbance ({self.allowed:.0%} may "
                f"be outside): the {self.constraint} by up to {self.amount:.2g} {self.unit}".rstrip()
                + f", for positions that are {self.ahead_s:.1f} s old"
            )
        if self.saturates:
            texts.append(
                f"the trajectory asks for {self.asked_mps2:.1f} m/s² at {self.asked_s:.1f} s, the inputs leave "
                f"{self.left_mps2:.1f} m/s²"
            )
        if self.leaves_trajectory or self.saturates:
            texts.append(
                f"the model is up to {self.tracking_max_m:.2f} m from the trajectory ({self.tracking_m:.2f} m in the "
                f"mean), mission.accept_m is {self.accept_m:g} m"
            )
        elif self.depends_on_drag:
            texts.append(
                f"with the configured drag of {self.drag_1ps:g} 1/s the model is {self.tracking_m:.3f} m from the "
                f"trajectory in the mean; with a drag of {LARGE_DRAG_1PS:g} 1/s it is {self.large_drag_m:.2f} m, "
                f"{self.large_drag_max_m:.2f} m at most"
            )
        return tuple(texts)

    @property
    def hint(self) -> str:
        """Remedy; empty without a problem."""
        texts = []
        if self.relaxes:
            texts.append(
                "the back-offs for old positions leave no room: improve the link, widen [sets], lower smpc.delta_x or "
                "the plant's wind_std_mps2"
            )
        if self.leaves_trajectory or self.saturates:
            texts.append("fly the trajectory slower, or widen sets.input_* and limits.accel_mps2 if the vehicle can")
        elif self.depends_on_drag:
            texts.append("measure the vehicle's drag with `uavctl tune`, or with `uavctl identify` from a recording")
        return "; ".join(texts)


def rehearse(config: Config, design: ConditionedDesign, controller: Controller) -> RehearsalResult:
    """Fly the mission on the plan's own model: a trajectory to its end, else `duration_s`."""
    result, positions_m = _fly_mission(config, design, controller, design.plant)
    if controller.mission.trajectory is None:
        return result
    result = _add_tracking(result, config, design, controller.mission, positions_m)
    min_drag_1ps = min(config.plant.drag_1ps, default=LARGE_DRAG_1PS)
    if min_drag_1ps >= LARGE_DRAG_1PS:
        return result
    large_drags_1ps = tuple(max(LARGE_DRAG_1PS, drag) for drag in config.plant.drag_1ps)
    plant = build_plant(replace(config, plant=replace(config.plant, drag_1ps=large_drags_1ps)))
    distances_m = _compute_distances(config, design, _fly_mission(config, design, controller, plant)[1])
    return replace(
        result, drag_1ps=min_drag_1ps, large_drag_m=float(distances_m.mean()), large_drag_max_m=float(distances_m.max())
    )


def _fly_mission(
    config: Config, design: ConditionedDesign, controller: Controller, vehicle: Plant
) -> tuple[RehearsalResult, Array]:
    """Fly the mission on a vehicle; return the result without tracking figures, and positions (steps, axes) [m]."""
    mission, plant, dt_ns = controller.mission, design.plant, controller.dt_ns
    motion, index = mission.trajectory, list(plant.position_index)
    x = make_rehearsal_start(config, design, mission)
    late_steps = _sample_late_steps(config, design)
    risk = RiskGroup()
    if controller.risk is not None:  # as after a long flight on the configured link
        ages = AgeRecord(level=find_configured_level(controller.risk.shares))
        risk = RiskGroup(ages, LoopState(log_silence_widening=0.0))
    steps = min(MAX_STEPS, round(config.duration_s / plant.dt_s) if motion is None else len(motion.states))
    last_input, state = np.zeros(plant.n_u), None
    worst, ahead_s, relaxed = ("", "", 0.0), 0.0, 0
    positions_m: list[Array] = []
    for k in range(steps):
        state = advance_mission(mission, state, _make_vector(x), k * dt_ns)
        target, preview = make_question(mission, state, k * dt_ns)
        age_steps = int(late_steps[k])
        request = Preview(
            limits=preview.limits, path=preview.path, age=age_steps, cov=design.estimate_cov, sent=last_input
        )
        request = set_risk(request, risk, controller.risk, is_led=False)
        answer = design.solver.solve(k, x, target, request)
        positions_m.append(x[index])
        relaxed += bool(answer.relaxed)
        for relaxation in answer.relaxed:
            name, unit, size = (
                controller.names.rows[relaxation.index] if relaxation.constraint == "state" else ("slew", "m/s²", 1.0)
            )
            if relaxation.amount / size > worst[2]:
                worst, ahead_s = (name, unit, relaxation.amount / size), (age_steps + relaxation.stage) * plant.dt_s
        last_input = answer.inputs[0] if len(answer.inputs) else last_input
        x = vehicle.a @ x + vehicle.b @ last_input
    result = RehearsalResult(
        seconds=round(len(positions_m) * plant.dt_s, 6),
        plans=len(positions_m),
        allowed=round(1.0 - config.smpc.delta_x, 9),
        relaxed=relaxed / max(1, len(positions_m)),
        constraint=worst[0],
        unit=worst[1],
        amount=worst[2],
        ahead_s=ahead_s,
        accept_m=config.mission.accept_m,
    )
    return result, np.array(positions_m)


def _add_tracking(
    result: RehearsalResult, config: Config, design: ConditionedDesign, mission: Mission, positions_m: Array
) -> RehearsalResult:
    """Return a rehearsal with the figures of its trajectory."""
    assert mission.trajectory is not None
    plant, motion = design.plant, mission.trajectory
    distances_m = _compute_distances(config, design, positions_m)
    low, high = (plant.accel_per_input * side for side in design.solver.problem.input_set.bounds)
    asked_mps2 = plant.accel_per_input * motion.path_inputs[:, 0]
    left_mps2 = np.where(asked_mps2 < 0.0, -low, high)
    step, axis = np.unravel_index(int((np.abs(asked_mps2) - left_mps2).argmax()), asked_mps2.shape)
    return replace(
        result,
        tracking_m=float(distances_m.mean()),
        tracking_max_m=float(distances_m.max()),
        tracking_max_s=round(int(distances_m.argmax()) * plant.dt_s, 6),
        asked_mps2=float(abs(asked_mps2[step, axis])),
        asked_s=round(int(step) * plant.dt_s, 6),
        left_mps2=float(left_mps2[step, axis]),
    )


def _compute_distances(config: Config, design: ConditionedDesign, positions_m: Array) -> Array:
    """Return the distance (steps,) of each position from the trajectory at its time [m]."""
    assert config.mission.trajectory is not None
    wanted_m, _ = sample_trajectory(config.mission.trajectory, design, config.plant.dead_time_s)
    columns = [AXES.index(axis) for axis in design.plant.axes]
    distances_m: Array = np.linalg.norm(positions_m - wanted_m[: len(positions_m), columns], axis=1)
    return distances_m


def make_rehearsal_start(config: Config, design: ConditionedDesign, mission: Mission) -> Array:
    """Return the first state (n_x,), at rest where a plan may rest."""
    if mission.trajectory is not None:
        return np.array(mission.trajectory.states[0])
    start_state = make_start_state(config, design.plant)
    return np.array(
        start_state if mission.rest_region is None else mission.rest_region.find_stop(_make_vector(start_state))
    )


def _sample_late_steps(config: Config, design: ConditionedDesign) -> NDArray[np.intp]:
    """Return the age of the position that each plan is made from [steps].

    With inertial data a plan is made in every step, so its position has any age of the link. Without them a plan is
    made when a position comes, so it has the age that most positions have.
    """
    weights = design.solver.risk.age_probabilities
    if not config.estimator.inertial_std_mps2:
        return np.full(MAX_STEPS, int(weights.argmax()))
    shares = np.cumsum(weights) / weights.sum()
    return np.searchsorted(shares, (0.5 + _GOLDEN * np.arange(MAX_STEPS)) % 1.0)


def _make_vector(x: Array) -> Vector:
    return tuple(x.tolist())
