"""What is said on a daemon's control socket, and where its socket is.

One JSON object a line in each direction: a `Request`, then its `Reply`.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import msgspec

from uavctl.config import Config
from uavctl.data import Vec3
from uavctl.errors import UsageError
from uavctl.health import Health
from uavctl.runtime_folder import runtime_folders

FOLDER_VARIABLE = "UAVCTL_CONTROL"
SUFFIX = ".sock"
MAX_LINE = 4096  # bytes of a request
_LONGEST_NAME = 48
_LONGEST_PATH = 107  # bytes that the kernel takes for the path of a socket


class Request(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A question or an order."""

    ask: Literal["goto", "hold", "resume", "land", "engage", "status"]
    position_m: Vec3 | None = None  # local NED; with goto only

    def problem(self) -> str | None:
        """What is wrong with it as such; None if nothing is."""
        if (self.ask == "goto") != (self.position_m is not None):
            return "goto needs a position_m" if self.position_m is None else f"{self.ask} takes no position_m"
        if self.position_m is not None and not all(map(math.isfinite, self.position_m)):
            return "position_m has to be finite"
        return None


class Reply(msgspec.Struct, frozen=True, kw_only=True):
    """What was decided on an order, or the flight as it is."""

    ok: bool
    text: str
    status: Health | None = None


def daemon_name(config: Config) -> str:
    """Name of the daemon that flies a configuration: that of the configuration, and the vehicle's URL."""
    url = config.daemon.vehicle.replace("://", "-")
    return re.sub(r"[^A-Za-z0-9.]+", "-", f"{config.name}-{url}").strip("-.")[:_LONGEST_NAME]


def control_folder(chosen: Path | None, environ: Mapping[str, str] = os.environ) -> Path:
    """Folder of the sockets: as chosen, else $UAVCTL_CONTROL, else the user's own runtime folder.

    Raises:
        UsageError: the user has none.
    """
    if chosen is not None:
        return chosen
    if environ.get(FOLDER_VARIABLE):
        return Path(environ[FOLDER_VARIABLE])
    return runtime_folders(environ)[0]


def socket_path(folder: Path, name: str) -> Path:
    """Where the daemon of this name listens.

    Raises:
        UsageError: the path is too long for a socket.
    """
    path = folder / f"{name}{SUFFIX}"
    if len(os.fsencode(path)) > _LONGEST_PATH:
        raise UsageError(
            f"{path}: longer than the {_LONGEST_PATH} bytes of a socket's path; choose a shorter folder with --control"
        )
    return path
