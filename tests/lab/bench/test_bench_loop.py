"""`uavctl bench --loop`: real processes on real UDP, a short run of each kind."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import numpy as np
import pytest

from uavctl.cli.app import run
from uavctl.lab.bench.loop import LoopBench, LoopRun, TimeQuantiles

NO_LIBRARY = ("--set", 'solver.method="exact"')  # none has to be made


def spread(us: float) -> TimeQuantiles:
    return TimeQuantiles(p50=us, p99=us, p999=us, max=us)


def make_run(us: float, missed: float = 0.0) -> LoopRun:
    return LoopRun(
        in_to_out_us=spread(us), lateness_us=spread(us), empty_lateness_us=spread(1.0), above_empty_us=us - 1.0,
        step_us=spread(us), positions=100.0, unanswered=0.0, missed_ticks=missed, recorded=1.0, dropped=0.0,
        memory_growth_kib=us, memory_mib=1.0,
    )  # fmt: skip


def test_a_spread_is_in_microseconds() -> None:
    times = TimeQuantiles.compute(np.arange(1001) * 1000)
    assert (times.p50, times.p99, times.p999, times.max) == (500.0, 990.0, 999.0, 1000.0)


def test_several_runs_give_the_median_of_each_figure() -> None:
    middle = LoopRun.compute_median([make_run(3.0, missed=9.0), make_run(1.0), make_run(2.0)])
    assert middle.in_to_out_us == spread(2.0) and middle.above_empty_us == 1.0
    assert middle.missed_ticks == 0.0 and middle.memory_growth_kib == 2.0


@pytest.mark.slow
def test_a_short_bench_gives_its_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "--loop", "--seconds", "2", "--runs", "1", "--json", *NO_LIBRARY]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    result = msgspec.convert(document, LoopBench)
    assert (result.seconds, result.runs, result.tick_s) == (2.0, 1, 0.05)
    for measured in (result.plain, result.realtime):
        assert 0 <= measured.unanswered < measured.positions == 40
        assert measured.recorded > measured.positions and measured.dropped == 0
        assert 0.0 < measured.in_to_out_us.p50 <= measured.in_to_out_us.p99 <= measured.in_to_out_us.max
        assert measured.memory_mib > 10.0


def test_a_daemon_that_does_not_start_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "--loop", "--seconds", "1", *NO_LIBRARY, "--set", f"log.free_bytes={10**15}"]) == 1
    assert "the daemon did not start" in capsys.readouterr().err
    assert run(["bench", "--loop", "--seconds", "0"]) == 2
