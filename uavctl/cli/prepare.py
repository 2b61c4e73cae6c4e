"""Preparation of a controller ready to decide, and its provenance: versions and processor."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.progress import TimeElapsedColumn

from uavctl import __version__
from uavctl.build.code_id import decider_id
from uavctl.build.controller import build_controller
from uavctl.build.outside import controller_id
from uavctl.cli.common import bars, messages
from uavctl.config import Config
from uavctl.flight.controller import Controller
from uavctl.smpc.conditioned.planner import AnyDesign, ConditionedDesign

if TYPE_CHECKING:
    from uavctl.build.library import StoredLibrary


# From a configuration to a controller that is ready to decide, with a progress bar where that takes seconds.


@dataclass(frozen=True, eq=False)
class Prepared:
    """Controller that is ready to fly, and what it is made from."""

    config: Config  # the configuration
    design: AnyDesign  # its design
    library: StoredLibrary | None  # the design's policy library; None where scheme or `solver.method` ask for none
    controller: Controller  # the controller


def prepare(config: Config, design: AnyDesign) -> Prepared:
    """Make policy library and controller of a design.

    Raises:
        DesignError: The configuration asks for what the design cannot do.
    """
    library = ready_library(config, design)
    controller = build_controller(config, design, None if library is None else library.library)
    return Prepared(config, design, library, controller)


def ready_library(config: Config, design: AnyDesign) -> StoredLibrary | None:
    """Return the policy library of a design that asks for one: from the cache, or made under a progress bar."""
    if isinstance(design, ConditionedDesign) or not config.uses_library:
        return None
    from uavctl.build.library import library_for

    with ExitStack() as stack:
        bar: list[Callable[[str], None]] = []  # from the first round on: there is none for what the cache holds

        def advance(name: str, count: int, worst_gap: float) -> None:
            if not bar:
                bar.append(stack.enter_context(_bar("policy library, made once for a design")))
            bar[0](f"policy library: {name}, {count} policies, worst gap {worst_gap:.0e}")

        return library_for(design, advance, lambda text: messages().print(escape(text), style="yellow", soft_wrap=True))


@contextmanager
def _bar(title: str) -> Iterator[Callable[[str], None]]:
    """Show a progress bar of unknown length; where standard error is no terminal, its title alone."""
    console = messages()
    if not console.is_terminal:
        console.print(escape(title), soft_wrap=True)
        yield lambda _: None
        return
    with bars(TimeElapsedColumn()) as progress:
        task = progress.add_task(escape(title), total=None)
        yield lambda text: progress.update(task, description=escape(text))


# What decides a flight's last bits beside its configuration: code, libraries, CPU type.


CONTROLLER = "controller"  # under which the one of another package stands among the versions
_LIBRARIES = ("numpy", "scipy", "clarabel", "daqp", "pymavlink", "msgspec", "mcap")


def versions(controller: str) -> dict[str, str]:
    """Return the versions of code and libraries that decisions depend on; `controller`: one of another package."""
    found = {name: metadata.version(name) for name in _LIBRARIES}
    if controller:
        found[CONTROLLER] = controller_id(controller)
    return {"uavctl": __version__, "code": decider_id(), "python": platform.python_version(), **found}


def cpu() -> str:
    """Return the CPU type: linear algebra kernels, and so the last bits of decisions, depend on it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
