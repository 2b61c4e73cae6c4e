"""Names of limits and states for people, and sentences on constraints that a plan did not keep."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from uavctl.records import GaveWay

_WITHOUT_ROW = ("equilibrium", "slew")  # constraints that are no rows of the state set


@dataclass(frozen=True)
class ConstraintNames:
    """Names and units of states, of the rows of the state set, and of axes."""

    states: tuple[tuple[str, str], ...]  # (name, unit) of each state; the unit is empty where it is not known
    # (name, unit, size) of each row of the state set; a row's excess divided by its size is in the unit
    rows: tuple[tuple[str, str, float], ...]
    axes: tuple[str, ...] = ()  # name of each axis


def name_constraints(
    c_x: Iterable[Sequence[float]],
    n_x: int,
    axes: Sequence[str],
    position_index: Sequence[int],
    velocity_index: Sequence[int],
    further: Sequence[tuple[str, str]] = (),
    n_gusts: int = 0,
) -> ConstraintNames:
    """Make the names of a plant's states, and of the rows of {x | c_x x <= b_x}.

    Args:
        c_x: Rows (m_x, n_x).
        axes: Axes of local NED that the plant moves in.
        position_index: State index of each axis' position.
        velocity_index: State index of each axis' velocity.
        further: (name, unit) of the states that follow position and velocity in each axis.
        n_gusts: Number of gusts, the last states: one an axis, or none.
    """
    states = [(f"state {index}", "") for index in range(n_x)]
    for axis, position, velocity in zip(axes, position_index, velocity_index, strict=True):
        states[position], states[velocity] = (f"{axis} position", "m"), (f"{axis} velocity", "m/s")
        for index, (name, unit) in enumerate(further, start=velocity + 1):
            states[index] = (f"{axis} {name}", unit)
    for axis, index in zip(axes, range(n_x - n_gusts, n_x), strict=False):
        states[index] = (f"{axis} gust", "m/s²")
    rows = tuple(_name_row(number, row, states) for number, row in enumerate(c_x))
    return ConstraintNames(tuple(states), rows, tuple(axes))


def _name_row(number: int, row: Sequence[float], states: Sequence[tuple[str, str]]) -> tuple[str, str, float]:
    used = [index for index, value in enumerate(row) if value]
    if len(used) != 1:
        return f"row {number} of the state limits", "", 1.0
    value, (name, unit) = float(row[used[0]]), states[used[0]]
    return f"{'upper' if value > 0 else 'lower'} limit of {name}", unit, abs(value)


def describe_relaxed(names: ConstraintNames, relaxed: GaveWay) -> str:
    """Describe one relaxed constraint."""
    if relaxed.constraint == "equilibrium":
        name, unit = names.states[relaxed.index]
        return f"rest was missed by {_amount(relaxed.amount, unit)} of {name} in stage {relaxed.stage}"
    if relaxed.constraint == "slew":
        axis = names.axes[relaxed.index]
        return f"the slew limit of the {axis} setpoint was relaxed by {relaxed.amount:.2g} m/s²"
    name, unit, _ = names.rows[relaxed.index]
    where = (
        f"in stage {relaxed.stage}"
        if relaxed.constraint == "state"
        else f"where the plan rests, from stage {relaxed.stage} on"
    )
    return f"{name} was relaxed by {_amount(measure_excess(names, relaxed), unit)} {where}"


def find_worst(names: ConstraintNames, given: Iterable[GaveWay]) -> GaveWay:
    """Find the most relaxed constraint, each in its own unit; a limit of a state first, the first of equals."""
    return max(given, key=lambda relaxed: compute_severity(names, relaxed))


def compute_severity(names: ConstraintNames, relaxed: GaveWay) -> tuple[bool, float]:
    """Compute the rank of a relaxed constraint: limits of states above all else, then by the amount."""
    return relaxed.constraint not in _WITHOUT_ROW, measure_excess(names, relaxed)


def measure_excess(names: ConstraintNames, relaxed: GaveWay) -> float:
    """Return the amount by which a constraint is relaxed, in the unit of its state."""
    return relaxed.amount / (1.0 if relaxed.constraint in _WITHOUT_ROW else names.rows[relaxed.index][2])


def describe_all_relaxed(names: ConstraintNames, given: Sequence[GaveWay]) -> str:
    """Describe the worst of the constraints that a plan did not keep, and how many others there are."""
    others = len(given) - 1
    more = "" if not others else f", and {others} other limit{'' if others == 1 else 's'}"
    return describe_relaxed(names, find_worst(names, given)) + more


def _amount(value: float, unit: str) -> str:
    return f"{value:.2g} {unit}".rstrip()
