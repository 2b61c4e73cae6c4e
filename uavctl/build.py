"""Composition: a configuration's numbers become plant, design, solver and controller."""

from __future__ import annotations

import math

import numpy as np

from uavctl.config.types import Config, LinkConfig
from uavctl.errors import DesignError
from uavctl.flight.controller import Controller
from uavctl.flight.fallback import FallbackParameters
from uavctl.flight.kalman import EstimatorParameters
from uavctl.flight.limits import LimitsParameters
from uavctl.smpc.answer import Solver
from uavctl.smpc.conic import ConicSolver
from uavctl.smpc.design import Design, DesignSpec, make_design
from uavctl.smpc.feasibility import check_schedule, optimal_cost
from uavctl.smpc.plant import Plant, drag_lag
from uavctl.smpc.printed import PrintedSolver
from uavctl.smpc.sets import Polytope

NANOSECONDS = 1e9


def build_plant(config: Config) -> Plant:
    """The plant (1).

    Raises:
        DesignError: The matrices are no sampled continuous plant.
    """
    plant = config.plant
    if plant.model == "drag-lag":
        return drag_lag(plant.drag_1ps, plant.lag_s, plant.gain, plant.wind_std_mps2, plant.dt_s, plant.axes)
    a, b, e, w, accel = (
        np.array(rows, dtype=np.float64) for rows in (plant.a, plant.b, plant.e, plant.w, plant.accel_per_input)
    )
    return Plant(
        a=a,
        b=b,
        e=e,
        w=w,
        dt_s=plant.dt_s,
        axes=plant.axes,
        position_index=plant.position_index,
        velocity_index=plant.velocity_index,
        accel_per_input=accel,
    )


def link_probability(config: Config) -> float:
    """p(k): probability that at least one position captured within a Δt is there at its end.

    Positions are lost one by one with the mean loss of the link. Of a Δt's positions, those count that even the
    longest delay lets arrive in time; without `source.rate_hz` it is one, which is what the paper's link sends.

    Raises:
        DesignError: No position can be counted on: the delay is Δt or more, or the rate too low.
    """
    link, rate_hz, dt_s = config.link, config.source.rate_hz, config.plant.dt_s
    longest_s = link.delay_s + link.jitter_s
    if longest_s >= dt_s:
        raise DesignError(
            "link.delay_s",
            f"a position is on its way for up to {link.delay_s:g} + {link.jitter_s:g} s (delay and jitter), and is of "
            f"use within the step of {dt_s:g} s only",
            f"keep link.delay_s + link.jitter_s below plant.dt_s = {dt_s:g}, or take a longer step",
        )
    in_time = math.floor(rate_hz * (dt_s - longest_s) + 1e-9) if rate_hz else 1
    if in_time < 1:
        raise DesignError(
            "source.rate_hz",
            f"{rate_hz:g} positions a second are none that is sure to be captured in the {dt_s - longest_s:g} s of a "
            "step that leave time for the delay",
            f"give at least {1.0 / (dt_s - longest_s):.4g}, or 0 to count on one position a step",
        )
    return 1.0 - mean_loss(link) ** in_time


def mean_loss(link: LinkConfig) -> float:
    """Share of packets lost in the long run; of Gilbert-Elliott's chain, in its stationary distribution."""
    if link.model == "bernoulli":
        return link.loss
    bad = link.burst_enter / (link.burst_enter + link.burst_leave)  # burst_leave is positive by its type
    return (1.0 - bad) * link.loss + bad * link.burst_loss


def build_spec(config: Config) -> DesignSpec:
    """What the configuration asks of a design.

    Raises:
        DesignError: See `build_plant` and `link_probability`.
    """
    smpc, schedule, sets = config.smpc, config.schedule, config.sets
    return DesignSpec(
        plant=build_plant(config),
        state_set=Polytope.from_box(sets.state_lower, sets.state_upper),
        input_set=Polytope.from_box(sets.input_lower, sets.input_upper),
        q_x=np.diag(config.cost.state),
        q_u=np.diag(config.cost.input),
        horizon=smpc.horizon,
        tau=smpc.tau,
        delta_x=smpc.delta_x,
        delta_u=smpc.delta_u,
        delta_tau=smpc.delta_tau,
        k_tau=np.array(smpc.k_tau, dtype=np.float64),
        link_p=np.full(max(smpc.horizon, smpc.tau), link_probability(config)),
        target_m=config.target.position_m,
        rule=schedule.rule,
        delays=schedule.delays,
        gamma_max=schedule.gamma_max,
        search_states=np.array(schedule.search_states, dtype=np.float64),
        allocation=config.risk.allocation,
        slack_linear=smpc.slack_linear,
        slack_quadratic=smpc.slack_quadratic,
        offset_weight=smpc.offset_weight,
        terminal_weight=smpc.terminal_weight,
        max_iterations=config.solver.max_iterations,
    )


def build_design(config: Config) -> Design:
    """The design, checked against Assumption 4 and for a terminal condition that its schedule can meet.

    Raises:
        DesignError: There is none, naming key, reason and what to do.
    """
    design = make_design(build_spec(config), optimal_cost)
    check_schedule(design)
    return design


def build_solver(design: Design, config: Config) -> Solver:
    """The solver of `solver.method`.

    Raises:
        DesignError: The design does not fit the solver.
    """
    return PrintedSolver(design) if config.solver.method == "printed" else ConicSolver(design)


def build_controller(config: Config, design: Design | None = None) -> Controller:
    """Everything constant that a control tick needs; the design is made if it is not given.

    Raises:
        DesignError: There is no design.
    """
    design = build_design(config) if design is None else design
    estimator, fallback, limits = config.estimator, config.fallback, config.limits
    return Controller(
        plant=design.plant,
        design_id=design.design_id,
        horizon=design.horizon,
        solver=build_solver(design, config),
        target=design.target,
        estimator=EstimatorParameters(
            position_std_m=estimator.position_std_m,
            velocity_std_mps=estimator.velocity_std_mps,
            initial_std=estimator.initial_std,
            window_s=estimator.window_s,
            max_position_m=estimator.max_position_m,
            max_velocity_mps=estimator.max_velocity_mps,
        ),
        fallback=FallbackParameters(
            brake_gain_1ps=fallback.brake_gain_1ps,
            brake_s=fallback.brake_s,
            hold_s=fallback.hold_s,
            land=fallback.land,
            recover_samples=fallback.recover_samples,
        ),
        limits=LimitsParameters(accel_mps2=limits.accel_mps2, slew_mps3=limits.slew_mps3),
        dt_ns=round(config.plant.dt_s * NANOSECONDS),
        tick_ns=round(config.daemon.tick_s * NANOSECONDS),
    )
