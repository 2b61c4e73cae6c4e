"""Attitude of relayed poses against the vehicle's own sensors. Pure; time is an argument.

1. Compare the direction of down in body axes with the vehicle's own. Gravity shows it to a vehicle without cameras.
2. Compare the change of heading with the integral of the vehicle's gyroscopes. The vehicle's own heading is not
   independent: it may come from the very poses that are checked, and turns with them.
3. Without data of the vehicle: compare with the last accepted pose. No vehicle turns faster than `MAX_TURN_RPS`.

PX4 and ArduPilot use the attitude of VISION_POSITION_ESTIMATE and ODOMETRY for the heading. PX4 also turns positions by
it where it does not fuse the heading. VISION_POSITION_ESTIMATE cannot say that its attitude is unknown. So a pose with
a wrong attitude is kept back as a whole.
"""

from __future__ import annotations

import math

from uavctl.arrays import SECOND_NS, sum_in_order
from uavctl.frames import Quaternion, euler_from_quaternion
from uavctl.mavlink.vehicle_turn import MotionSample, VehicleTurn, compute_down, wrap_angle
from uavctl.records import Vec3

TILTED, TURNED = "tilted", "turned"
# Vehicles limit their turns by default to 220°/s (PX4, MC_ROLLRATE_MAX) and 202.5°/s (ArduCopter, PILOT_Y_RATE).
# Higher limits are for acrobatics.
MAX_TURN_RPS = math.radians(360.0)
NOISE_RAD = math.radians(15.0)  # small bodies with near markers: 3° of noise, five standard deviations
# The body's definition in a camera system: 10°; tilt at 100°/s between two messages of the vehicle, 0.2 s: 20°.
MAX_TILT_RAD = math.radians(30.0)
# Noise 15° as above, and 5° for gyroscopes that drift by 0.25°/s in `FORGET_S`. A position loop stays stable with it.
MAX_HEADING_RAD = math.radians(20.0)
# Time constant in which the reference follows a slow difference. Gyroscopes drift by less than 0.3°/s. A heading that
# creeps by more than `MAX_HEADING_RAD / FORGET_S`, 1°/s, is found.
FORGET_S = 20.0
DELAY_S = 0.2  # by which the vehicle's messages may be late on a slow link; it turns on meanwhile
FIRST_POSES = 25  # that must agree before the first heading counts as right: 0.5 s at the usual 50 Hz
# On the ground a heading that is steady for this time is taken as new: a body was defined again.
NEW_HEADING_NS = 5 * SECOND_NS


class AttitudeCheck:
    """Finds poses whose attitude is not the vehicle's."""

    def __init__(self) -> None:
        self._accepted: tuple[int, Quaternion] | None = None  # capture and attitude of the last accepted pose
        self._reference_rad: float | None = None  # heading of poses where the vehicle's turn is zero
        self._start_count = 0  # of the vehicle's turn when the reference was taken
        self._agreed_count = 0  # poses since then that agree
        self._new: tuple[int, float] | None = None  # capture and reference of a new steady heading

    def find_fault(self, captured_ns: int, attitude: Quaternion, turn: VehicleTurn, *, armed: bool) -> str | None:
        """Return the fault of the next pose's attitude, `TILTED` or `TURNED`; None without one."""
        roll_rad, pitch_rad, heading_rad = euler_from_quaternion(attitude)
        samples = turn.select(captured_ns)
        if not samples:
            if self._is_turning_too_fast(captured_ns, attitude):
                return TURNED
        else:
            down = compute_down(roll_rad, pitch_rad)
            if min(_compute_angle(down, sample.down) for sample in samples) > MAX_TILT_RAD:
                return TILTED
            if not self._is_heading_right(captured_ns, attitude, heading_rad, turn, samples, armed=armed):
                return TURNED
        self._accepted = captured_ns, attitude
        return None

    def _is_turning_too_fast(self, captured_ns: int, attitude: Quaternion) -> bool:
        if self._accepted is None:
            return False
        before_ns, before = self._accepted
        # |angle| = 2 arccos |q · p|
        angle_rad = 2.0 * math.acos(min(abs(sum_in_order(a * b for a, b in zip(attitude, before, strict=True))), 1.0))
        return angle_rad > NOISE_RAD + MAX_TURN_RPS * (captured_ns - before_ns) * 1e-9

    def _is_heading_right(
        self,
        captured_ns: int,
        attitude: Quaternion,
        heading_rad: float,
        turn: VehicleTurn,
        samples: list[MotionSample],
        *,
        armed: bool,
    ) -> bool:
        if self._reference_rad is None or self._start_count != turn.start_count:
            if self._is_turning_too_fast(captured_ns, attitude):
                return False
            self._start_reference(heading_rad - samples[-1].turn_rad, turn)
        reference_rad = self._reference_rad or 0.0
        errors_rad = [wrap_angle(heading_rad - sample.turn_rad - reference_rad) for sample in samples]
        error_rad = min(errors_rad, key=abs)
        if abs(error_rad) <= MAX_HEADING_RAD + DELAY_S * abs(samples[-1].rate_rps):
            elapsed_s = 0.0 if self._accepted is None else (captured_ns - self._accepted[0]) * 1e-9
            self._reference_rad = reference_rad + error_rad * min(elapsed_s / FORGET_S, 1.0)
            self._agreed_count += 1
            self._new = None
            return True
        new_rad = heading_rad - samples[-1].turn_rad
        if self._agreed_count < FIRST_POSES or (not armed and self._is_steady(captured_ns, new_rad)):
            self._start_reference(new_rad, turn)
            return True
        return False

    def _start_reference(self, reference_rad: float, turn: VehicleTurn) -> None:
        self._reference_rad, self._start_count, self._agreed_count = reference_rad, turn.start_count, 0
        self._new = None

    def _is_steady(self, captured_ns: int, reference_rad: float) -> bool:
        """Return whether a new heading has agreed with the vehicle's turn for `NEW_HEADING_NS`."""
        if self._new is None or abs(wrap_angle(reference_rad - self._new[1])) > MAX_HEADING_RAD:
            self._new = captured_ns, reference_rad
        return captured_ns - self._new[0] >= NEW_HEADING_NS


def _compute_angle(a: Vec3, b: Vec3) -> float:
    """Compute the angle between two directions [rad]."""
    return math.acos(min(max(sum_in_order(x * y for x, y in zip(a, b, strict=True)), -1.0), 1.0))
