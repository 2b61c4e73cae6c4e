"""How far the flight that might have been departs from the recorded one.

Both obey x(k+1) = A x + B u + w with the same w, so their difference obeys δ(k+1) = A δ + B (u' − u): what disturbed
the recorded flight cancels, and need not be known. Between boundaries the same holds in continuous time, u held. Where
the vehicle has a dead time, what was sent acts by that much later.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.vehicle import CACHED_TRANSITIONS, LinearModel
from uavctl.data import Vec3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Response:
    """How a vehicle answers to setpoints.

    Attributes:
        model: Its motion.
        dead_ns: Time from sending a setpoint until it begins to act [ns].
    """

    model: LinearModel
    dead_ns: int = 0


class _Node(NamedTuple):
    """From here on this input acts."""

    at_ns: int
    state: Array
    input: Array


class Departure:
    """δ of state and input, from the first difference of the setpoints on.

    Args:
        response: How the vehicle answers to a difference of the setpoints.
    """

    def __init__(self, response: Response) -> None:
        self._model, self._dead_ns = response.model, response.dead_ns
        self._transition = lru_cache(maxsize=CACHED_TRANSITIONS)(response.model.transition)
        self._speeding = response.model.flow[list(response.model.velocity_index)]  # rows of v'
        n_x, n_u = response.model.b.shape
        self._nodes = [_Node(0, np.zeros(n_x), np.zeros(n_u))]

    @property
    def begun_ns(self) -> int | None:
        """When a difference of the setpoints acted first [ns]; None if they never differed."""
        return self._nodes[1].at_ns if len(self._nodes) > 1 else None

    def steer(self, at_ns: int, accel_mps2: Vec3) -> None:
        """Send setpoints that differ by this [m/s²] from `at_ns` on, no earlier than the last time."""
        model = self._model
        u = np.array([accel_mps2[axis] for axis in model.axes]) / model.accel_per_input
        if not np.array_equal(u, self._nodes[-1].input):
            acts_ns = at_ns + self._dead_ns
            self._nodes.append(_Node(acts_ns, self.state(acts_ns), u))

    def state(self, at_ns: int) -> Array:
        """δx (n_x,) at a time [ns]."""
        node = self._node(at_ns)
        if at_ns <= node.at_ns or not (node.state.any() or node.input.any()):
            return node.state
        a, b, _ = self._transition(at_ns - node.at_ns)
        return np.asarray(a @ node.state + b @ node.input)

    def input(self, at_ns: int) -> Array:
        """δu (n_u,) that is sent from `at_ns` on."""
        return self._node(at_ns + self._dead_ns).input

    def position_m(self, at_ns: int) -> Vec3:
        """δ of the position in local NED [m]; zero along axes that the plant has not."""
        return self._ned(self.state(at_ns)[list(self._model.position_index)])

    def velocity_mps(self, at_ns: int) -> Vec3:
        """δ of the velocity in local NED [m/s]."""
        return self._ned(self.state(at_ns)[list(self._model.velocity_index)])

    def acceleration_mps2(self, at_ns: int) -> Vec3:
        """δ of the acceleration in local NED [m/s²]: what inertial sensors would have shown more."""
        state, acts = self.state(at_ns), self._node(at_ns).input
        known = state.size + acts.size
        return self._ned(self._speeding[:, :known] @ np.concatenate((state, acts)))

    def _node(self, at_ns: int) -> _Node:
        return self._nodes[max(0, bisect_right(self._nodes, at_ns, key=lambda node: node.at_ns) - 1)]

    def _ned(self, by_axis: Array) -> Vec3:
        values = [0.0, 0.0, 0.0]
        for axis, value in zip(self._model.axes, by_axis.tolist(), strict=True):
            values[axis] = value
        return values[0], values[1], values[2]
