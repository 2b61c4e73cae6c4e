"""Folders of campaigns, written by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

STEPS = 50
_COUNTS = ("state_violations", "input_violations", "saturated", "decisions", "infeasible", "slack_used", "fallbacks")
_LISTS = dict.fromkeys(("ages", "outside"), pa.list_(pa.int64()))
_TYPES = {"error": pa.string(), **_LISTS, "cell": pa.int32(), "run": pa.int64()}


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
        row: dict[str, Any] = {"cell": index, "run": run, "error": "it broke" if failed else "", "cost": float(value)}
        row |= {"settled_cost": value / STEPS, "mean_square_input": 1.0, "largest_gap": float("nan")}
        row |= dict.fromkeys(_COUNTS, 0) | {"ages": [] if failed else [STEPS - 1, 1]}
        rows.append(row | {name: values[run] for name, values in columns.items()})
    return rows


def write(folder: Path, cells: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> Path:
    """A finished campaign."""
    folder.mkdir(parents=True, exist_ok=True)
    count = max((row["run"] for row in rows), default=0) + 1
    document = {"version": 1, "name": "by hand", "uavctl_version": "9.9", "master": 7, "runs": count, "steps": STEPS}
    (folder / "campaign.json").write_bytes(msgspec.json.encode({**document, "cells": list(cells)}))
    fields = [(name, _TYPES.get(name, pa.float64())) for name in (rows or runs(0, [1.0]))[0]]
    pq.write_table(pa.Table.from_pylist([dict(row) for row in rows], schema=pa.schema(fields)), folder / "runs.parquet")
    return folder
