"""Positions against the vehicle's own velocity: over a second or so, and over the ways of half a minute."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from envelope_rig import (
    AT_NS,
    AT_REST,
    LOOK_NS,
    NAN3,
    PARAMETERS,
    believed,
    changed,
    just_less,
    just_more,
    look,
    monitors,
    motion,
    offsets,
    seen,
    trusted_velocity,
    update,
    vec3,
)
from flight_rig import MS, START_NS, sample
from msgspec import structs

from uavctl.arrays import SECOND_NS
from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors import velocity
from uavctl.flight.monitors.engaged import INITIAL, MonitorState
from uavctl.flight.monitors.motion import Motion, PositionObservation
from uavctl.flight.monitors.observer import Observer
from uavctl.flight.monitors.velocity import VelocityState
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import Verdict
from uavctl.records import Vec3, VehicleMotion


@pytest.mark.parametrize(
    ("spans_ns", "compared"),
    [
        ((360 * MS,), False),
        ((100 * MS, 360 * MS), True),
        ((100 * MS, 360 * MS - 1), False),
        ((100 * MS, 1200 * MS - 1), True),
        ((100 * MS, 1200 * MS), False),  # one is too old
    ],
)
def test_velocities_are_compared_over_three_positions_and_part_of_the_window(
    spans_ns: tuple[int, ...], compared: bool
) -> None:
    watching, _ = look(ZERO, vehicle_motion=AT_REST, **offsets(0.125, spans_ns=spans_ns, apart_mps=9.0, apart_ns=1))
    assert watching.velocity.apart_mps == (pytest.approx(0.125) if compared else None)
    assert watching.velocity.apart_ns is None
    assert not watching.velocity.is_contradicted


# 0.4375 m/s are exactly what is shown of 0.4375 m/s, and 1.5 times 0.4375 / 1.5.
EXACT_MPS = 0.4375


def turning(accel: Vec3, slope: Vec3) -> tuple[float | None, bool]:
    """What is left of offsets with that slope while the vehicle accelerates, and whether it contradicts."""
    times_ns = [AT_NS - ns * MS for ns in (512, 256)]
    nodes_ns = (times_ns[0] - 1, *times_ns, AT_NS - 1)
    way = tuple((at, 0.5 * ((at - AT_NS) * 1e-9) ** 2 * np.array(accel)) for at in nodes_ns)
    lines = tuple((at, (at - AT_NS) * 1e-9 * np.array(slope)) for at in times_ns)
    watching, _ = look(ZERO, vehicle_motion=AT_REST, vehicle_path=way, offsets=lines)
    return watching.velocity.apart_mps, watching.velocity.is_contradicted


@pytest.mark.parametrize(
    ("accel", "slope", "left_mps"),
    [
        (ZERO, (0.3, 0.0, 0.0), 0.3),
        ((2.0, 0.0, 0.0), (-0.2, 0.0, 0.0), 0.0),  # positions are 0.1 s late
        ((2.0, 0.0, 0.0), (0.2, 0.0, 0.0), 0.0),  # or early
        ((0.5, 0.0, 0.0), (-0.05, 0.0, 0.0), 0.0),
        ((2.0, 0.0, 0.0), (-0.5, 0.0, 0.0), 0.2),  # no stamp is later than 0.15 s
        ((2.0, 0.0, 0.0), (0.5, 0.0, 0.0), 0.2),
        ((2.0, 0.0, 0.0), (0.0, 0.3, 0.0), 0.3),  # nor does it turn a velocity
        ((0.0, 1.0, 1.0), (0.0, -0.2, 0.0), math.hypot(0.1, 0.1)),
    ],
)
def test_as_much_as_late_stamps_make_is_no_difference_of_velocities(accel: Vec3, slope: Vec3, left_mps: float) -> None:
    left, contradicted = turning(accel, slope)
    assert left == pytest.approx(left_mps, abs=1e-6)
    assert contradicted == (left_mps > PARAMETERS.disagreement_mps)


def test_where_the_way_is_not_known_all_of_a_difference_counts() -> None:
    times_ns = [AT_NS - ns * MS for ns in (512, 256)]
    lines = tuple((at, np.array([(at - AT_NS) * -0.2e-9, 0.0, 0.0])) for at in times_ns)
    for begins_ns in (times_ns[0], times_ns[0] + 1):
        way = tuple(
            (at, np.array([((at - AT_NS) * 1e-9) ** 2, 0.0, 0.0])) for at in (begins_ns - 1, times_ns[1], AT_NS - 1)
        )
        watching, _ = look(ZERO, vehicle_motion=AT_REST, vehicle_path=way, offsets=lines)
        assert watching.velocity.apart_mps == pytest.approx(0.2 if begins_ns > times_ns[0] else 0.0, abs=5e-3)


def test_where_the_observer_begins_anew_a_contradiction_has_to_persist() -> None:
    """A position that comes three seconds late may still be compared with those before."""
    captured_ns = AT_NS - 2900 * MS
    state = monitors(
        observer=Observer(AT_NS - 3 * SECOND_NS, np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)),
        tick_ns=START_NS,
        vehicle_path=((captured_ns - 50 * MS, ZERO), (START_NS, ZERO)),
        offsets=tuple((captured_ns - ns * MS, np.array([-0.3e-3 * ns, 0.0, 0.0])) for ns in (500, 250)),
    )
    watching, breach = update(state, seen(AT_NS, sample(captured_ns, AT_NS), vehicle_motion=AT_REST), PARAMETERS)
    assert watching.velocity.apart_mps == pytest.approx(0.3) and watching.velocity.is_contradicted
    assert watching.velocity.apart_ns == captured_ns
    assert not watching.acceleration.is_hinted
    assert breach is not None


@pytest.mark.parametrize(
    ("since_ns", "breached"),
    [
        (None, False),
        (AT_NS - 600 * MS + 1, False),
        (AT_NS - 600 * MS, True),
        (AT_NS - 600 * MS - 1, True),
        (AT_NS - 700 * MS, True),
    ],
)
def test_velocities_that_contradicted_each_other_and_then_no_position_comes(
    since_ns: int | None, breached: bool
) -> None:
    _, breach = update(monitors(apart_ns=since_ns, tick_ns=START_NS), seen(AT_NS, vehicle_motion=AT_REST), PARAMETERS)
    assert (None if breach is None else breach.cause) == (EventCode.VELOCITY if breached else None)


def test_a_velocity_that_is_contradicted_is_not_agreed_with() -> None:
    bound_mps = PARAMETERS.disagreement_mps
    for apart_mps, agrees in ((None, True), (bound_mps, True), (just_more(bound_mps), False)):
        assert VelocityState(apart_mps=apart_mps).agrees(PARAMETERS) == agrees


def test_a_contradiction_counts_by_offsets_after_the_first_second_of_positions_alone() -> None:
    known = offsets(0.3)
    times_ns = [at_ns for at_ns, _ in known["offsets"]]
    # The first offset is the first that counts; or it does not, and too few are left; or all are in that second.
    for resumed_ns, finds in ((times_ns[0], True), (times_ns[0] + 1, False)):
        watching, _ = look(ZERO, vehicle_motion=AT_REST, resumed_ns=resumed_ns - SECOND_NS, **known)
        assert watching.velocity.is_contradicted and (watching.velocity.apart_ns is not None) == finds
    watching, _ = look(ZERO, vehicle_motion=AT_REST, resumed_ns=AT_NS - SECOND_NS + 1, **known)
    assert watching.velocity.is_contradicted and watching.velocity.apart_ns is None


@pytest.mark.parametrize("known", [("offsets",), ("places",), ("offsets", "places")])
def test_a_distance_that_begins_anew_is_not_compared_with_what_was_before(known: tuple[str, ...]) -> None:
    """Nor is one that is not known: this tick brings no position."""
    values = {"offsets": offsets(0.0)["offsets"], "places": ((START_NS - SECOND_NS, ZERO, ZERO),)}
    before = monitors(tick_ns=START_NS, **{name: values[name] for name in known})
    flown = ((START_NS, ZERO),)
    for path, own, is_kept in (((), AT_REST, False), (flown, None, False), (flown, AT_REST, True)):
        after, _ = update(changed(before, vehicle_path=path), seen(AT_NS, vehicle_motion=own), PARAMETERS)
        kept = (bool(after.velocity.offsets), bool(after.velocity.places))
        assert kept == (is_kept and "offsets" in known, is_kept and "places" in known)


@pytest.mark.parametrize(
    ("silent_s", "off_m", "ends"), [(1.5, 0.26, False), (1.5, 0.29, True), (4.0, 0.68, False), (4.0, 0.72, True)]
)
@pytest.mark.fault(95)
def test_positions_come_back_near_the_vehicle_s_own_way(silent_s: float, off_m: float, ends: bool) -> None:
    """It flies on at 0.5 m/s in a silence, by its own velocity, and positions come back beside that way."""
    unbounded = replace(PARAMETERS, unexplained_mps2=1e3)
    watching, causes, silent = INITIAL, [], range(20, 20 + round(silent_s / 0.05))
    for tick in range(silent.stop + 1):
        at_ns = START_NS + tick * 50 * MS
        where = (0.5 * tick * 0.05, 0.0 if tick < silent.stop else off_m, 0.0)
        taken = () if tick in silent else (sample(at_ns, at_ns, where),)
        ours = seen(at_ns, *taken, vehicle_motion=motion((0.5, 0.0, 0.0), at_ns))
        watching, breach = update(watching, ours, unbounded)
        causes += [] if breach is None else [(tick, breach.cause)]
    assert causes == ([(silent.stop, EventCode.VELOCITY)] if ends else [])


# The ways of half a minute


@pytest.mark.parametrize(
    ("place_m", "off_m", "near"),
    [
        ((2.2, 0.0, -2.0), (-0.41, 0.0, 0.0), True),  # north by its own way: 0.39 m before the wall
        ((2.2, 0.0, -2.0), (-0.29, 0.0, 0.0), False),  # 0.51 m before it
        ((2.7, 0.0, -2.0), (0.41, 0.0, 0.0), False),  # further inside than positions say
        ((-2.2, 0.0, -2.0), (0.41, 0.0, 0.0), True),
        ((-2.2, 0.0, -2.0), (0.29, 0.0, 0.0), False),
        ((-2.7, 0.0, -2.0), (-0.41, 0.0, 0.0), False),
        ((0.0, 1.4, -2.0), (0.0, -0.41, 0.0), True),
        ((0.0, -1.4, -2.0), (0.0, 0.41, 0.0), True),
        ((0.0, 0.0, -3.4), (0.0, 0.0, 0.41), True),  # the ceiling
        ((0.0, 0.0, -1.4), (0.0, 0.0, -0.41), False),  # the floor stops a vehicle
        ((2.7, 0.0, -2.0), (0.0, -0.41, 0.0), False),  # along the wall
        ((-2.7, 0.0, -2.0), (0.0, 0.41, 0.0), False),
        ((2.25, 0.0, -2.0), (-0.25, 0.0, 0.0), False),  # just 0.5 m before it
        ((-2.25, 0.0, -2.0), (0.25, 0.0, 0.0), False),
    ],
)
def test_the_own_way_leads_to_a_wall_or_the_ceiling(place_m: Vec3, off_m: Vec3, near: bool) -> None:
    assert velocity._leads_out(believed(place_m), list(off_m)) == near


@pytest.mark.parametrize(("place_m", "begin_s"), [((2.6, 0.0, -2.0), 1.0), ((0.0, 0.0, -2.0), 2.0)])
def test_a_drift_to_a_wall_is_found_at_half_the_distance(place_m: Vec3, begin_s: float) -> None:
    """Positions stay, and the own way goes north: in 5 s by the bound, or by little more."""
    within_m = (begin_s + 0.16 * 5.0) * PARAMETERS.disagreement_mps
    places = ((START_NS - 5 * SECOND_NS, ZERO, ZERO),)
    for off_m, breached in ((within_m, False), (just_more(within_m), True)):
        now = (-off_m, 0.0, 0.0)
        drift, *_ = velocity._find_drift(
            VelocityState(places=places), ((START_NS, now),), np.array([now]), ZERO, believed(place_m)
        )
        assert (drift is not None) == breached


def creeping(off_m: float, age_ns: int, *, before: int = 0) -> tuple[MonitorState, Verdict | None]:
    """A position now, where the vehicle's own way had another place so long before the middle of the offsets."""
    known = offsets(0.0, spans_ns=(256 * MS, 512 * MS))
    middle_ns = AT_NS - 256 * MS
    older = tuple((middle_ns - age_ns - n * SECOND_NS, ZERO, ZERO) for n in range(before, 0, -1))
    places = (*older, (middle_ns - age_ns, np.array([-off_m, 0.0, 0.0]), ZERO))
    return look(ZERO, vehicle_motion=AT_REST, places=places, **known)


@pytest.mark.parametrize(
    ("age_ns", "within_m"),
    [
        (SECOND_NS, 0.25 * 2.16),
        (5 * SECOND_NS, 0.25 * 2.8),
        (30 * SECOND_NS - 1, 0.25 * 6.8),
        (30 * SECOND_NS, math.inf),
    ],
)
def test_positions_may_leave_the_vehicles_own_way_by_so_much(age_ns: int, within_m: float) -> None:
    for off_m, breached in ((min(within_m, 99.0) - 1e-6, False), (within_m + 1e-6, True)):
        watching, breach = creeping(off_m if math.isfinite(off_m) else 99.0, age_ns)
        breached = breached and math.isfinite(within_m)
        assert (None if breach is None else breach.cause) == (EventCode.VELOCITY if breached else None)
        assert not watching.velocity.is_contradicted


def test_positions_may_leave_the_vehicles_own_way_by_just_so_much() -> None:
    within_m = (2.0 + 0.16) * PARAMETERS.disagreement_mps
    for off_m, breached in ((within_m, False), (just_more(within_m), True)):
        _, breach = creeping(off_m, SECOND_NS)
        assert (breach is not None) == breached


@pytest.mark.parametrize(
    ("late_s", "across_m", "breached"),
    [
        (0.29, 0.0, False),  # positions that are smoothed follow late
        (0.3, 1.0, True),
        (-0.29, 0.0, True),  # none come early
        (0.5, 0.0, True),  # so late is no smoothing
    ],
)
@pytest.mark.fault(100)
def test_smoothing_explains_a_change_of_offsets_with_the_velocity(
    late_s: float, across_m: float, breached: bool
) -> None:
    """At rest now; the vehicle flew at 5 m/s to the north 10 s before, by its own word."""
    known = offsets(0.0, spans_ns=(256 * MS, 512 * MS))
    places = ((AT_NS - 10 * SECOND_NS, (-late_s * 5.0, across_m, 0.0), (5.0, 0.0, 0.0)),)
    _, breach = look(ZERO, vehicle_motion=AT_REST, places=places, **known)
    assert (breach is not None) == breached


@pytest.mark.parametrize(
    ("late_s", "drift_mps", "breached"), [(0.29, 0.0, False), (0.0, 0.09, False), (0.0, 0.12, True), (0.29, 0.12, True)]
)
@pytest.mark.fault(42)
def test_a_drift_in_motion_is_no_smoothing(late_s: float, drift_mps: float, breached: bool) -> None:
    """At rest now; for 8 s before, the vehicle flew at 1 m/s and at 2 m/s in turn, by its own word.

    A delay of 0.3 s would explain 0.3 m or 0.6 m of each place alone, but not all of them.
    """
    known = offsets(0.0, spans_ns=(256 * MS, 512 * MS))
    flown = [(ago_s, 1.0 + ago_s % 2) for ago_s in range(8, 0, -1)]
    places = tuple(
        (AT_NS - 256 * MS - ago_s * SECOND_NS, (-late_s * v - drift_mps * ago_s, 0.0, 0.0), (v, 0.0, 0.0))
        for ago_s, v in flown
    )
    _, breach = look(ZERO, vehicle_motion=AT_REST, places=places, **known)
    assert (breach is not None) == breached


def test_any_place_of_the_way_that_is_too_far_off_is_enough() -> None:
    _, breach = creeping(9.0, SECOND_NS, before=3)
    assert breach is not None and breach.cause == EventCode.VELOCITY


@pytest.mark.parametrize(
    ("age_ns", "kept"),
    [(SECOND_NS - 1, 1), (SECOND_NS, 2), (30 * SECOND_NS - 1, 2), (30 * SECOND_NS, 1), (31 * SECOND_NS, 1)],
)
def test_a_place_of_the_way_is_remembered_each_second_for_half_a_minute(age_ns: int, kept: int) -> None:
    watching, breach = creeping(0.0, age_ns)
    assert breach is None
    assert len(watching.velocity.places) == kept
    if kept == 2 or age_ns >= 30 * SECOND_NS:
        at_ns, place, _ = watching.velocity.places[-1]
        assert at_ns == AT_NS - 256 * MS and isinstance(at_ns, int)
        np.testing.assert_allclose(place, ZERO, atol=1e-12)


def test_a_place_of_the_way_is_remembered_a_second_after_the_last_one() -> None:
    watching, _ = creeping(0.0, SECOND_NS // 2, before=5)
    assert len(watching.velocity.places) == 6


def test_the_place_of_the_way_is_the_mean_of_the_offsets() -> None:
    watching, _ = look(ZERO, vehicle_motion=AT_REST, **offsets(0.125, spans_ns=(100 * MS, 500 * MS)))
    ((at_ns, place, velocity),) = watching.velocity.places
    assert at_ns == AT_NS - 200 * MS
    np.testing.assert_allclose(place, (-0.125 * 0.2, 0.0, 0.0), atol=1e-12)
    assert velocity == ZERO


def test_over_a_gap_the_way_is_not_compared() -> None:
    places = ((START_NS - SECOND_NS, (9.0, 0.0, 0.0), ZERO),)
    for spans_ns, kept in (((100 * MS,), True), ((1200 * MS,), False)):
        watching, breach = look(ZERO, vehicle_motion=AT_REST, places=places, **offsets(0.0, spans_ns=spans_ns))
        assert breach is None
        assert watching.velocity.places == (places if kept else ())
    silent, _ = look(ZERO, places=places, **offsets(0.0))
    missed, _ = look(
        ZERO, vehicle_motion=AT_REST, places=places, **offsets(0.0, vehicle_path=((AT_NS - 301 * MS, ZERO),))
    )
    assert silent.velocity.places == missed.velocity.places == ()
    state = monitors(vehicle_path=((START_NS, ZERO),), places=places)  # the way is not known so early
    early, _ = update(state, seen(AT_NS, sample(START_NS, AT_NS), vehicle_motion=AT_REST), PARAMETERS)
    assert not early.velocity.offsets and not early.velocity.places


def test_a_contradiction_is_reported_before_scatter_and_after_an_unexplained_acceleration() -> None:
    contradicts = offsets(9.0)
    _, scattered = look(ZERO, off_m=9.0, vehicle_motion=AT_REST, clipped=(True, True), **contradicts)
    assert scattered is not None and scattered.cause == EventCode.VELOCITY
    _, unexplained = look((9.0, 0.0, 0.0), vehicle_motion=AT_REST, **contradicts)
    assert unexplained is not None and unexplained.cause == EventCode.RESPONSE


def test_velocities_that_contradict_each_other_are_told_before_ways_that_do() -> None:
    places = ((START_NS - SECOND_NS, (9.0, 0.0, 0.0), ZERO),)
    _, breach = look(ZERO, vehicle_motion=AT_REST, places=places, **offsets(9.0))
    assert breach is not None and breach.text.startswith("velocity by positions")


@pytest.mark.parametrize(
    ("for_ns", "answered"), [(None, False), (2 * SECOND_NS - 1, False), (2 * SECOND_NS, True), (3 * SECOND_NS, True)]
)
def test_positions_have_answered_after_two_seconds_of_a_flight(for_ns: int | None, answered: bool) -> None:
    watching = monitors(tick_ns=AT_NS, began_ns=None if for_ns is None else AT_NS - for_ns)
    assert watching.confirms_positions == answered
    assert not changed(watching, tick_ns=None).confirms_positions


# What is compared how


@pytest.mark.parametrize(
    ("bound_mps", "unexplained_mps2", "apart_ns", "since_ns", "breached"),
    [
        (EXACT_MPS, 0.0, None, None, False),
        (EXACT_MPS, 0.0, 1, None, False),
        (just_less(EXACT_MPS), 0.0, None, AT_NS, False),
        (just_less(EXACT_MPS), 0.0, AT_NS - 100 * MS + 1, AT_NS - 100 * MS + 1, False),
        (just_less(EXACT_MPS), 0.0, AT_NS - 100 * MS, AT_NS - 100 * MS, True),
        (just_less(EXACT_MPS), 0.0, AT_NS - 150 * MS, AT_NS - 150 * MS, True),
        (just_less(EXACT_MPS), 0.8, None, AT_NS, False),
        (just_less(EXACT_MPS), just_more(0.8), None, AT_NS, True),  # the observer too has a hint
        (EXACT_MPS, 1.0, None, None, False),
        (EXACT_MPS / 1.5, 0.0, None, AT_NS, True),
        (just_more(EXACT_MPS / 1.5), 0.0, None, AT_NS, False),
    ],
)
def test_velocities_that_contradict_each_other_have_to_persist_unless_it_is_plain(
    bound_mps: float, unexplained_mps2: float, apart_ns: int | None, since_ns: int | None, breached: bool
) -> None:
    parameters = replace(PARAMETERS, disagreement_mps=bound_mps)
    # The position is a little off where something is unexplained: so are the offsets.
    s = LOOK_NS * 1e-9
    place = s * -(s * unexplained_mps2) + 0.5 * s * s * unexplained_mps2
    known = offsets(EXACT_MPS, place_m=place, apart_ns=apart_ns)
    watching, breach = look((unexplained_mps2, 0.0, 0.0), vehicle_motion=AT_REST, parameters=parameters, **known)
    assert watching.velocity.apart_mps == EXACT_MPS
    assert watching.velocity.apart_ns == since_ns
    assert watching.velocity.is_contradicted == (since_ns is not None)
    assert (None if breach is None else breach.cause) == (EventCode.VELOCITY if breached else None)


def test_the_way_is_known_between_ticks_and_not_before_the_first() -> None:
    for captured_ns, known in ((START_NS, False), (START_NS + 1, True), (AT_NS, True)):
        state = monitors(vehicle_path=((START_NS, ZERO),))
        watching, _ = update(state, seen(AT_NS, sample(captured_ns, AT_NS), vehicle_motion=AT_REST), PARAMETERS)
        assert [at for at, _ in watching.velocity.offsets] == [captured_ns] * known


def test_the_way_is_not_known_after_the_last_tick() -> None:
    way = tuple((START_NS - n * MS, ZERO) for n in range(300, -1, -1))
    after = sample(AT_NS + 1, AT_NS + 1)
    watching, _ = update(monitors(vehicle_path=way), seen(AT_NS, after, vehicle_motion=AT_REST), PARAMETERS)
    assert len(watching.motion.vehicle_path) == 302 and watching.velocity.offsets == ()


def test_the_way_is_remembered_for_three_seconds() -> None:
    way = tuple((at, ZERO) for at in (AT_NS - 3 * SECOND_NS, AT_NS - 3 * SECOND_NS + 1, START_NS))
    watching, _ = update(monitors(vehicle_path=way), seen(AT_NS, vehicle_motion=AT_REST), PARAMETERS)
    assert [at for at, _ in watching.motion.vehicle_path] == [AT_NS - 3 * SECOND_NS + 1, START_NS, AT_NS]


@pytest.mark.parametrize(
    ("words", "known"),
    [
        (None, False),
        (VehicleMotion(), False),
        (VehicleMotion(velocity_mps=ZERO), False),
        (VehicleMotion(velocity_ns=AT_NS), False),
        (motion(ZERO, AT_NS - 300 * MS), True),
        (motion(ZERO, AT_NS - 300 * MS - 1), False),
        (motion((0.0, math.nan, 0.0), AT_NS), False),
        (motion((0.0, 0.0, math.inf), AT_NS), False),
    ],
)
def test_a_vehicle_that_says_nothing_of_late_is_not_compared(words: VehicleMotion | None, known: bool) -> None:
    watching, _ = look(ZERO, vehicle_motion=words, **offsets(0.125))
    assert (watching.velocity.apart_mps is not None) == (len(watching.velocity.offsets) == 3) == known
    assert len(watching.motion.vehicle_path) == (3 if known else 0)
    ours = structs.replace(seen(AT_NS, vehicle_motion=words), velocity_mps=ZERO)
    assert (trusted_velocity(watching, ours, 0.0, PARAMETERS) is not None) == known


@pytest.mark.parametrize(("gap_ns", "known"), [(300 * MS, True), (300 * MS + 1, False)])
def test_how_far_it_flew_in_ticks_that_were_missed_is_not_known(gap_ns: int, known: bool) -> None:
    before = offsets(0.0, vehicle_path=((AT_NS - gap_ns, (1.0, 2.0, 3.0)),))
    watching, _ = look(ZERO, vehicle_motion=motion((1.0, 0.0, 0.0), AT_NS), **before)
    assert watching.motion.vehicle_path[-1][0] == AT_NS
    assert watching.motion.vehicle_path[-1][1] == ((1.0 + 0.3, 2.0, 3.0) if known else ZERO)
    assert [at for at, _ in watching.motion.vehicle_path[:-1]] == [AT_NS - gap_ns] * known
    assert len(watching.velocity.offsets) == (3 if known else 0)


@pytest.mark.parametrize(
    ("own", "known", "age_s", "contradicted", "believed"),
    [
        ((0.25, 0.0, 0.0), ZERO, 0.0, False, True),
        ((just_more(0.25), 0.0, 0.0), ZERO, 0.0, False, False),
        ((0.0, -0.26, 0.0), ZERO, 0.0, False, False),
        ((0.0, 0.0, 1.5), (0.0, 0.0, 1.3), 0.0, False, True),
        ((0.84, 0.0, 0.0), ZERO, 1.0, False, True),  # 0.25 and 0.3 of 2 m/s² for a second
        ((0.86, 0.0, 0.0), ZERO, 1.0, False, False),
        ((0.0, 0.0, 0.0), ZERO, 0.0, True, False),
        ((9.0, 9.0, 0.1), (math.nan, math.nan, 0.0), 0.0, False, True),
        ((9.0, 9.0, 0.3), (math.nan, math.nan, 0.0), 0.0, False, False),
        ((9.0, 9.0, 9.0), NAN3, 0.0, False, True),
    ],
)
def test_which_own_velocity_may_be_braked_on(
    own: Vec3, known: Vec3, age_s: float, contradicted: bool, believed: bool
) -> None:
    ours = structs.replace(seen(AT_NS, vehicle_motion=motion(own, AT_NS)), velocity_mps=known)
    watching = monitors(is_contradicted=contradicted)
    assert trusted_velocity(watching, ours, age_s, PARAMETERS) == (own if believed else None)


@pytest.mark.parametrize(
    ("agreed_ns", "wrong_ns", "believed"),
    [(AT_NS - 300 * MS, None, True), (AT_NS - 300 * MS - 1, None, False), (None, None, False), (AT_NS, AT_NS, False)],
)
def test_an_own_velocity_that_inertial_data_support_is_believed_against_positions(
    agreed_ns: int | None, wrong_ns: int | None, believed: bool
) -> None:
    ours = structs.replace(seen(AT_NS, vehicle_motion=motion((0.5, 0.0, 0.0), AT_NS)), velocity_mps=ZERO)
    watching = structs.replace(
        monitors(is_contradicted=True),
        velocity_change=VelocityChangeState(agreed_ns=agreed_ns, supported_ns=agreed_ns, velocity_wrong_ns=wrong_ns),
    )
    assert trusted_velocity(watching, ours, 0.0, PARAMETERS) == ((0.5, 0.0, 0.0) if believed else None)


@pytest.mark.fault(42)
@pytest.mark.parametrize(
    ("silence_ms", "for_ms", "found"),
    [
        (4000, 500, False),  # what positions correct after a silence
        (1050, 500, False),
        (900, 500, True),  # it has hardly flown without them
        (4000, 9000, True),  # they move otherwise for good
    ],
)
def test_the_first_second_of_positions_after_a_silence_corrects_the_vehicle_s_own_velocity(
    silence_ms: int, for_ms: int, found: bool
) -> None:
    """At rest by its positions; by its own word it moves at 1.5 times what is allowed from their return on."""
    parameters = replace(PARAMETERS, unexplained_mps2=100.0)
    watching, found_ms = INITIAL, []
    back_ms = 3000 + silence_ms
    for now_ms in range(0, back_ms + 3000, 50):
        at_ns = START_NS + now_ms * MS
        moves = back_ms <= now_ms < back_ms + for_ms
        own = motion((1.5 * PARAMETERS.disagreement_mps if moves else 0.0, 0.0, 0.0), at_ns)
        taken = () if 3000 < now_ms < back_ms else (sample(at_ns, at_ns, ZERO),)
        watching, breach = update(watching, seen(at_ns, *taken, vehicle_motion=own), parameters)
        if breach is not None:
            assert breach.cause == EventCode.VELOCITY
            found_ms.append(now_ms - back_ms)
    assert bool(found_ms) == found
    if found:
        # Offsets over 0.36 s, three tenths of the window of comparison, begin after that second.
        late_ms = 1360 if silence_ms > 1000 else 0
        assert late_ms <= found_ms[0] <= late_ms + 1000


@pytest.mark.fault(100)
@pytest.mark.parametrize("std_m", [0.012, 0.0121, 0.05])
def test_noise_bounds_the_slope_that_chance_makes(std_m: float) -> None:
    """Four standard deviations of a slope by least squares over 0, 0.25 and 0.5 s."""
    three = tuple((START_NS + ms * MS, ZERO) for ms in (0, 250, 500))
    usual_m = 0.012
    slope_mps = 4.0 * std_m / math.sqrt(2.0 * 0.25**2) if std_m > usual_m else 0.0
    assert velocity._bound_noise_mps(three, std_m) == pytest.approx(slope_mps)


@pytest.mark.parametrize(("late_s", "found_s"), [(0.2, 0.2), (0.0, 0.0), (-0.1, 0.0), (0.5, 0.3)])
def test_one_delay_explains_all_places_of_a_frame_that_drifts(late_s: float, found_s: float) -> None:
    """Offsets are a constant, a drift, and the delay times the velocity: o = b + d t - τ v."""
    rng, times_s = np.random.default_rng(4), np.array([0.0, 1.0, 2.5, 3.0, 4.25])
    velocities, drift = rng.normal(0.0, 1.0, (5, 3)), np.array([0.3, -0.2, 0.1])
    points = np.array([1.0, 2.0, -1.0]) + np.outer(times_s, drift) - late_s * velocities
    places = tuple(
        (START_NS + round(s * 1e9), vec3(point), vec3(v))
        for s, point, v in zip(times_s, points, velocities, strict=True)
    )
    aligned = velocity._align(places)
    assert aligned is not None and aligned[0] == pytest.approx(found_s, abs=1e-9)
    np.testing.assert_allclose(aligned[1], points + found_s * velocities, atol=1e-8)
    assert velocity._align(places[:3]) is None and velocity._align(places[:4]) is not None


def test_the_step_of_a_tick_and_the_mean_velocity_are_differences_of_distances() -> None:
    path = tuple((START_NS + k * MS, (float(k * k), 0.0, 1.0)) for k in range(3))
    steps = [velocity._find_step(path, START_NS + k * MS) for k in range(4)]
    assert steps == [ZERO, (1.0, 0.0, 0.0), (3.0, 0.0, 0.0), ZERO]
    assert velocity._find_mean_velocity((1.0, 2.0, 3.0), (2.0, 4.0, 2.0), 0.5) == (2.0, 4.0, -2.0)
    assert velocity._find_mean_velocity(None, (2.0, 4.0, 2.0), 0.5) == ZERO
    assert velocity._find_mean_velocity((2.0, 4.0, 2.0), None, 0.5) == ZERO


def test_a_delay_explains_a_change_of_offsets_by_any_change_of_the_velocity() -> None:
    assert velocity._bound_delay_s([-0.05, 1.0, 0.0], [0.5, 0.0, 0.0]) == pytest.approx(0.1)
    assert velocity._bound_delay_s([-0.05, 1.0, 0.0], [0.0, 0.0, 0.0]) == 0.0


def test_what_a_delay_leaves_may_be_as_large_as_the_bound() -> None:
    within_m = (2.0 + 0.16) * PARAMETERS.disagreement_mps
    places = ((START_NS - SECOND_NS, ZERO, (0.0, -1.0, 0.0)),)
    for off_m, breached in ((within_m, False), (just_more(within_m), True)):
        now = (off_m, -0.25, 0.0)  # 0.25 s late: the velocity has changed by 1 m/s
        drift, *_ = velocity._find_drift(
            VelocityState(places=places), ((START_NS, now),), np.array([now]), ZERO, believed(ZERO)
        )
        assert (drift is not None) == breached


@pytest.mark.parametrize("first_age_s", [29.0, 31.0])
def test_the_delay_of_all_places_counts_now_and_is_found_anew_once_one_is_too_old(first_age_s: float) -> None:
    """Offsets follow the velocity 0.2 s late; at 5 m/s that is more than the bound."""
    ages_s, speeds = (first_age_s, 5.0, 4.0, 3.0, 2.0), (4.0, 1.0, -1.0, 2.0, 0.0)
    places = tuple(
        (START_NS - round(age_s * 1e9), (-0.2 * v, 0.0, 0.0), (v, 0.0, 0.0))
        for age_s, v in zip(ages_s, speeds, strict=True)
    )
    kept, now, flown = places if first_age_s < 30.0 else places[1:], (-1.0, 0.0, 0.0), (5.0, 0.0, 0.0)
    state = VelocityState(places=places, aligned=velocity._align(places))
    drift, after, _ = velocity._find_drift(state, ((START_NS, now),), np.array([now]), flown, believed(ZERO))
    assert drift is None and after[: len(kept)] == kept
    # Another delay that is known, 0.1 s, counts as long as no place is too old.
    state = structs.replace(state, aligned=(0.1, [[0.0, 0.0, 0.0]] * 5))
    strict = believed(ZERO, replace(PARAMETERS, disagreement_mps=0.01))
    drift, *_ = velocity._find_drift(state, ((START_NS, now),), np.array([now]), flown, strict)
    assert (drift is None) == (first_age_s > 30.0)
    assert drift is None or drift[1] == pytest.approx([-1.0 + 0.1 * 5.0, 0.0, 0.0])


@pytest.mark.parametrize(("std_m", "contradicts"), [(0.012, True), (0.05, False)])
def test_noise_that_may_make_a_difference_is_no_contradiction(std_m: float, contradicts: bool) -> None:
    flown = ((AT_NS - 500 * MS, (-0.15, 0.0, 0.0)), (AT_NS - 250 * MS, (-0.075, 0.0, 0.0)))
    state, path = VelocityState(offsets=flown), ((AT_NS - 600 * MS, ZERO), (AT_NS + MS, ZERO))
    observer = Observer(AT_NS, np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3))
    position = PositionObservation(
        AT_NS, np.zeros(3), False, False, Motion(vehicle_path=path), observer, seen(AT_NS), PARAMETERS, std_m
    )
    after, _ = velocity.update(state, position)
    assert after.apart_mps == pytest.approx(0.3) and after.is_contradicted == contradicts
    # With too few offsets the delay that is known is kept with its places.
    aligned = (0.1, [[0.0, 0.0, 0.0]])
    few = VelocityState(offsets=state.offsets[1:], places=((AT_NS - SECOND_NS, ZERO, ZERO),), aligned=aligned)
    assert velocity.update(few, position)[0].aligned == aligned
