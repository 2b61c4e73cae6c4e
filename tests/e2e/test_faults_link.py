"""Faults on the wire and in clocks, each with the reaction that it gets; and a fuzzer that reaches the handlers."""

from __future__ import annotations

import math
import random
import struct
import time
from collections import Counter
from collections.abc import Callable

import pytest
from mavlink_rig import MS, NO_COVARIANCE, OFFBOARD, SECOND, Peer, events, make_link, packets, read, samples, statuses
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config import load_config
from uavctl.config.connections import SourceConfig
from uavctl.event_codes import EventCode
from uavctl.flight.measure import find_refusal
from uavctl.mavlink import codec
from uavctl.mavlink.codec import decode
from uavctl.mavlink.connection import Item, MavlinkConnection
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.handover import HandoverStateMachine
from uavctl.mavlink.handover_guards import HandoverInput
from uavctl.mavlink.handover_states import HandoverState, SetpointMode
from uavctl.mavlink.requests import RequestKind
from uavctl.records import PositionSample, Setpoint, SetpointSource, Severity
from uavctl.wiring.controller import build_estimator

NOW = 50_000 * SECOND
CAMERA = Peer(17, 18)
GOOD = CAMERA.vision(1_000_000)


def flip_byte(data: bytes, bit: int) -> bytes:
    return data[: bit // 8] + bytes((data[bit // 8] ^ 1 << bit % 8,)) + data[bit // 8 + 1 :]


class Source:
    """Cameras with their own clock, 25 a second."""

    def __init__(self, link: MavlinkConnection, epoch_us: int = 10**9) -> None:
        self.link, self.us, self.at_ns = link, epoch_us, NOW

    def send(self, count: int = 1, delay_ns: int = 30 * MS) -> list[PositionSample]:
        got = []
        for _ in range(count):
            self.us, self.at_ns = self.us + 40_000, self.at_ns + 40 * MS
            got += samples(self.link.receive(CAMERA.vision(self.us), self.at_ns + delay_ns).items)
        return got


# --- rows 10 and 11: bit errors, truncated and oversized datagrams -----------------------------------


@pytest.mark.fault(10)
def test_row_10_one_flipped_bit_costs_one_sample_and_the_next_is_read() -> None:
    for bit in range(len(GOOD) * 8):
        link = make_link()
        assert samples(link.receive(flip_byte(GOOD, bit), NOW).items) == [], bit
        assert len(samples(link.receive(GOOD, NOW + MS).items)) == 1, bit
        assert sum(link.stats(NOW).bad.values()) == 1, bit


@pytest.mark.fault(11)
@pytest.mark.parametrize("length", [0, 1, 5, 11, len(GOOD) - 1])
def test_row_11_a_truncated_datagram_costs_nothing_else(length: int) -> None:
    link = make_link()
    assert samples(link.receive(GOOD[:length], NOW).items) == []
    assert len(samples(link.receive(GOOD, NOW + MS).items)) == 1
    assert link.stats(NOW).bad == ({"truncated": 1} if length else {})


@pytest.mark.fault(11)
def test_row_11_an_oversized_datagram_is_dropped_and_reported() -> None:
    link = make_link()
    (event,) = events(link.receive(GOOD * 2000, NOW).items)
    assert (event.code, event.count) == (EventCode.DROPPED, 1) and "1 oversize" in event.text
    assert len(samples(link.receive(GOOD, NOW + MS).items)) == 1


@pytest.mark.fault(10, 11)
def test_rows_10_and_11_are_reported_once_a_second() -> None:
    link = make_link()
    reported_events = [
        event for n in range(1000) for event in events(link.receive(flip_byte(GOOD, 160), NOW + n * 5 * MS).items)
    ]
    assert len(reported_events) == 5
    assert {event.severity for event in reported_events} == {Severity.WARNING}
    assert sum(event.count for event in reported_events) == 1 + 4 * 200
    assert link.stats(NOW).bad == {"crc": 1000}


# --- row 12: values that are none ----------------------------------------------------------------------


@pytest.mark.fault(12)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3.4e38, -1e6])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("make", [CAMERA.vision, Peer(1, 1).local_position])
def test_row_12_a_sample_with_such_a_value_counts_as_lost(make: Callable[..., bytes], axis: str, value: float) -> None:
    link = make_link(source=SourceConfig(messages=("VISION_POSITION_ESTIMATE", "LOCAL_POSITION_NED")))
    result = samples(link.receive(make(9, **{axis: value}), NOW).items)
    assert [find_refusal(item, NOW, build_estimator(load_config("room-hahn-stursberg"))) for item in result] == [
        "sample-invalid"
    ] * len(result)
    assert bool(result) == math.isfinite(value)
    assert sum(link.stats(NOW).bad.values()) == 1


# --- row 16: strangers ---------------------------------------------------------------------------------


@pytest.mark.fault(16)
def test_row_16_a_second_vehicle_is_reported_and_ignored() -> None:
    link, ours, second_vehicle = make_link(), Peer(1, 1), Peer(2, 1)
    assert len(statuses(link.receive(ours.heartbeat(), NOW).items)) == 1
    reported_events = []
    for n in range(10):
        items = link.receive(second_vehicle.heartbeat(), NOW + n * 200 * MS).items
        assert statuses(items) == []
        reported_events += events(items)
    assert [(event.code, event.severity) for event in reported_events] == [("second-vehicle", Severity.ERROR)] * 2
    assert link.stats(NOW).bad == {"second-vehicle": 10}
    assert read(link.encode_request(RequestKind.LAND, 0.0))[0].target_system == 1
    assert len(statuses(link.receive(ours.heartbeat(), NOW).items)) == 1


@pytest.mark.fault(16)
def test_row_16_unknown_messages_are_counted() -> None:
    link = make_link()
    for _, data in packets("px4-offboard.tlog"):
        link.receive(data, NOW)
    assert set(link.stats(NOW).bad) == {"unknown-message"}
    assert link.stats(NOW).bad["unknown-message"] > 50


# --- rows 17 to 20: clocks -----------------------------------------------------------------------------


@pytest.mark.fault(17)
def test_row_17_the_wall_clock_is_never_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> int:
        raise AssertionError("the wall clock was asked")

    link = make_link()
    Source(link).send()
    for name in ("time", "time_ns", "monotonic", "monotonic_ns"):
        monkeypatch.setattr(f"uavctl.mavlink.connection.{name}", refuse, raising=False)
    with monkeypatch.context() as patched:
        patched.setattr(time, "time_ns", refuse)
        patched.setattr(time, "monotonic_ns", refuse)
        (sample,) = samples(link.receive(CAMERA.vision(10**9 + 80_000), NOW + 80 * MS).items)
    assert sample.received_ns == NOW + 80 * MS


@pytest.mark.fault(18)
def test_row_18_stamps_from_the_future_are_refused() -> None:
    link = make_link()
    source = Source(link)
    source.send(30)
    for ahead_us in (25_000, 10**6, 3_600 * 10**6, 2**63, 2**64 - 1 - source.us):
        assert samples(link.receive(CAMERA.vision(source.us + ahead_us), source.at_ns + 30 * MS).items) == []
    assert link.stats(NOW).bad == {"future-stamp": 5}
    (sample,) = source.send()
    assert sample.captured_ns == source.at_ns + 30 * MS


@pytest.mark.fault(18)
def test_row_18_the_boot_clock_wraps_after_49_7_days() -> None:
    link, vehicle = make_link(source=SourceConfig(messages=("LOCAL_POSITION_NED",))), Peer(1, 1)
    for n in range(200):
        at_ns = NOW + n * 40 * MS
        (sample,) = samples(link.receive(vehicle.local_position((2**32 - 4_000 + 40 * n) % 2**32), at_ns).items)
        assert sample.captured_ns == at_ns
    assert link.stats(NOW).bad == {}


@pytest.mark.fault(18)
def test_row_18_our_own_boot_clock_wraps() -> None:
    link = make_link()
    link.receive(Peer(1, 1).heartbeat(), NOW)
    wrap_ns = 2**32 * MS
    for at_ns, want in ((wrap_ns - 1, 2**32 - 1), (wrap_ns, 0), (7 * wrap_ns + 5 * MS, 5)):
        data = link.encode_setpoint(Setpoint(at_ns=at_ns, accel_mps2=(0.0, 0.0, 1.0), source=SetpointSource.PLAN))
        assert struct.unpack_from("<I", data, 10)[0] == want


def answer_timesync(link: MavlinkConnection, at_ns: int, offset_ns: int, round_trip_ns: int = 2 * MS) -> bool:
    """Answer the request of `at_ns` if there is one, as a peer whose clock is `offset_ns` behind ours."""
    for data in link.due(at_ns):
        raw = mavlink.MAVLink(None).decode(bytearray(data))
        if raw.get_type() == "TIMESYNC":
            answer = CAMERA.send("timesync", at_ns + round_trip_ns // 2 - offset_ns, raw.ts1)
            link.receive(answer, at_ns + round_trip_ns)
            return True
    return False


def compute_offset(link: MavlinkConnection, at_ns: int, offset_ns: int) -> int | None:
    """The offset that a sample of `at_ns` is mapped with."""
    link.receive(CAMERA.vision((at_ns - offset_ns) // 1000), at_ns + 50 * MS)
    return link.stats(NOW).clock_offset_ns


OFFSET = 40_000 * SECOND


@pytest.mark.fault(19)
def test_row_19_a_long_round_trip_does_not_move_a_clock_of_short_ones() -> None:
    link = make_link()
    assert answer_timesync(link, NOW, OFFSET, round_trip_ns=200 * MS)
    assert compute_offset(link, NOW, OFFSET) == OFFSET
    for n in range(1, 4):
        assert answer_timesync(link, NOW + n * SECOND, OFFSET + 40 * MS, round_trip_ns=2 * MS)
    assert compute_offset(link, NOW + 3 * SECOND, OFFSET) == pytest.approx(OFFSET + 40 * MS, abs=MS)
    for n in range(4, 8):
        assert answer_timesync(link, NOW + n * SECOND, OFFSET, round_trip_ns=200 * MS)
    assert compute_offset(link, NOW + 7 * SECOND, OFFSET) == pytest.approx(OFFSET + 40 * MS, abs=20 * MS)


@pytest.mark.fault(19)
def test_row_19_deviating_answers_are_dropped_until_five_agree() -> None:
    link = make_link()
    assert answer_timesync(link, NOW, OFFSET)
    assert compute_offset(link, NOW, OFFSET) == OFFSET
    for n in range(1, 5):
        assert answer_timesync(link, NOW + n * SECOND, OFFSET + 300 * MS)
        assert compute_offset(link, NOW + n * SECOND, OFFSET) == OFFSET
    assert link.stats(NOW).bad == {"timesync": 4}
    assert answer_timesync(link, NOW + 5 * SECOND, OFFSET - 300 * MS)
    assert link.stats(NOW).bad == {"timesync": 4}  # the fifth in a row is believed


@pytest.mark.fault(19)
def test_row_19_a_drifting_clock_is_followed() -> None:
    link, drift = make_link(), 50e-6
    for n in range(600):
        at_ns = NOW + n * SECOND
        offset = OFFSET + round(n * SECOND * drift)
        assert answer_timesync(link, at_ns, offset)
        got = compute_offset(link, at_ns, offset)
        assert got is not None
        assert abs(got - offset) < MS


@pytest.mark.fault(20)
def test_row_20_a_restarted_source_is_found_and_synchronised_again() -> None:
    link = make_link()
    source = Source(link)
    assert len(source.send(50)) == 50
    source.us = 0  # its clock begins again
    assert source.send(4) == []
    got = source.send(10)
    assert [sample.captured_ns for sample in got] == [sample.received_ns for sample in got]
    assert len(got) == 10
    assert link.stats(NOW).bad == {"stamp-leap": 4}


@pytest.mark.fault(20)
def test_row_20_the_restart_is_reported_once() -> None:
    link = make_link()
    source = Source(link)
    source.send(50)
    reported_events = []
    for n in range(20):
        reported_events += events(link.receive(CAMERA.vision(40_000 * (n + 1)), source.at_ns + (n + 1) * 40 * MS).items)
    assert [event.code for event in reported_events].count("clock-resync") == 1


@pytest.mark.fault(20)
def test_row_20_a_rebooted_vehicle_is_let_go() -> None:
    link, vehicle, hand_over = make_link(), Peer(1, 1), HandoverStateMachine()
    (flying,) = statuses(link.receive(vehicle.heartbeat(OFFBOARD, 129), NOW).items)
    assert (
        hand_over.update(HandoverInput(at_ns=NOW, vehicle=flying, has_setpoint=True)).setpoint_mode
        is SetpointMode.SETPOINTS
    )
    for n in range(3):
        link.receive(vehicle.local_position(60_000 + n * 100), NOW)
    later = NOW + 5 * SECOND
    link.receive(vehicle.local_position(700), later)
    items = link.receive(vehicle.local_position(800), later).items
    assert [event.code for event in events(items)] == ["vehicle-reboot"]
    (booted,) = statuses(items)
    assert (
        hand_over.update(HandoverInput(at_ns=later, vehicle=booted, has_setpoint=True)).setpoint_mode
        is SetpointMode.NOTHING
    )
    assert hand_over.state is HandoverState.TAKEN_OVER  # though it says that it is armed, in OFFBOARD
    items = link.receive(vehicle.heartbeat(OFFBOARD, 129, status=1), later + SECOND).items
    assert not events(items)  # told once, and a heartbeat's status alone tells nothing


# --- mutated messages with a right checksum --------------------------------------------------------------

VEHICLE = Peer(1, 1)
SEEDS: tuple[Callable[[int], bytes], ...] = (
    CAMERA.vision,
    lambda us: CAMERA.send("vicon_position_estimate", us, 1.0, 2.0, 3.0, 0, 0, 0, NO_COVARIANCE),
    lambda us: CAMERA.send("att_pos_mocap", us, [1, 0, 0, 0], 1.0, 2.0, 3.0, NO_COVARIANCE),
    CAMERA.odometry,
    lambda us: VEHICLE.local_position(us // 1000 % 2**32),
    lambda us: VEHICLE.heartbeat(),
    lambda us: VEHICLE.send("timesync", us, us),
    lambda us: VEHICLE.send("timesync", 0, us),
    lambda us: VEHICLE.send("extended_sys_state", 0, 1),
    lambda us: VEHICLE.send("sys_status", 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13),
    lambda us: VEHICLE.send("battery_status", 0, 1, 2, 3, list(range(10)), 5, 6, 7, 8),
    lambda us: VEHICLE.send("statustext", 3, b"some words"),
    lambda us: VEHICLE.send("command_ack", 21, 0),
    lambda us: VEHICLE.send("attitude", 1, 0, 0, 0, 0, 0, 0),
)
NASTY = tuple(struct.pack("<f", value) for value in (math.nan, math.inf, -math.inf, 3.4e38, 1e-45, -0.0, 1e10)) + tuple(
    struct.pack("<q", value) for value in (-1, -(2**63), 2**63 - 1, 2**32, 2**31)
)


def seal_frame(data: bytes, crc_extra: int) -> bytes:
    """A version 2 frame with its length and checksum made right."""
    body = data[1:10] + data[10:-2]
    body = bytes((len(data) - 12,)) + body[1:]
    crc = mavlink.x25crc(body)
    crc.accumulate(bytes((crc_extra,)))
    return data[:1] + body + struct.pack("<H", crc.crc)


def mutate_frame(data: bytes, numbers: random.Random) -> bytes:
    """A seed with bytes of its payload, its length or its sender changed, and sealed again."""
    crc_extra = mavlink.mavlink_map[int.from_bytes(data[7:10], "little")].crc_extra
    frame = bytearray(data)
    for _ in range(numbers.randint(1, 4)):
        at = numbers.randrange(10, len(frame) - 2)
        match numbers.randrange(5):
            case 0:
                frame[at] = numbers.randrange(256)
            case 1:
                value = numbers.choice(NASTY)
                frame[at : min(at + len(value), len(frame) - 2)] = value[: len(frame) - 2 - at]
            case 2:
                frame[5:7] = bytes(numbers.randrange(256) for _ in range(2))
            case 3 if len(frame) > 14:
                del frame[at : at + numbers.randint(1, len(frame) - 2 - at)]
            case _ if len(frame) < 200:
                frame[at:at] = numbers.randbytes(numbers.randint(1, 40))
        if len(frame) < 13:
            break
    return seal_frame(bytes(frame), crc_extra)


def fuzz_link(link: MavlinkConnection, count: int, seed: int) -> Counter[str]:
    """Give mutated messages to a link and check what comes out; counts by kind."""
    numbers = random.Random(seed)
    kinds: Counter[str] = Counter()
    at_ns = NOW
    for _ in range(count):
        at_ns += numbers.randrange(20 * MS)
        link.due(at_ns)
        for item in link.receive(mutate_frame(numbers.choice(SEEDS)(at_ns // 1000), numbers), at_ns).items:
            check_samples(item)
            kinds[type(item).__name__] += 1
    return kinds


def check_samples(item: Item) -> None:
    """What every sample keeps, whatever came in."""
    if isinstance(item, PositionSample):
        assert all(map(math.isfinite, (*item.position_m, *(item.velocity_mps or ()))))
        assert all(map(math.isfinite, item.position_m))
        assert item.captured_ns <= item.received_ns


@pytest.mark.slow
def test_mutated_messages_raise_nothing() -> None:
    link = make_link(
        source=SourceConfig(
            messages=(
                "VISION_POSITION_ESTIMATE",
                "VICON_POSITION_ESTIMATE",
                "ATT_POS_MOCAP",
                "ODOMETRY",
                "LOCAL_POSITION_NED",
            )
        )
    )
    link.receive(VEHICLE.heartbeat(), NOW)
    kinds = fuzz_link(link, 20_000, seed=1)
    stats = link.stats(NOW)
    assert stats.messages == 20_001  # all of them reach the handlers
    assert "crc" not in stats.bad
    assert kinds["PositionSample"] > 100
    assert kinds["Event"] > 100
    assert kinds["VehicleStatus"] > 100
    assert stats.bad["non-finite"] > 100


def test_the_fuzzer_finds_a_planted_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "_is_finite", lambda *values: True)
    with pytest.raises((AssertionError, ValueError, OverflowError)):
        fuzz_link(make_link(), 20_000, seed=1)


def test_random_bytes_cost_nothing_but_themselves() -> None:
    numbers = random.Random(2)
    link = make_link()
    source = Source(link)
    for _ in range(2_000):
        noise = bytes(numbers.choices((0xFD, 0xFE, 0, 1, 9, 30, 255, 66), k=numbers.randrange(400)))
        link.receive(noise, source.at_ns)
        assert len(source.send()) == 1


def test_our_own_output_survives_our_own_input() -> None:
    encoder = Encoder(99, 1)
    data = encoder.encode_heartbeat() + encoder.encode_timesync(0, 5) + encoder.encode_command(21, (), 1, 1)
    assert decode(data).bad == {}
    assert decode(data).total == 3
