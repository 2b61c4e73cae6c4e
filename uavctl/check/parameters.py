"""Items of the vehicle's parameters: what it does when setpoints or positions stop, and where it takes positions from.

The wants are those of docs/autopilots.md, as seen with ArduCopter 4.6 and PX4 (main, 2026).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from uavctl.check.item import Item, State, item
from uavctl.check.positions import limits_m
from uavctl.check.seen import Seen
from uavctl.config.types import Config

Get = Callable[[str], float | None]
Judge = Callable[[float, Get, Config], State]
_GOOD, _NOTE, _BAD = State.GOOD, State.NOTE, State.BAD
_SLOW_S = 1.0
_NO_RADIO = 4  # COM_RC_IN_MODE
_EXTERNAL, _GPS = 6, 3  # EK3_SRC1_*
_HORIZONTAL, _VERTICAL, _YAW = 1, 2, 8  # EKF2_EV_CTRL


@dataclass(frozen=True)
class Rule:
    """One parameter: what is wanted and why, and how bad another value is."""

    name: str
    want: str
    hint: str
    judge: Judge


def _timeout(value: float, _get: Get, config: Config) -> State:
    if value < 3.0 * config.daemon.tick_s:
        return _BAD
    return _GOOD if value <= _SLOW_S else _NOTE


def _offboard_loss(value: float, get: Get, _config: Config) -> State:
    if value in (4, 5):
        return _GOOD
    return _BAD if value in (0, 1, 2) and get("COM_RC_IN_MODE") == _NO_RADIO else _NOTE


def _guided_options(value: float, _get: Get, _config: Config) -> State:
    return _NOTE if int(value) & 0x30 else _GOOD


def _copter_source(value: float, get: Get, config: Config) -> State:
    if value == _EXTERNAL:
        return _GOOD if get("VISO_TYPE") != 0 else _BAD
    return _BAD if config.relay.enabled else _NOTE


def _copter_yaw(value: float, get: Get, _config: Config) -> State:
    return _NOTE if get("EK3_SRC1_POSXY") == _EXTERNAL and value != _EXTERNAL else _GOOD


def _copter_height(value: float, get: Get, _config: Config) -> State:
    return _NOTE if get("EK3_SRC1_POSXY") == _EXTERNAL and value != _EXTERNAL else _GOOD


def _viso(value: float, get: Get, config: Config) -> State:
    wanted = get("EK3_SRC1_POSXY") == _EXTERNAL or config.relay.enabled
    return _BAD if wanted and value == 0 else _GOOD


def _compass(value: float, get: Get, _config: Config) -> State:
    return _NOTE if get("EK3_SRC1_YAW") == _EXTERNAL and value != 0 else _GOOD


def _px4_external(value: float, _get: Get, config: Config) -> State:
    wanted = _HORIZONTAL | _VERTICAL | _YAW
    if int(value) & wanted == wanted:
        return _GOOD
    return _BAD if config.relay.enabled and not int(value) & _HORIZONTAL else _NOTE


def _px4_height(value: float, get: Get, _config: Config) -> State:
    external = int(get("EKF2_EV_CTRL") or 0) & _VERTICAL
    return _NOTE if external and value != 3 else _GOOD


def _px4_gps(value: float, get: Get, _config: Config) -> State:
    return _NOTE if int(get("EKF2_EV_CTRL") or 0) & _HORIZONTAL and value != 0 else _GOOD


def _px4_mag(value: float, get: Get, _config: Config) -> State:
    return _NOTE if int(get("EKF2_EV_CTRL") or 0) & _YAW and value != 5 else _GOOD


_INDOORS = "the cameras; GPS and compass lead astray indoors"
ARDUPILOT = (
    Rule(
        "GUID_TIMEOUT",
        "at most 1 s",
        "when our setpoints stop, the last acceleration goes on for so long: 3 s took 1.9 m/s to 4.9 m/s",
        _timeout,
    ),
    Rule("GUID_OPTIONS", "bits 4 and 5 off", "with them an acceleration is not held against the wind", _guided_options),
    Rule("EK3_SRC1_POSXY", "6: the cameras", f"set it to 6, and VISO_TYPE to 1, to fly on {_INDOORS}", _copter_source),
    Rule("EK3_SRC1_POSZ", "6: the cameras", "set it to 6: pressure indoors moves with doors", _copter_height),
    Rule("EK3_SRC1_YAW", "6: the cameras", "set it to 6: a compass indoors is off by tens of degrees", _copter_yaw),
    Rule("VISO_TYPE", "1 with external positions", "set it to 1 and restart: without it they are not read", _viso),
    Rule("COMPASS_USE", "0 with EK3_SRC1_YAW 6", "set it to 0: arming checks a compass that is not used", _compass),
    Rule(
        "FS_EKF_ACTION",
        "1 or 3: land",
        "when its position is lost the vehicle would fly on, or drift at constant height",
        lambda value, _get, _config: _GOOD if value in (1, 3) else _NOTE,
    ),
)
PX4 = (
    Rule("COM_OF_LOSS_T", "at most 1 s", "the last setpoint goes on for so long when ours stop", _timeout),
    Rule(
        "COM_OBL_RC_ACT",
        "4: land, or 5: hold",
        "set it to 4 (land) or 5 (hold; it goes back to OFFBOARD by itself when setpoints come again): with 0 to 2 and "
        "no radio it was seen to fly on the last acceleration for 12 s",
        _offboard_loss,
    ),
    Rule("EKF2_EV_CTRL", "11: position, height, yaw", f"set it to 11 to fly on {_INDOORS}", _px4_external),
    Rule("EKF2_HGT_REF", "3: the cameras", "set it to 3: pressure indoors moves with doors", _px4_height),
    Rule("EKF2_GPS_CTRL", "0 with external positions", f"set it to 0 to fly on {_INDOORS}", _px4_gps),
    Rule(
        "EKF2_MAG_TYPE",
        "5: none, with external yaw",
        "set it to 5: a compass indoors is off by tens of degrees",
        _px4_mag,
    ),
)
RULES = {3: ARDUPILOT, 12: PX4}  # MAV_AUTOPILOT
_TAKE_OFF = "MIS_TAKEOFF_ALT"
_ALSO = {3: (), 12: ("COM_RC_IN_MODE", _TAKE_OFF)}


def wanted(autopilot: int | None) -> tuple[str, ...]:
    """Names of the parameters to ask this kind of autopilot for."""
    if autopilot not in RULES:
        return ()
    return (*_ALSO[autopilot], *(rule.name for rule in RULES[autopilot]))


def parameter_items(seen: Seen, config: Config, take_off_m: float | None = None) -> list[Item]:
    """An item for each parameter that matters to this kind of autopilot; `take_off_m` is the climb that is planned."""
    rules = RULES.get(seen.autopilot or 0, ())
    if rules is PX4:
        rules = (*rules, _climb(config, take_off_m))

    def get(name: str) -> float | None:
        return seen.parameter(name, px4=seen.autopilot == 12)

    return [_one(rule, get, config) for rule in rules]


def _climb(config: Config, take_off_m: float | None) -> Rule:
    """PX4 climbs to a height of its own, and is asked for OFFBOARD on the way, where `--takeoff` is reached."""
    ceiling_m = -limits_m(config).get("down", (-math.inf, 0.0))[0]
    least_m = 0.0 if take_off_m is None else take_off_m
    want = f"at most {ceiling_m:g} m, the room (sets)" + (f"; at least {least_m:g} m, --takeoff" if least_m else "")
    hint = (
        "set it to the height of --takeoff: PX4 climbs to it by itself. Lower, the flight begins below --takeoff (not "
        "at all under a third of it); higher than the room, the ceiling ends the climb if OFFBOARD is not granted"
    )
    return Rule(_TAKE_OFF, want, hint, lambda value, _get, _config: _GOOD if least_m <= value <= ceiling_m else _NOTE)


def _one(rule: Rule, get: Get, config: Config) -> Item:
    value = get(rule.name)
    if value is None:
        hint = "it was asked for several times; does this version have it, and does the link carry our messages?"
        return item(rule.name, State.UNDETERMINED, "not told", rule.want, hint)
    return item(rule.name, rule.judge(value, get, config), f"{value:g}", rule.want, rule.hint)
