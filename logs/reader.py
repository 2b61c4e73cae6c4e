"""Reader of recordings: all segments as one, in file order, nothing without its checksum.

A file that was not finished is read to its last whole chunk; a damaged one is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

from logs.chunks import Damage, End, Message, Order, last_chunk, scan
from logs.disk import later_segments
from logs.encoding import decode
from logs.topics import END, GOES_ON, HEADER, LIBRARY, NO_END, RECORDER, RECOVERED, RecorderNote, record_type
from uavctl.data import Header, Record
from uavctl.errors import RecordingError

R = TypeVar("R", bound=Record)


def segment_files(path: Path) -> tuple[Path, ...]:
    """Files of a recording in order: the named one, and those that go on after a failed write.

    Raises:
        RecordingError: there is none, or the path is that of a folder.
    """
    if path.is_dir():
        held = set(path.glob("*.mcap"))
        inside = sorted(held.difference(*map(later_segments, held)))[:3]
        hint = f"; give the recording in it: {', '.join(map(str, inside))}" if inside else " and holds no recording"
        raise RecordingError(f"{path}: is a folder{hint}")
    files = tuple(one for one in later_segments(path) if _continues(one))
    if path.exists():
        files = (path, *files)
    if not files:
        raise RecordingError(f"{path}: no such recording")
    return files


def walk(path: Path, order: Order | None = None) -> Iterator[Message | Damage | End]:
    """Messages and damage of all segments; header and library that later segments repeat are marked.

    Args:
        path: the recording.
        order: see `logs.chunks.scan`.

    Raises:
        RecordingError: there is no such recording, a file of it is none, or it is not in order.
    """
    first: dict[str, bytes] = {}
    for file in segment_files(path):
        for item in scan(file, order):
            if isinstance(item, Message) and item.definition.topic in (HEADER, LIBRARY):
                yield item._replace(repeated=item.data == first.get(item.definition.topic))
                first.setdefault(item.definition.topic, item.data)
            else:
                yield item


def read(path: Path) -> Iterator[tuple[str, int, Record]]:
    """Topic, log time [ns] and record of each message, in file order; what was made for viewers is left out.

    Raises:
        RecordingError: no recording, or damaged; names file and offset. What came before is good.
    """
    for message in good_messages(path):
        topic = message.definition.topic
        yield topic, message.at_ns, decode(topic, message.data, message.at_ns)


def finished(path: Path) -> bool:
    """Whether every file of a recording was closed in order, and the last of them with the recorder's last word.

    Raises:
        RecordingError: there is no such recording.
    """
    return not lacks_end(path)


def lacks_end(path: Path) -> str:
    """Why a recording's end is not there, in words; nothing if it is.

    Only the recorder's last word says that it is: index and footer stand in a file that was full or could not be
    written on, and in one that was recovered, too.

    Raises:
        RecordingError: there is no such recording.
    """
    files = segment_files(path)
    ends = [last_chunk(file) for file in files]
    if None in ends:
        return "the recording is torn"
    note = _note(ends[-1])
    if note is not None and is_end(note):
        return ""
    text = "" if note is None else note.text
    if text.startswith(GOES_ON):
        return f"the recording goes on after {files[-1].name}, in a file that is missing"
    if text.startswith(RECOVERED):
        return f"the recording was {text}"
    return f"the recording has no end: nothing could be written after {files[-1].name}"


def is_end(note: RecorderNote) -> bool:
    """Whether the end of a recording is there if this is what was noted last."""
    return note.text.startswith(END) or (note.text.startswith(RECOVERED) and NO_END not in note.text)


def last_note(path: Path) -> RecorderNote | None:
    """What the recorder, or who restored the recording, said last; None where a file was not closed in order.

    Raises:
        RecordingError: there is no such recording.
    """
    return _note(last_chunk(segment_files(path)[-1]))


def _note(end: list[Message] | None) -> RecorderNote | None:
    """The last one of a file's last chunk."""
    for message in reversed(end or []):
        if message.definition.topic == RECORDER:
            note = decode(RECORDER, message.data, message.at_ns)
            assert isinstance(note, RecorderNote)  # the topic's type
            return note
    return None


def records(path: Path, kind: type[R]) -> Iterator[R]:
    """The records of one type, in file order.

    Raises:
        RecordingError: as `read`.
    """
    for message in good_messages(path):
        topic = message.definition.topic
        if _is(topic, kind):
            record = decode(topic, message.data, message.at_ns)
            assert isinstance(record, kind)  # the topic's type
            yield record


def header(path: Path) -> Header:
    """The recording's header.

    Raises:
        RecordingError: as `read`, or it has none.
    """
    for record in records(path, Header):
        return record
    raise RecordingError(f"{path}: no header: it was ended before its first chunk was written, or that chunk was lost")


def good_messages(path: Path) -> Iterator[Message]:
    """The messages themselves, also of topics that this version does not know; no repetitions, nothing for viewers.

    Raises:
        RecordingError: as `read`.
    """
    for item in walk(path, Order(path)):
        if isinstance(item, Message):
            if not item.repeated:
                yield item
        elif isinstance(item, Damage) and not item.torn:
            raise RecordingError(f"{item}; `uavctl log recover {path} OUT` restores the rest")


def _is(topic: str, kind: type[Record]) -> bool:
    try:
        return issubclass(record_type(topic), kind)
    except KeyError:
        return False


def _continues(path: Path) -> bool:
    """Whether a file goes on with another one (and is no recording of its own with such a name)."""
    for count, item in enumerate(scan(path)):
        if not isinstance(item, Message):
            return True  # empty or damaged: better told than passed over
        if item.definition.topic == RECORDER:
            note = decode(RECORDER, item.data, item.at_ns)
            return isinstance(note, RecorderNote) and note.segment > 1
        if count == 1:
            break
    return False
