"""Identity of the code: hashes of the sources, and of the versions of what they compute with."""

from __future__ import annotations

from functools import cache
from importlib import metadata, resources

from uavctl.smpc.plant import digest

COMPUTES_WITH = ("numpy", "scipy", "clarabel", "daqp")


@cache
def maker_id() -> str:
    """Hash of the code that makes libraries, and of the versions of what it computes with."""
    versions = tuple((name, metadata.version(name)) for name in COMPUTES_WITH)
    return digest((sources_of("uavctl.smpc"), versions))


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
