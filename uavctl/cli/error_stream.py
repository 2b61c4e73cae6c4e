"""Standard streams of the process: standard error that never holds up a flight, and standard output of any encoding."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOBase
from types import FrameType

from uavctl.errors import OutputError

MAX_WAITING_BYTES = 2**20  # of text that nobody reads
END_LIMIT_S = 1.0  # for the last text at the end of the process
_POLL_S = 1.0
OUTPUT_LIMIT_S = 5.0  # for the summary at the end of a flight


class BackgroundStream(TextIOBase):
    """Text stream that a thread writes to a file descriptor; no method waits for the reader, none raises.

    Text that finds no room is dropped. After a failed write (a closed pipe, a terminal that is gone) all text is.

    Attributes:
        waiting_bytes: Bytes of text that are not written yet.
    """

    def __init__(self, descriptor: int, encoding: str) -> None:
        self._descriptor, self._encoding = descriptor, encoding
        self._is_terminal = os.isatty(descriptor)
        self._chunks: deque[bytes] = deque()
        self.waiting_bytes = 0
        self._is_broken = self._is_finished = False
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    @property
    def encoding(self) -> str:  # type: ignore[override]  # a plain attribute in typeshed
        """Encoding of the text."""
        return self._encoding

    @property
    def errors(self) -> str:  # type: ignore[override]
        """Treatment of characters that the encoding lacks."""
        return "backslashreplace"

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._descriptor

    def isatty(self) -> bool:
        """Return whether the stream is a terminal."""
        return self._is_terminal

    def writable(self) -> bool:
        """Return whether the stream takes text."""
        return True

    def flush(self) -> None:
        """Do nothing: the thread writes at once."""

    def write(self, text: str) -> int:
        """Queue text for the thread, if there is room for it."""
        data = text.encode(self._encoding, self.errors)
        with self._changed:
            if self._thread is None:
                self._start()
            if data and not self._is_broken and self.waiting_bytes + len(data) <= MAX_WAITING_BYTES:
                self._chunks.append(data)
                self.waiting_bytes += len(data)
                self._changed.notify_all()
        return len(text)

    def finish(self) -> None:
        """End the thread once all text is written; wait for that for a limited time."""
        with self._changed:
            self._is_finished = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(END_LIMIT_S)

    def _start(self) -> None:
        self._thread = threading.Thread(target=self._run, name="standard error", daemon=True)
        try:
            self._thread.start()
        except (RuntimeError, MemoryError):  # no room for another thread: tried again with the next text
            self._thread = None

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._chunks or self._is_finished)
                if not self._chunks:
                    return
                data = self._chunks.popleft()
            is_written = _write_all(self._descriptor, data)
            with self._changed:
                self.waiting_bytes -= len(data)
                if not is_written:
                    self._is_broken, self.waiting_bytes = True, 0
                    self._chunks.clear()


def _write_all(descriptor: int, data: bytes) -> bool:
    """Write all bytes; return whether that succeeded."""
    remaining = memoryview(data)
    while remaining:
        try:
            remaining = remaining[os.write(descriptor, remaining) :]
        except BlockingIOError:  # another program has made the descriptor non-blocking
            select.select([], [descriptor], [], _POLL_S)
        except OSError:
            return False
    return True


def prepare_streams() -> None:
    """Prepare the standard streams of this process, also closed ones.

    1. Open a closed standard stream on the null device: else the next file that is opened would take its number.
    2. Let standard output write characters that its encoding lacks as escapes.
    3. Write standard error from a thread of its own.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
    sys.stdin = sys.stdin or open(0, closefd=False)  # noqa: SIM115 open to the end
    sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="backslashreplace")
    encoding = "utf-8" if sys.stderr is None else sys.stderr.encoding
    sys.stderr = BackgroundStream(2, encoding)


@contextmanager
def limit_output_wait() -> Iterator[None]:
    """Let this block, which writes to standard output, wait for a reader for a limited time. Main thread only.

    Raises:
        OutputError: Nobody reads standard output; all further output is discarded.
    """
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def end_wait(number: int, frame: FrameType | None) -> None:
        del number, frame
        raise TimeoutError

    previous = signal.signal(signal.SIGALRM, end_wait)
    signal.setitimer(signal.ITIMER_REAL, OUTPUT_LIMIT_S)
    try:
        yield
    except (BrokenPipeError, TimeoutError) as error:
        discard_output()
        raise OutputError("standard output: it has no reader") from error
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL if previous is None else previous)


def discard_output() -> None:
    """Discard the buffer of standard output, and all that is written to it from now on."""
    with suppress(OSError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.close(null)


def finish_streams() -> None:
    """Write the rest of both streams, standard error for a limited time; then standard error is the system's again."""
    with suppress(OSError, ValueError):
        sys.stdout.flush()
    if isinstance(sys.stderr, BackgroundStream):
        sys.stderr.finish()
        sys.stderr = sys.__stderr__
