"""Problem (19) as printed, in CVXPY: the reference for every faster form.

1. Nothing is reduced: the terminal condition is the full matrix inequality Σ_ξ - Ξ_H ⪰ 0, the gains are matrices, and
   the covariances follow from the recursion (1). The target takes the place of the origin.
2. (19c) has no interior, which limits an interior-point method. With Clarabel's own settings the paper's example
   (τ = 4) ends INACCURATE, one axis up to 1e-6 and both jointly 6e-7 off, and a plant with coupled axes can fail. With
   REGULARIZATION nearly all end OPTIMAL and agree with the reduced form to 1e-8; the joint problem takes ten times as
   long as its axes. An inaccurate answer is reported as such and does not fly.
"""

from __future__ import annotations

import warnings

import cvxpy as cp
import numpy as np

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview, clip_inputs, is_finite
from uavctl.smpc.hahn_stursberg.components import Component, decompose, make_whole_component
from uavctl.smpc.hahn_stursberg.cones import catch_panic
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import PartAnswer, assemble

METHOD = "printed"

# Static regularization of the linear systems: the empty interior of (19c) makes them singular at the optimum. With
# Clarabel's default the joint problem ends inaccurate or fails; with this value it ends optimal, at the same cost.
REGULARIZATION = 1e-6
CLARABEL_REGULARIZATION = 1e-8  # Clarabel's default

_STATUS = {
    cp.OPTIMAL: SolveStatus.OPTIMAL,
    cp.OPTIMAL_INACCURATE: SolveStatus.INACCURATE,
    cp.INFEASIBLE: SolveStatus.INFEASIBLE,
    cp.INFEASIBLE_INACCURATE: SolveStatus.INFEASIBLE,
    cp.USER_LIMIT: SolveStatus.ITERATION_LIMIT,
}


class PrintedProblem:
    """Problem (19) of one component, compiled once with the state as a parameter."""

    def __init__(self, design: Design, component: Component, regularization: float = REGULARIZATION) -> None:
        """Write the problem of `component`; with `make_whole_component(design)` it is the joint problem."""
        self.component, self._design = component, design
        self._regularization = regularization
        part, H, tau = component, design.horizon, design.terminal.tau
        n_x, n_u = part.b.shape
        # A component without disturbances gets one without effect, and no gains.
        is_undisturbed = not part.w.size
        e, w = (np.zeros((n_x, 1)), np.zeros((1, 1))) if is_undisturbed else (part.e, part.w)
        n_w = e.shape[1]
        root_w = _root(w)
        self._x = cp.Parameter(n_x)
        self._x_s = cp.Parameter(n_x)
        self._u_s = cp.Parameter(n_u)

        # (8): u_t = V_t x(k) + Σ_r M_{t,r} w(k+r), r <= t - d_t. x(k) is known, so V_t x(k) is a free vector v_t.
        self._v = cp.Variable((H, n_u))
        self._m = {
            (t, r): cp.Variable((n_u, n_w))
            for t in range(0 if is_undisturbed else H)
            for r in range(max(0, t - design.schedule.delays[t] + 1))
        }

        # (1): means, and the matrices of all disturbances' effects, x_t - x̄_t = G_t w, u_t - v_t = M_t w.
        mean = [self._x]
        effect: list[cp.Expression] = [cp.Constant(np.zeros((n_x, H * n_w)))]
        self._gain: list[cp.Expression] = []
        for t in range(H):
            blocks = [self._m.get((t, r), np.zeros((n_u, n_w))) for r in range(H)]
            self._gain.append(cp.hstack(blocks) @ np.kron(np.eye(H), root_w))
            noise = np.zeros((n_x, H * n_w))
            noise[:, t * n_w : (t + 1) * n_w] = e @ root_w
            mean.append(part.a @ mean[-1] + part.b @ self._v[t])
            effect.append(part.a @ effect[-1] + part.b @ self._gain[-1] + noise)
        self._effect = effect

        # (18), (3): expectations are squares of means and traces of covariances.
        r_x, r_u, r_xi = _root(part.q_x), _root(part.q_u), _root(part.p_xi)
        xi_mean = cp.hstack([mean[t] - self._x_s for t in range(H - tau, H + 1)])
        xi_effect = cp.vstack(effect[H - tau :])
        cost = cp.sum_squares(r_xi @ xi_mean) + cp.sum_squares(r_xi @ xi_effect)
        for t in range(H):
            cost += cp.sum_squares(r_x @ (mean[t] - self._x_s)) + cp.sum_squares(r_x @ effect[t])
            cost += cp.sum_squares(r_u @ (self._v[t] - self._u_s)) + cp.sum_squares(r_u @ self._gain[t])

        # (9a), (9b): the confidence ellipsoid lies in the polytope.
        constraints: list[cp.Constraint] = []
        for t in range(1, H + 1):
            for c, b in zip(part.c_x, part.b_x, strict=True):
                constraints.append(c @ mean[t] + design.kappa_x[t] * cp.norm(c @ effect[t]) <= b)
        for t in range(H):
            for c, b in zip(part.c_u, part.b_u, strict=True):
                constraints.append(c @ self._v[t] + design.kappa_u[t] * cp.norm(c @ self._gain[t]) <= b)

        # (19c): ξ̄_H = 0 (here: at rest in the target), Σ_ξ - Ξ_H ⪰ 0 by its Schur complement; both are 0 undisturbed.
        constraints.append(xi_mean == 0)
        if not is_undisturbed:
            constraints.append(cp.bmat([[part.sigma_xi, xi_effect], [xi_effect.T, np.eye(H * n_w)]]) >> 0)
        self._problem = cp.Problem(cp.Minimize(cost), constraints)

    def solve(self, x: Array, target: Array) -> PartAnswer:
        """Solve for a state (n_x,) and a target (n_x,) of the whole plant."""
        part, design = self.component, self._design
        self._x.value, self._x_s.value = x[part.states], target[part.states]
        self._u_s.value = part.u_eq @ (part.coordinates @ self._x_s.value)
        status, cost, iterations = self._run()
        if status not in (SolveStatus.OPTIMAL, SolveStatus.INACCURATE):
            empty = np.zeros((0, 0))
            return PartAnswer(
                status, iterations, empty, empty, empty, np.zeros(0), np.inf, np.inf, np.inf, np.inf, -np.inf
            )
        inputs, kept = clip_inputs(self._v.value, part.c_u, part.b_u)
        effect = np.array([part.c_x @ g.value for g in self._effect])
        gain = np.array([part.c_u @ m.value for m in self._gain])
        return PartAnswer(
            status=status if kept else SolveStatus.INACCURATE,
            iterations=iterations,
            inputs=inputs,
            backoff_x=design.kappa_x[:, None] * np.linalg.norm(effect, axis=2),
            backoff_u=design.kappa_u[:, None] * np.linalg.norm(gain, axis=2),
            reference=self._x_s.value,
            slack=0.0,
            offset=0.0,
            terminal_miss=0.0,
            cost=cost,
            cost_lower=-np.inf,
        )

    def _run(self) -> tuple[SolveStatus, float, int]:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")  # the status says so
            try:
                value = catch_panic(self._solve)
            except cp.SolverError:
                value = None
        if value is None:
            return SolveStatus.FAILED, np.inf, 0
        status = _STATUS.get(self._problem.status, SolveStatus.FAILED)
        iterations = self._problem.solver_stats.num_iters or 0
        return status, value, int(iterations)

    def _solve(self) -> float:
        value = self._problem.solve(
            solver=cp.CLARABEL,
            max_iter=self._design.max_iterations,
            max_threads=1,
            static_regularization_constant=self._regularization,
        )
        return float(value)


class PrintedSolver:
    """Solves (19) as printed: hard constraints, the mean ends in the target.

    CVXPY returns no dual objective, so nothing is certified: `cost_lower` is -inf and `gap` inf.
    """

    def __init__(self, design: Design, *, joint: bool = False, regularization: float = REGULARIZATION) -> None:
        """Compile the problem of every component, or one joint problem.

        Raises:
            DesignError: The design cannot be decomposed.
        """
        self._design = design
        components = (make_whole_component(design),) if joint else decompose(design)
        self._problems = tuple(PrintedProblem(design, component, regularization) for component in components)

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """Plan from `x` (n_x,) to the equilibrium `target` (n_x,); never raises on numbers.

        The printed problem has no preview: with limits, a path or a late position the answer is FAILED.
        """
        if not is_finite(x, target, preview) or not preview.nominal:
            return Answer.failed(seq, SolveStatus.FAILED, METHOD)
        parts = [(problem.component, problem.solve(x, target)) for problem in self._problems]
        return assemble(self._design, seq, METHOD, x, parts)


def _root(matrix: Array) -> Array:
    """Return the symmetric root of a positive semi-definite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root
