"""Bounds of single variables in a polytope."""

from __future__ import annotations

import numpy as np

from uavctl.smpc.sets import Polytope


def test_bounds_are_the_tightest_of_each_variable_s_own_rows() -> None:
    rows = np.array([[2.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, -0.5, 0.0], [1.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    low, high = Polytope(rows, np.array([4.0, 3.0, 2.0, 0.1, 5.0])).bounds
    assert low.tolist() == [-5.0, -4.0, -np.inf]
    assert high.tolist() == [2.0, np.inf, np.inf]


def test_bounds_of_a_box_are_the_box() -> None:
    low, high = Polytope.from_box([-1.0, -np.inf], [np.inf, 2.0]).bounds
    assert (low.tolist(), high.tolist()) == ([-1.0, -np.inf], [np.inf, 2.0])
