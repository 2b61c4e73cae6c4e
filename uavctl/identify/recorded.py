"""The history of a flight out of its recording: our own, or a `.tlog` of anybody's."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.tlog import TlogPacket
from uavctl.config import Config
from uavctl.data import Datagram, PositionSample, Record, Setpoint, StepInput
from uavctl.errors import RecordingError
from uavctl.identify.exchange import Exchange
from uavctl.identify.history import LEAST_SAMPLES, Asked, Seen, seen_from
from uavctl.loop import MOCAP, make_links
from uavctl.mavlink.clocksync import ClockSource
from uavctl.mavlink.framing import scan

_NO_POSITION_NO_VELOCITY = 0x03F  # bits of type_mask: ignored
_MASK = 0x3FF  # of position, velocity, acceleration, and of acceleration as a force; whatever yaw does
_LOCAL_NED = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_OFFSET_NED)

_AUTOPILOTS = {mavlink.MAV_AUTOPILOT_PX4: "px4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot"}
_SHORTEST = 10  # bytes of the longer head
_STAMPED = {  # positions that begin with their time [µs]
    mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
    mavlink.MAVLINK_MSG_ID_VICON_POSITION_ESTIMATE,
    mavlink.MAVLINK_MSG_ID_ATT_POS_MOCAP,
    mavlink.MAVLINK_MSG_ID_ODOMETRY,
}
_SHORT_S = 0.1  # clocks that know nothing of each other are no tenth of a second apart
_QUICK = 0.2  # share of spacings without a loss, at the least
_REGULAR, _MOSTLY = 0.25, 0.9  # of a period, and the share of spacings that are nearer to a multiple of it
_REMEMBERED = 64  # messages among which the newest is looked for: one may be overtaken by others

Address = tuple[int, int]
Row = tuple[float, float, tuple[float, float, float]]


@dataclass(frozen=True, eq=False)
class History:
    """What a flight asked for and saw; times count from its first position [s].

    Attributes:
        asked: Setpoints.
        seen: Positions.
        gaps: Messages lost after each one that came from the positions' sender.
        autopilot: Whose software flew, "px4" or "ardupilot"; empty where nobody said so.
        parameters: The vehicle's own that begin with PSC_, by name, as far as they were asked for.
        latency_s: The shortest delay from capture to arrival [s], where the stamps tell it; else None.
    """

    asked: Asked
    seen: Seen
    gaps: NDArray[np.int64]
    autopilot: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)
    latency_s: float | None = None


class VehicleWords:
    """What the vehicle says of itself: whose software it flies, and its parameters of the position loops."""

    def __init__(self) -> None:
        self.autopilot = ""
        self.parameters: dict[str, float] = {}
        self._parser = mavlink.MAVLink(None)

    def take(self, data: bytes) -> None:
        """Read what a datagram, or a packet, holds."""
        for frame in scan(data, final=True).frames:
            if frame.message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                kind = self._parser.decode(bytearray(frame.data)).autopilot
                self.autopilot = _AUTOPILOTS.get(kind, self.autopilot)
            elif frame.message_id == mavlink.MAVLINK_MSG_ID_PARAM_VALUE:
                message = self._parser.decode(bytearray(frame.data))
                if message.param_id.startswith("PSC_") and math.isfinite(message.param_value):
                    self.parameters[message.param_id] = float(message.param_value)


class Senders:
    """Who sent what: numbers of the messages of each, modulo 256 as they come, and stamps of its positions."""

    def __init__(self) -> None:
        self._numbers: defaultdict[Address, list[int]] = defaultdict(list)
        self._stamps: defaultdict[Address, list[tuple[int, int]]] = defaultdict(list)

    def take(self, data: bytes, at_ns: int) -> None:
        """Count what a datagram, or a packet, holds: messages of unknown ids too, by their lengths."""
        for head in _heads(data):
            known = self._numbers[head.sender]
            newest = max(known[-_REMEMBERED:], default=head.number)
            known.append(newest + (head.number - newest + 128) % 256 - 128)
            if head.message_id in _STAMPED:
                self._stamps[head.sender].append((int.from_bytes(head.payload[:8], "little"), at_ns))

    def gaps(self, sender: Address) -> NDArray[np.int64]:
        """Messages of a sender lost after each one: by the stamps if they are regular, else by the numbers.

        A bridge numbers what it sends, and tells nothing of what was lost on the way to it.
        """
        stamps = np.unique([stamp for stamp, _ in self._stamps.get(sender, ())])
        by_times = _missing_of(np.diff(stamps))
        if by_times is not None:
            return by_times
        numbers = sorted(set(self._numbers[sender]))
        return np.array([after - before - 1 for before, after in pairwise(numbers)], dtype=np.int64)

    def shortest_delay_s(self, sender: Address) -> float | None:
        """The least time from a stamp to its arrival [s], if both are of one clock: then only is it a short one."""
        delays_s = [1e-9 * (at_ns - 1000 * stamp) for stamp, at_ns in self._stamps.get(sender, ())]
        return min(delays_s) if delays_s and 0.0 <= min(delays_s) <= _SHORT_S else None


def _missing_of(spacings: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Frames that are missing in each of the spacings of a regular camera's stamps; None of any other's."""
    if len(spacings) < LEAST_SAMPLES:
        return None
    period = float(np.quantile(spacings, _QUICK))
    for most in (2.0, 4.0, 16.0):  # the better the period is known, the longer a gap tells of it
        near = spacings[(spacings > 0.5 * period) & (spacings < (most + 0.5) * period)]
        period = float(near.sum() / np.rint(near / period).sum())
    frames = spacings / period
    off = np.abs(frames - np.rint(frames))[frames < 16.5]
    if np.mean(off < _REGULAR) < _MOSTLY:
        return None
    return np.maximum(np.rint(frames).astype(np.int64) - 1, 0)


class _Head(NamedTuple):
    """Head of a frame, and what it carries."""

    number: int
    sender: Address
    message_id: int
    payload: bytes


def _heads(data: bytes) -> Iterator[_Head]:
    """Each frame, one after the other up to the first byte that begins none."""
    at = 0
    while at + _SHORTEST <= len(data):
        length = data[at + 1]
        if data[at] == mavlink.PROTOCOL_MARKER_V2:
            signature = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN if data[at + 2] & mavlink.MAVLINK_IFLAG_SIGNED else 0
            sender, kind = (data[at + 5], data[at + 6]), int.from_bytes(data[at + 7 : at + 10], "little")
            yield _Head(data[at + 4], sender, kind, data[at + 10 : at + 10 + length])
            at += 12 + length + signature
        elif data[at] == mavlink.PROTOCOL_MARKER_V1:
            yield _Head(data[at + 2], (data[at + 3], data[at + 4]), data[at + 5], data[at + 6 : at + 6 + length])
            at += 8 + length
        else:
            return


def from_records(records: Iterable[tuple[str, int, Record]]) -> History:
    """Out of a recording of ours.

    Raises:
        RecordingError: No position or no setpoint in it.
    """
    samples: list[PositionSample] = []
    sent: list[tuple[int, tuple[float, float, float], bool]] = []
    senders, told = Senders(), VehicleWords()
    flown = False
    for _, at_ns, record in records:
        if isinstance(record, Datagram) and not record.outgoing:
            senders.take(record.data, at_ns)
            told.take(record.data)
        elif isinstance(record, StepInput):
            samples.extend(record.samples)
            flown = record.vehicle is not None and record.vehicle.armed and record.vehicle.external
        elif isinstance(record, Setpoint):
            sent.append((record.at_ns, record.accel_mps2, flown))
    return _history(sent, samples, senders, told)


def from_tlog(packets: Iterable[TlogPacket], config: Config) -> History:
    """Out of a `.tlog`: positions as the daemon would take them, acceleration setpoints as they were sent.

    Args:
        packets: In file order.
        config: Says which messages count as positions, and how their frame and clock are turned into ours.

    Raises:
        RecordingError: No position or no acceleration setpoint in it.
    """
    whole = tuple(packets)
    sent: list[tuple[int, tuple[float, float, float], bool]] = []
    senders, told = Senders(), VehicleWords()
    for packet in whole:
        if packet.outgoing:
            sent.extend((packet.at_ns, accel, alone) for accel, alone in _accelerations(packet.data))
        else:
            senders.take(packet.data, packet.at_ns)
            told.take(packet.data)
    samples, answered = _samples(whole, config)
    latency_s = senders.shortest_delay_s(_source(samples)) if samples else None
    if latency_s is not None:
        clock = msgspec.structs.replace(config.clock, latency_s=round(latency_s, 4))
        samples, _ = _samples(whole, msgspec.structs.replace(config, clock=clock))
    elif answered:
        latency_s = max(0.0, min(1e-9 * (one.received_ns - one.captured_ns) for one in answered))
        # Those from before the clock was known count by what stamps alone tell: how late they are is not known.
        samples = answered if len(answered) > len(samples) // 2 else samples
    return replace(_history(sent, samples, senders, told), latency_s=latency_s)


def _samples(packets: Sequence[TlogPacket], config: Config) -> tuple[list[PositionSample], list[PositionSample]]:
    """Positions as the daemon would take them, and those of them whose clock the client's own exchange told.

    A source that answers nothing may stamp by the vehicle's clock: its answers are tried for such stamps too.
    """
    links = make_links(config)
    link = links.get(MOCAP) or next(iter(links.values()))
    exchange, senders = Exchange(), {head.sender for one in packets if not one.outgoing for head in _heads(one.data)}
    found, answered = [], []
    for one in packets:
        for trip in exchange.take(one.data, one.at_ns, outgoing=one.outgoing):
            for address in senders:
                link.answered(address, trip.sent_ns, trip.remote_ns, one.at_ns)
        if one.outgoing:
            continue
        for item in link.receive(one.data, one.at_ns):
            if isinstance(item, PositionSample):
                found.append(item)
                if link.clock_source is ClockSource.TIMESYNC:
                    answered.append(item)
    return found, answered


def _source(samples: Iterable[PositionSample]) -> Address:
    """System and component of who sent most of the positions that were taken."""
    ((source, _),) = Counter(one.source for one in samples).most_common(1)
    system, component = source.rsplit(" ", 1)[-1].split("/")
    return int(system), int(component)


def _history(
    sent: list[tuple[int, tuple[float, float, float], bool]],
    samples: list[PositionSample],
    senders: Senders,
    told: VehicleWords,
) -> History:
    if not samples or not sent:
        missing = "no position" if not samples else "no acceleration setpoint"
        raise RecordingError(f"the recording has {missing}: there is nothing to identify a vehicle from")
    origin_ns = min(sample.captured_ns for sample in samples)
    rows: list[Row] = [
        ((one.captured_ns - origin_ns) * 1e-9, (one.received_ns - origin_ns) * 1e-9, one.position_m)
        for one in samples
        if all(map(math.isfinite, one.position_m))
    ]
    asked = Asked(
        times_s=np.array([(at_ns - origin_ns) * 1e-9 for at_ns, _, _ in sent]),
        accel_mps2=np.array([accel for _, accel, _ in sent]),
        flown=np.array([flown for _, _, flown in sent]),
    )
    return History(asked, seen_from(rows), senders.gaps(_source(samples)), told.autopilot, told.parameters)


def _accelerations(data: bytes) -> Iterable[tuple[tuple[float, float, float], bool]]:
    """Setpoints in a client's packet, and whether each asks for an acceleration and nothing else."""
    parser = mavlink.MAVLink(None)
    for frame in scan(data, final=True).frames:
        if frame.message_id == mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED:
            message = parser.decode(bytearray(frame.data))
            alone = message.type_mask & _MASK == _NO_POSITION_NO_VELOCITY and message.coordinate_frame in _LOCAL_NED
            accel = (message.afx, message.afy, message.afz)
            yield (accel, True) if alone and all(map(math.isfinite, accel)) else ((0.0, 0.0, 0.0), False)
