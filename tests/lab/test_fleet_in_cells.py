"""Two 6-DOF vehicles that exchange places in cells, through the daemons' control sockets, in virtual time."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from logs.recording.coordinator import CoordinatorRecording
from logs.recording.fleet_replay import replay_coordinator
from logs.recording.reader import read_kind
from uavctl.arrays import Array
from uavctl.clock import VIRTUAL_ZERO_UTC_NS
from uavctl.config import load_config
from uavctl.daemon.cell_exchange import CellExchange, ExchangedVehicle
from uavctl.daemon.control_socket import ControlServer, open_listener
from uavctl.daemon.flight_orders import FlightOrders
from uavctl.daemon.health import Health
from uavctl.fleet.cell import MovingCell
from uavctl.lab.lockstep import LockstepFleet
from uavctl.loop import ControlLoop
from uavctl.records import FleetTruth, Ticked
from uavctl.wiring.cells import Coordinator, build_cell_parameters
from uavctl.wiring.controller import build_flight_design, prepare

STARTS_M = ((-1.2, 0.1, -0.2), (1.2, -0.1, -0.2))
GOALS_M = np.array([[1.2, 0.0, -1.2], [-1.2, 0.0, -1.2]])
DISTANCE_M = 0.35
FLOWN_S, CROSSING_S = 24.0, 7.6  # they take off at 0.3 s, fly by plans from 6 s on, and pass each other at about 8 s
STEP_S = 0.05
ROOM = (
    "limits.accel_mps2=[2,2,1.5]",
    "sets.input_lower=[-2,-2,-1.5]",
    "sets.input_upper=[2,2,1.5]",
    "mission.cells=true",
    f"duration_s={FLOWN_S}",
)


def refuse_health() -> Health:
    raise AssertionError


class Daemon:
    """Services of one daemon after each tick of its loop."""

    def __init__(self, orders: FlightOrders, server: ControlServer) -> None:
        self._orders, self._server = orders, server

    def handle_tick(self, loop: ControlLoop, ticked: Ticked) -> None:
        self._orders.handle_tick(loop, ticked)
        self._server.after_tick(ticked, 0)


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="uavctl-") as path:  # short: a socket's path has 107 bytes
        yield Path(path)


def fly(folder: Path, stands_still_s: tuple[float, float]) -> tuple[Array, Array, Array]:
    """Fly while the coordinator stands still for a span; return times, true places (n, 2, 3), and lowest and highest
    corners of the last boxes in use when the span begins (2, 2, 3)."""
    configs = [
        load_config(
            "room-px4",
            [
                *ROOM,
                f"sim.start_position_m={list(start_m)}",
                f"mission.waypoints=[{goal_m.tolist()}]",
                f"sim.system_id={number + 1}",
                f"sim.seed={number + 70}",
            ],
        )
        for number, (start_m, goal_m) in enumerate(zip(STARTS_M, GOALS_M, strict=True))
    ]
    design = build_flight_design(configs[0])
    fleet = LockstepFleet(
        [prepare(config, design) for config in configs],
        [folder / f"v{number}.mcap" for number in range(2)],
        folder / "world.mcap",
    )
    parameters, path = build_cell_parameters(configs, DISTANCE_M), folder / "coordinator.mcap"
    coordinator = Coordinator(parameters, 2)
    boxes: list[Array] = []
    issued: dict[tuple[int, int], MovingCell] = {}  # by vehicle and number
    with ExitStack() as stack:
        daemons = []
        for number, (config, loop) in enumerate(zip(configs, fleet.loops, strict=True)):
            orders = FlightOrders(config, take_off_m=1.2, goto=False, waits_for_fleet=True)
            orders.begin(loop)
            listener = stack.enter_context(open_listener(folder, f"v{number}"))
            server = ControlServer(listener, config, loop, refuse_health, orders.permit_take_off)
            stack.callback(server.close)
            daemons.append(Daemon(orders, server))
        vehicles = [ExchangedVehicle(f"v{number}", folder / f"v{number}.sock") for number in range(2)]
        recording = stack.enter_context(
            CoordinatorRecording(path, ("v0", "v1"), parameters, start_ns=0, zero_utc_ns=VIRTUAL_ZERO_UTC_NS)
        )
        exchange = CellExchange(coordinator, vehicles, lambda at_ns: recording.add(at_ns, coordinator), pytest.fail)
        stack.callback(exchange.close)

        def wake(flown_s: float) -> bool:
            at_s = flown_s - 0.5 * STEP_S  # in the middle of the step
            if coordinator.state is not None:
                issued.update({(i, cell.number): cell for i, cell in enumerate(coordinator.state.newest)})
            if not stands_still_s[0] <= at_s < stands_still_s[1]:
                exchange.wake(round(at_s * 1e9))
            elif at_s >= stands_still_s[0] + 0.2 and not boxes:  # nothing is on its way any more
                for i, loop in enumerate(fleet.loops):
                    report = loop.report_cell()
                    assert report is not None and min(report.reach_mps2) > 0.0
                    cell = issued[i, report.in_use]
                    boxes.append(np.array([cell.lower_m[-1], cell.upper_m[-1]]))
            return True

        try:
            fleet.fly(wake, observers=daemons, landing_s=10.0)
        finally:
            fleet.close()
    assert not fleet.collisions
    for loop in fleet.loops:  # they have landed: their last reports say that they stay
        report = loop.report_cell()
        assert report is not None and (*report.reach_mps2, *report.velocity_mps) == (0.0,) * 6
    replayed = replay_coordinator(path)
    assert replayed.identical and not replayed.lacks_end
    # Ten cycles a second; from 6 s on, until the crossing at least, each vehicle gets nearly as many cells
    assert replayed.decisions > 10.0 * CROSSING_S - 10.0 and replayed.compared - replayed.decisions > 20
    truths = list(read_kind(folder / "world.mcap", FleetTruth))
    places_m = np.array([[vehicle.position_m for vehicle in truth.vehicles] for truth in truths])
    return np.array([truth.at_ns * 1e-9 for truth in truths]), places_m, np.array(boxes)


def assert_apart(places_m: Array) -> None:
    """Assert that vehicles in the air are apart: in flight by plans, and as they land."""
    offset_m = places_m[:, 0] - places_m[:, 1]
    assert np.hypot(offset_m[:, 0], offset_m[:, 1]).min() >= DISTANCE_M


@pytest.mark.slow
@pytest.mark.parametrize("span_s", [(FLOWN_S, FLOWN_S), (CROSSING_S, CROSSING_S + 3.0)], ids=["runs", "stands still"])
def test_vehicles_take_off_together_exchange_their_places_and_land(folder: Path, span_s: tuple[float, float]) -> None:
    times_s, places_m, boxes_m = fly(folder, span_s)
    assert_apart(places_m)
    at_end = int(np.searchsorted(times_s, FLOWN_S - STEP_S))
    assert (np.linalg.norm(places_m[at_end] - GOALS_M, axis=1) < 0.25).all()
    assert (places_m[-1, :, 2] > -0.1).all()  # on the floor
    if len(boxes_m):  # they rest in the boxes that hold for good, also in truth
        at_rest = int(np.searchsorted(times_s, span_s[1]))
        assert (places_m[at_rest] >= boxes_m[:, 0]).all() and (places_m[at_rest] <= boxes_m[:, 1]).all()


@pytest.mark.slow
def test_without_a_coordinator_all_hold_in_their_last_boxes(folder: Path) -> None:
    times_s, places_m, boxes_m = fly(folder, (CROSSING_S, FLOWN_S + 100.0))
    assert_apart(places_m)
    resting = (times_s > CROSSING_S + 3.0) & (times_s < FLOWN_S - STEP_S)
    assert (places_m[resting] >= boxes_m[:, 0]).all() and (places_m[resting] <= boxes_m[:, 1]).all()
