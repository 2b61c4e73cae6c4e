"""Simulated flights, recordings as tables, and figures of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from logs.recording.ends import create_recording, describe_ending
from logs.recording.export import list_tables, read_table
from logs.recording.flight import FlightData
from logs.recording.output_files import refuse_recording_path
from logs.recording.reader import explain_missing_end, read_header, read_kind
from logs.recording.reader import read as read_records
from logs.recording.summary import FlightSummary, summarise
from uavctl.api.control import Source, load, resolve_config
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.load import parse_recorded
from uavctl.daemon.flight_orders import FlightOrders, check_places, compute_stop_limit_s, make_goto_keys
from uavctl.errors import RecordingError, UsageError, in_words, need
from uavctl.lab.lockstep import LockstepFlight, check_length
from uavctl.records import Ending, Truth
from uavctl.wiring.controller import build_flight_design, prepare

if TYPE_CHECKING:
    import pandas
    import polars
    import pyarrow


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
