"""Reader of a recording: the files of one, in order, as messages, records, header and notes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TypeVar

from logs.recording.disk import find_later_segments
from logs.recording.file_scan import Damage, ReadingOrder, RecordedMessage, Scanned, read_last_chunk, scan_file
from logs.recording.notes import NoteKind, RecorderNote
from logs.recording.topics import HEADER, LIBRARY, RECORDER, decode, get_record_type, is_known
from uavctl.errors import RecordingError
from uavctl.records import Header, Record

R = TypeVar("R", bound=Record)


def find_segments(path: Path) -> tuple[Path, ...]:
    """Return the files of a recording in order: the named one, and those that go on after it.

    A file without any readable message is passed over. What it lacks is noticed by the numbers of the messages, or by
    the last note of the file before.

    Raises:
        RecordingError: there is none, or the path is that of a folder.
    """
    if path.is_dir():
        existing_files = set(path.glob("*.mcap"))
        inside = sorted(existing_files.difference(*map(find_later_segments, existing_files)))[:3]
        hint = f"; give the recording in it: {', '.join(map(str, inside))}" if inside else " and holds no recording"
        raise RecordingError(f"{path}: is a folder{hint}")
    files = [path] if path.exists() else []
    files += [file for file in find_later_segments(path) if _continues(file)]
    if not files:
        raise RecordingError(f"{path}: no such recording")
    return tuple(files)


def scan_recording(path: Path, order: ReadingOrder | None = None) -> Iterator[Scanned]:
    """Yield messages, attachments and damage of all segments; header and library that later segments repeat are marked.

    Args:
        order: see `logs.recording.file_scan.scan_file`.

    Raises:
        RecordingError: there is no such recording, a file of it is none, or it is not in order.
    """
    first: dict[str, bytes] = {}
    for file in find_segments(path):
        for item in scan_file(file, order):
            if isinstance(item, RecordedMessage) and item.definition.topic in (HEADER, LIBRARY):
                yield item._replace(repeated=item.data == first.get(item.definition.topic))
                first.setdefault(item.definition.topic, item.data)
            else:
                yield item


def read(path: Path) -> Iterator[tuple[str, int, Record]]:
    """Yield topic, log time [ns] and record of each message in file order, without messages for viewers.

    Raises:
        RecordingError: no recording, or damaged; names file and offset. What came before is good.
    """
    for message in read_messages(path):
        topic = message.definition.topic
        yield topic, message.at_ns, decode(topic, message.data, message.at_ns)


def explain_missing_end(path: Path) -> str:
    """Return why a recording's end is missing, in words; empty if it is there.

    Only the recorder's last word says that it is: index and footer stand in a file that was full or could not be
    written on, and in one that was recovered, too.

    Raises:
        RecordingError: there is no such recording.
    """
    files = find_segments(path)
    ends = [read_last_chunk(file) for file in files]
    if None in ends:
        return "the recording is torn"
    note = _find_last_note(ends[-1])
    if note is not None and note.is_end:
        return ""
    if note is not None and note.kind is NoteKind.CONTINUED:
        return f"the recording continues after {files[-1].name}, in a missing file"
    if note is not None and note.kind is NoteKind.RECOVERED:
        return f"the recording was {note.text}"
    return f"the recording has no end: nothing could be written after {files[-1].name}"


def read_last_note(path: Path) -> RecorderNote | None:
    """Return the last note of the recorder, or of a recovery; None where a file was not closed in order.

    Raises:
        RecordingError: there is no such recording.
    """
    return _find_last_note(read_last_chunk(find_segments(path)[-1]))


def _find_last_note(end: list[RecordedMessage] | None) -> RecorderNote | None:
    """Return the last note in a file's last chunk."""
    return next((note for message in reversed(end or []) if (note := decode_note(message)) is not None), None)


def decode_note(message: RecordedMessage) -> RecorderNote | None:
    """Return the recorder's note in a message; None in any other."""
    if message.definition.topic != RECORDER:
        return None
    note = decode(RECORDER, message.data, message.at_ns)
    assert isinstance(note, RecorderNote)  # the topic's type
    return note


def read_kind(path: Path, kind: type[R]) -> Iterator[R]:
    """Yield the records of one type in file order.

    Raises:
        RecordingError: as `read`.
    """
    for message in read_messages(path):
        topic = message.definition.topic
        if is_known(topic) and issubclass(get_record_type(topic), kind):
            record = decode(topic, message.data, message.at_ns)
            assert isinstance(record, kind)  # the topic's type
            yield record


def read_header(path: Path) -> Header:
    """Return the header of a recording.

    Raises:
        RecordingError: as `read`, or it has none.
    """
    for record in read_kind(path, Header):
        return record
    raise RecordingError(f"{path}: no header: it was ended before its first chunk was written, or that chunk was lost")


def read_messages(path: Path) -> Iterator[RecordedMessage]:
    """Yield the messages, also of topics unknown to this version, without repetitions and those for viewers.

    Raises:
        RecordingError: as `read`.
    """
    for item in scan_recording(path, ReadingOrder(path)):
        if isinstance(item, RecordedMessage):
            if not item.repeated:
                yield item
        elif isinstance(item, Damage) and not item.torn:
            raise RecordingError(f"{item}; `uavctl log recover {path} OUT` restores the rest")


def _continues(path: Path) -> bool:
    """Return whether a file has messages of a recording that began in an earlier file."""
    try:
        begin = list(islice(scan_file(path), 2))
        if all(isinstance(item, RecordedMessage) for item in begin):  # the header, repeated, and a note
            notes = [decode_note(item) for item in begin if isinstance(item, RecordedMessage)]
            return any(note is not None and note.segment > 1 for note in notes)
        return any(isinstance(item, RecordedMessage) for item in scan_file(path))
    except RecordingError:  # no recording
        return False
