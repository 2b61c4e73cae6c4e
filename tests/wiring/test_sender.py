"""Sender of several vehicles, sans IO: what a daemon reads of its frames, reports, budget and weights."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.cameras import Cameras
from uavctl.config import Config, load
from uavctl.frames import Quaternion
from uavctl.mavlink.connection import MOCAP, MavlinkConnection, make_links
from uavctl.records import PositionSample, Vec3
from uavctl.wiring.radio import RadioConfig
from uavctl.wiring.sender import PositionSender

START_NS = 1_000_000_000_000
RADIO = RadioConfig(bytes_per_s=5760.0, rate_hz=50.0)
ATTITUDE: Quaternion = (math.cos(0.4), 0.0, 0.0, math.sin(0.4))
QUIET = ("sim.camera.noise_std_m=0", "sim.camera.rate_hz=50", "sim.camera.latency_s=0", "sim.camera.jitter_s=0")


def make_config(*overrides: str) -> Config:
    return load("room-px4", [*QUIET, *overrides]).config


def make_sender(configs: list[Config], radio: RadioConfig = RADIO) -> PositionSender:
    urls = ["udpin://127.0.0.1:1"] * len(configs)
    return PositionSender(configs, urls, radio, spacing_m=0.4, start_ns=START_NS)


def make_cameras(config: Config) -> Cameras:
    return Cameras(config.sim.camera, config.frame, np.random.SeedSequence(1), START_NS)


def receive(link: MavlinkConnection, frame: bytes, at_ns: int) -> tuple[list[PositionSample], tuple[bytes, ...]]:
    result = link.receive(frame, at_ns)
    return [item for item in result.items if isinstance(item, PositionSample)], result.replies


@pytest.mark.parametrize("message", ["vision", "vicon", "mocap", "odometry"])
@pytest.mark.parametrize("frame", [(), ('frame.convention="enu"', "frame.yaw_deg=30", "frame.origin_m=[1,2,-0.5]")])
def test_a_daemon_reads_the_pose_and_the_stamp_of_the_cameras(message: str, frame: tuple[str, ...]) -> None:
    config = make_config(f'sim.camera.message="{message}"', *frame)
    cameras, sender, direct, served = (
        make_cameras(config),
        make_sender([config]),
        make_links(config),
        make_links(config),
    )
    for number in range(5):
        position_m: Vec3 = (0.5 + 0.01 * number, -0.7, -1.2)
        captured = cameras.capture(position_m, (0.0, 0.0, 0.0), ATTITUDE)
        assert captured is not None
        at_ns, data = captured
        sender.receive_positions(0, data, at_ns)
        sent = sender.send_next(at_ns)
        assert sent is not None and len(sent.frame) <= 44
        (expected,), _ = receive(direct[MOCAP], data, at_ns)
        (sample,), _ = receive(served[MOCAP], sent.frame, at_ns)
        assert sample.position_m == pytest.approx(position_m, abs=1e-5)
        assert sample.captured_ns == expected.captured_ns == sent.captured_ns
        attitude = served[MOCAP].receive(sent.frame, at_ns).attitude
        assert attitude is not None
        assert abs(np.dot(attitude, ATTITUDE)) == pytest.approx(1.0, abs=1e-6)


def test_reports_of_a_daemon_tell_a_lost_message_from_one_that_arrived() -> None:
    config = make_config("source.report=true", "clock.latency_s=0")
    sender = make_sender([config], RadioConfig(bytes_per_s=5760.0, rate_hz=50.0, loss=0.5, feedback_s=0.01))
    cameras, link = make_cameras(config), make_links(config)[MOCAP]
    ages_s = []
    for number in range(6):
        captured = cameras.capture((0.1 * number, 0.0, -1.0), (0.0, 0.0, 0.0), ATTITUDE)
        assert captured is not None
        at_ns, data = captured
        sender.receive_positions(0, data, at_ns)
        sent = sender.send_next(at_ns)
        assert sent is not None
        ages_s.append(sent.ages_s[0])
        if number != 3:  # the fourth message is lost
            (_,), replies = receive(link, sent.frame, at_ns + 1_000_000)
            (reply,) = replies
            sender.receive_reports(0, reply, at_ns + 2_000_000)
    # Believed ages before messages 2, 3, 4: one period of 20 ms after a report, the mean of 20 and 40 ms without one
    assert ages_s[1:4] == pytest.approx([0.02] * 3, abs=1e-4)
    assert ages_s[4] == pytest.approx(0.5 * 0.02 + 0.5 * 0.04, abs=1e-4)
    assert ages_s[5] == pytest.approx(0.02, abs=1e-4)


def test_nothing_is_reported_by_default_and_an_older_position_never() -> None:
    messages = [mavlink.MAVLink_vision_position_estimate_message(us, 0.1, 0, -1, 0, 0, 0) for us in (7000, 9000, 8000)]
    frames = [message.pack(mavlink.MAVLink(None, 17, 197)) for message in messages]
    for overrides, counts in (((), [0, 0, 0]), (("source.report=true",), [1, 1, 0])):
        link = make_links(make_config(*overrides))[MOCAP]
        replies = [receive(link, frame, START_NS + 1_000_000 * i)[1] for i, frame in enumerate(frames)]
        assert [len(reply) for reply in replies] == counts
        if any(counts):
            pings = [ping for reply in replies for ping in mavlink.MAVLink(None).parse_buffer(b"".join(reply)) or ()]
            assert [(ping.time_usec, ping.target_system, ping.target_component) for ping in pings] == [
                (7000, 17, 197),
                (9000, 17, 197),
            ]


@pytest.mark.parametrize("data", [b"", b"\xfd\x00", bytes(range(256)), b"\xfe" * 300])
def test_damaged_data_gives_nothing(data: bytes) -> None:
    sender = make_sender([make_config()])
    sender.receive_positions(0, data, START_NS)
    sender.receive_reports(0, data, START_NS)
    assert sender.send_next(START_NS) is None


def test_a_vehicle_at_a_wall_is_served_more_often_by_value() -> None:
    configs = [make_config()] * 3
    radio = RadioConfig(messages_per_s=20.0, rate_hz=50.0, max_wait_s=1.0)
    sender, cameras = make_sender(configs, radio), [make_cameras(config) for config in configs]
    # in the open, 5 mm from the east wall, in the open; more than a metre apart
    places: list[Vec3] = [(-1.0, 0.0, -1.2), (1.0, 2.495, -1.2), (1.0, 0.0, -1.2)]
    at_ns = START_NS
    for _ in range(1000):
        for number, place_m in enumerate(places):
            captured = cameras[number].capture(place_m, (0.0, 0.0, 0.0), ATTITUDE)
            assert captured is not None
            sender.receive_positions(number, captured[1], captured[0])
            at_ns = captured[0]
        sender.send_next(at_ns)
    assert sender.sent[1] > 1.1 * max(sender.sent[0], sender.sent[2])
