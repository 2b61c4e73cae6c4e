"""Noise of positions, and jumps between two solutions of a camera system, by the monitors of single samples."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from envelope_rig import just_more
from hypothesis import given
from hypothesis import strategies as st

from uavctl.flight.monitors import jumps, noise
from uavctl.flight.monitors.jumps import MAX_SHIFT_M, JumpTrack, Outcome
from uavctl.flight.monitors.noise import NoiseTrack
from uavctl.records import PositionSample, Vec3

STEP_NS = 50_000_000
SPREAD = np.full(3, 0.01)
JUMP: Vec3 = (0.2, -0.1, 0.0)
NONE: Vec3 = (0.0, 0.0, 0.0)


def make_sample(at_ns: int, position_m: Vec3) -> PositionSample:
    return PositionSample(
        captured_ns=at_ns, received_ns=at_ns, position_m=position_m, std_m=0.005, source="test", seq=0
    )


def measure_noise(offsets_m: np.ndarray, *, step_ns: int = STEP_NS, accel_mps2: float = 0.0) -> NoiseTrack:
    """The track of a vehicle that accelerates north, with these offsets (n, 3)."""
    track = NoiseTrack()
    for n, offset_m in enumerate(offsets_m):
        at_ns = (n + 1) * step_ns
        north, east, down = offset_m.tolist()
        place: Vec3 = (north + 0.5 * accel_mps2 * (at_ns * 1e-9) ** 2, east, down)
        track = noise.update(track, make_sample(at_ns, place), at_ns)
    return track


@pytest.mark.parametrize("step_ns", [STEP_NS, 4 * STEP_NS])
@pytest.mark.parametrize("std_m", [0.02, 0.05])
def test_noise_is_measured(std_m: float, step_ns: int) -> None:
    rng = np.random.default_rng(1)
    sizes = [measure_noise(std_m * rng.standard_normal((30, 3)), step_ns=step_ns).std_m for _ in range(50)]
    assert np.median(sizes) == pytest.approx(std_m, rel=0.15)


@pytest.mark.parametrize(("count", "factor"), [(3, 3.8), (4, 2.3), (5, 1.8), (17, 1.0)])
def test_few_positions_may_have_shown_too_little_noise(count: int, factor: float) -> None:
    """Positions to and fro by 3 cm leave 3 cm / √1.5 as residuals: 1.6 cm as the noise of an axis."""
    offsets = np.zeros((count, 3))
    offsets[::2, 0] = 0.03
    track = measure_noise(offsets)
    assert track.std_m == pytest.approx(factor * 0.0159, rel=0.01)
    assert track.is_known == track.is_measured == (count > 4)
    assert measure_noise(offsets[:2]).std_m == measure_noise(0.6 * offsets).std_m == 0.0


def test_usual_noise_and_acceleration_change_nothing() -> None:
    rng = np.random.default_rng(2)
    for accel_mps2 in (0.0, 4.0):
        assert measure_noise(0.004 * rng.standard_normal((60, 3)), accel_mps2=accel_mps2).std_m == 0.0


def test_a_jump_and_a_few_outliers_are_no_noise() -> None:
    offsets = np.zeros((15, 3))
    offsets[5:, 0] = 0.3
    offsets[10] = 2.0
    assert measure_noise(offsets).std_m == 0.0


def test_noise_is_bounded_and_needs_positions_close_to_one_another() -> None:
    rng = np.random.default_rng(3)
    wild = rng.standard_normal((30, 3))
    assert measure_noise(wild).std_m == 0.1
    far = measure_noise(wild, step_ns=7 * STEP_NS)
    assert not far.is_measured and not far.is_known and far.std_m == 0.0


@pytest.mark.parametrize(
    ("times_ms", "counts"), [((0, 200, 400, 600), True), ((0, 250, 500, 900), True), ((0, 250, 500, 901), False)]
)
def test_far_from_its_neighbours_a_position_is_compared_with_a_parabola(
    times_ms: tuple[int, ...], *, counts: bool
) -> None:
    """The three others and one coefficient each: r = |p - Σ c_i p_i| / √(1 + Σ c_i²); a parabola leaves nothing."""
    times_s, off_m = 1e-3 * np.array(times_ms), 0.12
    paths = np.polynomial.polynomial.polyvander(times_s, 2) @ np.array(
        [[1.0, 2.0, 3.0], [0.5, -1.0, 0.0], [2.0, -3.0, 1.0]]
    )
    others = [0, 1, 3]
    coefficients = np.linalg.solve(np.vander(times_s[others], 3).T, np.vander(times_s[[2]], 3)[0])
    for moved_m in (0.0, off_m):
        track = NoiseTrack()
        for k, ms in enumerate(times_ms):
            north, east, down = (paths[k] + (moved_m * np.eye(3)[2] if k == 2 else 0.0)).tolist()
            track = noise.update(track, make_sample(1 + ms * 1_000_000, (north, east, down)), 1 + ms * 1_000_000)
        expected = (moved_m / math.sqrt(1.0 + float(coefficients @ coefficients)),)
        assert track.residuals_m[-1:] == pytest.approx(expected if counts else (), abs=1e-9)
        assert [at_ns for at_ns, _ in track.last] == [1 + ms * 1_000_000 for ms in times_ms[1:]]


@pytest.mark.parametrize(
    ("before_ms", "after_ms", "counts"), [(50, 50, True), (20, 80, True), (40, 250, True), (40, 251, False)]
)
def test_a_position_is_compared_with_the_line_between_its_neighbours(
    before_ms: int, after_ms: int, counts: bool
) -> None:
    """r = |p - p_line| / √(1 + (1 - c)² + c²), if both distances in time have a product of up to 0.01 s²."""
    c = before_ms / (before_ms + after_ms)
    begin, end, off = np.array([1.0, -2.0, 0.5]), np.array([2.0, 1.0, -1.0]), np.array([0.03, 0.04, 0.12])
    track = NoiseTrack()
    assert track.std_m == 0.0
    for ms, place in ((0, begin), (before_ms, (1.0 - c) * begin + c * end + off), (before_ms + after_ms, end)):
        north, east, down = place.tolist()
        track = noise.update(track, make_sample(1 + ms * 1_000_000, (north, east, down)), 1 + ms * 1_000_000)
    residual_m = 0.13 / math.sqrt(1.0 + (1.0 - c) ** 2 + c**2)
    assert track.residuals_m == pytest.approx((residual_m,) if counts else ())


def test_a_position_long_before_changes_no_line() -> None:
    track = NoiseTrack()
    for ms, up_m in ((0, 7.0), (5000, 0.0), (5050, 0.3), (5100, 0.0)):
        track = noise.update(track, make_sample(1 + ms * 1_000_000, (0.0, 0.0, up_m)), 1 + ms * 1_000_000)
    assert track.residuals_m == pytest.approx((0.3 / math.sqrt(1.5),)) and track.close_count == 1


def test_noise_counts_above_the_usual_one() -> None:
    usual_m = 0.012 * 1.538  # median length of a residual
    for residual_m, is_above in ((usual_m, False), (usual_m * (1.0 + 1e-12), True)):
        track = noise.update(NoiseTrack(residuals_m=(residual_m,) * 15), make_sample(1, NONE), 1)
        assert track.std_m == pytest.approx(0.012 if is_above else 0.0)


@given(st.lists(st.tuples(st.integers(1, 40), st.floats(-0.2, 0.2)), min_size=10, max_size=40))
def test_positions_that_come_twice_or_too_late_are_no_noise(arrivals: list[tuple[int, float]]) -> None:
    """The noise is that of the positions that are newer than all before."""
    every, newer, newest = NoiseTrack(), NoiseTrack(), 0
    for step, north in arrivals:
        sample = make_sample(step * STEP_NS, (north, 0.0, 0.0))
        every = noise.update(every, sample, sample.captured_ns)
        if step > newest:
            newer, newest = noise.update(newer, sample, sample.captured_ns), step
    assert every == newer


def take(track: JumpTrack, n: int, offset_m: Vec3, age_s: float = 0.05) -> tuple[JumpTrack, Outcome]:
    """Take a position `n` steps after the first one, that was the first after a silence."""
    at_ns = 10_000_000_000 + n * STEP_NS
    return jumps.update(jumps.note_position(track, at_ns), offset_m, SPREAD, at_ns, age_s)


def settle() -> JumpTrack:
    """A track after so many positions that jumps are judged."""
    track = JumpTrack()
    for n in range(30):
        track, outcome = take(track, n, NONE)
        assert outcome is Outcome.COUNTS
    return track


def test_a_jump_that_the_next_position_confirms_shifts_positions() -> None:
    track, outcome = take(settle(), 30, JUMP)
    assert outcome is Outcome.REFUSED and track.compute_shift_m(0) == NONE
    track, outcome = take(track, 31, (0.21, -0.1, 0.01), 0.1)
    assert outcome is Outcome.COUNTS
    assert track.shift_m == pytest.approx((0.205, -0.1, 0.005))


def test_a_shift_fades_to_nothing() -> None:
    track, _ = take(take(settle(), 30, JUMP)[0], 31, JUMP, 0.1)
    size_m = math.hypot(*JUMP)
    later = track.compute_shift_m(track.at_ns + 1_000_000_000)
    assert math.hypot(*later) == pytest.approx(size_m - 0.05)
    assert track.compute_shift_m(track.at_ns + 60_000_000_000) == NONE


def test_an_outlier_shifts_nothing() -> None:
    track, outcome = take(settle(), 30, JUMP)
    assert outcome is Outcome.REFUSED
    track, outcome = take(track, 31, NONE, 0.1)
    assert outcome is Outcome.COUNTS and track.shift_m == NONE
    track, outcome = take(track, 32, (0.3, 0.3, 0.0))
    assert outcome is Outcome.REFUSED
    track, outcome = take(track, 33, (-0.4, 0.1, 0.2), 0.1)
    assert outcome is Outcome.REFUSED and track.shift_m == NONE


def test_all_jumps_together_shift_no_further_than_so_much() -> None:
    track, outcomes = settle(), []
    for n in range(30, 60, 2):
        track, _ = take(track, n, JUMP)
        track, outcome = take(track, n + 1, JUMP, 0.1)
        outcomes.append(outcome)
        assert math.hypot(*track.shift_m) <= MAX_SHIFT_M
    assert math.hypot(*track.shift_m) > 0.2
    assert outcomes[0] is Outcome.COUNTS and Outcome.TOO_FAR in outcomes


@pytest.mark.parametrize("accel_mps2", [2.0, 4.0, 8.0])
def test_a_motion_that_nothing_explains_is_no_jump(accel_mps2: float) -> None:
    """The offset of a wrong acceleration, of which nothing is corrected."""
    track = settle()
    for n in range(20):
        s = 0.05 * n
        track, _ = take(track, 30 + n, (0.5 * accel_mps2 * s * s, 0.0, 0.0), 0.05)
        assert track.shift_m == NONE


def test_a_push_whose_offsets_grow_is_no_jump() -> None:
    track = settle()
    for n in range(10):
        track, outcome = take(track, 30 + n, (0.04 * n, 0.0, 0.0))
        assert outcome is Outcome.COUNTS


def test_right_after_a_silence_nothing_is_a_jump() -> None:
    track, outcome = take(settle(), 50, JUMP, 1.0)
    assert outcome is Outcome.COUNTS
    track, outcome = take(track, 51, JUMP)
    assert outcome is Outcome.COUNTS and track.shift_m == NONE


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=20))
def test_while_others_fly_all_positions_count_in_full(offsets_m: list[float]) -> None:
    """A shift from before is forgotten, too; afterwards jumps are judged again."""
    track, _ = take(take(settle(), 30, JUMP)[0], 31, JUMP, 0.1)
    assert track.shift_m != NONE
    n = 32
    for n, north in enumerate(offsets_m, start=32):
        track = jumps.suspend(track, 10_000_000_000 + n * STEP_NS)
        track, outcome = take(track, n, (north, 0.0, 0.0))
        assert outcome is Outcome.COUNTS and track.compute_shift_m(track.seen_ns) == NONE
    track, outcome = take(track, n + 1, NONE)
    assert outcome is Outcome.COUNTS
    track, outcome = take(track, n + 2, JUMP)
    assert outcome is Outcome.REFUSED


@given(st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), min_size=5, max_size=60))
def test_no_positions_shift_by_more_than_so_much_and_no_three_are_refused_alike(
    places: list[tuple[float, float]],
) -> None:
    """Each place is held for three positions: a source that stays is refused only if it is too far."""
    track, n = settle(), 30
    for north, east in places:
        outcomes = []
        for _ in range(3):
            track, outcome = take(track, n, (north, east, 0.0))
            outcomes.append(outcome)
            n += 1
            assert math.hypot(*track.shift_m) <= MAX_SHIFT_M
        assert Outcome.TOO_FAR in outcomes or Outcome.COUNTS in outcomes


def judge(
    north_m: float,
    *,
    std_m: Vec3 = NONE,
    at_ns: int = 1,
    age_s: float = 0.0,
    beside_own_m: Vec3 | None = None,
    **known: Any,
) -> tuple[JumpTrack, Outcome]:
    """Take a position so far north of its prediction."""
    return jumps.update(JumpTrack(**known), (north_m, 0.0, 0.0), np.array(std_m), at_ns, age_s, beside_own_m)


@pytest.mark.parametrize(
    ("std_m", "age_s", "bound_m"),
    [
        ((0.01, 0.012, 0.013), 0.0, 0.07),
        ((0.01, 0.03, 0.02), 0.0, 5.0 * 0.03),
        (NONE, 0.2, 0.3 * 0.2 + 0.5 * 3.0 * 0.2 * 0.2),
        (NONE, 1.0, 0.25),
    ],
)
def test_a_position_beyond_each_bound_is_a_jump(std_m: Vec3, age_s: float, bound_m: float) -> None:
    for sign in (1.0, -1.0):
        assert judge(sign * bound_m, std_m=std_m, age_s=age_s)[1] is Outcome.COUNTS
        assert judge(sign * just_more(bound_m), std_m=std_m, age_s=age_s)[1] is Outcome.REFUSED


@pytest.mark.parametrize(
    ("beside_own_m", "outcome"),
    [
        (None, Outcome.REFUSED),
        (NONE, Outcome.COUNTS),
        ((0.0, 0.0, 0.125 - 2.0**-10), Outcome.COUNTS),
        ((0.0, -0.125, 0.0), Outcome.REFUSED),
        ((0.25, 0.0, 0.0), Outcome.REFUSED),
    ],
)
def test_a_position_that_moved_as_its_own_velocity_says_did_not_jump(
    beside_own_m: Vec3 | None, outcome: Outcome
) -> None:
    """The midpoint: a jump leaves all of the offset beside the own velocity, a wrong prediction nothing."""
    assert judge(0.25, beside_own_m=beside_own_m)[1] is outcome


def test_a_jump_that_waits_is_not_confirmed_by_a_position_that_moved_as_its_own_velocity_says() -> None:
    jump: Vec3 = (0.25, 0.0, 0.0)
    for beside_own_m, shift_m in ((None, jump), (jump, jump), (NONE, NONE)):
        track, outcome = judge(0.25, beside_own_m=beside_own_m, jump_m=jump)
        assert (outcome, track.shift_m, track.jump_m) == (Outcome.COUNTS, shift_m, None)


@pytest.mark.parametrize(
    ("before_m", "is_jump"), [(0.1875 - 2.0**-10, True), (0.1875, True), (0.1875 + 2.0**-10, False)]
)
def test_an_offset_whose_change_was_three_quarters_there_before_has_grown(before_m: float, is_jump: bool) -> None:
    _, outcome = judge(before_m + 0.25, offset_m=(before_m, 0.0, 0.0))
    assert (outcome is Outcome.REFUSED) == is_jump


@pytest.mark.parametrize(("jump_m", "confirms"), [(0.1875, True), (0.1875 - 2.0**-20, False)])
def test_the_next_position_is_as_far_away_by_two_fifths(jump_m: float, confirms: bool) -> None:
    track, outcome = judge(0.3125, jump_m=(jump_m, 0.0, 0.0))
    assert (outcome, track.shift_m[0]) == ((Outcome.COUNTS, 0.25) if confirms else (Outcome.REFUSED, 0.0))


def test_positions_are_shifted_by_two_fifths_of_a_metre_at_most() -> None:
    for jump_m, outcome in ((0.4, Outcome.COUNTS), (just_more(0.4), Outcome.TOO_FAR)):
        assert judge(jump_m, jump_m=(jump_m, 0.0, 0.0))[1] is outcome


def test_a_shift_is_no_larger_before_its_time() -> None:
    track = JumpTrack(shift_m=JUMP, at_ns=2_000_000_000)
    assert track.compute_shift_m(1_000_000_000) == track.compute_shift_m(2_000_000_000) == JUMP


@pytest.mark.parametrize(
    ("gap_ns", "settles_ns"),
    [(500_000_000, 0), (500_000_001, 500_000_001), (1_000_000_000, 1_000_000_000), (2_000_000_000, 1_000_000_000)],
)
def test_after_a_silence_positions_settle_for_as_long_again(gap_ns: int, settles_ns: int) -> None:
    assert jumps.note_position(JumpTrack(), gap_ns).settled_ns == (gap_ns + settles_ns if settles_ns else 0)


def test_jumps_are_judged_from_the_moment_on_that_is_settled() -> None:
    for at_ns, age_s, outcome in (
        (9, 0.0, Outcome.COUNTS),
        (10, 0.0, Outcome.REFUSED),
        (10, 1.5, Outcome.REFUSED),
        (10, just_more(1.5), Outcome.COUNTS),
    ):
        assert judge(0.3, at_ns=at_ns, age_s=age_s, settled_ns=10)[1] is outcome
    for at_ns, outcome in ((9, Outcome.COUNTS), (10, Outcome.REFUSED)):
        suspended = jumps.suspend(JumpTrack(), 9)
        assert jumps.update(suspended, (0.3, 0.0, 0.0), SPREAD, at_ns, 0.0)[1] is outcome


def test_noise_that_begins_in_flight_shows_in_three_of_five_residuals_of_a_slow_source() -> None:
    """The last quiet position and two noisy ones; a quick source tells a burst of five from noise."""
    noisy_m = np.outer([0.1, -0.1, 0.1, -0.1, 0.1], np.ones(3))
    offsets_m = np.concatenate([np.zeros((20, 3)), noisy_m])
    assert measure_noise(offsets_m[:23], step_ns=4 * STEP_NS).std_m > 0.012
    assert measure_noise(offsets_m[:22], step_ns=4 * STEP_NS).std_m == 0.0
    assert measure_noise(offsets_m, step_ns=STEP_NS).std_m == 0.0
