"""What is printed is short, plots say what they show, and runs are one table."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import uavctl

OWN = (
    "[plant]\na = [[1, 0.1], [0, 1]]\nb = [[0.005], [0.1]]\ne = [[0.005], [0.1]]\ndt_s = 0.1\n"
    "[sets]\nstate_lower = [-5, -2]\nstate_upper = [5, 2]\ninput_lower = [-1]\ninput_upper = [1]\n"
    "[cost]\nstate = [1, 0.1]\ninput = [0.1]\n[link]\nloss = 0.3\n"
)
ROOM_STATE = [0, 0, 0, 0, 0, 0, -1, 0, 0]


def test_printed_objects_are_a_few_lines(tmp_path: Path) -> None:
    room = uavctl.load("room")
    plan = uavctl.solve(room, ROOM_STATE)
    for value in (
        room,
        plan,
        uavctl.plant(room),
        uavctl.controller(room),
        uavctl.simulate(room, "lqg", runs=2, steps=3),
    ):
        assert len(repr(value).splitlines()) <= 4
        assert len(repr(value)) < 500
    assert plan.status.value in repr(plan)
    assert f"{plan.inputs[0, 0]:.4g} m/s²" in repr(plan)


@pytest.mark.parametrize(
    "link",
    [
        {"loss": 0.25},
        {"probability": [1.0, 0.9, 0.7]},
        {"model": "gilbert-elliott", "loss": 0.0, "burst_enter": 0.2, "burst_leave": 0.5},
        {"model": "gilbert-elliott", "loss": 0.1, "burst_enter": 0.05, "burst_leave": 0.3, "burst_loss": 0.8},
        {"model": "empirical", "gaps": [0.6, 0.25, 0.05, 0.1]},
        {"model": "trace", "trace_s": [0.0, float("inf"), 0.0, float("inf"), float("inf")]},
    ],
)
def test_a_configuration_s_text_has_the_loss_of_the_link_in_the_long_run(link: dict[str, object]) -> None:
    config = uavctl.load("paper", {"link.loss": 0.0, **{f"link.{key}": value for key, value in link.items()}})
    # With one packet a step and no delay, a position is a step old where its packet is lost.
    assert f"mean loss {uavctl.link(config).outage(1):.3g}" in repr(config)


def test_a_plan_is_drawn_with_units_and_limits() -> None:
    room = uavctl.load("room")
    figure = uavctl.plot(uavctl.solve(room, ROOM_STATE))
    by_label = {ax.get_ylabel(): ax for ax in figure.axes}
    assert {"position [m]", "velocity [m/s]", "acceleration [m/s²]", "input [m/s²]"} == set(by_label)
    drawn = [np.asarray(line.get_ydata()) for line in by_label["position [m]"].lines]
    levels = {float(heights[0]) for heights in drawn if heights.size}
    assert {room.sets.state_lower[0], room.sets.state_upper[0]} <= levels


def test_runs_are_one_table_in_both_kinds(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(OWN)
    runs = uavctl.simulate(path, "lqg", runs=2, steps=3, start=[1, 0])
    table: Any = runs.to_pandas()
    assert list(table.columns) == runs.to_polars().columns
    assert len(table) == len(runs.to_polars()) == 2 * 4
    second = table[table["run"] == 1]
    np.testing.assert_array_equal(second["state_0"], runs.states[1, :, 0])
    np.testing.assert_array_equal(second["input_0"].to_numpy()[:3], runs.inputs[1, :, 0])
    assert np.isnan(second["cost"].to_numpy()[3])
    assert second["state_violated"].isna().tolist() == [True, False, False, False]
    assert second["age_steps"].tolist()[:3] == runs.age_steps[1].tolist()
    assert [ax.get_title() for ax in uavctl.plot(runs).axes] == ["State 0", "State 1"]
