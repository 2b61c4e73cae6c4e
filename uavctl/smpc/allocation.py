"""How a plan spreads the risk of an age over its rows: iterative risk allocation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from uavctl.smpc.age_risk import LARGEST_RISK

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_KEEPS = 0.5  # of the room between a row that does not bind and its back-off: what it keeps
_AWAY = -float(ndtri(1e-6))  # deviations beyond which a row that does not bind keeps no more
DISTANT = 0.1  # of a budget: what rows share, before there is a plan, that the regulator's is not near
_BINDS = 1e-9  # of a row's standard deviation: nearer than this to its back-off, it binds


def quantile(risk: Array) -> Array:
    """Standard deviations that leave a risk on one side; none where it is above LARGEST_RISK."""
    return np.asarray(-ndtri(np.minimum(risk, LARGEST_RISK)))


def spent(room: Array, sigma: Array) -> Array:
    """Probability that a row is left whose mean keeps that room; all of the same shape."""
    if np.count_nonzero(sigma) == sigma.size:
        return np.asarray(ndtr(room / -sigma))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(sigma > 0.0, ndtr(-room / sigma), np.where(room < 0.0, 1.0, 0.0))


def binding(backoff: Array, room: Array, sigma: Array) -> Flags:
    """Which rows are at their back-offs, or beyond."""
    return np.asarray(room <= backoff + _BINDS * sigma)


def shifted(
    backoff: Array, room: Array, sigma: Array, budgets: Array, binds: Flags, away: Array | float = _AWAY
) -> Array:
    """Back-offs after risk has gone from the rows that do not bind to those that do, in stages where some do.

    What does not bind keeps half of its room, so the plan at hand keeps all of them.

    Args:
        backoff: Back-offs so far (S, m) of some stages.
        room: Room that the plan at hand leaves (S, m).
        sigma: Standard deviations (S, m).
        budgets: ε̄ of the stages (S,); where it is infinite there are no back-offs.
        binds: Which rows bind (S, m).
        away: Standard deviations (S, 1) beyond which a row that does not bind keeps no more.
    """
    kept = room - backoff
    np.maximum(kept, 0.0, out=kept)
    kept *= _KEEPS
    kept += backoff
    np.minimum(kept, np.maximum(backoff, away * sigma), out=kept)
    kept *= np.isfinite(budgets)[:, None]
    risk = spent(kept, sigma)
    risk *= ~binds
    count = np.add.reduce(binds, axis=1)
    left = budgets - np.add.reduce(risk, axis=1)
    share = quantile(left / np.maximum(count, 1))
    np.copyto(kept, share[:, None] * sigma, where=binds)
    return kept if np.count_nonzero(count) == count.size else np.where(count[:, None] > 0, kept, backoff)
