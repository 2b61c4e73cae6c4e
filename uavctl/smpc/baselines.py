"""Controllers to compare with, every one a real controller on the same plant, weights, limits, noise and losses."""

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
from uavctl.smpc.nominal import BatchMpc, ControlProblem, Part, deviations, lqr, parts, unseen
from uavctl.smpc.qp import SOFT, QuadraticProgram

# Constrained MPC on receipt, and three ways to fill the silence: play the plan out, hold, or let go.


Index = NDArray[np.intp]


class _OnReceipt(ABC):
    """A new plan from each position that is newer than the last one; a late one is predicted to now first.

    Args:
        margin: How far the plans keep from the state limits, in standard deviations of one step's disturbance.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float = 0.0) -> None:
        self._problem = problem
        self._mpc = self._planner(margin)
        self.begin(0)

    def _planner(self, margin: float) -> BatchMpc:
        """Make the planner, its limits tightened by `margin` standard deviations."""
        plant = self._problem.plant
        step = plant.e @ plant.w @ plant.e.T
        return BatchMpc(self._problem, margin * deviations(self._problem.state_set, step))

    def begin(self, runs: int) -> None:
        """See `BatchController`."""
        self._plans = np.zeros((runs, self._problem.horizon, self._problem.plant.n_u))
        self._made = np.zeros(runs, dtype=np.intp)
        self._captured = np.full(runs, -1, dtype=np.intp)

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        (fresh,) = np.nonzero(information.newest > self._captured)
        # x(0) is always known: every run has a plan from the first step on.
        self._plans[fresh] = self._mpc.plans(predict(self._problem.plant, information)[fresh])
        self._made[fresh] = information.step
        self._captured[fresh] = information.newest[fresh]
        return self._played(information.step - self._made)

    @abstractmethod
    def _played(self, index: Index, /) -> Array:
        """Inputs (N, n_u) of plans that were made `index` (N,) steps ago."""


class PacketisedPredictive(_OnReceipt):
    """Certainty-equivalent packetised predictive control: the plan is played out, then u_target.

    The receiver's buffer of Quevedo and Nešić (2011, Input-to-state stability of packetized predictive control over
    unreliable networks), with the losses before the controller in place of behind it.
    """

    def _played(self, index: Index, /) -> Array:
        steps = self._problem.horizon
        inputs = self._plans[np.arange(index.size), np.minimum(index, steps - 1)]
        return np.where((index < steps)[:, None], inputs, self._problem.u_target)


class HoldLast(_OnReceipt):
    """The plan's first input, held until the next position comes."""

    def _played(self, _index: Index, /) -> Array:
        return self._plans[:, 0].copy()


class ZeroOnLoss(_OnReceipt):
    """The plan's first input for one step, and u_target until the next position comes."""

    def _played(self, index: Index, /) -> Array:
        return np.where((index == 0)[:, None], self._plans[:, 0], self._problem.u_target)


class MeanQp(PacketisedPredictive):
    """Packetised predictive control with open-loop back-offs: stage t keeps κ σ_t from the state limits.

    σ_t is the standard deviation of a prediction over t steps, and κ the same at every age, however likely it is.

    Args:
        cov: Covariance (n_x, n_x) of the newest state known, of a filter to which all comes; None: it is exact.

    Raises:
        DesignError: The plant has no regulator.
    """

    def __init__(self, problem: ControlProblem, margin: float, cov: Array | None = None) -> None:
        self._cov = cov
        super().__init__(problem, margin)

    def _planner(self, margin: float) -> BatchMpc:
        problem = self._problem
        spread = unseen(problem.plant, problem.horizon, self._cov)
        return BatchMpc(problem, margin * np.array([deviations(problem.state_set, cov) for cov in spread]))


# Worst-case delay: the mean x̂ predicted over d steps has the error S = Σ_{i<d} A^i N A'^i, always, and is moved by
# A^d E w(k-d) in each step. Under u = mean + K_ρ(x̂ - mean) a stage t of the plan has the covariance S + Z_t, its input
# K_ρ Z_t K_ρ', with Z_{t+1} = (A + B K_ρ) Z_t (A + B K_ρ)' + A^d N A'^d from Z_0 = 0: κ σ off the rows.
# K_ρ is the regulator's for the input weight ρ R: the least ρ by which the spread at the target takes this share of
# the room, as the full gain asks for more input than there is.
_SHARE = 0.5
_INPUT_WEIGHTS = 2.0 ** np.arange(0, 21)


class WorstCaseDelay:
    """Positions wait until they are `delay` steps old; from there the mean is predicted, and each step plans anew.

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
        # Positions that are not old enough yet, by their capture modulo the length.
        self._waiting = np.full((runs, self._delay + 1), -1, dtype=np.intp)
        self._states = np.zeros((runs, self._delay + 1, n_x))
        self._used, self._state = np.zeros(runs, dtype=np.intp), np.zeros((runs, n_x))

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        self._take(information)
        x = predict(self._problem.plant, Information(information.step, self._used, self._state, information.inputs))
        first: Array = self._mpc.plans(x)[:, 0]
        return first

    def _take(self, information: Information) -> None:
        """Let the newest position that is old enough be the one that is used; x(0) is known at first."""
        every, slot = np.arange(len(information.newest)), information.newest % (self._delay + 1)
        self._waiting[every, slot], self._states[every, slot] = information.newest, information.state
        if information.step == 0:
            self._state = information.state.copy()
            return
        due = information.step - self._delay
        old = np.where((self._waiting >= 0) & (self._waiting <= due), self._waiting, -1)
        best = old.argmax(axis=1)
        newer = np.flatnonzero(old[every, best] > self._used)
        self._used[newer] = old[newer, best[newer]]
        self._state[newer] = self._states[newer, best[newer]]


def _backoffs(problem: ControlProblem, delay: int, kappa_x: float, kappa_u: float) -> tuple[Array, Array]:
    """Return the back-offs of the rows: states (H+1, m_x), inputs (H, m_u)."""
    plant = problem.plant
    step = plant.e @ plant.w @ plant.e.T
    error = np.zeros_like(step)
    for _ in range(delay):
        error, step = error + step, plant.a @ step @ plant.a.T
    k = _prediction_gain(problem, error, step, kappa_x, kappa_u)
    loop, spread = plant.a + plant.b @ k, np.zeros_like(step)
    backoff_x, backoff_u = [], []
    for _ in range(problem.horizon + 1):
        backoff_x.append(kappa_x * deviations(problem.state_set, error + spread))
        backoff_u.append(kappa_u * deviations(problem.input_set, k @ spread @ k.T))
        spread = loop @ spread @ loop.T + step
    return np.array(backoff_x), np.array(backoff_u[:-1])


def _prediction_gain(problem: ControlProblem, error: Array, step: Array, kappa_x: float, kappa_u: float) -> Array:
    """K_ρ; where no ρ leaves enough room, the one that leaves most of it."""
    plant, best = problem.plant, (np.inf, np.zeros((problem.plant.n_u, problem.plant.n_x)))
    room_x, room_u = problem.state_set.margin(problem.target), problem.input_set.margin(problem.u_target)
    for weight in _INPUT_WEIGHTS:
        k = lqr(plant, problem.q_x, weight * problem.q_u).k
        spread = solve_discrete_lyapunov(plant.a + plant.b @ k, step)
        taken = max(
            _taken(kappa_x * deviations(problem.state_set, error + spread), room_x),
            _taken(kappa_u * deviations(problem.input_set, k @ spread @ k.T), room_u),
        )
        if taken < best[0]:
            best = (taken, k)
        if taken <= _SHARE:
            break
    if best[0] >= 1.0:
        raise DesignError(
            "smpc.tau",
            f"a constant delay spreads the state over {best[0]:.3g} times the room that the limits leave at the target",
            "take a shorter smpc.tau, or wider limits",
        )
    return best[1]


def _taken(backoff: Array, room: Array) -> float:
    """Largest share of the room that a back-off takes."""
    shares = np.divide(backoff, room, out=np.full(room.size, np.inf), where=room > 0.0)
    return float(shares.max(initial=0.0))


# A governor: the regulator on the predicted mean, whose next mean keeps a margin from the state limits.


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

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        problem = self._problem
        plant, x = problem.plant, predict(problem.plant, information)
        asked = np.clip(problem.u_target + (x - problem.target) @ self._law.k.T, self._low, self._high)
        backoff = self._upto(int(information.age.max(initial=0)) + 1)[information.age + 1]
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

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        off = predict(self._problem.plant, information) - self._problem.target
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

    def act(self, information: Information) -> Array:
        """See `BatchController`."""
        gains, target, dt_s = self._gains, self._problem.target, self._problem.plant.dt_s
        fresh = (information.newest > self._captured)[:, None]
        position, velocity = information.state[:, self._position], information.state[:, self._velocity]
        self._differentiate(information, velocity, fresh)
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

    def _differentiate(self, information: Information, velocity: Array, fresh: Flags) -> None:
        """Acceleration between the two newest velocities known."""
        span_s = np.maximum(information.newest - self._captured, 1)[:, None] * self._problem.plant.dt_s
        seen = fresh & (self._captured >= 0)[:, None]
        self._accel = np.where(seen, (velocity - self._last) / span_s, self._accel)
        self._last = np.where(fresh, velocity, self._last)
        self._captured = np.maximum(self._captured, information.newest)

    def _within(self, accel: Array) -> Array:
        """Input (N, n_u) of an acceleration (N, n_axes), at most at its limits."""
        return np.clip(self._problem.u_target + accel @ self._input_of_accel.T, self._low, self._high)

    def _accel_within(self, accel: Array) -> Array:
        """The acceleration that the limits leave of one; what no input can do counts as done."""
        asked = self._problem.u_target + accel @ self._input_of_accel.T
        lost: Array = (asked - np.clip(asked, self._low, self._high)) @ self._accel_of_input.T
        return accel - lost


Cost = Callable[[Array], Array]

# Gains of the cascaded PID, tuned on the very scene that they fly in. A coarse grid, the same for all axes, then a
# cross-entropy search (Rubinstein 1999) over the logarithms of all gains: each generation lies around the best of the
# one before. Every candidate meets the same noise and losses, and the draws have a seed of their own.
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
            inputs[:, k] = pid.act(Information(k, known[:, k], states[every, known[:, k]], inputs[:, :k]))
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
