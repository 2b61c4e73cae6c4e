"""What happens in the course of a simulated flight, by the configuration's `[[sim.fault]]`."""

from __future__ import annotations

import msgspec

from sim.autopilot import Autopilot
from sim.personality import PERSONALITIES
from sim.quadrotor import Quadrotor
from sim.spans import within
from sim.vehicle import Vehicle
from uavctl.config.sim import FaultConfig
from uavctl.config.types import Config
from uavctl.errors import ConfigError

OF_LINK = ("blackout", "held", "uplink_blackout")
OF_CAMERA = ("occluded", "swapped", "frozen")
LASTING = ("wind", "parameter")


def with_spans(config: Config) -> Config:
    """The configuration with the faults that are spans of the link and of the cameras among these."""
    replace = msgspec.structs.replace
    link, camera = config.link, config.sim.camera
    for fault in config.sim.fault:
        span = (fault.at_s, fault.at_s + fault.for_s)
        if fault.kind in OF_LINK:
            link = replace(link, **{fault.kind: (*getattr(link, fault.kind), span)})
        elif fault.kind in OF_CAMERA:
            camera = replace(camera, **{fault.kind: (*getattr(camera, fault.kind), span)})
    return replace(config, link=link, sim=replace(config.sim, camera=camera))


def active(config: Config, since_ns: int) -> tuple[str, ...]:
    """What is amiss at a time since the start [ns]: the spans that it lies in, and the lasting changes made by then.

    Args:
        config: as `with_spans` gives it.
        since_ns: the time.
    """
    sections = ((config.link, OF_LINK), (config.sim.camera, OF_CAMERA))
    spans = [name for section, names in sections for name in names if within(getattr(section, name), since_ns)]
    lasting = [one for one in config.sim.fault if one.kind in LASTING and one.at_s * 1e9 <= since_ns]
    return tuple(dict.fromkeys([*spans, *(f"{one.kind} {one.name}".rstrip() for one in lasting)]))


class Faults:
    """The faults that are no spans, each done once at its time.

    Raises:
        ConfigError: a parameter or a mode that the autopilot has not.
    """

    def __init__(self, config: Config, vehicle: Vehicle | Quadrotor, autopilot: Autopilot, start_ns: int) -> None:
        self._kind = PERSONALITIES[config.sim.autopilot]
        self._vehicle = vehicle
        self._autopilot = autopilot
        numbered = [
            (start_ns + round(fault.at_s * 1e9), i, fault)
            for i, fault in enumerate(config.sim.fault)
            if fault.kind not in OF_LINK + OF_CAMERA
        ]
        wrong = [self._unknown(i, fault) for _, i, fault in numbered]
        if any(wrong):
            raise ConfigError(tuple(filter(None, wrong)))
        self._ahead = sorted(numbered, key=lambda one: one[:2])

    def _unknown(self, number: int, fault: FaultConfig) -> str:
        names = {"parameter": self._autopilot.parameters.names, "mode": tuple(one.name for one in self._kind.modes)}
        known = names.get(fault.kind, (fault.name,))
        if fault.name in known:
            return ""
        few = "" if fault.kind == "parameter" else f"; it has {', '.join(known)}"
        return f"sim.fault[{number}].name: {self._kind.name} has no {fault.kind} {fault.name!r}{few}"

    @property
    def next_ns(self) -> int | None:
        """Time of the next one [ns]."""
        return self._ahead[0][0] if self._ahead else None

    def run(self, at_ns: int) -> None:
        """Do what is due at `at_ns`, the vehicle being there."""
        while self._ahead and self._ahead[0][0] <= at_ns:
            self._do(self._ahead.pop(0)[2], at_ns)

    def _do(self, fault: FaultConfig, at_ns: int) -> None:
        vehicle = self._vehicle
        if fault.kind == "parameter":
            self._autopilot.parameters.set(fault.name, fault.value)
        elif fault.kind == "mode":
            self._autopilot.pilot.change(self._kind.mode(fault.name), at_ns)
        elif isinstance(vehicle, Quadrotor):
            if fault.kind == "wind":
                vehicle.wind.blow(fault.velocity_mps)
            else:
                vehicle.battery.charge(fault.charge)
