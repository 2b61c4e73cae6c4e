"""Parameters of the simulated autopilots: the ones that change what they do, and some that only tell.

The rest of the real ones' thousand parameters are not there: a vehicle that took a parameter and did not heed it would
tell a client something untrue. For the same reason a value that is not simulated is refused.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from sim.cascade import REFERENCE_ACCEL_MPS2, TUNINGS
from sim.steering import LAND_MPS


class Kind(IntEnum):
    """MAV_PARAM_TYPE."""

    INT8 = 2
    INT16 = 4
    UINT32 = 5
    INT32 = 6
    REAL32 = 9


LIMITS = {Kind.INT8: 2**7, Kind.INT16: 2**15, Kind.INT32: 2**31}


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        value: at the start.
        kind: its type.
        allowed: the values that are simulated; empty is all.
    """

    value: float
    kind: Kind
    allowed: tuple[float, ...] = ()


def _int(value: int, *allowed: float, kind: Kind = Kind.INT32) -> Parameter:
    return Parameter(value, kind, allowed)


def _byte(value: int, *allowed: float) -> Parameter:
    return _int(value, *allowed, kind=Kind.INT8)


def _real(value: float, *allowed: float) -> Parameter:
    return Parameter(value, Kind.REAL32, allowed)


def _told(value: float, kind: Kind = Kind.REAL32) -> Parameter:
    """One that tells what the vehicle is, and cannot be changed."""
    return Parameter(value, kind, (value,))


def _degrees(autopilot: str) -> float:
    return round(math.degrees(TUNINGS[autopilot].tilt_limit_rad))


# Values as in the recorded flights; COM_OBL_RC_ACT too, since with the default 0 a lost stream goes unnoticed.
PX4_PARAMETERS = {
    "BAT_CRIT_THR": _real(0.07),
    "BAT_LOW_THR": _real(0.15),
    "COM_DISARM_PRFLT": _real(10.0),
    "COM_DL_LOSS_T": _int(10),
    "COM_LOW_BAT_ACT": _int(0, 0, 2),  # warn, land when critical
    "COM_OBL_RC_ACT": _int(5, 0, 1, 2, 4, 5),  # 0-2 leave it to the stick, and without one do nothing; land, hold
    "COM_OF_LOSS_T": _real(1.0),
    "COM_RC_IN_MODE": _told(4, Kind.INT32),  # no stick
    "EKF2_BARO_CTRL": _int(1, 0, 1),
    "EKF2_EV_CTRL": _int(0),
    "EKF2_EV_DELAY": _real(0.0),
    "EKF2_GPS_CTRL": _int(7),
    "EKF2_HGT_REF": _int(1, 0, 1, 3),
    "EKF2_MAG_TYPE": _int(0, 0, 5),
    "EKF2_NOAID_TOUT": _int(5_000_000),
    "MAV_SYS_ID": _told(1, Kind.INT32),
    "MIS_TAKEOFF_ALT": _real(2.5),
    "MPC_ACC_HOR": _told(REFERENCE_ACCEL_MPS2),
    "MPC_LAND_SPEED": _told(TUNINGS["px4"].land_mps),
    "MPC_TILTMAX_AIR": _told(_degrees("px4")),
    "NAV_DLL_ACT": _int(0, 0, 1, 3),  # nothing, hold, land
    "SYS_HAS_GPS": _int(1, 0, 1),
    "SYS_HAS_MAG": _int(1, 0, 1),
}
ARDUPILOT_PARAMETERS = {
    "ANGLE_MAX": _told(100 * _degrees("ardupilot"), Kind.INT16),
    "ARMING_CHECK": _told(1, Kind.INT32),
    "BATT_FS_LOW_ACT": _byte(0, 0, 1),  # nothing, land
    "BATT_LOW_TIMER": _byte(10),
    "BATT_LOW_VOLT": _real(3.4),
    "COMPASS_USE": _byte(1, 0, 1),
    "COMPASS_USE2": _byte(1, 0, 1),
    "COMPASS_USE3": _byte(1, 0, 1),
    "DISARM_DELAY": _byte(10),
    "EK3_SRC1_POSXY": _byte(3, 0, 3, 6),  # none, GPS, external
    "EK3_SRC1_POSZ": _byte(1, 0, 1, 3, 6),  # none, barometer, GPS, external
    "EK3_SRC1_VELXY": _byte(3, 0, 3, 6),
    "EK3_SRC1_VELZ": _byte(3, 0, 3, 6),
    "EK3_SRC1_YAW": _byte(1, 0, 1, 6),  # none, compass, external
    "FS_EKF_ACTION": _byte(1, 0, 1),  # nothing, land
    "FS_EKF_THRESH": _told(0.8),
    "FS_GCS_ENABLE": _byte(0, 0, 5),  # nothing, land
    "FS_GCS_TIMEOUT": _real(5.0),
    "GPS1_TYPE": _byte(1, 0, 1),
    "GUID_OPTIONS": _told(0, Kind.INT32),
    "GUID_TIMEOUT": _real(3.0),
    "LAND_SPEED": _told(100 * LAND_MPS, Kind.INT16),
    "PSC_JERK_XY": _told(TUNINGS["ardupilot"].jerk_mps3),
    "PSC_JERK_Z": _told(TUNINGS["ardupilot"].jerk_mps3),
    "SYSID_MYGCS": _int(255, kind=Kind.INT16),
    "SYSID_THISMAV": _told(1, Kind.INT16),
    "VISO_DELAY_MS": _int(10, kind=Kind.INT16),
    "VISO_TYPE": _byte(0, 0, 1),
    "WPNAV_ACCEL": _told(100 * REFERENCE_ACCEL_MPS2),
    "WP_YAW_BEHAVIOR": _byte(2, 0, 1, 2, 3),  # 0 holds the heading, else the nose follows travel
}
TABLES: dict[str, Mapping[str, Parameter]] = {"px4": PX4_PARAMETERS, "ardupilot": ARDUPILOT_PARAMETERS}
WITH_STICK = 0  # COM_RC_IN_MODE
OWN_ID = {"px4": "MAV_SYS_ID", "ardupilot": "SYSID_THISMAV"}


class Parameters:
    """The values of one vehicle, in order of name as they are numbered on the wire.

    Args:
        autopilot: whose they are.
        system_id: MAVLink system id of the vehicle.
        radio: whether there is a stick.

    Attributes:
        names: in order; a parameter's index is its place.
    """

    def __init__(self, autopilot: Literal["px4", "ardupilot"], system_id: int = 1, *, radio: bool = False) -> None:
        name = OWN_ID[autopilot]
        table = TABLES[autopilot]
        self._table = {**table, name: _told(system_id, table[name].kind)}
        if autopilot == "px4" and radio:
            self._table["COM_RC_IN_MODE"] = _told(WITH_STICK, Kind.INT32)
        self._bytewise = autopilot == "px4"
        self._values = {name: _stored(one.value, one.kind) for name, one in self._table.items()}
        self.names = tuple(sorted(self._table))

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def kind(self, name: str) -> Kind:
        """Type of a parameter."""
        return self._table[name].kind

    def allowed(self, name: str) -> tuple[float, ...]:
        """The values of a parameter that are simulated; empty is all."""
        return self._table[name].allowed

    def takes(self, name: str, value: float) -> bool:
        """Whether a parameter can be changed to a value; not if it is none, or is not simulated."""
        one = self._table[name]
        if not math.isfinite(value) or abs(value) > 1e9:
            return False
        return not one.allowed or _stored(value, one.kind) in {_stored(allowed, one.kind) for allowed in one.allowed}

    def set(self, name: str, value: float) -> bool:
        """Change a parameter; False if it stays as it is, since it does not take the value."""
        takes = self.takes(name, value)
        if takes:
            self._values[name] = _stored(value, self._table[name].kind)
        return takes

    def encoded(self, name: str) -> float:
        """A value as it travels in PARAM_VALUE: PX4 puts the bytes of an integer into the float, ArduPilot casts."""
        value = self._values[name]
        if self._bytewise and self.kind(name) is not Kind.REAL32:
            return float(struct.unpack("<f", struct.pack("<i", int(value)))[0])
        return value

    def decoded(self, name: str, wire: float) -> float:
        """The inverse of `encoded` for what PARAM_SET carries."""
        if self._bytewise and self.kind(name) is not Kind.REAL32:
            return float(struct.unpack("<i", struct.pack("<f", wire))[0])
        return wire

    @property
    def digest(self) -> float:
        """PX4's `_HASH_CHECK`: CRC-32 of all names and values in order, its bytes as a float."""
        crc = 0
        for name in self.names:
            form = "<f" if self.kind(name) is Kind.REAL32 else "<i"
            value = self._values[name] if form == "<f" else int(self._values[name])
            crc = zlib.crc32(name.encode() + struct.pack(form, value), crc)
        return float(struct.unpack("<f", struct.pack("<I", crc))[0])


def _stored(value: float, kind: Kind) -> float:
    """A value as the autopilot keeps it: a float, or the nearest integer within the type."""
    if kind is Kind.REAL32:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    return float(min(max(math.floor(value + 0.5), -LIMITS[kind]), LIMITS[kind] - 1))
