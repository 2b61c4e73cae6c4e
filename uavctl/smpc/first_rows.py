"""Which rows a program begins with: a guess at those that bind, by where the fastest inputs lead.

An active-set method ends at the same optimum from any rows, and takes fewer iterations the nearer they are to those
that bind there. Plans in transit are alike: as fast as the slew rows let it to where a state row still can be kept,
back as fast, and then along that row. Where even the fastest inputs leave a state row, it gives way for certain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.qp import ACTIVE, BELOW, Sense

Array = NDArray[np.float64]

_EVERY = 2  # stages along a state row: from those of every one, more would have to be taken out than put in


class FirstRows:
    """Guesses for a part with one input and one slew row.

    It looks at the direction of the state rows that the input moves the soonest (a speed, before a position).

    Args:
        of_x: State rows (H, d, n) by z.
        of_u: Rows (H, k, n) of a stage by z: those of the input set, then the slew row.
        sense: DAQP's state of all rows: those of `of_x`, stage after stage, then those of `of_u`.
    """

    def __init__(self, of_x: Array, of_u: Array, sense: Sense) -> None:
        self._sense, self._steps = sense, len(of_x)
        width, last = of_u.shape[1], of_x.shape[0] * of_x.shape[1]
        inverse = np.linalg.inv(of_u[:, -1])
        by_slew = np.einsum("tdn,nk->dtk", of_x, inverse)
        direction = int(np.argmax(by_slew[:, 0, 0] / np.abs(by_slew[:, -1, 0])))
        self._states = slice(direction, last, of_x.shape[1])
        self._slews = slice(last + width - 1, None, width)
        # Rows of the input set, in the slew row's unit, where they are of the same sign.
        self._inputs = slice(last, None, width) if width > 1 else None
        self._unit = of_u[0, -1, 0] / of_u[0, 0, 0]
        self._of_z = np.asfortranarray(of_x[:, direction])
        self._z, self._reach = inverse, np.ascontiguousarray(by_slew[direction])

    @staticmethod
    def suits(of_x: Array, of_u: Array, slews: int) -> bool:
        """Whether there is one slew row and one input, and all rows move as the input does."""
        if slews != 1 or not of_x.shape[1] or of_u.shape[0] != of_u.shape[2] or of_u.shape[1] > 2:
            return False
        reach = np.einsum("tdn,nk->dtk", of_x, np.linalg.inv(of_u[:, -1]))
        return bool((of_u[0, :, 0] > 0.0).all() and (reach[:, -1, 0] != 0.0).all() and (reach[:, 0, 0] > 0.0).any())

    def of(self, upper: Array, lower: Array) -> Sense | None:
        """`sense` with the rows to begin with, by the sides (m,) of all rows; None: with none."""
        fast, slow = upper[self._slews], lower[self._slews]
        high, low = upper[self._states], lower[self._states]
        braked, pushed = self._reach.dot(slow), self._reach.dot(fast)
        over, under = braked > high, pushed < low
        if np.count_nonzero(over):
            return self._gives_way(over, ACTIVE, BELOW)
        if np.count_nonzero(under):
            return self._gives_way(under, BELOW, ACTIVE)
        if fast[0] < 0.0:
            cap = None if self._inputs is None else upper[self._inputs]
            return self._transit(fast, slow, high, cap, braked, ACTIVE, BELOW)
        if slow[0] > 0.0:
            cap = None if self._inputs is None else -lower[self._inputs]
            return self._transit(-slow, -fast, -low, cap, -pushed, BELOW, ACTIVE)
        return None

    def _gives_way(self, over: NDArray[np.bool_], beyond: int, against: int) -> Sense:
        """State rows `over` (H,) that give way, and all slew rows against it until the last one."""
        begin = self._sense.copy()
        begin[self._states][over] += beyond
        begin[self._slews][: _last(over) + 1] += against
        return begin

    def _transit(
        self, fast: Array, slow: Array, high: Array, cap: Array | None, braked: Array, towards: int, against: int
    ) -> Sense:
        """Rows of a setpoint that has to go upwards to the regulator's, farther than a slew row lets it.

        Args:
            fast: Upper sides of the slew rows (H,).
            slow: Lower ones.
            high: Upper sides of the state rows (H,).
            cap: Upper sides of the input rows (H,); None: there are none.
            braked: State rows by `slow` (H,).
            towards: DAQP's state of a row at its upper side.
            against: The same of its lower one.
        """
        begin = self._sense.copy()
        slews, states = begin[self._slews], begin[self._states]
        # To where the regulator asks for no more.
        z = self._z.dot(fast)
        there = z >= 0.0
        count = int(there.argmax()) or self._steps
        over = self._of_z[:, :count].dot(z[:count]) > high
        if not np.count_nonzero(over):
            slews[:count] += towards
            return begin
        # That leaves a state row: as long as it can still be kept, and back.
        ramp = fast.cumsum()
        top = ramp if cap is None else np.minimum(ramp, cap * self._unit)
        gain = top - slow
        gain[1:] -= top[:-1]
        room = high - braked
        count, beyond = 0, self._steps + 1
        while beyond - count > 1:
            middle = (count + beyond) // 2
            if np.count_nonzero(self._reach[:, :middle].dot(gain[:middle]) > room):
                beyond = middle
            else:
                count = middle
        nearest = int((room - self._reach[:, :count].dot(gain[:count])).argmin())
        slews[:count] += towards
        if cap is not None:
            capped = ramp[:count] > top[:count]
            if np.count_nonzero(capped):
                slews[:count][capped] -= towards
                begin[self._inputs][:count][capped] += towards
        slews[count + 1 : nearest + 1] += against
        states[nearest + 1 : _last(over) + 1 : _EVERY] += towards
        return begin


def _last(flags: NDArray[np.bool_]) -> int:
    return int(flags.size - 1 - flags[::-1].argmax())
