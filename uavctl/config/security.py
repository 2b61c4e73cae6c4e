"""Who is believed: signing, and the addresses that are listened to."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import ip_network
from pathlib import PurePath
from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.peers import CAMERAS, DaemonConfig
from uavctl.config.problem import Problem
from uavctl.config.section import LONGEST_PATH, Section

MOCAP_LINK = 1  # its link id is that of the vehicle's connection plus this


class SecurityConfig(Section, frozen=True, kw_only=True):
    """Signing of MAVLink 2, allow-list and budgets of the UDP connections."""

    key_file: Annotated[
        str,
        Meta(
            max_length=LONGEST_PATH,
            description="file of the signing key, from `/` or `~` on, readable by its owner only (`uavctl key new` "
            "makes one); empty neither signs nor verifies",
        ),
    ] = ""
    require: Annotated[
        tuple[Literal["vehicle", "mocap"], ...],
        Meta(
            min_length=1,
            max_length=2,
            description="connections on which, with a key, only signed frames are taken and ours are signed; one for "
            'both roles is the "vehicle"',
        ),
    ] = ("vehicle", "mocap")
    link_id: Annotated[
        int, Meta(ge=0, le=254, description="our link id on the vehicle's connection; the cameras' is one more")
    ] = 0
    peer_link_ids: Annotated[
        tuple[Annotated[int, Meta(ge=0, le=255)], ...],
        Meta(max_length=256, description="link ids that peers may sign with; none takes the first that each one uses"),
    ] = ()
    allow: Annotated[
        tuple[str, ...],
        Meta(
            max_length=1000,
            description="addresses and networks that UDP datagrams are taken from, as in "
            '`["192.168.7.20", "10.0.0.0/24"]`; none takes anybody\'s',
        ),
    ] = ()
    max_datagrams_per_s: Annotated[
        int,
        Meta(
            ge=100,
            le=1_000_000,
            description="datagrams a second that are taken of one sender (address and port), and of all strangers "
            "together; of the vehicle four times as many. UDP only [1/s]",
        ),
    ] = 2000
    max_frames_per_s: Annotated[
        int,
        Meta(
            ge=100,
            le=1_000_000,
            description="the same for the frames in them, counted before any checksum or hash is taken [1/s]",
        ),
    ] = 800
    max_bytes_per_s: Annotated[int, Meta(ge=10_000, le=1_000_000_000, description="the same for their bytes [1/s]")] = (
        200_000
    )


def check(security: SecurityConfig) -> Iterator[Problem]:
    """All problems of `[security]`."""
    path = security.key_file
    if path and not (PurePath(path).is_absolute() or path.startswith("~")):
        yield Problem("security.key_file", f'"{path}" depends on where the command is run', "begin it with / or ~")
    for i, text in enumerate(security.allow):
        try:
            ip_network(text, strict=False)
        except ValueError:
            yield Problem(
                f"security.allow[{i}]",
                f'"{text}" is no address or network (names are not looked up)',
                "give numbers, as in 192.168.7.20 or 192.168.7.0/24",
            )


def warnings(security: SecurityConfig, daemon: DaemonConfig) -> tuple[str, ...]:
    """What is open to strangers in a configuration that is not wrong; for people, before a flight."""
    urls = {"vehicle": daemon.vehicle, "mocap": daemon.mocap}
    if daemon.vehicle == daemon.mocap:
        del urls["mocap"]
    found = []
    for name, url in urls.items():
        signed = bool(security.key_file) and name in security.require
        if url.startswith("udpin:") and not security.allow:
            found.append(f"{name}: {url} listens to any address; list the peers in security.allow")
        if url.startswith("udp") and not signed:
            found.append(f"{name}: {url} is not signed, so a sender's address can be forged; see security.key_file")
        if url.startswith(CAMERAS):
            found.append(f"{name}: {url} has no signatures, so a sender's address can be forged; see docs/sources.md")
    return tuple(found)
