"""Decisions and ticks of a flight are timed, and compared with an earlier run."""

from __future__ import annotations

import gc
import json
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console

from sim.simulation import World
from uavctl.arrays import Array
from uavctl.cli.app import run
from uavctl.cli.bench import Bench, read_bench, render_bench
from uavctl.config import load_config
from uavctl.errors import UavctlError
from uavctl.lab.bench.decision import DecisionBench, Quantiles, time_decision, time_questions
from uavctl.lab.bench.tick import TickBench
from uavctl.loop import ControlLoop
from uavctl.records import Plan, Record, SolveStatus
from uavctl.smpc.answer import NOMINAL, Answer, Preview
from uavctl.wiring.controller import build_controller

QUESTIONS = [(np.array([float(i)]), np.zeros(1), NOMINAL) for i in range(3)]


class Stub:
    """Answers nothing; notes its questions, and whether garbage was collected meanwhile."""

    def __init__(self) -> None:
        self.asked: list[float] = []
        self.collected: list[bool] = []

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        self.asked.append(float(x[0]))
        self.collected.append(gc.isenabled())
        return Answer.failed(seq, SolveStatus.FAILED, "stub")


class Breaks(Stub):
    """Breaks down once it is timed."""

    def solve(self, seq: int, x: Array, target: Array, preview: Preview = NOMINAL) -> Answer:
        if not gc.isenabled():
            raise ArithmeticError
        return super().solve(seq, x, target, preview)


def test_questions_are_timed_in_rounds_without_garbage_collection() -> None:
    stub = Stub()
    assert time_questions(stub, QUESTIONS, rounds=2).shape == (3,)
    assert stub.asked == [0, 1, 2] * 3  # warmed up, then two rounds
    assert stub.collected == [True] * 3 + [False] * 6
    assert gc.isenabled()


def test_garbage_is_collected_again_after_an_error() -> None:
    with pytest.raises(ArithmeticError):
        time_questions(Breaks(), QUESTIONS)
    assert gc.isenabled()


@pytest.mark.slow
def test_the_decisions_are_those_of_the_flight() -> None:
    config = load_config("room-hahn-stursberg", ["smpc.scheme=age-conditioned", "duration_s=6"])
    plans: list[Plan] = []

    class Plans:
        def put(self, topic: str, at_ns: int, record: Record) -> None:
            if isinstance(record, Plan):
                plans.append(record)

    World(config, ControlLoop(config, build_controller(config), Plans(), lambda: 0)).run(config.duration_s)
    measured = time_decision(config)
    assert measured.questions == len(plans) > 10
    assert 0.0 < measured.us.p50 <= measured.us.p99 <= measured.us.max and measured.first_us > 0.0
    assert measured.printed_us is None  # the printed problem is another scheme


@pytest.mark.slow
def test_the_printed_problem_is_timed_where_the_scheme_has_it() -> None:
    measured = time_decision(load_config("paper", ["duration_s=20"]))
    assert measured.printed_us is not None and measured.printed_us > measured.us.p50


def test_a_flight_without_decisions_is_refused() -> None:
    with pytest.raises(UavctlError, match="no decision"):
        time_decision(load_config("room", ["duration_s=0.1"]))


def make_bench(us: float) -> Bench:
    times = Quantiles(p50=us, p99=2 * us, max=3 * us)
    tick = TickBench(ticks=20, sent_us=times, lateness_us=times, step_us=times, missed_ticks=0, dropped=0)
    return Bench(config="x", decision=DecisionBench(questions=9, us=times, first_us=us, printed_us=8 * us), tick=tick)


def test_figures_are_compared_with_those_of_the_last_run(tmp_path: Path) -> None:
    file = tmp_path / "last.json"
    file.write_bytes(msgspec.json.encode({"schema": "uavctl/bench/2", **msgspec.to_builtins(make_bench(200.0))}))
    shown = StringIO()
    console = Console(width=150, file=shown)
    console.print(render_bench(make_bench(500.0), read_bench(file, make_bench(500.0).config)))
    text = shown.getvalue()
    assert text.count("2.50") == 4 and "8 times" in text


@pytest.mark.parametrize("content", ["", "{}", '{"config": "x", "decision": 1}'])
def test_another_document_is_refused(content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "other.json"
    file.write_text(content)
    assert run(["bench", "--last", str(file)]) == 1
    assert str(file) in capsys.readouterr().err


def test_a_run_of_another_configuration_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "last.json"
    file.write_bytes(msgspec.json.encode(make_bench(500.0)))
    with pytest.raises(UavctlError, match="another-room"):
        read_bench(file, "another-room")


@pytest.mark.slow
def test_the_command_writes_both_answers(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "--seconds", "2", "--set", "duration_s=4", "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    result = msgspec.convert(document, Bench)
    assert document["schema"] == "uavctl/bench/2" and result.decision.questions > 5
    tick = result.tick
    assert 35 <= tick.ticks <= 41 and tick.dropped == 0  # of 50 ms, in 2 s
    assert 0.0 < tick.step_us.p50 <= tick.sent_us.max


def test_a_flight_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("uavctl.cli.bench.time_decision", lambda _: make_bench(1.0).decision)
    assert run(["bench", "--seconds", "1", "--set", f"log.free_bytes={10**15}"]) == 1
    assert "log.free_bytes" in capsys.readouterr().err
    assert run(["bench", "--seconds", "0"]) == 2
