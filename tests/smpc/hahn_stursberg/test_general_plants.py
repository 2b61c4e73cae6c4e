"""Plants of many shapes: the exact program against the problem written again, and redundancy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from optimisation_cases import START, paper_plant, paper_spec
from plant_cases import NAMED, SHAPES, case, kept, sampled, spec_of
from plant_oracle import margins, reduced_cost
from scipy.linalg import block_diag

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL
from uavctl.smpc.hahn_stursberg.components import decompose, make_whole_component
from uavctl.smpc.hahn_stursberg.design import make_design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver, PartSolver
from uavctl.smpc.hahn_stursberg.horizon import make_horizon
from uavctl.smpc.hahn_stursberg.printed import PrintedProblem, PrintedSolver
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import find_equilibria

# Those that the printed form solves at all: elsewhere its empty interior makes it end inaccurate or not.
PRINTED = (
    "coupled 0", "three coupled axes", "more disturbances than states, coupled", "free chain 0", "anchored chain 0",
    "lagged 0", "H = 4, tau = 1",
)  # fmt: skip


def kron(left: Array, right: Array) -> Array:
    return np.asarray(np.kron(left, right), dtype=np.float64)


@pytest.mark.long
@pytest.mark.parametrize("name", NAMED)
def test_cost_is_that_of_the_problem_written_down_again_and_every_row_is_kept(name: str) -> None:
    made = case(name)
    assert abs(made.answer.gap) < 1e-7
    assert made.answer.cost == pytest.approx(reduced_cost(made.design, made.x), rel=1e-6)
    minimum = margins(made.design, made.solver, made.x)
    assert {row: margin for row, margin in minimum.items() if margin < -1e-6} == {}


@pytest.mark.long
@pytest.mark.parametrize("name", PRINTED)
def test_cost_is_that_of_the_printed_problem(name: str) -> None:
    made = case(name)
    printed = PrintedSolver(made.design).solve(0, made.x, made.design.target)
    assert printed.status is SolveStatus.OPTIMAL
    assert made.answer.cost == pytest.approx(printed.cost, rel=1e-6)


@pytest.mark.slow
def test_the_printed_form_of_an_axis_that_nothing_disturbs() -> None:
    made = case("calm axis, no column")
    calm, windy = sorted(decompose(made.design), key=lambda part: part.e.shape[1])
    assert (calm.e.shape[1], windy.e.shape[1]) == (0, 1)
    printed = PrintedProblem(made.design, calm).solve(made.x, made.design.target)
    exact = PartSolver(made.design, calm).solve(made.x, made.design.target, NOMINAL)
    assert printed.status is SolveStatus.OPTIMAL
    assert printed.cost == pytest.approx(exact.cost, rel=1e-6)
    assert printed.inputs == pytest.approx(exact.inputs, abs=1e-4)
    assert not printed.backoff_x.any() and not printed.backoff_u.any()
    # The whole problem, whose other axis may end inaccurate: it is as good as that one.
    assert PrintedSolver(made.design).solve(0, made.x, made.design.target).cost == pytest.approx(
        made.answer.cost, rel=1e-5
    )


@pytest.mark.slow
def test_shapes_cover_all_kinds() -> None:
    plants = {shape.name: case(shape.name).design for shape in SHAPES if shape.horizon <= 20}
    assert any(design.plant.n_w > design.plant.n_x for design in plants.values())
    assert any(design.plant.n_w < design.plant.n_u for design in plants.values())
    assert any(design.plant.n_u > len(design.plant.axes) for design in plants.values())
    assert any(design.plant.n_u < len(design.plant.axes) for design in plants.values())
    assert any(np.linalg.matrix_rank(design.plant.e) < design.plant.n_w for design in plants.values())
    assert any(np.linalg.matrix_rank(design.plant.w) < design.plant.n_w for design in plants.values())
    assert {shape.horizon for shape in SHAPES} >= {4, 40}
    assert {shape.tau for shape in SHAPES} == set(range(1, 11)) - {9}


# --- redundancy -------------------------------------------------------------------------------------------------------


def test_disturbances_without_effect_on_the_state_are_not_fed_back() -> None:
    made = case("repeated disturbance 0")
    horizon = make_horizon(made.design, make_whole_component(made.design))
    # w_1 and 2 w_2 push alike and w_3 not at all: one number is known of the three.
    assert horizon.feedback.shape == (1, 3)
    assert horizon.feedback[0] / horizon.feedback[0, 0] == pytest.approx([1.0, 2.0, 0.0], abs=1e-9)
    assert horizon.feedback @ made.design.plant.w @ horizon.feedback.T == pytest.approx(np.eye(1), abs=1e-9)
    # It is the plant with one disturbance of the same covariance.
    plant = made.design.plant
    alike = np.array([1.0, 2.0, 0.0])
    single = replace(plant, e=plant.e[:, :1], w=np.atleast_2d(alike @ plant.w @ alike))
    answer = ConicSolver(make_design(replace(made.spec, plant=single))).solve(0, made.x, made.design.target)
    assert answer.cost == pytest.approx(made.answer.cost, rel=1e-8)


def test_parallel_inputs_share_the_effort_by_their_cost() -> None:
    made = case("redundant inputs 1")
    plant = made.design.plant
    calm = make_design(replace(made.spec, plant=replace(plant, w=0.0 * plant.w)))
    inputs = ConicSolver(calm).solve(0, 0.1 * made.x, calm.target).inputs[0]
    # Without active limits the share of an input is its effect over its price.
    share = inputs * np.diagonal(made.design.q_u) / plant.b[0]
    assert share == pytest.approx(np.full(3, share[0]), rel=1e-3)
    assert decompose(made.design)[0].u_eq.tolist() == [[0.0]] * 3


def test_inputs_at_rest_cost_the_least_of_those_that_hold_the_place() -> None:
    # A spring to the origin; u_1 + 2 u_2 = 1 holds p = 1. Lagrange: u_i = g_i / q_i · 1 / Σ g² / q.
    a = np.array([[1.0, 0.5], [-0.3, 0.6]])
    b = np.array([[0.0, 0.0], [0.3, 0.6]])
    result = find_equilibria(a, b, np.eye(2), np.diag([1.0, 2.0]), np.array([0]))
    assert result.x_eq == pytest.approx(np.array([[1.0], [0.0]]), abs=1e-12)
    assert result.u_eq[:, 0] == pytest.approx(np.array([1.0, 1.0]) / 3.0)
    # An input that costs nothing beside the other does it all.
    free = find_equilibria(a, b, np.eye(2), np.diag([1.0, 0.0]), np.array([0]))
    assert free.u_eq[:, 0] == pytest.approx([0.0, 0.5])


def test_a_chain_rests_where_its_spring_does_and_goes_to_the_nearest_such_place() -> None:
    made = case("free chain 0")
    (part,) = decompose(made.design)
    assert part.x_eq[:, 0] == pytest.approx([1.0, 0.0, 1.0, 0.0], abs=1e-9)
    solver = ConicSolver(made.design)
    difference = np.array([0.2, 0.0, -0.1, 0.0])
    weight = np.diagonal(made.design.q_x)[[0, 2]]
    between = weight @ difference[[0, 2]] / weight.sum()
    answer = solver.solve(0, np.zeros(4), difference)
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.reference == pytest.approx(between * np.array([1.0, 0.0, 1.0, 0.0]), abs=1e-6)


@pytest.mark.parametrize("name", ["free chain 0", "anchored chain 0"])
def test_a_target_that_cannot_be_held_names_the_axes(name: str) -> None:
    spec = case(name).spec
    with pytest.raises(DesignError, match=r"target\.position_m: .*no input holds north, east by itself"):
        make_design(replace(spec, target_m=(0.1, 0.0, 0.0)))


def test_an_axis_that_no_input_holds_is_named_alone() -> None:
    spring = np.array([[0.0, 1.0], [-1.0, -0.5]])
    model = NAMED["coupled 0"].model(np.random.default_rng(0))
    one_input = replace(model, f=block_diag(np.array([[0.0, 1.0], [0.0, -0.5]]), spring), g=np.eye(4)[:, 1:2])
    plant = sampled(one_input, 0.5)
    assert plant.equilibrium((3.0, 0.0, 0.0)).tolist() == [3.0, 0.0, 0.0, 0.0]
    with pytest.raises(DesignError, match="no input holds east by itself"):
        plant.equilibrium((3.0, 1.0, 0.0))


def test_a_plant_that_needs_more_steps_than_it_has_is_refused() -> None:
    spec = spec_of(NAMED["free chain 0"])
    with pytest.raises(DesignError, match=r"smpc\.tau: .*from any state to the target it takes 4"):
        make_design(replace(spec, horizon=4, delays=2))


def test_acceleration_of_inputs_that_are_not_one_an_axis() -> None:
    plant = case("redundant inputs 0").design.plant
    gain = plant.accel_map[0]
    assert plant.to_accel(np.array([1.0, 2.0])) == pytest.approx((gain[0] + 2.0 * gain[1], 0.0, 0.0))
    # The smallest input with this acceleration is along the gains.
    assert plant.to_input((3.0, 0.0, 0.0)) == pytest.approx(3.0 * gain / (gain @ gain))
    square = paper_plant()
    assert square.accel_map.tolist() == [[0.494, 0.0], [0.0, 0.494]]
    with pytest.raises(DesignError, match=r"plant\.accel_per_input: shape \(1, 3\) is not \(1, 2\)"):
        replace(plant, accel_per_input=np.ones((1, 3)))


def test_a_plant_of_six_axes_in_three_names() -> None:
    """Axes without a name rest at the origin of theirs."""
    item = paper_plant()
    plant = Plant(
        a=kron(np.eye(2), item.a),
        b=kron(np.eye(2), item.b),
        e=kron(np.eye(2), item.e),
        w=0.6 * np.eye(4),
        dt_s=1.0,
        axes=("north", "east"),
        position_index=(0, 2),
        velocity_index=(1, 3),
        accel_per_input=np.hstack([0.494 * np.eye(2), np.zeros((2, 2))]),
    )
    spec = paper_spec()
    double = replace(
        spec,
        plant=plant,
        state_set=replace(spec.state_set, c=kron(np.eye(2), spec.state_set.c), b=2.0 * np.tile(spec.state_set.b, 2)),
        input_set=replace(spec.input_set, c=kron(np.eye(2), spec.input_set.c), b=np.tile(spec.input_set.b, 2)),
        q_x=kron(np.eye(2), spec.q_x),
        q_u=kron(np.eye(2), spec.q_u),
        k_tau=kron(np.eye(2), spec.k_tau),
        search_states=np.zeros((0, 8)),
        delta_u=0.85,
    )
    design = make_design(double)
    parts = decompose(design)
    assert [part.held.tolist() for part in parts] == [[0]] * 4
    answer = ConicSolver(design).solve(0, np.tile(0.3 * START, 2), np.zeros(8))
    assert kept(answer)
    assert answer.inputs[:, :2] == pytest.approx(answer.inputs[:, 2:], abs=1e-6)
