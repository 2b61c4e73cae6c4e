"""STATUSTEXT in one piece again: a vehicle says what is longer than 50 characters in several."""

from __future__ import annotations

import msgspec

from uavctl.mavlink.messages import Text

WAIT_NS = 1_000_000_000  # for the pieces that are to come; PX4 sends them at once
MOST = 16  # texts under way
LOST = "…"  # stands for a piece that did not come


class _Begun(msgspec.Struct):
    """A text of which more is to come."""

    first: Text
    said: str
    next_chunk: int
    at_ns: int

    def so_far(self) -> Text:
        """What has come of it."""
        return _plain(self.first, self.said + LOST)


class Joiner:
    """Joins the pieces of texts, by their sender."""

    def __init__(self) -> None:
        self._begun: dict[tuple[int, int], _Begun] = {}

    def take(self, text: Text, at_ns: int) -> tuple[Text, ...]:
        """Take a piece, or a whole text; the texts that are whole now."""
        sender = text.system, text.component
        begun = self._begun.get(sender)
        told: tuple[Text, ...] = ()
        if begun is not None and (begun.first.number != text.number or text.chunk < begun.next_chunk):
            told = (self._begun.pop(sender).so_far(),)
            begun = None
        if begun is None:
            begun = _Begun(text, LOST if text.chunk else "", text.chunk, at_ns)
        begun.said += ("" if text.chunk == begun.next_chunk else LOST) + text.text
        begun.next_chunk = text.chunk + 1
        if not text.more:
            self._begun.pop(sender, None)
            return (*told, _plain(begun.first, begun.said))
        if sender in self._begun or len(self._begun) < MOST:
            self._begun[sender] = begun
            return told
        return (*told, begun.so_far())

    def overdue(self, at_ns: int) -> tuple[Text, ...]:
        """The texts whose rest has not come."""
        late = [sender for sender, begun in self._begun.items() if at_ns - begun.at_ns > WAIT_NS]
        return tuple(self._begun.pop(sender).so_far() for sender in late)


def _plain(first: Text, text: str) -> Text:
    return Text(system=first.system, component=first.component, severity=first.severity, text=text.rstrip())
