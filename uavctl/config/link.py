"""[link] and measured traces of it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from uavctl.config.document import (
    MAX_PATH_LENGTH,
    MAX_SPANS,
    ConfigProblem,
    DataFileError,
    Floats,
    Section,
    Spans,
    UnboundedFloats,
    declare,
    read_row_lines,
    refuse_file,
)

Probability = Annotated[float, Meta(ge=0, le=1)]
# Each run length is a state of the design's chain.
MAX_LOSS_RUN = 100
# A recording holds its configuration.
MAX_TRACE_PACKETS = 20_000
MAX_DELAY_S = 60.0


class LinkConfig(Section, frozen=True, kw_only=True):
    """The link that carries positions: the design assumes it, the simulator has it."""

    loss: Annotated[
        float,
        declare(
            "probability that a packet is lost; the design counts on 1 − lossⁿ for n positions in Δt (source.rate_hz)",
            low=0,
            below=1,
        ),
    ] = 0.0
    model: Annotated[
        Literal["bernoulli", "gilbert-elliott", "empirical", "trace", "scheduled"],
        declare(
            "losses: `bernoulli` (each by itself), `gilbert-elliott` (in bursts, by a good and a bad state), "
            "`empirical` (in measured runs), `trace` (losses and delays as measured) or `scheduled` (each by itself, "
            "from a sender that serves other vehicles too)"
        ),
    ] = "bernoulli"
    probability: Annotated[
        tuple[Probability, ...],
        declare(
            "`bernoulli`, in place of `loss`: probability that a packet of step k arrives, the last one repeated; the "
            "design counts on the least of the steps ahead",
            length=10_000,
        ),
    ] = ()
    gaps: Annotated[
        tuple[Probability, ...],
        declare(
            "`empirical`: probability of i lost packets in a row, i = 0, 1, …; the sum is 1", length=MAX_LOSS_RUN + 1
        ),
    ] = ()
    trace_file: Annotated[
        str,
        declare(
            "`trace`: CSV file beside this one with the delay [s] of each packet, empty or `inf` if lost; of "
            "several columns `delay_s` (or `_ms`, `_us`, `_ns`)",
            length=MAX_PATH_LENGTH,
        ),
    ] = ""
    trace_s: Annotated[
        UnboundedFloats,
        declare(
            "`trace`: these delays as a list, repeated at its end; the design counts those above delay_s + jitter_s "
            "as lost",
            "s",
            length=MAX_TRACE_PACKETS,
        ),
    ] = ()
    burst_enter: Annotated[float, declare("`gilbert-elliott`: probability of entering the bad state", "", 0, 1)] = 0.0
    burst_leave: Annotated[float, declare("`gilbert-elliott`: probability of leaving it", high=1, above=0)] = 1.0
    burst_loss: Annotated[
        float, declare("`gilbert-elliott`: loss in the bad state; in the good one it is `loss`", "", 0, 1)
    ] = 1.0
    wait_s: Annotated[
        float, declare("`scheduled`: longest time from one message to this vehicle to the next", "s", 0, MAX_DELAY_S)
    ] = 0.0
    delay_s: Annotated[float, declare("constant delay of a packet, not with `trace`", "s", 0, MAX_DELAY_S)] = 0.0
    jitter_s: Annotated[float, declare("uniform extra delay; packets may overtake", "s", 0, MAX_DELAY_S)] = 0.0
    duplicate: Annotated[float, declare("probability that a packet comes twice", "", 0, 1)] = 0.0
    corrupt: Annotated[float, declare("probability that one bit of a packet is flipped", "", 0, 1)] = 0.0
    truncate: Annotated[float, declare("probability that a packet is cut short", "", 0, 1)] = 0.0
    oversize: Annotated[float, declare("probability of a datagram above 4096 bytes", "", 0, 1)] = 0.0
    blackout: Annotated[Spans, declare("spans in which all packets are lost", "s", length=MAX_SPANS)] = ()
    held: Annotated[Spans, declare("spans that hold packets to their end", "s", length=MAX_SPANS)] = ()
    uplink_blackout: Annotated[Spans, declare("spans in which nothing reaches the vehicle", "s", length=MAX_SPANS)] = ()

    @property
    def mean_loss(self) -> float:
        """Share of packets that are lost in the long run, without delays and spans."""
        if self.model == "gilbert-elliott":
            # π_bad = enter / (enter + leave)
            bad = self.burst_enter / (self.burst_enter + self.burst_leave)
            return (1.0 - bad) * self.loss + bad * self.burst_loss
        if self.model == "empirical":
            # n̄ / (n̄ + 1), with the mean n̄ of the losses after one that arrived
            lost = sum(i * probability for i, probability in enumerate(self.gaps)) / sum(self.gaps)
            return lost / (lost + 1.0)
        if self.model == "trace":
            return sum(math.isinf(delay_s) for delay_s in self.trace_s) / len(self.trace_s)
        return 1.0 - self.probability[-1] if self.probability else self.loss


_COLUMN = "delay_s"
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_HEADING = re.compile(r"^delay(?:[_ ]?[\[(]?(?P<unit>s|ms|us|ns)[\])]?)?$")


def read_trace_file(link: LinkConfig, folder: Path, problems: list[ConfigProblem]) -> tuple[LinkConfig, dict[str, str]]:
    """Replace `link.trace_file` by its delays, so that the configuration is complete in itself.

    Args:
        folder: Where a relative name starts from.
        problems: Problems of the file are added here.

    Returns:
        The link, and where the keys that come from the file stand: `file:line`, or the file for the whole list.
    """
    key = "link.trace_file"
    if not link.trace_file:
        return link, {}
    if link.trace_s:
        problems.append(ConfigProblem(key, "there are delays in link.trace_s as well", "keep the file or the list"))
        return link, {}
    path = folder / link.trace_file
    try:
        delays = _read_delays(path)
    except DataFileError as error:
        problems.extend(ConfigProblem(key, reason, "correct the file") for reason in error.reasons)
        return link, {}
    return msgspec.structs.replace(link, trace_file="", trace_s=delays), {"link.trace_s": str(path)}


def _read_delays(path: Path) -> Floats:
    """Delay of each packet [s], infinite for a lost one."""
    lines = [(number, line) for number, line in enumerate(read_row_lines(path), 1) if not line.lstrip().startswith("#")]
    if len(lines) > MAX_TRACE_PACKETS + 1:  # more, also if the first one names the columns
        raise DataFileError((f"{path}: has {len(lines)} packets, more than {MAX_TRACE_PACKETS}",))
    rows = [(number, line.split(",")) for number, line in lines]
    column, width, factor = 0, 1, 1.0
    if rows and any(cell.strip() for cell in rows[0][1]) and not any(_is_number(cell) for cell in rows[0][1]):
        number, cells = rows[0]
        names = [cell.strip().strip("\"'").lower() for cell in cells]
        delay_columns = [i for i, name in enumerate(names) if _HEADING.match(name)]
        if len(delay_columns) != 1:
            count_text = "none of its columns" if not delay_columns else f"{len(delay_columns)} of its columns"
            raise DataFileError((f"{path}:{number}: {count_text} is a delay; head one of them {_COLUMN}, or delay_ms",))
        column, width = delay_columns[0], len(names)
        heading = _HEADING.match(names[column])
        factor = _UNITS[(heading and heading["unit"]) or "s"]
        rows = rows[1:]
    if not rows:
        raise DataFileError((f"{path}: has no packets",))
    if len(rows) > MAX_TRACE_PACKETS:
        raise DataFileError((f"{path}: has {len(rows)} packets, more than {MAX_TRACE_PACKETS}",))
    refuse_file(
        path,
        [f"{path}:{number}: {reason}" for number, cells in rows for reason in _find_row_problems(cells, column, width)],
    )
    return tuple(_parse_delay(cells[column]) * factor for _, cells in rows)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _find_row_problems(cells: list[str], column: int, width: int) -> Iterator[str]:
    """Yield the errors in a line."""
    if len(cells) != width:
        yield f"has {len(cells)} columns; give {'as many as the header' if width > 1 else 'one, or a header'}"
        return
    try:
        delay = _parse_delay(cells[column])
    except ValueError:
        yield f'"{cells[column].strip()[:40]}" is not a number'
        return
    if not delay >= 0.0:
        yield f"{delay:g} is not a delay in s"


def _parse_delay(cell: str) -> float:
    return float(cell) if cell.strip() else math.inf
