"""The live view: the recording's topics, on this machine only; a viewer that does not read holds nothing up."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from live_rig import Viewer
from places import without_pages
from view_rig import fly_view

from logs.recording.derived_topics import VIEWS
from logs.recording.reader import read, records
from logs.recording.recorder import BACKLOG, DerivedTopics, Recorder, Watcher, live_view
from logs.recording.topics import get_definition
from logs.recording.views import ViewBuilder
from uavctl.cli.app import run
from uavctl.errors import UsageError
from uavctl.records import Decision

EVENT = "/uavctl/event"
PATIENCE_S = 60.0


@contextmanager
def telling(watch: Watcher, at_ns: int, data: bytes) -> Iterator[None]:
    """Tell an event again and again: a subscription takes effect some time after it was sent."""
    done = threading.Event()

    def repeat() -> None:
        while not done.wait(0.01):
            tell(watch, at_ns, data)

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def refused(port: int) -> bool:
    """Whether nobody listens; gives a server that ends a moment."""
    with socket.socket() as other:
        if other.connect_ex(("127.0.0.1", port)) != 0:
            return True
    threading.Event().wait(0.01)
    return False


def tell(watch: Watcher, at_ns: int, data: bytes = b"{}") -> None:
    watch(get_definition(EVENT), at_ns, data)


@pytest.mark.slow
def test_a_viewer_gets_every_topic_with_its_schema(tmp_path: Path) -> None:
    ports: list[int] = []
    told = {topic for topic, _, _ in fly_view().entries if not topic.startswith("/raw/")} | {
        view.name for view in VIEWS
    }
    with live_view(0, on_open=ports.append) as watch:
        recorder = Recorder(tmp_path / "a.mcap", derived_topics=DerivedTopics(ViewBuilder(), watch))
        for entry in fly_view().entries:
            recorder.put(*entry)
        assert recorder.close().ok
        with Viewer(ports[0]) as viewer:
            channels = viewer.channels(told)
            assert channels.keys() == told
            for topic, channel in channels.items():
                want = get_definition(topic)
                assert (channel["encoding"], channel["schemaName"]) == (want.encoding, want.schema_name)
            viewer.subscribe({EVENT: channels[EVENT]})
            assert watch is not None
            with telling(watch, 77, b'{"a":1}'):
                assert next(viewer.messages()) == (EVENT, 77, b'{"a":1}')


def test_a_stalled_viewer_holds_nothing_up_and_the_oldest_messages_go(tmp_path: Path) -> None:
    """Ten times more than sockets and backlog hold: a server that waited for the viewer would not end this."""
    ports: list[int] = []
    large = b'"' + b"x" * 20_000 + b'"'
    with live_view(0, on_open=ports.append) as watch:
        assert watch is not None
        tell(watch, 0)
        with Viewer(ports[0], receive_bytes=4096) as viewer:
            viewer.subscribe(viewer.channels({EVENT}))
            messages = viewer.messages()
            with telling(watch, 1, b"{}"):
                next(messages)
            # From here on the viewer does not read.
            recorder = Recorder(tmp_path / "a.mcap", derived_topics=DerivedTopics(ViewBuilder(), watch))

            def fly() -> None:
                for entry in fly_view().entries:
                    recorder.put(*entry)
                for number in range(10 * BACKLOG):
                    tell(watch, 2 + number, large)

            flight = threading.Thread(target=fly, daemon=True)
            flight.start()
            flight.join(PATIENCE_S)
            assert not flight.is_alive()
            status = recorder.close()
            assert status.ok and not status.waiting and not status.dropped
            got = []
            for _, at_ns, _ in messages:
                got.append(at_ns)
                if at_ns == 1 + 10 * BACKLOG:
                    break
    assert len(got) < 9 * BACKLOG  # most of it was dropped, and the newest came
    assert len([*read(tmp_path / "a.mcap")]) >= len(fly_view().entries)


def test_the_end_does_not_wait_for_a_stalled_viewer() -> None:
    ports: list[int] = []
    stalled, ended = threading.Event(), threading.Event()

    def serve() -> None:
        with live_view(0, on_open=ports.append) as watch:
            assert watch is not None
            tell(watch, 0)
            with telling(watch, 1, b"{}"):
                stalled.wait(PATIENCE_S)
            for number in range(2 * BACKLOG):
                tell(watch, 2 + number, b"x" * 20_000)
        ended.set()

    server = threading.Thread(target=serve, daemon=True)
    server.start()
    while not ports:
        server.join(0.01)
    with Viewer(ports[0], receive_bytes=4096) as viewer:
        viewer.subscribe(viewer.channels({EVENT}))
        next(viewer.messages())
        stalled.set()
        assert ended.wait(PATIENCE_S)
    server.join(PATIENCE_S)


@pytest.mark.slow
def test_a_flight_in_real_time_is_the_same_beside_viewers_that_have_stalled(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "uavctl", "loopback", "--udp", "--config", "paper", "--duration", "4"]
    command += ["--live", "--live-port", "0", "--out", str(tmp_path), "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=without_pages()
    ) as flight:
        try:
            assert flight.stderr is not None
            said = iter(flight.stderr.readline, "")
            port = next((int(found[1]) for line in said if (found := re.search(r"ws://localhost:(\d+)", line))), 0)
            page = next((int(found[1]) for line in said if (found := re.search(r"http://localhost:(\d+)", line))), 0)
            assert port and page, "it ended before it served anything"
            # A page that asks for states, and takes none.
            stalled = socket.create_connection(("127.0.0.1", page))
            stalled.sendall(b"GET /scenes HTTP/1.1\r\nHost: localhost\r\n\r\n")
            with Viewer(port, receive_bytes=4096) as viewer:
                viewer.subscribe(viewer.channels({"/uavctl/decision", "/plot/age", "/view/scene/path"}))
                out, _ = flight.communicate(timeout=60)
            stalled.close()
        finally:
            flight.kill()
    summary = json.loads(out)
    assert flight.returncode == 0 and summary["recorder_dropped"] == 0
    decisions = [*records(tmp_path / "flight.mcap", Decision)]
    assert sum(1 + one.missed_ticks for one in decisions) == decisions[-1].tick + 1


def test_it_listens_on_this_machine_only() -> None:
    ports: list[int] = []
    with live_view(0, on_open=ports.append):
        with socket.socket() as other:
            other.settimeout(1.0)
            # every address of 127/8 is this machine; only the first one is served
            assert other.connect_ex(("127.0.0.2", ports[0])) != 0
        with Viewer(ports[0]):
            pass
    assert any(refused(ports[0]) for _ in range(round(PATIENCE_S * 100)))  # closed with the flight


def test_a_port_that_is_taken_is_told() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=f"port {port} cannot be had.*--live-port"), live_view(port):
            pass
    for number in (70_000, -1):
        with pytest.raises(UsageError, match=f"--live-port {number}: ports are 1 to 65535"), live_view(number):
            pass


def test_without_the_extra_the_command_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(UsageError, match=r"pip install 'uavctl\[live\]'"), live_view(0):
        pass


def test_nothing_is_imported_when_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with live_view(None) as watch:
        assert watch is None


def test_in_virtual_time_there_is_nothing_to_watch(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["loopback", "--config", "paper", "--live"]) == 2
    assert "--live needs --udp" in capsys.readouterr().err
