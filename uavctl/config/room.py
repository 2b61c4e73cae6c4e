"""`base` and `[room]`: a preset as the rest of a configuration, and its limits by name in place of lists.

Both are read before decoding, and written into the keys that they stand for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from msgspec import Meta

from uavctl.config.defaults import AXES, find_position_states
from uavctl.config.document import ConfigProblem, Number, Section, declare

Span = tuple[Number, Number] | None
Size = Annotated[float, Meta(gt=0, le=1000)] | None
# Keys of lists that [room] writes: they are given by name or as lists, not both.
ROOM_KEYS = ("sets", "target.position_m", "limits.accel_mps2")


class RoomConfig(Section, frozen=True, kw_only=True):
    """Limits of the vehicle's centre, and its target (default: that of the base), by name."""

    north_m: Annotated[Span, declare("least and largest position north", "m")] = None
    east_m: Annotated[Span, declare("least and largest position east", "m")] = None
    height_m: Annotated[Span, declare("least and largest height above the origin, up positive", "m")] = None
    speed_mps: Annotated[Size, declare("largest speed north, and east", "m/s")] = None
    climb_mps: Annotated[Size, declare("largest speed up and down", "m/s")] = None
    accel_mps2: Annotated[Size, declare("largest acceleration setpoint north, and east", "m/s²")] = None
    target_north_m: Annotated[Number | None, declare("target", "m")] = None
    target_east_m: Annotated[Number | None, declare("target", "m")] = None
    target_height_m: Annotated[Number | None, declare("target", "m")] = None


_AXIS_KEYS = {
    "north": ("north_m", "speed_mps", "target_north_m"),
    "east": ("east_m", "speed_mps", "target_east_m"),
    "down": ("height_m", "climb_mps", "target_height_m"),
}


def merge_tables(base: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, Any]:
    """A document with the keys of a base that it does not have, table by table."""
    merged = dict(base)
    for key, value in document.items():
        base_value = merged.get(key)
        are_tables = isinstance(value, dict) and isinstance(base_value, dict)
        merged[key] = merge_tables(base_value, value) if are_tables else value  # type: ignore[arg-type]
    return merged


def apply_room(
    table: dict[str, Any], room: RoomConfig, document: Mapping[str, Any], written: dict[str, str]
) -> Iterator[ConfigProblem]:
    """Write the values of [room] into the lists of a document; yield the problems.

    Args:
        table: The document with its base.
        document: The document without its base.
        written: The key of [room] that each key is written for is added here.
    """
    for name in ("north_m", "east_m", "height_m"):
        span = getattr(room, name)
        if span is not None and not span[0] < span[1]:
            yield ConfigProblem(f"room.{name}", f"{span[0]:g} is not below {span[1]:g}", "give the smaller one first")
            return
    plant = table.get("plant", {})
    index = find_position_states(plant) if isinstance(plant, dict) else {}
    if not index:
        yield ConfigProblem("room", "there is no plant with axes that it could limit", "add base, or [plant] with axes")
        return
    speeds = [i + 1 for i in index.values()] if plant.get("model") != "matrices" else plant.get("velocity_index", [])
    sets = table.setdefault("sets", {})
    lower, upper = (
        _get_limits(sets, "state_lower", -math.inf, plant, index),
        _get_limits(sets, "state_upper", math.inf, plant, index),
    )
    old_limits = {axis: (lower[i], upper[i]) for axis, i in index.items()}
    for axis_number, (axis, i) in enumerate(index.items()):
        span_key, speed_key, _ = _AXIS_KEYS[axis]
        span, speed = getattr(room, span_key), getattr(room, speed_key)
        if span is not None:
            lower[i], upper[i] = span if axis != "down" else (0.0 - span[1], 0.0 - span[0])
            _add_written(written, f"room.{span_key}", f"sets.state_lower[{i}]", f"sets.state_upper[{i}]")
        if speed is not None and axis_number < len(speeds):
            lower[speeds[axis_number]], upper[speeds[axis_number]] = -speed, speed
            _add_written(
                written,
                f"room.{speed_key}",
                *(f"sets.state_{side}[{speeds[axis_number]}]" for side in ("lower", "upper")),
            )
    sets["state_lower"], sets["state_upper"] = lower, upper
    if room.accel_mps2 is not None:
        _limit_inputs(table, plant, index, room.accel_mps2, written)
    new_limits = {axis: (lower[i], upper[i]) for axis, i in index.items()}
    _rescale_position(table.setdefault("target", {}), "position_m", old_limits, new_limits)
    target = table["target"].get("position_m")
    for axis in index:
        name = _AXIS_KEYS[axis][2]
        value = getattr(room, name)
        if value is not None:
            target = target or [0.0, 0.0, 0.0]
            target[AXES.index(axis)] = 0.0 - value if axis == "down" else value
            _add_written(written, f"room.{name}", f"target.position_m[{AXES.index(axis)}]")
    if target:
        table["target"]["position_m"] = target
    else:
        del table["target"]
    if "start_position_m" not in document.get("sim", {}):
        _rescale_position(table.setdefault("sim", {}), "start_position_m", old_limits, new_limits)


def _add_written(written: dict[str, str], room_key: str, *keys: str) -> None:
    written.update(dict.fromkeys(keys, room_key))


def _get_limits(
    sets: Mapping[str, Any], key: str, default: float, plant: Mapping[str, Any], index: Mapping[str, int]
) -> list[float]:
    """The limits of a base, or as many open ones as there are states."""
    axis_states = {"drag-lag": 3, "velocity-reference": 6}.get(str(plant.get("model")), 0)
    return list(sets.get(key, [default] * (axis_states * len(index) or len(plant.get("a", ())))))


def _limit_inputs(
    table: dict[str, Any],
    plant: Mapping[str, Any],
    index: Mapping[str, int],
    accel_mps2: float,
    written: dict[str, str],
) -> None:
    """Limit the inputs of the level axes, and the setpoint limiter's setpoints along them."""
    sets, accel_limits = table["sets"], table.setdefault("limits", {}).setdefault("accel_mps2", [accel_mps2] * 3)
    scales = plant.get("accel_per_input") or [1.0] * len(index)
    for side, sign in (("lower", -1.0), ("upper", 1.0)):
        limits = list(sets.get(f"input_{side}", [sign * accel_mps2 / abs(scale) for scale in scales]))
        for axis_number, axis in enumerate(index):
            if axis != "down":
                limits[axis_number] = sign * accel_mps2 / abs(scales[axis_number])
                _add_written(written, "room.accel_mps2", f"sets.input_{side}[{axis_number}]")
        sets[f"input_{side}"] = limits
    table["limits"]["accel_mps2"] = [
        accel_limits[axis_number] if axis == "down" else accel_mps2 for axis_number, axis in enumerate(AXES)
    ]


def _rescale_position(
    table: dict[str, Any],
    key: str,
    old_limits: Mapping[str, tuple[float, float]],
    new_limits: Mapping[str, tuple[float, float]],
) -> None:
    """Keep a place of the base where it was as a share of the room."""
    position_m = table.get(key)
    if not position_m:
        return
    new_position_m = list(position_m)
    for axis, (low, high) in old_limits.items():
        new_span, i = new_limits[axis], AXES.index(axis)
        if new_span != (low, high) and all(map(math.isfinite, (low, high, *new_span))) and low < high:
            new_position_m[i] = round(
                new_span[0] + (position_m[i] - low) / (high - low) * (new_span[1] - new_span[0]), 3
            )
    table[key] = new_position_m
