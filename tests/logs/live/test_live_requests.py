"""Requests to the live view: which are answered, and that whatever comes is read or refused."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from http import HTTPStatus
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_rig import HANDSHAKE, make_head

from logs.live.request import MAX_BODY_BYTES, LiveAccess, RequestRefusedError, check_request, parse_request
from logs.live.websocket import LARGEST, Opcode, WebSocketError, make_handshake, read_frame

TOKEN, ORDER_TOKEN = "t0ken", "0rder"
VIEW = LiveAccess(TOKEN, ORDER_TOKEN)  # of a flight that takes no orders
ORDERS = LiveAccess(TOKEN, ORDER_TOKEN, {"one": "/run/one.sock"})
FOREIGN = "https://flights.example"


def check(**changes: str) -> HTTPStatus:
    """The status of a request: a browser's for the page, with other headers, path or method."""
    path, method = changes.pop("path", "/"), changes.pop("method", "GET")
    headers = {"Host": "localhost:8765", **changes}
    try:
        check_request(parse_request(make_head(headers, path, method)), VIEW)
    except RequestRefusedError as refused:
        return refused.status
    return HTTPStatus.OK


@pytest.mark.fault(98)
@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost:8765", 200),
        ("localhost", 200),
        ("LocalHost:80", 200),
        ("127.0.0.1:9000", 200),
        ("", 403),
        ("flights.example:8765", 403),
        ("localhost.flights.example", 403),
        ("127.0.0.1.flights.example", 403),
        ("localhost:8765@flights.example", 403),
        ("localhost:8765, flights.example", 403),
        ("localhost:", 403),
        ("127.0.0.2", 403),
        ("127x0.0.1", 403),
        ("[::1]:8765", 403),
    ],
)
def test_98_only_this_machine_s_names_are_a_host(host: str, status: int) -> None:
    assert check(Host=host) == status
    assert check(**{**HANDSHAKE, "Host": host}) == status


@pytest.mark.fault(98)
def test_98_a_host_that_comes_twice_is_none() -> None:
    head = b"GET / HTTP/1.1\r\nHost: localhost\r\nhost: localhost\r\n\r\n"
    with pytest.raises(RequestRefusedError) as refused:
        check_request(parse_request(head), VIEW)
    assert refused.value.status == 403


@pytest.mark.fault(98)
@pytest.mark.parametrize(
    ("origin", "path", "status"),
    [
        ("http://localhost:8765", "/", 200),
        ("http://localhost:8080", "/", 403),
        ("https://localhost:8765", "/", 403),
        ("http://127.0.0.1:8765", "/", 403),
        (FOREIGN, "/", 403),
        ("null", "/", 403),
        ("", "/", 403),
        (FOREIGN, f"/{TOKEN}", 200),
        ("null", f"/{TOKEN}", 200),
        (FOREIGN, f"/{TOKEN}x", 403),
        (FOREIGN, f"/?{TOKEN}", 403),
        ("http://localhost:8765", "/wrong", 404),
    ],
)
def test_98_another_site_opens_the_websocket_with_the_token_alone(origin: str, path: str, status: int) -> None:
    assert check(**{**HANDSHAKE, "Host": "localhost:8765"}, Origin=origin, path=path) == status


@pytest.mark.fault(98)
@pytest.mark.parametrize(
    ("site", "status"), [("same-origin", 200), ("none", 200), ("same-site", 403), ("cross-site", 403), ("", 403)]
)
def test_98_a_request_without_an_answer_for_the_page_of_another_site_takes_no_place(site: str, status: int) -> None:
    assert check(path="/scenes", **{"Sec-Fetch-Site": site}) == status
    assert check(path=f"/{TOKEN}", **{**HANDSHAKE, "Sec-Fetch-Site": site}) == 200


@pytest.mark.fault(98)
def test_98_another_site_reads_no_page_even_with_the_token() -> None:
    for path in ("/", "/live.js", "/scenes"):
        assert (check(path=path), check(path=path, Origin=FOREIGN)) == (200, 403)
    assert check(path=f"/{TOKEN}") == 404
    assert check(path=f"/{TOKEN}", Origin=FOREIGN) == 403


@pytest.mark.fault(98)
@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "CONNECT", "TRACE", "HEAD", "get", ""])
def test_98_nothing_but_get_is_allowed(method: str) -> None:
    assert check(method=method) == 405
    assert check(**HANDSHAKE, method=method, path=f"/{TOKEN}") == 405


ORDER = {
    "Host": "localhost:8765",
    "Origin": "http://localhost:8765",
    "X-Uavctl-Token": ORDER_TOKEN,
    "Content-Type": "application/json",
    "Content-Length": "2",
}


def check_order(access: LiveAccess = ORDERS, path: str = "/orders", **changes: str | None) -> int:
    """The status of an order: a browser's from the page, with other headers, or without one."""
    headers = {**ORDER, **{name.replace("_", "-"): value for name, value in changes.items()}}
    try:
        check_request(
            parse_request(make_head({n: v for n, v in headers.items() if v is not None}, path, "POST")), access
        )
    except RequestRefusedError as refused:
        return refused.status
    return 200


@pytest.mark.fault(98)
@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({}, 200),
        ({"Sec_Fetch_Site": "same-origin"}, 200),
        ({"Host": "127.0.0.1:8765", "Origin": "http://127.0.0.1:8765"}, 200),
        ({"Host": "flights.example:8765", "Origin": "http://flights.example:8765"}, 403),  # its name leads here
        ({"Origin": FOREIGN}, 403),
        ({"Origin": "http://localhost:8080"}, 403),
        ({"Origin": "http://127.0.0.1:8765"}, 403),
        ({"Origin": "null"}, 403),
        ({"Origin": None}, 403),
        ({"Sec_Fetch_Site": "same-site"}, 403),
        ({"Sec_Fetch_Site": "cross-site"}, 403),
        ({"Sec_Fetch_Site": "none"}, 403),
        ({"X_Uavctl_Token": None}, 403),
        ({"X_Uavctl_Token": ""}, 403),
        ({"X_Uavctl_Token": TOKEN}, 403),  # the token that Foxglove gets
        ({"X_Uavctl_Token": f"{ORDER_TOKEN}x"}, 403),
        ({"X_Uavctl_Token": ORDER_TOKEN[:-1]}, 403),
        ({"X_Uavctl_Token": f"{ORDER_TOKEN}, {ORDER_TOKEN}"}, 403),
        ({"Content_Type": "text/plain"}, 415),  # a form may send this without a question before
        ({"Content_Type": None}, 415),
        ({"Content_Length": None}, 411),
        ({"Content_Length": "-1"}, 411),
        ({"Content_Length": "2, 2"}, 411),
        ({"Transfer_Encoding": "chunked"}, 411),
        ({"Content_Length": str(MAX_BODY_BYTES + 1)}, 413),
        ({"path": "/"}, 405),
        ({"path": "/orders?"}, 405),
        ({"path": "/scenes"}, 405),
        ({"access": VIEW}, 405),
    ],
)
def test_98_an_order_comes_from_the_page_itself_with_its_token(changes: Any, status: int) -> None:
    assert check_order(**changes) == status


@pytest.mark.fault(98)
def test_98_without_a_secret_nobody_may_order() -> None:
    assert check_order(LiveAccess(TOKEN, "", ORDERS.sockets), X_Uavctl_Token="") == 403


@given(st.binary(max_size=200))
def test_any_bytes_are_a_request_or_refused(data: bytes) -> None:
    for head in (data, b"GET / HTTP/1.1\r\n" + data, make_head({"Host": "localhost"})[:-2] + data):
        try:
            request = parse_request(head + b"\r\n\r\n")
            check_request(request, VIEW)
            make_handshake(request, ("foxglove.sdk.v1",))
        except RequestRefusedError as refused:
            assert 400 <= refused.status < 500


@pytest.mark.parametrize("name", ["Sec-WebSocket-Key", "Sec-WebSocket-Version", "Sec-WebSocket-Protocol"])
def test_a_handshake_that_lacks_a_header_is_refused(name: str) -> None:
    headers = {key: value for key, value in HANDSHAKE.items() if key != name}
    assert make_handshake(parse_request(make_head(HANDSHAKE)), ("foxglove.sdk.v1",))
    with pytest.raises(RequestRefusedError):
        make_handshake(parse_request(make_head(headers)), ("foxglove.sdk.v1",))


def test_a_handshake_is_answered_as_in_rfc_6455() -> None:
    """Section 1.3 has the key and its answer."""
    headers = {**HANDSHAKE, "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Protocol": "x, b, a"}
    answer = make_handshake(parse_request(make_head(headers)), ("a", "b"))
    assert b"Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n" in answer
    assert b"Sec-WebSocket-Protocol: a\r\n" in answer


def read(data: bytes) -> tuple[Opcode, bytes]:
    async def run() -> tuple[Opcode, bytes]:
        reader = asyncio.StreamReader()
        reader.feed_data(data)
        reader.feed_eof()
        return await read_frame(reader, 10.0)

    return asyncio.run(run())


def test_frames_are_read_as_in_rfc_6455() -> None:
    """Section 5.7 has the first one."""
    assert read(bytes.fromhex("818537fa213d7f9f4d5158")) == (Opcode.TEXT, b"Hello")
    assert read(b"\x88\x80abcd") == (Opcode.CLOSE, b"")
    assert read(b"\x82\xfe\x00\x7e" + bytes(4) + b"x" * 126) == (Opcode.BINARY, b"x" * 126)


@pytest.mark.fault(98)
@pytest.mark.parametrize(
    "data",
    [
        b"\x81\x05Hello",  # not masked
        b"\x01\x85" + bytes(9),  # the first of several parts
        b"\x80\x85" + bytes(9),  # a later part
        b"\xc1\x85" + bytes(9),  # a reserved bit
        b"\x83\x85" + bytes(9),  # a kind that does not exist
        b"\x89\xfe\x00\x7e" + bytes(130),  # a ping that is too long
        b"\x81\xff" + (LARGEST + 1).to_bytes(8, "big") + bytes(8),
        b"\x81\xff" + b"\xff" * 8 + bytes(8),
    ],
)
def test_98_a_frame_that_breaks_the_protocol_is_refused_before_it_is_read(data: bytes) -> None:
    with pytest.raises(WebSocketError):
        read(data)


@given(st.binary(max_size=64))
def test_any_bytes_are_a_frame_or_refused(data: bytes) -> None:
    with suppress(WebSocketError, asyncio.IncompleteReadError):
        assert len(read(data)[1]) < len(data)
