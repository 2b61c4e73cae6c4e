"""Runtime folders of a user, for locks and control sockets. No other user can enter them.

The first one is usually that of the login session. A service or a cron job of the same user may have none. So there is
one more folder that every process of the user finds in any environment.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from uavctl.errors import UsageError

RUN = Path("/run")
TEMPORARY = Path("/tmp")


def is_private_folder(folder: Path) -> bool:
    """Whether this is a folder of this user, that no other one may enter; a link to one is none."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o077


def find_runtime_folders(environ: Mapping[str, str] = os.environ) -> tuple[Path, ...]:
    """This user's folders for locks and sockets, those that can be had, the preferred one first; made if need be.

    Below $XDG_RUNTIME_DIR and /run/user/UID if these are the user's own; /run/uavctl, which a service has; and one
    below /tmp. What another user has put into the way, root included, is passed over.

    Raises:
        UsageError: there is none.
    """
    user = os.geteuid()
    given = Path(environ.get("XDG_RUNTIME_DIR") or "/")
    bases = [base for base in (given, RUN / "user" / str(user)) if base.is_absolute() and base != Path("/")]
    last = TEMPORARY / f"uavctl-{user}"
    wanted = [*(base / "uavctl" for base in bases if is_private_folder(base)), last]
    for folder in wanted:
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
    found = tuple(dict.fromkeys(one for one in (*wanted[:-1], RUN / "uavctl", last) if is_private_folder(one)))
    if not found:
        raise UsageError(
            f"{last}: not a folder of this user alone, and XDG_RUNTIME_DIR names none, so there is no safe place for "
            f"lock and socket; see whose it is, and remove it (sudo rm -r {last}) or run: chmod 700 {last}"
        )
    return found
