"""`uavctl design`: make a design, and show what it rests on."""

from __future__ import annotations

import time

from rich.console import Group, RenderableType
from rich.table import Table

from uavctl.build import build_design
from uavctl.cli.common import DEFAULTS, Common, located
from uavctl.smpc.design import Design, design_record
from uavctl.smpc.terminal import stationary_cost


def design(*, common: Common = DEFAULTS) -> int:
    """Make a design: schedule, terminal ingredients, Assumption 4 with figures."""
    loaded = common.load()
    start = time.perf_counter()
    with located(loaded):
        made = build_design(loaded.config)
    document = design_document(made, time.perf_counter() - start)
    common.show(document, lambda: design_picture(made, loaded.config.name))
    return 0


def design_document(made: Design, wall_s: float) -> dict[str, object]:
    """The figures of a design, for --json."""
    # Every decision is solved exactly: there is no library of policies whose gap could be bounded.
    return {**design_record(made), "library_size": 0, "gap_max": None, "wall_s": wall_s}


def design_picture(made: Design, name: str) -> RenderableType:
    """Assumption 4 and the schedule, as tables."""
    checks = Table(title=f"Assumption 4, design {made.design_id} of {name}", title_justify="left")
    for heading in ("item", "holds", "value", "limit", "of what"):
        checks.add_column(heading)
    for check in made.assumptions:
        holds = "[green]yes[/]" if check.ok else "[red]no[/]"
        checks.add_row(check.item, holds, f"{check.value:.4g}", f"{check.limit:.4g}", check.text)
    schedule = Table()
    for heading in ("t", "d_t", "α_t", "γ^x_t+1", "γ^u_t"):
        schedule.add_column(heading, justify="right")
    rows = zip(made.schedule.delays, made.schedule.alpha, made.schedule.gamma_x[1:], made.schedule.gamma_u, strict=True)
    for t, (delay, alpha, gamma_x, gamma_u) in enumerate(rows):
        schedule.add_row(str(t), str(delay), f"{alpha:.5f}", f"{gamma_x:.5f}", f"{gamma_u:.5f}")
    terminal = (
        f"τ = {made.terminal.tau}, spectral radius of the terminal loop {made.terminal.spectral_radius:.4f}, "
        f"its stationary cost {stationary_cost(made.terminal):.4f} a step.\n"
    )
    return Group(checks, terminal, "Schedule: stage t counts on information that is d_t steps old.", schedule)
