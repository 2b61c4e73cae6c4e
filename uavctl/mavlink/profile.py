"""One profile of each autopilot that is flown: its modes by name and number, take-off, landing, failsafes, messages.

Another autopilot is a row of `PROFILES` here, as docs/extending.md shows; a simulated one is another row, in
`sim.autopilot.profile`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

# PX4: custom_mode is reserved (16 bits), main mode (8), sub mode (8); src/modules/commander/px4_custom_mode.h
_PX4_MAIN = {
    1: "MANUAL",
    2: "ALTCTL",
    3: "POSCTL",
    4: "AUTO",
    5: "ACRO",
    6: "OFFBOARD",
    7: "STABILIZED",
    8: "RATTITUDE",
    9: "SIMPLE",
    10: "TERMINATION",
}
_PX4_AUTO = {
    1: "READY",
    2: "TAKEOFF",
    3: "LOITER",
    4: "MISSION",
    5: "RTL",
    6: "LAND",
    8: "FOLLOW_TARGET",
    9: "PRECLAND",
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


def _mode_names(prefix: str) -> dict[int, str]:
    """Return the names of an enum of modes by their numbers."""
    named = {name.removeprefix(prefix): int(getattr(mavlink, name)) for name in dir(mavlink) if name.startswith(prefix)}
    return {number: name for name, number in named.items() if name != "ENUM_END"}


# ArduPilot: the enum of modes of each kind of vehicle; ArduPlane's is that of a plane that can hover, too
_PLANE, _ROVER = _mode_names("PLANE_MODE_"), _mode_names("ROVER_MODE_")
_ARDUPILOT = {
    **dict.fromkeys(_COPTER_TYPES, _mode_names("COPTER_MODE_")),
    mavlink.MAV_TYPE_FIXED_WING: _PLANE,
    **dict.fromkeys(range(mavlink.MAV_TYPE_VTOL_DUOROTOR, mavlink.MAV_TYPE_VTOL_RESERVED5 + 1), _PLANE),
    mavlink.MAV_TYPE_GROUND_ROVER: _ROVER,
    mavlink.MAV_TYPE_SURFACE_BOAT: _ROVER,
    mavlink.MAV_TYPE_SUBMARINE: _mode_names("SUB_MODE_"),
    mavlink.MAV_TYPE_ANTENNA_TRACKER: _mode_names("TRACKER_MODE_"),
}


def _px4_mode(vehicle_type: int, custom_mode: int) -> str:
    del vehicle_type
    main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
    name = _PX4_MAIN.get(main, f"MODE_{main}")
    return f"AUTO.{_PX4_AUTO.get(sub, sub)}" if name == "AUTO" else name


def _ardupilot_mode(vehicle_type: int, custom_mode: int) -> str:
    names = _ARDUPILOT.get(vehicle_type)
    return "" if names is None else names.get(custom_mode, f"MODE_{custom_mode}")


@dataclass(frozen=True)
class AutopilotProfile:
    """Profile of one autopilot: its modes for take-off, flight and landing, by its own names, and its habits."""

    external: str  # the mode that takes our setpoints
    take_off: str  # the mode that take-off begins in, asked for on the ground
    climbing: frozenset[str]  # modes that it is in during its own climb and right after
    landing: frozenset[str]  # modes in which it lands by itself
    failsafes: frozenset[str]  # modes that its own failsafes choose
    returns: bool  # A failsafe that ends gives back the mode of before; else its mode stays
    # Arming in `take_off` starts the climb, to a height of its own; else MAV_CMD_NAV_TAKEOFF does, to a height above
    # the place of arming
    climbs_on_arming: bool
    reads_raw: bool  # its RAW_IMU is taken for its acceleration; else HIGHRES_IMU alone is
    wants_place: bool  # without GPS it has to be told a place on the globe before it arms
    moves_stamps: bool  # it moves the stamps of positions by what it has asked with TIMESYNC
    number: int  # MAV_AUTOPILOT of its heartbeats
    inertial: tuple[int, int]  # the messages that show how it turns, and its acceleration
    # A mode's name, of MAV_TYPE and of a heartbeat's custom_mode; empty where the kind of vehicle is not known
    mode_name: Callable[[int, int], str]
    modes: dict[str, tuple[int, int]]  # DO_SET_MODE's parameters 2 and 3 of the modes that are asked for


PROFILES = {
    # Recorded: AUTO.TAKEOFF is given on the ground, arming starts the climb to MIS_TAKEOFF_ALT, then it holds.
    "px4": AutopilotProfile(
        external="OFFBOARD",
        take_off="AUTO.TAKEOFF",
        climbing=frozenset({"AUTO.TAKEOFF", "AUTO.LOITER"}),
        landing=frozenset({"AUTO.LAND", "AUTO.PRECLAND"}),
        failsafes=frozenset({"AUTO.LAND", "AUTO.LOITER", "AUTO.RTL"}),
        returns=True,
        climbs_on_arming=True,
        reads_raw=False,
        wants_place=False,
        moves_stamps=True,
        number=mavlink.MAV_AUTOPILOT_PX4,
        inertial=(mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU),
        mode_name=_px4_mode,
        modes={"OFFBOARD": (6, 0), "AUTO.TAKEOFF": (4, 2)},
    ),
    # It climbs in GUIDED; a setpoint would end the climb.
    "ardupilot": AutopilotProfile(
        external="GUIDED",
        take_off="GUIDED",
        climbing=frozenset({"GUIDED"}),
        landing=frozenset({"LAND"}),
        failsafes=frozenset({"LAND", "RTL", "SMART_RTL", "BRAKE"}),
        returns=False,
        climbs_on_arming=False,
        reads_raw=True,
        wants_place=True,
        moves_stamps=False,
        number=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        inertial=(mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_RAW_IMU),
        mode_name=_ardupilot_mode,
        modes={"GUIDED": (4, 0)},
    ),
}


def autopilot_name(autopilot: int) -> str:
    """`px4`, `ardupilot` or `unknown` of MAV_AUTOPILOT."""
    return next((name for name, profile in PROFILES.items() if profile.number == autopilot), "unknown")


def describe_mode(autopilot: str, vehicle_type: int, custom_mode: int) -> tuple[str, bool]:
    """A mode by the autopilot's own name, and whether it takes our setpoints.

    Numbers mean something else on every autopilot, and on ArduPilot on every kind of vehicle; what is
    not known here never counts as external.
    """
    profile = PROFILES.get(autopilot)
    name = "" if profile is None else profile.mode_name(vehicle_type, custom_mode)
    if profile is None or not name:
        return f"MODE_{custom_mode}", False
    # GUIDED of a plane, a rover or a submarine is not the mode that a copter takes setpoints in.
    return name, name == profile.external and (autopilot != "ardupilot" or vehicle_type in _COPTER_TYPES)
