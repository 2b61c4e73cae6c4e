"""Noise of positions, and jumps between two solutions of a camera system, by the monitors of single samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavctl.flight.monitors import jumps, noise
from uavctl.flight.monitors.jumps import FADE_MPS, MAX_SHIFT_M, JumpTrack, Outcome
from uavctl.flight.monitors.noise import LARGEST_STD_M, NoiseTrack
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


@pytest.mark.parametrize("std_m", [0.02, 0.05])
def test_noise_is_measured(std_m: float) -> None:
    rng = np.random.default_rng(1)
    sizes = [measure_noise(std_m * rng.standard_normal((30, 3))).std_m for _ in range(50)]
    assert np.median(sizes) == pytest.approx(std_m, rel=0.15)


@pytest.mark.parametrize(("count", "factor"), [(3, 3.8), (4, 2.3), (5, 1.8), (17, 1.0)])
def test_few_positions_may_have_shown_too_little_noise(count: int, factor: float) -> None:
    """Positions to and fro by 3 cm leave 3 cm / √1.5 as residuals: 1.6 cm as the noise of an axis."""
    offsets = np.zeros((count, 3))
    offsets[::2, 0] = 0.03
    track = measure_noise(offsets)
    assert track.std_m == pytest.approx(factor * 0.0159, rel=0.01) and track.is_known == (count > 4)
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
    assert measure_noise(wild).std_m == LARGEST_STD_M
    far = measure_noise(wild, step_ns=4 * STEP_NS)
    assert not far.is_known and far.std_m == 0.0


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
    assert math.hypot(*later) == pytest.approx(size_m - FADE_MPS)
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
