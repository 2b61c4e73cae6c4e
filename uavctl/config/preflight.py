"""The sections `[check]` and `[relay]`: what is looked at before a flight, and positions passed on to the vehicle."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.section import Section


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
    rate_hz: Annotated[
        float, Meta(ge=0.1, le=1000, description="at most so many a second; the newest are sent [1/s]")
    ] = 50.0
