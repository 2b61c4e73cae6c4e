"""The comparison of the vehicle's own velocity with its inertial data: which of them is wrong, and when that ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from envelope_rig import PARAMETERS, just_more, motion, seen
from flight_rig import MS, START_NS
from msgspec import structs

from uavctl.flight.limits import ZERO
from uavctl.flight.monitors.motion import Motion, TickObservation, update_motion
from uavctl.flight.monitors.observer import InertialSpan, Observer
from uavctl.flight.monitors.velocity import CORRECTS_NS, VelocityState
from uavctl.flight.monitors.velocity_change import REPEATS_NS, VelocityChangeState, update
from uavctl.records import Vec3

TICK_NS = 50 * MS
ACCEL: Vec3 = (-1.5, 0.0, 0.0)
SPEED_MPS = 4.0  # at first
LAG_S = 1.5  # from then on the model's lag has no effect any more
NO_POSITIONS, AT_FIRST, INITIAL = VelocityState(), Motion(), VelocityChangeState()


def north(value: float) -> Vec3:
    return (value, 0.0, 0.0)


def fly(
    ticks: int,
    own: Callable[[float, float], float],
    inertial: Callable[[float, float], float | None],
    *,
    velocity: VelocityState = NO_POSITIONS,
    motion_state: Motion = AT_FIRST,
    state: VelocityChangeState = INITIAL,
) -> list[VelocityChangeState]:
    """Brake with ACCEL; `own` and `inertial` get the time and the true value, and return what is sent."""
    states = []
    for tick in range(ticks):
        at_ns, s = START_NS + tick * TICK_NS, tick * TICK_NS * 1e-9
        shown = inertial(s, ACCEL[0])
        observation = structs.replace(
            seen(at_ns, sent=ACCEL, vehicle_motion=motion(north(own(s, SPEED_MPS + s * ACCEL[0])), at_ns)),
            inertial_mps2=None if shown is None else north(shown),
        )
        motion_state = update_motion(motion_state, observation, PARAMETERS)
        state = update(state, TickObservation(observation, motion_state, PARAMETERS), velocity)
        states.append(state)
    return states


def true(_s: float, value: float) -> float:
    return value


def is_found(state: VelocityChangeState) -> tuple[bool, bool]:
    return state.velocity_wrong_ns is not None, state.inertial_wrong_ns is not None


def test_true_ones_agree_and_support_the_velocity() -> None:
    states = fly(40, true, true)
    assert {is_found(state) for state in states} == {(False, False)}
    last_ns = START_NS + 39 * TICK_NS
    assert states[-1].supports_velocity(last_ns) and not states[-1].supports_velocity(last_ns + 301 * MS)


@pytest.mark.fault(95)
@pytest.mark.parametrize(
    ("own", "supports"),
    [
        (true, True),
        (lambda s, v: v + 0.4 * s, True),  # wind
        (lambda s, v: v + 1.0 * s, False),
        (lambda _s, v: 0.3 * v, False),
        (lambda _s, v: -v, False),
    ],
)
def test_without_inertial_data_setpoints_support_the_velocity(
    own: Callable[[float, float], float], supports: bool
) -> None:
    states = fly(80, own, lambda _s, _a: None)
    assert states[-1].supports_velocity(START_NS + 79 * TICK_NS) == supports
    assert {is_found(state) for state in states} == {(False, False)}
    # Over less than half a second they say nothing, nor of an own velocity that was found wrong.
    assert all(state.agreed_ns is None for state in states[:10])
    wrong = VelocityChangeState(velocity_wrong_ns=START_NS)
    assert all(state.agreed_ns is None for state in fly(50, own, lambda _s, _a: None, state=wrong))


@pytest.mark.fault(94)
@pytest.mark.parametrize("begin_s", [LAG_S, LAG_S + 0.4])
@pytest.mark.parametrize(
    ("lie", "within_s"),
    [
        (lambda _s, v: -v, 0.15),
        (lambda _s, v: 0.3 * v, 0.15),
        (lambda _s, v: v + 0.9, 0.15),
        (lambda s, v: v + 1.5 * (s - LAG_S), 0.7),  # as of a velocity that does not change any more
    ],
)
def test_a_wrong_velocity_is_found(lie: Callable[[float, float], float], within_s: float, begin_s: float) -> None:
    states = fly(60, lambda s, v: lie(s, v) if s >= begin_s else v, true)
    found = [round(tick * 0.05, 2) for tick, state in enumerate(states) if is_found(state) == (True, False)]
    assert found and begin_s <= found[0] <= begin_s + within_s
    assert is_found(states[-1]) == (True, False) and not states[-1].supports_velocity(START_NS + 59 * TICK_NS)


@pytest.mark.fault(94)
@pytest.mark.parametrize("lie", [lambda a: -a, lambda a: 0.3 * a, lambda _a: 0.0])
def test_wrong_inertial_data_are_found(lie: Callable[[float], float]) -> None:
    states = fly(60, true, lambda s, a: lie(a) if s >= LAG_S else a)
    assert is_found(states[-1]) == (False, True)


@pytest.mark.fault(94)
def test_both_are_wrong_where_neither_changes_as_gusts_allow() -> None:
    states = fly(60, lambda s, v: v + 8.0 if s >= LAG_S else v, lambda s, a: -50.0 if s >= LAG_S else a)
    assert is_found(states[-1]) == (True, True)


@pytest.mark.fault(94)
@pytest.mark.parametrize(("turns", "both"), [(False, False), (True, True)])
def test_a_velocity_that_turns_wrong_is_found_beside_wrong_inertial_data(turns: bool, both: bool) -> None:
    def own(s: float, v: float) -> float:
        return v + 5.0 * max(s - LAG_S - 0.5, 0.0) if turns else v

    states = fly(70, own, lambda s, a: -a if s >= LAG_S else a)
    assert is_found(states[round((LAG_S + 0.5) / 0.05)]) == (False, True)
    assert is_found(states[-1]) == (both, True)


@pytest.mark.fault(94)
def test_a_velocity_that_repeats_is_found_without_inertial_data_but_not_at_rest() -> None:
    frozen = fly(40, lambda _s, _v: 1.25, lambda _s, _a: None)
    assert is_found(frozen[-1]) == (True, False)
    moving = fly(40, true, lambda _s, _a: None)
    assert is_found(moving[-1]) == (False, False)


@pytest.mark.fault(94)
@pytest.mark.parametrize("inertial_wrong_ns", [None, START_NS])
@pytest.mark.parametrize(("beyond_mps", "is_wrong"), [(-0.05, False), (0.05, True)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_velocity_that_leaps_is_found_in_that_message_without_inertial_data(
    sign: float, beyond_mps: float, is_wrong: bool, inertial_wrong_ns: int | None
) -> None:
    bound_mps = 0.255 + 0.05 * (6.0 if inertial_wrong_ns is None else 3.0)
    leap_mps, state = sign * (bound_mps + beyond_mps), VelocityChangeState(inertial_wrong_ns=inertial_wrong_ns)
    states = fly(40, lambda s, v: v + (leap_mps if s >= LAG_S else 0.0), lambda _s, _a: None, state=state)
    found = [tick for tick, state in enumerate(states) if state.velocity_wrong_ns is not None]
    assert found[:1] == ([round(LAG_S / 0.05)] if is_wrong else [])


@pytest.mark.fault(94)
@pytest.mark.parametrize(
    "lie", [lambda s, v: -v if s >= LAG_S else v, lambda s, v: v - 1.5 * max(s - LAG_S, 0.0), lambda _s, v: max(v, 2.5)]
)
def test_the_velocity_before_the_lie_is_kept_with_what_setpoints_change_since(
    lie: Callable[[float, float], float],
) -> None:
    last, first = 59, VelocityChangeState(inertial_wrong_ns=START_NS)
    right = fly(last + 1, lie, lambda s, a: a if s < LAG_S else -a, state=first)[-1].right_beside_model_mps
    # Setpoints have given ACCEL since the lag is over: both change alike.
    model_mps = fly(last + 1, true, true)[-1].samples[-1][3]
    assert right is not None and right[0] + model_mps[0] == pytest.approx(SPEED_MPS + 0.05 * last * ACCEL[0], abs=0.3)


def test_no_velocity_is_kept_while_the_own_one_is_right() -> None:
    wrong = VelocityChangeState(velocity_wrong_ns=START_NS, right_beside_model_mps=ZERO, right_ns=START_NS)
    positions = VelocityState(offsets=((START_NS + 1, ZERO),), apart_mps=0.0)
    (state,) = fly(1, true, true, state=wrong, velocity=positions)
    assert (state.right_beside_model_mps, state.right_ns) == (None, None)
    assert {one.right_beside_model_mps for one in fly(40, true, true)} == {None}


@pytest.mark.fault(94)
@pytest.mark.parametrize("shown", ["repeats", "moves"])
def test_positions_that_agree_make_no_velocity_right_that_repeats(shown: str) -> None:
    """The first position counts that came after the velocity was found wrong, and it agrees."""
    positions, wrong = VelocityState(offsets=((START_NS + 1, ZERO),), apart_mps=0.0), VelocityChangeState()
    wrong = structs.replace(wrong, velocity_wrong_ns=START_NS)
    ticks = round(REPEATS_NS / TICK_NS) + 4
    *_, last = fly(ticks, lambda _s, v: 1.0 if shown == "repeats" else v, true, state=wrong)
    assert last.velocity_wrong_ns is not None
    at_ns = START_NS + (ticks - 1) * TICK_NS
    assert last.repeats(at_ns) == (shown == "repeats")
    seen_again = seen(at_ns, sent=ACCEL, vehicle_motion=motion(north(1.0), at_ns))
    after = update(last, TickObservation(seen_again, AT_FIRST, PARAMETERS), positions)
    assert (after.velocity_wrong_ns is None) == (shown == "moves")


def test_a_velocity_repeats_once_it_has_for_longer_than_any_message_takes() -> None:
    state = VelocityChangeState(repeated=(ZERO, ZERO, START_NS))
    assert [state.repeats(START_NS + 1_000_000_000 + after_ns) for after_ns in (0, 1)] == [False, True]
    assert not VelocityChangeState().repeats(START_NS)


def test_nothing_is_compared_while_positions_correct_the_velocity() -> None:
    resumed = Motion(resumed_ns=START_NS)
    states = fly(30, lambda s, v: v + (0.9 if s > 0.2 else 0.0), true, motion_state=resumed)
    count = CORRECTS_NS // TICK_NS
    assert all(state.samples == () for state in states[:count]) and len(states[count].samples) == 1


@pytest.mark.parametrize("are_compared", [True, False])
def test_a_disagreement_is_decided_when_positions_come_back(*, are_compared: bool) -> None:
    """Without it, an own velocity that is wrong since the last message would be believed against positions."""
    samples = (
        (START_NS - 2 * TICK_NS, ZERO, ZERO, ZERO),
        (START_NS - TICK_NS, ZERO, north(9.0), ZERO),
        (START_NS, north(1.0), north(0.1), ZERO),
    )
    state = VelocityChangeState(samples=samples if are_compared else (), disagrees_ns=START_NS)
    (after,) = fly(1, true, true, state=state, motion_state=Motion(resumed_ns=START_NS))
    assert is_found(after) == (are_compared, False)
    assert after.samples == () and after.disagrees_ns is None


def test_inertial_data_are_compared_again_after_three_seconds() -> None:
    wrong = VelocityChangeState(inertial_wrong_ns=START_NS)
    states = fly(80, true, true, state=wrong)
    ends = [tick * TICK_NS for tick, state in enumerate(states) if state.inertial_wrong_ns is None]
    assert ends[0] == 3_000_000_000 + TICK_NS


@pytest.mark.parametrize(
    ("offset_ns", "apart_mps", "is_wrong"), [(1, 0.0, False), (0, 0.0, True), (1, None, True), (1, 0.9, True)]
)
def test_a_velocity_is_believed_again_once_positions_since_then_agree(
    offset_ns: int, apart_mps: float | None, is_wrong: bool
) -> None:
    positions = VelocityState(offsets=((START_NS + offset_ns, ZERO),), apart_mps=apart_mps)
    (state,) = fly(1, true, true, state=VelocityChangeState(velocity_wrong_ns=START_NS), velocity=positions)
    assert (state.velocity_wrong_ns is not None) == is_wrong


def test_an_old_own_velocity_is_no_sample() -> None:
    observation = structs.replace(
        seen(START_NS + 400 * MS, sent=ACCEL, vehicle_motion=motion(north(1.0), START_NS)), inertial_mps2=ACCEL
    )
    before = VelocityChangeState(samples=((START_NS, north(1.0), ZERO, ZERO),), disagrees_ns=START_NS)
    after = update(
        before,
        TickObservation(observation, update_motion(Motion(), observation, PARAMETERS), PARAMETERS),
        VelocityState(),
    )
    assert (after.samples, after.disagrees_ns) == ((), None)


def test_the_same_own_velocity_is_one_sample() -> None:
    observation = structs.replace(
        seen(START_NS, sent=ACCEL, vehicle_motion=motion(north(1.0), START_NS)), inertial_mps2=ACCEL
    )
    tick = TickObservation(observation, update_motion(Motion(), observation, PARAMETERS), PARAMETERS)
    once = update(INITIAL, tick, NO_POSITIONS)
    assert [captured_ns for captured_ns, *_ in once.samples] == [START_NS]
    assert update(once, tick, NO_POSITIONS) == once


@pytest.mark.parametrize(
    ("state", "contradicts"),
    [
        (VelocityChangeState(agreed_ns=START_NS), False),
        (VelocityChangeState(disagrees_ns=START_NS), True),
        (VelocityChangeState(velocity_wrong_ns=0), True),
        (VelocityChangeState(inertial_wrong_ns=0), True),
    ],
)
def test_what_differs_or_was_found_wrong_contradicts(state: VelocityChangeState, contradicts: bool) -> None:
    assert state.contradicts == contradicts


HALF_S_NS = 500 * MS
# Bounds after half a second without and with gusts: 0.25 m/s + 0.3 m/s² t, 0.25 m/s + 0.3 (2 m/s²) t
AGREE_MPS, GUSTS_MPS = 0.25 + 0.3 * 0.5, 0.25 + 0.3 * 2.0 * 0.5


def compare(
    own: Vec3,
    gained: Vec3 | None,
    *,
    ns: int = HALF_S_NS,
    model: Vec3 = ZERO,
    pushed_mps2: Vec3 | None = None,
    first: tuple[Vec3, Vec3 | None, Vec3] = (ZERO, ZERO, ZERO),
    **known: Any,
) -> VelocityChangeState:
    """Take one tick, `ns` after a first sample; until then velocities have become these.

    Args:
        pushed_mps2: Acceleration that positions showed beside setpoints; None before any position.
        gained: The integral of inertial data; None without any.
        first: The sample: own velocity, integral of inertial data, that by setpoints.
        known: State of the monitor. Both have differed since the first sample unless it says otherwise.
    """
    at_ns = START_NS + ns
    observer = None
    if pushed_mps2 is not None:
        observer = Observer(at_ns, np.array([ZERO, ZERO, pushed_mps2]), np.zeros((3, 3)), np.zeros(3))
    path = () if gained is None else (InertialSpan(at_ns, ZERO, gained, ZERO),)
    moved = Motion(tick_ns=at_ns, model_mps=model, inertial_path=path, observer=observer)
    tick = structs.replace(
        seen(at_ns, vehicle_motion=motion(own, at_ns)), inertial_mps2=None if gained is None else ZERO
    )
    before: dict[str, Any] = {"samples": ((START_NS, *first),), "disagrees_ns": START_NS, **known}
    return update(VelocityChangeState(**before), TickObservation(tick, moved, PARAMETERS), NO_POSITIONS)


@pytest.mark.parametrize(("ns", "bound_mps"), [(HALF_S_NS, AGREE_MPS), (2 * HALF_S_NS, 0.25 + 0.3)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_changes_agree_up_to_a_bound_that_grows_with_time(ns: int, bound_mps: float, sign: float) -> None:
    at_bound = compare(north(sign * bound_mps), ZERO, ns=ns, model=north(sign * 0.3 * bound_mps))
    assert (at_bound.agreed_ns, at_bound.disagrees_ns) == (START_NS + ns, None)
    beyond = compare(ZERO, north(sign * just_more(bound_mps)), ns=ns, disagrees_ns=None)
    assert (beyond.agreed_ns, beyond.disagrees_ns) == (None, START_NS + ns)


@pytest.mark.parametrize(("model_mps", "agrees"), [(0.09376, True), (0.09375, False)])
def test_inertial_data_three_times_as_near_to_setpoints_do_not_drift(model_mps: float, agrees: bool) -> None:
    own_mps = (
        0.375  # less than 0.25 m/s and half a second of drift; |Δv - Δm| = 3 |Δi - Δm| where the model has 0.09375
    )
    state = compare(north(own_mps), ZERO, model=north(model_mps))
    assert (state.agreed_ns is not None) == agrees == (state.disagrees_ns is None)
    # So far apart that nothing but the drift explains it.
    assert compare(north(0.25), ZERO, model=ZERO).agreed_ns is not None


@pytest.mark.parametrize(("for_ns", "finds"), [(50 * MS - 1, False), (50 * MS, True)])
def test_a_disagreement_has_to_last(for_ns: int, finds: bool) -> None:
    state = compare(north(1.0), ZERO, disagrees_ns=START_NS + HALF_S_NS - for_ns)
    assert is_found(state) == (finds, False)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("own", "gained", "pushed_mps2", "wrong"),
    [
        (0.5, -0.45, None, (True, False)),
        (0.45, -0.5, None, (False, True)),
        (0.5, -0.5, None, (True, False)),  # as far
        (0.5, -0.45, 0.0, (True, False)),
        (0.5, -0.45, 1.0, (False, True)),  # 1 m/s² makes 0.5 m/s
        (0.7, 0.25, 1.0, (False, True)),  # the nearer of both counts
        (-0.35, 0.25, 1.5, (True, False)),  # for inertial data, too
    ],
)
def test_the_one_that_is_further_from_setpoints_with_or_without_a_push_is_wrong(
    own: float, gained: float, pushed_mps2: float | None, wrong: tuple[bool, bool], axis: int
) -> None:
    def along(value: float) -> Vec3:
        values = [0.0] * 3
        values[axis] = value
        return values[0], values[1], values[2]

    state = compare(along(own), along(gained), pushed_mps2=None if pushed_mps2 is None else along(pushed_mps2))
    assert is_found(state) == wrong


def test_both_are_wrong_where_the_nearer_one_is_beyond_twice_the_gusts() -> None:
    bound_mps = 2.0 * GUSTS_MPS
    assert is_found(compare(north(bound_mps), north(-1.5 * bound_mps))) == (False, True)
    assert is_found(compare(north(just_more(bound_mps)), north(-1.5 * bound_mps))) == (True, True)
    # Once the own velocity was found wrong, inertial data alone are compared with that bound.
    for gained_mps, is_wrong in ((bound_mps, False), (just_more(bound_mps), True)):
        assert is_found(compare(ZERO, north(gained_mps), velocity_wrong_ns=START_NS)) == (True, is_wrong)


def test_beside_wrong_inertial_data_gusts_bound_the_own_velocity() -> None:
    for own_mps, is_wrong in ((GUSTS_MPS, False), (just_more(GUSTS_MPS), True)):
        assert is_found(compare(north(own_mps), ZERO, inertial_wrong_ns=START_NS)) == (is_wrong, True)


@pytest.mark.parametrize("wrong_ns", [None, START_NS])
def test_the_velocity_at_the_begin_of_the_window_is_kept_where_the_own_one_is_wrong(wrong_ns: int | None) -> None:
    first, model = (north(1.0), ZERO, north(0.25)), north(0.25)
    wrong = compare(north(3.0), ZERO, first=first, model=model, inertial_wrong_ns=wrong_ns)
    assert (wrong.right_beside_model_mps, wrong.right_ns) == (north(0.75), START_NS)
    right = compare(north(1.0), north(-2.0), first=first, model=model, inertial_wrong_ns=wrong_ns)
    assert (is_found(right), right.right_beside_model_mps, right.right_ns) == ((False, True), None, None)


@pytest.mark.parametrize(
    ("ns", "own_mps", "is_supported"),
    [(HALF_S_NS, GUSTS_MPS, True), (HALF_S_NS, just_more(GUSTS_MPS), False), (HALF_S_NS - 1, 0.0, False)],
)
def test_setpoints_agree_with_the_velocity_within_gusts_from_half_a_second_on(
    ns: int, own_mps: float, is_supported: bool
) -> None:
    state = compare(north(own_mps), None, ns=ns, first=(ZERO, None, ZERO))
    assert (state.agreed_ns == START_NS + ns) == is_supported and state.disagrees_ns is None
    # Inertial data that were found wrong count as none.
    wrong = compare(north(own_mps), north(9.0), ns=ns, inertial_wrong_ns=START_NS)
    assert (wrong.agreed_ns == START_NS + ns) == is_supported
    assert wrong.disagrees_ns == (START_NS if is_found(wrong) == (True, True) else None)
    both = compare(north(own_mps), north(9.0), ns=ns, inertial_wrong_ns=START_NS, velocity_wrong_ns=START_NS)
    assert (both.agreed_ns, both.velocity_wrong_ns) == (None, START_NS)


def test_inertial_data_agree_with_the_velocity_from_half_a_second_on() -> None:
    # Over less, a mirrored velocity changes alike, too.
    for ns, agreed_ns in ((HALF_S_NS, START_NS + HALF_S_NS), (HALF_S_NS - 1, None)):
        state = compare(ZERO, ZERO, ns=ns)
        assert (state.agreed_ns, state.disagrees_ns) == (agreed_ns, None)


@pytest.mark.fault(94)
@pytest.mark.parametrize(("change_mps", "supports"), [(0.25, False), (just_more(0.25), True), (-0.251, True)])
def test_only_a_change_supports_the_velocity(change_mps: float, supports: bool) -> None:
    """One that is mirrored or late agrees with everything as long as the vehicle does not accelerate."""
    change = north(change_mps)
    for gained in (change, None):
        first = (ZERO, None if gained is None else ZERO, ZERO)
        state = compare(change, gained, model=change, first=first)
        assert (state.supported_ns is not None, state.disagrees_ns) == (supports, None)
        assert state.agrees(state.agreed_ns or 0) and state.supports_velocity(state.agreed_ns or 0) == supports


def test_an_own_velocity_that_was_found_wrong_or_has_stopped_is_missing() -> None:
    assert not INITIAL.is_missing(START_NS)
    assert VelocityChangeState(velocity_wrong_ns=START_NS).is_missing(START_NS)
    # A vehicle that sends it once a second has not stopped.
    stopped = VelocityChangeState(right_ns=START_NS)
    assert [stopped.is_missing(START_NS + 1500 * MS + ns) for ns in (0, 1)] == [False, True]


@pytest.mark.parametrize(
    ("gained_mps", "ns", "is_confirmed"),
    [(0.5, HALF_S_NS, False), (0.501, HALF_S_NS, True), (0.501, HALF_S_NS - 1, False)],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_large_change_that_both_show_confirms_the_velocity_for_a_second(
    gained_mps: float, ns: int, is_confirmed: bool, sign: float
) -> None:
    state = compare(*(north(sign * gained_mps),) * 2, ns=ns)
    at_ns = START_NS + ns
    assert state.confirms_velocity(at_ns) == is_confirmed == state.confirms_velocity(at_ns + 1_000_000_000)
    assert not state.confirms_velocity(at_ns + 1_000_000_001)
    later = structs.replace(state, disagrees_ns=at_ns)
    assert not later.confirms_velocity(at_ns)


LONE_MPS = 1.2 * GUSTS_MPS


def fall_silent(
    gained: Vec3 | None, *, own: Vec3 | None = None, pushed_mps2: Vec3 = ZERO, **known: Any
) -> VelocityChangeState:
    """Take a tick without an own velocity, half a second after the first such one."""
    at_ns = START_NS + HALF_S_NS
    path = () if gained is None else (InertialSpan(at_ns, ZERO, gained, ZERO),)
    observer = Observer(at_ns, np.array([ZERO, ZERO, pushed_mps2]), np.zeros((3, 3)), np.zeros(3))
    moved = Motion(tick_ns=at_ns, model_mps=north(2.0), inertial_path=path, observer=observer)
    tick = structs.replace(
        seen(at_ns, vehicle_motion=None if own is None else motion(own, at_ns)),
        inertial_mps2=None if gained is None else ZERO,
    )
    before: dict[str, Any] = {"right_ns": START_NS, "lone": ((START_NS, north(1.0), north(2.0)),), **known}
    return update(VelocityChangeState(**before), TickObservation(tick, moved, PARAMETERS), NO_POSITIONS)


@pytest.mark.fault(94)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_where_the_own_velocity_has_stopped_setpoints_check_inertial_data(sign: float) -> None:
    off_mps = sign * LONE_MPS
    assert is_found(fall_silent(north(1.0 + off_mps * (1.0 - 1e-9)))) == (False, False)
    assert is_found(fall_silent(north(1.0 + off_mps * (1.0 + 1e-9)))) == (False, True)
    at_bound = fall_silent(north(off_mps), lone=((START_NS, ZERO, north(2.0)),))
    assert is_found(at_bound) == (False, False)
    # The acceleration that positions showed may last, or not.
    for gained_mps in (0.0, sign * 2.0):
        assert is_found(fall_silent(north(1.0 + gained_mps), pushed_mps2=north(sign * 4.0))) == (False, False)


def test_nothing_is_found_where_no_own_velocity_ever_came_or_no_inertial_data_do() -> None:
    assert is_found(fall_silent(north(9.0), right_ns=None)) == is_found(fall_silent(None)) == (False, False)
    comes = fall_silent(north(9.0), own=north(1.0))
    assert is_found(comes) == (False, False) and comes.lone == ()


def test_lone_inertial_data_are_compared_over_a_second() -> None:
    long_ago = (START_NS - HALF_S_NS - 1, north(-9.0), north(2.0))
    state = fall_silent(north(1.0), lone=(long_ago, (START_NS - HALF_S_NS, north(1.0), north(2.0))))
    assert is_found(state) == (False, False) and [at_ns for at_ns, *_ in state.lone] == [
        START_NS - HALF_S_NS,
        START_NS + HALF_S_NS,
    ]
    assert is_found(fall_silent(north(1.0), lone=((START_NS - HALF_S_NS, north(-9.0), north(2.0)),))) == (False, True)


def test_the_last_own_velocity_is_remembered_once_it_stops_and_forgotten_once_it_comes() -> None:
    before, sample = (START_NS - 50 * MS, north(9.0), ZERO, ZERO), (START_NS, north(1.5), ZERO, north(0.5))
    state = fall_silent(north(1.0), samples=(before, sample), right_ns=None)
    assert (state.right_beside_model_mps, state.right_ns) == (north(1.0), START_NS)
    again = fall_silent(north(1.0), own=north(1.0), right_beside_model_mps=north(1.0))
    assert (again.right_beside_model_mps, again.right_ns) == (None, None)
    wrong = fall_silent(north(1.0), samples=(sample,), velocity_wrong_ns=START_NS, right_beside_model_mps=north(3.0))
    assert wrong.right_beside_model_mps == north(3.0)


def test_inertial_data_count_up_to_the_own_velocity_or_up_to_now_without_one() -> None:
    at_ns, own_ns = START_NS + HALF_S_NS, START_NS + HALF_S_NS - 100 * MS
    moved = Motion(tick_ns=at_ns, inertial_path=(InertialSpan(START_NS, north(10.0), ZERO, ZERO),))
    old = motion(north(0.1), at_ns - 301 * MS)
    for own, gained_mps in ((motion(north(0.1), own_ns), 4.0), (None, 5.0), (old, 5.0)):
        tick = structs.replace(seen(at_ns, vehicle_motion=own), inertial_mps2=ZERO)
        state = update(INITIAL, TickObservation(tick, moved, PARAMETERS), NO_POSITIONS)
        gained = state.samples[-1][2] if state.samples else state.lone[-1][1]
        assert gained == pytest.approx(north(gained_mps))


@pytest.mark.fault(94)
def test_an_own_velocity_that_has_repeated_for_a_second_is_as_good_as_none() -> None:
    own, since_ns = north(1.0), START_NS + HALF_S_NS - 1_000_000_001
    lie = north(1.0 + 1.01 * LONE_MPS)
    state = fall_silent(lie, own=own, repeated=(own, north(2.0), since_ns))
    assert is_found(state) == (False, True) and state.repeated == (own, north(2.0), since_ns)
    # That setpoints have changed by more than a disagreement since shows that it is wrong.
    assert is_found(fall_silent(north(1.0), own=own, repeated=(own, north(1.7), since_ns))) == (True, False)
    for other in ((own, north(2.0), since_ns + 1), (north(1.1), north(2.0), since_ns)):
        assert is_found(fall_silent(lie, own=own, repeated=other)) == (False, False)


def test_changes_are_compared_whatever_the_velocities_were_at_first() -> None:
    at_first = (north(1.0), north(2.0), north(4.0))
    state = compare(north(1.5), north(2.5), first=at_first, model=north(4.5))
    assert (state.agreed_ns, is_found(state)) == (START_NS + HALF_S_NS, (False, False))


def test_samples_of_the_last_second_are_compared_each_once() -> None:
    earlier = tuple((START_NS + ns, ZERO, ZERO, ZERO) for ns in (HALF_S_NS - 1, HALF_S_NS, 2 * HALF_S_NS))
    state = compare(ZERO, ZERO, ns=3 * HALF_S_NS, samples=earlier)
    assert [at_ns - START_NS for at_ns, *_ in state.samples] == [HALF_S_NS, 2 * HALF_S_NS, 3 * HALF_S_NS]
    again = compare(ZERO, ZERO, ns=2 * HALF_S_NS, samples=earlier)
    assert (again.samples, again.disagrees_ns) == (earlier, START_NS)


def test_a_sample_without_inertial_data_is_not_compared_with_those_before() -> None:
    path = (InertialSpan(START_NS, ZERO, ZERO, ZERO),)
    before = VelocityChangeState(samples=((START_NS - MS, ZERO, ZERO, ZERO),), disagrees_ns=START_NS)
    tick = seen(START_NS, vehicle_motion=motion(ZERO, START_NS))
    state = update(before, TickObservation(tick, Motion(inertial_path=path), PARAMETERS), NO_POSITIONS)
    assert (state.samples, state.disagrees_ns) == (((START_NS, ZERO, None, ZERO),), None)


@pytest.mark.parametrize(
    ("own_mps", "model_mps", "is_wrong"),
    [
        (0.0, 0.25, False),  # repeats
        (0.0, just_more(0.25), True),
        (0.25 + 0.375, 0.0, False),  # leaps within 62.5 ms
        (just_more(0.25 + 0.375), 0.0, True),
        (-0.75, 0.5, False),  # a response that is turned by 180°
        (-0.75 - 1e-12, 0.5, True),
    ],
)
def test_a_velocity_may_repeat_and_leap_up_to_a_bound(own_mps: float, model_mps: float, is_wrong: bool) -> None:
    at_ns = START_NS + 62_500_000
    before = VelocityChangeState(repeated=(ZERO, ZERO, START_NS))
    tick = seen(at_ns, vehicle_motion=motion(north(own_mps), at_ns))
    state = update(before, TickObservation(tick, Motion(model_mps=north(model_mps)), PARAMETERS), NO_POSITIONS)
    assert is_found(state) == (is_wrong, False)
    assert state.right_ns == (START_NS if is_wrong else None)


@pytest.mark.parametrize("repeats", [True, False])
def test_one_message_does_not_repeat_itself(repeats: bool) -> None:
    """Setpoints have changed the velocity since the message by far more than the bound."""
    at_ns = START_NS + 100 * MS
    before = VelocityChangeState(repeated=(ZERO, ZERO, START_NS))
    tick = seen(at_ns, vehicle_motion=motion(ZERO, at_ns if repeats else START_NS))
    state = update(before, TickObservation(tick, Motion(model_mps=north(1.0)), PARAMETERS), NO_POSITIONS)
    assert is_found(state) == (repeats, False)


def test_times_and_bounds_count_to_the_last_nanosecond_and_bit() -> None:
    agreed = VelocityChangeState(agreed_ns=START_NS)
    assert agreed.agrees(START_NS + 300 * MS) and not agreed.agrees(START_NS + 300 * MS + 1)
    supported = VelocityChangeState(agreed_ns=START_NS + MS, supported_ns=START_NS)
    assert [supported.supports_velocity(START_NS + 300 * MS + ns) for ns in (0, 1)] == [True, False]
    for later_ns, is_wrong in ((3_000 * MS, True), (3_000 * MS + 1, False)):
        tick = TickObservation(seen(START_NS + later_ns), Motion(), PARAMETERS)
        assert is_found(update(VelocityChangeState(inertial_wrong_ns=START_NS), tick, NO_POSITIONS))[1] == is_wrong
    for apart_mps, is_wrong in ((0.25, False), (just_more(0.25), True)):
        positions = VelocityState(offsets=((START_NS + 1, ZERO),), apart_mps=apart_mps)
        tick = TickObservation(seen(START_NS + MS), Motion(), PARAMETERS)
        assert is_found(update(VelocityChangeState(velocity_wrong_ns=START_NS), tick, positions))[0] == is_wrong
