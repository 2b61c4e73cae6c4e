"""Flights in memory, and what might have been in their place."""

from __future__ import annotations

from functools import cache

import numpy as np
from loopback_rig import MemorySink, header, lockstep, share_flight

from uavctl.config import Config, load_config
from uavctl.lab.whatif.flight import (
    Entry,
    RecordedFlight,
    ReflownFlight,
    SimulatedLink,
    make_recorded_flight,
    make_response,
    refly,
)
from uavctl.records import Record, Truth

EXACT = ("solver.method=exact",)
PAPER = ("paper", 20.0, EXACT)
# The cameras' shortest delay is taken to be unknown, as it is without TIMESYNC.
ROOM = ("room-hahn-stursberg", 8.0, (*EXACT, "clock.latency_s=0.0"))
QUADROTOR = ("room-hahn-stursberg", 8.0, (*EXACT, "sim.plant=quadrotor"))
Case = tuple[str, float, tuple[str, ...]]
# Positions and setpoints cross MAVLink as float32, in one order of rounding here and in another there.
WIRE = 1e-5


def load_case_config(case: Case, *changes: str) -> Config:
    name, duration_s, overrides = case
    return load_config(name, [f"duration_s={duration_s}", *overrides, *changes])


@cache
def fly_case(case: Case, *changes: str) -> MemorySink:
    name, duration_s, overrides = case
    return lockstep(name, duration_s, *overrides, *changes)


@cache
def history(case: Case) -> RecordedFlight:
    return make_recorded_flight(fly_case(case).entries, load_case_config(case), "recording")


def fly_again(case: Case, *changes: str, other_link: SimulatedLink | None = None) -> tuple[MemorySink, ReflownFlight]:
    config, memory = load_case_config(case, *changes), MemorySink()
    design, controller = share_flight(config)
    memory.put("/uavctl/header", 0, header(config, design))
    response = make_response(history(case), load_case_config(case).plant)
    course = refly(history(case), config, controller, response, memory, lambda: 0, other_link)
    return memory, course


def compute_differences(some: MemorySink, others: MemorySink) -> float:
    """Largest difference of the true states, and of the inputs that acted."""
    left, right = some.of(Truth), others.of(Truth)
    assert [decision.at_ns for decision in left] == [decision.at_ns for decision in right]
    states = np.array([decision.state for decision in left]) - np.array([decision.state for decision in right])
    inputs = np.array([decision.input for decision in left]) - np.array([decision.input for decision in right])
    return float(max(np.abs(states).max(), np.abs(inputs).max()))


def strip_recording(case: Case, kind: type[Record]) -> list[Entry]:
    return [entry for entry in fly_case(case).entries if not isinstance(entry[2], kind)]
