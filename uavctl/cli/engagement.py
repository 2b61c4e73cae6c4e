"""What `fly` and `loopback` ask of the hand-over: whether to arm and take off, when, and what came of it."""

from __future__ import annotations

import math

from rich.markup import escape

from uavctl.build import resting
from uavctl.build_mission import build_mission
from uavctl.cli.common import messages
from uavctl.config import Config
from uavctl.data import Command, ControlMode, Ending, Order, Vec3
from uavctl.errors import UsageError
from uavctl.loop import ControlLoop
from uavctl.mavlink.mode import State
from uavctl.smpc.conditioned_design import AnyDesign

AXES = ("north", "east", "down")
DOWN = 2


def goto_overrides(goto: str | None) -> tuple[str, ...]:
    """Configuration keys for `--goto x,y,z`: the place is the mission, so it is checked, and recorded, as one.

    Raises:
        UsageError: it is not three numbers.
    """
    if goto is None:
        return ()
    try:
        place = tuple(float(number) for number in goto.split(","))
    except ValueError:
        place = ()
    if len(place) != 3 or not all(map(math.isfinite, place)):
        raise UsageError(f"--goto {goto}: give north, east and down in local NED [m], as in --goto 2,1,-2 (up is < 0)")
    return (f"mission.waypoints={[list(place)]}", "mission.hold_s=0.0", "mission.trajectory={}", 'mission.then="hold"')


class Engagement:
    """From the command line's words to the order, and back to what became of it.

    Attributes:
        goal: the place of `--goto`, local NED [m].
        arrived: whether it has been reached.
        engaged: whether the controller has been in charge.

    Args:
        config: the configuration, `--goto` in it.
        take_off_m: height of the climb above the ground [m]; None leaves arming and modes to the pilot.
        goto: whether the mission is the place of `--goto`.
    """

    def __init__(self, config: Config, *, take_off_m: float | None, goto: bool) -> None:
        self._config = config
        self._take_off_m = take_off_m
        self.goal: Vec3 | None = config.mission.waypoints[0] if goto else None
        self._ordered = False
        self.engaged = False
        self.arrived = False

    @property
    def takes_off(self) -> bool:
        """Whether the vehicle is to be armed."""
        return self._take_off_m is not None

    def begin(self, loop: ControlLoop) -> None:
        """Say before the first tick what the flight is to do."""
        loop.course.takes_off = self.takes_off
        loop.course.goal = "" if self.goal is None else f"--goto {','.join(f'{x:g}' for x in self.goal)}"

    def follow(self, loop: ControlLoop) -> None:
        """Look at the tick that has just run; the first one gives the order to take off."""
        self.engaged = self.engaged or loop.who_flies is State.ENGAGED
        self._look_for_arrival(loop)
        loop.course.arrived = self.arrived
        if self._take_off_m is not None and not self._ordered:
            self._ordered = loop.order(Command(order=Order.TAKE_OFF, height_m=self._take_off_m))

    def _look_for_arrival(self, loop: ControlLoop) -> None:
        decision, estimate = loop.decision, loop.estimate
        if self.goal is None or decision is None or estimate is None or decision.mode is not ControlMode.TRACK:
            return
        plant = loop.plant
        where = [estimate.mean[index] for index in plant.position_index]
        goal = [self.goal[AXES.index(axis)] for axis in plant.axes]
        self.arrived = self.arrived or math.dist(where, goal) <= self._config.mission.accept_m


def stand_by(loop: ControlLoop, flown_ns: int) -> None:
    """Leave a vehicle alone that is found armed, and say so: the daemon before this one left it in flight.

    Args:
        loop: told so before its first tick.
        flown_ns: when that flight began; a vehicle that has started since is another one.
    """
    loop.order(Command(order=Order.STAND_BY, flown_ns=flown_ns))
    messages().print(
        "[bold yellow]warning:[/] the daemon before this one left the vehicle in flight; if it is still armed, and "
        "has not started anew since, nothing is sent until `uavctl ctl engage`",
        soft_wrap=True,
    )


def check_places(config: Config, design: AnyDesign, take_off_m: float | None, goal: Vec3 | None) -> None:
    """Refuse what the room has no place for, before anything is made for the flight, or sent.

    Raises:
        UsageError: the plant may not rest at the goal, or the climb would end above the room.
        DesignError: the mission does not fit the design.
    """
    if take_off_m is not None and "down" not in design.plant.axes:
        raise UsageError("--takeoff: the plant has no vertical axis, so it cannot tell how high it is; see plant.axes")
    if take_off_m is None and goal is None:
        return
    room = build_mission(config, design, resting(design)).room
    if room is None:
        raise UsageError("--takeoff, --goto: this plant cannot rest wherever it is sent; see plant")
    why = "" if goal is None else room.refusal(goal)
    if why:
        raise UsageError(f"--goto: {why}")
    if take_off_m is None:
        return
    highest_m = -float(room.lower[room.axes.index(DOWN)])
    if take_off_m > highest_m:
        raise UsageError(f"--takeoff {take_off_m:g}: above {highest_m:.2f} m it may not rest (sets.state_lower)")


def checked_take_off(arm: bool, takeoff: float | None) -> float | None:
    """The height of the climb, if the command line asks for one; neither word stands alone.

    Raises:
        UsageError: one of the two is missing.
    """
    if arm and takeoff is None:
        raise UsageError("--arm needs --takeoff HEIGHT: on the ground nothing else can be done with an armed vehicle")
    if takeoff is not None and not arm:
        raise UsageError("--takeoff needs --arm: say that the vehicle may be armed")
    return takeoff


def tell_ending(ending: Ending) -> None:
    """Say on the console how the flight ended."""
    style = "[bold]ended:[/]" if ending.as_ordered else "[bold red]ended:[/]"
    messages().print(f"{style} {escape(ending.sentence)}", soft_wrap=True)
    if ending.relay:
        messages().print(f"[bold]relay:[/] {escape(ending.relay)}", soft_wrap=True)
