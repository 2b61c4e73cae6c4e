"""Headline of a `.tlog` or a ULog: rules that find causes in what the vehicle said and was sent while it was armed.

Such a recording knows neither room nor mission, and seldom who asked for a mode.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from logs.recording.design_view import Floats
from logs.recording.mavlink_flight import HeardTrack, MavlinkFlight, MavlinkFlightInfo
from logs.recording.summary import ARRIVED_M, BLIND_S, count, errors_from_arrival
from logs.report.causes import (
    BAD,
    FAILSAFE_MODES,
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
from uavctl.mavlink.profile import PROFILES
from uavctl.records import number

_C = HeadlineCause
_GRAVE = ("emergency", "alert", "critical", "error")  # of MAV_SEVERITY
_WARNS = (*_GRAVE, "warning")
_APART_M = 0.5  # between its own position and those sent, beyond what their origins differ by
_NEAR_S = 0.5  # between two of its own positions, to tell one in between
_BEAT_S = 1.0  # between two heartbeats
_GIVES_UP_S = 5.0  # without a position: the soonest at which vehicles' estimators were seen to give up
_STOPPED_S = 2.0  # without a position of one source while another's come: it stopped
_UNHEARD_S = 2.5  # of the vehicle: a heartbeat comes each second
_SLOW = 5.0  # usual times between its positions: one that comes seldom is no sign of silence
_FEWEST = 10  # positions of a source worth looking at
_UNUSABLE = 0.2  # of the stamps: more than come out of order, or twice, on any link
_LATE_MS = 1000.0  # positions later than this fly no vehicle
_FROZEN_S, _MOVED_M = 1.0, 0.1  # the same value for so long, while its own position moved by so much
_OFF_SHARE = 0.5  # of the radius of arrival, as of our own flights
_LEFT = 3  # sentences on modes
_OF_AUTOPILOTS = ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "ATTITUDE", "SYS_STATUS")


class ArmedFlight(NamedTuple):
    """A flight, and from when to when it was armed [s]."""

    flight: MavlinkFlight
    spans: list[tuple[float, float]]

    @property
    def info(self) -> MavlinkFlightInfo:
        """Its figures."""
        return self.flight.info

    def inside(self, t_s: Floats, slack_s: float = 0.0) -> Floats:
        """Return which of the times (n,) lie in an armed span."""
        within = [(begin - slack_s <= t_s) & (t_s <= end + slack_s) for begin, end in self.spans]
        return np.asarray(np.any(within, axis=0) if within else np.zeros(len(t_s), dtype=np.bool_))

    def mode_at(self, at_s: float) -> str:
        """Return the vehicle's mode at a time."""
        return next((one.mode for one in reversed(self.info.modes) if one.at_s <= at_s), "no mode yet")


def headline_of(flight: MavlinkFlight) -> Headline:
    """Return what matters most in a flight of a foreign recording, while the vehicle was armed."""
    info = flight.info
    if info.vehicle_system is None:
        return make_headline([Finding(_C.NO_VEHICLE, 0.0, "no autopilot's heartbeat is in it")])
    armed = ArmedFlight(flight, armed_spans(info))
    others = list(_second_vehicle(armed))
    if not armed.spans:
        said = ArmedFlight(flight, [(0.0, np.inf)])
        why = [one.sentence for one in _texts(said)]
        arming = (
            Finding(_C.NOT_ARMED, 0.0, "the vehicle was never armed in it")
            if info.modes
            else Finding(_C.ARMING_UNKNOWN, 0.0, "nothing in it tells modes or arming")
        )
        return make_headline([arming, *others], why=why)
    found = ranked(one for rule in RULES for one in rule(armed))
    told_s = {one.at_s for one in found if one.cause in (_C.MODE_LEFT, _C.VEHICLE_FAILSAFE)}
    return make_headline(found or [_nothing_found(armed)], why=_left(info, told_s))


def armed_spans(info: MavlinkFlightInfo) -> list[tuple[float, float]]:
    """Return from when to when it was armed [s]."""
    spans: list[tuple[float, float]] = []
    since_s: float | None = None
    for one in info.modes:
        if one.armed and since_s is None:
            since_s = one.at_s
        elif not one.armed and since_s is not None:
            spans.append((since_s, one.at_s))
            since_s = None
    return spans if since_s is None else [*spans, (since_s, info.duration_s)]


def _nothing_found(armed: ArmedFlight) -> Finding:
    """Return that nothing was found, with what was looked at and what the recording does not tell."""
    flight = armed.flight
    texts = [f"armed for {seconds(sum(end - begin for begin, end in armed.spans))}"]
    if flight.sent:
        texts.append(f"no position was missing for longer than {number(_silence(armed)[0], 2)} s")
        apart_m, apart_s, _ = _apart(armed)
        if np.isfinite(apart_s):
            texts.append(f"its own kept within {metres(apart_m)} of them")
    else:
        texts.append("it was sent no position")
    if armed.info.setpoints and not np.isfinite(flight.setpoint_m).any():
        texts.append("where it was to be is not in it")
    if not len(flight.battery_v):
        texts.append("its battery is not known")
    return Finding(_C.NOTHING_FOUND, 0.0, "; ".join(texts))


def _texts(armed: ArmedFlight) -> Iterator[Finding]:
    """Find what it said that a pilot must know, each cause once."""
    told: set[HeadlineCause] = set()
    at_s = np.array([one.at_s for one in armed.info.texts])
    heard = armed.inside(at_s, _BEAT_S)
    for one in (one for one, inside in zip(armed.info.texts, heard, strict=True) if inside):
        cause = cause_of_text(one.text, grave=one.severity in _GRAVE, warns=one.severity in _WARNS)
        if cause is not None and cause not in told:
            told.add(cause)
            before, after = armed.mode_at(one.at_s - _BEAT_S), armed.mode_at(one.at_s + 2.0 * _BEAT_S)
            mode = f"from {before} to {after}" if before != after else after
            yield Finding(
                cause, one.at_s, f'it said "{one.text.strip()}" ({one.severity}) at {seconds(one.at_s)} ({mode})'
            )


def _battery(armed: ArmedFlight) -> Iterator[Finding]:
    kept = armed.inside(armed.flight.battery_t_s)
    yield from battery_findings(armed.flight.battery_t_s[kept], armed.flight.battery_v[kept])


def _failsafe_mode(armed: ArmedFlight) -> Iterator[Finding]:
    """Find a mode that a failsafe alone chooses."""
    for one in armed.info.modes:
        if one.armed and one.mode in FAILSAFE_MODES:
            yield Finding(_C.VEHICLE_FAILSAFE, one.at_s, f"it went to {one.mode} at {seconds(one.at_s)}")
            return


def _vehicle_silent(armed: ArmedFlight) -> Iterator[Finding]:
    """Find that no heartbeat of the vehicle came for a while, and it was armed before."""
    begun_s, ended_s = _first_gap(armed, armed.flight.beat_t_s, _UNHEARD_S)
    if ended_s > begun_s:
        text = f"no heartbeat of it came for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} on"
        yield Finding(_C.VEHICLE_SILENT, begun_s, text)


def _own_position(armed: ArmedFlight) -> Iterator[Finding]:
    """Find that the vehicle told no position of its own, or no more, while it was armed."""
    own_s = armed.flight.own.t_s
    if not len(own_s):
        invalid = [name for name in armed.info.bad if "position" in name.lower()]
        told = f" ({', '.join(invalid)})" if invalid else ""
        cause = _C.POSITIONS_INVALID if invalid else _C.POSITIONS_ABSENT
        yield Finding(cause, armed.spans[0][0], f"the vehicle told no valid position of its own{told}")
        return
    usual_s = float(np.median(np.diff(own_s))) if len(own_s) > 1 else np.inf
    begun_s, ended_s = _first_gap(armed, own_s, max(_UNHEARD_S, _SLOW * usual_s))
    if ended_s > begun_s and not any(_vehicle_silent(armed)):
        text = f"it told none for {seconds(ended_s - begun_s)}, from {seconds(begun_s)} on"
        yield Finding(_C.VEHICLE_POSITION_LOST, begun_s, text)


def _first_gap(armed: ArmedFlight, t_s: Floats, limit_s: float) -> tuple[float, float]:
    """Return the first span without any of some times (n,) that is longer than a limit while armed; (0, 0) if none."""
    if len(t_s) < 2:
        return 0.0, 0.0
    edges = np.append(t_s, armed.flight.duration_s)
    gaps = np.flatnonzero(np.diff(edges) > limit_s)
    gaps = gaps[armed.inside(edges[gaps]).astype(np.bool_) & armed.inside(edges[gaps] + limit_s).astype(np.bool_)]
    return (float(edges[gaps[0]]), float(edges[gaps[0] + 1])) if len(gaps) else (0.0, 0.0)


def _silent(armed: ArmedFlight) -> Iterator[Finding]:
    """Find that it was sent no position for a while, or that one source stopped and another went on."""
    flight = armed.flight
    silent_s, since_s = _silence(armed)
    if silent_s > BLIND_S:
        moved_m = _moved(flight.own, since_s, silent_s)
        carried = f", while its own position moved by {metres(moved_m)}" if moved_m >= _APART_M else ""
        when = f"for {seconds(silent_s)}, from {seconds(since_s)} on ({armed.mode_at(since_s)})"
        tone = BAD if silent_s >= _GIVES_UP_S else ""
        yield Finding(_C.SILENCE, since_s, f"none came {when}{carried}", tone=tone)
    for source, track in flight.sent.items():
        if len(flight.sent) < 2 or len(track.t_s) < _FEWEST:
            continue
        longest_s, begun_s = _longest_gap(track.t_s, armed.spans)
        if begun_s >= track.t_s[0] and longest_s >= max(_STOPPED_S, silent_s + _BEAT_S):
            text = f"{source} stopped for {seconds(longest_s)}, from {seconds(begun_s)} on, while others went on"
            yield Finding(_C.RELAY_SILENT, begun_s, text)


def _silence(armed: ArmedFlight) -> tuple[float, float]:
    """Return the longest time that it was sent no position while armed, and when that began [s]; 0 if it never was."""
    return _longest_gap(np.concatenate([one.t_s for one in armed.flight.sent.values()] or [np.empty(0)]), armed.spans)


def _longest_gap(t_s: Floats, spans: Sequence[tuple[float, float]]) -> tuple[float, float]:
    came_s, worst = np.sort(t_s), (0.0, 0.0)
    for begin_s, end_s in spans if len(came_s) else ():
        edges = np.concatenate([[begin_s], came_s[(came_s > begin_s) & (came_s < end_s)], [end_s]])
        longest = int(np.diff(edges).argmax())
        worst = max(worst, (float(np.diff(edges)[longest]), float(edges[longest])))
    return worst


def _moved(track: HeardTrack, since_s: float, for_s: float) -> float:
    """Return how far a track went in a time [m]."""
    places_m = track.position_m[(track.t_s >= since_s) & (track.t_s <= since_s + for_s)]
    return float(np.linalg.norm(places_m - places_m[0], axis=1).max()) if len(places_m) else 0.0


def _frozen(armed: ArmedFlight) -> Iterator[Finding]:
    """Find a source that sent the same position again and again while the vehicle moved."""
    for source, track in armed.flight.sent.items():
        same = np.append(np.all(track.position_m[1:] == track.position_m[:-1], axis=1), False)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8))).reshape(-1, 2)
        for begin, end in edges.tolist():
            begun_s, ended_s = float(track.t_s[begin]), float(track.t_s[end])
            moved_m = _moved(armed.flight.own, begun_s, ended_s - begun_s)
            if ended_s - begun_s >= _FROZEN_S and moved_m >= _MOVED_M and armed.inside(np.array([begun_s]))[0]:
                text = (
                    f"{source} sent the same position {end - begin + 1} × from {seconds(begun_s)} on, while its own "
                    f"moved by {metres(moved_m)}"
                )
                yield Finding(_C.POSITIONS_FROZEN, begun_s, text)
                break


def _stamps(armed: ArmedFlight) -> Iterator[Finding]:
    """Find a source whose stamps its clock cannot have given, or by whose stamps positions are far too late."""
    for one in armed.info.sent:
        if one.positions >= _FEWEST and one.refused_stamps > _UNUSABLE * one.positions:
            text = f"{one.refused_stamps} of {count(one.positions, 'stamp')} of {one.source} cannot be used"
            yield Finding(_C.STAMPS_UNUSABLE, 0.0, text)
        elif one.positions >= _FEWEST and one.delay_ms is not None and one.delay_ms[1] > _LATE_MS:
            text = (
                f"by those of {one.source} positions were up to {seconds(1e-3 * one.delay_ms[2])} late: late, or "
                "stamped in another unit"
            )
            yield Finding(_C.STAMPS_UNUSABLE, 0.0, text)


def _positions_apart(armed: ArmedFlight) -> Iterator[Finding]:
    apart_m, apart_s, of = _apart(armed)
    if apart_m > _APART_M:
        where = f"{metres(apart_m)} off that of {of} at {seconds(apart_s)} ({armed.mode_at(apart_s)})"
        tone = BAD if apart_m > 2 * _APART_M else ""
        yield Finding(_C.POSITIONS_APART, apart_s, f"its own position was {where}", tone=tone)


def _apart(armed: ArmedFlight) -> tuple[float, float, str]:
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
        known = (
            (own.t_s[after] - own.t_s[after - 1] <= _NEAR_S) & (track.t_s <= own.t_s[-1]) & (track.t_s >= own.t_s[0])
        ) & armed.inside(track.t_s).astype(np.bool_)
        if known.sum() < 2:
            continue
        at_s = track.t_s[known]
        differs_m = track.position_m[known] - _at(own, at_s)
        apart_m = np.linalg.norm(differs_m - np.median(differs_m, axis=0), axis=1)
        most = int(apart_m.argmax())
        if apart_m[most] > worst[0]:
            worst = (float(apart_m[most]), float(at_s[most]), source)
    return worst


def _at(track: HeardTrack, at_s: Floats) -> Floats:
    """Return the places of a track at some times (n, 3) [m]."""
    return np.column_stack([np.interp(at_s, track.t_s, track.position_m[:, axis]) for axis in range(3)])


def _off_track(armed: ArmedFlight) -> Iterator[Finding]:
    """Find that its own position was far from where its setpoints had it, once it had been there.

    Of setpoints with a whole place, in the mode that takes them. They count as one course if most differ from the one
    before, as a trajectory's do; else each place counts from the arrival there on.
    """
    flight = armed.flight
    external = {profile.external_mode for profile in PROFILES.values()}
    t_s = flight.setpoint_t_s
    kept = np.isfinite(flight.setpoint_m).all(axis=1) & armed.inside(t_s).astype(np.bool_)
    kept &= np.array([armed.mode_at(at_s) in external for at_s in t_s], dtype=np.bool_)
    if kept.sum() < _FEWEST or len(flight.own.t_s) < _FEWEST:
        return
    at_s, wanted_m = t_s[kept], flight.setpoint_m[kept]
    moved = np.append(False, np.any(wanted_m[1:] != wanted_m[:-1], axis=1))
    if np.count_nonzero(moved) > 0.5 * len(moved):
        moved[:] = False
    error_m = np.linalg.norm(_at(flight.own, at_s) - wanted_m, axis=1)
    found = errors_from_arrival(at_s, error_m, moved)
    if found is not None and (found.worst_m > ARRIVED_M or found.rms_m > _OFF_SHARE * ARRIVED_M):
        most = f"at most {metres(found.worst_m)} at {seconds(found.worst_s)}"
        text = f"{metres(found.rms_m)} from its setpoints (rms), {most}"
        yield Finding(_C.OFF_TRACK, found.worst_s, text)
    elif found is None:
        yield Finding(
            _C.OFF_TRACK, float(at_s[0]), f"it never came nearer to its setpoints than {metres(error_m.min())}"
        )


def _mode_left(armed: ArmedFlight) -> Iterator[Finding]:
    """Find where it left the mode that takes setpoints for one that is no landing; who asked is not in it."""
    external = {profile.external_mode for profile in PROFILES.values()}
    landing = {mode for profile in PROFILES.values() for mode in profile.landing_modes}
    failsafe = {_C.VEHICLE_FENCE, _C.BATTERY_LOW, _C.VEHICLE_POSITION_LOST, _C.VEHICLE_FAILSAFE}
    if any(one.cause in failsafe for one in (*_texts(armed), *_failsafe_mode(armed))):
        return
    for one, then in pairwise(armed.info.modes):
        if one.armed and then.armed and one.mode in external and then.mode not in landing | external:
            text = f"from {one.mode} to {then.mode} at {seconds(then.at_s)}; who asked is not in it"
            yield Finding(_C.MODE_LEFT, then.at_s, text)
            return


def _second_vehicle(armed: ArmedFlight) -> Iterator[Finding]:
    """Find systems that speak as an autopilot does and are not the vehicle that is shown."""
    named = (name.rpartition(" of system ") for name in armed.info.messages)
    others = {system for message, _, system in named if message in _OF_AUTOPILOTS and system.isdecimal()}
    others.discard(str(armed.info.vehicle_system))
    if others:
        which = f"system{'s' if len(others) > 1 else ''} {', '.join(sorted(others, key=int))}"
        text = f"{which} speaks in it, too; this is of system {armed.info.vehicle_system}"
        yield Finding(_C.SECOND_VEHICLE, 0.0, text.replace("speaks", "speak") if len(others) > 1 else text)


def _left(info: MavlinkFlightInfo, told_s: Container[float]) -> Iterator[str]:
    """Yield where it left a mode that takes setpoints, whoever wanted that, but for the times that are told above."""
    external = {profile.external_mode for profile in PROFILES.values()}
    left = [
        (one, then)
        for one, then in pairwise(info.modes)
        if one.armed and one.mode in external and then.mode != one.mode and then.at_s not in told_s
    ]
    for one, then in left[:_LEFT]:
        yield f"It left {one.mode} for {then.mode} at {seconds(then.at_s)}{'' if then.armed else ', disarmed'}."


RULES: tuple[Callable[[ArmedFlight], Iterator[Finding]], ...] = (
    _battery, _texts, _failsafe_mode, _vehicle_silent, _own_position, _silent, _frozen, _stamps, _positions_apart,
    _off_track, _mode_left, _second_vehicle,
)  # fmt: skip
