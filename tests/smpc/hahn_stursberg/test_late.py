"""Re-basing on late positions: against the problem written from the time of capture, and in flight."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from design_rig import one_axis, paper_plant, spec
from loopback_rig import MemorySink, flight, lockstep, make_loop
from optimisation_cases import paper_spec
from scipy.linalg import solve_discrete_lyapunov

from logs.recording.replay import replay
from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.errors import DesignError
from uavctl.records import Decision, Plan, SolveStatus
from uavctl.smpc.answer import Preview
from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec, make_design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.smpc.hahn_stursberg.late import add_late_designs, make_late_design
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutSolver
from uavctl.smpc.link import LatePackets, gilbert_elliott
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_conditioned, build_design, build_solver
from uavctl.wiring.link import build_delayed_link, compute_late_steps


def axis_spec(**changes: Any) -> DesignSpec:
    """The north axis of the paper's example."""
    axis = paper_spec(
        plant=one_axis(paper_plant()),
        state_set=Polytope.from_box([-30.0, -8.0], [50.0, 7.0]),
        input_set=Polytope.from_box([-7.5], [7.5]),
        q_x=np.diag([10.0, 0.1]),
        q_u=0.1 * np.eye(1),
        k_tau=np.array([[-0.058, -1.172]]),
    )
    return replace(axis, **changes)


def from_capture(design: Design, late: int, x: Array, flown: Array) -> tuple[float, float]:
    """(19) from the capture time s = k - j of a position x, with the inputs that were `flown` since (j,) held fixed.

    Stages and disturbances count from s. No gain acts before k, nor before stage k + d_t; rows of stages up to k are
    left out. The terminal condition is Cov(z) ⪯ Σ_z, z = (x_N, u_N …), over the disturbances before N.

    Returns:
        Least cost of all stages from s on, and the part of it that is sunk: stages before k.
    """
    a, b = design.plant.a, design.plant.b
    spread = design.plant.e @ np.sqrt(design.plant.w)  # n_w = 1
    tau, k_tau = design.terminal.tau, design.terminal.k
    steps = late + design.horizon
    free = steps - tau
    v = cp.Variable(steps)
    gains = cp.Variable((steps, steps))
    rules: list[cp.Constraint] = [v[:late] == flown, v[free:] == 0]
    for t in range(steps):
        delay = design.schedule.delays[t - late] if t >= late else steps
        known = t - delay + 1 if t - late >= delay else 0
        rules.append(gains[t, known:] == 0)
    mean: list[Any] = [x]
    noise: list[Any] = [cp.Constant(np.zeros((2, steps)))]
    for t in range(steps):
        enter = np.zeros((2, steps))
        enter[:, t] = spread[:, 0]
        mean.append(a @ mean[-1] + b[:, 0] * v[t])
        noise.append(a @ noise[-1] + b @ cp.reshape(gains[t], (1, steps), order="C") + enter)
    rules.append(mean[free] == 0)
    root_x, root_u = np.sqrt(design.q_x), float(np.sqrt(design.q_u[0, 0]))
    stage = [
        cp.sum_squares(root_x @ mean[t])
        + cp.sum_squares(root_x @ noise[t])
        + cp.sum_squares(root_u * v[t])
        + cp.sum_squares(root_u * gains[t])
        for t in range(steps)
    ]
    values, vectors = np.linalg.eigh(design.terminal.p_xi)
    root_xi = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    terminal = cp.sum_squares(root_xi @ cp.vstack(noise[free:])) + cp.sum_squares(root_xi @ cp.hstack(mean[free:]))
    for t in range(late + 1, free):
        for c, limit in zip(design.state_set.c, design.state_set.b, strict=True):
            rules.append(c @ mean[t] + design.kappa_x[t - late] * cp.norm(c @ noise[t]) <= limit)
    for t in range(late, free):
        for c, limit in zip(design.input_set.c, design.input_set.b, strict=True):
            rules.append(c[0] * v[t] + design.kappa_u[t - late] * cp.norm(c[0] * gains[t]) <= limit)
    # z⁺ = F z + G w under u(t + τ) = K x(t)
    size = 2 + tau
    f, g = np.zeros((size, size)), np.zeros((size, 1))
    f[:2, :2], f[:2, 2] = a, b[:, 0]
    f[2:-1, 3:] = np.eye(tau - 1)
    f[-1, :2] = k_tau[0]
    g[:2] = spread
    sigma_z = solve_discrete_lyapunov(f, g @ g.T)
    z = cp.vstack([noise[free][:, :free], gains[free:, :free]])
    whiten = np.linalg.inv(np.linalg.cholesky(sigma_z)) @ z
    rules.append(cp.bmat([[np.eye(size), whiten], [whiten.T, np.eye(free)]]) >> 0)
    problem = cp.Problem(cp.Minimize(cp.sum(stage) + terminal), rules)
    problem.solve(solver=cp.CLARABEL, tol_gap_rel=1e-10, tol_gap_abs=1e-10, tol_feas=1e-10)
    assert problem.status == cp.OPTIMAL
    return float(problem.value), float(sum(part.value for part in stage[:late]))


@pytest.mark.slow
@pytest.mark.parametrize("late", [1, 2, 5])
@pytest.mark.parametrize(("x", "flown"), [((35.0, -2.0), -3.0), ((-20.0, 3.0), 2.0), ((2.0, 0.0), 0.5)])
def test_a_late_plan_is_the_plan_from_the_capture(late: int, x: tuple[float, float], flown: float) -> None:
    design_spec = axis_spec()
    design = make_design(design_spec)
    made = make_late_design(design, design_spec, late)
    inputs = flown * np.linspace(1.0, 0.4, late)
    now = np.array(x)
    for u in inputs:
        now = design.plant.a @ now + design.plant.b[:, 0] * u
    answer = ConicSolver(made).solve(0, now, np.zeros(2))
    assert answer.status is SolveStatus.OPTIMAL
    assert answer.slack + answer.terminal_miss + answer.offset < 1e-6
    total, sunk = from_capture(made, late, np.array(x), inputs)
    assert answer.cost == pytest.approx(total - sunk, rel=1e-6)


def test_a_delay_of_zero_is_the_design_itself() -> None:
    design_spec = paper_spec()
    design = make_design(design_spec)
    assert make_late_design(design, design_spec, 0) is design
    assert add_late_designs(design, design_spec, 0) is design
    assert build_design(load_config("paper")).late == ()


def test_plans_on_time_have_the_same_bits_with_late_designs() -> None:
    design_spec = paper_spec()
    design = make_design(design_spec)
    both = add_late_designs(design, design_spec, 2)
    assert both.design_id != design.design_id
    assert [late.past for late in both.late] == [1, 2]
    x, target = np.array([35.0, -2.0, -20.0, -4.0]), np.zeros(4)
    solver = ConicSolver(both)
    solver.solve(0, x, target, Preview(age=2))
    item, other = solver.solve(0, x, target), ConicSolver(design).solve(0, x, target)
    assert item.cost == other.cost
    np.testing.assert_array_equal(item.inputs, other.inputs)
    np.testing.assert_array_equal(item.backoff_x, other.backoff_x)
    for age in (3, -1, -2):
        assert solver.solve(0, x, target, Preview(age=age)).status is SolveStatus.FAILED


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "room-hahn-stursberg"])
def test_back_offs_grow_with_the_age(preset: str) -> None:
    """Of every state row, in every stage before the feedback sets in."""
    design_spec = spec(preset)
    solver = ConicSolver(add_late_designs(make_design(design_spec), design_spec, 3))
    target = design_spec.plant.equilibrium(design_spec.target_m)
    answers = [solver.solve(0, target, target, Preview(age=j)) for j in range(4)]
    for younger, older in pairwise(answers):
        assert older.status is SolveStatus.OPTIMAL
        assert older.cost > younger.cost
        assert np.all(older.backoff_x[1:6] > younger.backoff_x[1:6])


def test_the_delays_are_kept_and_the_likelihoods_conditional() -> None:
    """Independent losses: α = 1 - q^min(d, t) counted from now; bursts: a loss now makes the next more likely."""
    design_spec = paper_spec()
    late = make_late_design(make_design(design_spec), design_spec, 3)
    assert late.schedule.delays == (4, 5, 6, 7, 8, 5, 5, 5, 5, 5, 5, 5)  # the first five feed nothing back
    np.testing.assert_allclose(late.schedule.alpha, [1.0] * 5 + [1.0 - 0.3**5] * 7, rtol=1e-12)
    bursts = paper_spec(link=gilbert_elliott(enter=0.05, leave=0.6, good_loss=0.1, bad_loss=0.9))
    design = make_design(bursts)
    ages = [make_late_design(design, bursts, j).schedule.alpha[5] for j in (0, 1, 2)]
    assert ages[0] > ages[1] > ages[2]


def test_joint_likelihoods_are_at_most_those_of_the_product() -> None:
    plain, joint = paper_spec(), paper_spec(joint=True)
    product = make_late_design(make_design(plain), plain, 2).schedule
    exact = make_late_design(make_design(joint), joint, 2).schedule
    assert np.all(exact.gamma_x[1:] <= product.gamma_x[1:] + 1e-12)
    assert exact.gamma_x[-1] < product.gamma_x[-1]


def test_an_age_without_a_design_is_named() -> None:
    # After losses in a row the channel is likely bad, and stays so for long.
    design_spec = paper_spec(link=gilbert_elliott(enter=0.01, leave=0.4, good_loss=0.05, bad_loss=0.95))
    design = make_design(design_spec)
    with pytest.raises(DesignError, match=r"positions of age [123]: .* probability 0\.\d+") as caught:
        add_late_designs(design, design_spec, 3)
    assert caught.value.key in ("smpc.delta_x", "smpc.delta_u")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "steps", "tail"),
    [
        ([], 0, None),
        (["schedule.late=2"], 2, None),
        (["link.delay_s=0.25", "link.jitter_s=0"], 2, [1.0, 1.0, 0.1]),
        (["link.delay_s=0.2", "link.jitter_s=0"], 1, [1.0, 0.1]),
        # Half of the packets take longer than the 0.2 s of a step; all arrive within two.
        (["link.delay_s=0.1", "link.jitter_s=0.2"], 2, [1.0, 0.55, 0.1]),
        (["link.delay_s=0.25", "link.jitter_s=0", "schedule.late=4"], 4, [1.0, 1.0, 0.1, 0.1, 0.1]),
    ],
)
def test_delays_of_a_step_and_more_ask_for_late_designs(
    overrides: list[str], steps: int, tail: list[float] | None
) -> None:
    config = load_config("room-hahn-stursberg", ["link.loss=0.1", *overrides])
    assert compute_late_steps(config) == steps
    link = build_delayed_link(config)
    if tail is None:
        assert link.outage(1) == pytest.approx(0.1)
    else:
        assert isinstance(link, LatePackets)
        np.testing.assert_allclose(link.tail, tail, atol=1e-12)
    assert len(build_design(config).late) == steps


def silent(config: Config, phase: float, steps: int) -> Array:
    """Shares (steps+1,) of 40,000 boundaries for which all positions there are were captured so many Δt before.

    One was captured `phase` of the time between two before the boundary; each is lost, or late, by itself.
    """
    link, rng, gap_s = config.link, np.random.default_rng(11), 1.0 / config.source.rate_hz
    before_s = gap_s * (phase + np.arange(math.ceil(steps * config.plant.dt_s / gap_s) + 1))
    shape = (40_000, len(before_s))
    under_way_s = link.delay_s + link.jitter_s * rng.uniform(size=shape)
    there = (rng.uniform(size=shape) >= link.loss) & (under_way_s <= before_s + 1e-9)
    newest_s = np.where(there, before_s, np.inf).min(axis=1)
    return np.array([np.mean(newest_s >= step * config.plant.dt_s - 1e-9) for step in range(steps + 1)])


CAMERAS = [
    ["plant.dt_s=0.05", "daemon.tick_s=0.01", "source.rate_hz=40", "link.loss=0.6"],
    ["plant.dt_s=0.05", "daemon.tick_s=0.01", "source.rate_hz=40", "link.delay_s=0.1", "link.jitter_s=0"],
    ["plant.dt_s=0.05", "daemon.tick_s=0.01", "source.rate_hz=100", "link.loss=0.8", "link.jitter_s=0.13"],
    ["source.rate_hz=50", "link.loss=0.9", "link.delay_s=0.2", "link.jitter_s=0.3"],
]


@pytest.mark.parametrize("overrides", CAMERAS)
def test_the_age_counts_all_positions_of_a_step_that_a_delay_lets_through(overrides: list[str]) -> None:
    """With one position at each boundary and the longest delay, the model is the age in flight."""
    config = load_config("room-hahn-stursberg", ["smpc.scheme=age-conditioned", *overrides])
    link, measured = build_delayed_link(config), silent(config, 0.0, 6)
    promised = np.array([link.outage(step) for step in range(7)])
    assert np.all(np.abs(measured - promised) <= 5.0 * np.sqrt(promised * (1.0 - promised) / 40_000) + 1e-12)


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.8])
@pytest.mark.parametrize(
    "overrides",
    [
        *CAMERAS,
        ["plant.dt_s=0.05", "daemon.tick_s=0.01", "source.rate_hz=50", "link.loss=0.6"],
        ["plant.dt_s=0.2", "source.rate_hz=50", "link.loss=0.8"],
        ["plant.dt_s=0.2", "source.rate_hz=12", "link.loss=0.6"],
        # None is sure to come within its step, and one or the other does.
        ["plant.dt_s=0.05", "daemon.tick_s=0.01", "source.rate_hz=50", "link.delay_s=0.04", "link.jitter_s=0"],
    ],
)
def test_no_age_is_more_frequent_than_by_design(overrides: list[str], phase: float) -> None:
    config = load_config("room-hahn-stursberg", ["smpc.scheme=age-conditioned", *overrides])
    one_a_step = load_config("room-hahn-stursberg", ["smpc.scheme=age-conditioned", *overrides, "source.rate_hz=0"])
    link, measured = build_delayed_link(config), silent(config, phase, 6)
    promised = np.array([link.outage(step) for step in range(7)])
    assert np.all(measured <= promised + 5.0 * np.sqrt(promised * (1.0 - promised) / 40_000) + 1e-12)
    assert promised[6] < 0.5 * build_delayed_link(one_a_step).outage(6)


@pytest.mark.long
@pytest.mark.parametrize("phase", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("overrides", CAMERAS)
def test_younger_positions_than_by_design_use_no_more_risk(overrides: list[str], phase: float) -> None:
    """The model has the longest delays: an age that it excludes must not get a larger budget."""
    config = load_config("room-hahn-stursberg", ["smpc.scheme=age-conditioned", "smpc.horizon=48", *overrides])
    risk = build_conditioned(config).solver.risk
    measured = silent(config, phase, 12)
    spent = (measured[:-1] - measured[1:]) @ risk.budgets[:12] + measured[-1]
    assert (np.diff(risk.budgets) >= 0.0).all()
    assert spent <= 1.0 - config.smpc.delta_x + 5.0 * np.sqrt(0.05 / 40_000)


@pytest.mark.parametrize(
    ("overrides", "key", "figures"),
    [
        (["link.delay_s=0.25", "link.model=gilbert-elliott"], "link.delay_s", r"0\.29 s, the step is 0\.2 s"),
        (["link.delay_s=0.25", "link.probability=[0.9]"], "link.delay_s", "independent losses only"),
        (["link.delay_s=0.25", "source.rate_hz=4"], "source.rate_hz", "4 positions a second are not one a step"),
        (["link.delay_s=0.25", "link.loss=0.3"], "smpc.delta_x", r"out of reach"),
    ],
)
def test_delays_without_a_design_are_refused(overrides: list[str], key: str, figures: str) -> None:
    with pytest.raises(DesignError, match=figures) as caught:
        build_design(load_config("room-hahn-stursberg", overrides))
    assert caught.value.key == key


def test_the_printed_solver_refuses_late_positions() -> None:
    for overrides in (["schedule.late=1", "risk.estimate=exact"], ["risk.estimate=innovations"]):
        config = load_config("room-hahn-stursberg", ["solver.method=printed", *overrides])
        with pytest.raises(DesignError) as caught:
            build_solver(build_design(config), config)
        assert caught.value.key == "solver.method"


# All plans go to the same target: no axis leads.
LATE = ("link.delay_s=0.25", "link.loss=0.1", "clock.latency_s=0.25", "envelope.lead_s=0")


@pytest.fixture(scope="module")
def late_flight() -> MemorySink:
    return lockstep("room-hahn-stursberg", 12.0, *LATE)


@pytest.mark.slow
def test_a_flight_on_late_positions_plans_with_their_age(late_flight: MemorySink) -> None:
    config = load_config("room-hahn-stursberg", list(LATE))
    design = build_design(config)
    solver = ShortcutSolver(design)
    ages = {decision.step: decision.age_steps for decision in late_flight.of(Decision) if decision.boundary}
    plans = late_flight.of(Plan)
    assert len(plans) > 40
    assert {ages[plan.seq] for plan in plans} == {1}
    assert max(age for age in ages.values() if age is not None) >= 2
    for plan in plans[:: len(plans) // 5]:
        x, target = np.array(plan.states[0]), design.target
        late = solver.solve(plan.seq, x, target, Preview(age=1))
        # The solver plans what acts in all, of which the estimated bias is there without us.
        np.testing.assert_array_equal(np.array(plan.inputs), late.inputs - np.array(plan.bias))
        on_time = solver.solve(plan.seq, x, target)
        backoff = np.array(plan.backoff_x)
        assert np.all(backoff[1:6] > on_time.backoff_x[1:6])


@pytest.mark.slow
def test_a_flight_on_late_positions_keeps_its_limits(late_flight: MemorySink) -> None:
    config = load_config("room-hahn-stursberg", list(LATE))
    lower, upper = np.array(config.sets.state_lower), np.array(config.sets.state_upper)
    data = flight(late_flight)
    positions = np.array([truth.position_m for truth in data.truths])
    assert np.all(positions >= lower[[0, 3, 6]])
    assert np.all(positions <= upper[[0, 3, 6]])
    assert all(plan.slack < 1e-6 and plan.terminal_miss < 1e-6 for plan in late_flight.of(Plan))
    assert np.linalg.norm(positions[-1] - np.array(config.target.position_m)) < 0.3


@pytest.mark.slow
def test_a_flight_on_late_positions_replays(late_flight: MemorySink) -> None:
    config = load_config("room-hahn-stursberg", ["duration_s=12.0", *LATE])
    assert replay(late_flight.entries, lambda sink: make_loop(config, sink)).identical
