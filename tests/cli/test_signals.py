"""Signals that end a command: which are handled, what the second one does, what is as before afterwards."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from uavctl.cli import flying
from uavctl.cli.app import run
from uavctl.cli.signals import DELIBERATE, END_LIMIT_S, stop_on_signals
from uavctl.errors import EndedBySignal

NAMES = ("HUP", "INT", "QUIT", "TERM", "USR1", "USR2", "ALRM", "VTALRM", "PROF", "XCPU", "IO", "PWR", "SYS", "TRAP")
KILLING = [
    *(signal.Signals[f"SIG{name}"] for name in NAMES),
    *(number for number in signal.valid_signals() if number >= signal.SIGRTMIN),
]


@pytest.mark.fault(86)
@pytest.mark.parametrize("number", KILLING)
def test_each_signal_that_would_kill_asks_for_the_end(number: int) -> None:
    found = signal.getsignal(number)
    before = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    signal.signal(number, before)  # nohup and shells in the background ignore some
    try:
        with stop_on_signals() as stopped:
            assert not stopped()
            signal.raise_signal(number)
            assert stopped()
            if number not in DELIBERATE:
                signal.raise_signal(number)  # timers and closed terminals repeat theirs
        assert signal.getsignal(number) == before
    finally:
        signal.signal(number, found)


@pytest.mark.fault(86)
@pytest.mark.parametrize("number", sorted(DELIBERATE))
def test_a_second_deliberate_signal_ends_the_command_and_sets_a_limit_for_that(number: int) -> None:
    with pytest.raises(EndedBySignal) as raised, stop_on_signals():
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(number)
    assert raised.value.code == 128 + number
    assert 0 < signal.alarm(0) <= END_LIMIT_S
    assert signal.getsignal(signal.SIGALRM) == signal.SIG_DFL


@pytest.mark.fault(86)
def test_an_ignored_signal_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    try:
        with stop_on_signals() as stopped:
            signal.raise_signal(signal.SIGHUP)
            assert not stopped()
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.fault(86)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_after_the_flight_cuts_neither_its_page_nor_its_answer(
    number: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Path] = []

    def draw_page(path: Path, summary: object, page: Path) -> None:
        del path, summary
        signal.raise_signal(number)
        drawn.append(page)

    reached: list[int] = []
    before = signal.signal(number, lambda number, _: reached.append(number))
    if number not in DELIBERATE:
        signal.signal(number, signal.SIG_DFL)  # others are handled only where they would kill
    monkeypatch.setattr(flying, "draw_page", draw_page)
    try:
        code = run(["loopback", "--duration", "1", "--out", str(tmp_path / "f"), "--json"])
    finally:
        signal.signal(number, before)
    assert code == 0 and not reached
    assert json.loads(capsys.readouterr().out)["report"] == str(drawn[0])
