"""Margin of the terminal condition by schedule, and the optimal cost of a state."""

from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from optimisation_cases import ORIGIN, PAPER_COST, START, TAU_3, paper, paper_plant, paper_spec, room

from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg import exact as feasibility
from uavctl.smpc.hahn_stursberg.components import decompose
from uavctl.smpc.hahn_stursberg.design import Design, make_design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, check_schedule, optimal_cost
from uavctl.smpc.hahn_stursberg.horizon import Horizon, terminal_bound
from uavctl.smpc.link import bernoulli
from uavctl.smpc.sets import Polytope

GOOD_LINK = bernoulli(np.array([0.8]))


def test_the_papers_schedule_leaves_a_margin() -> None:
    assert check_schedule(paper()) == pytest.approx(0.1995, abs=1e-4)


def test_margin_is_reached_and_no_gain_goes_beyond_it() -> None:
    """Duality of the spectral norm: min ‖Y_0 + Mθ‖ = max ⟨Z, Y_0⟩ over nuclear norms <= 1 with Mᵀ vec Z = 0."""
    design = paper()
    margin = check_schedule(design)
    bound = terminal_bound(Horizon(decompose(design)[0], 12, 4, design.schedule), move_constants=False)
    matrix = bound.y.matrix.toarray()
    z = cp.Variable((bound.rows, bound.columns))
    constraints = [cp.normNuc(z) <= 1, matrix.T @ cp.vec(z, order="C") == 0]
    cp.Problem(cp.Maximize(bound.y.offset @ cp.vec(z, order="C")), constraints).solve(solver=cp.CLARABEL)
    # Whatever the solver left: exactly orthogonal to every gain, and of norm 1, so that the bound is one by itself.
    exact = z.value.ravel() - matrix @ np.linalg.lstsq(matrix, z.value.ravel(), rcond=None)[0]
    exact /= np.linalg.norm(exact.reshape(bound.rows, bound.columns), "nuc")
    maximum = 1.0 - float(exact @ bound.y.offset) ** 2
    assert margin <= maximum + 1e-8
    assert margin == pytest.approx(maximum, abs=1e-6)


def test_longer_delays_leave_less_margin() -> None:
    shorter, longer = (check_schedule(paper(delays=delay, link=GOOD_LINK)) for delay in (4, 5))
    assert shorter > longer + 0.1
    assert longer > 0


@pytest.mark.parametrize("delays", [6, [5] * 11 + [6], [8] * 12], ids=str)
def test_schedule_slower_than_the_terminal_law_is_refused(delays: int | list[int]) -> None:
    with pytest.raises(DesignError, match=r"schedule\.delays: the schedule is slower than the terminal law") as refused:
        check_schedule(paper(delays=delays, link=GOOD_LINK))
    assert refused.value.key == "schedule.delays"


def test_no_feedback_at_all_is_refused() -> None:
    with pytest.raises(DesignError, match="slower than the terminal law"):
        check_schedule(paper(delays=12))


def test_room_has_a_feasible_schedule_and_one_delay_too_long_at_stage_7_has_none() -> None:
    assert check_schedule(room()) > 0.05
    assert check_schedule(room(**TAU_3)) > 0.05
    with pytest.raises(DesignError, match=r"s\* = -"):
        check_schedule(room(**TAU_3 | {"delays": [5] * 9 + [4] * 3}))


def test_undisturbed_axis_is_no_obstacle() -> None:
    disturbed = check_schedule(paper())
    assert check_schedule(paper(plant=paper_plant(w=np.diag([0.6, 0.0])))) == pytest.approx(disturbed, abs=1e-6)


def test_terminal_condition_with_a_singular_transition_is_reduced_again() -> None:
    """K A⁻¹ B = 0 makes F singular: s* of the plain condition is 0, yet there is a feasible interior."""
    plant = paper_plant()
    position = -0.058
    drive = np.linalg.solve(plant.a, plant.b)[:2, 0]
    gain = np.kron(np.eye(2), [[position, -position * drive[0] / drive[1]]])
    wide = Polytope.from_box([-300.0, -80.0] * 2, [300.0, 80.0] * 2)
    design = paper(k_tau=gain, state_set=wide, input_set=Polytope.from_box([-75.0] * 2, [75.0] * 2))
    horizon = Horizon(decompose(design)[0], 12, 4, design.schedule)
    bound = terminal_bound(horizon)
    assert (bound.rows, bound.fixed.offset.size) == (5, bound.columns)
    assert check_schedule(design) > 1e-4
    # The oracle is the limit of slightly larger bounds, which have an interior; the printed form drowns here.
    exact = ConicSolver(design).solve(0, START, ORIGIN)
    relaxed = []
    for share in (1e-3, 1e-6):
        larger = replace(design.terminal, sigma_z=(1 + share) * design.terminal.sigma_z)
        relaxed.append(ConicSolver(replace(design, terminal=larger)).solve(0, START, ORIGIN).cost)
    assert relaxed[0] < relaxed[1] < exact.cost
    assert exact.cost == pytest.approx(relaxed[1], rel=1e-6)


def test_optimal_cost_is_the_papers_and_none_where_constraints_are_relaxed() -> None:
    design = paper()
    assert optimal_cost(design, START) == pytest.approx(PAPER_COST, abs=0.01)
    for outside in ([80.0, 60.0, 0.0, 0.0], [48.0, 7.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 0.0]):
        assert optimal_cost(design, np.array(outside)) is None
    assert optimal_cost(paper(delays=6), ORIGIN) is None


def test_the_margin_of_a_design_is_computed_once_for_all_its_states(monkeypatch: pytest.MonkeyPatch) -> None:
    designs: list[Design] = []

    def counted(design: Design) -> float:
        designs.append(design)
        return check_schedule(design)

    monkeypatch.setattr(feasibility, "check_schedule", counted)
    good, slow = paper(), paper(delays=6)
    for share in (1.0, 0.5, 0.1):
        assert optimal_cost(good, share * START) is not None
    for share in (1.0, 0.5):
        assert optimal_cost(slow, share * START) is None
    assert designs == [good, slow]


def test_search_takes_the_cheapest_of_its_candidates() -> None:
    spec = replace(paper_spec(), horizon=9, rule="search", search_states=np.array([[5.0, -1.0, -3.0, 1.0]]))
    costs: list[float | None] = []

    def cost_of(design: object, x: object) -> float | None:
        costs.append(optimal_cost(design, x))  # type: ignore[arg-type]  # make_design's own arguments
        return costs[-1]

    chosen = make_design(spec, cost_of)
    known = [cost for cost in costs if cost is not None]
    assert len(costs) > 1
    assert optimal_cost(chosen, spec.search_states[0]) == min(known)
