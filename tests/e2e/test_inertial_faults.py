"""Flights of the true quadrotor whose inertial data lie while no position comes: it goes no further than without."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from sim.autopilot.inertial import InertialMeasurement
from sim.simulation import World
from uavctl.config import load_config
from uavctl.lab.trial import TrackedFlyer, compute_excess_m, get_cached_controller, get_room_limits
from uavctl.loop import ControlLoop
from uavctl.records import Event, Record, Vec3

BLACKOUT_S = (5.0, 9.0)
GUSTS = ("sim.wind.velocity_mps=[0.6, -0.36, 0.0]", "sim.wind.gust_wind_mps=3.0")


class EventCodeSink:
    """A sink that keeps the codes of events."""

    def __init__(self) -> None:
        self.codes: set[str] = set()

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        del topic, at_ns
        if isinstance(record, Event):
            self.codes.add(record.code)


@lru_cache
def measure_excess_m(
    autopilot: str,
    lie: str,
    seed: int,
    preset: str = "",
    blackout_s: tuple[float, float] = BLACKOUT_S,
    lies_s: float = BLACKOUT_S[0],
    silent_s: float = math.inf,
) -> tuple[float, frozenset[str]]:
    """How far the true vehicle came beyond a wall from the blackout on [m], and what was told.

    Args:
        autopilot: whose preset flies.
        lie: what its inertial data do; "none": they are not used.
        seed: of gusts, noise and losses.
        preset: that flies; empty for the autopilot's own.
        blackout_s: from when to when no position comes.
        lies_s: from when on they lie.
        silent_s: from when on the vehicle says nothing of its own velocity.
    """
    preset = preset or f"room-{autopilot}"
    design = (f"sim.autopilot={autopilot}", *(("estimator.inertial_std_mps2=0.0",) if lie == "none" else ()))
    flown = load_config(
        preset,
        [
            *design,
            *GUSTS,
            "sim.plant=quadrotor",
            f"duration_s={blackout_s[1] + 0.5}",  # nothing after it is judged
            f"sim.seed={seed}",
            f"link.blackout=[[{blackout_s[0]}, {blackout_s[1]}]]",
        ],
    )
    events = EventCodeSink()
    believed = load_config(preset, design)
    watched = TrackedFlyer(ControlLoop(believed, get_cached_controller(believed), events, lambda: 0))
    world = World(flown, watched)
    vehicle, sensors = world.peers.vehicle, world.peers.autopilot.inertial
    streams, position_message_id = world.peers.autopilot.telemetry.streams, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED
    says = streams[position_message_id]
    streams[position_message_id] = lambda at_ns: says(at_ns) if at_ns < silent_s * 1e9 else None

    watched.get_position = lambda: vehicle.position_m
    measure, kept = sensors.measure, []

    def lying(unit: int) -> InertialMeasurement:
        true = measure(unit)
        since_s = (watched.times_s[-1] if watched.times_s else 0.0) - lies_s
        if since_s < 0.0:
            return true
        kept.append(true)
        forces: dict[str, Vec3] = {
            "frozen": kept[0].force_mps2,
            "step": (true.force_mps2[0] - 1.5, *true.force_mps2[1:]),
            "offset": (true.force_mps2[0] - 0.7, true.force_mps2[1] - 0.7, true.force_mps2[2]),
            "small": (true.force_mps2[0] - 0.3, *true.force_mps2[1:]),
            "ramp": (true.force_mps2[0] - min(2.0 * since_s, 2.0), *true.force_mps2[1:]),
        }
        return true._replace(force_mps2=forces.get(lie, true.force_mps2))

    sensors.measure = lying  # type: ignore[method-assign]
    world.run(flown.duration_s)
    times, where = np.array(watched.times_s), np.array(watched.positions_m)
    beyond = compute_excess_m(where, *get_room_limits(flown))
    return float(beyond[(times >= blackout_s[0]) & (times <= blackout_s[1])].max()), frozenset(events.codes)


@pytest.mark.long
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
@pytest.mark.parametrize(("lie", "seed"), [("frozen", 3), ("step", 11), ("small", 3), ("ramp", 11)])
@pytest.mark.fault(58)
@pytest.mark.fault(59)
def test_an_inertial_error_from_a_blackout_is_found_by_the_vehicle_velocity(
    autopilot: str, lie: str, seed: int
) -> None:
    lied_m, events = measure_excess_m(autopilot, lie, seed)
    without_m, _ = measure_excess_m(autopilot, "none", seed)
    # No further than without them, or plainly inside: it brakes where they contradict, and does not fly on.
    assert lied_m < max(without_m + 0.2, -0.5) and lied_m < 0.0
    assert events & {"inertial-doubted", "inertial-silent"}


@pytest.mark.long
@pytest.mark.fault(59)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_an_inertial_error_from_the_start_is_found_in_an_early_blackout(autopilot: str) -> None:
    """No position could yet speak for the vehicle's own velocity: what was sent since the flight began does."""
    for seed in (3, 5):
        lied_m, events = measure_excess_m(autopilot, "offset", seed, "room", (0.4, 5.4), 0.0)
        assert lied_m < 0.1 and "inertial-doubted" in events


@pytest.mark.long
@pytest.mark.fault(59)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_a_missing_vehicle_velocity_raises_no_inconsistency(autopilot: str) -> None:
    for seed in (3, 5):
        healthy_m, events = measure_excess_m(autopilot, "", seed, "room", (2.5, 7.5), silent_s=2.5)
        assert healthy_m < -0.4 and "inertial-doubted" not in events


@pytest.mark.long
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_correct_inertial_data_raise_no_inconsistency_and_keep_further_from_walls(autopilot: str) -> None:
    for seed in (3, 11):
        healthy_m, events = measure_excess_m(autopilot, "", seed)
        without_m, told_without = measure_excess_m(autopilot, "none", seed)
        assert healthy_m < without_m + 0.1
        assert not (events | told_without) & {"inertial-doubted", "inertial-silent"}
