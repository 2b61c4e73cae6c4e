"""Plans of the regulator for the whole plant at once, and the room that they leave: one product each, for all axes.

Rows of the state set stand side by side, part after part. The hard rows, which inputs alone are in, come part after
part too, each part with its stages one after the other: its rows of the input set, then both sides of its slew rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.mpc import regulated
from uavctl.smpc.baselines.problem import Part, Problem
from uavctl.smpc.lqg_bound import Lqr
from uavctl.smpc.qp import OPEN
from uavctl.smpc.slew import SlewRows

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class RegulatedRows:
    """What follows from a deviation dx (n_x,) of the state from its reference, under the regulator.

    Attributes:
        rows: Rows of the state set (m,) that are asked about, part after part.
        columns: Of each part, which of them are its own.
        hard: Of each part, which of the hard rows are its own.

    Args:
        problem: The problem.
        law: The regulator.
        parts: Independent parts.
        slew: Slew rows.
    """

    def __init__(self, problem: Problem, law: Lqr, parts: Sequence[Part], slew: SlewRows) -> None:
        plant, steps, n_x = problem.plant, problem.horizon, problem.plant.n_x
        self._steps, self._n_x, self._n_u = steps, n_x, plant.n_u
        states, inputs = np.zeros((steps + 1, n_x, n_x)), np.zeros((steps, plant.n_u, n_x))
        for part in parts:
            of_x, of_u = (of[:, :, : part.states.size] for of in regulated(problem, law, part))
            states[:, part.states[:, None], part.states] = of_x
            inputs[:, part.inputs[:, None], part.states] = of_u
        # Tall matrices, column by column: the product is a few long sums then.
        self._plan = np.asfortranarray(np.vstack([inputs.reshape(-1, n_x), states.reshape(-1, n_x)]))
        self.rows = np.concatenate([part.rows_x for part in parts])
        self.columns = _after_another([part.rows_x.size for part in parts])
        changes = np.diff(inputs, axis=0, prepend=0.0)
        hard: list[Array] = []
        of_hold: list[Array] = []
        sides: list[Array] = []
        first: list[Index] = []
        for part in parts:
            c = problem.input_set.c[part.rows_u]
            own = slew.own(part.inputs)
            d = slew.d[own]
            hard.append(np.concatenate([c @ inputs, d @ changes, -d @ changes], axis=1).reshape(-1, n_x))
            held = np.zeros((steps, len(c) + 2 * own.size, plant.n_u))
            held[:, : len(c)] = c
            held[0, len(c) :] = np.concatenate([d, -d])
            of_hold.append(held.reshape(-1, plant.n_u))
            side = np.full((steps, len(c) + 2 * own.size), slew.side)
            side[:, : len(c)] = problem.input_set.b[part.rows_u]
            side[0, len(c) :] = 0.0  # by what was sent
            before = sum(one.size for one in sides)
            sides.append(side.ravel())
            first.append(np.stack([own, before + len(c) + np.arange(own.size)]))
        self.hard = _after_another([one.size for one in sides])
        self._hard_sides, self._of_hold = np.concatenate(sides), np.vstack(of_hold)
        # Where the rows of u_0 - u_(-1) are, and behind those of their part the ones of u_(-1) - u_0.
        self._owner, self._above = np.hstack(first)
        self._below = self._above + np.concatenate([np.full(one.shape[1], one.shape[1]) for one in first])
        of_x = problem.state_set.c[self.rows] @ states[1:]
        self._room = np.asfortranarray(-np.vstack([of_x.reshape(-1, n_x), *hard]))

    def room(
        self, dx: Array, sides: Array, hold: Array | None, first: tuple[Array, Array] | None
    ) -> tuple[Array, Array]:
        """Room of the state rows (H, m) and of the hard rows.

        Args:
            dx: Deviation of the state (n_x,).
            sides: Right sides of the state rows less their values at the reference, (H, m) or (m,).
            hold: Input at the reference (n_u,); None for zero.
            first: See `SlewRows.first`; None where nothing is known of what was sent.
        """
        room: Array = self._room.dot(dx)
        of_x, hard = room[: self._steps * self.rows.size].reshape(self._steps, -1), room[self._steps * self.rows.size :]
        of_x += sides
        hard += self._hard_sides
        if hold is not None:
            hard -= self._of_hold @ hold
        if first is None:
            hard[self._above] = hard[self._below] = OPEN
        else:
            at, side = (values[self._owner] for values in first)
            hard[self._above] += side + at
            hard[self._below] += side - at
        return of_x, hard

    def plan(self, dx: Array) -> tuple[Array, Array]:
        """Inputs (H, n_u) and states (H+1, n_x), both as deviations from the reference."""
        plan: Array = self._plan.dot(dx)
        return plan[: self._steps * self._n_u].reshape(-1, self._n_u), plan[self._steps * self._n_u :].reshape(
            -1, self._n_x
        )


def _after_another(sizes: Sequence[int]) -> list[slice]:
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(i, j) for i, j in pairwise(ends)]
