"""The test of the response: a wrong one is found by its kind, a right one never, whatever the wind and the lag."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from envelope_rig import PARAMETERS, just_less, just_more, motion, seen, vec3
from flight_rig import MS, START_NS
from msgspec import structs
from response_definition import TICK_NS, WRONG_HORIZONTAL, WRONG_VERTICAL, compute_evidence_slowly, make_state

from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors import outside, response
from uavctl.flight.monitors.motion import Motion, TickObservation
from uavctl.flight.monitors.observation import Observation
from uavctl.flight.monitors.observer import Observer
from uavctl.flight.monitors.response import FAR, FAR_S, NEAR, WRONG, ResponseState
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import Action
from uavctl.records import Vec3

SECONDS = 6.0
WRONG_S = 3.0  # from then on
DRAG_1PS = 0.8
COS_45 = math.sqrt(0.5)
NEAR_TO_RIGHT = ("turned by 45°", "turned by 315°", "2.5 times as much")
VERTICAL = {"mirrored in down": -1.0, "not at all in down": 0.0}
ROTATIONS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "turned by 90°": ((0.0, -1.0), (1.0, 0.0)),
    "turned by 180°": ((-1.0, 0.0), (0.0, -1.0)),
    "turned by 270°": ((0.0, 1.0), (-1.0, 0.0)),
    "mirrored in north": ((-1.0, 0.0), (0.0, 1.0)),
    "mirrored in east": ((1.0, 0.0), (0.0, -1.0)),
    "not at all": ((0.0, 0.0), (0.0, 0.0)),
    "turned by 45°": ((COS_45, -COS_45), (COS_45, COS_45)),
    "turned by 315°": ((COS_45, COS_45), (-COS_45, COS_45)),
    "2.5 times as much": ((2.5, 0.0), (0.0, 2.5)),
}
ROOM = replace(PARAMETERS, unexplained_mps2=1.5)
CONSISTENT = VelocityChangeState(agreed_ns=START_NS + round(SECONDS * 1e9))  # all the time
INITIAL = VelocityChangeState()

Flight = list[tuple[ResponseState, bool]]


def compute_evidence(state: ResponseState) -> tuple[float, str]:
    return response.compute_evidence(state, ROOM.unexplained_mps2)


def request(s: float) -> tuple[float, float]:
    """What setpoints give: to and fro between walls, another way in each axis."""
    return 2.0 * math.sin(3.5 * s), 1.6 * math.sin(2.9 * s + 1.0)


def request_down(s: float) -> float:
    return 1.2 * math.sin(2.2 * s)


def fly(
    answer: Callable[[float], tuple[float, float]],
    *,
    wind: Callable[[float], tuple[float, float]] = lambda _s: (0.0, 0.0),
    drag_1ps: float = 0.0,
    noise_mps2: float = 0.1,
    inertial: bool = True,
    change: VelocityChangeState = CONSISTENT,
    requested: Callable[[float], tuple[float, float]] = request,
    position_m: Vec3 | None = None,
    silent_ns: int = 0,
    answer_down: Callable[[float], float] = request_down,
    own_velocity: bool = True,
    unexplained_mps2: tuple[float, float] = (0.0, 0.0),
) -> Flight:
    """Show the monitor a flight in which `answer` is the acceleration that the vehicle makes of its setpoints.

    Args:
        unexplained_mps2: What positions show beside setpoints, and beside inertial data.
    """
    rng = np.random.default_rng(3)
    beside, beside_inertial = np.zeros((3, 3)), np.zeros((3, 3))
    beside[2, 0], beside_inertial[2, 0] = unexplained_mps2
    state, velocity, down_mps, flight = ResponseState(), np.zeros(2), 0.0, []
    for tick in range(round(SECONDS * 1e9) // TICK_NS):
        at_ns, s = START_NS + tick * TICK_NS, tick * TICK_NS * 1e-9
        accel = np.array(answer(s)) + wind(s) - drag_1ps * velocity
        velocity = velocity + TICK_NS * 1e-9 * accel
        shown = accel + rng.normal(0.0, noise_mps2, 2)
        down_mps += TICK_NS * 1e-9 * answer_down(s)
        own: Vec3 = (float(velocity[0]), float(velocity[1]), down_mps)
        observation = structs.replace(
            seen(at_ns, vehicle_motion=motion(own, at_ns) if own_velocity else None),
            inertial_mps2=(float(shown[0]), float(shown[1]), answer_down(s)) if inertial else None,
            velocity_mps=own,
            position_m=position_m,
            has_positions=silent_ns == 0,
        )
        observer = Observer(at_ns - silent_ns, beside, np.zeros((3, 3)), np.zeros(3), inertial=beside_inertial)
        model = Motion(model_mps2=(*requested(s), request_down(s)), observer=observer)
        state, verdict = response.update(state, TickObservation(observation, model, ROOM), change)
        assert verdict.is_none or (verdict.action, verdict.cause) == (Action.END_PLANS, EventCode.SETPOINT_RESPONSE)
        flight.append((state, not verdict.is_none))
    return flight


def get_first_s(flight: Flight) -> float | None:
    """When the first verdict came [s]."""
    return next((tick * TICK_NS * 1e-9 for tick, (_, ends) in enumerate(flight) if ends), None)


def make_wrong(kind: str) -> Callable[[float], tuple[float, float]]:
    def answer(s: float) -> tuple[float, float]:
        north, east = request(s)
        if s < WRONG_S:
            return north, east
        if kind == "too late":
            return request(s - 0.3)
        (nn, ne), (en, ee) = ROTATIONS[kind]
        return nn * north + ne * east, en * north + ee * east

    return answer


def test_each_wrong_response_is_tested() -> None:
    assert set(WRONG) == {*ROTATIONS, *VERTICAL, "too late"}


@pytest.mark.fault(101)
@pytest.mark.parametrize(
    ("kind", "drag_1ps", "inertial"),
    [
        *((kind, drag_1ps, True) for kind in (*ROTATIONS, "too late") for drag_1ps in (0.0, DRAG_1PS)),
        # An own velocity is too smooth to show a delay in two seconds, or a response near to a right one.
        *((kind, 0.0, False) for kind in ROTATIONS if kind not in NEAR_TO_RIGHT),
    ],
)
def test_a_wrong_response_is_found_by_its_kind(kind: str, drag_1ps: float, inertial: bool) -> None:
    flight = fly(make_wrong(kind), drag_1ps=drag_1ps, inertial=inertial)
    first_s = get_first_s(flight)
    assert first_s is not None and WRONG_S < first_s < WRONG_S + 2.5
    at_end = [compute_evidence(state)[1] for state, _ in flight[-20:]]
    assert kind in at_end


@pytest.mark.fault(101)
@pytest.mark.parametrize(
    ("kind", "inertial"), [("mirrored in down", True), ("mirrored in down", False), ("not at all in down", True)]
)
def test_a_wrong_response_of_the_vertical_axis_is_found_by_its_kind(kind: str, inertial: bool) -> None:
    def answer_down(s: float) -> float:
        return request_down(s) * (VERTICAL[kind] if s >= WRONG_S else 1.0)

    flight = fly(request, answer_down=answer_down, inertial=inertial)
    first_s = get_first_s(flight)
    assert first_s is not None and WRONG_S < first_s < WRONG_S + 2.5
    assert kind in [compute_evidence(state)[1] for state, _ in flight[-20:]]


@pytest.mark.parametrize("inertial", [True, False])
@pytest.mark.parametrize(
    ("delay_s", "drag_1ps", "wind"),
    [
        (0.0, 0.0, lambda _s: (0.0, 0.0)),
        (0.1, 0.0, lambda _s: (0.0, 0.0)),
        (0.1, DRAG_1PS, lambda _s: (1.0, -1.0)),
        (0.05, DRAG_1PS, lambda s: (2.0 if s > WRONG_S else 0.0, 0.0)),  # it sets in at once
        (0.0, DRAG_1PS, lambda s: (1.2 * math.sin(1.3 * s), 1.2 * math.cos(0.9 * s))),
    ],
)
def test_a_right_response_is_not_found_wrong(
    delay_s: float, drag_1ps: float, wind: Callable[[float], tuple[float, float]], inertial: bool
) -> None:
    flight = fly(lambda s: request(s - delay_s), drag_1ps=drag_1ps, wind=wind, inertial=inertial)
    assert get_first_s(flight) is None


def test_a_steady_acceleration_from_the_start_is_wind() -> None:
    def stand(_s: float) -> tuple[float, float]:
        return 0.0, 0.0

    assert get_first_s(fly(stand, requested=lambda _s: (1.5, 0.0), wind=lambda _s: (-1.5, 0.0))) is None


def test_a_steady_request_that_is_answered_the_other_way_is_no_wind() -> None:
    """Nothing varies any more: the jump alone tells."""

    def swing(s: float) -> tuple[float, float]:
        return (2.0, 1.0) if s >= WRONG_S - 0.5 else (-1.0 * math.sin(2.0 * s), 0.0)

    def answer(s: float) -> tuple[float, float]:
        north, east = swing(s)
        return (north, east) if s < WRONG_S else (-north, -east)

    flight = fly(answer, requested=swing, noise_mps2=0.01, position_m=(-2.9, 0.0, -2.0))  # at a wall
    first_s = get_first_s(flight)
    assert first_s is not None and WRONG_S < first_s < WRONG_S + 1.5


def test_nothing_counts_while_both_sources_contradict_each_other() -> None:
    for change in (
        VelocityChangeState(disagrees_ns=START_NS),
        VelocityChangeState(velocity_wrong_ns=START_NS),
        VelocityChangeState(inertial_wrong_ns=START_NS),
    ):
        flight = fly(make_wrong("turned by 180°"), change=structs.replace(change, agreed_ns=CONSISTENT.agreed_ns))
        assert get_first_s(flight) is None and compute_evidence(flight[-1][0]) == (0.0, "")


def test_inertial_data_alone_prove_nothing() -> None:
    for agreed_ns in (None, START_NS):
        flight = fly(make_wrong("turned by 180°"), change=VelocityChangeState(agreed_ns=agreed_ns))
        assert get_first_s(flight) is None and compute_evidence(flight[-1][0])[0] > FAR


WITNESSED_MPS2 = 0.3 * ROOM.unexplained_mps2


@pytest.mark.fault(101)
@pytest.mark.parametrize(
    ("unexplained_mps2", "is_found"),
    [
        ((WITNESSED_MPS2 + 0.01, 0.0), True),
        ((WITNESSED_MPS2 - 0.01, 0.0), False),
        ((2.0, 0.99), True),
        ((2.0, 1.01), False),
        ((0.0, 4.0), False),  # inertial data are wrong
    ],
)
def test_positions_are_witness_where_no_own_velocity_comes(
    unexplained_mps2: tuple[float, float], is_found: bool
) -> None:
    for own_velocity, silent_ns, finds in ((False, 0, is_found), (True, 0, False), (False, 401 * MS, False)):
        flight = fly(
            make_wrong("turned by 180°"),
            change=VelocityChangeState(),
            own_velocity=own_velocity,
            unexplained_mps2=unexplained_mps2,
            silent_ns=silent_ns,
        )
        assert (get_first_s(flight) is not None) == finds


def test_it_takes_more_evidence_where_no_position_comes() -> None:
    first_s = [get_first_s(fly(make_wrong("turned by 180°"), silent_ns=ns * MS)) for ns in (0, 401)]
    assert first_s[0] is not None and first_s[1] is not None and first_s[0] < first_s[1]


@pytest.mark.parametrize(("position_north_m", "earlier"), [(2.9, True), (-2.9, False)])
def test_it_is_found_with_less_evidence_where_a_wall_is_near(position_north_m: float, earlier: bool) -> None:
    """The vehicle drifts north, to the upper limit of 3 m."""

    def fly_at(north_m: float | None) -> float:
        position = None if north_m is None else (north_m, 0.0, -2.0)
        flight = fly(make_wrong("turned by 180°"), wind=lambda s: (1.0 if s < 1.0 else 0.0, 0.0), position_m=position)
        first_s = get_first_s(flight)
        assert first_s is not None
        return first_s

    far_s = fly_at(None)
    assert (fly_at(position_north_m) < far_s) == earlier


def test_the_bound_is_met_at_a_second_before_the_last_moment_to_brake() -> None:
    speed_mps, brake_mps2 = 1.0, PARAMETERS.brake_mps2[0]
    stop_m = speed_mps * (0.3 + speed_mps / (2.0 * brake_mps2))
    for left_s, bound in (
        (0.0, NEAR),
        (0.5 * FAR_S, 0.5 * (NEAR + FAR)),
        (FAR_S, FAR),
        (2.0 * FAR_S, FAR),
        (-1.0, NEAR),
    ):
        north_m = PARAMETERS.upper_m[0] - stop_m - left_s * speed_mps
        for sign in (1.0, -1.0):  # the room is as wide to the south
            tick = structs.replace(
                seen(START_NS), position_m=(sign * north_m, 0.0, -2.0), velocity_mps=(sign * speed_mps, 0.0, 0.0)
            )
            assert response._compute_bound(tick, PARAMETERS) == pytest.approx(bound)


@pytest.mark.parametrize(
    ("north_m", "north_mps", "says"),
    [
        (0.0, 1.0, None),
        (2.9, 1.0, "0.1 m before the north limit at 1.0 m/s"),
        (2.9, -1.0, None),
        (-2.8, -2.0, "0.2 m before the south limit at 2.0 m/s"),
        (3.25, 1.0, "0.2 m beyond the north limit at 1.0 m/s"),
    ],
)
def test_the_cause_says_where_the_speed_allowed_no_stop(north_m: float, north_mps: float, says: str | None) -> None:
    for own in (None, motion((north_mps, 0.0, 0.0), START_NS)):
        tick = structs.replace(
            seen(START_NS, vehicle_motion=own),
            position_m=(north_m, 0.0, -2.0),
            velocity_mps=(north_mps if own is None else 0.0, 0.0, 0.0),
        )
        text = outside.describe_overrun(tick, PARAMETERS)
        assert says in text if says else not text


def test_the_cause_says_where_the_position_is_not_known() -> None:
    tick = structs.replace(seen(START_NS, vehicle_motion=motion((0.0, 3.0, 4.0), START_NS)), position_m=None)
    assert "5.0 m/s" in outside.describe_overrun(tick, PARAMETERS)


def test_a_gap_in_inertial_data_begins_anew() -> None:
    last = START_NS, (1.0, *[0.0] * 9)
    state = ResponseState(
        requested=((START_NS, ZERO),), inertial_ns=START_NS, samples=(last,), recent=(1.0, *[0.0] * 12)
    )
    for gap_ns, count in ((300 * MS, 1.0), (300 * MS + 1, 0.0)):
        tick = structs.replace(seen(START_NS + gap_ns), inertial_mps2=ZERO)
        after, _ = response.update(state, TickObservation(tick, Motion(), PARAMETERS), CONSISTENT)
        span = gap_ns * 1e-9 / response.CORRELATED_S
        kept = math.exp(-gap_ns * 1e-9 / response.MEMORY_S) * count
        assert after.recent[0] == pytest.approx(kept + span)
        assert len(after.samples) == 1 + count


def test_an_own_velocity_shows_nothing_beside_inertial_data_or_right_after_another() -> None:
    own: Vec3 = (1.0, 0.0, 0.0)
    before = ResponseState(requested=((START_NS, ZERO),), velocity=(START_NS, (0.5, 0.0, 0.0)))
    for state, ms, is_sample in (
        (before, 50, True),
        (before, 49, False),
        (structs.replace(before, inertial_ns=START_NS), 50, False),
        (structs.replace(before, inertial_ns=START_NS - 300 * MS), 50, True),
    ):
        at_ns = START_NS + ms * MS
        tick = seen(at_ns, vehicle_motion=motion(own, at_ns))
        after, _ = response.update(state, TickObservation(tick, Motion(), PARAMETERS), CONSISTENT)
        assert bool(after.samples) == is_sample


@pytest.mark.fault(101)
@pytest.mark.parametrize("late_ns", [0, 150 * MS, 300 * MS])
@pytest.mark.parametrize("kind", WRONG_HORIZONTAL)
def test_the_evidence_is_that_of_its_definition(kind: str, late_ns: int) -> None:
    """Blend a wrong response with a right one, of any gain, in both groups of axes or in one."""
    rng = np.random.default_rng([*WRONG_HORIZONTAL].index(kind) + 10 * late_ns)
    parts, gains = rng.uniform(0.5, 1.0, 2), rng.choice([0.3, 0.7, 1.0, 1.5, 1.8], 2)
    wrong = WRONG_HORIZONTAL[kind][0], list(WRONG_VERTICAL.values())[rng.integers(3)][0]
    blends = [p * r + (1.0 - p) * gain * np.eye(len(r)) for p, gain, r in zip(parts, gains, wrong, strict=True)]
    for answers in ((blends[0], blends[1]), (blends[0], np.eye(1)), (np.eye(2), blends[1])):
        state, unexplained_mps2 = make_state(rng, answers, late_ns, rng.uniform(0.0, 2.0)), rng.choice([0.6, 1.0, 1.5])
        evidence, found = response.compute_evidence(state, unexplained_mps2)
        slow, slow_found = compute_evidence_slowly(state, unexplained_mps2)
        assert evidence == pytest.approx(slow, rel=1e-9)
        assert found == slow_found
        lag_s: Vec3 = (float(rng.uniform(0.1, 0.5)), float(rng.uniform(0.1, 0.5)), float(rng.choice([0.0, 0.3])))
        parameters = replace(ROOM, unexplained_mps2=unexplained_mps2, lag_s=lag_s)
        last_before = state.samples[-1][0] - 350 * MS, state.samples[-5][1]
        state = structs.replace(state, samples=(*state.samples[:-5], last_before, *state.samples[-4:]))
        evidence, found = response.compute_onset_evidence(state, parameters)
        slow, slow_found = compute_evidence_slowly(state, unexplained_mps2, lag_s)
        assert evidence == pytest.approx(slow, rel=1e-9)
        assert found == slow_found


UNIT_MPS2 = 1.0 / 0.65  # with it a jump of the wind has a standard deviation of 1 m/s²


def make_little(means_mps2: Vec3, variances: Vec3, before_mps2: Vec3, count: float = 4.0) -> ResponseState:
    """Make the state of a vehicle that answers the other way, with these sums of what an exact response leaves."""
    state = make_state(np.random.default_rng(1), (-np.eye(2), -np.eye(1)), 0, 0.0)
    squares = [variance + mean * mean for mean, variance in zip(means_mps2, variances, strict=True)]
    return structs.replace(
        state,
        recent=tuple(count * x for x in (1.0, *means_mps2, *squares)),
        baseline=tuple(2.0 * x for x in (1.0, *before_mps2, 0.0, 0.0, 0.0)),
    )


@pytest.mark.parametrize(("count", "finds"), [(4.0, True), (just_less(4.0), False)])
def test_it_takes_four_samples(count: float, finds: bool) -> None:
    state = make_little((9.0, 9.0, 9.0), ZERO, ZERO, count)
    assert (response.compute_evidence(state, UNIT_MPS2)[0] > 0.0) == finds


@pytest.mark.parametrize(
    ("means_mps2", "finds"),
    [
        ((3.0, 1.0, 0.0), False),  # (3² + 1²) / 2 is 5
        ((3.0, 1.0 + 1e-9, 0.0), True),
        ((1.0, -3.0, 0.0), False),
        ((0.0, 0.0, 3.1), False),
        ((0.0, 0.0, -3.2), True),
    ],
)
def test_no_other_is_compared_where_an_exact_response_leaves_little(means_mps2: Vec3, finds: bool) -> None:
    evidence, _ = response.compute_evidence(make_little(means_mps2, ZERO, ZERO), UNIT_MPS2)
    assert (evidence > 0.0) == finds


@pytest.mark.parametrize("unexplained_mps2", [UNIT_MPS2, 0.8])
@pytest.mark.parametrize("axes", [(0,), (1,), (0, 1), (2,)])
def test_an_exact_response_leaves_a_variance_and_a_jump(axes: tuple[int, ...], unexplained_mps2: float) -> None:
    """n / 2 ln(1 + V / σ²) + J / 2 σ_J² is just below 5, or just above."""
    means, before, count = np.array([0.3, -0.5, 0.4]), np.array([0.1, 0.2, -0.3]), 6.0
    before = np.where(np.isin(range(3), axes), before, means)
    jumped = float(((means - before) ** 2).sum()) / (2.0 * (0.65 * unexplained_mps2) ** 2)
    variance = (0.2 * unexplained_mps2) ** 2 * (math.exp(2.0 * (5.0 - jumped) / count) - 1.0)
    for factor, finds in ((1.0 - 1e-9, False), (1.0 + 1e-9, True)):
        variances = np.where(np.isin(range(3), axes), factor * variance / len(axes), 0.0)
        state = make_little(vec3(means), vec3(variances), vec3(before), count)
        assert (response.compute_evidence(state, unexplained_mps2)[0] > 0.0) == finds


def observe(tick: Observation, observer: Observer | None = None) -> TickObservation:
    return TickObservation(tick, Motion(observer=observer), ROOM)


NOISE_FREE = Observer(START_NS, np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), inertial=np.zeros((3, 3)))
FELT = structs.replace(seen(START_NS, vehicle_motion=motion(ZERO, START_NS)), inertial_mps2=ZERO)


def ends_plans(
    monkeypatch: pytest.MonkeyPatch,
    evidence: float,
    tick: Observation,
    observer: Observer | None,
    change: VelocityChangeState = CONSISTENT,
    heard_ns: int | None = START_NS,
) -> bool:
    monkeypatch.setattr(response, "compute_evidence", lambda *_: (evidence, "mirrored in north"))
    begun = ResponseState(
        requested=((START_NS - TICK_NS, ZERO),), velocity=(START_NS - TICK_NS, ZERO), heard_ns=heard_ns
    )
    _, verdict = response.update(begun, observe(tick, observer), change)
    return not verdict.is_none


@pytest.mark.parametrize(
    ("tick", "heard_ns", "observer", "change", "factor", "is_heard"),
    [
        (FELT, START_NS, NOISE_FREE, CONSISTENT, 1.0, True),
        (FELT, START_NS - 400 * MS, NOISE_FREE, CONSISTENT, 1.0, True),
        (FELT, START_NS - 400 * MS - 1, NOISE_FREE, CONSISTENT, 3.0, False),
        (structs.replace(FELT, has_positions=True), None, None, CONSISTENT, 1.0, True),  # none is believed
        (FELT, None, NOISE_FREE, CONSISTENT, 3.0, False),
        # no inertial data
        (seen(START_NS, vehicle_motion=motion(ZERO, START_NS)), START_NS, NOISE_FREE, INITIAL, 3.0, True),
        (
            structs.replace(FELT, motion=None),
            START_NS,
            structs.replace(NOISE_FREE, mean=np.array([ZERO, ZERO, (1.0, 0.0, 0.0)])),
            INITIAL,
            2.5,  # positions show it
            True,
        ),
    ],
)
@pytest.mark.parametrize(("north_m", "bound", "braking"), [(0.0, 3.0, False), (3.0, 1.4, False), (0.0, 3.0, True)])
def test_plans_end_beyond_a_bound_by_what_is_witness_and_how_near_a_wall_is(
    tick: Observation,
    heard_ns: int | None,
    observer: Observer | None,
    change: VelocityChangeState,
    factor: float,
    is_heard: bool,
    north_m: float,
    bound: float,
    braking: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tick = structs.replace(tick, position_m=(north_m, 0.0, -2.0), velocity_mps=(0.1, 0.0, 0.0), braking=braking)
    # While the fallback brakes, and positions come, the least evidence is enough.
    limit = factor * (1.4 if braking and is_heard else bound)
    assert not ends_plans(monkeypatch, limit, tick, observer, change, heard_ns)
    assert ends_plans(monkeypatch, just_more(limit), tick, observer, change, heard_ns)


@pytest.mark.parametrize(
    ("tick", "heard_ns", "change", "counts"),
    [
        (FELT, START_NS, CONSISTENT, True),
        (FELT, None, CONSISTENT, False),  # no position comes
        (FELT, START_NS, INITIAL, False),
        (seen(START_NS, vehicle_motion=motion(ZERO, START_NS)), START_NS, CONSISTENT, False),  # no inertial data
    ],
)
@pytest.mark.parametrize(("north_m", "bound"), [(0.0, 3.0), (3.0, 1.4)])
def test_what_has_just_become_wrong_takes_half_as_much_again(
    tick: Observation,
    heard_ns: int | None,
    change: VelocityChangeState,
    counts: bool,
    north_m: float,
    bound: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tick = structs.replace(tick, position_m=(north_m, 0.0, -2.0), velocity_mps=(0.1, 0.0, 0.0))
    for evidence, ends in ((1.5 * bound, False), (just_more(1.5 * bound), counts)):
        monkeypatch.setattr(response, "compute_onset_evidence", lambda *_, found=evidence: (found, "mirrored in north"))
        assert ends_plans(monkeypatch, 0.0, tick, None, change, heard_ns) == ends


def make_onset(left_mps2: list[Vec3], ages_ms: list[int], before_mps2: Vec3 = ZERO) -> ResponseState:
    """Make the state of a vehicle of which an exact response leaves this, at those ages; nothing has been asked for."""
    samples = tuple(
        (START_NS - ms * MS, (1.0, *left, *ZERO, *ZERO)) for left, ms in zip(left_mps2, ages_ms, strict=True)
    )
    return ResponseState(
        requested=((START_NS - 999 * MS, (1.0, 1.0, 1.0)), *((at_ns, ZERO) for at_ns, _ in samples)),
        samples=samples,
        baseline=(2.0, *(2.0 * x for x in before_mps2), 0.0, 0.0, 0.0),
    )


@pytest.mark.parametrize(
    ("ages_ms", "finds"), [([350, 200, 0], True), ([349, 200, 0], False), ([2000, 349, 0], True), ([400, 0], True)]
)
def test_the_time_since_a_response_may_be_wrong_must_be_known(ages_ms: list[int], finds: bool) -> None:
    state = make_onset([(9.0, 9.0, 9.0)] * len(ages_ms), ages_ms)
    assert (response.compute_onset_evidence(state, ROOM) != (0.0, "")) == finds


@pytest.mark.parametrize("axes", [(0,), (1,), (0, 1), (2,)])
def test_a_response_that_has_just_become_wrong_leaves_a_variance_and_a_jump(axes: tuple[int, ...]) -> None:
    """2 / 2 ln(1 + V / σ²) + J / 2 σ_J² is just below 2.1, or just above, whatever was before."""
    before, jump_mps2, parameters = (0.1, 0.2, -0.3), 0.5, replace(ROOM, unexplained_mps2=UNIT_MPS2)
    jumped = len(axes) * jump_mps2**2 / 2.0
    std_mps2 = 0.2 * UNIT_MPS2 * math.sqrt(math.expm1(1.5 * NEAR - jumped) / len(axes))
    for factor, finds in ((1.0 - 1e-6, False), (1.0 + 1e-6, True)):
        left = [
            vec3([x + (axis in axes) * (jump_mps2 + sign * factor * std_mps2) for axis, x in enumerate(before)])
            for sign in (-1.0, 1.0)
        ]
        state = make_onset([(9.0, 9.0, 9.0), *left], [350, 200, 0], before)
        assert (response.compute_onset_evidence(state, parameters) != (0.0, "")) == finds


@pytest.mark.parametrize("answer_down", [-1.0, 0.0])
def test_what_an_exact_response_leaves_is_the_acceleration_less_what_setpoints_give(answer_down: float) -> None:
    samples = tuple(
        (START_NS - ms * MS, (1.0, -x, x, answer_down * x, x, -x, x, *ZERO))
        for ms, x in ((350, 1.5), (300, -1.5), (200, 1.5), (100, -1.5), (0, 1.5))
    )
    requested = tuple((at_ns, (row[4], row[5], row[6])) for at_ns, row in samples)
    state = ResponseState(requested=requested, samples=samples, baseline=(2.0, *[0.0] * 6))
    assert response.compute_onset_evidence(state, replace(ROOM, lag_s=ZERO))[0] > 1.0


@pytest.mark.parametrize("kind", ["turned by 90°", "turned by 180°", "mirrored in east", "not at all"])
def test_a_bound_hides_no_evidence_above_it(kind: str) -> None:
    rng, known = np.random.default_rng([*WRONG_HORIZONTAL].index(kind)), []
    for part in np.linspace(0.1, 1.0, 10):
        blend = part * WRONG_HORIZONTAL[kind][0] + (1.0 - part) * np.eye(2)
        state = make_state(rng, (blend, np.eye(1)), 0, rng.uniform(0.0, 2.0))
        last_before = state.samples[-1][0] - 350 * MS, state.samples[-5][1]
        state = structs.replace(state, samples=(*state.samples[:-5], last_before, *state.samples[-4:]))
        evidence = response.compute_onset_evidence(state, ROOM)
        for bound in (1.5 * NEAR, 0.999 * evidence[0], 1.001 * evidence[0] + 1e-9):
            found = response.compute_onset_evidence(state, ROOM, bound)
            assert found == evidence if evidence[0] > bound else found[0] <= bound
        assert response.compute_onset_evidence(state, ROOM, 1e9) == (0.0, "")
        known.append(evidence[0])
    assert max(known) > 1.5 * NEAR


@pytest.mark.parametrize(("jump_mps2", "finds"), [(2.0493901531919194, False), (2.04939015319192, True)])
def test_a_response_is_compared_where_an_exact_one_leaves_more_than_the_least_bound(
    jump_mps2: float, finds: bool
) -> None:
    """2.049...² / 2 is 1.5 · 1.4, to the last bit."""
    assert (jump_mps2**2 / 2.0 == 1.5 * NEAR) != finds
    state = make_onset([(9.0, 9.0, 9.0), (jump_mps2, 0.0, 0.0), (jump_mps2, 0.0, 0.0)], [350, 200, 0])
    evidence = response.compute_onset_evidence(state, replace(ROOM, unexplained_mps2=UNIT_MPS2))
    assert (evidence != (0.0, "")) == finds


@pytest.mark.fault(101)
@pytest.mark.parametrize("kind", ["turned by 90°", "turned by 270°", "mirrored in north", "mirrored in east"])
def test_a_response_that_has_just_become_wrong_is_found_soon(kind: str) -> None:
    first_s = get_first_s(fly(make_wrong(kind), position_m=(0.0, 0.0, -2.0)))
    assert first_s is not None and WRONG_S < first_s <= WRONG_S + 0.3


@pytest.mark.parametrize(
    ("d_mps2", "inertial_mps2", "is_witness"),
    [(0.3 * 1.5, 0.0, False), (just_more(0.3 * 1.5), 0.0, True), (2.0, 1.0, False), (just_more(2.0), 1.0, True)],
)
def test_positions_are_witness_beyond_a_bound(
    d_mps2: float, inertial_mps2: float, is_witness: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    observer = structs.replace(
        NOISE_FREE,
        mean=np.array([ZERO, ZERO, (d_mps2, 0.0, 0.0)]),
        inertial=np.array([ZERO, ZERO, (inertial_mps2, 0.0, 0.0)]),
    )
    tick = structs.replace(FELT, motion=None)
    assert ends_plans(monkeypatch, 99.0, tick, observer, INITIAL) == is_witness
    assert not ends_plans(monkeypatch, 99.0, tick, structs.replace(observer, inertial=None), INITIAL)
    for age_ns, counts in ((400 * MS, is_witness), (400 * MS + 1, False)):
        old = structs.replace(observer, at_ns=START_NS - age_ns)
        assert ends_plans(monkeypatch, 99.0, tick, old, INITIAL) == counts


def test_sums_of_equal_samples_are_geometric_series() -> None:
    """Σ w k^i is w (1 - k^n) / (1 - k), with k = e^(-Δt/τ)."""
    state, n, w = ResponseState(requested=((START_NS - TICK_NS, (1.0, 0.5, -0.25)),)), 30, TICK_NS * 1e-9 / 0.05
    for tick in range(n):
        seen_now = structs.replace(
            seen(START_NS + tick * TICK_NS), inertial_mps2=(3.0, 0.0, 0.25), velocity_mps=(0.5, math.nan, -2.0)
        )
        moved = Motion(model_mps2=(1.0, 0.5, -0.25))
        state, _ = response.update(state, TickObservation(seen_now, moved, ROOM), VelocityChangeState())
    short, long = (
        w * (1.0 - math.exp(-n * 0.05 / memory_s)) / (1.0 - math.exp(-0.05 / memory_s)) for memory_s in (0.4, 10.0)
    )
    recent = (1.0, 2.0, -0.5, 0.5, 4.0, 0.25, 0.25, 3.0, 0.0, 0.25, 9.0, 0.0, 0.0625)
    assert state.recent == pytest.approx([short * x for x in recent])
    assert state.baseline == pytest.approx([long * x for x in (1.0, 2.0, -0.5, 0.5, 0.5, 0.0, -2.0)])
    sample = (w, 3.0, 0.0, 0.25, 1.0, 0.5, -0.25, 0.5, 0.0, -2.0)
    assert [row for _, row in state.samples] == [pytest.approx(sample)] * n


def test_samples_of_two_seconds_are_kept_and_setpoints_for_a_little_longer() -> None:
    row = (1.0, *[0.0] * 9)
    ages_ns = (2600 * MS, 2600 * MS - 1, 2000 * MS, 2000 * MS - 1)
    state = ResponseState(
        requested=tuple((START_NS - ns, ZERO) for ns in ages_ns),
        samples=tuple((START_NS - ns, row) for ns in ages_ns),
        inertial_ns=START_NS,
    )
    after, _ = response.update(state, observe(FELT), CONSISTENT)
    assert [START_NS - ns for ns, _ in after.requested] == [*ages_ns[1:], 0]
    assert [START_NS - ns for ns, _ in after.samples] == [ages_ns[3], 0]


@pytest.mark.parametrize(
    ("inertial_age_ms", "before_age_ms", "own_age_ms", "count"),
    [
        (None, 300, 0, 1),
        (None, 301, 0, 0),
        (300, 300, 0, 0),  # inertial data count for 0.3 s, too
        (301, 300, 0, 1),
        (None, 400, 300, 1),
        (None, 400, 301, 0),  # the own velocity is too old
    ],
)
def test_own_velocities_up_to_three_tenths_of_a_second_old_and_apart_show_an_acceleration(
    inertial_age_ms: int | None, before_age_ms: int, own_age_ms: int, count: int
) -> None:
    state = ResponseState(
        requested=((START_NS - TICK_NS, ZERO),),
        velocity=(START_NS - before_age_ms * MS, ZERO),
        inertial_ns=None if inertial_age_ms is None else START_NS - inertial_age_ms * MS,
    )
    own = motion((0.6, 0.0, 0.0), START_NS - own_age_ms * MS)
    after, _ = response.update(state, observe(seen(START_NS, vehicle_motion=own)), CONSISTENT)
    assert len(after.samples) == count
    assert (after.velocity is None) == (own_age_ms > 300 or inertial_age_ms == 300)
    if count:
        middle_ns, row = after.samples[0]
        assert middle_ns == START_NS - (before_age_ms + own_age_ms) * MS // 2
        assert row[1] == pytest.approx(0.6 / (1e-3 * (before_age_ms - own_age_ms)))


def test_a_vehicle_that_can_just_stop_overruns_nothing() -> None:
    """x = v T + v² / 2 a, at 3 m/s with 2 m/s²; with 4.5 m/s to the side the landing stops both."""
    for east_mps, stop_m in (
        (0.0, 3.0 * (0.3 + 3.0 / 2.0 / 2.0)),
        (-4.5, 3.0 * (0.3 + math.hypot(3.0, 4.5) / (2.0 * 2.5))),
    ):
        tick = structs.replace(seen(START_NS), position_m=(0.0, 0.0, -2.0), velocity_mps=(3.0, east_mps, 0.0))
        for upper_m, overruns in ((stop_m, False), (just_less(stop_m), True)):
            parameters = replace(PARAMETERS, lower_m=(-3.0, -999.0, -4.0), upper_m=(upper_m, 2.0, -1.0))
            assert bool(outside.describe_overrun(tick, parameters)) == overruns
