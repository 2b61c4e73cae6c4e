"""`uavctl design --synthesize` and `--compare-risk`: designs beside one another."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
from rich.console import Group, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from uavctl.build import build_spec, start_state
from uavctl.cli.common import Common, located, messages
from uavctl.compare import (
    RISK_OPTIONS,
    Costs,
    GainComparison,
    GainReport,
    RiskComparison,
    compare_gains,
    compare_risk,
)

SEED = 0


def synthesize(common: Common, states: int) -> int:
    """Synthesise the terminal gain and compare; 1 if no complete design can be made with it."""
    loaded = common.load()
    begin = time.perf_counter()
    with located(loaded):
        spec = build_spec(loaded.config)
        with _progress(2 + 4 * states) as advance:
            found = compare_gains(spec, start_state(loaded.config, spec.plant), states, SEED, advance)
    document = {**msgspec.to_builtins(found), "k_tau": found.after.k_tau, "wall_s": time.perf_counter() - begin}
    common.show(document, lambda: _gains_picture(found, loaded.config.name))
    return 0 if found.after.refused is None else 1


def risk(common: Common, states: int) -> int:
    """Compare the risk allocations."""
    loaded = common.load()
    begin = time.perf_counter()
    with located(loaded):
        spec = build_spec(loaded.config)
        with _progress(1 + 2 * len(RISK_OPTIONS) * states) as advance:
            found = compare_risk(spec, start_state(loaded.config, spec.plant), states, SEED, advance)
    document = {**msgspec.to_builtins(found), "wall_s": time.perf_counter() - begin}
    common.show(document, lambda: _risk_picture(found, loaded.config.name))
    return 0


@contextmanager
def _progress(steps: int) -> Iterator[Callable[[str], None]]:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=messages(), transient=True) as progress:
        task = progress.add_task("designs", total=steps)

        def advance(what: str) -> None:
            progress.update(task, advance=1, description=what)

        yield advance


def _gains_picture(found: GainComparison, name: str) -> RenderableType:
    table = Table(title=f"Terminal gain of {name}", title_justify="left")
    for heading in ("", "configured", "synthesised"):
        table.add_column(heading, justify="right" if heading else "left")
    for label, figure in _GAIN_ROWS:
        table.add_row(label, figure(found.before), figure(found.after))
    refusals = [
        Text(f"No complete design with the {which} gain: {report.refused}")
        for which, report in (("configured", found.before), ("synthesised", found.after))
        if report.refused is not None
    ]
    return Group(table, *refusals, _basis(found), "To take the synthesised gain over:", "", Text(found.toml))


def _risk_picture(found: RiskComparison, name: str) -> RenderableType:
    table = Table(title=f"Risk allocation, {name}", title_justify="left")
    for heading in (
        "allocation", "κ_x last stage", "κ_u", "terminal back-off x", "back-off u", "cost at start", "mean cost",
        "of the box",
    ):  # fmt: skip
        table.add_column(heading, justify="left" if heading == "allocation" else "right")
    refusals = []
    for each in found.allocations:
        if each.costs is None or each.kappa_x_terminal is None or each.kappa_u_terminal is None:
            refusals.append(Text(f"No design with {each.allocation}: {each.refused}"))
            continue
        table.add_row(
            each.allocation,
            f"{each.kappa_x_terminal:.3f}",
            f"{each.kappa_u_terminal:.3f}",
            _several(each.terminal_backoff_x),
            _several(each.terminal_backoff_u),
            _cost(each.costs.start),
            _cost(each.costs.mean),
            f"{each.costs.feasible:.1%}",
        )
    return Group(table, *refusals, _basis(found))


def _basis(found: GainComparison | RiskComparison) -> str:
    return (
        "Infeasible: the target is not reached within the horizon with all constraints kept; a flight goes there by "
        "way of nearer equilibria, or gives way where the limits are soft.\n"
        f"Means over {found.compared} states on the way to the target, feasible for every design; shares of "
        f"{found.states} states uniform in the box of the limits."
    )


def _several(values: list[float]) -> str:
    """Different values, in their order; the two sides of a box have the same."""
    return " ".join(dict.fromkeys(f"{value:.3g}" for value in values))


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _cost(value: float | None) -> str:
    return "infeasible" if value is None else f"{value:.2f}"


def _cost_row(pick: Callable[[Costs], str]) -> Callable[[GainReport], str]:
    return lambda report: "-" if report.costs is None else pick(report.costs)


_GAIN_ROWS: tuple[tuple[str, Callable[[GainReport], str]], ...] = (
    ("stationary cost of a step", lambda report: _figure(report.stationary_cost)),
    ("spectral radius (4.2: below 1)", lambda report: _figure(report.spectral_radius)),
    ("state room taken (4.3: at most 1)", lambda report: _figure(report.filled_x)),
    ("input room taken (4.4: at most 1)", lambda report: _figure(report.filled_u)),
    ("margin s* of the terminal condition", lambda report: _figure(report.margin)),
    ("optimal cost from the simulator's start", _cost_row(lambda costs: _cost(costs.start))),
    ("mean optimal cost", _cost_row(lambda costs: _cost(costs.mean))),
    ("share of the box feasible", _cost_row(lambda costs: f"{costs.feasible:.1%}")),
)
