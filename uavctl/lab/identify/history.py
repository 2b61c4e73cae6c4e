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
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.errors import RecordingError
from uavctl.loop import MOCAP, make_links
from uavctl.mavlink.clocksync import ClockSource
from uavctl.mavlink.framing import scan_frames
from uavctl.mavlink.profile import PROFILES, find_autopilot_name
from uavctl.records import Datagram, PositionSample, Record, Setpoint, StepInput

_OPEN = 64  # requests whose answers are still taken
Address = tuple[int, int]


class RoundTrip(NamedTuple):
    """Answer to a client's request: who gave it, when the request was sent [ns], the time in the answer [ns]."""

    address: Address
    sent_ns: int
    remote_ns: int


class Exchange:
    """Pairs a client's requests with their answers, by the client's stamp that both carry.

    Times are the recorder's, so those of the client's clock do not matter.
    """

    def __init__(self) -> None:
        self._sent: OrderedDict[int, int] = OrderedDict()  # by the client's stamp
        self._parser = mavlink.MAVLink(None)

    def take(self, data: bytes, at_ns: int, *, outgoing: bool) -> Iterator[RoundTrip]:
        """Take a packet; return the round trip that it completes, if any."""
        for frame in scan_frames(data, final=True).frames:
            if frame.message_id != mavlink.MAVLINK_MSG_ID_TIMESYNC:
                continue
            message = self._parser.decode(bytearray(frame.data))
            if outgoing and message.tc1 == 0:
                self._sent[message.ts1] = at_ns
                if len(self._sent) > _OPEN:
                    self._sent.popitem(last=False)
            elif not outgoing and message.tc1 != 0 and message.ts1 in self._sent:
                address = message.get_srcSystem(), message.get_srcComponent()
                yield RoundTrip(address, self._sent[message.ts1], message.tc1)


LONGEST_PAUSE_S = 0.5  # without a setpoint for longer than this, the vehicle does as it likes
SHORTEST_S = 5.0  # a stretch says nothing of drag below this
LEAST_SAMPLES = 20
_NEIGHBOURS = 5
_JUMP_M, _JUMP = 0.3, 8.0  # a position this far from its neighbours is none, nor at so many times the usual distance


@dataclass(frozen=True, eq=False)
class SetpointHistory:
    """Setpoints in the order in which they were sent."""

    times_s: Array  # (n,) [s]
    accel_mps2: Array  # (n, 3), north, east, down [m/s²]
    flown: NDArray[np.bool_]  # (n,), whether the vehicle took setpoints then


@dataclass(frozen=True, eq=False)
class PositionHistory:
    """Positions in the order of their capture."""

    times_s: Array  # (m,), of capture, increasing [s]
    delays_s: Array  # (m,), from capture to arrival [s]
    positions_m: Array  # (m, 3), local NED [m]


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a flight in which setpoints streamed and the vehicle took them."""

    input_times_s: Array  # (n,), when the setpoint changed [s]; the first is the begin
    inputs_mps2: Array  # (n, 3), the setpoint from then on [m/s²]
    times_s: Array  # (m,), of capture [s]
    positions_m: Array  # (m, 3) [m]
    counted: NDArray[np.bool_] | None = None  # (m,), whether a position counts when parameters are fitted; None is all

    @property
    def length_s(self) -> float:
        """Time from the first to the last position [s]."""
        return float(self.times_s[-1] - self.times_s[0])


def stretches(asked: SetpointHistory, seen: PositionHistory) -> tuple[Stretch, ...]:
    """Return the parts of a flight that show how the vehicle responds.

    Raises:
        RecordingError: There is none that is long enough; says what is missing.
    """
    found = tuple(
        stretch
        for stretch in _all(asked, seen)
        if len(stretch.times_s) >= LEAST_SAMPLES and stretch.length_s >= SHORTEST_S
    )
    if not found:
        flown_s = sum(end - begin for begin, end in _spans(asked))
        raise RecordingError(
            f"setpoints were flown for {flown_s:.1f} s, and {len(seen.times_s)} positions are there: no stretch of at "
            f"least {SHORTEST_S:g} s with {LEAST_SAMPLES} positions. Fly some waypoints under setpoints, with positions"
        )
    return found


def thinned(stretch: Stretch, spacing_s: float) -> Stretch:
    """Return a stretch with positions thinned to at least `spacing_s` apart, the controller's own step."""
    kept, last_s = [], -np.inf
    for index, at_s in enumerate(stretch.times_s):
        if at_s - last_s >= spacing_s:
            kept.append(index)
            last_s = at_s
    return replace(stretch, times_s=stretch.times_s[kept], positions_m=stretch.positions_m[kept])


def seen_from(rows: Sequence[tuple[float, float, tuple[float, float, float]]]) -> PositionHistory:
    """Sort positions (capture [s], arrival [s], position [m]) by capture; drop repeated and implausible ones."""
    captured = np.array([row[0] for row in rows])
    _, first = np.unique(captured, return_index=True)
    arrived = np.array([row[1] for row in rows])
    positions = np.array([row[2] for row in rows], dtype=np.float64).reshape(-1, 3)[first]
    good = _plausible(positions)
    return PositionHistory(captured[first][good], (arrived - captured)[first][good], positions[good])


def _plausible(positions_m: Array) -> NDArray[np.bool_]:
    """Return whether each position (m, 3) is near its neighbours' median, unlike swapped bodies and reflections."""
    if len(positions_m) < _NEIGHBOURS:
        return np.ones(len(positions_m), dtype=np.bool_)
    half = _NEIGHBOURS // 2
    padded = np.pad(positions_m, ((half, half), (0, 0)), mode="edge")
    medians = np.median(np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS, axis=0), axis=-1)
    off_m = np.linalg.norm(positions_m - medians, axis=1)
    return np.asarray(off_m <= max(_JUMP_M, _JUMP * float(np.median(off_m))))


def _spans(asked: SetpointHistory) -> Iterator[tuple[float, float]]:
    """Return begin and end of each run of setpoints that were flown without a pause [s]."""
    begin: float | None = None
    for now, then in pairwise(range(len(asked.times_s))):
        if begin is None and asked.flown[now]:
            begin = float(asked.times_s[now])
        gap_s = asked.times_s[then] - asked.times_s[now]
        if begin is not None and (not asked.flown[then] or gap_s > LONGEST_PAUSE_S):
            yield begin, float(asked.times_s[now])
            begin = None
    if begin is not None:
        yield begin, float(asked.times_s[-1])


def _all(asked: SetpointHistory, seen: PositionHistory) -> Iterator[Stretch]:
    for begin, end in _spans(asked):
        within = (asked.times_s >= begin) & (asked.times_s <= end)
        times_s, accel = asked.times_s[within], asked.accel_mps2[within]
        changed = np.concatenate([[True], np.any(np.diff(accel, axis=0) != 0.0, axis=1)])
        held = (seen.times_s > begin) & (seen.times_s <= end)
        yield Stretch(times_s[changed], accel[changed], seen.times_s[held], seen.positions_m[held])


_NO_POSITION_NO_VELOCITY = 0x03F  # bits of type_mask: ignored
_MASK = 0x3FF  # of position, velocity, acceleration, and of acceleration as a force; whatever yaw does
_LOCAL_NED = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_OFFSET_NED)

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

Row = tuple[float, float, tuple[float, float, float]]


@dataclass(frozen=True, eq=False)
class FlightHistory:
    """Setpoints, positions and losses of a flight; times count from its first position [s]."""

    asked: SetpointHistory  # setpoints
    seen: PositionHistory  # positions
    gaps: NDArray[np.int64]  # messages lost after each one that came from the positions' sender
    autopilot: str = ""  # whose software flew, "px4" or "ardupilot"; empty where nobody said so
    # The vehicle's own that begin with PSC_, by name, as far as they were asked for
    parameters: Mapping[str, float] = field(default_factory=dict)
    # The shortest delay from capture to arrival [s], where the stamps tell it; else None
    latency_s: float | None = None


class VehicleWords:
    """What the vehicle says of itself: its autopilot, and its parameters of the position loops."""

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
        for head in _heads(data):
            known = self._numbers[head.sender]
            newest = max(known[-_REMEMBERED:], default=head.number)
            known.append(newest + (head.number - newest + 128) % 256 - 128)
            if head.message_id in _STAMPED:
                self._stamps[head.sender].append((int.from_bytes(head.payload[:8], "little"), at_ns))

    def gaps(self, sender: Address) -> NDArray[np.int64]:
        """Return how many messages of a sender were lost after each one: by regular stamps, else by sequence numbers.

        A bridge numbers what it sends, and tells nothing of what was lost on the way to it.
        """
        stamps = np.unique([stamp for stamp, _ in self._stamps.get(sender, ())])
        by_times = _missing_of(np.diff(stamps))
        if by_times is not None:
            return by_times
        numbers = sorted(set(self._numbers[sender]))
        return np.array([after - before - 1 for before, after in pairwise(numbers)], dtype=np.int64)

    def shortest_delay_s(self, sender: Address) -> float | None:
        """Return the least time from a stamp to its arrival [s], if both are of one clock; else None."""
        delays_s = [1e-9 * (at_ns - 1000 * stamp) for stamp, at_ns in self._stamps.get(sender, ())]
        return min(delays_s) if delays_s and 0.0 <= min(delays_s) <= _SHORT_S else None


def _missing_of(spacings: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return how many frames a regular camera's stamps lack between each two; None if it is not regular."""
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
    """Head of a frame, with its payload."""

    number: int
    sender: Address
    message_id: int
    payload: bytes


def _heads(data: bytes) -> Iterator[_Head]:
    """Yield the head of each frame, up to the first byte that begins none."""
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


def from_records(records: Iterable[tuple[str, int, Record]]) -> FlightHistory:
    """Make the history of one of our recordings.

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


def from_tlog(packets: Iterable[TlogPacket], config: Config) -> FlightHistory:
    """Make the history of a `.tlog`: positions as the daemon would take them, setpoints as they were sent.

    Args:
        config: Says which messages count as positions, how their frame and clock are turned into ours, and whose
            setpoints they are (`daemon.vehicle_system_id`; 0: any vehicle's).

    Raises:
        RecordingError: No position or no acceleration setpoint in it.
    """
    whole, system = tuple(packets), config.daemon.vehicle_system_id
    sent: list[tuple[int, tuple[float, float, float], bool]] = []
    senders, told = Senders(), VehicleWords()
    for packet in whole:
        if packet.outgoing:
            sent.extend((packet.at_ns, accel, alone) for accel, alone in _accelerations(packet.data, system))
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
    """Return positions as the daemon would take them, and those with a clock known by the client's own exchange.

    A source that answers nothing may stamp by the vehicle's clock: its answers are tried for such stamps too.
    """
    links = make_links(config)
    link = links.get(MOCAP) or next(iter(links.values()))
    exchange, senders = Exchange(), {head.sender for one in packets if not one.outgoing for head in _heads(one.data)}
    found, answered = [], []
    for one in packets:
        for trip in exchange.take(one.data, one.at_ns, outgoing=one.outgoing):
            for address in senders:
                link.add_timesync_answer(address, trip.sent_ns, trip.remote_ns, one.at_ns)
        if one.outgoing:
            continue
        understood = link.receive(one.data, one.at_ns)
        for item in understood.items:
            if isinstance(item, PositionSample):
                found.append(item)
                if understood.clock_source is ClockSource.TIMESYNC:
                    answered.append(item)
    return found, answered


def _source(samples: Iterable[PositionSample]) -> Address:
    """Return system and component that sent most of the accepted positions."""
    ((source, _),) = Counter(one.source for one in samples).most_common(1)
    system, component = source.rsplit(" ", 1)[-1].split("/")
    return int(system), int(component)


def _history(
    sent: list[tuple[int, tuple[float, float, float], bool]],
    samples: list[PositionSample],
    senders: Senders,
    told: VehicleWords,
) -> FlightHistory:
    if not samples or not sent:
        missing = "no position" if not samples else "no acceleration setpoint"
        raise RecordingError(f"the recording has {missing}: there is nothing to identify a vehicle from")
    origin_ns = min(sample.captured_ns for sample in samples)
    rows: list[Row] = [
        ((one.captured_ns - origin_ns) * 1e-9, (one.received_ns - origin_ns) * 1e-9, one.position_m)
        for one in samples
        if all(map(math.isfinite, one.position_m))
    ]
    asked = SetpointHistory(
        times_s=np.array([(at_ns - origin_ns) * 1e-9 for at_ns, _, _ in sent]),
        accel_mps2=np.array([accel for _, accel, _ in sent]),
        flown=np.array([flown for _, _, flown in sent]),
    )
    return FlightHistory(asked, seen_from(rows), senders.gaps(_source(samples)), told.autopilot, told.parameters)


def _accelerations(data: bytes, system: int) -> Iterable[tuple[tuple[float, float, float], bool]]:
    """Return the setpoints for a system in a client's packet, with whether each asks for an acceleration only."""
    parser = mavlink.MAVLink(None)
    for frame in scan_frames(data, final=True).frames:
        if frame.message_id == mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED:
            message = parser.decode(bytearray(frame.data))
            if system and message.target_system not in (0, system):
                continue
            alone = message.type_mask & _MASK == _NO_POSITION_NO_VELOCITY and message.coordinate_frame in _LOCAL_NED
            accel = (message.afx, message.afy, message.afz)
            yield (accel, True) if alone and all(map(math.isfinite, accel)) else ((0.0, 0.0, 0.0), False)
