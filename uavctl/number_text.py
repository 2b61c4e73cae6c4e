"""Numbers as text for people: few digits, units that suit, no exponents."""

from __future__ import annotations

import math

_ROUNDING = 1e-6  # of the quotient that finds two digits
_MIN_PERCENT = 1e-3


def format_duration(value_us: float) -> str:
    """Format a duration [µs] with a unit that suits it."""
    if value_us < 999.5:
        return f"{value_us:.3g} µs"
    return f"{value_us / 1e3:.3g} ms" if value_us < 999.5e3 else f"{value_us / 1e6:.3g} s"


def format_number(value: float, decimals: int = 3) -> str:
    """Format a number: no more decimals than needed, no exponent below a million."""
    return f"{round(value, decimals):g}"


def format_percent_above(share: float) -> str:
    """Format a share in percent, rounded up to two digits, so that it stays a bound; at least a thousandth of one."""
    percent = max(_MIN_PERCENT, 100.0 * share)
    place = math.floor(math.log10(percent)) - 1  # of the second digit
    return f"{format_number(math.ceil(percent / 10.0**place - _ROUNDING) * 10.0**place, 5)} %"
