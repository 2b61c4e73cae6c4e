"""Steps of `uavctl tune`: first flight, identification, tuned configuration, second flight, comparison.

A step is done when its file is there: a complete flight in `before` or `after`, `tuned.toml`. So the same command goes
on after an interruption.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from itertools import count
from pathlib import Path

import msgspec

from logs.recording.flight import FlightData
from logs.recording.output_files import write_atomically
from logs.recording.reader import explain_missing_end, read
from uavctl.cause import Cause
from uavctl.cli.identify import find_design_warnings, show_fit_progress
from uavctl.cli.output import print_message, warn
from uavctl.cli.tune_flights import TuneEnd, TuneFlight, find_complete_flight, fly_once, measure_position
from uavctl.config import Config
from uavctl.config.document import DataFileError, read_text
from uavctl.config.load import dump_config, flatten_keys, parse
from uavctl.errors import RecordingError, UsageError
from uavctl.lab.identify.history import read_recorded_history
from uavctl.lab.identify.page import render_identify_page
from uavctl.lab.identify.result import count_fits, identify
from uavctl.lab.tune.box_monitor import MIN_BRAKE_SHARE, TUNED_BRAKE_SHARE, BoxMonitor
from uavctl.lab.tune.change import Change, tune_config
from uavctl.lab.tune.excitation import SafeBox, check_start
from uavctl.lab.tune.figures import TunedFlight, TuneFigures, compute_flight_figures, compute_prediction_error_m
from uavctl.lab.tune.page import render_tune_page
from uavctl.smpc.plant import AXES

SETTINGS_FILE, TUNED_FILE, FIT_PAGE_FILE, PAGE_FILE = "configuration.toml", "tuned.toml", "identified.html", "tune.html"
BEFORE_FOLDER, AFTER_FOLDER = "before", "after"  # later attempts have numbers
_HORIZONTAL = (0, 1)
_MAX_LISTED = 5


class TuneExit(IntEnum):
    """Exit codes of `uavctl tune`."""

    DONE = 0
    FAILED = 1
    PILOT = 4
    INTERRUPTED = 130


class TuneStoppedError(Exception):
    """The run stops before its last step; the same command goes on."""

    def __init__(self, code: TuneExit, reason: str) -> None:
        super().__init__(reason)
        self.code = code


@dataclass(frozen=True)
class TuneRequest:
    """Request for a run: configuration, mission, box and folder."""

    config: Config  # the configuration to tune
    mission: Config  # the same with the mission of both flights
    box: SafeBox | None  # None with a recording
    flight: Path | None  # recording in place of the first flight
    folder: Path
    simulated: bool
    take_off_m: float | None  # height of the climb; None leaves arming to the pilot
    is_agreed: bool  # whether the second flight needs no question


@dataclass
class TuneResult:
    """Result of a run; empty and None for steps that are still to come."""

    before: str = ""  # recordings
    after: str = ""
    changes: tuple[Change, ...] = field(default=())  # of this call; the head of the configuration lists them too
    config: str | None = None
    report: str | None = None
    figures: tuple[TunedFlight, TunedFlight] | None = None  # of both flights
    prediction_m: tuple[float, float] | None = None  # errors of the old and the new model on the second flight
    exit_code: int = TuneExit.DONE
    stopped: str = ""


def run_tuning(request: TuneRequest) -> TuneResult:
    """Take the remaining steps of a run.

    Raises:
        UsageError: The folder holds something else, or the vehicle does not stand in the box.
        RecordingError: The first flight shows too little.
    """
    open_folder(request.folder, request.mission)
    result = TuneResult()
    try:
        _take_steps(request, result)
    except TuneStoppedError as stop:
        result.exit_code, result.stopped = int(stop.code), str(stop)
    except KeyboardInterrupt:  # outside of a flight, which handles it itself
        result.exit_code, result.stopped = int(TuneExit.INTERRUPTED), "interrupted by the operator"
    return result


def _take_steps(request: TuneRequest, result: TuneResult) -> None:
    before = request.flight or _fly(request, request.mission, BEFORE_FOLDER, MIN_BRAKE_SHARE)
    result.before = str(before)
    tuned_file = request.folder / TUNED_FILE
    if not tuned_file.exists():
        result.changes = _write_tuned(request, before)
    result.config = str(tuned_file)
    second = msgspec.structs.replace(
        read_tuned(tuned_file),
        mission=request.mission.mission,
        fence=request.mission.fence,
        target=request.mission.target,
        duration_s=request.mission.duration_s,
    )
    after = _fly(request, second, AFTER_FOLDER, TUNED_BRAKE_SHARE)
    result.after = str(after)
    first_flight, second_flight = (
        compute_flight_figures(FlightData.from_records(read(path), path), request.box) for path in (before, after)
    )
    history = read_recorded_history(read(after))
    old_error_m, new_error_m = (compute_prediction_error_m(history, config) for config in (request.config, second))
    result.figures, result.prediction_m = (first_flight, second_flight), (old_error_m, new_error_m)
    figures = TuneFigures(first_flight, second_flight, old_error_m, new_error_m)
    page = request.folder / PAGE_FILE
    write_atomically(page, render_tune_page(request.config.name, (before, after), TUNED_FILE, figures))
    result.report = str(page)


def _write_tuned(request: TuneRequest, recording: Path) -> tuple[Change, ...]:
    """Identify a flight, and write the tuned configuration; return its changes."""
    if cut := explain_missing_end(recording):
        warn(f"{cut}: identified from the part before")
    history = read_recorded_history(read(recording))
    with show_fit_progress(count_fits(history, request.config)) as advance:
        # Changes only raise wind and drift. A gust would take its share out of both, and is no change of its own.
        identification = identify(history, request.config, advance, finds_gusts=False)
    write_atomically(
        request.folder / FIT_PAGE_FILE, render_identify_page(identification, history.positions, str(recording))
    )
    for warning in identification.result.warnings:
        warn(warning)
    tuned, changes = tune_config(request.config, identification)
    if problems := find_design_warnings(tuned):
        raise RecordingError(f"{problems[0]}. Nothing is written")
    head = ["# Written by `uavctl tune`. Changed:"]
    head += [f"#   {change.key}: {change.old} -> {change.new}, {change.reason}" for change in changes]
    write_atomically(request.folder / TUNED_FILE, "\n".join([*head, "", dump_config(tuned)]))
    return changes


def _fly(request: TuneRequest, config: Config, name: str, brake_share: float) -> Path:
    """Fly a mission, unless the newest attempt is complete; return its recording.

    Raises:
        TuneStoppedError: The flight is not complete, or was not confirmed.
    """
    newest, free = find_attempts(request.folder, name)
    if newest is not None and (recording := find_complete_flight(config, newest)) is not None:
        print_message(f"the flight in {newest} is complete and counts", style="dim")
        return recording
    _announce_flight(request, name)
    if name == AFTER_FOLDER and not request.is_agreed and not ask_agreement():
        raise TuneStoppedError(TuneExit.INTERRUPTED, "the second flight was not confirmed")
    if not request.simulated and request.box is not None:
        check_start(request.box, measure_position(request.config), "where the vehicle stands", _HORIZONTAL)
    flight = fly_once(
        config,
        free,
        simulated=request.simulated,
        take_off_m=request.take_off_m,
        monitor=None if request.box is None else BoxMonitor(config, request.box, brake_share),
    )
    if flight.repeated:
        print_message(f"motions repeated smaller, near a side of the box: {flight.repeated}", style="dim")
    if flight.end is not TuneEnd.COMPLETE:
        raise TuneStoppedError(_EXITS[flight.end], _describe_end(flight))
    return flight.recording


_EXITS = {TuneEnd.PILOT: TuneExit.PILOT, TuneEnd.OPERATOR: TuneExit.INTERRUPTED, TuneEnd.FAILED: TuneExit.FAILED}


def _describe_end(flight: TuneFlight) -> str:
    if flight.stop_reason and flight.end is TuneEnd.FAILED:
        return f"{flight.stop_reason} ({flight.recording})"
    # A simulated flight that Ctrl-C cut off has another cause, so its sentence does not name the operator.
    is_unnamed = flight.end is TuneEnd.OPERATOR and flight.summary.ending.code != Cause.ENDED_BY_OPERATOR
    sentence = flight.summary.ending.sentence.removesuffix(".")
    prefix = "Ended by the operator. " if is_unnamed else ""
    return f"{prefix}{sentence}. The flight is not complete ({flight.recording})"


def _announce_flight(request: TuneRequest, name: str) -> None:
    which = "first flight, with the configuration as it is" if name == BEFORE_FOLDER else "second flight, tuned"
    print_message(f"The {which}: {len(request.mission.mission.waypoints)} waypoints.", style="bold")
    if request.box is not None:
        sides = zip(AXES, request.box.lower, request.box.upper, strict=True)
        print_message(f"Box: {', '.join(f'{axis} {low:g} to {high:g} m' for axis, low, high in sides)}.")
    if not request.simulated:
        print_message("The pilot can take over at any time. Ctrl-C brakes and lands; so does the end of the mission.")


def ask_agreement() -> bool:
    """Ask the operator to press Enter; a closed standard input means no."""
    print_message("Press Enter to fly, Ctrl-C to stop here.")
    return bool(sys.stdin.readline())


def find_attempts(folder: Path, name: str) -> tuple[Path | None, Path]:
    """Return the newest of NAME, NAME-2, NAME-3, … (None before the first), and the next one."""
    newest = None
    for number in count(1):
        path = folder / (name if number == 1 else f"{name}-{number}")
        if not path.exists():
            break
        newest = path
    return newest, path


def open_folder(path: Path, mission: Config) -> None:
    """Begin a run in a folder, or check that it continues the one that is there.

    Raises:
        UsageError: The folder holds something else, a run of another configuration, or cannot be made.
    """
    text, settings = dump_config(mission), path / SETTINGS_FILE
    try:
        path.mkdir(parents=True, exist_ok=True)
        names = {entry.name for entry in path.iterdir()}
    except OSError as error:
        raise UsageError(f"--folder {path}: cannot be made or read ({error.strerror}); choose another") from error
    if SETTINGS_FILE not in names:
        if names - {f"{SETTINGS_FILE}.part"}:  # which an interruption leaves
            raise UsageError(f"--folder {path}: is no run of `uavctl tune`, and not empty; choose another folder")
        write_atomically(settings, text)
    elif read_text(settings) != text:
        differences = "; ".join(_describe_differences(read_text(settings), text)) or "other values"
        raise UsageError(
            f"--folder {path}: is a run of another configuration or box ({differences}). Give these to continue, "
            "or choose another folder"
        )


def _describe_differences(stored: str, text: str) -> Iterator[str]:
    """Yield the first keys in which two configurations differ, with both values."""
    old, new = (_read_keys(one) for one in (stored, text))
    keys = [key for key in dict.fromkeys([*old, *new]) if old.get(key) != new.get(key)]
    for key in keys[:_MAX_LISTED]:
        yield f"{key} = {old.get(key)} there, {new.get(key)} here"


def _read_keys(text: str) -> dict[str, object]:
    try:
        return dict(flatten_keys(tomllib.loads(text)))
    except tomllib.TOMLDecodeError:
        return {}


def read_tuned(path: Path) -> Config:
    """Read the tuned configuration, also if the user has changed it.

    Raises:
        UsageError: A key is missing: its value would be a preset's, which no flight has tested.
        ConfigError: It is wrong.
    """
    try:
        text = read_text(path)
    except DataFileError as error:
        raise UsageError(f"{error}; remove the file: the same command then writes it again") from error
    config = parse(text, str(path)).config
    missing: Sequence[str] = [key for key in _read_keys(dump_config(config)) if key not in _read_keys(text)]
    if missing:
        raise UsageError(f"{path}: {missing[0]} is missing; remove the file: the same command then writes it again")
    return config
