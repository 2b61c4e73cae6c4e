"""Time of one tick: a flight of `uavctl loopback --udp` as a process, in real time and recording."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from logs.recording.reader import read
from uavctl.errors import UavctlError
from uavctl.lab.bench.decision import Quantiles
from uavctl.records import Timing

_LONGER_S = 600.0  # a design may have to be made first


class TickBench(msgspec.Struct, frozen=True, kw_only=True):
    """Times of the ticks of one flight on real UDP; they count from the tick's deadline."""

    ticks: int
    sent_us: Quantiles  # until the setpoint is handed to the socket
    lateness_us: Quantiles  # until the tick begins
    step_us: Quantiles  # in the control core
    missed_ticks: int
    dropped: int  # records that the recorder could not keep


def time_tick(options: Sequence[str], seconds: float) -> TickBench:
    """Fly for some seconds, and read the times of the ticks from the recording.

    Args:
        options: The command line that gives the configuration: --config and --set.

    Raises:
        UavctlError: It did not fly.
    """
    with tempfile.TemporaryDirectory(prefix="uavctl-bench-") as folder:
        flight = ("loopback", *options, "--udp", "--duration", f"{seconds:g}", "--out", folder, "--json")
        done = subprocess.run(
            [sys.executable, "-m", "uavctl", *flight],
            capture_output=True,
            text=True,
            check=False,
            timeout=seconds + _LONGER_S,
        )
        summary = json.loads(done.stdout or "{}")
        if "recording" not in summary:
            raise UavctlError(f"the flight that times ticks failed:\n{done.stderr.strip()}")
        timings = [record for _, _, record in read(Path(summary["recording"])) if isinstance(record, Timing)]
    return TickBench(
        ticks=len(timings),
        sent_us=_compute_quantiles([timing.send_ns for timing in timings]),
        lateness_us=_compute_quantiles([timing.lateness_ns for timing in timings]),
        step_us=_compute_quantiles([timing.step_ns for timing in timings]),
        missed_ticks=summary["missed_ticks"],
        dropped=summary["recorder_dropped"],
    )


def _compute_quantiles(times_ns: Sequence[int]) -> Quantiles:
    return Quantiles.compute(1e-3 * np.array(times_ns))
