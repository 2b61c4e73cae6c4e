"""`uavctl bench`: how long a decision takes, beside the problem as printed."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter, validators
from rich.console import Group, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from uavctl.bench import BenchResult, joint_states, run_bench
from uavctl.build import build_design
from uavctl.cli.common import DEFAULTS, Common, located, messages


def bench(
    *,
    states: Annotated[int, Parameter(help="number of states", validator=validators.Number(gte=1))] = 20,
    seed: Annotated[int, Parameter(help="seed of the states", validator=validators.Number(gte=0))] = 0,
    common: Common = DEFAULTS,
) -> int:
    """Measure the speed of a decision on this machine, beside the problem as printed, in one run."""
    loaded = common.load()
    with located(loaded):
        design = build_design(loaded.config)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=messages(), transient=True) as progress:
        task = progress.add_task("states", total=2 * states + joint_states(states))

        def advance(what: str) -> None:
            progress.update(task, advance=1, description=what)

        result = run_bench(design, states, seed, advance)
    common.show(result, lambda: bench_picture(result, loaded.config.name))
    return 0


def bench_picture(result: BenchResult, name: str) -> RenderableType:
    """The medians as a table."""
    table = Table()
    table.add_column("one decision")
    table.add_column("median (ms)", justify="right")
    table.add_column("against exact", justify="right")
    table.add_column("what came of it")
    joint = f"{result.printed_status} ({result.printed_optimal} of {result.printed_states} optimal)"
    cvxpy_ms = result.cvxpy_axis_ms * result.components
    same = f"same cost to {result.cost_difference:.1e}"
    table.add_row("as printed, joint, CVXPY", f"{result.printed_ms:.1f}", f"{result.ratio_printed_exact:.1f}", joint)
    table.add_row("as printed, axis by axis, CVXPY", f"{cvxpy_ms:.1f}", f"{result.ratio_cvxpy_exact:.1f}", same)
    table.add_row("exact, all axes", f"{result.exact_ms:.2f}", "1", "optimal")
    table.add_row("exact, one axis", f"{result.exact_axis_ms:.2f}", "", "optimal")
    return Group(f"{name}: {result.states} states, {result.components} independent axes", table)
