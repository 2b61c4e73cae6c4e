"""Senders in a recording of MAVLink, and the vehicle among them.

A log of a ground station may have several vehicles, and each of them a gimbal, a camera and a companion computer that
send heartbeats too. Header of a frame: https://mavlink.io/en/guide/serialization.html.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.tlog import GROUND_SYSTEMS, TlogPacket
from uavctl.errors import UsageError
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import Heartbeat
from uavctl.mavlink.profile import find_autopilot_name
from uavctl.mavlink.vehicle import is_vehicle

_AUTOPILOT = int(mavlink.MAV_COMP_ID_AUTOPILOT1)
# What a vehicle alone tells, so that one is known even where no heartbeat is in the file.
_STATES = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_SYS_STATUS, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT, mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, mavlink.MAVLINK_MSG_ID_VFR_HUD,
    }
)  # fmt: skip
_MAX_MISSING = 128  # numbers of a sequence of 256 that are missing at once; more is a step back
_MAX_LATE = 32  # numbers that a late message lies back: 12 in flights that were looked at
_MAX_DISORDER = 0.01  # steps back further than that, of the messages: a restart of the sender makes one


class LogSender(msgspec.Struct, frozen=True, kw_only=True):
    """One component that speaks in a recording."""

    system: int
    component: int
    kind: str  # of MAV_TYPE by its heartbeats; empty without any
    messages: int
    missing: int  # numbers of messages that are not in the recording: lost, or sent elsewhere; 0 in disorder
    disorder: bool = False  # several sequences of numbers, as of a program with several connections


@dataclass(frozen=True)
class ChosenVehicle:
    """The vehicle that a recording is read for, and the others in it."""

    system: int | None  # None: there is none
    heartbeat: Heartbeat | None  # its first; None if it sends none
    others: tuple[Heartbeat, ...] = ()  # the first of each other vehicle

    @property
    def notes(self) -> tuple[str, ...]:
        """Return sentences on other senders, and on unknown facts of the vehicle."""
        notes = []
        if self.system is not None and self.heartbeat is None:
            notes.append(f"system {self.system} sends no heartbeat of an autopilot: its mode and arming are not known")
        if self.others:
            names = ", ".join(
                f"system {sender.system} ({find_autopilot_name(sender.autopilot)})" for sender in self.others
            )
            notes.append(
                f"another vehicle is in it: {names}; system {self.system} is shown, `--system` chooses another"
                if len(self.others) == 1
                else f"other vehicles are in it: {names}; system {self.system} is shown, `--system` chooses another"
            )
        return tuple(notes)

    def of_others(self, packet: TlogPacket) -> bool:
        """Return whether a packet comes from another vehicle's system."""
        return any(get_system_id(packet.data) == sender.system for sender in self.others)


def get_system_id(frame: bytes) -> int:
    """Return the system id of a whole frame."""
    return frame[5 if frame[0] == mavlink.PROTOCOL_MARKER_V2 else 3]


def get_message_id(frame: bytes) -> int:
    """Return the message id of a whole frame."""
    return int.from_bytes(frame[7:10], "little") if frame[0] == mavlink.PROTOCOL_MARKER_V2 else frame[5]


def choose_vehicle(packets: Sequence[TlogPacket], name: str, system: int | None = None) -> ChosenVehicle:
    """Return the vehicle of some packets: the one that is asked for, else the first that is heard.

    Args:
        packets: whole frames in order of time.
        name: of the recording, for errors.
        system: the one that is asked for.

    Raises:
        UsageError: It is not in the recording.
    """
    first: dict[tuple[int, int], Heartbeat] = {}
    for packet in packets:
        if get_message_id(packet.data) == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            for message in decode(packet.data).messages:
                if isinstance(message, Heartbeat) and is_vehicle(message):
                    first.setdefault((message.system, message.component), message)
    vehicles: dict[int, Heartbeat] = {}
    for sender in sorted(first.values(), key=lambda sender: sender.component != _AUTOPILOT):  # in order else
        vehicles.setdefault(sender.system, sender)
    if system is None:
        system = next(iter(vehicles), None)
    elif system not in vehicles and all(get_system_id(packet.data) != system for packet in packets):
        there = sorted({get_system_id(packet.data) for packet in packets})
        listed = ", ".join(map(str, there))
        raise UsageError(f"--system {system}: {name} has nothing of it; systems in it: {listed}")
    if system is None:
        systems = (get_system_id(packet.data) for packet in packets if get_message_id(packet.data) in _STATES)
        system = next((system for system in systems if system not in GROUND_SYSTEMS), None)
    others = tuple(vehicle for number, vehicle in sorted(vehicles.items()) if number != system)
    return ChosenVehicle(system, None if system is None else vehicles.get(system), others)


@dataclass
class _Sequence:
    """Numbers of one sender's messages, modulo 256."""

    newest: int
    messages: int = 0
    steps_back: int = 0  # that are no late message
    missing: int = 0
    open_numbers: set[int] = field(default_factory=set)  # missing among the last `_MAX_LATE`

    def take(self, number: int) -> None:
        """Take the number of the next message."""
        self.messages += 1
        step = (number - self.newest) % 256
        if step == 0:  # a link may double a message
            return
        if number in self.open_numbers:
            self.open_numbers.remove(number)
            self.missing -= 1
        elif 0 < step <= _MAX_MISSING + 1:
            self.missing += step - 1
            self.open_numbers |= {(self.newest + ahead) % 256 for ahead in range(1, step)}
            self.newest = number
            self.open_numbers = {one for one in self.open_numbers if (number - one) % 256 <= _MAX_LATE}
        else:
            self.steps_back += 1
            self.newest = number
            self.open_numbers.clear()


class SenderCounter:
    """Counts the frames of each component."""

    def __init__(self) -> None:
        self._sequences: dict[tuple[int, int], _Sequence] = {}
        self._kinds: dict[tuple[int, int], int] = {}

    def take(self, frame: bytes) -> None:
        """Take a whole frame, of a known message or not."""
        at = 4 if frame[0] == mavlink.PROTOCOL_MARKER_V2 else 2
        sender = (frame[at + 1], frame[at + 2])
        self._sequences.setdefault(sender, _Sequence(newest=(frame[at] - 1) % 256)).take(frame[at])

    def take_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Take the type that a sender reports."""
        self._kinds[heartbeat.system, heartbeat.component] = heartbeat.vehicle_type

    def listed(self) -> Iterable[LogSender]:
        """Return the senders, by system and component."""
        for (system, component), sequence in sorted(self._sequences.items()):
            kind = self._kinds.get((system, component))
            disorder = sequence.steps_back > max(1.0, _MAX_DISORDER * sequence.messages)
            yield LogSender(
                system=system, component=component, kind="" if kind is None else _get_type_name(kind),
                messages=sequence.messages, missing=0 if disorder else sequence.missing, disorder=disorder,
            )  # fmt: skip


def _get_type_name(kind: int) -> str:
    entry = mavlink.enums["MAV_TYPE"].get(kind)
    return f"type {kind}" if entry is None else entry.name.removeprefix("MAV_TYPE_").lower().replace("_", " ")
