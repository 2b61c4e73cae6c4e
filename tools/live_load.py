"""What the fastest clients of a live view cost the ticks of a flight in real time, on loopback alone.

`python tools/live_load.py`: one flight of `uavctl loopback --udp --live`, in phases of some seconds in turns: without
any client, with clients of this flight's view, and with the same clients at a view that no flight feeds. The third kind
shows what the clients cost by their use of the processor alone. Told are missed ticks and how late ticks began.

The clients are two processes: one opens connections as fast as it can (answers that are read, answers that are not,
requests without an end), the other holds viewers that read nothing and sends requests for topics without a pause.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import cycle
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

from live_rig import HANDSHAKE, make_frame, make_head
from places import without_pages

from logs.live.process import LiveProcess
from logs.recording.reader import read_kind
from uavctl.clock import monotonic_ns
from uavctl.records import Decision, Timing

KINDS = ("no client", "at the flight's view", "at another view")
MAX_OPEN = 64  # connections that a client holds
LOCAL = {"Host": "localhost"}
TOPICS = json.dumps({"op": "subscribe", "subscriptions": [{"id": n, "channelId": n} for n in range(1, 40)]}).encode()
START_S = 4.0  # until the flight's own start no longer shows


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, and print a line for each kind of phase."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a phase, at most 10")
    parser.add_argument("--rounds", type=int, default=6, help="phases of each kind")
    parser.add_argument("--config", default="room")
    given = parser.parse_args(arguments)
    if not 1.0 <= given.seconds <= 10.0 or given.rounds < 1:
        parser.error("a phase has 1 to 10 s, and there is at least one round")
    with tempfile.TemporaryDirectory(prefix="uavctl-") as folder:
        phases, counts = fly(Path(folder), given.config, given.seconds, given.rounds)
        rows = [summarise(Path(folder) / "flight.mcap", kind, phases) for kind in KINDS]
    sys.stdout.write(json.dumps({"phases": rows, "clients": counts}, indent=1) + "\n")
    return 0


Phase = tuple[str, int, int]  # kind, begin and end on the monotonic clock [ns]


def fly(folder: Path, config: str, seconds: float, rounds: int) -> tuple[list[Phase], dict[str, dict[str, int]]]:
    """Fly beside clients; return the phases, and what the clients did in those of each kind."""
    duration_s = START_S + (seconds + 1.0) * rounds * len(KINDS) + 1.0
    command = [sys.executable, "-m", "uavctl", "loopback", "--udp", "--config", config, "--out", str(folder)]
    command += ["--duration", str(duration_s), "--live", "--live-port", "0", "--json"]
    phases: list[Phase] = []
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    other_view = LiveProcess(0, print)
    try:
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=without_pages()
        ) as flight:
            try:
                ports = {"at the flight's view": find_port(flight), "at another view": other_view.port}
                wait_for_flight(ports["at the flight's view"])
                for kind in KINDS * rounds:
                    begin_ns = monotonic_ns()
                    with running_clients(ports.get(kind), seconds) as results:
                        time.sleep(seconds)
                    phases.append((kind, begin_ns, begin_ns + round(seconds * 1e9)))
                    for result in results:
                        counts[kind].update(result)
                    time.sleep(max(0.0, 1.0 - (monotonic_ns() - phases[-1][2]) * 1e-9))
                flight.wait()
            finally:
                flight.kill()
    finally:
        other_view.close()
    return phases, {kind: dict(count) for kind, count in counts.items()}


def find_port(flight: subprocess.Popen[str]) -> int:
    """Return the port of a flight's view, as its console shows it."""
    for line in flight.stderr or ():
        if found := re.search(r"ws://localhost:(\d+)", line):
            return int(found[1])
    raise SystemExit("the flight ended before it served anything")


def wait_for_flight(port: int) -> None:
    """Wait until the page has a state of a flight that is under way."""
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.sendall(make_head(LOCAL, "/scenes"))
        for line in client.makefile("rb"):
            if line.startswith(b"data: {") and json.loads(line[6:])["time_s"] > START_S:
                return


@contextmanager
def running_clients(port: int | None, seconds: float) -> Iterator[list[dict[str, int]]]:
    """Run the clients beside the caller, for some seconds; the list has what they did, at the end."""
    results: list[dict[str, int]] = []
    if port is None:
        yield results
        return
    context = multiprocessing.get_context("fork")  # at once, and without the time that a new interpreter takes
    pipes = []
    for attack in (flood_requests, flood_websockets):
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=lambda attack=attack, sender=sender: sender.send(attack(port, seconds)))
        process.start()
        pipes.append((process, receiver))
    yield results
    for process, receiver in pipes:
        if receiver.poll(seconds):
            results.append(receiver.recv())
        process.kill()
        process.join()


def flood_requests(port: int, seconds: float) -> dict[str, int]:
    """Open connections as fast as possible, of three kinds in turns; return what came of them."""
    end_s, count = time.monotonic() + seconds, Counter[str]()
    held: deque[socket.socket] = deque()
    requests = cycle((make_head(LOCAL), make_head(LOCAL, "/scenes"), make_head(LOCAL)[:-2], make_head(LOCAL) * 200))
    for request in requests:
        if time.monotonic() >= end_s:
            break
        while len(held) >= MAX_OPEN:
            held.popleft().close()
        client = socket.socket()
        client.settimeout(0.05)
        held.append(client)
        with suppress(OSError):
            client.connect(("127.0.0.1", port))
            client.sendall(request)
            count["connections"] += 1
            if request == make_head(LOCAL):
                while client.recv(1 << 16):
                    pass
                count["pages"] += 1
    for client in held:
        client.close()
    return dict(count)


def flood_websockets(port: int, seconds: float) -> dict[str, int]:
    """Hold eight viewers that read nothing, and send their requests as fast as the server takes them."""
    end_s, count = time.monotonic() + seconds, Counter[str]()
    frame = make_frame(TOPICS) * 16
    viewers: list[socket.socket] = []
    while time.monotonic() < end_s:
        while len(viewers) < 8:
            viewer = socket.socket()
            viewer.settimeout(0.05)
            viewers.append(viewer)
            with suppress(OSError):
                viewer.connect(("127.0.0.1", port))
                viewer.sendall(make_head(HANDSHAKE))
                count["viewers"] += 1
            viewer.setblocking(False)
        for viewer in list(viewers):
            try:
                count["bytes"] += viewer.send(frame)
            except BlockingIOError:
                continue
            except OSError:
                viewer.close()
                viewers.remove(viewer)
    for viewer in viewers:
        viewer.close()
    return dict(count)


def summarise(path: Path, kind: str, phases: list[Phase]) -> dict[str, float | str]:
    """Return ticks, missed ticks and how late ticks began in all phases of a kind."""

    def is_inside(at_ns: int) -> bool:
        return any(name == kind and begin_ns <= at_ns < end_ns for name, begin_ns, end_ns in phases)

    decisions = [one for one in read_kind(path, Decision) if is_inside(one.at_ns)]
    late_ms = np.array([one.lateness_ns for one in read_kind(path, Timing) if is_inside(one.at_ns)]) * 1e-6
    return {
        "clients": kind,
        "ticks": len(decisions),
        "missed": sum(one.missed_ticks for one in decisions),
        **{f"late_p{share:g}_ms": round(float(np.percentile(late_ms, share)), 2) for share in (50, 99, 100)},
    }


if __name__ == "__main__":
    sys.exit(main())
