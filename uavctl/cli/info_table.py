"""`uavctl log info` as a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from logs.info import PositionLoss, RecordingInfo


def info_table(found: RecordingInfo) -> RenderableType:
    """Topics with rates and gaps, and below what else is worth knowing."""
    title = f"{found.files[0]}: {found.duration_s:.1f} s, {found.bytes:,} bytes"
    if len(found.files) > 1:
        title += f" in {len(found.files)} files"
    table = Table()
    for column in ("topic", "messages", "rate", "longest gap", "at"):
        table.add_column(column, justify="left" if column == "topic" else "right")
    for topic in found.topics:
        rate = f"{topic.rate_hz:.1f}/s" if topic.messages > 1 else ""
        gap = (f"{topic.longest_gap_s:.3f} s", f"{topic.longest_gap_at_s:.1f} s") if topic.longest_gap_s else ("", "")
        table.add_row(Text(topic.topic), str(topic.messages), rate, *gap)
    return Group(Text(title), table, *map(Text, _lines(found)))


def _lines(found: RecordingInfo) -> Iterator[str]:
    if not found.finished:
        yield "not closed: `uavctl log recover` makes a clean file"
    elif found.damage:
        yield "damaged: `uavctl log recover` restores the rest"
    else:
        yield "closed in order"
    yield (
        f"records lost: {found.dropped} dropped, {found.refused} refused, {found.missing} missing; "
        f"{found.failures} failed writes"
    )
    if len(found.segments) > 1:
        for one in found.segments:
            state = "" if one.finished else ", not closed"
            yield f"{one.file}: {one.messages} messages, {one.bytes:,} bytes{state}"
    yield from found.damage
    for note in found.notes:
        yield f"{note.at_s:.1f} s: {note.text}"
    for link in found.connections:
        lost = "".join(
            f"; {what}: {_counts(counts)}" for what, counts in (("bad", link.bad), ("refused", link.refused)) if counts
        )
        yield (
            f"connection {link.link}: {link.datagrams} datagrams, {link.messages} messages, "
            f"{link.samples} positions{lost}"
        )
    yield from _loss(found.position_loss)
    if found.origin is not None:
        yield f"{found.origin.command} ({found.origin.started_utc}, seed {found.origin.seed})"
    if found.library is not None:
        yield f"policy library {found.library.library_id}, {found.library.bytes:,} bytes"


def _loss(loss: PositionLoss) -> Iterator[str]:
    if loss.believed is not None:
        bursts = ", in bursts" if loss.bursts else ""
        promise = ", more than promised" if loss.below_promise else ""
        yield f"positions: {100 * loss.believed:.0f} % of the steps without news, as last estimated{bursts}{promise}"
    if loss.simulated_sent:
        yield f"simulated channel: {loss.simulated_lost} of {loss.simulated_sent} positions lost"


def _counts(counts: Mapping[str, int]) -> str:
    """Counts in words, as in "3 checksum, 1 length"."""
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
