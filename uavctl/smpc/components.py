"""Decomposition of the decision problem into independent parts.

Nodes are states, inputs and disturbances; an edge is a non-zero entry by which A, B, E, W, Q_x, Q_u, K or one row
of a constraint couples two of them. The connected components are problems of their own with the same optimum:
gains across components only add cost and covariance. The χ² quantiles stay those of the whole plant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from uavctl.errors import DesignError
from uavctl.smpc.design import Design
from uavctl.smpc.equilibria import equilibria

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Component:
    """One independent part of a design: where it sits in the whole, and its own matrices.

    Attributes:
        states: Indices of its states in the plant's.
        inputs: Indices of its inputs.
        disturbances: Indices of its disturbances.
        coordinates: (n_y, n_x): y of the equilibrium that a state belongs to, its positions where they can be held.
        rows_x: Indices of its rows in the state set.
        rows_u: Indices of its rows in the input set.
        a: A (n_x, n_x); b: B (n_x, n_u); e: E (n_x, n_w); w: W (n_w, n_w).
        q_x: State weight (n_x, n_x).
        q_u: Input weight (n_u, n_u).
        c_x: Rows of the state set (m_x, n_x).
        b_x: Right sides (m_x,).
        c_u: Rows of the input set (m_u, n_u).
        b_u: Right sides (m_u,).
        k: Terminal gain K_τ (n_u, n_x).
        sigma_x: Stationary covariance of a state under the terminal law (n_x, n_x).
        estimate_cov: Covariance of the estimate's error in every stage (n_x, n_x).
        sigma_xi: The same of ξ = (x_{H-τ} … x_H).
        sigma_z: The same of z = (x_{H-τ}, u_{H-τ} … u_{H-1}).
        p_xi: Terminal weight of ξ.
        held: Indices of the states whose values y is (n_y,).
        x_eq: Equilibrium states (n_x, n_y): x_s = x_eq y.
        u_eq: Equilibrium inputs (n_u, n_y).
    """

    states: Index
    inputs: Index
    disturbances: Index
    coordinates: Array
    rows_x: Index
    rows_u: Index
    a: Array
    b: Array
    e: Array
    w: Array
    q_x: Array
    q_u: Array
    c_x: Array
    b_x: Array
    c_u: Array
    b_u: Array
    k: Array
    sigma_x: Array
    estimate_cov: Array
    sigma_xi: Array
    sigma_z: Array
    p_xi: Array
    held: Index
    x_eq: Array
    u_eq: Array


def decompose(design: Design) -> tuple[Component, ...]:
    """Connected components of a design, in the order of their first state.

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


def whole(design: Design) -> Component:
    """The design as one component, whatever it decomposes into."""
    plant = design.plant
    return _component(design, np.arange(plant.n_x), np.arange(plant.n_u), np.arange(plant.n_w))


def _shared_row(c: Array) -> Array:
    """Non-zero where two variables appear in one row of a constraint."""
    used = (c != 0).astype(np.float64)
    shared: Array = used.T @ used
    return shared


def _component(design: Design, states: Index, inputs: Index, disturbances: Index) -> Component:
    plant, terminal = design.plant, design.terminal
    if not len(inputs):
        raise DesignError("plant.b", f"states {states.tolist()} are reached by no input", "give each state an input")
    rows_x = _finite_rows(design.state_set.c[:, states], design.state_set.b)
    rows_u = _finite_rows(design.input_set.c[:, inputs], design.input_set.b)
    stack = np.concatenate([i * plant.n_x + states for i in range(terminal.tau + 1)])
    z = np.concatenate([states, *(plant.n_x + i * plant.n_u + inputs for i in range(terminal.tau))])
    a, b = plant.a[np.ix_(states, states)], plant.b[np.ix_(states, inputs)]
    q_x, q_u = design.q_x[np.ix_(states, states)], design.q_u[np.ix_(inputs, inputs)]
    rest = equilibria(a, b, q_x, q_u, np.flatnonzero(np.isin(states, plant.position_index)))
    return Component(
        states=states,
        inputs=inputs,
        disturbances=disturbances,
        coordinates=rest.coordinates,
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
        sigma_xi=terminal.sigma_xi[np.ix_(stack, stack)],
        sigma_z=terminal.sigma_z[np.ix_(z, z)],
        p_xi=terminal.p_xi[np.ix_(stack, stack)],
        held=rest.held,
        x_eq=rest.x_eq,
        u_eq=rest.u_eq,
    )


def _finite_rows(c: Array, b: Array) -> Index:
    return np.flatnonzero(np.any(c != 0, axis=1) & np.isfinite(b))
