"""Risk allocation: quantiles against their definitions, and their cost on the paper's example."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from design_rig import spec
from scipy.stats import chi2, norm

from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.design import Allocation, kappa, make_design
from uavctl.smpc.hahn_stursberg.exact import optimal_cost
from uavctl.smpc.sets import Polytope

START = np.array([35.0, -2.0, -20.0, -4.0])


@pytest.mark.parametrize("gamma", [0.6, 0.9, 0.985])
def test_the_ellipsoid_holds_the_whole_likelihood(gamma: float) -> None:
    assert chi2.cdf(kappa(gamma, 4, 8, "ellipsoid") ** 2, 4) == pytest.approx(gamma)


@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.99])
def test_half_spaces_hold_for_any_correlation(correlation: float) -> None:
    """Boole: at most the sum of the single risks is lost, and they add up to 1 - gamma."""
    gamma, rows = 0.9, 4
    factor = kappa(gamma, 2, rows, "halfspace")
    assert rows * norm.sf(factor) == pytest.approx(1.0 - gamma)
    rng = np.random.default_rng(7)
    x = rng.multivariate_normal(np.zeros(2), [[1.0, correlation], [correlation, 1.0]], 100_000)
    inside = float(np.mean(np.all(np.abs(x) <= factor, axis=1)))
    assert inside >= gamma - 3.0 * np.sqrt(gamma * (1.0 - gamma) / len(x))


def test_the_ellipsoid_costs_more_than_half_spaces() -> None:
    """Each allocation with the printed schedule, from the printed state."""
    delays = make_design(spec("paper")).schedule.delays
    made = [make_design(spec("paper", rule="fixed", delays=delays, allocation=name)) for name in get_args(Allocation)]
    assert [design.kappa_x_terminal for design in made] == pytest.approx([3.2306, 2.6347], abs=1e-4)
    assert [optimal_cost(design, START) for design in made] == pytest.approx([61669.93, 59952.53], abs=0.01)


def test_half_spaces_fit_where_the_ellipsoid_does_not() -> None:
    tight = Polytope.from_box([-30.0, -5.0, -25.0, -5.0], [50.0, 5.0, 20.0, 5.0])  # room for 3 deviations of velocity
    make_design(spec("paper", state_set=tight, allocation="halfspace"))
    with pytest.raises(DesignError, match=r"Assumption 4\.3"):
        make_design(spec("paper", state_set=tight))
