"""The envelope's observer against a textbook filter, and what it and the vehicle's own velocity make of positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from envelope_rig import (
    AT_NS,
    AT_REST,
    LOOK_NS,
    NAN3,
    PARAMETERS,
    TICK_NS,
    changed,
    is_inertial_inconsistent,
    is_prediction_inconsistent,
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
from scipy.linalg import expm

from uavctl.arrays import SECOND_NS
from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors.braking import BrakingState
from uavctl.flight.monitors.engaged import INITIAL, MonitorState
from uavctl.flight.monitors.observation import Observation
from uavctl.flight.monitors.observer import Observer
from uavctl.flight.monitors.vehicle_velocity import VelocityObservation, find_confirmed_velocity, judge_braking
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import Action
from uavctl.flight.supervise import ENVELOPE_CODES
from uavctl.records import Vec3, VehicleMotion

# The observer


class Textbook:
    """A Kalman filter of (position, velocity, unexplained acceleration) of an axis; the lag is exact."""

    def __init__(
        self,
        at_ns: int,
        position_m: float,
        velocity_mps: float,
        velocity_std_mps: float,
        lag_s: float,
        unexplained_mps2: float = 2.0,
    ):
        self.at_ns = at_ns
        self.mean = np.array([position_m, velocity_mps, 0.0])
        self.cov = np.diag([0.02**2, velocity_std_mps**2, (unexplained_mps2 / 3.0) ** 2])
        self.unexplained_mps2 = unexplained_mps2
        self.accel = 0.0
        self.lag_s = lag_s

    def predict(self, at_ns: int, inputs: Sequence[tuple[int, float]]) -> None:
        g = np.zeros((5, 5))  # of (position, velocity, unexplained, acceleration, setpoint)
        g[0, 1] = g[1, 2] = g[1, 3] = 1.0
        g[3, 3:5] = [-1.0 / self.lag_s, 1.0 / self.lag_s]
        x = np.array([*self.mean, self.accel, 0.0])
        cuts = sorted({self.at_ns, at_ns, *(one for one, _ in inputs if self.at_ns < one < at_ns)})
        for begin_ns, end_ns in pairwise(cuts):
            x[4] = next((u for since_ns, u in reversed(inputs) if since_ns <= begin_ns), 0.0)
            x = expm(g * (end_ns - begin_ns) * 1e-9) @ x
        self.mean, self.accel = x[:3], float(x[3])
        # Van Loan: the noise of a random walk of the unexplained acceleration.
        step = np.zeros((6, 6))
        step[:3, :3], step[3:, 3:] = -g[:3, :3], g[:3, :3].T
        step[2, 5] = self.unexplained_mps2**2
        moved = expm(step * (at_ns - self.at_ns) * 1e-9)
        f = moved[3:, 3:].T
        self.cov = f @ self.cov @ f.T + f @ moved[:3, 3:]
        self.at_ns = at_ns

    def correct(self, position_m: float) -> bool:
        h = np.array([[1.0, 0.0, 0.0]])
        s = float((h @ self.cov @ h.T)[0, 0]) + 0.02**2
        gain = self.cov @ h.T / s
        innovation = position_m - self.mean[0]
        bound = 6.0 * math.sqrt(s)
        self.mean = self.mean + gain[:, 0] * min(max(innovation, -bound), bound)
        self.cov = (np.eye(3) - gain @ h) @ self.cov
        return bool(abs(innovation) > bound)


def same(watching: MonitorState, want: Sequence[Textbook]) -> None:
    observer = watching.motion.observer
    assert observer is not None
    assert {one.at_ns for one in want} == {observer.at_ns}
    for axis, one in enumerate(want):
        np.testing.assert_allclose(observer.mean[:, axis], one.mean, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(observer.cov, one.cov, rtol=1e-7, atol=1e-12)
        assert observer.accel_mps2[axis] == pytest.approx(one.accel, rel=1e-9, abs=1e-11)


@pytest.mark.parametrize(
    ("seed", "lag_s", "unexplained_mps2"), [(0, (0.2, 0.3, 0.4), 3.0), (2, (0.0, 0.001, 0.0005), 2.0)]
)
def test_the_observer_is_the_textbook_s_whatever_comes_when(seed: int, lag_s: Vec3, unexplained_mps2: float) -> None:
    """Setpoints at odd ticks, positions late and in bursts, some of them metres off."""
    rng = np.random.default_rng(seed)
    parameters = replace(PARAMETERS, lag_s=lag_s, unexplained_mps2=unexplained_mps2)
    at_ns, captured_ns = START_NS, START_NS - 7 * MS
    inputs: list[list[tuple[int, float]]] = [[], [], []]
    watching, sent, clipped = INITIAL, ZERO, 0
    books: list[Textbook] = []
    for _ in range(15):
        before_ns, at_ns = at_ns, at_ns + int(rng.integers(20, 120)) * MS
        if rng.random() < 0.4:
            sent = vec3(rng.normal(size=3))
        for axis in range(3):
            inputs[axis].append((before_ns if books else at_ns, sent[axis]))
        samples = []
        for _ in range(rng.integers(0, 4)):
            captured_ns += int(rng.integers(41, 60)) * MS
            if captured_ns > at_ns:
                captured_ns = at_ns
                break
            far = 5.0 if rng.random() < 0.1 else 0.1
            velocity = None if rng.random() < 0.5 else vec3(rng.normal(size=3))
            samples.append(sample(captured_ns, at_ns, vec3(rng.normal(scale=far, size=3)), velocity))
        for one in samples:
            if not books:
                speeds, std = (ZERO, 0.3) if one.velocity_mps is None else (one.velocity_mps, 0.1)
                books = [
                    Textbook(one.captured_ns, p, v, std, max(lag, 0.001), unexplained_mps2)
                    for p, v, lag in zip(one.position_m, speeds, lag_s, strict=True)
                ]
            elif one.captured_ns - books[0].at_ns >= 40 * MS:
                for axis, book in enumerate(books):
                    book.predict(one.captured_ns, inputs[axis])
                    clipped += book.correct(one.position_m[axis])
        watching, _ = update(watching, seen(at_ns, *samples[::-1], sent=sent), parameters)
        if books:
            same(watching, books)
    assert clipped


# What is unexplained


@pytest.mark.parametrize("seed", range(20))
def test_the_drag_that_explains_most_is_taken_away_up_to_a_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, v = rng.normal(size=3), rng.normal(size=3)
    rests = d + np.linspace(0.0, 1.2, 12_001)[:, None] * v
    least = rests[np.argmin(np.sum(rests**2, axis=1))]
    watching, _ = look(vec3(d), vec3(v))
    want = max(math.hypot(least[0], least[1]), abs(least[2]))
    assert watching.acceleration.unexplained_mps2 == pytest.approx(want, abs=2e-3)


@pytest.mark.parametrize(
    ("unexplained", "velocity", "rest_mps2"),
    [
        ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), 0.0),
        ((-2.4, 0.0, 0.0), (2.0, 0.0, 0.0), 0.0),  # drag of 1.2/s
        ((-4.0, 0.0, 0.0), (2.0, 0.0, 0.0), 1.6),  # more than any
        ((1.0, 0.0, 0.0), (2.0, 0.0, 0.0), 1.0),  # drag does not push
        ((0.0, 1.0, 0.0), (2.0, 0.0, 0.0), 1.0),
        ((0.0, 1.0, 0.0), ZERO, 1.0),
        ((0.3, 0.4, 0.0), ZERO, 0.5),
        ((0.3, 0.4, -0.6), ZERO, 0.6),  # of the two, not of both
    ],
)
def test_what_is_left_as_unexplained(unexplained: Vec3, velocity: Vec3, rest_mps2: float) -> None:
    watching, breach = look(unexplained, velocity)
    assert watching.acceleration.unexplained_mps2 == pytest.approx(rest_mps2, abs=1e-12)
    assert breach is None


@pytest.mark.parametrize(
    ("unexplained_mps2", "over_ns", "since_ns", "breached"),
    [
        (2.0, None, None, False),
        (2.0, AT_NS - 200 * MS, None, False),
        (1.5, AT_NS - 200 * MS, None, False),
        (just_more(2.0), None, AT_NS, False),
        (just_more(2.0), AT_NS - 100 * MS + 1, AT_NS - 100 * MS + 1, False),
        (just_more(2.0), AT_NS - 100 * MS, AT_NS - 100 * MS, True),
        (just_more(2.0), AT_NS - 150 * MS, AT_NS - 150 * MS, True),
        (just_less(3.0), None, AT_NS, False),
        (3.0, None, AT_NS, True),
        (-3.0, None, AT_NS, True),
    ],
)
def test_an_acceleration_beyond_the_bound_has_to_persist_and_a_plain_one_has_not(
    unexplained_mps2: float, over_ns: int | None, since_ns: int | None, breached: bool
) -> None:
    for axis in range(3):
        d = [0.0, 0.0, 0.0]
        d[axis] = unexplained_mps2
        watching, breach = look(vec3(d), over_ns=over_ns)
        assert watching.acceleration.unexplained_mps2 == abs(unexplained_mps2)
        assert watching.acceleration.over_ns == since_ns
        assert (breach is not None) == breached
        assert breach is None or breach.cause == EventCode.RESPONSE


@pytest.mark.parametrize(
    ("unexplained_mps2", "off_m", "apart", "clean"),
    [
        (1.0, 0.0, False, True),
        (just_more(1.0), 0.0, False, False),
        (0.0, 0.1, False, True),
        (0.0, 0.2, False, False),
        (0.0, -0.2, False, False),
        (0.0, 0.0, True, False),
    ],
)
def test_clean_is_what_nothing_speaks_against(unexplained_mps2: float, off_m: float, apart: bool, clean: bool) -> None:
    known = offsets(0.3) if apart else {}
    watching, _ = look(
        (unexplained_mps2, 0.0, 0.0), off_m=off_m, vehicle_motion=AT_REST, consistent_ns=START_NS - 5, **known
    )
    assert (watching.velocity.apart_ns is not None) == apart
    assert watching.consistent_ns == (AT_NS if clean else START_NS - 5)


@pytest.mark.parametrize(
    ("before", "off_m", "breached"),
    [
        ((True, True), 0.2, True),
        ((True, False, False, True), 0.2, True),
        ((True, True, False, False, False), 0.2, False),
        ((True, False), 0.2, False),
        ((True, True), 0.1, False),
        ((True, True, True, True, False), 0.0, True),  # it persists
        ((True, True, True), 0.2, True),
        ((True, True, True, True), 0.2, True),
    ],
)
def test_three_of_five_positions_that_are_far_off_are_no_chance(
    before: tuple[bool, ...], off_m: float, breached: bool
) -> None:
    watching, breach = look(ZERO, off_m=off_m, clipped=before)
    assert watching.acceleration.clipped == (*before, off_m > 0.15)[-5:]
    assert (None if breach is None else breach.cause) == (EventCode.SCATTER if breached else None)


def test_an_innovation_counts_up_to_six_standard_deviations() -> None:
    at_rest = Observer(at_ns=START_NS, mean=np.zeros((3, 3)), cov=np.diag([0.0021, 0, 0]), accel_mps2=np.zeros(3))
    at_ns = START_NS + 40 * MS
    book = Textbook(START_NS, 0.0, 0.0, 0.0, 0.2)
    book.cov = at_rest.cov
    book.predict(at_ns, [])
    bound_m = 6.0 * math.sqrt(float(book.cov[0, 0]) + 0.0004)
    assert bound_m == pytest.approx(0.3, abs=1e-5)
    for off_m, clipped in ((0.299, False), (0.301, True), (-0.299, False), (-0.301, True)):
        for axis in range(3):
            place = [0.0, 0.0, 0.0]
            place[axis] = off_m
            watching, _ = update(
                monitors(observer=at_rest), seen(at_ns, sample(at_ns, position_m=vec3(place))), PARAMETERS
            )
            assert watching.acceleration.clipped == (clipped,)


def test_an_innovation_at_its_bound_is_not_clipped() -> None:
    bound_m = 6.0 * math.sqrt(2.0**2 * ((LOOK_NS * 1e-9) ** 5 / 20) + 0.02**2)
    for off_m, clipped in ((bound_m, False), (just_more(bound_m), True)):
        watching, _ = look(ZERO, off_m=off_m)
        assert watching.acceleration.clipped == (clipped,)


@pytest.mark.parametrize(
    ("since_ns", "counts"), [(40 * MS, True), (40 * MS - 1, False), (0, False), (-SECOND_NS, False)]
)
def test_positions_that_are_late_or_close_to_one_another_say_nothing_new(since_ns: int, counts: bool) -> None:
    watching, _ = update(INITIAL, seen(START_NS, sample(START_NS)), PARAMETERS)
    at_ns = START_NS + 80 * MS
    after, _ = update(watching, seen(at_ns, sample(START_NS + since_ns, at_ns)), PARAMETERS)
    assert after.motion.observer is not None
    assert (after.motion.observer is not watching.motion.observer) == counts
    assert after.consistent_ns == after.motion.observer.at_ns == START_NS + (since_ns if counts else 0)


def test_a_stamp_after_the_arrival_counts_as_the_arrival() -> None:
    watching, _ = update(INITIAL, seen(START_NS, sample(START_NS + 9 * MS, START_NS - MS)), PARAMETERS)
    assert watching.motion.observer is not None and watching.motion.observer.at_ns == START_NS - MS


@pytest.mark.parametrize(
    ("silent_ns", "anew"), [(3 * SECOND_NS, True), (3 * SECOND_NS + MS, True), (3 * SECOND_NS - 1, False)]
)
def test_after_a_long_silence_the_observer_begins_anew(silent_ns: int, anew: bool) -> None:
    watching, _ = update(INITIAL, seen(START_NS, sample(START_NS)), PARAMETERS)
    watching = changed(watching, clipped=(True, True), over_ns=START_NS, consistent_ns=1)
    captured_ns, at_ns = START_NS + silent_ns - 30 * MS, START_NS + silent_ns
    far = sample(captured_ns, at_ns, (0.5, 0.0, 0.0))
    after, breach = update(watching, seen(at_ns, far), PARAMETERS)
    assert after.motion.observer is not None and breach is None
    if anew:
        np.testing.assert_array_equal(after.motion.observer.mean, [[0.5, 0.0, 0.0], ZERO, ZERO])
        np.testing.assert_allclose(np.diagonal(after.motion.observer.cov), [0.0004, 4.0, 4.0 / 9.0])
        assert (after.acceleration.clipped, after.acceleration.over_ns, after.consistent_ns) == ((), None, captured_ns)
    else:
        assert after.acceleration.clipped == (True, True, False)


def test_what_was_sent_is_remembered_for_three_seconds_and_no_longer() -> None:
    rng = np.random.default_rng(1)
    watching = INITIAL
    all_sent: list[tuple[int, Vec3]] = []
    for n in range(200):
        at_ns = START_NS + n * TICK_NS
        sent = (float(rng.integers(0, 3)), 0.0, 0.0) if n > 90 else (float(n % 7 == 0), 0.0, 0.0)
        watching, _ = update(watching, seen(at_ns, sent=sent), PARAMETERS)
        if not all_sent or all_sent[-1][1] != sent:
            all_sent.append((at_ns - TICK_NS if n else at_ns, sent))
        old = [one for one in all_sent if one[0] <= at_ns - 3 * SECOND_NS]
        assert watching.motion.sent == (*old[-1:], *(one for one in all_sent if one[0] > at_ns - 3 * SECOND_NS))
        assert watching.motion.tick_ns == at_ns


def test_of_what_was_sent_earlier_only_the_last_still_acts() -> None:
    sent = tuple((AT_NS - 5 * SECOND_NS + n * SECOND_NS, (float(n), 0.0, 0.0)) for n in range(5))
    watching, _ = update(monitors(tick_ns=START_NS, sent=sent), seen(AT_NS + 1, sent=sent[-1][1]), PARAMETERS)
    assert watching.motion.sent == sent[2:]


# What is not known counts less


def test_a_flight_that_began_before_its_first_position_has_the_velocity_that_was_sent() -> None:
    watching, sent = INITIAL, (1.0, -0.5, 0.0)
    for n in range(21):
        watching, _ = update(watching, seen(START_NS + n * TICK_NS, sent=sent), PARAMETERS)
    at_ns = START_NS + SECOND_NS
    watching, breach = update(watching, seen(at_ns, sample(at_ns, at_ns, (7.0, 8.0, -9.0)), sent=sent), PARAMETERS)
    assert breach is None and watching.motion.observer is not None
    left = [math.exp(-1.0 / lag_s) for lag_s in PARAMETERS.lag_s]
    velocity = [u * (1.0 - lag_s * (1.0 - e)) for u, lag_s, e in zip(sent, PARAMETERS.lag_s, left, strict=True)]
    np.testing.assert_allclose(watching.motion.observer.mean, [(7.0, 8.0, -9.0), velocity, ZERO], atol=1e-12)
    np.testing.assert_allclose(
        watching.motion.observer.accel_mps2, [u * (1.0 - e) for u, e in zip(sent, left, strict=True)]
    )
    # Gusts have had a second for it.
    assert watching.motion.observer.cov[1, 1] == pytest.approx((0.3 + 0.3 * 2.0 * 1.0) ** 2)


def test_a_first_position_has_the_velocity_of_all_that_was_sent_before() -> None:
    rng, watching = np.random.default_rng(6), INITIAL
    for n in range(31):
        at_ns = START_NS + n * TICK_NS
        first = [sample(at_ns)] if n == 30 else []
        watching, _ = update(watching, seen(at_ns, *first, sent=vec3(rng.uniform(-2.0, 2.0, 3))), PARAMETERS)
    assert watching.motion.observer is not None
    np.testing.assert_allclose(watching.motion.observer.mean[1], watching.motion.model_mps, atol=1e-12)
    np.testing.assert_allclose(watching.motion.observer.accel_mps2, watching.motion.model_mps2, atol=1e-12)
    # Gusts have had a second and a half for it.
    assert watching.motion.observer.cov[1, 1] == pytest.approx((0.3 + 0.3 * 2.0 * 1.5) ** 2)


@pytest.mark.parametrize(("std_m", "noise_m"), [(0.005, 0.02), (0.02, 0.02), (0.1, 0.1)])
def test_a_position_counts_by_its_own_standard_deviation(std_m: float, noise_m: float) -> None:
    begun, _ = update(INITIAL, seen(START_NS, sample(START_NS, std_m=std_m)), PARAMETERS)
    assert begun.motion.observer is not None
    assert begun.motion.observer.cov[0, 0] == pytest.approx(noise_m**2)
    observer = Observer(START_NS, np.zeros((3, 3)), np.diag([0.01, 0.0, 0.0]), np.zeros(3))
    later = sample(AT_NS, AT_NS, (0.1, 0.0, 0.0), std_m=std_m)
    watching, _ = update(monitors(observer=observer, tick_ns=START_NS), seen(AT_NS, later), PARAMETERS)
    assert watching.motion.observer is not None
    wanders = (PARAMETERS.unexplained_mps2 * math.sqrt((LOOK_NS * 1e-9) ** 5 / 20)) ** 2
    gain = (0.01 + wanders) / (0.01 + wanders + noise_m**2)
    assert watching.motion.observer.mean[0, 0] == pytest.approx(0.1 * gain)


def unsure(unexplained_mps2: float, std_mps2: float) -> MonitorState:
    """What comes of a position that tells next to nothing, where the observer knows so much."""
    mean = np.array([ZERO, ZERO, (unexplained_mps2, 0.0, 0.0)])
    observer = Observer(START_NS, mean, np.diag([0.0, 0.0, std_mps2**2]), np.zeros(3))
    s = LOOK_NS * 1e-9
    there = sample(AT_NS, AT_NS, (0.5 * unexplained_mps2 * s * s, 0.0, 0.0), std_m=50.0)
    watching, _ = update(monitors(observer=observer, tick_ns=START_NS), seen(AT_NS, there), PARAMETERS)
    assert watching.acceleration.unexplained_mps2 == pytest.approx(unexplained_mps2, rel=1e-6)
    return watching


@pytest.mark.parametrize(("std_mps2", "over"), [(0.0, True), (1.55, True), (1.6, False)])
def test_an_acceleration_that_may_as_well_be_none_is_none(std_mps2: float, over: bool) -> None:
    assert (unsure(2.5, std_mps2).acceleration.over_ns is not None) == over


def test_an_acceleration_of_just_so_many_standard_deviations_is_none() -> None:
    observer = unsure(0.0, 1.6).motion.observer
    assert observer is not None
    bound_mps2 = 1.5 * math.sqrt(observer.cov[2, 2])
    assert bound_mps2 > PARAMETERS.unexplained_mps2
    assert unsure(bound_mps2, 1.6).acceleration.over_ns is None
    assert unsure(just_more(bound_mps2), 1.6).acceleration.over_ns is not None


# The vehicle's own velocity as a witness


def told(velocity: Vec3, predicted: Vec3, **known: object) -> tuple[MonitorState, Observation]:
    """Half a second into a flight by what was sent, the vehicle's word, and a prediction."""
    watching = changed(monitors(tick_ns=AT_NS, began_ns=AT_NS - 500 * MS), **known)
    return watching, structs.replace(seen(AT_NS, vehicle_motion=motion(velocity, AT_NS)), velocity_mps=predicted)


@pytest.mark.parametrize(
    ("velocity", "predicted", "flown", "apart_mps", "braked_on"),
    [
        ((1.0, 0.0, 0.0), (1.25, 0.0, 0.0), (9.0, 0.0, 0.0), None, True),  # near the prediction
        ((1.0, 0.0, 0.0), (1.26, 0.0, 0.0), (9.0, 0.0, 0.0), None, False),
        ((1.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 0.0, 0.0), 0.1, True),  # positions agreed with it
        ((1.0, 0.0, 0.0), (9.0, 0.0, 0.0), (1.849, 0.0, 0.0), None, True),  # near what was sent, and gusts of 0.5 s
        ((1.0, 0.0, 0.0), (9.0, 0.0, 0.0), (1.851, 0.0, 0.0), None, False),
        ((0.0, 0.0, 1.0), (NAN3[0], NAN3[1], NAN3[2]), (9.0, 0.0, 0.0), None, True),  # the plant has no such axes
    ],
)
def test_who_speaks_for_the_vehicle_s_own_velocity(
    velocity: Vec3, predicted: Vec3, flown: Vec3, apart_mps: float | None, braked_on: bool
) -> None:
    watching, tick = told(velocity, predicted, model_mps=flown, apart_mps=apart_mps)
    assert trusted_velocity(watching, tick, 0.0, PARAMETERS) == (velocity if braked_on else None)
    assert trusted_velocity(changed(watching, is_contradicted=True), tick, 0.0, PARAMETERS) is None


def test_what_was_sent_is_a_witness_for_ten_seconds() -> None:
    watching, tick = told(ZERO, (9.0, 0.0, 0.0))
    assert trusted_velocity(changed(watching, began_ns=AT_NS - 10 * SECOND_NS), tick, 0.0, PARAMETERS) == ZERO
    assert trusted_velocity(changed(watching, began_ns=AT_NS - 10 * SECOND_NS - 1), tick, 0.0, PARAMETERS) is None
    assert trusted_velocity(changed(watching, began_ns=None), tick, 0.0, PARAMETERS) is None


@pytest.mark.fault(94)
def test_a_prediction_misleads_sooner_where_the_own_velocity_is_supported() -> None:
    for apart_mps, inconsistent in ((0.5, False), (0.51, True)):
        watching, tick = told(ZERO, (0.0, -apart_mps, 0.0), apart_mps=0.1)
        supported = structs.replace(watching, velocity_change=VelocityChangeState(agreed_ns=AT_NS, supported_ns=AT_NS))
        assert is_prediction_inconsistent(supported, tick, 0.0, PARAMETERS) == inconsistent
        assert not is_prediction_inconsistent(watching, tick, 0.0, PARAMETERS)


@pytest.mark.fault(94)
@pytest.mark.parametrize(
    ("own", "predicted", "began_mps", "ends"),
    [
        ((0.3, 0.0, 0.0), (-0.3, 0.0, 0.0), 0.199, True),
        ((0.3, 0.0, 0.0), (0.3, 0.0, 0.0), 0.2, False),  # both point the same way
        ((0.3, 0.0, 0.0), (-0.15, 0.3, 0.0), 0.2, False),  # apart by less than 120°
        ((0.3, 0.0, 0.0), (-0.18, 0.3, 0.0), 0.199, True),
        ((0.3, 0.0, 0.0), (-0.3, 0.0, 0.0), 0.201, False),  # braking does not make it faster
        ((0.3, 0.0, 0.0), (-0.3, 0.0, 0.0), None, False),  # it does not brake on it
        ((0.3, 0.0, 0.0), (-0.24, 0.0, 0.0), 0.1, False),  # gusts turn so slow a prediction
        ((0.24, 0.0, 0.0), (-0.3, 0.0, 0.0), 0.1, False),
        ((0.0, 0.0, 0.3), (-0.3, 0.0, NAN3[0]), 0.1, False),  # the plant has no such axis
        ((0.3, 0.0, 0.0), (-0.3, 0.0, NAN3[0]), 0.1, True),
    ],
)
def test_braking_by_a_velocity_that_it_makes_grow_ends(
    own: Vec3, predicted: Vec3, began_mps: float | None, ends: bool
) -> None:
    braking = BrakingState(None if began_mps is None else (AT_NS - SECOND_NS, began_mps))
    watching = structs.replace(INITIAL, braking=braking)
    observation = VelocityObservation(watching, AT_NS, own, predicted, 3.0, PARAMETERS)
    verdict = judge_braking(observation)
    assert (verdict.action is Action.END_PLANS, verdict.is_none) == (ends, not ends)
    assert judge_braking(structs.replace(observation, own_mps=None)).is_none


@pytest.mark.parametrize(
    ("apart_mps", "age_s", "inconsistent"), [(1.0, 0.0, False), (1.01, 0.0, True), (1.6, 1.0, False)]
)
def test_a_prediction_far_off_the_vehicle_s_own_velocity_misleads(
    apart_mps: float, age_s: float, inconsistent: bool
) -> None:
    watching, tick = told(ZERO, (0.0, -apart_mps, 0.0), apart_mps=0.1)
    assert is_prediction_inconsistent(watching, tick, age_s, PARAMETERS) == inconsistent
    assert not is_prediction_inconsistent(changed(watching, is_contradicted=True), tick, age_s, PARAMETERS)


@pytest.mark.parametrize(
    ("apart_mps", "agreed_mps", "age_s", "is_contradicted"),
    [
        (0.25, 0.1, 0.0, False),
        (0.26, 0.1, 0.0, True),
        (0.26, 0.1, 9.0, True),  # what was felt since has gusts in it: the age of the positions excuses nothing
        (0.26, None, 9.0, True),  # gusts may have made as much, so it is believed without positions, too
        (0.26, None, 0.0, False),  # but where nothing speaks for it, it contradicts nobody
    ],
)
def test_inertial_data_are_contradicted_by_a_velocity_that_may_be_believed(
    apart_mps: float, agreed_mps: float | None, age_s: float, is_contradicted: bool
) -> None:
    watching, tick = told(ZERO, (0.0, 0.0, apart_mps), apart_mps=agreed_mps, model_mps=(9.0, 0.0, 0.0))
    assert is_inertial_inconsistent(watching, tick, age_s, PARAMETERS) == is_contradicted
    assert not is_inertial_inconsistent(changed(watching, is_contradicted=True), tick, age_s, PARAMETERS)
    assert not is_inertial_inconsistent(watching, structs.replace(tick, motion=None), age_s, PARAMETERS)


def test_a_witness_is_who_agreed_with_positions_and_still_speaks() -> None:
    velocity: Vec3 = (1.0, -2.0, 0.5)
    words, agreed = motion(velocity, AT_NS), monitors(apart_mps=0.1)
    assert find_confirmed_velocity(agreed, words, AT_NS) == velocity
    assert find_confirmed_velocity(agreed, None, AT_NS) is None
    assert find_confirmed_velocity(agreed, words, AT_NS + 60 * SECOND_NS) is None
    assert find_confirmed_velocity(changed(agreed, is_contradicted=True), words, AT_NS) is None
    assert find_confirmed_velocity(monitors(), words, AT_NS) is None  # no position has been compared with it


def test_what_was_sent_acts_behind_the_lag_from_tick_to_tick() -> None:
    rng, watching, at_ns = np.random.default_rng(4), INITIAL, START_NS
    velocity, accel, sent = np.zeros(3), np.zeros(3), ZERO
    for n in range(30):
        for_ns = TICK_NS * (10 if n % 5 == 4 else 1)  # now and then one is late
        at_ns += for_ns if n else 0
        watching, _ = update(watching, seen(at_ns, sent=sent), PARAMETERS)
        if n:
            for axis, lag_s in enumerate(PARAMETERS.lag_s):
                step = expm(np.array([[0, 1, 0], [0, -1 / lag_s, 1 / lag_s], [0, 0, 0]]) * for_ns * 1e-9)
                velocity[axis], accel[axis], _ = step @ (velocity[axis], accel[axis], sent[axis])
        np.testing.assert_allclose(watching.motion.model_mps, velocity, atol=1e-12)
        np.testing.assert_allclose(watching.motion.model_mps2, accel, atol=1e-12)
        sent = vec3(rng.uniform(-2.0, 2.0, 3))
    assert watching.motion.began_ns == START_NS


def test_what_is_recorded_of_it_is_plain_numbers() -> None:
    watching, _ = look((0.1, 0.2, -0.9), vehicle_motion=AT_REST, **offsets(0.1))
    assert [type(watching.acceleration.unexplained_mps2), type(watching.velocity.apart_mps)] == [float, float]


# No clock's zero says anything


def later(watching: MonitorState, by_ns: int) -> MonitorState:
    """The same, all of it so much later."""

    def moved(rows: tuple[tuple[Any, ...], ...]) -> tuple[tuple[Any, ...], ...]:
        return tuple((at_ns + by_ns, *values) for at_ns, *values in rows)

    def at(group: str, name: str) -> Any:
        return getattr(getattr(watching, group), name)

    names = (
        ("motion", "tick_ns"),
        ("motion", "began_ns"),
        ("motion", "resumed_ns"),
        ("acceleration", "over_ns"),
        ("velocity", "apart_ns"),
        ("braking", "paused_ns"),
    )
    times = {name: at(group, name) + by_ns for group, name in names if at(group, name) is not None}
    if watching.consistent_ns is not None:
        times["consistent_ns"] = watching.consistent_ns + by_ns
    if watching.outside.since_ns is not None:
        times["outside_ns"] = watching.outside.since_ns + by_ns
    pairs = (("motion", "sent"), ("motion", "vehicle_path"), ("velocity", "offsets"), ("velocity", "places"))
    rows = {name: moved(at(group, name)) for group, name in pairs}
    change = watching.velocity_change
    names_of_change: tuple[str, ...] = ("agreed_ns", "supported_ns", "confirmed_ns", "disagrees_ns", "right_ns")
    names_of_change += ("velocity_wrong_ns", "inertial_wrong_ns")
    change_times: dict[str, Any] = {
        name: getattr(change, name) + by_ns for name in names_of_change if getattr(change, name) is not None
    }
    if change.repeated is not None:
        change_times["repeated"] = (*change.repeated[:2], change.repeated[2] + by_ns)
    change_later = structs.replace(change, samples=moved(change.samples), lone=moved(change.lone), **change_times)
    response, (inertial_ns, own) = watching.response, (watching.response.inertial_ns, watching.response.velocity)
    response_later = structs.replace(
        response,
        requested=moved(response.requested),
        samples=moved(response.samples),
        inertial_ns=None if inertial_ns is None else inertial_ns + by_ns,
        velocity=None if own is None else (own[0] + by_ns, own[1]),
    )
    watching = structs.replace(watching, velocity_change=change_later, response=response_later)
    observer, braking = watching.motion.observer, watching.braking.began
    return changed(
        watching,
        observer=None if observer is None else structs.replace(observer, at_ns=observer.at_ns + by_ns),
        braking=None if braking is None else moved((braking,))[0],
        **times,
        **rows,
    )


def random_tick(rng: np.random.Generator, at_ns: int, before: Observation) -> Observation:
    """A tick that may bring anything; much stays as it was before."""

    def anew(chance: float) -> bool:
        return bool(rng.random() < chance)

    samples = []
    for late_ms in sorted(rng.integers(0, 100, size=rng.integers(0, 3)), reverse=True):
        scale = 5.0 if anew(0.05) else 0.01
        samples.append(sample(at_ns - int(late_ms) * MS, at_ns, vec3(rng.normal(scale=scale, size=3))))
    was = before.motion
    words = VehicleMotion(
        velocity_mps=vec3(rng.normal(scale=0.3, size=3)) if was is None or anew(0.1) else was.velocity_mps,
        velocity_ns=at_ns if was is None or not anew(0.2) else was.velocity_ns,
        attitude_rad=vec3(rng.normal(scale=0.2, size=3)),
        attitude_ns=at_ns if was is None or anew(0.3) else was.attitude_ns,
    )
    return Observation(
        at_ns=at_ns,
        samples=samples,
        sent_mps2=vec3(rng.normal(scale=0.5, size=3)) if anew(0.2) else before.sent_mps2,
        position_m=vec3(rng.uniform((-4, 0, -3), (4, 0, -2))) if anew(0.2) else before.position_m,
        velocity_mps=vec3(rng.normal(scale=0.3, size=3)),
        motion=None if anew(0.02) else words,
        braking=before.braking != anew(0.05),
    )


def tick_later(tick: Observation, by_ns: int) -> Observation:
    words = tick.motion
    return structs.replace(
        tick,
        at_ns=tick.at_ns + by_ns,
        samples=[
            structs.replace(one, captured_ns=one.captured_ns + by_ns, received_ns=one.received_ns + by_ns)
            for one in tick.samples
        ],
        motion=words
        and structs.replace(
            words,
            velocity_ns=None if words.velocity_ns is None else words.velocity_ns + by_ns,
            attitude_ns=None if words.attitude_ns is None else words.attitude_ns + by_ns,
        ),
    )


def plain(watching: MonitorState) -> Any:
    return msgspec.to_builtins(watching, enc_hook=lambda array: array.tolist())


def test_what_time_it_is_makes_no_difference() -> None:
    """The same flights under a clock whose zero is long after them, and under one whose zero is as they begin."""
    found: set[EventCode | None] = set()
    for seed in range(6):
        by_ns = MS - START_NS if seed % 3 == 2 else -1000 * SECOND_NS
        rng, at_ns = np.random.default_rng(seed), START_NS + 1
        one = two = INITIAL
        tick = seen(at_ns)
        for n in range(60):
            tick = random_tick(rng, at_ns, tick)
            tick = structs.replace(tick, samples=tick.samples if n > seed else ())  # the first ones come a little later
            same_tick = tick_later(tick, by_ns)
            one, breach = update(one, tick, PARAMETERS)
            two, same_breach = update(two, same_tick, PARAMETERS)
            found |= {breach.cause} if breach else set()
            assert same_breach == breach
            assert plain(two) == plain(later(one, by_ns))
            assert two.confirms_positions == one.confirms_positions
            for says in (trusted_velocity, is_prediction_inconsistent):
                assert says(two, same_tick, 0.1, PARAMETERS) == says(one, tick, 0.1, PARAMETERS)
            at_ns += int(rng.choice([int(rng.integers(30, 90)), 400, 3500], p=[0.96, 0.03, 0.01])) * MS
    # A velocity drawn at random is found wrong before braking could show by it.
    assert found == ENVELOPE_CODES - {EventCode.BRAKING, EventCode.SETPOINT_RESPONSE}
