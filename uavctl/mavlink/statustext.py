"""Reassembly of STATUSTEXT: a vehicle sends a text of more than 50 characters in chunks."""

from __future__ import annotations

import msgspec

from uavctl.mavlink.messages import StatusText

CHUNK_WAIT_NS = 1_000_000_000  # for the next chunk; PX4 sends all chunks at once
MAX_PARTIAL_TEXTS = 16  # incomplete texts
MISSING_CHUNK = "…"  # replaces a missing chunk


class _PartialText(msgspec.Struct):
    """Incomplete text."""

    first: StatusText
    text: str
    next_chunk: int
    at_ns: int

    def finish(self) -> StatusText:
        """Return the received part of the text, with a mark for the missing one."""
        return _make_text(self.first, self.text + MISSING_CHUNK)


class StatusTextAssembler:
    """Joins the chunks of texts, by sender."""

    def __init__(self) -> None:
        self._partial_texts: dict[tuple[int, int], _PartialText] = {}

    def add_chunk(self, text: StatusText, at_ns: int) -> tuple[StatusText, ...]:
        """Add a chunk, or a whole text; return the texts that are complete now."""
        sender = text.system, text.component
        partial = self._partial_texts.get(sender)
        finished: tuple[StatusText, ...] = ()
        if partial is not None and (partial.first.text_id != text.text_id or text.chunk < partial.next_chunk):
            finished = (self._partial_texts.pop(sender).finish(),)
            partial = None
        if partial is None:
            partial = _PartialText(text, MISSING_CHUNK if text.chunk else "", text.chunk, at_ns)
        partial.text += ("" if text.chunk == partial.next_chunk else MISSING_CHUNK) + text.text
        partial.next_chunk = text.chunk + 1
        if not text.has_more:
            self._partial_texts.pop(sender, None)
            return (*finished, _make_text(partial.first, partial.text))
        if sender in self._partial_texts or len(self._partial_texts) < MAX_PARTIAL_TEXTS:
            self._partial_texts[sender] = partial
            return finished
        return (*finished, partial.finish())

    def flush_overdue(self, at_ns: int) -> tuple[StatusText, ...]:
        """Return the texts whose next chunk has not come in time."""
        overdue = [sender for sender, partial in self._partial_texts.items() if at_ns - partial.at_ns > CHUNK_WAIT_NS]
        return tuple(self._partial_texts.pop(sender).finish() for sender in overdue)


def _make_text(first: StatusText, text: str) -> StatusText:
    return StatusText(system=first.system, component=first.component, severity=first.severity, text=text.rstrip())
