"""Figures of a flight against a flight small enough to count by hand."""

from __future__ import annotations

import math
import re

import msgspec
import numpy as np
import pytest
from rich.console import Console
from synthetic_flight import Item, fly, header
from synthetic_scene import paper, room

from logs.recording.flight import FALLBACK, FlightData
from logs.recording.summary import FlightSummary, Percentiles, compute_percentiles, make_summary_table, summarise
from uavctl.errors import RecordingError
from uavctl.event_codes import MISSION, EventCode
from uavctl.number_text import format_number, format_percent_above
from uavctl.records import (
    ControlMode,
    Decision,
    Estimate,
    Event,
    Order,
    Plan,
    Record,
    Severity,
    SolveStatus,
    StepInput,
    Timing,
    Truth,
)

DT_NS = 1_000_000_000
EMPTY_COV = tuple((0.0,) * 4 for _ in range(4))


def decision(k: int, mode: ControlMode = ControlMode.TRACK, **changes: object) -> Decision:
    one = Decision(
        tick=k,
        at_ns=k * DT_NS,
        step=k,
        boundary=True,
        mode=mode,
        age_steps=0,
        news=False,
        plan_seq=None,
        plan_index=None,
        solve=None,
        input=(0.0, 0.0),
        fresh=1,
        missed_ticks=0,
        accepted=1,
        rejected=0,
        reason="test",
    )
    return msgspec.structs.replace(one, **changes)


def truth(k: int, state: tuple[float, ...], u: tuple[float, ...] = (0.0, 0.0), part: float = 0.0) -> Truth:
    return Truth(
        at_ns=round((k + part) * DT_NS),
        position_m=(state[0], state[2], 0.0),
        velocity_mps=(state[1], state[3], 0.0),
        state=state,
        input=u,
        sent=k + 1,
        lost=k // 2,
        mode="OFFBOARD",
    )


def plan(seq: int, slack: float = 0.0, miss: float = 0.0, status: SolveStatus = SolveStatus.OPTIMAL) -> Plan:
    made = next(record for _, _, record in fly(paper(), 1.0) if isinstance(record, Plan))
    return msgspec.structs.replace(made, seq=seq, slack=slack, terminal_miss=miss, status=status)


def flight(*records: Record) -> FlightData:
    """Records behind the header of the paper's plant: Q = diag(10, 0.1, 10, 0.1), R = 0.1 I, target 0."""
    items: list[Item] = [("/uavctl/header", 0, header(paper(), 'name = "hand"', 0))]
    return FlightData.from_records([*items, *(("/any", 0, record) for record in records)])


def figures(*records: Record) -> FlightSummary:
    return summarise(flight(*records), wall_s=2.0)


def test_keys_of_the_command_line_are_there() -> None:
    named = {
        "steps",
        "duration_s",
        "received",
        "lost",
        "max_age",
        "fallbacks",
        "state_violations",
        "input_violations",
        "slack_used",
        "cost",
        "recording",
        "report",
        "wall_s",
        "decision_us",
        "tick_lateness_us",
        "ended",
    }
    made = msgspec.json.decode(msgspec.json.encode(figures(decision(0), truth(0, (0.0,) * 4))))
    assert named <= set(made)
    assert set(made["decision_us"]) == set(made["tick_lateness_us"]) == {"p50", "p99", "max"}


def test_cost_and_distance_by_hand() -> None:
    s = figures(
        decision(0),
        decision(1),
        truth(0, (3.0, 1.0, 4.0, -2.0), (0.0, 0.0)),
        truth(0, (2.9, 1.0, 4.0, -2.0), (5.0, -1.0), part=0.5),
        truth(1, (1.0, 0.0, 0.0, 0.0), (5.0, -1.0)),
        truth(1, (1.0, 0.0, 0.0, 0.0), (2.0, 0.0), part=0.5),
    )
    # step 0: 10*9 + 0.1*1 + 10*16 + 0.1*4 + 0.1*(25 + 1); step 1: 10*1 + 0.1*4
    assert s.cost == pytest.approx(250.5 + 2.6 + 10.0 + 0.4)
    assert s.final_error_m == pytest.approx(1.0)
    assert s.duration_s == 2.0
    assert s.real_time_factor == 1.0


def test_steps_count_only_flown_boundaries() -> None:
    s = figures(
        decision(0, ControlMode.WAIT, age_steps=None, input=None),
        decision(1),
        decision(2, boundary=False),
        decision(3, ControlMode.BRAKE, age_steps=12),
        decision(4, ControlMode.HOLD, age_steps=13),
        decision(5, ControlMode.LAND, age_steps=99),
        decision(6, ControlMode.STOPPED, age_steps=99),
        *(truth(k, (0.0,) * 4) for k in range(7)),
    )
    assert (s.steps, s.max_age) == (3, 13)


def test_fallback_is_counted_once_an_entry() -> None:
    modes = ["track", "brake", "hold", "track", "track", "brake", "land", "stopped"]
    s = figures(*(decision(k, ControlMode(mode)) for k, mode in enumerate(modes)), truth(0, (0.0,) * 4))
    assert s.fallbacks == 2
    assert figures(decision(0, ControlMode.BRAKE), truth(0, (0.0,) * 4)).fallbacks == 1


def modes(*names: str, stop_at: int | None = None) -> FlightData:
    """One decision a second in these modes; the operator asks for the hand-over from tick `stop_at` on."""
    stops = [] if stop_at is None else [StepInput(tick=stop_at, at_ns=stop_at * DT_NS, stop=True)]
    return flight(*stops, *(decision(k, ControlMode(name)) for k, name in enumerate(names)), truth(0, (0.0,) * 4))


@pytest.mark.parametrize(
    ("flown", "fallbacks", "spans", "ended"),
    [
        (modes("wait", "track"), 0, [], "still flying"),
        (modes("track", "brake"), 1, [(1.0, 2.0)], "still flying"),
        (modes("track", "wait"), 0, [], "waiting"),
        (modes("wait", "stopped", stop_at=1), 0, [], "waiting"),
        (modes("stopped", stop_at=0), 0, [], "waiting"),
        (modes("track", "brake", "hold", "land", "stopped"), 1, [(1.0, 4.0)], "landed by the fallback"),
        (modes("track", "brake", "land", "stopped", stop_at=3), 1, [(1.0, 3.0)], "landed by the fallback"),
        (modes("track", "brake", "hold", "land", "stopped", stop_at=1), 0, [], "ended by the operator"),
        (modes("track", "brake", "brake", "hold", stop_at=2), 1, [(1.0, 2.0)], "ended by the operator"),
        (
            modes("track", "brake", "track", "brake", "land", "stopped", stop_at=3),
            1,
            [(1.0, 2.0)],
            "ended by the operator",
        ),
    ],
)
def test_the_hand_over_after_the_operators_stop_is_no_fallback(
    flown: FlightData, fallbacks: int, spans: list[tuple[float, float]], ended: str
) -> None:
    s = summarise(flown, wall_s=1.0)
    assert (s.fallbacks, s.ending.cause) == (fallbacks, ended)
    assert flown.spans(FALLBACK) == spans


def test_violations_at_and_beyond_a_limit() -> None:
    beyond = 50.0 * (1 + 1e-8)
    states = [50.0, 50.0 * (1 + 1e-10), beyond, -30.0, -30.1, math.nan]
    s = figures(
        *(decision(k) for k in range(len(states))), *(truth(k, (x, 0.0, 0.0, 0.0)) for k, x in enumerate(states))
    )
    assert s.state_violations == 3
    assert s.state_source == "truth"


def test_input_at_its_limit_may_be_rounded_by_the_wire_but_not_by_the_controller() -> None:
    rounded = float(np.float32(0.49429632181478 * 7.5)) / 0.49429632181478
    assert abs(rounded - 7.5) > 7.5e-9
    on_wire = max(rounded, 7.5 + (7.5 - rounded))
    applied = figures(decision(0, input=(7.5, 0.0)), truth(0, (0.0,) * 4, (on_wire, 0.0)))
    decided = figures(decision(0, input=(on_wire, 0.0)), truth(0, (0.0,) * 4, (7.5, 0.0)))
    further = figures(decision(0, input=(7.5, 0.0)), truth(0, (0.0,) * 4, (-7.50001, 0.0)))
    assert [s.input_violations for s in (applied, decided, further)] == [0, 1, 1]


def test_slack_counts_plans_that_were_flown() -> None:
    s = figures(
        *(decision(k, plan_seq=k, plan_index=0, solve=SolveStatus.OPTIMAL) for k in range(4)),
        decision(4, plan_seq=3, plan_index=1, solve=SolveStatus.INFEASIBLE),
        truth(0, (0.0,) * 4),
        plan(0),
        plan(1, slack=1e-7, miss=1e-7),
        plan(2, slack=1e-3),
        plan(3, miss=1e-3),
        plan(4, slack=1.0, status=SolveStatus.INFEASIBLE),
        plan(9, slack=1.0),
    )
    assert (s.slack_used, s.solves, s.failed_solves) == (2, 5, 1)


def test_without_truth_the_estimate_stands_in_and_is_named() -> None:
    estimates = [
        Estimate(at_ns=k * DT_NS, captured_ns=k * DT_NS - 250_000_000, mean=(x, 0.0, 0.0, 0.0), cov=EMPTY_COV)
        for k, x in enumerate((2.0, 60.0))
    ]
    s = figures(decision(0, accepted=3, rejected=2), decision(1, input=(1.0, 0.0)), *estimates)
    assert (s.received, s.lost, s.accepted, s.rejected) == (4, None, 4, 2)
    assert (s.state_source, s.state_violations) == ("estimate", 1)
    assert s.cost == pytest.approx(10 * (4 + 3600) + 0.1)
    assert s.max_age_s == pytest.approx(0.25)


def test_decision_times_are_those_of_ticks_that_solved() -> None:
    timings = [
        Timing(tick=k, at_ns=k, lateness_ns=1000 * k, step_ns=t, send_ns=0) for k, t in enumerate((5000, 9, 7000))
    ]
    solved = [decision(k, solve=SolveStatus.OPTIMAL if k != 1 else None) for k in range(3)]
    s = figures(*solved, truth(0, (0.0,) * 4), *timings)
    assert (s.decision_us.p50, s.decision_us.max) == (6.0, 7.0)
    assert (s.tick_lateness_us.p50, s.tick_lateness_us.max) == (1.0, 2.0)
    unsolved = figures(*(decision(k) for k in range(3)), truth(0, (0.0,) * 4), *timings)
    assert unsolved.decision_us.p50 == 5.0


def test_spread_of_nothing_is_nothing() -> None:
    assert compute_percentiles(np.array([])) == Percentiles(p50=None, p99=None, max=None)


def test_one_tick_is_a_flight() -> None:
    s = figures(decision(0), truth(0, (3.0, 0.0, 4.0, 0.0)))
    assert (s.steps, s.duration_s, s.received, s.lost, s.final_error_m) == (1, 0.0, 1, 0, 5.0)


def test_a_flight_that_never_began() -> None:
    s = figures(decision(0, ControlMode.WAIT, age_steps=None, input=None))
    assert (s.steps, s.cost, s.max_age, s.final_error_m) == (0, 0.0, 0, None)


def test_empty_recordings_are_refused() -> None:
    with pytest.raises(RecordingError, match="no header"):
        FlightData.from_records([])
    with pytest.raises(RecordingError, match="no decision"):
        flight()


@pytest.mark.parametrize(
    ("change", "told"),
    [({"q_x": None}, "q_x"), ({"b_x": [1.0]}, "c_x"), ({"axes": ["north", "up"]}, "axes"), ({"dt_s": 0.0}, "dt_s")],
)
def test_designs_that_do_not_fit_are_refused(change: dict[str, object], told: str) -> None:
    good = header(paper(), "", 0)
    bad = msgspec.structs.replace(good, design={**good.design, **change})
    with pytest.raises(RecordingError, match=told):
        FlightData.from_records([("/uavctl/header", 0, bad), ("/uavctl/decision", 0, decision(0))])


def test_a_whole_flight_agrees_with_its_records() -> None:
    records = list(fly(room(), 12.0, seed=3, blackout=(4.0, 8.0)))
    s = summarise(FlightData.from_records(records), wall_s=1.0)
    last = [record for _, _, record in records if isinstance(record, Truth)][-1]
    assert (s.steps, s.received + s.lost if s.lost is not None else None) == (60, 60)
    assert s.lost == last.lost
    assert s.fallbacks == 1
    assert s.max_age >= 20
    assert s.duration_s == 12.0


def test_table_tells_estimates_from_truth() -> None:
    console = Console(width=120, file=None, record=True, quiet=False, force_terminal=False)
    with console.capture() as shown:
        console.print(make_summary_table(figures(decision(0), truth(0, (0.0,) * 4))))
        console.print(make_summary_table(figures(decision(0))))
    assert shown.get().count("true state is unknown") == 1  # without it there is no cost either
    assert "1 step;" in shown.get()


def shown(s: FlightSummary) -> str:
    console = Console(width=120, force_terminal=False)
    with console.capture() as text:
        console.print(make_summary_table(s))
    return text.get()


def test_paths_are_shown_as_they_are() -> None:
    s = summarise(flight(decision(0)), wall_s=1.0, recording="out/[red]a[/red]/[/x].mcap", report="[link]b.html")
    assert "out/[red]a[/red]/[/x].mcap" in shown(s)
    assert "[link]b.html" in shown(s)


def test_an_unknown_wall_time_is_left_out() -> None:
    s = summarise(flight(decision(0), decision(1)), wall_s=None)
    assert msgspec.json.decode(msgspec.json.encode(s))["wall_s"] is None
    assert s.real_time_factor is None
    assert "2 steps; 2 s\n" in re.sub(r" +\n", "\n", shown(s))
    still = Percentiles(p50=0.0, p99=0.0, max=0.0)  # virtual time
    timed = msgspec.structs.replace(s, wall_s=1.0, real_time_factor=2.0, tick_lateness_us=still)
    assert "2 s in 1 s (2 × real time)" in shown(timed)
    late = msgspec.structs.replace(timed, tick_lateness_us=Percentiles(p50=1.0, p99=2.0, max=3.0))
    assert "real time" not in shown(late)


@pytest.mark.parametrize(("late_ns", "virtual"), [((0, 0), True), ((0, 1), False)])
def test_virtual_time_has_no_lateness(late_ns: tuple[int, ...], virtual: bool) -> None:
    timings = [Timing(tick=k, at_ns=k, lateness_ns=late, step_ns=5000, send_ns=0) for k, late in enumerate(late_ns)]
    found = flight(decision(0), decision(1), *timings)
    assert found.virtual_time is virtual
    text = shown(summarise(found, wall_s=1.0))
    assert ("virtual time" in text) is virtual
    assert ("Tick lateness" in text) is not virtual


def test_unmeasured_ticks_are_not_called_virtual() -> None:
    assert not flight(decision(0)).virtual_time
    assert "not measured" in shown(figures(decision(0)))


def landing(*names: str, order_at: int | None = None, due_at: int | None = None) -> FlightData:
    """One decision a second in these modes; the operator orders the landing, or the mission is over, at a tick."""
    events = [] if order_at is None else [order_of(order_at, Order.LAND)]
    if due_at is not None:
        events.append(event_of(due_at, EventCode.BRAKE, MISSION))
    ticks = [decision(k, ControlMode(name)) for k, name in enumerate(names)]
    return flight(*events, *ticks, truth(0, (0.0,) * 4))


def order_of(k: int, order: Order) -> Event:
    return event_of(k, EventCode.ORDER_ACCEPTED, order)


def event_of(k: int, code: EventCode, subject: str) -> Event:
    return Event(at_ns=k * DT_NS, severity=Severity.INFO, code=code, text="", subject=subject)


@pytest.mark.parametrize(
    ("flown", "fallbacks", "spans", "ended"),
    [
        (landing("track", "brake", "hold", "land", "stopped", order_at=1), 0, [], "landed as ordered"),
        (landing("track", "brake", "hold", "land", "stopped", due_at=1), 0, [], "landed at the end of the mission"),
        # Positions were lost before the order: that was the fallback, until then.
        (landing("track", "brake", "brake", "hold", "land", order_at=2), 1, [(1.0, 2.0)], "landed as ordered"),
        (landing("track", "brake", "track", "brake", "land", order_at=3), 1, [(1.0, 2.0)], "landed as ordered"),
        # The pilot took over on the way down and gave the vehicle back: what comes after is another matter.
        (landing("track", "brake", "wait", "track", "brake", "land", order_at=1), 2, None, "landed by the fallback"),
        (landing("track", "brake", "hold", order_at=1), 0, [], "still flying"),
    ],
)
def test_a_landing_that_was_wanted_is_no_fallback(
    flown: FlightData, fallbacks: int, spans: list[tuple[float, float]] | None, ended: str
) -> None:
    s = summarise(flown, wall_s=1.0)
    assert (s.fallbacks, s.ending.cause) == (fallbacks, ended)
    assert spans is None or flown.fallback_spans == spans
    assert s.ending.sentence in " ".join(shown(s).split())


def test_another_order_is_no_landing() -> None:
    held = flight(order_of(1, Order.HOLD), *landing("track", "brake", "hold", "land").decisions, truth(0, (0.0,) * 4))
    assert summarise(held, wall_s=1.0).ending.cause == "landed by the fallback"


def test_the_end_is_in_the_table() -> None:
    text = shown(summarise(modes("track", "brake", "hold", "land", "stopped"), wall_s=1.0))
    assert "Landed by the fallback" in text
    assert "m at the last flown step" in text


@pytest.mark.parametrize(("value", "text"), [(40.0, "40"), (0.2271, "0.227"), (1234.5, "1234.5"), (360000.0, "360000")])
def test_numbers_for_people(value: float, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (2.6e-5, "0.0026 %"),
        (2.032e-5, "0.0021 %"),
        (9.91e-5, "0.01 %"),
        (1e-5, "0.001 %"),
        (3e-5, "0.003 %"),
        (1.1e-3, "0.11 %"),
        (0.5, "50 %"),
        (0.0, "0.001 %"),
        (-1e-9, "0.001 %"),
    ],
)
def test_a_bound_in_percent_is_never_rounded_below_itself(share: float, text: str) -> None:
    assert format_percent_above(share) == text
    assert 1e-2 * float(text.removesuffix(" %")) >= share * (1.0 - 1e-9)


def test_the_certified_gap_is_said_without_an_exponent() -> None:
    s = msgspec.structs.replace(figures(decision(0)), methods={"frozen": 3}, largest_gap=2.6e-5)
    assert "3 frozen" in shown(s) and "0.0026 %" in shown(s)
    assert msgspec.json.decode(msgspec.json.encode(s))["largest_gap"] == 2.6e-5
