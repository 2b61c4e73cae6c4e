"""The recordings of a comparison, in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from logs.flight_data import FlightData
from logs.info import info
from logs.reader import read
from logs.summary import FlightSummary, summarise


class Side(msgspec.Struct, frozen=True, kw_only=True):
    """One of the recordings."""

    name: str  # A, B, ...
    recording: str
    config: str
    command: str
    started_utc: str
    seed: int
    ended: str
    finished: bool  # closed in order; else compared up to its end
    records_lost: int  # dropped, refused, or missing in the file


@dataclass(frozen=True, eq=False)
class Loaded:
    """A recording in memory."""

    side: Side
    flight: FlightData
    summary: FlightSummary


def load_all(paths: Sequence[Path], on_loaded: Callable[[], None] = lambda: None) -> tuple[Loaded, ...]:
    """Read recordings.

    Raises:
        RecordingError: One cannot be read, or nothing was flown in it; names it.
    """
    loaded = []
    for number, path in enumerate(paths):
        loaded.append(_load(path, _letter(number)))
        on_loaded()
    return tuple(loaded)


def _load(path: Path, name: str) -> Loaded:
    whole = info(path)
    flight = FlightData.from_records(read(path), path)
    summary = summarise(flight, wall_s=None)
    side = Side(
        name=name,
        recording=str(path),
        config="" if whole.origin is None else whole.origin.config,
        command=flight.header.command,
        started_utc=flight.header.started_utc,
        seed=flight.header.seed,
        ended=summary.ending.cause,
        finished=whole.finished,
        records_lost=whole.dropped + whole.refused + whole.missing,
    )
    return Loaded(side, flight, summary)


def _letter(number: int) -> str:
    """A to Z, and then A1, B1 ..."""
    return chr(ord("A") + number % 26) + (str(number // 26) if number >= 26 else "")
