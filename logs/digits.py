"""Figures as people read them: few digits, units that suit, no exponents."""

from __future__ import annotations

import math

_ROUNDING = 1e-6  # of the quotient that finds two digits
_LEAST_PERCENT = 1e-3


def duration(value_us: float) -> str:
    """A duration [µs] with a unit that suits it."""
    if value_us < 999.5:
        return f"{value_us:.3g} µs"
    return f"{value_us / 1e3:.3g} ms" if value_us < 999.5e3 else f"{value_us / 1e6:.3g} s"


def number(value: float, decimals: int = 3) -> str:
    """A number for people: no more decimals than they need, no exponent below a million."""
    return f"{round(value, decimals):g}"


def percent_above(share: float) -> str:
    """A share in percent, rounded up to two digits, so that it stays a bound; never less than a thousandth of one."""
    percent = max(_LEAST_PERCENT, 100.0 * share)
    place = math.floor(math.log10(percent)) - 1  # of the second digit
    return f"{number(math.ceil(percent / 10.0**place - _ROUNDING) * 10.0**place, 5)} %"
