"""Checks of a mission and its fences: lengths, times, and whether the places are inside the limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from uavctl.config.mission import FenceConfig, MissionConfig, TrajectoryConfig
from uavctl.config.problem import Problem
from uavctl.config.section import Floats, Position
from uavctl.config.types import PlantConfig, SetsConfig, SolverConfig

MOST_STEPS = 50_000  # of a motion, each of which is made before the flight
_AXES = ("north", "east", "down")


def position_index(plant: PlantConfig) -> tuple[int, ...]:
    """State index of each axis' position."""
    size = plant.states_per_axis
    return tuple(range(0, size * len(plant.axes), size)) if size else plant.position_index


def outside(plant: PlantConfig, sets: SetsConfig, place: Position, key: str, what: str) -> Iterator[Problem]:
    """Coordinates of a place that are outside the limits of the position."""
    for axis, i in zip(plant.axes, position_index(plant), strict=False):
        if not 0 <= i < min(len(sets.state_lower), len(sets.state_upper)):
            continue  # a problem of its own
        low, high = sets.state_lower[i], sets.state_upper[i]
        value = place[_AXES.index(axis)]
        if not low <= value <= high:
            yield Problem(
                f"{key}[{_AXES.index(axis)}]",
                f"{axis} {value:g} m is outside the admissible box [{low:g}, {high:g}]",
                f"move the {what} inside, or widen sets.state_lower and sets.state_upper",
            )


def mission(plant: PlantConfig, sets: SetsConfig, given: MissionConfig) -> Iterator[Problem]:
    """Problems of `[mission]`."""
    motion = given.trajectory
    moves = bool(motion.times_s or motion.positions_m or motion.velocities_mps)
    if given.waypoints and moves:
        yield Problem("mission.waypoints", "there is a trajectory as well", "give waypoints or a trajectory")
    if isinstance(given.hold_s, tuple) and len(given.hold_s) != len(given.waypoints):
        yield Problem(
            "mission.hold_s",
            f"has {len(given.hold_s)} entries, there are {len(given.waypoints)} waypoints",
            "give one number, or one for each waypoint",
        )
    if given.then == "land" and not given.waypoints and not moves:
        yield Problem(
            "mission.then",
            '"land" has no end to come after: the target is held',
            "give waypoints or a trajectory; one waypoint with a hold_s will do",
        )
    holds = given.hold_s if isinstance(given.hold_s, tuple) else (given.hold_s,)
    if min(holds, default=0.0) < 0:
        yield Problem("mission.hold_s", "a time is negative", "give numbers >= 0")
    for i, place in enumerate(given.waypoints):
        yield from outside(plant, sets, place, f"mission.waypoints[{i}]", "waypoint")
    if moves:
        yield from _trajectory(plant, sets, motion)


def _trajectory(plant: PlantConfig, sets: SetsConfig, motion: TrajectoryConfig) -> Iterator[Problem]:
    key, count = "mission.trajectory", len(motion.times_s)
    if count < 2:
        yield Problem(f"{key}.times_s", f"has {count} entries, a motion has at least 2", "add samples")
    yield from _increasing(f"{key}.times_s", motion.times_s)
    steps = max(motion.times_s, default=0.0) / plant.dt_s
    if steps > MOST_STEPS:
        yield Problem(
            f"{key}.times_s",
            f"the last one is {steps:.3g} steps of plant.dt_s = {plant.dt_s:g} s ahead",
            f"give a motion of at most {MOST_STEPS} steps",
        )
    for name in ("positions_m", "velocities_mps"):
        entries = len(getattr(motion, name))
        if entries != count and (entries or name == "positions_m"):
            yield Problem(f"{key}.{name}", f"has {entries} entries, there are {count} times", "give one for each time")
    if motion.velocities_mps and motion.interpolation == "linear":
        yield Problem(
            f"{key}.velocities_mps",
            'has no meaning with interpolation "linear"',
            'remove it, or use interpolation "cubic"',
        )
    for i, place in enumerate(motion.positions_m):
        yield from outside(plant, sets, place, f"{key}.positions_m[{i}]", "trajectory")


def fences(plant: PlantConfig, sets: SetsConfig, given: Sequence[FenceConfig]) -> Iterator[Problem]:
    """Problems of `[[fence]]`."""
    for number, fence in enumerate(given):
        key = f"fence[{number}]"
        yield from _increasing(f"{key}.times_s", fence.times_s)
        if len(fence.values) != len(fence.times_s):
            yield Problem(
                f"{key}.values",
                f"has {len(fence.values)} entries, there are {len(fence.times_s)} times",
                "give one for each time",
            )
        state = fence.state
        if isinstance(state, str):
            if state not in plant.axes:
                yield Problem(
                    f"{key}.state",
                    f'"{state}" is no axis of the plant',
                    f"give one of {', '.join(plant.axes)}, or the index of a state",
                )
                continue
            state = position_index(plant)[plant.axes.index(state)] if position_index(plant) else 0
        yield from _tightens(key, sets, fence, state)


def _tightens(key: str, sets: SetsConfig, fence: FenceConfig, state: int) -> Iterator[Problem]:
    """A fence stands inside the constant limits."""
    if not 0 <= state < min(len(sets.state_lower), len(sets.state_upper)):
        count = len(sets.state_lower)
        yield Problem(f"{key}.state", f"there is no state {state}", f"give 0 to {count - 1}")
        return
    sides = {"lower": sets.state_lower[state], "upper": sets.state_upper[state]}
    opposite = "lower" if fence.side == "upper" else "upper"
    inwards = 1.0 if fence.side == "lower" else -1.0
    for i, value in enumerate(fence.values):
        if inwards * (value - sides[fence.side]) < 0:
            yield Problem(
                f"{key}.values[{i}]",
                f"{value:g} is beyond sets.state_{fence.side}[{state}] = {sides[fence.side]:g}",
                "a fence may only close in; widen the constant limit",
            )
        elif inwards * (value - sides[opposite]) >= 0:
            yield Problem(
                f"{key}.values[{i}]",
                f"{value:g} as {fence.side} limit leaves nothing up to sets.state_{opposite}[{state}] = "
                f"{sides[opposite]:g}",
                f"give a value {'below' if opposite == 'upper' else 'above'} it",
            )


def _increasing(key: str, times_s: Floats) -> Iterator[Problem]:
    if times_s and times_s[0] < 0:
        yield Problem(f"{key}[0]", f"begins at {times_s[0]:g} s, before the mission does", "give times >= 0")
    for i, (now, then) in enumerate(pairwise(times_s)):
        if not now < then:
            yield Problem(f"{key}[{i + 1}]", f"{then:g} s is not after {now:g} s", "give increasing times")


def solver(given: SolverConfig, told: MissionConfig) -> Iterator[Problem]:
    """The printed problem knows no trajectory."""
    if given.method == "printed" and told.trajectory.times_s:
        yield Problem("solver.method", '"printed" follows no trajectory', 'use "library" or "exact"')


def solver_fences(given: SolverConfig, told: Sequence[FenceConfig]) -> Iterator[Problem]:
    """Nor does it know moving limits."""
    if given.method == "printed" and told:
        yield Problem("solver.method", '"printed" knows no limits that move', 'use "library" or "exact"')
