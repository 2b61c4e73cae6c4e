"""The sections of a report that say what was flown with: design, vehicle, checks before arming, configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from logs import page
from logs.flight_data import FlightData
from logs.page import Section

# Numbers that say no more than that it hardly ever happens are told as one.
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


def origin_sections(flight: FlightData) -> Iterator[Section]:
    """Parameters, then what the flight was made with."""
    design = list(_design(flight.header.design))
    parts = [page.facts(design)] if design else []
    assumptions = list(_assumptions(flight.header.design))
    if assumptions:
        columns = ("assumption", "value", "limit", "holds")
        parts.append(page.table_folded("Assumptions of the design", columns, assumptions, frozenset({1, 2})))
    if flight.checks:
        columns = ("check before arming", "state", "found", "wanted")
        found = [(one.name, one.state, one.value, one.want) for one in flight.checks]
        parts.append(page.table_folded("Checked before arming", columns, found, frozenset()))
    header = flight.header
    parts.append(page.folded("Configuration", header.config_toml))
    yield Section("Configuration and parameters", "", "".join(parts))
    made = [("Design", header.design_id), ("Processor", header.cpu), *sorted(header.versions.items())]
    yield Section("Made with", "", page.facts(made))


def _design(design: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    for key, name in _DESIGN.items():
        if key in design:
            yield name, _text(design[key])


def _text(value: object) -> str:
    """A number, or numbers; equal ones in a row are told once."""
    if isinstance(value, (int, float)):
        return f"{value:.4g}"
    if not isinstance(value, (list, tuple)):
        return str(value)
    runs: list[tuple[str, int]] = []
    for one in value:
        text = f"< {_NEGLIGIBLE:g}" if isinstance(one, float) and 0 < one < _NEGLIGIBLE else _text(one)
        if runs and runs[-1][0] == text:
            runs[-1] = (text, runs[-1][1] + 1)
        else:
            runs.append((text, 1))
    return ", ".join(text if times == 1 else f"{times} × {text}" for text, times in runs)


def _assumptions(design: Mapping[str, object]) -> Iterator[tuple[str, ...]]:
    found = design.get("assumptions")
    for one in found if isinstance(found, (list, tuple)) else ():
        if isinstance(one, Mapping):
            name = f"{one.get('item')}: {one.get('text')}"
            yield name, _text(one.get("value")), _text(one.get("limit")), "yes" if one.get("ok") else "no"
