"""A summary that nobody reads: the program ends all the same, and says so."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import sys
from uavctl import cli
from uavctl.cli import error_stream
from uavctl.errors import OutputError

error_stream.OUTPUT_LIMIT_S = 0.5
cli.prepare_streams()
try:
    with error_stream.limit_output_wait():
        sys.stdout.write("x" * 10**6)
        sys.stdout.flush()
except OutputError:
    cli._end_process(7)
cli._end_process(0)
"""


@pytest.mark.fault(89)
@pytest.mark.parametrize("is_gone", [False, True])
def test_89_output_that_nobody_reads_ends_in_an_error(is_gone: bool) -> None:
    reader, writer = os.pipe()
    with subprocess.Popen([sys.executable, "-c", PROGRAM], stdout=writer) as process:
        os.close(writer)
        if is_gone:
            os.close(reader)
        try:
            assert process.wait(30.0) == 7
        finally:
            process.kill()
            if not is_gone:
                os.close(reader)


def test_output_that_is_read_arrives_whole() -> None:
    result = subprocess.run([sys.executable, "-c", PROGRAM], stdout=subprocess.PIPE, check=False)
    assert (result.returncode, len(result.stdout)) == (0, 10**6)
