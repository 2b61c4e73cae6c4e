"""Fallback that flies when no plan may: brake, zero acceleration, the vehicle's own landing.

A state machine of four modes, each with a time limit:

    BRAKE --slow enough, or brake_s over--> HOLD --by its reason--> LAND --next tick--> STOPPED

    reason                 from HOLD
    RECOVER                LAND after hold_s, or blind_hold_s, if configured; else it holds on
    VELOCITY_WRONG         LAND once its zero has been sent, if configured; else STOPPED; it does not brake again before
    CONTROLLER_FAILED      LAND once its zero has been sent, if configured; else STOPPED
    POSITIONS_DISTRUSTED   the same
    ENVELOPE               the same; it does not brake before, as no position is believed: level at once
    STOP                   LAND once its zero has been sent, if configured; else STOPPED
    LAND                   LAND once its zero has been sent

1. Braking goes by the vehicle's own velocity where that may be believed (`uavctl.flight.monitors.vehicle_velocity`),
   else by the predicted one. Where they point against each other, it brakes by what recent positions show, or by the
   mean of both where inertial data carry the prediction on.
   By its own velocity the vehicle brakes again if it drifts while it holds; the time to hold runs on.
2. HOLD begins only when the setpoint has come down to the acceleration of HOLD, so it never accelerates. By a
   prediction from inputs alone the vehicle brakes only until that is slow.
3. Near a wall or the ceiling, braking ends at a slow retreat from it, and HOLD never accelerates to it: without
   positions the vehicle drifts, and its distance from the limit is not known well. Positions that are distrusted show
   no limit to retreat from.
4. Where the vehicle's own inertial data carry the estimate on, HOLD brings it back gently to the place where it began.
5. The way back to TRACK, from BRAKE and HOLD with reason RECOVER only, is decided at Δt boundaries
   (`uavctl.flight.decide`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum, auto

from uavctl.flight.limits import ZERO
from uavctl.records import ControlMode, Vec3

SETTLE_S = 1.0  # longest time in which the setpoint limiter reaches zero
STILL_MPS = 0.02  # below this speed the vehicle is at rest
# The same of a prediction by inputs alone: it is no better than this. An error would be braked on for seconds.
OPEN_LOOP_STILL_MPS = 0.1
DRIFT_MPS = 0.15  # above this speed, by its own velocity, a vehicle that holds drifts
CALM_MPS2 = 0.04  # HOLD begins when the setpoint is this close to its own
RETURN_GAIN_1PS2, RETURN_GAIN_1PS = 1.0, 1.5  # gains of distance and speed on the way back: two seconds
NEAR_LIMIT_M = 0.5  # distance of a limit to retreat from: without positions an estimate may be off by as much
RETREAT_MPS = 0.15  # no faster than a drift: HOLD follows where one axis retreats
RETURN_MPS2 = 1.0  # largest acceleration in any axis on the way back: the estimate may be wrong


@dataclass(frozen=True)
class FallbackParameters:
    """Parameters of the fallback."""

    brake_gain_1ps: float  # deceleration per predicted speed [1/s]
    brake_s: float  # longest time of braking [s]
    hold_s: float  # time of zero acceleration before landing [s]
    blind_hold_s: float  # longest time of it where not even the vehicle itself tells whether it drifts [s]
    land: bool  # whether the vehicle's own landing is requested after that
    recover_samples: int  # fresh samples in a row before plans are flown again


class FallbackReason(IntEnum):
    """Reason of the fallback, which decides its end. A greater one overrides a smaller one, for good."""

    RECOVER = auto()  # too few positions: plans fly again once they are back
    # The vehicle's own velocity was found wrong or has stopped: it cannot check positions that come back.
    VELOCITY_WRONG = auto()
    CONTROLLER_FAILED = auto()  # a controller of another package has failed: no plan again
    POSITIONS_DISTRUSTED = auto()  # no position is believed any more: no plan again
    ENVELOPE = auto()  # a monitor found the motion impossible: no plan again, and no braking
    STOP = auto()  # the operator's stop (Ctrl-C), or the end of the time to fly
    LAND = auto()  # an order to land, or the mission is over: it lands whatever `fallback.land` says


@dataclass(frozen=True)
class Fallback:
    """State of the fallback."""

    mode: ControlMode  # BRAKE, HOLD, LAND or STOPPED
    since_ns: int  # when this mode was entered [ns]
    reason: FallbackReason = FallbackReason.RECOVER
    held_ns: int | None = None  # when it first held [ns]; None before

    @property
    def is_over(self) -> bool:
        """Whether the fallback is over: no setpoint is sent any more."""
        return self.mode in (ControlMode.LAND, ControlMode.STOPPED)

    @property
    def is_final(self) -> bool:
        """Whether there is no way back to plans."""
        return self.reason is not FallbackReason.RECOVER


def begin_fallback(at_ns: int) -> Fallback:
    """Begin the fallback."""
    return Fallback(mode=ControlMode.BRAKE, since_ns=at_ns)


def request_fallback(fallback: Fallback | None, reason: FallbackReason, at_ns: int) -> Fallback:
    """Request a reason other than RECOVER. The fallback brakes first, unless no velocity may be believed."""
    if fallback is not None and (fallback.is_over or fallback.reason >= reason):
        return fallback
    if reason is FallbackReason.ENVELOPE:
        return Fallback(mode=ControlMode.HOLD, since_ns=at_ns, reason=reason)
    if fallback is not None:
        has_braked = fallback.reason is FallbackReason.ENVELOPE or reason is FallbackReason.VELOCITY_WRONG
        if fallback.mode is ControlMode.BRAKE or has_braked:
            return replace(fallback, reason=reason)
    return Fallback(mode=ControlMode.BRAKE, since_ns=at_ns, reason=reason)


def restart_hold(fallback: Fallback, at_ns: int) -> Fallback:
    """Restart the time to hold: positions are back, and are compared before plans fly again."""
    return fallback if fallback.held_ns is None else replace(fallback, held_ns=at_ns)


def advance_fallback(
    fallback: Fallback,
    at_ns: int,
    speed_mps: float,
    sent_mps2: Vec3,
    parameters: FallbackParameters,
    hold_accel_mps2: Vec3 = ZERO,
    *,
    is_measured: bool = False,
    is_open_loop: bool = False,
    is_blind: bool = False,
) -> Fallback:
    """Advance the fallback to `at_ns`, with all transitions that are due.

    Args:
        at_ns: Time of this tick [ns].
        speed_mps: Speed now, beside that of a retreat [m/s]; NaN counts as moving.
        sent_mps2: The setpoint of the tick before [m/s²].
        hold_accel_mps2: Acceleration of HOLD [m/s²].
        is_measured: Whether the speed is the vehicle's own velocity, not a prediction.
        is_open_loop: Whether it is a prediction that no recent position, and no inertial data, carry on.
        is_blind: Whether it is a prediction without a recent position: nothing shows a drift.
    """
    mode = fallback.mode
    if mode is ControlMode.STOPPED:
        return fallback
    if mode is ControlMode.LAND:
        return replace(fallback, mode=ControlMode.STOPPED, since_ns=at_ns)
    elapsed_s = (at_ns - fallback.since_ns) * 1e-9
    held_ns = fallback.since_ns if fallback.held_ns is None else fallback.held_ns
    hold_s = min(parameters.hold_s, parameters.blind_hold_s) if is_blind else parameters.hold_s
    due = (mode is ControlMode.HOLD or fallback.held_ns is not None) and (at_ns - held_ns) * 1e-9 >= hold_s
    if mode is ControlMode.BRAKE and not due:
        slow = speed_mps < (OPEN_LOOP_STILL_MPS if is_open_loop else STILL_MPS) or elapsed_s >= parameters.brake_s
        off_mps2 = max(abs(sent - held) for sent, held in zip(sent_mps2, hold_accel_mps2, strict=True))
        if slow and (is_open_loop or off_mps2 <= CALM_MPS2 or elapsed_s >= parameters.brake_s + SETTLE_S):
            held_ns = at_ns if fallback.held_ns is None else held_ns
            return replace(fallback, mode=ControlMode.HOLD, since_ns=at_ns, held_ns=held_ns)
        return fallback
    # A vehicle keeps its last setpoint for a while: that one is HOLD's zero, once the setpoint limiter lets it through.
    settled = fallback.is_final and (sent_mps2 == ZERO or elapsed_s >= SETTLE_S)
    if settled or due:
        after = _follow_hold(fallback.reason, parameters.land)
        if after is not ControlMode.HOLD:
            return replace(fallback, mode=after, since_ns=at_ns)
    if mode is ControlMode.HOLD and is_measured and not fallback.is_final and speed_mps > DRIFT_MPS:
        return replace(fallback, mode=ControlMode.BRAKE, since_ns=at_ns)
    return fallback


def compute_brake_accel(fallback: Fallback, at_ns: int, velocity_mps: Vec3, parameters: FallbackParameters) -> Vec3:
    """Compute the acceleration [m/s²] against the velocity while braking, else zero."""
    over = at_ns - fallback.since_ns >= parameters.brake_s * 1e9
    if fallback.mode is not ControlMode.BRAKE or over:
        return ZERO
    # a = -g v
    north, east, down = (-parameters.brake_gain_1ps * v for v in velocity_mps)
    return north, east, down


def compute_return_accel(off_m: Vec3, velocity_mps: Vec3) -> Vec3:
    """Compute the acceleration [m/s²] that brings a vehicle gently back to its place; zero in an axis that is NaN."""
    # a = -k_p (p - p_0) - k_v v, each axis within ±1 m/s²
    north, east, down = (
        _limit_return(-RETURN_GAIN_1PS2 * p - RETURN_GAIN_1PS * v) for p, v in zip(off_m, velocity_mps, strict=True)
    )
    return north, east, down


def _limit_return(accel_mps2: float) -> float:
    return min(max(accel_mps2, -RETURN_MPS2), RETURN_MPS2) if math.isfinite(accel_mps2) else 0.0


def find_retreat(position_m: Vec3, lower_m: Vec3, upper_m: Vec3) -> Vec3:
    """Find the velocity [m/s] away from the limits that the estimated position is near to; zero in other axes.

    The floor is no limit to retreat from.
    """
    north, east, down = (
        RETREAT_MPS * ((position - lower < NEAR_LIMIT_M) - (upper - position < NEAR_LIMIT_M))
        for position, lower, upper in zip(position_m, lower_m, (*upper_m[:2], math.inf), strict=True)
    )
    return north, east, down


def keep_from_limits(accel_mps2: Vec3, retreat_mps: Vec3) -> Vec3:
    """Remove from the acceleration of HOLD [m/s²] what points against the retreat from limits."""
    north, east, down = (
        0.0 if accel * retreat < 0.0 else accel for accel, retreat in zip(accel_mps2, retreat_mps, strict=True)
    )
    return north, east, down


def _follow_hold(reason: FallbackReason, land: bool) -> ControlMode:
    if land or reason is FallbackReason.LAND:
        return ControlMode.LAND
    return ControlMode.HOLD if reason is FallbackReason.RECOVER else ControlMode.STOPPED
