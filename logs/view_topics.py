"""Topics that are made from the records for viewers: one row each. A replay and our own pages never read them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message

from logs.plot_records import (
    AgePlot,
    CounterPlot,
    InputPlot,
    LimitsPlot,
    LinkPlot,
    SetpointPlot,
    SolvePlot,
    StatePlot,
    TimingPlot,
    TruthPlot,
    VehiclePlot,
)
from logs.proto import message_class, schema_of
from uavctl.data import Record

FRAMES, VEHICLE_FRAME = "/view/frames", "/view/vehicle_frame"
ESTIMATE, MEASURED, TRUTH, TARGET = "/view/estimate", "/view/measured", "/view/truth", "/view/target"
PLAN, LOG = "/view/plan", "/view/log"
ROOM_SCENE, PLAN_SCENE = "/view/scene/room", "/view/scene/plan"
PATH_SCENE, LINK_SCENE = "/view/scene/path", "/view/scene/link"


@dataclass(frozen=True)
class View:
    """A topic of protobuf messages of one type: a well-known one, or that of a record."""

    name: str
    kind: type[Message] | type[Record]
    text: str

    @cached_property
    def message(self) -> type[Message]:
        """The message type."""
        return self.kind if issubclass(self.kind, Message) else message_class(self.kind)

    @property
    def schema_name(self) -> str:
        """Full name of the message type."""
        return str(self.message.DESCRIPTOR.full_name)

    @cached_property
    def schema(self) -> bytes:
        """Descriptors, as MCAP wants them."""
        return schema_of(self.message)


VIEWS: tuple[View, ...] = (
    View(FRAMES, FrameTransforms, "frame `ned` in `room`, whose axes are east, north, up; every 5 s"),
    View(VEHICLE_FRAME, FrameTransform, "frame `vehicle` in `ned`, from the estimate (no attitude)"),
    View(ESTIMATE, PoseInFrame, "estimated position"),
    View(MEASURED, PoseInFrame, "a position as measured; its stamp is the capture time"),
    View(TRUTH, PoseInFrame, "true position, in simulated flights"),
    View(TARGET, PoseInFrame, "where the mission wants the vehicle to be"),
    View(PLAN, PosesInFrame, "predicted positions of a plan"),
    View(LOG, Log, "events"),
    View(ROOM_SCENE, SceneUpdate, "limits of the position; every 5 s"),
    View(PLAN_SCENE, SceneUpdate, "predicted path, confidence ellipsoids, limits less the back-offs"),
    View(PATH_SCENE, SceneUpdate, "flown and measured path of the last 20 s; once a second"),
    View(LINK_SCENE, SceneUpdate, "state of the link, at the vehicle"),
    View("/plot/age", AgePlot, "age of information"),
    View("/plot/input", InputPlot, "chosen input and its limits"),
    View("/plot/setpoint", SetpointPlot, "acceleration sent"),
    View("/plot/state", StatePlot, "estimate by axis"),
    View("/plot/limits", LimitsPlot, "limits, and what a plan's back-offs leave of them"),
    View("/plot/solve", SolvePlot, "how a plan was found"),
    View("/plot/timing", TimingPlot, "run time of a tick"),
    View("/plot/link", LinkPlot, "belief about the link"),
    View("/plot/counters", CounterPlot, "counters of a connection"),
    View("/plot/truth", TruthPlot, "simulator's state, by axis"),
    View("/plot/vehicle", VehiclePlot, "mode and battery"),
)
PLOTS = {view.kind: view.name for view in VIEWS if issubclass(view.kind, Record)}
