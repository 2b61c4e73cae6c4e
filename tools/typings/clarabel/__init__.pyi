from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csc_matrix

__version__: str

class ZeroConeT:
    def __init__(self, dim: int) -> None: ...

class NonnegativeConeT:
    def __init__(self, dim: int) -> None: ...

class SecondOrderConeT:
    def __init__(self, dim: int) -> None: ...

class PSDTriangleConeT:
    def __init__(self, dim: int) -> None: ...

Cone = ZeroConeT | NonnegativeConeT | SecondOrderConeT | PSDTriangleConeT

class SolverStatus:
    Unsolved: SolverStatus
    Solved: SolverStatus
    PrimalInfeasible: SolverStatus
    DualInfeasible: SolverStatus
    AlmostSolved: SolverStatus
    AlmostPrimalInfeasible: SolverStatus
    AlmostDualInfeasible: SolverStatus
    MaxIterations: SolverStatus
    MaxTime: SolverStatus
    NumericalError: SolverStatus
    InsufficientProgress: SolverStatus
    CallbackTerminated: SolverStatus

class DefaultSettings:
    verbose: bool
    max_iter: int
    max_threads: int
    direct_solve_method: str
    presolve_enable: bool
    chordal_decomposition_enable: bool
    equilibrate_enable: bool
    tol_gap_abs: float
    tol_gap_rel: float
    tol_feas: float
    static_regularization_constant: float
    max_step_fraction: float
    def __init__(self) -> None: ...

class DefaultSolution:
    x: Sequence[float]
    z: Sequence[float]
    s: Sequence[float]
    status: SolverStatus
    obj_val: float
    obj_val_dual: float
    iterations: int
    solve_time: float

class DefaultSolver:
    def __init__(
        self,
        P: csc_array | csc_matrix,
        q: NDArray[np.float64],
        A: csc_array | csc_matrix,
        b: NDArray[np.float64],
        cones: Sequence[Cone],
        settings: DefaultSettings,
    ) -> None: ...
    def solve(self) -> DefaultSolution: ...
    def update(self, *, q: NDArray[np.float64] = ..., b: NDArray[np.float64] = ...) -> None: ...
    def is_data_update_allowed(self) -> bool: ...
