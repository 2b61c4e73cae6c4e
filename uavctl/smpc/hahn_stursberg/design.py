"""Design of scheme `hahn-stursberg`: all that the decision problem is made of, checked against Assumption 4.

1. `kappa` turns a likelihood γ into the factor of a back-off: κ standard deviations.
2. `make_design` chooses a schedule by its rule, makes the terminal ingredients, and checks Assumption 4. Rule `search`
   takes the nested schedule of least mean cost over given states.
3. `design_record` is the design as plain numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal

import numpy as np
from scipy.special import gammaincinv, ndtri

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.records import Vec3
from uavctl.smpc.hahn_stursberg.schedule import Schedule, ScheduleDemand, list_nested, make_fixed, make_greedy
from uavctl.smpc.hahn_stursberg.terminal import (
    AssumptionCheck,
    Terminal,
    check_assumptions,
    make_terminal,
    stationary_cost,
)
from uavctl.smpc.link import LinkModel, age_cdf
from uavctl.smpc.plant import Plant, count_reach_steps, digest
from uavctl.smpc.sets import Polytope

Allocation = Literal["ellipsoid", "halfspace"]


def kappa(gamma: float, n: int, rows: int, allocation: Allocation) -> float:
    """Return κ, the distance of a row from its limit in standard deviations.

    Args:
        gamma: Likelihood γ of the whole vector.
        allocation: `ellipsoid`: root of the χ² quantile with n degrees of freedom, as printed; `halfspace`: Gaussian
            quantiles with an equal share of the risk for each row (Boole).
    """
    # (9): κ² = χ²_n(γ);  or κ = Φ⁻¹(1 - (1 - γ) / rows)
    if allocation == "ellipsoid":
        return float(np.sqrt(2.0 * gammaincinv(0.5 * n, gamma)))
    return float(-ndtri((1.0 - gamma) / max(1, rows)))


Rule = Literal["fixed", "search", "greedy"]
# Each candidate is a program, built and solved for each search state: this many take minutes.
MAX_CANDIDATES = 500


@dataclass(frozen=True, eq=False)
class DesignSpec:
    """Specification of a design; the fields are those of the configuration of the same name."""

    plant: Plant
    state_set: Polytope
    input_set: Polytope
    q_x: Array
    q_u: Array
    horizon: int
    tau: int
    delta_x: float
    delta_u: float
    delta_tau: float
    k_tau: Array
    link: LinkModel  # model of the link
    target_m: Vec3  # center of the terminal set, which must fit the limits, local NED [m]
    rule: Rule
    delays: int | Sequence[int]
    gamma_max: float
    search_states: Array
    allocation: Allocation
    slack_linear: float
    slack_quadratic: float
    offset_weight: float
    terminal_weight: float
    max_iterations: int
    # Likelihoods by the joint probability that all stages' feedback is usable, not by the product (6)
    joint: bool = False
    # Covariance of the state estimate's error (n_x, n_x); None: the state is known exactly
    estimate_cov: Array | None = None


@dataclass(frozen=True, eq=False)
class Design:
    """All data of a solver; the names of fields are part of the hash."""

    plant: Plant  # the plant
    state_set: Polytope  # X, m_x rows
    input_set: Polytope  # U, m_u rows
    q_x: Array  # Q_x (n_x, n_x)
    q_u: Array  # Q_u (n_u, n_u)
    target: Array  # equilibrium that the design was checked at (n_x,)
    horizon: int  # H
    schedule: Schedule  # delays and likelihoods
    terminal: Terminal  # terminal feedback after the horizon
    kappa_x: Array  # κ_t of the state rows (H+1,); entry 0 is not used
    kappa_u: Array  # κ_t of the input rows (H,)
    kappa_x_terminal: float  # the larger of δ_x's and the last stage's
    kappa_u_terminal: float  # the larger of δ_u's and the terminal stages'
    slack_linear: float  # exact penalty of a slack
    slack_quadratic: float  # its quadratic part
    offset_weight: float  # l1 weight of the reference's distance from the target
    terminal_weight: float  # l1 weight of a missed terminal equality
    max_iterations: int  # bound of the interior-point method
    estimate_cov: Array  # covariance of the state estimate's error (n_x, n_x), part of every state's back-off
    past: int  # age of the position that a plan is based on [steps]; disturbances since then are unknown
    late: tuple[Design, ...]  # designs for plans based on positions 1, 2 … steps old
    assumptions: tuple[AssumptionCheck, ...]  # assumption 4, item by item
    design_id: str  # hash of all the above

    @property
    def arrival_stage(self) -> int:
        """N, the stage from which a plan rests [steps]."""
        return self.horizon - self.terminal.tau


def make_design(spec: DesignSpec, cost_of: Callable[[Design, Array], float | None] | None = None) -> Design:
    """Choose a schedule, make the terminal ingredients, check Assumption 4.

    Args:
        cost_of: Optimal cost of a design from a state (n_x,), None where it is infeasible; rule `search` needs it.

    Raises:
        DesignError: No such design, naming the key, the item of Assumption 4 if one fails, and the figures.
    """
    _check_horizon(spec)
    demand = ScheduleDemand(spec.link, spec.horizon, spec.tau, spec.delta_x, spec.delta_u, spec.joint)
    terminal = make_terminal(spec.plant, spec.tau, spec.k_tau, spec.q_x, spec.q_u)
    if spec.rule == "fixed":
        return assemble_design(spec, make_fixed(demand, spec.delays), terminal)
    if spec.rule == "greedy":
        return assemble_design(spec, make_greedy(demand, spec.gamma_max), terminal)
    return _search(spec, demand, terminal, cost_of)


def _check_horizon(spec: DesignSpec) -> None:
    """Check that N = H - τ steps reach the target from any state, since the mean rests from stage N on."""
    free, least = spec.horizon - spec.tau, count_reach_steps(spec.plant)
    if free < least:
        raise DesignError(
            "smpc.tau",
            f"tau = {spec.tau} leaves N = {free} free steps of the horizon H = {spec.horizon}, and from any state "
            f"to the target it takes {least}",
            f"take smpc.tau of at most {spec.horizon - least}, or smpc.horizon of at least {spec.tau + least}",
        )


def _search(
    spec: DesignSpec,
    demand: ScheduleDemand,
    terminal: Terminal,
    cost_of: Callable[[Design, Array], float | None] | None,
) -> Design:
    """Find the nested schedule of least mean cost over the search states, feasible for all of them."""
    if cost_of is None:
        raise DesignError("schedule.rule", "rule `search` has no cost to minimise here", "use rule `fixed` or `greedy`")
    if not len(spec.search_states):
        raise DesignError(
            "schedule.search_states", "rule `search` has no states to minimise the cost over", "name some"
        )
    candidates = list(islice(list_nested(demand, spec.gamma_max), MAX_CANDIDATES + 1))
    if len(candidates) > MAX_CANDIDATES:
        raise DesignError(
            "schedule.rule",
            f"`search` has more than {MAX_CANDIDATES} nested schedules to try at H = {spec.horizon}",
            "take a shorter smpc.horizon, a lower schedule.gamma_max, or rule `greedy`",
        )
    best: tuple[float, Design] | None = None
    n_refused, last_reason = 0, ""
    for schedule in candidates:
        try:
            design = assemble_design(spec, schedule, terminal)
        except DesignError as error:  # the limits leave no margin for these likelihoods
            n_refused, last_reason = n_refused + 1, f": {error.reason}"
            continue
        costs = [cost_of(design, state) for state in spec.search_states]
        known_costs = [cost for cost in costs if cost is not None]
        mean = float(np.mean(known_costs)) if len(known_costs) == len(costs) else np.inf
        if np.isfinite(mean) and (best is None or mean < best[0]):
            best = (mean, design)
    if best is None:
        raise DesignError(
            "schedule.rule",
            f"none of {len(candidates)} nested schedules will do: {n_refused} fail Assumption 4, "
            f"{len(candidates) - n_refused} leave one of the {len(spec.search_states)} states infeasible{last_reason}",
            "name states that are easier, raise schedule.gamma_max, or use rule `fixed`",
        )
    return best[1]


def assemble_design(spec: DesignSpec, schedule: Schedule, terminal: Terminal, past: int = 0) -> Design:
    """Assemble the design of a schedule and a terminal law, for positions `past` steps old.

    Raises:
        DesignError: An item of Assumption 4 fails.
    """
    n_x, n_u = spec.plant.n_x, spec.plant.n_u
    m_x, m_u = spec.state_set.b.size, spec.input_set.b.size

    def factor(gamma: float, n: int, rows: int) -> float:
        return kappa(gamma, n, rows, spec.allocation)

    kappa_x = np.array([0.0, *(factor(g, n_x, m_x) for g in schedule.gamma_x[1:])])
    kappa_u = np.array([factor(g, n_u, m_u) for g in schedule.gamma_u])
    kappa_x_terminal = max(factor(spec.delta_x, n_x, m_x), float(kappa_x[-1]))
    kappa_u_terminal = max(factor(spec.delta_u, n_u, m_u), float(kappa_u[-spec.tau :].max()))
    target = spec.plant.equilibrium(spec.target_m)
    estimate_cov = np.zeros((n_x, n_x)) if spec.estimate_cov is None else spec.estimate_cov
    mu = spec.link.age(max(spec.horizon, spec.tau))
    checks = check_assumptions(
        plant=spec.plant,
        terminal=terminal,
        state_set=spec.state_set,
        input_set=spec.input_set,
        q_u=spec.q_u,
        target=target,
        estimate_cov=estimate_cov,
        kappa_x=kappa_x_terminal,
        kappa_u=kappa_u_terminal,
        # (17) at all times: in the horizon and in the long run
        age_within_tau=min(1.0 - spec.link.outage(spec.tau + 1), *(age_cdf(mu, t, spec.tau) for t in range(len(mu)))),
        delta_tau=spec.delta_tau,
    )
    design = Design(
        plant=spec.plant,
        state_set=spec.state_set,
        input_set=spec.input_set,
        q_x=spec.q_x,
        q_u=spec.q_u,
        target=target,
        horizon=spec.horizon,
        schedule=schedule,
        terminal=terminal,
        kappa_x=kappa_x,
        kappa_u=kappa_u,
        kappa_x_terminal=kappa_x_terminal,
        kappa_u_terminal=kappa_u_terminal,
        slack_linear=spec.slack_linear,
        slack_quadratic=spec.slack_quadratic,
        offset_weight=spec.offset_weight,
        terminal_weight=spec.terminal_weight,
        max_iterations=spec.max_iterations,
        estimate_cov=estimate_cov,
        past=past,
        late=(),
        assumptions=checks,
        design_id="",
    )
    return replace(design, design_id=digest(design))


def design_record(design: Design) -> dict[str, object]:
    """Return the design as plain numbers, for recordings and `uavctl design --json`."""
    plant, schedule, terminal = design.plant, design.schedule, design.terminal
    return {
        "design_id": design.design_id,
        "tau": terminal.tau,
        "horizon": design.horizon,
        "dt_s": plant.dt_s,
        "axes": list(plant.axes),
        "position_index": list(plant.position_index),
        "velocity_index": list(plant.velocity_index),
        "accel_per_input": plant.accel_per_input.tolist(),
        "target": design.target.tolist(),
        "delays": list(schedule.delays),
        "alpha": schedule.alpha.tolist(),
        "gamma_x": schedule.gamma_x.tolist(),
        "gamma_u": schedule.gamma_u.tolist(),
        "kappa_x": design.kappa_x.tolist(),
        "kappa_u": design.kappa_u.tolist(),
        "kappa_x_terminal": design.kappa_x_terminal,
        "kappa_u_terminal": design.kappa_u_terminal,
        "spectral_radius": terminal.spectral_radius,
        "stationary_cost": stationary_cost(terminal),
        "assumptions": [
            {
                "item": check.item,
                "ok": check.ok,
                "value": check.value,
                "limit": check.limit if np.isfinite(check.limit) else None,  # JSON has no infinity
                "text": check.text,
            }
            for check in design.assumptions
        ],
        "a": plant.a.tolist(),
        "b": plant.b.tolist(),
        "e": plant.e.tolist(),
        "w": plant.w.tolist(),
        "c_x": design.state_set.c.tolist(),
        "b_x": design.state_set.b.tolist(),
        "c_u": design.input_set.c.tolist(),
        "b_u": design.input_set.b.tolist(),
        "q_x": design.q_x.tolist(),
        "q_u": design.q_u.tolist(),
        "k_tau": terminal.k.tolist(),
        "sigma_x": terminal.sigma_x.tolist(),
        "estimate_cov": design.estimate_cov.tolist(),
        "late": [
            {
                "delays": list(late.schedule.delays),
                "alpha": late.schedule.alpha.tolist(),
                "gamma_x": late.schedule.gamma_x.tolist(),
                "gamma_u": late.schedule.gamma_u.tolist(),
                "kappa_x": late.kappa_x.tolist(),
                "kappa_u": late.kappa_u.tolist(),
            }
            for late in design.late
        ],
        "slack_linear": design.slack_linear,
        "slack_quadratic": design.slack_quadratic,
        "offset_weight": design.offset_weight,
        "terminal_weight": design.terminal_weight,
        "max_iterations": design.max_iterations,
    }
