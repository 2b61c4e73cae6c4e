"""Nine recorded flights of ArduCopter and PX4 drive hand-over, clock, check, identify and report to what was seen."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from loopback_rig import MemorySink
from numpy.typing import NDArray
from recorded_rig import (
    AT_REST,
    EVERY,
    OF_OTHERS,
    OWN_ESTIMATE,
    RELAYED,
    LoopRecord,
    events,
    find_event_times_s,
    listen,
    load_flight_config,
    make_page_data,
    packets,
    run_check,
    statuses,
    truth,
    watch_records,
)
from report_rig import read_page_text

from uavctl.config import load_config
from uavctl.lab.identify.fit import choose_dead_time
from uavctl.lab.identify.history import FlightHistory, TimesyncExchange, read_tlog_history
from uavctl.lab.identify.result import LinkFit, fit_link, get_candidate_models, identify, make_fitted_stretches
from uavctl.lab.trial import get_room_limits
from uavctl.mavlink.clocksync import TimesyncClock
from uavctl.records import Command, ControlMode, Decision, Event, Order

GPS, VICON, OFFBOARD = OF_OTHERS
WIND, PILOT, BLOWN, RELEASED, WAYPOINTS = RELAYED
GPS_TRUTH = "arducopter-gps"


def describe_statuses(name: str) -> list[str]:
    """What the vehicle was seen to be, as it changed."""
    observed: list[str] = []
    for _, status in statuses(name):
        text = f"{status.mode}{'' if status.armed else ', disarmed'}{', failsafe' if status.failsafe else ''}"
        if not observed or observed[-1] != text:
            observed.append(text)
    return observed


# --- the vehicle's own words -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_no_recorded_vehicle_counts_as_restarted(name: str) -> None:
    assert len(packets(name)) > 1000
    assert {status.boots for _, status in statuses(name)} == {0}


@pytest.mark.parametrize(
    ("name", "flown"),
    [
        (GPS, ["STABILIZE, disarmed", "GUIDED, disarmed", "GUIDED", "LAND", "LAND, disarmed"]),
        (VICON, ["STABILIZE, disarmed", "GUIDED, disarmed", "GUIDED", "LAND, failsafe", "LAND, disarmed, failsafe"]),
        (AT_REST, ["AUTO.LOITER, disarmed", "AUTO.TAKEOFF, disarmed"]),
        (
            RELEASED,
            [
                *("OFFBOARD, disarmed", "AUTO.TAKEOFF, disarmed", "AUTO.LAND, failsafe", "AUTO.TAKEOFF"),
                *("POSCTL", "OFFBOARD", "POSCTL"),
            ],
        ),
        (PILOT, ["GUIDED, disarmed", "GUIDED", "LOITER", "GUIDED", "LOITER", "GUIDED", "LOITER"]),
        (
            WAYPOINTS,
            [
                *("OFFBOARD, disarmed", "AUTO.TAKEOFF, disarmed", "AUTO.TAKEOFF", "OFFBOARD", "AUTO.LAND"),
                "OFFBOARD, disarmed",
            ],
        ),
    ],
)
def test_modes_and_failsafes_are_parsed_as_recorded(name: str, flown: list[str]) -> None:
    assert describe_statuses(name) == flown


def test_a_recorded_failsafe_that_holds_is_distinguished_from_a_pilot_who_holds() -> None:
    observed = describe_statuses(OFFBOARD)
    # Its text comes before the heartbeat with the new mode.
    flown = ["AUTO.TAKEOFF", "AUTO.LOITER", "OFFBOARD", "OFFBOARD, failsafe", "AUTO.LOITER, failsafe"]
    assert observed[2:7] == flown and "OFFBOARD" in observed[7:]


# --- clocks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*OF_OTHERS, *RELAYED])
def test_the_client_s_exchange_predicts_the_vehicle_s_clock_until_the_next_answer(name: str) -> None:
    """To half of the longest round trip that counts; simulated clocks run up to 3.4 % slow, and unevenly."""
    exchange, trips, off_ms = TimesyncExchange(), TimesyncClock(10_000_000_000), []
    for packet in packets(name):
        for trip in exchange.take(packet.data, packet.at_ns, outgoing=packet.outgoing):
            predicted = trips.offset_ns(packet.at_ns)
            measured = (trip.sent_ns + packet.at_ns) // 2 - trip.remote_ns
            if trips.add_answer(trip.sent_ns, trip.remote_ns, packet.at_ns) and predicted is not None:
                off_ms.append(abs(measured - predicted) * 1e-6)
    assert len(off_ms) > 40
    assert np.median(off_ms) < (3.0 if name in OF_OTHERS else 5.0)


@cache
def load_history(name: str) -> FlightHistory:
    return read_tlog_history(packets(name), load_flight_config(name))


@pytest.mark.parametrize(("name", "most_ms"), [(GPS, 10.0), (OFFBOARD, 20.0)])
def test_the_vehicle_s_own_estimate_comes_within_milliseconds_though_its_clock_runs_slow(
    name: str, most_ms: float
) -> None:
    """PX4's simulated clock lost 1.5 s in 113 s: with one offset for all of it, delays were 0.1 to 0.3 s."""
    delays_ms = 1e3 * load_history(name).positions.delays_s
    assert np.median(delays_ms) < 5.0
    assert np.quantile(delays_ms, 0.95) < most_ms


def test_the_cameras_delays_are_those_of_the_simulator() -> None:
    """25 to 142 ms, of which the shortest is configured (30 ms): the simulator's clock is not the answers'."""
    delays_ms = 1e3 * load_history(VICON).positions.delays_s
    low, middle, high = np.quantile(delays_ms, [0.05, 0.5, 0.95])
    assert (low, middle, high) == pytest.approx((34.0, 80.0, 124.0), abs=10.0)


# --- identify ----------------------------------------------------------------------------------------------------


@cache
def make_flight_link(name: str) -> LinkFit:
    result = load_history(name)
    return fit_link(result.positions, result.losses)


CAMERA_HZ = 40.0
QUICKEST_S, SLOWEST_S = 0.010, 0.040  # from a frame to its arrival, alike likely in between
BLACKOUT = "ORDER blackout "


@dataclass(frozen=True)
class Frames:
    """The rig's frames by their stamps alone, since the first packet.

    Attributes:
        stamps_s: Of those that came, each once.
        delays_s: From each stamp to its arrival.
        lost: Share that did not come, outside the blackouts that were ordered.
        within: Frames that came though they are of a blackout.
    """

    stamps_s: NDArray[np.float64]
    delays_s: NDArray[np.float64]
    lost: float
    within: int


@cache
def read_frames(name: str) -> Frames:
    """What the rig sent and what of it came: nothing of `identify` is asked."""
    first_ns = packets(name)[0].at_ns
    arrivals_ns: dict[int, int] = {}
    for packet in packets(name):
        if packet.data[5] == 20 and packet.data[7] == 102:
            arrivals_ns.setdefault(1000 * int.from_bytes(packet.data[10:18], "little"), packet.at_ns)
    stamps_s = (np.array(sorted(arrivals_ns)) - first_ns) * 1e-9
    dark = np.zeros(stamps_s.size, dtype=np.bool_)
    dark_s = 0.0
    for begin_s, arguments in events(name):
        if arguments.startswith(BLACKOUT):
            length_s = float(arguments.removeprefix(BLACKOUT))
            dark |= (stamps_s > begin_s) & (stamps_s < begin_s + length_s)
            dark_s += length_s
    # A late rig stamps late, but catches up: single spacings are off by up to half a period, the count is not.
    sent = 1.0 + CAMERA_HZ * (stamps_s[-1] - stamps_s[0] - dark_s)
    return Frames(
        stamps_s=stamps_s,
        delays_s=np.array([at_ns - stamp_ns for stamp_ns, at_ns in sorted(arrivals_ns.items())]) * 1e-9,
        lost=1.0 - float(np.count_nonzero(~dark)) / sent,
        within=int(np.count_nonzero(dark)),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "lost"), [(WIND, 0.292), (PILOT, 0.273), (BLOWN, 0.229), (RELEASED, 0.248), (WAYPOINTS, 0.222)]
)
def test_the_loss_found_is_that_of_the_frames_that_are_missing(name: str, lost: float) -> None:
    """Within 0.5 % of the frames'; all but one flight met fewer bursts than make 30 %."""
    result, true = make_flight_link(name), read_frames(name)
    assert true.within <= 1
    assert true.lost == pytest.approx(lost, abs=0.001)
    assert result.loss == pytest.approx(true.lost, abs=0.005)
    assert 0.01 < result.loss_std < 0.05
    assert result.bursts


@pytest.mark.slow
@pytest.mark.parametrize("name", RELAYED)
def test_the_rig_s_blackouts_rate_and_delays_are_found(name: str) -> None:
    result, true = make_flight_link(name), read_frames(name)
    assert len(result.outages_s) == len(find_event_times_s(name, BLACKOUT))
    assert all(length_s == pytest.approx(4.0, abs=0.3) for length_s in result.outages_s)
    assert result.rate_hz == pytest.approx(CAMERA_HZ, rel=0.01)
    assert result.delay_s == pytest.approx(QUICKEST_S, abs=0.002)
    assert result.delay_quantiles_s[3] == pytest.approx(SLOWEST_S - 0.05 * (SLOWEST_S - QUICKEST_S), abs=0.010)
    assert result.delay_quantiles_s[4] == pytest.approx(float(np.quantile(true.delays_s, 0.99)), abs=0.002)


@pytest.mark.slow
@pytest.mark.parametrize("name", RELAYED)
def test_all_but_a_hundredth_of_the_positions_have_the_configured_delay(name: str) -> None:
    """Of one flight only those before its wind: 3 s later, and for 43 s, 7 % of the frames came 50 to 95 ms late."""
    link = make_flight_link(name)
    if name == BLOWN:
        until_ns = packets(name)[0].at_ns + find_event_times_s(name, "ORDER set SIH_WIND")[0] * 1e9
        before = read_tlog_history(
            [packet for packet in packets(name) if packet.at_ns < until_ns], load_flight_config(name)
        )
        link = fit_link(before.positions, before.losses)
    late_s = link.delay_quantiles_s[4]
    assert late_s == pytest.approx(SLOWEST_S - 0.01 * (SLOWEST_S - QUICKEST_S), abs=0.010)


@pytest.mark.fault(59)
def test_the_loss_of_arducopter_s_long_flight_is_the_configured_one() -> None:
    """On the mean of a long flight; the other four met fewer bursts, by their frames as well."""
    assert make_flight_link(WIND).loss == pytest.approx(0.3, abs=0.02)


def test_positions_of_px4_do_not_count_as_camera_positions_though_they_are_more() -> None:
    kinds = [packet.data[7] | packet.data[8] << 8 for packet in packets(WAYPOINTS) if packet.data[5] in (1, 20)]
    assert kinds.count(331) >= kinds.count(102)  # ODOMETRY, VISION_POSITION_ESTIMATE
    assert make_flight_link(WAYPOINTS).rate_hz == pytest.approx(40.0, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", RELAYED)
def test_positions_are_captured_where_the_vehicle_truly_was(name: str) -> None:
    """The truth is 0.1 s apart, the cameras' noise 2 mm."""
    result, rows = load_history(name), truth(name)
    first_s = _first_capture_s(name)
    at_s = result.positions.times_s + first_s
    inside = (at_s > rows[0, 0]) & (at_s < rows[-1, 0])
    off = [
        np.interp(at_s[inside], rows[:, 0], rows[:, 1 + axis]) - result.positions.positions_m[inside, axis]
        for axis in range(2)
    ]
    assert np.median(np.hypot(*off)) < 0.05


def _first_capture_s(name: str) -> float:
    """Stamp of the first position, which is of the recorder's clock, since the first packet."""
    stamps = [
        int.from_bytes(packet.data[10:18], "little") * 1000
        for packet in packets(name)
        if packet.data[5] == 20 and packet.data[7] == 102
    ]
    return (min(stamps) - packets(name)[0].at_ns) * 1e-9


@pytest.mark.slow
def test_px4_s_response_is_that_of_its_own_log_though_its_clock_ran_slow() -> None:
    """By its log: dead time and lag together 0.24 and 0.32 s, drag 0.97 and 1.08 1/s, gain 0.98 and 1.10."""
    config = load_config("room-hahn-stursberg", ["daemon.mocap=tlog", "daemon.vehicle=tlog", OWN_ESTIMATE])
    result = identify(read_tlog_history(packets(OFFBOARD), config), config, lambda: None).result
    together_s = [result.candidates[0].dead_time_s + axis.lag_s for axis in result.response[:2]]
    assert together_s == pytest.approx([0.24, 0.32], abs=0.09)
    assert [axis.drag_1ps for axis in result.response[:2]] == pytest.approx([0.974, 1.080], abs=0.1)
    assert [axis.r2 > 0.99 for axis in result.response[:2]] == [True, True]


STEP_RAMP_S = 1.0 / 5.0  # which ArduPilot makes of a step of 1 m/s² at PSC_JERK_XY 5
GRID_S = 0.02  # of the dead times, and of the lags, of the fit to the simulator's log


@pytest.mark.slow
def test_arducopter_s_response_to_steps_is_that_of_its_own_log() -> None:
    """By its log, per step as sent: dead time and lag 0.18 s, gain 1.027 and 1.026, drag 0.009 and 0.011 1/s.

    That fit takes half of a step's ramp for dead time, and knows the true velocity. Ours knows the ramp, and sees what
    the vehicle's estimator says, which is later than the truth.
    """
    config = load_config("room-hahn-stursberg", ["daemon.mocap=tlog", "daemon.vehicle=tlog", OWN_ESTIMATE])
    boot_ns, estimates = _own_estimates(GPS)
    steps = read_tlog_history([packet for packet in packets(GPS) if packet.at_ns < boot_ns + 87.4e9], config)
    flown = make_fitted_stretches(steps, config)
    result = choose_dead_time(flown, (0, 1), get_candidate_models(steps, config)[0][:2], lambda: None)
    assert result.name == "drag-lag" and sum(stretch.length_s for stretch in flown) > 30.0
    for axis, gain, drag_1ps in ((0, 1.027, 0.009), (1, 1.026, 0.011)):
        fit = result.fits[axis]
        late_s = _lateness_s(estimates, axis, (55.4, 71.4) if axis == 0 else (71.4, 87.4))
        assert 0.0 < late_s < 0.06
        as_sent_s = result.dead_time_s + fit.value("lag_s") + 0.5 * STEP_RAMP_S - late_s
        assert as_sent_s == pytest.approx(0.18, abs=GRID_S)
        assert fit.value("gain") == pytest.approx(gain, abs=0.02)
        assert fit.value("drag_1ps") == pytest.approx(drag_1ps, abs=0.01)


def _own_estimates(name: str) -> tuple[int, NDArray[np.float64]]:
    """When the autopilot booted [ns], and rows of its own estimate: time since then [s], position [m]."""
    boot_ns, rows = 0, []
    for packet in packets(name):
        if not packet.outgoing and packet.data[7:10] == b"\x20\x00\x00":  # LOCAL_POSITION_NED, zeros at its end cut
            boot_ms, *position_m = struct.unpack("<I3f", packet.data[10:-2].ljust(16, b"\0")[:16])
            boot_ns = boot_ns or packet.at_ns - 1_000_000 * boot_ms
            rows.append((boot_ms * 1e-3, *position_m))
    return boot_ns, np.array(rows)


def _lateness_s(estimates: NDArray[np.float64], axis: int, span_s: tuple[float, float]) -> float:
    """By how much an estimate is later than the truth, where both are most alike [s]."""
    rows = truth(GPS_TRUTH)
    part = estimates[(estimates[:, 0] > span_s[0]) & (estimates[:, 0] < span_s[1])]
    tried_s = np.arange(-0.1, 0.2, 0.005)
    apart = [part[:, 1 + axis] - np.interp(part[:, 0] - shift_s, rows[:, 0], rows[:, 1 + axis]) for shift_s in tried_s]
    return float(tried_s[np.argmin(np.std(apart, axis=1))])


# --- check -------------------------------------------------------------------------------------------------------

GOOD, NOTE, BAD = "good", "note", "bad"


@pytest.mark.parametrize(
    ("name", "since_s", "seconds"),
    [
        (AT_REST, 0.0, 3.4),
        (WAYPOINTS, 10.0, 10.0),
        (BLOWN, 10.0, 10.0),
        (PILOT, 20.0, 10.0),
        (WIND, 25.0, 10.0),
        (RELEASED, 10.0, 10.0),
    ],
)
def test_a_good_set_up_passes_the_check_over_a_link_that_loses_in_bursts(
    name: str, since_s: float, seconds: float
) -> None:
    items = run_check(name, since_s, seconds)
    assert [name for name, state in items.items() if state == BAD] == []
    assert items["own position"] == GOOD
    assert items["position loss"] == GOOD
    assert items["position in the room"] == GOOD


@pytest.mark.parametrize(
    ("name", "seconds", "noted", "good"),
    [
        (
            GPS,  # "EKF3 IMU0 is using GPS" comes 41.5 s after the boot: before, it sends no position
            42.0,
            ["EK3_SRC1_POSXY"],
            ["GUID_OPTIONS", "EK3_SRC1_YAW", "FS_EKF_ACTION", "FS_EKF_THRESH", "position age"],
        ),
        (
            VICON,  # 25 to 142 ms late, while the preset counts on 30 to 70
            20.0,
            ["position age", "source clock"],
            ["EK3_SRC1_POSXY", "EK3_SRC1_POSZ", "EK3_SRC1_YAW", "VISO_TYPE", "own position", "FS_EKF_THRESH"],
        ),
        (OFFBOARD, 8.0, ["MIS_TAKEOFF_ALT"], ["COM_OBL_RC_ACT", "position noise"]),
    ],
)
def test_parameters_that_another_client_read_are_judged_as_that_flight_was_set_up(
    name: str, seconds: float, noted: list[str], good: list[str]
) -> None:
    """At rest before the flight. TIMESYNC is noted of each: it was the other client's that was answered."""
    items = run_check(name, 0.0, seconds)
    # An ArduPilot's 3 s, as shipped, are more than a room holds; so is PX4's second at the preset's 4 m/s².
    timeout = "COM_OF_LOSS_T" if name == OFFBOARD else "GUID_TIMEOUT"
    assert [name for name, state in items.items() if state == BAD] == [timeout]
    assert {name: items[name] for name in noted} == dict.fromkeys(noted, NOTE)
    assert {name: items[name] for name in good} == dict.fromkeys(good, GOOD)
    standing = ["vehicle", "armed", "landed", "position rate", "position loss", "position in the room"]
    assert {name: items[name] for name in standing} == dict.fromkeys(standing, GOOD)
    assert items["vehicle clock"] == NOTE


@pytest.mark.parametrize(("name", "since_s"), [(GPS, 60.0), (OFFBOARD, 28.0)])
def test_a_vehicle_that_flies_above_the_room_is_found_out_of_it(name: str, since_s: float) -> None:
    """Both took off to 5 m."""
    lower, _ = get_room_limits(load_flight_config(name))
    assert lower[2] > -5.0
    items = run_check(name, since_s, 10.0)
    assert [name for name, state in items.items() if state == BAD] == ["position in the room"]
    assert (items["armed"], items["landed"], items["position loss"]) == (NOTE, NOTE, GOOD)


@pytest.mark.parametrize(("name", "since_s"), [(VICON, 84.0), (WIND, 44.0)])
def test_cameras_that_fall_silent_are_found_by_the_longest_gap(name: str, since_s: float) -> None:
    """VICON's for good, 86.4 s after the boot, WIND's for the 4 s that were ordered."""
    items = run_check(name, since_s, 8.0)
    assert items["longest gap"] == BAD
    assert items["position in the room"] == GOOD


def test_a_link_that_loses_half_of_the_positions_is_reported_at_rest() -> None:
    """In the first 3 s of WIND its bursts took more than half of the frames."""
    stamps_s = read_frames(WIND).stamps_s
    assert np.count_nonzero((stamps_s > 0.0) & (stamps_s < 3.0)) < 0.5 * 3.0 * CAMERA_HZ
    assert run_check(WIND, 0.0, 3.0)["position loss"] == BAD


def test_a_px4_whose_position_is_not_valid_yet_is_not_called_bad() -> None:
    """RELEASED arms at 1.77 s and takes until 3.2 s to have one: then the origins are compared, before nothing is."""
    before, after = run_check(RELEASED, 0.0, 1.6), run_check(RELEASED, 2.0, 1.6)
    assert (before["own position"], after["own position"]) == ("undetermined", GOOD)
    assert (before["armed"], after["armed"]) == (GOOD, NOTE)
    assert BAD not in (*before.values(), *after.values())


def test_a_px4_at_rest_has_a_position_of_its_own() -> None:
    """It says CONST_POS_MODE of itself, which is no want of one."""
    assert run_check(AT_REST, 0.0, 3.4)["own position"] == GOOD


def test_a_turned_frame_is_found_in_the_recorded_flight() -> None:
    items = run_check(WAYPOINTS, 10.0, 10.0, "frame.yaw_deg=90.0")
    assert items["axes"] == BAD


# --- hand-over and page ------------------------------------------------------------------------------------------


def find_texts(memory: MemorySink) -> list[str]:
    return [event.text for event in memory.of(Event) if event.code == "hand-over"]


def list_codes(memory: MemorySink) -> list[str]:
    return [event.code for event in memory.of(Event)]


def _lost(memory: MemorySink) -> None:
    decisions = memory.of(Decision)
    assert any(decision.mode is not ControlMode.TRACK for decision in decisions)
    assert "fallback-brake" in list_codes(memory)


def _pilot(memory: MemorySink) -> None:
    assert any("-> released (LOITER" in text for text in find_texts(memory))


def _rest(memory: MemorySink) -> None:
    assert "vehicle-reboot" not in list_codes(memory)
    assert any("REJECTED" in event.text for event in memory.of(Event))


def _land(memory: MemorySink) -> None:
    assert any("-> unclear (AUTO.LAND" in text for text in find_texts(memory))


def _failsafe(memory: MemorySink) -> None:
    texts = [event.text for event in memory.of(Event) if event.code == "vehicle-text"]
    assert any(text.startswith("EKF Failsafe") for text in texts)


def _silent(memory: MemorySink) -> None:
    texts = [event.text for event in memory.of(Event) if event.code == "vehicle-text"]
    assert "Failsafe activated" in texts


def _landed(memory: MemorySink) -> None:
    texts = [event.text for event in memory.of(Event) if event.code == "vehicle-text"]
    assert "Disarming motors" in texts


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "since_s", "seconds", "matters", "on_the_page"),
    [
        (WIND, 40.0, 12.0, _lost, "without positions: landing"),
        (PILOT, 10.0, 8.0, _pilot, "LOITER"),
        (WAYPOINTS, 68.0, 14.0, _land, "AUTO.LAND"),
        (AT_REST, 0.0, 4.0, _rest, "REJECTED"),
        (VICON, 80.0, 26.0, _failsafe, "EKF Failsafe"),
        (OFFBOARD, 70.0, 12.0, _silent, "Failsafe activated"),
        (GPS, 107.0, 20.0, _landed, "Disarming motors"),
    ],
    ids=lambda value: value if isinstance(value, str) and "-" in value else "",
)
def test_the_page_of_each_flight_names_its_cause(
    name: str, since_s: float, seconds: float, matters: Callable[[MemorySink], Any], on_the_page: str
) -> None:
    memory = watch_records(name, since_s, seconds)
    matters(memory)
    page = read_page_text(make_page_data(memory))
    assert on_the_page in " ".join(page.text)
    assert page.plots


def find_code_times_s(received: LoopRecord, begin: str, code: str = "hand-over") -> list[float]:
    """When events of a code came whose texts begin so, since the first packet [s]."""
    result = received.memory.of(Event)
    return [
        received.get_flight_time_s(event.at_ns)
        for event in result
        if event.code == code and event.text.startswith(begin)
    ]


def test_the_wind_beyond_the_authority_is_met_before_it_has_blown_the_vehicle_out_of_the_room() -> None:
    """The real flight stayed in mode `track`, without a word, until it was 24 m outside."""
    received = listen(BLOWN, 50.0, 12.0)
    ordered_s = find_event_times_s(BLOWN, "ORDER set SIH_WIND")[0]
    (noticed_s,) = find_code_times_s(received, "", "envelope-response")
    assert noticed_s == pytest.approx(57.65, abs=0.01)
    assert noticed_s - ordered_s == pytest.approx(0.95, abs=0.1)
    (landing_s,) = find_code_times_s(received, "engaged -> landing")
    assert 0.0 < landing_s - noticed_s < 0.11
    assert list_codes(received.memory).index("envelope-response") < list_codes(received.memory).index("fallback-land")

    # What the console, the exit code and the page say of it: the reason is the envelope's own.
    (reason,) = [event.text for event in received.memory.of(Event) if event.code == "envelope-response"]
    assert received.loop.breach_reason == reason and reason in received.loop.ending.sentence
    assert received.loop.ending.exit_code == 1
    assert [notice.text for notice in received.notices if "engaged -> landing" in notice.text]
    assert reason in " ".join(read_page_text(make_page_data(received.memory)).text)

    rows = truth(BLOWN)
    where_m = np.array([np.interp(noticed_s, rows[:, 0], rows[:, 1 + axis]) for axis in range(2)])
    furthest_m = np.abs(rows[:, 1:3]).max()
    assert np.all(np.abs(where_m) < (3.0, 2.5)) and furthest_m > 20.0


@pytest.mark.slow
def test_before_the_wind_the_same_flight_has_no_finding() -> None:
    """In 25 s of hovering, and from the blackout's end to the order of the wind."""
    for since_s, seconds in ((20.0, 25.0), (51.0, 5.6)):
        received = listen(BLOWN, since_s, seconds)
        assert not received.loop.breach_reason and not received.notices
        assert not [code for code in list_codes(received.memory) if code.startswith(("envelope", "fallback"))]


@pytest.mark.slow
def test_a_failsafe_in_the_climb_the_pilot_and_the_order_are_reported_at_their_times() -> None:
    """Its client had let go for good in the climb, so OFFBOARD is waited for until the operator's order."""
    patient = ("hand_over.engage_s=60.0", "hand_over.tries=100")
    take_off, engage = Command(order=Order.TAKE_OFF, height_m=1.2), Command(order=Order.ENGAGE)
    ordered_s = find_event_times_s(RELEASED, "ORDER mark engage")[0]
    received = listen(RELEASED, 0.0, 66.0, *patient, orders=[(1.45, take_off), (ordered_s, engage)])
    pilot_s = find_event_times_s(RELEASED, "MODE 3/0")
    passages = {
        "climbing -> failsafe (AUTO.LAND": find_event_times_s(RELEASED, "MODE 4/6"),
        "failsafe -> climbing (AUTO.TAKEOFF": find_event_times_s(RELEASED, "MODE 4/2")[1:],
        "engaging -> released (POSCTL": pilot_s[:1],
        "released -> returning (POSCTL": [ordered_s],
        "returning -> engaged": find_event_times_s(RELEASED, "MODE 6/0"),
        "landing -> released (POSCTL": pilot_s[1:],
    }
    for begin, at_s in passages.items():
        assert find_code_times_s(received, begin) == pytest.approx(at_s, abs=0.15), begin
    # The vehicle took the order: it is to the pilot, at 62.4 s, that it refuses OFFBOARD, on his own connection.
    answers_s = find_code_times_s(received, "DO_SET_MODE: ACCEPTED", "command-ack")
    assert ordered_s < answers_s[-1] < ordered_s + 0.5
    assert find_event_times_s(RELEASED, "ACK 176 result 1")[0] > pilot_s[1]
    assert not any("REJECTED" in event.text or "DENIED" in event.text for event in received.memory.of(Event))

    noticed = " ".join(notice.text for notice in received.notices)
    assert all(begin in noticed for begin in passages if "failsafe" in begin or "released (" in begin)
    on_the_page = " ".join(read_page_text(make_page_data(received.memory)).text)
    assert all(begin in on_the_page for begin in passages)


def test_stamps_of_the_recordings_never_go_back() -> None:
    for name in EVERY:
        assert all(a.at_ns <= b.at_ns for a, b in pairwise(packets(name)))
