"""Names, units and digits as people read them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from uavctl.records import GaveWay

# Figures as people read them: few digits, units that suit, no exponents.


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


# Names of limits and states as people are told of them.


_OF_NO_ROW = ("equilibrium", "slew")  # constraints that are no rows of the state set


@dataclass(frozen=True)
class Names:
    """Names and units."""

    states: tuple[tuple[str, str], ...]  # (name, unit) of each state; the unit is empty where it is not known
    # (name, unit, size) of each row of the state set; a row's excess divided by its size is in the unit
    rows: tuple[tuple[str, str, float], ...]
    axes: tuple[str, ...] = ()  # name of each axis


def names_of(
    c_x: Iterable[Sequence[float]],
    n_x: int,
    axes: Sequence[str],
    position_index: Sequence[int],
    velocity_index: Sequence[int],
    further: Sequence[tuple[str, str]] = (),
) -> Names:
    """Names of a plant's states, and of the rows of {x | c_x x <= b_x}.

    Args:
        c_x: Rows (m_x, n_x).
        axes: Axes of local NED that the plant moves in.
        position_index: State index of each axis' position.
        velocity_index: State index of each axis' velocity.
        further: (name, unit) of the states that follow position and velocity in each axis.
    """
    states = [(f"state {index}", "") for index in range(n_x)]
    for axis, position, velocity in zip(axes, position_index, velocity_index, strict=True):
        states[position], states[velocity] = (f"{axis} position", "m"), (f"{axis} velocity", "m/s")
        for index, (name, unit) in enumerate(further, start=velocity + 1):
            states[index] = (f"{axis} {name}", unit)
    return Names(tuple(states), tuple(_row(number, row, states) for number, row in enumerate(c_x)), tuple(axes))


def _row(number: int, row: Sequence[float], states: Sequence[tuple[str, str]]) -> tuple[str, str, float]:
    used = [index for index, value in enumerate(row) if value]
    if len(used) != 1:
        return f"row {number} of the state limits", "", 1.0
    value, (name, unit) = float(row[used[0]]), states[used[0]]
    return f"{'upper' if value > 0 else 'lower'} limit of {name}", unit, abs(value)


def tell(names: Names, one: GaveWay) -> str:
    """One constraint that gave way, in words."""
    if one.constraint == "equilibrium":
        name, unit = names.states[one.index]
        return f"rest was missed by {_amount(one.amount, unit)} of {name} in stage {one.stage}"
    if one.constraint == "slew":
        return f"the limit of how fast the {names.axes[one.index]} setpoint changes gave way by {one.amount:.2g} m/s²"
    name, unit, _ = names.rows[one.index]
    where = f"in stage {one.stage}" if one.constraint == "state" else f"where the plan rests, from stage {one.stage} on"
    return f"{name} gave way by {_amount(excess(names, one), unit)} {where}"


def worst(names: Names, given: Iterable[GaveWay]) -> GaveWay:
    """The one that gave way the most, each in its own unit; a limit of a state first, the first of equals."""
    return max(given, key=lambda one: severity(names, one))


def severity(names: Names, one: GaveWay) -> tuple[bool, float]:
    """Order of constraints that gave way: limits of states above all else, then by the amount."""
    return one.constraint not in _OF_NO_ROW, excess(names, one)


def excess(names: Names, one: GaveWay) -> float:
    """Return by how much a constraint gave way, in the unit of its state."""
    return one.amount / (1.0 if one.constraint in _OF_NO_ROW else names.rows[one.index][2])


def tell_all(names: Names, given: Sequence[GaveWay]) -> str:
    """The worst of the constraints that a plan did not keep, and how many others there are."""
    others = len(given) - 1
    more = "" if not others else f"; so did {others} other{'' if others == 1 else 's'}"
    return tell(names, worst(names, given)) + more


def _amount(value: float, unit: str) -> str:
    return f"{value:.2g} {unit}".rstrip()
