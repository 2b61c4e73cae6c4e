"""Many flights in virtual time, judged tick by tick.

`python tools/soak.py --scenario mission --seeds 100`: presets `room-px4` and `room-ardupilot` as quadrotors in gusts,
30 % loss in bursts, 20 to 120 ms of delay: take-off, four waypoints, landing. No wall may be touched.
`python tools/soak.py --hours 100`: random faults. A fallback in the very tick in which the age reaches H, every
setpoint finite, bounded and slew-limited, no exception, and memory that does not grow.
`python tools/soak.py --scenario pairs --seeds 500`: two faults at a time, both plants, both autopilots: the true
vehicle stays within 1 m of the room and below 3 m/s, whatever mode anybody believes to be in.
`python tools/soak.py --scenario take-off --seeds 100`: take-offs of each autopilot by relayed positions, 30 % of them
lost in bursts of ten, checks that flicker, failsafes: engaged, or on the ground with the reason told, within 60 s.
`python tools/soak.py --scenario core --ticks 1000000`: the same of the control tick alone, with random inputs.
`python tools/soak.py --scenario replay --seeds 100`: random configurations, everything amiss, recorded, and replayed
from the file alone, a few of them in a process of their own: every decision the same, bit for bit.

Exit code 1 where something was wrong; recordings of those flights are in `--out`.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

from chaos import soak_core
from soak_faults import FlightBatch, fly_faults  # the tests' own
from soak_mission import AUTOPILOTS, MissionFlight, fly_mission, prepare_mission, summary
from soak_pairs import TrueFlight, fly_pair
from soak_replay import ReplayedFlight, replay_in_process, replay_seed, tally_flights
from soak_rig import prepare_room
from soak_take_off import TakeOff, fly_take_off, tally_take_offs

PROCESSES = 2
BATCH_SEEDS = 1_000_000  # seeds that each process of the faults has for itself
WARM_UP = 5
APART_EVERY = 10  # flights of which one is replayed in a process of its own as well
MOST_GROWN_BYTES = 5 * 1024 * 1024


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, tell, and say whether all was well."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--scenario", choices=("mission", "take-off", "faults", "pairs", "core", "replay"), default="faults"
    )
    parser.add_argument(
        "--seeds", type=int, default=100, help="missions of each autopilot, flights with pairs of faults, or to replay"
    )
    parser.add_argument("--hours", type=float, default=1.0, help="virtual time with faults")
    parser.add_argument("--ticks", type=int, default=1_000_000, help="control ticks alone")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--out", type=Path, default=Path("flights/soak"), help="folder for recordings of failures")
    parser.add_argument("--json", action="store_true", help="figures as JSON, one document")
    given = parser.parse_args(arguments)
    if min(given.seeds, given.ticks) < 1 or not 0.0 < given.hours < math.inf or given.first < 0:
        parser.error("give at least one seed and tick, hours above 0, and a first seed of 0 or more")
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"  # of the processes to come; the last bits would depend on it
    given.out.mkdir(parents=True, exist_ok=True)
    begun = time.monotonic()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(PROCESSES, mp_context=context) as pool:
        report, good = _SCENARIOS[given.scenario](pool, given)
    report["wall_s"] = round(time.monotonic() - begun, 1)
    sys.stdout.write(json.dumps(report) + "\n" if given.json else _text(report))
    return 0 if good else 1


def missions(seeds: Sequence[int], out: Path) -> list[MissionFlight]:
    """Fly missions of both autopilots in this process; those that went wrong again, recorded."""
    flights = []
    for autopilot in AUTOPILOTS:
        prepared = prepare_mission(autopilot)
        for seed in seeds:
            flights.append(fly_mission(prepared, seed))
            if not flights[-1].good:
                fly_mission(prepared, seed, out / f"{autopilot}-{seed}.mcap")
    return flights


def faults(first: int, hours: float, out: Path) -> FlightBatch:
    """Fly with faults in this process."""
    return fly_faults(prepare_room(), first, hours, WARM_UP, out)


def pairs(seeds: Sequence[int], out: Path) -> list[TrueFlight]:
    """Fly pairs of faults in this process; those that went wrong again, recorded."""
    prepared = prepare_room()
    flights = [fly_pair(prepared, seed) for seed in seeds]
    for flight in flights:
        if flight.wrong:
            fly_pair(prepared, flight.seed, out / f"pair-{flight.seed}.mcap")
    return flights


def _pairs(pool: ProcessPoolExecutor, given: argparse.Namespace) -> tuple[dict[str, object], bool]:
    seeds = list(range(given.first, given.first + given.seeds))
    waiting = [pool.submit(pairs, seeds[i : i + 5], given.out) for i in range(0, len(seeds), 5)]
    flights: list[TrueFlight] = []
    for done in as_completed(waiting):
        flights += done.result()
        sys.stderr.write(f"\r{len(flights)} of {given.seeds} flights ")
    sys.stderr.write("\n")
    furthest = max(flights, key=lambda flight: flight.outside_m)
    fastest = max(flights, key=lambda flight: flight.speed_mps)
    wrong = {str(flight.seed): [flight.what, *flight.wrong] for flight in flights if flight.wrong}
    document: dict[str, object] = {
        "flights": len(flights),
        "outside": sum(flight.outside_m > 0.0 for flight in flights),
        "outside_m_worst": furthest.outside_m,
        "furthest": f"seed {furthest.seed}, {furthest.what}",
        "speed_mps_worst": fastest.speed_mps,
        "fastest": f"seed {fastest.seed}, {fastest.what}",
        "let_go": sum(any("envelope-" in alarm for alarm in flight.alarms) for flight in flights),
        "wrong": wrong,
    }
    return document, not wrong


def _missions(pool: ProcessPoolExecutor, given: argparse.Namespace) -> tuple[dict[str, object], bool]:
    seeds = range(given.first, given.first + given.seeds)
    waiting = [pool.submit(missions, seeds[i : i + 5], given.out) for i in range(0, len(seeds), 5)]
    flights: list[MissionFlight] = []
    for done in as_completed(waiting):
        flights += done.result()
        sys.stderr.write(f"\r{len(flights)} of {2 * given.seeds} missions ")
    sys.stderr.write("\n")
    flights.sort(key=lambda flight: (flight.autopilot, flight.seed))
    report: dict[str, object] = {
        autopilot: summary([flight for flight in flights if flight.autopilot == autopilot]) for autopilot in AUTOPILOTS
    }
    report["flights"] = [asdict(flight) for flight in flights]
    return report, all(flight.good for flight in flights)


def take_offs(autopilot: str, seeds: Sequence[int]) -> list[TakeOff]:
    """Take off in this process."""
    return [fly_take_off(autopilot, seed) for seed in seeds]


def _take_offs(pool: ProcessPoolExecutor, given: argparse.Namespace) -> tuple[dict[str, object], bool]:
    seeds = range(given.first, given.first + given.seeds)
    waiting = [
        pool.submit(take_offs, autopilot, seeds[i : i + 5]) for autopilot in AUTOPILOTS for i in range(0, len(seeds), 5)
    ]
    flights: list[TakeOff] = []
    for done in as_completed(waiting):
        flights += done.result()
        sys.stderr.write(f"\r{len(flights)} of {2 * given.seeds} take-offs ")
    sys.stderr.write("\n")
    flights.sort(key=lambda flight: (flight.autopilot, flight.seed))
    report: dict[str, object] = {
        autopilot: tally_take_offs([flight for flight in flights if flight.autopilot == autopilot])
        for autopilot in AUTOPILOTS
    }
    report["flights"] = [asdict(flight) for flight in flights]
    return report, not any(flight.wrong for flight in flights)


def _faults(pool: ProcessPoolExecutor, given: argparse.Namespace) -> tuple[dict[str, object], bool]:
    share = given.hours / PROCESSES
    waiting = [pool.submit(faults, given.first + i * BATCH_SEEDS, share, given.out) for i in range(PROCESSES)]
    batches = [done.result() for done in as_completed(waiting)]
    modes: dict[str, int] = {}
    for batch in batches:
        for mode, count in batch.modes.items():
            modes[mode] = modes.get(mode, 0) + count
    grown = max(batch.grown_bytes for batch in batches)
    wrong = {str(seed): found for batch in batches for seed, found in batch.wrong.items()}
    report: dict[str, object] = {
        "hours": sum(batch.hours for batch in batches),
        "flights": sum(batch.flights for batch in batches),
        "ticks": sum(batch.ticks for batch in batches),
        "modes": modes,
        "grown_bytes": grown,
        "wrong": wrong,
    }
    return report, not wrong and grown < MOST_GROWN_BYTES


def _core(pool: ProcessPoolExecutor, given: argparse.Namespace) -> tuple[dict[str, object], bool]:
    share = -(-given.ticks // PROCESSES)
    counts = [
        asdict(count) for count in pool.map(soak_core, [share] * PROCESSES, range(given.first, given.first + PROCESSES))
    ]
    report: dict[str, object] = {key: sum(count[key] for count in counts) for key in counts[0]}
    return report, not report["late"] and not report["unsound"]


def replays(seed: int, out: Path) -> ReplayedFlight:
    """Fly and replay a seed, every tenth in a process of its own too; the recording of a difference is kept."""
    found = replay_seed(seed, out)
    if found.result.identical and seed % APART_EVERY == 0:
        found = replace(found, process_difference=replay_in_process(found.path))
    if found.is_identical:
        shutil.rmtree(found.path.parent)
    return found


def _replays(pool: ProcessPoolExecutor, given: argparse.Namespace) -> tuple[dict[str, object], bool]:
    waiting = [pool.submit(replays, seed, given.out) for seed in range(given.first, given.first + given.seeds)]
    found: list[ReplayedFlight] = []
    for done in as_completed(waiting):
        found.append(done.result())
        sys.stderr.write(f"\r{len(found)} of {given.seeds} flights ")
    sys.stderr.write("\n")
    return tally_flights(found), all(one.is_identical for one in found)


_SCENARIOS = {
    "mission": _missions,
    "take-off": _take_offs,
    "faults": _faults,
    "pairs": _pairs,
    "core": _core,
    "replay": _replays,
}


def _text(report: dict[str, object]) -> str:
    lines = []
    for key, value in report.items():
        if key == "flights" and isinstance(value, list):
            continue
        if isinstance(value, dict) and "take_offs" in value:
            lines += _take_off_lines(key, value)
            continue
        if not isinstance(value, dict) or "legs" not in value:
            lines.append(f"{key}: {value}")
            continue
        lines.append(
            f"{key}: {value['flights']} flights, {value['touched']} touched a wall, {value['landed']} landed; "
            f"room left: median {value['clearance_m']:.2f} m, "
            f"least {value['clearance_m_worst']:.2f} m ({value['worst']}); largest age {value['max_age']}"
        )
        lines.append(
            f"  {'leg':>3} {'seconds':>15} {'from the plan, rms':>20} {'max':>13} {'held, rms':>13} {'max':>13}"
        )
        for number, leg in enumerate(value["legs"]):
            pairs = " ".join(
                f"{leg[name]:.{digits}f} ({leg[f'{name}_worst']:.{digits}f})".rjust(width)
                for name, digits, width in (
                    ("seconds", 1, 15),
                    ("plan_rms_m", 3, 20),
                    ("plan_max_m", 2, 13),
                    ("hold_rms_m", 3, 13),
                    ("hold_max_m", 2, 13),
                )
            )
            lines.append(f"  {number:>3} {pairs}")
        lines.append("  (medians, the worst flight in brackets; lengths in m)")
        lines += [f"  seed {seed}: {found}" for seed, found in value["wrong"].items()]
    return "\n".join(lines) + "\n"


def _take_off_lines(autopilot: str, value: dict[str, Any]) -> list[str]:
    """The table of one autopilot's take-offs."""
    words = ("take_offs", "engaged", "landed_again", "landed", "refused", "hovers")
    lines = (
        [f"{'':<10}" + "".join(f"{word.replace('_', '-'):>13}" for word in words)] if autopilot == AUTOPILOTS[0] else []
    )
    lines.append(f"{autopilot:<10}" + "".join(f"{value[word]:>13}" for word in words))
    lines.append(f"  latest after {value['latest_s']} s (seed {value['latest_seed']})")
    lines += [f"  {number:>4} {cause}" for cause, number in value["ended"].items()]
    lines += [f"  wrong, seed {seed}: {'; '.join(found)}" for seed, found in value["wrong"].items()]
    return lines


if __name__ == "__main__":
    sys.exit(main())
