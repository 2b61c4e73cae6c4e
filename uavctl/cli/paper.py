"""Command `uavctl paper`: Section 5 of the paper reproduced, with each claim beside its measurement."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from cyclopts import Parameter, validators
from rich.console import Group, RenderableType
from rich.progress import MofNCompleteColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from uavctl.cli.common import SEED, WORKERS, Common, QuietJson, locate_design_errors, make_progress
from uavctl.cli.output import make_message_console, make_table
from uavctl.errors import UsageError
from uavctl.lab.paper.claims import (
    PRESET,
    PRINTED,
    VARIANTS,
    Claim,
    Complexity,
    Depth,
    TriedDesign,
    Variant,
    VariantResult,
    assess,
    make_depth_claims,
)
from uavctl.lab.paper.runs import MAX_LOCAL_RUNS, Flights, ReportProgress, Setup, fly_all
from uavctl.number_text import format_percent_above
from uavctl.wiring.controller import build_design, build_spec

_RUN_LIMITS = validators.Number(gte=1, lte=1_000_000)
# Above this number a second design would take minutes more for the same answer.
MAX_RUNS_OF_BOTH = 20_000


def paper(
    *,
    runs: Annotated[int, Parameter(help="number of runs", validator=_RUN_LIMITS)] = 200,
    steps: Annotated[int, Parameter(help="steps of a run", validator=validators.Number(gte=4, lte=10_000))] = 50,
    seed: Annotated[int, Parameter(help="seed of every random draw", validator=SEED)] = 0,
    tau: Annotated[
        Literal[4, 3] | None,
        Parameter(
            help=f"one design only: 4 as printed, or 3; else both, and the printed one above {MAX_RUNS_OF_BOTH} runs",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, Parameter(help="folder of the figures")] = Path("flights/paper"),
    workers: Annotated[
        int | None,
        Parameter(
            help=f"processes for more than {MAX_LOCAL_RUNS} runs; all cores by default. They change no figure",
            validator=WORKERS,
            show_default=False,
        ),
    ] = None,
    full: Annotated[
        bool,
        Parameter(
            negative=(),
            show_default=False,
            help="also which schedules make a design, complexity over τ, and the least cost within the input limits",
        ),
    ] = False,
    json: QuietJson = False,
) -> int:
    """Fly Section 5 of the paper, draw its figures, and compare every claim with its measured figure."""
    begin_s = time.perf_counter()
    _make_folder(out)
    chosen_tau = PRINTED.tau if tau is None and runs > MAX_RUNS_OF_BOTH else tau
    chosen = [variant for variant in VARIANTS if chosen_tau in (None, variant.tau)]
    setups = [_make_setup(variant) for variant in chosen]
    with _show_progress(runs * len(chosen), shown=runs > MAX_LOCAL_RUNS) as advance:
        flights = fly_all(setups, runs, steps, seed, workers or os.cpu_count() or 1, advance)
    results = [
        assess(setup, variant.note, flown, seed) for setup, variant, flown in zip(setups, chosen, flights, strict=True)
    ]
    depth = _measure_depth(seed) if full else None
    figures = _draw_figures(out, setups, flights)
    claims = [*results[0].claims, *(make_depth_claims(depth, results[0].settled_cost) if depth else [])]
    document = {
        **msgspec.to_builtins(results[0]),
        "claims": msgspec.to_builtins(claims),
        "variants": msgspec.to_builtins(results),
        "depth": None if depth is None else msgspec.to_builtins(depth),
        "figures": [str(path) for path in figures],
        "wall_s": time.perf_counter() - begin_s,
    }
    Common(json=json).show("paper", document, lambda: render_paper(results, claims, depth, figures))
    return 0 if all(result.decisions and not result.infeasible and not result.failed for result in results) else 1


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--out: {out} cannot be made ({error.strerror}); name another folder") from error


def _make_setup(variant: Variant) -> Setup:
    """Return the design of a variant."""
    loaded = Common(config=PRESET, overrides=variant.overrides).load()
    with locate_design_errors(loaded):
        return Setup(loaded.config, build_design(loaded.config))


@contextmanager
def _show_progress(total: int, *, shown: bool) -> Iterator[ReportProgress]:
    if not shown:
        yield lambda _: None
        return
    with make_progress(MofNCompleteColumn(), TimeRemainingColumn()) as progress:
        task = progress.add_task("runs", total=total)
        yield lambda done: progress.update(task, advance=done)


def _measure_depth(seed: int) -> Depth:
    from uavctl.lab.paper.depth import measure_depth  # the printed problem's CVXPY takes time to import

    with make_message_console().status("measuring") as status:
        return measure_depth(seed, status.update)


def _draw_figures(out: Path, setups: list[Setup], flights: list[Flights]) -> list[Path]:
    """Draw Fig. 3 of every design, and Fig. 4 once: all designs have the same link."""
    # Loads matplotlib, so only after the flights.
    from uavctl.lab.paper.figures import AgeReference, draw_ages_svg, draw_trajectories_svg

    figures = {}
    for setup, flown in zip(setups, flights, strict=True):
        figures[f"paper-runs-tau{setup.design.terminal.tau}.svg"] = draw_trajectories_svg(flown.drawn, setup.design)
    first = setups[0]
    link = AgeReference(first.design.terminal.tau, first.design.horizon, build_spec(first.config).link.outage(1))
    figures["paper-ages.svg"] = draw_ages_svg(flights[0].totals.ages, link)
    for name, svg in figures.items():
        (out / name).write_text(svg, encoding="utf-8")
    return [out / name for name in figures]


def render_paper(
    results: list[VariantResult], claims: list[Claim], depth: Depth | None, figures: list[Path]
) -> RenderableType:
    """Return the claims beside each design's result.

    Args:
        results: Result of each design.
        claims: Claims of the first design, and those of the measured depth.
        depth: Measured depth; None without --full.
        figures: Paths of the figures.
    """
    first = results[0]
    title = f"Section 5 of the paper: {first.runs:,} runs of {first.steps} steps, seed {first.seed}"
    headings = ("claim", "paper", *(f"τ = {result.tau}" for result in results))
    other_claims = [{claim.key: claim for claim in result.claims} for result in results[1:]]
    table = make_table(title, headings, (), headings, lines=True)
    for claim in claims:
        table.add_row(
            claim.claim,
            claim.paper,
            _format_cell(claim),
            *(_format_cell(column_claims.get(claim.key)) for column_claims in other_claims),
        )
    depth_tables = (
        [] if depth is None else [_make_design_table(depth.designs), _make_complexity_table(depth.complexity)]
    )
    lines = [Text(f"{_describe_costs(result)}\n{result.note}.") for result in results]
    return Group(table, *lines, *depth_tables, Text(f"Figures: {', '.join(map(str, figures))}"))


def _format_cell(claim: Claim | None) -> Text:
    if claim is None:
        return Text("")
    prefix, style = {True: ("yes: ", "green"), False: ("no: ", "red"), None: ("", "")}[claim.holds]
    return Text.assemble((prefix, style), claim.measured)


def _describe_costs(result: VariantResult) -> str:
    spread = ", ".join(f"{std:.2f}" for std in result.settled_std)
    return (
        f"τ = {result.tau}: summed cost {result.mean_cost:.0f} ± {result.cost_stderr:.0f} (standard error), settled "
        f"standard deviations {spread}, largest certified gap {format_percent_above(result.largest_gap)} of the cost"
    )


def _make_design_table(tried: list[TriedDesign]) -> Table:
    headings = ("τ", "schedule", "delays", "γ^x_H", "cost at start", "refused")
    rows = (
        (
            str(design.tau),
            design.schedule,
            "" if design.delays is None else " ".join(map(str, design.delays)),
            "" if design.gamma_h is None else f"{design.gamma_h:.4f}",
            "" if design.refused else "not reached" if design.cost is None else f"{design.cost:.0f}",
            Text(design.refused),
        )
        for design in tried
    )
    return make_table("Schedules and their designs", headings, rows, headings)


def _make_complexity_table(sizes: list[Complexity]) -> Table:
    headings = ("τ", "H", "terminal states", "gains", "as printed", "exact", "refused")
    table = make_table("One decision of one axis over τ, medians", headings, (), ("refused",))
    for size in sizes:
        times = (
            "" if size.printed_ms is None else f"{size.printed_ms:.0f} ms",
            "" if size.exact_ms is None else f"{size.exact_ms:.1f} ms",
        )
        table.add_row(str(size.tau), str(size.horizon), str(size.lifted), str(size.gains), *times, Text(size.refused))
    return table
