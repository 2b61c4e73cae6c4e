"""Topics derived from records for viewers, as Protobuf messages."""

from __future__ import annotations

import math
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import msgspec
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from mcap_protobuf.schema import build_file_descriptor_set

from logs.recording.design_view import Box, DesignView
from uavctl.arrays import Array
from uavctl.records import Decision, Estimate, LinkStats, Plan, Record, Setpoint, Timing, Truth

PlotRecord = typing.TypeVar("PlotRecord", bound=Record)


class Axes(Record, frozen=True, kw_only=True):
    """One number for each axis of local NED; NaN for an axis that the plant does not have."""

    north: float = math.nan
    east: float = math.nan
    down: float = math.nan


class AgePlot(Record, frozen=True, kw_only=True):
    """Age of the newest position at a tick, and the control mode that followed."""

    age_s: float  # from its capture to this tick
    age_steps: float  # as the controller counts it
    limit_steps: float  # the age at which a plan is played out (H)
    plan_index: float  # of the input that is flown
    news: bool
    mode: str
    reason: str


class InputPlot(Record, frozen=True, kw_only=True):
    """Input that a tick chose, and the limits of plans (an estimated bias may go beyond); in the plant's units."""

    chosen: Axes
    lower: Axes
    upper: Axes


class SetpointPlot(Record, frozen=True, kw_only=True):
    """Acceleration setpoint that was sent [m/s²]."""

    accel_mps2: Axes
    limited: bool  # the setpoint limiter changed it
    source: str


class StatePlot(Record, frozen=True, kw_only=True):
    """State estimate."""

    position_m: Axes
    velocity_mps: Axes
    position_std_m: Axes


class LimitsPlot(Record, frozen=True, kw_only=True):
    """Limits of position and velocity, and the newest plan's tightened ones at its end; infinite where open."""

    position_lower_m: Axes
    position_upper_m: Axes
    tightened_lower_m: Axes  # with the back-offs of the plan's last stage
    tightened_upper_m: Axes
    velocity_lower_mps: Axes
    velocity_upper_mps: Axes


class SolvePlot(Record, frozen=True, kw_only=True):
    """Method and outcome of a solve; its computing time is in `/plot/timing`."""

    status: str
    method: str
    iterations: int
    gap: float
    cost: float
    slack: float
    offset: float
    terminal_miss: float


class TimingPlot(Record, frozen=True, kw_only=True):
    """Run time of a tick; the ticks that solve are the long ones."""

    lateness_us: float
    step_us: float  # in the controller
    send_us: float  # from the deadline to the socket
    capture_to_send_ms: float


class LinkPlot(Record, frozen=True, kw_only=True):
    """Estimate of the link that carries the positions, and its design value."""

    arrival_mean: float
    arrival_lower: float
    promised: float
    below_promise: bool
    bursts: bool
    burst_statistic: float


class CounterPlot(Record, frozen=True, kw_only=True):
    """Counters of one connection, and its clock."""

    link: str
    datagrams: int
    messages: int
    samples: int
    bad: int
    clock_offset_ms: float
    clock_rtt_ms: float
    clock_drift_ppm: float


class TruthPlot(Record, frozen=True, kw_only=True):
    """True state of the simulated vehicle."""

    position_m: Axes
    velocity_mps: Axes
    sent: int
    lost: int


class VehiclePlot(Record, frozen=True, kw_only=True):
    """Mode and state of the vehicle, as its telemetry says."""

    mode: str
    armed: bool
    external: bool
    battery_v: float


def make_axes(design: DesignView, values: Sequence[float] | Array) -> Axes:
    """Name numbers that are in the order of the plant's axes."""
    return Axes(**dict(zip(design.axes, map(float, values), strict=True)))


def select_values(values: Sequence[float] | Array, index: Sequence[int]) -> list[float]:
    """Return the values at some indices."""
    return [float(values[i]) for i in index]


def make_age_plot(design: DesignView, decision: Decision, captured_ns: int | None) -> AgePlot:
    """Return the age at a tick; `captured_ns` is the capture time of the newest position so far."""
    return copy_fields(
        AgePlot,
        decision,
        age_s=math.nan if captured_ns is None else (decision.at_ns - captured_ns) * 1e-9,
        age_steps=replace_missing(decision.age_steps),
        limit_steps=float(design.horizon),
        plan_index=replace_missing(decision.plan_index),
        mode=decision.mode.value,
    )


def make_input_plot(design: DesignView, decision: Decision) -> InputPlot:
    """Return the input that a tick chose."""
    lower, upper = _get_limits(design.input_box, design.axes, tuple(range(len(design.axes))))
    chosen = Axes() if decision.input is None else make_axes(design, decision.input)
    return InputPlot(chosen=chosen, lower=lower, upper=upper)


def make_setpoint_plot(setpoint: Setpoint) -> SetpointPlot:
    """Return the setpoint that was sent."""
    north, east, down = setpoint.accel_mps2
    accel = Axes(north=north, east=east, down=down)
    return SetpointPlot(accel_mps2=accel, limited=bool(setpoint.limited), source=setpoint.source.value)


def make_state_plot(design: DesignView, estimate: Estimate) -> StatePlot:
    """Return an estimate by axis."""
    std = [math.sqrt(max(0.0, estimate.cov[i][i])) for i in design.position_index]
    return StatePlot(
        position_m=make_axes(design, select_values(estimate.mean, design.position_index)),
        velocity_mps=make_axes(design, select_values(estimate.mean, design.velocity_index)),
        position_std_m=make_axes(design, std),
    )


def make_limits_plot(design: DesignView, plan: Plan) -> LimitsPlot:
    """Return the limits, and the tightened ones of a plan."""
    position_lower_m, position_upper_m = _get_limits(design.state_box, design.axes, design.position_index)
    velocity_lower_mps, velocity_upper_mps = _get_limits(design.state_box, design.axes, design.velocity_index)
    lower, upper = tighten_limits(design, plan.backoff_x, -1)
    return LimitsPlot(
        position_lower_m=position_lower_m,
        position_upper_m=position_upper_m,
        tightened_lower_m=make_axes(design, select_values(lower, design.position_index)),
        tightened_upper_m=make_axes(design, select_values(upper, design.position_index)),
        velocity_lower_mps=velocity_lower_mps,
        velocity_upper_mps=velocity_upper_mps,
    )


@lru_cache(maxsize=16)
def _get_limits(box: Box, axes: tuple[str, ...], index: tuple[int, ...]) -> tuple[Axes, Axes]:
    """Return a box's lower and upper sides at some indices, one for each axis; asked anew in every tick."""
    lower, upper = (Axes(**dict(zip(axes, select_values(side, index), strict=True))) for side in (box.lower, box.upper))
    return lower, upper


def tighten_limits(design: DesignView, backoff: Array, stage: int) -> tuple[Array, Array]:
    """Return the state limits less the back-offs of a stage: lower and upper (n_x,)."""
    lower, upper, kept = design.state_box.lower.copy(), design.state_box.upper.copy(), backoff[stage].tolist()
    for side, closed in zip((lower, upper), design.closed_sides, strict=True):
        for state, row, size in closed:
            side[state] -= kept[row] / size
    return lower, upper


def make_timing_plot(timing: Timing) -> TimingPlot:
    """Return the computing times of a tick."""
    return TimingPlot(
        lateness_us=timing.lateness_ns * 1e-3,
        step_us=timing.step_ns * 1e-3,
        send_us=timing.send_ns * 1e-3,
        capture_to_send_ms=replace_missing(timing.capture_to_send_ns) * 1e-6,
    )


def make_counter_plot(stats: LinkStats) -> CounterPlot:
    """Return the counters of a connection."""
    return copy_fields(
        CounterPlot,
        stats,
        bad=sum(stats.bad.values()),
        clock_offset_ms=replace_missing(stats.clock_offset_ns) * 1e-6,
        clock_rtt_ms=replace_missing(stats.clock_rtt_ns) * 1e-6,
        clock_drift_ppm=replace_missing(stats.clock_drift_ppm),
    )


def make_truth_plot(truth: Truth) -> TruthPlot:
    """Return the true state of the simulated vehicle."""
    position, velocity = (Axes(north=v[0], east=v[1], down=v[2]) for v in (truth.position_m, truth.velocity_mps))
    return copy_fields(TruthPlot, truth, position_m=position, velocity_mps=velocity)


def copy_fields(kind: type[PlotRecord], record: Record, **others: object) -> PlotRecord:
    """Return a record of `kind`: fields of the same name are copied from `record`, the others given."""
    return kind(**{name: getattr(record, name) for name in kind.__struct_fields__ if name not in others}, **others)


def replace_missing(value: float | None) -> float:
    """A number that may be missing; NaN if it is."""
    return math.nan if value is None else float(value)


_PACKAGE = "uavctl"
_SCALARS: Mapping[object, FieldDescriptorProto.Type.ValueType] = {
    float: FieldDescriptorProto.TYPE_DOUBLE,
    int: FieldDescriptorProto.TYPE_INT64,
    bool: FieldDescriptorProto.TYPE_BOOL,
    str: FieldDescriptorProto.TYPE_STRING,
}


@cache
def make_message_class(kind: type[Record]) -> type[Message]:
    """Make the message class `uavctl.<name of the record>` of a record type.

    Args:
        kind: its fields are floats, integers, booleans, texts, tuples of one of these, and records of such fields.

    Raises:
        TypeError: a field has another type; names it.
    """
    file = FileDescriptorProto(name=f"{_PACKAGE}/{kind.__name__}.proto", package=_PACKAGE, syntax="proto3")
    _describe(file.message_type.add(), kind, f".{_PACKAGE}")
    pool = DescriptorPool()  # its own: what other libraries register has no say in these names
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(f"{_PACKAGE}.{kind.__name__}"))


def pack_message(record: Record) -> bytes:
    """Pack a record as the message of its type.

    Raises:
        ValueError: an integer that does not fit 64 bits, or a text that is none.
        TypeError: a value that is not of its field's type.
    """
    return make_message_class(type(record))(**msgspec.to_builtins(record)).SerializeToString()


def describe_schema(kind: type[Message]) -> bytes:
    """Return the descriptors of a message type and of all types in it, as MCAP wants them."""
    return build_file_descriptor_set(kind).SerializeToString()


def _describe(message: DescriptorProto, kind: type[msgspec.Struct], scope: str) -> None:
    """Fill in the descriptor of a message type; types of its fields are nested in it, so no name is taken twice."""
    message.name = kind.__name__
    scope = f"{scope}.{message.name}"
    for number, field in enumerate(msgspec.structs.fields(kind), start=1):
        entry = message.field.add(name=field.name, number=number, label=FieldDescriptorProto.LABEL_OPTIONAL)
        part = field.type
        if typing.get_origin(part) is tuple:
            entry.label = FieldDescriptorProto.LABEL_REPEATED
            part = typing.get_args(part)[0]
        if part in _SCALARS:
            entry.type = _SCALARS[part]
        elif isinstance(part, type) and issubclass(part, msgspec.Struct):
            entry.type = FieldDescriptorProto.TYPE_MESSAGE
            entry.type_name = f"{scope}.{part.__name__}"
            if part.__name__ not in {nested.name for nested in message.nested_type}:
                _describe(message.nested_type.add(), part, scope)
        else:
            raise TypeError(f"{kind.__name__}.{field.name}: no protobuf field for {field.type}")


FRAMES, VEHICLE_FRAME = "/view/frames", "/view/vehicle_frame"
ESTIMATE, MEASURED, TRUTH, TARGET = "/view/estimate", "/view/measured", "/view/truth", "/view/target"
PLAN, LOG = "/view/plan", "/view/log"
ROOM_SCENE, PLAN_SCENE = "/view/scene/room", "/view/scene/plan"
PATH_SCENE, LINK_SCENE = "/view/scene/path", "/view/scene/link"


@dataclass(frozen=True)
class DerivedTopic:
    """A topic of Protobuf messages of one type: a well-known type, or that of a record."""

    name: str
    kind: type[Message] | type[Record]
    text: str

    @cached_property
    def message(self) -> type[Message]:
        """Return the class of the topic's messages."""
        return self.kind if issubclass(self.kind, Message) else make_message_class(self.kind)

    @property
    def schema_name(self) -> str:
        """Full name of the message type."""
        return str(self.message.DESCRIPTOR.full_name)

    @cached_property
    def schema(self) -> bytes:
        """Return the descriptors of the message type, as MCAP wants them."""
        return describe_schema(self.message)


VIEWS: tuple[DerivedTopic, ...] = (
    DerivedTopic(FRAMES, FrameTransforms, "frame `ned` in `room`, whose axes are east, north, up; every 5 s"),
    DerivedTopic(VEHICLE_FRAME, FrameTransform, "frame `vehicle` in `ned`, from the estimate (no attitude)"),
    DerivedTopic(ESTIMATE, PoseInFrame, "estimated position"),
    DerivedTopic(MEASURED, PoseInFrame, "a position as measured; its stamp is the capture time"),
    DerivedTopic(TRUTH, PoseInFrame, "true position, in simulated flights"),
    DerivedTopic(TARGET, PoseInFrame, "target of the mission"),
    DerivedTopic(PLAN, PosesInFrame, "predicted positions of a plan"),
    DerivedTopic(LOG, Log, "events"),
    DerivedTopic(ROOM_SCENE, SceneUpdate, "limits of the position; every 5 s"),
    DerivedTopic(PLAN_SCENE, SceneUpdate, "predicted path, confidence ellipsoids, limits less the back-offs"),
    DerivedTopic(PATH_SCENE, SceneUpdate, "flown and measured path of the last 20 s; once a second"),
    DerivedTopic(LINK_SCENE, SceneUpdate, "state of the link, at the vehicle"),
    DerivedTopic("/plot/age", AgePlot, "age of information"),
    DerivedTopic(
        "/plot/input", InputPlot, "chosen input and limits of plans, in units of the plant; a bias may exceed them"
    ),
    DerivedTopic("/plot/setpoint", SetpointPlot, "acceleration sent [m/s²]"),
    DerivedTopic("/plot/state", StatePlot, "estimate by axis"),
    DerivedTopic("/plot/limits", LimitsPlot, "limits, and those less the back-offs at the end of the plan"),
    DerivedTopic("/plot/solve", SolvePlot, "method and outcome of a plan"),
    DerivedTopic("/plot/timing", TimingPlot, "run time of a tick"),
    DerivedTopic("/plot/link", LinkPlot, "estimate of the link, and its design value"),
    DerivedTopic("/plot/counters", CounterPlot, "counters of a connection"),
    DerivedTopic("/plot/truth", TruthPlot, "simulator's state, by axis"),
    DerivedTopic("/plot/vehicle", VehiclePlot, "mode and battery"),
)
PLOTS = {view.kind: view.name for view in VIEWS if issubclass(view.kind, Record)}
