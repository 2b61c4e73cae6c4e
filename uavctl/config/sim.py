"""[sim]: the simulated side, and its checks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from uavctl.config.connections import DaemonConfig
from uavctl.config.document import (
    MAX_DURATION_S,
    MAX_SEED,
    MAX_SPANS,
    ConfigProblem,
    Position,
    Section,
    Spans,
    Wind,
    declare,
)

MAX_FAULTS = 1000


class CameraConfig(Section, frozen=True, kw_only=True):
    """Simulated motion capture."""

    rate_hz: Annotated[float, declare("samples a second", "1/s", 0.01, 1000)]
    phase_s: Annotated[float, declare("time of the first sample; then every 1/rate_hz", "s", 0, MAX_DURATION_S)] = 0.0
    noise_std_m: Annotated[float, declare("noise of a position, each axis", "m", 0, 1000)] = 0.0
    latency_s: Annotated[float, declare("processing time in the cameras", "s", 0, 60)] = 0.0
    jitter_s: Annotated[float, declare("uniform extra processing time; samples may overtake", "s", 0, 60)] = 0.0
    clock_offset_s: Annotated[float, declare("offset of the cameras' clock", "s", -3999, 1e9)] = 0.0
    clock_drift_ppm: Annotated[float, declare("gain of the cameras' clock; recorded: 1e4 to 3e4", "ppm", -1e5, 1e5)] = (
        0.0
    )
    occluded: Annotated[Spans, declare("spans without samples", "s", length=MAX_SPANS)] = ()
    occlusions_per_s: Annotated[float, declare("random occlusions that begin in a second", "1/s", 0, 100)] = 0.0
    occlusion_s: Annotated[
        float, declare("mean length of random occlusions (exponential)", "s", 0.001, MAX_DURATION_S)
    ] = 0.5
    swapped: Annotated[
        Spans, declare("spans in which a body at other_body_m is taken for the vehicle", "s", length=MAX_SPANS)
    ] = ()
    other_body_m: Annotated[Position, declare("position of that body, local NED", "m")] = (0.0, 0.0, 0.0)
    frozen: Annotated[Spans, declare("spans that repeat the last pose", "s", length=MAX_SPANS)] = ()
    message: Annotated[
        Literal["vision", "vicon", "mocap", "odometry"], declare("MAVLink message; `odometry` has the velocity too")
    ] = "vision"


class WindConfig(Section, frozen=True, kw_only=True):
    """Wind of the simulated quadrotor, with Dryden gusts (docs/vehicle.md)."""

    velocity_mps: Annotated[Wind, declare("steady velocity of the air, local NED", "m/s")] = (0.0, 0.0, 0.0)
    gust_wind_mps: Annotated[float, declare("wind at 20 ft that sets the gusts (light: 7.7)", "m/s", 0, 50)] = 0.0
    height_m: Annotated[float, declare("height that sets the gusts' scales", "m", 0.01, 1000)] = 2.0


class QuadrotorConfig(Section, frozen=True, kw_only=True):
    """The simulated quadrotor (docs/vehicle.md)."""

    charge: Annotated[float, declare("battery at the start", high=1, above=0)] = 1.0


class InertialConfig(Section, frozen=True, kw_only=True):
    """Inertial data and attitude of the simulated autopilot (docs/vehicle.md)."""

    errors: Annotated[float, declare("factor of the errors in docs/vehicle.md", "", 0, 10)] = 1.0
    flown: Annotated[bool, declare("the quadrotor flies by the wrong attitude")] = False


class ChecksConfig(Section, frozen=True, kw_only=True):
    """False alarms of the simulated autopilot (docs/autopilots.md)."""

    flicker_s: Annotated[
        float, declare("mean time between changes of pre-flight checks; 0: they stay", "s", 0, MAX_DURATION_S)
    ] = 0.0
    invalid: Annotated[
        Spans, declare("spans since arming with an invalid position: the failsafe acts", "s", length=MAX_SPANS)
    ] = ()
    clears: Annotated[bool, declare("such a failsafe ends with its cause, as in PX4")] = False


class FaultConfig(Section, frozen=True, kw_only=True):
    """A fault of the simulated flight; `uavctl sim --faults FILE` reads a list of them."""

    at_s: Annotated[float, declare("time since the start", "s", 0, MAX_DURATION_S)]
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
        declare(
            "a span of `[link]` (`blackout`, `held`, `uplink_blackout`) or `[sim.camera]` (`occluded`, `swapped`, "
            "`frozen`); or lasting: steady `wind`, `battery` charge, camera `frame`, position `noise`, `drift` of the "
            "cameras' origin, `parameter` of the autopilot, `mode` by the pilot's stick"
        ),
    ]
    for_s: Annotated[float, declare("length of a span", "s", 0, MAX_DURATION_S)] = 0.0
    velocity_mps: Annotated[Wind, declare("of the air (`wind`) or the origin (`drift`), local NED", "m/s")] = (
        0.0,
        0.0,
        0.0,
    )
    charge: Annotated[float, declare("of the battery", "", 0, 1)] = 0.0
    name: Annotated[
        str,
        declare(
            "parameter; mode, as the autopilot calls it; or frame: `turned-90`, `turned-180`, `turned-270`, "
            "`mirrored-north`, `mirrored-east`, `mirrored-down`, `swapped`, `enu`, `millimetres`, `kilometres`, "
            "`right`",
            length=100,
        ),
    ] = ""
    value: Annotated[float, declare("of the parameter, or standard deviation of the noise", "m", -1e9, 1e9)] = 0.0


class SimConfig(Section, frozen=True, kw_only=True):
    """The simulated vehicle."""

    camera: CameraConfig
    wind: WindConfig = WindConfig()
    quadrotor: QuadrotorConfig = QuadrotorConfig()
    inertial: InertialConfig = InertialConfig()
    checks: ChecksConfig = ChecksConfig()
    plant: Annotated[
        Literal["linear", "quadrotor"],
        declare(
            "`linear` (`[plant]` without its dead time) or `quadrotor` (rotors, battery, autopilot; docs/vehicle.md)"
        ),
    ] = "linear"
    autopilot: Annotated[Literal["px4", "ardupilot"], declare("the simulated autopilot")] = "px4"
    streams: Annotated[
        Literal["few", "onboard"], declare("messages that come unasked: `few`, or `onboard` (over 300 a second)")
    ] = "few"
    fault: Annotated[tuple[FaultConfig, ...], declare("faults in the course of the flight", length=MAX_FAULTS)] = ()
    radius_m: Annotated[float, declare("of rotors and body; spheres that touch collide", "m", high=100, above=0)] = 0.07
    downwash: Annotated[float, declare("factor of the force below another vehicle (docs/vehicle.md)", "", 0, 10)] = 1.0
    system_id: Annotated[int, declare("MAVLink system id of the simulated vehicle", "", 1, 250)] = 1
    seed: Annotated[int, declare("seed of every random draw", "", 0, MAX_SEED)] = 0
    start_position_m: Annotated[Position, declare("position at the start, local NED", "m")] = (0.0, 0.0, 0.0)
    start_velocity_mps: Annotated[Wind, declare("velocity at the start, local NED", "m/s")] = (0.0, 0.0, 0.0)
    clock_drift_ppm: Annotated[float, declare("gain of the vehicle's clock; recorded: -1.4e4", "ppm", -1e5, 1e5)] = 0.0
    setpoint_timeout_s: Annotated[
        Annotated[float, Meta(ge=0.01, le=3600)] | None,
        declare("COM_OF_LOSS_T or GUID_TIMEOUT; default 0.7; as shipped PX4 has 1, ArduPilot 3", "s"),
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
    """Check that the simulated vehicle and the daemon have different system ids, to be distinguished on one link."""
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
