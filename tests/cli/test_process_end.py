"""End of a process: its exit code and its output arrive though a thread still waits for standard input."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys, threading, time
from uavctl import cli

threading.Thread(target=sys.stdin.buffer.readline, daemon=True).start()
time.sleep(0.2)
sys.stdout.write('{"ok": true}')
{end}
"""


def run_program(end: str) -> tuple[int, str]:
    """Exit code and standard output of the program, to whose standard input nobody writes."""
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM.replace("{end}", end)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        try:
            code, output = process.wait(30.0), process.stdout.read()
        finally:
            process.kill()
    return code, output


def test_a_thread_that_waits_for_input_changes_no_exit_code() -> None:
    assert run_program("sys.exit(3)")[0] < 0  # the interpreter's own end is an abort
    assert run_program("cli._end_process(3)") == (3, '{"ok": true}')
