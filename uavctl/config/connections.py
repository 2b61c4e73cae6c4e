"""Sections of the connections: hand-over, frame, source, clock, daemon, security, check and relay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from ipaddress import ip_network
from pathlib import PurePath
from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.document import MAX_PATH_LENGTH, MAX_URL_LENGTH, ConfigProblem, Position, Section, declare

MAX_LATENCY_S = 2.0  # no camera system is slower; 3 ms in milliseconds is above it


class HandOverConfig(Section, frozen=True, kw_only=True):
    """Requests to the vehicle (docs/hand-over.md); only `--arm` arms."""

    answer_s: Annotated[float, declare("time until a request without an effect is repeated", "s", 0.2, 10)] = 1.0
    retry_s: Annotated[float, declare("time until a request refused for now is repeated", "s", 0.2, 10)] = 2.0
    tries: Annotated[int, declare("most tries of one request", "", 1, 100)] = 30
    ground_s: Annotated[float, declare("longest wait for positions, mode, arming", "s", 0.1, 600)] = 60.0
    fresh_s: Annotated[float, declare("greatest age of the newest position at arming", "s", 0.001, 5)] = 1.0
    climb_s: Annotated[float, declare("longest climb by the vehicle; then it must land", "s", 0.1, 120)] = 20.0
    reached: Annotated[float, declare("share of the take-off height that ends the climb", "", 0.01, 1)] = 0.9
    engage_s: Annotated[
        float, declare("longest wait for the external mode in the air; after our take-off it then lands", "s", 0.1, 60)
    ] = 5.0
    land_s: Annotated[float, declare("longest landing after our take-off, until disarmed", "s", 0.1, 600)] = 60.0
    disarm_s: Annotated[float, declare("time after which a landed vehicle is disarmed", "s", 0.1, 60)] = 5.0
    origin_deg_m: Annotated[
        Position,
        declare("latitude, longitude [deg], altitude [m] of the origin of an ArduPilot without GPS; any place"),
    ] = (47.397742, 8.545594, 488.0)


@dataclass(frozen=True)
class CameraSystem:
    """A camera system that is listened to without a bridge to MAVLink."""

    camera: str  # `module:Class` of its `uavctl.io.camera.Camera`, made with the body's name and the axis that is up
    package: str  # package that it imports beyond ours; empty for none
    extra: str  # our optional dependency group that installs the package
    port: int  # of its server, if a URL names none; 0: a URL has to
    advice: str  # hint if no answer comes
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
    "ros2": CameraSystem(  # a topic: its URL has no server, see `uavctl.io.ros2_url`
        camera="",
        package="rclpy",
        extra="ros2",
        port=0,
        advice="does the driver run and see the body, with our ROS_DOMAIN_ID, and does discovery reach it?",
        up="z",
    ),
}
SOURCE_GROUP = "uavctl.sources"  # entry points of those of other packages
_TRANSPORTS = ("udpin", "udpout", "tcp", "serial")  # MAVLink as it is
CAMERA_SYSTEM_ID, CAMERA_MESSAGE = 246, "ODOMETRY"  # message of their positions


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

    convention: Annotated[Literal["ned", "enu"], declare("axes of the source's positions")] = "ned"
    origin_m: Annotated[Position, declare("position of the camera frame's origin in local NED", "m")] = (0.0, 0.0, 0.0)
    yaw_deg: Annotated[float, declare("heading of the camera frame's first axis, in NED axes", "deg", -180, 180)] = 0.0


class SourceConfig(Section, frozen=True, kw_only=True):
    """Messages that count as external positions."""

    messages: Annotated[
        tuple[
            Literal[
                "VISION_POSITION_ESTIMATE", "VICON_POSITION_ESTIMATE", "ATT_POS_MOCAP", "ODOMETRY", "LOCAL_POSITION_NED"
            ],
            ...,
        ],
        declare("accepted messages; LOCAL_POSITION_NED is the vehicle's own estimate", length=(1, 10)),
    ] = ("VISION_POSITION_ESTIMATE", "VICON_POSITION_ESTIMATE", "ATT_POS_MOCAP", "ODOMETRY")
    system_id: Annotated[int, declare("MAVLink system id that positions must come from; 0 takes any", "", 0, 255)] = 0
    rate_hz: Annotated[float, declare("positions that the design counts on; 0: one each Δt", "1/s", 0, 1000)] = 0.0
    report: Annotated[
        bool, declare("report the stamp of each newest position to its sender, by a PING of that time")
    ] = False


class ClockConfig(Section, frozen=True, kw_only=True):
    """Clock of the source (docs/check.md)."""

    latency_s: Annotated[
        float, declare("least delay of a position, for a peer without TIMESYNC", "s", 0, MAX_LATENCY_S)
    ] = 0.0
    window_s: Annotated[float, declare("window of the sliding minimum of (received − stamp)", "s", 0.001, 600)] = 10.0
    future_tolerance_s: Annotated[float, declare("a stamp further in the future is refused", "s", 0, 60)] = 0.02


class DaemonConfig(Section, frozen=True, kw_only=True):
    """Control loop and connections."""

    tick_s: Annotated[float, declare("time between setpoints; divides Δt", "s", 0.001, 0.1)]
    vehicle: Annotated[str, declare("URL of the vehicle", length=MAX_URL_LENGTH)] = "udpin://0.0.0.0:14540"
    mocap: Annotated[
        str, declare("URL of the positions (docs/sources.md); may be the vehicle's", length=MAX_URL_LENGTH)
    ] = "udpin://0.0.0.0:14560"
    vehicle_system_id: Annotated[int, declare("system id of the vehicle; 0: the first one heard", "", 0, 255)] = 0
    vehicle_component_id: Annotated[int, declare("component id of the autopilot; 0: any, preferably 1", "", 0, 255)] = 0
    system_id: Annotated[int, declare("MAVLink system id of the daemon", "", 1, 255)] = 245
    component_id: Annotated[int, declare("MAVLink component id of the daemon (25 = user 1)", "", 1, 255)] = 25
    radio_channels: Annotated[bool, declare("ask for RC_CHANNELS, which show the pilot's sticks")] = True
    parameters: Annotated[bool, declare("ask for all parameters before arming, for the recording")] = True


MOCAP_LINK = 1  # its link id is that of the vehicle's connection plus this


class SecurityConfig(Section, frozen=True, kw_only=True):
    """Signing, permitted senders and budgets (docs/security.md)."""

    key_file: Annotated[
        str, declare("file of the signing key, absolute or from `~`; empty: nothing is signed", length=MAX_PATH_LENGTH)
    ] = ""
    require: Annotated[
        tuple[Literal["vehicle", "mocap"], ...],
        declare(
            "connections that must be signed, if there is a key; one connection for both is `vehicle`", length=(1, 2)
        ),
    ] = ("vehicle", "mocap")
    link_id: Annotated[int, declare("link id of the vehicle's connection; the cameras' is one more", "", 0, 254)] = 0
    peer_link_ids: Annotated[
        tuple[Annotated[int, Meta(ge=0, le=255)], ...],
        declare("link ids that peers may sign with; empty: the first of each", length=256),
    ] = ()
    allow: Annotated[
        tuple[str, ...], declare("permitted senders of UDP, as `10.0.0.0/24`; empty: any", length=1000)
    ] = ()
    max_datagrams_per_s: Annotated[
        int, declare("UDP datagrams a second of one sender; the vehicle has four times as many", "1/s", 100, 1_000_000)
    ] = 2000
    max_frames_per_s: Annotated[int, declare("frames a second, likewise", "1/s", 100, 1_000_000)] = 800
    max_bytes_per_s: Annotated[int, declare("bytes a second, likewise", "1/s", 10_000, 1_000_000_000)] = 200_000


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
    """Return warnings of access that a valid configuration leaves to strangers; for people, before a flight."""
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
    """`uavctl check`, and the check before arming (docs/check.md)."""

    seconds: Annotated[float, declare("listening time", "s", 0.001, 600)] = 8.0
    wait_s: Annotated[float, declare("further wait for a vehicle without a position", "s", 0, 600)] = 15.0
    same_origin: Annotated[bool, declare("the vehicle's own position has the cameras' origin, after [frame]")] = True
    offset_m: Annotated[
        float, declare("largest distance between the vehicle's own position and the cameras'", "m", 0.001, 1e6)
    ] = 0.5
    move_m: Annotated[float, declare("shortest movement of the body that shows axes", "m", 0.001, 1000)] = 0.3
    yaw_deg: Annotated[
        float, declare("largest angle between the cameras' north and the vehicle's", "deg", 0.01, 45)
    ] = 10.0
    margin_m: Annotated[float, declare("distance outside `sets` at which a flight may begin", "m", 0, 1000)] = 0.25
    rehearsals: Annotated[int, declare("rehearsed flights, for the risk to leave the room", "", 0, MAX_REHEARSALS)] = 60
    battery_v: Annotated[float, declare("least voltage of the battery; 0: vehicle's own threshold", "V", 0, 1000)] = 0.0
    accept: Annotated[tuple[str, ...], declare("items that may fail", length=100)] = ()


class RelayConfig(Section, frozen=True, kw_only=True):
    """External positions, passed on to the vehicle's estimator (docs/check.md)."""

    enabled: Annotated[bool, declare("pass positions on")] = False
    message: Annotated[Literal["vision-position-estimate", "odometry"], declare("MAVLink message")] = (
        "vision-position-estimate"
    )
    vehicle_time: Annotated[bool, declare("stamp positions by the vehicle's clock if it asks for our time (PX4)")] = (
        True
    )
    rate_hz: Annotated[float, declare("largest rate; the newest are sent", "1/s", 0.1, 1000)] = 50.0
