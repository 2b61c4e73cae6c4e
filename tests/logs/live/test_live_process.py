"""The process of a live view: whom it serves, what it refuses, and that the flight never waits for it."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from live_rig import HANDSHAKE, Viewer, ask, make_head
from patience import wait_until
from places import without_pages
from view_rig import fly_view

from logs.live.process import LiveProcess, open_port
from logs.live.server import MAX_ASKING, MAX_HEAD_BYTES, MAX_VIEWERS
from logs.recording.derived_topics import VIEWS
from logs.recording.reader import read_kind
from logs.recording.recorder import DerivedTopics, Recorder
from logs.recording.topics import encode, get_definition
from logs.recording.views import ViewBuilder
from uavctl.cli.app import run
from uavctl.errors import UsageError
from uavctl.io.helper_process import MAX_RESTARTS
from uavctl.records import Decision

EVENT = "/uavctl/event"
PATIENCE_S = 60.0
LOCAL = {"Host": "localhost"}
LIMIT_DATAGRAMS = 100_000  # more than any pair of sockets holds


@contextmanager
def serving(deaths: list[str] | None = None) -> Iterator[LiveProcess]:
    """A process that has begun to serve."""
    live = LiveProcess(0, (deaths if deaths is not None else []).append)
    try:
        assert ask(live.port, make_head(LOCAL))[0] == 200
        yield live
    finally:
        live.close()


@pytest.fixture(scope="module")
def live() -> Iterator[LiveProcess]:
    """A process that several tests ask, each through connections of its own."""
    with serving() as process:
        yield process


@contextmanager
def telling(live: LiveProcess, topic: str, at_ns: int, data: bytes) -> Iterator[None]:
    """Tell a message again and again: a subscription takes effect some time after it was sent."""
    done = threading.Event()

    def repeat() -> None:
        while not done.wait(0.01):
            live.send(topic, at_ns, data)

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def find_listening_ports(process: int | str) -> set[int]:
    """The TCP ports on which a process listens."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    ports = {f"socket:[{row[9]}]": int(row[1].split(":")[1], 16) for row in rows if row[3] == "0A"}
    found = set()
    for descriptor in Path(f"/proc/{process}/fd").iterdir():
        with suppress(OSError):  # it has been closed
            found.add(ports.get(str(descriptor.readlink()), 0))
    return found - {0}


def find_child(parent: int, port: int) -> int:
    """The number of the process that another one has started and that listens on a port."""
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is somebody else's
            fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            if int(fields[1]) == parent and port in find_listening_ports(entry.name):
                return int(entry.name)
    pytest.fail("there is no process of a live view")


def is_running(process: int) -> bool:
    """Whether a process is there, and no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def is_refused(port: int) -> bool:
    """Whether nobody listens."""
    with socket.socket() as other:
        return other.connect_ex(("127.0.0.1", port)) != 0


# What it serves


@pytest.mark.slow
def test_a_viewer_gets_every_topic_with_its_schema(tmp_path: Path) -> None:
    told = {topic for topic, _, _ in fly_view().entries if not topic.startswith("/raw/")} | {
        view.name for view in VIEWS
    }
    with serving() as live, Viewer(live.port) as viewer:
        recorder = Recorder(tmp_path / "a.mcap", derived_topics=DerivedTopics(ViewBuilder(), live.send))
        for entry in fly_view().entries:
            recorder.put(*entry)
        assert recorder.close().ok
        channels = viewer.channels(told)
        assert channels.keys() == told
        for topic, channel in channels.items():
            want = get_definition(topic)
            assert (channel["encoding"], channel["schemaName"]) == (want.encoding, want.schema_name)
        viewer.subscribe({EVENT: channels[EVENT]})
        with telling(live, EVENT, 77, b'{"a":1}'):
            assert next(viewer.messages()) == (EVENT, 77, b'{"a":1}')


def test_a_browser_gets_the_page_its_script_and_one_state_after_another() -> None:
    with serving() as live:
        status, page = ask(live.port, make_head(LOCAL))
        assert status == 200 and b'src="/live.js"' in page and b"http" not in page
        status, script = ask(live.port, make_head(LOCAL, "/live.js"))
        assert status == 200 and b"EventSource" in script
        assert ask(live.port, make_head(LOCAL, "/etc/passwd"))[0] == 404
        for topic, at_ns, record in fly_view().entries:
            if not topic.startswith("/raw/"):
                live.send(topic, at_ns, encode(record))
        with socket.create_connection(("127.0.0.1", live.port), timeout=PATIENCE_S) as client:
            client.sendall(make_head(LOCAL, "/scenes"))
            states = (json.loads(line[6:]) for line in client.makefile("rb") if line.startswith(b"data: "))
            last_s = max(one.at_ns for _, _, one in fly_view().entries if isinstance(one, Decision)) * 1e-9
            assert any(state and state["time_s"] == pytest.approx(last_s, abs=1.0) for state in states)


# What it refuses


@pytest.mark.fault(98)
def test_98_a_foreign_site_s_page_gets_nothing(live: LiveProcess) -> None:
    foreign = {"Host": f"flights.example:{live.port}"}
    for path in ("/", "/live.js", "/scenes"):
        status, body = ask(live.port, make_head(foreign, path))
        assert status == 403 and len(body) < 200
    assert ask(live.port, make_head({**HANDSHAKE, **foreign}))[0] == 403
    assert ask(live.port, make_head({**HANDSHAKE, "Origin": "https://flights.example"}))[0] == 403
    assert ask(live.port, make_head({**HANDSHAKE, "Origin": "https://a.example"}, f"/{live.token}"))[0] == 101
    with socket.socket() as other:  # every address of 127/8 is this machine; only the first one is served
        assert other.connect_ex(("127.0.0.2", live.port)) != 0


@pytest.mark.fault(98)
@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS"])
def test_98_nothing_is_written_by_a_request(live: LiveProcess, method: str) -> None:
    for path in ("/", "/scenes", f"/{live.token}"):
        assert ask(live.port, make_head({**LOCAL, "Content-Length": "3"}, path, method) + b"{ }")[0] == 405


@pytest.mark.fault(98)
def test_98_nothing_is_written_through_the_websocket(live: LiveProcess) -> None:
    """Messages, parameters and services, as text and as bytes; the viewer is served on."""
    with Viewer(live.port) as viewer:
        for data in (b'{"op":"advertise","channels":[]}', b'{"op":"setParameters","parameters":[]}'):
            assert viewer.demand(data)["level"] == 2
        for operation in (b"\x01", b"\x02"):
            assert viewer.demand(operation + bytes(12), opcode=2)["level"] == 2


@pytest.mark.fault(98)
@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"\x16\x03\x01\r\n\r\n", 400),
        (b"GET /\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost localhost\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * MAX_HEAD_BYTES + b"\r\n\r\n", 431),
        (b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * MAX_HEAD_BYTES, 431),
        (make_head({**HANDSHAKE, "Sec-WebSocket-Version": "12"}), 400),
    ],
)
def test_98_a_request_that_is_wrong_or_too_long_is_refused(live: LiveProcess, request_: bytes, status: int) -> None:
    assert ask(live.port, request_[: MAX_HEAD_BYTES + 100])[0] == status


@pytest.mark.fault(97)
def test_97_connections_that_ask_nothing_give_way_to_one_that_asks(live: LiveProcess) -> None:
    with ExitStack() as stack:
        for _ in range(4 * MAX_ASKING):
            idle = stack.enter_context(socket.socket())
            idle.setblocking(False)
            idle.connect_ex(("127.0.0.1", live.port))
        assert ask(live.port, make_head(LOCAL))[0] == 200


@pytest.mark.fault(97)
def test_97_viewers_beyond_the_limit_are_refused_and_a_place_that_is_left_is_free() -> None:
    with serving() as live:
        with ExitStack() as stack:
            for _ in range(MAX_VIEWERS):
                stack.enter_context(Viewer(live.port)).read_frame()
            for head in (make_head(LOCAL, "/scenes"), make_head(HANDSHAKE)):
                assert ask(live.port, head)[0] == 503
        wait_until(lambda: ask(live.port, make_head(HANDSHAKE))[0] == 101, "a free place")


# What it costs the flight


@pytest.mark.fault(97)
def test_97_the_flight_s_process_serves_nobody() -> None:
    ports, threads = find_listening_ports("self"), set(threading.enumerate())
    with serving() as live:
        assert find_listening_ports("self") == ports
        assert find_listening_ports(find_child(os.getpid(), live.port)) == {live.port}
        assert len(set(threading.enumerate()) - threads) == 1  # waits for the process's end
        arguments = Path(f"/proc/{find_child(os.getpid(), live.port)}/cmdline").read_text()
        assert live.token not in arguments


@pytest.mark.fault(97)
def test_97_a_process_that_is_stopped_takes_nothing_and_holds_nothing_up() -> None:
    """Ten megabytes at least are dropped; a feed that waited would not end. The newest come once it goes on."""
    with serving() as live, Viewer(live.port) as viewer:
        live.send(EVENT, 0, b"{}")
        viewer.subscribe(viewer.channels({EVENT}))
        with telling(live, EVENT, 1, b"{}"):
            next(viewer.messages())
        child = find_child(os.getpid(), live.port)
        os.kill(child, signal.SIGSTOP)
        for _ in range(LIMIT_DATAGRAMS):
            live.send(EVENT, 2, bytes(10_000))
            if live.dropped >= 1000:
                break
        assert live.dropped >= 1000
        os.kill(child, signal.SIGCONT)
        with telling(live, EVENT, 3, b"{}"):
            assert next(at_ns for _, at_ns, _ in viewer.messages() if at_ns == 3)


@pytest.mark.fault(97)
def test_97_a_process_that_is_stopped_is_ended() -> None:
    with serving() as live:
        child = find_child(os.getpid(), live.port)
        os.kill(child, signal.SIGSTOP)
    assert not is_running(child) and is_refused(live.port)


@pytest.mark.fault(97)
def test_97_a_process_that_is_killed_is_started_again_a_limited_number_of_times() -> None:
    deaths: list[str] = []
    with serving(deaths) as live:
        live.send(EVENT, 7, b"{}")
        for count in range(1, MAX_RESTARTS + 2):
            os.kill(find_child(os.getpid(), live.port), signal.SIGKILL)
            wait_until(lambda count=count: len(deaths) == count, "the death is told")  # type: ignore[misc]
            if count <= MAX_RESTARTS:
                assert ask(live.port, make_head(LOCAL))[0] == 200
                with Viewer(live.port) as viewer:
                    assert viewer.channels({EVENT})  # what was sent before the death
        assert is_refused(live.port)
        before = live.dropped
        live.send(EVENT, 8, b"{}")
        assert live.dropped == before + 1
    assert all(text.startswith("signal 9; ") for text in deaths)


@pytest.mark.fault(97)
@pytest.mark.parametrize(("last_line", "cause"), [("echo no memory >&2", "no memory"), ("", "exit code 3")])
def test_97_a_process_that_cannot_start_is_told_with_its_cause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last_line: str, cause: str
) -> None:
    program, deaths = tmp_path / "python", list[str]()
    program.write_text(f"#!/bin/sh\n{last_line}\nexit 3\n")
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))
    live = LiveProcess(0, deaths.append)
    wait_until(lambda: len(deaths) > MAX_RESTARTS, "the last death is told")
    live.send(EVENT, 0, b"{}")
    live.close()
    assert [text.partition(";")[0] for text in deaths] == [cause] * (MAX_RESTARTS + 1)


def test_an_end_in_order_is_no_death() -> None:
    deaths: list[str] = []
    with serving(deaths) as live, Viewer(live.port, receive_bytes=4096):
        child = find_child(os.getpid(), live.port)
    assert not deaths and not is_running(child) and is_refused(live.port)


@pytest.mark.fault(97)
def test_97_a_message_that_is_too_long_is_dropped() -> None:
    with serving() as live:
        live.send(EVENT, 0, bytes(2**24))
        assert live.dropped == 1


@contextmanager
def flying(folder: Path, duration_s: int) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A flight in real time with a live view, and the number of its port."""
    command = [sys.executable, "-m", "uavctl", "loopback", "--udp", "--config", "paper"]
    command += ["--duration", str(duration_s), "--live", "--live-port", "0", "--out", str(folder), "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=without_pages()
    ) as flight:
        try:
            assert flight.stderr is not None
            lines = iter(flight.stderr.readline, "")
            port = next((int(found[1]) for line in lines if (found := re.search(r"ws://localhost:(\d+)/", line))), 0)
            assert port, "it ended before it served anything"
            yield flight, port
        finally:
            flight.kill()


def check_flight(flight: subprocess.Popen[str], folder: Path) -> str:
    """Wait for the end of a flight that must be whole; what it printed on standard error."""
    out, err = flight.communicate(timeout=PATIENCE_S)
    assert flight.returncode == 0, err
    assert json.loads(out)["recorder_dropped"] == 0
    decisions = [*read_kind(folder / "flight.mcap", Decision)]
    assert sum(1 + one.missed_ticks for one in decisions) == decisions[-1].tick + 1
    return err


@pytest.mark.slow
@pytest.mark.fault(97)
def test_97_a_flight_is_whole_beside_viewers_that_have_stalled(tmp_path: Path) -> None:
    with flying(tmp_path, 4) as (flight, port):
        assert not find_listening_ports(flight.pid)
        with socket.create_connection(("127.0.0.1", port)) as stalled, Viewer(port, receive_bytes=4096) as viewer:
            stalled.sendall(make_head(LOCAL, "/scenes"))  # a page that asks for states, and takes none
            viewer.subscribe(viewer.channels({"/uavctl/decision", "/plot/age", "/view/scene/path"}))
            assert "the live view has ended" not in check_flight(flight, tmp_path)


@pytest.mark.slow
@pytest.mark.fault(97)
def test_97_a_live_view_that_is_killed_leaves_the_flight_flying_and_is_told_once(tmp_path: Path) -> None:
    with flying(tmp_path, 4) as (flight, port):
        assert ask(port, make_head(LOCAL))[0] == 200
        os.kill(find_child(flight.pid, port), signal.SIGKILL)
        assert check_flight(flight, tmp_path).count("the live view has ended") == 1
        assert is_refused(port)


@pytest.mark.slow
@pytest.mark.fault(97)
def test_97_a_live_view_ends_with_a_flight_that_is_killed(tmp_path: Path) -> None:
    with flying(tmp_path, 60) as (flight, port):
        assert ask(port, make_head(LOCAL))[0] == 200
        child = find_child(flight.pid, port)
        flight.kill()
        wait_until(lambda: not is_running(child), "the end of the live view")
        assert is_refused(port)


# Usage


def test_a_port_that_cannot_be_had_is_told() -> None:
    with open_port(0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=f"port {port} cannot be used.*--live-port"):
            LiveProcess(port, print)
    for number in (70_000, -1):
        with pytest.raises(UsageError, match=f"--live-port {number}: ports are 1 to 65535"):
            LiveProcess(number, print)


def test_in_virtual_time_there_is_nothing_to_watch(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["loopback", "--config", "paper", "--live"]) == 2
    assert "--live needs --udp" in capsys.readouterr().err
