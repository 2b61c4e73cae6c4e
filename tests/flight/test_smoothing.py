"""Positions that a camera system smooths, or stamps too late: against the true path, in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from flight_rig import DT_NS, MS, START_NS, boundary_ns, estimator_parameters, sample, small_plant
from msgspec.structs import replace

from uavctl.arrays import SECOND_NS, Array
from uavctl.flight.estimator import FilterHistory, begin_history, insert_sample, predict_belief, shift_positions
from uavctl.flight.kalman import make_kalman
from uavctl.flight.monitors import smoothing
from uavctl.flight.monitors.observation import MOTION_NS
from uavctl.flight.monitors.smoothing import SmoothingTrack
from uavctl.records import Vec3, VehicleMotion

TICK_S, RATE_HZ = 0.05, 20.0
# A path between corners: the sum of these, amplitudes (3,) [m] and circular frequencies [rad/s]
WAVES = (((1.6, 0.9, 0.1), 0.7), ((0.25, -0.3, 0.1), 2.1), ((0.05, 0.04, 0.02), 4.5))


def follow(at_s: float, gain: Callable[[complex], complex] = lambda _: 1.0) -> Array:
    """The place on the path (3,) behind a linear system: Im Σ a G(jω) e^(jωt)."""
    places = [np.array(a) * (gain(1j * w) * np.exp(1j * w * at_s)).imag for a, w in WAVES]
    return np.array(np.sum(places, axis=0))


def velocity(at_s: float) -> Array:
    return follow(at_s, lambda s: s)


def delay(late_s: float) -> Callable[[complex], complex]:
    return lambda s: np.exp(-s * late_s)


LAGS: dict[str, Callable[[complex], complex]] = {
    "first order, 0.2 s": lambda s: 1.0 / (1.0 + 0.2 * s),
    "average over 0.2 s": lambda s: (1.0 - np.exp(-0.2 * s)) / (0.2 * s),
    "0.1 s late": delay(0.1),
    "0.2 s late": delay(0.2),
    "0.3 s late": delay(0.3),
}
NORTH = np.array([1.0, 0.0, 0.0])
TURNED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
OTHERS: dict[str, Callable[[float], Array]] = {
    "right": follow,
    "0.4 s late": lambda at_s: follow(at_s, delay(0.4)),
    "0.2 s early": lambda at_s: follow(at_s, delay(-0.2)),
    "half as far": lambda at_s: 0.5 * follow(at_s),
    "0.7 as far": lambda at_s: 0.7 * follow(at_s),
    "turned": lambda at_s: TURNED @ follow(at_s),
    "mirrored": lambda at_s: follow(at_s) * (1.0, -1.0, 1.0),
    "frozen": lambda _: np.ones(3),
    "drifting": lambda at_s: follow(at_s) + 0.2 * at_s * NORTH,
}


def fly(
    places: Callable[[float], Array], seconds: float, noise_m: float = 0.005, lost: float = 0.3
) -> tuple[SmoothingTrack, list[tuple[float, Vec3]]]:
    """Fly from `START_NS` on: positions with noise and losses; return too times [s] and what is added to positions."""
    rng, track, added = np.random.default_rng(3), SmoothingTrack(), []
    for tick in range(round(seconds / TICK_S)):
        at_s = tick * TICK_S
        at_ns = START_NS + round(at_s * 1e9)
        vx, vy, vz = velocity(at_s).tolist()
        motion = VehicleMotion(velocity_mps=(vx, vy, vz), velocity_ns=at_ns, attitude_rad=None, attitude_ns=None)
        track, _ = smoothing.advance(track, motion, at_ns)
        if rng.random() >= lost:
            north, east, down = (places(at_s) + noise_m * rng.standard_normal(3)).tolist()
            track = smoothing.update(track, at_ns, (north, east, down))
        added.append((at_s, track.compute_lag_m(at_ns)))
    return track, added


@pytest.mark.fault(100)
@pytest.mark.parametrize("name", LAGS)
def test_what_is_added_to_smoothed_positions_leads_to_the_path(name: str) -> None:
    """Two fifths of the error are left at most: a delay and a first order differ by so much."""
    _, added = fly(lambda at_s: follow(at_s, LAGS[name]), 12.0)
    late = [(at_s, lag_m) for at_s, lag_m in added if at_s > 2.0]
    before = [np.linalg.norm(follow(at_s) - follow(at_s, LAGS[name])) for at_s, _ in late]
    after = [np.linalg.norm(follow(at_s) - follow(at_s, LAGS[name]) - lag_m) for at_s, lag_m in late]
    assert np.sqrt(np.mean(np.square(after))) < 0.4 * np.sqrt(np.mean(np.square(before)))


@pytest.mark.fault(42)
@pytest.mark.parametrize("name", OTHERS)
def test_nothing_is_added_to_positions_that_are_no_smoothed_ones(name: str) -> None:
    _, added = fly(OTHERS[name], 12.0)
    assert all(lag_m == (0.0, 0.0, 0.0) for _, lag_m in added)


@pytest.mark.fault(100)
@pytest.mark.parametrize("name", LAGS)
def test_the_offset_of_positions_stays_while_they_are_right_on_the_whole(name: str) -> None:
    """Positions that are 0.2 m aside have another offset by 0.2 m."""
    track, _ = fly(lambda at_s: follow(at_s, LAGS[name]), 10.0)
    newest_ns, aside = track.flown[-1][0], 0.2 * NORTH
    offsets = []
    for at_s in np.arange(8.0, 9.9, 0.1).tolist():
        place = follow(at_s, LAGS[name])
        for north, east, down in (place.tolist(), (place + aside).tolist()):
            offset = track.compute_offset_m(START_NS + round(at_s * 1e9), (north, east, down))
            assert offset is not None
            offsets.append(offset)
    right, other = np.array(offsets[::2]), np.array(offsets[1::2])
    assert np.abs(right - right.mean(axis=0)).max() < 0.05
    assert np.abs(other - right - aside).max() < 1e-9
    for at_ns, is_known in (
        (track.flown[0][0], True),
        (track.flown[0][0] - 1, False),
        (newest_ns + MOTION_NS, True),
        (newest_ns + MOTION_NS + 1, False),
    ):
        assert (track.compute_offset_m(at_ns, (0.0, 0.0, 0.0)) is not None) == is_known
    assert SmoothingTrack().compute_offset_m(0, (0.0, 0.0, 0.0)) is None


def test_noise_of_5_cm_is_no_smoothing() -> None:
    _, added = fly(follow, 12.0, noise_m=0.05)
    assert all(lag_m == (0.0, 0.0, 0.0) for _, lag_m in added)


def test_a_delay_that_ends_is_not_added_any_more() -> None:
    track, _ = fly(lambda at_s: follow(at_s, LAGS["first order, 0.2 s"]), 6.0)
    assert track.late_s > 0.1
    track, _ = fly(lambda at_s: follow(at_s, LAGS["first order, 0.2 s"] if at_s < 6.0 else lambda _: 1.0), 20.0)
    assert track.late_s == 0.0


def test_hovering_shows_nothing_new() -> None:
    track, _ = fly(lambda at_s: follow(at_s, LAGS["first order, 0.2 s"]), 6.0)
    at_ns, rest = track.seen_ns, ((0.0,) * 3,) * 3
    still = replace(track, changes=(), flown=((at_ns, *rest), (at_ns + 3 * SECOND_NS, *rest)))
    for _ in range(40):
        at_ns += 50 * MS
        still = smoothing.update(still, at_ns, (1.0, 1.0, 1.0))
    assert still.changes and still.estimated_s == track.estimated_s > 0.1


def test_positions_right_after_a_silence_show_nothing() -> None:
    """They correct the vehicle's own velocity, which has drifted."""
    track, _ = fly(lambda at_s: follow(at_s, LAGS["0.2 s late"]), 0.5)
    silent = replace(track, seen_ns=track.seen_ns - 2 * SECOND_NS)
    after = smoothing.update(silent, track.seen_ns + 50 * MS, (0.0, 0.0, 0.0))
    assert after.changes == () and after.sums == track.sums


def test_the_filter_moves_as_if_positions_had_come_so() -> None:
    """A change of the delay, and all positions with it from the first one on: the same beliefs."""
    kalman = make_kalman(small_plant(("north", "east")), estimator_parameters(window_s=5.0), DT_NS)
    track, _ = fly(lambda at_s: follow(at_s, LAGS["0.2 s late"]), 3.0)
    _, change = smoothing.adopt(replace(track, estimated_s=track.late_s + 0.1))
    assert change is not None

    def fill(shift: Callable[[int], tuple[Vec3, Vec3]] | None) -> FilterHistory:
        history = begin_history(kalman, START_NS, START_NS)
        for step in range(5, 50, 3):
            at_ns = START_NS + step * 50 * MS
            north, east, down = follow(step * 0.05).tolist()
            if shift is not None:
                north, east, down = np.add((north, east, down), shift(at_ns)[0]).tolist()
            history, reason = insert_sample(kalman, history, sample(at_ns, position_m=(north, east, down)))
            assert reason is None
        return history

    at_ns = boundary_ns(30)
    moved = predict_belief(kalman, shift_positions(kalman, fill(None), change.shift), at_ns)
    right = predict_belief(kalman, fill(change.shift), at_ns)
    assert moved is not None and right is not None
    assert np.array_equal(moved.mean, right.mean) and np.array_equal(moved.cov, right.cov)


def test_what_was_known_before_the_window_moves_with_its_positions() -> None:
    """A step of the delay and back leaves the filter as it was; a step moves places by -δ v_f', speeds by its slope."""
    track, _ = fly(lambda at_s: follow(at_s, LAGS["0.2 s late"]), 3.0)
    track = replace(track, late_s=0.15)
    _, back = smoothing.forget(track)
    _, there = smoothing.adopt(replace(track, late_s=0.0, estimated_s=0.15))
    assert back is not None and there is not None
    at_ns, step_ns = START_NS + 1_725 * MS, MS
    for vector, reverse in zip(there.shift(at_ns), back.shift(at_ns), strict=True):
        assert np.add(vector, reverse) == pytest.approx(np.zeros(3), abs=1e-15)
    before, after = np.array(there.shift(at_ns - step_ns)[0]), np.array(there.shift(at_ns + step_ns)[0])
    # Between two own velocities v_f is interpolated: its slope is right to a fraction of the change of v_f'.
    assert there.shift(at_ns)[1] == pytest.approx((after - before) / 2e-3, abs=0.02)
    assert math.hypot(*there.shift(at_ns)[0]) > 0.05


def test_a_velocity_that_is_none_is_not_noted() -> None:
    track, _ = fly(follow, 0.5)
    at_ns = track.flown[-1][0]
    nothing = VehicleMotion(velocity_mps=None, velocity_ns=None, attitude_rad=None, attitude_ns=None)
    bad = replace(nothing, velocity_mps=(0.0, math.nan, 0.0), velocity_ns=at_ns + 50 * MS)
    again = replace(nothing, velocity_mps=(0.1, 0.1, 0.1), velocity_ns=at_ns)
    half = replace(nothing, velocity_ns=at_ns + 50 * MS), replace(again, velocity_ns=None)
    assert all(smoothing.note_velocity(track, motion) is track for motion in (None, nothing, *half, bad, again))


def test_a_position_that_is_no_newer_shows_nothing() -> None:
    track, _ = fly(follow, 0.5)
    assert smoothing.update(track, track.seen_ns, (9.0, 9.0, 9.0)) is track


@pytest.mark.parametrize("has_motion", [False, True])
def test_without_a_recent_velocity_nothing_is_added(has_motion: bool) -> None:
    """Else the last one would move all later positions: a hold beside a wall was 0.7 m outside."""
    track, _ = fly(lambda at_s: follow(at_s, LAGS["0.2 s late"]), 6.0)
    last_ns = track.flown[-1][0]
    old = VehicleMotion(velocity_mps=(1.0, 0.0, 0.0), velocity_ns=last_ns, attitude_rad=None, attitude_ns=None)
    motion = old if has_motion else None
    after, change = smoothing.advance(track, motion, last_ns + 301 * MS)
    assert track.late_s > 0.1 and change is not None and change.change_s == -track.late_s
    assert after.compute_lag_m(last_ns + 301 * MS) == (0.0, 0.0, 0.0)
    assert smoothing.advance(track, old, last_ns + 300 * MS)[0].late_s == track.late_s
