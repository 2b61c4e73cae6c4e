"""The test of the response: a wrong one is found by its kind, a right one never, whatever the wind and the lag."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from envelope_rig import PARAMETERS, motion, seen
from flight_rig import MS, START_NS
from msgspec import structs

from uavctl.event_codes import EventCode
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors import response
from uavctl.flight.monitors.motion import Motion, TickObservation
from uavctl.flight.monitors.observer import Observer
from uavctl.flight.monitors.response import FAR, FAR_S, NEAR, WRONG, ResponseState
from uavctl.flight.monitors.velocity_change import VelocityChangeState
from uavctl.flight.monitors.verdict import Action
from uavctl.records import Vec3

TICK_NS = 50 * MS
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


WITNESSED_MPS2 = response.WITNESSED_PART * ROOM.unexplained_mps2


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
    first_s = [get_first_s(fly(make_wrong("turned by 180°"), silent_ns=ns * MS)) for ns in (400, 401)]
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
    stop_m = speed_mps * (response.REACTION_S + speed_mps / (2.0 * brake_mps2))
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
        text = response._describe_overrun(tick, PARAMETERS)
        assert says in text if says else not text


def test_a_gap_in_inertial_data_begins_anew() -> None:
    last = START_NS, (1.0, *[0.0] * 9)
    state = ResponseState(
        requested=((START_NS, ZERO),), inertial_ns=START_NS, samples=(last,), recent=(1.0, *[0.0] * 6)
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
