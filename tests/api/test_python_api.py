"""`import uavctl`: the same numbers as the command line, and plain errors."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib.colors import to_rgb
from matplotlib.text import Text
from mcap.reader import make_reader
from places import ROOT

import uavctl
from uavctl.cli.app import run
from uavctl.errors import ConfigError, ControllerError, DesignError, RecordingError, UsageError
from uavctl.records import SolveStatus

PAPER = {"solver.method": "exact"}
STATE = [35.0, -2.0, -20.0, -4.0]


def test_import_loads_nothing_else() -> None:
    script = "import sys, uavctl; print(sorted({'numpy', 'matplotlib', 'cvxpy', 'uavctl.api'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.slow
def test_loading_and_solving_loads_neither_matplotlib_nor_cvxpy() -> None:
    script = (
        "import sys, uavctl; uavctl.solve('room', [0.0] * 9); uavctl.controller('room').step([0.0] * 9); "
        "print(sorted({'matplotlib', 'cvxpy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_exactly_the_public_names_have_types() -> None:
    stub = ast.parse((ROOT / "uavctl" / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    module_by_name = {str(alias.asname): str(node.module) for node in imports for alias in node.names}
    assert sorted(module_by_name) == sorted(uavctl.__all__)
    for name, module in module_by_name.items():
        assert getattr(uavctl, name) is getattr(sys.modules[module], name)
    assert set(module_by_name) <= set(dir(uavctl))


def test_a_name_that_is_none_is_refused_as_of_any_module() -> None:
    with pytest.raises(AttributeError, match="no attribute 'slove'"):
        _ = uavctl.slove  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["sim.py", pytest.param("logs/__init__.py", marks=pytest.mark.slow)])
def test_a_module_of_the_same_name_that_hides_ours_is_reported(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.touch()
    script = "import uavctl\ntry: uavctl.load\nexcept uavctl.errors.UavctlError as error: print(error)"
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith(f"module {name[:3].replace('log', 'logs')} is {path}, not the one of uavctl")


def test_a_folder_of_data_hides_nothing(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    script = "import uavctl; print(uavctl.load('paper').name)"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout == "paper\n"


@pytest.mark.parametrize(
    ("given", "typed"),
    [
        ({"link": {"loss": 0.25}}, ("link.loss=0.25",)),
        ({"link.loss": np.float64(0.25)}, ("link.loss=0.25",)),
        ({"duration_s": 7}, ("duration_s=7",)),
        ({"mission": {"waypoints": np.array([[1.0, 0.5, -1.2], [0.0, 0.0, -1.0]])}},
         ("mission.waypoints=[[1.0,0.5,-1.2],[0.0,0.0,-1.0]]",)),
        ({"sim": {"fault": [{"at_s": 2.0, "kind": "wind", "velocity_mps": (1.0, 0.0, 0.0)}], "plant": "quadrotor"}},
         ('sim.fault=[{at_s=2.0,kind="wind",velocity_mps=[1.0,0.0,0.0]}]', "sim.plant=quadrotor")),
        ({"estimator": {"window_s": 0.5}, "link": {"loss": 1e-7, "blackout": [[1, 2]]}},
         ("estimator.window_s=0.5", "link.loss=1e-7", "link.blackout=[[1,2]]")),
    ],
)  # fmt: skip
def test_overrides_are_those_of_the_command_line(given: dict[str, object], typed: tuple[str, ...]) -> None:
    from uavctl.cli.common import Common

    assert uavctl.load("room", given) == Common(config="room", overrides=typed).load().config


def test_a_configuration_can_be_changed_again_and_read_from_a_file(tmp_path: Path) -> None:
    from uavctl.config import dump_config

    once = uavctl.load("room", link={"loss": 0.25}, duration_s=7)
    path = tmp_path / "mine.toml"
    path.write_text(dump_config(once))
    assert uavctl.load(path) == once
    assert uavctl.load(once, {"link.loss": 0.5}) == uavctl.load("room", {"link.loss": 0.5}, duration_s=7)


@pytest.mark.parametrize(
    ("config", "state", "typed"),
    [
        ("room", [0.5, 0.1, 0.0, -1.0, 0.0, 0.2, -1.0, 0.0, 0.0], ()),
        ("room", [9.0, 5.0, 0.0, -1.0, 0.0, 0.2, -1.0, 0.0, 0.0], ()),
        ("paper", STATE, ("solver.method=exact",)),
        pytest.param("paper", STATE, (), marks=pytest.mark.slow),
    ],
)
def test_a_decision_is_that_of_the_command_line(
    config: str, state: list[float], typed: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    given = dict(setting.split("=") for setting in typed)
    answer = uavctl.solve(uavctl.load(config, given), state)
    arguments = [argument for setting in typed for argument in ("--set", setting)]
    run(["solve", "--config", config, "--state", ",".join(map(str, state)), "--json", *arguments])
    output = json.loads(capsys.readouterr().out)
    assert output["status"] == answer.status.value == SolveStatus.OPTIMAL
    for name in ("inputs", "states", "backoff_x", "backoff_u", "reference"):
        assert output[name] == getattr(answer, name).tolist()
    for name in ("cost", "slack", "offset", "iterations", "method"):
        assert output[name] == getattr(answer, name)


def test_a_plan_follows_the_plant() -> None:
    plant, answer = uavctl.plant("room"), uavctl.solve("room", [0.5, 0.1, 0.0, -1.0, 0.0, 0.2, -1.0, 0.0, 0.0])
    moved = answer.states[:-1] @ plant.a.T + answer.inputs @ plant.b.T
    assert np.allclose(moved, answer.states[1:], rtol=0.0, atol=1e-9)


def test_the_link_gives_the_probability_of_silence() -> None:
    """Independent losses: an age of j or more is j losses in a row."""
    link = uavctl.link(uavctl.load("paper", PAPER, link={"loss": 0.3, "probability": []}))
    assert [link.outage(j) for j in range(1, 5)] == pytest.approx([0.3**j for j in range(1, 5)])


@pytest.mark.parametrize("kind", ["smpc", "lqg"])
def test_a_stepped_controller_does_as_a_simulated_run_did(kind: str) -> None:
    config = uavctl.load("room", link={"loss": 0.5})
    runs = uavctl.simulate(config, kind, runs=1, steps=30, seed=5)
    assert runs.age_steps.max() > 1
    stepped = uavctl.controller(config, kind)
    for _ in range(2):  # the second time from anew
        for k, age in enumerate(runs.age_steps[0].tolist()):
            news = not k or age <= runs.age_steps[0, k - 1]
            acted = stepped.step(runs.states[0, k - age], age) if news else stepped.step(None)
            assert np.array_equal(acted, runs.inputs[0, k])
        stepped.reset()


def test_controllers_meet_the_same_draws() -> None:
    config = uavctl.load("room", link={"loss": 0.5})
    ours, theirs, other_seed = (
        uavctl.simulate(config, kind, runs=4, steps=20, seed=seed)
        for kind, seed in (("smpc", 1), ("lqg", 1), ("lqg", 2))
    )
    assert np.array_equal(ours.age_steps, theirs.age_steps)
    assert not np.array_equal(other_seed.age_steps, theirs.age_steps)
    plant = uavctl.plant(config)
    moved = [runs.states[:, 1:] - runs.states[:, :-1] @ plant.a.T - runs.inputs @ plant.b.T for runs in (ours, theirs)]
    assert np.allclose(moved[0], moved[1], rtol=0.0, atol=1e-9)
    assert np.abs(moved[0]).max() > 1e-3
    longer = uavctl.simulate(config, "lqg", runs=2, steps=25, seed=1)
    assert np.allclose(longer.states[:2, :21], theirs.states[:2], rtol=0.0, atol=1e-9)


CAMPAIGN = """
name = "one cell"
config = "room"
set = ["link.loss=0.5"]
runs = {runs}
steps = 12
master = 9
measured = "{measured}"
[[controller]]
name = "it"
kind = "{kind}"
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "measured", "runs"), [("smpc", "state", 30), ("lqg", "position", 1200), ("smpc", "position", 30)]
)
def test_simulated_runs_are_those_of_a_campaign(
    kind: str, measured: str, runs: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = tmp_path / "cell.toml"
    spec.write_text(CAMPAIGN.format(kind=kind, measured=measured, runs=runs))
    assert run(["campaign", str(spec), "--out", str(tmp_path / "out"), "--workers", "1", "--json"]) == 0
    capsys.readouterr()
    table = pq.read_table(tmp_path / "out" / "runs.parquet")
    result = uavctl.simulate(
        uavctl.load("room", {"link.loss": 0.5}),
        kind,
        runs=runs,
        steps=12,
        seed=9,
        measured=measured,  # type: ignore[arg-type]
    )
    assert result.cost.sum(axis=1).tolist() == table["cost"].to_pylist()
    assert result.state_violated.sum(axis=1).tolist() == table["state_violations"].to_pylist()
    assert result.age_steps.max(axis=1).tolist() == table["max_age"].to_pylist()


_MEASURED = ("/uavctl/header", "/uavctl/timing", "/plot/timing", "/uavctl/recorder")


def read_messages(path: Path) -> list[tuple[str, int, bytes]]:
    """All messages by mcap's own reader, but what is measured with a clock, and when it was."""
    with path.open("rb") as file:
        results = [
            (channel.topic, message.log_time, message.data) for _, channel, message in make_reader(file).iter_messages()
        ]
    return [message for message in results if message[0] not in _MEASURED]


@pytest.mark.parametrize(
    ("name", "more"), [pytest.param("paper", PAPER, marks=pytest.mark.slow), ("room", {"link.loss": 0.4})]
)
def test_a_flight_records_the_bytes_that_the_command_line_records(
    name: str, more: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str], no_page: None
) -> None:
    flight = uavctl.fly(uavctl.load(name, more), tmp_path / "python", seed=3, duration_s=3)
    arguments = [argument for key, value in more.items() for argument in ("--set", f"{key}={value}")]
    out = ["--out", str(tmp_path / "typed")]
    assert run(["loopback", "--config", name, *arguments, "--seed", "3", "--duration", "3", "--json", *out]) == 0
    output = json.loads(capsys.readouterr().out)
    assert flight.recording.path == tmp_path / "python" / "flight.mcap"
    ours, theirs = read_messages(flight.recording.path), read_messages(Path(output["recording"]))
    assert len(ours) > 100
    assert {topic for topic, _, _ in ours} >= {"/uavctl/decision", "/uavctl/step_input", "/uavctl/end"}
    assert ours == theirs
    assert output["ending"] == {name: getattr(flight.ending, name) for name in flight.ending.__struct_fields__}


def test_a_flight_has_the_true_path(tmp_path: Path) -> None:
    flight = uavctl.fly(uavctl.load("paper", PAPER), tmp_path, seed=3, duration_s=4)
    with flight.recording.path.open("rb") as file:
        truth = [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topics=["/sim/truth"])]
    assert flight.position_m.tolist() == [truth_record["position_m"] for truth_record in truth]
    assert flight.velocity_mps.tolist() == [truth_record["velocity_mps"] for truth_record in truth]
    assert np.allclose(np.diff(flight.time_s), flight.config.plant.dt_s)
    assert flight.config == flight.recording.config
    assert flight.config.sim.seed == 3


@pytest.mark.slow
def test_a_flight_from_python_has_its_page_and_its_figure(tmp_path: Path) -> None:
    flight = uavctl.fly(uavctl.load("paper", PAPER), tmp_path, duration_s=3)
    page = flight.recording.report(tmp_path / "page.html")
    assert "uavctl.fly" in page.read_text(encoding="utf-8")
    with pytest.raises(UsageError):
        flight.recording.report(flight.recording.path)
    for what in (flight, flight.recording):
        (ax,) = uavctl.plot(what).axes
        drawn = [np.asarray(line.get_xydata()) for line in ax.lines]
        assert any(np.allclose(line[-1], flight.position_m[-1, [1, 0]]) for line in drawn if len(line) > 1)


def test_a_figure_shows_the_plan() -> None:
    answer = uavctl.solve(uavctl.load("paper", PAPER), STATE)
    drawn = [np.asarray(line.get_ydata()).tolist() for ax in uavctl.plot(answer).axes for line in ax.lines]
    assert all(row in drawn for row in (*answer.states.T.tolist(), *answer.inputs.T.tolist()))


def test_a_figure_of_runs_shows_paths_target_and_limits() -> None:
    config = uavctl.load("room")
    runs = uavctl.simulate(config, "lqg", runs=3, steps=5)
    axes = uavctl.plot(runs).axes
    for number, (ax, place) in enumerate(zip(axes, config.target.position_m, strict=True)):
        drawn = [np.asarray(line.get_ydata()) for line in ax.lines]
        path = np.median(runs.states[:, :, 3 * number], axis=0)
        assert any(len(line) == len(path) and np.allclose(line, path) for line in drawn)
        levels = [float(line[0]) for line in drawn if len(line) and np.allclose(line, line[0])]
        for level in (place, config.sets.state_lower[3 * number], config.sets.state_upper[3 * number]):
            assert any(level == pytest.approx(drawn_level) for drawn_level in levels)


@pytest.mark.parametrize(("width", "width_in"), [("column", 3.5), ("page", 7.16)])
def test_a_figure_for_a_paper_has_its_width_its_fonts_and_no_legend_on_a_line(
    tmp_path: Path, width: Literal["column", "page"], width_in: float
) -> None:
    runs = [uavctl.simulate(uavctl.load("room"), kind, runs=3, steps=5, seed=1) for kind in ("lqg", "pid")]
    path = tmp_path / "runs.pdf"
    figure = uavctl.plot(runs, width=width, path=path)
    assert figure.get_figwidth() == pytest.approx(width_in)
    texts = [text for text in figure.findobj(Text) if isinstance(text, Text) and text.get_text()]
    assert min(float(text.get_fontsize()) for text in texts) >= 7.0
    data = path.read_bytes()
    assert b"/CIDFontType2" in data and b"/FontFile2" in data and b"/Type3" not in data
    (box,) = re.findall(rb"/MediaBox \[ 0 0 ([0-9.]+) [0-9.]+ \]", data)
    assert float(box) == pytest.approx(72.0 * width_in, abs=0.1)
    (legend,) = figure.legends
    assert {"lqg", "pid", "limit", "target"} <= {text.get_text() for text in legend.get_texts()}
    bounds = legend.get_window_extent()
    assert not any(bounds.overlaps(ax.get_window_extent()) for ax in figure.axes)
    for ax in figure.axes:
        flown = [line for line in ax.lines if line.get_label() in ("lqg", "pid")]
        # Luminance of sRGB as it is printed in grey: the lines differ, and so do their dashes
        greys = [np.dot(to_rgb(line.get_color()), [0.299, 0.587, 0.114]) for line in flown]
        assert abs(greys[0] - greys[1]) > 0.15
        assert flown[0].get_linestyle() != flown[1].get_linestyle()


def test_a_figure_of_several_controllers_has_the_median_of_each() -> None:
    runs = [uavctl.simulate(uavctl.load("room"), kind, runs=3, steps=5, seed=1) for kind in ("lqg", "pid")]
    for number, ax in enumerate(uavctl.plot(runs).axes):
        drawn = {line.get_label(): np.asarray(line.get_ydata()) for line in ax.lines}
        for one in runs:
            np.testing.assert_allclose(drawn[one.controller], np.median(one.states[:, :, 3 * number], axis=0))


FILE = "nothing-here.toml"


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        (lambda: uavctl.load("rom"), ConfigError, 'nearest valid name "room"'),
        (lambda: uavctl.load(Path(FILE)), ConfigError, FILE),
        (lambda: uavctl.load("room", link={"los": 0.3}), ConfigError, 'nearest valid name "loss"'),
        (lambda: uavctl.load("room", {"link.loss": 3}), ConfigError, "link.loss"),
        (lambda: uavctl.load("room", {"link.loss": None}), ConfigError, "link.loss: None is no value"),
        (lambda: uavctl.load("room", {"": 1}), ConfigError, "is not an override"),
        (lambda: uavctl.load("room", ["link.loss=0.3"]), UsageError, 'give {"link.loss": 0.3}'),  # type: ignore[arg-type]
        (lambda: uavctl.load("room", duration_s=[1, 2]), ConfigError, "duration_s"),
        (lambda: uavctl.load("room", sim={"fault": [{"at_s": 1.0, "kind": "mode", "name": "NO"}]}), ConfigError, "NO"),
        (lambda: uavctl.solve("room", [1.0, 2.0]), UsageError, "give 9 finite numbers"),
        (lambda: uavctl.solve("room", "here"), UsageError, "give 9 finite numbers"),
        (lambda: uavctl.solve("room", [np.nan] * 9), UsageError, "give 9 finite numbers"),
        (lambda: uavctl.solve("room", [[0.0] * 9]), UsageError, "give 9 finite numbers"),
        (lambda: uavctl.simulate("room", "smcp"), DesignError, 'nearest valid name "smpc"'),
        (lambda: uavctl.simulate("room", runs=0), UsageError, "runs"),
        (lambda: uavctl.simulate("room", steps=1), UsageError, "steps"),
        (lambda: uavctl.simulate("room", seed=-1), UsageError, "at `seed`"),
        (lambda: uavctl.simulate("room", start=[0.0]), UsageError, "give 9 finite numbers"),
        (lambda: uavctl.simulate(uavctl.load("room", {"sim.plant": "quadrotor"})), ConfigError, "sim.plant"),
        (lambda: uavctl.controller("room").step(None), UsageError, "first step"),
        (lambda: uavctl.controller("room").step([0.0] * 9, 1), UsageError, "cannot be 1 steps old"),
        (lambda: uavctl.controller("room").step([0.0] * 9, 0.5), UsageError, "whole number"),  # type: ignore[arg-type]
        (lambda: uavctl.controller("room", "pid-loop"), DesignError, "pid"),
        (lambda: uavctl.fly("room", duration_s=1e-3), UsageError, "shorter than a tick"),
        (lambda: uavctl.fly("room", seed=-1), ConfigError, "sim.seed"),
        (lambda: uavctl.fly("room", take_off_m=0.0), UsageError, "take_off_m 0.0: give a height"),
        (lambda: uavctl.fly("room", take_off_m=2.499), UsageError, "may not rest"),
        (lambda: uavctl.fly("room", goto=(0.0, 0.0, -2.499)), UsageError, "goto: down -2.499 m is outside"),
        (lambda: uavctl.fly("room", goto=(0.0, 1.0)), UsageError, "goto (0.0, 1.0): give north, east and down"),
        (lambda: uavctl.fly("room", goto=(0.0, 1.0, np.nan)), UsageError, "give north, east and down"),
        (lambda: uavctl.read("none.mcap"), RecordingError, "none.mcap"),
        (lambda: uavctl.read(ROOT), RecordingError, "is a folder"),
        (lambda: uavctl.read(ROOT / "README.md"), RecordingError, "README.md"),
        (lambda: uavctl.plot(3), UsageError, "a int has no figure"),  # type: ignore[arg-type]
        (lambda: uavctl.plot([], path="a.pdf"), UsageError, "a list has no figure"),
        (lambda: uavctl.plot([], path="a.mcap"), UsageError, "no file of a figure"),
        (lambda: uavctl.plot([], width="wide"), UsageError, "'wide'"),  # type: ignore[arg-type]
    ],
)
def test_an_error_is_reported_plainly(wrong: Callable[[], object], error: type[Exception], message: str) -> None:
    with pytest.raises(error) as raised:
        wrong()
    assert message in str(raised.value)


def test_an_infinite_input_is_reported() -> None:
    with pytest.raises(ControllerError, match="step 0"):
        uavctl.controller("room", "lqg").step([1e308] * 9)


OWN_CONTROLLERS = """
import numpy as np

class Flat:
    def __init__(self, problem):
        self.n_u = problem.plant.n_u

    def begin(self, runs):
        pass

    def act(self, information):
        return np.zeros(self.n_u)

class Nan(Flat):
    def act(self, information):
        inputs = np.zeros((len(information.newest), self.n_u))
        inputs[1::2] = np.nan
        return inputs if len(inputs) > 1 else inputs * np.nan
"""


def test_a_wrong_answer_names_the_controller_and_what_to_give(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "wrong_answers.py").write_text(OWN_CONTROLLERS)
    monkeypatch.syspath_prepend(str(tmp_path))
    for fly, shape in (
        (lambda kind: uavctl.simulate("room", kind, runs=5, steps=3), (5, 3)),
        (lambda kind: uavctl.controller("room", kind).step([0.0] * 9), (1, 3)),
    ):
        with pytest.raises(ControllerError) as raised:
            fly("wrong_answers:Flat")
        assert "wrong_answers:Flat" in str(raised.value)
        assert f"give {shape}" in str(raised.value)
    with pytest.raises(ControllerError, match="wrong_answers:Nan"):
        uavctl.controller("room", "wrong_answers:Nan").step([0.0] * 9)
    runs = uavctl.simulate("room", "wrong_answers:Nan", runs=5, steps=3)
    assert runs.failed.tolist() == [False, True, False, True, False]
    assert [bool(error) for error in runs.errors] == runs.failed.tolist()
    assert runs.errors[1] in repr(runs) and "wrong_answers:Nan" in runs.errors[1]


def test_a_recording_is_not_written_over(tmp_path: Path) -> None:
    config = uavctl.load("paper", PAPER)
    first = uavctl.fly(config, tmp_path, duration_s=2).recording.path.read_bytes()
    with pytest.raises(RecordingError):
        uavctl.fly(config, tmp_path, duration_s=2)
    assert (tmp_path / "flight.mcap").read_bytes() == first


@pytest.mark.usefixtures("control_may_fail")
@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_a_flight_that_breaks_off_leaves_a_whole_recording(
    error: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from uavctl.loop import ControlLoop
    from uavctl.records import Ticked

    def fail(self: ControlLoop, ticked: Ticked, **_: object) -> None:
        if ticked.decision.tick == 30:
            raise error

    monkeypatch.setattr(ControlLoop, "record_timing", fail)
    with pytest.raises(error):
        uavctl.fly(uavctl.load("paper", PAPER), tmp_path, duration_s=20)
    recording = uavctl.read(tmp_path / "flight.mcap")
    (end,) = recording.arrow("/uavctl/end").to_pylist()
    assert recording.arrow("/uavctl/decision").num_rows == 31
    assert end["cause"] == ("still flying" if error is KeyboardInterrupt else "the controller has failed")


@pytest.mark.slow
def test_a_flight_may_begin_on_the_ground_as_the_command_line_s_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], no_page: None
) -> None:
    given = uavctl.load("room", {"link.loss": 0.3})
    flight = uavctl.fly(given, tmp_path / "python", seed=3, duration_s=13, take_off_m=1.0, goto=(0.3, 0.0, -1.1))
    arguments = "loopback --set link.loss=0.3 --seed 3 --duration 13 --arm --takeoff 1.0 --goto 0.3,0,-1.1 --json --out"
    assert run([*arguments.split(), str(tmp_path / "typed")]) == 0
    output = json.loads(capsys.readouterr().out)
    assert read_messages(flight.recording.path) == read_messages(Path(output["recording"]))
    heights_m = -flight.position_m[:, 2]
    assert heights_m[0] == 0.0 and heights_m.max() > 0.9 and heights_m[-1] < 0.05
    assert np.hypot(flight.position_m[:, 0] - 0.3, flight.position_m[:, 1]).min() < 0.1
    assert flight.ending.as_ordered
