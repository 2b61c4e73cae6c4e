"""Evidence of a flight: what its records show of positions, pushes, battery and silence, for the headline's rules."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from functools import cached_property
from typing import NamedTuple

import numpy as np

from logs.recording.design_view import AXIS_NUMBER, Floats
from logs.recording.flight import FLOWN, FlightData
from logs.recording.summary import BLIND_S, FlightSummary
from logs.report.excursion import Clearance, Excursion, excursions
from logs.report.verdicts import Judged, flown_config
from uavctl.build.controller import build_estimator
from uavctl.config import Config
from uavctl.records import Decision, LinkStats

_PUSH_MPS2, _PUSH_MPS = 0.1, 0.3  # carries a vehicle off by as much as is worth telling, if it lasts
_LOOKED_AT_S, _AFTER_S = 0.3, 3.0  # least time to tell a push in, and the longest until a limit is left for it

STALLED_S = 0.5  # between two ticks: the process stood still, and heard nothing
BEAT_S = 1.0  # between two heartbeats


class Push(NamedTuple):
    """Acceleration outwards that no setpoint asked for, over a time [s]."""

    begun_s: float
    ended_s: float
    accel_mps2: float


class FlightEvidence:
    """What the records of a flight show."""

    def __init__(self, flight: FlightData, summary: FlightSummary, judged: Judged) -> None:
        self.flight, self.summary, self.judged = flight, summary, judged
        self.config: Config | None = flown_config(flight)
        self.clearance = Clearance.of(flight)
        self.excursions = excursions(flight)
        self.estimate_s = flight.seconds([one.at_ns for one in flight.estimates])
        self.wrong_s, self.wrong_m = _wrong(flight)
        self.taken_s = flight.seconds([one.at_ns for one in flight.decisions if one.accepted])
        self.breach_s = np.inf if flight.breach is None else self.second(flight.breach.at_ns)

    def second(self, at_ns: int) -> float:
        """Return a time on the report's axis [s]."""
        return (at_ns - self.flight.origin_ns) * 1e-9

    def first_s(self, *codes: str) -> float | None:
        """Return when an event of one of these codes came first [s]; None if none did."""
        return next((self.second(one.at_ns) for one in self.flight.events if one.code in codes), None)

    @cached_property
    def armed_spans(self) -> list[tuple[float, float]]:
        """From when to when the vehicle was armed, by its heartbeats [s]."""
        spans: list[tuple[float, float]] = []
        since: float | None = None
        for one in self.flight.vehicles:
            at_s = self.second(one.at_ns)
            if one.armed and since is None:
                since = at_s
            elif not one.armed and since is not None:
                spans.append((since, at_s))
                since = None
        return spans if since is None else [*spans, (since, np.inf)]

    def armed(self, at_s: float) -> bool:
        """Return whether the vehicle was armed at a time, to a heartbeat's period."""
        return any(begin - BEAT_S <= at_s <= end + BEAT_S for begin, end in self.armed_spans)

    @cached_property
    def last_links(self) -> tuple[LinkStats, ...]:
        """The last counters of each connection, by its name."""
        return tuple({one.link: one for one in sorted(self.flight.links, key=lambda one: one.link)}.values())

    @cached_property
    def battery_v(self) -> tuple[Floats, Floats]:
        """Times (n,) [s] and voltages (n,) of the battery while armed."""
        found = [
            (self.second(one.at_ns), one.battery_v)
            for one in self.flight.vehicles
            if one.battery_v is not None and one.armed
        ]
        return np.array([at_s for at_s, _ in found]), np.array([volts for _, volts in found], dtype=np.float64)

    @cached_property
    def arrived_s(self) -> Floats:
        """Times of capture of all positions that came while the controller flew, used or not (n,) [s]."""
        spans = self.flight.spans(FLOWN)
        at_s = self.flight.seconds([one.captured_ns for each in self.flight.step_inputs for one in each.samples])
        inside = [any(begin <= t <= end for begin, end in spans) for t in at_s.tolist()]
        return np.asarray(at_s[np.array(inside, dtype=np.bool_)])

    def armed_places_m(self) -> Floats:
        """Return the positions that came while the vehicle was armed (n, 3), local NED."""
        samples = [one for each in self.flight.step_inputs for one in each.samples]
        at_s = self.flight.seconds([one.captured_ns for one in samples])
        inside = np.array([any(begin <= t <= end for begin, end in self.armed_spans) for t in at_s.tolist()], np.bool_)
        return np.array([one.position_m for one in samples], dtype=np.float64).reshape(-1, 3)[inside]

    def came_after(self, at_s: float) -> bool:
        """Return whether any position was captured after a time, used or not, flown or not."""
        inputs = self.flight.step_inputs
        return any(self.second(one.captured_ns) > at_s for each in inputs for one in each.samples)

    def refused(self, *codes: str) -> tuple[int, float]:
        """Return how many positions were refused for these reasons while it was flown, and when first [s]."""
        spans = self.flight.spans(FLOWN)
        found = [
            (self.second(one.at_ns), one.count)
            for one in self.flight.events
            if one.code in codes and any(begin <= self.second(one.at_ns) <= end for begin, end in spans)
        ]
        return sum(number for _, number in found), found[0][0] if found else np.inf

    def push(self, one: Excursion) -> Push | None:
        """Return what pushed it outwards beside the setpoints, by the true velocity and the setpoints that were sent.

        Looked at from the last position on, or over the last second at least, while setpoints flew it. None where the
        truth is unknown, too little was flown, or nothing worth telling pushed.
        """
        flight = self.flight
        spans = [(begin, end) for begin, end in flight.spans(FLOWN) if begin < one.worst_s]
        if not flight.truths or not flight.setpoints or not spans:
            return None
        ended_s = min(one.worst_s, spans[-1][1])
        begun_s = max(spans[-1][0], min(ended_s - 1.0, one.worst_s - self.age_s(one.worst_s)))
        lasted_s = ended_s - begun_s
        if lasted_s < _LOOKED_AT_S or one.left_s - ended_s > _AFTER_S:
            return None
        number_of, column = AXIS_NUMBER[one.axis], flight.design.axes.index(one.axis)
        true_s = flight.seconds([truth.at_ns for truth in flight.truths])
        speeds = np.array([truth.velocity_mps[number_of] for truth in flight.truths])
        gained_mps = float(np.interp(ended_s, true_s, speeds) - np.interp(begun_s, true_s, speeds))
        lag_s = 0.0
        if self.config is not None and len(self.config.plant.lag_s) > column:
            lag_s = self.config.plant.dead_time_s + self.config.plant.lag_s[column]
        sent_s = flight.seconds([each.at_ns for each in flight.setpoints]) + lag_s
        sent = np.array([each.accel_mps2[number_of] for each in flight.setpoints])
        at = np.searchsorted(sent_s, np.linspace(begun_s, ended_s, 400, endpoint=False), side="right") - 1
        asked = float(np.where(at >= 0, sent[at], 0.0).mean())
        accel = one.outwards * (gained_mps / lasted_s - asked)
        worth_it = accel >= _PUSH_MPS2 and accel * lasted_s >= _PUSH_MPS
        return Push(begun_s, ended_s, accel) if worth_it else None

    def age_s(self, at_s: float) -> float:
        """Return how long ago the newest position was captured [s]; 0 before the first.

        The estimate tells, up to a breach of the envelope: then it takes back positions that did come.
        """
        place = int(np.searchsorted(self.estimate_s, at_s + 1e-6, side="right")) - 1
        if place < 0:
            return 0.0
        if at_s >= self.breach_s - 1e-6:
            taken_s = self.taken_s[self.taken_s <= at_s]
            return at_s - float(taken_s[-1]) if len(taken_s) else 0.0
        return self.flight.estimates[place].age_s + at_s - float(self.estimate_s[place])

    def stalled_s(self, at_s: Floats) -> Floats:
        """Return for how long until each time (n,) we did not run [s]: what came then was heard later, all at once."""
        ticks_s = self.flight.seconds([one.at_ns for one in self.flight.decisions])
        pauses_s = np.diff(ticks_s)
        stalled_s = np.append(0.0, np.cumsum(np.where(pauses_s > STALLED_S, pauses_s, 0.0)))
        return np.asarray(np.interp(at_s, ticks_s, stalled_s), dtype=np.float64)

    def blind_from_s(self) -> float:
        """Return the age of a position from which the vehicle counts as flown blind [s]."""
        return max(BLIND_S, 0.5 * self.flight.design.horizon * self.flight.design.dt_s)

    def decision(self, at_s: float) -> Decision:
        """Return the newest decision at a time [s]."""
        decisions, at_ns = self.flight.decisions, self.flight.origin_ns + round(at_s * 1e9)
        return decisions[max(0, bisect_right(decisions, at_ns, key=lambda one: one.at_ns) - 1)]

    def longest_silence(self) -> tuple[float, float]:
        """Return the longest time without a new position while it was flown [s]."""
        spans = self.flight.spans(FLOWN)
        times = [t for t in self.estimate_s.tolist() if any(begin <= t <= end for begin, end in spans)]
        age_s, at_s = max(((self.age_s(t), t) for t in times), default=(0.0, 0.0))
        return at_s - age_s, at_s

    def drift_m(self, begun_s: float, ended_s: float) -> float | None:
        """Return how far the true place and the estimate were apart at most in a time; None without a truth."""
        flight = self.flight
        if not flight.truths:
            return None
        true_s = flight.seconds([one.at_ns for one in flight.truths])
        true_m = np.array([one.position_m for one in flight.truths])
        inside = (self.estimate_s >= begun_s) & (self.estimate_s <= ended_s)
        columns = [AXIS_NUMBER[axis] for axis in flight.design.axes]
        believed_m = np.array([flight.design.position_of(e.mean) for e in flight.estimates])[inside][:, columns]
        at_m = np.column_stack([np.interp(self.estimate_s[inside], true_s, true_m[:, one]) for one in columns])
        apart = np.linalg.norm(at_m - believed_m, axis=1)
        return float(apart[np.isfinite(apart)].max(initial=0.0))

    def limited(self) -> tuple[float, float, list[tuple[str, float]]]:
        """Return the share of the setpoints that the last gate changed, when first [s], and the shares by name."""
        setpoints = self.flight.setpoints
        changed = [one for one in setpoints if one.limited]
        if not changed:
            return 0.0, 0.0, []
        names = Counter(name for one in changed for name in one.limited)
        first_s = float(self.flight.seconds([changed[0].at_ns])[0])
        kinds = [(name.replace("-", " ", 1), n / len(setpoints)) for name, n in names.most_common(3)]
        return len(changed) / len(setpoints), first_s, kinds

    def biases(self) -> tuple[Floats, Floats, Floats]:
        """Return times (n,) [s] and biases (n, n_u) estimated while it was flown, and their bounds (n_u,)."""
        flight = self.flight
        n_u = len(flight.design.q_u)
        spans = flight.spans(FLOWN)
        kept = [
            (t, one.bias)
            for t, one in zip(self.estimate_s.tolist(), flight.estimates, strict=True)
            if len(one.bias) == n_u and any(begin <= t < end for begin, end in spans)
        ]
        bounds = np.zeros(0) if self.config is None else np.array(build_estimator(self.config).bias_bounds)
        return np.array([t for t, _ in kept]), np.array([bias for _, bias in kept]).reshape(-1, n_u), bounds


def _wrong(flight: FlightData) -> tuple[Floats, Floats]:
    """Return when positions that came were captured (n,) [s], and how far each was from the true place [m].

    Of those that came while the controller flew; none where the truth is unknown.
    """
    samples = [one for each in flight.step_inputs for one in each.samples]
    if len(flight.truths) < 2 or not samples or not flight.spans(FLOWN):
        return np.zeros(0), np.zeros(0)
    true_s = flight.seconds([one.at_ns for one in flight.truths])
    true_m = np.array([one.position_m for one in flight.truths])
    at_s = flight.seconds([one.captured_ns for one in samples])
    columns = [AXIS_NUMBER[axis] for axis in flight.design.axes]
    measured = np.array([one.position_m for one in samples])[:, columns]
    place = np.column_stack([np.interp(at_s, true_s, true_m[:, one]) for one in columns])
    off = np.linalg.norm(measured - place, axis=1)
    known = np.isfinite(off) & (at_s >= true_s[0]) & (at_s <= true_s[-1])
    known &= np.any([(begin <= at_s) & (at_s < end) for begin, end in flight.spans(FLOWN)], axis=0)
    return at_s[known], off[known]
