"""What all sections of the configuration are made of."""

from __future__ import annotations

import msgspec

Rows = tuple[tuple[float, ...], ...]
Floats = tuple[float, ...]
Position = tuple[float, float, float]
Spans = tuple[tuple[float, float], ...]


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all sections."""
