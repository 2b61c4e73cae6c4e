"""A vehicle that the configuration does not know stays inside the box of a tuning, on the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import sim.vehicle.quadrotor as quadrotor
from sim import simulation
from sim.simulation import World
from sim.vehicle.airframe import CRAZYFLIE_2
from uavctl.config import Config, load_config
from uavctl.lab.trial import FlightCounts, compute_excess_m
from uavctl.lab.tune.box_monitor import MIN_REPEAT_SHARE, BoxMonitor
from uavctl.lab.tune.excitation import HOLD_S, MIN_STEP_M, PAUSE_S, SafeBox, add_excitation, parse_box
from uavctl.loop import ControlLoop
from uavctl.records import Command, ControlMode, Decision, Estimate, Event, Order, Send, Severity, Ticked, Vec3
from uavctl.wiring.controller import build_controller, build_flight_design

BOX = parse_box("-1.5,-1.4,-2,1.5,1.4,-0.4")
LEFT_M = 0.15  # to the nearest side; without a share for overshoot 0.07 m were left


SMALL = parse_box("-0.75,-0.75,-1.75,0.75,0.75,-0.65")
CENTRE = (0.0, 0.0, -1.2)


class TrueVehicle(quadrotor.Quadrotor):
    """A quadrotor that answers a setpoint with another gain and a further lag."""

    gain, lag_s = 1.0, 0.0
    followed: tuple[int, Vec3] = (0, (0.0, 0.0, 0.0))

    def accelerate(self, accel_mps2: Vec3) -> None:
        since_ns, at = self.followed
        part = 1.0 - math.exp(-(self.now_ns - since_ns) * 1e-9 / self.lag_s) if self.lag_s else 1.0
        north, east, down = (a + part * (self.gain * want - a) for a, want in zip(at, accel_mps2, strict=True))
        self.followed = (self.now_ns, (north, east, down))
        super().accelerate((north, east, down))


def fly(
    patch: pytest.MonkeyPatch, preset: str, box: SafeBox, *, over_s: float, drag: float, gain: float, lag_s: float
) -> BoxMonitor:
    """Fly the excitation on a true vehicle, and check that it stayed inside on the truth up to its own landing."""
    config = load_config(preset, ("sim.plant=quadrotor", f"sim.start_position_m={list(CENTRE)}"))
    front, right, down = (rotor_drag * drag / config.plant.drag_1ps[0] for rotor_drag in CRAZYFLIE_2.rotor_drag_kg)
    defaults = quadrotor.Quadrotor.__init__.__kwdefaults__
    assert defaults is not None
    patch.setitem(defaults, "airframe", replace(CRAZYFLIE_2, rotor_drag_kg=(front, right, down)))
    patch.setattr(simulation, "Quadrotor", type("True", (TrueVehicle,), {"gain": gain, "lag_s": lag_s}))
    excited = add_excitation(config, build_flight_design(config), box, lands=False)
    loop = ControlLoop(excited, build_controller(excited), FlightCounts(), lambda: 0)
    monitor, beyond = BoxMonitor(excited, box), [-np.inf]
    sides = np.array(box.lower), np.array(box.upper)

    class Followed:
        receive = staticmethod(loop.receive)

        def tick(self, tick: int, at_ns: int, send: Send) -> None:
            monitor.handle_tick(loop, loop.tick(tick, at_ns, send))
            if not monitor.reason:
                beyond.append(float(compute_excess_m(np.array([vehicle.position_m]), *sides)[0]))

    world = World(excited, Followed())
    vehicle = world.peers.vehicle
    world.run(over_s, lambda: world.peers.autopilot.mode_name in ("AUTO.LAND", "LAND"))
    assert isinstance(vehicle, TrueVehicle) and len(beyond) > 40  # two seconds of flight
    assert max(beyond) < -LEFT_M
    return monitor


@pytest.mark.slow
def test_an_unknown_drag_stays_well_inside_the_box(monkeypatch: pytest.MonkeyPatch) -> None:
    # Rotor drag in proportion: 1.0 1/s instead of the assumed 0.24. No motion has to be repeated.
    assert fly(monkeypatch, "room-px4", BOX, over_s=45.0, drag=1.0, gain=1.0, lag_s=0.0).repeated == 0


@pytest.mark.slow
def test_a_motion_that_comes_too_near_is_repeated_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    # PX4 with 0.15 s more of lag: 0.25 m beyond the box in the first 8 s without the monitor.
    monitor = fly(monkeypatch, "room-px4", BOX, over_s=14.0, drag=0.24, gain=0.8, lag_s=0.15)
    assert monitor.repeated > 0 and not monitor.reason


@pytest.mark.slow
def test_a_flight_whose_smallest_motion_does_not_fit_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    # ArduPilot with 0.3 s more of lag: unstable, and 0.6 m beyond the box within 11 s without the monitor.
    monitor = fly(monkeypatch, "room-ardupilot", SMALL, over_s=12.0, drag=0.24, gain=1.2, lag_s=0.3)
    assert "north" in monitor.reason


@dataclass
class Orders:
    """A loop that takes orders, and the ticks of a flight on it."""

    config: Config
    box: SafeBox
    given: list[Command] = field(default_factory=list)
    at_s: float = 0.0

    def __post_init__(self) -> None:
        self.monitor = BoxMonitor(self.config, self.box)
        self.size = self.config.plant.states_per_axis

    def order(self, command: Command) -> bool:
        self.given.append(command)
        return True

    def see(
        self,
        north_m: float,
        north_mps: float,
        *,
        waypoint: int | None = None,
        by: Command | None = None,
        dt_s: float = 0.1,
    ) -> None:
        """A tick at the last ordered place in the other axes, else the centre; `by` is an order of somebody else."""
        self.at_s += dt_s
        mean = np.zeros(3 * self.size)
        _, east_m, down_m = self.place if self.given and self.given[-1].position_m is not None else CENTRE
        mean[[0, 1, self.size, 2 * self.size]] = north_m, north_mps, east_m, down_m
        at_ns = round(self.at_s * 1e9)
        answered = () if by is None else ((by, Event(at_ns=at_ns, severity=Severity.INFO, code="x", text="")),)
        decision = cast(Decision, SimpleNamespace(at_ns=at_ns, mode=ControlMode.TRACK, waypoint=waypoint))
        estimate = Estimate(at_ns=at_ns, captured_ns=at_ns, mean=tuple(mean.tolist()), cov=())
        ticked = cast(Ticked, SimpleNamespace(decision=decision, estimate=estimate, answers=answered))
        self.monitor.handle_tick(cast(ControlLoop, self), ticked)

    @property
    def place(self) -> Vec3:
        """Place of the last order."""
        assert self.given[-1].order is Order.GOTO and self.given[-1].position_m is not None
        return self.given[-1].position_m


@pytest.fixture(params=["room-px4", "room-ardupilot"])
def orders(request: pytest.FixtureRequest) -> Orders:
    config = load_config(request.param, ("sim.plant=quadrotor",))
    return Orders(add_excitation(config, build_flight_design(config), BOX, lands=True), BOX)


def test_a_flight_that_stays_inside_gets_no_order(orders: Orders) -> None:
    for number, (north, _, _) in enumerate(orders.config.mission.waypoints):
        orders.see(0.0, 0.5, waypoint=number)
        orders.see(north, 0.0, waypoint=number)
    assert not orders.given


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_vehicle_that_cannot_stop_at_half_the_deceleration_returns_and_repeats_at_half_the_size(
    orders: Orders, side: float
) -> None:
    first = orders.config.mission.waypoints[0]
    fast_mps = 1.0
    stop_m = 0.3 * fast_mps + fast_mps**2 / orders.config.limits.accel_mps2[0]
    orders.see(side * (1.5 - 0.15 - stop_m - 0.01), side * fast_mps, waypoint=0)
    assert not orders.given
    orders.see(side * (1.5 - 0.15 - stop_m + 0.01), side * fast_mps, waypoint=0)
    assert orders.place == CENTRE
    orders.see(side * 0.9, -side * 0.5)
    orders.see(0.0, 0.0)
    assert len(orders.given) == 1
    orders.see(0.0, 0.0, dt_s=PAUSE_S)
    assert orders.place == pytest.approx((0.5 * first[0], *CENTRE[1:]), abs=1e-3)
    assert orders.monitor.repeated == 1 and not orders.monitor.reason
    orders.see(orders.place[0], 0.0)
    orders.see(orders.place[0], 0.0, dt_s=PAUSE_S)
    second = orders.config.mission.waypoints[1]
    assert orders.place == pytest.approx((0.5 * second[0], *CENTRE[1:]), abs=1e-3)


def test_only_the_axis_that_came_too_near_gets_smaller(orders: Orders) -> None:
    number = len(orders.config.mission.waypoints) - 3
    orders.see(1.4, 0.0, waypoint=number)
    orders.see(0.0, 0.0)
    orders.see(0.0, 0.0, dt_s=PAUSE_S)
    north, east, down = orders.config.mission.waypoints[number]
    assert orders.place == pytest.approx((0.5 * north, east, down), abs=1e-3)


def test_a_motion_below_the_smallest_step_ends_the_flight(orders: Orders) -> None:
    size = abs(orders.config.mission.waypoints[0][0])
    for _ in range(9):
        orders.see(1.4, 0.0, waypoint=0)
        orders.see(0.5, -0.5, waypoint=0)
        if orders.monitor.reason:
            break
        size *= 0.5
        assert size >= MIN_REPEAT_SHARE * MIN_STEP_M[0]
    assert orders.given[-1].order is Order.LAND and "north" in orders.monitor.reason
    assert 0.5 * size < MIN_REPEAT_SHARE * MIN_STEP_M[0]
    given = len(orders.given)
    orders.see(1.4, 1.0)
    assert len(orders.given) == given


def test_a_vehicle_that_leaves_the_box_lands_at_once(orders: Orders) -> None:
    orders.see(1.49, 0.2, waypoint=5)
    assert [order.order for order in orders.given] == [Order.LAND] and orders.monitor.reason


def test_the_rest_is_flown_by_orders_up_to_the_landing(orders: Orders) -> None:
    places = orders.config.mission.waypoints
    orders.see(1.4, 0.0, waypoint=len(places) - 2)
    orders.see(0.0, 0.0)
    orders.see(0.0, 0.0, dt_s=PAUSE_S)
    position_m = orders.place[0]
    orders.see(position_m, 0.0)
    orders.see(position_m, 0.0, dt_s=PAUSE_S)
    assert orders.place == places[-1]
    orders.see(0.0, 0.0)
    orders.see(0.0, 0.0, dt_s=HOLD_S)
    assert orders.given[-1].order is Order.LAND
    assert not orders.monitor.reason


def test_motions_that_no_longer_fit_in_the_time_are_left_out(orders: Orders) -> None:
    orders.see(1.4, 0.0, waypoint=0)
    orders.see(0.8, -0.1, dt_s=orders.config.duration_s - HOLD_S)
    assert orders.place == CENTRE
    orders.see(0.0, 0.0)
    orders.see(0.0, 0.0, dt_s=HOLD_S)
    assert orders.given[-1].order is Order.LAND


@pytest.mark.parametrize("order", [Order.HOLD, Order.GOTO, Order.RESUME, Order.LAND])
def test_an_order_of_an_operator_ends_the_monitor(orders: Orders, order: Order) -> None:
    orders.see(0.0, 0.0, waypoint=0, by=Command(order=order, position_m=CENTRE))
    orders.see(1.6, 1.0, waypoint=0)
    assert not orders.given


@pytest.mark.parametrize("preset", ["room", "room-px4", "room-ardupilot"])
def test_each_axis_begins_with_its_smaller_steps(preset: str) -> None:
    config = load_config(preset, ("sim.plant=quadrotor",))
    points = np.array(add_excitation(config, build_flight_design(config), BOX, lands=False).mission.waypoints)
    steps = np.abs(np.diff(points, axis=0))
    for axis in range(3):
        is_single_axis = (steps[:, axis] > 0.0) & (np.delete(steps, axis, axis=1).max(axis=1) == 0.0)
        step_sizes = steps[is_single_axis, axis]
        assert step_sizes[0] < 0.6 * step_sizes[-1]
