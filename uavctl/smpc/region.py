"""What a policy library is made for: states, targets, and what may be known ahead."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.answer import NOMINAL, Outlook, Path
from uavctl.smpc.components import Component
from uavctl.smpc.design import Design
from uavctl.smpc.horizon import horizon_of
from uavctl.smpc.meanqp import Kind, MeanProblem
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]

# Share of the samples that are drawn uniformly from the box with a target anywhere; the others stay near a target.
_ANYWHERE = 0.7
_SPREAD = 3.0  # standard deviations around the target, for states without limits and for states near it
# Shares of the samples with a trajectory to follow, and with limits that tighten along the plan by up to this share.
_FOLLOWS, _TIGHTENS, _TIGHTER = 0.4, 0.4, 0.4


def state_box(component: Component, home: Array, spread: float) -> tuple[Array, Array]:
    """Bounding box of a component's state set (n_x,), (n_x,).

    Where there is no limit: `spread` standard deviations of the settled state around `home` (n_x,).
    """
    around = spread * np.sqrt(np.diagonal(component.sigma_x + component.estimate_cov))
    low, high = Polytope(component.c_x, component.b_x).bounds
    return np.where(np.isfinite(low), low, home - around), np.where(np.isfinite(high), high, home + around)


class Region:
    """States and targets of one component that a library is made for: its box, and what lies around its targets."""

    def __init__(self, design: Design, component: Component) -> None:
        self._part, self._design = component, design
        home = design.target[component.states]
        self._lower, self._upper = state_box(component, home, _SPREAD)
        self._home = component.coordinates @ home
        values, vectors = np.linalg.eigh(component.sigma_x)
        self._root = vectors * np.sqrt(np.maximum(values, 0.0))
        self._y_lower, self._y_upper = self._reach(design, component)

    def _reach(self, design: Design, component: Component) -> tuple[Array, Array]:
        """Range of each coordinate of the reference that its terminal rows leave; around home where there is none."""
        lower, upper = self._home - 1.0, self._home + 1.0
        problem = MeanProblem(design, horizon_of(design, component))
        for i, row in enumerate(problem.rows):
            if row.kind is not Kind.REFERENCE:
                continue
            along = row.c @ component.x_eq
            (used,) = np.nonzero(along)
            if used.size == 1 and along[used[0]] > 0:
                lower[used[0]] = (problem.lower[i] + row.backoff) / along[used[0]]
                upper[used[0]] = (problem.upper[i] - row.backoff) / along[used[0]]
        bounded = np.isfinite(lower) & np.isfinite(upper)
        return np.where(bounded, lower, self._home - 1.0), np.where(bounded, upper, self._home + 1.0)

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """A state (n_x,) and a target (n_x,) of the component."""
        kind, fixed = rng.random(2)
        y = self._home if fixed < 0.5 else rng.uniform(self._y_lower, self._y_upper)
        target = self._part.x_eq @ y
        if kind < _ANYWHERE:
            return rng.uniform(self._lower, self._upper), target
        return target + _SPREAD * rng.random() * self._root @ rng.standard_normal(target.size), target

    def ahead(self, rng: np.random.Generator) -> Outlook:
        """What the whole plant knows ahead, as far as this component goes: mostly nothing."""
        kind, design, part = rng.random(), self._design, self._part
        if kind < _FOLLOWS:  # a free motion, which the plant can follow
            state = _SPREAD * self._root @ rng.standard_normal(part.a.shape[0])
            states, inputs = np.zeros((design.horizon, design.plant.n_x)), np.zeros((design.horizon, design.plant.n_u))
            for t in range(design.horizon):
                states[t, part.states] = state
                state = part.a @ state
            return Outlook(path=Path(states, inputs))
        if kind < _FOLLOWS + _TIGHTENS:
            limits = np.tile(design.state_set.b, (design.horizon + 1, 1))
            for row in rng.permutation(part.rows_x)[:1]:
                limits[rng.integers(design.horizon + 1) :, row] -= _TIGHTER * rng.random() * abs(limits[0, row])
            return Outlook(limits=limits)
        return NOMINAL
