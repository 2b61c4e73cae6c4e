"""Records of earlier versions: some of today's fields were part of a text, and are read from there."""

from __future__ import annotations

from msgspec.structs import replace

from logs.recording.notes import END_MISSING, MESSAGES_LOST, NoteKind, RecorderNote
from uavctl.cause import Cause, find_ending_code
from uavctl.event_codes import MISSION, EventCode
from uavctl.records import Ending, Event, Order, Record

_KINDS = {
    "begin": NoteKind.BEGIN,
    "goes on in the next file": NoteKind.CONTINUED,
    "recovered from ": NoteKind.RECOVERED,
    "end": NoteKind.END,
}
_ORDERS = {
    "will take off": Order.TAKE_OFF,
    "asks for the mode that takes setpoints": Order.ENGAGE,
    "leaves a vehicle alone that is found armed": Order.STAND_BY,
}
# Phrases of ends that read otherwise today.
_ENDS = {
    "the vehicle fell silent": Cause.VEHICLE_SILENT,
    "the vehicle has started anew": Cause.VEHICLE_RESTARTED,
    "a fence of the vehicle's own took over": Cause.VEHICLE_FENCE,
    "a failsafe of the vehicle's own took over": Cause.VEHICLE_FAILSAFE,
    "the mode was changed, and it is not known by whom": Cause.MODE_LEFT,
    "no positions came": Cause.POSITIONS_ABSENT,
    "let go by the envelope": Cause.ENVELOPE,
    "the vehicle disarmed before it had left the ground": Cause.NOT_RISEN,
    "nothing was flown": Cause.NOT_FLOWN,
    "the climb was broken off": Cause.CLIMB_ABORTED,
    "left alone, as the daemon before had left it in flight": Cause.LEFT_IN_FLIGHT,
    "landed by a failsafe of the vehicle's own": Cause.FAILSAFE_LANDED,
    "landed by a fence of the vehicle's own": Cause.FENCE_LANDED,
    "ended before the vehicle was down": Cause.ENDED_IN_AIR,
    "the vehicle's connection was closed by the other side": Cause.CONNECTION_CLOSED,
    "ended as its time was over": Cause.TIME_OVER,
}
_MISSION_OVER = "the mission is over: landing"
_OF_CONNECTION = "link "
_CONNECTION_CODES = frozenset(
    {
        EventCode.HUNG_UP,
        EventCode.CONNECTION_SILENT,
        EventCode.CLOCK_RESYNC,
        EventCode.STAMP_UNIT,
        EventCode.SLOW_ANSWER,
        EventCode.NO_HEARTBEAT,
        EventCode.SECOND_VEHICLE,
        EventCode.VEHICLE_REBOOT,
        EventCode.DROPPED,
        EventCode.INERTIAL_STALE,
    }
)


def complete_record(record: Record) -> Record:
    """Return a record with the fields that its version did not have."""
    if isinstance(record, Event) and not record.subject:
        return replace(record, subject=_find_subject(record))
    if isinstance(record, Ending) and not record.code:
        return replace(record, code=_ENDS.get(record.cause) or find_ending_code(record.cause))
    if isinstance(record, RecorderNote) and record.kind is NoteKind.STATE:
        kind = next((kind for text, kind in _KINDS.items() if record.text.startswith(text)), None)
        if kind is None:
            return record
        return replace(
            record,
            kind=kind,
            lacks_records=kind is NoteKind.RECOVERED and MESSAGES_LOST in record.text,
            lacks_end=kind is NoteKind.RECOVERED and END_MISSING in record.text,
        )
    return record


def _find_subject(event: Event) -> str:
    """Return the subject of an event by its text; empty if it has none."""
    text = event.text
    if event.code == EventCode.HAND_OVER:  # before -> after (mode, armed)
        return text.partition(" -> ")[2].partition(" (")[0].partition(":")[0]
    if event.code == EventCode.COMMAND_ACK:  # command: result
        return text.partition(":")[0]
    if event.code == EventCode.ORDER_ACCEPTED:  # order (place)
        return _ORDERS.get(text, text.partition(" (")[0])
    if text == _MISSION_OVER:
        return MISSION
    if event.code in _CONNECTION_CODES:  # link name: text
        return text.removeprefix(_OF_CONNECTION).partition(":")[0]
    return ""
