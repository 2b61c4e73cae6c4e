"""A controller that is ready to decide, and its provenance: versions and processor."""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from uavctl import __version__
from uavctl.build.code_id import decider_id
from uavctl.build.controller import build_controller
from uavctl.build.outside import controller_id
from uavctl.config.types import Config
from uavctl.flight.controller import Controller
from uavctl.smpc.conditioned.planner import AnyDesign, ConditionedDesign

if TYPE_CHECKING:
    from uavctl.build.library import Advance, StoredLibrary


@dataclass(frozen=True, eq=False)
class Prepared:
    """Controller that is ready to fly, and what it is made from."""

    config: Config  # the configuration
    design: AnyDesign  # its design
    library: StoredLibrary | None  # the design's policy library; None where scheme or `solver.method` ask for none
    controller: Controller  # the controller


def prepare(config: Config, design: AnyDesign, library: StoredLibrary | None) -> Prepared:
    """Make the controller of a design and its policy library.

    Raises:
        DesignError: The configuration asks for what the design cannot do.
    """
    controller = build_controller(config, design, None if library is None else library.library)
    return Prepared(config, design, library, controller)


def ready_library(
    config: Config, design: AnyDesign, advance: Advance | None = None, tell: Callable[[str], None] | None = None
) -> StoredLibrary | None:
    """Return the policy library of a design that asks for one: from the cache, or made, which takes half a minute.

    Args:
        advance: See `uavctl.build.library.library_for`, as `tell`.
    """
    if isinstance(design, ConditionedDesign) or not config.uses_library:
        return None
    from uavctl.build.library import library_for

    return library_for(design, advance, tell)


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
