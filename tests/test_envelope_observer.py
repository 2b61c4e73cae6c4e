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
    Array,
    S,
    just_less,
    just_more,
    look,
    motion,
    offsets,
    seen,
    vec3,
)
from flight_rig import MS, START_NS, sample
from msgspec import structs
from scipy.linalg import expm
from scipy.optimize import minimize_scalar

from uavctl.data import Vec3, VehicleMotion
from uavctl.flight.envelope import (
    BRAKING,
    BREACHES,
    NOT_WATCHING,
    OUTSIDE,
    RESPONSE,
    SCATTER,
    VELOCITY,
    Breach,
    Observation,
    Observer,
    Watching,
    misled,
    own_velocity,
    watch,
)
from uavctl.flight.limits import ZERO

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


def same(watching: Watching, want: Sequence[Textbook]) -> None:
    observer = watching.observer
    assert observer is not None
    assert {one.at_ns for one in want} == {observer.at_ns}
    for axis, one in enumerate(want):
        np.testing.assert_allclose(observer.mean[:, axis], one.mean, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(observer.cov, one.cov, rtol=1e-7, atol=1e-12)
        assert observer.accel_mps2[axis] == pytest.approx(one.accel, rel=1e-9, abs=1e-11)


@pytest.mark.parametrize(
    ("seed", "lag_s", "unexplained_mps2"),
    [(0, (0.2, 0.3, 0.4), 2.0), (1, (0.2, 0.2, 0.2), 3.0), (2, (0.0, 0.001, 0.0005), 2.0)],
)
def test_the_observer_is_the_textbook_s_whatever_comes_when(seed: int, lag_s: Vec3, unexplained_mps2: float) -> None:
    """Setpoints at odd ticks, positions late and in bursts, some of them metres off."""
    rng = np.random.default_rng(seed)
    parameters = replace(PARAMETERS, lag_s=lag_s, unexplained_mps2=unexplained_mps2)
    at_ns, captured_ns = START_NS, START_NS - 7 * MS
    inputs: list[list[tuple[int, float]]] = [[], [], []]
    watching, sent, clipped = NOT_WATCHING, ZERO, 0
    books: list[Textbook] = []
    for _ in range(30):
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
        watching, _ = watch(watching, seen(at_ns, *samples[::-1], sent=sent), parameters)
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
    assert watching.unexplained_mps2 == pytest.approx(want, abs=2e-3)


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
    assert watching.unexplained_mps2 == pytest.approx(rest_mps2, abs=1e-12)
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
        assert watching.unexplained_mps2 == abs(unexplained_mps2)
        assert watching.over_ns == since_ns
        assert (breach is not None) == breached
        assert breach is None or breach.code == RESPONSE


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
    watching, _ = look((unexplained_mps2, 0.0, 0.0), off_m=off_m, own=AT_REST, clean_ns=START_NS - 5, **known)
    assert (watching.apart_ns is not None) == apart
    assert watching.clean_ns == (AT_NS if clean else START_NS - 5)


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
    assert watching.clipped == (*before, off_m > 0.15)[-5:]
    assert (None if breach is None else breach.code) == (SCATTER if breached else None)


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
            watching, _ = watch(
                Watching(observer=at_rest), seen(at_ns, sample(at_ns, position_m=vec3(place))), PARAMETERS
            )
            assert watching.clipped == (clipped,)


def test_an_innovation_at_its_bound_is_not_clipped() -> None:
    bound_m = 6.0 * math.sqrt(2.0**2 * ((LOOK_NS * 1e-9) ** 5 / 20) + 0.02**2)
    for off_m, clipped in ((bound_m, False), (just_more(bound_m), True)):
        watching, _ = look(ZERO, off_m=off_m)
        assert watching.clipped == (clipped,)


@pytest.mark.parametrize(("since_ns", "counts"), [(40 * MS, True), (40 * MS - 1, False), (0, False), (-S, False)])
def test_positions_that_are_late_or_close_to_one_another_say_nothing_new(since_ns: int, counts: bool) -> None:
    watching, _ = watch(NOT_WATCHING, seen(START_NS, sample(START_NS)), PARAMETERS)
    at_ns = START_NS + 80 * MS
    after, _ = watch(watching, seen(at_ns, sample(START_NS + since_ns, at_ns)), PARAMETERS)
    assert after.observer is not None
    assert (after.observer is not watching.observer) == counts
    assert after.clean_ns == after.observer.at_ns == START_NS + (since_ns if counts else 0)


def test_a_stamp_after_the_arrival_counts_as_the_arrival() -> None:
    watching, _ = watch(NOT_WATCHING, seen(START_NS, sample(START_NS + 9 * MS, START_NS - MS)), PARAMETERS)
    assert watching.observer is not None and watching.observer.at_ns == START_NS - MS


@pytest.mark.parametrize(("silent_ns", "anew"), [(3 * S, True), (3 * S + MS, True), (3 * S - 1, False)])
def test_after_a_long_silence_the_observer_begins_anew(silent_ns: int, anew: bool) -> None:
    watching, _ = watch(NOT_WATCHING, seen(START_NS, sample(START_NS)), PARAMETERS)
    watching = structs.replace(watching, clipped=(True, True), over_ns=START_NS, clean_ns=1)
    captured_ns, at_ns = START_NS + silent_ns - 30 * MS, START_NS + silent_ns
    far = sample(captured_ns, at_ns, (0.5, 0.0, 0.0))
    after, breach = watch(watching, seen(at_ns, far), PARAMETERS)
    assert after.observer is not None and breach is None
    if anew:
        np.testing.assert_array_equal(after.observer.mean, [[0.5, 0.0, 0.0], ZERO, ZERO])
        np.testing.assert_allclose(np.diagonal(after.observer.cov), [0.0004, 4.0, 4.0 / 9.0])
        assert (after.clipped, after.over_ns, after.clean_ns) == ((), None, captured_ns)
    else:
        assert after.clipped == (True, True, False)


def test_what_was_sent_is_remembered_for_three_seconds_and_no_longer() -> None:
    rng = np.random.default_rng(1)
    watching = NOT_WATCHING
    all_sent: list[tuple[int, Vec3]] = []
    for n in range(200):
        at_ns = START_NS + n * TICK_NS
        sent = (float(rng.integers(0, 3)), 0.0, 0.0) if n > 90 else (float(n % 7 == 0), 0.0, 0.0)
        watching, _ = watch(watching, seen(at_ns, sent=sent), PARAMETERS)
        if not all_sent or all_sent[-1][1] != sent:
            all_sent.append((at_ns - TICK_NS if n else at_ns, sent))
        old = [one for one in all_sent if one[0] <= at_ns - 3 * S]
        assert watching.sent == (*old[-1:], *(one for one in all_sent if one[0] > at_ns - 3 * S))
        assert watching.tick_ns == at_ns


def test_of_what_was_sent_earlier_only_the_last_still_acts() -> None:
    sent = tuple((AT_NS - 5 * S + n * S, (float(n), 0.0, 0.0)) for n in range(5))
    watching, _ = watch(Watching(tick_ns=START_NS, sent=sent), seen(AT_NS + 1, sent=sent[-1][1]), PARAMETERS)
    assert watching.sent == sent[2:]


# Positions against the vehicle's own velocity


@pytest.mark.parametrize("seed", range(4))
def test_how_far_apart_two_velocities_are_is_a_line_through_what_is_between_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parameters = replace(PARAMETERS, disagreement_mps=100.0)
    watching, at_ns = NOT_WATCHING, START_NS
    ticks_ns: list[int] = []
    flown: list[Array] = []
    taken: list[tuple[int, Array]] = []
    for _ in range(80):
        at_ns += int(rng.integers(30, 90)) * MS
        velocity = rng.normal(size=3)
        flown.append(flown[-1] + velocity * (at_ns - ticks_ns[-1]) * 1e-9 if flown else np.zeros(3))
        ticks_ns.append(at_ns)
        captured_ns = at_ns - int(rng.integers(0, 30)) * MS
        one = sample(captured_ns, at_ns, vec3(rng.normal(size=3)))
        if captured_ns > ticks_ns[0] and (not taken or captured_ns - taken[-1][0] >= 40 * MS):
            distance = [np.interp(captured_ns, ticks_ns, axis) for axis in np.array(flown).T]
            taken.append((captured_ns, np.array(one.position_m) - distance))
        watching, _ = watch(watching, seen(at_ns, one, own=motion(vec3(velocity), at_ns)), parameters)
        if not taken or taken[-1][0] != captured_ns:
            continue
        window = [one for one in taken if one[0] > captured_ns - 1200 * MS]
        assert [at for at, _ in watching.offsets] == [at for at, _ in window]
        if len(window) < 3 or captured_ns - window[0][0] < 360 * MS:
            assert watching.apart_mps is None
            continue
        slope, _ = np.polyfit([(at - captured_ns) * 1e-9 for at, _ in window], [off for _, off in window], 1)
        # As much of it as stamps that are up to 0.15 s late or early make is no difference.
        middle_ns = (window[0][0] + captured_ns) // 2
        places = [[np.interp(at, ticks_ns, axis) for axis in np.array(flown).T] for at in (window[0][0], middle_ns)]
        half_s = (captured_ns - window[0][0]) * 0.5e-9
        accel = (np.array(places[0]) - 2.0 * np.array(places[1]) + distance) / half_s**2
        left = minimize_scalar(
            lambda late_s, by=slope, a=accel: float(np.linalg.norm(by + late_s * a)),
            bounds=(-0.15, 0.15),
            method="bounded",
            options={"xatol": 1e-9},
        )
        assert watching.apart_mps == pytest.approx(left.fun, rel=1e-6)
    kept = [at for at in ticks_ns if at > at_ns - 3 * S]
    assert [at for at, _ in watching.way] == kept


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
    watching, _ = look(ZERO, own=AT_REST, **offsets(0.125, spans_ns=spans_ns, apart_mps=9.0, apart_ns=1))
    assert watching.apart_mps == (pytest.approx(0.125) if compared else None)
    assert watching.apart_ns is None
    assert not watching.contradicted


# 0.4375 m/s are exactly what is shown of 0.4375 m/s, and 1.5 times 0.4375 / 1.5.
EXACT_MPS = 0.4375


def turning(accel: Vec3, slope: Vec3) -> tuple[float | None, bool]:
    """What is left of offsets with that slope while the vehicle accelerates, and whether it contradicts."""
    times_ns = [AT_NS - ns * MS for ns in (512, 256)]
    nodes_ns = (times_ns[0] - 1, *times_ns, AT_NS - 1)
    way = tuple((at, 0.5 * ((at - AT_NS) * 1e-9) ** 2 * np.array(accel)) for at in nodes_ns)
    lines = tuple((at, (at - AT_NS) * 1e-9 * np.array(slope)) for at in times_ns)
    watching, _ = look(ZERO, own=AT_REST, way=way, offsets=lines)
    return watching.apart_mps, watching.contradicted


@pytest.mark.parametrize(
    ("accel", "slope", "left_mps"),
    [
        (ZERO, (0.3, 0.0, 0.0), 0.3),
        ((2.0, 0.0, 0.0), (-0.2, 0.0, 0.0), 0.0),  # positions are 0.1 s late
        ((2.0, 0.0, 0.0), (0.2, 0.0, 0.0), 0.0),  # or early
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
        watching, _ = look(ZERO, own=AT_REST, way=way, offsets=lines)
        assert watching.apart_mps == pytest.approx(0.2 if begins_ns > times_ns[0] else 0.0, abs=5e-3)


def test_where_the_observer_begins_anew_a_contradiction_has_to_persist() -> None:
    """A position that comes three seconds late may still be compared with those before."""
    captured_ns = AT_NS - 2900 * MS
    state = Watching(
        observer=Observer(AT_NS - 3 * S, np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)),
        tick_ns=START_NS,
        way=((captured_ns - 50 * MS, np.zeros(3)), (START_NS, np.zeros(3))),
        offsets=tuple((captured_ns - ns * MS, np.array([-0.3e-3 * ns, 0.0, 0.0])) for ns in (500, 250)),
    )
    watching, breach = watch(state, seen(AT_NS, sample(captured_ns, AT_NS), own=AT_REST), PARAMETERS)
    assert watching.apart_mps == pytest.approx(0.3) and watching.contradicted
    assert watching.apart_ns == captured_ns
    assert breach is not None and breach.text.endswith("and none has come since")


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
    _, breach = watch(Watching(apart_ns=since_ns, tick_ns=START_NS), seen(AT_NS, own=AT_REST), PARAMETERS)
    assert (None if breach is None else breach.code) == (VELOCITY if breached else None)
    assert breach is None or breach.text.endswith("and none has come since")


# The ways of half a minute


def creeping(off_m: float, age_ns: int, *, before: int = 0) -> tuple[Watching, Breach | None]:
    """A position now, where the vehicle's own way had another place so long before the middle of the offsets."""
    known = offsets(0.0, spans_ns=(256 * MS, 512 * MS))
    middle_ns = AT_NS - 256 * MS
    older = tuple((middle_ns - age_ns - n * S, np.zeros(3)) for n in range(before, 0, -1))
    places = (*older, (middle_ns - age_ns, np.array([0.0, -off_m, 0.0])))
    return look(ZERO, own=AT_REST, places=places, **known)


@pytest.mark.parametrize(
    ("age_ns", "within_m"), [(S, 0.25 * 2.16), (5 * S, 0.25 * 2.8), (30 * S - 1, 0.25 * 6.8), (30 * S, math.inf)]
)
def test_positions_may_leave_the_vehicles_own_way_by_so_much(age_ns: int, within_m: float) -> None:
    for off_m, breached in ((min(within_m, 99.0) - 1e-6, False), (within_m + 1e-6, True)):
        watching, breach = creeping(off_m if math.isfinite(off_m) else 99.0, age_ns)
        breached = breached and math.isfinite(within_m)
        assert (None if breach is None else breach.code) == (VELOCITY if breached else None)
        assert breach is None or breach.text.endswith(f"away from the vehicle's own way in {age_ns * 1e-9:.0f} s")
        assert breach is None or f"(0.0, {off_m:.1f}, 0.0) m" in breach.text
        assert not watching.contradicted


def test_positions_may_leave_the_vehicles_own_way_by_just_so_much() -> None:
    within_m = (2.0 + 0.16) * PARAMETERS.disagreement_mps
    for off_m, breached in ((within_m, False), (just_more(within_m), True)):
        _, breach = creeping(off_m, S)
        assert (breach is not None) == breached


def test_any_place_of_the_way_that_is_too_far_off_is_enough() -> None:
    _, breach = creeping(9.0, S, before=3)
    assert breach is not None and breach.text.endswith("in 1 s")


@pytest.mark.parametrize(("age_ns", "kept"), [(S - 1, 1), (S, 2), (30 * S - 1, 2), (30 * S, 1), (31 * S, 1)])
def test_a_place_of_the_way_is_remembered_each_second_for_half_a_minute(age_ns: int, kept: int) -> None:
    watching, breach = creeping(0.0, age_ns)
    assert breach is None
    assert len(watching.places) == kept
    if kept == 2 or age_ns >= 30 * S:
        at_ns, place = watching.places[-1]
        assert at_ns == AT_NS - 256 * MS and isinstance(at_ns, int)
        np.testing.assert_allclose(place, ZERO, atol=1e-12)


def test_a_place_of_the_way_is_remembered_a_second_after_the_last_one() -> None:
    watching, _ = creeping(0.0, S // 2, before=5)
    assert len(watching.places) == 6


def test_the_place_of_the_way_is_the_mean_of_the_offsets() -> None:
    watching, _ = look(ZERO, own=AT_REST, **offsets(0.125, spans_ns=(100 * MS, 500 * MS)))
    ((at_ns, place),) = watching.places
    assert at_ns == AT_NS - 200 * MS
    np.testing.assert_allclose(place, (-0.125 * 0.2, 0.0, 0.0), atol=1e-12)


def test_over_a_gap_the_way_is_not_compared() -> None:
    places = ((START_NS - S, np.array([9.0, 0.0, 0.0])),)
    for spans_ns, kept in (((100 * MS,), True), ((1200 * MS,), False)):
        watching, breach = look(ZERO, own=AT_REST, places=places, **offsets(0.0, spans_ns=spans_ns))
        assert breach is None
        assert watching.places == (places if kept else ())
    silent, _ = look(ZERO, places=places, **offsets(0.0))
    missed, _ = look(ZERO, own=AT_REST, places=places, **offsets(0.0, way=((AT_NS - 301 * MS, np.zeros(3)),)))
    assert silent.places == missed.places == ()
    state = Watching(way=((START_NS, np.zeros(3)),), places=places)  # the way is not known so early
    early, _ = watch(state, seen(AT_NS, sample(START_NS, AT_NS), own=AT_REST), PARAMETERS)
    assert early.offsets == early.places == ()


def test_velocities_that_contradict_each_other_are_told_before_ways_that_do() -> None:
    places = ((START_NS - S, np.array([9.0, 0.0, 0.0])),)
    _, breach = look(ZERO, own=AT_REST, places=places, **offsets(9.0))
    assert breach is not None and breach.text.startswith("positions move otherwise")


@pytest.mark.parametrize(("for_ns", "answered"), [(None, False), (2 * S - 1, False), (2 * S, True), (3 * S, True)])
def test_positions_have_answered_after_two_seconds_of_a_flight(for_ns: int | None, answered: bool) -> None:
    watching = Watching(tick_ns=AT_NS, began_ns=None if for_ns is None else AT_NS - for_ns)
    assert watching.answered == answered
    assert not structs.replace(watching, tick_ns=None).answered


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
    watching, breach = look((unexplained_mps2, 0.0, 0.0), own=AT_REST, parameters=parameters, **known)
    assert watching.apart_mps == EXACT_MPS
    assert watching.apart_ns == since_ns
    assert watching.contradicted == (since_ns is not None)
    assert (None if breach is None else breach.code) == (VELOCITY if breached else None)


def test_the_way_is_known_between_ticks_and_not_before_the_first() -> None:
    for captured_ns, known in ((START_NS, False), (START_NS + 1, True), (AT_NS, True)):
        state = Watching(way=((START_NS, np.zeros(3)),))
        watching, _ = watch(state, seen(AT_NS, sample(captured_ns, AT_NS), own=AT_REST), PARAMETERS)
        assert [at for at, _ in watching.offsets] == [captured_ns] * known


def test_the_way_is_not_known_after_the_last_tick() -> None:
    way = tuple((START_NS - n * MS, np.zeros(3)) for n in range(300, -1, -1))
    after = sample(AT_NS + 1, AT_NS + 1)
    watching, _ = watch(Watching(way=way), seen(AT_NS, after, own=AT_REST), PARAMETERS)
    assert len(watching.way) == 302 and watching.offsets == ()


def test_the_way_is_remembered_for_three_seconds() -> None:
    way = tuple((at, np.zeros(3)) for at in (AT_NS - 3 * S, AT_NS - 3 * S + 1, START_NS))
    watching, _ = watch(Watching(way=way), seen(AT_NS, own=AT_REST), PARAMETERS)
    assert [at for at, _ in watching.way] == [AT_NS - 3 * S + 1, START_NS, AT_NS]


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
    watching, _ = look(ZERO, own=words, **offsets(0.125))
    assert (watching.apart_mps is not None) == (len(watching.offsets) == 3) == known
    assert len(watching.way) == (3 if known else 0)
    ours = structs.replace(seen(AT_NS, own=words), velocity_mps=ZERO)
    assert (own_velocity(watching, ours, 0.0, PARAMETERS) is not None) == known


@pytest.mark.parametrize(("gap_ns", "known"), [(300 * MS, True), (300 * MS + 1, False)])
def test_how_far_it_flew_in_ticks_that_were_missed_is_not_known(gap_ns: int, known: bool) -> None:
    before = offsets(0.0, way=((AT_NS - gap_ns, np.array([1.0, 2.0, 3.0])),))
    watching, _ = look(ZERO, own=motion((1.0, 0.0, 0.0), AT_NS), **before)
    assert watching.way[-1][0] == AT_NS
    assert watching.way[-1][1].tolist() == ([1.0 + 0.3, 2.0, 3.0] if known else [0.0, 0.0, 0.0])
    assert [at for at, _ in watching.way[:-1]] == [AT_NS - gap_ns] * known
    assert len(watching.offsets) == (3 if known else 0)


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
    ours = structs.replace(seen(AT_NS, own=motion(own, AT_NS)), velocity_mps=known)
    watching = Watching(contradicted=contradicted)
    assert own_velocity(watching, ours, age_s, PARAMETERS) == (own if believed else None)


# What is not known counts less


def test_a_flight_that_began_before_its_first_position_has_the_velocity_that_was_sent() -> None:
    watching, sent = NOT_WATCHING, (1.0, -0.5, 0.0)
    for n in range(21):
        watching, _ = watch(watching, seen(START_NS + n * TICK_NS, sent=sent), PARAMETERS)
    at_ns = START_NS + S
    watching, breach = watch(watching, seen(at_ns, sample(at_ns, at_ns, (7.0, 8.0, -9.0)), sent=sent), PARAMETERS)
    assert breach is None and watching.observer is not None
    left = [math.exp(-1.0 / lag_s) for lag_s in PARAMETERS.lag_s]
    velocity = [u * (1.0 - lag_s * (1.0 - e)) for u, lag_s, e in zip(sent, PARAMETERS.lag_s, left, strict=True)]
    np.testing.assert_allclose(watching.observer.mean, [(7.0, 8.0, -9.0), velocity, ZERO], atol=1e-12)
    np.testing.assert_allclose(watching.observer.accel_mps2, [u * (1.0 - e) for u, e in zip(sent, left, strict=True)])
    # Gusts have had a second for it.
    assert watching.observer.cov[1, 1] == pytest.approx((0.3 + 0.3 * 2.0 * 1.0) ** 2)


def test_a_first_position_has_the_velocity_of_all_that_was_sent_before() -> None:
    rng, watching = np.random.default_rng(6), NOT_WATCHING
    for n in range(31):
        at_ns = START_NS + n * TICK_NS
        first = [sample(at_ns)] if n == 30 else []
        watching, _ = watch(watching, seen(at_ns, *first, sent=vec3(rng.uniform(-2.0, 2.0, 3))), PARAMETERS)
    assert watching.observer is not None
    np.testing.assert_allclose(watching.observer.mean[1], watching.flown_mps, atol=1e-12)
    np.testing.assert_allclose(watching.observer.accel_mps2, watching.flown_mps2, atol=1e-12)
    # Gusts have had a second and a half for it.
    assert watching.observer.cov[1, 1] == pytest.approx((0.3 + 0.3 * 2.0 * 1.5) ** 2)


@pytest.mark.parametrize(("std_m", "noise_m"), [(0.005, 0.02), (0.02, 0.02), (0.1, 0.1)])
def test_a_position_counts_by_its_own_standard_deviation(std_m: float, noise_m: float) -> None:
    begun, _ = watch(NOT_WATCHING, seen(START_NS, sample(START_NS, std_m=std_m)), PARAMETERS)
    assert begun.observer is not None
    assert begun.observer.cov[0, 0] == pytest.approx(noise_m**2)
    observer = Observer(START_NS, np.zeros((3, 3)), np.diag([0.01, 0.0, 0.0]), np.zeros(3))
    later = sample(AT_NS, AT_NS, (0.1, 0.0, 0.0), std_m=std_m)
    watching, _ = watch(Watching(observer=observer, tick_ns=START_NS), seen(AT_NS, later), PARAMETERS)
    assert watching.observer is not None
    wanders = (PARAMETERS.unexplained_mps2 * math.sqrt((LOOK_NS * 1e-9) ** 5 / 20)) ** 2
    gain = (0.01 + wanders) / (0.01 + wanders + noise_m**2)
    assert watching.observer.mean[0, 0] == pytest.approx(0.1 * gain)


def unsure(unexplained_mps2: float, std_mps2: float) -> Watching:
    """What comes of a position that tells next to nothing, where the observer knows so much."""
    mean = np.array([ZERO, ZERO, (unexplained_mps2, 0.0, 0.0)])
    observer = Observer(START_NS, mean, np.diag([0.0, 0.0, std_mps2**2]), np.zeros(3))
    s = LOOK_NS * 1e-9
    there = sample(AT_NS, AT_NS, (0.5 * unexplained_mps2 * s * s, 0.0, 0.0), std_m=50.0)
    watching, _ = watch(Watching(observer=observer, tick_ns=START_NS), seen(AT_NS, there), PARAMETERS)
    assert watching.unexplained_mps2 == pytest.approx(unexplained_mps2, rel=1e-6)
    return watching


@pytest.mark.parametrize(("std_mps2", "over"), [(0.0, True), (1.55, True), (1.6, False)])
def test_an_acceleration_that_may_as_well_be_none_is_none(std_mps2: float, over: bool) -> None:
    assert (unsure(2.5, std_mps2).over_ns is not None) == over


def test_an_acceleration_of_just_so_many_standard_deviations_is_none() -> None:
    observer = unsure(0.0, 1.6).observer
    assert observer is not None
    bound_mps2 = 1.5 * math.sqrt(observer.cov[2, 2])
    assert bound_mps2 > PARAMETERS.unexplained_mps2
    assert unsure(bound_mps2, 1.6).over_ns is None
    assert unsure(just_more(bound_mps2), 1.6).over_ns is not None


# The vehicle's own velocity as a witness


def told(velocity: Vec3, predicted: Vec3, **known: object) -> tuple[Watching, Observation]:
    """Half a second into a flight by what was sent, the vehicle's word, and a prediction."""
    watching = structs.replace(Watching(tick_ns=AT_NS, began_ns=AT_NS - 500 * MS), **known)
    return watching, structs.replace(seen(AT_NS, own=motion(velocity, AT_NS)), velocity_mps=predicted)


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
    watching, tick = told(velocity, predicted, flown_mps=flown, apart_mps=apart_mps)
    assert own_velocity(watching, tick, 0.0, PARAMETERS) == (velocity if braked_on else None)
    assert own_velocity(structs.replace(watching, contradicted=True), tick, 0.0, PARAMETERS) is None


def test_what_was_sent_is_a_witness_for_ten_seconds() -> None:
    watching, tick = told(ZERO, (9.0, 0.0, 0.0))
    assert own_velocity(structs.replace(watching, began_ns=AT_NS - 10 * S), tick, 0.0, PARAMETERS) == ZERO
    assert own_velocity(structs.replace(watching, began_ns=AT_NS - 10 * S - 1), tick, 0.0, PARAMETERS) is None
    assert own_velocity(structs.replace(watching, began_ns=None), tick, 0.0, PARAMETERS) is None


@pytest.mark.parametrize(("apart_mps", "age_s", "is_misled"), [(1.0, 0.0, False), (1.01, 0.0, True), (1.6, 1.0, False)])
def test_a_prediction_far_off_the_vehicle_s_own_velocity_misleads(
    apart_mps: float, age_s: float, is_misled: bool
) -> None:
    watching, tick = told(ZERO, (0.0, -apart_mps, 0.0), apart_mps=0.1)
    assert misled(watching, tick, age_s, PARAMETERS) == is_misled
    assert not misled(structs.replace(watching, contradicted=True), tick, age_s, PARAMETERS)


def test_what_was_sent_acts_behind_the_lag_from_tick_to_tick() -> None:
    rng, watching, at_ns = np.random.default_rng(4), NOT_WATCHING, START_NS
    velocity, accel, sent = np.zeros(3), np.zeros(3), ZERO
    for n in range(30):
        for_ns = TICK_NS * (10 if n % 5 == 4 else 1)  # now and then one is late
        at_ns += for_ns if n else 0
        watching, _ = watch(watching, seen(at_ns, sent=sent), PARAMETERS)
        if n:
            for axis, lag_s in enumerate(PARAMETERS.lag_s):
                step = expm(np.array([[0, 1, 0], [0, -1 / lag_s, 1 / lag_s], [0, 0, 0]]) * for_ns * 1e-9)
                velocity[axis], accel[axis], _ = step @ (velocity[axis], accel[axis], sent[axis])
        np.testing.assert_allclose(watching.flown_mps, velocity, atol=1e-12)
        np.testing.assert_allclose(watching.flown_mps2, accel, atol=1e-12)
        sent = vec3(rng.uniform(-2.0, 2.0, 3))
    assert watching.began_ns == START_NS


def test_what_is_recorded_of_it_is_plain_numbers() -> None:
    watching, _ = look((0.1, 0.2, -0.9), own=AT_REST, **offsets(0.1))
    assert [type(watching.unexplained_mps2), type(watching.apart_mps)] == [float, float]


# No clock's zero says anything


def later(watching: Watching, by_ns: int) -> Watching:
    """The same, all of it so much later."""

    def moved(pairs: tuple[tuple[int, Any], ...]) -> tuple[tuple[int, Any], ...]:
        return tuple((at_ns + by_ns, value) for at_ns, value in pairs)

    names = ("tick_ns", "began_ns", "over_ns", "apart_ns", "clean_ns", "outside_ns")
    times = {name: at_ns + by_ns for name in names if (at_ns := getattr(watching, name)) is not None}
    rows = {name: moved(getattr(watching, name)) for name in ("sent", "way", "offsets", "places")}
    observer, braking = watching.observer, watching.braking
    return structs.replace(
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


def plain(watching: Watching) -> Any:
    return msgspec.to_builtins(watching, enc_hook=lambda array: array.tolist())


def test_what_time_it_is_makes_no_difference() -> None:
    """The same flights under a clock whose zero is long after them, and under one whose zero is as they begin."""
    found: set[str] = set()
    for seed in range(6):
        by_ns = MS - START_NS if seed % 3 == 2 else -1000 * S
        rng, at_ns = np.random.default_rng(seed), START_NS + 1
        one = two = NOT_WATCHING
        tick = seen(at_ns)
        for n in range(60):
            tick = random_tick(rng, at_ns, tick)
            tick = structs.replace(tick, samples=tick.samples if n > seed else ())  # the first ones come a little later
            same_tick = tick_later(tick, by_ns)
            one, breach = watch(one, tick, PARAMETERS)
            two, same_breach = watch(two, same_tick, PARAMETERS)
            found |= {breach.code} if breach else set()
            assert same_breach == breach
            assert plain(two) == plain(later(one, by_ns))
            assert two.answered == one.answered
            for says in (own_velocity, misled):
                assert says(two, same_tick, 0.1, PARAMETERS) == says(one, tick, 0.1, PARAMETERS)
            at_ns += int(rng.choice([int(rng.integers(30, 90)), 400, 3500], p=[0.96, 0.03, 0.01])) * MS
    assert found == BREACHES == {RESPONSE, VELOCITY, SCATTER, OUTSIDE, BRAKING}
