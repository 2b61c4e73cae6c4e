"""Command `uavctl bench`: how long one decision and one tick take on this machine, or how a link behaves."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter, validators
from rich.console import Group, RenderableType

from uavctl.cli.bench_link import bench_link
from uavctl.cli.common import DEFAULTS, SPAN_S, Common, locate_design_errors, make_progress
from uavctl.cli.output import make_table
from uavctl.errors import UavctlError
from uavctl.lab.bench.decision import DecisionBench, time_decision
from uavctl.lab.bench.tick import TickBench, time_tick

_RATE_HZ = validators.Number(gte=1, lte=1000)


class Bench(msgspec.Struct, frozen=True, kw_only=True):
    """One run of `uavctl bench`."""

    config: str
    decision: DecisionBench
    tick: TickBench


def bench(
    *,
    seconds: Annotated[
        float, Parameter(help="length of the flight that times ticks, or of --link [s]", validator=SPAN_S)
    ] = 20.0,
    link: Annotated[
        str | None,
        Parameter(help="measure the link to udpout://HOST:PORT, where udpin://0.0.0.0:PORT answers, in place of speed"),
    ] = None,
    rate: Annotated[float, Parameter(help="with --link: packets a second", validator=_RATE_HZ)] = 100.0,
    out: Annotated[Path, Parameter(help="with --link: folder of configurations and traces")] = Path("link"),
    last: Annotated[
        Path | None, Parameter(help="compare with an earlier run: a file that `uavctl bench --json` wrote")
    ] = None,
    common: Common = DEFAULTS,
) -> int:
    """Measure how long one decision and one tick take on this machine, beside the printed problem and the last run.

    With --link it measures losses and delays between two computers instead, and writes them as configurations.
    """
    if link is not None:
        return bench_link(link, seconds, rate, out, common)
    loaded = common.load()
    before = None if last is None else read_bench(last, loaded.config.name)
    options = ["--config", common.config]
    for override in common.overrides:
        options += ["--set", override]
    with make_progress(auto_refresh=False) as progress:  # a thread that draws would disturb the measurement
        task = progress.add_task("decisions", total=2)
        progress.refresh()
        with locate_design_errors(loaded):
            decision = time_decision(loaded.config)
        progress.update(task, description="ticks", completed=1, refresh=True)
        tick = time_tick(options, seconds)
    result = Bench(config=loaded.config.name, decision=decision, tick=tick)
    common.show("bench", result, lambda: render_bench(result, before))
    return 0


def read_bench(path: Path, config_name: str) -> Bench:
    """Read the document of an earlier run of the same configuration.

    Raises:
        UavctlError: The file cannot be read, or holds another document, or a run of another configuration.
    """
    try:
        before = msgspec.json.decode(path.read_bytes(), type=Bench)
    except (OSError, msgspec.MsgspecError) as error:
        raise UavctlError(f"{path} holds no run of a bench: {error}; write one by `uavctl bench --json`") from error
    if before.config != config_name:
        raise UavctlError(
            f"{path} is a run of {before.config}, not of {config_name}; give one of the same configuration"
        )
    return before


def render_bench(result: Bench, before: Bench | None = None) -> RenderableType:
    """Return the figures as a table, beside those of an earlier run if there is one."""
    rows = list(_list_times(result))
    headings = ["", "median", "99 %", "largest"]
    cells = [[name, *map(_format_us, times)] for name, times in rows]
    if before is not None:
        headings += ["last median", "now / last"]
        for row, (_, times), (_, last_times) in zip(cells, rows, _list_times(before), strict=False):
            row += [_format_us(last_times[0]), f"{times[0] / last_times[0]:.2f}"]
    tick, decision = result.tick, result.decision
    counts = (
        f"{decision.questions} decisions of a flight in virtual time. {tick.ticks} ticks of a flight in real time on "
        f"UDP: {tick.missed_ticks} missed, {tick.dropped} records lost."
    )
    return Group(make_table(result.config, headings, cells), counts, *_describe_printed(decision))


def _list_times(result: Bench) -> Iterator[tuple[str, tuple[float, float, float]]]:
    for name, us in (
        ("one decision", result.decision.us),
        ("one tick, from its time to its setpoint", result.tick.sent_us),
        ("  of it before the tick began", result.tick.lateness_us),
        ("  of it in the control core", result.tick.step_us),
    ):
        yield name, (us.p50, us.p99, us.max)


def _describe_printed(decision: DecisionBench) -> Iterator[str]:
    if decision.printed_us is not None:
        yield (
            f"The problem as printed takes {_format_us(decision.printed_us)} a decision: "
            f"{decision.printed_us / decision.us.p50:.0f} times as long."
        )


def _format_us(us: float) -> str:
    return f"{us / 1e6:.3g} s" if us >= 1e6 else f"{us / 1e3:.3g} ms" if us >= 1e3 else f"{us:.0f} µs"
