"""Checks of the simulated side's configuration."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from uavctl.config.peers import DaemonConfig
from uavctl.config.problem import Problem
from uavctl.config.section import Spans
from uavctl.config.sim import FaultConfig, QuadrotorConfig, SimConfig, WindConfig

# Keys that a kind of fault heeds; the others are spans.
_OF_KIND = {
    "wind": ("velocity_mps",),
    "battery": ("charge",),
    "frame": ("name",),
    "noise": ("value",),
    "drift": ("velocity_mps",),
    "parameter": ("name", "value"),
    "mode": ("name",),
}


def spans(key: str, given: Spans) -> Iterator[Problem]:
    """Spans of time since the start that are none."""
    for i, (start, end) in enumerate(given):
        if not 0 <= start < end:
            yield Problem(
                f"{key}[{i}]",
                f"[{start:g}, {end:g}] is not a span of time",
                "give [from_s, to_s] with 0 <= from_s < to_s",
            )


def sim(config: SimConfig) -> Iterator[Problem]:
    """All problems of `[sim]`."""
    for name in ("occluded", "swapped", "frozen"):
        yield from spans(f"sim.camera.{name}", getattr(config.camera, name))
    yield from spans("sim.checks.invalid", config.checks.invalid)
    if config.checks.clears and config.autopilot != "px4":
        yield Problem(
            "sim.checks.clears",
            f'has no effect with autopilot "{config.autopilot}", which stays in the mode of its failsafe',
            'remove it, or set sim.autopilot = "px4"',
        )
    yield from faults("sim.fault", config.fault, config.plant)
    if config.plant == "linear":
        for key, same in (("wind", config.wind == WindConfig()), ("quadrotor", config.quadrotor == QuadrotorConfig())):
            if not same:
                yield Problem(
                    f"sim.{key}",
                    'has no effect with plant "linear", whose disturbance is that of [plant]',
                    'remove it, or set sim.plant = "quadrotor"',
                )
        if config.inertial.flown:
            yield Problem(
                "sim.inertial.flown",
                'has no effect with plant "linear", which is always level',
                'remove it, or set sim.plant = "quadrotor"',
            )
    elif config.start_position_m[2] >= 0.0:
        yield Problem(
            "sim.start_position_m[2]",
            f"{config.start_position_m[2]:g} m is not above the floor z = 0, where the quadrotor would stand",
            "give a number below 0 (local NED: up is negative)",
        )


def ids(sim: SimConfig, daemon: DaemonConfig) -> Iterator[Problem]:
    """Two on one link that cannot be told apart."""
    if sim.system_id == daemon.system_id:
        yield Problem(
            "sim.system_id", f"{sim.system_id} is that of the daemon too (daemon.system_id)", "give another number"
        )


def faults(key: str, given: tuple[FaultConfig, ...], plant: str) -> Iterator[Problem]:
    """All problems of a list of faults that happen to a plant of this kind."""
    for i, fault in enumerate(given):
        yield from _fault(f"{key}[{i}]", fault, plant)


def _fault(key: str, fault: FaultConfig, plant: str) -> Iterator[Problem]:
    meant = ("at_s", "kind", *_OF_KIND.get(fault.kind, ("for_s",)))
    for field in msgspec.structs.fields(fault):
        if field.name not in meant and getattr(fault, field.name) != field.default:
            yield Problem(f"{key}.{field.name}", f'has no effect with kind "{fault.kind}"', "remove it")
    if fault.kind in ("wind", "battery"):
        if plant == "linear":
            yield Problem(f"{key}.kind", f'plant "linear" has no {fault.kind}', 'set sim.plant = "quadrotor"')
    elif fault.kind in ("parameter", "mode", "frame"):
        if not fault.name:
            yield Problem(f"{key}.name", f"is missing: which {fault.kind}", "add it")
    elif fault.kind in ("noise", "drift"):
        return
    elif fault.for_s == 0.0:
        yield Problem(f"{key}.for_s", f'is missing: how long the span of kind "{fault.kind}" is', "add it")
