"""Simulated flights, recordings as tables, and figures of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from logs.recording.ends import create_recording, describe_ending
from logs.recording.export import list_tables, read_table
from logs.recording.flight import FlightData
from logs.recording.output_files import refuse_recording_path
from logs.recording.reader import explain_missing_end, read_header, read_kind
from logs.recording.reader import read as read_records
from logs.recording.summary import FlightSummary, summarise
from uavctl.api.control import Runs, Signal, SolvedPlan, Source, get_limits, list_signals, load, resolve_config
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.load import parse_recorded
from uavctl.daemon.flight_orders import FlightOrders, check_places, compute_stop_limit_s, make_goto_keys
from uavctl.errors import RecordingError, UsageError, in_words, need
from uavctl.lab.lockstep import LockstepFlight, check_length
from uavctl.records import Ending, Truth
from uavctl.smpc.plant import AXES
from uavctl.wiring.controller import build_flight_design, build_problem, prepare

if TYPE_CHECKING:
    import pandas
    import polars
    import pyarrow
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Recording:
    """A recording with its topics as tables; a table is read from the disk on request.

    Every table has `log_time_ns`, `time_s` (since the first record) and, since version 0.2, `utc`; then the record's
    own fields, with their units in their names.
    """

    path: Path  # its first file
    topics: tuple[str, ...]  # its topics, and lists of records within them, as `/uavctl/step_input.samples`

    def __repr__(self) -> str:
        """Return one line; `topics` are the tables."""
        return f"recording {self.path}, {len(self.topics)} tables"

    @cached_property
    def config(self) -> Config:
        """The configuration that was flown.

        Raises:
            RecordingError: The recording has no header.
        """
        return parse_recorded(read_header(self.path).config_toml, f"{self.path} (configuration)").config

    @cached_property
    def data(self) -> FlightData:
        """All records of the flight, by type."""
        return FlightData.from_records(read_records(self.path), self.path)

    @cached_property
    def summary(self) -> FlightSummary:
        """Figures of the flight, as `uavctl log report --json` has them."""
        dropped = max((note.dropped for note in self.data.notes), default=0)
        return summarise(self.data, wall_s=None, recording=str(self.path), report="", recorder_dropped=dropped)

    def arrow(self, topic: str) -> pyarrow.Table:
        """Return a topic as an Arrow table.

        Raises:
            RecordingError: There is no such topic in it.
            ExtraMissingError: pyarrow is not there.
        """
        need("pyarrow", "parquet")
        return read_table(self.path, topic)

    def pandas(self, topic: str) -> pandas.DataFrame:
        """Return a topic as a pandas frame; whole numbers stay whole where some are missing (`Int64`).

        Raises:
            RecordingError: There is no such topic in it.
            ExtraMissingError: pandas or pyarrow is not there.
        """
        need("pandas", "pandas")
        import pandas as pd

        table = self.arrow(topic)
        column_types = {"int64": pd.Int64Dtype(), "bool": pd.BooleanDtype()}
        frame: pandas.DataFrame = table.to_pandas(types_mapper=lambda arrow_type: column_types.get(str(arrow_type)))
        return frame

    def polars(self, topic: str) -> polars.DataFrame:
        """Return a topic as a polars frame.

        Raises:
            RecordingError: There is no such topic in it.
            ExtraMissingError: polars or pyarrow is not there.
        """
        need("polars", "polars")
        import polars as pl

        return pl.from_arrow(self.arrow(topic))

    def report(self, out: str | Path | None = None) -> Path:
        """Write the page of the flight, and return its path.

        Args:
            out: The page; None: beside the recording.

        Raises:
            RecordingError: Nothing was flown, or the page cannot be written.
        """
        from logs.report.flight_page import write_report

        page = self.path.with_suffix(".html") if out is None else Path(out)
        refuse_recording_path(page)
        write_report(self.data, msgspec.structs.replace(self.summary, report=str(page)), page)
        return page


def read(path: str | Path, *, torn: bool = False) -> Recording:
    """Open a recording.

    Args:
        path: Its first file.
        torn: Whether one without an end may be read, as far as it goes.

    Raises:
        RecordingError: There is none, it is damaged, or it has no end and `torn` is not set.
    """
    path = Path(path)
    end_problem = explain_missing_end(path)
    if end_problem and not torn:
        raise RecordingError(
            f"{path}: {end_problem}; read(path, torn=True) reads it as far as it goes, `uavctl log recover` restores it"
        )
    return Recording(path, list_tables(path))


@dataclass(frozen=True, eq=False)
class Flight:
    """A simulated flight: its ending, its recording, and the true path of the vehicle."""

    config: Config
    ending: Ending  # cause, sentence, whether as ordered, exit code
    recording: Recording
    time_s: Array  # (n,), of the true path: every Δt
    position_m: Array  # true position (n, 3), local NED
    velocity_mps: Array  # true velocity (n, 3), local NED

    def __repr__(self) -> str:
        """Return three lines: configuration and length, ending, recording."""
        flown_s = self.time_s[-1] - self.time_s[0] if len(self.time_s) else 0.0
        return (
            f"flight of {self.config.name}, {flown_s:g} s\n  ended: {self.ending.sentence}\n"
            f"  recorded in {self.recording.path}"
        )


def fly(
    config: Source = "room",
    out: str | Path | None = None,
    *,
    seed: int | None = None,
    duration_s: float | None = None,
    take_off_m: float | None = None,
    goto: Sequence[float] | None = None,
) -> Flight:
    """Fly the simulated vehicle in virtual time, as `uavctl loopback` does; the same seed gives the same flight.

    Args:
        config: The configuration.
        out: Folder of the recording; None: a new one below `flights/`.
        seed: Seed of every random draw; None: `sim.seed`.
        duration_s: Length [s]; None: that of the configuration.
        take_off_m: Begin on the ground, disarmed, arm, climb so far [m], and land after the length; None begins and
            ends in the air.
        goto: Place in local NED [m] to fly to and stay; None: the configured mission.

    Raises:
        ConfigError: The configuration is wrong.
        DesignError: There is no design.
        RecordingError: The recording cannot be written, or is there already.
        UsageError: The flight is shorter than a tick, or the vehicle may not rest where it is to climb or go.
    """
    keys = {"sim.seed": seed, "duration_s": duration_s, **({} if goto is None else make_goto_keys(goto))}
    if take_off_m is not None and not take_off_m > 0:
        raise UsageError(f"take_off_m {take_off_m}: give a height above the ground [m]")
    flight_config = load(resolve_config(config), {key: value for key, value in keys.items() if value is not None})
    check_length(flight_config)
    design = build_flight_design(flight_config)
    orders = FlightOrders(flight_config, take_off_m=take_off_m, goto=goto is not None)
    check_places(flight_config, design, take_off_m, orders.goal)
    prepared = prepare(flight_config, design)
    with create_recording(None if out is None else Path(out), flight_config.name, flight_config.log) as path:
        flight = LockstepFlight(prepared, path, command="uavctl.fly")
        orders.begin(flight.loop)
        landing_s = None if take_off_m is None else compute_stop_limit_s(flight_config, takes_off=True)
        try:
            flight.fly(lambda _: True, observer=orders, landing_s=landing_s)
        except Exception as error:
            flight.loop.account.control_error = in_words(error)
            raise
        finally:
            status = flight.close()
    truth = tuple(read_kind(path, Truth))
    return Flight(
        config=flight_config,
        ending=describe_ending(flight.loop.ending, status),
        recording=read(path, torn=True),
        time_s=np.array([sample.at_ns for sample in truth]) * 1e-9,
        position_m=np.array([sample.position_m for sample in truth]).reshape(-1, 3),
        velocity_mps=np.array([sample.velocity_mps for sample in truth]).reshape(-1, 3),
    )


_QUANTILES = (0.05, 0.5, 0.95)


def plot(what: SolvedPlan | Runs | Flight | Recording) -> Figure:
    """Draw a plan, runs or a flight, with names, units and limits; the figure is returned, not shown.

    SolvedPlan: predicted states and inputs, and where it ends. Runs: median of each position (of each state, where a
    plant has no axes), and between which two values nine in ten runs are. Flight: the path from above and from the
    side.

    Raises:
        UsageError: It has no figure.
        RecordingError: Nothing was flown in the recording.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    if isinstance(what, SolvedPlan):
        _draw_plan(figure, what)
    elif isinstance(what, Runs):
        _draw_runs(figure, what)
    elif isinstance(what, Flight):
        _draw_path(figure, what.recording)
    elif isinstance(what, Recording):
        _draw_path(figure, what)
    else:
        raise UsageError(f"a {type(what).__name__} has no figure; give a result of solve, simulate, fly or read")
    return figure


_PANELS_PER_ROW = 3
_MAX_PANELS = 12


class _Panel(NamedTuple):
    """Panel of several signals: title, unit, and (label, values (…, T), limits, target) of each signal."""

    title: str
    unit: str
    rows: list[tuple[str, Array, tuple[float, float], float | None]]


def _group_panels(
    signals: Sequence[Signal], values: Array, limits: Sequence[tuple[float, float]], target: Array | None
) -> list[_Panel]:
    """Group signals of a kind into one panel; each signal of a plant without axes has its own."""
    panels: dict[str, _Panel] = {}
    for i, signal in enumerate(signals):
        axis, _, kind = signal.name.partition(" ")
        key = kind if axis in AXES else signal.name
        panel = panels.setdefault(key, _Panel(key, signal.unit, []))
        label = axis if axis in AXES else signal.name
        panel.rows.append((label, values[..., i], limits[i], None if target is None else float(target[i])))
    return list(panels.values())


def _draw_plan(figure: Figure, plan: SolvedPlan) -> None:
    if not plan.inputs.size:
        raise UsageError(f"there is no plan to draw: {plan!r}")
    (states, inputs), (state_limits, input_limits) = list_signals(plan.config), get_limits(plan.config)
    panels = [
        *_group_panels(states, plan.states, state_limits, plan.reference),
        *_group_panels(inputs, plan.inputs, input_limits, None),
    ]
    for ax, panel in _make_grid(figure, panels, "time ahead [s]"):
        for number, (label, values, limits, target) in enumerate(panel.rows):
            time_s = plan.config.plant.dt_s * np.arange(len(values))
            drawstyle = "steps-post" if len(values) < len(plan.states) else "default"
            ax.plot(time_s, values, color=f"C{number}", label=label, drawstyle=drawstyle)
            _draw_limits(ax, limits, target, f"C{number}")
        _add_legend(ax, panel)


def _draw_runs(figure: Figure, runs: Runs) -> None:
    if runs.failed.all():
        raise UsageError(f"there is no run to draw: {runs!r}")
    problem, (states, _), (limits, _) = build_problem(runs.config), list_signals(runs.config), get_limits(runs.config)
    state_indices = list(problem.plant.position_index) or list(range(problem.plant.n_x))
    panels = [
        _Panel(states[i].name, states[i].unit, [("median", runs.states[:, :, i], limits[i], float(problem.target[i]))])
        for i in state_indices
    ]
    for ax, panel in _make_grid(figure, panels, "time [s]"):
        ((label, values, limits_of_state, target),) = panel.rows
        low, middle, high = np.quantile(values[~runs.failed], _QUANTILES, axis=0)
        ax.fill_between(runs.time_s, low, high, alpha=0.25, lw=0, label="nine in ten runs")
        ax.plot(runs.time_s, middle, label=label)
        _draw_limits(ax, limits_of_state, target, "C3")
        _add_legend(ax, panel)


def _draw_limits(ax: Axes, limits: tuple[float, float], target: float | None, colour: str) -> None:
    for limit in limits:
        if np.isfinite(limit):
            ax.axhline(limit, ls="--", lw=1.0, color=colour, alpha=0.7)
    if target is not None:
        ax.axhline(target, ls=":", lw=1.0, color=colour)


def _add_legend(ax: Axes, panel: _Panel) -> None:
    ax.plot([], [], ls="--", lw=1.0, color="0.4", label="limit")
    if any(target is not None for *_, target in panel.rows):
        ax.plot([], [], ls=":", lw=1.0, color="0.4", label="target")
    ax.legend(fontsize="x-small")


def _make_grid(figure: Figure, panels: Sequence[_Panel], x_label: str) -> Iterator[tuple[Axes, _Panel]]:
    """Yield axes for the first panels, a few in a row, with title, unit and time."""
    shown = panels[:_MAX_PANELS]
    columns = min(_PANELS_PER_ROW, len(shown))
    rows = -(-len(shown) // columns)
    figure.set_size_inches(3.4 * columns + 0.6, 2.9 * rows)
    for position, panel in enumerate(shown, 1):
        ax = figure.add_subplot(rows, columns, position)
        unit = f" [{panel.unit}]" if panel.unit else ""
        ax.set(title=panel.title.capitalize(), xlabel=x_label, ylabel=f"{panel.title}{unit}")
        ax.grid(visible=True, alpha=0.3)
        yield ax, panel


def _draw_path(figure: Figure, recording: Recording) -> None:
    from logs.report.plots import draw_path

    views = [("From above", ("east", "north"))]
    if "down" in recording.data.design.axes:
        views.append(("From the south", ("east", "down")))
    for position, (title, view_axes) in enumerate(views, 1):
        names = ["height" if axis == "down" else axis for axis in view_axes]
        ax = _add_axes(figure, len(views), position, title, f"{names[0]} [m]", f"{names[1]} [m]")
        draw_path(ax, recording.data, view_axes)


def _add_axes(figure: Figure, count: int, position: int, title: str, x_label: str, y_label: str) -> Axes:
    ax = figure.add_subplot(1, count, position)
    ax.set(title=title, xlabel=x_label, ylabel=y_label)
    ax.grid(visible=True, alpha=0.3)
    return ax
