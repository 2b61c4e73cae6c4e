"""What counts as fresh, and in a row."""

from __future__ import annotations

import pytest
from flight_rig import DT_NS, MS, START_NS, TICK_NS, estimator_parameters, sample, small_plant

from uavctl.data import PositionSample, StepInput
from uavctl.flight.estimator import begin
from uavctl.flight.kalman import make_kalman
from uavctl.flight.samples import Intake, take

KALMAN = make_kalman(small_plant(), estimator_parameters(), DT_NS)


def taken(ticks: list[tuple[int, list[PositionSample]]], fresh: int = 0) -> Intake:
    """Intake after several ticks, each (time in ms, samples)."""
    intake = Intake(history=begin(KALMAN, START_NS, START_NS), accepted=0, refused=(), fresh=fresh)
    for at_ms, samples in ticks:
        inp = StepInput(tick=at_ms // 50, at_ns=START_NS + at_ms * MS, samples=tuple(samples))
        intake = take(KALMAN, intake.history, inp, TICK_NS, intake.fresh)
    return intake


def captured(at_ms: int, source: str = "camera", received_ms: int | None = None) -> PositionSample:
    received_ns = None if received_ms is None else START_NS + received_ms * MS
    return sample(START_NS + at_ms * MS, received_ns, source=source)


def test_samples_of_one_a_step_are_in_a_row() -> None:
    assert taken([(at, [captured(at)]) for at in (0, 200, 400, 600)]).fresh == 4


def test_several_in_one_tick_count_each() -> None:
    assert taken([(100, [captured(60), captured(20), captured(100)])]).fresh == 3


@pytest.mark.parametrize(("gap_ms", "fresh"), [(300, 3), (301, 1)])
def test_a_gap_of_more_than_one_and_a_half_steps_begins_the_row_anew(gap_ms: int, fresh: int) -> None:
    assert taken([(0, [captured(0)]), (200, [captured(200)]), (600, [captured(200 + gap_ms)])]).fresh == fresh


@pytest.mark.parametrize(("age_ms", "fresh"), [(199, 2), (200, 0)])
def test_a_sample_as_old_as_a_step_breaks_the_row(age_ms: int, fresh: int) -> None:
    assert taken([(200, [captured(150)]), (400, [captured(400 - age_ms)])]).fresh == fresh


def test_an_overtaken_sample_changes_nothing() -> None:
    assert taken([(200, [captured(200)]), (250, [captured(150)])]).fresh == 1


def test_the_same_instant_from_a_second_source_counts_once() -> None:
    intake = taken([(200, [captured(200), captured(200, source="second")])])
    assert (intake.accepted, intake.fresh) == (2, 1)


def test_refused_samples_do_not_count() -> None:
    again = captured(200)
    future = captured(501, received_ms=450)
    intake = taken([(200, [again]), (450, [again, future])])
    assert (intake.fresh, intake.accepted) == (1, 0)
    assert sorted(intake.refused) == ["sample-duplicate", "sample-future"]


def test_a_stamp_within_the_tolerance_after_the_arrival_is_taken() -> None:
    intake = taken([(450, [captured(500, received_ms=450)])])
    assert (intake.accepted, intake.history.captured_ns) == (1, START_NS + 450 * MS)
