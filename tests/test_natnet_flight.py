"""`uavctl fly --mocap natnet://...` over real sockets: what the simulated cameras see, told by a server of NatNet."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from natnet_server import Body, Server
from operation_rig import LIMIT_S, Scene, ended, scene, until
from sim_rig import decode

from logs.reader import records
from uavctl.build import build_design
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.data import ControlMode, Decision, PositionSample, StepInput
from uavctl.library_store import library_for


@pytest.fixture(scope="module", autouse=True)
def _library() -> None:
    """The daemon finds the policy library in the cache."""
    library_for(build_design(load_config("room")))


@contextmanager
def seen_by_motive(air: Scene) -> Iterator[Server]:
    """Motive, whose body is where the simulated cameras say; the daemon's cameras are Motive's from then on."""
    body, over = Body(7, "drone 1", shown=False), threading.Event()
    where = urlsplit(air.mocap)
    with socket.socket(type=socket.SOCK_DGRAM) as cameras, Server([Body(3, "table"), body]) as server:
        cameras.bind((where.hostname, where.port))
        cameras.settimeout(0.05)

        def watch() -> None:
            while not over.is_set():
                try:
                    (pose,) = decode(cameras.recv(2048))
                except TimeoutError:
                    continue
                # Y up: its axes are forward, up and right.
                body.position_m, body.shown = (pose.x, -pose.z, pose.y), True

        watching = threading.Thread(target=watch)
        watching.start()
        air.mocap = f"natnet://127.0.0.1:{server.port}/drone%201"
        try:
            yield server
        finally:
            over.set()
            watching.join()


def test_it_flies_on_a_body_of_motive_s_and_replays_without_it() -> None:
    with scene("sim.camera.rate_hz=60.0", "link.loss=0.0", "link.delay_s=0.0", "link.jitter_s=0.0") as air:
        with seen_by_motive(air) as server, ended(air.fly("f", "--duration", "4")) as process:
            _, told = process.communicate(timeout=LIMIT_S)
        assert process.returncode == 0, told
        until(lambda: air.mode == "AUTO.LAND", "the vehicle lands")
        recording = air.folder / "f" / "flight.mcap"
        tracking = [one for one in records(recording, Decision) if one.mode is ControlMode.TRACK]
        assert len(tracking) > 40
        samples = [one for step in records(recording, StepInput) for one in step.samples]
        assert {one.source for one in samples} == {"ODOMETRY 246/197"}
        # It has gone some way, and the body was where the vehicle was.
        moved = [abs(a - b) for a, b in zip(samples[-1].position_m, samples[0].position_m, strict=True)]
        assert max(moved) > 0.5
        truth = {round(one.at_ns * 1e-9, 1): one.position_m for one in air.truths}
        near = [one for one in samples if round(one.captured_ns * 1e-9, 1) in truth]
        assert near and all(apart_m(one, truth) < 0.5 for one in near)
        assert server.echo_answers > 0
        assert run(["log", "replay", str(recording)]) == 0


def apart_m(sample: PositionSample, truth: dict[float, tuple[float, float, float]]) -> float:
    """Largest distance along an axis to the truth within the same tenth of a second [m]."""
    there = truth[round(sample.captured_ns * 1e-9, 1)]
    return max(abs(a - b) for a, b in zip(sample.position_m, there, strict=True))
