"""One cache of policy libraries for a whole test run: for all its processes and the commands that they start."""

from __future__ import annotations

import os
import shutil
import tempfile

import pytest

CACHE = "UAVCTL_CACHE"
OWN = pytest.StashKey[str]()


def pytest_configure(config: pytest.Config) -> None:
    # Workers inherit the variable from the process that starts them; a cache that somebody chose is kept.
    if CACHE not in os.environ:
        config.stash[OWN] = os.environ[CACHE] = tempfile.mkdtemp(prefix="uavctl-test-cache-")


def pytest_unconfigure(config: pytest.Config) -> None:
    own = config.stash.get(OWN, None)
    if own is not None:
        shutil.rmtree(own, ignore_errors=True)
        del os.environ[CACHE]
