"""A lockstep flight in memory: the real loop, the real simulator, no disk."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

import msgspec

from logs.recording.flight import FlightData
from sim.simulation import World
from uavctl.config import Config, load_config
from uavctl.config.load import dump_config
from uavctl.flight.controller import Controller
from uavctl.loop import ControlLoop
from uavctl.records import Header, Record, Sink
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.wiring.controller import build_controller, build_flight_design, make_design_record

R = TypeVar("R", bound=Record)


class MemorySink:
    """Sink that keeps everything, in order."""

    def __init__(self) -> None:
        self.entries: list[tuple[str, int, Record]] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        self.entries.append((topic, at_ns, record))

    def of(self, kind: type[R]) -> list[R]:
        return [record for _, _, record in self.entries if isinstance(record, kind)]


def make_loop(config: Config, sink: Sink, design: AnyDesign | None = None) -> ControlLoop:
    return ControlLoop(config, build_controller(config, design), sink, lambda: 0)


def share_flight(config: Config) -> tuple[AnyDesign, Controller]:
    """Design and controller, made once for flights that differ in length and simulator alone.

    A flight leaves nothing in its controller; a replay, which makes one of its own, would find out.
    """
    return _made(msgspec.structs.replace(config, sim=load_config("paper").sim, duration_s=1.0))


@lru_cache(maxsize=8)
def _made(config: Config) -> tuple[AnyDesign, Controller]:
    design = build_flight_design(config)
    return design, build_controller(config, design)


def shared_loop(config: Config, sink: Sink) -> ControlLoop:
    """Return a loop with a controller that is shared, see `share_flight`; `make_loop` makes a new one."""
    return ControlLoop(config, share_flight(config)[1], sink, lambda: 0)


def lockstep(name: str, duration_s: float, *overrides: str) -> MemorySink:
    """Fly a preset in virtual time."""
    config = load_config(name, [f"duration_s={duration_s}", *overrides])
    design, controller = share_flight(config)
    memory = MemorySink()
    memory.put("/uavctl/header", 0, header(config, design))
    loop = ControlLoop(config, controller, memory, lambda: 0)
    World(config, loop, on_truth=lambda truth: memory.put("/sim/truth", truth.at_ns, truth)).run(duration_s)
    return memory


def header(config: Config, design: AnyDesign) -> Header:
    return Header(
        started_ns=0,
        started_utc="2026-01-01T00:00:00",
        seed=config.sim.seed,
        command="test",
        config_toml=dump_config(config),
        design_id=design.design_id,
        design=make_design_record(design),
        versions={},
        cpu="",
    )


def flight(memory: MemorySink) -> FlightData:
    return FlightData.from_records(memory.entries)
