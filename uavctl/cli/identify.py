"""Command `uavctl identify`: plant, lag, disturbance and link model from a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.text import Text

from logs.recording.file_kind import FileKind, detect_kind
from logs.recording.output_files import refuse_recording_path, write_atomically
from logs.recording.reader import explain_missing_end, read, read_header
from logs.recording.senders import choose_vehicle, get_system_id
from logs.recording.tlog import read_tlog
from uavctl.cli.common import DEFAULTS, Common, System, check_readable, make_progress
from uavctl.cli.output import make_pair_table, make_table, warn
from uavctl.config import Config
from uavctl.config.load import dump_config, parse_recorded
from uavctl.errors import DesignError, UsageError
from uavctl.lab.identify.history import FlightHistory, read_recorded_history, read_tlog_history
from uavctl.lab.identify.page import render_identify_page
from uavctl.lab.identify.result import Identification, count_fits, describe_gust, describe_loss, identify
from uavctl.wiring.controller import build_flight_design


def identify_command(
    flight: Annotated[
        Path, Parameter(help="the recording: a flight.mcap, or another program's .tlog", validator=check_readable)
    ],
    /,
    *,
    common: Common = DEFAULTS,
    out: Annotated[Path | None, Parameter(help="TOML file to write; else identified.toml beside the recording")] = None,
    system: System = None,
) -> int:
    """Identify the vehicle and the link of a flight, and write them as a configuration with a page of plots.

    A recording of ours brings its configuration along; for a `.tlog`, --config and --set define which messages are
    positions, and their frame. Plant, link, rate and noise of that configuration are replaced.
    """
    history, config = _read_history(flight, common, system)
    target = out if out is not None else flight.with_name("identified.toml")
    if target == flight:
        raise UsageError(f"{target}: is the recording itself, which would be lost; choose another place with --out")
    refuse_recording_path(target)
    with show_fit_progress(count_fits(history, config)) as advance:
        identification = identify(history, config, advance)
    warnings = (*identification.result.warnings, *find_design_warnings(identification.config))
    result = msgspec.structs.replace(identification.result, warnings=warnings)
    identification = dataclasses.replace(identification, result=result)
    page = target.with_suffix(".html")
    write_atomically(target, dump_config(identification.config))
    write_atomically(page, render_identify_page(identification, history.positions, str(flight)))
    document = {**msgspec.to_builtins(result), "config": str(target), "report": str(page)}
    common.show("identify", document, lambda: _render(identification, target, page))
    return 0


def _read_history(flight: Path, common: Common, system: int | None) -> tuple[FlightHistory, Config]:
    """Read the flight, and the configuration that the result is written into."""
    if detect_kind(flight) is FileKind.TLOG:
        config = common.load().config
        recorded = read_tlog(flight)
        for note in recorded.notes:
            warn(note)
        choice = choose_vehicle(recorded.packets, str(flight), system or config.daemon.vehicle_system_id or None)
        other_systems = {vehicle.system for vehicle in choice.others}
        if other_systems:
            system_list = ", ".join(map(str, sorted(other_systems)))
            warn(f"system {choice.system} is identified; vehicles left out: {system_list}; --system chooses another")
        tlog_daemon = msgspec.structs.replace(
            config.daemon, vehicle="tlog", mocap="tlog", vehicle_system_id=choice.system or 0
        )
        tlog_config = msgspec.structs.replace(config, daemon=tlog_daemon)
        return read_tlog_history(
            [vehicle for vehicle in recorded.packets if get_system_id(vehicle.data) not in other_systems], tlog_config
        ), config
    if system is not None:
        raise UsageError("--system is for a .tlog: a recording of uavctl has one vehicle")
    if common.overrides or common.config != DEFAULTS.config:
        raise UsageError("--config and --set are for a .tlog: a recording of uavctl contains its configuration")
    config = parse_recorded(read_header(flight).config_toml, f"{flight} (configuration)").config
    if cut := explain_missing_end(flight):
        warn(f"{cut}: identified from the part before")
    return read_recorded_history(read(flight)), config


def find_design_warnings(config: Config) -> tuple[str, ...]:
    """Return a warning if the identified configuration has no design; else nothing."""
    try:
        build_flight_design(config)
    except DesignError as error:
        return (f"no design yet with this plant and link: {error}; for another gain: `uavctl design --synthesize`",)
    return ()


@contextmanager
def show_fit_progress(steps: int) -> Iterator[Callable[[], None]]:
    """Show a bar while plants are fitted."""
    with make_progress() as progress:
        task = progress.add_task("fitting", total=steps)
        yield lambda: progress.advance(task)


def _render(identification: Identification, target: Path, page: Path) -> RenderableType:
    result = identification.result
    plant = make_table(
        f"{result.flown_s:.0f} s flown under setpoints, {result.positions} positions",
        ("axis", "lag [s]", "drag [1/s]", "gain", "wind [m/s²]", "residual [mm]", "R²"),
        (
            (
                axis.axis,
                f"{axis.lag_s:.3f}",
                f"{axis.drag_1ps:.3f}",
                "–" if axis.gain is None else f"{axis.gain:.3f}",
                f"{axis.wind_std_mps2:.3f}",
                f"{1e3 * axis.residual_std_m:.1f}",
                f"{axis.r2:.3f}",
            )
            for axis in result.response
        ),
    )
    kinds = make_table(
        "dead time, and error on the halves not fitted to",
        ("plant", "dead time [s]", "range [s]", "error [mm]"),
        (
            (
                kind.model,
                f"{kind.dead_time_s:.2f}",
                " to ".join(f"{end_s:.2f}" for end_s in kind.dead_time_range_s),
                f"{1e3 * kind.error_m:.1f}",
            )
            for kind in result.candidates
        ),
    )
    dead_ms, ramp_ms = 1e3 * identification.config.plant.dead_time_s, 1e3 * result.ramp_s
    ramp = f"configured dead time: {dead_ms:.1f} ms, of which {ramp_ms:.1f} ms are half of a setpoint's own ramp"
    delay_ms, jitter_ms = 1e3 * identification.link.delay_s, 1e3 * identification.link.jitter_s
    link = make_pair_table(
        "link",
        [
            ("rate", f"{identification.link.rate_hz:.4g} Hz"),
            ("lost", describe_loss(identification.link)),
            ("delay", f"{delay_ms:.0f} ms, 99 % within {jitter_ms:.0f} ms more"),
        ],
    )
    gusts = [f"gusts: {'; '.join(map(describe_gust, result.gusts))}"] if result.gusts else []
    warning_lines = [Text(text, style="yellow") for text in result.warnings]
    ramps = [ramp] if result.ramp_s > 0.0 else []
    return Group(plant, kinds, *gusts, *ramps, link, *warning_lines, f"configuration: {target}", f"page: {page}")
