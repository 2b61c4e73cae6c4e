"""The history of a flight out of its recording: our own, or a `.tlog` of anybody's."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.tlog import TlogPacket
from uavctl.config import Config
from uavctl.data import Datagram, PositionSample, Record, Setpoint, StepInput
from uavctl.errors import RecordingError
from uavctl.identify.history import Asked, Seen, seen_from
from uavctl.loop import MOCAP, make_links
from uavctl.mavlink.framing import scan

_NO_POSITION_NO_VELOCITY = 0x03F  # bits of type_mask: ignored
_MASK = 0x3FF  # of position, velocity, acceleration, and of acceleration as a force; whatever yaw does
_LOCAL_NED = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_OFFSET_NED)

_AUTOPILOTS = {mavlink.MAV_AUTOPILOT_PX4: "px4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot"}
_SHORTEST = 10  # bytes of the longer head
_REMEMBERED = 64  # messages among which the newest is looked for: one may be overtaken by others

Row = tuple[float, float, tuple[float, float, float]]


@dataclass(frozen=True, eq=False)
class History:
    """What a flight asked for and saw; times count from its first position [s].

    Attributes:
        asked: Setpoints.
        seen: Positions.
        gaps: Messages lost after each one that came from the positions' sender, by the numbers that MAVLink gives them.
        autopilot: Whose software flew, "px4" or "ardupilot"; empty where nobody said so.
        parameters: The vehicle's own that begin with PSC_, by name, as far as they were asked for.
    """

    asked: Asked
    seen: Seen
    gaps: NDArray[np.int64]
    autopilot: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)


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


class Numbers:
    """Numbers of the messages of each sender, modulo 256 as they come, told apart by their order."""

    def __init__(self, messages: Iterable[str]) -> None:
        self._ids = {getattr(mavlink, f"MAVLINK_MSG_ID_{name}") for name in messages}
        self._numbers: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
        self._positions: Counter[tuple[int, int]] = Counter()

    def take(self, data: bytes) -> None:
        """Count what a datagram, or a packet, holds: messages of unknown ids too, by their lengths."""
        for number, sender, message_id in _heads(data):
            known = self._numbers[sender]
            newest = max(known[-_REMEMBERED:], default=number)
            known.append(newest + (number - newest + 128) % 256 - 128)
            self._positions[sender] += message_id in self._ids

    def gaps(self) -> NDArray[np.int64]:
        """Messages lost after each one, of who sent most positions."""
        ((sender, _),) = self._positions.most_common(1) or [((0, 0), 0)]
        numbers = sorted(set(self._numbers[sender]))
        return np.array([after - before - 1 for before, after in pairwise(numbers)], dtype=np.int64)


def _heads(data: bytes) -> Iterator[tuple[int, tuple[int, int], int]]:
    """Number, sender and id of each frame, one after the other up to the first byte that begins none."""
    at = 0
    while at + _SHORTEST <= len(data):
        if data[at] == mavlink.PROTOCOL_MARKER_V2:
            signature = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN if data[at + 2] & mavlink.MAVLINK_IFLAG_SIGNED else 0
            yield data[at + 4], (data[at + 5], data[at + 6]), int.from_bytes(data[at + 7 : at + 10], "little")
            at += 12 + data[at + 1] + signature
        elif data[at] == mavlink.PROTOCOL_MARKER_V1:
            yield data[at + 2], (data[at + 3], data[at + 4]), data[at + 5]
            at += 8 + data[at + 1]
        else:
            return


def from_records(records: Iterable[tuple[str, int, Record]], config: Config) -> History:
    """Out of a recording of ours, with its configuration.

    Raises:
        RecordingError: No position or no setpoint in it.
    """
    samples: list[PositionSample] = []
    sent: list[tuple[int, tuple[float, float, float], bool]] = []
    numbers, told = Numbers(config.source.messages), VehicleWords()
    flown = False
    for _, _, record in records:
        if isinstance(record, Datagram) and not record.outgoing:
            numbers.take(record.data)
            told.take(record.data)
        elif isinstance(record, StepInput):
            samples.extend(record.samples)
            flown = record.vehicle is not None and record.vehicle.armed and record.vehicle.external
        elif isinstance(record, Setpoint):
            sent.append((record.at_ns, record.accel_mps2, flown))
    return _history(sent, samples, numbers, told)


def from_tlog(packets: Iterable[TlogPacket], config: Config) -> History:
    """Out of a `.tlog`: positions as the daemon would take them, acceleration setpoints as they were sent.

    Args:
        packets: In file order.
        config: Says which messages count as positions, and how their frame and clock are turned into ours.

    Raises:
        RecordingError: No position or no acceleration setpoint in it.
    """
    links = make_links(config)
    link = links.get(MOCAP) or next(iter(links.values()))
    samples: list[PositionSample] = []
    sent: list[tuple[int, tuple[float, float, float], bool]] = []
    numbers, told = Numbers(config.source.messages), VehicleWords()
    for packet in packets:
        if packet.outgoing:
            sent.extend((packet.at_ns, accel, alone) for accel, alone in _accelerations(packet.data))
        else:
            numbers.take(packet.data)
            told.take(packet.data)
            samples.extend(item for item in link.receive(packet.data, packet.at_ns) if isinstance(item, PositionSample))
    return _history(sent, samples, numbers, told)


def _history(
    sent: list[tuple[int, tuple[float, float, float], bool]],
    samples: list[PositionSample],
    numbers: Numbers,
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
    return History(asked, seen_from(rows), numbers.gaps(), told.autopilot, told.parameters)


def _accelerations(data: bytes) -> Iterable[tuple[tuple[float, float, float], bool]]:
    """Setpoints in a client's packet, and whether each asks for an acceleration and nothing else."""
    parser = mavlink.MAVLink(None)
    for frame in scan(data, final=True).frames:
        if frame.message_id == mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED:
            message = parser.decode(bytearray(frame.data))
            alone = message.type_mask & _MASK == _NO_POSITION_NO_VELOCITY and message.coordinate_frame in _LOCAL_NED
            accel = (message.afx, message.afy, message.afz)
            yield (accel, True) if alone and all(map(math.isfinite, accel)) else ((0.0, 0.0, 0.0), False)
