"""Monitor: may the vehicle's own velocity be believed? Does it contradict a prediction, or inertial data?

1. It may be believed if inertial data change as it does (`uavctl.flight.monitors.velocity_change`), or positions agreed
   with it, or the predicted velocity is near it, or (in a flight's first ten seconds) the velocity that setpoints gave
   is. Else: distrust the vehicle's velocity.
2. Without a position for two steps: a prediction far from it is wrong, and so is a plan of it. Then: brake.
3. Braking by it makes it grow, and the predicted one points against it. Then: end the plans.
4. A velocity that inertial data carried on without a position has drifted away from it. Then: distrust inertial data.

These compare without a memory of their own, so each is a `judge(observation) -> Verdict`.

False alarms: gusts change a velocity by 0.3 of the unexplained acceleration in the mean (docs/soak.md: 0 of 200
missions were braked for a prediction).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from uavctl.arrays import sum_in_order
from uavctl.event_codes import EventCode
from uavctl.flight.monitors.engaged import MonitorState
from uavctl.flight.monitors.motion import bound_gusts_mps
from uavctl.flight.monitors.observation import EnvelopeParameters, read_vehicle_velocity
from uavctl.flight.monitors.verdict import NO_VERDICT, Action, Verdict, brake, end_plans
from uavctl.records import Vec3, VehicleMotion

# Disagreements between a prediction and the vehicle that gusts alone do not make; the same where inertial data, or
# setpoints, change as its own velocity does.
MISLEADS, SUPPORTED_MISLEADS = 4.0, 2.0
# Speed from which two velocities point against each other, and a gain of speed that braking by the right one does not
# make: without it, 1 of 80 flights in gusts of 8 m/s was let go.
OPPOSED_MPS, FASTER_MPS = 0.25, 0.1
MODEL_COUNTS_S = 10.0  # of a flight: for so long the setpoints say something of the velocity
_DISTRUSTED = Verdict(Action.DISTRUST_VEHICLE_VELOCITY, EventCode.VELOCITY)


class VelocityObservation(msgspec.Struct, frozen=True, eq=False):
    """The vehicle's own velocity, and the data that it is compared with."""

    monitors: MonitorState
    at_ns: int  # the tick [ns]
    own_mps: Vec3 | None  # the vehicle's own velocity; None where it does not come
    predicted_mps: Vec3  # that is predicted, or that inertial data have carried on; NaN in axes that the plant lacks
    age_s: float  # age of the newest position in that [s]: gusts may have changed it since
    parameters: EnvelopeParameters


def judge_vehicle_velocity(observation: VelocityObservation) -> Verdict:
    """Judge whether the vehicle's own velocity may be believed."""
    return NO_VERDICT if find_trusted_velocity(observation) is not None else _DISTRUSTED


def find_trusted_velocity(observation: VelocityObservation) -> Vec3 | None:
    """Find the vehicle's own velocity where it may be braked on; None where it does not come, or nothing supports it.

    Inertial data that change as it does support it, positions that agreed with it, the predicted velocity, and what was
    sent since a flight began.
    """
    monitors, velocity, parameters = observation.monitors, observation.own_mps, observation.parameters
    if velocity is None or monitors.velocity_change.velocity_wrong_ns is not None:
        return None
    if monitors.velocity_change.supports_velocity(observation.at_ns):
        return velocity
    if monitors.velocity.is_contradicted:
        return None
    # |v - v_predicted| ≤ v_max + gusts(age)
    within_mps = parameters.disagreement_mps + bound_gusts_mps(observation.age_s, parameters)
    if monitors.velocity.apart_mps is not None or _is_near(velocity, observation.predicted_mps, within_mps):
        return velocity
    motion = monitors.motion
    if motion.began_ns is None:
        return None
    since_s = (observation.at_ns - motion.began_ns) * 1e-9
    # |v - v_sent| ≤ σ_begin + v_max + gusts(flight)
    within_mps = parameters.begins_mps + parameters.disagreement_mps + bound_gusts_mps(since_s, parameters)
    return velocity if since_s <= MODEL_COUNTS_S and _is_near(velocity, motion.model_mps, within_mps) else None


def judge_prediction(observation: VelocityObservation) -> Verdict:
    """Judge a prediction without fresh positions by the vehicle's own velocity."""
    velocity, parameters = find_trusted_velocity(observation), observation.parameters
    change = observation.monitors.velocity_change
    misleads = SUPPORTED_MISLEADS if change.supports_velocity(observation.at_ns) else MISLEADS
    within_mps = misleads * parameters.disagreement_mps + bound_gusts_mps(observation.age_s, parameters)
    if velocity is None or _is_near(velocity, observation.predicted_mps, within_mps):
        return NO_VERDICT
    return brake(
        EventCode.PREDICTION_INCONSISTENT, "the vehicle's velocity contradicts the prediction, and no position arrives"
    )


def judge_braking(observation: VelocityObservation) -> Verdict:
    """Judge whether braking may go on by the vehicle's own velocity: one that points the wrong way grows by it."""
    own_mps, began = observation.own_mps, observation.monitors.braking.began
    if own_mps is None or began is None:
        return NO_VERDICT
    known = [(v, other) for v, other in zip(own_mps, observation.predicted_mps, strict=True) if math.isfinite(other)]
    speed_mps, predicted_speed_mps = math.hypot(*own_mps), math.hypot(*(other for _, other in known))
    # v' v_predicted ≤ -½ |v| |v_predicted|: apart by 120° or more
    is_opposed = sum_in_order(v * other for v, other in known) <= -0.5 * speed_mps * predicted_speed_mps
    is_faster = speed_mps >= began[1] + FASTER_MPS
    if not (is_opposed and is_faster) or min(speed_mps, predicted_speed_mps) < OPPOSED_MPS:
        return NO_VERDICT
    return end_plans(
        EventCode.BRAKING, "braking increases the vehicle's velocity estimate, and decreases the predicted velocity"
    )


def is_inertial_consistent(observation: VelocityObservation) -> bool:
    """Whether a velocity that inertial data have carried on is near the vehicle's own, as far as that is believed."""
    velocity = find_trusted_velocity(observation)
    within_mps = observation.parameters.disagreement_mps
    return velocity is None or _is_near(velocity, observation.predicted_mps, within_mps)


def find_confirmed_velocity(monitors: MonitorState, motion: VehicleMotion | None, at_ns: int) -> Vec3 | None:
    """Find the vehicle's own velocity where recent positions agree with it; else None."""
    is_distrusted = monitors.velocity.is_contradicted or monitors.velocity_change.velocity_wrong_ns is not None
    if is_distrusted or monitors.velocity.apart_mps is None:
        return None
    return read_vehicle_velocity(motion, at_ns)


def _is_near(velocity: Vec3, known: Sequence[float], within_mps: float) -> bool:
    """Whether no known axis is further apart."""
    # An unknown value is NaN, and no difference from it is larger than anything.
    return not any(abs(own - value) > within_mps for own, value in zip(velocity, known, strict=True))
