"""The rules by which a delay of positions is found: closed forms, bounds, and what is noted of the own velocity."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flight_rig import MS, START_NS
from msgspec.structs import replace

from uavctl.arrays import SECOND_NS, Array
from uavctl.flight.monitors import smoothing
from uavctl.flight.monitors.smoothing import DelayChange, SmoothingTrack
from uavctl.records import Vec3, VehicleMotion

TICK_NS = 50 * MS
ZEROS = (0.0, 0.0, 0.0)


def moving(at_ns: int, velocity: Vec3) -> VehicleMotion:
    return VehicleMotion(velocity_mps=velocity, velocity_ns=at_ns, attitude_rad=None, attitude_ns=None)


def note(velocity: Callable[[float], Vec3], seconds: float, track: SmoothingTrack | None = None) -> SmoothingTrack:
    """Own velocities as a function of time, from `START_NS` on."""
    track = track or SmoothingTrack()
    for tick in range(round(seconds * 1e9 / TICK_NS) + 1):
        at_s = tick * TICK_NS * 1e-9
        track = smoothing.note_velocity(track, moving(START_NS + tick * TICK_NS, velocity(at_s)))
    return track


# --- the own velocity ------------------------------------------------------------------------------------------------


def test_a_steady_velocity_is_its_own_filter_and_its_distance_grows_with_time() -> None:
    """Constant v: v_f = v, s = v t; also beyond the newest velocity."""
    track = replace(note(lambda _: (1.5, -0.5, 0.25), 2.0), late_s=0.2)
    for at_s in (0.0, 0.73, 2.0, 2.2):
        at_ns = START_NS + round(at_s * 1e9)
        # A first order of 0.2 s, and a pure delay of as much, are both 0.2 s v behind.
        assert track.compute_lag_m(at_ns) == pytest.approx((0.3, -0.1, 0.05))
        assert DelayChange(0.2, track.flown).shift(at_ns)[1] == pytest.approx(ZEROS, abs=1e-12)
    times_s = [(at_ns - START_NS) * 1e-9 for at_ns, *_ in track.flown]
    distances_m = [distance for *_, distance in track.flown]
    assert np.array(distances_m) == pytest.approx(np.outer(times_s, (1.5, -0.5, 0.25)), abs=1e-9)


def test_a_velocity_that_grows_steadily_is_filtered_with_the_time_constant() -> None:
    """v = a t: s = a t² / 2, and a first order makes v_f = a (t - T + T e^(-t/T)); steps of Δt leave a Δt² / 12 T."""
    track = note(lambda at_s: (2.0 * at_s, 0.0, -1.0 * at_s), 2.0)
    for at_ns, velocity, filtered, distance in track.flown:
        at_s = (at_ns - START_NS) * 1e-9
        behind_s = at_s - 0.2 + 0.2 * math.exp(-at_s / 0.2)
        assert velocity == pytest.approx((2.0 * at_s, 0.0, -at_s))
        assert filtered == pytest.approx((2.0 * behind_s, 0.0, -behind_s), abs=2.1e-3)
        assert distance == pytest.approx((at_s**2, 0.0, -0.5 * at_s**2), abs=1e-9)


def test_what_is_added_beyond_the_newest_velocity_is_as_if_that_went_on() -> None:
    """The next velocity, were it the same, gives the same v_f and distance."""
    track = note(lambda at_s: (math.sin(3.0 * at_s), at_s, 0.0), 1.0)
    last_ns, velocity, *_ = track.flown[-1]
    later_ns = last_ns + 120 * MS
    after = smoothing.note_velocity(track, moving(later_ns, velocity))
    for before in (track, after):
        assert replace(before, late_s=1.0).compute_lag_m(later_ns) == pytest.approx(after.flown[-1][2], abs=1e-12)
    shown = [smoothing.update(replace(one, seen_ns=later_ns - 1), later_ns, ZEROS).changes for one in (track, after)]
    assert np.array(shown[0][0][1:]) == pytest.approx(np.array(shown[1][0][1:]), abs=0.01)
    assert shown[0][0][1] == pytest.approx([-way for way in shown[0][0][3]])


def test_between_two_velocities_all_is_on_the_line_between_them() -> None:
    before, after = (
        (START_NS, (1.0, 0.0, 0.0), (0.0, 2.0, 0.0), ZEROS),
        (START_NS + 40 * MS, (3.0, 0.0, 1.0), (4.0, 2.0, -4.0), (0.08, 0.0, 0.0)),
    )
    flown = before, after
    change = DelayChange(0.5, flown)
    # A quarter of the way: v (1.5, 0, 0.25), v_f (1, 2, -1)
    assert change.shift(START_NS + 10 * MS)[0] == pytest.approx((0.5, 1.0, -0.5))
    # δ (v - v_f) / T
    assert change.shift(START_NS + 10 * MS)[1] == pytest.approx((0.5 * 0.5 / 0.2, -0.5 * 2.0 / 0.2, 0.5 * 1.25 / 0.2))
    assert change.shift(START_NS)[0] == (0.0, 1.0, 0.0)
    assert change.shift(START_NS - 1) == (ZEROS, ZEROS)
    assert DelayChange(0.5, ()).shift(START_NS) == (ZEROS, ZEROS)
    # A place before the first own velocity moves by that one.
    early = SmoothingTrack(flown=flown, late_s=0.5)
    assert early.compute_lag_m(START_NS - SECOND_NS) == early.compute_lag_m(START_NS) == (0.0, 1.0, 0.0)


def test_a_silence_of_the_own_velocity_begins_its_record_again() -> None:
    """Distances across a longer silence than its velocity counts for are not known."""
    track = smoothing.note_velocity(SmoothingTrack(), moving(START_NS, (1.0, 0.0, 0.0)))
    track = replace(track, changes=((START_NS, ZEROS, ZEROS, ZEROS),))
    silence_ns = 300 * MS
    on = smoothing.note_velocity(track, moving(START_NS + silence_ns, (1.0, 0.0, 0.0)))
    assert len(on.flown) == 2 and on.changes == track.changes
    for at_ns in (START_NS + silence_ns + 1, START_NS - 1):
        again = smoothing.note_velocity(track, moving(at_ns, (2.0, 0.0, 0.0)))
        assert again.flown == ((at_ns, (2.0, 0.0, 0.0), (2.0, 0.0, 0.0), ZEROS),) and again.changes == ()


def test_velocities_are_kept_for_as_long_as_positions_may_come_late() -> None:
    old = SmoothingTrack()
    for at_ns in (START_NS, START_NS + 1, *range(START_NS + 250 * MS, START_NS + 2_500 * MS, 250 * MS)):
        old = smoothing.note_velocity(old, moving(at_ns, (1.0, 0.0, 0.0)))
    kept = smoothing.note_velocity(old, moving(START_NS + 2_500 * MS, (1.0, 0.0, 0.0)))
    assert kept.flown[0][0] == START_NS + 1 and kept.flown[-1][0] == START_NS + 2_500 * MS
    assert len(kept.flown) == len(old.flown)


# --- which positions are compared ------------------------------------------------------------------------------------


def look(*times_ns: int, begin: SmoothingTrack | None = None) -> SmoothingTrack:
    """Positions at some times after a start; own velocities, which turn, are known at all."""
    flown = note(lambda at_s: (math.sin(3.0 * at_s), math.cos(2.0 * at_s), 0.0), 2.4).flown
    track = begin or SmoothingTrack(flown=flown, seen_ns=START_NS - 1, resumed_ns=START_NS - SECOND_NS)
    for since_ns in times_ns:
        track = smoothing.update(track, START_NS + since_ns, (0.1, 0.2, 0.3))
    return track


def test_the_first_position_and_those_of_a_second_after_it_show_nothing() -> None:
    begin = SmoothingTrack(flown=look().flown)
    assert look(0, begin=begin).resumed_ns == START_NS
    first = look(0, SECOND_NS - 1, begin=begin)
    assert first.resumed_ns == START_NS and first.seen_ns == START_NS + SECOND_NS - 1 and first.changes == ()
    assert len(look(0, SECOND_NS, begin=begin).changes) == 1


def test_a_clock_may_begin_at_zero() -> None:
    rest = ZEROS, ZEROS, ZEROS
    begin = SmoothingTrack(flown=((0, *rest), (2 * SECOND_NS, *rest)))
    assert len(smoothing.update(begin, SECOND_NS, ZEROS).changes) == 1
    assert len(smoothing.update(replace(begin, resumed_ns=-SECOND_NS), 1, ZEROS).changes) == 1


def test_a_silence_is_longer_than_a_second() -> None:
    assert look(0, SECOND_NS).resumed_ns == START_NS - SECOND_NS and look(0, SECOND_NS).changes
    after = look(0, SECOND_NS + 1)
    assert after.resumed_ns == START_NS + SECOND_NS + 1 and after.changes == ()


def test_positions_are_compared_over_half_a_second() -> None:
    assert [at_ns - START_NS for at_ns, *_ in look(0, 500 * MS).changes] == [0, 500 * MS]
    assert [at_ns - START_NS for at_ns, *_ in look(0, 500 * MS + 1).changes] == [500 * MS + 1]
    assert not look(0, 350 * MS - 1).sums[0] and look(0, 350 * MS).sums[0] == 1.0


def test_positions_without_an_own_velocity_at_their_time_show_nothing() -> None:
    track = look()
    first_ns, last_ns = track.flown[0][0], track.flown[-1][0]
    known = replace(track, resumed_ns=first_ns - 2 * SECOND_NS)
    for at_ns, is_known in (
        (first_ns, True),
        (first_ns - 1, False),
        (last_ns + 300 * MS, True),
        (last_ns + 300 * MS + 1, False),
    ):
        before = replace(known, seen_ns=at_ns - 1)
        assert bool(smoothing.update(before, at_ns, ZEROS).changes) == is_known
    nothing = replace(known, flown=(), changes=((first_ns, ZEROS, ZEROS, ZEROS),))
    assert smoothing.update(nothing, first_ns + 1, ZEROS).changes == ()


def add(sums: tuple[float, ...], change_mps: Vec3, since_ns: int) -> tuple[float, ...]:
    """The sums after one change: v_f by what is given, distance by (0.5, 0.25, -1), place by (0.25, 0.5, -0.5)."""
    off, speed, way = np.array([1.0, -1.0, 0.5]), np.array([0.0, 0.25, -1.0]), np.array([2.0, 0.0, 4.0])
    now_ns = START_NS + 400 * MS
    speed_now, way_now = np.add(speed, change_mps), np.add(way, (0.5, 0.25, -1.0))
    rest: Any = tuple(speed.tolist()), tuple(speed.tolist()), tuple(way.tolist())
    now: Any = tuple(speed_now.tolist()), tuple(speed_now.tolist()), tuple(way_now.tolist())
    track = SmoothingTrack(
        flown=((START_NS, *rest), (now_ns, *now)),
        changes=((START_NS, tuple(off.tolist()), *rest[1:]),),
        sums=sums,
        seen_ns=now_ns - since_ns,
        resumed_ns=START_NS - SECOND_NS,
    )
    north, east, down = (off + way + (0.25, 0.5, -0.5)).tolist()
    return smoothing.update(track, now_ns, (north, east, down)).sums


def test_the_sums_are_those_of_changes_and_their_products() -> None:
    """Δv_f (1, 2, 0), Δs (0.5, 0.25, -1), Δo = Δp - Δs = (-0.25, 0.25, 0.5)."""
    speed, off, way = (1.0, 2.0, 0.0), (-0.25, 0.25, 0.5), (0.5, 0.25, -1.0)
    products = 5.0, 0.25, 0.375, 1.3125, -0.5625  # v_f v_f, o v_f, o o, s s, o s
    assert add((0.0,) * 15, speed, 50 * MS) == (1.0, *speed, *off, *way, *products)


@pytest.mark.parametrize(("since_ns", "counted_s"), [(50 * MS, 0.05), (500 * MS, 0.5), (900 * MS, 0.5)])
def test_older_changes_are_forgotten_over_five_seconds_of_new_ones(since_ns: int, counted_s: float) -> None:
    """A silence of positions makes nothing older: it shows nothing new."""
    new, both = add((0.0,) * 15, (1.0, 2.0, 0.0), since_ns), add((8.0,) * 15, (1.0, 2.0, 0.0), since_ns)
    assert np.subtract(both, new) == pytest.approx(np.full(15, 8.0 * math.exp(-counted_s / 5.0)))


def test_changes_of_less_than_a_tenth_of_a_metre_per_second_show_nothing() -> None:
    sums = (1.0,) * 15
    assert add(sums, (0.06, 0.079, 0.0), 50 * MS) is sums
    assert add(sums, (0.1, 0.0, 0.0), 50 * MS) != sums


# --- what is believed ------------------------------------------------------------------------------------------------


def add_up(speed: Array, off: Array, way: Array) -> tuple[float, ...]:
    """Sums over changes (n, 3) of v_f, offset and distance."""
    pairs = (speed, speed), (off, speed), (off, off), (way, way), (off, way)
    return (
        float(len(speed)),
        *np.sum(speed, axis=0).tolist(),
        *np.sum(off, axis=0).tolist(),
        *np.sum(way, axis=0).tolist(),
        *(float(np.sum(a * b)) for a, b in pairs),
    )


def estimate(delay_s: float, left: float, left_by_frame: float, late_s: float = 0.0, speed_2: float = 1.0) -> float:
    """The delay that is believed where smoothing leaves one part of the offsets' squares, and a frame another."""
    # Σ Δo² = q: smoothing takes away (Σ Δo' Δv_f)² / Σ |Δv_f|² = (1 - left) q, so that Σ Δo' Δv_f = -τ Σ |Δv_f|².
    off_2 = delay_s**2 * speed_2 / (1.0 - left)
    off_way = math.sqrt((1.0 - left_by_frame) * off_2)
    sums = 1.0, *(0.0,) * 9, speed_2, -delay_s * speed_2, off_2, 1.0, off_way
    return smoothing._estimate_delay_s(sums, late_s)


RNG = np.random.default_rng(8)


@pytest.mark.parametrize("delay_s", [0.06, 0.2, 0.34])
def test_the_delay_is_the_least_squares_fit_of_offsets_through_their_means(delay_s: float) -> None:
    """Against numpy's own fit, with a drift and noise."""
    speed, way = RNG.normal(size=(40, 3)), RNG.normal(size=(40, 3))
    off = -delay_s * speed + np.array([0.5, -0.3, 0.2]) + 0.01 * RNG.normal(size=(40, 3))
    centred = [(values - values.mean(axis=0)).ravel() for values in (speed, off)]
    fit, *_ = np.linalg.lstsq(centred[0][:, np.newaxis], centred[1], rcond=None)
    found_s = smoothing._estimate_delay_s(add_up(speed, off, way), 0.0)
    assert found_s == pytest.approx(-fit[0], rel=1e-9) and found_s == pytest.approx(delay_s, abs=0.01)


def test_a_drift_alone_is_no_delay() -> None:
    """The same change of the offset at all times, while the vehicle turns and while it flies one way."""
    way = RNG.normal(size=(40, 3))
    for mean in (ZEROS, (1.0, 1.0, 0.0)):
        speed = np.array(mean) + RNG.normal(size=(40, 3))
        off = np.tile((-0.2, -0.2, 0.0), (40, 1)) + 1e-4 * RNG.normal(size=(40, 3))
        assert smoothing._estimate_delay_s(add_up(speed, off, way), 0.0) == 0.0


def test_another_unit_is_no_delay_though_the_vehicle_flies_to_and_fro() -> None:
    """Offsets in proportion to the distance; smoothing would leave a tenth, such a frame leaves nothing."""
    way = RNG.normal(size=(40, 3))
    way -= way.mean(axis=0)
    speed = way + 0.3 * RNG.normal(size=(40, 3))
    assert smoothing._estimate_delay_s(add_up(speed, -0.2 * way, way), 0.0) == 0.0
    assert smoothing._estimate_delay_s(add_up(speed, -0.2 * speed, way), 0.0) == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("arguments", "is_believed"),
    [
        ({"delay_s": 0.049}, False),
        ({"delay_s": 0.051}, True),
        ({"delay_s": 0.349}, True),
        ({"delay_s": 0.351}, False),
        ({"delay_s": -0.2}, False),
        ({"left": 0.19}, True),
        ({"left": 0.21}, False),
        ({"left": 0.49, "late_s": 0.05}, True),
        ({"left": 0.51, "late_s": 0.05}, False),
        ({"left": 0.19, "left_by_frame": 0.39}, True),
        ({"left": 0.19, "left_by_frame": 0.37}, False),
        ({"left": 0.4, "left_by_frame": 0.79, "late_s": 0.05}, False),
        ({"left": 0.4, "left_by_frame": 0.81, "late_s": 0.05}, True),
        ({"speed_2": 1.01}, True),
        ({"speed_2": 0.99}, False),
    ],
)
def test_a_delay_is_believed_within_its_bounds(arguments: dict[str, Any], is_believed: bool) -> None:
    given = {"delay_s": 0.2, "left": 0.1, "left_by_frame": 1.0, **arguments}
    assert estimate(**given) == pytest.approx(given["delay_s"] if is_believed else 0.0)


def test_what_is_just_at_a_bound_is_believed() -> None:
    """Numbers without rounding: Σ |Δv_f|² = 1, Σ |Δo|² = 5 (or 2) times what smoothing leaves."""
    none = (0.0,) * 9
    for delay_s in (0.05, 0.35):
        assert smoothing._estimate_delay_s((1.0, *none, 1.0, -delay_s, delay_s**2, 1.0, 0.0), 0.0) == delay_s
    # (1/4)² 64 = 4 of 5 squares are explained, 1 is left.
    assert smoothing._estimate_delay_s((1.0, *none, 64.0, -16.0, 5.0, 1.0, 0.0), 0.0) == 0.25
    # 4 of 8; a frame leaves 8.
    assert smoothing._estimate_delay_s((1.0, *none, 64.0, -16.0, 8.0, 1.0, 0.0), 0.1) == 0.25
    # 4 of 5; a frame leaves 2.
    assert smoothing._estimate_delay_s((1.0, *none, 64.0, -16.0, 5.0, 3.0, 3.0), 0.0) == 0.25


def test_nothing_is_estimated_from_nothing() -> None:
    assert smoothing._estimate_delay_s((0.0,) * 15, 0.0) == 0.0
    still = 1.0, *(0.0,) * 9, 64.0, -16.0
    assert smoothing._estimate_delay_s((*still, 0.0, 1.0, 0.0), 0.0) == 0.0
    assert smoothing._estimate_delay_s((*still, 4.0, 0.0, 0.0), 0.0) == 0.0
    assert smoothing._estimate_delay_s((*still, 4.0, 1e-9, 0.0), 0.0) == 0.25


# --- what counts -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("estimated_s", "counts"), [(0.129, False), (0.131, True), (0.071, False), (0.069, True)])
def test_a_delay_counts_anew_where_it_differs_by_three_hundredths(estimated_s: float, counts: bool) -> None:
    track = replace(note(lambda _: (1.0, 0.0, 0.0), 1.0), late_s=0.1, estimated_s=estimated_s)
    after, change = smoothing.adopt(track)
    assert after.late_s == (estimated_s if counts else 0.1)
    assert (change is None) != counts
    if change is not None:
        assert change.change_s == pytest.approx(estimated_s - 0.1) and change.flown == track.flown


def test_the_least_change_counts() -> None:
    assert smoothing.adopt(SmoothingTrack(estimated_s=0.03))[0].late_s == 0.03


def test_what_is_forgotten_leaves_no_change_where_no_delay_counted() -> None:
    track = replace(note(lambda _: (1.0, 0.0, 0.0), 1.0), estimated_s=0.2)
    assert smoothing.forget(track) == (SmoothingTrack(), None)


def test_before_any_own_velocity_nothing_is_added() -> None:
    assert SmoothingTrack(late_s=0.2).compute_lag_m(START_NS) == ZEROS


# --- whole flights ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("late_s", [0.1, 0.2, 0.3])
def test_a_first_order_of_the_filter_and_a_pure_delay_are_measured(late_s: float) -> None:
    """Without noise, on a circle: a constant delay T is found as T to a twentieth of 0.2 s, a first order exactly."""
    w, at = 1.5, np.arange(0.0, 6.0, 0.05)
    track, first = SmoothingTrack(), SmoothingTrack()
    for at_s in at.tolist():
        at_ns = START_NS + round(at_s * 1e9)
        v = (-w * math.sin(w * at_s), w * math.cos(w * at_s), 0.0)
        track, _ = smoothing.advance(track, moving(at_ns, v), at_ns)
        first, _ = smoothing.advance(first, moving(at_ns, v), at_ns)
        late = w * (at_s - late_s)
        track = smoothing.update(track, at_ns, (math.cos(late), math.sin(late), 0.0))
        # e^(jωt) / (1 + jωT)
        lagged = np.exp(1j * w * at_s) / (1.0 + 1j * w * 0.2)
        first = smoothing.update(first, at_ns, (float(lagged.real), float(lagged.imag), 0.0))
    assert track.estimated_s == pytest.approx(late_s, abs=0.02)
    assert first.estimated_s == pytest.approx(0.2, abs=0.005)


def test_an_own_velocity_that_lies_is_no_delay() -> None:
    """It says half of what is flown, or stands still: offsets are in proportion to the distance, or to nothing."""
    w = 1.5
    for part in (0.5, 0.0, -1.0):
        track = SmoothingTrack()
        for tick in range(120):
            at_s = tick * 0.05
            at_ns = START_NS + tick * TICK_NS
            v = (-w * part * math.sin(w * at_s), w * part * math.cos(w * at_s), 0.0)
            track, _ = smoothing.advance(track, moving(at_ns, v), at_ns)
            track = smoothing.update(track, at_ns, (math.cos(w * at_s), math.sin(w * at_s), 0.0))
        assert track.late_s == track.estimated_s == 0.0
