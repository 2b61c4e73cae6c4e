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
    TAKEN_OVER = "released"  # another pilot has taken over: nothing is sent without an order
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

# An event that is missing here keeps the state, and nothing is sent.
_CHANGES: dict[HandoverState, dict[HandoverEvent, Target]] = {
    HandoverState.WAITING: {
        HandoverEvent.REFUSED: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.LEFT: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),  # setpoints would end PX4's failsafe
        HandoverEvent.DISARMED: (HandoverState.READY, SetpointMode.NEUTRAL),
        HandoverEvent.OTHER: (HandoverState.READY, SetpointMode.NEUTRAL),
        HandoverEvent.EXTERNAL: (HandoverState.ENGAGED, SetpointMode.SETPOINTS),
    },
    HandoverState.READY: {
        HandoverEvent.REFUSED: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.SILENCE: (HandoverState.WAITING, SetpointMode.NOTHING),
        HandoverEvent.TAKE_OFF: (HandoverState.MODE, SetpointMode.NEUTRAL),
        HandoverEvent.ENGAGE: (HandoverState.RETURNING, SetpointMode.NEUTRAL),
        HandoverEvent.DISARMED: (HandoverState.READY, SetpointMode.NEUTRAL),
        HandoverEvent.OTHER: (HandoverState.READY, SetpointMode.NEUTRAL),
        HandoverEvent.EXTERNAL: (HandoverState.ENGAGED, SetpointMode.SETPOINTS),
    },
    HandoverState.MODE: {
        HandoverEvent.REBOOT: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.LAND: (HandoverState.DONE, SetpointMode.NOTHING),  # it stands on the ground, disarmed
        HandoverEvent.REFUSED: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.FAILSAFE: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),  # on the ground, disarmed
        HandoverEvent.UNCLEAR: (HandoverState.UNCLEAR, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.GRANTED: (HandoverState.ARMING, SetpointMode.NEUTRAL),
        HandoverEvent.PENDING: (HandoverState.MODE, SetpointMode.NEUTRAL),
    },
    HandoverState.ARMING: {
        HandoverEvent.REBOOT: (HandoverState.FAILED, SetpointMode.NOTHING),
        # arming may have been granted and starts PX4's climb
        HandoverEvent.LAND: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.REFUSED: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.FAILSAFE: (HandoverState.FAILSAFE, SetpointMode.NOTHING),
        HandoverEvent.UNCLEAR: (HandoverState.UNCLEAR, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.GRANTED: (HandoverState.CLIMBING, SetpointMode.NEUTRAL),
        HandoverEvent.PENDING: (HandoverState.ARMING, SetpointMode.NEUTRAL),
    },
    HandoverState.CLIMBING: {
        HandoverEvent.REBOOT: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.LAND: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.UNSAFE: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.REFUSED: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.DISARMED: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.FAILSAFE: (HandoverState.FAILSAFE, SetpointMode.NOTHING),
        HandoverEvent.UNCLEAR: (HandoverState.UNCLEAR, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.GRANTED: (HandoverState.ENGAGING, SetpointMode.NEUTRAL),
        HandoverEvent.PENDING: (HandoverState.CLIMBING, SetpointMode.NEUTRAL),
    },
    HandoverState.ENGAGING: {
        HandoverEvent.REBOOT: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.LAND: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.UNSAFE: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.REFUSED: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.DISARMED: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.FAILSAFE: (HandoverState.FAILSAFE, SetpointMode.NOTHING),
        HandoverEvent.UNCLEAR: (HandoverState.UNCLEAR, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.GRANTED: (HandoverState.ENGAGED, SetpointMode.SETPOINTS),
        HandoverEvent.PENDING: (HandoverState.ENGAGING, SetpointMode.NEUTRAL),
    },
    HandoverState.RETURNING: {
        HandoverEvent.REBOOT: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.LAND: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),  # the pilot still flies
        HandoverEvent.REFUSED: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.DISARMED: (HandoverState.DONE, SetpointMode.NOTHING),
        HandoverEvent.FAILSAFE: (HandoverState.FAILSAFE, SetpointMode.NOTHING),
        HandoverEvent.UNCLEAR: (HandoverState.UNCLEAR, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.GRANTED: (HandoverState.ENGAGED, SetpointMode.SETPOINTS),
        HandoverEvent.PENDING: (HandoverState.RETURNING, SetpointMode.NEUTRAL),
    },
    HandoverState.ENGAGED: {
        HandoverEvent.REBOOT: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.LAND: (HandoverState.LANDING, SetpointMode.NOTHING),
        # the controller brakes and holds: the vehicle may still receive setpoints
        HandoverEvent.SILENCE: (HandoverState.ENGAGED, SetpointMode.SETPOINTS),
        HandoverEvent.DISARMED: (HandoverState.DONE, SetpointMode.NOTHING),
        HandoverEvent.FAILSAFE: (HandoverState.FAILSAFE, SetpointMode.NOTHING),
        HandoverEvent.UNCLEAR: (HandoverState.UNCLEAR, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.EXTERNAL: (HandoverState.ENGAGED, SetpointMode.SETPOINTS),
    },
    HandoverState.FAILSAFE: {
        HandoverEvent.REBOOT: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.LAND: (HandoverState.LANDING, SetpointMode.NOTHING),
        # the failsafe has ended, and the climb continues
        HandoverEvent.GRANTED: (HandoverState.CLIMBING, SetpointMode.NEUTRAL),
        HandoverEvent.REFUSED: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.ENGAGE: (HandoverState.ENGAGING, SetpointMode.NEUTRAL),
        HandoverEvent.DISARMED: (HandoverState.DONE, SetpointMode.NOTHING),
        HandoverEvent.UNCLEAR: (HandoverState.UNCLEAR, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
    },
    HandoverState.UNCLEAR: {
        HandoverEvent.REBOOT: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.LAND: (HandoverState.LANDING, SetpointMode.NOTHING),  # the operator's order
        # it flies by itself, and no pilot has shown control in time
        HandoverEvent.REFUSED: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.ENGAGE: (HandoverState.RETURNING, SetpointMode.NEUTRAL),
        HandoverEvent.DISARMED: (HandoverState.DONE, SetpointMode.NOTHING),
        HandoverEvent.FAILSAFE: (HandoverState.FAILSAFE, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
    },
    HandoverState.TAKEN_OVER: {
        HandoverEvent.ENGAGE: (HandoverState.RETURNING, SetpointMode.NEUTRAL),
        HandoverEvent.DISARMED: (HandoverState.DONE, SetpointMode.NOTHING),
    },
    HandoverState.LANDING: {
        HandoverEvent.REFUSED: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.DISARMED: (HandoverState.DONE, SetpointMode.NOTHING),
        HandoverEvent.UNCLEAR: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.GRANTED: (HandoverState.SETTLING, SetpointMode.NOTHING),
    },
    HandoverState.SETTLING: {
        HandoverEvent.REFUSED: (HandoverState.FAILED, SetpointMode.NOTHING),
        HandoverEvent.DISARMED: (HandoverState.DONE, SetpointMode.NOTHING),
        # the landing was the failsafe's and has ended: its climb continues
        HandoverEvent.FAILSAFE: (HandoverState.LANDING, SetpointMode.NOTHING),
        HandoverEvent.UNCLEAR: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
        HandoverEvent.OTHER: (HandoverState.TAKEN_OVER, SetpointMode.NOTHING),
    },
    HandoverState.DONE: {},
    HandoverState.FAILED: {},
}
# States in which the end of the daemon leaves no vehicle in flight.
NOT_LEFT_IN_FLIGHT = frozenset({HandoverState.READY, HandoverState.SETTLING, HandoverState.DONE})
TRANSITIONS: dict[tuple[HandoverState, HandoverEvent], Target] = {
    (state, event): _CHANGES[state].get(event, (state, SetpointMode.NOTHING))
    for state in HandoverState
    for event in HandoverEvent
}
