"""Folder of a campaign: its document, finished tasks as parts, and in the end one table of all runs.

A task is there whole or not at all, so a campaign that was killed goes on where it was; the table's bytes depend on the
runs alone.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from logs.recording.replay import unequal
from uavctl.errors import UavctlError, UsageError
from uavctl.lab.campaign.pool import Columns, Work

DOCUMENT, SPECIFICATION, RUNS, PARTS = "campaign.json", "campaign.toml", "runs.parquet", "parts"
_GROUP_ROWS = 65_536
# What tells a cell from the others, in either world: named in each row, so that the table speaks for itself.
NAMES = ("scenario", "autopilot", "rate_hz", "controller", "link", "air", "disturbance", "plant")
_WRITER: dict[str, Any] = {
    "version": "2.6",
    "compression": "zstd",
    "compression_level": 3,
    "use_dictionary": ["error", *NAMES],
}

_I32, _I64, _F64 = pa.int32(), pa.int64(), pa.float64()
SCHEMA = pa.schema(
    [
        ("cell", _I32),
        ("run", _I64),
        ("error", pa.string()),
        ("cost", _F64),
        ("settled_cost", _F64),
        ("steps", _I32),
        ("state_violations", _I32),
        ("input_violations", _I32),
        ("saturated", _I32),
        ("mean_square_input", _F64),
        ("decisions", _I32),
        ("infeasible", _I32),
        ("slack_used", _I32),
        ("fallbacks", _I32),
        ("max_age", _I32),
        ("age_sum", _I64),
        ("ages", pa.list_(_I64)),
        ("outside", pa.list_(_I64)),
        ("largest_gap", _F64),
        ("near_s", _F64),
        ("nearer_s", _F64),
        ("hold_rms_m", _F64),
        ("beyond_m", _F64),
    ]
)


class Store:
    """Folder of one campaign."""

    def __init__(self, folder: Path, schema: pa.Schema = SCHEMA) -> None:
        self.folder = folder
        self._schema = schema
        self._parts = folder / PARTS

    @contextmanager
    def opened(self, document: Mapping[str, object], specification: str, resume: bool) -> Iterator[None]:
        """Begin a campaign or go on with one, while nobody else can.

        Args:
            resume: Whether the folder's campaign is to go on.

        Raises:
            UsageError: There is a campaign and it is not to go on, there is none, it is another one, or another process
                is at it.
            UavctlError: The folder cannot be made or written.
        """
        with ExitStack() as stack:
            with self._disk():
                self.folder.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((self.folder / ".lock").open("ab"))
                _alone(lock.fileno(), self.folder)
                self._begin(document, specification, resume)
                self._parts.mkdir(exist_ok=True)
            yield

    def begun(self) -> bool:
        """Return whether there is a campaign that can go on."""
        return (self.folder / DOCUMENT).exists()

    def check(self, resume: bool) -> None:
        """Check that there is a campaign if one is to go on, and none if not.

        Raises:
            UsageError: It is the other way round.
        """
        if self.begun() and not resume:
            raise UsageError(f"{self.folder} holds a campaign; go on with it by --resume, or choose another folder")
        if resume and not self.begun():
            raise UsageError(f"{self.folder} holds no campaign that could go on; leave out --resume")

    def complete(self) -> bool:
        """Return whether all runs are in the table."""
        return (self.folder / RUNS).exists()

    def kept(self, tasks: Sequence[Work]) -> set[str]:
        """Return the names of the finished tasks."""
        return {task.name for task in tasks if self._part(task).exists()}

    def keep(self, task: Work, columns: Columns) -> None:
        """Write a task's rows; once this returns, they survive a kill.

        Raises:
            UavctlError: They cannot be written.
        """
        draft = self._part(task).with_suffix(".draft")
        with self._disk():
            pq.write_table(table_of(columns, self._schema), draft, **_WRITER)
            _settle(draft, self._part(task))

    def finish(self, tasks: Sequence[Work]) -> Path:
        """Put all parts together, in order, and remove them.

        Raises:
            UavctlError: A part is damaged, or the table cannot be written.
        """
        path = self.folder / RUNS
        with self._disk():
            if not self.complete():
                draft = path.with_suffix(".draft")
                told = msgspec.json.decode((self.folder / DOCUMENT).read_bytes())["cells"]
                cells = {one["index"]: one for one in told}
                kinds = {
                    name: _F64 if name == "rate_hz" else pa.string()
                    for name in NAMES
                    if all(name in cell for cell in told)
                }
                names = list(kinds.items())
                fields = [self._schema.field(place) for place in range(len(self._schema.names))]
                schema = pa.schema([fields[0], *names, *fields[1:]])
                with pq.ParquetWriter(draft, schema, **_WRITER) as writer:
                    for cell, of_cell in groupby(tasks, lambda task: task.cell):
                        table = pa.concat_tables([self._read(task) for task in of_cell]).combine_chunks()
                        for place, (name, kind) in enumerate(kinds.items(), 1):
                            values = pa.array([cells[cell][name]] * table.num_rows, type=kind)
                            table = table.add_column(place, name, values)
                        writer.write_table(table, row_group_size=_GROUP_ROWS)
                _settle(draft, path)
            for part in self._parts.iterdir():
                part.unlink()
            self._parts.rmdir()
        return path

    @contextmanager
    def _disk(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise UavctlError(
                f"{self.folder}: {error.strerror or error}; make room or mend it, and go on with --resume"
            ) from error

    def _part(self, task: Work) -> Path:
        return self._parts / f"{task.name}.parquet"

    def _read(self, task: Work) -> pa.Table:
        try:
            return pq.read_table(self._part(task), schema=self._schema)
        except (pa.ArrowException, OSError) as error:
            raise UavctlError(f"{self._part(task)} is damaged ({error}); remove it and go on with --resume") from error

    def _begin(self, document: Mapping[str, object], specification: str, resume: bool) -> None:
        self.check(resume)
        path = self.folder / DOCUMENT
        if resume:
            there = msgspec.json.decode(path.read_bytes())
            here = msgspec.json.decode(msgspec.json.encode(document))
            different = first_difference(there, here)
            if different is not None:
                raise UsageError(f"{self.folder} holds another campaign: {different}; choose another folder")
            return
        _write(self.folder / SPECIFICATION, specification.encode())
        _write(path, msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n")  # the last: now it is one


def table_of(columns: Columns, schema: pa.Schema = SCHEMA) -> pa.Table:
    """Return the rows of a task as they are stored."""
    arrays = []
    for name in schema.names:
        field, values = schema.field(name), columns[name]
        counted = name in ("ages", "outside")
        arrays.append(_histograms(values) if counted else pa.array(values, type=field.type, from_pandas=False))
    return pa.Table.from_arrays(arrays, schema=schema)


def first_difference(there: object, here: object) -> str | None:
    """Return the first place in which two JSON documents differ, in words."""
    found = next(unequal(there, here), None)
    return None if found is None else f"{found[0]} is {_short(found[1])} there and {_short(found[2])} here"


def _short(value: object) -> str:
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= 60 else f"{text[:59]}…"


def _histograms(counts: NDArray[np.generic]) -> pa.ListArray:
    """Return rows (N, T) as lists up to their last entry that is not 0."""
    used = counts.shape[1] - (counts[:, ::-1] != 0).argmax(axis=1)
    used = np.where(counts.any(axis=1), used, 0)
    inside = np.arange(counts.shape[1]) < used[:, None]
    offsets = np.concatenate([[0], np.cumsum(used)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(counts[inside], type=_I64))


def _alone(descriptor: int, folder: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UsageError(f"{folder}: another process flies this campaign; wait for it") from error


def _write(path: Path, data: bytes) -> None:
    draft = path.with_name(f"{path.name}.draft")
    draft.write_bytes(data)
    _settle(draft, path)


def _settle(draft: Path, path: Path) -> None:
    """Rename a temporary file once it is on the disk."""
    for one in (draft, path.parent):
        if one == path.parent:
            draft.replace(path)
        descriptor = os.open(one, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
