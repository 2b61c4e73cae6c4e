"""Controllers by name: our own, and those of other packages by entry point or as `module:Class`.

A class is made with the `ControlProblem` that it is to solve (plant, limits, weights, target, horizon) and then is a
`uavctl.smpc.batch.BatchController`: `begin(runs)`, and `act(news)` once a step for all runs together. docs/extending.md
has one in full.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from uavctl.config.load import find_nearest
from uavctl.errors import DesignError
from uavctl.smpc.batch import BatchController
from uavctl.smpc.nominal import ControlProblem

KINDS = ("smpc", "lqg", "packetised", "mean-qp", "governor", "worst-case-delay", "hold-last", "zero-on-loss", "pid")
GROUP = "uavctl.controllers"

ControllerClass = Callable[[ControlProblem], BatchController]


def installed() -> tuple[str, ...]:
    """Return the names of the controllers that installed packages offer."""
    return tuple(sorted({point.name for point in entry_points(group=GROUP)} - set(KINDS)))


def controller_class(kind: str) -> ControllerClass:
    """Return the class of a controller that is none of `KINDS`; modules of the working directory count.

    Raises:
        DesignError: nothing has that name, it cannot be imported, or it is no controller.
    """
    points = [point for point in entry_points(group=GROUP) if point.name == kind]
    where = points[0].value if points else kind
    module, colon, name = where.partition(":")
    if not colon:
        names = (*KINDS, *installed())
        raise DesignError(
            "kind",
            f'there is no controller "{kind}"{find_nearest(kind, names)}',
            f"give one of {', '.join(names)}, or module:Class",
        )
    here = str(Path.cwd())
    if here not in sys.path:  # as the interpreter does for scripts; workers of a campaign get the same list
        sys.path.append(here)
    try:
        made = getattr(import_module(module), name)
    except Exception as error:
        raise DesignError(
            "kind",
            f'controller "{kind}" cannot be imported ({type(error).__name__}: {error})',
            "install its package, or start uavctl in the folder of its module",
        ) from error
    missing = [method for method in ("begin", "act") if not callable(getattr(made, method, None))]
    if not callable(made) or missing:
        raise DesignError(
            "kind",
            f'"{where}" is no controller: it has no {" and no ".join(missing) or "way to be made"}',
            "give a class with begin(runs) and act(news), as docs/extending.md shows",
        )
    controller: ControllerClass = made
    return controller


def make_controller(kind: str, problem: ControlProblem) -> BatchController:
    """Make a controller of another package for a problem.

    Raises:
        DesignError: there is none, or its class does not take the problem.
    """
    made = controller_class(kind)
    try:
        return made(problem)
    except DesignError:
        raise
    except Exception as error:
        raise DesignError(
            "kind",
            f'controller "{kind}" cannot be made for this problem ({type(error).__name__}: {error})',
            "mend its __init__, or raise uavctl.errors.DesignError where it is not for such a plant",
        ) from error
