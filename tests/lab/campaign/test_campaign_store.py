"""The folder of a campaign: the files of its table, and what may go on there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from campaign_rig import cells, controller, table
from msgspec.structs import replace

from uavctl.errors import UavctlError, UsageError
from uavctl.lab.campaign.results import SCHEMA, CampaignRecord, CellRecord
from uavctl.lab.campaign.spec import CHUNK
from uavctl.lab.campaign.store import Store, find_first_difference, make_table
from uavctl.lab.campaign.tasks import Task, fly_task, make_tasks

TWO = table("link", "a") + table("link", "b", 'set = ["link.loss=0.5"]')
CELLS = [
    CellRecord(index=index, controller="lqg", link=link, kind="lqg", refused="") for index, link in enumerate("ab")
]
DOCUMENT = CampaignRecord(name="one", uavctl_version="9.9", master=0, runs=3, spec={}, configuration="", cells=CELLS)


@pytest.fixture
def tasks(tmp_path: Path) -> list[Task]:
    return list(make_tasks(cells(tmp_path, f"steps = 3\nruns = {CHUNK + 4}\n", controller("lqg"), TWO)))


def test_the_table_is_sorted_whatever_the_order_of_the_tasks(tmp_path: Path, tasks: list[Task]) -> None:
    written = []
    for name, order in (("one", tasks), ("other", tasks[::-1])):
        store = Store(tmp_path / name)
        with store.open(DOCUMENT, "text", resume=False):
            for task in order:
                store.keep(task, task.fly())
            assert store.find_finished(tasks) == {task.name for task in tasks}
        written.append({path.name: path.read_bytes() for path in store.table.iterdir()})
    assert written[0] == written[1] and len(written[0]) == len(tasks)
    figures = pq.read_table(tmp_path / "one" / "runs.parquet")
    assert figures.schema.names == ["cell", "controller", "link", *SCHEMA.names[1:]]
    assert set(zip(*(figures[name].to_pylist() for name in ("cell", "controller", "link")), strict=True)) == {
        (0, "lqg", "a"), (1, "lqg", "b"),
    }  # fmt: skip
    assert list(figures["cell"].to_numpy()) == [0] * (CHUNK + 4) + [1] * (CHUNK + 4)
    assert list(figures["run"].to_numpy()) == [*range(CHUNK + 4)] * 2
    columns = tasks[1].fly()
    row = figures.slice(CHUNK + 2, 1).to_pylist()[0]
    assert row["cost"] == columns["cost"][2] and row["run"] == CHUNK + 2 and row["error"] == ""
    ages = [int(count) for count in columns["ages"][2]]
    assert row["ages"] == ages[: row["max_age"] + 1] and not any(ages[row["max_age"] + 1 :])


def test_rows_without_figures_are_kept(tasks: list[Task]) -> None:
    rows = make_table(tasks[1].make_lost_rows("it died")).to_pylist()
    assert len(rows) == 4 and rows[0]["error"] == "it died" and rows[0]["ages"] == []
    assert np.isnan(rows[0]["cost"]) and rows[0]["steps"] == 0


def test_only_the_same_campaign_continues_and_only_with_resume(tmp_path: Path) -> None:
    store = Store(tmp_path / "one")
    with pytest.raises(UsageError, match="leave out --resume"), store.open(DOCUMENT, "text", resume=True):
        pass
    with store.open(DOCUMENT, "text", resume=False):
        assert (tmp_path / "one" / "campaign.toml").read_text() == "text"
        with pytest.raises(UsageError, match="another process"), Store(store.folder).open(DOCUMENT, "text", True):
            pass
    with pytest.raises(UsageError, match="continue it with --resume"), store.open(DOCUMENT, "text", resume=False):
        pass
    with store.open(DOCUMENT, "text", resume=True):
        pass
    other = replace(DOCUMENT, cells=[replace(CELLS[0], index=1), *CELLS[1:]])
    with (
        pytest.raises(UsageError, match=r"cells\[0\]\.index is 0 there and 1 here"),
        store.open(other, "text", resume=True),
    ):
        pass


def test_the_first_difference_is_described() -> None:
    one = {"a": 1, "b": {"c": [1, {"d": "x"}]}, "e": None}
    assert find_first_difference(one, {**one}) is None
    assert find_first_difference(one, {**one, "b": {"c": [1, {"d": "y"}]}}) == 'b.c[1].d is "x" there and "y" here'
    assert find_first_difference(one, {**one, "b": {"c": [1]}}) == 'b.c is [1,{"d":"x"}] there and [1] here'
    assert find_first_difference({}, {"f": 2}) == "f is null there and 2 here"


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UavctlError, match="file"), Store(tmp_path / "file").open(DOCUMENT, "text", resume=False):
        pass


def test_a_single_run_equals_that_of_its_chunk(tmp_path: Path) -> None:
    campaign_cells = cells(
        tmp_path, f"steps = 6\nruns = {CHUNK + 4}\nmaster = 2\n", controller("lqg"), controller("smpc"), TWO
    )
    task = list(make_tasks(campaign_cells))[3]
    assert (task.cell, task.first, task.runs) == (1, CHUNK, 4)
    figures, _ = fly_task(task, CHUNK + 2, 1)
    assert figures.cost.shape == (1, 6)
    assert figures.cost.sum() == pytest.approx(task.fly()["cost"][2], rel=1e-12)
