"""One run of a campaign once more, from the campaign's folder: all that it met, and how it went."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl import __version__
from uavctl.campaign.cells import cell_of, told
from uavctl.campaign.compose import campaign_of
from uavctl.campaign.controllers import LibraryFor
from uavctl.campaign.setting import met
from uavctl.campaign.spec import CHUNK
from uavctl.campaign.store import DOCUMENT, first_difference
from uavctl.campaign.tasks import Task, flown
from uavctl.campaign.world import Flown
from uavctl.config import Config
from uavctl.config.types import PlantConfig
from uavctl.errors import UavctlError, UsageError
from uavctl.smpc.batch import Counts

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Again:
    """One run of T steps.

    Attributes:
        config: What its controller believes.
        plant: The plant that flew.
        start: x(0) (n_x,).
        newest: Capture step of the newest position known in each step (T,).
        disturbances: w (T, n_w).
        flown: The run, N = 1.
        campaign: Name of the campaign.
        master: Its seed.
    """

    config: Config
    plant: PlantConfig
    start: Array
    newest: Counts
    disturbances: Array
    flown: Flown
    campaign: str
    master: int


def again(folder: Path, cell: int, run: int, library_for: LibraryFor) -> Again:
    """Fly one run once more, together with those that it was flown with.

    Args:
        folder: Folder of the campaign.
        cell: Index of the cell.
        run: Index of the run.
        library_for: Gives the policy library of a design.

    Raises:
        UavctlError: The folder holds no campaign, or this version would design another controller.
        UsageError: There is no such run.
    """
    document = _document(folder)
    campaign = campaign_of(document)
    cells, runs = msgspec.convert(document["cells"], list[dict[str, Any]]), campaign.spec.runs
    if not 0 <= cell < len(cells) or not 0 <= run < runs:
        raise UsageError(f"cell {cell}, run {run}: there are the cells 0 to {len(cells) - 1}, the runs 0 to {runs - 1}")
    if campaign.spec.measured != "state":
        raise UsageError(
            f"{folder}: its controllers were told positions, and a flight of the simulator has a noise of its own; "
            "fly one with uavctl loopback"
        )
    made = cell_of(campaign, cell, library_for)
    different = first_difference(cells[cell], told(made), f"cells[{cell}]")
    if different is not None:
        raise UavctlError(
            f"{folder}: uavctl {document['uavctl_version']} flew another controller than {__version__} makes "
            f"({different}); use the version that flew it"
        )
    if made.recipe is None:
        raise UsageError(f"cell {cell} was not flown: {made.refused}")
    first = run - run % CHUNK
    task = Task(cell, first, min(CHUNK, runs - first), made.setting, made.recipe)
    row = slice(run - first, run - first + 1)
    found, _ = flown(task, task.first, task.runs)
    meets = met(made.setting, task.first, task.runs)
    return Again(
        config=made.recipe.config,
        plant=made.setting.plant,
        start=meets.scene.start[row][0],
        newest=meets.newest[row][0],
        disturbances=meets.disturbances[row][0],
        flown=Flown(**{field.name: getattr(found, field.name)[row] for field in fields(Flown)}),
        campaign=campaign.spec.name,
        master=campaign.spec.master,
    )


def _document(folder: Path) -> dict[str, object]:
    try:
        document = msgspec.json.decode((folder / DOCUMENT).read_bytes(), type=dict[str, object])
    except (OSError, msgspec.MsgspecError) as error:
        raise UavctlError(f"{folder} holds no campaign ({error}); give the folder of one") from error
    return document
