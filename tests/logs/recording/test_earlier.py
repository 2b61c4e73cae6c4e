"""Fields that records of earlier versions lack; tests/e2e/test_older_recordings.py has whole recordings."""

from __future__ import annotations

import json

import pytest

from logs.recording.notes import NoteKind, RecorderNote
from logs.recording.topics import ENDED, RECORDER, decode
from uavctl.cause import Cause
from uavctl.event_codes import MISSION
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Ending, Event, Order


def decode_event(code: str, text: str) -> Event:
    fields = {"at_ns": 7, "severity": "info", "code": code, "text": text}
    record = decode("/uavctl/event", json.dumps(fields).encode(), 7)
    assert isinstance(record, Event) and (record.code, record.text) == (code, text)
    return record


@pytest.mark.parametrize(
    ("code", "text", "subject"),
    [
        ("hand-over", "arming -> climbing (GUIDED, armed)", HandoverState.CLIMBING),
        ("hand-over", "engaged -> released (LOITER, armed): the pilot", HandoverState.TAKEN_OVER),
        ("hand-over", "engaged -> waiting", HandoverState.WAITING),
        ("command-ack", "DO_SET_MODE: DENIED", "DO_SET_MODE"),
        ("order-accepted", "goto (1, 2, -1) m", Order.GOTO),
        ("order-accepted", "will take off", Order.TAKE_OFF),
        ("order-refused", "goto (9, 2, -1) m: outside", ""),
        ("fallback-brake", "the mission is over: landing", MISSION),
        ("hung-up", "link vehicle: the other side closed the connection; it is called again", "vehicle"),
        ("vehicle-text", "link lost", ""),
    ],
)
def test_an_event_has_its_subject(code: str, text: str, subject: str) -> None:
    assert decode_event(code, text).subject == subject


@pytest.mark.parametrize(
    ("text", "kind", "lacks"),
    [
        ("begin", NoteKind.BEGIN, (False, False)),
        ("end; 3 without views: slow", NoteKind.END, (False, False)),
        ("goes on in the next file", NoteKind.CONTINUED, (False, False)),
        ("goes on after flight.mcap", NoteKind.STATE, (False, False)),
        ("records lost", NoteKind.STATE, (False, False)),
        ("recovered from a.mcap: 3 messages lost", NoteKind.RECOVERED, (True, False)),
        ("recovered from a.mcap: 8 bytes lost, its end is missing", NoteKind.RECOVERED, (False, True)),
    ],
)
def test_a_note_has_its_kind(text: str, kind: NoteKind, lacks: tuple[bool, bool]) -> None:
    fields = {"at_ns": 7, "segment": 1, "written": 0, "dropped": 0, "refused": 0, "failures": 0, "text": text}
    note = decode(RECORDER, json.dumps(fields).encode(), 7)
    assert isinstance(note, RecorderNote)
    assert (note.kind, (note.lacks_records, note.lacks_end)) == (kind, lacks)


@pytest.mark.parametrize(
    ("phrase", "cause"),
    [
        ("landed by the fallback", Cause.FALLBACK_LANDED),
        ("the pilot has taken over", Cause.PILOT),
        ("the vehicle fell silent", Cause.VEHICLE_SILENT),  # worded otherwise today
        ("nothing was flown", Cause.NOT_FLOWN),
    ],
)
def test_an_ending_has_its_code(phrase: str, cause: Cause) -> None:
    fields = {"cause": phrase, "as_ordered": True, "sentence": "", "exit_code": 0}
    ending = decode(ENDED, json.dumps(fields).encode(), 7)
    assert isinstance(ending, Ending) and (ending.cause, ending.code) == (phrase, cause)
