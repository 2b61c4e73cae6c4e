"""The line at the top of a page, and why: each figure in it against the simulator's truth."""

from __future__ import annotations

import dataclasses
import json
import re

import numpy as np
import pytest
from loopback_rig import lockstep
from mavlink_rig import make_link
from recorded_rig import RELAYED, listen, make_page_data, truth
from report_rig import collect_figures
from synthetic_flight import fly
from synthetic_scene import room

from logs.recording.flight import FlightData
from logs.recording.summary import find_input_violations, find_state_violations, summarise
from logs.report.cursor import render_cursor_script
from logs.report.evidence import FlightEvidence
from logs.report.excursion import find_excursions
from logs.report.findings import Headline
from logs.report.headline import derive_headline
from logs.report.path_3d import draw_path_3d
from logs.report.plots import draw_path_views, find_moving_limits
from logs.report.verdicts import Judgement, judge_flight
from uavctl.cause import BAD, CAUTION, GOOD, Cause
from uavctl.records import Setpoint, SetpointSource, Truth

WALLS = {  # axis, sign, limit of preset and scene
    "north wall": (0, 1.0, 3.0),
    "south wall": (0, -1.0, 3.0),
    "east wall": (1, 1.0, 2.5),
    "west wall": (1, -1.0, 2.5),
    "ceiling": (2, -1.0, 2.5),
}
BLOWN = RELAYED[2]
WENT = re.compile(r"went ([\d.]+) (m|mm) (?:through the (.*?)|below the (floor)) at ([\d.]+) s")


def head(flight: FlightData, judged: Judgement | None = None) -> Headline:
    judged = judge_flight(flight) if judged is None else judged
    return derive_headline(FlightEvidence(flight, summarise(flight, wall_s=None), judged))


def went(text: str) -> tuple[float, str, float]:
    """How far [m], through which wall, and when [s], as a headline says."""
    found = WENT.search(text)
    assert found is not None, text
    return float(found[1]) * (1e-3 if found[2] == "mm" else 1.0), found[3] or found[4], float(found[5])


def check(headline: Headline, wanted: tuple[float, str, float]) -> None:
    beyond_m, wall, at_s = went(headline.text)
    assert wall == wanted[1]
    assert (beyond_m, at_s) == pytest.approx((wanted[0], wanted[2]), abs=0.06)


def furthest(flight: FlightData) -> tuple[float, str, float]:
    """The same by the simulator's truth: nothing but its places, the walls, and the time of the first tick."""
    rows = [
        (sign * truth.position_m[axis] - limit, wall, (truth.at_ns - flight.origin_ns) * 1e-9)
        for truth in flight.truths
        for wall, (axis, sign, limit) in WALLS.items()
    ]
    return max(rows)


@pytest.fixture(scope="module")
def flight() -> FlightData:
    return FlightData.from_records(fly(room(), 12.0))


@pytest.fixture(scope="module")
def judged(flight: FlightData) -> Judgement:
    return judge_flight(flight)


def bumped(flight: FlightData, wall: str, beyond_m: float, at_s: float, width_s: float = 0.6) -> FlightData:
    """The flight, with a true path that leaves a wall by so much around a time."""
    axis, sign, limit = WALLS[wall]
    index = flight.design.position_index[axis]

    def move(truth: Truth) -> Truth:
        part = max(0.0, 1.0 - abs((truth.at_ns - flight.origin_ns) * 1e-9 - at_s) / width_s)
        place, state = list(truth.position_m), list(truth.state)
        place[axis] = state[index] = (1.0 - part) * place[axis] + part * sign * (limit + beyond_m)
        return dataclass_of(truth, place, state)

    return dataclasses.replace(flight, truths=tuple(map(move, flight.truths)))


def dataclass_of(truth: Truth, place: list[float], state: list[float]) -> Truth:
    return Truth(
        at_ns=truth.at_ns, position_m=(place[0], place[1], place[2]), velocity_mps=truth.velocity_mps,
        state=tuple(state), input=truth.input, sent=truth.sent, lost=truth.lost, mode=truth.mode, faults=truth.faults,
    )  # fmt: skip


@pytest.mark.parametrize("wall", WALLS)
def test_it_names_wall_metres_and_time(flight: FlightData, judged: Judgement, wall: str) -> None:
    headline = head(bumped(flight, wall, 1.6, 8.0), judged)
    assert headline.tone == BAD
    check(headline, (1.6, wall, 8.0))
    assert headline.at_s == pytest.approx(8.0, abs=0.06)


def test_a_touch_is_no_grave_matter(flight: FlightData, judged: Judgement) -> None:
    headline = head(bumped(flight, "east wall", 0.02, 8.0), judged)
    assert Cause.TOUCHED_LIMIT in headline.causes and Cause.LEFT_LIMITS not in headline.causes
    (sentence,) = [reason for reason in headline.reasons if WENT.search(reason)]
    assert went(sentence)[:2] == (0.02, "east wall")


def test_a_flight_that_stayed_inside_says_so(flight: FlightData, judged: Judgement) -> None:
    headline = head(flight, judged)
    assert furthest(flight)[0] < 0.0 and find_excursions(flight) == ()
    assert headline.tone == GOOD and "inside its walls throughout" in headline.text
    near = re.search(r"([\d.]+) m from the (.*?) at the nearest, (?:at ([\d.]+) s|where it began)", headline.text)
    assert near is not None
    beyond_m, wall, at_s = furthest(flight)
    assert near[2] == wall and float(near[1]) == pytest.approx(-beyond_m, abs=0.05)
    assert float(near[3] or 0.5) == pytest.approx(at_s, abs=0.06 if near[3] else 0.5)


def test_without_truth_it_says_by_what(flight: FlightData, judged: Judgement) -> None:
    assert "by the estimate" in head(dataclasses.replace(flight, truths=()), judged).text
    assert "by the estimate" not in head(flight, judged).text


def test_it_says_when_it_left_and_came_back(flight: FlightData, judged: Judgement) -> None:
    moved = bumped(flight, "north wall", 1.0, 8.0)
    (excursion,) = find_excursions(moved)
    beyond = [(t.at_ns - flight.origin_ns) * 1e-9 for t in moved.truths if t.position_m[0] > 3.0]
    assert excursion.exit_s == pytest.approx(beyond[0]) and excursion.return_s == pytest.approx(
        beyond[-1] + 0.05, abs=0.051
    )
    (sentence,) = [why for why in head(moved, judged).reasons if "beyond the north wall" in why]
    assert [float(n) for n in re.findall(r"([\d.]+) s\b", sentence)] == pytest.approx(
        [excursion.exit_s, excursion.return_s], abs=0.051
    )


def test_blind_is_the_time_without_a_position() -> None:
    silent = FlightData.from_records(fly(room(), 12.0, blackout=(4.0, 8.0)))
    captured = sorted(sample.captured_ns for sample in silent.samples)
    gap_s = float(np.diff(captured).max()) * 1e-9
    headline = head(silent)
    assert headline.cause in (Cause.FLOWN_BLIND, Cause.SILENCE)
    lasted, begun, ended = (float(n) for n in re.findall(r"([\d.]+) s", headline.text)[:3])
    assert lasted == pytest.approx(gap_s, abs=0.26)  # known at ticks, and until the next position has come
    assert ended - begun == pytest.approx(lasted, abs=0.11)
    assert begun <= 4.05 and 7.9 <= ended <= 8.6


@pytest.mark.parametrize("code", [None, "hung-up", "went-silent"])
def test_a_vehicle_that_was_not_heard_is_told_before_what_came_of_it(
    flight: FlightData, judged: Judgement, code: str | None
) -> None:
    assert Cause.VEHICLE_SILENT not in head(flight, judged).causes
    kept = [status for status in flight.vehicles if not 3.0 < (status.at_ns - flight.origin_ns) * 1e-9 < 7.0]
    events = () if code is None else make_link().add_refusals({code: 1}, flight.origin_ns + 3_400_000_000)
    deaf = dataclasses.replace(flight, vehicles=tuple(kept), events=(*flight.events, *events))
    headline = head(deaf, judged)
    first = headline.text
    assert headline.cause is Cause.VEHICLE_SILENT
    assert "for 4.0 s, from 3.0 s on" in first
    assert ("at 3.4 s" in first and "connection" in first) == (code is not None)
    ends = dataclasses.replace(flight, vehicles=flight.vehicles[:8])
    assert "for 5.0 s, from 7.0 s on" in head(ends, judged).text


@pytest.mark.parametrize("every", [3, 50])
def test_setpoints_that_the_gate_changed_are_counted(flight: FlightData, judged: Judgement, every: int) -> None:
    def sent(number: int, at_ns: int) -> Setpoint:
        limited = () if number % every else ("slew-north",)
        return Setpoint(at_ns=at_ns, accel_mps2=(0.0, 0.0, 0.0), source=SetpointSource.PLAN, limited=limited)

    setpoints = tuple(sent(number, decision.at_ns) for number, decision in enumerate(flight.decisions))
    sentence = " ".join(head(dataclasses.replace(flight, setpoints=setpoints), judged).reasons)
    share = 100.0 * sum(bool(setpoint.limited) for setpoint in setpoints) / len(setpoints)
    assert (f"changed {share:.0f} % of the setpoints" in sentence) is (every == 3)
    assert ("slew north" in sentence) is (every == 3)


def test_crosses_are_on_the_axis_that_is_outside_only(flight: FlightData) -> None:
    moved = bumped(flight, "north wall", 1.0, 8.0)
    counts = [int(find_state_violations(moved, index).sum()) for index in range(9)]
    assert counts[0] > 0 and sum(counts) == counts[0]
    steps = flight.steps
    decided = steps.decided.copy()
    decided[5, 1] = 99.0
    over = dataclasses.replace(steps, decided=decided)
    pushed = dataclasses.replace(flight)
    pushed.__dict__["steps"] = over
    assert [int(find_input_violations(pushed, number).sum()) for number in range(3)] == [0, 1, 0]


def test_the_place_is_marked_in_each_view_of_the_path(flight: FlightData) -> None:
    def marked(flight: FlightData) -> list[list[str]]:
        with collect_figures() as figures:
            list(draw_path_views(flight))
            list(draw_path_3d(flight))
        texts = [[text.get_text() for text in figure.axes[0].texts] for figure in figures.values()]
        return [[text for text in each if text.startswith("left at") or " m out at " in text] for each in texts]

    moved = bumped(flight, "north wall", 1.0, 8.0)
    (excursion,) = find_excursions(moved)
    wanted = [f"left at {excursion.exit_s:.1f} s", f"1 m out at {excursion.worst_s:.1f} s"]
    assert marked(moved) == [wanted] * 3
    assert marked(flight) == [[]] * 3


def test_the_cursor_has_the_true_path_and_begins_where_it_matters(flight: FlightData) -> None:
    text = render_cursor_script(flight, 8.0)
    found = re.search(r"const flight = (\{.*?\});\n", text)
    assert found is not None
    given = json.loads(found[1])
    assert given["at_s"] == 8.0 and given["end_s"] == pytest.approx(flight.duration_s)
    true_s = flight.seconds([truth.at_ns for truth in flight.truths])
    for t_s, *place in given["course"]:
        near = int(np.abs(true_s - t_s).argmin())
        assert place == pytest.approx(flight.truths[near].position_m, abs=0.006)


# --- flights of the real controller in the simulator ---

WINDY = ("sim.plant=quadrotor", "sim.seed=1", "target.position_m=[2.2, 1.0, -1.2]")


@pytest.fixture(scope="module")
def blown() -> FlightData:
    memory = lockstep("room", 12.0, *WINDY, "sim.wind.velocity_mps=[4.0, 0.0, 0.0]", "sim.wind.gust_wind_mps=8.0")
    return FlightData.from_records(memory.entries)


@pytest.mark.slow
def test_wind_beyond_the_vehicles_strength_carries_it_out(blown: FlightData) -> None:
    headline = head(blown)
    beyond_m, wall, at_s = furthest(blown)
    assert beyond_m > 0.3 and wall == "north wall" and headline.tone == BAD
    check(headline, (beyond_m, wall, at_s))
    assert "wind" in headline.text
    bound = [event for event in blown.events if event.code == "bias-at-bound"]
    sentence = [why for why in headline.reasons if "bias was at its bound" in why]
    assert bool(sentence) == bool(bound)
    assert blown.breach is not None
    assert Cause.ENVELOPE in headline.causes
    (let_go,) = [why for why in headline.reasons if blown.breach.text in why]
    (breach_s,) = blown.seconds([blown.breach.at_ns])
    assert f"at {breach_s:.1f} s" in let_go


@pytest.mark.slow
def test_a_drifting_frame_is_told_as_wrong_positions_and_not_as_wind() -> None:
    fault = 'sim.fault=[{at_s=6.0, kind="drift", velocity_mps=[-0.1, 0.0, 0.0]}]'
    memory = lockstep("room", 22.0, "sim.plant=linear", "sim.seed=3", "target.position_m=[2.2, 1.0, -1.2]", fault)
    drifted = FlightData.from_records(memory.entries)
    headline, (beyond_m, wall, at_s) = head(drifted), furthest(drifted)
    assert "pushed by wind" not in headline.text
    if beyond_m > 0.05:
        check(headline, (beyond_m, wall, at_s))
    assert Cause.POSITIONS_DRIFTED in headline.causes and Cause.WIND not in headline.causes
    (sentence,) = [text for text in (headline.text, *headline.reasons) if "from the true place" in text]
    first_s = 6.0 + 0.3 / 0.1
    assert float(re.search(r"first at ([\d.]+) s", sentence)[1]) == pytest.approx(first_s, abs=0.5)  # type: ignore[index]


@pytest.mark.slow
def test_a_fence_that_closes_in_is_drawn_and_named() -> None:
    fence = 'fence=[{state="north", side="upper", times_s=[4.0, 8.0], values=[3.0, 0.5]}]'
    memory = lockstep("room", 11.0, "sim.seed=3", fence)
    closed = FlightData.from_records(memory.entries)
    (limit,) = find_moving_limits(closed)
    assert (limit.axis, limit.upper) == ("north", True)
    assert limit.tightest_m == pytest.approx(0.5)
    assert limit.at_s == pytest.approx(8.1, abs=0.2)
    headline = head(closed)
    assert furthest(closed)[0] < 0.0
    assert "fence" in headline.text and headline.tone == CAUTION
    late = [t.position_m[0] for t in closed.truths if (t.at_ns - closed.origin_ns) * 1e-9 > 8.2]
    assert max(late) < 0.55  # and so the target, at 1.5 m, was not to be reached
    assert re.search(r"target at the last step, which lay 1\.0 m beyond the limit north", headline.text)


@pytest.mark.slow
def test_a_recorded_flight_that_was_blown_away_is_told_by_its_positions() -> None:
    """PX4's own simulator, in a wind that its pilot had not ordered for; its truth was recorded beside it."""
    since_s, lasted_s = 50.0, 12.0
    headline = head(make_page_data(listen(BLOWN, since_s, lasted_s).memory))
    beyond_m, wall, at_s = went(headline.text)
    rows = truth(BLOWN)
    true_m = [float(np.interp(since_s + at_s, rows[:, 0], rows[:, 1 + axis])) for axis in range(3)]
    truly = {name: sign * true_m[axis] - limit for name, (axis, sign, limit) in WALLS.items()}
    assert wall == max(truly, key=truly.__getitem__) and truly[wall] > 0.5
    assert beyond_m == pytest.approx(truly[wall], abs=0.1)  # by positions, which are a little old
    assert "no longer used" in headline.text and headline.tone == BAD
