"""Which code this is: hashes of the sources and of the versions of what they compute with."""

from __future__ import annotations

from functools import cache
from importlib import metadata, resources

from uavctl.smpc.digest import digest

COMPUTES_WITH = ("numpy", "scipy", "clarabel", "daqp")


@cache
def maker_id() -> str:
    """Hash of the code that makes libraries, and of the versions of what it computes with."""
    versions = tuple((name, metadata.version(name)) for name in COMPUTES_WITH)
    return digest((_sources("uavctl.smpc"), versions))


@cache
def decider_id() -> str:
    """Hash of the code that a flight's records come from: from bytes to estimate, plan, decision and bytes again."""
    return digest(tuple(_sources(f"uavctl{name}") for name in ("", ".config", ".flight", ".mavlink", ".smpc")))


def _sources(package: str) -> tuple[tuple[str, bytes], ...]:
    """Names and contents of a package's own modules, without those of packages in it."""
    files = (file for file in resources.files(package).iterdir() if file.name.endswith(".py"))
    return tuple(sorted((file.name, file.read_bytes()) for file in files))
