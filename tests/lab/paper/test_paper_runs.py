"""Runs and figures of `uavctl paper`, against flights and sums made here."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.lab.campaign.arrivals import compute_newest_captures
from uavctl.lab.campaign.draws import draw
from uavctl.lab.campaign.world import LinearWorld, Trajectories, simulate
from uavctl.lab.paper import runs as run
from uavctl.lab.paper.claims import (
    PRINTED,
    SMALLEST_TAU,
    VARIANTS,
    Claim,
    VariantResult,
    assess,
    compute_age_distribution,
    make_claims,
)
from uavctl.lab.paper.runs import (
    Chunk,
    ChunkRunner,
    Moments,
    Setup,
    TerminalCheckDecider,
    add_totals,
    compute_totals,
    fly_all,
    is_in_ellipsoid,
)
from uavctl.smpc.batch import BatchSmpc, Decisions
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutDecider, ShortcutSolver
from uavctl.wiring.controller import build_design, build_plant, make_start_state

RUNS, STEPS, SEED = 10, 50, 3


@pytest.fixture(scope="module")
def setup() -> Setup:
    config = load_config("paper", PRINTED.overrides)
    design = build_design(config)
    return Setup(config, design)


def fly_directly(setup: Setup, *, sequential: bool) -> tuple[Trajectories, BatchSmpc]:
    """The same runs with nothing of this command in between."""
    design, plant = setup.design, build_plant(setup.config)
    chances = draw(SEED, 0, RUNS, STEPS, plant.n_w)
    scene = LinearWorld(
        plant, design.state_set, design.input_set, design.q_x, design.q_u, np.zeros(4), np.zeros(2),
        np.tile([35.0, -2.0, -20.0, -4.0], (RUNS, 1)),
    )  # fmt: skip
    solver = ShortcutSolver(design, sequential=sequential)
    smpc = BatchSmpc(ShortcutDecider(solver, np.zeros(4)), plant, 12, 0, 0.5)
    w = chances.normal * np.sqrt(0.6)
    return simulate(scene, smpc, compute_newest_captures(setup.config.link, 1.0, chances.link), w), smpc


@pytest.fixture(scope="module")
def directly(setup: Setup) -> tuple[Trajectories, BatchSmpc]:
    return fly_directly(setup, sequential=True)


@pytest.fixture(scope="module")
def result(setup: Setup) -> VariantResult:
    (flights,) = fly_all([setup], RUNS, STEPS, SEED, 1, lambda _: None)
    return assess(setup, PRINTED.note, flights, SEED)


def test_figures_are_those_of_the_runs(result: VariantResult, directly: tuple[Trajectories, BatchSmpc]) -> None:
    flown, smpc = directly
    cost, settled = flown.cost.sum(axis=1), flown.states[:, STEPS // 2 :].reshape(-1, 4)
    assert result.mean_cost == pytest.approx(cost.mean(), rel=1e-12)
    assert result.cost_stderr == pytest.approx(cost.std(ddof=1) / np.sqrt(RUNS), rel=1e-9)
    assert result.settled_std == pytest.approx(settled.std(axis=0), rel=1e-9)
    assert result.settled_cost == pytest.approx(flown.cost[:, STEPS // 2 :].mean() / 2, rel=1e-12)
    assert (result.runs, result.steps, result.tau, result.delays) == (RUNS, STEPS, 4, [5] * 12)
    assert result.decisions == smpc.tally.decisions.sum() == (flown.age == 0).sum()
    assert result.infeasible == result.slack_used == result.fallbacks == result.failed == 0
    assert result.state_violations == flown.state_violated.sum()
    assert result.input_violations == flown.input_violated.sum() == 0
    assert result.max_age == flown.age.max()
    assert result.age_distribution == pytest.approx(np.bincount(flown.age.ravel()) / flown.age.size)
    assert sum(result.age_distribution) == pytest.approx(1.0)
    aged = (flown.age[:, 1:] > 0).mean(axis=0)
    assert result.aged_share == pytest.approx([aged.mean(), aged.min(), aged.max()])
    low, high = np.array([-30, -8, -25, -8]), np.array([50, 7, 20, 8])
    room = np.stack([high - flown.states[:, 1:].max((0, 1)), flown.states[:, 1:].min((0, 1)) - low], axis=1)
    assert result.closest == pytest.approx(room.ravel())


def test_runs_are_those_of_the_exact_program(setup: Setup, directly: tuple[Trajectories, BatchSmpc]) -> None:
    """To the accuracy of the exact program: its gap of 1e-8 leaves a few 1e-6 in the states."""
    sequential, exact = directly[0], fly_directly(setup, sequential=False)[0]
    assert sequential.states == pytest.approx(exact.states, abs=1e-4)
    assert sequential.cost.sum(axis=1) == pytest.approx(exact.cost.sum(axis=1), rel=1e-8)
    np.testing.assert_array_equal(sequential.age, exact.age)


def test_chunks_change_nothing(setup: Setup, result: VariantResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "CHUNK", 7)
    progress: list[int] = []
    (flights,) = fly_all([setup], RUNS, STEPS, SEED, 1, progress.append)
    repeated = assess(setup, PRINTED.note, flights, SEED)
    assert progress == [7, 3]
    assert flights.drawn.shape == (RUNS, STEPS + 1, 4)
    for name in ("decisions", "state_violations", "max_age", "age_distribution", "aged_share", "runs_outside"):
        assert getattr(repeated, name) == getattr(result, name)
    assert repeated.closest == pytest.approx(result.closest, abs=1e-9)
    assert repeated.neighbourhood.area_ratio == pytest.approx(result.neighbourhood.area_ratio, rel=1e-9)
    assert repeated.mean_cost == pytest.approx(result.mean_cost, rel=1e-12)
    assert repeated.cost_stderr == pytest.approx(result.cost_stderr, rel=1e-9)


@pytest.mark.slow
def test_workers_change_nothing(setup: Setup, result: VariantResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "MAX_LOCAL_RUNS", 0)
    monkeypatch.setattr(run, "CHUNK", 8)
    one, two = (fly_all([setup], RUNS, STEPS, SEED, workers, lambda _: None)[0] for workers in (1, 2))
    assert vars(one.totals).keys() == vars(two.totals).keys()
    for name, value in vars(one.totals).items():
        other = getattr(two.totals, name)
        assert np.array_equal(value, other) if isinstance(value, np.ndarray) else value == other
    assert np.array_equal(one.drawn, two.drawn)
    assert one.totals.cost.mean == pytest.approx(result.mean_cost, rel=1e-12)
    assert one.totals.decisions == result.decisions


def test_longer_campaigns_begin_with_the_same_runs(setup: Setup) -> None:
    pilot = ChunkRunner(setup)
    first_runs, more = pilot.fly(SEED, 0, 3, STEPS), pilot.fly(SEED, 2, 4, STEPS)
    assert first_runs.trajectories.states[2] == pytest.approx(more.trajectories.states[0], abs=1e-9)


def test_the_start_is_the_printed_one(setup: Setup) -> None:
    assert make_start_state(setup.config, setup.design.plant).tolist() == [35.0, -2.0, -20.0, -4.0]


def test_moments_of_parts_are_those_of_all() -> None:
    values = np.random.default_rng(0).normal(5e4, 3.0, 1000)
    parts = [Moments.compute(part) for part in np.split(values, [1, 10, 400])]
    total = parts[0] + parts[1] + parts[2] + parts[3]
    assert total.count == 1000
    assert total.mean == pytest.approx(values.mean(), rel=1e-14)
    assert total.stderr == pytest.approx(values.std(ddof=1) / np.sqrt(1000), rel=1e-9)
    assert Moments.compute(values[:1]).stderr == np.inf


def test_the_ellipsoid_holds_its_share_of_what_it_is_made_for(setup: Setup) -> None:
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(4), setup.design.terminal.sigma_x, 40_000)
    assert is_in_ellipsoid(draws, setup.design).mean() == pytest.approx(0.95, abs=0.004)  # 3.7 standard errors


def make_chunk(states: Array, ages: NDArray[np.intp]) -> Chunk:
    """Runs along given states."""
    runs, steps = ages.shape
    flat, flags = np.zeros((runs, steps, 2)), np.zeros((runs, steps), dtype=bool)
    flags[0, 1:] = True
    flown = Trajectories(states, flat, flat, ages, np.ones((runs, steps)), flags, flags.copy(), ("",) * runs)
    return Chunk(flown, decisions=3, infeasible=0, slack_used=1, missed=2, fallbacks=0, largest_gap=0.5)


def test_totals_of_made_up_runs(setup: Setup) -> None:
    states = np.full((2, 5, 4), 100.0)
    states[0, 2:] = 0.0  # the first run arrives in step 2, the second never
    total = add_totals([compute_totals(make_chunk(states, np.array([[0, 1, 0, 1], [0, 1, 2, 3]])), setup.design)] * 2)
    assert total.arrived.tolist() == [0, 0, 2, 0, 0, 2]
    assert (total.ended_inside, total.settled_inside, total.settled) == (2, 6, 12)
    assert total.outside.tolist() == [0, 2, 2, 2]
    assert (total.runs_outside, total.runs_asking, total.decisions, total.slack_used, total.missed) == (2, 2, 6, 2, 4)
    assert total.ages[3].tolist() == [0, 2, 0, 2]
    assert compute_age_distribution(total) == [0.375, 0.375, 0.125, 0.125]
    # Beyond the upper limits by 100 - limit; from the lower ones, the nearest was the origin.
    assert total.closest.tolist() == [50.0, -30.0, 93.0, -8.0, 80.0, -25.0, 92.0, -8.0]
    assert total.largest_gap == 0.5


def test_plans_that_end_elsewhere_are_counted(setup: Setup) -> None:
    design = setup.design
    inner = ShortcutDecider(ShortcutSolver(design), design.target)

    class Astray:
        """Adds a push in the last input of one plan, and gives up another one."""

        def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:
            plans = inner.decide(x, late, cov)
            plans.inputs[0, -1, 1] += 1e-3
            plans.inputs[1, -1, 1] += 1e-3
            plans.solved[1] = False
            return plans

    x = np.array([[1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], [35.0, -2.0, -20.0, -4.0]])
    for decider, missed in ((inner, 0), (Astray(), 1)):
        watched = TerminalCheckDecider(decider, design)
        watched.decide(x, 0)
        assert watched.missed_target == missed


def by_key(claims: list[Claim]) -> dict[str, Claim]:
    return {claim.key: claim for claim in claims}


def test_claims_hold_or_not_by_what_was_measured(result: VariantResult) -> None:
    def holds(**changes: object) -> dict[str, bool | None]:
        claims = make_claims(replace(result, **changes), 0.3, 12, 0.95, 0.9)
        return {key: claim.holds for key, claim in by_key(claims).items()}

    as_flown = holds()
    assert as_flown["slack"] and as_flown["box"] and as_flown["neighbourhood"] and as_flown["worst-case"]
    assert as_flown["aged"] is False  # 30 % by p = 0.7, not 40 %
    assert as_flown["delta-tau"] is False  # 99.76 % with τ = 4
    assert holds(tau=3)["delta-tau"] is True
    assert holds(slack_used=1)["slack"] is False
    assert holds(infeasible=1)["slack"] is False
    assert holds(missed_target=1)["terminal"] is False
    assert holds(state_violations=1)["box"] is False
    assert holds(input_violations=1)["inputs"] is False
    assert holds(state_violation_worst_step=0.051)["likelihood"] is False
    assert holds(fallbacks=1)["planned"] is False
    ages = [1.0 - 1.0 / (RUNS * result.steps), *[0.0] * 11, 1.0 / (RUNS * result.steps)]
    assert holds(fallbacks=1, age_distribution=ages)["planned"] is True
    assert holds(fallbacks=2, age_distribution=ages)["planned"] is False
    assert holds(max_age=4)["oldest"] is False
    assert holds(settled_trend=4.0, settled_trend_stderr=1.0)["stable"] is False
    far = replace(result.neighbourhood, arrived=RUNS - 1)
    assert holds(neighbourhood=far)["converge"] is False
    wide = replace(result.neighbourhood, area_ratio=[0.1, 0.6])
    assert holds(neighbourhood=wide)["neighbourhood"] is holds(neighbourhood=wide)["worst-case"] is False


def test_the_worst_case_is_worse_on_the_same_runs(result: VariantResult) -> None:
    worst = result.worst_case
    assert (worst.runs, worst.delay) == (RUNS, 4)
    assert worst.mean_cost > result.mean_cost + 5 * result.cost_stderr
    assert worst.settled_cost > 5 * result.settled_cost
    assert min(worst.area_ratio) > 2 * max(result.neighbourhood.area_ratio)


def test_lqg_breaks_the_input_limits_as_often_as_its_inputs_spread(result: VariantResult) -> None:
    # 7.4 % over a million steps; the standard error of so few runs is about one point.
    assert 0.03 < result.lqg_asking < 0.12
    assert result.lqg_bound == pytest.approx(10.667, abs=1e-3)


def test_variants_are_designs_that_the_tool_accepts() -> None:
    assert (PRINTED, SMALLEST_TAU) == VARIANTS
    for variant in VARIANTS:
        design = build_design(load_config("paper", variant.overrides))
        assert design.terminal.tau == variant.tau
        assert set(design.schedule.delays) == {variant.tau + 1}
