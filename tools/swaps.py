"""Fly swaps across a circle with many vehicles in one room and one world, in moving cells or buffered Voronoi cells.

It prints, for each number of vehicles, the figures of all seeds from the true positions: how many arrived, collisions,
the closest pair, and the time to finish over that of a straight line. `--cycle` measures a cycle of the coordinator.

    python tools/swaps.py --vehicles 2 4 8 12 --seeds 20 [--first 1000] [--autopilot ardupilot] [--radio 5760]
        [--method voronoi --cell-distance 0.8]
    python tools/swaps.py --vehicles 20 --cycle
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import asdict
from pathlib import Path
from statistics import median

import numpy as np

from uavctl.arrays import Array
from uavctl.fleet.cell import PlannedPath, Report
from uavctl.fleet.coordinator import CellParameters, advance, begin, issue, receive
from uavctl.lab.swaps import SwapCase, SwapResult, fly_swap

CYCLES = 200
STAGES, DT_S = 49, 0.05  # of the presets of the autopilots
SPEED_MPS = 1.5


def make_grid(vehicles: int) -> Array:
    """Return places (N, 3) [m] on a grid in the room, at least 1 m apart for up to 25."""
    places_m = [(north, east, -1.2) for north in np.linspace(-2.4, 2.4, 5) for east in np.linspace(-2.4, 2.4, 5)]
    return np.array(places_m[:vehicles])


def measure_cycle_ms(vehicles: int) -> tuple[float, float]:
    """Measure cycles of the coordinator with a report of each vehicle: median and largest processor time [ms].

    Each vehicle has a plan towards its goal, and takes every cell at once.
    """
    begins_m = make_grid(vehicles)
    parameters = CellParameters(
        distance_m=0.5,
        room_lower_m=np.array([-3.0, -3.0, -3.0]),
        room_upper_m=np.array([3.0, 3.0, 0.0]),
        accel_mps2=np.array([3.9, 3.9, 1.5]),
        speed_mps=np.array([SPEED_MPS, SPEED_MPS, 1.0]),
        dt_s=DT_S,
        stages=STAGES,
    )
    state = begin(0, begins_m, begins_m[::-1].copy(), parameters)
    way_m = SPEED_MPS * DT_S * np.arange(STAGES)[:, None]
    durations_ms = []
    for cycle in range(CYCLES):
        reports = {}
        for number, cell in enumerate(state.newest):
            begin_m = state.reports[number].plan.advance(2 * cycle).mean_m[0]
            towards = cell.goal_m - begin_m
            length_m = max(float(np.linalg.norm(towards)), 1e-9)
            lower_m, upper_m = cell.find_limits(2 * cycle, STAGES)
            mean_m = np.clip(begin_m + np.minimum(way_m, length_m) * towards / length_m, lower_m, upper_m)
            plan = PlannedPath(2 * cycle, mean_m, np.zeros((STAGES, 3)))
            reports[number] = Report(plan, np.zeros(3), cell.number, cell.number)
        begin_s = time.process_time()
        state = issue(receive(advance(state, 2 * cycle), reports), parameters)
        durations_ms.append(1e3 * (time.process_time() - begin_s))
    return median(durations_ms), max(durations_ms)


def summarize(results: list[SwapResult]) -> dict[str, float]:
    """Summarize the swaps of one number of vehicles."""
    ratios = [result.finish_s / result.straight_s for result in results if not math.isnan(result.finish_s)]
    return {
        "vehicles": results[0].vehicles,
        "runs": len(results),
        "all_arrived": sum(result.arrived == result.vehicles for result in results),
        "collisions": sum(result.collisions for result in results),
        "closest": min(result.closest for result in results),
        "near_share": sum(result.near_share for result in results) / len(results),
        "outside_share": sum(result.outside_share for result in results) / len(results),
        "finish_ratio": median(ratios) if ratios else math.nan,
        "finish_ratio_max": max(ratios, default=math.nan),
        "exits": sum(result.exits for result in results),
        "landings": sum(result.landings for result in results),
    }


def main(arguments: list[str]) -> int:
    """Fly the swaps; return 1 if two vehicles collided, else 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[8])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--loss", type=float, default=0.3)
    parser.add_argument("--autopilot", choices=("px4", "ardupilot"), default="px4")
    parser.add_argument("--plant", choices=("linear", "quadrotor"), default="quadrotor")
    parser.add_argument("--method", choices=("cells", "voronoi"), default="cells")
    parser.add_argument("--cell-distance", type=float, metavar="M", help="distance of the cells; default: d = 0.5 m")
    parser.add_argument("--radio", type=float, metavar="BYTES_PER_S", help="one radio for the positions of all")
    parser.add_argument("--set", action="append", default=[], help="override of all vehicles")
    parser.add_argument("--out", type=Path, help="folder for the recordings, which are not kept without it")
    parser.add_argument("--cycle", action="store_true", help="measure a cycle of the coordinator only")
    parser.add_argument("--json", action="store_true", help="print each swap as a line of JSON")
    options = parser.parse_args(arguments)
    collisions = 0
    for vehicles in options.vehicles:
        if options.cycle:
            middle_ms, most_ms = measure_cycle_ms(vehicles)
            print(json.dumps({"vehicles": vehicles, "cycle_ms": middle_ms, "cycle_max_ms": most_ms}))  # noqa: T201
            continue
        results = []
        for seed in range(options.first, options.first + options.seeds):
            case = SwapCase(
                vehicles, seed, options.autopilot, options.plant, options.loss, options.method,
                overrides=tuple(options.set), radio_bytes_per_s=options.radio, cell_distance_m=options.cell_distance,
            )  # fmt: skip
            folder = None if options.out is None else options.out / f"swap-{vehicles}-{seed}"
            results.append(fly_swap(case, folder))
            if options.json:
                print(json.dumps(asdict(results[-1])), flush=True)  # noqa: T201
        summary = summarize(results)
        collisions += int(summary["collisions"])
        text = json.dumps(summary) if options.json else ", ".join(f"{k} {v:.4g}" for k, v in summary.items())
        print(text, flush=True)  # noqa: T201
    return 1 if collisions else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
