"""Both sides of `uavctl bench --link`: one measures the link to another computer, the other answers."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from rich.console import Group, RenderableType

from uavctl.arrays import SECOND_NS
from uavctl.cli.common import Common
from uavctl.cli.output import make_table, print_message
from uavctl.cli.signals import stop_on_signals
from uavctl.clock import monotonic_ns
from uavctl.config.link import MAX_TRACE_PACKETS
from uavctl.errors import UsageError
from uavctl.io.transport import open_connection
from uavctl.lab.link.measurement import LinkBench, WayResult, answer_link, measure_link, write_link
from uavctl.lab.link.probe import LinkProbe

ANSWER_LIMIT_S = 3600.0  # of a side that answers and is never asked


def bench_link(url: str, seconds: float, rate_hz: float, folder: Path, common: Common) -> int:
    """Measure the link to the other side, or answer it where the URL waits for a sender.

    Raises:
        ConnectionSpecError: The URL cannot be opened.
        UsageError: More packets than a trace has.
        UavctlError: Too little has arrived.
    """
    if url.startswith("udpin:"):
        with stop_on_signals() as stopped, closing(open_connection(url)) as connection:
            print_message(f"answering on {url}; Ctrl-C ends it")
            limit_ns = monotonic_ns() + round(ANSWER_LIMIT_S * 1e9)
            is_answered = answer_link(connection, limit_ns, stopped)
        common.show("bench/answer", {"answered": is_answered}, lambda: "answered" if is_answered else "not asked")
        return 0 if is_answered else 1
    count = round(seconds * rate_hz)
    if not 1 <= count <= MAX_TRACE_PACKETS:
        raise UsageError(
            f"{seconds:g} s at {rate_hz:g} Hz are {count} packets; give --seconds and --rate so that it is 1 to "
            f"{MAX_TRACE_PACKETS}"
        )
    config = common.load().config
    with stop_on_signals() as stopped, closing(open_connection(url)) as connection:
        print_message(f"measuring for {seconds:g} s")
        probe = LinkProbe(secrets.randbits(64), count, round(SECOND_NS / rate_hz), monotonic_ns())
        measurement = measure_link(connection, probe, stopped)
    result = write_link(measurement, config, url, folder)
    common.show("bench/link", result, lambda: render_link(result))
    return 0


def render_link(result: LinkBench) -> RenderableType:
    """Return the figures of both ways as a table, and the names of the files."""
    rows = zip(
        ("packets", "lost", "loss", "losses", "longest run", "outages", "delay"), *_list_cells(result), strict=True
    )
    median_s, _, largest_s = result.round_trip_s[1:]
    return Group(
        make_table(result.url, ("", "there", "back"), rows),
        f"Round trip: median {1e3 * median_s:.2f} ms, 99 % within {1e3 * largest_s:.2f} ms.",
        f"Configurations: {result.there.config}, {result.back.config}; traces: {result.there.trace}, "
        f"{result.back.trace}.",
    )


def _list_cells(result: LinkBench) -> Iterator[tuple[str, ...]]:
    for way in (result.there, result.back):
        yield _format_way(way)


def _format_way(way: WayResult) -> tuple[str, ...]:
    return (
        str(way.packets),
        str(way.lost),
        f"{way.loss:.1%} ± {way.loss_std:.1%}",
        "in bursts" if way.bursts else "each by itself",
        str(way.longest_run),
        ", ".join(f"{outage_s:.1f} s" for outage_s in way.outages_s) or "none",
        f"{1e3 * way.delay_s:.1f} ms, 99 % within {1e3 * way.jitter_s:.1f} ms more",
    )
