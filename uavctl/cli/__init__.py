"""Command line: joins configuration, controller, simulator and recorder; a module for each command or pair of them."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Mapping
from typing import NoReturn

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
INTERRUPTED = 130  # as a shell says of what SIGINT ended
_words: list[str] | None = None  # of the command line that this process runs; None if it is somebody else's


def main() -> None:
    """Run `uavctl`; end the process with the command's exit code."""
    # The matrices are small: BLAS threads only disturb the control loop. Read once, when numpy is imported.
    for variable in _THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
    # What is imported stays: to look through it again and again for garbage takes a fifth of the start.
    gc.disable()
    try:
        from uavctl.cli.app import run

        global _words
        _words = sys.argv[1:]
        code = run(_words, _imported)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        code = INTERRUPTED
    _end(code)


def _end(code: int) -> NoReturn:
    """End the process, at once where a daemon thread is left.

    A thread that waits for standard input holds the stream's lock, and the interpreter's own end aborts on it.
    """
    if any(thread.daemon for thread in threading.enumerate()):
        sys.stdout.flush()
        os._exit(code)
    sys.exit(code)


def start_anew(environ: Mapping[str, str]) -> None:
    """Run this process's command line again with this environment; do nothing in a process that is not `uavctl`."""
    if _words is not None:
        sys.stdout.flush()
        os.execve(sys.executable, [sys.executable, "-m", "uavctl", *_words], dict(environ))


def _imported() -> None:
    gc.freeze()
    gc.enable()
