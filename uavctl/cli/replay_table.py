"""A replay as a person reads it: where it parts from the recording, why that may be, and what becomes of it."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table

from logs.difference import Chosen, Context, Course, Difference
from uavctl.cli.common import two_columns
from uavctl.cli.replaying import Replayed

MOST_FIELDS = 12
_LONGEST = 60


def replay_table(replayed: Replayed) -> RenderableType:
    """The whole outcome."""
    result = replayed.result
    rows: list[tuple[str, object]] = [
        *(("changed", f"{one.key}: {_cut(one.recorded)} -> {_cut(one.replayed)}") for one in replayed.changed),
        ("decisions", result.decisions),
        ("records compared", result.compared),
        ("identical, bit for bit", "yes" if result.identical else "no"),
    ]
    first = result.first_difference
    if first is None:
        return two_columns("Replay", rows)
    rows += _difference("first difference", first)
    if first.stage:
        rows.append(("in question", first.stage))
    rows += [("made otherwise", text) for text in replayed.other_versions]
    if result.context is not None:
        rows += _context(result.context)
    decision = result.first_decision
    if decision is None:
        rows.append(("decisions that differ", "none"))
    else:
        since = result.decisions - (0 if result.context is None else result.context.decisions_before)
        rows.append(("decisions that differ", f"{result.decisions_differing} of {since} from then on"))
        if decision != first:
            rows += _difference("the first of them", decision)
    return Group(two_columns("Replay", rows), _course(result.course))


def _difference(title: str, one: Difference) -> Iterator[tuple[str, object]]:
    when = "before the first tick" if one.tick is None else f"{one.flight_s:.3f} s into the flight, tick {one.tick}"
    yield title, f"{when} (log time {one.at_ns} ns)"
    others = f", and {one.fields - 1} more fields of the record" if one.fields > 1 else ""
    named = f" ({one.meaning})" if one.meaning else ""
    yield "", f"{one.topic} {one.field}{named}".rstrip() + others
    unit = f" {one.unit}" if one.unit else ""
    change = "" if one.change is None else f", that is {one.change:+.3g}{unit}"
    yield "", f"recorded {_cut(one.recorded)}{unit}, replayed {_cut(one.replayed)}{unit}{change}"


def _context(context: Context) -> Iterator[tuple[str, object]]:
    yield "before it", f"{context.decisions_before} decisions, {context.records_before} records: all identical"
    newest = ""
    if context.position_m is not None and context.position_age_s is not None:
        place = ", ".join(f"{value:.3f}" for value in context.position_m)
        newest = f", the newest {context.position_age_s:.3f} s old at ({place}) m"
    parts = [
        f"{context.positions} position{'' if context.positions == 1 else 's'}{newest}",
        f"vehicle {context.vehicle}" if context.vehicle else "no vehicle heard",
        *([f"orders {', '.join(context.orders)}"] if context.orders else []),
        *([f"{context.missed_ticks} ticks missed before it"] if context.missed_ticks else []),
        *(["the hand-over is asked for"] if context.stop else []),
    ]
    yield "that tick was given", "; ".join(parts)
    if context.recorded is not None and context.recorded == context.replayed:
        yield "and decided, both", _chosen(context.recorded)
        return
    yield "and decided, recorded", _chosen(context.recorded)
    yield "and decided, replayed", _chosen(context.replayed)


def _chosen(one: Chosen | None) -> str:
    if one is None:
        return "nothing"
    age = "no age yet" if one.age_steps is None else f"age {one.age_steps} steps"
    plan = "no plan" if one.plan_seq is None else f"plan {one.plan_seq}, index {one.plan_index}"
    solve = "no solve" if one.solve is None else f"solve {one.solve}"
    return f"{one.mode} ({one.reason}); {age}; {plan}; {solve}"


def _course(course: tuple[Course, ...]) -> Table:
    """What becomes of the difference, on the recorded inputs."""
    title = "What becomes of it, on the recorded inputs"
    if len(course) > MOST_FIELDS:
        title += f" ({MOST_FIELDS} of {len(course)} fields, all with --json)"
    table = Table("field", title=title, title_justify="left")
    for name in ("from [s]", "records that differ", "largest", "at [s]"):
        table.add_column(escape(name), justify="right")
    for one in course[:MOST_FIELDS]:
        unit = f" {one.unit}" if one.unit else ""
        entry = f" ({one.entry})" if one.entry else ""
        table.add_row(
            escape(f"{one.topic} {one.field or '(a record on one side only)'}"),
            f"{one.first_s:.3f}",
            f"{one.differing} of {one.records}",
            "-" if one.largest is None else escape(f"{one.largest:.3g}{unit}{entry}"),
            "-" if one.largest_s is None else f"{one.largest_s:.3f}",
        )
    return table


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
