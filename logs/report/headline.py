"""Headline of a flight: rules that find causes in its records, and sentences on why.

Each rule looks at one kind of cause and yields what it finds; `logs.report.causes` ranks the findings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from logs.recording.design_view import Floats
from logs.recording.flight import FLOWN, FlightData
from logs.recording.reader import read
from logs.recording.summary import (
    ARRIVED_M,
    FlightSummary,
    box_at,
    count,
    input_outside,
    limits_at,
    position_error_m,
    state_outside,
    summarise,
)
from logs.recording.topics import GOES_ON
from logs.report.causes import (
    BAD,
    FAILSAFE_MODES,
    MIND,
    Finding,
    Headline,
    HeadlineCause,
    battery_findings,
    cause_of_text,
    make_headline,
    metres,
    ranked,
    seconds,
)
from logs.report.evidence import BEAT_S, STALLED_S, FlightEvidence
from logs.report.excursion import GRAVE_M, Excursion
from logs.report.reasons import reasons
from logs.report.verdicts import Flags, Judged, judge
from uavctl.errors import RecordingError
from uavctl.flight.estimator import DUPLICATE, TOO_OLD
from uavctl.flight.measure import FUTURE, INVALID
from uavctl.flight.monitors.outliers import JUMP
from uavctl.flight.monitors.stale import FROZEN
from uavctl.flight.supervise import OF_POSITIONS
from uavctl.mavlink.clocksync import StampRefusal
from uavctl.mavlink.codec import BAD_FIELD
from uavctl.mavlink.connection import CONNECTION_SILENT, HUNG_UP
from uavctl.mavlink.relay import HELD_BACK, REASONS, RELAY_RESUMED, RELAY_SILENT
from uavctl.mavlink.vehicle import SECOND_VEHICLE
from uavctl.outcome import Cause
from uavctl.records import ControlMode, Severity, VehicleStatus, number

_C = HeadlineCause
_LINK_OF_VEHICLE = "link vehicle: "  # begins what is told of the vehicle's connection
_UNHEARD_S = 2.5  # a heartbeat comes each second
_WRONG_M = 0.3  # between a position that was used and the true place: no noise of a camera
_DRIFT_STEP_M = 0.1  # what a drifting source adds from one position to the next; a jump adds more
_FEW = 0.05  # of positions, plans, or steps
_FEW_FROZEN = 3  # positions; some sources send each value twice
_UNUSABLE = 0.2  # of positions: more than come out of order, or twice, on any link
_OFF_SHARE = 0.5  # of the radius of arrival: root mean square distance that a mission of places may have on average
_BEGUN_S = 1.0  # it is still about where it began
_ARRIVED_SHARE = 0.1  # distance from the target at the end, of that at the beginning
_SLIGHT_M = 0.02  # beyond a wall: no more than what a camera and the estimator are off by
_SLIGHT = 0.05  # beyond a limit, of that limit: 7 cm/s of 1.5 m/s
_PUSHED_S = 1.0  # with a bias at its bound: shorter ones are gusts
_RISEN_M = 0.15  # from where it stood: more than positions are off by, less than any take-off
_ARMED_S, _FEW_PLACES = 3.0, 20  # time armed and positions in it: enough to tell that it did not move
# Orders before a flight, as the vehicle's answers to them begin, and what each of them asks of it.
_TO_BEGIN = {"DO_SET_MODE": "change its mode", "COMPONENT_ARM_DISARM": "arm"}
_MOST_WORDS = 3  # texts of the vehicle in one sentence
_RELAY_S = 2.0  # without a position passed on: vehicles' estimators give up after 5 to 7 s


def headline(flight: FlightData, summary: FlightSummary, judged: Judged) -> Headline:
    """Return what matters most in a flight; `summary` and `judged` are its figures and verdicts."""
    evidence = FlightEvidence(flight, summary, judged)
    findings = ranked(one for rule in RULES for one in rule(evidence))
    if not findings:
        return make_headline([_all_well(evidence)], why=reasons(evidence, None))
    grave = findings[0].cause is _C.LEFT_LIMITS
    worst = evidence.excursions[0] if evidence.excursions else None
    return make_headline(findings, _outcome(evidence, findings[0]), reasons(evidence, worst if grave else None))


def headline_in(path: Path) -> Headline | None:
    """Return what matters most in a recording of ours; None where it holds no flight that can be judged."""
    try:
        flight = FlightData.from_records(read(path), path)
    except RecordingError:
        return None
    return headline(flight, summarise(flight, wall_s=None), judge(flight))


# What came of it, and what is said where nothing was found.


_NAMES_ITS_END = frozenset(
    {_C.LET_GO, _C.NOT_AS_ORDERED, _C.NOT_FLOWN, _C.VEHICLE_SILENT, _C.VEHICLE_RESTARTED, _C.VEHICLE_DISARMED,
     _C.CONTROL_FAILED, _C.PILOT, _C.GROUND_STATION, _C.MODE_LEFT}
)  # fmt: skip
_OVER = (ControlMode.LAND, ControlMode.STOPPED)  # told by `_how`
_SAYS_WHERE = frozenset({_C.LEFT_LIMITS, _C.TOUCHED_LIMIT, _C.NOT_FLOWN, _C.POSITIONS_ABSENT, _C.POSITIONS_INVALID})


def _outcome(e: FlightEvidence, main: Finding) -> str:
    """Return how the flight ended, if not as ordered, and where it stayed."""
    ending = e.summary.ending
    named = main.cause in _NAMES_ITS_END or (
        main.cause is _C.LEFT_LIMITS and e.decision(main.look_s or 0.0).mode in _OVER
    )
    ended = "" if ending.as_ordered or named or not e.summary.steps else str(ending.cause)
    where = "" if main.cause in _SAYS_WHERE or not e.summary.steps else _stayed(e)
    return "; ".join(one for one in (ended, where) if one)


def _all_well(e: FlightEvidence) -> Finding:
    """Return that nothing was found, with what could not be judged."""
    s = e.summary
    goal = "trajectory" if s.trajectory else "target"
    texts = [_stayed(e)]
    if s.course_rms_m is not None and s.course_worst_m is not None:
        way = "on the whole way" if s.trajectory else "from its arrival on"
        texts.append(f"{metres(s.course_rms_m)} from its {goal} {way} (rms), at most {metres(s.course_worst_m)}")
    unknown = [
        *(["its battery"] if not len(e.battery_v[1]) else ()),
        *(["how it ended"] if not e.flight.endings else ()),
    ]
    if unknown:
        texts.append(f"not known: {' and '.join(unknown)}")
    cause = _C.ALL_WELL if e.flight.endings or e.flight.stopped_ns is not None else _C.NOTHING_FOUND
    return Finding(cause, 0.0, "; ".join(texts))


def _stayed(e: FlightEvidence) -> str:
    """Return that it stayed inside the limits of its position, with how near it came to one of them."""
    if e.excursions:
        worst = e.excursions[0]
        return f"{_beyond(e, worst)} at {seconds(worst.worst_s)}{_seen(e, worst.worst_s)}"
    nearest = e.clearance.nearest()
    if nearest is None:
        return "its position has no limits"
    wall, free_m, at_s = nearest
    begun = at_s < float(e.clearance.t_s[0]) + _BEGUN_S
    near = f"{metres(free_m)} from the {wall} at the nearest, {'where it began' if begun else f'at {seconds(at_s)}'}"
    known_s, flown_s = float(e.clearance.t_s[-1]), max((end for _, end in e.flight.spans(FLOWN)), default=0.0)
    until = f"until {seconds(known_s)}" if flown_s > known_s + STALLED_S else "throughout"
    return f"inside its walls {until}, {near}{_seen(e, at_s)}"


def _beyond(e: FlightEvidence, one: Excursion) -> str:
    """Return how far beyond a limit it was; a floor is the end of every fall, whatever the estimate puts below it."""
    estimated = not e.flight.truths
    return "down to the floor" if one.wall == "floor" and estimated else f"{metres(one.beyond_m)} {one.passage}"


def _seen(e: FlightEvidence, at_s: float) -> str:
    """Return by what it is known where the vehicle was at a time; empty where that is the truth."""
    if e.flight.truths:
        return ""
    breach = e.flight.breach
    doubted = breach is not None and breach.code in OF_POSITIONS and at_s >= e.breach_s
    source = "positions that were no longer believed" if doubted else "the estimate"
    return f" (by {source}: the true state is unknown)"


# Power, and a vehicle or a room that was lost.


def _battery(e: FlightEvidence) -> Iterator[Finding]:
    """Find a battery that gave in."""
    yield from battery_findings(*e.battery_v)


def _excursion(e: FlightEvidence) -> Iterator[Finding]:
    """Find where it left the limits of its position."""
    for worst in e.excursions[:1]:
        if worst.beyond_m <= _SLIGHT_M:
            return
        cause = _C.LEFT_LIMITS if worst.beyond_m >= GRAVE_M else _C.TOUCHED_LIMIT
        text = f"went {_beyond(e, worst)} at {seconds(worst.worst_s)}{_how(e, worst)}"
        yield Finding(cause, worst.left_s, f"{text}{_seen(e, worst.worst_s)}", worst.worst_s)


def _how(e: FlightEvidence, one: Excursion) -> str:
    """Return under which circumstances a limit was left, each by its own record."""
    told = ""
    before = e.wrong_m[e.wrong_s <= one.worst_s]
    wrong_m = float(before.max(initial=0.0))
    if wrong_m > _WRONG_M:
        told = f", flown on positions that were {metres(wrong_m)} off"
    if e.push(one) is not None and not any(_battery(e)):
        told += " while wind carried it" if told else ", carried by wind"
    if e.decision(one.worst_s).mode in (ControlMode.LAND, ControlMode.STOPPED):
        told += ", after it was let go" if e.flight.breach is not None else ", in the vehicle's own landing"
    return told


def _lost(e: FlightEvidence) -> Iterator[Finding]:
    """Find a vehicle that was not heard, has started anew, or disarmed in flight; and a controller that failed."""
    flight, cause = e.flight, e.summary.ending.cause
    heard_s = flight.seconds([*(one.at_ns for one in flight.vehicles), flight.decisions[-1].at_ns])
    # A vehicle that is disarmed may be switched off.
    gaps_s = np.diff(heard_s - e.stalled_s(heard_s)) * [one.armed for one in flight.vehicles]
    end_s = float(heard_s[-1])
    if gaps_s.size and gaps_s.max() > _UNHEARD_S:
        begun_s, ended_s = (float(one) for one in heard_s[gaps_s.argmax() :][:2])
        text = f"no heartbeat of it came for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} on"
        lost = [
            o for o in flight.events if o.code in (HUNG_UP, CONNECTION_SILENT) and o.text.startswith(_LINK_OF_VEHICLE)
        ]
        if lost:
            told = lost[0].text.removeprefix(_LINK_OF_VEHICLE).partition(";")[0]
            text += f"; at {seconds(e.second(lost[0].at_ns))} {told}"
        yield Finding(_C.VEHICLE_SILENT, begun_s, text)
    elif cause in (Cause.SILENT, Cause.CONNECTION):
        yield Finding(_C.VEHICLE_SILENT, end_s, str(cause))
    restarted_s = e.first_s("vehicle-reboot")
    if restarted_s is not None or cause == Cause.RESTARTED:
        at_s = end_s if restarted_s is None else restarted_s
        yield Finding(_C.VEHICLE_RESTARTED, at_s, f"its autopilot started anew at {seconds(at_s)}")
    if cause == Cause.DISARMED:
        off = [one.at_ns for before, one in pairwise(flight.vehicles) if before.armed and not one.armed]
        at_s = e.second(off[0]) if off else end_s
        yield Finding(_C.VEHICLE_DISARMED, at_s, f"the vehicle disarmed at {seconds(at_s)}, while it was flown")
    if cause == Cause.CONTROL:
        at_s = e.first_s("control") or end_s
        yield Finding(_C.CONTROL_FAILED, at_s, f"{e.summary.ending.sentence.rstrip('.')}, at {seconds(at_s)}")


def _stood_still(e: FlightEvidence) -> Iterator[Finding]:
    """Find the longest time in which the process did not run though the vehicle was flown."""
    pauses = [
        (after.at_ns - before.at_ns, before.at_ns)
        for before, after in pairwise(e.flight.decisions)
        if before.mode in FLOWN
    ]
    longest_ns, begun_ns = max(pauses, default=(0, 0))
    if longest_ns > STALLED_S * 1e9:
        at_s = e.second(begun_ns)
        text = f"it did not run for {seconds(longest_ns * 1e-9)}, from {seconds(at_s)} on, and sent no setpoints"
        yield Finding(_C.STOOD_STILL, at_s, text)


def _cut(e: FlightEvidence) -> Iterator[Finding]:
    """Find a recording that breaks off while the vehicle was flown, as one of a killed process does."""
    flight, last = e.flight, e.flight.decisions[-1]
    if not flight.breaks_off or flight.endings or flight.notes[-1].text.startswith(GOES_ON):
        return
    known = flight.vehicles[-1] if flight.vehicles else None
    down = known is not None and (not known.armed or (known.landed is True and e.summary.steps > 0))
    if (last.mode is not ControlMode.WAIT or known is not None) and not down:
        at_s = e.second(last.at_ns)
        mode = f" ({known.mode})" if known is not None else ""
        doing = "while it was flown" if last.mode in FLOWN else f"while the vehicle was armed{mode}"
        yield Finding(
            _C.RECORDING_CUT, at_s, f"at {seconds(at_s)}, {doing}: the process was killed, or the power failed"
        )


def _blind(e: FlightEvidence) -> Iterator[Finding]:
    """Find the longest time without any position, if it was flown blind; refused positions are told by `_refused`."""
    begun_s, ended_s = e.longest_silence()
    came = int(np.count_nonzero((e.arrived_s > begun_s + 1e-6) & (e.arrived_s < ended_s)))
    if ended_s - begun_s <= e.blind_from_s() or came > _FEW_FROZEN:
        return
    reach_s = e.flight.design.horizon * e.flight.design.dt_s
    fell = [one for one in e.flight.fallen if e.second(one.at_ns) >= begun_s]
    gave_up = any(one.mode is ControlMode.LAND for one in fell) or (
        not e.summary.ending.as_ordered and ended_s - begun_s >= reach_s
    )
    until = f"to {seconds(ended_s)}" if e.came_after(ended_s) else "on to the last step flown"
    text = (
        f"no position came for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} {until}, and plans reach "
        f"{number(reach_s, 1)} s"
    )
    drift_m = e.drift_m(begun_s, ended_s)
    if drift_m is not None and drift_m >= GRAVE_M:
        text += f"; it drifted {metres(drift_m)} away from its prediction"
    yield Finding(_C.FLOWN_BLIND if gave_up else _C.SILENCE, begun_s, text, ended_s)


# The vehicle's own failsafes and texts, and who took over.


_OF_FAILSAFES = frozenset({_C.VEHICLE_FENCE, _C.BATTERY_LOW, _C.VEHICLE_POSITION_LOST, _C.VEHICLE_FAILSAFE})


def _vehicle_texts(e: FlightEvidence) -> Iterator[Finding]:
    """Find what the vehicle said that a pilot must know, each cause once."""
    told: set[HeadlineCause] = set()
    changed = ""  # the change of mode that was told last: one text after another tells of the same
    for one in e.flight.events:
        at_s = e.second(one.at_ns)
        if one.code != "vehicle-text" or not e.armed(at_s):
            continue
        grave = one.severity is Severity.ERROR
        cause = cause_of_text(one.text, grave=grave, warns=grave or one.severity is Severity.WARNING)
        if cause is not None and cause not in told:
            told.add(cause)
            before, changed = changed, _mode_after(e, at_s)
            mode = "" if changed == before else changed
            yield Finding(cause, at_s, f'it said "{one.text.strip()}" at {seconds(at_s)}{mode}')


def _mode_after(e: FlightEvidence, at_s: float) -> str:
    """Return the mode that the vehicle is in within two heartbeats, if that is another one; else nothing."""
    before = [one for one in e.flight.vehicles if e.second(one.at_ns) < at_s]
    after = [one for one in e.flight.vehicles if at_s <= e.second(one.at_ns) <= at_s + _UNHEARD_S and one.armed]
    if not after or not before or after[-1].external or after[-1].mode == before[-1].mode:
        return ""
    if _asks_to_land(e, before[-1], after[-1]):
        return ""
    return f" and went from {before[-1].mode} to {after[-1].mode}"


def _failsafe(e: FlightEvidence) -> Iterator[Finding]:
    """Find a failsafe of the vehicle's own that its heartbeats or the end of the flight tell of."""
    name = _cause_name(e)
    said = next((o for o in e.flight.vehicles if o.armed and (o.failsafe or o.mode in FAILSAFE_MODES)), None)
    texts = {one.cause for one in _vehicle_texts(e)} & _OF_FAILSAFES
    if texts or (said is None and "FAILSAFE" not in name and "FENCE" not in name):
        return
    left = _left_external(e)
    at_s = e.second(said.at_ns) if said is not None else left[0] if left else e.second(e.flight.decisions[-1].at_ns)
    mode = said.mode if said is not None else left[1] if left else ""
    cause = _C.VEHICLE_FENCE if "FENCE" in name else _C.VEHICLE_FAILSAFE
    yield Finding(cause, at_s, f"it acted at {seconds(at_s)}{f' ({mode})' if mode else ''}")


def _taken_over(e: FlightEvidence) -> Iterator[Finding]:
    """Find who took the vehicle out of the mode that takes setpoints, if not we and no failsafe."""
    name = _cause_name(e)
    left = _left_external(e)
    if "PILOT" in name:
        at_s, mode = left or (e.second(e.flight.decisions[-1].at_ns), "")
        landed = ", and landed it" if name == Cause.PILOT_LANDED.name else ""
        yield Finding(_C.PILOT, at_s, f"at {seconds(at_s)}{f', to {mode}' if mode else ''}{landed}")
    elif name == "GROUND_STATION":
        at_s, mode = left or (e.second(e.flight.decisions[-1].at_ns), "")
        yield Finding(_C.GROUND_STATION, at_s, f"at {seconds(at_s)}{f', to {mode}' if mode else ''}")
    elif left is not None and not any(
        (*_failsafe(e), *(one for one in _vehicle_texts(e) if one.cause in _OF_FAILSAFES))
    ):
        yield Finding(
            _C.MODE_LEFT, left[0], f"the vehicle went to {left[1]} at {seconds(left[0])}; who asked is unknown"
        )


def _cause_name(e: FlightEvidence) -> str:
    """Return the name of the ending's cause; empty if this version has none such."""
    try:
        return Cause(e.summary.ending.cause).name
    except ValueError:
        return ""


def _left_external(e: FlightEvidence) -> tuple[float, str] | None:
    """Return when the armed vehicle left the mode that takes setpoints though it was flown, and for which mode."""
    flying = {(round(e.second(one.at_ns), 6)): one.mode for one in e.flight.flown}
    last_flown_s = max((at_s for at_s, mode in flying.items() if mode in FLOWN), default=-np.inf)
    for before, after in pairwise(e.flight.vehicles):
        at_s = e.second(after.at_ns)
        left = before.external and not after.external and before.armed and after.armed
        if left and not _asks_to_land(e, before, after) and at_s <= last_flown_s + _UNHEARD_S:
            return at_s, after.mode
    return None


def _asks_to_land(e: FlightEvidence, before: VehicleStatus, after: VehicleStatus) -> bool:
    """Return whether the vehicle was asked to land between two of its heartbeats, or shortly before."""
    begun_s, ended_s = e.second(before.at_ns) - _UNHEARD_S, e.second(after.at_ns)
    return any(
        one.code == "hand-over" and begun_s <= e.second(one.at_ns) <= ended_s and "-> landing" in one.text
        for one in e.flight.events
    )


# Positions.


_OF_SAMPLES = (
    (_C.POSITIONS_FROZEN, (FROZEN,), "the camera sent the same position again and again"),
    (_C.POSITIONS_JUMPED, (JUMP,), "positions were where the vehicle cannot have been"),
    (_C.STAMPS_UNUSABLE, (FUTURE, TOO_OLD, DUPLICATE), "stamps lay in the future, were too old or came twice"),
    (_C.POSITIONS_INVALID, (INVALID,), "positions were no finite numbers, or absurd"),
)


def _refused(e: FlightEvidence) -> Iterator[Finding]:
    """Find positions that came and were not believed, by reason."""
    arrived = max(1, len(e.arrived_s))
    for cause, codes, text in _OF_SAMPLES:
        refused, first_s = e.refused(*codes)
        least = _FEW_FROZEN if cause is _C.POSITIONS_FROZEN else _FEW * arrived
        if cause is _C.STAMPS_UNUSABLE:
            least = _UNUSABLE * arrived
        if refused > least:
            tone = BAD if not e.summary.ending.as_ordered or e.summary.fallbacks else MIND
            yield Finding(cause, first_s, f"{text}, {refused} × from {seconds(first_s)} on", tone=tone)
    yield from _stamps(e)


def _stamps(e: FlightEvidence) -> Iterator[Finding]:
    """Find a source whose stamps gave no times of capture, by the counters of its connection."""
    for last in e.last_links:
        bad = {reason: last.bad.get(reason, 0) for reason in StampRefusal}
        refused = sum(bad.values())
        if refused > _UNUSABLE * (refused + last.samples):
            most = max(bad, key=lambda reason: bad[reason])
            share = f"{refused} of {count(refused + last.samples, 'position')} on “{last.link}”"
            yield Finding(_C.STAMPS_UNUSABLE, 0.0, f"{share} had none that counts ({most})")


def _wrong(e: FlightEvidence) -> Iterator[Finding]:
    """Find positions that were used, or came, and were not where the vehicle was, by the truth."""
    wrong = e.wrong_m > _WRONG_M
    if np.count_nonzero(wrong) <= _FEW_FROZEN or e.refused(FROZEN)[0] > _FEW_FROZEN:
        return
    worst, first = int(e.wrong_m.argmax()), int(np.flatnonzero(wrong)[0])
    steps_m = np.abs(np.diff(e.wrong_m[: first + 1]))
    creeps = float(steps_m.max(initial=0.0)) < _DRIFT_STEP_M and first > 0
    text = (
        f"{count(int(wrong.sum()), 'position')} that came lay over {metres(_WRONG_M)} from the true place, first at "
        f"{seconds(float(e.wrong_s[first]))}; at worst {metres(float(e.wrong_m[worst]))}, at "
        f"{seconds(float(e.wrong_s[worst]))}"
    )
    yield Finding(_C.POSITIONS_DRIFTED if creeps else _C.POSITIONS_JUMPED, float(e.wrong_s[first]), text)


def _absent(e: FlightEvidence) -> Iterator[Finding]:
    """Find that nothing could be flown for want of a usable position."""
    if e.summary.steps or e.flight.estimates:
        return
    came = sum(len(one.samples) for one in e.flight.step_inputs)
    if came:
        kinds = sorted({one.code for one in e.flight.events if one.code.startswith("sample-")})
        why = f" ({', '.join(kinds)})" if kinds else ""
        yield Finding(_C.POSITIONS_INVALID, 0.0, f"none of {count(came, 'position')} could be used{why}")
    elif unread := sum(one.bad.get(BAD_FIELD, 0) for one in e.last_links):
        yield Finding(_C.POSITIONS_INVALID, 0.0, f"{count(unread, 'message')} had values that are no finite numbers")
    elif not any(_stamps(e)):
        yield Finding(_C.POSITIONS_ABSENT, 0.0, f"none came in {seconds(e.flight.duration_s)}")


def _relay(e: FlightEvidence) -> Iterator[Finding]:
    """Find that the vehicle, which lives on the positions that are passed on to it, got none."""
    silent_s = e.first_s(RELAY_SILENT)
    if silent_s is None:
        silent_s = _uncounted_s(e)
    if silent_s is None:
        return
    told = next((one for one in e.flight.relays if one.silent_for and e.second(one.at_ns) >= silent_s), None)
    reason = "" if told is None else told.silent_for
    if reason == HELD_BACK and silent_s >= e.breach_s:
        return  # it was let go, and so they were held back
    begun_s = silent_s if told is None or told.last_ns is None else min(silent_s, e.second(told.last_ns))
    again = (e.second(o.at_ns) for o in e.flight.events if o.code == RELAY_RESUMED)
    resumed_s = next((at_s for at_s in again if at_s > silent_s), None)
    until = "on" if resumed_s is None else f"to {seconds(resumed_s)}"
    why = f" ({REASONS[reason]})" if reason in REASONS else ""
    yield Finding(_C.RELAY_SILENT, begun_s, f"the vehicle got no position from us from {seconds(begun_s)} {until}{why}")


def _uncounted_s(e: FlightEvidence) -> float | None:
    """Return from when on positions were kept back and none was passed on, by the relay's counters [s]."""
    counted = [(e.second(one.at_ns), one.sent, sum(one.kept.values())) for one in e.flight.relays]
    for (begun_s, sent, _), (_, after, _) in pairwise(counted):
        if sent and after == sent:
            until_s = next((at_s for at_s, then, _ in counted if then > sent), counted[-1][0])
            kept = [kept for at_s, _, kept in counted if begun_s <= at_s <= until_s]
            if until_s - begun_s >= _RELAY_S and kept[-1] > kept[0] and e.armed(begun_s):
                return begun_s
    return None


# The end, and the quality of the flight.


def _ending(e: FlightEvidence) -> Iterator[Finding]:
    """Find an end that was not ordered, and a flight in which nothing was flown."""
    s, flight = e.summary, e.flight
    last = (flight.flown or flight.decisions)[-1]
    if not s.steps:
        tone = MIND if s.ending.as_ordered else BAD
        text = s.ending.sentence.rstrip(".")
        text = f"{text[:1].lower()}{text[1:]}" if flight.endings else last.reason
        rose = any(one.armed and one.landed is False for one in flight.vehicles)
        if rose and s.ending.cause == Cause.NOT_FLOWN:
            text = f"the controller was never in charge ({last.reason})"
        yield Finding(_C.NOT_AS_ORDERED if rose else _C.NOT_FLOWN, e.second(last.at_ns), text, tone=tone)
    elif flight.breach is not None or not s.ending.as_ordered:
        at_s = _ended_s(e)
        when = "" if at_s is None else f" at {seconds(at_s)}"
        if flight.breach is not None:
            yield Finding(_C.LET_GO, at_s or 0.0, f"by the envelope{when}: {flight.breach.text}")
        else:
            ended = s.ending.cause if s.ending.cause != Cause.WAITING else f"at the end it was waiting ({last.reason})"
            yield Finding(_C.NOT_AS_ORDERED, at_s or e.second(last.at_ns), f"{ended}{when}")


def _not_risen(e: FlightEvidence) -> Iterator[Finding]:
    """Find that the vehicle was armed on the ground and never left it, by the positions that came."""
    began_landed = next((one.landed for one in e.flight.vehicles if one.landed is not None), False)
    if not began_landed or not e.armed_spans or e.refused(FROZEN)[0]:
        return
    end_s = e.second(e.flight.decisions[-1].at_ns)
    begun_s, lasted_s = e.armed_spans[0][0], sum(min(end, end_s) - begin for begin, end in e.armed_spans)
    places_m = e.armed_places_m()
    if lasted_s < _ARMED_S or len(places_m) < _FEW_PLACES:
        return
    moved_m = float(np.linalg.norm(places_m - places_m[0], axis=1).max())
    if moved_m < _RISEN_M:
        text = f"the vehicle was armed for {seconds(lasted_s)} and its position moved by {metres(moved_m)} at most"
        yield Finding(_C.NOT_RISEN, begun_s, text)


def _begin_refused(e: FlightEvidence) -> Iterator[Finding]:
    """Find that the vehicle was never armed, as it refused to be, or refused the mode for it."""
    answers = [
        (e.second(one.at_ns), order, one.severity)
        for one in e.flight.events
        for order in _TO_BEGIN
        if one.code == "command-ack" and one.text.startswith(order)
    ]
    if not answers or answers[-1][2] is Severity.INFO or e.armed_spans:
        return
    order = answers[-1][1]
    refused_s = [at_s for at_s, one, severity in answers if one == order and severity is not Severity.INFO]
    said = [
        f'"{one.text.strip()}"'
        for one in e.flight.events
        if one.code == "vehicle-text"
        and one.severity is not Severity.INFO
        and refused_s[0] - BEAT_S <= e.second(one.at_ns) <= refused_s[-1] + BEAT_S
    ]
    words = ", ".join(list(dict.fromkeys(said))[:_MOST_WORDS])
    text = f"it refused {count(len(refused_s), 'time')} to {_TO_BEGIN[order]}{f' and said {words}' if words else ''}"
    yield Finding(_C.BEGIN_REFUSED, refused_s[0], text)


def _ended_s(e: FlightEvidence) -> float | None:
    """Return when it was let go, or when the fallback had it land or stopped [s]; None if neither was."""
    ends = (d.at_ns for d in e.flight.flown if d.mode in (ControlMode.LAND, ControlMode.STOPPED))
    at_ns = e.flight.breach.at_ns if e.flight.breach is not None else next(ends, None)
    return None if at_ns is None else e.second(at_ns)


def _limits(e: FlightEvidence) -> Iterator[Finding]:
    """Find states and inputs beyond limits that are not those of the position.

    A plan keeps its limits with a probability. So a few steps that are slightly outside are as planned; the verdict on
    the risk judges the promise.
    """
    flight, design, steps = e.flight, e.flight.design, e.flight.steps
    normals, limits = np.array(design.c_x).reshape(-1, len(design.q_x)), limits_at(flight, steps.t_s)
    others = np.flatnonzero((np.delete(normals, design.position_index, axis=1) != 0.0).any(axis=1))
    beyond = (steps.state @ normals.T - limits)[:, others]
    outside = state_outside(flight) & ~(beyond <= 0.0).all(axis=1)
    if _matters(beyond, limits[:, others], outside):
        at_s, text = float(steps.t_s[outside][0]), f"{outside.sum()} of {count(len(steps), 'step')} outside"
        row, worst = np.unravel_index(int(np.nan_to_num(beyond, nan=-np.inf).argmax()), beyond.shape)
        if beyond[row, worst] > 0.0:
            index = int(np.abs(normals[others[worst]]).argmax())
            at_s, most = float(steps.t_s[row]), float(beyond[row, worst] / np.abs(normals[others[worst], index]))
            unit = " m/s" if index in design.velocity_index else ""
            text = f"{most:.2g}{unit} beyond the limit of {design.state_name(index)} at {seconds(at_s)} ({text})"
        yield Finding(_C.BEYOND_LIMIT, at_s, text)
    outside = input_outside(flight)
    given = np.fmax(steps.decided, steps.input), np.fmin(steps.decided, steps.input)
    normals, bounds = np.array(design.c_u).reshape(-1, len(design.q_u)), np.array(design.b_u)
    beyond = np.maximum(*(one @ normals.T - bounds for one in given))
    if _matters(beyond, bounds, outside):
        at_s = float(steps.t_s[outside][0])
        text = f"an input was beyond its limits at {count(int(outside.sum()), 'step')}, first at {seconds(at_s)}"
        yield Finding(_C.BEYOND_LIMIT, at_s, text)


def _matters(beyond: Floats, limits: Floats, outside: Flags) -> bool:
    """Return whether more than a few steps are outside, or one is by more than slightly.

    Args:
        beyond: Of each step, by how much beyond each limit (n, rows); NaN where it is unknown.
        limits: (n, rows) or (rows,).
        outside: Which steps count (n,).
    """
    slight = (beyond[outside] <= np.broadcast_to(_SLIGHT * np.abs(limits), beyond.shape)[outside]).all()
    return bool(outside.any() and (outside.mean() > _FEW or not slight))


def _fell_back(e: FlightEvidence) -> Iterator[Finding]:
    """Find that the fallback flew for a while."""
    if e.summary.fallbacks and e.summary.ending.as_ordered and e.flight.breach is None:
        spans, first = e.flight.fallback_spans, e.flight.fallen[0]
        total_s = sum(end - begin for begin, end in spans)
        when = f"for {seconds(total_s)} in all, from {seconds(spans[0][0])} on"
        yield Finding(_C.FELL_BACK, spans[0][0], f"the fallback flew {when}: {first.reason}")


def _mission(e: FlightEvidence) -> Iterator[Finding]:
    """Find places that were not reached, and a vehicle that was off its target once it had been there.

    A mission asks to be within `mission.accept_m` of each place. So that is what a flight may be off at most, and half
    of it in the root mean square.
    """
    s, flight = e.summary, e.flight
    if s.final_error_m is None or not s.ending.as_ordered:
        return
    accept_m = ARRIVED_M if e.config is None else e.config.mission.accept_m
    last_s = float(flight.steps.t_s[-1])
    if s.trajectory:
        yield from _short(e, last_s)
    elif s.final_error_m > max(accept_m, _ARRIVED_SHARE * float(position_error_m(flight)[0])):
        yield Finding(
            _C.NOT_REACHED, last_s, f"{metres(s.final_error_m)} from its target at the last step{_out_of_reach(e)}"
        )
        return
    else:
        places = () if e.config is None else e.config.mission.waypoints
        reached = [one.waypoint for one in flight.flown if one.waypoint is not None]
        if len(places) and reached and max(reached) < len(places) - 1:
            yield Finding(_C.NOT_REACHED, last_s, f"{max(reached)} of {count(len(places), 'waypoint')} were reached")
    if s.course_rms_m is None or s.course_worst_m is None or s.course_worst_s is None:
        near_m, at_s = float(position_error_m(flight).min()), last_s
        cause = _C.OFF_TRACK if s.trajectory else _C.NOT_REACHED
        yield Finding(cause, at_s, f"it never came nearer to its target than {metres(near_m)}")
    elif s.course_worst_m > accept_m or s.course_rms_m > _OFF_SHARE * accept_m:
        goal = "its trajectory on the whole way" if s.trajectory else "its target from its arrival on"
        text = (
            f"{metres(s.course_rms_m)} from {goal} (rms), at most {metres(s.course_worst_m)} at "
            f"{seconds(s.course_worst_s)}"
        )
        yield Finding(_C.OFF_TRACK, s.course_worst_s, text)


def _short(e: FlightEvidence, last_s: float) -> Iterator[Finding]:
    """Find a trajectory of which the end was not flown though no operator ended it."""
    times_s = () if e.config is None else e.config.mission.trajectory.times_s
    if not times_s or e.flight.part or e.summary.ending.cause == Cause.OPERATOR:
        return
    begun_s = e.flight.spans(FLOWN)[0][0]
    if last_s - begun_s < times_s[-1] - e.flight.design.dt_s * 2.0:
        text = f"{seconds(last_s - begun_s)} of its trajectory's {seconds(times_s[-1])} were flown"
        yield Finding(_C.NOT_REACHED, last_s, text)


def _out_of_reach(e: FlightEvidence) -> str:
    """Return by how much the target lay beyond a limit of position at the end; empty if it did not."""
    flight, design = e.flight, e.flight.design
    index = list(design.position_index)
    target = flight.steps.target[-1, index]
    lower, upper = (side[0, index] for side in box_at(flight, flight.steps.t_s[-1:]))
    beyond = np.maximum(lower - target, target - upper)
    most = int(beyond.argmax())
    if beyond[most] <= 0.0:
        return ""
    return f", which lay {metres(float(beyond[most]))} beyond the limit {design.axes[most]} by then"


def _pushed(e: FlightEvidence) -> Iterator[Finding]:
    """Find a lasting push as strong as may be flown against; a battery that gives in pushes down like a wind."""
    at_s, left = e.first_s("bias-at-bound"), _left_external(e)
    flown_until_s = e.breach_s if left is None else min(e.breach_s, left[0] - BEAT_S)  # its mode is told that late
    if at_s is None or at_s >= flown_until_s or any(_battery(e)):
        return
    until_s = next(
        (e.second(o.at_ns) for o in e.flight.events if o.code == "bias-free" and e.second(o.at_ns) > at_s),
        e.second(e.flight.decisions[-1].at_ns),
    )
    if until_s - at_s > _PUSHED_S:
        yield Finding(_C.WIND, at_s, f"what pushed was as strong as may be flown against, from {seconds(at_s)} on")


def _relaxed(e: FlightEvidence) -> Iterator[Finding]:
    """Find that a constraint gave way in more than a few plans that were flown."""
    plans = e.flight.flown_plans
    if e.summary.slack_used > _FEW * max(1, len(plans)):
        text = f"in {e.summary.slack_used} of {count(len(plans), 'plan')} that were flown a constraint gave way"
        yield Finding(_C.PLANS_RELAXED, e.first_s("gave-way") or 0.0, text)


def _link(e: FlightEvidence) -> Iterator[Finding]:
    """Find a link that was worse than the design counts on, and another vehicle on it."""
    link = e.judged.verdicts.link
    if link.promised_news is not None and link.news.trials and link.news.high < link.promised_news:
        text = (
            f"{100 * link.news.rate:.0f} % of the steps had a position captured within them, and the design counts on "
            f"{100 * link.promised_news:.0f} %"
        )
        yield Finding(_C.LINK_WORSE, 0.0, text)
    second_s = e.first_s(SECOND_VEHICLE)
    if second_s is not None:
        yield Finding(_C.SECOND_VEHICLE, second_s, f"it was heard on the vehicle's link at {seconds(second_s)}")


RULES: tuple[Callable[[FlightEvidence], Iterator[Finding]], ...] = (
    _battery, _excursion, _lost, _cut, _blind, _stood_still, _vehicle_texts, _failsafe, _taken_over, _refused, _wrong,
    _absent, _relay, _begin_refused, _not_risen, _ending, _limits, _fell_back, _mission, _pushed, _relaxed, _link,
)  # fmt: skip
