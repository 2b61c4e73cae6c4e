"""Server of the live view: the page, its states one after another, its orders, and Foxglove's WebSocket, on one port.

All that a client can take up is bounded: connections, their rate, time and size of a request, and what waits for it.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path

import msgspec

from logs.live.foxglove import SUBPROTOCOLS, Subscriber, make_advertisement, make_server_info
from logs.live.orders import OrderSender
from logs.live.request import (
    HISTORY,
    ORDERS,
    LiveAccess,
    Request,
    RequestRefusedError,
    check_request,
    may_order,
    parse_request,
)
from logs.live.websocket import Opcode, WebSocketError, make_frame, make_handshake, read_frame
from logs.recording.topics import Definition

PERIOD_S = 0.1  # between two states of a page
MAX_VIEWERS = 8  # pages and Foxglove's connections that are open at once
MAX_ASKING = 16  # connections whose request is not answered yet; a newer one ends the oldest
ACCEPT_PERIOD_S = 0.005  # between two connections: a flood costs little time of the processor
REQUEST_PERIOD_S = 0.01  # between two requests of a viewer, likewise
PATIENCE_S = 5.0  # for a request, and for a client that takes nothing
MAX_HEAD_BYTES = 8192  # of a request; browsers send less than 1 kB
_JSON = "application/json"
_FILES = {
    "/": (Path(__file__).with_name("page.html"), "text/html; charset=utf-8"),
    "/live.js": (Path(__file__).with_name("page.js"), "text/javascript; charset=utf-8"),
}


class LiveServer:
    """Serves one flight.

    Args:
        get_scene: Returns the newest scene, as JSON.
        get_history: Returns the states since the start, as JSON.
        access: What it permits, and to whom.
    """

    def __init__(self, get_scene: Callable[[], bytes], get_history: Callable[[], bytes], access: LiveAccess) -> None:
        self._get_scene, self._get_history, self._access = get_scene, get_history, access
        self._orders = OrderSender(access.sockets)
        self._channels: dict[str, int] = {}  # number by topic, from 1
        self._definitions: list[Definition] = []
        self._subscribers: dict[Subscriber, asyncio.Event] = {}
        self._asking: dict[asyncio.Task[None], None] = {}  # the oldest first
        self._tasks: set[asyncio.Task[None]] = set()
        self._viewers = 0

    def publish(self, definition: Definition, at_ns: int, data: bytes) -> None:
        """Pass a message on to the subscribers of its topic."""
        channel = self._channels.get(definition.topic)
        if channel is None:
            self._definitions.append(definition)
            channel = self._channels[definition.topic] = len(self._definitions)
        for subscriber, has_news in self._subscribers.items():
            subscriber.put(channel, at_ns, data)
            has_news.set()

    async def accept(self, listener: socket.socket) -> None:
        """Accept connections until this is cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            with suppress(OSError):  # it has gone again, or no descriptor is left now
                connection, _ = await loop.sock_accept(listener)
                if len(self._asking) >= MAX_ASKING:
                    oldest = next(iter(self._asking))
                    del self._asking[oldest]
                    oldest.cancel()
                task = loop.create_task(self._handle(connection))
                self._asking[task] = None
                self._tasks.add(task)  # the loop itself would forget it
                task.add_done_callback(self._forget)
            await asyncio.sleep(ACCEPT_PERIOD_S)

    def _forget(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        self._asking.pop(task, None)
        if not task.cancelled():
            task.exception()  # one connection's defect ends that connection alone

    async def _handle(self, connection: socket.socket) -> None:
        """Answer the one request of a connection, and close it."""
        reader, writer = await asyncio.open_connection(sock=connection, limit=MAX_HEAD_BYTES)
        writer.transport.set_write_buffer_limits(high=0)  # `drain` waits until the kernel has all
        try:
            with suppress(OSError, asyncio.IncompleteReadError, WebSocketError):
                try:
                    request = await self._read_request(reader)
                    await self._answer(request, reader, writer)
                except RequestRefusedError as refused:
                    text = f"{refused.reason}\n".encode()
                    await _send(writer, _make_head(refused.status, "text/plain; charset=utf-8", len(text)) + text)
        finally:
            writer.transport.abort()  # an answer is with the kernel, and a client that takes nothing is not waited for

    async def _read_request(self, reader: asyncio.StreamReader) -> Request:
        try:
            async with asyncio.timeout(PATIENCE_S):
                head = await reader.readuntil(b"\r\n\r\n")
        except asyncio.LimitOverrunError:
            raise RequestRefusedError(
                HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, f"a request has at most {MAX_HEAD_BYTES} bytes"
            ) from None
        request = parse_request(head)
        check_request(request, self._access)
        return request

    async def _answer(self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not request.asks_for_websocket and request.path in _FILES:
            path, kind = _FILES[request.path]
            await _send_document(writer, kind, path.read_bytes())
            return
        if request.path == HISTORY:
            await _send_document(writer, _JSON, self._get_history())
            return
        if request.path == ORDERS:
            await self._answer_orders(request, reader, writer)
            return
        if self._viewers >= MAX_VIEWERS:
            raise RequestRefusedError(HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_VIEWERS} viewers are connected")
        handshake = make_handshake(request, SUBPROTOCOLS) if request.asks_for_websocket else b""
        self._keep_connection()
        self._viewers += 1
        try:
            if handshake:
                await _send(writer, handshake)
                await self._serve_foxglove(reader, writer)
            else:
                await self._send_scenes(writer)
        finally:
            self._viewers -= 1

    def _keep_connection(self) -> None:
        """Keep this connection where newer ones end the oldest whose request is not answered."""
        task = asyncio.current_task()
        if task is not None:
            self._asking.pop(task, None)

    async def _answer_orders(
        self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """List the vehicles that take orders, or pass an order on."""
        answer: object
        if request.method == "POST":
            self._keep_connection()
            async with asyncio.timeout(PATIENCE_S):
                body = await reader.readexactly(int(request.headers["content-length"]))
            answer = await self._orders.give(body)
        else:
            answer = {"vehicles": self._orders.vehicles, "permitted": may_order(request, self._access)}
        await _send_document(writer, _JSON, msgspec.json.encode(answer))

    async def _send_scenes(self, writer: asyncio.StreamWriter) -> None:
        await _send(writer, _make_head(HTTPStatus.OK, "text/event-stream"))
        while True:
            await _send(writer, b"data: " + self._get_scene() + b"\n\n")
            await asyncio.sleep(PERIOD_S)

    async def _serve_foxglove(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        subscriber = Subscriber()
        self._subscribers[subscriber] = asyncio.Event()
        sending = asyncio.ensure_future(self._send_messages(subscriber, writer))
        receiving = asyncio.ensure_future(_take_requests(subscriber, reader, writer))
        try:
            await asyncio.wait((sending, receiving), return_when=asyncio.FIRST_COMPLETED)
        finally:
            del self._subscribers[subscriber]
            for task in (sending, receiving):
                task.cancel()
            await asyncio.gather(sending, receiving, return_exceptions=True)

    async def _send_messages(self, subscriber: Subscriber, writer: asyncio.StreamWriter) -> None:
        """Send the offers and the messages that wait; return never."""
        await _send(writer, make_frame(Opcode.TEXT, make_server_info()))
        has_news = self._subscribers[subscriber]
        while True:
            known, message = subscriber.offered, subscriber.take()
            if known < len(self._definitions):
                subscriber.offered = len(self._definitions)
                new_channels = list(enumerate(self._definitions[known:], known + 1))
                await _send(writer, make_frame(Opcode.TEXT, make_advertisement(new_channels)))
            if message is not None:
                await _send(writer, make_frame(Opcode.BINARY, message))
            else:
                await has_news.wait()
                has_news.clear()


async def _take_requests(subscriber: Subscriber, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Answer a viewer's requests until it disconnects."""
    while True:
        opcode, data = await read_frame(reader, PATIENCE_S)
        if opcode is Opcode.CLOSE:
            await _send(writer, make_frame(Opcode.CLOSE, data[:2]))
            return
        if opcode is Opcode.PING:
            await _send(writer, make_frame(Opcode.PONG, data))
        elif opcode is not Opcode.PONG:
            # Binary requests are messages and service calls: those are refused as any other text.
            error = subscriber.answer(data)
            if error is not None:
                await _send(writer, make_frame(Opcode.TEXT, error))
        await asyncio.sleep(REQUEST_PERIOD_S)


async def _send(writer: asyncio.StreamWriter, data: bytes) -> None:
    """Send data, and wait until the kernel has taken them.

    Raises:
        TimeoutError: The client takes nothing.
        OSError: It has gone.
    """
    writer.write(data)
    async with asyncio.timeout(PATIENCE_S):
        await writer.drain()


async def _send_document(writer: asyncio.StreamWriter, kind: str, data: bytes) -> None:
    """Send a whole answer; raises as `_send`."""
    await _send(writer, _make_head(HTTPStatus.OK, kind, len(data)) + data)


def _make_head(status: HTTPStatus, kind: str, length: int | None = None) -> bytes:
    """Return the head of an answer, after which the connection is closed."""
    lines = [
        f"HTTP/1.1 {status.value} {status.phrase}",
        f"Content-Type: {kind}",
        "Cache-Control: no-store",
        "Content-Security-Policy: default-src 'self'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'none'",
        "X-Content-Type-Options: nosniff",
        "Connection: close",
    ]
    if length is not None:
        lines.append(f"Content-Length: {length}")
    return "\r\n".join([*lines, "", ""]).encode()
