"""Guards of the hand-over: the event that a tick sees, in the words of the table of `handover_states.py`.

Pure: all that it goes by is an argument.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from uavctl.config.connections import HandOverConfig
from uavctl.mavlink.handover_states import HandoverEvent, HandoverState
from uavctl.mavlink.messages import Ack, Text
from uavctl.mavlink.profile import PROFILES, profile_of
from uavctl.mavlink.requests import PendingRequest
from uavctl.mavlink.switcher import OWN, Switcher, flies_itself, who_switched
from uavctl.records import Command, Order, VehicleStatus

HEARTBEAT_TIMEOUT_NS = 3_000_000_000
# A heartbeat may have been under way when arming or the external mode was granted: PX4 shows it up to a second later.
GRACE_NS = 300_000_000
LATE_WORD_NS = 1_000_000_000  # from the heartbeat that shows a mode to the text that says why
LOOK_AHEAD_S = 0.5  # from asking for the external mode in a climb to the first braking: answer, news, the vehicle's lag
SHOWN_NS = 2_000_000_000  # a heartbeat shows by then that landing was asked for
MUST_LAND = 10  # times `land_s` for which landing is asked for: as long as a battery lasts
NONE = 0.1  # share below which there was no climb yet
LOW = 0.3  # share of the take-off height below which a climb that has ended was none
LEAVING = frozenset({HandoverState.MODE, HandoverState.ARMING, HandoverState.CLIMBING, HandoverState.ENGAGING})
_UNDER_WAY = LEAVING | {
    HandoverState.RETURNING,
    HandoverState.FAILSAFE,
}  # here the operator's end of the flight asks for landing, too
_CLIMBS = frozenset({HandoverState.CLIMBING, HandoverState.ENGAGING})
ASKING = _UNDER_WAY | {HandoverState.LANDING}
CLOCK_NS = 5_000_000_000  # in which a vehicle that is found armed tells how long ago it started
# A simulated vehicle's clock may be slow, so that it seems to have started later than it has.
SLOWEST, LATEST_S = 0.8, 1.0
_ANOTHER = "another vehicle is heard on this link: nothing is armed; give each its own link"
_ARMED = (
    "the vehicle is armed already; it begins on the ground, disarmed. Land and disarm it, or start without --arm "
    "--takeoff to fly it from where it is"
)
_OR_ENGAGE = ", and ask for that with `uavctl ctl engage`"
BROKEN_OFF = "the climb is broken off: "
_OR_PILOT = "it is slow, or the pilot has taken it back"
_DISARMED = "the vehicle has disarmed itself"
_LEFT = "a daemon before this one has left the vehicle in flight: nothing is sent until `uavctl ctl engage`"


class HandoverView(msgspec.Struct, frozen=True, kw_only=True):
    """Inputs of the hand-over in a tick."""

    at_ns: int  # time of the tick
    vehicle: VehicleStatus | None  # the vehicle's latest status; None before the first
    ready: bool  # the controller has a setpoint; without one no neutral stream invites the pilot
    up_s: float | None = None  # time since it started [s]; None if it does not tell
    land: bool = False  # the controller asks for landing
    stop: bool = False  # the operator asks for the end
    unsure: bool = False  # the pilot may have taken over unheard: nothing is asked of the vehicle
    unfit: str = ""  # why nothing may be armed now; empty if it may
    unsafe: str = ""  # why a vehicle in the air must not climb on by these positions; empty if it may
    up_m: float | None = None  # height of the estimate in local NED [m]; None without one
    up_mps: float = 0.0  # its rate of climb [m/s]
    moves: bool = False  # the vehicle sends its velocity or attitude now, whatever its heartbeats do
    heard: tuple[Ack | Text, ...] = ()  # the vehicle's answers and words since the last tick
    commands: tuple[Command, ...] = ()  # the operator's orders


@dataclass(kw_only=True)
class Progress:
    """Progress of the hand-over."""

    config: HandOverConfig  # times and bounds
    request: PendingRequest  # request that is made, or waited for
    state: HandoverState = HandoverState.WAITING  # place in the table
    since_ns: int = 0  # when it was entered [ns]
    ordered_ns: int | None = None  # when take-off was ordered [ns]; None if it was not
    height_m: float = 0.0  # height of the climb that was ordered [m]
    ground_up_m: float | None = None  # height of the estimate before it was armed [m]
    left_mode: str = ""  # the mode that a request is to end; or, in a failsafe, that it chose
    climb_ns: int | None = None  # time at which the climb first began [ns]; None before
    resumes: bool = False  # the failsafe that acts ended the climb, not the flight
    words: str = ""  # texts of the vehicle from before its failsafe acted
    who: Switcher | None = None  # who has the vehicle, where it is not we; None while it is we, or nobody
    lands_failing: bool = False  # the landing that is waited for was last seen as a failsafe's
    granted_ns: int | None = None  # when arming or the external mode was granted, ahead of the heartbeat [ns]
    boots: int = 0  # times that the vehicle had started anew by the last tick
    stands_by: bool = False  # A vehicle that is found armed is left alone
    flown_ns: int | None = None  # start of the flight that it was left in [ns]; None if not known
    heard_ns: int | None = None  # when the vehicle was heard first [ns]; None if it was not

    def shows_the_past(self, vehicle: VehicleStatus) -> bool:
        """Whether the last heartbeat may be from before arming or the external mode was granted."""
        return self.granted_ns is not None and vehicle.at_ns <= self.granted_ns + GRACE_NS


class GuardResult(msgspec.Struct, frozen=True):
    """Event that is seen, with the reason where that has to be told."""

    seen: HandoverEvent  # in the words of the table
    why: str = ""  # why something failed
    granted_ns: int | None = None  # when it was granted, if a heartbeat does not show it yet [ns]
    who: Switcher | None = None  # who has changed the mode, where it is none of ours


def silent(at_ns: int, vehicle: VehicleStatus | None) -> bool:
    """Whether there is no heartbeat, or the last one is too old."""
    return vehicle is None or at_ns - vehicle.at_ns > HEARTBEAT_TIMEOUT_NS


def ordered(view: HandoverView, order: Order) -> bool:
    """Whether this tick brings an order."""
    return any(command.order is order for command in view.commands)


def fails(vehicle: VehicleStatus) -> bool:
    """Whether a failsafe or a fence of its own has chosen its mode, which needs no person."""
    return flies_itself(vehicle) and who_switched(vehicle) in OWN


def _taken(progress: Progress, vehicle: VehicleStatus) -> GuardResult:
    """Return the event seen in a mode that is none of ours, by who has chosen it.

    A failsafe is waited for on a flight that we began, unless a person flies in its mode: the stick always wins.
    """
    who = who_switched(vehicle, had_failed=progress.state is HandoverState.FAILSAFE)
    if who is Switcher.UNKNOWN:
        return GuardResult(HandoverEvent.UNCLEAR, who=who)
    waits = who in OWN and progress.ordered_ns is not None and flies_itself(vehicle)
    return GuardResult(HandoverEvent.FAILSAFE if waits else HandoverEvent.OTHER, who=who)


def against_engaging(state: HandoverState, view: HandoverView) -> str:
    """Return why the external mode must not be asked for again; empty if it may."""
    vehicle = view.vehicle
    if state not in (HandoverState.READY, HandoverState.RELEASED, HandoverState.UNCLEAR, HandoverState.FAILSAFE):
        return f"there is nothing to engage; now: {state}"
    if vehicle is None or silent(view.at_ns, vehicle) or vehicle.autopilot not in PROFILES:
        return "no vehicle is heard that could be flown"
    if not vehicle.armed or vehicle.landed:
        return "the vehicle is not in the air"
    return view.unfit


def against_moving(state: HandoverState, vehicle: VehicleStatus | None) -> str:
    """Return why an order of where to fly would have no effect; empty if it is we who fly."""
    if state is HandoverState.ENGAGED:
        return ""
    if state is HandoverState.WAITING or vehicle is None:
        return "no vehicle is heard"
    mode = vehicle.mode
    if state is HandoverState.READY:
        return f"it is not we who fly: the vehicle is in mode {mode}, and the pilot has not switched"
    if state in LEAVING:
        return f"the vehicle is on its way up ({state}); order it once it is flown"
    if state in (HandoverState.FAILSAFE, HandoverState.UNCLEAR, HandoverState.RELEASED, HandoverState.RETURNING):
        return f"the vehicle has been taken over ({state}, in mode {mode}); `uavctl ctl engage` asks for it back"
    return f"the vehicle has been handed over ({state})"


def evaluate(progress: Progress, view: HandoverView) -> GuardResult:
    """Return the event that a tick sees; of several the first in the order of `HandoverEvent`."""
    vehicle, state = view.vehicle, progress.state
    if vehicle is not None and vehicle.boots > progress.boots and state is not HandoverState.WAITING:
        return GuardResult(HandoverEvent.REBOOT, "the vehicle has started anew")
    there = GuardResult(HandoverEvent.SILENCE)
    if vehicle is not None and not silent(view.at_ns, vehicle):
        there = _LOOKS.get(state, _around)(progress, view, vehicle)
    lands = vehicle is not None and vehicle.mode in profile_of(vehicle).landing
    taken = there.seen in (HandoverEvent.UNCLEAR, HandoverEvent.OTHER)
    if taken and not lands and state not in (HandoverState.WAITING, HandoverState.READY):
        return there  # whatever ends the flight: what the pilot has taken is asked for nothing
    if view.land and state is not HandoverState.UNCLEAR:
        return GuardResult(HandoverEvent.LAND)
    if (state in _UNDER_WAY and (view.stop or ordered(view, Order.LAND))) or _may_be_landed(progress, view):
        return GuardResult(HandoverEvent.LAND)
    if state is HandoverState.ENGAGED and view.stop and not view.ready and progress.ordered_ns is not None:
        # The controller has ended without a landing, and nobody else has what we took off.
        return GuardResult(HandoverEvent.LAND)
    if state in _CLIMBS and view.unsafe:
        return GuardResult(HandoverEvent.UNSAFE, f"{BROKEN_OFF}{view.unsafe}")
    if there.seen in (HandoverEvent.GRANTED, HandoverEvent.REFUSED):
        return there
    if there.seen is HandoverEvent.DISARMED and state is HandoverState.LANDING:
        return there  # whatever it answered, it is down
    why = _given_up(progress, view)
    return GuardResult(HandoverEvent.REFUSED, why) if why else there


def _given_up(progress: Progress, view: HandoverView) -> str:
    state, vehicle = progress.state, view.vehicle
    if state in (HandoverState.WAITING, HandoverState.READY):
        return _never_ready(progress, view)
    if state in (HandoverState.MODE, HandoverState.ARMING) and vehicle is not None and not vehicle.alone:
        return _ANOTHER
    if state in (HandoverState.FAILSAFE, HandoverState.UNCLEAR):
        return _stays(progress, view)
    waits = (state in ASKING or state is HandoverState.SETTLING) and not _must_land(progress, view)
    return progress.request.given_up(view.at_ns) if waits else ""


def _must_land(progress: Progress, view: HandoverView) -> bool:
    """Whether it is asked to land, whatever it answers: what we took off, or armed for that, has nobody else."""
    vehicle = view.vehicle
    if progress.state is not HandoverState.LANDING or progress.ordered_ns is None or vehicle is None:
        return False
    heard = vehicle.armed and not silent(view.at_ns, vehicle)
    return heard and view.at_ns - progress.since_ns < round(MUST_LAND * progress.config.land_s * 1e9)


def nobody_s(progress: Progress, vehicle: VehicleStatus | None) -> bool:
    """Whether a vehicle that we took off flies by itself, and nothing shows that a person has it."""
    if progress.ordered_ns is None or vehicle is None or vehicle.landed or vehicle.stick:
        return False
    return flies_itself(vehicle) or vehicle.external or vehicle.mode in profile_of(vehicle).climbing


def _may_be_landed(progress: Progress, view: HandoverView) -> bool:
    """Whether the operator orders a landing of what is nobody's."""
    unclear = progress.state is HandoverState.UNCLEAR and ordered(view, Order.LAND)
    return unclear and nobody_s(progress, view.vehicle)


def _stays(progress: Progress, view: HandoverView) -> str:
    """Return why the vehicle's failsafe, or who has it, is not waited for any longer; empty while it is."""
    vehicle, config = view.vehicle, progress.config
    unclear = progress.state is HandoverState.UNCLEAR
    if unclear and not nobody_s(progress, vehicle):
        return ""
    lands = vehicle is not None and vehicle.mode in profile_of(vehicle).landing
    begun_ns, limit_s = progress.since_ns, config.land_s if lands else config.climb_s
    if progress.resumes and not lands and progress.climb_ns is not None:
        begun_ns = progress.climb_ns
    if view.at_ns - begun_ns < round(limit_s * 1e9):
        return ""
    if unclear:
        mode = "" if vehicle is None else vehicle.mode
        return f"nobody has shown in {limit_s:g} s that he has the vehicle, which flies by itself ({mode})"
    acts = vehicle is None or fails(vehicle)
    became = "has not ended" if acts else "has ended, and nobody has taken the flight up again,"
    return f"{progress.who or Switcher.FAILSAFE} ({progress.left_mode}) {became} in {limit_s:g} s{progress.words}"


def _never_ready(progress: Progress, view: HandoverView) -> str:
    """Return why an ordered take-off will not begin; empty if it may, or none was ordered."""
    vehicle, limit_s = view.vehicle, progress.config.ground_s
    if progress.ordered_ns is None:
        return ""
    if vehicle is not None and vehicle.autopilot not in PROFILES:
        return f"take-off: how autopilot {vehicle.autopilot!r} takes off is not known; PX4 and ArduCopter are"
    if vehicle is not None and not vehicle.alone:
        return _ANOTHER
    if vehicle is not None and vehicle.armed:
        return f"take-off: {_ARMED}{_OR_ENGAGE if progress.stands_by else ''}"
    if view.at_ns - progress.ordered_ns < round(limit_s * 1e9):
        return ""
    missing = "the vehicle's heartbeats are missing" if view.moves else "the vehicle is silent"
    reason = "no vehicle is heard" if vehicle is None else view.unfit or missing
    return f"take-off: {reason} (waited {limit_s:g} s)"


def _around(progress: Progress, view: HandoverView, vehicle: VehicleStatus) -> GuardResult:
    """Return the event seen before, between and after flights."""
    ready = progress.state is HandoverState.READY and not (view.unfit or view.stop)
    if ready and progress.ordered_ns is not None and not vehicle.armed and vehicle.alone:
        return (
            GuardResult(HandoverEvent.TAKE_OFF)
            if vehicle.autopilot in PROFILES
            else GuardResult(HandoverEvent.DISARMED)
        )
    if ordered(view, Order.ENGAGE) and not against_engaging(progress.state, view):
        return GuardResult(HandoverEvent.ENGAGE)
    if progress.state is HandoverState.ENGAGED and progress.shows_the_past(vehicle):
        return GuardResult(HandoverEvent.EXTERNAL)
    if not vehicle.armed:
        return GuardResult(HandoverEvent.DISARMED)
    if progress.stands_by and not _has_started_since(progress, view):
        heard_ns = view.at_ns if progress.heard_ns is None else progress.heard_ns
        tells_not_yet = view.up_s is None and view.at_ns - heard_ns < CLOCK_NS
        return GuardResult(HandoverEvent.SILENCE) if tells_not_yet else GuardResult(HandoverEvent.LEFT, _LEFT)
    if vehicle.external:
        return GuardResult(HandoverEvent.EXTERNAL)
    if progress.state is HandoverState.ENGAGED:
        return _taken(progress, vehicle)
    # A text that says of a failsafe comes after the heartbeat that shows its mode, sometimes.
    guessed = progress.who in (Switcher.PILOT, Switcher.UNKNOWN) and view.at_ns - progress.since_ns < LATE_WORD_NS
    who = who_switched(vehicle) if guessed and progress.state is HandoverState.RELEASED else progress.who
    return GuardResult(HandoverEvent.OTHER, who=progress.who if who is Switcher.UNKNOWN else who)


def _has_started_since(progress: Progress, view: HandoverView) -> bool:
    """Whether the vehicle has started after the flight that an earlier daemon left: it is on another one."""
    if progress.flown_ns is None or view.up_s is None:
        return False
    return view.up_s / SLOWEST + LATEST_S < (view.at_ns - progress.flown_ns) / 1e9


def _for_mode(progress: Progress, view: HandoverView, vehicle: VehicleStatus) -> GuardResult:
    profile = profile_of(vehicle)
    if vehicle.armed:
        return _taken(progress, vehicle)
    if vehicle.alone and vehicle.mode == profile.take_off:
        return GuardResult(HandoverEvent.GRANTED)
    # A mode that nobody here asked for is the pilot's; the one of before may be that of a vehicle that is slow.
    if vehicle.alone and vehicle.mode not in (profile.take_off, progress.left_mode):
        return _taken(progress, vehicle)
    if _shows_granted(progress, vehicle, SHOWN_NS):
        return GuardResult(HandoverEvent.REFUSED, f"{progress.request.given_up(view.at_ns, at_once=True)}; {_OR_PILOT}")
    return GuardResult(HandoverEvent.PENDING)


def _shows_granted(progress: Progress, vehicle: VehicleStatus, after_ns: int = GRACE_NS) -> bool:
    """Whether the last heartbeat is from after the request was granted, and so shows what became of it."""
    granted_ns = progress.request.granted_ns
    return granted_ns is not None and vehicle.at_ns > granted_ns + after_ns


def _for_arming(progress: Progress, _view: HandoverView, vehicle: VehicleStatus) -> GuardResult:
    profile, granted_ns = profile_of(vehicle), progress.request.granted_ns
    # Disarmed it has not climbed, so it is not where PX4's climb ends.
    if vehicle.mode != profile.take_off and not (vehicle.armed and vehicle.mode in profile.climbing):
        return _taken(progress, vehicle)
    if profile.climbs_on_arming and granted_ns is not None:  # it climbs already
        return GuardResult(HandoverEvent.GRANTED, granted_ns=granted_ns)
    return GuardResult(HandoverEvent.GRANTED if vehicle.armed else HandoverEvent.PENDING)


def _at_climb(progress: Progress, view: HandoverView, vehicle: VehicleStatus) -> GuardResult:
    if not (vehicle.armed or progress.shows_the_past(vehicle)):
        return GuardResult(HandoverEvent.DISARMED, _DISARMED)
    profile = profile_of(vehicle)
    if vehicle.mode not in profile.climbing:
        return _taken(progress, vehicle)
    if vehicle.mode != profile.take_off and vehicle.landed and _climbed(progress, view, 0.0) < NONE:
        return _taken(progress, vehicle)  # no climb has ended on the ground
    share = _climbed(progress, view, LOOK_AHEAD_S if profile.climbs_on_arming else 0.0)
    ended = profile.climbs_on_arming and vehicle.mode != profile.take_off  # below the height: as high as it goes
    return GuardResult(
        HandoverEvent.GRANTED if share >= (LOW if ended else progress.config.reached) else HandoverEvent.PENDING
    )


def _climbed(progress: Progress, view: HandoverView, ahead_s: float) -> float:
    """Return the share of the height that will be reached `ahead_s` from now, by fresh positions."""
    if view.up_m is None or progress.ground_up_m is None or view.unfit:
        return 0.0
    return (view.up_m + ahead_s * view.up_mps - progress.ground_up_m) / progress.height_m


def _for_external(progress: Progress, _view: HandoverView, vehicle: VehicleStatus) -> GuardResult:
    if not (vehicle.armed or progress.shows_the_past(vehicle)):
        return GuardResult(HandoverEvent.DISARMED, _DISARMED)
    granted_ns = progress.request.granted_ns
    if vehicle.external or granted_ns is not None:
        return GuardResult(HandoverEvent.GRANTED, granted_ns=granted_ns)
    engaging = progress.state is HandoverState.ENGAGING
    if vehicle.mode == progress.left_mode or (engaging and vehicle.mode in profile_of(vehicle).climbing):
        return GuardResult(HandoverEvent.PENDING)
    return _taken(progress, vehicle)


def _at_failsafe(progress: Progress, view: HandoverView, vehicle: VehicleStatus) -> GuardResult:
    """Return the event seen in a failsafe on a flight that we began; the pilot may take over as at any other time."""
    if not vehicle.armed:
        return GuardResult(
            HandoverEvent.DISARMED,
            f"{progress.who or Switcher.FAILSAFE} ({progress.left_mode}) has landed it{progress.words}",
        )
    if ordered(view, Order.ENGAGE) and not against_engaging(progress.state, view):
        return GuardResult(HandoverEvent.ENGAGE)
    profile = profile_of(vehicle)
    if progress.resumes and vehicle.mode in profile.climbing:
        return GuardResult(HandoverEvent.GRANTED)
    stays = not profile.returns and vehicle.mode == progress.left_mode and not vehicle.stick
    # The external mode is not taken up again unasked: nobody knows whose doing it is.
    if vehicle.external or fails(vehicle) or stays:
        return GuardResult(HandoverEvent.PENDING)
    return _taken(progress, vehicle)


def _at_unclear(progress: Progress, view: HandoverView, vehicle: VehicleStatus) -> GuardResult:
    """Return the event seen while it is not known who has changed the mode: word of that may still come."""
    if not vehicle.armed:
        return GuardResult(HandoverEvent.DISARMED)
    if ordered(view, Order.ENGAGE) and not against_engaging(progress.state, view):
        return GuardResult(HandoverEvent.ENGAGE)
    seen = GuardResult(HandoverEvent.PENDING) if vehicle.external else _taken(progress, vehicle)
    return GuardResult(HandoverEvent.PENDING) if seen.seen is HandoverEvent.UNCLEAR else seen


def _at_landing(progress: Progress, _view: HandoverView, vehicle: VehicleStatus) -> GuardResult:
    """Return the event seen while the vehicle is asked to land (LANDING), and once it has shown that it does."""
    news, asking = vehicle.at_ns > progress.since_ns, progress.state is HandoverState.LANDING
    if not vehicle.armed:
        return GuardResult(HandoverEvent.DISARMED if news else HandoverEvent.PENDING)
    profile, ours = profile_of(vehicle), progress.ordered_ns is not None
    if vehicle.mode in profile.landing:
        # A failsafe lands only until it ends: what we took off is to land whatever comes.
        for_us = not (ours and fails(vehicle)) or progress.request.granted_ns is not None
        return GuardResult(HandoverEvent.GRANTED if asking and for_us else HandoverEvent.PENDING)
    if not news or (ours and fails(vehicle)):
        return GuardResult(HandoverEvent.PENDING)
    if asking:
        # Asked for in the middle of a climb, any mode of the climb may still be shown; after it was granted, only the
        # one of before may, for a while, by a vehicle that has not begun to land.
        passing = vehicle.external or vehicle.mode in profile.climbing
        for_ns = SHOWN_NS if vehicle.mode == progress.left_mode else GRACE_NS
        taken = not passing or _shows_granted(progress, vehicle, for_ns)
        return _taken(progress, vehicle) if taken else GuardResult(HandoverEvent.PENDING)
    if ours and progress.lands_failing and profile.climbs_on_arming and vehicle.mode == profile.take_off:
        shown = vehicle.at_ns > progress.since_ns + SHOWN_NS
        return GuardResult(HandoverEvent.FAILSAFE if shown else HandoverEvent.PENDING)
    return _taken(progress, vehicle)


_LOOKS: dict[HandoverState, Callable[[Progress, HandoverView, VehicleStatus], GuardResult]] = {
    HandoverState.MODE: _for_mode,
    HandoverState.ARMING: _for_arming,
    HandoverState.CLIMBING: _at_climb,
    HandoverState.ENGAGING: _for_external,
    HandoverState.RETURNING: _for_external,
    HandoverState.FAILSAFE: _at_failsafe,
    HandoverState.UNCLEAR: _at_unclear,
    HandoverState.LANDING: _at_landing,
    HandoverState.SETTLING: _at_landing,
}
