"""Answer of a solver of the decision problem, and the protocol that solvers share."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uavctl.records import GaveWay, SolveStatus

Array = NDArray[np.float64]

# A mean input may pass a hard limit by this much before it is cut back [input units]; more is not an optimum.
INPUT_TOLERANCE = 1e-6

# Tolerance up to which a constraint counts as kept (each in its own unit, or summed over a plan).
KEPT = 1e-6


@dataclass(frozen=True, eq=False)
class Path:
    """A trajectory to follow, as deviations from the equilibrium that it is followed by."""

    states: Array  # (H, n_x): desired state of stage t minus the target
    inputs: Array  # (H, n_u): desired input of stage t minus the target's


@dataclass(frozen=True, eq=False)
class Preview:
    """Knowledge of the steps of one plan ahead: limits, path, age of the position, covariance."""

    # Right sides of the state rows in each stage (H+1, m_x); None: those of the design. What holds in the last τ + 1
    # stages holds for the reference.
    limits: Array | None = None
    path: Path | None = None  # trajectory to follow; None: stay at the target
    late: int = 0  # age of the position that the state was predicted from [steps]
    # Covariance of the state estimate's error (n_x, n_x), with those of the inputs' biases behind the states if the
    # solver counts on biases (n_x + n_u, n_x + n_u); None: it is exact. A design with its own uses that.
    cov: Array | None = None
    # Input (n_u,) that acts until the plan begins, in the plan's own count; None: nothing is known of it
    sent: Array | None = None
    # Least and largest inputs (n_u,), in the plan's own count, where the vehicle can do less than the design says;
    # None: it can do all of that
    inputs: tuple[Array, Array] | None = None

    @property
    def nominal(self) -> bool:
        """Whether nothing but the design is known."""
        return self.limits is None and self.path is None and not self.late


NOMINAL = Preview()


def finite(x: Array, target: Array, outlook: Preview) -> bool:
    """Whether a question is made of finite numbers."""
    given = [x, target]
    for one in (outlook.cov, outlook.limits, outlook.sent, *(outlook.inputs or ())):
        if one is not None:
            given.append(one)
    if outlook.path is not None:
        given += [outlook.path.states, outlook.path.inputs]
    return all_finite(given)


def all_finite(given: Iterable[Array]) -> bool:
    """Whether arrays are made of finite numbers."""
    # A sum of squares is finite where all of them are, unless it overflows: then each is looked at.
    return all(math.isfinite(np.vdot(values, values)) or bool(np.isfinite(values).all()) for values in given)


@dataclass(frozen=True, eq=False)
class Answer:
    """Optimal plan from one state, for the whole plant; one row a step Δt."""

    seq: int  # number of the question, given back as it came
    status: SolveStatus  # how the solve ended; only OPTIMAL may fly
    method: str  # which program answered
    inputs: Array  # mean inputs v_t (H, n_u), within the hard limits, in the plant's input units
    states: Array  # predicted mean states (H+1, n_x), those that follow from `inputs`
    backoff_x: Array  # back-off of each row of the state set (H+1, m_x), in the row's unit
    backoff_u: Array  # back-off of each row of the input set (H, m_u), in the row's unit
    reference: Array  # equilibrium x_s (n_x,) that the plan ends in
    slack: float  # sum of all slacks of the state constraints
    offset: float  # l1 distance of the reference from the target, in equilibrium coordinates
    terminal_miss: float  # l1 violation of the terminal equality and of the terminal limits
    cost: float  # objective: cost (18) and all penalties
    # Dual objective, a lower bound of the optimal cost up to the solver's tolerance; -inf if the method knows none
    cost_lower: float
    gap: float  # (cost - cost_lower) / |cost|, see `relative_gap`; inf if no lower bound is known
    iterations: int  # iterations of the solver, summed over all programs that were run
    gave_way: tuple[GaveWay, ...] = ()  # which constraints gave way, and by how much
    fault: str = ""  # why the solver is not to be asked again; empty if it may be

    def __repr__(self) -> str:
        """Return two lines: how it ended, and where it begins."""
        if not self.inputs.size:
            return f"no plan: {self.status.value}, method {self.method}"
        gave = f", {len(self.gave_way)} limits gave way" if self.gave_way else ""
        begins = ", ".join(f"{value:.4g}" for value in self.inputs[0])
        return (
            f"plan of {len(self.inputs)} steps: {self.status.value}, cost {self.cost:.6g}, method {self.method}{gave}\n"
            f"  first input: {begins}"
        )

    @classmethod
    def failed(cls, seq: int, status: SolveStatus, method: str, iterations: int = 0, fault: str = "") -> Answer:
        """An answer without a plan: empty arrays, infinite cost.

        Args:
            iterations: Interior-point iterations spent.
            fault: Why the solver is not to be asked again.
        """
        empty = np.zeros((0, 0))
        return cls(
            seq=seq,
            status=status,
            method=method,
            inputs=empty,
            states=empty,
            backoff_x=empty,
            backoff_u=empty,
            reference=np.zeros(0),
            slack=np.inf,
            offset=np.inf,
            terminal_miss=np.inf,
            cost=np.inf,
            cost_lower=-np.inf,
            gap=np.inf,
            iterations=iterations,
            fault=fault,
        )


def inside(inputs: Array, c: Array, b: Array) -> tuple[Array, bool]:
    """Cut inputs (H, n_u) back to c u <= b: a row of one entry exactly, others along the row.

    Returns:
        The inputs, and whether they were within INPUT_TOLERANCE of the limits before.
    """
    cut = inputs.copy()
    for row, side in zip(c, b, strict=True):
        (used,) = np.nonzero(row)
        excess = np.maximum(np.sum(cut * row, axis=1) - side, 0.0)
        cut -= np.outer(excess, row / (row @ row))
        if used.size == 1:
            limit = side / row[used[0]]
            clip = np.minimum if row[used[0]] > 0 else np.maximum
            cut[:, used[0]] = clip(cut[:, used[0]], limit)
    return cut, bool(np.max(np.abs(cut - inputs), initial=0.0) <= INPUT_TOLERANCE)


# Costs below are zero but for rounding: those of a plant without disturbance, at rest in its target.
LEAST_COST = 1e-6


def relative_gap(cost: float, cost_lower: float) -> float:
    """Gap of an answer relative to its cost; a cost below LEAST_COST counts as that."""
    return (cost - cost_lower) / max(LEAST_COST, abs(cost))


class Solver(Protocol):
    """Answers the decision problem of one step."""

    def solve(self, seq: int, x: Array, target: Array, outlook: Preview = NOMINAL) -> Answer:
        """Plan from state `x` (n_x,) towards `target` (n_x,), an equilibrium; never raises on numbers.

        With an `outlook.late` of j, `x` is the prediction for now from a position j steps old.
        """
        ...
