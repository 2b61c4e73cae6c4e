"""The page of a campaign says what its figures say, and holds for campaigns of any shape."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaign_results import cell, runs, summarise, write
from report_rig import omit_figures
from text_numbers import find_numbers

from logs.report.page import PageSection, render_page
from logs.report.run_statistics import PairedDifference
from logs.report.svg import Drawing
from uavctl.errors import UavctlError
from uavctl.lab.campaign.page import CampaignView, describe_outcome, write_report
from uavctl.lab.campaign.plots import ControllerStyles
from uavctl.lab.campaign.results import read_results
from uavctl.lab.campaign.verdicts import (
    CampaignVerdict,
    describe_briefly,
    describe_verdict,
    get_verdict_word,
    group_cells,
    make_verdicts,
)

N = 60
REFUSED = "tau: nothing is fast enough"
NOISE = np.random.default_rng(3).normal(0.0, 1.0, N)
SMPC = 100.0 + NOISE


class _Text(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        if tag not in ("meta", "br", "path", "use", "rect", "circle"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("path", "use", "rect", "circle"):
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text.append(data)


def text_of(path: Path) -> str:
    parser = _Text()
    parser.feed(path.read_text(encoding="utf-8"))
    assert parser.open == []
    return re.sub(r"\s+", " ", " ".join(parser.text))


def judged(tmp_path: Path, baseline: list[dict[str, Any]], smpc: list[dict[str, Any]] | None = None) -> CampaignVerdict:
    rows = [*(smpc or runs(0, SMPC.tolist())), *baseline]
    results = read_results(write(tmp_path, [cell(0, "ours", "smpc"), cell(1, "theirs")], rows))
    (verdict,) = make_verdicts(results, group_cells(summarise(tmp_path)))
    return verdict


def outside(steps: int) -> list[int]:
    return [steps] * N


def test_cheaper_and_as_safe_is_yes(tmp_path: Path) -> None:
    verdict = judged(tmp_path, runs(1, (SMPC * 1.1).tolist()))
    assert (verdict.is_unmatched, verdict.is_better_than_all, verdict.is_beaten, get_verdict_word(verdict)) == (
        True,
        True,
        False,
        "yes",
    )
    assert describe_briefly(verdict.comparisons[0]) == "costs 10 % more"
    (sentence,) = describe_verdict(verdict)
    assert "theirs (10 % more" in sentence  # among those that are beaten


def test_a_paired_difference_is_reported(tmp_path: Path) -> None:
    # Both costs lie within 99.7 to 100.3; the difference of 0.02 is the same in every run.
    verdict = judged(tmp_path, runs(1, (SMPC + 0.02).tolist()))
    assert verdict.is_unmatched


def test_a_cheaper_baseline_is_named_with_the_limits_that_it_breaks(tmp_path: Path) -> None:
    cheaper = runs(1, (SMPC * 0.97).tolist(), state_violations=outside(1), input_violations=outside(15))
    verdict = judged(tmp_path, cheaper)
    assert (verdict.is_unmatched, verdict.is_better_than_all, verdict.is_beaten, get_verdict_word(verdict)) == (
        True,
        False,
        False,
        "yes",
    )
    costs, limits = describe_briefly(verdict.comparisons[0]).split(", ")
    assert find_numbers(costs) == [3.0] and "less" in costs and "more often" in limits
    (sentence,) = describe_verdict(verdict)
    assert find_numbers(sentence)[-5:] == [2.0, 0.0, 30.0, 0.0, 10.0]  # states, SMPC's, inputs, SMPC's; allowed
    assert "inputs (10 %)" in sentence and "caution" not in sentence and "chance" not in sentence


def test_unused_allowance_is_reported(tmp_path: Path) -> None:
    verdict = judged(tmp_path, runs(1, (SMPC * 0.97).tolist(), state_violations=outside(1)))
    (sentence,) = describe_verdict(verdict)
    assert "(states 5 %, inputs 10 %)" in sentence and "caution" in sentence


def test_a_rate_above_the_allowance_is_never_reported_as_within_it(tmp_path: Path) -> None:
    # 3 runs with 14 of 50 steps on average; every interval reaches below 10 %.
    rows = runs(1, (SMPC[:3] * 0.9).tolist(), input_violations=[42, 0, 0])
    verdict = judged(tmp_path, rows, runs(0, SMPC[:3].tolist()))
    one = verdict.comparisons[0]
    rate, interval = one.baseline.input_violation_rate, one.baseline.input_violation_ci
    assert rate is not None and interval is not None and interval[0] <= 0.1 < rate
    safer = replace(one, inputs=PairedDifference(mean=-rate, low=-rate, high=-rate, runs=3))
    (sentence,) = describe_verdict(replace(verdict, comparisons=(safer,)))
    assert find_numbers(sentence)[-3:] == [28.0, 0.0, 10.0]  # inputs, SMPC's; allowed
    assert "10 % allowed for inputs" in sentence and "chance" in sentence and "caution" not in sentence


def test_a_rate_at_the_allowance_is_within_it(tmp_path: Path) -> None:
    cells = [cell(0, "ours", "smpc", promised_u=1.0 - 0.9), cell(1, "theirs")]  # below 0.1 by rounding
    rows = [*runs(0, SMPC.tolist()), *runs(1, (SMPC * 0.9).tolist(), input_violations=[10, 0] * (N // 2))]
    results = read_results(write(tmp_path, cells, rows))
    (verdict,) = make_verdicts(results, group_cells(summarise(tmp_path)))
    (sentence,) = describe_verdict(verdict)
    assert "inputs in 10 %" in sentence and "caution" in sentence


@pytest.mark.parametrize(
    ("hits", "cells", "chance", "rate"),
    [([2, 2, 2], [1.0], False, 4.0), ([30, 0, 0], [1.0, 1.0], True, 20.0), ([30] * 60, [1.0, 1.0], False, 60.0)],
)  # `cells`: all of them where none broke its promise, else those that did and all
def test_the_promise_is_judged_by_the_measured_rates(
    hits: list[int], cells: list[float], chance: bool, rate: float, tmp_path: Path
) -> None:
    rows = runs(0, SMPC[: len(hits)].tolist(), state_violations=hits)
    folder = write(tmp_path, [cell(0, "ours", "smpc")], rows)
    with omit_figures():
        text = text_of(write_report(folder)[0])
    word = "Promise kept" if len(cells) == 1 and rate <= 5.0 else "Perhaps too often" if chance else "Promise broken"
    (first,) = re.findall(rf"{word}: (.*?allowed)", text)
    assert find_numbers(first) == [*cells, rate, 5.0]


@pytest.mark.parametrize(
    ("states", "inputs", "named"),
    [(1, 1, ["states", "requested inputs"]), (1, 0, ["states"]), (0, 1, ["requested inputs"])],
)
def test_states_and_requests_that_are_outside_more_often_are_told_apart(
    states: int, inputs: int, named: list[str], tmp_path: Path
) -> None:
    cheaper = runs(1, (SMPC * 0.97).tolist(), state_violations=outside(states), input_violations=outside(inputs))
    verdict = judged(tmp_path, cheaper)
    _, limits = describe_briefly(verdict.comparisons[0]).split(", ")
    assert limits.partition(" outside")[0].split(" and ") == named
    claim = describe_verdict(verdict)[0].partition(":")[0]
    assert [noun for noun in ("states", "requested inputs") if noun in claim] == named


def test_a_better_baseline_is_reported(tmp_path: Path) -> None:
    verdict = judged(tmp_path, runs(1, (SMPC * 0.5).tolist()))
    assert (verdict.is_unmatched, verdict.is_beaten, get_verdict_word(verdict)) == (False, True, "no")
    assert "theirs costs 50 % less" in describe_verdict(verdict)[0]
    assert "breaks limits no more often" in describe_verdict(verdict)[0]


def test_cheaper_at_a_higher_violation_rate_is_not_outright(tmp_path: Path) -> None:
    worse = runs(0, SMPC.tolist(), state_violations=outside(2))
    verdict = judged(tmp_path, runs(1, (SMPC * 1.1).tolist()), worse)
    assert (verdict.is_unmatched, verdict.is_better_than_all, verdict.is_beaten) == (True, False, False)
    costs, limits = describe_briefly(verdict.comparisons[0]).split(", ")
    assert find_numbers(costs) == [10.0] and "more" in costs and "better" in limits


def test_costs_without_a_significant_difference_are_no(tmp_path: Path) -> None:
    verdict = judged(tmp_path, runs(1, (SMPC + np.tile([1.0, -1.0], N // 2)).tolist()))
    assert (verdict.is_unmatched, verdict.is_beaten) == (False, False)
    assert describe_briefly(verdict.comparisons[0]) == "costs the same"


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three losses and a burst link, a refused cell, failed runs, a name that is no HTML."""
    cells, rows = [], []
    for place, (link, loss) in enumerate([("10 %", 0.1), ("30 %", 0.3), ("50 %", 0.5), ("bursts", None)]):
        reported: dict[str, Any] = {"link": link, "link_loss": loss}
        cells += [cell(3 * place, "smpc", "smpc", **reported), cell(3 * place + 1, "lqg <b>", **reported)]
        cells.append(cell(3 * place + 2, "far", "smpc", refused=REFUSED, **reported))
        cost = (100.0 + 10.0 * place) + NOISE
        rows += runs(3 * place, cost.tolist())
        baseline_cost = 0.9 * cost
        baseline_cost[7] = np.nan if place == 1 else baseline_cost[7]
        rows += runs(3 * place + 1, baseline_cost.tolist(), state_violations=outside(3))
    folder = write(tmp_path_factory.mktemp("grid"), cells, rows)
    (folder / "campaign.toml").write_text('name = "by hand"\n')
    write_report(folder)
    return folder


@pytest.mark.slow
def test_the_page_is_complete_in_itself(grid: Path) -> None:
    html = (grid / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"https?://|<script[^>]*\bsrc\b|<link|url\((?!#)", html)
    assert len(html) < 1_500_000
    ids = re.findall(r'\bid="([^"]*)"', html)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:href="#|url\(#)([^")]+)', html)) <= set(ids)


def test_the_page_lists_cells_and_results(grid: Path) -> None:
    text = text_of(grid / "report.html")
    for label in ("Campaign “by hand”", "12 cells", "seed 7", "uavctl 9.9", f"Not flown: {REFUSED}"):
        assert label in text
    reported = list(describe_outcome(CampaignView.make(read_results(grid))))
    assert all(sentence in text for sentence in reported)
    assert find_numbers(reported[0])[:2] == [480.0, 50.0]  # runs, steps
    assert find_numbers(reported[1]) == [4.0] and "no design" in reported[1]
    assert find_numbers(reported[3]) == [4.0, 4.0, 0.0, 0.0]  # SMPC best at its rate, of so many; outright; beaten
    assert 'name = "by hand"' in text
    assert "lqg <b>" in text


def test_failed_runs_are_listed(grid: Path) -> None:
    text = text_of(grid / "report.html")
    assert "1 run failed" in text
    assert "4 lqg <b> 30 % 7 it broke" in text


def test_links_that_are_a_loss_make_a_line_and_others_dots(grid: Path) -> None:
    html = (grid / "report.html").read_text(encoding="utf-8")
    figures = set(re.findall(r'<figure id="([^"]*)"', html))
    assert {"cost-loss-s0", "states-loss-s0", "inputs-loss-s0", "cost-link-s0", "states-link-s0"} <= figures
    assert {"difference-s0-0", "ages"} <= figures
    (states,) = re.findall(r'<figure id="states-loss-s0".*?</figure>', html, re.DOTALL)
    assert "stroke-dasharray" in states
    assert "var(--limit" in states  # the promised risk
    (cost,) = re.findall(r'<figure id="cost-loss-s0".*?</figure>', html, re.DOTALL)
    assert "var(--limit" not in cost


def test_every_figure_has_a_text_alternative(grid: Path) -> None:
    html = (grid / "report.html").read_text(encoding="utf-8")
    labels = re.findall(r'<figure [^>]*><svg role="img" aria-label="([^"]+)"', html)
    assert len(labels) == html.count("<figure")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cells", "rows", "text"),
    [
        ([cell(0, "lqg")], runs(0, [1.0, 2.0]), "No SMPC was flown."),
        ([cell(0, "smpc", "smpc")], runs(0, [1.0]), "no baseline to compare"),
        ([cell(0, "smpc", "smpc")], runs(0, [np.nan, np.nan]), "all 2 failed"),
        ([cell(0, "smpc", "smpc", refused="no")], runs(1, [1.0]), "Not flown: no."),
        ([cell(0, "smpc", "smpc"), cell(1, "lqg")], [*runs(0, [1.0]), *runs(1, [1e300])], "no baseline is as cheap"),
        ([cell(0, "smpc", "smpc"), cell(1, "lqg")], [*runs(0, [0.0, 0.0]), *runs(1, [0.0, 0.0])], "costs the same"),
    ],
)  # fmt: skip
def test_campaigns_of_odd_shapes_have_a_page(cells: Any, rows: Any, text: str, tmp_path: Path) -> None:
    assert text in text_of(write_report(write(tmp_path, cells, rows))[0])


def test_a_page_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    folder = write(tmp_path, [cell(0, "a")], runs(0, [1.0]))
    (folder / "report.html").mkdir()
    with pytest.raises(UavctlError, match="cannot be written"):
        write_report(folder)


def test_the_reason_of_a_refused_cell_is_a_row_over_all_columns(grid: Path) -> None:
    html = (grid / "report.html").read_text(encoding="utf-8")
    assert len(re.findall(rf'<tr><td colspan="15">2 far: [^<]*{REFUSED}</td></tr>', html)) == 1
    assert "min-width:97" not in html  # no table is set wider than the paper


def test_numbers_below_the_axis_of_differences_do_not_touch(tmp_path: Path) -> None:
    rows = [*runs(0, SMPC.tolist()), *runs(1, (SMPC * 0.9).tolist()), *runs(2, (SMPC * 40.0).tolist())]
    folder = write(tmp_path, [cell(0, "ours", "smpc"), cell(1, "less"), cell(2, "more")], rows)
    html = write_report(folder)[0].read_text(encoding="utf-8")
    (drawn,) = re.findall(r'<figure id="difference-s0-0".*?</figure>', html, re.DOTALL)
    shown = re.findall(r">([−-]?[0-9]+k?)</text>", drawn)
    assert "1000" in shown and "3000" not in shown


def test_a_legend_has_the_markers_of_its_figure() -> None:
    looks = ControllerStyles(tuple(f"controller {place}" for place in range(12)))
    entries = list(looks.make_marks(looks.controllers))
    assert len({(entry.role, entry.path, entry.full) for entry in entries}) == 12
    drawn = re.findall(
        r"<li>.*?</li>", render_page("", "", [PageSection("", lambda _: [Drawing("", "", "")], legend=entries)], None)
    )
    assert len({re.sub(r"controller \d+", "", label) for label in drawn}) == 12
    assert all(
        f"var(--{entry.role})" in text and entry.path in text for entry, text in zip(entries, drawn, strict=True)
    )
