"""Profiles and parameters of the simulated autopilots: those that change their behaviour, and some that only inform.

The rest of the real ones' thousand parameters are not there: a vehicle that took a parameter and did not heed it would
tell a client something untrue. For the same reason a value that is not simulated is refused.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import Any, Literal

from sim.vehicle.interface import ZERO, Quaternion, compute_heading_rad, rotate_to_ned
from sim.vehicle.loops import LAND_MPS, REFERENCE_ACCEL_MPS2, TUNINGS
from uavctl.records import Vec3


class ParameterType(IntEnum):
    """MAV_PARAM_TYPE."""

    INT8 = 2
    INT16 = 4
    UINT32 = 5
    INT32 = 6
    REAL32 = 9


LIMITS = {ParameterType.INT8: 2**7, ParameterType.INT16: 2**15, ParameterType.INT32: 2**31}


@dataclass(frozen=True)
class Parameter:
    """A parameter of an autopilot."""

    value: float  # at the start
    kind: ParameterType  # its type
    allowed: tuple[float, ...] = ()  # the values that are simulated; empty is all


def _int(value: int, *allowed: float, kind: ParameterType = ParameterType.INT32) -> Parameter:
    return Parameter(value, kind, allowed)


def _byte(value: int, *allowed: float) -> Parameter:
    return _int(value, *allowed, kind=ParameterType.INT8)


def _real(value: float, *allowed: float) -> Parameter:
    return Parameter(value, ParameterType.REAL32, allowed)


def _make_fixed(value: float, kind: ParameterType = ParameterType.REAL32) -> Parameter:
    """Make a parameter that describes the vehicle and cannot be changed."""
    return Parameter(value, kind, (value,))


def _get_tilt_limit_deg(autopilot: str) -> float:
    return round(math.degrees(TUNINGS[autopilot].tilt_limit_rad))


# Values as in the recorded flights; COM_OBL_RC_ACT too, since with the default 0 a lost stream goes unnoticed. Setpoint
# timeouts are the room's, as docs/first-flight.md sets them: as shipped PX4 has 1 s and ArduPilot 3 s.
PX4_PARAMETERS = {
    "BAT_CRIT_THR": _real(0.07),
    "BAT_LOW_THR": _real(0.15),
    "COM_DISARM_PRFLT": _real(10.0),
    "COM_DL_LOSS_T": _int(10),
    "COM_LOW_BAT_ACT": _int(0, 0, 2),  # warn, land when critical
    "COM_OBL_RC_ACT": _int(5, 0, 1, 2, 4, 5),  # 0-2 leave it to the stick, and without one do nothing; land, hold
    "COM_OF_LOSS_T": _real(0.7),
    "COM_RC_IN_MODE": _make_fixed(4, ParameterType.INT32),  # no stick
    "EKF2_BARO_CTRL": _int(1, 0, 1),
    "EKF2_EV_CTRL": _int(0),
    "EKF2_EV_DELAY": _real(0.0),
    "EKF2_GPS_CTRL": _int(7),
    "EKF2_HGT_REF": _int(1, 0, 1, 3),
    "EKF2_MAG_TYPE": _int(0, 0, 5),
    "EKF2_NOAID_TOUT": _int(5_000_000),
    "GF_ACTION": _int(2, 0, 1, 2, 3, 5),  # nothing, warn, hold, return, land
    "GF_MAX_VER_DIST": _real(0.0),  # above home; 0: no fence
    "MAV_SYS_ID": _make_fixed(1, ParameterType.INT32),
    "MIS_TAKEOFF_ALT": _real(2.5),
    "MPC_ACC_HOR": _make_fixed(REFERENCE_ACCEL_MPS2),
    "MPC_LAND_SPEED": _make_fixed(TUNINGS["px4"].land_mps),
    "MPC_TILTMAX_AIR": _make_fixed(_get_tilt_limit_deg("px4")),
    "NAV_DLL_ACT": _int(0, 0, 1, 3),  # nothing, hold, land
    "SYS_HAS_GPS": _int(1, 0, 1),
    "SYS_HAS_MAG": _int(1, 0, 1),
}
ARDUPILOT_PARAMETERS = {
    "ANGLE_MAX": _make_fixed(100 * _get_tilt_limit_deg("ardupilot"), ParameterType.INT16),
    "ARMING_CHECK": _make_fixed(1, ParameterType.INT32),
    "BATT_FS_LOW_ACT": _byte(0, 0, 1),  # nothing, land
    "BATT_LOW_TIMER": _byte(10),
    "BATT_LOW_VOLT": _real(3.4),
    "COMPASS_USE": _byte(1, 0, 1),
    "COMPASS_USE2": _byte(1, 0, 1),
    "COMPASS_USE3": _byte(1, 0, 1),
    "DISARM_DELAY": _byte(10),
    "EK3_SRC1_POSXY": _byte(3, 0, 3, 6),  # None, GPS, external
    "EK3_SRC1_POSZ": _byte(1, 0, 1, 3, 6),  # None, barometer, GPS, external
    "EK3_SRC1_VELXY": _byte(3, 0, 3, 6),
    "EK3_SRC1_VELZ": _byte(3, 0, 3, 6),
    "EK3_SRC1_YAW": _byte(1, 0, 1, 6),  # None, compass, external
    "FENCE_ACTION": _byte(1, 0, 1, 2),  # report, return, land
    "FENCE_ALT_MAX": _real(100.0),  # above home
    "FENCE_ENABLE": _byte(0, 0, 1),
    "FS_EKF_ACTION": _byte(1, 0, 1),  # nothing, land
    "FS_EKF_THRESH": _make_fixed(0.8),
    "FS_GCS_ENABLE": _byte(0, 0, 5),  # nothing, land
    "FS_GCS_TIMEOUT": _real(5.0),
    "GPS1_TYPE": _byte(1, 0, 1),
    "GUID_OPTIONS": _make_fixed(0, ParameterType.INT32),
    "GUID_TIMEOUT": _real(0.7),
    "LAND_SPEED": _make_fixed(100 * LAND_MPS, ParameterType.INT16),
    "PSC_JERK_XY": _make_fixed(TUNINGS["ardupilot"].jerk_mps3),
    "PSC_JERK_Z": _make_fixed(TUNINGS["ardupilot"].jerk_mps3),
    "SYSID_MYGCS": _int(255, kind=ParameterType.INT16),
    "SYSID_THISMAV": _make_fixed(1, ParameterType.INT16),
    "VISO_DELAY_MS": _int(10, kind=ParameterType.INT16),
    "VISO_TYPE": _byte(0, 0, 1),
    "WPNAV_ACCEL": _make_fixed(100 * REFERENCE_ACCEL_MPS2),
    "WP_YAW_BEHAVIOR": _byte(2, 0, 1, 2, 3),  # 0 holds the heading, else the nose follows travel
}
TABLES: dict[str, Mapping[str, Parameter]] = {"px4": PX4_PARAMETERS, "ardupilot": ARDUPILOT_PARAMETERS}
RADIO_MODE = 0  # COM_RC_IN_MODE
SYSTEM_ID_PARAMETER = {"px4": "MAV_SYS_ID", "ardupilot": "SYSID_THISMAV"}


class Parameters:
    """Parameter values of one vehicle, in order of name as they are numbered on the wire.

    Args:
        system_id: MAVLink system id of the vehicle.

    Attributes:
        names: in order; a parameter's index is its place.
    """

    def __init__(self, autopilot: Literal["px4", "ardupilot"], system_id: int = 1, *, has_radio: bool = False) -> None:
        name = SYSTEM_ID_PARAMETER[autopilot]
        table = TABLES[autopilot]
        self._table = {**table, name: _make_fixed(system_id, table[name].kind)}
        if autopilot == "px4" and has_radio:
            self._table["COM_RC_IN_MODE"] = _make_fixed(RADIO_MODE, ParameterType.INT32)
        self._bytewise = autopilot == "px4"
        self._values = {
            name: _round_to_type(parameter.value, parameter.kind) for name, parameter in self._table.items()
        }
        self.names = tuple(sorted(self._table))

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def get_type(self, name: str) -> ParameterType:
        """Return the type of a parameter."""
        return self._table[name].kind

    def get_default(self, name: str) -> float:
        """Return the value of a parameter at the start."""
        return _round_to_type(self._table[name].value, self._table[name].kind)

    def get_allowed(self, name: str) -> tuple[float, ...]:
        """Return the values of a parameter that are simulated; empty means all."""
        return self._table[name].allowed

    def accepts(self, name: str, value: float) -> bool:
        """Return whether a parameter can take a value: a finite one, and one that is simulated."""
        parameter = self._table[name]
        if not math.isfinite(value) or abs(value) > 1e9:
            return False
        return not parameter.allowed or _round_to_type(value, parameter.kind) in {
            _round_to_type(allowed, parameter.kind) for allowed in parameter.allowed
        }

    def set(self, name: str, value: float) -> bool:
        """Change a parameter; return False if it does not take the value and stays as it is."""
        is_accepted = self.accepts(name, value)
        if is_accepted:
            self._values[name] = _round_to_type(value, self._table[name].kind)
        return is_accepted

    def encode(self, name: str) -> float:
        """Encode a value for PARAM_VALUE: PX4 puts the bytes of an integer into the float, ArduPilot casts."""
        value = self._values[name]
        if self._bytewise and self.get_type(name) is not ParameterType.REAL32:
            return float(struct.unpack("<f", struct.pack("<i", int(value)))[0])
        return value

    def decode(self, name: str, wire: float) -> float:
        """Decode the value of PARAM_SET, the inverse of `encoded`."""
        if self._bytewise and self.get_type(name) is not ParameterType.REAL32:
            return float(struct.unpack("<i", struct.pack("<f", wire))[0])
        return wire

    @property
    def digest(self) -> float:
        """PX4's `_HASH_CHECK`: CRC-32 of all names and values in order, its bytes read as a float."""
        crc = 0
        for name in self.names:
            form = "<f" if self.get_type(name) is ParameterType.REAL32 else "<i"
            value = self._values[name] if form == "<f" else int(self._values[name])
            crc = zlib.crc32(name.encode() + struct.pack(form, value), crc)
        return float(struct.unpack("<f", struct.pack("<I", crc))[0])


def _round_to_type(value: float, kind: ParameterType) -> float:
    """Return a value as the autopilot keeps it: a float, or the nearest integer within the type."""
    if kind is ParameterType.REAL32:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    return float(min(max(math.floor(value + 0.5), -LIMITS[kind]), LIMITS[kind] - 1))


# How a PX4 and an ArduCopter differ, as tables: modes, frames, answers, profile.
#
# Mode numbers are the `custom_mode` of each autopilot's HEARTBEAT; base modes are those of recorded flights.


# MAVLink common: MAV_RESULT
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4


class Role(Enum):
    """Role of a mode in the simulation."""

    EXTERNAL = auto()  # takes our setpoints
    HOLD = auto()  # brakes and waits
    TAKEOFF = auto()
    LAND = auto()


@dataclass(frozen=True)
class Mode:
    """A flight mode; `base` is its base_mode while disarmed."""

    name: str
    custom: int
    base: int
    role: Role
    needs_position: bool = True


@dataclass(frozen=True)
class SimulatedProfile:
    """Profile of one kind of autopilot: modes, parameters, timing."""

    name: Literal["px4", "ardupilot"]
    autopilot: int  # MAV_AUTOPILOT
    modes: tuple[Mode, ...]
    initial_mode: str  # mode after boot
    frames: frozenset[int]  # MAV_FRAMEs in which setpoints are taken
    needs_stream: bool  # external mode is refused without setpoints
    timeout_parameter: str  # parameter with the silence [s] after which setpoints have stopped
    preflight_timeout_parameter: (
        str  # parameter with the time [s] after which it disarms itself if it does not take off
    )
    refused_arming: int  # MAV_RESULT
    refused_disarming: int  # MAV_RESULT
    unknown_mode: int  # MAV_RESULT for a mode that it has not
    set_mode_ack: int  # command number that answers SET_MODE
    armed_text: str
    disarmed_text: str
    preflight_text: str  # when it disarms itself before take-off
    landed_text: str  # empty: it says nothing
    takeoff_text: str  # when it notices that it takes off; empty: it says nothing
    touch_text: str  # its simulator's, on the floor's first touch; empty: it says nothing
    liftoff_s: float  # from arming to the thrust that lifts: rotors spin up, thrust ramps
    thrust_ramp_s: float  # the same from the order, armed for long
    landing_detection_s: float  # from standing on the floor to knowing it
    disarm_delay_s: float  # from knowing it to disarming
    resumes_mode: bool  # a landing or a failsafe that ended with disarming leaves the mode of before
    good_flags: int  # ESTIMATOR_STATUS_FLAGS of a good estimate, as recorded in flight
    vtol_state: int  # of EXTENDED_SYS_STATE
    version: int  # flight_sw_version of AUTOPILOT_VERSION
    origin_deg_m: tuple[float, float, float]  # latitude, longitude, altitude of its simulated field
    has_radio: bool  # whether its simulator has a stick by itself, as SYS_STATUS of the recorded flights tells
    greeting: tuple[bytes, ...]  # text on a TCP link, before its first packet and between that and the second

    def get_mode(self, name: str) -> Mode:
        """Return the mode of this name."""
        return next(mode for mode in self.modes if mode.name == name)

    def get_mode_by_role(self, role: Role) -> Mode:
        """Return the first mode of a role."""
        return next(mode for mode in self.modes if mode.role is role)

    def get_mode_by_number(self, custom: int) -> Mode | None:
        """Return the mode with this custom_mode; None if there is none."""
        return next((mode for mode in self.modes if mode.custom == custom), None)


def make_px4_custom_mode(main: int, sub: int) -> int:
    """Return PX4's custom_mode: main mode in bits 16-23, sub mode in bits 24-31."""
    return main << 16 | sub << 24


PX4 = SimulatedProfile(
    name="px4",
    autopilot=12,
    modes=(
        Mode("OFFBOARD", make_px4_custom_mode(6, 0), 17, Role.EXTERNAL),
        Mode("AUTO.LOITER", make_px4_custom_mode(4, 3), 29, Role.HOLD),
        Mode("AUTO.TAKEOFF", make_px4_custom_mode(4, 2), 29, Role.TAKEOFF),
        Mode("AUTO.LAND", make_px4_custom_mode(4, 6), 29, Role.LAND, needs_position=False),
        Mode("POSCTL", make_px4_custom_mode(3, 0), 81, Role.HOLD),
        Mode("AUTO.RTL", make_px4_custom_mode(4, 5), 29, Role.LAND),  # its home is below: it goes down where it is
        Mode("AUTO.DESCEND", make_px4_custom_mode(4, 20), 29, Role.LAND, needs_position=False),
    ),
    initial_mode="AUTO.LOITER",
    frames=frozenset({1, 8}),
    needs_stream=True,
    timeout_parameter="COM_OF_LOSS_T",
    preflight_timeout_parameter="COM_DISARM_PRFLT",
    refused_arming=TEMPORARILY_REJECTED,
    refused_disarming=DENIED,
    unknown_mode=DENIED,
    set_mode_ack=176,
    armed_text="Armed by external command",
    disarmed_text="Disarmed by landing",
    preflight_text="Disarmed by auto preflight disarming",
    landed_text="Landing detected",
    takeoff_text="Takeoff detected",
    touch_text="",
    liftoff_s=3.8,
    thrust_ramp_s=3.0,
    landing_detection_s=1.9,
    disarm_delay_s=2.0,
    resumes_mode=True,
    good_flags=0x37F,
    vtol_state=0,
    version=0x01080000,
    origin_deg_m=(47.397742, 8.545594, 488.0),
    has_radio=False,
    greeting=(),
)

ARDUPILOT = SimulatedProfile(
    name="ardupilot",
    autopilot=3,
    modes=(
        Mode("GUIDED", 4, 89, Role.EXTERNAL),
        Mode("LOITER", 5, 89, Role.HOLD),
        Mode("LAND", 9, 89, Role.LAND, needs_position=False),
        Mode("BRAKE", 17, 89, Role.HOLD),
        Mode("STABILIZE", 0, 81, Role.HOLD, needs_position=False),
        Mode("RTL", 6, 89, Role.LAND),  # its home is below: it goes down where it is
    ),
    initial_mode="STABILIZE",
    frames=frozenset({1, 7, 8, 9}),
    needs_stream=False,
    timeout_parameter="GUID_TIMEOUT",
    preflight_timeout_parameter="DISARM_DELAY",
    refused_arming=FAILED,
    refused_disarming=FAILED,
    unknown_mode=FAILED,
    set_mode_ack=11,
    armed_text="Arming motors",
    disarmed_text="Disarming motors",
    preflight_text="Disarming motors",
    landed_text="",
    takeoff_text="",
    touch_text="SIM Hit ground at 0.500000 m/s",
    liftoff_s=3.4,
    thrust_ramp_s=0.8,
    landing_detection_s=0.0,
    disarm_delay_s=1.65,
    resumes_mode=False,
    good_flags=0x33F,
    vtol_state=3,
    version=0x040602FF,
    origin_deg_m=(-35.363262, 149.165237, 584.0),
    has_radio=True,
    greeting=(b"\n\nInit ArduCopter V4.6.2 (simulated)\n\nFree RAM: 131072\n", b"parameters loaded\nready to fly\n"),
)

SIMULATED = {"px4": PX4, "ardupilot": ARDUPILOT}


# POSITION_TARGET_TYPEMASK
IGNORE_POSITION, IGNORE_VELOCITY, IGNORE_ACCEL, FORCE, IGNORE_YAW = 0x7, 0x38, 0x1C0, 0x200, 0x400
# Beyond is nothing that a vehicle could fly to; limited there, numbers fit what telemetry carries.
MAX_VALUE = 1e6
# MAV_FRAME
LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED = 1, 7, 8, 9
OFFSET_FRAMES = (LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED)
BODY_FRAMES = (BODY_NED, BODY_OFFSET_NED)


class SetpointKind(Enum):
    """Kind of a setpoint."""

    ACCELERATION = auto()
    VELOCITY = auto()
    POSITION = auto()
    STOP = auto()  # nothing flyable: the vehicle stops
    REFUSED = auto()  # nothing: it does not count for the stream
    FATAL = auto()  # the program dies of it


@dataclass(frozen=True)
class ParsedSetpoint:
    """Motion that a setpoint asks for."""

    kind: SetpointKind  # what about
    vector: Vec3 = ZERO  # acceleration, velocity or position in local NED
    yaw_rad: float | None = None  # heading to take; None is not asked
    text: str = ""  # why it was refused
    velocity_mps: Vec3 | None = None  # with a position, the velocity that it moves with; None is a place to go to
    accel_mps2: Vec3 = ZERO  # with that velocity, its acceleration


STOP = ParsedSetpoint(SetpointKind.STOP)
FATAL = ParsedSetpoint(SetpointKind.FATAL)


def parse_setpoint(profile: SimulatedProfile, msg: Any, position_m: Vec3, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint.

    Args:
        place_m: where the vehicle believes to be; offsets count from there.
        attitude: attitude of the vehicle, by which setpoints in body axes are turned.
    """
    return (
        _parse_px4(profile, msg, attitude)
        if profile.name == "px4"
        else _parse_ardupilot(profile, msg, position_m, attitude)
    )


def _read_vectors(msg: Any) -> tuple[Vec3, Vec3, Vec3]:
    return (
        (_limit(msg.x), _limit(msg.y), _limit(msg.z)),
        (_limit(msg.vx), _limit(msg.vy), _limit(msg.vz)),
        (_limit(msg.afx), _limit(msg.afy), _limit(msg.afz)),
    )


def _limit(number: float) -> float:
    """Limit a number; one that is not finite stays as it is."""
    return min(max(number, -MAX_VALUE), MAX_VALUE) if math.isfinite(number) else number


def _is_finite(vector: Vec3) -> bool:
    return all(map(math.isfinite, vector))


def _read_yaw(msg: Any, offset_rad: float) -> float | None:
    if msg.type_mask & IGNORE_YAW or not math.isfinite(msg.yaw):
        return None
    return math.remainder(msg.yaw + offset_rad, math.tau)


def _parse_px4(profile: SimulatedProfile, msg: Any, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint as PX4: a field that is ignored or NaN is unset; all three of a kind are needed to fly it.

    A message in which nothing is set does not count for the stream. Source: PX4's handling of the message in its
    MAVLink receiver.
    """
    is_body_frame = msg.coordinate_frame == BODY_NED
    if msg.coordinate_frame not in profile.frames:
        return ParsedSetpoint(SetpointKind.REFUSED, text=f"setpoint refused: frame {msg.coordinate_frame}")
    position, velocity, accel = (
        _mask_ignored(vector, msg.type_mask >> 3 * i & 0x7, all_or_none=is_body_frame)
        for i, vector in enumerate(_read_vectors(msg))
    )
    if accel and msg.type_mask & FORCE:
        return ParsedSetpoint(SetpointKind.REFUSED, text="force setpoint not supported")
    yaw = _read_yaw(msg, 0.0)
    if position and not is_body_frame:  # there are no positions in body axes
        return _make_position_setpoint(position, velocity, accel, yaw) if _is_finite(position) else STOP
    if velocity:
        rotated = _rotate_yaw(velocity, compute_heading_rad(attitude) if is_body_frame else 0.0)
        return ParsedSetpoint(SetpointKind.VELOCITY, rotated, yaw) if _is_finite(velocity) else STOP
    if accel:
        rotated = rotate_to_ned(attitude, accel) if is_body_frame else accel
        return ParsedSetpoint(SetpointKind.ACCELERATION, rotated, yaw) if _is_finite(accel) else STOP
    return ParsedSetpoint(SetpointKind.REFUSED, text="SET_POSITION_TARGET_LOCAL_NED invalid")


def _make_position_setpoint(
    position: Vec3, velocity: Vec3 | None, accel: Vec3 | None, yaw: float | None
) -> ParsedSetpoint:
    """Return a position setpoint, with velocity and acceleration if they are given in full."""
    finite_velocity = velocity if velocity and _is_finite(velocity) else None
    finite_accel = accel if accel and _is_finite(accel) else None
    if finite_velocity is None and finite_accel is None:
        return ParsedSetpoint(SetpointKind.POSITION, position, yaw)
    return ParsedSetpoint(
        SetpointKind.POSITION, position, yaw, velocity_mps=finite_velocity or ZERO, accel_mps2=finite_accel or ZERO
    )


def _mask_ignored(vector: Vec3, ignored: int, *, all_or_none: bool) -> Vec3 | None:
    """Return a vector with NaN on ignored axes, None if all are; with `whole`, one ignored axis ignores all."""
    if all_or_none and ignored:
        return None
    north, east, down = (math.nan if ignored >> i & 1 else number for i, number in enumerate(vector))
    return (north, east, down) if any(map(math.isfinite, (north, east, down))) else None


def _rotate_yaw(vector: Vec3, heading: float) -> Vec3:
    """Return a vector turned about the vertical."""
    north, east, down = vector
    cos, sin = math.cos(heading), math.sin(heading)
    return (cos * north - sin * east, sin * north + cos * east, down) if heading != 0.0 else vector


def _parse_ardupilot(profile: SimulatedProfile, msg: Any, position_m: Vec3, attitude: Quaternion) -> ParsedSetpoint:
    """Read a setpoint as ArduPilot: one ignored axis ignores all three; NaN passes; the force bit is dropped."""
    if msg.coordinate_frame not in profile.frames:
        return STOP
    heading = compute_heading_rad(attitude) if msg.coordinate_frame in BODY_FRAMES else 0.0
    position, velocity, accel = _read_vectors(msg)
    if not msg.type_mask & IGNORE_POSITION:
        kind, vector = SetpointKind.POSITION, position
    elif not msg.type_mask & IGNORE_VELOCITY:
        kind, vector = SetpointKind.VELOCITY, velocity
    elif not msg.type_mask & IGNORE_ACCEL:
        kind, vector = SetpointKind.ACCELERATION, accel
    else:
        return STOP
    if not _is_finite(vector):
        return FATAL
    north, east, down = _rotate_yaw(vector, heading)
    if kind is SetpointKind.POSITION and msg.coordinate_frame in OFFSET_FRAMES:
        north, east, down = north + position_m[0], east + position_m[1], down + position_m[2]
    if kind is SetpointKind.POSITION and not msg.type_mask & IGNORE_VELOCITY:
        rotated_velocity = _rotate_yaw(velocity, heading)
        rotated_accel = ZERO if msg.type_mask & IGNORE_ACCEL else _rotate_yaw(accel, heading)
        return (
            _make_position_setpoint((north, east, down), rotated_velocity, rotated_accel, _read_yaw(msg, heading))
            if _is_finite(velocity)
            else FATAL
        )
    return ParsedSetpoint(kind, (north, east, down), _read_yaw(msg, heading))
