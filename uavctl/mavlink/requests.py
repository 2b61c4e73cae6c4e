"""One request to the vehicle: its repetition, the vehicle's answer, and its end.

Pure: time is an argument.

1. Send the request, and wait `answer_ns` for its effect.
2. If the vehicle refuses it for now, repeat it after `retry_ns`.
3. Give up after a final refusal, after `tries` requests, or after `limit_ns`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.arrays import SECOND_NS
from uavctl.mavlink.messages import CommandAck, StatusText

SHOWN_NS = 3 * SECOND_NS  # heartbeats, at 1 Hz, show a grant by then
_FINAL = frozenset({mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_UNSUPPORTED})
_MAX_TEXTS = 4  # texts of the vehicle that are reported with a refusal


class RequestKind(StrEnum):
    """Request to the vehicle; the value is its text for people."""

    TAKE_OFF_MODE = "the mode to take off in"
    ARM = "arming"
    TAKE_OFF = "take-off"
    EXTERNAL_MODE = "the mode that takes setpoints"
    LAND = "landing"
    DISARM = "disarming"


COMMANDS = {
    RequestKind.TAKE_OFF_MODE: int(mavlink.MAV_CMD_DO_SET_MODE),
    RequestKind.ARM: int(mavlink.MAV_CMD_COMPONENT_ARM_DISARM),
    RequestKind.TAKE_OFF: int(mavlink.MAV_CMD_NAV_TAKEOFF),
    RequestKind.EXTERNAL_MODE: int(mavlink.MAV_CMD_DO_SET_MODE),
    RequestKind.LAND: int(mavlink.MAV_CMD_NAV_LAND),
    RequestKind.DISARM: int(mavlink.MAV_CMD_COMPONENT_ARM_DISARM),
}


class Failure(msgspec.Struct, frozen=True):
    """Failure in words."""

    text: str  # whole, for an event
    reason: str  # without what was asked for, for a sentence that names it


def make_failure(reason: str, subject: str = "") -> Failure:
    """Make a failure whose text is the subject, then the reason."""
    return Failure(f"{subject}{reason}", reason)


@dataclass(frozen=True)
class RequestLimits:
    """Time limits and number of attempts of a request."""

    answer_ns: int  # without an effect it is repeated after this time [ns]
    retry_ns: int  # refused for now, it is repeated after this time [ns]
    tries: int  # largest number of attempts
    limit_ns: int  # after this time it has failed [ns]


class PendingRequest:
    """Request from its first attempt to its effect or end.

    Args:
        kind: The request; None for a wait in which nothing is sent.
    """

    def __init__(self, kind: RequestKind | None, at_ns: int, limits: RequestLimits) -> None:
        self.kind = kind  # the request; None for a wait in which nothing is sent
        self._limits = limits
        self._start_ns = at_ns
        self._next_ns = at_ns
        self._tries = 0
        self._result: int | None = None
        self._texts: list[str] = []
        self._blocked_reason = ""
        self._is_retry_delayed = False  # a refusal has delayed the next attempt
        self.requested_ns: int | None = None  # last attempt
        self.granted_ns: int | None = None  # last acceptance

    def handle_message(self, message: CommandAck | StatusText, at_ns: int) -> None:
        """Handle an answer or a text of the vehicle."""
        if isinstance(message, StatusText):
            if message.severity <= mavlink.MAV_SEVERITY_WARNING and message.text not in self._texts:
                self._texts = [*self._texts, message.text][-_MAX_TEXTS:]
        elif self.kind is not None and self._tries and message.command == COMMANDS[self.kind]:
            is_repeated, self._result = self._result == message.result, message.result
            if message.result == mavlink.MAV_RESULT_ACCEPTED:
                self.granted_ns = at_ns
                self._next_ns = at_ns + SHOWN_NS
            elif message.result == mavlink.MAV_RESULT_IN_PROGRESS:
                self._next_ns = max(self._next_ns, at_ns + self._limits.retry_ns)
            elif not (is_repeated and self._is_retry_delayed):  # a repeated refusal does not extend the wait
                self._is_retry_delayed = True
                self._next_ns = at_ns + self._limits.retry_ns

    def due(self, at_ns: int, blocked_reason: str = "", *, is_mode_uncertain: bool = False) -> RequestKind | None:
        """Return the request to send now, if any; `blocked_reason` tells why not to send it yet.

        `is_mode_uncertain`: the vehicle's mode may have changed, so nothing is repeated now.
        """
        self._blocked_reason = blocked_reason
        if is_mode_uncertain and self._tries:
            return None
        if self.kind is None or blocked_reason or at_ns < self._next_ns or self._tries >= self._limits.tries:
            return None
        if self.kind is RequestKind.TAKE_OFF and self.granted_ns is not None:  # the climb would start again
            return None
        self._tries += 1
        self._is_retry_delayed, self.requested_ns = False, at_ns
        self._next_ns = at_ns + self._limits.answer_ns
        return self.kind

    def find_failure(self, at_ns: int) -> Failure | None:
        """Return the failure of the request; None while it may still succeed."""
        is_over_time = at_ns - self._start_ns >= self._limits.limit_ns
        out_of_tries = self.kind is not None and self._tries >= self._limits.tries and at_ns >= self._next_ns
        if not (is_over_time or out_of_tries or (self._result is not None and self._result in _FINAL)):
            return None
        return self.describe_failure(at_ns)

    def describe_failure(self, at_ns: int) -> Failure:
        """Return the failure of a request that will not succeed."""
        effort = self._describe_effort(at_ns)
        if self.kind is None:
            return Failure(
                f"it took too long{self.quoted_texts} ({effort})", f"not done in {effort}{self.quoted_texts}"
            )
        return make_failure(f"{self._describe_answer()}{self.quoted_texts} ({effort})", f"{self.kind.value}: ")

    def _describe_answer(self) -> str:
        if self._blocked_reason and self._result is None:
            return f"not requested, because {self._blocked_reason}"
        if self._result is None:
            return "the vehicle did not answer"
        name = mavlink.enums["MAV_RESULT"].get(self._result)
        result = str(self._result) if name is None else str(name.name).removeprefix("MAV_RESULT_")
        if self._result == mavlink.MAV_RESULT_ACCEPTED:
            return f"the vehicle answered {result}, but did not do it"
        return f"the vehicle answered {result}"

    @property
    def quoted_texts(self) -> str:
        """Texts of the vehicle since the request, quoted, for a reason."""
        return "".join(f', "{text}"' for text in self._texts)

    def _describe_effort(self, at_ns: int) -> str:
        seconds = f"{(at_ns - self._start_ns) / SECOND_NS:.1f} s"
        if self.kind is None:
            return seconds
        times = "once" if self._tries == 1 else f"{self._tries} times"
        return f"requested {times} in {seconds}" if self._tries else f"not sent in {seconds}"
