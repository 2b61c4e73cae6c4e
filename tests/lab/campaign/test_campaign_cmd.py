"""`uavctl campaign` as it is typed: the same table however it is flown, and whatever ends it half way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from campaign_rig import HEAD, controller, table

from uavctl.cli import campaign_run
from uavctl.cli.app import run
from uavctl.lab.campaign.spec import CHUNK

LIMIT_S = 120.0
RAISING = """
import numpy as np

class Raising:
    def __init__(self, problem):
        self.n_u = problem.plant.n_u

    def begin(self, runs):
        self.runs = runs

    def act(self, information):
        if information.step:
            raise KeyError(f"gain of step {information.step}")
        return np.zeros((self.runs, self.n_u))
"""
RUNS = CHUNK + 3  # two tasks a cell
SPEC = (
    HEAD
    + f"steps = 6\nruns = {RUNS}\n"
    + controller("smpc")
    + controller("lqg")
    + table("link", "as printed")
    + table("link", "bad", 'set = ["link.loss=0.6"]')
    + table("disturbance", "heavy", 'kind = "heavy"')
)
KEYS = [
    "controller", "link", "disturbance", "plant", "runs", "failed", "violation_rate", "violation_ci",
    "run_violation_rate", "run_violation_ci", "cost", "cost_ci", "fallbacks", "max_age", "refused",
]  # fmt: skip


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("campaign") / "small.toml"
    file.write_text(SPEC, encoding="utf-8")
    return file


@pytest.fixture(scope="module")
def flown(spec: Path) -> Path:
    """A campaign flown by one worker."""
    folder = spec.parent / "one"
    assert run(["campaign", str(spec), "--workers", "1", "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a real scheduler with two real worker processes."""
    from distributed import LocalCluster  # a quarter of a second, in each process that collects this file

    with LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        yield str(cluster.scheduler_address)


def contents(folder: Path) -> dict[str, bytes]:
    assert sorted(path.name for path in folder.iterdir()) == [
        ".lock", "campaign.json", "campaign.toml", "report.html", "runs.parquet"
    ]  # fmt: skip
    return {path.name: path.read_bytes() for path in sorted((folder / "runs.parquet").iterdir())}


HELD = """
import sys
from uavctl.lab.campaign.store import Store
from uavctl.cli.app import run

def keep_and_wait(store, task, columns):
    keep(store, task, columns)
    Store.keep = keep
    print("kept", flush=True)
    sys.stdin.read()

if __name__ == "__main__":
    keep, Store.keep = Store.keep, keep_and_wait
    sys.exit(run(sys.argv[1:]))
"""


def started(spec: Path, folder: Path, workers: int) -> subprocess.Popen[str]:
    """A campaign in a process group of its own that has kept one task, and goes on once nobody speaks to it."""
    script = folder.parent / "held.py"
    script.write_text(HELD, encoding="utf-8")
    line = [sys.executable, str(script), "campaign", str(spec), "--workers", str(workers), "--out", str(folder)]
    pipe = subprocess.PIPE
    process = subprocess.Popen(line, start_new_session=True, text=True, stdin=pipe, stdout=pipe, stderr=pipe)
    assert process.stdout is not None and process.stdout.readline() == "kept\n"
    return process


@pytest.mark.slow
def test_one_worker_gives_every_run_in_order(flown: Path) -> None:
    assert contents(flown)
    stored_runs = pq.read_table(flown / "runs.parquet")
    cells, runs = stored_runs["cell"].to_numpy(), stored_runs["run"].to_numpy()
    assert list(dict.fromkeys(cells.tolist())) == [0, 2, 3]  # the SMPC of the bad link is refused
    assert all((runs[cells == cell] == range(RUNS)).all() for cell in (0, 2, 3))
    assert set(stored_runs["error"].to_pylist()) == {""}


@pytest.mark.slow
def test_two_workers_give_the_same(spec: Path, flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["campaign", str(spec), "--workers", "2", "--out", str(tmp_path / "two"), "--json"]) == 0
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert contents(tmp_path / "two") == contents(flown)
    text: dict[str, Any] = json.loads(out)
    assert text.keys() == {"schema", "name", "runs_file", "report", "wall_s", "cells"} and text["name"] == "small"
    assert text["runs_file"] == str(tmp_path / "two" / "runs.parquet") and Path(text["report"]).exists()
    assert all(list(cell)[: len(KEYS)] == KEYS for cell in text["cells"])
    smpc, refused, lqg, _ = text["cells"]
    assert (smpc["runs"], smpc["failed"], smpc["refused"]) == (RUNS, 0, "")
    assert refused["runs"] == 0 and refused["refused"].startswith("smpc.delta_x") and refused["cost"] is None
    assert smpc["cost_ci"][0] < smpc["cost"] < smpc["cost_ci"][1]
    assert smpc["violation_rate"] <= lqg["violation_rate"] and lqg["violation_ci"][0] <= lqg["violation_rate"]


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same(spec: Path, flown: Path, tmp_path: Path, scheduler: str) -> None:
    assert run(["campaign", str(spec), "--dask", scheduler, "--out", str(tmp_path / "dask")]) == 0
    assert contents(tmp_path / "dask") == contents(flown)


@pytest.mark.slow
def test_killed_half_way_and_resumed_it_gives_the_same(spec: Path, flown: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    process = started(spec, folder, workers=1)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=LIMIT_S)
    part_times = {path: path.stat().st_mtime_ns for path in folder.glob("runs.parquet/*.parquet")}
    assert process.returncode == -signal.SIGKILL and len(part_times) == 1
    assert run(["campaign", str(spec), "--out", str(folder)]) == 2  # not without --resume
    assert {path: path.stat().st_mtime_ns for path in folder.glob("runs.parquet/*.parquet")} == part_times
    assert run(["campaign", str(spec), "--workers", "1", "--out", str(folder), "--resume"]) == 0
    assert contents(folder) == contents(flown)


@pytest.mark.slow
def test_ctrl_c_ends_it_and_names_the_command_to_continue(spec: Path, tmp_path: Path) -> None:
    folder = tmp_path / "stopped"
    process = started(spec, folder, workers=2)
    os.killpg(process.pid, signal.SIGINT)
    _, text = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130 and "interrupted" in text and "Traceback" not in text
    assert text.strip().splitlines()[-1] == f"uavctl campaign {spec} --out {folder} --resume"
    assert list(folder.glob("runs.parquet/*.parquet")) and not (folder / "report.html").exists()


def test_ctrl_c_before_the_first_run_leaves_no_campaign(
    spec: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(campaign_run, "make_cells", interrupted)
    assert run(["campaign", str(spec), "--out", str(tmp_path / "none")]) == 130
    assert "interrupted before the first run" in capsys.readouterr().err and not (tmp_path / "none").exists()


@pytest.mark.slow
def test_another_campaign_does_not_go_on(spec: Path, flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["campaign", str(spec), "--runs", "4", "--out", str(flown), "--resume"]) == 2
    assert f"runs is {RUNS} there and 4 here" in capsys.readouterr().err
    before = contents(flown)
    assert run(["campaign", str(spec), "--out", str(flown), "--resume"]) == 0  # complete: only the page is made
    assert contents(flown) == before


@pytest.mark.slow
def test_fewer_runs_and_a_table_for_people(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    wild = 'set = ["plant.a=[[1e7, 0, 0, 0], [0, 1e7, 0, 0], [0, 0, 1e7, 0], [0, 0, 0, 1e7]]"]'
    (tmp_path / "c.toml").write_text(
        HEAD + "steps = 100\n" + controller("lqg") + table("plant", "as modelled") + table("plant", "wild", wild)
    )
    monkeypatch.chdir(tmp_path)
    assert run(["campaign", "c.toml", "--runs", "12", "--workers", "1"]) == 0
    out = capsys.readouterr().out
    (folder,) = (tmp_path / "flights").iterdir()
    assert folder.name.endswith("-small") and f"flights/{folder.name}/runs.parquet" in out
    assert "wild" in out and "as modelled" in out and "disturbance" not in out
    rows = pq.read_table(folder / "runs.parquet").to_pylist()
    assert len(rows) == 24 and {bool(row["error"]) for row in rows if row["cell"] == 0} == {False}
    assert {row["error"] for row in rows if row["cell"] == 1} == {"ended in numbers that are not finite"}


def test_the_first_reason_of_failed_runs_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "raising_controllers.py").write_text(RAISING)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "c.toml").write_text(
        HEAD + "steps = 3\nruns = 3\n" + controller("lqg") + '[[controller]]\nname = "own"\n'
        'kind = "raising_controllers:Raising"\n'
    )
    assert run(["campaign", str(tmp_path / "c.toml"), "--workers", "1", "--out", str(tmp_path / "out")]) == 0
    assert "own: KeyError: 'gain of step 1'" in " ".join(capsys.readouterr().err.split())


def test_a_campaign_without_flown_cells_ends_with_exit_code_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.toml").write_text(HEAD + 'set = ["link.loss=0.6"]\n' + controller("smpc"))
    assert run(["campaign", str(tmp_path / "c.toml"), "--out", str(tmp_path / "out")]) == 1
    assert "smpc.delta_x: 0.95 is out of reach" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--dask", "tcp://127.0.0.1:9", "--workers", "2"], "give one of them"),
        (["--resume"], "with --out"),
        (["--dask", "nonsense://127.0.0.1"], "no scheduler answers"),
    ],
)
def test_options_that_do_not_go_together(
    spec: Path, tmp_path: Path, options: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [] if options == ["--resume"] else ["--out", str(tmp_path / "out")]
    assert run(["campaign", str(spec), *options, *out]) == 2
    assert text in capsys.readouterr().err


def test_problems_of_a_file_are_reported_with_their_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "c.toml").write_text(HEAD + "step = 6\n" + controller("lqq"))
    assert run(["campaign", str(tmp_path / "c.toml")]) == 2
    text = capsys.readouterr().err
    assert 'c.toml:3: step: unknown key (nearest valid name "steps")' in text
    assert 'c.toml:6: controller[0].kind: there is no controller "lqq" (nearest valid name "lqg")' in text
