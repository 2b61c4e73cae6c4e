"""Flights of the true quadrotor in lockstep, judged on the truth, with the vehicle's own position loop beside ours.

`python tools/trials.py`: preset `room` as it is, both autopilots, cameras at 5 and 50 Hz, 30 and 60 % loss, in gusts:
how well it holds its place. `--scenario eight` is a figure of eight, `--scenario blackout` 4 s without any position.
`python tools/trials.py --config room-hahn-stursberg --pilots hahn-stursberg age-conditioned own --seeds 5 --jobs 2`
`python tools/trials.py --variant "H 16" smpc.horizon=16 cost.input=[0.25,0.25,0.25] --pilots own`

Pilots: `hahn-stursberg` and `age-conditioned` are ours with that `smpc.scheme` (the latter designed for the losses that
it meets, the former for those of its configuration, unless `--design` says otherwise); `configured` flies each
configuration as it is. `own` is the vehicle's own position loop as delivered, its positions passed on by the daemon's
relay; `own-tuned` gets them the moment they arrive, knows their delay, and is told of a motion ahead of its lag.

Every pilot meets the same gusts, camera noise, losses and delays. Each cell is told as median (worst).
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, fields
from pathlib import Path
from statistics import median
from typing import get_args

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from uavctl.errors import UavctlError
from uavctl.lab.position_loop import TUNED_LOOPS, PositionLoopTuning
from uavctl.lab.trial import (
    AUTOPILOTS,
    SCENARIO_FIGURES,
    SCENARIOS,
    Air,
    Scenario,
    TrialCell,
    TrialFlight,
    TrialPilot,
    fly_trial,
)

SCHEMES = ("hahn-stursberg", "age-conditioned")
PILOTS = ("configured", *SCHEMES, "own", "own-tuned")
WIDTH = 170


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly and tell; exit code 1 where nothing was flown."""
    given = _parser().parse_args(arguments)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"  # of the processes to come; the last bits would depend on it
    cells = [
        TrialCell(pilot, scenario, autopilot, rate_hz, f"{100 * loss:g} %", (f"link.loss={loss}",), air)
        for scenario in given.scenario
        for autopilot in given.autopilots
        for rate_hz in given.rates
        for loss in given.losses
        for air in given.air
        for pilot in pilots(given, autopilot)
    ]
    seeds = range(given.first, given.first + given.seeds)
    found, refused = _flown(cells, list(seeds), given)
    if given.json:
        sys.stdout.write(json.dumps(_document(cells, found, refused), allow_nan=False) + "\n")
    else:
        console = Console(width=WIDTH)
        for scenario in given.scenario:
            console.print(_table(scenario, [cell for cell in cells if cell.scenario == scenario], found, given))
        for cell, why in refused.items():
            console.print(f"{_name(cell)}: {why}", markup=False)
    return 0 if any(found.values()) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", nargs="+", default=["room"], help="presets or files that ours are made from")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override for all of them")
    parser.add_argument(
        "--variant", action="append", nargs="+", default=[], metavar=("NAME", "KEY=VALUE"), help="one more of ours"
    )
    parser.add_argument("--pilots", nargs="*", choices=PILOTS, default=["configured", "own"])
    parser.add_argument(
        "--design", choices=("usual", "configured", "flown"), default="usual", help="losses that ours are designed for"
    )
    parser.add_argument("--scenario", nargs="+", choices=SCENARIOS, default=["hold"])
    parser.add_argument("--autopilots", nargs="+", choices=AUTOPILOTS, default=list(AUTOPILOTS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--rates", nargs="+", type=float, default=[5.0, 50.0], help="of the cameras [Hz]")
    parser.add_argument("--losses", nargs="+", type=float, default=[0.3, 0.6])
    parser.add_argument("--air", nargs="+", choices=get_args(Air), default=["gusts"])
    parser.add_argument("--seconds", type=float, default=40.0, help="length of a flight [s]; an eight has its own")
    parser.add_argument("--from", dest="from_s", type=float, default=10.0, help="from when on it is to hold [s]")
    parser.add_argument("--own-gain", action="append", default=[], metavar="NAME=VALUE", help="of own-tuned")
    parser.add_argument("--own-delay", type=float, help="that own-tuned counts on [s]")
    parser.add_argument("--own-lead", type=float, help="by which own-tuned is told ahead [s]")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="every flight, as one JSON document")
    return parser


def pilots(given: argparse.Namespace, autopilot: str) -> list[TrialPilot]:
    """Who flies, as the arguments have it."""
    out: list[TrialPilot] = []
    several = len(given.config) > 1
    shared = tuple(given.set)
    for config in given.config:
        label = f"{Path(config).stem}: " if several else ""
        for name in given.pilots:
            if name == "configured":
                out.append(
                    TrialPilot(label.rstrip(": ") or Path(config).stem, config, shared, None, given.design == "flown")
                )
            elif name in SCHEMES:
                knows = given.design == "flown" or (given.design == "usual" and name == "age-conditioned")
                out.append(TrialPilot(label + name, config, (*shared, f"smpc.scheme={name}"), None, knows))
        for name, *overrides in given.variant:
            knows = given.design == "flown" or (given.design == "usual" and any("age-cond" in one for one in overrides))
            out.append(TrialPilot(label + name, config, (*shared, *overrides), None, knows))
    out += [
        TrialPilot(name, given.config[0], shared, _tuning(given, name, autopilot))
        for name in given.pilots
        if "own" in name
    ]
    return out


def _tuning(given: argparse.Namespace, name: str, autopilot: str) -> PositionLoopTuning:
    if name == "own":
        return PositionLoopTuning()
    tuned = TUNED_LOOPS[autopilot]
    gains = dict(tuned.gains) | {key: float(value) for key, value in (one.split("=") for one in given.own_gain)}
    return PositionLoopTuning(
        relays_at_once=True,
        delay_s=tuned.delay_s if given.own_delay is None else given.own_delay,
        lead_s=tuned.lead_s if given.own_lead is None else given.own_lead,
        gains=tuple(gains.items()),
    )


def _flown(
    cells: list[TrialCell], seeds: list[int], given: argparse.Namespace
) -> tuple[dict[TrialCell, list[TrialFlight]], dict[TrialCell, str]]:
    """The flights of each cell, in order of their seeds, and why there are none of others."""
    found: dict[TrialCell, list[TrialFlight]] = {cell: [] for cell in cells}
    refused: dict[TrialCell, str] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    context = multiprocessing.get_context("spawn")
    with (
        Progress(
            *columns, TextColumn("left"), TimeRemainingColumn(), console=Console(stderr=True), transient=True
        ) as bar,
        ProcessPoolExecutor(given.jobs, mp_context=context) as pool,
    ):
        task = bar.add_task("flights", total=len(cells) * len(seeds))
        # All seeds of a cell in turn, so that a process makes a controller once.
        waiting = {pool.submit(flights, cell, seeds, given.seconds, given.from_s): cell for cell in cells}
        for done in as_completed(waiting):
            outcome = done.result()
            if isinstance(outcome, str):
                refused[waiting[done]] = outcome
            else:
                found[waiting[done]] = outcome
            bar.update(task, advance=len(seeds))
    return found, refused


def flights(cell: TrialCell, seeds: Sequence[int], seconds: float, from_s: float) -> list[TrialFlight] | str:
    """The flights of a cell, or why there are none."""
    try:
        return [fly_trial(cell, seed, seconds=seconds, from_s=from_s) for seed in seeds]
    except UavctlError as error:
        return str(error)


def _table(
    scenario: Scenario, cells: list[TrialCell], found: dict[TrialCell, list[TrialFlight]], given: argparse.Namespace
) -> Table:
    what = f"{scenario}, {given.seeds} seeds from {given.first}: median (worst)"
    table = Table(title=what, title_justify="left")
    for heading in ("autopilot", "Hz", "loss", "air", "pilot"):
        table.add_column(heading, no_wrap=True)
    shown = SCENARIO_FIGURES[scenario]
    for one in shown:
        table.add_column(one.heading, justify="right")
    table.add_column("ended")
    before: tuple[object, ...] = ()
    for cell in cells:
        flown = found[cell]
        place = (cell.autopilot, cell.rate_hz, cell.link_name, cell.air)
        if before and place != before:
            table.add_section()
        before = place
        names = (cell.autopilot, f"{cell.rate_hz:g}", cell.link_name, cell.air, cell.pilot.name)
        if not flown:
            table.add_row(*names, "refused")
            continue
        told = [figure.format_values([getattr(one, figure.key) for one in flown]) for figure in shown]
        table.add_row(*names, *told, " ".join(sorted({one.mode for one in flown})))
    return table


def _name(cell: TrialCell) -> str:
    return f"{cell.pilot.name}, {cell.scenario}, {cell.autopilot}, {cell.rate_hz:g} Hz, {cell.link_name}"


def _document(
    cells: list[TrialCell], found: dict[TrialCell, list[TrialFlight]], refused: dict[TrialCell, str]
) -> dict[str, object]:
    """Everything; what is not a finite number is null."""
    told = []
    for cell in cells:
        flown = [{key: _finite(value) for key, value in asdict(one).items()} for one in found[cell]]
        numbers = [one.name for one in fields(TrialFlight) if one.name not in ("seed", "mode")]
        medians = {key: _finite(median(float(getattr(one, key)) for one in found[cell])) for key in numbers if flown}
        worst = {key: _finite(max(float(getattr(one, key)) for one in found[cell])) for key in numbers if flown}
        told.append(
            {**asdict(cell), "refused": refused.get(cell, ""), "median": medians, "worst": worst, "flights": flown}
        )
    return {"cells": told}


def _finite(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    sys.exit(main())
