"""The folder of a campaign: parts, the table in the end, and what may go on there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from campaign_rig import cells, controller, table

from uavctl.errors import UavctlError, UsageError
from uavctl.lab.campaign.spec import CHUNK
from uavctl.lab.campaign.store import SCHEMA, Store, first_difference, table_of
from uavctl.lab.campaign.tasks import Task, flown, tasks_of

TWO = table("link", "a") + table("link", "b", 'set = ["link.loss=0.5"]')
CELLS = [{"index": 0, "controller": "lqg", "link": "a"}, {"index": 1, "controller": "lqg", "link": "b"}]
DOCUMENT = {"name": "one", "runs": 3, "cells": CELLS}


@pytest.fixture
def given(tmp_path: Path) -> list[Task]:
    return list(tasks_of(cells(tmp_path, f"steps = 3\nruns = {CHUNK + 4}\n", controller("lqg"), TWO)))


def test_the_table_is_sorted_whatever_the_order_of_the_tasks(tmp_path: Path, given: list[Task]) -> None:
    files = []
    for name, order in (("one", given), ("other", given[::-1])):
        store = Store(tmp_path / name)
        with store.opened(DOCUMENT, "text", resume=False):
            for task in order:
                store.keep(task, task.fly())
            assert store.kept(given) == {task.name for task in given} and not store.complete()
            files.append(store.finish(given))
        assert store.complete() and not (tmp_path / name / "parts").exists()
    assert files[0].read_bytes() == files[1].read_bytes()
    found = pq.read_table(files[0])
    assert found.schema.names == ["cell", "controller", "link", *SCHEMA.names[1:]]
    assert set(zip(*(found[name].to_pylist() for name in ("cell", "controller", "link")), strict=True)) == {
        (0, "lqg", "a"), (1, "lqg", "b"),
    }  # fmt: skip
    assert list(found["cell"].to_numpy()) == [0] * (CHUNK + 4) + [1] * (CHUNK + 4)
    assert list(found["run"].to_numpy()) == [*range(CHUNK + 4)] * 2
    make_whole_component = given[1].fly()
    row = found.slice(CHUNK + 2, 1).to_pylist()[0]
    assert row["cost"] == make_whole_component["cost"][2] and row["run"] == CHUNK + 2 and row["error"] == ""
    ages = [int(count) for count in make_whole_component["ages"][2]]
    assert row["ages"] == ages[: row["max_age"] + 1] and not any(ages[row["max_age"] + 1 :])


def test_rows_without_figures_are_kept(given: list[Task]) -> None:
    rows = table_of(given[1].lost("it died")).to_pylist()
    assert len(rows) == 4 and rows[0]["error"] == "it died" and rows[0]["ages"] == []
    assert np.isnan(rows[0]["cost"]) and rows[0]["steps"] == 0


def test_a_part_that_is_damaged_is_named(tmp_path: Path, given: list[Task]) -> None:
    store = Store(tmp_path / "one")
    with store.opened(DOCUMENT, "text", resume=False):
        for task in given:
            store.keep(task, task.fly())
        part = tmp_path / "one" / "parts" / f"{given[1].name}.parquet"
        part.write_bytes(part.read_bytes()[:-20])
        with pytest.raises(UavctlError, match=rf"{given[1].name}\.parquet is damaged.*remove it"):
            store.finish(given)


def test_only_the_same_campaign_goes_on_and_only_if_it_is_asked_to(tmp_path: Path) -> None:
    store = Store(tmp_path / "one")
    with pytest.raises(UsageError, match="leave out --resume"), store.opened(DOCUMENT, "text", resume=True):
        pass
    with store.opened(DOCUMENT, "text", resume=False):
        assert (tmp_path / "one" / "campaign.toml").read_text() == "text"
        with pytest.raises(UsageError, match="another process"), Store(store.folder).opened(DOCUMENT, "text", True):
            pass
    with pytest.raises(UsageError, match="go on with it by --resume"), store.opened(DOCUMENT, "text", resume=False):
        pass
    with store.opened(DOCUMENT, "text", resume=True):
        pass
    other = {**DOCUMENT, "cells": [{"index": 1, "controller": "lqg", "link": "a"}, *CELLS[1:]]}
    with (
        pytest.raises(UsageError, match=r"cells\[0\]\.index is 0 there and 1 here"),
        store.opened(other, "text", resume=True),
    ):
        pass


def test_the_first_difference_is_told() -> None:
    one = {"a": 1, "b": {"c": [1, {"d": "x"}]}, "e": None}
    assert first_difference(one, {**one}) is None
    assert first_difference(one, {**one, "b": {"c": [1, {"d": "y"}]}}) == 'b.c[1].d is "x" there and "y" here'
    assert first_difference(one, {**one, "b": {"c": [1]}}) == 'b.c is [1,{"d":"x"}] there and [1] here'
    assert first_difference({}, {"f": 2}) == "f is null there and 2 here"


def test_a_folder_that_cannot_be_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UavctlError, match="file"), Store(tmp_path / "file").opened(DOCUMENT, "text", resume=False):
        pass


def test_a_run_alone_is_that_of_its_chunk(tmp_path: Path) -> None:
    made = cells(tmp_path, f"steps = 6\nruns = {CHUNK + 4}\nmaster = 2\n", controller("lqg"), controller("smpc"), TWO)
    task = list(tasks_of(made))[3]
    assert (task.cell, task.first, task.runs) == (1, CHUNK, 4)
    found, _ = flown(task, CHUNK + 2, 1)
    assert found.cost.shape == (1, 6)
    assert found.cost.sum() == pytest.approx(task.fly()["cost"][2], rel=1e-12)
