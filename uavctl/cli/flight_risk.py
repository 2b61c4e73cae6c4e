"""Rehearsed flights for `uavctl design`, `uavctl check` and `uavctl fly --arm`, with a bar while they take long."""

from __future__ import annotations

import time
from typing import Annotated

from cyclopts import Parameter

from uavctl.build.controller import build_controller
from uavctl.cli.common import SEED, make_progress
from uavctl.config import Config
from uavctl.flight.controller import Controller
from uavctl.lab.flight_risk import FlightRisk, rehearse_flights
from uavctl.smpc.conditioned.planner import ConditionedDesign

RiskSeed = Annotated[
    int, Parameter(name="--seed", help="seed of the rehearsed flights (check.rehearsals)", validator=SEED)
]
_BAR_AFTER_S = 2.0  # what ends sooner needs no bar


def compute_flight_risk(
    config: Config, design: ConditionedDesign, controller: Controller | None = None, seed: int = 0
) -> FlightRisk | None:
    """Rehearse the flights; None where none are rehearsed: see `rehearse_flights` and `rehearse_mission`.

    Raises:
        DesignError: The mission cannot be flown.
    """
    if not config.plant.axes or config.smpc.controller or not config.check.rehearsals:
        return None
    progress, begin_s = make_progress(), time.monotonic()
    task = progress.add_task(f"rehearsing {config.check.rehearsals} flights [steps]")

    def report(done: int, total: int) -> None:
        progress.update(task, completed=done, total=total)
        if time.monotonic() - begin_s > _BAR_AFTER_S:
            progress.start()

    try:
        return rehearse_flights(config, design, controller or build_controller(config, design), seed, report)
    finally:
        progress.stop()
