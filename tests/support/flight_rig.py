"""A small plant, a stub solver and a runner for tests of the control tick."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag, expm

from uavctl.arrays import Array
from uavctl.constraint_names import name_constraints
from uavctl.flight.controller import Controller
from uavctl.flight.fallback import FallbackParameters
from uavctl.flight.kalman import EstimatorParameters
from uavctl.flight.limits import LimitsParameters
from uavctl.flight.link_estimate import LinkEstimateParameters
from uavctl.flight.mission import RestRegion, make_hold_mission
from uavctl.flight.monitors.outliers import GateParameters
from uavctl.flight.state import ControlState
from uavctl.flight.tick import TickOutput, make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.records import Command, ControlMode, PositionSample, SolveStatus, StepInput, Vec3, VehicleStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.smpc.plant import Plant

Fault = Callable[[Answer], Answer]

MS = 1_000_000
DT_NS = 200 * MS
TICK_NS = 50 * MS
TICKS = DT_NS // TICK_NS
HORIZON = 4
START_NS = 7_000_000_000


def drag_lag_generator(drag: float, lag: float) -> Array:
    """Generator of (p, v, a, w, u) of one axis: p' = v, v' = a - c v + w, T a' = u - a."""
    g = np.zeros((5, 5))
    g[0, 1] = 1.0
    g[1, 1:4] = [-drag, 1.0, 1.0]
    g[2, 2], g[2, 4] = -1.0 / lag, 1.0 / lag
    return g


def small_plant(axes: tuple[str, ...] = ("north",), wind_std: float = 0.15, dt_s: float = DT_NS * 1e-9) -> Plant:
    """Drag-lag axes from the matrix exponential, independent of the project's own plants."""
    n = len(axes)
    axis_matrix = expm(drag_lag_generator(0.3, 0.25) * dt_s)
    return Plant(
        a=block_diag(*[axis_matrix[:3, :3]] * n),
        b=block_diag(*[axis_matrix[:3, 4:5]] * n),
        e=block_diag(*[axis_matrix[:3, 3:4]] * n),
        w=np.eye(n) * wind_std**2,
        dt_s=dt_s,
        axes=axes,
        position_index=tuple(3 * i for i in range(n)),
        velocity_index=tuple(3 * i + 1 for i in range(n)),
        accel_per_input=np.ones(n),
    )


def estimator_parameters(**changes: Any) -> EstimatorParameters:
    base = EstimatorParameters(
        position_std_m=0.005,
        velocity_std_mps=0.05,
        initial_std=0.3,
        window_s=2.0,
        max_position_m=1000.0,
        max_velocity_mps=100.0,
    )
    return replace(base, **changes)


def make_answer(plant: Plant, seq: int, x: Array, inputs: Array, status: SolveStatus = SolveStatus.OPTIMAL) -> Answer:
    states = [x]
    for u in inputs:
        states.append(plant.a @ states[-1] + plant.b @ u)
    return Answer(
        seq=seq,
        status=status,
        method="stub",
        inputs=inputs,
        states=np.array(states),
        backoff_x=np.zeros((len(inputs) + 1, 2)),
        backoff_u=np.zeros((len(inputs), 2)),
        reference=np.zeros(plant.n_x),
        slack=0.0,
        offset=0.0,
        terminal_miss=0.0,
        cost=1.0,
        cost_lower=1.0,
        gap=0.0,
        iterations=1,
    )


@dataclass
class StubSolver:
    """Plays a distinct input in each stage; `faults` maps a step to what happens there instead."""

    plant: Plant
    horizon: int = HORIZON
    faults: Mapping[int, Fault] = field(default_factory=dict)
    asked: list[tuple[int, Array]] = field(default_factory=list)

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        self.asked.append((seq, x))
        answer = make_answer(self.plant, seq, x, stub_inputs(seq, self.horizon, self.plant.n_u))
        fault = self.faults.get(seq)
        return answer if fault is None else fault(answer)


def stub_inputs(seq: int, horizon: int, n_u: int) -> Array:
    """0.01 a stage and 0.1 a step (modulo 10), so that every input tells where it comes from."""
    return np.repeat(0.1 * (seq % 10) + 0.01 * np.arange(horizon)[:, None], n_u, axis=1)


def make_controller(
    solver: StubSolver | None = None,
    *,
    horizon: int = HORIZON,
    land: bool = True,
    sigma: float = math.inf,
    **changes: float,
) -> Controller:
    """A controller; with its `sigma` it believes any position, so that a stub's inputs need not fit the samples."""
    plant = solver.plant if solver is not None else small_plant()
    fallback = FallbackParameters(
        brake_gain_1ps=1.5, brake_s=2.0, hold_s=3.0, blind_hold_s=3.0, land=land, recover_samples=3
    )
    return Controller(
        plant=plant,
        design_id="stub",
        horizon=horizon,
        solver=solver or StubSolver(plant, horizon),
        mission=make_hold_mission(
            np.zeros(plant.n_x),
            plant.position_index,
            np.zeros(0),
            horizon=horizon,
            dt_ns=DT_NS,
            rest_region=make_rest_region(plant),
        ),
        names=name_constraints((), plant.n_x, plant.axes, plant.position_index, plant.velocity_index),
        estimator=estimator_parameters(**changes),
        fallback=fallback,
        limits=LimitsParameters(accel_mps2=(2.0, 2.0, 1.5), slew_mps3=100.0),
        position_gate=GateParameters(sigma=sigma, margin_m=0.0, jump_ns=500 * MS),
        link=LinkEstimateParameters(promised=0.5),
        dt_ns=DT_NS,
        tick_ns=TICK_NS,
    )


def make_rest_region(plant: Plant, half_m: float = 5.0) -> RestRegion:
    """Places up to `half_m` from the middle; from a speed v it comes to rest v / 2 further."""
    n = len(plant.axes)
    rest, stop = np.zeros((n, plant.n_x)), np.zeros((n, plant.n_x))
    for axis, (position, velocity) in enumerate(zip(plant.position_index, plant.velocity_index, strict=True)):
        rest[axis, position] = stop[axis, position] = 1.0
        stop[axis, velocity] = 0.5
    axes = tuple(("north", "east", "down").index(axis) for axis in plant.axes)
    return RestRegion(
        axes=axes, lower=np.full(n, -half_m), upper=np.full(n, half_m), equilibrium_map=rest, stop_map=stop
    )


def sample(
    captured_ns: int,
    received_ns: int | None = None,
    position_m: Vec3 = (0.0, 0.0, 0.0),
    velocity_mps: Vec3 | None = None,
    source: str = "camera",
    std_m: float = 0.005,
) -> PositionSample:
    return PositionSample(
        captured_ns=captured_ns,
        received_ns=captured_ns if received_ns is None else received_ns,
        position_m=position_m,
        velocity_mps=velocity_mps,
        std_m=std_m,
        source=source,
        seq=0,
    )


def vehicle(*, armed: bool = True, external: bool = True) -> VehicleStatus:
    return VehicleStatus(at_ns=START_NS, autopilot="px4", armed=armed, mode="OFFBOARD", external=external)


def boundary_ns(number: int) -> int:
    return START_NS + number * DT_NS


def make_step_samples(lost: Iterable[int] = (), steps: int = 1000, delay_ns: int = 20 * MS) -> list[PositionSample]:
    """A sample 50 ms before each boundary (arriving before it), but for those of the lost steps."""
    missing = set(lost)
    kept = [number for number in range(steps) if number not in missing]
    return [sample(boundary_ns(number) - 50 * MS, boundary_ns(number) - 50 * MS + delay_ns) for number in kept]


def make_motion_samples(step: int, speed_mps: float = 1.0) -> list[PositionSample]:
    """One sample at each boundary up to `step` that shows a steady motion, then none."""
    return [
        sample(boundary_ns(n), position_m=(speed_mps * 0.2 * n, 0, 0), velocity_mps=(speed_mps, 0, 0))
        for n in range(step + 1)
    ]


def make_inputs(
    ticks: Iterable[int],
    samples: Iterable[PositionSample],
    *,
    stop_from: int | None = None,
    commands: Mapping[int, tuple[Command, ...]] | None = None,
    status: Callable[[int], VehicleStatus | None] = lambda tick: vehicle(),
) -> list[StepInput]:
    """Tick inputs: every sample in the first tick after its arrival; left-out ticks count as missed."""
    waiting = sorted(samples, key=lambda received: received.received_ns)
    result: list[StepInput] = []
    place, before = 0, None
    for tick in ticks:
        at_ns = START_NS + tick * TICK_NS
        begin = place
        while place < len(waiting) and waiting[place].received_ns <= at_ns:
            place += 1
        result.append(
            StepInput(
                tick=tick,
                at_ns=at_ns,
                samples=tuple(waiting[begin:place]),
                vehicle=status(tick),
                missed_ticks=0 if before is None else tick - before - 1,
                stop=stop_from is not None and tick >= stop_from,
                commands=(commands or {}).get(tick, ()),
            )
        )
        before = tick
    return result


def run(controller: Controller, inputs: Iterable[StepInput], state: ControlState | None = None) -> list[TickOutput]:
    outputs = []
    state = make_initial_state() if state is None else state
    for inp in inputs:
        state, output = run_tick(state, inp, controller)
        outputs.append(output)
    return outputs


def find_boundaries(outputs: list[TickOutput]) -> list[TickOutput]:
    return [output for output in outputs if output.decision.boundary]


def list_modes(outputs: list[TickOutput]) -> list[ControlMode]:
    return [output.decision.mode for output in outputs]


def list_plan_steps(outputs: list[TickOutput]) -> list[tuple[int | None, int | None]]:
    """(plan, index) at each boundary."""
    return [(output.decision.plan_seq, output.decision.plan_index) for output in find_boundaries(outputs)]


def list_codes(output: TickOutput) -> dict[str, int]:
    return {event.code: event.count for event in output.events}


def with_faults(faults: Mapping[int, Fault], axes: tuple[str, ...] = ("north",)) -> tuple[Controller, StubSolver]:
    solver = StubSolver(small_plant(axes), faults=faults)
    return make_controller(solver), solver


def assert_sound(outputs: list[TickOutput], limits: tuple[float, ...] = (2.0, 2.0, 1.5), slew: float = 5.0) -> None:
    """Every setpoint finite, bounded, slew-limited; every plan used within its horizon."""
    before = (0.0, 0.0, 0.0)
    for output in outputs:
        assert output.decision.plan_index is None or 0 <= output.decision.plan_index < HORIZON
        if output.setpoint is not None:
            accel = output.setpoint.accel_mps2
            assert all(math.isfinite(a) and abs(a) <= limit for a, limit in zip(accel, limits, strict=True))
            assert max(abs(a - b) for a, b in zip(accel, before, strict=True)) <= slew + 1e-12
            before = accel
