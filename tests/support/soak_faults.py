"""Random faults on preset `room`, flight after flight: what the link, the cameras, the wind and the pilot can do."""

from __future__ import annotations

import gc
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from soak_rig import fly

from uavctl.config import Config, load_config
from uavctl.config.sim import FaultConfig
from uavctl.wiring.controller import Prepared

FLIGHT_S = 180.0
SPANS = ("blackout", "held", "uplink_blackout", "occluded", "swapped", "frozen")
LONGEST_SPAN_S = 6.0
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def draw_world(seed: int, flight_s: float = FLIGHT_S) -> Config:
    """The world of a flight: another link than the design counts on, another plant, and things that happen to it."""
    rng = np.random.default_rng(seed)
    plant = str(rng.choice(["linear", "quadrotor"], p=[0.7, 0.3]))
    autopilot = str(rng.choice(["px4", "ardupilot"]))
    config = load_config(
        "room-hahn-stursberg", [f"sim.plant={plant}", f"sim.autopilot={autopilot}", f"sim.seed={seed}"]
    )
    config = replace(config, duration_s=flight_s)
    link = replace(
        config.link,
        loss=float(rng.uniform(0.0, 0.6)),
        delay_s=float(rng.uniform(0.0, 0.15)),
        jitter_s=float(rng.uniform(0.0, 0.3)),
        duplicate=float(rng.uniform(0.0, 0.1)),
        corrupt=float(rng.uniform(0.0, 0.05)),
        truncate=float(rng.uniform(0.0, 0.02)),
        oversize=float(rng.uniform(0.0, 0.01)),
    )
    camera = replace(
        config.sim.camera,
        rate_hz=float(rng.choice([5.0, 10.0, 20.0])),
        clock_offset_s=float(rng.uniform(-100.0, 100.0)),
        clock_drift_ppm=float(rng.uniform(-200.0, 200.0)),
        occlusions_per_s=float(rng.uniform(0.0, 0.05)),
        other_body_m=(1.0, -1.0, -0.5),
    )
    wind = replace(config.sim.wind, gust_wind_mps=float(rng.uniform(0.0, 6.0)))
    return replace(
        config, link=link, sim=replace(config.sim, camera=camera, wind=wind, fault=_faults(rng, plant, flight_s))
    )


def _faults(rng: np.random.Generator, plant: str, flight_s: float) -> tuple[FaultConfig, ...]:
    """About one in 20 s: spans of a bad link or bad cameras, other wind, and now and then the pilot's stick."""
    faults = []
    for at_s in np.sort(rng.uniform(0.0, flight_s, rng.poisson(flight_s / 20.0))).tolist():
        what = rng.uniform()
        if what < 0.9 or plant == "linear":
            kind, for_s = str(rng.choice(SPANS)), float(rng.uniform(0.1, LONGEST_SPAN_S))
            faults.append(FaultConfig(at_s=at_s, kind=kind, for_s=for_s))  # type: ignore[arg-type]  # one of them
        else:
            north, east = rng.uniform(-1.5, 1.5, 2).tolist()
            faults.append(FaultConfig(at_s=at_s, kind="wind", velocity_mps=(north, east, 0.0)))
    return tuple(faults)


@dataclass(frozen=True)
class FlightBatch:
    """What a run of flights came to.

    Attributes:
        first: Seed of its first flight; the others follow.
        flights: How many.
        hours: Virtual time flown [h].
        ticks: Control ticks.
        modes: Ticks in each mode.
        wrong: What was wrong, by seed.
        grown_bytes: Memory of the process at the end, beyond that after the warm-up.
    """

    first: int
    flights: int
    hours: float
    ticks: int
    modes: dict[str, int]
    wrong: dict[int, tuple[str, ...]]
    grown_bytes: int


def fly_faults(
    prepared: Prepared, first: int, hours: float, warm_up: int, out: Path | None = None, flight_s: float = FLIGHT_S
) -> FlightBatch:
    """Fly until so many hours are over, each flight from its own seed; those with findings are flown again, recorded.

    Args:
        prepared: `soak_rig.prepared_for()`, the preset as it is.
        first: Seed of the first flight; one up for each next.
        hours: Virtual time to fly at least [h].
        warm_up: Flights before memory is measured for the first time.
        out: Folder for recordings of findings; None keeps none.
        flight_s: Longest flight; one that has landed ends before [s].
    """
    tick_s = prepared.config.daemon.tick_s
    wrong: dict[int, tuple[str, ...]] = {}
    modes: dict[str, int] = {}
    flights, ticks, begun_bytes, spent_s = 0, 0, 0, 0.0
    while spent_s < hours * 3600.0 or flights <= warm_up:
        seed = first + flights
        result, flown = _flight(prepared, draw_world(seed, flight_s), None)
        if result:
            wrong[seed] = result
            if out is not None:
                _flight(prepared, draw_world(seed, flight_s), out / f"faults-{seed}.mcap")
        flights += 1
        for mode, count in flown.items():
            modes[mode] = modes.get(mode, 0) + count
        ticks += sum(flown.values())
        # One that broke off has no ticks to tell and counts in full: else, if all do, this would never end.
        spent_s += sum(flown.values()) * tick_s if flown else flight_s
        if flights == warm_up:
            begun_bytes = memory_bytes()
    grown = memory_bytes() - begun_bytes
    return FlightBatch(first, flights, ticks * tick_s / 3600.0, ticks, modes, wrong, grown)


def _flight(prepared: Prepared, config: Config, path: Path | None) -> tuple[tuple[str, ...], dict[str, int]]:
    """What was wrong with a flight, and its ticks in each mode."""
    try:
        watch = fly(prepared, config, path=path)
    except Exception as error:  # noqa: BLE001 - whatever it is, it is the finding
        return (f"{type(error).__name__}: {error}",), {}
    return tuple(watch.wrong), watch.modes


def memory_bytes() -> int:
    """Resident memory of this process [bytes], after a collection."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_BYTES
