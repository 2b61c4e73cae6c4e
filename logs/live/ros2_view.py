"""Content of a flight's messages of ROS 2, made from its records. Pure: no ROS is imported.

A message is a mapping of its fields. Axes are those of REP 103: frame `map` has the axes east, north, up of local NED,
and the body's are forward, left, up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from logs.live.scene import FlightScene, Level, LiveScene
from logs.recording.derived_topics import tighten_limits
from logs.recording.design_view import DesignView, read_design
from logs.recording.views import BOX_EDGES, get_room_sides
from uavctl.arrays import SECOND_NS, Array
from uavctl.errors import RecordingError
from uavctl.frames import Frame, Quaternion, quaternion_from_euler
from uavctl.records import ControlMode, Decision, Estimate, Header, Plan, Record, SolveStatus, StepInput, VehicleMotion

Fields = Mapping[str, Any]
FRAME = "map"
ENU = Frame("enu")
DIAGNOSTICS_PERIOD_NS = LIMITS_PERIOD_NS = SECOND_NS
MAX_ATTITUDE_AGE_NS = SECOND_NS
_LINE_LIST = 5  # visualization_msgs/Marker
_LINE_M = 0.02
_OK, _WARN, _ERROR = 0, 1, 2  # diagnostic_msgs/DiagnosticStatus
_LEVELS: dict[Level, int] = {"good": _OK, "plain": _OK, "warn": _WARN, "bad": _ERROR}
_WHITE, _ORANGE = ({"r": 0.9, "g": 0.9, "b": 0.9, "a": 0.9}, {"r": 1.0, "g": 0.65, "b": 0.1, "a": 0.8})
_UNKNOWN_ATTITUDE: Quaternion = (1.0, 0.0, 0.0, 0.0)


class Output(NamedTuple):
    """A topic that a flight publishes."""

    kind: str
    is_latched: bool = False  # who subscribes later gets the newest message


POSE, PLAN, LIMITS, DIAGNOSTICS = "pose", "plan", "limits", "/diagnostics"
# By its name below the flight's namespace; tools look for diagnostics at the root.
OUTPUTS = {
    POSE: Output("geometry_msgs/msg/PoseStamped"),
    PLAN: Output("nav_msgs/msg/Path"),
    LIMITS: Output("visualization_msgs/msg/MarkerArray", is_latched=True),
    DIAGNOSTICS: Output("diagnostic_msgs/msg/DiagnosticArray"),
}


class Ros2View:
    """Makes messages of records; remembers the newest of each kind.

    Args:
        namespace: Of the flight, for its diagnostics.

    Attributes:
        last_order: Newest order by ROS 2 and its answer, for the diagnostics.
    """

    def __init__(self, namespace: str) -> None:
        self._namespace = namespace
        self._scene = FlightScene()
        self._design: DesignView | None = None
        self._motion: VehicleMotion | None = None
        self._mode: ControlMode | None = None
        self._diagnostics_ns = self._limits_ns = 0  # next times
        self.last_order = ""

    def make_messages(self, record: Record, utc_ns: int) -> Iterator[tuple[str, Fields]]:
        """Yield the name and the message of each output that follows from a record.

        Args:
            utc_ns: Log time of the record.
        """
        self._scene.add_record(record)
        match record:
            case Header():
                self._read_design(record)
            case StepInput() if record.motion is not None:
                self._motion = record.motion
            case Decision():
                yield from self._make_diagnostics(record, utc_ns)
        if self._design is None:
            return
        match record:
            case Header():
                yield LIMITS, self._make_limits(self._design, utc_ns)
            case Estimate():
                at_m = self._design.position_of(record.mean)
                yield POSE, {"header": make_header(utc_ns), "pose": make_pose(at_m, self._get_attitude(record.at_ns))}
            case Plan() if record.status is SolveStatus.OPTIMAL:
                yield PLAN, make_path(self._design, record, utc_ns)
                if utc_ns >= self._limits_ns:
                    self._limits_ns = utc_ns + LIMITS_PERIOD_NS
                    yield LIMITS, self._make_limits(self._design, utc_ns, record)

    def _read_design(self, header: Header) -> None:
        try:
            self._design = read_design(header)
        except RecordingError:
            self._design = None  # nothing but diagnostics is published

    def _get_attitude(self, at_ns: int) -> Quaternion:
        """Return the vehicle's newest attitude, body forward, right, down to NED; level to the north if it is old."""
        motion = self._motion
        if motion is None or motion.attitude_rad is None or motion.attitude_ns is None:
            return _UNKNOWN_ATTITUDE
        if at_ns - motion.attitude_ns > MAX_ATTITUDE_AGE_NS:
            return _UNKNOWN_ATTITUDE
        return quaternion_from_euler(motion.attitude_rad) or _UNKNOWN_ATTITUDE

    def _make_diagnostics(self, decision: Decision, utc_ns: int) -> Iterator[tuple[str, Fields]]:
        """Yield the diagnostics once a second, and at each change of the mode."""
        scene = self._scene.scene()
        if scene is None or (utc_ns < self._diagnostics_ns and decision.mode is self._mode):
            return
        self._mode, self._diagnostics_ns = decision.mode, utc_ns + DIAGNOSTICS_PERIOD_NS
        status = {
            "level": _LEVELS[scene.level],
            "name": f"{self._namespace}: flight",
            "message": scene.headline,
            "hardware_id": self._namespace,
            "values": [{"key": key, "value": value} for key, value in self._list_values(scene, decision)],
        }
        yield DIAGNOSTICS, {"header": make_header(utc_ns, ""), "status": [status]}

    def _list_values(self, scene: LiveScene, decision: Decision) -> Iterator[tuple[str, str]]:
        yield "mode", decision.mode.value
        yield "reason", decision.reason
        if scene.age_s is not None:
            yield "age [s]", f"{scene.age_s:.3f}"
        if decision.age_steps is not None:
            yield "age [steps]", str(decision.age_steps)
        if scene.age_limit_s is not None:
            yield "age limit [s]", f"{scene.age_limit_s:.3f}"
        for figure in scene.figures:
            yield figure.name, figure.value
        if self.last_order:
            yield "last order", self.last_order

    def _make_limits(self, design: DesignView, utc_ns: int, plan: Plan | None = None) -> Fields:
        """Return the limits of the position, and those less the back-offs at the end of a plan."""
        box = design.state_box
        markers = [_make_box(utc_ns, 0, design, box.lower, box.upper, _WHITE)]
        if plan is not None:
            markers.append(_make_box(utc_ns, 1, design, *tighten_limits(design, plan.backoff_x, -1), _ORANGE))
        return {"markers": markers}


def make_path(design: DesignView, plan: Plan, utc_ns: int) -> Fields:
    """Return the predicted positions of a plan, each with its time."""
    level = _UNKNOWN_ATTITUDE
    poses = [
        {"header": make_header(utc_ns + stage * design.dt_ns), "pose": make_pose(at_m, level)}
        for stage, at_m in enumerate(design.positions_of(plan.states).tolist())
    ]
    return {"header": make_header(utc_ns), "poses": poses}


def make_header(utc_ns: int, frame: str = FRAME) -> Fields:
    """Return the header of a message."""
    return {"stamp": {"sec": utc_ns // SECOND_NS, "nanosec": utc_ns % SECOND_NS}, "frame_id": frame}


def make_point(at_m: Sequence[float]) -> Fields:
    """Return a position in local NED as a point of frame `map`."""
    east, north, up = ENU.from_ned((at_m[0], at_m[1], at_m[2]))
    return {"x": east, "y": north, "z": up}


def make_pose(at_m: Sequence[float], attitude: Quaternion) -> Fields:
    """Return a position [m] and an attitude in local NED as a pose in frame `map`."""
    w, x, y, z = ENU.attitude_from_ned(attitude, euler=True)
    return {"position": make_point(at_m), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _make_box(utc_ns: int, number: int, design: DesignView, lower: Array, upper: Array, colour: Fields) -> Fields:
    corners = list(product(*zip(*get_room_sides(design, lower, upper), strict=True)))
    return {
        "header": make_header(utc_ns),
        "ns": "limits",
        "id": number,
        "type": _LINE_LIST,
        "pose": {"orientation": {"w": 1.0}},
        "scale": {"x": _LINE_M},
        "color": colour,
        "points": [make_point(corners[corner]) for corner in np.ravel(BOX_EDGES).tolist()],
    }
