"""The vehicle's parameters, as it tells them in PARAM_VALUE: out of raw MAVLink, and as a file of QGroundControl.

https://mavlink.io/en/services/parameter.html: ArduPilot casts an integer to a float, PX4 puts its bytes into one. A
heartbeat says which of the two it is.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.mavlink.framing import read_single_frame_id, scan_frames
from uavctl.mavlink.message_layout import MessageLayout, decode_text
from uavctl.records import Datagram, Record, ToldParameter

_HEARTBEAT, _PARAM_VALUE = mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_PARAM_VALUE
_LAYOUTS = {
    _HEARTBEAT: MessageLayout(mavlink.MAVLink_heartbeat_message),
    _PARAM_VALUE: MessageLayout(mavlink.MAVLink_param_value_message),
}
_PREFIX = "MAV_PARAM_TYPE_"
_TYPES = {
    number: entry.name.removeprefix(_PREFIX)
    for number, entry in mavlink.enums["MAV_PARAM_TYPE"].items()
    if not entry.name.endswith("ENUM_END")
}
_NUMBERS = {name: number for number, name in _TYPES.items()}
_INTEGERS = {"UINT8": "<B", "INT8": "<b", "UINT16": "<H", "INT16": "<h", "UINT32": "<I", "INT32": "<i"}
_HASH = "_HASH_CHECK"  # PX4's checksum over all of them, told as one; any setting changes it
_MAX_PARAMETERS = 20_000  # parameters kept: a vehicle has one or two thousand


class VehicleParameter(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter of the vehicle, by its newest PARAM_VALUE."""

    value: int | float
    type: str  # of MAV_PARAM_TYPE: REAL32, INT32 ...
    system: int
    component: int


class ParameterReader:
    """Reader of the parameters in the vehicle's datagrams."""

    def __init__(self) -> None:
        self._partial_frames: dict[str, bytes] = {}  # of a link: the frame that its last bytes ended in
        self._is_aligned: dict[str, bool] = {}  # whether the next byte of a link should begin a frame
        self._earlier_values: dict[str, VehicleParameter] = {}  # told before the recording began
        self._values: dict[tuple[int, int, str], tuple[float, int]] = {}
        self._counts: dict[tuple[int, int], int] = {}  # parameters that each says it has
        self._count_before: int | None = None
        self._autopilots: dict[int, int] = {}  # MAV_AUTOPILOT by system, in the order in which they were heard

    def take(self, record: Record) -> None:
        """Take raw bytes from the vehicle, or parameters of an earlier record; other records are ignored."""
        match record:
            case Datagram(outgoing=False):
                self._take_bytes(record)
            case ToldParameter():
                value = int(record.value) if record.type in _INTEGERS and math.isfinite(record.value) else record.value
                parameter = VehicleParameter(
                    value=value, type=record.type, system=record.system, component=record.component
                )
                self._earlier_values[record.name] = parameter
                self._count_before = record.count or self._count_before

    def _take_bytes(self, datagram: Datagram) -> None:
        partial, message_id = self._partial_frames.pop(datagram.link, b""), read_single_frame_id(datagram.data)
        if not partial and message_id is not None and message_id not in _LAYOUTS:
            return  # one frame that tells nothing of parameters, as most datagrams
        data = partial + datagram.data
        scan = scan_frames(data, final=False, is_aligned=self._is_aligned.get(datagram.link, True))
        if scan.consumed < len(data):
            self._partial_frames[datagram.link] = data[scan.consumed :]
        self._is_aligned[datagram.link] = scan.is_aligned
        for frame in scan.frames:
            self._read(frame.message_id, frame.data)

    def _read(self, message_id: int, frame: bytes) -> None:
        if message_id not in _LAYOUTS:
            return
        fields = _LAYOUTS[message_id].unpack(frame)
        if message_id == _HEARTBEAT:
            if fields.autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                self._autopilots.setdefault(fields.src_system, fields.autopilot)
            return
        key = fields.src_system, fields.src_component, decode_text(fields.param_id)
        if key[2] != _HASH and (len(self._values) < _MAX_PARAMETERS or key in self._values):
            self._values[key] = fields.param_value, fields.param_type
            self._counts[key[:2]] = fields.param_count

    @property
    def count(self) -> int | None:
        """Number of parameters that the autopilot says it has; None if it told none."""
        systems = [*self._autopilots, *(system for system, _ in self._counts)]
        count = self._counts.get((systems[0], mavlink.MAV_COMP_ID_AUTOPILOT1)) if systems else None
        return count or self._count_before

    def parameters(self) -> dict[str, VehicleParameter]:
        """Return the parameters by name, in order: of the first vehicle that was heard, or else told any."""
        systems = [*self._autopilots, *(system for system, _, _ in self._values)]
        received = {
            name: VehicleParameter(
                value=_read_value(value, kind, bytewise=self._autopilots.get(system) == mavlink.MAV_AUTOPILOT_PX4),
                type=_TYPES.get(kind, str(kind)),
                system=system,
                component=component,
            )
            # The autopilot comes last: what else has parameters aboard (a gimbal, a radio) does not hide its own.
            for (system, component, name), (value, kind) in sorted(self._values.items(), key=_is_autopilot)
            if system == systems[0]
        }
        return dict(sorted({**self._earlier_values, **received}.items()))


def count_parameters(parameters: Mapping[str, VehicleParameter]) -> int:
    """Return how many of the autopilot's list were told."""
    return sum(parameter.component == mavlink.MAV_COMP_ID_AUTOPILOT1 for parameter in parameters.values())


def make_parameter_records(
    parameters: Mapping[str, VehicleParameter], at_ns: int, count: int | None = None
) -> Iterator[ToldParameter]:
    """Return records of parameters, for a recording that begins after they were told.

    Args:
        count: how many the vehicle says it has.
    """
    for name, parameter in parameters.items():
        address = {"system": parameter.system, "component": parameter.component}
        yield ToldParameter(
            at_ns=at_ns, name=name, value=float(parameter.value), type=parameter.type, count=count or 0, **address
        )


def make_parameter_file(parameters: Mapping[str, VehicleParameter], count: int | None = None) -> str:
    """Return parameters as a file of QGroundControl: system, component, name, value and type, parted by tabs.

    Args:
        count: how many the vehicle says it has.
    """
    received_count = count_parameters(parameters)
    incomplete_text = "" if count is None or received_count >= count else ": INCOMPLETE"
    count_text = (
        "" if count is None else f"# {received_count} of the {count} that the vehicle says it has{incomplete_text}\n"
    )
    head = (
        f"# Vehicle parameters, as PARAM_VALUE told them\n{count_text}# "
        f"system\tcomponent\tname\tvalue\tMAV_PARAM_TYPE\n"
    )
    return head + "".join(
        f"{parameter.system}\t{parameter.component}\t{name}\t{parameter.value}\t"
        f"{_NUMBERS.get(parameter.type, parameter.type)}\n"
        for name, parameter in parameters.items()
    )


def _is_autopilot(item: tuple[tuple[int, int, str], object]) -> bool:
    return bool(item[0][1] == mavlink.MAV_COMP_ID_AUTOPILOT1)


def _read_value(value: float, kind: int, *, bytewise: bool) -> int | float:
    """Return the value of a parameter; of a single float the shortest digits that give it back."""
    form = _INTEGERS.get(_TYPES.get(kind, ""))
    if form is not None and bytewise:
        return int(struct.unpack_from(form, struct.pack("<f", value))[0])
    if form is not None and math.isfinite(value):
        return round(value)
    return float(str(np.float32(value)))
