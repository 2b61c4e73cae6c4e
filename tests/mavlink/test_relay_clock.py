"""Positions go on to the vehicle whatever its link does to TIMESYNC; judged on the true vehicle and the true clocks."""

from __future__ import annotations

import math
import random
from bisect import bisect_left
from itertools import pairwise

import pytest
from indoors_rig import Delay, IndoorsRig
from mavlink_rig import MS, SECOND
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import Client

from sim.autopilot.autopilot import UPTIME_NS
from uavctl.config.checks import get_position_limits_m
from uavctl.event_codes import EventCode
from uavctl.records import Event, RelayStats, StepInput

TIMESYNC = mavlink.MAVLINK_MSG_ID_TIMESYNC
EXTERNAL = {"px4": "OFFBOARD", "ardupilot": "GUIDED"}
FROM_S, TO_S = 12.0, 26.0
SLOW_PPM = -14_000  # of PX4's own simulation, as recorded
Flights = dict[str, tuple[Delay, float]]


def both_ways(up_s: float, down_s: float, from_s: float = FROM_S, to_s: float = 1e9) -> Delay:
    return lambda at_s, data, up: (up_s if up else down_s) if from_s <= at_s < to_s else 0.002


def lossy(part: float, from_s: float, seed: int = 5) -> Delay:
    numbers = random.Random(seed)

    def delay(at_s: float, data: bytes, up: bool) -> float | None:
        timesync = int.from_bytes(data[7:10], "little") == TIMESYNC
        return None if timesync and at_s >= from_s and numbers.random() < part else 0.008

    return delay


def jitter(at_s: float, data: bytes, up: bool, numbers: random.Random = random.Random(7)) -> float | None:  # noqa: B008
    return numbers.uniform(0.002, 0.1) if at_s >= FROM_S else 0.002


# The way of each link, and by how much stamps may be off [s]: half of what the two directions differ by, at the least
# the half of a short round trip.
LINKS: Flights = {
    "5 ms": (both_ways(0.0025, 0.0025), 0.004),
    "16 ms from the start": (both_ways(0.008, 0.008, 0.0), 0.004),
    "16 ms": (both_ways(0.008, 0.008), 0.004),
    "200 ms": (both_ways(0.1, 0.1), 0.004),
    "200 ms from the start": (both_ways(0.1, 0.1, 0.0), 0.004),
    "100 ms, all up, from the start": (both_ways(0.1, 0.0, 0.0), 0.054),
    "100 ms, all down, from the start": (both_ways(0.0, 0.1, 0.0), 0.054),
    "100 ms, all up": (both_ways(0.1, 0.0), 0.054),
    "100 ms, all down": (both_ways(0.0, 0.1), 0.054),
    "10, 150, 10 ms": (both_ways(0.075, 0.075, FROM_S, FROM_S + 10.0), 0.006),
    "jitter to 200 ms": (jitter, 0.05),
    "half of the answers lost": (lossy(0.5, 0.0), 0.006),
    "no answers any more": (lossy(1.0, FROM_S), 0.006),
    "never an answer": (lossy(1.0, 0.0), 0.02),
}

# A quick one, a slow one that differs by direction, and one that loses answers; the others take as long.
QUICK = ("16 ms from the start", "100 ms, all up", "half of the answers lost")


def ready(name: str, delay: Delay, *more: str) -> IndoorsRig:
    rig = IndoorsRig(name, "sim.start_position_m=[0.0, 0.0, -0.1]", *more, delay=delay)
    rig.peers.receive("vehicle", Client().pack(mavlink.MAVLink_set_gps_global_origin_message(1, 0, 0, 0)), 0)
    rig.run(8.0)
    return rig


def assert_they_flow(rig: IndoorsRig, from_s: float, off_s: float) -> None:
    """Without a gap, and with stamps of the capture in the vehicle's clock; PX4 moves stamps itself."""
    sent = [(at_ns, message) for at_ns, message in rig.relayed() if at_ns > from_s * SECOND]
    times = [at_ns for at_ns, _ in sent]
    assert len(sent) > 15 * (rig.peers.now_ns / SECOND - from_s)
    assert max(b - a for a, b in pairwise(times)) < 500 * MS
    assert EventCode.RELAY_SILENT not in {event.code for event in rig.memory.of(Event)}
    captured = {one.position_m: one.captured_ns for inp in rig.memory.of(StepInput) for one in inp.samples}
    places = sorted(captured)
    rate = 1.0 + rig.config.sim.clock_drift_ppm * 1e-6
    for _, message in sent:
        place = message.x, message.y, message.z
        alike = places[max(bisect_left(places, place) - 2, 0) :][:4]  # messages carry them in single precision
        nearest = min(alike, key=lambda one: math.dist(one, place))
        assert abs((1000 * message.usec - UPTIME_NS) / rate - captured[nearest]) < off_s * SECOND + MS


@pytest.mark.fault(19)
@pytest.mark.parametrize(
    "link", [link if link in QUICK else pytest.param(link, marks=pytest.mark.slow) for link in LINKS]
)
def test_an_ardupilot_gets_its_positions_with_stamps_of_its_clock(link: str) -> None:
    delay, off_s = LINKS[link]
    rig = ready("ardupilot", delay)
    while rig.peers.now_ns < TO_S * SECOND:
        rig.run(1.0)
        assert rig.peers.autopilot.estimator.is_position_valid
    assert_they_flow(rig, 4.0, off_s)


@pytest.mark.long
@pytest.mark.fault(19)
@pytest.mark.parametrize(
    ("name", "link", "drift_ppm"),
    [
        ("ardupilot", "16 ms", SLOW_PPM),
        ("ardupilot", "100 ms, all down", 0),
        ("ardupilot", "never an answer", 0),
        ("px4", "16 ms", SLOW_PPM),
        ("px4", "200 ms", 0),
        ("px4", "200 ms", SLOW_PPM),
        ("px4", "200 ms", -SLOW_PPM),
        ("px4", "never an answer", SLOW_PPM),
    ],
)
def test_a_flying_vehicle_keeps_its_position_and_its_room_whatever_the_round_trips(
    name: str, link: str, drift_ppm: int
) -> None:
    delay, off_s = LINKS[link]
    rig = ready(name, delay, f"sim.clock_drift_ppm={drift_ppm}")
    rig.pilot_flies(EXTERNAL[name])
    estimator, vehicle = rig.peers.autopilot.estimator, rig.peers.vehicle
    limits = get_position_limits_m(rig.config)
    while rig.peers.now_ns < TO_S * SECOND:
        rig.run(0.1)
        assert estimator.is_position_valid and not rig.loop.finished, rig.peers.now_ns / SECOND
        assert max(abs(a - b) for a, b in zip(estimator.position_m, vehicle.position_m, strict=True)) < 0.25
        assert all(low < x < high for x, (low, high) in zip(vehicle.position_m, limits.values(), strict=False))
    assert_they_flow(rig, 8.0, off_s)


@pytest.mark.parametrize("name", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_a_relay_that_is_silent_is_reported_once_with_its_reason_and_its_end(name: str) -> None:
    rig = ready(name, both_ways(0.0, 0.0), "link.blackout=[[18.0, 20.5], [22.0, 22.4]]")
    rig.pilot_flies(EXTERNAL[name])
    rig.run(8.0)
    told = [event for event in rig.memory.of(Event) if event.code in (EventCode.RELAY_SILENT, EventCode.RELAY_RESUMED)]
    assert [event.code for event in told] == [EventCode.RELAY_SILENT, EventCode.RELAY_RESUMED]
    assert [event.at_ns / SECOND for event in told] == pytest.approx([18.55, 20.55], abs=0.15)
    silent = {stats.silent_for for stats in rig.memory.of(RelayStats)}
    assert silent == {"", "nothing comes"}
