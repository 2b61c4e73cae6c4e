"""Flights drawn at random: world, mission, faults, and what the operator, the shell and strangers do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from draw_controller import draw_controller, is_mission_feasible
from msgspec.structs import replace

from sim.autopilot.profile import SIMULATED
from uavctl.config import Config, load_config
from uavctl.config.link import LinkConfig
from uavctl.config.sim import FaultConfig
from uavctl.records import Command, Order, Vec3

SPANS = ("blackout", "held", "uplink_blackout", "occluded", "swapped", "frozen")


@dataclass(frozen=True)
class FlightDraw:
    """What a seed draws.

    Attributes:
        config: What flies, and in what simulator.
        link: The channel that positions really come over; that of `config` is what the design counts on.
        start_ns: Time of tick 0.
        take_off_m: Height of a climb that is ordered in the first tick; None begins in the air.
        orders: Of the operator, each with the tick before which it comes.
        stop_tick: From when on the operator asks for the hand-over; None never.
        skipped: Ticks that the loop oversleeps.
        late_ticks: Ticks that run when what arrives up to the next one is there.
        noise: Share of the ticks before which a stranger's datagram comes.
        reboot_step: Step Δt at which the vehicle starts anew; None never.
        signed: Whether there are doors on both connections.
        viewers: Whether what viewers want is made beside the records.
    """

    config: Config
    link: LinkConfig
    start_ns: int
    take_off_m: float | None
    orders: tuple[tuple[int, Command], ...]
    stop_tick: int | None
    skipped: frozenset[int]
    late_ticks: frozenset[int]
    noise: float
    reboot_step: int | None
    signed: bool
    viewers: bool

    @property
    def labels(self) -> tuple[str, ...]:
        """What it has, for a count of what many seeds have covered."""
        config = self.config
        is_present = {
            f"preset {config.name}": True,
            f"simulated {config.sim.plant}": True,
            config.sim.autopilot: True,
            f"solver {config.solver.method}": True,
            f"schedule {config.schedule.rule}": True,
            f"allocation {config.risk.allocation}": True,
            f"estimate {config.risk.estimate}": True,
            f"design link {config.link.model}": True,
            f"true link {self.link.model}": True,
            f"camera {config.sim.camera.message}": True,
            "late positions planned on": config.schedule.late > 0,
            "bias estimated": config.estimator.bias_drift > 0.0,
            "waypoints": bool(config.mission.waypoints),
            "trajectory": bool(config.mission.trajectory.times_s),
            "fence": bool(config.fence),
            "relay": config.relay.enabled,
            "one connection": config.daemon.vehicle == config.daemon.mocap,
            "take-off": self.take_off_m is not None,
            "orders": bool(self.orders),
            "stop": self.stop_tick is not None,
            "missed ticks": bool(self.skipped),
            "late ticks": bool(self.late_ticks),
            "strangers": self.noise > 0.0,
            "reboot": self.reboot_step is not None,
            "signed": self.signed,
            "viewers": self.viewers,
            **{f"fault {fault.kind}": True for fault in config.sim.fault},
        }
        return tuple(label for label, is_so in is_present.items() if is_so)


def draw_flight(seed: int) -> FlightDraw:
    """The flight of a seed."""
    rng = np.random.default_rng(seed)
    config = draw_controller(rng, seed)
    calm = rng.uniform() < 0.5  # else little is flown: the fallback has it soon
    config = _mission(rng, _simulated(rng, config, seed, calm))
    ticks = round(config.duration_s / config.daemon.tick_s)
    steps = round(config.duration_s / config.plant.dt_s)
    per_step = ticks // steps
    takes_off = config.name == "room-hahn-stursberg" and config.sim.plant == "quadrotor" and rng.uniform() < 0.4
    if takes_off:
        low = replace(config.sim, start_position_m=(*config.sim.start_position_m[:2], -0.05))
        config = replace(config, sim=low)
    skipped, late_ticks = _ticks(rng, ticks, 0.4), _ticks(rng, ticks, 0.4)
    return FlightDraw(
        config=config,
        link=_true_link(rng, config, calm),
        start_ns=int(rng.integers(0, 10**6)) * round(config.plant.dt_s * 1e9),
        take_off_m=1.0 if takes_off else None,
        orders=_orders(rng, config, ticks),
        stop_tick=int(rng.integers(ticks // 2, ticks)) if rng.uniform() < 0.25 else None,
        skipped=skipped,
        late_ticks=late_ticks - skipped,
        noise=float(rng.choice([0.0, 0.3])),
        reboot_step=int(rng.integers(steps // 3, steps)) if rng.uniform() < 0.15 else None,
        signed=bool(rng.uniform() < 0.3 and per_step > 1),
        viewers=bool(rng.uniform() < 0.2),
    )


def _true_link(rng: np.random.Generator, config: Config, calm: bool) -> LinkConfig:
    """What it really is: sometimes what was counted on, and always with what no design knows of."""
    link = config.link
    if not calm:
        link = LinkConfig(
            loss=float(rng.uniform(0.0, 0.7)),
            delay_s=float(rng.uniform(0.0, 0.15)),
            jitter_s=float(rng.uniform(0.0, 0.3)),
            model="gilbert-elliott" if rng.uniform() < 0.5 else "bernoulli",
            burst_enter=0.1,
            burst_leave=0.4,
        )
    return replace(
        link,
        duplicate=float(rng.uniform(0.0, 0.2)),
        corrupt=float(rng.uniform(0.0, 0.1)),
        truncate=float(rng.uniform(0.0, 0.05)),
        oversize=float(rng.uniform(0.0, 0.02)),
    )


def _simulated(rng: np.random.Generator, config: Config, seed: int, calm: bool) -> Config:
    """Vehicle, cameras, their clock and frame, connections, and faults at their times."""
    plant = str(rng.choice(["linear", "quadrotor"])) if config.name == "room-hahn-stursberg" else "linear"
    autopilot = str(rng.choice(["px4", "ardupilot"]))
    camera = replace(
        config.sim.camera,
        rate_hz=float(rng.choice([5.0, 10.0, 30.0]))
        if config.name == "room-hahn-stursberg"
        else config.sim.camera.rate_hz,
        noise_std_m=float(rng.choice([0.0, 0.003, 0.02])),
        latency_s=float(rng.choice([0.0, 0.02])),
        jitter_s=float(rng.choice([0.0, 0.05])),
        clock_offset_s=float(rng.uniform(-100.0, 1e4)),
        clock_drift_ppm=float(rng.uniform(-300.0, 300.0)),
        occlusions_per_s=0.0 if calm else 0.1,
        other_body_m=(1.0, -1.0, -0.5),
        message=str(rng.choice(["vision", "vicon", "mocap", "odometry"]))
        if config.name == "room-hahn-stursberg"
        else "odometry",
    )
    duration_s = float(rng.integers(8, 15)) if config.name == "room-hahn-stursberg" else float(rng.integers(12, 25))
    sim = replace(
        config.sim,
        plant=plant,
        autopilot=autopilot,
        camera=camera,
        seed=seed,
        system_id=int(rng.integers(1, 20)),
        fault=_faults(rng, plant, autopilot, duration_s, 12.0 if calm else 4.0),
    )
    if plant == "quadrotor":
        wind = replace(sim.wind, velocity_mps=(0.5, -0.3, 0.0), gust_wind_mps=float(rng.uniform(0.0, 6.0)))
        sim = replace(sim, wind=wind, quadrotor=replace(sim.quadrotor, charge=float(rng.choice([1.0, 0.2]))))
    shared = rng.uniform() < 0.3
    return replace(
        config,
        duration_s=duration_s,
        sim=sim,
        frame=replace(
            config.frame,
            convention=str(rng.choice(["ned", "enu"])),
            origin_m=tuple(float(x) for x in rng.uniform(-1.0, 1.0, 3)),
            yaw_deg=float(rng.uniform(-180.0, 180.0)),
        ),
        daemon=replace(config.daemon, mocap=config.daemon.vehicle if shared else config.daemon.mocap),
        relay=replace(
            config.relay,
            enabled=bool(rng.uniform() < 0.4),
            message=str(rng.choice(["odometry", "vision-position-estimate"])),
        ),
        log=replace(
            config.log,
            chunk_bytes=int(rng.choice([1024, 4096, 16384])),
            segment_bytes=int(rng.choice([100_000, 50_000_000])),
        ),
    )


def _faults(
    rng: np.random.Generator, plant: str, autopilot: str, flight_s: float, every_s: float
) -> tuple[FaultConfig, ...]:
    """About one in so many seconds."""
    kinds = [*SPANS, "mode", "parameter", *(("wind", "battery") if plant == "quadrotor" else ())]
    weights = np.array([0.3 if kind == "mode" else 1.0 for kind in kinds])
    results = []
    for at_s in np.sort(rng.uniform(0.0, flight_s, rng.poisson(flight_s / every_s))).tolist():
        kind = str(rng.choice(kinds, p=weights / weights.sum()))
        fault = FaultConfig(at_s=at_s, kind=kind)  # type: ignore[arg-type]  # one of them
        if kind in SPANS:
            fault = replace(fault, for_s=float(rng.uniform(0.1, 4.0)))
        elif kind == "wind":
            fault = replace(fault, velocity_mps=(*(float(v) for v in rng.uniform(-1.5, 1.5, 2)), 0.0))
        elif kind == "battery":
            fault = replace(fault, charge=float(rng.uniform(0.0, 0.5)))
        elif kind == "mode":
            fault = replace(fault, name=str(rng.choice([mode.name for mode in SIMULATED[autopilot].modes])))
        else:
            name = "COM_OF_LOSS_T" if autopilot == "px4" else "GUID_TIMEOUT"
            fault = replace(fault, name=name, value=float(rng.uniform(0.5, 3.0)))
        results.append(fault)
    return tuple(results)


def _mission(rng: np.random.Generator, config: Config) -> Config:
    """Waypoints, a trajectory, or neither; sometimes a limit that closes in."""
    kind = str(rng.choice(["target", "waypoints", "trajectory"]))
    mission = config.mission
    if kind == "waypoints":
        places = tuple(_place(rng, config) for _ in range(int(rng.integers(1, 4))))
        then = str(rng.choice(["hold", "land"]))
        mission = replace(mission, waypoints=places, hold_s=float(rng.uniform(0.0, 2.0)), then=then)
    elif kind == "trajectory" and config.solver.method != "printed":
        times = tuple(float(t) for t in np.arange(0.0, config.duration_s, config.duration_s / 5.0))
        motion = replace(
            mission.trajectory,
            times_s=times,
            positions_m=tuple(_place(rng, config) for _ in times),
            interpolation=str(rng.choice(["linear", "cubic"])),
        )
        mission = replace(mission, trajectory=motion)
    fenced = config.name == "room-hahn-stursberg" and config.solver.method != "printed" and rng.uniform() < 0.2
    overrides = ["fence=[{state='north', side='upper', times_s=[2.0, 6.0], values=[3.0, 2.2]}]"] if fenced else []
    fence = load_config("room-hahn-stursberg", overrides).fence
    moved = replace(config, mission=mission, fence=fence)
    return moved if is_mission_feasible(moved) else config


def _place(rng: np.random.Generator, config: Config) -> Vec3:
    """Somewhere well inside of the limits."""
    if config.name == "room-hahn-stursberg":
        return (float(rng.uniform(-1.5, 1.5)), float(rng.uniform(-1.0, 1.0)), float(rng.uniform(-1.6, -0.9)))
    return (float(rng.uniform(-10.0, 20.0)), float(rng.uniform(-10.0, 8.0)), 0.0)


def _orders(rng: np.random.Generator, config: Config, ticks: int) -> tuple[tuple[int, Command], ...]:
    """A few orders of the operator, in the midst of it."""
    results = []
    for tick in np.sort(rng.integers(0, ticks, rng.poisson(1.5))).tolist():
        order = rng.choice([Order.GOTO, Order.HOLD, Order.RESUME, Order.LAND, Order.ENGAGE, Order.TAKE_OFF])
        command = Command(
            order=Order(str(order)),
            position_m=_place(rng, config) if order == Order.GOTO else None,
            height_m=1.0 if order == Order.TAKE_OFF else None,
        )
        results.append((tick, command))
    return tuple(results)


def _ticks(rng: np.random.Generator, ticks: int, share: float) -> frozenset[int]:
    """Some ticks, some of them in a row; in part of the flights none."""
    if rng.uniform() > share:
        return frozenset()
    starts = rng.integers(1, ticks - 1, 6)
    return frozenset(
        int(start) + i for start in starts for i in range(int(rng.integers(1, 8))) if start + i < ticks - 1
    )
