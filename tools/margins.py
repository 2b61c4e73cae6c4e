"""Margins of simple controllers at which their worst step is outside as seldom as that of scheme age-conditioned.

`python tools/margins.py docs/campaigns/loss.toml --runs 400`: for each link of the campaign and each `mean-qp` and
`governor` in it, the least margin whose worst step has no more runs with a state outside than the age-conditioned
controller's, on runs of another seed than the campaign's; as [[tuning]] tables, with every margin that was tried.
With `--settled` it is the share of the steps of each run's second half: where plans rest at a limit, that is what
costs, and the worst step may be one of the start, which no margin changes.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from uavctl.lab.campaign.spec import CampaignSpec, ControllerSpec, compose, read_campaign
from uavctl.lab.campaign.tasks import Cell, Task, fly_task, make_cells

SIMPLE = ("mean-qp", "governor")
LEAST, MOST, HALVINGS = 0.5, 4.5, 6
SEED = 1  # added to the campaign's


def main(arguments: list[str]) -> int:
    """Find the margins and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("--links", nargs="*", help="names of links; all of the campaign's by default")
    parser.add_argument("--settled", action="store_true", help="compare settled steps, not the worst one")
    given = parser.parse_args(arguments)
    campaign, _ = read_campaign(given.file, given.runs)
    spec, configuration = campaign.spec, campaign.configuration
    spec = msgspec.structs.replace(spec, master=spec.master + SEED)
    (ours,) = (one for one in spec.controller if "smpc.scheme=age-conditioned" in one.set)
    for link in spec.link:
        if given.links and link.name not in given.links:
            continue
        _tell(f'# "{link.name}"')
        judge = _Judge(spec, configuration, link.name, given.settled)
        allowed, cost = judge.flown(ours, None)
        _tell(f"# {ours.name}: {judge.what} {100 * allowed:.2f} %, cost {cost:.1f}")
        for one in spec.controller:
            if one.kind in SIMPLE:
                margin = judge.tuned(one, allowed)
                _tell(f'[[tuning]]\ncontrollers = ["{one.name}"]\nlinks = ["{link.name}"]\nmargin = {margin:.4g}\n')
    return 0


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


@dataclass(frozen=True, eq=False)
class _Judge:
    """How often controllers are outside on one link of a campaign, in settled steps or in the worst one."""

    spec: CampaignSpec
    configuration: str
    link: str
    settled: bool

    @property
    def what(self) -> str:
        """Whose share of runs it is."""
        return "settled steps" if self.settled else "worst step"

    def tuned(self, one: ControllerSpec, allowed: float) -> float:
        """The least margin that is outside no more often, by halving."""
        low, high = LEAST, MOST
        for _ in range(HALVINGS):
            margin = 0.5 * (low + high)
            rate, cost = self.flown(one, margin)
            _tell(f"# {one.name}, margin {margin:.4g}: {self.what} {100 * rate:.2f} %, cost {cost:.1f}")
            low, high = (low, margin) if rate <= allowed else (margin, high)
        return high

    def flown(self, one: ControllerSpec, margin: float | None) -> tuple[float, float]:
        """Share of runs outside, and mean cost, of one controller with that margin."""
        spec = self.spec
        (flown_link,) = (other for other in spec.link if other.name == self.link)
        tuning = [
            msgspec.structs.replace(tuned, controllers=(one.name,), links=(self.link,), margin=margin)
            for tuned in spec.tuning
            if one.name in tuned.controllers and self.link in tuned.links
        ]
        own = one if margin is None else msgspec.structs.replace(one, margin=margin)
        alone = msgspec.structs.replace(spec, controller=(own,), link=(flown_link,), tuning=tuple(tuning))
        (cell,) = make_cells(compose(alone, self.configuration))
        return self._figures(cell)

    def _figures(self, cell: Cell) -> tuple[float, float]:
        if cell.recipe is None:
            raise SystemExit(cell.refused)
        runs = cell.setting.spec.runs
        found, _ = fly_task(Task(cell.index, 0, runs, cell.setting, cell.recipe), 0, runs)
        share = found.state_violated.mean(axis=0)
        rate = share[share.size // 2 :].mean() if self.settled else share.max()
        return float(rate), float(np.sum(found.cost, axis=1).mean())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
