"""Fit of the matrix from the vehicle's axes to the cameras': identity, or one of the usual mistakes.

Every pair (v, e) is one vector in the vehicle's axes and in the cameras' axes after `[frame]`. A set-up is a matrix M
with e = M v; the right one is I. Pairs that do not fit a mistake *exclude* it. A mistake that no pair excludes stays
undetermined.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uavctl.arrays import Array

_MIN_EXTENT_RATIO = 0.05  # a movement whose third extent is below this part of its largest shows no handedness


@dataclass(frozen=True)
class Mistake:
    """A common mistake of a camera set-up: its name, and its matrix."""

    name: str
    matrix: Array
    is_yaw_only: bool = False  # about the vertical: a compared heading shows it too


def _make_matrix(*rows: tuple[int, int, int]) -> Array:
    return np.array(rows, dtype=np.float64)


_N, _E, _D = (1, 0, 0), (0, 1, 0), (0, 0, 1)
MISTAKES = (
    Mistake("millimetres are taken for metres", 1000.0 * np.eye(3)),
    Mistake("centimetres are taken for metres", 100.0 * np.eye(3)),
    Mistake("metres are divided by 1000", 0.001 * np.eye(3)),
    Mistake("metres are divided by 100", 0.01 * np.eye(3)),
    Mistake("ENU and NED are swapped (frame.convention)", _make_matrix(_E, _N, (0, 0, -1))),
    Mistake("up is taken for down (mirrored)", _make_matrix(_N, _E, (0, 0, -1))),
    Mistake("north is mirrored", _make_matrix((-1, 0, 0), _E, _D)),
    Mistake("east is mirrored", _make_matrix(_N, (0, -1, 0), _D)),
    Mistake("north and east are swapped (mirrored)", _make_matrix(_E, _N, _D)),
    Mistake("axes forward, left, up are taken for NED", _make_matrix(_N, (0, -1, 0), (0, 0, -1))),
    Mistake("the cameras' second axis points up (y-up)", _make_matrix(_N, (0, 0, -1), _E)),
    Mistake("turned by 180 deg (frame.yaw_deg)", _make_matrix((-1, 0, 0), (0, -1, 0), _D), True),
    Mistake("turned by 90 deg (frame.yaw_deg)", _make_matrix((0, -1, 0), _N, _D), True),
    Mistake("turned by -90 deg (frame.yaw_deg)", _make_matrix(_E, (-1, 0, 0), _D), True),
)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Pairs that belong together."""

    vehicle_m: Array  # v (k, 3), vectors in the vehicle's axes [m]
    cameras_m: Array  # e (k, 3), the same vectors in the cameras' axes [m]
    tolerance_m: float  # root of the mean square of e - v that a right set-up keeps

    def compute_misfit(self, matrix: Array) -> float:
        """Return the error of e = M v, in tolerances; up to 1 the relation may hold."""
        error_m = self.cameras_m - self.vehicle_m @ matrix.T
        # An error of v counts as often as the set-up multiplies it.
        scale = max(1.0, float(np.cbrt(abs(np.linalg.det(matrix)))))
        return math.sqrt(float(np.mean(np.sum(error_m * error_m, axis=1)))) / (self.tolerance_m * scale)


def compute_misfit(evidence: Sequence[Evidence], matrix: Array) -> float:
    """The worst misfit of all evidence; 0 without any."""
    return max((pairs.compute_misfit(matrix) for pairs in evidence), default=0.0)


def find_possible_mistakes(evidence: Sequence[Evidence]) -> list[Mistake]:
    """The mistakes that no evidence excludes."""
    return [mistake for mistake in MISTAKES if compute_misfit(evidence, mistake.matrix) <= 1.0]


def estimate_yaw_deg(evidence: Sequence[Evidence]) -> float:
    """Least-squares turn about the vertical from the vehicle's axes to the cameras', clockwise from above [deg]."""
    # sin = Σ (v_n e_e - v_e e_n), cos = Σ (v_n e_n + v_e e_e)
    sine = cosine = 0.0
    for pairs in evidence:
        vehicle, cameras = pairs.vehicle_m, pairs.cameras_m
        sine += float(np.sum(vehicle[:, 0] * cameras[:, 1] - vehicle[:, 1] * cameras[:, 0]))
        cosine += float(np.sum(vehicle[:, :2] * cameras[:, :2]))
    return math.degrees(math.atan2(sine, cosine))


def make_yaw_matrix(angle_deg: float) -> Array:
    """Matrix of a turn about the vertical."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def explain_misfit(evidence: Sequence[Evidence]) -> str:
    """Return the error that explains evidence which does not fit I: a usual mistake, a turn, or the best similarity."""
    mistakes = find_possible_mistakes(evidence)
    angle_deg = estimate_yaw_deg(evidence)
    if len(mistakes) > 1:
        return "one of: " + "; ".join(mistake.name for mistake in mistakes)
    if mistakes:
        return mistakes[0].name
    if compute_misfit(evidence, make_yaw_matrix(angle_deg)) <= 1.0:
        return f"turned by {angle_deg:.0f} deg about the vertical (frame.yaw_deg is {angle_deg:.0f} deg too large)"
    return _describe_similarity(evidence)


def compute_rms(vectors: Array) -> float:
    """Return the root of the mean square of the lengths of vectors."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def _describe_similarity(evidence: Sequence[Evidence]) -> str:
    """Scale, and handedness where it is determined, of the best similarity of the longest evidence (Umeyama 1991)."""
    longest = max(evidence, key=lambda pairs: len(pairs.vehicle_m))
    vehicle_m, cameras_m = compute_rms(longest.vehicle_m), compute_rms(longest.cameras_m)
    u, extents, vt = np.linalg.svd(longest.cameras_m.T @ longest.vehicle_m)
    texts = [f"{vehicle_m:.2g} m for the vehicle are {cameras_m:.2g} m for the cameras"]
    if extents[2] > _MIN_EXTENT_RATIO**2 * extents[0] and float(np.linalg.det(u @ vt)) < 0.0:
        texts.append("and they are mirrored")
    return " ".join(texts)
