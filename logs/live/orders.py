"""Orders of a live page, passed on to the control sockets of the daemons as `uavctl ctl` does."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from http import HTTPStatus
from typing import Literal

import msgspec

from logs.live.request import RequestRefusedError
from uavctl.records import Vec3

OrderName = Literal["goto", "hold", "resume", "land", "engage"]  # none arms, none takes off
SHARED_ORDERS = frozenset({"hold", "land"})  # that several vehicles may get at once
ANSWER_LIMIT_S = 5.0  # a tick takes a tenth of a second at most
MAX_ORDERS = 4  # requests that wait for their answers
_MAX_ANSWER_BYTES = 65_536


class PageOrder(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An order of a page."""

    order: OrderName
    vehicles: tuple[str, ...]
    position_m: Vec3 | None = None  # local NED; with goto only


class OrderAnswer(msgspec.Struct, frozen=True):
    """Answer of a vehicle's daemon to an order."""

    vehicle: str
    ok: bool
    text: str


class _Reply(msgspec.Struct, frozen=True):
    """The part of a daemon's reply that a page shows."""

    ok: bool
    text: str


class _DaemonRequest(msgspec.Struct, frozen=True, omit_defaults=True):
    """Request on a control socket."""

    ask: OrderName
    position_m: Vec3 | None = None


class OrderSender:
    """Sends orders to the daemons of vehicles.

    Args:
        sockets: Path of the control socket by name of the vehicle; empty where no orders are taken.
    """

    def __init__(self, sockets: Mapping[str, str]) -> None:
        self._sockets, self._waiting = sockets, 0

    @property
    def vehicles(self) -> list[str]:
        """Names of the vehicles that take orders."""
        return list(self._sockets)

    async def give(self, body: bytes) -> list[OrderAnswer]:
        """Send an order of a page; return the answer of each vehicle.

        Args:
            body: A `PageOrder` as JSON.

        Raises:
            RequestRefusedError: The order is malformed, or too many wait.
        """
        order = self._read_order(body)
        if self._waiting >= MAX_ORDERS:
            raise RequestRefusedError(HTTPStatus.SERVICE_UNAVAILABLE, "earlier orders still wait for their answers")
        self._waiting += 1
        try:
            request = _DaemonRequest(order.order, order.position_m)
            paths = [self._sockets[name] for name in order.vehicles]
            replies = await asyncio.gather(*(_ask_daemon(path, request) for path in paths))
        finally:
            self._waiting -= 1
        return [OrderAnswer(name, reply.ok, reply.text) for name, reply in zip(order.vehicles, replies, strict=True)]

    def _read_order(self, body: bytes) -> PageOrder:
        """Decode an order, and check that its vehicles may get it."""
        try:
            order = msgspec.json.decode(body, type=PageOrder)
        except msgspec.MsgspecError as error:  # of msgspec's own, a subclass of ValueError
            raise RequestRefusedError(HTTPStatus.BAD_REQUEST, f"the order is not understood: {error}") from None
        names = order.vehicles
        unknown = [name for name in names if name not in self._sockets]
        problem = ""
        if unknown:
            problem = f"there is no vehicle {unknown[0]!r}"
        elif not names or len(set(names)) < len(names):
            problem = "an order names each of its vehicles once"
        elif len(names) > 1 and order.order not in SHARED_ORDERS:
            problem = f"{order.order} goes to one vehicle"
        if problem:
            raise RequestRefusedError(HTTPStatus.BAD_REQUEST, problem)
        return order


async def _ask_daemon(path: str, request: _DaemonRequest) -> _Reply:
    """Return a daemon's reply to an order; a daemon that gives none has refused it."""
    try:
        async with asyncio.timeout(ANSWER_LIMIT_S):
            reader, writer = await asyncio.open_unix_connection(path, limit=_MAX_ANSWER_BYTES)
            try:
                writer.write(msgspec.json.encode(request) + b"\n")
                line = await reader.readline()
            finally:
                writer.close()
        return msgspec.json.decode(line, type=_Reply)
    except TimeoutError:
        return _Reply(ok=False, text=f"no answer within {ANSWER_LIMIT_S:g} s: watch the vehicle")
    except (FileNotFoundError, ConnectionRefusedError):
        return _Reply(ok=False, text="no daemon answers: it has ended")
    except OSError as error:
        return _Reply(ok=False, text=f"the daemon cannot be reached ({error.strerror})")
    except ValueError:  # of msgspec, and of a line without an end
        return _Reply(ok=False, text="the daemon closed the connection: it is ending")
