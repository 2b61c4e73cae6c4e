"""`uavctl cameras`: four simulated vehicles' cameras over loopback, the recording, and refusals."""

from __future__ import annotations

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from operation_rig import reserve_port
from patience import wait_until
from places import ROOT
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sender_recordings import open_sender_recording

from logs.recording.reader import explain_missing_end
from logs.recording.topics import SENT
from sim.fleet import make_fleet
from sim.server import serve_all
from uavctl.cli.app import run
from uavctl.cli.fleet_file import read_fleet
from uavctl.config import load_config
from uavctl.io.key_file import new_key, read_key
from uavctl.io.signed_connection import sign_connections
from uavctl.io.transport import open_connection
from uavctl.mavlink.codec import decode
from uavctl.mavlink.connection import MOCAP, make_links
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.messages import Position
from uavctl.mavlink.signing import FrameSigner, SigningTimestamps
from uavctl.records import PositionSample, Vec3

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
        messages = [message for _, _, message in make_reader(file).iter_messages(topics=[SENT])]
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
        ("loss = 0.3", "signed = true", "south-west: security.key_file: is missing, and radio.signed"),
        ('cameras = "udpin://0.0.0.0:14661"', 'cameras = "udpin://0.0.0.0:14660"', "is that of south-west too"),
        ('cameras = "udpin://0.0.0.0:14661"', 'cameras = "udpin://0.0.0.0:14660/2"', "takes all of"),
        (
            'cameras = "udpin://0.0.0.0:14660"',
            'cameras = "udpin://0.0.0.0:14661/2"',
            "south-east: cameras: takes all of",
        ),
        ('cameras = "udpin://0.0.0.0:14661"', 'cameras = "udpin://0.0.0.0:14661/x"', "south-east: cameras: "),
        ('cameras = "udpin://0.0.0.0:14661"', 'cameras = "natnet://10.0.0.5"', "south-east: cameras: "),
        ('cameras = "udpin://0.0.0.0:14661"', 'cameras = "garbage"', "south-east: cameras: "),
        ('cameras = "udpin://0.0.0.0:14661"', 'positions = "udpout://127.0.0.1:14560"', "that of south-west too"),
        ('cameras = "udpin://0.0.0.0:14661"', 'cameras = "udpin://1.2.3.4:14661"', "south-east: cameras: "),
        ("set = [", 'set = ["source.system_id=17",', "south-west: source.system_id: 17"),
        ("set = [", """set = ['source.messages=["ODOMETRY"]',""", "south-west: source.messages: leaves out VISION"),
        ("set = [", 'set = ["security.key_file=/etc/key",', "south-west: security.require: `mocap` must be signed"),
        ("rate_hz = 50", "rate_hz = 0", "radio.rate_hz"),
        ("bytes_per_s = 5760", "bytes_per_s = -1", "radio.bytes_per_s"),
        ("bytes_per_s = 5760", "bytes_per_s = true", "radio.bytes_per_s"),
        ("bytes_per_s = 5760", "bytes_per_sec = 5760", "bytes_per_sec"),
        ("loss = 0.3", "loss = 1.0", "radio.loss"),
        ("loss = 0.3", "max_wait_s = 0.03", "radio.max_wait_s"),
        ("loss = 0.3", "signed = 1", "radio.signed"),
        ('cameras = "udpin://0.0.0.0:14660"', "", "south-west: cameras"),
        ('mocap = "udpin://0.0.0.0:14560"', 'mocap = "tcp://127.0.0.1:1"', "south-west: positions"),
        ('schedule = "value"', 'schedule = "best"', "radio.schedule"),
    ],
)
def test_a_fleet_that_cannot_be_served_is_refused_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, expected_text: str
) -> None:
    text = (ROOT / "docs" / "examples" / "radio.toml").read_text()
    assert old in text
    (tmp_path / "fleet.toml").write_text(text.replace(old, new))
    assert run(["cameras", str(tmp_path / "fleet.toml"), "--out", str(tmp_path / "new")]) == 2
    error = capsys.readouterr().err
    assert expected_text in error and "fleet.toml" in error
    assert not (tmp_path / "new").exists()


def test_signed_positions_are_taken_with_the_vehicles_key_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One port of MAVLink with two bodies; a key for each vehicle; daemons' links that ask for the time."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "sender"))
    keys = [tmp_path / f"{name}.key" for name in ("west", "east")]
    for key in keys:
        new_key(key)
    with ExitStack() as stack:
        daemons = [stack.enter_context(closing(open_connection("udpin://127.0.0.1:0"))) for _ in keys]
        with reserve_port() as reserved:
            port = reserved.getsockname()[1]
        tables = []
        for number, (daemon, key) in enumerate(zip(daemons, keys, strict=True)):
            with socket.socket(fileno=os.dup(daemon.fileno())) as bound:
                mocap = f"udpin://127.0.0.1:{bound.getsockname()[1]}"
            low, high = (-2.5, -0.2) if number == 0 else (0.2, 2.5)
            settings = [
                f"security.key_file={key}",
                f"sets.state_lower=[-3,-1.5,-inf,{low},-1.5,-inf,-2.5,-1,-inf]",
                f"sets.state_upper=[3,1.5,inf,{high},1.5,inf,0,1,inf]",
                f"target.position_m=[0,{0.5 * (low + high)},-1.2]",
            ]
            tables.append(
                f'[[vehicle]]\nname = "v{number}"\nconfig = "room-px4"\nvehicle = "udpin://127.0.0.1:{24541 + number}"'
                f'\nmocap = "{mocap}"\ncameras = "udpin://127.0.0.1:{port}/{11 + number}"'
                f"\nset = {json.dumps(settings)}\n"
            )
        file = tmp_path / "fleet.toml"
        radio = "[radio]\nbytes_per_s = 5760\nsigned = true\nfeedback_s = 0.2\n"
        file.write_text(f"spacing_m = 0.3\n{radio}" + "".join(tables))
        configs = [member.config for member in read_fleet(file).members]
        links = [make_links(config)[MOCAP] for config in configs]
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "daemons"))
        signed = [
            stack.enter_context(sign_connections({MOCAP: daemon}, config.security))[MOCAP]
            for daemon, config in zip(daemons, configs, strict=True)
        ]
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "sender"))
        samples: list[list[PositionSample]] = [[], []]
        done = threading.Event()

        def serve() -> None:
            """Both bodies at 50 Hz, and what the daemons do with their links."""
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bridge:
                while not done.wait(0.02):
                    for system in (11, 12):
                        message = mavlink.MAVLink_vision_position_estimate_message(
                            time.monotonic_ns() // 1000, 0.1 * system, 0, -1, 0, 0, 0
                        )
                        bridge.sendto(message.pack(mavlink.MAVLink(None, system, 197)), ("127.0.0.1", port))
                    for number, (link, connection) in enumerate(zip(links, signed, strict=True)):
                        for data, at_ns in connection.receive():
                            result = link.receive(data, at_ns)
                            samples[number] += [item for item in result.items if isinstance(item, PositionSample)]
                            for reply in result.replies:
                                connection.send(reply)
                        for frame in link.due(time.monotonic_ns()) if samples[number] else ():
                            connection.send(frame)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            assert run(["cameras", str(file), "--duration", "3", "--out", str(tmp_path / "out"), "--json"]) == 0
        finally:
            done.set()
            thread.join()
        for number, (link, connection) in enumerate(zip(links, signed, strict=True)):
            assert samples[number]
            norths_m = [sample.position_m[0] for sample in samples[number]]
            assert norths_m == pytest.approx([0.1 * (11 + number)] * len(norths_m))
            assert link.stats(0).clock_source == "timesync"
            assert not connection.refused
        # A vehicle with another key takes none.
        stranger = FrameSigner(read_key(keys[1]), 1, SigningTimestamps(), time.time_ns() - time.monotonic_ns())
        with closing(open_connection(f"udpout://{configs[0].daemon.mocap.removeprefix('udpin://')}")) as other:
            other.send(
                stranger.sign(
                    Encoder(246, 197).encode_position(1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), time.monotonic_ns()
                )
            )
            wait_until(lambda: not signed[0].receive() and signed[0].refused["forged"] == 1, "it is refused")
    with (tmp_path / "out" / "sender.mcap").open("rb") as recording:
        records = [json.loads(message.data) for _, _, message in make_reader(recording).iter_messages(topics=[SENT])]
    assert max(record["bytes"] for record in records) <= 57


def start_sender(file: Path, out: Path, **options: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-P", "-m", "uavctl", "cameras", str(file), "--out", str(out)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, **options)


@contextmanager
def serve_bridge(tmp_path: Path) -> Iterator[tuple[Path, socket.socket, threading.Event]]:
    """A fleet file of four, the socket of the first daemon, and a bridge at 50 Hz until the event is set."""
    text = (ROOT / "docs" / "examples" / "radio.toml").read_text()
    silenced, done = threading.Event(), threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as daemon:
        daemon.bind(("127.0.0.1", 0))
        daemon.settimeout(0.02)
        text = text.replace("udpin://0.0.0.0:14560", f"udpin://127.0.0.1:{daemon.getsockname()[1]}")
        with reserve_port() as reserved:
            port = reserved.getsockname()[1]
        for number in range(COUNT):
            text = text.replace(f"udpin://0.0.0.0:{14660 + number}", f"udpin://127.0.0.1:{port}/{1 + number}")
        (tmp_path / "fleet.toml").write_text(text)

        def serve() -> None:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bridge:
                while not done.wait(0.02):
                    for system in range(1, 1 + COUNT):
                        message = mavlink.MAVLink_vision_position_estimate_message(
                            time.monotonic_ns() // 1000, system, 0, -1, 0, 0, 0
                        )
                        if system > 1 or not silenced.is_set():
                            bridge.sendto(message.pack(mavlink.MAVLink(None, system, 197)), ("127.0.0.1", port))

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield tmp_path / "fleet.toml", daemon, silenced
        finally:
            done.set()
            thread.join()


def wait_for_stamp(daemon: socket.socket, after_us: int) -> int:
    """Stamp of a position that was captured later."""
    stamps_us: list[int] = []

    def hear() -> bool:
        try:
            messages = decode(daemon.recv(4096)).messages
        except TimeoutError:
            return False
        stamps_us.extend(message.stamp_us or 0 for message in messages if isinstance(message, Position))
        return bool(stamps_us) and stamps_us[-1] > after_us

    wait_until(hear, "a new position", pause_s=0.0)
    return stamps_us[-1]


def test_a_killed_sender_is_replaced_and_its_stamps_go_on(tmp_path: Path) -> None:
    with serve_bridge(tmp_path) as (file, daemon, _):
        first = start_sender(file, tmp_path / "first")
        with first:
            wait_for_stamp(daemon, 0)
            first.kill()
        killed_us = time.monotonic_ns() // 1000
        with start_sender(file, tmp_path / "second") as second:
            stamp_us = wait_for_stamp(daemon, killed_us)
            assert stamp_us <= time.monotonic_ns() // 1000
            for _ in range(10):  # by then each vehicle has had its turn
                stamp_us = wait_for_stamp(daemon, stamp_us)
            second.send_signal(signal.SIGINT)
            assert second.wait(60) == 0


def test_positions_go_on_without_a_disk_and_a_lost_body_is_named(tmp_path: Path) -> None:
    def limit_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    with (
        serve_bridge(tmp_path) as (file, daemon, silenced),
        start_sender(file, tmp_path / "out", preexec_fn=limit_files) as process,
    ):
        assert process.stderr is not None
        wait_for_stamp(daemon, 0)
        wait_until(lambda: "the recording lacks positions" in process.stderr.readline(), "it is told")  # type: ignore[union-attr]
        wait_for_stamp(daemon, time.monotonic_ns() // 1000)
        silenced.set()
        wait_until(lambda: "south-west: no position" in process.stderr.readline(), "it is told")  # type: ignore[union-attr]
        silenced.clear()
        wait_until(lambda: "south-west: positions again" in process.stderr.readline(), "it is told")  # type: ignore[union-attr]
        wait_for_stamp(daemon, time.monotonic_ns() // 1000)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 1


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
    assert not explain_missing_end(out)
    with out.open("rb") as file:
        assert not list(make_reader(file).iter_messages(topics=[SENT]))


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


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--set", "link.loss=0.5", "--set", "sim.seed=2"), "--set link.loss=0.5"),
        (("--topic", "/vehicle"), "--topic /vehicle"),
        (("--system", "3"), "--system 3"),
    ],
    ids=["set", "topic", "system"],
)
def test_the_replay_of_a_sender_refuses_what_only_a_flight_takes(
    options: tuple[str, ...], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "sender.mcap"
    open_sender_recording(path, ("a", "b")).close()
    assert run(["log", "replay", str(path), *options]) == 2
    error = capsys.readouterr().err
    assert named in error
    assert str(path) in error
