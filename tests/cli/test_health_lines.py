"""Health lines of a daemon: written to standard error, and hidden in the daemon of a fleet."""

from __future__ import annotations

from contextvars import copy_context

import pytest

from uavctl.cli.health_lines import choose_line_writer, hide_health_lines

LINE = "track   age 0.05 s"


def test_a_line_is_written_to_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    choose_line_writer()(LINE)
    assert capsys.readouterr().err == f"{LINE}\n"


def test_a_daemon_of_a_fleet_writes_none(capsys: pytest.CaptureFixture[str]) -> None:
    def write_hidden() -> None:
        hide_health_lines()
        choose_line_writer()(LINE)

    copy_context().run(write_hidden)
    assert capsys.readouterr().err == ""
