"""Folders of campaigns, written by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from uavctl.lab.campaign.results import SCHEMA, VERSION, CellSummary, read_results, summarise_cell

STEPS = 50
_EMPTY = {name: float("nan") if SCHEMA.field(name).type == pa.float64() else 0 for name in SCHEMA.names}


def cell(index: int, controller: str, kind: str = "lqg", link: str = "30 %", **fields: Any) -> dict[str, Any]:
    """A cell of `campaign.json`."""
    promised = {"promised_x": 0.05, "promised_u": 0.1} if kind == "smpc" else {}
    names = {"disturbance": "as modelled", "plant": "as modelled", "design_id": None, "refused": ""}
    return {"index": index, "controller": controller, "kind": kind, "link": link, **names, **promised, **fields}


def runs(index: int, cost: Sequence[float], **columns: Sequence[Any]) -> list[dict[str, Any]]:
    """Rows of one cell; a run whose cost is NaN has failed."""
    rows = []
    for run, value in enumerate(cost):
        failed = bool(np.isnan(value))
        row: dict[str, Any] = {**_EMPTY, "cell": index, "run": run, "error": "it broke" if failed else ""}
        row |= {"cost": float(value), "settled_cost": value / STEPS, "mean_square_input": 1.0}
        row |= {"ages": [] if failed else [STEPS - 1, 1]} | {name: values[run] for name, values in columns.items()}
        rows.append({**row, "outside": row["outside"] or [1] * row["state_violations"]})
    return rows


def write(folder: Path, cells: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> Path:
    """A finished campaign."""
    folder.mkdir(parents=True, exist_ok=True)
    count = max((row["run"] for row in rows), default=0) + 1
    document = {"version": VERSION, "name": "by hand", "uavctl_version": "9.9", "master": 7, "runs": count}
    document |= {"steps": STEPS, "spec": {}, "configuration": ""}
    (folder / "campaign.json").write_bytes(msgspec.json.encode({**document, "cells": list(cells)}))
    (folder / "runs.parquet").mkdir(exist_ok=True)
    for index in dict.fromkeys(row["cell"] for row in rows):
        put(folder, index, pa.Table.from_pylist([dict(row) for row in rows if row["cell"] == index], schema=SCHEMA))
    return folder


def put(folder: Path, index: int, table: pa.Table, first: int = 0) -> Path:
    """Write a file of the table of runs, of runs from `first` on of a cell."""
    path = folder / "runs.parquet" / f"{index:05d}-{first:08d}.parquet"
    pq.write_table(table, path)
    return path


def summarise(folder: Path) -> list[CellSummary]:
    """Figures of every cell of a campaign."""
    results = read_results(folder)
    return [summarise_cell(results, one) for one in results.record.cells]
