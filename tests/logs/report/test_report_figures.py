"""Figures and words where a flight has little to show, or much of the same."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from loopback_rig import lockstep
from report_rig import collect_figures, data, read_page_text
from synthetic_scene import room

from logs.recording.flight import FlightData
from logs.recording.notes import NoteKind, RecorderNote
from logs.recording.summary import summarise
from logs.report import link_figures, plan_figures, plots
from logs.report.figures import draw_overview
from logs.report.path_3d import draw_path_3d
from logs.report.plots import MAX_POINTS, thin_path
from logs.report.summary_text import describe_part_begin
from logs.report.svg import colour
from logs.report.verdict_clocks import format_plain
from logs.report.verdict_link import judge_link
from logs.report.verdicts import judge_flight


@pytest.fixture(scope="module")
def flight() -> FlightData:
    return data(room(), 12.0)


@pytest.fixture(scope="module")
def short() -> FlightData:
    return FlightData.from_records(lockstep("room-hahn-stursberg", 2.0, "solver.method=exact").entries)


def test_a_long_stay_takes_no_point_from_the_journey() -> None:
    journey = np.linspace([0.0, 0.0, -1.0], [6.0, 3.0, -1.0], 200)
    stay = journey[-1] + 0.01 * np.random.default_rng(0).standard_normal((20_000, 3))
    whole = np.vstack([journey, stay])
    kept = thin_path(whole)
    gone_m = np.linalg.norm(np.diff(whole, axis=0), axis=1).sum()
    assert len(kept) <= MAX_POINTS
    assert kept[0].tolist() == whole[0].tolist() and kept[-1].tolist() == whole[-1].tolist()
    step_m = np.linalg.norm(np.diff(kept, axis=0), axis=1)
    assert step_m.max() <= gone_m / MAX_POINTS + np.linalg.norm(np.diff(whole, axis=0), axis=1).max()
    assert len(thin_path(np.full((10, 3), np.nan))) == 0


def test_the_reserve_is_drawn_as_long_as_a_plan_is_flown(flight: FlightData) -> None:
    last = max(flight.flown_plans.values(), key=lambda plan: plan.base_ns)
    silent = last.base_ns + flight.design.dt_ns  # as if no news had come after that plan
    decisions = tuple(
        msgspec.structs.replace(d, plan_seq=last.seq) if d.at_ns >= silent else d for d in flight.decisions
    )
    with collect_figures() as figures:
        list(plots.draw_axes_over_time(dataclasses.replace(flight, decisions=decisions)))
    for figure in figures.values():
        bands = figure.axes[0].collections
        assert bands and all(band.get_paths()[0].get_extents().x1 == pytest.approx(flight.duration_s) for band in bands)


def test_what_is_too_small_to_count_is_no_slack(flight: FlightData) -> None:
    tiny = tuple(msgspec.structs.replace(plan, slack=1e-9, terminal_miss=1e-9) for plan in flight.plans)
    assert "plan-slack" not in read_page_text(dataclasses.replace(flight, plans=tiny)).plots


@pytest.mark.parametrize("slack", [0.003, 20.0])
def test_small_slack_fills_its_drawing(flight: FlightData, slack: float) -> None:
    two = {plan.seq for plan in list(flight.flown_plans.values())[:2]}
    plans = tuple(msgspec.structs.replace(plan, slack=slack) if plan.seq in two else plan for plan in flight.plans)
    with collect_figures() as figures:
        list(plan_figures.draw_certificates(dataclasses.replace(flight, plans=plans)))
    low, high = figures["Relaxed constraints of flown plans"].axes[0].get_ylim()
    assert low <= 0.0 and slack < high < 2 * slack


def test_gaps_that_are_alike_still_have_a_scale(flight: FlightData) -> None:
    gaps = np.geomspace(1.5e-9, 4e-9, len(flight.plans))
    plans = tuple(msgspec.structs.replace(plan, gap=gap) for plan, gap in zip(flight.plans, gaps, strict=True))
    with collect_figures() as figures:
        list(plan_figures.draw_certificates(dataclasses.replace(flight, plans=plans)))
    ax = figures["Certified gap"].axes[0]
    low, high = ax.get_ylim()
    assert low <= 100.0 * gaps[0] and 100.0 * gaps[-1] <= high and high < 1000.0 * gaps[-1]
    assert ax.get_yscale() == "log" and ax.get_ylabel().startswith("%")
    assert sum(low <= tick <= high for tick in ax.get_yticks()) >= 2


def test_arrivals_without_delay_are_not_drawn(flight: FlightData) -> None:
    inputs = tuple(
        msgspec.structs.replace(
            step, samples=tuple(msgspec.structs.replace(s, received_ns=s.captured_ns) for s in step.samples)
        )
        for step in flight.step_inputs
    )
    quick = dataclasses.replace(flight, step_inputs=inputs)
    with collect_figures() as figures:
        list(link_figures.draw_link_in_flight(quick, judge_link(quick, None)))
    assert "Capture to arrival, by the stamps" not in figures  # one value is no plot


def test_promised_risks_are_what_was_configured(short: FlightData) -> None:
    verdicts = judge_flight(short).verdicts
    promised = {limit.name: limit.promised for limit in verdicts.risk.limits}
    assert (promised["all states"], promised["all inputs"]) == (0.05, 0.1)
    assert verdicts.link.promised_ages[:3] == (0.7, 0.21, 0.063)


@pytest.mark.parametrize(
    ("value", "told"),
    [(-1291.4, "−1291"), (-63.5321, "−63.5"), (0.2994, "0.299"), (0.0, "0"), (-3e-15, "0"), (1e6, "1000000")],
)
def test_figures_of_clocks_have_no_exponent(value: float, told: str) -> None:
    assert format_plain(value) == told


def part_of(flight: FlightData, from_tick: int) -> FlightData:
    """What a later file of a recording holds."""
    begun_ns = flight.decisions[from_tick].at_ns
    return dataclasses.replace(
        flight,
        decisions=flight.decisions[from_tick:],
        truths=tuple(truth for truth in flight.truths if truth.at_ns >= begun_ns),
        estimates=tuple(estimate for estimate in flight.estimates if estimate.at_ns >= begun_ns),
    )


def test_a_part_of_a_flight_begins_at_its_tick_and_has_its_own_steps(flight: FlightData) -> None:
    part = part_of(flight, 80)
    assert describe_part_begin(flight) == "" and describe_part_begin(part).startswith("tick 80, 4 s")
    assert summarise(part, wall_s=None).steps == 40


def note(text: str, segment: int = 1, kind: NoteKind = NoteKind.STATE) -> RecorderNote:
    return RecorderNote(at_ns=0, segment=segment, written=0, dropped=0, refused=0, failures=0, text=text, kind=kind)


@pytest.mark.parametrize(
    ("kind", "breaks_off"),
    [(NoteKind.END, False), (NoteKind.BEGIN, True), (NoteKind.CONTINUED, False), (NoteKind.RECOVERED, True)],
)
def test_a_recording_breaks_off_unless_it_was_closed_or_goes_on(
    flight: FlightData, kind: NoteKind, breaks_off: bool
) -> None:
    cut = dataclasses.replace(flight, notes=(note("begin", kind=NoteKind.BEGIN), note("", kind=kind)))
    assert summarise(cut, wall_s=None).breaks_off is breaks_off


def test_a_later_file_has_its_own_figures(flight: FlightData) -> None:
    part = dataclasses.replace(part_of(flight, 80), notes=(note("goes on after flight.mcap", 2), note("end", 2)))
    found, whole = summarise(part, wall_s=None), summarise(flight, wall_s=None)
    first, last = part.truths[0], part.truths[-1]
    assert found.lost is not None
    assert (found.lost, found.received) == (last.lost - first.lost, last.sent - first.sent - found.lost)
    assert (whole.lost, whole.received) == (last.lost, last.sent - last.lost)
    assert found.accepted <= found.received


def test_without_truth_nothing_is_drawn_in_its_colour(flight: FlightData) -> None:
    def key(flight: FlightData) -> tuple[set[str], list[str]]:
        """Colours of the lines of the path in three dimensions, and what the small picture explains."""
        with collect_figures() as figures:
            list(draw_path_3d(flight))
            draw_overview(flight)
        deep = {str(line.get_color()) for line in figures[""].axes[0].lines if line.get_marker() == "None"}
        return deep, [text.get_text() for text in figures["The path, from above"].legends[0].get_texts()]

    seen, explained = key(flight)
    assert colour("truth") in seen and "position lost" in explained
    seen, explained = key(dataclasses.replace(flight, truths=()))
    assert colour("truth") not in seen and "position lost" not in explained
