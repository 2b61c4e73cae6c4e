"""What the envelope is shown in its tests: ticks, and what it knew before one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from flight_rig import MS, START_NS, sample
from msgspec import structs

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors import engaged
from uavctl.flight.monitors.braking import BrakingState
from uavctl.flight.monitors.engaged import INITIAL, MonitorState
from uavctl.flight.monitors.motion import Motion, PositionObservation
from uavctl.flight.monitors.observation import EnvelopeParameters, Observation, read_vehicle_velocity
from uavctl.flight.monitors.observer import Observer
from uavctl.flight.monitors.outside import OutsideState
from uavctl.flight.monitors.vehicle_velocity import (
    VelocityObservation,
    find_trusted_velocity,
    is_inertial_consistent,
    judge_prediction,
    judge_vehicle_velocity,
)
from uavctl.flight.monitors.verdict import Action, Verdict
from uavctl.flight.supervise import ENVELOPE_CODES
from uavctl.records import PositionSample, Vec3, VehicleMotion

TICK_NS = 50 * MS
NAN3: Vec3 = (math.nan, math.nan, math.nan)
PARAMETERS = EnvelopeParameters(
    axes=(True, True, True),
    lower_m=(-3.0, -2.0, -4.0),
    upper_m=(3.0, 2.0, -1.0),
    outside_m=(0.5, 0.625, 0.75),
    brake_mps2=(2.0, 2.5, 1.5),
    lag_s=(0.2, 0.3, 0.4),
    unexplained_mps2=2.0,
    disagreement_mps=0.25,
    window_ns=1200 * MS,
    begins_mps=0.3,
)


# Where each thing that the monitors know is kept in their state.
GROUPS = {
    "motion": (
        "tick_ns",
        "began_ns",
        "model_mps",
        "model_mps2",
        "sent",
        "vehicle_path",
        "inertial_path",
        "push_mps2",
        "observer",
        "resumed_ns",
    ),
    "acceleration": ("unexplained_mps2", "clipped", "is_pushed", "over_ns"),
    "velocity": ("offsets", "places", "apart_mps", "apart_ns", "is_contradicted"),
}


def changed(state: MonitorState, **known: Any) -> MonitorState:
    """The state of the monitors with other values, each named as in its group."""
    for group, names in GROUPS.items():
        values = {name: known.pop(name) for name in names if name in known}
        if "resumed_ns" in values:  # known before this tick: the monitor of braking knows it, too
            known["braking_resumed_ns"] = values["resumed_ns"]
        state = structs.replace(state, **{group: structs.replace(getattr(state, group), **values)})
    if "outside_ns" in known:
        state = structs.replace(state, outside=OutsideState(known.pop("outside_ns")))
    if "braking" in known or "braking_resumed_ns" in known:
        began, resumed_ns = known.pop("braking", state.braking.began), known.pop("braking_resumed_ns", None)
        paused_ns = known.pop("paused_ns", state.braking.paused_ns)
        state = structs.replace(state, braking=BrakingState(began, resumed_ns or state.braking.resumed_ns, paused_ns))
    return structs.replace(state, **known)


def monitors(**known: Any) -> MonitorState:
    return changed(INITIAL, **known)


def update(
    state: MonitorState, observation: Observation, parameters: EnvelopeParameters
) -> tuple[MonitorState, Verdict | None]:
    """The monitors after a tick, and their verdict; None for none."""
    state, verdict = engaged.update(state, observation, parameters)
    assert verdict.is_none or (verdict.action is Action.END_PLANS and verdict.cause in ENVELOPE_CODES)
    return state, None if verdict.is_none else verdict


def _observe_velocity(
    state: MonitorState, tick: Observation, age_s: float, parameters: EnvelopeParameters
) -> VelocityObservation:
    own_mps = read_vehicle_velocity(tick.motion, tick.at_ns)
    return VelocityObservation(state, tick.at_ns, own_mps, tick.velocity_mps, age_s, parameters)


def trusted_velocity(
    state: MonitorState, tick: Observation, age_s: float, parameters: EnvelopeParameters
) -> Vec3 | None:
    observation = _observe_velocity(state, tick, age_s, parameters)
    velocity, verdict = find_trusted_velocity(observation), judge_vehicle_velocity(observation)
    assert verdict.is_none == (velocity is not None)
    assert verdict.is_none or verdict.action is Action.DISTRUST_VEHICLE_VELOCITY
    return velocity


def is_prediction_inconsistent(
    state: MonitorState, tick: Observation, age_s: float, parameters: EnvelopeParameters
) -> bool:
    verdict = judge_prediction(_observe_velocity(state, tick, age_s, parameters))
    assert verdict.is_none or (verdict.action, verdict.cause) == (Action.BRAKE, EventCode.PREDICTION_INCONSISTENT)
    return not verdict.is_none


def is_inertial_inconsistent(
    state: MonitorState, tick: Observation, age_s: float, parameters: EnvelopeParameters
) -> bool:
    return not is_inertial_consistent(_observe_velocity(state, tick, age_s, parameters))


def vec3(values: Sequence[float] | Array) -> Vec3:
    north, east, down = map(float, values)
    return north, east, down


def motion(velocity_mps: Vec3, at_ns: int) -> VehicleMotion:
    return VehicleMotion(velocity_mps=velocity_mps, velocity_ns=at_ns)


def seen(
    at_ns: int, *samples: PositionSample, sent: Vec3 = ZERO, vehicle_motion: VehicleMotion | None = None
) -> Observation:
    return Observation(
        at_ns=at_ns,
        samples=samples,
        sent_mps2=sent,
        position_m=None,
        velocity_mps=NAN3,
        motion=vehicle_motion,
        braking=False,
    )


LOOK_NS = 62_500_000
AT_NS = START_NS + LOOK_NS


def look(
    unexplained: Vec3,
    velocity: Vec3 = ZERO,
    *,
    off_m: float = 0.0,
    vehicle_motion: VehicleMotion | None = None,
    accel: Vec3 = ZERO,
    parameters: EnvelopeParameters = PARAMETERS,
    **known: Any,
) -> tuple[MonitorState, Verdict | None]:
    """What comes of a position, by which the observer has, exactly, that velocity and unexplained acceleration."""
    s, d = LOOK_NS * 1e-9, np.array(unexplained)
    begun = np.array(velocity) - s * d
    observer = Observer(
        at_ns=START_NS, mean=np.array([np.zeros(3), begun, d]), cov=np.zeros((3, 3)), accel_mps2=np.array(accel)
    )
    watching = changed(monitors(observer=observer, tick_ns=START_NS, sent=((START_NS, accel),)), **known)
    position = s * begun + 0.5 * s * s * (np.array(accel) + d) + np.array([off_m, 0.0, 0.0])
    return update(
        watching,
        seen(AT_NS, sample(AT_NS, AT_NS, vec3(position)), sent=accel, vehicle_motion=vehicle_motion),
        parameters,
    )


def just_more(value: float) -> float:
    return math.nextafter(value, math.inf)


def just_less(value: float) -> float:
    return math.nextafter(value, -math.inf)


AT_REST = motion(ZERO, AT_NS)


def offsets(
    speed_mps: float, *, spans_ns: Sequence[int] = (250 * MS, 500 * MS), place_m: float = 0.0, **known: object
) -> dict[str, Any]:
    """Offsets so long before AT_NS that grow by so much in a second; the vehicle says that it is at rest."""
    return {
        "vehicle_path": ((START_NS, ZERO), (AT_NS - MS, ZERO)),
        "offsets": tuple((AT_NS - ns, (place_m - speed_mps * ns * 1e-9, 0.0, 0.0)) for ns in sorted(spans_ns)[::-1]),
        **known,
    }


def believed(place_m: Vec3, parameters: EnvelopeParameters = PARAMETERS) -> PositionObservation:
    """A position that was believed."""
    observer = Observer(AT_NS, np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3))
    return PositionObservation(AT_NS, np.array(place_m), False, False, Motion(), observer, seen(AT_NS), parameters)
