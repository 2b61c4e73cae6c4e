"""Flights between walls in which the controller's process stands still, judged on the true vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from deception_rig import choose_plant, prepare_believed
from soak_pairs import compute_outside_m

from sim.simulation import World
from uavctl.config import load_config
from uavctl.daemon.tick_gaps import GapLimit
from uavctl.errors import UavctlError
from uavctl.loop import ControlLoop
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, Datagram, Event, Order, Received, Record, Send

NO_ANSWER = Received((), False, False, ())
HEIGHT_M = 1.2
LANDING_S = 25.0
GUSTS_MPS = 2.0


@dataclass
class GapFlight:
    """What the truth has of a flight.

    Attributes:
        outside_m: Furthest beyond a wall or the ceiling from the first gap on; negative is inside [m].
        outside_s: When that was, since the start [s].
        begin_mps: Speed when the first gap began.
        speed_mps: Largest speed from then on.
        modes: Changes of the autopilot's mode, each with its time [s].
        told: Events of the hand-over, each with its time [s].
        is_down: Whether it stands on the floor in the end.
    """

    outside_m: float = -math.inf
    outside_s: float = 0.0
    begin_mps: float = 0.0
    speed_mps: float = 0.0
    modes: list[tuple[float, str]] = field(default_factory=list)
    told: list[tuple[float, str]] = field(default_factory=list)
    is_down: bool = False


class StoppedLoop:
    """A control loop that stands still in gaps. At its end it reads what has come as if it came just then.

    Args:
        gaps_s: Begin and end of each gap, in order [s].
    """

    def __init__(self, loop: ControlLoop, gaps_s: Sequence[tuple[float, float]]) -> None:
        self._loop, self._gaps_s = loop, gaps_s
        self._limit = GapLimit()
        self._backlog: list[Datagram] = []
        self._missed = 0
        self._is_stopped = False
        self.look: Callable[[int], None] = lambda _: None
        self.stop = False

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        """Take a datagram, or leave it unread in a gap."""
        if not self._is_stopped:
            return self._loop.receive(link, data, at_ns)
        self._backlog.append(Datagram(at_ns=at_ns, link=link, outgoing=False, data=data))
        return NO_ANSWER

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        """Run a tick, unless it is in a gap."""
        self.look(at_ns)
        self._is_stopped = any(begin_s <= at_ns * 1e-9 < end_s for begin_s, end_s in self._gaps_s)
        if self._is_stopped:
            self._missed += 1
            return
        for place, unread in enumerate(self._backlog):
            for answer in self._loop.receive(unread.link, unread.data, at_ns + 1 + place).answers:
                send(answer)
        self._backlog.clear()
        missed, self._missed = self._missed, 0
        try:
            self._limit.check(at_ns, is_in_control=self._loop.handover_state is HandoverState.ENGAGED)
        except UavctlError as error:
            self._loop.fail(error, at_ns)
            return
        self._loop.tick(tick, at_ns, send, missed, stop=self.stop)


class _TextSink:
    def __init__(self, flight: GapFlight) -> None:
        self._flight = flight

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        del topic
        if isinstance(record, Event) and record.code in ("hand-over", "control-failed"):
            self._flight.told.append((round(at_ns * 1e-9, 2), record.text))


def fly_with_gaps(
    autopilot: str,
    plant: str,
    gaps_s: Sequence[tuple[float, float]],
    *,
    seed: int = 1,
    takes_off: bool = False,
    after_s: float = 5.0,
    lands: bool = True,
) -> GapFlight:
    """Fly from wall to wall, and end the flight after that as the operator would.

    Args:
        takes_off: Whether it begins on the ground, by an order; else in the air, and the pilot has begun the flight.
        after_s: How long it goes on after the last gap [s].
        lands: Whether it is ended; else it is looked at until then.
    """
    preset, duration_s = f"room-{autopilot}", gaps_s[-1][1] + after_s
    waypoints = _make_waypoints(preset, autopilot)
    config = load_config(
        preset,
        [
            f"sim.autopilot={autopilot}",
            f"sim.seed={seed}",
            *choose_plant(plant, GUSTS_MPS),
            waypoints,
            f"duration_s={duration_s}",
        ],
    )
    _, controller = prepare_believed(preset, autopilot, (waypoints,))
    flight = GapFlight()
    loop = ControlLoop(config, controller, _TextSink(flight), lambda: 0)
    stopped = StoppedLoop(loop, gaps_s)
    world = World(config, stopped, airborne=not takes_off)
    begin_ns = round(gaps_s[0][0] * 1e9)
    if takes_off:
        loop.order(Command(order=Order.TAKE_OFF, height_m=HEIGHT_M))

    def look(at_ns: int) -> None:
        vehicle, mode = world.peers.vehicle, world.peers.autopilot.mode_name
        if not flight.modes or flight.modes[-1][1] != mode:
            flight.modes.append((round(at_ns * 1e-9, 2), mode))
        if at_ns < begin_ns:
            return
        speed_mps, outside_m = math.hypot(*vehicle.velocity_mps), compute_outside_m(config, vehicle.position_m)
        flight.begin_mps = flight.begin_mps or speed_mps
        flight.speed_mps = max(flight.speed_mps, speed_mps)
        if outside_m > flight.outside_m:
            flight.outside_m, flight.outside_s = outside_m, at_ns * 1e-9

    stopped.look = look
    world.run(duration_s, lambda: loop.finished)
    if not lands:
        return flight
    stopped.stop = True
    world.run(duration_s + LANDING_S, lambda: not world.peers.autopilot.pilot.is_armed)
    flight.is_down = not world.peers.autopilot.pilot.is_armed
    return flight


def _make_waypoints(preset: str, autopilot: str) -> str:
    config = load_config(preset, [f"sim.autopilot={autopilot}"])
    size = len(config.sets.state_lower) // 3
    lower, upper = ([row[i * size] for i in range(2)] for row in (config.sets.state_lower, config.sets.state_upper))
    corners = [(0.9 * n, 0.9 * e) for n, e in (lower, upper)] * 4
    return "mission.waypoints=[" + ", ".join(f"[{n:.2f}, {e:.2f}, {-HEIGHT_M}]" for n, e in corners) + "]"
