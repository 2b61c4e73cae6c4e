"""Guards of the hand-over: they find the one event of a tick for the table in `handover_states.py`.

Pure: all inputs are arguments. `evaluate` tests in this order:

1. A restart of the vehicle.
2. A mode that another person or a failsafe has chosen: the pilot can take over at any time.
3. A landing that the controller or the operator asks for, and a climb that is not safe.
4. The guard of the current state (`_GUARDS`).
5. A request that the vehicle has refused, or a wait that took too long.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from uavctl.config.connections import HandOverConfig
from uavctl.mavlink.handover_states import HandoverEvent, HandoverState
from uavctl.mavlink.messages import CommandAck, StatusText
from uavctl.mavlink.mode_reason import VEHICLE_REASONS, ModeReason, determine_mode_reason, is_autonomous_mode
from uavctl.mavlink.profile import PROFILES, find_profile
from uavctl.mavlink.requests import Failure, PendingRequest, RequestKind, make_failure
from uavctl.records import Command, Order, VehicleStatus

HEARTBEAT_TIMEOUT_NS = 3_000_000_000
# Heartbeats may be in transit when arming or the external mode is granted. PX4 shows the grant up to 1 s later.
GRACE_NS = 300_000_000
LATE_TEXT_NS = 1_000_000_000  # from the heartbeat with a mode to the text with its reason
LOOK_AHEAD_S = 0.5  # from the request of the external mode to the first braking: answer, new position, vehicle lag
MODE_SHOWN_NS = 2_000_000_000  # a heartbeat shows a requested landing by then
LAND_PERIODS = 10  # multiples of `land_s` for which landing is requested: as long as a battery lasts
NO_CLIMB_SHARE = 0.1  # share of the climb below which it has not begun
MIN_CLIMB_SHARE = 0.3  # share of the climb that an ended climb must have reached
TAKING_OFF = frozenset({HandoverState.MODE, HandoverState.ARMING, HandoverState.CLIMBING, HandoverState.ENGAGING})
# Not yet engaged, or interrupted: the operator's end of the flight requests landing here. Once engaged, the controller
# brakes first and then requests it.
_IN_PROGRESS = TAKING_OFF | {HandoverState.RETURNING, HandoverState.FAILSAFE}
_CLIMB_STATES = frozenset({HandoverState.CLIMBING, HandoverState.ENGAGING})
REQUESTING = _IN_PROGRESS | {HandoverState.LANDING}
BOOT_TIME_WAIT_NS = 5_000_000_000  # wait for the uptime of a vehicle that is armed at the start
# The clock of a simulated vehicle may be slow, so its uptime may be too short.
MIN_CLOCK_RATE, BOOT_TIME_MARGIN_S = 0.8, 1.0
_SECOND_VEHICLE = make_failure("nothing is armed; give each its own link", "another vehicle is heard on this link: ")
_TAKE_OFF = f"{RequestKind.TAKE_OFF}: "
_ALREADY_ARMED = (
    "the vehicle is already armed. A take-off begins disarmed, on the ground. Land and disarm, or start without --arm "
    "--takeoff to fly from here"
)
_ENGAGE_HINT = ", then type `uavctl ctl engage`"
_SLOW_OR_PILOT = "the vehicle is slow, or the pilot changed the mode"
_DISARMED = make_failure("the vehicle disarmed itself")
_LEFT_IN_FLIGHT = make_failure(
    "an earlier daemon left the vehicle in flight: nothing is sent until `uavctl ctl engage`"
)


class HandoverInput(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs of the hand-over in a tick."""

    at_ns: int  # time of the tick
    vehicle: VehicleStatus | None  # the vehicle's latest status; None before the first
    has_setpoint: bool  # the controller has a setpoint; only then neutral setpoints are streamed
    uptime_s: float | None = None  # time since its start [s]; None if unknown
    is_landing_requested: bool = False  # the controller asks for landing
    is_stop_requested: bool = False  # the operator asks for the end
    may_have_lost_messages: bool = False  # messages about a takeover may be lost: no request is made
    arming_refusal: str = ""  # reason not to arm now; empty if arming is allowed
    climb_hazard: str = ""  # reason to end a climb in the air; empty if it may continue
    estimated_height_m: float | None = None  # height of the estimate in local NED [m]; None without one
    climb_rate_mps: float = 0.0  # its rate of climb [m/s]
    has_motion: bool = False  # the vehicle sends its velocity or attitude, with or without heartbeats
    messages: tuple[CommandAck | StatusText, ...] = ()  # the vehicle's answers and texts since the last tick
    commands: tuple[Command, ...] = ()  # the operator's orders


@dataclass(kw_only=True)
class HandoverProgress:
    """Progress of the hand-over."""

    config: HandOverConfig  # times and bounds
    request: PendingRequest  # present request, or wait
    state: HandoverState = HandoverState.WAITING  # present state
    state_start_ns: int = 0  # when it was entered [ns]
    take_off_ordered_ns: int | None = None  # when take-off was ordered [ns]; None if it was not
    height_m: float = 0.0  # height of the climb that was ordered [m]
    ground_height_m: float | None = None  # height of the estimate before it was armed [m]
    previous_mode: str = ""  # the mode before a request; in a failsafe, the mode of the failsafe
    climb_start_ns: int | None = None  # time at which the climb first began [ns]; None before
    is_climb_interrupted: bool = False  # the active failsafe has interrupted a climb
    failsafe_texts: str = ""  # texts of the vehicle before its failsafe
    mode_reason: ModeReason | None = None  # reason of a mode that is not ours; None without one
    is_failsafe_landing: bool = False  # a failsafe has begun the landing that is waited for
    granted_ns: int | None = None  # when arming or the external mode was granted, ahead of the heartbeat [ns]
    boots: int = 0  # restarts of the vehicle by the last tick
    is_standing_by: bool = False  # a vehicle that is armed at the start is left alone
    previous_flight_ns: int | None = None  # start of the flight that an earlier daemon left [ns]; None if unknown
    first_heard_ns: int | None = None  # when the vehicle was heard first [ns]; None if it was not

    def may_be_outdated(self, vehicle: VehicleStatus) -> bool:
        """Return whether the last heartbeat may be older than the grant of arming or of the external mode."""
        return self.granted_ns is not None and vehicle.at_ns <= self.granted_ns + GRACE_NS


class GuardResult(msgspec.Struct, frozen=True):
    """Event of a tick, with its reason."""

    event: HandoverEvent  # column of the transition table
    failure: Failure | None = None
    granted_ns: int | None = None  # when it was granted, if a heartbeat does not show it yet [ns]
    mode_reason: ModeReason | None = None  # reason of a mode that is not ours


def is_silent(at_ns: int, vehicle: VehicleStatus | None) -> bool:
    """Return whether there is no heartbeat, or the last one is too old."""
    return vehicle is None or at_ns - vehicle.at_ns > HEARTBEAT_TIMEOUT_NS


def is_ordered(inputs: HandoverInput, order: Order) -> bool:
    """Return whether this tick has an order of this kind."""
    return any(command.order is order for command in inputs.commands)


def is_in_failsafe(vehicle: VehicleStatus) -> bool:
    """Return whether a failsafe or fence of the vehicle has chosen its mode, which needs no pilot."""
    return is_autonomous_mode(vehicle) and determine_mode_reason(vehicle) in VEHICLE_REASONS


def _classify_takeover(progress: HandoverProgress, vehicle: VehicleStatus) -> GuardResult:
    """Return the event for a mode that is not ours, by its reason.

    On an ordered flight the hand-over waits for a failsafe, unless a pilot flies in its mode: the pilot has priority.
    """
    mode_reason = determine_mode_reason(vehicle, was_in_failsafe=progress.state is HandoverState.FAILSAFE)
    if mode_reason is ModeReason.UNKNOWN:
        return GuardResult(HandoverEvent.UNCLEAR, mode_reason=mode_reason)
    is_waiting = (
        mode_reason in VEHICLE_REASONS and progress.take_off_ordered_ns is not None and is_autonomous_mode(vehicle)
    )
    return GuardResult(HandoverEvent.FAILSAFE if is_waiting else HandoverEvent.OTHER, mode_reason=mode_reason)


def explain_engage_refusal(state: HandoverState, inputs: HandoverInput) -> str:
    """Return why the external mode must not be requested again; empty if it may."""
    vehicle = inputs.vehicle
    if state not in (HandoverState.READY, HandoverState.TAKEN_OVER, HandoverState.UNCLEAR, HandoverState.FAILSAFE):
        return f"nothing to engage (state: {state})"
    if vehicle is None or is_silent(inputs.at_ns, vehicle) or vehicle.autopilot not in PROFILES:
        return "no known vehicle is heard"
    if not vehicle.armed or vehicle.landed:
        return "the vehicle is not in the air"
    return inputs.arming_refusal


def explain_take_off_refusal(state: HandoverState, vehicle: VehicleStatus | None, *, is_ordered_flight: bool) -> str:
    """Return why a running flight must not arm and take off; empty if it may: it stands by, before its first flight."""
    if state is HandoverState.WAITING or vehicle is None:
        return "no vehicle is heard"
    if state is not HandoverState.READY or is_ordered_flight:
        return f"take-off is possible once, from the ground (state: {state})"
    if vehicle.armed:
        return "the vehicle is already armed; a take-off begins disarmed, on the ground: land and disarm it"
    if vehicle.landed is False:
        return "the vehicle reports that it is in the air"
    if vehicle.autopilot not in PROFILES:
        return f"autopilot {vehicle.autopilot!r} is not supported; use PX4 or ArduCopter"
    return "" if vehicle.alone else "another vehicle is heard on this link; give each its own link"


def explain_move_refusal(state: HandoverState, vehicle: VehicleStatus | None) -> str:
    """Return the reason why an order to move would have no effect; empty while the controller flies."""
    if state is HandoverState.ENGAGED:
        return ""
    if state is HandoverState.WAITING or vehicle is None:
        return "no vehicle is heard"
    mode = vehicle.mode
    if state is HandoverState.READY:
        return f"the controller does not fly: the vehicle is in mode {mode}, and the pilot has not switched"
    if state in TAKING_OFF:
        return f"the vehicle is climbing ({state}); repeat the order after the climb"
    if state in (HandoverState.FAILSAFE, HandoverState.UNCLEAR, HandoverState.TAKEN_OVER, HandoverState.RETURNING):
        return f"the vehicle was taken over ({state}, in mode {mode}); `uavctl ctl engage` takes it back"
    return f"the vehicle has been handed over ({state})"


def evaluate(progress: HandoverProgress, inputs: HandoverInput) -> GuardResult:
    """Return the event of a tick; of several, the first in the order of `HandoverEvent`."""
    vehicle, state = inputs.vehicle, progress.state
    if vehicle is not None and vehicle.boots > progress.boots and state is not HandoverState.WAITING:
        return GuardResult(HandoverEvent.REBOOT, make_failure("the vehicle has restarted"))
    result = GuardResult(HandoverEvent.SILENCE)
    if vehicle is not None and not is_silent(inputs.at_ns, vehicle):
        result = _GUARDS.get(state, _guard_standby)(progress, inputs, vehicle)
    is_landing = vehicle is not None and vehicle.mode in find_profile(vehicle).landing_modes
    is_taken_over = result.event in (HandoverEvent.UNCLEAR, HandoverEvent.OTHER)
    if is_taken_over and not is_landing and state not in (HandoverState.WAITING, HandoverState.READY):
        return result  # the pilot has the vehicle: no request is made, whatever ends the flight
    if inputs.is_landing_requested and state is not HandoverState.UNCLEAR:
        return GuardResult(HandoverEvent.LAND)
    if (state in _IN_PROGRESS and (inputs.is_stop_requested or is_ordered(inputs, Order.LAND))) or _is_landing_ordered(
        progress, inputs
    ):
        return GuardResult(HandoverEvent.LAND)
    if (
        state is HandoverState.ENGAGED
        and inputs.is_stop_requested
        and not inputs.has_setpoint
        and progress.take_off_ordered_ns is not None
    ):
        # The controller has ended without a landing, and no pilot has the vehicle that we took off.
        return GuardResult(HandoverEvent.LAND)
    if state in _CLIMB_STATES and inputs.climb_hazard:
        return GuardResult(HandoverEvent.UNSAFE, make_failure(inputs.climb_hazard, "the climb was aborted: "))
    if result.event in (HandoverEvent.GRANTED, HandoverEvent.REFUSED):
        return result
    if result.event is HandoverEvent.DISARMED and state is HandoverState.LANDING:
        return result  # it has landed, whatever it answered
    failure = _find_failure(progress, inputs)
    return result if failure is None else GuardResult(HandoverEvent.REFUSED, failure)


def _find_failure(progress: HandoverProgress, inputs: HandoverInput) -> Failure | None:
    state, vehicle = progress.state, inputs.vehicle
    if state in (HandoverState.WAITING, HandoverState.READY):
        return _find_take_off_failure(progress, inputs)
    if state in (HandoverState.MODE, HandoverState.ARMING) and vehicle is not None and not vehicle.alone:
        return _SECOND_VEHICLE
    if state in (HandoverState.FAILSAFE, HandoverState.UNCLEAR):
        return _find_wait_timeout(progress, inputs)
    is_waiting = (state in REQUESTING or state is HandoverState.SETTLING) and not _must_keep_landing(progress, inputs)
    return progress.request.find_failure(inputs.at_ns) if is_waiting else None


def _must_keep_landing(progress: HandoverProgress, inputs: HandoverInput) -> bool:
    """Return whether the landing request is repeated after a refusal: no pilot has a vehicle that we took off."""
    vehicle = inputs.vehicle
    if progress.state is not HandoverState.LANDING or progress.take_off_ordered_ns is None or vehicle is None:
        return False
    is_heard = vehicle.armed and not is_silent(inputs.at_ns, vehicle)
    return is_heard and inputs.at_ns - progress.state_start_ns < round(LAND_PERIODS * progress.config.land_s * 1e9)


def is_without_pilot(progress: HandoverProgress, vehicle: VehicleStatus | None) -> bool:
    """Return whether a vehicle that we took off flies by itself, without evidence of a pilot."""
    if progress.take_off_ordered_ns is None or vehicle is None or vehicle.landed or vehicle.stick:
        return False
    return is_autonomous_mode(vehicle) or vehicle.external or vehicle.mode in find_profile(vehicle).climb_modes


def _is_landing_ordered(progress: HandoverProgress, inputs: HandoverInput) -> bool:
    """Return whether the operator orders a landing of a vehicle without a pilot."""
    is_unclear = progress.state is HandoverState.UNCLEAR and is_ordered(inputs, Order.LAND)
    return is_unclear and is_without_pilot(progress, inputs.vehicle)


def _find_wait_timeout(progress: HandoverProgress, inputs: HandoverInput) -> Failure | None:
    """Return the failure that ends the wait for a failsafe or an unknown pilot; None while it lasts."""
    vehicle, config = inputs.vehicle, progress.config
    is_unclear = progress.state is HandoverState.UNCLEAR
    if is_unclear and not is_without_pilot(progress, vehicle):
        return None
    is_landing = vehicle is not None and vehicle.mode in find_profile(vehicle).landing_modes
    start_ns, limit_s = progress.state_start_ns, config.land_s if is_landing else config.climb_s
    if progress.is_climb_interrupted and not is_landing and progress.climb_start_ns is not None:
        start_ns = progress.climb_start_ns
    if inputs.at_ns - start_ns < round(limit_s * 1e9):
        return None
    if is_unclear:
        mode = "" if vehicle is None else vehicle.mode
        text = f"no pilot took control in {limit_s:g} s, and the vehicle flies by itself ({mode})"
        return make_failure(text)
    is_failsafe_active = vehicle is None or is_in_failsafe(vehicle)
    outcome = "has not ended" if is_failsafe_active else "has ended, and no pilot took control"
    outcome += f" in {limit_s:g} s{progress.failsafe_texts}"
    return Failure(f"{_describe_failsafe(progress)} {outcome}", f"{progress.previous_mode} {outcome}")


def _describe_failsafe(progress: HandoverProgress) -> str:
    """Return the name of the active failsafe, and its mode."""
    return f"{progress.mode_reason or ModeReason.FAILSAFE} ({progress.previous_mode})"


def _find_take_off_failure(progress: HandoverProgress, inputs: HandoverInput) -> Failure | None:
    """Return the failure by which an ordered take-off cannot begin; None if it can, or without an order."""
    vehicle, limit_s = inputs.vehicle, progress.config.ground_s
    if progress.take_off_ordered_ns is None:
        return None
    if vehicle is not None and vehicle.autopilot not in PROFILES:
        text = f"autopilot {vehicle.autopilot!r} is not supported; use PX4 or ArduCopter"
        return make_failure(text, _TAKE_OFF)
    if vehicle is not None and not vehicle.alone:
        return _SECOND_VEHICLE
    if vehicle is not None and vehicle.armed:
        return make_failure(f"{_ALREADY_ARMED}{_ENGAGE_HINT if progress.is_standing_by else ''}", _TAKE_OFF)
    if inputs.at_ns - progress.take_off_ordered_ns < round(limit_s * 1e9):
        return None
    silence = "the vehicle's heartbeats are missing" if inputs.has_motion else "the vehicle is silent"
    reason = "no vehicle is heard" if vehicle is None else inputs.arming_refusal or silence
    return make_failure(f"{reason} (waited {limit_s:g} s)", _TAKE_OFF)


def _guard_standby(progress: HandoverProgress, inputs: HandoverInput, vehicle: VehicleStatus) -> GuardResult:
    """Return the event before, between and after flights."""
    is_ready = progress.state is HandoverState.READY and not (inputs.arming_refusal or inputs.is_stop_requested)
    if is_ready and progress.take_off_ordered_ns is not None and not vehicle.armed and vehicle.alone:
        return (
            GuardResult(HandoverEvent.TAKE_OFF)
            if vehicle.autopilot in PROFILES
            else GuardResult(HandoverEvent.DISARMED)
        )
    if is_ordered(inputs, Order.ENGAGE) and not explain_engage_refusal(progress.state, inputs):
        return GuardResult(HandoverEvent.ENGAGE)
    if progress.state is HandoverState.ENGAGED and progress.may_be_outdated(vehicle):
        return GuardResult(HandoverEvent.EXTERNAL)
    if not vehicle.armed:
        return GuardResult(HandoverEvent.DISARMED)
    if progress.is_standing_by and not _has_started_since(progress, inputs):
        heard_ns = inputs.at_ns if progress.first_heard_ns is None else progress.first_heard_ns
        is_uptime_pending = inputs.uptime_s is None and inputs.at_ns - heard_ns < BOOT_TIME_WAIT_NS
        return (
            GuardResult(HandoverEvent.SILENCE)
            if is_uptime_pending
            else GuardResult(HandoverEvent.LEFT, _LEFT_IN_FLIGHT)
        )
    if vehicle.external:
        return GuardResult(HandoverEvent.EXTERNAL)
    if progress.state is HandoverState.ENGAGED:
        return _classify_takeover(progress, vehicle)
    # The text of a failsafe may come after the heartbeat with its mode.
    is_reason_uncertain = (
        progress.mode_reason in (ModeReason.PILOT, ModeReason.UNKNOWN)
        and inputs.at_ns - progress.state_start_ns < LATE_TEXT_NS
    )
    mode_reason = (
        determine_mode_reason(vehicle)
        if is_reason_uncertain and progress.state is HandoverState.TAKEN_OVER
        else progress.mode_reason
    )
    return GuardResult(
        HandoverEvent.OTHER, mode_reason=progress.mode_reason if mode_reason is ModeReason.UNKNOWN else mode_reason
    )


def _has_started_since(progress: HandoverProgress, inputs: HandoverInput) -> bool:
    """Return whether the vehicle has restarted since the flight that an earlier daemon left."""
    if progress.previous_flight_ns is None or inputs.uptime_s is None:
        return False
    return inputs.uptime_s / MIN_CLOCK_RATE + BOOT_TIME_MARGIN_S < (inputs.at_ns - progress.previous_flight_ns) / 1e9


def _guard_mode(progress: HandoverProgress, inputs: HandoverInput, vehicle: VehicleStatus) -> GuardResult:
    profile = find_profile(vehicle)
    if vehicle.armed:
        return _classify_takeover(progress, vehicle)
    if vehicle.alone and vehicle.mode == profile.take_off_mode:
        return GuardResult(HandoverEvent.GRANTED)
    # A mode that we did not request is the pilot's. A slow vehicle may still be in the previous mode.
    if vehicle.alone and vehicle.mode not in (profile.take_off_mode, progress.previous_mode):
        return _classify_takeover(progress, vehicle)
    if _is_after_grant(progress, vehicle, MODE_SHOWN_NS):
        failure = progress.request.describe_failure(inputs.at_ns)
        texts = (f"{text}; {_SLOW_OR_PILOT}" for text in (failure.text, failure.reason))
        return GuardResult(HandoverEvent.REFUSED, Failure(*texts))
    return GuardResult(HandoverEvent.PENDING)


def _is_after_grant(progress: HandoverProgress, vehicle: VehicleStatus, after_ns: int = GRACE_NS) -> bool:
    """Return whether the last heartbeat is newer than the grant of the request, and so shows its effect."""
    granted_ns = progress.request.granted_ns
    return granted_ns is not None and vehicle.at_ns > granted_ns + after_ns


def _guard_arming(progress: HandoverProgress, _inputs: HandoverInput, vehicle: VehicleStatus) -> GuardResult:
    profile, granted_ns = find_profile(vehicle), progress.request.granted_ns
    # A disarmed vehicle has not climbed, so its mode is not the end of PX4's climb.
    if vehicle.mode != profile.take_off_mode and not (vehicle.armed and vehicle.mode in profile.climb_modes):
        return _classify_takeover(progress, vehicle)
    if profile.climbs_on_arming and granted_ns is not None:  # it climbs already
        return GuardResult(HandoverEvent.GRANTED, granted_ns=granted_ns)
    return GuardResult(HandoverEvent.GRANTED if vehicle.armed else HandoverEvent.PENDING)


def _guard_climbing(progress: HandoverProgress, inputs: HandoverInput, vehicle: VehicleStatus) -> GuardResult:
    if not (vehicle.armed or progress.may_be_outdated(vehicle)):
        return GuardResult(HandoverEvent.DISARMED, _DISARMED)
    profile = find_profile(vehicle)
    if vehicle.mode not in profile.climb_modes:
        return _classify_takeover(progress, vehicle)
    if (
        vehicle.mode != profile.take_off_mode
        and vehicle.landed
        and _predict_climb_share(progress, inputs, 0.0) < NO_CLIMB_SHARE
    ):
        return _classify_takeover(progress, vehicle)  # a climb cannot end on the ground
    share = _predict_climb_share(progress, inputs, LOOK_AHEAD_S if profile.climbs_on_arming else 0.0)
    # A climb that has ended below the height goes no higher.
    is_climb_over = profile.climbs_on_arming and vehicle.mode != profile.take_off_mode
    return GuardResult(
        HandoverEvent.GRANTED
        if share >= (MIN_CLIMB_SHARE if is_climb_over else progress.config.reached)
        else HandoverEvent.PENDING
    )


def _predict_climb_share(progress: HandoverProgress, inputs: HandoverInput, ahead_s: float) -> float:
    """Return the share of the height that will be reached `ahead_s` from now, by new positions."""
    if inputs.estimated_height_m is None or progress.ground_height_m is None or inputs.arming_refusal:
        return 0.0
    return (inputs.estimated_height_m + ahead_s * inputs.climb_rate_mps - progress.ground_height_m) / progress.height_m


def _guard_external(progress: HandoverProgress, _inputs: HandoverInput, vehicle: VehicleStatus) -> GuardResult:
    if not (vehicle.armed or progress.may_be_outdated(vehicle)):
        return GuardResult(HandoverEvent.DISARMED, _DISARMED)
    granted_ns = progress.request.granted_ns
    if vehicle.external or granted_ns is not None:
        return GuardResult(HandoverEvent.GRANTED, granted_ns=granted_ns)
    is_engaging = progress.state is HandoverState.ENGAGING
    if vehicle.mode == progress.previous_mode or (is_engaging and vehicle.mode in find_profile(vehicle).climb_modes):
        return GuardResult(HandoverEvent.PENDING)
    return _classify_takeover(progress, vehicle)


def _guard_failsafe(progress: HandoverProgress, inputs: HandoverInput, vehicle: VehicleStatus) -> GuardResult:
    """Return the event in a failsafe of an ordered flight; the pilot can take over at any time."""
    if not vehicle.armed:
        text = f"{_describe_failsafe(progress)} has landed the vehicle{progress.failsafe_texts}"
        return GuardResult(HandoverEvent.DISARMED, make_failure(text))
    if is_ordered(inputs, Order.ENGAGE) and not explain_engage_refusal(progress.state, inputs):
        return GuardResult(HandoverEvent.ENGAGE)
    profile = find_profile(vehicle)
    if progress.is_climb_interrupted and vehicle.mode in profile.climb_modes:
        return GuardResult(HandoverEvent.GRANTED)
    stays_in_failsafe = not profile.restores_mode and vehicle.mode == progress.previous_mode and not vehicle.stick
    # The external mode is not used again without an order: its reason is unknown.
    if vehicle.external or is_in_failsafe(vehicle) or stays_in_failsafe:
        return GuardResult(HandoverEvent.PENDING)
    return _classify_takeover(progress, vehicle)


def _guard_unclear(progress: HandoverProgress, inputs: HandoverInput, vehicle: VehicleStatus) -> GuardResult:
    """Return the event while the reason of a mode is unknown: evidence may still come."""
    if not vehicle.armed:
        return GuardResult(HandoverEvent.DISARMED)
    if is_ordered(inputs, Order.ENGAGE) and not explain_engage_refusal(progress.state, inputs):
        return GuardResult(HandoverEvent.ENGAGE)
    result = GuardResult(HandoverEvent.PENDING) if vehicle.external else _classify_takeover(progress, vehicle)
    return GuardResult(HandoverEvent.PENDING) if result.event is HandoverEvent.UNCLEAR else result


def _guard_landing(progress: HandoverProgress, _inputs: HandoverInput, vehicle: VehicleStatus) -> GuardResult:
    """Return the event while landing is requested (LANDING), and after the vehicle has begun it (SETTLING)."""
    is_new_heartbeat, is_requesting = vehicle.at_ns > progress.state_start_ns, progress.state is HandoverState.LANDING
    if not vehicle.armed:
        return GuardResult(HandoverEvent.DISARMED if is_new_heartbeat else HandoverEvent.PENDING)
    profile, is_ordered_flight = find_profile(vehicle), progress.take_off_ordered_ns is not None
    if vehicle.mode in profile.landing_modes:
        # A failsafe may end its landing. An ordered flight must land in any case.
        is_our_landing = not (is_ordered_flight and is_in_failsafe(vehicle)) or progress.request.granted_ns is not None
        return GuardResult(HandoverEvent.GRANTED if is_requesting and is_our_landing else HandoverEvent.PENDING)
    if not is_new_heartbeat or (is_ordered_flight and is_in_failsafe(vehicle)):
        return GuardResult(HandoverEvent.PENDING)
    if is_requesting:
        # If landing is requested in a climb, heartbeats may still show any mode of the climb. After the grant, only
        # the previous mode may appear, for `MODE_SHOWN_NS`.
        is_climb_mode = vehicle.external or vehicle.mode in profile.climb_modes
        grace_ns = MODE_SHOWN_NS if vehicle.mode == progress.previous_mode else GRACE_NS
        is_taken_over = not is_climb_mode or _is_after_grant(progress, vehicle, grace_ns)
        return _classify_takeover(progress, vehicle) if is_taken_over else GuardResult(HandoverEvent.PENDING)
    if (
        is_ordered_flight
        and progress.is_failsafe_landing
        and profile.climbs_on_arming
        and vehicle.mode == profile.take_off_mode
    ):
        is_mode_shown = vehicle.at_ns > progress.state_start_ns + MODE_SHOWN_NS
        return GuardResult(HandoverEvent.FAILSAFE if is_mode_shown else HandoverEvent.PENDING)
    return _classify_takeover(progress, vehicle)


_GUARDS: dict[HandoverState, Callable[[HandoverProgress, HandoverInput, VehicleStatus], GuardResult]] = {
    HandoverState.MODE: _guard_mode,
    HandoverState.ARMING: _guard_arming,
    HandoverState.CLIMBING: _guard_climbing,
    HandoverState.ENGAGING: _guard_external,
    HandoverState.RETURNING: _guard_external,
    HandoverState.FAILSAFE: _guard_failsafe,
    HandoverState.UNCLEAR: _guard_unclear,
    HandoverState.LANDING: _guard_landing,
    HandoverState.SETTLING: _guard_landing,
}
