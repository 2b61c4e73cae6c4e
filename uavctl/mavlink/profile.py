"""One profile of each autopilot that is flown: its modes by name and number, take-off, landing, failsafes, messages.

Another autopilot is a row of `PROFILES` here, as docs/extending.md shows; a simulated one is another row, in
`sim.autopilot.profile`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.records import VehicleStatus


class ModeChoice(Enum):
    """Possible choosers of a mode of an autopilot."""

    PERSON = "a person, with a stick or at a ground station"  # also a mode that the autopilot restores
    EITHER = "a person, or a failsafe"  # it flies by itself
    FAILSAFE = "a failsafe only"


_P, _E, _F = ModeChoice.PERSON, ModeChoice.EITHER, ModeChoice.FAILSAFE
# PX4: custom_mode is reserved (16 bits), main mode (8), sub mode (8). Main modes: src/modules/commander/
# px4_custom_mode.h; who chooses them: src/modules/commander/failsafe/failsafe.cpp.
_PX4_MAIN = {
    1: ("MANUAL", _P),
    2: ("ALTCTL", _P),
    3: ("POSCTL", _P),
    4: ("AUTO", _P),
    5: ("ACRO", _P),
    6: ("OFFBOARD", _P),
    7: ("STABILIZED", _P),
    8: ("RATTITUDE", _P),
    9: ("SIMPLE", _P),
    10: ("TERMINATION", _F),
    11: ("ALTITUDE_CRUISE", _P),
}
_PX4_AUTO = {
    1: ("READY", _P),
    2: ("TAKEOFF", _P),
    3: ("LOITER", _E),
    4: ("MISSION", _P),
    5: ("RTL", _E),
    6: ("LAND", _E),
    7: ("RTGS", _E),  # of old versions: back to the ground station
    8: ("FOLLOW_TARGET", _P),
    9: ("PRECLAND", _E),
    10: ("VTOL_TAKEOFF", _P),
    **{10 + number: (f"EXTERNAL{number}", _P) for number in range(1, 9)},
    19: ("GUIDED_COURSE", _P),
    20: ("DESCEND", _F),  # recorded: down without a position
}
_COPTER_TYPES = frozenset(
    {
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_TYPE_COAXIAL,
        mavlink.MAV_TYPE_HELICOPTER,
        mavlink.MAV_TYPE_HEXAROTOR,
        mavlink.MAV_TYPE_OCTOROTOR,
        mavlink.MAV_TYPE_TRICOPTER,
        mavlink.MAV_TYPE_DODECAROTOR,
        mavlink.MAV_TYPE_DECAROTOR,
    }
)


def _read_mode_names(prefix: str) -> dict[int, str]:
    """Return the names of a mode enum by number."""
    named = {name.removeprefix(prefix): int(getattr(mavlink, name)) for name in dir(mavlink) if name.startswith(prefix)}
    return {number: name for name, number in named.items() if name != "ENUM_END"}


# ArduPilot: the enum of modes of each kind of vehicle; ArduPlane's is that of a plane that can hover, too
_COPTER, _PLANE, _ROVER = map(_read_mode_names, ("COPTER_MODE_", "PLANE_MODE_", "ROVER_MODE_"))
_ARDUPILOT = {
    **dict.fromkeys(_COPTER_TYPES, _COPTER),
    mavlink.MAV_TYPE_FIXED_WING: _PLANE,
    **dict.fromkeys(range(mavlink.MAV_TYPE_VTOL_DUOROTOR, mavlink.MAV_TYPE_VTOL_RESERVED5 + 1), _PLANE),
    mavlink.MAV_TYPE_GROUND_ROVER: _ROVER,
    mavlink.MAV_TYPE_SURFACE_BOAT: _ROVER,
    mavlink.MAV_TYPE_SUBMARINE: _read_mode_names("SUB_MODE_"),
    mavlink.MAV_TYPE_ANTENNA_TRACKER: _read_mode_names("TRACKER_MODE_"),
}
# Who chooses the modes of a copter: ArduCopter/events.cpp, fence.cpp, avoidance_adsb.cpp.
_COPTER_EITHER = frozenset({"AUTO", "AUTO_RTL", "AUTOROTATE", "BRAKE", "LAND", "RTL", "SMART_RTL"})
_PX4_CHOICES = {name: choice for name, choice in _PX4_MAIN.values() if name != "AUTO"} | {
    f"AUTO.{name}": choice for name, choice in _PX4_AUTO.values()
}
_COPTER_CHOICES = {name: _E if name in _COPTER_EITHER else _P for name in _COPTER.values()} | {"AVOID_ADSB": _F}


def _name_px4_mode(vehicle_type: int, custom_mode: int) -> str:
    del vehicle_type
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    name = _PX4_MAIN[main][0] if main in _PX4_MAIN else f"MODE_{main}"
    if name != "AUTO":
        return name
    return f"AUTO.{_PX4_AUTO[sub][0] if sub in _PX4_AUTO else sub}"


def _name_ardupilot_mode(vehicle_type: int, custom_mode: int) -> str:
    names = _ARDUPILOT.get(vehicle_type)
    return "" if names is None else names.get(custom_mode, f"MODE_{custom_mode}")


@dataclass(frozen=True)
class AutopilotProfile:
    """Profile of one autopilot: its modes by its own names, and its behaviour."""

    external_mode: str  # the mode that takes our setpoints
    take_off_mode: str  # the mode in which take-off begins, requested on the ground
    climb_modes: frozenset[str]  # its modes in its own climb and right after
    landing_modes: frozenset[str]  # its modes in its own landing
    mode_choices: dict[str, ModeChoice]  # its modes, and the possible choosers of each
    # Modes of a person that a failsafe also chooses if the previous mode is not possible any more
    degraded_modes: frozenset[str]
    # The end of a failsafe restores the previous mode; otherwise the mode of the failsafe stays
    restores_mode: bool
    # Arming in `take_off_mode` starts the climb, to its own height. Otherwise MAV_CMD_NAV_TAKEOFF starts it, to a
    # height above the place of arming.
    climbs_on_arming: bool
    uses_raw_imu: bool  # use RAW_IMU for its acceleration; otherwise only HIGHRES_IMU
    needs_global_origin: bool  # without GPS it needs a global origin before it arms
    number: int  # MAV_AUTOPILOT of its heartbeats
    inertial_messages: tuple[int, int]  # its messages of attitude and acceleration
    # Name of a mode by MAV_TYPE and custom_mode of a heartbeat; empty for an unknown kind of vehicle.
    mode_name: Callable[[int, int], str]
    mode_parameters: dict[str, tuple[int, int]]  # parameters 2 and 3 of DO_SET_MODE for the requested modes


PROFILES = {
    # Recorded: AUTO.TAKEOFF is given on the ground, arming starts the climb to MIS_TAKEOFF_ALT, then it holds.
    "px4": AutopilotProfile(
        external_mode="OFFBOARD",
        take_off_mode="AUTO.TAKEOFF",
        climb_modes=frozenset({"AUTO.TAKEOFF", "AUTO.LOITER"}),
        landing_modes=frozenset({"AUTO.LAND", "AUTO.PRECLAND", "AUTO.DESCEND"}),
        mode_choices=_PX4_CHOICES,
        # COM_OBL_RC_ACT 0 to 2, COM_POSCTL_NAVL; a mode of another program that stands for RTL or LAND
        degraded_modes=frozenset(
            {"POSCTL", "ALTCTL", "STABILIZED", "MANUAL", *(f"AUTO.EXTERNAL{n}" for n in range(1, 9))}
        ),
        restores_mode=True,
        climbs_on_arming=True,
        uses_raw_imu=False,
        needs_global_origin=False,
        number=mavlink.MAV_AUTOPILOT_PX4,
        inertial_messages=(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU),
        mode_name=_name_px4_mode,
        mode_parameters={"OFFBOARD": (6, 0), "AUTO.TAKEOFF": (4, 2)},
    ),
    # It climbs in GUIDED; a setpoint would end the climb.
    "ardupilot": AutopilotProfile(
        external_mode="GUIDED",
        take_off_mode="GUIDED",
        climb_modes=frozenset({"GUIDED"}),
        landing_modes=frozenset({"LAND"}),
        mode_choices=_COPTER_CHOICES,
        degraded_modes=frozenset({"ALT_HOLD", "LOITER"}),  # FS_EKF_ACTION 2, and where BRAKE ends
        restores_mode=False,
        climbs_on_arming=False,
        uses_raw_imu=True,
        needs_global_origin=True,
        number=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        inertial_messages=(mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_RAW_IMU),
        mode_name=_name_ardupilot_mode,
        mode_parameters={"GUIDED": (4, 0)},
    ),
}

_NAMES = {profile.number: name for name, profile in PROFILES.items()}


def find_profile(vehicle: VehicleStatus) -> AutopilotProfile:
    """Return the profile of the autopilot; PX4's for an unknown one, which never gets a mode request."""
    return PROFILES.get(vehicle.autopilot, PROFILES["px4"])


def find_autopilot_name(autopilot: int) -> str:
    """Return the name of a MAV_AUTOPILOT: `px4`, `ardupilot` or `unknown`."""
    return _NAMES.get(autopilot, "unknown")


def describe_mode(autopilot: str, vehicle_type: int, custom_mode: int) -> tuple[str, bool]:
    """Return a mode by the autopilot's own name, and whether it takes our setpoints.

    Mode numbers differ by autopilot, and on ArduPilot by kind of vehicle. An unknown mode never counts as external.
    """
    profile = PROFILES.get(autopilot)
    name = "" if profile is None else profile.mode_name(vehicle_type, custom_mode)
    if profile is None or not name:
        return f"MODE_{custom_mode}", False
    # GUIDED of a plane, a rover or a submarine is not the mode that a copter takes setpoints in.
    return name, name == profile.external_mode and (autopilot != "ardupilot" or vehicle_type in _COPTER_TYPES)
