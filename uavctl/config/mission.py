"""Where to fly to in the course of a flight: waypoints or a trajectory, and limits that close in."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from uavctl.config.section import LARGEST_PLANT, LONGEST_MOTION, LONGEST_PATH, Floats, Number, Position, Section


class TrajectoryConfig(Section, frozen=True, kw_only=True):
    """A trajectory as samples; time counts from the first decision with a vehicle that takes setpoints."""

    times_s: Annotated[
        Floats, Meta(max_length=LONGEST_MOTION, description="times of the samples, increasing from 0 or later [s]")
    ] = ()
    positions_m: Annotated[
        tuple[Position, ...], Meta(max_length=LONGEST_MOTION, description="positions at these times, local NED [m]")
    ] = ()
    velocities_mps: Annotated[
        tuple[Position, ...],
        Meta(
            max_length=LONGEST_MOTION,
            description="velocities at these times, local NED [m/s]; without them they follow from the positions",
        ),
    ] = ()
    file: Annotated[
        str,
        Meta(
            max_length=LONGEST_PATH,
            description="CSV file with the samples instead, beside this file: columns t, x, y, z in s and m, and "
            "vx, vy, vz in m/s or none of them; a header line is allowed",
        ),
    ] = ""
    interpolation: Annotated[
        Literal["cubic", "linear"],
        Meta(description="between the samples: `cubic` spline, or `linear`"),
    ] = "cubic"


class MissionConfig(Section, frozen=True, kw_only=True):
    """Waypoints, or a trajectory; with neither, `target.position_m` is held from start to end."""

    waypoints: Annotated[
        tuple[Position, ...],
        Meta(max_length=1000, description="positions to fly to, one after the other, local NED [m]"),
    ] = ()
    hold_s: Annotated[
        Number | Annotated[Floats, Meta(max_length=1000)],
        Meta(description="time at each waypoint, from the arrival on: one number, or one for each of them [s]"),
    ] = 0.0
    accept_m: Annotated[
        float, Meta(ge=0.001, le=1e6, description="a waypoint is reached when the estimate is this near to it [m]")
    ] = 0.3
    then: Annotated[
        Literal["hold", "land"],
        Meta(
            description="after the last waypoint's time, or the trajectory's end: `hold` that place, or `land`: brake "
            "and hand over to the vehicle's own landing"
        ),
    ] = "hold"
    trajectory: TrajectoryConfig = TrajectoryConfig()


class FenceConfig(Section, frozen=True, kw_only=True):
    """A limit of a state that changes in time, inside the constant one of `[sets]`."""

    state: Annotated[
        Annotated[str, Meta(max_length=100)] | Annotated[int, Meta(ge=0, lt=LARGEST_PLANT)],
        Meta(description="axis whose position is limited (`north`, `east`, `down`), or index of a state"),
    ]
    side: Annotated[Literal["lower", "upper"], Meta(description="which limit")]
    times_s: Annotated[
        Floats,
        Meta(min_length=1, max_length=1000, description="times, increasing; counted as those of the mission [s]"),
    ]
    values: Annotated[
        Floats,
        Meta(
            min_length=1,
            max_length=1000,
            description="limit at these times, a line in between, constant before and after [m, m/s, m/s²]",
        ),
    ]
