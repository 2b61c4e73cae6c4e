"""Controllers of a campaign's cells, the settings they fly in, and baselines within the flight core."""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from uavctl.build.controller import (
    build_conditioned,
    build_design,
    build_plant,
    build_problem,
    build_solver,
    needed,
    start_state,
)
from uavctl.build.rest import check_axes
from uavctl.config import Config
from uavctl.config.link import LinkConfig
from uavctl.config.types import PlantConfig
from uavctl.lab.campaign.spec import CampaignSpec, ControllerSpec, DisturbanceSpec, make_controller
from uavctl.lab.campaign.world import FilterBelief, Scene, draw, draw_noise, known, newest_of
from uavctl.records import SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.smpc.baselines import Governor, HoldLast, Lqg, MeanQp, PacketisedPredictive, WorstCaseDelay, ZeroOnLoss
from uavctl.smpc.batch import BatchController, BatchSmpc, Counts, Decider, SequentialDecider
from uavctl.smpc.conditioned.planner import ConditionedDecider
from uavctl.smpc.estimate import innovation_form
from uavctl.smpc.hahn_stursberg.design import Design, kappa
from uavctl.smpc.hahn_stursberg.frozen import ShortcutDecider, ShortcutSolver
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.outside import SilencePlanner, make_answer
from uavctl.smpc.pid import CascadedPid, PidGains, tune

# Disturbances of many runs: each kind a transform of the same standard normal draws.


Array = NDArray[np.float64]

_DEGREES = 4.0  # of Student's t; its variance is degrees / (degrees - 2)


def disturbances(spec: DisturbanceSpec, w: Array, normal: Array) -> Array:
    """Return w(k) of every run (N, T, n_w).

    Args:
        spec: The kind; all have mean `bias` and covariance scale² W, gusts as they are once they have long blown.
        w: W (n_w, n_w).
        normal: Standard normal draws (N, T, n_w), see `Chances.normal`.
    """
    values, vectors = np.linalg.eigh(w)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T  # the symmetric one, which is unique
    shaped = spec.scale * _shaped(spec, normal) @ root
    return np.asarray(shaped + spec.bias * np.sqrt(np.diag(w)), dtype=np.float64)


def _shaped(spec: DisturbanceSpec, normal: Array) -> Array:
    """Return draws of mean 0 and covariance I."""
    if spec.kind == "uniform":
        return np.asarray(np.sqrt(3.0) * (2.0 * ndtr(normal) - 1.0), dtype=np.float64)
    if spec.kind == "heavy":
        # By the lower tail on either side: the upper one's probability would be rounded to 1.
        tail = stdtrit(_DEGREES, ndtr(-np.abs(normal)))
        return np.asarray(-np.sign(normal) * tail * np.sqrt((_DEGREES - 2.0) / _DEGREES), dtype=np.float64)
    if spec.kind == "gusts":
        gusts = normal.copy()
        for k in range(1, normal.shape[1]):
            gusts[:, k] = spec.memory * gusts[:, k - 1] + np.sqrt(1.0 - spec.memory**2) * normal[:, k]
        return gusts
    return normal


# What a cell's runs meet, whoever flies them: plant, limits, costs, start, link, disturbance.


_START = 2  # child of a run's seed that draws its start; 0 and 1 are those of `chance.draw`


@dataclass(frozen=True, eq=False)
class Setting:
    """Setting of a cell: everything but its controller."""

    spec: CampaignSpec  # the campaign's specification: steps, seed, start
    base: Config  # the base configuration, which every cell is judged by
    plant: PlantConfig  # the plant that flies
    link: LinkConfig  # the link that it flies on
    disturbance: DisturbanceSpec  # the disturbance


@dataclass(frozen=True, eq=False)
class Met:
    """Disturbances, losses and noise that N runs of T steps meet."""

    scene: Scene  # the scene
    newest: Counts  # capture step of the newest position known in each step (N, T)
    disturbances: Array  # w (N, T, n_w)
    known: Counts  # step that knows the position of each step first (N, T)
    noise: Array | None  # noise of the positions (N, T, n_axes) [m]; None where the state is measured


def met(setting: Setting, first: int, runs: int) -> Met:
    """Return what the runs `first` … `first` + `runs` - 1 meet.

    Raises:
        DesignError: The plant that flies is none.
    """
    spec, flown = setting.spec, msgspec.structs.replace(setting.base, plant=setting.plant)
    plant, judged = build_plant(flown), build_problem(setting.base)
    chances = draw(spec.master, first, runs, spec.steps, plant.n_w)
    scene = Scene(
        plant=plant,
        state_set=judged.state_set,
        input_set=judged.input_set,
        q_x=judged.q_x,
        q_u=judged.q_u,
        target=judged.target,
        u_target=judged.u_target,
        start=_starts(setting, first, runs),
    )
    first_known = known(setting.link, plant.dt_s, chances.link)
    noise = None
    if spec.measured == "position":
        std_m = setting.base.sim.camera.noise_std_m
        noise = std_m * draw_noise(spec.master, first, runs, spec.steps, len(plant.axes))
    return Met(
        scene, newest_of(first_known), disturbances(setting.disturbance, plant.w, chances.normal), first_known, noise
    )


def start_of(spec: CampaignSpec, base: Config) -> Array:
    """Return the state in which runs start (n_x,); with a box, its middle."""
    if spec.start:
        return np.array(spec.start, dtype=np.float64)
    if spec.start_box:
        middle: Array = np.array(spec.start_box, dtype=np.float64).mean(axis=0)
        return middle
    return start_state(base, build_plant(base))


def _starts(setting: Setting, first: int, runs: int) -> Array:
    """Return x(0) of every run (N, n_x)."""
    spec = setting.spec
    if not spec.start_box:
        return np.tile(start_of(spec, setting.base), (runs, 1))
    lower, upper = np.array(spec.start_box, dtype=np.float64)
    draws = np.empty((runs, lower.size))
    for i in range(runs):
        seed = np.random.SeedSequence([spec.master, first + i]).spawn(_START + 1)[_START]
        np.random.default_rng(seed).random(out=draws[i])
    return np.asarray(lower + (upper - lower) * draws, dtype=np.float64)


# From what a controller is to believe to the controller: first a recipe, once, then as many controllers as workers.


# Runs that a PID is tuned on: beyond the last index that a campaign can fly.
TUNING_FIRST, TUNING_RUNS = 10_000_000, 64
TUNING_STEPS = 200  # longer runs show nothing new, and every candidate flies them all

_OF_POSITIONS = ("pid",)  # it goes by positions and velocities, whatever else a plant has


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
    cov: NDArray[np.float64] | None = None


def recipe_for(given: ControllerSpec, config: Config, spec: CampaignSpec) -> Recipe:
    """Make a recipe: design and gains, which take time or depend on chance.

    Args:
        config: The configuration that it believes in.

    Raises:
        DesignError: There is no such controller.
    """
    kind = config.smpc.controller or "smpc" if given.kind == "smpc" else given.kind
    made = Recipe("", kind, config, margin=given.margin)
    if kind in _OF_POSITIONS or spec.measured == "position":
        check_axes(config)
    if spec.measured == "position":
        sight = sight_of(config)
        made = replace(made, cov=innovation_form(sight.plant, sight.position_std_m, 0.0, 0).estimate_cov)
    if kind == "smpc" and not config.is_age_conditioned:
        made = replace(made, design=build_design(config))
    elif kind == "pid":
        made = replace(made, gains=_tuned(config, spec))
    made = replace(made, key=hashlib.sha256(pickle.dumps(made)).hexdigest())
    if made.design is None:
        build(made)  # what needs no design is refused here, not in a worker
    return made


def build(recipe: Recipe) -> BatchController:
    """Build a controller from a recipe.

    Raises:
        DesignError: There is none.
    """
    config = recipe.config
    if recipe.kind == "smpc":
        return _smpc(recipe)
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
        kappa_u = kappa(needed(config.smpc.delta_u, "smpc.delta_u"), plant.n_u, len(problem.input_set.b), allocation)
        return WorstCaseDelay(problem, needed(config.smpc.tau, "smpc.tau"), kappa_x, kappa_u)
    if recipe.kind == "pid" and recipe.gains is not None:
        return CascadedPid(problem, recipe.gains)
    return make_controller(recipe.kind, problem)


def sight_of(config: Config) -> FilterBelief:
    """Return what a controller with this configuration believes of positions."""
    return FilterBelief(build_plant(config), config.estimator.position_std_m, config.estimator.initial_std)


_built = threading.local()  # a controller has a state: each thread of a worker has its own


def built(recipe: Recipe) -> BatchController:
    """Return a controller of a recipe; the last one is kept, as a worker mostly goes on with the same."""
    if getattr(_built, "key", None) != recipe.key:
        _built.key = None
        _built.controller = build(recipe)
        _built.key = recipe.key
    controller: BatchController = _built.controller
    return controller


def _smpc(recipe: Recipe) -> BatchSmpc:
    config, design, plant = recipe.config, recipe.design, build_plant(recipe.config)
    brake_gain_1ps = config.fallback.brake_gain_1ps
    if config.is_age_conditioned:
        conditioned, steps = build_conditioned(config, flown=False, cov=recipe.cov).solver, config.smpc.horizon
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


def _tuned(config: Config, spec: CampaignSpec) -> PidGains:
    """Return gains tuned for what the PID believes in, from the campaign's start."""
    spec = msgspec.structs.replace(spec, steps=min(spec.steps, TUNING_STEPS))
    believed = Setting(spec, config, config.plant, config.link, DisturbanceSpec(name="believed"))
    meets = met(believed, TUNING_FIRST, TUNING_RUNS)
    start = start_of(spec, config)
    return tune(build_problem(config), np.asarray(start), meets.newest, meets.disturbances)


# Controllers of ours in place of the SMPC, within the flight core: its filter, fallback and last gate stay.


class BaselineSolver:
    """Baseline in the form of a solver; implements `uavctl.smpc.answer.Solver`.

    Args:
        name: Method that plans name.
        make: Makes the problem and the controller that fly to a target (n_x,).
    """

    def __init__(self, name: str, make: Callable[[Array], tuple[ControlProblem, BatchController]]) -> None:
        self._name, self._rehearsal = name, SilencePlanner(make)

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        """See `Solver`; `preview` is not used."""
        del preview
        problem, inputs = self._rehearsal.inputs(seq, x, target)
        if not np.isfinite(inputs).all():
            return Answer.failed(seq, SolveStatus.FAILED, self._name)
        low, high = problem.input_set.bounds
        acts, states = np.clip(inputs, low, high), [x]
        for u in acts:
            states.append(problem.plant.a @ states[-1] + problem.plant.b @ u)
        wanted, held = problem.target[np.newaxis], problem.u_target[np.newaxis]
        return replace(make_answer(seq, self._name, problem, np.array(states), acts, wanted, held), inputs=inputs)
