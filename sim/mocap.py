"""Simulated motion capture: what the cameras see, when, and as which MAVLink message.

Bytes are made with pymavlink's dialect directly. The cameras stamp with their own clock and answer no TIMESYNC, as
the bridges of motion-capture systems do.
"""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.types import CameraConfig, FrameConfig
from uavctl.data import Vec3
from uavctl.errors import ConfigError
from uavctl.frames import Frame

SYSTEM_ID, COMPONENT_ID = 17, 197  # 197: MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
# The cameras' clock at the start, so that a stamp is never 0 ("unknown") and never our time.
UPTIME_S = 4000.0
UNKNOWN = [math.nan, *([0.0] * 20)]  # a covariance whose first element is NaN is unknown (message definitions)


class Cameras:
    """Cameras that sample at phase_s + i / rate_hz after the start.

    Positions are sent in the camera frame of `[frame]`. The vehicle is taken as level with its nose north; message
    `odometry` carries that attitude and the velocity in body axes, as its definition wants.

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
        self._attitude = north_level(frame)
        self._frame = Frame(frame.convention, frame.origin_m, frame.yaw_deg)
        self._rng = np.random.default_rng(seed)
        self._start_ns = start_ns
        self._latency_ns = round(camera.latency_s * 1e9)
        self._clock_us = round((UPTIME_S + camera.clock_offset_s) * 1e6)
        self._mav = mavlink.MAVLink(None, SYSTEM_ID, COMPONENT_ID)
        self._taken = 0

    @property
    def next_ns(self) -> int:
        """Time of the next sample [ns]."""
        return self._start_ns + round((self._camera.phase_s + self._taken / self._camera.rate_hz) * 1e9)

    def capture(self, position_m: Vec3, velocity_mps: Vec3) -> tuple[int, bytes]:
        """Take the sample that is due at `next_ns`.

        Args:
            position_m: true position in local NED [m].
            velocity_mps: true velocity in local NED [m/s].

        Returns:
            When the cameras send it [ns], and its datagram.
        """
        at_ns = self.next_ns
        self._taken += 1
        noise = self._camera.noise_std_m * self._rng.standard_normal(3)
        north, east, down = (float(p + n) for p, n in zip(position_m, noise, strict=True))
        where = self._frame.from_ned((north, east, down))
        usec = self._clock_us + (at_ns - self._start_ns) // 1000
        msg = self._message(usec, where, velocity_mps)
        data = bytes(msg.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not advance it
        return at_ns + self._latency_ns, data

    def _message(self, usec: int, where: Vec3, body_mps: Vec3) -> mavlink.MAVLink_message:
        msg: mavlink.MAVLink_message
        match self._camera.message:
            case "vision":
                msg = mavlink.MAVLink_vision_position_estimate_message(usec, *where, 0.0, 0.0, 0.0, UNKNOWN)
            case "vicon":
                msg = mavlink.MAVLink_vicon_position_estimate_message(usec, *where, 0.0, 0.0, 0.0, UNKNOWN)
            case "mocap":
                msg = mavlink.MAVLink_att_pos_mocap_message(usec, self._attitude, *where, UNKNOWN)
            case "odometry":  # LOCAL_FRD and BODY_FRD are what both PX4 and ArduPilot take
                frames = self._odometry_frame, mavlink.MAV_FRAME_BODY_FRD
                motion = *body_mps, 0.0, 0.0, 0.0, UNKNOWN, UNKNOWN
                msg = mavlink.MAVLink_odometry_message(usec, *frames, *where, self._attitude, *motion)
        return msg


def north_level(frame: FrameConfig) -> list[float]:
    """Attitude (w, x, y, z) of a level vehicle with its nose north: from body FRD to the camera frame."""
    cos, sin = math.cos(math.radians(frame.yaw_deg) / 2), math.sin(math.radians(frame.yaw_deg) / 2)
    if frame.convention == "ned":
        return [cos, 0.0, 0.0, -sin]
    half = math.sqrt(0.5)  # the same, then half a turn about (1, 1, 0): NED to ENU
    return [0.0, half * (cos - sin), half * (cos + sin), 0.0]
