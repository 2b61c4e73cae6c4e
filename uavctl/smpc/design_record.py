"""A design as plain numbers."""

from __future__ import annotations

import numpy as np

from uavctl.smpc.design import Design
from uavctl.smpc.terminal import stationary_cost


def design_record(design: Design) -> dict[str, object]:
    """The design as plain numbers, for recordings and `uavctl design --json`."""
    plant, schedule, terminal = design.plant, design.schedule, design.terminal
    return {
        "design_id": design.design_id,
        "tau": terminal.tau,
        "horizon": design.horizon,
        "dt_s": plant.dt_s,
        "axes": list(plant.axes),
        "position_index": list(plant.position_index),
        "velocity_index": list(plant.velocity_index),
        "accel_per_input": plant.accel_per_input.tolist(),
        "target": design.target.tolist(),
        "delays": list(schedule.delays),
        "alpha": schedule.alpha.tolist(),
        "gamma_x": schedule.gamma_x.tolist(),
        "gamma_u": schedule.gamma_u.tolist(),
        "kappa_x": design.kappa_x.tolist(),
        "kappa_u": design.kappa_u.tolist(),
        "kappa_x_terminal": design.kappa_x_terminal,
        "kappa_u_terminal": design.kappa_u_terminal,
        "spectral_radius": terminal.spectral_radius,
        "stationary_cost": stationary_cost(terminal),
        "assumptions": [
            {
                "item": check.item,
                "ok": check.ok,
                "value": check.value,
                "limit": check.limit if np.isfinite(check.limit) else None,  # JSON has no infinity
                "text": check.text,
            }
            for check in design.assumptions
        ],
        "a": plant.a.tolist(),
        "b": plant.b.tolist(),
        "e": plant.e.tolist(),
        "w": plant.w.tolist(),
        "c_x": design.state_set.c.tolist(),
        "b_x": design.state_set.b.tolist(),
        "c_u": design.input_set.c.tolist(),
        "b_u": design.input_set.b.tolist(),
        "q_x": design.q_x.tolist(),
        "q_u": design.q_u.tolist(),
        "k_tau": terminal.k.tolist(),
        "sigma_x": terminal.sigma_x.tolist(),
        "estimate_cov": design.estimate_cov.tolist(),
        "late": [
            {
                "delays": list(late.schedule.delays),
                "alpha": late.schedule.alpha.tolist(),
                "gamma_x": late.schedule.gamma_x.tolist(),
                "gamma_u": late.schedule.gamma_u.tolist(),
                "kappa_x": late.kappa_x.tolist(),
                "kappa_u": late.kappa_u.tolist(),
            }
            for late in design.late
        ],
        "slack_linear": design.slack_linear,
        "slack_quadratic": design.slack_quadratic,
        "offset_weight": design.offset_weight,
        "terminal_weight": design.terminal_weight,
        "max_iterations": design.max_iterations,
    }
