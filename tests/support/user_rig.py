"""Another user of the machine, as far as there can be one."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

NOBODY = 65_534
# Only root can become somebody else; as any other user the other one is oneself.
OTHER = NOBODY if os.geteuid() == 0 else os.geteuid()


def run_as_other_user(does: Callable[[], str]) -> str:
    """What a function of a process of the other user's gives, or the name of the error that it raises."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of other threads: the child needs none of them
        child = os.fork()
    if child == 0:
        text = ""
        try:
            if os.geteuid() == 0:
                os.setgroups([])
                os.setgid(NOBODY)
                os.setuid(NOBODY)
            text = does()
        except BaseException as error:  # noqa: BLE001 (whatever it is, the other process has to hear of it)
            text = f"{type(error).__name__}: {error}"
        finally:
            os.write(writing, text.encode())
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    return text


@contextmanager
def shared_folder() -> Iterator[Path]:
    """A folder like /tmp."""
    with tempfile.TemporaryDirectory(prefix="uavctl-users-", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o1777)
        yield folder
