"""`uavctl fly`: the flight daemon on a real link. It never arms, and never asks for a mode but landing."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from logs.disk import check_room
from logs.recorder import Recorder
from logs.summary import render
from uavctl.build import build_design
from uavctl.cli.common import DEFAULTS, POSITIVE, Common, located, messages
from uavctl.cli.flying import conclude, live_line, put_header, recording_path, stop_on_signals
from uavctl.cli.prepare import prepare
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config
from uavctl.daemon import fly as run_daemon
from uavctl.loop import ControlLoop
from uavctl.transport import Connection, open_connection

LANDING_S = 10.0  # after braking: for asking the vehicle to land


def fly(
    *,
    common: Common = DEFAULTS,
    vehicle: Annotated[str | None, Parameter(help="URL of the vehicle; else daemon.vehicle")] = None,
    mocap: Annotated[
        str | None, Parameter(help="URL of the positions; else daemon.mocap. The vehicle's own is one connection")
    ] = None,
    duration: Annotated[
        float | None, Parameter(help="hand over after this time [s]; else fly on", validator=POSITIVE)
    ] = None,
    out: Annotated[Path | None, Parameter(help="folder of the recording; else a new one below flights/")] = None,
) -> int:
    """Fly a vehicle that the pilot arms and switches to OFFBOARD or GUIDED; Ctrl-C hands it back.

    Setpoints are streamed as soon as the vehicle is heard and there is an estimate, neutral ones until the pilot
    switches. When the pilot leaves the mode, streaming stops at once and does not come back.
    """
    given = {"daemon.vehicle": vehicle, "daemon.mocap": mocap}
    overrides = [f'{key}="{value}"' for key, value in given.items() if value is not None]
    loaded = common.with_overrides(overrides).load()
    config = loaded.config
    with located(loaded):
        design = build_design(config)
    path = recording_path(out, config.name)
    check_room(path, config.log.free_bytes)
    with located(loaded):
        prepared = prepare(config, design)
    connections = _connect(config)
    tick_ns, dt_ns = round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9)
    begun = time.perf_counter()
    with stop_on_signals() as stopped:
        recorder = Recorder(path, config.log.chunk_bytes, config.log.queue)
        try:
            put_header(recorder, prepared, monotonic_ns())
            loop = ControlLoop(config, prepared.controller, recorder, time.perf_counter_ns)
            messages().print(f"recording to {path}; Ctrl-C hands over", soft_wrap=True)
            with live_line(loop, recorder, duration, config.daemon.tick_s):
                limit_s = config.fallback.brake_s + LANDING_S
                ticker = Ticker(tick_ns, dt_ns)
                run_daemon(loop, connections, ticker, stopped, duration_s=duration, stop_limit_s=limit_s)
        finally:
            for connection in connections.values():
                connection.close()
            status = recorder.close()
    summary = conclude(path, time.perf_counter() - begun, status)
    common.show(summary, lambda: render(summary))
    return 0 if summary.steps and status.ok else 1


def _connect(config: Config) -> dict[str, Connection]:
    """Open the connections; one if both URLs are the same.

    Raises:
        ConnectionSpecError: a URL cannot be understood or opened.
    """
    urls = {"vehicle": config.daemon.vehicle}
    if config.daemon.mocap != config.daemon.vehicle:
        urls["mocap"] = config.daemon.mocap
    return {name: open_connection(url) for name, url in urls.items()}
