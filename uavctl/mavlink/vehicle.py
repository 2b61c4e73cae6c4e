"""The vehicle as its messages tell: status, and its own words."""

from __future__ import annotations

from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.data import Event, Severity, VehicleStatus
from uavctl.mavlink.messages import Ack, Battery, Heartbeat, Landed, Message, Text
from uavctl.mavlink.mode import autopilot_name, describe_mode

SECOND_VEHICLE = "second-vehicle"
_NO_AUTOPILOT = int(mavlink.MAV_AUTOPILOT_INVALID)
_GROUND_STATION = int(mavlink.MAV_TYPE_GCS)


def is_vehicle(heartbeat: Heartbeat) -> bool:
    """Whether a heartbeat is an autopilot's: not a ground station's, a camera's or a gimbal's."""
    return heartbeat.autopilot != _NO_AUTOPILOT and heartbeat.vehicle_type != _GROUND_STATION


class VehicleWatch:
    """Follows the first vehicle that is heard; others are counted and ignored.

    Args:
        bad: counter that heartbeats of other vehicles are added to.
    """

    def __init__(self, bad: Callable[[str], None]) -> None:
        self._bad = bad
        self._landed: bool | None = None
        self._battery_v: float | None = None
        self.address: tuple[int, int] | None = None  # system, component

    def take(self, message: Message, at_ns: int) -> VehicleStatus | Event | None:
        """Take any message; only the vehicle's count."""
        if isinstance(message, Heartbeat) and is_vehicle(message):
            return self._heartbeat(message, at_ns)
        if self.address is None or message.system != self.address[0]:
            return None
        match message:
            case Landed(landed=landed):
                self._landed = landed
            case Battery(voltage_v=voltage_v):
                self._battery_v = voltage_v
            case Text(severity=severity, text=text):
                return Event(at_ns=at_ns, severity=_severity(severity), code="vehicle-text", text=text)
            case Ack():
                return _ack_event(message, at_ns)
        return None

    def _heartbeat(self, message: Heartbeat, at_ns: int) -> VehicleStatus | None:
        address = (message.system, message.component)
        if self.address is None:
            self.address = address
        if address != self.address:
            if message.system != self.address[0]:
                self._bad(SECOND_VEHICLE)
            return None
        autopilot = autopilot_name(message.autopilot)
        mode, external = describe_mode(autopilot, message.vehicle_type, message.custom_mode)
        return VehicleStatus(
            at_ns=at_ns,
            autopilot=autopilot,
            armed=bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED),
            mode=mode,
            external=external,
            landed=self._landed,
            battery_v=self._battery_v,
        )


def _severity(mav_severity: int) -> Severity:
    if mav_severity <= mavlink.MAV_SEVERITY_ERROR:
        return Severity.ERROR
    return Severity.WARNING if mav_severity == mavlink.MAV_SEVERITY_WARNING else Severity.INFO


def _ack_event(ack: Ack, at_ns: int) -> Event:
    good = ack.result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
    return Event(
        at_ns=at_ns,
        severity=Severity.INFO if good else Severity.WARNING,
        code="command-ack",
        text=f"{_enum_name('MAV_CMD', ack.command)}: {_enum_name('MAV_RESULT', ack.result)}",
    )


def _enum_name(enum: str, value: int) -> str:
    entry = mavlink.enums[enum].get(value)
    return str(value) if entry is None else str(entry.name).removeprefix(f"{enum}_")
