"""Foxglove's protocol: offered channels, subscriptions, and waiting messages. Nothing can be written.

https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
"""

from __future__ import annotations

import base64
import struct
from collections import deque

import msgspec

from logs.recording.topics import Definition

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
MAX_WAITING_BYTES = 8 * 2**20  # for each viewer; about a minute of a flight
_MESSAGE_DATA = struct.Struct("<BIQ")  # opcode, subscription, log time [ns]
_MESSAGE_DATA_OPCODE = 1
_ERROR_LEVEL = 2


class _Subscription(msgspec.Struct, rename="camel"):
    id: int
    channel_id: int


class _Request(msgspec.Struct, rename="camel"):
    """A viewer's request; it needs the field of its operation alone."""

    op: str
    subscriptions: list[_Subscription] = []
    subscription_ids: list[int] = []


def make_server_info() -> bytes:
    """Return the first message to a viewer: it can do nothing but subscribe."""
    return msgspec.json.encode({"op": "serverInfo", "name": "uavctl", "capabilities": [], "metadata": {}})


def make_advertisement(channels: list[tuple[int, Definition]]) -> bytes:
    """Return the message that offers channels, each with its number."""
    return msgspec.json.encode(
        {
            "op": "advertise",
            "channels": [
                {
                    "id": number,
                    "topic": definition.topic,
                    "encoding": definition.encoding,
                    "schemaName": definition.schema_name,
                    "schemaEncoding": definition.schema_encoding,
                    "schema": definition.schema.decode()
                    if definition.schema_encoding == "jsonschema"
                    else base64.b64encode(definition.schema).decode(),
                }
                for number, definition in channels
            ],
        }
    )


class Subscriber:
    """A viewer: its subscriptions, and the newest messages that wait for it.

    Attributes:
        offered: Number of channels that it knows.
    """

    def __init__(self) -> None:
        self.offered = 0
        self._subscriptions: dict[int, int] = {}  # subscription by channel
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0

    def answer(self, text: bytes) -> bytes | None:
        """Take a request; return the error for one that is not fulfilled."""
        try:
            request = msgspec.json.decode(text, type=_Request)
        except (msgspec.MsgspecError, RecursionError):
            return _make_error("the request is not understood")
        if request.op == "subscribe":
            return self._subscribe(request.subscriptions)
        if request.op == "unsubscribe":
            ended = set(request.subscription_ids)
            self._subscriptions = {
                channel: subscription
                for channel, subscription in self._subscriptions.items()
                if subscription not in ended
            }
            return None
        return _make_error("refused: a viewer of uavctl can only subscribe and unsubscribe")

    def _subscribe(self, subscriptions: list[_Subscription]) -> bytes | None:
        for subscription in subscriptions:
            if not 0 < subscription.channel_id <= self.offered or not 0 <= subscription.id < 2**32:
                return _make_error("there is no such channel, or the subscription's number is too large")
            self._subscriptions[subscription.channel_id] = subscription.id
        return None

    def put(self, channel: int, at_ns: int, data: bytes) -> None:
        """Queue a message of a channel, if it is asked for; the oldest are dropped where too much waits."""
        subscription = self._subscriptions.get(channel)
        if subscription is None:
            return
        self._waiting.append(_MESSAGE_DATA.pack(_MESSAGE_DATA_OPCODE, subscription, at_ns) + data)
        self._waiting_bytes += len(self._waiting[-1])
        while self._waiting_bytes > MAX_WAITING_BYTES:
            self._waiting_bytes -= len(self._waiting.popleft())

    def take(self) -> bytes | None:
        """Return the oldest message that waits, and forget it."""
        if not self._waiting:
            return None
        self._waiting_bytes -= len(self._waiting[0])
        return self._waiting.popleft()


def _make_error(text: str) -> bytes:
    return msgspec.json.encode({"op": "status", "level": _ERROR_LEVEL, "message": text})
