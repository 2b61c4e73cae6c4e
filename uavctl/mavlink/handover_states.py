"""The hand-over between pilot and controller, as a table of transitions.

Without an order the controller never asks for a mode but landing: it streams neutral setpoints so that the pilot may
switch, flies while the vehicle is armed in its external mode, and is out once somebody else has taken over. Ordered to,
it asks for the mode, arms, lets the vehicle climb and asks for the external mode: `uavctl.mavlink.handover` walks
the table. A vehicle that a daemon before has left in the air is not taken up again without an order.
"""

from __future__ import annotations

from enum import Enum, StrEnum


class HandoverState(StrEnum):
    """State of the hand-over."""

    WAITING = "waiting"  # no vehicle is heard
    READY = "ready"  # heard; neutral setpoints are streamed
    MODE = "asking for the mode"  # on the ground, ordered to take off
    ARMING = "arming"
    CLIMBING = "climbing"  # the vehicle climbs by itself
    ENGAGING = "engaging"  # at height: the external mode is requested
    RETURNING = "returning"  # the same from `released`, by an order
    ENGAGED = "engaged"  # armed and in the external mode: setpoints
    FAILSAFE = "failsafe"  # a failsafe of the vehicle flies it on an ordered flight: nothing is sent, in bounded time
    UNCLEAR = "unclear"  # another mode for an unknown reason: nothing is sent, in bounded time
    RELEASED = "released"  # another pilot has taken over: nothing is sent without an order
    LANDING = "landing"  # landing is requested: no setpoints any more
    SETTLING = "settling"  # the vehicle lands by itself
    DONE = "done"  # disarmed: nothing is sent any more
    FAILED = "failed"  # the vehicle has not carried out a request: nothing is sent any more


class HandoverEvent(StrEnum):
    """Event of a tick of the hand-over; of several, the first in this order counts."""

    REBOOT = "reboot"  # the vehicle has restarted
    LAND = "land"  # the controller or the operator requests landing
    UNSAFE = "unsafe"  # it climbs on impossible positions, without positions, or out of the room
    GRANTED = "granted"  # the request has taken effect
    REFUSED = "refused"  # the request will not take effect
    SILENCE = "silence"  # no heartbeat, or the last one is too old
    TAKE_OFF = "take-off"  # ordered, and allowed
    ENGAGE = "engage"  # ordered, and the vehicle is in the air
    LEFT = "left"  # armed at the start, and an earlier daemon has left it in flight
    DISARMED = "disarmed"
    FAILSAFE = "failsafe"  # armed, in the mode of a failsafe, on an ordered flight
    UNCLEAR = "unclear"  # another mode, for an unknown reason
    OTHER = "other"  # another mode: of a person, or of a failsafe on a flight of the pilot
    EXTERNAL = "external"  # armed, in the external mode
    PENDING = "pending"  # the request has not taken effect yet


class SetpointMode(Enum):
    """Setpoints that a tick may stream to the vehicle."""

    NOTHING = "nothing"
    NEUTRAL = "neutral"
    SETPOINTS = "setpoints"


Target = tuple[HandoverState, SetpointMode]
_W, _R, _M, _A, _C = (
    HandoverState.WAITING,
    HandoverState.READY,
    HandoverState.MODE,
    HandoverState.ARMING,
    HandoverState.CLIMBING,
)
_G, _B, _E, _X, _L = (
    HandoverState.ENGAGING,
    HandoverState.RETURNING,
    HandoverState.ENGAGED,
    HandoverState.RELEASED,
    HandoverState.LANDING,
)
_S, _D, _F, _V = HandoverState.SETTLING, HandoverState.DONE, HandoverState.FAILED, HandoverState.FAILSAFE
_U = HandoverState.UNCLEAR
_NOTHING, _NEUTRAL, _FLY = SetpointMode.NOTHING, SetpointMode.NEUTRAL, SetpointMode.SETPOINTS

# An event that is missing here keeps the state, and nothing is sent.
_CHANGES: dict[HandoverState, dict[HandoverEvent, Target]] = {
    _W: {
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.LEFT: (_X, _NOTHING),  # setpoints would end PX4's failsafe
        HandoverEvent.DISARMED: (_R, _NEUTRAL),
        HandoverEvent.OTHER: (_R, _NEUTRAL),
        HandoverEvent.EXTERNAL: (_E, _FLY),
    },
    _R: {
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.SILENCE: (_W, _NOTHING),
        HandoverEvent.TAKE_OFF: (_M, _NEUTRAL),
        HandoverEvent.ENGAGE: (_B, _NEUTRAL),
        HandoverEvent.DISARMED: (_R, _NEUTRAL),
        HandoverEvent.OTHER: (_R, _NEUTRAL),
        HandoverEvent.EXTERNAL: (_E, _FLY),
    },
    _M: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_D, _NOTHING),  # it stands on the ground, disarmed
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.FAILSAFE: (_X, _NOTHING),  # on the ground, disarmed
        HandoverEvent.UNCLEAR: (_U, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_A, _NEUTRAL),
        HandoverEvent.PENDING: (_M, _NEUTRAL),
    },
    _A: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),  # arming may have been granted and starts PX4's climb
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.UNCLEAR: (_U, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_C, _NEUTRAL),
        HandoverEvent.PENDING: (_A, _NEUTRAL),
    },
    _C: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),
        HandoverEvent.UNSAFE: (_L, _NOTHING),
        HandoverEvent.REFUSED: (_L, _NOTHING),
        HandoverEvent.DISARMED: (_F, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.UNCLEAR: (_U, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_G, _NEUTRAL),
        HandoverEvent.PENDING: (_C, _NEUTRAL),
    },
    _G: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),
        HandoverEvent.UNSAFE: (_L, _NOTHING),
        HandoverEvent.REFUSED: (_L, _NOTHING),
        HandoverEvent.DISARMED: (_F, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.UNCLEAR: (_U, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_E, _FLY),
        HandoverEvent.PENDING: (_G, _NEUTRAL),
    },
    _B: {
        HandoverEvent.REBOOT: (_X, _NOTHING),
        HandoverEvent.LAND: (_X, _NOTHING),  # the pilot still flies
        HandoverEvent.REFUSED: (_X, _NOTHING),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.UNCLEAR: (_U, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_E, _FLY),
        HandoverEvent.PENDING: (_B, _NEUTRAL),
    },
    _E: {
        HandoverEvent.REBOOT: (_X, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),
        HandoverEvent.SILENCE: (_E, _FLY),  # the controller brakes and holds: the vehicle may still receive setpoints
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.UNCLEAR: (_U, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.EXTERNAL: (_E, _FLY),
    },
    _V: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),
        HandoverEvent.GRANTED: (_C, _NEUTRAL),  # the failsafe has ended, and the climb continues
        HandoverEvent.REFUSED: (_L, _NOTHING),
        HandoverEvent.ENGAGE: (_G, _NEUTRAL),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.UNCLEAR: (_U, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
    },
    _U: {
        HandoverEvent.REBOOT: (_X, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),  # the operator's order
        HandoverEvent.REFUSED: (_L, _NOTHING),  # it flies by itself, and no pilot has shown control in time
        HandoverEvent.ENGAGE: (_B, _NEUTRAL),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
    },
    _X: {HandoverEvent.ENGAGE: (_B, _NEUTRAL), HandoverEvent.DISARMED: (_D, _NOTHING)},
    _L: {
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.UNCLEAR: (_X, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_S, _NOTHING),
    },
    _S: {
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.FAILSAFE: (_L, _NOTHING),  # the landing was the failsafe's and has ended: its climb continues
        HandoverEvent.UNCLEAR: (_X, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
    },
    _D: {},
    _F: {},
}
# States in which the end of the daemon leaves no vehicle in flight.
NOT_LEFT_IN_FLIGHT = frozenset({HandoverState.READY, HandoverState.SETTLING, HandoverState.DONE})
TRANSITIONS: dict[tuple[HandoverState, HandoverEvent], Target] = {
    (state, event): _CHANGES[state].get(event, (state, _NOTHING)) for state in HandoverState for event in HandoverEvent
}
