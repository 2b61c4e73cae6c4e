"""Cells: the grid and its order, who is refused, what runs meet, who flies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from campaign_rig import cells, controller, read, table

from uavctl.config import load_config
from uavctl.lab.campaign.arrivals import compute_newest_captures
from uavctl.lab.campaign.controllers import (
    TUNING_FIRST,
    RunConditions,
    build_from_recipe,
    draw_conditions,
    get_controller,
    get_start_state,
)
from uavctl.lab.campaign.draws import draw
from uavctl.lab.campaign.spec import CHUNK
from uavctl.lab.campaign.tasks import describe_cell, make_cells, make_document, make_tasks
from uavctl.lab.campaign.world import simulate
from uavctl.smpc.baselines import Lqg, PacketisedPredictive, WorstCaseDelay
from uavctl.smpc.batch import BatchSmpc
from uavctl.smpc.hahn_stursberg.design import kappa
from uavctl.wiring.controller import build_problem

LINKS = table("link", "good", 'set = ["link.loss=0.1"]') + table("link", "bad", 'set = ["link.loss=0.6"]')
WEAK = table("plant", "weak", 'set = ["plant.b=[[0.1, 0.0], [0.2, 0.0], [0.0, 0.1], [0.0, 0.2]]"]')


def test_the_grid_is_the_product_in_the_order_given(tmp_path: Path) -> None:
    made_cells = cells(
        tmp_path,
        controller("lqg"),
        controller("hold-last"),
        LINKS,
        table("disturbance", "a"),
        table("plant", "b"),
        WEAK,
    )
    assert [cell.index for cell in made_cells] == list(range(8))
    assert [cell.names[:2] + cell.names[3:] for cell in made_cells[:5]] == [
        ("lqg", "good", "b"),
        ("lqg", "good", "weak"),
        ("lqg", "bad", "b"),
        ("lqg", "bad", "weak"),
        ("hold-last", "good", "b"),
    ]
    # One recipe for all cells with the same controller that believes the same.
    assert len({id(cell.recipe) for cell in made_cells}) == 4
    assert len({cell.recipe.key for cell in made_cells if cell.recipe}) == 4


def test_a_margin_may_be_tuned_for_a_link(tmp_path: Path) -> None:
    tuning = '[[tuning]]\ncontrollers = ["governor"]\nlinks = ["bad"]\nmargin = 2.25\n'
    good, bad = cells(tmp_path, controller("governor", "margin = 1.5"), LINKS, tuning)
    assert [made_cell.recipe.margin for made_cell in (good, bad) if made_cell.recipe] == [1.5, 2.25]


def test_the_flown_link_and_the_believed_one_may_differ(tmp_path: Path) -> None:
    first, weak = cells(tmp_path, controller("lqg", 'link = "good"'), LINKS, table("plant", "b"), WEAK)[2:]
    assert first.recipe is weak.recipe and weak.recipe is not None
    assert weak.recipe.config.link.loss == 0.1 and weak.setting.link.loss == 0.6
    assert draw_conditions(first.setting, 0, 1).world.plant.b[1, 0] == 0.39
    assert draw_conditions(weak.setting, 0, 1).world.plant.b[1, 0] == 0.2
    assert build_problem(weak.recipe.config).plant.b[1, 0] == 0.39


def test_a_design_that_is_refused_costs_its_cells_only(tmp_path: Path) -> None:
    links = table("link", "as printed") + table("link", "bad", 'set = ["link.loss=0.6"]')
    campaign = read(tmp_path, controller("smpc"), controller("lqg"), links)
    made_cells = make_cells(campaign)
    assert [bool(cell.refused) for cell in made_cells] == [False, True, False, False]
    assert made_cells[1].refused.startswith("smpc.delta_x: 0.95 is out of reach") and made_cells[1].recipe is None
    assert {task.cell for task in make_tasks(made_cells)} == {0, 2, 3}
    cell_records = make_document(campaign, made_cells).cells
    assert cell_records[1].refused == made_cells[1].refused and cell_records[1].design_id is None
    assert cell_records[0].promised_x == pytest.approx(0.05) and cell_records[0].link_loss == 0.3
    assert cell_records[2].promised_x is None and cell_records[2].kind == "lqg"


def test_a_plant_that_cannot_be_flown_is_refused_too(tmp_path: Path) -> None:
    negative = 'set = ["plant.a=[[1.0, 0.79, 0.0, 0.0], [0.0, -0.6, 0.0, 0.0], [0, 0, 1, 0.79], [0, 0, 0, 0.61]]"]'
    (made_cells,) = cells(tmp_path, controller("lqg"), table("plant", "none", negative))
    assert made_cells.refused.startswith("plant.a: A has no real logarithm") and made_cells.recipe is None


def test_every_cell_has_the_same_draws(tmp_path: Path) -> None:
    lines = 'steps = 9\nmaster = 5\nset = ["plant.w=[[0.5, 0.1], [0.1, 0.3]]"]\n'
    made_cells = cells(tmp_path, lines, controller("lqg"), controller("hold-last"), LINKS)
    one, other = (draw_conditions(cell.setting, 3, 4) for cell in (made_cells[0], made_cells[2]))
    np.testing.assert_array_equal(one.disturbances, other.disturbances)
    np.testing.assert_array_equal(one.newest_captures, other.newest_captures)
    # A worse link loses what the better one loses, and more.
    assert (draw_conditions(made_cells[1].setting, 3, 4).newest_captures <= one.newest_captures).all()
    chances = draw(5, 3, 4, 9, 2)
    np.testing.assert_array_equal(
        one.newest_captures, compute_newest_captures(made_cells[0].setting.link, 1.0, chances.link)
    )
    root = np.linalg.cholesky(np.array([[0.5, 0.1], [0.1, 0.3]]))
    whitened = one.disturbances @ np.linalg.inv(root).T
    turn = whitened.reshape(-1, 2).T @ np.linalg.pinv(chances.normal.reshape(-1, 2).T)
    np.testing.assert_allclose(turn @ turn.T, np.eye(2), atol=1e-9)  # any two roots differ by a rotation
    np.testing.assert_array_equal(draw_conditions(made_cells[0].setting, 4, 1).disturbances[0], one.disturbances[1])


def test_runs_start_at_the_configured_states(tmp_path: Path) -> None:
    def starts(line: str) -> RunConditions:
        (made_cells,) = cells(tmp_path, line, controller("lqg"))
        return draw_conditions(made_cells.setting, 2, 50)

    np.testing.assert_array_equal(starts("").world.start, np.tile([35.0, -2.0, -20.0, -4.0], (50, 1)))
    np.testing.assert_array_equal(starts("start = [1, 2, 3, 4]\n").world.start[7], [1, 2, 3, 4])
    box = starts("start_box = [[-1, 0, 5, 0], [1, 2, 5, 8]]\n")
    drawn = box.world.start
    assert (drawn >= [-1, 0, 5, 0]).all() and (drawn <= [1, 2, 5, 8]).all()
    assert (drawn[:, 2] == 5).all() and len(np.unique(drawn[:, 0])) == 50
    assert drawn.mean(axis=0) == pytest.approx([0, 1, 5, 4], abs=1.2)
    (made_cells,) = cells(tmp_path, "start_box = [[-1, 0, 5, 0], [1, 2, 5, 8]]\n", controller("lqg"))
    np.testing.assert_array_equal(draw_conditions(made_cells.setting, 9, 1).world.start[0], drawn[7])
    np.testing.assert_array_equal(get_start_state(made_cells.setting.spec, made_cells.setting.base), [0, 1, 5, 4])
    # The draws of where runs start leave the others as they are.
    np.testing.assert_array_equal(box.disturbances, starts("").disturbances)


@pytest.mark.slow
def test_every_kind_of_controller_flies(tmp_path: Path) -> None:
    kinds = ("smpc", "lqg", "packetised", "worst-case-delay", "hold-last", "zero-on-loss", "pid")
    made_cells = cells(tmp_path, "steps = 6\n", *(controller(kind) for kind in kinds))
    assert [cell.kind for cell in made_cells] == list(kinds) and not any(cell.refused for cell in made_cells)
    recipes = [cell.recipe for cell in made_cells if cell.recipe is not None]
    assert isinstance(build_from_recipe(recipes[0]), BatchSmpc) and isinstance(build_from_recipe(recipes[1]), Lqg)
    assert recipes[6].gains is not None
    assert describe_cell(made_cells[6]).gains == {
        name: getattr(recipes[6].gains, name).tolist()
        for name in ("position_1ps", "velocity_1ps", "integral_1ps2", "derivative", "speed")
    }
    assert get_controller(recipes[1]) is get_controller(recipes[1])
    assert get_controller(recipes[2]) is not get_controller(recipes[1])


def test_the_worst_case_delay_is_tau_with_the_promised_likelihoods(tmp_path: Path) -> None:
    (made_cells,) = cells(tmp_path, 'set = ["smpc.tau=3"]\n', controller("worst-case-delay"))
    config, recipe = load_config("paper", ["smpc.tau=3"]), made_cells.recipe
    assert recipe is not None
    expected_controller, problem = build_from_recipe(recipe), build_problem(config)
    expected = WorstCaseDelay(problem, 3, kappa(0.95, 4, 8, "ellipsoid"), kappa(0.9, 2, 4, "ellipsoid"))
    conditions = draw_conditions(made_cells.setting, 0, 5)
    one, other = (
        simulate(conditions.world, tested, conditions.newest_captures, conditions.disturbances)
        for tested in (expected_controller, expected)
    )
    np.testing.assert_array_equal(one.inputs, other.inputs)


def test_a_margin_acts_on_the_plans_of_its_controllers(tmp_path: Path) -> None:
    made_cells = cells(
        tmp_path, controller("packetised"), controller("packetised", "margin = 3.0").replace('d"\n', 'd2"\n', 1)
    )
    conditions = draw_conditions(made_cells[0].setting, 0, 5)
    without, expected_controller = (
        simulate(conditions.world, build_from_recipe(cell.recipe), conditions.newest_captures, conditions.disturbances)
        for cell in made_cells
        if cell.recipe
    )
    expected = PacketisedPredictive(build_problem(load_config("paper")), 3.0)
    np.testing.assert_array_equal(
        expected_controller.inputs,
        simulate(conditions.world, expected, conditions.newest_captures, conditions.disturbances).inputs,
    )
    assert np.abs(expected_controller.inputs - without.inputs).max() > 0.1


def test_tasks_are_fixed_chunks_and_no_task_has_tuning_runs(tmp_path: Path) -> None:
    made_cells = cells(tmp_path, f"runs = {2 * CHUNK + 7}\n", controller("lqg"), LINKS)
    tasks = list(make_tasks(made_cells))
    assert [(task.cell, task.first, task.runs) for task in tasks] == [
        (cell, first, runs) for cell in (0, 1) for first, runs in ((0, CHUNK), (CHUNK, CHUNK), (2 * CHUNK, 7))
    ]
    names = [task.name for task in tasks]
    assert names == sorted(names) and len(set(names)) == 6
    assert TUNING_FIRST >= 10_000_000  # the most runs that a specification may ask for
