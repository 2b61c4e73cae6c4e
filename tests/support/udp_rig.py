"""`uavctl loopback --udp` as a process: it flies until enough is seen, and what holds of such a flight at any pace."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from patience import LIMIT_S, wait_until
from places import without_pages

from logs.recording.reader import read_kind
from uavctl.records import ControlMode, Decision, Setpoint, Truth

# The machine may stand still for a while: that is no failsafe of the vehicle's.
PATIENT = ("--set", "sim.setpoint_timeout_s=600.0")


def fly_over_udp(out: Path, enough: Callable[[list[Truth]], bool], *options: str) -> dict[str, Any]:
    """Fly until 15 steps were planned and the truth shows enough; gives the summary."""
    command = [sys.executable, "-m", "uavctl", "loopback", "--udp", "--duration", "600", "--out", str(out), "--json"]
    recording = out / "flight.mcap"

    def seen() -> bool:
        assert process.poll() is None, "it ended by itself"
        if not recording.exists():
            return False
        planned = sum(
            decision.boundary and decision.mode is ControlMode.TRACK for decision in read_kind(recording, Decision)
        )
        truths = list(read_kind(recording, Truth))
        return planned >= 15 and bool(truths) and enough(truths)

    with subprocess.Popen(
        [*command, *PATIENT, *options], stdout=subprocess.PIPE, text=True, env=without_pages()
    ) as process:
        try:
            wait_until(seen, "it flies")
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=LIMIT_S)
        finally:
            process.kill()
    assert process.returncode == 0
    document: dict[str, Any] = json.loads(output)
    return document


def assert_in_order(recording: Path, dt_ns: int) -> None:
    """Assert that no tick and no step is missing, and that the vehicle flew the setpoints."""
    decisions, truths = list(read_kind(recording, Decision)), list(read_kind(recording, Truth))
    assert sum(1 + decision.missed_ticks for decision in decisions) == decisions[-1].tick + 1
    assert {after.at_ns - before.at_ns for before, after in pairwise(truths)} == {dt_ns}
    setpoints = np.array([(0.0, 0.0, 0.0), *(setpoint.accel_mps2 for setpoint in read_kind(recording, Setpoint))])
    flown = np.unique([truth.input for truth in truths], axis=0)
    assert flown.any()
    for applied in flown:
        assert np.abs(setpoints - applied).max(axis=1).min() < 1e-6
