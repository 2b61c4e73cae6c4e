"""The monitor of inertial data: what makes them distrusted, and what ends that."""

from __future__ import annotations

import math

import numpy as np
import pytest

from uavctl.event_codes import EventCode
from uavctl.flight.monitors.inertial import (
    UNUSED,
    ComparedSource,
    InertialObservation,
    InertialTrust,
    contradict_model_alone,
    is_consistent,
    is_plausible,
    update,
)
from uavctl.flight.monitors.verdict import Action, Verdict

S = 1_000_000_000
SINCE_NS = 5 * S


def compare(
    trust: InertialTrust, source: ComparedSource, agrees: bool, at_ns: int, captured_ns: int = 0
) -> InertialTrust:
    """The state after a comparison; a verdict comes if and only if distrust begins."""
    after, verdict = update(trust, InertialObservation(source, agrees, at_ns, captured_ns))
    begins = trust.distrusted_ns is None and after.distrusted_ns is not None
    assert verdict == (
        Verdict(Action.DISTRUST_INERTIAL, EventCode.INERTIAL_DOUBTED, since_ns=at_ns) if begins else Verdict()
    )
    assert verdict.is_none != begins
    return after


def test_three_readings_in_a_row_that_the_model_refuses_are_distrusted() -> None:
    trust = UNUSED
    for at_ns, agrees in enumerate((True, False, False, True, False, False), start=1):
        trust = compare(trust, ComparedSource.MODEL, agrees, at_ns)
    assert (trust.used_ns, trust.refused, trust.distrusted_ns) == (4, 2, None)
    assert compare(trust, ComparedSource.MODEL, False, 7).distrusted_ns == 7


def test_the_model_alone_was_the_reason_where_three_readings_were_refused() -> None:
    refused = InertialTrust(used_ns=5, refused=2)
    distrusted = compare(refused, ComparedSource.MODEL, False, 7)
    assert contradict_model_alone(distrusted) and not contradict_model_alone(refused)
    for source in (ComparedSource.POSITION, ComparedSource.VEHICLE_VELOCITY):
        assert not contradict_model_alone(compare(refused, source, False, 7, captured_ns=4))


@pytest.mark.parametrize("source", [ComparedSource.POSITION, ComparedSource.VEHICLE_VELOCITY])
@pytest.mark.parametrize(
    ("used_ns", "captured_ns", "agrees", "distrusted"),
    [
        (5, 4, False, True),
        (5, 5, False, False),  # no reading has carried the estimate on since that position
        (None, 4, False, False),
        (5, 4, True, False),
    ],
)
def test_inertial_data_are_distrusted_if_they_carried_the_estimate_somewhere_else(
    source: ComparedSource, used_ns: int | None, captured_ns: int, agrees: bool, distrusted: bool
) -> None:
    trust = InertialTrust(used_ns=used_ns, refused=1)
    after = compare(trust, source, agrees, 9, captured_ns)
    assert after == InertialTrust(used_ns=used_ns, refused=1, distrusted_ns=9 if distrusted else None)


@pytest.mark.parametrize(
    ("source", "agrees", "after_ns", "age_ns", "ends"),
    [
        (ComparedSource.POSITION, True, 3 * S, S, True),
        (ComparedSource.POSITION, True, 3 * S - 1, S, False),
        (ComparedSource.POSITION, True, 9 * S, S + 1, False),  # after a silence nearly every position agrees
        (ComparedSource.POSITION, False, 9 * S, S, False),
        (ComparedSource.MODEL, True, 9 * S, S, False),
        (ComparedSource.VEHICLE_VELOCITY, True, 9 * S, S, False),
    ],
)
def test_only_a_position_that_agrees_ends_distrust_and_no_sooner_than_three_seconds(
    source: ComparedSource, agrees: bool, after_ns: int, age_ns: int, ends: bool
) -> None:
    trust = InertialTrust(used_ns=7, refused=3, distrusted_ns=SINCE_NS)
    at_ns = SINCE_NS + after_ns
    after = compare(trust, source, agrees, at_ns, at_ns - age_ns)
    assert after == (InertialTrust(used_ns=7) if ends else trust)


@pytest.mark.parametrize("axis", range(3))
def test_a_reading_is_plausible_up_to_three_standard_deviations_in_each_axis(axis: int) -> None:
    stds = np.array([0.5, 1.0, 2.0])
    for share, plausible in ((3.0, True), (-3.0, True), (3.001, False), (-3.001, False)):
        innovation = np.zeros(3)
        innovation[axis] = share * stds[axis]
        assert is_plausible(tuple(innovation), tuple(stds**2)) is plausible


def test_a_position_is_consistent_up_to_a_squared_distance_of_40() -> None:
    assert is_consistent(40.0)
    assert not is_consistent(math.nextafter(40.0, 41.0))
