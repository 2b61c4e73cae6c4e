"""Health lines of a daemon: written to standard error, and hidden in the daemon of a fleet."""

from __future__ import annotations

from contextvars import copy_context

import pytest
from patience import wait_until

from uavctl.cli.health_lines import hide_health_lines, write_health_lines

LINE = "track   age 0.05 s"


def test_a_line_is_written_to_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    with write_health_lines() as write:
        write(LINE)
        wait_until(lambda: capsys.readouterr().err == f"{LINE}\n", "the line")


def test_a_daemon_of_a_fleet_writes_none(capsys: pytest.CaptureFixture[str]) -> None:
    def write_hidden() -> None:
        hide_health_lines()
        with write_health_lines() as write:
            write(LINE)

    copy_context().run(write_hidden)
    with write_health_lines() as write:  # its line would come after a hidden one
        write("later")
        wait_until(lambda: capsys.readouterr().err == "later\n", "the later line, and no other")
