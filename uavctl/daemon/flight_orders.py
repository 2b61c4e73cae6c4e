"""Orders with which a flight begins: take-off, a position to go to; and the time limit of its end."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from uavctl.config import Config
from uavctl.errors import UsageError
from uavctl.flight.cells import REST_NS
from uavctl.flight.mission import RestRegion
from uavctl.loop import ControlLoop
from uavctl.mavlink.handover_guards import LAND_PERIODS
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Command, ControlMode, Order, Ticked, Vec3
from uavctl.smpc.conditioned.design import AnyDesign
from uavctl.smpc.plant import AXES
from uavctl.wiring.controller import compute_reference_limits
from uavctl.wiring.mission import build_mission

DOWN = 2
LANDING_S = 10.0  # after braking: for the landing request
TickFollower = Callable[[ControlLoop, Ticked], None]


def make_goto_keys(place_m: Sequence[float]) -> dict[str, object]:
    """Return configuration keys that make a position in local NED [m] the mission, checked and recorded like one.

    Raises:
        UsageError: it is not three finite numbers.
    """
    if len(place_m) != 3 or not all(map(math.isfinite, place_m)):
        raise UsageError(f"goto {place_m}: give north, east and down in local NED [m], as in 2, 1, -2 (up is < 0)")
    return {
        "mission.waypoints": [[float(coordinate) for coordinate in place_m]],
        "mission.hold_s": 0.0,
        "mission.trajectory": {},
        "mission.then": "hold",
    }


class FlightOrders:
    """Orders with which a flight begins (take-off, position to go to), and their progress.

    Attributes:
        goal: the position of `--goto`, local NED [m].
        has_arrived: whether the vehicle has reached it.
        has_engaged: whether the controller has been in control.

    Args:
        config: the configuration, `--goto` in it.
        take_off_m: height of the climb above the ground [m]; None leaves arming and modes to the pilot.
        goto: whether the mission is the position of `--goto`.
        follower: called after each tick; it may give orders.
        waits_for_fleet: whether the take-off is only ordered once `permit_take_off` was called.
    """

    def __init__(
        self,
        config: Config,
        *,
        take_off_m: float | None,
        goto: bool,
        follower: TickFollower | None = None,
        waits_for_fleet: bool = False,
    ) -> None:
        self._config = config
        self._take_off_m = take_off_m
        self._follower = follower
        self.goal: Vec3 | None = config.mission.waypoints[0] if goto else None
        self._is_take_off_ordered = False
        self._is_take_off_permitted = not waits_for_fleet
        self.has_engaged = False
        self.has_arrived = False

    @property
    def takes_off(self) -> bool:
        """Whether the flight arms the vehicle and takes off."""
        return self._take_off_m is not None

    def begin(self, loop: ControlLoop) -> None:
        """Note the orders in the account of the flight, before the first tick."""
        loop.account.takes_off = self.takes_off
        loop.account.goal = "" if self.goal is None else f"--goto {','.join(f'{x:g}' for x in self.goal)}"

    def handle_tick(self, loop: ControlLoop, ticked: Ticked) -> None:
        """Update after a tick; once it is permitted, order the take-off."""
        self.has_engaged = self.has_engaged or loop.handover_state is HandoverState.ENGAGED
        self._check_arrival(loop, ticked)
        loop.account.has_arrived = self.has_arrived
        is_due = self._is_take_off_permitted and not self._is_take_off_ordered
        if self._take_off_m is not None and is_due:
            self._is_take_off_ordered = loop.order(Command(order=Order.TAKE_OFF, height_m=self._take_off_m))
        if self._follower is not None:
            self._follower(loop, ticked)

    def permit_take_off(self) -> None:
        """Permit the take-off."""
        self._is_take_off_permitted = True

    def _check_arrival(self, loop: ControlLoop, ticked: Ticked) -> None:
        estimate = ticked.estimate
        if self.goal is None or estimate is None or ticked.decision.mode is not ControlMode.TRACK:
            return
        plant = loop.plant
        position = [estimate.mean[index] for index in plant.position_index]
        goal = [self.goal[AXES.index(axis)] for axis in plant.axes]
        self.has_arrived = self.has_arrived or math.dist(position, goal) <= self._config.mission.accept_m


def check_places(config: Config, design: AnyDesign, take_off_m: float | None, goal: Vec3 | None) -> None:
    """Refuse positions outside the room, before the flight is prepared.

    Raises:
        UsageError: the plant may not rest at the goal, or the climb would end above the room.
        DesignError: the mission does not fit the design.
    """
    if take_off_m is None and goal is None:
        return
    region = build_mission(config, design, compute_reference_limits(design)).rest_region
    refusal = "" if take_off_m is None else explain_height_refusal(region, take_off_m)
    if refusal:
        raise UsageError(refusal)
    if goal is not None and region is None:
        raise UsageError("goto: this plant cannot rest at every target; see plant")
    refusal = "" if goal is None or region is None else region.describe_refusal(goal)
    if refusal:
        raise UsageError(f"goto: {refusal}")


def explain_height_refusal(region: RestRegion | None, take_off_m: float) -> str:
    """Return why the plant may not climb to a height above the ground [m] and rest there; empty if it may."""
    if region is None:
        return "take-off: this plant cannot rest at every target; see plant"
    if DOWN not in region.axes:
        return "take-off: the plant has no vertical axis, so its height is unknown; see plant.axes"
    highest_m = -float(region.lower[region.axes.index(DOWN)])
    if take_off_m > highest_m:
        return f"take-off to {take_off_m:g} m: above {highest_m:.2f} m it may not rest (sets.state_lower)"
    return ""


def compute_stop_limit_s(config: Config, *, takes_off: bool) -> float:
    """Return the time limit of a hand-over [s], with rest in a cell and the landing of an ordered or relayed flight."""
    landings = 1 + LAND_PERIODS if takes_off else int(config.relay.enabled)
    rest_s = REST_NS * 1e-9 if config.mission.cells else 0.0
    return rest_s + config.fallback.brake_s + LANDING_S + landings * config.hand_over.land_s
