"""The MAVLink messages that are understood, as typed records."""

from __future__ import annotations

import msgspec

from uavctl.data import Vec3
from uavctl.frames import Convention, Quaternion


class Message(msgspec.Struct, frozen=True, kw_only=True):
    """Base of the messages that are understood; `system` and `component` sent it."""

    system: int
    component: int


class Position(Message, frozen=True, kw_only=True):
    """A position, and perhaps a velocity, in the axes that the message declares.

    Attributes:
        name: name of the MAVLink message.
        stamp_us: the source's time of capture [µs]; None if it gives none.
        boot_ms: the stamp is `time_boot_ms`, which wraps at 2**32 ms.
        position_m: position [m].
        velocity_mps: velocity in the same axes [m/s], or None.
        convention: axes that the message declares; None if it leaves them to the configuration.
        local_ned: the message is in the vehicle's local NED already.
        attitude: how the body is turned (w, x, y, z), body axes to those of the position; None if not given, or no
            rotation.
        euler: the attitude came as Euler angles: its body axes are forward, right, down in a frame that points down
            and forward, left, up in one that points up. Otherwise they are forward, right, down.
    """

    name: str
    stamp_us: int | None
    boot_ms: bool = False
    position_m: Vec3
    velocity_mps: Vec3 | None = None
    convention: Convention | None = None
    local_ned: bool = False
    attitude: Quaternion | None = None
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


class Landed(Message, frozen=True, kw_only=True):
    """EXTENDED_SYS_STATE; None while the vehicle does not know. `own_climb`: it takes off, or lands, by itself."""

    landed: bool | None
    own_climb: bool = False


class Battery(Message, frozen=True, kw_only=True):
    """SYS_STATUS or BATTERY_STATUS with a voltage [V]."""

    voltage_v: float


class Text(Message, frozen=True, kw_only=True):
    """STATUSTEXT, or a piece of a long one.

    Attributes:
        severity: MAV_SEVERITY, 0 the worst, 7 the least.
        text: what it says.
        number: of the long text that it is a piece of; 0: it is whole.
        chunk: which piece, from 0.
        more: another piece follows.
    """

    severity: int
    text: str
    number: int = 0
    chunk: int = 0
    more: bool = False


class Ack(Message, frozen=True, kw_only=True):
    """COMMAND_ACK; `result` is MAV_RESULT, 0 accepted; target 0 is for everybody."""

    command: int
    result: int
    target_system: int
    target_component: int


class Origin(Message, frozen=True, kw_only=True):
    """GPS_GLOBAL_ORIGIN: the vehicle knows its place on the globe."""


class Attitude(Message, frozen=True, kw_only=True):
    """ATTITUDE or ATTITUDE_QUATERNION.

    Attributes:
        angles_rad: roll, pitch, yaw of body axes forward, right, down in NED.
        quaternion: it is ATTITUDE_QUATERNION.
        stamp_us: by the sender's clock, since boot; 0: it does not tell.
    """

    angles_rad: Vec3
    quaternion: bool = False
    stamp_us: int = 0


class Inertial(Message, frozen=True, kw_only=True):
    """HIGHRES_IMU or RAW_IMU: specific force, body axes forward, right, down [m/s²].

    Attributes:
        specific_force_mps2: that; (0, 0, -g) at rest.
        raw: it is RAW_IMU, whose unit is the sender's own: read as ArduPilot's, thousandths of g.
        stamp_us: by the sender's clock, since boot or of an epoch; 0: it does not tell.
    """

    specific_force_mps2: Vec3
    raw: bool = False
    stamp_us: int = 0


class ParamValue(Message, frozen=True, kw_only=True):
    """PARAM_VALUE; `cast` and `bytewise` are the two readings of the same four bytes.

    Attributes:
        name: of the parameter.
        cast: the value as a number, as ArduPilot means it.
        bytewise: the value as PX4 means it: the bytes of an integer, if the type is one.
    """

    name: str
    cast: float
    bytewise: float


class EstimatorFlags(Message, frozen=True, kw_only=True):
    """ESTIMATOR_STATUS or EKF_STATUS_REPORT: what the vehicle's own estimator trusts.

    Attributes:
        flags: ESTIMATOR_STATUS_FLAGS, which are EKF_STATUS_FLAGS.
    """

    flags: int


class AutopilotVersion(Message, frozen=True, kw_only=True):
    """AUTOPILOT_VERSION.

    Attributes:
        capabilities: MAV_PROTOCOL_CAPABILITY.
        version: of the software: major, minor, patch.
    """

    capabilities: int
    version: tuple[int, int, int]
