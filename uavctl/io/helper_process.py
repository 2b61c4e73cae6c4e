"""Helper process of a flight: a Python module at the other end of a pair of sockets that keeps message bounds.

The process ends when the pair is closed: by `close`, or by the system once the flight's process has gone.
"""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Sequence

from uavctl.operating_system import check_flight_platform

_END_S = 2.0  # for the process to end by itself
MAX_RESTARTS = 3  # of a helper process that ends while it is needed


class HelperProcess:
    """A helper process and the flight's end of the pair.

    Args:
        module: Run with the number of its end as the first argument.
        arguments: Further arguments.
        descriptors: Passed on with the same numbers.
        stderr: See `subprocess.Popen`. By default it has none: a console that nobody reads would hold it up.

    Attributes:
        socket: The flight's end.
        process: The process.

    Raises:
        OSError: The system does not allow that now: no memory, no descriptor, or too many processes.
        PlatformError: This operating system cannot fly.
    """

    def __init__(
        self,
        module: str,
        arguments: Sequence[str],
        *,
        descriptors: Sequence[int] = (),
        stderr: int | None = subprocess.DEVNULL,
    ) -> None:
        check_flight_platform()
        self.socket, peer = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with peer:
            number = peer.fileno()
            try:
                self.process: subprocess.Popen[bytes] = subprocess.Popen(
                    [sys.executable, "-P", "-m", module, str(number), *arguments],
                    pass_fds=(number, *descriptors),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                    start_new_session=True,  # an interrupt is for the flight
                )
            except OSError:
                self.socket.close()
                raise

    def close(self) -> None:
        """Close the pair; the process ends, or is killed."""
        self.socket.close()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
