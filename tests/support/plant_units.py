"""Designs in other units."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uavctl.arrays import Array
from uavctl.smpc.hahn_stursberg.design import Design, DesignSpec
from uavctl.smpc.hahn_stursberg.terminal import Terminal
from uavctl.smpc.link import bernoulli
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope


@dataclass(frozen=True, eq=False)
class Units:
    """x' = state · x, u' = input · u, w' = disturbance · w, cost' = cost · cost; all positions have the same factor."""

    state: Array
    input: Array
    disturbance: Array
    cost: float

    @classmethod
    def drawn(cls, plant: Plant, seed: int) -> Units:
        rng = np.random.default_rng(seed)
        state = 10.0 ** rng.uniform(-3.0, 3.0, plant.n_x)
        state[list(plant.position_index)] = state[0]
        if plant.n_u > len(plant.axes):  # some states beside the positions may be references, with the same price
            state[:] = state[0]
        return cls(
            state,
            10.0 ** rng.uniform(-3.0, 3.0, plant.n_u),
            10.0 ** rng.uniform(-3.0, 3.0, plant.n_w),
            float(10.0 ** rng.uniform(-6.0, 6.0)),
        )

    @classmethod
    def of(cls, plant: Plant, state: float, input: float, cost: float) -> Units:
        return cls(np.full(plant.n_x, state), np.full(plant.n_u, input), np.ones(plant.n_w), cost)


def in_units(spec: DesignSpec, units: Units) -> DesignSpec:
    """The same design in other units.

    Rows of the sets keep their own unit where states have different ones, so that slacks and their prices do too; a
    common factor of all states is also theirs.
    """
    s, u, w, f, plant = units.state, units.input, units.disturbance, units.cost, spec.plant
    row = float(s[0]) if np.all(s == s[0]) else 1.0
    position = float(s[plant.position_index[0]])
    return replace(
        spec,
        plant=replace(
            plant,
            a=s[:, None] * plant.a / s,
            b=s[:, None] * plant.b / u,
            e=s[:, None] * plant.e / w,
            w=w[:, None] * plant.w * w,
            accel_per_input=plant.accel_map / u,
        ),
        state_set=Polytope(row * spec.state_set.c / s, row * spec.state_set.b),
        input_set=Polytope(spec.input_set.c / u, spec.input_set.b),
        q_x=f * spec.q_x / np.outer(s, s),
        q_u=f * spec.q_u / np.outer(u, u),
        k_tau=u[:, None] * spec.k_tau / s,
        target_m=(position * spec.target_m[0], position * spec.target_m[1], position * spec.target_m[2]),
        search_states=spec.search_states * s,
        slack_linear=spec.slack_linear * f / row,
        slack_quadratic=spec.slack_quadratic * f / row**2,
        offset_weight=spec.offset_weight * f / position,
        terminal_weight=spec.terminal_weight * f / row,
    )


def design_in_units(design: Design, units: Units) -> Design:
    """The same design in other units, with every array converted and none made anew."""
    s, u, f, terminal = units.state, units.input, units.cost, design.terminal
    spec = DesignSpec(
        plant=design.plant,
        state_set=design.state_set,
        input_set=design.input_set,
        q_x=design.q_x,
        q_u=design.q_u,
        horizon=design.horizon,
        tau=terminal.tau,
        delta_x=0.0,
        delta_u=0.0,
        delta_tau=0.0,
        k_tau=terminal.k,
        link=bernoulli(np.array([1.0])),
        target_m=(0.0, 0.0, 0.0),
        rule="fixed",
        delays=list(design.schedule.delays),
        gamma_max=1.0,
        search_states=np.zeros((0, design.plant.n_x)),
        allocation="ellipsoid",
        slack_linear=design.slack_linear,
        slack_quadratic=design.slack_quadratic,
        offset_weight=design.offset_weight,
        terminal_weight=design.terminal_weight,
        max_iterations=design.max_iterations,
    )
    scaled_spec = in_units(spec, units)
    xi, z = np.tile(s, terminal.tau + 1), np.concatenate([s, np.tile(u, terminal.tau)])
    return replace(
        design,
        plant=scaled_spec.plant,
        state_set=scaled_spec.state_set,
        input_set=scaled_spec.input_set,
        q_x=scaled_spec.q_x,
        q_u=scaled_spec.q_u,
        target=design.target * s,
        estimate_cov=s[:, None] * design.estimate_cov * s,
        slack_linear=scaled_spec.slack_linear,
        slack_quadratic=scaled_spec.slack_quadratic,
        offset_weight=scaled_spec.offset_weight,
        terminal_weight=scaled_spec.terminal_weight,
        terminal=Terminal(
            tau=terminal.tau,
            k=scaled_spec.k_tau,
            a_cl=xi[:, None] * terminal.a_cl / xi,
            e_xi=xi[:, None] * terminal.e_xi / units.disturbance,
            sigma_xi=xi[:, None] * terminal.sigma_xi * xi,
            sigma_x=s[:, None] * terminal.sigma_x * s,
            sigma_z=z[:, None] * terminal.sigma_z * z,
            p_xi=f * terminal.p_xi / np.outer(xi, xi),
            q_xi=f * terminal.q_xi / np.outer(xi, xi),
            spectral_radius=terminal.spectral_radius,
        ),
    )
