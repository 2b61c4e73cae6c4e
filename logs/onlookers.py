"""What a recording carries for those who look on: messages for viewers beside each record, and a live view's share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from logs.topics import Definition, definition
from uavctl.data import Record
from uavctl.errors import RecordingError

Watcher = Callable[[Definition, int, bytes], None]


class ViewMaker(Protocol):
    """Makes messages for viewers; `logs.views.Views` is one."""

    def made(self, at_ns: int, record: Record) -> list[tuple[str, bytes]]:
        """Topic and message of all that a record gives rise to."""
        ...


class Onlookers:
    """Makes what is written beside a record, and shows both.

    Args:
        views: makes the messages for viewers; None: there are none.
        watch: is given definition, log time [ns] and bytes of each message, soon after its record was taken;
            returns at once and raises nothing.

    Attributes:
        unseen: records of which no messages could be made; they are in the recording.
        reason: of the newest one.
    """

    def __init__(self, views: ViewMaker | None = None, watch: Watcher | None = None) -> None:
        self._views, self._watch = views, watch
        self.unseen = 0
        self.reason = ""

    def beside(self, topic: str, at_ns: int, record: Record, data: bytes) -> list[tuple[str, int, bytes]]:
        """Topic, log time [ns] and message of all that goes beside a record, whose own message is `data`."""
        made = [(name, at_ns, view) for name, view in self._made(at_ns, record)]
        if self._watch is not None:
            for name, time_ns, message in ((topic, at_ns, data), *made):
                self._watch(definition(name), time_ns, message)
        return made

    def _made(self, at_ns: int, record: Record) -> list[tuple[str, bytes]]:
        if self._views is None:
            return []
        try:
            return self._views.made(at_ns, record)
        except (RecordingError, ValueError, TypeError, LookupError, ArithmeticError) as error:
            self.unseen += 1
            self.reason = f"{type(record).__name__}: {error}"
            return []
