"""Fallback that flies when no plan may: brake, zero acceleration, the vehicle's own landing.

A state machine of four modes, each with a time limit:

    BRAKE --slow enough, or brake_s over--> HOLD --as its end says--> LAND --next tick--> STOPPED

    end       from HOLD
    RECOVER   LAND after hold_s, or blind_hold_s, if configured; else it holds on
    UNPLANNED LAND once its zero has been sent, if configured; else STOPPED
    BARRED    the same
    LET_GO    the same; and nothing is braked on before, as no position is believed: level at once
    STOP      LAND once its zero has been sent, if configured; else STOPPED
    LAND      LAND once its zero has been sent

Braking goes by the vehicle's own velocity where that may be believed (`uavctl.flight.envelope`), else by the
predicted one. By its own velocity it brakes again if it drifts while it holds; the time to hold runs on meanwhile.
HOLD begins only when the setpoint has come down to what is held: it never accelerates. Where the vehicle's own
inertial data carry the estimate on, HOLD brings it back to where it began to hold, gently.

The way back to TRACK, from BRAKE and HOLD with end RECOVER only, is decided at Δt boundaries
(`uavctl.flight.decision`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum, auto

from uavctl.flight.limits import ZERO
from uavctl.records import ControlMode, Vec3, Vector

SETTLE_S = 1.0  # longest time that the last gate may take to let a zero through
STILL_MPS = 0.02  # below this speed there is nothing left to brake
DRIFT_MPS = 0.15  # above this speed, by the vehicle's own word, it drifts
CALM_MPS2 = 0.04  # HOLD begins within this of what it sends
BACK_1PS2, BACK_1PS = 1.0, 1.5  # of way and speed while it holds by inertial data: back within two seconds
BACK_MPS2 = 1.0  # and no more than this in any axis: the estimate may be poisoned
LEARNT_NS = 2_000_000_000  # a bias counts that has been there for so long,
LATELY_NS = 3_000_000_000  # as far as it has been there for all of this time


@dataclass(frozen=True)
class FallbackParameters:
    """Parameters of the fallback."""

    brake_gain_1ps: float  # deceleration per predicted speed [1/s]
    brake_s: float  # longest time of braking [s]
    hold_s: float  # time of zero acceleration before landing [s]
    blind_hold_s: float  # longest time of it where not even the vehicle itself tells whether it drifts [s]
    land: bool  # whether to hand over to the vehicle's own landing after that
    recover_samples: int  # fresh samples in a row before plans are flown again


class FallbackEnd(IntEnum):
    """End of the fallback; a greater one overrides a smaller one, and there is no way back to a smaller one."""

    RECOVER = auto()  # plans, once positions are back; until then as configured
    UNPLANNED = auto()  # a controller of another package has failed: as configured, and plans never again
    BARRED = auto()  # positions are not believed any more: as configured, and plans never again
    LET_GO = auto()  # what is seen cannot be: the same, and nothing is braked on
    STOP = auto()  # the operator's stop: as configured, and then nothing is sent
    LAND = auto()  # the vehicle's own landing, whatever is configured


@dataclass(frozen=True)
class Fallback:
    """State of the fallback."""

    mode: ControlMode  # BRAKE, HOLD, LAND or STOPPED
    since_ns: int  # when this mode was entered [ns]
    end: FallbackEnd = FallbackEnd.RECOVER  # end of the fallback
    held_ns: int | None = None  # when it first held [ns]; None before

    @property
    def ended(self) -> bool:
        """Whether the vehicle has been handed over: nothing is sent any more."""
        return self.mode in (ControlMode.LAND, ControlMode.STOPPED)

    @property
    def final(self) -> bool:
        """Whether there is no way back to plans."""
        return self.end is not FallbackEnd.RECOVER


def enter(at_ns: int) -> Fallback:
    """The fallback as it begins."""
    return Fallback(mode=ControlMode.BRAKE, since_ns=at_ns)


def request(fallback: Fallback | None, end: FallbackEnd, at_ns: int) -> Fallback:
    """The fallback once an end other than RECOVER is asked for; it brakes first, unless nothing may be braked on."""
    if fallback is not None and (fallback.ended or fallback.end >= end):
        return fallback
    if end is FallbackEnd.LET_GO:
        return Fallback(mode=ControlMode.HOLD, since_ns=at_ns, end=end)
    if fallback is not None and (fallback.mode is ControlMode.BRAKE or fallback.end is FallbackEnd.LET_GO):
        return replace(fallback, end=end)
    return Fallback(mode=ControlMode.BRAKE, since_ns=at_ns, end=end)


def advance(
    fallback: Fallback,
    at_ns: int,
    speed_mps: float,
    sent_mps2: Vec3,
    parameters: FallbackParameters,
    held_mps2: Vec3 = ZERO,
    *,
    measured: bool = False,
    blind: bool = False,
) -> Fallback:
    """The fallback at `at_ns`, with all transitions that are due.

    Args:
        at_ns: Time of this tick [ns].
        speed_mps: Speed now [m/s]; NaN counts as moving.
        sent_mps2: The setpoint of the tick before [m/s²].
        held_mps2: What HOLD sends [m/s²].
        measured: Whether the speed is the vehicle's own word, not a prediction.
        blind: Whether it is a prediction without a position of late: nothing tells a drift.
    """
    mode = fallback.mode
    if mode is ControlMode.STOPPED:
        return fallback
    if mode is ControlMode.LAND:
        return replace(fallback, mode=ControlMode.STOPPED, since_ns=at_ns)
    elapsed_s = (at_ns - fallback.since_ns) * 1e-9
    held_ns = fallback.since_ns if fallback.held_ns is None else fallback.held_ns
    hold_s = min(parameters.hold_s, parameters.blind_hold_s) if blind else parameters.hold_s
    due = (mode is ControlMode.HOLD or fallback.held_ns is not None) and (at_ns - held_ns) * 1e-9 >= hold_s
    if mode is ControlMode.BRAKE and not due:
        slow = speed_mps < STILL_MPS or elapsed_s >= parameters.brake_s
        off_mps2 = max(abs(sent - held) for sent, held in zip(sent_mps2, held_mps2, strict=True))
        if slow and (off_mps2 <= CALM_MPS2 or elapsed_s >= parameters.brake_s + SETTLE_S):
            held_ns = at_ns if fallback.held_ns is None else held_ns
            return replace(fallback, mode=ControlMode.HOLD, since_ns=at_ns, held_ns=held_ns)
        return fallback
    # A vehicle keeps its last setpoint for a while: that one is HOLD's zero, once the last gate lets it through.
    settled = fallback.final and (sent_mps2 == ZERO or elapsed_s >= SETTLE_S)
    if settled or due:
        after = _after_hold(fallback.end, parameters.land)
        if after is not ControlMode.HOLD:
            return replace(fallback, mode=after, since_ns=at_ns)
    if mode is ControlMode.HOLD and measured and not fallback.final and speed_mps > DRIFT_MPS:
        return replace(fallback, mode=ControlMode.BRAKE, since_ns=at_ns)
    return fallback


def acceleration(fallback: Fallback, at_ns: int, velocity_mps: Vec3, parameters: FallbackParameters) -> Vec3:
    """Acceleration asked for [m/s²]: against the velocity while braking, else zero."""
    over = at_ns - fallback.since_ns >= parameters.brake_s * 1e9
    if fallback.mode is not ControlMode.BRAKE or over:
        return ZERO
    north, east, down = (-parameters.brake_gain_1ps * v for v in velocity_mps)
    return north, east, down


def stop_m(speed_mps: float, most_mps2: float, parameters: FallbackParameters) -> float:
    """Distance that braking takes [m], with so much acceleration at most, and no lag."""
    gentle_mps = most_mps2 / parameters.brake_gain_1ps  # below this speed it brakes by less
    if speed_mps <= gentle_mps:
        return speed_mps / parameters.brake_gain_1ps
    return (speed_mps**2 - gentle_mps**2) / (2.0 * most_mps2) + gentle_mps / parameters.brake_gain_1ps


def back(off_m: Vec3, velocity_mps: Vec3) -> Vec3:
    """Acceleration [m/s²] that brings a vehicle gently to rest where it is to hold; zero of what is NaN."""
    north, east, down = (_gently(-BACK_1PS2 * p - BACK_1PS * v) for p, v in zip(off_m, velocity_mps, strict=True))
    return north, east, down


def _gently(accel_mps2: float) -> float:
    return min(max(accel_mps2, -BACK_MPS2), BACK_MPS2) if math.isfinite(accel_mps2) else 0.0


def _after_hold(end: FallbackEnd, land: bool) -> ControlMode:
    if land or end is FallbackEnd.LAND:
        return ControlMode.LAND
    return ControlMode.HOLD if end is FallbackEnd.RECOVER else ControlMode.STOPPED


# The bias that braking and holding count on

Biases = tuple[tuple[int, Vector], ...]  # (time [ns], estimated bias (n_u,)), oldest first


def learnt(biases: Biases) -> Vector:
    """Return the part of a bias (n_u,) that has lasted through recent time; zero if it has not been known for long.

    In the first seconds, and where the vehicle does not answer as the model says, an estimated bias comes and goes with
    what is flown; blind, its acceleration would be flown for seconds.
    """
    if not biases:
        return ()
    known = biases[-1][0] - biases[0][0] >= LEARNT_NS
    sides = [(min(values), max(values)) for values in zip(*(bias for _, bias in biases), strict=True)]
    return tuple(max(low, 0.0) + min(high, 0.0) if known else 0.0 for low, high in sides)
