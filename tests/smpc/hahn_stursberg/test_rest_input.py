"""Redundant inputs: Assumption 4.4 is checked at the cheapest rest input, which plans use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plant_cases import Model, Shape, spec_of
from scipy.optimize import linprog

from uavctl.errors import DesignError
from uavctl.smpc.answer import Answer
from uavctl.smpc.hahn_stursberg.design import DesignSpec, make_design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.smpc.hahn_stursberg.synthesis import synthesize, terminal_factors
from uavctl.smpc.sets import Polytope, find_equilibrium_input

# At 2 m the spring pulls with 1, which the inputs share as u_1 + u_2 / 2 = 1. Of those the cheapest, with weights of
# 100 and 1, is u_1 = 0.01 / 0.26, u_2 = 0.5 / 0.26; the smallest is (0.8, 0.4).
PLACE_M = (2.0, 0.0, 0.0)
CHEAPEST = np.array([0.01, 0.5]) / 0.26
FITS_CHEAPEST, FITS_SMALLEST = [0.5, 2.6], [1.5, 1.2]


def spring(rng: np.random.Generator) -> Model:
    """One axis on a spring, with two inputs."""
    del rng
    f, g = np.array([[0.0, 1.0], [-0.5, -0.6]]), np.array([[0.0, 0.0], [1.0, 0.5]])
    return Model(f, g, np.array([[0.0], [1.0]]), np.array([[0.002]]), (0,), (1,))


def requested(sides: list[float], target_m: tuple[float, float, float] = PLACE_M) -> DesignSpec:
    return replace(
        spec_of(Shape("spring", spring, horizon=8, tau=1, seed=3)),
        q_u=np.diag([100.0, 1.0]),
        state_set=Polytope.from_box([-4.0, -4.0], [4.0, 4.0]),
        input_set=Polytope.from_box([-side for side in sides], sides),
        target_m=target_m,
    )


def at_place(case: DesignSpec) -> Answer:
    design = make_design(case)
    x = case.plant.equilibrium(PLACE_M)
    return ConicSolver(design).solve(0, x, x)


def some_rest_fits(case: DesignSpec) -> bool:
    """Whether any input holds the target within the limits."""
    x = case.plant.equilibrium(PLACE_M)
    limits = list(zip(*np.split(case.input_set.b, 2), strict=True))
    result = linprog(
        np.zeros(2), A_eq=case.plant.b, b_eq=x - case.plant.a @ x, bounds=[(-lower, upper) for upper, lower in limits]
    )
    return bool(result.status == 0)


def test_the_rest_input_is_the_cheapest() -> None:
    case = requested(FITS_CHEAPEST)
    x, (a, b) = case.plant.equilibrium(PLACE_M), (case.plant.a, case.plant.b)
    result = find_equilibrium_input(a, b, case.q_u, x)
    assert result == pytest.approx(CHEAPEST, rel=1e-9)
    assert a @ x + b @ result == pytest.approx(x, rel=1e-9, abs=1e-12)


def test_a_target_that_the_cheapest_rest_input_holds_is_accepted_and_held() -> None:
    case = requested(FITS_CHEAPEST)
    answer = at_place(case)
    assert answer.offset < 1e-6 and answer.slack < 1e-6
    assert answer.inputs[-1] == pytest.approx(CHEAPEST, rel=1e-5)
    design = make_design(case)
    (item,) = [check for check in design.assumptions if check.item == "4.4"]
    assert item.ok and item.limit == pytest.approx(min(0.5 - CHEAPEST[0], 2.6 - CHEAPEST[1]), rel=1e-9)


def test_a_target_that_only_more_expensive_inputs_hold_is_refused() -> None:
    case = requested(FITS_SMALLEST)
    assert some_rest_fits(case)
    with pytest.raises(DesignError, match=r"Assumption 4\.4 fails.*upper limit of input 1"):
        make_design(case)
    kappa_x, kappa_u = terminal_factors(case)
    x = case.plant.equilibrium(PLACE_M)
    limits = (case.state_set, case.input_set, x, kappa_x, kappa_u)
    with pytest.raises(DesignError, match="leaves no margin"):
        synthesize(case.plant, case.tau, case.q_x, case.q_u, *limits)
    # From a design for another target: the plan ends as near as its rest input allows.
    assert at_place(requested(FITS_SMALLEST, (0.0, 0.0, 0.0))).offset > 0.1
