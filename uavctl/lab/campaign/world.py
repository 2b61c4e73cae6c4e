"""Linear world of campaigns: many runs in step, their link, filter and random numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uavctl.config.link import LinkConfig
from uavctl.smpc.batch import BatchController, Counts, Information
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope

# All that is random in a run, from (master, index) alone: common random numbers for every cell of a campaign.


Array = NDArray[np.float64]

_NOISE = 3  # child of a run's seed: 0 and 1 are those of `draw`, 2 draws its start


@dataclass(frozen=True, eq=False)
class Chances:
    """Random draws of N runs of T steps."""

    normal: Array  # standard normal draws (N, T, n_w): the disturbances'
    # Uniform draws (N, T+1, 3): for each step's position, of the channel's state, of its loss, of its delay
    link: Array


def draw(master: int, first: int, runs: int, steps: int, n_w: int) -> Chances:
    """Draw for the runs `first` … `first` + `runs` - 1 of a campaign; longer runs begin with the same draws."""
    normal, link = np.empty((runs, steps, n_w)), np.empty((runs, steps + 1, 3))
    for i in range(runs):
        for_plant, for_link = np.random.SeedSequence([master, first + i]).spawn(2)
        np.random.default_rng(for_plant).standard_normal(out=normal[i])
        np.random.default_rng(for_link).random(out=link[i])
    return Chances(normal, link)


def draw_noise(master: int, first: int, runs: int, steps: int, axes: int) -> Array:
    """Draw the standard normal noise of positions (N, T, axes), apart from all other draws of a run; see `draw`."""
    noise = np.empty((runs, steps, axes))
    for i in range(runs):
        seed = np.random.SeedSequence([master, first + i]).spawn(_NOISE + 1)[_NOISE]
        np.random.default_rng(seed).standard_normal(out=noise[i])
    return noise


# What the link of a configuration does to the positions of many runs: when each is known, and which is the newest.


Flags = NDArray[np.bool_]

_ROUNDING = 1e-9


def known(link: LinkConfig, dt_s: float, chances: Array) -> Counts:
    """Return the first step that knows the position of each step; T or more for those that no step does.

    One position is captured a step; the first one is known at once, as in the paper. As in the design, the age counts
    whole steps: where every delay is below Δt, a position is known in its own step; else one that is under way for
    up to i Δt is known i steps later.

    Args:
        link: The link; losses of every model, delay, jitter and blackouts act.
        dt_s: Δt [s].
        chances: Uniform draws (N, T+1, 3), see `Chances.link`.

    Returns:
        Steps (N, T).
    """
    steps = chances.shape[1] - 1
    lost = _lost(link, dt_s, chances[:, :steps])
    under_way_s = link.delay_s + link.jitter_s * chances[:, :steps, 2]
    longest_s = link.delay_s + link.jitter_s
    if link.model == "trace":
        under_way_s = _traced(link, chances[:, :steps])
        lost |= np.isinf(under_way_s)
        under_way_s[lost] = 0.0
        longest_s = max(filter(math.isfinite, link.trace_s))
    within = longest_s < dt_s
    late = np.zeros(lost.shape, np.intp) if within else np.ceil(under_way_s / dt_s - _ROUNDING).astype(np.intp)
    first = np.where(lost, steps, np.arange(steps) + late)
    first[:, 0] = 0
    return first


def newest(link: LinkConfig, dt_s: float, chances: Array) -> Counts:
    """Return the capture step (N, T) of the newest position known at the beginning of each step; see `known`."""
    return newest_of(known(link, dt_s, chances))


def newest_of(known: Counts) -> Counts:
    """Return the capture step (N, T) of the newest position, from the first step (N, T) that knows each one."""
    steps = known.shape[1]
    found = np.zeros(known.shape, dtype=np.intp)
    runs = np.arange(known.shape[0])
    for step in range(steps):
        first = known[:, step]
        (there,) = np.nonzero(first < steps)
        found[runs[there], first[there]] = np.maximum(found[runs[there], first[there]], step)
    return np.maximum.accumulate(found, axis=1)


def _traced(link: LinkConfig, chances: Array) -> Array:
    """Return the delay of each position (N, T) in the trace [s], infinite if lost; each run has its own start in it."""
    trace = np.array(link.trace_s)
    first = (chances[:, 0, 0] * len(trace)).astype(np.intp)
    index = (first[:, np.newaxis] + np.arange(chances.shape[1])) % len(trace)
    return np.asarray(trace[index], dtype=np.float64)


def _lost(link: LinkConfig, dt_s: float, chances: Array) -> Flags:
    """Return which positions (N, T) never arrive."""
    steps = chances.shape[1]
    at_s = np.arange(steps) * dt_s
    dark = np.any([(begin <= at_s) & (at_s <= end) for begin, end in link.blackout] or [np.zeros(steps, bool)], axis=0)
    if link.model == "gilbert-elliott":
        lost = _bursts(link, chances)
    elif link.model == "empirical":
        lost = _gaps(link, chances)
    elif link.model == "trace":
        lost = np.zeros(chances.shape[:2], dtype=np.bool_)
    elif link.probability:
        arrives = np.array(link.probability)[np.minimum(np.arange(steps), len(link.probability) - 1)]
        lost = chances[:, :, 1] >= arrives
    else:
        lost = chances[:, :, 1] < link.loss
    return np.asarray(lost | dark, dtype=np.bool_)


def _bursts(link: LinkConfig, chances: Array) -> Flags:
    """Return losses of a Gilbert-Elliott channel: good before the first packet, a step of the chain before each."""
    lost = np.zeros(chances.shape[:2], dtype=np.bool_)
    bad = np.zeros(chances.shape[0], dtype=np.bool_)
    for k in range(chances.shape[1]):
        step, draw = chances[:, k, 0], chances[:, k, 1]
        bad = np.where(bad, step >= link.burst_leave, step < link.burst_enter)
        lost[:, k] = draw < np.where(bad, link.burst_loss, link.loss)
    return lost


def _gaps(link: LinkConfig, chances: Array) -> Flags:
    """Return runs of losses as measured: one is drawn before the first packet, and after each that arrives."""
    runs = np.cumsum(link.gaps)
    lost = np.zeros(chances.shape[:2], dtype=np.bool_)
    to_lose = np.full(chances.shape[0], -1, dtype=np.intp)
    for k in range(chances.shape[1]):
        drawn = np.searchsorted(runs, chances[:, k, 0] * runs[-1], side="right")
        to_lose = np.where(to_lose < 0, drawn, to_lose) - 1
        lost[:, k] = to_lose >= 0
    return lost


# What controllers know where positions alone are measured: the flight's filter, for many runs in step.


@dataclass(frozen=True, eq=False)
class FilterBelief:
    """Plant and noise that a controller assumes of positions."""

    plant: Plant  # the plant that it believes in
    position_std_m: float  # standard deviation of a position, each axis [m]
    initial_std: float  # standard deviation of the states that the first position does not show


class PositionFilter:
    """Kalman filter of N runs, one position a step, in whatever order they come.

    A position is captured where a step begins. There the flight's filter (`uavctl.flight.kalman`) has drawn its
    disturbance anew, so that of its z = (x, w) nothing but x is carried on, and a step of it is A, B and E W E'. The
    first position shows itself, and the other states begin with zero and `initial_std`. After a late one the steps
    since its capture are filtered again: the numbers are the same as if all had come in order.

    Args:
        sight: Plant and noise assumed of the positions.
        known: Step (N, T) that knows the position of each step first, T or more where none does; the first position of
            all is known at once.
    """

    def __init__(self, sight: FilterBelief, known: Counts) -> None:
        plant = sight.plant
        runs, steps = known.shape
        self._plant, self._known = plant, known
        self._noise = plant.e @ plant.w @ plant.e.T
        self._index = list(plant.position_index)
        self._shown = np.eye(len(self._index)) * sight.position_std_m**2
        self._latest = int((known - np.arange(steps))[known < steps].max(initial=0))
        mean, cov = np.zeros((runs, plant.n_x)), np.tile(np.eye(plant.n_x) * sight.initial_std**2, (runs, 1, 1))
        self._before = {0: (mean, cov)}  # of a step, without its own position
        self._after = mean, cov  # of the newest step, with it
        self._positions: dict[int, Array] = {}
        self._mean, self._cov = mean.copy(), cov.copy()

    def told(self, step: int, positions: Array, newest: Counts, inputs: Array) -> tuple[Array, Array]:
        """Return the state (N, n_x) at the capture of the newest position known, and its covariance.

        Args:
            step: The step that begins; called for 0, 1, … in turn.
            positions: The positions (N, n_axes) that are captured now, whether they come or not.
            newest: Capture step (N,) of the newest position known.
            inputs: Inputs (N, step, n_u) that have acted.
        """
        self._positions[step] = positions
        if step:
            self._before[step] = self._moved(*self._after, inputs[:, step - 1])
        (come,) = np.nonzero((self._known[:, : step + 1] == step).any(axis=0))
        for past in range(int(come[0]) if come.size else step, step + 1):
            mean, cov = self._after = self._seen(past, step)
            own = newest == past
            self._mean[own], self._cov[own] = mean[own], cov[own]
            if past < step:
                self._before[past + 1] = self._moved(mean, cov, inputs[:, past])
        for past in [one for one in self._before if one < step - self._latest]:
            del self._before[past], self._positions[past]
        return self._mean.copy(), self._cov.copy()

    def _moved(self, mean: Array, cov: Array, u: Array) -> tuple[Array, Array]:
        """Move beliefs on by a step, under the inputs (N, n_u)."""
        plant = self._plant
        return mean @ plant.a.T + u @ plant.b.T, plant.a @ cov @ plant.a.T + self._noise

    def _seen(self, past: int, step: int) -> tuple[Array, Array]:
        """Return the belief of a step by its own position too, in the runs that know it in `step`."""
        mean, cov = (one.copy() for one in self._before[past])
        index = self._index
        if not past:
            mean[:, index] = self._positions[0]
            cov[np.ix_(range(len(cov)), index, index)] = self._shown
            return mean, cov
        (who,) = np.nonzero(self._known[:, past] <= step)
        held = cov[who]
        ph = held[:, :, index]
        gain = np.linalg.solve(ph[:, index] + self._shown, ph.transpose(0, 2, 1)).transpose(0, 2, 1)
        off = self._positions[past][who] - mean[who][:, index]
        keep = np.tile(np.eye(mean.shape[1]), (who.size, 1, 1))
        keep[:, :, index] -= gain
        mean[who] += (gain @ off[:, :, None])[:, :, 0]
        # Joseph's form: symmetric and positive semidefinite whatever rounding does.
        cov[who] = keep @ held @ keep.transpose(0, 2, 1) + gain @ self._shown @ gain.transpose(0, 2, 1)
        return mean, cov


# The linear world of a campaign: N runs in step, one controller, in memory.


# Beyond a limit by less than this share of it is rounding.


@dataclass(frozen=True, eq=False)
class Scene:
    """Plant that is flown, and the limits and costs by which it is judged."""

    plant: Plant  # the plant that flies; the controllers may believe in another one
    state_set: Polytope  # X
    input_set: Polytope  # U: the actuators' limits, which hold whatever a controller asks
    q_x: Array  # Q_x (n_x, n_x)
    q_u: Array  # Q_u (n_u, n_u)
    target: Array  # equilibrium to go to (n_x,), with input u_target
    u_target: Array  # its input (n_u,)
    start: Array  # x(0) (N, n_x)


@dataclass(frozen=True, eq=False)
class Flown:
    """Trajectories of N runs of T steps."""

    states: Array  # (N, T+1, n_x)
    inputs: Array  # inputs that acted (N, T, n_u), within the limits
    asked: Array  # inputs that the controller asked for (N, T, n_u)
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


def fly(
    scene: Scene,
    controller: BatchController,
    newest: Counts,
    disturbances: Array,
    seen: MeasuredPositions | None = None,
) -> Flown:
    """Fly all runs at once.

    Args:
        newest: Capture step of the newest position known in each step (N, T), see `links.newest`.
        disturbances: w (N, T, n_w).
        seen: Filter and noise of measured positions; None: the controller knows the exact state.
    """
    plant, (runs, steps) = scene.plant, newest.shape
    states, inputs = np.zeros((runs, steps + 1, plant.n_x)), np.zeros((runs, steps, plant.n_u))
    asked = np.zeros_like(inputs)
    states[:, 0] = scene.start
    failed = np.zeros(runs, dtype=np.bool_)
    every = np.arange(runs)
    low, high = scene.input_set.bounds
    controller.begin(runs)
    where = list(plant.position_index)
    for k in range(steps):
        if seen is None:
            state, cov = states[every, newest[:, k]], None
        else:
            state, cov = seen.filter.told(k, states[:, k, where] + seen.noise[:, k], newest[:, k], inputs[:, :k])
        news = Information(k, newest[:, k], state, inputs[:, :k], cov)
        wanted = controller.act(news)
        failed |= ~np.isfinite(wanted).all(axis=1)
        asked[:, k] = np.where(failed[:, None], 0.0, wanted)
        inputs[:, k] = np.clip(asked[:, k], low, high)
        states[:, k + 1] = states[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + disturbances[:, k] @ plant.e.T
    x, u = states[:, :-1] - scene.target, inputs - scene.u_target
    return Flown(
        states=states,
        inputs=inputs,
        asked=asked,
        age=np.arange(steps) - newest,
        cost=np.einsum("nti,ij,ntj->nt", x, scene.q_x, x) + np.einsum("nti,ij,ntj->nt", u, scene.q_u, u),
        state_violated=_outside(scene.state_set, states[:, 1:]),
        input_violated=_outside(scene.input_set, asked),
        failed=failed,
    )


def _outside(limits: Polytope, points: Array) -> Flags:
    """Return which points (…, n) are outside the set."""
    room = limits.b * (1.0 + _ROUNDING * np.sign(limits.b)) + _ROUNDING
    return np.asarray((points @ limits.c.T > room).any(axis=-1), dtype=np.bool_)
