"""What the SMPC is held against: MPC for the worst-case delay, and LQG, on the same noise and the same losses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uavctl.build import build_problem, needed
from uavctl.paper.flights import Setup, fly_runs, planes
from uavctl.paper.result import WorstCase
from uavctl.smpc.baselines.lqg import Lqg
from uavctl.smpc.baselines.worst_case import WorstCaseDelay
from uavctl.smpc.design import Design
from uavctl.smpc.risk import kappa
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]


def worst_case(setup: Setup, seed: int, runs: int, steps: int) -> WorstCase:
    """MPC for a constant delay of τ, with the likelihoods of the constraints themselves."""
    design, smpc = setup.design, setup.config.smpc
    tau, delta_u = design.terminal.tau, needed(smpc.delta_u, "smpc.delta_u")
    controller = WorstCaseDelay(
        build_problem(setup.config),
        tau,
        kappa(smpc.delta_x, design.plant.n_x, design.state_set.b.size, "ellipsoid"),
        kappa(delta_u, design.plant.n_u, design.input_set.b.size, "ellipsoid"),
    )
    flown = fly_runs(setup, controller, seed, range(runs), steps)
    settled = flown.states[:, steps // 2 :].reshape(-1, design.plant.n_x)
    return WorstCase(
        runs=runs,
        delay=tau,
        mean_cost=float(flown.cost.sum(axis=1).mean()),
        settled_cost=float(flown.cost[:, steps // 2 :].mean()) / len(design.plant.axes),
        settled_std=settled.std(axis=0).tolist(),
        area_ratio=area_ratios(np.cov(settled.T, bias=True), design),
    )


def lqg_asking(setup: Setup, seed: int, runs: int, steps: int) -> float:
    """Share of settled steps and inputs in which LQG breaks the input limits, where nothing stops it from doing so."""
    limits = setup.design.input_set
    open_sides = Polytope(limits.c, np.full(limits.b.size, np.inf))
    problem = replace(build_problem(setup.config), input_set=open_sides)
    flown = fly_runs(setup, Lqg(problem), seed, range(runs), steps, open_sides)
    beyond = flown.asked[:, steps // 2 :] @ limits.c.T > limits.b  # opposite rows are never broken together
    return float(beyond.sum() / flown.asked[:, steps // 2 :].size)


def area_ratios(covariance: Array, design: Design) -> list[float]:
    """Areas of a covariance's ellipses over those of Σ_ξ, in each axis' plane; the likelihood cancels out."""
    pairs = [np.ix_(pair, pair) for pair in planes(design.plant)]
    sigma = design.terminal.sigma_x
    return [float(np.sqrt(np.linalg.det(covariance[two]) / np.linalg.det(sigma[two]))) for two in pairs]
