"""How likely a recorded axis is under p' = v, v' = a - c v + b + w, T a' = g u(t - d) - a.

b is constant in a stretch, w is white; positions are seen with white noise. The likelihood is that of the innovations
of a Kalman filter, for several sets of parameters at once, so that a gradient costs one pass over the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.identify.history import Stretch

Array = NDArray[np.float64]

# A parameter vector (5,) of an axis is log T, c, g, log of the wind's density, log of the noise of a position.
OUTLIER = 5.0  # standard deviations beyond which an innovation counts by its size and not by its square (Huber)
_BIAS_STD_MPS2 = 0.5
_START_STD = (10.0, 2.0, 2.0)  # of position, velocity and acceleration where a stretch begins
_ORDER, _HALVINGS = 10, 6
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True, eq=False)
class Timeline:
    """An axis' stretch cut where the input changes or a position was captured.

    Attributes:
        lengths_s: (n,) of the parts [s].
        inputs_mps2: (n,), held in each [m/s²].
        measured_m: (n,), position at the end of each; NaN where there is none [m].
    """

    lengths_s: Array
    inputs_mps2: Array
    measured_m: Array


@dataclass(frozen=True, eq=False)
class Filtered:
    """What the filter made of a timeline.

    Attributes:
        states: (n, 4): p, v, a, b at the end of each part, with the position there.
        innovations_m: (m,): position minus what was predicted of it, in the order of capture [m].
        stds_m: (m,), standard deviation that the filter gives each [m].
    """

    states: Array
    innovations_m: Array
    stds_m: Array


def timeline(stretch: Stretch, axis: int, dead_time_s: float) -> Timeline:
    """Cut a stretch for one axis, its inputs acting `dead_time_s` after they were sent."""
    changes_s = stretch.input_times_s + dead_time_s
    begin = stretch.times_s[0]
    cuts = np.unique(
        np.concatenate([changes_s[(changes_s > begin) & (changes_s < stretch.times_s[-1])], stretch.times_s])
    )
    held = np.clip(np.searchsorted(changes_s, cuts[:-1], side="right") - 1, 0, None)
    measured = np.full(len(cuts), np.nan)
    measured[np.searchsorted(cuts, stretch.times_s)] = stretch.positions_m[:, axis]
    lengths = np.concatenate([[0.0], np.diff(cuts)])
    inputs = np.concatenate([[0.0], stretch.inputs_mps2[held, axis]])
    return Timeline(lengths, inputs, measured)


def deviance(parts: Sequence[Timeline], parameters: Array) -> Array:
    """-2 log likelihood of all parts of an axis, up to a constant, for each of k parameter vectors (k, 5)."""
    total = np.zeros(len(parameters))
    for part in parts:
        total += _pass(part, parameters)[0]
    return total


def filtered(part: Timeline, parameters: Array) -> Filtered:
    """States and innovations of one part under one parameter vector (5,)."""
    _, states, innovations, variances = _pass(part, parameters[None])
    return Filtered(states[:, 0], innovations[:, 0], np.sqrt(variances[:, 0]))


def transition(lengths_s: Array, parameters: Array) -> tuple[Array, Array]:
    """Transition (n, k, 4, 4) of p, v, a, b, and effect (n, k, 4) of a held input, over n lengths for k parameters."""
    generator = np.zeros((len(parameters), 5, 5))
    lag_s = np.exp(parameters[:, 0])
    generator[:, 0, 1] = 1.0
    generator[:, 1, 1] = -parameters[:, 1]
    generator[:, 1, 2] = generator[:, 1, 3] = 1.0
    generator[:, 2, 2] = -1.0 / lag_s
    generator[:, 2, 4] = parameters[:, 2] / lag_s
    different_s, which = np.unique(lengths_s, return_inverse=True)  # few: ticks are equally long
    scaled = different_s[:, None, None, None] * generator / 2**_HALVINGS
    term = np.broadcast_to(np.eye(5), scaled.shape)
    power = term.copy()
    for order in range(1, _ORDER + 1):
        term = term @ scaled / order
        power += term
    for _ in range(_HALVINGS):
        power = power @ power
    return power[which, :, :4, :4], power[which, :, :4, 4]


def disturbance(lengths_s: Array, parameters: Array) -> Array:
    """Covariance (n, k, 2, 2) of p and v that white acceleration noise makes in n lengths, for k parameters."""
    drag = parameters[:, 1]
    ago_s = lengths_s[:, None] * (1.0 + _GAUSS_X) / 2.0  # (n, points)
    fall = np.exp(-drag[:, None] * ago_s[:, None, :])  # velocity that is left of a kick, (n, k, points)
    ratio = drag[:, None] * ago_s[:, None, :]
    way = ago_s[:, None, :] * np.where(np.abs(ratio) < 1e-6, 1.0, -np.expm1(-ratio) / np.where(ratio == 0, 1, ratio))
    kicks = np.stack([way, fall], axis=-1)
    weights = lengths_s[:, None, None] * _GAUSS_W / 2.0 * np.exp(2.0 * parameters[:, 3])[:, None]
    return np.asarray(np.einsum("nkg,nkgi,nkgj->nkij", weights, kicks, kicks))


def _pass(part: Timeline, parameters: Array) -> tuple[Array, Array, Array, Array]:
    """Deviance (k,), states (n, k, 4), innovations and their variances (m, k)."""
    move, push = transition(part.lengths_s, parameters)
    noise = disturbance(part.lengths_s, parameters)
    seen_var = np.exp(2.0 * parameters[:, 4])
    count = len(parameters)
    state = np.zeros((count, 4))
    state[:, 0] = part.measured_m[0]
    cov = np.tile(np.diag(np.square([*_START_STD, _BIAS_STD_MPS2])), (count, 1, 1))
    total = np.zeros(count)
    states, innovations, variances = [], [], []
    for index, (length, pushed, measured) in enumerate(
        zip(part.lengths_s, part.inputs_mps2, part.measured_m, strict=True)
    ):
        if length > 0.0:
            state = (move[index] @ state[:, :, None])[:, :, 0] + push[index] * pushed
            cov = move[index] @ cov @ move[index].transpose(0, 2, 1)
            cov[:, :2, :2] += noise[index]
        if np.isfinite(measured):
            variance = cov[:, 0, 0] + seen_var
            innovation = measured - state[:, 0]
            size = np.abs(innovation) / np.sqrt(variance)
            trust = OUTLIER / np.maximum(size, OUTLIER)
            total += np.where(size < OUTLIER, size**2, OUTLIER * (2.0 * size - OUTLIER)) + np.log(variance)
            gain = cov[:, :, 0] / variance[:, None]
            state = state + gain * (trust * innovation)[:, None]
            cov = cov - gain[:, :, None] * cov[:, None, 0, :]
            innovations.append(innovation)
            variances.append(variance)
        states.append(state)
    return total, np.array(states), np.array(innovations), np.array(variances)
