"""What the flights of a campaign in the world of the quadrotor came to."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from statistics import median

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from uavctl.campaign.results import DOCUMENT, RUNS
from uavctl.campaign.trial_cells import REAL
from uavctl.campaign.trial_spec import QUADROTOR
from uavctl.errors import UavctlError
from uavctl.trial.case import Scenario


class ToldPlace(msgspec.Struct, frozen=True, kw_only=True):
    """A cell as `campaign.json` has it."""

    index: int
    controller: str
    kind: str
    scenario: Scenario
    autopilot: str
    rate_hz: float
    air: str
    link: str
    refused: str
    usable_room: float | None = None
    design_id: str | None = None


class ToldTrial(msgspec.Struct, frozen=True, kw_only=True):
    """A campaign as `campaign.json` has it."""

    name: str
    world: str
    uavctl_version: str
    master: int
    runs: int
    cells: list[ToldPlace]


class TrialSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a cell; null where one says nothing of its scenario, or is infinite."""

    place: ToldPlace
    runs: int
    failed: int
    median: dict[str, float | None]
    worst: dict[str, float | None]
    modes: dict[str, int]  # flights that ended in each
    errors: list[str]
    values: dict[str, list[float]]


def told_trial(folder: Path) -> ToldTrial | None:
    """What a folder's campaign compared; None if it is of another world, or none at all."""
    try:
        told = msgspec.json.decode((folder / DOCUMENT).read_bytes(), type=ToldTrial)
    except (OSError, msgspec.MsgspecError):
        return None
    return told if told.world == QUADROTOR else None


def summarise_trial(folder: Path) -> tuple[ToldTrial, list[TrialSummary]]:
    """The figures of every cell of a campaign.

    Raises:
        UavctlError: The folder has no results that can be read.
    """
    told = told_trial(folder)
    if told is None:
        raise UavctlError(f"{folder} holds no campaign of flights; give the folder of one")
    try:
        table = pq.read_table(folder / RUNS)
        return told, [_summary(table, place) for place in told.cells]
    except (OSError, pa.ArrowException, KeyError) as error:
        raise UavctlError(f"{folder / RUNS}: cannot be read ({error}); go on with --resume") from error


def _summary(table: pa.Table, place: ToldPlace) -> TrialSummary:
    cells = table["cell"].to_numpy()
    first, last = np.searchsorted(cells, [place.index, place.index + 1])
    rows = table.slice(first, last - first)
    errors = rows["error"].to_pylist()
    good = [i for i, error in enumerate(errors) if not error]
    columns = {name: rows[name].to_pylist() for name in (*REAL, "mode")}
    values = {name: [float(columns[name][i]) for i in good] for name in REAL}
    modes = Counter(columns["mode"][i] for i in good)
    return TrialSummary(
        place=place,
        runs=len(errors),
        failed=len(errors) - len(good),
        median={name: _finite(median(found)) if found else None for name, found in values.items()},
        worst={name: _finite(max(found)) if found else None for name, found in values.items()},
        modes=dict(modes),
        errors=[error for error in dict.fromkeys(errors) if error],
        values=values,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
