"""What decides a flight's last bits beside its configuration: code, libraries, CPU type."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path

from uavctl import __version__
from uavctl.code_id import decider_id

_LIBRARIES = ("numpy", "scipy", "clarabel", "daqp", "pymavlink", "msgspec", "mcap")


def versions() -> dict[str, str]:
    """What decides alike must be of the same versions."""
    found = {name: metadata.version(name) for name in _LIBRARIES}
    return {"uavctl": __version__, "code": decider_id(), "python": platform.python_version(), **found}


def cpu() -> str:
    """The CPU type: linear algebra kernels, and so the last bits, depend on it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
