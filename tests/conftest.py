"""One cache of policy libraries for a whole test run, and what is collected only when it is asked for by its path."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest

CACHE = "UAVCTL_CACHE"
OWN = pytest.StashKey[str]()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    # Real clients need interpreters of their own: `make test-clients`.
    asked = any("clients" in argument for argument in config.args)
    return True if collection_path.name == "clients" and not asked else None


def pytest_configure(config: pytest.Config) -> None:
    # Workers inherit the variable from the process that starts them; a cache that somebody chose is kept.
    if CACHE not in os.environ:
        config.stash[OWN] = os.environ[CACHE] = tempfile.mkdtemp(prefix="uavctl-test-cache-")


def pytest_unconfigure(config: pytest.Config) -> None:
    own = config.stash.get(OWN, None)
    if own is not None:
        shutil.rmtree(own, ignore_errors=True)
        del os.environ[CACHE]
