"""Sources of the positions of several vehicles: the bodies of one server or port share a connection.

A URL names a body: that of a camera system by its name, one of MAVLink by its system id, as udpin://HOST:PORT/11.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from uavctl.config.connections import CAMERA_SYSTEM_ID, parse_camera_scheme
from uavctl.errors import ConnectionSpecError
from uavctl.io.camera_host import COMPONENT_ID
from uavctl.io.camera_url import parse_camera_url

_MAVLINK_BODY = re.compile(r"(?P<connection>\w+://.*:\d+)/(?P<body>.*)", re.DOTALL)
ANY = 0


@dataclass(frozen=True)
class SharedSource:
    """A connection, and the vehicles whose positions it gives."""

    urls: tuple[str, ...]  # one for each body of a camera system; else the connection's alone
    is_camera: bool  # a camera system, not MAVLink
    addresses: dict[int, tuple[int, int]]  # system and component of each vehicle's positions; `ANY` takes all

    @property
    def url(self) -> str:
        """URL for people."""
        return ", ".join(self.urls)


def split_source_url(url: str) -> tuple[object, str]:
    """Return what URLs of one connection have in common, and the body; empty for all that a port of MAVLink gives.

    Raises:
        ConnectionSpecError: the URL names no body as it has to.
    """
    if parse_camera_scheme(url):
        camera_url = parse_camera_url(url)
        return replace(camera_url, body=""), camera_url.body
    match = _MAVLINK_BODY.fullmatch(url)
    if match is None:
        return url, ""
    connection, body = match["connection"], match["body"]
    if not body.isdecimal() or not 1 <= int(body) <= 255:
        raise ConnectionSpecError(f"connection {url!r}: {body!r} is no MAVLink system id; write {connection}/1 to /255")
    return connection, str(int(body))


def find_shared_sources(urls: Sequence[str]) -> tuple[SharedSource, ...]:
    """Return the connections for the sources of vehicles, in order of their first vehicle.

    Raises:
        ConnectionSpecError: a URL names no body as it has to.
    """
    numbers_by_connection: dict[object, list[int]] = {}
    bodies: list[str] = []
    for number, url in enumerate(urls):
        connection, body = split_source_url(url)
        numbers_by_connection.setdefault(connection, []).append(number)
        bodies.append(body)
    sources = []
    for connection, numbers in numbers_by_connection.items():
        if isinstance(connection, str):
            addresses = {number: (int(bodies[number] or ANY), ANY) for number in numbers}
            sources.append(SharedSource((connection,), is_camera=False, addresses=addresses))
        else:
            addresses = {number: (CAMERA_SYSTEM_ID, COMPONENT_ID + index) for index, number in enumerate(numbers)}
            sources.append(SharedSource(tuple(urls[number] for number in numbers), is_camera=True, addresses=addresses))
    return tuple(sources)
