"""Linear world of campaigns of fleets: several vehicles whose positions share one radio, with their controllers.

1. Cameras capture every vehicle at each step k. The sender chooses a vehicle for each message of the radio, and what
   it sends in step k has the position of step k. A message that is not lost is known to the first step that begins
   after its delay, as in flight.
2. A vehicle reports its newest position at the step that learns it; a report is as often lost as a message.
3. Vehicles fly apart: none is in the way of another one, and no distance between them counts.
4. The random numbers of a run come from (master, run) alone: the same disturbances for every schedule, and the same
   draws for the messages in the order in which they are sent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from uavctl.arrays import SECOND_NS, Array
from uavctl.config import Config
from uavctl.lab.campaign.draws import Stream, compute_root, draw_normal, draw_uniform
from uavctl.records import Vec3
from uavctl.schedule.channel import BudgetedChannel, compute_frame_bytes
from uavctl.smpc.batch import BatchSmpc, Counts, Decider, Decisions, Information
from uavctl.smpc.conditioned.planner import ConditionedDecider
from uavctl.wiring.controller import build_conditioned, build_problem, make_start_state
from uavctl.wiring.radio import RadioConfig, RadioSchedule, build_schedule_parameters, make_budget

WEIGHT_STEPS_S = 0.1  # between two updates of the weights, as in `uavctl cameras`
_ROUNDING_NS = 1  # of a delay


@dataclass(frozen=True)
class TaskVehicle:
    """One vehicle: its configuration, and a second target to which it goes and back."""

    config: Config
    other_target_m: Vec3 | None = None  # None: it stays at its target
    leg_s: float = 0.0  # time between two changes of the target


@dataclass(frozen=True, eq=False)
class FleetRuns:
    """Figures of N runs."""

    cost: Array  # mean cost of a step of a vehicle (N,)
    outside: Array  # share of a vehicle's steps with a state outside (N,)
    fallbacks: Array  # share of a vehicle's steps without a plan (N,)
    mean_age_s: Array  # mean age of the newest position (N,) [s]
    max_age_s: Array  # largest age (N,) [s]
    messages: Array  # messages sent (N,)
    vehicle_costs: Array  # mean cost of a step of each vehicle (N, vehicles)


class Choosing(Protocol):
    """Interface of a schedule; implemented by `uavctl.schedule.scheduler.Scheduler`."""

    def add_position(self, number: int, captured_ns: int) -> bool:
        """Note a vehicle's newest position."""
        ...

    def add_feedback(self, number: int, captured_ns: int, at_ns: int) -> None:
        """Note a report."""
        ...

    def choose(self, at_ns: int) -> int | None:
        """Choose the vehicle that is served now."""
        ...


class _LegDecider:
    """Decider of a vehicle that goes to one of two targets and back; `is_away` chooses."""

    def __init__(self, deciders: Sequence[Decider]) -> None:
        self._deciders = deciders
        self.is_away = False

    def decide(self, x: Array, age: int, cov: Array | None = None) -> Decisions:
        """See `Decider`."""
        return self._deciders[self.is_away].decide(x, age, cov)


class _Pilot:
    """Controllers of vehicles with one task, of all runs side by side, with their true states."""

    def __init__(self, vehicle: TaskVehicle, numbers: Sequence[int], runs: int, steps: int) -> None:
        config = vehicle.config
        design = build_conditioned(config, for_flight=False)
        problem, plant = build_problem(config), design.plant
        self.numbers, self.plant, self._problem = list(numbers), plant, problem
        self._targets = [problem.target]
        if vehicle.other_target_m is not None:
            self._targets.append(plant.equilibrium(vehicle.other_target_m))
        self._leg_steps = round(vehicle.leg_s / plant.dt_s)
        self._decider = _LegDecider([ConditionedDecider(design.solver, target) for target in self._targets])
        horizon = config.smpc.horizon
        self._controller = BatchSmpc(self._decider, plant, horizon, horizon, config.fallback.brake_gain_1ps)
        self._runs = runs
        count = runs * len(self.numbers)
        self._controller.begin(count)
        self.states = np.zeros((count, steps + 1, plant.n_x))
        self.states[:, 0] = make_start_state(config, plant)
        self._inputs = np.zeros((count, steps, plant.n_u))
        self.costs, self.is_outside = np.zeros((count, steps)), np.zeros((count, steps), dtype=np.bool_)

    def advance(self, step: int, newest: Counts, disturbance: Array) -> None:
        """Decide on the newest positions (M,), and move all by one step with w (M, n_w)."""
        problem, plant, rows = self._problem, self.plant, np.arange(len(newest))
        is_away = len(self._targets) > 1 and step // self._leg_steps % 2 == 1
        if is_away is not self._decider.is_away:
            self._decider.is_away = is_away
            self._controller.renew()
        target = self._targets[is_away]
        x, information = self.states[:, step], self.states[rows, newest]
        wanted = self._controller.act(Information(step, newest, information, self._inputs[:, :step]))
        u = self._inputs[:, step] = np.clip(wanted, *problem.input_set.bounds)
        after = self.states[:, step + 1] = x @ plant.a.T + u @ plant.b.T + disturbance @ plant.e.T
        dx, du = x - target, u - problem.u_target
        self.costs[:, step] = np.einsum("ni,ij,nj->n", dx, problem.q_x, dx) + np.einsum(
            "ni,ij,nj->n", du, problem.q_u, du
        )
        bounds = problem.state_set.b
        self.is_outside[:, step] = (after @ problem.state_set.c.T > bounds + 1e-9 * (1.0 + np.abs(bounds))).any(axis=1)

    def reshape(self, values: Array) -> Array:
        """Return values of all states (M, …) by run and vehicle (N, vehicles, …)."""
        return values.reshape(self._runs, len(self.numbers), *values.shape[1:])

    @property
    def fallbacks(self) -> Array:
        """Steps without a plan by run and vehicle (N, vehicles)."""
        return self.reshape(self._controller.tally.fallbacks.astype(np.float64))


class _Sender:
    """Sender of one run: budget, schedule, and messages and reports on their way."""

    def __init__(self, world: LinearFleet, schedule: Choosing, draws: Array) -> None:
        self._world, self._schedule, self._draws = world, schedule, draws
        self._channel = BudgetedChannel(make_budget(world.radio))
        self._under_way: list[tuple[int, int, int]] = []  # step that knows it, vehicle, step of the capture
        self._free_ns = 0
        self.newest = np.zeros(len(world.vehicles), dtype=np.intp)
        self.messages = 0

    def receive(self, step: int, report_draws: Array) -> None:
        """Let the vehicles take what has arrived by a step; they report it if they are to."""
        world, before = self._world, self.newest.copy()
        for known_step, number, captured in self._under_way:
            if known_step <= step:
                self.newest[number] = max(self.newest[number], captured)
        self._under_way = [message for message in self._under_way if message[0] > step]
        if not world.radio.feedback_s:
            return
        for number in np.flatnonzero(self.newest > before).tolist():
            if report_draws[number] >= world.radio.loss:
                self._schedule.add_feedback(number, int(self.newest[number]) * world.dt_ns, step * world.dt_ns)

    def send(self, step: int) -> None:
        """Send what the budget carries until the next step."""
        world, begin_ns = self._world, step * self._world.dt_ns
        for number in range(len(world.vehicles)):
            self._schedule.add_position(number, begin_ns)
        at_ns = max(self._free_ns, begin_ns)
        while at_ns < begin_ns + world.dt_ns:
            chosen = self._schedule.choose(at_ns)
            if chosen is None:
                break
            self._channel.occupy(at_ns, world.frame_bytes)
            lost, late = self._draws[self.messages]
            self.messages += 1
            if lost >= world.radio.loss:
                arrival_ns = at_ns + round((world.delay_s + world.jitter_s * late) * SECOND_NS)
                known_step = -((_ROUNDING_NS - arrival_ns) // world.dt_ns)
                self._under_way.append((known_step, chosen, step))
            at_ns += self._channel.compute_remaining_ns(at_ns)
        self._free_ns = at_ns + self._channel.compute_remaining_ns(at_ns)


class LinearFleet:
    """Fleet on one radio.

    Attributes:
        frame_bytes: Length of a message [bytes].

    Args:
        vehicles: Vehicles; equal ones share a controller. All have the same Δt and the same delays.
        radio: Channel, loss and schedule; with `feedback_s` vehicles report.
    """

    def __init__(self, vehicles: Sequence[TaskVehicle], radio: RadioConfig) -> None:
        self.vehicles, self.radio = tuple(vehicles), radio
        first = vehicles[0].config
        self.dt_ns = round(first.plant.dt_s * SECOND_NS)
        self.delay_s, self.jitter_s = first.link.delay_s, first.link.jitter_s
        self.frame_bytes = compute_frame_bytes(signed=radio.signed)

    def fly(
        self,
        steps: int,
        master: int,
        first: int,
        runs: int,
        make_schedule: Callable[[LinearFleet], Choosing] | None = None,
    ) -> FleetRuns:
        """Fly runs `first` … `first` + `runs` - 1.

        Args:
            make_schedule: Makes another schedule for each run; None: that of the radio.
        """
        groups: dict[int, list[int]] = {}  # numbers of equal vehicles, by the first one's
        for number, vehicle in enumerate(self.vehicles):
            groups.setdefault(self.vehicles.index(vehicle), []).append(number)
        pilots = [_Pilot(self.vehicles[number], numbers, runs, steps) for number, numbers in groups.items()]
        parameters = build_schedule_parameters([vehicle.config for vehicle in self.vehicles], self.radio)
        schedules = [RadioSchedule(parameters, 0) for _ in range(runs)]
        chosen = [schedule.scheduler if make_schedule is None else make_schedule(self) for schedule in schedules]
        count, n_w = len(self.vehicles), pilots[0].plant.n_w
        most = 2 + steps * (2 + self.dt_ns // make_budget(self.radio).compute_slot_ns(self.frame_bytes))
        draws = draw_uniform(Stream.LINK, master, first, runs, (most, 2))
        report_draws = draw_uniform(Stream.REPORT, master, first, runs, (steps, count))
        normal = draw_normal(Stream.DISTURBANCE, master, first, runs, (steps, count, n_w))
        senders = [_Sender(self, one, row) for one, row in zip(chosen, draws, strict=True)]
        roots = [compute_root(pilot.plant.w) for pilot in pilots]
        ages = np.zeros((runs, steps, count), dtype=np.intp)
        weight_steps = max(1, round(WEIGHT_STEPS_S * SECOND_NS / self.dt_ns))
        far_m = np.full(count, np.inf)
        for step in range(steps):
            positions_m = self._gather_positions(pilots, step, runs) if step % weight_steps == 0 else None
            for run, sender in enumerate(senders):
                sender.receive(step, report_draws[run, step])
                if positions_m is not None:
                    schedules[run].update_weights(positions_m[run], far_m)
                sender.send(step)
                ages[run, step] = step - sender.newest
            newest = step - ages[:, step]
            for pilot, root in zip(pilots, roots, strict=True):
                disturbance = normal[:, step][:, pilot.numbers] @ root
                pilot.advance(step, newest[:, pilot.numbers].reshape(-1), disturbance.reshape(-1, n_w))
        return self._collect(pilots, ages, senders)

    def _gather_positions(self, pilots: Sequence[_Pilot], step: int, runs: int) -> Array:
        positions_m = np.full((runs, len(self.vehicles), 3), np.inf)
        for pilot in pilots:
            states = pilot.reshape(pilot.states[:, step])
            index = list(pilot.plant.position_index)
            positions_m[:, pilot.numbers, : len(index)] = states[:, :, index]
        return positions_m

    def _collect(self, pilots: Sequence[_Pilot], ages: Counts, senders: Sequence[_Sender]) -> FleetRuns:
        runs, steps, count = ages.shape
        costs, outside, fallbacks = np.zeros((3, runs, count))
        for pilot in pilots:
            costs[:, pilot.numbers] = pilot.reshape(pilot.costs).mean(axis=2)
            outside[:, pilot.numbers] = pilot.reshape(pilot.is_outside.astype(np.float64)).mean(axis=2)
            fallbacks[:, pilot.numbers] = pilot.fallbacks / steps
        age_s = ages * self.dt_ns / SECOND_NS
        return FleetRuns(
            cost=costs.mean(axis=1),
            outside=outside.mean(axis=1),
            fallbacks=fallbacks.mean(axis=1),
            mean_age_s=age_s.mean(axis=(1, 2)),
            max_age_s=age_s.max(axis=(1, 2)),
            messages=np.array([float(sender.messages) for sender in senders]),
            vehicle_costs=costs,
        )


def make_report_delay_s(config: Config) -> float:
    """Return the longest time from a message to its report [s]: delay, jitter, and the wait for a step."""
    return config.link.delay_s + config.link.jitter_s + config.plant.dt_s
