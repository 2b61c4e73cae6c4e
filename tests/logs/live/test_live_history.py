"""History of a flight for its live page: whole, in bounded memory, and the same as the page keeps."""

from __future__ import annotations

import itertools
import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from view_rig import fly_view

from logs.live.history import CAPACITY, History
from logs.live.scene import FlightScene
from uavctl.records import Decision, Estimate, Header, Truth, Vec3


def read(history: History) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(history.encode())
    return document


@given(
    st.lists(st.floats(0.0, 3.0), min_size=1, max_size=200),
    st.lists(st.one_of(st.none(), st.floats(0.0, 9.0)), min_size=200, max_size=200),
    st.integers(2, 9),
)
def test_it_reaches_from_the_first_state_to_the_last_and_keeps_the_largest_age(
    steps_s: list[float], ages_s: list[float | None], capacity: int
) -> None:
    history, time_s, told = History(capacity), 0.0, list[tuple[float, float | None, Vec3]]()
    for step_s, age_s in zip(steps_s, ages_s, strict=False):
        time_s += step_s
        told.append((time_s, age_s, (time_s, 0.0, -1.0)))
        history.add(time_s, age_s, {"one": told[-1][2]})
    document = read(history)
    samples, period_s = document["samples"], document["period_s"]
    assert len(samples) <= capacity
    indices = [index for index, *_ in samples]
    assert indices == sorted(set(indices))
    by_bin: dict[int, list[tuple[float, float | None, Vec3]]] = {}
    for state in told:
        by_bin.setdefault(int(state[0] / period_s), []).append(state)
    assert indices == list(by_bin)
    for (_, at_s, age_s, places_m), states in zip(samples, by_bin.values(), strict=True):
        assert (at_s, places_m) == (states[-1][0], {"one": list(states[-1][2])})
        assert age_s == max((one for _, one, _ in states if one is not None), default=None)


def test_a_flight_of_an_hour_is_whole_and_small() -> None:
    history = History()
    for tick in range(36_000):
        history.add(tick * 0.1, 0.1, {"one": (1.0, 2.0, -3.0)})
    document = read(history)
    times_s = [at_s for _, at_s, _, _ in document["samples"]]
    assert CAPACITY / 2 <= len(times_s) <= CAPACITY
    assert times_s[0] <= document["period_s"] and times_s[-1] == pytest.approx(3599.9)
    assert max(b - a for a, b in itertools.pairwise(times_s)) <= 2 * document["period_s"]


def test_an_earlier_time_begins_a_new_flight() -> None:
    history = History(4)
    for tick in range(100):
        history.add(float(tick), None, {"one": (0.0, 0.0, 0.0)})
    history.add(2.0, 0.5, {"two": (1.0, 1.0, 1.0)})
    assert read(history) == {"period_s": 0.1, "samples": [[20, 2.0, 0.5, {"two": [1.0, 1.0, 1.0]}]]}


def test_a_flight_s_history_has_its_true_path_and_its_ages() -> None:
    """Nobody asks for a scene meanwhile: a page that is opened at the end shows the whole flight."""
    history, started_ns = History(), fly_view().of(Header)[0].started_ns
    scene, truth_m, age_s, want = FlightScene(history), None, None, dict[int, tuple[float, Vec3 | None]]()
    for _, _, record in fly_view().entries:
        scene.add_record(record)
        match record:
            case Truth():
                truth_m = record.position_m
            case Estimate():
                age_s = max(0.0, record.age_s)
            case Decision():
                index = int((record.at_ns - started_ns) * 1e-9 / 0.1)
                want[index] = max(age_s or 0.0, want.get(index, (0.0, None))[0]), truth_m
    samples = read(history)["samples"]
    assert len(samples) > 20
    found = {
        index: (age or 0.0, tuple(places_m["truth"])) for index, _, age, places_m in samples if "truth" in places_m
    }
    assert found == {index: one for index, one in want.items() if one[1] is not None}
