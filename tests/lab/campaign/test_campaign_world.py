"""The linear world: links against the theory's chains and the simulator's channel, flights against a plain loop."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sim.channel import Channel
from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.errors import ControllerError
from uavctl.lab.campaign.arrivals import compute_newest_captures
from uavctl.lab.campaign.draws import draw
from uavctl.lab.campaign.world import LinearWorld, simulate
from uavctl.smpc.batch import BatchSmpc, Decisions, Information, predict
from uavctl.smpc.plant import Plant
from uavctl.smpc.sets import Polytope
from uavctl.wiring.controller import build_design, build_plant
from uavctl.wiring.link import build_delayed_link

RUNS, STEPS = 20_000, 12

LINKS = {
    "independent": ["link.loss=0.3"],
    "p(k)": ["link.probability=[1.0, 0.9, 0.2, 0.5, 0.7]"],
    "bursts": [
        'link.model="gilbert-elliott"', "link.loss=0.1", "link.burst_enter=0.2", "link.burst_leave=0.4",
        "link.burst_loss=0.9",
    ],
    "runs as measured": ['link.model="empirical"', "link.gaps=[0.6, 0.25, 0.05, 0.1]"],
    "late": ["link.loss=0.1", "link.delay_s=0.5", "link.jitter_s=2.0", "schedule.late=3"],
    "shorter than a step": ["link.loss=0.3", "link.delay_s=0.3", "link.jitter_s=0.4"],
}  # fmt: skip


def config(*overrides: str) -> Config:
    return load_config("paper", overrides)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "base"),
    [("independent", 0), ("late", 0), ("shorter than a step", 0), ("bursts", 30), ("runs as measured", 30)],
)
def test_the_age_is_distributed_as_the_theory_says(name: str, base: int) -> None:
    """From a position that came by itself: after a while, where the channel remembers how it began."""
    configured = config(*LINKS[name])
    captures = compute_newest_captures(configured.link, 1.0, draw(3, 0, RUNS, base + STEPS, 1).link)
    captures = captures[captures[:, base] == base][:, base:] - base
    age = np.arange(STEPS) - captures
    expected = build_delayed_link(configured).age(STEPS - 1)
    assert len(age) > 0.3 * RUNS
    for t in range(STEPS):
        measured = np.bincount(age[:, t], minlength=STEPS)[:STEPS] / len(age)
        # Five standard deviations of a binomial share: 144 of them may not fail by chance.
        assert np.abs(measured - expected[t]).max() < 5.0 * 0.5 / np.sqrt(len(age)), t


@pytest.mark.slow
def test_probabilities_of_each_step_lose_that_share() -> None:
    configured = config(*LINKS["p(k)"])
    captures = compute_newest_captures(configured.link, 1.0, draw(3, 0, RUNS, STEPS, 1).link)
    for k in range(1, STEPS):
        share = float((captures[:, k] == k).mean())
        assert share == pytest.approx(configured.link.probability[min(k, 4)], abs=5.0 * 0.5 / np.sqrt(RUNS))


@pytest.mark.parametrize("name", ["independent", "bursts", "runs as measured"])
def test_losses_are_the_channel_s_for_the_same_draws(name: str) -> None:
    """The simulator's own channel, fed the same uniform numbers, loses the same packets."""
    link = config(*LINKS[name]).link
    chances = draw(5, 0, 40, 30, 1).link
    captures = compute_newest_captures(link, 1.0, chances)
    for run in range(len(chances)):
        channel = Channel(link, np.random.SeedSequence(0), 0, 1_000_000_000)
        channel._loss = _Fed(chances[run, :, :2])  # type: ignore[assignment]
        known = 0
        for k in range(30):
            channel.push(k * 1_000_000_000, b"x", is_certain=k == 0)
            known = k if channel.pop_due(k * 1_000_000_000) else known
            assert captures[run, k] == known, (run, k)


class _Fed:
    """A generator that gives the rows of a table."""

    def __init__(self, rows: Array) -> None:
        self._rows = iter(rows)

    def random(self, size: int) -> Array:
        row: Array = next(self._rows)
        assert row.size == size
        return row


def test_a_blackout_loses_all() -> None:
    captures = compute_newest_captures(
        config("link.blackout=[[3, 6]]", "link.loss=0.0").link, 1.0, draw(0, 0, 2, 10, 1).link
    )
    assert captures.tolist() == [[0, 1, 2, 2, 2, 2, 2, 7, 8, 9]] * 2


def test_a_run_s_draws_depend_on_master_and_index_alone() -> None:
    several, one, longer = draw(7, 10, 5, 20, 2), draw(7, 13, 1, 20, 2), draw(7, 13, 1, 30, 2)
    assert np.array_equal(several.normal[3], one.normal[0])
    assert np.array_equal(several.link[3], one.link[0])
    assert np.array_equal(longer.normal[0, :20], one.normal[0])
    assert np.array_equal(longer.link[0, :21], one.link[0])
    assert not np.array_equal(draw(8, 13, 1, 20, 2).normal, one.normal)
    assert not np.array_equal(several.normal[3], several.normal[2])


class _Linear:
    """u = K x̂, on the prediction; one run answers with what is no number."""

    def __init__(self, plant: Plant, gain: Array, bad: int = -1) -> None:
        self._plant, self._gain, self._bad = plant, gain, bad

    def begin(self, runs: int) -> None:
        self.runs = runs

    def act(self, measurement: Information) -> Array:
        requested_input = predict(self._plant, measurement) @ self._gain.T
        if measurement.step == 3 and self._bad >= 0:
            requested_input[self._bad] = np.nan
        return requested_input


def scene(plant: Plant, runs: int) -> LinearWorld:
    n_x, n_u = plant.n_x, plant.n_u
    return LinearWorld(
        plant=plant,
        state_set=Polytope.from_box([-3.0] * n_x, [3.0] * n_x),
        input_set=Polytope.from_box([-0.5] * n_u, [0.4] * n_u),
        q_x=np.diag(np.arange(1.0, n_x + 1)),
        q_u=2.0 * np.eye(n_u),
        target=np.full(n_x, 0.1),
        u_target=np.full(n_u, 0.05),
        start=np.linspace(-1.0, 1.0, runs)[:, None] * np.ones(n_x),
    )


def test_the_simulation_equals_a_plain_loop() -> None:
    plant = build_plant(config())
    gain = np.array([[-0.2, -0.8, 0.0, 0.0], [0.0, 0.0, -0.3, -0.9]])
    runs, steps = 6, 15
    chances = draw(1, 0, runs, steps, plant.n_w)
    known = compute_newest_captures(config("link.loss=0.6").link, 1.0, chances.link)
    configured = scene(plant, runs)
    flown = simulate(configured, _Linear(plant, gain), known, chances.normal)
    for i in range(runs):
        x, states = configured.start[i], [configured.start[i]]
        past: list[Array] = []
        for k in range(steps):
            known_state = states[known[i, k]]
            for u in past[known[i, k] :]:
                known_state = plant.a @ known_state + plant.b @ u
            requested_input = gain @ known_state
            u = np.minimum(np.maximum(requested_input, -0.5), 0.4)
            dx, du = x - configured.target, u - configured.u_target
            assert flown.cost[i, k] == pytest.approx(dx @ configured.q_x @ dx + du @ configured.q_u @ du)
            assert flown.input_violated[i, k] == (requested_input.max() > 0.4 or requested_input.min() < -0.5)
            assert flown.age[i, k] == k - known[i, k]
            past.append(u)
            x = plant.a @ x + plant.b @ u + plant.e @ chances.normal[i, k]
            assert flown.state_violated[i, k] == (np.abs(x).max() > 3.0)
            states.append(x)
        assert flown.states[i] == pytest.approx(np.array(states), abs=1e-12)
        assert flown.inputs[i] == pytest.approx(np.array(past), abs=1e-12)
    assert flown.input_violated.any()
    assert flown.state_violated.any()
    assert not flown.state_violated.all()
    assert not flown.failed.any()


def test_a_run_with_an_invalid_input_fails_alone() -> None:
    plant = build_plant(config())
    gain = np.zeros((2, 4))
    chances = draw(1, 0, 3, 8, plant.n_w)
    known = compute_newest_captures(config().link, 1.0, chances.link)
    good = simulate(scene(plant, 3), _Linear(plant, gain), known, chances.normal)
    bad = simulate(scene(plant, 3), _Linear(plant, gain, bad=1), known, chances.normal)
    assert bad.failed.tolist() == [False, True, False]
    assert [error.endswith(":_Linear answered what is not finite in step 3") for error in bad.errors] == [
        False, True, False,
    ]  # fmt: skip
    assert np.array_equal(bad.states[[0, 2]], good.states[[0, 2]])
    assert np.isfinite(bad.states).all()


class _Answers:
    """A controller with one answer."""

    def __init__(self, answer: object) -> None:
        self._answer = answer

    def begin(self, runs: int) -> None: ...

    def act(self, information: Information) -> Any:
        return self._answer


@pytest.mark.parametrize(
    ("answer", "found"),
    [
        (np.zeros(2), "shape (2,)"),
        (np.zeros((1, 2)), "shape (1, 2)"),
        (np.zeros((3, 1)), "shape (3, 1)"),
        (np.zeros((3, 2, 1)), "shape (3, 2, 1)"),
        (0.0, "shape ()"),
        (None, "NoneType"),
        ("left", "str"),
        ([[0.0, 0.0], [0.0], [0.0, 0.0]], "list"),
    ],
)
def test_an_answer_that_is_no_input_of_every_run_is_refused(answer: object, found: str) -> None:
    plant = build_plant(config())
    with pytest.raises(ControllerError) as raised:
        simulate(scene(plant, 3), _Answers(answer), np.zeros((3, 4), dtype=np.intp), np.zeros((3, 4, plant.n_w)))
    for part in (__name__.rpartition(".")[2] + ":_Answers", found, "give (3, 2)"):
        assert part in str(raised.value)


def test_a_list_of_numbers_is_an_answer() -> None:
    plant = build_plant(config())
    flown = simulate(
        scene(plant, 2), _Answers([[0, 0.25], [0.125, 0]]), np.zeros((2, 3), dtype=np.intp), np.zeros((2, 3, plant.n_w))
    )
    assert flown.inputs[:, -1].tolist() == [[0.0, 0.25], [0.125, 0.0]]


def test_a_run_whose_state_overflows_fails_without_an_accusation() -> None:
    plant = build_plant(config())
    wild = replace(plant, a=1e300 * np.eye(plant.n_x))
    with np.errstate(over="ignore", invalid="ignore"):
        flown = simulate(
            scene(wild, 2), _Answers(np.zeros((2, 2))), np.zeros((2, 4), dtype=np.intp), np.zeros((2, 4, plant.n_w))
        )
    assert flown.failed.all()
    assert set(flown.errors) == {"ended in numbers that are not finite"}


class _Numbered:
    """Plans that say in which step they were made: first input 100 k + index; every third question has no plan."""

    def __init__(self, steps: int) -> None:
        self._steps, self.requested = steps, 0

    def decide(self, x: Array, late: int, cov: Array | None = None) -> Decisions:
        self.requested += 1
        plan = 100.0 * self.requested + np.arange(self._steps)
        inputs = np.broadcast_to(plan[None, :, None], (len(x), self._steps, 2)).copy()
        solved = np.full(len(x), self.requested % 3 != 0)
        return Decisions(solved, inputs, np.where(solved, 0.5, np.inf), np.ones(len(x)), np.full(len(x), 1e-5))


def test_plans_continue_fail_and_end() -> None:
    """News in steps 0, 1, 4, then silence: plan 1, plan 2 played to step 3, no plan in step 4, then the brake."""
    configured = config()
    design, plant = build_design(configured), build_plant(configured)
    pilot = BatchSmpc(_Numbered(design.horizon), plant, design.horizon, len(design.late), brake_gain_1ps=0.5)
    pilot.begin(1)
    known = [0, 1, 1, 1, *[4] * 14]
    state, requested_input = np.array([[1.0, 2.0, 3.0, -4.0]]), []
    for k, last in enumerate(known):
        requested_input.append(pilot.act(Information(k, np.array([last]), state, np.zeros((1, k, 2))))[0])
    # From step 4 on its position is newer than the plan's, so each step asks again until there is a plan.
    assert [u[0] for u in requested_input[:6]] == [100.0, 200.0, 201.0, 202.0, 203.0, 400.0]
    solved = 5
    assert [u[0] for u in requested_input[6:16]] == [400.0 + k - solved for k in range(6, 16)]
    # Step 16: the position is 12 = H steps old. Brake: a = -0.5 v, of the velocity predicted without inputs.
    speed = plant.a[1, 1] ** 12 * 2.0
    assert requested_input[16][0] == pytest.approx(-0.5 * speed / plant.accel_per_input[0])
    tally = pilot.tally
    assert (tally.decisions[0], tally.infeasible[0], tally.slack_used[0], tally.fallbacks[0]) == (4, 1, 3, 2)
    assert tally.largest_gap[0] == 1e-5
