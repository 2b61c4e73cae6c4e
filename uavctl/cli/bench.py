"""Command `uavctl bench`: the duration of a decision beside the problem as printed, or with --loop the control loop."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Annotated

import msgspec
from cyclopts import Parameter, validators
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from uavctl.cli.common import DEFAULTS, SEED, SPAN_S, Common, locate_design_errors, make_progress, make_table
from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.lab.bench.loop import LoopBench, LoopRun, run_loop_bench
from uavctl.lab.bench.run import DEFAULT_SIZES, DecisionBench, ReportProgress, run_bench, time_decisions, time_flight
from uavctl.lab.bench.timing import BenchResult, ConditionedTimes
from uavctl.smpc.conditioned.planner import ConditionedSolver
from uavctl.wiring.controller import build_conditioned, build_design, build_spec


def report_loop(common: Common, seconds: float, runs: int) -> int:
    """Measure the control loop and show the result."""
    options = ["--config", common.config]
    for override in common.overrides:
        options += ["--set", override]
    with make_progress(auto_refresh=False) as progress:
        task = progress.add_task("")

        def report(stage: str, done: int, total: int) -> None:
            progress.update(task, description=stage, completed=done, total=total, refresh=True)

        result = run_loop_bench(common.load().config, options, seconds, runs, report)
    common.show("bench/loop", result, lambda: render_loop(result))
    return 0


def render_loop(result: LoopBench) -> RenderableType:
    """Return the figures of the control loop as a table."""
    table = make_table("Control loop on real UDP, recording", ("", "median", "p99", "p99.9", "largest"), ())
    for name, run in (("without --realtime", result.plain), ("with --realtime", result.realtime)):
        table.add_row(Text(name, style="bold"))
        for label, spread in (
            ("position in -> setpoint out", run.in_to_out_us),
            ("tick late by", run.lateness_us),
            ("tick of an empty loop late by", run.empty_lateness_us),
            ("in the control core", run.step_us),
        ):
            table.add_row(f"  {label}", *(f"{value / 1e3:.3f} ms" for value in msgspec.structs.astuple(spread)))
    head = (
        f"Median of {result.runs} runs of {result.seconds:g} s each, a position in every tick of {result.tick_s:g} s."
    )
    denied = () if result.permitted else ("Not all of --realtime was permitted; `uavctl fly --realtime` says what.",)
    return Group(
        head,
        "",
        table,
        _describe_run("without --realtime", result.plain),
        _describe_run("with --realtime", result.realtime),
        *denied,
    )


def _describe_run(name: str, run: LoopRun) -> str:
    return (
        f"{name}: {run.positions:.0f} positions, {run.unanswered:.0f} without a setpoint in their tick, "
        f"{run.missed_ticks:.0f} ticks missed; {run.recorded:.0f} records, {run.dropped:.0f} dropped; "
        f"{run.memory_mib:.0f} MiB, grown by {run.memory_growth_kib:.0f} KiB."
    )


_REFRESH_PERIOD_S = 0.2


def bench(
    *,
    states: Annotated[
        int,
        Parameter(
            help="number of states; the slow methods answer the first of them",
            validator=validators.Number(gte=1, lte=100_000),
        ),
    ] = DEFAULT_SIZES.states,
    seed: Annotated[int, Parameter(help="seed of the states", validator=SEED)] = 0,
    loop: Annotated[
        bool, Parameter(negative=(), help="measure the whole control loop on real UDP instead, beside an empty one")
    ] = False,
    seconds: Annotated[float, Parameter(help="with --loop: length of a run [s]", validator=SPAN_S)] = 60.0,
    runs: Annotated[
        int,
        Parameter(
            help="with --loop: runs without --realtime, and as many with it",
            validator=validators.Number(gte=1, lte=1000),
        ),
    ] = 5,
    common: Common = DEFAULTS,
) -> int:
    """Measure the speed of a decision on this machine; of hahn-stursberg beside the problem as printed, in one run."""
    if loop:
        return report_loop(common, seconds, runs)
    loaded = common.load()
    if loaded.config.is_age_conditioned:
        with locate_design_errors(loaded):
            solver = build_conditioned(loaded.config).solver
        with _show_progress() as advance:
            advance("a flight's own decisions", 0, None)
            flight = time_flight(loaded.config, lambda done, total: advance("a flight's own decisions", done, total))
            decisions = time_decisions(solver, states, seed, lambda done: advance("decisions", done, states))
        decisions = msgspec.structs.replace(decisions, flight=flight)
        common.show("bench/decisions", decisions, lambda: _describe_decisions(decisions, loaded.config.name))
        return 0
    with locate_design_errors(loaded):
        design = build_design(loaded.config)
        loss = build_spec(loaded.config).link.outage(1)
        with _show_progress() as advance:
            sizes = replace(DEFAULT_SIZES, states=states)
            result = run_bench(design, loss, seed, advance, sizes, _build_conditioned_solver(loaded.config))
    common.show("bench", result, lambda: render_bench(result, loaded.config.name))
    return 0


def _build_conditioned_solver(config: Config) -> ConditionedSolver | None:
    """Make the solver of scheme `age-conditioned`; None where silence outlasts the horizon too often for it."""
    try:
        return build_conditioned(config).solver
    except DesignError:
        return None


def _describe_decisions(result: DecisionBench, name: str) -> str:
    """Return the figures of scheme `age-conditioned` as text."""
    us, iterations, flight = result.us, result.iterations, result.flight
    flight_text = (
        ""
        if flight is None
        else (
            f"\n{flight.questions} of its own flight: median {_format_us(flight.us.p50)}, p99 "
            f"{_format_us(flight.us.p99)}, at most "
            f"{_format_us(flight.us.max)}, the first one {_format_us(flight.first_us)}; iterations "
            f"{flight.iterations.p50:.0f}, p99 "
            f"{flight.iterations.p99:.0f}, at most {flight.iterations.max:.0f}. {flight.left_alone:.1%} need no "
            f"program, {flight.gave_way:.1%} give way."
        )
    )
    return (
        f"{name}, risk conditioned on the age: one decision for all axes, {result.states} states and targets anywhere "
        f"within the limits.\nMedian {_format_us(us.p50)}, p99 {_format_us(us.p99)}, at most {_format_us(us.max)}; "
        f"iterations "
        f"{iterations.p50:.0f}, p99 {iterations.p99:.0f}, at most {iterations.max:.0f}.\n"
        f"{result.left_alone:.1%} need no program, {result.gave_way:.1%} give way, {result.without} got no "
        f"plan.{flight_text}"
    )


@contextmanager
def _show_progress() -> Iterator[ReportProgress]:
    # A thread that draws the bar would disturb the measurement.
    with make_progress(auto_refresh=False) as progress:
        task = progress.add_task("design", total=None)
        drawn_s = 0.0

        def advance(stage: str, done: int, total: int | None) -> None:
            nonlocal drawn_s
            now_s = time.monotonic()
            if done and done != total and now_s - drawn_s < _REFRESH_PERIOD_S:
                return
            drawn_s = now_s
            progress.update(task, description=stage, completed=done, total=total, refresh=True)

        yield advance


def render_bench(result: BenchResult, name: str) -> RenderableType:
    """Return the figures as tables."""
    axes = "1 independent axis" if result.components == 1 else f"{result.components} independent axes"
    head = (
        f"{name}: {axes}; {result.states} states, half uniform over the feasible {result.feasible_share:.0%} of the "
        "box, half along closed loops"
    )
    methods = (_make_method_table(result), _describe_conditioned(result.conditioned), _describe_axis(result))
    return Group(head, "", *methods, _make_certificate_table(result), _describe_gaps(result))


def _make_method_table(result: BenchResult) -> Table:
    printed_outcome = f"{result.printed_status} ({result.printed_optimal} of {result.printed_states} optimal)"
    cost_agreement = "" if result.cost_difference is None else f"cost of the exact one to {result.cost_difference:.1e}"
    flown = result.flown_us
    rows = (
        (
            "as printed, jointly, CVXPY",
            result.printed_states,
            result.printed_ms,
            f"{result.ratio_printed:.0f} ×",
            printed_outcome,
        ),
        (
            "as printed, axis by axis, CVXPY",
            result.cvxpy_states,
            result.cvxpy_ms,
            f"{result.ratio_cvxpy:.0f} ×",
            cost_agreement,
        ),
        ("exact program alone", result.exact_states, result.exact_ms, "", ""),
        (
            "as flown",
            result.states,
            flown.p50 / 1e3,
            "",
            f"p99 {_format_us(flown.p99)}, at most {_format_us(flown.max)}",
        ),
    )
    cells = [
        (label, str(states), _format_ms(duration_ms), ratio, outcome)
        for label, states, duration_ms, ratio, outcome in rows
    ]
    headings = ("", "states", "median", "to the exact program", "what came of it")
    return make_table("One decision for all axes", headings, cells, (headings[0], headings[-1]))


def _describe_conditioned(times: ConditionedTimes | None) -> str:
    if times is None:
        return ""
    return (
        f"Risk conditioned on the age, a scheme of its own: {_format_us(times.us.p50)}, p99 "
        f"{_format_us(times.us.p99)}, at most "
        f"{_format_us(times.us.max)} and {times.iterations.max:.0f} iterations; {times.left_alone:.0%} of the states "
        f"need no "
        f"program. The printed problem, axis by axis, takes {times.ratio_cvxpy:.0f} × as long.\n"
    )


def _describe_axis(result: BenchResult) -> str:
    return f"One axis: exact {_format_ms(result.exact_axis_ms)}, as printed {_format_ms(result.cvxpy_axis_ms)}.\n"


def _make_certificate_table(result: BenchResult) -> Table:
    shares = result.shares
    rows = (
        ("frozen policies alone", f"{shares.frozen:.1%}", _format_us(result.frozen_us)),
        ("exact program", f"{shares.exact:.1%}", _format_us(result.program_us)),
    )
    return make_table("Answers as flown", ("method", "share", "median"), rows)


def _describe_gaps(result: BenchResult) -> str:
    gap = result.gap
    return (
        f"Certified gap: median {gap.p50:.1e}, p99 {gap.p99:.1e}, at most {gap.max:.1e}; "
        f"exact optima outside the certified bounds by at most {result.certificate_excess:.0e}. "
        f"The solver was ready in {result.ready_s:.2f} s."
    )


def _format_ms(milliseconds: float) -> str:
    return f"{milliseconds:.3g} ms" if milliseconds < 999.5 else f"{milliseconds / 1e3:.3g} s"


def _format_us(microseconds: float | None) -> str:
    return "-" if microseconds is None else f"{microseconds:.0f} µs"
