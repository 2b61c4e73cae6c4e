"""Risk in flight: preset `room` beside a wall over a link in bursts; counts, level and spread are recorded."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flight_rig import MS, START_NS, run, sample, vehicle

from uavctl.config.load import dump_config, load_config, parse_recorded
from uavctl.config.types import Config
from uavctl.event_codes import EventCode
from uavctl.flight.context import locate_on_grid
from uavctl.flight.risk import report_saturation
from uavctl.flight.risk_state import RiskGroup
from uavctl.flight.state import ControlState
from uavctl.flight.tick import TickOutput, make_initial_state
from uavctl.flight.tick import tick as run_tick
from uavctl.records import Plan, RiskRecord, StepInput, Vec3
from uavctl.smpc.answer import Preview, QuestionError
from uavctl.smpc.conditioned.adaptation import MAX_WIDENING, AgeRecord, LoopState, charge_risk, count_age
from uavctl.smpc.conditioned.reference import CERTIFICATE_LEVEL, get_link
from uavctl.wiring.controller import build_conditioned, build_controller

STEPS = 300
WALL_M = 3.0


def load_room(*overrides: str) -> Config:
    return load_config("room", ["target.position_m=[2.9, 0, -1.2]", "risk.budgets=observed", *overrides])


def fly(
    config: Config,
    seed: int,
    ground_ticks: int = 0,
    loss: tuple[float, float] = (0.1, 0.8),
    silent: range = range(0),
    begins_m: Vec3 = (2.4, 0.0, -1.2),
    steps: int = STEPS,
    period: int = 1,
) -> tuple[list[StepInput], list[TickOutput]]:
    """Fly from 0.5 m beside the target, or from another place, with runs of five lost positions in the mean.

    Args:
        ground_ticks: Ticks before the flight, with the same link.
        loss: Probability that a position is lost after one that came, and after one that was lost.
        silent: Ticks without any position.
        period: Ticks from one position of the camera to the next.
    """
    controller, rng = build_controller(config), np.random.default_rng(seed)
    plant, state, inputs, outputs = controller.plant, make_initial_state(), [], []
    x, is_bad = plant.equilibrium(begins_m), False
    waiting = []
    for tick in range(ground_ticks + steps):
        at_ns = START_NS + tick * controller.tick_ns
        is_bad = bool(rng.random() < loss[is_bad])
        if not is_bad and tick not in silent and tick % period == 0:
            position = x[list(plant.position_index)] + rng.normal(scale=0.003, size=3)
            waiting.append(sample(at_ns + MS, at_ns + 40 * MS, tuple(position.tolist())))
        arrived = tuple(one for one in waiting if one.received_ns <= at_ns)
        waiting = [one for one in waiting if one.received_ns > at_ns]
        inputs.append(StepInput(tick=tick, at_ns=at_ns, samples=arrived, vehicle=vehicle(armed=tick >= ground_ticks)))
        state, output = run_tick(state, inputs[-1], controller)
        outputs.append(output)
        if tick < ground_ticks:
            continue
        u = np.zeros(plant.n_u) if output.setpoint is None else plant.to_input(output.setpoint.accel_mps2)
        w = rng.multivariate_normal(np.zeros(plant.n_w), plant.w)
        x = plant.a @ x + plant.b @ u + plant.e @ w
    return inputs, outputs


def list_risks(outputs: list[TickOutput]) -> list[RiskRecord]:
    return [output.link.risk for output in outputs if output.link is not None and output.link.risk is not None]


@pytest.fixture(scope="module")
def flight() -> tuple[list[StepInput], list[TickOutput]]:
    return fly(load_room(), 1)


def test_a_replay_decides_the_same_with_the_same_risk(flight: tuple[list[StepInput], list[TickOutput]]) -> None:
    inputs, outputs = flight
    assert run(build_controller(load_room()), inputs) == outputs
    assert len(list_risks(outputs)) > 0.9 * STEPS


def test_a_slow_camera_shows_the_spread_too() -> None:
    _, outputs = fly(load_room(), 4, loss=(0.0, 0.0), period=4)
    assert 0.5 < list_risks(outputs)[-1].spread < 1.0


def test_level_and_spread_follow_from_the_recorded_counts_alone(
    flight: tuple[list[StepInput], list[TickOutput]],
) -> None:
    controller = build_controller(load_room())
    parameters, horizon = controller.risk, controller.horizon
    assert parameters is not None
    ages, loop = AgeRecord(), LoopState()
    plans: dict[str, float] = {}
    for output in flight[1]:
        risk = None if output.link is None else output.link.risk
        if risk is not None:
            keeps_away = plans.get("flown", 0.0) > 0.0
            assert risk.outside is not None
            ages = count_age(ages, risk.age, parameters.shares)
            loop = charge_risk(
                loop, risk.outside, parameters.allowed, keeps_away=keeps_away, is_behind_horizon=risk.age > horizon
            )
            assert risk.level == ages.level
            assert (risk.widening, risk.silence_widening) == (loop.widening, loop.silence_widening)
        if output.plan is not None:
            plans["flown"] = output.plan.offset
    assert ages.steps > 0.9 * STEPS


def test_bursts_are_observed(flight: tuple[list[StepInput], list[TickOutput]]) -> None:
    """Runs of five lost positions in the mean, one position a step: ρ = 0.8."""
    continuations = [get_link(risk.level)[1] for risk in list_risks(flight[1])[100:]]
    assert 0.75 <= float(np.median(continuations)) <= 0.92


@pytest.mark.slow
def test_the_certificate_keeps_further_from_the_wall_in_silence_than_the_configured_link() -> None:
    """The oldest stages of the plans have no back-off where the configured link calls their ages rare."""

    def mean_distance_m(*overrides: str) -> float:
        _, outputs = fly(load_room("risk.adapt=false", *overrides), 2)
        return float(np.mean([WALL_M - output.plan.states[-1][0] for output in outputs if output.plan is not None]))

    assert mean_distance_m("risk.budgets=certificate") > 1.2 * mean_distance_m("risk.budgets=configured")


INDEPENDENT = (0.3, 0.3)  # the configured link


def test_the_ages_before_the_flight_count() -> None:
    config, ticks = load_room(), 900
    controller = build_controller(config)
    assert controller.risk is not None
    inputs, outputs = fly(config, 3, ticks, INDEPENDENT, steps=20)
    risks = list_risks(outputs)
    waited = [risk for risk in risks if risk.outside is None]
    record = AgeRecord()
    for risk in waited:
        record = count_age(record, risk.age, controller.risk.shares)
        assert (risk.level, risk.widening) == (record.level, 1.0)
    assert record.level > CERTIFICATE_LEVEL
    assert risks[len(waited)].level == record.level
    assert run(build_controller(config), inputs) == outputs
    # The first two seconds, and the first position, are not counted.
    assert ticks - len(waited) == pytest.approx(2.0 / controller.plant.dt_s, abs=3)


def test_a_source_that_is_off_before_the_flight_says_nothing_of_the_link() -> None:
    config, off = load_room(), range(600, 800)
    horizon = build_controller(config).horizon
    _, outputs = fly(config, 3, 900, INDEPENDENT, off, steps=1)
    waited = [risk for risk in list_risks(outputs) if risk.outside is None]
    assert max(risk.age for risk in waited) == horizon
    _, continuation = get_link(waited[-1].level)
    assert continuation < 0.5


def test_while_one_axis_leads_beside_a_wall_the_other_one_is_not_moved_by_the_budgets() -> None:
    """Else a frame whose axes are swapped shows nothing: both axes accelerate alike, along the diagonal."""
    lead_s, no_loss = 0.3, (0.0, 0.0)

    def list_plans(*overrides: str) -> list[Plan]:
        config = load_room("target.position_m=[1.0, 1.0, -1.2]", f"envelope.lead_s={lead_s}", *overrides)
        _, outputs = fly(config, 5, loss=no_loss, begins_m=(-1.9, -2.4, -1.2), steps=20)
        return [output.plan for output in outputs if output.plan is not None]

    def list_first_inputs(plans: list[Plan]) -> list[list[float]]:
        ends_ns = plans[0].base_ns + round(lead_s * 1e9)
        return [plan.inputs[0].tolist() for plan in plans if plan.base_ns < ends_ns]

    led = list_first_inputs(list_plans())
    assert len(led) == 6
    assert led == list_first_inputs(list_plans("risk.budgets=configured"))
    assert all(abs(east) < 0.2 * north for north, east, _ in led[1:])


def test_by_default_the_budgets_follow_the_link_and_in_recordings_of_before_they_do_not() -> None:
    assert load_config("room").risk == load_room().risk
    assert build_controller(load_config("room-hahn-stursberg")).risk is None
    keys = ("adapt =", "budgets =")
    text = "\n".join(line for line in dump_config(load_config("room")).splitlines() if not line.startswith(keys))
    config = parse_recorded(text, "recording").config
    design = build_conditioned(config)
    assert build_controller(config, design).risk is None
    with pytest.raises(QuestionError):
        design.solver.select_risk(design.target, Preview(level=CERTIFICATE_LEVEL))


def test_saturation_is_an_event_when_it_begins() -> None:
    controller = build_controller(load_room())
    given = StepInput(tick=0, at_ns=START_NS, samples=(), vehicle=vehicle())
    context = locate_on_grid(ControlState(), given, controller, is_climbing_or_landing=False)
    below, at = RiskGroup(), RiskGroup(loop=LoopState(math.log(MAX_WIDENING)))
    assert [event.code for event in report_saturation(below, at, context)] == [EventCode.RISK_SATURATED]
    assert not report_saturation(at, at, context)
    assert not report_saturation(at, below, context)
