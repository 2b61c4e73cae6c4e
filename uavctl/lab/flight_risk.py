"""Risk of a whole flight: how many of many rehearsed flights leave the room, and by how much.

`uavctl.wiring.rehearsal` flies the mission once, without disturbance. Here it is flown many times in the linear world
of the configuration, with all that is random there:

1. The vehicle moves as x(k+1) = A x(k) + B u(k) + E w(k), w ~ N(0, W), as the plans assume.
2. A position is captured each Δt, with noise, and is lost or late by the link's model. Where the flight uses inertial
   data, each step has one reading of them, with noise and a slow error, both as `estimator` assumes them.
3. The flight's filter estimates state and biases. The flight's solver plans; a plan acts after the dead time.
4. Where the position is as old as the horizon, the vehicle brakes by its predicted velocity.
5. Each flight has its own risk: the ages are counted and the steps are charged as in flight.

A flight that leaves the room is one trial. So the flights are independent, though the steps of a flight are not, and
the bound of Clopper and Pearson (1934) is exact for the probability *in this world*. Its wind, link and vehicle are the
configured ones. Monitors, setpoint limiter and the vehicle's own loops are left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.special import betaincinv

from uavctl.arrays import SECOND_NS, Array
from uavctl.config import Config
from uavctl.config.checks import get_position_limits_m
from uavctl.flight.controller import Controller
from uavctl.flight.kalman import Kalman, make_kalman, make_model
from uavctl.flight.mission import MissionState, advance_mission, find_limits, make_question
from uavctl.flight.risk import charge_step, set_risk
from uavctl.flight.risk_state import RiskGroup
from uavctl.lab.campaign.arrivals import compute_known_steps, select_newest_captures
from uavctl.lab.campaign.draws import Stream, compute_root, draw, draw_normal
from uavctl.lab.campaign.position_filter import FilterBelief, PositionFilter
from uavctl.records import SolveStatus
from uavctl.smpc.answer import Preview
from uavctl.smpc.batch import Counts
from uavctl.smpc.conditioned.design import ConditionedDesign
from uavctl.smpc.plant import Plant
from uavctl.wiring.controller import build_estimator
from uavctl.wiring.rehearsal import MAX_STEPS, make_rehearsal_start

CONFIDENCE = 0.95  # of the bound of the probability
_ROUNDING_M = 1e-9  # beyond a limit by less is rounding


class FlightRisk(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of the rehearsed flights."""

    flights: int  # rehearsed
    left: int  # flights that were beyond a limit of the position at one step or more
    seconds: float  # length of a flight [s]
    steps: int  # steps of a flight, each Δt
    steps_outside: int  # steps beyond a limit, of all flights
    max_steps_outside: int  # the same of the flight with the most
    beyond_m: float  # furthest beyond a limit; negative: the least distance kept [m]
    probability_max: float  # upper bound of the probability that a flight leaves the room, with `confidence`
    confidence: float
    step_risk: float  # 1 - delta_x: probability, at most, that a plan leaves for a step to be beyond any limit
    seed: int

    @property
    def sentence(self) -> str:
        """The result in words, with the flight as its subject."""
        # Rounded up to 0.1 %: a bound must not become smaller in print.
        percent = math.ceil(round(1000.0 * self.probability_max, 6)) / 10.0
        text = (
            f"leaves the room in {self.left} of {self.flights} rehearsals: at most {percent:g} % "
            f"({100.0 * self.confidence:g} % confidence) in {self.seconds:g} s"
        )
        if not self.left:
            return f"{text}. The nearest is {-self.beyond_m:.2f} m from a limit"
        share = self.steps_outside / (self.flights * self.steps)
        return (
            f"{text}, by at most {self.beyond_m:.2f} m. {100.0 * share:.2g} % of the steps are outside, "
            f"{100.0 * self.step_risk:.3g} % are allowed"
        )


def bound_probability(hits: int, trials: int) -> float:
    """Return the upper bound, with `CONFIDENCE`, of a probability by hits in independent trials.

    It is the one-sided bound of Clopper and Pearson (1934): the p with P(X ≤ hits) = 1 - `CONFIDENCE`, where X is
    binomial.
    """
    return float(betaincinv(hits + 1.0, trials - hits, CONFIDENCE)) if hits < trials else 1.0


def rehearse_flights(
    config: Config,
    design: ConditionedDesign,
    controller: Controller,
    seed: int = 0,
    report_progress: Callable[[int, int], None] | None = None,
) -> FlightRisk | None:
    """Fly the mission `check.rehearsals` times; None for none, and for a room without a wall.

    Args:
        seed: Flight i's draws come from (seed, i).
        report_progress: Called with the steps flown, and with all there are.
    """
    flights, limits_m = config.check.rehearsals, get_position_limits_m(config)
    lower_m, upper_m = np.array([limits_m[axis] for axis in design.plant.axes]).T
    if not flights or not np.isfinite([lower_m, upper_m]).any():
        return None
    motion = controller.mission.trajectory
    steps = max(1, round(config.duration_s / design.plant.dt_s)) if motion is None else len(motion.states)
    steps = min(MAX_STEPS, steps)
    draws = _draw(config, design.plant, flights, steps, seed)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not a number is outside
        positions_m = _fly(config, design, controller, draws, report_progress)
        beyond_m = np.maximum(lower_m - positions_m, positions_m - upper_m).max(axis=2)
    beyond_m[~np.isfinite(beyond_m)] = np.inf
    is_outside = beyond_m > _ROUNDING_M
    left = int(np.count_nonzero(is_outside.any(axis=1)))
    return FlightRisk(
        flights=flights,
        left=left,
        seconds=round(steps * design.plant.dt_s, 6),
        steps=steps,
        steps_outside=int(np.count_nonzero(is_outside)),
        max_steps_outside=int(is_outside.sum(axis=1).max()),
        beyond_m=float(beyond_m.max()),
        probability_max=bound_probability(left, flights),
        confidence=CONFIDENCE,
        step_risk=round(1.0 - config.smpc.delta_x, 9),
        seed=seed,
    )


@dataclass(frozen=True, eq=False)
class _Draws:
    """Random draws of N flights of T steps."""

    disturbances: Array  # w (N, T, n_w)
    known_steps: Counts  # step that knows the position of each step first (N, T)
    position_noise_m: Array  # (N, T, n_axes)
    inertial_errors_mps2: Array  # noise and slow error of a step's inertial data (N, T, n_axes)


def _draw(config: Config, plant: Plant, flights: int, steps: int, seed: int) -> _Draws:
    draws, shape, estimator = draw(seed, 0, flights, steps, plant.n_w), (steps, len(plant.axes)), config.estimator
    slow, white = np.moveaxis(draw_normal(Stream.INERTIAL, seed, 0, flights, (2, *shape)), 1, 0)
    # b(k+1) = φ b(k) + √(1 - φ²) σ n(k), φ = exp(-Δt/T), b(0) ~ N(0, σ²)
    kept = math.exp(-plant.dt_s / estimator.inertial_bias_s)
    for k in range(1, steps):
        slow[:, k] = kept * slow[:, k - 1] + math.sqrt(1.0 - kept**2) * slow[:, k]
    return _Draws(
        disturbances=draws.normal @ compute_root(plant.w),
        known_steps=compute_known_steps(config.link, plant.dt_s, draws.link),
        position_noise_m=estimator.position_std_m * draw_normal(Stream.POSITION_NOISE, seed, 0, flights, shape),
        inertial_errors_mps2=estimator.inertial_bias_mps2 * slow + estimator.inertial_std_mps2 * white,
    )


class FlightFilter(PositionFilter):
    """The flight's filter for N runs: of states and biases, by positions and inertial data.

    Args:
        start: State in which all runs begin (n_x,).
        cov: Covariance (n, n) at which the filter of states and biases settles; its variances are those at the start.
        readings: Inertial data of each step (N, T, n_axes); filled in as the runs fly.
    """

    def __init__(
        self, plant: Plant, kalman: Kalman, start: Array, cov: Array, known_steps: Counts, readings: Array
    ) -> None:
        model = make_model(plant, kalman.parameters)
        super().__init__(FilterBelief(model, kalman.parameters.position_std_m, 0.0), known_steps)
        mean, std = np.zeros(model.n_x), np.full(model.n_x, kalman.parameters.inertial_bias_mps2)
        mean[: plant.n_x], std[: len(cov)] = start, np.sqrt(cov.diagonal())
        runs = known_steps.shape[0]
        self._before = {0: (np.tile(mean, (runs, 1)), np.tile(np.diag(std**2), (runs, 1, 1)))}
        self._kalman, self._readings = kalman, readings
        # y = M_x x + M_u u + M_w w: of the acceleration at the end of a step
        self._of_x, of_w = kalman.inertial_z[:, : model.n_x], kalman.inertial_z[:, model.n_x :]
        self._cross = model.e @ model.w @ of_w.T
        joint = self._of_x @ self._cross
        self._noise_cov = joint + joint.T + of_w @ model.w @ of_w.T + kalman.inertial_noise

    def _advance(self, mean: Array, cov: Array, u: Array, step: int) -> tuple[Array, Array]:
        """Predict a step ahead, and correct by the inertial data of that step."""
        mean, cov = self.predict(mean, cov, u)
        if not self._kalman.n_inertial:
            return mean, cov
        # C = Cov(x, y) = P M_x' + E W M_w',  S = M_x P M_x' + M_x E W M_w' + (M_x E W M_w')' + M_w W M_w' + R
        spread = cov @ self._of_x.T
        cov_of_readings = self._of_x @ spread + self._noise_cov
        spread = spread + self._cross
        # K = C S⁻¹,  x = x + K (y - M_x x - M_u u),  P = P - K C'
        gain = np.linalg.solve(cov_of_readings, spread.transpose(0, 2, 1)).transpose(0, 2, 1)
        innovation = self._readings[:, step] - mean @ self._of_x.T - u @ self._kalman.inertial_u.T
        mean = mean + (gain @ innovation[:, :, None])[:, :, 0]
        cov = cov - gain @ spread.transpose(0, 2, 1)
        return mean, 0.5 * (cov + cov.transpose(0, 2, 1))


class _Pilot:
    """State of one run: mission and plan."""

    def __init__(self, config: Config, design: ConditionedDesign, controller: Controller) -> None:
        self._design, self._mission, self._dt_ns = design, controller.mission, controller.dt_ns
        self._replans_by_inertial = bool(config.estimator.inertial_std_mps2)
        self._bias_max = config.estimator.bias_max
        self._brake = config.fallback.brake_gain_1ps
        self._input_of_accel = np.linalg.pinv(design.plant.accel_map)
        self._state: MissionState | None = None
        self._parameters, self._risk, self._keeps_away = controller.risk, RiskGroup(age_steps=0), False
        self._plan, self._plan_step, self._capture = np.zeros((0, design.plant.n_u)), 0, -1
        self._sent = np.zeros(design.plant.n_u)

    def decide(self, k: int, capture: int, mean: Array, cov: Array) -> Array:
        """Return the input (n_u,) to send in step k; see `uavctl.flight.decide`.

        Args:
            capture: Step in which the newest position was captured.
            mean: States and biases where the input begins to act (n,).
            cov: Their covariance (n, n).
        """
        design, n_x = self._design, self._design.plant.n_x
        x, bias, age = mean[:n_x], np.clip(mean[n_x:], -self._bias_max, self._bias_max), k - capture
        if age < design.horizon:
            self._state = advance_mission(self._mission, self._state, tuple(x.tolist()), k * self._dt_ns)
            if capture > self._capture or self._replans_by_inertial:
                self._replan(k, capture, x, bias, cov)
        index = k - self._plan_step
        if age < design.horizon and index < len(self._plan):
            self._sent = self._plan[index]
        else:
            # u = -k v, as an acceleration, and d is compensated
            braking = -self._brake * x[list(design.plant.velocity_index)] @ self._input_of_accel.T
            self._plan, self._sent = self._plan[:0], braking - bias if bias.size else braking
        return self._sent

    def charge(self, k: int, age_steps: int, mean: Array, cov: Array) -> None:
        """Count and charge the step that ends at k; see `uavctl.flight.risk`.

        Args:
            mean: States there (n_x,).
            cov: Their covariance (n_x, n_x).
        """
        if self._parameters is None:
            return
        rows = self._parameters.rows
        # m = b - C x̂,  σ² = diag(C P C')
        margins = find_limits(self._mission, self._state, k * self._dt_ns) - rows @ mean
        variances = ((rows @ cov) * rows).sum(axis=1)
        self._risk, _ = charge_step(
            self._risk,
            age_steps,
            self._parameters,
            margins,
            variances,
            spread=1.0,  # disturbances are those of the model
            horizon=self._design.horizon,
            keeps_away=self._keeps_away and bool(len(self._plan)),
        )

    def _replan(self, k: int, capture: int, x: Array, bias: Array, cov: Array) -> None:
        assert self._state is not None
        target, preview = make_question(self._mission, self._state, k * self._dt_ns)
        sent = self._sent + bias if bias.size else self._sent
        question = Preview(limits=preview.limits, path=preview.path, age=k - capture, cov=cov, sent=sent)
        question = set_risk(question, self._risk, self._parameters, is_led=False)
        answer = self._design.solver.solve(k, x, target, question)
        if answer.status is SolveStatus.OPTIMAL:
            self._keeps_away = answer.offset > 0.0
            # u_sent = u_plan - d
            self._plan = answer.inputs - bias if bias.size else answer.inputs
            self._plan_step, self._capture = k, capture


def _fly(
    config: Config,
    design: ConditionedDesign,
    controller: Controller,
    draws: _Draws,
    report_progress: Callable[[int, int], None] | None = None,
) -> Array:
    """Fly all runs; return the true positions (N, T, n_axes) of x(1) … x(T) [m]."""
    plant, mission = design.plant, controller.mission
    runs, steps = draws.known_steps.shape
    kalman = make_kalman(plant, build_estimator(config), round(plant.dt_s * SECOND_NS))
    start = make_rehearsal_start(config, design, mission)
    readings = np.zeros_like(draws.inertial_errors_mps2)
    flight_filter = FlightFilter(plant, kalman, start, design.estimate_cov, draws.known_steps, readings)
    pilots = [_Pilot(config, design, controller) for _ in range(runs)]
    newest_captures, index, n = select_newest_captures(draws.known_steps), list(plant.position_index), kalman.bias.stop
    # Whole steps from sending an input until it acts, rounded up.
    dead_steps = math.ceil(round(config.plant.dead_time_s / plant.dt_s, 6))
    states, inputs = np.zeros((runs, steps + 1, plant.n_x)), np.zeros((runs, steps + dead_steps, plant.n_u))
    states[:, 0] = start
    low, high = np.array(config.sets.input_lower), np.array(config.sets.input_upper)
    of_w = kalman.inertial_z[:, kalman.n_x : kalman.n_x + plant.n_w]
    for k in range(steps):
        measured_m = states[:, k, index] + draws.position_noise_m[:, k]
        flight_filter.update(k, measured_m, newest_captures[:, k], inputs[:, :k])
        mean, cov = flight_filter.now
        for run, pilot in enumerate(pilots if k else ()):
            age_steps = k - int(newest_captures[run, k])
            pilot.charge(k, age_steps, mean[run, : plant.n_x], cov[run, : plant.n_x, : plant.n_x])
        for dead in range(dead_steps):
            mean, cov = flight_filter.predict(mean, cov, inputs[:, k + dead])
        cov = np.ascontiguousarray(cov[:, :n, :n])
        for run, pilot in enumerate(pilots):
            sent = pilot.decide(k, int(newest_captures[run, k]), mean[run, :n], cov[run])
            inputs[run, k + dead_steps] = np.clip(sent, low, high)
        u, w = inputs[:, k], draws.disturbances[:, k]
        states[:, k + 1] = states[:, k] @ plant.a.T + u @ plant.b.T + w @ plant.e.T
        if kalman.n_inertial:
            accels_mps2 = states[:, k + 1] @ kalman.inertial_z[:, : plant.n_x].T + u @ kalman.inertial_u.T + w @ of_w.T
            readings[:, k] = accels_mps2 + draws.inertial_errors_mps2[:, k]
        if report_progress is not None:
            report_progress(k + 1, steps)
    return states[:, 1:, index]
