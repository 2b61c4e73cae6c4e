"""`base` and `[room]`: a preset as the rest of a configuration, and its limits by name in place of lists.

Both are read before anything is decoded, and what they say is written into the keys that they stand for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from msgspec import Meta

from uavctl.config.defaults import AXES, places
from uavctl.config.document import ConfigProblem, Number, Section

Span = tuple[Number, Number] | None
Size = Annotated[float, Meta(gt=0, le=1000)] | None
# Keys of lists that [room] writes: they are given by name or as lists, not both.
WRITTEN = ("sets", "target.position_m", "limits.accel_mps2")


class RoomConfig(Section, frozen=True, kw_only=True):
    """Limits of the vehicle's centre and its target by name, in place of `[sets]`, `[target]` and their lists."""

    north_m: Annotated[Span, Meta(description="least and largest position north [m]")] = None
    east_m: Annotated[Span, Meta(description="least and largest position east [m]")] = None
    height_m: Annotated[Span, Meta(description="least and largest height above the origin, up is positive [m]")] = None
    speed_mps: Annotated[Size, Meta(description="largest speed north, and east [m/s]")] = None
    climb_mps: Annotated[Size, Meta(description="largest speed up and down [m/s]")] = None
    accel_mps2: Annotated[Size, Meta(description="largest acceleration setpoint north, and east [m/s²]")] = None
    target_north_m: Annotated[Number | None, Meta(description="target [m]; without it where the base has it")] = None
    target_east_m: Annotated[Number | None, Meta(description="target [m]; without it where the base has it")] = None
    target_height_m: Annotated[Number | None, Meta(description="target [m]; without it where the base has it")] = None


_OF_AXIS = {
    "north": ("north_m", "speed_mps", "target_north_m"),
    "east": ("east_m", "speed_mps", "target_east_m"),
    "down": ("height_m", "climb_mps", "target_height_m"),
}


def merge(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """A document with the keys of a base that it does not have, table by table."""
    merged = dict(base)
    for key, value in own.items():
        below = merged.get(key)
        both = isinstance(value, dict) and isinstance(below, dict)
        merged[key] = merge(below, value) if both else value  # type: ignore[arg-type]
    return merged


def furnish(
    table: dict[str, Any], room: RoomConfig, own: Mapping[str, Any], written: dict[str, str]
) -> Iterator[ConfigProblem]:
    """Write what [room] says into the lists of a document; yield what cannot be.

    Args:
        table: The document, with what its base says.
        own: The document without it.
        written: The key of [room] that each key is written for is added here.
    """
    for name in ("north_m", "east_m", "height_m"):
        span = getattr(room, name)
        if span is not None and not span[0] < span[1]:
            yield ConfigProblem(f"room.{name}", f"{span[0]:g} is not below {span[1]:g}", "give the smaller one first")
            return
    plant = table.get("plant", {})
    index = places(plant) if isinstance(plant, dict) else {}
    if not index:
        yield ConfigProblem("room", "there is no plant with axes that it could limit", "add base, or [plant] with axes")
        return
    speeds = [i + 1 for i in index.values()] if plant.get("model") != "matrices" else plant.get("velocity_index", [])
    sets = table.setdefault("sets", {})
    lower, upper = (
        _list(sets, "state_lower", -math.inf, plant, index),
        _list(sets, "state_upper", math.inf, plant, index),
    )
    before = {axis: (lower[i], upper[i]) for axis, i in index.items()}
    for place, (axis, i) in enumerate(index.items()):
        of_span, of_speed, _ = _OF_AXIS[axis]
        span, speed = getattr(room, of_span), getattr(room, of_speed)
        if span is not None:
            lower[i], upper[i] = span if axis != "down" else (0.0 - span[1], 0.0 - span[0])
            _note(written, f"room.{of_span}", f"sets.state_lower[{i}]", f"sets.state_upper[{i}]")
        if speed is not None and place < len(speeds):
            lower[speeds[place]], upper[speeds[place]] = -speed, speed
            _note(written, f"room.{of_speed}", *(f"sets.state_{side}[{speeds[place]}]" for side in ("lower", "upper")))
    sets["state_lower"], sets["state_upper"] = lower, upper
    if room.accel_mps2 is not None:
        _limit_inputs(table, plant, index, room.accel_mps2, written)
    after = {axis: (lower[i], upper[i]) for axis, i in index.items()}
    _move(table.setdefault("target", {}), "position_m", before, after)
    target = table["target"].get("position_m")
    for axis in index:
        name = _OF_AXIS[axis][2]
        value = getattr(room, name)
        if value is not None:
            target = target or [0.0, 0.0, 0.0]
            target[AXES.index(axis)] = 0.0 - value if axis == "down" else value
            _note(written, f"room.{name}", f"target.position_m[{AXES.index(axis)}]")
    if target:
        table["target"]["position_m"] = target
    else:
        del table["target"]
    if "start_position_m" not in own.get("sim", {}):
        _move(table.setdefault("sim", {}), "start_position_m", before, after)


def _note(written: dict[str, str], by: str, *keys: str) -> None:
    written.update(dict.fromkeys(keys, by))


def _list(
    sets: Mapping[str, Any], key: str, otherwise: float, plant: Mapping[str, Any], index: Mapping[str, int]
) -> list[float]:
    """The limits of a base, or as many open ones as there are states."""
    each = {"drag-lag": 3, "velocity-reference": 6}.get(str(plant.get("model")), 0)
    return list(sets.get(key, [otherwise] * (each * len(index) or len(plant.get("a", ())))))


def _limit_inputs(
    table: dict[str, Any],
    plant: Mapping[str, Any],
    index: Mapping[str, int],
    accel_mps2: float,
    written: dict[str, str],
) -> None:
    """Limit the inputs of the level axes, and the last gate's setpoints along them."""
    sets, gate = table["sets"], table.setdefault("limits", {}).setdefault("accel_mps2", [accel_mps2] * 3)
    scales = plant.get("accel_per_input") or [1.0] * len(index)
    for side, sign in (("lower", -1.0), ("upper", 1.0)):
        limits = list(sets.get(f"input_{side}", [sign * accel_mps2 / abs(scale) for scale in scales]))
        for place, axis in enumerate(index):
            if axis != "down":
                limits[place] = sign * accel_mps2 / abs(scales[place])
                _note(written, "room.accel_mps2", f"sets.input_{side}[{place}]")
        sets[f"input_{side}"] = limits
    table["limits"]["accel_mps2"] = [gate[place] if axis == "down" else accel_mps2 for place, axis in enumerate(AXES)]


def _move(
    table: dict[str, Any], key: str, before: Mapping[str, tuple[float, float]], after: Mapping[str, tuple[float, float]]
) -> None:
    """Keep a place of the base where it was as a share of the room."""
    place = table.get(key)
    if not place:
        return
    moved = list(place)
    for axis, (low, high) in before.items():
        new, i = after[axis], AXES.index(axis)
        if new != (low, high) and all(map(math.isfinite, (low, high, *new))) and low < high:
            moved[i] = round(new[0] + (place[i] - low) / (high - low) * (new[1] - new[0]), 3)
    table[key] = moved
