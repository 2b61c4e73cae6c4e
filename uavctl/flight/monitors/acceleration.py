"""Monitor: do positions show an acceleration that no setpoint asked for? Do they scatter?

1. The observer (`uavctl.flight.monitors.observer`) gives the unexplained acceleration at each position.
2. Drag explains the part that points against the velocity.
3. Where inertial data show the same acceleration, it is wind or a hit: a push, and positions are right.
4. What is left is compared with its bound: for 0.1 s, or at once if it is 1.5 times the bound. Then: end the plans.
5. Three clipped innovations of the last five: positions scatter. Then: end the plans.

A frame that is turned, mirrored or in another unit gives the acceleration sent a wrong direction or size. A marker that
came loose shows none at all.

False alarms (docs/soak.md): 0 of 200 missions, with a bound of 1.5 m/s². The largest unexplained acceleration was
0.97 m/s² with PX4 and 1.82 m/s² with ArduPilot, whose standard deviation was larger, too. Scatter: 0 of 200.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from msgspec.structs import replace

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.limits import GRAVITY_MPS2
from uavctl.flight.monitors.motion import Motion, PositionObservation
from uavctl.flight.monitors.noise import LARGEST_STD_M
from uavctl.flight.monitors.observation import MOTION_NS, describe_vector
from uavctl.flight.monitors.observer import POSITION_STD_M, Observer, measure_size_mps2, remove_drag
from uavctl.flight.monitors.verdict import NO_VERDICT, Verdict, end_plans
from uavctl.records import VehicleMotion

CLIPPED_LIMIT, CLIPPED_OF = 3, 5  # so many clipped innovations of the last ones are no chance
PERSISTS_NS = 100_000_000  # time for which it has to last, over two positions at least
IMMEDIATE_RATIO = 1.5  # of the bound: from there on one position is enough
MIN_SIGMA = 1.5  # it counts from so many of its standard deviations on,
MIN_SIGMA_NOISY = 4.0  # and from so many where positions are noisier than `USUAL_STD_M`: chance alone makes two of them
HINT_RATIO = 0.4  # of the bound: above it, a difference of velocities counts at once
CLEAN_RATIO = 0.5  # of the bound: up to it, a position is clean
# Of the bound: a push that inertial data show explains nothing up to it, and a strong push ends at it.
PUSH_RATIO = 0.5
MIN_UP = 0.1  # vertical part of the thrust below which the vehicle lies on its side
_COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


class AccelerationState(msgspec.Struct, frozen=True):
    """State of the monitor."""

    unexplained_mps2: float | None = None  # size that no setpoint asked for at the last position; None before any
    ratio: float = 0.0  # size that nothing explains, over its bound
    clipped: tuple[bool, ...] = ()  # whether each of the last innovations was clipped, newest last
    is_pushed: bool = False  # whether inertial data explain more than the bound
    over_ns: int | None = None  # capture time from which it has been beyond its bound [ns]; None while it is not

    @property
    def is_hinted(self) -> bool:
        """Whether something may be wrong."""
        return self.ratio > HINT_RATIO

    @property
    def is_clean(self) -> bool:
        """Whether the last position is clean."""
        return self.ratio <= CLEAN_RATIO and self.clipped[-1:] != (True,)


def update(state: AccelerationState, observation: PositionObservation) -> tuple[AccelerationState, Verdict]:
    """Take a position."""
    if observation.begins:
        return replace(state, ratio=0.0, clipped=(), over_ns=None), NO_VERDICT
    observer, bound_mps2 = observation.observer, observation.parameters.unexplained_mps2
    unexplained = remove_drag(observer.mean[2], observer.mean[1])
    beside_sent_mps2 = measure_size_mps2(unexplained)
    is_pushed, beside_mps2 = _explain_push(state, observation.motion, beside_sent_mps2, bound_mps2)
    ratio = beside_mps2 / bound_mps2
    # |d| > 1.5 √P_dd
    sigma = MIN_SIGMA_NOISY if POSITION_STD_M < observation.std_m <= LARGEST_STD_M else MIN_SIGMA
    is_significant = beside_mps2 > sigma * math.sqrt(observer.cov[2, 2])
    over_ns = (state.over_ns or observation.at_ns) if ratio > 1.0 and is_significant else None
    clipped = (*state.clipped, observation.is_clipped)[-CLIPPED_OF:]
    state = AccelerationState(beside_sent_mps2, ratio, clipped, is_pushed, over_ns)
    if over_ns is not None and (ratio >= IMMEDIATE_RATIO or observation.at_ns - over_ns >= PERSISTS_NS):
        return state, end_plans(EventCode.RESPONSE, _describe_response(unexplained, observation))
    if sum(clipped) >= CLIPPED_LIMIT:
        return state, end_plans(EventCode.SCATTER, "positions scatter more than the vehicle can move")
    return state, NO_VERDICT


def _explain_push(
    state: AccelerationState, motion: Motion, beside_sent_mps2: float, bound_mps2: float
) -> tuple[bool, float]:
    """Return whether inertial data explain a strong push, and the size of the acceleration that is left [m/s²].

    A push of no more than half of what positions may show unexplained explains nothing.

    Args:
        beside_sent_mps2: Size of the acceleration that no setpoint asked for [m/s²].
    """
    observer = motion.observer
    if observer is None or observer.inertial is None:
        return state.is_pushed, beside_sent_mps2
    if not measure_size_mps2(motion.push_mps2) > PUSH_RATIO * bound_mps2:
        return False, beside_sent_mps2
    beside_mps2 = min(beside_sent_mps2, measure_size_mps2(remove_drag(observer.inertial[2], observer.inertial[1])))
    return beside_sent_mps2 > (PUSH_RATIO if state.is_pushed else 1.0) * bound_mps2 >= beside_mps2, beside_mps2


def _describe_response(unexplained: Array, observation: PositionObservation) -> str:
    observer, tick = observation.observer, observation.tick
    text = (
        f"positions show an acceleration of {describe_vector(unexplained)} m/s² beside that of the setpoints "
        f"({describe_vector(observer.accel_mps2)} m/s²)"
    )
    leans = _leans_as_sent(observer, unexplained, tick.motion, tick.at_ns)
    return text if leans is None else f"{text}; the vehicle {'tilts' if leans else 'does not tilt'} as commanded"


def describe_push(motion: Motion, vehicle: VehicleMotion | None, at_ns: int) -> str:
    """Return the push that inertial data explain in words."""
    observer, push = motion.observer, motion.push_mps2
    leans = None if observer is None else _leans_as_sent(observer, np.array(push), vehicle, at_ns)
    return describe_acceleration(push, leans)


def describe_acceleration(push_mps2: Sequence[float], leans: bool | None) -> str:
    """Return a push in words.

    Args:
        push_mps2: Acceleration that no setpoint asked for, local NED [m/s²].
        leans: Whether the autopilot leans as it was told; None where that is not known.
    """
    north, east, down = push_mps2
    sideways = math.hypot(north, east)
    if abs(down) > sideways:
        size, way = abs(down), "down" if down > 0.0 else "up"
    else:
        size, way = sideways, _COMPASS[round(math.atan2(east, north) / (0.25 * math.pi)) % len(_COMPASS)]
    tilt = {
        None: "",
        True: " although the autopilot tilted as commanded",
        False: ", and the autopilot did not tilt as commanded",
    }[leans]
    return f"Pushed {size:.1f} m/s² {way}{tilt}: strong wind or a hit. Positions and IMU data agree."


def _leans_as_sent(observer: Observer, unexplained: Array, vehicle: VehicleMotion | None, at_ns: int) -> bool | None:
    """Return whether the vehicle leans as it was told, beside an unexplained acceleration; None where unknown."""
    lean = None if vehicle is None else compute_lean_mps2(vehicle, at_ns)
    if lean is None:
        return None
    off = math.hypot(lean[0] - float(observer.accel_mps2[0]), lean[1] - float(observer.accel_mps2[1]))
    return off <= 0.5 * math.hypot(*unexplained)


def compute_lean_mps2(motion: VehicleMotion, at_ns: int) -> tuple[float, float] | None:
    """Compute the horizontal acceleration (north, east) that an attitude gives a vehicle whose thrust carries it."""
    if motion.attitude_rad is None or motion.attitude_ns is None or at_ns - motion.attitude_ns > MOTION_NS:
        return None
    roll, pitch, yaw = motion.attitude_rad
    up = math.cos(roll) * math.cos(pitch)
    if up < MIN_UP:
        return None
    # a = g R_z(ψ) (-sin θ cos φ, sin φ) / (cos φ cos θ)
    forward, right = -math.sin(pitch) * math.cos(roll) / up, math.sin(roll) / up
    north = forward * math.cos(yaw) - right * math.sin(yaw)
    east = forward * math.sin(yaw) + right * math.cos(yaw)
    return GRAVITY_MPS2 * north, GRAVITY_MPS2 * east
