"""Monitor: is the estimate outside the room, or about to leave it faster than the vehicle can brake?

1. Each side of each axis: is the estimate beyond the limit by more than the margin, and not on its way back?
2. Would the distance to stop end beyond the margin?
3. One of both holds for 0.1 s. Then: end the plans.
4. Right after the delay of positions has changed, the second question is not asked: the estimate has moved to a limit,
   and the plan brakes there already.
5. A vehicle that climbs by itself flies sideways. Then: break the climb off.

False alarms (docs/soak.md): 1 of 600 missions, where a burst of losses followed the take-off.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from uavctl.event_codes import EventCode
from uavctl.flight.monitors.motion import Motion, TickObservation
from uavctl.flight.monitors.observation import EnvelopeParameters, Observation, read_vehicle_velocity
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans
from uavctl.records import Vec3

LASTS_NS = 100_000_000  # one estimate alone may be a late sample's fault
SHIFTED_NS = 1_000_000_000  # time in which a plan stops a vehicle at 1.5 m/s before a limit that it has just learned of
RETURNS_MPS = 0.3  # a vehicle outside that moves so fast towards the limit is on its way back
STANDS_MPS = 0.05  # an outward speed that is shown as 0.0 m/s
SIDEWAYS_MPS = 0.6  # upright climbs in gusts of 5 m/s came to 0.25 m/s
REACTION_S = 0.3  # from a setpoint to its effect: recorded autopilots need 0.18 to 0.32 s
# Standard deviation of the velocity by positions: 0.15 m/s at 5 Hz, 0.33 m/s at the first one after a silence of 1 s
UNCERTAIN_MPS = 0.3
LANDING_MPS2 = 2.5  # deceleration of a vehicle that brakes by itself, as recorded of ArduCopter

_LIMITS = (("south", "north"), ("west", "east"), ("upper", "lower"))


class OutsideState(msgspec.Struct, frozen=True):
    """State of the monitor."""

    since_ns: int | None = None  # since when the estimate has been outside [ns]; None while it is not
    shifted_ns: int | None = None  # when the delay of positions last changed [ns]; None before


def update(state: OutsideState, observation: TickObservation) -> tuple[OutsideState, Verdict]:
    """Take a tick."""
    tick, parameters = observation.tick, observation.parameters
    brakes = state.shifted_ns is None or tick.at_ns - state.shifted_ns > SHIFTED_NS
    text = _describe_outside(tick, parameters, brakes=brakes)
    vehicle_mps = read_vehicle_velocity(tick.motion, tick.at_ns)
    if text is not None and vehicle_mps is not None and _is_velocity_uncertain(observation.motion):
        # One position does not tell an early gust from a late one: the estimated velocity may be twice the true one.
        text = _describe_outside(replace(tick, velocity_mps=vehicle_mps), parameters, brakes=brakes)
    if text is None:
        return OutsideState(shifted_ns=state.shifted_ns), NO_VERDICT
    since_ns = state.since_ns or tick.at_ns
    lasts = tick.at_ns - since_ns >= LASTS_NS
    return replace(state, since_ns=since_ns), end_plans(EventCode.OUTSIDE, text) if lasts else NO_VERDICT


def _is_velocity_uncertain(motion: Motion) -> bool:
    """Whether too few positions have come since the last silence for them to show the velocity."""
    return motion.observer is not None and float(motion.observer.cov[1, 1]) > UNCERTAIN_MPS * UNCERTAIN_MPS


def describe_sideways(observation: Observation) -> str:
    """Return how fast a vehicle that climbs by itself flies sideways; empty where its climb is upright.

    A wrong heading turns the corrections of its own position control, so that they drive it away.
    """
    # Its own velocity first: positions may be lost in a burst meanwhile, and a jump of positions makes no such speed.
    own = read_vehicle_velocity(observation.motion, observation.at_ns)
    if own is None and observation.position_m is None:
        return ""
    speed_mps = math.hypot(*(own or observation.velocity_mps)[:2])
    if speed_mps <= SIDEWAYS_MPS:
        return ""
    return f"the vehicle moves sideways at {speed_mps:.1f} m/s in its climb: its heading may be wrong"


def is_outside(observation: Observation, parameters: EnvelopeParameters) -> bool:
    """Whether the estimate is outside by more than the margin, or about to be."""
    return _describe_outside(observation, parameters) is not None


def describe_beyond(observation: Observation, parameters: EnvelopeParameters) -> str:
    """Return the limit that the estimate is beyond by more than the margin, not on its way back; empty if none."""
    return _describe_outside(observation, parameters, brakes=False) or ""


def _describe_outside(observation: Observation, parameters: EnvelopeParameters, *, brakes: bool = True) -> str | None:
    """Return how the estimate is outside, or about to be (`brakes`: it must be able to stop before); None if not."""
    if observation.position_m is None:
        return None
    rows = zip(
        _LIMITS,
        parameters.axes,
        observation.position_m,
        observation.velocity_mps,
        parameters.lower_m,
        parameters.upper_m,
        parameters.outside_m,
        parameters.brake_mps2,
        strict=True,
    )
    for (below, above), has, position, velocity, lower, upper, margin, brake in rows:
        if has and not math.isfinite(position + velocity):
            return f"the estimated distance to the {above} limit is not a number"
        for limit, out_m, outward in ((below, lower - position, -velocity), (above, position - upper, velocity)):
            # s = v T + v² / 2 a
            stop_m = outward * REACTION_S + outward * outward / (2.0 * brake)
            is_beyond = out_m > margin and outward > -RETURNS_MPS
            if is_beyond or (brakes and outward > 0.0 and out_m + stop_m > margin):
                return f"the estimate is {_describe_limit(out_m, limit, outward)}"
    return None


class Approach(msgspec.Struct, frozen=True):
    """A limit that the vehicle flies to."""

    axis: int
    limit: str
    distance_m: float  # negative beyond it
    speed_mps: float
    brake_mps2: float  # largest deceleration


def list_approaches(tick: Observation, parameters: EnvelopeParameters, velocity_mps: Vec3) -> list[Approach]:
    """List the limits that the vehicle flies to."""
    if tick.position_m is None:
        return []
    approaches = []
    rows = zip(
        range(len(_LIMITS)),
        _LIMITS,
        tick.position_m,
        velocity_mps,
        parameters.lower_m,
        parameters.upper_m,
        parameters.brake_mps2,
        strict=True,
    )
    for axis, (below, above), position, velocity, lower, upper, brake in rows:
        if velocity > 0.0:
            approaches.append(Approach(axis, above, upper - position, velocity, brake))
        elif velocity < 0.0:
            approaches.append(Approach(axis, below, position - lower, -velocity, brake))
    return approaches


def describe_overrun(tick: Observation, parameters: EnvelopeParameters) -> str:
    """Return in words the limits before which the vehicle cannot stop any more by its own landing; empty if none.

    Without an estimated position the words say that this is not known.
    """
    text = ""
    velocity_mps = read_vehicle_velocity(tick.motion, tick.at_ns) or tick.velocity_mps
    speed_mps = math.hypot(*velocity_mps)
    if tick.position_m is None:
        return f"; the position is unknown: at {speed_mps:.1f} m/s the vehicle may be too fast to stop in time"
    for approach in list_approaches(tick, parameters, velocity_mps):
        # All axes come to rest together: t = max(v_axis / a_axis, |v| / a); x < v_axis (T + t / 2)
        stop_s = max(approach.speed_mps / approach.brake_mps2, speed_mps / LANDING_MPS2)
        if approach.distance_m < approach.speed_mps * (REACTION_S + stop_s / 2.0):
            text += f"; {_describe_limit(-approach.distance_m, approach.limit, approach.speed_mps)}"
    return text


def _describe_limit(out_m: float, limit: str, outward_mps: float) -> str:
    """Return how far beyond a limit the vehicle is, and that it could not stop where it flies outward."""
    place = f"{out_m:.1f} m beyond the {limit} limit" if out_m > 0.0 else f"{-out_m:.1f} m before the {limit} limit"
    return f"{place} at {outward_mps:.1f} m/s, too fast to stop in time" if outward_mps > STANDS_MPS else place
