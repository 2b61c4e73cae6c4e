"""From what a controller is to believe to the controller: first a recipe, once, then as many controllers as workers."""

from __future__ import annotations

import hashlib
import pickle
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from uavctl.build import build_conditioned, build_design, build_plant, build_problem, build_solver, needed
from uavctl.campaign.positions import FilterBelief
from uavctl.campaign.setting import Setting, met, start_of
from uavctl.campaign.spec import CampaignSpec, ControllerSpec, DisturbanceSpec, Kind
from uavctl.config import Config
from uavctl.library_bytes import StoredLibrary, decode
from uavctl.smpc.answer import Solver
from uavctl.smpc.baselines import (
    CascadedPid,
    Governor,
    HoldLast,
    Lqg,
    MeanQp,
    PacketisedPredictive,
    PidGains,
    WorstCaseDelay,
    ZeroOnLoss,
    tune,
)
from uavctl.smpc.batch import BatchController
from uavctl.smpc.batch_smpc import BatchSmpc, Decider, OneByOne
from uavctl.smpc.conditioned import ConditionedDecider
from uavctl.smpc.design import Design
from uavctl.smpc.explicit import ExplicitDecider
from uavctl.smpc.innovation import innovations
from uavctl.smpc.library import Library
from uavctl.smpc.risk import kappa

# Runs that a PID is tuned on: beyond the last index that a campaign can fly.
TUNING_FIRST, TUNING_RUNS = 10_000_000, 64
TUNING_STEPS = 200  # longer runs show nothing new, and every candidate flies them all

LibraryFor = Callable[[Config, Design], StoredLibrary | None]


@dataclass(frozen=True, eq=False)
class Recipe:
    """All that a controller is built from; it can be sent to another process.

    Attributes:
        key: Hash of all the others.
        kind: What it is.
        config: The configuration that it believes in.
        design: Its design, of the SMPC with scheme `hahn-stursberg`.
        library: Its policy library as `library_bytes.decode` reads it, of the SMPC with solver.method = `library`.
        library_id: The library's hash.
        gains: The gains of a PID.
        margin: Of an MPC without back-offs, see `ControllerSpec`.
        cov: Covariance (n_x, n_x) that the simple margins begin with; None: the state is measured.
    """

    key: str
    kind: Kind
    config: Config
    design: Design | None = None
    library: bytes | None = None
    library_id: str | None = None
    gains: PidGains | None = None
    margin: float = 0.0
    cov: NDArray[np.float64] | None = None


def recipe_for(given: ControllerSpec, config: Config, spec: CampaignSpec, library_for: LibraryFor) -> Recipe:
    """Make design, library and gains: what takes its time, or depends on chance.

    Args:
        given: What is asked for.
        config: The configuration that it believes in.
        spec: The campaign.
        library_for: Gives the policy library of a design.

    Raises:
        DesignError: There is no such controller.
    """
    made = Recipe("", given.kind, config, margin=given.margin)
    if spec.measured == "position":
        sight = sight_of(config)
        made = replace(made, cov=innovations(sight.plant, sight.position_std_m, 0.0, 0).estimate_cov)
    if given.kind == "smpc" and not config.conditioned:
        design = build_design(config)
        stored = library_for(config, design)
        if stored is None:
            made = replace(made, design=design)
        else:
            made = replace(made, design=design, library=stored.data, library_id=stored.library_id)
    elif given.kind == "pid":
        made = replace(made, gains=_tuned(config, spec))
    made = replace(made, key=hashlib.sha256(pickle.dumps(made)).hexdigest())
    if made.design is None:
        build(made)  # what needs no design is refused here, not in a worker
    return made


def build(recipe: Recipe) -> BatchController:
    """A controller of a recipe.

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
    if recipe.gains is None:
        raise ValueError("a PID without gains")
    return CascadedPid(problem, recipe.gains)


def sight_of(config: Config) -> FilterBelief:
    """What a controller that believes in a configuration makes of positions."""
    return FilterBelief(build_plant(config), config.estimator.position_std_m, config.estimator.initial_std)


_built = threading.local()  # a controller has a state: each thread of a worker has its own


def built(recipe: Recipe) -> BatchController:
    """A controller of a recipe; the last one is kept, since a worker mostly goes on with the same."""
    if getattr(_built, "key", None) != recipe.key:
        _built.key = None
        _built.controller = build(recipe)
        _built.key = recipe.key
    controller: BatchController = _built.controller
    return controller


def _smpc(recipe: Recipe) -> BatchSmpc:
    config, design, plant = recipe.config, recipe.design, build_plant(recipe.config)
    brake_gain_1ps = config.fallback.brake_gain_1ps
    if config.conditioned:
        solver, steps = build_conditioned(config, flown=False, cov=recipe.cov).solver, config.smpc.horizon
        return BatchSmpc(ConditionedDecider(solver, solver.problem.target), plant, steps, steps, brake_gain_1ps)
    if design is None:
        raise ValueError("an SMPC without a design")
    library = None if recipe.library is None else decode(recipe.library).library
    decider = _decider(design, library, build_solver(design, config, library))
    return BatchSmpc(decider, plant, design.horizon, len(design.late), brake_gain_1ps)


def _decider(design: Design, library: Library | None, solver: Solver) -> Decider:
    if library is None:
        return OneByOne(solver, design.target, (design.horizon, design.plant.n_u))
    return ExplicitDecider(design, library, solver, design.target)


def _tuned(config: Config, spec: CampaignSpec) -> PidGains:
    """The gains that suit what the PID believes in, from where the campaign starts."""
    spec = msgspec.structs.replace(spec, steps=min(spec.steps, TUNING_STEPS))
    believed = Setting(spec, config, config.plant, config.link, DisturbanceSpec(name="believed"))
    meets = met(believed, TUNING_FIRST, TUNING_RUNS)
    start = start_of(spec, config)
    return tune(build_problem(config), np.asarray(start), meets.newest, meets.disturbances)
