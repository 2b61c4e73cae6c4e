"""Monitor of the box in a flight of `uavctl tune`: ends a motion that comes too near to a side, and repeats it smaller.

The controller plans inside the box with the model that it has, and an unknown vehicle may leave it. So each tick asks
of the estimate what a flight asks of the limits (`uavctl.flight.monitors.outside`): can the vehicle stop before?

    out + v REACTION_S + v² / (2 weakest a) > -RESERVE_M      the motion ends: back to the centre
    out + v REACTION_S + v² / (2 a)         > 0               the flight ends: brake, and the vehicle's own landing

out is how far it is beyond a side (negative inside), v the speed towards it, a the largest deceleration that is asked
for. The motion is repeated at half its size. Where that is smaller than the smallest step of any box, the flight ends,
too. All of it are orders, as those of an operator: the recording has them, and a replay is given them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from uavctl.build.controller import build_envelope, build_plant
from uavctl.config import Config
from uavctl.flight.context import read_position, read_velocity
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors.observation import Observation
from uavctl.flight.monitors.outside import REACTION_S, is_outside
from uavctl.lab.tune.excitation import LEAST_WAY_M, RESERVE_M, SafeBox
from uavctl.loop import ControlLoop
from uavctl.records import Command, ControlMode, Order, Ticked, Vec3
from uavctl.smpc.plant import AXES

WEAKEST = 0.5  # of the deceleration that is asked for: the least gain that a tuning takes over
KNOWN = 0.8  # the same of a tuned plant: a gain is taken over with a standard error of 0.1, and twice that is certain
SMALLER = 0.5  # times the size of a motion that did not stay inside
SMALLEST = 0.25  # of the least way, from the centre: the first step in the smallest box; a smaller one tells nothing
_BACK_S = 3.0  # for the way to the last place, before the time to hold it
_TAKEN_S = 1.0  # after which an order has been taken up
_MOVES = frozenset({Order.GOTO, Order.HOLD, Order.RESUME, Order.LAND})


def _only(axis: int, sides: Vec3, free: float) -> Vec3:
    """Return the side of one axis; the others are free."""
    north, east, down = (side if number == axis else free for number, side in enumerate(sides))
    return north, east, down


class BoxMonitor:
    """Follower of one flight; gives orders only once a motion has come too near to a side.

    Attributes:
        repeated: how many motions were ended and repeated smaller.
        why: why the flight was ended, and what to do; empty while it was not.

    Args:
        config: the configuration that is flown, with the excitation as its mission.
        box: where the vehicle is to stay.
        weakest: share of the deceleration asked for that it surely has.
    """

    def __init__(self, config: Config, box: SafeBox, weakest: float = WEAKEST) -> None:
        self._config, self._box, self._plant = config, box, build_plant(config)
        whole = replace(build_envelope(config, self._plant), lower_m=box.lower, upper_m=box.upper)
        north, east, down = (weakest * one for one in whole.brake_mps2)
        near = replace(whole, outside_m=(-RESERVE_M,) * 3, brake_mps2=(north, east, down))
        self._near = [
            replace(near, lower_m=_only(axis, box.lower, -math.inf), upper_m=_only(axis, box.upper, math.inf))
            for axis in range(3)
        ]
        self._leaving = replace(whole, outside_m=ZERO)
        self._places, self._last = config.mission.waypoints, len(config.mission.waypoints) - 1
        holds = config.mission.hold_s
        self._holds_s = holds if isinstance(holds, tuple) else (holds,) * len(self._places)
        self._scale = [1.0, 1.0, 1.0]
        self._number = 0  # of the place that is flown to, or comes next
        self._goal: Vec3 | None = None  # of our last order; None while the mission flies
        self._returns = False  # to the centre, before the motion is repeated
        self._ordered_ns = self._begun_ns = 0
        self._arrived_ns: int | None = None
        self._clear = True  # not too near since a motion was ended
        self._own: list[Command] = []
        self._ended = False
        self.repeated = 0
        self.why = ""

    def follow(self, loop: ControlLoop, ticked: Ticked) -> None:
        """Look at the tick that has just run. Once an operator orders, the flight is left to that person."""
        decision, estimate, at_ns = ticked.decision, ticked.estimate, ticked.decision.at_ns
        self._ended |= any(one.order in _MOVES and one not in self._own for one, _ in ticked.answers)
        if self._ended or estimate is None or decision.mode is not ControlMode.TRACK:
            return
        self._begun_ns = self._begun_ns or at_ns
        if self._goal is None and decision.waypoint is not None:
            self._number = decision.waypoint
        where, speed = read_position(estimate, self._plant), read_velocity(estimate, self._plant)
        seen = Observation(at_ns, (), ZERO, where, speed, None, braking=False)
        near = [axis for axis, one in enumerate(self._near) if is_outside(seen, one)]
        if is_outside(seen, self._leaving):
            self._end(loop, f"the vehicle was about to leave the box: {self._figures(seen)}")
        elif near and self._clear and self._number < self._last:
            self._turn_back(loop, seen, near)
        elif self._goal is not None:
            self._go_on(loop, decision.waypoint, where, at_ns)
        self._clear = not near

    def _turn_back(self, loop: ControlLoop, seen: Observation, near: Sequence[int]) -> None:
        """End a motion: back to the centre, and then the same at half the size in the axes that came too near."""
        for axis in near:
            sizes = [abs(self._offset(number)[axis]) for number in range(self._last)]
            # In an axis that only moves along, as where it swings from before, its smallest motion to come counts.
            size_m = sizes[self._number] or min(filter(None, sizes), default=0.0)
            self._scale[axis] *= SMALLER
            if SMALLER * size_m < SMALLEST * LEAST_WAY_M[axis]:
                name = f"a motion of {size_m:.2f} m {AXES[axis]}"
                self._end(loop, f"{name} came too near to a side of the box: {self._figures(seen)}")
                return
        self.repeated += 1
        self._returns = True
        self._go(loop, self._places[self._last], seen.at_ns)

    def _go_on(self, loop: ControlLoop, waypoint: int | None, where: Vec3, at_ns: int) -> None:
        """Fly the rest of the mission by orders, once a place has been reached and the pause there is over."""
        assert self._goal is not None
        if waypoint is not None and at_ns - self._ordered_ns > _TAKEN_S * 1e9:
            self._go(loop, self._goal, at_ns)  # the mission has started again, as after a pilot
        if self._arrived_ns is None and math.dist(where, self._goal) <= self._config.mission.accept_m:
            self._arrived_ns = at_ns
        late = at_ns - self._begun_ns > (self._config.duration_s - self._holds_s[-1] - _BACK_S) * 1e9
        if self._number < self._last and late:
            self._number, self._returns = self._last, False
            self._go(loop, self._places[self._last], at_ns)
        if self._arrived_ns is None or at_ns - self._arrived_ns < self._holds_s[self._number] * 1e9:
            return
        if self._number == self._last:
            if self._config.mission.then == "land":
                self._order(loop, Command(order=Order.LAND))
            self._ended = True
            return
        self._number += not self._returns
        self._returns = False
        north, east, down = (
            round(at + off, 3) for at, off in zip(self._places[self._last], self._offset(self._number), strict=True)
        )
        self._go(loop, (north, east, down), at_ns)

    def _end(self, loop: ControlLoop, why: str) -> None:
        self._order(loop, Command(order=Order.LAND))
        self._ended = True
        self.why = (
            f"{why}. Give a larger box, or lower limits.accel_mps2 and the speeds of [sets], or correct lag, gain and "
            "drag of [plant] by what the first part of this flight shows (`uavctl identify`)"
        )

    def _figures(self, seen: Observation) -> str:
        """Return how near it is to the side that it would reach first, and how fast."""
        assert seen.position_m is not None
        sides = zip(AXES, seen.position_m, seen.velocity_mps, self._box.lower, self._box.upper, strict=True)
        left_m, speed_mps, axis = min(
            (
                side
                for axis, at, speed, low, high in sides
                for side in ((at - low, -speed, axis), (high - at, speed, axis))
            ),
            key=lambda side: side[0] - REACTION_S * max(side[1], 0.0),
        )
        where = f"{left_m:.2f} m inside" if left_m >= 0.0 else f"{-left_m:.2f} m beyond"
        return f"{where} in {axis}, at {speed_mps:.1f} m/s outwards"

    def _offset(self, number: int) -> Vec3:
        """Return a place of the mission from the centre, at its present size [m]."""
        rows = zip(self._places[number], self._places[self._last], self._scale, strict=True)
        north, east, down = (round(scale * (place - centre), 3) for place, centre, scale in rows)
        return north, east, down

    def _go(self, loop: ControlLoop, place: Vec3, at_ns: int) -> None:
        self._goal, self._ordered_ns, self._arrived_ns = place, at_ns, None
        self._order(loop, Command(order=Order.GOTO, position_m=place))

    def _order(self, loop: ControlLoop, command: Command) -> None:
        self._own.append(command)
        loop.order(command)
