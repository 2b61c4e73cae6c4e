"""One benchmark, from a design to its figures."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.bench.frozen_qp import time_frozen_qp
from uavctl.bench.growth import growth_with_axes, growth_with_horizon
from uavctl.bench.in_flight import InFlight
from uavctl.bench.result import BenchResult, ConditionedTimes, Memory, Quantiles, Shares
from uavctl.bench.states import draw_states
from uavctl.bench.timing import EXACT, FROZEN, MIXTURE, Case, Timed, clock_us, median, timed
from uavctl.data import SolveStatus
from uavctl.smpc.answer import Answer
from uavctl.smpc.components import decompose
from uavctl.smpc.conditioned import ConditionedSolver
from uavctl.smpc.conic import ConicSolver
from uavctl.smpc.design import Design
from uavctl.smpc.library import Library, make_library
from uavctl.smpc.library_solver import LibrarySolver
from uavctl.smpc.printed import SOLVERS_OWN, PrintedSolver

Array = NDArray[np.float64]

# Told what is being done, how much of it is done, and of how much; None where nobody knows.
Advance = Callable[[str, int, int | None], None]

_MEGABYTE = 1e6


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        states: Asked of the library; the others are asked the first of them.
        printed: Asked of the joint problem as printed; it ends badly, and a few say so.
        cvxpy: Asked of the printed problem axis by axis.
        exact: Asked of the exact program.
        runs: Of the library and of the exact program over their states; a state's time is the median.
        horizons: H of the growth with the horizon.
        policies: In each of its libraries.
        growth_states: States of each measurement of growth.
        axes: Most axes of the growth with axes.
    """

    states: int = 1000
    printed: int = 3
    cvxpy: int = 20
    exact: int = 50
    runs: int = 5
    horizons: tuple[int, ...] = (8, 12, 16, 24, 32, 40)
    policies: int = 6
    growth_states: int = 300
    axes: int = 6


DEFAULT_SIZES = Sizes()


def run_bench(
    design: Design,
    loss: float,
    seed: int,
    advance: Advance,
    sizes: Sizes = DEFAULT_SIZES,
    conditioned: ConditionedSolver | None = None,
) -> BenchResult:
    """Measure everything on the same states.

    Args:
        design: What is decided.
        loss: Probability that a step of a closed loop brings no news.
        seed: Of states and policies.
        advance: Told of the progress.
        sizes: How much is measured.
        conditioned: Solver of scheme `age-conditioned` for the same plant; None: it is left out.

    Raises:
        UavctlError: No state is feasible.
        DesignError: The design has no library.
    """
    begin = time.perf_counter()
    memory = [_peak_mb()]
    library, library_s = _library(design, seed, advance)
    start = time.perf_counter()
    solver = LibrarySolver(design, library)
    ready_s = time.perf_counter() - start
    memory.append(_peak_mb())

    def phase(what: str, total: int) -> Callable[[int], None]:
        advance(what, 0, total)
        return lambda done: advance(what, done, total)

    states = draw_states(design, solver, sizes.states, loss, seed, phase("states", sizes.states))
    points, target = states.points, design.target
    count = len(points)
    compared = [
        Case(solver, points, target),
        Case(ConicSolver(design), points[: sizes.exact], target),
        Case(PrintedSolver(design), points[: sizes.cvxpy], target, once=True),
    ]
    if conditioned is not None:
        compared.append(Case(InFlight(conditioned), points, target))
    asked = sum(len(case.asked(run, sizes.runs)) for case in compared for run in range(sizes.runs))
    by_library, exact, axes, *ours = timed(compared, sizes.runs, phase("all methods in turns", asked))
    few = points[: sizes.printed]
    whole = Case(PrintedSolver(design, joint=True, regularization=SOLVERS_OWN), few, target)
    (joint,) = timed([whole], 1, phase("printed, jointly", len(few)))
    qp = time_frozen_qp(design, decompose(design)[0], library.variants[0][0], points[: sizes.growth_states], sizes.runs)
    growth_axes = growth_with_axes(
        design, library, points[: sizes.growth_states], sizes.axes, sizes.runs, _each(phase("more axes", sizes.axes))
    )
    told = _each(phase("longer horizons", len(sizes.horizons)))
    growth_h = growth_with_horizon(design, sizes.horizons, sizes.policies, sizes.growth_states, sizes.runs, seed, told)
    memory.append(_peak_mb())

    components = len(decompose(design))
    library_us, gaps = Quantiles.of(by_library.us), np.array([answer.gap for answer in by_library.answers])
    exact_ms, axes_ms, joint_ms = (float(np.median(found.us)) / 1e3 for found in (exact, axes, joint))
    endings = [answer.status for answer in joint.answers]
    parts = [part for variant in library.variants for part in variant]
    return BenchResult(
        states=count,
        components=components,
        feasible_share=states.feasible_share,
        printed_ms=joint_ms,
        printed_status=", ".join(sorted(set(endings))),
        printed_optimal=endings.count(SolveStatus.OPTIMAL),
        printed_states=len(endings),
        cvxpy_axis_ms=axes_ms / components,
        cvxpy_ms=axes_ms,
        cvxpy_states=len(axes.answers),
        exact_axis_ms=exact_ms / components,
        exact_ms=exact_ms,
        exact_states=len(exact.answers),
        library_us=library_us,
        frozen_us=median(by_library.of(FROZEN)),
        mixture_us=median(by_library.of(MIXTURE)),
        fallback_us=median(by_library.of(EXACT)),
        ratio_printed_library=joint_ms * 1e3 / library_us.p50,
        ratio_cvxpy_library=axes_ms * 1e3 / library_us.p50,
        ratio_exact_library=exact_ms * 1e3 / library_us.p50,
        conditioned=_conditioned(ours[0], axes_ms) if ours else None,
        shares=_shares(by_library),
        gap=Quantiles.of(gaps),
        certificate_excess=_excess(by_library.answers, exact.answers),
        cost_difference=None if design.estimate_cov.any() else _cost_difference(axes.answers, exact.answers),
        library_s=library_s,
        library_policies=[len(part.level) for part in parts],
        library_bytes=sum(part.theta.nbytes + part.level.nbytes + part.slope.nbytes for part in parts),
        ready_s=ready_s,
        memory_mb=Memory(before=memory[0], library=memory[1], after=memory[2]),
        growth_h=growth_h,
        growth_axes=growth_axes,
        qp_us=qp,
        clock_us=clock_us(),
        wall_s=time.perf_counter() - begin,
    )


def _conditioned(found: Timed, axes_ms: float) -> ConditionedTimes:
    us = Quantiles.of(found.us)
    return ConditionedTimes(
        us=us,
        iterations=Quantiles.of(np.array([answer.iterations for answer in found.answers])),
        left_alone=sum(answer.iterations == 0 for answer in found.answers) / len(found.answers),
        ratio_cvxpy=axes_ms * 1e3 / us.p50,
    )


def _library(design: Design, seed: int, advance: Advance) -> tuple[Library, float]:
    """The library, made anew, and the time that it took [s]."""
    advance("making the library", 0, None)
    start = time.perf_counter()
    library = make_library(
        design, seed, lambda name, policies, _: advance(f"making the library, {name}", policies, None)
    )
    return library, time.perf_counter() - start


def _each(told: Callable[[int], None]) -> Callable[[], None]:
    """Counts calls."""
    done = 0

    def one() -> None:
        nonlocal done
        done += 1
        told(done)

    return one


def _peak_mb() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / _MEGABYTE if sys.platform == "darwin" else peak * 1024 / _MEGABYTE


def _shares(found: Timed) -> Shares:
    methods = [answer.method for answer in found.answers]
    frozen, mixture, exact = (methods.count(method) / len(methods) for method in (FROZEN, MIXTURE, EXACT))
    return Shares(frozen=frozen, mixture=mixture, exact=exact)


def _excess(certified: Sequence[Answer], exact: Sequence[Answer]) -> float:
    """How far exact optima are outside the certified bounds, relative; an optimum is known up to its own gap."""
    most = 0.0
    for ours, theirs in zip(certified, exact, strict=False):  # the exact program is asked fewer
        beyond = max(ours.cost_lower - theirs.cost, theirs.cost_lower - ours.cost)
        most = max(most, beyond / max(1.0, abs(theirs.cost)))
    return most


def _cost_difference(printed: Sequence[Answer], exact: Sequence[Answer]) -> float | None:
    """Of the states that the printed problem can be solved from; None without any."""
    pairs = [(one.cost, other.cost) for one, other in zip(printed, exact, strict=False) if np.isfinite(one.cost)]
    return max((abs(one / other - 1.0) for one, other in pairs), default=None)
