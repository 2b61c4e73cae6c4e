"""Gains of the cascaded PID, tuned on the very scene that they fly in: plant, weights, limits, start and link.

A coarse grid, the same for all axes, then a cross-entropy search (Rubinstein 1999) over the logarithms of all gains:
each generation is drawn around the best of the one before. Every candidate meets the same noise and losses, and the
draws have a seed of their own: the same arguments give the same gains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.batch import Counts, News, predict
from uavctl.smpc.bounds import lqr
from uavctl.smpc.nominal import ControlProblem, Part, deviations, parts, unseen
from uavctl.smpc.qp import SOFT, QuadraticProgram

# A governor: the regulator on the predicted mean, whose next mean keeps a margin from the state limits.


Array = NDArray[np.float64]


class Governor:
    """The input nearest to the regulator's by which the next state's mean keeps a margin.

    The margin is so many standard deviations of a prediction one step older than the newest position. Where inputs do
    not reach that far, the rows give way at the price of their slack.

    Args:
        cov: Covariance (n_x, n_x) of the newest state known, of a filter to which all comes; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float, cov: Array | None = None) -> None:
        self._problem, self._margin, self._cov = problem, margin, cov
        self._law = lqr(problem.plant, problem.q_x, problem.q_u)
        self._parts = [_Step(problem, part) for part in parts(problem)]
        self._low, self._high = problem.input_set.bounds
        self._backoffs = np.zeros((1, problem.state_set.b.size))

    def begin(self, runs: int) -> None:
        """See `BatchController`."""

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        problem = self._problem
        plant, x = problem.plant, predict(problem.plant, news)
        asked = np.clip(problem.u_target + (x - problem.target) @ self._law.k.T, self._low, self._high)
        backoff = self._upto(int(news.age.max(initial=0)) + 1)[news.age + 1]
        drift = x @ plant.a.T @ problem.state_set.c.T
        room = problem.state_set.b - backoff - drift
        short = asked @ (problem.state_set.c @ plant.b).T > room
        for i in np.flatnonzero(short.any(axis=1) & np.isfinite(x).all(axis=1)):
            for part in self._parts:
                part.move(asked[i], room[i])
        return asked

    def _upto(self, age: int) -> Array:
        """Margins (…, m_x) of means that are 0, 1 … `age` steps old, and older."""
        if len(self._backoffs) <= age:
            limits, spread = self._problem.state_set, unseen(self._problem.plant, 2 * age, self._cov)
            self._backoffs = self._margin * np.array([deviations(limits, cov) for cov in spread])
        return self._backoffs


class _Step:
    """One independent part of one step."""

    def __init__(self, problem: ControlProblem, part: Part) -> None:
        self._part = part
        of_u = problem.state_set.c[np.ix_(part.rows_x, part.states)] @ problem.plant.b[np.ix_(part.states, part.inputs)]
        (used,) = np.nonzero(np.any(of_u != 0.0, axis=1))
        self._rows, hard = part.rows_x[used], problem.input_set.c[np.ix_(part.rows_u, part.inputs)]
        rows, self._sides = np.vstack([of_u[used], hard]), problem.input_set.b[part.rows_u]
        soft = np.arange(len(rows)) < used.size
        self._program = QuadraticProgram(
            2.0 * np.eye(part.inputs.size),
            np.ascontiguousarray(rows),
            np.where(soft, SOFT, 0).astype(np.int32),
            np.where(soft, problem.slack_linear, 0.0),
            np.where(soft, problem.slack_quadratic, 0.0),
        )

    def move(self, asked: Array, room: Array) -> None:
        """Move the part's inputs in `asked` (n_u,) until the rows keep `room` (m_x,)."""
        sides = np.concatenate([room[self._rows], self._sides])
        u = asked[self._part.inputs]
        solved = self._program.solve(-2.0 * u, sides, np.full(sides.size, -np.inf))
        asked[self._part.inputs] = np.nan if solved is None else solved[0]


# LQG: the regulator's gain on the mean of the state, whatever the limits are.


class Lqg:
    """Infinite-horizon LQG; the newest state is exact, so the Kalman filter is the prediction from it.

    Without limits nothing costs less (see `lqg_bound`). What it asks for is not clipped.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem) -> None:
        self._problem = problem
        self._k = lqr(problem.plant, problem.q_x, problem.q_u).k

    def begin(self, runs: int) -> None:
        """See `BatchController`."""

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        off = predict(self._problem.plant, news) - self._problem.target
        asked: Array = self._problem.u_target + off @ self._k.T
        return asked


# Cascaded PID: position P, velocity PID, each axis by itself, on what was measured last: the usual autopilot.


Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class PidGains:
    """Gains of each axis (n_axes,), or of each axis of each run (N, n_axes)."""

    position_1ps: Array  # wanted speed per distance to the target [1/s]
    velocity_1ps: Array  # acceleration per error of the speed [1/s]
    integral_1ps2: Array  # acceleration per integral of this error [1/s²]
    derivative: Array  # acceleration taken back per measured acceleration
    speed: Array  # share of the velocity limits that is wanted at most


class CascadedPid:
    """Position and velocity loops as an autopilot has them; outputs saturate at the input limits.

    A lost position leaves the measurement as it was, and the integral too. The integral also stops while the output is
    at a limit and the error would drive it on.

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

    def act(self, news: News) -> Array:
        """See `BatchController`."""
        gains, target, dt_s = self._gains, self._problem.target, self._problem.plant.dt_s
        fresh = (news.newest > self._captured)[:, None]
        position, velocity = news.state[:, self._position], news.state[:, self._velocity]
        self._differentiate(news, velocity, fresh)
        wanted = gains.position_1ps * (target[self._position] - position)
        # No limit, no share of it: 0 · inf is no number.
        wanted = np.clip(wanted, gains.speed * self._slowest, gains.speed * self._fastest)
        error = target[self._velocity] + wanted - velocity
        grown = self._integral + np.where(fresh, gains.integral_1ps2 * error * dt_s, 0.0)
        rest = gains.velocity_1ps * error - gains.derivative * self._accel
        beyond = rest + grown - self._accel_within(rest + grown)
        winding = beyond * error > 0.0
        self._integral = np.where(winding, self._integral, grown)
        return self._within(rest + self._integral)

    def _differentiate(self, news: News, velocity: Array, fresh: Flags) -> None:
        """Acceleration between the two newest velocities known."""
        span_s = np.maximum(news.newest - self._captured, 1)[:, None] * self._problem.plant.dt_s
        seen = fresh & (self._captured >= 0)[:, None]
        self._accel = np.where(seen, (velocity - self._last) / span_s, self._accel)
        self._last = np.where(fresh, velocity, self._last)
        self._captured = np.maximum(self._captured, news.newest)

    def _within(self, accel: Array) -> Array:
        """Input (N, n_u) of an acceleration (N, n_axes), at most at its limits."""
        return np.clip(self._problem.u_target + accel @ self._input_of_accel.T, self._low, self._high)

    def _accel_within(self, accel: Array) -> Array:
        """The acceleration that the limits leave of one; what no input can do counts as done."""
        asked = self._problem.u_target + accel @ self._input_of_accel.T
        lost: Array = (asked - np.clip(asked, self._low, self._high)) @ self._accel_of_input.T
        return accel - lost


Cost = Callable[[Array], Array]

# First guesses: rates in 1/Δt, the integral in shares of the product of both loops' gains.
_POSITION = (0.03, 0.06, 0.12, 0.25, 0.5)
_VELOCITY = (0.05, 0.1, 0.2, 0.4, 0.8)
_INTEGRAL, _DERIVATIVE, _SPEED = (0.01, 0.1), 0.02, (0.6, 1.0)
_GENERATIONS, _CANDIDATES, _KEPT = 25, 40, 8
_WIDTH = 0.8  # standard deviation of the first generation's logarithms
_MEMORY = 0.3  # share of the last generation's width that the next one has, beside that of the best
_SEED = 0


def tune(problem: ControlProblem, start: Array, newest: Counts, disturbances: Array) -> PidGains:
    """Gains of least mean summed stage cost, state limits at the price of their slack.

    Args:
        start: x(0) (n_x,).
        newest: Capture step of the newest position known in each step (N, T) of N runs to tune on.
        disturbances: w (N, T, n_w) of these runs.
    """
    axes = len(problem.plant.axes)

    def cost(candidates: Array) -> Array:
        return _costs(problem, candidates.reshape(-1, 5, axes), start, newest, disturbances)

    return _gains(_searched(_guess(problem.plant.dt_s, axes, cost), cost).reshape(5, axes))


def _guess(dt_s: float, axes: int, cost: Cost) -> Array:
    """The best of the grid (5 n_axes,)."""
    grid = np.array(
        [
            [p / dt_s, v / dt_s, share * p * v / dt_s**2, _DERIVATIVE, speed]
            for p, v, share, speed in product(_POSITION, _VELOCITY, _INTEGRAL, _SPEED)
        ]
    )
    candidates = np.repeat(grid, axes, axis=1)
    best: Array = candidates[np.argmin(cost(candidates))]
    return best


def _searched(best: Array, cost: Cost) -> Array:
    """The best point (n,) found from `best` on."""
    rng = np.random.default_rng(_SEED)
    least = float(cost(best[np.newaxis])[0])
    mean, width = np.log(best), np.full(best.size, _WIDTH)
    for _ in range(_GENERATIONS):
        drawn = mean + width * rng.standard_normal((_CANDIDATES, best.size))
        found = cost(np.exp(drawn))
        kept = drawn[np.argsort(found, kind="stable")[:_KEPT]]
        if found.min() < least:
            least, best = float(found.min()), np.exp(kept[0])
        mean, width = kept.mean(axis=0), _MEMORY * width + (1.0 - _MEMORY) * kept.std(axis=0)
    return best


def _costs(problem: ControlProblem, candidates: Array, start: Array, newest: Counts, disturbances: Array) -> Array:
    """Mean cost (G,) of candidates (G, 5, n_axes); inf where a run leaves all bounds."""
    plant, (runs, steps), count = problem.plant, newest.shape, len(candidates)
    pid = CascadedPid(problem, _gains(np.repeat(candidates, runs, axis=0).swapaxes(0, 1)))
    pid.begin(count * runs)
    known, noise = np.tile(newest, (count, 1)), np.tile(disturbances @ plant.e.T, (count, 1, 1))
    every = np.arange(count * runs)
    states, inputs = np.zeros((every.size, steps + 1, plant.n_x)), np.zeros((every.size, steps, plant.n_u))
    states[:, 0] = start
    total = np.zeros(every.size)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(steps):
            inputs[:, k] = pid.act(News(k, known[:, k], states[every, known[:, k]], inputs[:, :k]))
            states[:, k + 1] = states[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + noise[:, k]
            total += _stage(problem, states[:, k], inputs[:, k], states[:, k + 1])
    mean = total.reshape(count, runs).mean(axis=1)
    return np.where(np.isfinite(mean), mean, np.inf)


def _stage(problem: ControlProblem, x: Array, u: Array, then: Array) -> Array:
    """Stage cost (M,), and the price of what the next state is beyond its limits."""
    off_x, off_u = x - problem.target, u - problem.u_target
    beyond = np.maximum(then @ problem.state_set.c.T - problem.state_set.b, 0.0)
    slack = problem.slack_linear * beyond + problem.slack_quadratic * beyond**2
    cost: Array = np.sum(off_x @ problem.q_x * off_x, axis=1) + np.sum(off_u @ problem.q_u * off_u, axis=1)
    return np.asarray(cost + slack.sum(axis=1), dtype=np.float64)


def _gains(values: Array) -> PidGains:
    """Gains from (5, …) in the order of the fields."""
    position, velocity, integral, derivative, speed = values
    return PidGains(position, velocity, integral, derivative, speed)
