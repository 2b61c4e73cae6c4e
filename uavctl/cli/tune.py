"""Command `uavctl tune`: fly inside a box, identify, write a tuned configuration, fly again, compare."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.text import Text

from logs.recording.reader import read_header
from uavctl.cli.common import (
    SEED,
    Common,
    Json,
    Overrides,
    TakeOff,
    check_readable,
    locate_design_errors,
    make_key_overrides,
)
from uavctl.cli.flying import check_take_off
from uavctl.cli.output import label_text, make_table, print_message
from uavctl.cli.tune_run import TuneRequest, TuneResult, run_tuning
from uavctl.config import Config, LoadedConfig
from uavctl.config.document import DataFileError, read_text
from uavctl.config.load import parse_recorded, parse_toml
from uavctl.errors import UsageError
from uavctl.lab.tune.change import check_tunable
from uavctl.lab.tune.excitation import DOWN, SafeBox, add_excitation, check_start, parse_box
from uavctl.lab.tune.figures import TuneFigures, list_figure_rows
from uavctl.wiring.controller import build_flight_design

_HORIZONTAL = (0, 1)


def tune(
    config: Annotated[str, Parameter(help="preset or TOML file that is to be tuned; it is never written to")],
    /,
    *,
    folder: Annotated[Path, Parameter(help="of the run; the same folder continues after the last complete step")],
    box: Annotated[
        str | None,
        Parameter(
            help="two opposite corners n,e,d,n,e,d in local NED [m]: the vehicle is excited inside",
            allow_leading_hyphen=True,
        ),
    ] = None,
    flight: Annotated[
        Path | None,
        Parameter(help="begin with this recording instead; its mission is flown again", validator=check_readable),
    ] = None,
    loopback: Annotated[
        bool, Parameter(negative=(), help="fly the simulator in this process, in virtual time")
    ] = False,
    seed: Annotated[int | None, Parameter(help="with --loopback: of every random draw", validator=SEED)] = None,
    vehicle: Annotated[str | None, Parameter(help="URL of the vehicle; else daemon.vehicle")] = None,
    mocap: Annotated[str | None, Parameter(help="URL of the positions; else daemon.mocap")] = None,
    arm: Annotated[bool, Parameter(negative=(), help="the vehicle may be armed; needs --takeoff")] = False,
    takeoff: TakeOff = None,
    yes: Annotated[bool, Parameter(negative=(), help="do not ask before the second flight")] = False,
    overrides: Overrides = (),
    json: Json = False,
) -> int:
    """Excite the vehicle inside a box, identify it, write a tuned configuration, fly again, and compare.

    The pilot's stick ends a flight at any time, and the pilot keeps the vehicle; Ctrl-C brakes and lands. Either way
    the same command continues later. Without --arm the pilot arms, takes off and switches.

    Exit codes: 0 done; 1 a flight ended early, or shows too little; 2 box, folder or options are wrong; 4 the pilot has
    taken over; 130 interrupted.
    """
    take_off_m = check_take_off(arm, takeoff)
    if (box is None) == (flight is None):
        raise UsageError("give --box, to excite the vehicle inside, or --flight, to begin with a recording")
    if not loopback and seed is not None:
        raise UsageError("--seed belongs to the simulator; add --loopback")
    if loopback and not (vehicle is None and mocap is None):
        raise UsageError("--vehicle and --mocap belong to a real vehicle; leave them out with --loopback")
    common = Common(config, overrides, json)
    plant = ("sim.plant=quadrotor",) if loopback and not _chooses_plant(common) else ()
    keys = make_key_overrides(daemon__vehicle=vehicle, daemon__mocap=mocap, sim__seed=seed)
    loaded = common.with_overrides([*plant, *keys]).load()
    check_tunable(loaded.config)
    safe_box = None if box is None else parse_box(box)
    request = TuneRequest(
        config=loaded.config,
        mission=_make_mission(loaded, safe_box, flight, take_off_m, simulated=loopback),
        box=safe_box,
        flight=flight,
        folder=folder,
        simulated=loopback,
        take_off_m=take_off_m,
        is_agreed=yes or loopback,
    )
    result = run_tuning(request)
    if result.stopped:
        print_message(label_text("stopped", result.stopped, "bold yellow"))
        print_message(f"Continue with the same command; complete steps stay in {folder}.")
    document = {field.name: msgspec.to_builtins(getattr(result, field.name)) for field in dataclasses.fields(result)}
    common.show("tune", document, lambda: Group(*_render(result)))
    return result.exit_code


def _make_mission(
    loaded: LoadedConfig, box: SafeBox | None, flight: Path | None, take_off_m: float | None, *, simulated: bool
) -> Config:
    """Return the configuration with the mission of both flights: the excitation in the box, or a recording's."""
    lands = not simulated or take_off_m is not None
    with locate_design_errors(loaded):
        if box is not None:
            mission = add_excitation(loaded.config, build_flight_design(loaded.config), box, lands=lands)
            _check_start(loaded.config, box, take_off_m, simulated=simulated)
            return mission
        assert flight is not None
        return _take_mission(loaded.config, flight, lands=lands)


def _check_start(config: Config, box: SafeBox, take_off_m: float | None, *, simulated: bool) -> None:
    """Refuse a climb, or a start in the simulator, outside the box."""
    if take_off_m is not None:
        check_start(box, (0.0, 0.0, -take_off_m), "--takeoff", (DOWN,))
    if simulated:
        axes = _HORIZONTAL if take_off_m is not None else (*_HORIZONTAL, DOWN)
        centre = ",".join(f"{coordinate:g}" for coordinate in box.centre)
        hint = f"begin inside, as with --set sim.start_position_m=[{centre}]"
        check_start(box, config.sim.start_position_m, "sim.start_position_m", axes, hint)


def _take_mission(config: Config, flight: Path, *, lands: bool) -> Config:
    """Return the configuration with the mission of a recording."""
    flown = parse_recorded(read_header(flight).config_toml, f"{flight} (configuration)").config
    then = "land" if lands and flown.mission.waypoints else "hold"
    mission = msgspec.structs.replace(flown.mission, then=then)
    return msgspec.structs.replace(
        config, mission=mission, fence=flown.fence, target=flown.target, duration_s=flown.duration_s
    )


def _chooses_plant(common: Common) -> bool:
    """Return whether a file or an override chooses the simulated vehicle."""
    if any(override.replace(" ", "").startswith("sim.plant=") for override in common.overrides):
        return True
    path = Path(common.config)
    if path.suffix != ".toml" or not path.exists():
        return False
    try:
        text = read_text(path)
    except DataFileError:
        return False  # the loader reports the error
    sim = parse_toml(text, str(path)).get("sim")
    return isinstance(sim, dict) and "plant" in sim


def _render(result: TuneResult) -> Iterator[RenderableType]:
    if result.changes:
        rows = [(change.key, str(change.old), str(change.new), change.reason) for change in result.changes]
        headings = ("value", "old", "new", "why")
        yield make_table("Configuration", headings, rows, headings, fold=True)
    if result.figures is not None and result.prediction_m is not None:
        figure_rows = list_figure_rows(TuneFigures(*result.figures, *result.prediction_m))
        yield make_table("Before and after", ("", "before", "after"), figure_rows)
    if result.config is not None:
        yield Text(f"configuration: {result.config}")
    if result.report is not None:
        yield Text(f"page: {result.report}")
