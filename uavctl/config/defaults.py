"""Keys that a document may leave out because others say what they are: an own plant needs no room, and no vehicle.

They are filled in as plain values before anything is decoded, so that a configuration is complete wherever it is
kept. What is written stays as it is written.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

AXES = ("north", "east", "down")
# Of scheme `age-conditioned`: that of the presets, which looks 2.4 s ahead there.
_HORIZON = 48
# A vehicle's setpoint as the presets limit it; no acceleration of an own plant is known.
_ACCEL_MPS2, _SLEW_MPS3 = 2.0, 15.0
_LONGEST_TICK_S = 0.1
_DT_S = 0.05  # of the presets, where plant.dt_s is wrong and told anyway
_ROUNDING = 1e-9


def complete(table: dict[str, Any], file: str) -> None:
    """Fill in what a document leaves out; what has a wrong type is left for the decoder to tell."""
    table.setdefault("name", PurePath(file).stem[:100] or "own")
    plant, sets, sim = (_table(table, key) for key in ("plant", "sets", "sim"))
    if "a" in plant:
        plant.setdefault("model", "matrices")
        width = _width(plant.get("e"))
        if width:  # E alone scales a disturbance of variance 1
            plant.setdefault("w", [[float(i == j) for j in range(width)] for i in range(width)])
    smpc = _table(table, "smpc")
    if smpc.get("scheme") != "hahn-stursberg":
        smpc.setdefault("horizon", _HORIZON)
    dt_s = _number(plant.get("dt_s"), _DT_S)
    accel = _largest_accel(plant, sets)
    widest = 2.0 * max(accel) / dt_s if plant.get("model") == "matrices" else _SLEW_MPS3
    _fill(table, "limits", {"accel_mps2": accel, "slew_mps3": min(1e6, max(_SLEW_MPS3, widest))})
    _fill(table, "target", {"position_m": _inside(plant, sets)})
    _fill(table, "estimator", {})
    _fill(table, "daemon", {"tick_s": _tick_s(dt_s)})
    _fill(sim, "camera", {"rate_hz": min(1000.0, max(0.01, 1.0 / dt_s))})
    sim.setdefault("start_position_m", _inside(plant, sets))


def places(plant: Mapping[str, Any]) -> dict[str, int]:
    """State index of each axis' position, of a plant's table; empty where that is not known."""
    axes, size = plant.get("axes"), {"drag-lag": 3, "velocity-reference": 6}.get(str(plant.get("model")))
    if not isinstance(axes, list | tuple) or not all(axis in AXES for axis in axes):
        return {}
    index = [size * place for place in range(len(axes))] if size else plant.get("position_index")
    if not isinstance(index, list | tuple) or len(index) != len(axes) or not all(type(i) is int for i in index):
        return {}
    return dict(zip(axes, index, strict=True))


def _fill(table: dict[str, Any], key: str, values: Mapping[str, object]) -> None:
    inner = _table(table, key)
    for name, value in values.items():
        inner.setdefault(name, value)


def _table(table: dict[str, Any], key: str) -> dict[str, Any]:
    """A table in another one, made where it is missing; where something else stands, one that nothing reads."""
    found = table.setdefault(key, {}) if key not in ("plant", "sets") else table.get(key)
    return found if isinstance(found, dict) else {}


def _number(value: object, otherwise: float) -> float:
    good = isinstance(value, int | float) and not isinstance(value, bool) and 0.001 <= value <= 5
    return float(value) if good else otherwise  # type: ignore[arg-type]


def _width(rows: object) -> int:
    """Columns of a matrix, 0 where it is none."""
    return len(rows[0]) if isinstance(rows, list) and rows and isinstance(rows[0], list) else 0


def _at(values: object, index: int, otherwise: float) -> float:
    """An entry of a list of numbers; what is none, or not finite, is `otherwise`."""
    value = values[index] if isinstance(values, Sequence) and 0 <= index < len(values) else None
    good = isinstance(value, int | float) and abs(value) <= 1e7
    return float(value) if good else otherwise  # type: ignore[arg-type]


def _inside(plant: Mapping[str, Any], sets: Mapping[str, Any]) -> list[float]:
    """The place nearest to the origin that is not at a limit: 0, or the middle where 0 is not inside."""
    where, found = places(plant), []
    for axis in AXES:
        index = where.get(axis, -1)
        low, high = (_at(sets.get(f"state_{side}"), index, math.nan) for side in ("lower", "upper"))
        if math.isnan(low) or math.isnan(high):  # open on one side: one unit from the other
            side = low + 1.0 if high != high else high - 1.0
            found.append(0.0 if not low >= 0.0 and not high <= 0.0 else side)
        else:
            found.append(0.0 if low < 0.0 < high else 0.5 * (low + high))
    return found


def _largest_accel(plant: Mapping[str, Any], sets: Mapping[str, Any]) -> list[float]:
    """Acceleration that the input limits allow along each axis [m/s²]."""
    found = dict.fromkeys(AXES, _ACCEL_MPS2)
    axes = plant.get("axes")
    for place, axis in enumerate(places(plant) if isinstance(axes, list | tuple) else ()):
        low, high = (_at(sets.get(f"input_{side}"), place, math.nan) for side in ("lower", "upper"))
        each = 1.0 if plant.get("model") != "matrices" else _at(plant.get("accel_per_input"), place, 1.0)
        most = max(abs(low), abs(high)) * abs(each)
        if 0.0 < most < math.inf:
            found[axis] = most
    return list(found.values())


def _tick_s(dt_s: float) -> float:
    """The longest time between setpoints that divides Δt [s]."""
    return dt_s / math.ceil(dt_s / _LONGEST_TICK_S - _ROUNDING)
