"""Campaigns of flights of the quadrotor: read, flown, kept, resumed, summed up."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import pyarrow.parquet as pq
import pytest

from uavctl.cli.app import run
from uavctl.errors import ConfigError
from uavctl.lab.campaign import trials as trial_cells
from uavctl.lab.campaign.store import Store, make_table
from uavctl.lab.campaign.trial_page import render_trial_report
from uavctl.lab.campaign.trials import (
    CHUNK,
    SCHEMA,
    TrialTask,
    get_flight_seed,
    is_trial_file,
    make_trial_cells,
    make_trial_document,
    make_trial_tasks,
    read_trial,
    summarise_trial,
)
from uavctl.lab.trial import TrialCell, TrialFlight, fly_trial

RUNS = CHUNK + 1  # two tasks a cell
HEAD = f"""
name = "small"
world = "quadrotor"
config = "room-hahn-stursberg"
set = ["smpc.scheme=age-conditioned", "link.loss=0.4"]
runs = {RUNS}
seconds = 2.0
from_s = 1.0
scenario = ["hold", "blackout"]
autopilot = ["ardupilot"]
rate_hz = [20.0]
"""
OWN = '[[controller]]\nname = "own loop"\nkind = "own-loop"\ntuned = true\n'
OURS = '[[controller]]\nname = "ours"\nkind = "smpc"\n'
REFUSED = '[[controller]]\nname = "too sure"\nkind = "smpc"\nset = ["smpc.horizon=3", "smpc.delta_x=0.99999999999"]\n'


def written(folder: Path, text: str) -> Path:
    file = folder / "small.toml"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign flown by one worker."""
    folder = tmp_path_factory.mktemp("trials")
    spec = written(folder, HEAD + OWN + OURS + REFUSED)
    assert run(["campaign", str(spec), "--workers", "1", "--out", str(folder / "one")]) == 0
    return folder / "one"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + OWN + OWN, 'controller[1].name: "own loop" is there twice'),
        (HEAD + OWN + 'set = ["smpc.horizon=10"]\n', "the vehicle's own loop has no design"),
        (HEAD + OURS + "tuned = true\n", "controller[0].tuned"),
        (HEAD + OURS + 'set = ["smpc.horizonn=10"]\n', "smpc.horizonn"),
        (HEAD + OWN + '[[link]]\nname = "x"\nset = ["cost.input=[1]"]\n', "is no key of [link]"),
        (HEAD.replace("from_s = 1.0", "from_s = 2.0") + OWN, "from_s: 2 s is not within the flight"),
        (HEAD.replace('"hold", ', '"loop", ') + OWN, "scenario"),
        (HEAD + "steps = 4\n" + OWN, "steps"),
    ],
)
def test_problems_of_a_trial_file_are_reported_with_their_keys(tmp_path: Path, text: str, message: str) -> None:
    file = written(tmp_path, text)
    assert is_trial_file(file)
    with pytest.raises(ConfigError) as caught:
        read_trial(file)
    assert message in str(caught.value) and str(file) in str(caught.value)


def test_every_controller_has_the_same_seeds_and_link(tmp_path: Path) -> None:
    spec, _ = read_trial(written(tmp_path, HEAD + OWN + OURS))
    places = make_trial_cells(spec)
    assert [(place.cell.scenario, place.cell.pilot.name) for place in places] == [
        ("hold", "own loop"), ("hold", "ours"), ("blackout", "own loop"), ("blackout", "ours")
    ]  # fmt: skip
    tasks = list(make_trial_tasks(spec, places))
    assert [(task.cell, task.first, task.runs) for task in tasks] == [
        (c, f, r) for c in range(4) for f, r in ((0, 5), (5, 1))
    ]
    assert len({get_flight_seed(spec.master, i) for i in range(1000)}) == 1000
    assert get_flight_seed(0, 3) != get_flight_seed(1, 3)
    (position_loop_cell, _), (controller_cell, _) = places[:2]
    assert controller_cell.usable_room is not None and 0.3 < controller_cell.usable_room < 1.0
    assert (position_loop_cell.usable_room, position_loop_cell.design_id) == (None, None)


@pytest.mark.slow
def test_the_table_equals_separate_flights(flown: Path) -> None:
    rows = pq.read_table(flown / "runs.parquet").to_pylist()
    assert [(row["cell"], row["run"]) for row in rows] == [(c, i) for c in (0, 1, 3, 4) for i in range(RUNS)]
    assert not any(row["error"] for row in rows)
    spec, _ = read_trial(flown.parent / "small.toml")
    cell = make_trial_cells(spec)[1].cell
    single = fly_trial(cell, get_flight_seed(spec.master, 5), seconds=2.0, from_s=1.0)
    row = next(row for row in rows if (row["cell"], row["run"]) == (1, 5))
    for name in (*trial_cells.FLOAT_COLUMNS, "positions", "mode", "seed"):
        assert row[name] == getattr(single, name) or np.isnan(row[name]), name


@pytest.mark.slow
def test_an_interrupted_campaign_continues_to_the_same_bytes(flown: Path, tmp_path: Path) -> None:
    path = flown.parent / "small.toml"
    spec, text = read_trial(path)
    places = make_trial_cells(spec)
    tasks, store = list(make_trial_tasks(spec, places)), Store(tmp_path / "two", SCHEMA)
    with store.open(make_trial_document(spec, places), text, resume=False):
        for task in tasks[3::-2]:
            store.keep(task, task.fly())
    assert run(["campaign", str(path), "--workers", "2", "--out", str(store.folder), "--resume"]) == 0
    names = sorted(path.name for path in (flown / "runs.parquet").iterdir())
    assert len(names) == len(tasks) and sorted(path.name for path in store.table.iterdir()) == names
    for name in names:
        assert (store.table / name).read_bytes() == (flown / "runs.parquet" / name).read_bytes()
    assert run(["campaign", str(path), "--runs", "2", "--out", str(store.folder), "--resume"]) != 0


def test_an_error_of_a_flight_is_recorded_and_the_others_continue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(cell: TrialCell, seed: int, *, seconds: float, from_s: float) -> TrialFlight:
        if seed == get_flight_seed(0, 1):
            raise RuntimeError("no more")
        return TrialFlight(seed, hold_rms_m=0.5, mode="GUIDED")

    spec, _ = read_trial(written(tmp_path, HEAD + OWN))
    task = next(make_trial_tasks(spec, make_trial_cells(spec)))
    monkeypatch.setattr(trial_cells, "fly_trial", fails)
    rows = make_table(task.fly(), SCHEMA).to_pylist()
    assert [row["error"] for row in rows] == ["", "RuntimeError: no more", "", "", ""]
    assert [row["hold_rms_m"] for row in rows] == pytest.approx([0.5, np.nan, 0.5, 0.5, 0.5], nan_ok=True)
    dead = make_table(replace(task, runs=2).make_lost_rows("it died"), SCHEMA).to_pylist()
    assert [(row["run"], row["error"]) for row in dead] == [(0, "it died"), (1, "it died")]


@pytest.mark.slow
def test_the_summary_has_the_medians_and_the_worst_of_the_table(flown: Path) -> None:
    rows = pq.read_table(flown / "runs.parquet").to_pylist()
    message, cells = summarise_trial(flown)
    assert [cell.place.refused[:12] for cell in cells] == ["", "", "smpc.horizon"] * 2
    for cell in cells:
        cell_rows = [row for row in rows if row["cell"] == cell.place.index]
        assert (cell.runs, cell.failed) == (len(cell_rows), 0)
        if cell_rows:
            holds = [row["hold_rms_m"] for row in cell_rows]
            assert cell.median["hold_rms_m"] == median(holds) and cell.worst["hold_rms_m"] == max(holds)
            assert cell.modes == {"GUIDED": RUNS}
    page = render_trial_report(message, cells)
    assert "own loop" in page and "Not flown, or failed" in page and "too sure" in page
    beyond_m = max(row["beyond_m"] for row in rows if np.isfinite(row["beyond_m"]))
    assert (f"had {-beyond_m:.2f} m left" if beyond_m <= 0.0 else f"the furthest by {beyond_m:.2f} m") in page


@pytest.mark.slow
def test_trials_have_a_json_document_and_are_no_campaign_of_runs(
    flown: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = flown.parent / "small.toml"
    capsys.readouterr()
    assert run(["campaign", str(path), "--out", str(flown), "--resume", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [cell["place"]["controller"] for cell in document["cells"]] == ["own loop", "ours", "too sure"] * 2


def test_a_task_s_name_sorts_as_its_rows() -> None:
    names = [TrialTask(cell, first, 1, None, 1.0, 0.0, 0).name for cell in (0, 9, 10) for first in (0, 5, 95)]  # type: ignore[arg-type]
    assert names == sorted(names)
