"""How strong errors are, from slow to quick, beside what was foretold: what too large a foretold noise can explain.

A filter that is told larger noises than there are foretells a covariance C of all positions together that is at least
the true one. Its errors over their deviations, z = L⁻¹ (position − forecast) with C = L Lᵀ, then have a covariance of
at most the identity: in no direction are they stronger than foretold. They need not be white, as the filter weighs
positions otherwise than the true noises would have it. Where errors are stronger, caution cannot be why.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from logs.design_view import Floats
from logs.statistics import LEVEL

BANDS = 4  # of frequencies, equally wide: of 30 errors each still has seven


def band_powers(normalised: Floats) -> tuple[Floats, Floats]:
    """Mean squares of errors by frequency, from slow to quick, and how many independent squares each is the mean of.

    Each is about 1 where errors are white and as large as foretold; sums of squares of `count` coordinates in an
    orthonormal basis, so for errors whose covariance is at most the identity none is larger than χ² is.

    Args:
        normalised: Errors over their foretold deviations (n,), n ≥ 2 `BANDS`.

    Returns:
        Powers (`BANDS`,) and counts (`BANDS`,).
    """
    n = len(normalised)
    squares = np.abs(np.fft.rfft(normalised)) ** 2 / n
    pairs = np.full(len(squares), 2.0)  # a sine and a cosine; of the slowest and the quickest wave there is one alone
    pairs[0] = 1.0
    if n % 2 == 0:
        pairs[-1] = 1.0
    cuts = np.round(np.linspace(0.0, len(squares), BANDS + 1)).astype(np.int64)
    counts = np.add.reduceat(pairs, cuts[:-1])
    return np.asarray(np.add.reduceat(pairs * squares, cuts[:-1]) / counts), np.asarray(counts)


def power_bounds(counts: Floats, tests: int) -> Floats:
    """What powers (`BANDS`,) stay below, all of `tests` together with `LEVEL`, if errors are as foretold or smaller."""
    return np.asarray(chdtri(counts, (1.0 - LEVEL) / tests) / counts)
