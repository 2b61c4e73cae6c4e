"""What flies when no plan may: brake on the prediction, zero acceleration, the vehicle's own landing.

A state machine of four modes, each with a time limit:

    BRAKE --slow enough, or brake_s over--> HOLD --as its end says--> LAND --next tick--> STOPPED

    end       from HOLD
    RECOVER   LAND after hold_s, if configured; else it holds on
    BARRED    LAND once its zero has been sent, if configured; else it holds on
    STOP      LAND once its zero has been sent, if configured; else STOPPED
    LAND      LAND once its zero has been sent

The way back to TRACK, from BRAKE and HOLD with end RECOVER only, is decided at Δt boundaries
(`uavctl.flight.decide`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum, auto

from uavctl.data import ControlMode, Vec3
from uavctl.flight.limits import ZERO

SETTLE_S = 1.0  # longest time that the last gate may take to let a zero through
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


class End(IntEnum):
    """What the fallback ends in; a greater one overrides a smaller one, and there is no way back to a smaller one."""

    RECOVER = auto()  # plans, once positions are back; until then as configured
    BARRED = auto()  # positions are not believed any more: as configured, and plans never again
    STOP = auto()  # the operator's stop: as configured, and then nothing is sent
    LAND = auto()  # the vehicle's own landing, whatever is configured


@dataclass(frozen=True)
class Fallback:
    """State of the fallback.

    Attributes:
        mode: BRAKE, HOLD, LAND or STOPPED.
        since_ns: When this mode was entered [ns].
        end: What it ends in.
    """

    mode: ControlMode
    since_ns: int
    end: End = End.RECOVER

    @property
    def ended(self) -> bool:
        """Whether the vehicle has been handed over: nothing is sent any more."""
        return self.mode in (ControlMode.LAND, ControlMode.STOPPED)

    @property
    def final(self) -> bool:
        """Whether there is no way back to plans."""
        return self.end is not End.RECOVER


def enter(at_ns: int) -> Fallback:
    """The fallback as it begins."""
    return Fallback(mode=ControlMode.BRAKE, since_ns=at_ns)


def request(fallback: Fallback | None, end: End, at_ns: int) -> Fallback:
    """The fallback once an end other than RECOVER is asked for; braking begins unless it is under way."""
    if fallback is not None and (fallback.ended or fallback.end >= end):
        return fallback
    if fallback is not None and fallback.mode is ControlMode.BRAKE:
        return replace(fallback, end=end)
    return Fallback(mode=ControlMode.BRAKE, since_ns=at_ns, end=end)


def advance(
    fallback: Fallback, at_ns: int, speed_mps: float, sent_mps2: Vec3, parameters: FallbackParameters
) -> Fallback:
    """The fallback at `at_ns`, with all transitions that are due.

    Args:
        fallback: State after the tick before.
        at_ns: Time of this tick [ns].
        speed_mps: Predicted speed now [m/s]; NaN counts as moving.
        sent_mps2: The setpoint of the tick before [m/s²].
        parameters: Times and choices.
    """
    mode = fallback.mode
    if mode is ControlMode.LAND:
        return replace(fallback, mode=ControlMode.STOPPED, since_ns=at_ns)
    elapsed_s = (at_ns - fallback.since_ns) * 1e-9
    if mode is ControlMode.BRAKE and (speed_mps < STILL_MPS or elapsed_s >= parameters.brake_s):
        return replace(fallback, mode=ControlMode.HOLD, since_ns=at_ns)
    # A vehicle keeps its last setpoint for a while: that one is HOLD's zero, once the last gate lets it through.
    settled = fallback.final and (sent_mps2 == ZERO or elapsed_s >= SETTLE_S)
    if mode is ControlMode.HOLD and (settled or elapsed_s >= parameters.hold_s):
        after = _after_hold(fallback.end, parameters.land)
        return fallback if after is mode else replace(fallback, mode=after, since_ns=at_ns)
    return fallback


def acceleration(fallback: Fallback, velocity_mps: Vec3, parameters: FallbackParameters) -> Vec3:
    """Acceleration asked for [m/s²]: against the predicted velocity while braking, else zero."""
    if fallback.mode is not ControlMode.BRAKE:
        return ZERO
    north, east, down = (-parameters.brake_gain_1ps * v for v in velocity_mps)
    return north, east, down


def _after_hold(end: End, land: bool) -> ControlMode:
    if land or end is End.LAND:
        return ControlMode.LAND
    return ControlMode.STOPPED if end is End.STOP else ControlMode.HOLD
