"""Checks of a configuration that no single key's type can make: shapes, orders, fits.

Each check takes sections that were decoded and yields every problem that it finds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from uavctl.config import log, mission_checks, peer_checks, security, sim_checks
from uavctl.config.link import LONGEST_DELAY_S
from uavctl.config.peers import DaemonConfig
from uavctl.config.problem import Problem as Problem
from uavctl.config.section import LARGEST, Open
from uavctl.config.types import (
    LIBRARY_HORIZON,
    PLANNED_HORIZON,
    CostConfig,
    EstimatorConfig,
    LimitsConfig,
    LinkConfig,
    PlantConfig,
    Rows,
    ScheduleConfig,
    Section,
    SetsConfig,
    SmpcConfig,
    SolverConfig,
    TargetConfig,
)

_MATRIX_KEYS: tuple[str, ...] = ("a", "b", "e", "w", "position_index", "velocity_index", "accel_per_input")
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
_AXES = ("north", "east", "down")
_SUM = 1e-4  # shares are written rounded
_TICKS_TRIED = 10_000
_RELATIVE = 1e-9  # asymmetry and negative eigenvalues below this share of W's size are rounding


def dimensions(plant: PlantConfig) -> tuple[int, int]:
    """(n_x, n_u) that the other sections must fit."""
    n_u = len(plant.axes)
    return (plant.states_per_axis * n_u or len(plant.a)), n_u


def check(sections: Mapping[str, Section | tuple[Section, ...]]) -> Iterator[Problem]:
    """All problems among the sections that are there (a section that is not decoded is left out)."""
    for names, check_one in _CHECKS:
        if all(name in sections for name in names):
            yield from check_one(*(sections[name] for name in names))


def _length(key: str, values: Open | tuple[int, ...], wanted: int, meaning: str) -> Iterator[Problem]:
    if len(values) != wanted:
        yield Problem(key, f"has {len(values)} entries, {meaning} = {wanted}", f"give {wanted} numbers")


def _shape(key: str, rows: Rows, wanted: tuple[int, int], meaning: str) -> Iterator[Problem]:
    lengths = {len(row) for row in rows}
    todo = f"give {wanted[0]} rows of {wanted[1]} numbers"
    if len(lengths) > 1:
        yield Problem(key, f"rows have different lengths ({', '.join(map(str, sorted(lengths)))})", todo)
        return
    shape = (len(rows), lengths.pop() if lengths else 0)
    if shape != wanted:
        yield Problem(key, f"is {shape[0]} x {shape[1]}, {meaning} = {wanted[0]} x {wanted[1]}", todo)


def _plant(plant: PlantConfig) -> Iterator[Problem]:
    if list(plant.axes) != sorted(set(plant.axes), key=_AXES.index):
        yield Problem(
            "plant.axes", f"{list(plant.axes)} repeats or turns round axes", "keep the order north, east, down"
        )
    wanted = _KEYS[plant.model]
    foreign = dict.fromkeys(key for keys in _KEYS.values() for key in keys if key not in wanted)
    missing = [key for key in wanted if not getattr(plant, key)]
    for key in missing:
        yield Problem(f"plant.{key}", f'is missing, and model "{plant.model}" needs it', "add it")
    for key in foreign:
        if getattr(plant, key):
            yield Problem(
                f"plant.{key}", f'has no meaning with model "{plant.model}"', "remove it, or change the model"
            )
    if not missing:
        yield from _matrices(plant) if plant.model == "matrices" else _each_axis(plant, wanted)


def _matrices(plant: PlantConfig) -> Iterator[Problem]:
    n_x, n_u = dimensions(plant)
    n_w = len(plant.w)
    yield from _shape("plant.a", plant.a, (n_x, n_x), "n_x x n_x")
    yield from _shape("plant.b", plant.b, (n_x, n_u), "n_x x number of axes")
    yield from _shape("plant.e", plant.e, (n_x, n_w), "n_x x n_w")
    wrong_w = list(_shape("plant.w", plant.w, (n_w, n_w), "n_w x n_w"))
    yield from wrong_w or _covariance(plant.w)
    for key in ("position_index", "velocity_index"):
        index = getattr(plant, key)
        yield from _length(f"plant.{key}", index, n_u, "number of axes")
        if any(not 0 <= i < n_x for i in index):
            yield Problem(f"plant.{key}", f"{list(index)} names a state that is not there", f"give 0 to {n_x - 1}")
    both = plant.position_index + plant.velocity_index
    if len(set(both)) < len(both):
        yield Problem("plant.velocity_index", "a state is named twice", "give each position and velocity its own state")
    yield from _length("plant.accel_per_input", plant.accel_per_input, n_u, "number of axes")
    if 0.0 in plant.accel_per_input:
        yield Problem(
            "plant.accel_per_input", "is 0 for an axis, which nothing could steer", "give a number other than 0"
        )


def _covariance(w: Rows) -> Iterator[Problem]:
    matrix = np.array(w)
    size = float(np.abs(matrix).max(initial=0.0))
    if float(np.abs(matrix - matrix.T).max(initial=0.0)) > _RELATIVE * size:
        yield Problem("plant.w", "is not symmetric", "a covariance has W[i][j] = W[j][i]")
        return
    smallest = float(np.linalg.eigvalsh(matrix).min(initial=0.0))
    if smallest < -_RELATIVE * size:
        yield Problem(
            "plant.w",
            f"is not positive semidefinite (smallest eigenvalue {smallest:.4g})",
            "give a covariance matrix: variances on the diagonal, covariances at most their geometric mean",
        )


def _each_axis(plant: PlantConfig, keys: tuple[str, ...]) -> Iterator[Problem]:
    n_u = len(plant.axes)
    for key in keys:
        values = getattr(plant, key)
        yield from _length(f"plant.{key}", values, n_u, "number of axes")
        positive = key in _POSITIVE
        if any(value <= 0 if positive else value < 0 for value in values):
            yield Problem(
                f"plant.{key}", f"{list(values)} is out of range", f"give numbers {'> 0' if positive else '>= 0'}"
            )


def _sets(plant: PlantConfig, sets: SetsConfig) -> Iterator[Problem]:
    for kind, size, name in zip(("state", "input"), dimensions(plant), ("n_x", "number of axes"), strict=True):
        lower, upper = getattr(sets, f"{kind}_lower"), getattr(sets, f"{kind}_upper")
        yield from _length(f"sets.{kind}_lower", lower, size, name)
        yield from _length(f"sets.{kind}_upper", upper, size, name)
        for i, (low, high) in enumerate(zip(lower, upper, strict=False)):
            for name, side in ((f"sets.{kind}_lower[{i}]", low), (f"sets.{kind}_upper[{i}]", high)):
                if math.isfinite(side) and abs(side) > LARGEST:
                    yield Problem(name, f"{side:g} is beyond {LARGEST:g}", "give a smaller number, or inf for no limit")
            if not low < high:
                yield Problem(
                    f"sets.{kind}_lower[{i}]",
                    f"lower limit {low:g} is not below sets.{kind}_upper[{i}] = {high:g}",
                    "give a lower limit below the upper one",
                )


def _cost(plant: PlantConfig, cost: CostConfig) -> Iterator[Problem]:
    n_x, n_u = dimensions(plant)
    yield from _length("cost.state", cost.state, n_x, "n_x")
    yield from _length("cost.input", cost.input, n_u, "number of axes")
    if any(weight <= 0 for weight in cost.input):
        yield Problem("cost.input", "a weight is not positive, so the cost is not strictly convex", "give numbers > 0")


def _smpc(plant: PlantConfig, smpc: SmpcConfig) -> Iterator[Problem]:
    n_x, n_u = dimensions(plant)
    if smpc.conditioned or smpc.tau is None or smpc.k_tau is None:
        return
    if smpc.horizon > PLANNED_HORIZON:
        yield Problem(
            "smpc.horizon",
            f"{smpc.horizon} steps are more than planned feedback is solved for, {PLANNED_HORIZON}",
            'shorten it, or set smpc.scheme = "age-conditioned"',
        )
    yield from _shape("smpc.k_tau", smpc.k_tau, (n_u, n_x), "number of axes x n_x")
    if smpc.tau >= smpc.horizon:
        yield Problem(
            "smpc.tau",
            f"{smpc.tau} steps do not fit into the horizon of {smpc.horizon}",
            "give a tau below smpc.horizon, or a longer horizon",
        )


def _schedule(plant: PlantConfig, smpc: SmpcConfig, schedule: ScheduleConfig) -> Iterator[Problem]:
    n_x, _ = dimensions(plant)
    if smpc.conditioned:
        return
    delays = schedule.delays
    if schedule.rule == "fixed":
        if isinstance(delays, tuple):
            yield from _length("schedule.delays", delays, smpc.horizon, "smpc.horizon")
        if any(delay < 1 for delay in (delays if isinstance(delays, tuple) else (delays,))):
            yield Problem(
                "schedule.delays",
                "a delay is below 1 step: feedback on what has not happened yet",
                'give whole numbers >= 1, or rule = "search" or "greedy"',
            )
    if schedule.rule == "search" and not schedule.search_states:
        yield Problem(
            "schedule.search_states", 'is missing, and rule "search" needs it', f"add states of {n_x} numbers each"
        )
    for i, state in enumerate(schedule.search_states):
        yield from _length(f"schedule.search_states[{i}]", state, n_x, "n_x")


def _library(smpc: SmpcConfig, solver: SolverConfig) -> Iterator[Problem]:
    if not smpc.conditioned and solver.method == "library" and LIBRARY_HORIZON < smpc.horizon <= PLANNED_HORIZON:
        yield Problem(
            "smpc.horizon",
            f"{smpc.horizon} steps are more than a policy library is made for, {LIBRARY_HORIZON}",
            'shorten it, or set solver.method = "exact"',
        )


def _target(plant: PlantConfig, sets: SetsConfig, target: TargetConfig) -> Iterator[Problem]:
    yield from mission_checks.outside(plant, sets, target.position_m, "target.position_m", "target")


def _link(link: LinkConfig) -> Iterator[Problem]:
    if link.model == "empirical":
        yield from _gaps(link.gaps)
    if link.model == "trace":
        yield from _trace(link.trace_s)
    if link.probability and link.probability[-1] == 0.0:
        yield Problem(
            "link.probability",
            "ends in 0, which is repeated: nothing arrives for ever",
            "add the probability that goes on; use link.blackout to test an outage",
        )
    for name in ("blackout", "held", "uplink_blackout"):
        yield from sim_checks.spans(f"link.{name}", getattr(link, name))


def _gaps(gaps: Open) -> Iterator[Problem]:
    todo = "give the shares of the measured runs of 0, 1, 2 … lost packets"
    if not gaps:
        yield Problem("link.gaps", 'is missing, and model "empirical" needs it', todo)
    elif abs(math.fsum(gaps) - 1.0) > _SUM:
        yield Problem("link.gaps", f"the entries add up to {math.fsum(gaps):.6g}, probabilities of all runs to 1", todo)


def _trace(delays: Open) -> Iterator[Problem]:
    if not delays:
        yield Problem("link.trace_file", 'is missing, and model "trace" needs it', "give a file, or link.trace_s")
    elif all(math.isinf(delay) for delay in delays):
        yield Problem("link.trace_s", "every packet is lost", "give a trace in which some arrive")
    for i, delay in enumerate(delays):
        if not (0.0 <= delay <= LONGEST_DELAY_S or math.isinf(delay)) or delay < 0.0:
            yield Problem(
                f"link.trace_s[{i}]",
                f"{delay:g} is not a delay",
                f"give seconds, at most {LONGEST_DELAY_S:g}, or inf for a lost packet",
            )


def _tick(plant: PlantConfig, daemon: DaemonConfig) -> Iterator[Problem]:
    tick_ns, dt_ns = round(daemon.tick_s * 1e9), round(plant.dt_s * 1e9)
    if tick_ns < 1 or dt_ns % tick_ns:
        least = math.ceil(dt_ns / max(tick_ns, 1))
        count = next((n for n in range(least, least + _TICKS_TRIED) if dt_ns % n == 0), least)
        yield Problem(
            "daemon.tick_s",
            f"{daemon.tick_s:g} s does not divide plant.dt_s = {plant.dt_s:g} s",
            f"give plant.dt_s / n with a whole n, for example {plant.dt_s / count:g}",
        )


def _limits(limits: LimitsConfig) -> Iterator[Problem]:
    if any(limit <= 0 for limit in limits.accel_mps2):
        yield Problem("limits.accel_mps2", "a limit is not positive", "give numbers > 0")


_CheckFunction = Callable[..., Iterator[Problem]]


def _bias(plant: PlantConfig, sets: SetsConfig, estimator: EstimatorConfig) -> Iterator[Problem]:
    if plant.model == "velocity-reference" and estimator.bias_drift:
        yield Problem(
            "estimator.bias_drift",
            'an unknown part of the input is not what disturbs model "velocity-reference": its loops hold it',
            "set bias_drift and bias_max to 0, and plant.force_drift_mps2_rts in their place",
        )
    if (estimator.bias_drift > 0.0) != (estimator.bias_max > 0.0):
        missing = "bias_max" if estimator.bias_drift else "bias_drift"
        yield Problem(
            f"estimator.{missing}",
            "is 0, and the other one of bias_drift and bias_max is not",
            "give both, or neither for a filter without a bias",
        )
    for i, (low, high) in enumerate(zip(sets.input_lower, sets.input_upper, strict=False)):
        if high - low <= 2.0 * estimator.bias_max:
            yield Problem(
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
    (("smpc", "solver"), _library),
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
    (("plant", "sets", "mission"), mission_checks.mission),
    (("plant", "sets", "fence"), mission_checks.fences),
    (("solver", "mission"), mission_checks.solver),
    (("solver", "fence"), mission_checks.solver_fences),
)
