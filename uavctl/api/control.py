"""Configurations, models, decisions, a controller that is stepped by hand, and many runs on common draws."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.faults import check_fault_support
from uavctl.build.controller import build_flight_design, build_plant, build_problem, build_solver
from uavctl.build.link import build_ages
from uavctl.config import Config, dump_config, parse
from uavctl.config import load as load_file
from uavctl.config.load import format_overrides
from uavctl.config.mission import MissionConfig
from uavctl.errors import ConfigError, UavctlError, UsageError, need
from uavctl.records import names_of
from uavctl.smpc.answer import Answer, Solver
from uavctl.smpc.batch import BatchController, News
from uavctl.smpc.conditioned.planner import AnyDesign
from uavctl.smpc.link import AgeModel
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import Plant

if TYPE_CHECKING:
    import pandas
    import polars

    from uavctl.lab.campaign.controllers import Recipe, Setting

Array = NDArray[np.float64]
Source = Config | str | Path


def load(source: Source = "room", overrides: Mapping[str, object] | None = None, /, **keys: object) -> Config:
    """Load a configuration: a preset's name, a TOML file, or one that is there, with some keys given anew.

    Args:
        source: What it is made from.
        overrides: Values by dotted key, as in `{"link.loss": 0.3}`.
        keys: Values of keys at the top, and tables of them, as in `duration_s=10, link={"loss": 0.3}`.

    Raises:
        ConfigError: With all problems found, one a line.
        UsageError: The overrides are no mapping.
    """
    if not isinstance(overrides, Mapping | None):
        raise UsageError(f'{overrides!r} does not say which key is to differ; give {{"link.loss": 0.3}}')
    given = tuple(format_overrides({**(overrides or {}), **keys}))
    if isinstance(source, Config):
        loaded = parse(dump_config(source), source.name, given)
    else:
        loaded = load_file(str(source), given)
    check_fault_support(loaded)
    return loaded.config


def loaded(source: Source) -> Config:
    """Return a configuration, loaded if a name or a file is given."""
    return source if isinstance(source, Config) else load(source)


def plant(config: Source) -> Plant:
    """Return the plant x(k+1) = A x(k) + B u(k) + E w(k) of a configuration.

    Raises:
        ConfigError: The configuration is wrong.
        DesignError: It is no plant.
    """
    return build_plant(loaded(config))


def link(config: Source) -> AgeModel:
    """Return the model of the link: `outage(j)` is the probability that the age is at least j steps.

    Raises:
        ConfigError: The configuration is wrong.
        DesignError: No position can be counted on.
    """
    return build_ages(loaded(config))


class Signal(NamedTuple):
    """A state or an input: its name, its unit (empty where that is not known), and the column of tables."""

    name: str
    unit: str
    column: str


_SUFFIXES = {"m": "_m", "m/s": "_mps", "m/s²": "_mps2"}


def signals(config: Config) -> tuple[tuple[Signal, ...], tuple[Signal, ...]]:
    """Return the states and the inputs of a configuration's plant, in order."""
    of = build_plant(config)
    states = names_of((), of.n_x, of.axes, of.position_index, of.velocity_index, of.further).states
    unit = "" if config.plant.model == "matrices" else "m/s²"
    inputs = [(f"{axis} input", unit) for axis in of.axes] or [(f"input {i}", "") for i in range(of.n_u)]
    made = (
        tuple(Signal(name, unit, re.sub(r"\W+", "_", name) + _SUFFIXES.get(unit, "")) for name, unit in given)
        for given in (states, inputs)
    )
    return next(made), next(made)


def limits_of(config: Config) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Return lower and upper limit of each state and of each input; infinite where there is none."""
    sets = config.sets
    states = list(zip(sets.state_lower, sets.state_upper, strict=True))
    return states, list(zip(sets.input_lower, sets.input_upper, strict=True))


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Answer):
    """The answer of `solve`, with the configuration that it was asked for."""

    config: Config = field(kw_only=True)

    def __repr__(self) -> str:
        """Return a few lines: how it ended, and the first input with its units."""
        text = super().__repr__()
        if not self.inputs.size:
            return text
        _, inputs = signals(self.config)
        begins = ", ".join(
            f"{one.name} {value:.4g} {one.unit}".rstrip() for one, value in zip(inputs, self.inputs[0], strict=True)
        )
        ahead_s = len(self.inputs) * self.config.plant.dt_s
        return (
            f"{text.partition(chr(10))[0]}\n  first input: {begins}\n  looks {ahead_s:g} s ahead ({self.config.name})"
        )


def solve(config: Source, state: ArrayLike, target: ArrayLike | None = None) -> Plan:
    """Solve one decision problem: the plan from a state to the configured target.

    The solver of a configuration is kept for the next call.

    Args:
        config: What is flown, and with which scheme.
        state: State now (n_x,), axis by axis.
        target: Equilibrium to go to (n_x,); None: the configured one.

    Raises:
        ConfigError: The configuration is wrong.
        DesignError: There is no design.
        UsageError: The state is none of this plant.
    """
    found = loaded(config)
    design, solver = _solver(found)
    n_x = design.plant.n_x
    wanted = design.target if target is None else state_of(target, n_x)
    answer = solver.solve(0, state_of(state, n_x), wanted)
    return Plan(**{one.name: getattr(answer, one.name) for one in fields(Answer)}, config=found)


@lru_cache(maxsize=8)
def _solver(config: Config) -> tuple[AnyDesign, Solver]:
    design = build_flight_design(config)
    return design, build_solver(design, config)


def state_of(given: ArrayLike, n_x: int) -> Array:
    """Return a state (n_x,) that a person gave.

    Raises:
        UsageError: It is not n_x finite numbers.
    """
    try:
        state = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        state = np.empty(0)
    if state.shape != (n_x,) or not np.isfinite(state).all():
        raise UsageError(f"{given!r} is not a state of this plant; give {n_x} finite numbers")
    return state


class SteppedController:
    """A controller of one run that is asked step by step; implements nothing but what a loop of your own needs.

    Args:
        controller: The controller.
        problem: What it is made for; its input limits are the actuators'.
    """

    def __init__(self, controller: BatchController, problem: ControlProblem) -> None:
        self._controller, self.problem = controller, problem
        self.reset()

    def __repr__(self) -> str:
        """Return one line."""
        return f"{type(self._controller).__name__} after {len(self._inputs)} steps, for a {self.problem.plant!r}"

    def reset(self) -> None:
        """Begin a new run."""
        self._controller.begin(1)
        self._newest, self._state = -1, np.empty(0)
        self._inputs: list[Array] = []

    def step(self, state: ArrayLike | None, age_steps: int = 0) -> Array:
        """Return the input (n_u,) that acts in the next step, within the actuators' limits.

        Args:
            state: State (n_x,) that a packet tells; None where none has come.
            age_steps: How many steps ago it was captured; older ones than are known change nothing.

        Raises:
            UsageError: The first state is missing, it is none of this plant, or older than the run.
            UavctlError: The controller asked for numbers that are not finite.
        """
        step, plant = len(self._inputs), self.problem.plant
        if not 0 <= age_steps <= step:
            raise UsageError(f"a packet of step {step} cannot be {age_steps} steps old; give 0 to {step}")
        if state is not None:
            told = state_of(state, plant.n_x)
            if step - age_steps > self._newest:
                self._newest, self._state = step - age_steps, told
        elif not step:
            raise UsageError("the first step needs a state: a controller has to know where it begins")
        acted = np.array(self._inputs).reshape(1, step, plant.n_u)
        news = News(step, np.array([self._newest]), self._state[np.newaxis], acted)
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is told
            asked = self._controller.act(news)[0]
        if not np.isfinite(asked).all():
            raise UavctlError(f"the controller asks for {asked} in step {step}; is the state far beyond the limits?")
        self._inputs.append(np.clip(asked, *self.problem.input_set.bounds))
        return self._inputs[-1].copy()


def controller(config: Source, kind: str = "smpc") -> SteppedController:
    """Return a controller to be stepped in a loop of your own, told states that may be lost.

    Args:
        config: What it is made for.
        kind: `smpc`, a baseline of campaigns (`lqg`, `mean-qp` …), an entry point, or `module:Class`.

    Raises:
        ConfigError: The configuration is wrong, or not one of campaigns.
        DesignError: There is no such controller.
    """
    from uavctl.lab.campaign.controllers import build

    found = loaded(config)
    recipe, _ = cell_of(found, kind)
    return SteppedController(build(recipe), build_problem(found))


def cell_of(config: Config, kind: str, **spec: object) -> tuple[Recipe, Setting]:
    """Return the one cell of a campaign: the recipe of a controller, and what its runs meet.

    Args:
        config: What is flown, and believed.
        kind: Kind of the controller.
        spec: Further keys of the campaign, as docs/campaign-keys.md has them.

    Raises:
        ConfigError: The configuration is none that campaigns fly.
        UsageError: A key of the campaign is wrong.
        DesignError: There is no such controller.
    """
    from uavctl.lab.campaign.controllers import Setting, recipe_for
    from uavctl.lab.campaign.spec import CampaignSpec, compose, flown

    given = {"name": "python", "config": config.name, "controller": [{"name": kind, "kind": kind}], **spec}
    try:
        campaign = msgspec.convert(given, CampaignSpec)
    except msgspec.ValidationError as error:
        raise UsageError(f"{error}; docs/campaign-keys.md says what is possible") from error
    wrong = tuple(f"{one.key}: {one.reason}; load it with {one.todo}" for one in flown(config, (), "config"))
    if wrong:
        raise ConfigError(wrong)
    base = msgspec.structs.replace(config, mission=MissionConfig(), fence=())  # runs go to the target alone
    made = compose(campaign, dump_config(base))
    believed = made.believed_link(0, 0)
    recipe = recipe_for(made.tuned(0, believed), made.believed[0, believed], campaign)
    setting = Setting(campaign, made.base, made.flown_plant[0].plant, made.flown_link[0].link, campaign.disturbance[0])
    return recipe, setting


_ARRAYS = ("states", "inputs", "age", "cost", "state_violated", "input_violated", "failed")


@dataclass(frozen=True, eq=False)
class Runs:
    """N runs of T steps of one controller; run i of a seed meets the same whoever flies."""

    config: Config  # what was flown
    controller: str  # kind of the controller
    seed: int  # of the draws
    time_s: Array  # (T+1,), of the states
    states: Array  # (N, T+1, n_x)
    inputs: Array  # inputs that acted (N, T, n_u)
    age_steps: NDArray[np.intp]  # age of information (N, T)
    cost: Array  # stage costs (N, T)
    state_violated: NDArray[np.bool_]  # whether x(1) … x(T) left the limits (N, T)
    input_violated: NDArray[np.bool_]  # whether the input asked for was outside its limits (N, T)
    failed: NDArray[np.bool_]  # whether a run ended in numbers that are not finite (N,)

    def __repr__(self) -> str:
        """Return two lines: what was flown, and what it came to."""
        runs, steps = self.cost.shape
        good = ~self.failed
        cost = f"{self.cost[good].sum(axis=1).mean():.6g}" if good.any() else "none, all failed"
        failed = f", {int(self.failed.sum())} failed" if self.failed.any() else ""
        return (
            f"{runs} runs of {steps} steps by {self.controller} on {self.config.name}, seed {self.seed}{failed}\n"
            f"  mean cost {cost}, outside the state limits {self.state_violated[good].mean() if good.any() else 0:.2%} "
            f"of the time, oldest position {int(self.age_steps.max(initial=0))} steps"
        )

    def _columns(self) -> dict[str, list[Any]]:
        """One row for each run and step; the last state of a run has no input, age or cost, the first no verdict."""
        (runs, steps), (states, inputs) = self.cost.shape, signals(self.config)
        before, after = np.arange(steps + 1) < steps, np.arange(steps + 1) > 0

        def spread(values: NDArray[Any], where: NDArray[np.bool_]) -> list[Any]:
            cells = np.full((runs, steps + 1), None, dtype=object)
            cells[:, where] = values
            return list(cells.ravel())

        found: dict[str, list[Any]] = {
            "run": np.repeat(np.arange(runs), steps + 1).tolist(),
            "step": np.tile(np.arange(steps + 1), runs).tolist(),
            "time_s": np.tile(self.time_s, runs).tolist(),
        }
        found |= {one.column: self.states[:, :, i].ravel().tolist() for i, one in enumerate(states)}
        found |= {one.column: spread(self.inputs[:, :, i], before) for i, one in enumerate(inputs)}
        for name, values, where in (
            ("age_steps", self.age_steps, before),
            ("cost", self.cost, before),
            ("state_violated", self.state_violated, after),
            ("input_violated", self.input_violated, before),
        ):
            found[name] = spread(values, where)
        return found | {"failed": np.repeat(self.failed, steps + 1).tolist()}

    def to_pandas(self) -> pandas.DataFrame:
        """Return one table, a row for each run and step: `run`, `step`, `time_s`, states, inputs, age and cost.

        Raises:
            ExtraMissingError: pandas is not there.
        """
        need("pandas", "pandas")
        import pandas as pd

        kinds = {"age_steps": "Int64", "state_violated": "boolean", "input_violated": "boolean"}
        columns = self._columns()
        _, inputs = signals(self.config)
        kinds |= dict.fromkeys(("cost", *(one.column for one in inputs)), "float64")
        return pd.DataFrame({name: pd.Series(cells, dtype=kinds.get(name)) for name, cells in columns.items()})

    def to_polars(self) -> polars.DataFrame:
        """Return the same table as a polars frame.

        Raises:
            ExtraMissingError: polars is not there.
        """
        need("polars", "polars")
        import polars as pl

        plain = {
            name: [cell.item() if isinstance(cell, np.generic) else cell for cell in cells]
            for name, cells in self._columns().items()
        }
        return pl.DataFrame(plain)


def simulate(
    config: Source,
    controller: str = "smpc",
    *,
    runs: int = 100,
    steps: int = 50,
    seed: int = 0,
    start: ArrayLike | None = None,
    measured: Literal["state", "position"] = "state",
) -> Runs:
    """Fly many runs of a controller, as one cell of `uavctl campaign` does.

    Args:
        config: Plant, link, limits, costs and target; what the controller believes, too.
        controller: `smpc`, a baseline (`lqg`, `mean-qp` …), an entry point, or `module:Class`.
        runs: N.
        steps: T.
        seed: Run i's draws come from (seed, i), whatever the controller.
        start: State in which every run starts (n_x,); None: that of `[sim]`.
        measured: What a packet tells: the exact `state`, or a noisy `position` that a filter reads.

    Raises:
        ConfigError: The configuration is wrong, or not one of campaigns.
        DesignError: There is no such controller.
        UsageError: A number of runs or steps, or a start, that cannot be.
        ExtraMissingError: pyarrow is not there.
    """
    need("pyarrow", "campaign")
    from uavctl.lab.campaign.spec import CHUNK
    from uavctl.lab.campaign.tasks import Task, flown

    found = loaded(config)
    begin = () if start is None else tuple(state_of(start, build_plant(found).n_x).tolist())
    recipe, setting = cell_of(found, controller, runs=runs, steps=steps, master=seed, start=begin, measured=measured)
    task = Task(0, 0, runs, setting, recipe)
    parts = [flown(task, first, min(CHUNK, runs - first))[0] for first in range(0, runs, CHUNK)]

    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
    arrays["age_steps"] = arrays.pop("age")
    return Runs(found, controller, seed, np.arange(steps + 1, dtype=np.float64) * found.plant.dt_s, **arrays)
