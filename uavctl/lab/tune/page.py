"""Page of `uavctl tune`: the flight before and the flight after, which of them is better, and how they compare."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from logs.report.compare import compare_flights, load_flights
from logs.report.compare_page import SECTIONS as COMPARISON_SECTIONS
from logs.report.compare_page import ComparisonView
from logs.report.findings import Banner
from logs.report.page import PageSection, render_page, render_table
from uavctl.cause import CAUTION, GOOD
from uavctl.lab.tune.figures import HoldChange, TuneFigures, compare_holds, list_figure_rows

BEFORE, AFTER = "before", "after"
_OUTCOMES = {
    HoldChange.BETTER: (GOOD, "Better after tuning"),
    HoldChange.ALIKE: (GOOD, "As good after tuning"),
    HoldChange.WORSE: (CAUTION, "Worse after tuning"),
    HoldChange.UNKNOWN: (CAUTION, "Not known which is better"),
}


@dataclass(frozen=True, eq=False)
class _TuneView(ComparisonView):
    """Content of the page: the comparison of both flights, and their figures."""

    figures: TuneFigures


def render_tune_page(name: str, recordings: tuple[Path, Path], tuned_file: str, figures: TuneFigures) -> str:
    """Return the page of a tuning run as HTML.

    Args:
        name: Name of the configuration that was tuned.
        recordings: Recordings of the flights before and after.
        tuned_file: Name of the tuned configuration.
    """
    loaded = load_flights(recordings, names=(BEFORE, AFTER))
    subtitle = f"“{BEFORE}” was flown with the configuration as it was, “{AFTER}” with {tuned_file}."
    view = _TuneView(compare_flights(loaded), loaded, figures)
    return render_page(f"Tuning of “{name}”: before and after", subtitle, _SECTIONS, view, judge_tuning(figures))


def judge_tuning(figures: TuneFigures) -> Banner:
    """Return the first line: which flight held its last waypoint better, and how well each model predicts."""
    before, after = figures.before, figures.after
    change = compare_holds(before, after)
    tone, word = _OUTCOMES[change]
    hold_text = "a flight held its last waypoint for too short a time"
    if before.hold_rms_m is not None and after.hold_rms_m is not None:
        hold_text = (
            f"it held its last waypoint within {100 * after.hold_rms_m:.1f} cm (rms), before within "
            f"{100 * before.hold_rms_m:.1f} cm"
        )
        if change is HoldChange.ALIKE:
            hold_text += ", no more than two flights of one configuration differ by"
    model_text = (
        f"the tuned model predicts its motion within {100 * figures.new_error_m:.1f} cm, the model before within "
        f"{100 * figures.old_error_m:.1f} cm"
    )
    reasons: tuple[str, ...] = ()
    if after.beyond_box_m is not None and after.beyond_box_m > 0.0:
        tone, reasons = CAUTION, (f"The flight after left the box by {100 * after.beyond_box_m:.1f} cm.",)
    return Banner(tone, word, f"{hold_text}; {model_text}.", reasons)


_COLUMNS = ("", BEFORE, AFTER)
_SECTIONS: tuple[PageSection[_TuneView], ...] = (
    PageSection(
        "Before and after",
        lambda view: [render_table(_COLUMNS, list_figure_rows(view.figures), frozenset({1, 2}), kind="words")],
        note="The prediction of the flight after is that of the model before and of the tuned one: geometric mean of "
        "the rms errors of all axes, 0.25 to 2 s ahead.",
    ),
    *COMPARISON_SECTIONS,
)
