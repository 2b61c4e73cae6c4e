"""The cells of a campaign in the world of the quadrotor, and the tasks that fly them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import product

import msgspec
import numpy as np
import pyarrow as pa

from uavctl import __version__
from uavctl.build import build_controller, design_of
from uavctl.campaign.controllers import LibraryFor
from uavctl.campaign.spec import LinkSpec
from uavctl.campaign.tasks import Columns, name_of, told_of
from uavctl.campaign.trial_spec import TrialControllerSpec, TrialSpec
from uavctl.config import Config, dump_config, load_config
from uavctl.errors import DesignError
from uavctl.smpc.design import Design
from uavctl.trial.case import AutopilotName, TrialCell, TrialPilot, believed
from uavctl.trial.fly import TrialFlight, fly
from uavctl.trial.own_loop import TUNED, OwnTuning
from uavctl.trial.room import usable_room

VERSION = 1
CHUNK = 5  # flights of a task: a minute or less
_WHOLE = ("positions",)
_WORDS = ("mode",)
REAL = tuple(one.name for one in fields(TrialFlight) if one.name not in ("seed", *_WHOLE, *_WORDS))
SCHEMA = pa.schema(
    [
        ("cell", pa.int32()),
        ("run", pa.int64()),
        ("error", pa.string()),
        ("seed", pa.int64()),
        *((name, pa.float64()) for name in REAL),
        *((name, pa.int32()) for name in _WHOLE),
        *((name, pa.string()) for name in _WORDS),
    ]
)


@dataclass(frozen=True)
class TrialPlace:
    """One combination of a campaign.

    Attributes:
        index: Its number.
        cell: What is flown.
        kind: Kind of who flies.
        design_id: Of the design of ours; None of the vehicle's own loop.
        usable_room: Share of the room in which ours may rest; None likewise.
        refused: Why nobody flies there; empty if somebody does.
    """

    index: int
    cell: TrialCell
    kind: str
    design_id: str | None
    usable_room: float | None
    refused: str


@dataclass(frozen=True)
class TrialTask:
    """Flights `first` … `first` + `runs` - 1 of a cell."""

    cell: int
    first: int
    runs: int
    flown: TrialCell
    seconds: float
    from_s: float
    master: int

    @property
    def name(self) -> str:
        """Names it within its campaign; sorts as the rows do."""
        return name_of(self.cell, self.first)

    def fly(self) -> Columns:
        """Fly; a flight that raises has what ended it in its row, and stops nothing."""
        rows = []
        for run in range(self.first, self.first + self.runs):
            seed = seed_of(self.master, run)
            try:
                rows.append((fly(self.flown, seed, seconds=self.seconds, from_s=self.from_s), ""))
            except Exception as error:  # noqa: BLE001 a crashed run is reported and stops nothing
                rows.append((TrialFlight(seed), told_of(error)))
        return self._columns(rows)

    def lost(self, error: str) -> Columns:
        """The rows of flights that all ended without figures."""
        return self._columns([(TrialFlight(seed_of(self.master, self.first + i)), error) for i in range(self.runs)])

    def _columns(self, rows: Sequence[tuple[TrialFlight, str]]) -> Columns:
        columns: Columns = {
            "cell": np.full(self.runs, self.cell, dtype=np.int32),
            "run": np.arange(self.first, self.first + self.runs, dtype=np.int64),
            "error": np.array([error for _, error in rows], dtype=object),
        }
        for name in SCHEMA.names:
            if name not in columns:
                values = [getattr(flight, name) for flight, _ in rows]
                columns[name] = np.array(values, dtype=object if name in _WORDS else None)
        return columns


def seed_of(master: int, run: int) -> int:
    """Seed of a flight: run i has the same in every cell."""
    return int(np.random.SeedSequence([master, run]).generate_state(1)[0])


def places_of(spec: TrialSpec, library_for: LibraryFor) -> tuple[TrialPlace, ...]:
    """Every cell of a campaign; what cannot be designed is refused here, and libraries are made.

    Args:
        spec: The campaign.
        library_for: Gives the policy library of a design.
    """
    text = dump_config(load_config(spec.config, spec.set))
    made: dict[Config, tuple[str | None, float | None, str]] = {}
    axes = (spec.scenario, spec.autopilot, spec.rate_hz, spec.air, spec.link, spec.controller)
    places = []
    for index, (scenario, autopilot, rate_hz, air, link, controller) in enumerate(product(*axes)):
        pilot = _pilot(spec, controller, autopilot, text)
        cell = TrialCell(pilot, scenario, autopilot, rate_hz, link.name, _settings(link), air)
        found: tuple[str | None, float | None, str] = (None, None, "")
        if pilot.own is None:
            config = believed(cell)
            if config not in made:
                made[config] = _designed(config, library_for)
            found = made[config]
        places.append(TrialPlace(index, cell, controller.kind, *found))
    return tuple(places)


def _pilot(spec: TrialSpec, given: TrialControllerSpec, autopilot: AutopilotName, text: str) -> TrialPilot:
    own = None
    if given.kind == "own-loop":
        own = TUNED[autopilot] if given.tuned else OwnTuning()
    return TrialPilot(given.name, spec.config, given.set, own, given.link == "true", text)


def _settings(link: LinkSpec) -> tuple[str, ...]:
    return tuple(link.set)


def _designed(knows: Config, library_for: LibraryFor) -> tuple[str | None, float | None, str]:
    try:
        design = design_of(knows)
        stored = library_for(knows, design) if isinstance(design, Design) else None
        build_controller(knows, design, None if stored is None else stored.library)
        return design.design_id, usable_room(knows, design), ""
    except DesignError as error:
        return None, None, str(error)


def trial_tasks(spec: TrialSpec, places: Sequence[TrialPlace]) -> Iterator[TrialTask]:
    """All tasks of a campaign, in order."""
    for place in places:
        if not place.refused:
            for first in range(0, spec.runs, CHUNK):
                runs = min(CHUNK, spec.runs - first)
                yield TrialTask(place.index, first, runs, place.cell, spec.seconds, spec.from_s, spec.master)


def trial_document(spec: TrialSpec, places: Sequence[TrialPlace]) -> dict[str, object]:
    """What `campaign.json` holds."""
    return {
        "version": VERSION,
        "world": spec.world,
        "name": spec.name,
        "uavctl_version": __version__,
        "master": spec.master,
        "runs": spec.runs,
        "spec": msgspec.to_builtins(spec),
        "configuration": dump_config(load_config(spec.config, spec.set)),
        "cells": [_told(place) for place in places],
    }


def _told(place: TrialPlace) -> dict[str, object]:
    cell, own = place.cell, place.cell.pilot.own
    return {
        "index": place.index,
        "controller": cell.pilot.name,
        "kind": place.kind,
        "scenario": cell.scenario,
        "autopilot": cell.autopilot,
        "rate_hz": cell.rate_hz,
        "air": cell.air,
        "link": cell.link_name,
        "design_id": place.design_id,
        "usable_room": place.usable_room,
        "own": None if own is None else {**asdict(own), "gains": dict(own.gains)},
        "refused": place.refused,
    }
