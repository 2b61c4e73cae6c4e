"""Faults in the course of a simulated flight, by the configuration's `[[sim.fault]]`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import msgspec

from sim.autopilot.autopilot import Autopilot
from sim.autopilot.profile import SIMULATED, Parameters
from sim.cameras import AXES, Cameras
from sim.channel import within
from sim.vehicle.linear import LinearVehicle
from sim.vehicle.quadrotor import Quadrotor
from uavctl.config.document import ConfigProblem
from uavctl.config.load import LoadedConfig, find_nearest
from uavctl.config.sim import FaultConfig
from uavctl.config.types import Config
from uavctl.errors import ConfigError

OF_LINK = ("blackout", "held", "uplink_blackout")
OF_CAMERA = ("occluded", "swapped", "frozen")
LASTING = ("wind", "battery", "frame", "noise", "drift", "parameter")
MOST_NOISE_M = 100.0
MODE_S = 1.0  # how long a change of mode is told; afterwards the mode itself tells


def with_spans(config: Config) -> Config:
    """Return the configuration with those faults merged in that are spans of the link or of the cameras."""
    replace = msgspec.structs.replace
    link, camera = config.link, config.sim.camera
    for fault in config.sim.fault:
        span = (fault.at_s, fault.at_s + fault.for_s)
        if fault.kind in OF_LINK:
            link = replace(link, **{fault.kind: (*getattr(link, fault.kind), span)})
        elif fault.kind in OF_CAMERA:
            camera = replace(camera, **{fault.kind: (*getattr(camera, fault.kind), span)})
    return replace(config, link=link, sim=replace(config.sim, camera=camera))


def check_faults(loaded: LoadedConfig) -> None:
    """Refuse a configuration with faults that its autopilot cannot have.

    Raises:
        ConfigError: With all problems found.
    """
    wrong = tuple(problems(loaded.config.sim.autopilot, loaded.config.sim.fault, "sim.fault"))
    if wrong:
        raise ConfigError(tuple(loaded.source.describe(problem) for problem in wrong))


def problems(
    autopilot: Literal["px4", "ardupilot"], faults: Sequence[FaultConfig], key: str
) -> Iterator[ConfigProblem]:
    """Return which parameters, values and modes of a list of faults an autopilot of this kind lacks."""
    parameters, modes = Parameters(autopilot), tuple(mode.name for mode in SIMULATED[autopilot].modes)
    for i, fault in enumerate(faults):
        if fault.kind == "frame":
            yield from _unknown(f"{key}[{i}].name", "there are no axes", fault.name, tuple(AXES))
        elif fault.kind == "noise" and not 0.0 <= fault.value <= MOST_NOISE_M:
            yield ConfigProblem(f"{key}[{i}].value", f"{fault.value:g} m is no noise", f"give 0 to {MOST_NOISE_M:g} m")
        elif fault.kind == "mode":
            yield from _unknown(f"{key}[{i}].name", f"{autopilot} has no mode", fault.name, modes)
        elif fault.kind == "parameter" and fault.name not in parameters:
            yield from _unknown(f"{key}[{i}].name", f"{autopilot} has no parameter", fault.name, parameters.names)
        elif fault.kind == "parameter" and not parameters.takes(fault.name, fault.value):
            few = " or ".join(f"{value:g}" for value in parameters.allowed(fault.name)) or "a number up to 1e9"
            yield ConfigProblem(
                f"{key}[{i}].value", f"{fault.value:g} is not simulated for {fault.name}", f"give {few}"
            )


def _unknown(key: str, what: str, name: str, names: Sequence[str]) -> Iterator[ConfigProblem]:
    if name and name not in names:
        nearest = find_nearest(name, names)
        yield ConfigProblem(
            key, f'{what} "{name}"{nearest}', "rename it" if nearest else f"give one of {', '.join(names)}"
        )


def active(config: Config, since_ns: int) -> tuple[str, ...]:
    """Return the faults at a time since the start [ns]: spans that it lies in, and changes made by then."""
    sections = ((config.link, OF_LINK), (config.sim.camera, OF_CAMERA))
    spans = [name for section, names in sections for name in names if within(getattr(section, name), since_ns)]
    made = [one for one in config.sim.fault if one.at_s * 1e9 <= since_ns]
    changes = [
        f"{one.kind} {one.name}".rstrip()
        for one in made
        if one.kind in LASTING or (one.kind == "mode" and since_ns <= (one.at_s + MODE_S) * 1e9)
    ]
    return tuple(dict.fromkeys([*spans, *changes]))


class Faults:
    """Faults that are no spans, each done once at its time.

    Raises:
        ConfigError: a parameter, a value or a mode that the autopilot has not.
    """

    def __init__(
        self, config: Config, vehicle: LinearVehicle | Quadrotor, autopilot: Autopilot, cameras: Cameras, start_ns: int
    ) -> None:
        wrong = tuple(problems(config.sim.autopilot, config.sim.fault, "sim.fault"))
        if wrong:
            raise ConfigError(tuple(f"{one.key}: {one.reason}; {one.todo}" for one in wrong))
        self._kind = SIMULATED[config.sim.autopilot]
        self._vehicle = vehicle
        self._autopilot = autopilot
        self._cameras = cameras
        numbered = [
            (start_ns + round(fault.at_s * 1e9), i, fault)
            for i, fault in enumerate(config.sim.fault)
            if fault.kind not in OF_LINK + OF_CAMERA
        ]
        self._ahead = sorted(numbered, key=lambda one: one[:2])

    @property
    def next_ns(self) -> int | None:
        """Time of the next fault [ns]."""
        return self._ahead[0][0] if self._ahead else None

    def run(self, at_ns: int) -> None:
        """Do the faults due at `at_ns`, with the vehicle moved there."""
        while self._ahead and self._ahead[0][0] <= at_ns:
            self._do(self._ahead.pop(0)[2], at_ns)

    def _do(self, fault: FaultConfig, at_ns: int) -> None:
        vehicle = self._vehicle
        if fault.kind == "parameter":
            self._autopilot.parameters.set(fault.name, fault.value)
        elif fault.kind == "frame":
            self._cameras.mistake(fault.name)
        elif fault.kind == "noise":
            self._cameras.shake(fault.value)
        elif fault.kind == "drift":
            self._cameras.creep(fault.velocity_mps)
        elif fault.kind == "mode":
            self._autopilot.pilot.change(self._kind.mode(fault.name), at_ns)
        elif isinstance(vehicle, Quadrotor):
            if fault.kind == "wind":
                vehicle.wind.blow(fault.velocity_mps)
            else:
                vehicle.battery.charge(fault.charge)
