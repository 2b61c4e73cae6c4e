"""Figures of a comparison as people read them; scripts get them as they are."""

from __future__ import annotations

from logs.report.compare import Figure
from logs.report.compare_text import convert_to_display_unit, format_difference, format_label, format_value


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
    converted = convert_to_display_unit(figure("largest_gap"))
    assert format_label(converted) == "largest certified gap, %"
    assert [format_value(value) for value in converted.values] == ["0.002274", "0.002002", "–"]
    assert [format_difference(value) for value in converted.differences] == ["-0.000272", "–"]
    assert converted.ratios == figure("largest_gap").ratios


def test_other_figures_stay() -> None:
    assert convert_to_display_unit(figure("cost")) == figure("cost")
