"""Link: one connection's roles, clocks, vehicle, and what it sends; peers are pymavlink's own."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from mavlink_rig import MS, OFFBOARD, SECOND, Peer, events, make_link, packets, read, samples, statuses

from uavctl.config import load_config
from uavctl.config.connections import ClockConfig, DaemonConfig, FrameConfig, SourceConfig
from uavctl.config.types import EstimatorConfig
from uavctl.flight.measure import find_refusal
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.mavlink.encoder import UnsendableError
from uavctl.mavlink.requests import RequestKind
from uavctl.records import Setpoint, SetpointSource, Severity
from uavctl.wiring.controller import build_estimator

NOW = 50_000 * SECOND
SETPOINT = Setpoint(at_ns=NOW, accel_mps2=(0.5, 0.0, -0.25), source=SetpointSource.PLAN)


def test_a_position_becomes_a_sample() -> None:
    link = make_link(
        frame=FrameConfig(convention="enu", origin_m=(10.0, 20.0, 0.0), yaw_deg=90.0), clock=ClockConfig(latency_s=0.01)
    )
    (sample,) = samples(link.receive(Peer(17, 18).vision(5_000_000, 1.0, 2.0, 0.5), NOW).items)
    # ENU (1, 2, 0.5) is NED (2, 1, -0.5); a heading of 90 degrees turns north to east
    assert sample.position_m == pytest.approx((9.0, 22.0, -0.5))
    assert (sample.captured_ns, sample.received_ns) == (NOW - 10 * MS, NOW)
    assert (sample.std_m, sample.seq) == (0.005, 1)
    assert sample.source == "VISION_POSITION_ESTIMATE 17/18"
    assert sample.velocity_mps is None


def test_odometry_is_rotated_by_its_attitude_and_then_by_the_frame() -> None:
    half = math.sqrt(0.5)
    link = make_link(frame=FrameConfig(convention="enu", origin_m=(0.0, 0.0, -1.0), yaw_deg=180.0))
    # its axes are declared (NED), so the configured ENU does not apply; origin and yaw do
    data = Peer(17, 18).odometry(9, velocity=(1.0, 0.0, 0.0), q=(half, 0.0, 0.0, half))
    (sample,) = samples(link.receive(data, NOW).items)
    assert sample.position_m == pytest.approx((-1.0, -2.0, -4.0))
    assert sample.velocity_mps == pytest.approx((0.0, -1.0, 0.0), abs=1e-6)


def test_the_vehicles_own_estimate_counts_only_if_named_and_is_local_ned() -> None:
    data = Peer(1, 1).local_position(1000)
    assert make_link().receive(data, NOW).items == ()
    link = make_link(
        source=SourceConfig(messages=("LOCAL_POSITION_NED",)),
        frame=FrameConfig(convention="enu", origin_m=(5.0, 5.0, 5.0), yaw_deg=45.0),
    )
    (sample,) = samples(link.receive(data, NOW).items)
    assert sample.position_m == (1.0, 2.0, -3.0)
    assert sample.velocity_mps == pytest.approx((0.1, 0.2, 0.3))


def test_roles_decide_what_is_taken() -> None:
    data = Peer(17, 18).vision(9) + Peer(1, 1).heartbeat()
    assert [len(kind(make_link(("mocap",)).receive(data, NOW).items)) for kind in (samples, statuses)] == [1, 0]
    assert [len(kind(make_link(("vehicle",)).receive(data, NOW).items)) for kind in (samples, statuses)] == [0, 1]


def test_messages_that_are_not_named_are_no_samples() -> None:
    link = make_link(source=SourceConfig(messages=("ODOMETRY",)))
    assert link.receive(Peer(17, 18).vision(9), NOW).items == ()
    assert link.stats(NOW).bad == {}


def test_positions_of_another_system_are_counted() -> None:
    link = make_link(source=SourceConfig(system_id=17))
    assert samples(link.receive(Peer(18, 18).vision(9), NOW).items) == []
    assert len(samples(link.receive(Peer(17, 18).vision(9), NOW).items)) == 1
    assert link.stats(NOW).bad == {"system-id": 1}


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (Peer(17).vision(9, x=math.nan), "non-finite"),
        (Peer(17).vision(9, y=1000.5), "absurd"),
        (Peer(17).vision(9, z=-3e38), "absurd"),
        (Peer(17).odometry(9, velocity=(0.0, 101.0, 0.0)), "absurd"),
    ],
)
def test_useless_samples_are_counted(data: bytes, reason: str) -> None:
    link = make_link()
    found = samples(link.receive(data, NOW).items)
    assert link.stats(NOW).bad == {reason: 1}
    # What is absurd is refused by the controller, which has to know how long a source says nothing else.
    limits = build_estimator(load_config("room-hahn-stursberg"))
    assert [find_refusal(one, NOW, limits) for one in found] == (["sample-invalid"] if reason == "absurd" else [])


def test_limits_of_the_absurd_are_configured() -> None:
    link = make_link(estimator=EstimatorConfig(position_std_m=0.1, max_position_m=5e3))
    assert len(samples(link.receive(Peer(17).vision(9, y=1000.5), NOW).items)) == 1


def test_each_source_has_its_own_clock() -> None:
    link = make_link()
    for n in range(5):
        at_ns = NOW + n * 40 * MS
        for system, epoch_us in ((17, 10**6), (18, 10**12)):
            (sample,) = samples(link.receive(Peer(system).vision(epoch_us + n * 40_000), at_ns + 10 * MS).items)
            assert sample.captured_ns == at_ns + 10 * MS
    assert link.stats(NOW).bad == {}


def test_each_sources_new_clock_is_told_once() -> None:
    link, cameras = make_link(), {17: Peer(17), 18: Peer(18)}
    epochs_us, told = dict.fromkeys(cameras, 10**12), []
    jumps = {50: 17, 100: 18, 150: 17}  # a new clock is believed with the fifth stamp
    for n in range(200):
        at_ns = NOW + n * 40 * MS
        if n in jumps:
            epochs_us[jumps[n]] += 10**10
        for system, camera in cameras.items():
            items = link.receive(camera.vision(epochs_us[system] + n * 40_000, x=1.0 + n / 1e3), at_ns).items
            told += [n for event in events(items) if event.code == "clock-resync"]
    assert told == [54, 104, 154]


@pytest.mark.fault(47)
def test_forged_sources_keep_no_later_one_out() -> None:
    """Each of many speaks once; a genuine one that comes later is heard at once, and its clock is kept."""
    link = make_link()
    for system in range(1, 201):
        link.receive(Peer(system, 9).vision(9), NOW + system * 10 * MS)
    begun_ns = NOW + 3 * SECOND
    late = [60 * MS, *[10 * MS] * 30]  # the first one was late: only who remembers the others knows
    for n, delay_ns in enumerate(late):
        at_ns = begun_ns + n * 40 * MS
        (sample,) = samples(link.receive(Peer(17).vision(10**6 + n * 40_000), at_ns + delay_ns).items)
        assert sample.captured_ns == at_ns + delay_ns
    (sample,) = samples(link.receive(Peer(17).vision(10**6 + 31 * 40_000), begun_ns + 31 * 40 * MS + 200 * MS).items)
    assert sample.received_ns - sample.captured_ns == 190 * MS


@pytest.mark.fault(47)
def test_a_source_that_speaks_loses_nothing_to_those_that_come_and_go() -> None:
    link, strange = make_link(), 0
    for n in range(500):
        at_ns = NOW + n * 40 * MS
        for k in range(40):  # a thousand new ones a second
            number = 40 * n + k
            strange += len(
                samples(link.receive(Peer(100 + number % 100, 1 + number // 100 % 200).vision(9), at_ns).items)
            )
        delay_ns = 10 * MS if n < 50 else 100 * MS
        (sample,) = samples(link.receive(Peer(17).vision(10**6 + n * 40_000), at_ns + delay_ns).items)
        if 50 < n < 290:  # within the window of the minimum
            assert sample.received_ns - sample.captured_ns == 90 * MS
    assert strange <= 50 + 100 + 10 * 20  # what is looked at of them: each costs the estimator its time
    bad = link.stats(NOW).bad
    assert set(bad) == {"new-source", "sources"} and bad["new-source"] == 20_000 - strange


def test_answers_of_many_peers_do_not_lose_the_vehicle_s_clock() -> None:
    link, vehicle = make_link(), Peer(1, 1)
    link.receive(vehicle.heartbeat(), NOW)
    for n in range(100):
        at_ns = NOW + n * SECOND
        for data in link.due(at_ns):
            for message in read(data):
                if message.get_type() == "TIMESYNC":
                    for peer in (vehicle, Peer(2, 1 + n)):
                        link.receive(peer.send("timesync", at_ns - 5 * SECOND, message.ts1), at_ns)
    trips = link.timesync_clock((1, 1))
    assert trips is not None and len(trips.round_trips_ns) == 60
    assert trips.offset_ns(NOW + 100 * SECOND) == 5 * SECOND


@pytest.mark.fault(48)
def test_others_requests_for_the_time_leave_the_vehicle_its_answers() -> None:
    link, vehicle = make_link(), Peer(1, 1)
    link.receive(vehicle.heartbeat(), NOW)
    link.receive(vehicle.send("local_position_ned", 5000, *[0.0] * 6), NOW)  # its clock is known
    answered = 0
    for n in range(1000):
        at_ns = NOW + n * MS
        link.receive(b"".join(Peer(99).send("timesync", 0, -k - 1) for k in range(20)), at_ns)
        if n % 100 == 0:
            answered += len(link.receive(vehicle.send("timesync", 0, 7), at_ns).replies)
    assert answered == 10
    assert link.stats(NOW).bad["timesync-flood"] > 19_000


@pytest.mark.parametrize(
    ("autopilot", "custom", "base", "wanted"),
    [
        (12, OFFBOARD, 129, ("px4", True, "OFFBOARD", True)),
        (12, 3 << 16, 1, ("px4", False, "POSCTL", False)),
        (3, 4, 217, ("ardupilot", True, "GUIDED", True)),
        (3, 9, 217, ("ardupilot", True, "LAND", False)),
        (0, 4, 217, ("unknown", True, "MODE_4", False)),
    ],
)
def test_heartbeats_tell_the_status(
    autopilot: int, custom: int, base: int, wanted: tuple[str, bool, str, bool]
) -> None:
    (status,) = statuses(make_link().receive(Peer(1, 1).heartbeat(custom, base, autopilot), NOW).items)
    assert (status.autopilot, status.armed, status.mode, status.external) == wanted
    assert (status.at_ns, status.landed, status.battery_v) == (NOW, None, None)


def test_status_messages_show_in_the_next_heartbeat() -> None:
    link, vehicle = make_link(), Peer(1, 1)
    link.receive(vehicle.heartbeat(), NOW)
    more = vehicle.send("extended_sys_state", 0, 2) + vehicle.send("sys_status", 0, 0, 0, 0, 15_100, *[0] * 8)
    assert link.receive(more + Peer(9, 1).send("extended_sys_state", 0, 1), NOW).items == ()
    (status,) = statuses(link.receive(vehicle.heartbeat(), NOW).items)
    assert (status.landed, status.battery_v) == (False, 15.1)


def test_only_autopilots_are_vehicles() -> None:
    link = make_link()
    station, camera = Peer(255, 190).heartbeat(autopilot=8, kind=6), Peer(17, 18).heartbeat(autopilot=8, kind=30)
    station_with_autopilot = Peer(255, 190).heartbeat(autopilot=3, kind=6)
    assert link.receive(station + camera + station_with_autopilot, NOW).items == ()
    with pytest.raises(UnsendableError, match="no vehicle has been heard"):
        link.encode_setpoint(SETPOINT)


def test_another_component_of_the_vehicle_is_no_vehicle() -> None:
    link = make_link()
    link.receive(Peer(1, 1).heartbeat(), NOW)
    assert link.receive(Peer(1, 100).heartbeat(), NOW).items == ()
    assert link.stats(NOW).bad == {}


def test_the_vehicles_words_are_events() -> None:
    link, vehicle = make_link(), Peer(1, 1)
    link.receive(vehicle.heartbeat(), NOW)
    data = (
        vehicle.send("statustext", 2, b"EKF variance")
        + vehicle.send("statustext", 4, b"Failsafe activated\t")
        + vehicle.send("statustext", 6, b"Arming motors")
        + vehicle.send("command_ack", 176, 1)
        + vehicle.send("command_ack", 21, 0)
        + vehicle.send("command_ack", 21, 200)
        + Peer(77, 1).send("statustext", 2, b"somebody else")
    )
    assert [(event.severity, event.code, event.text) for event in events(link.receive(data, NOW).items)] == [
        (Severity.ERROR, "vehicle-text", "EKF variance"),
        (Severity.WARNING, "vehicle-text", "Failsafe activated"),
        (Severity.INFO, "vehicle-text", "Arming motors"),
        (Severity.WARNING, "command-ack", "DO_SET_MODE: TEMPORARILY_REJECTED"),
        (Severity.INFO, "command-ack", "NAV_LAND: ACCEPTED"),
        (Severity.WARNING, "command-ack", "NAV_LAND: 200"),
    ]


def test_setpoint_and_landing_go_to_the_vehicle() -> None:
    link = make_link(daemon=DaemonConfig(tick_s=0.05, system_id=200, component_id=30))
    link.receive(Peer(7, 3).heartbeat(), NOW)
    setpoint, land = read(link.encode_setpoint(SETPOINT) + link.encode_request(RequestKind.LAND, 0.0))
    assert (setpoint.get_type(), setpoint.target_system, setpoint.target_component) == (
        "SET_POSITION_TARGET_LOCAL_NED",
        7,
        3,
    )
    assert (land.command, land.target_system, land.target_component) == (21, 7, 3)
    assert {(raw.get_srcSystem(), raw.get_srcComponent()) for raw in (setpoint, land)} == {(200, 30)}
    assert land.get_seq() == setpoint.get_seq() + 1


def sent(link: MavlinkConnection, name: str, period_ns: int, count: int) -> list[int]:
    """Times, in ns from NOW, at which ticks send a message of this name."""
    return [
        n * period_ns
        for n in range(count)
        for data in link.due(NOW + n * period_ns)
        if read(data)[0].get_type() == name
    ]


def test_heartbeats_are_sent_once_a_second() -> None:
    assert sent(make_link(), "HEARTBEAT", 50 * MS, 101) == [n * SECOND for n in range(6)]


def test_time_is_asked_for_quickly_at_first_and_then_every_second() -> None:
    times = sent(make_link(), "TIMESYNC", 50 * MS, 101)
    assert times[:10] == [n * 200 * MS for n in range(10)]
    assert {later - earlier for earlier, later in pairwise(times[9:])} == {950 * MS}


def answered(link: MavlinkConnection, at_ns: int, peer: Peer, offset_ns: int, delay_ns: int = MS) -> bool:
    """Let a peer answer what the link asks at `at_ns`; whether it asked."""
    for data in link.due(at_ns):
        (raw,) = read(data)
        if raw.get_type() == "TIMESYNC" and raw.tc1 == 0:
            assert raw.ts1 == at_ns
            link.receive(peer.send("timesync", at_ns + delay_ns - offset_ns, raw.ts1), at_ns + 2 * delay_ns)
            return True
    return False


def test_an_answered_request_slows_the_asking_down() -> None:
    link = make_link()
    assert answered(link, NOW, Peer(1, 1), 5 * SECOND)
    assert not answered(link, NOW + 900 * MS, Peer(1, 1), 5 * SECOND)
    assert answered(link, NOW + 950 * MS, Peer(1, 1), 5 * SECOND)


def test_answers_give_the_whole_delay() -> None:
    link, camera, offset = make_link(), Peer(17, 18), 40_000 * SECOND
    assert answered(link, NOW, camera, offset)
    captured = NOW + 100 * MS
    (sample,) = samples(link.receive(camera.vision((captured - offset) // 1000), captured + 60 * MS).items)
    assert sample.captured_ns == captured
    stats = link.stats(NOW)
    assert (stats.clock_source, stats.clock_offset_ns) == ("timesync", offset)


def test_answers_of_one_source_are_not_anothers() -> None:
    link, offset = make_link(), 40_000 * SECOND
    answered(link, NOW, Peer(1, 1), offset)
    captured = NOW + 100 * MS
    (sample,) = samples(link.receive(Peer(17, 18).vision((captured - offset) // 1000), captured + 60 * MS).items)
    assert sample.captured_ns == sample.received_ns
    assert link.stats(NOW).clock_source == "minimum"


def test_answers_to_others_are_ignored() -> None:
    link = make_link()
    link.due(NOW)
    link.receive(Peer(17, 18).send("timesync", 5 * SECOND, NOW - 3), NOW + MS)
    link.receive(Peer(17, 18).vision(9), NOW)
    assert link.stats(NOW).clock_source == "minimum"
    assert sent(link, "TIMESYNC", 50 * MS, 11) == [200 * MS, 400 * MS]  # still asking quickly


def test_requests_are_answered_with_our_time() -> None:
    link = make_link()
    link.due(NOW)
    asked = Peer(1, 1).send("timesync", 0, -77) + Peer(1, 1).send("timesync", 0, 78)
    answers = [read(data)[0] for data in link.receive(asked, NOW + 3 * MS).replies]
    assert [(raw.tc1, raw.ts1) for raw in answers] == [(NOW + 3 * MS, -77), (NOW + 3 * MS, 78)]
    assert link.due(NOW + 51 * MS) == ()
    assert link.receive(Peer(1, 1).heartbeat(), NOW + 52 * MS).replies == ()  # to its own requests only


def test_a_flood_of_requests_is_answered_in_part() -> None:
    link = make_link()
    link.due(NOW)
    for window in range(3):
        answers: list[bytes] = []
        for n in range(1000):
            at_ns = NOW + window * 50 * MS + n * MS // 25
            answers += link.receive(Peer(1, 1).send("timesync", 0, n), at_ns).replies
        assert [read(data)[0].ts1 for data in answers] == list(range(8))
    assert link.stats(NOW).bad == {"timesync-flood": 3 * 992}


def test_a_flood_of_requests_in_one_datagram_is_too() -> None:
    link = make_link()
    asked = b"".join(Peer(1, 1).send("timesync", 0, n) for n in range(100))
    assert len(link.receive(asked, NOW).replies) == 8


def test_our_own_words_sent_back_are_ignored() -> None:
    link = make_link()
    for data in link.due(NOW):
        assert link.receive(data, NOW).items == ()
    assert link.receive(Peer(245, 25).heartbeat(), NOW).items == ()
    assert link.due(NOW + MS) == ()
    assert link.stats(NOW).messages == 3


@pytest.mark.parametrize(
    ("role", "daemon"),
    [
        ("vehicle", DaemonConfig(tick_s=0.05, vehicle="tcp://127.0.0.1:5760")),
        ("mocap", DaemonConfig(tick_s=0.05, mocap="serial:///dev/ttyUSB0:57600")),
    ],
)
def test_streams_are_reassembled(role: str, daemon: DaemonConfig) -> None:
    link = make_link((role,), daemon=daemon)
    data = Peer(1, 1).heartbeat() + Peer(17, 18).vision(9)
    items = [item for at in range(len(data)) for item in link.receive(data[at : at + 1], NOW + at).items]
    assert len(items) == 1
    assert link.stats(NOW).messages == 2


def test_datagrams_are_not() -> None:
    link, data = make_link(), Peer(17, 18).vision(9)
    assert samples(link.receive(data[:20], NOW).items) == []
    assert samples(link.receive(data[20:], NOW).items) == []
    assert link.stats(NOW).bad == {"truncated": 1, "garbage": 1}


def test_dropped_data_is_told_once_a_second() -> None:
    link = make_link()
    told = []
    for n in range(300):
        got = link.receive(b"noise" if n % 3 else Peer(17).vision(9, x=math.nan), NOW + n * 10 * MS).items
        told += events(got)
    assert [event.at_ns - NOW for event in told] == [0, SECOND, 2 * SECOND]
    assert [event.count for event in told] == [1, 100, 100]
    assert "67 garbage, 33 non-finite" in told[1].text
    assert {(event.severity, event.code) for event in told} == {(Severity.WARNING, "dropped")}


def test_what_every_flight_has_is_counted_and_not_told() -> None:
    link = make_link()
    unknown = bytes((0xFD, 1, 0, 0, 0, 1, 1)) + (60_000).to_bytes(3, "little") + b"\x01\x02\x03"
    assert link.receive(unknown + Peer(1, 1).odometry(9, estimator=8), NOW).items == ()
    assert link.stats(NOW).bad == {"unknown-message": 1, "own-estimate": 1}


def test_statistics() -> None:
    link = make_link(clock=ClockConfig(latency_s=0.02))
    link.receive(Peer(17).vision(1_000_000) + Peer(1, 1).heartbeat(), NOW)
    link.receive(b"noise", NOW)
    stats = link.stats(NOW + 5)
    assert (stats.at_ns, stats.link, stats.datagrams, stats.messages, stats.samples) == (NOW + 5, "vehicle", 2, 2, 1)
    assert (stats.bad, stats.clock_source) == ({"garbage": 1}, "minimum")
    assert stats.clock_offset_ns == NOW - SECOND - 20 * MS


def test_statistics_before_anything_came() -> None:
    stats = make_link().stats(NOW)
    assert (stats.datagrams, stats.clock_source, stats.clock_offset_ns) == (0, "none", None)


def test_recorded_camera_flight() -> None:
    link = make_link()
    got, ages, captured = 0, [], []
    words = []
    for at_ns, data in packets("arducopter-vicon.tlog"):
        items = link.receive(data, at_ns).items
        for sample in samples(items):
            ages.append(sample.received_ns - sample.captured_ns)
            captured.append(sample.captured_ns)
        got += len(statuses(items))
        words += [event.text for event in events(items)]
    assert link.stats(0).bad == {}
    assert link.stats(0).samples == len(ages) > 300
    assert 14 <= got <= 18  # one heartbeat a second; the cameras' two a second are not the vehicle's
    assert sorted(ages)[len(ages) // 2] == pytest.approx(55 * MS, abs=8 * MS)
    out_of_order = sum(later < earlier for earlier, later in pairwise(captured))
    assert out_of_order / len(captured) == pytest.approx(0.20, abs=0.05)
    assert words == []
