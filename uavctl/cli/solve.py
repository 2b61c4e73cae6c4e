"""Command `uavctl solve`: one decision."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray
from rich.console import Group, RenderableType

from uavctl.build.controller import build_solver, design_of
from uavctl.build.mission import build_names
from uavctl.cli.common import DEFAULTS, Column, Common, WideTable, located
from uavctl.cli.prepare import ready_library
from uavctl.config import Config
from uavctl.errors import UsageError
from uavctl.labels import tell_all
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer
from uavctl.smpc.conditioned.planner import AnyDesign


def solve(
    *,
    state: Annotated[
        str, Parameter(allow_leading_hyphen=True, help="state now, axis by axis, as in 35,-2,-20,-4", metavar="X,V,...")
    ],
    method: Annotated[
        Literal["library", "exact", "printed"] | None,
        Parameter(
            help="overrides solver.method; `printed` knows no lower bound: cost_lower and gap are null in --json"
        ),
    ] = None,
    common: Common = DEFAULTS,
) -> int:
    """Solve one decision problem, towards the configured target."""
    loaded = common.with_overrides([] if method is None else [f"solver.method={method}"]).load()
    with located(loaded):
        design = design_of(loaded.config)
        x = parse_state(state, design.plant.n_x)
        stored = ready_library(loaded.config, design)
        solver = build_solver(design, loaded.config, None if stored is None else stored.library)
    start = time.perf_counter()
    answer = solver.solve(0, x, design.target)
    solve_us = (time.perf_counter() - start) * 1e6
    common.show(
        "solve", solve_document(answer, solve_us), lambda: solve_picture(answer, design, loaded.config, solve_us)
    )
    return 0 if answer.status is SolveStatus.OPTIMAL else 1


def parse_state(text: str, n_x: int) -> NDArray[np.float64]:
    """Parse a state (n_x,) that a person typed.

    Raises:
        UsageError: It is not n_x finite numbers.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != n_x or not all(map(math.isfinite, numbers)):
        raise UsageError(f"--state {text}: is not a state of this plant; give {n_x} numbers, joined by commas")
    return np.array(numbers)


def solve_document(answer: Answer, solve_us: float) -> dict[str, object]:
    """Return the answer for --json; infinite values (no plan, no lower bound) are null."""
    document: dict[str, object] = msgspec.to_builtins(answer, enc_hook=lambda array: array.tolist())
    del document["seq"]
    return {**document, "solve_us": solve_us}


def solve_picture(answer: Answer, design: AnyDesign, config: Config, solve_us: float) -> RenderableType:
    """Return the plan as a table, stage by stage, with its largest back-offs."""
    head = f"{config.name}, method {answer.method}: {answer.status.value} in {solve_us / 1000:.1f} ms"
    if not answer.inputs.size:
        hint = "is the state far beyond what numbers can hold? Give one nearer to the limits"
        if config.solver.method == "printed":
            hint = "the printed problem has hard limits; `library` and `exact` soften those of the state"
        return f"{head}; no plan: {hint}"
    bound = "no lower bound known"
    if math.isfinite(answer.gap):
        bound = f"at least {answer.cost_lower:.2f}, gap {answer.gap:.1e}"
    facts = f"cost {answer.cost:.2f} ({bound}), slack {answer.slack:.3g}, offset {answer.offset:.3g}"
    gave_way = [tell_all(build_names(design), answer.gave_way)] if answer.gave_way else []
    return Group(
        head,
        facts,
        *gave_way,
        "Predicted means, inputs, and the largest back-off from a limit, stage by stage:",
        plan_table(answer, design),
    )


def plan_table(answer: Answer, design: AnyDesign) -> WideTable:
    """Return the plan as a table, stage by stage; the columns of an axis stay together, and so do back-offs."""
    axes, count = design.plant.axes, len(answer.states)
    names = [*state_names(design.plant.n_x, axes), *(f"u_{axis[0]}" for axis in axes)]
    values = [*answer.states.T, *answer.inputs.T]
    groups: dict[str, list[Column]] = {}
    for name, of_stages in zip(names, values, strict=True):
        groups.setdefault(name.partition("_")[2] or name, []).append(_column(name, of_stages, count))
    backoffs = [
        _column(f"back-off {of}", [max(rows, default=0.0) for rows in table], count)
        for of, table in (("x", answer.backoff_x), ("u", answer.backoff_u))
    ]
    return WideTable(Column("t", [str(t) for t in range(count)]), [*groups.values(), backoffs])


def state_names(n_x: int, axes: Sequence[str]) -> list[str]:
    """Return the names of the states, axis by axis: position, velocity, acceleration; numbers for other plants."""
    each, rest = divmod(n_x, len(axes))
    if rest or each > len("pva"):
        return [f"x{i}" for i in range(n_x)]
    return [f"{letter}_{axis[0]}" for axis in axes for letter in "pva"[:each]]


def _column(heading: str, values: Iterable[float], rows: int) -> Column:
    """Return a column of figures, blank where there are fewer of them than `rows`."""
    cells = [f"{value:z.3f}" for value in values]
    return Column(heading, [*cells, *([""] * (rows - len(cells)))])
