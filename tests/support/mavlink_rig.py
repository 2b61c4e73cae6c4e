"""Peers that speak MAVLink through pymavlink alone, and the recorded excerpts: nothing of our codec."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

from places import DATA
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.config.connections import ClockConfig, DaemonConfig, FrameConfig, SourceConfig
from uavctl.config.types import EstimatorConfig
from uavctl.mavlink.connection import Item, MavlinkConnection
from uavctl.records import Event, PositionSample, VehicleStatus

MS, SECOND = 1_000_000, 1_000_000_000
OFFBOARD = 6 << 16
NO_COVARIANCE = [float("nan")] + [0.0] * 20


class Peer:
    """A system that sends messages."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)

    def send(self, name: str, *fields: Any, v1: bool = False) -> bytes:
        message: mavlink.MAVLink_message = getattr(mavlink, f"MAVLink_{name}_message")(*fields)
        data = message.pack(self.mav, force_mavlink1=v1)
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def vision(self, usec: int, x: float = 1.0, y: float = 2.0, z: float = -3.0, v1: bool = False) -> bytes:
        return self.send("vision_position_estimate", usec, x, y, z, 0.0, 0.0, 0.0, NO_COVARIANCE, v1=v1)

    def heartbeat(
        self, custom_mode: int = OFFBOARD, base_mode: int = 129, autopilot: int = 12, kind: int = 2, status: int = 4
    ) -> bytes:
        return self.send("heartbeat", kind, autopilot, base_mode, custom_mode, status, 3)

    def local_position(self, boot_ms: int, x: float = 1.0, y: float = 2.0, z: float = -3.0) -> bytes:
        return self.send("local_position_ned", boot_ms, x, y, z, 0.1, 0.2, 0.3)

    def odometry(
        self,
        usec: int,
        position: tuple[float, float, float] = (1.0, 2.0, -3.0),
        velocity: tuple[float, float, float] = (1.0, 0.0, 0.0),
        q: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
        frame: int = 1,
        child: int = 12,
        estimator: int = 6,
        quality: int = 0,
    ) -> bytes:
        rest = (0.0, 0.0, 0.0, NO_COVARIANCE, NO_COVARIANCE, 0, estimator, quality)
        return self.send("odometry", usec, frame, child, *position, q, *velocity, *rest)


def read(data: bytes) -> list[mavlink.MAVLink_message]:
    """What pymavlink's own parser makes of our bytes."""
    return mavlink.MAVLink(None).parse_buffer(data) or []


def make_link(
    roles: tuple[str, ...] = ("vehicle", "mocap"),
    *,
    frame: FrameConfig | None = None,
    clock: ClockConfig | None = None,
    source: SourceConfig | None = None,
    estimator: EstimatorConfig | None = None,
    daemon: DaemonConfig | None = None,
) -> MavlinkConnection:
    return MavlinkConnection(
        "vehicle",
        roles=frozenset(roles),
        daemon=daemon or DaemonConfig(tick_s=0.05),
        frame=frame or FrameConfig(),
        clock=clock or ClockConfig(),
        source=source or SourceConfig(),
        estimator=estimator or EstimatorConfig(position_std_m=0.005),
    )


def samples(items: tuple[Item, ...]) -> list[PositionSample]:
    return [item for item in items if isinstance(item, PositionSample)]


def statuses(items: tuple[Item, ...]) -> list[VehicleStatus]:
    return [item for item in items if isinstance(item, VehicleStatus)]


def events(items: tuple[Item, ...]) -> list[Event]:
    return [item for item in items if isinstance(item, Event)]


def packets(name: str) -> Iterator[tuple[int, bytes]]:
    """(arrival [ns], packet) of an excerpt; MAVLink 2, unsigned."""
    data = (DATA / name).read_bytes()
    at = 0
    while at < len(data):
        (stamp_us,) = struct.unpack_from(">Q", data, at)
        end = at + 8 + 12 + data[at + 9]
        yield stamp_us * 1000, data[at + 8 : end]
        at = end
