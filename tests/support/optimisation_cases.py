"""Designs that the tests of the decision problem share: the paper's, a room's, and one with coupled axes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec, make_design
from uavctl.smpc.link import bernoulli
from uavctl.smpc.plant import Plant, drag_lag
from uavctl.smpc.sets import Polytope

START = np.array([35.0, -2.0, -20.0, -4.0])
ORIGIN = np.zeros(4)
PAPER_COST, PAPER_COST_X, PAPER_COST_Y = 61669.93, 42499.44, 19170.49

ROOM_CORNER = np.array([-2.4, 0, 0, -1.9, 0, 0, -0.7, 0, 0])
ROOM_TARGET = np.array([1.5, 0, 0, 1.0, 0, 0, -1.2, 0, 0])

PAPER_LOWER = np.array([-30.0, -8.0, -25.0, -8.0])
PAPER_UPPER = np.array([50.0, 7.0, 20.0, 8.0])

TWO = np.eye(2)


def kron(left: Array, right: list[list[float]]) -> Array:
    return np.asarray(np.kron(left, np.array(right)), dtype=np.float64)


def paper_plant(w: Array | None = None, coupling: float = 0.0) -> Plant:
    a = kron(TWO, [[1.0, 0.79], [0.0, 0.61]])
    a[1, 3] = a[3, 1] = coupling
    return Plant(
        a=a,
        b=kron(TWO, [[0.21], [0.39]]),
        e=kron(TWO, [[0.5], [1.0]]),
        w=0.6 * np.eye(2) if w is None else w,
        dt_s=1.0,
        axes=("north", "east"),
        position_index=(0, 2),
        velocity_index=(1, 3),
        accel_per_input=np.full(2, 0.494),
    )


def paper_spec(**changes: Any) -> DesignSpec:
    spec = DesignSpec(
        plant=paper_plant(),
        state_set=Polytope.from_box(PAPER_LOWER.tolist(), PAPER_UPPER.tolist()),
        input_set=Polytope.from_box([-7.5, -7.5], [7.5, 7.5]),
        q_x=np.diag([10.0, 0.1, 10.0, 0.1]),
        q_u=0.1 * np.eye(2),
        horizon=12,
        tau=4,
        delta_x=0.95,
        delta_u=0.9,
        delta_tau=0.99,
        k_tau=kron(TWO, [[-0.058, -1.172]]),
        link=bernoulli(np.array([0.7])),
        target_m=(0.0, 0.0, 0.0),
        rule="fixed",
        delays=5,
        gamma_max=0.985,
        search_states=np.zeros((0, 4)),
        allocation="ellipsoid",
        slack_linear=1e5,
        slack_quadratic=1e3,
        offset_weight=5000.0,
        terminal_weight=1e5,
        max_iterations=100,
    )
    return replace(spec, **changes)


def paper(**changes: Any) -> Design:
    return make_design(paper_spec(**changes))


def coupled() -> Design:
    """Two axes that drag at one another, with a short horizon and a good link."""
    return paper(plant=paper_plant(coupling=0.1), horizon=5, tau=1, delays=2, link=bernoulli(np.array([0.95])))


# A shorter delay for the room: stages 4 and 5 feed nothing back, so that enough likelihood is left.
TAU_3: dict[str, Any] = {"tau": 3, "k_tau": kron(np.eye(3), [[-1.060, -1.444, -0.696]]), "delays": [6] * 7 + [4] * 5}


def room(**changes: Any) -> Design:
    inf = np.inf
    spec = paper_spec(
        plant=drag_lag([0.3] * 3, [0.25] * 3, [1.0] * 3, [0.15, 0.15, 0.10], 0.2, ("north", "east", "down")),
        state_set=Polytope.from_box(
            [-3.0, -1.5, -inf, -2.5, -1.5, -inf, -2.5, -1.0, -inf], [3.0, 1.5, inf, 2.5, 1.5, inf, 0.0, 1.0, inf]
        ),
        input_set=Polytope.from_box([-2.0, -2.0, -1.5], [2.0, 2.0, 1.5]),
        q_x=np.diag([10.0, 1.0, 0.1] * 3),
        q_u=np.eye(3),
        k_tau=kron(np.eye(3), [[-0.814, -1.209, -0.710]]),
        target_m=(1.5, 1.0, -1.2),
        search_states=np.zeros((0, 9)),
        offset_weight=300.0,  # as in the preset
    )
    return make_design(replace(spec, **changes))
