"""Faults and attacks between cameras, sender and vehicles, for `sender_rig.fly_pair`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sender_rig import Air

from uavctl.mavlink.encoder import Encoder
from uavctl.wiring.sender import PositionMessage, PositionSender

BEGIN_NS = 2_000_000_000  # both vehicles are in motion
SECOND_NS = 1_000_000_000
OnTick = Callable[[int], None]


def read_message(data: bytes) -> Any:
    """The one message of a datagram."""
    (message,) = list(mavlink.MAVLink(None).parse_buffer(data) or ())
    return message


def kill_sender(restart_s: float | None) -> Callable[[Air], OnTick]:
    """End the sender in motion; another one starts after some time, or none does."""

    def make(air: Air) -> OnTick:
        def act(at_ns: int) -> None:
            if at_ns == BEGIN_NS:
                air.senders = []
            if restart_s is not None and at_ns == BEGIN_NS + round(restart_s * 1e9):
                air.senders = [air.make_sender(at_ns)]

        return act

    return make


def start_second_sender(air: Air) -> OnTick:
    """Start a second sender in motion."""

    def act(at_ns: int) -> None:
        if at_ns == BEGIN_NS:
            air.senders.append(air.make_sender(at_ns))

    return act


class _OtherClock:
    """A sender on another computer, whose clock is 1000 s ahead."""

    def __init__(self, sender: PositionSender) -> None:
        self._sender, self._encoder = sender, Encoder(246, 197)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sender, name)

    def send_next(self, at_ns: int) -> Any:
        sent = self._sender.send_next(at_ns)
        if not isinstance(sent, PositionMessage):
            return sent
        message = read_message(sent.frame)
        angles = message.roll, message.pitch, message.yaw
        stamp_us = message.usec + 1_000_000_000
        return sent._replace(frame=self._encoder.encode_position(stamp_us, (message.x, message.y, message.z), angles))


def start_sender_elsewhere(air: Air) -> OnTick:
    """Start a second sender in motion, on another computer."""

    def act(at_ns: int) -> None:
        if at_ns == BEGIN_NS:
            air.senders.append(cast(PositionSender, _OtherClock(air.make_sender(at_ns))))

    return act


def exchange_bodies(seconds: float) -> Callable[[Air], None]:
    """Give each vehicle the body of the other one for a time."""

    def make(air: Air) -> None:
        def exchange(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
            is_exchanged = BEGIN_NS <= at_ns < BEGIN_NS + seconds * 1e9
            return ((1 - number if is_exchanged else number, data),)

        air.cameras = exchange

    return make


def exchange_after_gap(seconds: float) -> Callable[[Air], None]:
    """Hide both vehicles for a time; the cameras then take one for the other."""

    def make(air: Air) -> None:
        def exchange(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
            if at_ns < BEGIN_NS:
                return ((number, data),)
            return () if at_ns < BEGIN_NS + seconds * 1e9 else ((1 - number, data),)

        air.cameras = exchange

    return make


def lose_bodies(numbers: Sequence[int], seconds: float) -> Callable[[Air], None]:
    """Let the cameras lose bodies for a time."""

    def make(air: Air) -> None:
        def lose(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
            is_lost = number in numbers and BEGIN_NS <= at_ns < BEGIN_NS + seconds * 1e9
            return () if is_lost else ((number, data),)

        air.cameras = lose

    return make


def shift_stamps(shift_s: float, period: int = 1) -> Callable[[Air], None]:
    """Move each `period`-th stamp of the first vehicle's cameras."""

    def make(air: Air) -> None:
        count = 0

        def shift(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
            nonlocal count
            count += 1
            if number or at_ns < BEGIN_NS or count % period:
                return ((number, data),)
            message = read_message(data)
            message.usec += round(shift_s * 1e6)
            return ((number, bytes(message.pack(mavlink.MAVLink(None, 17, 197)))),)

        air.cameras = shift

    return make


def change_reports(change: str) -> Callable[[Air], None]:
    """Let the first vehicle's reports be missing, late by 2 s, or forged: they claim that every message arrives."""

    def make(air: Air) -> None:
        encoder = Encoder(1, 1)

        def change_report(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
            del at_ns
            if number:
                return ((0, data),)
            return ((2 * SECOND_NS, data),) if change == "late" else ()

        def claim(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
            message = read_message(data)
            if number == 0 and message.get_type() == "VISION_POSITION_ESTIMATE":
                report = encoder.encode_position_report(message.usec, 1, 246, 197)
                for sender in air.senders:
                    if sender is not None:
                        sender.receive_reports(0, report, at_ns)
            return ((0, data),)

        air.to_sender = change_report
        if change == "forged":
            air.to_vehicle = claim

    return make


def forge_positions(shift_s: float) -> Callable[[Air], None]:
    """Send the first vehicle forged positions 1.5 m away, with stamps of the future, beside the true ones."""

    def make(air: Air) -> None:
        encoder = Encoder(246, 197)

        def forge(number: int, data: bytes, at_ns: int) -> Sequence[tuple[int, bytes]]:
            message = read_message(data)
            if number or at_ns < BEGIN_NS or message.get_type() != "VISION_POSITION_ESTIMATE":
                return ((0, data),)
            place = message.x, message.y - 1.5, message.z
            forged = encoder.encode_position(message.usec + round(shift_s * 1e6), place, (0.0, 0.0, 0.0))
            return ((0, data), (1_000_000, forged))

        air.to_vehicle = forge

    return make


ATTACKS: dict[str, Callable[[Air], OnTick | None]] = {
    "sender-restarted": kill_sender(0.5),
    "sender-away-for-3-s": kill_sender(3.0),
    "sender-killed": kill_sender(None),
    "two-senders": start_second_sender,
    "two-senders-two-clocks": start_sender_elsewhere,
    "bodies-exchanged": exchange_bodies(100.0),
    "bodies-exchanged-for-1-s": exchange_bodies(1.0),
    "bodies-exchanged-after-0.3-s": exchange_after_gap(0.3),
    "bodies-exchanged-after-1-s": exchange_after_gap(1.0),
    "bodies-exchanged-after-2-s": exchange_after_gap(2.0),
    "reports-missing": change_reports("missing"),
    "reports-late": change_reports("late"),
    "reports-forged": change_reports("forged"),
    "cameras-stall": lose_bodies((0, 1), 100.0),
    "body-lost-for-5-s": lose_bodies((0,), 5.0),
    "clock-jumps-ahead": shift_stamps(100.0),
    "stamps-of-the-future": shift_stamps(0.5, 3),
    "clock-steps-back": shift_stamps(-2.0),
    "forged-positions": forge_positions(0.0005),
    "forged-positions-of-the-future": forge_positions(5.0),
}
