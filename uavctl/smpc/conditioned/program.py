"""The QP of a part: rows, slew limits, places of rest."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from operator import le

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.smpc.nominal import ControlProblem, Lqr, Part, predict_regulated
from uavctl.smpc.plant import Plant
from uavctl.smpc.qp import ACTIVE, BELOW, OPEN, SOFT, FirstRows, QuadraticProgram, Sense, find_pairs
from uavctl.smpc.sets import Equilibria, Polytope

# Rows on how far the acceleration setpoint may go from one step to the next, as the last gate lets it.
#
# Inputs are held for a step. The gate lets a setpoint move by slew · tick in each tick, so a change of up to slew · Δt
# has arrived with the last tick of its step: the rows bound the change from step to step by that. While it moves, what
# is sent is behind the plan by half a step in the mean.


Index = NDArray[np.intp]

_APART = 1e-8  # of a setpoint: what the first row and the set of inputs have in common is wider than this


class SlewRows:
    """|D (u_t - u_(t-1))| <= side in each row that can bind.

    Args:
        input_set: U; a change as large as the whole of it needs no row.
        slew_mps3: Largest change in a second [m/s³]; infinite for no rows.
    """

    def __init__(self, plant: Plant, input_set: Polytope, slew_mps3: float) -> None:
        self.side = slew_mps3 * plant.dt_s  # largest change in a step [m/s²]
        self._set = input_set
        self._low, self._high = input_set.bounds
        self._lows, self._highs = self._low.tolist(), self._high.tolist()
        d = plant.accel_map
        with np.errstate(invalid="ignore"):  # an input without limits that an axis does not feel
            widest = np.nansum(np.abs(d) * (self._high - self._low), axis=1)
        # Index of the plant's axis of each row (m,)
        self.axes = np.flatnonzero(np.any(d != 0.0, axis=1) & (widest > self.side))
        # D (m, n_u), change of an axis' acceleration setpoint per change of the input [m/s² per unit]
        self.d = d[self.axes]
        self._sides = np.full(self.axes.size, self.side)
        self._box = all(np.count_nonzero(row) == 1 for row in input_set.c)
        self._nearest: QuadraticProgram | None = None
        if not self._box:
            n, m = plant.n_u, len(input_set.b)
            hard = np.zeros(m, dtype=np.int32)
            self._nearest = QuadraticProgram(np.eye(n), input_set.c.copy(), hard, np.zeros(m), np.zeros(m))

    def own(self, inputs: Index) -> Index:
        """Return which rows involve some inputs."""
        return np.flatnonzero(np.any(self.d[:, inputs] != 0.0, axis=1))

    def first(self, sent: Array) -> tuple[Array, Array]:
        """D u_(-1) (m,) of the input sent last (n_u,), and how far the first input may be from it (m,).

        That is `side`, or as far as the nearest input in U is away: from there on every input may stay.
        """
        at = self.d @ sent
        if self._box and all(map(le, self._lows, sent.tolist())) and all(map(le, sent.tolist(), self._highs)):
            return at, self._sides
        away = np.abs(self.d @ self._within(sent) - at)
        return at, np.maximum(away + _APART * (1.0 + away), self.side)

    def _within(self, sent: Array) -> Array:
        """The input in U that is nearest (n_u,)."""
        if self._nearest is None:
            return np.minimum(np.maximum(sent, self._low), self._high)
        if (self._set.c @ sent <= self._set.b).all():
            return sent
        found = self._nearest.solve(-sent, np.minimum(self._set.b, OPEN), np.full(self._set.b.size, -OPEN))
        return sent if found is None else found[0]


# The program of one independent part: how to leave the regulator's plan so that rows are kept, at the least cost.


MAX_ITERATIONS = 2000  # of one program


class PartProgram:
    """min |z|² with all rows kept, state rows at the price of their slack; one row for both sides of a direction.

    Rooms come in one vector of the whole plant: those of the state rows, stage after stage, then those of the hard rows
    of the parts, one part after the other (see `RegulatedRows`), and OPEN at its end for a side without a limit.

    Attributes:
        part: Its states, inputs and rows.
        columns: Which of the state rows of a stage are the part's.
        hard: Which of the hard rows are.

    Args:
        width: Number of state rows of a stage.
    """

    def __init__(
        self,
        problem: ControlProblem,
        law: Lqr,
        part: Part,
        slew: SlewRows,
        columns: slice,
        hard: slice,
        width: int,
        end: int,
    ) -> None:
        self.part, self.columns, self.hard = part, columns, hard
        self._steps = steps = problem.horizon
        states, inputs = (of[:, :, part.states.size :] for of in predict_regulated(problem, law, part))
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
            """Return the indices of the rooms (rows,) of one side."""
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
            max_iterations=MAX_ITERATIONS,
            linear=False,
        )
        is_suitable = FirstRows.is_suitable(*by_stage, len(d))
        self._first = FirstRows(*by_stage, self._program.sense).guess if is_suitable else self._ramps

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

    def leave(self, z: Array, taken: Array) -> None:
        """Write what z takes of the room of the part's state rows into `taken` (H, m), of the whole plant."""
        taken[:, self.columns] = self._x_of_z.dot(z).reshape(self._steps, -1)

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
    rows = [dict(pair.sides) for pair in find_pairs(c)]
    above, below = (np.array([sides.get(sign, -1) for sides in rows], dtype=np.intp) for sign in (1.0, -1.0))
    return above, below


def _directions(of_z: Array, above: Index, below: Index) -> Array:
    """Rows (H d, n) of the directions, from those of both sides (H, m, n)."""
    chosen = np.where((above >= 0)[:, None], of_z[:, above], -of_z[:, below])
    return np.asarray(chosen.reshape(-1, of_z.shape[2]))


# Where a plan may rest: the equilibria of one part that keep given limits.


class RestPlaces:
    """Equilibria of one part: the one nearest to a target that keeps given limits."""

    def __init__(self, problem: ControlProblem, rests: Equilibria, part: Part) -> None:
        (self._own,) = np.nonzero(np.isin(rests.held, part.states))
        self._states, self._held = part.states, rests.held[self._own]
        self._x_eq = rests.x_eq[np.ix_(part.states, self._own)]
        rows = problem.state_set.c[np.ix_(part.rows_x, part.states)] @ self._x_eq
        # Of each row of the part, its value (m, n_y) at an equilibrium of the whole plant
        self.rows = np.zeros((part.rows_x.size, rests.held.size))
        self.rows[:, self._own] = rows
        (self._used,) = np.nonzero(np.any(rows != 0.0, axis=1))
        self._rows = rows[self._used]
        if self._used.size and self._own.size:
            price, curve = np.full(self._used.size, problem.slack_linear), np.full(self._used.size, 1.0)
            sense = np.full(self._used.size, SOFT, dtype=np.int32)
            self._program = QuadraticProgram(2.0 * np.eye(self._own.size), self._rows, sense, price, curve)

    def nearest(self, reference: Array, sides: Array) -> None:
        """Move the part's states of `reference` (n_x,) to the nearest equilibrium within `sides` (m,) of its rows."""
        if not self._used.size or not self._own.size:
            return
        y = reference[self._held]
        room = sides[self._used] - self._rows @ y
        if (room >= 0.0).all():
            return
        moved = self._program.solve(np.zeros(y.size), np.minimum(room, OPEN), np.full(room.size, -OPEN))
        if moved is not None:
            reference[self._states] = self._x_eq @ (y + moved[0])


# Plans of the regulator for the whole plant at once, and the room that they leave: one product each, for all axes.
#
# Rows of the state set stand side by side, part after part. The hard rows, which inputs alone are in, come part after
# part too, each part with its stages one after the other: its rows of the input set, then both sides of its slew rows.


class RegulatedRows:
    """Effect of a deviation dx (n_x,) of the state from its reference on plan and rows, under the regulator."""

    def __init__(self, problem: ControlProblem, law: Lqr, parts: Sequence[Part], slew: SlewRows) -> None:
        plant, steps, n_x = problem.plant, problem.horizon, problem.plant.n_x
        self._steps, self._n_x, self._n_u = steps, n_x, plant.n_u
        states, inputs = np.zeros((steps + 1, n_x, n_x)), np.zeros((steps, plant.n_u, n_x))
        for part in parts:
            of_x, of_u = (of[:, :, : part.states.size] for of in predict_regulated(problem, law, part))
            states[:, part.states[:, None], part.states] = of_x
            inputs[:, part.inputs[:, None], part.states] = of_u
        # Tall matrices, column by column: the product is a few long sums then.
        self._plan = np.asfortranarray(np.vstack([inputs.reshape(-1, n_x), states.reshape(-1, n_x)]))
        # Rows of the state set (m,) that are asked about, part after part
        self.rows = np.concatenate([part.rows_x for part in parts])
        self.columns = _after_another([part.rows_x.size for part in parts])  # of each part, which of them are its own
        changes = np.diff(inputs, axis=0, prepend=0.0)
        hard: list[Array] = []
        of_hold: list[Array] = []
        of_inputs: list[Index] = []
        sides: list[Array] = []
        first: list[Index] = []
        for part in parts:
            c = problem.input_set.c[part.rows_u]
            own = slew.own(part.inputs)
            d = slew.d[own]
            hard.append(np.concatenate([c @ inputs, d @ changes, -d @ changes], axis=1).reshape(-1, n_x))
            held = np.zeros((steps, len(c) + 2 * own.size, plant.n_u))
            held[:, : len(c)] = c
            of_input = np.full((steps, len(c) + 2 * own.size), -1)
            of_input[:, : len(c)] = part.rows_u
            of_inputs.append(of_input.ravel())
            held[0, len(c) :] = np.concatenate([d, -d])
            of_hold.append(held.reshape(-1, plant.n_u))
            side = np.full((steps, len(c) + 2 * own.size), slew.side)
            side[:, : len(c)] = problem.input_set.b[part.rows_u]
            side[0, len(c) :] = 0.0  # by what was sent
            before = sum(one.size for one in sides)
            sides.append(side.ravel())
            first.append(np.stack([own, before + len(c) + np.arange(own.size)]))
        self.hard = _after_another([one.size for one in sides])  # of each part, which of the hard rows are its own
        self._hard_sides, self._of_hold = np.concatenate(sides), np.vstack(of_hold)
        rows_u = np.concatenate(of_inputs)
        # Where the rows of the input set are among the hard rows, and which row of the set each of them is
        self._input_rows = np.flatnonzero(rows_u >= 0)
        self._row_u = rows_u[self._input_rows]
        # Where the rows of u_0 - u_(-1) are, and behind those of their part the ones of u_(-1) - u_0.
        owner, above = np.hstack(first)
        below = above + np.concatenate([np.full(one.shape[1], one.shape[1]) for one in first])
        self._first, self._owner = np.concatenate([above, below]), np.concatenate([owner, owner])
        self._sign = np.repeat([1.0, -1.0], owner.size)
        of_x = problem.state_set.c[self.rows] @ states[1:]
        self._room = np.asfortranarray(-np.vstack([of_x.reshape(-1, n_x), *hard]))

    def room(
        self, dx: Array, sides: Array, hold: Array | None, first: tuple[Array, Array] | None, less: Array | None = None
    ) -> tuple[Array, Array]:
        """Room of the state rows (H, m) and of the hard rows.

        Args:
            dx: Deviation of the state (n_x,).
            sides: Right sides of the state rows less their values at the reference, (H, m) or (m,).
            hold: Input at the reference (n_u,); None for zero.
            first: See `SlewRows.first`; None where nothing is known of what was sent.
            less: What the right sides of the input set are less than the design's (m,); None: nothing.
        """
        room: Array = self._room.dot(dx)
        of_x, hard = room[: self._steps * self.rows.size].reshape(self._steps, -1), room[self._steps * self.rows.size :]
        of_x += sides
        hard += self._hard_sides
        if less is not None:
            hard[self._input_rows] -= less[self._row_u]
        if hold is not None:
            hard -= self._of_hold @ hold
        if first is None:
            hard[self._first] = OPEN
        else:
            at, side = first
            hard[self._first] += side.take(self._owner) + self._sign * at.take(self._owner)
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
