"""`uavctl cameras`: four simulated vehicles' cameras over loopback, the recording, and refusals."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest
from mcap.reader import make_reader
from operation_rig import reserve_port
from places import ROOT

from logs.recording.sender import TOPIC
from sim.fleet import make_fleet
from sim.server import serve_all
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.mavlink.codec import decode
from uavctl.mavlink.messages import Position
from uavctl.records import Vec3

COUNT = 4


def test_each_vehicle_gets_its_own_positions_within_the_budget(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load_config("room-px4", ["sim.start_position_m=[0,-1.5,-0.2]", "sim.camera.rate_hz=50", "link.loss=0"])
    setups = make_fleet(config, "udpin://127.0.0.1:0", "udpout://127.0.0.1:1", COUNT, lambda _: None)
    text = (ROOT / "docs" / "examples" / "radio.toml").read_text()
    done = threading.Event()
    with ExitStack() as stack:
        daemons = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(COUNT)]
        with ExitStack() as reserved:  # free again once all are known
            sources = [reserved.enter_context(reserve_port()).getsockname()[1] for _ in range(COUNT)]
        for number, daemon in enumerate(daemons):
            daemon.bind(("127.0.0.1", 0))
            daemon.setblocking(False)
            text = text.replace(f"udpin://0.0.0.0:{14560 + number}", f"udpin://127.0.0.1:{daemon.getsockname()[1]}")
            text = text.replace(f"udpin://0.0.0.0:{14660 + number}", f"udpin://127.0.0.1:{sources[number]}")
        fleet_file, out = tmp_path / "fleet.toml", tmp_path / "sender.mcap"
        fleet_file.write_text(text)
        worlds = [
            setup.__class__(setup.config, "udpin://127.0.0.1:0", f"udpout://127.0.0.1:{port}", setup.on_truth)
            for setup, port in zip(setups, sources, strict=True)
        ]
        world = threading.Thread(
            target=lambda: serve_all(worlds, duration_s=None, airborne=False, on_ready=lambda _: None, stop=done.is_set)
        )
        world.start()
        try:
            assert run(["cameras", str(fleet_file), "--duration", "3", "--out", str(out.parent), "--json"]) == 0
        finally:
            done.set()
            world.join()
        sent = json.loads(capsys.readouterr().out)["sent"]
        received = [_read_positions(daemon) for daemon in daemons]
    for setup, positions in zip(setups, received, strict=True):
        assert positions
        north, east, _ = setup.config.sim.start_position_m
        # 1 m apart; the cameras' noise is 3 mm
        assert all(abs(n - north) < 0.1 and abs(e - east) < 0.1 for n, e, _ in positions)
    with out.open("rb") as file:
        messages = [message for _, _, message in make_reader(file).iter_messages(topics=[TOPIC])]
    records = [json.loads(message.data) for message in messages]
    # Zeros at the end of a payload are not sent, so a frame may be shorter than 44 bytes
    assert max(record["bytes"] for record in records) <= 44
    at_s = [1e-9 * message.log_time for message in messages]
    assert sum(record["bytes"] for record in records) <= (at_s[-1] - at_s[0]) * 5760 + 2 * 44
    assert len(records) == sum(sent.values())
    assert [sum(record["vehicle"] == name for record in records) for name in sent] == list(sent.values())
    assert all(set(record["ages_s"]) == set(sent) and min(record["ages_s"].values()) >= 0.0 for record in records)


def _read_positions(daemon: socket.socket) -> list[Vec3]:
    positions: list[Vec3] = []
    while True:
        try:
            messages = decode(daemon.recv(4096)).messages
        except BlockingIOError:
            return positions
        positions += [message.position_m for message in messages if isinstance(message, Position)]


@pytest.mark.parametrize(
    ("old", "new", "expected_text"),
    [
        ("bytes_per_s = 5760", "", "has no budget"),
        ("loss = 0.3", "signed = true", "radio.signed"),
        ('cameras = "udpin://0.0.0.0:14660"', "", "south-west: cameras"),
        ('mocap = "udpin://0.0.0.0:14560"', 'mocap = "tcp://127.0.0.1:1"', "south-west: positions"),
        ('schedule = "value"', 'schedule = "best"', "radio.schedule"),
    ],
)
def test_a_fleet_that_cannot_be_served_is_refused_before_anything_is_opened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, expected_text: str
) -> None:
    text = (ROOT / "docs" / "examples" / "radio.toml").read_text()
    assert old in text
    (tmp_path / "fleet.toml").write_text(text.replace(old, new))
    assert run(["cameras", str(tmp_path / "fleet.toml"), "--out", str(tmp_path / "new")]) == 2
    assert expected_text in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_ctrl_c_ends_it_with_a_whole_recording(tmp_path: Path) -> None:
    text, out = (ROOT / "docs" / "examples" / "radio.toml").read_text(), tmp_path / "sender.mcap"
    for number in range(2 * COUNT):
        old = 14560 + number if number < COUNT else 14660 + number - COUNT
        with reserve_port() as reserved:
            text = text.replace(f"0.0.0.0:{old}", f"127.0.0.1:{reserved.getsockname()[1]}")
    (tmp_path / "fleet.toml").write_text(text)
    command = [sys.executable, "-P", "-m", "uavctl", "cameras", str(tmp_path / "fleet.toml"), "--out", str(out.parent)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None and "4 vehicles" in process.stderr.readline()
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 1  # nobody was sent a position
    with out.open("rb") as file:
        assert not list(make_reader(file).iter_messages())


def test_an_older_recording_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sender.mcap"
    out.write_bytes(b"older")
    assert run(["cameras", str(ROOT / "docs" / "examples" / "radio.toml"), "--out", str(out.parent)]) != 0
    assert str(out) in capsys.readouterr().err
    assert out.read_bytes() == b"older"


def test_a_fleet_without_a_radio_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    duo = ROOT / "docs" / "examples" / "duo.toml"
    assert run(["cameras", str(duo), "--out", str(tmp_path / "new")]) == 2
    assert "radio: is missing" in capsys.readouterr().err
