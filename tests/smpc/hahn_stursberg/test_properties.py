"""Properties of all solvers' answers on seeded random samples.

A comparison of two optima uses both bounds, `cost_lower` of the one that may not be the larger, so that it holds for
solvers that certify a gap as well as for exact ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from optimisation_cases import ORIGIN, PAPER_LOWER, PAPER_UPPER, START, paper, paper_plant, paper_spec
from plant_cases import case, kept
from plant_units import Units, in_units

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer, Solver
from uavctl.smpc.hahn_stursberg import exact as conic
from uavctl.smpc.hahn_stursberg.components import decompose, make_whole_component
from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec, kappa, make_design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, optimal_cost
from uavctl.smpc.hahn_stursberg.horizon import Horizon, make_horizon
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutSolver
from uavctl.smpc.link import bernoulli
from uavctl.smpc.sets import Polytope


@dataclass(frozen=True)
class Kind:
    """A kind of solver, how far its costs may be from the optimum, and its plans from the optimal ones."""

    make: Callable[[Design], Solver]
    cost: float
    plan: float


SOLVERS = {"exact": Kind(ConicSolver, cost=1e-7, plan=1e-4), "flown": Kind(ShortcutSolver, cost=1e-7, plan=1e-4)}

SYMMETRIC = Polytope.from_box([-40.0, -8.0, -25.0, -8.0], [40.0, 8.0, 25.0, 8.0])


@pytest.fixture(params=SOLVERS)
def kind(request: pytest.FixtureRequest) -> Kind:
    return SOLVERS[request.param]


def states(count: int, seed: int, share: float = 0.8) -> list[Array]:
    rng = np.random.default_rng(seed)
    return [share * x for x in rng.uniform(PAPER_LOWER, PAPER_UPPER, size=(count, 4))]


def answers(kind: Kind, spec: DesignSpec, points: list[Array], target: Array = ORIGIN) -> list[Answer]:
    solver = kind.make(make_design(spec))
    result = [solver.solve(0, x, target) for x in points]
    assert {answer.status for answer in result} == {SolveStatus.OPTIMAL}
    return result


def never_costs_more(kind: Kind, less: list[Answer], more: list[Answer]) -> None:
    for item, other in zip(less, more, strict=True):
        assert item.cost_lower <= other.cost * (1.0 + 1e-7)
        assert item.cost <= other.cost * (1.0 + kind.cost)


# --- back-offs --------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_backoffs_grow_with_the_age_of_the_information(kind: Kind) -> None:
    """Until the first feedback the state is known from stage 0 alone: its age is the stage."""
    for answer in answers(kind, paper_spec(), states(5, 1)):
        for before, after in pairwise(answer.backoff_x[:6]):
            assert np.all(after > before)
        assert not answer.backoff_u[:5].any()


def test_backoffs_grow_with_the_age_of_the_base() -> None:
    """With the same gains on the disturbances since now, an older base has less information."""
    design = paper()
    rng = np.random.default_rng(2)
    for part in decompose(design):
        new = make_horizon(design, part)
        theta = 0.1 * rng.normal(size=new.n_theta)
        sizes = []
        for past in range(4):
            old = Horizon(part, design.horizon, design.terminal.tau, design.schedule, past)
            same = dict(zip(new.gains, theta, strict=True))
            gains = np.array([same.get(gain, 0.0) for gain in old.gains])
            noises = [old.state_noise(t, part.c_x).evaluate(gains) for t in range(1, design.horizon + 1)]
            sizes.append([np.linalg.norm(noise.reshape(len(part.c_x), -1), axis=1) for noise in noises])
        for newer, older in pairwise(np.array(sizes)):
            assert np.all(older > newer)


@pytest.mark.long
def test_backoffs_grow_with_loss(kind: Kind) -> None:
    points = states(4, 3, 0.5)
    worse = [answers(kind, paper_spec(link=bernoulli(np.array([1.0 - loss]))), points) for loss in (0.1, 0.2, 0.3)]
    designs = [paper(link=bernoulli(np.array([1.0 - loss]))) for loss in (0.1, 0.2, 0.3)]
    for better, design in pairwise(designs):
        assert np.all(design.kappa_x[1:] >= better.kappa_x[1:])
        assert np.all(design.kappa_x[6:] > better.kappa_x[6:])
        assert np.all(design.kappa_u[5:] > better.kappa_u[5:])
    for low, high in pairwise(worse):
        for item, other in zip(low, high, strict=True):
            assert np.all(other.backoff_x[1:6] >= item.backoff_x[1:6])  # no feedback there: κ is all that changes


# --- cost -------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_better_link_never_costs_more_with_the_same_delays(kind: Kind) -> None:
    points = states(6, 4)
    costs = [answers(kind, paper_spec(link=bernoulli(np.array([p]))), points) for p in (0.99, 0.9, 0.8, 0.7)]
    for better, worse in pairwise(costs):
        never_costs_more(kind, better, worse)


@pytest.mark.long
def test_a_better_link_never_costs_more_with_the_best_schedule() -> None:
    """Every schedule that a link admits, a better one admits too."""
    point = np.array([[5.0, -1.0, -3.0, 1.0]])
    spec = replace(paper_spec(), horizon=10, rule="search", search_states=point, delta_x=0.9, delta_u=0.85)
    costs = []
    for p in (0.9, 0.8, 0.72):
        design = make_design(replace(spec, link=bernoulli(np.array([p]))), optimal_cost)
        cost = optimal_cost(design, point[0])
        assert cost is not None
        costs.append(cost)
    for better, worse in pairwise(costs):
        assert better <= worse * (1.0 + 1e-7)
    assert costs[0] < costs[-1] * (1.0 - 1e-4)


@pytest.mark.long
def test_more_disturbance_never_costs_less(kind: Kind) -> None:
    points = states(6, 5)
    sizes = [np.diag([0.3, 0.3]), np.diag([0.3, 0.6]), np.diag([0.6, 0.6]), np.diag([0.75, 0.6])]
    costs = [answers(kind, paper_spec(plant=paper_plant(w=w)), points) for w in sizes]
    for less, more in pairwise(costs):
        never_costs_more(kind, less, more)


@pytest.mark.long
@pytest.mark.parametrize("which", ["state", "input"])
def test_wider_limits_never_cost_more(kind: Kind, which: str) -> None:
    points = states(6, 6)
    costs = []
    for factor in (1.5, 1.2, 1.0):
        if which == "state":
            spec = paper_spec(
                state_set=Polytope.from_box((factor * PAPER_LOWER).tolist(), (factor * PAPER_UPPER).tolist())
            )
        else:
            spec = paper_spec(input_set=Polytope.from_box([-7.5 * factor] * 2, [7.5 * factor] * 2))
        costs.append(answers(kind, spec, points))
    for wide, narrow in pairwise(costs):
        never_costs_more(kind, wide, narrow)


@pytest.mark.long
def test_longer_delays_never_cost_less(kind: Kind) -> None:
    """On a link without losses, where the delays change what is fed back and no likelihood."""
    points = states(5, 7)
    sure = paper_spec(link=bernoulli(np.array([1.0])))
    costs = [answers(kind, replace(sure, delays=delays), points) for delays in ([3] * 8 + [5] * 4, 4, 5)]
    for short, long in pairwise(costs):
        never_costs_more(kind, short, long)


# --- symmetries -------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_mirrored_states_give_mirrored_plans(kind: Kind) -> None:
    solver = kind.make(make_design(paper_spec(state_set=SYMMETRIC)))
    for x in states(6, 8):
        item, other = solver.solve(0, x, ORIGIN), solver.solve(0, -x, ORIGIN)
        assert item.inputs == pytest.approx(-other.inputs, abs=kind.plan)
        assert item.backoff_x == pytest.approx(other.backoff_x, abs=10 * kind.plan)
        assert item.cost == pytest.approx(other.cost, rel=kind.cost)


@pytest.mark.long
def test_axes_of_the_same_kind_may_be_swapped(kind: Kind) -> None:
    solver = kind.make(make_design(paper_spec(state_set=Polytope.from_box([-30.0, -8.0] * 2, [30.0, 8.0] * 2))))
    swap = [2, 3, 0, 1]
    for x in states(4, 9):
        item, other = solver.solve(0, x, ORIGIN), solver.solve(0, x[swap], ORIGIN)
        assert item.inputs == pytest.approx(other.inputs[:, ::-1], abs=kind.plan)
        assert item.cost == pytest.approx(other.cost, rel=kind.cost)


@pytest.mark.long
@pytest.mark.parametrize("move_m", [(100.0, 0.0), (-3.0, 2000.0), (1e5, -1e5)], ids=str)
def test_a_shift_of_everything_shifts_the_plan(kind: Kind, move_m: tuple[float, float]) -> None:
    move = np.array([move_m[0], 0.0, move_m[1], 0.0])
    spec = paper_spec()
    shifted = replace(
        spec, state_set=replace(spec.state_set, b=spec.state_set.b + spec.state_set.c @ move), target_m=(*move_m, 0.0)
    )
    points = states(5, 10)
    here = answers(kind, spec, points)
    there = answers(kind, shifted, [x + move for x in points], move)
    for item, other in zip(here, there, strict=True):
        assert item.inputs == pytest.approx(other.inputs, abs=kind.plan)
        assert item.states == pytest.approx(other.states - move, abs=10 * kind.plan)
        assert item.cost == pytest.approx(other.cost, rel=kind.cost)


def test_the_step_s_number_changes_nothing(kind: Kind) -> None:
    solver = kind.make(paper())
    item, other = solver.solve(0, START, ORIGIN), solver.solve(12345, START, ORIGIN)
    assert item.inputs.tobytes() == other.inputs.tobytes()
    assert (item.seq, other.seq, item.cost) == (0, 12345, other.cost)


@pytest.mark.long
@pytest.mark.parametrize("units", [(1e3, 1.0, 1.0), (1.0, 1e-3, 1.0), (1.0, 1.0, 1e6), (0.3048, 1e3, 1e-4)], ids=str)
def test_a_change_of_units_changes_nothing(kind: Kind, units: tuple[float, float, float]) -> None:
    spec, changed = paper_spec(), Units.of(paper_plant(), *units)
    points = states(5, 11, 1.2)  # some beyond the limits
    here = answers(kind, spec, points)
    there = answers(kind, in_units(spec, changed), [x * changed.state for x in points], ORIGIN)
    for item, other in zip(here, there, strict=True):
        assert item.inputs == pytest.approx(other.inputs / changed.input, abs=kind.plan)
        assert item.states == pytest.approx(other.states / changed.state, abs=10 * kind.plan)
        assert item.cost == pytest.approx(other.cost / changed.cost, rel=kind.cost)
        assert item.slack == pytest.approx(other.slack / changed.state[0], abs=1e-4)


# --- coupling ---------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_hardly_coupled_axes_have_the_plan_of_independent_ones(kind: Kind) -> None:
    """One component of two axes, whose coupling does nothing, against two components."""
    joint = make_design(paper_spec(plant=paper_plant(coupling=1e-10)))
    difference = paper()
    assert (len(decompose(joint)), len(decompose(difference))) == (1, 2)
    together, single = kind.make(joint), kind.make(difference)
    for x in states(3, 12):
        item, other = together.solve(0, x, ORIGIN), single.solve(0, x, ORIGIN)
        assert item.cost == pytest.approx(other.cost, rel=kind.cost)
        assert item.inputs == pytest.approx(other.inputs, abs=10 * kind.plan)
        assert item.states == pytest.approx(other.states, abs=10 * kind.plan)


@pytest.mark.parametrize("name", ["calm axis, W = 0", "calm axis, no column"])
def test_the_whole_plant_as_one_part_has_the_cost_of_its_parts(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = case(name)
    monkeypatch.setattr(conic, "decompose", lambda design: (make_whole_component(design),))
    together = ConicSolver(made.design).solve(0, made.x, made.design.target)
    assert kept(together)
    assert together.cost == pytest.approx(made.answer.cost, rel=1e-7)


def test_likelihoods_are_those_of_the_whole_plant() -> None:
    design = paper()
    assert design.kappa_x[1] == pytest.approx(kappa(0.95, 4, 8, "ellipsoid"))
    assert design.kappa_u[0] == pytest.approx(kappa(0.9, 2, 4, "ellipsoid"))
