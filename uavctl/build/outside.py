"""Identity of our code by hashes, and classes of other packages: how they are found, made, and told apart.

A controller is made with the `ControlProblem` that it is to solve (plant, limits, weights, target, horizon). What flies
has `plan(request)` (`uavctl.smpc.outside.FlightPlanner`); what campaigns ask has `begin(runs)` and `act(news)`, once a
step for all runs together (`uavctl.smpc.batch.BatchController`), and can fly too. docs/extending.md has both in full.
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

import numpy as np
from numpy.typing import NDArray

from uavctl.config import Config
from uavctl.config.load import find_nearest
from uavctl.errors import RAISED, DesignError, in_words
from uavctl.smpc.batch import BatchController
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.outside import FlightPlanner, OutsideSolver, SilencePlanner, retarget
from uavctl.smpc.plant import digest


@cache
def decider_id() -> str:
    """Hash of the code that a flight's records come from: from bytes to estimate, plan, decision and bytes again."""
    return digest(
        tuple(sources_of(f"uavctl{name}") for name in ("", ".build", ".config", ".flight", ".mavlink", ".smpc"))
    )


def sources_of(package: str) -> tuple[tuple[str, bytes], ...]:
    """Names and contents of a package's modules, and of those of the packages in it; of `uavctl` only its own."""
    found = []
    for entry in resources.files(package).iterdir():
        if entry.name.endswith(".py"):
            found.append((f"{package}.{entry.name}", entry.read_bytes()))
        elif package != "uavctl" and (entry / "__init__.py").is_file():
            found.extend(sources_of(f"{package}.{entry.name}"))
    return tuple(sorted(found))


GROUP = "uavctl.controllers"
KEY = "smpc.controller"
PLANS, ACTS = ("plan",), ("begin", "act")
_ID_LENGTH = 12

Made = TypeVar("Made")


def installed(but: Collection[str] = ()) -> tuple[str, ...]:
    """Return the names of the controllers that installed packages offer."""
    return tuple(sorted({point.name for point in entry_points(group=GROUP)} - set(but)))


def controller_class(
    name: str, key: str, kinds: tuple[tuple[str, ...], ...], others: Collection[str] = ()
) -> Callable[[ControlProblem], object]:
    """Return the class of a controller of another package; modules of the working directory count.

    Args:
        name: Its entry point, or `module:Class`.
        key: The key that names it.
        kinds: The methods that it has to have: all of one of these.
        others: Names of ours that the key may have instead.

    Raises:
        DesignError: Nothing has that name, it cannot be imported, or it is no controller.
    """
    points = [point for point in entry_points(group=GROUP) if point.name == name]
    where = points[0].value if points else name
    module, colon, attribute = where.partition(":")
    if not colon:
        names = (*others, *installed(others))
        known = f"one of {', '.join(names)}, or module:Class" if names else "module:Class, or install its package"
        raise DesignError(key, f'there is no controller "{name}"{find_nearest(name, names)}', f"give {known}")
    here = str(Path.cwd())
    if here not in sys.path:  # as the interpreter does for scripts; workers of a campaign get the same list
        sys.path.append(here)
    try:
        made = getattr(import_module(module), attribute)
    except RAISED as error:
        raise DesignError(
            key,
            f'controller "{name}" cannot be imported ({in_words(error)})',
            "install its package, or start uavctl in the folder of its module",
        ) from error
    lacking = min(([one for one in kind if not callable(getattr(made, one, None))] for kind in kinds), key=len)
    if not callable(made) or lacking:
        raise DesignError(
            key,
            f'"{where}" is no controller: it has no {" and no ".join(lacking) or "way to be made"}',
            f"give a class with {' or with '.join(' and '.join(kind) for kind in kinds)}, as docs/extending.md shows",
        )
    return cast(Callable[[ControlProblem], object], made)


def make(made: Callable[[ControlProblem], object], name: str, key: str, problem: ControlProblem) -> object:
    """Make a controller for a problem.

    Raises:
        DesignError: Its class does not take the problem.
    """
    try:
        return made(problem)
    except DesignError:
        raise
    except RAISED as error:
        raise DesignError(
            key,
            f'controller "{name}" cannot be made for this problem ({in_words(error)})',
            "mend its __init__, or raise uavctl.errors.DesignError where it is not for such a plant",
        ) from error


def flown_outside(config: Config, problem: ControlProblem) -> OutsideSolver:
    """Return the solver of the controller that `smpc.controller` names.

    Raises:
        DesignError: There is none that can fly this problem.
    """
    name = config.smpc.controller
    made = controller_class(name, KEY, (PLANS, ACTS))
    if callable(getattr(made, "plan", None)):
        return OutsideSolver(name, problem, cast(FlightPlanner, make(made, name, KEY, problem)))
    if config.mission.trajectory.times_s:
        raise DesignError(
            KEY, f'controller "{name}" is told no trajectory', "give it plan(request), or fly waypoints instead"
        )
    make(made, name, KEY, problem)  # what cannot be made is refused here, not in flight

    def to(target: NDArray[np.float64]) -> tuple[ControlProblem, BatchController]:
        there = retarget(problem, target)
        return there, cast(BatchController, made(there))

    return OutsideSolver(name, problem, SilencePlanner(to))


def controller_id(name: str) -> str:
    """Return the name of a controller with a hash of the sources of its package, or of its module.

    Raises:
        DesignError: See `controller_class`.
    """
    made = controller_class(name, KEY, (PLANS, ACTS))
    top = made.__module__.partition(".")[0]
    if hasattr(sys.modules[top], "__path__"):
        code: object = sources_of(top)
    else:
        path = inspect.getsourcefile(sys.modules[top])
        code = Path(path).read_bytes() if path is not None and Path(path).is_file() else b""
    return f"{name} {digest((code,))[:_ID_LENGTH]}"
