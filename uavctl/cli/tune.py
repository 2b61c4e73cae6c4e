"""Command `uavctl tune`: fly, identify the response of the vehicle, write a tuned configuration, fly again, compare.

A run continues after its last finished step.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from logs.recording.flight import FlightData
from logs.recording.output_files import write_atomically
from logs.recording.reader import explain_missing_end, read, read_header
from logs.recording.summary import summarise
from uavctl.cause import Cause
from uavctl.cli.common import (
    SEED,
    Common,
    Json,
    Overrides,
    TakeOff,
    check_readable,
    label_text,
    locate_design_errors,
    make_key_overrides,
    make_message_console,
    make_table,
    print_message,
    warn,
)
from uavctl.cli.flying import check_take_off
from uavctl.cli.identify import find_design_warnings, show_fit_progress
from uavctl.cli.tune_flights import TuneEnd, TuneFlight, find_complete_flight, fly_once, measure_position
from uavctl.config import Config
from uavctl.config.document import DataFileError, read_text
from uavctl.config.load import dump_config, parse_recorded, parse_toml
from uavctl.errors import RecordingError, UsageError
from uavctl.lab.identify.history import read_recorded_history
from uavctl.lab.identify.page import render_identify_page
from uavctl.lab.identify.result import (
    compute_ramp_delay_s,
    count_fits,
    get_candidate_models,
    identify,
    make_fitted_stretches,
)
from uavctl.lab.tune.box_monitor import MIN_BRAKE_SHARE, TUNED_BRAKE_SHARE, BoxMonitor
from uavctl.lab.tune.change import (
    PinnedAxisModel,
    PredictionErrors,
    TunedResult,
    check_tunable,
    compute_held_out_errors,
    get_assumed_response,
    tune_config,
)
from uavctl.lab.tune.excitation import DOWN, SafeBox, add_excitation, check_start, parse_box
from uavctl.lab.tune.run_folder import (
    AFTER_FOLDER,
    BEFORE_FOLDER,
    CHANGE_COLUMNS,
    FIGURE_COLUMNS,
    FIT_PAGE_FILE,
    PAGE_FILE,
    TUNED_FILE,
    TuneComparison,
    TuneFolder,
    TuneProgress,
    TuneSettings,
    compute_flight_figures,
    describe_tuning,
    lock_run,
    make_change_rows,
    make_error_columns,
    make_error_rows,
    make_figure_rows,
    read_tuned,
    render_tune_page,
)
from uavctl.smpc.plant import AXES
from uavctl.wiring.controller import build_flight_design


def render_changes(result: TunedResult) -> RenderableType:
    """Return tables of old and new values, and of the prediction errors of both models on unfitted data."""
    error_headings, rows = make_error_columns(result.old_errors), make_error_rows(result.old_errors, result.new_errors)
    return Group(
        _make_text_table("Configuration", CHANGE_COLUMNS, make_change_rows(result), ("value", "why")),
        _make_text_table(
            "Prediction on halves of the flight not fitted to, rms", error_headings, rows, error_headings[:2]
        ),
        *(Text(f"{warning}.", style="yellow") for warning in result.warnings),
    )


def render_progress(progress: TuneProgress, folder: Path) -> RenderableType:
    """Return tables of the results of the run so far."""
    parts: list[RenderableType] = []
    if progress.tuned is not None:
        parts += [Text(line) for line in describe_tuning(progress.tuned, progress.comparison)]
    if progress.comparison is not None:
        parts.append(
            _make_text_table("Both flights", FIGURE_COLUMNS, make_figure_rows(progress.comparison), FIGURE_COLUMNS[:1])
        )
    if progress.tuned is not None:
        parts.append(Text(f"configuration: {folder / TUNED_FILE}"))
    if progress.comparison is not None:
        parts.append(Text(f"page: {folder / PAGE_FILE}"))
    return Group(*parts)


def _make_text_table(
    title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], left_headings: Sequence[str]
) -> Table:
    return make_table(title, headings, rows, left_headings, fold=True)


FAILED, INTERRUPTED, PILOT = 1, 130, 4  # exit codes: a flight failed, Ctrl-C, the pilot has taken over
_HORIZONTAL = (0, 1)


def tune(
    config: Annotated[str, Parameter(help="preset or TOML file that is to be tuned; it is never written to")],
    /,
    *,
    folder: Annotated[Path, Parameter(help="of the run; given again, the run goes on after its last finished step")],
    box: Annotated[
        str | None,
        Parameter(
            help="two opposite corners n,e,d,n,e,d in local NED [m]: the vehicle is excited inside",
            allow_leading_hyphen=True,
        ),
    ] = None,
    flight: Annotated[
        Path | None,
        Parameter(
            help="begin with this recording of ours instead; its mission is flown again", validator=check_readable
        ),
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
    the same command goes on later. Without --arm the pilot arms, takes off and switches.

    Exit codes: 0 done; 1 a flight went otherwise, or shows too little; 2 what was asked for cannot be; 4 the pilot has
    taken over; 130 interrupted.
    """
    take_off_m = check_take_off(arm, takeoff)
    if (box is None) == (flight is None):
        raise UsageError("give --box, to excite the vehicle inside, or --flight, to begin with a recording")
    if not loopback and seed is not None:
        raise UsageError("--seed is of the simulator; add --loopback")
    if loopback and not (vehicle is None and mocap is None):
        raise UsageError("--vehicle and --mocap are of a real vehicle; leave them out with --loopback")
    extra_overrides = make_key_overrides(daemon__vehicle=vehicle, daemon__mocap=mocap, sim__seed=seed)
    common = Common(config, overrides, json)
    if loopback and not _chooses_plant(common):
        extra_overrides.insert(0, "sim.plant=quadrotor")
    loaded = common.with_overrides(extra_overrides).load()
    check_tunable(loaded.config)
    with locate_design_errors(loaded):
        settings = _FlightSettings.check(loaded.config, box, flight, simulated=loopback, take_off_m=take_off_m)
    options = TuneSettings(
        box=""
        if settings.box is None
        else ",".join(f"{coordinate:g}" for coordinate in (*settings.box.lower, *settings.box.upper)),
        flight="" if flight is None else str(flight.absolute()),
        simulated=loopback,
        take_off_m=take_off_m,
    )
    with lock_run(folder):
        run = _TuneRun(TuneFolder.open(folder, loaded.config, options), loaded.config, settings, yes=yes or loopback)
        try:
            code, stop_reason = run.run()
        except KeyboardInterrupt:  # outside of a flight, which handles it itself
            code, stop_reason = INTERRUPTED, "interrupted by the operator"
    if stop_reason:
        print_message(label_text("stopped", stop_reason, "bold yellow"))
        print_message(f"Go on with the same command; what is done stays in {folder}.")
    progress = run.folder.progress
    document = {
        **msgspec.to_builtins(progress),
        "exit_code": code,
        "stopped": stop_reason,
        "config": str(folder / TUNED_FILE) if progress.tuned is not None else None,
        "report": str(folder / PAGE_FILE) if progress.comparison is not None else None,
    }
    common.show("tune", document, lambda: render_progress(progress, folder))
    return code


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
        return False  # the loader says what is wrong
    sim = parse_toml(text, str(path)).get("sim")
    return isinstance(sim, dict) and "plant" in sim


@dataclass(frozen=True)
class _FlightSettings:
    """Settings of both flights of a tuning run."""

    mission: Config  # the configuration with the mission of both flights
    box: SafeBox | None  # box of the flights; None with a recording
    flight: Path | None  # the recording in place of the first flight
    simulated: bool  # both are flown in the simulator
    take_off_m: float | None  # height of the climb; None leaves arming to the pilot

    @classmethod
    def check(
        cls, config: Config, box: str | None, flight: Path | None, *, simulated: bool, take_off_m: float | None
    ) -> _FlightSettings:
        """Check the options before anything is sent.

        Raises:
            UsageError: The box is not valid or not suitable.
            DesignError: The configuration has no controller.
        """
        lands = not simulated or take_off_m is not None
        if flight is not None:
            flown_config = parse_recorded(read_header(flight).config_toml, f"{flight} (configuration)").config
            mission = msgspec.structs.replace(
                flown_config.mission, then="land" if lands and flown_config.mission.waypoints else "hold"
            )
            tuned_config = msgspec.structs.replace(
                config,
                mission=mission,
                fence=flown_config.fence,
                target=flown_config.target,
                duration_s=flown_config.duration_s,
            )
            return cls(tuned_config, None, flight, simulated, take_off_m)
        assert box is not None
        safe_box = parse_box(box)
        design = build_flight_design(config)
        mission_config = add_excitation(config, design, safe_box, lands=lands)
        if take_off_m is not None:
            check_start(safe_box, (0.0, 0.0, -take_off_m), "--takeoff", (DOWN,))
        if simulated:
            axes = _HORIZONTAL if take_off_m is not None else (*_HORIZONTAL, DOWN)
            centre = ",".join(f"{coordinate:g}" for coordinate in safe_box.centre)
            hint = f"begin inside, as with --set sim.start_position_m=[{centre}]"
            check_start(safe_box, config.sim.start_position_m, "sim.start_position_m", axes, hint)
        return cls(mission_config, safe_box, None, simulated, take_off_m)


class _TuneRun:
    """Steps of a tuning run; a finished step is skipped."""

    def __init__(self, folder: TuneFolder, config: Config, settings: _FlightSettings, *, yes: bool) -> None:
        self.folder = folder
        self._config = config
        self._settings = settings
        self._is_agreed = yes

    def run(self) -> tuple[int, str]:
        """Take the remaining steps; return the exit code, and the reason of an early stop."""
        for step in (self._excite, self._identify, self._fly_again, self._compare):
            code, stop_reason = step()
            if code:
                return code, stop_reason
        return 0, ""

    def _excite(self) -> tuple[int, str]:
        if self.folder.progress.before:
            return self._skip_step("the first flight is there")
        if self._settings.flight is not None:
            if cut := explain_missing_end(self._settings.flight):
                warn(f"{cut}: identified from what comes before")
            self.folder.save_progress(before=str(self._settings.flight.absolute()))
            return 0, ""
        if (outcome := self._find_flown(self._settings.mission, BEFORE_FOLDER)) is not None:
            return outcome
        self._announce_flight("The first flight, with the configuration as it is")
        return self._fly(self._settings.mission, BEFORE_FOLDER)

    def _identify(self) -> tuple[int, str]:
        if self.folder.progress.tuned is not None and (self.folder.path / TUNED_FILE).exists():
            return self._skip_step("identified, and the configuration is written")
        recording = self.folder.get_recording_path(self.folder.progress.before)
        history = read_recorded_history(read(recording))
        with show_fit_progress(count_fits(history, self._config)) as advance:
            identification = identify(history, self._config, advance)
        result = tune_config(self._config, identification)
        warnings = find_design_warnings(result.config)
        write_atomically(
            self.folder.path / FIT_PAGE_FILE, render_identify_page(identification, history.positions, str(recording))
        )
        tuned_result = msgspec.structs.replace(result.result, warnings=(*result.result.warnings, *warnings))
        make_message_console().print(render_changes(tuned_result))
        if warnings:
            raise RecordingError(f"{warnings[0]}. Nothing is written")
        lines = [f"# {line}" for line in _list_changes(tuned_result)]
        write_atomically(self.folder.path / TUNED_FILE, "\n".join([*lines, dump_config(result.config)]))
        self.folder.save_progress(tuned=tuned_result)
        print_message(f"written: {self.folder.path / TUNED_FILE}")
        return 0, ""

    def _fly_again(self) -> tuple[int, str]:
        if self.folder.progress.after:
            return self._skip_step("the second flight is there")
        mission = self._settings.mission
        second_config = msgspec.structs.replace(
            self._read_tuned(),
            mission=mission.mission,
            fence=mission.fence,
            target=mission.target,
            duration_s=mission.duration_s,
        )
        if (outcome := self._find_flown(second_config, AFTER_FOLDER)) is not None:
            return outcome
        self._announce_flight("The second flight: the same mission with the tuned configuration")
        if not self._is_agreed and not ask_agreement():
            return INTERRUPTED, "the second flight was not agreed to"
        return self._fly(second_config, AFTER_FOLDER)

    def _compare(self) -> tuple[int, str]:
        progress = self.folder.progress
        if progress.comparison is not None and (self.folder.path / PAGE_FILE).exists():
            return 0, ""
        paths = [self.folder.get_recording_path(name) for name in (progress.before, progress.after)]
        flights = [FlightData.from_records(read(path), path) for path in paths]
        before, after = (
            compute_flight_figures(flight, name, summarise(flight, wall_s=None).fallbacks, self._settings.box)
            for flight, name in zip(flights, (progress.before, progress.after), strict=True)
        )
        old, new = self._compute_errors(paths[1])
        comparison = TuneComparison(before=before, after=after, old_errors=old, new_errors=new)
        self.folder.save_progress(comparison=comparison)
        progress = self.folder.progress
        write_atomically(
            self.folder.path / PAGE_FILE, render_tune_page(progress, flights[0], flights[1], self._settings.box)
        )
        return 0, ""

    def _compute_errors(self, recording: Path) -> tuple[PredictionErrors, PredictionErrors]:
        """Return the prediction errors of the old and the new plant on the second flight."""
        history = read_recorded_history(read(recording))
        new = self._read_tuned()
        stretches = make_fitted_stretches(history, new)
        ramp_s = compute_ramp_delay_s(history, new)
        names = new.plant.axes
        axis_indices = [AXES.index(name) for name in names]
        models = get_candidate_models(history, new)[0]

        def compute_errors(config: Config) -> PredictionErrors:
            response = get_assumed_response(config, ramp_s)
            pinned = [PinnedAxisModel(model, axis) for model, axis in zip(models, response.axes, strict=True)]
            return compute_held_out_errors(stretches, names, axis_indices, pinned, response.dead_time_s, new.plant.dt_s)

        return compute_errors(self._config), compute_errors(new)

    def _read_tuned(self) -> Config:
        return read_tuned(self.folder.path / TUNED_FILE)

    def _find_flown(self, config: Config, name: str) -> tuple[int, str] | None:
        """Find a complete flight that an earlier run did not note, and note it; None if there is none."""
        newest = self.folder.find_newest(name)
        recording = None if newest is None else find_complete_flight(config, newest)
        if recording is None:
            return None
        self.folder.save_progress(**{name: self.folder.make_relative(recording)})
        return self._skip_step(f"the flight in {newest} came to its end, and counts")

    def _fly(self, config: Config, name: str) -> tuple[int, str]:
        if not self._settings.simulated and self._settings.box is not None:
            check_start(self._settings.box, measure_position(self._config), "where the vehicle stands", _HORIZONTAL)
        box, weakest = self._settings.box, MIN_BRAKE_SHARE if name == BEFORE_FOLDER else TUNED_BRAKE_SHARE
        flight = fly_once(
            config,
            self.folder.find_free_folder(name),
            simulated=self._settings.simulated,
            take_off_m=self._settings.take_off_m,
            monitor=None if box is None else BoxMonitor(config, box, weakest),
        )
        if flight.repeated:
            print_message(
                f"motions that came too near to a side of the box and were repeated smaller: {flight.repeated}",
                style="dim",
            )
        code, stop_reason = _describe_stop(flight)
        if not code:
            self.folder.save_progress(**{name: self.folder.make_relative(flight.recording)})
        return code, stop_reason

    def _announce_flight(self, text: str) -> None:
        mission, box = self._settings.mission.mission, self._settings.box
        print_message(f"{text}.", style="bold")
        if box is not None:
            sides = ", ".join(
                f"{axis} {low:g} to {high:g}" for axis, low, high in zip(AXES, box.lower, box.upper, strict=True)
            )
            print_message(f"{len(mission.waypoints)} waypoints in the box {sides} m.")
        if not self._settings.simulated:
            print_message(
                "The pilot's stick ends it at any time, and the pilot keeps the vehicle. Ctrl-C brakes and lands; so "
                "does the end of the mission."
            )

    def _skip_step(self, text: str) -> tuple[int, str]:
        """Print why a step is skipped; the run goes on."""
        print_message(text, style="dim")
        return 0, ""


def _describe_stop(flight: TuneFlight) -> tuple[int, str]:
    sentence = flight.summary.ending.sentence.removesuffix(".")
    codes = {TuneEnd.COMPLETE: 0, TuneEnd.PILOT: PILOT, TuneEnd.OPERATOR: INTERRUPTED, TuneEnd.FAILED: FAILED}
    code = codes[flight.end]
    if flight.stop_reason and flight.end is TuneEnd.FAILED:
        return code, f"{flight.stop_reason} ({flight.recording})"
    # A simulated flight that Ctrl-C cut off has another cause, so its sentence does not name the operator.
    is_unnamed = flight.end is TuneEnd.OPERATOR and flight.summary.ending.code != Cause.ENDED_BY_OPERATOR
    prefix = "Ended by the operator. " if is_unnamed else ""
    return code, "" if not code else f"{prefix}{sentence}. The flight did not come to its end ({flight.recording})"


def ask_agreement() -> bool:
    """Ask the operator to press Enter; a closed standard input means no."""
    print_message("Press Enter to fly, Ctrl-C to stop here.")
    return bool(sys.stdin.readline())


def _list_changes(result: TunedResult) -> Iterator[str]:
    yield "Written by `uavctl tune`. Changed:"
    for row in result.changes:
        if row.is_changed:
            yield f"  {row.key}{f', {row.axis}' if row.axis else ''}: {row.old:g} -> {row.new:g}"
