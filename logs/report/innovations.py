"""Errors of the forecasts of the flight's own filter, over all its positions in the order of capture.

Each position is predicted from those before it and, in windows, from those up to H steps before. If the model is right,
the errors over their predicted deviations are standard normal and independent, whatever was lost or late. Every flight
measures positions, so the simulator's truth is not needed.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from logs.recording.flight import FLOWN, FlightData
from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.flight.context import describe_not_ready
from uavctl.flight.kalman import (
    Belief,
    Kalman,
    make_first_belief,
    make_kalman,
    predict,
    read_capture_ns,
    read_measurement,
    update_with_position,
)
from uavctl.records import PositionSample
from uavctl.wiring.controller import build_estimator, build_plant

# Positions that are looked at, the first of the flight: enough to find a deviation that is 3 % wrong.
MAX_POSITIONS = 20_000

# The first positions after a start depend on the initial state, not on the model.
SETTLING_POSITIONS = 5


@dataclass(frozen=True, eq=False)
class InnovationSamples:
    """Positions against their forecasts, by the flight's own filter."""

    t_s: Array  # capture times of the report (n,) [s]
    error_m: Array  # position minus its prediction from earlier ones (n, axes) [m]
    std_m: Array  # deviation predicted (n, axes) [m]
    lead_steps: NDArray[np.int64]  # steps ahead of a forecast, 1 … H (m,), of windows that follow each other
    distance: Array  # squared distance of the position from its forecast, by the forecast's covariance (m,)

    @property
    def normalised(self) -> Array:
        """Errors over their predicted deviations (n, axes)."""
        return self.error_m / self.std_m


def compute_innovations(flight: FlightData, config: Config) -> InnovationSamples:
    """Run the filter of a configuration over a flight; return the errors of its forecasts.

    Raises:
        DesignError: The configuration has no plant.
    """
    kalman = make_kalman(build_plant(config), build_estimator(config), flight.design.dt_ns)
    replay = FilterReplay(flight, kalman, round(config.plant.dead_time_s * 1e9))
    one_step = list(replay.iterate_one_step_errors())
    lead_distances = list(replay.iterate_lead_distances([belief for belief, _, _ in one_step], flight.design.horizon))
    axes = len(flight.design.axes)
    return InnovationSamples(
        t_s=flight.seconds([belief.at_ns for belief, _, _ in one_step]),
        error_m=np.array([error for _, error, _ in one_step]).reshape(-1, axes),
        std_m=np.array([std for _, _, std in one_step]).reshape(-1, axes),
        lead_steps=np.array([lead for lead, _ in lead_distances], dtype=np.int64),
        distance=np.array([distance for _, distance in lead_distances], dtype=np.float64),
    )


class FilterReplay:
    """Positions and inputs of a flight in order of capture.

    Args:
        dead_ns: From sending an input until it begins to act, as the flight's filter assumed [ns].
    """

    def __init__(self, flight: FlightData, kalman: Kalman, dead_ns: int = 0) -> None:
        self.kalman = kalman
        self.origin_ns = flight.origin_ns - flight.decisions[0].tick * flight.tick_ns
        self.samples = sorted({read_capture_ns(sample): sample for sample in flight.samples}.items())[:MAX_POSITIONS]
        ready_by_tick = {step.tick: not describe_not_ready(step.vehicle) for step in flight.step_inputs}
        self.input_ns: list[int] = []
        self.inputs: list[Array | None] = []
        for decision in flight.decisions:
            is_acting = decision.input is not None and ready_by_tick.get(decision.tick, False)
            u = np.array(decision.input) if is_acting else None
            previous = self.inputs[-1] if self.inputs else None
            if u is previous or (u is not None and previous is not None and np.array_equal(u, previous)):
                continue
            self.input_ns.append(decision.at_ns + dead_ns)
            self.inputs.append(u)
        self.spans_ns = _find_flown_spans_ns(flight)

    def iterate_one_step_errors(self) -> Iterator[tuple[Belief, Array, Array]]:
        """Yield the belief after each position, and the position's error and predicted deviation (axes,) [m]."""
        belief, consecutive_positions = None, 0
        for at_ns, sample in self.samples:
            if belief is None:
                belief = make_first_belief(self.kalman, sample)
                continue
            belief = self.to(belief, at_ns)
            error, cov = self._compute_error(belief, sample)
            belief = update_with_position(self.kalman, belief, sample)
            consecutive_positions = consecutive_positions + 1 if self._is_flown(at_ns) else 0
            if consecutive_positions > SETTLING_POSITIONS:
                yield belief, error, np.sqrt(np.diagonal(cov))

    def iterate_lead_distances(self, beliefs: list[Belief], horizon: int) -> Iterator[tuple[int, float]]:
        """Yield (steps ahead, squared Mahalanobis distance) of each step's last position, window by window.

        A window has `horizon` steps. The next one begins at this one's last position, so each outcome is known when
        the next forecast is made: for each lead, hits are independent trials.
        """
        dt_ns = self.kalman.propagation.dt_ns
        captured_times_ns = [at_ns for at_ns, _ in self.samples]
        window_end_ns = 0
        for belief in beliefs:
            if belief.at_ns < window_end_ns:
                continue
            begin_ns = window_end_ns = belief.at_ns
            first, last = (bisect_right(captured_times_ns, begin_ns + offset_ns) for offset_ns in (0, horizon * dt_ns))
            last_samples = {-(-(at_ns - begin_ns) // dt_ns): sample for at_ns, sample in self.samples[first:last]}
            current = belief
            for lead, sample in last_samples.items():
                at_ns = read_capture_ns(sample)
                if not self._is_flown(at_ns):
                    break
                current, window_end_ns = self.to(current, at_ns), at_ns
                error, cov = self._compute_error(current, sample)
                yield lead, float(error @ np.linalg.solve(cov, error))

    def to(self, belief: Belief, at_ns: int) -> Belief:
        """Return a belief moved on to `at_ns` by the inputs that acted."""
        index = bisect_right(self.input_ns, belief.at_ns)
        u = self.inputs[index - 1] if index else None
        while index < len(self.input_ns) and self.input_ns[index] < at_ns:
            belief = predict(self.kalman, self.origin_ns, belief, u, self.input_ns[index])
            u = self.inputs[index]
            index += 1
        return predict(self.kalman, self.origin_ns, belief, u, at_ns)

    def _compute_error(self, belief: Belief, sample: PositionSample) -> tuple[Array, Array]:
        """Return position minus belief (axes,) [m], and the covariance that it should have (axes, axes) [m²]."""
        values, variances = read_measurement(self.kalman, sample)
        axes = len(self.kalman.axes)
        index = self.kalman.measured_index[:axes]
        cov = belief.cov[np.ix_(index, index)] + np.diag(variances[:axes])
        return np.asarray(values[:axes] - belief.mean[index]), np.asarray(cov)

    def _is_flown(self, at_ns: int) -> bool:
        return any(begin_ns <= at_ns <= end_ns for begin_ns, end_ns in self.spans_ns)


def _find_flown_spans_ns(flight: FlightData) -> list[tuple[int, int]]:
    """Return the spans in which the controller flew [ns]."""
    flown = [d for d in flight.flown if d.mode in FLOWN]
    spans: list[tuple[int, int]] = []
    begin_ns = last = None
    for decision in flown:
        if last is not None and begin_ns is not None and decision.tick > last.tick + 1:
            spans.append((begin_ns, last.at_ns))
            begin_ns = None
        begin_ns = decision.at_ns if begin_ns is None else begin_ns
        last = decision
    if begin_ns is not None and last is not None:
        spans.append((begin_ns, last.at_ns))
    return spans
