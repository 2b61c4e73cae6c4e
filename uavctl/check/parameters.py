"""Items of the vehicle's parameters: reaction to lost setpoints and positions, and source of positions.

The wanted values are those of docs/autopilots.md, as observed with ArduCopter 4.6 and PX4 (main, 2026).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from uavctl.check.check_data import CheckData
from uavctl.check.findings import Item, ItemState, make_item
from uavctl.config.checks import get_position_limits_m
from uavctl.config.types import Config
from uavctl.smpc.plant import AXES

ParameterGetter = Callable[[str], float | None]
_MAX_TIMEOUT_S = 1.0
_BRAKING_MPS2 = 2.5  # of an ArduPilot whose setpoints have stopped
_FLOAT32_TOLERANCE = 1e-6  # relative: vehicles keep parameters in single precision
_DIGITS = 7  # decimals, which single precision does not exceed for times up to a second
_NO_RADIO = 4  # COM_RC_IN_MODE
_EXTERNAL = 6  # EK3_SRC1_*
_HORIZONTAL, _VERTICAL, _YAW = 1, 2, 8  # EKF2_EV_CTRL
_ANY = "any value"


class ParameterVerdict(NamedTuple):
    """Verdict on a parameter's value, and the wanted value with the other parameters as they are."""

    state: ItemState
    want: str
    hint: str = ""  # remedy for this value; empty is the hint of the rule


ParameterJudge = Callable[[float, ParameterGetter, Config], ParameterVerdict]


@dataclass(frozen=True)
class Rule:
    """One parameter: the rule for its value, and the remedy."""

    name: str
    hint: str
    judge: ParameterJudge


def _require(want: str, *, is_good: bool, failed_state: ItemState = ItemState.NOTE) -> ParameterVerdict:
    return ParameterVerdict(ItemState.GOOD if is_good else failed_state, want)


def _require_if(applies: bool, want: str, reason: str, *, is_good: bool) -> ParameterVerdict:
    """Judge a want that holds only under a condition; without the condition any value is good."""
    return _require(want, is_good=is_good) if applies else ParameterVerdict(ItemState.GOOD, f"{_ANY}: {reason}")


class Runaway(NamedTuple):
    """Flight on one axis after setpoints have stopped: from rest in the room's middle, with the largest acceleration.

    It accelerates until the vehicle's own timeout, then it brakes: d(t) = a t²/2 + (a t)²/(2 b).
    """

    axis: str
    accel_mps2: float
    free_m: float  # from the middle to a limit

    def distance_m(self, timeout_s: float) -> float:
        """Return how far the vehicle goes until it stands [m]."""
        speed_mps = self.accel_mps2 * timeout_s
        return speed_mps * timeout_s / 2.0 + speed_mps**2 / (2.0 * _BRAKING_MPS2)

    @property
    def max_timeout_s(self) -> float:
        """Timeout after which the vehicle stands at the limit [s]."""
        return math.sqrt(self.free_m / self.distance_m(1.0))  # d grows with t²


def compute_max_accel_mps2(free_m: float, timeout_s: float) -> float:
    """Return the acceleration [m/s²] with which a `Runaway` with this timeout [s] stands at a limit so far away [m].

    a² + a b - 2 b d / t² = 0
    """
    return (math.sqrt(_BRAKING_MPS2**2 + 8.0 * _BRAKING_MPS2 * free_m / timeout_s**2) - _BRAKING_MPS2) / 2.0


def _find_runaways(config: Config) -> list[Runaway]:
    """Return the axes that have limits, the one with the least room for its acceleration first."""
    limits = get_position_limits_m(config).items()
    runaways = [
        Runaway(axis, config.limits.accel_mps2[AXES.index(axis)], (high - low) / 2.0) for axis, (low, high) in limits
    ]
    runaways = [runaway for runaway in runaways if math.isfinite(runaway.free_m)]
    return sorted(runaways, key=lambda runaway: runaway.max_timeout_s)


def _make_timeout_judge(lowest_s: float) -> ParameterJudge:
    """Return the judge of a timeout: until it the last acceleration continues, and the room has to hold that.

    Args:
        lowest_s: timeout that the autopilot does not go below [s].
    """

    def judge(value: float, _get: ParameterGetter, config: Config) -> ParameterVerdict:
        min_s, tightest = max(3.0 * config.daemon.tick_s, lowest_s), _find_runaways(config)[:1]
        fitting_s = min((runaway.max_timeout_s for runaway in tightest), default=math.inf)
        max_s = _round_down(min(_MAX_TIMEOUT_S, fitting_s), min_s)
        if max_s is None:
            hint = (
                f"No value fits. {_describe_distances(tightest, min_s)} Give [sets] more room, or lower "
                f"limits.accel_mps2 ({tightest[0].axis})."
            )
            return ParameterVerdict(ItemState.BAD, f"at least {min_s:.7g} s, in a larger room", hint)
        want = f"{min_s:.7g} to {max_s:.7g} s"
        if value < min_s * (1.0 - _FLOAT32_TOLERANCE):
            hint = (
                f"Set it to {max_s:.7g} s. It has to outlast three setpoints ({3.0 * config.daemon.tick_s:.7g} s), "
                "or a short pause of the link ends the flight."
            )
            return ParameterVerdict(ItemState.BAD, want, hint)
        hint = (
            f"Set it to {max_s:.7g} s or less{_suggest_acceleration(tightest, max_s)}. If setpoints stop, the vehicle "
            f"keeps accelerating that long. {_describe_distances(tightest, value)}"
        )
        if value > fitting_s * (1.0 + _FLOAT32_TOLERANCE):
            return ParameterVerdict(ItemState.BAD, want, hint)
        is_good = value <= max_s * (1.0 + _FLOAT32_TOLERANCE)
        return ParameterVerdict(ItemState.GOOD if is_good else ItemState.NOTE, want, hint)

    return judge


def _suggest_acceleration(tightest: list[Runaway], max_s: float) -> str:
    """Return the other remedy, a lower acceleration, where the room and not the longest timeout is the bound."""
    key = "room.accel_mps2 or limits.accel_mps2"
    return f", or lower {key} ({tightest[0].axis})" if tightest and max_s < _MAX_TIMEOUT_S else ""


def _round_down(max_s: float, min_s: float) -> float | None:
    """Return `most_s` with as few decimals as leave it at `least_s` or above; None if it is below."""
    min_s *= 1.0 - _FLOAT32_TOLERANCE
    candidates_s = (math.floor(max_s * 10**digits + _FLOAT32_TOLERANCE) / 10**digits for digits in range(1, _DIGITS))
    return None if max_s < min_s else next((rounded_s for rounded_s in candidates_s if rounded_s >= min_s), max_s)


def _describe_distances(tightest: list[Runaway], timeout_s: float) -> str:
    """Describe how far a timeout carries the vehicle where the room is tightest; empty in a room without limits."""
    directions = {"north": "north or south", "east": "east or west", "down": "up or down"}
    texts = []
    for runaway in tightest:
        distance_m = runaway.distance_m(timeout_s)
        # As many digits as distinguish the two.
        digits = next((n for n in range(3, 9) if f"{distance_m:.{n}g}" != f"{runaway.free_m:.{n}g}"), 9)
        texts.append(
            f"{timeout_s:.7g} s would carry it {distance_m:.{digits}g} m {directions[runaway.axis]}; your room allows "
            f"{runaway.free_m:.{digits}g} m from its middle."
        )
    return "".join(texts)


def _judge_offboard_loss(value: float, get: ParameterGetter, _config: Config) -> ParameterVerdict:
    keeps_flying = value in (0, 1, 2) and get("COM_RC_IN_MODE") == _NO_RADIO
    return _require(
        "4: land, or 5: hold", is_good=value in (4, 5), failed_state=ItemState.BAD if keeps_flying else ItemState.NOTE
    )


def _judge_guided_options(value: float, _get: ParameterGetter, _config: Config) -> ParameterVerdict:
    return _require("bits 4 and 5 off", is_good=not int(value) & 0x30)


def _judge_copter_source(value: float, get: ParameterGetter, config: Config) -> ParameterVerdict:
    if value == _EXTERNAL and get("VISO_TYPE") == 0:
        return ParameterVerdict(ItemState.BAD, "6: the cameras, with a VISO_TYPE other than 0")
    failed_state = ItemState.BAD if config.relay.enabled else ItemState.NOTE
    return _require("6: the cameras", is_good=value == _EXTERNAL, failed_state=failed_state)


def _judge_copter_other_source(value: float, get: ParameterGetter, _config: Config) -> ParameterVerdict:
    applies = get("EK3_SRC1_POSXY") == _EXTERNAL
    return _require_if(applies, "6: the cameras", "EK3_SRC1_POSXY is not 6", is_good=value == _EXTERNAL)


def _judge_viso(value: float, get: ParameterGetter, config: Config) -> ParameterVerdict:
    if get("EK3_SRC1_POSXY") != _EXTERNAL and not config.relay.enabled:
        return ParameterVerdict(ItemState.GOOD, f"{_ANY}: external positions are not used")
    return _require("1, or another that is not 0", is_good=value != 0, failed_state=ItemState.BAD)


def _judge_compass(value: float, get: ParameterGetter, _config: Config) -> ParameterVerdict:
    return _require_if(get("EK3_SRC1_YAW") == _EXTERNAL, "0: off", "EK3_SRC1_YAW is not 6", is_good=value == 0)


def _judge_copter_failsafe(value: float, _get: ParameterGetter, config: Config) -> ParameterVerdict:
    return _require("1 or 3: land", is_good=value in (1, 3), failed_state=_grade_missing_failsafe(config))


def _judge_copter_threshold(value: float, _get: ParameterGetter, config: Config) -> ParameterVerdict:
    failed_state = _grade_missing_failsafe(config) if value <= 0.0 else ItemState.NOTE
    return _require("0.6 to 1", is_good=0.6 <= value <= 1.0, failed_state=failed_state)


def _grade_missing_failsafe(config: Config) -> ItemState:
    """Return how bad it is that nothing ends a flight without positions: where they are ours, they stop when we do."""
    return ItemState.BAD if config.relay.enabled else ItemState.NOTE


def _judge_px4_external(value: float, _get: ParameterGetter, config: Config) -> ParameterVerdict:
    bits = _HORIZONTAL | _VERTICAL | _YAW
    is_ignored = config.relay.enabled and not int(value) & _HORIZONTAL
    want = f"{bits}: position, height, yaw (bits 0, 1 and 3)"
    return _require(
        want, is_good=int(value) & bits == bits, failed_state=ItemState.BAD if is_ignored else ItemState.NOTE
    )


def _fuses_external(get: ParameterGetter, bit: int) -> bool:
    """Whether PX4 takes this from external positions."""
    return bool(int(get("EKF2_EV_CTRL") or 0) & bit)


def _judge_px4_height(value: float, get: ParameterGetter, _config: Config) -> ParameterVerdict:
    return _require_if(
        _fuses_external(get, _VERTICAL), "3: the cameras", "EKF2_EV_CTRL takes no height", is_good=value == 3
    )


def _judge_px4_gps(value: float, get: ParameterGetter, _config: Config) -> ParameterVerdict:
    return _require_if(
        _fuses_external(get, _HORIZONTAL), "0: off", "EKF2_EV_CTRL takes no position", is_good=value == 0
    )


def _judge_px4_mag(value: float, get: ParameterGetter, _config: Config) -> ParameterVerdict:
    return _require_if(_fuses_external(get, _YAW), "5: none", "EKF2_EV_CTRL takes no yaw", is_good=value == 5)


_CAMERA_HINT = "the cameras. GPS and compass are wrong indoors"
_BARO_HINT = "Set it to {0}. Air pressure indoors changes with doors."
_COMPASS_HINT = "Set it to {0}. A compass indoors is off by tens of degrees."
ARDUPILOT = (
    Rule("GUID_TIMEOUT", "", _make_timeout_judge(0.1)),  # ArduCopter takes a shorter one for 0.1 s
    Rule(
        "GUID_OPTIONS",
        "Clear these bits. With them an acceleration is not held against the wind.",
        _judge_guided_options,
    ),
    Rule("EK3_SRC1_POSXY", f"Set it to 6, and VISO_TYPE to 1, to fly on {_CAMERA_HINT}.", _judge_copter_source),
    Rule("EK3_SRC1_POSZ", _BARO_HINT.format(6), _judge_copter_other_source),
    Rule("EK3_SRC1_YAW", _COMPASS_HINT.format(6), _judge_copter_other_source),
    Rule("VISO_TYPE", "Set it to 1 and restart. Without it the vehicle does not read external positions.", _judge_viso),
    Rule("COMPASS_USE", "Set it to 0. Arming checks a compass that is not used.", _judge_compass),
    Rule(
        "FS_EKF_ACTION",
        "Set it to 1. Otherwise a vehicle without positions stays in GUIDED and drifts, despite a short GUID_TIMEOUT.",
        _judge_copter_failsafe,
    ),
    Rule(
        "FS_EKF_THRESH",
        "Set it to 0.8, as shipped. 0 turns FS_EKF_ACTION off. It acts 8 s after the last position (observed).",
        _judge_copter_threshold,
    ),
)
PX4 = (
    Rule("COM_OF_LOSS_T", "", _make_timeout_judge(0.0)),
    Rule(
        "COM_OBL_RC_ACT",
        "Set it to 4 (land) or 5 (hold; PX4 returns to OFFBOARD by itself when setpoints come again). With 0 to 2 "
        "and no radio PX4 flew on with the last acceleration for 12 s (observed).",
        _judge_offboard_loss,
    ),
    Rule("EKF2_EV_CTRL", f"Set it to 11 to fly on {_CAMERA_HINT}.", _judge_px4_external),
    Rule("EKF2_HGT_REF", _BARO_HINT.format(3), _judge_px4_height),
    Rule("EKF2_GPS_CTRL", f"Set it to 0 to fly on {_CAMERA_HINT}.", _judge_px4_gps),
    Rule("EKF2_MAG_TYPE", _COMPASS_HINT.format(5), _judge_px4_mag),
)
RULES = {3: ARDUPILOT, 12: PX4}  # MAV_AUTOPILOT
_TAKE_OFF = "MIS_TAKEOFF_ALT"
LOW_VOLTAGE, LOW_CHARGE = "BATT_LOW_VOLT", "BAT_LOW_THR"  # of the vehicle's own low battery: ArduPilot [V], PX4 [share]
_OTHER_PARAMETERS = {3: (LOW_VOLTAGE,), 12: ("COM_RC_IN_MODE", _TAKE_OFF, LOW_CHARGE)}


def list_parameters(autopilot: int | None) -> tuple[str, ...]:
    """Names of the parameters to ask this kind of autopilot for."""
    if autopilot not in RULES:
        return ()
    return (*_OTHER_PARAMETERS[autopilot], *(rule.name for rule in RULES[autopilot]))


def check_parameters(data: CheckData, config: Config, take_off_m: float | None = None) -> list[Item]:
    """An item for each parameter that matters to this kind of autopilot; `take_off_m` is the climb that is planned."""
    rules = RULES.get(data.autopilot or 0, ())
    if rules is PX4:
        rules = (*rules, _make_climb_rule(config, take_off_m))

    def get(name: str) -> float | None:
        return data.get_parameter(name, px4=data.autopilot == 12)

    return [_check_parameter(rule, get, config) for rule in rules]


def _make_climb_rule(config: Config, take_off_m: float | None) -> Rule:
    """Make the rule for PX4's take-off height: OFFBOARD is requested during its climb, at the height of `--takeoff`."""
    ceiling_m = -get_position_limits_m(config).get("down", (-math.inf, 0.0))[0]
    min_m = 0.0 if take_off_m is None else take_off_m
    bounds = [f"at most {ceiling_m:g} m, the room (sets)"] if math.isfinite(ceiling_m) else []
    bounds += [f"at least {min_m:g} m, --takeoff"] if min_m else []
    hint = (
        "Set it to the height of --takeoff. PX4 climbs to it by itself. With a lower value the flight begins below "
        "--takeoff; below a third of it, not at all. With a value above the room, the ceiling ends the climb if "
        "OFFBOARD is refused."
    )

    def judge(value: float, _get: ParameterGetter, _config: Config) -> ParameterVerdict:
        return _require("; ".join(bounds) or _ANY, is_good=min_m <= value <= ceiling_m)

    return Rule(_TAKE_OFF, hint, judge)


def _check_parameter(rule: Rule, get: ParameterGetter, config: Config) -> Item:
    value = get(rule.name)
    if value is None:
        hint = "several requests had no answer; does this version have it, and does the link carry our messages?"
        return make_item(rule.name, ItemState.UNDETERMINED, "not reported", "its value, to judge it", hint)
    verdict = rule.judge(value, get, config)
    return make_item(rule.name, verdict.state, f"{value:g}", verdict.want, verdict.hint or rule.hint)
