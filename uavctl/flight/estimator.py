"""Estimate from samples that come at any time, late or out of order.

A sorted history of samples and input changes starts at an anchor that follows the time at a distance
of `window_s`. Each entry keeps the belief after it, so that a sample in order costs one update, and a
late one a recomputation from its place on: the result is the same to the last bit.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from operator import attrgetter

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.flight.kalman import Array, Belief, Kalman, captured_ns, felt, first_belief, predicted, updated
from uavctl.records import Estimate, InertialSample, PositionSample

DUPLICATE = "sample-duplicate"
TOO_OLD = "sample-too-old"

# How far a stamp may lie after the arrival: clocks over a link are known to milliseconds, and a stamp that is
# further off says nothing of the capture. A constant, as a tick may be of any length.
LATEST_STAMP_NS = 20_000_000

# Order of what happens at one instant; a sample comes before a change of input, which leaves the state the same.
_SAMPLE, _FELT, _INPUT, _MARK = 0, 1, 2, 3

Coming = tuple[tuple[int, Array | None], ...]  # (when it begins to act [ns], input), oldest first
Key = tuple[int, int, str, int]  # time, kind, source, capture time as stamped
_KEY = attrgetter("key")


class Node(msgspec.Struct, frozen=True, eq=False):
    """State of the filter after an entry: the belief (None before the first sample) and the input that acts.

    The input is None while others fly the vehicle.
    """

    belief: Belief | None
    input: Array | None


class FilterEvent(msgspec.Struct, frozen=True, eq=False):
    """One happening: a sample, inertial data, an input change, or none (a boundary, where a belief is kept)."""

    key: Key
    sample: PositionSample | None
    input: Array | None  # of an input change; None: others fly from here on
    after: Node
    accel_mps2: Array | None = None  # of inertial data: what they show of each axis of the plant
    doubted: bool = False  # inertial data are doubted from here on


class FilterHistory(msgspec.Struct, frozen=True, eq=False):
    """State of the filter; immutable."""

    origin_ns: int  # A boundary of the Δt grid [ns]
    horizon_ns: int  # everything up to here is in the anchor; older samples are refused [ns]
    anchor: Node  # state of the filter at the horizon
    entries: tuple[FilterEvent, ...] = ()  # entries since then, sorted by key

    @property
    def newest(self) -> Node:
        """State of the filter after all entries."""
        return self.entries[-1].after if self.entries else self.anchor

    @property
    def captured_ns(self) -> int | None:
        """Capture time of the newest sample, None before the first."""
        belief = self.newest.belief
        return None if belief is None else belief.captured_ns


def begin(kalman: Kalman, origin_ns: int, at_ns: int) -> FilterHistory:
    """An empty history at `at_ns`, on the grid of boundaries origin_ns + n Δt."""
    return FilterHistory(
        origin_ns=origin_ns, horizon_ns=_horizon_ns(kalman, at_ns), anchor=Node(belief=None, input=None)
    )


def move_on(kalman: Kalman, history: FilterHistory, at_ns: int) -> FilterHistory:
    """Move the window up to `at_ns`, and keep a belief at a boundary that has come."""
    horizon_ns = max(history.horizon_ns, _horizon_ns(kalman, at_ns))
    boundary_ns = at_ns - (at_ns - history.origin_ns) % kalman.propagation.dt_ns
    mark = (boundary_ns, _MARK, "", boundary_ns)
    if boundary_ns > horizon_ns and (not history.entries or history.entries[-1].key < mark):
        history = _inserted(kalman, history, FilterEvent(key=mark, sample=None, input=None, after=history.newest), None)
    return _trimmed(history, horizon_ns)


def absorb(
    kalman: Kalman, history: FilterHistory, at_ns: int, samples: Sequence[PositionSample], belief: Belief | None = None
) -> tuple[FilterHistory, tuple[PositionSample, ...], tuple[str, ...]]:
    """Move the window up to `at_ns` and take samples of any age and order.

    Args:
        at_ns: Time now [ns]; no sample may be captured or received later.
        samples: Valid samples (see `uavctl.flight.gating`).
        belief: What `belief_at` gives at the first one's capture time, if that has been asked.

    Returns:
        The new state, the samples that were taken, and the reason for each one that was refused.
    """
    history = move_on(kalman, history, at_ns)
    taken: list[PositionSample] = []
    refused: list[str] = []
    for sample in samples:
        key = (captured_ns(sample), _SAMPLE, sample.source, sample.captured_ns)
        if key[0] <= history.horizon_ns:
            refused.append(TOO_OLD)
        elif _known_already(history.entries, key):
            refused.append(DUPLICATE)
        else:
            taken.append(sample)
            new = FilterEvent(key=key, sample=sample, input=None, after=history.anchor)
            history = _inserted(kalman, history, new, belief)
        belief = None  # the next one's is another
    return history, tuple(taken), tuple(refused)


def feel(kalman: Kalman, history: FilterHistory, samples: Sequence[InertialSample]) -> FilterHistory:
    """Take the mean of a tick's inertial data, at the mean of their times.

    Data that are not finite, or equal to the last bit to the ones before, are ignored.
    """
    told = [one for one, before in zip(samples, (None, *samples), strict=False) if _says_something(one, before)]
    if not told or not kalman.n_felt:
        return history
    at_ns = sum(one.at_ns for one in told) // len(told)
    if at_ns <= history.horizon_ns:
        return history
    accel = np.add.reduce([one.accel_mps2 for one in told], axis=0)[list(kalman.axes)] / len(told)
    key = (at_ns, _FELT, "", at_ns)
    new = FilterEvent(key=key, sample=None, input=None, after=history.anchor, accel_mps2=accel)
    return _inserted(kalman, history, new, None)


def doubted(kalman: Kalman, history: FilterHistory, at_ns: int) -> FilterHistory:
    """The state without the inertial data since the newest position of the window, and with more of them doubted."""
    newest = max((place for place, entry in enumerate(history.entries) if entry.sample is not None), default=-1)
    node, kept = history.anchor, []
    for place, entry in enumerate(history.entries):
        if place > newest and entry.accel_mps2 is not None:
            continue
        node = _after(kalman, history.origin_ns, node, entry)
        kept.append(replace(entry, after=node))
    history = replace(history, entries=tuple(kept))
    mark = FilterEvent(key=(at_ns, _MARK, "doubted", at_ns), sample=None, input=None, after=node, doubted=True)
    return _inserted(kalman, history, mark, None)


def _says_something(sample: InertialSample, before: InertialSample | None) -> bool:
    told = all(map(math.isfinite, sample.accel_mps2))
    return told and (before is None or before.accel_mps2 != sample.accel_mps2)


def _known_already(entries: Sequence[FilterEvent], key: Key) -> bool:
    """Whether a source has said something of this capture time, as stamped; near it, as stamps lie near arrivals."""
    first = bisect_left(entries, key[3] - LATEST_STAMP_NS, key=lambda entry: entry.key[0])
    for entry in entries[first:]:
        if entry.key[0] > key[3]:
            return False
        if entry.key[2:] == key[2:]:
            return True
    return False


def without(kalman: Kalman, history: FilterHistory, poisoned: Callable[[PositionSample], bool]) -> FilterHistory:
    """The state as if some samples of the window had not come."""
    node, kept = history.anchor, []
    for entry in history.entries:
        if entry.sample is not None and poisoned(entry.sample):
            continue
        node = _after(kalman, history.origin_ns, node, entry)
        kept.append(replace(entry, after=node))
    return replace(history, entries=tuple(kept))


def set_input(
    kalman: Kalman, history: FilterHistory, at_ns: int, u: Array | None, belief: Belief | None = None
) -> FilterHistory:
    """Note that an input acts from now on.

    Args:
        at_ns: Time now [ns]; it never goes back, and nothing that is known is later.
        u: The input (n_u,); None: others fly.
        belief: What `belief_at` gives at `at_ns`, if that has been asked.
    """
    before = history.newest.input
    if before is u or (before is not None and u is not None and before.tolist() == u.tolist()):
        return history
    after = Node(belief=belief or belief_at(kalman, history, at_ns), input=u)
    entry = FilterEvent(key=(at_ns, _INPUT, "", at_ns), sample=None, input=u, after=after)
    place = bisect_right(history.entries, entry.key, key=_KEY)
    marks = (replace(mark, after=after) for mark in history.entries[place:])  # of the same instant
    return replace(history, entries=(*history.entries[:place], entry, *marks))


def act(kalman: Kalman, history: FilterHistory, coming: Coming, at_ns: int) -> tuple[FilterHistory, Coming]:
    """Note the inputs that have begun to act by `at_ns`; those that have not are left."""
    for due_ns, u in coming:
        if due_ns > at_ns:
            break
        history = set_input(kalman, history, due_ns, u)
        coming = coming[1:]
    return history, coming


def belief_ahead(kalman: Kalman, history: FilterHistory, coming: Coming, at_ns: int, ahead_ns: int) -> Belief | None:
    """The belief of `at_ns`, see `belief_at`, moved on by `ahead_ns` with the inputs that were sent."""
    belief = belief_at(kalman, history, at_ns)
    if belief is None or not ahead_ns:
        return belief
    u = _known(history, at_ns).input
    acted: list[tuple[int, Array | None]] = []
    for entry in reversed(history.entries):  # of a window, a few are newer
        if entry.key[0] <= at_ns:
            break
        if entry.key[1] == _INPUT:
            acted.append((entry.key[0], entry.input))
    for due_ns, after in (*acted[::-1], *coming):
        if at_ns < due_ns < at_ns + ahead_ns:
            belief, u = predicted(kalman, history.origin_ns, belief, u, due_ns), after
    return predicted(kalman, history.origin_ns, belief, u, at_ns + ahead_ns)


def estimate(kalman: Kalman, history: FilterHistory, at_ns: int) -> Estimate | None:
    """Estimate at `at_ns` from all that had happened by then; None before the first sample.

    A time before the newest entry leaves out what came after it; a time before the window has no estimate.
    """
    belief = belief_at(kalman, history, at_ns)
    return None if belief is None else estimated(kalman, belief)


def estimated(kalman: Kalman, belief: Belief) -> Estimate:
    """Return a belief as the estimate that leaves the filter, biases within their bounds."""
    bias, largest = kalman.bias, np.array(kalman.bias_bounds)
    return Estimate(
        at_ns=belief.at_ns,
        captured_ns=belief.captured_ns,
        mean=tuple(belief.mean[: bias.start].tolist()),
        cov=tuple(map(tuple, belief.cov[: bias.start, : bias.start].tolist())),
        bias=tuple(belief.mean[bias].clip(-largest, largest).tolist()),
    )


def uncertain(kalman: Kalman, belief: Belief) -> Array:
    """Covariance (n, n) of the states and, behind them, of the biases."""
    n = kalman.bias.stop
    return np.ascontiguousarray(belief.cov[:n, :n])


def newest_capture_ns(history: FilterHistory, at_ns: int) -> int | None:
    """Capture time of the newest sample from up to `at_ns`; None where there is no estimate."""
    belief = _known(history, at_ns).belief
    return None if belief is None or belief.at_ns > at_ns else belief.captured_ns


def belief_at(kalman: Kalman, history: FilterHistory, at_ns: int) -> Belief | None:
    """The belief at `at_ns` from all that had happened by then; None where there is none, as with `estimate`."""
    node = _known(history, at_ns)
    if node.belief is None or node.belief.at_ns > at_ns:
        return None
    return predicted(kalman, history.origin_ns, node.belief, node.input, at_ns)


def coasted(kalman: Kalman, history: FilterHistory, belief: Belief, at_ns: int) -> Belief:
    """An earlier belief moved on to `at_ns` by the inputs that acted, without what samples have shown since."""
    u = _known(history, belief.at_ns).input
    for entry in history.entries:
        if entry.key[1] == _INPUT and belief.at_ns < entry.key[0] < at_ns:
            belief = predicted(kalman, history.origin_ns, belief, u, entry.key[0])
            u = entry.input
    return predicted(kalman, history.origin_ns, belief, u, at_ns)


def _known(history: FilterHistory, at_ns: int) -> Node:
    """Return the state of the filter after all that had happened by `at_ns`."""
    for entry in reversed(history.entries):  # one of the newest, as a rule
        if entry.key[0] <= at_ns:
            return entry.after
    return history.anchor


def _horizon_ns(kalman: Kalman, at_ns: int) -> int:
    return at_ns - round(kalman.parameters.window_s * 1e9)


def _inserted(kalman: Kalman, history: FilterHistory, new: FilterEvent, belief: Belief | None) -> FilterHistory:
    """Sort an entry in and recompute the beliefs from there on; its own prediction may have been asked before."""
    entries = history.entries
    place = bisect_right(entries, new.key, key=_KEY)
    node = entries[place - 1].after if place else history.anchor
    later = entries[place:]
    if later and later[0].key[0] == new.key[0]:
        belief = None  # it may be that of the later one
    node = _after(kalman, history.origin_ns, node, new, belief)
    changed = [replace(new, after=node)]
    for entry in later:
        node = _after(kalman, history.origin_ns, node, entry)
        changed.append(replace(entry, after=node))
    return replace(history, entries=(*entries[:place], *changed))


def _trimmed(history: FilterHistory, horizon_ns: int) -> FilterHistory:
    """Move the anchor up to the horizon."""
    past = 0
    while past < len(history.entries) and history.entries[past].key[0] <= horizon_ns:
        past += 1
    anchor = history.entries[past - 1].after if past else history.anchor
    return replace(history, horizon_ns=horizon_ns, anchor=anchor, entries=history.entries[past:])


def _after(kalman: Kalman, origin_ns: int, node: Node, entry: FilterEvent, belief: Belief | None = None) -> Node:
    """Return the state of the filter after an entry; `belief` is the prediction for it, if it is there already."""
    if belief is None and node.belief is not None:
        belief = predicted(kalman, origin_ns, node.belief, node.input, entry.key[0])
    if entry.sample is not None:
        belief = first_belief(kalman, entry.sample) if belief is None else updated(kalman, belief, entry.sample)
    elif entry.accel_mps2 is not None and belief is not None:
        belief = felt(kalman, belief, entry.accel_mps2, node.input)
    if entry.doubted and belief is not None and belief.doubted_ns is None:
        belief = replace(belief, doubted_ns=entry.key[0])
    return Node(belief=belief, input=entry.input if entry.key[1] == _INPUT else node.input)
