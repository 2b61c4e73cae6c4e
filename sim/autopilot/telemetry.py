"""Telemetry of the simulated autopilot: messages, their contents and their rates."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.arming import check_preflight
from sim.autopilot.estimator import Estimator
from sim.autopilot.geodesy import GeodeticOrigin
from sim.autopilot.inertial import InertialSensors
from sim.autopilot.parameters import Parameters
from sim.autopilot.pilot import Phase, Pilot
from sim.autopilot.position_target import make_position_target
from sim.autopilot.profile import SimulatedProfile
from sim.vehicle.airframe import GRAVITY_MPS2
from sim.vehicle.interface import Vehicle, compute_heading_rad
from uavctl.records import Vec3

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

# Roll, pitch, throttle and yaw of a stick at rest [µs]; telemetry has room for 18 channels.
STICK_CENTRE_US = (1500, 1500, 1500, 1500)
NO_CHANNEL, FULL_SIGNAL = 65535, 254

# Usual intervals [ms]; 0: only on request. A message that is not here is never sent.
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
# Streams of a recorded PX4 on an onboard link; an ArduPilot sends there only requested streams.
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
        start_ns: start of the simulation.
        uptime_ns: reading of this clock at the start.
        drift_ppm: gain [millionths].
    """

    start_ns: int
    uptime_ns: int
    drift_ppm: float

    def read_ns(self, at_ns: int) -> int:
        """Return the reading of this clock at a simulated time [ns]."""
        since_ns = at_ns - self.start_ns
        return self.uptime_ns + since_ns + round(since_ns * self.drift_ppm * 1e-6)


@dataclass(frozen=True)
class TelemetrySources:
    """Objects whose state telemetry reports."""

    profile: SimulatedProfile
    vehicle: Vehicle
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
        streams: message id to its maker, which returns None without data.
        next_ns: time of the next message, None if none is due ever.
    """

    def __init__(self, sources: TelemetrySources, start_ns: int) -> None:
        self._sources = sources
        name = sources.profile.name
        default_ms = USUAL_MS[name] | (ONBOARD_MS[name] if sources.streams == "onboard" else {})
        self._default_period_ns = {message_id: ms * 1_000_000 for message_id, ms in default_ms.items()}
        self._period_ns = dict(self._default_period_ns)
        self._due_ns = dict.fromkeys(self._default_period_ns, start_ns)
        self.next_ns = self._find_next_ns()
        makers: dict[int, Callable[[int], Message | None]] = {
            0: self._make_heartbeat,
            1: self._make_status,
            24: self._make_gps,
            27: self._make_raw_imu,
            30: self._make_attitude,
            31: self._make_quaternion,
            32: self._make_local_position,
            33: self._make_global_position,
            49: self._make_origin,
            65: self._make_rc_channels,
            74: self._make_hud,
            85: self._make_target,
            105: self._make_highres_imu,
            111: self._make_timesync,
            116: self._make_second_imu,
            141: self._make_altitude,
            147: self._make_battery,
            148: self._make_version,
            193: self._make_ekf,
            230: self._make_estimator,
            242: self._make_home,
            245: self._make_landed,
            331: self._make_odometry,
        }
        self.streams = {message_id: makers[message_id] for message_id in self._default_period_ns}

    def _find_next_ns(self) -> int | None:
        return min([due for message_id, due in self._due_ns.items() if self._period_ns[message_id] > 0], default=None)

    def make_due_messages(self, at_ns: int) -> list[Message]:
        """Return the messages that are due."""
        if self.next_ns is None or self.next_ns > at_ns:
            return []
        messages = []
        for message_id, make in self.streams.items():
            if self._period_ns[message_id] > 0 and self._due_ns[message_id] <= at_ns:
                self._due_ns[message_id] += self._period_ns[message_id]
                messages.append(make(at_ns))
        self.next_ns = self._find_next_ns()
        return [msg for msg in messages if msg is not None]

    def make_message(self, message_id: int, at_ns: int) -> Message | None:
        """Make one message now; None without data, or without such a message."""
        return self.streams[message_id](at_ns) if message_id in self.streams else None

    def get_interval_us(self, message_id: int) -> int:
        """Return the interval of a message as MESSAGE_INTERVAL has it [µs]: -1 not sent, 0 not known."""
        if message_id not in self.streams:
            return 0
        return self._period_ns[message_id] // 1000 or -1

    def set_interval(self, message_id: float, interval_us: float, at_ns: int) -> bool:
        """Set an interval [µs]: 0 is the default one, -1 none; return False if that is not possible."""
        if message_id not in self.streams or not (interval_us == -1.0 or 0.0 <= interval_us <= 1e9):
            return False
        message_key = int(message_id)
        if interval_us > 0.0:
            self._period_ns[message_key] = max(int(interval_us) * 1000, SHORTEST_INTERVAL_NS)
        else:
            self._period_ns[message_key] = self._default_period_ns[message_key] if interval_us == 0.0 else 0
        self._due_ns[message_key] = at_ns + 1
        self.next_ns = self._find_next_ns()
        return True

    def _read_boot_ms(self, at_ns: int) -> int:
        return self._sources.clock.read_ns(at_ns) // 1_000_000 % 2**32

    def _read_boot_us(self, at_ns: int) -> int:
        return self._sources.clock.read_ns(at_ns) // 1000

    def _make_heartbeat(self, at_ns: int) -> Message:
        pilot = self._sources.pilot
        status = mavlink.MAV_STATE_STANDBY
        if not self._is_on_floor or (pilot.is_armed and self._sources.profile.name == "px4"):
            status = mavlink.MAV_STATE_CRITICAL if pilot.is_failsafe else mavlink.MAV_STATE_ACTIVE
        elif self._sources.profile.name == "px4" and not self._can_arm(at_ns):
            status = mavlink.MAV_STATE_UNINIT  # as recorded: it stands by only while it might be armed
        base = pilot.mode.base | (ARMED_FLAG if pilot.is_armed else 0)
        vehicle_type = mavlink.MAV_TYPE_QUADROTOR, self._sources.profile.autopilot
        return mavlink.MAVLink_heartbeat_message(*vehicle_type, base, pilot.mode.custom, status, 3)

    def _can_arm(self, at_ns: int) -> bool:
        sources = self._sources
        refusals = check_preflight(
            sources.profile,
            sources.parameters,
            sources.estimator,
            sources.vehicle.battery,
            sources.clock.read_ns(at_ns),
        )
        return not (refusals or sources.pilot.lacks_stream(at_ns))

    def _make_status(self, at_ns: int) -> Message:
        sources, battery = self._sources, self._sources.vehicle.battery
        estimator = sources.estimator
        present = GYRO | ACCEL | MAG | BARO | CONTROL | AHRS | BATTERY | PREARM
        present |= (GPS if estimator.uses_gps else 0) | (VISION if estimator.uses_external else 0)
        present |= RADIO if sources.pilot.has_radio else 0
        healthy = present & ~(AHRS | VISION | PREARM)
        if estimator.is_position_valid:
            healthy |= present & (AHRS | VISION)
        if self._can_arm(at_ns):
            healthy |= PREARM
        # As recorded: an ArduPilot has a fence that is healthy unless it is enabled and breached, a PX4 reports none.
        fence = FENCE if sources.profile.name == "ardupilot" else 0
        enabled = fence if fence and sources.parameters["FENCE_ENABLE"] else 0
        power = round(1000.0 * battery.voltage_v), round(100.0 * battery.current_a), round(100.0 * battery.remaining)
        sensors = present | fence, present | enabled, healthy | (0 if sources.pilot.is_fence_breached else fence)
        return mavlink.MAVLink_sys_status_message(*sensors, 250, *power, 0, 0, 0, 0, 0, 0)

    def _make_gps(self, at_ns: int) -> Message:
        sources = self._sources
        if not sources.estimator.uses_gps:
            return mavlink.MAVLink_gps_raw_int_message(
                self._read_boot_us(at_ns), 0, 0, 0, 0, 65535, 65535, 65535, 65535, 0
            )
        north, east, _ = sources.vehicle.velocity_mps
        course = round(math.degrees(math.atan2(east, north)) * 100.0) % 36000
        position = sources.origin.compute_degrees_e7(sources.vehicle.position_m)
        speed = min(round(100.0 * math.hypot(north, east)), 65534)
        return mavlink.MAVLink_gps_raw_int_message(
            self._read_boot_us(at_ns),
            3,
            *position,
            sources.origin.compute_altitude_mm(sources.vehicle.position_m),
            121,
            200,
            speed,
            course,
            10,
        )

    def _compute_euler(self) -> Vec3:
        w, x, y, z = attitude = self._sources.inertial.estimate_attitude()
        roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
        pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
        return roll, pitch, compute_heading_rad(attitude)

    def _make_attitude(self, at_ns: int) -> Message:
        return mavlink.MAVLink_attitude_message(
            self._read_boot_ms(at_ns), *self._compute_euler(), *self._sources.inertial.measure_rates()
        )

    def _make_quaternion(self, at_ns: int) -> Message:
        inertial = self._sources.inertial
        attitude = inertial.estimate_attitude()
        return mavlink.MAVLink_attitude_quaternion_message(
            self._read_boot_ms(at_ns), *attitude, *inertial.measure_rates()
        )

    def _make_highres_imu(self, _at_ns: int) -> Message:
        """Return PX4's HIGHRES_IMU in SI units, with the fields of accelerometer and gyroscope only."""
        measured_ns, force, rates = self._sources.inertial.measure(0)
        unset = [0.0] * 7  # magnetometer, barometer and their temperature
        boot_us = self._read_boot_us(measured_ns)
        return mavlink.MAVLink_highres_imu_message(boot_us, *force, *rates, *unset, FORCE_AND_RATES)

    def _make_raw_imu(self, _at_ns: int) -> Message:
        """Return ArduPilot's RAW_IMU, scaled like SCALED_IMU despite its name."""
        measured_ns, force, rates = self._sources.inertial.measure(0)
        return mavlink.MAVLink_raw_imu_message(
            self._read_boot_us(measured_ns), *convert_to_milli(force, rates), 0, 0, 0
        )

    def _make_second_imu(self, _at_ns: int) -> Message:
        measured_ns, force, rates = self._sources.inertial.measure(1)
        return mavlink.MAVLink_scaled_imu2_message(
            self._read_boot_ms(measured_ns), *convert_to_milli(force, rates), 0, 0, 0
        )

    def _make_local_position(self, at_ns: int) -> Message | None:
        estimator = self._sources.estimator
        if not estimator.has_estimate:
            return None
        boot_ms = self._read_boot_ms(at_ns)
        return mavlink.MAVLink_local_position_ned_message(boot_ms, *estimator.position_m, *estimator.velocity_mps)

    def _make_odometry(self, at_ns: int) -> Message | None:
        """Return ODOMETRY of the vehicle's own estimate; as recorded, all of it in local NED."""
        estimator, inertial = self._sources.estimator, self._sources.inertial
        if not estimator.has_estimate:
            return None
        ned, unknown = mavlink.MAV_FRAME_LOCAL_NED, [math.nan] * 21
        pose = (
            *estimator.position_m,
            list(inertial.estimate_attitude()),
            *estimator.velocity_mps,
            *inertial.measure_rates(),
        )
        estimator_type = mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT
        return mavlink.MAVLink_odometry_message(
            self._read_boot_us(at_ns), ned, ned, *pose, unknown, unknown, 0, estimator_type
        )

    def _compute_heading_cdeg(self) -> int:
        return round(math.degrees(compute_heading_rad(self._sources.vehicle.attitude)) * 100.0) % 36000

    def _compute_height_m(self) -> float:
        return self._sources.pilot.home_m[2] - self._sources.estimator.position_m[2]

    def _make_global_position(self, at_ns: int) -> Message | None:
        sources = self._sources
        if not sources.estimator.has_global_position:
            return None
        position = sources.estimator.position_m
        speed = (min(max(round(100.0 * value), -32768), 32767) for value in sources.estimator.velocity_mps)
        geodetic = (
            *sources.origin.compute_degrees_e7(position),
            sources.origin.compute_altitude_mm(position),
            clip_mm(self._compute_height_m()),
        )
        return mavlink.MAVLink_global_position_int_message(
            self._read_boot_ms(at_ns), *geodetic, *speed, self._compute_heading_cdeg()
        )

    def _make_origin(self, at_ns: int) -> Message | None:
        sources = self._sources
        if not sources.estimator.has_global_position:
            return None
        zero = (0.0, 0.0, 0.0)
        geodetic = *sources.origin.compute_degrees_e7(zero), sources.origin.compute_altitude_mm(zero)
        return mavlink.MAVLink_gps_global_origin_message(*geodetic, self._read_boot_us(at_ns))

    def _make_home(self, at_ns: int) -> Message | None:
        sources, home = self._sources, self._sources.pilot.home_m
        if not sources.estimator.has_global_position:
            return None
        geodetic = *sources.origin.compute_degrees_e7(home), sources.origin.compute_altitude_mm(home)
        attitude = [1.0, 0.0, 0.0, 0.0] if sources.profile.name == "px4" else [math.nan] * 4  # as recorded
        return mavlink.MAVLink_home_position_message(
            *geodetic, *home, attitude, 0.0, 0.0, 0.0, self._read_boot_us(at_ns)
        )

    def _make_rc_channels(self, at_ns: int) -> Message | None:
        """Return RC_CHANNELS with the stick at rest, and the switch of modes; nothing without a remote control."""
        if not self._sources.pilot.has_radio:
            return None
        stick_us = *STICK_CENTRE_US, self._sources.pilot.switch_us
        channels = *stick_us, *([NO_CHANNEL] * (18 - len(stick_us)))
        return mavlink.MAVLink_rc_channels_message(self._read_boot_ms(at_ns), len(stick_us), *channels, FULL_SIGNAL)

    def _make_hud(self, _at_ns: int) -> Message:
        sources = self._sources
        north, east, down = sources.estimator.velocity_mps
        speed = math.hypot(north, east)
        height = sources.origin.altitude_m - sources.estimator.position_m[2]
        throttle = 50 if sources.pilot.phase is not Phase.GROUND else 0
        return mavlink.MAVLink_vfr_hud_message(
            speed, speed, self._compute_heading_cdeg() // 100, throttle, height, -down
        )

    def _make_altitude(self, at_ns: int) -> Message:
        sources = self._sources
        local = -sources.estimator.position_m[2]
        amsl = sources.origin.altitude_m + local
        heights = amsl, amsl, local, self._compute_height_m(), math.nan, math.nan
        return mavlink.MAVLink_altitude_message(self._read_boot_us(at_ns), *heights)

    def _make_target(self, at_ns: int) -> Message | None:
        sources = self._sources
        return make_position_target(
            sources.profile, sources.pilot, sources.estimator, sources.vehicle.attitude, self._read_boot_ms(at_ns)
        )

    def _make_timesync(self, at_ns: int) -> Message:
        """Return a TIMESYNC request of the autopilot's own."""
        return mavlink.MAVLink_timesync_message(0, self._sources.clock.read_ns(at_ns))

    def _make_battery(self, _at_ns: int) -> Message:
        battery = self._sources.vehicle.battery
        volts = [round(1000.0 * battery.voltage_v), *([65535] * 9)]
        used_mah = round((1.0 - battery.remaining) * CAPACITY_MAH)
        return mavlink.MAVLink_battery_status_message(
            0, 0, 1, 32767, volts, round(100.0 * battery.current_a), used_mah, -1, round(100.0 * battery.remaining)
        )

    def _make_version(self, _at_ns: int) -> Message:
        is_px4 = self._sources.profile.name == "px4"
        capabilities = FLOAT | COMMAND_INT | FILES | LOCAL_TARGETS | MAVLINK2 | (BYTEWISE if is_px4 else CAST)
        version = self._sources.profile.version
        return mavlink.MAVLink_autopilot_version_message(
            capabilities, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0x5541564354, [0] * 18
        )

    def _make_ekf(self, _at_ns: int) -> Message:
        estimator = self._sources.estimator
        flags, variance = estimator.flags, 0.05 if estimator.is_position_valid else 1.0
        return mavlink.MAVLink_ekf_status_report_message(flags, variance, variance, 0.05, 0.05, 0.0)

    def _make_estimator(self, at_ns: int) -> Message:
        """Return PX4's ESTIMATOR_STATUS; at rest its flags have a constant position."""
        estimator = self._sources.estimator
        flags = estimator.flags | (CONSTANT if self._sources.pilot.phase is Phase.GROUND else 0)
        ratio, accuracy = (0.1, 0.05) if estimator.is_position_valid else (2.0, 10.0)
        return mavlink.MAVLink_estimator_status_message(
            self._read_boot_us(at_ns), flags, ratio, ratio, 0.1, 0.1, 0.0, 0.0, accuracy, 0.1
        )

    @property
    def _is_on_floor(self) -> bool:
        """Whether the vehicle is on the floor, its rotors perhaps spinning up."""
        return self._sources.pilot.phase is Phase.GROUND or (
            self._sources.pilot.phase is Phase.CLIMB and self._sources.vehicle.grounded
        )

    def _make_landed(self, _at_ns: int) -> Message:
        return mavlink.MAVLink_extended_sys_state_message(
            self._sources.profile.vtol_state, (Phase.GROUND if self._is_on_floor else self._sources.pilot.phase).value
        )


def clip_mm(metres: float) -> int:
    """Return a length in millimetres that fits 32 bits [mm]."""
    return min(max(round(1000.0 * metres), -(2**31)), 2**31 - 1)


def convert_to_milli(force_mps2: Vec3, rates_rps: Vec3) -> tuple[int, ...]:
    """Convert specific force to mg and body rates to mrad/s, 16 bits, truncated towards zero as ArduPilot does."""
    values = *(value / GRAVITY_MPS2 for value in force_mps2), *rates_rps
    return tuple(int(min(max(1000.0 * value, -32768.0), 32767.0)) for value in values)
