"""Estimator of the simulated autopilot: position from GPS, or from external positions by each autopilot's rules.

With GPS the estimate is the truth. With external positions it carries an error: accelerometers with a constant bias
drift, samples pull the estimate back, and when they stop the error grows unseen. Bias, silence and flags are those of
the recorded loss of the cameras (ArduCopter reports nothing for 7.2 s while the vehicle drifts half a metre).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from sim.autopilot.parameters import Parameters
from sim.autopilot.profile import SimulatedProfile
from sim.vehicle.interface import ZERO, Vehicle, compute_heading_rad, rotate_to_ned, subtract
from uavctl.arrays import SECOND_NS
from uavctl.records import Vec3

STEP_NS = 20_000_000
ACCEL_BIAS_MPS2: Vec3 = (-0.0187, 0.0155, 0.0)  # fitted to the recorded drift: 0.54 m north, -0.43 m east in 7.6 s
LOST_NS = 7_200_000_000  # ArduPilot: from the last sample to flags 0x25
FUSE_S = 0.2  # time constant with which samples pull the estimate
GATE_M = 1.0  # the estimator rejects a sample further off
PX4_GAP_NS = 200_000_000  # PX4 begins to fuse at more than 5 Hz only
# PX4 fuses samples up to EKF2_DELAY_MAX (200 ms) back. It drops those 100 ms older, and those from the future.
PX4_AGES_S = (-0.1, 0.3)
HEADING_S = 1.0  # time constant with which an external heading turns the estimated one; assumed
# ArduPilot limits the innovation of a heading to this, and so follows a wrong one more slowly. Assumed for PX4 too.
MAX_HEADING_INNOVATION_RAD = 0.5
START_NS = SECOND_NS  # of good samples before the estimate counts
LOCAL_FRD, LOCAL_NED, BODY_FRD = 20, 1, 12  # MAV_FRAME

FUSED_MESSAGES = {
    "px4": ("VISION_POSITION_ESTIMATE", "ODOMETRY"),
    "ardupilot": ("VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP", "ODOMETRY"),
}
# ESTIMATOR_STATUS_FLAGS and EKF_STATUS_FLAGS
LOST, ATTITUDE_ONLY = 0x25, 0x1


class Estimator:
    """Position and velocity as the vehicle estimates them.

    Args:
        kind: PX4 or ArduCopter.
        age_ns: function of (stamp, time) [ns]: time of the own clock less the stamp [ns]; PX4 first corrects the stamp
            by its TIMESYNC offset.

    Attributes:
        may_be_valid: whether its position may count as valid.
        heading_error_rad: estimated heading less the true one, by external headings.
        passes_checks: whether pre-flight checks that flicker pass.
        has_origin: whether the geographic origin is known; ArduPilot without GPS waits for SET_GPS_GLOBAL_ORIGIN.
    """

    def __init__(
        self, profile: SimulatedProfile, parameters: Parameters, vehicle: Vehicle, age_ns: Callable[[int, int], int]
    ) -> None:
        self._profile = profile
        self._age_ns = age_ns
        self._parameters = parameters
        self._vehicle = vehicle
        self.has_origin = False
        self.may_be_valid = self.passes_checks = True
        self.heading_error_rad = 0.0
        self._position_error: Vec3 = ZERO
        self._velocity_error: Vec3 = ZERO
        self._updated_ns = vehicle.now_ns
        self._first_ns: int | None = None  # of the good samples without a long gap
        self._last_ns: int | None = None  # arrival of the last sample fused
        self._offset_ns: int | None = None  # least (arrival - stamp)
        self._step_ns = vehicle.now_ns

    @property
    def uses_gps(self) -> bool:
        """Whether positions come from GPS."""
        p = self._parameters
        if self._profile.name == "px4":
            return p["SYS_HAS_GPS"] == 1 and bool(int(p["EKF2_GPS_CTRL"]) & 1)
        return p["GPS1_TYPE"] != 0 and p["EK3_SRC1_POSXY"] == 3

    @property
    def uses_external(self) -> bool:
        """Whether external positions are fused."""
        p = self._parameters
        if self._profile.name == "px4":
            return bool(int(p["EKF2_EV_CTRL"]) & 1)
        return p["VISO_TYPE"] != 0 and p["EK3_SRC1_POSXY"] == 6

    @property
    def uses_external_heading(self) -> bool:
        """Whether external headings are fused."""
        p = self._parameters
        return bool(int(p["EKF2_EV_CTRL"]) & 8) if self._profile.name == "px4" else p["EK3_SRC1_YAW"] == 6

    @property
    def has_heading(self) -> bool:
        """Whether there is a source of heading."""
        p = self._parameters
        if self._profile.name == "px4":
            compass = p["SYS_HAS_MAG"] == 1 and p["EKF2_MAG_TYPE"] != 5
            return compass or (self.uses_external_heading and self._is_fusing)
        if self.uses_external_heading:
            return self._is_fusing
        return p["EK3_SRC1_YAW"] == 1 and any(p[f"COMPASS_USE{n}"] == 1 for n in ("", "2", "3"))

    @property
    def has_height(self) -> bool:
        """Whether there is a source of height."""
        p = self._parameters
        if self._profile.name == "px4":
            gps = self.uses_gps and bool(int(p["EKF2_GPS_CTRL"]) & 2)
            return p["EKF2_BARO_CTRL"] == 1 or gps or bool(int(p["EKF2_EV_CTRL"]) & 2 and self._is_fusing)
        source = p["EK3_SRC1_POSZ"]
        return source == 1 or (source == 3 and p["GPS1_TYPE"] != 0) or (source == 6 and self._is_fusing)

    def start_in_flight(self) -> None:
        """Start as if begun on the ground, with good external positions, an origin and no error."""
        self.has_origin = True
        self._last_ns = self._updated_ns = self._vehicle.now_ns
        self._first_ns = self._last_ns - START_NS

    @property
    def _is_fusing(self) -> bool:
        """Whether external positions have come for long enough and not stopped for too long."""
        if not self.uses_external or self._last_ns is None or self._first_ns is None:
            return False
        now_ns = self._vehicle.now_ns
        lost_ns = 1000 * int(self._parameters["EKF2_NOAID_TOUT"]) if self._profile.name == "px4" else LOST_NS
        return self._last_ns - self._first_ns >= START_NS and now_ns - self._last_ns < lost_ns

    @property
    def has_estimate(self) -> bool:
        """Whether there is an estimate at all, however bad."""
        return self.uses_gps or (self._last_ns is not None and self._knows_origin)

    @property
    def _knows_origin(self) -> bool:
        return self.uses_gps or self.has_origin or self._profile.name == "px4"

    @property
    def has_position(self) -> bool:
        """Whether there is a position, be it one that the vehicle does not trust."""
        return self.uses_gps or (self._is_fusing and self._knows_origin)

    @property
    def is_position_valid(self) -> bool:
        """Whether the vehicle trusts its position."""
        return self.may_be_valid and self.has_position

    @property
    def has_global_position(self) -> bool:
        """Whether latitude and longitude are known."""
        return self.uses_gps or (self.has_origin and self.has_estimate)

    @property
    def flags(self) -> int:
        """Flags of EKF_STATUS_REPORT, the same as those of ESTIMATOR_STATUS."""
        if self.is_position_valid:
            good_flags = self._profile.good_flags
            return (
                good_flags if self.has_global_position else good_flags & ~0x210
            )  # no absolute position without an origin
        return LOST if self.has_height or self._last_ns is not None else ATTITUDE_ONLY

    @property
    def position_m(self) -> Vec3:
        """Estimated position, local NED [m]."""
        return _add(self._vehicle.position_m, self._position_error)

    @property
    def velocity_mps(self) -> Vec3:
        """Estimated velocity, local NED [m/s]."""
        return _add(self._vehicle.velocity_mps, self._velocity_error)

    @property
    def next_ns(self) -> int | None:
        """Time at which the error next moves on [ns]; None while there is none."""
        return self._step_ns if self._last_ns is not None and self.uses_external and not self.uses_gps else None

    def run(self, at_ns: int) -> None:
        """Let the error grow, and pass it to the loops that fly."""
        if self.uses_gps:
            if self._position_error != ZERO or self._velocity_error != ZERO:
                self._set_error(ZERO, ZERO)
        elif self.next_ns is not None and self._step_ns <= at_ns:
            self._step_ns = at_ns + STEP_NS
            self._grow_error(at_ns)

    def _grow_error(self, at_ns: int) -> None:
        t = (at_ns - self._updated_ns) * 1e-9
        self._updated_ns = at_ns
        if self._vehicle.grounded:  # known to stand still
            return
        p, v, b = self._position_error, self._velocity_error, ACCEL_BIAS_MPS2
        self._set_error(
            _add(p, (t * (v[0] + 0.5 * t * b[0]), t * (v[1] + 0.5 * t * b[1]), t * (v[2] + 0.5 * t * b[2]))),
            _add(v, (t * b[0], t * b[1], t * b[2])),
        )

    def _set_error(self, position_error: Vec3, velocity_error: Vec3) -> None:
        self._position_error, self._velocity_error = position_error, velocity_error
        self._vehicle.set_estimate_error(position_error, velocity_error)

    def fuse_message(self, msg: Any, at_ns: int) -> None:
        """Take an external position, if this autopilot takes and fuses messages of its kind."""
        if msg.get_type() not in FUSED_MESSAGES[self._profile.name] or not self.uses_external or self.uses_gps:
            return
        if msg.get_type() == "ODOMETRY" and not self._accepts_frames(msg):
            return
        stamp_us = msg.usec if msg.get_type() == "VISION_POSITION_ESTIMATE" else msg.time_usec
        position_m = (msg.x, msg.y, msg.z)
        age_s = self._compute_age_s(stamp_us, at_ns)
        if age_s is not None and all(map(math.isfinite, position_m)) and max(map(abs, position_m)) < 1e6:
            if self.uses_external_heading:
                self._fuse_heading(_read_heading_rad(msg), at_ns)
            self._fuse(position_m, self._read_velocity(msg), age_s, at_ns)

    def _fuse_heading(self, heading_rad: float, at_ns: int) -> None:
        """Turn the estimated heading towards an external one."""
        true_rad = compute_heading_rad(self._vehicle.attitude)
        innovation_rad = math.remainder(heading_rad - true_rad - self.heading_error_rad, math.tau)
        if self._last_ns is None:
            self.heading_error_rad = innovation_rad
            return
        gain = 1.0 - math.exp(-min((at_ns - self._last_ns) * 1e-9, FUSE_S) / HEADING_S)
        self.heading_error_rad += gain * min(
            max(innovation_rad, -MAX_HEADING_INNOVATION_RAD), MAX_HEADING_INNOVATION_RAD
        )

    def _accepts_frames(self, msg: Any) -> bool:
        local = (LOCAL_FRD, LOCAL_NED) if self._profile.name == "px4" else (LOCAL_FRD,)
        return msg.frame_id in local and msg.child_frame_id == BODY_FRD

    def _read_velocity(self, msg: Any) -> Vec3 | None:
        if msg.get_type() != "ODOMETRY":
            return None
        if self._profile.name == "px4":
            is_fused = int(self._parameters["EKF2_EV_CTRL"]) & 4
        else:
            is_fused = self._parameters["EK3_SRC1_VELXY"] == 6
        body = (msg.vx, msg.vy, msg.vz)
        is_plausible = all(map(math.isfinite, body)) and max(map(abs, body)) < 1e3
        return rotate_to_ned(self._vehicle.attitude, body) if is_fused and is_plausible else None

    def _compute_age_s(self, stamp_us: int, at_ns: int) -> float | None:
        """Return the age of a sample with the configured delay [s]; None if it is unusable.

        PX4 corrects the stamp by its TIMESYNC offset. ArduPilot counts the delay beyond the quickest sample.
        """
        px4 = self._profile.name == "px4"
        delay_s = min(max(self._parameters["EKF2_EV_DELAY" if px4 else "VISO_DELAY_MS"], 0.0), 1000.0) * 1e-3
        if px4:
            age_s = self._age_ns(1000 * stamp_us, at_ns) * 1e-9 + delay_s
            return age_s if PX4_AGES_S[0] <= age_s <= PX4_AGES_S[1] else None
        offset_ns = self._age_ns(1000 * stamp_us, at_ns)
        if self._offset_ns is None or not self._offset_ns <= offset_ns <= self._offset_ns + SECOND_NS:
            self._offset_ns = offset_ns  # quicker than all samples before, or another clock
        return (offset_ns - self._offset_ns) * 1e-9 + delay_s

    def _fuse(self, position_m: Vec3, velocity_mps: Vec3 | None, age_s: float, at_ns: int) -> None:
        self._grow_error(at_ns)
        v = self.velocity_mps
        predicted_m = (position_m[0] + age_s * v[0], position_m[1] + age_s * v[1], position_m[2] + age_s * v[2])
        innovation_m = subtract(predicted_m, self.position_m)
        silent_ns = None if self._last_ns is None else at_ns - self._last_ns
        gap_ns = PX4_GAP_NS if self._profile.name == "px4" else SECOND_NS
        is_first = silent_ns is None or not (self._is_fusing or silent_ns <= gap_ns)
        if is_first:  # take it as it is
            self._first_ns = at_ns
            self._set_error(_add(self._position_error, innovation_m), ZERO)
        elif math.hypot(*innovation_m) > GATE_M and self._is_fusing:
            return
        else:
            self._correct(innovation_m, velocity_mps, min((silent_ns or 0) * 1e-9, FUSE_S))
        self._last_ns = at_ns

    def _correct(self, innovation_m: Vec3, velocity_mps: Vec3 | None, gap_s: float) -> None:
        """Pull position and velocity to a sample, critically damped with time constant `FUSE_S` at any rate."""
        decay = math.exp(-gap_s / FUSE_S)
        position_gain, velocity_gain = 1.0 - decay * decay, (1.0 - decay) ** 2 / max(gap_s, 1e-3)
        v = self._velocity_error
        if velocity_mps is None:
            velocity = _add(
                v, (velocity_gain * innovation_m[0], velocity_gain * innovation_m[1], velocity_gain * innovation_m[2])
            )
        else:
            innovation_mps = subtract(velocity_mps, self.velocity_mps)
            velocity = _add(
                v,
                (
                    (1.0 - decay) * innovation_mps[0],
                    (1.0 - decay) * innovation_mps[1],
                    (1.0 - decay) * innovation_mps[2],
                ),
            )
        position = (position_gain * innovation_m[0], position_gain * innovation_m[1], position_gain * innovation_m[2])
        self._set_error(_add(self._position_error, position), velocity)


def _read_heading_rad(msg: Any) -> float:
    return float(msg.yaw) if msg.get_type() == "VISION_POSITION_ESTIMATE" else compute_heading_rad(tuple(msg.q))


def _add(a: Vec3, b: Vec3) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
