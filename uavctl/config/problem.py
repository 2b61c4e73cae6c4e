"""One thing that is wrong with a configuration."""

from __future__ import annotations

from typing import NamedTuple


class Problem(NamedTuple):
    """Key path, what is wrong with it, and what to do."""

    key: str
    reason: str
    todo: str
