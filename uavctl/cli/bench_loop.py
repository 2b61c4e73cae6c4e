"""`uavctl bench --loop`: the control loop on real UDP beside an empty one."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from uavctl.bench.loop import run_loop_bench
from uavctl.bench.loop_result import LoopBench, LoopRun, Spread
from uavctl.cli.common import Common, messages


def bench_loop(common: Common, seconds: float, runs: int) -> int:
    """Measure and show."""
    options = ["--config", common.config]
    for override in common.overrides:
        options += ["--set", override]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=messages(), transient=True, auto_refresh=False) as progress:
        task = progress.add_task("")

        def told(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total, refresh=True)

        result = run_loop_bench(common.load().config, options, seconds, runs, told)
    common.show(result, lambda: loop_picture(result))
    return 0


def loop_picture(result: LoopBench) -> RenderableType:
    """The figures as a table."""
    table = Table(title="Control loop on real UDP, recording", title_justify="left")
    for heading in ("", "median", "p99", "p99.9", "largest"):
        table.add_column(heading, justify="right" if heading else "left")
    for name, run in (("without --realtime", result.plain), ("with --realtime", result.realtime)):
        table.add_row(f"[bold]{name}")
        for label, spread in _spreads(run):
            table.add_row(f"  {label}", *(f"{value / 1e3:.3f} ms" for value in _values(spread)))
    head = (
        f"Median of {result.runs} runs of {result.seconds:g} s each, a position in every tick of {result.tick_s:g} s."
    )
    denied = () if result.permitted else ("Not all of --realtime was permitted; `uavctl fly --realtime` says what.",)
    return Group(
        head, "", table, _rest("without --realtime", result.plain), _rest("with --realtime", result.realtime), *denied
    )


def _spreads(run: LoopRun) -> tuple[tuple[str, Spread], ...]:
    return (
        ("position in -> setpoint out", run.in_to_out_us),
        ("tick late by", run.lateness_us),
        ("tick of an empty loop late by", run.empty_lateness_us),
        ("in the control core", run.step_us),
    )


def _values(spread: Spread) -> tuple[float, float, float, float]:
    return spread.p50, spread.p99, spread.p999, spread.max


def _rest(name: str, run: LoopRun) -> str:
    return (
        f"{name}: {run.positions:.0f} positions, {run.unanswered:.0f} without a setpoint in their tick, "
        f"{run.missed_ticks:.0f} ticks missed; {run.recorded:.0f} records, {run.dropped:.0f} dropped; "
        f"{run.memory_mib:.0f} MiB, grown by {run.memory_growth_kib:.0f} KiB."
    )
