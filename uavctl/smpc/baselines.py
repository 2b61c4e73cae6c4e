"""Baseline controllers on the same plant, weights, limits, noise and losses as the SMPC.

1. On receipt: constrained MPC plans from each new position. In silence it plays the plan out, holds its first input, or
   sends u_target. `MeanQp` adds open-loop back-offs.
2. Worst-case delay: the mean x̂ is always predicted over d steps. Its error is S = Σ_{i<d} A^i N A'^i, and A^d E w(k-d)
   moves it in each step. Under u = mean + K_ρ (x̂ - mean), stage t of a plan has the covariance S + Z_t and its input
   K_ρ Z_t K_ρ', with

       Z_{t+1} = (A + B K_ρ) Z_t (A + B K_ρ)' + A^d N A'^d,   Z_0 = 0

   Rows keep κ σ. K_ρ is the regulator for the input weight ρ R, with the least ρ whose spread at the target takes
   `_MAX_SHARE` of the room; the full gain needs more input than there is.
3. Governor: the regulator on the predicted mean, whose next mean keeps a margin from the state limits.
4. LQG: the regulator on the predicted mean, without limits.
5. Cascaded PID: position P, velocity PID, each axis alone, on the newest measurement, as in the usual autopilot. Its
   gains are tuned on the scene that they fly in: a coarse grid, the same for all axes, then a cross-entropy search
   (Rubinstein 1999) over the logarithms of all gains. Each generation lies around the elite of the last one. Every
   candidate has the same noise and losses, and the draws have their own seed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.batch import Counts, Information, predict
from uavctl.smpc.nominal import BatchMpc, ControlProblem, Part, find_parts, lqr, propagate_covariance, row_deviations
from uavctl.smpc.qp import SOFT, QuadraticProgram

Index = NDArray[np.intp]


class _OnReceipt(ABC):
    """Makes a new plan from each newer position; a late one is predicted to now first.

    Args:
        margin: Distance of plans from the state limits, in standard deviations of one step's disturbance.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float = 0.0) -> None:
        self._problem = problem
        self._mpc = self._make_planner(margin)
        self.begin(0)

    def _make_planner(self, margin: float) -> BatchMpc:
        """Make the planner, its limits tightened by `margin` standard deviations."""
        plant = self._problem.plant
        step = plant.e @ plant.w @ plant.e.T
        return BatchMpc(self._problem, margin * row_deviations(self._problem.state_set, step))

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        self._plans = np.zeros((runs, self._problem.horizon, self._problem.plant.n_u))
        self._plan_step = np.zeros(runs, dtype=np.intp)
        self._captured = np.full(runs, -1, dtype=np.intp)

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        (has_new,) = np.nonzero(information.newest > self._captured)
        # x(0) is always known, so each run has a plan from the first step on.
        self._plans[has_new] = self._mpc.compute_plans(predict(self._problem.plant, information)[has_new])
        self._plan_step[has_new] = information.step
        self._captured[has_new] = information.newest[has_new]
        return self._select_inputs(information.step - self._plan_step)

    @abstractmethod
    def _select_inputs(self, index: Index, /) -> Array:
        """Return the inputs (N, n_u) of plans that were made `index` (N,) steps ago."""


class PacketisedPredictive(_OnReceipt):
    """Certainty-equivalent packetised predictive control: plays the plan out, then sends u_target.

    The receiver's buffer of Quevedo and Nešić (2011, Input-to-state stability of packetized predictive control over
    unreliable networks), with the losses before the controller instead of after it.
    """

    def _select_inputs(self, index: Index, /) -> Array:
        steps = self._problem.horizon
        inputs = self._plans[np.arange(index.size), np.minimum(index, steps - 1)]
        return np.where((index < steps)[:, None], inputs, self._problem.u_target)


class HoldLast(_OnReceipt):
    """Holds the plan's first input until the next position arrives."""

    def _select_inputs(self, _index: Index, /) -> Array:
        return self._plans[:, 0].copy()


class ZeroOnLoss(_OnReceipt):
    """Sends the plan's first input for one step, then u_target until the next position arrives."""

    def _select_inputs(self, index: Index, /) -> Array:
        return np.where((index == 0)[:, None], self._plans[:, 0], self._problem.u_target)


class MeanQp(PacketisedPredictive):
    """Packetised predictive control with open-loop back-offs: stage t keeps κ σ_t from the state limits.

    σ_t is the standard deviation of a prediction over t steps; κ is the same for every age.

    Args:
        cov: Covariance (n_x, n_x) of the newest known state in a filter without losses; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float, cov: Array | None = None) -> None:
        self._cov = cov
        super().__init__(problem, margin)

    def _make_planner(self, margin: float) -> BatchMpc:
        problem = self._problem
        spread = propagate_covariance(problem.plant, problem.horizon, self._cov)
        return BatchMpc(problem, margin * np.array([row_deviations(problem.state_set, cov) for cov in spread]))


_MAX_SHARE = 0.5  # share of the room that the spread at the target may take
_INPUT_WEIGHTS = 2.0 ** np.arange(0, 21)


class WorstCaseDelay:
    """Holds positions back until they are `delay` steps old, predicts the mean from there, and plans in each step.

    Args:
        delay: d >= 1 [steps].
        kappa_x: κ of the state rows, see `risk.kappa`.

    Raises:
        DesignError: The spread leaves no room around the target, or the plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, delay: int, kappa_x: float, kappa_u: float) -> None:
        if delay < 1:
            raise DesignError("smpc.tau", f"{delay} is no delay", "give at least 1 step")
        self._problem, self._delay = problem, delay
        self._mpc = BatchMpc(problem, *_backoffs(problem, delay, kappa_x, kappa_u))
        self.begin(0)

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        n_x = self._problem.plant.n_x
        # Positions that are not old enough yet, by their capture step modulo the length
        self._waiting = np.full((runs, self._delay + 1), -1, dtype=np.intp)
        self._states = np.zeros((runs, self._delay + 1, n_x))
        self._used, self._state = np.zeros(runs, dtype=np.intp), np.zeros((runs, n_x))

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        self._update_used(information)
        x = predict(self._problem.plant, Information(information.step, self._used, self._state, information.inputs))
        first: Array = self._mpc.compute_plans(x)[:, 0]
        return first

    def _update_used(self, information: Information) -> None:
        """Use the newest position that is old enough; x(0) is known at first."""
        runs, slot = np.arange(len(information.newest)), information.newest % (self._delay + 1)
        self._waiting[runs, slot], self._states[runs, slot] = information.newest, information.state
        if information.step == 0:
            self._state = information.state.copy()
            return
        due = information.step - self._delay
        old = np.where((self._waiting >= 0) & (self._waiting <= due), self._waiting, -1)
        best = old.argmax(axis=1)
        newer = np.flatnonzero(old[runs, best] > self._used)
        self._used[newer] = old[newer, best[newer]]
        self._state[newer] = self._states[newer, best[newer]]


def _backoffs(problem: ControlProblem, delay: int, kappa_x: float, kappa_u: float) -> tuple[Array, Array]:
    """Return the back-offs of the rows: states (H+1, m_x), inputs (H, m_u)."""
    plant = problem.plant
    step = plant.e @ plant.w @ plant.e.T
    # S = Σ_{i<d} A^i N A'^i,  step = A^d N A'^d
    error = np.zeros_like(step)
    for _ in range(delay):
        error, step = error + step, plant.a @ step @ plant.a.T
    k = _prediction_gain(problem, error, step, kappa_x, kappa_u)
    loop, spread = plant.a + plant.b @ k, np.zeros_like(step)
    # κ_x (c'(S + Z_t)c)^½,  κ_u (c'K_ρ Z_t K_ρ'c)^½
    backoff_x, backoff_u = [], []
    for _ in range(problem.horizon + 1):
        backoff_x.append(kappa_x * row_deviations(problem.state_set, error + spread))
        backoff_u.append(kappa_u * row_deviations(problem.input_set, k @ spread @ k.T))
        spread = loop @ spread @ loop.T + step
    return np.array(backoff_x), np.array(backoff_u[:-1])


def _prediction_gain(problem: ControlProblem, error: Array, step: Array, kappa_x: float, kappa_u: float) -> Array:
    """Return K_ρ; if no ρ leaves enough room, the one that leaves most."""
    plant, best = problem.plant, (np.inf, np.zeros((problem.plant.n_u, problem.plant.n_x)))
    room_x, room_u = problem.state_set.margin(problem.target), problem.input_set.margin(problem.u_target)
    for weight in _INPUT_WEIGHTS:
        k = lqr(plant, problem.q_x, weight * problem.q_u).k
        # Z = (A + B K_ρ) Z (A + B K_ρ)' + A^d N A'^d
        spread = solve_discrete_lyapunov(plant.a + plant.b @ k, step)
        share = max(
            _find_largest_share(kappa_x * row_deviations(problem.state_set, error + spread), room_x),
            _find_largest_share(kappa_u * row_deviations(problem.input_set, k @ spread @ k.T), room_u),
        )
        if share < best[0]:
            best = (share, k)
        if share <= _MAX_SHARE:
            break
    if best[0] >= 1.0:
        raise DesignError(
            "smpc.tau",
            f"a constant delay spreads the state over {best[0]:.3g} times the room that the limits leave at the target",
            "take a shorter smpc.tau, or wider limits",
        )
    return best[1]


def _find_largest_share(backoff: Array, room: Array) -> float:
    """Return the largest share of the room that a back-off takes."""
    shares = np.divide(backoff, room, out=np.full(room.size, np.inf), where=room > 0.0)
    return float(shares.max(initial=0.0))


class Governor:
    """Sends the input nearest to the regulator's for which the mean of the next state keeps a margin.

    The margin is a number of standard deviations of a prediction one step longer than the age. State rows are soft.

    Args:
        cov: Covariance (n_x, n_x) of the newest known state in a filter without losses; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float, cov: Array | None = None) -> None:
        self._problem, self._margin, self._cov = problem, margin, cov
        self._law = lqr(problem.plant, problem.q_x, problem.q_u)
        self._parts = [_PartStep(problem, part) for part in find_parts(problem)]
        self._low, self._high = problem.input_set.bounds
        self._backoffs = np.zeros((1, problem.state_set.b.size))

    def begin(self, runs: int) -> None:
        """See `BatchController`."""

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        problem = self._problem
        plant, x = problem.plant, predict(problem.plant, information)
        # u = u_s + K (x̂ - x_s);  c'(A x̂ + B u) + margin σ_{a+1} <= b
        inputs = np.clip(problem.u_target + (x - problem.target) @ self._law.k.T, self._low, self._high)
        backoff = self._extend_backoffs(int(information.age.max(initial=0)) + 1)[information.age + 1]
        drift = x @ plant.a.T @ problem.state_set.c.T
        room = problem.state_set.b - backoff - drift
        violated = inputs @ (problem.state_set.c @ plant.b).T > room
        for i in np.flatnonzero(violated.any(axis=1) & np.isfinite(x).all(axis=1)):
            for part in self._parts:
                part.move(inputs[i], room[i])
        return inputs

    def _extend_backoffs(self, age: int) -> Array:
        """Return the margins (…, m_x) of means that are 0, 1 … `age` steps old or more."""
        if len(self._backoffs) <= age:
            limits, spread = self._problem.state_set, propagate_covariance(self._problem.plant, 2 * age, self._cov)
            self._backoffs = self._margin * np.array([row_deviations(limits, cov) for cov in spread])
        return self._backoffs


class _PartStep:
    """One independent part of one step."""

    def __init__(self, problem: ControlProblem, part: Part) -> None:
        self._part = part
        u_rows = (
            problem.state_set.c[np.ix_(part.rows_x, part.states)] @ problem.plant.b[np.ix_(part.states, part.inputs)]
        )
        (used,) = np.nonzero(np.any(u_rows != 0.0, axis=1))
        self._rows, hard = part.rows_x[used], problem.input_set.c[np.ix_(part.rows_u, part.inputs)]
        rows, self._sides = np.vstack([u_rows[used], hard]), problem.input_set.b[part.rows_u]
        soft = np.arange(len(rows)) < used.size
        self._program = QuadraticProgram(
            2.0 * np.eye(part.inputs.size),
            np.ascontiguousarray(rows),
            np.where(soft, SOFT, 0).astype(np.int32),
            np.where(soft, problem.slack_linear, 0.0),
            np.where(soft, problem.slack_quadratic, 0.0),
        )

    def move(self, inputs: Array, room: Array) -> None:
        """Move the part's inputs in `inputs` (n_u,) until the rows keep `room` (m_x,)."""
        sides = np.concatenate([room[self._rows], self._sides])
        u = inputs[self._part.inputs]
        solved = self._program.solve(-2.0 * u, sides, np.full(sides.size, -np.inf))
        inputs[self._part.inputs] = np.nan if solved is None else solved[0]


class Lqg:
    """Infinite-horizon LQG; the newest state is exact, so the Kalman filter is the prediction from it.

    Without limits no controller costs less (see `stationary_bound`). Its inputs are not clipped.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem) -> None:
        self._problem = problem
        self._k = lqr(problem.plant, problem.q_x, problem.q_u).k

    def begin(self, runs: int) -> None:
        """See `BatchController`."""

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        deviation = predict(self._problem.plant, information) - self._problem.target
        inputs: Array = self._problem.u_target + deviation @ self._k.T
        return inputs


Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PidGains:
    """Gains of each axis (n_axes,), or of each axis of each run (N, n_axes)."""

    position_1ps: Array  # speed setpoint per distance to the target [1/s]
    velocity_1ps: Array  # acceleration per error of the speed [1/s]
    integral_1ps2: Array  # acceleration per integral of this error [1/s²]
    derivative: Array  # acceleration subtracted per measured acceleration
    speed: Array  # largest speed setpoint, as a share of the velocity limits


class CascadedPid:
    """Position and velocity loops as in an autopilot; outputs saturate at the input limits.

    A lost position changes neither measurement nor integral. The integral also stops while the output is at a limit and
    the error would drive it further.

    Args:
        problem: The problem; axes and accelerations are those of its plant.
        gains: The gains, see `pid_tuning.tune`.
    """

    def __init__(self, problem: ControlProblem, gains: PidGains) -> None:
        plant = problem.plant
        self._problem, self._gains = problem, gains
        self._position, self._velocity = list(plant.position_index), list(plant.velocity_index)
        low, high = problem.state_set.bounds
        self._slowest, self._fastest = np.minimum(low[self._velocity], 0.0), np.maximum(high[self._velocity], 0.0)
        self._accel_of_input, self._input_of_accel = plant.accel_map, np.linalg.pinv(plant.accel_map)
        self._low, self._high = problem.input_set.bounds
        self.begin(0)

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        axes = len(self._position)
        self._integral, self._accel, self._last = np.zeros((3, runs, axes))
        self._captured = np.full(runs, -1, dtype=np.intp)

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        gains, target, dt_s = self._gains, self._problem.target, self._problem.plant.dt_s
        has_new = (information.newest > self._captured)[:, None]
        position, velocity = information.state[:, self._position], information.state[:, self._velocity]
        self._differentiate(information, velocity, has_new)
        speed = gains.position_1ps * (target[self._position] - position)
        # v_set = clip(kp (p_s - p), ± share of the limits); an infinite limit clips nothing
        speed = np.clip(speed, gains.speed * self._slowest, gains.speed * self._fastest)
        error = target[self._velocity] + speed - velocity
        next_integral = self._integral + np.where(has_new, gains.integral_1ps2 * error * dt_s, 0.0)
        proportional = gains.velocity_1ps * error - gains.derivative * self._accel
        saturation = proportional + next_integral - self._saturate_accel(proportional + next_integral)
        winds_up = saturation * error > 0.0
        self._integral = np.where(winds_up, self._integral, next_integral)
        return self._saturate_input(proportional + self._integral)

    def _differentiate(self, information: Information, velocity: Array, has_new: Flags) -> None:
        """Update the acceleration from the two newest velocities."""
        span_s = np.maximum(information.newest - self._captured, 1)[:, None] * self._problem.plant.dt_s
        has_two = has_new & (self._captured >= 0)[:, None]
        self._accel = np.where(has_two, (velocity - self._last) / span_s, self._accel)
        self._last = np.where(has_new, velocity, self._last)
        self._captured = np.maximum(self._captured, information.newest)

    def _saturate_input(self, accel: Array) -> Array:
        """Return the input (N, n_u) of an acceleration (N, n_axes), clipped to its limits."""
        return np.clip(self._problem.u_target + accel @ self._input_of_accel.T, self._low, self._high)

    def _saturate_accel(self, accel: Array) -> Array:
        """Return the acceleration that the limits leave; a part that no input can produce counts as produced."""
        inputs = self._problem.u_target + accel @ self._input_of_accel.T
        lost: Array = (inputs - np.clip(inputs, self._low, self._high)) @ self._accel_of_input.T
        return accel - lost


Cost = Callable[[Array], Array]

# Grid: rates in 1/Δt, the integral as shares of the product of both loops' gains
_POSITION = (0.03, 0.06, 0.12, 0.25, 0.5)
_VELOCITY = (0.05, 0.1, 0.2, 0.4, 0.8)
_INTEGRAL, _DERIVATIVE, _SPEED = (0.01, 0.1), 0.02, (0.6, 1.0)
_GENERATIONS, _CANDIDATES, _ELITE = 25, 40, 8
_WIDTH = 0.8  # standard deviation of the first generation's logarithms
_SMOOTHING = 0.3  # weight of the last generation's width in the next one; the rest is that of the elite
_SEED = 0


def tune(problem: ControlProblem, start: Array, newest: Counts, disturbances: Array) -> PidGains:
    """Tune the gains for the least mean summed stage cost, with soft state limits.

    Args:
        start: x(0) (n_x,).
        newest: Capture step of the newest position known in each step (N, T) of N runs to tune on.
        disturbances: w (N, T, n_w) of these runs.
    """
    axes = len(problem.plant.axes)

    def cost(candidates: Array) -> Array:
        return _evaluate(problem, candidates.reshape(-1, 5, axes), start, newest, disturbances)

    return _make_gains(_search(_search_grid(problem.plant.dt_s, axes, cost), cost).reshape(5, axes))


def _search_grid(dt_s: float, axes: int, cost: Cost) -> Array:
    """Return the best gains of the grid (5 n_axes,)."""
    grid = np.array(
        [
            [p / dt_s, v / dt_s, share * p * v / dt_s**2, _DERIVATIVE, speed]
            for p, v, share, speed in product(_POSITION, _VELOCITY, _INTEGRAL, _SPEED)
        ]
    )
    candidates = np.repeat(grid, axes, axis=1)
    best: Array = candidates[np.argmin(cost(candidates))]
    return best


def _search(best: Array, cost: Cost) -> Array:
    """Search from `best` (n,) on and return the best point."""
    rng = np.random.default_rng(_SEED)
    lowest_cost = float(cost(best[np.newaxis])[0])
    mean, width = np.log(best), np.full(best.size, _WIDTH)
    for _ in range(_GENERATIONS):
        samples = mean + width * rng.standard_normal((_CANDIDATES, best.size))
        costs = cost(np.exp(samples))
        elite = samples[np.argsort(costs, kind="stable")[:_ELITE]]
        if costs.min() < lowest_cost:
            lowest_cost, best = float(costs.min()), np.exp(elite[0])
        mean, width = elite.mean(axis=0), _SMOOTHING * width + (1.0 - _SMOOTHING) * elite.std(axis=0)
    return best


def _evaluate(problem: ControlProblem, candidates: Array, start: Array, newest: Counts, disturbances: Array) -> Array:
    """Return the mean cost (G,) of candidates (G, 5, n_axes); inf where a run diverges."""
    plant, (runs, steps), count = problem.plant, newest.shape, len(candidates)
    pid = CascadedPid(problem, _make_gains(np.repeat(candidates, runs, axis=0).swapaxes(0, 1)))
    pid.begin(count * runs)
    all_newest, noise = np.tile(newest, (count, 1)), np.tile(disturbances @ plant.e.T, (count, 1, 1))
    all_runs = np.arange(count * runs)
    states, inputs = np.zeros((all_runs.size, steps + 1, plant.n_x)), np.zeros((all_runs.size, steps, plant.n_u))
    states[:, 0] = start
    total = np.zeros(all_runs.size)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(steps):
            inputs[:, k] = pid.act(Information(k, all_newest[:, k], states[all_runs, all_newest[:, k]], inputs[:, :k]))
            states[:, k + 1] = states[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + noise[:, k]
            total += _stage_cost(problem, states[:, k], inputs[:, k], states[:, k + 1])
    mean = total.reshape(count, runs).mean(axis=1)
    return np.where(np.isfinite(mean), mean, np.inf)


def _stage_cost(problem: ControlProblem, x: Array, u: Array, x_next: Array) -> Array:
    """Return the stage cost (M,) and the price of the next state's excess over its limits."""
    # (x - x_s)'Q_x(x - x_s) + (u - u_s)'Q_u(u - u_s) + Σ (ρ_1 s + ρ_2 s²),  s = max(C x⁺ - b, 0)
    off_x, off_u = x - problem.target, u - problem.u_target
    excess = np.maximum(x_next @ problem.state_set.c.T - problem.state_set.b, 0.0)
    slack = problem.slack_linear * excess + problem.slack_quadratic * excess**2
    cost: Array = np.sum(off_x @ problem.q_x * off_x, axis=1) + np.sum(off_u @ problem.q_u * off_u, axis=1)
    return np.asarray(cost + slack.sum(axis=1), dtype=np.float64)


def _make_gains(values: Array) -> PidGains:
    """Make gains from (5, …) in the order of the fields."""
    position, velocity, integral, derivative, speed = values
    return PidGains(position, velocity, integral, derivative, speed)
