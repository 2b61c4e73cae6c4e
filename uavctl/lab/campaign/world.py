"""Linear world of campaigns: many runs in step, in memory, with their draws, link and filter.

1. All random numbers of a run come from (master, index) alone, so all cells share them.
2. The link determines when each position is known, and which known one is the newest.
3. Where positions alone are measured, the flight's filter estimates the state, for all runs in step.
4. `simulate` steps all runs with one controller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.config.link import LinkConfig
from uavctl.smpc.batch import BatchController, Counts, Information
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

_NOISE = 3  # child of a run's seed: 0 and 1 are those of `draw`, 2 draws its start


@dataclass(frozen=True, eq=False)
class RandomDraws:
    """Random draws of N runs of T steps."""

    normal: Array  # standard normal draws (N, T, n_w): the disturbances'
    # Uniform draws (N, T+1, 3): for each step's position, of the channel's state, of its loss, of its delay
    link: Array


def draw(master: int, first: int, runs: int, steps: int, n_w: int) -> RandomDraws:
    """Draw for the runs `first` … `first` + `runs` - 1 of a campaign; longer runs begin with the same draws."""
    normal, link = np.empty((runs, steps, n_w)), np.empty((runs, steps + 1, 3))
    for i in range(runs):
        for_plant, for_link = np.random.SeedSequence([master, first + i]).spawn(2)
        np.random.default_rng(for_plant).standard_normal(out=normal[i])
        np.random.default_rng(for_link).random(out=link[i])
    return RandomDraws(normal, link)


def draw_noise(master: int, first: int, runs: int, steps: int, axes: int) -> Array:
    """Draw the standard normal noise of positions (N, T, axes), apart from all other draws of a run; see `draw`."""
    noise = np.empty((runs, steps, axes))
    for i in range(runs):
        seed = np.random.SeedSequence([master, first + i]).spawn(_NOISE + 1)[_NOISE]
        np.random.default_rng(seed).standard_normal(out=noise[i])
    return noise


Flags = NDArray[np.bool_]

_ROUNDING = 1e-9  # share of a limit, or of a step; less is rounding


def compute_known_steps(link: LinkConfig, dt_s: float, draws: Array) -> Counts:
    """Return the first step that knows the position of each step; T or more where none does.

    One position is captured a step; the first one is known at once, as in the paper. As in the design, the age counts
    whole steps: where every delay is below Δt, a position is known in its own step; else one with a delay of up to
    i Δt is known i steps later.

    Args:
        link: The link; losses of every model, delay, jitter and blackouts act.
        dt_s: Δt [s].
        draws: Uniform draws (N, T+1, 3), see `RandomDraws.link`.

    Returns:
        Steps (N, T).
    """
    steps = draws.shape[1] - 1
    lost = _find_losses(link, dt_s, draws[:, :steps])
    under_way_s = link.delay_s + link.jitter_s * draws[:, :steps, 2]
    longest_s = link.delay_s + link.jitter_s
    if link.model == "trace":
        under_way_s = _get_trace_delays(link, draws[:, :steps])
        lost |= np.isinf(under_way_s)
        under_way_s[lost] = 0.0
        longest_s = max(filter(math.isfinite, link.trace_s))
    is_within_step = longest_s < dt_s
    delay_steps = (
        np.zeros(lost.shape, np.intp) if is_within_step else np.ceil(under_way_s / dt_s - _ROUNDING).astype(np.intp)
    )
    first = np.where(lost, steps, np.arange(steps) + delay_steps)
    first[:, 0] = 0
    return first


def compute_newest_captures(link: LinkConfig, dt_s: float, draws: Array) -> Counts:
    """Return the capture step (N, T) of the newest position known at the beginning of each step; see `known`."""
    return select_newest_captures(compute_known_steps(link, dt_s, draws))


def select_newest_captures(known_steps: Counts) -> Counts:
    """Return the capture step (N, T) of the newest position, from the first step (N, T) that knows each one."""
    steps = known_steps.shape[1]
    captures = np.zeros(known_steps.shape, dtype=np.intp)
    runs = np.arange(known_steps.shape[0])
    for step in range(steps):
        first = known_steps[:, step]
        (known_runs,) = np.nonzero(first < steps)
        captures[runs[known_runs], first[known_runs]] = np.maximum(captures[runs[known_runs], first[known_runs]], step)
    return np.maximum.accumulate(captures, axis=1)


def _get_trace_delays(link: LinkConfig, draws: Array) -> Array:
    """Return the delay of each position (N, T) in the trace [s], infinite if lost; each run has its own start in it."""
    trace = np.array(link.trace_s)
    first = (draws[:, 0, 0] * len(trace)).astype(np.intp)
    index = (first[:, np.newaxis] + np.arange(draws.shape[1])) % len(trace)
    return np.asarray(trace[index], dtype=np.float64)


def _find_losses(link: LinkConfig, dt_s: float, draws: Array) -> Flags:
    """Return which positions (N, T) never arrive."""
    steps = draws.shape[1]
    at_s = np.arange(steps) * dt_s
    is_blackout = np.any(
        [(begin <= at_s) & (at_s <= end) for begin, end in link.blackout] or [np.zeros(steps, bool)], axis=0
    )
    if link.model == "gilbert-elliott":
        is_lost = _draw_burst_losses(link, draws)
    elif link.model == "empirical":
        is_lost = _draw_gap_losses(link, draws)
    elif link.model == "trace":
        is_lost = np.zeros(draws.shape[:2], dtype=np.bool_)
    elif link.probability:
        arrival_chances = np.array(link.probability)[np.minimum(np.arange(steps), len(link.probability) - 1)]
        is_lost = draws[:, :, 1] >= arrival_chances
    else:
        is_lost = draws[:, :, 1] < link.loss
    return np.asarray(is_lost | is_blackout, dtype=np.bool_)


def _draw_burst_losses(link: LinkConfig, draws: Array) -> Flags:
    """Return losses of a Gilbert-Elliott channel: good before the first packet, a step of the chain before each."""
    is_lost = np.zeros(draws.shape[:2], dtype=np.bool_)
    is_bad = np.zeros(draws.shape[0], dtype=np.bool_)
    for k in range(draws.shape[1]):
        state_draws, loss_draws = draws[:, k, 0], draws[:, k, 1]
        is_bad = np.where(is_bad, state_draws >= link.burst_leave, state_draws < link.burst_enter)
        is_lost[:, k] = loss_draws < np.where(is_bad, link.burst_loss, link.loss)
    return is_lost


def _draw_gap_losses(link: LinkConfig, draws: Array) -> Flags:
    """Return runs of losses as measured: one is drawn before the first packet, and after each that arrives."""
    cumulated = np.cumsum(link.gaps)
    is_lost = np.zeros(draws.shape[:2], dtype=np.bool_)
    remaining_losses = np.full(draws.shape[0], -1, dtype=np.intp)
    for k in range(draws.shape[1]):
        drawn = np.searchsorted(cumulated, draws[:, k, 0] * cumulated[-1], side="right")
        remaining_losses = np.where(remaining_losses < 0, drawn, remaining_losses) - 1
        is_lost[:, k] = remaining_losses >= 0
    return is_lost


@dataclass(frozen=True, eq=False)
class FilterBelief:
    """Plant and noise that a controller assumes of positions."""

    plant: Plant  # the plant that it believes in
    position_std_m: float  # standard deviation of a position, each axis [m]
    initial_std: float  # standard deviation of the states that the first position does not show


class PositionFilter:
    """Kalman filter of N runs, one position a step, in whatever order they come.

    A position is captured where a step begins. There the flight's filter (`uavctl.flight.kalman`) has drawn its
    new disturbance, so only x of its z = (x, w) is kept, and one step is x := A x + B u with noise E W E'. The first
    position initialises its own states; the other states begin with zero and `initial_std`. After a delayed position
    the steps since its capture are filtered again, so the result is the same as if all had arrived in order.

    Args:
        belief: Plant and noise assumed of the positions.
        known_steps: First step (N, T) that knows the position of each step, T or more where none does; the position of
            step 0 is known at once.
    """

    def __init__(self, belief: FilterBelief, known_steps: Counts) -> None:
        plant = belief.plant
        runs, steps = known_steps.shape
        self._plant, self._known_steps = plant, known_steps
        self._noise = plant.e @ plant.w @ plant.e.T
        self._index = list(plant.position_index)
        self._position_cov = np.eye(len(self._index)) * belief.position_std_m**2
        self._max_delay_steps = int((known_steps - np.arange(steps))[known_steps < steps].max(initial=0))
        mean, cov = np.zeros((runs, plant.n_x)), np.tile(np.eye(plant.n_x) * belief.initial_std**2, (runs, 1, 1))
        self._before = {0: (mean, cov)}  # of a step, without its own position
        self._after = mean, cov  # of the newest step, with it
        self._positions: dict[int, Array] = {}
        self._mean, self._cov = mean.copy(), cov.copy()

    def update(self, step: int, positions: Array, newest_captures: Counts, inputs: Array) -> tuple[Array, Array]:
        """Take the positions of a step; return the state (N, n_x) at the newest known capture, and its covariance.

        Args:
            step: Number of the step; call for 0, 1, … in turn.
            positions: Positions (N, n_axes) captured now, also those that never arrive.
            newest_captures: Capture step (N,) of the newest position known.
            inputs: Inputs (N, step, n_u) that have acted.
        """
        self._positions[step] = positions
        if step:
            self._before[step] = self._predict(*self._after, inputs[:, step - 1])
        (arrived,) = np.nonzero((self._known_steps[:, : step + 1] == step).any(axis=0))
        for capture in range(int(arrived[0]) if arrived.size else step, step + 1):
            mean, cov = self._after = self._correct(capture, step)
            is_newest = newest_captures == capture
            self._mean[is_newest], self._cov[is_newest] = mean[is_newest], cov[is_newest]
            if capture < step:
                self._before[capture + 1] = self._predict(mean, cov, inputs[:, capture])
        for capture in [step_before for step_before in self._before if step_before < step - self._max_delay_steps]:
            del self._before[capture], self._positions[capture]
        return self._mean.copy(), self._cov.copy()

    def _predict(self, mean: Array, cov: Array, u: Array) -> tuple[Array, Array]:
        """Predict states and covariances one step ahead, under the inputs (N, n_u)."""
        plant = self._plant
        return mean @ plant.a.T + u @ plant.b.T, plant.a @ cov @ plant.a.T + self._noise

    def _correct(self, capture: int, step: int) -> tuple[Array, Array]:
        """Correct the belief of step `capture` by its position, in the runs that know it in `step`."""
        mean, cov = (array.copy() for array in self._before[capture])
        index = self._index
        if not capture:
            mean[:, index] = self._positions[0]
            cov[np.ix_(range(len(cov)), index, index)] = self._position_cov
            return mean, cov
        (updated_runs,) = np.nonzero(self._known_steps[:, capture] <= step)
        prior_cov = cov[updated_runs]
        ph = prior_cov[:, :, index]
        gain = np.linalg.solve(ph[:, index] + self._position_cov, ph.transpose(0, 2, 1)).transpose(0, 2, 1)
        innovation = self._positions[capture][updated_runs] - mean[updated_runs][:, index]
        complement = np.tile(np.eye(mean.shape[1]), (updated_runs.size, 1, 1))
        complement[:, :, index] -= gain
        mean[updated_runs] += (gain @ innovation[:, :, None])[:, :, 0]
        # Joseph's form, P := (I - K H) P (I - K H)' + K R K': symmetric and positive semidefinite in spite of rounding.
        cov[updated_runs] = complement @ prior_cov @ complement.transpose(
            0, 2, 1
        ) + gain @ self._position_cov @ gain.transpose(0, 2, 1)
        return mean, cov


@dataclass(frozen=True, eq=False)
class LinearWorld:
    """Plant that is flown, and the limits and costs by which runs are judged."""

    plant: Plant  # the plant that flies; the controllers may believe in another one
    state_set: Polytope  # X
    input_set: Polytope  # U: the actuators' limits, which hold whatever a controller asks
    q_x: Array  # Q_x (n_x, n_x)
    q_u: Array  # Q_u (n_u, n_u)
    target: Array  # equilibrium to go to (n_x,), with input u_target
    u_target: Array  # its input (n_u,)
    start: Array  # x(0) (N, n_x)


@dataclass(frozen=True, eq=False)
class Trajectories:
    """Trajectories of N runs of T steps."""

    states: Array  # (N, T+1, n_x)
    inputs: Array  # inputs that acted (N, T, n_u), within the limits
    requested: Array  # inputs that the controller asked for (N, T, n_u)
    age: Counts  # age of information (N, T)
    cost: Array  # stage costs (N, T): (x - x_target)'Q_x(…) + (u - u_target)'Q_u(…) of each step
    state_violated: Flags  # whether x(1) … x(T) left X (N, T)
    input_violated: Flags  # whether the input asked for was outside U (N, T)
    failed: Flags  # whether a run ended in numbers that are not finite (N,)


@dataclass(frozen=True, eq=False)
class MeasuredPositions:
    """Filter and noise of N runs in which positions alone are measured."""

    filter: PositionFilter  # estimates states from the positions
    noise: Array  # noise of the positions (N, T, n_axes) [m]


def simulate(
    world: LinearWorld,
    controller: BatchController,
    newest_captures: Counts,
    disturbances: Array,
    measured: MeasuredPositions | None = None,
) -> Trajectories:
    """Simulate all runs at once.

    Args:
        newest_captures: Capture step of the newest position known in each step (N, T).
        disturbances: w (N, T, n_w).
        measured: Filter and noise of measured positions; None: the controller knows the exact state.
    """
    plant, (runs, steps) = world.plant, newest_captures.shape
    states, inputs = np.zeros((runs, steps + 1, plant.n_x)), np.zeros((runs, steps, plant.n_u))
    requested = np.zeros_like(inputs)
    states[:, 0] = world.start
    failed = np.zeros(runs, dtype=np.bool_)
    run_indices = np.arange(runs)
    low, high = world.input_set.bounds
    controller.begin(runs)
    position_index = list(plant.position_index)
    for k in range(steps):
        if measured is None:
            state, cov = states[run_indices, newest_captures[:, k]], None
        else:
            state, cov = measured.filter.update(
                k, states[:, k, position_index] + measured.noise[:, k], newest_captures[:, k], inputs[:, :k]
            )
        measurement = Information(k, newest_captures[:, k], state, inputs[:, :k], cov)
        wanted_inputs = controller.act(measurement)
        failed |= ~np.isfinite(wanted_inputs).all(axis=1)
        requested[:, k] = np.where(failed[:, None], 0.0, wanted_inputs)
        inputs[:, k] = np.clip(requested[:, k], low, high)
        states[:, k + 1] = states[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + disturbances[:, k] @ plant.e.T
    x, u = states[:, :-1] - world.target, inputs - world.u_target
    return Trajectories(
        states=states,
        inputs=inputs,
        requested=requested,
        age=np.arange(steps) - newest_captures,
        cost=np.einsum("nti,ij,ntj->nt", x, world.q_x, x) + np.einsum("nti,ij,ntj->nt", u, world.q_u, u),
        state_violated=_is_outside(world.state_set, states[:, 1:]),
        input_violated=_is_outside(world.input_set, requested),
        failed=failed,
    )


def _is_outside(limits: Polytope, points: Array) -> Flags:
    """Return which points (…, n) are outside the set."""
    bounds = limits.b * (1.0 + _ROUNDING * np.sign(limits.b)) + _ROUNDING
    return np.asarray((points @ limits.c.T > bounds).any(axis=-1), dtype=np.bool_)
