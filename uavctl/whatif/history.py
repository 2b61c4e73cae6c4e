"""What a recording tells of its flight: inputs of the loop, setpoints flown, and when each position was captured."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from msgspec.structs import replace

from logs.flight_data import FlightData
from sim.mocap import COMPONENT_ID, SYSTEM_ID, UPTIME_S
from sim.vehicle import linear_model
from uavctl.config import Config
from uavctl.config.peers import DaemonConfig
from uavctl.config.types import PlantConfig
from uavctl.data import Datagram, PositionSample, Record, Setpoint, StepInput, Vec3
from uavctl.errors import RecordingError
from uavctl.loop import MOCAP, VEHICLE
from uavctl.mavlink.framing import scan
from uavctl.mavlink.link import STREAM_SCHEMES
from uavctl.mavlink.messages import Position
from uavctl.whatif.departure import Response
from uavctl.whatif.rewrite import Seen

Entry = tuple[str, int, Record]
LEAST_POSITIONS = 2


@dataclass(frozen=True, eq=False)
class History:
    """A recorded flight.

    Attributes:
        entries: (topic, log time [ns], record), in the order of recording; of a byte stream, each chunk holds the
            whole frames that could be read by then.
        flight: The same by type.
        config: Its configuration.
        setpoints: Acceleration setpoint [m/s²] that was sent in the tick of each time [ns].
        taken: Whether the vehicle took setpoints in the tick of each time [ns].
        samples: Positions that came to the controller, by time of arrival [ns].
    """

    entries: tuple[Entry, ...]
    flight: FlightData
    config: Config
    setpoints: dict[int, Vec3]
    taken: dict[int, bool]
    samples: dict[int, list[PositionSample]]

    def captured_ns(self, seen: Seen, at_ns: int) -> int | None:
        """When a position that arrived at `at_ns` was captured [ns]; None if the controller never got it.

        By the simulator's own clock where it is a simulated flight, else as the controller believed.
        """
        position = seen.position
        source = f"{position.name} {position.system}/{position.component}"
        for sample in self.samples.get(at_ns, ()):
            if sample.source == source and sample.position_m == seen.position_m:
                simulated_ns = self.simulated_ns(position)
                return sample.captured_ns if simulated_ns is None else simulated_ns
        return None

    def simulated_ns(self, position: Position) -> int | None:
        """The same by the stamp of the simulated cameras; None where it is not theirs."""
        theirs = (position.system, position.component) == (SYSTEM_ID, COMPONENT_ID)
        if not (self.flight.truths and theirs and position.stamp_us):
            return None
        camera = self.config.sim.camera
        since_us = (position.stamp_us - round((UPTIME_S + camera.clock_offset_s) * 1e6)) / (
            1.0 + camera.clock_drift_ppm * 1e-6
        )
        return self.flight.truths[0].at_ns + round(since_us * 1e3)


def history_of(entries: Iterable[Entry], config: Config, name: str) -> History:
    """Sort out a recording.

    Args:
        entries: (topic, log time [ns], record), in the order of recording.
        config: Its configuration.
        name: What errors call it.

    Raises:
        RecordingError: Nothing was decided, or flown, or hardly any position came.
    """
    kept = tuple(_whole_frames(entries, config.daemon))
    setpoints: dict[int, Vec3] = {}
    taken: dict[int, bool] = {}
    samples: defaultdict[int, list[PositionSample]] = defaultdict(list)
    for _, at_ns, record in kept:
        if isinstance(record, Setpoint):
            setpoints[at_ns] = record.accel_mps2
        elif isinstance(record, StepInput):
            taken[at_ns] = record.vehicle is not None and record.vehicle.armed and record.vehicle.external
            for sample in record.samples:
                samples[sample.received_ns].append(sample)
    count = sum(map(len, samples.values()))
    if count < LEAST_POSITIONS:
        raise RecordingError(
            f"{name}: only {count} positions came in it; a what-if needs at least {LEAST_POSITIONS}, of a flight under "
            "setpoints (`uavctl log info` tells what there is)"
        )
    flight = FlightData.from_records(kept)
    if not any(at_ns in setpoints and takes for at_ns, takes in taken.items()):
        raise RecordingError(
            f"{name}: the vehicle never took a setpoint in it, so there is nothing that could have gone otherwise"
        )
    return History(kept, flight, config, setpoints, taken, dict(samples))


def response_of(history: History, plant: PlantConfig) -> Response:
    """How the recorded vehicle answers to setpoints if this is its plant; the simulator's linear one has no dead time.

    Raises:
        DesignError: There is no motion between its steps.
    """
    at_once = bool(history.flight.truths) and history.config.sim.plant == "linear"
    return Response(linear_model(plant), 0 if at_once else round(plant.dead_time_s * 1e9))


def _whole_frames(entries: Iterable[Entry], daemon: DaemonConfig) -> Iterator[Entry]:
    """The same, byte streams cut between frames in place of anywhere."""
    urls = {VEHICLE: daemon.vehicle, MOCAP: daemon.mocap}
    streams = {name: _Stream() for name, url in urls.items() if url.startswith(STREAM_SCHEMES)}
    for topic, at_ns, record in entries:
        if isinstance(record, Datagram) and not record.outgoing and record.link in streams:
            yield topic, at_ns, replace(record, data=streams[record.link].whole(record.data))
        else:
            yield topic, at_ns, record


class _Stream:
    """A byte stream in chunks."""

    def __init__(self) -> None:
        self._rest = b""
        self._in_step = True

    def whole(self, chunk: bytes) -> bytes:
        """All that can be read now; what a frame is still missing of waits."""
        data = self._rest + chunk
        found = scan(data, final=False, in_step=self._in_step)
        self._rest, self._in_step = data[found.consumed :], found.in_step
        return data[: found.consumed]
