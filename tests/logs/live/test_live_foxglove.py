"""Foxglove's protocol: as Foxglove's own server speaks it, bounded, and without anything that writes."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_rig import Viewer

from logs.live.foxglove import MAX_WAITING_BYTES, Subscriber, make_advertisement, make_server_info
from logs.recording.topics import get_definition

TOPICS = ("/uavctl/decision", "/plot/age", "/view/scene/path")
SUBSCRIBE = b'{"op":"subscribe","subscriptions":[{"id":7,"channelId":2}]}'
WRITES = (
    {"op": "advertise", "channels": [{"id": 1, "topic": "/x", "encoding": "json", "schemaName": ""}]},
    {"op": "unadvertise", "channelIds": [1]},
    {"op": "getParameters", "parameterNames": []},
    {"op": "setParameters", "parameters": [{"name": "a", "value": 1}]},
    {"op": "subscribeParameterUpdates", "parameterNames": ["a"]},
    {"op": "subscribeConnectionGraph"},
    {"op": "fetchAsset", "uri": "file:///etc/passwd", "requestId": 1},
    {"op": "shutDown"},
)


def make_subscriber() -> Subscriber:
    subscriber = Subscriber()
    subscriber.offered = 3
    return subscriber


def take_all(subscriber: Subscriber) -> list[bytes]:
    return [*iter(subscriber.take, None)]


def test_offers_and_messages_are_those_of_foxglove_s_own_server() -> None:
    """The first answers and a message of `foxglove-sdk`, for the same topics."""
    foxglove = pytest.importorskip("foxglove")
    context = foxglove.Context()
    server = foxglove.start_server(name="uavctl", port=0, context=context)
    try:
        definitions = [get_definition(topic) for topic in TOPICS]
        channels = [
            foxglove.Channel(
                one.topic,
                schema=foxglove.Schema(name=one.schema_name, encoding=one.schema_encoding, data=one.schema),
                message_encoding=one.encoding,
                context=context,
            )
            for one in definitions
        ]
        with Viewer(server.port) as viewer:
            info = json.loads(viewer.read_frame()[1])
            offers: dict[str, dict[str, Any]] = viewer.channels(set(TOPICS))
            numbers = {topic: int(offer["id"]) for topic, offer in offers.items()}
            viewer.demand(
                b'{"op":"subscribe","subscriptions":[{"id":7,"channelId":%d},{"id":8,"channelId":999999}]}'
                % numbers["/plot/age"]
            )
            channels[1].log(b"data", log_time=77)
            message = viewer.read_frame()[1]
    finally:
        server.stop()
    own_info = json.loads(make_server_info())
    assert {name: info[name] for name in ("op", "name", "capabilities")} == {
        name: own_info[name] for name in ("op", "name", "capabilities")
    }
    own_offers = json.loads(make_advertisement([(numbers[one.topic], one) for one in definitions]))["channels"]
    assert {offer["topic"]: offer for offer in own_offers} == offers
    subscriber = Subscriber()
    subscriber.offered = max(numbers.values())
    assert subscriber.answer(SUBSCRIBE.replace(b"2", b"%d" % numbers["/plot/age"])) is None
    subscriber.put(numbers["/plot/age"], 77, b"data")
    assert subscriber.take() == message


@pytest.mark.fault(98)
@pytest.mark.parametrize("request_", WRITES, ids=lambda one: str(one["op"]))
def test_98_a_request_that_would_write_is_refused(request_: dict[str, Any]) -> None:
    subscriber = make_subscriber()
    assert subscriber.answer(SUBSCRIBE) is None
    answer = subscriber.answer(json.dumps(request_).encode())
    assert answer is not None and json.loads(answer)["level"] == 2
    subscriber.put(2, 0, b"a")
    assert len(take_all(subscriber)) == 1  # it is served on


@given(st.binary(max_size=100) | st.text(max_size=100).map(str.encode))
def test_any_text_is_a_request_or_refused(text: bytes) -> None:
    answer = make_subscriber().answer(text)
    assert answer is None or json.loads(answer)["op"] == "status"


@pytest.mark.parametrize(
    "text",
    [
        b"[" * 100_000,
        b'{"op":"subscribe","subscriptions":[{"id":1,"channelId":4}]}',
        b'{"op":"subscribe","subscriptions":[{"id":1,"channelId":0}]}',
        b'{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}',
        b'{"op":"subscribe","subscriptions":[{"id":4294967296,"channelId":1}]}',
        b'{"op":"subscribe","subscriptions":7}',
        b'{"op":["subscribe"]}',
    ],
)
def test_a_wrong_request_is_refused(text: bytes) -> None:
    subscriber = make_subscriber()
    assert subscriber.answer(text) is not None
    for channel in range(1, 4):
        subscriber.put(channel, 0, b"a")
    assert not take_all(subscriber)


def test_a_viewer_gets_what_it_asks_for_until_it_does_no_more() -> None:
    subscriber = make_subscriber()
    subscriber.put(2, 0, b"a")
    subscriber.answer(SUBSCRIBE)
    subscriber.put(2, 1, b"b")
    subscriber.put(1, 1, b"c")
    assert [message[-1:] for message in take_all(subscriber)] == [b"b"]
    subscriber.answer(b'{"op":"unsubscribe","subscriptionIds":[7]}')
    subscriber.put(2, 2, b"d")
    assert not take_all(subscriber)


@pytest.mark.fault(97)
def test_97_what_waits_for_a_viewer_is_bounded_and_the_newest_stay() -> None:
    subscriber, data = make_subscriber(), bytes(100_000)
    subscriber.answer(SUBSCRIBE)
    for number in range(200):
        subscriber.put(2, number, data)
    times = [int.from_bytes(message[5:13], "little") for message in take_all(subscriber)]
    assert sum(1 for _ in times) * len(data) < MAX_WAITING_BYTES
    assert times == [*range(200 - len(times), 200)] and len(times) > 50
    subscriber.put(2, 0, bytes(MAX_WAITING_BYTES + 1))
    assert not take_all(subscriber)
