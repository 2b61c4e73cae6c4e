"""End of a flight, told once: console, `ctl status`, health, summary, page, JSON and exit code take it from here.

The control loop notes what happens along the way; whoever ends it adds why. Pure: nothing here decides anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from msgspec.structs import replace

from uavctl.flight.decide import MISSION_OVER
from uavctl.flight.monitors.external import CONTROLLER_FAULT
from uavctl.mavlink.handover import StateTransition
from uavctl.mavlink.handover_guards import CLIMB_ABORTED, is_in_failsafe, is_silent
from uavctl.mavlink.handover_states import HandoverEvent, HandoverState
from uavctl.mavlink.mode_reason import PERSON_REASONS, ModeReason
from uavctl.mavlink.requests import RequestKind
from uavctl.records import ORDER_ACCEPTED, ControlMode, Decision, Ending, Event, Order, VehicleStatus

SECOND_NS = 1_000_000_000


class Cause(StrEnum):
    """Cause of a flight's end; the value is a phrase for a table."""

    MISSION = "landed at the end of the mission"
    ORDERED = "landed as ordered"
    OPERATOR = "ended by the operator"
    TIME = "ended as its time was over"
    IN_FLIGHT = "still flying"  # a simulated flight that was to end in the air, or a recording that says no more
    PILOT = "the pilot has taken over"
    PILOT_LANDED = "landed by the pilot"
    GROUND_STATION = "a ground station has taken over"
    UNKNOWN_SWITCH = "the mode was changed, and it is not known by whom"
    NOT_FLOWN = "nothing was flown"
    NO_VEHICLE = "no vehicle was heard"
    NO_POSITIONS = "no positions came"
    NOT_ALONE = "another vehicle was heard"
    NOT_BEGUN = "the take-off was not begun"
    NO_MODE = "the mode to take off in was refused"
    NOT_ARMED = "arming was refused"
    NO_TAKE_OFF = "the take-off was refused"
    NO_CLIMB = "the climb took too long"
    BROKEN_OFF = "the climb was broken off"
    NOT_GRANTED = "the mode that takes setpoints was refused"
    NOT_ENGAGED = "ended before the controller was in charge"
    NOT_REACHED = "the place was not reached"
    LEFT = "left alone, as the daemon before had left it in flight"
    FALLBACK = "landed by the fallback"
    FALLBACK_STOPPED = "let go by the fallback"
    LET_GO = "let go by the envelope"
    FAILSAFE = "a failsafe of the vehicle's own took over"
    FAILSAFE_LANDED = "landed by a failsafe of the vehicle's own"
    FENCE = "a fence of the vehicle's own took over"
    FENCE_LANDED = "landed by a fence of the vehicle's own"
    RESTARTED = "the vehicle has started anew"
    SILENT = "the vehicle fell silent"
    DISARMED = "the vehicle disarmed in flight"
    NOT_RISEN = "the vehicle disarmed before it had left the ground"
    LANDING_FAILED = "landing has failed"
    CUT_OFF = "ended before the vehicle was down"
    CONNECTION = "the vehicle's connection was closed by the other side"
    CONTROL = "the controller has failed"
    SIGNALLED = "ended at once by a second signal"
    WAITING = "waiting"  # by an older recording, which does not say for what


# Ends that a person wanted who has the vehicle since
TAKEN = frozenset({Cause.PILOT, Cause.PILOT_LANDED, Cause.GROUND_STATION})
# Ends that somebody wanted: the operator, the mission, or whoever has taken over.
WANTED = TAKEN | {Cause.MISSION, Cause.ORDERED, Cause.OPERATOR, Cause.TIME, Cause.IN_FLIGHT}
_SWITCHED = {
    ModeReason.PILOT: Cause.PILOT,
    ModeReason.GROUND_STATION: Cause.GROUND_STATION,
    ModeReason.FAILSAFE: Cause.FAILSAFE,
    ModeReason.FENCE: Cause.FENCE,
    ModeReason.UNKNOWN: Cause.UNKNOWN_SWITCH,
}
_LANDED = {Cause.PILOT: Cause.PILOT_LANDED, Cause.FAILSAFE: Cause.FAILSAFE_LANDED, Cause.FENCE: Cause.FENCE_LANDED}
_OWN = frozenset({Cause.FAILSAFE, Cause.FENCE})
_BEFORE = "before the controller was in charge"
_REFUSED = {
    HandoverState.MODE: Cause.NO_MODE,
    HandoverState.ARMING: Cause.NOT_ARMED,
    HandoverState.ENGAGING: Cause.NOT_GRANTED,
    HandoverState.FAILSAFE: Cause.FAILSAFE,
    HandoverState.UNCLEAR: Cause.UNKNOWN_SWITCH,
    HandoverState.LANDING: Cause.LANDING_FAILED,
    HandoverState.SETTLING: Cause.LANDING_FAILED,
}
_COMES_DOWN = frozenset({HandoverState.LANDING, HandoverState.SETTLING})
_FLOWN = frozenset({ControlMode.TRACK, ControlMode.BRAKE, ControlMode.HOLD})
_FALLING = frozenset({ControlMode.BRAKE, ControlMode.HOLD})


def lacking(ending: Ending, records: int, why: str) -> Ending:
    """Return the ending of a flight whose recording lacks records: it did not go as ordered."""
    if not records:
        return ending
    some = "1 record" if records == 1 else f"{records} records"
    text = f"{ending.sentence.removesuffix('.')}; the recording lacks {some}{f' ({why})' if why else ''}."
    return replace(ending, as_ordered=False, exit_code=ending.exit_code or 1, sentence=text)


def make_ending(cause: Cause, what: str, *, as_ordered: bool | None = None, exit_code: int | None = None) -> Ending:
    """Make an ending of one sentence; whether it is as ordered follows from its cause, unless given."""
    good = cause in WANTED if as_ordered is None else as_ordered
    code = (0 if good else 1) if exit_code is None else exit_code
    return Ending(cause=cause.value, as_ordered=good, sentence=f"{what[:1].upper()}{what[1:]}.", exit_code=code)


@dataclass
class FlightCourse:
    """Course of a flight, as far as it bears upon its end."""

    takes_off: bool = False  # the flight begins on the ground, by our order
    in_flight: bool = False  # it is to end in the air, as simulated flights do
    goal: str = ""  # the place that was to be reached, in words; empty if none was
    arrived: bool = False  # it has been reached
    let_go: str = ""  # why the envelope let the vehicle go; empty while it did not
    flown: bool = False  # the controller has been in charge at a Δt boundary
    engaged: bool = False  # the vehicle has been flown by our setpoints
    over: bool = False  # nothing more will be sent
    died: str = ""  # failure of the controller; empty while there is none
    _state: HandoverState = HandoverState.WAITING
    _found: Cause | None = None  # first cause of the end, if there is one
    _why: str = ""
    _failed: str = ""  # why the landing failed
    _asked: Cause | None = None  # end that the controller flies to by itself: an order to land, or the mission's end
    _asked_ns: int | None = None
    _stop: Cause | None = None  # the end that was asked for from outside
    _closed: str = ""
    _signal: int = 0
    _failsafes: int = 0  # number of failsafes that have ended by themselves
    _armed: bool = False  # it has been armed
    _aloft: bool = False  # it has been in the air, as far as it tells
    _taken: Cause | None = None  # who has changed the mode to one that is none of ours, if that is not the cause
    _fails: bool = False  # it landed by a failsafe of its own while, or after, it was asked to
    _vehicle: VehicleStatus | None = None
    _positions: bool = False  # there has been an estimate
    _fell: str = ""  # why the fallback took over last
    _mode: ControlMode = ControlMode.WAIT
    _now_ns: int = 0

    def stop(self, cause: Cause) -> None:
        """Note that the end is asked for from outside: OPERATOR or TIME; the first one counts."""
        self._stop = self._stop or cause

    def close(self, text: str) -> None:
        """Note that the vehicle's connection is closed."""
        self._closed = text

    def kill(self, number: int) -> None:
        """Note that a second signal ends the flight at once."""
        self._signal = number

    def see(self, at_ns: int, vehicle: VehicleStatus | None) -> None:
        """Note the vehicle's state at a tick."""
        self._now_ns, self._vehicle = at_ns, vehicle
        if vehicle is None:
            return
        self._armed = self._armed or vehicle.armed
        self._aloft = self._aloft or (vehicle.armed and not vehicle.landed)
        self._fails = self._fails or (self._state in _COMES_DOWN and vehicle.armed and is_in_failsafe(vehicle))

    def decide(self, decision: Decision, events: tuple[Event, ...], *, estimated: bool) -> None:
        """Note what the controller decided in a tick."""
        self._positions = self._positions or estimated
        before, self._mode = self._mode, decision.mode
        if decision.mode is ControlMode.TRACK:
            self._asked, self._fell = None, ""
        if any(one.code == ORDER_ACCEPTED and one.text == Order.LAND.value for one in events):
            self._asked = Cause.ORDERED
        if decision.reason == MISSION_OVER:
            self._asked = Cause.MISSION
        self.flown = self.flown or (decision.boundary and decision.mode in _FLOWN and self._stop is None)
        if decision.mode in _FALLING and before not in _FALLING:
            self._fell = decision.reason
        self._fell = next((one.text for one in events if one.code == CONTROLLER_FAULT), self._fell)
        ends = decision.mode in (ControlMode.LAND, ControlMode.STOPPED) and before in _FLOWN
        if ends and self._stop is None and not (self.let_go or self.died):
            lost = is_silent(decision.at_ns, self._vehicle)
            landed = Cause.FALLBACK if decision.mode is ControlMode.LAND else Cause.FALLBACK_STOPPED
            self._find(self._asked or (Cause.SILENT if lost else landed), "" if self._asked else self._fell)

    def turn(self, one: StateTransition, vehicle: VehicleStatus | None) -> None:
        """Note a transition of the hand-over."""
        self._state = one.after
        if one.after is HandoverState.ENGAGED or (
            one.before is HandoverState.FAILSAFE and one.after is HandoverState.CLIMBING
        ):
            self._failsafes += self._found in _OWN
            self._found, self._why, self._taken = None, "", None
        self.engaged = self.engaged or one.after is HandoverState.ENGAGED
        if one.event is HandoverEvent.REBOOT:
            self._find(Cause.RESTARTED, "")
        elif one.event is HandoverEvent.REFUSED:
            self._refuse(one, vehicle)
        elif one.event is HandoverEvent.UNSAFE:
            self._find(Cause.BROKEN_OFF, _reason(one))
        elif one.event is HandoverEvent.LEFT:
            self._find(Cause.LEFT, "")
        elif one.mode_reason is not None:
            self._switch(one.mode_reason, vehicle)
        elif one.event is HandoverEvent.DISARMED:
            self._disarm(one)
        elif one.event is HandoverEvent.LAND and self._stop is None and not self.engaged and self._found is None:
            self._asked = Cause.ORDERED

    def _switch(self, who: ModeReason, vehicle: VehicleStatus | None) -> None:
        """Note that somebody has changed the mode to one that is none of ours; the newest word of it counts."""
        cause = _SWITCHED[who]
        before = self._found
        if before is Cause.UNKNOWN_SWITCH or before in WANTED or (who in PERSON_REASONS and before in _OWN):
            self._found = None  # it is known now; or the landing that was asked for does not come
        self._taken = cause
        said = "" if vehicle is None or not vehicle.said else f', "{vehicle.said}"'
        self._find(cause, "" if cause in TAKEN else f"{_mode(vehicle)}{said}")

    def ending(self, *, over: bool | None = None) -> Ending:
        """Return how it ended, or would end now; `over`: nothing more was to be sent, if that is known better."""
        cause, why = self._told(self.over if over is None else over)
        where = "" if cause is Cause.IN_FLIGHT else self._where()
        what = f"{cause.value}{f': {why}' if why else ''}"
        missed = self.goal if cause in WANTED and not self.arrived else ""
        if cause is Cause.NOT_REACHED:
            what = f"{self.goal} was not reached"
        elif missed:
            what += f"; {missed} was not reached"
        early = cause in WANTED and ((self.takes_off and not self.engaged) or not self.flown)
        if self._failed and cause is not Cause.LANDING_FAILED:
            what += f"; landing has failed: {self._failed}"
        if self._failsafes and cause not in _OWN:
            what += "; a failsafe of the vehicle's own had acted and ended"
        elif self._fails and self._taken is None and cause not in _OWN:
            what += "; a failsafe of the vehicle's own acted in the landing"
        if self._taken is not None and cause not in (self._taken, _LANDED.get(self._taken)):
            what += f"; {self._taken.value}"
        text = f"{what}{f', {_BEFORE}' if early else ''}{f'; {where}' if where else ''}"
        good = cause in WANTED and not (early or missed or self._failed)
        return make_ending(cause, text, as_ordered=good, exit_code=128 + self._signal if self._signal else None)

    @property
    def told(self) -> str:
        """The sentence of an end that has come, or is under way; empty while it flies, or has yet to."""
        done = self.over or self._found or self._stop or self.let_go or self.died or self._closed or self._signal
        return self.ending(over=True).sentence if done else ""

    def _find(self, cause: Cause, why: str) -> None:
        """Note a cause of the end; the first one counts."""
        if self._found is None:
            self._found, self._why = cause, why

    def _refuse(self, one: StateTransition, vehicle: VehicleStatus | None) -> None:
        cause = _REFUSED.get(one.before, Cause.NOT_BEGUN)
        if one.before in (HandoverState.MODE, HandoverState.ARMING) and vehicle is not None and not vehicle.alone:
            cause = Cause.NOT_ALONE
        elif one.before in (HandoverState.WAITING, HandoverState.READY):
            cause = self._against_beginning(vehicle)
        elif one.before is HandoverState.CLIMBING:
            cause = Cause.NO_TAKE_OFF if one.request is RequestKind.TAKE_OFF and not one.is_granted else Cause.NO_CLIMB
        elif one.before is HandoverState.RETURNING:
            return  # the pilot has it still
        elif is_silent(self._now_ns, vehicle):  # it has refused nothing, nor has the fallback landed it
            self._found = None if self._found in (Cause.FALLBACK, Cause.NO_CLIMB) else self._found
            self._find(Cause.SILENT, "")
        if cause is Cause.LANDING_FAILED:
            self._failed = _reason(one)
        elif cause is Cause.FAILSAFE:
            self._found = self._found if self._found in _OWN else cause
            self._why = _reason(one)
        else:
            self._find(cause, "" if cause is Cause.NO_VEHICLE else _reason(one))

    def _against_beginning(self, vehicle: VehicleStatus | None) -> Cause:
        if vehicle is None:
            return Cause.NO_VEHICLE
        if not vehicle.alone:
            return Cause.NOT_ALONE
        if vehicle.armed or self._positions or is_silent(self._now_ns, vehicle):
            return Cause.NOT_BEGUN
        return Cause.NO_POSITIONS

    def _disarm(self, one: StateTransition) -> None:
        if one.before in (HandoverState.CLIMBING, HandoverState.ENGAGING, HandoverState.ENGAGED):
            self._find(Cause.DISARMED if self._aloft else Cause.NOT_RISEN, "")
        elif one.before not in _COMES_DOWN and self._found is not None and (self._aloft or self._found in _OWN):
            self._found = _LANDED.get(self._found, self._found)

    def _told(self, over: bool) -> tuple[Cause, str]:
        """Return the cause that counts most, and the reason behind it."""
        if self._signal:
            return Cause.SIGNALLED, ""
        if self._closed:
            return Cause.CONNECTION, self._closed
        if self.died:
            return Cause.CONTROL, self.died
        if self.let_go:
            return Cause.LET_GO, self.let_go
        if self._found is None and self._state is HandoverState.ENGAGED and is_silent(self._now_ns, self._vehicle):
            return Cause.SILENT, ""
        wanted = self._found is None or self._found in WANTED
        if self._failed and (wanted or self._found is Cause.FALLBACK):
            return Cause.LANDING_FAILED, self._failed
        if self._found is not None and (not wanted or self._found in TAKEN):
            return self._found, self._why
        return self._wished(over)

    def _wished(self, over: bool) -> tuple[Cause, str]:
        """Return the cause of an end that somebody wanted and nothing else brought about, if there was one."""
        asked = self._found or self._stop or self._asked
        if self.takes_off and not self.engaged:
            return Cause.NOT_ENGAGED, "" if asked is None else asked.value
        if not self.engaged and not self.flown:
            return self._nothing_flown()
        if self.goal and not self.arrived:
            return Cause.NOT_REACHED, ""
        if self.in_flight and self._found is None:
            falls = self._mode in _FALLING and self._asked is None
            return Cause.IN_FLIGHT, f"the fallback, {self._mode.value}: {self._fell}" if falls else ""
        if not over:
            return Cause.CUT_OFF, "" if asked is None else asked.value
        return (Cause.OPERATOR if asked is None else asked), self._why

    def _nothing_flown(self) -> tuple[Cause, str]:
        if self._vehicle is None:
            return Cause.NO_VEHICLE, ""
        if not self._positions:
            return Cause.NO_POSITIONS, ""
        return Cause.NOT_FLOWN, "the pilot has not switched to the mode that takes setpoints"

    def _where(self) -> str:
        """Return in words where the vehicle is, as far as it has told."""
        vehicle = self._vehicle
        if vehicle is None:
            return ""
        mode = f"in mode {vehicle.mode}"
        if not vehicle.armed:
            flew = self._aloft and self._found is not Cause.DISARMED
            down = "it has landed and disarmed" if flew else "it is disarmed"
            return down if self._armed else "it was not armed"
        if is_silent(self._now_ns, vehicle):
            since_s = (self._now_ns - vehicle.at_ns) / SECOND_NS
            was = "stood on the ground" if vehicle.landed else "was in the air"
            return f"when it was last heard, {since_s:.0f} s before, it {was}, armed, {mode}"
        if vehicle.landed:
            return f"it stands on the ground, armed, {mode}"
        return f"it is in the air, {mode}"


def _reason(one: StateTransition) -> str:
    """Return why something was refused, without what the cause says already."""
    asked = "" if one.request is None else f"{one.request.value}: "
    text = one.reason
    for said in (
        asked,
        "take-off: ",
        CLIMB_ABORTED,
        "another vehicle is heard on this link: ",
        "the vehicle's own failsafe ",
        "the vehicle's own fence ",
    ):
        text = text.removeprefix(said)
    if one.request is None and text.startswith("("):  # the failsafe's mode
        text = text.replace("(", "", 1).replace(")", "", 1)
    return text.replace("it took too long (", "not done in ").removesuffix(")") if "too long" in text else text


def _mode(vehicle: VehicleStatus | None) -> str:
    return "unknown" if vehicle is None else vehicle.mode
