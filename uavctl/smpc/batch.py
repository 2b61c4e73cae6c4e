"""Many runs of one plant in step: what a controller of all of them sees, and what it answers.

A campaign compares controllers on the same noise and the same losses. Every controller is given the same news: the
state at the capture of the newest position that has arrived, exact or as a filter knows it, its age, and the inputs
that have acted since.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.plant import Plant

Array = NDArray[np.float64]
Counts = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class News:
    """What is known at the beginning of step k, for N runs.

    Attributes:
        step: k.
        newest: Step (N,) in which the newest position known was captured; 0 at first: x(0) is always known.
        state: State (N, n_x) in step `newest`.
        inputs: Inputs (N, k, n_u) that have acted in steps 0 … k-1, within the actuators' limits.
        cov: Covariance (N, n_x, n_x) of the error of `state`; None: it is exact.
    """

    step: int
    newest: Counts
    state: Array
    inputs: Array
    cov: Array | None = None

    @property
    def age(self) -> Counts:
        """Age of information a(k) (N,) [steps]."""
        return self.step - self.newest


class BatchController(Protocol):
    """A controller of N runs at once. Runs do not influence each other."""

    def begin(self, runs: int) -> None:
        """Forget everything, for `runs` new runs."""
        ...

    def act(self, news: News) -> Array:
        """Inputs (N, n_u) for step `news.step`, not clipped to the actuators' limits; called for k = 0, 1, … in turn.

        Entries that are not finite end the run as failed.
        """
        ...


def predict(plant: Plant, news: News) -> Array:
    """Mean of the state now (N, n_x): the newest known state, moved on by the inputs that have acted since."""
    x = news.state.copy()
    for past in range(int(news.age.max(initial=0)), 0, -1):
        (moved,) = np.nonzero(news.age >= past)
        x[moved] = x[moved] @ plant.a.T + news.inputs[moved, news.step - past] @ plant.b.T
    return x


def predicted_cov(plant: Plant, news: News) -> Array | None:
    """Covariance (N, n_x, n_x) of the error of `predict`, where the newest known state is not exact."""
    if news.cov is None:
        return None
    cov, noise = news.cov.copy(), plant.e @ plant.w @ plant.e.T
    for past in range(int(news.age.max(initial=0)), 0, -1):
        (moved,) = np.nonzero(news.age >= past)
        cov[moved] = plant.a @ cov[moved] @ plant.a.T + noise
    return cov
