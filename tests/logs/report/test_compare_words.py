"""Figures of a comparison as people read them; scripts get them as they are."""

from __future__ import annotations

from logs.report.compare import Figure, difference, for_people, label, measured


def figure(key: str) -> Figure:
    return Figure(
        key=key,
        group="plans",
        text="largest certified gap",
        unit="",
        values=(2.274e-05, 2.002e-05, None),
        differences=(-2.72e-06, None),
        ratios=(0.88, None),
    )


def test_a_certified_gap_is_read_in_percent() -> None:
    one = for_people(figure("largest_gap"))
    assert label(one) == "largest certified gap, %"
    assert [measured(value) for value in one.values] == ["0.002274", "0.002002", "–"]
    assert [difference(value) for value in one.differences] == ["-0.000272", "–"]
    assert one.ratios == figure("largest_gap").ratios


def test_other_figures_stay() -> None:
    assert for_people(figure("cost")) == figure("cost")
