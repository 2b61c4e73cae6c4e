"""Gaps between ticks: how many end a flight."""

from __future__ import annotations

import pytest

from uavctl.daemon.tick_gaps import MAX_GAPS, SPAN_NS, GapLimit
from uavctl.errors import UavctlError
from uavctl.flight.context import GAP_NS

LONG_NS = GAP_NS + 1


def tick(limit: GapLimit, gaps_ns: list[int], *, is_in_control: bool = True) -> None:
    at_ns = 0
    limit.check(at_ns, is_in_control=is_in_control)
    for gap_ns in gaps_ns:
        at_ns += gap_ns
        limit.check(at_ns, is_in_control=is_in_control)


@pytest.mark.fault(104)
def test_more_gaps_than_allowed_end_the_flight() -> None:
    tick(GapLimit(), [LONG_NS] * MAX_GAPS)
    with pytest.raises(UavctlError, match="too busy"):
        tick(GapLimit(), [LONG_NS] * (MAX_GAPS + 1))


@pytest.mark.fault(104)
def test_gaps_that_are_short_or_rare_do_not_count() -> None:
    tick(GapLimit(), [GAP_NS] * 100)
    tick(GapLimit(), [*[GAP_NS] * (SPAN_NS // GAP_NS), LONG_NS] * 10)


@pytest.mark.fault(104)
def test_gaps_outside_of_control_do_not_count() -> None:
    limit = GapLimit()
    tick(limit, [LONG_NS] * 100, is_in_control=False)
    for at_ns in range(0, 100 * LONG_NS, 2 * LONG_NS):  # each gap ends control, or begins it
        limit.check(at_ns, is_in_control=False)
        limit.check(at_ns + LONG_NS, is_in_control=True)
