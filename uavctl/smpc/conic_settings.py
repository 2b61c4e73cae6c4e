"""How Clarabel is asked, by whoever asks it directly."""

from __future__ import annotations

import clarabel

# The optimum is to be right to 1e-7. With a smaller gap the linear algebra may run out of digits before the end.
GAP_TOLERANCE = 1e-8
RESIDUAL_TOLERANCE = 1e-8

# A factorisation by blocks pays for long horizons only: at H = 40 it takes a third of the time.
_MANY_ROWS = 900


def conic_settings(max_iterations: int, rows: int) -> clarabel.DefaultSettings:
    """Settings for a program of so many rows: one thread, and no change of the problem's shape."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = max_iterations
    settings.max_threads = 1
    settings.direct_solve_method = "faer" if rows > _MANY_ROWS else "qdldl"
    # Both would change the shape of the data that update() replaces, and of the multipliers.
    settings.presolve_enable = False
    settings.chordal_decomposition_enable = False
    settings.tol_gap_abs = settings.tol_gap_rel = GAP_TOLERANCE
    settings.tol_feas = RESIDUAL_TOLERANCE
    return settings
