"""A controller of another package that is slower than a tick: a flight in virtual time says so at its end."""

from __future__ import annotations

from pathlib import Path

import pytest

from uavctl.cli.app import run

SLEEPS = """
import time

class Sleeps:
    sleep_s = 0.0

    def __init__(self, problem):
        pass

    def plan(self, request):
        time.sleep(self.sleep_s)
        return request.inputs[0]

class Overdue(Sleeps):
    sleep_s = 0.06
"""


@pytest.mark.usefixtures("no_page")
@pytest.mark.parametrize(("name", "warns"), [("Overdue", True), ("Sleeps", False)])
def test_a_controller_slower_than_a_tick_is_reported(
    name: str, warns: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sleeping_controllers.py").write_text(SLEEPS)
    monkeypatch.syspath_prepend(str(tmp_path))
    choice = f"smpc.controller=sleeping_controllers:{name}"
    assert run(["loopback", "--config", "room", "--duration", "0.5", "--set", choice, "--out", str(tmp_path)]) == 0
    assert (f"sleeping_controllers:{name} took" in " ".join(capsys.readouterr().err.split())) is warns
