"""Sections of the connections: hand-over, frame, source, clock, daemon, security, check and relay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from ipaddress import ip_network
from pathlib import PurePath
from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.document import MAX_PATH_LENGTH, MAX_URL_LENGTH, ConfigProblem, Position, Section


class HandOverConfig(Section, frozen=True, kw_only=True):
    """Requests to the vehicle; nothing here arms: that takes `--arm --takeoff`."""

    answer_s: Annotated[
        float, Meta(ge=0.2, le=10, description="a request that shows no effect is repeated after this time [s]")
    ] = 1.0
    retry_s: Annotated[
        float, Meta(ge=0.2, le=10, description="a request that was refused for now is repeated after this time [s]")
    ] = 2.0
    tries: Annotated[int, Meta(ge=1, le=100, description="times that one request is made at most")] = 30
    ground_s: Annotated[
        float,
        Meta(
            le=600,
            ge=0.1,
            description="time that the vehicle and the positions are given to get ready, and then the mode, and then "
            "arming [s]",
        ),
    ] = 60.0
    fresh_s: Annotated[
        float, Meta(le=5, ge=0.001, description="nothing is armed while the newest position is older than this [s]")
    ] = 1.0
    climb_s: Annotated[
        float, Meta(le=120, ge=0.1, description="time for the vehicle's own climb; then it is asked to land [s]")
    ] = 20.0
    reached: Annotated[
        float, Meta(le=1, ge=0.01, description="share of the take-off height at which the climb counts as done")
    ] = 0.9
    engage_s: Annotated[
        float,
        Meta(
            le=60, ge=0.1, description="time for the external mode in the air; after a take-off, then it must land [s]"
        ),
    ] = 5.0
    land_s: Annotated[
        float, Meta(le=600, ge=0.1, description="time from the landing mode to disarmed, after a take-off of ours [s]")
    ] = 60.0
    disarm_s: Annotated[
        float, Meta(le=60, ge=0.1, description="a vehicle that has landed and stays armed so long is disarmed [s]")
    ] = 5.0
    origin_deg_m: Annotated[
        Position,
        Meta(
            description="latitude, longitude [deg] and altitude [m] told to an ArduPilot that flies by external "
            "positions and knows no place on the globe, before arming; any will do indoors"
        ),
    ] = (47.397742, 8.545594, 488.0)


@dataclass(frozen=True)
class CameraSystem:
    """A camera system that is listened to without a bridge to MAVLink."""

    camera: str  # `module:Class` of its `uavctl.io.camera.Camera`, made with the body's name and the axis that is up
    package: str  # package that it imports beyond ours; empty for none
    extra: str  # our optional dependency group that installs the package
    port: int  # of its server, if a URL names none; 0: a URL has to
    advice: str  # what to check if no answer comes
    up: Literal["y", "z"] = "y"  # the vertical axis without a statement in the URL


# By the scheme of their URLs, SCHEME://SERVER[:PORT]/BODY.
CAMERA_SYSTEMS = {
    "natnet": CameraSystem(
        camera="uavctl.io.natnet:NatNet",
        package="natnet",
        extra="optitrack",
        port=1510,  # Motive's own default
        advice="does Motive run there, is NatNet enabled in its streaming settings, and does no firewall block it?",
    ),
    "qualisys": CameraSystem(
        camera="uavctl.io.qualisys:Qualisys",
        package="qtm_rt",
        extra="qualisys",
        port=22223,  # QTM's little-endian port
        advice="does QTM run there, with a measurement or its preview, and does no firewall block TCP 22223?",
        up="z",
    ),
}
SOURCE_GROUP = "uavctl.sources"  # entry points of those of other packages
_TRANSPORTS = ("udpin", "udpout", "tcp", "serial")  # MAVLink as it is
CAMERA_SYSTEM_ID, CAMERA_MESSAGE = 246, "ODOMETRY"  # as what their positions come to the controller


def parse_camera_scheme(url: str) -> str:
    """Return the scheme of a camera system's URL; empty if it is no camera system's.

    That of another package is the name of its entry point `uavctl.sources`, or its `module:Class`.
    """
    scheme, separator, _ = url.partition("://")
    if not separator or scheme in _TRANSPORTS:
        return ""
    return scheme if scheme in CAMERA_SYSTEMS or ":" in scheme or entry_points(group=SOURCE_GROUP, name=scheme) else ""


def get_camera_system(scheme: str) -> CameraSystem:
    """Return a camera system by the scheme of its URLs."""
    if scheme in CAMERA_SYSTEMS:
        return CAMERA_SYSTEMS[scheme]
    camera = next((entry_point.value for entry_point in entry_points(group=SOURCE_GROUP, name=scheme)), scheme)
    return CameraSystem(camera=camera, package="", extra="", port=0, advice="does the server run there?")


class FrameConfig(Section, frozen=True, kw_only=True):
    """Camera frame to local NED."""

    convention: Annotated[Literal["ned", "enu"], Meta(description="axes of the source's positions")] = "ned"
    origin_m: Annotated[Position, Meta(description="position of the camera frame's origin in local NED [m]")] = (
        0.0,
        0.0,
        0.0,
    )
    yaw_deg: Annotated[
        float,
        Meta(
            ge=-180, le=180, description="heading of the camera frame's first axis (after conversion to NED axes) [deg]"
        ),
    ] = 0.0


class SourceConfig(Section, frozen=True, kw_only=True):
    """Messages that count as external positions."""

    messages: Annotated[
        tuple[
            Literal[
                "VISION_POSITION_ESTIMATE", "VICON_POSITION_ESTIMATE", "ATT_POS_MOCAP", "ODOMETRY", "LOCAL_POSITION_NED"
            ],
            ...,
        ],
        Meta(
            min_length=1,
            max_length=10,
            description="messages that are taken; LOCAL_POSITION_NED is the vehicle's own estimate only if named",
        ),
    ] = ("VISION_POSITION_ESTIMATE", "VICON_POSITION_ESTIMATE", "ATT_POS_MOCAP", "ODOMETRY")
    system_id: Annotated[
        int, Meta(ge=0, le=255, description="MAVLink system id that positions must come from; 0 takes any")
    ] = 0
    rate_hz: Annotated[
        float,
        Meta(
            ge=0,
            le=1000,
            description="positions a second that the design counts on; 0 counts on one position each Δt [1/s]",
        ),
    ] = 0.0


class ClockConfig(Section, frozen=True, kw_only=True):
    """The source's clock."""

    latency_s: Annotated[
        float,
        Meta(ge=0, le=60, description="smallest delay from capture to arrival, when the peer answers no TIMESYNC [s]"),
    ] = 0.0
    window_s: Annotated[
        float, Meta(ge=0.001, le=600, description="window of the sliding minimum of (received − stamp) [s]")
    ] = 10.0
    future_tolerance_s: Annotated[
        float, Meta(ge=0, le=60, description="a stamp further in the future is refused [s]")
    ] = 0.02


class DaemonConfig(Section, frozen=True, kw_only=True):
    """The control loop and its connections."""

    tick_s: Annotated[float, Meta(le=0.1, ge=0.001, description="time between setpoints; divides Δt [s]")]
    vehicle: Annotated[str, Meta(max_length=MAX_URL_LENGTH, description="URL of the vehicle")] = "udpin://0.0.0.0:14540"
    mocap: Annotated[
        str,
        Meta(
            max_length=MAX_URL_LENGTH,
            description="URL of the source of positions; the same URL as the vehicle's is one connection. "
            "`natnet://SERVER/BODY` is a rigid body of an OptiTrack system, `qualisys://SERVER/BODY` one of Qualisys "
            "(docs/sources.md), `NAME://SERVER:PORT/BODY` one of another package, by its entry point `uavctl.sources` "
            "or as `module:Class` (docs/extending.md)",
        ),
    ] = "udpin://0.0.0.0:14560"
    vehicle_system_id: Annotated[
        int, Meta(ge=0, le=255, description="MAVLink system id of the vehicle; 0 takes the first one that is heard")
    ] = 0
    vehicle_component_id: Annotated[
        int,
        Meta(
            ge=0,
            le=255,
            description="MAVLink component id of the vehicle's autopilot; 0 takes any, and 1 rather than another",
        ),
    ] = 0
    system_id: Annotated[int, Meta(ge=1, le=255, description="MAVLink system id of the daemon")] = 245
    component_id: Annotated[int, Meta(ge=1, le=255, description="MAVLink component id of the daemon (25 = user 1)")] = (
        25
    )
    radio_channels: Annotated[
        bool, Meta(description="ask the vehicle for RC_CHANNELS, which show whether a pilot moves a stick")
    ] = True
    parameters: Annotated[
        bool, Meta(description="ask the vehicle for all its parameters before it is armed, for the recording")
    ] = True


MOCAP_LINK = 1  # its link id is that of the vehicle's connection plus this


class SecurityConfig(Section, frozen=True, kw_only=True):
    """Signing of MAVLink 2, allow-list and budgets of the UDP connections."""

    key_file: Annotated[
        str,
        Meta(
            max_length=MAX_PATH_LENGTH,
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


def check_security(security: SecurityConfig) -> Iterator[ConfigProblem]:
    """All problems of `[security]`."""
    path = security.key_file
    if path and not (PurePath(path).is_absolute() or path.startswith("~")):
        yield ConfigProblem(
            "security.key_file", f'"{path}" depends on where the command is run', "begin it with / or ~"
        )
    for i, text in enumerate(security.allow):
        try:
            ip_network(text, strict=False)
        except ValueError:
            yield ConfigProblem(
                f"security.allow[{i}]",
                f'"{text}" is no address or network (names are not looked up)',
                "give numbers, as in 192.168.7.20 or 192.168.7.0/24",
            )


def find_security_warnings(security: SecurityConfig, daemon: DaemonConfig) -> tuple[str, ...]:
    """Return warnings of what a valid configuration leaves open to strangers; for people, before a flight."""
    urls = {"vehicle": daemon.vehicle, "mocap": daemon.mocap}
    if daemon.vehicle == daemon.mocap:
        del urls["mocap"]
    names_by_text: dict[str, list[str]] = {}
    for name, url in urls.items():
        is_signed = bool(security.key_file) and name in security.require
        if url.startswith("udpin:") and not security.allow:
            names_by_text.setdefault("any address may send; list the peers in security.allow", []).append(name)
        if url.startswith("udp") and not is_signed:
            names_by_text.setdefault("not signed, so an address can be forged; see security.key_file", []).append(name)
        if parse_camera_scheme(url):
            names_by_text.setdefault(
                f"{url} has no signatures, so an address can be forged; see docs/sources.md", []
            ).append(name)
    return tuple(f"{', '.join(names)}: {text}" for text, names in names_by_text.items())


def check_roles(daemon: DaemonConfig) -> Iterator[ConfigProblem]:
    """Check that a camera system is not given as the vehicle."""
    if parse_camera_scheme(daemon.vehicle):
        yield ConfigProblem("daemon.vehicle", f'"{daemon.vehicle}" is a camera system', "give it as daemon.mocap")


def check_source(daemon: DaemonConfig, source: SourceConfig) -> Iterator[ConfigProblem]:
    """Check that a camera system's positions are among those that count."""
    if not parse_camera_scheme(daemon.mocap):
        return
    if CAMERA_MESSAGE not in source.messages:
        yield ConfigProblem(
            "source.messages", f"leaves out {CAMERA_MESSAGE}, which {daemon.mocap} comes as", f'add "{CAMERA_MESSAGE}"'
        )
    if source.system_id not in (0, CAMERA_SYSTEM_ID):
        yield ConfigProblem(
            "source.system_id",
            f"{source.system_id} is another system than the cameras of daemon.mocap, {CAMERA_SYSTEM_ID}",
            f"give {CAMERA_SYSTEM_ID}, or 0",
        )


def check_signing(daemon: DaemonConfig, security: SecurityConfig) -> Iterator[ConfigProblem]:
    """Check that no signatures are asked of a camera system, which cannot sign."""
    if parse_camera_scheme(daemon.mocap) and security.key_file and "mocap" in security.require:
        yield ConfigProblem(
            "security.require",
            f'"mocap" cannot be: {daemon.mocap} has no signatures',
            'write require = ["vehicle"], and keep the cameras\' network to itself',
        )


MAX_REHEARSALS = 1000  # minutes, and some 400 MB for draws and states of two minutes each


class CheckConfig(Section, frozen=True, kw_only=True):
    """`uavctl check`, and what it has to say before `uavctl fly --arm` arms (docs/check.md)."""

    seconds: Annotated[
        float, Meta(le=600, ge=0.001, description="how long positions and vehicle are listened to [s]")
    ] = 8.0
    wait_s: Annotated[
        float,
        Meta(
            ge=0,
            le=600,
            description="how much longer, if the vehicle has no position of its own yet: its estimator may be starting "
            "[s]",
        ),
    ] = 15.0
    same_origin: Annotated[
        bool,
        Meta(
            description="the vehicle's own position counts from the same origin as the cameras' after [frame]; `false` "
            "if it counts from where it was switched on: then only its movements are compared"
        ),
    ] = True
    offset_m: Annotated[
        float,
        Meta(ge=0.001, le=1e6, description="largest distance between the vehicle's own position and the cameras' [m]"),
    ] = 0.5
    move_m: Annotated[
        float, Meta(ge=0.001, le=1000, description="shortest movement of the body that shows axes [m]")
    ] = 0.3
    yaw_deg: Annotated[
        float, Meta(le=45, ge=0.01, description="largest turn between the cameras' north and the vehicle's [deg]")
    ] = 10.0
    margin_m: Annotated[
        float,
        Meta(ge=0, le=1000, description="how far outside the limits of `sets` a vehicle may stand before a flight [m]"),
    ] = 0.25
    rehearsals: Annotated[
        int,
        Meta(
            ge=0,
            le=MAX_REHEARSALS,
            description="flights that are rehearsed with disturbances and losses, for the probability that one leaves "
            "the room; 0 rehearses none",
        ),
    ] = 60
    battery_v: Annotated[
        float, Meta(ge=0, le=1000, description="least voltage of the battery; 0 does not judge it [V]")
    ] = 0.0
    accept: Annotated[
        tuple[str, ...],
        Meta(
            max_length=100,
            description="names of items that may fail: they are told, and arming is not refused for them",
        ),
    ] = ()


class RelayConfig(Section, frozen=True, kw_only=True):
    """External positions, passed on to the vehicle's own estimator on the vehicle's link (docs/check.md)."""

    enabled: Annotated[bool, Meta(description="pass positions on")] = False
    message: Annotated[
        Literal["vision-position-estimate", "odometry"],
        Meta(description="as which MAVLink message, in local NED; PX4 and ArduPilot take both"),
    ] = "vision-position-estimate"
    vehicle_time: Annotated[
        bool,
        Meta(
            description="a vehicle that asks for our time (PX4) gets that of its own clock, in which positions are "
            "stamped; else it gets ours, and moves their stamps by the offset that it finds"
        ),
    ] = True
    rate_hz: Annotated[
        float, Meta(ge=0.1, le=1000, description="at most so many a second; the newest are sent [1/s]")
    ] = 50.0
