"""Two faults at a time on preset `room`, judged on the true vehicle: where it is, and how fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from soak_rig import LoopWatch, fly

from sim.cameras import AXES
from sim.simulation import World
from uavctl.config import Config, load_config
from uavctl.config.sim import FaultConfig
from uavctl.records import ControlMode, Vec3
from uavctl.wiring.controller import Prepared

FLIGHT_S = 30.0
OUTSIDE_M = 1.0  # beyond the position limits of `[sets]`, ceiling included
SPEED_MPS = 3.0  # twice what `[sets]` allows
WORLDS = [(plant, autopilot) for plant in ("linear", "quadrotor") for autopilot in ("px4", "ardupilot")]
KINDS = ("blackout", "held", "occluded", "swapped", "frozen", "frame", "noise", "drift", "wind")
WRONG_AXES = tuple(name for name in AXES if name != "right")


@dataclass(frozen=True)
class TrueFlight:
    """One flight as the truth has it.

    Attributes:
        seed: Of the flight.
        what: Plant, autopilot and the faults, for a person.
        outside_m: Furthest beyond the walls and the ceiling; negative is inside.
        speed_mps: Largest speed.
        moved_m: Furthest from where it was when the first fault began.
        hold_mps2: Largest setpoint while it held.
        ended: Whether it stood on the floor, or the controller flew it, in the end.
        alarms: What the envelope found.
        wrong: What was wrong.
    """

    seed: int
    what: str
    outside_m: float
    speed_mps: float
    moved_m: float
    hold_mps2: float
    ended: str
    alarms: tuple[str, ...]
    wrong: tuple[str, ...]


def compute_outside_m(config: Config, position_m: Vec3) -> float:
    """How far a position is beyond walls and ceiling; the floor is the simulator's own."""
    # The states of an axis follow each other, its position first; models differ in how many an axis has.
    states = len(config.sets.state_lower) // 3
    lower = config.sets.state_lower[::states]
    upper = [*config.sets.state_upper[: 2 * states : states], math.inf]
    rows = zip(position_m, lower, upper, strict=True)
    return max(max(low - value, value - high) for value, low, high in rows)


def silence_motion(world: World) -> None:
    """Keep the vehicle's own position and velocity from being sent."""
    streams = world.peers.autopilot.telemetry.streams
    streams[mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED] = lambda at_ns: None


def fly_true(
    prepared: Prepared, config: Config, path: Path | None = None, flight_s: float = FLIGHT_S, *, own_motion: bool = True
) -> TrueFlight:
    """Fly from the air, and look at the true vehicle in every tick; with or without its own word of how it moves."""
    begins_s = min((fault.at_s for fault in config.sim.fault), default=0.0)
    outside_m, speed_mps, moved_m, hold_mps2 = -math.inf, 0.0, 0.0, 0.0
    start: Vec3 | None = None
    ended = ""
    worlds: list[World] = []

    def look(world: World, watch: LoopWatch, at_ns: int) -> None:
        nonlocal outside_m, speed_mps, moved_m, hold_mps2, start, ended
        if not worlds:
            worlds.append(world)
            if not own_motion:
                silence_motion(world)
        place = world.peers.vehicle.position_m
        decision = None if watch.ticked is None else watch.ticked.decision
        outside_m = max(outside_m, compute_outside_m(config, place))
        pilot = world.peers.autopilot
        if pilot.pilot.is_armed:  # disarmed, a PX4 takes up the mode of before
            ended = pilot.mode_name
        speed_mps = max(speed_mps, math.hypot(*world.peers.vehicle.velocity_mps))
        if at_ns * 1e-9 >= begins_s:
            start = start or place
            moved_m = max(moved_m, math.dist(place[:2], start[:2]))
        if decision is not None and decision.mode is ControlMode.HOLD and decision.input is not None:
            hold_mps2 = max(hold_mps2, *map(abs, decision.input))

    config = replace(config, duration_s=flight_s)
    watch = fly(prepared, config, look, path=path, lands=True)
    wrong = list(watch.wrong)
    if outside_m > OUTSIDE_M:
        wrong.append(f"{outside_m:.2f} m outside")
    if speed_mps > SPEED_MPS:
        wrong.append(f"{speed_mps:.2f} m/s")
    return TrueFlight(
        seed=config.sim.seed,
        what=f"{config.sim.plant} {config.sim.autopilot}: " + "; ".join(map(_told, config.sim.fault)),
        outside_m=outside_m,
        speed_mps=speed_mps,
        moved_m=moved_m,
        hold_mps2=hold_mps2,
        ended=ended,
        alarms=tuple(watch.alarms),
        wrong=tuple(wrong),
    )


def _told(fault: FaultConfig) -> str:
    what = " ".join(filter(None, (fault.kind, fault.name)))
    if fault.kind == "noise":
        what += f" {fault.value:.2f} m"
    if fault.kind in ("wind", "drift"):
        what += " (" + ", ".join(f"{v:.1f}" for v in fault.velocity_mps) + ") m/s"
    return f"{what} at {fault.at_s:.2f} s" + (f" for {fault.for_s:.1f} s" if fault.for_s else "")


def draw_pair(seed: int) -> Config:
    """A world with two faults at random moments; each of the four worlds in turn."""
    rng = np.random.default_rng([seed, 14])
    plant, autopilot = WORLDS[seed % len(WORLDS)]
    config = load_config(
        "room-hahn-stursberg", [f"sim.plant={plant}", f"sim.autopilot={autopilot}", f"sim.seed={seed}"]
    )
    sim, link = config.sim, config.link
    wind = sim.wind
    if plant == "quadrotor":
        wind = replace(wind, velocity_mps=(0.6, -0.4, 0.0), gust_wind_mps=float(rng.uniform(0.0, 3.0)))
    faults = tuple(_drawn_fault(rng, plant) for _ in range(2))
    camera = replace(sim.camera, rate_hz=float(rng.choice([5.0, 10.0, 30.0])), other_body_m=(1.0, -1.0, -0.5))
    return replace(
        config,
        link=replace(link, loss=float(rng.uniform(0.0, 0.4))),
        sim=replace(sim, wind=wind, camera=camera, fault=faults),
    )


def _drawn_fault(rng: np.random.Generator, plant: str) -> FaultConfig:
    kinds = [kind for kind in KINDS if kind != "wind" or plant == "quadrotor"]
    kind, at_s = str(rng.choice(kinds)), float(rng.uniform(0.3, 12.0))
    span_s, noise_m = float(rng.uniform(0.2, 20.0)), float(rng.uniform(0.0, 1.0))
    name = str(rng.choice(WRONG_AXES)) if kind == "frame" else ""
    north, east = rng.uniform(-1.5, 1.5, 2).tolist()
    if kind == "drift":
        north, east = rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.6), float(rng.uniform(-0.3, 0.3))
    return FaultConfig(
        at_s=at_s,
        kind=kind,  # type: ignore[arg-type]  # one of them
        for_s=span_s if kind in ("blackout", "held", "occluded", "swapped", "frozen") else 0.0,
        name=name,
        value=noise_m if kind == "noise" else 0.0,
        velocity_mps=(north, east, 0.0) if kind in ("wind", "drift") else (0.0, 0.0, 0.0),
    )


def fly_pair(prepared: Prepared, seed: int, path: Path | None = None) -> TrueFlight:
    """Fly a drawn pair."""
    return fly_true(prepared, draw_pair(seed), path)
