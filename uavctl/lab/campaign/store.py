"""Folder of a campaign: its document, and the table of its runs, a folder of Parquet files with one for each task.

A task is stored completely or not at all, so a killed campaign can continue. The bytes of a file depend on its runs
alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from logs.recording.replay import iterate_different_leaves
from uavctl.errors import PlatformError, UavctlError, UsageError
from uavctl.lab.campaign.pool import Columns, Work
from uavctl.lab.campaign.results import DOCUMENT, RUNS, SCHEMA, CampaignRecord, CellRecord, read_document
from uavctl.operating_system import lock_file, sync_folder

SPECIFICATION = "campaign.toml"
# Columns that name the cell of each row, in either world, so that the table can be read alone.
CELL_COLUMNS = ("scenario", "autopilot", "rate_hz", "controller", "link", "air", "disturbance", "plant")
_WRITER: dict[str, Any] = {
    "version": "2.6",
    "compression": "zstd",
    "compression_level": 3,
    "use_dictionary": ["error", *CELL_COLUMNS],
}


class Store:
    """Folder of one campaign."""

    def __init__(self, folder: Path, schema: pa.Schema = SCHEMA) -> None:
        self.folder = folder
        self.table = folder / RUNS
        self._schema = schema
        self._cells: dict[int, CellRecord] = {}  # by their indices

    @contextmanager
    def open(self, document: CampaignRecord[Any], specification: str, resume: bool) -> Iterator[None]:
        """Begin or continue a campaign; other processes are locked out.

        Args:
            resume: Whether to continue the folder's campaign.

        Raises:
            UsageError: There is a campaign but `resume` is false, there is none, it is another one, or another process
                flies it.
            UavctlError: The folder cannot be made or written.
        """
        with ExitStack() as stack:
            with self._convert_disk_errors():
                self.folder.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context((self.folder / ".lock").open("ab"))
                _lock_folder(lock.fileno(), self.folder)
                self._begin(document, specification, resume)
                self.table.mkdir(exist_ok=True)
                self._cells = {cell.index: cell for cell in document.cells}
            yield

    def has_campaign(self) -> bool:
        """Return whether the folder has a campaign."""
        return (self.folder / DOCUMENT).exists()

    def check(self, resume: bool) -> None:
        """Check that there is a campaign to continue, or none to overwrite.

        Raises:
            UsageError: There is none to continue, or one although `resume` is false.
        """
        if self.has_campaign() and not resume:
            raise UsageError(f"{self.folder} holds a campaign; continue it with --resume, or choose another folder")
        if resume and not self.has_campaign():
            raise UsageError(f"{self.folder} holds no campaign to continue; leave out --resume")

    def find_finished(self, tasks: Sequence[Work]) -> set[str]:
        """Return the names of the finished tasks."""
        return {task.name for task in tasks if self._get_path(task).exists()}

    def keep(self, task: Work, columns: Columns) -> None:
        """Write a task's rows; once this returns, they survive a kill.

        Raises:
            UavctlError: They cannot be written.
        """
        path = self._get_path(task)
        draft = path.with_name(f".{path.name}.draft")  # readers of the table pass over files with a point
        with self._convert_disk_errors():
            pq.write_table(self._name_cell(make_table(columns, self._schema), task.cell), draft, **_WRITER)
            _rename_synced(draft, path)

    @contextmanager
    def _convert_disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise UavctlError(
                f"{self.folder}: {error.strerror or error}; make room or repair it, and continue with --resume"
            ) from error

    def _get_path(self, task: Work) -> Path:
        return self.table / f"{task.name}.parquet"

    def _name_cell(self, table: pa.Table, cell: int) -> pa.Table:
        """Return the table with columns that name the cell, after its index."""
        record = self._cells[cell]
        for position, name in enumerate((name for name in CELL_COLUMNS if hasattr(record, name)), 1):
            values = pa.array(
                [getattr(record, name)] * table.num_rows, type=pa.float64() if name == "rate_hz" else pa.string()
            )
            table = table.add_column(position, name, values)
        return table

    def _begin(self, document: CampaignRecord[Any], specification: str, resume: bool) -> None:
        self.check(resume)
        path = self.folder / DOCUMENT
        if resume:
            stored = read_document(self.folder, dict[str, Any])
            current = msgspec.json.decode(msgspec.json.encode(document))
            difference = find_first_difference(stored, current)
            if difference is not None:
                raise UsageError(f"{self.folder} holds another campaign: {difference}; choose another folder")
            return
        _write_file(self.folder / SPECIFICATION, specification.encode())
        # The document comes last, as it makes the folder a campaign.
        _write_file(path, msgspec.json.format(msgspec.json.encode(document), indent=1) + b"\n")


def make_table(columns: Columns, schema: pa.Schema = SCHEMA) -> pa.Table:
    """Return the stored table of a task's rows."""
    arrays = []
    for name in schema.names:
        field, values = schema.field(name), columns[name]
        is_histogram = field.type == pa.list_(pa.int64())
        arrays.append(
            _trim_histograms(values) if is_histogram else pa.array(values, type=field.type, from_pandas=False)
        )
    return pa.Table.from_arrays(arrays, schema=schema)


def find_first_difference(stored: object, current: object) -> str | None:
    """Return the first place in which two JSON documents differ, in words."""
    difference = next(iterate_different_leaves(stored, current), None)
    return (
        None
        if difference is None
        else f"{difference[0]} is {_shorten(difference[1])} there and {_shorten(difference[2])} here"
    )


def find_first_error(table: Path) -> str:
    """Return controller and reason of the first failed run in a table of runs; empty without one."""
    for file in sorted(table.glob("*.parquet")):
        rows = pq.read_table(file, columns=["controller", "error"])
        for controller, error in zip(rows["controller"].to_pylist(), rows["error"].to_pylist(), strict=True):
            if error:
                return f"{controller}: {error}"
    return ""


def _shorten(value: object) -> str:
    text = msgspec.json.encode(value).decode()
    return text if len(text) <= 60 else f"{text[:59]}…"


def _trim_histograms(counts: NDArray[np.generic]) -> pa.ListArray:
    """Return rows (N, T) as lists up to their last entry that is not 0."""
    lengths = counts.shape[1] - (counts[:, ::-1] != 0).argmax(axis=1)
    lengths = np.where(counts.any(axis=1), lengths, 0)
    is_used = np.arange(counts.shape[1]) < lengths[:, None]
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(counts[is_used], type=pa.int64()))


def _lock_folder(descriptor: int, folder: Path) -> None:
    try:
        lock_file(descriptor)
    except BlockingIOError as error:
        raise UsageError(f"{folder}: another process flies this campaign; wait for it") from error
    except PlatformError:  # only the start of a second process on this folder goes unnoticed
        return


def _write_file(path: Path, data: bytes) -> None:
    draft = path.with_name(f"{path.name}.draft")
    draft.write_bytes(data)
    _rename_synced(draft, path)


def _rename_synced(draft: Path, path: Path) -> None:
    """Rename a temporary file once it is on the disk."""
    with draft.open("ab") as file:
        os.fsync(file.fileno())
    draft.replace(path)
    sync_folder(path.parent)
