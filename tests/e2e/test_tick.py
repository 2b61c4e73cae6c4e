"""How many files a position and a planning tick cross, by a profiler, and that docs/tick.md draws them."""

from __future__ import annotations

import gc
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from inspect import getsource
from types import FrameType
from typing import TypeVar

import pytest
from loopback_rig import MemorySink
from places import ROOT

from sim.simulation import World
from uavctl.config import load_config
from uavctl.flight.tick import tick
from uavctl.loop import ControlLoop
from uavctl.records import LinkStats, Outgoing, Plan, Received, Send
from uavctl.wiring.controller import build_flight_design, prepare

PAGE = (ROOT / "docs" / "tick.md").read_text(encoding="utf-8")
T = TypeVar("T")
WARM_S = 1.0  # what is done once in a flight is done by then


@dataclass
class WatchedLoop:
    """A loop whose calls are watched; implements `uavctl.records.Flyer`."""

    loop: ControlLoop
    memory: MemorySink
    positions: list[frozenset[str]] = field(default_factory=list)
    planning: list[frozenset[str]] = field(default_factory=list)
    at_s: float = 0.0

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        received, files = trace_call(lambda: self.loop.receive(link, data, at_ns))
        if received.from_source and self.at_s > WARM_S:
            self.positions.append(files)
        return received

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        before, self.at_s = len(self.memory.entries), at_ns * 1e-9
        outgoing: list[Outgoing] = []
        _, files = trace_call(lambda: self.loop.tick(tick, at_ns, outgoing.append))
        kinds = {type(record) for _, _, record in self.memory.entries[before:]}
        if Plan in kinds and LinkStats not in kinds and self.at_s > WARM_S:  # counters of a second are not of the tick
            self.planning.append(files)
        for datagram in outgoing:
            send(datagram)


def trace_call(call: Callable[[], T]) -> tuple[T, frozenset[str]]:
    """What a call gives, and the product's files in which a function was called meanwhile."""
    files: set[str] = set()

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            files.add(frame.f_code.co_filename)

    gc.disable()  # what other tests left would be tidied up in its own files' names
    sys.setprofile(watch)
    try:
        result = call()
    finally:
        sys.setprofile(None)
        gc.enable()
    places = (name.removeprefix(f"{ROOT}/") for name in files if name.startswith(f"{ROOT}/"))
    return result, frozenset(place for place in places if place.startswith(("uavctl/", "sim/", "logs/")))


@pytest.fixture(scope="module")
def watched_loop() -> WatchedLoop:
    config = load_config("room-px4")
    prepared = prepare(config, build_flight_design(config))
    prepared.make_levels()  # as flights in real time do: the first tick of a level would make it
    memory = MemorySink()
    flyer = WatchedLoop(ControlLoop(config, prepared.controller, memory, lambda: 0), memory)
    World(config, flyer).run(5.0)
    return flyer


def test_a_position_crosses_few_files(watched_loop: WatchedLoop) -> None:
    assert len(watched_loop.positions) > 30
    assert max(map(len, watched_loop.positions)) <= 12


def test_the_phases_run_in_the_order_that_the_page_draws() -> None:
    drawn = re.findall(r"uavctl/flight/(\w+)\.py +(\d):", PAGE)
    assert [number for _, number in drawn] == list("123456")
    calls = re.findall(r"^    \w+ = (\w+)\(", getsource(tick), re.MULTILINE)[1:-1]
    modules = [getattr(sys.modules[tick.__module__], name).__module__ for name in calls]
    assert modules == [f"uavctl.flight.{name}" for name, _ in drawn]


def test_planning_ticks_were_watched(watched_loop: WatchedLoop) -> None:
    assert len(watched_loop.planning) > 30


@pytest.mark.parametrize(("title", "of"), [("A position", "positions"), ("A planning tick", "planning")])
def test_the_page_draws_what_is_crossed(watched_loop: WatchedLoop, title: str, of: str) -> None:
    (section,) = re.findall(rf"^## {title}\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    drawn = set(re.findall(r"uavctl/\S+\.py", section))
    assert frozenset().union(*getattr(watched_loop, of)) == drawn
