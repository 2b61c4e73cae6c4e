"""Folder of a tuning run: its settings, its progress, its files, and its page.

Every step writes its files first and its note last, so an interrupted run continues after the last complete step. The
page compares two flights of the same mission: how well each held a place, and how well its plans predicted the motion.
"""

from __future__ import annotations

import fcntl
import hashlib
import math
import os
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from logs.recording.budget import read_whole
from logs.recording.flight import FlightData
from logs.recording.output_files import write_atomically
from logs.recording.summary import compute_position_errors_m
from logs.report.page import Mark, PageSection, render_grid, render_page, render_table
from logs.report.plots import DASHED, DOTTED
from logs.report.svg import Drawing, colour, open_canvas
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.document import DataFileError, read_text
from uavctl.config.load import dump_config, flatten_keys, parse
from uavctl.errors import RecordingError, UsageError
from uavctl.lab.trial import compute_excess_m, compute_rms_m
from uavctl.lab.tune.change import Change, PredictionErrors, TunedResult
from uavctl.lab.tune.excitation import SETTLING_S, SafeBox
from uavctl.records import ControlMode
from uavctl.smpc.plant import AXES

PLANNED_AHEAD_S = 0.5  # time ahead at which a plan is compared with the flight
MIN_HOLD_S = 2.0
_SAME_M = 1e-6
_MAX_PROGRESS_BYTES = 2**26  # of `tune`'s own file, which has some ten thousand


class TunedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one of the two flights; None where it does not determine them."""

    recording: str
    judged_by: str  # "truth" where the simulator recorded it, else "estimate"
    flown_s: float
    hold_s: float  # time that counts as hold
    hold_rms_m: float | None  # distance from the last waypoint, all three axes
    hold_max_m: float | None
    plan_rms_m: float | None  # distance from the plan of PLANNED_AHEAD_S before
    beyond_box_m: float | None  # largest distance outside the box; negative is inside; None without a box
    fallbacks: int


class TuneComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Comparison of both flights, and of both models on the second, which neither was fitted to."""

    before: TunedFlight
    after: TunedFlight
    old_errors: PredictionErrors
    new_errors: PredictionErrors


def compute_flight_figures(flight: FlightData, recording: str, fallbacks: int, box: SafeBox | None) -> TunedFlight:
    """Return the figures of a flight.

    Args:
        fallbacks: Entries into braking, holding or landing without an order.
        box: Box of the flight; None without one.
    """
    steps = flight.steps
    is_held = find_hold_steps(flight)
    distances = compute_position_errors_m(flight)[is_held]
    hold_s = float(np.count_nonzero(is_held)) * flight.design.dt_s
    has_hold = hold_s >= MIN_HOLD_S
    plan_errors = compute_plan_errors_m(flight)
    return TunedFlight(
        recording=recording,
        judged_by="truth" if steps.from_truth else "estimate",
        flown_s=round(len(steps) * flight.design.dt_s, 6),
        hold_s=round(hold_s, 6),
        hold_rms_m=compute_rms_m(distances) if has_hold else None,
        hold_max_m=float(distances.max()) if has_hold else None,
        plan_rms_m=compute_rms_m(plan_errors) if len(plan_errors) else None,
        beyond_box_m=None if box is None else _compute_box_excess_m(flight, box),
        fallbacks=fallbacks,
    )


def find_last_waypoint_steps(flight: FlightData) -> tuple[NDArray[np.bool_], float]:
    """Return which steps (n,) flew plans to the last waypoint, and since when that was the target [s]."""
    steps = flight.steps
    is_tracked = np.array([d.mode is ControlMode.TRACK for d in steps.decisions], dtype=np.bool_)
    if not is_tracked.any():
        return is_tracked, math.inf
    index = list(flight.design.position_index)
    last_target = steps.target[np.flatnonzero(is_tracked)[-1]][index]
    is_last_target = np.linalg.norm(steps.target[:, index] - last_target, axis=1) <= _SAME_M
    other_steps = np.flatnonzero(is_tracked & ~is_last_target)
    begin = int(other_steps[-1]) + 1 if len(other_steps) else int(np.flatnonzero(is_tracked)[0])
    is_chosen = is_tracked & is_last_target & (np.arange(len(is_tracked)) >= begin)
    return is_chosen, float(steps.t_s[begin])


def find_hold_steps(flight: FlightData) -> NDArray[np.bool_]:
    """Return the steps (n,) that held the last waypoint: from `SETTLING_S` after it became the target."""
    is_chosen, since_s = find_last_waypoint_steps(flight)
    return np.asarray(is_chosen & (flight.steps.t_s >= since_s + SETTLING_S), dtype=np.bool_)


def compute_plan_errors_m(flight: FlightData) -> Array:
    """Return the distance between plan and flight `PLANNED_AHEAD_S` later (n,) [m]."""
    steps, index = flight.steps, list(flight.design.position_index)
    steps_ahead = max(1, round(PLANNED_AHEAD_S / flight.design.dt_s))
    dt_ns = flight.design.dt_ns
    decided_ns = np.array([d.at_ns for d in steps.decisions], dtype=np.int64)
    errors = []
    for plan in flight.flown_plans.values():
        if steps_ahead >= len(plan.states):
            continue
        later = int(np.searchsorted(decided_ns, plan.base_ns + steps_ahead * dt_ns))
        neighbours = [step for step in (later - 1, later) if 0 <= step < len(decided_ns)]
        if len(neighbours) < 2:
            continue
        left, right = neighbours
        span = int(decided_ns[right] - decided_ns[left])
        if span > 2 * dt_ns:
            continue  # no plan was flown in between
        share = (plan.base_ns + steps_ahead * dt_ns - int(decided_ns[left])) / span
        position = (1.0 - share) * steps.state[left][index] + share * steps.state[right][index]
        errors.append(float(np.linalg.norm(position - plan.states[steps_ahead, index])))
    return np.array(errors)


def _compute_box_excess_m(flight: FlightData, box: SafeBox) -> float | None:
    """Return the largest distance outside the box over all steps flown by plans [m]."""
    steps = flight.steps
    tracked_steps = [step for step, d in enumerate(steps.decisions) if d.mode is ControlMode.TRACK]
    if not tracked_steps:
        return None
    positions = steps.state[tracked_steps][:, list(flight.design.position_index)]
    axes = [AXES.index(axis) for axis in flight.design.axes]
    return float(compute_excess_m(positions, np.array(box.lower)[axes], np.array(box.upper)[axes]).max())


STATE_FILE, SETTINGS_FILE, TUNED_FILE, PAGE_FILE, FIT_PAGE_FILE = (
    "tune.json",
    "configuration.toml",
    "tuned.toml",
    "tune.html",
    "identified.html",
)
BEFORE_FOLDER, AFTER_FOLDER = "before", "after"  # folders of the flights; later attempts have numbers
_MAX_LISTED = 5


class TuneSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of a tuning run; they may not change between two calls."""

    box: str  # the parsed box; empty without one
    flight: str  # recording to begin with; empty where one is flown
    simulated: bool
    take_off_m: float | None


class TuneProgress(msgspec.Struct, frozen=True, kw_only=True):
    """Progress of a tuning run."""

    asked: TuneSettings
    digest: str  # hash of the configuration
    before: str = ""  # recording of the excitation, once complete; relative to the folder if inside
    tuned: TunedResult | None = None
    after: str = ""  # recording of the flight with the tuned configuration
    comparison: TuneComparison | None = None


class TuneFolder:
    """Folder of a tuning run on disk."""

    def __init__(self, path: Path, progress: TuneProgress) -> None:
        self.path = path
        self.progress = progress  # how far the run has come

    @classmethod
    def open(cls, path: Path, config: Config, settings: TuneSettings) -> TuneFolder:
        """Begin a run, or continue the existing one.

        Raises:
            UsageError: The folder holds something else, or a run of another configuration.
        """
        text = dump_config(config)
        digest = hashlib.sha256(text.encode()).hexdigest()
        if not (path / STATE_FILE).exists():
            # A run interrupted while it wrote its first file leaves a part of it.
            if path.exists() and (
                not path.is_dir() or any(path_inside.name != f"{STATE_FILE}.part" for path_inside in path.iterdir())
            ):
                raise UsageError(f"--folder {path}: is no run of `uavctl tune`, and not empty; choose another folder")
            path.mkdir(parents=True, exist_ok=True)
            folder = cls(path, TuneProgress(asked=settings, digest=digest))
            folder.save_progress()
            write_atomically(path / SETTINGS_FILE, text)
            return folder
        progress = _read_progress(path / STATE_FILE)
        if progress.digest != digest:
            description = "; ".join(_describe_differences(path / SETTINGS_FILE, text)) or "other values"
            raise UsageError(
                f"--folder {path}: is a run of another configuration ({description}). Give that one to go on, or "
                "choose another folder"
            )
        if progress.asked != settings:
            description = ", ".join(_describe_other_settings(progress.asked, settings))
            raise UsageError(
                f"--folder {path}: is a run that was begun with {description}. Go on with the same, or choose "
                "another folder"
            )
        folder = cls(path, progress)
        if not (path / SETTINGS_FILE).exists():
            write_atomically(path / SETTINGS_FILE, text)
        if progress.comparison is None:
            folder.save_progress()  # fails before a flight if the folder cannot be written
        return folder

    def save_progress(self, **changes: object) -> None:
        """Save the results of a finished step.

        Raises:
            RecordingError: It cannot be written.
        """
        self.progress = msgspec.structs.replace(self.progress, **changes)
        write_atomically(
            self.path / STATE_FILE, msgspec.json.format(msgspec.json.encode(self.progress)).decode() + "\n"
        )

    def find_free_folder(self, name: str) -> Path:
        """Return a folder for one more flight: the first of NAME, NAME-2, NAME-3, … that does not exist yet."""
        return self._attempts(name)[1]

    def find_newest(self, name: str) -> Path | None:
        """Return the folder of the newest attempt at a flight; None before the first."""
        return self._attempts(name)[0]

    def _attempts(self, name: str) -> tuple[Path | None, Path]:
        find_newest, number = None, 1
        while (candidate := self.path / (name if number == 1 else f"{name}-{number}")).exists():
            find_newest, number = candidate, number + 1
        return find_newest, candidate

    def get_recording_path(self, noted: str) -> Path:
        """Return the path of a recording that the progress names."""
        return self.path / noted  # an absolute path stays unchanged

    def make_relative(self, recording: Path) -> str:
        """Return the name of a recording for the progress, relative, so that the folder may be moved."""
        try:
            return str(recording.relative_to(self.path))
        except ValueError:
            return str(recording.absolute())


@contextmanager
def lock_run(path: Path) -> Iterator[None]:
    """Lock the folder of a run, and make it if needed; the kernel releases the lock when the process ends.

    Raises:
        UsageError: Another process has the lock, or the folder cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise UsageError(f"--folder {path}: no folder can be had there ({error.strerror}); choose another") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            reason = "another `uavctl tune` is at work in it; wait for it, or end it"
            raise UsageError(f"--folder {path}: {reason}") from None
        yield
    finally:
        os.close(descriptor)


def read_tuned(path: Path) -> Config:
    """Read the tuned configuration, also if the user has changed it.

    Raises:
        UsageError: A key is missing: its value would be a preset's, which no flight has tested.
        ConfigError: It is wrong.
    """
    try:
        text = read_text(path)
    except DataFileError as error:
        raise UsageError(f"{error}; mend the file or remove it: the same command then writes it anew") from error
    config = parse(text, str(path)).config
    keys = dict(flatten_keys(tomllib.loads(text)))
    missing = [key for key, _ in flatten_keys(tomllib.loads(dump_config(config))) if key not in keys]
    if missing:
        others_text = f" and {len(missing) - 1} more keys" if len(missing) > 1 else ""
        raise UsageError(
            f"{path}: is not whole, {missing[0]}{others_text} are missing; put them back, or remove the file: the same "
            "command then writes it anew"
        )
    return config


def _read_progress(path: Path) -> TuneProgress:
    try:
        return msgspec.json.decode(read_whole(path, _MAX_PROGRESS_BYTES), type=TuneProgress)
    except (RecordingError, msgspec.DecodeError, RecursionError) as error:
        raise UsageError(f"{path}: cannot be read ({error}); choose another --folder") from error


def _describe_differences(settings: Path, text: str) -> Iterator[str]:
    """Return the first keys in which two configurations differ, with both values."""
    try:
        old = dict(flatten_keys(tomllib.loads(read_text(settings))))
    except (DataFileError, tomllib.TOMLDecodeError):
        return
    new = dict(flatten_keys(tomllib.loads(text)))
    keys = [key for key in dict.fromkeys([*old, *new]) if old.get(key) != new.get(key)]
    for key in keys[:_MAX_LISTED]:
        yield f"{key} = {old.get(key)} there, {new.get(key)} here"
    if len(keys) > _MAX_LISTED:
        yield f"{len(keys) - _MAX_LISTED} more"


def _describe_other_settings(stored: TuneSettings, current: TuneSettings) -> Iterator[str]:
    if stored.box != current.box:
        yield f"--box={stored.box}" if stored.box else "no --box"
    if stored.flight != current.flight:
        yield f"--flight {stored.flight}" if stored.flight else "no --flight"
    if stored.simulated != current.simulated:
        yield "--loopback" if stored.simulated else "a real vehicle"
    if stored.take_off_m != current.take_off_m:
        yield "no --arm" if stored.take_off_m is None else f"--arm --takeoff {stored.take_off_m:g}"


CHANGE_COLUMNS = ("value", "old", "the flight says", "new", "why")
FIGURE_COLUMNS = ("figure", "before", "after", "after / before")
_NONE = "–"


def make_change_rows(result: TunedResult) -> Iterator[tuple[str, ...]]:
    """Return a row for each value: name, old value, what the flight shows, new value, reason."""
    for row in result.changes:
        yield (
            get_change_name(row),
            f"{row.old:.4g}",
            _format_flight_value(row),
            f"{row.new:.4g}" if row.is_changed else "=",
            row.reason,
        )


def get_change_name(row: Change) -> str:
    """Return key, axis and unit of a value."""
    unit = f" [{row.unit}]" if row.unit else ""
    return f"{row.key}{f' {row.axis}' if row.axis else ''}{unit}"


def make_error_columns(errors: PredictionErrors) -> tuple[str, ...]:
    """Return the headings of the prediction errors."""
    return ("axis", "model", *(f"{time_s:g} s [mm]" for time_s in errors.ahead_s))


def make_error_rows(old: PredictionErrors, new: PredictionErrors) -> Iterator[tuple[str, ...]]:
    """Return the rms errors of both models, axis by axis."""
    for axis, before, after in zip(old.axes, old.rms_m, new.rms_m, strict=True):
        for model, row in (("old", before), ("new", after)):
            yield (axis, model, *(f"{1e3 * value:.1f}" for value in row))


def make_figure_rows(comparison: TuneComparison) -> Iterator[tuple[str, ...]]:
    """Return the figures of both flights."""
    before, after = comparison.before, comparison.after
    yield _make_row("held to, rms [cm]", before.hold_rms_m, after.hold_rms_m, 100.0)
    yield _make_row("held to, at most [cm]", before.hold_max_m, after.hold_max_m, 100.0)
    yield _make_row(
        f"off the plan of {PLANNED_AHEAD_S:g} s before, rms [cm]", before.plan_rms_m, after.plan_rms_m, 100.0
    )
    yield _make_row(
        "model off on the second flight [mm]", comparison.old_errors.overall_m, comparison.new_errors.overall_m, 1000.0
    )
    if before.beyond_box_m is not None and after.beyond_box_m is not None:
        yield ("room left in the box [m]", f"{-before.beyond_box_m:.2f}", f"{-after.beyond_box_m:.2f}", _NONE)
    yield ("fallbacks", str(before.fallbacks), str(after.fallbacks), _NONE)


def describe_tuning(result: TunedResult, comparison: TuneComparison | None) -> list[str]:
    """Return sentences on the result."""
    count = sum(row.is_changed for row in result.changes)
    old_m, new_m = result.old_errors.overall_m, result.new_errors.overall_m
    sentences = [
        f"{count} of {len(result.changes)} values of the configuration were changed.",
        f"On the halves of the first flight that it was not fitted to, the model is off by {1e3 * new_m:.1f} mm, not "
        f"{1e3 * old_m:.1f} mm (0.25 to 2 s ahead).",
    ]
    if comparison is not None:
        sentences.append(
            f"On the second flight, which neither was fitted to: {1e3 * comparison.new_errors.overall_m:.1f} mm "
            f"instead of {1e3 * comparison.old_errors.overall_m:.1f} mm."
        )
        before_m, after_m = comparison.before.hold_rms_m, comparison.after.hold_rms_m
        if before_m is not None and after_m is not None:
            sentences.append(
                f"The last place was held to {100.0 * after_m:.1f} cm (rms, {comparison.after.hold_s:.0f} s) instead "
                f"of {100.0 * before_m:.1f} cm, by the {comparison.after.judged_by}."
            )
    return [*sentences, *(f"{warning}." for warning in result.warnings)]


def _format_flight_value(row: Change) -> str:
    if row.flight is None:
        return _NONE
    return f"{row.flight:.4g}" if row.std is None else f"{row.flight:.4g} ± {row.std:.2g}"


def _make_row(name: str, before: float | None, after: float | None, scale: float) -> tuple[str, ...]:
    ratio = _NONE if before is None or after is None or not before else f"{after / before:.2f}"
    return (name, *(_NONE if value is None else f"{scale * value:.1f}" for value in (before, after)), ratio)


_HEIGHT_IN = 2.6
_BEFORE_ROLE, _AFTER_ROLE = "sample", "estimate"  # roles of the colours
_MARKS = (Mark("line", _BEFORE_ROLE, "before"), Mark("line", _AFTER_ROLE, "after"))
_MODEL_MARKS = (Mark("line", _BEFORE_ROLE, "old model"), Mark("line", _AFTER_ROLE, "new model"))
_TARGET_MARK, _BOX_MARK = Mark("dotted", "target", "place to fly to, before"), Mark("dashed", "limit", "box")
_CHANGE_NOTE = (
    "Taken over is what the flight tells well; ± is the standard error. Noise, loss and delay are raised where the "
    "flight was worse than believed, and never lowered. An = is a value that stays."
)
_FIGURE_NOTE = (
    "Held: distance from the last place, from 5 s after it became the one to fly to. Off the plan: how far the vehicle "
    "was from where the plan of half a second before had it. The model is off by the geometric mean of errors below."
)
_ERROR_NOTE = "Root mean square of the motion over the next step and the next 0.25 to 2 s that is not told, "
_FIRST_NOTE = f"{_ERROR_NOTE}each half of the flight by plants fitted to the other."
_SECOND_NOTE = f"{_ERROR_NOTE}of a flight that neither was fitted to."
_MOTION_NOTE = "Positions, by the true states if they were recorded, else by the controllers' estimates."
_HOLD_NOTE = "Distance from the last place, from when it was to be held."


def render_tune_page(progress: TuneProgress, before: FlightData, after: FlightData, box: SafeBox | None) -> str:
    """Return the page of a finished run as HTML.

    Args:
        progress: Progress of the run, with changes and comparison.
        box: Box of both flights; None with a recording.
    """
    assert progress.tuned is not None and progress.comparison is not None
    result, comparison = progress.tuned, progress.comparison
    sections = _make_sections(progress, comparison, before, after, box)
    return render_page(
        "Tuned by flying",
        f"{comparison.before.recording}, {comparison.after.recording}",
        describe_tuning(result, comparison),
        sections,
    )


def _make_sections(
    progress: TuneProgress, comparison: TuneComparison, before: FlightData, after: FlightData, box: SafeBox | None
) -> Iterator[PageSection]:
    assert progress.tuned is not None
    result = progress.tuned
    yield PageSection(
        "Both flights", _FIGURE_NOTE, render_table(FIGURE_COLUMNS, make_figure_rows(comparison), frozenset({1, 2, 3}))
    )
    yield PageSection("How the place was held", _HOLD_NOTE, render_grid([_draw_hold(before, after)]), _MARKS)
    yield PageSection(
        "What changes", _CHANGE_NOTE, render_table(CHANGE_COLUMNS, make_change_rows(result), frozenset({1, 2, 3}))
    )
    yield _make_prediction_section(
        "first", "Prediction on the first flight", _FIRST_NOTE, result.old_errors, result.new_errors
    )
    yield _make_prediction_section(
        "second", "Prediction on the second flight", _SECOND_NOTE, comparison.old_errors, comparison.new_errors
    )
    drawings = [_draw_axis(before, after, name, row, box) for row, name in enumerate(before.design.axes)]
    yield PageSection(
        "Motion", _MOTION_NOTE, render_grid(drawings), (*_MARKS, _TARGET_MARK, *([] if box is None else [_BOX_MARK]))
    )


def _make_prediction_section(
    key: str, title: str, save_progress: str, old: PredictionErrors, new: PredictionErrors
) -> PageSection:
    columns = make_error_columns(old)
    body = render_table(columns, make_error_rows(old, new), frozenset(range(2, len(columns))))
    return PageSection(title, save_progress, body + render_grid([_draw_error_growth(key, old, new)]), _MODEL_MARKS)


def _draw_hold(before: FlightData, after: FlightData) -> Drawing:
    with open_canvas("held", _HEIGHT_IN) as canvas:
        ax = canvas.axes("Distance from the last place", "time of holding [s]", "distance [cm]")
        for flight, role in ((before, _BEFORE_ROLE), (after, _AFTER_ROLE)):
            is_held, steps = find_hold_steps(flight), flight.steps
            if not is_held.any():
                continue
            distances_m = compute_position_errors_m(flight)[is_held]
            ax.plot(steps.t_s[is_held] - steps.t_s[is_held][0], 100.0 * distances_m, color=colour(role))
        ax.set_ylim(bottom=0.0)
    return Drawing("held", canvas.svg, "distance from the last place over the time of holding, of both flights")


def _draw_error_growth(key: str, old: PredictionErrors, new: PredictionErrors) -> Drawing:
    """Draw how errors grow with the time ahead, a line for each axis."""
    title = "Error over the time ahead, each axis"
    with open_canvas(f"growing-{key}", _HEIGHT_IN) as canvas:
        ax = canvas.axes(title, "time ahead [s]", "error [mm]")
        for errors, role in ((old, _BEFORE_ROLE), (new, _AFTER_ROLE)):
            for row in errors.rms_m:
                ax.plot(errors.ahead_s, [1e3 * value for value in row], color=colour(role), marker="o", markersize=3)
        ax.set_ylim(bottom=0.0)
    return Drawing(
        f"growing-{key}", canvas.svg, f"error of the old and the new model over the time ahead, {key} flight"
    )


def _draw_axis(before: FlightData, after: FlightData, name: str, row: int, box: SafeBox | None) -> Drawing:
    with open_canvas(f"motion-{name}", _HEIGHT_IN) as canvas:
        ax = canvas.axes(name, "time [s]", "position [m]")
        for flight, role in ((before, _BEFORE_ROLE), (after, _AFTER_ROLE)):
            index = flight.design.position_index[row]
            ax.plot(flight.steps.t_s, flight.steps.state[:, index], color=colour(role))
        index = before.design.position_index[row]
        ax.plot(before.steps.t_s, before.steps.target[:, index], color=colour("target"), ls=DOTTED, lw=1.1)
        if box is not None:
            for side in (box.lower, box.upper):
                ax.axhline(side[AXES.index(name)], color=colour("limit"), ls=DASHED, lw=1.0)
    return Drawing(f"motion-{name}", canvas.svg, f"position {name} of both flights over time, and the sides of the box")
