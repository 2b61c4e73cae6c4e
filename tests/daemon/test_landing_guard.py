"""Landing request after the death of a flight's process: to whom it is sent, and what keeps it back."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from mavlink_rig import OFFBOARD, Peer
from patience import LIMIT_S
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode

from uavctl.config import load_config
from uavctl.config.connections import HandOverConfig
from uavctl.daemon import landing_guard
from uavctl.daemon.landing_guard import LandingFrames
from uavctl.daemon.landing_host import land
from uavctl.errors import UavctlError
from uavctl.io.base import Connection
from uavctl.loop import ControlLoop
from uavctl.mavlink.landing import LandingRequest

POSITION_CONTROL = 3 << 16
Ends = tuple[socket.socket, socket.socket]


@pytest.fixture(params=["connected", "unconnected"])
def ends(request: pytest.FixtureRequest) -> Iterator[Ends]:
    """The flight's socket and the vehicle's."""
    with socket.socket(type=socket.SOCK_DGRAM) as flight, socket.socket(type=socket.SOCK_DGRAM) as vehicle:
        for sock in (flight, vehicle):
            sock.bind(("127.0.0.1", 0))
        vehicle.connect(flight.getsockname())
        vehicle.settimeout(LIMIT_S)
        if request.param == "connected":
            flight.connect(vehicle.getsockname())
        yield flight, vehicle


def ask(ends: Ends, land_s: float) -> LandingRequest:
    flight, vehicle = ends
    request = LandingRequest((245, 191), HandOverConfig(land_s=land_s))
    request.prepare((1, 1), "px4")
    assert request.target is not None
    try:
        flight.getpeername()
        peer = None
    except OSError:
        peer = vehicle.getsockname()
    land(LandingFrames((request.target[2],), (1, 1), "px4", peer), flight.fileno(), request)
    return request


@pytest.mark.fault(103)
def test_103_a_vehicle_that_the_pilot_has_taken_meanwhile_is_asked_for_nothing(ends: Ends) -> None:
    _, vehicle = ends
    vehicle.send(Peer().heartbeat(OFFBOARD))
    vehicle.send(Peer().heartbeat(POSITION_CONTROL))
    assert ask(ends, LIMIT_S).is_answered
    vehicle.setblocking(False)
    with pytest.raises(BlockingIOError):
        vehicle.recv(2048)


@pytest.mark.fault(103)
def test_103_landing_is_asked_for_until_the_vehicle_accepts(ends: Ends) -> None:
    _, vehicle = ends
    commands: list[int] = []

    def answer() -> None:
        while len(commands) < 2:
            commands.extend(m.command for m in decode(vehicle.recv(2048)) if m.get_type() == "COMMAND_LONG")
        message = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_NAV_LAND, mavlink.MAV_RESULT_ACCEPTED)
        vehicle.send(message.pack(mavlink.MAVLink(None, 1, 1)))

    answering = threading.Thread(target=answer)
    answering.start()
    request = ask(ends, LIMIT_S)
    answering.join()
    assert request.is_answered and set(commands) == {mavlink.MAV_CMD_NAV_LAND}


@pytest.mark.fault(103)
def test_103_a_vehicle_that_says_nothing_is_asked_for_a_limited_time(ends: Ends) -> None:
    assert not ask(ends, 0.5).is_answered


@pytest.mark.fault(103)
@pytest.mark.parametrize(
    ("error", "lands"), [(KeyboardInterrupt(), True), (SystemExit(130), True), (UavctlError("no flight"), False)]
)
def test_103_a_flight_that_ends_at_once_leaves_the_vehicle_to_the_process(
    error: BaseException, lands: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs = socket.socketpair()
    helper = SimpleNamespace(socket=ours, close=ours.close)
    monkeypatch.setattr(landing_guard, "HelperProcess", lambda *_, **__: helper)
    with theirs:
        connection = cast("Connection", None)
        with (
            pytest.raises(type(error)),
            landing_guard.guard_landing(cast("ControlLoop", None), load_config("room"), connection, Path("x"), print),
        ):
            raise error
        theirs.settimeout(LIMIT_S)
        assert theirs.recv(64) == (b"" if lands else landing_guard.END)
