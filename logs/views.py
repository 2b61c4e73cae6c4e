"""Makes the topics for viewers from the records of a flight, as they come.

It runs where recordings are written, never in the control thread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from google.protobuf.message import Message

from logs import plot_records as plots
from logs import scene
from logs import view_topics as topics
from logs.design_view import DesignView, design_view
from logs.proto import pack
from logs.topics import RecorderNote
from uavctl.data import (
    Datagram,
    Decision,
    Estimate,
    Event,
    Header,
    LinkEstimate,
    LinkStats,
    Plan,
    Record,
    Setpoint,
    Severity,
    SolveStatus,
    StepInput,
    Timing,
    Truth,
    Vec3,
    VehicleStatus,
)

STILL_NS = 5_000_000_000  # what does not move is told again: for viewers that come late, and files begun later
TRAIL_NS = 1_000_000_000
TRAIL_S = 20.0
_TRAIL_POINTS = 200  # at most, however fast positions come
_Item = tuple[str, Message]


class Views:
    """Makes messages for viewers; one for each recording, since paths and the newest estimate are remembered."""

    def __init__(self) -> None:
        self._design: DesignView | None = None
        self._estimate: Estimate | None = None
        self._flown = _Trail()
        self._measured = _Trail()
        self._true_path = False
        self._still_ns = self._trail_ns = 0

    def made(self, at_ns: int, record: Record) -> list[tuple[str, bytes]]:
        """Topic and message of what a record gives rise to, in order; nothing before a header.

        Args:
            at_ns: log time of the record, and of what is made of it [ns].
            record: the next one of the recording.

        Raises:
            RecordingError: a header whose design cannot be used: no views come of this recording.
            ValueError, TypeError: the record holds something that has no place in a view.
            LookupError: its arrays do not fit the design.
        """
        if isinstance(record, Header):
            self._design, self._still_ns = design_view(record), at_ns
        if self._design is None or isinstance(record, Datagram):  # half of all records
            return []
        views = [*self._views(self._design, at_ns, record)]
        made = [(topic, view.SerializeToString()) for topic, view in views]
        made += [(topics.PLOTS[type(plot)], pack(plot)) for plot in self._plots(self._design, record)]
        return made

    def _plots(self, design: DesignView, record: Record) -> Iterator[Record]:
        match record:
            case Decision():
                captured_ns = None if self._estimate is None else self._estimate.captured_ns
                yield plots.age_plot(design, record, captured_ns)
                yield plots.input_plot(design, record)
            case Estimate():
                yield plots.state_plot(design, record)
            case Setpoint():
                yield plots.setpoint_plot(record)
            case Timing():
                yield plots.timing_plot(record)
            case Plan():
                yield plots.solve_plot(record)
                if record.status is SolveStatus.OPTIMAL:
                    yield plots.limits_plot(design, record)
            case LinkEstimate():
                yield plots.link_plot(record)
            case LinkStats():
                yield plots.counter_plot(record)
            case Truth():
                yield plots.truth_plot(record)
            case VehicleStatus():
                yield plots.vehicle_plot(record)

    def _views(self, design: DesignView, at_ns: int, record: Record) -> Iterator[_Item]:
        match record:
            case Header() | Decision():
                yield from self._still(design, at_ns)
                if isinstance(record, Decision):
                    yield from self._decision(design, record)
            case Estimate():
                self._estimate = record
                at_m = design.position_of(record.mean)
                if not self._true_path:
                    self._flown.add(record.at_ns, at_m)
                yield topics.ESTIMATE, scene.pose_in_frame(record.at_ns, at_m)
                yield topics.VEHICLE_FRAME, scene.vehicle_frame(record.at_ns, at_m)
            case Truth():
                self._true_path = True
                self._flown.add(record.at_ns, record.position_m)
                yield topics.TRUTH, scene.pose_in_frame(record.at_ns, record.position_m)
            case StepInput():
                for sample in record.samples:
                    self._measured.add(record.at_ns, sample.position_m)
                    yield topics.MEASURED, scene.pose_in_frame(sample.captured_ns, sample.position_m)
            case Plan() if record.status is SolveStatus.OPTIMAL:
                places = design.positions_of(record.states)
                yield topics.PLAN, scene.poses_in_frame(at_ns, places)
                yield topics.PLAN_SCENE, scene.plan_scene(at_ns, design, record, self._estimate, places)
            case Event():
                yield topics.LOG, scene.log_line(record)
            case RecorderNote():
                told = Event(at_ns=at_ns, severity=Severity.WARNING, code="recording", text=record.text)
                yield topics.LOG, scene.log_line(told)

    def _still(self, design: DesignView, at_ns: int) -> Iterator[_Item]:
        """What does not move, when it is due."""
        if at_ns >= self._still_ns:
            self._still_ns = at_ns + STILL_NS
            yield topics.FRAMES, scene.frames(at_ns)
            yield topics.ROOM_SCENE, scene.room_scene(at_ns, design)

    def _decision(self, design: DesignView, decision: Decision) -> Iterator[_Item]:
        if decision.boundary:
            yield topics.LINK_SCENE, scene.link_scene(design, decision)
            if decision.target is not None:
                target_m = design.position_of(decision.target)
                yield topics.TARGET, scene.pose_in_frame(decision.at_ns, target_m)
        if decision.at_ns >= self._trail_ns:
            self._trail_ns = decision.at_ns + TRAIL_NS
            since_ns = decision.at_ns - round(TRAIL_S * 1e9)
            yield (
                topics.PATH_SCENE,
                scene.path_scene(decision.at_ns, self._flown.since(since_ns), self._measured.since(since_ns)),
            )


class _Trail:
    """Places of the last while."""

    def __init__(self) -> None:
        self._places: deque[tuple[int, Vec3]] = deque(maxlen=_TRAIL_POINTS)

    def add(self, at_ns: int, at_m: Vec3) -> None:
        """Take a place, unless the last one was there only just before."""
        if not self._places or at_ns - self._places[-1][0] >= TRAIL_S * 1e9 / _TRAIL_POINTS:
            self._places.append((at_ns, at_m))

    def since(self, at_ns: int) -> list[Vec3]:
        """Places since a time."""
        return [at_m for told_ns, at_m in self._places if told_ns >= at_ns]
