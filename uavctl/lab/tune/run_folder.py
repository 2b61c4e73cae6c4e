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

from logs.recording.disk import write_atomically
from logs.recording.flight import FlightData
from logs.recording.summary import compute_position_errors_m
from logs.report.page import Mark, PageSection, render_grid, render_page, render_table
from logs.report.plots import DASHED, DOTTED
from logs.report.svg import Drawing, colour, open_canvas
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.load import dump_config, flatten_keys, parse
from uavctl.errors import UsageError
from uavctl.lab.trial import beyond_m, rms_m
from uavctl.lab.tune.change import Change, PredictionErrors, TunedResult
from uavctl.lab.tune.excitation import SETTLES_S, SafeBox
from uavctl.records import ControlMode
from uavctl.smpc.plant import AXES

# Two flights of the same mission, before and after: how well the place was held, and how well plans came true.

PLANNED_AHEAD_S = 0.5  # so much later a plan is compared with what became of it
LEAST_HOLD_S = 2.0
_SAME_M = 1e-6


class TunedFlight(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one of the two flights; None where it does not show them."""

    recording: str
    judged_by: str  # "truth" where the simulator told it, else "estimate"
    flown_s: float
    hold_s: float  # that count
    hold_rms_m: float | None  # distance from the last place, three axes together
    hold_max_m: float | None
    plan_rms_m: float | None  # distance from where the plan of PLANNED_AHEAD_S before had the vehicle
    beyond_box_m: float | None  # furthest outside of the box; negative is the room that was left; None without a box
    fallbacks: int


class TuneComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Comparison of both flights, and of both models on the second, which neither was fitted to."""

    before: TunedFlight
    after: TunedFlight
    old_errors: PredictionErrors
    new_errors: PredictionErrors


def figures_of(flight: FlightData, recording: str, fallbacks: int, box: SafeBox | None) -> TunedFlight:
    """Return the figures of a flight.

    Args:
        fallbacks: Entries into braking, holding or landing that nobody wanted.
        box: Where it was to stay; None where nothing was said.
    """
    steps = flight.steps
    held = holding(flight)
    distances = compute_position_errors_m(flight)[held]
    hold_s = float(np.count_nonzero(held)) * flight.design.dt_s
    enough = hold_s >= LEAST_HOLD_S
    planned = plan_errors_m(flight)
    return TunedFlight(
        recording=recording,
        judged_by="truth" if steps.from_truth else "estimate",
        flown_s=round(len(steps) * flight.design.dt_s, 6),
        hold_s=round(hold_s, 6),
        hold_rms_m=rms_m(distances) if enough else None,
        hold_max_m=float(distances.max()) if enough else None,
        plan_rms_m=rms_m(planned) if len(planned) else None,
        beyond_box_m=None if box is None else _beyond(flight, box),
        fallbacks=fallbacks,
    )


def last_place(flight: FlightData) -> tuple[NDArray[np.bool_], float]:
    """Return which steps were flown by plans to the mission's last place (n,), and since when it was the target [s]."""
    steps = flight.steps
    tracked = np.array([d.mode is ControlMode.TRACK for d in steps.decisions], dtype=np.bool_)
    if not tracked.any():
        return tracked, math.inf
    index = list(flight.design.position_index)
    last = steps.target[np.flatnonzero(tracked)[-1]][index]
    there = np.linalg.norm(steps.target[:, index] - last, axis=1) <= _SAME_M
    moved = np.flatnonzero(tracked & ~there)
    begin = int(moved[-1]) + 1 if len(moved) else int(np.flatnonzero(tracked)[0])
    chosen = tracked & there & (np.arange(len(tracked)) >= begin)
    return chosen, float(steps.t_s[begin])


def holding(flight: FlightData) -> NDArray[np.bool_]:
    """Return the steps (n,) at which the last place was held: from `SETTLES_S` after it became the target."""
    chosen, since_s = last_place(flight)
    return np.asarray(chosen & (flight.steps.t_s >= since_s + SETTLES_S), dtype=np.bool_)


def plan_errors_m(flight: FlightData) -> Array:
    """Return the distance between plan and flight `PLANNED_AHEAD_S` later (n,) [m]."""
    steps, index = flight.steps, list(flight.design.position_index)
    ahead = max(1, round(PLANNED_AHEAD_S / flight.design.dt_s))
    dt_ns = flight.design.dt_ns
    known_ns = np.array([d.at_ns for d in steps.decisions], dtype=np.int64)
    wrong = []
    for plan in flight.flown_plans.values():
        if ahead >= len(plan.states):
            continue
        place = int(np.searchsorted(known_ns, plan.base_ns + ahead * dt_ns))
        near = [one for one in (place - 1, place) if 0 <= one < len(known_ns)]
        if len(near) < 2:
            continue
        left, right = near
        span = int(known_ns[right] - known_ns[left])
        if span > 2 * dt_ns:
            continue  # nobody flew by plans in between
        share = (plan.base_ns + ahead * dt_ns - int(known_ns[left])) / span
        was = (1.0 - share) * steps.state[left][index] + share * steps.state[right][index]
        wrong.append(float(np.linalg.norm(was - np.array(plan.states[ahead])[index])))
    return np.array(wrong)


def _beyond(flight: FlightData, box: SafeBox) -> float | None:
    """Return how far outside the box a step flown by plans was at most [m]."""
    steps = flight.steps
    tracked = [place for place, d in enumerate(steps.decisions) if d.mode is ControlMode.TRACK]
    if not tracked:
        return None
    positions = steps.state[tracked][:, list(flight.design.position_index)]
    axes = [AXES.index(axis) for axis in flight.design.axes]
    return float(beyond_m(positions, np.array(box.lower)[axes], np.array(box.upper)[axes]).max())


STATE, SETTINGS, TUNED, PAGE, FIT_PAGE = "tune.json", "configuration.toml", "tuned.toml", "tune.html", "identified.html"
BEFORE, AFTER = "before", "after"  # folders of the flights; later attempts have numbers
_MOST_TOLD = 5


class TuneAsked(msgspec.Struct, frozen=True, kw_only=True):
    """What a tuning run was asked for; it may not change between two calls."""

    box: str  # as it was understood; empty without one
    flight: str  # the recording that is begun with; empty where one is flown
    simulated: bool
    take_off_m: float | None


class TuneProgress(msgspec.Struct, frozen=True, kw_only=True):
    """Progress of a tuning run."""

    asked: TuneAsked
    digest: str  # of the configuration
    before: str = ""  # recording of the excitation, once it is whole; relative to the folder if inside
    tuned: TunedResult | None = None
    after: str = ""  # recording of the flight with the tuned configuration
    comparison: TuneComparison | None = None


class TuneFolder:
    """Folder of a tuning run on disk."""

    def __init__(self, path: Path, progress: TuneProgress) -> None:
        self.path = path
        self.progress = progress  # how far the run has come

    @classmethod
    def opened(cls, path: Path, config: Config, asked: TuneAsked) -> TuneFolder:
        """Begin a run, or go on with the one that is there.

        Raises:
            UsageError: The folder holds something else, or a run of another configuration.
        """
        text = dump_config(config)
        digest = hashlib.sha256(text.encode()).hexdigest()
        if not (path / STATE).exists():
            # A run that was cut off while it wrote its first file leaves a part of that.
            if path.exists() and (not path.is_dir() or any(one.name != f"{STATE}.part" for one in path.iterdir())):
                raise UsageError(f"--folder {path}: is no run of `uavctl tune`, and not empty; choose another folder")
            path.mkdir(parents=True, exist_ok=True)
            folder = cls(path, TuneProgress(asked=asked, digest=digest))
            folder.note()
            write_atomically(path / SETTINGS, text)
            return folder
        progress = _read(path / STATE)
        if progress.digest != digest:
            told = "; ".join(_differences(path / SETTINGS, text)) or "other values"
            raise UsageError(
                f"--folder {path}: is a run of another configuration ({told}). Give that one to go on, or choose "
                "another folder"
            )
        if progress.asked != asked:
            told = ", ".join(_asked_otherwise(progress.asked, asked))
            raise UsageError(
                f"--folder {path}: is a run that was begun with {told}. Go on with the same, or choose another folder"
            )
        folder = cls(path, progress)
        if not (path / SETTINGS).exists():
            write_atomically(path / SETTINGS, text)
        if progress.comparison is None:
            folder.note()  # a folder that takes no more is told before anything is flown
        return folder

    def note(self, **done: object) -> None:
        """Record that a step is done.

        Raises:
            RecordingError: It cannot be written.
        """
        self.progress = msgspec.structs.replace(self.progress, **done)
        write_atomically(self.path / STATE, msgspec.json.format(msgspec.json.encode(self.progress)).decode() + "\n")

    def free(self, name: str) -> Path:
        """Return a folder for one more flight: the first of NAME, NAME-2, NAME-3, … that does not exist yet."""
        return self._attempts(name)[1]

    def newest(self, name: str) -> Path | None:
        """Return the folder of the newest attempt at a flight; None before the first."""
        return self._attempts(name)[0]

    def _attempts(self, name: str) -> tuple[Path | None, Path]:
        newest, number = None, 1
        while (found := self.path / (name if number == 1 else f"{name}-{number}")).exists():
            newest, number = found, number + 1
        return newest, found

    def recording(self, noted: str) -> Path:
        """Return the path of a recording that the progress names."""
        return self.path / noted  # an absolute one stays what it is

    def relative(self, recording: Path) -> str:
        """Return the name of a recording for the progress, relative, so that the folder may be moved."""
        try:
            return str(recording.relative_to(self.path))
        except ValueError:
            return str(recording.absolute())


@contextmanager
def sole_run(path: Path) -> Iterator[None]:
    """Lock the folder of a run, made if there is none; the kernel releases it when its holder ends.

    Raises:
        UsageError: Another process has it, or it cannot be made.
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
    """Read the tuned configuration, as it was written or as its owner has changed it since.

    Raises:
        UsageError: It was cut: what it lacks would be a preset's, and nobody has seen that fly.
        ConfigError: It is wrong.
    """
    text = path.read_text(encoding="utf-8")
    config = parse(text, str(path)).config
    there = dict(flatten_keys(tomllib.loads(text)))
    lacking = [key for key, _ in flatten_keys(tomllib.loads(dump_config(config))) if key not in there]
    if lacking:
        more = f" and {len(lacking) - 1} more keys" if len(lacking) > 1 else ""
        raise UsageError(
            f"{path}: is not whole, {lacking[0]}{more} are missing; put them back, or remove the file: the same "
            "command then writes it anew"
        )
    return config


def _read(path: Path) -> TuneProgress:
    try:
        return msgspec.json.decode(path.read_bytes(), type=TuneProgress)
    except (OSError, msgspec.DecodeError) as error:
        raise UsageError(f"{path}: cannot be read ({error}); choose another --folder") from error


def _differences(settings: Path, text: str) -> Iterator[str]:
    """Return the first keys in which two configurations differ, with both values."""
    try:
        old = dict(flatten_keys(tomllib.loads(settings.read_text(encoding="utf-8"))))
    except (OSError, tomllib.TOMLDecodeError):
        return
    new = dict(flatten_keys(tomllib.loads(text)))
    keys = [key for key in dict.fromkeys([*old, *new]) if old.get(key) != new.get(key)]
    for key in keys[:_MOST_TOLD]:
        yield f"{key} = {old.get(key)} there, {new.get(key)} here"
    if len(keys) > _MOST_TOLD:
        yield f"{len(keys) - _MOST_TOLD} more"


def _asked_otherwise(there: TuneAsked, here: TuneAsked) -> Iterator[str]:
    if there.box != here.box:
        yield f"--box={there.box}" if there.box else "no --box"
    if there.flight != here.flight:
        yield f"--flight {there.flight}" if there.flight else "no --flight"
    if there.simulated != here.simulated:
        yield "--loopback" if there.simulated else "a real vehicle"
    if there.take_off_m != here.take_off_m:
        yield "no --arm" if there.take_off_m is None else f"--arm --takeoff {there.take_off_m:g}"


CHANGE_COLUMNS = ("value", "old", "the flight says", "new", "why")
FIGURE_COLUMNS = ("figure", "before", "after", "after / before")
_NONE = "–"


def change_rows(told: TunedResult) -> Iterator[tuple[str, ...]]:
    """Return a row for each value: name, old value, what the flight shows, new value, reason."""
    for row in told.changes:
        yield (name_of(row), f"{row.old:.4g}", _said(row), f"{row.new:.4g}" if row.changed else "=", row.reason)


def name_of(row: Change) -> str:
    """Return key, axis and unit of a value."""
    unit = f" [{row.unit}]" if row.unit else ""
    return f"{row.key}{f' {row.axis}' if row.axis else ''}{unit}"


def error_columns(errors: PredictionErrors) -> tuple[str, ...]:
    """Return the headings of the prediction errors."""
    return ("axis", "model", *(f"{time_s:g} s [mm]" for time_s in errors.ahead_s))


def error_rows(old: PredictionErrors, new: PredictionErrors) -> Iterator[tuple[str, ...]]:
    """Return the rms errors of both models, axis by axis."""
    for axis, before, after in zip(old.axes, old.rms_m, new.rms_m, strict=True):
        for model, row in (("old", before), ("new", after)):
            yield (axis, model, *(f"{1e3 * value:.1f}" for value in row))


def figure_rows(found: TuneComparison) -> Iterator[tuple[str, ...]]:
    """Return the figures of both flights."""
    before, after = found.before, found.after
    yield _row("held to, rms [cm]", before.hold_rms_m, after.hold_rms_m, 100.0)
    yield _row("held to, at most [cm]", before.hold_max_m, after.hold_max_m, 100.0)
    yield _row(f"off the plan of {PLANNED_AHEAD_S:g} s before, rms [cm]", before.plan_rms_m, after.plan_rms_m, 100.0)
    yield _row("model off on the second flight [mm]", found.old_errors.overall_m, found.new_errors.overall_m, 1000.0)
    if before.beyond_box_m is not None and after.beyond_box_m is not None:
        yield ("room left in the box [m]", f"{-before.beyond_box_m:.2f}", f"{-after.beyond_box_m:.2f}", _NONE)
    yield ("fallbacks", str(before.fallbacks), str(after.fallbacks), _NONE)


def story(told: TunedResult, found: TuneComparison | None) -> list[str]:
    """Return sentences on the result."""
    changed = sum(row.changed for row in told.changes)
    old_m, new_m = told.old_errors.overall_m, told.new_errors.overall_m
    said = [
        f"{changed} of {len(told.changes)} values of the configuration were changed.",
        f"On the halves of the first flight that it was not fitted to, the model is off by {1e3 * new_m:.1f} mm, not "
        f"{1e3 * old_m:.1f} mm (0.25 to 2 s ahead).",
    ]
    if found is not None:
        said.append(
            f"On the second flight, which neither was fitted to: {1e3 * found.new_errors.overall_m:.1f} mm instead of "
            f"{1e3 * found.old_errors.overall_m:.1f} mm."
        )
        before_m, after_m = found.before.hold_rms_m, found.after.hold_rms_m
        if before_m is not None and after_m is not None:
            said.append(
                f"The last place was held to {100.0 * after_m:.1f} cm (rms, {found.after.hold_s:.0f} s) instead of "
                f"{100.0 * before_m:.1f} cm, by the {found.after.judged_by}."
            )
    return [*said, *(f"{one}." for one in told.warnings)]


def _said(row: Change) -> str:
    if row.flight is None:
        return _NONE
    return f"{row.flight:.4g}" if row.std is None else f"{row.flight:.4g} ± {row.std:.2g}"


def _row(name: str, before: float | None, after: float | None, scale: float) -> tuple[str, ...]:
    ratio = _NONE if before is None or after is None or not before else f"{after / before:.2f}"
    return (name, *(_NONE if one is None else f"{scale * one:.1f}" for one in (before, after)), ratio)


_HEIGHT_IN = 2.6
_BEFORE, _AFTER = "sample", "estimate"  # roles of the colours
_MARKS = (Mark("line", _BEFORE, "before"), Mark("line", _AFTER, "after"))
_MODELS = (Mark("line", _BEFORE, "old model"), Mark("line", _AFTER, "new model"))
_TARGET, _BOX = Mark("dotted", "target", "place to fly to, before"), Mark("dashed", "limit", "box")
_CHANGES = (
    "Taken over is what the flight tells well; ± is the standard error. Noise, loss and delay are raised where the "
    "flight was worse than believed, and never lowered. An = is a value that stays."
)
_FIGURES = (
    "Held: distance from the last place, from 5 s after it became the one to fly to. Off the plan: how far the vehicle "
    "was from where the plan of half a second before had it. The model is off by the geometric mean of errors below."
)
_ERROR = "Root mean square of the motion over the next step and the next 0.25 to 2 s that is not told, "
_ON_FIRST = f"{_ERROR}each half of the flight by plants fitted to the other."
_ON_SECOND = f"{_ERROR}of a flight that neither was fitted to."
_MOTION = "Positions, by the true states if they were recorded, else by the controllers' estimates."
_HOLD = "Distance from the last place, from when it was to be held."


def write_page(progress: TuneProgress, before: FlightData, after: FlightData, box: SafeBox | None) -> str:
    """Return the page of a run that is done as HTML.

    Args:
        progress: The run; changes and comparison are there.
        box: Where both were to stay; None with a recording.
    """
    assert progress.tuned is not None and progress.comparison is not None
    told, found = progress.tuned, progress.comparison
    sections = _sections(progress, found, before, after, box)
    return render_page(
        "Tuned by flying", f"{found.before.recording}, {found.after.recording}", story(told, found), sections
    )


def _sections(
    progress: TuneProgress, found: TuneComparison, before: FlightData, after: FlightData, box: SafeBox | None
) -> Iterator[PageSection]:
    assert progress.tuned is not None
    told = progress.tuned
    yield PageSection("Both flights", _FIGURES, render_table(FIGURE_COLUMNS, figure_rows(found), frozenset({1, 2, 3})))
    yield PageSection("How the place was held", _HOLD, render_grid([_held(before, after)]), _MARKS)
    yield PageSection("What changes", _CHANGES, render_table(CHANGE_COLUMNS, change_rows(told), frozenset({1, 2, 3})))
    yield _prediction("first", "Prediction on the first flight", _ON_FIRST, told.old_errors, told.new_errors)
    yield _prediction("second", "Prediction on the second flight", _ON_SECOND, found.old_errors, found.new_errors)
    drawings = [_axis(before, after, name, place, box) for place, name in enumerate(before.design.axes)]
    yield PageSection("Motion", _MOTION, render_grid(drawings), (*_MARKS, _TARGET, *([] if box is None else [_BOX])))


def _prediction(key: str, title: str, note: str, old: PredictionErrors, new: PredictionErrors) -> PageSection:
    columns = error_columns(old)
    body = render_table(columns, error_rows(old, new), frozenset(range(2, len(columns))))
    return PageSection(title, note, body + render_grid([_growing(key, old, new)]), _MODELS)


def _held(before: FlightData, after: FlightData) -> Drawing:
    with open_canvas("held", _HEIGHT_IN) as drawn:
        ax = drawn.axes("Distance from the last place", "time of holding [s]", "distance [cm]")
        for flight, role in ((before, _BEFORE), (after, _AFTER)):
            held, steps = holding(flight), flight.steps
            if not held.any():
                continue
            off = compute_position_errors_m(flight)[held]
            ax.plot(steps.t_s[held] - steps.t_s[held][0], 100.0 * off, color=colour(role))
        ax.set_ylim(bottom=0.0)
    return Drawing("held", drawn.svg, "distance from the last place over the time of holding, of both flights")


def _growing(key: str, old: PredictionErrors, new: PredictionErrors) -> Drawing:
    """Draw how errors grow with the time ahead, a line for each axis."""
    title = "Error over the time ahead, each axis"
    with open_canvas(f"growing-{key}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(title, "time ahead [s]", "error [mm]")
        for errors, role in ((old, _BEFORE), (new, _AFTER)):
            for row in errors.rms_m:
                ax.plot(errors.ahead_s, [1e3 * value for value in row], color=colour(role), marker="o", markersize=3)
        ax.set_ylim(bottom=0.0)
    return Drawing(f"growing-{key}", drawn.svg, f"error of the old and the new model over the time ahead, {key} flight")


def _axis(before: FlightData, after: FlightData, name: str, place: int, box: SafeBox | None) -> Drawing:
    with open_canvas(f"motion-{name}", _HEIGHT_IN) as drawn:
        ax = drawn.axes(name, "time [s]", "position [m]")
        for flight, role in ((before, _BEFORE), (after, _AFTER)):
            index = flight.design.position_index[place]
            ax.plot(flight.steps.t_s, flight.steps.state[:, index], color=colour(role))
        index = before.design.position_index[place]
        ax.plot(before.steps.t_s, before.steps.target[:, index], color=colour("target"), ls=DOTTED, lw=1.1)
        if box is not None:
            for side in (box.lower, box.upper):
                ax.axhline(side[AXES.index(name)], color=colour("limit"), ls=DASHED, lw=1.0)
    return Drawing(f"motion-{name}", drawn.svg, f"position {name} of both flights over time, and the sides of the box")
