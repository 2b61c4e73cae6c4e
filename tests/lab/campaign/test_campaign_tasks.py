"""Tasks: the figures of each run, runs that crash, and crews whose workers die."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from campaign_rig import cells, controller, table

from uavctl.lab.campaign import controllers, spec
from uavctl.lab.campaign.controllers import build_from_recipe, draw_conditions
from uavctl.lab.campaign.pool import Columns, Work, fly_tasks
from uavctl.lab.campaign.tasks import Task, make_tasks
from uavctl.lab.campaign.world import simulate
from uavctl.smpc.batch import BatchSmpc, Information

FIGURES = ("cost", "settled_cost", "mean_square_input", "largest_gap")
# B of preset paper a million times stronger: whatever is asked for drives the state out of all numbers.
WILD = 'set = ["plant.a=[[1e7, 0, 0, 0], [0, 1e7, 0, 0], [0, 0, 1e7, 0], [0, 0, 0, 1e7]]"]'


def task(folder: Path, *parts: str) -> Task:
    return next(make_tasks(cells(folder, *parts)))


def test_figures_are_those_of_the_runs(tmp_path: Path) -> None:
    one = task(tmp_path, "steps = 11\nruns = 7\n", controller("smpc"))
    columns = one.fly()
    smpc, meets = build_from_recipe(one.recipe), draw_conditions(one.setting, 0, 7)
    flown = simulate(meets.world, smpc, meets.newest_captures, meets.disturbances)
    assert isinstance(smpc, BatchSmpc)
    assert set(columns["error"]) == {""}
    for i in range(7):
        x, u = flown.states[i], flown.inputs[i]
        stage = [10 * s[0] ** 2 + 0.1 * s[1] ** 2 + 10 * s[2] ** 2 + 0.1 * s[3] ** 2 for s in x[:-1]]
        stage = [a + 0.1 * float(b @ b) for a, b in zip(stage, u, strict=True)]
        assert columns["cost"][i] == pytest.approx(sum(stage), rel=1e-12)
        assert columns["settled_cost"][i] == pytest.approx(np.mean(stage[5:]), rel=1e-12)
        assert columns["mean_square_input"][i] == pytest.approx(np.mean([float(b @ b) for b in u]), rel=1e-12)
        low, high = np.array([-30, -8, -25, -8]), np.array([50, 7, 20, 8])
        assert columns["state_violations"][i] == sum(((s < low) | (s > high)).any() for s in x[1:])
        assert columns["saturated"][i] == sum((np.abs(b) >= 7.5 - 1e-6).any() for b in u)
        assert list(columns["ages"][i]) == [list(flown.age[i]).count(a) for a in range(11)]
        assert columns["age_sum"][i] == flown.age[i].sum() and columns["max_age"][i] == flown.age[i].max()
    np.testing.assert_array_equal(columns["decisions"], smpc.tally.decisions)
    np.testing.assert_array_equal(columns["largest_gap"], smpc.tally.largest_gap)
    assert all(columns["saturated"]) and (columns["run"] == np.arange(7)).all()


def test_a_controller_that_counts_nothing_has_no_gap(tmp_path: Path) -> None:
    columns = task(tmp_path, "steps = 5\nruns = 3\n", controller("lqg")).fly()
    assert np.isnan(columns["largest_gap"]).all() and not columns["decisions"].any()
    assert np.isfinite(columns["cost"]).all() and (columns["steps"] == 5).all()


def test_infinite_numbers_are_an_error(tmp_path: Path) -> None:
    columns = task(tmp_path, "steps = 60\nruns = 3\n", controller("lqg"), table("plant", "wild", WILD)).fly()
    assert set(columns["error"]) == {"ended in numbers that are not finite"}
    assert all(np.isnan(columns[name]).all() for name in FIGURES)
    assert not columns["steps"].any() and not columns["ages"].any()


class Crashing:
    """A controller that raises in the run which starts furthest out."""

    def __init__(self, limit: float) -> None:
        self._limit = limit

    def begin(self, runs: int) -> None: ...

    def act(self, measurement: Information) -> np.ndarray:
        if measurement.step == 0 and (measurement.state[:, 0] > self._limit).any():
            raise ZeroDivisionError("out of range")
        return np.zeros((len(measurement.state), 2))


def test_an_error_of_a_run_is_recorded_and_the_others_continue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = "start_box = [[0, 0, 0, 0], [10, 0, 0, 0]]\nsteps = 2\nruns = 40\n"
    one = task(tmp_path, box, controller("lqg"))
    starts = draw_conditions(one.setting, 0, 40).world.start[:, 0]
    limit = float(np.sort(starts)[-3])
    monkeypatch.setattr(controllers, "build_from_recipe", lambda recipe: Crashing(limit))
    columns = replace(one, recipe=replace(one.recipe, key="crashing")).fly()
    out = starts > limit
    assert out.sum() == 2
    assert list(columns["error"][out]) == ["ZeroDivisionError: out of range"] * 2
    assert set(columns["error"][~out]) == {""}
    assert np.isfinite(columns["cost"][~out]).all() and np.isnan(columns["cost"][out]).all()
    np.testing.assert_array_equal(columns["run"], np.arange(40))


def test_a_controller_that_cannot_be_built_loses_its_runs_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(recipe: object) -> None:
        raise OSError("no such file")

    one = task(tmp_path, "steps = 2\nruns = 4\n", controller("lqg"))
    monkeypatch.setattr(controllers, "build_from_recipe", none)
    columns = replace(one, recipe=replace(one.recipe, key="none")).fly()
    assert list(columns["error"]) == ["OSError: no such file"] * 4


class DeadError(Exception):
    """A worker died."""


class FakeCrew:
    """Two workers; a task that is named in `deadly` takes them with it, that many times."""

    size = 2

    def __init__(self, deadly: dict[str, int]) -> None:
        self.deadly, self.renewed = dict(deadly), 0
        self.submitted: list[str] = []
        self._broken = False

    def submit(self, task: Work) -> Future[Columns]:
        future: Future[Columns] = Future()
        self.submitted.append(task.name)
        if self.deadly.get(task.name, 0):
            self.deadly[task.name] -= 1
            self._broken = True
        if self._broken:
            future.set_exception(DeadError())
        else:
            future.set_result(task.make_lost_rows(""))
        return future

    def is_worker_death(self, error: BaseException) -> bool:
        return isinstance(error, DeadError)

    def restart(self) -> None:
        self.renewed += 1
        self._broken = False


def never() -> bool:
    return False


def several(folder: Path) -> list[Task]:
    return list(make_tasks(cells(folder, f"runs = {5 * spec.CHUNK}\n", controller("lqg"))))


@pytest.mark.parametrize("deaths", [1, 2])
def test_a_worker_that_dies_costs_at_most_the_task_that_kills_it(tmp_path: Path, deaths: int) -> None:
    tasks, kept_tasks = several(tmp_path), dict[str, str]()
    crew = FakeCrew({tasks[1].name: deaths})
    fly_tasks(tasks, crew, lambda task, columns: kept_tasks.update({task.name: str(columns["error"][0])}), never)
    assert sorted(kept_tasks) == [task.name for task in tasks]
    expected = "the worker died, twice" if deaths == 2 else ""
    assert kept_tasks.pop(tasks[1].name) == expected
    assert set(kept_tasks.values()) == {""} and crew.renewed == deaths


def test_a_stop_keeps_pending_tasks(tmp_path: Path) -> None:
    tasks, kept_tasks = several(tmp_path), list[str]()
    is_stopped: Callable[[], bool] = lambda: len(kept_tasks) >= 1  # noqa: E731
    fly_tasks(tasks, FakeCrew({}), lambda task, columns: kept_tasks.append(task.name), is_stopped)
    assert 1 <= len(kept_tasks) <= 4 and len(kept_tasks) < len(tasks)


def test_another_error_than_a_dead_worker_is_raised(tmp_path: Path) -> None:
    class Broken(FakeCrew):
        def is_worker_death(self, error: BaseException) -> bool:
            return False

    with pytest.raises(DeadError):
        fly_tasks(several(tmp_path), Broken({"00000-00000000": 1}), lambda task, columns: None, never)
