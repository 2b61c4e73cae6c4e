"""Headline of a `.tlog` or a ULog: rules that find causes in messages from and to the armed vehicle.

Such a recording holds neither room nor mission, and seldom the requester of a mode.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from logs.recording.flight import find_spans
from logs.recording.mavlink_flight import MavlinkFlight, MavlinkFlightInfo, PositionTrack
from logs.recording.summary import ARRIVED_M, BLIND_S, compute_errors_from_arrival, count
from logs.report.battery import find_battery_faults
from logs.report.findings import Finding, Headline, make_headline, metres, seconds, sort_findings
from logs.report.vehicle_texts import FAILSAFE_MODES, classify_texts
from uavctl.arrays import Array
from uavctl.cause import BAD, CAUTION, Cause
from uavctl.mavlink.profile import PROFILES
from uavctl.number_text import format_number
from uavctl.records import Severity

_SEVERITIES = {  # of MAV_SEVERITY; the others are notices
    **dict.fromkeys(("emergency", "alert", "critical", "error"), Severity.ERROR),
    "warning": Severity.WARNING,
}
_MAX_DISAGREEMENT_M = 0.5  # between its own position and those sent, beyond the offset of their origins
_MAX_INTERPOLATION_S = 0.5  # between two of its own positions, to interpolate one in between
_HEARTBEAT_S = 1.0  # between two heartbeats
_ESTIMATOR_TIMEOUT_S = 5.0  # without a position: the soonest at which vehicles' estimators were seen to give up
_SOURCE_TIMEOUT_S = 2.0  # without a position of one source while another's come: it stopped
_HEARTBEAT_TIMEOUT_S = 2.5  # of the vehicle: a heartbeat comes each second
_MAX_PERIODS = 5.0  # usual times between its positions: one that comes seldom is no sign of silence
_SETPOINT_TIMEOUT_S = 1.5  # without a setpoint: a heartbeat, by which the end of a mode is known late, and PX4's 0.5 s
_MAX_SETPOINT_PERIOD_S = 0.5  # of setpoints that are a stream; a single place to fly to needs no other one
_MIN_POSITIONS = 10  # positions of a source worth looking at
_UNUSABLE_SHARE = 0.2  # of the stamps: more than come out of order, or twice, on any link
_MAX_DELAY_MS = 1000.0  # positions later than this fly no vehicle
_MIN_FROZEN_S, _MIN_MOTION_M = 1.0, 0.1  # the same value for so long, while its own position moved by so much
_MAX_RMS_SHARE = 0.5  # of the radius of arrival, as of our own flights
_MAX_MODE_TEXTS = 3  # sentences on modes
_MAX_SHOWN_MODES = 12
_EXTERNAL = frozenset(profile.external_mode for profile in PROFILES.values())
_AUTOPILOT_MESSAGES = ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ATTITUDE", "SYS_STATUS")


class ArmedFlight(NamedTuple):
    """A flight, and from when to when it was armed [s]."""

    flight: MavlinkFlight
    spans: list[tuple[float, float]]

    @property
    def info(self) -> MavlinkFlightInfo:
        """Its figures."""
        return self.flight.info

    def inside(self, t_s: Array, slack_s: float = 0.0) -> Array:
        """Return which of the times (n,) lie in an armed span."""
        within = [(begin - slack_s <= t_s) & (t_s <= end + slack_s) for begin, end in self.spans]
        return np.asarray(np.any(within, axis=0) if within else np.zeros(len(t_s), dtype=np.bool_))

    def mode_at(self, at_s: float) -> str:
        """Return the vehicle's mode at a time."""
        return next((mode.mode for mode in reversed(self.info.modes) if mode.at_s <= at_s), "no mode yet")


def derive_tlog_headline(flight: MavlinkFlight) -> Headline:
    """Return the headline of a foreign recording, from the time while the vehicle was armed."""
    info = flight.info
    if info.vehicle_system is None:
        return make_headline([Finding(Cause.NO_VEHICLE, 0.0, "the recording holds no heartbeat of an autopilot")])
    armed = ArmedFlight(flight, find_armed_spans(info))
    others = list(_find_second_vehicle(armed))
    if not armed.spans:
        unarmed_flight = ArmedFlight(flight, [(0.0, np.inf)])
        sentences = [finding.sentence for finding in _find_texts(unarmed_flight)]
        arming = (
            Finding(Cause.NOT_ARMED, 0.0, "the vehicle was never armed in this recording")
            if info.modes
            else Finding(Cause.ARMING_UNKNOWN, 0.0, "the recording holds no modes or arming")
        )
        return make_headline([arming, *others], reasons=sentences)
    findings = sort_findings(finding for rule in RULES for finding in rule(armed))
    reported_s = {finding.at_s for finding in findings if finding.cause in (Cause.MODE_LEFT, Cause.VEHICLE_FAILSAFE)}
    return make_headline(
        findings or [_make_clear_finding(armed)],
        outcome="; ".join(_describe_course(armed)),
        reasons=(*_describe_mode_exits(armed, reported_s), *_describe_modes(info)),
        root_first=True,
    )


def find_armed_spans(info: MavlinkFlightInfo) -> list[tuple[float, float]]:
    """Return from when to when it was armed [s]."""
    return find_spans(((mode.at_s, mode.armed) for mode in info.modes), info.duration_s)


def _make_clear_finding(armed: ArmedFlight) -> Finding:
    """Return that nothing was found, with the checks made and the data that the recording lacks."""
    flight = armed.flight
    texts = [f"armed for {seconds(sum(end - begin for begin, end in armed.spans))}"]
    if flight.sent:
        texts.append(f"no position was missing for longer than {format_number(_measure_silence(armed)[0], 2)} s")
        apart_m, apart_s, _ = _measure_disagreement(armed)
        if np.isfinite(apart_s):
            texts.append(f"the vehicle's own position stayed within {metres(apart_m)} of them")
    else:
        texts.append("no position was sent to the vehicle")
    if armed.info.setpoints and not np.isfinite(flight.setpoint_m).any():
        texts.append("the recording holds no position setpoints")
    if not len(flight.battery_v):
        texts.append("its battery is not known")
    return Finding(Cause.NOTHING_FOUND, 0.0, "; ".join(texts), tone=CAUTION if _ends_in_flight(armed) else "")


def _ends_in_flight(armed: ArmedFlight) -> bool:
    """Return whether the recording ends in an armed mode that takes setpoints."""
    last = armed.info.modes[-1]
    return last.armed and last.mode in _EXTERNAL


def _describe_course(armed: ArmedFlight) -> Iterator[str]:
    """Yield clauses on how far the vehicle went under setpoints, and in which mode the recording ends."""
    own, furthest = armed.flight.own, (0.0, 0.0, "")
    for begin_s, end_s, mode in _list_external_spans(armed):
        inside = np.flatnonzero((own.t_s >= begin_s) & (own.t_s < end_s))
        if len(inside):
            distance_m = np.linalg.norm(own.position_m[inside] - own.position_m[inside[0]], axis=1)
            index = int(distance_m.argmax())
            furthest = max(furthest, (float(distance_m[index]), float(own.t_s[inside[index]]), mode))
    distance_max_m, at_s, mode = furthest
    if distance_max_m >= _MAX_DISAGREEMENT_M:
        yield f"in {mode} it was at most {metres(distance_max_m)} from where that mode began, at {seconds(at_s)}"
    last = armed.info.modes[-1]
    if _ends_in_flight(armed):
        yield f"the recording ends in flight ({last.mode}, armed)"
    elif last.armed:
        yield f"the recording ends while the vehicle is armed ({last.mode})"


def _list_external_spans(armed: ArmedFlight) -> Iterator[tuple[float, float, str]]:
    """Yield begin and end [s] of each armed span in a mode that takes setpoints, and that mode."""
    modes = armed.info.modes
    ends_s = [*(mode.at_s for mode in modes[1:]), armed.flight.duration_s]
    for mode, end_s in zip(modes, ends_s, strict=True):
        if mode.armed and mode.mode in _EXTERNAL:
            yield mode.at_s, end_s, mode.mode


def _find_texts(armed: ArmedFlight) -> Iterator[Finding]:
    """Find the vehicle's texts that a pilot must know, each cause once."""
    is_armed = armed.inside(np.array([text.at_s for text in armed.info.texts]), _HEARTBEAT_S)
    texts = [text for text, is_inside in zip(armed.info.texts, is_armed, strict=True) if is_inside]
    for text, cause in classify_texts(texts, lambda text: _SEVERITIES.get(text.severity, Severity.INFO)):
        before, after = armed.mode_at(text.at_s - _HEARTBEAT_S), armed.mode_at(text.at_s + 2.0 * _HEARTBEAT_S)
        mode = f"from {before} to {after}" if before != after else after
        yield Finding(
            cause,
            text.at_s,
            f'the vehicle reported "{text.text.strip()}" ({text.severity}) at {seconds(text.at_s)} ({mode})',
        )


def _find_battery_fault(armed: ArmedFlight) -> Iterator[Finding]:
    is_armed = armed.inside(armed.flight.battery_t_s)
    yield from find_battery_faults(armed.flight.battery_t_s[is_armed], armed.flight.battery_v[is_armed])


def _find_failsafe_mode(armed: ArmedFlight) -> Iterator[Finding]:
    """Find a mode that a failsafe alone chooses."""
    for number, mode in enumerate(armed.info.modes):
        if mode.armed and mode.mode in FAILSAFE_MODES:
            before = f" from {armed.info.modes[number - 1].mode}" if number else ""
            text = f"the vehicle went{before} to {mode.mode} at {seconds(mode.at_s)}"
            yield Finding(Cause.VEHICLE_FAILSAFE, mode.at_s, text)
            return


def _find_vehicle_silence(armed: ArmedFlight) -> Iterator[Finding]:
    """Find that no heartbeat of the vehicle came for a while, and it was armed before."""
    begun_s, ended_s = _find_first_gap(armed, armed.flight.beat_t_s, _HEARTBEAT_TIMEOUT_S)
    if ended_s > begun_s:
        text = f"no heartbeat came for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} on"
        yield Finding(Cause.VEHICLE_SILENT, begun_s, text)


def _find_position_loss(armed: ArmedFlight) -> Iterator[Finding]:
    """Find that the vehicle reported no position of its own, or stopped, while it was armed."""
    own_s = armed.flight.own.t_s
    if not len(own_s):
        invalid = [name for name in armed.info.bad if "position" in name.lower()]
        invalid_text = f" ({', '.join(invalid)})" if invalid else ""
        cause = Cause.POSITIONS_INVALID if invalid else Cause.POSITIONS_ABSENT
        yield Finding(cause, armed.spans[0][0], f"the vehicle reported no valid position of its own{invalid_text}")
        return
    usual_s = float(np.median(np.diff(own_s))) if len(own_s) > 1 else np.inf
    begun_s, ended_s = _find_first_gap(armed, own_s, max(_HEARTBEAT_TIMEOUT_S, _MAX_PERIODS * usual_s))
    if ended_s > begun_s and not any(_find_vehicle_silence(armed)):
        text = f"the vehicle reported none for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} on"
        yield Finding(Cause.VEHICLE_POSITION_LOST, begun_s, text)


def _find_first_gap(armed: ArmedFlight, t_s: Array, limit_s: float) -> tuple[float, float]:
    """Return the first span without any of some times (n,) that is longer than a limit while armed; (0, 0) if none."""
    if len(t_s) < 2:
        return 0.0, 0.0
    edges = np.append(t_s, armed.flight.duration_s)
    gaps = np.flatnonzero(np.diff(edges) > limit_s)
    gaps = gaps[armed.inside(edges[gaps]).astype(np.bool_) & armed.inside(edges[gaps] + limit_s).astype(np.bool_)]
    return (float(edges[gaps[0]]), float(edges[gaps[0] + 1])) if len(gaps) else (0.0, 0.0)


def _find_silence(armed: ArmedFlight) -> Iterator[Finding]:
    """Find that it was sent no position for a while, or that one source stopped and another went on."""
    flight = armed.flight
    silent_s, since_s = _measure_silence(armed)
    if silent_s > BLIND_S:
        moved_m = _measure_motion(flight.own, since_s, silent_s)
        motion_text = f", while its own position moved by {metres(moved_m)}" if moved_m >= _MAX_DISAGREEMENT_M else ""
        period = f"for {seconds(silent_s)}, from {seconds(since_s)} on ({armed.mode_at(since_s)})"
        tone = BAD if silent_s >= _ESTIMATOR_TIMEOUT_S else ""
        yield Finding(Cause.SILENCE, since_s, f"none came {period}{motion_text}", tone=tone)
    for source, track in flight.sent.items():
        if len(flight.sent) < 2 or len(track.t_s) < _MIN_POSITIONS:
            continue
        longest_s, begun_s = _find_longest_gap(track.t_s, armed.spans)
        if begun_s >= track.t_s[0] and longest_s >= max(_SOURCE_TIMEOUT_S, silent_s + _HEARTBEAT_S):
            text = f"{source} stopped for {seconds(longest_s)}, from {seconds(begun_s)} on, while others went on"
            yield Finding(Cause.RELAY_SILENT, begun_s, text)


def _find_setpoint_gap(armed: ArmedFlight) -> Iterator[Finding]:
    """Find the longest time without a setpoint, after a stream of them, in a mode that takes setpoints."""
    t_s, longest = armed.flight.setpoint_t_s, (0.0, 0.0, "")
    for begin_s, end_s, mode in _list_external_spans(armed):
        edges = np.append(t_s[(t_s >= begin_s) & (t_s < end_s)], end_s)
        gaps_s = np.diff(edges)
        if len(gaps_s) >= _MIN_POSITIONS and np.median(gaps_s) <= _MAX_SETPOINT_PERIOD_S:
            index = int(gaps_s.argmax())
            longest = max(longest, (float(gaps_s[index]), float(edges[index]), mode))
    gap_s, since_s, mode = longest
    if gap_s > _SETPOINT_TIMEOUT_S:
        text = f"none came for {seconds(gap_s)}, from {seconds(since_s)} on ({mode})"
        yield Finding(Cause.SETPOINTS_SILENT, since_s, text)


def _measure_silence(armed: ArmedFlight) -> tuple[float, float]:
    """Return the longest time that it was sent no position while armed, and when that began [s]; 0 if it never was."""
    return _find_longest_gap(
        np.concatenate([track.t_s for track in armed.flight.sent.values()] or [np.empty(0)]), armed.spans
    )


def _find_longest_gap(t_s: Array, spans: Sequence[tuple[float, float]]) -> tuple[float, float]:
    sorted_s, longest = np.sort(t_s), (0.0, 0.0)
    for begin_s, end_s in spans if len(sorted_s) else ():
        edges = np.concatenate([[begin_s], sorted_s[(sorted_s > begin_s) & (sorted_s < end_s)], [end_s]])
        index = int(np.diff(edges).argmax())
        longest = max(longest, (float(np.diff(edges)[index]), float(edges[index])))
    return longest


def _measure_motion(track: PositionTrack, since_s: float, duration_s: float) -> float:
    """Return how far a track went in a time [m]."""
    positions_m = track.position_m[(track.t_s >= since_s) & (track.t_s <= since_s + duration_s)]
    return float(np.linalg.norm(positions_m - positions_m[0], axis=1).max()) if len(positions_m) else 0.0


def _find_frozen_source(armed: ArmedFlight) -> Iterator[Finding]:
    """Find a source that sent the same position again and again while the vehicle moved."""
    for source, track in armed.flight.sent.items():
        is_repeated = np.append(np.all(track.position_m[1:] == track.position_m[:-1], axis=1), False)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_repeated, [False]]).astype(np.int8))).reshape(-1, 2)
        for begin, end in edges.tolist():
            begun_s, ended_s = float(track.t_s[begin]), float(track.t_s[end])
            moved_m = _measure_motion(armed.flight.own, begun_s, ended_s - begun_s)
            if ended_s - begun_s >= _MIN_FROZEN_S and moved_m >= _MIN_MOTION_M and armed.inside(np.array([begun_s]))[0]:
                text = (
                    f"{source} sent the same position {end - begin + 1} × from {seconds(begun_s)} on, while its own "
                    f"moved by {metres(moved_m)}"
                )
                yield Finding(Cause.POSITIONS_FROZEN, begun_s, text)
                break


def _find_unusable_stamps(armed: ArmedFlight) -> Iterator[Finding]:
    """Find a source whose stamps its clock cannot have given, or by whose stamps positions are far too late."""
    for source in armed.info.sent:
        if source.positions >= _MIN_POSITIONS and source.refused_stamps > _UNUSABLE_SHARE * source.positions:
            text = f"{source.refused_stamps} of {count(source.positions, 'stamp')} of {source.source} cannot be used"
            yield Finding(Cause.STAMPS_UNUSABLE, 0.0, text)
        elif source.positions >= _MIN_POSITIONS and source.delay_ms is not None and source.delay_ms[1] > _MAX_DELAY_MS:
            text = (
                f"by their stamps, positions of {source.source} were up to {seconds(1e-3 * source.delay_ms[2])} late: "
                "delayed, or stamped in another unit"
            )
            yield Finding(Cause.STAMPS_UNUSABLE, 0.0, text)


def _find_position_disagreement(armed: ArmedFlight) -> Iterator[Finding]:
    apart_m, apart_s, source = _measure_disagreement(armed)
    if apart_m > _MAX_DISAGREEMENT_M:
        description = f"{metres(apart_m)} off that of {source} at {seconds(apart_s)} ({armed.mode_at(apart_s)})"
        tone = BAD if apart_m > 2 * _MAX_DISAGREEMENT_M else ""
        yield Finding(Cause.POSITIONS_APART, apart_s, f"its own position was {description}", tone=tone)


def _measure_disagreement(armed: ArmedFlight) -> tuple[float, float, str]:
    """Return how far its own position was off one that it was sent [m], when [s], and which source's.

    What they differ by at all times is that of their origins, and does not count. Where nothing is to be compared the
    time is infinite.
    """
    worst = (0.0, np.inf, "")
    own = armed.flight.own
    if len(own.t_s) < 2:
        return worst
    for source, track in armed.flight.sent.items():
        after = np.searchsorted(own.t_s, track.t_s).clip(1, len(own.t_s) - 1)
        is_known = (
            (own.t_s[after] - own.t_s[after - 1] <= _MAX_INTERPOLATION_S)
            & (track.t_s <= own.t_s[-1])
            & (track.t_s >= own.t_s[0])
        ) & armed.inside(track.t_s).astype(np.bool_)
        if is_known.sum() < 2:
            continue
        at_s = track.t_s[is_known]
        difference_m = track.position_m[is_known] - _interpolate_track(own, at_s)
        disagreement_m = np.linalg.norm(difference_m - np.median(difference_m, axis=0), axis=1)
        index = int(disagreement_m.argmax())
        if disagreement_m[index] > worst[0]:
            worst = (float(disagreement_m[index]), float(at_s[index]), source)
    return worst


def _interpolate_track(track: PositionTrack, at_s: Array) -> Array:
    """Return the places of a track at some times (n, 3) [m]."""
    return np.column_stack([np.interp(at_s, track.t_s, track.position_m[:, axis]) for axis in range(3)])


def _find_track_error(armed: ArmedFlight) -> Iterator[Finding]:
    """Find that its own position was far from where its setpoints had it, once it had been there.

    Of setpoints with a whole place, in the mode that takes them. They count as one course if most differ from the one
    before, as a trajectory's do; else each place counts from the arrival there on.
    """
    flight = armed.flight
    t_s = flight.setpoint_t_s
    is_kept = np.isfinite(flight.setpoint_m).all(axis=1) & armed.inside(t_s).astype(np.bool_)
    is_kept &= np.array([armed.mode_at(at_s) in _EXTERNAL for at_s in t_s], dtype=np.bool_)
    if is_kept.sum() < _MIN_POSITIONS or len(flight.own.t_s) < _MIN_POSITIONS:
        return
    at_s, setpoint_m = t_s[is_kept], flight.setpoint_m[is_kept]
    has_moved = np.append(False, np.any(setpoint_m[1:] != setpoint_m[:-1], axis=1))
    if np.count_nonzero(has_moved) > 0.5 * len(has_moved):
        has_moved[:] = False
    error_m = np.linalg.norm(_interpolate_track(flight.own, at_s) - setpoint_m, axis=1)
    errors = compute_errors_from_arrival(at_s, error_m, has_moved)
    if errors is not None and (errors.worst_m > ARRIVED_M or errors.rms_m > _MAX_RMS_SHARE * ARRIVED_M):
        max_text = f"at most {metres(errors.worst_m)} at {seconds(errors.worst_s)}"
        text = f"{metres(errors.rms_m)} from its setpoints (rms), {max_text}"
        yield Finding(Cause.OFF_TRACK, errors.worst_s, text)
    elif errors is None:
        yield Finding(
            Cause.OFF_TRACK, float(at_s[0]), f"its nearest distance from its setpoints was {metres(error_m.min())}"
        )


def _find_mode_exit(armed: ArmedFlight) -> Iterator[Finding]:
    """Find where it left the mode that takes setpoints for one that is no landing."""
    landing = {mode for profile in PROFILES.values() for mode in profile.landing_modes}
    failsafe = {Cause.VEHICLE_FENCE, Cause.BATTERY_LOW, Cause.VEHICLE_POSITION_LOST, Cause.VEHICLE_FAILSAFE}
    if any(finding.cause in failsafe for finding in (*_find_texts(armed), *_find_failsafe_mode(armed))):
        return
    for before, after in pairwise(armed.info.modes):
        if before.armed and after.armed and before.mode in _EXTERNAL and after.mode not in landing | _EXTERNAL:
            text = f"from {before.mode} to {after.mode} at {seconds(after.at_s)}; the requester is unknown"
            yield Finding(Cause.MODE_LEFT, after.at_s, text)
            return


def _find_second_vehicle(armed: ArmedFlight) -> Iterator[Finding]:
    """Find systems that send messages of an autopilot and are not the vehicle that is shown."""
    name_parts = (name.rpartition(" of system ") for name in armed.info.messages)
    other_systems = {
        system for message, _, system in name_parts if message in _AUTOPILOT_MESSAGES and system.isdecimal()
    }
    other_systems.discard(str(armed.info.vehicle_system))
    if other_systems:
        subject = f"system{'s' if len(other_systems) > 1 else ''} {', '.join(sorted(other_systems, key=int))}"
        text = f"{subject} also sent autopilot messages; this page shows system {armed.info.vehicle_system}"
        yield Finding(Cause.SECOND_VEHICLE, 0.0, text)


def _describe_mode_exits(armed: ArmedFlight, reported_s: Container[float]) -> Iterator[str]:
    """Yield exits from modes that take setpoints, but for the times that the findings report."""
    exits = [
        (before, after)
        for before, after in pairwise(armed.info.modes)
        if before.armed and before.mode in _EXTERNAL and after.mode != before.mode and after.at_s not in reported_s
    ]
    setpoint_t_s = armed.flight.setpoint_t_s
    for before, after in exits[:_MAX_MODE_TEXTS]:
        disarmed_text = "" if after.armed else ", disarmed"
        sent_s = setpoint_t_s[(setpoint_t_s >= before.at_s) & (setpoint_t_s < after.at_s)]
        stopped = len(sent_s) and after.at_s - sent_s[-1] > BLIND_S
        setpoint_text = f"; the last setpoint came at {seconds(float(sent_s[-1]))}" if stopped else ""
        yield (
            f"The vehicle left {before.mode} for {after.mode} at {seconds(after.at_s)}{disarmed_text}{setpoint_text}."
        )


def _describe_modes(info: MavlinkFlightInfo) -> Iterator[str]:
    """Yield a sentence on the modes while armed, if there are more than two."""
    modes = [mode for mode in info.modes if mode.armed]
    if len(modes) > 2:
        shown = ", ".join(f"{mode.mode} {seconds(mode.at_s)}" for mode in modes[:_MAX_SHOWN_MODES])
        more = f", and {len(modes) - _MAX_SHOWN_MODES} more" if len(modes) > _MAX_SHOWN_MODES else ""
        yield f"Modes while armed, from: {shown}{more}."


RULES: tuple[Callable[[ArmedFlight], Iterator[Finding]], ...] = (
    _find_battery_fault,
    _find_texts,
    _find_failsafe_mode,
    _find_vehicle_silence,
    _find_position_loss,
    _find_silence,
    _find_setpoint_gap,
    _find_frozen_source,
    _find_unusable_stamps,
    _find_position_disagreement,
    _find_track_error,
    _find_mode_exit,
    _find_second_vehicle,
)
