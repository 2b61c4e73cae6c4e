"""Sections of a flight's page on its origin: design, checks before arming, configuration, versions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from logs.report.evidence import FlightEvidence
from logs.report.page import PageSection, Part, render_facts, render_folded, render_table

# Negligible probabilities are shown as one value.
_NEGLIGIBLE = 1e-6
_DESIGN = {
    "horizon": "Horizon H [steps]",
    "dt_s": "Step Δt [s]",
    "scheme": "Scheme",
    "weights": "Shares of the ages of information",
    "budgets": "Risk of each age",
    "beyond": "Share of information older than the horizon",
    "tau": "Delay τ of the terminal law [steps]",
    "delays": "Information delays d",
    "gamma_x": "Likelihoods γ of the states",
    "gamma_u": "Likelihoods γ of the inputs",
    "spectral_radius": "Spectral radius of the terminal law",
    "stationary_cost": "Stationary cost",
}


def _show_configuration(e: FlightEvidence) -> Iterator[Part]:
    header = e.flight.header
    design, assumptions = list(_list_design_facts(header.design)), list(_list_assumptions(header.design))
    if design:
        yield render_facts(design)
    if assumptions:
        table = render_table(("assumption", "value", "limit", "holds"), assumptions, frozenset({1, 2}))
        yield render_folded("Assumptions of the design", table)
    if e.flight.checks:
        rows = [(check.name, check.state, check.value, check.want) for check in e.flight.checks]
        table = render_table(("check before arming", "state", "found", "wanted"), rows, frozenset())
        yield render_folded("Checked before arming", table)
    yield render_folded("Configuration", header.config_toml)


def _show_versions(e: FlightEvidence) -> Iterator[Part]:
    header = e.flight.header
    yield render_facts([("Design", header.design_id), ("Processor", header.cpu), *sorted(header.versions.items())])


def _list_design_facts(design: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    for key, name in _DESIGN.items():
        if key in design:
            yield name, _format_value(design[key])


def _format_value(value: object) -> str:
    """Return a number, or a list of them, as text; a run of equal numbers is written once."""
    if isinstance(value, (int, float)):
        return f"{value:.4g}"
    if not isinstance(value, (list, tuple)):
        return str(value)
    runs: list[tuple[str, int]] = []
    for entry in value:
        text = f"< {_NEGLIGIBLE:g}" if isinstance(entry, float) and 0 < entry < _NEGLIGIBLE else _format_value(entry)
        if runs and runs[-1][0] == text:
            runs[-1] = (text, runs[-1][1] + 1)
        else:
            runs.append((text, 1))
    return ", ".join(text if times == 1 else f"{times} × {text}" for text, times in runs)


def _list_assumptions(design: Mapping[str, object]) -> Iterator[tuple[str, ...]]:
    assumptions = design.get("assumptions")
    for assumption in assumptions if isinstance(assumptions, (list, tuple)) else ():
        if isinstance(assumption, Mapping):
            name = f"{assumption.get('item')}: {assumption.get('text')}"
            yield (
                name,
                _format_value(assumption.get("value")),
                _format_value(assumption.get("limit")),
                "yes" if assumption.get("ok") else "no",
            )


SECTIONS: tuple[PageSection[FlightEvidence], ...] = (
    PageSection("Configuration and parameters", _show_configuration, is_closed=True),
    PageSection("Made with", _show_versions, is_closed=True),
)
