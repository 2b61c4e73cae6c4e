"""A controller that is ready to decide, and its provenance: versions and processor."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from uavctl import __version__
from uavctl.build.code_id import decider_id
from uavctl.config.types import Config
from uavctl.flight.controller import Controller
from uavctl.smpc.conditioned.planner import AnyDesign

if TYPE_CHECKING:
    from uavctl.build.library import StoredLibrary


@dataclass(frozen=True, eq=False)
class Prepared:
    """Controller that is ready to fly, and what it is made from."""

    config: Config  # the configuration
    design: AnyDesign  # its design
    library: StoredLibrary | None  # the design's policy library; None where scheme or `solver.method` ask for none
    controller: Controller  # the controller


# What decides a flight's last bits beside its configuration: code, libraries, CPU type.


_LIBRARIES = ("numpy", "scipy", "clarabel", "daqp", "pymavlink", "msgspec", "mcap")


def versions() -> dict[str, str]:
    """Return the versions of code and libraries that decisions depend on."""
    found = {name: metadata.version(name) for name in _LIBRARIES}
    return {"uavctl": __version__, "code": decider_id(), "python": platform.python_version(), **found}


def cpu() -> str:
    """Return the CPU type: linear algebra kernels, and so the last bits of decisions, depend on it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
