"""Items of the vehicle: who it is, whether others are heard, armed, landed, battery."""

from __future__ import annotations

from itertools import pairwise
from statistics import median

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.check.item import Item, State, item, judged
from uavctl.check.seen import Seen
from uavctl.config.types import Config
from uavctl.flight.envelope import MOTION_NS
from uavctl.mavlink.vehicle import SECOND_VEHICLE

_SILENCE_S = 3.0
_NAMES = {3: "ArduPilot", 12: "PX4"}


def vehicle_items(seen: Seen, config: Config, at_ns: int, take_off_m: float | None = None) -> list[Item]:
    """Items of what the vehicle told of itself up to `at_ns`; `take_off_m` is the climb that is planned."""
    heartbeat = seen.heartbeat
    want = "heartbeats of PX4 or ArduPilot, about one a second"
    if heartbeat is None:
        hint = (
            f"is the vehicle on, and does it speak at {config.daemon.vehicle}? See --vehicle, and its telemetry ports"
        )
        return [item("vehicle", State.BAD, "no heartbeat", want, hint)]
    return [
        _who(seen, at_ns, want),
        _others(seen),
        _armed(seen, takes_off=take_off_m is not None),
        _landed(seen),
        _own_velocity(seen),
        _battery(seen, config),
    ]


def _who(seen: Seen, at_ns: int, want: str) -> Item:
    assert seen.heartbeat is not None
    kind = seen.heartbeat.autopilot
    silent_s = (at_ns - seen.heartbeat_ns) * 1e-9
    version = "" if seen.version is None else " " + ".".join(map(str, seen.version.version))
    name = _NAMES.get(kind, f"MAV_AUTOPILOT {kind}")
    value = f"{name}{version}, system {seen.heartbeat.system}"
    if kind not in _NAMES:
        return item("vehicle", State.BAD, value, want, "its modes are not known, so its setpoint mode cannot be told")
    if silent_s > _SILENCE_S:
        return item("vehicle", State.BAD, f"{value}, silent for {silent_s:.1f} s", want, "see to the link")
    return item("vehicle", State.GOOD, value, want)


def _others(seen: Seen) -> Item:
    count = sum(stats.bad.get(SECOND_VEHICLE, 0) for stats in seen.stats.values())
    return judged(
        "other vehicles",
        good=count == 0,
        value=f"{count} heartbeats of others" if count else "none",
        want="one vehicle on a link",
        hint="give each vehicle a port of its own, and ids that differ (SYSID_THISMAV, MAV_SYS_ID)",
    )


def is_armed(seen: Seen) -> bool:
    """Whether the vehicle says that it is armed."""
    return seen.heartbeat is not None and bool(seen.heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)


def _armed(seen: Seen, *, takes_off: bool) -> Item:
    want = "disarmed before a flight"
    if not is_armed(seen):
        return item("armed", State.GOOD, "no", want)
    if takes_off:
        hint = "land and disarm it, or start without --arm --takeoff to fly it from where it is"
        return item("armed", State.BAD, "yes, already", want, hint)
    return item("armed", State.NOTE, "yes", want, "keep away from the propellers")


def _landed(seen: Seen) -> Item:
    told = {None: "not told", True: "on the ground", False: "in the air"}[seen.landed]
    state = State.GOOD if seen.landed else State.NOTE
    hint = (
        "a flight with --arm --takeoff begins on the ground"
        if seen.landed is False
        else "what it does not tell cannot be waited for"
    )
    return item("landed", state, told, "on the ground", hint)


def _own_velocity(seen: Seen) -> Item:
    """Whether positions can be held against the vehicle's own velocity in flight."""
    want = f"LOCAL_POSITION_NED at {1e9 / MOTION_NS:.2g} Hz or more, for positions to be held against it in flight"
    hint = (
        "without it a turned or mirrored frame is found later in flight, and one that creeps is not; "
        "see to the vehicle's streams, and to its estimator"
    )
    if len(seen.own) < 2:
        return item("own velocity", State.NOTE, "not told", want, hint)
    period_ns = median(b - a for (a, _), (b, _) in pairwise(seen.own))
    state = State.GOOD if period_ns <= MOTION_NS else State.NOTE
    return item("own velocity", state, f"{1e9 / period_ns:.3g} Hz", want, hint)


def _battery(seen: Seen, config: Config) -> Item:
    least_v = config.check.battery_v
    want = f"at least {least_v:g} V (check.battery_v)" if least_v else "check.battery_v is not set"
    if seen.battery_v is None:
        return item("battery", State.UNDETERMINED, "not told", want, "see to the vehicle's battery monitor")
    value = f"{seen.battery_v:.2f} V"
    return judged("battery", good=seen.battery_v >= least_v, value=value, want=want, hint="charge it, or change it")
