"""Account of a flight: the causes of its end, as noted by the control loop and by the shells that run it.

Its end is an `Ending`: console, `ctl status`, health, summary, page, JSON and exit code take it from there.
1. Of several causes of an end, the first one counts; a later one only if it is known better (`_find_main_cause`).
2. An end that somebody wanted counts where nothing else brought it about.
3. The sentence: the cause, its reason, what else was against it, and where the vehicle was then.
Pure: nothing here decides anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from msgspec.structs import replace

from uavctl.arrays import SECOND_NS
from uavctl.cause import CAUSES, TAKEN, WANTED, Cause
from uavctl.event_codes import MISSION, EventCode
from uavctl.mavlink.handover import StateTransition
from uavctl.mavlink.handover_guards import is_in_failsafe, is_silent
from uavctl.mavlink.handover_states import HandoverEvent, HandoverState
from uavctl.mavlink.mode_reason import PERSON_REASONS, ModeReason
from uavctl.mavlink.requests import RequestKind
from uavctl.records import ControlMode, Decision, Ending, Event, Order, VehicleStatus

_MODE_CAUSES = {
    ModeReason.PILOT: Cause.PILOT,
    ModeReason.GROUND_STATION: Cause.GROUND_STATION,
    ModeReason.FAILSAFE: Cause.VEHICLE_FAILSAFE,
    ModeReason.FENCE: Cause.VEHICLE_FENCE,
    ModeReason.UNKNOWN: Cause.MODE_LEFT,
}
_LANDED_CAUSES = {
    Cause.PILOT: Cause.PILOT_LANDED,
    Cause.VEHICLE_FAILSAFE: Cause.FAILSAFE_LANDED,
    Cause.VEHICLE_FENCE: Cause.FENCE_LANDED,
}
_FAILSAFES = frozenset({Cause.VEHICLE_FAILSAFE, Cause.VEHICLE_FENCE})
_REFUSED_CAUSES = {
    HandoverState.MODE: Cause.MODE_REFUSED,
    HandoverState.ARMING: Cause.ARMING_REFUSED,
    HandoverState.ENGAGING: Cause.SETPOINTS_REFUSED,
    HandoverState.FAILSAFE: Cause.VEHICLE_FAILSAFE,
    HandoverState.UNCLEAR: Cause.MODE_LEFT,
    HandoverState.LANDING: Cause.LANDING_FAILED,
    HandoverState.SETTLING: Cause.LANDING_FAILED,
}
_LANDING_STATES = frozenset({HandoverState.LANDING, HandoverState.SETTLING})
_FLOWN_MODES = frozenset({ControlMode.TRACK, ControlMode.BRAKE, ControlMode.HOLD})
_FALLBACK_MODES = frozenset({ControlMode.BRAKE, ControlMode.HOLD})
_BEFORE_CONTROL = "before the controller was in charge"


def report_lost_records(ending: Ending, records: int, reason: str) -> Ending:
    """Return the ending of a flight whose recording lacks records: it did not go as ordered."""
    if not records:
        return ending
    count = "1 record" if records == 1 else f"{records} records"
    text = f"{ending.sentence.removesuffix('.')}; the recording lacks {count}{f' ({reason})' if reason else ''}."
    return replace(ending, as_ordered=False, exit_code=ending.exit_code or 1, sentence=text)


def report_failed_writes(ending: Ending, reason: str) -> Ending:
    """Return the ending of a flight whose recording is complete, but could not be written as it should."""
    text = f"{ending.sentence.removesuffix('.')}; writing the recording failed ({reason}), and no record is lost."
    return replace(ending, as_ordered=False, exit_code=ending.exit_code or 1, sentence=text)


def report_missing_files(ending: Ending, names: Sequence[str]) -> Ending:
    """Return the ending of a flight of whose recording files were deleted or moved."""
    text = f"{ending.sentence.removesuffix('.')}; of the recording {', '.join(names)} was deleted or moved."
    return replace(ending, as_ordered=False, exit_code=ending.exit_code or 1, sentence=text)


def make_ending(cause: Cause, text: str, *, as_ordered: bool | None = None, exit_code: int | None = None) -> Ending:
    """Make an ending of one sentence; whether it is as ordered follows from its cause, unless given."""
    good = cause in WANTED if as_ordered is None else as_ordered
    return Ending(
        cause=CAUSES[cause].phrase,
        code=cause.value,
        as_ordered=good,
        sentence=f"{text[:1].upper()}{text[1:]}.",
        exit_code=(0 if good else 1) if exit_code is None else exit_code,
    )


@dataclass
class FlightAccount:
    """Account of a flight.

    Attributes:
        takes_off: The flight begins on the ground, by our order.
        ends_in_flight: The flight is to end in the air, as simulated flights do.
        goal: The place to be reached, in words; empty without one.
        has_arrived: The place has been reached.
        breach_reason: Why the envelope has let the vehicle go; empty while it has not.
        was_controlled: The controller has been in charge at a Δt boundary.
        was_engaged: The vehicle has been flown by our setpoints.
        is_over: Nothing more will be sent.
        control_error: Failure of the controller; empty while there is none.
    """

    takes_off: bool = False
    ends_in_flight: bool = False
    goal: str = ""
    has_arrived: bool = False
    breach_reason: str = ""
    was_controlled: bool = False
    was_engaged: bool = False
    is_over: bool = False
    control_error: str = ""
    _state: HandoverState = HandoverState.WAITING
    _cause: Cause | None = None  # first cause of the end, if there is one
    _reason: str = ""  # of that cause
    _landing_error: str = ""
    _planned_end: Cause | None = None  # the controller flies to it by itself: an order to land, or the mission's end
    _requested_end: Cause | None = None  # asked for from outside
    _connection_error: str = ""
    _signal: int = 0
    _ended_failsafes: int = 0
    _was_armed: bool = False
    _was_airborne: bool = False  # as far as the vehicle reports
    _mode_cause: Cause | None = None  # of a mode that is not ours, whether or not it is the cause of the end
    _had_landing_failsafe: bool = False  # a failsafe of the vehicle acted in a landing that was asked for
    _vehicle: VehicleStatus | None = None
    _had_estimate: bool = False
    _fallback_reason: str = ""  # of the last fallback
    _mode: ControlMode = ControlMode.WAIT
    _now_ns: int = 0

    def note_requested_end(self, cause: Cause) -> None:
        """Note that the end is asked for from outside: ENDED_BY_OPERATOR or TIME_OVER; the first one counts."""
        self._requested_end = self._requested_end or cause

    def note_closed_connection(self, text: str) -> None:
        """Note that the vehicle's connection is closed."""
        self._connection_error = text

    def note_signal(self, number: int) -> None:
        """Note that a second signal ends the flight at once."""
        self._signal = number

    def update_vehicle(self, at_ns: int, vehicle: VehicleStatus | None) -> None:
        """Note the vehicle's state at a tick."""
        self._now_ns, self._vehicle = at_ns, vehicle
        if vehicle is None:
            return
        self._was_armed = self._was_armed or vehicle.armed
        self._was_airborne = self._was_airborne or (vehicle.armed and not vehicle.landed)
        if self._state in _LANDING_STATES and vehicle.armed and is_in_failsafe(vehicle):
            self._had_landing_failsafe = True

    def add_decision(self, decision: Decision, events: tuple[Event, ...], *, has_estimate: bool) -> None:
        """Note the controller's decision of a tick, and its events."""
        self._had_estimate = self._had_estimate or has_estimate
        before, self._mode = self._mode, decision.mode
        if decision.mode is ControlMode.TRACK:
            self._planned_end, self._fallback_reason = None, ""
        is_ended_from_outside = self._requested_end is not None
        if decision.boundary and decision.mode in _FLOWN_MODES and not is_ended_from_outside:
            self.was_controlled = True
        if decision.mode in _FALLBACK_MODES and before not in _FALLBACK_MODES:
            self._fallback_reason = decision.reason
        for event in events:
            if event.code == EventCode.ORDER_ACCEPTED and event.subject == Order.LAND:
                self._planned_end = Cause.LANDED_AS_ORDERED
            elif event.subject == MISSION:
                self._planned_end = Cause.LANDED_AFTER_MISSION
            elif event.code == EventCode.CONTROLLER_FAULT:
                self._fallback_reason = event.text
        has_ended = decision.mode in (ControlMode.LAND, ControlMode.STOPPED) and before in _FLOWN_MODES
        if has_ended and not (is_ended_from_outside or self.breach_reason or self.control_error):
            self._note_fallback_end(decision)

    def _note_fallback_end(self, decision: Decision) -> None:
        """Note that the fallback has handed the vehicle over, as planned or not."""
        if self._planned_end is not None:
            self._note_cause(self._planned_end, "")
        elif is_silent(decision.at_ns, self._vehicle):
            self._note_cause(Cause.VEHICLE_SILENT, self._fallback_reason)
        elif decision.mode is ControlMode.LAND:
            self._note_cause(Cause.FALLBACK_LANDED, self._fallback_reason)
        else:
            self._note_cause(Cause.FALLBACK_STOPPED, self._fallback_reason)

    def add_transition(self, transition: StateTransition, vehicle: VehicleStatus | None) -> None:
        """Note a transition of the hand-over."""
        before, event, self._state = transition.before, transition.event, transition.after
        climbs_on = before is HandoverState.FAILSAFE and self._state is HandoverState.CLIMBING
        if self._state is HandoverState.ENGAGED or climbs_on:
            self._ended_failsafes += self._cause in _FAILSAFES
            self._cause, self._reason, self._mode_cause = None, "", None
        self.was_engaged = self.was_engaged or self._state is HandoverState.ENGAGED
        if event is HandoverEvent.REBOOT:
            self._note_cause(Cause.VEHICLE_RESTARTED, "")
        elif event is HandoverEvent.REFUSED:
            self._add_refusal(transition, vehicle)
        elif event is HandoverEvent.UNSAFE:
            self._note_cause(Cause.CLIMB_ABORTED, transition.reason)
        elif event is HandoverEvent.LEFT:
            self._note_cause(Cause.LEFT_IN_FLIGHT, "")
        elif transition.mode_reason is not None:
            self._add_mode_change(transition.mode_reason, vehicle)
        elif event is HandoverEvent.DISARMED:
            self._add_disarming(before)
        elif (
            event is HandoverEvent.LAND and self._requested_end is None and not self.was_engaged and self._cause is None
        ):
            self._planned_end = Cause.LANDED_AS_ORDERED

    def _add_mode_change(self, reason: ModeReason, vehicle: VehicleStatus | None) -> None:
        """Note a mode that is not ours; the newest evidence of its reason counts."""
        cause, before = _MODE_CAUSES[reason], self._cause
        is_person_after_failsafe = reason in PERSON_REASONS and before in _FAILSAFES
        if before is Cause.MODE_LEFT or before in WANTED or is_person_after_failsafe:
            self._cause = None  # its reason is known now; or the landing that was asked for does not come
        self._mode_cause = cause
        mode = "unknown" if vehicle is None else vehicle.mode
        quoted_text = "" if vehicle is None or not vehicle.said else f', "{vehicle.said}"'
        self._note_cause(cause, "" if cause in TAKEN else f"{mode}{quoted_text}")

    def _add_refusal(self, transition: StateTransition, vehicle: VehicleStatus | None) -> None:
        before = transition.before
        cause = _REFUSED_CAUSES.get(before, Cause.TAKE_OFF_NOT_BEGUN)
        if before in (HandoverState.MODE, HandoverState.ARMING) and vehicle is not None and not vehicle.alone:
            cause = Cause.SECOND_VEHICLE
        elif before in (HandoverState.WAITING, HandoverState.READY):
            cause = self._find_start_obstacle(vehicle)
        elif before is HandoverState.CLIMBING:
            is_refused = transition.request is RequestKind.TAKE_OFF and not transition.is_granted
            cause = Cause.TAKE_OFF_REFUSED if is_refused else Cause.CLIMB_TOO_LONG
        elif before is HandoverState.RETURNING:
            return  # the pilot still has the vehicle
        elif is_silent(self._now_ns, vehicle):  # a silent vehicle refuses nothing, nor does the fallback land it
            if self._cause in (Cause.FALLBACK_LANDED, Cause.CLIMB_TOO_LONG):
                self._cause = None
            self._note_cause(Cause.VEHICLE_SILENT, "")
        if cause is Cause.LANDING_FAILED:
            self._landing_error = transition.reason
        elif cause is Cause.VEHICLE_FAILSAFE:
            self._cause = self._cause if self._cause in _FAILSAFES else cause
            self._reason = transition.reason
        else:
            self._note_cause(cause, "" if cause is Cause.NO_VEHICLE else transition.reason)

    def _find_start_obstacle(self, vehicle: VehicleStatus | None) -> Cause:
        if vehicle is None:
            return Cause.NO_VEHICLE
        if not vehicle.alone:
            return Cause.SECOND_VEHICLE
        if vehicle.armed or self._had_estimate or is_silent(self._now_ns, vehicle):
            return Cause.TAKE_OFF_NOT_BEGUN
        return Cause.POSITIONS_ABSENT

    def _add_disarming(self, before: HandoverState) -> None:
        if before in (HandoverState.CLIMBING, HandoverState.ENGAGING, HandoverState.ENGAGED):
            self._note_cause(Cause.VEHICLE_DISARMED if self._was_airborne else Cause.NOT_RISEN, "")
        elif self._cause is not None and before not in _LANDING_STATES:
            has_landed = self._was_airborne or self._cause in _FAILSAFES
            self._cause = _LANDED_CAUSES.get(self._cause, self._cause) if has_landed else self._cause

    def _note_cause(self, cause: Cause, reason: str) -> None:
        """Note a cause of the end; the first one counts."""
        if self._cause is None:
            self._cause, self._reason = cause, reason

    def compute_ending(self, *, is_over: bool | None = None) -> Ending:
        """Return how the flight ended, or would end now.

        Args:
            is_over: Nothing more is to be sent, if the caller knows better.
        """
        cause, reason = self._find_main_cause(self.is_over if is_over is None else is_over)
        has_missed_goal = bool(self.goal) and not self.has_arrived and cause in WANTED
        is_early = cause in WANTED and ((self.takes_off and not self.was_engaged) or not self.was_controlled)
        text = f"{CAUSES[cause].phrase}{f': {reason}' if reason else ''}"
        if cause is Cause.NOT_REACHED:
            text = f"{self.goal} was not reached"
        elif has_missed_goal:
            text += f"; {self.goal} was not reached"
        text += "".join(f"; {clause}" for clause in self._list_other_faults(cause))
        text += f", {_BEFORE_CONTROL}" if is_early else ""
        place = "" if cause is Cause.IN_FLIGHT else self._describe_place()
        return make_ending(
            cause,
            f"{text}; {place}" if place else text,
            as_ordered=cause in WANTED and not (is_early or has_missed_goal or self._landing_error),
            exit_code=128 + self._signal if self._signal else None,
        )

    def _list_other_faults(self, cause: Cause) -> list[str]:
        """Return clauses on faults of the flight's end beside its cause."""
        clauses = []
        if self._landing_error and cause is not Cause.LANDING_FAILED:
            clauses.append(f"landing has failed: {self._landing_error}")
        if self._ended_failsafes and cause not in _FAILSAFES:
            clauses.append("the vehicle's own failsafe had acted and ended")
        elif self._had_landing_failsafe and self._mode_cause is None and cause not in _FAILSAFES:
            clauses.append("the vehicle's own failsafe acted in the landing")
        if self._mode_cause is not None and cause not in (self._mode_cause, _LANDED_CAUSES.get(self._mode_cause)):
            clauses.append(CAUSES[self._mode_cause].phrase)
        return clauses

    @property
    def end_sentence(self) -> str:
        """The sentence of an end that has come, or is under way; empty while it flies, or has yet to."""
        has_cause = self._cause or self._requested_end or self.breach_reason or self.control_error
        is_ending = self.is_over or has_cause or self._connection_error or self._signal
        return self.compute_ending(is_over=True).sentence if is_ending else ""

    def _find_main_cause(self, is_over: bool) -> tuple[Cause, str]:
        """Return the cause that counts most, and its reason."""
        if self._signal:
            return Cause.SIGNALLED, ""
        if self._connection_error:
            return Cause.CONNECTION_CLOSED, self._connection_error
        if self.control_error:
            return Cause.CONTROL_FAILED, self.control_error
        if self.breach_reason:
            return Cause.ENVELOPE, self.breach_reason
        cause = self._cause
        if cause is None and self._state is HandoverState.ENGAGED and is_silent(self._now_ns, self._vehicle):
            return Cause.VEHICLE_SILENT, ""
        is_wanted = cause is None or cause in WANTED
        if self._landing_error and (is_wanted or cause is Cause.FALLBACK_LANDED):
            return Cause.LANDING_FAILED, self._landing_error
        if cause is not None and (not is_wanted or cause in TAKEN):
            return cause, self._reason
        return self._find_wanted_cause(is_over)

    def _find_wanted_cause(self, is_over: bool) -> tuple[Cause, str]:
        """Return the cause of an end that somebody wanted and nothing else brought about, and its reason."""
        wanted = self._cause or self._requested_end or self._planned_end
        if self.takes_off and not self.was_engaged:
            return Cause.NOT_ENGAGED, "" if wanted is None else CAUSES[wanted].phrase
        if not self.was_engaged and not self.was_controlled:
            return self._find_obstacle()
        if self.goal and not self.has_arrived:
            return Cause.NOT_REACHED, ""
        if self.ends_in_flight and self._cause is None:
            has_fallen = self._mode in _FALLBACK_MODES and self._planned_end is None
            reason = f"the fallback, {self._mode.value}: {self._fallback_reason}" if has_fallen else ""
            return Cause.IN_FLIGHT, reason
        if not is_over:
            return Cause.ENDED_IN_AIR, "" if wanted is None else CAUSES[wanted].phrase
        return (Cause.ENDED_BY_OPERATOR if wanted is None else wanted), self._reason

    def _find_obstacle(self) -> tuple[Cause, str]:
        """Return why nothing was flown, and its reason."""
        if self._vehicle is None:
            return Cause.NO_VEHICLE, ""
        if not self._had_estimate:
            return Cause.POSITIONS_ABSENT, ""
        return Cause.NOT_FLOWN, "the pilot has not switched to the mode that takes setpoints"

    def _describe_place(self) -> str:
        """Return where the vehicle is, in words, as far as it has reported."""
        vehicle = self._vehicle
        if vehicle is None:
            return ""
        mode = f"in mode {vehicle.mode}"
        if not vehicle.armed:
            has_landed = self._was_airborne and self._cause is not Cause.VEHICLE_DISARMED
            state = "it has landed and disarmed" if has_landed else "it is disarmed"
            return state if self._was_armed else "it was not armed"
        if is_silent(self._now_ns, vehicle):
            silent_s = (self._now_ns - vehicle.at_ns) / SECOND_NS
            place = "stood on the ground" if vehicle.landed else "was in the air"
            return f"when it was last heard, {silent_s:.0f} s before, it {place}, armed, {mode}"
        if vehicle.landed:
            return f"it stands on the ground, armed, {mode}"
        return f"it is in the air, {mode}"
