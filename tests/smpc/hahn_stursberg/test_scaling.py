"""Units change nothing, tolerances hold, and far states have answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from optimisation_cases import ORIGIN, ROOM_CORNER, ROOM_TARGET, START, paper, paper_plant, paper_spec, room
from plant_cases import SHAPES, case, kept
from plant_units import Units, design_in_units, in_units

from uavctl.arrays import Array
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer
from uavctl.smpc.hahn_stursberg import cones as conic_settings
from uavctl.smpc.hahn_stursberg.design import Design, make_design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.smpc.sets import equilibrate

SHORT = [shape.name for shape in SHAPES if shape.horizon <= 12]


def difference(item: Array, other: Array) -> float:
    """Largest difference as a share of the largest number."""
    return float(np.abs(item - other).max() / max(float(np.abs(other).max()), 1e-300))


# --- units ------------------------------------------------------------------------------------------------------------


def same_plan(name: str, units: Units, *, inputs: float = 1e-6) -> None:
    made = case(name)
    design = design_in_units(made.design, units)
    answer = ConicSolver(design).solve(0, made.x * units.state, design.target)
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.cost / units.cost == pytest.approx(made.answer.cost, rel=1e-7)
    assert difference(answer.inputs / units.input, made.answer.inputs) < inputs
    assert difference(answer.states / units.state, made.answer.states) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", SHORT)
def test_a_change_of_units_changes_nothing(name: str) -> None:
    plant = case(name).design.plant
    # What inputs that push alike do against one another is known to the root of the gap only.
    inputs = 1e-4 if name.startswith("redundant") else 1e-6
    same_plan(name, Units.of(plant, 1e3, 1e-3, 1e6), inputs=inputs)
    same_plan(name, Units.drawn(plant, 0), inputs=inputs)


@pytest.mark.parametrize(
    ("state", "input", "cost"), [(1e3, 1, 1), (1e-3, 1, 1), (1, 1e-3, 1), (1, 1, 1e6), (1, 1, 1e-6)]
)
def test_each_unit_alone(state: float, input: float, cost: float) -> None:
    for name in ("coupled 0", "H = 20, tau = 10"):
        same_plan(name, Units.of(case(name).design.plant, state, input, cost))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_prices_are_per_unit_and_are_converted_with_it(seed: int) -> None:
    """A start outside the limits, so that slack and terminal miss are paid for, with the paper's plant."""
    rng = np.random.default_rng(seed)
    units = Units.of(paper_plant(), *(float(10.0 ** rng.uniform(-3, 3)) for _ in range(3)))
    spec = paper_spec()
    converted = in_units(spec, units)
    assert converted.slack_linear == pytest.approx(spec.slack_linear * units.cost / units.state[0])
    here, there = ConicSolver(make_design(spec)), ConicSolver(make_design(converted))
    for x in (np.array([0.0, 14.0, 0.0, 0.0]), np.array([80.0, 60.0, -3.0, 1.0]), np.array([30.0, 5.0, -40.0, -9.0])):
        item, other = here.solve(0, x, ORIGIN), there.solve(0, x * units.state, ORIGIN)
        assert {item.status, other.status} == {SolveStatus.OPTIMAL}
        assert item.slack + item.terminal_miss > 0.1
        assert other.cost / units.cost == pytest.approx(item.cost, rel=1e-7)
        assert (other.slack + other.terminal_miss) / units.state[0] == pytest.approx(
            item.slack + item.terminal_miss, rel=1e-5
        )
        assert difference(other.inputs / units.input, item.inputs) < 1e-5


def test_equilibrated_matrices_have_unit_rows_and_columns_in_any_units() -> None:
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(4, 3)) * 10.0 ** rng.uniform(-6, 6, (4, 1)) * 10.0 ** rng.uniform(-6, 6, 3)
    matrix[2] = 0.0
    rows, columns = equilibrate(matrix)
    scaled = np.abs(matrix * np.outer(rows, columns))
    assert scaled.max(axis=0) == pytest.approx(np.ones(3), abs=1e-4)
    assert scaled.max(axis=1) == pytest.approx([1.0, 1.0, 0.0, 1.0], abs=1e-4)


def test_parts_of_a_step_are_exact_in_any_units() -> None:
    plant = case("free chain 0").design.plant
    scale = np.array([1e3, 1e-3, 1.0, 1e6])
    other = replace(
        plant, a=scale[:, None] * plant.a / scale, b=1e4 * scale[:, None] * plant.b, e=scale[:, None] * plant.e
    )
    for item, two in zip(plant.transition(0.4 * plant.dt_s), other.transition(0.4 * plant.dt_s), strict=True):
        factor = scale[:, None] if two.shape[1] != 4 else scale[:, None] / scale
        factor = 1e4 * factor if two.shape[1] == 1 else factor
        np.testing.assert_allclose(two / factor, item, atol=1e-11)


# --- tolerances and far states ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coupled 2", "lagged 1", "more disturbances than inputs", "H = 20, tau = 10"])
def test_a_tighter_tolerance_gives_the_same_optimum(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Regularisation and tolerance of the solver move the optimum by less than 1e-6."""
    made = case(name)
    monkeypatch.setattr(conic_settings, "GAP_TOLERANCE", 1e-9)
    tight = ConicSolver(made.design).solve(0, made.x, made.design.target)
    assert tight.status is SolveStatus.OPTIMAL
    assert abs(tight.gap) < 1e-8
    assert made.answer.cost == pytest.approx(tight.cost, rel=1e-7)
    assert made.answer.cost_lower <= tight.cost * (1 + 1e-8)


def far(design: Design, x: Array, target: Array) -> list[Answer]:
    solver = ConicSolver(design)
    return [solver.solve(0, target + scale * (x - target), target) for scale in 10.0 ** np.arange(1, 7)]


@pytest.mark.parametrize(
    ("design", "x", "target"), [(paper(), START, ORIGIN), (room(), ROOM_CORNER, ROOM_TARGET)], ids=["paper", "room"]
)
def test_states_up_to_a_million_times_outside_have_an_answer(design: Design, x: Array, target: Array) -> None:
    for answer in far(design, x, target):
        assert answer.status is SolveStatus.OPTIMAL
        assert design.input_set.margin(answer.inputs[0]).min() >= 0.0
        assert answer.terminal_miss > 1.0
        assert answer.relaxed
        # At full thrust against the way it has to go.
        shifted = answer.inputs[0] * (target - x)[list(design.plant.position_index)]
        assert shifted[0] > 0.0


def test_a_target_far_away_is_approached() -> None:
    solver = ConicSolver(paper())
    near = solver.solve(0, ORIGIN, np.array([1e3, 0.0, 0.0, 0.0]))
    for distance in (1e4, 1e5, 1e6):
        answer = solver.solve(0, ORIGIN, np.array([distance, 0.0, 0.0, 0.0]))
        assert answer.status is SolveStatus.OPTIMAL
        assert answer.reference == pytest.approx(near.reference, abs=1e-3)


def test_a_hard_answer_is_the_same_for_any_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    """The origin of large numbers is not part of the problem."""
    made = case("coupled 0")
    monkeypatch.setattr("uavctl.smpc.sets._ACCURATE_SIZES", 0.0)
    shifted = ConicSolver(made.design).solve(0, made.x, made.design.target)
    assert kept(shifted)
    assert shifted.cost == pytest.approx(made.answer.cost, rel=1e-7)
    assert difference(shifted.inputs, made.answer.inputs) < 1e-4
