"""A campaign with all that its page shows worked out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from uavctl.campaign.plots import Looks
from uavctl.campaign.results import Results
from uavctl.campaign.statistics import CellSummary, cell_summary
from uavctl.campaign.verdict import SMPC, Group, Verdict, grouped, verdicts

_WHAT = ("link", "disturbance", "plant")


@dataclass(frozen=True, eq=False)
class View:
    """A campaign as its page shows it.

    Attributes:
        results: The campaign.
        cells: The figures of its cells.
        groups: They by link, disturbance and plant.
        verdicts: Each SMPC against the baselines of its group.
        looks: How controllers are drawn.
    """

    results: Results
    cells: list[CellSummary]
    groups: dict[Group, list[CellSummary]]
    verdicts: list[Verdict]
    looks: Looks

    @classmethod
    def of(cls, results: Results) -> Self:
        """Work out the figures of a campaign."""
        cells = [cell_summary(results, cell) for cell in results.cells]
        groups = grouped(cells)
        first = [cell.controller for cell in cells if cell.kind == SMPC]
        looks = Looks(tuple(dict.fromkeys([*first, *(cell.controller for cell in cells)])))
        return cls(results, cells, groups, list(verdicts(results, groups)), looks)

    def is_smpc(self, controller: str) -> bool:
        """Whether a controller is an SMPC."""
        return any(cell.controller == controller and cell.kind == SMPC for cell in self.cells)

    def place(self, group: Group) -> str:
        """Where a cell is, by what is not the same for all."""
        names = list(group[:1])
        for which in (1, 2):
            if len({other[which] for other in self.groups}) > 1:
                names.append(f"{_WHAT[which]} {group[which]}")
        return ", ".join(names)

    @property
    def scenes(self) -> dict[tuple[str, str], list[CellSummary]]:
        """Cells by disturbance and plant."""
        scenes: dict[tuple[str, str], list[CellSummary]] = {}
        for cell in self.cells:
            scenes.setdefault((cell.disturbance, cell.plant), []).append(cell)
        return scenes
