"""Command `uavctl tune`."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from cyclopts import Parameter
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from logs.recording.disk import write_atomically
from logs.recording.flight import FlightData
from logs.recording.reader import header, lacks_end, read
from logs.recording.summary import FlightSummary, summarise
from uavctl.build.controller import design_of
from uavctl.cli.common import (
    SEED,
    Common,
    Json,
    Overrides,
    TakeOff,
    can_be_read,
    columns,
    given_keys,
    labelled,
    located,
    messages,
    warn,
)
from uavctl.cli.fly import fly_daemon
from uavctl.cli.flying import checked_take_off
from uavctl.cli.identify import design_doubts, fitting
from uavctl.cli.loopback import fly_simulated
from uavctl.clock import Ticker, monotonic_ns
from uavctl.config import Config, LoadedConfig
from uavctl.config.load import dump_config, parse, parse_recorded, parse_toml
from uavctl.daemon.lock import lock_vehicle
from uavctl.errors import NotReachedError, RecordingError, UsageError
from uavctl.io.base import Connection
from uavctl.io.signed_connection import open_links
from uavctl.io.transport import wait
from uavctl.lab.identify.history import read_recorded_history
from uavctl.lab.identify.page import render_identify_page
from uavctl.lab.identify.result import (
    compute_ramp_delay_s,
    count_fits,
    get_candidate_models,
    identify,
    make_fitted_stretches,
)
from uavctl.lab.tune.box_monitor import MIN_BRAKE_SHARE, TUNED_BRAKE_SHARE, BoxMonitor
from uavctl.lab.tune.change import (
    PinnedAxisModel,
    PredictionErrors,
    TunedResult,
    check_tunable,
    compute_held_out_errors,
    get_assumed_response,
    tune_config,
)
from uavctl.lab.tune.excitation import DOWN, SafeBox, add_excitation, check_start, parse_box
from uavctl.lab.tune.run_folder import (
    AFTER_FOLDER,
    BEFORE_FOLDER,
    CHANGE_COLUMNS,
    FIGURE_COLUMNS,
    FIT_PAGE_FILE,
    PAGE_FILE,
    TUNED_FILE,
    TuneComparison,
    TuneFolder,
    TuneProgress,
    TuneSettings,
    compute_flight_figures,
    describe_tuning,
    find_last_waypoint_steps,
    lock_run,
    make_change_rows,
    make_error_columns,
    make_error_rows,
    make_figure_rows,
    read_tuned,
    render_tune_page,
)
from uavctl.loop import make_links
from uavctl.mavlink.connection import MavlinkConnection
from uavctl.outcome import Cause
from uavctl.records import PositionSample, Vec3, VehicleStatus
from uavctl.smpc.plant import AXES

# The flights of `uavctl tune`: one function that flies, and what it came to by its recording.


LISTENS_S = 10.0  # for the vehicle's place, before the first flight
ENOUGH = 5  # positions of one source
_ROUNDING_S = 0.5


class TuneEnd(StrEnum):
    """How a flight of a tuning run ended: whether the run can go on."""

    WHOLE = "whole"
    PILOT = "pilot"  # has taken over, and keeps the vehicle
    OPERATOR = "operator"  # ended it
    FAILED = "failed"


@dataclass(frozen=True)
class TuneFlown:
    """Recording, ending and figures of a flight that was flown."""

    summary: FlightSummary  # its figures
    recording: Path  # where it is
    end: TuneEnd  # what became of it
    ended: str = ""  # why the monitor of the box ended it; empty where it did not
    repeated: int = 0  # motions that came too near to a side of the box, and were repeated smaller


def fly_once(
    config: Config, out: Path, *, simulated: bool, take_off_m: float | None, monitor: BoxMonitor | None = None
) -> TuneFlown:
    """Fly a configuration's mission once; the pilot's stick and Ctrl-C end it as any flight.

    Args:
        config: The configuration, mission in it.
        simulated: In lockstep with the simulator, else on the configured links.
        take_off_m: Height of the climb, armed by us; None leaves arming and modes to the pilot.
        monitor: Monitor of the box where it is to stay; None for none.

    Raises:
        UavctlError: Nothing was flown, and why.
    """
    follower = None if monitor is None else monitor.handle_tick
    loaded: LoadedConfig = parse(dump_config(config), f"{out} (configuration)")
    if simulated:
        summary = fly_simulated(loaded, take_off_m=take_off_m, out=out, follower=follower)
    else:
        summary = fly_daemon(loaded, take_off_m=take_off_m, out=out, follower=follower)
    recording = out / "flight.mcap"
    end = _end(config, summary, recording)
    if monitor is None:
        return TuneFlown(summary, recording, end)
    end = TuneEnd.FAILED if monitor.reason and end is not TuneEnd.PILOT else end
    return TuneFlown(summary, recording, end, monitor.reason, monitor.repeated)


def left_whole(config: Config, out: Path) -> Path | None:
    """Return the recording in a folder, if it is of a whole flight of this configuration; else None.

    One that was killed between the end of a flight and its note has left such a one.
    """
    recording = out / "flight.mcap"
    try:
        flight = FlightData.from_records(read(recording), recording)
    except RecordingError:
        return None
    if not flight.endings or flight.header.config_toml != dump_config(config):
        return None
    summary = summarise(flight, wall_s=None)
    return recording if _end(config, summary, recording) is TuneEnd.WHOLE else None


def _end(config: Config, summary: FlightSummary, recording: Path) -> TuneEnd:
    cause = summary.ending.cause
    if cause in (Cause.PILOT, Cause.PILOT_LANDED):
        return TuneEnd.PILOT
    if summary.ending.as_ordered and _whole(config, FlightData.from_records(read(recording), recording)):
        return TuneEnd.WHOLE
    # A simulated flight ends in the air as ordered, also where Ctrl-C ended it before its time.
    cut = cause == Cause.IN_FLIGHT and summary.duration_s < config.duration_s - _ROUNDING_S
    return TuneEnd.OPERATOR if cut or cause == Cause.OPERATOR else TuneEnd.FAILED


def _whole(config: Config, flight: FlightData) -> bool:
    """Return whether a flight reached its last place, and stayed there as long as it was to."""
    mission = config.mission
    if not mission.waypoints:
        return True  # it had no end to come to
    chosen, since_s = find_last_waypoint_steps(flight)
    if not chosen.any():
        return False
    index = list(flight.design.position_index)
    axes = [AXES.index(axis) for axis in flight.design.axes]
    wanted = np.array(mission.waypoints[-1])[axes]
    if not np.allclose(flight.steps.target[np.flatnonzero(chosen)[-1]][index], wanted):
        return False
    holds_s = mission.hold_s[-1] if isinstance(mission.hold_s, tuple) else mission.hold_s
    return float(flight.steps.t_s[np.flatnonzero(chosen)[-1]]) - since_s >= holds_s - _ROUNDING_S


def where_it_stands(config: Config) -> Vec3:
    """Return where the vehicle is by the cameras: the median of some positions, local NED [m].

    Heartbeats, TIMESYNC and requests for streams are sent, as before any flight: some sources speak to nobody else, and
    the clock of some is not known before they have answered. Nothing that moves is.

    Raises:
        NotReachedError: No positions came.
        VehicleTakenError: Another daemon flies this vehicle.
    """
    samples: list[PositionSample] = []
    # The lock comes first: nothing is said to a vehicle that another daemon flies.
    with lock_vehicle(config.daemon.vehicle), open_links(config) as connections:
        links = make_links(config)
        ticker = Ticker(round(config.daemon.tick_s * 1e9), round(config.plant.dt_s * 1e9), monotonic_ns)
        due = ticker.next()
        end_ns = due.at_ns + round(LISTENS_S * 1e9)
        while due.at_ns < end_ns and not _enough(samples):
            while True:
                for name in wait(connections, due.at_ns):
                    samples += _heard(links[name], connections[name])
                if monotonic_ns() >= due.at_ns:
                    break
            for name, link in links.items():
                for data in link.due(due.at_ns):
                    connections[name].send(data)
            due = ticker.next()
    if not samples:
        raise NotReachedError(
            f"no position came within {LISTENS_S:g} s, so nobody knows whether the vehicle stands in the box; "
            "see to the cameras (`uavctl check`)"
        )
    ((source, _),) = Counter(one.source for one in samples).most_common(1)
    north, east, down = np.median([one.position_m for one in samples if one.source == source], axis=0).tolist()
    return north, east, down


def _heard(link: MavlinkConnection, connection: Connection) -> Iterator[PositionSample]:
    """Return the positions that have arrived; answer the sources and the vehicle as a flight does."""
    for index, (data, at_ns) in enumerate(connection.receive()):
        found, answers, settled, *_ = link.receive(data, at_ns)
        if any(isinstance(one, VehicleStatus) for one in found):
            connection.select_peer(index)
        elif settled and any(isinstance(one, PositionSample) for one in found):
            connection.trust_sender(index)
        for answer in answers:
            connection.send(answer)
        yield from (one for one in found if isinstance(one, PositionSample))


def _enough(samples: list[PositionSample]) -> bool:
    counts = Counter(one.source for one in samples)
    return bool(counts) and max(counts.values()) >= ENOUGH


# What `uavctl tune` shows on the terminal: the changes, and both flights beside each other.


def changes_picture(told: TunedResult) -> RenderableType:
    """Return tables of old and new values, and of both models' prediction errors on data they were not fitted to."""
    predicted, rows = make_error_columns(told.old_errors), make_error_rows(told.old_errors, told.new_errors)
    return Group(
        _table("Configuration", CHANGE_COLUMNS, make_change_rows(told), ("value", "why")),
        _table("Prediction on halves of the flight not fitted to, rms", predicted, rows, predicted[:2]),
        *(Text(f"{one}.", style="yellow") for one in told.warnings),
    )


def comparison_picture(progress: TuneProgress, folder: Path) -> RenderableType:
    """Return tables of what the run has found so far."""
    parts: list[RenderableType] = []
    if progress.tuned is not None:
        parts += [Text(one) for one in describe_tuning(progress.tuned, progress.comparison)]
    if progress.comparison is not None:
        parts.append(_table("Both flights", FIGURE_COLUMNS, make_figure_rows(progress.comparison), FIGURE_COLUMNS[:1]))
    if progress.tuned is not None:
        parts.append(Text(f"configuration: {folder / TUNED_FILE}"))
    if progress.comparison is not None:
        parts.append(Text(f"page: {folder / PAGE_FILE}"))
    return Group(*parts)


def _table(title: str, headings: Sequence[str], rows: Iterable[Sequence[str]], left: Sequence[str]) -> Table:
    return columns(title, headings, rows, left, fold=True)


# `uavctl tune`: fly to learn how the vehicle answers, write that down, fly again, compare. Goes on where it ended.


FAILED, INTERRUPTED, PILOT = 1, 130, 4  # exit codes: a flight went otherwise, Ctrl-C, the pilot has the vehicle
_LEVEL = (0, 1)


def tune(
    config: Annotated[str, Parameter(help="preset or TOML file that is to be tuned; it is never written to")],
    /,
    *,
    folder: Annotated[Path, Parameter(help="of the run; given again, the run goes on after its last finished step")],
    box: Annotated[
        str | None,
        Parameter(
            help="two opposite corners n,e,d,n,e,d in local NED [m]: the vehicle is excited inside",
            allow_leading_hyphen=True,
        ),
    ] = None,
    flight: Annotated[
        Path | None,
        Parameter(help="begin with this recording of ours instead; its mission is flown again", validator=can_be_read),
    ] = None,
    loopback: Annotated[
        bool, Parameter(negative=(), help="fly the simulator in this process, in virtual time")
    ] = False,
    seed: Annotated[int | None, Parameter(help="with --loopback: of every random draw", validator=SEED)] = None,
    vehicle: Annotated[str | None, Parameter(help="URL of the vehicle; else daemon.vehicle")] = None,
    mocap: Annotated[str | None, Parameter(help="URL of the positions; else daemon.mocap")] = None,
    arm: Annotated[bool, Parameter(negative=(), help="the vehicle may be armed; needs --takeoff")] = False,
    takeoff: TakeOff = None,
    yes: Annotated[bool, Parameter(negative=(), help="do not ask before the second flight")] = False,
    overrides: Overrides = (),
    json: Json = False,
) -> int:
    """Excite the vehicle inside a box, identify it, write a tuned configuration, fly again, and compare.

    The pilot's stick ends a flight at any time, and the pilot keeps the vehicle; Ctrl-C brakes and lands. Either way
    the same command goes on later. Without --arm the pilot arms, takes off and switches.

    Exit codes: 0 done; 1 a flight went otherwise, or shows too little; 2 what was asked for cannot be; 4 the pilot has
    taken over; 130 interrupted.
    """
    take_off_m = checked_take_off(arm, takeoff)
    if (box is None) == (flight is None):
        raise UsageError("give --box, to excite the vehicle inside, or --flight, to begin with a recording")
    if not loopback and seed is not None:
        raise UsageError("--seed is of the simulator; add --loopback")
    if loopback and not (vehicle is None and mocap is None):
        raise UsageError("--vehicle and --mocap are of a real vehicle; leave them out with --loopback")
    more = given_keys(daemon__vehicle=vehicle, daemon__mocap=mocap, sim__seed=seed)
    common = Common(config, overrides, json)
    if loopback and not _says_plant(common):
        more.insert(0, "sim.plant=quadrotor")
    loaded = common.with_overrides(more).load()
    check_tunable(loaded.config)
    with located(loaded):
        made = _Flights.of(loaded.config, box, flight, simulated=loopback, take_off_m=take_off_m)
    asked = TuneSettings(
        box="" if made.box is None else ",".join(f"{one:g}" for one in (*made.box.lower, *made.box.upper)),
        flight="" if flight is None else str(flight.absolute()),
        simulated=loopback,
        take_off_m=take_off_m,
    )
    with lock_run(folder):
        run = _TuneRun(TuneFolder.open(folder, loaded.config, asked), loaded.config, made, yes=yes or loopback)
        try:
            code, why = run.go()
        except KeyboardInterrupt:  # beside a flight, which has its own end
            code, why = INTERRUPTED, "interrupted by the operator"
    if why:
        messages().print(labelled("stopped", why, "bold yellow"), soft_wrap=True)
        messages().print(f"Go on with the same command; what is done stays in {folder}.", soft_wrap=True)
    progress = run.folder.progress
    document = {
        **msgspec.to_builtins(progress),
        "exit_code": code,
        "stopped": why,
        "config": str(folder / TUNED_FILE) if progress.tuned is not None else None,
        "report": str(folder / PAGE_FILE) if progress.comparison is not None else None,
    }
    common.show("tune", document, lambda: comparison_picture(progress, folder))
    return code


def _says_plant(common: Common) -> bool:
    """Return whether a file or an override chose the simulated vehicle."""
    if any(one.replace(" ", "").startswith("sim.plant=") for one in common.overrides):
        return True
    path = Path(common.config)
    if path.suffix != ".toml" or not path.exists():
        return False
    sim = parse_toml(path.read_text(encoding="utf-8"), str(path)).get("sim")
    return isinstance(sim, dict) and "plant" in sim


@dataclass(frozen=True)
class _Flights:
    """Settings of both flights of a tuning run."""

    mission: Config  # the configuration with the mission of both flights
    box: SafeBox | None  # where they stay; None with a recording
    flight: Path | None  # the recording that is begun with
    simulated: bool  # both are flown in the simulator
    take_off_m: float | None  # height of the climb; None leaves arming to the pilot

    @classmethod
    def of(
        cls, config: Config, box: str | None, flight: Path | None, *, simulated: bool, take_off_m: float | None
    ) -> _Flights:
        """Check what is asked for, before anything is sent.

        Raises:
            UsageError: The box is none, or does not do.
            DesignError: There is no controller of this configuration.
        """
        lands = not simulated or take_off_m is not None
        if flight is not None:
            flown = parse_recorded(header(flight).config_toml, f"{flight} (configuration)").config
            mission = msgspec.structs.replace(
                flown.mission, then="land" if lands and flown.mission.waypoints else "hold"
            )
            as_flown = msgspec.structs.replace(
                config, mission=mission, fence=flown.fence, target=flown.target, duration_s=flown.duration_s
            )
            return cls(as_flown, None, flight, simulated, take_off_m)
        assert box is not None
        inside = parse_box(box)
        design = design_of(config)
        mission_of = add_excitation(config, design, inside, lands=lands)
        if take_off_m is not None:
            check_start(inside, (0.0, 0.0, -take_off_m), "--takeoff", (DOWN,))
        if simulated:
            axes = _LEVEL if take_off_m is not None else (*_LEVEL, DOWN)
            centre = ",".join(f"{one:g}" for one in inside.centre)
            hint = f"begin inside, as with --set sim.start_position_m=[{centre}]"
            check_start(inside, config.sim.start_position_m, "sim.start_position_m", axes, hint)
        return cls(mission_of, inside, None, simulated, take_off_m)


class _TuneRun:
    """Steps of a tuning run; a step that is done is skipped."""

    def __init__(self, folder: TuneFolder, config: Config, made: _Flights, *, yes: bool) -> None:
        self.folder = folder
        self._config = config
        self._made = made
        self._yes = yes

    def go(self) -> tuple[int, str]:
        """Take the remaining steps; return the exit code, and why it stopped before the end."""
        for step in (self._excite, self._identify, self._refly, self._compare):
            code, why = step()
            if code:
                return code, why
        return 0, ""

    def _excite(self) -> tuple[int, str]:
        if self.folder.progress.before:
            return self._told("the first flight is there")
        if self._made.flight is not None:
            if cut := lacks_end(self._made.flight):
                warn(f"{cut}: identified from what comes before")
            self.folder.save_progress(before=str(self._made.flight.absolute()))
            return 0, ""
        if (done := self._flown_before(self._made.mission, BEFORE_FOLDER)) is not None:
            return done
        self._say_what_comes("The first flight, with the configuration as it is")
        return self._fly(self._made.mission, BEFORE_FOLDER)

    def _identify(self) -> tuple[int, str]:
        if self.folder.progress.tuned is not None and (self.folder.path / TUNED_FILE).exists():
            return self._told("identified, and the configuration is written")
        recording = self.folder.get_recording_path(self.folder.progress.before)
        history = read_recorded_history(read(recording))
        with fitting(count_fits(history, self._config)) as advance:
            found = identify(history, self._config, advance)
        result = tune_config(self._config, found)
        doubts = design_doubts(result.config)
        write_atomically(
            self.folder.path / FIT_PAGE_FILE, render_identify_page(found, history.positions, str(recording))
        )
        told = msgspec.structs.replace(result.result, warnings=(*result.result.warnings, *doubts))
        messages().print(changes_picture(told))
        if doubts:
            raise RecordingError(f"{doubts[0]}. Nothing is written")
        lines = [f"# {one}" for one in _written(told)]
        write_atomically(self.folder.path / TUNED_FILE, "\n".join([*lines, dump_config(result.config)]))
        self.folder.save_progress(tuned=told)
        messages().print(f"written: {self.folder.path / TUNED_FILE}", soft_wrap=True)
        return 0, ""

    def _refly(self) -> tuple[int, str]:
        if self.folder.progress.after:
            return self._told("the second flight is there")
        mission = self._made.mission
        again = msgspec.structs.replace(
            self._tuned(),
            mission=mission.mission,
            fence=mission.fence,
            target=mission.target,
            duration_s=mission.duration_s,
        )
        if (done := self._flown_before(again, AFTER_FOLDER)) is not None:
            return done
        self._say_what_comes("The second flight: the same mission with the tuned configuration")
        if not self._yes and not agreed():
            return INTERRUPTED, "the second flight was not agreed to"
        return self._fly(again, AFTER_FOLDER)

    def _compare(self) -> tuple[int, str]:
        progress = self.folder.progress
        if progress.comparison is not None and (self.folder.path / PAGE_FILE).exists():
            return 0, ""
        paths = [self.folder.get_recording_path(one) for one in (progress.before, progress.after)]
        flights = [FlightData.from_records(read(path), path) for path in paths]
        before, after = (
            compute_flight_figures(one, noted, summarise(one, wall_s=None).fallbacks, self._made.box)
            for one, noted in zip(flights, (progress.before, progress.after), strict=True)
        )
        old, new = self._errors(paths[1])
        found = TuneComparison(before=before, after=after, old_errors=old, new_errors=new)
        self.folder.save_progress(comparison=found)
        progress = self.folder.progress
        write_atomically(
            self.folder.path / PAGE_FILE, render_tune_page(progress, flights[0], flights[1], self._made.box)
        )
        return 0, ""

    def _errors(self, recording: Path) -> tuple[PredictionErrors, PredictionErrors]:
        """Return the prediction errors of the old and the new plant on the second flight."""
        history = read_recorded_history(read(recording))
        new = self._tuned()
        flown = make_fitted_stretches(history, new)
        ramp_s = compute_ramp_delay_s(history, new)
        names = new.plant.axes
        where = [AXES.index(name) for name in names]
        models = get_candidate_models(history, new)[0]
        found = []
        for one in (self._config, new):
            response = get_assumed_response(one, ramp_s)
            pinned = [PinnedAxisModel(model, own) for model, own in zip(models, response.axes, strict=True)]
            found.append(compute_held_out_errors(flown, names, where, pinned, response.dead_time_s, new.plant.dt_s))
        return found[0], found[1]

    def _tuned(self) -> Config:
        return read_tuned(self.folder.path / TUNED_FILE)

    def _flown_before(self, config: Config, name: str) -> tuple[int, str] | None:
        """Take up a flight that ended while nobody was left to note it; None if there is none."""
        newest = self.folder.find_newest(name)
        recording = None if newest is None else left_whole(config, newest)
        if recording is None:
            return None
        self.folder.save_progress(**{name: self.folder.make_relative(recording)})
        return self._told(f"the flight in {newest} came to its end, and counts")

    def _fly(self, config: Config, name: str) -> tuple[int, str]:
        if not self._made.simulated and self._made.box is not None:
            check_start(self._made.box, where_it_stands(self._config), "where the vehicle stands", _LEVEL)
        box, weakest = self._made.box, MIN_BRAKE_SHARE if name == BEFORE_FOLDER else TUNED_BRAKE_SHARE
        flown = fly_once(
            config,
            self.folder.find_free_folder(name),
            simulated=self._made.simulated,
            take_off_m=self._made.take_off_m,
            monitor=None if box is None else BoxMonitor(config, box, weakest),
        )
        if flown.repeated:
            self._told(f"motions that came too near to a side of the box and were repeated smaller: {flown.repeated}")
        code, why = _stopped(flown)
        if not code:
            self.folder.save_progress(**{name: self.folder.make_relative(flown.recording)})
        return code, why

    def _say_what_comes(self, what: str) -> None:
        mission, box = self._made.mission.mission, self._made.box
        messages().print(f"{what}.", style="bold", soft_wrap=True)
        if box is not None:
            sides = ", ".join(
                f"{axis} {low:g} to {high:g}" for axis, low, high in zip(AXES, box.lower, box.upper, strict=True)
            )
            messages().print(f"{len(mission.waypoints)} waypoints in the box {sides} m.", soft_wrap=True)
        if not self._made.simulated:
            messages().print(
                "The pilot's stick ends it at any time, and the pilot keeps the vehicle. Ctrl-C brakes and lands; so "
                "does the end of the mission.",
                soft_wrap=True,
            )

    def _told(self, what: str) -> tuple[int, str]:
        messages().print(what, style="dim", soft_wrap=True)
        return 0, ""


def _stopped(flown: TuneFlown) -> tuple[int, str]:
    sentence = flown.summary.ending.sentence.removesuffix(".")
    codes = {TuneEnd.WHOLE: 0, TuneEnd.PILOT: PILOT, TuneEnd.OPERATOR: INTERRUPTED, TuneEnd.FAILED: FAILED}
    code = codes[flown.end]
    if flown.ended and flown.end is TuneEnd.FAILED:
        return code, f"{flown.ended} ({flown.recording})"
    told = flown.end is not TuneEnd.OPERATOR or "operator" in sentence
    who = "" if told else "Ended by the operator. "
    return code, "" if not code else f"{who}{sentence}. The flight did not come to its end ({flown.recording})"


def agreed() -> bool:
    """Ask the operator to press Enter; without anybody there the answer is no."""
    messages().print("Press Enter to fly, Ctrl-C to stop here.", soft_wrap=True)
    return bool(sys.stdin.readline())


def _written(told: TunedResult) -> Iterator[str]:
    yield "Written by `uavctl tune`. Changed:"
    for row in told.changes:
        if row.is_changed:
            yield f"  {row.key}{f', {row.axis}' if row.axis else ''}: {row.old:g} -> {row.new:g}"
