"""Risk allocation: quantiles against their definitions, and what each costs on the paper's example."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from design_rig import spec
from scipy.stats import chi2, norm

from uavctl.errors import DesignError
from uavctl.lab.compare_designs import RISK_OPTIONS, RiskComparison, RiskReport, compare_risk
from uavctl.smpc.hahn_stursberg.design import Allocation, component_kappa, kappa, make_design
from uavctl.smpc.sets import Polytope

START = np.array([35.0, -2.0, -20.0, -4.0])


def nothing(what: str) -> None:
    """No progress to be shown."""


@pytest.fixture(scope="module")
def paper() -> RiskComparison:
    return compare_risk(spec("paper"), START, 8, 1, nothing)


def by_name(found: RiskComparison) -> dict[str, RiskReport]:
    return {report.allocation: report for report in found.allocations}


@pytest.mark.parametrize("gamma", [0.6, 0.9, 0.95, 0.985])
@pytest.mark.parametrize("sizes", [(2,), (2, 2), (3, 3, 3), (1, 1, 1, 1)], ids=str)
def test_parts_that_are_all_inside_make_the_whole_likelihood(gamma: float, sizes: tuple[int, ...]) -> None:
    factor = component_kappa(gamma, sizes)
    assert np.prod([chi2.cdf(factor**2, size) for size in sizes]) == pytest.approx(gamma)


def test_parts_of_unequal_size_are_inside_with_at_least_the_likelihood() -> None:
    factor = component_kappa(0.95, (1, 3))
    assert chi2.cdf(factor**2, 1) * chi2.cdf(factor**2, 3) >= 0.95


@pytest.mark.parametrize("gamma", [0.6, 0.9, 0.985])
def test_one_part_is_the_ellipsoid_and_more_are_tighter(gamma: float) -> None:
    assert component_kappa(gamma, (4,)) == pytest.approx(kappa(gamma, 4, 8, "ellipsoid"))
    assert component_kappa(gamma, (2, 2)) < kappa(gamma, 4, 8, "ellipsoid")


@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.99])
def test_half_spaces_hold_whatever_the_correlation(correlation: float) -> None:
    """Boole: at most the sum of the single risks is lost, and they add up to 1 - gamma."""
    gamma, rows = 0.9, 4
    factor = kappa(gamma, 2, rows, "halfspace")
    assert rows * norm.sf(factor) == pytest.approx(1.0 - gamma)
    rng = np.random.default_rng(7)
    x = rng.multivariate_normal(np.zeros(2), [[1.0, correlation], [correlation, 1.0]], 100_000)
    inside = float(np.mean(np.all(np.abs(x) <= factor, axis=1)))
    assert inside >= gamma - 3.0 * np.sqrt(gamma * (1.0 - gamma) / len(x))


def test_the_ellipsoid_costs_the_most(paper: RiskComparison) -> None:
    reports = by_name(paper)
    assert tuple(reports) == (*get_args(Allocation), "component") == RISK_OPTIONS
    factors = [reports[name].kappa_x_terminal for name in ("halfspace", "component", "ellipsoid")]
    assert factors == pytest.approx([2.6347, 2.8550, 3.2306], abs=1e-4)
    costs = [reports[name].costs for name in ("halfspace", "component", "ellipsoid")]
    assert [each.start for each in costs if each] == pytest.approx([59952.53, 60348.48, 61669.93], abs=0.01)
    means = [each.mean for each in costs if each and each.mean]
    assert means == sorted(means) and len(means) == 3
    shares = [each.feasible for each in costs if each]
    assert shares == sorted(shares, reverse=True) and shares[-1] > 0.0
    assert 0 < paper.compared <= paper.states == 8


def test_backoffs_are_those_of_the_terminal_set(paper: RiskComparison) -> None:
    report = by_name(paper)["ellipsoid"]
    design = make_design(spec("paper"))
    figures = {check.item: check.value for check in design.assumptions}
    assert max(report.terminal_backoff_x) == pytest.approx(figures["4.3"])
    assert max(report.terminal_backoff_u) == pytest.approx(figures["4.4"])
    assert report.kappa_x == design.kappa_x[1:].tolist()
    assert report.kappa_u == design.kappa_u.tolist()
    # the same noise under each allocation: only κ differs
    other = by_name(paper)["component"]
    ratio = np.array(other.terminal_backoff_x) / np.array(report.terminal_backoff_x)
    assert other.kappa_x_terminal is not None and report.kappa_x_terminal is not None
    np.testing.assert_allclose(ratio, other.kappa_x_terminal / report.kappa_x_terminal)


def test_an_allocation_that_does_not_fit_is_told_beside_the_others() -> None:
    tight = Polytope.from_box([-30.0, -5.0, -25.0, -5.0], [50.0, 5.0, 20.0, 5.0])  # room for 3 deviations of velocity
    found = by_name(compare_risk(spec("paper", state_set=tight, allocation="halfspace"), START / 10, 1, 0, nothing))
    assert found["ellipsoid"].costs is None
    assert "Assumption 4.3 fails" in str(found["ellipsoid"].refused)
    for name in ("halfspace", "component"):
        assert found[name].refused is None
        assert found[name].costs is not None
    tighter = Polytope.from_box([-30.0, -4.5, -25.0, -4.5], [50.0, 4.5, 20.0, 4.5])
    found = by_name(compare_risk(spec("paper", state_set=tighter, allocation="halfspace"), START / 10, 1, 0, nothing))
    assert "Assumption 4.3 fails" in str(found["component"].refused)
    assert found["halfspace"].refused is None
    with pytest.raises(DesignError, match=r"Assumption 4\.3"):
        compare_risk(spec("paper", state_set=tight), START / 10, 1, 0, nothing)
