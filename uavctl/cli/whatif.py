"""Command `uavctl log whatif`."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter
from msgspec.structs import replace
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.progress import Progress, TaskProgressColumn, TimeElapsedColumn
from rich.text import Text

from logs.recording.disk import FileKind, detect_kind, write_atomically
from logs.recording.ends import create_recording, put_header
from logs.recording.export import count_messages
from logs.recording.flight import FlightData
from logs.recording.foreign import is_foreign
from logs.recording.reader import header, lacks_end, read
from logs.recording.recorder import DerivedTopics, RecorderStatus, SyncRecorder
from logs.recording.summary import count, summarise
from logs.recording.topics import HEADER, RecorderNote
from logs.recording.views import ViewBuilder
from uavctl.build.controller import Prepared, build_problem, design_of, prepare
from uavctl.cli.common import SEED, Common, Flight, Json, bars, columns, located, warn
from uavctl.cli.flying import conclude
from uavctl.cli.replay import changed_flyer, check_first, compute_as, other_versions, recorded_flyer
from uavctl.config import Config, LoadedConfig, load
from uavctl.config.checks import get_dimensions
from uavctl.config.load import parse_recorded
from uavctl.config.types import PlantConfig, TargetConfig
from uavctl.errors import UsageError
from uavctl.lab.campaign.controllers import BaselineSolver, build_from_recipe, make_recipe
from uavctl.lab.campaign.spec import KINDS, CampaignSpec, ControllerSpec
from uavctl.lab.whatif.comparison import (
    HEADINGS,
    WhatIf,
    compare_reproduction,
    compute_max_distance_m,
    cut_entries,
    describe_what_if,
    fit_model,
    make_comparison_rows,
    render_what_if_page,
)
from uavctl.lab.whatif.flight import (
    Entry,
    EntryObserver,
    OtherLink,
    RecordedFlight,
    ReflownFlight,
    SimulatedLink,
    VehicleResponse,
    make_recorded_flight,
    make_response,
    refly,
)
from uavctl.records import Header, Record
from uavctl.smpc.batch import BatchController
from uavctl.smpc.nominal import ControlProblem
from uavctl.smpc.plant import AXES

# What flies in a what-if: the recorded configuration with what was changed, and its controller.


Array = NDArray[np.float64]
# What the recorded bytes were made with, and how they are read.
RECORDED_KEYS = ("sim", "daemon", "frame", "clock", "hand_over", "relay", "security", "log", "check", "duration_s")
_RATE = "source.rate_hz"


def changed(before: Config, toml: str, flight: Path, config: str | None, overrides: Sequence[str]) -> LoadedConfig:
    """Return the configuration that flies: the recording's, or another one in the recorded surroundings.

    Args:
        overrides: `key=value` each.

    Raises:
        ConfigError: It is none.
        UsageError: A change of what is recorded, or a plant of another kind.
    """
    for text in overrides:
        key = text.partition("=")[0].strip()
        if key.split(".")[0] in RECORDED_KEYS or (key.startswith("source.") and key != _RATE):
            raise UsageError(
                f"--set {text}: {key} is part of what was recorded and cannot be another one now; what can be changed "
                "is the controller, its beliefs (plant, sets, cost, smpc, schedule, ...) and link.*"
            )
    name = f"{flight} (configuration)"
    loaded = parse_recorded(toml, name, overrides) if config is None else load(config, overrides)
    given = loaded.config
    source = replace(before.source, rate_hz=given.source.rate_hz)
    surroundings = {section: getattr(before, section) for section in RECORDED_KEYS}
    flies = replace(given, name=f"{before.name}-whatif", source=source, **surroundings)
    check_plant(flies.plant, before.plant, "plant" if config is None else f"{config}: plant")
    return dataclasses.replace(loaded, config=flies)


def check_plant(plant: PlantConfig, recorded: PlantConfig, what: str) -> None:
    """Refuse a plant whose state differs in kind from that of the recording.

    Raises:
        UsageError: It is another one.
    """
    shapes = [(*get_dimensions(one), one.axes, one.dt_s) for one in (plant, recorded)]
    if shapes[0] != shapes[1]:
        told = [
            f"{n_x} states, {n_u} inputs, axes {', '.join(axes)} and steps of {dt_s:g} s"
            for n_x, n_u, axes, dt_s in shapes
        ]
        raise UsageError(f"{what} has {told[0]}, the recorded flight {told[1]}; give one of the same kind")


def plant_of(path: Path | None, before: Config) -> tuple[PlantConfig, str]:
    """Return the plant that responds to other setpoints, and its name.

    Raises:
        ConfigError: The file is no configuration.
        UsageError: It is of another kind than the recorded plant.
    """
    if path is None:
        return before.plant, "the recording's [plant]"
    plant = load(str(path)).config.plant
    check_plant(plant, before.plant, f"--model {path}: plant")
    return plant, f"[plant] of {path}"


def baseline_flyer(loaded: LoadedConfig, kind: str, start: Array) -> Prepared:
    """Make a controller with a baseline in the place of the solver.

    Args:
        start: State (n_x,) that a PID is tuned from.

    Raises:
        ConfigError: There is no such controller for this plant.
        UsageError: The mission follows a trajectory, which no baseline does.
    """
    if loaded.config.mission.trajectory.times_s:
        raise UsageError(f"--controller {kind}: follows no trajectory; fly a recording of waypoints, or smpc")
    # Its plans are its own: the design is for the mission's names and limits.
    config = replace(loaded.config, solver=replace(loaded.config.solver, method="exact"))
    spec = ControllerSpec(name=kind, kind=kind)
    campaign = CampaignSpec(name="what-if", config=config.name, controller=(spec,), start=tuple(start.tolist()))
    with located(loaded):
        prepared = prepare(config, design_of(config))
        recipe = make_recipe(spec, config, campaign)

    def make(target: Array) -> tuple[ControlProblem, BatchController]:
        there = replace(config, target=TargetConfig(position_m=_place(config.plant.axes, prepared, target)))
        return build_problem(there), build_from_recipe(dataclasses.replace(recipe, config=there))

    controller = dataclasses.replace(prepared.controller, solver=BaselineSolver(kind, make))
    return dataclasses.replace(prepared, controller=controller)


def _place(axes: Sequence[str], prepared: Prepared, target: Array) -> tuple[float, float, float]:
    """Return the position of a target state, local NED [m]."""
    place = [0.0, 0.0, 0.0]
    for axis, index in zip(axes, prepared.controller.plant.position_index, strict=True):
        place[AXES.index(axis)] = float(target[index])
    return place[0], place[1], place[2]


# `uavctl log whatif`: a recorded flight flown by another controller, schedule or link.


RECORDED, CONFIGURED = "recorded", "configured"


def whatif(
    flight: Flight,
    /,
    *,
    config: Annotated[str | None, Parameter(help="preset or TOML file in place of the recorded configuration")] = None,
    overrides: Annotated[
        tuple[str, ...],
        Parameter(name="--set", negative=(), metavar="KEY=VALUE", help="change one key; may be repeated"),
    ] = (),
    controller: Annotated[
        str,
        Parameter(
            help=f"who flies: {', '.join(KINDS)}; or a controller of another package, by its entry point "
            "uavctl.controllers or as module:Class"
        ),
    ] = "smpc",
    link: Annotated[
        tuple[str, ...],
        Parameter(
            negative=(),
            metavar="recorded|configured|KEY=VALUE",
            help="how positions come: as recorded; over a simulated link as [link] says; or over that with a key of it "
            "changed, as in loss=0.5, which the design does not know; may be repeated. Else as recorded, unless --set "
            "changes a key of link",
        ),
    ] = (),
    seed: Annotated[
        int | None, Parameter(help="seed of a simulated link; else the recorded sim.seed", validator=SEED)
    ] = None,
    model: Annotated[
        Path | None, Parameter(help="TOML file whose [plant] answers to other setpoints, as of `uavctl identify`")
    ] = None,
    out: Annotated[Path | None, Parameter(help="folder of the recording; else a new one below flights/")] = None,
    json: Json = False,
) -> int:
    """Fly a recorded flight again with something changed, in the same disturbance, and compare."""
    if (detect_kind(flight) is FileKind.TLOG and flight.exists()) or is_foreign(flight):
        raise UsageError(
            f"{flight} is another program's recording: it does not tell what was decided; `uavctl log replay` and "
            "`uavctl identify` read it"
        )
    over = _link(link, overrides)
    if seed is not None and over == RECORDED:
        raise UsageError("--seed is of a simulated link; add --link configured, or --link KEY=VALUE")
    check_first(flight)
    recorded = header(flight)
    compute_as(recorded)
    before = parse_recorded(recorded.config_toml, f"{flight} (configuration)").config
    loaded = changed(before, recorded.config_toml, flight, config, overrides)
    keys = tuple(f"link.{text.strip()}" for text in link if "=" in text)
    on = changed(before, recorded.config_toml, flight, config, (*overrides, *keys)).config.link
    plant, source = plant_of(model, before)
    with _progress() as progress:
        entries = progress.track(read(flight), total=count_messages(flight), description="reading")
        history = make_recorded_flight(entries, before, str(flight))
    response = make_response(history, plant)
    _warn(flight, recorded, history)
    was = recorded_flyer(flight, before)
    outside = controller not in KINDS
    if outside:
        smpc = replace(loaded.config.smpc, controller=controller)
        loaded = dataclasses.replace(loaded, config=replace(loaded.config, smpc=smpc))
    if controller == "smpc" or outside:
        same = config is None and not overrides and not outside
        now = was if same else changed_flyer(loaded)
    else:
        now = baseline_flyer(loaded, controller, _start(history))
    other = None
    if over != RECORDED:
        noise_m = before.sim.camera.noise_std_m if history.flight.truths else before.estimator.position_std_m
        other = SimulatedLink(history, on, before.sim.seed if seed is None else seed, noise_m)
    begun = time.perf_counter()
    with create_recording(out, loaded.config.name, before.log.free_bytes) as path, _progress() as progress:
        again = _reproduced(history, was, response, _watch(progress, "reproducing the flight"))
        course, status = _recorded(
            history, now, response, other, path, recorded, _watch(progress, "flying it otherwise")
        )
        progress.add_task("writing the pages", total=None)
        conclude(path, time.perf_counter() - begun, status)
        given = (
            *((f"--config {config}",) if config else ()),
            *overrides,
            *((f"--seed {seed}",) if seed is not None else ()),
        )
        sides = [
            FlightData.from_records(cut_entries(entries, course.end_ns))
            for entries in (history.entries, again, tuple(read(path)))
        ]
        result = WhatIf(
            flight=str(flight),
            reproduction=compare_reproduction(sides[0], sides[1]),
            model=fit_model(history, response, source),
            controller=controller,
            link=over,
            changed=given,
            compared_s=(course.end_ns - sides[0].origin_ns + sides[0].tick_ns) * 1e-9,
            ended=course.ended,
            largest_departure_m=compute_max_distance_m(sides[0], sides[2]),
            inertial_moved=course.inertial_moved,
            inertial_left_out=course.inertial_dropped,
            recorded=summarise(sides[0], wall_s=None),
            reproduced=summarise(sides[1], wall_s=None),
            what_if=summarise(sides[2], wall_s=None),
            recording=str(path),
            report=str(path.with_suffix(".html")),
            page=str(path.with_name("what-if.html")),
        )
        write_atomically(Path(result.page), render_what_if_page(result, sides[0], sides[2]))
    Common(json=json).show("log/whatif", result, lambda: _picture(result))
    return 0 if result.what_if.steps else 1


def _warn(flight: Path, recorded: Header, history: RecordedFlight) -> None:
    """Warn why the reproduction may not be exact."""
    texts = [f"{text}: decisions may differ" for text in other_versions(recorded, history.config.smpc.controller)]
    lost = max((one.dropped + one.refused for _, _, one in history.entries if isinstance(one, RecorderNote)), default=0)
    if lost:
        texts.append(f"{count(lost, 'record')} missing in the recording")
    if cut := lacks_end(flight):
        texts.append(f"{cut}: flown up to there")
    for text in texts:
        warn(text)


def _progress() -> Progress:
    return bars(TaskProgressColumn(), TimeElapsedColumn())


def _watch(progress: Progress, what: str) -> EntryObserver:
    """Show a progress bar of a flight through a recording's entries."""

    def watch(entries: Iterable[Entry]) -> Iterable[Entry]:
        return progress.track(entries, description=what)

    return watch


def _start(history: RecordedFlight) -> NDArray[np.float64]:
    """Return the state (n_x,) in which the recorded flight began, as far as it is known."""
    flight = history.flight
    return np.array(flight.truths[0].state if flight.truths else flight.estimates[0].mean)


def _link(given: tuple[str, ...], overrides: tuple[str, ...]) -> str:
    """Return the name of the link that positions come over."""
    words = [text for text in given if "=" not in text]
    if not given:
        return CONFIGURED if any(text.strip().startswith("link.") for text in overrides) else RECORDED
    if (len(given) > 1 and words) or not set(words) <= {RECORDED, CONFIGURED}:
        typed = " --link ".join(given)
        raise UsageError(f"--link {typed}: give `{RECORDED}` or `{CONFIGURED}` alone, or KEY=VALUE, as in loss=0.5")
    return words[0] if words else ", ".join(given)


class _Memory:
    """Sink that keeps all records, in order."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        self.entries.append((topic, at_ns, record))


def _reproduced(
    history: RecordedFlight, was: Prepared, response: VehicleResponse, watch: EntryObserver
) -> tuple[Entry, ...]:
    """Fly the recorded flight again, with nothing changed."""
    memory = _Memory()
    memory.put(HEADER, history.flight.header.started_ns, history.flight.header)
    refly(history, was.config, was.controller, response, memory, lambda: 0, watch=watch)
    return tuple(memory.entries)


def _recorded(
    history: RecordedFlight,
    now: Prepared,
    response: VehicleResponse,
    other: OtherLink | None,
    path: Path,
    recorded: Header,
    watch: EntryObserver,
) -> tuple[ReflownFlight, RecorderStatus]:
    """Fly what was changed, and record it; remove an incomplete recording, which would look like a shorter flight."""
    recorder = SyncRecorder(path, now.config.log, onlookers=DerivedTopics(ViewBuilder()))
    try:
        put_header(recorder, now, recorded.started_ns, recorded.zero_utc_ns)
        course = refly(history, now.config, now.controller, response, recorder, time.perf_counter_ns, other, watch)
    except BaseException:
        recorder.close()
        path.unlink(missing_ok=True)
        raise
    return course, recorder.close()


def _picture(result: WhatIf) -> RenderableType:
    table = columns("", HEADINGS, (map(Text, row) for row in make_comparison_rows(result)), HEADINGS, fold=True)
    places = [f"recording: {result.recording}", f"report: {result.report}", f"page: {result.page}"]
    return Group(*map(Text, describe_what_if(result)), table, *map(Text, places))
