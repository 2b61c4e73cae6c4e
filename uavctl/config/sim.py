"""[sim]: the simulated side, and its checks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from uavctl.config.connections import DaemonConfig
from uavctl.config.document import MAX_DURATION_S, MAX_SEED, MAX_SPANS, ConfigProblem, Position, Section, Spans, Wind

MAX_FAULTS = 1000


class CameraConfig(Section, frozen=True, kw_only=True):
    """Simulated motion capture."""

    rate_hz: Annotated[float, Meta(ge=0.01, le=1000, description="samples a second [1/s]")]
    phase_s: Annotated[
        float, Meta(ge=0, le=MAX_DURATION_S, description="time of the first sample; then every 1/rate_hz [s]")
    ] = 0.0
    noise_std_m: Annotated[float, Meta(ge=0, le=1000, description="noise of a position, each axis [m]")] = 0.0
    latency_s: Annotated[
        float, Meta(ge=0, le=60, description="processing time in the cameras, before the link [s]")
    ] = 0.0
    jitter_s: Annotated[
        float,
        Meta(
            ge=0, le=60, description="uniform extra processing time from 0 to this [s]; samples may overtake each other"
        ),
    ] = 0.0
    clock_offset_s: Annotated[float, Meta(ge=-3999, le=1e9, description="offset of the cameras' clock [s]")] = 0.0
    clock_drift_ppm: Annotated[
        float, Meta(ge=-1e5, le=1e5, description="what the cameras' clock gains [millionths]; recorded: 1e4 to 3e4")
    ] = 0.0
    occluded: Annotated[
        Spans,
        Meta(
            max_length=MAX_SPANS,
            description="spans [from_s, to_s] since the start in which the vehicle is not seen: no samples [s]",
        ),
    ] = ()
    occlusions_per_s: Annotated[
        float,
        Meta(
            ge=0, le=100, description="random occlusions beside those: how many a second begin while it is seen [1/s]"
        ),
    ] = 0.0
    occlusion_s: Annotated[
        float, Meta(ge=0.001, le=MAX_DURATION_S, description="their mean length; lengths are exponential [s]")
    ] = 0.5
    swapped: Annotated[
        Spans,
        Meta(
            max_length=MAX_SPANS,
            description="spans [from_s, to_s] since the start in which another body is taken for the vehicle: it "
            "stands still at other_body_m, level, its nose north [s]",
        ),
    ] = ()
    other_body_m: Annotated[Position, Meta(description="position of that other body, local NED [m]")] = (0.0, 0.0, 0.0)
    frozen: Annotated[
        Spans,
        Meta(
            max_length=MAX_SPANS,
            description="spans [from_s, to_s] since the start in which the last sample's pose is repeated, to the last "
            "bit, with new stamps [s]",
        ),
    ] = ()
    message: Annotated[
        Literal["vision", "vicon", "mocap", "odometry"],
        Meta(description="MAVLink message; `odometry` carries the velocity too"),
    ] = "vision"


class WindConfig(Section, frozen=True, kw_only=True):
    """Wind of the simulated quadrotor: steady, with Dryden gusts (docs/vehicle.md)."""

    velocity_mps: Annotated[Wind, Meta(description="steady wind: velocity of the air, local NED [m/s]")] = (
        0.0,
        0.0,
        0.0,
    )
    gust_wind_mps: Annotated[
        float,
        Meta(
            ge=0,
            le=50,
            description="wind speed at 20 ft that sets the strength of the gusts (light 7.7, moderate 15.4); 0 is none "
            "[m/s]",
        ),
    ] = 0.0
    height_m: Annotated[
        float, Meta(ge=0.01, le=1000, description="height for which the gusts' scales are taken [m]")
    ] = 2.0


class QuadrotorConfig(Section, frozen=True, kw_only=True):
    """The simulated quadrotor (docs/vehicle.md)."""

    charge: Annotated[float, Meta(gt=0, le=1, description="charge of the battery at the start")] = 1.0


class InertialConfig(Section, frozen=True, kw_only=True):
    """Inertial measurements of the simulated autopilot, and the attitude told with them (docs/vehicle.md)."""

    errors: Annotated[
        float,
        Meta(
            ge=0,
            le=10,
            description="size of the errors of inertial measurements, and of the attitude once they are asked for, "
            "relative to those of docs/vehicle.md; 0 is none",
        ),
    ] = 1.0
    flown: Annotated[
        bool, Meta(description="whether the quadrotor flies by the wrong attitude too: what it takes for level is not")
    ] = False


class ChecksConfig(Section, frozen=True, kw_only=True):
    """False alarms of the simulated autopilot: checks that fail though nothing is wrong (docs/autopilots.md)."""

    flicker_s: Annotated[
        float,
        Meta(
            ge=0,
            le=MAX_DURATION_S,
            description="mean time after which its pre-flight checks change between passing and failing, drawn each "
            "time; 0: they stay as they are [s]",
        ),
    ] = 0.0
    invalid: Annotated[
        Spans,
        Meta(
            max_length=MAX_SPANS,
            description="spans [from_s, to_s] since arming in which its position does not count as valid: its failsafe "
            "acts [s]",
        ),
    ] = ()
    clears: Annotated[
        bool,
        Meta(
            description="whether a failsafe for want of a position ends with its cause: PX4 is back in the mode of "
            "before, and a take-off goes on"
        ),
    ] = False


class FaultConfig(Section, frozen=True, kw_only=True):
    """Something that happens at a time of the simulated flight; `uavctl sim --faults FILE` reads a list of them."""

    at_s: Annotated[float, Meta(ge=0, le=MAX_DURATION_S, description="when, since the start [s]")]
    kind: Annotated[
        Literal[
            "blackout",
            "held",
            "uplink_blackout",
            "occluded",
            "swapped",
            "frozen",
            "wind",
            "battery",
            "frame",
            "noise",
            "drift",
            "parameter",
            "mode",
        ],
        Meta(
            description="`blackout`, `held`, `uplink_blackout`: a span of these of `[link]`; `occluded`, `swapped`, "
            "`frozen`: a span of these of `[sim.camera]`; `wind`: the steady wind of the quadrotor changes; `battery`: "
            "that of the quadrotor has another charge; `frame`: the cameras' axes are others from then on; `noise`: "
            "so is the noise of their positions; `drift`: their origin moves from then on; `parameter`: one of the "
            "autopilot's has another value; `mode`: the pilot changes the autopilot's mode with the stick"
        ),
    ]
    for_s: Annotated[float, Meta(ge=0, le=MAX_DURATION_S, description="length of a span [s]")] = 0.0
    velocity_mps: Annotated[
        Wind,
        Meta(description="of the air, with `wind`, or of positions beside the vehicle, with `drift`, local NED [m/s]"),
    ] = (0.0, 0.0, 0.0)
    charge: Annotated[float, Meta(ge=0, le=1, description="of the battery, with `battery`")] = 0.0
    name: Annotated[
        str,
        Meta(
            max_length=100,
            description="of the parameter, or of the mode as the autopilot calls it; of the axes: `turned-90`, "
            "`turned-180`, `turned-270`, `mirrored-north`, `mirrored-east`, `mirrored-down`, `swapped`, `enu`, "
            "`millimetres`, `kilometres`, or `right`",
        ),
    ] = ""
    value: Annotated[
        float, Meta(ge=-1e9, le=1e9, description="of the parameter, or the noise's standard deviation [m]")
    ] = 0.0


class SimConfig(Section, frozen=True, kw_only=True):
    """The simulated side of the wire."""

    camera: CameraConfig
    wind: WindConfig = WindConfig()
    quadrotor: QuadrotorConfig = QuadrotorConfig()
    inertial: InertialConfig = InertialConfig()
    checks: ChecksConfig = ChecksConfig()
    plant: Annotated[
        Literal["linear", "quadrotor"],
        Meta(
            description="simulated vehicle: the plant of `[plant]` without its dead time, or a quadrotor with rotors, "
            "battery, wind and the loops of its autopilot"
        ),
    ] = "linear"
    autopilot: Annotated[
        Literal["px4", "ardupilot"], Meta(description="whose behaviour the simulated autopilot shows")
    ] = "px4"
    streams: Annotated[
        Literal["few", "onboard"],
        Meta(
            description="messages that the autopilot sends unasked: `few`, or `onboard`: as many and as often as a PX4 "
            "was recorded to on such a link, above 300 a second; an ArduPilot sends few on both"
        ),
    ] = "few"
    fault: Annotated[
        tuple[FaultConfig, ...], Meta(max_length=MAX_FAULTS, description="what happens in the course of a flight")
    ] = ()
    system_id: Annotated[int, Meta(ge=1, le=250, description="MAVLink system id of the simulated vehicle")] = 1
    seed: Annotated[int, Meta(ge=0, le=MAX_SEED, description="seed of every random draw")] = 0
    start_position_m: Annotated[Position, Meta(description="position at the start, local NED [m]")] = (0.0, 0.0, 0.0)
    start_velocity_mps: Annotated[Wind, Meta(description="velocity at the start, local NED [m/s]")] = (0.0, 0.0, 0.0)
    clock_drift_ppm: Annotated[
        float, Meta(ge=-1e5, le=1e5, description="what the vehicle's clock gains [millionths]; recorded: -1.4e4")
    ] = 0.0
    setpoint_timeout_s: Annotated[
        Annotated[float, Meta(ge=0.01, le=3600)] | None,
        Meta(
            description="silence after which setpoints count as gone [s], COM_OF_LOSS_T or GUID_TIMEOUT; without it "
            "0.7 s, as a room needs it (as shipped PX4 has 1 s and ArduPilot 3 s)"
        ),
    ] = None


# Keys that a kind of fault heeds; the kinds that are not here are spans.
_KEYS_OF_KIND = {
    "wind": ("velocity_mps",),
    "battery": ("charge",),
    "frame": ("name",),
    "noise": ("value",),
    "drift": ("velocity_mps",),
    "parameter": ("name", "value"),
    "mode": ("name",),
}


def check_spans(key: str, spans: Spans) -> Iterator[ConfigProblem]:
    """Yield the spans of time since the start that are not valid: a negative start, or an end that is not after it."""
    for i, (start, end) in enumerate(spans):
        if not 0 <= start < end:
            yield ConfigProblem(
                f"{key}[{i}]",
                f"[{start:g}, {end:g}] is not a span of time",
                "give [from_s, to_s] with 0 <= from_s < to_s",
            )


def check_sim(config: SimConfig) -> Iterator[ConfigProblem]:
    """All problems of `[sim]`."""
    for name in ("occluded", "swapped", "frozen"):
        yield from check_spans(f"sim.camera.{name}", getattr(config.camera, name))
    yield from check_spans("sim.checks.invalid", config.checks.invalid)
    if config.checks.clears and config.autopilot != "px4":
        yield ConfigProblem(
            "sim.checks.clears",
            f'has no effect with autopilot "{config.autopilot}", which stays in the mode of its failsafe',
            'remove it, or set sim.autopilot = "px4"',
        )
    yield from check_faults("sim.fault", config.fault, config.plant)
    if config.plant == "linear":
        for key, is_default in (
            ("wind", config.wind == WindConfig()),
            ("quadrotor", config.quadrotor == QuadrotorConfig()),
        ):
            if not is_default:
                yield ConfigProblem(
                    f"sim.{key}",
                    'has no effect with plant "linear", whose disturbance is that of [plant]',
                    'remove it, or set sim.plant = "quadrotor"',
                )
        if config.inertial.flown:
            yield ConfigProblem(
                "sim.inertial.flown",
                'has no effect with plant "linear", which is always level',
                'remove it, or set sim.plant = "quadrotor"',
            )
    elif config.start_position_m[2] >= 0.0:
        yield ConfigProblem(
            "sim.start_position_m[2]",
            f"{config.start_position_m[2]:g} m is not above the floor z = 0, where the quadrotor would stand",
            "give a number below 0 (local NED: up is negative)",
        )


def check_system_ids(sim: SimConfig, daemon: DaemonConfig) -> Iterator[ConfigProblem]:
    """Check that the simulated vehicle and the daemon have different system ids, to be told apart on one link."""
    if sim.system_id == daemon.system_id:
        yield ConfigProblem(
            "sim.system_id", f"{sim.system_id} is that of the daemon too (daemon.system_id)", "give another number"
        )


def check_faults(key: str, faults: tuple[FaultConfig, ...], plant: str) -> Iterator[ConfigProblem]:
    """All problems of a list of faults that happen to a plant of this kind."""
    for i, fault in enumerate(faults):
        yield from _check_fault(f"{key}[{i}]", fault, plant)


def _check_fault(key: str, fault: FaultConfig, plant: str) -> Iterator[ConfigProblem]:
    used_keys = ("at_s", "kind", *_KEYS_OF_KIND.get(fault.kind, ("for_s",)))
    for field in msgspec.structs.fields(fault):
        if field.name not in used_keys and getattr(fault, field.name) != field.default:
            yield ConfigProblem(f"{key}.{field.name}", f'has no effect with kind "{fault.kind}"', "remove it")
    if fault.kind in ("wind", "battery"):
        if plant == "linear":
            yield ConfigProblem(f"{key}.kind", f'plant "linear" has no {fault.kind}', 'set sim.plant = "quadrotor"')
    elif fault.kind in ("parameter", "mode", "frame"):
        if not fault.name:
            yield ConfigProblem(f"{key}.name", f"is missing: which {fault.kind}", "add it")
    elif fault.kind not in _KEYS_OF_KIND and fault.for_s == 0.0:
        yield ConfigProblem(f"{key}.for_s", f'is missing: how long the span of kind "{fault.kind}" is', "add it")
