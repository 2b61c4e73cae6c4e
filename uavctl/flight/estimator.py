"""Estimate from samples that come at any time, late or out of order.

1. A sorted history holds samples, inertial data and input changes. It begins at an anchor that follows the time at a
   distance of `window_s`.
2. The belief after each entry is computed once, when it is asked for. A sample in order costs one update.
3. A late sample is sorted in, and all beliefs after it are computed again: the result is the same to the last bit.
4. Samples can be dropped again, as if they had not come.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from operator import attrgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array, sum_in_order
from uavctl.event_codes import EventCode
from uavctl.flight.kalman import (
    Belief,
    Kalman,
    make_first_belief,
    predict,
    read_capture_ns,
    update_with_inertial,
    update_with_position,
)
from uavctl.records import Estimate, InertialSample, PositionSample, Vec3

# Largest time of a stamp after the arrival. Clocks over a link are known to milliseconds, and a stamp further off says
# nothing of the capture. It is a constant, as a tick may be of any length.
LATEST_STAMP_NS = 20_000_000

# Order of entries at one instant. A sample comes before a change of input, which leaves the state the same.
_SAMPLE, _INERTIAL, _INPUT, _MARK = 0, 1, 2, 3

PendingInputs = tuple[tuple[int, Array | None], ...]  # (when it begins to act [ns], input), oldest first
Key = tuple[int, int, str, int]  # time, kind, source, capture time as stamped
_KEY = attrgetter("key")


class FilterState(msgspec.Struct, frozen=True, eq=False):
    """State of the filter after an entry: the belief (None before the first sample) and the input that acts.

    The input is None while others fly the vehicle.
    """

    belief: Belief | None
    input: Array | None


class FilterEvent(msgspec.Struct, frozen=True, eq=False):
    """Entry of the history: a sample, inertial data, an input change, or a mark (a boundary with its belief)."""

    key: Key
    sample: PositionSample | None = None
    input: Array | None = None  # of an input change; None: others fly from here on
    accel_mps2: Array | None = None  # of inertial data: what they show of each axis of the plant
    distrusts_inertial: bool = False  # inertial data are distrusted from here on


class FilterHistory(msgspec.Struct, frozen=True, eq=False):
    """State of the filter; immutable but for `states`, which follow from all else and are filled in when asked for."""

    origin_ns: int  # A boundary of the Δt grid [ns]
    window_begin_ns: int  # everything up to here is in the anchor; older samples are refused [ns]
    anchor: FilterState  # state of the filter at the begin of the window
    entries: Sequence[FilterEvent] = ()  # entries since then, sorted by key
    states: list[FilterState] = []  # states of the filter after the first entries, as far as they are known

    @property
    def captured_ns(self) -> int | None:
        """Capture time of the newest sample, None before the first."""
        for entry in reversed(self.entries):
            if entry.sample is not None:
                return entry.key[0]
        return None if self.anchor.belief is None else self.anchor.belief.captured_ns


def begin_history(kalman: Kalman, origin_ns: int, at_ns: int) -> FilterHistory:
    """Begin an empty history at `at_ns`, on the grid of boundaries origin_ns + n Δt."""
    return FilterHistory(
        origin_ns=origin_ns, window_begin_ns=at_ns - kalman.window_ns, anchor=FilterState(belief=None, input=None)
    )


def advance_window(kalman: Kalman, history: FilterHistory, at_ns: int) -> FilterHistory:
    """Move the window up to `at_ns`, and keep a belief at a boundary that has come."""
    is_due = is_mark_due(kalman, history, at_ns)
    history = insert_mark(kalman, history, at_ns) if is_due else history
    return move_window(kalman, history, at_ns)


def move_window(kalman: Kalman, history: FilterHistory, at_ns: int) -> FilterHistory:
    """Move the window up to `at_ns`, and its anchor to the state at its begin."""
    begin_ns, past = max(history.window_begin_ns, at_ns - kalman.window_ns), 0
    while past < len(history.entries) and history.entries[past].key[0] <= begin_ns:
        past += 1
    anchor = _compute_state(kalman, history, past)
    return FilterHistory(history.origin_ns, begin_ns, anchor, history.entries[past:], history.states[past:])


def is_mark_due(kalman: Kalman, history: FilterHistory, at_ns: int) -> bool:
    """Whether a boundary has come at which no belief is kept yet."""
    window_begin_ns = max(history.window_begin_ns, at_ns - kalman.window_ns)
    mark = _find_mark(kalman, history, at_ns)
    return mark[0] > window_begin_ns and (not history.entries or history.entries[-1].key < mark)


def insert_mark(kalman: Kalman, history: FilterHistory, at_ns: int) -> FilterHistory:
    """Keep a belief at the last boundary."""
    mark = _find_mark(kalman, history, at_ns)
    return _insert(history, FilterEvent(key=mark))


def _find_mark(kalman: Kalman, history: FilterHistory, at_ns: int) -> Key:
    boundary_ns = at_ns - (at_ns - history.origin_ns) % kalman.propagation.dt_ns
    return (boundary_ns, _MARK, "", boundary_ns)


def absorb_samples(
    kalman: Kalman, history: FilterHistory, at_ns: int, samples: Sequence[PositionSample]
) -> tuple[FilterHistory, tuple[PositionSample, ...], tuple[str, ...]]:
    """Move the window up to `at_ns` and take samples of any age and order.

    Args:
        at_ns: Time now [ns]; no sample may be captured or received later.
        samples: Valid samples (see `uavctl.flight.measure`).

    Returns:
        The new state, the samples that were taken, and the reason for each one that was refused.
    """
    history = advance_window(kalman, history, at_ns)
    taken: list[PositionSample] = []
    refused: list[str] = []
    for sample in samples:
        history, reason = insert_sample(kalman, history, sample)
        if reason is None:
            taken.append(sample)
        else:
            refused.append(reason)
    return history, tuple(taken), tuple(refused)


def insert_sample(
    kalman: Kalman, history: FilterHistory, sample: PositionSample, belief: Belief | None = None
) -> tuple[FilterHistory, str | None]:
    """Sort a sample in; return too the reason if it is refused.

    Args:
        belief: Result of `predict_belief` at its capture time, if that is known.
    """
    key = (read_capture_ns(sample), _SAMPLE, sample.source, sample.captured_ns)
    if key[0] <= history.window_begin_ns:
        return history, EventCode.SAMPLE_TOO_OLD
    if _is_duplicate(history.entries, key):
        return history, EventCode.SAMPLE_DUPLICATE
    new = FilterEvent(key=key, sample=sample)
    place = _find_place(history.entries, key)
    inserted, later = _insert(history, new), history.entries[place:]
    if belief is not None and len(history.states) >= place and not (later and later[0].key[0] == key[0]):
        # The prediction is this one, and not that of a later entry of the same instant.
        inserted.states.append(_apply_entry(kalman, history, _compute_state(kalman, history, place), new, belief))
    return inserted, None


def update_inertial(kalman: Kalman, history: FilterHistory, samples: Sequence[InertialSample]) -> FilterHistory:
    """Take the mean of a tick's inertial data, at the mean of their times.

    Data that are not finite, or equal to the last bit to the ones before, are ignored.
    """
    readings = [one for one, before in zip(samples, (None, *samples), strict=False) if _is_new_reading(one, before)]
    if not readings or not kalman.n_inertial:
        return history
    at_ns = sum([one.at_ns for one in readings]) // len(readings)
    if at_ns <= history.window_begin_ns:
        return history
    mean = average_vectors([one.accel_mps2 for one in readings])
    accel = np.array([mean[axis] for axis in kalman.axes])
    return _insert(history, FilterEvent(key=(at_ns, _INERTIAL, "", at_ns), accel_mps2=accel))


def distrust_inertial(history: FilterHistory, at_ns: int) -> FilterHistory:
    """Drop the inertial data since the newest position of the window, and distrust those that come."""
    newest = max((place for place, entry in enumerate(history.entries) if entry.sample is not None), default=-1)
    kept = [entry for place, entry in enumerate(history.entries) if place <= newest or entry.accel_mps2 is None]
    history = _keep_entries(history, kept)
    return _insert(history, FilterEvent(key=(at_ns, _MARK, "distrusted", at_ns), distrusts_inertial=True))


def average_vectors(vectors: Sequence[Vec3]) -> Vec3:
    """Return the mean of vectors, at least one."""
    n = len(vectors)
    # ā = Σ a_i / n
    north, east, down = [sum_in_order(values) / n for values in zip(*vectors, strict=True)]
    return north, east, down


def _is_new_reading(sample: InertialSample, before: InertialSample | None) -> bool:
    is_finite = all(map(math.isfinite, sample.accel_mps2))
    return is_finite and (before is None or before.accel_mps2 != sample.accel_mps2)


def _is_duplicate(entries: Sequence[FilterEvent], key: Key) -> bool:
    """Whether a source has sent a sample with this stamp. Stamps lie near the capture times that count."""
    for entry in reversed(entries):
        if entry.key[0] < key[3] - LATEST_STAMP_NS:
            return False
        if entry.key[0] <= key[3] and entry.key[2:] == key[2:]:
            return True
    return False


def drop_samples(history: FilterHistory, dropped: Callable[[PositionSample], bool]) -> FilterHistory:
    """Drop samples of the window, as if they had not come."""
    return _keep_entries(
        history, [entry for entry in history.entries if entry.sample is None or not dropped(entry.sample)]
    )


def weaken_samples(history: FilterHistory, std_m: float) -> FilterHistory:
    """Let samples of the window count with this standard deviation [m] at least, as if they had come with it."""
    return _keep_entries(
        history,
        [
            entry
            if entry.sample is None or entry.sample.std_m >= std_m
            else replace(entry, sample=replace(entry.sample, std_m=std_m))
            for entry in history.entries
        ],
    )


def shift_positions(kalman: Kalman, history: FilterHistory, shift: Callable[[int], tuple[Vec3, Vec3]]) -> FilterHistory:
    """Move the positions of the window, as if they had come so; what was before it moves along.

    Args:
        shift: Gives how far positions [m] and velocities [m/s] of a time move.
    """
    entries = []
    for entry in history.entries:
        if entry.sample is not None:
            moved, _ = shift(entry.key[0])
            north, east, down = (p + m for p, m in zip(entry.sample.position_m, moved, strict=True))
            entry = replace(entry, sample=replace(entry.sample, position_m=(north, east, down)))
        entries.append(entry)
    anchor, belief = history.anchor, history.anchor.belief
    if belief is not None:
        values = [vector[axis] for vector in shift(belief.at_ns) for axis in kalman.axes]
        mean = belief.mean.copy()
        mean[kalman.measured_index] += values
        anchor = FilterState(replace(belief, mean=mean), anchor.input)
    return FilterHistory(history.origin_ns, history.window_begin_ns, anchor, entries, [])


def note_input(history: FilterHistory, at_ns: int, u: Array | None, belief: Belief | None = None) -> FilterHistory:
    """Note that an input acts from now on.

    Args:
        at_ns: Time now [ns]; it never goes back, and nothing that is known is later.
        u: The input (n_u,); None: others fly.
        belief: Result of `predict_belief` at `at_ns`, if that is known.
    """
    before = _find_newest_input(history)
    if before is u or (before is not None and u is not None and before.tolist() == u.tolist()):
        return history
    new = FilterEvent(key=(at_ns, _INPUT, "", at_ns), input=u)
    place = _find_place(history.entries, new.key)
    inserted = _insert(history, new)
    if belief is not None and len(history.states) >= place:
        inserted.states.append(FilterState(belief=belief, input=u))
    return inserted


def apply_due_inputs(
    history: FilterHistory, pending_inputs: PendingInputs, at_ns: int
) -> tuple[FilterHistory, PendingInputs]:
    """Note the inputs that have begun to act by `at_ns`; those that have not are left."""
    for due_ns, u in pending_inputs:
        if due_ns > at_ns:
            break
        history = note_input(history, due_ns, u)
        pending_inputs = pending_inputs[1:]
    return history, pending_inputs


def predict_ahead(
    kalman: Kalman, history: FilterHistory, pending_inputs: PendingInputs, belief: Belief | None, ahead_ns: int
) -> Belief | None:
    """Predict a belief (see `predict_belief`) on by `ahead_ns`, with the inputs that were sent."""
    if belief is None or not ahead_ns:
        return belief
    at_ns = belief.at_ns
    u = _find_state(kalman, history, at_ns).input
    acted: list[tuple[int, Array | None]] = []
    for entry in reversed(history.entries):  # of a window, a few are newer
        if entry.key[0] <= at_ns:
            break
        if entry.key[1] == _INPUT:
            acted.append((entry.key[0], entry.input))
    for due_ns, after in (*acted[::-1], *pending_inputs):
        if at_ns < due_ns < at_ns + ahead_ns:
            belief, u = predict(kalman, history.origin_ns, belief, u, due_ns), after
    return predict(kalman, history.origin_ns, belief, u, at_ns + ahead_ns)


def estimate_at(kalman: Kalman, history: FilterHistory, at_ns: int) -> Estimate | None:
    """Estimate the state at `at_ns` from all that had come by then; None before the first sample.

    A time before the newest entry leaves out what came after it; a time before the window has no estimate.
    """
    belief = predict_belief(kalman, history, at_ns)
    return None if belief is None else make_estimate(kalman, belief)


def make_estimate(kalman: Kalman, belief: Belief, *, with_cov: bool = True) -> Estimate:
    """Make the estimate that leaves the filter from a belief, biases within their bounds."""
    bias = kalman.bias
    return Estimate(
        at_ns=belief.at_ns,
        captured_ns=belief.captured_ns,
        mean=tuple(belief.mean[: bias.start].tolist()),
        cov=tuple(map(tuple, belief.cov[: bias.start, : bias.start].tolist())) if with_cov else (),
        # d within ±d_max
        bias=tuple(
            [min(max(d, -most), most) for d, most in zip(belief.mean[bias].tolist(), kalman.bias_bounds, strict=True)]
        ),
    )


def select_covariance(kalman: Kalman, belief: Belief) -> Array:
    """Select the covariance (n, n) of the states and, behind them, of the biases."""
    n = kalman.bias.stop
    return np.ascontiguousarray(belief.cov[:n, :n])


def find_newest_capture_ns(kalman: Kalman, history: FilterHistory, at_ns: int) -> int | None:
    """Find the capture time of the newest sample up to `at_ns`; None where there is no estimate."""
    belief = _find_state(kalman, history, at_ns).belief
    return None if belief is None or belief.at_ns > at_ns else belief.captured_ns


def predict_belief(kalman: Kalman, history: FilterHistory, at_ns: int) -> Belief | None:
    """Predict the belief at `at_ns` from all that had come by then; None where there is none, as with `estimate_at`."""
    node = _find_state(kalman, history, at_ns)
    if node.belief is None or node.belief.at_ns > at_ns:
        return None
    return predict(kalman, history.origin_ns, node.belief, node.input, at_ns)


def predict_without_samples(kalman: Kalman, history: FilterHistory, belief: Belief, at_ns: int) -> Belief:
    """Predict an earlier belief for `at_ns` by the inputs that acted, without the samples since."""
    u = _find_state(kalman, history, belief.at_ns).input
    for entry in history.entries:
        if entry.key[1] == _INPUT and belief.at_ns < entry.key[0] < at_ns:
            belief = predict(kalman, history.origin_ns, belief, u, entry.key[0])
            u = entry.input
    return predict(kalman, history.origin_ns, belief, u, at_ns)


def find_newest_belief(kalman: Kalman, history: FilterHistory) -> Belief | None:
    """Find the belief after all that has come; None before the first sample."""
    return _compute_state(kalman, history, len(history.entries)).belief


def _find_newest_input(history: FilterHistory) -> Array | None:
    """Find the input that acts after all that has come."""
    for entry in reversed(history.entries):
        if entry.key[1] == _INPUT:
            return entry.input
    return history.anchor.input


def _find_state(kalman: Kalman, history: FilterHistory, at_ns: int) -> FilterState:
    """Find the state of the filter after all that had come by `at_ns`."""
    count = len(history.entries)
    while count and history.entries[count - 1].key[0] > at_ns:  # few are newer, as a rule
        count -= 1
    return _compute_state(kalman, history, count)


def _compute_state(kalman: Kalman, history: FilterHistory, count: int) -> FilterState:
    """Compute the state of the filter after the first `count` entries, from those that are known."""
    states = history.states
    for entry in history.entries[len(states) : count]:
        before = states[-1] if states else history.anchor
        states.append(_apply_entry(kalman, history, before, entry))
    return states[count - 1] if count else history.anchor


def _find_place(entries: Sequence[FilterEvent], key: Key) -> int:
    """Find the place of a key in a sorted history; most belong at its end."""
    return len(entries) if not entries or entries[-1].key <= key else bisect_right(entries, key, key=_KEY)


def _insert(history: FilterHistory, new: FilterEvent) -> FilterHistory:
    """Sort an entry in; the states from there on are not known any more."""
    entries, place = [*history.entries], _find_place(history.entries, new.key)
    entries.insert(place, new)
    return FilterHistory(
        origin_ns=history.origin_ns,
        window_begin_ns=history.window_begin_ns,
        anchor=history.anchor,
        entries=entries,
        states=history.states[:place],
    )


def _keep_entries(history: FilterHistory, kept: Sequence[FilterEvent]) -> FilterHistory:
    """Keep these entries only; the states from the first change on are not known any more."""
    same = 0
    while same < len(kept) and kept[same] is history.entries[same]:
        same += 1
    return replace(history, entries=kept, states=history.states[:same])


def _apply_entry(
    kalman: Kalman, history: FilterHistory, before: FilterState, entry: FilterEvent, belief: Belief | None = None
) -> FilterState:
    """Apply an entry to the state of the filter before it; `belief` is the prediction for it, if that is known."""
    if belief is None and before.belief is not None:
        belief = predict(kalman, history.origin_ns, before.belief, before.input, entry.key[0])
    if entry.sample is not None:
        belief = (
            make_first_belief(kalman, entry.sample)
            if belief is None
            else update_with_position(kalman, belief, entry.sample)
        )
    elif entry.accel_mps2 is not None and belief is not None:
        belief = update_with_inertial(kalman, belief, entry.accel_mps2, before.input)
    if entry.distrusts_inertial and belief is not None and belief.inertial.distrusted_ns is None:
        belief = replace(belief, inertial=replace(belief.inertial, distrusted_ns=entry.key[0]))
    return FilterState(belief=belief, input=entry.input if entry.key[1] == _INPUT else before.input)
