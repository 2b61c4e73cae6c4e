"""The cost bound without limits: closed forms, least squares, and simulated costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from baseline_rig import MAKERS, PAPER_START, arrivals, flown, noise, problem, unlimited
from design_rig import one_axis, paper_plant
from scipy.linalg import solve_discrete_lyapunov

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.baselines import Lqg
from uavctl.smpc.link import LatePackets, LinkModel, bernoulli, empirical, gilbert_elliott
from uavctl.smpc.lqg_bound import stationary_bound
from uavctl.smpc.nominal import lqr
from uavctl.smpc.plant import Plant

STEPS = 50


def growing(factor: float) -> Plant:
    """One state that grows by a factor a step, as position and as velocity."""
    item = np.ones((1, 1))
    return Plant(
        a=factor * item,
        b=item,
        e=item,
        w=0.5 * item,
        dt_s=1.0,
        axes=("north",),
        position_index=(0,),
        velocity_index=(0,),
        accel_per_input=np.ones(1),
    )


def prices(plant: Plant, q_x: Array, q_u: Array) -> tuple[float, Array, Array]:
    """Return the cost of a known state, the weight M of its error, and E W E'."""
    best = lqr(plant, q_x, q_u)
    spread = plant.e @ plant.w @ plant.e.T
    price = plant.a.T @ best.p @ plant.a + q_x - best.p  # = A'PB (R + B'PB)^-1 B'PA, by Riccati's equation
    return float(np.trace(best.p @ spread)), price, spread


@pytest.mark.parametrize("loss", [0.1, 0.3, 0.7, 0.9])
@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_independent_losses_are_a_lyapunov_equation(name: str, loss: float) -> None:
    case = problem(name)
    known, price, spread = prices(case.plant, case.q_x, case.q_u)
    error = loss * solve_discrete_lyapunov(np.sqrt(loss) * case.plant.a, spread)
    bound = stationary_bound(case.plant, case.q_x, case.q_u, bernoulli(np.array([1.0 - loss])))
    assert bound == pytest.approx(known + float(np.sum(price * error)), rel=1e-9)


def test_the_paper_s_example_costs_at_least_10_67_an_axis() -> None:
    case = problem("paper")
    bound = stationary_bound(case.plant, case.q_x, case.q_u, bernoulli(np.array([0.7])))
    assert bound / 2 == pytest.approx(10.6666, abs=5e-5)


@pytest.mark.parametrize(
    "link",
    [
        gilbert_elliott(enter=0.1, leave=0.4, good_loss=0.1, bad_loss=0.9),
        empirical(np.array([0.6, 0.2, 0.1, 0.1])),
        LatePackets(np.array([1.0, 0.5, 0.2])),
    ],
    ids=["bursts", "measured runs", "late"],
)
def test_other_links_count_by_their_stationary_age(link: LinkModel) -> None:
    """The mean over the ages, j of P(a = j) Σ_{i<j} A^i N A'^i, from the chain of the age itself."""
    case = problem("paper")
    known, price, spread = prices(case.plant, case.q_x, case.q_u)
    ages = link.age(300)[-1]
    error, grown, mean = np.zeros_like(spread), spread, np.zeros_like(spread)
    for share in ages:
        mean = mean + share * error
        error, grown = error + grown, case.plant.a @ grown @ case.plant.a.T
    bound = stationary_bound(case.plant, case.q_x, case.q_u, link)
    assert bound == pytest.approx(known + float(np.sum(price * mean)), rel=1e-9)


def test_lqg_without_limits_costs_the_bound_and_would_break_them_in_7_percent_of_steps() -> None:
    case, runs, steps, burn = problem("paper"), 600, 220, 20
    free = unlimited(case)
    result = flown(free, Lqg(free), np.zeros(4), arrivals(runs, steps, 0.3, 1), noise(case, runs, steps, 2))
    mean = result.cost[:, burn:].mean(axis=1)
    bound = stationary_bound(case.plant, case.q_x, case.q_u, bernoulli(np.array([0.7])))
    assert abs(mean.mean() - bound) < 3.0 * mean.std() / np.sqrt(runs)
    outside = np.abs(result.requested[:, burn:]) > 7.5  # of each axis by itself
    assert outside.mean() == pytest.approx(0.075, abs=0.004)


def test_no_bound_where_the_error_grows_faster_than_losses_end() -> None:
    q = np.eye(1)
    with pytest.raises(DesignError, match="no bound") as refused:
        stationary_bound(growing(1.5), q, q, bernoulli(np.array([0.5])))  # 0.5 · 1.5² > 1
    assert refused.value.key == "link.loss"
    bound = stationary_bound(growing(1.5), q, q, bernoulli(np.array([0.6])))  # 0.4 · 1.5² = 0.9
    known, price, spread = prices(growing(1.5), q, q)
    assert bound == pytest.approx(known + float(price[0, 0] * 0.4 * spread[0, 0] / (1.0 - 0.9)), rel=1e-9)
    with pytest.raises(DesignError, match="no bound"):
        stationary_bound(growing(1.0), q, q, bernoulli(np.array([0.0])))  # nothing ever arrives


def test_no_regulator_no_bound() -> None:
    plant = growing(1.5)
    stuck = replace(plant, b=np.zeros((1, 1)))
    with pytest.raises(DesignError, match="Riccati"):
        stationary_bound(stuck, np.eye(1), np.eye(1), bernoulli(np.array([0.9])))


def stacked(plant: Plant, steps: int) -> tuple[Array, Array]:
    """x_0 … x_{T-1} (T, n_x, …) from x_0 and from u_0 … u_{T-2} (n_u (T-1) columns)."""
    of_x = np.array([np.linalg.matrix_power(plant.a, t) for t in range(steps)])
    of_u = np.zeros((steps, plant.n_x, steps, plant.n_u))
    for t in range(steps):
        for s in range(t):
            of_u[t, :, s] = np.linalg.matrix_power(plant.a, t - 1 - s) @ plant.b
    return of_x, of_u.reshape(steps, plant.n_x, -1)


def finite_bound(plant: Plant, q_x: Array, q_u: Array, x0: Array, target: Array, u_target: Array, ages: Array) -> float:
    """Least expected sum of T stage costs (x - x_target)'Q_x(…) + (u - u_target)'Q_u(…), k = 0 … T-1.

    Args:
        q_x: Q_x (n_x, n_x).
        q_u: Q_u (n_u, n_u), positive definite.
        x0: The state at first (n_x,), which is known.
        target: x_target (n_x,), at rest under u_target.
        u_target: (n_u,).
        ages: Distribution of the age in each step (T, A): P(a(k) = j), as of `LinkModel.age`.
    """
    noise = plant.e @ plant.w @ plant.e.T
    errors = _errors(plant, noise, ages)
    p, cost = np.zeros_like(plant.a), 0.0
    for error in errors[::-1]:
        cost += float(np.sum(p * noise))
        forward = plant.b.T @ p @ plant.a
        price = forward.T @ np.linalg.solve(q_u + plant.b.T @ p @ plant.b, forward)
        cost += float(np.sum(price * error))
        p = q_x + plant.a.T @ p @ plant.a - price
        p = (p + p.T) / 2
    start = x0 - target
    return cost + float(start @ p @ start)


def _errors(plant: Plant, noise: Array, ages: Array) -> Array:
    """Covariance of the error of the state's mean in each step (T, n_x, n_x)."""
    older = 1.0 - np.cumsum(ages, axis=1)  # P(a(k) > j)
    errors, grown = np.zeros((len(ages), *noise.shape)), noise
    for older_than in older.T:
        errors += np.maximum(older_than, 0.0)[:, None, None] * grown
        grown = plant.a @ grown @ plant.a.T
    return errors


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg", "coupled 0"])
def test_without_positions_the_finite_bound_is_least_squares_and_open_loop_covariance(name: str) -> None:
    case, steps = problem(name), 9
    plant = case.plant
    x0 = case.target + np.random.default_rng(3).normal(size=plant.n_x)
    ages = np.eye(steps)  # a(k) = k
    of_x, of_u = stacked(plant, steps)
    root_x, root_u = np.linalg.cholesky(case.q_x).T, np.linalg.cholesky(case.q_u).T
    matrix = np.vstack([root_x @ each for each in of_u] + [np.kron(np.eye(steps), root_u)])
    drift = np.concatenate([root_x @ each @ (x0 - case.target) for each in of_x] + [np.zeros(steps * plant.n_u)])
    plan = np.linalg.lstsq(matrix, -drift, rcond=None)[0]
    cost, spread = float(np.sum((matrix @ plan + drift) ** 2)), np.zeros_like(plant.a)
    for _ in range(steps):
        cost += float(np.sum(case.q_x * spread))
        spread = plant.a @ spread @ plant.a.T + plant.e @ plant.w @ plant.e.T
    bound = finite_bound(plant, case.q_x, case.q_u, x0, case.target, case.u_target, ages)
    assert bound == pytest.approx(cost, rel=1e-9)


def gains_backwards(plant: Plant, q_x: Array, q_u: Array, steps: int) -> list[Array]:
    p, gains = np.zeros_like(plant.a), []
    for _ in range(steps):
        gain = -np.linalg.inv(q_u + plant.b.T @ p @ plant.b) @ plant.b.T @ p @ plant.a
        gains.append(np.asarray(gain, dtype=np.float64))
        loop = plant.a + plant.b @ gain
        p = q_x + gain.T @ q_u @ gain + loop.T @ p @ loop
    return gains[::-1]


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.7])
def test_the_best_law_of_a_finite_flight_costs_the_finite_bound(loss: float) -> None:
    """Simulated with its own estimator, step by step: with loss 0, in 3 standard errors as with others."""
    plant, q_x, q_u, steps, runs = one_axis(paper_plant()), np.diag([10.0, 0.1]), 0.1 * np.eye(1), 20, 4000
    x0 = np.array([3.0, -1.0])
    rng = np.random.default_rng(11)
    x, mean, cost = np.tile(x0, (runs, 1)), np.tile(x0, (runs, 1)), np.zeros(runs)
    for k, gain in enumerate(gains_backwards(plant, q_x, q_u, steps)):
        arrived = rng.random(runs) >= (loss if k else 0.0)
        mean = np.where(arrived[:, None], x, mean)
        u = mean @ gain.T
        cost += np.sum(x @ q_x * x, axis=1) + np.sum(u @ q_u * u, axis=1)
        x = x @ plant.a.T + u @ plant.b.T + np.sqrt(0.6) * rng.standard_normal((runs, 1)) @ plant.e.T
        mean = mean @ plant.a.T + u @ plant.b.T
    ages = bernoulli(np.array([1.0 - loss])).age(steps - 1)
    bound = finite_bound(plant, q_x, q_u, x0, np.zeros(2), np.zeros(1), ages)
    assert abs(cost.mean() - bound) < 3.0 * cost.std() / np.sqrt(runs)


def test_one_step_more_of_a_long_flight_costs_the_stationary_bound() -> None:
    case, link = problem("paper"), bernoulli(np.array([0.7]))
    ages = link.age(120)
    longer, shorter = (
        finite_bound(case.plant, case.q_x, case.q_u, PAPER_START, case.target, case.u_target, ages[:steps])
        for steps in (121, 120)
    )
    bound = stationary_bound(case.plant, case.q_x, case.q_u, link)
    assert longer - shorter == pytest.approx(bound, rel=1e-6)


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("loss", [0.3, 0.6])
def test_no_controller_beats_the_bound(name: str, loss: float) -> None:
    case, runs = unlimited(problem("paper")), 300
    newest, disturbances = arrivals(runs, STEPS, loss, 5), noise(case, runs, STEPS, 6)
    cost = flown(case, MAKERS[name](case), PAPER_START, newest, disturbances).cost.sum(axis=1)
    ages = bernoulli(np.array([1.0 - loss])).age(STEPS - 1)
    bound = finite_bound(case.plant, case.q_x, case.q_u, PAPER_START, case.target, case.u_target, ages)
    assert cost.mean() > bound - 3.0 * cost.std() / np.sqrt(runs)
    if name in ("lqg", "packetised"):  # both are the best there is, but for the end of the flight
        assert cost.mean() < bound * 1.01 + 3.0 * cost.std() / np.sqrt(runs)
