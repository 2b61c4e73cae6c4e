"""The flight's end of its node of ROS 2: a process that publishes the records sent to it, and takes orders."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from logs.live.feed_process import FeedProcess
from logs.live.ros2_view import OUTPUTS
from uavctl.errors import ExtraMissingError, UsageError
from uavctl.io.helper_process import HelperProcess
from uavctl.io.ros2_node import EXTRA

TRIGGER = "std_srvs/srv/Trigger"
_NAMESPACE = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)*", re.ASCII)


class Ros2Process(FeedProcess):
    """Process that publishes a flight below a namespace of ROS 2; see `FeedProcess`.

    Args:
        namespace: As `drone1`, without a slash at its begin.
        control: Folder and name of the daemon that gets orders; None: orders are not taken.

    Raises:
        UsageError: The namespace cannot be, or the process cannot be started.
        ExtraMissingError: A package of ROS 2 is not installed.
    """

    name = "ROS 2"

    def __init__(self, namespace: str, control: tuple[Path, str] | None, on_death: Callable[[str], None]) -> None:
        if not _NAMESPACE.fullmatch(namespace):
            raise UsageError(f"--ros2 {namespace}: no namespace; write letters, digits and _, as in --ros2 drone1")
        kinds = [*(output.kind for output in OUTPUTS.values()), TRIGGER]
        for package in ("rclpy", *(kind.partition("/")[0] for kind in kinds)):
            if find_spec(package) is None:  # not imported: the node has a process of its own
                raise ExtraMissingError(package, EXTRA)
        self._arguments = [namespace, *(() if control is None else (str(control[0]), control[1]))]
        super().__init__(on_death)

    def _make_helper(self) -> HelperProcess:
        # Standard error is read by the thread that waits for the end.
        return HelperProcess("uavctl.cli.ros2_host", self._arguments, stderr=subprocess.PIPE)
