"""The stuck detector, without a flight: what is remembered of a source, and when that is called stuck."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flight_rig import DT_NS, MS, START_NS, TICK_NS, estimator_parameters, sample, small_plant
from msgspec.structs import replace

from uavctl.event_codes import EventCode
from uavctl.flight.estimator import absorb_samples, begin_history, note_input
from uavctl.flight.kalman import Belief, make_kalman
from uavctl.flight.monitors.frozen import (
    LastMotionNs,
    PredictedSample,
    SourceTrack,
    SourceTracks,
    is_frozen,
    is_repeat,
    is_suspect,
    track_sample,
    update,
)
from uavctl.flight.monitors.outliers import GateParameters
from uavctl.records import PositionSample

PARAMETERS = GateParameters(sigma=6.0, margin_m=0.1, jump_ns=500 * MS)
PLANT = small_plant()
KALMAN = make_kalman(PLANT, estimator_parameters(), DT_NS)


def watched(
    values: list[float],
    source: str = "camera",
    watches: SourceTracks | None = None,
    off_m: tuple[float, ...] = (0.001,),
) -> SourceTracks:
    """What is known of a source after these values, one each 50 ms, with what was off as 1 mm."""
    watches = watches or {}
    history = begin_history(KALMAN, START_NS, START_NS)
    for n, value in enumerate(values):
        one = sample(START_NS + (n + 1) * TICK_NS, position_m=(value, 0.0, 0.0), source=source)
        history, _, _ = absorb_samples(KALMAN, history, one.received_ns, ())
        watches = track_sample(watches, KALMAN, history, one, np.array(off_m))
        history, _, _ = absorb_samples(KALMAN, history, one.received_ns, (one,))
        history = note_input(history, one.received_ns, np.array([1.0]))
    return watches


def test_the_resolution_is_the_smallest_change_and_repeats_are_counted_from_the_last_one() -> None:
    watch = watched([0.0, 0.5, 0.25, 0.75])["camera"]
    assert (watch.resolution_m, watch.repeats, watch.open_loop_belief) == (0.25, 0, None)
    assert watch.noise_m == pytest.approx(0.001)
    assert watched([0.0, 0.5, 0.25], off_m=(0.001, -0.003, 0.002))["camera"].noise_m == pytest.approx(0.003)
    assert (watch.changes, watch.first_ns) == (3, START_NS + 4 * TICK_NS)
    watch = watched([0.0, 0.5, 0.5, 0.5])["camera"]
    assert (watch.resolution_m, watch.repeats, watch.first_ns) == (0.5, 2, START_NS + 2 * TICK_NS)
    assert watch.open_loop_belief is not None
    assert watch.open_loop_belief.at_ns == watch.at_ns == START_NS + 4 * TICK_NS
    assert [is_repeat(watch, at_ns) for at_ns in (watch.at_ns, watch.at_ns - 1)] == [True, False]
    watch = watched([0.0, 0.5, 0.5])["camera"]
    assert watch.repeats == 1 and is_repeat(watch, watch.at_ns)
    watch = watched([0.0, 0.5, 0.5, 0.25])["camera"]
    assert (watch.repeats, watch.open_loop_belief) == (0, None)
    assert not is_repeat(watch, watch.at_ns)
    assert watched([0.0])["camera"].resolution_m == 0.0
    assert watched([0.0, 3.0])["camera"].resolution_m == 3.0


def test_the_smallest_change_of_any_axis_shows_the_resolution() -> None:
    history = begin_history(KALMAN, START_NS, START_NS)
    records = track_sample({}, KALMAN, history, sample(START_NS), np.array([0.001]))
    assert (records["camera"].axis_repeats, records["camera"].gap_ns) == ((0, 0, 0), 0)
    moved = sample(START_NS + TICK_NS, position_m=(0.5, 0.25, 0.0))
    assert track_sample(records, KALMAN, history, moved, np.array([0.001]))["camera"].resolution_m == 0.25


def test_coasting_goes_by_the_inputs_alone() -> None:
    two, three = watched([0.0, 0.5, 0.5])["camera"], watched([0.0, 0.5, 0.5, 0.5])["camera"]
    assert two.open_loop_belief is not None
    assert three.open_loop_belief is not None
    a, b, e = PLANT.transition(TICK_NS * 1e-9)
    mean = two.open_loop_belief.mean[:3]
    # The step's disturbance is expected to be what it was so far, until the next boundary.
    want = a @ mean + b @ np.array([1.0]) + e @ two.open_loop_belief.mean[3:]
    assert three.open_loop_belief.mean[:3] == pytest.approx(want, abs=1e-9)


def test_sources_are_watched_apart() -> None:
    watches = watched([0.0, 0.5, 0.5], "one")
    watches = watched([0.0, 0.5, 0.25], "two", watches)
    assert (watches["one"].repeats, watches["two"].repeats) == (1, 0)


@pytest.mark.parametrize("late_ns", [0, 1, DT_NS])
def test_late_samples_say_nothing(late_ns: int) -> None:
    watches, history = watched([0.0, 0.5, 0.25]), begin_history(KALMAN, START_NS, START_NS)
    late = sample(START_NS + 3 * TICK_NS - late_ns, position_m=(0.25, 0.0, 0.0))
    assert track_sample(watches, KALMAN, history, late, np.zeros(1)) is watches


def test_eight_sources_are_watched_and_many_names_do_not_fill_the_memory() -> None:
    watches: SourceTracks = {}
    for n in range(8):
        watches = watched([0.0], f"s{n}", watches)
    assert set(watches) == {f"s{n}" for n in range(8)}
    for n in range(8, 30):
        watches = watched([0.0], f"s{n}", watches)
        assert len(watches) <= 8
        assert f"s{n}" in watches
    crowd = {f"c{n}": watches["s29"] for n in range(9)}
    assert set(watched([0.0], "new", crowd)) == {"new"}


def test_each_axis_is_watched_for_moves_and_repeats_of_its_own() -> None:
    """The north moves and the down but twice; the east never does."""
    watches: SourceTracks = {}
    history = begin_history(KALMAN, START_NS, START_NS)
    values = [(0.0, 1.0, 5.0), (0.1, 1.0, 5.0), (0.3, 1.0, 6.0), (0.3, 1.0, 6.0), (0.4, 1.0, 7.0), (0.6, 1.0, 7.0)]
    for n, value in enumerate(values):
        one = sample(START_NS + (n + 1) * TICK_NS, position_m=value)
        history, _, _ = absorb_samples(KALMAN, history, one.received_ns, (one,))
        watches = track_sample(watches, KALMAN, history, one, np.array([0.001]))
    watch = watches["camera"]
    assert (watch.axis_changes, watch.axis_repeats) == ((4, 0, 2), (0, 5, 1))
    assert watch.axis_first_ns == (START_NS + 6 * TICK_NS, START_NS + TICK_NS, START_NS + 5 * TICK_NS)
    for n in range(20):
        one = sample(START_NS + (n + 9) * TICK_NS, position_m=(0.1 * (n % 2), 1.0, 7.0))
        watches = track_sample(watches, KALMAN, history, one, np.array([0.001]))
    assert (watches["camera"].axis_changes, watches["camera"].axis_repeats) == ((10, 0, 2), (0, 25, 21))


@pytest.mark.parametrize(
    ("moves", "still", "noise_m", "since"),
    [
        ((10, 10, 10), (0, 0, 5), 0.02, 3),
        ((10, 10, 10), (0, 0, 4), 0.02, None),
        ((10, 10, 10), (0, 0, 6), 0.02, 3),
        ((10, 10, 9), (0, 0, 5), 0.02, None),  # it has not moved all the time
        ((10, 10, 10), (5, 0, 5), 0.02, 1),
        ((10, 10, 10), (0, 5, 5), 0.02, 2),
        ((10, 10, 10), (0, 0, 5), 0.01999, None),  # of 20 resolutions
        ((10, 10, 10), (0, 0, 0), 0.02, None),
    ],
)
def test_an_axis_that_noise_has_moved_and_that_stands_still_is_stuck(
    moves: tuple[int, ...], still: tuple[int, ...], noise_m: float, since: int | None
) -> None:
    watch = SourceTrack(
        START_NS, (0.0, 0.0, 0.0), 0.001, noise_m, axis_changes=moves, axis_repeats=still, axis_first_ns=(1, 2, 3)
    )
    assert watch.find_frozen_axis_ns(ALWAYS) == since
    assert is_frozen(watch, KALMAN, sample(START_NS), PARAMETERS, ALWAYS) is (since is not None)


ALWAYS: LastMotionNs = (2**62,) * 3  # it moves all the time


@pytest.mark.parametrize(
    ("moved_ns", "since"), [((1, 2, 3), 1), ((0, 2, 3), 3), ((0, 9, 2), None), ((0, 0, 9), 3), ((9, 0, 0), 1)]
)
def test_an_axis_that_has_rested_since_by_the_vehicles_word_may_stand_still(
    moved_ns: LastMotionNs, since: int | None
) -> None:
    watch = SourceTrack(
        START_NS, (0.0, 0.0, 0.0), 0.001, 0.02, axis_changes=(10,) * 3, axis_repeats=(5, 0, 5), axis_first_ns=(1, 2, 3)
    )
    assert watch.find_frozen_axis_ns(moved_ns) == since
    assert is_frozen(watch, KALMAN, sample(START_NS), PARAMETERS, moved_ns) is (since is not None)


@pytest.mark.parametrize(
    ("moved_ns", "rests"),
    [((6, 6, 6), True), ((7, 6, 6), False), ((6, 7, 6), False), ((6, 6, 7), False), ((9, 6, 6), False)],
)
def test_a_value_may_come_again_of_who_has_rested_all_the_time(moved_ns: LastMotionNs, rests: bool) -> None:
    watch = SourceTrack(START_NS, (0.0, 0.0, 0.0), 5e-5, first_ns=7)
    assert watch.may_rest(moved_ns) == rests
    assert replace(watch, resolution_m=1e-3).may_rest(moved_ns) == rests
    assert not replace(watch, resolution_m=4.99e-5).may_rest(moved_ns)  # noise to the last digit does not say it twice
    assert not replace(watch, is_known_frozen=True).may_rest(moved_ns)
    assert not replace(watch, is_known_suspect=True).may_rest(moved_ns)


@pytest.mark.parametrize(
    ("changes", "resolution_m", "grain_m"),
    [(10, 0.01, 0.01), (9, 0.01, 0.002), (9, 0.001, 0.001), (11, 0.01, 0.01), (0, 0.0, 0.0)],
)
def test_a_few_changes_do_not_tell_the_resolution(changes: int, resolution_m: float, grain_m: float) -> None:
    assert SourceTrack(START_NS, (0.0, 0.0, 0.0), resolution_m, changes=changes).limited_resolution_m == grain_m


@pytest.mark.parametrize(
    ("repeats", "noise_m", "resolution_m", "std_m", "far_m", "found"),
    [
        (3, 0.003, 1e-6, 0.01, 0.0, True),
        (2, 0.003, 1e-6, 0.01, 0.0, False),
        (400, 0.003, 1e-6, 0.01, 0.0, True),
        (3, 0.0005, 0.001, 0.02, 0.0, True),
        (3, 0.000499, 0.001, 0.02, 0.0, False),
        (3, 0.003, 0.001, 0.01999, 0.0, False),
        (3, 2e-5, 1e-7, 0.01, 0.0, True),
        (3, 1.99e-5, 1e-7, 0.01, 0.0, False),
        (9, 0.003, 0.0, 0.01, 0.0, False),
        (1, 0.0, 0.0, 0.0, 0.1301, True),  # 6 times 5 mm, and the margin
        (1, 0.0, 0.0, 0.0, -0.1301, True),
        (1, 0.0, 0.0, 0.0, 0.1299, False),
        (1, 0.0, 0.0, 0.0, -0.1299, False),
        (1, 0.0, 0.01, 0.0, 0.1399, False),
        (1, 0.0, 0.01, 0.0, 0.1401, True),
    ],
)
def test_what_counts_as_stuck(
    repeats: int, noise_m: float, resolution_m: float, std_m: float, far_m: float, found: bool
) -> None:
    one: PositionSample = sample(START_NS, position_m=(2.0, 0.0, 0.0))
    belief = Belief(
        at_ns=START_NS,
        captured_ns=START_NS,
        mean=np.array([2.0 + far_m, 9.0, 9.0, 9.0]),
        cov=np.diag([std_m**2, 9, 9, 9]),
    )
    watch = SourceTrack(
        START_NS, one.position_m, resolution_m, noise_m, changes=10, repeats=repeats, open_loop_belief=belief
    )
    assert is_frozen(watch, KALMAN, one, PARAMETERS, ALWAYS) is found
    assert is_frozen(replace(watch, open_loop_belief=None), KALMAN, one, PARAMETERS, ALWAYS) is False
    assert is_frozen(replace(watch, is_known_frozen=True), KALMAN, one, PARAMETERS, ALWAYS) is True


@pytest.mark.parametrize(
    ("noise_m", "resolution_m", "far_m", "suspect"),
    [
        (0.004, 0.001, 0.0, True),  # noise of four resolutions
        (0.003999, 0.001, 0.0, False),
        (2e-5, 1e-6, 0.0, True),
        (1.99e-5, 1e-6, 0.0, False),  # a message's numbers
        (9.0, 0.0, 0.0, False),  # it has said but one thing
        (0.0, 0.0, 0.01499, False),  # half of 6 times 5 mm
        (0.0, 0.0, 0.01501, True),
        (0.0, 0.0, -0.01501, True),
        (0.0, 0.0, -0.01499, False),
        (0.0, 0.002, 0.01699, False),
        (0.0, 0.002, 0.01701, True),
    ],
)
def test_when_a_value_that_came_again_is_not_believed(
    noise_m: float, resolution_m: float, far_m: float, suspect: bool
) -> None:
    """However uncertain the prediction is, in the axis of the plant alone."""
    one = sample(START_NS, position_m=(2.0, 7.0, -7.0))
    for std_m in (0.0, 5.0):
        mean, cov = np.array([2.0 + far_m, 9.0, 9.0, 9.0]), np.eye(4) * std_m**2
        belief = Belief(at_ns=START_NS, captured_ns=START_NS, mean=mean, cov=cov)
        watch = SourceTrack(
            START_NS, one.position_m, resolution_m, noise_m, changes=10, repeats=1, open_loop_belief=belief
        )
        assert is_suspect(watch, KALMAN, one, PARAMETERS) is suspect
        assert is_suspect(replace(watch, open_loop_belief=None), KALMAN, one, PARAMETERS) is False


def test_what_is_near_enough_is_so_at_the_edge_as_well() -> None:
    parameters = GateParameters(sigma=0.0, margin_m=9.0, jump_ns=0)
    one = sample(START_NS, position_m=(2.0, 0.0, 0.0))
    for north_m, suspect in ((2.125, False), (math.nextafter(2.125, 3.0), True)):
        belief = Belief(START_NS, START_NS, mean=np.array([north_m, 0.0, 0.0, 0.0]), cov=np.zeros((4, 4)))
        watch = SourceTrack(
            START_NS, one.position_m, changes=10, resolution_m=0.125, repeats=1, open_loop_belief=belief
        )
        assert is_suspect(watch, KALMAN, one, parameters) is suspect


def test_as_far_as_all_that_is_uncertain_is_not_yet_too_far() -> None:
    parameters = GateParameters(sigma=0.0, margin_m=0.125, jump_ns=0)
    one = sample(START_NS, position_m=(2.0, 0.0, 0.0))
    for north_m, found in ((2.25, False), (math.nextafter(2.25, 3.0), True)):
        belief = Belief(START_NS, START_NS, mean=np.array([north_m, 0.0, 0.0, 0.0]), cov=np.zeros((4, 4)))
        watch = SourceTrack(
            START_NS, one.position_m, changes=10, resolution_m=0.125, repeats=1, open_loop_belief=belief
        )
        assert is_frozen(watch, KALMAN, one, parameters, ALWAYS) is found


def test_how_far_apart_samples_are_and_how_long_none_came_before_a_value() -> None:
    watches: SourceTracks = {}
    history = begin_history(KALMAN, START_NS, START_NS)
    seen = []
    for ticks, value in ((1, 0.0), (4, 0.5), (6, 0.7), (9, 0.7), (10, 0.7), (14, 0.9)):
        one = sample(START_NS + ticks * TICK_NS, position_m=(value, 0.0, 0.0))
        history, _, _ = absorb_samples(KALMAN, history, one.received_ns, (one,))
        watches = track_sample(watches, KALMAN, history, one, np.array([0.001]))
        seen.append((watches["camera"].gap_ns // TICK_NS, watches["camera"].spacing_ns // TICK_NS))
    assert seen == [(0, 0), (3, 3), (2, 2), (2, 2), (2, 1), (4, 1)]


@pytest.mark.parametrize(
    ("changes", "repeats", "gap_ns", "stale"),
    [
        (4, 1, 149, False),  # none can have been lost before it
        (4, 1, 150, True),
        (3, 1, 100, True),  # nobody knows how often it samples
        (3, 2, 100, False),
        (2, 1, 100, True),
        (9, 9, 300, True),
    ],
)
def test_the_value_that_first_came_may_be_stale_where_one_was_lost_before(
    changes: int, repeats: int, gap_ns: int, stale: bool
) -> None:
    watch = SourceTrack(9, (0.0, 0.0, 0.0), changes=changes, repeats=repeats, first_ns=7, gap_ns=gap_ns, spacing_ns=100)
    assert watch.repeated_since_ns == (7 if stale else 8)


def test_the_part_of_values_that_come_again_is_learnt_of_one_repeat_or_two() -> None:
    assert watched([0.0, 0.5, 0.7])["camera"].repeated_share == 0.0
    assert watched([0.0, 0.0, 0.5])["camera"].repeated_share == 1.0
    assert watched([0.0, 0.0, 0.0, 0.5])["camera"].repeated_share == 1.0
    assert watched([0.0, 0.0, 0.0, 0.0, 0.5])["camera"].repeated_share == 0.0
    assert watched([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])["camera"].repeated_share == 0.0
    assert watched([0.0, 0.0, 0.5, 0.7])["camera"].repeated_share == 0.5
    assert watched([0.0, 0.0, 0.5, 0.7, 0.7])["camera"].repeated_share == 0.5


@pytest.mark.parametrize(
    ("usual", "repeats", "as_usual", "unlike_it"),
    [
        (0.15, 2, True, False),
        (0.1499, 2, False, True),
        (1.0, 3, False, True),
        (1.0, 4, False, False),
        (0.0, 1, False, True),
        (0.0, 3, False, True),
        (0.0, 4, False, False),
        (0.0, 0, False, False),
        (1.0, 1, True, False),
    ],
)
def test_what_a_source_does_as_usual(usual: float, repeats: int, as_usual: bool, unlike_it: bool) -> None:
    watch = SourceTrack(9, (0.0, 0.0, 0.0), repeated_share=usual, repeats=repeats)
    assert (watch.repeats_regularly, watch.has_just_begun_to_repeat) == (as_usual, unlike_it)


def test_a_source_that_says_values_twice_is_not_stuck_for_it_however_far_the_vehicle_flew() -> None:
    one = sample(START_NS, position_m=(2.0, 0.0, 0.0))
    belief = Belief(START_NS, START_NS, mean=np.array([3.0, 0.0, 0.0, 0.0]), cov=np.zeros((4, 4)))
    watch = SourceTrack(START_NS, one.position_m, repeats=2, repeated_share=1.0, open_loop_belief=belief)
    assert is_frozen(watch, KALMAN, one, PARAMETERS, ALWAYS) is False
    assert is_suspect(watch, KALMAN, one, PARAMETERS) is True
    assert is_frozen(replace(watch, repeats=3), KALMAN, one, PARAMETERS, ALWAYS) is True
    assert is_frozen(replace(watch, repeated_share=0.0), KALMAN, one, PARAMETERS, ALWAYS) is True


def test_news_is_a_mean_of_which_the_first_values_are_equal_parts() -> None:
    watches, history = watched([0.0]), begin_history(KALMAN, START_NS, START_NS)
    means = []
    for n, off_m in enumerate((0.001, 0.004, 0.001)):
        one = sample(START_NS + (n + 2) * TICK_NS, position_m=(0.5 + 0.1 * n, 0.0, 0.0))
        watches = track_sample(watches, KALMAN, history, one, np.array([-off_m]))
        means.append(watches["camera"].noise_m)
    assert means == pytest.approx([0.001, 0.0025, 0.002])


def test_the_time_between_two_values_does_not_go_by_when_it_was() -> None:
    history = begin_history(KALMAN, 0, 0)
    watches = track_sample({}, KALMAN, history, sample(10), np.array([0.001]))
    watches = track_sample(watches, KALMAN, history, sample(50, position_m=(1.0, 0.0, 0.0)), np.array([0.001]))
    assert (watches["camera"].gap_ns, watches["camera"].spacing_ns) == (40, 40)


def test_each_repeat_of_an_axis_counts() -> None:
    assert [watched([0.5, *[1.0] * n])["camera"].axis_repeats[1] for n in range(1, 6)] == [1, 2, 3, 4, 5]


def test_its_axes_do_not_stand_still_for_it() -> None:
    watch = watched([0.0, 0.0, 0.5, 0.5])["camera"]
    assert (watch.repeats, watch.axis_repeats) == (1, (0, 2, 2))
    watch = watched([0.0, 0.0, 0.5, 0.5, 0.5, 0.5])["camera"]
    assert (watch.repeats, watch.axis_repeats) == (3, (1, 3, 3))


def test_a_value_that_was_taken_back_is_not_believed_until_another_comes() -> None:
    one = sample(START_NS, position_m=(2.0, 0.0, 0.0))
    belief = Belief(START_NS, START_NS, mean=np.array([2.0, 0.0, 0.0, 0.0]), cov=np.zeros((4, 4)))
    watch = SourceTrack(START_NS, one.position_m, repeats=1, open_loop_belief=belief)
    assert is_suspect(watch, KALMAN, one, PARAMETERS) is False
    assert is_suspect(replace(watch, is_known_suspect=True), KALMAN, one, PARAMETERS) is True
    assert is_suspect(replace(watch, is_known_suspect=True, open_loop_belief=None), KALMAN, one, PARAMETERS) is True
    told = {"camera": replace(watch, is_known_suspect=True, at_ns=START_NS)}
    history = begin_history(KALMAN, START_NS, START_NS)
    again = sample(START_NS + 1, position_m=(2.0, 0.0, 0.0))
    assert track_sample(told, KALMAN, history, again, np.zeros(1))["camera"].is_known_suspect
    other = sample(START_NS + 1, position_m=(2.1, 0.0, 0.0))
    assert not track_sample(told, KALMAN, history, other, np.zeros(1))["camera"].is_known_suspect


def test_a_value_that_comes_again_after_the_window_is_held_against_the_inputs_too() -> None:
    """Else a repeat after a long silence would be believed."""
    watches = watched([0.0, 0.5])
    history = begin_history(KALMAN, START_NS, START_NS)
    one = sample(START_NS + 2 * TICK_NS, position_m=(0.5, 0.0, 0.0))
    history, _, _ = absorb_samples(KALMAN, history, one.received_ns, (one,))
    history = note_input(history, one.received_ns, np.array([1.0]))
    late_ns = one.captured_ns + round(1.5e9 * KALMAN.parameters.window_s)
    history, _, _ = absorb_samples(KALMAN, history, late_ns, ())
    assert history.window_begin_ns > one.captured_ns
    late = sample(late_ns, position_m=(0.5, 0.0, 0.0))
    watch = track_sample(watches, KALMAN, history, late, np.zeros(1))["camera"]
    assert watch.open_loop_belief is not None
    assert watch.open_loop_belief.at_ns == late_ns
    assert is_suspect(watch, KALMAN, late, PARAMETERS)


def judged(
    inputs_mps2: list[float], *, is_flying: bool = True, late_ns: int = 0, next_m: float = 0.02
) -> list[tuple[EventCode | None, float]]:
    """Verdicts on a value that comes again with each input, and the position that inputs alone predict [m].

    Args:
        late_ns: Time by which the last sample comes late [ns].
        next_m: Value of the last sample.
    """
    values = [0.0, 0.01, *[0.02] * len(inputs_mps2), next_m]
    records: SourceTracks = {}
    history, found = begin_history(KALMAN, START_NS, START_NS), []
    for n, (value, accel_mps2) in enumerate(zip(values, [0.0, 0.0, 0.0, *inputs_mps2], strict=True)):
        at_ns = START_NS + (n + 1) * TICK_NS
        captured_ns = at_ns - late_ns if n == len(values) - 1 else at_ns
        one = sample(captured_ns, at_ns, position_m=(value, 0.0, 0.0))
        history, _, _ = absorb_samples(KALMAN, history, at_ns, ())
        observation = PredictedSample(one, np.array([0.001]), KALMAN, history, is_flying, ALWAYS, PARAMETERS)
        records, verdict = update(records, observation)
        if verdict.is_none:
            history, _, _ = absorb_samples(KALMAN, history, at_ns, (one,))
        history = note_input(history, at_ns, np.array([accel_mps2]))
        open_loop_belief = records["camera"].open_loop_belief
        found.append((verdict.cause, math.nan if open_loop_belief is None else float(open_loop_belief.mean[0])))
    return found


@pytest.mark.parametrize(
    ("inputs_mps2", "within_m", "cause"),
    [
        ([4.0] * 2 + [-4.0] * 12, 0.015, EventCode.SAMPLE_REPEATED),
        ([4.0] * 8 + [-4.0] * 25, 0.1, EventCode.SAMPLE_FROZEN),
    ],
)
def test_a_source_that_was_found_out_is_not_believed_though_inputs_come_back_to_its_value(
    inputs_mps2: list[float], within_m: float, cause: EventCode
) -> None:
    last, predicted_m = judged(inputs_mps2)[-1]
    assert predicted_m == pytest.approx(0.02, abs=within_m)  # so near that this repeat alone is no reason
    assert last == cause
    assert judged(inputs_mps2, next_m=0.03)[-1][0] is None


def test_a_vehicle_on_the_ground_may_repeat_its_value_and_a_late_sample_says_nothing() -> None:
    assert {cause for cause, _ in judged([4.0] * 20, is_flying=False)} == {None}
    assert judged([4.0] * 20)[-1][0] == EventCode.SAMPLE_FROZEN
    assert judged([4.0] * 20, late_ns=TICK_NS + MS)[-1][0] is None
