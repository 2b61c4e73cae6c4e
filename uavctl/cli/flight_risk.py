"""Rehearsed flights for `uavctl design`, `uavctl check` and `uavctl log report`, with a bar while they take long."""

from __future__ import annotations

import time
from typing import Annotated

from cyclopts import Parameter, validators

from uavctl.cli.common import SEED, make_progress
from uavctl.config import Config
from uavctl.config.connections import MAX_REHEARSALS
from uavctl.lab.flight_risk import FlightRisk, rehearse_flights
from uavctl.smpc.conditioned.design import ConditionedDesign
from uavctl.wiring.controller import build_conditioned, build_controller

Rehearsals = Annotated[
    int | None,
    Parameter(
        help="flights to rehearse, 0 for none; else check.rehearsals",
        validator=validators.Number(gte=0, lte=MAX_REHEARSALS),
    ),
]
RiskSeed = Annotated[int, Parameter(name="--seed", help="seed of the rehearsed flights", validator=SEED)]
_BAR_AFTER_S = 2.0  # what ends sooner needs no bar


def compute_flight_risk(config: Config, seed: int = 0, design: ConditionedDesign | None = None) -> FlightRisk | None:
    """Rehearse the flights; None for none, the paper's scheme, a plant without axes, and an outside controller.

    Args:
        seed: Seed of the rehearsed flights.
        design: The design, if it is made already.

    Raises:
        DesignError: The configuration has no controller, or its mission cannot be flown.
    """
    if not config.is_age_conditioned or config.smpc.controller or not config.check.rehearsals:
        return None
    if not config.plant.axes:
        return None
    design = build_conditioned(config) if design is None else design
    progress, begin_s = make_progress(), time.monotonic()
    task = progress.add_task(f"rehearsing {config.check.rehearsals} flights [steps]")

    def report(done: int, total: int) -> None:
        progress.update(task, completed=done, total=total)
        if time.monotonic() - begin_s > _BAR_AFTER_S:
            progress.start()

    try:
        return rehearse_flights(config, design, build_controller(config, design), seed, report)
    finally:
        progress.stop()
