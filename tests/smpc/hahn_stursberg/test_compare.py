"""Designs beside one another, as functions and as they are typed."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from design_rig import spec
from numpy.typing import NDArray

from uavctl.build.controller import start_state
from uavctl.cli.app import run
from uavctl.config import load
from uavctl.lab.compare_designs import compare_gains, seeded_states
from uavctl.smpc.hahn_stursberg.design import make_design
from uavctl.smpc.hahn_stursberg.exact import check_schedule, optimal_cost
from uavctl.smpc.sets import Polytope

Array = NDArray[np.float64]
BEST = [[-0.151872, -0.787386, 0.0, 0.0], [0.0, 0.0, -0.151872, -0.787386]]
START = np.array([35.0, -2.0, -20.0, -4.0])


def nothing(what: str) -> None:
    """No progress to be shown."""


def typed(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = run(arguments)
    output = capsys.readouterr()
    return code, output.out, output.err


def document(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    code, out, _ = typed(capsys, *arguments, "--json")
    assert (code, out.count("\n")) == (0, 1)
    found: dict[str, Any] = json.loads(out)
    return found


def test_states_are_seeded_and_in_the_box() -> None:
    limits = Polytope.from_box([-1.0, -np.inf, 2.0], [3.0, np.inf, np.inf])
    target = np.array([0.5, 7.0, 4.0])
    points, nearer = seeded_states(limits, target, 500, 3)
    assert -1.0 <= points[:, 0].min() < -0.9 and 2.9 < points[:, 0].max() <= 3.0
    np.testing.assert_array_equal(points[:, 1:], np.tile(target[1:], (500, 1)))  # not limited on both sides
    share = (nearer[:, 0] - target[0]) / (points[:, 0] - target[0])
    assert 0.0 <= share.min() < 0.05 and 0.95 < share.max() <= 1.0
    again = seeded_states(limits, target, 500, 3)
    np.testing.assert_array_equal(again, (points, nearer))
    assert not np.array_equal(seeded_states(limits, target, 500, 4)[0], points)


@pytest.mark.slow
def test_the_paper_s_gain_beside_the_best() -> None:
    told: list[str] = []
    found = compare_gains(spec("paper"), 0.9 * START, 5, 0, told.append)
    assert len(told) == 2 + 2 * 2 * 5
    assert found.before.stationary_cost == pytest.approx(517.23, abs=0.01)
    assert found.after.stationary_cost == pytest.approx(324.04, abs=0.01)
    assert (found.before.spectral_radius, found.after.spectral_radius) == pytest.approx((0.9714, 0.9182), abs=1e-4)
    assert found.after.k_tau == BEST
    design = make_design(spec("paper", k_tau=np.array(BEST)))
    assert found.after.design_id == design.design_id
    assert found.after.margin == check_schedule(design)
    assert found.before.costs and found.after.costs
    assert found.after.costs.start == optimal_cost(design, 0.9 * START)
    assert found.before.costs.start == pytest.approx(47919.07, abs=0.01)
    assert found.before.costs.mean and found.after.costs.mean
    assert found.after.costs.mean < found.before.costs.mean
    assert 0 < found.compared <= found.states == 5


@pytest.mark.slow
def test_means_are_over_the_states_that_both_can_leave() -> None:
    given = spec("paper")
    found = compare_gains(given, START, 6, 2, nothing)
    _, nearer = seeded_states(given.state_set, np.zeros(4), 6, 2)
    designs = [make_design(given), make_design(spec("paper", k_tau=np.array(BEST)))]
    costs = [[optimal_cost(design, x) for x in nearer] for design in designs]
    common = [pair for pair in zip(*costs, strict=True) if None not in pair]
    assert len(common) == found.compared
    assert found.before.costs and found.before.costs.mean == pytest.approx(np.mean([pair[0] for pair in common]))
    assert found.after.costs and found.after.costs.mean == pytest.approx(np.mean([pair[1] for pair in common]))


def test_a_gain_that_no_design_can_be_made_with_is_replaced() -> None:
    found = compare_gains(spec("paper", k_tau=np.kron(np.eye(2), [[-0.6, -1.2]])), START, 1, 0, nothing)
    assert "unstable" in str(found.before.refused)
    assert found.before.costs is None
    assert found.after.refused is None
    np.testing.assert_allclose(found.after.k_tau, BEST, rtol=1e-5)


def test_the_simulator_s_start() -> None:
    paper = load("paper")
    given = spec("paper")
    np.testing.assert_array_equal(start_state(paper.config, given.plant), START)
    room = start_state(
        load("room-hahn-stursberg", ("sim.start_velocity_mps=[0.1, 0.2, 0.3]",)).config,
        spec("room-hahn-stursberg").plant,
    )
    np.testing.assert_array_equal(room, [-2.4, 0.1, 0.0, -1.9, 0.2, 0.0, -0.7, 0.3, 0.0])


def test_synthesise_as_typed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    found = document(capsys, "design", "--config", "paper", "--synthesize", "--states", "2")
    assert {"k_tau", "toml", "before", "after", "compared", "wall_s"} <= found.keys()
    assert found["k_tau"] == found["after"]["k_tau"] == BEST
    # the fragment is ready to be pasted
    fragment = found["toml"]
    assert tomllib.loads(fragment) == {"smpc": {"k_tau": BEST}}
    override = "smpc.k_tau=" + json.dumps(BEST)
    design = document(capsys, "design", "--config", "paper", "--set", override, "--set", "solver.method=exact")
    assert design["design_id"] == found["after"]["design_id"]
    assert design["stationary_cost"] == found["after"]["stationary_cost"]


@pytest.mark.slow
def test_synthesise_shows_people_a_table_and_the_fragment(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = typed(capsys, "design", "--config", "paper", "--synthesize", "--states", "1")
    assert code == 0
    for shown in ("517.2", "324", "0.9182", "61669.93", "[smpc]\n", "  [-0.151872, -0.787386, 0.0, 0.0],\n"):
        assert shown in out


def test_a_gain_without_a_complete_design_ends_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    # delays beyond the terminal law's leave a terminal condition that no gain can meet
    arguments = (
        "design", "--config", "paper", "--synthesize", "--states", "1",
        "--set", "schedule.delays=6", "--set", "link.loss=0.2",
    )  # fmt: skip
    code, out, _ = typed(capsys, *arguments, "--json")
    found = json.loads(out)
    assert code == 1
    assert "slower than the terminal law" in found["after"]["refused"]
    assert found["compared"] == 0
    code, out, _ = typed(capsys, *arguments)
    assert code == 1
    assert "No complete design with the synthesised gain" in out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--synthesize", "--states", "0"), "--states"),
        (("--synthesize", "--set", "smpc.delta_x=0.995"), "smpc.delta_x"),
        (("--synthesize", "--set", "sets.input_upper=[0.5, 0.5]"), "smpc.k_tau: no gain was found whose terminal set"),
    ],
)
def test_what_cannot_be_ends_with_2(capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], told: str) -> None:
    code, out, err = typed(capsys, "design", "--config", "paper", *arguments)
    assert (code, out) == (2, "")
    assert told in err
