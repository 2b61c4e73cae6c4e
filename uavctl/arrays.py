"""Array type and time unit that the whole tree shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SECOND_NS = 1_000_000_000
