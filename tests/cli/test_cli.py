"""The command line as it is typed: exit codes, what goes where, refusals."""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

from uavctl import __version__
from uavctl.cli.app import app, run
from uavctl.cli.common import make_progress

PRESET = ROOT / "uavctl" / "presets" / "paper.toml"
STATE = "35,-2,-20,-4"


def run_command(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    code = run(arguments)
    output = capsys.readouterr()
    return code, output.out, output.err


def run_document(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    code, out, _ = run_command(capsys, *arguments, "--json")
    assert code == 0
    assert out.count("\n") == 1  # one document, on a line of its own
    run_document: dict[str, Any] = json.loads(out)
    name = re.fullmatch(r"uavctl/([a-z/-]+)/[1-9][0-9]*", run_document.pop("schema"))
    assert name is not None and name[1] == arguments[0]
    return run_document


@pytest.mark.parametrize(
    ("arguments", "kind", "code", "message"),
    [
        (("log", "info", "there/is/none.mcap"), "RecordingError", 1, "none.mcap"),
        (("solve", "--config", "paper", "--state=1,2"), "UsageError", 2, "give 4 numbers"),
        (("solve", "--config", "paper", "--sate=1,2"), "UsageError", 2, "--sate"),
        (("fly", "--config", "there/is/none.toml"), "ConfigError", 2, "none.toml"),
        (("flyy",), "UsageError", 2, "flyy"),
    ],
)
def test_an_error_is_a_document_too(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], kind: str, code: int, message: str
) -> None:
    without, _, _ = run_command(capsys, *arguments)
    ended, out, err = run_command(capsys, *arguments, "--json")
    run_document = json.loads(out)
    assert (ended, without) == (code, code) and out.count("\n") == 1
    assert message in run_document.pop("message") and message in err
    assert run_document == {"schema": "uavctl/error/1", "type": kind, "exit_code": code}


def test_every_command_names_its_document() -> None:
    # Whoever writes a document gives its name, and no two commands the same one.
    given = re.compile(r"""(?:\.show|write_document)\(\s*"([a-z/-]+)\"""")
    names = [
        name for file in sorted((ROOT / "uavctl" / "cli").glob("*.py")) for name in given.findall(file.read_text())
    ]
    assert len(names) == len(set(names)) > 20


def test_solve_gives_the_paper_s_cost(capsys: pytest.CaptureFixture[str]) -> None:
    answer = run_document(capsys, "solve", "--config", "paper", "--state", STATE)
    assert {
        "status", "cost", "cost_lower", "gap", "inputs", "states", "backoff_x", "backoff_u", "slack", "method",
        "solve_us",
    } <= answer.keys()  # fmt: skip
    assert answer["status"] == "optimal" and answer["method"] in ("frozen", "mixture", "exact")
    assert answer["cost_lower"] - 0.01 <= 61669.93 <= answer["cost"] + 0.01
    assert answer["gap"] <= 1e-3 and answer["gave_way"] == []
    assert answer["inputs"][0] == pytest.approx([-7.5, 7.5], abs=1e-6)
    assert (len(answer["states"]), len(answer["inputs"])) == (13, 12)
    assert answer["states"][0] == [35.0, -2.0, -20.0, -4.0]


def test_solve_shows_people_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run_command(capsys, "solve", "--config", "paper", "--method", "exact", "--state", STATE)
    assert code == 0
    assert "method exact: optimal" in out and "61669.93" in out and "gap" in out and "v_e" in out


def test_solve_names_relaxed_constraints(capsys: pytest.CaptureFixture[str]) -> None:
    outside = "49,-2,-20,-14"
    answer = run_document(capsys, "solve", "--config", "paper", "--state", outside)
    assert answer["method"] == "exact" and answer["slack"] > 10
    assert {"constraint", "stage", "index", "amount"} == answer["gave_way"][0].keys()
    code, out, _ = run_command(capsys, "solve", "--config", "paper", "--state", outside)
    assert code == 0
    assert "lower limit of east position" in out and "relaxed by" in out


@pytest.mark.parametrize("state", ["1,2", "1,2,3,x", "1,2,3,nan", ""])
def test_a_state_that_is_none_is_refused(capsys: pytest.CaptureFixture[str], state: str) -> None:
    code, out, err = run_command(capsys, "solve", "--config", "paper", f"--state={state}")
    assert (code, out) == (2, "")
    assert "give 4 numbers" in err


def test_design_shows_assumption_4_with_figures(capsys: pytest.CaptureFixture[str]) -> None:
    result = run_document(capsys, "design", "--config", "paper")
    assert {
        "tau", "delays", "alpha", "gamma_x", "gamma_u", "spectral_radius", "assumptions", "design_id",
        "wall_s",
    } <= result.keys()  # fmt: skip
    assert (result["tau"], result["delays"]) == (4, [5] * 12)
    assert result["spectral_radius"] == pytest.approx(0.9714, abs=5e-5)
    assert [check["item"] for check in result["assumptions"]] == ["4.1", "4.2", "4.3", "4.4", "4.5"]
    assert all(check["ok"] and {"value", "limit"} <= check.keys() for check in result["assumptions"])
    assert result["assumptions"][0]["value"] == pytest.approx(1 - 0.3**5)
    code, out, _ = run_command(capsys, "design", "--config", "paper")
    assert code == 0
    assert "Assumption 4" in out and "0.9976" in out


WRONG = {
    "unknown key": (("horizon = 12", "horizn = 12"), "smpc.horizn", "unknown key", 'nearest valid name "horizon"'),
    "wrong shape": (("[0.0, 0.61, 0.0, 0.0], ", ""), "plant.a", "is 3 x 4", "give 3 rows of 3 numbers"),
    "target too near the limits": (
        ("position_m = [0.0,", "position_m = [45.0,"), "target.position_m", "Assumption 4.3 fails", "move the target",
    ),
    "tau as long as the horizon": (("tau = 4", "tau = 12"), "smpc.tau", "do not fit into", "longer horizon"),
    "tau too long for the horizon": (("tau = 4", "tau = 11"), "smpc.tau", "free steps", "smpc.horizon of at least"),
    "unstable gain": (("[-0.058, -1.172, 0.0", "[-0.6, -1.2, 0.0"), "smpc.k_tau", "unstable", "smaller gain"),
    "W is no covariance": (
        ("w = [[0.6, 0.0], [0.0, 0.6]]", "w = [[0.6, 0.7], [0.7, 0.6]]"), "plant.w", "not positive semidefinite",
        "give a covariance",
    ),
    "delta out of reach": (("delta_x = 0.95", "delta_x = 0.995"), "smpc.delta_x", "out of reach", "lower it"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_a_wrong_configuration_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path, what: str) -> None:
    (old, new), key, reason, todo = WRONG[what]
    text = PRESET.read_text(encoding="utf-8")
    assert text.count(old) == 1
    file = tmp_path / "mine.toml"
    file.write_text(text.replace(old, new), encoding="utf-8")
    code, out, err = run_command(capsys, "design", "--config", str(file), "--json")
    assert (code, json.loads(out)["type"]) == (2, "ConfigError")
    name = key.partition(".")[2]
    lines = enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
    line = next(number for number, content in lines if content.startswith(f"{name} ="))
    (error_line,) = [each for each in err.splitlines() if f"{file}:{line}: {key}: " in each]
    assert reason in error_line
    assert todo in error_line.partition(reason)[2] or todo in error_line
    assert "Traceback" not in err


def test_overrides_repeat_and_their_errors_name_them(capsys: pytest.CaptureFixture[str]) -> None:
    result = run_document(
        capsys, "design", "--config", "paper", "--set", "smpc.tau=3", "--set", "schedule.delays=4",
        "--set", "smpc.delta_x=0.9", "--set", "sets.state_lower=[-90, -20, -90, -20]",
        "--set", "sets.state_upper=[90, 20, 90, 20]", "--set", "solver.method=exact",
    )  # fmt: skip
    assert (result["tau"], result["delays"]) == (3, [4] * 12)
    code, out, err = run_command(capsys, "design", "--set", "link.los=0.3", "--set", "smpc.tau=0")
    assert (code, out) == (2, "")
    assert "--set link.los=0.3: link.los: unknown key" in err
    assert "--set smpc.tau=0: smpc.tau: " in err and ">= 1, got 0" in err


@pytest.mark.parametrize(
    "arguments", [("desgn",), ("solve",), ("design", "--confg", "paper"), ("solve", "--method", "x")]
)
def test_usage_errors_exit_with_2(capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]) -> None:
    code, out, err = run_command(capsys, *arguments)
    assert (code, out) == (2, "")
    assert err


def test_help_lists_commands_and_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = run_command(capsys, "--help")
    assert code == 0
    assert re.search(r"Exit codes: 0 \w.*; 1 .*; 2 .* configuration", " ".join(out.split()))
    for name in ("loopback", "fly", "sim", "design", "solve", "bench", "log"):
        assert name in out
        assert app[name].help  # the module is there, and has the function that is named


def test_a_fresh_process_writes_one_document_and_keeps_to_one_thread() -> None:
    # The variable only counts if it is set before numpy is imported.
    script = (
        "import atexit, os, sys; from uavctl.cli import main; assert 'numpy' not in sys.modules;"
        "atexit.register(lambda: sys.stderr.write(os.environ['OMP_NUM_THREADS'])); main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "design", "--config", "paper", "--set", "solver.method=exact", "--json"],
        env={name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"},
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "1")
    assert json.loads(done.stdout)["tau"] == 4
    done = subprocess.run(
        [sys.executable, "-m", "uavctl", "--version"], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.stdout.strip() == __version__


def test_an_interruption_is_one_line(tmp_path: Path) -> None:
    """Also while modules are imported, which takes most of a short command's time."""
    command = [sys.executable, "-X", "importtime", "-m", "uavctl", "log", "info", str(tmp_path / "flight.mcap")]
    # A shell has what it runs in the background ignore interruptions, and so do all that this starts.
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    )
    assert process.stderr is not None
    # What is not read yet holds it up: else a machine that is busy lets it end before it is interrupted.
    fcntl.fcntl(process.stderr, fcntl.F_SETPIPE_SZ, 4096)
    lines = iter(process.stderr.readline, "")
    assert any("cyclopts" in line for line in lines)
    process.send_signal(signal.SIGINT)
    rest = [line for line in lines if not line.startswith("import time:")]
    process.stderr.close()
    assert (process.wait(), rest) == (130, ["interrupted\n"])


@pytest.mark.parametrize(("arguments", "message"), [(["replay", "x.mcap"], '"replay"'), (["flyy"], '"fly"')])
def test_a_wrong_command_is_refused(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = run_command(capsys, *arguments)
    assert (code, out) == (2, "")
    assert message in err and err.startswith("error:") and err.count("\n") == 1


@pytest.mark.parametrize("place", [["-1,0,-1"], ["-1", "0", "-1"], ["-1.5", "-0.5", "-1e0"]])
def test_a_place_below_zero_is_taken_with_commas_and_with_spaces(
    place: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["ctl", "goto", *place, "--control", str(tmp_path)]) != 2
    assert "no daemon answers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"), [(["-1", "0"], "write three numbers"), (["1", "0", "-1", "--contrl", "x"], "--contrl")]
)
def test_a_wrong_position_is_refused(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["ctl", "goto", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_progress_is_printed_in_lines_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = 0.0
    with make_progress() as progress:
        progress.get_time = lambda: now_s
        task = progress.add_task("flights", total=40_000)
        for _ in range(20):
            now_s += 1.0
            progress.advance(task, 1000)
        page = progress.add_task("", total=None)
        now_s += 7.0
        progress.update(page, description="the page")
    # The first word says when it began, so that what is quick says nothing.
    assert capsys.readouterr().err.splitlines() == [
        "flights: 6000 of 40000 (6 s)",
        "flights: 11000 of 40000 (11 s)",
        "flights: 16000 of 40000 (16 s)",
        "the page (7 s)",
    ]


def test_the_manual_is_shown_page_by_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["docs"]) == 0
    listed = capsys.readouterr().out
    for path in (ROOT / "docs").glob("*.md"):
        assert f" {path.stem} " in listed
    for named in ("faults", "faults.md", "docs/faults.md"):
        assert run(["docs", named]) == 0
        assert capsys.readouterr().out == (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")
    assert run(["docs", "fault"]) == 2
    assert 'There is no page "fault" (nearest valid name "faults")' in capsys.readouterr().err
    assert run(["docs", "../README"]) == 2


def test_the_manual_page_lists_every_command_with_its_options() -> None:
    text = (ROOT / "docs" / "uavctl.1").read_text(encoding="utf-8").replace("\\-", "-")
    for heading, option in (
        (".SH UAVCTL LOOPBACK", "--takeoff FLOAT"), (".SH UAVCTL FLY", "--realtime"),
        (".SS uavctl log replay", "--tolerance FLOAT"), (".SS uavctl ctl status", "--json"),
    ):  # fmt: skip
        section = re.split(r"^\.S[HS] ", text.partition(f"{heading}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]
        assert f".TP\n.B {option}\n" in section
