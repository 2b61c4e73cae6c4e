"""Trials with the simulated quadrotor: case, flight, figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from statistics import median
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import brentq

from sim.simulation import World
from uavctl.build.controller import build_conditioned, build_controller, build_plant, resting
from uavctl.build.mission import build_rests, resting_places
from uavctl.config import Config, load_config, parse
from uavctl.config.checks import get_position_limits_m
from uavctl.config.mission import TrajectoryConfig
from uavctl.flight.controller import Controller
from uavctl.lab.own_loop import Moment, OwnLoop, OwnTuning, Path
from uavctl.loop import ControlLoop
from uavctl.records import ControlMode, Decision, Flyer, Plan, Received, Record, Send, Setpoint, Vec3
from uavctl.smpc.conditioned.planner import AnyDesign
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.plant import AXES

# A figure of eight with a given mean and largest speed, from rest to rest, as a trajectory of the configuration.
#
# Speeds and rounds are those of J. A. Preiss, W. Hönig, G. S. Sukhatme and N. Ayanian, "Crazyswarm: A large
# nano-quadcopter swarm", ICRA 2017: three times around, 0.76 m/s in the mean, 1.5 m/s at most. The curve is our own:
# (a sin θ, b sin θ cos θ), and θ runs faster through the crossing than around the tips.


Array = NDArray[np.float64]

MEAN_MPS, LARGEST_MPS, ROUNDS = 0.76, 1.5, 3
CENTRE_M: Vec3 = (0.0, 0.0, -1.2)
HALF_M, WIDTH_M = 1.0, 1.0  # a and b: 2 m long, 1 m wide
RAMP_S = 2.0  # from rest to full speed, and back
_FINE = 20_000  # points of a round by which its length and time are found
_SAMPLE_S = 0.05


@lru_cache(maxsize=1)
def eight() -> TrajectoryConfig:
    """Return the figure of eight as a sampled trajectory with velocities."""
    times, positions, velocities = motion(_SAMPLE_S)
    return TrajectoryConfig(
        times_s=tuple(times.tolist()),
        positions_m=tuple(vec3(row) for row in positions),
        velocities_mps=tuple(vec3(row) for row in velocities),
    )


def motion(step_s: float) -> tuple[Array, Array, Array]:
    """Return times (n,) [s], positions (n, 3) [m] and velocities (n, 3) [m/s] of the figure of eight, its end last."""
    angle, rate, over_s = _schedule()
    times = np.append(np.arange(0.0, over_s, step_s), over_s)
    done = np.interp(times, *angle)
    speed = _speed(done, rate) * _eased(times, over_s)
    north, east = HALF_M * np.sin(done), 0.5 * WIDTH_M * np.sin(2.0 * done)
    ahead = np.column_stack([HALF_M * np.cos(done), WIDTH_M * np.cos(2.0 * done), np.zeros_like(done)])
    positions = np.column_stack([north, east, np.zeros_like(done)]) + np.array(CENTRE_M)
    return times, positions, ahead * speed[:, None]


def _speed(angle: Array, rate: tuple[float, float]) -> Array:
    """Return θ' at full speed [1/s]: a mean rate, faster where the figure crosses itself."""
    base, faster = rate
    return np.asarray(base * (1.0 + faster * np.cos(2.0 * angle)))


def _eased(times: Array, over_s: float) -> Array:
    """Return the share of full speed (n,): smooth from 0 to 1 and back."""
    near = np.clip(np.minimum(times, over_s - times) / RAMP_S, 0.0, 1.0)
    return np.asarray(near * near * near * (10.0 - 15.0 * near + 6.0 * near * near))


def _schedule() -> tuple[tuple[Array, Array], tuple[float, float], float]:
    """Return θ over time, the rate, and the length of the motion [s]."""
    fastest = math.hypot(HALF_M, WIDTH_M)

    def made(faster: float) -> tuple[tuple[Array, Array], tuple[float, float], float]:
        rate = (LARGEST_MPS / (fastest * (1.0 + faster)), faster)
        angle = np.linspace(0.0, 2.0 * math.pi * ROUNDS, ROUNDS * _FINE + 1)
        # Time at full speed; easing in and out takes RAMP_S longer in all, half of it at each end.
        slow = 1.0 / _speed(angle, rate)
        full = np.concatenate([[0.0], np.cumsum(0.5 * (slow[1:] + slow[:-1]) * np.diff(angle))])
        over_s = float(full[-1]) + RAMP_S
        times = np.linspace(0.0, over_s, 4 * _FINE)
        eased = _eased(times, over_s)
        flown = np.concatenate([[0.0], np.cumsum(0.5 * (eased[1:] + eased[:-1]) * np.diff(times))])
        return (times, np.interp(flown * (full[-1] / flown[-1]), full, angle)), rate, over_s

    def missed(faster: float) -> float:
        return _length() * ROUNDS / made(faster)[2] - MEAN_MPS

    return made(float(brentq(missed, -0.5, 0.8, xtol=1e-6)))


def _length() -> float:
    """Return the length of one round [m]."""
    angle = np.linspace(0.0, 2.0 * math.pi, _FINE + 1)
    points = np.column_stack([HALF_M * np.sin(angle), 0.5 * WIDTH_M * np.sin(2.0 * angle)])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


# What is flown in a trial: who flies, what, with whom, in which air and over which link. Plain and picklable.


Scenario = Literal["hold", "eight", "blackout"]
AutopilotName = Literal["px4", "ardupilot"]
Air = Literal["calm", "gusts", "strong-gusts"]

SCENARIOS: tuple[Scenario, ...] = ("hold", "eight", "blackout")
AUTOPILOTS: tuple[AutopilotName, ...] = ("px4", "ardupilot")
WIND_MPS: Vec3 = (0.6, -0.36, 0.0)  # 0.7 m/s, wherever there are gusts
GUST_WIND_MPS: dict[Air, float] = {"calm": 0.0, "gusts": 3.0, "strong-gusts": 8.0}
BLACKOUT_S = 4.0
BLACKOUT_BEGINS_S = (1.0, 6.0)  # the way of preset `room` takes about as long
_MOMENT = 1  # child of a flight's seed that draws when a blackout begins
EIGHT_MORE_S = 2.0  # after the end of the figure of eight


@dataclass(frozen=True)
class TrialPilot:
    """Pilot of a trial: a controller of ours, or the vehicle's own loop."""

    name: str  # what it is called
    config: str = "room"  # preset or file that it is made from; what messages call it, where there is a text
    overrides: tuple[str, ...] = ()  # overrides of that configuration
    own: OwnTuning | None = None  # how the vehicle is set up that flies by its own position loop; None where ours flies
    knows_link: bool = False  # whether it is designed for the link that it meets; else for that of its configuration
    text: str = ""  # TOML text that it is made from instead, for who has not the file; empty for none

    def load(self, overrides: Sequence[str]) -> Config:
        """Load the pilot's configuration with its own and further overrides.

        Raises:
            ConfigError: An override is none.
        """
        every = (*self.overrides, *overrides)
        return parse(self.text, self.config, every).config if self.text else load_config(self.config, every)


@dataclass(frozen=True)
class TrialCell:
    """Cell of trials: flights that differ in their seed alone."""

    pilot: TrialPilot  # who flies
    scenario: Scenario  # what
    autopilot: AutopilotName  # whose behaviour the vehicle shows
    rate_hz: float  # of the cameras
    link_name: str  # what the link is called
    link: tuple[str, ...]  # overrides that make it
    air: Air  # calm, or wind with gusts (`GUST_WIND_MPS`)


def flown(cell: TrialCell, seed: int, seconds: float) -> Config:
    """Return the configuration that a flight meets: simulator, link and mission.

    Raises:
        ConfigError: An override is none.
    """
    wind = (0.0, 0.0, 0.0) if cell.air == "calm" else WIND_MPS
    more = [
        f"duration_s={seconds}",
        "sim.plant=quadrotor",
        f"sim.autopilot={cell.autopilot}",
        f"sim.seed={seed}",
        f"sim.camera.rate_hz={cell.rate_hz}",
        f"sim.wind.velocity_mps={list(wind)}",
        f"sim.wind.gust_wind_mps={GUST_WIND_MPS[cell.air]}",
        *cell.link,
    ]
    if cell.scenario == "blackout":
        begin = blackout_s(seed)
        more.append(f"link.blackout=[[{begin}, {begin + BLACKOUT_S}]]")
    return _with_mission(cell.pilot.load(more), cell.scenario)


def believed(cell: TrialCell) -> Config:
    """Return the configuration that a controller of ours is made from.

    Raises:
        ConfigError: An override is none.
    """
    overrides = (f"sim.autopilot={cell.autopilot}", *(cell.link if cell.pilot.knows_link else ()))
    return _with_mission(cell.pilot.load(overrides), cell.scenario)


def blackout_s(seed: int) -> float:
    """Return when a flight's blackout begins [s]: a random moment on the way, the same for all pilots."""
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(_MOMENT + 1)[_MOMENT])
    return round(float(rng.uniform(*BLACKOUT_BEGINS_S)), 3)


def length_s(scenario: Scenario, seconds: float) -> float:
    """Return how long a flight lasts [s]: a figure of eight is flown to its end."""
    return eight().times_s[-1] + EIGHT_MORE_S if scenario == "eight" else seconds


def _with_mission(config: Config, scenario: Scenario) -> Config:
    """Return the configuration with the figure of eight as mission from its centre, if that is flown."""
    if scenario != "eight":
        return config
    replace = msgspec.structs.replace
    return replace(
        config,
        mission=replace(config.mission, waypoints=(), trajectory=eight(), then="hold"),
        sim=replace(config.sim, start_position_m=CENTRE_M, start_velocity_mps=(0.0, 0.0, 0.0)),
        target=replace(config.target, position_m=CENTRE_M),
    )


# The figures of a flight that tables show, by scenario; in all of them the larger, the worse.


@dataclass(frozen=True)
class Shown:
    """Display of a figure in a table."""

    key: str  # its name in `TrialFlight`
    heading: str  # over its column
    factor: float  # to the column's unit
    digits: int  # after the point

    def told(self, values: Sequence[float]) -> str:
        """Return median and worst of some flights; a dash where the figure does not apply to one."""
        if not values or any(map(math.isnan, values)):
            return "-"
        mid, worst = self.factor * median(values), self.factor * max(values)
        return f"{mid:.{self.digits}f} ({worst:.{self.digits}f})"


HOLD = Shown("hold_rms_m", "hold rms cm", 100.0, 1)
NEAR = Shown("near_s", "to 0.3 m s", 1.0, 1)
BEYOND = Shown("beyond_m", "beyond wall m", 1.0, 2)
COUNTS = (
    Shown("limited", "limited %", 100.0, 0),
    Shown("gave_way", "gave way %", 100.0, 1),
    Shown("fallback", "fallback %", 100.0, 1),
)
SHOWN: dict[Scenario, tuple[Shown, ...]] = {
    "hold": (
        HOLD,
        Shown("hold_max_m", "hold max cm", 100.0, 1),
        NEAR,
        Shown("nearer_s", "to 0.1 m s", 1.0, 1),
        BEYOND,
        *COUNTS,
    ),
    "eight": (
        Shown("tracking_m", "tracking cm", 100.0, 1),
        Shown("tracking_max_m", "tracking max cm", 100.0, 1),
        BEYOND,
        *COUNTS,
    ),
    "blackout": (Shown("blackout_beyond_m", "beyond wall m", 1.0, 2), HOLD, NEAR, *COUNTS),
}
MEANING = (
    "Median, and the worst in brackets. Hold: distance of the true position from the target from the time on when it "
    "is to be held. To 0.3 m, to 0.1 m: from when on it stayed so near, counted from the first order. Tracking: "
    "distance from where the motion was to be at the time, mean and largest. Beyond wall: furthest beyond a limit of "
    "the position; negative is the room that was left; with a blackout, from its begin on. Limited: share of setpoints "
    "that the last gate changed. Gave way: share of plans in which a constraint gave way. Fallback: share of ticks in "
    "which no plan was flown."
)


# What a flight came to, from where the vehicle truly was. Pure; lengths in metres, times in seconds.


def distances_m(positions: Array, wanted: Array) -> Array:
    """Return the distance (n,) [m] of positions (n, 3) from where they were wanted, (3,) or (n, 3)."""
    return np.asarray(np.linalg.norm(positions - wanted, axis=1))


def rms_m(distances: Array) -> float:
    """Return the root mean square [m]; NaN of no values."""
    return float(np.sqrt(np.mean(distances**2))) if distances.size else math.nan


def largest(values: Array) -> float:
    """Return the largest value; NaN of no values."""
    return float(values.max()) if values.size else math.nan


def mean(values: Array) -> float:
    """Return the mean; NaN of no values."""
    return float(values.mean()) if values.size else math.nan


def settled_s(times: Array, distances: Array, radius_m: float) -> float:
    """Return the time from which the vehicle stays within a radius to the end [s]; infinite if it ends outside.

    Args:
        times: (n,), increasing.
        distances: From the target at these times (n,).
    """
    outside = np.flatnonzero(distances > radius_m)
    if not outside.size:
        return float(times[0])
    last = int(outside[-1])
    return math.inf if last + 1 == len(times) else float(times[last + 1])


def beyond_m(positions: Array, lower: Array, upper: Array) -> Array:
    """Return how far positions (n, 3) are beyond the nearest wall (n,) [m]; negative is the room left.

    Args:
        positions: (n, 3).
        lower: Least position in the room (3,), minus infinity where there is no wall.
    """
    return np.asarray(np.maximum(lower - positions, positions - upper).max(axis=1))


# The room of a configuration, and what of it a controller can use.


def room_of(config: Config) -> tuple[Array, Array]:
    """Return the least and the largest position in the room (3,) [m]; infinite where there is no wall."""
    limits = get_position_limits_m(config)
    lower, upper = np.array([limits.get(axis, (-np.inf, np.inf)) for axis in AXES]).T
    return lower, upper


def usable_room(config: Config, design: AnyDesign) -> float:
    """Return the share of the room in which a plan may rest, with estimation error; NaN where a wall is open.

    Raises:
        DesignError: There is no such scheme.
    """
    return _volume_share(config, *resting_places(design.plant, design.state_set, resting(design)))


def usable_seen(config: Config, design: Design | None) -> float:
    """Return the share of the room in which a plan may rest if the state is known, as in the linear world.

    Raises:
        DesignError: There is no such scheme.
    """
    if design is not None:
        return _volume_share(config, *resting_places(design.plant, design.state_set, build_rests(design)))
    n_x = build_plant(config).n_x
    exact = build_conditioned(config, flown=False, cov=np.zeros((n_x, n_x)))
    return _volume_share(config, *resting_places(exact.plant, exact.state_set, exact.rest_limits))


def _volume_share(config: Config, least: Array, most: Array) -> float:
    axes = [AXES.index(axis) for axis in config.plant.axes]
    lower, upper = room_of(config)
    whole = (upper - lower)[axes]
    return float(np.prod(np.clip(most - least, 0.0, None) / whole)) if np.isfinite(whole).all() else math.nan


# One flight of the true vehicle in lockstep, and what it came to.


NEAR_M, NEARER_M = 0.3, 0.1  # of the target
SLACK = 1e-6  # more is slack that was used
_CONTROLLERS = 8  # kept at hand: their solvers take a second each to make


@dataclass(frozen=True)
class TrialFlight:
    """Figures of one flight; NaN where a figure does not apply to its scenario."""

    seed: int  # of the flight
    # Distance of the true position from the target once it is to hold it, root mean square
    hold_rms_m: float = math.nan
    hold_max_m: float = math.nan  # the largest
    # From when on it stayed within 0.3 m of the target; counted from the first order to fly there
    near_s: float = math.nan
    nearer_s: float = math.nan  # the same for 0.1 m
    beyond_m: float = math.nan  # furthest beyond a wall of the room; negative is the room that was left
    tracking_m: float = math.nan  # distance from where the motion wanted it at the time, mean
    tracking_max_m: float = math.nan  # the largest
    blackout_beyond_m: float = math.nan  # furthest beyond a wall from a blackout's begin on
    limited: float = math.nan  # share of setpoints that the last gate changed
    gave_way: float = math.nan  # share of plans in which a constraint gave way
    fallback: float = math.nan  # share of ticks, from the first order on, in which no plan was flown
    positions: int = 0  # that arrived
    mode: str = ""  # of the vehicle at the end


@dataclass
class WatchedFlyer:
    """Flyer that records the true motion tick by tick; implements `uavctl.records.Flyer`."""

    flyer: Flyer  # who flies
    where: Callable[[], Vec3] = lambda: (math.nan, math.nan, math.nan)  # gives the true position
    times_s: list[float] = field(default_factory=list)  # of the ticks
    positions_m: list[Vec3] = field(default_factory=list)  # true positions at these times

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take a datagram."""
        return self.flyer.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Record where the vehicle is, and run the tick."""
        self.times_s.append(at_ns * 1e-9)
        self.positions_m.append(self.where())
        self.flyer.tick(tick, at_ns, send)


@dataclass
class FlightTally:
    """Sink that counts how a controller of ours fares: limited setpoints, plans that gave way, fallback."""

    begun_ns: int | None = None  # time of the first decision with somewhere to go to; None before
    setpoints: int = 0  # that were sent
    limited: int = 0  # setpoints that the last gate changed
    plans: int = 0  # that were made
    gave_way: int = 0  # plans in which a constraint gave way
    ticks: int = 0  # from the first such decision on
    fallen: int = 0  # ticks in which no plan was flown
    positions: int = 0  # that ticks were given

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
    """Fly once; return the figures by the true motion.

    Args:
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
    """Return the vehicle's own loop, as a cell asks for it."""
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
    """Return a controller of ours.

    Raises:
        DesignError: There is none.
    """
    return build_controller(config)


def path_of(motion: TrajectoryConfig) -> Path:
    """Return a sampled motion as a function of time, at rest before its begin and after its end."""
    times = np.array(motion.times_s)
    spline = CubicHermiteSpline(times, np.array(motion.positions_m), np.array(motion.velocities_mps))
    speed, change = spline.derivative(), spline.derivative(2)

    def at(since_s: float) -> Moment:
        moves = times[0] <= since_s < times[-1]
        place = spline(min(max(since_s, times[0]), times[-1]))
        velocity, accel = (speed(since_s), change(since_s)) if moves else (np.zeros(3), np.zeros(3))
        return vec3(place), vec3(velocity), vec3(accel)

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


def vec3(values: Array) -> Vec3:
    """Three numbers as plain ones."""
    north, east, down = np.asarray(values, dtype=np.float64).tolist()
    return north, east, down
