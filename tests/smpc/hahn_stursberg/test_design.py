"""Designs: figures of the presets, risk allocation, search, hash, and refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from design_rig import spec
from scipy.stats import chi2, norm

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg import design as design_module
from uavctl.smpc.hahn_stursberg.design import Design, design_record, kappa, make_design
from uavctl.smpc.link import bernoulli
from uavctl.smpc.sets import Polytope

STATES = np.array([[35.0, -2.0, -20.0, -4.0], [0.0, 0.0, 0.0, 0.0]])


def test_design_of_the_paper() -> None:
    design = make_design(spec("paper"))
    assert design.schedule.delays == (5,) * 12
    assert design.schedule.gamma_x[-1] == pytest.approx(0.9663177)
    assert design.kappa_x[1] == pytest.approx(np.sqrt(chi2.ppf(0.95, 4)))
    assert design.kappa_x[12] == pytest.approx(np.sqrt(chi2.ppf(0.95 / 0.99757**7, 4)))
    assert design.kappa_u[-1] == pytest.approx(np.sqrt(chi2.ppf(0.9 / 0.99757, 2)))
    # Assumption 4.3 and 4.4 with the stages' likelihoods: 16.41 of 20 m, 4.27 of 7.5
    assert design.kappa_x_terminal == design.kappa_x[12]
    assert design.kappa_u_terminal == design.kappa_u[-1]
    figures = {check.item: (check.value, check.limit) for check in design.assumptions}
    assert figures["4.1"] == pytest.approx((0.99757, 0.99))
    assert figures["4.2"] == pytest.approx((0.9714, 1.0), abs=5e-5)
    assert figures["4.3"] == pytest.approx((16.41, 20.0), abs=5e-3)
    assert figures["4.4"] == pytest.approx((4.267, 7.5), abs=5e-4)
    assert all(check.ok for check in design.assumptions)


def test_design_of_the_room_fits_around_its_target() -> None:
    design = make_design(spec("room-hahn-stursberg"))
    assert design.target.tolist() == [1.5, 0.0, 0.0, 1.0, 0.0, 0.0, -1.2, 0.0, 0.0]
    assert all(check.ok for check in design.assumptions)
    assert design.assumptions[0].value == pytest.approx(1.0 - 0.3 ** (design.terminal.tau + 1))
    # χ² with all nine states
    assert design.kappa_x_terminal == pytest.approx(np.sqrt(chi2.ppf(design.schedule.gamma_x[-1], 9)))


@pytest.mark.parametrize("gamma", [0.9, 0.95, 0.985])
def test_risk_allocation(gamma: float) -> None:
    assert kappa(gamma, 4, 8, "ellipsoid") ** 2 == pytest.approx(chi2.ppf(gamma, 4))
    assert kappa(gamma, 4, 8, "halfspace") == pytest.approx(norm.ppf(1.0 - (1.0 - gamma) / 8))
    assert kappa(gamma, 1, 1, "halfspace") == pytest.approx(norm.ppf(gamma))


def test_halfspaces_keep_the_likelihood_with_less() -> None:
    rng = np.random.default_rng(8)
    covariance = np.array([[2.0, 0.6], [0.6, 1.0]])
    box = Polytope.from_box([-1.0, -1.0], [1.0, 1.0])
    deviation = np.sqrt(np.einsum("ij,jk,ik->i", box.c, covariance, box.c))
    limit = kappa(0.95, 2, 4, "halfspace") * deviation
    samples = rng.multivariate_normal([0.0, 0.0], covariance, size=100_000)
    inside = np.mean(np.all(samples @ box.c.T <= limit, axis=1))
    assert 0.95 <= inside < 0.97
    assert np.all(limit < kappa(0.95, 2, 4, "ellipsoid") * deviation)


def test_halfspace_allocation_counts_the_rows_of_each_set() -> None:
    design = make_design(spec("paper", allocation="halfspace"))
    np.testing.assert_allclose(design.kappa_x[1:], norm.ppf(1.0 - (1.0 - design.schedule.gamma_x[1:]) / 8))
    np.testing.assert_allclose(design.kappa_u, norm.ppf(1.0 - (1.0 - design.schedule.gamma_u) / 4))


def test_greedy_rule_keeps_assumption_4() -> None:
    design = make_design(spec("paper", rule="greedy"))
    assert design.schedule.gamma_x[-1] == pytest.approx(0.97978, abs=5e-6)
    assert design.assumptions[2].value == pytest.approx(17.33, abs=5e-3)


def test_greedy_to_the_edge_of_the_likelihood_is_refused() -> None:
    with pytest.raises(DesignError, match=r"target\.position_m: Assumption 4\.3 fails.*limit 20"):
        make_design(spec("paper", rule="greedy", gamma_max=0.9999))


def test_the_id_follows_every_number() -> None:
    base = make_design(spec("paper"))
    assert make_design(spec("paper")).design_id == base.design_id
    assert len(base.design_id) == 16
    case = spec("paper")
    nudged = case.q_x.copy()
    nudged[0, 0] = np.nextafter(nudged[0, 0], 11.0)
    others: list[dict[str, Any]] = [
        {"q_x": nudged},
        {"slack_linear": 2e5},
        {"offset_weight": 5001.0},
        {"max_iterations": 99},
        {"delays": 6},
        {"target_m": (1.0, 0.0, 0.0)},
        {"allocation": "halfspace"},
        {"plant": replace(case.plant, accel_per_input=np.ones(2))},
        {"state_set": Polytope.from_box([-30.0, -8.0, -25.0, -8.0], [51.0, 7.0, 20.0, 8.0])},
    ]
    ids = {make_design(spec("paper", **changes)).design_id for changes in others}
    assert len(ids | {base.design_id}) == len(others) + 1


def test_search_takes_the_least_mean_cost() -> None:
    tried: list[tuple[int, ...]] = []

    def cost_of(design: Design, state: Array) -> float:
        tried.append(design.schedule.delays)
        # least for r̂ = (-1 -1 -1 -1 0 0 1 2), on the mean of two states that want different things
        expected = np.array([1, 2, 3, 4, 4, 5, 5, 5, 5, 5, 5, 5])
        return float(np.abs(np.array(design.schedule.delays) - expected).sum() + state[0])

    design = make_design(spec("paper", rule="search", search_states=STATES), cost_of)
    assert design.schedule.delays == (1, 2, 3, 4, 4, 5, 5, 5, 5, 5, 5, 5)
    assert len(set(tried)) == 38
    assert len(tried) == 2 * 38


def test_search_skips_a_schedule_that_is_infeasible_for_a_state() -> None:
    def cost_of(design: Design, state: Array) -> float | None:
        eager = design.schedule.delays[4] == 4
        if eager and state[0] == 35.0:
            return None
        return 1.0 if eager else 2.0 + float(sum(design.schedule.delays))

    design = make_design(spec("paper", rule="search", search_states=STATES), cost_of)
    assert design.schedule.delays[4] == 5


def test_search_needs_states_and_a_cost() -> None:
    with pytest.raises(DesignError, match=r"schedule\.search_states: rule `search` has no states"):
        make_design(spec("paper", rule="search"), lambda *_: 1.0)
    with pytest.raises(DesignError, match=r"schedule\.rule: rule `search` has no cost"):
        make_design(spec("paper", rule="search", search_states=STATES))


def test_search_without_a_candidate_gives_the_reason() -> None:
    with pytest.raises(DesignError, match=r"schedule\.rule: none of 38 nested schedules .* 0 fail .* 38 leave one of"):
        make_design(spec("paper", rule="search", search_states=STATES), lambda *_: None)
    with pytest.raises(DesignError, match=r"38 fail Assumption 4, 0 leave .*Assumption 4\.4 fails"):
        small = Polytope.from_box([-4.0, -4.0], [4.0, 4.0])
        make_design(spec("paper", rule="search", search_states=STATES, input_set=small), lambda *_: 1.0)


def test_search_over_too_many_schedules_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(design_module, "MAX_CANDIDATES", 37)
    with pytest.raises(DesignError, match=r"schedule\.rule: `search` has more than 37 nested schedules"):
        make_design(spec("paper", rule="search", search_states=STATES), lambda *_: 1.0)


@pytest.mark.parametrize(
    ("name", "changes", "key", "message"),
    [
        ("paper", {"tau": 12}, "smpc.tau", r"N = 0 free steps of the horizon H = 12.* takes 2"),
        ("paper", {"tau": 11}, "smpc.tau", r"N = 1 free steps"),
        ("room-hahn-stursberg", {"tau": 10}, "smpc.tau", r"N = 2 free steps .* takes 3"),
        ("paper", {"tau": 3, "delays": 5, "delta_tau": 0.995}, "smpc.delta_tau", r"Assumption 4\.1 fails.*0\.9919"),
        ("paper", {"target_m": (0.0, 4.0, 0.0)}, "target.position_m", r"Assumption 4\.3 fails.*16\.4076, limit 16"),
        (
            "room-hahn-stursberg",
            {"target_m": (1.5, 1.0, -0.1)},
            "target.position_m",
            r"Assumption 4\.3 fails.*limit 0\.1",
        ),
        ("paper", {"k_tau": -np.eye(2, 4)}, "smpc.k_tau", r"Assumption 4\.2"),
        ("paper", {"delta_x": 0.99}, "smpc.delta_x", r"0\.99 is out of reach.*0\.9831"),
        ("paper", {"link": bernoulli(np.array([0.4]))}, "smpc.delta_x", r"0\.95 is out of reach"),
        ("paper", {"delays": 3}, "schedule.delays", r"d_11 = 3 is below 4"),
    ],
)
def test_an_impossible_design_is_refused(name: str, changes: dict[str, Any], key: str, message: str) -> None:
    with pytest.raises(DesignError, match=message) as caught:
        make_design(spec(name, **changes))
    assert caught.value.key == key
    assert caught.value.hint
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_record_is_json_without_infinity(name: str) -> None:
    design = make_design(spec(name))
    record = json.loads(json.dumps(design_record(design), allow_nan=False))
    assert record["design_id"] == design.design_id
    assert record["tau"] == design.terminal.tau
    assert record["delays"] == list(design.schedule.delays)
    for key, expected in (
        ("alpha", design.schedule.alpha),
        ("gamma_x", design.schedule.gamma_x),
        ("gamma_u", design.schedule.gamma_u),
        ("a", design.plant.a),
        ("w", design.plant.w),
        ("c_x", design.state_set.c),
        ("sigma_x", design.terminal.sigma_x),
    ):
        assert np.array_equal(np.array(record[key]), expected)
    assert [row["item"] for row in record["assumptions"]] == ["4.1", "4.2", "4.3", "4.4", "4.5"]
    assert set(record["assumptions"][0]) == {"item", "ok", "value", "limit", "text"}
    assert record["spectral_radius"] == design.terminal.spectral_radius
    # 258.6 for each of the paper's two axes; the room's is the least that a static gain leaves.
    assert record["stationary_cost"] == pytest.approx({"paper": 517.2, "room-hahn-stursberg": 1.2721}[name], rel=5e-4)


def test_record_of_a_design_without_state_limits() -> None:
    free = Polytope.from_box([-np.inf] * 4, [np.inf] * 4)
    record = design_record(make_design(spec("paper", state_set=free)))
    text = json.dumps(record, allow_nan=False)
    assert json.loads(text)["assumptions"][2]["limit"] is None
