"""The simulated side of the wire: vehicle, autopilot and motion capture."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.section import Position, Section


class CameraConfig(Section, frozen=True, kw_only=True):
    """Simulated motion capture."""

    rate_hz: Annotated[float, Meta(gt=0, description="samples a second [1/s]")]
    phase_s: Annotated[float, Meta(ge=0, description="time of the first sample; then every 1/rate_hz [s]")] = 0.0
    noise_std_m: Annotated[float, Meta(ge=0, description="noise of a position, each axis [m]")] = 0.0
    latency_s: Annotated[float, Meta(ge=0, description="processing time in the cameras, before the link [s]")] = 0.0
    clock_offset_s: Annotated[float, Meta(ge=-3999, le=1e9, description="offset of the cameras' clock [s]")] = 0.0
    message: Annotated[
        Literal["vision", "vicon", "mocap", "odometry"],
        Meta(description="MAVLink message; `odometry` carries the velocity too"),
    ] = "vision"


class SimConfig(Section, frozen=True, kw_only=True):
    """The simulated side of the wire."""

    camera: CameraConfig
    plant: Annotated[Literal["linear"], Meta(description="simulated vehicle")] = "linear"
    autopilot: Annotated[
        Literal["px4", "ardupilot"], Meta(description="whose behaviour the simulated autopilot shows")
    ] = "px4"
    seed: Annotated[int, Meta(ge=0, description="seed of every random draw")] = 0
    start_position_m: Annotated[Position, Meta(description="position at the start, local NED [m]")] = (0.0, 0.0, 0.0)
    start_velocity_mps: Annotated[Position, Meta(description="velocity at the start, local NED [m/s]")] = (
        0.0,
        0.0,
        0.0,
    )
    setpoint_timeout_s: Annotated[
        float, Meta(gt=0, description="silence after which the vehicle leaves the mode that takes setpoints [s]")
    ] = 1.0
