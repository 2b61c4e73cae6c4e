"""Whom the control loop talks to: frame and clock of the positions' source, and the connections."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.section import LONGEST_URL, Position, Section

CAMERAS = ("natnet:",)  # URLs of camera systems that are listened to without a bridge
CAMERA_SYSTEM_ID, CAMERA_MESSAGE = 246, "ODOMETRY"  # as what their positions come to the controller


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
    """Which messages count as external positions."""

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
    vehicle: Annotated[str, Meta(max_length=LONGEST_URL, description="URL of the vehicle")] = "udpin://0.0.0.0:14540"
    mocap: Annotated[
        str,
        Meta(
            max_length=LONGEST_URL,
            description="URL of the source of positions; the same URL as the vehicle's is one connection. "
            "`natnet://SERVER/BODY` is a rigid body of an OptiTrack system (docs/sources.md)",
        ),
    ] = "udpin://0.0.0.0:14560"
    vehicle_system_id: Annotated[
        int, Meta(ge=0, le=255, description="MAVLink system id of the vehicle; 0 takes the first one that is heard")
    ] = 0
    system_id: Annotated[int, Meta(ge=1, le=255, description="MAVLink system id of the daemon")] = 245
    component_id: Annotated[int, Meta(ge=1, le=255, description="MAVLink component id of the daemon (25 = user 1)")] = (
        25
    )
