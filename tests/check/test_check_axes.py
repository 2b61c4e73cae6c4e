"""Must hold: a wrong frame, a wrong unit and a mirrored set-up are caught before anything can arm."""

from __future__ import annotations

import math
import re
import struct

import pytest
from check_rig import CheckResult, HandMotion, S, run_check, transform_cameras
from mavlink_rig import packets, read

from uavctl.check.axes import check_axes, has_vehicle_position
from uavctl.check.check_data import CheckData, Sample
from uavctl.check.findings import ItemState
from uavctl.check.preflight import Preflight
from uavctl.config import load_config
from uavctl.mavlink.connection import make_links
from uavctl.mavlink.messages import Heartbeat

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
ORIGIN = "sim.start_position_m=[0.0,0.0,-0.01]"
AWAY = "sim.start_position_m=[-1.8,1.1,-0.01]"
ALOFT = "sim.start_position_m=[0.0,0.0,-1.0]"
MIRRORED = {
    "north": [[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]],
    "east": [[1.0, 0, 0], [0, -1, 0], [0, 0, 1]],
    "north and east": [[0, 1.0, 0], [1, 0, 0], [0, 0, 1]],
}
DOWN = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]
Y_UP = [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]
FLU = [[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]


def scaled(factor: float) -> list[list[float]]:
    return [[factor, 0, 0], [0, factor, 0], [0, 0, factor]]


def around(at_s: float) -> tuple[float, float, float] | None:
    """Up, north and east by about half a metre each, and back to rest between them."""
    phase, axis = at_s % 2.0, int(at_s // 2.0)
    if axis > 2 or at_s < 0.0:
        return (0.0, 0.0, 0.0)
    push = 0.8 if phase < 1.0 else -0.6
    return [(0.0, 0.0, -push), (push, 0.0, 0.0), (0.0, push, 0.0)][axis]


def moving(
    *wrong: str, autopilot: str, matrix: list[list[float]] | None = None, more: tuple[str, ...] = ()
) -> CheckResult:
    setup = [f"sim.autopilot={autopilot}", ALOFT, *more]
    return run_check(
        setup, wrong, seconds=6.5, airborne=True, setpoints=around, twist=transform_cameras(matrix or scaled(1.0))
    )


@BOTH
def test_a_right_set_up_is_good_once_it_has_moved(autopilot: str) -> None:
    found = moving(autopilot=autopilot)
    assert found.bad_items == []
    assert found["axes"].state is ItemState.GOOD and "moved" in found["axes"].value


@BOTH
@pytest.mark.parametrize("setup", ["frame.convention=enu", "frame.yaw_deg=40", "frame.origin_m=[1.0,-2.0,0.5]"])
def test_a_right_set_up_with_a_frame_of_its_own_is_good(autopilot: str, setup: str) -> None:
    found = moving(autopilot=autopilot, more=(setup,))
    assert found.bad_items == [] and found["axes"].state is ItemState.GOOD


@BOTH
@pytest.mark.parametrize("place", [ORIGIN, AWAY])
def test_a_right_set_up_at_rest_is_not_refused_and_what_cannot_be_seen_is_told(autopilot: str, place: str) -> None:
    found = run_check([f"sim.autopilot={autopilot}", place])
    assert found.bad_items == []
    axes = found["axes"]
    assert axes.state is ItemState.UNDETERMINED and "up is taken for down" in axes.value and axes.hint
    assert ("ENU" in axes.value) == (place is ORIGIN)


@pytest.mark.fault(15)
@BOTH
@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("frame.convention=enu", "ENU and NED are swapped"),
        ("frame.yaw_deg=90", "turned by 90 deg"),
        ("frame.yaw_deg=180", "turned by 180 deg"),
    ],
)
def test_a_wrong_frame_is_named_when_it_moves(autopilot: str, wrong: str, told: str) -> None:
    axes = moving(wrong, autopilot=autopilot)["axes"]
    assert axes.state is ItemState.BAD and told in axes.value and axes.hint


@pytest.mark.fault(15)
@BOTH
@pytest.mark.parametrize("angle_deg", [30, -15])
def test_a_frame_that_is_turned_a_little_is_measured_when_it_moves(autopilot: str, angle_deg: int) -> None:
    axes = moving(f"frame.yaw_deg={angle_deg}", autopilot=autopilot)["axes"]
    assert axes.state is ItemState.BAD
    told = re.search(r"turned by (-?\d+) deg about the vertical", axes.value)
    assert told is not None and abs(int(told[1]) - angle_deg) <= 2


@pytest.mark.slow
@pytest.mark.fault(15)
@BOTH
@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        (scaled(1000.0), "millimetres"),
        (scaled(100.0), "centimetres"),
        (scaled(0.001), "divided by 1000"),
        (MIRRORED["north"], "north is mirrored"),
        (MIRRORED["east"], "east is mirrored"),
        (MIRRORED["north and east"], "north and east are swapped (mirrored)"),
        (DOWN, "up is taken for down (mirrored)"),
        (Y_UP, "y-up"),
        (FLU, "forward, left, up"),
    ],
)
def test_a_wrong_unit_or_a_mirror_is_named_when_it_moves(autopilot: str, matrix: list[list[float]], told: str) -> None:
    found = moving(autopilot=autopilot, matrix=matrix, more=("estimator.max_position_m=1e5",))
    assert found["axes"].state is ItemState.BAD and told in found["axes"].value


@pytest.mark.fault(15)
@BOTH
@pytest.mark.parametrize(
    "wrong", ["frame.convention=enu", "frame.yaw_deg=90", "frame.yaw_deg=180", "frame.yaw_deg=-30"]
)
def test_a_wrong_frame_is_caught_at_rest_off_the_origin(autopilot: str, wrong: str) -> None:
    found = run_check([f"sim.autopilot={autopilot}", AWAY], [wrong])
    assert found["axes"].state is ItemState.BAD


@pytest.mark.fault(15)
@BOTH
@pytest.mark.parametrize("matrix", [scaled(1000.0), scaled(100.0), scaled(0.01), *MIRRORED.values(), Y_UP, FLU])
def test_a_wrong_unit_or_a_mirror_is_caught_at_rest_off_the_origin(autopilot: str, matrix: list[list[float]]) -> None:
    more = "estimator.max_position_m=1e5"
    found = run_check([f"sim.autopilot={autopilot}", AWAY, more], twist=transform_cameras(matrix))
    assert found["axes"].state is ItemState.BAD


@pytest.mark.fault(15)
@BOTH
def test_at_rest_on_the_origin_the_noise_tells_the_unit(autopilot: str) -> None:
    more = "estimator.max_position_m=1e5"
    found = run_check([f"sim.autopilot={autopilot}", ORIGIN, more], twist=transform_cameras(scaled(1000.0)))
    assert found["position noise"].state is ItemState.BAD and "millimetres" in found["position noise"].hint


@pytest.mark.slow
@pytest.mark.fault(15)
@BOTH
@pytest.mark.parametrize(
    ("right", "wrong"), [("frame.yaw_deg=30", "frame.yaw_deg=0"), ("frame.convention=enu", "frame.convention=ned")]
)
@pytest.mark.parametrize("message", ["vision", "mocap", "odometry"])
def test_at_rest_on_the_origin_the_attitude_tells_a_turned_frame(
    autopilot: str, right: str, wrong: str, message: str
) -> None:
    setup = [f"sim.autopilot={autopilot}", ORIGIN, right, f"sim.camera.message={message}"]
    assert run_check(setup)["heading"].state is ItemState.GOOD
    declared = message == "odometry" and "enu" in right  # it says so itself, and is believed
    assert (run_check(setup, [wrong])["heading"].state is ItemState.BAD) == (not declared)


def test_cameras_that_see_another_body_are_caught() -> None:
    setup = ["sim.autopilot=px4", ALOFT, "sim.camera.swapped=[[0.0,99.0]]", "sim.camera.other_body_m=[0.0,0.0,-1.0]"]
    found = run_check(setup, seconds=6.5, airborne=True, setpoints=around)
    assert found["axes"].state is ItemState.BAD and "m for the cameras" in found["axes"].value


def test_a_vehicle_that_counts_from_elsewhere_is_told_apart_by_its_movement() -> None:
    hand = HandMotion("check.same_origin=false", has_estimate=True)
    hand.follow()
    assert hand.is_done()["axes"].state is ItemState.GOOD
    hand = HandMotion("check.same_origin=false", has_estimate=True)
    hand.matrix = DOWN
    hand.follow()
    assert "up is taken for down" in hand.is_done()["axes"].value


@pytest.mark.fault(15)
@pytest.mark.parametrize(
    ("wrong", "want"),
    [((), ItemState.GOOD), (("frame.convention=enu",), ItemState.BAD), (("frame.yaw_deg=-45",), ItemState.BAD)],
)
def test_a_level_attitude_is_meant_if_the_vehicle_takes_its_heading_from_it(
    wrong: tuple[str, ...], want: ItemState
) -> None:
    """At rest on the origin: a source that is level to the north to the last bit, as simulators are."""
    for fuses in (False, True):
        hand = HandMotion(*wrong, has_estimate=True)
        hand.place = [0.0, 0.0, -0.05]
        if fuses:
            (as_float,) = struct.unpack("<f", struct.pack("<i", 11))
            hand.hold(1.2)
            hand.report(hand.vehicle.send("param_value", b"EKF2_EV_CTRL", as_float, 6, 1, 0))
        hand.hold(3.0)
        assert hand.is_done()["heading"].state is (want if fuses else ItemState.UNDETERMINED)


# --- without a position of its own, a hand moves it -----------------------------------------------------------------


@pytest.mark.parametrize("heading_deg", [0.0, 35.0, -120.0])
def test_three_movements_along_the_body_show_every_axis(heading_deg: float) -> None:
    hand = HandMotion(heading_rad=math.radians(heading_deg), move=True)
    hand.follow()
    found = hand.is_done()
    assert found["axes"].state is ItemState.GOOD and found["movements"].state is ItemState.GOOD
    assert found["own position"].state is ItemState.UNDETERMINED
    assert found.bad_items == []


@pytest.mark.fault(15)
@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        (scaled(1000.0), "millimetres"),
        (MIRRORED["east"], "east is mirrored"),
        (MIRRORED["north"], "north is mirrored"),
        (DOWN, "up is taken for down"),
        (FLU, "forward, left, up"),
        (Y_UP, "y-up"),
        ([[0, 1.0, 0], [1, 0, 0], [0, 0, -1]], "ENU and NED"),
        ([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]], "turned by 90 deg"),
    ],
)
def test_movements_name_a_wrong_set_up(matrix: list[list[float]], told: str) -> None:
    hand = HandMotion("estimator.max_position_m=1e5", move=True)
    hand.matrix = matrix
    hand.follow()
    found = hand.is_done()
    assert found["axes"].state is ItemState.BAD and told in found["axes"].value


def test_prompts_that_are_not_followed_fail_the_guided_check() -> None:
    hand = HandMotion(move=True)
    hand.hold(2.0)
    hand.carry(0.0, 0.0, -0.5)
    assert hand.is_done()["movements"].state is ItemState.BAD
    hand.hold(70.0)  # two prompts run out
    found = hand.is_done()
    assert "missing: nose, right" in found["movements"].value


def test_nobody_is_asked_to_touch_an_armed_vehicle() -> None:
    hand = HandMotion(move=True)
    hand.hold(1.2, armed=True)
    hand.hold(4.0, armed=True)
    assert hand.flight.prompt == ""
    assert hand.is_done()["armed"].state is ItemState.NOTE


def test_positions_of_the_vehicle_itself_need_no_frame() -> None:
    setup = ['source.messages=["LOCAL_POSITION_NED"]', "daemon.mocap=udpin://0.0.0.0:14540"]
    found = run_check(setup)
    assert found["axes"].state is ItemState.GOOD and found.bad_items == []


# --- recorded: ArduCopter on its built-in simulated cameras, moving ---------------------------------------------------


def recorded(*wrong: str) -> CheckResult:
    same = "udpin://0.0.0.0:14540"
    overrides = [f"daemon.vehicle={same}", f"daemon.mocap={same}", "link.loss=0.0", *wrong]
    flight, begun_ns, at_ns = Preflight(load_config("room-hahn-stursberg", overrides), make_links, 0), 0, 0
    for stamp_ns, data in packets("arducopter-vicon.tlog"):
        begun_ns = begun_ns or stamp_ns
        at_ns = stamp_ns - begun_ns
        if at_ns > 12.5 * S:
            break
        if data[5] != 255:  # not the client of then
            flight.receive("vehicle", data, at_ns)
    return CheckResult(flight, at_ns)


def test_a_recorded_flight_is_a_right_example() -> None:
    found = recorded()
    assert "axes" in found.items and found["axes"].state is not ItemState.BAD
    assert "moved" in found["axes"].value
    assert found["own position"].state is ItemState.GOOD
    assert found["position rate"].ok and found["position loss"].ok and found["position in the room"].ok


@pytest.mark.fault(15)
@pytest.mark.parametrize("wrong", ["frame.convention=enu", "frame.yaw_deg=90", "frame.yaw_deg=180", "frame.yaw_deg=25"])
def test_the_recorded_flight_in_a_wrong_frame_is_caught(wrong: str) -> None:
    assert recorded(wrong)["axes"].state is ItemState.BAD


def seen_with(autopilot: int, flags: int) -> CheckData:
    """A vehicle at rest whose estimator tells these flags, with positions of its own beside the cameras'."""
    beat = Heartbeat(
        system=1, component=1, vehicle_type=2, autopilot=autopilot, base_mode=0, custom_mode=0, system_status=3
    )
    seen = CheckData(0, heartbeat=beat, estimator=flags)
    for k in range(20):
        at_ns = k * S // 10
        seen.vehicle_positions.append((at_ns, (1.0, 2.0, -0.1)))
        seen.samples.append(Sample(at_ns + 1, at_ns + 2, (1.0, 2.0, -0.1), None, "VISION_POSITION_ESTIMATE"))
    return seen


@pytest.mark.parametrize(
    ("autopilot", "flags", "there"),
    [
        (12, 0x1EF, True),  # a PX4 that rests and fuses positions: it says CONST_POS_MODE all the same
        (12, 0x16F, True),
        (12, 0x0EF, False),  # nothing tells it where it is: it assumes that it stands
        (12, 0x1E7, False),  # no horizontal position
        (3, 0x33F, True),
        (3, 0x1AF, False),  # an ArduPilot in this mode has no position
    ],
)
def test_a_resting_px4_has_a_position_of_its_own(autopilot: int, flags: int, there: bool) -> None:
    seen = seen_with(autopilot, flags)
    assert has_vehicle_position(seen) is there
    own = check_axes(seen, load_config("room-hahn-stursberg"), [])[0]
    assert own.name == "own position" and (own.state is ItemState.GOOD) is there


@pytest.mark.parametrize("seconds", [0.9, 1.9])
def test_a_recorded_px4_at_rest_over_a_lossy_link_has_a_position_and_its_origin_is_compared(seconds: float) -> None:
    """Its flags were 0x1ef, and 0xef from the second second on: for a while nothing told it where it was."""
    same = "udpin://0.0.0.0:14540"
    overrides = [f"daemon.vehicle={same}", f"daemon.mocap={same}", "source.system_id=20"]
    flight, begun_ns, at_ns = Preflight(load_config("room-hahn-stursberg", overrides), make_links, 0), 0, 0
    flags = []
    for stamp_ns, data in packets("px4-rest.tlog"):
        begun_ns = begun_ns or stamp_ns
        at_ns = stamp_ns - begun_ns
        if at_ns > seconds * S:
            break
        if data[5] == 1 and data[7:10] == bytes((230, 0, 0)):
            flags.append(read(data)[0].flags)
        flight.receive("vehicle", data, at_ns)
    assert flags == [0x1EF, 0xEF][: len(flags)] and len(flags) == (1 if seconds < 1.0 else 2)
    own = CheckResult(flight, at_ns)["own position"]
    assert own.state is ItemState.GOOD


def test_another_origin_is_found_beside_a_resting_px4() -> None:
    seen = seen_with(12, 0x1EF)
    seen.vehicle_positions = [(at_ns, (1.0, 0.0, -0.1)) for at_ns, _ in seen.vehicle_positions]
    axes = check_axes(seen, load_config("room-hahn-stursberg"), [])[1]
    assert axes.name == "axes" and axes.state is ItemState.BAD
