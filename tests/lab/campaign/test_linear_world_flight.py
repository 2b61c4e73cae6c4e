"""What a campaign flies in its linear world is what the flight core flies through MAVLink and the simulator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import heappush

import numpy as np
import pytest
from loopback_rig import MemorySink, make_loop
from msgspec.structs import replace

from sim import simulation
from sim.channel import Channel
from sim.simulation import World
from sim.vehicle.linear import LinearVehicle
from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.config.connections import ClockConfig
from uavctl.config.link import LinkConfig
from uavctl.lab.campaign.arrivals import compute_newest_captures
from uavctl.lab.campaign.draws import draw
from uavctl.lab.campaign.world import LinearWorld, Trajectories, simulate
from uavctl.records import Decision, Truth
from uavctl.smpc.batch import BatchSmpc, Counts
from uavctl.smpc.hahn_stursberg.shortcut import ShortcutDecider, ShortcutSolver
from uavctl.wiring.controller import build_design, build_plant

STEPS, DT_NS = 50, 1_000_000_000
NEVER = 1e6  # [s], [m], [m/s]
BASE = load_config("paper")
DESIGN = build_design(BASE)
LOSSES = LinkConfig(loss=0.3)
LATE = LinkConfig(loss=0.1, delay_s=0.5, jitter_s=1.6)
BURSTS = LinkConfig(model="gilbert-elliott", loss=0.1, burst_enter=0.1, burst_leave=0.05, burst_loss=1.0)


@dataclass(frozen=True, eq=False)
class Run:
    """One run of preset `paper` in the linear world, with all that it met."""

    start: Array  # x(0) (n_x,)
    newest: Counts  # capture step of the newest position known in each step (T,)
    disturbances: Array  # w (T, n_w)
    flown: Trajectories  # N = 1


def in_the_linear_world(link: LinkConfig, number: int) -> Run:
    plant = build_plant(BASE)
    chances = draw(5, number, 1, STEPS, plant.n_w)
    known = compute_newest_captures(link, plant.dt_s, chances.link)
    w = chances.normal @ np.linalg.cholesky(plant.w).T
    start = np.array([33.5, -2.25, -18.0, 1.5])
    scene = LinearWorld(
        plant, DESIGN.state_set, DESIGN.input_set, DESIGN.q_x, DESIGN.q_u, DESIGN.target, np.zeros(2), start[None]
    )
    decider = ShortcutDecider(ShortcutSolver(DESIGN), DESIGN.target)
    controller = BatchSmpc(decider, plant, DESIGN.horizon, len(DESIGN.late), 0.5)
    return Run(start, known[0], w[0], simulate(scene, controller, known, w))


def delays_ns(known: Counts) -> Iterator[int | None]:
    """Delay of each position [ns], None for those that were never the newest: lost, or overtaken and of no use."""
    captured, first = np.unique(known, return_index=True)
    arrives = dict(zip(captured.tolist(), first.tolist(), strict=True))
    return iter([(arrives[step] - step) * DT_NS if step in arrives else None for step in range(known.size)])


class GivenDisturbances(LinearVehicle):
    """The simulated vehicle under the disturbances of a run."""

    def __init__(self, run: Run, config: Config, seed: np.random.SeedSequence, start_ns: int) -> None:
        self._given = iter(run.disturbances)
        super().__init__(config, seed, start_ns)

    def _draw(self) -> Array:
        return next(self._given, np.zeros(2))


class GivenDelays(Channel):
    """The radio channel with the losses and delays of a run."""

    def __init__(self, run: Run, link: LinkConfig, seed: np.random.SeedSequence, start_ns: int, step_ns: int) -> None:
        super().__init__(link, seed, start_ns, step_ns)
        self._given = delays_ns(run.newest)

    def push(self, at_ns: int, data: bytes, *, is_certain: bool = False) -> None:
        delay_ns = next(self._given, None)
        self.counters.sent += 1
        if delay_ns is None:
            self.counters.lost += 1
            return
        heappush(self._pending, (at_ns + delay_ns, at_ns + delay_ns, self.counters.sent, data))


def as_flown(start: Array) -> Config:
    """The preset with what the linear world has in place of cameras, filter and gate.

    One exact position a step that shows the velocity too; no limit of a setpoint but that of the inputs; plans are
    flown again as soon as there is one. Nothing that the design depends on is changed.
    """
    estimator, fallback, sim = BASE.estimator, BASE.fallback, BASE.sim
    return replace(
        BASE,
        duration_s=float(STEPS),
        clock=ClockConfig(window_s=STEPS + 1.0),  # the first position is never late and sets the clock
        estimator=replace(
            estimator,
            position_std_m=1e-5,
            velocity_std_mps=1e-5,
            initial_std=1e-6,
            window_s=max(estimator.window_s, 2.0 * DESIGN.horizon),
            max_position_m=NEVER,
            max_velocity_mps=NEVER,
        ),
        fallback=replace(fallback, brake_s=NEVER, hold_s=NEVER, blind_hold_s=NEVER, land=False, recover_samples=1),
        envelope=replace(BASE.envelope, lead_s=0.0),
        limits=replace(BASE.limits, accel_mps2=(100.0, 100.0, 100.0), slew_mps3=NEVER),
        sim=replace(
            sim,
            start_position_m=(start[0], start[2], 0.0),
            start_velocity_mps=(start[1], start[3], 0.0),
            camera=replace(
                sim.camera,
                rate_hz=1.0,
                phase_s=0.0,
                noise_std_m=0.0,
                latency_s=0.0,
                clock_offset_s=0.0,
                message="odometry",
            ),
        ),
    )


def in_lockstep(run: Run) -> MemorySink:
    """The same run by controller, MAVLink and simulated autopilot."""
    config, memory = as_flown(run.start), MemorySink()
    assert build_design(config).design_id == DESIGN.design_id
    loop = make_loop(config, memory, DESIGN)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "LinearVehicle", lambda *arguments: GivenDisturbances(run, *arguments))
        patch.setattr(simulation, "Channel", lambda *arguments: GivenDelays(run, *arguments))
        world = World(config, loop, lambda truth: memory.put("/sim/truth", truth.at_ns, truth))
    world.run(config.duration_s)
    world.peers.advance(STEPS * DT_NS)
    world.peers.flush()
    return memory


def largest_difference(run: Run, truths: list[Truth], steps: int = STEPS) -> float:
    """Of a state or an input, over the first steps."""
    states = np.array([truth.state for truth in truths[: steps + 1]]) - run.flown.states[0, : steps + 1]
    inputs = np.array([truth.input for truth in truths[:steps]]) - run.flown.inputs[0, :steps]
    return float(max(np.abs(states).max(), np.abs(inputs).max()))


# A position of 33 m is within 2e-6 m as float32 and the feedback multiplies that by less than 10.
SAME = 2e-5


@pytest.mark.slow
@pytest.mark.parametrize("link", [LOSSES, LATE], ids=["lost", "late"])
def test_a_flight_equals_the_run_within_float32(link: LinkConfig) -> None:
    run = in_the_linear_world(link, 3)
    memory = in_lockstep(run)
    truths = memory.of(Truth)
    assert len(truths) == STEPS + 1
    assert largest_difference(run, truths) < SAME
    ages = [decision.age_steps for decision in memory.of(Decision) if decision.boundary]
    assert ages == run.flown.age[0].tolist()
    assert largest_difference(in_the_linear_world(link, 4), truths) > 1.0  # another run is another flight


@pytest.mark.slow
def test_flight_and_run_are_equal_until_the_plan_ends() -> None:
    """Then the flight core brakes tick by tick, and the linear world step by step."""
    run = in_the_linear_world(BURSTS, 6)
    (without,) = np.nonzero(run.flown.age[0] >= DESIGN.horizon)
    assert 0 < without[0] < STEPS
    assert largest_difference(run, in_lockstep(run).of(Truth), int(without[0])) < SAME


def test_positions_are_delayed_or_lost_as_in_the_run() -> None:
    known = np.array([0, 0, 0, 1, 4, 4, 5])  # 1 is two steps late, 4 and 0 are not, 5 is one; 2, 3, 6 are lost
    expected = [0, 2, None, None, 0, 1, None]
    assert list(delays_ns(known)) == [None if steps is None else steps * DT_NS for steps in expected]
