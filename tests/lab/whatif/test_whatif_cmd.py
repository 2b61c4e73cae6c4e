"""`uavctl log whatif` as it is typed."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from places import DATA
from report_rig import omit_figures, omit_pages

from logs.recording.reader import read_header
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.config.load import dump_config


def typed(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = run(arguments)
    output = capsys.readouterr()
    return code, output.out, output.err


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    text = ["loopback", "--config", "paper", "--set", "solver.method=exact", "--duration", "20", "--out", str(folder)]
    with omit_pages():
        assert run(text) == 0
    return folder / "flight.mcap"


@pytest.fixture
def no_figures() -> Iterator[None]:
    """For flights whose pages nobody reads."""
    with omit_pages(), omit_figures():
        yield


def document(capsys: pytest.CaptureFixture[str], flown: Path, out: Path, *more: str) -> dict[str, Any]:
    code, text, errors = typed(capsys, "log", "whatif", str(flown), "--out", str(out), "--json", *more)
    assert code == 0, errors
    result: dict[str, Any] = json.loads(text)
    return result


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_nothing_changed_reproduces_the_flight(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = document(capsys, flown, tmp_path)
    assert result["reproduction"] == {"identical": True, "decisions": 200, "largest_state": 0.0, "largest_input": 0.0}
    assert result["recorded"]["cost"] == result["reproduced"]["cost"] == result["what_if"]["cost"]
    assert (result["link"], result["controller"], result["changed"], result["compared_s"]) == (
        "recorded",
        "smpc",
        [],
        20.0,
    )
    assert result["largest_departure_m"] == 0
    assert result["model"]["moves"] == 19 and 0.9 < result["model"]["r2"] < 1.0


@pytest.mark.slow
def test_another_cost_is_recorded_reported_and_replays(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "other"
    result = document(capsys, flown, out, "--set", "cost.input=[20.0, 20.0]")
    assert result["reproduction"]["identical"] and result["largest_departure_m"] > 1.0
    assert result["what_if"]["cost"] > result["recorded"]["cost"] + 1.0
    assert result["changed"] == ["cost.input=[20.0, 20.0]"]
    assert read_header(out / "flight.mcap").config_toml.count("input = [20.0, 20.0]") == 1
    for key, text in (("page", "<svg"), ("report", "<svg")):
        assert text in Path(result[key]).read_text(encoding="utf-8")
    code, text, _ = typed(capsys, "log", "replay", str(out / "flight.mcap"), "--json")
    assert code == 0 and json.loads(text)["identical"]
    again = document(capsys, out / "flight.mcap", tmp_path / "again", "--set", "cost.input=[5.0, 5.0]")
    assert again["reproduction"]["identical"] and again["largest_departure_m"] > 1.0


@pytest.mark.usefixtures("no_figures")
@pytest.mark.usefixtures("no_figures")
def test_the_terminal_shows_the_validity_before_the_figures(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, text, _ = typed(
        capsys, "log", "whatif", str(flown), "--controller", "lqg", "--set", "link.loss=0.2", "--out", str(tmp_path)
    )
    assert code == 0
    assert text.startswith("Reproduced")
    assert text.index("Reproduced") < text.index("Model (the recording's [plant])") < text.index("what-if")
    (changed,) = [line for line in text.splitlines() if line.startswith("Changed: ")]
    assert all(change in changed for change in ("link.loss=0.2", "controller lqg", "link: configured"))
    assert "lqg" in text and "Decision time" not in text


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_the_design_may_believe_in_another_link_than_the_one_flown(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = document(capsys, flown, tmp_path / "a", "--set", "link.loss=0.1", "--link", "recorded")
    assert result["link"] == "recorded" and result["what_if"]["lost"] == result["recorded"]["lost"]
    result = document(capsys, flown, tmp_path / "b", "--link", "configured", "--seed", "5")
    assert result["link"] == "configured" and result["what_if"]["lost"] != result["recorded"]["lost"]
    assert result["changed"] == ["--seed 5"]
    # A link that no design could count on is flown by one that knows nothing of it.
    result = document(capsys, flown, tmp_path / "c", "--link", "loss=0.7", "--link", "jitter_s=0.2")
    assert result["link"] == "loss=0.7, jitter_s=0.2"
    assert result["what_if"]["lost"] > 10 and result["what_if"]["max_age"] > result["recorded"]["max_age"]


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_a_model_that_was_identified(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = load_config("paper", ["plant.b=[[0.25, 0.0], [0.45, 0.0], [0.0, 0.25], [0.0, 0.45]]"])
    model = tmp_path / "identified.toml"
    model.write_text(dump_config(config), encoding="utf-8")
    result = document(
        capsys, flown, tmp_path / "a", "--model", str(model), "--set", "target.position_m=[1.0, 0.0, 0.0]"
    )
    assert result["model"]["source"] == f"[plant] of {model}" and result["reproduction"]["identical"]
    own = document(capsys, flown, tmp_path / "b", "--set", "target.position_m=[1.0, 0.0, 0.0]")
    assert result["model"]["rms_m"] > own["model"]["rms_m"]
    assert result["what_if"]["cost"] != own["what_if"]["cost"]


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_a_model_with_gusts_moves_the_vehicle_as_one_without(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A gust does not depend on what is flown, and the simulated vehicle has no such state."""
    flight = tmp_path / "flight"
    with omit_pages():
        assert run(["loopback", "--config", "room-px4", "--duration", "6", "--out", str(flight)]) == 0
    capsys.readouterr()
    moved = []
    for number, gusts in enumerate(([], ["plant.gust_mps2=[0.4, 0.4, 0.2]", "plant.gust_s=[1.0, 1.0, 1.0]"])):
        model = tmp_path / f"model-{number}.toml"
        model.write_text(dump_config(load_config("room-px4", gusts)), encoding="utf-8")
        more = ("--model", str(model), "--set", "target.position_m=[1.0, 0.0, -1.2]")
        moved.append(document(capsys, flight / "flight.mcap", tmp_path / str(number), *more))
    assert moved[0]["what_if"]["cost"] == pytest.approx(moved[1]["what_if"]["cost"], rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--set", "sim.seed=3"), "sim.seed is part of"),
        (("--set", "source.system_id=3"), "source.system_id is part of"),
        (("--set", "smpc.horizn=3"), 'nearest valid name "horizon"'),
        (("--set", "nothing"), "is not an override"),
        (("--set", "plant.dt_s=0.5"), "steps of 0.5 s, the recorded"),
        (("--set", "link.loss=0.9"), "out of reach"),
        (("--config", "room-hahn-stursberg"), "room-hahn-stursberg: plant has 9 states, 3 inputs"),
        (("--config", "missing.toml"), "no such file or preset"),
        (("--model", "room-hahn-stursberg"), "--model room-hahn-stursberg: plant has 9 states"),
        (("--seed", "4"), "--seed belongs to a simulated link"),
        (("--link", "none"), "--link none: give `recorded` or `configured`"),
        (("--link", "recorded", "--link", "loss=0.1"), "give `recorded` or `configured` alone"),
        (("--link", "los=0.1"), 'nearest valid name "loss"'),
        (("--controller", "genius"), "genius"),
    ],
)
def test_keys_that_cannot_change_are_reported(
    flown: Path, arguments: tuple[str, ...], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, errors = typed(capsys, "log", "whatif", str(flown), *arguments)
    assert code == 2 and not out
    assert text in " ".join(errors.split())


def test_other_files_are_refused(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, errors = typed(capsys, "log", "whatif", str(DATA / "arducopter-vicon.tlog"))
    assert code == 2 and "another program's recording" in errors
    code, _, errors = typed(capsys, "log", "whatif", str(tmp_path / "none.mcap"))
    assert code == 1 and "no such recording" in errors
    text = tmp_path / "text.mcap"
    text.write_text("nothing of the kind")
    code, _, errors = typed(capsys, "log", "whatif", str(text))
    assert code == 1 and "not a recording" in errors
    code, _, errors = typed(capsys, "log", "whatif", str(flown), "--out", str(text))
    assert code in (1, 2) and str(text) in " ".join(errors.split())


@pytest.mark.slow
@pytest.mark.usefixtures("no_figures")
def test_a_torn_recording_is_flown_to_its_end(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torn = tmp_path / "torn.mcap"
    data = flown.read_bytes()
    torn.write_bytes(data[: len(data) * 6 // 10])
    code, text, errors = typed(capsys, "log", "whatif", str(torn), "--out", str(tmp_path / "out"), "--json")
    assert code == 0 and "torn" in errors
    result = json.loads(text)
    assert result["compared_s"] < 20.0 and result["recorded"]["steps"] == result["what_if"]["steps"] > 2
    torn.write_bytes(data[:3000])
    code, _, errors = typed(capsys, "log", "whatif", str(torn), "--out", os.devnull)
    assert code == 1 and "no header" in errors
