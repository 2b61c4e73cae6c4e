"""The flight's own filter over all its positions in the order of capture: what it foretold, and what came.

Each position is foretold from those before it, and, from time to time, from those up to H steps before. If the model
is right, the errors over their foretold deviations are standard normal and independent, whatever was lost or late.
Positions are measured in every flight, so nothing here needs the simulator's truth.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from logs.design_view import Floats
from logs.flight_data import FLOWN, FlightData
from uavctl.build import build_estimator, build_plant
from uavctl.config import Config
from uavctl.data import PositionSample
from uavctl.flight.kalman import Belief, Kalman, captured_ns, first_belief, make_kalman, predicted, shown_by, updated
from uavctl.flight.orders import unready

# Positions that are looked at, the first of the flight: enough to find a deviation that is 3 % wrong.
MOST = 20_000
# The first positions after a start tell of how it began, not of the model.
SETTLING = 5


@dataclass(frozen=True, eq=False)
class Innovations:
    """Positions against what was foretold of them, both measured in flight.

    Attributes:
        t_s: Capture times of the report (n,) [s].
        error_m: Position minus what the ones before it foretell (n, axes) [m].
        std_m: Deviation foretold (n, axes) [m].
        lead_steps: Steps ahead of a forecast, 1 … H (m,), of windows that follow each other.
        distance: Squared distance of the position from its forecast, by the forecast's covariance (m,).
    """

    t_s: Floats
    error_m: Floats
    std_m: Floats
    lead_steps: NDArray[np.int64]
    distance: Floats

    @property
    def normalised(self) -> Floats:
        """Errors over their foretold deviations (n, axes)."""
        return self.error_m / self.std_m


def innovations(flight: FlightData, config: Config) -> Innovations:
    """Run the filter of a configuration over a flight.

    Raises:
        DesignError: The configuration has no plant.
    """
    kalman = make_kalman(build_plant(config), build_estimator(config), flight.design.dt_ns)
    track = Track(flight, kalman, round(config.plant.dead_time_s * 1e9))
    near = list(track.one_ahead())
    far = list(track.many_ahead([belief for belief, _, _ in near], flight.design.horizon))
    axes = len(flight.design.axes)
    return Innovations(
        t_s=flight.seconds([belief.at_ns for belief, _, _ in near]),
        error_m=np.array([error for _, error, _ in near]).reshape(-1, axes),
        std_m=np.array([std for _, _, std in near]).reshape(-1, axes),
        lead_steps=np.array([lead for lead, _ in far], dtype=np.int64),
        distance=np.array([distance for _, distance in far], dtype=np.float64),
    )


class Track:
    """Positions and inputs of a flight along the time of capture.

    Args:
        flight: The flight.
        kalman: Its filter.
        dead_ns: From sending an input until it begins to act, as the flight's filter believed [ns].
    """

    def __init__(self, flight: FlightData, kalman: Kalman, dead_ns: int = 0) -> None:
        self.kalman = kalman
        self.origin_ns = flight.origin_ns - flight.decisions[0].tick * flight.tick_ns
        self.samples = sorted({captured_ns(one): one for one in flight.samples}.items())[:MOST]
        ready = {one.tick: not unready(one.vehicle) for one in flight.step_inputs}
        self.input_ns: list[int] = []
        self.inputs: list[Floats | None] = []
        for decision in flight.decisions:
            acts = decision.input is not None and ready.get(decision.tick, False)
            u = np.array(decision.input) if acts else None
            before = self.inputs[-1] if self.inputs else None
            if u is before or (u is not None and before is not None and np.array_equal(u, before)):
                continue
            self.input_ns.append(decision.at_ns + dead_ns)
            self.inputs.append(u)
        self.spans_ns = _flown_ns(flight)

    def one_ahead(self) -> Iterator[tuple[Belief, Floats, Floats]]:
        """Belief after each position of flown time, the position's error and its foretold deviation (axes,)."""
        belief, since = None, 0
        for at_ns, sample in self.samples:
            if belief is None:
                belief = first_belief(self.kalman, sample)
                continue
            belief = self.to(belief, at_ns)
            error, cov = self._error(belief, sample)
            belief = updated(self.kalman, belief, sample)
            since = since + 1 if self._flown(at_ns) else 0
            if since > SETTLING:
                yield belief, error, np.sqrt(np.diagonal(cov))

    def many_ahead(self, beliefs: list[Belief], horizon: int) -> Iterator[tuple[int, float]]:
        """(steps ahead, squared distance) of the last position in each step of windows of `horizon` steps.

        The next window begins where this one's last position was seen, so each outcome is known when the next
        forecast is made: for each lead, hits are independent trials.
        """
        dt_ns = self.kalman.propagation.dt_ns
        times = [at_ns for at_ns, _ in self.samples]
        free_ns = 0
        for belief in beliefs:
            if belief.at_ns < free_ns:
                continue
            begun_ns = free_ns = belief.at_ns
            first, last = (bisect_right(times, begun_ns + ahead) for ahead in (0, horizon * dt_ns))
            chosen = {-(-(at_ns - begun_ns) // dt_ns): sample for at_ns, sample in self.samples[first:last]}
            now = belief
            for lead, sample in chosen.items():
                at_ns = captured_ns(sample)
                if not self._flown(at_ns):
                    break
                now, free_ns = self.to(now, at_ns), at_ns
                error, cov = self._error(now, sample)
                yield lead, float(error @ np.linalg.solve(cov, error))

    def to(self, belief: Belief, at_ns: int) -> Belief:
        """The belief moved on by the inputs that acted."""
        place = bisect_right(self.input_ns, belief.at_ns)
        u = self.inputs[place - 1] if place else None
        while place < len(self.input_ns) and self.input_ns[place] < at_ns:
            belief = predicted(self.kalman, self.origin_ns, belief, u, self.input_ns[place])
            u = self.inputs[place]
            place += 1
        return predicted(self.kalman, self.origin_ns, belief, u, at_ns)

    def _error(self, belief: Belief, sample: PositionSample) -> tuple[Floats, Floats]:
        """Position minus belief (axes,), and the covariance that it should have (axes, axes)."""
        values, variances = shown_by(self.kalman, sample)
        axes = len(self.kalman.axes)
        index = self.kalman.shown[:axes]
        cov = belief.cov[np.ix_(index, index)] + np.diag(variances[:axes])
        return np.asarray(values[:axes] - belief.mean[index]), np.asarray(cov)

    def _flown(self, at_ns: int) -> bool:
        return any(begun <= at_ns <= ended for begun, ended in self.spans_ns)


def _flown_ns(flight: FlightData) -> list[tuple[int, int]]:
    """Spans in which the controller flew [ns]."""
    flown = [d for d in flight.flown if d.mode in FLOWN]
    spans: list[tuple[int, int]] = []
    begun = last = None
    for decision in flown:
        if last is not None and begun is not None and decision.tick > last.tick + 1:
            spans.append((begun, last.at_ns))
            begun = None
        begun = decision.at_ns if begun is None else begun
        last = decision
    if begun is not None and last is not None:
        spans.append((begun, last.at_ns))
    return spans
