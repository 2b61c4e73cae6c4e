"""Recovery of a torn or damaged recording into a clean one."""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec

from logs.recording import attachments
from logs.recording.disk import DiskFile
from logs.recording.file_scan import AttachedFile, Damage, EndOfFile, RecordedMessage
from logs.recording.notes import END_MISSING, MESSAGES_LOST, NoteKind, RecorderNote
from logs.recording.parameters import ParameterReader
from logs.recording.reader import decode_note, scan_recording
from logs.recording.segment import QueuedMessage, Segment
from logs.recording.topics import HEADER, PARAMETER, RECORDER, decode, encode, get_definition, parse_raw_topic
from uavctl.errors import RecordingError
from uavctl.records import Header

CHUNK_BYTES = 16384


class RecoverResult(msgspec.Struct, frozen=True, kw_only=True):
    """Numbers of restored and lost messages."""

    messages: int  # restored
    messages_lost: int  # by their running numbers; those after the last restored one cannot be known
    lost_bytes: int  # damaged bytes that held messages, or may have
    chunks_bad: int  # damaged places, a torn end included
    finished: bool  # every file of the recording had been closed in order
    ended: bool  # the recorder's last word is there, so that nothing is missing after it
    damage: tuple[str, ...]  # in words: file, offset, reason; and if losses at the end cannot be counted

    @property
    def lossless(self) -> bool:
        """Whether everything that the files held is restored."""
        return self.messages_lost == 0 and self.lost_bytes == 0


class _Tally:
    """Counter of losses, fed message by message."""

    def __init__(self) -> None:
        self.messages = 0
        self.messages_lost = 0
        self.lost_bytes = 0
        self.damage: list[Damage] = []
        self.finished = True
        self.ended = False  # the newest message is the recorder's last word
        self._next: int | None = None
        self._doubtful_bytes = 0  # damaged since the last message

    def message(self, item: RecordedMessage) -> None:
        # A first message of another number than 1 means that those before it are gone.
        missing = item.sequence - (self._next or 1)
        if missing != 0:
            self.messages_lost += max(0, missing)
            self.lost_bytes += self._doubtful_bytes
        self._doubtful_bytes = 0  # without a gap nothing was in them: an index, or the file's head
        self._next = item.sequence + 1
        self.messages += not item.repeated
        note = decode_note(item)
        self.ended = note is not None and note.is_end

    def damaged(self, item: Damage) -> None:
        self.damage.append(item)
        self._doubtful_bytes += item.length

    def file_ended(self, item: EndOfFile) -> None:
        self.finished &= item.finished

    def end(self) -> None:
        if self.ended:
            self._doubtful_bytes = 0  # no message comes after the last word
        self.lost_bytes += self._doubtful_bytes
        self._doubtful_bytes = 0


def recover(src: Path, dst: Path) -> RecoverResult:
    """Write all whole chunks' messages of `src` (with its later segments) to the new file `dst`.

    Messages keep their bytes, times and order; they are numbered anew. If anything was lost, or the end of
    the recording is not there, the last message, from the recorder, says so.

    Raises:
        RecordingError: `src` is no recording or holds no whole chunk, `dst` exists, or it cannot be
            written (what was written of it is removed).
    """
    try:
        file = DiskFile(dst)
    except FileExistsError as error:
        raise RecordingError(f"{dst} exists and a recording is never overwritten; choose another name") from error
    except OSError as error:
        raise RecordingError(f"{dst}: {error.strerror}; choose another place") from error
    try:
        result = _copy(src, file)
        if result.messages == 0:
            raise RecordingError(f"{src}: no whole chunk in it; nothing can be restored")
    except BaseException as error:
        # Also after Ctrl-C: half of it would look like a shorter flight.
        with contextlib.suppress(OSError):
            dst.unlink()
        if isinstance(error, OSError):
            raise RecordingError(f"{dst}: {error.strerror}; make room or choose another place") from error
        raise
    return result


def _copy(src: Path, file: DiskFile) -> RecoverResult:
    tally, parameters = _Tally(), ParameterReader()
    segment: Segment | None = None
    has_header = False
    at_ns = zero_utc_ns = 0
    for item in scan_recording(src):
        if isinstance(item, Damage):
            tally.damaged(item)
        elif isinstance(item, EndOfFile):
            tally.file_ended(item)
        elif isinstance(item, AttachedFile):
            continue  # made anew from the messages
        else:
            tally.message(item)
            at_ns = item.at_ns
            if segment is None:
                zero_utc_ns = item.zero_utc_ns
                segment = Segment(file, CHUNK_BYTES, zero_utc_ns)
            if not item.repeated:
                segment.add(QueuedMessage(item.definition, tally.messages, item.at_ns, item.data))
                topic = item.definition.topic
                if topic in (HEADER, PARAMETER) or parse_raw_topic(topic) is not None:
                    record = decode(topic, item.data, item.at_ns)
                    parameters.take(record)
                    if isinstance(record, Header) and not has_header:
                        has_header = True
                        utc_ns = at_ns + zero_utc_ns
                        segment.attach(
                            (
                                *attachments.make_header_attachments(record, utc_ns),
                                *attachments.make_layout_attachment(utc_ns),
                            )
                        )
    segment = segment or Segment(file, CHUNK_BYTES)
    tally.end()
    damage = [str(item) for item in tally.damage]
    if not tally.ended:
        damage.append(f"{src}: the end is missing: messages after the last restored one cannot be counted")
    result = RecoverResult(
        messages=tally.messages,
        messages_lost=tally.messages_lost,
        lost_bytes=tally.lost_bytes,
        chunks_bad=len(tally.damage),
        finished=tally.finished,
        ended=tally.ended,
        damage=tuple(damage),
    )
    if not (result.lossless and result.ended):
        note = RecorderNote(
            at_ns=at_ns,
            segment=1,
            written=result.messages,
            dropped=0,
            refused=0,
            failures=0,
            text=f"recovered from {src.name}: {_losses(result)}",
            kind=NoteKind.RECOVERED,
            lacks_records=result.messages_lost > 0,
            lacks_end=not result.ended,
        )
        segment.add(QueuedMessage(get_definition(RECORDER), tally.messages + 1, at_ns, encode(note)))
    segment.attach(attachments.make_parameter_attachments(parameters, at_ns + zero_utc_ns))
    segment.finish()
    return result


def _losses(result: RecoverResult) -> str:
    parts = (
        (result.messages_lost > 0, f"{result.messages_lost} {MESSAGES_LOST}"),
        (result.lost_bytes > 0, f"{result.lost_bytes} bytes lost"),
        (not result.ended, END_MISSING),
    )
    return ", ".join(text for is_lost, text in parts if is_lost)
