"""One flight of the true vehicle in lockstep, and what it came to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from sim.world import World
from uavctl.build import build_controller, design_of
from uavctl.config import Config
from uavctl.config.mission import TrajectoryConfig
from uavctl.data import ControlMode, Decision, Flyer, Outgoing, Plan, Record, Setpoint, Vec3
from uavctl.flight.controller import Controller
from uavctl.library_store import library_for
from uavctl.loop import ControlLoop
from uavctl.smpc.design import Design
from uavctl.trial.case import TrialCell, believed, blackout_s, flown, length_s
from uavctl.trial.metrics import beyond_m, distances_m, largest, mean, rms_m, settled_s
from uavctl.trial.own_loop import Moment, OwnLoop, Path
from uavctl.trial.room import room_of

Array = NDArray[np.float64]

NEAR_M, NEARER_M = 0.3, 0.1  # of the target
SLACK = 1e-6  # more is slack that was used
_CONTROLLERS = 8  # kept at hand: their solvers take a second each to make


@dataclass(frozen=True)
class TrialFlight:
    """What one flight came to; NaN where a figure says nothing of its scenario.

    Attributes:
        seed: Of the flight.
        hold_rms_m: Distance of the true position from the target once it is to hold it, root mean square.
        hold_max_m: The largest.
        near_s: From when on it stayed within 0.3 m of the target; counted from the first order to fly there.
        nearer_s: The same for 0.1 m.
        beyond_m: Furthest beyond a wall of the room; negative is the room that was left.
        tracking_m: Distance from where the motion wanted it at the time, mean.
        tracking_max_m: The largest.
        blackout_beyond_m: Furthest beyond a wall from a blackout's begin on.
        limited: Share of setpoints that the last gate changed.
        gave_way: Share of plans in which a constraint gave way.
        fallback: Share of ticks, from the first order on, in which no plan was flown.
        positions: That arrived.
        mode: Of the vehicle at the end.
    """

    seed: int
    hold_rms_m: float = math.nan
    hold_max_m: float = math.nan
    near_s: float = math.nan
    nearer_s: float = math.nan
    beyond_m: float = math.nan
    tracking_m: float = math.nan
    tracking_max_m: float = math.nan
    blackout_beyond_m: float = math.nan
    limited: float = math.nan
    gave_way: float = math.nan
    fallback: float = math.nan
    positions: int = 0
    mode: str = ""


@dataclass
class WatchedFlyer:
    """The true motion, tick by tick, under whoever flies; implements `uavctl.data.Flyer`.

    Attributes:
        flyer: Who flies.
        where: Gives the true position.
        times_s: Of the ticks.
        positions_m: True positions at these times.
    """

    flyer: Flyer
    where: Callable[[], Vec3] = lambda: (math.nan, math.nan, math.nan)
    times_s: list[float] = field(default_factory=list)
    positions_m: list[Vec3] = field(default_factory=list)

    def receive(self, link: str, data: bytes, at_ns: int) -> Iterable[Outgoing]:
        """Take a datagram."""
        return self.flyer.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int) -> Iterator[Outgoing]:
        """Look where the vehicle is, and run the tick."""
        self.times_s.append(at_ns * 1e-9)
        self.positions_m.append(self.where())
        yield from self.flyer.tick(tick, at_ns)


@dataclass
class FlightTally:
    """A sink that counts what tells how a controller of ours fared.

    Attributes:
        begun_ns: Time of the first decision with somewhere to go to; None before.
        setpoints: That were sent.
        limited: Of them, that the last gate changed.
        plans: That were made.
        gave_way: Of them, that a constraint gave way in.
        ticks: From the first such decision on.
        fallen: Of them, in which no plan was flown.
        positions: That ticks were given.
    """

    begun_ns: int | None = None
    setpoints: int = 0
    limited: int = 0
    plans: int = 0
    gave_way: int = 0
    ticks: int = 0
    fallen: int = 0
    positions: int = 0

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        """Count a record."""
        del topic
        if isinstance(record, Setpoint):
            self.setpoints += 1
            self.limited += bool(record.limited)
        elif isinstance(record, Plan):
            self.plans += 1
            self.gave_way += bool(record.gave_way) or record.slack > SLACK
        elif isinstance(record, Decision):
            self.positions += record.accepted + record.rejected
            if self.begun_ns is None and record.target is not None:
                self.begun_ns = at_ns
            self.ticks += self.begun_ns is not None
            self.fallen += self.begun_ns is not None and record.mode is not ControlMode.TRACK


def fly(cell: TrialCell, seed: int, *, seconds: float, from_s: float) -> TrialFlight:
    """Fly once and judge it by the truth.

    Args:
        cell: What is flown.
        seed: Of every random draw.
        seconds: Length of the flight; a figure of eight has its own.
        from_s: From when on the vehicle is to hold its place.

    Raises:
        ConfigError: An override is none.
        DesignError: There is no such controller.
    """
    seconds = length_s(cell.scenario, seconds)
    config = flown(cell, seed, seconds)
    return _fly_ours(cell, config, from_s) if cell.pilot.own is None else _fly_own(cell, config, from_s)


def _fly_ours(cell: TrialCell, config: Config, from_s: float) -> TrialFlight:
    told = FlightTally()
    knows = believed(cell)
    watched = WatchedFlyer(ControlLoop(knows, controller_of(knows), told, lambda: 0))
    world = _flown(config, watched)
    begun_s = None if told.begun_ns is None else told.begun_ns * 1e-9
    return _judged(
        cell,
        config,
        watched,
        begun_s,
        from_s,
        limited=_share(told.limited, told.setpoints),
        gave_way=_share(told.gave_way, told.plans),
        fallback=_share(told.fallen, told.ticks),
        positions=told.positions,
        mode=world.peers.autopilot.mode_name,
    )


def _fly_own(cell: TrialCell, config: Config, from_s: float) -> TrialFlight:
    own = own_loop(cell, config)
    watched = WatchedFlyer(own)
    world = _flown(config, watched, own)
    return _judged(
        cell,
        config,
        watched,
        None if own.begun_ns is None else own.begun_ns * 1e-9,
        from_s,
        positions=len(own.samples),
        mode=world.peers.autopilot.mode_name,
    )


def own_loop(cell: TrialCell, config: Config) -> OwnLoop:
    """The vehicle's own loop, as a cell asks for it."""
    assert cell.pilot.own is not None
    path = path_of(config.mission.trajectory) if cell.scenario == "eight" else None
    return OwnLoop(config, cell.pilot.own, config.target.position_m, path)


def _flown(config: Config, watched: WatchedFlyer, own: OwnLoop | None = None) -> World:
    world = World(config, watched)
    vehicle = world.peers.vehicle
    watched.where = lambda: vehicle.position_m
    if own is not None:
        own.board(world.peers.autopilot)
    world.run(config.duration_s)
    return world


@lru_cache(maxsize=_CONTROLLERS)
def controller_of(config: Config) -> Controller:
    """A controller of ours.

    Raises:
        DesignError: There is none.
    """
    design = design_of(config)
    library = library_for(design).library if config.uses_library and isinstance(design, Design) else None
    return build_controller(config, design, library)


def path_of(motion: TrajectoryConfig) -> Path:
    """A sampled motion as a function of time, at rest before its begin and after its end."""
    times = np.array(motion.times_s)
    spline = CubicHermiteSpline(times, np.array(motion.positions_m), np.array(motion.velocities_mps))
    speed, change = spline.derivative(), spline.derivative(2)

    def at(since_s: float) -> Moment:
        moves = times[0] <= since_s < times[-1]
        place = spline(min(max(since_s, times[0]), times[-1]))
        velocity, accel = (speed(since_s), change(since_s)) if moves else (np.zeros(3), np.zeros(3))
        return _vec3(place), _vec3(velocity), _vec3(accel)

    return at


def _judged(
    cell: TrialCell,
    config: Config,
    watched: WatchedFlyer,
    begun_s: float | None,
    from_s: float,
    **counts: float | int | str,
) -> TrialFlight:
    times, where = np.array(watched.times_s), np.array(watched.positions_m)
    beyond = beyond_m(where, *room_of(config))
    found: dict[str, float] = {"beyond_m": largest(beyond)}
    if begun_s is None:
        pass
    elif cell.scenario == "eight":
        path = path_of(config.mission.trajectory)
        flies = (times >= begun_s) & (times <= begun_s + config.mission.trajectory.times_s[-1])
        wanted = np.array([path(t - begun_s)[0] for t in times[flies]])
        off = distances_m(where[flies], wanted)
        found |= {"tracking_m": mean(off), "tracking_max_m": largest(off)}
    else:
        flies = times >= begun_s
        off = distances_m(where, np.array(config.target.position_m))
        held = off[times >= from_s]
        found |= {
            "hold_rms_m": rms_m(held),
            "hold_max_m": largest(held),
            "near_s": settled_s(times[flies] - begun_s, off[flies], NEAR_M),
            "nearer_s": settled_s(times[flies] - begun_s, off[flies], NEARER_M),
        }
    if cell.scenario == "blackout":
        found["blackout_beyond_m"] = largest(beyond[times >= blackout_s(config.sim.seed)])
    return TrialFlight(seed=config.sim.seed, **found, **counts)  # type: ignore[arg-type]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _vec3(values: Array) -> Vec3:
    north, east, down = np.asarray(values, dtype=np.float64).tolist()
    return north, east, down
