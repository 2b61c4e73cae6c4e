"""Sender of several vehicles, sans IO: what a daemon reads of its frames, reports, budget and weights."""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec.structs import replace
from places import ROOT
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.cameras import Cameras
from uavctl.cli.fleet_file import read_fleet
from uavctl.config import Config, load
from uavctl.frames import Quaternion
from uavctl.io.shared_sources import find_shared_sources
from uavctl.mavlink.codec import decode
from uavctl.mavlink.connection import MOCAP, MavlinkConnection, make_links
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.messages import TimeSync
from uavctl.records import PositionSample, Vec3
from uavctl.wiring.radio import (
    RadioConfig,
    build_schedule_parameters,
    compute_fleet_costs,
    compute_link_wait_s,
    compute_slot_ns,
    compute_vehicle_costs,
)
from uavctl.wiring.sender import UNUSED, PositionMessage, PositionSender

START_NS = 1_000_000_000_000
RADIO = RadioConfig(bytes_per_s=5760.0, rate_hz=50.0)
ATTITUDE: Quaternion = (math.cos(0.4), 0.0, 0.0, math.sin(0.4))
QUIET = ("sim.camera.noise_std_m=0", "sim.camera.rate_hz=50", "sim.camera.latency_s=0", "sim.camera.jitter_s=0")


def make_config(*overrides: str) -> Config:
    return load("room-px4", [*QUIET, *overrides]).config


def make_sender(configs: list[Config], radio: RadioConfig = RADIO) -> PositionSender:
    urls = [f"udpin://127.0.0.1:{1 + number}" for number in range(len(configs))]
    return PositionSender(configs, find_shared_sources(urls), radio, spacing_m=0.4, start_ns=START_NS)


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
        assert isinstance(sent, PositionMessage) and len(sent.frame) <= 44
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
        assert isinstance(sent, PositionMessage)
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


def make_vision(system: int, stamp_us: int, north_m: float) -> bytes:
    message = mavlink.MAVLink_vision_position_estimate_message(stamp_us, north_m, 0, -1, 0, 0, 0)
    return bytes(message.pack(mavlink.MAVLink(None, system, 197)))


def test_bodies_of_one_port_go_to_the_vehicles_that_name_them() -> None:
    configs = [make_config()] * 2
    sources = find_shared_sources(["udpin://127.0.0.1:1/12", "udpin://127.0.0.1:1/11"])
    sender = PositionSender(configs, sources, RADIO, spacing_m=0.4, start_ns=START_NS)
    for system in (11, 12, 13):
        sender.receive_positions(0, make_vision(system, 1000 + system, 0.1 * system), START_NS)
    norths_m, at_ns = {}, START_NS
    while (sent := sender.send_next(at_ns)) is not None:
        assert isinstance(sent, PositionMessage)
        ((sample,), _) = receive(make_links(configs[sent.vehicle])[MOCAP], sent.frame, at_ns)
        norths_m[sent.vehicle] = sample.position_m[0]
        at_ns += 10_000_000
    assert norths_m == pytest.approx({0: 1.2, 1: 1.1})
    assert sender.refused[UNUSED] == 1
    assert sender.find_silent(START_NS + 1_100_000_000) == {0, 1}


def test_with_time_answers_a_stamp_is_right_however_slow_cameras_and_radio_are() -> None:
    """Cameras in a clock of their own send 30 ms after the exposure, the radio takes 40 ms each way."""
    clock_ns, exposure_ns, radio_ns, step_ns = 4_000_000_000_000, 30_000_000, 40_000_000, 1_000_000
    config = make_config("clock.latency_s=0")
    sender, link = make_sender([config]), make_links(config)[MOCAP]
    to_vehicle: list[tuple[int, bytes]] = []
    to_sender: list[tuple[int, bytes]] = []
    errors_ns, encoder = [], Encoder(17, 197)
    for at_ns in range(START_NS, START_NS + 6_000_000_000, step_ns):
        request = sender.make_time_request(0, at_ns)
        if request is not None:
            (question,) = decode(request).messages
            assert isinstance(question, TimeSync)
            sender.receive_positions(0, encoder.encode_timesync(at_ns + clock_ns, question.ts1_ns), at_ns)
        if (at_ns - START_NS) % 20_000_000 == 0:
            # The way north tells the time of exposure.
            stamp_us = (at_ns + clock_ns - exposure_ns) // 1000
            sender.receive_positions(0, make_vision(17, stamp_us, (at_ns - exposure_ns - START_NS) * 1e-9), at_ns)
        sent = sender.send_next(at_ns)
        if sent is not None:
            to_vehicle.append((at_ns + radio_ns, sent.frame))
        to_sender += [(at_ns + radio_ns, frame) for frame in link.due(at_ns)]
        while to_vehicle and to_vehicle[0][0] <= at_ns:
            samples, _ = receive(link, to_vehicle.pop(0)[1], at_ns)
            errors_ns += [sample.captured_ns - (START_NS + round(sample.position_m[0] * 1e9)) for sample in samples]
        while to_sender and to_sender[0][0] <= at_ns:
            sender.receive_reports(0, to_sender.pop(0)[1], at_ns)
    # A step is 1 ms; a position in float32 tells a time of 6 s to less than a microsecond.
    assert max(map(abs, errors_ns[-100:])) < 2 * step_ns


def test_a_flood_of_time_requests_keeps_budget_and_wait() -> None:
    configs = [make_config()] * 4
    sender, cameras = make_sender(configs), [make_cameras(config) for config in configs]
    encoder, at_ns, wait_ns = Encoder(245, 25), START_NS, compute_link_wait_s(RADIO, 4) * 1e9
    sent_ns: dict[int, int] = {}
    answered_ns: list[int] = []
    total_bytes = 0
    while at_ns < START_NS + 5_000_000_000:
        for number in range(4):
            if cameras[number].next_ns <= at_ns:
                captured = cameras[number].capture((0.5 * number, 0.0, -1.2), (0.0, 0.0, 0.0), ATTITUDE)
                assert captured is not None
                sender.receive_positions(number, captured[1], at_ns)
            sender.receive_reports(number, encoder.encode_timesync(0, at_ns), at_ns)
        sent = sender.send_next(at_ns)
        if isinstance(sent, PositionMessage):
            total_bytes += sent.wire_bytes
            # The test asks each millisecond.
            assert at_ns - sent_ns.get(sent.vehicle, at_ns) <= wait_ns + 1_000_000
            sent_ns[sent.vehicle] = at_ns
        elif sent is not None:
            total_bytes += len(sent.frame)
            answered_ns.append(at_ns)
        at_ns += 1_000_000
    assert total_bytes <= 5 * 5760 + 2 * 44
    assert len(sent_ns) == 4
    # Each of the four vehicles has an answer in 0.9 s.
    assert len(answered_ns) == pytest.approx(4 * 5 / 0.9, abs=2)


def test_what_a_source_asks_or_answers_unasked_has_no_effect() -> None:
    sender, encoder = make_sender([make_config()]), Encoder(17, 197)
    request = sender.make_time_request(0, START_NS)
    assert request is not None and sender.make_time_request(0, START_NS + 1) is None
    for answer in (encoder.encode_timesync(0, 5), encoder.encode_timesync(10**18, START_NS + 1)):
        sender.receive_positions(0, answer, START_NS + 2)
    sender.receive_positions(0, make_vision(17, 1_000_000, 0.5), START_NS + 1000)
    sent = sender.send_next(START_NS + 1000)
    assert isinstance(sent, PositionMessage)
    assert sent.captured_ns == START_NS + 1000 - round(make_config().clock.latency_s * 1e9)


def test_vehicles_of_one_kind_are_computed_once_and_others_for_themselves() -> None:
    fleet = read_fleet(ROOT / "docs" / "examples" / "radio.toml")
    configs = [member.config for member in fleet.members[:2]]
    configs.append(replace(configs[0], plant=replace(configs[0].plant, wind_std_mps2=(0.9, 0.9, 0.9))))
    results, slot_s = compute_fleet_costs(configs, RADIO), compute_slot_ns(RADIO) / 1e9
    assert results[0] is results[1]
    for config, (costs, stds_m) in zip(configs, results, strict=True):
        expected_costs, expected_stds_m = compute_vehicle_costs(config, slot_s)
        np.testing.assert_array_equal(costs, expected_costs)
        np.testing.assert_array_equal(stds_m, expected_stds_m)
    assert results[2][0][-1] > results[0][0][-1]
    parameters = build_schedule_parameters(configs, RADIO)
    assert [vehicle.kind for vehicle in parameters.vehicles] == [0, 0, 1]
    assert [len(costs) for costs in parameters.costs] == [len(results[0][0]), len(results[2][0])]
