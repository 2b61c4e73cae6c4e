"""One run of a campaign again: as a flight through the flight controller, MAVLink and the simulated autopilot.

The controller's configuration is that of the cell's design: it believes in the cell's link and plant. What really
flies (plant, start, disturbances, losses) is given to the simulator apart, as a script, so a replay of the recording
needs the configuration alone. Baselines have no flight controller, so there is nothing to fly again.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from sim.script import Script
from uavctl.build import build_plant
from uavctl.campaign.again import Again
from uavctl.campaign.world import Flown
from uavctl.config import Config
from uavctl.config.mission import MissionConfig
from uavctl.config.peers import ClockConfig, FrameConfig, SourceConfig
from uavctl.config.types import PlantConfig
from uavctl.data import Truth
from uavctl.smpc.batch import Counts
from uavctl.smpc.plant import AXES

Array = NDArray[np.float64]

# Positions, velocities and setpoints cross MAVLink as float32: 2e-6 m of 50 m. Feedback multiplies that by a few, and
# the loop, being stable, does not heap it up. An answer within the certified gap that another policy gives on the other
# side of a border may differ by more, and then shows as a disagreement.
TOLERANCE = 1e-4
_EXACT = 1e-5  # standard deviation believed of what the campaign measures exactly
_KNOWN = 1e-6  # the same of the states that the first position does not show
_NEVER = 1e6  # [s], [m], [m/s]
_ACCEL_MPS2 = 100.0  # the simulated vehicle takes no more


@dataclass(frozen=True, eq=False)
class Reflight:
    """What is flown again, and what it should come to.

    Attributes:
        config: The configuration of the flight.
        script: What the simulator does.
        flown: The run as the campaign flew it (N = 1).
        compared: Steps in which both fly plans; then no plan was left, and the flight core brakes tick by tick.
        parts: Why they differ all the same; empty if they should not.
    """

    config: Config
    script: Script
    flown: Flown
    compared: int
    parts: str


class Agreement(msgspec.Struct, frozen=True, kw_only=True):
    """How well a flight agrees with its run in the campaign."""

    steps: int  # compared: until a plan ran out
    largest_state: float  # largest difference of a state [m, m/s, m/s²]
    largest_input: float  # of an input [input units]
    tolerance: float
    agrees: bool
    reason: str  # why they differ, where that is known; empty if they should not


def reflight(run: Again, name: str) -> Reflight:
    """Make a flight of a run of an SMPC, called `name`."""
    believed, newest = run.config, run.newest
    script = Script(
        plant=_same_setpoints(run.plant, believed.plant),
        start=run.start,
        disturbances=run.disturbances,
        delays_ns=delays_ns(newest, round(believed.plant.dt_s * 1e9)),
    )
    (old,) = np.nonzero(np.arange(newest.size) - newest >= believed.smpc.horizon)
    return Reflight(
        config=flight_config(believed, run.start, newest.size, name, run.master),
        script=script,
        flown=run.flown,
        compared=int(old[0]) if old.size else newest.size,
        parts=_parts(run),
    )


def _parts(run: Again) -> str:
    """Why the flight's estimate is not the state that the campaign tells its controllers; empty if it is."""
    if run.plant != run.config.plant:
        return "the flight's filter believes in the design's plant, and another one flies"
    if run.config.risk.estimate != "exact":
        return "the design counts on a filter of inexact positions, and the flight has one"
    if run.config.estimator.bias_drift:
        return "the flight's filter estimates a bias of the inputs"
    return ""


def delays_ns(newest: Counts, dt_ns: int) -> tuple[int | None, ...]:
    """Delay of each position [ns], None for those that were never the newest: lost, or overtaken and of no use.

    Args:
        newest: Capture step of the newest position known in each step (T,).
        dt_ns: Δt [ns].
    """
    captured, known = np.unique(newest, return_index=True)
    delays: list[int | None] = [None] * newest.size
    for step, first in zip(captured.tolist(), known.tolist(), strict=True):
        delays[step] = (first - step) * dt_ns
    return tuple(delays)


def flight_config(config: Config, start: Array, steps: int, name: str, seed: int) -> Config:
    """The design's configuration, with what the campaign's world is in place of cameras, filter and gate.

    One exact position a step that shows the velocity too; no limit of a setpoint but that of the inputs; plans are
    flown again as soon as there is one. Nothing that the design depends on is changed. The campaign's `seed` is told
    in the recording; nothing is drawn with it.
    """
    dt_s, duration_s = config.plant.dt_s, config.plant.dt_s * steps
    plant = build_plant(config)
    position_m, velocity_mps, accel_mps2 = [0.0] * 3, [0.0] * 3, [_ACCEL_MPS2] * 3
    widest = np.maximum(np.abs(config.sets.input_lower), np.abs(config.sets.input_upper))
    largest = np.abs(plant.accel_map) @ np.minimum(widest, _NEVER)
    for place, axis in enumerate(map(AXES.index, config.plant.axes)):
        position_m[axis] = float(start[plant.position_index[place]])
        velocity_mps[axis] = float(start[plant.velocity_index[place]])
        accel_mps2[axis] = min(float(largest[place]), _ACCEL_MPS2)
    estimator, sim = config.estimator, config.sim
    exact = config.risk.estimate == "exact"  # else the design counts on the filter's own figure
    return replace(
        config,
        name=name,
        duration_s=duration_s,
        mission=MissionConfig(),
        fence=(),
        frame=FrameConfig(),
        source=SourceConfig(rate_hz=config.source.rate_hz),
        clock=ClockConfig(window_s=duration_s + dt_s),  # the first position is never late and sets the clock
        estimator=replace(
            estimator,
            position_std_m=_EXACT if exact else estimator.position_std_m,
            velocity_std_mps=_EXACT,
            initial_std=_KNOWN,
            window_s=max(estimator.window_s, 2 * config.smpc.horizon * dt_s),
            max_position_m=_NEVER,
            max_velocity_mps=_NEVER,
        ),
        fallback=replace(
            config.fallback, brake_s=_NEVER, hold_s=_NEVER, blind_hold_s=_NEVER, land=False, recover_samples=1
        ),
        envelope=replace(config.envelope, lead_s=0.0),
        limits=replace(config.limits, accel_mps2=tuple(accel_mps2), slew_mps3=_NEVER),
        sim=replace(
            sim,
            seed=seed,
            start_position_m=tuple(position_m),
            start_velocity_mps=tuple(velocity_mps),
            camera=replace(
                sim.camera,
                rate_hz=1.0 / dt_s,
                phase_s=0.0,
                noise_std_m=0.0,
                latency_s=0.0,
                clock_offset_s=0.0,
                message="odometry",
            ),
        ),
    )


def agreement(again: Reflight, truths: list[Truth]) -> Agreement:
    """Compare a flight with its run, as far as both fly plans.

    Args:
        again: The flight.
        truths: The true state at each boundary, and the input from there on.
    """
    steps = again.compared
    states = np.array([truth.state for truth in truths[: steps + 1]])
    inputs = np.array([truth.input for truth in truths[:steps]])
    state = float(np.abs(states - again.flown.states[0, : steps + 1]).max(initial=0.0))
    used = float(np.abs(inputs - again.flown.inputs[0, :steps]).max(initial=0.0))
    return Agreement(
        steps=steps,
        largest_state=state,
        largest_input=used,
        tolerance=TOLERANCE,
        agrees=max(state, used) <= TOLERANCE,
        reason=again.parts,
    )


def _same_setpoints(flown: PlantConfig, believed: PlantConfig) -> PlantConfig:
    """The plant that flies, taking setpoints as the believed one does: what differs acts on the inputs themselves."""
    if flown.model != "matrices":
        return flown
    gain = believed.accel_per_input if believed.model == "matrices" else (1.0,) * len(flown.axes)
    return replace(flown, accel_per_input=gain)
