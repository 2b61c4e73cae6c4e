"""Campaigns of fleets on one radio: budget, ages, paired runs, dynamic programming for two, and problems of a file."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from uavctl.arrays import SECOND_NS, Array
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.errors import ConfigError
from uavctl.lab.campaign.fleet_world import FleetRuns, LinearFleet, TaskVehicle
from uavctl.lab.campaign.fleets import make_fleet_cells, make_fleet_tasks, read_fleet_campaign, summarise_fleets
from uavctl.schedule.ages import compute_periodic_tail
from uavctl.schedule.scheduler import ScheduleName
from uavctl.wiring.radio import RadioConfig, compute_slot_ns, compute_vehicle_costs, make_link_overrides

HEAD = """
name = "small"
world = "fleet"
config = "room"
set = ["estimator.bias_drift=0", "estimator.bias_max=0"]
steps = 20
runs = 6
vehicles = [2, 3]
bytes_per_s = [900.0]
"""
REST = '[[task]]\nname = "rest"\nset = ["sim.start_position_m=[0,0,-1.2]", "target.position_m=[0,0,-1.2]"]\n'
# A message a step: the age of each vehicle is the number of steps since its last arrival.
DT_S, PROMPT = 0.05, ("link.delay_s=0", "link.jitter_s=0")
WINDS = ([0.6, 0.6, 0.3], [0.1, 0.1, 0.06])


def make_radio(schedule: ScheduleName, loss: float, *, reports: bool = True) -> RadioConfig:
    return RadioConfig(
        messages_per_s=1.0 / DT_S, rate_hz=1.0 / DT_S, schedule=schedule, loss=loss, feedback_s=DT_S if reports else 0.0
    )


def make_vehicles(radio: RadioConfig, winds: Iterable[list[float]]) -> list[TaskVehicle]:
    winds = list(winds)
    keys = ["estimator.bias_drift=0", "estimator.bias_max=0", *PROMPT]
    place = ["sim.start_position_m=[0,0,-1.2]", "target.position_m=[0,0,-1.2]"]
    overrides = [*keys, *place, *make_link_overrides(radio, len(winds))]
    return [TaskVehicle(load_config("room", [*overrides, f"plant.wind_std_mps2={wind}"])) for wind in winds]


def fly(schedule: ScheduleName, loss: float, winds: Iterable[list[float]], runs: int, steps: int = 200) -> FleetRuns:
    radio = make_radio(schedule, loss)
    return LinearFleet(make_vehicles(radio, winds), radio).fly(steps, 41, 0, runs)


def test_one_message_a_slot_and_the_ages_of_the_periodic_chain() -> None:
    loss, count, steps, runs = 0.3, 4, 200, 20
    radio = make_radio("round-robin", loss)
    flown = LinearFleet(make_vehicles(radio, [WINDS[1]] * count), radio).fly(steps, 41, 0, runs)
    slot_ns = compute_slot_ns(radio)
    assert set(flown.messages) == {float(-(-steps * round(DT_S * SECOND_NS) // slot_ns))}
    # E a = Σ_{n>0} P(a >= n), and a message that is sent at the begin of a step is known at the next one: one more
    tail = compute_periodic_tail(range(count), 0, loss, 200)
    expected_s = DT_S * (tail[1:].sum() + 1.0)
    error_s = 3.0 * flown.mean_age_s.std(ddof=1) / runs**0.5
    # Ages begin at 0: they lack at most the first 20 of 200 steps.
    assert expected_s - error_s - 0.1 * expected_s < flown.mean_age_s.mean() < expected_s + error_s


def test_equal_tasks_without_losses_cost_the_same_by_every_schedule() -> None:
    # With one longest wait the designs are equal, and so is all else.
    flown = []
    for schedule in ("round-robin", "oldest-first", "value"):
        radio = RadioConfig(messages_per_s=20.0, rate_hz=20.0, schedule=schedule, max_wait_s=0.2)
        flown.append(LinearFleet(make_vehicles(radio, [WINDS[0]] * 3), radio).fly(60, 41, 0, 3))
    for other in flown[1:]:
        assert np.array_equal(other.vehicle_costs, flown[0].vehicle_costs)


def solve_policy(costs: tuple[Array, Array], loss: float, cap: int = 40) -> Array:
    """Return whom to serve (cap + 1, cap + 1) at two ages, by relative value iteration over both."""
    after = np.minimum(np.arange(cap + 1) + 1, cap)
    fresh = np.ones_like(after)  # a message that is sent now is one step old in the next step
    stage = costs[0][: cap + 1, None] + costs[1][None, : cap + 1]
    value = np.zeros_like(stage)
    for _ in range(4000):
        total = stage + value
        options = total[np.ix_(fresh, after)], total[np.ix_(after, fresh)]
        best = loss * total[np.ix_(after, after)] + (1.0 - loss) * np.minimum(*options)
        value = 0.5 * (best - best[0, 0] + value)
    return np.asarray(options[1] < options[0], dtype=np.intp)


class PolicySchedule:
    """Schedule by a table over the true ages, which its sender learns from reports that are never lost."""

    def __init__(self, policy: Array) -> None:
        self._policy, self._captured_ns = policy, [0, 0]

    def add_position(self, number: int, captured_ns: int) -> bool:
        del number, captured_ns
        return True

    def add_feedback(self, number: int, captured_ns: int, at_ns: int) -> None:
        del at_ns
        self._captured_ns[number] = captured_ns

    def choose(self, at_ns: int) -> int:
        step_ns = round(DT_S * SECOND_NS)
        ages = [min((at_ns - captured_ns) // step_ns, len(self._policy) - 1) for captured_ns in self._captured_ns]
        return int(self._policy[ages[0], ages[1]])


def test_value_is_within_5_percent_of_dynamic_programming_for_two_vehicles() -> None:
    radio = make_radio("value", 0.0)
    vehicles = make_vehicles(radio, WINDS)
    first, second = (compute_vehicle_costs(vehicle.config, DT_S)[0] for vehicle in vehicles)
    policy = solve_policy((first, second), 0.0)
    assert 0 < policy.mean() < 1
    world = LinearFleet(vehicles, radio)
    value = world.fly(200, 43, 0, 20)
    best = world.fly(200, 43, 0, 20, lambda _: PolicySchedule(policy))
    assert value.cost.mean() <= 1.05 * best.cost.mean()


def test_with_unequal_winds_value_costs_less_than_turns() -> None:
    value, turns = (fly(schedule, 0.3, [*WINDS, WINDS[1], WINDS[1]], 20) for schedule in ("value", "round-robin"))
    difference = value.cost - turns.cost
    assert difference.mean() + 2.0 * difference.std(ddof=1) / 20**0.5 < 0.0


def write(folder: Path, text: str) -> Path:
    path = folder / "small.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_campaign_of_fleets_is_flown_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, HEAD + REST)
    assert run(["campaign", str(path), "--out", str(tmp_path / "out"), "--workers", "1"]) == 0
    capsys.readouterr()
    record, cells = summarise_fleets(tmp_path / "out")
    assert [(cell.vehicles, cell.schedule) for cell in cells] == [
        (count, schedule) for count in (2, 3) for schedule in ("round-robin", "oldest-first", "value")
    ]
    assert record.world == "fleet" and (tmp_path / "out" / "report.html").exists()
    assert all(cell.runs == 6 and cell.failed == 0 for cell in cells)
    # The rows are those of the world itself, whatever the tasks' size.
    spec, _ = read_fleet_campaign(path)
    numbered = make_fleet_cells(spec)
    rows = np.concatenate([task.fly()["cost"] for task in make_fleet_tasks(spec, numbered[:1])])
    assert cells[0].cost == pytest.approx(float(rows.mean()))
    assert cells[2].value_gain is None and cells[0].value_gain is not None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD, r"task: "),
        (HEAD + REST + REST, r"task\[1\]\.name: .*twice"),
        (HEAD.replace("vehicles = [2, 3]", "vehicles = [0]") + REST, r"vehicles\[0\]"),
        (HEAD + REST.replace('-1.2]"]\n', '-1.2]", "link.delay_s=0.01"]\n'), r"task\[0\]\.set: step or delay"),
        (HEAD + REST.replace("sim.start", "sim.begin"), r"task\[0\]\.set\[0\]"),
    ],
)
def test_problems_of_a_file_are_reported_with_their_keys(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_fleet_campaign(write(tmp_path, text))


def test_a_radio_that_does_not_carry_the_fleet_is_refused_and_told(tmp_path: Path) -> None:
    text = HEAD.replace("bytes_per_s = [900.0]", "bytes_per_s = [900.0]\nloss = 0.9").replace("[2, 3]", "[40]")
    spec, _ = read_fleet_campaign(write(tmp_path, text + REST))
    cells = make_fleet_cells(spec)
    assert all(cell.record.refused for cell in cells)
    assert list(make_fleet_tasks(spec, cells)) == []
