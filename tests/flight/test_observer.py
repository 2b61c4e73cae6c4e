"""Wind, hits and false positions held against inertial data, of vehicles that are integrated in small steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from envelope_rig import PARAMETERS, TICK_NS, monitors, seen, update, vec3
from flight_rig import MS, START_NS, sample
from msgspec import structs

from uavctl.arrays import SECOND_NS, Array
from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors import acceleration
from uavctl.flight.monitors.acceleration import AccelerationState, describe_acceleration, describe_push
from uavctl.flight.monitors.engaged import INITIAL, MonitorState, continue_unengaged, shift_monitors
from uavctl.flight.monitors.motion import Motion, PositionObservation
from uavctl.flight.monitors.observation import Observation
from uavctl.flight.monitors.observer import (
    InertialSpan,
    Observer,
    correct_observer,
    extend_path,
    move_along,
    predict_observer,
)
from uavctl.flight.monitors.smoothing import DelayChange
from uavctl.records import Vec3, VehicleMotion

BOUND_MPS2 = PARAMETERS.unexplained_mps2
LAG_S, FINE_S = np.array(PARAMETERS.lag_s), 0.001
NAN3: Vec3 = (math.nan, math.nan, math.nan)


def steady(north: float, east: float = 0.0, down: float = 0.0, *, from_s: float = 3.0) -> Callable[[float], Array]:
    return lambda t: np.array([north, east, down]) * (t >= from_s)


def hit(north: float, *, at_s: float = 3.0) -> Callable[[float], Array]:
    """A push of a tenth of a second."""
    return lambda t: np.array([north, 0.0, 0.0]) * (at_s <= t < at_s + 0.1)


def turned(degrees: float) -> Array:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass
class Flown:
    """What the envelope made of a flight of 9 s: the breach, when, and the truth."""

    code: str | None
    at_s: float
    watching: MonitorState
    pushed_s: list[float]


def fly(
    wind: Callable[[float], Array],
    *,
    drag_1ps: float = 1.0,
    frame: Array | None = None,
    from_s: float = 0.0,
    shown: Callable[[float, Array], Array | None] = lambda t, accel: accel,
    lost: float = 0.3,
    seed: int = 1,
) -> Flown:
    """Setpoints swing to and fro and lean against a steady wind.

    Args:
        wind: Acceleration by the wind at rest at a time [m/s²].
        frame: Of positions from `from_s` on, about where the vehicle is then; None: right.
        shown: Inertial data of a tick, of its time and the true acceleration; None: there are none.
    """
    rng = np.random.default_rng(seed)
    position, velocity, accel = np.zeros(3), np.zeros(3), np.zeros(3)
    pivot: Array | None = None
    watching, sent, pushed_s = INITIAL, np.zeros(3), []
    for n in range(180):
        t, at_ns = n * TICK_NS * 1e-9, START_NS + n * TICK_NS
        if frame is not None and pivot is None and t >= from_s:
            pivot = position.copy()
        place = position if frame is None or pivot is None else pivot + frame @ (position - pivot)
        camera = place + rng.normal(scale=0.003, size=3)
        true = accel - drag_1ps * velocity + wind(t)
        felt = shown(t, true + rng.normal(scale=0.1, size=3))
        ours = Observation(
            at_ns=at_ns,
            samples=(sample(at_ns, at_ns, vec3(camera)),) if rng.random() >= lost else (),
            sent_mps2=vec3(sent),
            position_m=None,
            velocity_mps=NAN3,
            motion=None,
            braking=False,
            inertial_mps2=None if felt is None else vec3(felt),
        )
        watching, breach = update(watching, ours, PARAMETERS)
        if watching.acceleration.is_pushed:
            pushed_s.append(t)
        if breach is not None:
            return Flown(breach.cause, t, watching, pushed_s)
        swing = 1.5 * np.array([math.sin(2.0 * t), math.cos(1.3 * t), 0.0])
        sent = swing - 0.5 * wind(t)
        for _ in range(round(TICK_NS * 1e-9 / FINE_S)):
            velocity = velocity + FINE_S * (accel - drag_1ps * velocity + wind(t))
            position = position + FINE_S * velocity
            accel = accel + FINE_S * (sent - accel) / LAG_S
    return Flown("", math.inf, watching, pushed_s)


WINDS = {
    "north": steady(3.0),
    "south-west": steady(-2.5, -2.5),
    "down": steady(0.0, 0.0, 3.0),
    "gale": steady(8.0),
    "from-the-start": steady(3.0, from_s=0.0),
    "rising": lambda t: np.array([0.6 * t, 0.0, 0.0]),
    "gusts": lambda t: np.array([3.0 + 2.0 * math.sin(4.0 * t), 2.0 * math.sin(2.5 * t), 0.0]),
    "turns-round": lambda t: np.array([3.5 if t < 5.0 else -3.5, 0.0, 0.0]),
}


@pytest.mark.parametrize("drag_1ps", [0.24, pytest.param(1.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("wind", WINDS)
@pytest.mark.fault(71)
def test_a_wind_that_inertial_data_show_is_no_false_position(wind: str, drag_1ps: float) -> None:
    for seed in range(3):
        flown = fly(WINDS[wind], drag_1ps=drag_1ps, seed=seed)
        assert flown.code == ""
    without = fly(WINDS[wind], drag_1ps=drag_1ps, shown=lambda t, accel: None)
    assert without.code == EventCode.RESPONSE


@pytest.mark.fault(71)
def test_a_hit_that_inertial_data_show_is_no_false_position() -> None:
    assert fly(hit(25.0)).code == ""
    assert fly(hit(25.0), shown=lambda t, accel: None).code == EventCode.RESPONSE


@pytest.mark.fault(71)
def test_a_strong_push_is_told_with_its_size_and_a_weak_one_is_not() -> None:
    flown = fly(steady(3.0))
    assert flown.pushed_s and 3.0 < flown.pushed_s[0] < 4.0
    assert fly(steady(0.5)).pushed_s == []
    held = fly(steady(3.0), drag_1ps=0.0)  # without drag all of the push is wind
    np.testing.assert_allclose(held.watching.motion.push_mps2, (3.0, 0.0, 0.0), atol=0.3)


@pytest.mark.parametrize("wind", ["calm", "north", pytest.param("gusts", marks=pytest.mark.slow)])
@pytest.mark.parametrize("from_s", [0.0, 4.0])
@pytest.mark.parametrize(
    "frame",
    [turned(180.0), turned(90.0), np.diag([-1.0, 1.0, 1.0]), 3.0 * np.eye(3), turned(90.0) @ np.diag([1.0, -1.0, 1.0])],
    ids=["turned-180", "turned-90", "mirrored", "larger", "swapped"],
)
@pytest.mark.fault(42)
def test_positions_of_a_wrong_frame_are_found_with_inertial_data_as_without(
    frame: Array, from_s: float, wind: str
) -> None:
    blows = WINDS.get(wind, steady(0.0))
    with_data = fly(blows, frame=frame, from_s=from_s)
    assert with_data.code == EventCode.RESPONSE
    if wind == "calm":
        without = fly(blows, frame=frame, from_s=from_s, shown=lambda t, accel: None)
        assert without.code == EventCode.RESPONSE and with_data.at_s <= without.at_s + 0.3
    else:
        assert from_s < with_data.at_s < from_s + 5.0


@pytest.mark.parametrize(
    "lie",
    [
        lambda t, accel: accel + np.array([1.5, 0.0, 0.0]),
        lambda t, accel: np.zeros(3),
        lambda t, accel: -accel,
        lambda t, accel: accel + np.array([0.0, 0.5 * t, 0.0]),
        lambda t, accel: np.array([math.nan, 0.0, 0.0]) if t > 4.0 else accel,
    ],
    ids=["offset", "frozen", "mirrored", "ramp", "nan"],
)
@pytest.mark.fault(42)
@pytest.mark.fault(59)
def test_inertial_data_that_are_wrong_let_no_flight_go_and_hide_no_wrong_frame(
    lie: Callable[[float, Array], Array],
) -> None:
    assert fly(steady(0.5), shown=lie).code == ""
    found = fly(steady(0.5), shown=lie, frame=turned(180.0), from_s=4.0)
    assert found.code == EventCode.RESPONSE and found.at_s < 9.0


@pytest.mark.fault(71)
def test_a_silence_of_inertial_data_goes_on_with_the_wind_that_they_showed() -> None:
    def silent(t: float, accel: Array) -> Array | None:
        return None if t > 5.0 else accel

    assert fly(steady(3.0), shown=silent).code == ""
    # Nothing else is excused by it: not a frame that turns, nor a wind that comes then.
    assert fly(steady(3.0), shown=silent, frame=turned(180.0), from_s=5.5).code == EventCode.RESPONSE
    assert fly(steady(5.0, from_s=6.0), shown=silent).code == EventCode.RESPONSE


def test_the_way_is_the_double_integral_of_its_spans() -> None:
    """Constant, then none, then another acceleration: closed forms."""
    way = extend_path((), START_NS, (2.0, 0.0, 0.0), 0)
    way = extend_path(way, START_NS + 1 * SECOND_NS, (0.0, 0.0, 0.0), 0)
    way = extend_path(way, START_NS + 2 * SECOND_NS, (0.0, -1.0, 0.0), 0)
    rest = np.zeros((3, 3))
    moved = move_along(way, rest, START_NS, START_NS + 3 * SECOND_NS)
    np.testing.assert_allclose(moved, [(1.0 + 4.0, -0.5, 0.0), (2.0, -1.0, 0.0), (0.0, 0.0, 0.0)])
    begun = np.array([(1.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, 4.0)])
    later = move_along(way, begun, START_NS + 500 * MS, START_NS + 1500 * MS)
    # A second: from rest it gains 1 m/s in the first half and keeps it.
    np.testing.assert_allclose(later, [(1.0 + 0.5 + 0.25 + 0.5, 0.0, 2.0), (1.5, 0.0, 4.0), (0.0, 0.0, 4.0)])


def test_spans_that_ended_before_the_horizon_are_dropped_and_change_nothing() -> None:
    rng = np.random.default_rng(2)
    whole: tuple[InertialSpan, ...] = ()
    short: tuple[InertialSpan, ...] = ()
    for n in range(200):
        at_ns, accel = START_NS + n * TICK_NS, rng.normal(size=3).tolist()
        whole, short = extend_path(whole, at_ns, accel, 0), extend_path(short, at_ns, accel, at_ns - SECOND_NS)
    assert len(whole) == 200 and len(short) == SECOND_NS // TICK_NS + 1
    mean = rng.normal(size=(3, 3))
    since, until = at_ns - SECOND_NS + 7 * MS, at_ns + 20 * MS
    np.testing.assert_array_equal(move_along(whole, mean, since, until), move_along(short, mean, since, until))


@pytest.mark.parametrize(
    ("push_mps2", "sent_mps2", "inertial_mps2", "was_pushed", "is_pushed"),
    [
        (1.0, 3.0, 0.0, False, False),  # half of the bound: inertial data explain no more than chance
        (1.001, 3.0, 0.0, False, True),
        (3.0, 2.0, 0.0, False, False),  # positions show no more than the bound allows
        (3.0, 2.001, 0.0, False, True),
        (3.0, 1.0, 0.0, True, False),  # a push that was there goes on down to half of it
        (3.0, 1.001, 0.0, True, True),
        (3.0, 3.0, 2.0, False, True),
        (3.0, 3.0, 2.001, False, False),  # inertial data leave more than the bound unexplained
        (3.0, 3.0, None, False, False),
        (0.0, 3.0, None, True, True),  # without inertial data, what they last showed holds
    ],
)
def test_inertial_data_explain_a_push(
    push_mps2: float, sent_mps2: float, inertial_mps2: float | None, was_pushed: bool, is_pushed: bool
) -> None:
    def unexplained(accel_mps2: float) -> Array:
        return np.array([np.zeros(3), np.zeros(3), [accel_mps2, 0.0, 0.0]])

    inertial = None if inertial_mps2 is None else unexplained(inertial_mps2)
    observer = Observer(START_NS, unexplained(sent_mps2), np.zeros((3, 3)), np.zeros(3), inertial)
    motion = Motion(push_mps2=(push_mps2, 0.0, 0.0), observer=observer)
    position = PositionObservation(START_NS, np.zeros(3), False, False, motion, observer, seen(START_NS), PARAMETERS)
    state, _ = acceleration.update(AccelerationState(is_pushed=was_pushed), position)
    assert state.is_pushed == is_pushed


@pytest.mark.parametrize(("shown", "is_kept"), [(None, True), ((0.0, 0.0, 0.0), False)])
def test_a_push_stays_as_inertial_data_last_showed_it(shown: Vec3 | None, is_kept: bool) -> None:
    observer = Observer(START_NS, np.zeros((3, 3)), np.eye(3), np.zeros(3), np.zeros((3, 3)))
    path = extend_path((), START_NS - TICK_NS, (0.0, 0.0, 0.0), 0)
    before = monitors(observer=observer, inertial_path=path, push_mps2=(0.5, 0.0, 0.0), tick_ns=START_NS)
    at_ns = START_NS + TICK_NS
    tick = structs.replace(seen(at_ns, sample(at_ns, at_ns)), inertial_mps2=shown)
    after, _ = update(before, tick, PARAMETERS)
    assert (after.motion.push_mps2 == (0.5, 0.0, 0.0)) == is_kept


def test_the_path_of_inertial_data_is_kept_for_three_seconds() -> None:
    watching = INITIAL
    for n in range(100):
        tick = structs.replace(seen(START_NS + n * TICK_NS), inertial_mps2=(0.1 * n, 0.0, 0.0))
        watching, _ = update(watching, tick, PARAMETERS)
    begins = [span.at_ns for span in watching.motion.inertial_path]
    assert begins == [START_NS + n * TICK_NS for n in range(99 - 3 * SECOND_NS // TICK_NS, 99)]


@pytest.mark.parametrize(("silent_ns", "is_silence"), [(SECOND_NS, False), (SECOND_NS + 1, True)])
def test_positions_come_back_after_a_silence_of_more_than_a_second(silent_ns: int, is_silence: bool) -> None:
    observer = Observer(START_NS, np.zeros((3, 3)), np.eye(3), np.zeros(3))
    at_ns = START_NS + silent_ns
    after, _ = update(monitors(observer=observer, tick_ns=START_NS), seen(at_ns, sample(at_ns, at_ns)), PARAMETERS)
    assert after.motion.resumed_ns == (at_ns if is_silence else None)


def test_what_inertial_data_drive_begins_at_the_observer_and_leaves_nothing_unexplained() -> None:
    mean = np.array([[1.0, 2.0, 3.0], [0.5, -0.5, 0.25], [9.0, 9.0, 9.0]])
    observer = Observer(START_NS, mean, np.eye(3), np.zeros(3))
    path = extend_path((), START_NS, (0.0, 0.0, 0.0), 0)
    inertial = predict_observer(observer, (), path, START_NS + SECOND_NS, PARAMETERS.lag_s, 2.0).inertial
    assert inertial is not None
    np.testing.assert_allclose(inertial, [mean[0] + mean[1], mean[1], np.zeros(3)])


@pytest.mark.parametrize(("off_m", "is_clipped"), [(0.0, False), (9.0, True)])
def test_a_position_is_far_off_only_if_it_is_so_of_inertial_data_too(off_m: float, is_clipped: bool) -> None:
    shown = np.zeros((3, 3))
    shown[0, 0] = 9.0 - off_m
    observer = Observer(START_NS, np.zeros((3, 3)), np.eye(3) * 1e-4, np.zeros(3), shown)
    _, found = correct_observer(observer, np.array([9.0, 0.0, 0.0]), 0.02)
    assert found == is_clipped


@pytest.mark.parametrize(
    ("clipped", "is_clean"), [((), True), ((True, False), True), ((False, True), False), ((True,), False)]
)
def test_a_position_is_clean_unless_it_is_itself_far_off(clipped: tuple[bool, ...], is_clean: bool) -> None:
    state = AccelerationState(clipped=clipped)
    assert state.is_clean == is_clean and not state.is_hinted


@pytest.mark.parametrize(
    ("push", "words"),
    [
        ((2.3, 0.0, 0.0), "2.3 m/s² north:"),
        ((-1.0, 1.0, 0.0), "1.4 m/s² south-east:"),
        ((0.0, -2.0, 1.0), "2.0 m/s² west:"),
        ((0.1, 0.0, -2.0), "2.0 m/s² up:"),
        ((-2.0, -1e-9, 0.0), "2.0 m/s² south:"),
        ((1.0, 0.0, 1.0), "1.0 m/s² north:"),
    ],
)
def test_a_push_has_a_size_and_a_direction(push: Vec3, words: str) -> None:
    assert words in describe_acceleration(push, None)


def test_the_watch_of_others_flight_goes_on_from_what_inertial_data_have_shown() -> None:
    flown = fly(steady(1.0)).watching
    assert flown.motion.observer is not None and flown.motion.observer.inertial is not None
    after = continue_unengaged(flown, (0.1, 0.2, 0.0))
    assert after.motion.observer is not None
    np.testing.assert_array_equal(after.motion.observer.mean, flown.motion.observer.inertial)
    assert (
        after.motion.sent == ((flown.motion.observer.at_ns, (0.1, 0.2, 0.0)),)
        and after.motion.tick_ns == flown.motion.tick_ns
    )
    without = fly(steady(0.0), shown=lambda t, accel: None).watching
    assert continue_unengaged(without, (0.0, 0.0, 0.0)) is INITIAL
    assert continue_unengaged(INITIAL, (0.0, 0.0, 0.0)) is INITIAL


def test_a_push_is_described_with_and_without_an_attitude() -> None:
    flown = fly(steady(2.0)).watching
    assert describe_push(flown.motion, None, START_NS) == describe_acceleration(flown.motion.push_mps2, None)
    assert describe_push(INITIAL.motion, None, START_NS) == describe_acceleration(INITIAL.motion.push_mps2, None)
    leaning = VehicleMotion(attitude_rad=(0.0, 1.0, 0.0), attitude_ns=START_NS)
    assert describe_push(flown.motion, leaning, START_NS) != describe_push(flown.motion, None, START_NS)


@pytest.mark.parametrize("has_inertial", [False, True])
def test_positions_that_move_leave_the_observer_as_if_they_had_come_so(has_inertial: bool) -> None:
    """A constant own velocity v and a delay of τ move all positions by τ v."""
    v: Vec3 = (0.5, -0.4, 0.2)
    change = DelayChange(0.2, ((START_NS - SECOND_NS, v, v, ZERO), (START_NS + 9 * SECOND_NS, v, v, ZERO)))
    moved = [0.2 * one for one in v]

    def fly(from_tick: int) -> MonitorState:
        """Positions that come moved from a tick on; those before are moved then."""
        watching = INITIAL
        for tick in range(40):
            at_ns = START_NS + tick * TICK_NS
            if tick == from_tick:
                watching = shift_monitors(watching, change, at_ns)
            place = 0.3 * np.sin(0.1 * tick + np.arange(3)) + (tick >= from_tick) * np.array(moved)
            tick_seen = seen(at_ns, sample(at_ns, position_m=vec3(place)))
            if has_inertial:
                tick_seen = structs.replace(tick_seen, inertial_mps2=(0.3, 0.1, 0.0))
            watching, _ = update(watching, tick_seen, PARAMETERS)
        return watching

    late, at_once = fly(20).motion.observer, fly(0).motion.observer
    assert late is not None and at_once is not None
    assert late.mean == pytest.approx(at_once.mean, abs=1e-12)
    assert (late.inertial is not None) == has_inertial
    assert late.inertial == pytest.approx(at_once.inertial, abs=1e-12)
    assert shift_monitors(INITIAL, change, START_NS).motion.observer is None
