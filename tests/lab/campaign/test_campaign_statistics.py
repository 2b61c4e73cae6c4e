"""Intervals against independent calculations and against what they promise; figures of a folder by hand."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow as pa
import pytest
from campaign_results import STEPS, cell, put, runs, summarise, write
from scipy.optimize import brentq
from scipy.stats import binom

from logs.report.run_statistics import (
    MAX_BOOTSTRAP_VALUES,
    bootstrap_mean,
    clopper_pearson,
    max_step_rate,
    paired_difference,
    step_rate,
)
from uavctl.errors import UavctlError, UsageError
from uavctl.lab.campaign.results import (
    SCHEMA,
    LinearCampaignRecord,
    compute_difference,
    read_cells,
    read_document,
    read_results,
)


@pytest.mark.parametrize(("hits", "trials"), [(1, 10), (3, 7), (50, 200), (199, 200), (2, 200_000)])
def test_the_exact_interval_leaves_the_binomial_tails(hits: int, trials: int) -> None:
    # The definition: at the lower end `hits` or more, at the upper end `hits` or fewer, have a probability of 2.5 %.
    low = brentq(lambda p: binom.sf(hits - 1, trials, p) - 0.025, 1e-12, 1.0 - 1e-12, xtol=1e-15)
    high = brentq(lambda p: binom.cdf(hits, trials, p) - 0.025, 1e-12, 1.0 - 1e-12, xtol=1e-15)
    assert clopper_pearson(hits, trials) == pytest.approx((low, high), rel=1e-9)


def test_the_exact_interval_of_none_and_of_all_in_closed_form() -> None:
    edge = 1.0 - 0.005 ** (1 / 40)  # (1 - p)^40 = 0.5 %
    assert clopper_pearson(0, 40, 0.99) == pytest.approx((0.0, edge))
    assert clopper_pearson(40, 40, 0.99) == pytest.approx((1.0 - edge, 1.0))


@pytest.mark.parametrize("share", [0.002, 0.05, 0.37])
def test_the_exact_interval_covers_at_least_as_often_as_it_says(share: float) -> None:
    # Summed over all outcomes, not drawn: the coverage itself. Exact intervals are cautious, but not by everything.
    trials = 150
    ends = np.array([clopper_pearson(hits, trials) for hits in range(trials + 1)])
    covers = (ends[:, 0] <= share) & (share <= ends[:, 1])
    coverage = binom.pmf(np.arange(trials + 1), trials, share)[covers].sum()
    assert 0.95 <= coverage <= 0.9999


@pytest.mark.parametrize(("hits", "trials"), [(0, 0), (3, 2), (-1, 5)])
def test_a_share_of_nothing_is_refused(hits: int, trials: int) -> None:
    with pytest.raises(UsageError, match="no share"):
        clopper_pearson(hits, trials)


@pytest.mark.slow
def test_the_bootstrap_covers_the_mean_of_skewed_costs_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(11)
    trials = 400
    draws = rng.exponential(3.0, (trials, 120))
    covered = sum(low <= 3.0 <= high for low, high in map(bootstrap_mean, draws))
    # Percentiles of a skewed sample fall short by about 1 %; 3 standard errors of 400 trials are 3.5 %.
    assert 0.90 <= covered / trials <= 0.985


def test_the_bootstrap_is_the_normal_interval_where_there_are_many_values() -> None:
    # Drawn by hand on both sides of the border: the same figure by either way, to a twentieth of its width.
    values = np.random.default_rng(5).exponential(2.0, MAX_BOOTSTRAP_VALUES)
    resampled = bootstrap_mean(values)
    reach = 1.959963984540054 * values.std(ddof=1) / len(values) ** 0.5
    assert resampled == pytest.approx((values.mean() - reach, values.mean() + reach), abs=0.1 * reach)
    normal = bootstrap_mean(np.append(values, values.mean()))
    assert normal == pytest.approx(resampled, abs=0.1 * reach)


def test_the_bootstrap_gives_the_same_for_a_seed_and_takes_200_000_values() -> None:
    values = np.random.default_rng(1).normal(size=300)
    assert bootstrap_mean(values, seed=4) == bootstrap_mean(values, seed=4) != bootstrap_mean(values, seed=5)
    low, high = bootstrap_mean(np.arange(200_000.0))
    assert (low + high) / 2 == pytest.approx(99_999.5)
    assert high - low == pytest.approx(2 * 1.96 * 200_000 / 12**0.5 / 200_000**0.5, rel=1e-3)


def test_one_value_is_its_own_interval_and_none_has_none() -> None:
    assert bootstrap_mean(np.array([3.0])) == (3.0, 3.0)
    with pytest.raises(UsageError, match="no values"):
        bootstrap_mean(np.empty(0))


def test_pairs_show_a_difference_that_separate_costs_hide() -> None:
    rng = np.random.default_rng(2)
    shared = rng.normal(1000.0, 200.0, 400)
    a, b = shared + rng.normal(0.0, 1.0, 400), shared + 2.0 + rng.normal(0.0, 1.0, 400)
    difference = paired_difference(a, b)
    assert difference.sign == -1
    assert difference.mean == pytest.approx(a.mean() - b.mean())
    assert difference.high - difference.low < 0.02 * (bootstrap_mean(a)[1] - bootstrap_mean(a)[0])
    assert paired_difference(a, a).sign == 0


def test_pairs_need_partners() -> None:
    with pytest.raises(UsageError, match="paired"):
        paired_difference(np.ones(3), np.ones(4))


def test_a_rate_that_was_zero_may_be_as_large_as_the_share_of_runs_may_be() -> None:
    rate, ends = step_rate(np.zeros(200), STEPS)
    assert rate == 0.0
    assert ends == clopper_pearson(0, 200)


def test_few_runs_with_violations_are_counted_exactly() -> None:
    hits = np.zeros(200)
    hits[:4] = [1, 2, 3, 4]
    rate, (low, high) = step_rate(hits, STEPS)
    exact = clopper_pearson(4, 200)
    assert rate == pytest.approx(10 / (200 * STEPS))
    assert (low, high) == pytest.approx((exact[0] * 2.5 / STEPS, exact[1] * 2.5 / STEPS))


def test_steps_of_a_run_that_come_together_do_not_make_the_interval_narrow() -> None:
    # 30 of 300 runs are outside in all their steps: the steps are 30 observations, not 1500.
    hits = np.zeros(300)
    hits[:30] = STEPS
    _, (low, high) = step_rate(hits, STEPS)
    steps = clopper_pearson(30 * STEPS, 300 * STEPS)
    assert high - low > 5 * (steps[1] - steps[0])
    assert low < clopper_pearson(30, 300)[0] * 1.1


def test_the_worst_step_s_interval_goes_for_all_steps_at_once() -> None:
    """It misses a rate that all steps have in at most 5 % of all campaigns; the step's own interval does in many."""
    rng, missed, separate_misses = np.random.default_rng(4), 0, 0
    for _ in range(400):
        hits = rng.binomial(300, 0.05, 40)
        rate, (low, high) = max_step_rate(hits, 300, 40)
        assert rate == hits.max() / 300 and low <= rate <= high
        missed += low > 0.05
        separate_misses += clopper_pearson(int(hits.max()), 300)[0] > 0.05
    assert missed <= 0.05 * 400 < 100 < separate_misses


def test_the_worst_step_is_that_of_all_runs_together(tmp_path: Path) -> None:
    rows = runs(0, [1.0, 2.0, 3.0, 4.0], state_violations=[2, 1, 0, 1], outside=[[0, 1, 1], [0, 1], [], [1]])
    (one,) = summarise(write(tmp_path, [cell(0, "smpc", "smpc")], rows))
    assert one.worst_step_rate == 0.5
    assert one.worst_step_ci == pytest.approx(clopper_pearson(2, 4, 1.0 - 0.05 / STEPS))


def test_settled_steps_are_those_of_the_second_half(tmp_path: Path) -> None:
    early, late = [1] * (STEPS // 2), [0] * (STEPS // 2) + [1, 1, 0, 1]
    rows = runs(0, [1.0] * 4, state_violations=[STEPS // 2, 3, 0, 0], outside=[early, late, [], []])
    (one,) = summarise(write(tmp_path, [cell(0, "smpc", "smpc")], rows))
    assert one.settled_violation_rate == pytest.approx(3 / (4 * STEPS // 2))


def test_results_of_a_small_folder(tmp_path: Path) -> None:
    nan = float("nan")
    folder = write(
        tmp_path,
        [cell(0, "smpc", "smpc"), cell(1, "lqg"), cell(2, "small", "smpc", refused="no horizon is short enough")],
        [
            *runs(0, [10.0, 20.0, nan, 30.0], state_violations=[0, 5, 0, 0], fallbacks=[1, 0, 0, 2],
                  ages=[[50], [48, 1, 1], [], [49, 0, 0, 1]], largest_gap=[1e-5, 3e-4, nan, 0.0]),
            *runs(1, [1.0, 2.0, 3.0, 4.0], input_violations=[25, 25, 25, 25]),
        ],
    )  # fmt: skip
    smpc, lqg, refused = summarise(folder)
    assert (smpc.runs, smpc.failed, smpc.cost, smpc.fallbacks, smpc.max_age) == (4, 1, 20.0, 3, 3)
    assert smpc.ages == [147, 1, 1, 1]
    assert smpc.mean_age == pytest.approx((1 + 2 + 3) / 150)
    assert smpc.violation_rate == pytest.approx(5 / 150)
    assert smpc.run_violation_rate == pytest.approx(1 / 3)
    assert smpc.run_violation_ci == pytest.approx(clopper_pearson(1, 3))
    assert smpc.largest_gap == 3e-4
    assert (lqg.cost, lqg.input_violation_rate, lqg.promised_x) == (2.5, 0.5, None)
    assert (refused.runs, refused.cost, refused.violation_ci, refused.refused) == (
        0,
        None,
        None,
        "no horizon is short enough",
    )
    assert msgspec.json.decode(msgspec.json.encode([smpc, lqg, refused]))[0]["cost_ci"] == list(smpc.cost_ci or ())


def test_differences_are_over_the_runs_that_both_ended(tmp_path: Path) -> None:
    nan = float("nan")
    rows = [*runs(0, [10.0, nan, 30.0, 40.0]), *runs(1, [1.0, 2.0, nan, 4.0])]
    difference = read_results(write(tmp_path, [cell(0, "a"), cell(1, "b"), cell(2, "c")], rows))
    both = compute_difference(difference.runs[0], difference.runs[1], "cost")
    assert both is not None
    assert both.runs == 2
    assert both.mean == pytest.approx((9 + 36) / 2)
    assert difference.runs[0].failed == ((1, "it broke"),)
    assert compute_difference(difference.runs[0], difference.runs[2], "cost") is None


def test_a_folder_without_a_campaign_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UavctlError, match="holds no campaign"):
        summarise(tmp_path)
    write(tmp_path, [cell(0, "a")], runs(0, [1.0]))
    (path,) = (tmp_path / "runs.parquet").iterdir()
    path.write_bytes(b"torn")
    with pytest.raises(UavctlError, match=rf"{path.name} is damaged.*remove it and continue with --resume"):
        summarise(tmp_path)


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"ages": [[1] * 100_000]}, "unpacks to more"),
        ({"cost": ["much"]}, "is damaged"),
        ({"run": [None], "ages": [None]}, "is damaged"),
        ({}, "lacks a column"),
    ],
)
@pytest.mark.fault(96)
def test_a_table_that_no_campaign_writes_is_refused(
    columns: dict[str, Any], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("uavctl.lab.campaign.results._FREE_CELL_BYTES", 2**15)
    write(tmp_path, [cell(0, "a"), cell(1, "b")], runs(0, [1.0]))
    table = {name: [value] for name, value in runs(1, [1.0])[0].items()} if columns else {"cell": [1]}
    put(tmp_path, 1, pa.Table.from_pydict(table | columns))
    with pytest.raises(UavctlError, match=rf"00001-00000000\.parquet.*{words}"):
        summarise(tmp_path)


@pytest.mark.parametrize("text", [b'{"more":' + b"[" * 100_000, b'{"more":' + b"[" * 100_000 + b"]" * 100_000 + b"}"])
def test_a_document_that_nests_without_end_is_refused(text: bytes, tmp_path: Path) -> None:
    (tmp_path / "campaign.json").write_bytes(text)
    with pytest.raises(UavctlError, match="holds no campaign"):
        summarise(tmp_path)


def test_a_cell_may_have_several_files(tmp_path: Path) -> None:
    rows = [row for index in range(3) for row in runs(index, [float(10 * index + run) for run in range(5)])]
    cells = [cell(index, str(index)) for index in range(4)]
    whole = read_results(write(tmp_path / "whole", cells, rows))
    write(tmp_path / "cut", cells, rows)
    for index in range(3):
        part = [row for row in rows if row["cell"] == index]
        put(tmp_path / "cut", index, pa.Table.from_pylist(part[:2], schema=SCHEMA))
        put(tmp_path / "cut", index, pa.Table.from_pylist(part[2:], schema=SCHEMA), first=2)
    cut = read_results(tmp_path / "cut")
    for index in range(4):
        assert cut.runs[index]["cost"].tolist() == whole.runs[index]["cost"].tolist()
        assert cut.runs[index].index.tolist() == list(range(5 if index < 3 else 0))


def test_the_rows_of_one_cell_are_in_memory_at_a_time(tmp_path: Path) -> None:
    def peak_bytes(cells: int) -> int:
        rows = [row for index in range(cells) for row in runs(index, [1.0] * 2, ages=[[1] * 20_000] * 2)]
        folder = write(tmp_path / str(cells), [cell(index, "a") for index in range(cells)], rows)
        gc.collect()  # tables of other tests, freed meanwhile, would count as negative
        before = pa.total_allocated_bytes()
        sizes: list[int] = []
        document = read_document(folder, LinearCampaignRecord)
        read_cells(
            folder,
            document.cells,
            SCHEMA,
            lambda rows, _: sizes.append(pa.total_allocated_bytes() - before + rows.num_rows),
        )
        return max(sizes)

    assert peak_bytes(20) < 3 * peak_bytes(2)
