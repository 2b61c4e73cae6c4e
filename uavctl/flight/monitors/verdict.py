"""Verdict of a monitor: an action, a cause, and a time. `uavctl.flight.supervise` turns verdicts into actions."""

from __future__ import annotations

from enum import Enum, StrEnum, auto

import msgspec


class Action(Enum):
    """Action that a monitor asks for."""

    NONE = auto()
    DISTRUST_POSITIONS = auto()  # drop the positions captured since `since_ns`
    DISTRUST_INERTIAL = auto()  # use no inertial data from `since_ns` on
    DISTRUST_VEHICLE_VELOCITY = auto()  # neither brake on the vehicle's own velocity nor compare with it
    BRAKE = auto()  # fly no plan until the cause is gone
    RELEASE = auto()  # never fly a plan again in this flight


class Cause(StrEnum):
    """Cause of a verdict; where an event reports it, the event's code."""

    OUTSIDE = "envelope-outside"  # the estimate is outside the room
    RESPONSE = "envelope-response"  # positions show an acceleration that nothing explains
    VELOCITY = "envelope-velocity"  # positions move otherwise than the vehicle says
    SCATTER = "envelope-scatter"  # positions scatter more than the vehicle can move
    BRAKING = "envelope-braking"  # braking has no effect
    FROZEN = "sample-frozen"  # a source repeats its value although the vehicle moves
    REPEATED = "sample-repeated"  # a source repeats its value, and it may be stuck
    JUMP = "sample-jump"  # a position that the vehicle cannot have come to
    SOURCE_MOVED = "positions-moved"  # such positions agree for so long that their source has moved
    ABSURD = "positions-absurd"  # all positions are further out than any can be
    PREDICTION = "prediction-inconsistent"  # the vehicle moves otherwise than was predicted
    INERTIAL = "inertial-doubted"  # inertial data contradict positions, the vehicle's velocity or the model
    CONTROLLER_LATE = "controller-late"  # a controller of another package takes too long
    CONTROLLER_WALL = "controller-wall"  # it flies too fast towards a limit


class Verdict(msgspec.Struct, frozen=True):
    """Verdict of a monitor."""

    action: Action = Action.NONE
    cause: Cause | None = None  # None without an action
    text: str = ""  # cause in words
    since_ns: int | None = None  # time from which on data are distrusted [ns]; None where nothing is

    @property
    def is_none(self) -> bool:
        """Whether nothing is asked for."""
        return self.action is Action.NONE


NO_VERDICT = Verdict()


def release(cause: Cause, text: str) -> Verdict:
    """Make the verdict that ends a flight on plans."""
    return Verdict(Action.RELEASE, cause, text)


def brake(cause: Cause, text: str) -> Verdict:
    """Make the verdict that brakes a flight on a plan."""
    return Verdict(Action.BRAKE, cause, text)
