"""Fly the age-conditioned scheme, designed for 30 % independent losses, on other links and disturbances.

The simulation is independent of `uavctl.lab`: own loop, links and disturbances around the planner. Plant and limits are
those of the paper, the target is 1 m from a wall in each axis. It prints, for each cell, the share of steps outside in
the first 200 steps and after them, with its 95 % interval, and the mean cost of a step after them.

With `--before 600` the ages of so many steps before the flight are counted too, and further cells are flown whose link
on the ground is another one.

With `--design 0.6` the scheme is designed for 60 % independent losses, with `--late 2` for positions 2 steps late, and
with `--gust 0.8` for disturbances of which each step keeps 0.8: the gust is a state, estimated from the known states.

    python tools/other_links.py [--axes 2] [--runs 8] [--steps 2200] [--seed 1] [--budgets configured] [--cells AR]
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.answer import Answer, Preview
from uavctl.smpc.conditioned.adaptation import (
    AgeRecord,
    LoopState,
    SpreadState,
    charge_risk,
    compute_outside_risk,
    count_age,
    count_innovation,
)
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.conditioned.reference import CERTIFICATE_LEVEL
from uavctl.smpc.link import RunLengthAges, bernoulli
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

ALLOWED, HORIZON, WALL_M, SETTLED = 0.05, 12, 20.0, 200


@dataclass(frozen=True)
class Cell:
    """A link and a disturbance."""

    name: str
    loss: float = 0.3
    burst: float = 1.0  # mean length of a run of losses; 1: independent losses
    then: tuple[float, float] | None = None  # loss and burst of the second half
    late: int = 0  # steps that every position is late
    before: tuple[float, float] | None = None  # loss and burst before the flight; None: as in its first half
    noise: str = "white"


CELLS = [
    Cell(f"{loss:.0%}, bursts of {burst}" if burst > 1 else f"{loss:.0%}", loss, burst)
    for loss in (0.1, 0.3, 0.6, 0.8)
    for burst in (1, 3, 5, 10, 50)
    if burst == 1 or loss / (1.0 - loss) <= burst
] + [
    Cell("30 % then 60 %", then=(0.6, 1.0)),
    Cell("30 % then bursts of 10", then=(0.3, 10.0)),
    Cell("60 % then 30 %", 0.6, then=(0.3, 1.0)),
    Cell("30 %, 1 step late", late=1),
    Cell("30 %, 2 steps late", late=2),
    Cell("30 %, AR(0.5)", noise="0.5"),
    Cell("30 %, AR(0.8)", noise="0.8"),
    Cell("30 %, t of 3", noise="t"),
    Cell("30 %, twice W", noise="twice"),
]
GROUND_CELLS = [
    Cell(f"30 % on the ground, then {name}", loss, burst, before=(0.3, 1.0))
    for name, loss, burst in (
        ("60 %", 0.6, 1.0),
        ("80 %", 0.8, 1.0),
        ("bursts of 3", 0.3, 3.0),
        ("bursts of 10", 0.3, 10.0),
        ("60 %, bursts of 5", 0.6, 5.0),
    )
]


def _repeat(axes: int, block: list[list[float]]) -> Array:
    return np.asarray(np.kron(np.eye(axes), block), dtype=np.float64)


def make_problem(axes: int) -> ControlProblem:
    """Make the problem of one axis, or of two alike."""
    eye: Array = np.eye(axes)
    plant = Plant(
        a=_repeat(axes, [[1.0, 0.79], [0.0, 0.61]]),
        b=_repeat(axes, [[0.21], [0.39]]),
        e=_repeat(axes, [[0.5], [1.0]]),
        w=0.6 * eye,
        dt_s=1.0,
        axes=("north", "east")[:axes],
        position_index=tuple(range(0, 2 * axes, 2)),
        velocity_index=tuple(range(1, 2 * axes, 2)),
        accel_per_input=np.full(axes, 0.494),
    )
    return ControlProblem(
        plant=plant,
        state_set=Polytope.from_box([-60.0, -8.0] * axes, [WALL_M, 8.0] * axes),
        input_set=Polytope.from_box([-7.5] * axes, [7.5] * axes),
        q_x=np.diag([10.0, 0.1] * axes),
        q_u=0.1 * eye,
        target=np.array([WALL_M - 1.0, 0.0] * axes),
        u_target=np.zeros(axes),
        horizon=HORIZON,
        slack_linear=1e5,
        slack_quadratic=1e3,
    )


def add_gusts(problem: ControlProblem, kept: float) -> ControlProblem:
    """Return the problem whose last states are the disturbances of the step before; each step keeps a share."""
    plant, zeros = problem.plant, np.zeros((problem.plant.n_w, problem.plant.n_x))
    eye: Array = np.eye(plant.n_w)
    gusty = replace(
        plant,
        # w(k) = φ w(k-1) + n(k), Var n = (1 - φ²) W
        a=np.block([[plant.a, kept * plant.e], [zeros, kept * eye]]),
        b=np.vstack([plant.b, np.zeros((plant.n_w, plant.n_u))]),
        e=np.vstack([plant.e, eye]),
        w=(1.0 - kept**2) * plant.w,
    )
    rows = np.pad(problem.state_set.c, ((0, 0), (0, plant.n_w)))
    return replace(
        problem,
        plant=gusty,
        state_set=Polytope(rows, problem.state_set.b),
        q_x=np.pad(problem.q_x, ((0, plant.n_w), (0, plant.n_w))),
        target=np.pad(problem.target, (0, plant.n_w)),
    )


class Knowledge:
    """State and covariance of its error, by positions and velocities that are known exactly.

    Args:
        believed: Plant of the design; its last states may be gusts.
        x: First state, without gusts.
    """

    def __init__(self, believed: Plant, x: Array, gust_cov: Array) -> None:
        self._plant, self._n_known = believed, x.size
        self._noise = believed.e @ believed.w @ believed.e.T
        gusts = believed.n_x - x.size
        self.mean, self.cov = np.pad(x, (0, gusts)), np.zeros_like(self._noise)
        self.cov[x.size :, x.size :] = gust_cov[:gusts, :gusts]

    def predict(self, inputs: Array) -> tuple[Array, Array]:
        """Predict over the steps of some inputs (steps, n_u)."""
        mean, cov, plant = self.mean, self.cov, self._plant
        for u in inputs:
            mean, cov = plant.a @ mean + plant.b @ u, plant.a @ cov @ plant.a.T + self._noise
        return mean, cov

    def learn(self, mean: Array, cov: Array, x: Array) -> None:
        """Learn a state without gusts, where `mean` and `cov` were predicted."""
        n = self._n_known
        # K = P C' (C P C')⁺: one disturbance moves position and velocity, so C P C' is singular
        gain = cov[:, :n] @ np.linalg.pinv(cov[:n, :n], rcond=1e-9, hermitian=True)
        self.mean, self.cov = mean + gain @ (x - mean[:n]), cov - gain @ cov[:n]
        self.mean[:n] = x
        self.cov[np.abs(self.cov) < 1e-12] = 0.0  # rounding


def draw_arrivals(loss: float, burst: float, steps: int, rng: np.random.Generator) -> Array:
    """Draw which positions arrive (steps,), on a two-state link that loses all in one state."""
    leave = 1.0 / burst if burst > 1.0 else 1.0 - loss
    enter = leave * loss / (1.0 - loss)
    is_bad, arrived = rng.random() < loss, np.empty(steps)
    for step, draw in enumerate(rng.random(steps)):
        is_bad = draw >= leave if is_bad else draw < enter
        arrived[step] = not is_bad
    return arrived


def draw_noise(kind: str, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """Draw disturbances of unit variance, or twice that."""
    if kind == "t":
        return np.asarray(rng.standard_t(3, shape) / math.sqrt(3.0))
    noise = rng.standard_normal(shape)
    if kind == "twice":
        return math.sqrt(2.0) * noise
    if kind != "white":
        rho = float(kind)
        for step in range(1, len(noise)):
            noise[step] = rho * noise[step - 1] + math.sqrt(1.0 - rho**2) * noise[step]
    return noise


def draw_run(cell: Cell, steps: int, problem: ControlProblem, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw which positions of a run arrive (steps,), and its disturbances (steps, n_w)."""
    arrived = draw_arrivals(cell.loss, cell.burst, steps, rng)
    if cell.then is not None:
        arrived[steps // 2 :] = draw_arrivals(*cell.then, steps - steps // 2, rng)
    return arrived, math.sqrt(problem.plant.w[0, 0]) * draw_noise(cell.noise, (steps, problem.plant.n_w), rng)


def fly(
    solver: ConditionedSolver, cell: Cell, steps: int, rng: np.random.Generator, budgets: str, steps_before: int = 0
) -> tuple[Array, Array]:
    """Fly one run by `risk.budgets`; return the flags of steps outside and the cost of each step."""
    adapts = budgets != "configured"
    axes = solver.problem.plant.n_u
    problem, plant = make_problem(axes), make_problem(axes).plant
    shares, ages, loop = solver.age_shares, AgeRecord(), LoopState()
    arrived, noise = draw_run(cell, steps, problem, rng)
    if steps_before:
        silence = 0
        for is_there in draw_arrivals(*(cell.before or (cell.loss, cell.burst)), steps_before, rng):
            ages, silence = count_age(ages, silence + 1, shares), 0 if is_there else silence + 1
    lower, upper = problem.input_set.bounds
    rows, sides = solver.problem.state_set.c, solver.problem.state_set.b
    target = problem.target
    x = target - np.array([2.0, 0.0] * plant.n_u)
    plan: Answer | None = None
    spread = SpreadState()
    knowledge = Knowledge(solver.problem.plant, x, plant.w)
    states, inputs, begun, newest, before = [x], np.zeros((steps, plant.n_u)), 0, 0, 0
    outside, cost = np.zeros(steps), np.zeros(steps)
    for k in range(steps):
        captured = k - cell.late
        is_new = k == 0 or (captured >= 0 and bool(arrived[captured]))
        if is_new and captured > newest:
            mean, cov = knowledge.predict(inputs[newest:captured])
            variances, innovation = cov.diagonal()[: plant.n_x : 2], states[captured] - mean[: plant.n_x]
            spread = count_innovation(spread, innovation[::2].tolist(), variances.tolist())
            knowledge.learn(mean, cov, states[captured])
            newest = captured
        age = k - newest
        mean, cov = knowledge.predict(inputs[newest:k])
        if k and adapts:
            ages = count_age(ages, before + 1, shares)
            variances = np.einsum("mi,ij,mj->m", rows, cov, rows)
            is_behind = age >= HORIZON
            risk = compute_outside_risk(sides - rows @ mean, variances, spread.spread)
            keeps_away = plan is not None and plan.offset > 0.0
            loop = charge_risk(loop, risk, ALLOWED, keeps_away=keeps_away, is_behind_horizon=is_behind)
        before = age
        if is_new and age < HORIZON:
            preview = Preview(age=age, cov=cov if cov.any() else None)
            if adapts:
                preview = Preview(
                    age=age,
                    cov=preview.cov,
                    level=ages.level if budgets == "observed" else CERTIFICATE_LEVEL,
                    widening=loop.widening,
                    silence_widening=loop.silence_widening,
                )
            plan, begun = solver.solve(0, mean, solver.problem.target, preview), k
        if plan is not None and k - begun < HORIZON and age < HORIZON:
            inputs[k] = plan.inputs[k - begun]
        else:
            inputs[k] = np.clip(-0.5 * mean[1 : plant.n_x : 2], lower, upper)
        off = x - target
        cost[k] = off @ problem.q_x @ off + inputs[k] @ problem.q_u @ inputs[k]
        x = plant.a @ x + plant.b @ inputs[k] + plant.e @ noise[k]
        states.append(x)
        outside[k] = bool((x[::2] > WALL_M).any())
    return outside, cost


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", type=int, choices=(1, 2), default=1)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--steps", type=int, default=2200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--design", type=float, default=0.3, help="share of independent losses of the design")
    parser.add_argument("--late", type=int, default=0, help="steps that positions of the design are late")
    parser.add_argument(
        "--gust", type=float, default=0.0, help="share that a step keeps of a disturbance, by the design"
    )
    parser.add_argument("--budgets", choices=("observed", "certificate", "configured"), default="observed")
    parser.add_argument("--before", type=int, default=0, help="steps before the flight whose ages count")
    parser.add_argument("--cells", default="", help="fly only cells with this in their names")
    given = parser.parse_args()
    adapts = given.budgets != "configured"
    problem = make_problem(given.axes)
    solver = ConditionedSolver(
        add_gusts(problem, given.gust) if given.gust else problem,
        RunLengthAges(given.design, given.design, given.late)
        if given.late
        else bernoulli(np.array([1.0 - given.design])),
        ALLOWED,
        has_observed_levels=adapts,
        bounds_slack=not adapts,
    )
    sys.stdout.write(f"| cell | first {SETTLED} steps outside | after | cost |\n|---|---|---|---|\n")
    cells = (*CELLS, *(GROUND_CELLS if given.before else ()))
    for cell in (cell for cell in cells if given.cells in cell.name):
        runs = [
            fly(solver, cell, given.steps, np.random.default_rng([given.seed, run]), given.budgets, given.before)
            for run in range(given.runs)
        ]
        early = np.mean([outside[:SETTLED].mean() for outside, _ in runs])
        late = np.array([outside[SETTLED:].mean() for outside, _ in runs])
        cost = np.mean([cost[SETTLED:].mean() for _, cost in runs])
        half = 1.96 * late.std(ddof=1) / math.sqrt(given.runs)
        sys.stdout.write(f"| {cell.name} | {early:.1%} | {late.mean():.1%} ± {half:.1%} | {cost:.4g} |\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
