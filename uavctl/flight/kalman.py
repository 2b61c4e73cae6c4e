"""Kalman filter in continuous time over a piecewise constant disturbance: the Gaussian part, without a memory.

Between two boundaries of the Δt grid the disturbance w is one draw of N(0, W); it is redrawn at each boundary. So
the filter carries z = (x, w) with the covariance of both, and at a boundary forgets w: mean 0, covariance W,
uncorrelated with x. With u piecewise constant this is exact at any instant.

Where a bias of the input is estimated, x is (x, d) of the larger plant (`uavctl.smpc.estimate`). While others fly
the vehicle, what accelerates it is no bias: d is drawn anew at each boundary, with the variance that it begins with.

Where the vehicle's inertial data are used, x is (x, d, b): they show the acceleration of each axis plus b, which
comes and goes slowly: a bias of the sensors, and an attitude that is not quite level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from uavctl.flight.limits import AXES
from uavctl.records import PositionSample, Vec3
from uavctl.smpc.estimate import at_once, with_bias, with_wander
from uavctl.smpc.plant import Plant

# Exact propagation of state and disturbance over any part of a Δt interval, fast enough for every tick.


Array = NDArray[np.float64]

# exp(G Δt s) is entire in s: this many Chebyshev terms on [0, 1] reach rounding for any plant whose
# fastest time constant is above a twentieth of Δt.
_TERMS = 32
_MOST_PARTS = 64


@dataclass(frozen=True, eq=False)
class Propagation:
    """z(t + dt) = F(dt) z(t) + G(dt) u for z = (x, w), u and w held; 0 < dt <= Δt."""

    dt_ns: int  # δt [ns]
    whole: Array  # F and G side by side over Δt (n_x + n_w, n_x + n_w + n_u)
    series: Array  # chebyshev coefficients of the same in 2 dt/Δt - 1 (terms, its entries)
    # F and G of the first spans that were asked for: the ticks' own, which come again and again
    parts: dict[int, tuple[Array, Array]] = field(default_factory=dict, repr=False)

    def over(self, dt_ns: int) -> tuple[Array, Array]:
        """(F, G) over `dt_ns`, 0 < dt_ns <= Δt; each by itself in memory, as products want it."""
        known = self.parts.get(dt_ns)
        if known is None:
            known = self._part(dt_ns)
            if len(self.parts) < _MOST_PARTS:
                self.parts[dt_ns] = known
        return known

    def _part(self, dt_ns: int) -> tuple[Array, Array]:
        if dt_ns == self.dt_ns:
            joint = self.whole
        else:
            angle = math.acos(2.0 * dt_ns / self.dt_ns - 1.0)
            joint = (np.cos(angle * _ORDERS) @ self.series).reshape(self.whole.shape)
        n_z = joint.shape[0]
        part = joint[:, :n_z].copy(), joint[:, n_z:].copy()
        for array in part:
            array.flags.writeable = False
        return part


_ORDERS = np.arange(_TERMS, dtype=np.float64)


def make_propagation(plant: Plant, dt_ns: int) -> Propagation:
    """Sample `plant.transition` at the Chebyshev nodes of (0, Δt) and fit the series.

    `plant.transition` takes a matrix exponential each time; a tick cannot afford that.
    """
    angles = (np.arange(_TERMS) + 0.5) * math.pi / _TERMS
    samples = np.array([_joint(plant, plant.dt_s * 0.5 * (1.0 + math.cos(angle))).ravel() for angle in angles])
    series = 2.0 / _TERMS * np.cos(np.outer(_ORDERS, angles)) @ samples
    series[0] *= 0.5
    whole = _joint(plant, plant.dt_s)
    for array in (series, whole):
        array.flags.writeable = False
    return Propagation(dt_ns=dt_ns, whole=whole, series=series)


def _joint(plant: Plant, dt_s: float) -> Array:
    """[[A, E, B], [0, I, 0]] over dt_s."""
    a, b, e = plant.transition(dt_s)
    n_w = plant.n_w
    return np.block([[a, e, b], [np.zeros((n_w, plant.n_x)), np.eye(n_w), np.zeros((n_w, plant.n_u))]])


# Inertial data further from the prediction than this many standard deviations, in any axis, are not believed: twenty
# come in a second, so one that is left out for nothing costs next to nothing.
FELT_SIGMA = 3.0
# So many of them in a row, or a position so far from where they carried the estimate (squared distance by covariance,
# three axes: chance 1e-8), and they are doubted, until positions agree again and for this time at least.
REFUSED, CONTRADICTED = 3, 40.0
DOUBTED_NS = 3_000_000_000
AGREES_NS = 1_000_000_000  # after the position before, a position that agrees says something
# A bias that may drift fast is what inertial data show. Positions alone show it late and with their noise and the
# model's errors in it: in a silence a vehicle that said nothing itself was flown 6 m out against a wind that was none.
# So it drifts a tenth as fast while no inertial data are used, and from so long after the newest ones on.
UNFELT_DRIFT, UNFELT_NS = 0.1, 1_000_000_000
# The first ones are not refused for a bias that nobody can know yet: a flight that begins in wind would doubt them.
SETTLES_NS = 40_000_000_000  # in which covariances settle
RELEARNT_MPS = 0.2  # standard deviation of a velocity that doubted data may have left behind


@dataclass(frozen=True)
class EstimatorParameters:
    """Parameters of the estimator: what it assumes of samples, biases and inertial data."""

    position_std_m: float  # least standard deviation of a position sample, each axis [m]; a sample may claim more
    velocity_std_mps: float  # standard deviation of a velocity sample, each axis [m/s]
    initial_std: float  # standard deviation of the states that the first sample does not show
    window_s: float  # samples later than this are refused [s]
    max_position_m: float  # largest plausible position, each axis [m]
    max_velocity_mps: float  # largest plausible velocity, each axis [m/s]
    # Standard deviation of what an input's bias gains in a second [input units / √s]; 0: there is none
    bias_drift: float = 0.0
    # Bias that plans leave room for, each input [input units]; it begins with a quarter as deviation
    bias_max: float = 0.0
    # Largest bias that is flown against, of each input (n_u,) [input units]; empty: bias_max
    bias_bounds: tuple[float, ...] = ()
    # Standard deviation of the inertial data of a tick, each axis [m/s²]; 0: they are not used
    inertial_std_mps2: float = 0.0
    inertial_bias_mps2: float = 0.1  # standard deviation of what they are off for longer [m/s²]
    inertial_bias_s: float = 20.0  # time in which that comes and goes [s]


@dataclass(frozen=True, eq=False)
class Kalman:
    """The constant part of the filter: model, noise and indices."""

    propagation: Propagation  # F and G of z = (x, w)
    w: Array  # covariance W (n_w, n_w)
    unfelt_w: Array  # the same while the filter could use inertial data and has none (n_w, n_w)
    n_x: int  # number of states: the plant's, the biases, and what inertial data are off
    n_u: int  # number of inputs
    n_bias: int  # number of biases, behind the plant's states: n_u, or 0 where none is estimated
    n_felt: int  # number of axes of inertial data, the last of the states: 0 where they are not used
    axes: tuple[int, ...]  # index (0 north, 1 east, 2 down) of each axis that the plant has
    shown: NDArray[np.intp]  # state index of each axis' position, then of each axis' velocity
    parameters: EstimatorParameters  # noise and window
    felt_z: Array  # measurement matrix of inertial data for z (n_felt, n_x + n_w)
    felt_u: Array  # the same for the input (n_felt, n_u)
    felt_noise: Array  # covariance of their noise (n_felt, n_felt)
    pushed: Array  # covariance that a push of bias_max in each input's bias gives z at once (n_x + n_w, n_x + n_w)
    identity: Array  # of the size of z

    @property
    def bias_bounds(self) -> tuple[float, ...]:
        """Largest bias that is flown against, of each input that has one [input units]."""
        return (self.parameters.bias_bounds or (self.parameters.bias_max,) * self.n_bias)[: self.n_bias]

    @property
    def bias(self) -> slice:
        """Slice of the biases among the states."""
        return slice(self.n_x - self.n_felt - self.n_bias, self.n_x - self.n_felt)


class Belief(msgspec.Struct, frozen=True, eq=False):
    """Gaussian of z = (x, w) at `at_ns`, and what went into it."""

    at_ns: int  # time [ns]
    captured_ns: int  # capture time of the newest sample in it [ns]
    mean: Array  # (n_x + n_w,)
    cov: Array  # (n_x + n_w, n_x + n_w)
    felt_ns: int | None = None  # time of the newest inertial data in it [ns]; None without any
    refused: int = 0  # inertial data in a row that were not believed
    doubted_ns: int | None = None  # since when inertial data are doubted, and not used [ns]; None where they are not


def make_kalman(plant: Plant, parameters: EstimatorParameters, dt_ns: int) -> Kalman:
    """The filter of a plant, with `dt_ns` the integer Δt of the grid [ns]."""
    n_bias, feels = plant.n_u if parameters.bias_drift else 0, parameters.inertial_std_mps2 > 0.0
    seen = with_bias(plant, parameters.bias_drift, force=feels) if n_bias else plant
    n_felt = len(plant.axes) if feels else 0
    if n_felt:
        seen = with_wander(seen, np.full(n_felt, parameters.inertial_bias_mps2), parameters.inertial_bias_s)
    # An acceleration is the slope of a velocity: z is (x, w), and w is held between boundaries.
    slopes = seen.generator[list(plant.velocity_index)] if feels else np.zeros((0, seen.n_x + seen.n_u + seen.n_w))
    felt_z = np.delete(slopes, slice(seen.n_x, seen.n_x + seen.n_u), axis=1)
    felt_z[:, seen.n_x - n_felt : seen.n_x] += np.eye(n_felt)
    n_z = seen.n_x + seen.n_w
    push = np.zeros((n_z, n_bias))
    if n_bias and n_felt:
        push[: plant.n_x] = at_once(plant)
        push[plant.n_x : plant.n_x + n_bias] = np.eye(n_bias)
    unfelt_w = seen.w.copy()
    if n_felt and n_bias:
        drift = slice(plant.n_w, plant.n_w + n_bias)
        unfelt_w[drift, drift] *= UNFELT_DRIFT**2
    return Kalman(
        propagation=make_propagation(seen, dt_ns),
        w=seen.w,
        unfelt_w=unfelt_w,
        n_x=seen.n_x,
        n_u=plant.n_u,
        n_bias=n_bias,
        n_felt=n_felt,
        axes=tuple(AXES.index(axis) for axis in plant.axes),
        shown=np.array(plant.position_index + plant.velocity_index, dtype=np.intp),
        parameters=parameters,
        felt_z=felt_z,
        felt_u=slopes[:, seen.n_x : seen.n_x + seen.n_u],
        felt_noise=np.eye(n_felt) * parameters.inertial_std_mps2**2,
        pushed=parameters.bias_max**2 * push @ push.T,
        identity=np.eye(n_z),
    )


def settled_cov(kalman: Kalman, dt_ns: int, age_ns: int, dead_ns: int) -> Array:
    """Covariance (n, n) of states and biases that a filter settles at, with a position and inertial data in every step.

    Args:
        dt_ns: Δt [ns].
        age_ns: Age of a step's position at the step's end, up to Δt [ns].
        dead_ns: How long after that end it is asked for [ns].
    """

    def position(at_ns: int) -> PositionSample:
        return PositionSample(
            captured_ns=at_ns, received_ns=at_ns, position_m=(0.0, 0.0, 0.0), std_m=0.0, source="", seq=0
        )

    still, belief = np.zeros(kalman.n_u), first_belief(kalman, position(0))
    n, steps = kalman.bias.stop, SETTLES_NS // dt_ns
    for end_ns in range(dt_ns, (steps + 1) * dt_ns, dt_ns):
        at_ns = end_ns - age_ns
        belief = predicted(kalman, 0, belief, still, at_ns)
        belief = updated(kalman, belief, position(at_ns))
        belief = predicted(kalman, 0, belief, still, end_ns)
        if kalman.n_felt:
            belief = felt(kalman, belief, kalman.felt_z.dot(belief.mean), still)
    return predicted(kalman, 0, belief, still, steps * dt_ns + dead_ns).cov[:n, :n]


def captured_ns(sample: PositionSample) -> int:
    """Capture time that counts: never after the arrival, where a clock offset's error may put the stamp."""
    return min(sample.captured_ns, sample.received_ns)


def predicted(kalman: Kalman, origin_ns: int, belief: Belief, u: Array | None, at_ns: int) -> Belief:
    """The belief at `at_ns`; the grid's boundaries cut the way at the same places whatever came in.

    Args:
        origin_ns: A boundary of the grid [ns].
        u: Input that acts (n_u,); None while others fly the vehicle.
        at_ns: Time to predict for [ns].
    """
    now_ns, mean, cov = belief.at_ns, belief.mean, belief.cov
    if now_ns >= at_ns:
        return belief
    propagation, n_x = kalman.propagation, kalman.n_x
    acting = np.zeros(kalman.n_u) if u is None else u
    while now_ns < at_ns:
        boundary_ns = now_ns - (now_ns - origin_ns) % propagation.dt_ns + propagation.dt_ns
        stop_ns = min(at_ns, boundary_ns)
        f, g = propagation.over(stop_ns - now_ns)
        mean = f.dot(mean)
        mean += g.dot(acting)
        cov = _symmetric(f.dot(cov).dot(f.T))
        if stop_ns == boundary_ns:
            mean[n_x:] = 0.0
            cov[:n_x, n_x:] = 0.0
            cov[n_x:, :n_x] = 0.0
            cov[n_x:, n_x:] = kalman.w if _feels(belief, stop_ns) else kalman.unfelt_w
            if u is None and kalman.n_bias:
                _forget_bias(kalman, mean, cov)
        now_ns = stop_ns
    return replace(belief, at_ns=now_ns, mean=mean, cov=cov)


def _feels(belief: Belief, at_ns: int) -> bool:
    """Whether inertial data are used at a time."""
    return belief.doubted_ns is None and belief.felt_ns is not None and at_ns - belief.felt_ns <= UNFELT_NS


def _forget_bias(kalman: Kalman, mean: Array, cov: Array) -> None:
    """Put the biases of a belief back to what they begin with, in place."""
    bias = kalman.bias
    mean[bias] = 0.0
    cov[bias] = 0.0
    cov[:, bias] = 0.0
    cov[bias, bias] = np.eye(kalman.n_bias) * (0.25 * kalman.parameters.bias_max) ** 2


def first_belief(kalman: Kalman, sample: PositionSample) -> Belief:
    """The belief after the first sample: what it shows, and zero for what it does not."""
    n_x, n_w = kalman.n_x, kalman.w.shape[0]
    values, variances = shown_by(kalman, sample)
    index = kalman.shown[: len(values)]
    mean = np.zeros(n_x + n_w)
    mean[index] = values
    diagonal = np.full(n_x, kalman.parameters.initial_std**2)
    diagonal[index] = variances
    cov = np.zeros((n_x + n_w, n_x + n_w))
    cov[:n_x, :n_x] = np.diag(diagonal)
    cov[n_x:, n_x:] = kalman.unfelt_w
    if kalman.n_bias:
        _forget_bias(kalman, mean, cov)
    if kalman.n_felt:
        felt = slice(n_x - kalman.n_felt, n_x)
        cov[felt, felt] = np.eye(kalman.n_felt) * kalman.parameters.inertial_bias_mps2**2
    at_ns = captured_ns(sample)
    return Belief(at_ns=at_ns, captured_ns=at_ns, mean=mean, cov=cov)


def updated(kalman: Kalman, belief: Belief, sample: PositionSample) -> Belief:
    """Kalman update; the covariance in Joseph's form, which stays symmetric and positive semidefinite."""
    values, variances = shown_by(kalman, sample)
    index = kalman.shown[: len(values)]
    noise = kalman.identity[: len(values), : len(values)] * variances
    if kalman.n_felt:
        belief = _confronted(kalman, belief, values, variances)
    ph = belief.cov[:, index]
    gain = np.linalg.solve(ph[index] + noise, ph.T).T
    keep = kalman.identity.copy()
    keep[:, index] -= gain
    return replace(
        belief,
        captured_ns=captured_ns(sample),
        mean=belief.mean + gain.dot(values - belief.mean[index]),
        cov=_symmetric(keep.dot(belief.cov).dot(keep.T) + gain.dot(noise).dot(gain.T)),
    )


def contradicted(kalman: Kalman, belief: Belief, values: Array, variances: Array) -> bool:
    """Whether the squared distance of what a sample shows from what is believed, by its covariance, is too large."""
    index = kalman.shown[: len(values)]
    off = values - belief.mean[index]
    # By the sample's own noise alone it is larger yet: where even that is well within, nothing has to be solved.
    if float(off.dot(off)) <= 0.9 * CONTRADICTED * float(variances.min()):
        return False
    noise = kalman.identity[: len(values), : len(values)] * variances
    return float(off @ np.linalg.solve(belief.cov[np.ix_(index, index)] + noise, off)) > CONTRADICTED


def _confronted(kalman: Kalman, belief: Belief, values: Array, variances: Array) -> Belief:
    """The belief before an update, with its inertial data doubted, or not any more, by what a sample shows."""
    off = contradicted(kalman, belief, values, variances)
    if belief.doubted_ns is not None:
        knows = belief.at_ns - belief.captured_ns <= AGREES_NS  # with whatever came, nearly all agrees after a silence
        ended = knows and not off and belief.at_ns - belief.doubted_ns >= DOUBTED_NS
        return replace(belief, refused=0, doubted_ns=None) if ended else belief
    if not off or belief.felt_ns is None or belief.felt_ns <= belief.captured_ns:
        return belief
    cov = belief.cov.copy()
    _widen(cov, kalman.shown[len(kalman.axes) :], RELEARNT_MPS**2)
    if kalman.n_bias:
        _widen(cov, np.arange(kalman.bias.start, kalman.bias.stop), (0.25 * kalman.parameters.bias_max) ** 2)
    return replace(belief, cov=cov, doubted_ns=belief.at_ns)


def _widen(cov: Array, index: NDArray[np.intp], variance: float) -> None:
    """Add to variances, in place."""
    cov[index, index] += variance


def felt(kalman: Kalman, belief: Belief, accel_mps2: Array, u: Array | None) -> Belief:
    """Kalman update with an acceleration (n_felt,) under an input (n_u,); left out where it is implausible.

    Raises:
        ValueError: The filter uses no inertial data.
    """
    if not kalman.n_felt:
        raise ValueError("this filter uses no inertial data")
    if belief.doubted_ns is not None:
        return belief
    of_z, noise, cov = kalman.felt_z, kalman.felt_noise, belief.cov
    if belief.felt_ns is None and kalman.n_bias:
        cov = cov + kalman.pushed
    off = accel_mps2 - of_z.dot(belief.mean)
    if u is not None:
        off -= kalman.felt_u.dot(u)
    ph = cov.dot(of_z.T)
    shown = of_z.dot(ph) + noise
    if not bool((np.square(off) <= FELT_SIGMA**2 * np.diagonal(shown)).all()):
        refused = belief.refused + 1
        return replace(belief, refused=refused, doubted_ns=belief.at_ns if refused >= REFUSED else None)
    gain = np.linalg.solve(shown, ph.T).T
    keep = kalman.identity - gain.dot(of_z)
    return replace(
        belief,
        mean=belief.mean + gain.dot(off),
        cov=_symmetric(keep.dot(cov).dot(keep.T) + gain.dot(noise).dot(gain.T)),
        felt_ns=belief.at_ns,
        refused=0,
    )


def shown_by(kalman: Kalman, sample: PositionSample) -> tuple[Array, Array]:
    """Values that a sample shows (positions, then velocities if it has them) and their variances."""
    parameters, axes = kalman.parameters, kalman.axes
    values = _of_axes(sample.position_m, axes)
    variances = [max(sample.std_m, parameters.position_std_m) ** 2] * len(axes)
    if sample.velocity_mps is not None:
        values += _of_axes(sample.velocity_mps, axes)
        variances += [parameters.velocity_std_mps**2] * len(axes)
    return np.array(values), np.array(variances)


def _of_axes(vector: Vec3, axes: tuple[int, ...]) -> list[float]:
    return [vector[axis] for axis in axes]


def _symmetric(matrix: Array) -> Array:
    both: Array = matrix + matrix.T
    both *= 0.5
    return both
