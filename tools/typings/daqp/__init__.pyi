# DAQP 0.11: the part that is used here.
from typing import Any

import numpy as np
from numpy.typing import NDArray

class Model:
    settings: dict[str, float]
    def setup(
        self,
        H: NDArray[np.float64] | None,
        f: NDArray[np.float64] | None,
        A: NDArray[np.float64],
        bupper: NDArray[np.float64],
        blower: NDArray[np.float64] | None = None,
        sense: NDArray[np.int32] | None = None,
    ) -> tuple[int, float]: ...
    def solve(self) -> tuple[NDArray[np.float64], float, int, dict[str, Any]]: ...
    def update(
        self,
        H: NDArray[np.float64] | None = None,
        f: NDArray[np.float64] | None = None,
        A: NDArray[np.float64] | None = None,
        bupper: NDArray[np.float64] | None = None,
        blower: NDArray[np.float64] | None = None,
        sense: NDArray[np.int32] | None = None,
    ) -> int: ...
    def soft_weights(
        self,
        rho_l: NDArray[np.float64] | None = None,
        rho_u: NDArray[np.float64] | None = None,
        w_l: NDArray[np.float64] | None = None,
        w_u: NDArray[np.float64] | None = None,
    ) -> None: ...
