"""Guess of the working set of a program, its active rows, from the fastest inputs.

1. An active-set method ends at the same optimum from any rows, after fewer iterations the nearer they are to the active
   ones.
2. Plans in transit are alike: the input changes at the slew limit until a state row can just be kept, changes back as
   fast, and the plan then follows that row.
3. Where even the fastest inputs leave a state row, that row is relaxed for certain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.smpc.qp import ACTIVE, BELOW, KEEPS_LIMIT, Sense

Flags = NDArray[np.bool_]

# Every second stage along a state row is active: with each one, more would have to be removed than added.
_ROW_SPACING = 2
# Extra time on a state row, as a share of the stages in which a plan without state rows is beyond it.
_EXTRA_SHARE = 1.0 / 3.0


class WorkingSetGuess:
    """Guess of the working set of a part with one input and one slew row. Not for concurrent use.

    It uses the state rows of one direction: that which the input moves first (a speed, before a position).

    Args:
        x_rows: State rows (H, d, n) by z.
        u_rows: Rows (H, k, n) of a stage by z: those of the input set, then the slew row.
        sense: DAQP's state of all rows: all of `x_rows`, stage after stage, then all of `u_rows`.
    """

    def __init__(self, x_rows: Array, u_rows: Array, sense: Sense) -> None:
        self._sense, self._steps = sense, len(x_rows)
        width, last = u_rows.shape[1], x_rows.shape[0] * x_rows.shape[1]
        inverse = np.linalg.inv(u_rows[:, -1])
        by_slew = np.einsum("tdn,nk->dtk", x_rows, inverse)
        direction = int(np.argmax(by_slew[:, 0, 0] / np.abs(by_slew[:, -1, 0])))
        self._states = slice(direction, last, x_rows.shape[1])
        self._slews = slice(last + width - 1, None, width)
        # Factor from the unit of the input set's rows to that of the slew row
        self._inputs = slice(last, None, width) if width > 1 else None
        self._unit = u_rows[0, -1, 0] / u_rows[0, 0, 0]
        self._soft, self._hard = int(sense[0]), int(sense[last])
        tops = np.zeros(self._steps + 1)
        self._top, self._before = tops[1:], tops[:-1]  # largest input in each stage, and in the one before
        z_rows = np.asfortranarray(x_rows[:, direction])
        self._z, self._reach = inverse, np.ascontiguousarray(by_slew[direction])
        # Their first columns, by number: a product with a part of a matrix would copy it first.
        counts = range(len(x_rows) + 1)
        self._z_columns = [np.ascontiguousarray(z_rows[:, :count]) for count in counts[:-1]] + [z_rows]
        self._reached = [np.ascontiguousarray(self._reach[:, :count]) for count in counts]

    @staticmethod
    def is_suitable(x_rows: Array, u_rows: Array, slews: int) -> bool:
        """Return whether there is one slew row and one input, and all rows move in the input's direction."""
        if slews != 1 or not x_rows.shape[1] or u_rows.shape[0] != u_rows.shape[2] or u_rows.shape[1] > 2:
            return False
        reach = np.einsum("tdn,nk->dtk", x_rows, np.linalg.inv(u_rows[:, -1]))
        return bool((u_rows[0, :, 0] > 0.0).all() and (reach[:, -1, 0] != 0.0).all() and (reach[:, 0, 0] > 0.0).any())

    def guess(self, upper: Array, lower: Array) -> Sense | None:
        """Return `sense` with the guessed active rows, from the sides (m,) of all rows; None: no guess."""
        fast, slow = upper[self._slews], lower[self._slews]
        braked = self._reach.dot(slow)
        over = braked > upper[self._states]
        if np.count_nonzero(over):
            return self._build_guess(upper, lower, braked, over, ACTIVE, BELOW)
        pushed = self._reach.dot(fast)
        under = pushed < lower[self._states]
        if np.count_nonzero(under):
            return self._build_guess(-lower, -upper, -pushed, under, BELOW, ACTIVE)
        if fast[0] < 0.0:
            return self._build_guess(upper, lower, braked, None, ACTIVE, BELOW)
        if slow[0] > 0.0:
            return self._build_guess(-lower, -upper, -pushed, None, BELOW, ACTIVE)
        return None

    def _build_guess(
        self, upper: Array, lower: Array, braked: Array, over: Flags | None, towards: int, against: int
    ) -> Sense:
        """Guess the active rows of a plan that goes up, after it has braked while state rows are relaxed.

        Args:
            upper: Upper sides of all rows (m,).
            lower: Lower sides (m,).
            braked: State rows (H,) by the lower sides of the slew rows.
            over: State rows that are relaxed (H,); None: none.
            towards: DAQP's state of a row at its upper side.
        """
        fast, slow, high = upper[self._slews], lower[self._slews], upper[self._states]
        working_set, since = self._sense.copy(), 0
        slews, states = working_set[self._slews], working_set[self._states]
        if over is not None:
            since = _find_last(over) + 1
            states[over] = self._soft + towards
            slews[:since] = self._hard + against
            if since == self._steps:
                return working_set
            fast = np.concatenate([slow[:since], fast[since:]])
        # Up to the stage where the regulator needs no more: z_t >= 0 with z = S⁻¹ fast
        z = self._z.dot(fast)
        is_reached = z[since:] >= 0.0
        if is_reached[0]:
            return working_set
        count = since + (int(is_reached.argmax()) or is_reached.size)
        leaves_row = self._z_columns[count][since:].dot(z[:count]) > high[since:]
        if not np.count_nonzero(leaves_row):
            slews[since:count] = self._hard + towards
            return working_set
        # If that leaves a state row: as long as the row can still be kept, then back.
        ramp = np.add.accumulate(fast)
        top = self._top
        if self._inputs is None:
            top[:] = ramp
        else:
            np.minimum(ramp, upper[self._inputs] * self._unit, out=top)
        gain = top - slow
        gain -= self._before
        margin, used = (high - braked)[since:], None
        # Bisection over the last stage, from the one where the regulator needs no more
        middle, count, infeasible = count, since, self._steps + 1
        while infeasible - count > 1:
            of_gain = self._reached[middle]
            tried = (of_gain[since:] if since else of_gain).dot(gain[:middle])
            if np.count_nonzero(tried > margin):
                infeasible = middle
            else:
                count, used = middle, tried
            middle = (count + infeasible) // 2
        if used is None:
            used = self._reached[since][since:].dot(gain[:since])
        nearest = since + int((margin - used).argmin())
        slews[since:count] = self._hard + towards
        if self._inputs is not None:
            capped = ramp[since:count] > top[since:count]
            if np.count_nonzero(capped):
                slews[since:count][capped] = self._hard
                working_set[self._inputs][since:count][capped] = self._hard + towards
        slews[count + 1 : nearest + 1] = self._hard + against
        # The plan stays on the row for longer than a free plan is beyond it.
        end = since + _find_last(leaves_row) + 1
        end += int(_EXTRA_SHARE * (end - nearest))
        states[nearest + 1 : end : _ROW_SPACING] = self._soft + towards + KEEPS_LIMIT
        return working_set


def _find_last(flags: Flags) -> int:
    return int(flags.size - 1 - flags[::-1].argmax())
