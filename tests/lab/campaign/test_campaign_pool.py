"""Workers: one BLAS thread each, replaced when they die, gone when their parent is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from campaign_rig import cells, controller
from patience import LIMIT_S, wait_until

from uavctl.errors import UsageError
from uavctl.lab.campaign import pool
from uavctl.lab.campaign.pool import ONE_THREAD, Columns, Work, fly_tasks, open_processes
from uavctl.lab.campaign.spec import CHUNK
from uavctl.lab.campaign.tasks import make_tasks

ORPHAN = """
import os, sys
from uavctl.lab.campaign.pool import open_processes
if __name__ == "__main__":
    with open_processes(1) as crew:
        print(crew._executor.submit(os.getpid).result(), flush=True)
        sys.stdin.read()
"""


@pytest.mark.slow
def test_a_killed_worker_is_replaced_and_no_run_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    tasks = list(make_tasks(cells(tmp_path, f"steps = 3\nruns = {5 * CHUNK}\n", controller("lqg"))))
    rows_by_task: dict[str, Columns] = {}
    with open_processes(1) as crew:
        assert crew._executor.submit(os.getenv, "OPENBLAS_NUM_THREADS").result() == "1"

        def keep(task: Work, columns: Columns) -> None:
            if not rows_by_task:
                os.kill(crew._executor.submit(os.getpid).result(), signal.SIGKILL)
            rows_by_task[task.name] = columns

        fly_tasks(tasks, crew, keep, lambda: False)
    assert sorted(rows_by_task) == [task.name for task in tasks]
    assert {error for columns in rows_by_task.values() for error in columns["error"]} == {""}
    # The environment is as it was.
    assert os.environ["OPENBLAS_NUM_THREADS"] == "2" and "MKL_NUM_THREADS" not in os.environ


def test_workers_end_with_their_parent_however_it_ends(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(ORPHAN)
    parent = subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert parent.stdout is not None and parent.stdin is not None
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.communicate(timeout=LIMIT_S)
    wait_until(lambda: not _runs(worker), "the worker ends with its parent")


def test_workers_with_other_versions_or_threads_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    current = pool._get_version_and_threads()
    assert current[1] == "1"
    pool._check_workers("tcp://a", {"w": current})
    with pytest.raises(UsageError, match=r"worker w has uavctl 0\.0, this is"):
        pool._check_workers("tcp://a", {"v": current, "w": ("0.0", "1")})
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "4")  # it wins over the other
    with pytest.raises(UsageError, match=r"computes with 4 BLAS threads.*OPENBLAS_NUM_THREADS=1"):
        pool._check_workers("tcp://a", {"w": pool._get_version_and_threads()})
    assert set(ONE_THREAD.values()) == {"1"}


def _runs(process: int) -> bool:
    """Whether a process is there and has not ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
