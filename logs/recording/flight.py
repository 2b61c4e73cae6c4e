"""A flight in memory: its records by type, and the arrays for summary and report."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Self, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from logs.recording.design_view import DesignView, read_design
from logs.recording.notes import NoteKind, RecorderNote
from uavctl.arrays import Array
from uavctl.errors import RecordingError
from uavctl.event_codes import MISSION, EventCode
from uavctl.flight.supervise import ENVELOPE_CODES
from uavctl.records import (
    Checked,
    ControlMode,
    Decision,
    Ending,
    Estimate,
    Event,
    Header,
    LinkEstimate,
    LinkStats,
    Order,
    Plan,
    PositionSample,
    Record,
    RelayStats,
    Setpoint,
    SolveStatus,
    StepInput,
    Timing,
    Truth,
    VehicleStatus,
)

FLOWN = frozenset({ControlMode.TRACK, ControlMode.BRAKE, ControlMode.HOLD})
MIN_TARGET_CHANGES = 3  # successive boundaries with another target each: it moves, and was not only changed
FALLBACK = frozenset({ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND})


def find_spans(states: Iterable[tuple[float, bool]], end_s: float) -> list[tuple[float, float]]:
    """Return the spans of time [s] in which a state held.

    Args:
        states: Times [s] in their order, and whether the state held from then on.
        end_s: End of a span that the last of them leaves open.
    """
    spans: list[tuple[float, float]] = []
    begun_s: float | None = None
    for at_s, holds in states:
        if holds and begun_s is None:
            begun_s = at_s
        elif not holds and begun_s is not None:
            spans.append((begun_s, at_s))
            begun_s = None
    return spans if begun_s is None else [*spans, (begun_s, end_s)]


class Landing(NamedTuple):
    """Begin of a wanted landing [ns], and whether the operator ordered it or the mission ended with it."""

    at_ns: int
    ordered: bool


@dataclass(frozen=True, eq=False)
class FlightData:
    """All records of a flight, by type, in the order in which they were written."""

    header: Header
    design: DesignView
    step_inputs: tuple[StepInput, ...]
    estimates: tuple[Estimate, ...]
    plans: tuple[Plan, ...]
    decisions: tuple[Decision, ...]
    setpoints: tuple[Setpoint, ...]
    vehicles: tuple[VehicleStatus, ...]
    events: tuple[Event, ...]
    timings: tuple[Timing, ...]
    links: tuple[LinkStats, ...]
    truths: tuple[Truth, ...]
    link_estimates: tuple[LinkEstimate, ...] = ()
    checks: tuple[Checked, ...] = ()  # before arming
    notes: tuple[RecorderNote, ...] = ()  # the recorder's own account
    relays: tuple[RelayStats, ...] = ()  # counters of positions passed on to the vehicle, once a second
    endings: tuple[Ending, ...] = ()  # the daemon's last word; none in older recordings, and in torn ones

    @classmethod
    def from_records(cls, records: Iterable[tuple[str, int, Record]], path: Path | None = None) -> Self:
        """Sort (topic, log_time_ns, record) by record type; types that no report needs are left out.

        Args:
            path: The file that they are from, which errors name.

        Raises:
            RecordingError: no header, no decision, or a design without the keys of `DesignView`.
        """
        records_by_type: defaultdict[type[Record], list[Any]] = defaultdict(list)
        for _, _, record in records:
            records_by_type[type(record)].append(record)

        headers = records_by_type[Header]
        prefix = "" if path is None else f"{path}: "
        if not headers:
            raise RecordingError(f"{prefix}the recording has no header; it is empty, or not one of uavctl")
        if not records_by_type[Decision]:
            raise RecordingError(
                f"{prefix}the recording has no decision: nothing was flown, so there is nothing to report"
            )
        return cls(
            header=headers[0],
            design=read_design(headers[0]),
            **{
                name: tuple(records_by_type[get_args(annotation)[0]])
                for name, annotation in get_type_hints(cls).items()
                if get_args(annotation)
            },
        )

    @property
    def origin_ns(self) -> int:
        """Time of the first tick: the zero of every time axis."""
        return self.decisions[0].at_ns

    @property
    def samples(self) -> tuple[PositionSample, ...]:
        """Positions that were accepted, as far as the recording tells.

        A decision counts what it refused without naming it, so ticks that refused any are left out.
        """
        refusing = {decision.tick for decision in self.decisions if decision.rejected}
        return tuple(sample for inputs in self.step_inputs if inputs.tick not in refusing for sample in inputs.samples)

    @cached_property
    def flown(self) -> tuple[Decision, ...]:
        """Return the ticks up to the operator's stop; after it comes the hand-over, not the flight."""
        stopped = self.stopped_ns
        return tuple(d for d in self.decisions if stopped is None or d.at_ns < stopped)

    @cached_property
    def stopped_ns(self) -> int | None:
        """Return the time at which the operator asked for the hand-over [ns]; None without a request."""
        return min((inputs.at_ns for inputs in self.step_inputs if inputs.stop), default=None)

    @cached_property
    def breach(self) -> Event | None:
        """Return the envelope's event on an impossible observation, for which the vehicle was let go; else None."""
        return next((event for event in self.events if event.code in ENVELOPE_CODES), None)

    @cached_property
    def landing(self) -> Landing | None:
        """Return the wanted landing that began before the operator's stop with no plan flown after it; else None."""
        after_ns = max((d.at_ns for d in self.flown if d.mode is ControlMode.TRACK), default=-1)
        ordered = [
            Landing(event.at_ns, ordered=True)
            for event in self.events
            if event.code == EventCode.ORDER_ACCEPTED and event.subject == Order.LAND
        ]
        due = [Landing(event.at_ns, ordered=False) for event in self.events if event.subject == MISSION]
        until_ns = self.decisions[-1].at_ns + 1 if self.stopped_ns is None else self.stopped_ns
        return min((landing for landing in ordered + due if after_ns < landing.at_ns < until_ns), default=None)

    @cached_property
    def fallen(self) -> tuple[Decision, ...]:
        """Return the flown ticks of the fallback, without braking and holding before a wanted landing."""
        landing = self.landing
        decisions = (decision for decision in self.flown if landing is None or decision.at_ns < landing.at_ns)
        return tuple(decision for decision in decisions if decision.mode in FALLBACK)

    @property
    def fallback_spans(self) -> list[tuple[float, float]]:
        """Spans of time [s] in which the fallback flew."""
        spans = self.spans(FALLBACK)
        if self.landing is None:
            return spans
        until_s = self._second(self.landing.at_ns)
        return [(begun_s, min(ended_s, until_s)) for begun_s, ended_s in spans if begun_s < until_s]

    @property
    def part(self) -> bool:
        """Whether the recording lacks the first ticks of its flight, as a later file does."""
        return self.decisions[0].tick > self.decisions[0].missed_ticks

    @property
    def breaks_off(self) -> bool:
        """Whether the recorder could not close the recording: killed, without power, or the file was cut."""
        return bool(self.notes) and self.notes[-1].kind not in (NoteKind.END, NoteKind.CONTINUED)

    @cached_property
    def virtual_time(self) -> bool:
        """Return whether the flight was in virtual time: no measured tick was late by a single nanosecond."""
        return bool(self.timings) and not any(timing.lateness_ns for timing in self.timings)

    @cached_property
    def tick_ns(self) -> int:
        """Return the time between two ticks [ns]; 0 if there was only one."""
        first, last = self.decisions[0], self.decisions[-1]
        return (last.at_ns - first.at_ns) // max(1, last.tick - first.tick)

    @cached_property
    def duration_s(self) -> float:
        """Return the time from the first tick to the end of the last one [s]."""
        return (self.decisions[-1].at_ns - self.origin_ns + self.tick_ns) * 1e-9

    @cached_property
    def flown_plans(self) -> dict[int, Plan]:
        """Return the plans that were flown, by their number."""
        seqs = {decision.plan_seq for decision in self.decisions}
        return {p.seq: p for p in self.plans if p.seq in seqs and p.status is SolveStatus.OPTIMAL}

    @cached_property
    def targets(self) -> tuple[Array, Array]:
        """Return times (n,) [s] and targets (n, n_x) of the mission, one for each boundary.

        A recording without any says what its design was made for.
        """
        targets = [(d.at_ns, d.target) for d in self.flown if d.boundary and d.target is not None]
        targets = targets or [(self.origin_ns, self.design.target)]
        return self.seconds([at_ns for at_ns, _ in targets]), np.array([target for _, target in targets])

    @cached_property
    def moving_target(self) -> bool:
        """Return whether a trajectory was to be followed: the target moves from boundary to boundary.

        A place that was ordered is no waypoint either, and stays where it is.
        """
        targets = [None if d.waypoint is not None else d.target for d in self.flown if d.boundary]
        runs = zip(*(targets[n:] for n in range(MIN_TARGET_CHANGES)), strict=False)
        return any(None not in run and len(set(run)) == MIN_TARGET_CHANGES for run in runs)

    @cached_property
    def ordered_places(self) -> tuple[tuple[int, tuple[float, ...]], ...]:
        """Return the places that the vehicle was ordered to: (time [ns], target (n_x,))."""
        if self.moving_target:
            return ()
        targets = [(d.at_ns, d.target, d.waypoint) for d in self.flown if d.boundary and d.target is not None]
        previous = [(None, 0), *((target, waypoint) for _, target, waypoint in targets)]
        return tuple(
            (at_ns, target)
            for (at_ns, target, waypoint), (last, last_waypoint) in zip(targets, previous, strict=False)
            if waypoint is None and (target != last or last_waypoint is not None)
        )

    @cached_property
    def last_flown(self) -> Estimate | None:
        """Return the estimate at the last flown boundary."""
        at_ns = self.steps.decisions[-1].at_ns if len(self.steps) else None
        return next((estimate for estimate in reversed(self.estimates) if estimate.at_ns == at_ns), None)

    @cached_property
    def steps(self) -> Steps:
        """Return the flown Δt boundaries."""
        return Steps.of(self)

    def seconds(self, at_ns: Sequence[int]) -> Array:
        """Return times on the report's axis (n,) [s], 0 at the first tick."""
        return np.array([(at - self.origin_ns) * 1e-9 for at in at_ns], dtype=np.float64)

    def spans(self, modes: Collection[ControlMode]) -> list[tuple[float, float]]:
        """Return the spans of flown time [s] in which the mode was one of `modes`; none after the operator's stop."""
        end_s = self.duration_s if self.stopped_ns is None else self._second(self.stopped_ns)
        return find_spans(((self._second(d.at_ns), d.mode in modes) for d in self.flown), end_s)

    def lost_at_s(self) -> Array:
        """Return when the simulated channel lost positions (n,) [s], one entry each; empty for a real flight."""
        times = [b.at_ns for a, b in pairwise(self.truths) for _ in range(b.lost - a.lost)]
        return self.seconds(times)

    def _second(self, at_ns: int) -> float:
        return (at_ns - self.origin_ns) * 1e-9


@dataclass(frozen=True, eq=False)
class Steps:
    """One row for each Δt boundary at which the controller flew (TRACK, BRAKE or HOLD)."""

    decisions: tuple[Decision, ...]
    t_s: Array  # (n,)
    state: Array  # (n, n_x), the true one if known, else the estimate
    decided: Array  # (n, n_u), inputs before the wire; NaN where there was none
    input: Array  # (n, n_u), applied during the step; NaN if unknown
    target: Array  # (n, n_x), where the mission wanted the vehicle to be
    from_truth: bool

    def __len__(self) -> int:
        return len(self.decisions)

    @classmethod
    def of(cls, flight: FlightData) -> Self:
        """Collect the flown boundaries of a flight."""
        decisions = tuple(d for d in flight.flown if d.boundary and d.mode in FLOWN)
        at_ns = np.array([d.at_ns for d in decisions], dtype=np.int64)
        n_x, n_u = len(flight.design.target), len(flight.design.q_u)
        records: Sequence[Truth] | Sequence[Estimate] = flight.truths or flight.estimates
        states = np.array([record.state if isinstance(record, Truth) else record.mean for record in records]).reshape(
            -1, n_x
        )
        decided = np.array([d.input or (np.nan,) * n_u for d in decisions]).reshape(-1, n_u)
        applied = _find_applied_inputs(flight, at_ns) if flight.truths else decided
        nearest = _find_nearest(np.array([record.at_ns for record in records], dtype=np.int64), at_ns)
        state = states[nearest] if len(states) else np.full((len(decisions), n_x), np.nan)
        target = np.array([d.target or flight.design.target for d in decisions]).reshape(-1, n_x)
        return cls(decisions, flight.seconds(at_ns.tolist()), state, decided, applied, target, bool(flight.truths))


def _find_nearest(known_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of the known time nearest to each wanted one; 0 if none is known."""
    right_index = np.clip(np.searchsorted(known_ns, wanted_ns), 0, max(0, len(known_ns) - 1))
    left = np.maximum(right_index - 1, 0)
    if not len(known_ns):
        return right_index
    return np.where(np.abs(known_ns[left] - wanted_ns) < np.abs(known_ns[right_index] - wanted_ns), left, right_index)


def _find_applied_inputs(flight: FlightData, at_ns: NDArray[np.int64]) -> Array:
    """Return the input of the plant in each step (n, n_u).

    The setpoint reaches the vehicle shortly after the boundary, so the last truth within the step
    tells what was applied; the one at the boundary may still show the step before.
    """
    truth_ns = np.array([truth.at_ns for truth in flight.truths], dtype=np.int64)
    last_in_step = np.searchsorted(truth_ns, at_ns + flight.design.dt_ns) - 1
    index = np.where(truth_ns[last_in_step] > at_ns, last_in_step, _find_nearest(truth_ns, at_ns))
    return np.array([truth.input for truth in flight.truths])[index].reshape(len(at_ns), len(flight.design.q_u))
