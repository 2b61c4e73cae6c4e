"""The command `uavctl paper`: its document, its figures, its refusals."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import pytest

from uavctl.cli import paper as paper_cmd
from uavctl.cli.app import run as command
from uavctl.lab.paper import depth as deep
from uavctl.lab.paper import runs as run
from uavctl.lab.paper.claims import Complexity, Depth, TriedDesign

WANTED = {
    "runs", "mean_cost", "cost_stderr", "infeasible", "slack_used", "state_violations", "input_violations", "max_age",
    "age_distribution", "settled_std", "wall_s", "figures", "claims", "variants",
}  # fmt: skip
DEPTH = Depth(
    designs=[
        TriedDesign(tau=3, schedule="d_t = 5", delays=None, gamma_h=None, cost=None, refused="too slow"),
        TriedDesign(tau=4, schedule="greedy", delays=[1, 2], gamma_h=0.97, cost=None, refused=""),
        TriedDesign(tau=4, schedule="d_t = 5", delays=[5, 5], gamma_h=0.97, cost=61670.0, refused=""),
    ],
    complexity=[
        Complexity(tau=tau, horizon=12, gains=36, lifted=8, exact_ms=10.0, printed_ms=printed, refused="")
        for tau, printed in ((3, 100.0), (4, 151.0))
    ]
    + [Complexity(tau=6, horizon=12, gains=0, lifted=14, exact_ms=None, printed_ms=None, refused="unstable")],
    least_settled_cost=11.95,
)


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The document of five runs."""
    out = io.StringIO()
    with redirect_stdout(out):
        folder = tmp_path_factory.mktemp("paper") / "new" / "folder"
        assert command(["paper", "--runs", "5", "--json", "--out", str(folder)]) == 0
    text: dict[str, Any] = json.loads(out.getvalue())
    return text


@pytest.mark.slow
def test_the_document_has_every_figure_and_both_designs(document: dict[str, Any]) -> None:
    assert document.keys() >= WANTED
    assert [variant["tau"] for variant in document["variants"]] == [4, 3]
    printed = document["variants"][0]
    assert {key: document[key] for key in printed} == printed  # at the top: τ = 4 as printed
    assert document["runs"] == 5 and document["steps"] == 50 and document["seed"] == 0
    assert document["depth"] is None
    assert all(claim.keys() == {"key", "claim", "paper", "measured", "holds"} for claim in document["claims"])
    assert len(document["figures"]) == 3
    for name in document["figures"]:
        assert ElementTree.parse(name).getroot().tag.endswith("svg")


@pytest.mark.slow
def test_both_designs_meet_the_same_losses(document: dict[str, Any]) -> None:
    four, three = document["variants"]
    assert four["age_distribution"] == three["age_distribution"]
    assert four["mean_cost"] != three["mean_cost"]
    assert four["mean_cost"] == pytest.approx(three["mean_cost"], rel=0.01)


def test_the_document_of_several_chunks_is_plain_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "CHUNK", 2)
    assert command(["paper", "--runs", "5", "--steps", "8", "--tau", "4", "--json", "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out)["runs"] == 5


def test_the_terminal_shows_claims_and_paths_of_the_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(["paper", "--runs", "2", "--steps", "12", "--tau", "3", "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    for text in ("claim", "τ = 3", "yes:", "no:", "paper-runs-tau3.svg", "paper-ages.svg", "slack variable"):
        assert text in shown
    assert "τ = 4:" not in shown
    assert sorted(path.name for path in tmp_path.iterdir()) == ["paper-ages.svg", "paper-runs-tau3.svg"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--runs", "0"], "runs"),
        (["--runs", "-3"], "runs"),
        (["--steps", "3"], "steps"),
        (["--tau", "9"], "tau"),
        (["--seed", "-1"], "seed"),
        (["--workers", "0"], "workers"),
        (["--run", "5"], "--run"),
    ],
)
def test_invalid_options_are_refused_by_name(
    arguments: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(["paper", "--out", str(tmp_path), *arguments]) == 2
    out, err = capsys.readouterr()
    assert text in (out + err).lower()


def test_a_folder_that_cannot_be_made_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert command(["paper", "--runs", "1", "--out", str(tmp_path / "file" / "below")]) == 2
    assert "--out" in capsys.readouterr().err


@pytest.mark.slow
def test_the_slow_part_is_in_the_document_when_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(deep, "measure_depth", lambda seed, text: DEPTH)
    arguments = ["paper", "--runs", "2", "--steps", "8", "--tau", "4", "--full", "--out", str(tmp_path)]
    assert command([*arguments, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {claim["key"] for claim in document["claims"]} >= {"complexity", "optimum"}
    assert document["depth"] == msgspec.to_builtins(DEPTH)
    claims = {claim["key"]: claim for claim in document["claims"]}
    assert claims["complexity"]["holds"] is False  # as printed, 100 ms become 151
    assert "100 to 151 ms" in claims["complexity"]["measured"]
    assert command(arguments) == 0
    shown = capsys.readouterr().out
    assert "Schedules" in shown and "too slow" in shown and "over τ" in shown and "unstable" in shown


def test_the_slow_part_is_loaded_when_asked_for_only() -> None:
    assert not hasattr(paper_cmd, "measure_depth")
    assert callable(deep.measure_depth)
