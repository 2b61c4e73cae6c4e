"""Kalman filter in continuous time over a piecewise constant disturbance: the Gaussian part, without a memory.

1. State z = (x, w). The disturbance w is one draw of N(0, W) in each interval of the Δt grid.
2. Prediction to any instant is exact, as the input u is piecewise constant. At a boundary of the grid w is drawn anew:
   mean 0, covariance W, independent of x.
3. Where a bias d of the input is estimated, x is (x, d) of the larger plant (`uavctl.smpc.estimate`). While others fly
   the vehicle, what accelerates it is no bias: d is drawn anew at each boundary, from its initial distribution. So are
   the plant's gusts.
4. Where the vehicle's inertial data are used, x is (x, d, b). They show the acceleration of each axis plus b, which
   comes and goes slowly: a bias of the sensors, and an attitude that is not quite level.
5. Each update first asks whether inertial data may be used (`uavctl.flight.monitors.inertial`).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.flight.limits import AXES
from uavctl.flight.monitors import inertial
from uavctl.flight.monitors.inertial import UNUSED, ComparedSource, InertialObservation, InertialTrust
from uavctl.flight.propagation import Propagation, make_propagation
from uavctl.records import PositionSample, Vec3
from uavctl.smpc.estimate import add_bias, add_gauss_markov, force_jump
from uavctl.smpc.plant import Plant

# Only inertial data show a bias that drifts fast. Positions alone show it late, with their noise and the model's
# errors in it. Without positions a vehicle flew 6 m out, against a wind that did not exist. So the bias drifts a tenth
# as fast while no inertial data are used, and from this long after the newest ones on.
DRIFT_WITHOUT_INERTIAL, INERTIAL_LASTS_NS = 0.1, 1_000_000_000
SETTLES_NS = 40_000_000_000  # time in which covariances settle
RELEARN_STD_MPS = 0.2  # standard deviation of a velocity error that inertial data may have left behind


@dataclass(frozen=True)
class EstimatorParameters:
    """Parameters of the estimator: its assumptions on samples, biases and inertial data."""

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
    # Rows of w in the covariance of z where w is drawn anew, [0, W] (n_w, n_x + n_w)
    drawn_rows: Array
    drawn_rows_without_inertial: Array  # the same while the filter could use inertial data and has none
    n_x: int  # number of states: the plant's, the biases, and what inertial data are off
    n_u: int  # number of inputs
    n_bias: int  # number of biases, behind the plant's states: n_u, or 0 where none is estimated
    n_inertial: int  # number of axes of inertial data, the last of the states: 0 where they are not used
    axes: tuple[int, ...]  # index (0 north, 1 east, 2 down) of each axis that the plant has
    measured_index: NDArray[np.intp]  # state index of each axis' position, then of each axis' velocity
    parameters: EstimatorParameters  # noise and window
    inertial_z: Array  # measurement matrix of inertial data for z (n_inertial, n_x + n_w)
    inertial_u: Array  # the same for the input (n_inertial, n_u)
    inertial_noise: Array  # covariance of their noise (n_inertial, n_inertial)
    push_cov: Array  # covariance that a push of bias_max in each input's bias gives z at once (n_x + n_w, n_x + n_w)
    measured_z: Array  # measurement matrix of positions, then velocities, for z (2 n_axes, n_x + n_w)
    identity: Array  # of the size of z
    gusts: slice  # slice of the plant's gusts among the states, empty without gusts
    gust_mps2: Array  # their standard deviations in the long run (n_gusts,)
    # Largest bias that is flown against, of each input that has one [input units]; made from the others
    bias_bounds: tuple[float, ...] = field(init=False)
    bias: slice = field(init=False)  # slice of the biases among the states; made from the others
    window_ns: int = field(init=False)  # samples later than this are refused [ns]; made from the parameters

    def __post_init__(self) -> None:
        bounds = (self.parameters.bias_bounds or (self.parameters.bias_max,) * self.n_bias)[: self.n_bias]
        object.__setattr__(self, "bias_bounds", bounds)
        object.__setattr__(self, "bias", slice(self.n_x - self.n_inertial - self.n_bias, self.n_x - self.n_inertial))
        object.__setattr__(self, "window_ns", round(self.parameters.window_s * 1e9))


class Belief(msgspec.Struct, frozen=True, eq=False):
    """Gaussian of z = (x, w) at `at_ns`, and its sources."""

    at_ns: int  # time [ns]
    captured_ns: int  # capture time of the newest sample in it [ns]
    mean: Array  # (n_x + n_w,)
    cov: Array  # (n_x + n_w, n_x + n_w)
    inertial: InertialTrust = UNUSED  # whether inertial data are used


def make_model(plant: Plant, parameters: EstimatorParameters) -> Plant:
    """Make the plant that the filter estimates: x, then the biases d, and the bias b of inertial data."""
    uses_inertial = parameters.inertial_std_mps2 > 0.0
    model = add_bias(plant, parameters.bias_drift, force=uses_inertial) if parameters.bias_drift else plant
    if not uses_inertial:
        return model
    return add_gauss_markov(model, np.full(len(plant.axes), parameters.inertial_bias_mps2), parameters.inertial_bias_s)


def make_kalman(plant: Plant, parameters: EstimatorParameters, dt_ns: int) -> Kalman:
    """Make the filter of a plant, with `dt_ns` the integer Δt of the grid [ns]."""
    model = make_model(plant, parameters)
    n_bias = plant.n_u if parameters.bias_drift else 0
    n_inertial = len(plant.axes) if parameters.inertial_std_mps2 else 0
    inertial_z, inertial_u = _make_inertial_model(plant, model, n_inertial)
    push = np.zeros((model.n_x + model.n_w, n_bias))
    if n_bias and n_inertial:
        push[: plant.n_x] = force_jump(plant)
        push[plant.n_x : plant.n_x + n_bias] = np.eye(n_bias)
    w_without_inertial = model.w.copy()
    if n_inertial and n_bias:
        drift = slice(plant.n_w, plant.n_w + n_bias)
        w_without_inertial[drift, drift] *= DRIFT_WITHOUT_INERTIAL**2
    identity = np.eye(model.n_x + model.n_w)
    measured_index = np.array(plant.position_index + plant.velocity_index, dtype=np.intp)
    return Kalman(
        propagation=make_propagation(model, dt_ns),
        w=model.w,
        drawn_rows=np.pad(model.w, ((0, 0), (model.n_x, 0))),
        drawn_rows_without_inertial=np.pad(w_without_inertial, ((0, 0), (model.n_x, 0))),
        n_x=model.n_x,
        n_u=plant.n_u,
        n_bias=n_bias,
        n_inertial=n_inertial,
        axes=tuple(AXES.index(axis) for axis in plant.axes),
        measured_index=measured_index,
        parameters=parameters,
        inertial_z=inertial_z,
        inertial_u=inertial_u,
        inertial_noise=np.eye(n_inertial) * parameters.inertial_std_mps2**2,
        push_cov=parameters.bias_max**2 * push @ push.T,
        measured_z=identity[measured_index],
        identity=identity,
        gusts=plant.gusts,
        gust_mps2=np.array(plant.gust_mps2),
    )


def _make_inertial_model(plant: Plant, model: Plant, n_inertial: int) -> tuple[Array, Array]:
    """Make the measurement matrices of inertial data for z = (x, w) and for the input."""
    n_x, n_u = model.n_x, model.n_u
    # a = v' = M_z z + M_u u + b: the rows of the velocities in the generator, and the sensors' own bias b
    slopes = model.generator[list(plant.velocity_index)] if n_inertial else np.zeros((0, n_x + n_u + model.n_w))
    of_z = np.delete(slopes, slice(n_x, n_x + n_u), axis=1)
    of_z[:, n_x - n_inertial : n_x] += np.eye(n_inertial)
    return of_z, slopes[:, n_x : n_x + n_u]


def settle_covariance(kalman: Kalman, dt_ns: int, age_ns: int, dead_ns: int) -> Array:
    """Compute the covariance (n, n) at which a filter settles, with a position and inertial data in every step.

    It is that of the states and, behind them, of the biases.

    Args:
        dt_ns: Δt [ns].
        age_ns: Age of a step's position at the step's end, up to Δt [ns].
        dead_ns: How long after that end it is asked for [ns].
    """

    def position(at_ns: int) -> PositionSample:
        return PositionSample(
            captured_ns=at_ns, received_ns=at_ns, position_m=(0.0, 0.0, 0.0), std_m=0.0, source="", seq=0
        )

    still, belief = np.zeros(kalman.n_u), make_first_belief(kalman, position(0))
    n, steps = kalman.bias.stop, SETTLES_NS // dt_ns
    for end_ns in range(dt_ns, (steps + 1) * dt_ns, dt_ns):
        at_ns = end_ns - age_ns
        belief = predict(kalman, 0, belief, still, at_ns)
        belief = update_with_position(kalman, belief, position(at_ns))
        belief = predict(kalman, 0, belief, still, end_ns)
        if kalman.n_inertial:
            belief = update_with_inertial(kalman, belief, kalman.inertial_z.dot(belief.mean), still)
    return predict(kalman, 0, belief, still, steps * dt_ns + dead_ns).cov[:n, :n]


def read_capture_ns(sample: PositionSample) -> int:
    """Return the capture time that counts: never after the arrival, where a clock offset's error may put the stamp."""
    return min(sample.captured_ns, sample.received_ns)


def predict(kalman: Kalman, origin_ns: int, belief: Belief, u: Array | None, at_ns: int) -> Belief:
    """Predict a belief for `at_ns`. The grid's boundaries always cut the time at the same places.

    Args:
        origin_ns: A boundary of the grid [ns].
        u: Input that acts (n_u,); None while others fly the vehicle.
        at_ns: Time to predict for [ns].
    """
    now_ns, mean, cov = belief.at_ns, belief.mean, belief.cov
    if now_ns >= at_ns:
        return belief
    propagation = kalman.propagation
    acting = np.zeros(kalman.n_u) if u is None else u
    while now_ns < at_ns:
        boundary_ns = now_ns - (now_ns - origin_ns) % propagation.dt_ns + propagation.dt_ns
        stop_ns = min(at_ns, boundary_ns)
        f, half_transposed, g = propagation.over(stop_ns - now_ns)
        # z = F z + G u
        mean = f.dot(mean)
        mean += g.dot(acting)
        # P = ½ F P F' + (½ F P F')'
        half = f.dot(cov).dot(half_transposed)
        cov = half.T.copy()
        cov += half
        if stop_ns == boundary_ns:
            _draw_disturbance(kalman, mean, cov, _uses_inertial(belief.inertial, stop_ns))
            if u is None:
                _reset_pushes(kalman, mean, cov)
        now_ns = stop_ns
    return Belief(now_ns, belief.captured_ns, mean, cov, belief.inertial)


def _draw_disturbance(kalman: Kalman, mean: Array, cov: Array, uses_inertial: bool) -> None:
    """Draw the disturbance anew, in place: w ~ N(0, W), independent of x."""
    n_x = kalman.n_x
    mean[n_x:] = 0.0
    cov[:n_x, n_x:] = 0.0
    cov[n_x:] = kalman.drawn_rows if uses_inertial else kalman.drawn_rows_without_inertial


def _uses_inertial(trust: InertialTrust, at_ns: int) -> bool:
    """Whether inertial data are used at a time."""
    is_recent = trust.used_ns is not None and at_ns - trust.used_ns <= INERTIAL_LASTS_NS
    return is_recent and trust.distrusted_ns is None


def _reset_pushes(kalman: Kalman, mean: Array, cov: Array) -> None:
    """Set biases and gusts of a belief to their initial distributions, in place."""
    if kalman.n_bias:
        # d ~ N(0, (d_max / 4)²)
        _redraw(mean, cov, kalman.bias, np.eye(kalman.n_bias) * (0.25 * kalman.parameters.bias_max) ** 2)
    if kalman.gust_mps2.size:
        _redraw(mean, cov, kalman.gusts, np.diag(np.square(kalman.gust_mps2)))


def _redraw(mean: Array, cov: Array, states: slice, states_cov: Array) -> None:
    """Set some states to zero mean and a covariance, independent of all else, in place."""
    mean[states] = 0.0
    cov[states] = 0.0
    cov[:, states] = 0.0
    cov[states, states] = states_cov


def make_first_belief(kalman: Kalman, sample: PositionSample) -> Belief:
    """Make the belief after the first sample: its values, and zero for all that it does not show."""
    n_x, n_w = kalman.n_x, kalman.w.shape[0]
    values, variances = read_measurement(kalman, sample)
    index = kalman.measured_index[: len(values)]
    mean = np.zeros(n_x + n_w)
    mean[index] = values
    diagonal = np.full(n_x, kalman.parameters.initial_std**2)
    diagonal[index] = variances
    cov = np.zeros((n_x + n_w, n_x + n_w))
    cov[:n_x, :n_x] = np.diag(diagonal)
    _draw_disturbance(kalman, mean, cov, uses_inertial=False)
    _reset_pushes(kalman, mean, cov)
    if kalman.n_inertial:
        sensor_bias = slice(n_x - kalman.n_inertial, n_x)
        cov[sensor_bias, sensor_bias] = np.eye(kalman.n_inertial) * kalman.parameters.inertial_bias_mps2**2
    at_ns = read_capture_ns(sample)
    return Belief(at_ns=at_ns, captured_ns=at_ns, mean=mean, cov=cov)


def update_with_position(kalman: Kalman, belief: Belief, sample: PositionSample) -> Belief:
    """Update a belief with a sample. Joseph's form keeps the covariance symmetric and positive semidefinite."""
    values, variances = read_measurement(kalman, sample)
    if kalman.n_inertial:
        belief = _judge_inertial(kalman, belief, values, variances)
    n, cov = len(values), belief.cov
    of_z, noise = kalman.measured_z[:n], kalman.identity[:n, :n] * variances
    # ν = y - H z
    innovation = values - of_z.dot(belief.mean)
    # S = H P H' + R
    ph = cov.dot(of_z.T)
    spread = of_z.dot(ph) + noise
    # K = P H' S⁻¹
    gain = divide_by_spread(ph, spread)
    return Belief(
        at_ns=belief.at_ns,
        captured_ns=read_capture_ns(sample),
        # z = z + K ν
        mean=belief.mean + gain.dot(innovation),
        cov=_correct_covariance(kalman, cov, gain, of_z, noise),
        inertial=belief.inertial,
    )


def divide_by_spread(ph: Array, spread: Array) -> Array:
    """Compute the gain K = P H' S⁻¹ from P H' (n, m) and the covariance S (m, m) of an innovation."""
    variances = spread.diagonal()
    if np.count_nonzero(spread) == len(variances):
        # S is diagonal where the axes are independent: K_ij = (P H')_ij (1 / S_jj), as `solve` rounds it
        return ph * (1.0 / variances)
    return np.asarray(np.linalg.solve(spread, ph.T).T, dtype=np.float64)


def _correct_covariance(kalman: Kalman, cov: Array, gain: Array, of_z: Array, noise: Array) -> Array:
    """Correct a covariance by a measurement of matrix H = `of_z` (m, n) and noise of covariance R (m, m)."""
    # I - K H
    keep = kalman.identity - gain.dot(of_z)
    # P = (I - K H) P (I - K H)' + K R K', made symmetric; a copy of the transpose makes the product faster
    half = keep.dot(cov).dot(keep.T.copy())
    half += gain.dot(noise).dot(gain.T)
    half *= 0.5
    corrected: Array = half.T.copy()
    corrected += half
    return corrected


def is_consistent(kalman: Kalman, belief: Belief, values: Array, variances: Array) -> bool:
    """Whether a sample's squared distance from a belief, by its covariance, is no larger than chance makes it."""
    index = kalman.measured_index[: len(values)]
    innovation = values - belief.mean[index]
    # ν' S⁻¹ ν ≤ ν' ν / min R: where even that is well within, nothing has to be solved.
    if float(innovation.dot(innovation)) <= 0.9 * inertial.MOST_CHI2 * min(variances.tolist()):
        return True
    noise = kalman.identity[: len(values), : len(values)] * variances
    # χ² = ν' (H P H' + R)⁻¹ ν
    chi2 = float(innovation @ np.linalg.solve(belief.cov[np.ix_(index, index)] + noise, innovation))
    return inertial.is_consistent(chi2)


def _judge_inertial(kalman: Kalman, belief: Belief, values: Array, variances: Array) -> Belief:
    """Compare a belief with a sample: inertial data are distrusted, or are not any more."""
    consistent = is_consistent(kalman, belief, values, variances)
    observation = InertialObservation(ComparedSource.POSITION, consistent, belief.at_ns, belief.captured_ns)
    trust, verdict = inertial.update(belief.inertial, observation)
    if trust is belief.inertial:
        return belief
    if verdict.is_none:
        return replace(belief, inertial=trust)
    cov = belief.cov.copy()
    _widen(cov, kalman.measured_index[len(kalman.axes) :], RELEARN_STD_MPS**2)
    if kalman.n_bias:
        _widen(cov, np.arange(kalman.bias.start, kalman.bias.stop), (0.25 * kalman.parameters.bias_max) ** 2)
    return replace(belief, cov=cov, inertial=trust)


def _widen(cov: Array, index: NDArray[np.intp], variance: float) -> None:
    """Add to variances, in place."""
    cov[index, index] += variance


def update_with_inertial(kalman: Kalman, belief: Belief, accel_mps2: Array, u: Array | None) -> Belief:
    """Update a belief with an acceleration (n_inertial,) under an input (n_u,). An implausible one is left out.

    Raises:
        ValueError: The filter uses no inertial data.
    """
    if not kalman.n_inertial:
        raise ValueError("this filter uses no inertial data")
    if belief.inertial.distrusted_ns is not None:
        return belief
    of_z, noise, cov = kalman.inertial_z, kalman.inertial_noise, belief.cov
    if belief.inertial.used_ns is None and kalman.n_bias:
        # The first reading is not refused for a bias that nobody can know yet: a flight may begin in wind.
        cov = cov + kalman.push_cov
    # ν = a - M_z z - M_u u
    innovation = accel_mps2 - of_z.dot(belief.mean)
    if u is not None:
        innovation -= kalman.inertial_u.dot(u)
    # S = M_z P M_z' + R
    ph = cov.dot(of_z.T)
    spread = of_z.dot(ph) + noise
    plausible = inertial.is_plausible(innovation.tolist(), spread.diagonal().tolist())
    observation = InertialObservation(ComparedSource.MODEL, plausible, belief.at_ns, belief.captured_ns)
    trust, _ = inertial.update(belief.inertial, observation)
    if not plausible:
        return replace(belief, inertial=trust)
    # K = P M_z' S⁻¹
    gain = divide_by_spread(ph, spread)
    return Belief(
        at_ns=belief.at_ns,
        captured_ns=belief.captured_ns,
        # z = z + K ν
        mean=belief.mean + gain.dot(innovation),
        cov=_correct_covariance(kalman, cov, gain, of_z, noise),
        inertial=trust,
    )


def compute_position_variance(parameters: EstimatorParameters, sample: PositionSample) -> float:
    """Compute the variance of a sample's position, each axis [m²]."""
    return max(sample.std_m, parameters.position_std_m) ** 2


def read_measurement(kalman: Kalman, sample: PositionSample) -> tuple[Array, Array]:
    """Return the values of a sample (positions, then velocities if it has them) and their variances."""
    parameters, axes = kalman.parameters, kalman.axes
    values = _select_axes(sample.position_m, axes)
    variances = [compute_position_variance(parameters, sample)] * len(axes)
    if sample.velocity_mps is not None:
        values += _select_axes(sample.velocity_mps, axes)
        variances += [parameters.velocity_std_mps**2] * len(axes)
    return np.array(values), np.array(variances)


def _select_axes(vector: Vec3, axes: tuple[int, ...]) -> list[float]:
    return [vector[axis] for axis in axes]
