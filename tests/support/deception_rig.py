"""Flights between walls whose data deceive, or whose response is wrong, judged on the true vehicle."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from soak_pairs import compute_outside_m

from sim.autopilot.inertial import InertialMeasurement
from sim.autopilot.setpoints import ParsedSetpoint, SetpointKind
from sim.cameras import Cameras
from sim.simulation import World
from uavctl.config import Config, load_config
from uavctl.flight.controller import Controller
from uavctl.frames import Quaternion
from uavctl.lab.trial import get_cached_controller
from uavctl.loop import ControlLoop
from uavctl.records import Event, Record, Vec3

SOURCES = ("velocity", "attitude", "inertial", "positions")
KINDS = ("frozen", "scaled", "flipped", "swapped", "delayed")
RESPONSES = ("turned 90", "turned 180", "turned 270", "mirrored north", "mirrored east", "dead", "delayed")
DELAY_S = 0.3
SCALE = 0.3
BLACKOUT_S = 4.0
AFTER_S = 6.0  # that are flown after a blackout
MOTION_MESSAGES = (mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mavlink.MAVLINK_MSG_ID_ODOMETRY)


@dataclass(frozen=True)
class Deception:
    """A source that deceives from a time on.

    Attributes:
        source: One of `SOURCES`, or "response": how the vehicle answers acceleration setpoints.
        kind: One of `KINDS`; of a response, one of `RESPONSES`.
        at_s: When it begins, since the start [s].
    """

    source: str
    kind: str
    at_s: float


class ValueDistorter:
    """Distorts the values (n,) of a source as a deception says."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._kept: deque[tuple[float, tuple[float, ...]]] = deque()
        self._frozen: tuple[float, ...] | None = None

    def distort(self, at_s: float, value: Sequence[float], *, deceives: bool) -> tuple[float, ...]:
        """Return the value that is sent at a time; all values are kept, so that a delay has some from before."""
        values = tuple(map(float, value))
        self._kept.append((at_s, values))
        while len(self._kept) > 1 and self._kept[1][0] <= at_s - DELAY_S:
            self._kept.popleft()
        if not deceives:
            return values
        if self._frozen is None:
            self._frozen = values
        if self._kind == "frozen":
            return self._frozen
        if self._kind == "scaled":
            return tuple(SCALE * number for number in values)
        if self._kind == "flipped":
            return (-values[0], -values[1], *values[2:])
        if self._kind == "swapped":
            return (values[1], values[0], *values[2:])
        return self._kept[0][1]


@dataclass
class DeceivedFlight:
    """What the truth has of a flight.

    Attributes:
        outside_m: Furthest beyond a wall or the ceiling; negative is inside [m].
        outside_s: When that was, since the start [s].
        speed_mps: Largest speed from the first deception on.
        begin_mps: Speed when the first deception began.
        codes: Codes of events, each with its first time [s].
        modes: Changes of the control mode, each with its time [s].
        mode: Mode of the autopilot in the end.
    """

    outside_m: float = -math.inf
    outside_s: float = 0.0
    speed_mps: float = 0.0
    begin_mps: float = 0.0
    codes: dict[str, float] | None = None
    modes: list[tuple[float, str]] | None = None
    mode: str = ""


class _CodeSink:
    def __init__(self) -> None:
        self.codes: dict[str, float] = {}

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        del topic
        if isinstance(record, Event):
            self.codes.setdefault(record.code, round(at_ns * 1e-9, 2))


def prepare_believed(preset: str, autopilot: str, overrides: tuple[str, ...] = ()) -> tuple[Config, Controller]:
    """Prepare the controller that flies."""
    config = load_config(preset, [f"sim.autopilot={autopilot}", *overrides])
    return config, get_cached_controller(config)


def deceive(world: World, deceptions: Sequence[Deception], get_time_s: Callable[[], float]) -> None:
    """Let sources of a simulated flight deceive."""
    autopilot = world.peers.autopilot
    sensors, streams = autopilot.inertial, autopilot.telemetry.streams
    for deception in deceptions:
        if deception.source == "velocity":
            for message_id in MOTION_MESSAGES:
                if message_id in streams:
                    streams[message_id] = _wrap_velocity(streams[message_id], deception)
        elif deception.source == "attitude":
            estimate = _wrap_attitude(sensors.estimate_attitude, deception, get_time_s)
            sensors.estimate_attitude = estimate  # type: ignore[method-assign]
        elif deception.source == "inertial":
            sensors.measure = _wrap_inertial(sensors.measure, deception)  # type: ignore[method-assign, assignment]
        elif deception.source == "response":
            answer = _wrap_response(autopilot.pilot.receive_setpoint, deception)
            autopilot.pilot.receive_setpoint = answer  # type: ignore[method-assign, assignment]
        else:
            _deceive_cameras(world.peers.cameras, deception)


def _wrap_velocity(make: Callable[[int], Any], deception: Deception) -> Callable[[int], Any]:
    distorter = ValueDistorter(deception.kind)

    def make_distorted(at_ns: int) -> Any:
        message = make(at_ns)
        if message is not None:
            true = (message.vx, message.vy, message.vz)
            message.vx, message.vy, message.vz = distorter.distort(
                at_ns * 1e-9, true, deceives=at_ns * 1e-9 >= deception.at_s
            )
        return message

    return make_distorted


def _wrap_attitude(
    estimate: Callable[[], Quaternion], deception: Deception, get_time_s: Callable[[], float]
) -> Callable[[], Quaternion]:
    distorter = ValueDistorter(deception.kind)

    def estimate_distorted() -> Quaternion:
        w, x, y, z = estimate()
        # A quaternion and its negative are one attitude: with w > 0 its vector says all.
        vector = tuple(math.copysign(1.0, w) * part for part in (x, y, z))
        x, y, z = distorter.distort(get_time_s(), vector, deceives=get_time_s() >= deception.at_s)
        return math.sqrt(max(1.0 - x * x - y * y - z * z, 0.0)), x, y, z

    return estimate_distorted


def _wrap_inertial(
    measure: Callable[[int], InertialMeasurement], deception: Deception
) -> Callable[[int], InertialMeasurement]:
    distorters = {unit: ValueDistorter(deception.kind) for unit in range(3)}

    def measure_distorted(unit: int) -> InertialMeasurement:
        true = measure(unit)
        at_s = true[0] * 1e-9
        north, east, down = distorters[unit].distort(at_s, true.force_mps2, deceives=at_s >= deception.at_s)
        return true._replace(force_mps2=(north, east, down))

    return measure_distorted


def _wrap_response(
    receive: Callable[[ParsedSetpoint, int], None], deception: Deception
) -> Callable[[ParsedSetpoint, int], None]:
    delayed = ValueDistorter("delayed")

    def receive_distorted(setpoint: ParsedSetpoint, at_ns: int) -> None:
        deceives = at_ns * 1e-9 >= deception.at_s
        late = delayed.distort(at_ns * 1e-9, setpoint.vector, deceives=True)
        if deceives and setpoint.kind is SetpointKind.ACCELERATION:
            north, east, down = late if deception.kind == "delayed" else turn_response(deception.kind, setpoint.vector)
            setpoint = replace(setpoint, vector=(north, east, down))
        receive(setpoint, at_ns)

    return receive_distorted


def turn_response(kind: str, accel_mps2: Vec3) -> Vec3:
    """Return the acceleration [m/s²] that a wrong response makes of a setpoint."""
    north, east, down = accel_mps2
    return {
        "turned 90": (-east, north, down),
        "turned 180": (-north, -east, down),
        "turned 270": (east, -north, down),
        "mirrored north": (-north, east, down),
        "mirrored east": (north, -east, down),
        "dead": (0.0, 0.0, 0.0),
    }[kind]


def _deceive_cameras(cameras: Cameras, deception: Deception) -> None:
    capture, distorter = cameras.capture, ValueDistorter(deception.kind)

    def capture_distorted(position_m: Vec3, velocity_mps: Vec3, attitude: Quaternion) -> Any:
        at_s = cameras.next_ns * 1e-9
        north, east, down = distorter.distort(at_s, position_m, deceives=at_s >= deception.at_s)
        return capture((north, east, down), velocity_mps, attitude)

    cameras.capture = capture_distorted  # type: ignore[method-assign]


def fly_deceived(
    config: Config,
    believed: Config,
    controller: Controller,
    deceptions: Sequence[Deception],
    blackout_s: float | None,
    prepare: Callable[[World], None] = lambda _: None,
) -> DeceivedFlight:
    """Fly with sources that deceive.

    Args:
        config: Of the world.
        believed: Of the controller.
        blackout_s: When the blackout of the world begins; None for none.
        prepare: Changes the world before the flight.
    """
    sink, flight = _CodeSink(), DeceivedFlight()
    modes: list[tuple[float, str]] = []
    begin_s = min([deception.at_s for deception in deceptions] + ([] if blackout_s is None else [blackout_s]))
    loop = ControlLoop(believed, controller, sink, lambda: 0)
    time_s = 0.0

    class Watch:
        def receive(self, link: str, data: bytes, at_ns: int) -> Any:
            return loop.receive(link, data, at_ns)

        def tick(self, tick: int, at_ns: int, send: Any) -> object:
            nonlocal time_s
            time_s = at_ns * 1e-9
            vehicle = world.peers.vehicle
            speed_mps = math.hypot(*vehicle.velocity_mps)
            outside_m = compute_outside_m(config, vehicle.position_m)
            if time_s >= begin_s:
                if outside_m > flight.outside_m:
                    flight.outside_m, flight.outside_s = outside_m, time_s
                flight.begin_mps = flight.begin_mps or speed_mps
                flight.speed_mps = max(flight.speed_mps, speed_mps)
            ticked = loop.tick(tick, at_ns, send)
            mode = ticked.decision.mode
            if not modes or modes[-1][1] != mode:
                modes.append((round(time_s, 2), mode))
            return ticked

    world = World(config, Watch())
    deceive(world, deceptions, lambda: time_s)
    prepare(world)
    world.run(config.duration_s)
    flight.codes, flight.modes = sink.codes, modes
    flight.mode = world.peers.autopilot.mode_name
    return flight


def _choose_autopilot(seed: int) -> tuple[str, str]:
    """Choose the autopilot and its preset; both take turns."""
    autopilot = ("px4", "ardupilot")[seed % 2]
    return autopilot, (f"room-{autopilot}", f"room-{autopilot}", "room")[(seed // 2) % 3]


def choose_plant(plant: str, gust_wind_mps: float) -> tuple[str, ...]:
    """Choose the plant of a world; the linear one has its own disturbance in place of wind."""
    return f"sim.plant={plant}", *([f"sim.wind.gust_wind_mps={gust_wind_mps:.2f}"] if plant == "quadrotor" else [])


def _load_world(
    seed: int,
    rng: np.random.Generator,
    waypoints: str,
    duration_s: float,
    overrides: Sequence[str] = (),
    *,
    plant: str = "quadrotor",
) -> Config:
    """Load the configuration of the world that is flown in, with gusts."""
    autopilot, preset = _choose_autopilot(seed)
    return load_config(
        preset,
        [
            f"sim.autopilot={autopilot}",
            f"sim.seed={seed}",
            *choose_plant(plant, float(rng.uniform(0.0, 3.0))),
            f"mission.waypoints=[{waypoints}]",
            f"duration_s={duration_s}",
            *overrides,
        ],
    )


def _draw_waypoints(rng: np.random.Generator, preset: str, autopilot: str) -> str:
    believed, _ = prepare_believed(preset, autopilot)
    lower = [believed.sets.state_lower[i * (len(believed.sets.state_lower) // 3)] for i in range(3)]
    upper = [believed.sets.state_upper[i * (len(believed.sets.state_upper) // 3)] for i in range(3)]
    height = -float(rng.uniform(0.8, 1.6))
    sides = [(0.9 * lower[0], 0.9 * lower[1]), (0.9 * upper[0], 0.9 * upper[1])]
    if rng.random() < 0.5:
        sides = [(0.9 * lower[0], 0.9 * upper[1]), (0.9 * upper[0], 0.9 * lower[1])]
    corners = [*sides, *sides, *sides]
    return ", ".join(f"[{n:.2f}, {e:.2f}, {height:.2f}]" for n, e in corners)


def draw_flight(seed: int, plant: str = "quadrotor") -> tuple[Config, Config, Controller, list[Deception], float]:
    """Draw a flight: preset, autopilot, gusts, path between walls, a blackout, and one or two deceptions."""
    rng = np.random.default_rng([seed, 39])
    autopilot, preset = _choose_autopilot(seed)
    waypoints = _draw_waypoints(rng, preset, autopilot)
    blackout_s = float(rng.uniform(3.0, 10.0))
    size = 1 + int(rng.random() < 0.5)
    sources = rng.choice(len(SOURCES), size, replace=False)
    deceptions = [
        Deception(
            SOURCES[source],
            KINDS[int(rng.integers(len(KINDS)))],
            blackout_s + float(rng.uniform(-1.0, 0.0) if rng.random() < 0.7 else rng.uniform(0.0, 2.0)),
        )
        for source in sources
    ]
    blackout = f"link.blackout=[[{blackout_s}, {blackout_s + BLACKOUT_S}]]"
    config = _load_world(seed, rng, waypoints, blackout_s + BLACKOUT_S + AFTER_S, (blackout,), plant=plant)
    believed, controller = prepare_believed(preset, autopilot, (f"mission.waypoints=[{waypoints}]",))
    return config, believed, controller, deceptions, blackout_s


def draw_hover(
    seed: int, kind: str, plant: str = "quadrotor", source: str = "velocity", after_s: float = AFTER_S
) -> tuple[Config, Config, Controller, list[Deception], float]:
    """Draw a hover 0.25 to 0.6 m before a wall, with a source that deceives from just before a blackout on."""
    rng = np.random.default_rng([seed, 41])
    autopilot, preset = _choose_autopilot(seed)
    believed, _ = prepare_believed(preset, autopilot)
    upper, axis, blackout_s = believed.sets.state_upper, int(rng.integers(2)), float(rng.uniform(1.5, 5.0))
    place = [*rng.uniform(-1.5, 1.5, 2), -float(rng.uniform(0.8, 1.6))]
    place[axis] = float(rng.choice([-1.0, 1.0])) * (upper[axis * (len(upper) // 3)] - float(rng.uniform(0.25, 0.6)))
    waypoint = "[" + ", ".join(f"{x:.2f}" for x in place) + "]"
    deceptions = [Deception(source, kind, blackout_s + float(rng.uniform(-1.0, 0.0)))]
    overrides = (
        f"link.blackout=[[{blackout_s}, {blackout_s + BLACKOUT_S}]]",
        f"sim.start_position_m={waypoint}",
        "mission.hold_s=60.0",
    )
    config = _load_world(seed, rng, waypoint, blackout_s + BLACKOUT_S + after_s, overrides, plant=plant)
    believed, controller = prepare_believed(
        preset, autopilot, (f"mission.waypoints=[{waypoint}]", "mission.hold_s=60.0")
    )
    return config, believed, controller, deceptions, blackout_s


def draw_response_flight(
    seed: int, plant: str = "quadrotor"
) -> tuple[Config, Config, Controller, list[Deception], float | None]:
    """Draw a flight between walls whose response is wrong from a moment on: no blackout."""
    rng = np.random.default_rng([seed, 40])
    autopilot, preset = _choose_autopilot(seed)
    waypoints = _draw_waypoints(rng, preset, autopilot)
    at_s = float(rng.uniform(2.5, 14.0))
    config = _load_world(seed, rng, waypoints, at_s + AFTER_S, plant=plant)
    believed, controller = prepare_believed(preset, autopilot, (f"mission.waypoints=[{waypoints}]",))
    return config, believed, controller, [Deception("response", str(rng.choice(RESPONSES)), at_s)], None
