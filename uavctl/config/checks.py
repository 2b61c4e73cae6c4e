"""Checks of a configuration that no single key's type can make: shapes, orders, fits.

Each check takes sections that were decoded and yields every problem that it finds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from uavctl.config import connections as peer_checks
from uavctl.config import connections as security
from uavctl.config import sim as sim_checks
from uavctl.config import types as log
from uavctl.config.connections import DaemonConfig
from uavctl.config.document import LARGEST, ConfigProblem, Floats, Open, Position, Rows, Section
from uavctl.config.link import LONGEST_DELAY_S, LinkConfig
from uavctl.config.mission import FenceConfig, MissionConfig, TrajectoryConfig
from uavctl.config.types import (
    PLANNED_HORIZON,
    Config,
    CostConfig,
    EstimatorConfig,
    LimitsConfig,
    PlantConfig,
    ScheduleConfig,
    SetsConfig,
    SmpcConfig,
    SolverConfig,
    TargetConfig,
)
from uavctl.frames import suggest_height_sign

# Checks of a mission and its fences: lengths, times, and whether the places are inside the limits.


MOST_STEPS = 50_000  # of a motion, each of which is made before the flight
_AXES = ("north", "east", "down")


def position_index(plant: PlantConfig) -> tuple[int, ...]:
    """State index of each axis' position."""
    size = plant.states_per_axis
    return tuple(range(0, size * len(plant.axes), size)) if size else plant.position_index


def position_limits_m(config: Config) -> dict[str, tuple[float, float]]:
    """Return the least and the largest position along each axis that the plant has [m]; infinite without a wall."""
    plant, sets = config.plant, config.sets
    places = position_index(plant)
    return {axis: (sets.state_lower[i], sets.state_upper[i]) for axis, i in zip(plant.axes, places, strict=True)}


def outside(plant: PlantConfig, sets: SetsConfig, place: Position, key: str, what: str) -> Iterator[ConfigProblem]:
    """Coordinates of a place that are outside the limits of the position."""
    for axis, i in zip(plant.axes, position_index(plant), strict=False):
        if not 0 <= i < min(len(sets.state_lower), len(sets.state_upper)):
            continue  # a problem of its own
        low, high = sets.state_lower[i], sets.state_upper[i]
        value = place[_AXES.index(axis)]
        if not low <= value <= high:
            yield ConfigProblem(
                f"{key}[{_AXES.index(axis)}]",
                f"{axis} {value:g} m is outside the admissible box [{low:g}, {high:g}]",
                suggest_height_sign(axis, value, low, high)
                or f"move the {what} inside, or widen sets.state_lower and sets.state_upper",
            )


def mission(plant: PlantConfig, sets: SetsConfig, given: MissionConfig) -> Iterator[ConfigProblem]:
    """Problems of `[mission]`."""
    motion = given.trajectory
    moves = bool(motion.times_s or motion.positions_m or motion.velocities_mps)
    if given.waypoints and moves:
        yield ConfigProblem("mission.waypoints", "there is a trajectory as well", "give waypoints or a trajectory")
    if isinstance(given.hold_s, tuple) and len(given.hold_s) != len(given.waypoints):
        yield ConfigProblem(
            "mission.hold_s",
            f"has {len(given.hold_s)} entries, there are {len(given.waypoints)} waypoints",
            "give one number, or one for each waypoint",
        )
    if given.then == "land" and not given.waypoints and not moves:
        yield ConfigProblem(
            "mission.then",
            '"land" has no end to come after: the target is held',
            "give waypoints or a trajectory; one waypoint with a hold_s will do",
        )
    holds = given.hold_s if isinstance(given.hold_s, tuple) else (given.hold_s,)
    if min(holds, default=0.0) < 0:
        yield ConfigProblem("mission.hold_s", "a time is negative", "give numbers >= 0")
    for i, place in enumerate(given.waypoints):
        yield from outside(plant, sets, place, f"mission.waypoints[{i}]", "waypoint")
    if moves:
        yield from _trajectory(plant, sets, motion)


def _trajectory(plant: PlantConfig, sets: SetsConfig, motion: TrajectoryConfig) -> Iterator[ConfigProblem]:
    key, count = "mission.trajectory", len(motion.times_s)
    if count < 2:
        yield ConfigProblem(f"{key}.times_s", f"has {count} entries, a motion has at least 2", "add samples")
    yield from _increasing(f"{key}.times_s", motion.times_s)
    steps = max(motion.times_s, default=0.0) / plant.dt_s
    if steps > MOST_STEPS:
        yield ConfigProblem(
            f"{key}.times_s",
            f"the last one is {steps:.3g} steps of plant.dt_s = {plant.dt_s:g} s ahead",
            f"give a motion of at most {MOST_STEPS} steps",
        )
    for name in ("positions_m", "velocities_mps"):
        entries = len(getattr(motion, name))
        if entries != count and (entries or name == "positions_m"):
            yield ConfigProblem(
                f"{key}.{name}", f"has {entries} entries, there are {count} times", "give one for each time"
            )
    if motion.velocities_mps and motion.interpolation == "linear":
        yield ConfigProblem(
            f"{key}.velocities_mps",
            'has no meaning with interpolation "linear"',
            'remove it, or use interpolation "cubic"',
        )
    for i, place in enumerate(motion.positions_m):
        yield from outside(plant, sets, place, f"{key}.positions_m[{i}]", "trajectory")


def fences(plant: PlantConfig, sets: SetsConfig, given: Sequence[FenceConfig]) -> Iterator[ConfigProblem]:
    """Problems of `[[fence]]`."""
    for number, fence in enumerate(given):
        key = f"fence[{number}]"
        yield from _increasing(f"{key}.times_s", fence.times_s)
        if len(fence.values) != len(fence.times_s):
            yield ConfigProblem(
                f"{key}.values",
                f"has {len(fence.values)} entries, there are {len(fence.times_s)} times",
                "give one for each time",
            )
        state = fence.state
        if isinstance(state, str):
            if state not in plant.axes:
                yield ConfigProblem(
                    f"{key}.state",
                    f'"{state}" is no axis of the plant',
                    f"give one of {', '.join(plant.axes)}, or the index of a state",
                )
                continue
            state = position_index(plant)[plant.axes.index(state)] if position_index(plant) else 0
        yield from _tightens(key, sets, fence, state)


def _tightens(key: str, sets: SetsConfig, fence: FenceConfig, state: int) -> Iterator[ConfigProblem]:
    """Check that a fence stands inside the constant limits."""
    if not 0 <= state < min(len(sets.state_lower), len(sets.state_upper)):
        count = len(sets.state_lower)
        yield ConfigProblem(f"{key}.state", f"there is no state {state}", f"give 0 to {count - 1}")
        return
    sides = {"lower": sets.state_lower[state], "upper": sets.state_upper[state]}
    opposite = "lower" if fence.side == "upper" else "upper"
    inwards = 1.0 if fence.side == "lower" else -1.0
    for i, value in enumerate(fence.values):
        if inwards * (value - sides[fence.side]) < 0:
            yield ConfigProblem(
                f"{key}.values[{i}]",
                f"{value:g} is beyond sets.state_{fence.side}[{state}] = {sides[fence.side]:g}",
                "a fence may only close in; widen the constant limit",
            )
        elif inwards * (value - sides[opposite]) >= 0:
            yield ConfigProblem(
                f"{key}.values[{i}]",
                f"{value:g} as {fence.side} limit leaves nothing up to sets.state_{opposite}[{state}] = "
                f"{sides[opposite]:g}",
                f"give a value {'below' if opposite == 'upper' else 'above'} it",
            )


def _increasing(key: str, times_s: Floats) -> Iterator[ConfigProblem]:
    if times_s and times_s[0] < 0:
        yield ConfigProblem(f"{key}[0]", f"begins at {times_s[0]:g} s, before the mission does", "give times >= 0")
    for i, (now, then) in enumerate(pairwise(times_s)):
        if not now < then:
            yield ConfigProblem(f"{key}[{i + 1}]", f"{then:g} s is not after {now:g} s", "give increasing times")


def solver(given: SolverConfig, told: MissionConfig) -> Iterator[ConfigProblem]:
    """Check that no trajectory is given to the printed problem, which cannot follow one."""
    if given.method == "printed" and told.trajectory.times_s:
        yield ConfigProblem("solver.method", '"printed" follows no trajectory', 'use "exact"')


def solver_fences(given: SolverConfig, told: Sequence[FenceConfig]) -> Iterator[ConfigProblem]:
    """Check that no moving limits are given to the printed problem, which cannot keep them."""
    if given.method == "printed" and told:
        yield ConfigProblem("solver.method", '"printed" knows no limits that move', 'use "exact"')


_OF_AXES: tuple[str, ...] = ("position_index", "velocity_index", "accel_per_input")
_MATRIX_KEYS: tuple[str, ...] = ("a", "b", "e", "w", *_OF_AXES)
_DRAG_LAG_KEYS: tuple[str, ...] = ("drag_1ps", "lag_s", "gain", "wind_std_mps2")
_REFERENCE_KEYS: tuple[str, ...] = (
    "drag_1ps",
    "lag_s",
    "position_1ps",
    "velocity_1ps",
    "integral_1ps2",
    "wind_std_mps2",
    "input_std_mps2",
    "force_drift_mps2_rts",
)
_KEYS = {"matrices": _MATRIX_KEYS, "drag-lag": _DRAG_LAG_KEYS, "velocity-reference": _REFERENCE_KEYS}
_POSITIVE = ("lag_s", "gain", "position_1ps", "velocity_1ps", "integral_1ps2", "input_std_mps2")
_SUM = 1e-4  # shares are written rounded
_TICKS_TRIED = 10_000
_RELATIVE = 1e-9  # asymmetry and negative eigenvalues below this share of W's size are rounding


def dimensions(plant: PlantConfig) -> tuple[int, int]:
    """(n_x, n_u) that the other sections must fit; a plant without axes has as many inputs as B has columns."""
    n_u = len(plant.axes) or (len(plant.b[0]) if plant.b else 0)
    return (plant.states_per_axis * n_u or len(plant.a)), n_u


def check(sections: Mapping[str, Section | tuple[Section, ...]]) -> Iterator[ConfigProblem]:
    """All problems among the sections that are there (a section that is not decoded is left out)."""
    for names, check_one in _CHECKS:
        if all(name in sections for name in names):
            yield from check_one(*(sections[name] for name in names))


def _length(key: str, values: Open | tuple[int, ...], wanted: int, meaning: str) -> Iterator[ConfigProblem]:
    if len(values) != wanted:
        yield ConfigProblem(key, f"has {len(values)} entries, {meaning} = {wanted}", f"give {wanted} numbers")


def _shape(key: str, rows: Rows, wanted: tuple[int, int], meaning: str) -> Iterator[ConfigProblem]:
    lengths = {len(row) for row in rows}
    todo = f"give {wanted[0]} rows of {wanted[1]} numbers"
    if len(lengths) > 1:
        yield ConfigProblem(key, f"rows have different lengths ({', '.join(map(str, sorted(lengths)))})", todo)
        return
    shape = (len(rows), lengths.pop() if lengths else 0)
    if shape != wanted:
        yield ConfigProblem(key, f"is {shape[0]} x {shape[1]}, {meaning} = {wanted[0]} x {wanted[1]}", todo)


def _plant(plant: PlantConfig) -> Iterator[ConfigProblem]:
    if list(plant.axes) != sorted(set(plant.axes), key=_AXES.index):
        yield ConfigProblem(
            "plant.axes", f"{list(plant.axes)} repeats or turns round axes", "keep the order north, east, down"
        )
    wanted = _KEYS[plant.model]
    if not plant.axes:
        named = [key for key in _OF_AXES if getattr(plant, key)]
        if plant.model != "matrices" or named:
            asks = f"plant.{named[0]}" if named else f'model "{plant.model}"'
            yield ConfigProblem(
                "plant.axes", f"is missing, and {asks} needs it", 'add it, as in ["north", "east", "down"]'
            )
            return
        wanted = tuple(key for key in wanted if key not in _OF_AXES)
    foreign = dict.fromkeys(key for keys in _KEYS.values() for key in keys if key not in wanted)
    missing = [key for key in wanted if not getattr(plant, key)]
    if plant.model == "matrices" and {*missing} >= {*_OF_AXES}:  # one thing is missing: what the states are
        yield ConfigProblem(
            "plant.axes",
            f"is given without {', '.join(_OF_AXES)}, which say how the plant moves along them",
            "add them, or remove plant.axes: then the plant is planned for and simulated, and flies nowhere",
        )
        return
    for key in missing:
        yield ConfigProblem(f"plant.{key}", f'is missing, and model "{plant.model}" needs it', "add it")
    for key in foreign:
        if key not in _KEYS[plant.model] and getattr(plant, key):
            yield ConfigProblem(
                f"plant.{key}", f'has no meaning with model "{plant.model}"', "remove it, or change the model"
            )
    if not missing:
        yield from _matrices(plant) if plant.model == "matrices" else _each_axis(plant, wanted)


def _matrices(plant: PlantConfig) -> Iterator[ConfigProblem]:
    n_x, n_u = dimensions(plant)
    n_w = len(plant.w)
    yield from _shape("plant.a", plant.a, (n_x, n_x), "n_x x n_x")
    yield from _shape("plant.b", plant.b, (n_x, n_u), "n_x x number of axes")
    yield from _shape("plant.e", plant.e, (n_x, n_w), "n_x x n_w")
    wrong_w = list(_shape("plant.w", plant.w, (n_w, n_w), "n_w x n_w"))
    yield from wrong_w or _covariance(plant.w)
    if not plant.axes:
        return
    for key in ("position_index", "velocity_index"):
        index = getattr(plant, key)
        yield from _length(f"plant.{key}", index, n_u, "number of axes")
        if any(not 0 <= i < n_x for i in index):
            yield ConfigProblem(
                f"plant.{key}", f"{list(index)} names a state that is not there", f"give 0 to {n_x - 1}"
            )
    both = plant.position_index + plant.velocity_index
    if len(set(both)) < len(both):
        yield ConfigProblem(
            "plant.velocity_index", "a state is named twice", "give each position and velocity its own state"
        )
    yield from _length("plant.accel_per_input", plant.accel_per_input, n_u, "number of axes")
    if 0.0 in plant.accel_per_input:
        yield ConfigProblem(
            "plant.accel_per_input", "is 0 for an axis, which nothing could steer", "give a number other than 0"
        )


def _covariance(w: Rows) -> Iterator[ConfigProblem]:
    matrix = np.array(w)
    size = float(np.abs(matrix).max(initial=0.0))
    if float(np.abs(matrix - matrix.T).max(initial=0.0)) > _RELATIVE * size:
        yield ConfigProblem("plant.w", "is not symmetric", "a covariance has W[i][j] = W[j][i]")
        return
    smallest = float(np.linalg.eigvalsh(matrix).min(initial=0.0))
    if smallest < -_RELATIVE * size:
        yield ConfigProblem(
            "plant.w",
            f"is not positive semidefinite (smallest eigenvalue {smallest:.4g})",
            "give a covariance matrix: variances on the diagonal, covariances at most their geometric mean",
        )


def _each_axis(plant: PlantConfig, keys: tuple[str, ...]) -> Iterator[ConfigProblem]:
    n_u = len(plant.axes)
    for key in keys:
        values = getattr(plant, key)
        yield from _length(f"plant.{key}", values, n_u, "number of axes")
        positive = key in _POSITIVE
        if any(value <= 0 if positive else value < 0 for value in values):
            yield ConfigProblem(
                f"plant.{key}", f"{list(values)} is out of range", f"give numbers {'> 0' if positive else '>= 0'}"
            )


def _sets(plant: PlantConfig, sets: SetsConfig) -> Iterator[ConfigProblem]:
    for kind, size, name in zip(("state", "input"), dimensions(plant), ("n_x", "number of axes"), strict=True):
        lower, upper = getattr(sets, f"{kind}_lower"), getattr(sets, f"{kind}_upper")
        yield from _length(f"sets.{kind}_lower", lower, size, name)
        yield from _length(f"sets.{kind}_upper", upper, size, name)
        for i, (low, high) in enumerate(zip(lower, upper, strict=False)):
            for name, side in ((f"sets.{kind}_lower[{i}]", low), (f"sets.{kind}_upper[{i}]", high)):
                if math.isfinite(side) and abs(side) > LARGEST:
                    yield ConfigProblem(
                        name, f"{side:g} is beyond {LARGEST:g}", "give a smaller number, or inf for no limit"
                    )
            if not low < high:
                yield ConfigProblem(
                    f"sets.{kind}_lower[{i}]",
                    f"lower limit {low:g} is not below sets.{kind}_upper[{i}] = {high:g}",
                    "give a lower limit below the upper one",
                )


def _cost(plant: PlantConfig, cost: CostConfig) -> Iterator[ConfigProblem]:
    n_x, n_u = dimensions(plant)
    yield from _length("cost.state", cost.state, n_x, "n_x")
    yield from _length("cost.input", cost.input, n_u, "number of axes")
    if any(weight <= 0 for weight in cost.input):
        yield ConfigProblem(
            "cost.input", "a weight is not positive, so the cost is not strictly convex", "give numbers > 0"
        )


def _smpc(plant: PlantConfig, smpc: SmpcConfig) -> Iterator[ConfigProblem]:
    n_x, n_u = dimensions(plant)
    if smpc.conditioned or smpc.tau is None or smpc.k_tau is None:
        return
    if smpc.horizon > PLANNED_HORIZON:
        yield ConfigProblem(
            "smpc.horizon",
            f"{smpc.horizon} steps are more than planned feedback is solved for, {PLANNED_HORIZON}",
            'shorten it, or set smpc.scheme = "age-conditioned"',
        )
    yield from _shape("smpc.k_tau", smpc.k_tau, (n_u, n_x), "number of axes x n_x")
    if smpc.tau >= smpc.horizon:
        yield ConfigProblem(
            "smpc.tau",
            f"{smpc.tau} steps do not fit into the horizon of {smpc.horizon}",
            "give a tau below smpc.horizon, or a longer horizon",
        )


def _schedule(plant: PlantConfig, smpc: SmpcConfig, schedule: ScheduleConfig) -> Iterator[ConfigProblem]:
    n_x, _ = dimensions(plant)
    if smpc.conditioned:
        return
    delays = schedule.delays
    if schedule.rule == "fixed":
        if isinstance(delays, tuple):
            yield from _length("schedule.delays", delays, smpc.horizon, "smpc.horizon")
        if any(delay < 1 for delay in (delays if isinstance(delays, tuple) else (delays,))):
            yield ConfigProblem(
                "schedule.delays",
                "a delay is below 1 step: feedback on what has not happened yet",
                'give whole numbers >= 1, or rule = "search" or "greedy"',
            )
    if schedule.rule == "search" and not schedule.search_states:
        yield ConfigProblem(
            "schedule.search_states", 'is missing, and rule "search" needs it', f"add states of {n_x} numbers each"
        )
    for i, state in enumerate(schedule.search_states):
        yield from _length(f"schedule.search_states[{i}]", state, n_x, "n_x")


def _target(plant: PlantConfig, sets: SetsConfig, target: TargetConfig) -> Iterator[ConfigProblem]:
    yield from outside(plant, sets, target.position_m, "target.position_m", "target")


def _link(link: LinkConfig) -> Iterator[ConfigProblem]:
    if link.model == "empirical":
        yield from _gaps(link.gaps)
    if link.model == "trace":
        yield from _trace(link.trace_s)
    if link.probability and link.probability[-1] == 0.0:
        yield ConfigProblem(
            "link.probability",
            "ends in 0, which is repeated: nothing arrives for ever",
            "add the probability that goes on; use link.blackout to test an outage",
        )
    for name in ("blackout", "held", "uplink_blackout"):
        yield from sim_checks.spans(f"link.{name}", getattr(link, name))


def _gaps(gaps: Open) -> Iterator[ConfigProblem]:
    todo = "give the shares of the measured runs of 0, 1, 2 … lost packets"
    if not gaps:
        yield ConfigProblem("link.gaps", 'is missing, and model "empirical" needs it', todo)
    elif abs(math.fsum(gaps) - 1.0) > _SUM:
        yield ConfigProblem(
            "link.gaps", f"the entries add up to {math.fsum(gaps):.6g}, probabilities of all runs to 1", todo
        )


def _trace(delays: Open) -> Iterator[ConfigProblem]:
    if not delays:
        yield ConfigProblem("link.trace_file", 'is missing, and model "trace" needs it', "give a file, or link.trace_s")
    elif all(math.isinf(delay) for delay in delays):
        yield ConfigProblem("link.trace_s", "every packet is lost", "give a trace in which some arrive")
    for i, delay in enumerate(delays):
        if not (0.0 <= delay <= LONGEST_DELAY_S or math.isinf(delay)) or delay < 0.0:
            yield ConfigProblem(
                f"link.trace_s[{i}]",
                f"{delay:g} is not a delay",
                f"give seconds, at most {LONGEST_DELAY_S:g}, or inf for a lost packet",
            )


def _tick(plant: PlantConfig, daemon: DaemonConfig) -> Iterator[ConfigProblem]:
    tick_ns, dt_ns = round(daemon.tick_s * 1e9), round(plant.dt_s * 1e9)
    if tick_ns < 1 or dt_ns % tick_ns:
        least = math.ceil(dt_ns / max(tick_ns, 1))
        count = next((n for n in range(least, least + _TICKS_TRIED) if dt_ns % n == 0), least)
        yield ConfigProblem(
            "daemon.tick_s",
            f"{daemon.tick_s:g} s does not divide plant.dt_s = {plant.dt_s:g} s",
            f"give plant.dt_s / n with a whole n, for example {plant.dt_s / count:g}",
        )


def _limits(limits: LimitsConfig) -> Iterator[ConfigProblem]:
    if any(limit <= 0 for limit in limits.accel_mps2):
        yield ConfigProblem("limits.accel_mps2", "a limit is not positive", "give numbers > 0")


_CheckFunction = Callable[..., Iterator[ConfigProblem]]


def _bias(plant: PlantConfig, sets: SetsConfig, estimator: EstimatorConfig) -> Iterator[ConfigProblem]:
    if plant.model == "velocity-reference" and estimator.bias_drift:
        yield ConfigProblem(
            "estimator.bias_drift",
            'an unknown part of the input is not what disturbs model "velocity-reference": its loops hold it',
            "set bias_drift and bias_max to 0, and plant.force_drift_mps2_rts in their place",
        )
    if (estimator.bias_drift > 0.0) != (estimator.bias_max > 0.0):
        missing = "bias_max" if estimator.bias_drift else "bias_drift"
        yield ConfigProblem(
            f"estimator.{missing}",
            "is 0, and the other one of bias_drift and bias_max is not",
            "give both, or neither for a filter without a bias",
        )
    for i, (low, high) in enumerate(zip(sets.input_lower, sets.input_upper, strict=False)):
        if high - low <= 2.0 * estimator.bias_max:
            yield ConfigProblem(
                "estimator.bias_max",
                f"{estimator.bias_max:g} on either side leaves nothing of input {i}, {low:g} to {high:g}",
                f"give less than {0.5 * (high - low):g}, or wider sets.input_lower and input_upper",
            )


_CHECKS: tuple[tuple[tuple[str, ...], _CheckFunction], ...] = (
    (("plant",), _plant),
    (("plant", "sets"), _sets),
    (("plant", "cost"), _cost),
    (("plant", "smpc"), _smpc),
    (("plant", "smpc", "schedule"), _schedule),
    (("plant", "sets", "target"), _target),
    (("link",), _link),
    (("plant", "daemon"), _tick),
    (("limits",), _limits),
    (("plant", "sets", "estimator"), _bias),
    (("security",), security.check),
    (("daemon",), peer_checks.roles),
    (("daemon", "source"), peer_checks.source),
    (("daemon", "security"), peer_checks.signing),
    (("log",), log.check),
    (("sim",), sim_checks.sim),
    (("sim", "daemon"), sim_checks.ids),
    (("plant", "sets", "mission"), mission),
    (("plant", "sets", "fence"), fences),
    (("solver", "mission"), solver),
    (("solver", "fence"), solver_fences),
)
