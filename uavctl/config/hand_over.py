"""How the vehicle is asked for modes, arming and take-off, and how long its answers are waited for."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from uavctl.config.section import Position, Section


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
