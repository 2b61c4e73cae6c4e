"""A largest tilt in flight, judged by the true attitude: both axes together never lean further, and it arrives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest
from soak_rig import LoopWatch, fly

from sim.simulation import World
from uavctl.config import load_config
from uavctl.wiring.controller import build_flight_design, prepare

TILT_DEG = 15.0
LOOPS_DEG = 1.5  # further, for the vehicle's own loops on the way to an attitude
# From corner to corner both axes are accelerated together.
CORNERS = ("sim.plant=quadrotor", "sim.seed=4", "sim.wind.gust_wind_mps=3.0", "target.position_m=[2.2,1.8,-1.2]")


@dataclass
class Seen:
    """What the true vehicle did, tick by tick."""

    tilts_deg: list[float] = field(default_factory=list)
    off_m: float = math.nan  # from the target, at the end


def fly_corners(preset: str, autopilot: str, *keys: str) -> Seen:
    config = load_config(preset, [*CORNERS, f"sim.autopilot={autopilot}", "duration_s=9", *keys])
    seen = Seen()

    def look(world: World, watch: LoopWatch, at_ns: int) -> None:
        del watch, at_ns
        _, x, y, _ = world.peers.vehicle.attitude
        # cos φ = R_33
        seen.tilts_deg.append(math.degrees(math.acos(1.0 - 2.0 * (x * x + y * y))))
        seen.off_m = math.dist(world.peers.vehicle.position_m, config.target.position_m)

    assert not fly(prepare(config, build_flight_design(config)), config, look).wrong
    return seen


@pytest.mark.parametrize(
    ("preset", "autopilot", "keys"),
    [
        ("room-px4", "px4", ()),
        pytest.param(
            *("room-ardupilot", "ardupilot", ("sets.input_lower=[-3.5,-3.5,-1.5]", "sets.input_upper=[3.5,3.5,1.5]")),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_vehicle_leans_no_further_than_told_and_arrives(preset: str, autopilot: str, keys: tuple[str, ...]) -> None:
    limits = ("limits.accel_mps2=[3.5,3.5,1.5]", *keys)
    free = fly_corners(preset, autopilot, *limits)
    assert max(free.tilts_deg) > TILT_DEG + LOOPS_DEG
    held = fly_corners(preset, autopilot, *limits, f"limits.tilt_deg={TILT_DEG}")
    assert max(held.tilts_deg) < TILT_DEG + LOOPS_DEG
    assert held.off_m < 0.1
