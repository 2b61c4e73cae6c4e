"""What a benchmark found; one document, all of one run."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray


class Quantiles(msgspec.Struct, frozen=True, kw_only=True):
    """Of a figure over the states."""

    p50: float
    p99: float
    max: float

    @staticmethod
    def of(values: NDArray[np.float64]) -> Quantiles:
        """Of values (n,)."""
        p50, p99, most = np.quantile(values, [0.5, 0.99, 1.0]).tolist()
        return Quantiles(p50=p50, p99=p99, max=most)


class Shares(msgspec.Struct, frozen=True, kw_only=True):
    """Shares of the states that were answered by each method of the library; a plan is named by its slowest axis."""

    frozen: float
    mixture: float
    exact: float


class HorizonGrowth(msgspec.Struct, frozen=True, kw_only=True):
    """One axis' decision over the horizon, under a library of a few policies; null where no state was answered so."""

    horizon: list[int]
    gains: list[int]  # entries of M
    frozen_us: list[float | None]
    mixture_us: list[float | None]
    frozen_exponent: float | None  # slope of log time over log H, by least squares
    mixture_exponent: float | None
    mixture_exponent_last: float | None  # the same over the three longest horizons


class AxesGrowth(msgspec.Struct, frozen=True, kw_only=True):
    """Decision over the number of identical axes; null where no state was answered so."""

    axes: list[int]
    frozen_us: list[float | None]  # every axis frozen
    mixture_us: list[float | None]  # every axis a mixture
    frozen_exponent: float | None
    mixture_exponent: float | None


class QpTimes(msgspec.Struct, frozen=True, kw_only=True):
    """Medians of the frozen policy's QP of one axis, the same matrices in two solvers."""

    daqp: float
    clarabel: float
    variables: int
    rows: int
    cost_difference: float  # largest relative difference of the two optima


class ConditionedTimes(msgspec.Struct, frozen=True, kw_only=True):
    """Decision of scheme `age-conditioned` for all axes, each with a covariance of its own and a setpoint sent last."""

    us: Quantiles
    iterations: Quantiles  # of all its programs together
    left_alone: float  # share of the states from which the regulator's own plan keeps everything
    ratio_cvxpy: float  # the problem as printed, axis by axis, in the same run


class Memory(msgspec.Struct, frozen=True, kw_only=True):
    """Peak resident set of the process [MB]."""

    before: float
    library: float  # with the library made and ready
    after: float


class BenchResult(msgspec.Struct, frozen=True, kw_only=True):
    """Medians over the states and ratios of them; a time is of a decision for all axes unless it says otherwise."""

    states: int
    components: int  # independent axes
    feasible_share: float  # of the box
    printed_ms: float  # the joint problem as printed, CVXPY
    printed_status: str  # how that ended; several endings are joined by commas
    printed_optimal: int  # how many of printed_states were solved
    printed_states: int
    cvxpy_axis_ms: float  # as printed, one axis, CVXPY with the problem compiled once
    cvxpy_ms: float
    cvxpy_states: int
    exact_axis_ms: float  # one axis
    exact_ms: float
    exact_states: int
    library_us: Quantiles
    frozen_us: float | None  # median where the frozen policies answered
    mixture_us: float | None
    fallback_us: float | None  # median where the library asked the exact program
    ratio_printed_library: float  # as printed, jointly
    ratio_cvxpy_library: float  # as printed, axis by axis
    ratio_exact_library: float
    conditioned: ConditionedTimes | None  # null: silence outlasts the horizon too often for it
    shares: Shares
    gap: Quantiles  # certified
    certificate_excess: float  # most by which an exact optimum is outside the certified bounds, relative; 0: never
    cost_difference: float | None  # largest relative difference of printed and exact optima; null: not the same problem
    library_s: float  # time to make the library
    library_policies: list[int]  # of each component, fresh and late
    library_bytes: int
    ready_s: float  # from the library to a solver
    memory_mb: Memory
    growth_h: HorizonGrowth
    growth_axes: AxesGrowth
    qp_us: QpTimes
    clock_us: float  # an empty measurement, which all times contain
    wall_s: float
