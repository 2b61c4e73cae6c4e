"""Command `uavctl log whatif`: a recorded flight flown by another controller, schedule or link."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter
from msgspec.structs import replace
from rich.console import Group, RenderableType
from rich.progress import Progress, TaskProgressColumn, TimeElapsedColumn
from rich.text import Text

from logs.recording.ends import create_recording, put_header
from logs.recording.export import count_messages
from logs.recording.file_kind import FileKind, detect_kind
from logs.recording.flight import FlightData
from logs.recording.foreign import is_foreign
from logs.recording.notes import RecorderNote
from logs.recording.output_files import write_atomically
from logs.recording.reader import explain_missing_end, read, read_header
from logs.recording.recorder import DerivedTopics, RecorderStatus, SyncRecorder
from logs.recording.summary import count, summarise
from logs.recording.topics import HEADER
from logs.recording.views import ViewBuilder
from uavctl.arrays import Array
from uavctl.cli.common import SEED, Common, Flight, Json, make_progress
from uavctl.cli.flying import conclude_flight
from uavctl.cli.output import make_table, warn
from uavctl.cli.replays import (
    check_first_file,
    find_other_versions,
    make_changed_controller,
    make_recorded_controller,
    match_arithmetic,
)
from uavctl.cli.whatif_setup import change_config, choose_plant, make_baseline_controller
from uavctl.config import Config, LoadedConfig
from uavctl.config.load import parse_recorded
from uavctl.errors import UsageError
from uavctl.lab.campaign.spec import KINDS
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
    RecordedFlight,
    ReflownFlight,
    SimulatedLink,
    VehicleResponse,
    make_recorded_flight,
    make_response,
    refly,
)
from uavctl.records import Header, Record
from uavctl.wiring.controller import Prepared

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
            help=f"controller: {', '.join(KINDS)}; or a controller of another package, by its entry point "
            "uavctl.controllers or as module:Class"
        ),
    ] = "smpc",
    link: Annotated[
        tuple[str, ...],
        Parameter(
            negative=(),
            metavar="recorded|configured|KEY=VALUE",
            help="link of the positions: recorded; configured, simulated as in [link]; or KEY=VALUE, a changed key "
            "that the design does not know, as in loss=0.5 (may be repeated). Default: recorded, unless --set changes "
            "a key of link",
        ),
    ] = (),
    seed: Annotated[
        int | None, Parameter(help="seed of a simulated link; else the recorded sim.seed", validator=SEED)
    ] = None,
    model: Annotated[
        Path | None, Parameter(help="TOML file with the [plant] of the vehicle, as `uavctl identify` writes it")
    ] = None,
    out: Annotated[Path | None, Parameter(help="folder of the recording; else a new one below flights/")] = None,
    json: Json = False,
) -> int:
    """Fly a recorded flight again with something changed, in the same disturbance, and compare."""
    if (detect_kind(flight) is FileKind.TLOG and flight.exists()) or is_foreign(flight):
        raise UsageError(
            f"{flight} is another program's recording: it holds no decisions; `uavctl log replay` and "
            "`uavctl identify` read it"
        )
    link_name = _choose_link(link, overrides)
    if seed is not None and link_name == RECORDED:
        raise UsageError("--seed belongs to a simulated link; add --link configured, or --link KEY=VALUE")
    check_first_file(flight)
    link_keys = tuple(f"link.{text.strip()}" for text in link if "=" in text)
    result = fly_what_if(WhatIfRequest(flight, config, overrides, controller, link_name, link_keys, seed, model, out))
    Common(json=json).show("log/whatif", result, lambda: _render(result))
    return 0 if result.what_if.steps else 1


@dataclass(frozen=True)
class WhatIfRequest:
    """Differences from the recorded flight."""

    flight: Path
    config: str | None  # preset or file in place of the recorded configuration
    overrides: tuple[str, ...]  # `key=value` each
    controller: str
    link_name: str  # how positions come
    link_keys: tuple[str, ...]  # overrides of the flown link alone, which the design does not know
    seed: int | None  # of a simulated link
    model: Path | None  # file with the plant that responds to other setpoints
    out: Path | None

    @property
    def is_baseline(self) -> bool:
        """Whether a controller of this package other than the SMPC flies."""
        return self.controller in KINDS and self.controller != "smpc"

    @property
    def is_outside(self) -> bool:
        """Whether a controller of another package flies."""
        return self.controller not in KINDS


def fly_what_if(request: WhatIfRequest) -> WhatIf:
    """Fly the recorded flight unchanged and changed, record the latter, and write its page.

    Raises:
        UavctlError: The recording or the change cannot be flown; the message is the reason.
    """
    flight = request.flight
    recorded = read_header(flight)
    match_arithmetic(recorded)
    before = parse_recorded(recorded.config_toml, f"{flight} (configuration)").config
    loaded = change_config(before, recorded.config_toml, flight, request.config, request.overrides)
    plant, source = choose_plant(request.model, before)
    with _show_progress() as progress:
        entries = progress.track(read(flight), total=count_messages(flight), description="reading")
        history = make_recorded_flight(entries, before, str(flight))
    response = make_response(history, plant)
    _print_warnings(flight, recorded, history)
    recorded_controller = make_recorded_controller(flight, before)
    changed_controller = _make_controller(request, loaded, recorded_controller, history)
    other_link = None if request.link_name == RECORDED else _make_link(request, recorded, before, history)
    begin_s = time.perf_counter()
    with create_recording(request.out, loaded.config.name, before.log) as path, _show_progress() as progress:
        watch = _make_watch(progress, "reproducing the flight")
        reproduced = _reproduce(history, recorded_controller, response, watch)
        watch = _make_watch(progress, "flying the variant")
        course, status = _record_changed(history, changed_controller, response, other_link, path, recorded, watch)
        progress.add_task("writing the pages", total=None)
        conclude_flight(path, time.perf_counter() - begin_s, status)
        first, again, other = (
            FlightData.from_records(cut_entries(entries, course.end_ns))
            for entries in (history.entries, reproduced, tuple(read(path)))
        )
        result = WhatIf(
            flight=str(flight),
            reproduction=compare_reproduction(first, again),
            model=fit_model(history, response, source),
            controller=request.controller,
            link=request.link_name,
            changed=_list_changes(request),
            compared_s=(course.end_ns - first.origin_ns + first.tick_ns) * 1e-9,
            ended=course.ended,
            largest_departure_m=compute_max_distance_m(first, other),
            recorded=summarise(first, wall_s=None),
            reproduced=summarise(again, wall_s=None),
            what_if=summarise(other, wall_s=None),
            recording=str(path),
            report=str(path.with_suffix(".html")),
            page=str(path.with_name("what-if.html")),
        )
        write_atomically(Path(result.page), render_what_if_page(result, first, other))
    return result


def _make_controller(
    request: WhatIfRequest, loaded: LoadedConfig, recorded_controller: Prepared, history: RecordedFlight
) -> Prepared:
    """Return the controller that flies: a baseline, one of another package, or the SMPC, changed or not."""
    if request.is_baseline:
        return make_baseline_controller(loaded, request.controller, _get_start_state(history))
    if request.is_outside:
        smpc = replace(loaded.config.smpc, controller=request.controller)
        loaded = dataclasses.replace(loaded, config=replace(loaded.config, smpc=smpc))
    elif request.config is None and not request.overrides:
        return recorded_controller
    return make_changed_controller(loaded)


def _make_link(request: WhatIfRequest, recorded: Header, before: Config, history: RecordedFlight) -> SimulatedLink:
    overrides = (*request.overrides, *request.link_keys)
    config = change_config(before, recorded.config_toml, request.flight, request.config, overrides).config
    noise_m = before.sim.camera.noise_std_m if history.flight.truths else before.estimator.position_std_m
    return SimulatedLink(history, config.link, before.sim.seed if request.seed is None else request.seed, noise_m)


def _list_changes(request: WhatIfRequest) -> tuple[str, ...]:
    """Return the overrides, as given."""
    return (
        *((f"--config {request.config}",) if request.config else ()),
        *request.overrides,
        *((f"--seed {request.seed}",) if request.seed is not None else ()),
    )


def _print_warnings(flight: Path, recorded: Header, history: RecordedFlight) -> None:
    """Print warnings on an inexact reproduction."""
    texts = [f"{text}: decisions may differ" for text in find_other_versions(recorded, history.config.smpc.controller)]
    lost_records = max(
        (note.dropped + note.refused for _, _, note in history.entries if isinstance(note, RecorderNote)), default=0
    )
    if lost_records:
        texts.append(f"{count(lost_records, 'record')} missing in the recording")
    if cut := explain_missing_end(flight):
        texts.append(f"{cut}: flown up to there")
    for text in texts:
        warn(text)


def _show_progress() -> Progress:
    return make_progress(TaskProgressColumn(), TimeElapsedColumn())


def _make_watch(progress: Progress, description: str) -> EntryObserver:
    """Return a function that shows a progress bar of a flight through the entries of a recording."""

    def watch(entries: Iterable[Entry]) -> Iterable[Entry]:
        return progress.track(entries, description=description)

    return watch


def _get_start_state(history: RecordedFlight) -> Array:
    """Return the state (n_x,) in which the recorded flight began, as far as it is known."""
    flight = history.flight
    return np.array(flight.truths[0].state if flight.truths else flight.estimates[0].mean)


def _choose_link(links: tuple[str, ...], overrides: tuple[str, ...]) -> str:
    """Return the name of the link that positions come over."""
    names = [text for text in links if "=" not in text]
    if not links:
        return CONFIGURED if any(text.strip().startswith("link.") for text in overrides) else RECORDED
    if (len(links) > 1 and names) or not set(names) <= {RECORDED, CONFIGURED}:
        typed = " --link ".join(links)
        raise UsageError(f"--link {typed}: give `{RECORDED}` or `{CONFIGURED}` alone, or KEY=VALUE, as in loss=0.5")
    return names[0] if names else ", ".join(links)


class _RecordMemory:
    """Sink that keeps all records, in order."""

    def __init__(self) -> None:
        self.entries: list[Entry] = []

    def put(self, topic: str, at_ns: int, record: Record) -> None:
        self.entries.append((topic, at_ns, record))


def _reproduce(
    history: RecordedFlight, recorded_controller: Prepared, response: VehicleResponse, watch: EntryObserver
) -> tuple[Entry, ...]:
    """Fly the recorded flight again, with nothing changed."""
    memory = _RecordMemory()
    memory.put(HEADER, history.flight.header.started_ns, history.flight.header)
    refly(history, recorded_controller.config, recorded_controller.controller, response, memory, lambda: 0, watch=watch)
    return tuple(memory.entries)


def _record_changed(
    history: RecordedFlight,
    changed_controller: Prepared,
    response: VehicleResponse,
    other_link: SimulatedLink | None,
    path: Path,
    recorded: Header,
    watch: EntryObserver,
) -> tuple[ReflownFlight, RecorderStatus]:
    """Fly the changed configuration and record it; remove an incomplete recording, a seeming shorter flight."""
    recorder = SyncRecorder(path, changed_controller.config.log, derived_topics=DerivedTopics(ViewBuilder()))
    try:
        put_header(recorder, changed_controller, recorded.started_ns, recorded.zero_utc_ns, moved_inputs=True)
        course = refly(
            history,
            changed_controller.config,
            changed_controller.controller,
            response,
            recorder,
            time.perf_counter_ns,
            other_link,
            watch,
        )
    except BaseException:
        recorder.close()
        path.unlink(missing_ok=True)
        raise
    return course, recorder.close()


def _render(result: WhatIf) -> RenderableType:
    table = make_table("", HEADINGS, (map(Text, row) for row in make_comparison_rows(result)), HEADINGS, fold=True)
    file_lines = [f"recording: {result.recording}", f"report: {result.report}", f"page: {result.page}"]
    return Group(*map(Text, describe_what_if(result)), table, *map(Text, file_lines))
