"""A mission with the preset of each autopilot: take-off, four waypoints, landing, in gusts, over a bursty link."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from soak_rig import LoopWatch, fly, prepare_room

from sim.simulation import World
from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.records import ControlMode
from uavctl.wiring.controller import Prepared

AUTOPILOTS = ("px4", "ardupilot")
TAKE_OFF_M = 1.2
# 30 % of the packets are lost, more than half of them in a bad state that lasts two on average.
LINK = (
    "link.model=gilbert-elliott",
    "link.loss=0.2",
    "link.burst_enter=0.1",
    "link.burst_leave=0.5",
    "link.burst_loss=0.8",
    "link.delay_s=0.02",
    "link.jitter_s=0.1",
)
MISSION = (
    *LINK,
    "duration_s=240",
    "sim.plant=quadrotor",
    "sim.wind.velocity_mps=[0.6, -0.4, 0.0]",
    "sim.wind.gust_wind_mps=3.0",
    "mission.waypoints=[[1.5, 1.0, -1.2], [1.5, -1.2, -1.6], [-1.5, -1.2, -1.0], [-1.5, 1.2, -1.4]]",
    "mission.hold_s=3.0",
    "mission.then=land",
)
HELD_S = 2.0  # the end of the time at a waypoint, 3 s after the arrival
ON_FLOOR_M = 0.01
FLIES = (ControlMode.TRACK, ControlMode.BRAKE, ControlMode.HOLD)


@dataclass(frozen=True)
class Leg:
    """How well one waypoint was flown.

    Attributes:
        seconds: From the decision for it to the one for the next.
        plan_rms_m: Distance of the true position from where the plan wanted it, at Δt boundaries, root mean square.
        plan_max_m: The largest.
        hold_rms_m: Distance from the waypoint in the last HELD_S at it, root mean square.
        hold_max_m: The largest.
    """

    seconds: float
    plan_rms_m: float
    plan_max_m: float
    hold_rms_m: float
    hold_max_m: float


@dataclass(frozen=True)
class MissionFlight:
    """One mission, as the truth has it.

    Attributes:
        autopilot: Whose behaviour the simulated vehicle shows.
        seed: Of the flight.
        clearance_m: Least distance from a wall in each tick, ceiling and (while a plan is flown) floor too; negative is
            through it.
        nearest: Which one that was.
        landed: Whether it ended on the floor, disarmed, with all waypoints reached.
        seconds: Length of the flight.
        max_age: Largest age of information [steps].
        legs: One a waypoint.
        unexplained_mps2: Largest acceleration that positions showed beside what was sent.
        apart_mps: Largest difference of their velocity from the vehicle's own.
        alarms: What the envelope took for impossible, each a false alarm.
        wrong: What it did and should not have.
    """

    autopilot: str
    seed: int
    clearance_m: float
    nearest: str
    landed: bool
    seconds: float
    max_age: int
    legs: tuple[Leg, ...]
    unexplained_mps2: float
    apart_mps: float
    alarms: tuple[str, ...]
    wrong: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether nothing was touched and all was flown."""
        return self.landed and not self.wrong and not self.alarms and self.clearance_m > 0.0


class _Ground:
    """Where the vehicle was, tick by tick, against walls, plan and waypoints."""

    def __init__(self, prepared: Prepared) -> None:
        config, index = prepared.config, prepared.controller.plant.position_index
        self._lower = np.array([config.sets.state_lower[i] for i in index])
        self._upper = np.array([config.sets.state_upper[i] for i in index])
        self._index = list(index)
        self._held = round(HELD_S / config.daemon.tick_s)
        self.clearance_m, self.nearest, self.max_age = math.inf, "", 0
        self.unexplained_mps2 = self.apart_mps = 0.0
        self.plan: dict[int, list[float]] = {}
        self.away: dict[int, list[float]] = {}
        self._of_plan: Sequence[Sequence[float]] = ()

    def look(self, world: World, watch: LoopWatch, at_ns: int) -> None:
        """After a tick."""
        decision = None if watch.ticked is None else watch.ticked.decision
        place = np.array(world.peers.vehicle.position_m)
        flies = decision is not None and decision.mode in FLIES
        self._walls(place, at_ns, flies=flies)
        if decision is None or not flies:
            return
        self.max_age = max(self.max_age, decision.age_steps or 0)
        self.unexplained_mps2 = max(self.unexplained_mps2, decision.unexplained_mps2 or 0.0)
        self.apart_mps = max(self.apart_mps, decision.apart_mps or 0.0)
        if decision.waypoint is None or decision.target is None or decision.mode is not ControlMode.TRACK:
            return
        away = float(np.linalg.norm(place - np.array(decision.target)[self._index]))
        self.away.setdefault(decision.waypoint, []).append(away)
        if decision.boundary and decision.plan_index is not None and watch.plan is not None:
            wanted = np.array(watch.plan.states[decision.plan_index])[self._index]
            self.plan.setdefault(decision.waypoint, []).append(float(np.linalg.norm(place - wanted)))

    def _walls(self, place: Array, at_ns: int, *, flies: bool) -> None:
        names = ("south", "west", "ceiling", "north", "east", "floor")
        rooms = np.concatenate([place - self._lower, self._upper - place])
        if not flies:
            rooms[names.index("floor")] = math.inf
        k = int(np.argmin(rooms))
        if rooms[k] < self.clearance_m:
            self.clearance_m, self.nearest = float(rooms[k]), f"{names[k]} at {at_ns * 1e-9:.1f} s"

    def legs(self, tick_s: float) -> tuple[Leg, ...]:
        """Of the whole flight."""
        return tuple(
            Leg(len(away) * tick_s, *_spread(self.plan.get(number, [])), *_spread(away[-self._held :]))
            for number, away in sorted(self.away.items())
        )


def _spread(values: Sequence[float]) -> tuple[float, float]:
    """Root mean square and largest; NaN of nothing."""
    if not values:
        return math.nan, math.nan
    return float(np.sqrt(np.mean(np.square(values)))), max(values)


def prepare_mission(autopilot: str) -> Prepared:
    """Design and controller of the mission with the autopilot's preset."""
    return prepare_room(*MISSION, preset=f"room-{autopilot}")


def fly_mission(prepared: Prepared, seed: int, path: Path | None = None) -> MissionFlight:
    """Fly it once.

    Args:
        prepared: `prepare_mission` of the autopilot.
        seed: Of every draw.
        path: Recording; None for none.
    """
    autopilot = prepared.config.sim.autopilot
    config = load_config(f"room-{autopilot}", [*MISSION, f"sim.seed={seed}"])
    ground = _Ground(prepared)
    worlds: list[World] = []

    def look(world: World, watch: LoopWatch, at_ns: int) -> None:
        worlds[:] = [world]
        ground.look(world, watch, at_ns)

    watch = fly(prepared, config, look, take_off_m=TAKE_OFF_M, path=path)
    tick_s, vehicle = config.daemon.tick_s, None if watch.ticked is None else watch.ticked.vehicle
    down = worlds[0].peers.vehicle.position_m[2] > -ON_FLOOR_M and vehicle is not None and not vehicle.armed
    return MissionFlight(
        autopilot=autopilot,
        seed=seed,
        clearance_m=ground.clearance_m,
        nearest=ground.nearest,
        landed=down and len(ground.away) == len(config.mission.waypoints),
        seconds=watch.ticks * tick_s,
        max_age=ground.max_age,
        legs=ground.legs(tick_s),
        unexplained_mps2=ground.unexplained_mps2,
        apart_mps=ground.apart_mps,
        alarms=tuple(watch.alarms),
        wrong=tuple(watch.wrong),
    )


def summary(flights: Sequence[MissionFlight]) -> dict[str, object]:
    """Figures of one autopilot's missions; worst seeds by name."""
    worst = min(flights, key=lambda flight: flight.clearance_m)
    legs = []
    for number in range(max(len(flight.legs) for flight in flights)):
        flown = [flight.legs[number] for flight in flights if len(flight.legs) > number]
        row: dict[str, float] = {}
        for key in ("seconds", "plan_rms_m", "plan_max_m", "hold_rms_m", "hold_max_m"):
            values = [getattr(leg, key) for leg in flown]
            row[key], row[f"{key}_worst"] = float(np.median(values)), float(np.max(values))
        legs.append(row)
    return {
        "flights": len(flights),
        "touched": sum(flight.clearance_m <= 0.0 for flight in flights),
        "landed": sum(flight.landed for flight in flights),
        "wrong": {str(flight.seed): flight.wrong for flight in flights if flight.wrong},
        "clearance_m": float(np.median([flight.clearance_m for flight in flights])),
        "clearance_m_worst": worst.clearance_m,
        "worst": f"seed {worst.seed}, {worst.nearest}",
        "unexplained_mps2": float(np.median([flight.unexplained_mps2 for flight in flights])),
        "unexplained_mps2_worst": max(flight.unexplained_mps2 for flight in flights),
        "apart_mps": float(np.median([flight.apart_mps for flight in flights])),
        "apart_mps_worst": max(flight.apart_mps for flight in flights),
        "alarms": {str(flight.seed): flight.alarms for flight in flights if flight.alarms},
        "max_age": max(flight.max_age for flight in flights),
        "legs": legs,
    }
