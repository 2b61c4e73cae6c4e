"""A link between two computers: measured over the simulator's channel, it has that channel's figures."""

from __future__ import annotations

import json
import math
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim.channel import Channel
from uavctl.cli.app import run
from uavctl.config import load, load_config
from uavctl.config.link import LinkConfig
from uavctl.errors import UavctlError
from uavctl.lab.link.measurement import WayResult, fit_way, write_link
from uavctl.lab.link.probe import LinkAnswer, LinkMeasurement, LinkProbe

MS, S = 1_000_000, 1_000_000_000
PERIOD_NS, COUNT = 10 * MS, 6000
OFFSET_NS = 123_456 * S  # of the answering computer's clock
BURSTS: dict[str, Any] = {"model": "gilbert-elliott", "burst_enter": 0.05, "burst_leave": 0.25}


def measure(there: LinkConfig, back: LinkConfig, count: int = COUNT, drift: float = 0.0) -> LinkProbe:
    """Measure both ways of a channel in virtual time, in steps of half a millisecond.

    Args:
        drift: Drift of the answering computer's clock [s/s].
    """

    def read_far_clock(at_ns: int) -> int:
        return at_ns + OFFSET_NS + round(drift * at_ns)

    seeds = np.random.SeedSequence(5).spawn(2)
    ways = Channel(there, seeds[0], 0), Channel(back, seeds[1], 0)
    probe, answer = LinkProbe(77, count, PERIOD_NS, 0), LinkAnswer()
    now_ns = 0
    while not probe.is_over(now_ns):
        for datagram in probe.poll(now_ns):
            ways[0].push(now_ns, datagram)
        for at_ns, data in ways[0].pop_due(now_ns):
            for reply in answer.receive(data, read_far_clock(at_ns)) or ():
                ways[1].push(now_ns, reply)
        for datagram in answer.poll(read_far_clock(now_ns)):
            ways[1].push(now_ns, datagram)
        for at_ns, data in ways[1].pop_due(now_ns):
            probe.receive(data, at_ns)
        now_ns += MS // 2
    return probe


@pytest.fixture(scope="module")
def measured() -> LinkMeasurement:
    """One way loses in bursts and is quick, the other one loses each packet by itself and is slow."""
    there = LinkConfig(delay_s=0.004, jitter_s=0.006, **BURSTS)
    return measure(there, LinkConfig(loss=0.2, delay_s=0.004, jitter_s=0.012)).measure()


def test_each_way_has_its_own_losses(measured: LinkMeasurement) -> None:
    # Shares of 1/6 with memory 0.7, and of 0.2: π(1 − π)(1 + λ)/(1 − λ)/n is the variance.
    bad, memory = 0.05 / 0.3, 1.0 - 0.05 - 0.25
    error = math.sqrt(bad * (1 - bad) * (1 + memory) / (1 - memory) / COUNT)
    assert abs(np.isinf(measured.there.delays_s).mean() - bad) < 4 * error
    assert abs(np.isinf(measured.back.delays_s).mean() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / COUNT)


def test_losses_in_bursts_are_told_from_those_by_themselves(measured: LinkMeasurement) -> None:
    bursts, alone = fit_way(measured.there), fit_way(measured.back)
    assert (bursts.bursts, alone.bursts) == (True, False)
    # Runs after an arrival: none with 1 − 0.05, else geometric with a mean of 1 / 0.25.
    runs = np.array(bursts.runs)
    arrivals = int(np.isfinite(measured.there.delays_s).sum())
    assert abs(runs[0] - 0.95) < 4 * math.sqrt(0.95 * 0.05 / arrivals)
    mean_run = float((np.arange(len(runs)) * runs).sum() / runs[1:].sum())
    assert abs(mean_run - 4.0) < 4 * math.sqrt(0.75 / 0.25**2 / (arrivals * 0.05))


def test_delays_are_those_of_the_channel_and_the_clocks_may_differ(measured: LinkMeasurement) -> None:
    # The shortest round trip has 4 ms either way, so neither the offset nor a way is wrong by more than a step or two.
    assert abs(measured.clock_offset_s - OFFSET_NS / S) < 0.0015
    for way, jitter_s in ((measured.there, 0.006), (measured.back, 0.012)):
        fit = fit_way(way)
        assert abs(fit.delay_s - 0.004) < 0.002
        assert abs(fit.jitter_s - 0.99 * jitter_s) < 0.002
    assert measured.round_trips_s.min() >= 0.008
    assert measured.round_trips_s.max() <= 0.026 + 0.001


@pytest.mark.parametrize("drift", [-2e-4, 0.0, 2e-4])
def test_a_drift_of_the_clocks_is_no_jitter(drift: float) -> None:
    """In 30 s the clocks drift apart by 6 ms, three times the jitter."""
    ways = LinkConfig(loss=0.1, delay_s=0.004, jitter_s=0.002), LinkConfig(delay_s=0.004, jitter_s=0.001)
    measurement = measure(*ways, count=3000, drift=drift).measure()
    assert abs(measurement.clock_drift - drift) < 5e-6
    assert abs(measurement.clock_offset_s - OFFSET_NS / S) < 0.0002
    for way, jitter_s in ((measurement.there, 0.002), (measurement.back, 0.001)):
        fit = fit_way(way)
        assert abs(fit.delay_s - 0.004) < 0.0002
        assert abs(fit.jitter_s - 0.99 * jitter_s) < 0.0003


def test_a_silent_other_side_ends_in_an_error_that_names_the_command() -> None:
    probe = measure(LinkConfig(loss=0.999), LinkConfig(blackout=((0.0, 1e6),)), count=100)
    with pytest.raises(UavctlError, match=r"uavctl bench --link udpin"):
        probe.measure()


def test_too_few_arrivals_say_nothing() -> None:
    probe = measure(LinkConfig(loss=0.1), LinkConfig(), count=30)
    with pytest.raises(UavctlError, match="--seconds"):
        probe.measure()


def test_datagrams_of_others_change_nothing() -> None:
    probe, answer = LinkProbe(1, 100, PERIOD_NS, 0), LinkAnswer()
    (first,) = probe.poll(0)
    for data in (b"", first[:-1], b"\0" * len(first), b"x" * len(first)):
        assert answer.receive(data, 0) is None
        probe.receive(data, 0)
    assert answer.receive(first, 0) == []
    assert LinkProbe(2, 100, PERIOD_NS, 0).poll(0)[0] != first
    (reply,) = answer.poll(0)
    stranger = LinkProbe(2, 100, PERIOD_NS, 0)
    stranger.receive(reply, 1)
    with pytest.raises(UavctlError, match="0 of 100"):
        stranger.measure()


def test_the_answering_side_goes_silent_after_the_last_probe() -> None:
    """A single datagram with another's address must not make it send for minutes."""
    answer = LinkAnswer()
    (first,) = LinkProbe(1, 20_000, MS, 0).poll(0)
    answer.receive(first, 0)
    sent = sum(len(answer.poll(now_ns)) for now_ns in range(0, 30 * S, MS))
    assert sent <= 1001


@pytest.mark.parametrize("name", ["link", "link-back"])
def test_a_flight_in_simulation_loads_what_was_measured(name: str, measured: LinkMeasurement, tmp_path: Path) -> None:
    result = write_link(measured, load_config("room"), "udpout://host:1", tmp_path)
    way: WayResult = result.there if name == "link" else result.back
    assert way.config == str(tmp_path / f"{name}.toml")
    config = load(way.config, ()).config
    assert abs(config.link.mean_loss - way.lost / way.packets) < 0.01
    trace = load("room", ("link.model=trace", f'link.trace_file="{way.trace}"')).config
    assert sum(math.isinf(delay_s) for delay_s in trace.link.trace_s) == way.lost
    out = str(tmp_path / "flight")
    assert run(("loopback", "--config", way.config, "--duration", "2", "--out", out)) == 0


class Proxy:
    """A lossy link of real UDP: between a port of its own and another, over the simulator's channel."""

    def __init__(self, target_port: int, there: LinkConfig, back: LinkConfig) -> None:
        seeds = np.random.SeedSequence(9).spawn(2)
        now_ns = time.monotonic_ns()
        self._ways = Channel(there, seeds[0], now_ns), Channel(back, seeds[1], now_ns)
        self._near, self._far = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(2))
        self._near.bind(("127.0.0.1", 0))
        self._far.connect(("127.0.0.1", target_port))
        for sock in (self._near, self._far):
            sock.setblocking(False)
        self.port = self._near.getsockname()[1]
        self._peer: Any = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._done.wait(0.0005):
            now_ns = time.monotonic_ns()
            try:
                while True:
                    data, self._peer = self._near.recvfrom(4096)
                    self._ways[0].push(now_ns, data)
            except OSError:
                pass
            try:
                while True:
                    self._ways[1].push(now_ns, self._far.recv(4096))
            except OSError:
                pass
            for _, data in self._ways[0].pop_due(now_ns):
                self._far.send(data)
            for _, data in self._ways[1].pop_due(now_ns):
                self._near.sendto(data, self._peer)

    def close(self) -> None:
        self._done.set()
        self._thread.join()
        self._near.close()
        self._far.close()

    @property
    def lost(self) -> tuple[int, int]:
        return self._ways[0].counters.lost, self._ways[1].counters.lost


@pytest.mark.slow
def test_two_processes_measure_a_lossy_link_of_real_sockets(tmp_path: Path) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "uavctl", "bench", "--json", "--link"]
    pipe = subprocess.PIPE
    with subprocess.Popen([*command, f"udpin://127.0.0.1:{port}"], stdout=pipe, stderr=pipe, text=True) as answering:
        assert answering.stderr is not None
        assert answering.stderr.readline().startswith("answering on")
        proxy = Proxy(port, LinkConfig(loss=0.3, delay_s=0.02), LinkConfig(loss=0.1, delay_s=0.02))
        options = ["--seconds", "6", "--rate", "100", "--out", str(tmp_path)]
        done = subprocess.run(
            [*command, f"udpout://127.0.0.1:{proxy.port}", *options], capture_output=True, check=False
        )
        answered, _ = answering.communicate()
        proxy.close()
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (json.loads(answered)["answered"], answering.returncode) == (True, 0)
    for way, loss, channel_lost in zip((result["there"], result["back"]), (0.3, 0.1), proxy.lost, strict=True):
        assert way["packets"] == 600
        assert way["lost"] <= channel_lost  # the channel also lost questions and reports
        assert abs(way["lost"] / 600 - loss) < 4 * math.sqrt(loss * (1 - loss) / 600)
    # No packet is faster than the proxy; on a busy computer some are far slower
    assert result["there"]["delay_s"] + result["back"]["delay_s"] > 0.039
    assert result["round_trip_s"][0] >= 0.04


def test_more_packets_than_a_trace_has_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(("bench", "--link", "udpout://127.0.0.1:9", "--seconds", "300", "--rate", "100", "--json")) == 2
    assert "30000 packets" in json.loads(capsys.readouterr().out)["message"]
