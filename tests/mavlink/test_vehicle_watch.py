"""What the vehicle's messages tell of it: whose answers count, other vehicles, its clock going back."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from mavlink_rig import OFFBOARD, SECOND, Peer, events, make_link, packets, read, statuses
from scipy.spatial.transform import Rotation

from uavctl.config.connections import DaemonConfig
from uavctl.config.types import EstimatorConfig
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.mavlink.messages import CommandAck, StatusText
from uavctl.mavlink.vehicle import ALONE_NS, FROZEN_RAW_US, GONE_NS, MAX_ATTITUDE_AGE_NS, SensorStreamMonitor
from uavctl.records import InertialSample, VehicleMotion, VehicleStatus

NOW = 1000 * SECOND
MS = 1_000_000
WRAP_MS = 2**32


def heard(boot_ms: int = 60_000, inertial_std_mps2: float = 0.0) -> tuple[MavlinkConnection, Peer]:
    estimator = EstimatorConfig(position_std_m=0.005, inertial_std_mps2=inertial_std_mps2)
    link, vehicle = make_link(daemon=DaemonConfig(tick_s=0.05), estimator=estimator), Peer(1, 1)
    link.receive(vehicle.heartbeat(), NOW)
    link.receive(vehicle.local_position(boot_ms), NOW)
    link.receive(vehicle.local_position(boot_ms), NOW)
    return link, vehicle


def newest(link: MavlinkConnection, vehicle: Peer, at_ns: int = NOW + SECOND) -> VehicleStatus:
    return statuses(link.receive(vehicle.heartbeat(), at_ns).items)[-1]


@pytest.mark.parametrize(
    ("system", "component", "counts"),
    [(245, 25, True), (0, 0, True), (245, 0, True), (255, 190, False), (245, 7, False)],
)
def test_answers_to_others_are_not_ours(system: int, component: int, counts: bool) -> None:
    link, vehicle = heard()
    items = link.receive(vehicle.send("command_ack", 400, 4, 0, 0, system, component), NOW).items
    assert bool([item for item in items if isinstance(item, CommandAck)]) == counts == bool(events(items))


def test_answers_about_streams_are_not_told_of() -> None:
    link, vehicle = heard()
    assert not events(link.receive(vehicle.send("command_ack", 511, 0, 0, 0, 245, 25), NOW).items)


def test_words_of_the_vehicle_are_told_and_handed_on() -> None:
    link, vehicle = heard()
    items = link.receive(vehicle.send("statustext", 2, b"PreArm: no"), NOW).items
    assert [type(item) for item in items] == [StatusText, type(events(items)[0])]
    assert not link.receive(Peer(9, 1).send("statustext", 2, b"not mine"), NOW).items


@pytest.mark.fault(16)
def test_another_vehicle_is_remembered_for_a_while() -> None:
    link, vehicle = heard()
    assert newest(link, vehicle).alone
    link.receive(Peer(2, 1).heartbeat(), NOW + SECOND)
    assert not newest(link, vehicle, NOW + SECOND + ALONE_NS).alone
    assert newest(link, vehicle, NOW + SECOND + ALONE_NS + 1).alone


def test_a_ground_station_and_a_camera_are_no_vehicles() -> None:
    link, vehicle = heard()
    link.receive(Peer(255, 190).heartbeat(autopilot=8, kind=6), NOW)
    link.receive(Peer(1, 100).heartbeat(autopilot=8, kind=30), NOW)
    assert newest(link, vehicle).alone


def test_how_long_it_has_been_up_is_told_by_its_clock_and_goes_on_between_its_messages() -> None:
    link, vehicle = make_link(daemon=DaemonConfig(tick_s=0.05)), Peer(1, 1)
    link.receive(vehicle.heartbeat(), NOW)
    assert link.vehicle_uptime_s(NOW) is None
    link.receive(vehicle.local_position(60_000), NOW)
    assert link.vehicle_uptime_s(NOW) == 60.0 and link.vehicle_uptime_s(NOW + 2 * SECOND) == 62.0


@pytest.mark.fault(20)
@pytest.mark.parametrize("young_ms", [0, 100, 49_900])
def test_a_clock_that_goes_back_is_a_restart(young_ms: int) -> None:
    link, vehicle = heard()
    assert not events(link.receive(vehicle.local_position(young_ms), NOW + SECOND).items)  # one word may be garbage
    items = link.receive(vehicle.local_position(young_ms + 40), NOW + SECOND).items
    assert [event.code for event in events(items)] == ["vehicle-reboot"]
    assert [status.boots for status in statuses(items)] == [1]  # at once, not with the next heartbeat
    assert not events(link.receive(vehicle.local_position(young_ms + 80), NOW + SECOND).items)
    assert newest(link, vehicle).boots == 1


@pytest.mark.fault(20, 94)
@pytest.mark.parametrize(
    ("before_ms", "boot_ms", "restarts"),
    [
        (60_000, 50_000, False),  # messages that are 10 s older than those before
        (60_000, 49_999, True),
        (5_000, 2_001, False),  # a second later: a clock that has begun anew shows two at most
        (5_000, 2_000, True),
    ],
)
def test_messages_that_become_late_are_no_restart(before_ms: int, boot_ms: int, restarts: bool) -> None:
    link, vehicle = heard(before_ms)
    found = [
        event for _ in range(3) for event in events(link.receive(vehicle.local_position(boot_ms), NOW + SECOND).items)
    ]
    assert [event.code for event in found] == ["vehicle-reboot"] * restarts


@pytest.mark.fault(20)
@pytest.mark.parametrize("name", ["attitude", "attitude_quaternion"])
def test_any_clock_since_boot_tells_a_restart_once(name: str) -> None:
    link, vehicle = heard()
    zeros = (0.0,) * (7 if name == "attitude_quaternion" else 6)
    turn = (1.0, *zeros[1:]) if name == "attitude_quaternion" else zeros
    told = []
    for boot_ms in (60_000, 60_050, 300, 350, 400):
        told += events(link.receive(vehicle.send(name, boot_ms, *turn), NOW + SECOND).items)
    for boot_ms in (450, 500, 550):
        told += events(link.receive(vehicle.local_position(boot_ms), NOW + SECOND).items)
    assert [event.code for event in told] == ["vehicle-reboot"]


@pytest.mark.fault(20)
def test_a_vehicle_that_starts_after_weeks_is_found_though_its_clock_seems_to_leap() -> None:
    link, vehicle = heard(2**31 + 5_000)
    told = [link.receive(vehicle.local_position(n * 100), NOW + 3 * SECOND).items for n in (1, 2)]
    assert [event.code for items in told for event in events(items)] == ["vehicle-reboot"]


@pytest.mark.fault(20)
def test_two_vehicles_of_one_id_are_taken_for_one_that_starts_anew() -> None:
    link, first = heard()
    second, told = Peer(1, 1), []
    for n in range(10):
        at_ns = NOW + n * 100 * MS
        told += events(link.receive(first.local_position(60_000 + n * 100), at_ns).items)
        told += events(link.receive(second.local_position(5_000 + n * 100), at_ns).items)
    assert "vehicle-reboot" in {event.code for event in told}


@pytest.mark.fault(18, 60)
def test_garbage_in_a_time_since_boot_is_no_restart() -> None:
    link, vehicle = heard()
    rng = np.random.default_rng(1)
    for n in range(500):
        garbage = int(rng.integers(WRAP_MS)) if n % 3 == 0 else 60_000 + n * 100
        assert not events(link.receive(vehicle.local_position(garbage), NOW + n * 100 * MS).items), n
    assert newest(link, vehicle).boots == 0


@pytest.mark.fault(18, 20)
@pytest.mark.parametrize(
    ("before_ms", "after_ms"), [(60_000, 59_500), (60_000, 60_000), (WRAP_MS - 20, 20), (0, 10**9)]
)
def test_disorder_the_wrap_and_gaps_are_no_restarts(before_ms: int, after_ms: int) -> None:
    link, vehicle = heard(before_ms)
    assert not events(link.receive(vehicle.local_position(after_ms), NOW + SECOND).items)
    assert newest(link, vehicle).boots == 0


@pytest.mark.fault(94)
@pytest.mark.parametrize(
    ("late_ms", "change_mps", "counts"),
    [(1000, 0.01, True), (1050, 0.01, False), (1050, 0.0, True)],  # one that repeats is passed on as such
)
def test_a_velocity_that_its_stamp_calls_old_is_not_used(late_ms: int, change_mps: float, counts: bool) -> None:
    link, vehicle = heard()
    for n in range(1, 40):
        boot_ms = 60_000 + 100 * n - (late_ms if n >= 20 else 0)
        data = vehicle.send("local_position_ned", boot_ms, 1.0, 2.0, -3.0, change_mps * n, 0.2, 0.3)
        items = link.receive(data, NOW + 100 * n * MS).items
        assert any(isinstance(item, VehicleMotion) for item in items) == (counts or n < 20), n
    assert link.stats(NOW).bad.get("velocity-not-of-now", 0) == (0 if counts else 20)
    # A restart begins a new clock.
    link.receive(vehicle.local_position(1), NOW + 5 * SECOND)
    items = link.receive(vehicle.local_position(101), NOW + 5 * SECOND + 100 * MS).items
    assert any(isinstance(item, VehicleMotion) for item in items)


@pytest.mark.fault(60)
@pytest.mark.parametrize("pause_s", [1, 20])
def test_heartbeats_that_go_back_to_not_being_ready_are_no_restart(pause_s: int) -> None:
    link, vehicle = make_link(), Peer(1, 1)
    for n, status in enumerate((0, 2, 3, 0, 3, 4, 5, 0, 2, 3, 0)):
        items = link.receive(vehicle.heartbeat(OFFBOARD, 129, status=status), NOW + n * pause_s * SECOND).items
        assert not events(items) and statuses(items)[0].boots == 0, n


@pytest.mark.fault(20)
def test_a_heartbeat_of_booting_after_silence_is_a_restart() -> None:
    link, vehicle = make_link(), Peer(1, 1)
    for at_s, status, boots in ((0, 3, 0), (1, 1, 0), (2, 3, 0), (6, 1, 1), (7, 1, 1), (8, 3, 1)):
        (told,) = statuses(link.receive(vehicle.heartbeat(OFFBOARD, 129, status=status), NOW + at_s * SECOND).items)
        assert told.boots == boots, at_s


@pytest.mark.fault(60)
def test_the_recorded_px4_whose_checks_come_and_go_has_not_started_anew() -> None:
    link, told = make_link(), []
    for at_ns, data in packets("px4-flickering-checks.tlog"):
        told += events(link.receive(data, at_ns).items)
    assert link.vehicle == (1, 1)
    assert "vehicle-reboot" not in {event.code for event in told}


def test_another_component_s_clock_is_not_the_vehicle_s() -> None:
    link, _ = heard()
    assert not events(link.receive(Peer(1, 191).local_position(5), NOW + SECOND).items)


@pytest.mark.fault(16)
def test_with_an_id_that_is_configured_no_other_vehicle_takes_its_place() -> None:
    link = make_link(daemon=DaemonConfig(tick_s=0.05, vehicle_system_id=7))
    for n in range(100):
        assert not statuses(link.receive(Peer(1 + n % 6, 1).heartbeat(), NOW + n * SECOND).items)
    assert len(statuses(link.receive(Peer(7, 1).heartbeat(), NOW + 100 * SECOND).items)) == 1
    assert link.vehicle == (7, 1)
    assert link.stats(NOW).bad == {"second-vehicle": 100}


@pytest.mark.fault(16)
def test_a_vehicle_that_is_gone_from_the_ground_gives_its_place_and_one_in_the_air_never_does() -> None:
    for armed in (False, True):
        link, first, other = make_link(), Peer(9, 1), Peer(1, 1)
        link.receive(first.heartbeat(base_mode=1 | (128 if armed else 0)), NOW)
        assert not statuses(link.receive(other.heartbeat(), NOW + GONE_NS).items)
        found = statuses(link.receive(other.heartbeat(), NOW + GONE_NS + 1).items)
        assert bool(found) == (not armed)
        assert link.vehicle == ((9, 1) if armed else (1, 1))
        if found:  # nothing is armed that was ordered for the first one
            assert not found[0].alone and found[0].boots == 1


# Inertial data

PX4, ARDUPILOT = 12, 3


def felt(
    link: MavlinkConnection, vehicle: Peer, force: tuple[float, ...], at_ns: int, *, raw: bool = False
) -> list[InertialSample]:
    name, rest = ("raw_imu", (0,) * 6) if raw else ("highres_imu", (*(0.0,) * 10, 0))
    items = link.receive(vehicle.send(name, at_ns // 1000, *force, *rest), at_ns).items
    return [item for item in items if isinstance(item, InertialSample)]


@pytest.mark.parametrize("quaternion", [False, True])
def test_a_specific_force_is_turned_into_an_acceleration_by_the_newest_attitude(quaternion: bool) -> None:
    link, vehicle = heard(inertial_std_mps2=0.1)
    assert felt(link, vehicle, (1.0, 0.0, -9.0), NOW) == []  # no attitude yet
    turn = Rotation.from_euler("ZYX", (2.0, -0.2, 0.1))
    if quaternion:
        w, x, y, z = turn.as_quat(scalar_first=True)
        link.receive(vehicle.send("attitude_quaternion", NOW // MS, w, x, y, z, 0.0, 0.0, 0.0), NOW)
    else:
        link.receive(vehicle.send("attitude", NOW // MS, 0.1, -0.2, 2.0, 0.0, 0.0, 0.0), NOW)
    force = (0.5, -0.25, -9.5)
    (sample,) = felt(link, vehicle, force, NOW + MAX_ATTITUDE_AGE_NS)
    assert sample.at_ns == NOW + MAX_ATTITUDE_AGE_NS
    assert sample.accel_mps2 == pytest.approx(turn.apply(force) + np.array([0.0, 0.0, 9.80665]), abs=1e-6)
    assert felt(link, vehicle, (0.5, -0.25, -9.4), NOW + MAX_ATTITUDE_AGE_NS + 1_000) == []  # the attitude is too old
    assert felt(link, vehicle, (float("nan"), 0.0, 0.0), NOW) == []
    assert felt(link, Peer(1, 100), force, NOW) == felt(link, Peer(9, 1), force, NOW) == []  # a camera, another one


def stream(lies: Callable[[int], tuple[int, int, bool, bool]], count: int = 300) -> list[int]:
    """Which of a stream of 50 Hz give an acceleration, each with an attitude.

    Args:
        lies: of message i, what its arrival and its stamp are late [ns], and whether force and attitude are frozen.
        count: of messages.
    """
    link, vehicle = heard(inertial_std_mps2=0.1)
    taken = []
    for i in range(count):
        late_ns, behind_ns, frozen, stiff = lies(i)
        at_ns, stamp_ns = NOW + i * 20 * MS + late_ns, NOW + i * 20 * MS - behind_ns
        roll, north = 0.0 if stiff else 1e-4 * (i % 7), 0.1 if frozen else 0.01 * (i % 11)
        link.receive(vehicle.send("attitude", stamp_ns // MS, roll, 0.0, 0.0, 0.0, 0.0, 0.0), at_ns)
        items = link.receive(
            vehicle.send("highres_imu", stamp_ns // 1000, north, 0.0, -9.8, *(0.0,) * 10, 0), at_ns
        ).items
        taken += [i for item in items if isinstance(item, InertialSample)]
    return taken


def test_inertial_data_that_are_of_now_are_all_taken_whatever_the_clocks() -> None:
    assert stream(lambda i: (0, 0, False, False)) == list(range(300))
    assert stream(lambda i: (3 * MS * (i % 5), 0, False, False)) == list(range(300))  # jitter
    drifting = stream(lambda i: (0, -i * 1_000, False, False))  # 50 ppm
    assert drifting == list(range(300))
    assert stream(lambda i: (0, i * 1_000, False, False)) == list(range(300))


@pytest.mark.parametrize(
    "lies",
    [
        lambda i: (500 * MS if i >= 100 else 0, 0, False, False),
        lambda i: (0, 100 * MS if i >= 100 else 0, False, False),
        lambda i: (0, 0, i >= 100, False),
        lambda i: (0, 0, False, i >= 100),
    ],
    ids=["late", "old stamps", "frozen force", "frozen attitude"],
)
@pytest.mark.fault(58)
def test_inertial_data_that_are_not_of_now_say_nothing(lies: Callable[[int], tuple[int, int, bool, bool]]) -> None:
    taken = stream(lies, count=190)
    assert taken[:100] == list(range(100))
    assert len(taken[100:]) <= 1 + MAX_ATTITUDE_AGE_NS // (20 * MS)  # as long as the last attitude turns them


@pytest.mark.parametrize("ppm", [-14_000, -500, 500, 14_000])
def test_clocks_that_drift_apart_for_half_an_hour_lose_nothing(ppm: int) -> None:
    stream_of_now = SensorStreamMonitor()
    for n in range(18_000):
        at_ns = NOW + n * SECOND // 10
        stamp_us = (at_ns + n * ppm * 100) // 1000
        assert stream_of_now.is_current(stamp_us, (0.01 * (n % 3), 0.0, 0.0), at_ns), n


def test_a_new_stamp_is_a_new_measurement_and_the_same_stamp_is_none() -> None:
    one = SensorStreamMonitor()
    for n in range(100):
        at_ns, readings = NOW + n * 20 * MS, (float(n // 40), 0.0, -9.8)  # whole numbers repeat for 0.8 s
        assert one.is_current(at_ns // 1000, readings, at_ns, frozen_us=FROZEN_RAW_US)
        assert one.is_current(at_ns // 1000, readings, at_ns + MS, frozen_us=FROZEN_RAW_US) is None


@pytest.mark.parametrize("name", ["px4-inertial-drift.tlog", "arducopter-inertial-integers.tlog"])
def test_recorded_inertial_data_are_used(name: str) -> None:
    """PX4's simulated clock ran 1.4 % slow; ArduPilot's whole numbers repeat. Both were dropped for it once."""
    estimator = EstimatorConfig(position_std_m=0.005, inertial_std_mps2=0.1)
    link, told = make_link(estimator=estimator), list[str]()
    for at_ns, data in packets(name):
        told += [event.code for event in events(link.receive(data, at_ns).items)]
    used, total = link.inertial_counts
    assert total > 500 and used > 0.95 * total
    assert "inertial-not-of-now" not in told and told.count("dropped") <= 1


@pytest.mark.parametrize("jump_s", [-900, 900])
def test_another_clock_of_the_same_vehicle_is_taken_up_at_once(jump_s: int) -> None:
    assert stream(lambda i: (0, 0 if i < 50 else jump_s * SECOND, False, False)) == list(range(300))


def test_a_quaternion_beside_the_angles_counts_only_where_inertial_data_are_used() -> None:
    for std_mps2, wanted in ((0.0, 0), (0.1, 1)):
        link, vehicle = heard(inertial_std_mps2=std_mps2)
        told = link.receive(
            vehicle.send("attitude_quaternion", NOW // MS, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), NOW
        ).items
        assert len(told) == wanted


def test_raw_inertial_data_have_ardupilots_unit_and_are_taken_from_it_only() -> None:
    for autopilot in (PX4, ARDUPILOT):
        estimator = EstimatorConfig(position_std_m=0.005, inertial_std_mps2=0.1)
        link, vehicle = make_link(daemon=DaemonConfig(tick_s=0.05), estimator=estimator), Peer(1, 1)
        link.receive(vehicle.heartbeat(autopilot=autopilot), NOW)
        link.receive(vehicle.send("attitude", NOW // MS, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), NOW)
        told = felt(link, vehicle, (100, -200, -1000), NOW, raw=True)
        accels = [sample.accel_mps2 for sample in told]
        wanted = [pytest.approx((0.980665, -1.96133, 0.0), abs=1e-9)] if autopilot == ARDUPILOT else []
        assert accels == wanted


@pytest.mark.parametrize(("autopilot", "ids"), [(PX4, {31, 105}), (ARDUPILOT, {30, 27})])
def test_inertial_data_are_asked_for_where_they_are_used_until_they_come(autopilot: int, ids: set[int]) -> None:
    def asked(inertial_std_mps2: float, *, tells: bool) -> list[set[tuple[int, float]]]:
        estimator = EstimatorConfig(position_std_m=0.005, inertial_std_mps2=inertial_std_mps2)
        link, vehicle, out = make_link(estimator=estimator), Peer(1, 1), []
        link.receive(vehicle.heartbeat(autopilot=autopilot), NOW)
        for second in range(20):
            at_ns = NOW + second * SECOND
            link.receive(vehicle.heartbeat(autopilot=autopilot), at_ns)
            if tells and second > 4:
                link.receive(vehicle.send("highres_imu", 0, 0.0, 0.0, -9.8, *(0.0,) * 10, 0), at_ns)
            told = [one for data in link.due(at_ns) for one in read(data) if one.get_type() == "COMMAND_LONG"]
            out.append({(int(one.param1), one.param2) for one in told if one.command == 511})
        return [one for one in out if one]

    every = {(number, 20_000.0) for number in ids}
    silent = asked(0.1, tells=False)
    assert [every <= one for one in silent] == [True] * 5 + [False]  # the last is for what is wanted of any vehicle
    assert [every <= one for one in asked(0.1, tells=True)][:4] == [True, True, True, False]
    assert not any(every & one for one in asked(0.0, tells=False))


# --- Who is the vehicle

GIMBAL, CAMERA, ONBOARD, QUADROTOR = 26, 30, 18, 2


@pytest.mark.fault(16)
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize(
    ("component", "kind", "autopilot"),
    [(154, GIMBAL, ARDUPILOT), (191, ONBOARD, 0), (100, CAMERA, PX4), (154, QUADROTOR, 0), (191, QUADROTOR, ARDUPILOT)],
)
def test_the_autopilot_is_the_vehicle_whatever_of_its_system_is_heard_first(
    component: int, kind: int, autopilot: int, first: bool
) -> None:
    link, vehicle, device = make_link(), Peer(1, 1), Peer(1, component)
    for n in range(4):
        beats = [device.heartbeat(autopilot=autopilot, kind=kind), vehicle.heartbeat(OFFBOARD, 129, autopilot=PX4)]
        for beat in beats if first else beats[::-1]:
            found = statuses(link.receive(beat, NOW + n * SECOND).items)
    assert link.vehicle == (1, 1)
    status = newest(link, vehicle, NOW + 4 * SECOND)
    assert (status.boots, status.alone) == (0, True)
    assert {one.autopilot for one in found} <= {"px4"}


@pytest.mark.fault(16)
def test_a_component_that_is_configured_is_the_vehicle() -> None:
    link = make_link(daemon=DaemonConfig(tick_s=0.05, vehicle_component_id=2))
    for n in range(3):
        link.receive(Peer(1, 1).heartbeat(), NOW + n * SECOND)
        link.receive(Peer(1, 2).heartbeat(), NOW + n * SECOND)
    assert link.vehicle == (1, 2)


@pytest.mark.fault(16)
def test_another_component_of_the_vehicles_system_says_nothing_of_the_vehicle() -> None:
    link, vehicle = heard()
    device = Peer(1, 191)
    answer = device.send("command_ack", 400, 0, 0, 0, 245, 25)
    landed = device.send("extended_sys_state", 0, 1)
    moves = device.send("attitude", 60_000, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert not [item for data in (answer, landed, moves) for item in link.receive(data, NOW).items]
    (said,) = link.receive(device.send("statustext", 4, b"failsafe"), NOW).items  # shown, and nothing is made of it
    assert not isinstance(said, StatusText)
    status = newest(link, vehicle)
    assert status.landed is None and not status.failsafe


def test_a_vehicle_that_sends_its_position_but_no_heartbeat_is_reported_once() -> None:
    link, told = make_link(), list[str]()
    for n in range(100):
        told += [
            event.code
            for event in events(link.receive(Peer(1, 1).local_position(60_000 + 100 * n), NOW + n * SECOND // 10).items)
        ]
    assert told == ["no-heartbeat"] and link.vehicle is None
