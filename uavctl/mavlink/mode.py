"""Flight modes by name, and the hand-over between pilot and controller as a table.

The controller never asks for a mode: it streams neutral setpoints so that the pilot may switch, flies
while the vehicle is armed in its external mode, and is out for good once the pilot has taken over.
"""

from __future__ import annotations

from enum import Enum, StrEnum

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.data import Event, Severity, VehicleStatus

HEARTBEAT_TIMEOUT_NS = 3_000_000_000

# PX4: custom_mode is reserved (16 bits), main mode (8), sub mode (8); src/modules/commander/px4_custom_mode.h
_PX4_MAIN = {
    1: "MANUAL",
    2: "ALTCTL",
    3: "POSCTL",
    4: "AUTO",
    5: "ACRO",
    6: "OFFBOARD",
    7: "STABILIZED",
    8: "RATTITUDE",
    9: "SIMPLE",
    10: "TERMINATION",
}
_PX4_AUTO = {
    1: "READY",
    2: "TAKEOFF",
    3: "LOITER",
    4: "MISSION",
    5: "RTL",
    6: "LAND",
    8: "FOLLOW_TARGET",
    9: "PRECLAND",
}
_COPTER_TYPES = frozenset(
    {
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_TYPE_COAXIAL,
        mavlink.MAV_TYPE_HELICOPTER,
        mavlink.MAV_TYPE_HEXAROTOR,
        mavlink.MAV_TYPE_OCTOROTOR,
        mavlink.MAV_TYPE_TRICOPTER,
        mavlink.MAV_TYPE_DODECAROTOR,
        mavlink.MAV_TYPE_DECAROTOR,
    }
)
# ArduCopter: enum COPTER_MODE
_COPTER = {
    int(getattr(mavlink, name)): name.removeprefix("COPTER_MODE_")
    for name in dir(mavlink)
    if name.startswith("COPTER_MODE_") and name != "COPTER_MODE_ENUM_END"
}


def autopilot_name(autopilot: int) -> str:
    """`px4`, `ardupilot` or `unknown` of MAV_AUTOPILOT."""
    names = {mavlink.MAV_AUTOPILOT_PX4: "px4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot"}
    return names.get(autopilot, "unknown")


def describe_mode(autopilot: str, vehicle_type: int, custom_mode: int) -> tuple[str, bool]:
    """A mode by the autopilot's own name, and whether it takes our setpoints.

    Numbers mean something else on every autopilot, and on ArduPilot on every kind of vehicle; what is
    not known here never counts as external.
    """
    if autopilot == "px4":
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
        name = _PX4_MAIN.get(main, f"MODE_{main}")
        return (f"AUTO.{_PX4_AUTO.get(sub, sub)}" if name == "AUTO" else name), name == "OFFBOARD"
    if autopilot == "ardupilot" and vehicle_type in _COPTER_TYPES:
        name = _COPTER.get(custom_mode, f"MODE_{custom_mode}")
        return name, name == "GUIDED"
    return f"MODE_{custom_mode}", False


class State(StrEnum):
    """Who flies."""

    WAITING = "waiting"  # no vehicle is heard
    READY = "ready"  # heard; neutral setpoints warm the stream up
    ENGAGED = "engaged"  # armed and in the external mode: setpoints
    RELEASED = "released"  # the pilot has taken over: nothing is sent, for good
    LANDING = "landing"  # landing was asked for: nothing is sent, for good


class Seen(StrEnum):
    """What a tick sees."""

    SILENCE = "silence"  # no heartbeat, or the last one is too old
    PILOT = "pilot"  # heard; disarmed or in another mode
    EXTERNAL = "external"  # heard, armed, in the external mode
    LAND = "land"  # whatever is heard: the controller asks for landing


class Sending(Enum):
    """What a tick may send to the vehicle."""

    NOTHING = "nothing"
    NEUTRAL = "neutral"
    SETPOINTS = "setpoints"
    LAND = "land"


# A landing is asked for only by who flies; before that there is nothing to hand over.
TRANSITIONS: dict[tuple[State, Seen], tuple[State, Sending]] = {
    (State.WAITING, Seen.SILENCE): (State.WAITING, Sending.NOTHING),
    (State.WAITING, Seen.PILOT): (State.READY, Sending.NEUTRAL),
    (State.WAITING, Seen.EXTERNAL): (State.ENGAGED, Sending.SETPOINTS),
    (State.WAITING, Seen.LAND): (State.WAITING, Sending.NOTHING),
    (State.READY, Seen.SILENCE): (State.WAITING, Sending.NOTHING),
    (State.READY, Seen.PILOT): (State.READY, Sending.NEUTRAL),
    (State.READY, Seen.EXTERNAL): (State.ENGAGED, Sending.SETPOINTS),
    (State.READY, Seen.LAND): (State.READY, Sending.NOTHING),
    (State.ENGAGED, Seen.SILENCE): (State.ENGAGED, Sending.NOTHING),
    (State.ENGAGED, Seen.PILOT): (State.RELEASED, Sending.NOTHING),
    (State.ENGAGED, Seen.EXTERNAL): (State.ENGAGED, Sending.SETPOINTS),
    (State.ENGAGED, Seen.LAND): (State.LANDING, Sending.LAND),
    **{(State.RELEASED, seen): (State.RELEASED, Sending.NOTHING) for seen in Seen},
    **{(State.LANDING, seen): (State.LANDING, Sending.NOTHING) for seen in Seen},
}


def look(at_ns: int, vehicle: VehicleStatus | None, *, land: bool) -> Seen:
    """What a tick at `at_ns` sees of the vehicle."""
    if land:
        return Seen.LAND
    if vehicle is None or at_ns - vehicle.at_ns > HEARTBEAT_TIMEOUT_NS:
        return Seen.SILENCE
    return Seen.EXTERNAL if vehicle.armed and vehicle.external else Seen.PILOT


class HandOver:
    """The table's state from tick to tick."""

    def __init__(self) -> None:
        self.state = State.WAITING
        self._silent = False

    def update(
        self, at_ns: int, vehicle: VehicleStatus | None, *, ready: bool, land: bool
    ) -> tuple[Sending, tuple[Event, ...]]:
        """Decide what one tick may send.

        Args:
            at_ns: time of the tick.
            vehicle: its latest status, or None.
            ready: whether the controller has a setpoint; without one no neutral stream invites the pilot.
            land: whether the controller asks for landing.

        Returns:
            What may be sent, and what there is to tell.
        """
        seen = look(at_ns, vehicle, land=land)
        before = self.state
        self.state, sending = TRANSITIONS[before, seen]
        if sending is Sending.NEUTRAL and not ready:
            sending = Sending.NOTHING
        return sending, self._tell(at_ns, before, seen, vehicle)

    def _tell(self, at_ns: int, before: State, seen: Seen, vehicle: VehicleStatus | None) -> tuple[Event, ...]:
        events = []
        silent = self.state is State.ENGAGED and seen is Seen.SILENCE
        if silent != self._silent:
            self._silent = silent
            word = "lost: no setpoints are sent" if silent else "is back"
            events.append(Event(at_ns=at_ns, severity=Severity.ERROR, code="heartbeat", text=f"heartbeat {word}"))
        if self.state is not before:
            mode = "" if vehicle is None else f" ({vehicle.mode}, {'armed' if vehicle.armed else 'disarmed'})"
            severity = Severity.WARNING if self.state in (State.RELEASED, State.LANDING) else Severity.INFO
            text = f"{before} -> {self.state}{mode}"
            events.append(Event(at_ns=at_ns, severity=severity, code="hand-over", text=text))
        return tuple(events)
