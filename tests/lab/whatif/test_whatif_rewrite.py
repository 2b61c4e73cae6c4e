"""A moved position message says what cameras would have said that saw the vehicle there."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.cameras import Cameras
from uavctl.config import load_config
from uavctl.config.connections import FrameConfig
from uavctl.config.sim import CameraConfig
from uavctl.frames import Quaternion
from uavctl.lab.whatif.rewrite import SourceFrames
from uavctl.records import Vec3

FRAMES = [
    FrameConfig(),
    FrameConfig(convention="enu", origin_m=(1.0, -2.0, 0.5), yaw_deg=0.0),
    FrameConfig(convention="enu", origin_m=(1.0, -2.0, 0.5), yaw_deg=37.0),
    FrameConfig(convention="ned", origin_m=(0.0, 3.0, 0.0), yaw_deg=-120.0),
]
HERE: tuple[Vec3, Vec3] = (1.25, -0.5, -1.0), (0.5, -0.25, 0.125)
BY: tuple[Vec3, Vec3] = (0.7, 1.1, -0.3), (-0.4, 0.2, 0.9)
THERE: tuple[Vec3, Vec3] = tuple(tuple(np.add(a, b).tolist()) for a, b in zip(HERE, BY, strict=True))  # type: ignore[assignment]
TURNED: Quaternion = (math.cos(0.4), 0.0, math.sin(0.4) * 0.6, math.sin(0.4) * 0.8)


def capture(camera: CameraConfig, frame: FrameConfig, motion: tuple[Vec3, Vec3]) -> bytes:
    decoded = Cameras(camera, frame, np.random.SeedSequence(1), 0).capture(*motion, TURNED)
    assert decoded is not None
    return decoded[1]


def camera_of(message: str) -> CameraConfig:
    camera = load_config("room-hahn-stursberg").sim.camera
    return CameraConfig(rate_hz=camera.rate_hz, message=message)  # type: ignore[arg-type]


@pytest.mark.parametrize("frame", FRAMES, ids=["ned", "enu", "enu-turned", "ned-turned"])
@pytest.mark.parametrize("message", ["vision", "vicon", "mocap", "odometry"])
def test_positions_of_cameras_are_moved(message: str, frame: FrameConfig) -> None:
    camera, axes = camera_of(message), SourceFrames(frame)
    (position_frame,) = axes.find_positions(capture(camera, frame, HERE))
    np.testing.assert_allclose(position_frame.position_m, HERE[0], atol=1e-6)
    moved = axes.move(position_frame, *BY)
    expected = capture(camera, frame, THERE)
    mav = mavlink.MAVLink(None)
    moved_message, expected_message = (mav.decode(bytearray(data)) for data in (moved, expected))
    assert moved_message.get_type() == expected_message.get_type()
    assert moved[:10] == expected[:10]  # length, number, sender
    for name in moved_message.fieldnames:
        np.testing.assert_allclose(
            getattr(moved_message, name), getattr(expected_message, name), atol=2e-6, err_msg=name
        )
    (moved_position,) = axes.find_positions(moved)
    np.testing.assert_allclose(moved_position.position_m, THERE[0], atol=2e-6)


@pytest.mark.parametrize("message", ["vision", "odometry"])
def test_a_stamp_is_replaced(message: str) -> None:
    axes = SourceFrames(FrameConfig())
    (position_frame,) = axes.find_positions(capture(camera_of(message), FrameConfig(), HERE))
    moved = axes.move(position_frame, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), stamp_us=123_456_789)
    (moved_position,) = axes.find_positions(moved)
    assert moved_position.position.stamp_us == 123_456_789 and moved_position.position_m == position_frame.position_m


def test_the_vehicle_s_own_estimate_is_moved_as_it_stands_and_in_its_own_version() -> None:
    mav = mavlink.MAVLink(None, 1, 1)
    mav.seq = 77
    frame = FRAMES[2]
    message = mavlink.MAVLink_local_position_ned_message(5000, 1.0, 2.0, -3.0, 0.5, 0.0, 0.0)
    axes = SourceFrames(frame)
    (position_frame,) = axes.find_positions(bytes(message.pack(mav, force_mavlink1=True)))
    moved = axes.move(position_frame, (0.5, 0.0, 0.25), (0.0, 1.0, 0.0), stamp_us=7_000_000)
    assert moved[0] == 0xFE and moved[2] == 77
    decoded = mavlink.MAVLink(None).decode(bytearray(moved))
    assert (decoded.x, decoded.y, decoded.z, decoded.vx, decoded.vy, decoded.time_boot_ms) == (
        1.5,
        2.0,
        -2.75,
        0.5,
        1.0,
        7000,
    )


def test_other_messages_have_no_position() -> None:
    beat = mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3).pack(mavlink.MAVLink(None, 1, 1))
    assert list(SourceFrames(FrameConfig()).find_positions(bytes(beat) + b"\xfd\x00garbage")) == []
