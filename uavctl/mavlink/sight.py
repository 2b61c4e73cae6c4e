"""What a tick sees of the vehicle, in the words of the table of `mode.py`. Pure: all that it goes by is an argument."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import msgspec

from uavctl.config.hand_over import HandOverConfig
from uavctl.data import Command, Order, VehicleStatus
from uavctl.mavlink.messages import Ack, Text
from uavctl.mavlink.mode import Seen, State
from uavctl.mavlink.modes import HABITS, Habits
from uavctl.mavlink.request import Request

HEARTBEAT_TIMEOUT_NS = 3_000_000_000
# A heartbeat may have been under way when arming or the external mode was granted: PX4 shows it up to a second later.
GRACE_NS = 300_000_000
LOOK_AHEAD_S = 0.5  # from asking for the external mode in a climb to the first braking: answer, news, the vehicle's lag
SHOWN_NS = 2_000_000_000  # a heartbeat shows by then that landing was asked for
LOW = 0.3  # share of the take-off height below which a climb that has ended was none
LEAVING = frozenset({State.MODE, State.ARMING, State.CLIMBING, State.ENGAGING})
_UNDER_WAY = LEAVING | {State.RETURNING, State.FAILSAFE}  # here the operator's end of the flight asks for landing, too
ASKING = _UNDER_WAY | {State.LANDING}
CLOCK_NS = 5_000_000_000  # in which a vehicle that is found armed tells how long ago it started
# A simulated vehicle's clock may be slow, so that it seems to have started later than it has.
SLOWEST, LATEST_S = 0.8, 1.0
_ANOTHER = "another vehicle is heard on this link: nothing is armed; give each its own link"
_ARMED = (
    "the vehicle is armed already; it begins on the ground, disarmed. Land and disarm it, or start without --arm "
    "--takeoff to fly it from where it is"
)
_OR_ENGAGE = ", and ask for that with `uavctl ctl engage`"
_DISARMED = "the vehicle has disarmed itself"
_LEFT = "a daemon before this one has left the vehicle in flight: nothing is sent until `uavctl ctl engage`"


class View(msgspec.Struct, frozen=True, kw_only=True):
    """What the hand-over knows in a tick.

    Attributes:
        at_ns: Time of the tick.
        vehicle: The vehicle's latest status; None before the first.
        up_s: How long ago it started [s]; None if it does not tell.
        ready: The controller has a setpoint; without one no neutral stream invites the pilot.
        land: The controller asks for landing.
        stop: The operator asks for the end.
        unfit: Why nothing may be armed now; empty if it may.
        up_m: Height of the estimate in local NED [m]; None without one.
        up_mps: How fast it climbs [m/s].
        heard: The vehicle's answers and words since the last tick.
        commands: The operator's orders.
    """

    at_ns: int
    vehicle: VehicleStatus | None
    ready: bool
    up_s: float | None = None
    land: bool = False
    stop: bool = False
    unfit: str = ""
    up_m: float | None = None
    up_mps: float = 0.0
    heard: tuple[Ack | Text, ...] = ()
    commands: tuple[Command, ...] = ()


@dataclass(kw_only=True)
class Progress:
    """How far the hand-over has come.

    Attributes:
        config: Times and bounds.
        request: What is asked for, or waited for.
        state: Place in the table.
        since_ns: When it was entered [ns].
        ordered_ns: When take-off was ordered [ns]; None if it was not.
        height_m: Height of the climb that was ordered [m].
        ground_up_m: Height of the estimate before it was armed [m].
        left_mode: The mode that is to be left for the external one, after a release; or that a failsafe chose.
        climb_ns: When the climb began first [ns]; None before.
        resumes: The failsafe that acts ended the climb, not the flight.
        words: What the vehicle said before its failsafe acted.
        granted_ns: When arming or the external mode was granted, ahead of the heartbeat [ns].
        boots: Times that the vehicle had started anew by the last tick.
        stands_by: A vehicle that is found armed is left alone.
        flown_ns: When the flight that it is left from began [ns]; None if that is not known.
        heard_ns: When the vehicle was heard first [ns]; None if it was not.
    """

    config: HandOverConfig
    request: Request
    state: State = State.WAITING
    since_ns: int = 0
    ordered_ns: int | None = None
    height_m: float = 0.0
    ground_up_m: float | None = None
    left_mode: str = ""
    climb_ns: int | None = None
    resumes: bool = False
    words: str = ""
    granted_ns: int | None = None
    boots: int = 0
    stands_by: bool = False
    flown_ns: int | None = None
    heard_ns: int | None = None

    def shows_the_past(self, vehicle: VehicleStatus) -> bool:
        """Whether the last heartbeat may be from before arming or the external mode was granted."""
        return self.granted_ns is not None and vehicle.at_ns <= self.granted_ns + GRACE_NS


class Sight(msgspec.Struct, frozen=True):
    """What is seen, and why, where that has to be told.

    Attributes:
        seen: In the words of the table.
        why: Why something failed.
        granted_ns: When it was granted, if a heartbeat does not show it yet [ns].
    """

    seen: Seen
    why: str = ""
    granted_ns: int | None = None


def silent(at_ns: int, vehicle: VehicleStatus | None) -> bool:
    """Whether there is no heartbeat, or the last one is too old."""
    return vehicle is None or at_ns - vehicle.at_ns > HEARTBEAT_TIMEOUT_NS


def habits_of(vehicle: VehicleStatus) -> Habits:
    """The autopilot's habits; those of PX4 for one that is not known, which is never asked for a mode."""
    return HABITS.get(vehicle.autopilot, HABITS["px4"])


def ordered(view: View, order: Order) -> bool:
    """Whether this tick brings an order."""
    return any(command.order is order for command in view.commands)


def fails(vehicle: VehicleStatus) -> bool:
    """Whether a failsafe of its own has chosen its mode: it says that one acts, in a mode that they choose."""
    return vehicle.failsafe and vehicle.mode in habits_of(vehicle).failsafes


def against_engaging(state: State, view: View) -> str:
    """Why the external mode must not be asked for again; empty if it may."""
    vehicle = view.vehicle
    if state not in (State.READY, State.RELEASED, State.FAILSAFE):
        return f"there is nothing to engage; now: {state}"
    if vehicle is None or silent(view.at_ns, vehicle) or vehicle.autopilot not in HABITS:
        return "no vehicle is heard that could be flown"
    if not vehicle.armed or vehicle.landed:
        return "the vehicle is not in the air"
    return view.unfit


def against_moving(state: State, vehicle: VehicleStatus | None) -> str:
    """Why an order of where to fly would come to nothing; empty if it is we who fly."""
    if state is State.ENGAGED:
        return ""
    if state is State.WAITING or vehicle is None:
        return "no vehicle is heard"
    mode = vehicle.mode
    if state is State.READY:
        return f"it is not we who fly: the vehicle is in mode {mode}, and the pilot has not switched"
    if state in LEAVING:
        return f"the vehicle is on its way up ({state}); order it once it is flown"
    if state in (State.FAILSAFE, State.RELEASED, State.RETURNING):
        whose = "a failsafe of its own" if state is State.FAILSAFE else "the pilot"
        return f"{whose} has the vehicle, in mode {mode}; `uavctl ctl engage` asks for it back"
    return f"the vehicle has been handed over ({state})"


def look(progress: Progress, view: View) -> Sight:
    """What a tick sees; of several things the first in the order of `Seen`."""
    vehicle, state = view.vehicle, progress.state
    if vehicle is not None and vehicle.boots > progress.boots and state is not State.WAITING:
        return Sight(Seen.REBOOT, "the vehicle has started anew")
    if view.land or (state in _UNDER_WAY and (view.stop or ordered(view, Order.LAND))):
        return Sight(Seen.LAND)
    if state is State.ENGAGED and view.stop and not view.ready and progress.ordered_ns is not None:
        return Sight(Seen.LAND)  # the controller has ended without a landing, and nobody else has what we took off
    there = Sight(Seen.SILENCE)
    if vehicle is not None and not silent(view.at_ns, vehicle):
        there = _LOOKS.get(state, _around)(progress, view, vehicle)
    taken = state is State.FAILSAFE and there.seen is Seen.OTHER  # time is up, but the pilot has it: nothing is asked
    if there.seen is Seen.GRANTED or taken:
        return there
    why = _given_up(progress, view)
    return Sight(Seen.REFUSED, why) if why else there


def _given_up(progress: Progress, view: View) -> str:
    state, vehicle = progress.state, view.vehicle
    if state in (State.WAITING, State.READY):
        return _never_ready(progress, view)
    if state in (State.MODE, State.ARMING) and vehicle is not None and not vehicle.alone:
        return _ANOTHER
    if state is State.FAILSAFE:
        return _failsafe_stays(progress, view)
    waits = state in ASKING or state is State.SETTLING
    return progress.request.given_up(view.at_ns) if waits else ""


def _failsafe_stays(progress: Progress, view: View) -> str:
    """Why the vehicle's failsafe is not waited for any longer; empty while it is."""
    vehicle, config = view.vehicle, progress.config
    lands = vehicle is not None and vehicle.mode in habits_of(vehicle).landing
    begun_ns, limit_s = progress.since_ns, config.land_s if lands else config.climb_s
    if progress.resumes and not lands and progress.climb_ns is not None:
        begun_ns = progress.climb_ns
    if view.at_ns - begun_ns < round(limit_s * 1e9):
        return ""
    acts = vehicle is None or fails(vehicle)
    became = "has not ended" if acts else "has ended, and nobody has taken the flight up again,"
    return f"the vehicle's own failsafe ({progress.left_mode}) {became} in {limit_s:g} s{progress.words}"


def _never_ready(progress: Progress, view: View) -> str:
    """Why an ordered take-off will not begin; empty if it may, or none was ordered."""
    vehicle, limit_s = view.vehicle, progress.config.ground_s
    if progress.ordered_ns is None:
        return ""
    if vehicle is not None and vehicle.autopilot not in HABITS:
        return f"take-off: how autopilot {vehicle.autopilot!r} takes off is not known; PX4 and ArduCopter are"
    if vehicle is not None and not vehicle.alone:
        return _ANOTHER
    if vehicle is not None and vehicle.armed:
        return f"take-off: {_ARMED}{_OR_ENGAGE if progress.stands_by else ''}"
    if view.at_ns - progress.ordered_ns < round(limit_s * 1e9):
        return ""
    reason = "no vehicle is heard" if vehicle is None else view.unfit or "the vehicle is silent"
    return f"take-off: {reason} (waited {limit_s:g} s)"


def _around(progress: Progress, view: View, vehicle: VehicleStatus) -> Sight:
    """Before, between and after flights."""
    ready = progress.state is State.READY and not (view.unfit or view.stop)
    if ready and progress.ordered_ns is not None and not vehicle.armed and vehicle.alone:
        return Sight(Seen.TAKE_OFF) if vehicle.autopilot in HABITS else Sight(Seen.DISARMED)
    if ordered(view, Order.ENGAGE) and not against_engaging(progress.state, view):
        return Sight(Seen.ENGAGE)
    if progress.state is State.ENGAGED and progress.shows_the_past(vehicle):
        return Sight(Seen.EXTERNAL)
    if not vehicle.armed:
        return Sight(Seen.DISARMED)
    if progress.stands_by and not _has_started_since(progress, view):
        heard_ns = view.at_ns if progress.heard_ns is None else progress.heard_ns
        tells_not_yet = view.up_s is None and view.at_ns - heard_ns < CLOCK_NS
        return Sight(Seen.SILENCE) if tells_not_yet else Sight(Seen.LEFT, _LEFT)
    if vehicle.external:
        return Sight(Seen.EXTERNAL)
    ours = progress.state is State.ENGAGED and progress.ordered_ns is not None
    return Sight(Seen.FAILSAFE if ours and fails(vehicle) else Seen.OTHER)


def _has_started_since(progress: Progress, view: View) -> bool:
    """Whether the vehicle has started after the flight that a daemon before left: it is on another one."""
    if progress.flown_ns is None or view.up_s is None:
        return False
    return view.up_s / SLOWEST + LATEST_S < (view.at_ns - progress.flown_ns) / 1e9


def _for_mode(_progress: Progress, _view: View, vehicle: VehicleStatus) -> Sight:
    if vehicle.armed:
        return Sight(Seen.OTHER)
    there = vehicle.alone and vehicle.mode == habits_of(vehicle).take_off
    return Sight(Seen.GRANTED if there else Seen.PENDING)


def _for_arming(progress: Progress, _view: View, vehicle: VehicleStatus) -> Sight:
    habits, granted_ns = habits_of(vehicle), progress.request.granted_ns
    if vehicle.mode not in habits.climbing:
        return Sight(Seen.FAILSAFE if vehicle.armed and fails(vehicle) else Seen.OTHER)
    if habits.climbs_on_arming and granted_ns is not None:  # it climbs already
        return Sight(Seen.GRANTED, granted_ns=granted_ns)
    return Sight(Seen.GRANTED if vehicle.armed else Seen.PENDING)


def _at_climb(progress: Progress, view: View, vehicle: VehicleStatus) -> Sight:
    if not (vehicle.armed or progress.shows_the_past(vehicle)):
        return Sight(Seen.DISARMED, _DISARMED)
    habits = habits_of(vehicle)
    if vehicle.mode not in habits.climbing:
        return Sight(Seen.FAILSAFE if fails(vehicle) else Seen.OTHER)
    share = _climbed(progress, view, LOOK_AHEAD_S if habits.climbs_on_arming else 0.0)
    ended = habits.climbs_on_arming and vehicle.mode != habits.take_off  # below the height: as high as it goes
    return Sight(Seen.GRANTED if share >= (LOW if ended else progress.config.reached) else Seen.PENDING)


def _climbed(progress: Progress, view: View, ahead_s: float) -> float:
    """Share of the height that will have been reached in a moment, by fresh positions."""
    if view.up_m is None or progress.ground_up_m is None or view.unfit:
        return 0.0
    return (view.up_m + ahead_s * view.up_mps - progress.ground_up_m) / progress.height_m


def _for_external(progress: Progress, _view: View, vehicle: VehicleStatus) -> Sight:
    if not (vehicle.armed or progress.shows_the_past(vehicle)):
        return Sight(Seen.DISARMED, _DISARMED)
    granted_ns = progress.request.granted_ns
    if vehicle.external or granted_ns is not None:
        return Sight(Seen.GRANTED, granted_ns=granted_ns)
    engaging = progress.state is State.ENGAGING
    if vehicle.mode == progress.left_mode or (engaging and vehicle.mode in habits_of(vehicle).climbing):
        return Sight(Seen.PENDING)
    return Sight(Seen.FAILSAFE if engaging and fails(vehicle) else Seen.OTHER)


def _at_failsafe(progress: Progress, view: View, vehicle: VehicleStatus) -> Sight:
    """On a flight that we began; that the pilot may take over is no different from any other time."""
    if not vehicle.armed:
        return Sight(Seen.DISARMED, f"the vehicle's own failsafe ({progress.left_mode}) has landed it{progress.words}")
    if ordered(view, Order.ENGAGE) and not against_engaging(progress.state, view):
        return Sight(Seen.ENGAGE)
    habits = habits_of(vehicle)
    if progress.resumes and vehicle.mode in habits.climbing:
        return Sight(Seen.GRANTED)
    stays = not habits.returns and vehicle.mode == progress.left_mode
    # The external mode is not taken up again unasked: nobody knows whose doing it is.
    return Sight(Seen.PENDING if vehicle.external or fails(vehicle) or stays else Seen.OTHER)


def _at_landing(progress: Progress, _view: View, vehicle: VehicleStatus) -> Sight:
    news = vehicle.at_ns > progress.since_ns
    if not vehicle.armed:
        return Sight(Seen.DISARMED if news else Seen.PENDING)
    habits, asking = habits_of(vehicle), progress.state is State.LANDING
    ours = progress.ordered_ns is not None
    if vehicle.mode in habits.landing:
        # A failsafe lands only until it ends: what we took off is to land whatever comes.
        for_us = not (ours and fails(vehicle)) or progress.request.granted_ns is not None
        return Sight(Seen.GRANTED if asking and for_us else Seen.PENDING)
    if ours and not asking and habits.climbs_on_arming and vehicle.mode == habits.take_off:
        return Sight(Seen.FAILSAFE if vehicle.at_ns > progress.since_ns + SHOWN_NS else Seen.PENDING)
    # Asked for in the middle of a climb, any mode of the climb may still be shown.
    passing = vehicle.external or vehicle.mode in habits.climbing or (ours and fails(vehicle))
    return Sight(Seen.PENDING if passing or not news else Seen.OTHER)


_LOOKS: dict[State, Callable[[Progress, View, VehicleStatus], Sight]] = {
    State.MODE: _for_mode,
    State.ARMING: _for_arming,
    State.CLIMBING: _at_climb,
    State.ENGAGING: _for_external,
    State.RETURNING: _for_external,
    State.FAILSAFE: _at_failsafe,
    State.LANDING: _at_landing,
    State.SETTLING: _at_landing,
}
