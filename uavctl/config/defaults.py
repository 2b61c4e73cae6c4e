"""Defaults that follow from other keys of a document: a plant of matrices needs no room and no vehicle.

They are filled in as plain values before decoding, so a stored configuration is complete. Given values stay unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any

AXES = ("north", "east", "down")
# Of scheme `age-conditioned`: that of the presets, 2.4 s there.
_HORIZON = 48
# A vehicle's setpoint as the presets limit it; no acceleration of an own plant is known.
_ACCEL_MPS2, _SLEW_MPS3 = 2.0, 15.0
_MAX_TICK_S = 0.1
_DT_S = 0.05  # of the presets, used where plant.dt_s is wrong; the decoder reports it
_ROUNDING = 1e-9


def fill_defaults(table: dict[str, Any], file: str) -> None:
    """Fill in the keys that a document leaves out; the decoder reports values of a wrong type."""
    table.setdefault("name", PurePath(file).stem[:100] or "own")
    plant, sets, sim = (_get_table(table, key) for key in ("plant", "sets", "sim"))
    if "a" in plant:
        plant.setdefault("model", "matrices")
        width = _count_columns(plant.get("e"))
        if width:  # E alone scales a disturbance of variance 1
            plant.setdefault("w", [[float(i == j) for j in range(width)] for i in range(width)])
    smpc = _get_table(table, "smpc")
    if smpc.get("scheme") != "hahn-stursberg":
        smpc.setdefault("horizon", _HORIZON)
    dt_s = _parse_step_s(plant.get("dt_s"), _DT_S)
    accel_mps2 = _find_max_accel(plant, sets)
    slew_mps3 = 2.0 * max(accel_mps2) / dt_s if plant.get("model") == "matrices" else _SLEW_MPS3
    _set_defaults(table, "limits", {"accel_mps2": accel_mps2, "slew_mps3": min(1e6, max(_SLEW_MPS3, slew_mps3))})
    _set_defaults(table, "target", {"position_m": _find_inside_position(plant, sets)})
    _set_defaults(table, "estimator", {})
    _set_defaults(table, "daemon", {"tick_s": _compute_tick_s(dt_s)})
    _set_defaults(sim, "camera", {"rate_hz": min(1000.0, max(0.01, 1.0 / dt_s))})
    sim.setdefault("start_position_m", _find_inside_position(plant, sets))


def find_position_states(plant: Mapping[str, Any]) -> dict[str, int]:
    """State index of each axis' position, of a plant's table; empty where that is not known."""
    axes, size = plant.get("axes"), {"drag-lag": 3, "velocity-reference": 6}.get(str(plant.get("model")))
    if not isinstance(axes, list | tuple) or not all(axis in AXES for axis in axes):
        return {}
    indices = [size * axis_number for axis_number in range(len(axes))] if size else plant.get("position_index")
    if not isinstance(indices, list | tuple) or len(indices) != len(axes) or not all(type(i) is int for i in indices):
        return {}
    return dict(zip(axes, indices, strict=True))


def _set_defaults(table: dict[str, Any], key: str, values: Mapping[str, object]) -> None:
    inner = _get_table(table, key)
    for name, value in values.items():
        inner.setdefault(name, value)


def _get_table(table: dict[str, Any], key: str) -> dict[str, Any]:
    """A table in another one, made where it is missing; where something else stands, one that nothing reads."""
    value = table.setdefault(key, {}) if key not in ("plant", "sets") else table.get(key)
    return value if isinstance(value, dict) else {}


def _parse_step_s(value: object, default_s: float) -> float:
    is_valid = isinstance(value, int | float) and not isinstance(value, bool) and 0.001 <= value <= 5
    return float(value) if is_valid else default_s  # type: ignore[arg-type]


def _count_columns(rows: object) -> int:
    """Columns of a matrix, 0 where it is none."""
    return len(rows[0]) if isinstance(rows, list) and rows and isinstance(rows[0], list) else 0


def _get_entry(values: object, index: int, default: float) -> float:
    """Return an entry of a list of numbers; `default` if it is no finite number."""
    value = values[index] if isinstance(values, Sequence) and 0 <= index < len(values) else None
    is_number = isinstance(value, int | float) and abs(value) <= 1e7
    return float(value) if is_number else default  # type: ignore[arg-type]


def _find_inside_position(plant: Mapping[str, Any], sets: Mapping[str, Any]) -> list[float]:
    """The place nearest to the origin that is not at a limit: 0, or the middle where 0 is not inside."""
    states, position_m = find_position_states(plant), []
    for axis in AXES:
        index = states.get(axis, -1)
        low, high = (_get_entry(sets.get(f"state_{inner}"), index, math.nan) for inner in ("lower", "upper"))
        if math.isnan(low) or math.isnan(high):  # open on one side: one unit from the other
            inner = low + 1.0 if high != high else high - 1.0
            position_m.append(0.0 if not low >= 0.0 and not high <= 0.0 else inner)
        else:
            position_m.append(0.0 if low < 0.0 < high else 0.5 * (low + high))
    return position_m


def _find_max_accel(plant: Mapping[str, Any], sets: Mapping[str, Any]) -> list[float]:
    """Acceleration that the input limits allow along each axis [m/s²]."""
    max_accel_mps2 = dict.fromkeys(AXES, _ACCEL_MPS2)
    axes = plant.get("axes")
    for axis_number, axis in enumerate(find_position_states(plant) if isinstance(axes, list | tuple) else ()):
        low, high = (_get_entry(sets.get(f"input_{side}"), axis_number, math.nan) for side in ("lower", "upper"))
        accel_per_input = (
            1.0 if plant.get("model") != "matrices" else _get_entry(plant.get("accel_per_input"), axis_number, 1.0)
        )
        limit_mps2 = max(abs(low), abs(high)) * abs(accel_per_input)
        if 0.0 < limit_mps2 < math.inf:
            max_accel_mps2[axis] = limit_mps2
    return list(max_accel_mps2.values())


def _compute_tick_s(dt_s: float) -> float:
    """The longest time between setpoints that divides Δt [s]."""
    return dt_s / math.ceil(dt_s / _MAX_TICK_S - _ROUNDING)
