"""A simulated vehicle at one instant, for whoever watches."""

from __future__ import annotations

from dataclasses import dataclass

from uavctl.data import Vec3


@dataclass(frozen=True)
class Look:
    """What can be seen of one vehicle; positions and velocities are the true ones, local NED.

    Attributes:
        system_id: MAVLink system id.
        time_s: since the start.
        mode: the autopilot's own name of it, or CRASHED.
        armed: whether it is armed.
        phase: where it is: ground, air, climb, descent.
        position_m: position.
        velocity_mps: velocity.
        battery: charge left, 0 to 1.
        steered_by: (system, component) id of whom the last setpoint came from, None before the first.
        setpoint_age_s: time since that setpoint, None before the first.
        sent: positions that the cameras sent.
        lost: those of them that the link lost.
        faults: what is amiss, as kinds of faults.
        text: the last STATUSTEXT.
    """

    system_id: int
    time_s: float
    mode: str
    armed: bool
    phase: str
    position_m: Vec3
    velocity_mps: Vec3
    battery: float
    steered_by: tuple[int, int] | None
    setpoint_age_s: float | None
    sent: int
    lost: int
    faults: tuple[str, ...]
    text: str
