"""Standard deviations of state rows under a plan that is played out in open loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.problem import Part, Problem
from uavctl.smpc.layout import pairs_of
from uavctl.smpc.plant import Plant

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class Deviations:
    """σ_ti of the state rows: σ² = c'(A^t P A^t' + Σ_{j<t} A^j E W E' A^j')c in the stages t = 1 … H.

    Where a filter knows more states than the plant has, biases of its inputs (`with_bias`), A, E, W and P are those of
    all of them. It is linear in the entries of P that a part has to do with. All parts are one product; where they are
    of different sizes the smaller ones are filled up with zeros. Both sides of a direction share one deviation.

    Args:
        problem: The problem.
        parts: Independent parts, whose rows stand side by side.
        seen: The plant as the filter sees it.
    """

    def __init__(self, problem: Problem, parts: Sequence[Part], seen: Plant) -> None:
        steps, noise = problem.horizon, seen.e @ seen.w @ seen.e.T
        found = [_of_part(problem, part, seen, noise) for part in parts]
        most, entries = (max(size) for size in zip(*((one[0].shape[1:]) for one in found), strict=True))
        self._of_cov = np.zeros((len(parts), steps * most, entries))
        self._alone = np.zeros((len(parts), steps * most))
        self._entries = np.zeros((len(parts), entries, 1), dtype=np.intp)
        self._squares = seen.n_x**2
        places = []
        for i, (part, (of_cov, alone, own)) in enumerate(zip(parts, found, strict=True)):
            count, squares = of_cov.shape[1:]
            stage = most * np.arange(steps)[:, None]
            at = (stage + np.arange(count)).ravel()
            self._of_cov[i, at, :squares], self._alone[i, at] = of_cov.reshape(-1, squares), alone.ravel()
            states = _states(problem, part, seen)
            self._entries[i, :squares, 0] = (states[:, None] * seen.n_x + states).ravel()
            places.append(i * steps * most + stage + own)
        self._places = np.hstack(places)

    def of(self, cov: Array | None) -> Array:
        """Deviations (H, m) by the covariance of the estimate's error, biases included (n, n); None: it is exact.

        Raises:
            ValueError: It is of another size.
        """
        variance = self._alone
        if cov is not None:
            if cov.size != self._squares:
                raise ValueError(f"a covariance of shape {cov.shape}, wanted {self._squares} entries")
            variance = variance + (self._of_cov @ cov.ravel().take(self._entries))[:, :, 0]
            np.maximum(variance, 0.0, out=variance)
        return np.sqrt(variance).ravel().take(self._places)


def _states(problem: Problem, part: Part, seen: Plant) -> Index:
    """The states of a part among those of a filter: the plant's, and the biases of its inputs."""
    biases = part.inputs if seen.n_x > problem.plant.n_x else part.inputs[:0]
    return np.concatenate([part.states, problem.plant.n_x + biases])


def _of_part(problem: Problem, part: Part, seen: Plant, noise: Array) -> tuple[Array, Array, Index]:
    """Variance of each direction by each entry of P (H, d, n²) and without P (H, d), and each row's direction (m,)."""
    states = _states(problem, part, seen)
    index = np.ix_(states, states)
    a, noise = seen.a[index], noise[index]
    pairs = pairs_of(problem.state_set.c[np.ix_(part.rows_x, part.states)])
    c = np.array([pair.c for pair in pairs]).reshape(-1, part.states.size)
    c = np.pad(c, ((0, 0), (0, states.size - part.states.size)))
    own = np.zeros(part.rows_x.size, dtype=np.intp)
    for i, pair in enumerate(pairs):
        own[[row for _, row in pair.sides]] = i
    power, spread = np.eye(len(a)), np.zeros_like(noise)
    of_cov, alone = [], []
    for _ in range(problem.horizon):
        power, spread = a @ power, a @ spread @ a.T + noise
        phi = c @ power
        of_cov.append((phi[:, :, None] * phi[:, None, :]).reshape(len(c), -1))
        alone.append(np.einsum("mi,ij,mj->m", c, spread, c))
    return np.array(of_cov), np.array(alone), own
