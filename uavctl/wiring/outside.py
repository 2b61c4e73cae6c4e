"""Identity of our code by hashes, and controllers of other packages: how they are found, made and identified.

A controller is made with its `ControlProblem` (plant, limits, weights, target, horizon). A controller of flights has
`plan(request)` (`uavctl.smpc.outside.FlightPlanner`). A controller of campaigns has `begin(runs)` and `act(news)`, once
a step for all runs together (`uavctl.smpc.batch.BatchController`), and can fly too. docs/extending.md has both in full.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Collection
from functools import cache
from importlib import import_module, resources
from importlib.metadata import entry_points
from pathlib import Path
from typing import TypeVar, cast

from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.load import find_nearest
from uavctl.errors import RAISED, DesignError, in_words
from uavctl.smpc.batch import BatchController
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.outside import FlightPlanner, OutsideSolver, SilencePlanner, retarget
from uavctl.smpc.plant import digest


@cache
def compute_code_id() -> str:
    """Return the hash of the code that makes a flight's records: from bytes to estimate, plan, decision and bytes."""
    return digest(
        tuple(read_sources(f"uavctl{name}") for name in ("", ".config", ".flight", ".mavlink", ".smpc", ".wiring"))
    )


def read_sources(package: str) -> tuple[tuple[str, bytes], ...]:
    """Return names and contents of a package's modules and subpackages; of `uavctl` only its own modules."""
    sources = []
    for entry in resources.files(package).iterdir():
        if entry.name.endswith(".py"):
            sources.append((f"{package}.{entry.name}", entry.read_bytes()))
        elif package != "uavctl" and (entry / "__init__.py").is_file():
            sources.extend(read_sources(f"{package}.{entry.name}"))
    return tuple(sorted(sources))


ENTRY_POINT_GROUP = "uavctl.controllers"
CONTROLLER_KEY = "smpc.controller"
PLAN_METHODS, BATCH_METHODS = ("plan",), ("begin", "act")
_ID_LENGTH = 12

Made = TypeVar("Made")


def list_installed(exclude: Collection[str] = ()) -> tuple[str, ...]:
    """Return the names of the controllers that installed packages offer."""
    return tuple(sorted({point.name for point in entry_points(group=ENTRY_POINT_GROUP)} - set(exclude)))


def load_controller_class(
    name: str, key: str, kinds: tuple[tuple[str, ...], ...], known_names: Collection[str] = ()
) -> Callable[[ControlProblem], object]:
    """Return the class of a controller of another package; modules of the working directory count.

    Args:
        name: Its entry point, or `module:Class`.
        key: Key of the configuration that names it.
        kinds: Sets of methods; it needs all methods of one set.
        known_names: Names of our controllers, which the key may have instead.

    Raises:
        DesignError: Nothing has that name, it cannot be imported, or it is not a controller.
    """
    entry_point_list = [point for point in entry_points(group=ENTRY_POINT_GROUP) if point.name == name]
    location = entry_point_list[0].value if entry_point_list else name
    module, colon, attribute = location.partition(":")
    if not colon:
        names = (*known_names, *list_installed(known_names))
        choices = f"one of {', '.join(names)}, or module:Class" if names else "module:Class, or install its package"
        raise DesignError(key, f'there is no controller "{name}"{find_nearest(name, names)}', f"give {choices}")
    working_folder = str(Path.cwd())
    if working_folder not in sys.path:  # as for scripts; workers of a campaign get the same list
        sys.path.append(working_folder)
    try:
        controller_class = getattr(import_module(module), attribute)
    except RAISED as error:
        raise DesignError(
            key,
            f'controller "{name}" cannot be imported ({in_words(error)})',
            "install its package, or start uavctl in the folder of its module",
        ) from error
    missing = min(
        ([method for method in kind if not callable(getattr(controller_class, method, None))] for kind in kinds),
        key=len,
    )
    if not callable(controller_class) or missing:
        raise DesignError(
            key,
            f'"{location}" is no controller: it has no {" and no ".join(missing) or "way to be made"}',
            f"give a class with {' or with '.join(' and '.join(kind) for kind in kinds)}, as docs/extending.md shows",
        )
    return cast(Callable[[ControlProblem], object], controller_class)


def create_controller(
    controller_class: Callable[[ControlProblem], object], name: str, key: str, problem: ControlProblem
) -> object:
    """Create a controller for a problem.

    Raises:
        DesignError: Its class does not take the problem.
    """
    try:
        return controller_class(problem)
    except DesignError:
        raise
    except RAISED as error:
        raise DesignError(
            key,
            f'controller "{name}" cannot be made for this problem ({in_words(error)})',
            "correct its __init__, or raise uavctl.errors.DesignError where it is not for such a plant",
        ) from error


def build_outside_solver(config: Config, problem: ControlProblem) -> OutsideSolver:
    """Return the solver of the controller that `smpc.controller` names.

    Raises:
        DesignError: It cannot fly this problem.
    """
    name = config.smpc.controller
    controller_class = load_controller_class(name, CONTROLLER_KEY, (PLAN_METHODS, BATCH_METHODS))
    if callable(getattr(controller_class, "plan", None)):
        return OutsideSolver(
            name, problem, cast(FlightPlanner, create_controller(controller_class, name, CONTROLLER_KEY, problem))
        )
    if config.mission.trajectory.times_s:
        raise DesignError(
            CONTROLLER_KEY,
            f'controller "{name}" cannot follow a trajectory',
            "give it plan(request), or fly waypoints instead",
        )
    create_controller(controller_class, name, CONTROLLER_KEY, problem)  # a failure is raised here, not in flight

    def make_target_controller(target: Array) -> tuple[ControlProblem, BatchController]:
        target_problem = retarget(problem, target)
        return target_problem, cast(BatchController, controller_class(target_problem))

    return OutsideSolver(name, problem, SilencePlanner(make_target_controller))


def compute_controller_id(name: str) -> str:
    """Return the name of a controller with a hash of the sources of its package, or of its module.

    Raises:
        DesignError: See `load_controller_class`.
    """
    controller_class = load_controller_class(name, CONTROLLER_KEY, (PLAN_METHODS, BATCH_METHODS))
    package = controller_class.__module__.partition(".")[0]
    if hasattr(sys.modules[package], "__path__"):
        sources: object = read_sources(package)
    else:
        path = inspect.getsourcefile(sys.modules[package])
        sources = Path(path).read_bytes() if path is not None and Path(path).is_file() else b""
    return f"{name} {digest((sources,))[:_ID_LENGTH]}"
