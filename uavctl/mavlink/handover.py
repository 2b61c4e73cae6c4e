"""State machine of the hand-over between pilot and controller, one update in each tick.

1. Accept or refuse the orders of the operator.
2. Evaluate the guards (`handover_guards`): one event for this tick.
3. Look up the next state and the allowed setpoints (`handover_states.TRANSITIONS`).
4. On entry of a state, choose the request to the vehicle and its limits.
5. Return the request that is due, the setpoint mode, and the events for people.
"""

from __future__ import annotations

import msgspec

from uavctl.config.connections import HandOverConfig
from uavctl.event_codes import EventCode
from uavctl.mavlink.handover_guards import (
    LAND_PERIODS,
    REQUESTING,
    TAKING_OFF,
    GuardResult,
    HandoverInput,
    HandoverProgress,
    evaluate,
    explain_engage_refusal,
    is_in_failsafe,
    is_silent,
    is_without_pilot,
)
from uavctl.mavlink.handover_states import TRANSITIONS, HandoverEvent, HandoverState, SetpointMode
from uavctl.mavlink.mode_reason import ModeReason
from uavctl.mavlink.profile import find_profile
from uavctl.mavlink.requests import PendingRequest, RequestKind, RequestLimits
from uavctl.records import Command, Event, Order, Severity, VehicleStatus

LAND_TRIES = 5
NEW_HEARTBEAT_NS = 100_000_000  # a heartbeat counts as new for two ticks
MISSING_HEARTBEAT_NS = 1_500_000_000  # a heartbeat is missing
FOREVER_NS = 2**62
_END_STATES = frozenset({HandoverState.DONE, HandoverState.FAILED})
_ON_THE_GROUND = frozenset({HandoverState.MODE, HandoverState.ARMING})
_CLIMB_OR_LANDING_STATES = frozenset(
    {
        HandoverState.CLIMBING,
        HandoverState.ENGAGING,
        HandoverState.FAILSAFE,
        HandoverState.UNCLEAR,
        HandoverState.LANDING,
        HandoverState.SETTLING,
    }
)
_ROUTINE_STATES = frozenset(HandoverState) - {
    HandoverState.FAILSAFE,
    HandoverState.UNCLEAR,
    HandoverState.TAKEN_OVER,
    HandoverState.LANDING,
    HandoverState.FAILED,
}
# States that store the vehicle's mode on entry.
_STATES_STORING_MODE = frozenset(
    {HandoverState.MODE, HandoverState.RETURNING, HandoverState.FAILSAFE, HandoverState.LANDING}
)
# A failsafe in one of these states, which ends itself, has only interrupted the climb.
_CLIMB_STATES = frozenset({HandoverState.ARMING, HandoverState.CLIMBING, HandoverState.ENGAGING})
# States in which a failsafe, or nobody who is known, has the vehicle for a limited time.
_INTERRUPTED_STATES = frozenset({HandoverState.FAILSAFE, HandoverState.UNCLEAR})
_ORDER_TEXTS = {
    Order.TAKE_OFF: "take-off begins",
    Order.ENGAGE: "OFFBOARD or GUIDED is requested",
    Order.STAND_BY: "nothing is sent to an armed vehicle",
}
HAND_OVER_ORDERS = frozenset(_ORDER_TEXTS)  # all other orders are for the controller


class StateTransition(msgspec.Struct, frozen=True):
    """Transition between two states."""

    before: HandoverState  # the state that was left
    event: HandoverEvent
    after: HandoverState  # the state that was entered
    reason: str = ""  # reason of a failure, without what was asked for
    request: RequestKind | None = None  # request to the vehicle at that time
    is_granted: bool = False  # the vehicle had accepted the request
    mode_reason: ModeReason | None = None  # reason of a mode that is not ours


class HandoverOutput(msgspec.Struct, frozen=True):
    """Result of a tick of the hand-over."""

    setpoint_mode: SetpointMode  # setpoints that may be streamed
    request: RequestKind | None = None  # request to make now, if any
    events: tuple[Event, ...] = ()  # events for people
    transition: StateTransition | None = None  # transition that was made, if one was


class HandoverStateMachine:
    """State machine of the hand-over of one vehicle.

    Args:
        waits_for_landing: Wait for the end of every landing, not only of ordered flights: the vehicle lands on relayed
            positions.

    Attributes:
        failure: Why a request failed; empty while none has.
    """

    def __init__(self, config: HandOverConfig | None = None, *, waits_for_landing: bool = False) -> None:
        self._config = HandOverConfig() if config is None else config
        self._progress = HandoverProgress(
            config=self._config, request=PendingRequest(None, 0, RequestLimits(0, 0, 0, FOREVER_NS))
        )
        self._waits_for_landing = waits_for_landing
        self._landed_ns: int | None = None  # since then it stands on the ground, armed
        self._is_disarm_requested = False
        self._is_heartbeat_lost = False
        self._is_without_pilot = False  # a vehicle that we took off flies by itself without a pilot
        self._is_landing_overdue = False  # the vehicle has not begun a requested landing in time
        self._airborne_ns: int | None = None  # the last tick with a vehicle that is heard and in the air
        self.failure = ""

    @property
    def state(self) -> HandoverState:
        """Present state."""
        return self._progress.state

    @property
    def is_ordered_flight(self) -> bool:
        """Whether an order to take off began this flight."""
        return self._progress.take_off_ordered_ns is not None

    @property
    def height_m(self) -> float:
        """Height of the climb that was ordered [m]."""
        return self._progress.height_m

    @property
    def is_climbing_or_landing(self) -> bool:
        """Whether the vehicle climbs or lands at our request, or by a failsafe on an ordered flight."""
        return self.state in _CLIMB_OR_LANDING_STATES

    @property
    def lands_on_request(self) -> bool:
        """Whether a request to land would be made in this state, or is made already."""
        return TRANSITIONS[self.state, HandoverEvent.LAND][0] is HandoverState.LANDING

    @property
    def is_finished(self) -> bool:
        """Whether nothing will be sent any more."""
        return self.state in _END_STATES and not self.is_relay_needed

    @property
    def is_relay_needed(self) -> bool:
        """Whether a vehicle is in the air on relayed positions, so that the relay must go on.

        A silent vehicle gets positions for the time of a landing.
        """
        return self._waits_for_landing and self._airborne_ns is not None

    @property
    def is_busy(self) -> bool:
        """Whether an answer of the vehicle is pending, or it is in the air on relayed positions."""
        if self.is_relay_needed:
            return True
        if self.state is HandoverState.UNCLEAR:
            return self._is_without_pilot
        return self.state in REQUESTING or (
            self.state is HandoverState.SETTLING and (self.is_ordered_flight or self._waits_for_landing)
        )

    def select_controlled_status(self, at_ns: int, vehicle: VehicleStatus | None) -> VehicleStatus | None:
        """Return the status for the controller: None if the vehicle is silent, external only while we control it."""
        if vehicle is None or is_silent(at_ns, vehicle):
            return None
        if self.state in (HandoverState.WAITING, HandoverState.READY) and not self._progress.is_standing_by:
            return vehicle
        if self.state is HandoverState.ENGAGED:
            if self.is_ordered_flight:
                # EXTENDED_SYS_STATE comes once a second and may still show the climb that we have ended.
                vehicle = msgspec.structs.replace(vehicle, own_climb=False)
            is_outdated = self._progress.may_be_outdated(vehicle)
            return msgspec.structs.replace(vehicle, armed=True, external=True) if is_outdated else vehicle
        return msgspec.structs.replace(vehicle, external=False, mode=f"{vehicle.mode} ({self.state})")

    def has_left_external_mode(self, vehicle: VehicleStatus) -> bool:
        """Return whether a heartbeat shows that the vehicle has left the external mode."""
        return not (vehicle.external and vehicle.armed) and not self._progress.may_be_outdated(vehicle)

    def update(self, inputs: HandoverInput) -> HandoverOutput:
        """Decide the setpoint mode and the request of one tick."""
        progress, before = self._progress, self.state
        for message in inputs.messages:
            progress.request.handle_message(message, inputs.at_ns)
        events = self._accept_orders(inputs)
        if progress.first_heard_ns is None and inputs.vehicle is not None:
            progress.first_heard_ns = inputs.at_ns
        self.update_airborne(inputs.at_ns, inputs.vehicle)
        result = evaluate(progress, inputs)
        if inputs.vehicle is not None and inputs.vehicle.mode in find_profile(inputs.vehicle).landing_modes:
            progress.is_failsafe_landing = is_in_failsafe(inputs.vehicle)
        if before is HandoverState.FAILSAFE and inputs.vehicle is not None and is_in_failsafe(inputs.vehicle):
            # One failsafe may follow another, and ArduPilot stays in its mode.
            progress.previous_mode = inputs.vehicle.mode
        progress.boots = 0 if inputs.vehicle is None else inputs.vehicle.boots
        progress.state, setpoint_mode = TRANSITIONS[before, result.event]
        transition = None
        is_late_reason = (
            progress.state is before is HandoverState.TAKEN_OVER and result.mode_reason is not progress.mode_reason
        )
        if progress.state is not before or is_late_reason:
            previous_request = progress.request
            transition = StateTransition(
                before,
                result.event,
                progress.state,
                "" if result.failure is None else result.failure.reason,
                previous_request.kind,
                previous_request.granted_ns is not None,
                result.mode_reason,
            )
            progress.mode_reason = result.mode_reason
        if progress.state is not before:
            self._enter_state(before, result, inputs)
        self._is_without_pilot = progress.state is HandoverState.UNCLEAR and is_without_pilot(progress, inputs.vehicle)
        if setpoint_mode is SetpointMode.NEUTRAL and not (inputs.has_setpoint and self._may_send_neutral(inputs)):
            setpoint_mode = SetpointMode.NOTHING
        self._request_disarming(inputs)
        blocked_reason = inputs.arming_refusal if progress.state in _ON_THE_GROUND else ""
        kind = None
        if progress.request.kind is not None and not inputs.may_have_lost_messages:
            kind = progress.request.due(
                inputs.at_ns, blocked_reason, is_mode_uncertain=self._may_be_pilot_mode_change(inputs)
            )
        if progress.state is HandoverState.FAILED and before is HandoverState.ARMING:
            kind = RequestKind.DISARM  # arming may have been granted after all
        return HandoverOutput(
            setpoint_mode,
            kind,
            (*events, *self._make_events(inputs, before, result, has_changed=transition is not None)),
            transition,
        )

    def update_airborne(self, at_ns: int, vehicle: VehicleStatus | None) -> None:
        """Update whether the vehicle is in the air; without messages, the last state counts for `land_s`."""
        if vehicle is not None and not is_silent(at_ns, vehicle):
            self._airborne_ns = at_ns if vehicle.armed and not vehicle.landed else None
        elif self._airborne_ns is not None and at_ns - self._airborne_ns >= _ns(self._config.land_s):
            self._airborne_ns = None

    def _accept_orders(self, inputs: HandoverInput) -> list[Event]:
        events = []
        for command in inputs.commands:
            if command.order not in _ORDER_TEXTS:
                continue
            refusal = self._explain_refusal(command, inputs)
            if not refusal and command.order is Order.TAKE_OFF:
                self._progress.take_off_ordered_ns, self._progress.height_m = inputs.at_ns, command.height_m or 0.0
            elif not refusal and command.order is Order.STAND_BY:
                self._progress.is_standing_by, self._progress.previous_flight_ns = True, command.flown_ns
            code, severity = (
                (EventCode.ORDER_REFUSED, Severity.WARNING) if refusal else (EventCode.ORDER_ACCEPTED, Severity.INFO)
            )
            events.append(
                Event(
                    at_ns=inputs.at_ns,
                    severity=severity,
                    code=code,
                    text=refusal or _ORDER_TEXTS[command.order],
                    subject="" if refusal else command.order.value,
                )
            )
        return events

    def _explain_refusal(self, command: Command, inputs: HandoverInput) -> str:
        """Return why an order is refused; empty if it is accepted."""
        if command.order is Order.ENGAGE:
            return explain_engage_refusal(self.state, inputs)
        if command.order is Order.STAND_BY:
            return "" if self.state is HandoverState.WAITING else f"the vehicle is already heard (state: {self.state})"
        if not (command.height_m or 0.0) > 0.0:
            return f"{command.height_m} m is not a height to climb to"
        is_on_ground = self.state in (HandoverState.WAITING, HandoverState.READY) and not self.is_ordered_flight
        return "" if is_on_ground else f"take-off is possible once, from the ground (state: {self.state})"

    def _may_be_pilot_mode_change(self, inputs: HandoverInput) -> bool:
        """Return whether the pilot may have changed the mode since the last heartbeat.

        Heartbeats show a mode up to one second late. A repeated request would override the pilot meanwhile. So it is
        repeated only right after a heartbeat; a landing request also if heartbeats are missing.
        """
        vehicle, kind = inputs.vehicle, self._progress.request.kind
        if kind not in (RequestKind.EXTERNAL_MODE, RequestKind.LAND) or vehicle is None:
            return False
        age_ns = inputs.at_ns - vehicle.at_ns
        return age_ns > NEW_HEARTBEAT_NS and not (kind is RequestKind.LAND and age_ns > MISSING_HEARTBEAT_NS)

    def _may_send_neutral(self, inputs: HandoverInput) -> bool:
        """Return whether neutral setpoints are safe: they would end the climb of an ArduPilot."""
        if self.state not in TAKING_OFF or inputs.vehicle is None:
            return True
        return find_profile(inputs.vehicle).climbs_on_arming

    def _enter_state(self, before: HandoverState, result: GuardResult, inputs: HandoverInput) -> None:
        progress = self._progress
        progress.state_start_ns, progress.is_standing_by = inputs.at_ns, False
        if progress.state in _INTERRUPTED_STATES and before not in _INTERRUPTED_STATES:
            progress.is_climb_interrupted = before in _CLIMB_STATES
        if progress.state is HandoverState.FAILSAFE:
            failsafe_text = "" if inputs.vehicle is None else inputs.vehicle.said
            progress.failsafe_texts = progress.request.quoted_texts + (
                f', "{failsafe_text}"' if failsafe_text and failsafe_text not in progress.request.quoted_texts else ""
            )
        if progress.state is HandoverState.CLIMBING and progress.climb_start_ns is None:
            progress.climb_start_ns = inputs.at_ns
        if progress.state is HandoverState.CLIMBING:
            progress.previous_mode = ""  # the mode on the ground would now be a choice of the pilot
        progress.request = PendingRequest(
            self._choose_request(inputs), inputs.at_ns, self._choose_limits(progress.state, inputs.at_ns)
        )
        if progress.state is HandoverState.ARMING:
            progress.ground_height_m = inputs.estimated_height_m
        takes_control_back = progress.state is HandoverState.ENGAGING and before is HandoverState.FAILSAFE
        if (takes_control_back or progress.state in _STATES_STORING_MODE) and inputs.vehicle is not None:
            progress.previous_mode = inputs.vehicle.mode
        if result.granted_ns is not None:
            progress.granted_ns = result.granted_ns
        elif progress.state not in (HandoverState.CLIMBING, HandoverState.ENGAGING):
            progress.granted_ns = None
        if before is not HandoverState.RETURNING:
            self.failure = self.failure or ("" if result.failure is None else result.failure.text)

    def _choose_request(self, inputs: HandoverInput) -> RequestKind | None:
        climbs_on_arming = inputs.vehicle is not None and find_profile(inputs.vehicle).climbs_on_arming
        is_external = inputs.vehicle is not None and inputs.vehicle.external
        requests = {
            HandoverState.MODE: RequestKind.TAKE_OFF_MODE,
            HandoverState.ARMING: RequestKind.ARM,
            HandoverState.CLIMBING: None if climbs_on_arming else RequestKind.TAKE_OFF,
            HandoverState.ENGAGING: None if is_external else RequestKind.EXTERNAL_MODE,
            HandoverState.RETURNING: None if is_external else RequestKind.EXTERNAL_MODE,
            HandoverState.LANDING: RequestKind.LAND,
        }
        return requests.get(self.state)

    def _choose_limits(self, state: HandoverState, at_ns: int) -> RequestLimits:
        config = self._config
        climbed_s = 0.0 if self._progress.climb_start_ns is None else (at_ns - self._progress.climb_start_ns) / 1e9
        limits_s = {
            HandoverState.MODE: config.ground_s,
            HandoverState.ARMING: config.ground_s,
            # One limit for the climb, also after interruptions.
            HandoverState.CLIMBING: max(config.climb_s - climbed_s, 0.0),
            HandoverState.ENGAGING: config.engage_s,
            HandoverState.RETURNING: config.engage_s,
            HandoverState.LANDING: config.land_s,
            HandoverState.SETTLING: config.land_s,
        }
        limit_ns = _ns(limits_s[state]) if state in limits_s else FOREVER_NS
        if state is HandoverState.LANDING:
            # Nobody else would land what we took off: the request is repeated for longer.
            tries = (
                max(LAND_TRIES, round(LAND_PERIODS * config.land_s / config.answer_s))
                if self.is_ordered_flight
                else LAND_TRIES
            )
            return RequestLimits(_ns(config.answer_s), _ns(config.answer_s), tries, limit_ns)
        # In the air, long pauses cost too much time.
        retry_s = config.retry_s if state in _ON_THE_GROUND else config.answer_s / 2
        return RequestLimits(_ns(config.answer_s), _ns(retry_s), config.tries, limit_ns)

    def _request_disarming(self, inputs: HandoverInput) -> None:
        """Request disarming if the vehicle stays armed on the ground after an ordered flight."""
        vehicle = inputs.vehicle
        if not (
            self.is_ordered_flight and self.state is HandoverState.SETTLING and vehicle is not None and vehicle.landed
        ):
            self._landed_ns = None
        elif self._landed_ns is None:
            self._landed_ns = inputs.at_ns
        elif not self._is_disarm_requested and inputs.at_ns - self._landed_ns >= _ns(self._config.disarm_s):
            self._is_disarm_requested = True
            self._progress.request = PendingRequest(
                RequestKind.DISARM, inputs.at_ns, self._choose_limits(HandoverState.SETTLING, inputs.at_ns)
            )

    def _make_events(
        self, inputs: HandoverInput, before: HandoverState, result: GuardResult, *, has_changed: bool
    ) -> list[Event]:
        events = []
        is_heartbeat_lost = self.state is HandoverState.ENGAGED and result.event is HandoverEvent.SILENCE
        if is_heartbeat_lost != self._is_heartbeat_lost:
            self._is_heartbeat_lost = is_heartbeat_lost
            others = "other messages arrive" if inputs.has_motion else "no other message arrives"
            text = f"no heartbeat, {others}: braking and holding" if is_heartbeat_lost else "the heartbeat is back"
            events.append(Event(at_ns=inputs.at_ns, severity=Severity.ERROR, code=EventCode.HEARTBEAT, text=text))
        is_landing = self.state is HandoverState.LANDING
        overdue = self._progress.request.find_failure(inputs.at_ns) if is_landing else None
        if overdue is not None and not self._is_landing_overdue:
            text = f"{overdue.text}; landing is requested again while the vehicle is in the air"
            events.append(Event(at_ns=inputs.at_ns, severity=Severity.ERROR, code=EventCode.REQUEST_FAILED, text=text))
        self._is_landing_overdue = overdue is not None
        if has_changed:
            vehicle = inputs.vehicle
            mode = "" if vehicle is None else f" ({vehicle.mode}, {'armed' if vehicle.armed else 'disarmed'})"
            is_routine = self.state in _ROUTINE_STATES and before is not HandoverState.FAILSAFE
            severity = Severity.INFO if is_routine else Severity.WARNING
            text = f"{before} -> {self.state}{mode}"
            if result.mode_reason is not None:
                failsafe_text = "" if vehicle is None or not vehicle.said else f', "{vehicle.said}"'
                text += f": {result.mode_reason}{failsafe_text}"
            events.append(
                Event(
                    at_ns=inputs.at_ns, severity=severity, code=EventCode.HAND_OVER, text=text, subject=self.state.value
                )
            )
            if result.failure is not None:
                text = result.failure.text
                events.append(
                    Event(at_ns=inputs.at_ns, severity=Severity.ERROR, code=EventCode.REQUEST_FAILED, text=text)
                )
        return events


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
