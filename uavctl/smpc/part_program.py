"""The program of one independent part: how to leave the regulator's plan so that rows are kept, at the least cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.baselines.mpc import regulated
from uavctl.smpc.baselines.problem import Part, Problem
from uavctl.smpc.first_rows import FirstRows
from uavctl.smpc.layout import pairs_of
from uavctl.smpc.lqg_bound import Lqr
from uavctl.smpc.qp import ACTIVE, BELOW, SOFT, QuadraticProgram, Sense
from uavctl.smpc.slew import SlewRows

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MOST_ITERATIONS = 2000  # of one program


class PartProgram:
    """min |z|² with all rows kept, state rows at the price of their slack; one row for both sides of a direction.

    Rooms come in one vector of the whole plant: those of the state rows, stage after stage, then those of the hard rows
    of the parts, one part after the other (see `RegulatedRows`), and OPEN at its end for a side without a limit.

    Attributes:
        part: Its states, inputs and rows.
        columns: Which of the state rows of a stage are the part's.
        hard: Which of the hard rows are.

    Args:
        problem: The problem.
        law: The regulator.
        part: Its states, inputs and rows.
        slew: Slew rows.
        columns: See above.
        hard: See above.
        width: Number of state rows of a stage.
        end: Where OPEN stands.
    """

    def __init__(
        self, problem: Problem, law: Lqr, part: Part, slew: SlewRows, columns: slice, hard: slice, width: int, end: int
    ) -> None:
        self.part, self.columns, self.hard = part, columns, hard
        self._steps = steps = problem.horizon
        states, inputs = (of[:, :, part.states.size :] for of in regulated(problem, law, part))
        n = states.shape[2]
        self._plan = np.vstack([inputs.reshape(-1, n), states[1:].reshape(-1, n)])
        self._inputs, self._states = _slice(part.inputs), _slice(part.states)
        # A path (p_t, r_t) to follow adds -2 Σ (x_t' Q p_t + u_t' R r_t) to the cost, which z = Σ … is the least of.
        q_x, q_u = problem.q_x[np.ix_(part.states, part.states)], problem.q_u[np.ix_(part.inputs, part.inputs)]
        self._of_path_x = np.einsum("tij,ik->jtk", states[:-1], q_x).reshape(n, -1)
        self._of_path_u = np.einsum("tij,ik->jtk", inputs, q_u).reshape(n, -1)
        c_x = problem.state_set.c[np.ix_(part.rows_x, part.states)]
        c_u = problem.input_set.c[np.ix_(part.rows_u, part.inputs)]
        d = slew.d[np.ix_(slew.own(part.inputs), part.inputs)]
        changes = np.diff(inputs, axis=0, prepend=0.0)
        of_x, of_u = c_x @ states[1:], np.concatenate([c_u @ inputs, d @ changes, -d @ changes], axis=1)
        self._x_of_z, self._u_of_z = np.asfortranarray(of_x.reshape(-1, n)), of_u.reshape(-1, n)
        above_x, below_x = _sides(c_x)
        pairs_u, slews = _sides(c_u), len(c_u) + np.arange(len(d))
        above_u, below_u = np.append(pairs_u[0], slews), np.append(pairs_u[1], slews + len(d))
        rows_x, rows_u = _directions(of_x, above_x, below_x), _directions(of_u, above_u, below_u)
        rows = np.vstack([rows_x, rows_u])

        def places(of_states: Index, of_hard: Index) -> Index:
            """Where the rooms (rows,) of one side stand."""
            at_x = columns.start + width * np.arange(steps)[:, None] + of_states
            at_u = width * steps + hard.start + of_u.shape[1] * np.arange(steps)[:, None] + of_hard
            return np.append(np.where(of_states >= 0, at_x, end).ravel(), np.where(of_hard >= 0, at_u, end).ravel())

        self._upper, self._lower = places(above_x, above_u), places(below_x, below_u)
        self._width = above_u.size  # of the hard rows of a stage
        self._slews = range(len(rows_x) + pairs_u[0].size, len(rows_x) + self._width)  # those of the first stage
        soft = np.arange(len(rows)) < len(rows_x)
        by_stage = rows_x.reshape(steps, -1, n), rows_u.reshape(steps, -1, n)
        self._program = QuadraticProgram(
            2.0 * np.eye(n),
            np.ascontiguousarray(rows),
            np.where(soft, SOFT, 0).astype(np.int32),
            np.where(soft, problem.slack_linear, 0.0),
            np.where(soft, problem.slack_quadratic, 0.0),
            most=MOST_ITERATIONS,
        )
        suits = FirstRows.suits(*by_stage, len(d))
        self._first = FirstRows(*by_stage, self._program.sense).of if suits else self._ramps

    def along(self, path_x: Array, path_u: Array) -> Array:
        """z (n,) that follows a path of the whole plant (H, n_x), (H, n_u) at the least cost, without limits."""
        part = self.part
        z: Array = self._of_path_x @ path_x[:, part.states].ravel()
        z += self._of_path_u @ path_u[:, part.inputs].ravel()
        return z

    def take(self, z: Array, room_x: Array, room_u: Array) -> None:
        """Take the room off that z needs: of the state rows (H, m) of the whole plant, and of the hard rows."""
        room_x[:, self.columns] -= (self._x_of_z @ z).reshape(self._steps, -1)
        room_u[self.hard] -= self._u_of_z @ z

    def leave(self, z: Array, room_x: Array, left: Array) -> None:
        """Write what z leaves of the room of the part's state rows into `left` (H, m), of the whole plant both."""
        taken = self._x_of_z.dot(z).reshape(self._steps, -1)
        np.subtract(room_x[:, self.columns], taken, out=left[:, self.columns])

    @property
    def iterations(self) -> int:
        """Of the last program."""
        return self._program.iterations

    def solve(self, rooms: Array, again: bool) -> Array | None:
        """Best z (n,); None where the program found none.

        Args:
            rooms: Room of all rows where z = 0, less their back-offs; OPEN at the end.
            again: Whether to begin with the rows that bound in the last program: it must be of the same question.
        """
        upper, lower = rooms.take(self._upper), -rooms.take(self._lower)
        begin = None if again else self._first(upper, lower)
        # Where two back-offs meet no mean keeps both: it stays between them.
        crossed = upper < lower
        if np.count_nonzero(crossed):
            middle = 0.5 * (upper + lower)
            np.copyto(upper, middle, where=crossed)
            np.copyto(lower, middle, where=crossed)
        return self._program.solve_sides(upper, lower, begin, again)

    def _ramps(self, upper: Array, lower: Array) -> Sense | None:
        """Rows to begin with: the setpoint goes from the one sent last to the regulator's as fast as it may.

        It is there where the room of all slew rows so far adds up to none that is missing.
        """
        begin = None
        for i in self._slews:
            for sides, sign, state in ((upper, 1.0, ACTIVE), (lower, -1.0, BELOW)):
                if sign * sides[i] < 0.0:
                    missing = (sign * sides[i :: self._width]).cumsum() < 0.0
                    if begin is None:
                        begin = self._program.sense.copy()
                    count = int(missing.argmin()) or self._steps
                    begin[i : i + count * self._width : self._width] += state
        return begin

    def add(self, z: Array, inputs: Array, states: Array) -> None:
        """Add what z does to the inputs (H, n_u) and states (H+1, n_x) of the whole plant."""
        plan = self._plan.dot(z)
        count = self._steps * self.part.inputs.size
        _add(plan[:count].reshape(self._steps, -1), inputs, self._inputs)
        _add(plan[count:].reshape(self._steps, -1), states[1:], self._states)


def _slice(index: Index) -> slice | Index:
    """The same places as a slice, where they are one beside the other: it takes no copy."""
    if not index.size or index[-1] - index[0] + 1 != index.size:
        return index
    return slice(int(index[0]), int(index[-1]) + 1)


def _add(change: Array, to: Array, columns: slice | Index) -> None:
    """Add to some columns of a matrix; with a slice, without writing them twice."""
    if isinstance(columns, slice):
        own = to[:, columns]
        own += change
    else:
        to[:, columns] += change


def _sides(c: Array) -> tuple[Index, Index]:
    """Rows that limit each direction from above and from below, -1 for none: (d,), (d,)."""
    rows = [dict(pair.sides) for pair in pairs_of(c)]
    above, below = (np.array([sides.get(sign, -1) for sides in rows], dtype=np.intp) for sign in (1.0, -1.0))
    return above, below


def _directions(of_z: Array, above: Index, below: Index) -> Array:
    """Rows (H d, n) of the directions, from those of both sides (H, m, n)."""
    chosen = np.where((above >= 0)[:, None], of_z[:, above], -of_z[:, below])
    return np.asarray(chosen.reshape(-1, of_z.shape[2]))
