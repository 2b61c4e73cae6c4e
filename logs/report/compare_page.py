"""Page of a comparison: all flights in one drawing, and the tables of the terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from logs.recording.flight import FlightData
from logs.recording.output_files import refuse_recording_path, write_atomically
from logs.report import overlays
from logs.report.compare import FlightComparison, LoadedFlight
from logs.report.compare_text import (
    convert_to_display_unit,
    describe_match,
    format_difference,
    format_label,
    format_parameter,
    format_value,
)
from logs.report.page import Mark, PageSection, Part, render_facts, render_list, render_page, render_table
from uavctl.errors import UsageError

_MAX_COMPARED_COLUMNS = 2  # more columns would not fit on paper


def write_comparison_page(comparison: FlightComparison, recordings: Sequence[LoadedFlight], path: Path) -> None:
    """Write the page.

    Raises:
        RecordingError: The file cannot be written.
        UsageError: More flights than can be distinguished in one drawing, or `path` is that of a recording.
    """
    refuse_recording_path(path)
    if len(recordings) > len(overlays.ROLES):
        raise UsageError(
            f"--out draws {len(overlays.ROLES)} flights at most, these are {len(recordings)}; compare fewer at a time"
        )
    write_atomically(path, render_comparison(ComparisonView(comparison, recordings)))


@dataclass(frozen=True, eq=False)
class ComparisonView:
    """Content of the page: the comparison, and the flights themselves."""

    comparison: FlightComparison
    recordings: Sequence[LoadedFlight]

    @property
    def flights(self) -> list[FlightData]:
        """The flights, the first one first."""
        return [recording.flight for recording in self.recordings]

    @property
    def names(self) -> list[str]:
        """Their names."""
        return [recording.identity.name for recording in self.recordings]


def render_comparison(view: ComparisonView) -> str:
    """Return the page of a comparison as HTML."""
    subtitle = f"The others are compared with {view.names[0]}."
    return render_page(f"Comparison of {len(view.recordings)} flights", subtitle, SECTIONS, view)


def _describe_likeness(view: ComparisonView) -> Iterator[Part]:
    matches = (describe_match(match, view.names[0]) for match in view.comparison.likenesses)
    yield render_list([*matches, *(f"Mind: {note}." for note in view.comparison.notes)])


def _draw_flights_over_time(view: ComparisonView) -> Iterator[Part]:
    yield from overlays.draw_positions(view.flights)
    yield overlays.draw_ages(view.flights)


def _list_marks(view: ComparisonView) -> Iterator[Mark]:
    yield from (Mark("line", role, name) for role, name in zip(overlays.ROLES, view.names, strict=False))
    yield Mark("dashed", "limit", f"limit of {view.names[0]}")


def _show_recordings(view: ComparisonView) -> Iterator[Part]:
    yield render_facts(
        (
            recording.name,
            f"{recording.recording} · {recording.started_utc} · {recording.command} · "
            f"{recording.ended}{'' if recording.finished else ', torn'}",
        )
        for recording in view.comparison.recordings
    )


def _show_figures(view: ComparisonView) -> Iterator[Part]:
    """Return the first flight's figures beside those of the others, a few others in each table."""
    indices = range(1, len(view.recordings))
    for begin in range(0, len(indices), _MAX_COMPARED_COLUMNS):
        yield _make_figure_table(view, indices[begin : begin + _MAX_COMPARED_COLUMNS])


def _make_figure_table(view: ComparisonView, indices: Sequence[int]) -> Markup:
    first = view.names[0]
    columns = ["figure", first]
    for index in indices:
        name = view.names[index]
        columns += [name, f"{name} − {first}", f"{name} / {first}"]
    rows = []
    for figure in map(convert_to_display_unit, view.comparison.figures):
        cells = [format_value(figure.values[0])]
        for index in indices:
            cells += [format_value(figure.values[index]), format_difference(figure.differences[index - 1])]
            cells.append(format_value(figure.ratios[index - 1]))
        rows.append([format_label(figure), *(cell.replace("-", "−") for cell in cells)])
    return render_table(columns, rows, frozenset(range(1, len(columns))))


def _show_parameters(view: ComparisonView) -> Iterator[Part]:
    rows = [[entry.key, *map(format_parameter, entry.values)] for entry in view.comparison.parameters]
    if rows:
        yield render_table(["parameter", *view.names], rows, frozenset())


SECTIONS: tuple[PageSection[ComparisonView], ...] = (
    PageSection("How alike they are", _describe_likeness),
    PageSection("Recordings", _show_recordings),
    PageSection("Path", lambda view: overlays.draw_paths(view.flights), legend=_list_marks),
    PageSection(
        "Positions and age",
        _draw_flights_over_time,
        note="Time counts from each flight's first tick. Positions are the true ones where they are known.",
        legend=lambda view: (*_list_marks(view), Mark("dotted", "muted", "horizon H")),
    ),
    PageSection("Figures", _show_figures),
    PageSection("Parameters that differ", _show_parameters, empty_text="None."),
)
