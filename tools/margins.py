"""Margins of simple controllers at which their worst step is outside as seldom as that of scheme age-conditioned.

`python tools/margins.py docs/campaigns/loss.toml --runs 400`: for each link of the campaign and each `mean-qp` and
`governor` in it, the least margin whose worst step has no more runs with a state outside than the age-conditioned
controller's, on runs of another seed than the campaign's; as [[tuning]] tables, with every margin that was tried.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import msgspec
import numpy as np

from uavctl.campaign.cells import Cell, cells_of
from uavctl.campaign.compose import compose
from uavctl.campaign.read import read_campaign
from uavctl.campaign.spec import CampaignSpec, ControllerSpec
from uavctl.campaign.tasks import Task, flown

SIMPLE = ("mean-qp", "governor")
LEAST, MOST, HALVINGS = 0.5, 4.5, 6
SEED = 1  # added to the campaign's


def main(arguments: list[str]) -> int:
    """Find the margins and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--runs", type=int, default=400)
    parser.add_argument("--links", nargs="*", help="names of links; all of the campaign's by default")
    given = parser.parse_args(arguments)
    campaign, _ = read_campaign(given.file, given.runs)
    spec, configuration = campaign.spec, campaign.configuration
    spec = msgspec.structs.replace(spec, master=spec.master + SEED)
    (ours,) = (one for one in spec.controller if "smpc.scheme=age-conditioned" in one.set)
    for link in spec.link:
        if given.links and link.name not in given.links:
            continue
        _tell(f'# "{link.name}"')
        allowed, cost = _flown(spec, configuration, ours, link.name, None)
        _tell(f"# {ours.name}: worst step {100 * allowed:.2f} %, cost {cost:.1f}")
        for one in spec.controller:
            if one.kind in SIMPLE:
                margin = _tuned(spec, configuration, one, link.name, allowed)
                _tell(f'[[tuning]]\ncontrollers = ["{one.name}"]\nlinks = ["{link.name}"]\nmargin = {margin:.4g}\n')
    return 0


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _tuned(spec: CampaignSpec, configuration: str, one: ControllerSpec, link: str, allowed: float) -> float:
    """The least margin that is outside no more often in its worst step, by halving."""
    low, high = LEAST, MOST
    for _ in range(HALVINGS):
        margin = 0.5 * (low + high)
        rate, cost = _flown(spec, configuration, one, link, margin)
        _tell(f"# {one.name}, margin {margin:.4g}: worst step {100 * rate:.2f} %, cost {cost:.1f}")
        low, high = (low, margin) if rate <= allowed else (margin, high)
    return high


def _flown(
    spec: CampaignSpec, configuration: str, one: ControllerSpec, link: str, margin: float | None
) -> tuple[float, float]:
    """Share of runs outside in the worst step, and mean cost, of one controller on one link."""
    (flown_link,) = (other for other in spec.link if other.name == link)
    tuning = [
        msgspec.structs.replace(tuned, controllers=(one.name,), links=(link,), margin=margin)
        for tuned in spec.tuning
        if one.name in tuned.controllers and link in tuned.links
    ]
    own = one if margin is None else msgspec.structs.replace(one, margin=margin)
    alone = msgspec.structs.replace(spec, controller=(own,), link=(flown_link,), tuning=tuple(tuning))
    (cell,) = cells_of(compose(alone, configuration), lambda *_: None)
    return _figures(cell)


def _figures(cell: Cell) -> tuple[float, float]:
    if cell.recipe is None:
        raise SystemExit(cell.refused)
    runs = cell.setting.spec.runs
    found, _ = flown(Task(cell.index, 0, runs, cell.setting, cell.recipe), 0, runs)
    return float(found.state_violated.mean(axis=0).max()), float(np.sum(found.cost, axis=1).mean())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
