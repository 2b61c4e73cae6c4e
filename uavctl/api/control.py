"""Configurations, models, decisions, a controller that is stepped by hand, and many runs on common draws."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.faults import check_fault_support
from uavctl.arrays import Array
from uavctl.config import Config, dump_config, parse
from uavctl.config import load as load_file
from uavctl.config.load import format_overrides
from uavctl.config.mission import MissionConfig
from uavctl.constraint_names import name_constraints
from uavctl.errors import ConfigError, ControllerError, UsageError, need
from uavctl.smpc.answer import Answer, Solver
from uavctl.smpc.batch import BatchController, Information, ask, name_class
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.smpc.link import AgeModel
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import Plant
from uavctl.wiring.controller import build_flight_design, build_plant, build_problem, build_solver
from uavctl.wiring.link import build_ages
from uavctl.wiring.rest import build_state_bounds, pad_state

if TYPE_CHECKING:
    import pandas
    import polars

    from uavctl.lab.campaign.controllers import CellSetting, Recipe

Source = Config | str | Path


def load(source: Source = "room", overrides: Mapping[str, object] | None = None, /, **keys: object) -> Config:
    """Load a configuration from a preset, a TOML file or another configuration, with some keys changed.

    Args:
        source: Name of a preset, path of a TOML file, or a configuration.
        overrides: Values by dotted key, as in `{"link.loss": 0.3}`.
        keys: Values of keys at the top, and tables of them, as in `duration_s=10, link={"loss": 0.3}`.

    Raises:
        ConfigError: With all problems found, one a line.
        UsageError: The overrides are not a mapping.
    """
    if not isinstance(overrides, Mapping | None):
        raise UsageError(f'{overrides!r} are not overrides by key; give {{"link.loss": 0.3}}')
    overrides_text = tuple(format_overrides({**(overrides or {}), **keys}))
    if isinstance(source, Config):
        loaded = parse(dump_config(source), source.name, overrides_text)
    else:
        loaded = load_file(str(source), overrides_text)
    check_fault_support(loaded)
    return loaded.config


def resolve_config(source: Source) -> Config:
    """Return a configuration, loaded if a name or a file is given."""
    return source if isinstance(source, Config) else load(source)


def plant(config: Source) -> Plant:
    """Return the plant x(k+1) = A x(k) + B u(k) + E w(k) of a configuration.

    Raises:
        ConfigError: The configuration is wrong.
        DesignError: Its plant is not valid.
    """
    return build_plant(resolve_config(config))


def link(config: Source) -> AgeModel:
    """Return the model of the link: `outage(j)` is the probability that the age is at least j steps.

    Raises:
        ConfigError: The configuration is wrong.
        DesignError: No position can be counted on.
    """
    return build_ages(resolve_config(config))


class Signal(NamedTuple):
    """A state or an input: its name, its unit (empty if unknown), and the column of tables."""

    name: str
    unit: str
    column: str


_SUFFIXES = {"m": "_m", "m/s": "_mps", "m/s²": "_mps2"}


def list_signals(config: Config) -> tuple[tuple[Signal, ...], tuple[Signal, ...]]:
    """Return the states and the inputs of a configuration's plant, in order."""
    model = build_plant(config)
    indices = model.position_index, model.velocity_index
    states = name_constraints((), model.n_x, model.axes, *indices, model.extra_states, len(model.gust_mps2)).states
    unit = "" if config.plant.model == "matrices" else "m/s²"
    inputs = [(f"{axis} input", unit) for axis in model.axes] or [(f"input {i}", "") for i in range(model.n_u)]
    signal_groups = (
        tuple(Signal(name, unit, re.sub(r"\W+", "_", name) + _SUFFIXES.get(unit, "")) for name, unit in named_units)
        for named_units in (states, inputs)
    )
    return next(signal_groups), next(signal_groups)


def get_limits(config: Config) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Return lower and upper limit of each state and of each input; infinite without a limit."""
    sets = config.sets
    lower, upper = build_state_bounds(sets, build_plant(config))
    states = list(zip(lower.tolist(), upper.tolist(), strict=True))
    return states, list(zip(sets.input_lower, sets.input_upper, strict=True))


class SolvedPlan(Answer, frozen=True, eq=False, kw_only=True):
    """The answer of `solve`, with its configuration."""

    config: Config

    def __repr__(self) -> str:
        """Return a few lines: the status, and the first input with its units."""
        text = super().__repr__()
        if not self.inputs.size:
            return text
        _, inputs = list_signals(self.config)
        first_input = ", ".join(
            f"{signal.name} {value:.4g} {signal.unit}".rstrip()
            for signal, value in zip(inputs, self.inputs[0], strict=True)
        )
        horizon_s = len(self.inputs) * self.config.plant.dt_s
        first_line, _, _ = text.partition("\n")
        return f"{first_line}\n  first input: {first_input}\n  looks {horizon_s:g} s ahead ({self.config.name})"


def solve(config: Source, state: ArrayLike, target: ArrayLike | None = None) -> SolvedPlan:
    """Solve one decision problem: the plan from a state to the configured target.

    The solver of a configuration is kept for the next call.

    Args:
        config: The configuration, with plant and scheme.
        state: State now (n_x,), axis by axis.
        target: Equilibrium to go to (n_x,); None: the configured one.

    Raises:
        ConfigError: The configuration is wrong.
        DesignError: There is no design.
        UsageError: The state is not one of this plant.
    """
    loaded = resolve_config(config)
    design, solver = _build_cached_solver(loaded)
    target_state = design.target if target is None else make_state(target, design.plant)
    answer = solver.solve(0, make_state(state, design.plant), target_state)
    return SolvedPlan(**msgspec.structs.asdict(answer), config=loaded)


@lru_cache(maxsize=8)
def _build_cached_solver(config: Config) -> tuple[AnyDesign, Solver]:
    design = build_flight_design(config)
    return design, build_solver(design, config)


def make_state(value: ArrayLike, plant: Plant) -> Array:
    """Return a state (n_x,) from the value of a caller, who may leave out gusts: they are zero then.

    Raises:
        UsageError: It is not n_x finite numbers.
    """
    try:
        state = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        state = np.empty(0)
    state = pad_state(state, plant) if state.ndim == 1 else state
    if state.shape != (plant.n_x,) or not np.isfinite(state).all():
        raise UsageError(f"{value!r} is not a state of this plant; give {plant.n_x} finite numbers")
    return state


class SteppedController:
    """Controller of one run that is called step by step, for a loop of your own.

    Args:
        controller: The controller.
        problem: Its control problem; the input limits are those of the actuators.
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
            state: State (n_x,) of a packet; None if no packet has come.
            age_steps: Steps since its capture; a packet older than the newest one changes nothing.

        Raises:
            UsageError: The first state is missing, not one of this plant, or older than the run.
            ControllerError: The answer of the controller has another shape, or is not finite.
        """
        step, plant = len(self._inputs), self.problem.plant
        if not isinstance(age_steps, int | np.integer) or not 0 <= age_steps <= step:
            raise UsageError(
                f"a packet of step {step} cannot be {age_steps} steps old; give a whole number, 0 to {step}"
            )
        if state is not None:
            reported_state = make_state(state, plant)
            if step - age_steps > self._newest:
                self._newest, self._state = step - age_steps, reported_state
        elif not step:
            raise UsageError("the first step needs a state: a controller has to know where it begins")
        applied = np.array(self._inputs).reshape(1, step, plant.n_u)
        measurement = Information(step, np.array([self._newest]), self._state[np.newaxis], applied)
        with np.errstate(over="ignore", invalid="ignore"):  # an infinite input is reported below
            requested = ask(self._controller, measurement, plant.n_u)[0]
        if not np.isfinite(requested).all():
            raise ControllerError(
                f"{name_class(self._controller)} answered {requested} in step {step} to a newest state of "
                f"{self._state}; an answer is {plant.n_u} finite numbers"
            )
        self._inputs.append(np.clip(requested, *self.problem.input_set.bounds))
        return self._inputs[-1].copy()


def controller(config: Source, kind: str = "smpc") -> SteppedController:
    """Return a controller to be stepped in a loop of your own, with states that may be lost.

    Args:
        config: The configuration of its problem.
        kind: `smpc`, a baseline of campaigns (`lqg`, `mean-qp` …), an entry point, or `module:Class`.

    Raises:
        ConfigError: The configuration is wrong, or not one of campaigns.
        DesignError: There is no such controller.
    """
    from uavctl.lab.campaign.controllers import build_from_recipe

    loaded = resolve_config(config)
    recipe, _ = make_cell(loaded, kind)
    return SteppedController(build_from_recipe(recipe), build_problem(loaded))


def make_cell(config: Config, kind: str, **spec: object) -> tuple[Recipe, CellSetting]:
    """Return the single cell of a campaign: the recipe of a controller, and the setting of its runs.

    Args:
        config: Configuration of the runs, and of the model of the controller.
        kind: Kind of the controller.
        spec: Further keys of the campaign, as docs/campaign-keys.md has them.

    Raises:
        ConfigError: Campaigns do not fly this configuration.
        UsageError: A key of the campaign is wrong.
        DesignError: There is no such controller.
    """
    from uavctl.lab.campaign.controllers import CellSetting, make_recipe
    from uavctl.lab.campaign.spec import CampaignSpec, compose, find_plant_problems

    document = {"name": "python", "config": config.name, "controller": [{"name": kind, "kind": kind}], **spec}
    try:
        campaign = msgspec.convert(document, CampaignSpec)
    except msgspec.ValidationError as error:
        text = str(error).replace("$.master", "seed").replace("$.", "")
        raise UsageError(f"{text}; docs/campaign-keys.md lists the keys") from error
    problems = tuple(
        f"{problem.key}: {problem.reason}; load it with {problem.todo}"
        for problem in find_plant_problems(config, (), "config")
    )
    if problems:
        raise ConfigError(problems)
    base = msgspec.structs.replace(config, mission=MissionConfig(), fence=())  # a run only goes to the target
    cells = compose(campaign, dump_config(base))
    believed_link = cells.get_believed_link(0, 0)
    recipe = make_recipe(
        cells.get_tuned_controller(0, believed_link), cells.believed_configs[0, believed_link], campaign
    )
    setting = CellSetting(
        campaign, cells.base, cells.flown_plants[0].plant, cells.flown_links[0].link, campaign.disturbance[0]
    )
    return recipe, setting


_RUN_ARRAYS = ("states", "inputs", "age", "cost", "state_violated", "input_violated", "failed")


@dataclass(frozen=True, eq=False)
class Runs:
    """N runs of T steps of one controller; run i of a seed has equal disturbances and losses for every controller."""

    config: Config
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
    errors: tuple[str, ...]  # why each run failed (N,); empty where it did not

    def __repr__(self) -> str:
        """Return two lines: the runs, and their figures."""
        runs, steps = self.cost.shape
        is_good = ~self.failed
        outside = self.state_violated[is_good].mean() if is_good.any() else 0.0
        cost = f"{self.cost[is_good].sum(axis=1).mean():.6g}" if is_good.any() else "none, all failed"
        first_error = next(filter(None, self.errors), "")
        failed = f", {int(self.failed.sum())} failed: {first_error}" if first_error else ""
        return (
            f"{runs} runs of {steps} steps by {self.controller} on {self.config.name}, seed {self.seed}{failed}\n"
            f"  mean cost {cost}, outside the state limits {outside:.2%} "
            f"of the time, oldest position {int(self.age_steps.max(initial=0))} steps"
        )

    def _columns(self) -> dict[str, list[Any]]:
        """Make columns of one row for each run and step.

        The last state of a run has no input, age or cost, the first no verdict.
        """
        (runs, steps), (states, inputs) = self.cost.shape, list_signals(self.config)
        has_input, has_verdict = np.arange(steps + 1) < steps, np.arange(steps + 1) > 0

        def spread(values: NDArray[Any], has_value: NDArray[np.bool_]) -> list[Any]:
            cells = np.full((runs, steps + 1), None, dtype=object)
            cells[:, has_value] = values
            return list(cells.ravel())

        table: dict[str, list[Any]] = {
            "run": np.repeat(np.arange(runs), steps + 1).tolist(),
            "step": np.tile(np.arange(steps + 1), runs).tolist(),
            "time_s": np.tile(self.time_s, runs).tolist(),
        }
        table |= {signal.column: self.states[:, :, i].ravel().tolist() for i, signal in enumerate(states)}
        table |= {signal.column: spread(self.inputs[:, :, i], has_input) for i, signal in enumerate(inputs)}
        for name, values, has_value in (
            ("age_steps", self.age_steps, has_input),
            ("cost", self.cost, has_input),
            ("state_violated", self.state_violated, has_verdict),
            ("input_violated", self.input_violated, has_input),
        ):
            table[name] = spread(values, has_value)
        return table | {"failed": np.repeat(self.failed, steps + 1).tolist()}

    def to_pandas(self) -> pandas.DataFrame:
        """Return one table, a row for each run and step: `run`, `step`, `time_s`, states, inputs, age and cost.

        Raises:
            ExtraMissingError: pandas is not there.
        """
        need("pandas", "pandas")
        import pandas as pd

        column_types = {"age_steps": "Int64", "state_violated": "boolean", "input_violated": "boolean"}
        columns = self._columns()
        _, inputs = list_signals(self.config)
        column_types |= dict.fromkeys(("cost", *(signal.column for signal in inputs)), "float64")
        return pd.DataFrame({name: pd.Series(cells, dtype=column_types.get(name)) for name, cells in columns.items()})

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
        config: Plant, link, limits, costs and target; also of the controller's model.
        controller: `smpc`, a baseline (`lqg`, `mean-qp` …), an entry point, or `module:Class`.
        runs: N.
        steps: T.
        seed: Run i's draws come from (seed, i), for each controller.
        start: State in which every run starts (n_x,); None: that of `[sim]`.
        measured: Content of a packet: the exact `state`, or a noisy `position` that a filter reads.

    Raises:
        ConfigError: The configuration is wrong, or not one of campaigns.
        DesignError: There is no such controller.
        UsageError: A number of runs or steps, or a start, that cannot be.
        ControllerError: The controller answers with another shape. What it raises itself is raised as it is.
        ExtraMissingError: pyarrow is not there.
    """
    need("pyarrow", "campaign")
    from uavctl.lab.campaign.spec import CHUNK
    from uavctl.lab.campaign.tasks import Task, fly_task

    loaded = resolve_config(config)
    start_state = () if start is None else tuple(make_state(start, build_plant(loaded)).tolist())
    recipe, setting = make_cell(
        loaded, controller, runs=runs, steps=steps, master=seed, start=start_state, measured=measured
    )
    task = Task(0, 0, runs, setting, recipe)
    parts = [fly_task(task, first, min(CHUNK, runs - first))[0] for first in range(0, runs, CHUNK)]

    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _RUN_ARRAYS}
    arrays["age_steps"] = arrays.pop("age")
    errors = tuple(error for part in parts for error in part.errors)
    return Runs(
        loaded, controller, seed, np.arange(steps + 1, dtype=np.float64) * loaded.plant.dt_s, errors=errors, **arrays
    )
