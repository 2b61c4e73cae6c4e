"""How a decision's time grows with the horizon and with the number of axes.

Both start from the first independent component of a design, so that nothing but the size changes.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import clarabel
import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import block_diag

from uavctl.smpc.answer import Answer, Solver
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.horizon import Component, decompose, horizon_of
from uavctl.smpc.hahn_stursberg.library import Library, LibrarySolver, PartLibrary, Region
from uavctl.smpc.hahn_stursberg.mean import MeanProblem
from uavctl.smpc.hahn_stursberg.policies import PolicyProgram
from uavctl.smpc.hahn_stursberg.schedule import Schedule
from uavctl.smpc.hahn_stursberg.terminal import make_terminal
from uavctl.smpc.plant import Plant, steps_to_reach
from uavctl.smpc.qp import EQUAL, OPEN, SOFT, QuadraticProgram
from uavctl.smpc.sets import Polytope

# What a benchmark found; one document, all of one run.


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


# Times of decisions: warmed up, without garbage collection, several runs of the same states.


Array = NDArray[np.float64]

# How a library's answer names its method.
FROZEN, MIXTURE, EXACT = "frozen", "mixture", "exact"

_EMPTY = 1000
_WARM = 5


@dataclass(frozen=True, eq=False)
class Timed:
    """Times and answers, one a state."""

    us: Array  # median over the runs (n,) [µs]
    answers: tuple[Answer, ...]  # the last run's

    def of(self, method: str) -> Array:
        """Times of the states that a method answered with a plan."""
        with_plan = [answer.method == method and bool(np.isfinite(answer.cost)) for answer in self.answers]
        times: Array = self.us[np.array(with_plan, dtype=bool)]
        return times


@contextmanager
def quiet() -> Iterator[None]:
    """Without garbage collection, whose pauses belong to nobody's decision."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@dataclass(frozen=True, eq=False)
class Case:
    """What is timed."""

    solver: Solver  # who decides
    points: Sequence[Array]  # from which states (n_x,)
    target: Array  # towards which equilibrium (n_x,)
    once: bool = False  # whether each state is asked in one of the runs only; else in all of them

    def asked(self, run: int, runs: int) -> range:
        """Indices of the states that a run asks."""
        return range(run, len(self.points), runs) if self.once else range(len(self.points))


def timed(cases: Sequence[Case], runs: int, told: Callable[[int], None] = lambda _: None) -> list[Timed]:
    """Time solvers that are compared, run by run in turns: what else the machine does meets all of them alike.

    Args:
        cases: What is timed; a few states of each are asked before.
        runs: How often; a state's time is the median.
        told: Told the number of decisions done, after each.
    """
    for case in cases:
        for x in case.points[:_WARM]:
            case.solver.solve(0, x, case.target)
    us = [np.full((runs, len(case.points)), np.nan) for case in cases]
    answers: list[dict[int, Answer]] = [{} for _ in cases]
    done = 0
    with quiet():
        for run in range(runs):
            gc.collect()
            for i, case in enumerate(cases):
                for j in case.asked(run, runs):
                    x = case.points[j]
                    start = time.perf_counter()
                    answer = case.solver.solve(0, x, case.target)
                    us[i][run, j] = (time.perf_counter() - start) * 1e6
                    answers[i][j] = answer
                    done += 1
                    told(done)
    return [
        Timed(np.nanmedian(times, axis=0), tuple(found[j] for j in range(len(found))))
        for times, found in zip(us, answers, strict=True)
    ]


def clock_us() -> float:
    """Median of an empty measurement [µs]."""
    us = np.zeros(_EMPTY)
    for i in range(_EMPTY):
        start = time.perf_counter()
        us[i] = (time.perf_counter() - start) * 1e6
    return float(np.median(us))


def median(times: Array) -> float | None:
    """Median, None of nothing."""
    return float(np.median(times)) if times.size else None


def exponent(sizes: Sequence[int], times: Sequence[float | None]) -> float | None:
    """Slope of log time over log size by least squares; None for fewer than two times."""
    known = [(size, us) for size, us in zip(sizes, times, strict=True) if us is not None]
    if len(known) < 2:
        return None
    x, y = np.log(np.array(known)).T
    return float(np.polyfit(x, y, 1)[0])


# The QP of a frozen policy, one axis, in two solvers: DAQP, which flies, and Clarabel.


_TOLERANCE = 1e-9


class FrozenProgram:
    """The mean QP of a component under the first policy of its library.

    Attributes:
        daqp: It in DAQP.
        clarabel: It in Clarabel.
        variables: Their number, without slacks.
        rows: Their number, two-sided.
    """

    def __init__(self, design: Design, component: Component, library: PartLibrary) -> None:
        problem = MeanProblem(design, horizon_of(design, component))
        policy = library.policies(problem)[0]
        self._problem, self._part = problem, component
        self.rows, self.variables = problem.a.shape
        self._backoff = problem.backoff.copy()
        self._backoff[problem.links] = policy.backoff
        self._soft = np.isfinite(problem.price)
        # Rows whose room the policy takes whole.
        self._pins = problem.links[(policy.slope > 0.0) & ~self._soft[problem.links]]
        self._price = np.where(self._soft, problem.price, 0.0)
        sense = np.where(self._soft, SOFT, 0).astype(np.int32)
        sense[self._pins] = EQUAL
        self.daqp = QuadraticProgram(problem.h, problem.a, sense, self._price, problem.curve)
        self.clarabel = ClarabelProgram(problem, self._pins)

    def question(self, x: Array, target: Array) -> tuple[Array, Array, Array]:
        """f, upper and lower sides for the whole plant's state and target."""
        question = self._problem.question(x[self._part.states], target[self._part.states])
        upper = np.minimum(question.upper - question.offset - self._backoff, OPEN)
        lower = np.maximum(question.lower - question.offset + self._backoff, -OPEN)
        middle = 0.5 * (upper[self._pins] + lower[self._pins])
        upper[self._pins] = lower[self._pins] = middle
        return question.f, upper, lower

    def cost(self, q: Array, f: Array, upper: Array, lower: Array) -> float:
        """Objective of a mean q, soft rows paid for."""
        problem, value = self._problem, self._problem.a @ q
        beyond = np.maximum(np.maximum(value - upper, lower - value), 0.0)
        quadratic = 0.5 * float(q @ problem.h @ q) + float(f @ q)
        return quadratic + float(self._price @ beyond + problem.curve @ beyond**2)


class ClarabelProgram:
    """The same program with a slack for each soft row; set up once, then only vectors are updated."""

    def __init__(self, problem: MeanProblem, pins: NDArray[np.intp]) -> None:
        (soft,) = np.nonzero(np.isfinite(problem.price))
        free = np.ones(len(problem.rows), dtype=bool)
        free[pins] = False
        self._n_q, self._pins = problem.h.shape[0], pins
        (self._above,) = np.nonzero(free & np.isfinite(problem.upper))
        (self._below,) = np.nonzero(free & np.isfinite(problem.lower))
        give = np.zeros((len(problem.rows), soft.size))
        give[soft, range(soft.size)] = -1.0
        rows = np.block(
            [
                [problem.a[pins], give[pins]],
                [problem.a[self._above], give[self._above]],
                [-problem.a[self._below], give[self._below]],
                [np.zeros((soft.size, self._n_q)), -np.eye(soft.size)],
            ]
        )
        hessian = np.zeros((rows.shape[1], rows.shape[1]))
        hessian[: self._n_q, : self._n_q] = problem.h
        hessian[self._n_q :, self._n_q :] = 2.0 * np.diag(problem.curve[soft])
        self._linear = np.concatenate([np.zeros(self._n_q), problem.price[soft]])
        self._right = np.zeros(rows.shape[0])
        cones: list[clarabel.Cone] = [clarabel.NonnegativeConeT(rows.shape[0] - pins.size)]
        if pins.size:
            cones.insert(0, clarabel.ZeroConeT(pins.size))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_threads = 1
        settings.direct_solve_method = "qdldl"
        settings.presolve_enable = False  # it would change the shape of what update() replaces
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = _TOLERANCE
        p, a = sparse.csc_array(np.triu(hessian)), sparse.csc_array(rows)
        self._solver = clarabel.DefaultSolver(p, self._linear, a, self._right, cones, settings)

    def solve(self, f: Array, upper: Array, lower: Array) -> Array:
        """Minimiser (n_q,)."""
        linear, right = self._linear.copy(), self._right.copy()
        linear[: self._n_q] = f
        sides = np.concatenate([upper[self._pins], upper[self._above], -lower[self._below]])
        right[: sides.size] = sides
        self._solver.update(q=linear, b=right)
        return np.array(self._solver.solve().x[: self._n_q])


def time_frozen_qp(
    design: Design, component: Component, library: PartLibrary, points: Sequence[Array], runs: int
) -> QpTimes:
    """Time both solvers on the questions that states (n_x,) bring, where the QP has an optimum."""
    both = FrozenProgram(design, component, library)
    asked, differences = [], []
    for x in (design.target, *points):
        question = both.question(x, design.target)
        solved = both.daqp.solve(*question)
        if solved is None:
            continue  # the frozen policy leaves this state no plan
        one, other = both.cost(solved[0], *question), both.cost(both.clarabel.solve(*question), *question)
        asked.append(question)
        differences.append(abs(one - other) / max(1.0, abs(one)))
    return QpTimes(
        daqp=_median_us(both.daqp.solve, asked, runs),
        clarabel=_median_us(both.clarabel.solve, asked, runs),
        variables=both.variables,
        rows=both.rows,
        cost_difference=max(differences),
    )


def _median_us(
    solve: Callable[[Array, Array, Array], object], asked: Sequence[tuple[Array, Array, Array]], runs: int
) -> float:
    us = np.zeros((runs, len(asked)))
    with quiet():
        for run in range(runs):
            for i, question in enumerate(asked):
                start = time.perf_counter()
                solve(*question)
                us[run, i] = (time.perf_counter() - start) * 1e6
    return float(np.median(us))


_TRIES_PER_POLICY = 50
_LAST = 3  # horizons that the exponent at the long end is of


def copies(design: Design, component: Component, count: int) -> Design:
    """A design of `count` independent copies of one component; likelihoods and schedule stay the design's.

    Copies have no meaning as axes of space; only `component`'s first position is named.
    """

    def blocks(matrix: Array) -> Array:
        return np.asarray(block_diag(*([matrix] * count)), dtype=np.float64)

    n_u, held = component.b.shape[1], int(component.held[0])
    plant = Plant(
        a=blocks(component.a),
        b=blocks(component.b),
        e=blocks(component.e),
        w=blocks(component.w),
        dt_s=design.plant.dt_s,
        axes=("north",),
        position_index=(held,),
        velocity_index=(held,),
        accel_per_input=np.zeros((1, count * n_u)),
    )
    q_x, q_u = blocks(component.q_x), blocks(component.q_u)
    return replace(
        design,
        plant=plant,
        state_set=Polytope(blocks(component.c_x), np.tile(component.b_x, count)),
        input_set=Polytope(blocks(component.c_u), np.tile(component.b_u, count)),
        q_x=q_x,
        q_u=q_u,
        target=np.tile(design.target[component.states], count),
        terminal=make_terminal(plant, design.terminal.tau, blocks(component.k), q_x, q_u),
        estimate_cov=blocks(component.estimate_cov),
        late=(),
        design_id=f"{design.design_id}, {count} x {component.states.tolist()}",
    )


def lengthened(design: Design, steps: int) -> Design | None:
    """The design over another horizon, None where it is too short for a mean that reaches the target.

    τ stays; every stage has the terminal likelihoods; feedback is τ + 1 steps late, or as early as it takes for one
    stage of a short horizon to feed back at all.
    """
    tau = design.terminal.tau
    free = steps - tau
    if free <= max(1, steps_to_reach(design.plant)):
        return None
    delays = (min(tau + 1, free - 1),) * free + (tau + 1,) * tau
    return replace(
        design,
        horizon=steps,
        schedule=Schedule(delays, np.ones(steps), np.ones(steps + 1), np.ones(steps)),
        kappa_x=np.concatenate([[0.0], np.full(steps, design.kappa_x_terminal)]),
        kappa_u=np.full(steps, design.kappa_u_terminal),
        design_id=f"{design.design_id}, H = {steps}",
    )


def few_policies(design: Design, count: int, rng: np.random.Generator) -> tuple[Library, int] | None:
    """A library of `count` policies for a design of one component, and its number of gains; None if there is none."""
    (component,) = decompose(design)
    problem = MeanProblem(design, horizon_of(design, component))
    program, region = PolicyProgram(problem, design.max_iterations), Region(design, component)
    policies = [program.cheapest()]
    for _ in range(_TRIES_PER_POLICY * count):
        if len(policies) == count:
            break
        found = program.best(problem.question(*region.draw(rng)))
        policies += [found] if found is not None else []
    kept = [policy for policy in policies if policy is not None]
    if len(kept) < len(policies):
        return None
    part = PartLibrary(
        theta=np.array([policy.theta for policy in kept]),
        level=np.array([policy.level for policy in kept]),
        slope=np.array([policy.slope for policy in kept]),
    )
    return Library(design.design_id, ((part,),)), problem.horizon.n_theta


def growth_with_horizon(
    design: Design, horizons: Sequence[int], policies: int, states: int, runs: int, seed: int, told: Callable[[], None]
) -> HorizonGrowth:
    """Time one axis' decision for each horizon that the design can have.

    Args:
        design: The design; its first component is taken.
        told: Told when each horizon is prepared.
    """
    one = copies(design, decompose(design)[0], 1)
    lengths, gains, cases = [], [], []
    for steps in horizons:
        longer, rng = lengthened(one, steps), np.random.default_rng((seed, steps))
        library = None if longer is None else few_policies(longer, policies, rng)
        if longer is not None and library is not None:
            region = Region(longer, decompose(longer)[0])
            points = [region.draw(rng)[0] for _ in range(states)]
            cases.append(Case(LibrarySolver(longer, library[0], exact=False), points, longer.target))
            lengths.append(steps)
            gains.append(library[1])
        told()
    found = timed(cases, runs)
    frozen, mixture = [median(each.of(FROZEN)) for each in found], [median(each.of(MIXTURE)) for each in found]
    return HorizonGrowth(
        horizon=lengths,
        gains=gains,
        frozen_us=frozen,
        mixture_us=mixture,
        frozen_exponent=exponent(lengths, frozen),
        mixture_exponent=exponent(lengths, mixture),
        mixture_exponent_last=exponent(lengths[-_LAST:], mixture[-_LAST:]),
    )


def growth_with_axes(
    design: Design, library: Library, points: Sequence[Array], most: int, runs: int, told: Callable[[], None]
) -> AxesGrowth:
    """Time decisions for 1 … `most` copies of a design's first component, each under the library it has.

    Args:
        points: States (n_x,) of the design; those of its first component are dealt out to the copies, the ones that
            a frozen policy answers apart from those that take a mixture.
        told: Told when each number of copies is prepared.
    """
    component, part = decompose(design)[0], library.variants[0][0]
    pools: dict[str, list[Array]] = {FROZEN: [], MIXTURE: []}
    one = copies(design, component, 1)
    alone = LibrarySolver(one, Library(one.design_id, ((part,),)), exact=False)
    for x in points:
        answer = alone.solve(0, x[component.states], one.target)
        if np.isfinite(answer.cost):
            pools[answer.method].append(x[component.states])
    counts = list(range(1, most + 1))
    cases: dict[str, list[Case]] = {method: [] for method in pools}
    for count in counts:
        several = copies(design, component, count)
        solver = LibrarySolver(several, Library(several.design_id, ((part,) * count,)), exact=False)
        for method, pool in pools.items():
            dealt = [np.concatenate([pool[(i - k) % len(pool)] for k in range(count)]) for i in range(len(pool))]
            cases[method].append(Case(solver, dealt, several.target))
        told()
    found = timed([*cases[FROZEN], *cases[MIXTURE]], runs)
    frozen = [median(each.of(FROZEN)) for each in found[:most]]
    mixture = [median(each.of(MIXTURE)) for each in found[most:]]
    return AxesGrowth(
        axes=counts,
        frozen_us=frozen,
        mixture_us=mixture,
        frozen_exponent=exponent(counts, frozen),
        mixture_exponent=exponent(counts, mixture),
    )
