"""Commands `uavctl design` and `uavctl solve`: a design, and one decision."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from uavctl.build.controller import (
    build_conditioned,
    build_controller,
    build_design,
    build_solver,
    build_spec,
    design_of,
    start_state,
)
from uavctl.build.mission import build_names
from uavctl.build.rehearsal import RehearsalResult, rehearse
from uavctl.cli.common import DEFAULTS, Column, Common, WideTable, columns, located, messages
from uavctl.config import Config
from uavctl.errors import UsageError
from uavctl.lab.terminal_gain import GainComparison, GainReport, compare_gains
from uavctl.records import SolveStatus, tell_all
from uavctl.smpc.answer import Answer
from uavctl.smpc.conditioned.planner import AnyDesign, ConditionedDesign, conditioned_record
from uavctl.smpc.hahn_stursberg.design import Design, design_record
from uavctl.smpc.hahn_stursberg.terminal import stationary_cost

# `uavctl design --synthesize`: the configured terminal gain beside the best one.


def gains_report(common: Common) -> int:
    """Synthesise the terminal gain and compare; return 1 if no complete design can be made with it."""
    loaded = common.load()
    begin = time.perf_counter()
    with located(loaded), messages().status("synthesis and designs"):
        spec = build_spec(loaded.config)
        found = compare_gains(spec, start_state(loaded.config, spec.plant))
    document = {**msgspec.to_builtins(found), "k_tau": found.after.k_tau, "wall_s": time.perf_counter() - begin}
    common.show("design/gains", document, lambda: _gains_picture(found, loaded.config.name))
    return 0 if found.after.refused is None else 1


def _gains_picture(found: GainComparison, name: str) -> RenderableType:
    rows = ((label, figure(found.before), figure(found.after)) for label, figure in _GAIN_ROWS)
    table = columns(f"Terminal gain of {name}", ("", "configured", "synthesised"), rows)
    refusals = [
        Text(f"No complete design with the {which} gain: {report.refused}")
        for which, report in (("configured", found.before), ("synthesised", found.after))
        if report.refused is not None
    ]
    return Group(table, *refusals, _BASIS, "To take the synthesised gain over:", "", Text(found.toml))


_BASIS = (
    "Infeasible: the target is not reached within the horizon with all constraints kept; a flight goes there by "
    "way of nearer equilibria, or gives way where the limits are soft."
)


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _start_cost(report: GainReport) -> str:
    if report.refused is not None:
        return "-"
    return "infeasible" if report.start_cost is None else f"{report.start_cost:.2f}"


_GAIN_ROWS: tuple[tuple[str, Callable[[GainReport], str]], ...] = (
    ("stationary cost of a step", lambda report: _figure(report.stationary_cost)),
    ("spectral radius (4.2: below 1)", lambda report: _figure(report.spectral_radius)),
    ("state room taken (4.3: at most 1)", lambda report: _figure(report.filled_x)),
    ("input room taken (4.4: at most 1)", lambda report: _figure(report.filled_u)),
    ("margin s* of the terminal condition", lambda report: _figure(report.margin)),
    ("optimal cost from the simulator's start", _start_cost),
)


# `uavctl design`: make a design, and show what it rests on.


_RARE = 1e-9  # ages that are all older than this share of the time are told together


def design(
    *,
    synthesize: Annotated[
        bool,
        Parameter(negative=(), show_default=False, help="find the terminal gain of least stationary cost, and compare"),
    ] = False,
    common: Common = DEFAULTS,
) -> int:
    """Make a design: schedule, terminal ingredients, Assumption 4 with figures."""
    if synthesize:
        return gains_report(common)
    loaded = common.load()
    start = time.perf_counter()
    if loaded.config.is_age_conditioned:
        with located(loaded):
            conditioned = build_conditioned(loaded.config)
            found = rehearsed(loaded.config, conditioned)
        figures = {
            **conditioned_record(conditioned),
            "rehearsal": msgspec.to_builtins(found),
            "wall_s": time.perf_counter() - start,
        }
        common.show("design/conditioned", figures, lambda: conditioned_picture(conditioned, loaded.config.name, found))
        return 1 if found is not None and (found.relaxes or found.strays) else 0
    with located(loaded):
        made = build_design(loaded.config)
    document = design_document(made, time.perf_counter() - start)
    common.show("design", document, lambda: design_picture(made, loaded.config.name))
    return 0


def rehearsed(config: Config, made: ConditionedDesign) -> RehearsalResult | None:
    """Rehearse the mission; None for a plant without axes, or where a controller of another package flies.

    Raises:
        DesignError: The mission cannot be flown.
    """
    if not config.plant.axes or config.smpc.controller:
        return None
    return rehearse(config, made, build_controller(config, made))


def conditioned_picture(made: ConditionedDesign, name: str, found: RehearsalResult | None = None) -> RenderableType:
    """Return tables of ages with their risk, and of where a plan may rest; and what is wrong with the mission."""
    title = f"Risk by the age of information, design {made.design_id} of {name}"
    ages = columns(title, ("age [steps]", "probability", "may be outside", "far from limits"), (), ())
    risk, transit, problem = made.solver.risk, made.solver.transit_risk, made.solver.problem
    left = 1.0 - np.cumsum(risk.weights)
    told = min(problem.horizon, 1 + int(np.count_nonzero(left > _RARE)))
    for age in range(told):
        both = (f"{spread.budgets[age]:.2%}" for spread in (risk, transit))
        ages.add_row(str(age + 1), f"{risk.weights[age]:.3g}", *both)
    if told < problem.horizon:
        rest = f"{risk.weights[told:].sum():.3g}"
        both = (f"up to {spread.budgets[-1]:.2%}" for spread in (risk, transit))
        ages.add_row(f"{told + 1} to {problem.horizon}", rest, *both)
    ages.add_row(f"> {problem.horizon}", f"{risk.older_probability:.3g}", "counts in full", "counts in full")
    names = build_names(made)
    # A row of one entry limits -x from below where the entry is negative.
    sizes = problem.state_set.c.sum(axis=1)
    rows = (
        (row, f"{side / size:.3g}", f"{rest / size:.3g}", unit)
        for (row, unit, _), size, side, rest in zip(
            names.rows, sizes, problem.state_set.b, made.rest_limits, strict=True
        )
    )
    headings = ("limit", "at", "rests up to", "unit")
    wrong = [] if found is None or not found.sentences else [*found.sentences, found.hint]
    doubts = [Text(f"{one[:1].upper()}{one[1:]}.", style="bold yellow") for one in wrong]
    return Group(ages, columns("Where a plan may rest", headings, rows, ("limit", "unit")), *doubts)


def design_document(made: Design, wall_s: float) -> dict[str, object]:
    """Return the figures of a design, for --json."""
    return {**design_record(made), "wall_s": wall_s}


def design_picture(made: Design, name: str) -> RenderableType:
    """Return Assumption 4 and the schedule as tables."""
    headings = ("item", "holds", "value", "limit", "of what")
    checked = (
        (
            check.item,
            Text("yes", style="green") if check.ok else Text("no", style="red"),
            f"{check.value:.4g}",
            f"{check.limit:.4g}",
            check.text,
        )
        for check in made.assumptions
    )
    checks = columns(f"Assumption 4, design {made.design_id} of {name}", headings, checked, headings)
    schedule = columns("", ("t", "d_t", "α_t", "γ^x_t+1", "γ^u_t"), (), ())
    stages = zip(
        made.schedule.delays, made.schedule.alpha, made.schedule.gamma_x[1:], made.schedule.gamma_u, strict=True
    )
    for t, (delay, *shares) in enumerate(stages):
        schedule.add_row(str(t), str(delay), *(f"{share:.5f}" for share in shares))
    terminal = (
        f"τ = {made.terminal.tau}, spectral radius of the terminal loop {made.terminal.spectral_radius:.4f}, "
        f"its stationary cost {stationary_cost(made.terminal):.4f} a step.\n"
    )
    return Group(checks, terminal, "Schedule: stage t counts on information that is d_t steps old.", schedule)


def solve(
    *,
    state: Annotated[
        str, Parameter(allow_leading_hyphen=True, help="state now, axis by axis, as in 35,-2,-20,-4", metavar="X,V,...")
    ],
    method: Annotated[
        Literal["exact", "printed"] | None,
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
        solver = build_solver(design, loaded.config)
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
            hint = "the printed problem has hard limits; `exact` softens those of the state"
        return f"{head}; no plan: {hint}"
    bound = "no lower bound known"
    if math.isfinite(answer.gap):
        bound = f"at least {answer.cost_lower:.2f}, gap {answer.gap:.1e}"
    facts = f"cost {answer.cost:.2f} ({bound}), slack {answer.slack:.3g}, offset {answer.offset:.3g}"
    gave_way = [tell_all(build_names(design), answer.relaxed)] if answer.relaxed else []
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
    inputs = [f"u_{axis[0]}" for axis in axes] if axes else [f"u{i}" for i in range(design.plant.n_u)]
    names = [*state_names(design.plant.n_x, axes), *inputs]
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
    each, rest = divmod(n_x, len(axes)) if axes else (n_x, 0)
    if not axes or rest or each > len("pva"):
        return [f"x{i}" for i in range(n_x)]
    return [f"{letter}_{axis[0]}" for axis in axes for letter in "pva"[:each]]


def _column(heading: str, values: Iterable[float], rows: int) -> Column:
    """Return a column of figures, blank where there are fewer of them than `rows`."""
    cells = [f"{value:z.3f}" for value in values]
    return Column(heading, [*cells, *([""] * (rows - len(cells)))])
