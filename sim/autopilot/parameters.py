"""Parameters of the simulated autopilots: those that change their behaviour, and some that only inform.

Other parameters of the real autopilots do not exist here: a vehicle that accepted and ignored a parameter would
mislead a client. For the same reason a value that is not simulated is refused.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from sim.vehicle.loops import REFERENCE_ACCEL_MPS2, TUNINGS
from sim.vehicle.motion_laws import LAND_MPS


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


class Parameters(dict[str, float]):
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
        super().__init__({name: self.get_default(name) for name in self._table})
        self.names = tuple(sorted(self._table))

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
            self[name] = _round_to_type(value, self._table[name].kind)
        return is_accepted

    def encode(self, name: str) -> float:
        """Encode a value for PARAM_VALUE: PX4 puts the bytes of an integer into the float, ArduPilot casts."""
        value = self[name]
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
            value = self[name] if form == "<f" else int(self[name])
            crc = zlib.crc32(name.encode() + struct.pack(form, value), crc)
        return float(struct.unpack("<f", struct.pack("<I", crc))[0])


def _round_to_type(value: float, kind: ParameterType) -> float:
    """Return a value as the autopilot keeps it: a float, or the nearest integer within the type."""
    if kind is ParameterType.REAL32:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    return float(min(max(math.floor(value + 0.5), -LIMITS[kind]), LIMITS[kind] - 1))
