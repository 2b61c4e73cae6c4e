"""A complete design: what the decision problem is made from, checked against Assumption 4 and frozen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from uavctl.data import Vec3
from uavctl.errors import DesignError
from uavctl.smpc.age import at_most
from uavctl.smpc.assumptions import AssumptionCheck, check_assumptions
from uavctl.smpc.digest import digest
from uavctl.smpc.link import LinkModel
from uavctl.smpc.plant import Plant, steps_to_reach
from uavctl.smpc.risk import Allocation, kappa
from uavctl.smpc.schedule import Demand, Schedule, fixed, greedy, nested
from uavctl.smpc.sets import Polytope
from uavctl.smpc.terminal import Terminal, make_terminal

Array = NDArray[np.float64]
Rule = Literal["fixed", "search", "greedy"]
# A candidate costs one program built and solved for each search state: this many are minutes.
MOST_CANDIDATES = 500


@dataclass(frozen=True, eq=False)
class DesignSpec:
    """What a design is asked for; the fields are those of the configuration of the same name.

    Attributes:
        link: Model of the link.
        target_m: Where the terminal set has to fit the limits, local NED [m].
        joint: Likelihoods by the exact probability that all stages' feedback is usable, not by the product (6).
        estimate_cov: Covariance of the state estimate's error (n_x, n_x); None: the state is known exactly.
    """

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
    link: LinkModel
    target_m: Vec3
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
    joint: bool = False
    estimate_cov: Array | None = None


@dataclass(frozen=True, eq=False)
class Design:
    """Everything that a solver reads.

    Attributes:
        plant: The plant.
        state_set: X, m_x rows.
        input_set: U, m_u rows.
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u).
        target: Equilibrium that the design was checked at (n_x,).
        horizon: H.
        schedule: Delays and likelihoods.
        terminal: What follows after the horizon.
        kappa_x: κ_t of the state rows (H+1,); entry 0 is not used.
        kappa_u: κ_t of the input rows (H,).
        kappa_x_terminal: The larger of δ_x's and the last stage's.
        kappa_u_terminal: The larger of δ_u's and the terminal stages'.
        slack_linear: Exact penalty of a slack.
        slack_quadratic: Its quadratic part.
        offset_weight: l1 weight of the reference's distance from the target.
        terminal_weight: l1 weight of a missed terminal equality.
        max_iterations: Bound of the interior-point method.
        estimate_cov: Covariance of the state estimate's error (n_x, n_x), part of every state's back-off.
        past: Age of the position that a plan is based on [steps]: disturbances since then are unknown to it.
        late: The same design for plans that are based on positions 1, 2 … steps old.
        assumptions: Assumption 4, item by item.
        design_id: Hash of all the above.
    """

    plant: Plant
    state_set: Polytope
    input_set: Polytope
    q_x: Array
    q_u: Array
    target: Array
    horizon: int
    schedule: Schedule
    terminal: Terminal
    kappa_x: Array
    kappa_u: Array
    kappa_x_terminal: float
    kappa_u_terminal: float
    slack_linear: float
    slack_quadratic: float
    offset_weight: float
    terminal_weight: float
    max_iterations: int
    estimate_cov: Array
    past: int
    late: tuple[Design, ...]
    assumptions: tuple[AssumptionCheck, ...]
    design_id: str

    @property
    def settles(self) -> int:
        """N, the stage from which a plan rests [steps]."""
        return self.horizon - self.terminal.tau


def make_design(spec: DesignSpec, cost_of: Callable[[Design, Array], float | None] | None = None) -> Design:
    """Choose a schedule, make the terminal ingredients, check Assumption 4.

    Args:
        spec: What is asked for.
        cost_of: Optimal cost of a design from a state (n_x,), None where it is infeasible; rule `search` needs it.

    Raises:
        DesignError: No such design, naming the key, the item of Assumption 4 if one fails, and the figures.
    """
    _check_horizon(spec)
    demand = Demand(spec.link, spec.horizon, spec.tau, spec.delta_x, spec.delta_u, spec.joint)
    terminal = make_terminal(spec.plant, spec.tau, spec.k_tau, spec.q_x, spec.q_u)
    if spec.rule == "fixed":
        return assembled(spec, fixed(demand, spec.delays), terminal)
    if spec.rule == "greedy":
        return assembled(spec, greedy(demand, spec.gamma_max), terminal)
    return _search(spec, demand, terminal, cost_of)


def _check_horizon(spec: DesignSpec) -> None:
    """The mean is at the target from stage N = H - τ on: N steps have to suffice from any state."""
    free, least = spec.horizon - spec.tau, steps_to_reach(spec.plant)
    if free < least:
        raise DesignError(
            "smpc.tau",
            f"tau = {spec.tau} leaves N = {free} free steps of the horizon H = {spec.horizon}, and from any state "
            f"to the target it takes {least}",
            f"take smpc.tau of at most {spec.horizon - least}, or smpc.horizon of at least {spec.tau + least}",
        )


def _search(
    spec: DesignSpec, demand: Demand, terminal: Terminal, cost_of: Callable[[Design, Array], float | None] | None
) -> Design:
    """Least mean cost over the named states among the nested schedules that keep all of them feasible."""
    if cost_of is None:
        raise DesignError("schedule.rule", "rule `search` has no cost to minimise here", "use rule `fixed` or `greedy`")
    if not len(spec.search_states):
        raise DesignError(
            "schedule.search_states", "rule `search` has no states to minimise the cost over", "name some"
        )
    candidates = list(islice(nested(demand, spec.gamma_max), MOST_CANDIDATES + 1))
    if len(candidates) > MOST_CANDIDATES:
        raise DesignError(
            "schedule.rule",
            f"`search` has more than {MOST_CANDIDATES} nested schedules to try at H = {spec.horizon}",
            "take a shorter smpc.horizon, a lower schedule.gamma_max, or rule `greedy`",
        )
    best: tuple[float, Design] | None = None
    refused, why = 0, ""
    for schedule in candidates:
        try:
            design = assembled(spec, schedule, terminal)
        except DesignError as error:  # this schedule's likelihoods ask for more than the limits leave
            refused, why = refused + 1, f": {error.reason}"
            continue
        costs = [cost_of(design, state) for state in spec.search_states]
        known = [cost for cost in costs if cost is not None]
        mean = float(np.mean(known)) if len(known) == len(costs) else np.inf
        if np.isfinite(mean) and (best is None or mean < best[0]):
            best = (mean, design)
    if best is None:
        raise DesignError(
            "schedule.rule",
            f"none of {len(candidates)} nested schedules will do: {refused} fail Assumption 4, "
            f"{len(candidates) - refused} leave one of the {len(spec.search_states)} states infeasible{why}",
            "name states that are easier, raise schedule.gamma_max, or use rule `fixed`",
        )
    return best[1]


def assembled(spec: DesignSpec, schedule: Schedule, terminal: Terminal, past: int = 0) -> Design:
    """The design with a given schedule and terminal law, for positions that are `past` steps old.

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
        # (17) is asked of all times: those of the horizon, and the long run.
        age_within_tau=min(1.0 - spec.link.outage(spec.tau + 1), *(at_most(mu, t, spec.tau) for t in range(len(mu)))),
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
