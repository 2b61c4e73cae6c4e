"""Decomposition of the decision problem into independent components.

1. Nodes are states, inputs and disturbances; an edge is a non-zero entry of A, B, E, W, Q_x, Q_u, K or of one row of a
   constraint that couples two of them.
2. The connected components are independent problems with the same optimum, because gains across components only add
   cost and covariance. The χ² quantiles stay those of the plant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from uavctl.arrays import Array
from uavctl.errors import DesignError
from uavctl.smpc.hahn_stursberg.design import Design
from uavctl.smpc.sets import find_equilibria

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Component:
    """One independent part of a design: its indices in the plant, and its matrices."""

    states: Index  # indices of its states in the plant's
    inputs: Index  # indices of its inputs
    disturbances: Index  # indices of its disturbances
    coordinates: Array  # (n_y, n_x): y of the equilibrium of a state; its positions where they can be held
    rows_x: Index  # indices of its rows in the state set
    rows_u: Index  # indices of its rows in the input set
    a: Array  # A (n_x, n_x); b: B (n_x, n_u); e: E (n_x, n_w); w: W (n_w, n_w)
    b: Array
    e: Array
    w: Array
    q_x: Array  # state weight (n_x, n_x)
    q_u: Array  # input weight (n_u, n_u)
    c_x: Array  # rows of the state set (m_x, n_x)
    b_x: Array  # right sides (m_x,)
    c_u: Array  # rows of the input set (m_u, n_u)
    b_u: Array  # right sides (m_u,)
    k: Array  # terminal gain K_τ (n_u, n_x)
    sigma_x: Array  # stationary covariance of a state under the terminal law (n_x, n_x)
    estimate_cov: Array  # covariance of the estimate's error in every stage (n_x, n_x)
    sigma_xi: Array  # the same of ξ = (x_{H-τ} … x_H)
    sigma_z: Array  # the same of z = (x_{H-τ}, u_{H-τ} … u_{H-1})
    p_xi: Array  # terminal weight of ξ
    held: Index  # indices of the states whose values y is (n_y,)
    x_eq: Array  # equilibrium states (n_x, n_y): x_s = x_eq y
    u_eq: Array  # equilibrium inputs (n_u, n_y)


def decompose(design: Design) -> tuple[Component, ...]:
    """Return the connected components of a design, in the order of their first state.

    Raises:
        DesignError: A state is connected to no input.
    """
    plant = design.plant
    n_x, n_u, n_w = plant.n_x, plant.n_u, plant.n_w
    size = n_x + n_u + n_w
    x, u, w = np.arange(n_x), n_x + np.arange(n_u), n_x + n_u + np.arange(n_w)
    edges = np.zeros((size, size), dtype=bool)
    for rows, columns, matrix in (
        (x, x, plant.a),
        (x, u, plant.b),
        (x, w, plant.e),
        (w, w, plant.w),
        (x, x, design.q_x),
        (x, x, design.estimate_cov),
        (u, u, design.q_u),
        (u, x, design.terminal.k),
        (x, x, _shared_row(design.state_set.c)),
        (u, u, _shared_row(design.input_set.c)),
    ):
        edges[np.ix_(rows, columns)] |= matrix != 0
    _, label = connected_components(sparse.csr_array(edges), directed=False)
    labels = dict.fromkeys(int(label[i]) for i in x)
    return tuple(
        _component(design, np.flatnonzero(label[x] == i), np.flatnonzero(label[u] == i), np.flatnonzero(label[w] == i))
        for i in labels
    )


def make_whole_component(design: Design) -> Component:
    """Return the design as one component."""
    plant = design.plant
    return _component(design, np.arange(plant.n_x), np.arange(plant.n_u), np.arange(plant.n_w))


def _shared_row(c: Array) -> Array:
    """Return a matrix that is non-zero where two variables share a row of a constraint."""
    used = (c != 0).astype(np.float64)
    shared: Array = used.T @ used
    return shared


def _component(design: Design, states: Index, inputs: Index, disturbances: Index) -> Component:
    plant, terminal = design.plant, design.terminal
    if not len(inputs):
        raise DesignError("plant.b", f"states {states.tolist()} are reached by no input", "give each state an input")
    rows_x = _finite_rows(design.state_set.c[:, states], design.state_set.b)
    rows_u = _finite_rows(design.input_set.c[:, inputs], design.input_set.b)
    xi = np.concatenate([i * plant.n_x + states for i in range(terminal.tau + 1)])
    z = np.concatenate([states, *(plant.n_x + i * plant.n_u + inputs for i in range(terminal.tau))])
    a, b = plant.a[np.ix_(states, states)], plant.b[np.ix_(states, inputs)]
    q_x, q_u = design.q_x[np.ix_(states, states)], design.q_u[np.ix_(inputs, inputs)]
    equilibria = find_equilibria(a, b, q_x, q_u, np.flatnonzero(np.isin(states, plant.position_index)))
    return Component(
        states=states,
        inputs=inputs,
        disturbances=disturbances,
        coordinates=equilibria.coordinates,
        rows_x=rows_x,
        rows_u=rows_u,
        a=a,
        b=b,
        e=plant.e[np.ix_(states, disturbances)],
        w=plant.w[np.ix_(disturbances, disturbances)],
        q_x=q_x,
        q_u=q_u,
        c_x=design.state_set.c[np.ix_(rows_x, states)],
        b_x=design.state_set.b[rows_x],
        c_u=design.input_set.c[np.ix_(rows_u, inputs)],
        b_u=design.input_set.b[rows_u],
        k=terminal.k[np.ix_(inputs, states)],
        sigma_x=terminal.sigma_x[np.ix_(states, states)],
        estimate_cov=design.estimate_cov[np.ix_(states, states)],
        sigma_xi=terminal.sigma_xi[np.ix_(xi, xi)],
        sigma_z=terminal.sigma_z[np.ix_(z, z)],
        p_xi=terminal.p_xi[np.ix_(xi, xi)],
        held=equilibria.held,
        x_eq=equilibria.x_eq,
        u_eq=equilibria.u_eq,
    )


def _finite_rows(c: Array, b: Array) -> Index:
    return np.flatnonzero(np.any(c != 0, axis=1) & np.isfinite(b))
