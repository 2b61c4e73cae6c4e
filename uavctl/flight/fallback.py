"""What flies when no plan may: brake on the prediction, zero acceleration, the vehicle's own landing.

A state machine of four modes, each with a time limit:

    BRAKE --slow enough, or brake_s over--> HOLD --hold_s over, if land--> LAND --next tick--> STOPPED
    BRAKE --the same, but the operator asked for the hand-over--> LAND if configured, else STOPPED

The way back to TRACK, from BRAKE and HOLD only, is decided at Δt boundaries (`uavctl.flight.decide`).
"""

from __future__ import annotations

from dataclasses import dataclass

from uavctl.data import ControlMode, Vec3
from uavctl.flight.limits import ZERO

STILL_MPS = 0.02  # below this predicted speed there is nothing left to brake


@dataclass(frozen=True)
class FallbackParameters:
    """How the fallback acts.

    Attributes:
        brake_gain_1ps: Deceleration per predicted speed [1/s].
        brake_s: Longest time of braking [s].
        hold_s: Time of zero acceleration before landing [s].
        land: Whether to hand over to the vehicle's own landing after that.
        recover_samples: Fresh samples in a row before plans are flown again.
    """

    brake_gain_1ps: float
    brake_s: float
    hold_s: float
    land: bool
    recover_samples: int


@dataclass(frozen=True)
class Fallback:
    """State of the fallback.

    Attributes:
        mode: BRAKE, HOLD, LAND or STOPPED.
        since_ns: When this mode was entered [ns].
        stopping: The operator asked for the hand-over: there is no way back.
    """

    mode: ControlMode
    since_ns: int
    stopping: bool = False

    @property
    def ended(self) -> bool:
        """Whether the vehicle has been handed over: nothing is sent any more."""
        return self.mode in (ControlMode.LAND, ControlMode.STOPPED)


def enter(at_ns: int) -> Fallback:
    """The fallback as it begins."""
    return Fallback(mode=ControlMode.BRAKE, since_ns=at_ns)


def request_stop(fallback: Fallback | None, at_ns: int) -> Fallback:
    """The fallback once the operator has asked for the hand-over; braking begins unless it is under way."""
    if fallback is not None and (fallback.ended or fallback.stopping):
        return fallback
    since_ns = fallback.since_ns if fallback is not None and fallback.mode is ControlMode.BRAKE else at_ns
    return Fallback(mode=ControlMode.BRAKE, since_ns=since_ns, stopping=True)


def advance(fallback: Fallback, at_ns: int, speed_mps: float, parameters: FallbackParameters) -> Fallback:
    """The fallback at `at_ns`, with all transitions that are due.

    Args:
        fallback: State after the tick before.
        at_ns: Time of this tick [ns].
        speed_mps: Predicted speed now [m/s]; NaN counts as moving.
        parameters: Times and choices.
    """
    mode = fallback.mode
    if mode is ControlMode.LAND:
        return _to(fallback, ControlMode.STOPPED, at_ns)
    elapsed_s = (at_ns - fallback.since_ns) * 1e-9
    if mode is ControlMode.BRAKE and (speed_mps < STILL_MPS or elapsed_s >= parameters.brake_s):
        return _to(fallback, ControlMode.HOLD, at_ns)
    if mode is ControlMode.HOLD and fallback.stopping:
        # A vehicle keeps its last setpoint for a while: that one is HOLD's zero, sent at least once.
        return _to(fallback, ControlMode.LAND if parameters.land else ControlMode.STOPPED, at_ns)
    if mode is ControlMode.HOLD and parameters.land and elapsed_s >= parameters.hold_s:
        return _to(fallback, ControlMode.LAND, at_ns)
    return fallback


def acceleration(fallback: Fallback, velocity_mps: Vec3, parameters: FallbackParameters) -> Vec3:
    """Acceleration asked for [m/s²]: against the predicted velocity while braking, else zero."""
    if fallback.mode is not ControlMode.BRAKE:
        return ZERO
    north, east, down = (-parameters.brake_gain_1ps * v for v in velocity_mps)
    return north, east, down


def _to(fallback: Fallback, mode: ControlMode, at_ns: int) -> Fallback:
    return Fallback(mode=mode, since_ns=at_ns, stopping=fallback.stopping)
