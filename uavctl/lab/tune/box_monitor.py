"""Monitor of the box in a flight of `uavctl tune`: ends a motion that comes too near to a side, and repeats it smaller.

The controller plans inside the box with its model, and an unknown vehicle may leave the box. So each tick checks, as a
flight does for its limits (`uavctl.flight.monitors.outside`), whether the vehicle can stop inside:

    out + v REACTION_S + v² / (2 s a) > -RESERVE_M      the motion ends: back to the centre
    out + v REACTION_S + v² / (2 a)   > 0               the flight ends: brake, and the vehicle's own landing

out is the distance beyond a side (negative inside), v the speed towards it, a the largest commanded deceleration, and s
the share of a that the vehicle surely has (`brake_share`). The motion is repeated at half its size. If that is smaller
than the smallest step of any box, the flight ends. The monitor acts by orders, as an operator does, so a recording and
its replay have them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from uavctl.config import Config
from uavctl.flight.context import read_position, read_velocity
from uavctl.flight.limits import ZERO
from uavctl.flight.monitors.observation import Observation
from uavctl.flight.monitors.outside import REACTION_S, is_outside
from uavctl.lab.tune.excitation import MIN_STEP_M, RESERVE_M, SafeBox
from uavctl.loop import ControlLoop
from uavctl.records import Command, ControlMode, Order, Ticked, Vec3
from uavctl.smpc.plant import AXES
from uavctl.wiring.controller import build_envelope, build_plant

MIN_BRAKE_SHARE = 0.5  # of the commanded deceleration: the least gain that a tuning adopts
# The same of a tuned plant: an adopted gain has a standard error of at most 0.1, of which this takes two
TUNED_BRAKE_SHARE = 0.8
REPEAT_SCALE = 0.5  # times the size of a motion that did not stay inside
# Of the least step, from the centre: the first step in the smallest box; a smaller one shows nothing
MIN_REPEAT_SHARE = 0.25
_RETURN_S = 3.0  # time to fly to the last waypoint, before its hold
_ORDER_DELAY_S = 1.0  # after which an order must have taken effect
_MOTION_ORDERS = frozenset({Order.GOTO, Order.HOLD, Order.RESUME, Order.LAND})


def _restrict_to_axis(axis: int, sides: Vec3, free: float) -> Vec3:
    """Return the side of one axis; the others are free."""
    north, east, down = (side if number == axis else free for number, side in enumerate(sides))
    return north, east, down


class BoxMonitor:
    """Follower of one flight; it gives orders only after a motion came too near to a side.

    Attributes:
        repeated: number of motions that were ended and repeated smaller.
        reason: why the flight was ended, and the remedy; empty while it was not.

    Args:
        config: the configuration that is flown, with the excitation as its mission.
        box: region that the vehicle must not leave.
        brake_share: share of the commanded deceleration that the vehicle surely has.
    """

    def __init__(self, config: Config, box: SafeBox, brake_share: float = MIN_BRAKE_SHARE) -> None:
        self._config, self._box, self._plant = config, box, build_plant(config)
        envelope = replace(build_envelope(config, self._plant), lower_m=box.lower, upper_m=box.upper)
        north, east, down = (brake_share * deceleration for deceleration in envelope.brake_mps2)
        near_envelope = replace(envelope, outside_m=(-RESERVE_M,) * 3, brake_mps2=(north, east, down))
        self._near_envelopes = [
            replace(
                near_envelope,
                lower_m=_restrict_to_axis(axis, box.lower, -math.inf),
                upper_m=_restrict_to_axis(axis, box.upper, math.inf),
            )
            for axis in range(3)
        ]
        self._leaving_envelope = replace(envelope, outside_m=ZERO)
        self._waypoints, self._last_index = config.mission.waypoints, len(config.mission.waypoints) - 1
        holds = config.mission.hold_s
        self._holds_s = holds if isinstance(holds, tuple) else (holds,) * len(self._waypoints)
        self._scale = [1.0, 1.0, 1.0]
        self._index = 0  # of the waypoint that is flown to, or comes next
        self._goal: Vec3 | None = None  # position of our last order; None while the mission flies
        self._is_returning = False  # whether it flies to the centre before it repeats a motion
        self._ordered_ns = self._start_ns = 0
        self._arrived_ns: int | None = None
        self._is_clear = True  # whether the vehicle was away from all sides since the last ended motion
        self._commands: list[Command] = []
        self._has_ended = False
        self.repeated = 0
        self.reason = ""

    def handle_tick(self, loop: ControlLoop, ticked: Ticked) -> None:
        """Check the tick that has just run; do nothing more once an operator has given an order."""
        decision, estimate, at_ns = ticked.decision, ticked.estimate, ticked.decision.at_ns
        self._has_ended |= any(
            command.order in _MOTION_ORDERS and command not in self._commands for command, _ in ticked.answers
        )
        if self._has_ended or estimate is None or decision.mode is not ControlMode.TRACK:
            return
        self._start_ns = self._start_ns or at_ns
        if self._goal is None and decision.waypoint is not None:
            self._index = decision.waypoint
        position_m, velocity = read_position(estimate, self._plant), read_velocity(estimate, self._plant)
        observation = Observation(at_ns, (), ZERO, position_m, velocity, None, braking=False)
        near_axes = [
            axis for axis, near_envelope in enumerate(self._near_envelopes) if is_outside(observation, near_envelope)
        ]
        if is_outside(observation, self._leaving_envelope):
            self._end_flight(loop, f"the vehicle was about to leave the box: {self._describe_distance(observation)}")
        elif near_axes and self._is_clear and self._index < self._last_index:
            self._abort_motion(loop, observation, near_axes)
        elif self._goal is not None:
            self._continue_mission(loop, decision.waypoint, position_m, at_ns)
        self._is_clear = not near_axes

    def _abort_motion(self, loop: ControlLoop, observation: Observation, near_axes: Sequence[int]) -> None:
        """End a motion: fly to the centre, then repeat it at half the size in the axes that came too near."""
        for axis in near_axes:
            sizes = [abs(self._get_offset(number)[axis]) for number in range(self._last_index)]
            # An axis without a motion of its own still swings from an earlier one; then its smallest motion counts.
            size_m = sizes[self._index] or min(filter(None, sizes), default=0.0)
            self._scale[axis] *= REPEAT_SCALE
            if REPEAT_SCALE * size_m < MIN_REPEAT_SHARE * MIN_STEP_M[axis]:
                motion = f"a motion of {size_m:.2f} m {AXES[axis]}"
                self._end_flight(
                    loop, f"{motion} came too near to a side of the box: {self._describe_distance(observation)}"
                )
                return
        self.repeated += 1
        self._is_returning = True
        self._order_goto(loop, self._waypoints[self._last_index], observation.at_ns)

    def _continue_mission(self, loop: ControlLoop, waypoint: int | None, position_m: Vec3, at_ns: int) -> None:
        """Fly the rest of the mission by orders: the next one after each waypoint is reached and its pause is over."""
        assert self._goal is not None
        if waypoint is not None and at_ns - self._ordered_ns > _ORDER_DELAY_S * 1e9:
            self._order_goto(loop, self._goal, at_ns)  # the mission has started again, as after a pilot
        if self._arrived_ns is None and math.dist(position_m, self._goal) <= self._config.mission.accept_m:
            self._arrived_ns = at_ns
        is_overdue = at_ns - self._start_ns > (self._config.duration_s - self._holds_s[-1] - _RETURN_S) * 1e9
        if self._index < self._last_index and is_overdue:
            self._index, self._is_returning = self._last_index, False
            self._order_goto(loop, self._waypoints[self._last_index], at_ns)
        if self._arrived_ns is None or at_ns - self._arrived_ns < self._holds_s[self._index] * 1e9:
            return
        if self._index == self._last_index:
            if self._config.mission.then == "land":
                self._send(loop, Command(order=Order.LAND))
            self._has_ended = True
            return
        self._index += not self._is_returning
        self._is_returning = False
        north, east, down = (
            round(centre + offset, 3)
            for centre, offset in zip(self._waypoints[self._last_index], self._get_offset(self._index), strict=True)
        )
        self._order_goto(loop, (north, east, down), at_ns)

    def _end_flight(self, loop: ControlLoop, reason: str) -> None:
        self._send(loop, Command(order=Order.LAND))
        self._has_ended = True
        self.reason = (
            f"{reason}. Give a larger box, or lower limits.accel_mps2 and the speeds of [sets], or correct lag, gain "
            "and drag of [plant] by the first part of this flight (`uavctl identify`)"
        )

    def _describe_distance(self, observation: Observation) -> str:
        """Describe distance and speed towards the side that the vehicle would reach first."""
        assert observation.position_m is not None
        sides = zip(
            AXES, observation.position_m, observation.velocity_mps, self._box.lower, self._box.upper, strict=True
        )
        left_m, speed_mps, axis = min(
            (
                side
                for axis, position, speed, low, high in sides
                for side in ((position - low, -speed, axis), (high - position, speed, axis))
            ),
            key=lambda side: side[0] - REACTION_S * max(side[1], 0.0),
        )
        distance = f"{left_m:.2f} m inside" if left_m >= 0.0 else f"{-left_m:.2f} m beyond"
        return f"{distance} in {axis}, at {speed_mps:.1f} m/s outwards"

    def _get_offset(self, index: int) -> Vec3:
        """Return a waypoint relative to the centre, at the present scale [m]."""
        rows = zip(self._waypoints[index], self._waypoints[self._last_index], self._scale, strict=True)
        north, east, down = (round(scale * (waypoint - centre), 3) for waypoint, centre, scale in rows)
        return north, east, down

    def _order_goto(self, loop: ControlLoop, position_m: Vec3, at_ns: int) -> None:
        self._goal, self._ordered_ns, self._arrived_ns = position_m, at_ns, None
        self._send(loop, Command(order=Order.GOTO, position_m=position_m))

    def _send(self, loop: ControlLoop, command: Command) -> None:
        self._commands.append(command)
        loop.order(command)
