"""Text of a comparison for people: sentences on differences, values with their digits and units."""

from __future__ import annotations

import msgspec

from logs.recording.summary import count
from logs.report.compare import Figure, Match, Value

_NONE = "–"


def describe_match(match: Match, first: str) -> str:
    """Return a sentence on how long a flight is the same as the first one, and where it departs from it.

    Args:
        first: Name of the first one.
    """
    divergence = match.parting
    if divergence is None:
        identical_text = count(match.records, "record")
        return (
            f"{match.name} is the same flight as {first}: {identical_text} alike, bit for bit (computing times do not "
            "count)."
        )
    if not match.records:
        return f"{match.name} is another flight than {first} from its first record on."
    field = f", {divergence.field}" if divergence.field else ""
    return (
        f"{match.name} is the same as {first} for {count(match.records, 'record')}, up to {divergence.flight_s:.3f} s. "
        f"Then {divergence.topic}{field}: {divergence.first} in {first}, {divergence.other} in {match.name}."
    )


def format_parameter(value: object) -> str:
    """Return a parameter's value as text."""
    if value is None:
        return _NONE
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def convert_to_display_unit(figure: Figure) -> Figure:
    """Return a figure in the unit that it is shown in; the certified gap, a small share, in percent."""
    if figure.key != "largest_gap":
        return figure
    values, differences = (
        tuple(None if value is None else 100.0 * value for value in figures)
        for figures in (figure.values, figure.differences)
    )
    return msgspec.structs.replace(figure, unit="%", values=values, differences=differences)


def format_value(value: Value) -> str:
    """Return a figure as text: four digits, or all of those before the point up to a million."""
    if value is None:
        return _NONE
    return f"{value:.0f}" if isinstance(value, int) or 1e4 <= abs(value) < 1e6 else f"{value:.4g}"


def format_difference(value: Value) -> str:
    """Return a difference of figures as text, with its sign."""
    return f"+{format_value(value)}" if value is not None and value > 0 else format_value(value)


def format_label(figure: Figure) -> str:
    """Return the name of a figure with its unit."""
    return f"{figure.text}, {figure.unit}" if figure.unit else figure.text
