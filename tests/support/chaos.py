"""Flights in virtual time under random faults of the link, the messages, the solver, the loop and the operator.

Each tick is held against rules that are told here in a few lines of their own, not by the code that is tested.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from flight_rig import (
    DT_NS,
    HORIZON,
    START_NS,
    TICK_NS,
    TICKS,
    StubSolver,
    make_controller,
    sample,
    small_plant,
    vehicle,
)
from msgspec import structs

from uavctl.arrays import Array
from uavctl.flight.controller import Controller
from uavctl.flight.monitors.outliers import GateParameters
from uavctl.flight.tick import TickOutput, make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.records import Command, ControlMode, Order, PositionSample, SolveStatus, StepInput, VehicleStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview

LIMITS, SLEW = (2.0, 2.0, 1.5), 100.0 * TICK_NS * 1e-9
ODD = (math.nan, math.inf, -math.inf, 1e9, 1e300, 999.0, -0.0)
FLOWN = (ControlMode.TRACK, ControlMode.BRAKE, ControlMode.HOLD)


@dataclass
class ChaosCounts:
    """What came of a run.

    Attributes:
        ticks: Control ticks.
        late: Ticks in which a plan was flown though the age had reached H at their boundary.
        unsound: Setpoints that are not finite, beyond a limit, or too far from the one before.
        falls: Times that the fallback began.
        flights: Flights begun anew, after a hand-over.
    """

    ticks: int = 0
    late: int = 0
    unsound: int = 0
    falls: int = 0
    flights: int = 0


class WildSolver(StubSolver):
    """Answers a question as it likes: well, badly, or not at all."""

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__(small_plant(("north", "east")), HORIZON)
        self.rng = rng

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """A steady answer, spoiled in a third of the cases."""
        self.asked.clear()  # a long run is not to fill the memory
        answer = super().solve(seq, x, target, preview)
        kind = int(self.rng.integers(12))
        if kind == 0:
            raise OverflowError("too large")
        if kind == 1:
            return Answer.failed(seq, SolveStatus.INFEASIBLE, "stub")
        if kind == 2:
            return structs.replace(answer, seq=seq - 1)
        inputs = -0.8 * x[[0, 3]] - 1.2 * x[[1, 4]] + self.rng.normal(scale=0.3, size=(HORIZON, 2))
        if kind == 3:
            inputs[int(self.rng.integers(HORIZON)), 0] = self.rng.choice(ODD)
        return structs.replace(answer, inputs=np.asarray(inputs))


@dataclass
class World:
    """A plant in the wind, seen through a bad link; everything random from one generator."""

    rng: np.random.Generator
    controller: Controller

    def __post_init__(self) -> None:
        """Begin at rest, away from the target."""
        plant = self.controller.plant
        self._a, self._b, self._e = plant.transition(TICK_NS * 1e-9)
        self.x, self.w = plant.equilibrium((1.0, -1.0, 0.0)), np.zeros(plant.n_w)
        self._waiting: list[PositionSample] = []
        self._bad = False

    def advance(self, tick: int, output: TickOutput | None) -> None:
        """One tick of the plant, by what was sent, and one look of the camera."""
        rng, at_ns = self.rng, START_NS + tick * TICK_NS
        if tick % TICKS == 0:
            self.w = rng.normal(scale=0.15, size=2)
            self._bad = rng.random() < (0.85 if self._bad else 0.08)  # bursts
        sent = None if output is None else output.setpoint
        u = np.zeros(2) if sent is None else np.array(sent.accel_mps2[:2])
        self.x = self._a @ self.x + self._b @ u + self._e @ self.w
        if tick % 2 or self._bad or rng.random() < 0.2:
            return
        north, east = (self.x[[0, 3]] + rng.normal(scale=0.003, size=2)).tolist()
        place, kind = [north, east, 0.0], int(rng.integers(40))
        if kind == 0:
            place[int(rng.integers(3))] = float(rng.choice(ODD))
        if kind == 1:
            place[0] += float(rng.choice([-2.0, 2.0]))
        received_ns = at_ns + int(rng.integers(0, DT_NS))
        new_sample = sample(at_ns + (2 * DT_NS if kind == 2 else 0), received_ns, (place[0], place[1], place[2]))
        self._waiting += [new_sample] * (2 if kind == 3 else 1)

    def arrived(self, at_ns: int) -> tuple[PositionSample, ...]:
        """What has come in by a tick."""
        arrived_samples = tuple(sample for sample in self._waiting if sample.received_ns <= at_ns)
        self._waiting = [sample for sample in self._waiting if sample.received_ns > at_ns]
        return arrived_samples


def run_ticks(rng: np.random.Generator, ticks: int, orders: bool) -> Iterator[tuple[StepInput, TickOutput, bool]]:
    """Inputs and outputs of that many ticks, and whether a flight begins; a new one follows each hand-over."""
    done = 0
    while done < ticks:
        controller = make_controller(WildSolver(rng), land=bool(rng.integers(2)))
        controller = replace(controller, position_gate=GateParameters(sigma=6.0, margin_m=0.3, jump_ns=DT_NS))
        world, state, output, begins = World(rng, controller), make_initial_state(), None, True
        missed, silent_until, tick = 0, 0, -1
        while done < ticks and state.mode is not ControlMode.STOPPED:
            tick += 1
            world.advance(tick, output)
            if rng.random() < 0.02:
                missed += 1
                continue
            at_ns = START_NS + tick * TICK_NS
            if orders and rng.random() < 0.002:
                silent_until = tick + int(rng.integers(1, 200))
            inp = StepInput(
                tick=tick,
                at_ns=at_ns,
                samples=world.arrived(at_ns),
                vehicle=None if tick < silent_until else _status(rng, orders),
                missed_ticks=missed,
                stop=orders and rng.random() < 0.0005,
                commands=_orders(rng) if orders else (),
            )
            missed = 0
            state, output = run_tick(state, inp, controller)
            yield inp, output, begins
            begins, done = False, done + 1


def soak_core(ticks: int, seed: int, *, orders: bool = True) -> ChaosCounts:
    """Fly for that many ticks and count what must not happen."""
    count, before, mode, age = ChaosCounts(), (0.0, 0.0, 0.0), ControlMode.WAIT, 0
    for _, output, begins in run_ticks(np.random.default_rng(seed), ticks, orders):
        if begins:
            count.flights, before, mode, age = count.flights + 1, (0.0, 0.0, 0.0), ControlMode.WAIT, 0
        decision, setpoint = output.decision, output.setpoint
        if decision.boundary:
            age = decision.age_steps or 0
        count.ticks += 1
        count.late += decision.mode is ControlMode.TRACK and age >= HORIZON
        count.falls += decision.mode is not mode is ControlMode.TRACK and decision.mode in FLOWN
        mode = decision.mode
        accel = (0.0, 0.0, 0.0) if setpoint is None else setpoint.accel_mps2
        bounded = all(math.isfinite(a) and abs(a) <= limit for a, limit in zip(accel, LIMITS, strict=True))
        near = setpoint is None or max(abs(a - b) for a, b in zip(accel, before, strict=True)) <= SLEW + 1e-12
        count.unsound += not (bounded and near)
        before = accel
    return count


def _status(rng: np.random.Generator, orders: bool) -> VehicleStatus:
    odd = orders and rng.random() < 0.0005
    return vehicle(armed=not odd, external=not odd or bool(rng.integers(2)))


def _orders(rng: np.random.Generator) -> tuple[Command, ...]:
    if rng.random() > 0.004:
        return ()
    order = list(Order)[int(rng.integers(len(Order)))]
    if order is Order.GOTO:
        place = rng.normal(scale=4.0, size=3)
        if rng.random() < 0.2:
            place[int(rng.integers(3))] = rng.choice(ODD)
        return (Command(order=order, position_m=(float(place[0]), float(place[1]), float(place[2]))),)
    return (Command(order=order),)
