"""Costs of one controller of a finished campaign over those of others, run by run on the same draws.

`python tools/ratios.py flights/loss age-conditioned "smpc as printed" "mean QP"`: for each link, disturbance and plant
the controller's costs of a run and settled step, how often it is outside, how many plans have slack, and its costs over
each other's, with the paired interval at 95 %.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from logs.report.run_statistics import RUNS_LEVEL, Interval, paired_difference
from uavctl.arrays import Array
from uavctl.errors import UsageError
from uavctl.lab.campaign.results import CellSummary, Results, read_results, summarise_cell
from uavctl.lab.campaign.verdicts import group_cells

COLUMNS = ("cost", "settled_cost")


def main(arguments: list[str]) -> int:
    """Print a line for each cell, and one for each other controller."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("controller")
    parser.add_argument("others", nargs="*")
    given = parser.parse_args(arguments)
    results = read_results(given.folder)
    groups = group_cells([summarise_cell(results, cell) for cell in results.cells])
    for group, cells in groups.items():
        named = {cell.controller: cell for cell in cells}
        ours = named[given.controller]
        _tell(f"{', '.join(group)}: {_figures(results, ours)}")
        for other in given.others:
            _tell(f"    {other}: {_figures(results, named[other])}{_over(results, ours, named[other])}")
    return 0


def paired_ratio(a: Array, b: Array, level: float = RUNS_LEVEL) -> tuple[float, Interval]:
    """Mean of a (N,) over the mean of b (N,), run against run on the same draws, with its interval.

    The interval is that of the mean of a - r b, with r the ratio, over the mean of b: what moves both costs of a run
    alike is not counted.

    Raises:
        UsageError: There are no pairs, or runs without a partner, or b is zero in the mean.
    """
    base = float(b.mean()) if b.size else 0.0
    if base == 0.0:
        raise UsageError("nothing has a ratio to a mean of zero; compare runs that cost something")
    ratio = float(a.mean()) / base
    left = paired_difference(a, ratio * b, level)
    return ratio, (ratio + left.low / base, ratio + left.high / base)


def _figures(results: Results, cell: CellSummary) -> str:
    if cell.refused or cell.cost is None:
        return f"not flown: {cell.refused or 'no run ended in order'}"
    steps, outside = results.steps, results.runs[cell.index].outside
    settled = outside[steps // 2 :].sum() / (cell.runs * (steps - steps // 2))
    low = cell.worst_step_ci[0] if cell.worst_step_ci else float("nan")
    plans = f", slack {100 * cell.slack_used / cell.decisions:.2f} % of plans" if cell.decisions else ""
    return (
        f"{cell.runs} runs of {steps}, cost {cell.cost:.1f}, settled {cell.settled_cost:.2f}, outside "
        f"{100 * settled:.2f} % of settled steps, worst step {100 * (cell.worst_step_rate or 0.0):.2f} % "
        f"(from {100 * low:.2f} %){plans}, fallback in {cell.fallbacks} steps"
    )


def _over(results: Results, ours: CellSummary, other: CellSummary) -> str:
    if ours.cost is None or other.cost is None:
        return ""
    a, b = results.runs[ours.index], results.runs[other.index]
    _, of_a, of_b = np.intersect1d(a.index, b.index, assume_unique=True, return_indices=True)
    told = []
    for column in COLUMNS:
        ratio, (low, high) = paired_ratio(a[column][of_a], b[column][of_b])
        told.append(f"{column} ratio {ratio:.4f} ({low:.4f} to {high:.4f})")
    return f"; {', '.join(told)}"


def _tell(line: str) -> None:
    sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
