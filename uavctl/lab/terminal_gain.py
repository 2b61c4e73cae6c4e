"""The configured terminal gain beside the one of least stationary cost, each with its complete design."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.design import DesignSpec, make_design
from uavctl.smpc.hahn_stursberg.exact import check_schedule, optimal_cost
from uavctl.smpc.hahn_stursberg.synthesis import synthesize, terminal_factors
from uavctl.smpc.hahn_stursberg.terminal import stationary_cost

_DIGITS = 6  # of a gain as it is printed: the figures are those of the printed one


class GainReport(msgspec.Struct, frozen=True, kw_only=True):
    """A complete design with one terminal gain, or the reason why there is none."""

    k_tau: list[list[float]]
    refused: str | None
    design_id: str | None = None
    stationary_cost: float | None = None
    spectral_radius: float | None = None
    filled_x: float | None = None  # Assumption 4.3: share of the room that the terminal set takes
    filled_u: float | None = None  # Assumption 4.4
    margin: float | None = None  # s* of the terminal condition
    start_cost: float | None = None  # optimal cost from the simulator's start; None if the target is out of reach


class GainComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Configured terminal gain beside the synthesised one."""

    toml: str
    before: GainReport
    after: GainReport
    starts: int  # stable gains that the search began from


def compare_gains(spec: DesignSpec, start: Array) -> GainComparison:
    """Synthesise the terminal gain, and make a design with it and with the configured one.

    Args:
        spec: Specification of the design; its own gain may be one that no design can be made with.
        start: State (n_x,) whose cost is reported.

    Raises:
        DesignError: No gain was found (see `synthesize`), or the target or the likelihoods are out of reach.
    """
    kappa_x, kappa_u = terminal_factors(spec)
    synthesis = synthesize(
        spec.plant,
        spec.tau,
        spec.q_x,
        spec.q_u,
        spec.state_set,
        spec.input_set,
        spec.plant.equilibrium(spec.target_m),
        kappa_x,
        kappa_u,
        start=spec.k_tau,
        estimate_cov=spec.estimate_cov,
    )
    rounded_gain = np.array([[float(f"{entry:.{_DIGITS}g}") for entry in row] for row in synthesis.k])
    before, after = (_make_report(replace(spec, k_tau=gain), start) for gain in (spec.k_tau, rounded_gain))
    return GainComparison(toml=_format_gain(rounded_gain), before=before, after=after, starts=synthesis.starts)


def _format_gain(k: Array) -> str:
    """Return a gain as it stands in a configuration."""
    rows = "".join(f"  [{', '.join(repr(float(entry)) for entry in row)}],\n" for row in k)
    return f"[smpc]\nk_tau = [\n{rows}]\n"


def _make_report(spec: DesignSpec, start: Array) -> GainReport:
    try:
        design = make_design(spec, optimal_cost)
        margin = check_schedule(design)
    except DesignError as error:
        return GainReport(k_tau=spec.k_tau.tolist(), refused=str(error))
    shares = {check.item: check.value / check.limit for check in design.assumptions}
    return GainReport(
        k_tau=spec.k_tau.tolist(),
        refused=None,
        design_id=design.design_id,
        stationary_cost=stationary_cost(design.terminal),
        spectral_radius=design.terminal.spectral_radius,
        filled_x=shares["4.3"],
        filled_u=shares["4.4"],
        margin=margin,
        start_cost=optimal_cost(design, start),
    )
