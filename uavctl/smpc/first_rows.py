"""Which rows a program begins with: a guess at those that bind, by where the fastest inputs lead.

An active-set method ends at the same optimum from any rows, and takes fewer iterations the nearer they are to those
that bind there. Plans in transit are alike: as fast as the slew rows let it to where a state row still can be kept,
back as fast, and then along that row. Where even the fastest inputs leave a state row, it gives way for certain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from uavctl.smpc.qp import ACTIVE, BELOW, KEEPS, Sense

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_EVERY = 2  # stages along a state row: from those of every one, more would have to be taken out than put in
_LONGER = 1.0 / 3.0  # of the stages in which a plan without state rows is beyond one: how much longer it is kept to


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
        # From the unit of the rows of the input set to that of the slew row.
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
        if np.count_nonzero(over) or (fast[0] < 0.0 and not np.count_nonzero(under)):
            cap = None if self._inputs is None else upper[self._inputs]
            return self._begin(fast, slow, high, cap, braked, over, ACTIVE, BELOW)
        if np.count_nonzero(under) or slow[0] > 0.0:
            cap = None if self._inputs is None else -lower[self._inputs]
            return self._begin(-slow, -fast, -low, cap, -pushed, under, BELOW, ACTIVE)
        return None

    def _begin(
        self,
        fast: Array,
        slow: Array,
        high: Array,
        cap: Array | None,
        braked: Array,
        over: Flags,
        towards: int,
        against: int,
    ) -> Sense:
        """Rows of a plan that goes upwards, after it has braked while state rows give way.

        Args:
            fast: Upper sides of the slew rows (H,).
            slow: Lower ones.
            high: Upper sides of the state rows (H,).
            cap: Upper sides of the input rows (H,); None: there are none.
            braked: State rows by `slow` (H,).
            over: Those that give way (H,).
            towards: DAQP's state of a row at its upper side.
            against: The same of its lower one.
        """
        begin, since = self._sense.copy(), 0
        slews, states = begin[self._slews], begin[self._states]
        if np.count_nonzero(over):
            since = _last(over) + 1
            states[over] += towards
            slews[:since] += against
            if since == self._steps:
                return begin
            fast = np.concatenate([slow[:since], fast[since:]])
        # To where the regulator asks for no more.
        z = self._z.dot(fast)
        there = z[since:] >= 0.0
        if there[0]:
            return begin
        count = since + (int(there.argmax()) or there.size)
        left = self._of_z[since:, :count].dot(z[:count]) > high[since:]
        if not np.count_nonzero(left):
            slews[since:count] += towards
            return begin
        # That leaves a state row: as long as it can still be kept, and back.
        ramp = fast.cumsum()
        top = ramp if cap is None else np.minimum(ramp, cap * self._unit)
        gain = top - slow
        gain[1:] -= top[:-1]
        room, reach = (high - braked)[since:], self._reach[since:]
        # Where the regulator asks for no more is a good first try.
        middle, count, beyond = count, since, self._steps + 1
        while beyond - count > 1:
            if np.count_nonzero(reach[:, :middle].dot(gain[:middle]) > room):
                beyond = middle
            else:
                count = middle
            middle = (count + beyond) // 2
        nearest = since + int((room - reach[:, :count].dot(gain[:count])).argmin())
        slews[since:count] += towards
        if cap is not None:
            capped = ramp[since:count] > top[since:count]
            if np.count_nonzero(capped):
                slews[since:count][capped] -= towards
                begin[self._inputs][since:count][capped] += towards
        slews[count + 1 : nearest + 1] += against
        # Along the row it takes longer than past it.
        end = since + _last(left) + 1
        end += int(_LONGER * (end - nearest))
        states[nearest + 1 : end : _EVERY] += towards + KEEPS
        return begin


def _last(flags: Flags) -> int:
    return int(flags.size - 1 - flags[::-1].argmax())
