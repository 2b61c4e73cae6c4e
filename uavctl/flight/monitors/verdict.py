"""Verdict of a monitor: an action, a cause, and a time. `uavctl.flight.supervise` turns verdicts into actions.

Verdicts on single samples (a frozen value, an outlier) act in `uavctl.flight.measure`: such samples are refused.
"""

from __future__ import annotations

from enum import Enum, auto

import msgspec

from uavctl.event_codes import EventCode


class Action(Enum):
    """Action that a monitor asks for."""

    NONE = auto()
    DISTRUST_POSITIONS = auto()  # refuse the present position; with `since_ns`, drop those captured since then, too
    DISTRUST_INERTIAL = auto()  # use no inertial data from `since_ns` on
    DISTRUST_VEHICLE_VELOCITY = auto()  # neither brake on the vehicle's own velocity nor compare with it
    BRAKE = auto()  # fly no plan until the cause is gone
    END_PLANS = auto()  # fly no plan again in this flight: the fallback ends it


class Verdict(msgspec.Struct, frozen=True):
    """Verdict of a monitor."""

    action: Action = Action.NONE
    cause: EventCode | None = None  # None without an action
    text: str = ""  # cause in words
    since_ns: int | None = None  # earlier data from this time on are distrusted, too [ns]; None for no earlier data

    @property
    def is_none(self) -> bool:
        """Whether nothing is asked for."""
        return self.action is Action.NONE


NO_VERDICT = Verdict()


def end_plans(cause: EventCode, text: str) -> Verdict:
    """Make the verdict that ends a flight on plans."""
    return Verdict(Action.END_PLANS, cause, text)


def brake(cause: EventCode, text: str) -> Verdict:
    """Make the verdict that brakes a flight on a plan."""
    return Verdict(Action.BRAKE, cause, text)
