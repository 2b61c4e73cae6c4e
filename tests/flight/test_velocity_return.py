"""Monitor of the velocity: positions that come back beside the vehicle's own way, and what they move from it then."""

from __future__ import annotations

import numpy as np
import pytest
from envelope_rig import AT_NS, PARAMETERS, believed, just_more, seen, vec3
from flight_rig import MS, START_NS
from msgspec import structs

from uavctl.arrays import SECOND_NS
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors import velocity
from uavctl.flight.monitors.motion import Motion, PositionObservation, find_distance
from uavctl.flight.monitors.velocity import VelocityState
from uavctl.records import Vec3


def observe_return(
    now_m: Vec3, path: tuple[tuple[int, Vec3], ...], at_ns: int, resumed_ns: int | None
) -> PositionObservation:
    """The position `now_m` comes after a silence."""
    return structs.replace(
        believed(now_m), at_ns=at_ns, tick=seen(at_ns), motion=Motion(vehicle_path=path, resumed_ns=resumed_ns)
    )


def find_return(
    before: velocity.Offsets, now_m: Vec3, path: tuple[tuple[int, Vec3], ...], at_ns: int, *, resumed_ns: int | None
) -> tuple[float, list[float], float] | None:
    """The position `now_m` comes after a silence: its offset is that from the vehicle's own way."""
    distance = find_distance(path, at_ns)
    offset = () if distance is None else (*before, (at_ns, vec3(np.subtract(now_m, distance))))
    return velocity._find_return(before, offset, observe_return(now_m, path, at_ns, resumed_ns))


@pytest.mark.parametrize("accel_mps2", [(0.7, -1.1, 0.4), (0.0, 0.0, 0.0)])
def test_a_vehicle_that_accelerates_through_a_silence_comes_back_on_its_own_way(accel_mps2: Vec3) -> None:
    """Ticks of 0.25 s count with the velocity at their end, Σ Δt v_k; the position is v_0 t + ½ a t²."""
    accel, begin_mps, ticks, step_ns = np.array(accel_mps2), np.array([0.3, 0.0, -0.2]), 16, 250 * MS
    times_s = 0.25 * np.arange(ticks)
    flown = np.cumsum([0.25 * (begin_mps + s * accel) for s in times_s], axis=0)
    path = tuple((START_NS + k * step_ns, vec3(flown[k])) for k in range(ticks))

    def fly(s: float) -> Vec3:
        return vec3(begin_mps * s + 0.5 * accel * s * s)

    then, now = 2, 14
    before = ((START_NS + then * step_ns, vec3(np.subtract(fly(times_s[then]), flown[then]))),)
    at_ns, end = START_NS + now * step_ns, fly(times_s[now])
    for off_m in (ZERO, (0.1, 0.2, -0.3)):
        found = find_return(before, vec3(end + np.array(off_m)), path, at_ns, resumed_ns=at_ns)
        assert found is not None and found[0] == pytest.approx(3.0) and found[1] == pytest.approx(off_m)
    for resumed_ns in (None, at_ns - 1):  # it is not the first position
        assert find_return(before, (9.0, 9.0, 9.0), path, at_ns, resumed_ns=resumed_ns) is None
    assert find_return((), (9.0, 9.0, 9.0), path, at_ns, resumed_ns=at_ns) is None
    assert find_return(before, (9.0, 9.0, 9.0), path[:now], at_ns, resumed_ns=at_ns) is None  # the way is not known


def test_positions_come_back_just_so_far_beside_the_way() -> None:
    """(0.8 s + 0.12 1/s t²) v_max, where no tick of the begin is known any more."""
    path = ((START_NS, ZERO), (START_NS + 500 * MS, ZERO), (START_NS + 2500 * MS, ZERO))
    at_ns, before = START_NS + 2000 * MS, ((START_NS, ZERO),)
    bound_m = (0.8 + 0.12 * 2.0 * 2.0) * 0.25
    found = find_return(before, (0.0, -bound_m, 0.0), path, at_ns, resumed_ns=at_ns)
    assert found == (2.0, [0.0, -bound_m, 0.0], bound_m)
    for off_m, ends in ((bound_m, False), (just_more(bound_m), True)):
        observation = observe_return((0.0, -off_m, 0.0), path, at_ns, at_ns)
        state, verdict = velocity.update(VelocityState(offsets=before), observation)
        assert state.returned == ([0.0, -off_m, 0.0], bound_m) and verdict.is_none != ends


@pytest.mark.fault(95)
@pytest.mark.parametrize(
    ("place_m", "allowed_m", "bound_m"),
    [
        ((0.0, 0.0, -2.0), 0.68, 0.68),
        ((2.6, 0.0, -2.0), 0.68, 0.8 * 0.68),  # the own way leads to the wall
        ((0.0, 0.0, -2.0), 0.2, 0.5),  # as a drift without a silence
        ((2.6, 0.0, -2.0), 0.2, 0.25),
    ],
)
@pytest.mark.parametrize("back_m", [0.2, 0.0, -0.2])
def test_what_positions_came_back_with_and_have_moved_since_is_bounded_in_all(
    place_m: Vec3, allowed_m: float, bound_m: float, back_m: float
) -> None:
    """They came back south of the own way, and have moved further south; in 5 s, 0.2 m more are allowed."""
    since_ns = AT_NS - 5 * SECOND_NS
    places, returned = ((since_ns, (7.0, 0.0, 0.0), ZERO),), ([-back_m, 0.0, 0.0], allowed_m)
    for beyond_m, is_found in ((-1e-9, False), (1e-9, True)):
        now = [7.0 - (bound_m + 0.16 * 5.0 * PARAMETERS.disagreement_mps + beyond_m - back_m), 0.0, 0.0]
        # Places from before the return hold what it has shown.
        for resumed_ns in (since_ns, since_ns + 1):
            observation = structs.replace(believed(place_m), motion=Motion(resumed_ns=resumed_ns))
            state = VelocityState(places=places, returned=returned)
            found = velocity._find_return_drift(state, now, [places[0][1]], places, observation)
            assert (found is not None) == (is_found and resumed_ns == since_ns)
    assert velocity._find_return_drift(VelocityState(), now, [places[0][1]], places, observation) is None
    assert velocity._find_return_drift(VelocityState(returned=returned), now, [], (), observation) is None


@pytest.mark.fault(95)
def test_positions_that_came_back_beside_the_way_may_move_less_from_it() -> None:
    """By 0.68 m in 5 s: a drift without a silence may be 0.7 m."""
    places = ((AT_NS - 5 * SECOND_NS, ZERO, ZERO),)
    now = (-0.68, 0.0, 0.0)
    observation = structs.replace(believed((0.0, 0.0, -2.0)), motion=Motion(resumed_ns=places[0][0]))
    for returned in (None, ([-0.25, 0.0, 0.0], 0.7)):
        state = VelocityState(places=places, returned=returned)
        drift, *_ = velocity._find_drift(state, ((AT_NS, now),), np.array([now]), ZERO, observation)
        assert drift == (None if returned is None else (5.0, [-0.93, 0.0, 0.0]))
