"""What counts as fresh, and in a row."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flight_rig import HORIZON, MS, START_NS, TICK_NS, make_controller, sample, vehicle
from msgspec import structs

from uavctl.event_codes import EventCode
from uavctl.flight.estimator import LATEST_STAMP_NS, begin_history, note_input, predict_belief
from uavctl.flight.measure import GatedSamples, gate_samples
from uavctl.flight.monitors import smoothing
from uavctl.flight.monitors.outliers import GateParameters
from uavctl.flight.state import SourceHealth
from uavctl.records import PositionSample, StepInput, Vec3, VehicleMotion

CONTROLLER = make_controller()


def taken(ticks: list[tuple[int, list[PositionSample]]], horizon: int = HORIZON) -> GatedSamples:
    """Intake after several ticks, each (time in ms, samples)."""
    history = begin_history(CONTROLLER.kalman, START_NS, START_NS)
    intake = GatedSamples(history, SourceHealth())
    for at_ms, samples in ticks:
        inp = StepInput(tick=at_ms // 50, at_ns=START_NS + at_ms * MS, samples=tuple(samples))
        intake = gate_samples(
            CONTROLLER.kalman,
            CONTROLLER.reach,
            intake.history,
            intake.sources,
            inp,
            horizon,
            intake.consecutive_samples,
        )
    return intake


def captured(at_ms: int, source: str = "camera", received_ms: int | None = None) -> PositionSample:
    received_ns = None if received_ms is None else START_NS + received_ms * MS
    return sample(START_NS + at_ms * MS, received_ns, source=source)


def test_samples_of_one_a_step_are_in_a_row() -> None:
    assert taken([(at, [captured(at)]) for at in (0, 200, 400, 600)]).consecutive_samples == 4


def test_several_in_one_tick_count_each() -> None:
    assert taken([(100, [captured(60), captured(20), captured(100)])]).consecutive_samples == 3


# H = 4: at the boundary of 1000 ms the sample of 200 ms is H steps old, unless there is one from up to then.
@pytest.mark.parametrize(("captured_ms", "fresh"), [(850, 3), (1000, 3), (1001, 1)])
def test_a_boundary_at_which_the_age_reaches_the_horizon_begins_the_row_anew(captured_ms: int, fresh: int) -> None:
    assert (
        taken([(0, [captured(0)]), (200, [captured(200)]), (1050, [captured(captured_ms)])]).consecutive_samples
        == fresh
    )


# A third of H = 4 steps of 200 ms is 266.7 ms, of H = 12 it is 800 ms; for H = 2 it is one step all the same.
@pytest.mark.parametrize(
    ("horizon", "age_ms", "fresh"), [(4, 266, 2), (4, 267, 0), (12, 800, 2), (12, 801, 0), (2, 200, 2), (2, 201, 0)]
)
def test_a_sample_older_than_a_third_of_the_horizon_breaks_the_row(horizon: int, age_ms: int, fresh: int) -> None:
    before = captured(1000 - age_ms - 50)
    assert taken([(1000 - age_ms, [before]), (1000, [captured(1000 - age_ms)])], horizon).consecutive_samples == fresh


def test_an_overtaken_sample_changes_nothing() -> None:
    assert taken([(200, [captured(200)]), (250, [captured(150)])]).consecutive_samples == 1


def test_the_same_instant_from_a_second_source_counts_once() -> None:
    intake = taken([(200, [captured(200), captured(200, source="second")])])
    assert (len(intake.accepted), intake.consecutive_samples) == (2, 1)


def test_refused_samples_do_not_count() -> None:
    again = captured(200)
    future = captured(471, received_ms=450)
    intake = taken([(200, [again]), (450, [again, future])])
    assert (intake.consecutive_samples, intake.accepted) == (1, ())
    assert intake.refused == ((future, "sample-future"), (again, "sample-duplicate"))


def test_a_stamp_within_the_tolerance_after_the_arrival_counts_as_captured_at_the_arrival() -> None:
    arrival_ns = START_NS + 440 * MS
    intake = taken([(450, [sample(arrival_ns + LATEST_STAMP_NS, arrival_ns)])])
    assert (len(intake.accepted), intake.history.captured_ns) == (1, arrival_ns)


def test_a_stamp_further_after_the_arrival_is_refused_though_it_is_less_than_a_tick() -> None:
    arrival_ns = START_NS + 440 * MS
    intake = taken([(450, [sample(arrival_ns + LATEST_STAMP_NS + 1, arrival_ns)])])
    assert (len(intake.accepted), [why for _, why in intake.refused]) == (0, ["sample-future"])


def pushed(
    says: dict[str, int], ticks: int, *, believes: bool = True, own: Vec3 | None = None, at_rest_mps: float = 0.0
) -> list[GatedSamples]:
    """Cameras, some millimetres off, of a vehicle pushed north from tick 12 on; each says the same from a tick on.

    A tick of -1 is never. Where they are not to be believed, what is said again does not come. `own` is the velocity
    that the vehicle says it has.
    """
    gate = GateParameters(sigma=6.0, margin_m=0.1, jump_ns=500 * MS, at_rest_mps=at_rest_mps)
    controller = replace(make_controller(), position_gate=gate)
    history = begin_history(controller.kalman, START_NS, START_NS)
    a, b, _ = controller.plant.transition(TICK_NS * 1e-9)
    x, intakes, last = np.zeros(3), [], dict.fromkeys(says, 0.0)
    intake = GatedSamples(history, SourceHealth())
    for tick in range(ticks):
        at_ns, samples = START_NS + tick * TICK_NS, []
        for n, (source, freezes) in enumerate(says.items()):
            again = 0 <= freezes < tick
            last[source] = last[source] if again else float(x[0]) + 0.001 * (tick % 2)
            if believes or not again:
                samples.append(sample(at_ns - n * MS, at_ns, (last[source], 0.0, 0.0), source=source))
        told = None if own is None else VehicleMotion(velocity_mps=own, velocity_ns=at_ns)
        inp = StepInput(tick=tick, at_ns=at_ns, samples=tuple(samples), vehicle=vehicle(), motion=told)
        intake = gate_samples(
            controller.kalman,
            controller.reach,
            intake.history,
            intake.sources,
            inp,
            HORIZON,
            intake.consecutive_samples,
        )
        u = np.full(1, float(tick >= 12))
        intake = structs.replace(intake, history=note_input(intake.history, at_ns, u))
        intakes.append(intake)
        x = a @ x + b @ u
    return intakes


def known(intake: GatedSamples) -> str:
    """All that the filter knows, to the last bit."""
    history = intake.history
    newest_ns = history.entries[-1].key[0]
    return repr((history.anchor, history.entries, predict_belief(CONTROLLER.kalman, history, newest_ns)))


def refused_as(intake: GatedSamples) -> set[str]:
    return {why for _, why in intake.refused}


def test_what_a_stuck_source_said_again_is_taken_back() -> None:
    # From rest it says the same although it is pushed: at first nobody can tell it from one that rounds.
    found = pushed({"stuck": 12}, 40)
    back = [tick for tick, one in enumerate(found) if one.dropped_after_ns is not None]
    assert len(back) == 1
    (tick,) = back
    assert refused_as(found[tick]) == {EventCode.SAMPLE_FROZEN}
    believed = [n for n in range(13, tick) if found[n].accepted]
    assert believed  # or there was nothing to take back
    assert found[tick].dropped_after_ns == START_NS + 12 * TICK_NS
    assert found[tick].consecutive_samples == 0
    assert found[tick - 1].history.captured_ns == START_NS + believed[-1] * TICK_NS
    never = pushed({"stuck": 12}, 40, believes=False)
    assert known(found[tick]) == known(never[tick])
    for one in found[tick + 1 :]:
        assert (refused_as(one), one.dropped_after_ns, one.accepted) == ({EventCode.SAMPLE_FROZEN}, None, ())
    assert known(found[-1]) == known(never[-1])


@pytest.mark.parametrize(
    ("own", "at_rest_mps", "believed"),
    [
        ((0.0, 0.0, 0.0), 0.1, True),
        ((0.09, -0.09, 0.09), 0.1, True),
        ((0.1, 0.0, 0.0), 0.1, False),
        ((0.0, -0.1, 0.0), 0.1, False),
        ((0.0, 0.0, 0.1), 0.1, False),
        ((0.0, 0.0, 0.0), 0.0, False),  # its velocity is made of these positions
        ((math.nan, 0.0, 0.0), 0.1, False),
        (None, 0.1, False),
    ],
)
def test_who_says_that_it_rests_may_be_where_it_was(own: Vec3 | None, at_rest_mps: float, believed: bool) -> None:
    found = pushed({"stuck": 12}, 40, own=own, at_rest_mps=at_rest_mps)
    assert any(EventCode.SAMPLE_FROZEN in refused_as(one) for one in found) != believed


def test_what_others_said_meanwhile_is_kept() -> None:
    found = pushed({"good": -1, "stuck": 12}, 40)
    never = pushed({"good": -1, "stuck": 12}, 40, believes=False)
    back = [tick for tick, one in enumerate(found) if one.dropped_after_ns is not None]
    assert back and found[back[0]].dropped_after_ns == START_NS + 12 * TICK_NS - MS
    assert known(found[-1]) == known(never[-1])
    assert found[-1].history.captured_ns == START_NS + 39 * TICK_NS


def flown_on(values: dict[int, float], ticks: int) -> list[GatedSamples]:
    """Ticks that push all the time, and what a camera says in some of them (north) [m]."""
    controller = replace(make_controller(), position_gate=GateParameters(sigma=6.0, margin_m=0.1, jump_ns=500 * MS))
    intakes: list[GatedSamples] = []
    history, sources = begin_history(controller.kalman, START_NS, START_NS), SourceHealth()
    for tick in range(ticks):
        at_ns = START_NS + tick * TICK_NS
        said = (sample(at_ns, position_m=(values[tick], 0.0, 0.0)),) if tick in values else ()
        inp = StepInput(tick=tick, at_ns=at_ns, samples=said, vehicle=vehicle())
        intakes.append(gate_samples(controller.kalman, controller.reach, history, sources, inp, HORIZON, 0))
        history = note_input(intakes[-1].history, at_ns, np.ones(1))
        sources = intakes[-1].sources
    return intakes


BEFORE = {tick: 0.5 * (tick * TICK_NS * 1e-9) ** 2 + 0.002 * (tick % 3) for tick in range(10)}


def test_a_stale_value_whose_first_sample_was_lost_is_taken_back_as_soon_as_it_comes_again() -> None:
    # It froze at tick 10, of which nothing came: the first that comes is a value that nobody has heard.
    stale = BEFORE[9] + 0.03
    found, never = flown_on({**BEFORE, 14: stale, 15: stale}, 18), flown_on(BEFORE, 18)
    assert found[14].accepted
    assert found[14].history.captured_ns == START_NS + 14 * TICK_NS
    assert refused_as(found[15]) == {EventCode.SAMPLE_REPEATED}
    # The newest position that is left: a plan made since is outdated by it.
    assert found[15].dropped_after_ns == START_NS + 9 * TICK_NS
    assert found[15].history.captured_ns == START_NS + 9 * TICK_NS
    assert found[17].history.captured_ns == never[17].history.captured_ns


def test_a_value_whose_first_sample_cannot_have_been_lost_stays() -> None:
    found = flown_on({**BEFORE, 10: BEFORE[9] + 0.03, 15: BEFORE[9] + 0.03}, 16)
    assert refused_as(found[15]) == {EventCode.SAMPLE_REPEATED}
    assert found[15].dropped_after_ns is None
    assert found[15].history.captured_ns == START_NS + 10 * TICK_NS


def test_the_first_value_of_all_is_watched_and_stays_where_nothing_else_is_known() -> None:
    found = flown_on({0: 0.0, 18: 0.0}, 19)
    assert found[0].sources.tracks["camera"].first_ns == START_NS
    assert refused_as(found[18]) <= {EventCode.SAMPLE_REPEATED, EventCode.SAMPLE_FROZEN}
    assert refused_as(found[18])
    assert found[18].history.captured_ns == START_NS
    assert found[18].dropped_after_ns is None


@pytest.mark.parametrize(("own_mps", "jumps"), [(4.0, False), (0.0, True), (-4.0, True), (None, True)])
def test_a_position_far_from_its_prediction_jumped_unless_the_own_velocity_shows_its_way(
    own_mps: float | None, jumps: bool
) -> None:
    """After two seconds at rest one position is lost, and the next is 0.3 m further north."""
    history, sources, last = begin_history(CONTROLLER.kalman, START_NS, START_NS), SourceHealth(), 42
    intake = GatedSamples(history, sources)
    for tick in range(last + 1):
        at_ns = START_NS + tick * TICK_NS
        if own_mps is not None:
            # Ticks of 0.05 s: its way is 4 m/s (½ + 1) 0.05 s = 0.3 m.
            velocity: Vec3 = (own_mps if tick >= last - 1 else 0.0, 0.0, 0.0)
            motion = VehicleMotion(velocity_mps=velocity, velocity_ns=at_ns)
            sources = structs.replace(sources, smoothing=smoothing.note_velocity(sources.smoothing, motion))
        place: Vec3 = (0.3 if tick == last else 0.001 * (tick % 2), 0.0, 0.0)
        said = () if tick == last - 1 else (sample(at_ns, position_m=place),)
        inp = StepInput(tick=tick, at_ns=at_ns, samples=said, vehicle=vehicle())
        intake = gate_samples(CONTROLLER.kalman, CONTROLLER.reach, history, sources, inp, HORIZON, 0)
        assert tick == last or not intake.refused
        history, sources = intake.history, intake.sources
    assert refused_as(intake) == ({EventCode.SAMPLE_JUMP} if jumps else set())
