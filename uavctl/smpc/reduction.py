"""The terminal condition Σ_ξ - Ξ_H ⪰ 0 of (19c) without its empty interior.

The last τ disturbances reach both sides alike, so (19c) is Cov(z) ⪯ Σ_z for z = (x_N, u_N … u_{H-1}) and the N older
disturbances. Columns of z that no gain acts on are constant and move to the right side, R = Σ_z - Z_c Z_cᵀ. On the
range of R, whitened, what is left is ‖Y(θ)‖₂ <= 1; off that range z must not move: linear equalities.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from uavctl.smpc.horizon import Affine, Horizon
from uavctl.smpc.scaling import RANK_TOLERANCE

Array = NDArray[np.float64]

# A deviation whose variance RANK_TOLERANCE calls empty.
_EMPTY = float(np.sqrt(RANK_TOLERANCE))


@dataclass(frozen=True, eq=False)
class TerminalBound:
    """I - Y Yᵀ ⪰ 0 with Y (rows, columns), row by row affine in θ, and `fixed` = 0, linearly independent.

    `least` is the least eigenvalue of R, scaled to unit variances; below zero, no θ meets (19c).
    """

    y: Affine
    rows: int
    columns: int
    fixed: Affine
    least: float

    def triangle(self) -> Affine:
        """Upper triangle of [[I, Y], [Yᵀ, I]], column by column."""
        size = self.rows + self.columns
        place = np.full((size, size), -1)
        place[: self.rows, self.rows :] = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        index = np.concatenate([place[: j + 1, j] for j in range(size)])
        diagonal = np.concatenate([np.arange(j + 1) == j for j in range(size)])
        picked = np.flatnonzero(index >= 0)
        select = sparse.csr_array(
            (np.ones(picked.size), (picked, index[picked])), shape=(index.size, self.y.offset.size)
        )
        return Affine(diagonal + select @ self.y.offset, sparse.csr_array(select @ self.y.matrix))


def terminal_bound(horizon: Horizon, *, move_constants: bool = True) -> TerminalBound:
    """Reduce (19c) of one component.

    Args:
        horizon: The component's prediction.
        move_constants: Move constant columns to the right side; without, R = Σ_z as it stands.
    """
    sigma = horizon.sigma_z
    z = horizon.terminal_noise()
    n_z = sigma.shape[0]
    n_columns = z.offset.size // n_z
    column = np.tile(np.arange(n_columns), n_z)
    acted = np.zeros(n_columns, dtype=bool)
    acted[column[np.diff(z.matrix.indptr) > 0]] = True
    kept = acted if move_constants else np.ones(n_columns, dtype=bool)
    constant = z.offset.reshape(n_z, n_columns)[:, ~kept]
    scale = np.sqrt(np.diagonal(sigma))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh((sigma - constant @ constant.T) / np.outer(scale, scale))
    inside = values > RANK_TOLERANCE
    whiten = (vectors[:, inside] / np.sqrt(values[inside])).T / scale
    outside = vectors[:, ~inside].T / scale
    select = np.flatnonzero(kept[column])
    rest = Affine(z.offset[select], z.matrix[select])
    return TerminalBound(
        y=_times(whiten, rest, int(kept.sum())),
        rows=whiten.shape[0],
        columns=int(kept.sum()),
        fixed=_independent(_times(outside, rest, int(kept.sum())), _effect(rest, np.repeat(scale, kept.sum()))),
        least=float(values[0]),
    )


def _times(matrix: Array, z: Affine, columns: int) -> Affine:
    """matrix · Z for Z stored row by row."""
    wide = sparse.kron(sparse.csr_array(matrix), sparse.eye_array(columns), format="csr")
    return Affine(np.asarray(wide @ z.offset), sparse.csr_array(wide @ z.matrix))


def _effect(z: Affine, std: Array) -> Array:
    """Largest effect of each gain on an entry of z, in standard deviations; 1 for gains without any."""
    largest = np.abs(z.matrix.toarray() / std[:, None]).max(axis=0, initial=0.0)
    return np.where(largest > 0.0, largest, 1.0)


def _independent(rows: Affine, effect: Array) -> Affine:
    """Linearly independent equations with the same solutions; what no gain moves is left out unless it is not 0."""
    left, singular, right = np.linalg.svd(rows.matrix.toarray() / effect)
    rank = int(np.sum(singular > _EMPTY))
    along, beside = left[:, :rank].T @ rows.offset, left[:, rank:].T @ rows.offset
    contradiction = beside[np.abs(beside) > _EMPTY]
    return Affine(
        np.concatenate([along / singular[:rank], contradiction]),
        sparse.csr_array(np.vstack([right[:rank] * effect, np.zeros((contradiction.size, effect.size))])),
    )
