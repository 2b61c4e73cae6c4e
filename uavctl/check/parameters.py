"""Items of the vehicle's parameters: what it does when setpoints or positions stop, and where it takes positions from.

The wants are those of docs/autopilots.md, as seen with ArduCopter 4.6 and PX4 (main, 2026).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from uavctl.check.item import Item, State, item
from uavctl.check.positions import limits_m
from uavctl.check.seen import Seen
from uavctl.config.types import Config

Get = Callable[[str], float | None]
_SLOW_S = 1.0
_NO_RADIO = 4  # COM_RC_IN_MODE
_EXTERNAL = 6  # EK3_SRC1_*
_HORIZONTAL, _VERTICAL, _YAW = 1, 2, 8  # EKF2_EV_CTRL
_ANY = "any value"


class Verdict(NamedTuple):
    """How a value is, and what is wanted in its place with the other parameters as they are."""

    state: State
    want: str


Judge = Callable[[float, Get, Config], Verdict]


@dataclass(frozen=True)
class Rule:
    """One parameter: how its value is judged, and what to do about another one."""

    name: str
    hint: str
    judge: Judge


def _wanted(want: str, *, good: bool, otherwise: State = State.NOTE) -> Verdict:
    return Verdict(State.GOOD if good else otherwise, want)


def _only(applies: bool, want: str, unless: str, *, good: bool) -> Verdict:
    """A want that holds under a condition alone; without it any value will do, and that is what is said."""
    return _wanted(want, good=good) if applies else Verdict(State.GOOD, f"{_ANY}: {unless}")


def _timeout(value: float, _get: Get, config: Config) -> Verdict:
    least_s = 3.0 * config.daemon.tick_s
    want = f"{least_s:g} s (three times daemon.tick_s) to {_SLOW_S:g} s"
    return _wanted(want, good=least_s <= value <= _SLOW_S, otherwise=State.BAD if value < least_s else State.NOTE)


def _offboard_loss(value: float, get: Get, _config: Config) -> Verdict:
    flies_on = value in (0, 1, 2) and get("COM_RC_IN_MODE") == _NO_RADIO
    return _wanted("4: land, or 5: hold", good=value in (4, 5), otherwise=State.BAD if flies_on else State.NOTE)


def _guided_options(value: float, _get: Get, _config: Config) -> Verdict:
    return _wanted("bits 4 and 5 off", good=not int(value) & 0x30)


def _copter_source(value: float, get: Get, config: Config) -> Verdict:
    if value == _EXTERNAL and get("VISO_TYPE") == 0:
        return Verdict(State.BAD, "6: the cameras, with a VISO_TYPE other than 0")
    otherwise = State.BAD if config.relay.enabled else State.NOTE
    return _wanted("6: the cameras", good=value == _EXTERNAL, otherwise=otherwise)


def _copter_also(value: float, get: Get, _config: Config) -> Verdict:
    applies = get("EK3_SRC1_POSXY") == _EXTERNAL
    return _only(applies, "6: the cameras", "EK3_SRC1_POSXY is not 6", good=value == _EXTERNAL)


def _viso(value: float, get: Get, config: Config) -> Verdict:
    if get("EK3_SRC1_POSXY") != _EXTERNAL and not config.relay.enabled:
        return Verdict(State.GOOD, f"{_ANY}: no external positions are asked for")
    return _wanted("1, or another that is not 0", good=value != 0, otherwise=State.BAD)


def _compass(value: float, get: Get, _config: Config) -> Verdict:
    return _only(get("EK3_SRC1_YAW") == _EXTERNAL, "0: off", "EK3_SRC1_YAW is not 6", good=value == 0)


def _copter_failsafe(value: float, _get: Get, config: Config) -> Verdict:
    return _wanted("1 or 3: land", good=value in (1, 3), otherwise=_without_positions(config))


def _copter_threshold(value: float, _get: Get, config: Config) -> Verdict:
    off = _without_positions(config) if value <= 0.0 else State.NOTE
    return _wanted("0.6 to 1", good=0.6 <= value <= 1.0, otherwise=off)


def _without_positions(config: Config) -> State:
    """How bad it is that nothing ends a flight without positions: where they are ours, they stop when we do."""
    return State.BAD if config.relay.enabled else State.NOTE


def _px4_external(value: float, _get: Get, config: Config) -> Verdict:
    bits = _HORIZONTAL | _VERTICAL | _YAW
    deaf = config.relay.enabled and not int(value) & _HORIZONTAL
    want = f"{bits}: position, height, yaw (bits 0, 1 and 3)"
    return _wanted(want, good=int(value) & bits == bits, otherwise=State.BAD if deaf else State.NOTE)


def _takes(get: Get, bit: int) -> bool:
    """Whether PX4 takes this from external positions."""
    return bool(int(get("EKF2_EV_CTRL") or 0) & bit)


def _px4_height(value: float, get: Get, _config: Config) -> Verdict:
    return _only(_takes(get, _VERTICAL), "3: the cameras", "EKF2_EV_CTRL takes no height", good=value == 3)


def _px4_gps(value: float, get: Get, _config: Config) -> Verdict:
    return _only(_takes(get, _HORIZONTAL), "0: off", "EKF2_EV_CTRL takes no position", good=value == 0)


def _px4_mag(value: float, get: Get, _config: Config) -> Verdict:
    return _only(_takes(get, _YAW), "5: none", "EKF2_EV_CTRL takes no yaw", good=value == 5)


_INDOORS = "the cameras; GPS and compass lead astray indoors"
ARDUPILOT = (
    Rule(
        "GUID_TIMEOUT",
        "when our setpoints stop, the last acceleration goes on for so long: 3 s took 1.9 m/s to 4.9 m/s",
        _timeout,
    ),
    Rule("GUID_OPTIONS", "with them an acceleration is not held against the wind", _guided_options),
    Rule("EK3_SRC1_POSXY", f"set it to 6, and VISO_TYPE to 1, to fly on {_INDOORS}", _copter_source),
    Rule("EK3_SRC1_POSZ", "set it to 6: pressure indoors moves with doors", _copter_also),
    Rule("EK3_SRC1_YAW", "set it to 6: a compass indoors is off by tens of degrees", _copter_also),
    Rule("VISO_TYPE", "set it to 1 and restart: without it they are not read", _viso),
    Rule("COMPASS_USE", "set it to 0: arming checks a compass that is not used", _compass),
    Rule(
        "FS_EKF_ACTION",
        "set it to 1: without its position the vehicle would stay GUIDED and drift, whatever GUID_TIMEOUT is",
        _copter_failsafe,
    ),
    Rule(
        "FS_EKF_THRESH",
        "set it to 0.8, as shipped: 0 turns FS_EKF_ACTION off, which was seen to act 8 s after the last position",
        _copter_threshold,
    ),
)
PX4 = (
    Rule("COM_OF_LOSS_T", "the last setpoint goes on for so long when ours stop", _timeout),
    Rule(
        "COM_OBL_RC_ACT",
        "set it to 4 (land) or 5 (hold; it goes back to OFFBOARD by itself when setpoints come again): with 0 to 2 and "
        "no radio it was seen to fly on the last acceleration for 12 s",
        _offboard_loss,
    ),
    Rule("EKF2_EV_CTRL", f"set it to 11 to fly on {_INDOORS}", _px4_external),
    Rule("EKF2_HGT_REF", "set it to 3: pressure indoors moves with doors", _px4_height),
    Rule("EKF2_GPS_CTRL", f"set it to 0 to fly on {_INDOORS}", _px4_gps),
    Rule("EKF2_MAG_TYPE", "set it to 5: a compass indoors is off by tens of degrees", _px4_mag),
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
    bounds = [f"at most {ceiling_m:g} m, the room (sets)"] if math.isfinite(ceiling_m) else []
    bounds += [f"at least {least_m:g} m, --takeoff"] if least_m else []
    hint = (
        "set it to the height of --takeoff: PX4 climbs to it by itself. Lower, the flight begins below --takeoff (not "
        "at all under a third of it); higher than the room, the ceiling ends the climb if OFFBOARD is not granted"
    )

    def judge(value: float, _get: Get, _config: Config) -> Verdict:
        return _wanted("; ".join(bounds) or _ANY, good=least_m <= value <= ceiling_m)

    return Rule(_TAKE_OFF, hint, judge)


def _one(rule: Rule, get: Get, config: Config) -> Item:
    value = get(rule.name)
    if value is None:
        hint = "it was asked for several times; does this version have it, and does the link carry our messages?"
        return item(rule.name, State.UNDETERMINED, "not told", "its value, to judge it", hint)
    verdict = rule.judge(value, get, config)
    return item(rule.name, verdict.state, f"{value:g}", verdict.want, rule.hint)
