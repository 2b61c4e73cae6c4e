"""Comparison of terminal gains, by functions and by commands."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from design_rig import spec

from uavctl.cli.app import run
from uavctl.config import load
from uavctl.lab.terminal_gain import compare_gains
from uavctl.smpc.hahn_stursberg.design import make_design
from uavctl.smpc.hahn_stursberg.exact import check_schedule, optimal_cost
from uavctl.wiring.controller import make_start_state

BEST = [[-0.151872, -0.787386, 0.0, 0.0], [0.0, 0.0, -0.151872, -0.787386]]
START = np.array([35.0, -2.0, -20.0, -4.0])


def typed(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = run(arguments)
    output = capsys.readouterr()
    return code, output.out, output.err


def document(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    code, out, _ = typed(capsys, *arguments, "--json")
    assert (code, out.count("\n")) == (0, 1)
    result: dict[str, Any] = json.loads(out)
    return result


@pytest.mark.slow
def test_the_paper_s_gain_beside_the_best() -> None:
    result = compare_gains(spec("paper"), 0.9 * START)
    assert result.before.stationary_cost == pytest.approx(517.23, abs=0.01)
    assert result.after.stationary_cost == pytest.approx(324.04, abs=0.01)
    assert (result.before.spectral_radius, result.after.spectral_radius) == pytest.approx((0.9714, 0.9182), abs=1e-4)
    assert result.after.k_tau == BEST
    design = make_design(spec("paper", k_tau=np.array(BEST)))
    assert result.after.design_id == design.design_id
    assert result.after.margin == check_schedule(design)
    assert result.after.start_cost == optimal_cost(design, 0.9 * START)
    assert result.before.start_cost == pytest.approx(47919.07, abs=0.01)


def test_a_gain_that_no_design_can_be_made_with_is_replaced() -> None:
    result = compare_gains(spec("paper", k_tau=np.kron(np.eye(2), [[-0.6, -1.2]])), START)
    assert "unstable" in str(result.before.refused)
    assert result.before.start_cost is None
    assert result.after.refused is None
    np.testing.assert_allclose(result.after.k_tau, BEST, rtol=1e-5)


def test_the_simulator_s_start() -> None:
    paper = load("paper")
    case = spec("paper")
    np.testing.assert_array_equal(make_start_state(paper.config, case.plant), START)
    room = make_start_state(
        load("room-hahn-stursberg", ("sim.start_velocity_mps=[0.1, 0.2, 0.3]",)).config,
        spec("room-hahn-stursberg").plant,
    )
    np.testing.assert_array_equal(room, [-2.4, 0.1, 0.0, -1.9, 0.2, 0.0, -0.7, 0.3, 0.0])


def test_synthesise_as_typed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    result = document(capsys, "design", "--config", "paper", "--synthesize")
    assert {"k_tau", "toml", "before", "after", "starts", "wall_s"} <= result.keys()
    assert result["k_tau"] == result["after"]["k_tau"] == BEST
    # the fragment is ready to be pasted
    fragment = result["toml"]
    assert tomllib.loads(fragment) == {"smpc": {"k_tau": BEST}}
    override = "smpc.k_tau=" + json.dumps(BEST)
    design = document(capsys, "design", "--config", "paper", "--set", override)
    assert design["design_id"] == result["after"]["design_id"]
    assert design["stationary_cost"] == result["after"]["stationary_cost"]


@pytest.mark.slow
def test_synthesise_shows_people_a_table_and_the_fragment(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = typed(capsys, "design", "--config", "paper", "--synthesize")
    assert code == 0
    for shown in ("517.2", "324", "0.9182", "61669.93", "[smpc]\n", "  [-0.151872, -0.787386, 0.0, 0.0],\n"):
        assert shown in out


def test_a_gain_without_a_complete_design_ends_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    # delays beyond the terminal law's leave a terminal condition that no gain can meet
    arguments = (
        "design", "--config", "paper", "--synthesize" ,
        "--set", "schedule.delays=6", "--set", "link.loss=0.2",
    )  # fmt: skip
    code, out, _ = typed(capsys, *arguments, "--json")
    result = json.loads(out)
    assert code == 1
    assert "slower than the terminal law" in result["after"]["refused"]
    code, out, _ = typed(capsys, *arguments)
    assert code == 1
    assert "No complete design with the synthesised gain" in out


@pytest.mark.parametrize(
    ("arguments", "reported"),
    [
        (("--synthesize", "--set", "smpc.delta_x=0.995"), "smpc.delta_x"),
        (("--synthesize", "--set", "sets.input_upper=[0.5, 0.5]"), "smpc.k_tau: no gain was found whose terminal set"),
    ],
)
def test_impossible_arguments_end_with_2(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], reported: str
) -> None:
    code, out, err = typed(capsys, "design", "--config", "paper", *arguments)
    assert (code, out) == (2, "")
    assert reported in err
