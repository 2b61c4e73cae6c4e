"""Checks of a camera system that is listened to without a bridge to MAVLink."""

from __future__ import annotations

from collections.abc import Iterator

from uavctl.config.peers import CAMERA_MESSAGE, CAMERA_SYSTEM_ID, CAMERAS, DaemonConfig, SourceConfig
from uavctl.config.problem import Problem
from uavctl.config.security import SecurityConfig


def roles(daemon: DaemonConfig) -> Iterator[Problem]:
    """A camera system flies nothing."""
    if daemon.vehicle.startswith(CAMERAS):
        yield Problem("daemon.vehicle", f'"{daemon.vehicle}" is a camera system', "give it as daemon.mocap")


def source(daemon: DaemonConfig, source: SourceConfig) -> Iterator[Problem]:
    """Its positions have to be among those that count."""
    if not daemon.mocap.startswith(CAMERAS):
        return
    if CAMERA_MESSAGE not in source.messages:
        yield Problem(
            "source.messages", f"leaves out {CAMERA_MESSAGE}, which {daemon.mocap} comes as", f'add "{CAMERA_MESSAGE}"'
        )
    if source.system_id not in (0, CAMERA_SYSTEM_ID):
        yield Problem(
            "source.system_id",
            f"{source.system_id} is another system than the cameras of daemon.mocap, {CAMERA_SYSTEM_ID}",
            f"give {CAMERA_SYSTEM_ID}, or 0",
        )


def signing(daemon: DaemonConfig, security: SecurityConfig) -> Iterator[Problem]:
    """It cannot sign."""
    if daemon.mocap.startswith(CAMERAS) and security.key_file and "mocap" in security.require:
        yield Problem(
            "security.require",
            f'"mocap" cannot be: {daemon.mocap} has no signatures',
            'write require = ["vehicle"], and keep the cameras\' network to itself',
        )
