"""A short run of `uavctl tune` in the simulator, and the command as it is typed."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from endings_rig import ON_THE_FLOOR, TAKE_OFF, EndingRig, use_virtual_time
from report_rig import omit_figures
from sim_rig import decode

from uavctl.cli.app import run
from uavctl.daemon.lock import find_lock_paths
from uavctl.lab.identify import fit
from uavctl.lab.tune import excitation

BOX = "--box=-1.2,-1.1,-2,1.2,1.1,-0.4"
START = "sim.start_position_m=[0.0,0.0,-1.2]"
REQUEST_STREAM = 511
VEHICLE = "udpin://127.0.0.1:1"  # never opened: the connections are the rig's
FLIES = frozenset({"SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET", "COMMAND_LONG", "COMMAND_INT", "SET_MODE"})


def run_command(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    """Exit code, standard output and standard error."""
    code = run(arguments)
    output = capsys.readouterr()
    return code, output.out, output.err


def make_arguments(folder: Path, *more: str) -> list[str]:
    """A run of preset `room` on the simulated quadrotor."""
    return ["tune", "room", BOX, "--folder", str(folder), "--loopback", "--seed", "1", "--set", START, *more]


@contextmanager
def short_flights(*, has_figures: bool = False) -> Iterator[None]:
    """One large step of each axis and a third of the hold: enough to identify, in a quarter of the time.

    Every second dead time is tried; test_identify.py tries them all. Pages leave their figures out unless asked for,
    and flights draw none, as no test reads it.
    """
    with pytest.MonkeyPatch.context() as patch, nullcontext() if has_figures else omit_figures():
        patch.setattr("uavctl.cli.flying.draw_page", lambda *_: None)
        patch.setattr(fit, "COARSE_S", fit.COARSE_S[::2])
        patch.setattr(excitation, "STEP_SIZES", excitation.STEP_SIZES[-1:])
        patch.setattr(excitation, "HOLD_S", 7.5)
        yield


@dataclass(frozen=True)
class TuneResult:
    """What one call of the command left.

    Attributes:
        code: Its exit code.
        document: Of `--json`; empty where there was none.
        is_received: Standard error.
        rig: The flight, if there was one.
        folder: Of the run.
    """

    code: int
    document: dict[str, Any]
    console_text: str
    rig: EndingRig
    folder: Path

    def find_motion_commands(self, at_ns: int) -> list[str]:
        """What we sent after a time that makes a vehicle move, or asks it for anything."""
        results = [message for sent_ns, data in self.rig.sent if sent_ns > at_ns for message in decode(data)]
        asks = [message for message in results if getattr(message, "command", None) != REQUEST_STREAM]
        return [name for message in asks if (name := message.get_type()) in FLIES]


def real_rig(*overrides: str) -> EndingRig:
    """The simulated peers behind the connections of a real vehicle."""
    return EndingRig(Path(), "sim.plant=quadrotor", *overrides, preset="room")


def fly_real(rig: EndingRig, folder: Path, *more: str, enter: str | type[BaseException] = "") -> TuneResult:
    """Type `uavctl tune` of a real vehicle, armed by us; `enter` is what is typed when it asks."""

    def readline() -> str:
        if isinstance(enter, str):
            return enter
        raise enter

    sets = [argument for setting in (*ON_THE_FLOOR, "sim.plant=quadrotor") for argument in ("--set", setting)]
    arguments = ["tune", "room", BOX, "--folder", str(folder), "--vehicle", VEHICLE, *sets, *TAKE_OFF, "--json", *more]
    out, err = io.StringIO(), io.StringIO()
    try:
        with (
            pytest.MonkeyPatch.context() as patch,
            use_virtual_time(rig),
            short_flights(),
            # A folder with a short name: a socket's path has 107 bytes.
            tempfile.TemporaryDirectory(prefix="uavctl-") as control,
            redirect_stdout(out),
            redirect_stderr(err),
        ):
            patch.setenv("UAVCTL_CONTROL", control)
            patch.setattr("sys.stdin.readline", readline, raising=False)
            code = run(arguments)
    finally:
        for path in find_lock_paths(VEHICLE):
            path.unlink(missing_ok=True)
    text = out.getvalue()
    return TuneResult(code, json.loads(text) if text else {}, err.getvalue(), rig, folder)
