"""Trials with the simulated quadrotor: case, flight in lockstep, figures from its true positions.

The figures of a flight are pure functions, in metres and seconds; a larger figure is always worse.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from statistics import median
from typing import Literal

import msgspec
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from sim.simulation import World
from uavctl.arrays import Array
from uavctl.config import Config, load_config, parse
from uavctl.config.checks import get_position_limits_m
from uavctl.config.mission import TrajectoryConfig
from uavctl.flight.controller import Controller
from uavctl.lab.figure_eight import CENTRE_M, make_figure_eight, to_vec3
from uavctl.lab.position_loop import MotionPath, MotionPoint, PositionLoopFlyer, PositionLoopTuning
from uavctl.loop import ControlLoop
from uavctl.records import ControlMode, Decision, Flyer, Plan, Received, Record, Send, Setpoint, Vec3
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.plant import AXES
from uavctl.wiring.controller import build_conditioned, build_controller, build_plant, compute_reference_limits
from uavctl.wiring.mission import build_reference_limits, compute_reference_range

Scenario = Literal["hold", "eight", "blackout"]
AutopilotName = Literal["px4", "ardupilot"]
Air = Literal["calm", "gusts", "strong-gusts"]

SCENARIOS: tuple[Scenario, ...] = ("hold", "eight", "blackout")
AUTOPILOTS: tuple[AutopilotName, ...] = ("px4", "ardupilot")
WIND_MPS: Vec3 = (0.6, -0.36, 0.0)  # 0.7 m/s, wherever there are gusts
GUST_WIND_MPS: dict[Air, float] = {"calm": 0.0, "gusts": 3.0, "strong-gusts": 8.0}
BLACKOUT_S = 4.0
BLACKOUT_BEGINS_S = (1.0, 6.0)  # the path of preset `room` takes about as long
_BLACKOUT_CHILD = 1  # child of a flight's seed that draws when a blackout begins
AFTER_EIGHT_S = 2.0  # after the end of the figure of eight


@dataclass(frozen=True)
class TrialPilot:
    """Pilot of a trial: a controller of ours, or the vehicle's own loop."""

    name: str  # name in tables
    config: str = "room"  # preset or file of its configuration; only a name in messages where there is a `text`
    overrides: tuple[str, ...] = ()  # overrides of that configuration
    position_loop: PositionLoopTuning | None = None  # setup of the vehicle's own loop; None for a controller of ours
    knows_link: bool = False  # whether it is designed for the flown link; else for that of its configuration
    text: str = ""  # TOML text of its configuration, for processes without the file; empty for none

    def load(self, overrides: Sequence[str]) -> Config:
        """Load the pilot's configuration with its own and further overrides.

        Raises:
            ConfigError: An override is not valid.
        """
        all_overrides = (*self.overrides, *overrides)
        return (
            parse(self.text, self.config, all_overrides).config
            if self.text
            else load_config(self.config, all_overrides)
        )


@dataclass(frozen=True)
class TrialCell:
    """Cell of trials: flights that differ in their seed alone."""

    pilot: TrialPilot
    scenario: Scenario
    autopilot: AutopilotName  # autopilot that the simulator imitates
    rate_hz: float  # rate of the cameras
    link_name: str
    link: tuple[str, ...]  # overrides that define the link
    air: Air  # calm, or wind with gusts (`GUST_WIND_MPS`)


def make_flight_config(cell: TrialCell, seed: int, seconds: float) -> Config:
    """Return the configuration of a flight: simulator, link and mission.

    Raises:
        ConfigError: An override is not valid.
    """
    wind = (0.0, 0.0, 0.0) if cell.air == "calm" else WIND_MPS
    overrides = [
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
        begin = draw_blackout_begin_s(seed)
        overrides.append(f"link.blackout=[[{begin}, {begin + BLACKOUT_S}]]")
    return _with_mission(cell.pilot.load(overrides), cell.scenario)


def make_design_config(cell: TrialCell) -> Config:
    """Return the configuration that a controller of ours is designed for.

    Raises:
        ConfigError: An override is not valid.
    """
    overrides = (f"sim.autopilot={cell.autopilot}", *(cell.link if cell.pilot.knows_link else ()))
    return _with_mission(cell.pilot.load(overrides), cell.scenario)


def draw_blackout_begin_s(seed: int) -> float:
    """Draw when a flight's blackout begins [s]: a random time on the path, the same for all pilots."""
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(_BLACKOUT_CHILD + 1)[_BLACKOUT_CHILD])
    return round(float(rng.uniform(*BLACKOUT_BEGINS_S)), 3)


def get_flight_length_s(scenario: Scenario, seconds: float) -> float:
    """Return the length of a flight [s]: a figure of eight is flown to its end."""
    return make_figure_eight().times_s[-1] + AFTER_EIGHT_S if scenario == "eight" else seconds


def _with_mission(config: Config, scenario: Scenario) -> Config:
    """Return the configuration, with the figure of eight as mission from its centre in that scenario."""
    if scenario != "eight":
        return config
    replace = msgspec.structs.replace
    return replace(
        config,
        mission=replace(config.mission, waypoints=(), trajectory=make_figure_eight(), then="hold"),
        sim=replace(config.sim, start_position_m=CENTRE_M, start_velocity_mps=(0.0, 0.0, 0.0)),
        target=replace(config.target, position_m=CENTRE_M),
    )


@dataclass(frozen=True)
class TableFigure:
    """Display of a figure in a table."""

    key: str  # its name in `TrialFlight`
    heading: str  # over its column
    factor: float  # to the column's unit
    digits: int  # after the point

    def format_values(self, values: Sequence[float]) -> str:
        """Return median and worst of some flights; a dash where the figure does not apply to one."""
        if not values or any(map(math.isnan, values)):
            return "-"
        middle, worst = self.factor * median(values), self.factor * max(values)
        return f"{middle:.{self.digits}f} ({worst:.{self.digits}f})"


HOLD_FIGURE = TableFigure("hold_rms_m", "hold rms cm", 100.0, 1)
NEAR_FIGURE = TableFigure("near_s", "to 0.3 m s", 1.0, 1)
EXCESS_FIGURE = TableFigure("beyond_m", "beyond wall m", 1.0, 2)
COUNT_FIGURES = (
    TableFigure("limited", "limited %", 100.0, 0),
    TableFigure("gave_way", "relaxed %", 100.0, 1),
    TableFigure("fallback", "fallback %", 100.0, 1),
)
SCENARIO_FIGURES: dict[Scenario, tuple[TableFigure, ...]] = {
    "hold": (
        HOLD_FIGURE,
        TableFigure("hold_max_m", "hold max cm", 100.0, 1),
        NEAR_FIGURE,
        TableFigure("nearer_s", "to 0.1 m s", 1.0, 1),
        EXCESS_FIGURE,
        *COUNT_FIGURES,
    ),
    "eight": (
        TableFigure("tracking_m", "tracking cm", 100.0, 1),
        TableFigure("tracking_max_m", "tracking max cm", 100.0, 1),
        EXCESS_FIGURE,
        *COUNT_FIGURES,
    ),
    "blackout": (TableFigure("blackout_beyond_m", "beyond wall m", 1.0, 2), HOLD_FIGURE, NEAR_FIGURE, *COUNT_FIGURES),
}
FIGURE_NOTE = (
    "Median, and the worst in brackets. Hold: distance of the true position from the target, while the target is held. "
    "To 0.3 m, to 0.1 m: time from the first order until the vehicle stayed so near. Tracking: distance from the "
    "reference of the motion, mean and largest. Beyond wall: furthest point beyond a limit of the position, negative "
    "inside; with a blackout, from its beginning on. Limited: share of setpoints "
    "that the setpoint limiter changed. Relaxed: share of plans with a relaxed constraint. Fallback: share of "
    "ticks in which no plan was flown."
)


def compute_distances_m(positions: Array, reference: Array) -> Array:
    """Return the distance (n,) [m] of positions (n, 3) from their reference, (3,) or (n, 3)."""
    return np.asarray(np.linalg.norm(positions - reference, axis=1))


def compute_rms_m(distances: Array) -> float:
    """Return the root mean square [m]; NaN of no values."""
    return float(np.sqrt(np.mean(distances**2))) if distances.size else math.nan


def compute_max(values: Array) -> float:
    """Return the largest value; NaN of no values."""
    return float(values.max()) if values.size else math.nan


def compute_mean(values: Array) -> float:
    """Return the mean; NaN of no values."""
    return float(values.mean()) if values.size else math.nan


def compute_settling_time_s(times: Array, distances: Array, radius_m: float) -> float:
    """Return the time from which the vehicle stays within a radius to the end [s]; infinite if it ends outside.

    Args:
        times: (n,), increasing.
        distances: From the target at these times (n,).
    """
    outside_indices = np.flatnonzero(distances > radius_m)
    if not outside_indices.size:
        return float(times[0])
    last = int(outside_indices[-1])
    return math.inf if last + 1 == len(times) else float(times[last + 1])


def compute_excess_m(positions: Array, lower: Array, upper: Array) -> Array:
    """Return the distance of positions (n, 3) beyond the nearest wall (n,) [m]; negative is inside.

    Args:
        positions: (n, 3).
        lower: Least position in the room (3,), minus infinity where there is no wall.
    """
    return np.asarray(np.maximum(lower - positions, positions - upper).max(axis=1))


def get_room_limits(config: Config) -> tuple[Array, Array]:
    """Return the least and the largest position in the room (3,) [m]; infinite where there is no wall."""
    limits = get_position_limits_m(config)
    lower, upper = np.array([limits.get(axis, (-np.inf, np.inf)) for axis in AXES]).T
    return lower, upper


def compute_usable_share(config: Config, design: AnyDesign) -> float:
    """Return the share of the room in which a plan may rest, with estimation error; NaN where a wall is open.

    Raises:
        DesignError: There is no such scheme.
    """
    return _compute_volume_share(
        config, *compute_reference_range(design.plant, design.state_set, compute_reference_limits(design))
    )


def compute_exact_usable_share(config: Config, design: Design | None) -> float:
    """Return the share of the room in which a plan may rest if the state is known, as in the linear world.

    Raises:
        DesignError: There is no such scheme.
    """
    if design is not None:
        return _compute_volume_share(
            config, *compute_reference_range(design.plant, design.state_set, build_reference_limits(design))
        )
    n_x = build_plant(config).n_x
    conditioned = build_conditioned(config, for_flight=False, cov=np.zeros((n_x, n_x)))
    return _compute_volume_share(
        config, *compute_reference_range(conditioned.plant, conditioned.state_set, conditioned.reference_limits)
    )


def _compute_volume_share(config: Config, rest_lower: Array, rest_upper: Array) -> float:
    axes = [AXES.index(axis) for axis in config.plant.axes]
    lower, upper = get_room_limits(config)
    lengths = (upper - lower)[axes]
    return (
        float(np.prod(np.clip(rest_upper - rest_lower, 0.0, None) / lengths))
        if np.isfinite(lengths).all()
        else math.nan
    )


NEAR_M, NEARER_M = 0.3, 0.1  # of the target
SLACK = 1e-6  # more is slack that was used
_CACHED_CONTROLLERS = 8  # a solver takes a second to make


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
    limited: float = math.nan  # share of setpoints that the setpoint limiter changed
    gave_way: float = math.nan  # share of plans in which a constraint was relaxed
    fallback: float = math.nan  # share of ticks, from the first order on, in which no plan was flown
    positions: int = 0  # that arrived
    mode: str = ""  # of the vehicle at the end


@dataclass
class TrackedFlyer:
    """Flyer that records the true motion at each tick; implements `uavctl.records.Flyer`."""

    flyer: Flyer
    get_position: Callable[[], Vec3] = lambda: (math.nan, math.nan, math.nan)  # the true one
    times_s: list[float] = field(default_factory=list)  # of the ticks
    positions_m: list[Vec3] = field(default_factory=list)  # true positions at these times

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take a datagram."""
        return self.flyer.receive(link, data, at_ns)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Record the true position, and run the tick."""
        self.times_s.append(at_ns * 1e-9)
        self.positions_m.append(self.get_position())
        self.flyer.tick(tick, at_ns, send)


@dataclass
class FlightCounts:
    """Sink that counts setpoints, limited setpoints, plans, relaxed plans and ticks in fallback."""

    first_target_ns: int | None = None  # time of the first decision with a target; None before
    setpoints: int = 0  # setpoints sent
    limited: int = 0  # setpoints that the setpoint limiter changed
    plans: int = 0
    gave_way: int = 0  # plans in which a constraint was relaxed
    ticks: int = 0  # ticks from the first such decision on
    fallback_ticks: int = 0  # ticks in which no plan was flown
    positions: int = 0  # positions that ticks used

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
            if self.first_target_ns is None and record.target is not None:
                self.first_target_ns = at_ns
            self.ticks += self.first_target_ns is not None
            self.fallback_ticks += self.first_target_ns is not None and record.mode is not ControlMode.TRACK


def fly_trial(cell: TrialCell, seed: int, *, seconds: float, from_s: float) -> TrialFlight:
    """Fly one trial; return its figures, from the true motion.

    Args:
        seconds: Length of the flight; a figure of eight has its own.
        from_s: Time from which the vehicle has to hold its position.

    Raises:
        ConfigError: An override is not valid.
        DesignError: There is no such controller.
    """
    seconds = get_flight_length_s(cell.scenario, seconds)
    config = make_flight_config(cell, seed, seconds)
    return (
        _fly_controller(cell, config, from_s)
        if cell.pilot.position_loop is None
        else _fly_position_loop(cell, config, from_s)
    )


def _fly_controller(cell: TrialCell, config: Config, from_s: float) -> TrialFlight:
    counts = FlightCounts()
    config_of_design = make_design_config(cell)
    tracked = TrackedFlyer(ControlLoop(config_of_design, get_cached_controller(config_of_design), counts, lambda: 0))
    world = _run_world(config, tracked)
    start_s = None if counts.first_target_ns is None else counts.first_target_ns * 1e-9
    return _compute_figures(
        cell,
        config,
        tracked,
        start_s,
        from_s,
        limited=_compute_share(counts.limited, counts.setpoints),
        gave_way=_compute_share(counts.gave_way, counts.plans),
        fallback=_compute_share(counts.fallback_ticks, counts.ticks),
        positions=counts.positions,
        mode=world.peers.autopilot.mode_name,
    )


def _fly_position_loop(cell: TrialCell, config: Config, from_s: float) -> TrialFlight:
    flyer = make_position_loop(cell, config)
    tracked = TrackedFlyer(flyer)
    world = _run_world(config, tracked, flyer)
    return _compute_figures(
        cell,
        config,
        tracked,
        None if flyer.first_target_ns is None else flyer.first_target_ns * 1e-9,
        from_s,
        positions=len(flyer.samples),
        mode=world.peers.autopilot.mode_name,
    )


def make_position_loop(cell: TrialCell, config: Config) -> PositionLoopFlyer:
    """Return the flyer of a cell that uses the vehicle's own position loop."""
    assert cell.pilot.position_loop is not None
    path = make_path(config.mission.trajectory) if cell.scenario == "eight" else None
    return PositionLoopFlyer(config, cell.pilot.position_loop, config.target.position_m, path)


def _run_world(config: Config, tracked: TrackedFlyer, position_loop: PositionLoopFlyer | None = None) -> World:
    world = World(config, tracked)
    vehicle = world.peers.vehicle
    tracked.get_position = lambda: vehicle.position_m
    if position_loop is not None:
        position_loop.configure_vehicle(world.peers.autopilot)
    world.run(config.duration_s)
    return world


@lru_cache(maxsize=_CACHED_CONTROLLERS)
def get_cached_controller(config: Config) -> Controller:
    """Return the controller of a configuration, from a cache.

    Raises:
        DesignError: There is none.
    """
    return build_controller(config)


def make_path(motion: TrajectoryConfig) -> MotionPath:
    """Return a sampled motion as a function of time, at rest before its start and after its end."""
    times = np.array(motion.times_s)
    spline = CubicHermiteSpline(times, np.array(motion.positions_m), np.array(motion.velocities_mps))
    velocity_spline, accel_spline = spline.derivative(), spline.derivative(2)

    def get_point(since_s: float) -> MotionPoint:
        is_moving = times[0] <= since_s < times[-1]
        position = spline(min(max(since_s, times[0]), times[-1]))
        velocity, accel = (velocity_spline(since_s), accel_spline(since_s)) if is_moving else (np.zeros(3), np.zeros(3))
        return to_vec3(position), to_vec3(velocity), to_vec3(accel)

    return get_point


def _compute_figures(
    cell: TrialCell,
    config: Config,
    tracked: TrackedFlyer,
    start_s: float | None,
    from_s: float,
    **counts: float | int | str,
) -> TrialFlight:
    times, positions_m = np.array(tracked.times_s), np.array(tracked.positions_m)
    excess_m = compute_excess_m(positions_m, *get_room_limits(config))
    figures: dict[str, float] = {"beyond_m": compute_max(excess_m)}
    if start_s is None:
        pass
    elif cell.scenario == "eight":
        path = make_path(config.mission.trajectory)
        is_flying = (times >= start_s) & (times <= start_s + config.mission.trajectory.times_s[-1])
        reference = np.array([path(t - start_s)[0] for t in times[is_flying]])
        distances_m = compute_distances_m(positions_m[is_flying], reference)
        figures |= {"tracking_m": compute_mean(distances_m), "tracking_max_m": compute_max(distances_m)}
    else:
        is_flying = times >= start_s
        distances_m = compute_distances_m(positions_m, np.array(config.target.position_m))
        hold_distances_m = distances_m[times >= from_s]
        figures |= {
            "hold_rms_m": compute_rms_m(hold_distances_m),
            "hold_max_m": compute_max(hold_distances_m),
            "near_s": compute_settling_time_s(times[is_flying] - start_s, distances_m[is_flying], NEAR_M),
            "nearer_s": compute_settling_time_s(times[is_flying] - start_s, distances_m[is_flying], NEARER_M),
        }
    if cell.scenario == "blackout":
        figures["blackout_beyond_m"] = compute_max(excess_m[times >= draw_blackout_begin_s(config.sim.seed)])
    return TrialFlight(seed=config.sim.seed, **figures, **counts)  # type: ignore[arg-type]


def _compute_share(part: int, total: int) -> float:
    return part / total if total else math.nan
