"""Answer of a solver of the decision problem, and the protocol that solvers share."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Protocol

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.records import GaveWay, SolveStatus
from uavctl.smpc.braking import Braking

# Largest violation of a hard limit by a mean input that is clipped [input units]; with more it is no optimum.
INPUT_TOLERANCE = 1e-6

# Largest violation of a constraint that counts as kept, in its own unit or summed over a plan.
KEPT_TOLERANCE = 1e-6


CERTIFICATE_LEVEL = 0  # level of the budgets of the risk that holds on any link
CONFIGURED_LEVEL = -1  # level of the budgets of the risk that is made for the configured link


class QuestionError(ValueError):
    """A question that cannot be answered: its age or its covariance cannot be."""


class Path(msgspec.Struct, frozen=True, eq=False):
    """A trajectory to follow, as deviations from the target."""

    states: Array  # (H, n_x): desired state of stage t minus the target
    inputs: Array  # (H, n_u): desired input of stage t minus the target's


class Preview(msgspec.Struct, frozen=True, eq=False):
    """Preview of the steps of one plan: limits, path, age of the position, covariance."""

    # Right sides of the state rows in each stage (H+1, m_x); None: those of the design. The reference keeps those of
    # the last τ + 1 stages.
    limits: Array | None = None
    path: Path | None = None  # trajectory to follow; None: stay at the target
    age: int = 0  # age of the position that the state was predicted from [steps]
    # Covariance of the state estimate's error (n_x, n_x), or of states and input biases (n_x + n_u, n_x + n_u) if the
    # solver counts on biases; None: the estimate is exact. A design with its own covariance uses that.
    cov: Array | None = None
    # Input (n_u,) that acts until the plan begins, biases included; None: unknown
    sent: Array | None = None
    # Smallest and largest inputs (n_u,), biases included, where the vehicle can do less than the design assumes;
    # None: it can do all of that
    input_bounds: tuple[Array, Array] | None = None

    sent_mps2: Array | None = None  # acceleration setpoint that acts until then (n_axes,), without biases
    braking: Braking | None = None  # braking of the fallback, for a controller that nothing keeps from the limits

    level: int = CONFIGURED_LEVEL  # level of the budgets of the risk by age
    widening: float = 1.0  # factor of all standard deviations of the rows
    silence_widening: float = 1.0  # further factor of those of information H steps old

    # Right sides of the state rows (m_x,) where the plan rests: those of a moving cell's last box; None: the tightest
    # ones of all stages, and no moving cell
    resting_limits: Array | None = None

    @property
    def nominal(self) -> bool:
        """Whether the preview adds nothing to the design."""
        return self.limits is None and self.path is None and not self.age


NOMINAL = Preview()


def is_finite(x: Array, target: Array, preview: Preview) -> bool:
    """Return whether all numbers of a question are finite."""
    arrays = [x, target]
    for values in (preview.cov, preview.limits, preview.resting_limits, preview.sent, *(preview.input_bounds or ())):
        if values is not None:
            arrays.append(values)
    if preview.path is not None:
        arrays += [preview.path.states, preview.path.inputs]
    return are_finite(arrays)


def are_finite(arrays: Iterable[Array]) -> bool:
    """Return whether all numbers of all arrays are finite."""
    # A finite sum of squares proves it in one product; an infinite one may be an overflow.
    return all(math.isfinite(np.vdot(values, values)) or bool(np.isfinite(values).all()) for values in arrays)


class Answer(msgspec.Struct, frozen=True, eq=False):
    """Optimal plan from one state, for the whole plant; one row a step Δt."""

    seq: int  # number of the question
    status: SolveStatus  # how the solve ended; only OPTIMAL may fly
    method: str  # name of the program that answered
    inputs: Array  # mean inputs v_t (H, n_u), within the hard limits, in the plant's input units
    states: Array  # predicted mean states (H+1, n_x) under `inputs`
    backoff_x: Array  # back-off of each row of the state set (H+1, m_x), in the row's unit
    backoff_u: Array  # back-off of each row of the input set (H, m_u), in the row's unit
    reference: Array  # equilibrium x_s (n_x,) that the plan ends in
    slack: float  # sum of all slacks of the state constraints
    offset: float  # l1 distance of the reference from the target, in equilibrium coordinates
    terminal_miss: float  # l1 violation of the terminal equality and of the terminal limits
    cost: float  # objective: cost (18) and all penalties
    # Dual objective, a lower bound of the optimal cost up to the solver's tolerance; -inf if there is none
    cost_lower: float
    gap: float  # (cost - cost_lower) / |cost|, see `relative_gap`; inf if no lower bound is known
    iterations: int  # iterations of the solver, summed over all programs
    relaxed: tuple[GaveWay, ...] = ()  # constraints that the plan does not keep, and by how much
    fault: str = ""  # reason not to use the solver again; empty if there is none

    def __repr__(self) -> str:
        """Return two lines: how it ended, and where it begins."""
        if not self.inputs.size:
            return f"no plan: {self.status.value}, method {self.method}"
        relaxed_text = f", {len(self.relaxed)} limits relaxed" if self.relaxed else ""
        begins = ", ".join(f"{value:.4g}" for value in self.inputs[0])
        head = f"plan of {len(self.inputs)} steps: {self.status.value}, cost {self.cost:.6g}, method {self.method}"
        return f"{head}{relaxed_text}\n  first input: {begins}"

    @classmethod
    def failed(cls, seq: int, status: SolveStatus, method: str, iterations: int = 0, fault: str = "") -> Answer:
        """Return an answer without a plan: empty arrays, infinite cost.

        Args:
            iterations: Interior-point iterations spent.
            fault: Reason not to use the solver again.
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


def clip_inputs(inputs: Array, c: Array, b: Array) -> tuple[Array, bool]:
    """Clip inputs (H, n_u) to c u <= b: a row of one entry exactly, others along the row.

    Returns:
        The inputs, and whether they were within INPUT_TOLERANCE of the limits before.
    """
    # u <- u - max(c_i u - b_i, 0) c_i / |c_i|²
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


# Smaller costs are rounding: those of a plant without disturbance, at rest in its target.
MIN_COST = 1e-6


def relative_gap(cost: float, cost_lower: float) -> float:
    """Return (cost - cost_lower) / |cost|; a smaller |cost| counts as MIN_COST."""
    return (cost - cost_lower) / max(MIN_COST, abs(cost))


class Solver(Protocol):
    """Interface of a solver of the decision problem."""

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """Plan from state `x` (n_x,) to the equilibrium `target` (n_x,); numbers that are not finite get no plan.

        With an `preview.age` of j, `x` is the prediction for now from a position j steps old.

        Raises:
            QuestionError: The question cannot be answered.
        """
        ...
