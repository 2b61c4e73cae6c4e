"""3D scenes of a flight in Foxglove's messages, all in local NED; viewers turn it (topic /view/frames).

The parts of a message are made as its fields, to be put in once: a message in a message would be copied at each depth.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import product
from typing import Any, TypeVar

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message

from logs.recording import derived_topics as topics
from logs.recording.derived_topics import pack_message, tighten_limits
from logs.recording.design_view import AXIS_NUMBER, DesignView, read_design
from logs.recording.notes import RecorderNote
from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.frames import quaternion_from_axes, rotation_to_ned
from uavctl.records import (
    ControlMode,
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

Fields = dict[str, Any]  # of a message within another
M = TypeVar("M", bound=Message)

ROOM, NED, VEHICLE = "room", "ned", "vehicle"  # east-north-up; local NED; at the vehicle's estimated place
OPEN_M = 5.0  # an open side of the room is drawn so far from the target
# Square root of the 0.95 quantile of chi squared with three degrees of freedom: what an estimate's ellipsoid holds.
STD_95 = 2.7955


def _choose_colour(red: float, green: float, blue: float, alpha: float) -> Fields:
    return {"r": red, "g": green, "b": blue, "a": alpha}


_LIMITS, _TIGHT = _choose_colour(0.9, 0.9, 0.9, 0.9), _choose_colour(1.0, 0.65, 0.1, 0.8)
_PLANNED, _SPREAD = _choose_colour(0.25, 0.6, 1.0, 1.0), _choose_colour(0.25, 0.6, 1.0, 0.15)
_FLOWN, _MEASURED = _choose_colour(0.2, 0.85, 0.4, 1.0), _choose_colour(0.85, 0.3, 0.85, 0.8)
_NEW_MEASUREMENT, _SILENCE, _FALLBACK = _choose_colour(0.2, 0.85, 0.4, 0.9), _TIGHT, _choose_colour(0.95, 0.2, 0.2, 0.9)
_LEVEL: Fields = {"w": 1.0}
_LABEL_M = (0.0, 0.0, -0.35)  # above the vehicle: down is positive
_IN_CONTROL = frozenset({ControlMode.WAIT, ControlMode.TRACK})
_LEVELS = {Severity.INFO: Log.INFO, Severity.WARNING: Log.WARNING, Severity.ERROR: Log.ERROR}
BOX_EDGES = [  # corners whose numbers differ in one bit
    corner for first, second in product(range(8), repeat=2) if first < second and (first ^ second) in (1, 2, 4)
    for corner in (first, second)
]  # fmt: skip


def _make_message(kind: Callable[..., M], **fields: Any) -> M:
    """Make a message of its fields; the constructors are typed for nested messages, not for their fields."""
    return kind(**fields)


def make_timestamp(at_ns: int) -> Fields:
    """Return a log time as a Protobuf timestamp."""
    return {"seconds": at_ns // 1_000_000_000, "nanos": at_ns % 1_000_000_000}


def make_vector(at_m: Sequence[float]) -> Fields:
    """Return three numbers as a vector or a point."""
    return {"x": at_m[0], "y": at_m[1], "z": at_m[2]}


def make_pose(at_m: Sequence[float], turn: Fields = _LEVEL) -> Fields:
    """Return a place [m] and a rotation as a pose."""
    return {"position": make_vector(at_m), "orientation": turn}


def make_quaternion(turn: Sequence[float]) -> Fields:
    """Return a rotation (w, x, y, z) as a quaternion."""
    w, x, y, z = turn
    return {"x": x, "y": y, "z": z, "w": w}


def make_pose_in_frame(at_ns: int, at_m: Vec3) -> PoseInFrame:
    """Return a place in local NED [m] as a pose with its frame."""
    return _make_message(PoseInFrame, timestamp=make_timestamp(at_ns), frame_id=NED, pose=make_pose(at_m))


def make_poses_in_frame(at_ns: int, places_m: Array) -> PosesInFrame:
    """Return places in local NED [m] (n, 3) as poses with their frame, in order."""
    poses = [make_pose(at_m) for at_m in places_m.tolist()]
    return _make_message(PosesInFrame, timestamp=make_timestamp(at_ns), frame_id=NED, poses=poses)


def make_frames(at_ns: int) -> FrameTransforms:
    """Return the transform from local NED to the room's frame, whose z axis points up as viewers want it."""
    turned: Fields = {
        "timestamp": make_timestamp(at_ns),
        "parent_frame_id": ROOM,
        "child_frame_id": NED,
        "translation": {},
        "rotation": make_quaternion(rotation_to_ned("enu")),
    }
    return _make_message(FrameTransforms, transforms=[turned])


def make_vehicle_frame(at_ns: int, at_m: Vec3) -> FrameTransform:
    """Return the transform to the estimated position; the attitude is not known, so axes stay those of local NED."""
    return _make_message(
        FrameTransform,
        timestamp=make_timestamp(at_ns),
        parent_frame_id=NED,
        child_frame_id=VEHICLE,
        translation=make_vector(at_m),
        rotation=_LEVEL,
    )


def make_log_message(event: Event, at_ns: int) -> Log:
    """Return an event as a log message."""
    times = "" if event.count == 1 else f" ({event.count} times)"
    return _make_message(
        Log, timestamp=make_timestamp(at_ns), level=_LEVELS[event.severity], message=event.text + times, name=event.code
    )


def draw_room(at_ns: int, design: DesignView) -> SceneUpdate:
    """Draw the position limits as a box."""
    lower, upper = get_room_sides(design, design.state_box.lower, design.state_box.upper)
    return _make_update(_make_entity(at_ns, "limits", lines=[_make_box(lower, upper, _LIMITS)]))


def draw_plan(
    at_ns: int, design: DesignView, plan: Plan, estimate: Estimate | None, positions: Array | None = None
) -> SceneUpdate:
    """Draw a plan's predicted path, its confidence ellipsoids, and the tightened limits at its end.

    A stage's ellipsoid has the back-offs of the position limits as semi-axes: what the plan keeps
    from them so that they hold with the promised probability. The estimate's is from its covariance.
    `places` are the positions of the plan's states, where they are at hand.
    """
    places = design.positions_of(plan.states) if positions is None else positions
    diameters = 2.0 * _compute_semi_axes(design, plan.backoff_x)
    spheres = [_make_ellipsoid(*stage) for stage in zip(places.tolist(), diameters.tolist(), strict=True)]
    lower, upper = get_room_sides(design, *tighten_limits(design, plan.backoff_x, -1))
    entities = [
        _make_entity(at_ns, "predicted path", lines=[_make_line(places.tolist(), _PLANNED, 3.0)]),
        _make_entity(at_ns, "predicted spread", spheres=spheres),
        _make_entity(at_ns, "limits less back-offs", lines=[_make_box(lower, upper, _TIGHT)]),
    ]
    if estimate is not None:
        entities.append(_make_entity(at_ns, "estimate, 95 %", spheres=[_draw_estimate_ellipsoid(design, estimate)]))
    return _make_update(*entities)


def draw_path(at_ns: int, flown_m: Sequence[Vec3], measured_m: Sequence[Vec3]) -> SceneUpdate:
    """Draw the recently flown path and the recent positions."""
    return _make_update(
        _make_entity(at_ns, "flown path", lines=[_make_line(flown_m, _FLOWN, 3.0)]),
        _make_entity(at_ns, "measured path", lines=[_make_line(measured_m, _MEASURED, 1.5)]),
    )


def draw_link(at_ns: int, design: DesignView, decision: Decision) -> SceneUpdate:
    """Draw the link's state at the vehicle, with words: green with news, amber in silence, red in the fallback."""
    colour = _FALLBACK if decision.mode not in _IN_CONTROL else _NEW_MEASUREMENT if decision.news else _SILENCE
    age = "no position yet" if decision.age_steps is None else f"age {decision.age_steps} of {design.horizon} steps"
    label: Fields = {
        "pose": make_pose(_LABEL_M),
        "billboard": True,
        "font_size": 14.0,
        "scale_invariant": True,
        "color": colour,
        "text": f"{decision.mode.value}, {age}",
    }
    ball: Fields = {"pose": make_pose((0.0, 0.0, 0.0)), "size": make_vector((0.2, 0.2, 0.2)), "color": colour}
    return _make_update(_make_entity(at_ns, "link", VEHICLE, spheres=[ball], texts=[label]))


def _make_update(*entities: Fields) -> SceneUpdate:
    return _make_message(SceneUpdate, entities=entities)


def _make_entity(
    at_ns: int,
    name: str,
    frame: str = NED,
    *,
    lines: Sequence[Fields] = (),
    spheres: Sequence[Fields] = (),
    texts: Sequence[Fields] = (),
) -> Fields:
    return {
        "timestamp": make_timestamp(at_ns),
        "frame_id": frame,
        "id": name,
        "frame_locked": True,
        "lines": lines,
        "spheres": spheres,
        "texts": texts,
    }


def _make_line(places_m: Iterable[Sequence[float]], colour: Fields, pixels: float) -> Fields:
    return {
        "type": LinePrimitive.LINE_STRIP,
        "pose": make_pose((0.0, 0.0, 0.0)),
        "thickness": pixels,
        "scale_invariant": True,
        "points": [make_vector(at_m) for at_m in places_m],
        "color": colour,
    }


def _make_box(lower: Vec3, upper: Vec3, colour: Fields) -> Fields:
    line = _make_line(product(*zip(lower, upper, strict=True)), colour, 1.5)
    return {**line, "type": LinePrimitive.LINE_LIST, "indices": BOX_EDGES}


def get_room_sides(design: DesignView, lower: Array, upper: Array) -> tuple[Vec3, Vec3]:
    """Return the sides of the room in local NED [m]; open ones lie near the target, axes without motion are flat."""
    centre = np.array(design.target)
    return (
        design.position_of(np.where(np.isfinite(lower), lower, centre - OPEN_M).tolist()),
        design.position_of(np.where(np.isfinite(upper), upper, centre + OPEN_M).tolist()),
    )


def _compute_semi_axes(design: DesignView, backoff: Array) -> Array:
    """Return the semi-axes of the stages' ellipsoids (n, 3) [m]; 0 in an axis without limits."""
    reach = np.zeros((len(backoff), len(design.target)))
    for state, row, size in design.position_rows:
        np.maximum(reach[:, state], backoff[:, row] / size, out=reach[:, state])
    return design.positions_of(reach)


def _make_ellipsoid(at_m: Sequence[float], size_m: Sequence[float], turn: Fields = _LEVEL) -> Fields:
    return {"pose": make_pose(at_m, turn), "size": make_vector(size_m), "color": _SPREAD}


def _draw_estimate_ellipsoid(design: DesignView, estimate: Estimate) -> Fields:
    """Draw the ellipsoid that holds the position with 95 %, by the covariance."""
    cov = [[0.0] * 3 for _ in range(3)]
    axis_states = [(AXIS_NUMBER[axis], index) for axis, index in zip(design.axes, design.position_index, strict=True)]
    for row, i in axis_states:
        for column, j in axis_states:
            cov[row][column] = estimate.cov[i][j]
    variances, directions = np.linalg.eigh(cov)
    semi_axes_m = STD_95 * np.sqrt(np.maximum(variances, 0.0))
    turn = make_quaternion(quaternion_from_axes(directions.T.tolist()))
    return _make_ellipsoid(design.position_of(estimate.mean), (2 * semi_axes_m).tolist(), turn)


STILL_NS = 5_000_000_000  # what does not move is told again: for viewers that come late, and files begun later
TRAIL_NS = 1_000_000_000
PLAN_NS = 200_000_000  # between two drawn plans: each has some 10 kB, and five a second look smooth
TRAIL_S = 20.0
_TRAIL_POINTS = 100  # at most, however fast positions come
_Item = tuple[str, Message]


class ViewBuilder:
    """Maker of messages for viewers, one for each recording: it remembers paths and the newest estimate."""

    def __init__(self) -> None:
        self._design: DesignView | None = None
        self._estimate: Estimate | None = None
        self._flown = _Trail()
        self._measured = _Trail()
        self._true_path = False
        self._still_ns = self._trail_ns = self._plan_ns = 0
        self._zero_utc_ns = 0  # stamps, like log times, are so much later than the records' times

    def derive(self, at_ns: int, record: Record) -> list[tuple[str, bytes]]:
        """Yield topic and message of all that is derived from a record, in order; nothing before a header.

        Args:
            at_ns: time of the record by our clock [ns]; what is made of it has stamps in UTC, as the header says.

        Raises:
            RecordingError: a header whose design cannot be used: no views come of this recording.
            ValueError, TypeError: the record holds something that has no place in a view.
            LookupError: its arrays do not fit the design.
        """
        if isinstance(record, Header):
            self._design, self._still_ns = read_design(record), at_ns
            self._zero_utc_ns = record.zero_utc_ns or 0
        if self._design is None or isinstance(record, Datagram):  # half of all records
            return []
        views = [*self._make_views(self._design, at_ns, record)]
        messages = [(topic, view.SerializeToString()) for topic, view in views]
        messages += [(topics.PLOTS[type(plot)], pack_message(plot)) for plot in self._make_plots(self._design, record)]
        return messages

    def _make_plots(self, design: DesignView, record: Record) -> Iterator[Record]:
        match record:
            case Decision():
                captured_ns = None if self._estimate is None else self._estimate.captured_ns
                yield topics.make_age_plot(design, record, captured_ns)
                yield topics.make_input_plot(design, record)
            case Estimate():
                yield topics.make_state_plot(design, record)
            case Setpoint():
                yield topics.make_setpoint_plot(record)
            case Timing():
                yield topics.make_timing_plot(record)
            case Plan():
                yield topics.copy_fields(topics.SolvePlot, record, status=record.status.value)
                if record.status is SolveStatus.OPTIMAL:
                    yield topics.make_limits_plot(design, record)
            case LinkEstimate():
                yield topics.copy_fields(topics.LinkPlot, record)
            case LinkStats():
                yield topics.make_counter_plot(record)
            case Truth():
                yield topics.make_truth_plot(record)
            case VehicleStatus():
                yield topics.copy_fields(topics.VehiclePlot, record, battery_v=topics.replace_missing(record.battery_v))

    def _make_views(self, design: DesignView, at_ns: int, record: Record) -> Iterator[_Item]:
        match record:
            case Header() | Decision():
                yield from self._make_still_views(design, at_ns)
                if isinstance(record, Decision):
                    yield from self._make_decision_views(design, record)
            case Estimate():
                self._estimate = record
                at_m = design.position_of(record.mean)
                if not self._true_path:
                    self._flown.add(record.at_ns, at_m)
                utc_ns = record.at_ns + self._zero_utc_ns
                yield topics.ESTIMATE, make_pose_in_frame(utc_ns, at_m)
                yield topics.VEHICLE_FRAME, make_vehicle_frame(utc_ns, at_m)
            case Truth():
                self._true_path = True
                self._flown.add(record.at_ns, record.position_m)
                yield topics.TRUTH, make_pose_in_frame(record.at_ns + self._zero_utc_ns, record.position_m)
            case StepInput():
                for sample in record.samples:
                    self._measured.add(record.at_ns, sample.position_m)
                    captured_utc_ns = sample.captured_ns + self._zero_utc_ns
                    yield topics.MEASURED, make_pose_in_frame(captured_utc_ns, sample.position_m)
            case Plan() if record.status is SolveStatus.OPTIMAL and at_ns >= self._plan_ns:
                self._plan_ns = at_ns + PLAN_NS
                positions = design.positions_of(record.states)
                utc_ns = at_ns + self._zero_utc_ns
                yield topics.PLAN, make_poses_in_frame(utc_ns, positions)
                yield topics.PLAN_SCENE, draw_plan(utc_ns, design, record, self._estimate, positions)
            case Event():
                yield topics.LOG, make_log_message(record, record.at_ns + self._zero_utc_ns)
            case RecorderNote():
                event = Event(at_ns=at_ns, severity=Severity.WARNING, code=EventCode.RECORDING, text=record.text)
                yield topics.LOG, make_log_message(event, at_ns + self._zero_utc_ns)

    def _make_still_views(self, design: DesignView, at_ns: int) -> Iterator[_Item]:
        """Yield the scenes that do not move, when they are due."""
        if at_ns >= self._still_ns:
            self._still_ns = at_ns + STILL_NS
            yield topics.FRAMES, make_frames(at_ns + self._zero_utc_ns)
            yield topics.ROOM_SCENE, draw_room(at_ns + self._zero_utc_ns, design)

    def _make_decision_views(self, design: DesignView, decision: Decision) -> Iterator[_Item]:
        utc_ns = decision.at_ns + self._zero_utc_ns
        if decision.boundary:
            yield topics.LINK_SCENE, draw_link(utc_ns, design, decision)
            if decision.target is not None:
                target_m = design.position_of(decision.target)
                yield topics.TARGET, make_pose_in_frame(utc_ns, target_m)
        if decision.at_ns >= self._trail_ns:
            self._trail_ns = decision.at_ns + TRAIL_NS
            since_ns = decision.at_ns - round(TRAIL_S * 1e9)
            yield (
                topics.PATH_SCENE,
                draw_path(utc_ns, self._flown.list_points(since_ns), self._measured.list_points(since_ns)),
            )


class _Trail:
    """Recent places."""

    def __init__(self) -> None:
        self._points: deque[tuple[int, Vec3]] = deque(maxlen=_TRAIL_POINTS)

    def add(self, at_ns: int, at_m: Vec3) -> None:
        """Add a place, unless the last one was added only just before."""
        if not self._points or at_ns - self._points[-1][0] >= TRAIL_S * 1e9 / _TRAIL_POINTS:
            self._points.append((at_ns, at_m))

    def list_points(self, at_ns: int) -> list[Vec3]:
        """Return the places since a time."""
        return [at_m for point_ns, at_m in self._points if point_ns >= at_ns]
