"""The hand-over between pilot and controller, as a table of transitions.

Without an order the controller never asks for a mode but landing: it streams neutral setpoints so that the pilot may
switch, flies while the vehicle is armed in its external mode, and is out once the pilot has taken over. Ordered to,
it asks for the mode, arms, lets the vehicle climb and asks for the external mode: `uavctl.mavlink.handover` walks
the table. A vehicle that a daemon before has left in the air is not taken up again without an order.
"""

from __future__ import annotations

from enum import Enum, StrEnum

from uavctl.mavlink.autopilots import HABITS


class HandoverState(StrEnum):
    """Who flies, or what is under way."""

    WAITING = "waiting"  # no vehicle is heard
    READY = "ready"  # heard; neutral setpoints warm the stream up
    MODE = "asking for the mode"  # on the ground, ordered to take off
    ARMING = "arming"
    CLIMBING = "climbing"  # the vehicle climbs by itself
    ENGAGING = "engaging"  # at height: the external mode is asked for
    RETURNING = "returning"  # the same from `released`, ordered to
    ENGAGED = "engaged"  # armed and in the external mode: setpoints
    FAILSAFE = "failsafe"  # what we took off is flown by a failsafe of its own: nothing is sent; in bounded time
    RELEASED = "released"  # the pilot has taken over: nothing is sent unless ordered to
    LANDING = "landing"  # landing was asked for: no setpoints any more, for good
    SETTLING = "settling"  # the vehicle lands by itself
    DONE = "done"  # disarmed after all: nothing is sent, for good
    FAILED = "failed"  # the vehicle does not do what was asked: nothing is sent, for good


class HandoverEvent(StrEnum):
    """What a tick sees; of several things the first in this order."""

    REBOOT = "reboot"  # the vehicle has started anew
    LAND = "land"  # the controller, or the operator, asks for landing
    GRANTED = "granted"  # what was asked for is there
    REFUSED = "refused"  # what was asked for will not come
    SILENCE = "silence"  # no heartbeat, or the last one is too old
    TAKE_OFF = "take-off"  # ordered, and nothing speaks against it
    ENGAGE = "engage"  # ordered, and the vehicle is in the air
    LEFT = "left"  # found armed, and a daemon before this one ended while it had it
    DISARMED = "disarmed"
    FAILSAFE = "failsafe"  # armed, in a mode that a failsafe of its own has chosen, on a flight that we began
    OTHER = "other"  # armed, in a mode that is none of ours: the pilot's, or on the pilot's flight a failsafe's
    EXTERNAL = "external"  # armed, in the external mode
    PENDING = "pending"  # what was asked for is not there yet


class Sending(Enum):
    """What a tick may stream to the vehicle."""

    NOTHING = "nothing"
    NEUTRAL = "neutral"
    SETPOINTS = "setpoints"


Target = tuple[HandoverState, Sending]
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
_NOTHING, _NEUTRAL, _FLY = Sending.NOTHING, Sending.NEUTRAL, Sending.SETPOINTS

# What is not here changes nothing, and nothing is sent.
_CHANGES: dict[HandoverState, dict[HandoverEvent, Target]] = {
    _W: {
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.LEFT: (_X, _NOTHING),  # setpoints would end PX4's failsafe, and so take over
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
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_A, _NEUTRAL),
        HandoverEvent.PENDING: (_M, _NEUTRAL),
    },
    _A: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),  # arming may have been granted, and starts PX4's climb
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_C, _NEUTRAL),
        HandoverEvent.PENDING: (_A, _NEUTRAL),
    },
    _C: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),
        HandoverEvent.REFUSED: (_L, _NOTHING),
        HandoverEvent.DISARMED: (_F, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_G, _NEUTRAL),
        HandoverEvent.PENDING: (_C, _NEUTRAL),
    },
    _G: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),
        HandoverEvent.REFUSED: (_L, _NOTHING),
        HandoverEvent.DISARMED: (_F, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_E, _FLY),
        HandoverEvent.PENDING: (_G, _NEUTRAL),
    },
    _B: {
        HandoverEvent.REBOOT: (_X, _NOTHING),
        HandoverEvent.LAND: (_X, _NOTHING),  # the pilot flies still
        HandoverEvent.REFUSED: (_X, _NOTHING),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_E, _FLY),
        HandoverEvent.PENDING: (_B, _NEUTRAL),
    },
    _E: {
        HandoverEvent.REBOOT: (_X, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),
        HandoverEvent.SILENCE: (
            _E,
            _FLY,
        ),  # the controller brakes and holds, for a while: the vehicle may hear us still
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.FAILSAFE: (_V, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.EXTERNAL: (_E, _FLY),
    },
    _V: {
        HandoverEvent.REBOOT: (_F, _NOTHING),
        HandoverEvent.LAND: (_L, _NOTHING),
        HandoverEvent.GRANTED: (_C, _NEUTRAL),  # it has ended by itself, and the climb goes on
        HandoverEvent.REFUSED: (_L, _NOTHING),
        HandoverEvent.ENGAGE: (_G, _NEUTRAL),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
    },
    _X: {HandoverEvent.ENGAGE: (_B, _NEUTRAL), HandoverEvent.DISARMED: (_D, _NOTHING)},
    _L: {
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.OTHER: (_X, _NOTHING),
        HandoverEvent.GRANTED: (_S, _NOTHING),
    },
    _S: {
        HandoverEvent.REFUSED: (_F, _NOTHING),
        HandoverEvent.DISARMED: (_D, _NOTHING),
        HandoverEvent.FAILSAFE: (_L, _NOTHING),  # it only seemed to land for us: its climb goes on
        HandoverEvent.OTHER: (_X, _NOTHING),
    },
    _D: {},
    _F: {},
}
# Where a daemon that ends leaves no vehicle behind that has flown on its setpoints, or may still.
LEAVES_NONE = frozenset({HandoverState.READY, HandoverState.SETTLING, HandoverState.DONE})
TRANSITIONS: dict[tuple[HandoverState, HandoverEvent], Target] = {
    (state, seen): _CHANGES[state].get(seen, (state, _NOTHING)) for state in HandoverState for seen in HandoverEvent
}


def page() -> str:
    """The page of the documentation that shows the table."""
    return f"""# Who flies: the hand-over

Written from the table in `uavctl/mavlink/handover_states.py` (`make docs`).
A word on an arrow is what a tick sees; of several
things the first in this list counts:
{", ".join(f"`{seen}`" for seen in HandoverEvent)}.
What is not drawn changes nothing. Setpoints are sent in `ENGAGED` only; neutral ones (zero acceleration) where PX4
wants a stream before it gives OFFBOARD: in `READY`, on the way up (not to ArduPilot, whose climb they would end), and
in `RETURNING`.

```mermaid
{drawing()}```

* `take-off` is `--arm --takeoff HEIGHT`; `engage` is `uavctl ctl engage`. Nothing else leads towards arming or back
  from the pilot. `land` comes from the controller, or from the operator on the way up.
* `left`: the daemon before this one ended while it had the vehicle, and nobody had asked it to (it was killed, or
  failed); and the vehicle, which has not started anew since, is armed when it is heard first. Nothing is sent, as
  setpoints would end PX4's failsafe; `uavctl ctl engage` takes it up again. Whoever ends so leaves word in the file
  of its lock ([operation.md](operation.md#how-it-ends)).
* `refused`: the vehicle said no for good, or did not do it within the tries and times of `[hand_over]`
  (configuration.md). Its own reason (COMMAND_ACK, STATUSTEXT) is in the event `refused`, and ends the program with 1.
* `failsafe`: the vehicle itself says that a failsafe acts (system status CRITICAL, or "failsafe" in a text), and is in
  a mode that failsafes choose ({_listed()}).
  Any other mode is the pilot's, and so are these without such a word. On a flight that began with `--arm` it is waited
  for: PX4 takes its climb up again by itself, and so does the hand-over, all within `climb_s`. A failsafe that lands
  has `land_s`; one that hovers, or that has ended an engaged flight, is ended by our landing after `climb_s`, unless
  `ctl engage` comes first. A flight that the pilot began is released.
* PX4: AUTO.TAKEOFF, arming, OFFBOARD as soon as the positions show the height, not when its own climb ends
  (MIS_TAKEOFF_ALT). ArduPilot: GUIDED, arming, MAV_CMD_NAV_TAKEOFF, setpoints at nine tenths of the height.
* What was granted by COMMAND_ACK counts before the next heartbeat shows it (they come once a second); a heartbeat that
  still says otherwise 0.3 s later is the pilot's word.
* A request of the external mode, or of landing, is made again right after a heartbeat only: in between the pilot may
  have switched, which the next one shows. Landing is asked for without heartbeats, too. The first request of the
  external mode, at the end of a climb, waits for none: a pilot who switches in that second has to switch again.
* While the heartbeats of an engaged vehicle are missing, the controller brakes and holds, then sends nothing.
"""


def _listed() -> str:
    """The modes that failsafes choose, by autopilot."""
    return "; ".join(f"{name}: {', '.join(sorted(habits.failsafes))}" for name, habits in HABITS.items())


def drawing() -> str:
    """The table as a Mermaid state diagram: every way from one state to another, by what is seen."""
    lines = ["stateDiagram-v2", "    [*] --> WAITING"]
    for before in HandoverState:
        ways: dict[HandoverState, list[str]] = {}
        for seen in HandoverEvent:
            after = TRANSITIONS[before, seen][0]
            if after is not before:
                ways.setdefault(after, []).append(seen.value)
        lines += [f"    {before.name} --> {after.name}: {', '.join(seen)}" for after, seen in ways.items()]
    return "\n".join([*lines, "    DONE --> [*]", "    FAILED --> [*]"]) + "\n"
