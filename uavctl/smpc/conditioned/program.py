"""The QP of an independent part: slew limits, rows, regulated plans, reference equilibria.

1. `SlewRows`: the setpoint limiter lets a setpoint move by slew · tick in each tick, and inputs are held for a step. A
   change of up to slew · Δt has arrived with the last tick of its step: rows bound the change from step to step by
   that. While it moves, the setpoint lags the plan by half a step on average.
2. `RegulatedRows`: plan of the regulator for the whole plant, and the margin that it leaves in all rows: one product
   each. State rows stand side by side, part after part. Hard rows are in inputs alone and come part after part, each
   with its stages in order: rows of the input set, then both sides of its slew rows.
3. `PartProgram`: min Σ_t s_t |z_t|² such that the rows are kept, with z = L'c, the change c of the regulator's inputs
   and the weights s of the stages.
4. `ReferenceEquilibria`: the equilibrium nearest to a target that keeps given limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from operator import le

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.smpc.nominal import ControlProblem, Lqr, Part, predict_regulated
from uavctl.smpc.plant import Plant
from uavctl.smpc.qp import ACTIVE, BELOW, OPEN, SOFT, QuadraticProgram, Sense
from uavctl.smpc.sets import Equilibria, Polytope, find_pairs
from uavctl.smpc.working_set import WorkingSetGuess

Index = NDArray[np.intp]

_MIN_WIDTH = 1e-8  # least width of the intersection of the first slew row and U, as a share of a setpoint


class SlewRows:
    """Slew limits |D (u_t - u_(t-1))| <= side, in each row that can bind.

    Args:
        input_set: U; a limit wider than U needs no row.
        slew_mps3: Largest change in a second [m/s³]; infinite for no rows.
    """

    def __init__(self, plant: Plant, input_set: Polytope, slew_mps3: float) -> None:
        self.side = slew_mps3 * plant.dt_s  # largest change in a step [m/s²]
        self._set = input_set
        self._low, self._high = input_set.bounds
        self._lows, self._highs = self._low.tolist(), self._high.tolist()
        d = plant.accel_map
        with np.errstate(invalid="ignore"):  # ∞ · 0: an unlimited input without effect on the axis
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

    def find_rows(self, inputs: Index) -> Index:
        """Return which rows involve some inputs."""
        return np.flatnonzero(np.any(self.d[:, inputs] != 0.0, axis=1))

    def measure_first_step(self, sent: Array) -> tuple[Array, Array]:
        """Return D u_(-1) (m,) of the input sent last (n_u,), and the largest change to the first input (m,).

        The change is `side`, or the distance of the nearest input in U, so that the first row is feasible.
        """
        d_sent = self.d.dot(sent)
        if self._box and all(map(le, self._lows, sent.tolist())) and all(map(le, sent.tolist(), self._highs)):
            return d_sent, self._sides
        distance = np.abs(self.d @ self._clip(sent) - d_sent)
        return d_sent, np.maximum(distance + _MIN_WIDTH * (1.0 + distance), self.side)

    def _clip(self, sent: Array) -> Array:
        """Return the nearest input in U (n_u,)."""
        if self._nearest is None:
            return np.minimum(np.maximum(sent, self._low), self._high)
        if (self._set.c @ sent <= self._set.b).all():
            return sent
        solution = self._nearest.solve(-sent, np.minimum(self._set.b, OPEN), np.full(self._set.b.size, -OPEN))
        return sent if solution is None else solution[0]


MAX_ITERATIONS = 2000  # of one program


class PartProgram:
    """min Σ_t s_t |z_t|² with all rows kept; state rows are soft; one row for both sides of a direction.

    Margins are one vector of the whole plant: state rows, stage after stage, then the hard rows part after part (see
    `RegulatedRows`), and OPEN at the end for a side without a limit.

    Attributes:
        part: Its states, inputs and rows.
        columns: The part's state rows of a stage.
        hard: The part's hard rows.

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
        self._k = law.k[np.ix_(part.inputs, part.states)]
        self._z_of_input = np.linalg.cholesky(law.weight[np.ix_(part.inputs, part.inputs)]).T
        states, inputs = (prediction[:, :, part.states.size :] for prediction in predict_regulated(problem, law, part))
        n = states.shape[2]
        self._plan = np.vstack([inputs.reshape(-1, n), states[1:].reshape(-1, n)])
        self._inputs, self._states = _as_slice(part.inputs), _as_slice(part.states)
        # A path (p_t, r_t) adds -2 Σ (x_t' Q p_t + u_t' R r_t) to |z|²: least at z = Σ (X_t' Q p_t + U_t' R r_t)
        q_x, q_u = problem.q_x[np.ix_(part.states, part.states)], problem.q_u[np.ix_(part.inputs, part.inputs)]
        self._path_map_x = np.einsum("tij,ik->jtk", states[:-1], q_x).reshape(n, -1)
        self._path_map_u = np.einsum("tij,ik->jtk", inputs, q_u).reshape(n, -1)
        c_x = problem.state_set.c[np.ix_(part.rows_x, part.states)]
        c_u = problem.input_set.c[np.ix_(part.rows_u, part.inputs)]
        d = slew.d[np.ix_(slew.find_rows(part.inputs), part.inputs)]
        changes = np.diff(inputs, axis=0, prepend=0.0)
        x_rows, u_rows = c_x @ states[1:], np.concatenate([c_u @ inputs, d @ changes, -d @ changes], axis=1)
        self._x_of_z, self._u_of_z = np.asfortranarray(x_rows.reshape(-1, n)), u_rows.reshape(-1, n)
        above_x, below_x = _find_sides(c_x)
        pairs_u, slews = _find_sides(c_u), len(c_u) + np.arange(len(d))
        above_u, below_u = np.append(pairs_u[0], slews), np.append(pairs_u[1], slews + len(d))
        rows_x, rows_u = _select_directions(x_rows, above_x, below_x), _select_directions(u_rows, above_u, below_u)
        rows = np.vstack([rows_x, rows_u])

        def index_margins(state_rows: Index, hard_rows: Index) -> Index:
            """Return the indices of the margins (rows,) of one side."""
            at_x = columns.start + width * np.arange(steps)[:, None] + state_rows
            at_u = width * steps + hard.start + u_rows.shape[1] * np.arange(steps)[:, None] + hard_rows
            return np.append(np.where(state_rows >= 0, at_x, end).ravel(), np.where(hard_rows >= 0, at_u, end).ravel())

        self._upper, self._lower = index_margins(above_x, above_u), index_margins(below_x, below_u)
        self._width = above_u.size  # of the hard rows of a stage
        self._slews = range(len(rows_x) + pairs_u[0].size, len(rows_x) + self._width)  # those of the first stage
        self._rows, self._is_soft = rows, np.arange(len(rows)) < len(rows_x)
        self._slack_linear, self._slack_quadratic = problem.slack_linear, problem.slack_quadratic
        # The program in y for each weights used so far, and z / y
        self._programs: dict[bytes, tuple[QuadraticProgram, Array]] = {}
        self.weigh_stages(None)
        by_stage = rows_x.reshape(steps, -1, n), rows_u.reshape(steps, -1, n)
        is_suitable = WorkingSetGuess.is_suitable(*by_stage, len(d))
        self._guess_working_set = (
            WorkingSetGuess(*by_stage, self._program.sense).guess if is_suitable else self._guess_ramps
        )

    def weigh_stages(self, weights: Array | None) -> None:
        """Select the weights s (H,) of the stages for the programs to come; None: all alike."""
        key = b"" if weights is None else weights.tobytes()
        if key not in self._programs:
            # y_t = s_t^½ z_t: min |y|²
            scale = np.ones(self._steps) if weights is None else 1.0 / np.sqrt(weights)
            scale = np.repeat(scale, self.part.inputs.size)
            self._programs[key] = self._make_program(self._rows * scale), scale
        self._program, self._z_per_y = self._programs[key]

    def _make_program(self, rows: Array) -> QuadraticProgram:
        """Make the program min |y|² whose rows are linear in y, (rows, n)."""
        return QuadraticProgram(
            2.0 * np.eye(rows.shape[1]),
            np.ascontiguousarray(rows),
            np.where(self._is_soft, SOFT, 0).astype(np.int32),
            np.where(self._is_soft, self._slack_linear, 0.0),
            np.where(self._is_soft, self._slack_quadratic, 0.0),
            max_iterations=MAX_ITERATIONS,
            linear=False,
        )

    def follow_path(self, path_x: Array, path_u: Array) -> Array:
        """Return the z (n,) of least cost along a path of the whole plant (H, n_x), (H, n_u), without limits."""
        part = self.part
        z: Array = self._path_map_x @ path_x[:, part.states].ravel()
        z += self._path_map_u @ path_u[:, part.inputs].ravel()
        return z

    def find_shift(self, state: Array, input_: Array) -> Array:
        """Return the z_t (n_u,) of the regulator around an equilibrium that is shifted by `state`, `input_`.

        Args:
            state: Shift of the equilibrium (n_x,), of the whole plant.
            input_: Shift of its input (n_u,).
        """
        # z_t = L'c_t,  c_t = u_s - K x_s
        part = self.part
        z: Array = self._z_of_input @ (input_[part.inputs] - self._k @ state[part.states])
        return z

    def subtract_margin(self, z: Array, margin_x: Array, margin_u: Array) -> None:
        """Subtract the margin that z uses, in the state rows (H, m) and the hard rows of the whole plant."""
        margin_x[:, self.columns] -= (self._x_of_z @ z).reshape(self._steps, -1)
        margin_u[self.hard] -= self._u_of_z @ z

    def write_used_margin(self, z: Array, used_margin: Array) -> None:
        """Write the margin that z uses in the part's state rows into `used_margin` (H, m), of the whole plant."""
        used_margin[:, self.columns] = self._x_of_z.dot(z).reshape(self._steps, -1)

    @property
    def iterations(self) -> int:
        """Iterations of the last program."""
        return self._program.iterations

    def solve(self, margins: Array, reuse_rows: bool) -> Array | None:
        """Solve for z (n,); None without an optimum.

        Args:
            margins: Margin of all rows for z = 0, less their back-offs; OPEN at the end.
            reuse_rows: Start from the active rows of the last program, which must be of the same question.
        """
        upper, lower = margins.take(self._upper), -margins.take(self._lower)
        working_set = None if reuse_rows else self._guess_working_set(upper, lower)
        # Where two back-offs overlap, the mean stays in the middle.
        crossed = upper < lower
        if np.count_nonzero(crossed):
            middle = 0.5 * (upper + lower)
            np.copyto(upper, middle, where=crossed)
            np.copyto(lower, middle, where=crossed)
        y = self._program.solve_sides(upper, lower, working_set, reuse_rows)
        if y is None and not reuse_rows:
            # DAQP cycles in rare programs. From other rows it takes another way: from those that z = 0 violates.
            sense = self._program.sense
            violated = np.where(upper < 0.0, sense + ACTIVE, np.where(lower > 0.0, sense + BELOW, sense))
            y = self._program.solve_sides(upper, lower, violated.astype(np.int32))
        return None if y is None else self._z_per_y * y

    def _guess_ramps(self, upper: Array, lower: Array) -> Sense | None:
        """Guess the active rows: the setpoint moves from the last one to the regulator's at the slew limit.

        It arrives in the stage where the sum of the margins of all slew rows so far is not negative.
        """
        working_set = None
        for i in self._slews:
            for sides, sign, state in ((upper, 1.0, ACTIVE), (lower, -1.0, BELOW)):
                if sign * sides[i] < 0.0:
                    missing = (sign * sides[i :: self._width]).cumsum() < 0.0
                    if working_set is None:
                        working_set = self._program.sense.copy()
                    count = int(missing.argmin()) or self._steps
                    working_set[i : i + count * self._width : self._width] += state
        return working_set

    def add_to_plan(self, z: Array, inputs: Array, states: Array) -> None:
        """Add the effect of z to the inputs (H, n_u) and states (H+1, n_x) of the whole plant."""
        plan = self._plan.dot(z)
        count = self._steps * self.part.inputs.size
        _add_columns(plan[:count].reshape(self._steps, -1), inputs, self._inputs)
        _add_columns(plan[count:].reshape(self._steps, -1), states[1:], self._states)


def _as_slice(index: Index) -> slice | Index:
    """Return adjacent indices as a slice, which needs no copy."""
    if not index.size or index[-1] - index[0] + 1 != index.size:
        return index
    return slice(int(index[0]), int(index[-1]) + 1)


def _add_columns(change: Array, matrix: Array, columns: slice | Index) -> None:
    """Add to some columns of a matrix; with a slice, in place."""
    if isinstance(columns, slice):
        selected = matrix[:, columns]
        selected += change
    else:
        matrix[:, columns] += change


def _find_sides(c: Array) -> tuple[Index, Index]:
    """Return the rows that limit each direction from above and from below, -1 for none: (d,), (d,)."""
    rows = [dict(pair.sides) for pair in find_pairs(c)]
    above, below = (np.array([sides.get(sign, -1) for sides in rows], dtype=np.intp) for sign in (1.0, -1.0))
    return above, below


def _select_directions(rows: Array, above: Index, below: Index) -> Array:
    """Return the rows (H d, n) of the directions, from those of both sides (H, m, n)."""
    chosen = np.where((above >= 0)[:, None], rows[:, above], -rows[:, below])
    return np.asarray(chosen.reshape(-1, rows.shape[2]))


class ReferenceEquilibria:
    """Equilibria of one part that keep given limits."""

    def __init__(self, problem: ControlProblem, equilibria: Equilibria, part: Part) -> None:
        (self._coordinates,) = np.nonzero(np.isin(equilibria.held, part.states))
        self._states, self._held = part.states, equilibria.held[self._coordinates]
        self._x_eq = equilibria.x_eq[np.ix_(part.states, self._coordinates)]
        rows = problem.state_set.c[np.ix_(part.rows_x, part.states)] @ self._x_eq
        # Of each row of the part, its value (m, n_y) at an equilibrium of the whole plant
        self.rows = np.zeros((part.rows_x.size, equilibria.held.size))
        self.rows[:, self._coordinates] = rows
        (self._used,) = np.nonzero(np.any(rows != 0.0, axis=1))
        self._rows = rows[self._used]
        if self._used.size and self._coordinates.size:
            price, curve = np.full(self._used.size, problem.slack_linear), np.full(self._used.size, 1.0)
            sense = np.full(self._used.size, SOFT, dtype=np.int32)
            self._program = QuadraticProgram(2.0 * np.eye(self._coordinates.size), self._rows, sense, price, curve)

    def move_to_nearest(self, reference: Array, sides: Array) -> None:
        """Move the part's states of `reference` (n_x,) to the nearest equilibrium within `sides` (m,) of its rows."""
        if not self._used.size or not self._coordinates.size:
            return
        y = reference[self._held]
        margin = sides[self._used] - self._rows @ y
        if (margin >= 0.0).all():
            return
        solution = self._program.solve(np.zeros(y.size), np.minimum(margin, OPEN), np.full(margin.size, -OPEN))
        if solution is not None:
            reference[self._states] = self._x_eq @ (y + solution[0])


class RegulatedRows:
    """Plan and margins under the regulator, for a deviation dx (n_x,) of the state from its reference."""

    def __init__(self, problem: ControlProblem, law: Lqr, parts: Sequence[Part], slew: SlewRows) -> None:
        plant, steps, n_x = problem.plant, problem.horizon, problem.plant.n_x
        self._steps, self._n_x, self._n_u = steps, n_x, plant.n_u
        states, inputs = np.zeros((steps + 1, n_x, n_x)), np.zeros((steps, plant.n_u, n_x))
        for part in parts:
            x_map, u_map = (
                prediction[:, :, : part.states.size] for prediction in predict_regulated(problem, law, part)
            )
            states[:, part.states[:, None], part.states] = x_map
            inputs[:, part.inputs[:, None], part.states] = u_map
        # Tall matrices in column order: fast products
        self._plan = np.asfortranarray(np.vstack([inputs.reshape(-1, n_x), states.reshape(-1, n_x)]))
        # Rows of the state set (m,) with limits, part after part
        self.rows = np.concatenate([part.rows_x for part in parts])
        self.columns = _make_slices([part.rows_x.size for part in parts])  # columns of each part
        changes = np.diff(inputs, axis=0, prepend=0.0)
        hard: list[Array] = []
        rest_maps: list[Array] = []
        input_rows: list[Index] = []
        sides: list[Array] = []
        first: list[Index] = []
        for part in parts:
            c = problem.input_set.c[part.rows_u]
            slew_rows = slew.find_rows(part.inputs)
            d = slew.d[slew_rows]
            hard.append(np.concatenate([c @ inputs, d @ changes, -d @ changes], axis=1).reshape(-1, n_x))
            rest_map = np.zeros((steps, len(c) + 2 * slew_rows.size, plant.n_u))
            rest_map[:, : len(c)] = c
            input_row = np.full((steps, len(c) + 2 * slew_rows.size), -1)
            input_row[:, : len(c)] = part.rows_u
            input_rows.append(input_row.ravel())
            rest_map[0, len(c) :] = np.concatenate([d, -d])
            rest_maps.append(rest_map.reshape(-1, plant.n_u))
            side = np.full((steps, len(c) + 2 * slew_rows.size), slew.side)
            side[:, : len(c)] = problem.input_set.b[part.rows_u]
            side[0, len(c) :] = 0.0  # set by the input sent last
            before = sum(entries.size for entries in sides)
            sides.append(side.ravel())
            first.append(np.stack([slew_rows, before + len(c) + np.arange(slew_rows.size)]))
        self.hard = _make_slices([entries.size for entries in sides])  # hard rows of each part
        self._hard_sides, self._rest_map = np.concatenate(sides), np.vstack(rest_maps)
        rows_u = np.concatenate(input_rows)
        # Indices of the input set's rows among the hard rows, and the row of the set of each
        self._input_rows = np.flatnonzero(rows_u >= 0)
        self._row_u = rows_u[self._input_rows]
        # Indices of the rows of u_0 - u_(-1), and of u_(-1) - u_0
        slew_row, above = np.hstack(first)
        below = above + np.concatenate([np.full(entries.shape[1], entries.shape[1]) for entries in first])
        self._first, self._slew_row = np.concatenate([above, below]), np.concatenate([slew_row, slew_row])
        self._sign = np.repeat([1.0, -1.0], slew_row.size)
        x_map = problem.state_set.c[self.rows] @ states[1:]
        self._margin = np.asfortranarray(-np.vstack([x_map.reshape(-1, n_x), *hard]))

    def compute_margin(
        self,
        dx: Array,
        sides: Array,
        equilibrium_input: Array | None,
        first: tuple[Array, Array] | None,
        input_reduction: Array | None = None,
    ) -> tuple[Array, Array]:
        """Return the margin of the state rows (H, m) and of the hard rows.

        Args:
            dx: Deviation of the state (n_x,).
            sides: Right sides of the state rows minus their values at the reference, (H, m) or (m,).
            equilibrium_input: Input at the reference (n_u,); None for zero.
            first: See `SlewRows.measure_first_step`; None if the input sent last is unknown.
            input_reduction: Reduction of the right sides of the input set (m,); None: none.
        """
        # b - C x_t(dx), b - C u_t(dx), side ∓ D (u_t - u_(t-1))
        margin: Array = self._margin.dot(dx)
        margin_x, hard = (
            margin[: self._steps * self.rows.size].reshape(self._steps, -1),
            margin[self._steps * self.rows.size :],
        )
        margin_x += sides
        hard += self._hard_sides
        if input_reduction is not None:
            hard[self._input_rows] -= input_reduction[self._row_u]
        if equilibrium_input is not None:
            hard -= self._rest_map @ equilibrium_input
        if first is None:
            hard[self._first] = OPEN
        else:
            d_sent, side = first
            hard[self._first] += side.take(self._slew_row) + self._sign * d_sent.take(self._slew_row)
        return margin_x, hard

    def plan(self, dx: Array) -> tuple[Array, Array]:
        """Return inputs (H, n_u) and states (H+1, n_x), as deviations from the reference."""
        plan: Array = self._plan.dot(dx)
        return plan[: self._steps * self._n_u].reshape(-1, self._n_u), plan[self._steps * self._n_u :].reshape(
            -1, self._n_x
        )


def _make_slices(sizes: Sequence[int]) -> list[slice]:
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(i, j) for i, j in pairwise(ends)]
