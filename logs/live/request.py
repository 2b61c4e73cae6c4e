"""Requests to the live view: how they are read, and which of them are refused."""

from __future__ import annotations

import hmac
import re
from dataclasses import dataclass
from http import HTTPStatus

import msgspec

ORDERS = "/orders"  # GET: vehicles that take orders; POST: an order
TOKEN_HEADER = "x-uavctl-token"
MAX_BODY_BYTES = 4096  # of an order; a name and three numbers have some hundred
HISTORY = "/history"
_PAGES = ("/", "/live.js", "/scenes", HISTORY, ORDERS)
_LOCAL_HOST = re.compile(r"(localhost|127\.0\.0\.1)(:[0-9]{1,5})?", re.IGNORECASE)
_OWN_SITE = ("same-origin", "none")  # values of Sec-Fetch-Site: a page of ours, or a user's own request
_HEADER_NAME = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")


@dataclass(frozen=True)
class RequestRefusedError(Exception):
    """A request that is refused, with the status and the reason of the answer."""

    status: HTTPStatus
    reason: str


class LiveAccess(msgspec.Struct, frozen=True):
    """What a live view permits, and to whom."""

    view_token: str  # path by which pages of other sites may open the WebSocket
    order_token: str = ""  # of pages that may give orders
    sockets: dict[str, str] = {}  # path of the control socket by name of the vehicle; empty: no orders are taken


@dataclass(frozen=True)
class Request:
    """Head of an HTTP request; the names of its headers are in lower case."""

    method: str
    path: str
    headers: dict[str, str]

    @property
    def asks_for_websocket(self) -> bool:
        """Whether the connection is to become a WebSocket."""
        return self.headers.get("upgrade", "").lower() == "websocket"


def parse_request(head: bytes) -> Request:
    """Read the head of a request; values of a header that comes twice are joined by a comma.

    Raises:
        RequestRefusedError: It is not HTTP.
    """
    first, *lines = head.decode("latin-1").rstrip("\r\n").split("\r\n")
    words = first.split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        raise RequestRefusedError(HTTPStatus.BAD_REQUEST, "this is not HTTP 1")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if not colon or not _HEADER_NAME.fullmatch(name):
            raise RequestRefusedError(HTTPStatus.BAD_REQUEST, "a header has no name")
        name, value = name.lower(), value.strip(" \t")
        headers[name] = f"{headers[name]}, {value}" if name in headers else value
    return Request(words[0], words[1], headers)


def check_request(request: Request, access: LiveAccess) -> None:
    """Check that a request comes from this machine, not from the page of another site, and reads or may give orders.

    Host is the name by which the browser knows the server: another site may let its own name lead to this machine.
    Origin is the site whose page asks; programs that are no browsers send none. A browser sends none either where the
    page cannot read the answer, as of a picture; such a page could take all places. Sec-Fetch-Site shows the origin.

    Raises:
        RequestRefusedError: It is refused.
    """
    host = request.headers.get("host", "")
    if not _LOCAL_HOST.fullmatch(host):
        raise RequestRefusedError(
            HTTPStatus.FORBIDDEN, "ask by the name localhost or 127.0.0.1; other names are refused"
        )
    if request.method == "POST" and request.path == ORDERS and access.sockets:
        _check_order(request, host, access)
        return
    if request.method != "GET":
        raise RequestRefusedError(HTTPStatus.METHOD_NOT_ALLOWED, "nothing can be written here; GET alone is allowed")
    origin = request.headers.get("origin")
    is_same_site = (origin is None or _is_own_origin(origin, host)) and (
        request.headers.get("sec-fetch-site", "none") in _OWN_SITE
    )
    has_token = request.asks_for_websocket and _are_equal(request.path, f"/{access.view_token}")
    if not is_same_site and not has_token:
        raise RequestRefusedError(
            HTTPStatus.FORBIDDEN, "pages of other sites are refused; the address with the token is on the console"
        )
    paths = ("/", f"/{access.view_token}") if request.asks_for_websocket else _PAGES
    if request.path not in paths:
        raise RequestRefusedError(HTTPStatus.NOT_FOUND, "there is no such page")


def may_order(request: Request, access: LiveAccess) -> bool:
    """Return whether a request has the token of orders."""
    token = request.headers.get(TOKEN_HEADER, "")
    return bool(access.sockets and access.order_token) and _are_equal(token, access.order_token)


def _check_order(request: Request, host: str, access: LiveAccess) -> None:
    """Check that an order comes from this page, which has the token.

    The header of the token and the type of the content are such that a browser asks this server first, by OPTIONS,
    before it sends them for the page of another site; that is refused.
    """
    headers = request.headers
    if not _is_own_origin(headers.get("origin", ""), host) or headers.get("sec-fetch-site", "same-origin") != (
        "same-origin"
    ):
        raise RequestRefusedError(HTTPStatus.FORBIDDEN, "orders are taken from this page alone (Host and Origin)")
    if not may_order(request, access):
        raise RequestRefusedError(
            HTTPStatus.FORBIDDEN, "this page only shows; to give orders open the address on the console, with its token"
        )
    if headers.get("content-type", "") != "application/json":
        raise RequestRefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "an order is application/json")
    length = headers.get("content-length", "")
    if not re.fullmatch("[0-9]{1,6}", length) or "transfer-encoding" in headers:
        raise RequestRefusedError(HTTPStatus.LENGTH_REQUIRED, "an order has a Content-Length")
    if int(length) > MAX_BODY_BYTES:
        raise RequestRefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"an order has at most {MAX_BODY_BYTES} bytes")


def _is_own_origin(origin: str, host: str) -> bool:
    return origin.lower() == f"http://{host.lower()}"


def _are_equal(given: str, secret: str) -> bool:
    """Return whether two texts are equal, after a time that does not depend on where they differ."""
    return hmac.compare_digest(given.encode(), secret.encode())
