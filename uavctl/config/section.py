"""What all sections of the configuration are made of, and how large anything in them may be.

Every number has a range and every list and text a longest length: what is beyond is a slip, and would only come out as
an overflow, or as work without end.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

LARGEST = 1e7  # of numbers that have no range of their own
LONGEST_S = 1e6
LONGEST_PATH, LONGEST_URL = 1000, 300
LARGEST_PLANT = 24  # states
LARGEST_SEED = 2**53  # what JSON holds exactly
MOST_SPANS = 1000
LONGEST_MOTION = 10_000  # samples of a trajectory; a recording holds them

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Rows = tuple[tuple[Number, ...], ...]
Floats = tuple[Number, ...]
Open = tuple[float, ...]  # may be infinite: each use has its own check
Weights = tuple[Annotated[float, Meta(ge=0, le=1e12)], ...]
Position = tuple[Number, Number, Number]
Speed = Annotated[float, Meta(ge=-100, le=100)]
Wind = tuple[Speed, Speed, Speed]
Spans = tuple[tuple[Number, Number], ...]


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all sections."""
