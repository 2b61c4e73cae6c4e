"""A short run of `uavctl tune` in the simulator, and the command as it is typed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from uavctl.cli.app import run
from uavctl.tune import excitation

BOX = "--box=-1.2,-1.1,-2,1.2,1.1,-0.4"
START = "sim.start_position_m=[0.0,0.0,-1.2]"


def typed(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error."""
    code = run(arguments)
    output = capsys.readouterr()
    return code, output.out, output.err


def words(folder: Path, *more: str) -> list[str]:
    """A run of preset `room` on the simulated quadrotor."""
    return ["tune", "room", BOX, "--folder", str(folder), "--loopback", "--seed", "1", "--set", START, *more]


@contextmanager
def short_flights() -> Iterator[None]:
    """Half of the steps, and a third of the hold: enough to identify, in a third of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(excitation, "STEPS", 2)
        patch.setattr(excitation, "HOLD_S", 8.0)
        yield
