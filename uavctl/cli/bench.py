"""Command `uavctl bench`."""

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

from uavctl.build.controller import build_conditioned, build_design, build_spec
from uavctl.cli.common import DEFAULTS, SEED, SPAN_S, Common, bars, columns, located
from uavctl.config.types import Config
from uavctl.errors import DesignError
from uavctl.lab.bench.loop import LoopBench, LoopRun, run_loop_bench
from uavctl.lab.bench.run import DEFAULT_SIZES, DecisionBench, ReportProgress, run_bench, time_decisions, time_flight
from uavctl.lab.bench.timing import BenchResult, ConditionedTimes
from uavctl.smpc.conditioned.planner import ConditionedSolver

# `uavctl bench --loop`: the control loop on real UDP beside an empty one.


def bench_loop(common: Common, seconds: float, runs: int) -> int:
    """Measure the control loop and show the result."""
    options = ["--config", common.config]
    for override in common.overrides:
        options += ["--set", override]
    with bars(auto_refresh=False) as progress:
        task = progress.add_task("")

        def told(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total, refresh=True)

        result = run_loop_bench(common.load().config, options, seconds, runs, told)
    common.show("bench/loop", result, lambda: loop_picture(result))
    return 0


def loop_picture(result: LoopBench) -> RenderableType:
    """Return the figures of the control loop as a table."""
    table = columns("Control loop on real UDP, recording", ("", "median", "p99", "p99.9", "largest"), ())
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
        head, "", table, _rest("without --realtime", result.plain), _rest("with --realtime", result.realtime), *denied
    )


def _rest(name: str, run: LoopRun) -> str:
    return (
        f"{name}: {run.positions:.0f} positions, {run.unanswered:.0f} without a setpoint in their tick, "
        f"{run.missed_ticks:.0f} ticks missed; {run.recorded:.0f} records, {run.dropped:.0f} dropped; "
        f"{run.memory_mib:.0f} MiB, grown by {run.memory_growth_kib:.0f} KiB."
    )


# `uavctl bench`: how long a decision takes, beside the problem as printed.


_REFRESH_S = 0.2


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
        return bench_loop(common, seconds, runs)
    loaded = common.load()
    if loaded.config.is_age_conditioned:
        with located(loaded):
            solver = build_conditioned(loaded.config).solver
        with _progress() as advance:
            advance("a flight's own decisions", 0, None)
            flight = time_flight(loaded.config, lambda done, total: advance("a flight's own decisions", done, total))
            decided = time_decisions(solver, states, seed, lambda done: advance("decisions", done, states))
        decided = msgspec.structs.replace(decided, flight=flight)
        common.show("bench/decisions", decided, lambda: _decisions(decided, loaded.config.name))
        return 0
    with located(loaded):
        design = build_design(loaded.config)
        loss = build_spec(loaded.config).link.outage(1)
        with _progress() as advance:
            sizes = replace(DEFAULT_SIZES, states=states)
            result = run_bench(design, loss, seed, advance, sizes, _conditioned_solver(loaded.config))
    common.show("bench", result, lambda: bench_picture(result, loaded.config.name))
    return 0


def _conditioned_solver(config: Config) -> ConditionedSolver | None:
    """Make the solver of scheme `age-conditioned`; None where silence outlasts the horizon too often for it."""
    try:
        return build_conditioned(config).solver
    except DesignError:
        return None


def _decisions(found: DecisionBench, name: str) -> str:
    """Return the figures of scheme `age-conditioned` in words."""
    us, iterations, flight = found.us, found.iterations, found.flight
    flown = (
        ""
        if flight is None
        else (
            f"\n{flight.questions} of its own flight: median {_us(flight.us.p50)}, p99 {_us(flight.us.p99)}, at most "
            f"{_us(flight.us.max)}, the first one {_us(flight.first_us)}; iterations {flight.iterations.p50:.0f}, p99 "
            f"{flight.iterations.p99:.0f}, at most {flight.iterations.max:.0f}. {flight.left_alone:.1%} need no "
            f"program, {flight.gave_way:.1%} give way."
        )
    )
    return (
        f"{name}, risk conditioned on the age: one decision for all axes, {found.states} states and targets anywhere "
        f"within the limits.\nMedian {_us(us.p50)}, p99 {_us(us.p99)}, at most {_us(us.max)}; iterations "
        f"{iterations.p50:.0f}, p99 {iterations.p99:.0f}, at most {iterations.max:.0f}.\n"
        f"{found.left_alone:.1%} need no program, {found.gave_way:.1%} give way, {found.without} got no plan.{flown}"
    )


@contextmanager
def _progress() -> Iterator[ReportProgress]:
    # A thread that draws the bar would disturb what is measured.
    with bars(auto_refresh=False) as progress:
        task = progress.add_task("design", total=None)
        drawn = 0.0

        def advance(what: str, done: int, total: int | None) -> None:
            nonlocal drawn
            now = time.monotonic()
            if done and done != total and now - drawn < _REFRESH_S:
                return
            drawn = now
            progress.update(task, description=what, completed=done, total=total, refresh=True)

        yield advance


def bench_picture(result: BenchResult, name: str) -> RenderableType:
    """Return the figures as tables."""
    axes = "1 independent axis" if result.components == 1 else f"{result.components} independent axes"
    head = (
        f"{name}: {axes}; {result.states} states, half uniform over the feasible {result.feasible_share:.0%} of the "
        "box, half along closed loops"
    )
    methods = (_methods(result), _conditioned(result.conditioned), _axis(result))
    return Group(head, "", *methods, _certificates(result), _gaps(result))


def _methods(result: BenchResult) -> Table:
    joint = f"{result.printed_status} ({result.printed_optimal} of {result.printed_states} optimal)"
    same = "" if result.cost_difference is None else f"cost of the exact one to {result.cost_difference:.1e}"
    flown = result.flown_us
    rows = (
        (
            "as printed, jointly, CVXPY",
            result.printed_states,
            result.printed_ms,
            f"{result.ratio_printed:.0f} ×",
            joint,
        ),
        ("as printed, axis by axis, CVXPY", result.cvxpy_states, result.cvxpy_ms, f"{result.ratio_cvxpy:.0f} ×", same),
        ("exact program alone", result.exact_states, result.exact_ms, "", ""),
        ("as flown", result.states, flown.p50 / 1e3, "", f"p99 {_us(flown.p99)}, at most {_us(flown.max)}"),
    )
    told = [(label, str(states), _ms(took), ratio, ending) for label, states, took, ratio, ending in rows]
    headings = ("", "states", "median", "to the exact program", "what came of it")
    return columns("One decision for all axes", headings, told, (headings[0], headings[-1]))


def _conditioned(ours: ConditionedTimes | None) -> str:
    if ours is None:
        return ""
    return (
        f"Risk conditioned on the age, a scheme of its own: {_us(ours.us.p50)}, p99 {_us(ours.us.p99)}, at most "
        f"{_us(ours.us.max)} and {ours.iterations.max:.0f} iterations; {ours.left_alone:.0%} of the states need no "
        f"program. The printed problem, axis by axis, takes {ours.ratio_cvxpy:.0f} × as long.\n"
    )


def _axis(result: BenchResult) -> str:
    return f"One axis: exact {_ms(result.exact_axis_ms)}, as printed {_ms(result.cvxpy_axis_ms)}.\n"


def _certificates(result: BenchResult) -> Table:
    shares = result.shares
    rows = (
        ("frozen policies alone", f"{shares.frozen:.1%}", _us(result.frozen_us)),
        ("exact program", f"{shares.exact:.1%}", _us(result.program_us)),
    )
    return columns("Answers as flown", ("method", "share", "median"), rows)


def _gaps(result: BenchResult) -> str:
    gap = result.gap
    return (
        f"Certified gap: median {gap.p50:.1e}, p99 {gap.p99:.1e}, at most {gap.max:.1e}; "
        f"exact optima outside the certified bounds by at most {result.certificate_excess:.0e}. "
        f"The solver was ready in {result.ready_s:.2f} s."
    )


def _ms(milliseconds: float) -> str:
    return f"{milliseconds:.3g} ms" if milliseconds < 999.5 else f"{milliseconds / 1e3:.3g} s"


def _us(microseconds: float | None) -> str:
    return "-" if microseconds is None else f"{microseconds:.0f} µs"
