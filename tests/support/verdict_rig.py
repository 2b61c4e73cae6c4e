"""Flights that obey the filter's model exactly, or break it in a known way. No solver, no link, no simulator."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from loopback_rig import header

from logs.recording.flight import FlightData
from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.flight.kalman import make_kalman
from uavctl.records import ControlMode, Decision, PositionSample, Record, StepInput, VehicleStatus
from uavctl.wiring.controller import build_design, build_estimator, build_plant

VEHICLE = VehicleStatus(at_ns=0, autopilot="px4", armed=True, mode="OFFBOARD", external=True)
CAPTURED_NS = 30_000_000  # into each step
ARRIVED_NS = 40_000_000  # later
Noise = Callable[[int, Array], Array]


def room() -> Config:
    return load_config("room-hahn-stursberg", ("solver.method=exact",))


def plain(_step: int, w: Array) -> Array:
    """The disturbance as the model has it."""
    return w


def simulate_model(
    config: Config,
    steps: int,
    *,
    seed: int,
    noise: Noise = plain,
    loss: float = 0.3,
    late_ns: int = 0,
    dead_steps: int = 0,
) -> FlightData:
    """A flight of the filter's own model, open loop: random inputs, disturbances as `noise` makes of the model's.

    `late_ns`: by so much the stamps are later than the captures. `dead_steps`: so many steps after it was sent an input
    begins to act.
    """
    rng = np.random.default_rng(seed)
    plant, believed = build_plant(config), build_estimator(config)
    dt_ns, tick_ns = round(config.plant.dt_s * 1e9), round(config.daemon.tick_s * 1e9)
    kalman = make_kalman(plant, believed, dt_ns)
    roots = np.linalg.cholesky(kalman.w)
    state = rng.normal(0.0, believed.initial_std, kalman.n_x)
    state[plant.n_x :] = rng.normal(0.0, 0.25 * believed.bias_max, kalman.n_bias)
    items: list[tuple[str, int, Record]] = [("/uavctl/header", 0, header(config, build_design(config)))]
    per_step, age = dt_ns // tick_ns, 0
    waiting: list[PositionSample] = []
    coming = [np.zeros(plant.n_u)] * dead_steps
    for step in range(steps):
        begun_ns = step * dt_ns
        u = rng.normal(0.0, 0.5, plant.n_u)
        z = np.concatenate([state, noise(step, roots @ rng.standard_normal(len(roots)))])
        arrived = bool(waiting)
        age = 0 if arrived else age + 1
        for part in range(per_step):
            at_ns = begun_ns + part * tick_ns
            samples, waiting = tuple(waiting), []
            tick = step * per_step + part
            items.append(("", at_ns, StepInput(tick=tick, at_ns=at_ns, samples=samples, vehicle=VEHICLE)))
            items.append(("", at_ns, decision(tick, at_ns, step, u, age, boundary=part == 0)))
        coming.append(u)
        acting = coming.pop(0)
        f, _, g = kalman.propagation.over(CAPTURED_NS)
        observed = (f @ z + g @ acting)[kalman.measured_index[: len(kalman.axes)]] + rng.normal(
            0.0, believed.position_std_m, 3
        )
        if step == 0 or rng.random() >= loss:
            stamp_ns = begun_ns + CAPTURED_NS + late_ns
            waiting = [sample(observed, stamp_ns, stamp_ns + ARRIVED_NS, step, believed.position_std_m)]
        f, _, g = kalman.propagation.over(dt_ns)
        state = (f @ z + g @ acting)[: kalman.n_x]
    return FlightData.from_records(items)


def sample(position: Array, captured_ns: int, received_ns: int, seq: int, std_m: float) -> PositionSample:
    north, east, down = position.tolist()
    return PositionSample(
        captured_ns=captured_ns,
        received_ns=received_ns,
        position_m=(north, east, down),
        std_m=std_m,
        source="camera",
        seq=seq,
    )


def decision(tick: int, at_ns: int, step: int, u: Array, age: int, *, boundary: bool) -> Decision:
    return Decision(
        tick=tick,
        at_ns=at_ns,
        step=step,
        boundary=boundary,
        mode=ControlMode.TRACK,
        age_steps=age,
        news=age == 0 and boundary,
        plan_seq=None,
        plan_index=None,
        solve=None,
        input=tuple(u.tolist()),
        fresh=1,
        missed_ticks=0,
        accepted=0,
        rejected=0,
        reason="made up",
    )
