"""Items of rates, ages, noise, place, clocks and vehicle: each is seen good, and seen to fail."""

from __future__ import annotations

import math

import pytest
from check_rig import CheckResult, HandMotion, S, run_check
from hypothesis import given
from hypothesis import strategies as st
from mavlink_rig import MS, Peer
from sim_rig import decode

from sim.simulation import Peers
from uavctl.check.findings import ItemState, find_refusals, make_item
from uavctl.check.parameters import list_parameters
from uavctl.check.preflight import Preflight
from uavctl.config import load_config
from uavctl.config.connections import CheckConfig
from uavctl.lab.position_loop import EXTERNAL_ONLY
from uavctl.mavlink.connection import make_links
from uavctl.records import Outgoing, discard

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])


def state(found: CheckResult, name: str) -> ItemState:
    return found[name].state


def test_every_item_has_a_want_and_every_one_that_is_not_good_says_what_to_do() -> None:
    for found in (run_check(), run_check(["sim.autopilot=ardupilot"]), run_check(wrong=["frame.yaw_deg=90"])):
        for one in found.items.values():
            assert one.name and one.value and one.want
            assert bool(one.hint) == (one.state is not ItemState.GOOD)
            assert one.ok == (one.state is not ItemState.BAD)


# --- positions -------------------------------------------------------------------------------------------------------


def test_no_positions_at_all() -> None:
    found = run_check(["sim.camera.occluded=[[0.0,99.0]]"])
    assert found.bad_items == ["positions"]
    assert "none" in found["positions"].value and "is the source running" in found["positions"].hint


@pytest.mark.parametrize("shared", [False, True])
def test_on_a_shared_link_the_vehicle_s_own_estimate_is_offered(shared: bool) -> None:
    urls = [f'daemon.{role}="udpin://127.0.0.1:14540"' for role in ("vehicle", "mocap")]
    config = load_config("room-hahn-stursberg", urls if shared else [])
    flight, vehicle = Preflight(config, make_links, 0), Peer(1, 1)
    for at_ns in (MS, 2 * MS):
        flight.receive("vehicle", vehicle.heartbeat() + vehicle.local_position(at_ns // MS), at_ns)
    one = next(one for one in flight.make_items(3 * MS) if one.name == "positions")
    assert one.state is ItemState.BAD and ("LOCAL_POSITION_NED" in one.hint) == shared


def test_positions_that_are_refused_are_told_by_reason() -> None:
    found = run_check(["source.system_id=99"])
    assert "system-id" in found["positions"].value


@pytest.mark.parametrize(("rate_hz", "good"), [(20.0, True), (21.0, True), (25.0, False)])
def test_the_rate_is_that_of_the_cameras_whatever_the_link_loses(rate_hz: float, good: bool) -> None:
    found = run_check(["link.loss=0.3"], [f"source.rate_hz={rate_hz}"], seconds=10.0)
    assert found["position rate"].value.startswith("20 Hz captured")
    assert found["position rate"].ok == good


def test_a_sender_of_several_vehicles_leaves_positions_out() -> None:
    turns = ["link.model=scheduled", "sim.camera.rate_hz=50", "source.rate_hz=50", "link.loss=0.3"]
    for seed in range(4):
        found = run_check([*turns, "link.wait_s=0.07", f"sim.seed={seed}"], seconds=8.0)
        assert found["position rate"].ok, found["position rate"]
    assert not run_check([*turns, "link.wait_s=0.2"], ["link.wait_s=0.07"], seconds=8.0)["position rate"].ok


def test_more_loss_than_the_design_counts_on_fails_and_chance_does_not() -> None:
    for seed in range(8):
        more = ["link.loss=0.3", f"sim.seed={seed}", "sim.camera.rate_hz=5.0"]
        assert run_check(more, seconds=8.0)["position loss"].ok
    assert not run_check(["link.loss=0.5", "sim.camera.rate_hz=5.0"], ["link.loss=0.1"], seconds=8.0)[
        "position loss"
    ].ok
    # Four positions a step: the design's one of them is there far more often.
    assert run_check(["link.loss=0.3"], ["link.loss=0.1"], seconds=8.0)["position loss"].ok
    assert state(run_check(wrong=["link.model=gilbert-elliott"]), "position loss") is ItemState.NOTE


def test_an_age_beyond_the_design_is_told_and_one_beyond_a_step_fails() -> None:
    slow = run_check(["link.jitter_s=0.12"], ["link.jitter_s=0.02", "link.delay_s=0.0"])
    assert state(slow, "position age") is ItemState.NOTE
    late = run_check(["link.jitter_s=0.4"], ["link.jitter_s=0.02"])
    assert state(late, "position age") is ItemState.BAD
    # Plans of the other scheme count with every age up to the horizon.
    planned = run_check(["link.jitter_s=0.4"], ["link.jitter_s=0.02", "smpc.scheme=age-conditioned"])
    assert state(planned, "position age") is ItemState.NOTE
    # A sender of several vehicles lets a position wait for its turn, up to the cameras' period.
    turns = ["link.model=scheduled", "link.wait_s=0.3", "source.rate_hz=10", "smpc.scheme=age-conditioned"]
    waiting = run_check(["link.jitter_s=0.1"], ["link.jitter_s=0.02", *turns])
    assert state(waiting, "position age") is ItemState.GOOD


def test_a_gap_as_long_as_the_horizon_fails() -> None:
    found = run_check(["sim.camera.occluded=[[2.0,4.6]]"])
    assert not found["longest gap"].ok
    stopped = run_check(["sim.camera.occluded=[[3.0,99.0]]"])
    assert not stopped["longest gap"].ok  # also a gap that has not ended


def test_noise_beyond_the_filter_s_belief_fails() -> None:
    assert run_check()["position noise"].ok
    assert not run_check(["sim.camera.noise_std_m=0.03"])["position noise"].ok


@pytest.mark.fault(14)
def test_a_frozen_pose_is_told() -> None:
    found = run_check(["sim.camera.frozen=[[1.0,99.0]]"])
    assert state(found, "position frozen") is ItemState.UNDETERMINED
    assert "Move the body" in found["position frozen"].hint


@pytest.mark.fault(15)
@pytest.mark.parametrize(
    ("scale", "told"), [((1000.0, 1000.0, 1000.0), "millimetres"), ((1.0, 1.0, -1.0), "is up negative")]
)
def test_a_vehicle_outside_the_room_is_told_why(scale: tuple[float, float, float], told: str) -> None:
    hand = HandMotion("estimator.max_position_m=1e5")
    hand.place = [1.2, 0.4, -1.0]
    hand.matrix = [[scale[0], 0, 0], [0, scale[1], 0], [0, 0, scale[2]]]
    hand.hold(4.0)
    place = hand.is_done()["position in the room"]
    assert not place.ok and told in place.hint


def test_a_vehicle_just_outside_the_room_is_not_asked_for_its_unit() -> None:
    hand = HandMotion()
    hand.place = [3.6, 0.4, -1.0]
    hand.hold(4.0)
    place = hand.is_done()["position in the room"]
    assert not place.ok and "metres" not in place.hint


# --- clocks ----------------------------------------------------------------------------------------------------------


def test_clocks_that_are_answered_show_round_trip_and_drift() -> None:
    found = run_check(seconds=8.0)
    assert state(found, "vehicle clock") is ItemState.GOOD and "drift +0 ppm" in found["vehicle clock"].value
    assert state(found, "source clock") is ItemState.NOTE  # the simulated cameras answer nothing
    assert "set" not in found["source clock"].hint  # clock.latency_s is given
    assert "set clock.latency_s" in run_check(["clock.latency_s=0"], seconds=4.0)["source clock"].hint


class Answering(HandMotion):
    """A vehicle that answers TIMESYNC late, or by a clock that drifts."""

    delay_ns, drift = 0, 0.0

    def rest(self, seconds: float, *, armed: bool = False) -> None:
        for _ in range(round(seconds * 20)):
            super().hold(0.05, armed=armed)

    def answer(self) -> None:
        outgoing: list[Outgoing] = []
        self.flight.tick(0, self.at_ns, outgoing.append)
        for one in outgoing:
            for message in decode(one.data):
                if message.get_type() == "TIMESYNC" and one.link == "vehicle":
                    theirs = 10**12 + round(self.at_ns * (1.0 - self.drift))
                    data = self.vehicle.send("timesync", theirs, message.ts1)
                    self.flight.receive("vehicle", data, self.at_ns + self.delay_ns)


@pytest.mark.fault(19)
@pytest.mark.parametrize(
    ("delay_ms", "drift", "told"), [(0, 0.02, "drift +20"), (25, 0.0, "rejected"), (0, 0.0, "0 rejected")]
)
def test_clock_trouble_is_told(delay_ms: int, drift: float, told: str) -> None:
    hand = Answering()
    hand.delay_ns, hand.drift = delay_ms * MS, drift
    for _ in range(12):
        hand.at_ns += 950 * MS
        hand.flight.receive("vehicle", hand.vehicle.heartbeat(), hand.at_ns)
        hand.answer()
    clock = hand.is_done()["vehicle clock"]
    assert told in clock.value
    assert clock.state is (ItemState.GOOD if told == "0 rejected" else ItemState.NOTE)


def test_the_relay_cannot_do_without_the_vehicle_s_clock() -> None:
    hand = HandMotion("relay.enabled=true")
    hand.hold(4.0)
    assert not hand.is_done()["vehicle clock"].ok


def test_two_sources_of_one_id_are_found_by_their_stamps() -> None:
    hand = HandMotion()
    hand.hold(2.0)
    for n in range(40):
        hand.at_ns += 50 * MS
        for _ in range(2):
            hand.flight.receive("mocap", hand.cameras.vision(10**9 + n * 50_000, 0.3, 0.2, 0.0), hand.at_ns)
    assert not hand.is_done()["source clock"].ok


# --- vehicle ---------------------------------------------------------------------------------------------------------


def test_no_vehicle() -> None:
    config = load_config("room-hahn-stursberg")
    flight = Preflight(config, make_links, 0)
    found = CheckResult(flight, S)
    assert {"vehicle", "positions"} <= set(found.bad_items)


def test_an_autopilot_that_is_not_known_fails() -> None:
    hand = HandMotion()
    hand.flight.receive("vehicle", hand.vehicle.heartbeat(autopilot=8), 0)
    assert not CheckResult(hand.flight, S)["vehicle"].ok


def test_a_vehicle_that_fell_silent_fails() -> None:
    hand = HandMotion()
    hand.hold(2.0)
    assert not CheckResult(hand.flight, hand.at_ns + 4 * S)["vehicle"].ok


@pytest.mark.fault(16)
def test_a_second_vehicle_on_the_link_fails() -> None:
    hand = HandMotion()
    hand.hold(2.0)
    hand.flight.receive("vehicle", Peer(2, 1).heartbeat(), hand.at_ns)
    assert not hand.is_done()["other vehicles"].ok


def test_the_battery_is_judged_by_the_configured_voltage() -> None:
    assert state(run_check(wrong=["check.battery_v=14.0"]), "battery") is ItemState.BAD
    assert state(run_check(wrong=["check.battery_v=4.0"]), "battery") is ItemState.GOOD


def report_battery(autopilot: int, threshold: float | None, voltage_v: float, percent: int) -> HandMotion:
    """A vehicle of this kind with its own threshold of a low battery, if it has one, and its battery."""
    hand = HandMotion()
    hand.hold(2.0)
    hand.report(hand.vehicle.heartbeat(autopilot=autopilot, custom_mode=4))
    if threshold is not None:
        name = {3: b"BATT_LOW_VOLT", 12: b"BAT_LOW_THR"}[autopilot]
        hand.report(hand.vehicle.send("param_value", name, threshold, 9, 1, 0))
    hand.report(hand.vehicle.send("sys_status", 0, 0, 0, 0, round(1000 * voltage_v), 0, percent, 0, 0, 0, 0, 0, 0))
    return hand


@pytest.mark.parametrize(
    ("autopilot", "threshold", "voltage_v", "percent", "want"),
    [
        (12, 0.15, 11.1, 80, ItemState.GOOD),
        (12, 0.15, 16.8, 15, ItemState.BAD),  # PX4 judges the charge, whatever the voltage
        (12, 0.15, 11.1, -1, ItemState.UNDETERMINED),  # the charge is not known
        (12, None, 11.1, 80, ItemState.UNDETERMINED),
        (3, 10.5, 11.1, 5, ItemState.GOOD),  # ArduPilot's threshold is a voltage
        (3, 10.5, 10.4, 90, ItemState.BAD),
        (3, 0.0, 10.4, 90, ItemState.UNDETERMINED),  # its failsafe is off
        (3, None, 10.4, 90, ItemState.UNDETERMINED),
        (3, 10.5, 0.0, 0, ItemState.UNDETERMINED),  # it has no battery monitor
    ],
)
def test_without_a_configured_voltage_the_vehicle_s_own_threshold_judges_the_battery(
    autopilot: int, threshold: float | None, voltage_v: float, percent: int, want: ItemState
) -> None:
    assert state(report_battery(autopilot, threshold, voltage_v, percent).is_done(), "battery") is want


def test_the_configured_voltage_comes_before_the_vehicle_s_own_threshold() -> None:
    low = ["sim.plant='quadrotor'", "sim.quadrotor.charge=0.1"]
    assert state(run_check(low, ["check.battery_v=1.0"]), "battery") is ItemState.GOOD
    assert state(run_check(low), "battery") is ItemState.BAD
    assert state(run_check(low[:1]), "battery") is ItemState.GOOD


def test_armed_and_in_the_air_are_told() -> None:
    found = run_check(airborne=True)
    assert (state(found, "armed"), state(found, "landed")) == (ItemState.NOTE, ItemState.NOTE)


@pytest.mark.parametrize(
    ("periods_ms", "told", "wanted_state"),
    [
        ([], "not reported", ItemState.NOTE),
        ([100], "10 Hz", ItemState.GOOD),
        ([300, 300, 300], "3.33 Hz", ItemState.GOOD),
        ([400, 400, 100], "2.5 Hz", ItemState.NOTE),
        ([100, 100, 900], "10 Hz", ItemState.GOOD),  # a few that are lost
    ],
)
def test_the_rate_of_the_vehicles_own_velocity_is_told(
    periods_ms: list[int], told: str, wanted_state: ItemState
) -> None:
    flight, vehicle, at_ms = Preflight(load_config("room-hahn-stursberg"), make_links, 0), Peer(1, 1), 1000
    flight.receive("vehicle", vehicle.heartbeat() + vehicle.local_position(at_ms), at_ms * MS)
    for period_ms in periods_ms:
        at_ms += period_ms
        flight.receive("vehicle", vehicle.local_position(at_ms), at_ms * MS)
    one = next(one for one in flight.make_items((at_ms + 1) * MS) if one.name == "own velocity")
    assert (one.value, one.state) == (told, wanted_state)


@pytest.mark.parametrize("armed", [False, True])
def test_what_is_to_take_off_is_not_armed_already(armed: bool) -> None:
    config = load_config("room-hahn-stursberg")
    flight = Preflight(config, make_links, 0, take_off_m=1.0)
    flight.receive("vehicle", Peer(1, 1).heartbeat(base_mode=129 if armed else 1), 1)
    one = next(one for one in flight.make_items(1) if one.name == "armed")
    assert one.state is (ItemState.BAD if armed else ItemState.GOOD)
    assert ("without --arm" in one.hint) == armed


@BOTH
def test_a_check_sends_nothing_that_arms_or_moves(autopilot: str) -> None:
    """Every message to the vehicle is one of these, and every command asks for a message."""
    config = load_config("room-hahn-stursberg", [f"sim.autopilot={autopilot}", "relay.enabled=true"])
    peers, flight = Peers(config, 0, airborne=False), Preflight(config, make_links, 0)
    kinds, commands = set(), set()
    for tick in range(300):
        at_ns = tick * 50 * MS
        for arrival_ns, link, data in peers.advance(at_ns):
            flight.receive(link, data, arrival_ns)
        outgoing: list[Outgoing] = []
        flight.tick(tick, at_ns, outgoing.append)
        for one in outgoing:
            peers.receive(one.link, one.data, at_ns)
            for message in decode(one.data):
                kinds.add(message.get_type())
                if message.get_type() == "COMMAND_LONG":
                    commands.add(message.command)
    quiet = {
        "HEARTBEAT",
        "TIMESYNC",
        "PARAM_REQUEST_LIST",
        "PARAM_REQUEST_READ",
        "COMMAND_LONG",
        "VISION_POSITION_ESTIMATE",
    }
    assert kinds <= quiet | {"SET_GPS_GLOBAL_ORIGIN"}
    assert commands <= {511, 512}  # MAV_CMD_SET_MESSAGE_INTERVAL, MAV_CMD_REQUEST_MESSAGE
    assert not peers.autopilot.pilot.is_armed


# --- a camera system without a bridge --------------------------------------------------------------------------------

MOTIVE = "daemon.mocap=natnet://10.0.0.5/drone"


def test_without_a_position_the_hint_is_of_who_should_have_sent_it() -> None:
    bridge = Preflight(load_config("room-hahn-stursberg"), make_links, 0).make_items(3 * S)
    motive = Preflight(load_config("room-hahn-stursberg", [MOTIVE]), make_links, 0).make_items(3 * S)
    hints = [next(one.hint for one in items if one.name == "positions") for items in (bridge, motive)]
    assert "VISION_POSITION_ESTIMATE" in hints[0] and "track the body" not in hints[0]
    assert "track the body of natnet://" in hints[1] and "VISION_POSITION_ESTIMATE" not in hints[1]


def told_by_motive(*place: float, mocap: str = MOTIVE) -> Preflight:
    """Motive's metres, sent with the axes of another up."""
    flight, peer = Preflight(load_config("room-hahn-stursberg", [mocap]), make_links, 0), Peer(246, 197)
    level = (
        20,
        12,
        *place,
        [1.0, 0.0, 0.0, 0.0],
        *(math.nan,) * 3,
        *(0.0,) * 3,
        [math.nan] * 21,
        [math.nan] * 21,
        0,
        5,
    )
    for n in range(60):
        flight.receive("mocap", peer.send("odometry", 10**9 + 50_000 * n, *level), n * 50 * MS)
        flight.tick(n, n * 50 * MS, discard)
    return flight


def test_a_body_of_motive_s_out_of_the_room_is_a_matter_of_its_up_axis_not_of_units() -> None:
    place = {one.name: one for one in told_by_motive(0.1, 0.2, 1.2).make_items(3 * S)}["position in the room"]
    assert place.state is ItemState.BAD and "?up=z" in place.hint and "frame.convention" not in place.hint
    place = {one.name: one for one in told_by_motive(50.0, 20.0, -90.0).make_items(3 * S)}["position in the room"]
    assert place.state is ItemState.BAD and "metres" not in place.hint


def test_a_body_of_a_topic_out_of_the_room_is_a_matter_of_its_driver_s_axes_and_unit() -> None:
    flight = told_by_motive(0.1, 0.2, 1.2, mocap="daemon.mocap=ros2://drone/pose")
    place = {one.name: one for one in flight.make_items(3 * S)}["position in the room"]
    assert place.state is ItemState.BAD and "metres" in place.hint and "?up=" not in place.hint


# --- what forbids arming ---------------------------------------------------------------------------------------------


def test_only_bad_items_forbid_arming_and_accepted_ones_do_not() -> None:
    items = [make_item(f"one {each}", each, "x", "y", "z") for each in ItemState]
    assert [one.name for one in find_refusals(items, CheckConfig())] == ["one bad"]
    assert find_refusals(items, CheckConfig(accept=("one bad",))) == ()


def test_the_heading_of_a_turned_body_is_a_mean_of_directions() -> None:
    """Angles near 180 degrees must not average to 0."""
    hand = HandMotion(heading_rad=math.pi)
    hand.hold(3.0)
    assert state(hand.is_done(), "heading") is ItemState.UNDETERMINED  # the hand's cameras tell no attitude
    found = run_check(["frame.yaw_deg=10.0"], ["frame.yaw_deg=-170.0"])
    assert state(found, "heading") is ItemState.BAD and "180" in found["heading"].value


@BOTH
def test_with_the_relay_the_check_itself_gives_the_vehicle_its_position(autopilot: str) -> None:
    def prepare(peers: Peers) -> None:
        for name, value in EXTERNAL_ONLY[autopilot].items():
            assert peers.autopilot.parameters.set(name, value), name

    more = ["relay.enabled=true", "frame.yaw_deg=20", "sim.camera.rate_hz=30.0", "sim.plant=quadrotor"]
    found = run_check([f"sim.autopilot={autopilot}", *more], prepare=prepare, seconds=8.0)
    assert not found.bad_items
    assert state(found, "relay") is ItemState.GOOD and state(found, "own position") is ItemState.GOOD
    # What the vehicle believes because we told it shows nothing of our axes.
    assert state(found, "axes") is ItemState.UNDETERMINED and "ENU" in found["axes"].value


@pytest.mark.fault(12)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38, -3e38, 1e-45])
@pytest.mark.parametrize("autopilot", [3, 12])
def test_absurd_values_of_a_vehicle_never_raise(autopilot: int, value: float) -> None:
    hand = HandMotion(has_estimate=True)
    hand.hold(2.0)
    hand.report(hand.vehicle.heartbeat(autopilot=autopilot, custom_mode=4))
    for name in list_parameters(autopilot):
        for kind in (2, 6, 9):
            hand.report(hand.vehicle.send("param_value", name.encode(), value, kind, 9, 3))
    for n in range(20):
        hand.at_ns += 50 * MS
        boot_ms = hand.at_ns // MS + 20_000
        hand.report(hand.vehicle.local_position(boot_ms, value, value, value))
        hand.report(hand.vehicle.send("attitude", boot_ms, value, value, value, 0.0, 0.0, 0.0))
        where = (value if math.isfinite(value) else 0.0, 0.0, 0.0)
        attitude = [value, 0.0, 0.0, 1.0]
        data = hand.cameras.send("att_pos_mocap", 10**10 + n * 50_000, attitude, *where, [math.nan] * 21)
        hand.flight.receive("mocap", data, hand.at_ns)
    assert hand.is_done().items


@pytest.mark.slow
@given(st.lists(st.binary(max_size=64), max_size=30))
def test_random_bytes_never_raise(chunks: list[bytes]) -> None:
    flight = Preflight(load_config("room-hahn-stursberg"), make_links, 0)
    for n, data in enumerate(chunks):
        flight.receive("vehicle" if n % 2 else "mocap", data, n * MS)
        flight.tick(n, n * MS, discard)
    assert flight.make_items(S)
