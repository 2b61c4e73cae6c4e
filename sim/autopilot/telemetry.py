"""Telemetry of the simulated autopilot: messages, rates, geodesy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.estimator import Estimator
from sim.autopilot.inertial import InertialSensors
from sim.autopilot.pilot import Phase, Pilot, preflight
from sim.autopilot.profile import (
    IGNORE_ACCEL,
    IGNORE_POSITION,
    IGNORE_VELOCITY,
    IGNORE_YAW,
    Parameters,
    Role,
    SetpointKind,
    SimulatedProfile,
)
from sim.vehicle.interface import ZERO, Quaternion, Vehicle, heading_rad
from sim.vehicle.rigid_body import GRAVITY_MPS2
from uavctl.records import Vec3

# Local NED to latitude and longitude, flat around the origin.


EARTH_M = 6378137.0
LARGEST_E7 = 2**31 - 1


@dataclass(frozen=True)
class GeodeticOrigin:
    """Geographic position of local NED's zero."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def degrees_e7(self, place_m: Vec3) -> tuple[int, int]:
        """Return latitude and longitude of a place, in MAVLink's unit [1e-7 degrees]."""
        lat = self.latitude_deg + math.degrees(place_m[0] / EARTH_M)
        lon = self.longitude_deg + math.degrees(place_m[1] / (EARTH_M * self._shrink))
        return _clipped(1e7 * lat), _clipped(1e7 * lon)

    def altitude_mm(self, place_m: Vec3) -> int:
        """Return the height of a place above the sea [mm]."""
        return _clipped(1000.0 * (self.altitude_m - place_m[2]))

    def local_m(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vec3:
        """Return a place on the globe in local NED [m]."""
        return (
            math.radians(latitude_deg - self.latitude_deg) * EARTH_M,
            math.radians(longitude_deg - self.longitude_deg) * EARTH_M * self._shrink,
            self.altitude_m - altitude_m,
        )

    @property
    def _shrink(self) -> float:
        return max(math.cos(math.radians(self.latitude_deg)), 1e-3)


def _clipped(value: float) -> int:
    return min(max(round(value), -LARGEST_E7 - 1), LARGEST_E7)


# POSITION_TARGET_LOCAL_NED: what is flown, as each autopilot tells it (masks and unset numbers as recorded).


IGNORE_YAW_RATE = 0x800
UNSET: Vec3 = (math.nan, math.nan, math.nan)
DOWN: Vec3 = (0.0, 0.0, 100.0)  # acceleration with which PX4 presses itself to the floor
Told = tuple[int, Vec3, Vec3, Vec3]  # type mask, position, velocity, acceleration


def target(kind: SimulatedProfile, pilot: Pilot, estimator: Estimator, attitude: Quaternion, boot_ms: int) -> Any:
    """Return POSITION_TARGET_LOCAL_NED (pymavlink's classes have no types); None where there is nothing to tell.

    Args:
        estimator: where the vehicle believes to be.
    """
    px4 = kind.name == "px4"
    told = _px4(pilot, estimator) if px4 else _ardupilot(pilot)
    if told is None:
        return None
    mask, *vectors = told
    nine = [number for vector in vectors for number in vector]
    obeyed = pilot.helm.obeyed
    wanted = None if obeyed is None else obeyed.yaw_rad
    yaw = heading_rad(attitude) if wanted is None and px4 else wanted or 0.0
    return mavlink.MAVLink_position_target_local_ned_message(boot_ms, 1, mask, *nine, yaw, 0.0)


def _px4(pilot: Pilot, estimator: Estimator) -> Told:
    """Return PX4's target, sent always: in modes of its own it plans position, velocity and acceleration."""
    obeyed = pilot.helm.obeyed
    if obeyed is not None and obeyed.ask is SetpointKind.ACCELERATION:
        return IGNORE_POSITION | IGNORE_VELOCITY, UNSET, UNSET, obeyed.vector
    if obeyed is not None and obeyed.ask is SetpointKind.VELOCITY:
        return IGNORE_POSITION, UNSET, obeyed.vector, ZERO
    if obeyed is not None:
        return 0, obeyed.vector, obeyed.velocity_mps or ZERO, obeyed.accel_mps2
    if pilot.phase is Phase.GROUND:
        return IGNORE_POSITION | IGNORE_VELOCITY, UNSET, UNSET, DOWN
    return 0, estimator.position_m, estimator.velocity_mps, ZERO


def _ardupilot(pilot: Pilot) -> Told | None:
    """Return ArduPilot's target, sent in GUIDED only: rest and braking by a velocity, a climb to a position."""
    if pilot.mode.role is not Role.EXTERNAL:
        return None
    no_yaw = IGNORE_YAW | IGNORE_YAW_RATE
    obeyed = pilot.helm.obeyed
    if obeyed is not None and obeyed.ask is SetpointKind.ACCELERATION:
        return IGNORE_POSITION | IGNORE_VELOCITY | no_yaw, ZERO, ZERO, obeyed.vector
    if obeyed is not None and obeyed.ask is SetpointKind.POSITION and obeyed.velocity_mps is not None:
        return no_yaw, obeyed.vector, obeyed.velocity_mps, obeyed.accel_mps2
    if obeyed is not None and obeyed.ask is SetpointKind.POSITION:
        return IGNORE_VELOCITY | IGNORE_ACCEL | no_yaw, obeyed.vector, ZERO, ZERO
    if obeyed is None and pilot.armed and pilot.phase is not Phase.AIR:
        return IGNORE_VELOCITY | IGNORE_ACCEL | no_yaw, ZERO, ZERO, ZERO
    return IGNORE_POSITION | no_yaw, ZERO, ZERO if obeyed is None else obeyed.vector, ZERO


# What the simulated vehicle tells: its messages, their contents, and how often each goes out.


SECOND_NS = 1_000_000_000
SHORTEST_INTERVAL_NS = 1_000_000
ARMED_FLAG = 128  # MAV_MODE_FLAG
CAPACITY_MAH = 240.0
HOME_POSITION, AUTOPILOT_VERSION, MESSAGE_INTERVAL = 242, 148, 244  # message ids
CONSTANT = 128  # ESTIMATOR_CONST_POS_MODE
FORCE_AND_RATES = 63  # HIGHRES_IMU_UPDATED_FLAGS: XACC to ZGYRO

Message = Any  # pymavlink's classes have no types
# MAV_SYS_STATUS_SENSOR
GYRO, ACCEL, MAG, BARO, GPS, VISION = 1, 2, 4, 8, 32, 128
CONTROL = 1024 | 2048 | 4096 | 8192 | 16384 | 32768  # rates, attitude, yaw, height, position, motors
RADIO, FENCE, AHRS, BATTERY, PREARM = 1 << 16, 1 << 20, 1 << 21, 1 << 25, 1 << 28
# MAV_PROTOCOL_CAPABILITY
FLOAT, COMMAND_INT, BYTEWISE, FILES, LOCAL_TARGETS, MAVLINK2, CAST = 2, 8, 16, 32, 128, 8192, 131072

# Roll, pitch, throttle and yaw of a stick that nobody moves [µs]; telemetry has room for 18 channels.
STICK_US = (1500, 1500, 1500, 1500)
NO_CHANNEL, FULL_SIGNAL = 65535, 254

# Usual intervals [ms]; 0: only when asked for. A message that is not here is not sent at all.
COMMON_MS = {
    0: 1000,  # HEARTBEAT
    1: 1000,  # SYS_STATUS
    24: 1000,  # GPS_RAW_INT
    30: 250,  # ATTITUDE
    31: 0,  # ATTITUDE_QUATERNION
    32: 100,  # LOCAL_POSITION_NED
    33: 250,  # GLOBAL_POSITION_INT
    49: 0,  # GPS_GLOBAL_ORIGIN
    74: 1000,  # VFR_HUD
    85: 1000,  # POSITION_TARGET_LOCAL_NED
    147: 2000,  # BATTERY_STATUS
    148: 0,  # AUTOPILOT_VERSION
    65: 1000,  # RC_CHANNELS
    242: 0,  # HOME_POSITION
    245: 1000,  # EXTENDED_SYS_STATE
}
USUAL_MS = {
    "px4": {**COMMON_MS, 31: 250, 105: 0, 111: 100, 141: 1000, 230: 1000, 242: 2000},
    "ardupilot": {**COMMON_MS, 27: 0, 116: 0, 193: 1000},
}
# What a PX4 was recorded to send unasked on an onboard link; an ArduPilot sends there what it is asked for.
ONBOARD_MS = {
    "px4": {
        1: 200,
        24: 125,
        30: 10,
        31: 20,
        32: 33,
        33: 200,
        74: 100,
        85: 100,
        105: 20,
        111: 90,
        141: 100,
        245: 200,
        331: 33,
    },
    "ardupilot": {},
}


@dataclass(frozen=True)
class BoardClock:
    """Clock of the autopilot's board: time since its boot, faster or slower than ours.

    Attributes:
        start_ns: our time when the simulation began.
        uptime_ns: what the clock showed then.
        drift_ppm: what it gains [millionths].
    """

    start_ns: int
    uptime_ns: int
    drift_ppm: float

    def shown_ns(self, at_ns: int) -> int:
        """Return what the clock shows at a time of ours [ns]."""
        since_ns = at_ns - self.start_ns
        return self.uptime_ns + since_ns + round(since_ns * self.drift_ppm * 1e-6)


@dataclass(frozen=True)
class TelemetrySources:
    """Objects whose state telemetry reports."""

    kind: SimulatedProfile
    craft: Vehicle
    pilot: Pilot
    estimator: Estimator
    inertial: InertialSensors
    parameters: Parameters
    origin: GeodeticOrigin
    clock: BoardClock
    streams: str  # `sim.streams`


class Telemetry:
    """Telemetry streams of one vehicle.

    Attributes:
        streams: message id to what makes it; None from it is nothing to tell yet.
        next_ns: time of the next message, None if none is due ever.
    """

    def __init__(self, vehicle: TelemetrySources, start_ns: int) -> None:
        self._v = vehicle
        name = vehicle.kind.name
        usual_ms = USUAL_MS[name] | (ONBOARD_MS[name] if vehicle.streams == "onboard" else {})
        self._usual_ns = {kind: ms * 1_000_000 for kind, ms in usual_ms.items()}
        self._period_ns = dict(self._usual_ns)
        self._due_ns = dict.fromkeys(self._usual_ns, start_ns)
        self.next_ns = self._soonest_ns()
        makers: dict[int, Callable[[int], Message | None]] = {
            0: self._heartbeat,
            1: self._status,
            24: self._gps,
            27: self._raw_imu,
            30: self._attitude,
            31: self._quaternion,
            32: self._local,
            33: self._global,
            49: self._origin,
            65: self._radio,
            74: self._hud,
            85: self._target,
            105: self._highres_imu,
            111: self._timesync,
            116: self._second_imu,
            141: self._altitude,
            147: self._battery,
            148: self._version,
            193: self._ekf,
            230: self._estimator,
            242: self._home,
            245: self._landed,
            331: self._odometry,
        }
        self.streams = {kind: makers[kind] for kind in self._usual_ns}

    def _soonest_ns(self) -> int | None:
        return min((due for kind, due in self._due_ns.items() if self._period_ns[kind] > 0), default=None)

    def due(self, at_ns: int) -> list[Message]:
        """Return the messages that are due."""
        if self.next_ns is None or self.next_ns > at_ns:
            return []
        made = []
        for kind, make in self.streams.items():
            if self._period_ns[kind] > 0 and self._due_ns[kind] <= at_ns:
                self._due_ns[kind] += self._period_ns[kind]
                made.append(make(at_ns))
        self.next_ns = self._soonest_ns()
        return [msg for msg in made if msg is not None]

    def make(self, kind: int, at_ns: int) -> Message | None:
        """Make one message now; None if there is nothing to tell, or no such message."""
        return self.streams[kind](at_ns) if kind in self.streams else None

    def interval_us(self, kind: int) -> int:
        """Return the interval of a message as MESSAGE_INTERVAL has it [µs]: -1 not sent, 0 not known."""
        if kind not in self.streams:
            return 0
        return self._period_ns[kind] // 1000 or -1

    def set_interval(self, kind: float, interval_us: float, at_ns: int) -> bool:
        """Set an interval [µs]: 0 is the default one, -1 none; return False if that is not possible."""
        if kind not in self.streams or not (interval_us == -1.0 or 0.0 <= interval_us <= 1e9):
            return False
        number = int(kind)
        if interval_us > 0.0:
            self._period_ns[number] = max(int(interval_us) * 1000, SHORTEST_INTERVAL_NS)
        else:
            self._period_ns[number] = self._usual_ns[number] if interval_us == 0.0 else 0
        self._due_ns[number] = at_ns + 1
        self.next_ns = self._soonest_ns()
        return True

    # What it tells

    def _boot_ms(self, at_ns: int) -> int:
        return self._v.clock.shown_ns(at_ns) // 1_000_000 % 2**32

    def _boot_us(self, at_ns: int) -> int:
        return self._v.clock.shown_ns(at_ns) // 1000

    def _heartbeat(self, at_ns: int) -> Message:
        pilot = self._v.pilot
        status = mavlink.MAV_STATE_STANDBY
        if not self._stands or (pilot.armed and self._v.kind.name == "px4"):
            status = mavlink.MAV_STATE_CRITICAL if pilot.failsafe else mavlink.MAV_STATE_ACTIVE
        elif self._v.kind.name == "px4" and not self._may_arm(at_ns):
            status = mavlink.MAV_STATE_UNINIT  # as recorded: it stands by only while it might be armed
        base = pilot.mode.base | (ARMED_FLAG if pilot.armed else 0)
        kind = mavlink.MAV_TYPE_QUADROTOR, self._v.kind.autopilot
        return mavlink.MAVLink_heartbeat_message(*kind, base, pilot.mode.custom, status, 3)

    def _may_arm(self, at_ns: int) -> bool:
        v = self._v
        why = preflight(v.kind, v.parameters, v.estimator, v.craft.battery, v.clock.shown_ns(at_ns))
        return not (why or v.pilot.lacks_stream(at_ns))

    def _status(self, at_ns: int) -> Message:
        v, battery = self._v, self._v.craft.battery
        estimator = v.estimator
        present = GYRO | ACCEL | MAG | BARO | CONTROL | AHRS | BATTERY | PREARM
        present |= (GPS if estimator.uses_gps else 0) | (VISION if estimator.uses_external else 0)
        present |= RADIO if v.pilot.radio else 0
        healthy = present & ~(AHRS | VISION | PREARM)
        if estimator.position_ok:
            healthy |= present & (AHRS | VISION)
        if self._may_arm(at_ns):
            healthy |= PREARM
        # As recorded: an ArduPilot has a fence that is healthy unless it is enabled and breached, a PX4 tells of none.
        fence = FENCE if v.kind.name == "ardupilot" else 0
        enabled = fence if fence and v.parameters["FENCE_ENABLE"] else 0
        power = round(1000.0 * battery.voltage_v), round(100.0 * battery.current_a), round(100.0 * battery.remaining)
        told = present | fence, present | enabled, healthy | (0 if v.pilot.breaches else fence)
        return mavlink.MAVLink_sys_status_message(*told, 250, *power, 0, 0, 0, 0, 0, 0)

    def _gps(self, at_ns: int) -> Message:
        v = self._v
        if not v.estimator.uses_gps:
            return mavlink.MAVLink_gps_raw_int_message(self._boot_us(at_ns), 0, 0, 0, 0, 65535, 65535, 65535, 65535, 0)
        north, east, _ = v.craft.velocity_mps
        course = round(math.degrees(math.atan2(east, north)) * 100.0) % 36000
        where = v.origin.degrees_e7(v.craft.position_m)
        speed = min(round(100.0 * math.hypot(north, east)), 65534)
        return mavlink.MAVLink_gps_raw_int_message(
            self._boot_us(at_ns), 3, *where, v.origin.altitude_mm(v.craft.position_m), 121, 200, speed, course, 10
        )

    def _euler(self) -> Vec3:
        w, x, y, z = attitude = self._v.inertial.attitude()
        roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
        return roll, pitch, heading_rad(attitude)

    def _attitude(self, at_ns: int) -> Message:
        return mavlink.MAVLink_attitude_message(self._boot_ms(at_ns), *self._euler(), *self._v.inertial.rates())

    def _quaternion(self, at_ns: int) -> Message:
        inertial = self._v.inertial
        turn = inertial.attitude()
        return mavlink.MAVLink_attitude_quaternion_message(self._boot_ms(at_ns), *turn, *inertial.rates())

    def _highres_imu(self, _at_ns: int) -> Message:
        """Return PX4's HIGHRES_IMU in SI units, with the fields of accelerometer and gyroscope only."""
        measured_ns, force, rates = self._v.inertial.measure(0)
        nothing = [0.0] * 7  # magnetometer, barometer and their temperature
        boot_us = self._boot_us(measured_ns)
        return mavlink.MAVLink_highres_imu_message(boot_us, *force, *rates, *nothing, FORCE_AND_RATES)

    def _raw_imu(self, _at_ns: int) -> Message:
        """Return ArduPilot's RAW_IMU, scaled like SCALED_IMU despite its name."""
        measured_ns, force, rates = self._v.inertial.measure(0)
        return mavlink.MAVLink_raw_imu_message(self._boot_us(measured_ns), *in_thousandths(force, rates), 0, 0, 0)

    def _second_imu(self, _at_ns: int) -> Message:
        measured_ns, force, rates = self._v.inertial.measure(1)
        return mavlink.MAVLink_scaled_imu2_message(self._boot_ms(measured_ns), *in_thousandths(force, rates), 0, 0, 0)

    def _local(self, at_ns: int) -> Message | None:
        estimator = self._v.estimator
        if not estimator.begun:
            return None
        boot_ms = self._boot_ms(at_ns)
        return mavlink.MAVLink_local_position_ned_message(boot_ms, *estimator.position_m, *estimator.velocity_mps)

    def _odometry(self, at_ns: int) -> Message | None:
        """Return ODOMETRY of the vehicle's own estimate; as recorded, all of it in local NED."""
        estimator, inertial = self._v.estimator, self._v.inertial
        if not estimator.begun:
            return None
        ned, unknown = mavlink.MAV_FRAME_LOCAL_NED, [math.nan] * 21
        motion = *estimator.position_m, list(inertial.attitude()), *estimator.velocity_mps, *inertial.rates()
        of_whom = mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT
        return mavlink.MAVLink_odometry_message(self._boot_us(at_ns), ned, ned, *motion, unknown, unknown, 0, of_whom)

    def _heading_cdeg(self) -> int:
        return round(math.degrees(heading_rad(self._v.craft.attitude)) * 100.0) % 36000

    def _height_m(self) -> float:
        return self._v.pilot.home_m[2] - self._v.estimator.position_m[2]

    def _global(self, at_ns: int) -> Message | None:
        v = self._v
        if not v.estimator.geographic:
            return None
        where = v.estimator.position_m
        speed = (min(max(round(100.0 * each), -32768), 32767) for each in v.estimator.velocity_mps)
        place = *v.origin.degrees_e7(where), v.origin.altitude_mm(where), clipped_mm(self._height_m())
        return mavlink.MAVLink_global_position_int_message(self._boot_ms(at_ns), *place, *speed, self._heading_cdeg())

    def _origin(self, at_ns: int) -> Message | None:
        v = self._v
        if not v.estimator.geographic:
            return None
        zero = (0.0, 0.0, 0.0)
        place = *v.origin.degrees_e7(zero), v.origin.altitude_mm(zero)
        return mavlink.MAVLink_gps_global_origin_message(*place, self._boot_us(at_ns))

    def _home(self, at_ns: int) -> Message | None:
        v, home = self._v, self._v.pilot.home_m
        if not v.estimator.geographic:
            return None
        place = *v.origin.degrees_e7(home), v.origin.altitude_mm(home)
        level = [1.0, 0.0, 0.0, 0.0] if v.kind.name == "px4" else [math.nan] * 4  # as recorded
        return mavlink.MAVLink_home_position_message(*place, *home, level, 0.0, 0.0, 0.0, self._boot_us(at_ns))

    def _radio(self, at_ns: int) -> Message | None:
        """Return RC_CHANNELS with the stick at rest, and the switch of modes; nothing without a remote control."""
        if not self._v.pilot.radio:
            return None
        used = *STICK_US, self._v.pilot.switch_us
        channels = *used, *([NO_CHANNEL] * (18 - len(used)))
        return mavlink.MAVLink_rc_channels_message(self._boot_ms(at_ns), len(used), *channels, FULL_SIGNAL)

    def _hud(self, _at_ns: int) -> Message:
        v = self._v
        north, east, down = v.estimator.velocity_mps
        speed = math.hypot(north, east)
        height = v.origin.altitude_m - v.estimator.position_m[2]
        throttle = 50 if v.pilot.phase is not Phase.GROUND else 0
        return mavlink.MAVLink_vfr_hud_message(speed, speed, self._heading_cdeg() // 100, throttle, height, -down)

    def _altitude(self, at_ns: int) -> Message:
        v = self._v
        local = -v.estimator.position_m[2]
        amsl = v.origin.altitude_m + local
        heights = amsl, amsl, local, self._height_m(), math.nan, math.nan
        return mavlink.MAVLink_altitude_message(self._boot_us(at_ns), *heights)

    def _target(self, at_ns: int) -> Message | None:
        v = self._v
        return target(v.kind, v.pilot, v.estimator, v.craft.attitude, self._boot_ms(at_ns))

    def _timesync(self, at_ns: int) -> Message:
        """Return a TIMESYNC request of the autopilot's own."""
        return mavlink.MAVLink_timesync_message(0, self._v.clock.shown_ns(at_ns))

    def _battery(self, _at_ns: int) -> Message:
        battery = self._v.craft.battery
        volts = [round(1000.0 * battery.voltage_v), *([65535] * 9)]
        used = round((1.0 - battery.remaining) * CAPACITY_MAH)
        return mavlink.MAVLink_battery_status_message(
            0, 0, 1, 32767, volts, round(100.0 * battery.current_a), used, -1, round(100.0 * battery.remaining)
        )

    def _version(self, _at_ns: int) -> Message:
        px4 = self._v.kind.name == "px4"
        can = FLOAT | COMMAND_INT | FILES | LOCAL_TARGETS | MAVLINK2 | (BYTEWISE if px4 else CAST)
        version = self._v.kind.version
        return mavlink.MAVLink_autopilot_version_message(
            can, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0x5541564354, [0] * 18
        )

    def _ekf(self, _at_ns: int) -> Message:
        estimator = self._v.estimator
        flags, variance = estimator.flags, 0.05 if estimator.position_ok else 1.0
        return mavlink.MAVLink_ekf_status_report_message(flags, variance, variance, 0.05, 0.05, 0.0)

    def _estimator(self, at_ns: int) -> Message:
        """Return PX4's ESTIMATOR_STATUS; of a vehicle at rest it says that it assumes a constant position."""
        estimator = self._v.estimator
        flags = estimator.flags | (CONSTANT if self._v.pilot.phase is Phase.GROUND else 0)
        ratio, accuracy = (0.1, 0.05) if estimator.position_ok else (2.0, 10.0)
        return mavlink.MAVLink_estimator_status_message(
            self._boot_us(at_ns), flags, ratio, ratio, 0.1, 0.1, 0.0, 0.0, accuracy, 0.1
        )

    @property
    def _stands(self) -> bool:
        """Whether the vehicle is on the floor, its rotors perhaps spinning up."""
        return self._v.pilot.phase is Phase.GROUND or (self._v.pilot.phase is Phase.CLIMB and self._v.craft.grounded)

    def _landed(self, _at_ns: int) -> Message:
        return mavlink.MAVLink_extended_sys_state_message(
            self._v.kind.vtol_state, (Phase.GROUND if self._stands else self._v.pilot.phase).value
        )


def clipped_mm(metres: float) -> int:
    """Return a length in millimetres that fits 32 bits [mm]."""
    return min(max(round(1000.0 * metres), -(2**31)), 2**31 - 1)


def in_thousandths(force_mps2: Vec3, rates_rps: Vec3) -> tuple[int, ...]:
    """Convert specific force to mg and body rates to mrad/s, 16 bits, truncated towards zero as ArduPilot does."""
    values = *(each / GRAVITY_MPS2 for each in force_mps2), *rates_rps
    return tuple(int(min(max(1000.0 * each, -32768.0), 32767.0)) for each in values)
