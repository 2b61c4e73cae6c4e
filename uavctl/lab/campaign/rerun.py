"""One run of a campaign again: as a flight through the flight controller, MAVLink and the simulated autopilot.

The controller's configuration is that of the cell's design: it believes in the cell's link and plant. What really
flies (plant, start, disturbances, losses) is given to the simulator apart, as a script, so a replay of the recording
needs the configuration alone. Baselines have no flight controller, so there is nothing to fly again.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from sim.vehicle.linear import Script
from uavctl import __version__
from uavctl.build.controller import build_plant
from uavctl.config import Config
from uavctl.config.connections import ClockConfig, FrameConfig, SourceConfig
from uavctl.config.mission import MissionConfig
from uavctl.config.types import PlantConfig
from uavctl.errors import UavctlError, UsageError
from uavctl.lab.campaign.controllers import LibraryFor, met
from uavctl.lab.campaign.spec import CHUNK, campaign_of
from uavctl.lab.campaign.store import DOCUMENT, first_difference
from uavctl.lab.campaign.tasks import Task, cell_of, flown, told
from uavctl.lab.campaign.world import Flown
from uavctl.records import Truth
from uavctl.smpc.batch import Counts
from uavctl.smpc.plant import AXES

# One run of a campaign once more, from the campaign's folder: all that it met, and how it went.


Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Rerun:
    """One run of T steps."""

    config: Config  # what its controller believes
    plant: PlantConfig  # the plant that flew
    start: Array  # x(0) (n_x,)
    newest: Counts  # capture step of the newest position known in each step (T,)
    disturbances: Array  # w (T, n_w)
    flown: Flown  # the run, N = 1
    campaign: str  # name of the campaign
    master: int  # its seed


def again(folder: Path, cell: int, run: int, library_for: LibraryFor) -> Rerun:
    """Fly one run once more, together with those that it was flown with.

    Args:
        library_for: Gives the policy library of a design.

    Raises:
        UavctlError: The folder holds no campaign, or this version would design another controller.
        UsageError: There is no such run.
    """
    document = _document(folder)
    campaign = campaign_of(document)
    cells, runs = msgspec.convert(document["cells"], list[dict[str, Any]]), campaign.spec.runs
    if not 0 <= cell < len(cells) or not 0 <= run < runs:
        raise UsageError(f"cell {cell}, run {run}: there are the cells 0 to {len(cells) - 1}, the runs 0 to {runs - 1}")
    if campaign.spec.measured != "state":
        raise UsageError(
            f"{folder}: its controllers were told positions, and a flight of the simulator has a noise of its own; "
            "fly one with uavctl loopback"
        )
    made = cell_of(campaign, cell, library_for)
    different = first_difference(cells[cell], told(made), f"cells[{cell}]")
    if different is not None:
        raise UavctlError(
            f"{folder}: uavctl {document['uavctl_version']} flew another controller than {__version__} makes "
            f"({different}); use the version that flew it"
        )
    if made.recipe is None:
        raise UsageError(f"cell {cell} was not flown: {made.refused}")
    first = run - run % CHUNK
    task = Task(cell, first, min(CHUNK, runs - first), made.setting, made.recipe)
    row = slice(run - first, run - first + 1)
    found, _ = flown(task, task.first, task.runs)
    meets = met(made.setting, task.first, task.runs)
    return Rerun(
        config=made.recipe.config,
        plant=made.setting.plant,
        start=meets.scene.start[row][0],
        newest=meets.newest[row][0],
        disturbances=meets.disturbances[row][0],
        flown=Flown(**{field.name: getattr(found, field.name)[row] for field in fields(Flown)}),
        campaign=campaign.spec.name,
        master=campaign.spec.master,
    )


def _document(folder: Path) -> dict[str, object]:
    try:
        document = msgspec.json.decode((folder / DOCUMENT).read_bytes(), type=dict[str, object])
    except (OSError, msgspec.MsgspecError) as error:
        raise UavctlError(f"{folder} holds no campaign ({error}); give the folder of one") from error
    return document


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
    """What is flown again, and what it should come to."""

    config: Config  # the configuration of the flight
    script: Script  # what the simulator does
    flown: Flown  # the run as the campaign flew it (N = 1)
    compared: int  # steps in which both fly plans; then no plan was left, and the flight core brakes tick by tick
    parts: str  # why they differ all the same; empty if they should not


class Agreement(msgspec.Struct, frozen=True, kw_only=True):
    """How well a flight agrees with its run in the campaign."""

    steps: int  # compared: until a plan ran out
    largest_state: float  # largest difference of a state [m, m/s, m/s²]
    largest_input: float  # of an input [input units]
    tolerance: float
    agrees: bool
    reason: str  # why they differ, where that is known; empty if they should not


def reflight(run: Rerun, name: str) -> Reflight:
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


def _parts(run: Rerun) -> str:
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
