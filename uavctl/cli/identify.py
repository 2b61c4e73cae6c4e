"""`uavctl identify`: plant, lag, disturbance and link model from a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from logs.recording.disk import FileKind, detect_kind, refuse_recording_path, write_atomically
from logs.recording.reader import header, lacks_end, read
from logs.recording.senders import choose_vehicle, get_system_id
from logs.recording.tlog import read_tlog
from uavctl.build.controller import design_of
from uavctl.cli.common import DEFAULTS, Common, System, bars, can_be_read, warn
from uavctl.config import Config
from uavctl.config.load import dump_config, parse
from uavctl.errors import DesignError, UsageError
from uavctl.lab.identify.history import FlightHistory, read_recorded_history, read_tlog_history
from uavctl.lab.identify.page import render_identify_page
from uavctl.lab.identify.result import Identification, count_fits, describe_loss, identify


def identify_command(
    flight: Annotated[Path, Parameter(help="the recording: .mcap of ours, or anybody's .tlog", validator=can_be_read)],
    /,
    *,
    common: Common = DEFAULTS,
    out: Annotated[Path | None, Parameter(help="TOML file to write; else identified.toml beside the recording")] = None,
    system: System = None,
) -> int:
    """Identify the vehicle and the link of a flight, and write them as a configuration with a page of plots.

    A recording of ours brings its configuration along; for a `.tlog`, --config and --set say which messages are
    positions and in what frame. Plant, link, rate and noise of that configuration are replaced, all else is kept.
    """
    history, config = _history(flight, common, system)
    target = out if out is not None else flight.with_name("identified.toml")
    if target == flight:
        raise UsageError(f"{target}: is the recording itself, which would be lost; choose another place with --out")
    refuse_recording_path(target)
    with fitting(count_fits(history, config)) as advance:
        found = identify(history, config, advance)
    doubts = (*found.result.warnings, *design_doubts(found.config))
    result = msgspec.structs.replace(found.result, warnings=doubts)
    found = dataclasses.replace(found, result=result)
    page = target.with_suffix(".html")
    write_atomically(target, dump_config(found.config))
    write_atomically(page, render_identify_page(found, history.positions, str(flight)))
    document = {**msgspec.to_builtins(result), "config": str(target), "report": str(page)}
    common.show("identify", document, lambda: _picture(found, target, page))
    return 0


def _history(flight: Path, common: Common, system: int | None) -> tuple[FlightHistory, Config]:
    """Return the flight, and the configuration that its result goes into."""
    if detect_kind(flight) is FileKind.TLOG:
        config = common.load().config
        recorded = read_tlog(flight)
        for note in recorded.notes:
            warn(note)
        chosen = choose_vehicle(recorded.packets, str(flight), system or config.daemon.vehicle_system_id or None)
        others = {one.system for one in chosen.others}
        if others:
            listed = ", ".join(map(str, sorted(others)))
            warn(f"system {chosen.system} is identified; vehicles left out: {listed}; --system chooses another")
        one_link = msgspec.structs.replace(
            config.daemon, vehicle="tlog", mocap="tlog", vehicle_system_id=chosen.system or 0
        )
        read_as = msgspec.structs.replace(config, daemon=one_link)
        return read_tlog_history(
            [one for one in recorded.packets if get_system_id(one.data) not in others], read_as
        ), config
    if system is not None:
        raise UsageError("--system is for a .tlog: a recording of ours is of one vehicle")
    if common.overrides or common.config != DEFAULTS.config:
        raise UsageError("--config and --set are for a .tlog: a recording of ours brings its own configuration")
    config = parse(header(flight).config_toml, f"{flight} (configuration)").config
    if cut := lacks_end(flight):
        warn(f"{cut}: identified from what comes before")
    return read_recorded_history(read(flight)), config


def design_doubts(config: Config) -> tuple[str, ...]:
    """Return why the identified configuration makes no design as it stands; empty if it does."""
    try:
        design_of(config)
    except DesignError as error:
        return (f"no design yet with this plant and link: {error}; for another gain: `uavctl design --synthesize`",)
    return ()


@contextmanager
def fitting(steps: int) -> Iterator[Callable[[], None]]:
    """Show a bar while plants are fitted."""
    with bars() as progress:
        task = progress.add_task("fitting", total=steps)
        yield lambda: progress.advance(task)


def _picture(found: Identification, target: Path, page: Path) -> RenderableType:
    result = found.result
    plant = Table(title=f"{result.flown_s:.0f} s flown under setpoints, {result.positions} positions")
    for column in ("axis", "lag [s]", "drag [1/s]", "gain", "wind [m/s²]", "residual [mm]", "R²"):
        plant.add_column(column, justify="left" if column == "axis" else "right")
    for one in result.response:
        plant.add_row(
            one.axis,
            f"{one.lag_s:.3f}",
            f"{one.drag_1ps:.3f}",
            "–" if one.gain is None else f"{one.gain:.3f}",
            f"{one.wind_std_mps2:.3f}",
            f"{1e3 * one.residual_std_m:.1f}",
            f"{one.r2:.3f}",
        )
    kinds = Table(title="dead time, and error on the halves not fitted to")
    for column in ("plant", "dead time [s]", "range [s]", "error [mm]"):
        kinds.add_column(column, justify="left" if column == "plant" else "right")
    for kind in result.candidates:
        low_s, high_s = kind.dead_time_range_s
        within = f"{low_s:.2f} to {high_s:.2f}"
        kinds.add_row(kind.model, f"{kind.dead_time_s:.2f}", within, f"{1e3 * kind.error_m:.1f}")
    dead_ms, ramp_ms = 1e3 * found.config.plant.dead_time_s, 1e3 * result.ramp_s
    ramp = f"configured dead time: {dead_ms:.1f} ms, of which {ramp_ms:.1f} ms are half of a setpoint's own ramp"
    link = Table(title="link", show_header=False)
    for name, value in (
        ("rate", f"{found.link.rate_hz:.4g} Hz"),
        ("lost", describe_loss(found.link)),
        ("delay", f"{1e3 * found.link.delay_s:.0f} ms, 99 % within {1e3 * found.link.jitter_s:.0f} ms more"),
    ):
        link.add_row(name, value)
    told = [Text(text, style="yellow") for text in result.warnings]
    ramps = [ramp] if result.ramp_s > 0.0 else []
    return Group(plant, kinds, *ramps, link, *told, f"configuration: {target}", f"page: {page}")
