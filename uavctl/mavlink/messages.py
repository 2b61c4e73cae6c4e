"""The MAVLink messages that are understood, as typed records."""

from __future__ import annotations

import msgspec

from uavctl.frames import Convention, Quaternion
from uavctl.records import Vec3


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """Base of the messages that are understood; `system` and `component` sent it."""

    system: int
    component: int


class Position(Message, frozen=True, kw_only=True):
    """A position, and perhaps a velocity, in the axes that the message declares."""

    name: str  # name of the MAVLink message
    stamp_us: int | None  # the source's time of capture [µs]; None if it gives none
    boot_ms: bool = False  # the stamp is `time_boot_ms`, which wraps at 2**32 ms
    position_m: Vec3  # position [m]
    velocity_mps: Vec3 | None = None  # velocity in the same axes [m/s], or None
    convention: Convention | None = None  # axes that the message declares; None if it leaves them to the configuration
    local_ned: bool = False  # the message is in the vehicle's local NED already
    # attitude of the body (w, x, y, z), body axes to those of the position; None if not given, or no rotation
    attitude: Quaternion | None = None
    # the attitude came as Euler angles: its body axes are forward, right, down in a frame that points down and forward,
    # left, up in one that points up. Otherwise they are forward, right, down.
    euler: bool = False


class Heartbeat(Message, frozen=True, kw_only=True):
    """HEARTBEAT."""

    vehicle_type: int
    autopilot: int
    base_mode: int
    custom_mode: int
    system_status: int


class TimeSync(Message, frozen=True, kw_only=True):
    """TIMESYNC: a request if `tc1_ns` is 0, else an answer to the request of `ts1_ns`."""

    tc1_ns: int
    ts1_ns: int


class LandedState(Message, frozen=True, kw_only=True):
    """EXTENDED_SYS_STATE; None while the vehicle does not know. `own_climb`: it takes off, or lands, by itself."""

    landed: bool | None
    own_climb: bool = False


class Battery(Message, frozen=True, kw_only=True):
    """SYS_STATUS or BATTERY_STATUS."""

    voltage_v: float | None  # None if it is not measured
    remaining: float | None = None  # share of the charge, 0 to 1; None if it is not known
    has_radio: bool | None = None  # a remote control is received; None if unknown
    is_within_fence: bool = True  # it is not beyond a fence of its own


class FenceBreach(Message, frozen=True, kw_only=True):
    """FENCE_STATUS."""

    is_breached: bool  # it is beyond a fence of its own


class RadioChannels(Message, frozen=True, kw_only=True):
    """RC_CHANNELS or RC_CHANNELS_RAW."""

    channels_us: tuple[int, ...]  # pulse of each channel, from the first [µs]; 0 where there is none


class ModeCommand(Message, frozen=True, kw_only=True):
    """SET_MODE, or COMMAND_LONG that changes the mode, of any sender."""

    target_system: int  # 0 is for everybody


class StatusText(Message, frozen=True, kw_only=True):
    """STATUSTEXT, or a chunk of a long one."""

    severity: int  # MAV_SEVERITY, from 0 (emergency) to 7 (debug)
    text: str
    text_id: int = 0  # number of the long text that this is a chunk of; 0: the text is whole
    chunk: int = 0  # number of the chunk, from 0
    has_more: bool = False  # another chunk follows


class CommandAck(Message, frozen=True, kw_only=True):
    """COMMAND_ACK; `result` is MAV_RESULT, 0 accepted; target 0 is for everybody."""

    command: int
    result: int
    target_system: int
    target_component: int


class GlobalOrigin(Message, frozen=True, kw_only=True):
    """GPS_GLOBAL_ORIGIN: the vehicle has a global origin of its local frame."""


class Attitude(Message, frozen=True, kw_only=True):
    """ATTITUDE or ATTITUDE_QUATERNION."""

    angles_rad: Vec3  # roll, pitch, yaw of body axes forward, right, down in NED
    rates_rps: Vec3 | None = None  # body rates about forward, right, down; None if not finite
    quaternion: bool = False  # it is ATTITUDE_QUATERNION
    stamp_us: int = 0  # by the sender's clock, since boot; 0 if unknown


class Inertial(Message, frozen=True, kw_only=True):
    """HIGHRES_IMU or RAW_IMU: specific force, body axes forward, right, down [m/s²]."""

    specific_force_mps2: Vec3  # acceleration less gravity; (0, 0, -g) at rest
    raw: bool = False  # it is RAW_IMU, whose unit is the sender's own: read as ArduPilot's, thousandths of g
    stamp_us: int = 0  # by the sender's clock, since boot or an epoch; 0 if unknown


class ParamValue(Message, frozen=True, kw_only=True):
    """PARAM_VALUE; `cast` and `bytewise` are the two readings of the same four bytes."""

    name: str  # name of the parameter
    cast: float  # the value as a number, as ArduPilot means it
    bytewise: float  # the value as PX4 means it: the bytes of an integer, if the type is one
    index: int = 65535  # its index in the list; 65535 if unknown
    count: int = 0  # number of parameters of the vehicle


class EstimatorFlags(Message, frozen=True, kw_only=True):
    """ESTIMATOR_STATUS or EKF_STATUS_REPORT: sources that the vehicle's own estimator trusts."""

    flags: int  # ESTIMATOR_STATUS_FLAGS, which are EKF_STATUS_FLAGS


class AutopilotVersion(Message, frozen=True, kw_only=True):
    """AUTOPILOT_VERSION."""

    capabilities: int  # MAV_PROTOCOL_CAPABILITY
    version: tuple[int, int, int]  # of the software: major, minor, patch
