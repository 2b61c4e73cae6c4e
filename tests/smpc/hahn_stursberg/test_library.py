"""Making a library: the same bytes every time, within its region, for the design that it is made for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import optimisation_cases as cases
import pytest
from library_rig import PRESETS, bounds, case, small

from uavctl.errors import DesignError
from uavctl.records import SolveStatus
from uavctl.smpc.hahn_stursberg import library as maker
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.smpc.hahn_stursberg.horizon import decompose
from uavctl.smpc.hahn_stursberg.library import Library, LibrarySolver, Region, make_library
from uavctl.smpc.sets import Polytope


def content(library: Library) -> list[bytes]:
    return [
        array.tobytes()
        for parts in library.variants
        for part in parts
        for array in (part.theta, part.level, part.slope)
    ]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five policies for a late position do for how a library is made."""
    monkeypatch.setattr(maker, "MOST_LATE", 5)


@pytest.mark.slow
@pytest.mark.usefixtures("few")
def test_the_same_design_and_seed_give_the_same_bytes_and_another_seed_others() -> None:
    design = small(late=1)
    first, again, other = (
        make_library(one, seed, most=8) for one, seed in ((design, 3), (small(late=1), 3), (design, 4))
    )
    assert content(first) == content(again)
    assert content(first) != content(other)
    assert first.design_id == design.design_id


@pytest.mark.slow
@pytest.mark.usefixtures("few")
def test_there_is_a_library_for_every_age_and_component_and_progress_is_told() -> None:
    design = small(late=2)
    heard: list[tuple[str, int, float]] = []
    library = make_library(design, advance=lambda name, count, worst: heard.append((name, count, worst)), most=8)
    assert [len(parts) for parts in library.variants] == [1, 1, 1]
    assert [part.theta.shape[0] for parts in library.variants for part in parts] == [8, 5, 5]
    names = list(dict.fromkeys(name for name, _, _ in heard))
    assert names == ["component 0", "component 0, 1 late", "component 0, 2 late"]
    for name, most in zip(names, (8, 5, 5), strict=True):
        counts = [count for told, count, _ in heard if told == name]
        assert counts == sorted(counts)
        assert counts[-1] == most
    assert max(worst for _, _, worst in heard) > 1e-4


def test_a_design_without_any_policy_is_refused() -> None:
    design = small()
    less = {name: 0.5 * getattr(design.terminal, name) for name in ("sigma_xi", "sigma_z")}
    terminal = replace(design.terminal, **less)
    with pytest.raises(DesignError, match="no policy"):
        make_library(replace(design, terminal=terminal))


@pytest.mark.parametrize("name", PRESETS)
def test_the_first_policy_is_the_cheapest_and_every_cut_is_finite(name: str) -> None:
    one = case(name)
    for policies in one.policies:
        costs = np.array([policy.cost for policy in policies])
        assert costs.argmin() == 0
        assert len({policy.theta.tobytes() for policy in policies}) == len(policies)
        for policy in policies:
            assert np.isfinite(policy.level)
            assert np.all(policy.slope >= 0.0)
            # Its cut is below every policy's cost, and touches its own.
            cuts = [policy.level - policy.slope @ other.backoff for other in policies]
            assert np.all(np.array(cuts) <= costs * (1.0 + 1e-7))
            assert policy.level - policy.slope @ policy.backoff == pytest.approx(policy.cost, rel=1e-4)


@pytest.mark.parametrize("name", PRESETS)
def test_a_library_of_another_design_is_refused(name: str) -> None:
    one, other = case(name), small()
    with pytest.raises(DesignError, match=other.design_id):
        LibrarySolver(other, one.library)
    with pytest.raises(DesignError, match="not of"):
        LibrarySolver(one.design, replace(one.library, design_id="0" * 16))


@pytest.mark.parametrize("name", PRESETS)
def test_states_are_drawn_all_over_the_box_and_around_the_target(name: str) -> None:
    design = case(name).design
    lower, upper = bounds(design)
    rng = np.random.default_rng(5)
    for part in decompose(design):
        region = Region(design, part)
        drawn = [region.draw(rng) for _ in range(400)]
        states, targets = (np.array(values) for values in zip(*drawn, strict=True))
        share = (states - lower[part.states]) / (upper - lower)[part.states]
        in_box = np.all((share >= 0.0) & (share <= 1.0), axis=1)
        assert in_box.mean() > 0.7
        deciles = np.histogram(share[in_box][:, 0], bins=10, range=(0.0, 1.0))[0]
        assert deciles.min() > 8
        home = np.all(targets == design.target[part.states], axis=1)
        assert 0.3 < home.mean() < 0.7
        for target in targets:  # places to rest
            assert part.a @ target + part.b @ part.u_eq @ part.coordinates @ target == pytest.approx(target, abs=1e-9)
            assert np.all(target >= lower[part.states] - 1e-9)
            assert np.all(target <= upper[part.states] + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "design",
    [
        cases.paper(plant=cases.paper_plant(w=np.zeros((2, 2)))),
        cases.paper(plant=cases.paper_plant(w=np.diag([0.6, 0.0]))),
        cases.paper(state_set=Polytope.from_box([-np.inf, -20.0, -40.0, -20.0], [50.0, 7.0, 40.0, np.inf])),
        cases.paper(input_set=Polytope.from_box([-np.inf, -7.5], [7.5, 7.5])),
        cases.coupled(),
    ],
    ids=["no disturbance", "one axis undisturbed", "open limits", "open input", "coupled"],
)
def test_unusual_designs_have_libraries_whose_certificates_hold(design: Design) -> None:
    solver, exact = LibrarySolver(design, make_library(design, most=12), exact=False), ConicSolver(design)
    rng, certified = np.random.default_rng(5), 0
    for _ in range(25):
        x = rng.uniform([-20.0, -5.0, -20.0, -5.0], [35.0, 5.0, 18.0, 5.0])
        answer, optimum = solver.solve(0, x, design.target), exact.solve(0, x, design.target)
        assert answer.status is SolveStatus.OPTIMAL
        size = max(1.0, abs(optimum.cost))
        assert answer.cost_lower <= optimum.cost + 1e-6 * size
        assert optimum.cost_lower <= answer.cost + 1e-6 * size
        assert not np.isnan(answer.gap)
        certified += answer.gap < 1e-2
    assert certified >= 5  # a dozen policies
