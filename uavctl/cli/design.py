"""Commands `uavctl design`, with --synthesize for the best terminal gain, and `uavctl solve` for one decision."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from typing import Annotated, Literal

import msgspec
import numpy as np
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.text import Text

from uavctl.arrays import Array
from uavctl.cli.common import DEFAULTS, Common, locate_design_errors, make_key_overrides
from uavctl.cli.flight_risk import Rehearsals, RiskSeed, compute_flight_risk
from uavctl.cli.output import Column, WideTable, make_message_console, make_table
from uavctl.config import Config
from uavctl.constraint_names import describe_all_relaxed
from uavctl.errors import UsageError
from uavctl.lab.flight_risk import FlightRisk
from uavctl.lab.terminal_gain import GainComparison, GainReport, compare_gains
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Answer
from uavctl.smpc.conditioned.design import AnyDesign, ConditionedDesign, make_conditioned_record
from uavctl.smpc.hahn_stursberg.design import Design, design_record
from uavctl.smpc.hahn_stursberg.terminal import stationary_cost
from uavctl.smpc.plant import Plant
from uavctl.wiring.controller import (
    build_conditioned,
    build_controller,
    build_design,
    build_flight_design,
    build_solver,
    build_spec,
    make_start_state,
)
from uavctl.wiring.mission import build_names
from uavctl.wiring.rehearsal import RehearsalResult, rehearse
from uavctl.wiring.rest import pad_state


def report_gains(common: Common) -> int:
    """Synthesise the terminal gain and compare; return 1 if no complete design can be made with it."""
    loaded = common.load()
    begin_s = time.perf_counter()
    with locate_design_errors(loaded), make_message_console().status("synthesis and designs"):
        spec = build_spec(loaded.config)
        comparison = compare_gains(spec, make_start_state(loaded.config, spec.plant))
    document = {
        **msgspec.to_builtins(comparison),
        "k_tau": comparison.after.k_tau,
        "wall_s": time.perf_counter() - begin_s,
    }
    common.show("design/gains", document, lambda: _render_gains(comparison, loaded.config.name))
    return 0 if comparison.after.refused is None else 1


def _render_gains(comparison: GainComparison, name: str) -> RenderableType:
    rows = ((label, figure(comparison.before), figure(comparison.after)) for label, figure in _GAIN_ROWS)
    table = make_table(f"Terminal gain of {name}", ("", "configured", "synthesised"), rows)
    refusals = [
        Text(f"No complete design with the {label} gain: {report.refused}")
        for label, report in (("configured", comparison.before), ("synthesised", comparison.after))
        if report.refused is not None
    ]
    return Group(table, *refusals, _INFEASIBLE_NOTE, "To take the synthesised gain over:", "", Text(comparison.toml))


_INFEASIBLE_NOTE = (
    "Infeasible: no plan reaches the target within the horizon and keeps all constraints. A flight takes nearer "
    "targets first, or relaxes soft limits."
)


def _format_figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _format_start_cost(report: GainReport) -> str:
    if report.refused is not None:
        return "-"
    return "infeasible" if report.start_cost is None else f"{report.start_cost:.2f}"


_GAIN_ROWS: tuple[tuple[str, Callable[[GainReport], str]], ...] = (
    ("stationary cost of a step", lambda report: _format_figure(report.stationary_cost)),
    ("spectral radius (4.2: below 1)", lambda report: _format_figure(report.spectral_radius)),
    ("state room taken (4.3: at most 1)", lambda report: _format_figure(report.filled_x)),
    ("input room taken (4.4: at most 1)", lambda report: _format_figure(report.filled_u)),
    ("margin s* of the terminal condition", lambda report: _format_figure(report.margin)),
    ("optimal cost from the simulator's start", _format_start_cost),
)


_RARE_SHARE = 1e-9  # ages with a smaller probability of being exceeded share one row


def design(
    *,
    synthesize: Annotated[
        bool,
        Parameter(negative=(), show_default=False, help="find the terminal gain of least stationary cost, and compare"),
    ] = False,
    rehearsals: Rehearsals = None,
    seed: RiskSeed = 0,
    common: Common = DEFAULTS,
) -> int:
    """Make a design: schedule, terminal ingredients, Assumption 4 with figures."""
    if synthesize:
        return report_gains(common)
    loaded = common.with_overrides(make_key_overrides(check__rehearsals=rehearsals)).load()
    begin_s = time.perf_counter()
    if loaded.config.is_age_conditioned:
        with locate_design_errors(loaded):
            conditioned = build_conditioned(loaded.config)
            rehearsal = rehearse_mission(loaded.config, conditioned)
            risk = compute_flight_risk(loaded.config, seed, conditioned)
        figures = {
            **make_conditioned_record(conditioned),
            "rehearsal": msgspec.to_builtins(rehearsal),
            "flight_risk": msgspec.to_builtins(risk),
            "wall_s": time.perf_counter() - begin_s,
        }
        common.show(
            "design/conditioned", figures, lambda: render_conditioned(conditioned, loaded.config.name, rehearsal, risk)
        )
        return 1 if rehearsal is not None and (rehearsal.relaxes or rehearsal.leaves_trajectory) else 0
    with locate_design_errors(loaded):
        paper_design = build_design(loaded.config)
    document = make_design_document(paper_design, time.perf_counter() - begin_s)
    common.show("design", document, lambda: render_design(paper_design, loaded.config.name))
    return 0


def rehearse_mission(config: Config, design: ConditionedDesign) -> RehearsalResult | None:
    """Rehearse the mission; None for a plant without axes and for a controller of another package.

    Raises:
        DesignError: The mission cannot be flown.
    """
    if not config.plant.axes or config.smpc.controller:
        return None
    return rehearse(config, design, build_controller(config, design))


def render_conditioned(
    design: ConditionedDesign,
    name: str,
    rehearsal: RehearsalResult | None = None,
    risk_of_flight: FlightRisk | None = None,
) -> RenderableType:
    """Return tables of the risk of each age and of the limits at rest, the risk of a flight, and warnings on it."""
    title = f"Risk by the age of information, design {design.design_id} of {name}"
    ages = make_table(title, ("age [steps]", "probability", "may be outside", "far from limits"), (), ())
    risk, transit, problem = design.solver.risk, design.solver.transit_risk, design.solver.problem
    remaining = 1.0 - np.cumsum(risk.age_probabilities)
    listed_ages = min(problem.horizon, 1 + int(np.count_nonzero(remaining > _RARE_SHARE)))
    for age in range(listed_ages):
        budgets = (f"{spread.budgets[age]:.2%}" for spread in (risk, transit))
        ages.add_row(str(age + 1), f"{risk.age_probabilities[age]:.3g}", *budgets)
    if listed_ages < problem.horizon:
        probability = f"{risk.age_probabilities[listed_ages:].sum():.3g}"
        budgets = (f"up to {spread.budgets[-1]:.2%}" for spread in (risk, transit))
        ages.add_row(f"{listed_ages + 1} to {problem.horizon}", probability, *budgets)
    ages.add_row(f"> {problem.horizon}", f"{risk.older_probability:.3g}", "counts in full", "counts in full")
    names = build_names(design)
    # A row of one entry limits -x from below where the entry is negative.
    sizes = problem.state_set.c.sum(axis=1)
    rows = (
        (row, f"{side / size:.3g}", f"{probability / size:.3g}", unit)
        for (row, unit, _), size, side, probability in zip(
            names.rows, sizes, problem.state_set.b, design.reference_limits, strict=True
        )
    )
    headings = ("limit", "at", "rests up to", "unit")
    sentences = [] if rehearsal is None or not rehearsal.sentences else [*rehearsal.sentences, rehearsal.hint]
    warnings = [Text(f"{sentence[:1].upper()}{sentence[1:]}.", style="bold yellow") for sentence in sentences]
    rest = make_table("Where a plan may rest", headings, rows, ("limit", "unit"))
    promises = [] if risk_of_flight is None else [Text(f"A flight {risk_of_flight.sentence}.")]
    return Group(ages, rest, *promises, *warnings)


def make_design_document(design: Design, wall_s: float) -> dict[str, object]:
    """Return the figures of a design, for --json."""
    return {**design_record(design), "wall_s": wall_s}


def render_design(design: Design, name: str) -> RenderableType:
    """Return Assumption 4 and the schedule as tables."""
    headings = ("item", "holds", "value", "limit", "quantity")
    rows = (
        (
            check.item,
            Text("yes", style="green") if check.ok else Text("no", style="red"),
            f"{check.value:.4g}",
            f"{check.limit:.4g}",
            check.text,
        )
        for check in design.assumptions
    )
    checks = make_table(f"Assumption 4, design {design.design_id} of {name}", headings, rows, headings)
    schedule = make_table("", ("t", "d_t", "α_t", "γ^x_t+1", "γ^u_t"), (), ())
    stages = zip(
        design.schedule.delays, design.schedule.alpha, design.schedule.gamma_x[1:], design.schedule.gamma_u, strict=True
    )
    for t, (delay, *shares) in enumerate(stages):
        schedule.add_row(str(t), str(delay), *(f"{share:.5f}" for share in shares))
    terminal = (
        f"τ = {design.terminal.tau}, spectral radius of the terminal loop {design.terminal.spectral_radius:.4f}, "
        f"its stationary cost {stationary_cost(design.terminal):.4f} a step.\n"
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
    with locate_design_errors(loaded):
        design = build_flight_design(loaded.config)
        x = parse_state(state, design.plant)
        solver = build_solver(design, loaded.config)
    begin_s = time.perf_counter()
    answer = solver.solve(0, x, design.target)
    solve_us = (time.perf_counter() - begin_s) * 1e6
    common.show(
        "solve", make_solve_document(answer, solve_us), lambda: render_solution(answer, design, loaded.config, solve_us)
    )
    return 0 if answer.status is SolveStatus.OPTIMAL else 1


def parse_state(text: str, plant: Plant) -> Array:
    """Parse a state (n_x,) of the command line; gusts may be left out.

    Raises:
        UsageError: It is not n_x finite numbers.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    state = pad_state(np.array(numbers), plant)
    if state.size != plant.n_x or not np.isfinite(state).all():
        raise UsageError(f"--state {text}: is not a state of this plant; give {plant.n_x} numbers, joined by commas")
    return state


def make_solve_document(answer: Answer, solve_us: float) -> dict[str, object]:
    """Return the answer for --json; infinite values (no plan, no lower bound) are null."""
    document: dict[str, object] = msgspec.to_builtins(answer, enc_hook=lambda array: array.tolist())
    del document["seq"]
    document["gave_way"] = document.pop("relaxed")  # the key in recordings, too
    return {**document, "solve_us": solve_us}


def render_solution(answer: Answer, design: AnyDesign, config: Config, solve_us: float) -> RenderableType:
    """Return the plan as a table with its largest back-offs, a row for each stage."""
    head = f"{config.name}, method {answer.method}: {answer.status.value} in {solve_us / 1000:.1f} ms"
    if not answer.inputs.size:
        hint = "is the state too large to compute with? Give one nearer to the limits"
        if config.solver.method == "printed":
            hint = "the printed problem has hard limits; `exact` softens those of the state"
        return f"{head}; no plan: {hint}"
    bound = "no lower bound known"
    if math.isfinite(answer.gap):
        bound = f"at least {answer.cost_lower:.2f}, gap {answer.gap:.1e}"
    facts = f"cost {answer.cost:.2f} ({bound}), slack {answer.slack:.3g}, offset {answer.offset:.3g}"
    relaxed_lines = [describe_all_relaxed(build_names(design), answer.relaxed)] if answer.relaxed else []
    return Group(
        head,
        facts,
        *relaxed_lines,
        "Predicted means, inputs, and the largest back-off from a limit, stage by stage:",
        make_plan_table(answer, design),
    )


def make_plan_table(answer: Answer, design: AnyDesign) -> WideTable:
    """Return the plan as a table, a row for each stage; the columns of an axis and the back-offs are groups."""
    axes, count = design.plant.axes, len(answer.states)
    inputs = [f"u_{axis[0]}" for axis in axes] if axes else [f"u{i}" for i in range(design.plant.n_u)]
    names = [*make_state_names(design.plant), *inputs]
    values = [*answer.states.T, *answer.inputs.T]
    groups: dict[str, list[Column]] = {}
    for name, stage_values in zip(names, values, strict=True):
        groups.setdefault(name.partition("_")[2] or name, []).append(_make_column(name, stage_values, count))
    backoffs = [
        _make_column(f"back-off {symbol}", [max(rows, default=0.0) for rows in table], count)
        for symbol, table in (("x", answer.backoff_x), ("u", answer.backoff_u))
    ]
    return WideTable(Column("t", [str(t) for t in range(count)]), [*groups.values(), backoffs])


def make_state_names(plant: Plant) -> list[str]:
    """Return the names of the states: position, velocity, acceleration of each axis, then gusts; else numbers."""
    axes, count = plant.axes, plant.gusts.start
    states_per_axis, remainder = divmod(count, len(axes)) if axes else (count, 0)
    if not axes or remainder or states_per_axis > len("pva"):
        return [f"x{i}" for i in range(plant.n_x)]
    names = [f"{letter}_{axis[0]}" for axis in axes for letter in "pva"[:states_per_axis]]
    return names + [f"g_{axis[0]}" for axis in axes[: len(plant.gust_mps2)]]


def _make_column(heading: str, values: Iterable[float], rows: int) -> Column:
    """Return a column of figures, blank where there are fewer of them than `rows`."""
    cells = [f"{value:z.3f}" for value in values]
    return Column(heading, [*cells, *([""] * (rows - len(cells)))])
