"""The stuck detector: a frozen value with fresh stamps counts as lost; rest, rounding and a still world do not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from flight_rig import (
    DT_NS,
    HORIZON,
    MS,
    START_NS,
    TICK_NS,
    StubSolver,
    list_codes,
    list_modes,
    make_controller,
    sample,
    small_plant,
    vehicle,
)

from uavctl.arrays import Array
from uavctl.flight.monitors.outliers import GateParameters
from uavctl.flight.tick import TickOutput, make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.records import ControlMode, StepInput, Vec3, VehicleStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview

Camera = Callable[[int, Vec3], Vec3]  # tick, truth -> what it says

TRACK = ControlMode.TRACK
STEPS, TICKS = 60, DT_NS // TICK_NS
PARAMETERS = GateParameters(sigma=6.0, margin_m=0.1, jump_ns=500 * MS)


class Steering(StubSolver):
    """Flies to the target by a gain, or back and forth, or does nothing."""

    def __init__(self, want: Callable[[int], float], gain: float = 0.8) -> None:
        super().__init__(small_plant(), HORIZON)
        self.want, self.gain = want, gain

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        answer = super().solve(seq, x, target, preview)
        u = float(np.clip(self.gain * (self.want(seq) - x[0]) - 1.2 * x[1] - 0.3 * x[2], -1.5, 1.5))
        return msgspec.structs.replace(answer, inputs=np.full_like(answer.inputs, u))


def fly(
    camera: Camera,
    *,
    want: Callable[[int], float] = lambda seq: 0.0,
    gust: float = 0.15,
    every: int = 1,
    steps: int = STEPS,
    status: VehicleStatus | None = None,
    seed: int = 14,
) -> list[TickOutput]:
    """Ticks around a plant with disturbances; a sample each `every` ticks, as the camera says it."""
    rng = np.random.default_rng(seed)
    solver = Steering(want)
    controller = replace(make_controller(solver, land=False), position_gate=PARAMETERS)
    plant = controller.plant
    a, b, e = plant.transition(TICK_NS * 1e-9)
    x, w, state, outputs = np.zeros(3), np.zeros(1), make_initial_state(), []
    for tick in range(steps * TICKS):
        at_ns = START_NS + tick * TICK_NS
        if tick % TICKS == 0:
            w = rng.normal(scale=gust, size=1)
        # The axes that the plant has not sway by a centimetre, if there are gusts.
        truth = (float(x[0]), 0.5 + 0.07 * gust * math.sin(0.11 * tick), -1.0 + 0.07 * gust * math.cos(0.08 * tick))
        samples = () if tick % every else (sample(at_ns, position_m=camera(tick, truth)),)
        inp = StepInput(tick=tick, at_ns=at_ns, samples=samples, vehicle=status or vehicle())
        state, output = run_tick(state, inp, controller)
        outputs.append(output)
        u = np.zeros(1) if output.setpoint is None or status else plant.to_input(output.setpoint.accel_mps2)
        x = a @ x + b @ u + e @ w
    return outputs


def frozen(outputs: list[TickOutput]) -> list[int]:
    return [tick for tick, one in enumerate(outputs) if "sample-frozen" in list_codes(one)]


def each(change: Callable[[float], float], truth: Vec3) -> Vec3:
    north, east, down = truth
    return change(north), change(east), change(down)


def noisy(seed: int = 3, std_m: float = 0.003) -> Camera:
    rng = np.random.default_rng(seed)
    return lambda tick, truth: each(lambda value: value + float(rng.normal(scale=std_m)), truth)


def rounded(camera: Camera, to_m: float) -> Camera:
    return lambda tick, truth: each(lambda value: round(value / to_m) * to_m, camera(tick, truth))


def exact(tick: int, truth: Vec3) -> Vec3:
    return truth


def freezing(camera: Camera, ticks: range) -> Camera:
    held: list[Vec3] = []

    def say(tick: int, truth: Vec3) -> Vec3:
        if tick not in ticks:
            return camera(tick, truth)
        if tick == ticks[0]:
            held.append(camera(tick, truth))
        return held[0]

    return say


def there_and_back(seq: int) -> float:
    return 1.5 if seq % 20 < 10 else -1.5


@pytest.mark.fault(14)
@pytest.mark.parametrize("every", [1, 4])
def test_row_14_a_noisy_source_that_freezes_in_hover_counts_as_lost_at_the_third_repeat(every: int) -> None:
    freezes, ends = 160, 200
    outputs = fly(freezing(noisy(), range(freezes, ends)), every=every)
    assert frozen(outputs) == list(range(freezes + 3 * every, ends, every))
    assert all(one.decision.accepted == 0 for one in outputs[freezes + 3 * every : ends])
    ages = [one.decision.age_steps for one in outputs]
    assert max(age or 0 for age in ages[:freezes]) <= 1
    if every == 1:  # 8 steps: the age reaches H, and positions come back
        assert max(age or 0 for age in ages) >= HORIZON
        assert set(list_modes(outputs)[:freezes]) == {TRACK}
        assert ControlMode.HOLD in list_modes(outputs)[freezes:] or ControlMode.BRAKE in list_modes(outputs)[freezes:]
        assert list_modes(outputs)[-1] is TRACK


@pytest.mark.fault(14)
@pytest.mark.parametrize("camera", [exact, rounded(exact, 0.01), rounded(exact, 0.001)])
def test_row_14_a_value_that_stands_still_while_the_plan_moves_counts_as_lost(camera: Camera) -> None:
    freezes = 90  # 2 s before it has to be found
    still = fly(camera, want=there_and_back, gust=0.0)
    assert frozen(still) == []
    assert set(list_modes(still)) == {TRACK}
    outputs = fly(freezing(camera, range(freezes, 9999)), want=there_and_back, gust=0.0)
    assert freezes < frozen(outputs)[0] <= freezes + 40
    assert TRACK not in list_modes(outputs)[freezes + 40 + (HORIZON + 1) * TICKS :]


@pytest.mark.fault(14)
@pytest.mark.parametrize("to_m", [0.001, 0.01])
def test_row_14_rounding_cameras_that_freeze_are_found_once_gusts_must_have_moved_the_vehicle(to_m: float) -> None:
    camera = rounded(noisy(std_m=to_m), to_m)
    assert frozen(fly(camera)) == []
    outputs = fly(freezing(camera, range(80, 9999)))
    assert 80 < frozen(outputs)[0] <= 80 + 4 * 20  # 4 s


@pytest.mark.long
@pytest.mark.fault(14)
@pytest.mark.parametrize("to_m", [1e-6, 0.001, 0.01])
@pytest.mark.parametrize("seed", range(3))
def test_row_14_cameras_that_round_and_a_gusty_hover_raise_no_alarm(to_m: float, seed: int) -> None:
    for std_m in (0.0, to_m / 10, to_m):
        outputs = fly(rounded(noisy(seed, std_m), to_m), seed=seed, steps=100)
        assert frozen(outputs) == []
        assert set(list_modes(outputs)) == {TRACK}


@pytest.mark.fault(14)
def test_row_14_a_world_without_noise_may_come_to_rest() -> None:
    # It flies to 0.5 m and stays there: in the end the same value comes again and again, to the last bit.
    outputs = fly(rounded(exact, 2.0**-24), want=lambda seq: 0.5, gust=0.0, steps=300)
    values = [one.estimate.mean[0] for one in outputs if one.estimate is not None]
    assert abs(values[-1] - 0.5) < 0.1
    assert frozen(outputs) == []


@pytest.mark.fault(14)
@pytest.mark.parametrize(
    "status", [vehicle(armed=False), msgspec.structs.replace(vehicle(external=False), landed=True)]
)
def test_row_14_a_vehicle_on_the_ground_may_stand_still(status: VehicleStatus) -> None:
    camera = noisy()
    outputs = fly(lambda tick, truth: (0.0, 0.0, 0.0) if tick > 40 else camera(tick, truth), status=status)
    assert frozen(outputs) == []
    assert outputs[-1].decision.age_steps == 0


@pytest.mark.fault(14)
def test_row_14_a_source_that_sends_each_value_twice_is_not_stuck() -> None:
    camera, said = noisy(), [(0.0, 0.0, 0.0)]

    def twice(tick: int, truth: Vec3) -> Vec3:
        if tick % 2 == 0:
            said[0] = camera(tick, truth)
        return said[0]

    assert frozen(fly(twice)) == []
