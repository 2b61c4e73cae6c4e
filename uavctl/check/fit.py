"""What turns the vehicle's axes into the cameras': right, or which of the usual mistakes; least squares on pairs.

Every pair (v, e) is a vector as the vehicle knows it and as the cameras see it after `[frame]`. A set-up is a matrix M
with e = M v; the right one is I. A mistake is *excluded* by pairs that it does not fit; what no pair excludes stays
undetermined.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_FLAT = 0.05  # a movement whose third extent is below this part of its largest shows no handedness


@dataclass(frozen=True)
class Mistake:
    """A way in which a camera set-up is commonly wrong: what it is, and its matrix."""

    name: str
    matrix: Array
    turns_only: bool = False  # about the vertical: a compared heading shows it too


def _signed(*rows: tuple[int, int, int]) -> Array:
    return np.array(rows, dtype=np.float64)


_N, _E, _D = (1, 0, 0), (0, 1, 0), (0, 0, 1)
MISTAKES = (
    Mistake("millimetres are taken for metres", 1000.0 * np.eye(3)),
    Mistake("centimetres are taken for metres", 100.0 * np.eye(3)),
    Mistake("metres are divided by 1000", 0.001 * np.eye(3)),
    Mistake("metres are divided by 100", 0.01 * np.eye(3)),
    Mistake("ENU and NED are swapped (frame.convention)", _signed(_E, _N, (0, 0, -1))),
    Mistake("up is taken for down (mirrored)", _signed(_N, _E, (0, 0, -1))),
    Mistake("north is mirrored", _signed((-1, 0, 0), _E, _D)),
    Mistake("east is mirrored", _signed(_N, (0, -1, 0), _D)),
    Mistake("north and east are swapped (mirrored)", _signed(_E, _N, _D)),
    Mistake("axes forward, left, up are taken for NED", _signed(_N, (0, -1, 0), (0, 0, -1))),
    Mistake("the cameras' second axis points up (y-up)", _signed(_N, (0, 0, -1), _E)),
    Mistake("turned by 180 deg (frame.yaw_deg)", _signed((-1, 0, 0), (0, -1, 0), _D), True),
    Mistake("turned by 90 deg (frame.yaw_deg)", _signed((0, -1, 0), _N, _D), True),
    Mistake("turned by -90 deg (frame.yaw_deg)", _signed(_E, (-1, 0, 0), _D), True),
)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Pairs that belong together.

    Attributes:
        own: v (k, 3), vectors as the vehicle knows them [m].
        seen: e (k, 3), the same as the cameras see them [m].
        tolerance_m: root of the mean square of e - v that a right set-up keeps.
    """

    own: Array
    seen: Array
    tolerance_m: float

    def misfit(self, matrix: Array) -> float:
        """How badly e = M v holds, in tolerances; up to 1 it may be so."""
        off = self.seen - self.own @ matrix.T
        # What the vehicle does not know of v counts as often as the set-up multiplies it.
        scale = max(1.0, float(np.cbrt(abs(np.linalg.det(matrix)))))
        return math.sqrt(float(np.mean(np.sum(off * off, axis=1)))) / (self.tolerance_m * scale)


def misfit(evidence: Sequence[Evidence], matrix: Array) -> float:
    """The worst misfit of all evidence; 0 without any."""
    return max((one.misfit(matrix) for one in evidence), default=0.0)


def possible(evidence: Sequence[Evidence]) -> list[Mistake]:
    """The mistakes that no evidence excludes."""
    return [one for one in MISTAKES if misfit(evidence, one.matrix) <= 1.0]


def yaw_deg(evidence: Sequence[Evidence]) -> float:
    """Least-squares turn about the vertical from the vehicle's axes to the cameras', clockwise from above [deg]."""
    sine = sum(float(np.sum(one.own[:, 0] * one.seen[:, 1] - one.own[:, 1] * one.seen[:, 0])) for one in evidence)
    cosine = sum(float(np.sum(one.own[:, :2] * one.seen[:, :2])) for one in evidence)
    return math.degrees(math.atan2(sine, cosine))


def turn(angle_deg: float) -> Array:
    """Matrix of a turn about the vertical."""
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def explain(evidence: Sequence[Evidence]) -> str:
    """What is wrong, for evidence that does not fit I: a usual mistake, a turn, or what the best similarity shows."""
    usual = possible(evidence)
    angle = yaw_deg(evidence)
    if len(usual) > 1:
        return "one of: " + "; ".join(one.name for one in usual)
    if usual:
        return usual[0].name
    if misfit(evidence, turn(angle)) <= 1.0:
        return f"turned by {angle:.0f} deg about the vertical (frame.yaw_deg is {angle:.0f} deg too large)"
    return _similarity(evidence)


def _similarity(evidence: Sequence[Evidence]) -> str:
    """Scale, and handedness where it is determined, of the best similarity of the longest evidence (Umeyama 1991)."""
    longest = max(evidence, key=lambda one: len(one.own))
    own, seen = (float(np.sqrt(np.mean(np.sum(a * a, axis=1)))) for a in (longest.own, longest.seen))
    u, extents, vt = np.linalg.svd(longest.seen.T @ longest.own)
    words = [f"{own:.2g} m for the vehicle are {seen:.2g} m for the cameras"]
    if extents[2] > _FLAT**2 * extents[0] and float(np.linalg.det(u @ vt)) < 0.0:
        words.append("and they are mirrored")
    return " ".join(words)
