"""Flight history for identification, from recordings: setpoints, positions, messages and their senders.

A history is read from our recordings or from any `.tlog`. The TIMESYNC exchange of a recorded client gives the
vehicle's clock although no client asks any more.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from logs.recording.tlog import TlogPacket
from uavctl.arrays import Array, Flags
from uavctl.config import Config
from uavctl.errors import RecordingError
from uavctl.mavlink.clocksync import ClockSource
from uavctl.mavlink.connection import MOCAP, make_links
from uavctl.mavlink.framing import scan_frames
from uavctl.mavlink.profile import PROFILES, find_autopilot_name
from uavctl.records import Datagram, PositionSample, Record, Setpoint, StepInput

_MAX_OPEN_REQUESTS = 64  # older requests are dropped
Address = tuple[int, int]


class TimesyncAnswer(NamedTuple):
    """Answer to a client's request: its sender, when the request was sent [ns], the time in the answer [ns]."""

    address: Address
    sent_ns: int
    remote_ns: int


class TimesyncExchange:
    """Pairs a client's requests with their answers, by the client's stamp that both carry.

    Times are the recorder's, so those of the client's clock do not matter.
    """

    def __init__(self) -> None:
        self._sent: OrderedDict[int, int] = OrderedDict()  # by the client's stamp
        self._parser = mavlink.MAVLink(None)

    def take(self, data: bytes, at_ns: int, *, outgoing: bool) -> Iterator[TimesyncAnswer]:
        """Take a packet; yield the answer in it, if it has one."""
        for frame in scan_frames(data, final=True).frames:
            if frame.message_id != mavlink.MAVLINK_MSG_ID_TIMESYNC:
                continue
            message = self._parser.decode(bytearray(frame.data))
            if outgoing and message.tc1 == 0:
                self._sent[message.ts1] = at_ns
                if len(self._sent) > _MAX_OPEN_REQUESTS:
                    self._sent.popitem(last=False)
            elif not outgoing and message.tc1 != 0 and message.ts1 in self._sent:
                address = message.get_srcSystem(), message.get_srcComponent()
                yield TimesyncAnswer(address, self._sent[message.ts1], message.tc1)


MAX_PAUSE_S = 0.5  # without a setpoint for longer, the vehicle leaves its external mode
MIN_STRETCH_S = 5.0  # a shorter stretch does not show drag
MIN_SAMPLES = 20
_NEIGHBOURS = 5
_MIN_JUMP_M, _JUMP_FACTOR = (0.3, 8.0)  # from the neighbours' median; farther is an error of the cameras


@dataclass(frozen=True, eq=False)
class SetpointHistory:
    """Setpoints in the order in which they were sent."""

    times_s: Array  # (n,) [s]
    accel_mps2: Array  # (n, 3), north, east, down [m/s²]
    is_flown: Flags  # (n,), whether the vehicle took setpoints then


@dataclass(frozen=True, eq=False)
class PositionHistory:
    """Positions in the order of their capture."""

    times_s: Array  # (m,), of capture, increasing [s]
    delays_s: Array  # (m,), from capture to arrival [s]
    positions_m: Array  # (m, 3), local NED [m]


@dataclass(frozen=True, eq=False)
class Stretch:
    """Part of a flight in which setpoints streamed and the vehicle used them."""

    input_times_s: Array  # (n,), when the setpoint changed [s]; the first is the start
    inputs_mps2: Array  # (n, 3), the setpoint from then on [m/s²]
    times_s: Array  # (m,), of capture [s]
    positions_m: Array  # (m, 3) [m]
    # (m,), whether a position counts when parameters are fitted; None is all
    counts_for_fit: Flags | None = None

    @property
    def length_s(self) -> float:
        """Time from the first to the last position [s]."""
        return float(self.times_s[-1] - self.times_s[0])


def find_stretches(setpoints: SetpointHistory, positions: PositionHistory) -> tuple[Stretch, ...]:
    """Return the parts of a flight that show how the vehicle responds.

    Raises:
        RecordingError: No part is long enough.
    """
    long_enough = tuple(
        stretch
        for stretch in _cut_stretches(setpoints, positions)
        if len(stretch.times_s) >= MIN_SAMPLES and stretch.length_s >= MIN_STRETCH_S
    )
    if not long_enough:
        flown_s = sum(end - begin for begin, end in _find_setpoint_spans(setpoints))
        raise RecordingError(
            f"setpoints were flown for {flown_s:.1f} s, and {len(positions.times_s)} positions are there: no stretch "
            f"of at least {MIN_STRETCH_S:g} s with {MIN_SAMPLES} positions. Fly some waypoints under setpoints, with "
            "positions"
        )
    return long_enough


def thin_positions(stretch: Stretch, spacing_s: float) -> Stretch:
    """Return a stretch with positions thinned to at least `spacing_s` apart, the controller's own step."""
    kept_indices, last_s = [], -np.inf
    for index, at_s in enumerate(stretch.times_s):
        if at_s - last_s >= spacing_s:
            kept_indices.append(index)
            last_s = at_s
    return replace(stretch, times_s=stretch.times_s[kept_indices], positions_m=stretch.positions_m[kept_indices])


def make_position_history(rows: Sequence[tuple[float, float, tuple[float, float, float]]]) -> PositionHistory:
    """Sort positions (capture [s], arrival [s], position [m]) by capture; drop repeated and implausible ones."""
    captured_s = np.array([row[0] for row in rows])
    _, first_index = np.unique(captured_s, return_index=True)
    arrived_s = np.array([row[1] for row in rows])
    positions = np.array([row[2] for row in rows], dtype=np.float64).reshape(-1, 3)[first_index]
    is_plausible = _is_plausible(positions)
    return PositionHistory(
        captured_s[first_index][is_plausible],
        (arrived_s - captured_s)[first_index][is_plausible],
        positions[is_plausible],
    )


def _is_plausible(positions_m: Array) -> Flags:
    """Return whether each position (m, 3) is near its neighbours' median, unlike swapped bodies and reflections."""
    if len(positions_m) < _NEIGHBOURS:
        return np.ones(len(positions_m), dtype=np.bool_)
    half = _NEIGHBOURS // 2
    padded = np.pad(positions_m, ((half, half), (0, 0)), mode="edge")
    medians = np.median(np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS, axis=0), axis=-1)
    distances_m = np.linalg.norm(positions_m - medians, axis=1)
    return np.asarray(distances_m <= max(_MIN_JUMP_M, _JUMP_FACTOR * float(np.median(distances_m))))


def _find_setpoint_spans(setpoints: SetpointHistory) -> Iterator[tuple[float, float]]:
    """Return begin and end of each run of setpoints that were flown without a pause [s]."""
    begin: float | None = None
    for index, next_index in pairwise(range(len(setpoints.times_s))):
        if begin is None and setpoints.is_flown[index]:
            begin = float(setpoints.times_s[index])
        gap_s = setpoints.times_s[next_index] - setpoints.times_s[index]
        if begin is not None and (not setpoints.is_flown[next_index] or gap_s > MAX_PAUSE_S):
            yield begin, float(setpoints.times_s[index])
            begin = None
    if begin is not None:
        yield begin, float(setpoints.times_s[-1])


def _cut_stretches(setpoints: SetpointHistory, positions: PositionHistory) -> Iterator[Stretch]:
    for begin, end in _find_setpoint_spans(setpoints):
        in_span = (setpoints.times_s >= begin) & (setpoints.times_s <= end)
        times_s, accel = setpoints.times_s[in_span], setpoints.accel_mps2[in_span]
        is_changed = np.concatenate([[True], np.any(np.diff(accel, axis=0) != 0.0, axis=1)])
        positions_in_span = (positions.times_s > begin) & (positions.times_s <= end)
        yield Stretch(
            times_s[is_changed],
            accel[is_changed],
            positions.times_s[positions_in_span],
            positions.positions_m[positions_in_span],
        )


_ACCELERATION_ONLY = 0x03F  # bits of type_mask: position and velocity are ignored
_TYPE_MASK = 0x3FF  # bits of position, velocity, acceleration and force; those of yaw do not matter
_LOCAL_NED = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_OFFSET_NED)

_MIN_HEADER_BYTES = 10  # of the longer header
_STAMPED_MESSAGES = {  # positions that begin with their time [µs]
    mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
    mavlink.MAVLINK_MSG_ID_VICON_POSITION_ESTIMATE,
    mavlink.MAVLINK_MSG_ID_ATT_POS_MOCAP,
    mavlink.MAVLINK_MSG_ID_ODOMETRY,
}
_MAX_DELAY_S = 0.1  # unrelated clocks differ by more than this
_PERIOD_QUANTILE = 0.2  # at least this share of spacings is without a loss
_REGULAR_TOLERANCE, _MIN_REGULAR_SHARE = (
    0.25,
    0.9,
)  # of a period, and the least share of spacings so near to a multiple of it
_REORDER_WINDOW = 64  # messages may arrive in another order within so many

PositionRow = tuple[float, float, tuple[float, float, float]]


@dataclass(frozen=True, eq=False)
class FlightHistory:
    """Setpoints, positions and losses of a flight; times count from its first position [s]."""

    setpoints: SetpointHistory  # setpoints
    positions: PositionHistory  # positions
    losses: NDArray[np.int64]  # messages lost after each one that came from the positions' sender
    autopilot: str = ""  # "px4" or "ardupilot"; empty where no heartbeat reported it
    # Reported parameters of the vehicle that begin with PSC_, by name
    parameters: Mapping[str, float] = field(default_factory=dict)
    # The shortest delay from capture to arrival [s], where the stamps show it; else None
    latency_s: float | None = None


class VehicleReports:
    """Reports of the vehicle about itself: its autopilot, and its parameters of the position loops."""

    def __init__(self) -> None:
        self.autopilot = ""
        self.parameters: dict[str, float] = {}
        self._parser = mavlink.MAVLink(None)

    def take(self, data: bytes) -> None:
        """Read the messages of a datagram or packet."""
        for frame in scan_frames(data, final=True).frames:
            if frame.message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                name = find_autopilot_name(self._parser.decode(bytearray(frame.data)).autopilot)
                self.autopilot = name if name in PROFILES else self.autopilot
            elif frame.message_id == mavlink.MAVLINK_MSG_ID_PARAM_VALUE:
                message = self._parser.decode(bytearray(frame.data))
                if message.param_id.startswith("PSC_") and math.isfinite(message.param_value):
                    self.parameters[message.param_id] = float(message.param_value)


class Senders:
    """Senders of messages: the sequence number of each message, and the stamps of their positions."""

    def __init__(self) -> None:
        self._numbers: defaultdict[Address, list[int]] = defaultdict(list)
        self._stamps: defaultdict[Address, list[tuple[int, int]]] = defaultdict(list)

    def take(self, data: bytes, at_ns: int) -> None:
        """Count the messages of a datagram or packet, those of unknown ids too, by their lengths."""
        for header in _read_headers(data):
            numbers_before = self._numbers[header.sender]
            newest = max(numbers_before[-_REORDER_WINDOW:], default=header.number)
            numbers_before.append(newest + (header.number - newest + 128) % 256 - 128)
            if header.message_id in _STAMPED_MESSAGES:
                self._stamps[header.sender].append((int.from_bytes(header.payload[:8], "little"), at_ns))

    def count_losses(self, sender: Address) -> NDArray[np.int64]:
        """Return the number of lost messages after each one of a sender: by regular stamps, else by sequence numbers.

        A bridge numbers its own messages, so its numbers do not show earlier losses.
        """
        stamps = np.unique([stamp for stamp, _ in self._stamps.get(sender, ())])
        losses_by_stamps = _count_missing_frames(np.diff(stamps))
        if losses_by_stamps is not None:
            return losses_by_stamps
        numbers = sorted(set(self._numbers[sender]))
        return np.array([after - before - 1 for before, after in pairwise(numbers)], dtype=np.int64)

    def estimate_min_delay_s(self, sender: Address) -> float | None:
        """Return the least time from a stamp to its arrival [s], if both use the same clock; else None."""
        delays_s = [1e-9 * (at_ns - 1000 * stamp) for stamp, at_ns in self._stamps.get(sender, ())]
        return min(delays_s) if delays_s and 0.0 <= min(delays_s) <= _MAX_DELAY_S else None


def _count_missing_frames(spacings: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return the number of missing frames between stamps of a regular camera; None if it is not regular."""
    if len(spacings) < MIN_SAMPLES:
        return None
    period = float(np.quantile(spacings, _PERIOD_QUANTILE))
    for max_frames in (2.0, 4.0, 16.0):  # a better known period lets longer gaps refine it
        short_spacings = spacings[(spacings > 0.5 * period) & (spacings < (max_frames + 0.5) * period)]
        period = float(short_spacings.sum() / np.rint(short_spacings / period).sum())
    frames = spacings / period
    offsets = np.abs(frames - np.rint(frames))[frames < 16.5]
    if np.mean(offsets < _REGULAR_TOLERANCE) < _MIN_REGULAR_SHARE:
        return None
    return np.maximum(np.rint(frames).astype(np.int64) - 1, 0)


class _FrameHeader(NamedTuple):
    """Header of a frame, with its payload."""

    number: int
    sender: Address
    message_id: int
    payload: bytes


def _read_headers(data: bytes) -> Iterator[_FrameHeader]:
    """Yield the header of each frame, up to the first byte that begins no frame."""
    position = 0
    while position + _MIN_HEADER_BYTES <= len(data):
        length = data[position + 1]
        if data[position] == mavlink.PROTOCOL_MARKER_V2:
            signature = mavlink.MAVLINK_SIGNATURE_BLOCK_LEN if data[position + 2] & mavlink.MAVLINK_IFLAG_SIGNED else 0
            sender, message_id = (
                (data[position + 5], data[position + 6]),
                int.from_bytes(data[position + 7 : position + 10], "little"),
            )
            yield _FrameHeader(data[position + 4], sender, message_id, data[position + 10 : position + 10 + length])
            position += 12 + length + signature
        elif data[position] == mavlink.PROTOCOL_MARKER_V1:
            yield _FrameHeader(
                data[position + 2],
                (data[position + 3], data[position + 4]),
                data[position + 5],
                data[position + 6 : position + 6 + length],
            )
            position += 8 + length
        else:
            return


def read_recorded_history(records: Iterable[tuple[str, int, Record]]) -> FlightHistory:
    """Make the history of one of our recordings.

    Raises:
        RecordingError: No position or no setpoint in it.
    """
    samples: list[PositionSample] = []
    sent: list[tuple[int, tuple[float, float, float], bool]] = []
    senders, reports = Senders(), VehicleReports()
    takes_setpoints = False
    for _, at_ns, record in records:
        if isinstance(record, Datagram) and not record.outgoing:
            senders.take(record.data, at_ns)
            reports.take(record.data)
        elif isinstance(record, StepInput):
            samples.extend(record.samples)
            takes_setpoints = record.vehicle is not None and record.vehicle.armed and record.vehicle.external
        elif isinstance(record, Setpoint):
            sent.append((record.at_ns, record.accel_mps2, takes_setpoints))
    return _make_history(sent, samples, senders, reports)


def read_tlog_history(packets: Iterable[TlogPacket], config: Config) -> FlightHistory:
    """Make the history of a `.tlog`: positions as the daemon would take them, setpoints as they were sent.

    Args:
        config: Configuration of the messages that count as positions, of their frame and clock, and of the vehicle that
            the setpoints are for (`daemon.vehicle_system_id`; 0: any vehicle).

    Raises:
        RecordingError: No position or no acceleration setpoint in it.
    """
    all_packets, system_id = tuple(packets), config.daemon.vehicle_system_id
    sent: list[tuple[int, tuple[float, float, float], bool]] = []
    senders, reports = Senders(), VehicleReports()
    for packet in all_packets:
        if packet.outgoing:
            sent.extend(
                (packet.at_ns, accel, is_accel_only)
                for accel, is_accel_only in _read_accelerations(packet.data, system_id)
            )
        else:
            senders.take(packet.data, packet.at_ns)
            reports.take(packet.data)
    samples, answered = _collect_samples(all_packets, config)
    latency_s = senders.estimate_min_delay_s(_find_source(samples)) if samples else None
    if latency_s is not None:
        clock = msgspec.structs.replace(config.clock, latency_s=round(latency_s, 4))
        samples, _ = _collect_samples(all_packets, msgspec.structs.replace(config, clock=clock))
    elif answered:
        latency_s = max(0.0, min(1e-9 * (sample.received_ns - sample.captured_ns) for sample in answered))
        # Before the first answer the stamps alone count, and the delay of those positions is unknown.
        samples = answered if len(answered) > len(samples) // 2 else samples
    return replace(_make_history(sent, samples, senders, reports), latency_s=latency_s)


def _collect_samples(
    packets: Sequence[TlogPacket], config: Config
) -> tuple[list[PositionSample], list[PositionSample]]:
    """Return positions as the daemon would take them, and those with a clock known from the client's own exchange.

    A source that does not answer may stamp by the vehicle's clock, so the vehicle's answers are tried for it too.
    """
    links = make_links(config)
    link = links.get(MOCAP) or next(iter(links.values()))
    exchange, senders = (
        TimesyncExchange(),
        {header.sender for packet in packets if not packet.outgoing for header in _read_headers(packet.data)},
    )
    samples, answered_samples = [], []
    for packet in packets:
        for trip in exchange.take(packet.data, packet.at_ns, outgoing=packet.outgoing):
            for address in senders:
                link.add_timesync_answer(address, trip.sent_ns, trip.remote_ns, packet.at_ns)
        if packet.outgoing:
            continue
        received = link.receive(packet.data, packet.at_ns)
        for sample in received.items:
            if isinstance(sample, PositionSample):
                samples.append(sample)
                if received.clock_source is ClockSource.TIMESYNC:
                    answered_samples.append(sample)
    return samples, answered_samples


def _find_source(samples: Iterable[PositionSample]) -> Address:
    """Return system and component that sent most of the accepted positions."""
    ((source, _),) = Counter(sample.source for sample in samples).most_common(1)
    system, component = source.rsplit(" ", 1)[-1].split("/")
    return int(system), int(component)


def _make_history(
    sent: list[tuple[int, tuple[float, float, float], bool]],
    samples: list[PositionSample],
    senders: Senders,
    reports: VehicleReports,
) -> FlightHistory:
    if not samples or not sent:
        missing = "no position" if not samples else "no acceleration setpoint"
        raise RecordingError(f"the recording has {missing}: there is nothing to identify a vehicle from")
    origin_ns = min(sample.captured_ns for sample in samples)
    rows: list[PositionRow] = [
        ((sample.captured_ns - origin_ns) * 1e-9, (sample.received_ns - origin_ns) * 1e-9, sample.position_m)
        for sample in samples
        if all(map(math.isfinite, sample.position_m))
    ]
    setpoints = SetpointHistory(
        times_s=np.array([(at_ns - origin_ns) * 1e-9 for at_ns, _, _ in sent]),
        accel_mps2=np.array([accel for _, accel, _ in sent]),
        is_flown=np.array([is_flown for _, _, is_flown in sent]),
    )
    return FlightHistory(
        setpoints,
        make_position_history(rows),
        senders.count_losses(_find_source(samples)),
        reports.autopilot,
        reports.parameters,
    )


def _read_accelerations(data: bytes, system_id: int) -> Iterable[tuple[tuple[float, float, float], bool]]:
    """Return the setpoints for a system in a client's packet, with whether each asks for an acceleration only."""
    parser = mavlink.MAVLink(None)
    for frame in scan_frames(data, final=True).frames:
        if frame.message_id == mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED:
            message = parser.decode(bytearray(frame.data))
            if system_id and message.target_system not in (0, system_id):
                continue
            is_accel_only = (
                message.type_mask & _TYPE_MASK == _ACCELERATION_ONLY and message.coordinate_frame in _LOCAL_NED
            )
            accel = (message.afx, message.afy, message.afz)
            yield (accel, True) if is_accel_only and all(map(math.isfinite, accel)) else ((0.0, 0.0, 0.0), False)
