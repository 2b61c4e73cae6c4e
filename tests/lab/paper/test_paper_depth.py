"""The slow part of `uavctl paper`: schedules tried, complexity over τ, and the least settled cost."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from uavctl.config import load_config
from uavctl.errors import UavctlError
from uavctl.lab.paper import depth as deep
from uavctl.lab.paper.claims import Depth
from uavctl.lab.paper.depth import GridSize, compute_least_settled_cost, extract_component
from uavctl.smpc.hahn_stursberg.components import decompose
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.lqg_bound import stationary_bound
from uavctl.smpc.nominal import lqr
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_design, build_spec

COARSE = GridSize(states=35, inputs=31)


@pytest.fixture(scope="module")
def axis() -> Design:
    design = build_design(load_config("paper"))
    return extract_component(design, decompose(design)[0])


@pytest.fixture(scope="module")
def depth() -> Depth:
    """All of it, with fewer designs, states and points."""
    schedules = [schedule for schedule in deep._list_schedules() if "search" not in schedule[1]][:3]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deep, "_list_schedules", lambda: iter(schedules))
        for name, value in (("_TAUS", (2, 3, 4)), ("_STATES", 2), ("_RUNS", 1)):
            patch.setattr(deep, name, value)
        patch.setattr(
            deep,
            "compute_least_settled_cost",
            partial(compute_least_settled_cost, grid_size=GridSize(states=11, inputs=11)),
        )
        return deep.measure_depth(0, lambda _: None)


def test_without_limits_the_least_cost_is_the_lqg_bound(axis: Design) -> None:
    link = build_spec(load_config("paper")).link
    open_sides = Polytope(axis.input_set.c, 20 * axis.input_set.b)
    cost = compute_least_settled_cost(axis.plant, open_sides, axis.q_x, axis.q_u, 0.3, GridSize(states=25, inputs=61))
    assert cost == pytest.approx(stationary_bound(axis.plant, axis.q_x, axis.q_u, link), rel=2e-3)


@pytest.mark.long
def test_limits_cost_and_clipped_lqg_is_not_below_the_least(axis: Design) -> None:
    least_cost = compute_least_settled_cost(axis.plant, axis.input_set, axis.q_x, axis.q_u, 0.3, COARSE)
    assert least_cost == pytest.approx(11.95, abs=0.05)
    # LQG with its input clipped, simulated by itself: an upper bound of the least.
    rng, k = np.random.default_rng(0), lqr(axis.plant, axis.q_x, axis.q_u).k
    a, b, e = axis.plant.a, axis.plant.b, axis.plant.e
    x = known = np.zeros((4000, 2))
    costs = []
    for step in range(300):
        known = np.where(rng.random((4000, 1)) < 0.7, x, known)
        u = np.clip(known @ k.T, -7.5, 7.5)
        if step >= 50:
            costs.append(np.einsum("ni,ij,nj->n", x, axis.q_x, x) + 0.1 * u[:, 0] ** 2)
        x = x @ a.T + u @ b.T + np.sqrt(0.6) * rng.standard_normal((4000, 1)) @ e.T
        known = known @ a.T + u @ b.T
    by_run = np.mean(costs, axis=0)
    error = by_run.std() / np.sqrt(4000)
    assert least_cost < by_run.mean() + 3 * error
    assert by_run.mean() < 1.02 * least_cost + 3 * error  # and it is nearly the least


def test_a_plant_of_several_axes_is_refused(axis: Design) -> None:
    design = build_design(load_config("paper"))
    with pytest.raises(UavctlError, match="one axis"):
        compute_least_settled_cost(design.plant, design.input_set, design.q_x, design.q_u, 0.3, COARSE)


@pytest.mark.slow
def test_tried_designs_are_listed_with_the_reason(depth: Depth) -> None:
    tried = {design.schedule: design for design in depth.designs if design.tau == 3}
    assert "0.9370" in tried["d_t = 4"].refused and tried["d_t = 4"].delays is None
    assert "slower than the terminal law" in tried["d_t = 5"].refused
    joint = tried["d_t = 4, joint"]
    assert joint.refused == "" and joint.delays == [4] * 12
    assert joint.gamma_h == pytest.approx(0.9974, abs=1e-4)
    assert joint.cost == pytest.approx(59569.4, abs=0.5)


@pytest.mark.slow
def test_complexity_is_measured_where_there_is_a_design(depth: Depth) -> None:
    assert [(entry.tau, entry.horizon) for entry in depth.complexity] == [(2, 12), (3, 12), (4, 12), (2, 10), (3, 11)]
    for entry in depth.complexity:
        assert entry.lifted == 2 * (entry.tau + 1)
        times = (entry.exact_ms, entry.printed_ms)
        if entry.tau == 2:
            assert "out of reach" in entry.refused and times == (None, None)
        else:
            assert entry.refused == "" and all(time is not None and time > 0.0 for time in times)
    gains = {(entry.tau, entry.horizon): entry.gains for entry in depth.complexity}
    assert gains[3, 12] == 36 and gains[4, 12] == 28 and gains[3, 11] == 28
