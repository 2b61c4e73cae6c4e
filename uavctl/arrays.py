"""The array type of all numerical code: 64-bit floating point numbers of any shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
