"""Account of a recorded flight: its records, figures and verdicts. Headline and page are made from it."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from functools import cached_property
from typing import NamedTuple

import numpy as np

from logs.recording.design_view import AXIS_NUMBER
from logs.recording.flight import FLOWN, FlightData, find_spans
from logs.recording.summary import BLIND_S, FlightSummary
from logs.report.battery import find_battery_faults
from logs.report.excursion import Clearance, Excursion, find_excursions
from logs.report.findings import Finding
from logs.report.verdicts import Judgement, read_flown_config
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.records import Decision, LinkStats
from uavctl.wiring.controller import build_estimator

_PUSH_MPS2, _PUSH_MPS = 0.1, 0.3  # carries a vehicle off by as much as is worth reporting, if it lasts
_MIN_OBSERVATION_S, _MAX_EXIT_DELAY_S = (
    0.3,
    3.0,
)  # least time to detect a push in, and the longest until a limit is left for it

MIN_STALL_S = 0.5  # between two ticks: the process did not run or receive
HEARTBEAT_S = 1.0  # between two heartbeats


class Push(NamedTuple):
    """Acceleration outwards that no setpoint asked for, over a time [s]."""

    begun_s: float
    ended_s: float
    accel_mps2: float


class FlightEvidence:
    """Records of a flight, with its figures and verdicts."""

    def __init__(self, flight: FlightData, summary: FlightSummary, judged: Judgement) -> None:
        self.flight, self.summary, self.judged = flight, summary, judged
        self.config: Config | None = read_flown_config(flight)
        self.clearance = Clearance.of(flight)
        self.excursions = find_excursions(flight)
        self.estimate_s = flight.seconds([estimate.at_ns for estimate in flight.estimates])
        self.position_error_t_s, self.position_error_m = _compute_position_errors(flight)
        self.accepted_s = flight.seconds([decision.at_ns for decision in flight.decisions if decision.accepted])
        self.breach_s = np.inf if flight.breach is None else self.to_seconds(flight.breach.at_ns)

    def to_seconds(self, at_ns: int) -> float:
        """Return a time on the report's axis [s]."""
        return (at_ns - self.flight.origin_ns) * 1e-9

    def find_first_s(self, *codes: str) -> float | None:
        """Return when an event of one of these codes came first [s]; None if none did."""
        return next((self.to_seconds(event.at_ns) for event in self.flight.events if event.code in codes), None)

    @cached_property
    def armed_spans(self) -> list[tuple[float, float]]:
        """From when to when the vehicle was armed, by its heartbeats [s]."""
        return find_spans(((self.to_seconds(status.at_ns), status.armed) for status in self.flight.vehicles), np.inf)

    def is_armed(self, at_s: float) -> bool:
        """Return whether the vehicle was armed at a time, to a heartbeat's period."""
        return any(begin - HEARTBEAT_S <= at_s <= end + HEARTBEAT_S for begin, end in self.armed_spans)

    @cached_property
    def last_link_stats(self) -> tuple[LinkStats, ...]:
        """The last counters of each connection, by its name."""
        return tuple({link.link: link for link in sorted(self.flight.links, key=lambda link: link.link)}.values())

    @cached_property
    def battery_v(self) -> tuple[Array, Array]:
        """Times (n,) [s] and voltages (n,) of the battery while armed."""
        readings = [
            (self.to_seconds(status.at_ns), status.battery_v)
            for status in self.flight.vehicles
            if status.battery_v is not None and status.armed
        ]
        return np.array([at_s for at_s, _ in readings]), np.array([volts for _, volts in readings], dtype=np.float64)

    @cached_property
    def battery_faults(self) -> tuple[Finding, ...]:
        """Findings on a battery that failed while armed."""
        return tuple(find_battery_faults(*self.battery_v))

    @cached_property
    def captured_s(self) -> Array:
        """Times of capture of all positions that came while the controller flew, used or not (n,) [s]."""
        spans = self.flight.spans(FLOWN)
        at_s = self.flight.seconds([sample.captured_ns for step in self.flight.step_inputs for sample in step.samples])
        is_flown = [any(begin <= t <= end for begin, end in spans) for t in at_s.tolist()]
        return np.asarray(at_s[np.array(is_flown, dtype=np.bool_)])

    def collect_armed_positions_m(self) -> Array:
        """Return the positions that came while the vehicle was armed (n, 3), local NED."""
        samples = [sample for step in self.flight.step_inputs for sample in step.samples]
        at_s = self.flight.seconds([sample.captured_ns for sample in samples])
        is_armed = np.array(
            [any(begin <= t <= end for begin, end in self.armed_spans) for t in at_s.tolist()], np.bool_
        )
        return np.array([sample.position_m for sample in samples], dtype=np.float64).reshape(-1, 3)[is_armed]

    def has_position_after(self, at_s: float) -> bool:
        """Return whether any position was captured after a time, used or not, flown or not."""
        inputs = self.flight.step_inputs
        return any(self.to_seconds(sample.captured_ns) > at_s for step in inputs for sample in step.samples)

    def count_refused(self, *codes: str) -> tuple[int, float]:
        """Return how many positions were refused for these reasons while it was flown, and when first [s]."""
        spans = self.flight.spans(FLOWN)
        refusals = [
            (self.to_seconds(event.at_ns), event.count)
            for event in self.flight.events
            if event.code in codes and any(begin <= self.to_seconds(event.at_ns) <= end for begin, end in spans)
        ]
        return sum(count for _, count in refusals), refusals[0][0] if refusals else np.inf

    def estimate_push(self, excursion: Excursion) -> Push | None:
        """Return the push outwards that no setpoint explains, by the true velocity and the sent setpoints.

        Looked at from the last position on, or over the last second at least, while setpoints flew it. None where the
        truth is unknown, too little was flown, or no significant push was found.
        """
        flight = self.flight
        spans = [(begin, end) for begin, end in flight.spans(FLOWN) if begin < excursion.worst_s]
        if not flight.truths or not flight.setpoints or not spans:
            return None
        ended_s = min(excursion.worst_s, spans[-1][1])
        begun_s = max(spans[-1][0], min(ended_s - 1.0, excursion.worst_s - self.compute_age_s(excursion.worst_s)))
        duration_s = ended_s - begun_s
        if duration_s < _MIN_OBSERVATION_S or excursion.exit_s - ended_s > _MAX_EXIT_DELAY_S:
            return None
        component, column = AXIS_NUMBER[excursion.axis], flight.design.axes.index(excursion.axis)
        true_s = flight.seconds([truth.at_ns for truth in flight.truths])
        velocities_mps = np.array([truth.velocity_mps[component] for truth in flight.truths])
        velocity_change_mps = float(
            np.interp(ended_s, true_s, velocities_mps) - np.interp(begun_s, true_s, velocities_mps)
        )
        lag_s = 0.0
        if self.config is not None and len(self.config.plant.lag_s) > column:
            lag_s = self.config.plant.dead_time_s + self.config.plant.lag_s[column]
        sent_s = flight.seconds([setpoint.at_ns for setpoint in flight.setpoints]) + lag_s
        sent = np.array([setpoint.accel_mps2[component] for setpoint in flight.setpoints])
        indices = np.searchsorted(sent_s, np.linspace(begun_s, ended_s, 400, endpoint=False), side="right") - 1
        commanded_mps2 = float(np.where(indices >= 0, sent[indices], 0.0).mean())
        push_mps2 = excursion.outwards * (velocity_change_mps / duration_s - commanded_mps2)
        is_significant = push_mps2 >= _PUSH_MPS2 and push_mps2 * duration_s >= _PUSH_MPS
        return Push(begun_s, ended_s, push_mps2) if is_significant else None

    def compute_age_s(self, at_s: float) -> float:
        """Return how long ago the newest position was captured [s]; 0 before the first.

        By the estimate, up to a breach of the envelope: then it rolls back positions that did come.
        """
        index = int(np.searchsorted(self.estimate_s, at_s + 1e-6, side="right")) - 1
        if index < 0:
            return 0.0
        if at_s >= self.breach_s - 1e-6:
            taken_s = self.accepted_s[self.accepted_s <= at_s]
            return at_s - float(taken_s[-1]) if len(taken_s) else 0.0
        return self.flight.estimates[index].age_s + at_s - float(self.estimate_s[index])

    def compute_stalled_s(self, at_s: Array) -> Array:
        """Return for how long until each time (n,) we did not run [s]; messages of pauses are read later."""
        ticks_s = self.flight.seconds([decision.at_ns for decision in self.flight.decisions])
        pauses_s = np.diff(ticks_s)
        stalled_s = np.append(0.0, np.cumsum(np.where(pauses_s > MIN_STALL_S, pauses_s, 0.0)))
        return np.asarray(np.interp(at_s, ticks_s, stalled_s), dtype=np.float64)

    def get_blind_age_s(self) -> float:
        """Return the age of a position from which the vehicle counts as flown blind [s]."""
        return max(BLIND_S, 0.5 * self.flight.design.horizon * self.flight.design.dt_s)

    def find_decision(self, at_s: float) -> Decision:
        """Return the newest decision at a time [s]."""
        decisions, at_ns = self.flight.decisions, self.flight.origin_ns + round(at_s * 1e9)
        return decisions[max(0, bisect_right(decisions, at_ns, key=lambda decision: decision.at_ns) - 1)]

    def find_longest_silence(self) -> tuple[float, float]:
        """Return the longest time without a new position while it was flown [s]."""
        spans = self.flight.spans(FLOWN)
        times = [t for t in self.estimate_s.tolist() if any(begin <= t <= end for begin, end in spans)]
        age_s, at_s = max(((self.compute_age_s(t), t) for t in times), default=(0.0, 0.0))
        return at_s - age_s, at_s

    def compute_max_drift_m(self, begun_s: float, ended_s: float) -> float | None:
        """Return how far the true place and the estimate were apart at most in a time; None without a truth."""
        flight = self.flight
        if not flight.truths:
            return None
        true_s = flight.seconds([truth.at_ns for truth in flight.truths])
        true_m = np.array([truth.position_m for truth in flight.truths])
        is_inside = (self.estimate_s >= begun_s) & (self.estimate_s <= ended_s)
        columns = [AXIS_NUMBER[axis] for axis in flight.design.axes]
        estimate_m = np.array([flight.design.position_of(e.mean) for e in flight.estimates])[is_inside][:, columns]
        interpolated_m = np.column_stack(
            [np.interp(self.estimate_s[is_inside], true_s, true_m[:, column]) for column in columns]
        )
        distances_m = np.linalg.norm(interpolated_m - estimate_m, axis=1)
        return float(distances_m[np.isfinite(distances_m)].max(initial=0.0))

    def count_limited(self) -> tuple[float, float, list[tuple[str, float]]]:
        """Return the share of setpoints that the limiter changed, when first [s], and the shares by name."""
        setpoints = self.flight.setpoints
        limited_setpoints = [setpoint for setpoint in setpoints if setpoint.limited]
        if not limited_setpoints:
            return 0.0, 0.0, []
        names = Counter(name for setpoint in limited_setpoints for name in setpoint.limited)
        first_s = float(self.flight.seconds([limited_setpoints[0].at_ns])[0])
        shares = [(name.replace("-", " ", 1), n / len(setpoints)) for name, n in names.most_common(3)]
        return len(limited_setpoints) / len(setpoints), first_s, shares

    def collect_biases(self) -> tuple[Array, Array, Array]:
        """Return times (n,) [s] and biases (n, n_u) estimated while it was flown, and their bounds (n_u,)."""
        flight = self.flight
        n_u = len(flight.design.q_u)
        spans = flight.spans(FLOWN)
        samples = [
            (t, estimate.bias)
            for t, estimate in zip(self.estimate_s.tolist(), flight.estimates, strict=True)
            if len(estimate.bias) == n_u and any(begin <= t < end for begin, end in spans)
        ]
        bounds = np.zeros(0) if self.config is None else np.array(build_estimator(self.config).bias_bounds)
        return np.array([t for t, _ in samples]), np.array([bias for _, bias in samples]).reshape(-1, n_u), bounds


def _compute_position_errors(flight: FlightData) -> tuple[Array, Array]:
    """Return when positions that came were captured (n,) [s], and how far each was from the true place [m].

    Of those that came while the controller flew; none where the truth is unknown.
    """
    samples = [sample for step in flight.step_inputs for sample in step.samples]
    if len(flight.truths) < 2 or not samples or not flight.spans(FLOWN):
        return np.zeros(0), np.zeros(0)
    true_s = flight.seconds([truth.at_ns for truth in flight.truths])
    true_m = np.array([truth.position_m for truth in flight.truths])
    at_s = flight.seconds([sample.captured_ns for sample in samples])
    columns = [AXIS_NUMBER[axis] for axis in flight.design.axes]
    measured = np.array([sample.position_m for sample in samples])[:, columns]
    true_at_sample_m = np.column_stack([np.interp(at_s, true_s, true_m[:, column]) for column in columns])
    error_m = np.linalg.norm(measured - true_at_sample_m, axis=1)
    is_known = np.isfinite(error_m) & (at_s >= true_s[0]) & (at_s <= true_s[-1])
    is_known &= np.any([(begin <= at_s) & (at_s < end) for begin, end in flight.spans(FLOWN)], axis=0)
    return at_s[is_known], error_m[is_known]
