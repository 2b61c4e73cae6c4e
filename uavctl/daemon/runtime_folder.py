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
from uavctl.operating_system import check_flight_platform

RUN = Path("/run")
TEMPORARY = Path("/tmp")


def is_private_folder(folder: Path) -> bool:
    """Return whether this is a folder that only this user may enter; a link to one is none."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o077


def find_runtime_folders(environ: Mapping[str, str] = os.environ) -> tuple[Path, ...]:
    """Find, or make, this user's folders for locks and sockets; the preferred one is first.

    Below $XDG_RUNTIME_DIR and /run/user/UID if these are the user's own; /run/uavctl, which a service has; and one
    below /tmp. What another user has put into the way, root included, is passed over.

    Raises:
        UsageError: there is none.
        PlatformError: this operating system cannot fly.
    """
    check_flight_platform()
    user_id = os.geteuid()
    xdg_folder = Path(environ.get("XDG_RUNTIME_DIR") or "/")
    bases = [base for base in (xdg_folder, RUN / "user" / str(user_id)) if base.is_absolute() and base != Path("/")]
    temporary_folder = TEMPORARY / f"uavctl-{user_id}"
    candidates = [*(base / "uavctl" for base in bases if is_private_folder(base)), temporary_folder]
    for folder in candidates:
        with suppress(OSError):
            folder.mkdir(mode=0o700, exist_ok=True)
    folders = tuple(
        dict.fromkeys(
            folder for folder in (*candidates[:-1], RUN / "uavctl", temporary_folder) if is_private_folder(folder)
        )
    )
    if not folders:
        raise UsageError(
            f"{temporary_folder}: not a folder of this user alone, and XDG_RUNTIME_DIR names none, so there is no safe "
            f"place for lock and socket; see whose it is, and remove it (sudo rm -r {temporary_folder}) or run: "
            f"chmod 700 {temporary_folder}"
        )
    return folders
