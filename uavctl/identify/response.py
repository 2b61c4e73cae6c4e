"""How likely a recorded axis is under one of the plants: the innovations of a Kalman filter.

The motion is linear, so what the inputs do is one sum from the stretch's begin on, and the filter follows the rest: it
steps from position to position, however many inputs lie between. All times are counted in instants of half a
millisecond, so few different lengths occur, and each is a product of powers of one instant's motion. Several parameter
vectors go through at once: a gradient costs one pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavctl.identify.axis_model import AxisModel, LinearMotion
from uavctl.identify.history import Stretch

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

OUTLIER = 5.0  # standard deviations beyond which an innovation counts by its size and not by its square (Huber)
INSTANT_S = 5e-4  # a vehicle at 1.5 m/s goes 0.4 mm in half of it, less than the noise of any camera
_ORDER = 8  # of the series of one instant, in which no lag is shorter than twenty
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(3)


@dataclass(frozen=True, eq=False)
class Timeline:
    """An axis' stretch cut where the input changes or a position was captured.

    Attributes:
        lengths: (n,) of the parts [instants].
        inputs_mps2: (n,), held in each [m/s²].
        measured: (m,), the part at whose end each position was captured.
        positions_m: (m,) [m].
    """

    lengths: Counts
    inputs_mps2: Array
    measured: Counts
    positions_m: Array

    @property
    def captured(self) -> Counts:
        """Time of capture of each position, from the first one on (m,) [instants]."""
        return np.cumsum(self.lengths)[self.measured]


class Advance(NamedTuple):
    """Motion over different lengths, for k parameter vectors.

    Attributes:
        move: (lengths, k, n, n).
        push: (lengths, k, n), by a held input of one.
        spread: Covariance that the noise makes (lengths, k, n, n).
    """

    move: Array
    push: Array
    spread: Array


@dataclass(frozen=True, eq=False)
class Filtered:
    """What the filter made of a timeline, under one parameter vector.

    Attributes:
        driven: (m, n), what the inputs alone have done since the begin.
        rest: (m, n), the state without that, with the position there.
        innovations_m: (m,): position minus what was predicted of it, in the order of capture [m].
        stds_m: (m,), standard deviation that the filter gives each [m].
    """

    driven: Array
    rest: Array
    innovations_m: Array
    stds_m: Array


def timeline(stretch: Stretch, axis: int, dead_time_s: float) -> Timeline:
    """Cut a stretch for one axis, its inputs acting `dead_time_s` after they were sent."""
    captured, positions_m = _instants(stretch.times_s), stretch.positions_m[:, axis]
    captured, first = np.unique(captured, return_index=True)
    changes = _instants(stretch.input_times_s + dead_time_s)
    begin, end = captured[0], captured[-1]
    cuts = np.unique(np.concatenate([changes[(changes > begin) & (changes < end)], captured]))
    held = np.clip(np.searchsorted(changes, cuts[:-1], side="right") - 1, 0, None)
    return Timeline(
        lengths=np.concatenate([[0], np.diff(cuts)]),
        inputs_mps2=np.concatenate([[0.0], stretch.inputs_mps2[held, axis]]),
        measured=np.searchsorted(cuts, captured),
        positions_m=positions_m[first],
    )


def deviance(parts: Sequence[Timeline], model: AxisModel, parameters: Array) -> Array:
    """-2 log likelihood of all parts of an axis, up to a constant, for each of k parameter vectors (k, m)."""
    total = np.zeros(len(parameters))
    motion = model.motion(parameters)
    for part in parts:
        total += _pass(part, model, motion, parameters)[0]
    return total


def filtered(part: Timeline, model: AxisModel, parameters: Array) -> Filtered:
    """States and innovations of one part under one parameter vector (m,)."""
    _, driven, rest, innovations, variances = _pass(part, model, model.motion(parameters[None]), parameters[None])
    return Filtered(driven[:, 0], rest[:, 0], innovations[:, 0], np.sqrt(variances[:, 0]))


def advance(motion: LinearMotion, lengths: Counts) -> Advance:
    """Motion over some lengths (n,) [instants], by the binary digits of each."""
    move, push, spread = _instant(motion)
    count, size = len(lengths), move.shape[-1]
    moves = np.tile(np.eye(size), (count, len(move), 1, 1))
    pushes, spreads = np.zeros((count, *push.shape)), np.zeros((count, *spread.shape))
    for digit in range(int(lengths.max(initial=0)).bit_length()):
        chosen = (lengths >> digit) & 1 == 1
        moves[chosen] = move @ moves[chosen]
        pushes[chosen] = push + (move @ pushes[chosen][..., None])[..., 0]
        spreads[chosen] = spread + move @ spreads[chosen] @ move.swapaxes(1, 2)
        push = push + (move @ push[..., None])[..., 0]
        spread = spread + move @ spread @ move.swapaxes(1, 2)
        move = move @ move
    return Advance(moves, pushes, spreads)


def _instants(times_s: Array) -> Counts:
    return np.rint(times_s / INSTANT_S).astype(np.int64)


def _instant(motion: LinearMotion) -> tuple[Array, Array, Array]:
    """Transition, effect of a held input, and covariance of the noise, of one instant."""
    move, integral = _series(motion.a, INSTANT_S)
    spread = np.zeros_like(motion.noise)
    for node, weight in zip(_GAUSS_X, _GAUSS_W, strict=True):
        left, _ = _series(motion.a, INSTANT_S * (1.0 + float(node)) / 2.0)
        spread += INSTANT_S * float(weight) / 2.0 * (left @ motion.noise @ left.swapaxes(1, 2))
    return move, (integral @ motion.b[..., None])[..., 0], spread


def _series(slope: Array, time_s: float) -> tuple[Array, Array]:
    """exp(A t) and its integral from 0 to t, (k, n, n) each."""
    term = np.broadcast_to(np.eye(slope.shape[-1]), slope.shape)
    power, integral = term.copy(), time_s * term
    for order in range(1, _ORDER + 1):
        term = term @ slope * (time_s / order)
        power += term
        integral = integral + term * (time_s / (order + 1))
    return power, integral


def _pass(
    part: Timeline, model: AxisModel, motion: LinearMotion, parameters: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Deviance (k,), driven and other states (m, k, n), innovations and their variances (m, k)."""
    driven = _driven(part, motion)
    different, which = np.unique(np.diff(part.captured), return_inverse=True)
    moves, _, spreads = advance(motion, different)
    noise = [one.name for one in model.free].index("noise_m")
    seen_var = np.exp(2.0 * parameters[:, noise])
    count = len(parameters)
    state = np.zeros((count, len(model.start_std)))
    state[:, 0] = part.positions_m[0]
    cov = np.tile(np.diag(np.square(model.start_std)), (count, 1, 1))
    total = np.zeros(count)
    states, innovations, variances = [], [], []
    for index, position_m in enumerate(part.positions_m):
        if index:
            move = moves[which[index - 1]]
            state = (move @ state[:, :, None])[:, :, 0]
            cov = move @ cov @ move.swapaxes(1, 2) + spreads[which[index - 1]]
        variance = cov[:, 0, 0] + seen_var
        innovation = position_m - driven[index, :, 0] - state[:, 0]
        size = np.abs(innovation) / np.sqrt(variance)
        trust = OUTLIER / np.maximum(size, OUTLIER)
        total += np.where(size < OUTLIER, size**2, OUTLIER * (2.0 * size - OUTLIER)) + np.log(variance)
        gain = cov[:, :, 0] / variance[:, None]
        state = state + gain * (trust * innovation)[:, None]
        cov = cov - gain[:, :, None] * cov[:, None, 0, :]
        innovations.append(innovation)
        variances.append(variance)
        states.append(state)
    return total, driven, np.array(states), np.array(innovations), np.array(variances)


def _driven(part: Timeline, motion: LinearMotion) -> Array:
    """What the inputs alone have done at each position (m, k, n)."""
    different, which = np.unique(part.lengths, return_inverse=True)
    moves, pushes, _ = advance(motion, different)
    state = np.zeros((*motion.b.shape, 1))
    pushed = pushes[which] * part.inputs_mps2[:, None, None]
    states = np.empty((len(which), *motion.b.shape))
    for index, kind in enumerate(which):
        state = moves[kind] @ state
        state[:, :, 0] += pushed[index]
        states[index] = state[:, :, 0]
    return states[part.measured]
