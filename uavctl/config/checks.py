"""Checks of a configuration that no single key's type can make: shapes, orders, fits.

Each check takes sections that were decoded and yields every problem that it finds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from uavctl.config.connections import DaemonConfig, check_roles, check_security, check_signing, check_source
from uavctl.config.document import MAX_NUMBER, ConfigProblem, Floats, Position, Rows, Section, UnboundedFloats
from uavctl.config.link import MAX_DELAY_S, LinkConfig
from uavctl.config.mission import FenceConfig, MissionConfig, TrajectoryConfig
from uavctl.config.sim import check_sim, check_spans, check_system_ids
from uavctl.config.types import (
    MAX_PLANNED_HORIZON,
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

MAX_STEPS = 50_000  # of a motion, each of which is made before the flight
_AXES = ("north", "east", "down")


def get_position_index(plant: PlantConfig) -> tuple[int, ...]:
    """State index of each axis' position."""
    size = plant.states_per_axis
    return tuple(range(0, size * len(plant.axes), size)) if size else plant.position_index


def get_position_limits_m(config: Config) -> dict[str, tuple[float, float]]:
    """Return the least and the largest position along each axis that the plant has [m]; infinite without a wall."""
    plant, sets = config.plant, config.sets
    indices = get_position_index(plant)
    return {axis: (sets.state_lower[i], sets.state_upper[i]) for axis, i in zip(plant.axes, indices, strict=True)}


_ROOM_KEYS = {"north": "room.north_m", "east": "room.east_m", "down": "room.height_m"}


def find_outside(
    plant: PlantConfig, sets: SetsConfig, position_m: Position, key: str, name: str
) -> Iterator[ConfigProblem]:
    """Coordinates of a place that are outside the limits of the position."""
    for axis, i in zip(plant.axes, get_position_index(plant), strict=False):
        if not 0 <= i < min(len(sets.state_lower), len(sets.state_upper)):
            continue  # reported separately
        low, high = sets.state_lower[i], sets.state_upper[i]
        value = position_m[_AXES.index(axis)]
        if not low <= value <= high:
            yield ConfigProblem(
                f"{key}[{_AXES.index(axis)}]",
                f"{axis} {value:g} m is outside the admissible box [{low:g}, {high:g}]",
                suggest_height_sign(axis, value, low, high)
                or f"move the {name} inside, or widen {_ROOM_KEYS[axis]} (without [room]: sets.state_lower and "
                "sets.state_upper)",
            )


def check_mission(plant: PlantConfig, sets: SetsConfig, mission: MissionConfig) -> Iterator[ConfigProblem]:
    """Problems of `[mission]`."""
    trajectory = mission.trajectory
    has_trajectory = bool(trajectory.times_s or trajectory.positions_m or trajectory.velocities_mps)
    if mission.waypoints and has_trajectory:
        yield ConfigProblem("mission.waypoints", "there is a trajectory as well", "give waypoints or a trajectory")
    if isinstance(mission.hold_s, tuple) and len(mission.hold_s) != len(mission.waypoints):
        yield ConfigProblem(
            "mission.hold_s",
            f"has {len(mission.hold_s)} entries, there are {len(mission.waypoints)} waypoints",
            "give one number, or one for each waypoint",
        )
    if mission.then == "land" and not mission.waypoints and not has_trajectory:
        yield ConfigProblem(
            "mission.then",
            '"land" has no end to come after: the target is held',
            "give waypoints or a trajectory; one waypoint with a hold_s is enough",
        )
    yield from _check_yaw(plant, mission)
    hold_times = mission.hold_s if isinstance(mission.hold_s, tuple) else (mission.hold_s,)
    if min(hold_times, default=0.0) < 0:
        yield ConfigProblem("mission.hold_s", "a time is negative", "give numbers >= 0")
    for i, waypoint in enumerate(mission.waypoints):
        yield from find_outside(plant, sets, waypoint, f"mission.waypoints[{i}]", "waypoint")
    if has_trajectory:
        yield from _check_trajectory(plant, sets, trajectory)


def _check_yaw(plant: PlantConfig, mission: MissionConfig) -> Iterator[ConfigProblem]:
    if mission.yaw == "angle" and mission.yaw_deg is None:
        yield ConfigProblem("mission.yaw", '"angle" has no angle', "give mission.yaw_deg")
    if mission.yaw != "angle" and mission.yaw_deg is not None:
        yield ConfigProblem(
            "mission.yaw_deg", f'mission.yaw is "{mission.yaw}"', 'set mission.yaw = "angle", or remove it'
        )
    if isinstance(mission.yaw_deg, tuple) and len(mission.yaw_deg) != len(mission.waypoints):
        yield ConfigProblem(
            "mission.yaw_deg",
            f"has {len(mission.yaw_deg)} entries, there are {len(mission.waypoints)} waypoints",
            "give one number, or one for each waypoint",
        )
    if mission.yaw == "path" and not {"north", "east"} <= set(plant.axes):
        yield ConfigProblem("mission.yaw", "the plant does not move north and east", 'give "hold" or "angle"')


def _check_trajectory(plant: PlantConfig, sets: SetsConfig, trajectory: TrajectoryConfig) -> Iterator[ConfigProblem]:
    key, count = "mission.trajectory", len(trajectory.times_s)
    if count < 2:
        yield ConfigProblem(f"{key}.times_s", f"has {count} entries, a motion has at least 2", "add samples")
    yield from _check_increasing(f"{key}.times_s", trajectory.times_s)
    steps = max(trajectory.times_s, default=0.0) / plant.dt_s
    if steps > MAX_STEPS:
        yield ConfigProblem(
            f"{key}.times_s",
            f"the last one is {steps:.3g} steps of plant.dt_s = {plant.dt_s:g} s ahead",
            f"give a motion of at most {MAX_STEPS} steps",
        )
    for name in ("positions_m", "velocities_mps"):
        entries = len(getattr(trajectory, name))
        if entries != count and (entries or name == "positions_m"):
            yield ConfigProblem(
                f"{key}.{name}", f"has {entries} entries, there are {count} times", "give one for each time"
            )
    if trajectory.velocities_mps and trajectory.interpolation == "linear":
        yield ConfigProblem(
            f"{key}.velocities_mps",
            'has no meaning with interpolation "linear"',
            'remove it, or use interpolation "cubic"',
        )
    for i, position_m in enumerate(trajectory.positions_m):
        yield from find_outside(plant, sets, position_m, f"{key}.positions_m[{i}]", "trajectory")
    for i, velocity_mps in enumerate(trajectory.velocities_mps):
        yield from _find_too_fast(plant, sets, velocity_mps, f"{key}.velocities_mps[{i}]")


def _find_too_fast(plant: PlantConfig, sets: SetsConfig, velocity_mps: Position, key: str) -> Iterator[ConfigProblem]:
    """Components of a velocity that are outside the limits of the velocity."""
    indices = tuple(i + 1 for i in get_position_index(plant)) if plant.states_per_axis else plant.velocity_index
    for axis, i in zip(plant.axes, indices, strict=False):
        if not 0 <= i < min(len(sets.state_lower), len(sets.state_upper)):
            continue  # reported separately
        low, high, number = sets.state_lower[i], sets.state_upper[i], _AXES.index(axis)
        if not low <= velocity_mps[number] <= high:
            yield ConfigProblem(
                f"{key}[{number}]",
                f"{axis} {velocity_mps[number]:g} m/s is outside the limits [{low:g}, {high:g}]",
                "fly the trajectory slower, or widen the limits of this velocity",
            )


def check_fences(plant: PlantConfig, sets: SetsConfig, fences: Sequence[FenceConfig]) -> Iterator[ConfigProblem]:
    """Problems of `[[fence]]`."""
    for number, fence in enumerate(fences):
        key = f"fence[{number}]"
        yield from _check_increasing(f"{key}.times_s", fence.times_s)
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
            state = get_position_index(plant)[plant.axes.index(state)] if get_position_index(plant) else 0
        yield from _check_fence_values(key, sets, fence, state)


def _check_fence_values(key: str, sets: SetsConfig, fence: FenceConfig, state: int) -> Iterator[ConfigProblem]:
    """Check that a fence stands inside the constant limits."""
    if not 0 <= state < min(len(sets.state_lower), len(sets.state_upper)):
        count = len(sets.state_lower)
        yield ConfigProblem(f"{key}.state", f"there is no state {state}", f"give 0 to {count - 1}")
        return
    sides = {"lower": sets.state_lower[state], "upper": sets.state_upper[state]}
    opposite = "lower" if fence.side == "upper" else "upper"
    inward_sign = 1.0 if fence.side == "lower" else -1.0
    for i, value in enumerate(fence.values):
        if inward_sign * (value - sides[fence.side]) < 0:
            yield ConfigProblem(
                f"{key}.values[{i}]",
                f"{value:g} is beyond sets.state_{fence.side}[{state}] = {sides[fence.side]:g}",
                "a fence may only close in; widen the constant limit",
            )
        elif inward_sign * (value - sides[opposite]) >= 0:
            yield ConfigProblem(
                f"{key}.values[{i}]",
                f"{value:g} as {fence.side} limit leaves nothing up to sets.state_{opposite}[{state}] = "
                f"{sides[opposite]:g}",
                f"give a value {'below' if opposite == 'upper' else 'above'} it",
            )


def _check_increasing(key: str, times_s: Floats) -> Iterator[ConfigProblem]:
    if times_s and times_s[0] < 0:
        yield ConfigProblem(f"{key}[0]", f"begins at {times_s[0]:g} s, before the mission does", "give times >= 0")
    for i, (time_s, next_s) in enumerate(pairwise(times_s)):
        if not time_s < next_s:
            yield ConfigProblem(f"{key}[{i + 1}]", f"{next_s:g} s is not after {time_s:g} s", "give increasing times")


def check_solver(solver: SolverConfig, mission: MissionConfig) -> Iterator[ConfigProblem]:
    """Check that no trajectory is given to the printed problem, which cannot follow one."""
    if solver.method == "printed" and mission.trajectory.times_s:
        yield ConfigProblem("solver.method", '"printed" follows no trajectory', 'use "exact"')


def check_solver_fences(solver: SolverConfig, fences: Sequence[FenceConfig]) -> Iterator[ConfigProblem]:
    """Check that no moving limits are given to the printed problem, which cannot keep them."""
    if solver.method == "printed" and fences:
        yield ConfigProblem("solver.method", '"printed" knows no limits that move', 'use "exact"')


_AXIS_KEYS: tuple[str, ...] = ("position_index", "velocity_index", "accel_per_input")
_MATRIX_KEYS: tuple[str, ...] = ("a", "b", "e", "w", *_AXIS_KEYS)
_DRAG_LAG_KEYS: tuple[str, ...] = ("drag_1ps", "lag_s", "gain", "wind_std_mps2")
_GUST_KEYS: tuple[str, ...] = ("gust_mps2", "gust_s")  # of `drag-lag`, which does without them
MAX_GUST_S = 10.0  # a gust that lasts longer is a bias of the filter
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
_POSITIVE = ("lag_s", "gain", "position_1ps", "velocity_1ps", "integral_1ps2", "input_std_mps2", "gust_s")
_SUM_TOLERANCE = 1e-4  # shares are written rounded
_MAX_TICKS_TRIED = 10_000
_EIGENVALUE_TOLERANCE = 1e-9  # asymmetry and negative eigenvalues below this share of W's size are rounding


def get_dimensions(plant: PlantConfig) -> tuple[int, int]:
    """(n_x, n_u) that the other sections must fit: gusts do not count.

    A plant without axes has as many inputs as B has columns.
    """
    n_u = len(plant.axes) or (len(plant.b[0]) if plant.b else 0)
    return (plant.states_per_axis * n_u or len(plant.a)), n_u


def check_sections(sections: Mapping[str, Section | tuple[Section, ...]]) -> Iterator[ConfigProblem]:
    """All problems among the sections that are there (a section that is not decoded is left out)."""
    for names, check_function in _CHECKS:
        if all(name in sections for name in names):
            yield from check_function(*(sections[name] for name in names))


def _check_length(
    key: str, values: UnboundedFloats | tuple[int, ...], expected: int, meaning: str
) -> Iterator[ConfigProblem]:
    if len(values) != expected:
        yield ConfigProblem(key, f"has {len(values)} entries, {meaning} = {expected}", f"give {expected} numbers")


def _check_shape(key: str, rows: Rows, expected: tuple[int, int], meaning: str) -> Iterator[ConfigProblem]:
    lengths = {len(row) for row in rows}
    todo = f"give {expected[0]} rows of {expected[1]} numbers"
    if len(lengths) > 1:
        yield ConfigProblem(key, f"rows have different lengths ({', '.join(map(str, sorted(lengths)))})", todo)
        return
    shape = (len(rows), lengths.pop() if lengths else 0)
    if shape != expected:
        yield ConfigProblem(key, f"is {shape[0]} x {shape[1]}, {meaning} = {expected[0]} x {expected[1]}", todo)


def _check_plant(plant: PlantConfig) -> Iterator[ConfigProblem]:
    if list(plant.axes) != sorted(set(plant.axes), key=_AXES.index):
        yield ConfigProblem(
            "plant.axes", f"{list(plant.axes)} repeats or turns round axes", "keep the order north, east, down"
        )
    required_keys = _KEYS[plant.model]
    if not plant.axes:
        axis_keys = [key for key in _AXIS_KEYS if getattr(plant, key)]
        if plant.model != "matrices" or axis_keys:
            reason = f"plant.{axis_keys[0]}" if axis_keys else f'model "{plant.model}"'
            yield ConfigProblem(
                "plant.axes", f"is missing, and {reason} needs it", 'add it, as in ["north", "east", "down"]'
            )
            return
        required_keys = tuple(key for key in required_keys if key not in _AXIS_KEYS)
    foreign = dict.fromkeys(key for keys in _KEYS.values() for key in keys if key not in required_keys)
    missing = [key for key in required_keys if not getattr(plant, key)]
    if plant.model == "matrices" and {*missing} >= {*_AXIS_KEYS}:  # only the meaning of the states is missing
        yield ConfigProblem(
            "plant.axes",
            f"is given without {', '.join(_AXIS_KEYS)}, which define the motion along them",
            "add them, or remove plant.axes: then the plant can be planned for and simulated, but not flown",
        )
        return
    for key in missing:
        yield ConfigProblem(f"plant.{key}", f'is missing, and model "{plant.model}" needs it', "add it")
    for key in foreign:
        if key not in _KEYS[plant.model] and getattr(plant, key):
            yield ConfigProblem(
                f"plant.{key}", f'has no meaning with model "{plant.model}"', "remove it, or change the model"
            )
    yield from _check_gusts(plant)
    if not missing:
        yield from _check_matrices(plant) if plant.model == "matrices" else _check_axis_values(plant, required_keys)


def _check_gusts(plant: PlantConfig) -> Iterator[ConfigProblem]:
    given = [key for key in _GUST_KEYS if getattr(plant, key)]
    if given and plant.model != "drag-lag":
        yield ConfigProblem(
            f"plant.{given[0]}", f'has no meaning with model "{plant.model}"', 'remove it, or take model "drag-lag"'
        )
    elif len(given) == 1:
        (missing,) = set(_GUST_KEYS) - set(given)
        yield ConfigProblem(f"plant.{missing}", f"is missing, and plant.{given[0]} needs it", "add it")
    elif given:
        yield from _check_axis_values(plant, _GUST_KEYS)
    if max(plant.gust_s, default=0.0) > MAX_GUST_S:
        yield ConfigProblem(
            "plant.gust_s",
            f"{max(plant.gust_s):g} s is more than {MAX_GUST_S:g}",
            "leave such gusts to estimator.bias_drift",
        )


def _check_matrices(plant: PlantConfig) -> Iterator[ConfigProblem]:
    n_x, n_u = get_dimensions(plant)
    n_w = len(plant.w)
    yield from _check_shape("plant.a", plant.a, (n_x, n_x), "n_x x n_x")
    yield from _check_shape("plant.b", plant.b, (n_x, n_u), "n_x x number of axes")
    yield from _check_shape("plant.e", plant.e, (n_x, n_w), "n_x x n_w")
    w_problems = list(_check_shape("plant.w", plant.w, (n_w, n_w), "n_w x n_w"))
    yield from w_problems or _check_covariance(plant.w)
    if not plant.axes:
        return
    for key in ("position_index", "velocity_index"):
        index = getattr(plant, key)
        yield from _check_length(f"plant.{key}", index, n_u, "number of axes")
        if any(not 0 <= i < n_x for i in index):
            yield ConfigProblem(
                f"plant.{key}", f"{list(index)} names a state that is not there", f"give 0 to {n_x - 1}"
            )
    state_indices = plant.position_index + plant.velocity_index
    if len(set(state_indices)) < len(state_indices):
        yield ConfigProblem(
            "plant.velocity_index", "a state is named twice", "give each position and velocity its own state"
        )
    yield from _check_length("plant.accel_per_input", plant.accel_per_input, n_u, "number of axes")
    if 0.0 in plant.accel_per_input:
        yield ConfigProblem(
            "plant.accel_per_input", "is 0 for an axis, which nothing could steer", "give a number other than 0"
        )


def _check_covariance(w: Rows) -> Iterator[ConfigProblem]:
    matrix = np.array(w)
    size = float(np.abs(matrix).max(initial=0.0))
    if float(np.abs(matrix - matrix.T).max(initial=0.0)) > _EIGENVALUE_TOLERANCE * size:
        yield ConfigProblem("plant.w", "is not symmetric", "a covariance has W[i][j] = W[j][i]")
        return
    smallest = float(np.linalg.eigvalsh(matrix).min(initial=0.0))
    if smallest < -_EIGENVALUE_TOLERANCE * size:
        yield ConfigProblem(
            "plant.w",
            f"is not positive semidefinite (smallest eigenvalue {smallest:.4g})",
            "give a covariance matrix: variances on the diagonal, covariances at most their geometric mean",
        )


def _check_axis_values(plant: PlantConfig, keys: tuple[str, ...]) -> Iterator[ConfigProblem]:
    n_u = len(plant.axes)
    for key in keys:
        values = getattr(plant, key)
        yield from _check_length(f"plant.{key}", values, n_u, "number of axes")
        is_positive = key in _POSITIVE
        if any(value <= 0 if is_positive else value < 0 for value in values):
            yield ConfigProblem(
                f"plant.{key}", f"{list(values)} is out of range", f"give numbers {'> 0' if is_positive else '>= 0'}"
            )


def _check_sets(plant: PlantConfig, sets: SetsConfig) -> Iterator[ConfigProblem]:
    for kind, size, name in zip(("state", "input"), get_dimensions(plant), ("n_x", "number of axes"), strict=True):
        lower, upper = getattr(sets, f"{kind}_lower"), getattr(sets, f"{kind}_upper")
        yield from _check_length(f"sets.{kind}_lower", lower, size, name)
        yield from _check_length(f"sets.{kind}_upper", upper, size, name)
        for i, (low, high) in enumerate(zip(lower, upper, strict=False)):
            for name, side in ((f"sets.{kind}_lower[{i}]", low), (f"sets.{kind}_upper[{i}]", high)):
                if math.isfinite(side) and abs(side) > MAX_NUMBER:
                    yield ConfigProblem(
                        name, f"{side:g} is beyond {MAX_NUMBER:g}", "give a smaller number, or inf for no limit"
                    )
            if not low < high:
                yield ConfigProblem(
                    f"sets.{kind}_lower[{i}]",
                    f"lower limit {low:g} is not below sets.{kind}_upper[{i}] = {high:g}",
                    "give a lower limit below the upper one",
                )


def _check_cost(plant: PlantConfig, cost: CostConfig) -> Iterator[ConfigProblem]:
    n_x, n_u = get_dimensions(plant)
    yield from _check_length("cost.state", cost.state, n_x, "n_x")
    yield from _check_length("cost.input", cost.input, n_u, "number of axes")
    if any(weight <= 0 for weight in cost.input):
        yield ConfigProblem(
            "cost.input", "a weight is not positive, so the cost is not strictly convex", "give numbers > 0"
        )


def _check_smpc(plant: PlantConfig, smpc: SmpcConfig) -> Iterator[ConfigProblem]:
    n_x, n_u = get_dimensions(plant)
    if plant.gust_mps2 and not smpc.is_age_conditioned:
        yield ConfigProblem(
            "plant.gust_mps2",
            'scheme "hahn-stursberg" takes no state that inputs do not move',
            'remove gust_mps2 and gust_s, or set smpc.scheme = "age-conditioned"',
        )
    if smpc.is_age_conditioned or smpc.tau is None or smpc.k_tau is None:
        return
    if smpc.horizon > MAX_PLANNED_HORIZON:
        yield ConfigProblem(
            "smpc.horizon",
            f"{smpc.horizon} steps are more than planned feedback is solved for, {MAX_PLANNED_HORIZON}",
            'shorten it, or set smpc.scheme = "age-conditioned"',
        )
    yield from _check_shape("smpc.k_tau", smpc.k_tau, (n_u, n_x), "number of axes x n_x")
    if smpc.tau >= smpc.horizon:
        yield ConfigProblem(
            "smpc.tau",
            f"{smpc.tau} steps do not fit into the horizon of {smpc.horizon}",
            "give a tau below smpc.horizon, or a longer horizon",
        )


def _check_schedule(plant: PlantConfig, smpc: SmpcConfig, schedule: ScheduleConfig) -> Iterator[ConfigProblem]:
    n_x, _ = get_dimensions(plant)
    if smpc.is_age_conditioned:
        return
    delays = schedule.delays
    if schedule.rule == "fixed":
        if isinstance(delays, tuple):
            yield from _check_length("schedule.delays", delays, smpc.horizon, "smpc.horizon")
        if any(delay < 1 for delay in (delays if isinstance(delays, tuple) else (delays,))):
            yield ConfigProblem(
                "schedule.delays",
                "a delay is below 1 step: feedback on a future state",
                'give whole numbers >= 1, or rule = "search" or "greedy"',
            )
    if schedule.rule == "search" and not schedule.search_states:
        yield ConfigProblem(
            "schedule.search_states", 'is missing, and rule "search" needs it', f"add states of {n_x} numbers each"
        )
    for i, state in enumerate(schedule.search_states):
        yield from _check_length(f"schedule.search_states[{i}]", state, n_x, "n_x")


def _check_target(plant: PlantConfig, sets: SetsConfig, target: TargetConfig) -> Iterator[ConfigProblem]:
    yield from find_outside(plant, sets, target.position_m, "target.position_m", "target")


def _check_link(link: LinkConfig) -> Iterator[ConfigProblem]:
    if link.model == "empirical":
        yield from _check_gaps(link.gaps)
    if link.model == "trace":
        yield from _check_trace(link.trace_s)
    if link.model == "scheduled" and not link.wait_s:
        yield ConfigProblem(
            "link.wait_s",
            'is missing, and model "scheduled" needs it',
            "give the longest time between two messages to this vehicle; `uavctl fleet check` prints it",
        )
    if link.probability and link.probability[-1] == 0.0:
        yield ConfigProblem(
            "link.probability",
            "ends in 0, which is repeated: nothing arrives for ever",
            "add the probability that repeats; use link.blackout to test an outage",
        )
    for name in ("blackout", "held", "uplink_blackout"):
        yield from check_spans(f"link.{name}", getattr(link, name))


def _check_gaps(gaps: UnboundedFloats) -> Iterator[ConfigProblem]:
    todo = "give the shares of the measured runs of 0, 1, 2 … lost packets"
    if not gaps:
        yield ConfigProblem("link.gaps", 'is missing, and model "empirical" needs it', todo)
    elif abs(math.fsum(gaps) - 1.0) > _SUM_TOLERANCE:
        yield ConfigProblem(
            "link.gaps", f"the entries add up to {math.fsum(gaps):.6g}, probabilities of all runs to 1", todo
        )


def _check_trace(delays: UnboundedFloats) -> Iterator[ConfigProblem]:
    if not delays:
        yield ConfigProblem("link.trace_file", 'is missing, and model "trace" needs it', "give a file, or link.trace_s")
    elif all(math.isinf(delay) for delay in delays):
        yield ConfigProblem("link.trace_s", "every packet is lost", "give a trace in which some arrive")
    for i, delay in enumerate(delays):
        if not (0.0 <= delay <= MAX_DELAY_S or math.isinf(delay)) or delay < 0.0:
            yield ConfigProblem(
                f"link.trace_s[{i}]",
                f"{delay:g} is not a delay",
                f"give seconds, at most {MAX_DELAY_S:g}, or inf for a lost packet",
            )


def _check_tick(plant: PlantConfig, daemon: DaemonConfig) -> Iterator[ConfigProblem]:
    tick_ns, dt_ns = round(daemon.tick_s * 1e9), round(plant.dt_s * 1e9)
    if tick_ns < 1 or dt_ns % tick_ns:
        min_count = math.ceil(dt_ns / max(tick_ns, 1))
        count = next((n for n in range(min_count, min_count + _MAX_TICKS_TRIED) if dt_ns % n == 0), min_count)
        yield ConfigProblem(
            "daemon.tick_s",
            f"{daemon.tick_s:g} s does not divide plant.dt_s = {plant.dt_s:g} s",
            f"give plant.dt_s / n with a whole n, for example {plant.dt_s / count:g}",
        )


def _check_limits(limits: LimitsConfig) -> Iterator[ConfigProblem]:
    if any(limit <= 0 for limit in limits.accel_mps2):
        yield ConfigProblem("limits.accel_mps2", "a limit is not positive", "give numbers > 0")


CheckFunction = Callable[..., Iterator[ConfigProblem]]


def _check_bias(plant: PlantConfig, sets: SetsConfig, estimator: EstimatorConfig) -> Iterator[ConfigProblem]:
    if plant.model == "velocity-reference" and estimator.bias_drift:
        yield ConfigProblem(
            "estimator.bias_drift",
            'an unknown part of the input does not disturb model "velocity-reference": its loops hold it',
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


_CHECKS: tuple[tuple[tuple[str, ...], CheckFunction], ...] = (
    (("plant",), _check_plant),
    (("plant", "sets"), _check_sets),
    (("plant", "cost"), _check_cost),
    (("plant", "smpc"), _check_smpc),
    (("plant", "smpc", "schedule"), _check_schedule),
    (("plant", "sets", "target"), _check_target),
    (("link",), _check_link),
    (("plant", "daemon"), _check_tick),
    (("limits",), _check_limits),
    (("plant", "sets", "estimator"), _check_bias),
    (("security",), check_security),
    (("daemon",), check_roles),
    (("daemon", "source"), check_source),
    (("daemon", "security"), check_signing),
    (("sim",), check_sim),
    (("sim", "daemon"), check_system_ids),
    (("plant", "sets", "mission"), check_mission),
    (("plant", "sets", "fence"), check_fences),
    (("solver", "mission"), check_solver),
    (("solver", "fence"), check_solver_fences),
)
