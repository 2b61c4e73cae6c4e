"""Fly swaps across a circle with many linear vehicles in one room, in moving cells or buffered Voronoi cells.

It prints, for each number of vehicles, the figures of all seeds from the true positions: how many arrived, collisions,
the closest pair, and the time to finish over that of a straight line. `--cycle` measures a cycle of the coordinator.

    python tools/swaps.py --vehicles 2 4 8 12 --seeds 20 [--first 1000] [--method voronoi] [--loss 0.3] [--json]
    python tools/swaps.py --vehicles 20 --cycle
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import asdict
from statistics import median

import numpy as np

from uavctl.arrays import Array
from uavctl.fleet.coordinator import advance, issue, receive
from uavctl.lab.swaps import SwapCase, SwapResult, SwapWorld, build_swap_design, fly_swap
from uavctl.smpc.conditioned.design import ConditionedDesign

CYCLES, WARM_STEPS = 200, 12


def make_grid(vehicles: int) -> Array:
    """Return places (N, 3) [m] on a grid in the room, at least 1 m apart for up to 25."""
    places_m = [(north, east, -1.2) for north in np.linspace(-2.4, 2.4, 5) for east in np.linspace(-2.4, 2.4, 5)]
    return np.array(places_m[:vehicles])


def measure_cycle_ms(vehicles: int, design: ConditionedDesign) -> tuple[float, float]:
    """Measure cycles of the coordinator with a report of each vehicle: median and largest processor time [ms]."""
    begins_m = make_grid(vehicles)
    world = SwapWorld(SwapCase(vehicles, seed=0, loss=0.0), design, begins_m, begins_m[::-1].copy())
    for _ in range(WARM_STEPS):
        world.advance()
    state, reports = world.coordinator, dict(enumerate(world.coordinator.reports))
    durations_ms = []
    for _ in range(CYCLES):
        begin = time.process_time()
        issue(receive(advance(state, world.step), reports), world.parameters)
        durations_ms.append(1e3 * (time.process_time() - begin))
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
        "finish_ratio": median(ratios) if ratios else math.nan,
        "finish_ratio_max": max(ratios, default=math.nan),
        "outside_share": sum(result.outside_share for result in results) / len(results),
        "slack_share": sum(result.slack_share for result in results) / len(results),
        "refused_share": sum(result.refused_share for result in results) / len(results),
    }


def main(arguments: list[str]) -> int:
    """Fly the swaps; return 1 if two vehicles collided, else 0."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--vehicles", type=int, nargs="+", default=[8])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--loss", type=float, default=0.3)
    parser.add_argument("--method", choices=("cells", "voronoi"), default="cells")
    parser.add_argument("--cycle", action="store_true", help="measure a cycle of the coordinator only")
    parser.add_argument("--json", action="store_true", help="print each swap as a line of JSON")
    options = parser.parse_args(arguments)
    design, collisions = build_swap_design(), 0
    for vehicles in options.vehicles:
        if options.cycle:
            middle_ms, most_ms = measure_cycle_ms(vehicles, design)
            print(json.dumps({"vehicles": vehicles, "cycle_ms": middle_ms, "cycle_max_ms": most_ms}))  # noqa: T201
            continue
        results = []
        for seed in range(options.first, options.first + options.seeds):
            results.append(fly_swap(SwapCase(vehicles, seed, options.loss, options.method), design))
            if options.json:
                print(json.dumps(asdict(results[-1])), flush=True)  # noqa: T201
        summary = summarize(results)
        collisions += int(summary["collisions"])
        text = json.dumps(summary) if options.json else ", ".join(f"{k} {v:.4g}" for k, v in summary.items())
        print(text, flush=True)  # noqa: T201
    return 1 if collisions else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
