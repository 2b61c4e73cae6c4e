"""Plants in their boxes, for made-up flights: a room with 9 states, and the 4 states of Section 5."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from uavctl.arrays import Array


@dataclass(frozen=True)
class Scene:
    """A plant in its box, with a start and a target."""

    a: Array
    b: Array
    e: Array
    noise_std: Array
    q_x: Array
    q_u: Array
    lower: Array
    upper: Array
    input_limit: Array
    start: Array
    target: Array
    dt_s: float
    tick_s: float
    axes: tuple[str, ...]
    name: str
    gain: Array = field(init=False)

    def __post_init__(self) -> None:
        p = solve_discrete_are(self.a, self.b, self.q_x, self.q_u * 20)
        gain = np.linalg.solve(self.q_u * 20 + self.b.T @ p @ self.b, self.b.T @ p @ self.a)
        object.__setattr__(self, "gain", -gain)

    @property
    def per_axis(self) -> int:
        return len(self.start) // len(self.axes)

    def design(self) -> dict[str, object]:
        """As the header carries it."""
        n, m = len(self.start), len(self.input_limit)
        c_x, b_x = box(self.lower, self.upper)
        c_u, b_u = box(-self.input_limit, self.input_limit)
        return {
            "c_x": c_x.tolist(),
            "b_x": b_x.tolist(),
            "c_u": c_u.tolist(),
            "b_u": b_u.tolist(),
            "q_x": self.q_x.tolist(),
            "q_u": self.q_u.tolist(),
            "target": self.target.tolist(),
            "dt_s": self.dt_s,
            "horizon": 12,
            "axes": list(self.axes),
            "position_index": list(range(0, n, self.per_axis)),
            "velocity_index": list(range(1, n, self.per_axis)),
            "input_unit": "m/s²" if m == 3 else "input units",
            "gamma_x": [1.0] * 13,
        }


def _kron(left: Array, right: Array) -> Array:
    return np.asarray(np.kron(left, right), dtype=np.float64)


def box(lower: Array, upper: Array) -> tuple[Array, Array]:
    eye = np.eye(len(lower))
    rows = [(s * eye[i], s * v) for i in range(len(lower)) for s, v in ((1.0, upper[i]), (-1.0, lower[i]))]
    rows = [(c, b) for c, b in rows if np.isfinite(b)]
    return np.array([c for c, _ in rows]), np.array([b for _, b in rows])


def room() -> Scene:
    """Three axes with drag and acceleration lag, 9 states."""
    ac = np.array([[0.0, 1.0, 0.0], [0.0, -0.3, 1.0], [0.0, 0.0, -4.0]])
    m = expm(np.block([[ac, np.array([[0.0, 0.0], [0.0, 1.0], [4.0, 0.0]])], [np.zeros((2, 5))]]) * 0.2)
    eye, inf = np.eye(3), np.inf
    return Scene(
        a=_kron(eye, m[:3, :3]),
        b=_kron(eye, m[:3, 3:4]),
        e=_kron(eye, m[:3, 4:5]),
        noise_std=np.array([0.15, 0.15, 0.10]),
        q_x=_kron(eye, np.diag([10.0, 1.0, 0.1])),
        q_u=eye,
        lower=np.array([-3.0, -1.5, -inf, -2.5, -1.5, -inf, -2.5, -1.0, -inf]),
        upper=np.array([3.0, 1.5, inf, 2.5, 1.5, inf, 0.0, 1.0, inf]),
        input_limit=np.array([2.0, 2.0, 1.5]),
        start=np.array([-2.4, 0.0, 0.0, -1.9, 0.0, 0.0, -0.7, 0.0, 0.0]),
        target=np.array([1.5, 0.0, 0.0, 1.0, 0.0, 0.0, -1.2, 0.0, 0.0]),
        dt_s=0.2,
        tick_s=0.05,
        axes=("north", "east", "down"),
        name="room",
    )


def paper() -> Scene:
    """Section 5: two axes, 4 states."""
    eye = np.eye(2)
    return Scene(
        a=_kron(eye, np.array([[1.0, 0.79], [0.0, 0.61]])),
        b=_kron(eye, np.array([[0.21], [0.39]])),
        e=_kron(eye, np.array([[0.5], [1.0]])),
        noise_std=np.sqrt([0.6, 0.6]),
        q_x=_kron(eye, np.diag([10.0, 0.1])),
        q_u=0.1 * eye,
        lower=np.array([-30.0, -8.0, -25.0, -8.0]),
        upper=np.array([50.0, 7.0, 20.0, 8.0]),
        input_limit=np.array([7.5, 7.5]),
        start=np.array([35.0, -2.0, -20.0, -4.0]),
        target=np.zeros(4),
        dt_s=1.0,
        tick_s=0.1,
        axes=("north", "east"),
        name="paper",
    )
