"""Paths of the checkout."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

TESTS = Path(__file__).resolve().parent.parent
ROOT = TESTS.parent
DATA = TESTS / "data"
UNDRAWN = TESTS / "support" / "undrawn"


def without_pages(environ: Mapping[str, str] = os.environ) -> dict[str, str]:
    """The environment of a process that flies and whose page nobody reads: drawing one takes longer than to fly."""
    return {**environ, "PYTHONPATH": os.pathsep.join(filter(None, (environ.get("PYTHONPATH", ""), str(UNDRAWN))))}
