"""How runs went through the room, against closed forms."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from campaign_results import cell, runs, write
from numpy.typing import NDArray

from uavctl.build.controller import build_conditioned, build_design
from uavctl.build.mission import build_rests
from uavctl.config import load_config
from uavctl.lab.campaign.page import report_html
from uavctl.lab.campaign.results import read_results, summarise
from uavctl.lab.campaign.tasks import ways
from uavctl.lab.trial import usable_seen

CONFIG = load_config("room-hahn-stursberg")  # target (1.5, 1, -1.2), walls at +-3, +-2.5, -2.5 and 0
DT_S = CONFIG.plant.dt_s


def approaching(far_m: float, tau_s: float, steps: int) -> NDArray[np.float64]:
    """States of a run (1, T+1, 9) that comes from the north as an exponential."""
    states = np.zeros((1, steps + 1, 9))
    states[0, :, [0, 3, 6]] = np.array(CONFIG.target.position_m)[:, None]
    states[0, :, 0] += far_m * np.exp(-DT_S * np.arange(steps + 1) / tau_s)
    return states


def test_an_exponential_is_near_at_its_logarithm() -> None:
    found = ways(CONFIG, approaching(2.0, 1.0, 100))
    for name, radius_m in (("near_s", 0.3), ("nearer_s", 0.1)):
        exact = math.log(2.0 / radius_m)
        assert exact <= found[name][0] < exact + DT_S
    assert found["beyond_m"][0] == pytest.approx(0.5)  # it began at 3.5 m


def test_who_is_never_near_has_no_time_and_a_steady_distance_is_held() -> None:
    states = approaching(0.0, 1.0, 40)
    states[0, :, 3] += 0.4
    found = ways(CONFIG, states)
    assert found["near_s"][0] == found["nearer_s"][0] == math.inf
    assert found["hold_rms_m"][0] == pytest.approx(0.4)
    assert found["beyond_m"][0] == pytest.approx(-1.1)  # north and east leave more


def test_the_room_that_can_be_used_is_that_between_the_places_to_rest() -> None:
    config = load_config("room-hahn-stursberg", ["smpc.scheme=age-conditioned"])
    exact = build_conditioned(config, flown=False, cov=np.zeros((9, 9)))
    assert usable_seen(config, None) == pytest.approx(share(exact.rest_limits))
    design = build_design(CONFIG)
    assert usable_seen(CONFIG, design) == pytest.approx(share(build_rests(design)))
    assert usable_seen(CONFIG, design) < usable_seen(config, None) < 1.0


def share(rests: NDArray[np.float64]) -> float:
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
def test_the_page_shows_them_and_older_tables_have_none(tmp_path: Path) -> None:
    figures = {"near_s": [3.0, 4.0, 9.0], "nearer_s": [5.0, math.inf, math.inf], "hold_rms_m": [0.1, 0.2, 0.4]}
    figures["beyond_m"] = [-0.5, 0.25, -0.5]
    new = write(tmp_path / "new", [cell(0, "ours", "smpc", usable_room=0.79)], runs(0, [1.0, 2.0, 3.0], **figures))
    (found,) = summarise(new)
    assert (found.near_s, found.nearer_s, found.hold_rms_m, found.beyond_m) == (4.0, None, 0.2, 0.25)
    page = report_html(read_results(new))
    assert "Through the room" in page and "79" in page and "0.25" in page
    old = write(tmp_path / "old", [cell(0, "ours", "smpc")], runs(0, [1.0, 2.0]))
    assert summarise(old)[0].beyond_m is None and "Through the room" not in report_html(read_results(old))
