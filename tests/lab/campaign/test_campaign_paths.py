"""How runs went through the room, against closed forms."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from campaign_results import cell, runs, summarise, write

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.lab.campaign.page import CampaignView, render_report
from uavctl.lab.campaign.results import read_results
from uavctl.lab.campaign.tasks import compute_path_figures
from uavctl.lab.trial import compute_exact_usable_share
from uavctl.wiring.controller import build_conditioned, build_design
from uavctl.wiring.mission import build_reference_limits

CONFIG = load_config("room-hahn-stursberg")  # target (1.5, 1, -1.2), walls at +-3, +-2.5, -2.5 and 0
DT_S = CONFIG.plant.dt_s


def approaching(far_m: float, tau_s: float, steps: int) -> Array:
    """States of a run (1, T+1, 9) that comes from the north as an exponential."""
    states = np.zeros((1, steps + 1, 9))
    states[0, :, [0, 3, 6]] = np.array(CONFIG.target.position_m)[:, None]
    states[0, :, 0] += far_m * np.exp(-DT_S * np.arange(steps + 1) / tau_s)
    return states


def test_an_exponential_is_near_at_its_logarithm() -> None:
    path_figures = compute_path_figures(CONFIG, approaching(2.0, 1.0, 100))
    for name, radius_m in (("near_s", 0.3), ("nearer_s", 0.1)):
        exact = math.log(2.0 / radius_m)
        assert exact <= path_figures[name][0] < exact + DT_S
    assert path_figures["beyond_m"][0] == pytest.approx(0.5)  # it began at 3.5 m


def test_without_coming_near_the_time_is_infinite_and_a_steady_distance_is_the_hold() -> None:
    states = approaching(0.0, 1.0, 40)
    states[0, :, 3] += 0.4
    path_figures = compute_path_figures(CONFIG, states)
    assert path_figures["near_s"][0] == path_figures["nearer_s"][0] == math.inf
    assert path_figures["hold_rms_m"][0] == pytest.approx(0.4)
    assert path_figures["beyond_m"][0] == pytest.approx(-1.1)  # north and east leave more


def test_the_usable_room_lies_between_the_resting_positions() -> None:
    config = load_config("room-hahn-stursberg", ["smpc.scheme=age-conditioned"])
    exact = build_conditioned(config, for_flight=False, cov=np.zeros((9, 9)))
    assert compute_exact_usable_share(config, None) == pytest.approx(share(exact.reference_limits))
    design = build_design(CONFIG)
    assert compute_exact_usable_share(CONFIG, design) == pytest.approx(share(build_reference_limits(design)))
    assert compute_exact_usable_share(CONFIG, design) < compute_exact_usable_share(config, None) < 1.0


def share(rests: Array) -> float:
    """By the box between rows of the state set that are a position alone."""
    rows = build_design(CONFIG).state_set.c
    sides: dict[tuple[int, bool], float] = {}
    for row, side in zip(rows, rests, strict=True):
        (used,) = np.nonzero(row)
        if used.size == 1 and used[0] in (0, 3, 6):
            sides[int(used[0]), bool(row[used[0]] > 0)] = float(side / row[used[0]])
    room = {0: 6.0, 3: 5.0, 6: 2.5}
    return math.prod((sides[axis, True] - sides[axis, False]) / size for axis, size in room.items())


@pytest.mark.slow
def test_the_page_shows_path_figures_where_there_are_any(tmp_path: Path) -> None:
    figures = {"near_s": [3.0, 4.0, 9.0], "nearer_s": [5.0, math.inf, math.inf], "hold_rms_m": [0.1, 0.2, 0.4]}
    figures["beyond_m"] = [-0.5, 0.25, -0.5]
    new = write(tmp_path / "new", [cell(0, "ours", "smpc", usable_room=0.79)], runs(0, [1.0, 2.0, 3.0], **figures))
    (path_figures,) = summarise(new)
    assert (path_figures.near_s, path_figures.nearer_s, path_figures.hold_rms_m, path_figures.beyond_m) == (
        4.0,
        None,
        0.2,
        0.25,
    )
    page = render_report(CampaignView.make(read_results(new)))
    assert "Through the room" in page and "79" in page and "0.25" in page
    without = write(tmp_path / "without", [cell(0, "ours", "smpc")], runs(0, [1.0, 2.0]))
    assert summarise(without)[0].beyond_m is None
    assert "Through the room" not in render_report(CampaignView.make(read_results(without)))
