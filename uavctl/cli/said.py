"""What a person at the console is told of a flight's events, and of what is being waited for."""

from __future__ import annotations

from uavctl.data import Event, Severity
from uavctl.mavlink.mode import State

AGAIN_NS = 30_000_000_000  # until the same is said again, if it goes on
MOST = 256  # different texts that are remembered
VEHICLE_TEXT = "vehicle-text"

_WAITS_FOR = {
    State.WAITING: "the vehicle's heartbeat",
    State.MODE: "the mode to take off in",
    State.ARMING: "arming",
    State.CLIMBING: "the end of the climb",
    State.ENGAGING: "the mode that takes setpoints",
    State.RETURNING: "the mode that takes setpoints",
    State.LANDING: "landing",
    State.SETTLING: "the ground",
}


def waits_for(state: State) -> str:
    """What the hand-over waits for; empty where it waits for nothing of the vehicle's."""
    return _WAITS_FOR.get(state, "")


class Said:
    """Says each different text once, at once, and again only after a while if it goes on."""

    def __init__(self) -> None:
        self._said_ns: dict[str, int] = {}

    def line(self, event: Event, state: State) -> str | None:
        """What to say of an event now, if anything.

        Args:
            event: what has happened.
            state: where the hand-over stands.
        """
        if event.code == VEHICLE_TEXT and event.severity is Severity.INFO:
            return None
        said_ns = self._said_ns.get(event.text)
        if said_ns is not None and event.at_ns - said_ns < AGAIN_NS:
            return None
        if said_ns is None and len(self._said_ns) >= MOST:
            del self._said_ns[min(self._said_ns, key=lambda text: self._said_ns[text])]
        self._said_ns[event.text] = event.at_ns
        waiting = waits_for(state)
        text = f'the vehicle says: "{event.text}"' if event.code == VEHICLE_TEXT else event.text
        return f"{text} (waiting for {waiting})" if waiting else text
