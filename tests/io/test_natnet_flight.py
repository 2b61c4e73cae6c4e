"""`uavctl fly --mocap natnet://...` over real sockets: what the simulated cameras see, told by a server of NatNet."""

from __future__ import annotations

import os
import signal
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import numpy as np
import pytest
from natnet_server import Body, Server, message
from numpy.typing import NDArray
from operation_rig import Scene, end_process, open_scene
from patience import LIMIT_S, wait_until
from process_rig import child_of
from sim_rig import decode

from logs.recording.reader import read_kind
from sim.cameras import UPTIME_S
from uavctl.cli.app import run
from uavctl.event_codes import EventCode
from uavctl.io.natnet import ECHO
from uavctl.records import ControlMode, Decision, Event, StepInput


@contextmanager
def seen_by_motive(air: Scene) -> Iterator[Server]:
    """Motive, whose body is where the simulated cameras say; the daemon's cameras are Motive's from then on."""
    bodies, over = [Body(3, "table"), Body(7, "drone 1", shown=False)], threading.Event()
    where = urlsplit(air.mocap)
    with socket.socket(type=socket.SOCK_DGRAM) as cameras, Server(bodies) as server:
        cameras.bind((where.hostname, where.port))
        cameras.settimeout(0.05)

        def watch() -> None:
            while not over.is_set():
                try:
                    (pose,) = decode(cameras.recv(2048))
                except TimeoutError:
                    continue
                if air.truths:
                    # Y up: its axes are forward, up and right. The cameras' clock counts from the first truth.
                    exposed_s = air.truths[0].at_ns * 1e-9 + pose.usec * 1e-6 - UPTIME_S
                    bodies[1] = Body(7, "drone 1", (pose.x, -pose.z, pose.y), exposed_s=exposed_s)

        watching = threading.Thread(target=watch)
        watching.start()
        air.mocap = f"natnet://127.0.0.1:{server.port}/drone%201"
        try:
            yield server
        finally:
            over.set()
            watching.join()


@pytest.mark.slow
def test_it_flies_on_a_body_of_motive_s_and_replays_without_it() -> None:
    with open_scene("sim.camera.rate_hz=60.0", "link.loss=0.0", "link.delay_s=0.0", "link.jitter_s=0.0") as air:
        recording = air.folder / "f" / "flight.mcap"

        def tracking() -> int:
            return sum(one.mode is ControlMode.TRACK for one in read_kind(recording, Decision))

        with seen_by_motive(air) as server, end_process(air.fly("f")) as process:
            wait_until(recording.exists, "it records")
            wait_until(lambda: tracking() > 40 and moved_m(air) > 0.5, "it flies, and has gone some way")
            process.send_signal(signal.SIGINT)
            _, told = process.communicate(timeout=LIMIT_S)
        assert process.returncode == 0, told
        wait_until(lambda: air.has_landed, "the vehicle lands")
        samples = [one for step in read_kind(recording, StepInput) for one in step.samples]
        assert {one.source for one in samples} == {"ODOMETRY 246/197"}
        # The body was where the vehicle went, whatever the clocks say.
        way = np.array([one.position_m for one in air.truths])
        assert max(off_m(np.array(one.position_m), way) for one in samples) < 0.1
        assert server.echo_answers > 0
        assert run(["log", "replay", str(recording)]) == 0


@pytest.mark.slow
@pytest.mark.fault(91, 92)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_it_flies_on_after_a_forged_answer_and_after_the_death_of_the_process(autopilot: str) -> None:
    overrides = ("sim.camera.rate_hz=60.0", "link.loss=0.0", "link.delay_s=0.0", "link.jitter_s=0.0")
    with open_scene(*overrides, f'sim.autopilot="{autopilot}"') as air:
        recording = air.folder / "f" / "flight.mcap"

        def count_tracking() -> int:
            return sum(decision.mode is ControlMode.TRACK for decision in read_kind(recording, Decision))

        def is_tracking_on(more: int) -> bool:
            return count_tracking() >= more

        with seen_by_motive(air) as server, end_process(air.fly("f")) as process:
            wait_until(recording.exists, "it records")
            wait_until(lambda: is_tracking_on(40), "it flies")
            child = child_of(process.pid, "uavctl.io.camera_host")
            server.send(message(ECHO, struct.pack("<QQ", 1, 2**64 - 1)))
            flown = count_tracking()
            wait_until(lambda: is_tracking_on(flown + 40), "it flies on after the forged answer")
            assert child_of(process.pid, "uavctl.io.camera_host") == child
            os.kill(child, signal.SIGKILL)
            wait_until(
                lambda: any(e.code == EventCode.PROCESS_ENDED for e in read_kind(recording, Event)), "it is told"
            )
            flown = count_tracking()
            wait_until(lambda: is_tracking_on(flown + 40), "it flies on after the death of the process")
            process.send_signal(signal.SIGINT)
            answer, errors = process.communicate(timeout=LIMIT_S)
        assert process.returncode == 0, answer
        assert "signal 9" in errors
        wait_until(lambda: air.has_landed, "the vehicle lands")
        assert run(["log", "replay", str(recording)]) == 0


def moved_m(air: Scene) -> float:
    """Largest distance along an axis from where the vehicle began [m]."""
    return max(abs(a - b) for a, b in zip(air.truths[-1].position_m, air.truths[0].position_m, strict=True))


def off_m(place: NDArray[np.float64], way: NDArray[np.float64]) -> float:
    """Distance of a place (3,) from the nearest of the straight lines through successive places (n, 3) [m]."""
    begin, step = way[:-1], np.diff(way, axis=0)
    length2 = np.maximum(np.sum(step**2, axis=1), 1e-12)
    part = np.clip(np.sum((place - begin) * step, axis=1) / length2, 0.0, 1.0)
    return float(np.linalg.norm(begin + part[:, None] * step - place, axis=1).min())
