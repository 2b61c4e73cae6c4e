"""Command line: it joins configuration, controller, simulator and recorder; a module for each command or pair."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Mapping
from traceback import format_exc
from typing import NoReturn

from uavctl.cli.error_stream import discard_output, finish_streams, prepare_streams

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
INTERRUPTED = 130  # exit code of a shell for a command that SIGINT ended
_arguments: list[str] | None = None  # of the command line of this process; None in a process that is not `uavctl`


def main() -> None:
    """Run `uavctl`; end the process with the command's exit code."""
    # The matrices are small: BLAS threads only disturb the control loop. numpy reads this once, at its import.
    for variable in _THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
    # Imported modules stay: the search for garbage among them would take a fifth of the start.
    gc.disable()
    prepare_streams()
    try:
        from uavctl.cli.app import run

        global _arguments
        _arguments = sys.argv[1:]
        code = run(_arguments, _freeze_imports)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        finish_streams()
        # At its end the interpreter would kill itself by the signal, if that came while a dataclass was made.
        os._exit(INTERRUPTED)
    except BrokenPipeError:  # the reader of standard output has gone
        discard_output()
        code = 1
    except Exception:  # noqa: BLE001 an error that nobody expected
        sys.stderr.write(format_exc())
        code = 1
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    _end_process(code)


def _end_process(code: int) -> NoReturn:
    """End the process, at once where a daemon thread is left.

    A thread that waits for standard input holds the lock of the stream; the end of the interpreter would abort on it.
    """
    finish_streams()
    if any(thread.daemon for thread in threading.enumerate()):
        os._exit(code)
    sys.exit(code)


def restart_process(environ: Mapping[str, str]) -> None:
    """Restart this process with its command line and this environment; do nothing if the process is not `uavctl`."""
    if _arguments is not None:
        finish_streams()
        os.execve(sys.executable, [sys.executable, "-m", "uavctl", *_arguments], dict(environ))


def _freeze_imports() -> None:
    gc.freeze()
    gc.enable()
