"""Items of the vehicle: identity, other vehicles, arming, landed state, velocity stream, battery."""

from __future__ import annotations

from itertools import pairwise
from statistics import median

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.check.check_data import CheckData
from uavctl.check.findings import Item, ItemState, judge_item, make_item
from uavctl.check.parameters import LOW_CHARGE, LOW_VOLTAGE
from uavctl.config.types import Config
from uavctl.event_codes import EventCode
from uavctl.flight.monitors.observation import MOTION_NS

_MAX_SILENCE_S = 3.0
_ARDUPILOT, _PX4 = 3, 12  # MAV_AUTOPILOT
_NAMES = {_ARDUPILOT: "ArduPilot", _PX4: "PX4"}


def check_vehicle(data: CheckData, config: Config, at_ns: int, take_off_m: float | None = None) -> list[Item]:
    """Return the items of the vehicle's own reports up to `at_ns`; `take_off_m` is the planned climb."""
    heartbeat = data.heartbeat
    want = "heartbeats of PX4 or ArduPilot, about one a second"
    if heartbeat is None:
        hint = f"is the vehicle on, and does it send to {config.daemon.vehicle}? See --vehicle, and its telemetry ports"
        return [make_item("vehicle", ItemState.BAD, "no heartbeat", want, hint)]
    return [
        _check_identity(data, at_ns, want),
        _check_other_vehicles(data),
        _check_armed(data, takes_off=take_off_m is not None),
        _check_landed(data),
        _check_velocity_rate(data),
        _check_battery(data, config),
    ]


def _check_identity(data: CheckData, at_ns: int, want: str) -> Item:
    assert data.heartbeat is not None
    kind = data.heartbeat.autopilot
    silent_s = (at_ns - data.heartbeat_ns) * 1e-9
    version = "" if data.version is None else " " + ".".join(map(str, data.version.version))
    name = _NAMES.get(kind, f"MAV_AUTOPILOT {kind}")
    value = f"{name}{version}, system {data.heartbeat.system}"
    if kind not in _NAMES:
        return make_item("vehicle", ItemState.BAD, value, want, "its modes are unknown, so uavctl cannot fly it")
    if silent_s > _MAX_SILENCE_S:
        return make_item("vehicle", ItemState.BAD, f"{value}, silent for {silent_s:.1f} s", want, "check the link")
    return make_item("vehicle", ItemState.GOOD, value, want)


def _check_other_vehicles(data: CheckData) -> Item:
    count = sum(stats.bad.get(EventCode.SECOND_VEHICLE, 0) for stats in data.stats.values())
    return judge_item(
        "other vehicles",
        is_good=count == 0,
        value=f"{count} heartbeats of others" if count else "none",
        want="one vehicle on a link",
        hint="give each vehicle a port of its own, and ids that differ (SYSID_THISMAV, MAV_SYS_ID)",
    )


def is_armed(data: CheckData) -> bool:
    """Return whether the vehicle reports that it is armed."""
    return data.heartbeat is not None and bool(data.heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)


def _check_armed(data: CheckData, *, takes_off: bool) -> Item:
    want = "disarmed before a flight"
    if not is_armed(data):
        return make_item("armed", ItemState.GOOD, "no", want)
    if takes_off:
        hint = "land and disarm it, or start without --arm --takeoff to fly from here"
        return make_item("armed", ItemState.BAD, "yes, already", want, hint)
    return make_item("armed", ItemState.NOTE, "yes", want, "keep away from the propellers")


def _check_landed(data: CheckData) -> Item:
    value = {None: "not reported", True: "on the ground", False: "in the air"}[data.landed]
    state = ItemState.GOOD if data.landed else ItemState.NOTE
    hint = (
        "a flight with --arm --takeoff begins on the ground"
        if data.landed is False
        else "a flight cannot wait for a state that the vehicle does not report"
    )
    return make_item("landed", state, value, "on the ground", hint)


def _check_velocity_rate(data: CheckData) -> Item:
    """Return whether positions can be compared with the vehicle's own velocity in flight."""
    want = f"LOCAL_POSITION_NED at {1e9 / MOTION_NS:.2g} Hz or more, to compare positions with it in flight"
    hint = (
        "without it a turned or mirrored frame is found late in flight, and a slow drift never; "
        "check the vehicle's streams and its estimator"
    )
    if len(data.vehicle_positions) < 2:
        return make_item("own velocity", ItemState.NOTE, "not reported", want, hint)
    period_ns = median(b - a for (a, _), (b, _) in pairwise(data.vehicle_positions))
    state = ItemState.GOOD if period_ns <= MOTION_NS else ItemState.NOTE
    return make_item("own velocity", state, f"{1e9 / period_ns:.3g} Hz", want, hint)


def _check_battery(data: CheckData, config: Config) -> Item:
    """Judge the battery by `check.battery_v`, or else by the vehicle's own threshold of a low battery."""
    hint = "charge it, or change it"
    low_charge = data.get_parameter(LOW_CHARGE, px4=True) if data.autopilot == _PX4 else None
    if not config.check.battery_v and low_charge and data.battery_remaining is not None:
        return judge_item(
            "battery",
            is_good=data.battery_remaining > low_charge,  # as PX4 judges it before arming
            value=f"{data.battery_remaining:.0%}",
            want=f"more than {low_charge:.0%} ({LOW_CHARGE}; check.battery_v is not set)",
            hint=hint,
        )
    low_v = data.get_parameter(LOW_VOLTAGE, px4=False) if data.autopilot == _ARDUPILOT else None
    min_v, source = config.check.battery_v, "check.battery_v"
    # 0 V is that of an ArduPilot without a battery monitor, and a threshold of 0 V is none
    if not min_v and data.battery_v and low_v and low_v > 0.0:
        min_v, source = low_v, f"{LOW_VOLTAGE}; check.battery_v is not set"
    want = f"at least {min_v:.4g} V ({source})" if min_v else "check.battery_v is not set"
    if data.battery_v is None:
        return make_item("battery", ItemState.UNDETERMINED, "not reported", want, "check the vehicle's battery monitor")
    value = f"{data.battery_v:.2f} V"
    if not min_v:
        unset_hint = "set check.battery_v to the lowest voltage to start with"
        return make_item("battery", ItemState.UNDETERMINED, f"{value}, not judged", want, unset_hint)
    return judge_item("battery", is_good=data.battery_v >= min_v, value=value, want=want, hint=hint)
