"""Faults in the course of a simulated flight, by the configuration's `[[sim.fault]]`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import msgspec

from sim.autopilot.autopilot import Autopilot
from sim.autopilot.parameters import Parameters
from sim.autopilot.profile import SIMULATED
from sim.cameras import AXES, Cameras
from sim.channel import is_within
from sim.vehicle.linear import LinearVehicle
from sim.vehicle.quadrotor import Quadrotor
from uavctl.config.document import ConfigProblem
from uavctl.config.load import LoadedConfig, find_nearest
from uavctl.config.sim import FaultConfig
from uavctl.config.types import Config
from uavctl.errors import ConfigError

LINK_FAULTS = ("blackout", "held", "uplink_blackout")
CAMERA_FAULTS = ("occluded", "swapped", "frozen")
LASTING_FAULTS = ("wind", "battery", "frame", "noise", "drift", "parameter")
MAX_NOISE_M = 100.0
MODE_REPORT_S = 1.0  # a change of mode counts as a fault for this time


def merge_fault_spans(config: Config) -> Config:
    """Return the configuration with those faults merged in that are spans of the link or of the cameras."""
    replace = msgspec.structs.replace
    link, camera = config.link, config.sim.camera
    for fault in config.sim.fault:
        span = (fault.at_s, fault.at_s + fault.for_s)
        if fault.kind in LINK_FAULTS:
            link = replace(link, **{fault.kind: (*getattr(link, fault.kind), span)})
        elif fault.kind in CAMERA_FAULTS:
            camera = replace(camera, **{fault.kind: (*getattr(camera, fault.kind), span)})
    return replace(config, link=link, sim=replace(config.sim, camera=camera))


def check_fault_support(loaded: LoadedConfig) -> None:
    """Refuse a configuration with faults that its autopilot cannot have.

    Raises:
        ConfigError: With all problems found.
    """
    problems = tuple(find_fault_problems(loaded.config.sim.autopilot, loaded.config.sim.fault, "sim.fault"))
    if problems:
        raise ConfigError(tuple(loaded.source.describe(problem) for problem in problems))


def find_fault_problems(
    autopilot: Literal["px4", "ardupilot"], faults: Sequence[FaultConfig], key: str
) -> Iterator[ConfigProblem]:
    """Return which parameters, values and modes of a list of faults an autopilot of this kind lacks."""
    parameters, modes = Parameters(autopilot), tuple(mode.name for mode in SIMULATED[autopilot].modes)
    for i, fault in enumerate(faults):
        if fault.kind == "frame":
            yield from _check_name(f"{key}[{i}].name", "there are no axes", fault.name, tuple(AXES))
        elif fault.kind == "noise" and not 0.0 <= fault.value <= MAX_NOISE_M:
            yield ConfigProblem(f"{key}[{i}].value", f"{fault.value:g} m is no noise", f"give 0 to {MAX_NOISE_M:g} m")
        elif fault.kind == "mode":
            yield from _check_name(f"{key}[{i}].name", f"{autopilot} has no mode", fault.name, modes)
        elif fault.kind == "parameter" and fault.name not in parameters:
            yield from _check_name(f"{key}[{i}].name", f"{autopilot} has no parameter", fault.name, parameters.names)
        elif fault.kind == "parameter" and not parameters.accepts(fault.name, fault.value):
            allowed_values = (
                " or ".join(f"{value:g}" for value in parameters.get_allowed(fault.name)) or "a number up to 1e9"
            )
            yield ConfigProblem(
                f"{key}[{i}].value", f"{fault.value:g} is not simulated for {fault.name}", f"give {allowed_values}"
            )


def _check_name(key: str, complaint: str, name: str, names: Sequence[str]) -> Iterator[ConfigProblem]:
    if name and name not in names:
        nearest = find_nearest(name, names)
        yield ConfigProblem(
            key, f'{complaint} "{name}"{nearest}', "rename it" if nearest else f"give one of {', '.join(names)}"
        )


def find_active_faults(config: Config, since_ns: int) -> tuple[str, ...]:
    """Return the faults at a time since the start [ns]: spans around it, and changes made before."""
    sections = ((config.link, LINK_FAULTS), (config.sim.camera, CAMERA_FAULTS))
    spans = [name for section, names in sections for name in names if is_within(getattr(section, name), since_ns)]
    past_faults = [fault for fault in config.sim.fault if fault.at_s * 1e9 <= since_ns]
    changes = [
        f"{fault.kind} {fault.name}".rstrip()
        for fault in past_faults
        if fault.kind in LASTING_FAULTS or (fault.kind == "mode" and since_ns <= (fault.at_s + MODE_REPORT_S) * 1e9)
    ]
    return tuple(dict.fromkeys([*spans, *changes]))


class Faults:
    """Faults that are no spans, each done once at its time.

    Raises:
        ConfigError: a parameter, a value or a mode that the autopilot lacks.
    """

    def __init__(
        self, config: Config, vehicle: LinearVehicle | Quadrotor, autopilot: Autopilot, cameras: Cameras, start_ns: int
    ) -> None:
        problems = tuple(find_fault_problems(config.sim.autopilot, config.sim.fault, "sim.fault"))
        if problems:
            raise ConfigError(tuple(f"{entry.key}: {entry.reason}; {entry.todo}" for entry in problems))
        self._kind = SIMULATED[config.sim.autopilot]
        self._vehicle = vehicle
        self._autopilot = autopilot
        self._cameras = cameras
        numbered = [
            (start_ns + round(fault.at_s * 1e9), i, fault)
            for i, fault in enumerate(config.sim.fault)
            if fault.kind not in LINK_FAULTS + CAMERA_FAULTS
        ]
        self._pending = sorted(numbered, key=lambda entry: entry[:2])

    @property
    def next_ns(self) -> int | None:
        """Time of the next fault [ns]."""
        return self._pending[0][0] if self._pending else None

    def run(self, at_ns: int) -> None:
        """Do the faults due at `at_ns`, with the vehicle moved there."""
        while self._pending and self._pending[0][0] <= at_ns:
            self._apply(self._pending.pop(0)[2], at_ns)

    def _apply(self, fault: FaultConfig, at_ns: int) -> None:
        vehicle = self._vehicle
        if fault.kind == "parameter":
            self._autopilot.parameters.set(fault.name, fault.value)
        elif fault.kind == "frame":
            self._cameras.set_axes(fault.name)
        elif fault.kind == "noise":
            self._cameras.set_noise(fault.value)
        elif fault.kind == "drift":
            self._cameras.set_drift(fault.velocity_mps)
        elif fault.kind == "mode":
            self._autopilot.pilot.change_mode(self._kind.get_mode(fault.name), at_ns)
        elif isinstance(vehicle, Quadrotor):
            if fault.kind == "wind":
                vehicle.wind.set_mean(fault.velocity_mps)
            else:
                vehicle.battery.set_charge(fault.charge)
