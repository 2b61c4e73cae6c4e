"""The campaigns in docs/campaigns: they can be read, and every SMPC in them has the design that the file says."""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path

import pytest
from places import ROOT

from uavctl.errors import DesignError
from uavctl.lab.campaign.controllers import CellSetting, draw_conditions
from uavctl.lab.campaign.fleets import is_fleet_file, make_fleet_cells, read_fleet_campaign
from uavctl.lab.campaign.spec import read_campaign
from uavctl.lab.campaign.trials import is_trial_file, read_trial
from uavctl.wiring.controller import build_design

FOLDER = ROOT / "docs" / "campaigns"
EVERY = sorted(FOLDER.glob("*.toml"))
FLEETS = [file for file in EVERY if is_fleet_file(file)]
FILES = [file for file in EVERY if not is_trial_file(file) and file not in FLEETS]
# (file, controller, link that it believes in): there is no such design, as the file's head says.
REFUSED = {
    *(("loss", "smpc as printed", f"{loss} %") for loss in range(40, 100, 10)),
    ("room-hahn-stursberg", "hahn-stursberg", "60 %"),
    *(("bursts", "smpc as printed", name) for name in ("bursts of 2", "bursts of 3", "bursts of 5", "seldom, of 5")),
}


@pytest.mark.parametrize("file", sorted(set(EVERY) - set(FILES) - set(FLEETS)), ids=lambda file: file.stem)
def test_the_flights_of_the_quadrotor_can_be_read_and_are_as_many_as_the_file_says(file: Path) -> None:
    spec, text = read_trial(file)
    cells = math.prod(map(len, (spec.scenario, spec.autopilot, spec.rate_hz, spec.air, spec.controller, spec.link)))
    assert spec.name == file.stem and f"{spec.runs} flights of each of {cells} cells" in text


@pytest.mark.parametrize("file", FLEETS, ids=lambda file: file.stem)
def test_the_campaigns_of_fleets_can_be_read_and_none_of_their_cells_is_refused(file: Path) -> None:
    spec, _ = read_fleet_campaign(file)
    assert spec.name == file.stem
    assert [cell.record.refused for cell in make_fleet_cells(spec) if cell.record.refused] == []


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_what_is_refused_is_what_the_file_says(file: Path) -> None:
    campaign, _ = read_campaign(file)
    spec, refused = campaign.spec, set()
    assert spec.name == file.stem
    for (i, link), config in campaign.believed_configs.items():
        if spec.controller[i].kind == "smpc" and not config.is_age_conditioned:  # which takes no promise of a design's
            try:
                build_design(config)
            except DesignError:
                refused.add((file.stem, spec.controller[i].name, link))
    assert refused == {entry for entry in REFUSED if entry[0] == file.stem}
    for flown, disturbance in product(campaign.flown_plants, spec.disturbance):
        draw_conditions(CellSetting(spec, campaign.base, flown.plant, campaign.flown_links[0].link, disturbance), 0, 1)
