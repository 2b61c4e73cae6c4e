"""Compare models of first-order gusts: in flights of one axis beside a wall, or on a recorded flight.

Without a recording: an axis like that of preset `room` (step 0.05 s, lag 0.12 s, no drag, horizon 48), positions with
5 mm noise of which 30 % are lost, the target 5 cm from a wall. Gusts have a deviation of 0.3 m/s², white noise beside
them 0.05 m/s² a step. Plans have the configured budgets, and the filter the same model as the plans. It prints, for
each model, the share of steps outside in the first 200 steps and after them, and the mean cost of a step after them.

With a recording (.tlog): plain fits of the plant `drag-lag` to each axis, with white noise, with a drift in addition,
and with first-order gusts. It prints the fall of the deviance, the time constant, and the spread 0.25 to 2 s ahead.

    python tools/gusts.py [--runs 40] [--steps 2200] [--seed 1]
    python tools/gusts.py FLIGHT.tlog --config room-px4 --dead-time 0.12
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from logs.recording.tlog import read_tlog
from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.lab.identify.fit import fit_axes
from uavctl.lab.identify.history import read_tlog_history
from uavctl.lab.identify.response import AxisModel, DragLagAxis, FreeParameter, LinearMotion
from uavctl.lab.identify.result import make_fitted_stretches
from uavctl.lab.identify.spread import compute_spread, measure_spreads
from uavctl.smpc.answer import Preview
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.smpc.link import bernoulli
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import AXES, Plant, drag_lag
from uavctl.smpc.sets import Polytope

ALLOWED, HORIZON, SETTLED, LOSS = 0.05, 48, 200, 0.3
WALL_M, ROOM_M, NOISE_M, GUST_MPS2, WHITE_MPS2 = 2.0, 0.05, 0.005, 0.3, 0.05
TIMES_S = (0.25, 1.0, 4.0)
PLANT = drag_lag([0.0], [0.12], [1.0], [1.0], 0.05, ("north",))
FILTER_STEPS = 3000  # until the filter's covariance has settled


def make_problem(variance: float) -> ControlProblem:
    """Make the problem of the axis, with white noise of a variance."""
    return ControlProblem(
        plant=replace(PLANT, w=np.array([[variance]])),
        state_set=Polytope.from_box([-8.0, -1.5, -50.0], [WALL_M, 1.5, 50.0]),
        input_set=Polytope.from_box([-2.0], [2.0]),
        q_x=np.diag([10.0, 1.0, 0.1]),
        q_u=np.eye(1),
        target=np.array([WALL_M - ROOM_M, 0.0, 0.0]),
        u_target=np.zeros(1),
        horizon=HORIZON,
        slack_linear=1e5,
        slack_quadratic=1e3,
    )


def add_gust(plant: Plant, keep: float, variance: float) -> Plant:
    """Return the plant of (x, d): x+ = A x + B u + E (w + d), d+ = keep d + n with the variance of n."""
    return replace(
        plant,
        a=np.block([[plant.a, plant.e], [np.zeros((1, plant.n_x)), np.array([[keep]])]]),
        b=np.vstack([plant.b, np.zeros((1, plant.n_u))]),
        e=np.block([[plant.e, np.zeros((plant.n_x, 1))], [np.zeros((1, plant.n_w)), np.eye(1)]]),
        w=np.diag([plant.w[0, 0], variance]),
        extra_states=(),
    )


class Flier:
    """Filter and plans with one model of the gusts.

    Args:
        variance: Variance of the white noise.
        keep: Share of a gust that is left after a step; None: the model has white noise only.
        gust_variance: Variance of the change of a gust in a step.
    """

    def __init__(self, variance: float, keep: float | None = None, gust_variance: float = 0.0) -> None:
        self.problem = make_problem(variance)
        plant = self.problem.plant
        self.keep = keep or 0.0
        self.model = plant if keep is None else add_gust(plant, keep, gust_variance)
        self.noise = self.model.e @ self.model.w @ self.model.e.T
        cov = 0.1 * np.eye(self.model.n_x)
        for _ in range(FILTER_STEPS):
            _, cov = self.update(np.zeros(self.model.n_x), self.model.a @ cov @ self.model.a.T + self.noise, 0.0)
        self.cov = cov
        self.solver = ConditionedSolver(
            self.problem,
            bernoulli(np.array([1.0 - LOSS])),
            ALLOWED,
            cov=cov,
            filter_plant=None if keep is None else self.model,
        )

    def update(self, mean: Array, cov: Array, position_m: float) -> tuple[Array, Array]:
        """Update the belief with a position."""
        gain = cov[:, 0] / (cov[0, 0] + NOISE_M**2)
        rest = np.eye(len(cov))
        rest[:, 0] -= gain
        corrected = rest @ cov @ rest.T + NOISE_M**2 * np.outer(gain, gain)
        return mean + gain * (position_m - mean[0]), (corrected + corrected.T) / 2.0

    def fly(self, time_s: float, steps: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Fly one run in gusts of a time constant; return the flags of steps outside and the cost of each step."""
        problem, model, n_x = self.problem, self.model, PLANT.n_x
        arrived = rng.random(steps) >= LOSS
        white, gusts, noise = (rng.standard_normal(steps) for _ in range(3))
        kept = math.exp(-PLANT.dt_s / time_s)
        for step in range(1, steps):
            gusts[step] = kept * gusts[step - 1] + math.sqrt(1.0 - kept**2) * gusts[step]
        x = problem.target - np.array([0.4, 0.0, 0.0])
        mean, cov = np.append(x, np.zeros(model.n_x - n_x)), self.cov
        plan, begun, gust = self.solver.solve(0, x, problem.target, Preview(cov=cov)), 0, 0.0
        outside, cost = np.zeros(steps), np.zeros(steps)
        for k in range(steps):
            if k and arrived[k]:
                mean, cov = self.update(mean, cov, x[0] + NOISE_M * noise[k])
                plan, begun = self.solver.solve(0, mean[:n_x], problem.target, Preview(cov=cov)), k
                gust = float(mean[n_x:].sum())
            since = min(k - begun, HORIZON - 1)
            # u = v - d, with the gust as predicted: it moves the axis as an input does, but for the lag
            u = np.clip(plan.inputs[since] - self.keep ** (k - begun) * gust, -2.0, 2.0)
            off = x - problem.target
            cost[k] = off @ problem.q_x @ off + u @ problem.q_u @ u
            force = GUST_MPS2 * gusts[k] + WHITE_MPS2 * white[k]
            x = PLANT.a @ x + PLANT.b @ u + PLANT.e[:, 0] * force
            mean, cov = model.a @ mean + model.b @ u, model.a @ cov @ model.a.T + self.noise
            outside[k] = x[0] > WALL_M
        return outside, cost


def make_fliers(time_s: float) -> dict[str, Flier]:
    """Make the models to compare, by name."""
    white, gust = WHITE_MPS2**2, GUST_MPS2**2
    keep = math.exp(-PLANT.dt_s / time_s)
    slow, quick = math.exp(-PLANT.dt_s / (4.0 * time_s)), math.exp(-4.0 * PLANT.dt_s / time_s)
    drift = gust * (1.0 - keep**2)
    return {
        "white, same variance": Flier(white + gust),
        **{f"white, {factor} times the variance": Flier(factor * (white + gust)) for factor in (2, 4, 8)},
        "first order, true": Flier(white, keep, drift),
        "first order, 4 times the time constant": Flier(white, slow, gust * (1.0 - slow**2)),
        "first order, a quarter of it": Flier(white, quick, gust * (1.0 - quick**2)),
        "drift of the gusts": Flier(white, 1.0, drift),
        "drift, 0.3 times that variance": Flier(white, 1.0, 0.3 * drift),
    }


def compare_in_flights(runs: int, steps: int, seed: int) -> None:
    """Print the table of the flights."""
    sys.stdout.write(f"| gusts | model | first {SETTLED} steps outside | after | cost |\n|---|---|---|---|---|\n")
    for time_s in TIMES_S:
        for name, flier in make_fliers(time_s).items():
            flown = [flier.fly(time_s, steps, np.random.default_rng([seed, run])) for run in range(runs)]
            early = np.mean([outside[:SETTLED].mean() for outside, _ in flown])
            late = np.array([outside[SETTLED:].mean() for outside, _ in flown])
            cost = np.array([step_cost[SETTLED:].mean() for _, step_cost in flown])
            half = 1.96 / math.sqrt(runs)
            sys.stdout.write(
                f"| {time_s:g} s | {name} | {early:.1%} | {late.mean():.1%} ± {half * late.std(ddof=1):.1%} | "
                f"{cost.mean():.3f} ± {half * cost.std(ddof=1):.3f} |\n"
            )
            sys.stdout.flush()


@dataclass(frozen=True)
class GustAxis:
    """Plant of model drag-lag whose bias is a first-order gust: b' = -b / T + n."""

    name: ClassVar[str] = "first order"
    start_std: ClassVar[tuple[float, ...]] = DragLagAxis.start_std
    free: ClassVar[tuple[FreeParameter, ...]] = (
        *DragLagAxis(drifts=True).free,
        FreeParameter("time_s", 0.05, 100.0, logarithmic=True),
    )

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """See `AxisModel`: quick and slow gusts."""
        plain = DragLagAxis(drifts=True).starts
        pairs = ((0.3, 0.3), (3.0, 0.1))
        return tuple({**start, "time_s": time_s, "drift_mps2_rts": drift} for start in plain for time_s, drift in pairs)

    def motion(self, parameters: Array) -> LinearMotion:
        """See `AxisModel`."""
        motion = DragLagAxis(drifts=True).motion(parameters)
        motion.a[:, 3, 3] = -np.exp(-parameters[:, -1])
        return motion


def compare_on_recording(flight: Path, config_name: str, dead_time_s: float) -> None:
    """Print the fits of a recorded flight."""
    config = load_config(config_name, ["daemon.mocap=tlog", "daemon.vehicle=tlog"])
    flown = make_fitted_stretches(read_tlog_history(read_tlog(flight).packets, config), config)
    models: dict[str, AxisModel] = {
        "white": DragLagAxis(drifts=False),
        "drift": DragLagAxis(drifts=True),
        "first order": GustAxis(),
    }
    sys.stdout.write("| axis | model | deviance | time constant [s] | spread 0.25, 0.5, 1, 2 s ahead |\n")
    sys.stdout.write("|---|---|---|---|---|\n")
    for axis in map(AXES.index, config.plant.axes):
        first: float | None = None
        for name, model in models.items():
            (fit,) = fit_axes(flown, (axis,), (model,), dead_time_s, (None,))
            first = fit.deviance if first is None else first
            time = f"{fit.value('time_s'):.2g}" if name == "first order" else "–"
            spreads = (
                f"{compute_spread(*pair):.2f}"
                for pair in measure_spreads(flown, axis, model, fit.parameters, dead_time_s)
            )
            change = f"{fit.deviance - first:.1f}"
            sys.stdout.write(f"| {AXES[axis]} | {name} | {change} | {time} | {', '.join(spreads)} |\n")
            sys.stdout.flush()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("flight", type=Path, nargs="?", help="recording of a flight (.tlog)")
    parser.add_argument("--config", default="room", help="configuration that the recording is read with")
    parser.add_argument("--dead-time", type=float, default=0.1, help="dead time of the fits [s]")
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--steps", type=int, default=2200)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    if given.flight is not None:
        compare_on_recording(given.flight, given.config, given.dead_time)
    else:
        compare_in_flights(given.runs, given.steps, given.seed)


if __name__ == "__main__":
    main()
