"""A plant whose autopilot integrates an acceleration setpoint into a velocity and position that its own loops hold.

Each axis moves under a force f (wind, an error of the hover thrust) that is a random walk, f' = n:

    p' = v,    v' = b + f - c v + w,    T b' = u + kv (s + kp q) + j - b,    j' = ki (s + kp q),
    q' = s,    s' = u - v',

with the reference's lead q, s over position and velocity, the acceleration b that the loops make and their integral j.
Only the sums a = b + f and i = j + f meet a motion, and both take a change of f at once:

    v' = a - c v + w,    T a' = u + kv (s + kp q) + i - a + T n,    i' = ki (s + kp q) + n

So a force that stays needs no state, and where it is learnt the loops are known to fly against it already. The lead
and not the reference is the state: it is zero where the loops begin, wherever that is.

The input is u = r + e of what was sent, r, and an error e: jerk limits, setpoints that come late or not at all, and a
vehicle's own estimate that wanders, move the reference by what nobody sent. Without it the reference would be the sum
of all that was ever sent, and no position could correct it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from uavctl.errors import DesignError
from uavctl.smpc.plant import Plant
from uavctl.smpc.sampling import exponential

Array = NDArray[np.float64]

_FURTHER = (
    ("acceleration", "m/s²"),
    ("reference's lead in position", "m"),
    ("reference's lead in velocity", "m/s"),
    ("own integral", "m/s²"),
)
STATES = 2 + len(_FURTHER)  # of an axis: p, v, a, q, s, i


class HeldAxis(NamedTuple):
    """Numbers of one axis.

    Attributes:
        drag_1ps: Drag c [1/s].
        lag_s: Lag T of the acceleration [s].
        position_1ps: Gain kp of the position loop [1/s].
        velocity_1ps: Gain kv of the velocity loop [1/s].
        integral_1ps2: Integral gain ki of the velocity loop [1/s²].
        wind_std_mps2: Standard deviation of w, held over Δt [m/s²].
        input_std_mps2: Standard deviation of e, held over Δt [m/s²].
        force_drift_mps2_rts: Standard deviation of what f gains in a second [m/s² / √s].
    """

    drag_1ps: float
    lag_s: float
    position_1ps: float
    velocity_1ps: float
    integral_1ps2: float
    wind_std_mps2: float
    input_std_mps2: float
    force_drift_mps2_rts: float


def velocity_reference(held: Sequence[HeldAxis], dt_s: float, axes: tuple[str, ...]) -> Plant:
    """Axes with the states (p, v, a, q, s, i), input r, and the disturbances (w, e, n), all held over Δt.

    Args:
        held: Numbers of each axis.
        dt_s: Δt [s].
        axes: Axes of local NED.

    Raises:
        DesignError: Not one entry for each axis, or a lag or gain that is not positive: without one of the gains
            there are states that no input moves.
    """
    if len(held) != len(axes):
        raise DesignError("plant.lag_s", f"{len(held)} entries for {len(axes)} axes", "give one an axis")
    for key in ("lag_s", "position_1ps", "velocity_1ps", "integral_1ps2"):
        values = [getattr(one, key) for one in held]
        if min(values, default=1.0) <= 0.0:
            raise DesignError(f"plant.{key}", f"{values} has a number that is not positive", "give numbers above 0")
    parts = [exponential(_generator(one) * dt_s)[:STATES] for one in held]
    # n is what f gains in a second: over a step it gains n Δt, with the deviation drift √Δt.
    spread = [(one.wind_std_mps2, one.input_std_mps2, one.force_drift_mps2_rts / np.sqrt(dt_s)) for one in held]
    return Plant(
        a=block_diag(*(part[:, :STATES] for part in parts)),
        b=block_diag(*(part[:, STATES : STATES + 1] for part in parts)),
        e=block_diag(*(part[:, [STATES + 1, STATES, STATES + 2]] for part in parts)),
        w=np.diag(np.square(np.array(spread, dtype=np.float64)).ravel()),
        dt_s=dt_s,
        axes=axes,
        position_index=tuple(range(0, STATES * len(axes), STATES)),
        velocity_index=tuple(range(1, STATES * len(axes), STATES)),
        accel_per_input=np.ones(len(axes)),
        further=_FURTHER,
    )


def _generator(one: HeldAxis) -> Array:
    """Slope (9, 9) of (p, v, a, q, s, i, u, w, n)."""
    slope = np.zeros((STATES + 3, STATES + 3))
    _, v, a, q, s, i, u, w, n = np.eye(STATES + 3)
    error = s + one.position_1ps * q
    slope[0] = v
    slope[1] = a - one.drag_1ps * v + w
    slope[2] = (u + one.velocity_1ps * error + i - a) / one.lag_s + n
    slope[3] = s
    slope[4] = u - slope[1]
    slope[5] = one.integral_1ps2 * error + n
    return slope
