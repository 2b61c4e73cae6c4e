"""The control tick with the exact solver around a simulated plant: preset `room` over a bad link."""

from __future__ import annotations

import numpy as np
from flight_rig import MS, START_NS, run, sample, vehicle
from numpy.typing import NDArray

from uavctl.config import load_config
from uavctl.flight.tick import TickOutput, make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.records import ControlMode, SolveStatus, StepInput
from uavctl.wiring.controller import build_controller


def fly(seconds: float, seed: int) -> tuple[list[StepInput], list[TickOutput], NDArray[np.float64]]:
    """A camera sample a Δt with noise, 30 % loss, 30 to 70 ms of delay; truth (steps + 1, n_x) at the boundaries."""
    config = load_config("room-hahn-stursberg")
    controller = build_controller(config)
    plant = controller.plant
    rng = np.random.default_rng(seed)
    a, b, e = plant.transition(controller.tick_ns * 1e-9)
    x = plant.equilibrium(config.sim.start_position_m)
    state = make_initial_state()
    waiting, inputs, outputs, truth = [], [], [], []
    w = np.zeros(plant.n_w)
    for tick in range(round(seconds * 1e9) // controller.tick_ns):
        at_ns = START_NS + tick * controller.tick_ns
        into = tick % controller.ticks_per_step
        if into == 0:
            truth.append(x)
            w = rng.multivariate_normal(np.zeros(plant.n_w), plant.w)
        if into == 2 and rng.random() > config.link.loss:
            north, east, down = x[list(plant.position_index)] + rng.normal(scale=0.003, size=3)
            waiting.append(sample(at_ns, at_ns + int(rng.integers(30, 70)) * MS, (north, east, down)))
        arrived = tuple(one for one in waiting if one.received_ns <= at_ns)
        waiting = [one for one in waiting if one.received_ns > at_ns]
        inputs.append(StepInput(tick=tick, at_ns=at_ns, samples=arrived, vehicle=vehicle()))
        state, output = run_tick(state, inputs[-1], controller)
        outputs.append(output)
        u = np.zeros(plant.n_u) if output.setpoint is None else plant.to_input(output.setpoint.accel_mps2)
        x = a @ x + b @ u + e @ w
    return inputs, outputs, np.array(truth)


def test_room_reaches_the_target_within_its_limits_over_a_link_with_losses_and_delay() -> None:
    inputs, outputs, truth = fly(seconds=14.0, seed=4)
    config = load_config("room-hahn-stursberg")
    assert np.linalg.norm(truth[-20:, [0, 3, 6]] - config.target.position_m, axis=1).max() < 0.35
    assert (truth >= np.array(config.sets.state_lower)).all()
    assert (truth <= np.array(config.sets.state_upper)).all()
    decisions = [output.decision for output in outputs]
    begun = next(tick for tick, decision in enumerate(decisions) if decision.mode is not ControlMode.WAIT)
    assert {decision.mode for decision in decisions[begun:]} == {ControlMode.TRACK}
    assert {decision.solve for decision in decisions} == {None, SolveStatus.OPTIMAL}
    assert max(decision.plan_index or 0 for decision in decisions) >= 2  # the link did fail on the way
    assert sum(output.plan.slack for output in outputs if output.plan is not None) < 1e-6
    for output in outputs:
        if output.estimate is not None and output.decision.boundary:
            error = np.array(output.estimate.mean) - truth[output.decision.step]
            spread = np.sqrt(np.diag(np.array(output.estimate.cov)))
            assert (np.abs(error) < 6.0 * spread + 1e-9).all()
    again = run(build_controller(config), inputs)
    assert again == outputs
