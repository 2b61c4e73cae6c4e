"""Notes of the recorder in a recording: the begin and the end of each file, lost records, a full disk."""

from __future__ import annotations

from enum import StrEnum

from uavctl.records import Record

MESSAGES_LOST, END_MISSING = "messages lost", "its end is missing"  # in the text of a recovery's note


class NoteKind(StrEnum):
    """Kind of a note.

    A recording whose last note is of no other kind than END, CONTINUED or RECOVERED has no end: the process was
    killed, the power failed, the disk took no more, or the file was cut.
    """

    BEGIN = "begin"
    STATE = "state"  # records were lost, or the disk is nearly full
    END = "end"  # the recording has all records but those that were counted as dropped or refused
    CONTINUED = "continued"  # the file was full: the next file continues it
    RECOVERED = "recovered"  # by a recovery, from a recording with lost messages or without an end


class RecorderNote(Record, frozen=True, kw_only=True):
    """State of the recorder: at the start of a file, after lost records, and at the end."""

    at_ns: int
    segment: int  # 1 is the first file
    written: int  # records in the files so far
    dropped: int  # records so far that found the queue full
    refused: int  # records so far that could not be encoded
    failures: int  # failed writes so far
    text: str
    kind: NoteKind = NoteKind.STATE
    lacks_records: bool = False  # recovered: messages before the last one are missing
    lacks_end: bool = False  # recovered: messages after the last one may be missing

    @property
    def is_end(self) -> bool:
        """Whether this is the last note of a whole recording."""
        return self.kind is NoteKind.END or (self.kind is NoteKind.RECOVERED and not self.lacks_end)
