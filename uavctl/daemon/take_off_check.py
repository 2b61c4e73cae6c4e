"""Check before arming beside a running flight, for the order to take off: on copies of the flight's datagrams."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from uavctl.check.findings import Item, describe_item, find_refusals
from uavctl.check.preflight import Preflight
from uavctl.config import Config
from uavctl.daemon.flight_orders import explain_height_refusal
from uavctl.flight.mission import RestRegion
from uavctl.io.base import Connection
from uavctl.loop import ControlLoop
from uavctl.mavlink.connection import make_links
from uavctl.records import Order


class TakeOffCheck:
    """Check before arming of a flight that stands by.

    Args:
        connections: Connections of the flight, for the requests of the check; it reads none of them.
        region: Places where the plant may rest; None if it may not rest at every place.
        mission_items: Items on the configuration, found before the flight.
        report: Called with all items after a check that forbids nothing.
    """

    def __init__(
        self,
        config: Config,
        loop: ControlLoop,
        connections: Mapping[str, Connection],
        region: RestRegion | None,
        mission_items: tuple[Item, ...],
        report: Callable[[tuple[Item, ...]], None],
    ) -> None:
        self._config, self._loop, self._connections = config, loop, connections
        self._region, self._mission_items, self._report = region, mission_items, report
        self._preflight: Preflight | None = None
        self._begin_ns = self._ticks = 0
        loop.on_datagram = self._handle_datagram

    def begin(self, height_m: float, at_ns: int) -> str:
        """Begin a check before a climb [m]; return why none may begin, empty if it has begun."""
        if self._config.mission.cells:
            return "a vehicle with moving cells takes off with its fleet: start it with --arm --takeoff HEIGHT"
        if self._preflight is not None:
            return "a take-off is being checked already"
        refusal = self._loop.explain_refusal(Order.TAKE_OFF) or explain_height_refusal(self._region, height_m)
        if not refusal:
            self._begin_ns, self._ticks = at_ns, 0
            self._preflight = Preflight(self._config, make_links, at_ns, take_off_m=height_m, is_beside_flight=True)
        return refusal

    def cancel(self) -> None:
        """End a check without a result."""
        self._preflight = None

    def update(self, at_ns: int) -> str | None:
        """Send what is due; return the reasons not to arm, empty without one, None before the end of the check."""
        preflight = self._preflight
        if preflight is None:
            return "the check has failed"
        # Not recorded: a replay of the flight sends no requests of a check.
        preflight.tick(self._ticks, at_ns, lambda message: self._connections[message.link].send(message.data))
        self._ticks += 1
        refusal = self._loop.explain_refusal(Order.TAKE_OFF)  # the pilot may have armed it
        if not refusal and not preflight.is_complete((at_ns - self._begin_ns) * 1e-9, self._config.check.seconds):
            return None
        self._preflight = None
        if refusal:
            return refusal
        items = (*self._mission_items, *preflight.make_items(at_ns))
        refusals = find_refusals(items, self._config.check)
        if refusals:
            return "\n".join(("not armed, because the check failed:", *map(describe_item, refusals)))
        self._report(items)
        return ""

    def _handle_datagram(self, link: str, data: bytes, at_ns: int) -> None:
        if self._preflight is not None:
            self._preflight.receive(link, data, at_ns)  # the flight sends the answers
