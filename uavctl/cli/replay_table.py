"""Tables of a replay: the first difference, its possible cause, and its course."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from rich.console import Group, RenderableType
from rich.table import Table

from logs.recording.fleet_replay import FleetReplay
from logs.recording.replay import Chosen, Context, FieldDivergence, ReplayDifference
from logs.recording.tlog import ForeignReplay
from uavctl.cli.output import format_counts, make_pair_table, make_table
from uavctl.cli.replays import ReplayOutcome

MAX_FIELDS = 12


_MAX_VALUE_LENGTH = 60


def make_replay_table(replayed: ReplayOutcome) -> RenderableType:
    """Return the outcome of a replay as tables."""
    result = replayed.result
    identical_text = "yes" if result.identical else "no"
    rows: list[tuple[str, object]] = [
        *(("changed", f"{key.key}: {_shorten(key.recorded)} -> {_shorten(key.replayed)}") for key in replayed.changed),
        ("decisions", result.decisions),
        ("records compared", result.compared),
        (f"the same to {replayed.tolerance:g}" if replayed.tolerance else "identical, bit for bit", identical_text),
    ]
    first = result.first_difference
    if first is None:
        return make_pair_table("Replay", rows)
    rows += _describe_difference("first difference", first)
    if first.stage:
        rows.append(("possible cause", first.stage))
    rows += [("other version", text) for text in replayed.other_versions]
    if result.context is not None:
        rows += _describe_context(result.context)
    decision = result.first_decision
    if decision is None:
        rows.append(("decisions that differ", "none"))
    else:
        decisions_since = result.decisions - (0 if result.context is None else result.context.decisions_before)
        rows.append(("decisions that differ", f"{result.decisions_differing} of {decisions_since}, from then on"))
        if decision != first:
            rows += _describe_difference("first such decision", decision)
    return Group(make_pair_table("Replay", rows), _make_course_table(result.course))


def make_fleet_table(result: FleetReplay) -> RenderableType:
    """Return the outcome of the replay of a sender or a coordinator as a table."""
    rows: list[tuple[str, object]] = [
        ("messages" if result.kind == "sender" else "cycles", result.decisions),
        ("records compared", result.compared),
        ("identical, bit for bit", "yes" if result.identical else "no"),
    ]
    if (first := result.first_difference) is not None:
        rows += [
            ("first difference", f"{first.at_s:.3f} s after the begin (log time {first.at_ns} ns)"),
            ("", f"{first.topic} {first.field}".rstrip()),
            ("", f"recorded {_shorten(first.recorded)}, replayed {_shorten(first.replayed)}"),
        ]
    return make_pair_table(f"Replay of the {result.kind}", rows)


def _describe_difference(title: str, difference: ReplayDifference) -> Iterator[tuple[str, object]]:
    time_text = (
        "before the first tick"
        if difference.tick is None
        else f"{difference.flight_s:.3f} s into the flight, tick {difference.tick}"
    )
    yield title, f"{time_text} (log time {difference.at_ns} ns)"
    other_fields = f", and {difference.fields - 1} more fields of the record" if difference.fields > 1 else ""
    meaning = f" ({difference.meaning})" if difference.meaning else ""
    yield "", f"{difference.topic} {difference.field}{meaning}".rstrip() + other_fields
    unit = f" {difference.unit}" if difference.unit else ""
    change = "" if difference.change is None else f", that is {difference.change:+.3g}{unit}"
    yield "", f"recorded {_shorten(difference.recorded)}{unit}, replayed {_shorten(difference.replayed)}{unit}{change}"


def _describe_context(context: Context) -> Iterator[tuple[str, object]]:
    yield "before it", f"{context.decisions_before} decisions, {context.records_before} records: all identical"
    newest = ""
    if context.position_m is not None and context.position_age_s is not None:
        position = ", ".join(f"{value:z.3f}" for value in context.position_m)
        newest = f", the newest {context.position_age_s:.3f} s old at ({position}) m"
    inputs = [
        f"{context.positions} position{'' if context.positions == 1 else 's'}{newest}",
        f"vehicle {context.vehicle}" if context.vehicle else "no vehicle heard",
        *([f"orders {', '.join(context.orders)}"] if context.orders else []),
        *([f"{context.missed_ticks} ticks missed before it"] if context.missed_ticks else []),
        *(["the operator ended the flight"] if context.stop else []),
    ]
    yield "inputs of that tick", "; ".join(inputs)
    if context.recorded is not None and context.recorded == context.replayed:
        yield "decision, both", _describe_choice(context.recorded)
        return
    yield "decision, recorded", _describe_choice(context.recorded)
    yield "decision, replayed", _describe_choice(context.replayed)


def _describe_choice(choice: Chosen | None) -> str:
    if choice is None:
        return "nothing"
    age = "no age yet" if choice.age_steps is None else f"age {choice.age_steps} steps"
    plan = "no plan" if choice.plan_seq is None else f"plan {choice.plan_seq}, index {choice.plan_index}"
    solve = "no solve" if choice.solve is None else f"solve {choice.solve}"
    return f"{choice.mode} ({choice.reason}); {age}; {plan}; {solve}"


def _make_course_table(course: tuple[FieldDivergence, ...]) -> Table:
    """Return a table of the differences in each field, on the recorded inputs."""
    title = "Differences by field, on the recorded inputs"
    if len(course) > MAX_FIELDS:
        title += f" ({MAX_FIELDS} of {len(course)} fields, all with --json)"
    table = make_table(title, ("field", "from [s]", "records that differ", "largest", "at [s]"), ())
    for divergence in course[:MAX_FIELDS]:
        unit = f" {divergence.unit}" if divergence.unit else ""
        entry = f" ({divergence.entry})" if divergence.entry else ""
        table.add_row(
            f"{divergence.topic} {divergence.field or '(a record on one side only)'}",
            f"{divergence.first_s:.3f}",
            f"{divergence.differing} of {divergence.records}",
            "-" if divergence.largest is None else f"{divergence.largest:.3g}{unit}{entry}",
            "-" if divergence.largest_s is None else f"{divergence.largest_s:.3f}",
        )
    return table


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_VALUE_LENGTH else f"{text[: _MAX_VALUE_LENGTH - 3]}..."


def _format_ages(ages: Mapping[str, int], horizon: int) -> str:
    """Return the ages at decisions, in a few classes."""
    classes: dict[str, int] = {}
    for age, decisions in ages.items():
        steps = int(age)
        name = age if steps < 2 else f"2 to {horizon - 1}" if steps < horizon else f"{horizon} and more"
        classes[name] = classes.get(name, 0) + decisions
    return ", ".join(f"{name}: {decisions}" for name, decisions in classes.items())


def make_foreign_table(result: ForeignReplay, horizon: int) -> Table:
    """Return the figures of a replay of another program's recording as a table."""
    ages = result.age_ms
    rows: list[tuple[str, object]] = [
        ("datagrams", result.datagrams),
        ("positions", result.positions),
        ("out of order", result.out_of_order),
        ("accepted / refused", f"{result.accepted} / {result.rejected}"),
        ("ticks / decisions", f"{result.ticks} / {result.decisions}"),
        ("solves", format_counts(result.solves)),
        ("ticks by mode", format_counts(result.modes)),
        *([("not taken by the connection", format_counts(result.left_out))] if result.left_out else []),
        ("decisions by age in steps", _format_ages(result.age_steps, horizon)),
    ]
    if ages is not None:
        spread = f"{ages.min:.0f}, {ages.p05:.0f}, {ages.p50:.0f}, {ages.p95:.0f}, {ages.max:.0f}"
        rows.append(("capture to arrival, ms: min, 5 %, median, 95 %, max", spread))
    return make_pair_table("Foreign recording through our controller", rows)
