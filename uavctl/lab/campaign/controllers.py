"""Controllers of a campaign's cells, their settings, and baselines within the flight core.

1. A disturbance is a transform of standard normal draws, which are the same for every cell.
2. A `CellSetting` holds what is the same for every controller: plant, limits, costs, start, link and disturbance.
3. A `Recipe` is made once for each belief; each worker builds its own controller from it.
4. A `BaselineSolver` replaces the SMPC within the flight core; filter, fallback and setpoint limiter stay.
"""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from scipy.special import ndtr, stdtrit

from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.link import LinkConfig
from uavctl.config.types import PlantConfig
from uavctl.lab.campaign.arrivals import compute_known_steps, select_newest_captures
from uavctl.lab.campaign.draws import Stream, compute_root, draw, draw_normal, draw_uniform
from uavctl.lab.campaign.position_filter import FilterBelief
from uavctl.lab.campaign.spec import CampaignSpec, ControllerSpec, DisturbanceSpec, make_controller
from uavctl.lab.campaign.world import LinearWorld
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.smpc.baselines import Governor, HoldLast, Lqg, MeanQp, PacketisedPredictive, WorstCaseDelay, ZeroOnLoss
from uavctl.smpc.batch import BatchController, BatchSmpc, Counts, Decider, SequentialDecider
from uavctl.smpc.conditioned.planner import ConditionedDecider
from uavctl.smpc.estimate import innovation_form
from uavctl.smpc.hahn_stursberg.design import Design, kappa
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutDecider, ShortcutSolver
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.outside import SilencePlanner, make_answer
from uavctl.smpc.pid import CascadedPid, PidGains, tune
from uavctl.wiring.controller import (
    build_conditioned,
    build_design,
    build_plant,
    build_problem,
    build_solver,
    make_start_state,
    require_value,
)
from uavctl.wiring.rest import check_axes, pad_state

_STUDENT_DEGREES = 4.0  # of Student's t; its variance is degrees / (degrees - 2)


def shape_disturbances(spec: DisturbanceSpec, w: Array, normal: Array) -> Array:
    """Return w(k) of every run (N, T, n_w).

    Args:
        spec: The kind; all have mean `bias` and covariance scale² W, gusts in their stationary state.
        w: W (n_w, n_w).
        normal: Standard normal draws (N, T, n_w), see `RandomDraws.normal`.
    """
    shaped = spec.scale * _shape_draws(spec, normal) @ compute_root(w)
    return np.asarray(shaped + spec.bias * np.sqrt(np.diag(w)), dtype=np.float64)


def _shape_draws(spec: DisturbanceSpec, normal: Array) -> Array:
    """Return draws of mean 0 and covariance I."""
    if spec.kind == "uniform":
        return np.asarray(np.sqrt(3.0) * (2.0 * ndtr(normal) - 1.0), dtype=np.float64)
    if spec.kind == "heavy":
        # By the lower tail on either side: the upper one's probability would be rounded to 1.
        tail = stdtrit(_STUDENT_DEGREES, ndtr(-np.abs(normal)))
        return np.asarray(
            -np.sign(normal) * tail * np.sqrt((_STUDENT_DEGREES - 2.0) / _STUDENT_DEGREES), dtype=np.float64
        )
    if spec.kind == "gusts":
        gusts = normal.copy()
        for k in range(1, normal.shape[1]):
            gusts[:, k] = spec.memory * gusts[:, k - 1] + np.sqrt(1.0 - spec.memory**2) * normal[:, k]
        return gusts
    return normal


@dataclass(frozen=True, eq=False)
class CellSetting:
    """Setting of a cell: everything but its controller."""

    spec: CampaignSpec  # the campaign's specification: steps, seed, start
    base: Config  # the base configuration, which every cell is judged by
    plant: PlantConfig  # the plant that flies
    link: LinkConfig  # the link that it flies on
    disturbance: DisturbanceSpec  # the disturbance


@dataclass(frozen=True, eq=False)
class RunConditions:
    """World, losses, disturbances and noise of N runs of T steps; the same for every controller."""

    world: LinearWorld  # the scene
    newest_captures: Counts  # capture step of the newest position known in each step (N, T)
    disturbances: Array  # w (N, T, n_w)
    known_steps: Counts  # step that knows the position of each step first (N, T)
    noise: Array | None  # noise of the positions (N, T, n_axes) [m]; None where the state is measured


def draw_conditions(setting: CellSetting, first: int, runs: int) -> RunConditions:
    """Draw the conditions of the runs `first` … `first` + `runs` - 1.

    Raises:
        DesignError: The flown plant is not valid.
    """
    spec, flown_config = setting.spec, msgspec.structs.replace(setting.base, plant=setting.plant)
    plant, problem = build_plant(flown_config), build_problem(setting.base)
    draws = draw(spec.master, first, runs, spec.steps, plant.n_w)
    world = LinearWorld(
        plant=plant,
        state_set=problem.state_set,
        input_set=problem.input_set,
        q_x=problem.q_x,
        q_u=problem.q_u,
        target=problem.target,
        u_target=problem.u_target,
        start=_draw_start_states(setting, first, runs),
    )
    known_steps = compute_known_steps(setting.link, plant.dt_s, draws.link)
    noise = None
    if spec.measured == "position":
        std_m = setting.base.sim.camera.noise_std_m
        noise = std_m * draw_normal(Stream.POSITION_NOISE, spec.master, first, runs, (spec.steps, len(plant.axes)))
    return RunConditions(
        world,
        select_newest_captures(known_steps),
        shape_disturbances(setting.disturbance, plant.w, draws.normal),
        known_steps,
        noise,
    )


def get_start_state(spec: CampaignSpec, base: Config) -> Array:
    """Return the state in which runs start (n_x,); with a box, its middle."""
    plant = build_plant(base)
    if spec.start:
        return pad_state(np.array(spec.start, dtype=np.float64), plant)
    if spec.start_box:
        return pad_state(np.array(spec.start_box, dtype=np.float64).mean(axis=0), plant)
    return make_start_state(base, plant)


def _draw_start_states(setting: CellSetting, first: int, runs: int) -> Array:
    """Return x(0) of every run (N, n_x)."""
    spec = setting.spec
    if not spec.start_box:
        return np.tile(get_start_state(spec, setting.base), (runs, 1))
    lower, upper = pad_state(np.array(spec.start_box, dtype=np.float64), build_plant(setting.base))
    draws = draw_uniform(Stream.START, spec.master, first, runs, (lower.size,))
    return np.asarray(lower + (upper - lower) * draws, dtype=np.float64)


# Runs that a PID is tuned on: beyond the last index that a campaign can fly.
TUNING_FIRST, TUNING_RUNS = 10_000_000, 64
TUNING_STEPS = 200  # longer runs show nothing new, and every candidate flies them all

_POSITION_KINDS = ("pid",)  # kinds that use positions and velocities alone


@dataclass(frozen=True, eq=False)
class Recipe:
    """Everything that a controller is built from; it can be sent to another process."""

    key: str  # hash of all the others
    kind: str  # one of `uavctl.lab.campaign.spec.KINDS`, or of another package
    config: Config  # the configuration that it believes in
    design: Design | None = None  # its design, of the SMPC with scheme `hahn-stursberg`
    gains: PidGains | None = None  # the gains of a PID
    margin: float = 0.0  # of an MPC without back-offs, see `ControllerSpec`
    # Covariance (n_x, n_x) that the simple margins begin with; None: the state is measured
    cov: Array | None = None


def make_recipe(controller: ControllerSpec, config: Config, spec: CampaignSpec) -> Recipe:
    """Make a recipe: design and gains, which take time or depend on chance.

    Args:
        config: The configuration that it believes in.

    Raises:
        DesignError: There is no such controller.
    """
    kind = config.smpc.controller or "smpc" if controller.kind == "smpc" else controller.kind
    recipe = Recipe("", kind, config, margin=controller.margin)
    if kind in _POSITION_KINDS or spec.measured == "position":
        check_axes(config)
    if spec.measured == "position":
        belief = make_filter_belief(config)
        recipe = replace(recipe, cov=innovation_form(belief.plant, belief.position_std_m, 0.0, 0).estimate_cov)
    if kind == "smpc" and not config.is_age_conditioned:
        recipe = replace(recipe, design=build_design(config))
    elif kind == "pid":
        recipe = replace(recipe, gains=_tune_gains(config, spec))
    recipe = replace(recipe, key=hashlib.sha256(pickle.dumps(recipe)).hexdigest())
    if recipe.design is None:
        build_from_recipe(recipe)  # without a design, refuse here and not in a worker
    return recipe


def build_from_recipe(recipe: Recipe) -> BatchController:
    """Build a controller from a recipe.

    Raises:
        DesignError: There is none.
    """
    config = recipe.config
    if recipe.kind == "smpc":
        return _build_smpc(recipe)
    problem = build_problem(config)
    if recipe.kind == "lqg":
        return Lqg(problem)
    if recipe.kind == "packetised":
        return PacketisedPredictive(problem, recipe.margin)
    if recipe.kind == "mean-qp":
        return MeanQp(problem, recipe.margin, recipe.cov)
    if recipe.kind == "governor":
        return Governor(problem, recipe.margin, recipe.cov)
    if recipe.kind == "hold-last":
        return HoldLast(problem, recipe.margin)
    if recipe.kind == "zero-on-loss":
        return ZeroOnLoss(problem, recipe.margin)
    if recipe.kind == "worst-case-delay":
        plant, allocation = problem.plant, config.risk.allocation
        kappa_x = kappa(config.smpc.delta_x, plant.n_x, len(problem.state_set.b), allocation)
        kappa_u = kappa(
            require_value(config.smpc.delta_u, "smpc.delta_u"), plant.n_u, len(problem.input_set.b), allocation
        )
        return WorstCaseDelay(problem, require_value(config.smpc.tau, "smpc.tau"), kappa_x, kappa_u)
    if recipe.kind == "pid" and recipe.gains is not None:
        return CascadedPid(problem, recipe.gains)
    return make_controller(recipe.kind, problem)


def make_filter_belief(config: Config) -> FilterBelief:
    """Return plant and noise that a controller with this configuration assumes of positions."""
    return FilterBelief(build_plant(config), config.estimator.position_std_m, config.estimator.initial_std)


_cache = threading.local()  # a controller has a state: each thread of a worker has its own


def get_controller(recipe: Recipe) -> BatchController:
    """Return the controller of a recipe; the last one is cached, as a worker mostly flies the same again."""
    if getattr(_cache, "key", None) != recipe.key:
        _cache.key = None
        _cache.controller = build_from_recipe(recipe)
        _cache.key = recipe.key
    controller: BatchController = _cache.controller
    return controller


def _build_smpc(recipe: Recipe) -> BatchSmpc:
    config, design, plant = recipe.config, recipe.design, build_plant(recipe.config)
    brake_gain_1ps = config.fallback.brake_gain_1ps
    if config.is_age_conditioned:
        conditioned, steps = build_conditioned(config, for_flight=False, cov=recipe.cov).solver, config.smpc.horizon
        return BatchSmpc(
            ConditionedDecider(conditioned, conditioned.problem.target), plant, steps, steps, brake_gain_1ps
        )
    if design is None:
        raise ValueError("an SMPC without a design")
    solver = build_solver(design, config)
    if isinstance(solver, ShortcutSolver):
        decider: Decider = ShortcutDecider(solver, design.target)
    else:
        decider = SequentialDecider(solver, design.target, (design.horizon, design.plant.n_u))
    return BatchSmpc(decider, plant, design.horizon, len(design.late), brake_gain_1ps)


def _tune_gains(config: Config, spec: CampaignSpec) -> PidGains:
    """Return gains tuned for the plant and link that the PID believes in, from the campaign's start."""
    spec = msgspec.structs.replace(spec, steps=min(spec.steps, TUNING_STEPS))
    believed = CellSetting(spec, config, config.plant, config.link, DisturbanceSpec(name="believed"))
    conditions = draw_conditions(believed, TUNING_FIRST, TUNING_RUNS)
    start = get_start_state(spec, config)
    return tune(build_problem(config), np.asarray(start), conditions.newest_captures, conditions.disturbances)


class BaselineSolver:
    """Baseline in the form of a solver; implements `uavctl.smpc.answer.Solver`.

    Args:
        name: Method that plans name.
        make: Makes the problem and the controller that fly to a target (n_x,).
    """

    def __init__(self, name: str, make: Callable[[Array], tuple[ControlProblem, BatchController]]) -> None:
        self._name, self._rehearsal = name, SilencePlanner(make)

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """See `Solver`; the preview is not used."""
        del preview
        problem, inputs = self._rehearsal.inputs(seq, x, target)
        if not np.isfinite(inputs).all():
            return Answer.failed(seq, SolveStatus.FAILED, self._name)
        low, high = problem.input_set.bounds
        applied, states = np.clip(inputs, low, high), [x]
        for u in applied:
            states.append(problem.plant.a @ states[-1] + problem.plant.b @ u)
        target_states, target_inputs = problem.target[np.newaxis], problem.u_target[np.newaxis]
        return msgspec.structs.replace(
            make_answer(seq, self._name, problem, np.array(states), applied, target_states, target_inputs),
            inputs=inputs,
        )
