"""One connection's MAVLink state, without input or output of its own: bytes in, events out, and back."""

from __future__ import annotations

from collections import Counter, deque

from uavctl.config.peers import ClockConfig, DaemonConfig, FrameConfig, SourceConfig
from uavctl.config.types import EstimatorConfig
from uavctl.data import Event, LinkStats, PositionSample, Setpoint, Severity, VehicleStatus
from uavctl.mavlink.codec import OWN_ESTIMATE, StreamDecoder, decode
from uavctl.mavlink.encoder import Encoder, UnsendableError
from uavctl.mavlink.framing import BadBytes
from uavctl.mavlink.intake import PositionIntake
from uavctl.mavlink.messages import Message, Position, TimeSync
from uavctl.mavlink.vehicle import SECOND_VEHICLE, VehicleWatch

VEHICLE, MOCAP = "vehicle", "mocap"
SECOND_NS = 1_000_000_000
HEARTBEAT_NS = SECOND_NS
# A little off one second, so that requests do not always wait behind the same step's solve.
TIMESYNC_NS = 950_000_000
FIRST_TIMESYNC_NS = 200_000_000
FIRST_REQUESTS = 10  # sent faster, until the first answer
OPEN_REQUESTS = 8  # requests whose answers are still taken
MAX_ANSWERS = 8  # answers to others' requests that wait for the next tick
STREAM_SCHEMES = ("tcp:", "serial:")
_USUAL = frozenset({BadBytes.UNKNOWN, OWN_ESTIMATE})  # counted, not told: every flight has them

Item = PositionSample | VehicleStatus | Event


class Link:
    """MAVLink on one connection.

    Args:
        name: the connection's name in records.
        roles: `vehicle` (heartbeats, status, setpoints), `mocap` (positions), or both.
        daemon: our ids; the connection's URL tells a byte stream from datagrams.
        frame: camera frame to local NED.
        clock: the sources' clocks.
        source: which messages and which system count as positions.
        estimator: standard deviation of a position, and what is absurd.
    """

    def __init__(
        self,
        name: str,
        *,
        roles: frozenset[str],
        daemon: DaemonConfig,
        frame: FrameConfig,
        clock: ClockConfig,
        source: SourceConfig,
        estimator: EstimatorConfig,
    ) -> None:
        self._name, self._roles = name, roles
        self._own = (daemon.system_id, daemon.component_id)
        url = daemon.vehicle if VEHICLE in roles else daemon.mocap
        self._stream = StreamDecoder() if url.startswith(STREAM_SCHEMES) else None
        self._encoder = Encoder(*self._own)
        self._intake = PositionIntake(frame, clock, source, estimator, self._count)
        self._vehicle = VehicleWatch(self._count)
        self._bad: Counter[str] = Counter()
        self._untold: Counter[str] = Counter()
        self._told_ns: int | None = None
        self._resyncs_told = 0
        self._datagrams = self._messages = 0
        self._heartbeat_ns: int | None = None
        self._request_ns: int | None = None
        self._requests = 0
        self._open: deque[int] = deque(maxlen=OPEN_REQUESTS)
        self._answered = False
        self._answers: deque[tuple[int, int]] = deque(maxlen=MAX_ANSWERS)  # (tc1, ts1)

    def receive(self, data: bytes, at_ns: int) -> tuple[Item, ...]:
        """Take one datagram, or one chunk of a stream, that arrived at `at_ns`; never raises."""
        decoded = decode(data) if self._stream is None else self._stream.push(data)
        self._datagrams += 1
        self._messages += decoded.total
        for reason, count in decoded.bad.items():
            self._count(reason, count)
        items = [item for message in decoded.messages for item in self._take(message, at_ns)]
        return (*items, *self._tell(at_ns))

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """What is to be sent at `at_ns` besides setpoints: heartbeat, TIMESYNC requests and answers."""
        out = []
        if self._heartbeat_ns is None or at_ns - self._heartbeat_ns >= HEARTBEAT_NS:
            self._heartbeat_ns = at_ns
            out.append(self._encoder.heartbeat())
        eager = not self._answered and self._requests < FIRST_REQUESTS
        interval_ns = FIRST_TIMESYNC_NS if eager else TIMESYNC_NS
        if self._request_ns is None or at_ns - self._request_ns >= interval_ns:
            self._request_ns = at_ns
            self._requests += 1
            self._open.append(at_ns)
            out.append(self._encoder.timesync(0, at_ns))
        while self._answers:
            out.append(self._encoder.timesync(*self._answers.popleft()))
        return tuple(out)

    def setpoint(self, setpoint: Setpoint) -> bytes:
        """The setpoint, addressed to the vehicle.

        Raises:
            UnsendableError: a value is not finite, or no vehicle has been heard.
        """
        return self._encoder.setpoint(setpoint, *self._target())

    def land(self, at_ns: int) -> bytes:
        """The request to land where it is, addressed to the vehicle.

        Args:
            at_ns: time of sending; the message carries none.

        Raises:
            UnsendableError: no vehicle has been heard.
        """
        del at_ns
        return self._encoder.land(*self._target())

    def stats(self, at_ns: int) -> LinkStats:
        """Counters since the start."""
        return LinkStats(
            at_ns=at_ns,
            link=self._name,
            datagrams=self._datagrams,
            messages=self._messages,
            samples=self._intake.samples,
            bad={str(reason): count for reason, count in self._bad.items()},
            clock_offset_ns=self._intake.clock_offset_ns,
            clock_source=str(self._intake.clock_source),
        )

    def _target(self) -> tuple[int, int]:
        if self._vehicle.address is None:
            raise UnsendableError(f"link {self._name}: no vehicle has been heard, so there is nobody to send to")
        return self._vehicle.address

    def _take(self, message: Message, at_ns: int) -> tuple[Item, ...]:
        if (message.system, message.component) == self._own:  # our own words, sent back by a router
            return ()
        item: Item | None = None
        if isinstance(message, TimeSync):
            self._timesync(message, at_ns)
        elif isinstance(message, Position):
            item = self._intake.take(message, at_ns) if MOCAP in self._roles else None
        elif VEHICLE in self._roles:
            item = self._vehicle.take(message, at_ns)
        return () if item is None else (item,)

    def _timesync(self, message: TimeSync, at_ns: int) -> None:
        if message.tc1_ns == 0:
            self._answers.append((at_ns, message.ts1_ns))
        elif message.ts1_ns in self._open:  # else it answers somebody else
            self._answered = True
            self._intake.answer((message.system, message.component), message.ts1_ns, message.tc1_ns, at_ns)

    def _count(self, reason: str, count: int = 1) -> None:
        self._bad[reason] += count
        if reason not in _USUAL:
            self._untold[reason] += count

    def _tell(self, at_ns: int) -> tuple[Event, ...]:
        """What was dropped, as one event a second, and new clocks as they are found."""
        events = []
        if self._intake.resyncs > self._resyncs_told:
            self._resyncs_told = self._intake.resyncs
            text = f"link {self._name}: a source's clock has jumped; synchronised anew"
            events.append(Event(at_ns=at_ns, severity=Severity.WARNING, code="clock-resync", text=text))
        if self._untold and (self._told_ns is None or at_ns - self._told_ns >= SECOND_NS):
            self._told_ns = at_ns
            events.extend(self._dropped(at_ns))
            self._untold.clear()
        return tuple(events)

    def _dropped(self, at_ns: int) -> list[Event]:
        events = []
        vehicles = self._untold.pop(SECOND_VEHICLE, 0)
        if vehicles and self._vehicle.address is not None:
            text = f"link {self._name}: another vehicle than system {self._vehicle.address[0]} is heard, and ignored"
            events.append(Event(at_ns=at_ns, severity=Severity.ERROR, code=SECOND_VEHICLE, text=text, count=vehicles))
        if self._untold:
            reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(self._untold.items()))
            text = f"link {self._name}: dropped {reasons}"
            count = self._untold.total()
            events.append(Event(at_ns=at_ns, severity=Severity.WARNING, code="dropped", text=text, count=count))
        return events
