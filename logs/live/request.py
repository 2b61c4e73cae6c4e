"""Requests to the live view: how they are read, and which of them are refused."""

from __future__ import annotations

import hmac
import re
from dataclasses import dataclass
from http import HTTPStatus

_LOCAL_HOST = re.compile(r"(localhost|127\.0\.0\.1)(:[0-9]{1,5})?", re.IGNORECASE)
_OWN_SITE = ("same-origin", "none")  # values of Sec-Fetch-Site: a page of ours, or a user's own request
_HEADER_NAME = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")


@dataclass(frozen=True)
class RequestRefusedError(Exception):
    """A request that is refused, with the status and the reason of the answer."""

    status: HTTPStatus
    reason: str


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


def check_request(request: Request, token: str) -> None:
    """Check that a request only reads, and comes from this machine and not from the page of another site.

    Host is the name by which the browser knows the server: another site may let its own name lead to this machine.
    Origin is the site whose page asks; programs that are no browsers send none. A browser sends none either where the
    page cannot read the answer, as of a picture; such a page could take all places. Sec-Fetch-Site shows the origin.

    Args:
        token: A WebSocket with this path may be opened by the page of any site, as its user has entered the token.

    Raises:
        RequestRefusedError: It is refused.
    """
    host = request.headers.get("host", "")
    if not _LOCAL_HOST.fullmatch(host):
        raise RequestRefusedError(
            HTTPStatus.FORBIDDEN, "ask by the name localhost or 127.0.0.1; other names are refused"
        )
    if request.method != "GET":
        raise RequestRefusedError(HTTPStatus.METHOD_NOT_ALLOWED, "nothing can be written here; GET alone is allowed")
    origin = request.headers.get("origin")
    is_same_site = (origin is None or origin.lower() == f"http://{host.lower()}") and (
        request.headers.get("sec-fetch-site", "none") in _OWN_SITE
    )
    has_token = request.asks_for_websocket and hmac.compare_digest(request.path.encode(), f"/{token}".encode())
    if not is_same_site and not has_token:
        raise RequestRefusedError(
            HTTPStatus.FORBIDDEN, "pages of other sites are refused; the address with the token is on the console"
        )
    paths = ("/", f"/{token}") if request.asks_for_websocket else ("/", "/live.js", "/scenes")
    if request.path not in paths:
        raise RequestRefusedError(HTTPStatus.NOT_FOUND, "there is no such page")
