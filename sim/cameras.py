"""Simulated motion capture: samples of the vehicle's pose, their times, and the MAVLink messages that carry them.

Bytes are made with pymavlink's dialect directly. The cameras stamp with their own clock and answer no TIMESYNC, as
the bridges of motion-capture systems do.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.channel import is_within
from sim.vehicle.interface import LEVEL, Quaternion, compute_heading_rad, rotate_to_body
from uavctl.arrays import sum_in_order
from uavctl.config.connections import FrameConfig
from uavctl.config.sim import CameraConfig
from uavctl.errors import ConfigError
from uavctl.frames import Frame, multiply_quaternions
from uavctl.records import Vec3

SYSTEM_ID, COMPONENT_ID = 17, 197  # 197: MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
# The cameras' clock at the start, so that a stamp is never 0 ("unknown") and never our time.
UPTIME_S = 4000.0
HALF_ROLL: Quaternion = (0.0, 1.0, 0.0, 0.0)  # FLU to FRD
ZERO_VELOCITY: Vec3 = (0.0, 0.0, 0.0)
UNKNOWN = [math.nan, *([0.0] * 20)]  # a covariance whose first element is NaN is unknown (message definitions)


# Axes that the cameras may use as local NED; a row for each reported component.
AXES: dict[str, tuple[Vec3, Vec3, Vec3]] = {
    "right": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "turned-90": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "turned-180": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "turned-270": ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "mirrored-north": ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "mirrored-east": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "mirrored-down": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
    "swapped": ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "enu": ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "millimetres": ((1e3, 0.0, 0.0), (0.0, 1e3, 0.0), (0.0, 0.0, 1e3)),
    "kilometres": ((1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 1e-3)),
}


class _Pose(NamedTuple):
    """Pose of a body, and its velocity, in local NED."""

    position_m: Vec3
    velocity_mps: Vec3
    attitude: Quaternion


class Cameras:
    """Cameras that sample at phase_s + i / rate_hz after the start.

    Positions are sent in the camera frame of `[frame]`. Messages `mocap` and `odometry` carry the attitude (body axes
    FRD to the frame), `odometry` the velocity in body axes too, as its definition wants; the others carry Euler angles
    of the body in the frame, with body axes FRD in a NED frame, FLU in an ENU one.

    Each effect draws from its own generator, the same number of values for every sample whether the effect is on or
    off, visible or not. So two runs with one seed differ only by the effects that differ.

    Attributes:
        next_ns: time of the next sample [ns].

    Raises:
        ConfigError: the clock offset makes a stamp that is not positive.
    """

    def __init__(self, camera: CameraConfig, frame: FrameConfig, seed: np.random.SeedSequence, start_ns: int) -> None:
        if not 1.0 <= UPTIME_S + camera.clock_offset_s < 1e9:
            raise ConfigError(
                (f"sim.camera.clock_offset_s: {camera.clock_offset_s} is outside {1.0 - UPTIME_S} to 1e9 s",)
            )
        self._camera = camera
        self._odometry_frame = mavlink.MAV_FRAME_LOCAL_FRD if frame.convention == "ned" else mavlink.MAV_FRAME_LOCAL_ENU
        self._convention = frame.convention
        self._frame_rotation = compute_frame_rotation(frame)
        self._frame = Frame(frame.convention, frame.origin_m, frame.yaw_deg)
        self._noise_rng = np.random.default_rng(seed)
        self._latency_rng, self._occlusion_rng = (np.random.default_rng(child) for child in seed.spawn(2))
        self._start_ns = start_ns
        self._clock_us = round((UPTIME_S + camera.clock_offset_s) * 1e6)
        # Probabilities that a random occlusion begins, and that it goes on, from one sample to the next.
        self._occlusion_begin_probability = -math.expm1(-camera.occlusions_per_s / camera.rate_hz)
        self._occlusion_stay_probability = math.exp(-1.0 / (camera.occlusion_s * camera.rate_hz))
        self._is_occluded = False
        self._last_pose: _Pose | None = None
        self._axes, self._noise_std_m = AXES["right"], camera.noise_std_m
        self._drift_mps, self._drift_start_ns, self._drift_start_m = ZERO_VELOCITY, start_ns, ZERO_VELOCITY
        self._mav = mavlink.MAVLink(None, SYSTEM_ID, COMPONENT_ID)
        self._sample_count = 0
        self.next_ns = self._compute_sample_ns()

    def _compute_sample_ns(self) -> int:
        return self._start_ns + round((self._camera.phase_s + self._sample_count / self._camera.rate_hz) * 1e9)

    @property
    def is_occluded(self) -> bool:
        """Whether a random occlusion lasted at the last sample."""
        return self._is_occluded

    def clock_us(self, at_ns: int) -> int:
        """Return the cameras' own clock at a time of the simulation [µs]."""
        since_ns = at_ns - self._start_ns
        return self._clock_us + since_ns // 1000 + round(since_ns * self._camera.clock_drift_ppm * 1e-9)

    def set_axes(self, axes: str) -> None:
        """Permute the axes of positions from now on, by a name in `AXES`, as of a wrong setup."""
        self._axes = AXES[axes]

    def set_noise(self, noise_std_m: float) -> None:
        """Set the noise of positions from now on [m]."""
        self._noise_std_m = noise_std_m

    def set_drift(self, velocity_mps: Vec3) -> None:
        """Let the cameras' origin drift from the next sample on [m/s], as of cameras that were knocked."""
        self._drift_start_m = self._compute_drift_m(self.next_ns)
        self._drift_mps, self._drift_start_ns = velocity_mps, self.next_ns

    def capture(self, position_m: Vec3, velocity_mps: Vec3, attitude: Quaternion) -> tuple[int, bytes] | None:
        """Take the sample that is due at `next_ns`.

        Args:
            position_m: true position in local NED [m].
            velocity_mps: true velocity in local NED [m/s].
            attitude: true attitude (w, x, y, z), body axes FRD to NED.

        Returns:
            When the cameras send it [ns], and its datagram; None if the vehicle is hidden.
        """
        camera, at_ns = self._camera, self.next_ns
        since_ns = at_ns - self._start_ns
        self._sample_count += 1
        self.next_ns = self._compute_sample_ns()
        noise = self._noise_std_m * self._noise_rng.standard_normal(3)
        latency_s = camera.latency_s + camera.jitter_s * float(self._latency_rng.random())
        if self._draw_occlusion(since_ns):
            return None
        truth = _Pose(position_m, velocity_mps, attitude)
        body = _Pose(camera.other_body_m, ZERO_VELOCITY, LEVEL) if is_within(camera.swapped, since_ns) else truth
        if self._last_pose is None or not is_within(camera.frozen, since_ns):
            north, east, down = (float(p + n) for p, n in zip(body.position_m, noise, strict=True))
            position_ned, velocity_ned = (
                _transform_axes(self._axes, (north, east, down)),
                _transform_axes(self._axes, body.velocity_mps),
            )
            if self._drift_mps is not ZERO_VELOCITY:
                north, east, down = (
                    p + drift for p, drift in zip(position_ned, self._compute_drift_m(at_ns), strict=True)
                )
                position_ned = (north, east, down)
            self._last_pose = body._replace(position_m=position_ned, velocity_mps=velocity_ned)
        msg = self._make_message(self.clock_us(at_ns), self._last_pose)
        data = bytes(msg.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not advance it
        return at_ns + round(latency_s * 1e9), data

    def _compute_drift_m(self, at_ns: int) -> Vec3:
        s = (at_ns - self._drift_start_ns) * 1e-9
        north, east, down = (start + s * v for start, v in zip(self._drift_start_m, self._drift_mps, strict=True))
        return north, east, down

    def _draw_occlusion(self, since_ns: int) -> bool:
        self._is_occluded = bool(
            self._occlusion_rng.random()
            < (self._occlusion_stay_probability if self._is_occluded else self._occlusion_begin_probability)
        )
        return self._is_occluded or is_within(self._camera.occluded, since_ns)

    def _make_message(self, usec: int, pose: _Pose) -> mavlink.MAVLink_message:
        msg: mavlink.MAVLink_message
        position_m, attitude = (
            self._frame.from_ned(pose.position_m),
            multiply_quaternions(self._frame_rotation, pose.attitude),
        )
        match self._camera.message:
            case "vision":
                angles = self._compute_euler(attitude)
                msg = mavlink.MAVLink_vision_position_estimate_message(usec, *position_m, *angles, UNKNOWN)
            case "vicon":
                angles = self._compute_euler(attitude)
                msg = mavlink.MAVLink_vicon_position_estimate_message(usec, *position_m, *angles, UNKNOWN)
            case "mocap":
                msg = mavlink.MAVLink_att_pos_mocap_message(usec, attitude, *position_m, UNKNOWN)
            case "odometry":  # LOCAL_FRD and BODY_FRD are what both PX4 and ArduPilot take
                frames = self._odometry_frame, mavlink.MAV_FRAME_BODY_FRD
                motion = *rotate_to_body(pose.attitude, pose.velocity_mps), 0.0, 0.0, 0.0, UNKNOWN, UNKNOWN
                msg = mavlink.MAVLink_odometry_message(usec, *frames, *position_m, attitude, *motion)
        return msg

    def _compute_euler(self, attitude: Quaternion) -> Vec3:
        return compute_euler(attitude if self._convention == "ned" else multiply_quaternions(attitude, HALF_ROLL))


def _transform_axes(axes: tuple[Vec3, Vec3, Vec3], ned: Vec3) -> Vec3:
    if axes is AXES["right"]:
        return ned
    north, east, down = (sum_in_order(row * value for row, value in zip(rows, ned, strict=True)) for rows in axes)
    return north, east, down


def compute_frame_rotation(frame: FrameConfig) -> Quaternion:
    """Return the rotation from NED to the camera frame (w, x, y, z)."""
    cos, sin = math.cos(math.radians(frame.yaw_deg) / 2), math.sin(math.radians(frame.yaw_deg) / 2)
    if frame.convention == "ned":
        return cos, 0.0, 0.0, -sin
    half = math.sqrt(0.5)  # the same, then half a turn about (1, 1, 0): NED to ENU
    return 0.0, half * (cos - sin), half * (cos + sin), 0.0


def compute_euler(attitude: Quaternion) -> Vec3:
    """Return roll, pitch and yaw of an attitude [rad], turned about z, y, x in this order."""
    w, x, y, z = attitude
    pitch = math.asin(min(max(2.0 * (w * y - x * z), -1.0), 1.0))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return roll, pitch, compute_heading_rad(attitude)
