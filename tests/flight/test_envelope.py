"""The envelope alone: its questions against closed forms, and vehicles that fly by `expm` under cameras that lie."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
from envelope_rig import AT_NS, PARAMETERS, TICK_NS, just_less, just_more, look, monitors, motion, seen, update, vec3
from flight_rig import MS, START_NS, drag_lag_generator, sample
from msgspec import structs
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from uavctl.arrays import SECOND_NS, Array
from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors import acceleration
from uavctl.flight.monitors.acceleration import AccelerationState, compute_lean_mps2
from uavctl.flight.monitors.engaged import INITIAL, shift_monitors
from uavctl.flight.monitors.motion import Motion, PositionObservation
from uavctl.flight.monitors.observation import Observation, select_axes
from uavctl.flight.monitors.observer import Observer
from uavctl.flight.monitors.outside import describe_beyond, describe_sideways, is_outside
from uavctl.flight.monitors.smoothing import DelayChange
from uavctl.flight.monitors.verdict import Verdict
from uavctl.records import Vec3, VehicleMotion

# The limits


def at(position: Vec3 | None, velocity: Vec3 = ZERO, *, since_ns: int | None = AT_NS - 100 * MS) -> Verdict | None:
    """The answer to an estimate that has been outside since then."""
    ours = structs.replace(seen(AT_NS), position_m=position, velocity_mps=velocity)
    watching, breach = update(monitors(outside_ns=since_ns), ours, PARAMETERS)
    assert is_outside(ours, PARAMETERS) == (watching.outside.since_ns is not None)
    assert breach is None or (breach.cause == EventCode.OUTSIDE and watching.outside.since_ns == since_ns)
    return breach


def on_axis(axis: int, value: float, others: Vec3 = (0.0, 0.0, -2.0)) -> Vec3:
    values = list(others)
    values[axis] = value
    return vec3(values)


@pytest.mark.parametrize(("axis", "words"), [(0, ("south", "north")), (1, ("west", "east")), (2, ("upper", "lower"))])
@pytest.mark.fault(41)
def test_an_estimate_beyond_a_limit_and_its_margin_is_outside_unless_it_comes_back(
    axis: int, words: tuple[str, str]
) -> None:
    assert at(None) is None
    limits = ((PARAMETERS.lower_m[axis], -1.0), (PARAMETERS.upper_m[axis], 1.0))
    for word, (limit, outward) in zip(words, limits, strict=True):
        edge = limit + outward * PARAMETERS.outside_m[axis]
        assert at(on_axis(axis, edge)) is None
        breach = at(on_axis(axis, edge + outward * 1e-9))
        assert breach is not None and f"beyond the {word} limit" in breach.text
        for speed, comes_back in ((1.0, True), (0.3, True), (just_less(0.3), False)):
            speeds = on_axis(axis, -outward * speed, ZERO)
            assert (at(on_axis(axis, edge + outward), speeds) is None) == comes_back


@pytest.mark.parametrize(("axis", "words"), [(0, ("south", "north")), (1, ("west", "east")), (2, ("upper", "lower"))])
@pytest.mark.fault(41)
def test_an_estimate_that_leaves_faster_than_it_can_brake_is_outside_before_it_is(
    axis: int, words: tuple[str, str]
) -> None:
    """It flies on for 0.3 s, then brakes at the limit: v 0.3 + v² / 2b."""
    brake, margin = PARAMETERS.brake_mps2[axis], PARAMETERS.outside_m[axis]
    limits = ((PARAMETERS.lower_m[axis], -1.0), (PARAMETERS.upper_m[axis], 1.0))
    for word, (limit, outward) in zip(words, limits, strict=True):
        for room_m in (-0.4, 0.0, 0.7):  # to the limit; then the speed at which it comes to rest at the margin
            left = room_m + margin
            speed = -0.3 * brake + math.sqrt((0.3 * brake) ** 2 + 2.0 * brake * left)
            position = on_axis(axis, limit - outward * room_m)
            assert at(position, on_axis(axis, outward * (speed - 1e-9), ZERO)) is None
            breach = at(position, on_axis(axis, outward * (speed + 1e-9), ZERO))
            assert breach is not None and f"the {word} limit" in breach.text and "stop" in breach.text
        rests = on_axis(axis, limit + outward * margin)
        assert at(rests, ZERO) is None
        assert at(rests, on_axis(axis, outward * 1e-6, ZERO)) is not None
        assert at(rests, on_axis(axis, -outward * 2.0, ZERO)) is None


def test_an_estimate_that_comes_to_rest_at_the_margin_is_not_outside() -> None:
    parameters = replace(PARAMETERS, outside_m=(0.3 + 1.0 / (2.0 * 2.0), 9.0, 9.0))
    for speed, outside in ((1.0, False), (1.0 + 1e-9, True)):
        ours = structs.replace(seen(AT_NS), position_m=(3.0, 0.0, -2.0), velocity_mps=(speed, 0.0, 0.0))
        assert is_outside(ours, parameters) == outside


@pytest.mark.parametrize(("std_mps", "needs_both"), [(0.3, False), (just_more(0.3), True)])
@pytest.mark.fault(41)
def test_an_uncertain_velocity_is_outside_only_by_the_own_one_too(std_mps: float, *, needs_both: bool) -> None:
    """After a silence the vehicle's own velocity decides, where it is known; a place beyond the margin needs none."""
    observer = Observer(at_ns=AT_NS, mean=np.zeros((3, 3)), cov=np.diag([0.0, std_mps**2, 0.0]), accel_mps2=np.zeros(3))
    leaves, beyond, rests, old = (2.5, 0.0, -2.0), (4.0, 0.0, -2.0), motion(ZERO, AT_NS), motion(ZERO, 0)
    fast = motion((3.0, 0.0, 0.0), AT_NS)
    for position, speed, own, is_found in (
        (leaves, 3.0, None, True),
        (leaves, 3.0, old, True),
        (leaves, 3.0, fast, True),
        (leaves, 3.0, rests, not needs_both),
        (leaves, 0.0, fast, False),
        (beyond, 0.0, rests, True),
    ):
        ours = seen(AT_NS, vehicle_motion=own)
        ours = structs.replace(ours, position_m=position, velocity_mps=(speed, 0.0, 0.0))
        known = monitors(observer=observer, outside_ns=AT_NS - 100 * MS)
        assert (update(known, ours, PARAMETERS)[1] is not None) == is_found


@pytest.mark.parametrize("speed", [-0.31, -0.3, -just_less(0.3), 9.0])
@pytest.mark.parametrize("beyond_m", [-1.0, 0.0, 1e-9, 2.0])
def test_being_beyond_a_limit_is_without_what_braking_needs(beyond_m: float, speed: float) -> None:
    north = PARAMETERS.upper_m[0] + PARAMETERS.outside_m[0] + beyond_m
    ours = structs.replace(seen(AT_NS), position_m=(north, 0.0, -2.0), velocity_mps=(speed, 0.0, 0.0))
    assert bool(describe_beyond(ours, PARAMETERS)) == (beyond_m > 0.0 and speed > -0.3)


@pytest.mark.parametrize(("speed", "says"), [(0.05, False), (just_more(0.05), True)])
def test_the_cause_says_that_it_could_not_stop_unless_it_stands(speed: float, *, says: bool) -> None:
    ours = structs.replace(seen(AT_NS), position_m=(9.0, 0.0, -2.0), velocity_mps=(speed, 0.0, 0.0))
    assert ("stop" in describe_beyond(ours, PARAMETERS)) == says


@pytest.mark.fault(99)
@pytest.mark.parametrize("by_itself", [True, False])
def test_a_climb_that_is_not_upright_is_found_by_either_velocity(by_itself: bool) -> None:
    """By the vehicle's own velocity where it is known, else by the estimate; without both nothing is known."""
    for speed, is_found in ((0.6, False), (just_more(0.6), True)):
        moved, other = (0.0, speed, -9.0), (9.0, 0.0, 0.0)
        ours = seen(AT_NS, vehicle_motion=motion(moved, AT_NS) if by_itself else None)
        known = structs.replace(ours, position_m=ZERO, velocity_mps=other if by_itself else moved)
        assert bool(describe_sideways(known)) == is_found
        assert bool(describe_sideways(ours)) == (is_found and by_itself)


@pytest.mark.fault(100)
def test_right_after_a_change_of_the_delay_only_a_place_beyond_the_margin_is_outside() -> None:
    """The plan has just learned how near the limit is: let go, a vehicle flies on further than with its brake."""
    for ago_ns, position, outside in (
        (SECOND_NS, (2.9, 0.0, -2.0), False),
        (SECOND_NS + 1, (2.9, 0.0, -2.0), True),
        (SECOND_NS, (4.0, 0.0, -2.0), True),
    ):
        ours = structs.replace(seen(AT_NS), position_m=position, velocity_mps=(2.0, 0.0, 0.0))
        watching = monitors(outside_ns=AT_NS - 100 * MS)
        shifted = shift_monitors(watching, DelayChange(0.1, ()), AT_NS - ago_ns)
        assert (update(shifted, ours, PARAMETERS)[1] is not None) == outside
        assert update(watching, ours, PARAMETERS)[1] is not None


def test_being_outside_has_to_persist() -> None:
    out: Vec3 = (4.0, 0.0, -2.0)
    assert at(out, since_ns=None) is None
    assert at(out, since_ns=AT_NS - 100 * MS + 1) is None
    watching = INITIAL
    since = []
    for n, position in enumerate([out, out, (0.0, 0.0, -2.0), out, out, out, out]):
        ours = structs.replace(seen(START_NS + n * TICK_NS), position_m=position, velocity_mps=ZERO)
        watching, breach = update(watching, ours, PARAMETERS)
        since.append(None if watching.outside.since_ns is None else (watching.outside.since_ns - START_NS) // TICK_NS)
        assert (breach is not None) == (n >= 5)
    assert since == [0, 0, None, 3, 3, 3, 3]


def test_an_estimate_that_is_no_number_is_outside() -> None:
    for axis in range(3):
        assert at(on_axis(axis, math.nan)) is not None
        assert at((0.0, 0.0, -2.0), on_axis(axis, math.inf, ZERO)) is not None
    assert at((0.0, 0.0, -2.0), (1e200, 0.0, 0.0)) is not None


# Braking


def braked(speeds: Iterator[tuple[int, float | None]], *, ends: Sequence[int] = ()) -> list[tuple[int, Verdict]]:
    """What comes of own velocities (north), each at a time [ms]; the fallback does not brake at those of `ends`."""
    watching, found = INITIAL, []
    for at_ms, speed in speeds:
        at_ns = START_NS + at_ms * MS
        own = None if speed is None else motion((0.6 * speed, 0.0, -0.8 * speed), at_ns)
        ours = structs.replace(seen(at_ns, vehicle_motion=own), braking=at_ms not in ends)
        watching, breach = update(watching, ours, PARAMETERS)
        if breach is not None:
            found.append((at_ms, breach))
    return found


@pytest.mark.parametrize(
    ("speeds", "ends", "found"),
    [
        ([(0, 2.0), (500, 2.0), (999, 2.0), (1000, 2.0)], (), [1000]),
        ([(0, 2.0), (1000, 1.89)], (), []),  # 0.8 of it and 0.3
        ([(0, 2.0), (1000, 1.91)], (), [1000]),
        ([(0, 0.0), (1000, 0.29)], (), []),
        ([(0, 0.0), (1000, 0.31)], (), [1000]),
        (
            [(0, 2.0), (300, 1.6), (600, 1.2), (900, 0.8), (1200, 0.9), (1300, 1.3), (1400, 1.6), (1500, 1.92)],
            (),
            [1500],
        ),
        ([(0, 2.0), (500, 2.0), (999, 2.0), (1000, 2.0)], (500,), [1000]),  # it goes on after a short hold
        ([(0, 2.0), (500, 2.0), (1499, 2.0), (1500, 2.0), (2499, 2.0), (2500, 2.0)], (500,), [1499, 1500, 2499, 2500]),
        ([(0, 2.0), (500, 2.0), (699, 2.0), (1550, 2.0)], (500, 699), [1550]),
        ([(0, 2.0), (500, 1.5), (550, 1.5), (1600, 1.5), (1650, 2.0)], (500, 1600), [1650]),  # two short holds
        ([(0, 2.0), (500, 2.0), (700, 2.0), (750, 2.0), (1749, 2.0), (1750, 2.0)], (500, 700), [1750]),
        ([(0, None), (400, 2.0), (1000, 2.0), (1400, 2.0)], (), [1400]),  # since it is known
        ([(0, 2.0), (500, None), (1000, 2.0)], (), [1000]),  # a gap does not begin it anew
        ([(0, 2.0), (1000, None)], (), []),
    ],
)
@pytest.mark.fault(43)
def test_braking_has_to_show(speeds: list[tuple[int, float | None]], ends: tuple[int, ...], found: list[int]) -> None:
    breaches = braked(iter(speeds), ends=ends)
    assert [at_ms for at_ms, _ in breaches] == found
    assert {breach.cause for _, breach in breaches} <= {EventCode.BRAKING}


@pytest.mark.parametrize(("slows", "found"), [(True, []), (False, [1700])])
@pytest.mark.fault(43)
def test_braking_counts_from_when_the_setpoint_points_against_the_velocity(slows: bool, found: list[int]) -> None:
    """The setpoint of a plan that accelerates is slew-limited: the vehicle goes on gaining speed while it turns."""
    watching, breaches = INITIAL, []
    for now_ms in range(0, 1750, 50):
        at_ns, turned_ms = START_NS + now_ms * MS, now_ms - 700
        speed = 1.4 + 0.001 * min(now_ms, 700) - (0.001 if slows else 0.00001) * max(turned_ms, 0)
        sent = (0.5, 0.0, 0.0) if turned_ms < 0 else (-2.0, 0.0, 0.0)
        ours = seen(at_ns, sent=sent, vehicle_motion=motion((speed, 0.0, 0.0), at_ns))
        watching, breach = update(watching, structs.replace(ours, braking=True), PARAMETERS)
        breaches += [] if breach is None else [now_ms]
    assert breaches == found


@pytest.mark.parametrize(("for_ns", "breached"), [(10**9 - 1, False), (10**9, True), (10**9 + 1, True)])
def test_braking_has_a_second_to_show(for_ns: int, breached: bool) -> None:
    for north, fast in ((0.3, False), (just_more(0.3), True)):
        ours = structs.replace(seen(AT_NS, vehicle_motion=motion((north, 0.0, 0.0), AT_NS)), braking=True)
        _, breach = update(monitors(braking=(AT_NS - for_ns, 0.0)), ours, PARAMETERS)
        assert (breach is not None) == (breached and fast)


@pytest.mark.parametrize(("silent", "found"), [(False, [1500]), (True, [])])
@pytest.mark.fault(43)
def test_positions_that_come_back_correct_its_own_velocity_and_begin_braking_anew(
    silent: bool, found: list[int]
) -> None:
    parameters = replace(PARAMETERS, disagreement_mps=100.0, unexplained_mps2=100.0)
    watching, breaches = INITIAL, []
    for now_ms in range(0, 2600, 50):
        at_ns = START_NS + now_ms * MS
        taken = () if silent and 0 < now_ms < 1500 else (sample(at_ns, at_ns, ZERO),)
        own = motion((0.1 if now_ms < 1500 else 0.9, 0.0, 0.0), at_ns)
        watching, breach = update(
            watching, structs.replace(seen(at_ns, *taken, vehicle_motion=own), braking=True), parameters
        )
        if breach is not None:
            assert breach.cause == EventCode.BRAKING
            breaches.append(now_ms)
    assert breaches[:1] == found


# Attitude


@pytest.mark.parametrize("seed", range(10))
def test_the_lean_is_what_a_thrust_that_carries_the_vehicle_does_along_the_floor(seed: int) -> None:
    roll, pitch, yaw = np.random.default_rng(seed).uniform((-1.0, -1.0, -3.1), (1.0, 1.0, 3.1))
    thrust = Rotation.from_euler("ZYX", (yaw, pitch, roll)).apply([0.0, 0.0, -1.0])
    words = VehicleMotion(attitude_rad=(roll, pitch, yaw), attitude_ns=AT_NS)
    lean = compute_lean_mps2(words, AT_NS)
    assert lean == pytest.approx(tuple(9.81 * thrust[:2] / -thrust[2]))


@pytest.mark.parametrize(
    ("words", "known"),
    [
        (VehicleMotion(), False),
        (VehicleMotion(attitude_rad=ZERO), False),
        (VehicleMotion(attitude_ns=AT_NS), False),
        (VehicleMotion(attitude_rad=ZERO, attitude_ns=AT_NS - 300 * MS), True),
        (VehicleMotion(attitude_rad=ZERO, attitude_ns=AT_NS - 300 * MS - 1), False),
        (VehicleMotion(attitude_rad=(math.acos(0.1) - 1e-6, 0.0, 0.0), attitude_ns=AT_NS), True),
        (VehicleMotion(attitude_rad=(math.acos(0.1) + 1e-6, 0.0, 0.0), attitude_ns=AT_NS), False),
        (VehicleMotion(attitude_rad=(0.0, 2.0, 0.0), attitude_ns=AT_NS), False),
        (VehicleMotion(attitude_rad=(2.0, 2.0, 0.0), attitude_ns=AT_NS), True),  # the same as none of them, turned
    ],
)
def test_an_attitude_that_is_old_or_on_its_side_says_nothing(words: VehicleMotion, known: bool) -> None:
    assert (compute_lean_mps2(words, AT_NS) is not None) == known


def test_an_attitude_that_is_just_not_on_its_side_says_something() -> None:
    pitches = np.linspace(0.0, 0.5, 1001).tolist()
    leans = ((math.acos(0.1 / math.cos(pitch)), pitch, 0.0) for pitch in pitches)
    lean = next(one for one in leans if math.cos(one[0]) * math.cos(one[1]) == 0.1)
    assert compute_lean_mps2(VehicleMotion(attitude_rad=lean, attitude_ns=AT_NS), AT_NS) is not None


AS_COMMANDED, OTHERWISE = "; the vehicle tilts as commanded", "; the vehicle does not tilt as commanded"


@pytest.mark.parametrize(
    ("accel", "level", "words"),
    [
        ((2.0, 0.0, 0.0), True, AS_COMMANDED),  # exactly half of the 4 m/s² that nobody asked for
        ((just_more(2.0), 0.0, 0.0), True, OTHERWISE),
        ((0.0, 1.5, -1.5), False, AS_COMMANDED),
        ((0.0, -1.5, 1.5), False, OTHERWISE),
    ],
)
def test_the_lean_is_held_against_what_was_told_along_the_floor(accel: Vec3, level: bool, words: str) -> None:
    """It is level, or leans 1.5 m/s² east."""
    roll = 0.0 if level else math.atan(1.5 / 9.81)
    own = VehicleMotion(attitude_rad=(roll, 0.0, 0.0), attitude_ns=AT_NS)
    _, breach = look((0.0, 0.0, 4.0), accel=accel, vehicle_motion=own)
    assert breach is not None and breach.text.endswith(words)


@pytest.mark.parametrize(
    ("unexplained", "lean", "words"),
    [
        ((3.0, 4.0, 0.0), (1.0, 0.0), AS_COMMANDED),
        ((3.0, 4.0, 0.0), (1.0, 2.49), AS_COMMANDED),
        ((3.0, 4.0, 0.0), (1.0, -2.51), OTHERWISE),
        ((3.0, 4.0, 0.0), (3.49, 0.0), AS_COMMANDED),
        ((3.0, 4.0, 0.0), (-1.51, 0.0), OTHERWISE),
        ((0.0, 0.0, 4.0), (1.0, 1.99), AS_COMMANDED),  # a climb that nobody asked for is no lean
        ((0.0, 0.0, 4.0), (1.0, 2.01), OTHERWISE),
        ((3.0, 4.0, 0.0), None, ""),
    ],
)
def test_a_breach_tells_whether_the_vehicle_leans_as_it_was_told(
    unexplained: Vec3, lean: tuple[float, float] | None, words: str
) -> None:
    """It was told 1 m/s² north, and the observer knows."""
    own = None
    if lean is not None:  # a lean forwards is a negative pitch
        pitch = -math.atan(lean[0] / 9.81)
        own = VehicleMotion(attitude_rad=(math.atan(lean[1] / 9.81 * math.cos(pitch)), pitch, 0.0), attitude_ns=AT_NS)
    _, breach = look(unexplained, accel=(1.0, 0.0, 0.0), vehicle_motion=own)
    assert breach is not None and breach.cause == EventCode.RESPONSE
    assert breach.text.endswith(words) and ("commanded" in breach.text) == bool(words)


# What there is not


def test_axes_that_the_plant_has_not_are_not_looked_at() -> None:
    rng = np.random.default_rng(5)
    for axis in range(3):
        parameters = replace(PARAMETERS, axes=tuple(other == axis for other in range(3)))
        only = np.eye(3)[axis]
        one = two = INITIAL
        for n in range(30):
            at_ns = START_NS + n * TICK_NS
            position, own, sent = (rng.normal(scale=0.01, size=3) for _ in range(3))
            wild = np.where(only > 0, 0.0, rng.normal(scale=50.0, size=3))
            velocity = None if n else own
            estimated = np.where(only > 0, position, math.nan)

            def tick(other: Array, at_ns: int = at_ns) -> Observation:
                return Observation(
                    at_ns=at_ns,
                    samples=(
                        sample(
                            at_ns,
                            position_m=vec3(position * only + other),  # noqa: B023
                            velocity_mps=None if velocity is None else vec3(velocity * only + other),  # noqa: B023
                        ),
                    ),
                    sent_mps2=vec3(sent * only + other),  # noqa: B023
                    position_m=vec3(estimated) if axis < 2 else None,  # noqa: B023
                    velocity_mps=vec3(estimated),  # noqa: B023
                    motion=motion(vec3(own * only + other), at_ns),  # noqa: B023
                    braking=True,
                    inertial_mps2=vec3(sent * only + other),  # noqa: B023
                )

            one, breach = update(one, tick(wild), parameters)
            assert breach is None
            two, _ = update(two, tick(np.zeros(3)), parameters)
            assert repr(one) == repr(two)
        assert one.velocity.apart_mps is not None


def test_what_did_not_come_is_not_made_up_in_axes_that_the_plant_has_not() -> None:
    parameters = replace(PARAMETERS, axes=(True, False, False))
    silent = seen(AT_NS, sample(AT_NS, AT_NS, (1.0, 2.0, 3.0)))
    for words in (None, VehicleMotion(), VehicleMotion(attitude_rad=ZERO, attitude_ns=AT_NS)):
        selected = select_axes(structs.replace(silent, motion=words), parameters)
        assert selected.motion == words and selected.inertial_mps2 is None
        assert [(one.position_m, one.velocity_mps) for one in selected.samples] == [((1.0, 0.0, 0.0), None)]


# Vehicles that fly as they are told, and frames that do not fit


Camera = Callable[[float, Array], Array]  # time, true position -> what it says


def fly(
    camera: Camera, *, drag_1ps: float = 0.3, own: bool = False, accel_mps2: float = 2.0, stall: range = range(0)
) -> tuple[float, float, EventCode | None] | None:
    """A vehicle is sent to and fro, by `expm`, for 10 s: (time, largest true distance so far, code) of a breach."""
    rng = np.random.default_rng(2)
    parameters = replace(PARAMETERS, unexplained_mps2=1.5, lag_s=(0.25, 0.25, 0.25), lower_m=(-99.0,) * 3)
    step = expm(drag_lag_generator(drag_1ps, 0.25) * TICK_NS * 1e-9)
    x, watching, sent, far_m = np.zeros((5, 3)), INITIAL, ZERO, 0.0
    for n in range(200):
        t, at_ns = n * 0.05, START_NS + n * TICK_NS
        far_m = max(far_m, float(np.linalg.norm(x[0])))
        if n not in stall:
            said = camera(t, x[0]) + rng.normal(scale=0.003, size=3)
            words = motion(vec3(x[1] + rng.normal(scale=0.02, size=3)), at_ns) if own else None
            watching, breach = update(
                watching, seen(at_ns, sample(at_ns, None, vec3(said)), sent=sent, vehicle_motion=words), parameters
            )
            if breach is not None:
                return t, far_m, breach.cause
            north = accel_mps2 if int(t / 0.8 + 0.5) % 2 else -accel_mps2
            sent = (north, -0.5 * north, -0.3 * north)
        x[4] = sent
        x = step @ x
    assert far_m > 0.2
    return None


def turned(degrees: float) -> Camera:
    matrix = Rotation.from_euler("Z", degrees, degrees=True).as_matrix()
    return lambda t, truth: matrix @ truth


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("drag_1ps", [0.0, 0.3, 1.0])
def test_a_vehicle_that_flies_as_it_is_told_is_quiet(drag_1ps: float, own: bool) -> None:
    assert fly(lambda t, truth: truth, drag_1ps=drag_1ps, own=own) is None
    assert fly(turned(4.0), drag_1ps=drag_1ps, own=own) is None  # nobody hangs up cameras better


def test_a_vehicle_that_flew_on_while_we_missed_ticks_is_no_contradiction() -> None:
    for begins in range(40, 80, 5):
        assert fly(lambda t, truth: truth, own=True, stall=range(begins, begins + 13)) is None


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize(
    "camera",
    [
        turned(90.0),
        turned(-90.0),
        turned(180.0),
        lambda t, truth: truth * [-1.0, 1.0, 1.0],
        lambda t, truth: truth[[1, 0, 2]] * [1.0, 1.0, -1.0],  # east, north, up
        lambda t, truth: truth * 3.281,
        lambda t, truth: truth * 1000.0,
        lambda t, truth: truth * 0.0,  # the marker is on the floor
        lambda t, truth: truth * [1.0, 1.0, 1.0] if t < 2.0 else np.array([0.0, 0.0, 9.81 / 2 * (t - 2.0) ** 2]),
    ],
)
@pytest.mark.fault(42)
def test_frames_that_do_not_fit_and_loose_markers_are_found_before_the_vehicle_is_far(
    camera: Camera, own: bool
) -> None:
    found = fly(camera, own=own)
    assert found is not None
    assert found[1] < 1.0
    assert found[2] in {EventCode.RESPONSE, EventCode.VELOCITY, EventCode.SCATTER}


@pytest.mark.fault(42)
def test_positions_that_leap_about_are_found() -> None:
    rng = np.random.default_rng(9)
    found = fly(lambda t, truth: truth + rng.normal(scale=0.7, size=3) * (t > 1.0))
    assert found is not None and found[0] < 1.5


@pytest.mark.parametrize(("std_m", "sigma"), [(0.02, 1.5), (just_more(0.02), 4.0), (0.1, 4.0), (just_more(0.1), 1.5)])
def test_where_positions_are_noisy_an_acceleration_counts_from_more_standard_deviations_on(
    std_m: float, sigma: float
) -> None:
    """Its standard deviation is 1 m/s², and so is its bound."""
    parameters = replace(PARAMETERS, unexplained_mps2=1.0)
    for size_mps2, counts in ((sigma, False), (just_more(sigma), True)):
        observer = Observer(AT_NS, np.array([ZERO, ZERO, (0.0, -size_mps2, 0.0)]), np.eye(3), np.zeros(3))
        position = PositionObservation(
            AT_NS, np.zeros(3), False, False, Motion(observer=observer), observer, seen(AT_NS), parameters, std_m
        )
        state, _ = acceleration.update(AccelerationState(), position)
        assert state.over_ns == (AT_NS if counts else None)
