"""[plant], [sets], [cost] and [link] are a complete configuration; a plant needs no room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import uavctl
from uavctl.config import dump_config, load, parse
from uavctl.errors import ConfigError, DesignError
from uavctl.records import SolveStatus
from uavctl.wiring.controller import build_controller, build_problem

ONE = ("a = [[0.9]]\nb = [[0.1]]\ne = [[0.1]]\ndt_s = 1.0", 1, 1)
ONE_BY_TWO = ("a = [[0.9]]\nb = [[0.1, 0.2]]\ne = [[0.1]]\ndt_s = 1.0", 1, 2)
TWO = ("a = [[1, 0.1], [0, 1]]\nb = [[0.005], [0.1]]\ne = [[0.005], [0.1]]\nw = [[0.01]]\ndt_s = 0.1", 2, 1)
FOUR = (
    "a = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 0.9, 0.2], [0, 0, -0.1, 0.8]]\n"
    "b = [[0, 0], [0.1, 0], [0, 0], [0, 0.1]]\ne = [[0.1, 0], [0.1, 0], [0, 0.1], [0, 0]]\ndt_s = 0.1",
    4,
    2,
)
SINGULAR = ("a = [[0, 0], [1, 0]]\nb = [[1], [0]]\ne = [[0.01], [0]]\ndt_s = 0.1", 2, 1)
UNSTABLE = ("a = [[1.2]]\nb = [[1.0]]\ne = [[0.01]]\ndt_s = 0.1", 1, 1)
ALL = (ONE, ONE_BY_TWO, TWO, FOUR, SINGULAR, UNSTABLE)


def text(
    plant: tuple[str, int, int], state: tuple[str, str] = ("-5", "5"), given: tuple[str, str] = ("-9", "9")
) -> str:
    rows, n_x, n_u = plant

    def each(value: str, count: int) -> str:
        return f"[{', '.join([value] * count)}]"

    return (
        f"[plant]\n{rows}\n[sets]\nstate_lower = {each(state[0], n_x)}\nstate_upper = {each(state[1], n_x)}\n"
        f"input_lower = {each(given[0], n_u)}\ninput_upper = {each(given[1], n_u)}\n"
        f"[cost]\nstate = {each('1.0', n_x)}\ninput = {each('0.1', n_u)}\n[link]\nloss = 0.3\n"
    )


@pytest.mark.parametrize("plant", ALL)
def test_four_tables_are_planned_for_and_simulated(plant: tuple[str, int, int], tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text(plant))
    config = uavctl.load(path)
    assert config.name == "mine"
    start = [0.5] * plant[1]
    plan = uavctl.solve(config, start)
    assert plan.status is SolveStatus.OPTIMAL
    assert np.abs(plan.states[-1]).max() < 0.25  # towards the origin
    flown = uavctl.simulate(config, runs=3, steps=5, start=start)
    assert flown.states.shape == (3, 6, plant[1])
    assert np.isfinite(flown.cost).all()


def test_what_is_filled_in_is_kept() -> None:
    made = parse(text(TWO), "mine.toml").config
    assert parse(dump_config(made), "other.toml").config == made


def test_a_flight_of_a_plant_without_axes_is_refused_by_one_key() -> None:
    with pytest.raises(DesignError) as refused:
        build_controller(parse(text(TWO), "mine.toml").config)
    assert refused.value.key == "plant.axes"


AXES = 'axes = ["north"]\nposition_index = [0]\nvelocity_index = [1]\naccel_per_input = [2.0]\n[sets]'


def test_a_plant_with_axes_has_a_controller_and_its_gate() -> None:
    config = parse(text(TWO).replace("[sets]", AXES), "mine.toml").config
    assert config.limits.accel_mps2[0] == 18.0  # 9 units of 2 m/s² each
    assert config.daemon.tick_s == pytest.approx(0.1)
    assert build_controller(config).plant.axes == ("north",)


@pytest.mark.parametrize(
    ("given", "key"),
    [
        (text(TWO).replace("[sets]", 'axes = ["north"]\n[sets]'), "plant.axes"),
        (text(TWO).replace("[sets]", "position_index = [0]\n[sets]"), "plant.axes"),
        (text(TWO).replace("dt_s = 0.1", ""), "plant.dt_s"),
        (text(TWO).replace("[[0.01]]", "[[-0.01]]"), "plant.w"),
        (text(TWO, state=("5", "-5")), "sets.state_lower[0]"),
        (text(TWO).split("[cost]")[0], "cost"),
    ],
)
def test_one_thing_that_is_wrong_is_one_error(given: str, key: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse(given, "mine.toml")
    assert refused.value.problems[0].split(": ")[1] == key
    assert len({problem.split(": ")[1].partition("[")[0] for problem in refused.value.problems}) == 1


def test_where_zero_is_no_input_the_plant_rests_elsewhere_within_its_limits() -> None:
    config = parse(text(ONE, given=("0.5", "3")), "mine.toml").config
    problem = build_problem(config)
    plant, u = problem.plant, problem.u_target
    np.testing.assert_allclose(plant.a @ problem.target + plant.b @ u, problem.target, atol=1e-9)
    assert 0.5 <= float(u[0]) <= 3.0
    assert uavctl.solve(config, [0.0]).status is SolveStatus.OPTIMAL


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (["sets.input_lower=[0.5,-1.5,-1.5]"], "sets.input_lower[0]"),
        (["sets.input_upper=[2.0,-0.5,1.5]"], "sets.input_upper[1]"),
    ],
)
def test_a_vehicle_that_no_input_holds_is_refused(overrides: list[str], key: str) -> None:
    with pytest.raises(DesignError) as refused:
        build_problem(load("room", overrides).config)
    assert refused.value.key == key


@pytest.mark.parametrize("free", [(6, 7, 8), tuple(range(9))])
def test_axes_without_any_limit_have_a_plan(free: tuple[int, ...]) -> None:
    room = uavctl.load("room")
    sides = {
        side: [sign * np.inf if i in free else value for i, value in enumerate(getattr(room.sets, side))]
        for side, sign in (("state_lower", -1), ("state_upper", 1))
    }
    plan = uavctl.solve(uavctl.load(room, sets=sides), [0, 0, 0, 0, 0, 0, -1, 0, 0])
    assert plan.status is SolveStatus.OPTIMAL
    assert np.isfinite(plan.states).all()
