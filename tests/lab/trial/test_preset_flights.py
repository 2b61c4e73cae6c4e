"""The presets of the autopilots, judged on where the simulated quadrotor truly was."""

from __future__ import annotations

from dataclasses import replace
from statistics import median

import pytest

from uavctl.lab.position_loop import TUNED_LOOPS
from uavctl.lab.trial import AUTOPILOTS, AutopilotName, TrialCell, TrialPilot, fly_trial

SEEDS = (7410, 7411, 7412)
# Mean distance from the reference [m]: what the best published room flights have, and what few positions may add
MAX_TRACKING_M, MAX_SCARCE_TRACKING_M = 0.02, 0.03


def make_cell(autopilot: AutopilotName, rate_hz: float, loss: float) -> TrialCell:
    """Make the cell of a hold in gusts by the autopilot's preset."""
    pilot = TrialPilot("preset", f"room-{autopilot}")
    return TrialCell(pilot, "hold", autopilot, rate_hz, f"{loss}", (f"link.loss={loss}",), "gusts")


@pytest.mark.long
@pytest.mark.parametrize(("rate_hz", "max_m"), [(20.0, MAX_TRACKING_M), (5.0, MAX_SCARCE_TRACKING_M)])
@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_a_figure_of_eight_is_tracked_with_the_preset_as_it_is(
    autopilot: AutopilotName, rate_hz: float, max_m: float
) -> None:
    cell = replace(make_cell(autopilot, rate_hz, 0.3), scenario="eight", air="calm")
    assert fly_trial(cell, SEEDS[0], seconds=0.0, from_s=0.0).tracking_m <= max_m


@pytest.mark.long
@pytest.mark.parametrize("autopilot", AUTOPILOTS)
def test_a_preset_holds_no_worse_than_the_tuned_loop_where_positions_are_scarce(autopilot: AutopilotName) -> None:
    ours = make_cell(autopilot, 5.0, 0.3)
    tuned = replace(ours, pilot=TrialPilot("own-tuned", f"room-{autopilot}", (), TUNED_LOOPS[autopilot]))
    ours_m, tuned_m = (
        median(fly_trial(cell, seed, seconds=40.0, from_s=10.0).hold_rms_m for seed in SEEDS) for cell in (ours, tuned)
    )
    assert ours_m <= tuned_m
