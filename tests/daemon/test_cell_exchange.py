"""Exchange of cells with daemons over their control sockets, in virtual time: round trips, and what stands still."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from ticked_rig import ticked

from uavctl.config import load_config
from uavctl.daemon.cell_exchange import STALL_NS, CellExchange, DaemonConnection, ExchangedVehicle
from uavctl.daemon.control_socket import ControlRequest, ControlServer, open_listener
from uavctl.daemon.health import Health
from uavctl.fleet.cell import CellChoice, PlannedPath, Report, decide_cell, format_report, parse_cell
from uavctl.fleet.coordinator import find_near_starts
from uavctl.records import CellMessage, CellReport, Command, Conduct, Order
from uavctl.wiring.cells import Coordinator, build_cell_parameters

CONFIG = load_config("room-px4", ["mission.cells=true"])
PARAMETERS = build_cell_parameters([CONFIG], 0.5)
STEP_NS = 50_000_000
GROUND_M = 0.25


class StandingFlight:
    """A vehicle that rests at a place, and takes each cell that its place keeps."""

    def __init__(self, place_m: tuple[float, float, float], half_m: float = 0.0) -> None:
        self.place_m, self.half_m = np.array(place_m), half_m
        self.choice = CellChoice(None, 0)
        self.step = 0
        self.taken: list[CellMessage] = []
        self.conduct = Conduct.REST

    def order(self, command: Command) -> bool:
        raise AssertionError(command)

    def explain_refusal(self, order: Order) -> str:
        raise AssertionError(order)

    def put_cell(self, cell: CellMessage) -> str:
        before = self.choice
        self.choice = decide_cell(self.choice, parse_cell(cell), self.step, self._make_path())
        if self.choice.cell is not before.cell:
            self.conduct = Conduct.CELL
            self.taken.append(cell)
        return ""

    def report_cell(self) -> CellReport:
        number = 0 if self.choice.cell is None else self.choice.cell.number
        return format_report(
            Report(
                self._make_path(),
                np.zeros(3),
                number,
                self.choice.decided,
                self.conduct,
                goal_m=self.place_m,
                reach_mps2=np.ones(3),
            )
        )

    def _make_path(self) -> PlannedPath:
        shape = (PARAMETERS.stages, 1)
        return PlannedPath(self.step, np.tile(self.place_m, shape), np.full((PARAMETERS.stages, 3), self.half_m))


def refuse_health() -> Health:
    raise AssertionError


class Rig:
    """Daemons with control sockets, and an exchange with them; one `run` is some steps of both."""

    def __init__(self, folder: Path, flights: list[StandingFlight]) -> None:
        self.flights, self.folder, self.stack = flights, folder, ExitStack()
        self.permits = [0 for _ in flights]
        self.servers: dict[int, ControlServer] = {}
        self.listeners: dict[int, ExitStack] = {}
        for number in range(len(flights)):
            self.open(number)
        self.coordinator = Coordinator(PARAMETERS, len(flights))
        self.cycles: list[int] = []
        self.notes: list[str] = []
        vehicles = [ExchangedVehicle(f"v{i}", folder / f"v{i}.sock") for i in range(len(flights))]
        self.exchange = CellExchange(self.coordinator, vehicles, self.cycles.append, self.notes.append)
        self.stack.callback(self.exchange.close)
        self.at_ns = 40 * STEP_NS

    def open(self, number: int) -> None:
        """Open the daemon of a vehicle."""
        self.listeners[number] = self.stack.enter_context(ExitStack())
        listener = self.listeners[number].enter_context(open_listener(self.folder, f"v{number}"))

        def permit() -> None:
            self.permits[number] += 1

        server = ControlServer(listener, CONFIG, self.flights[number], refuse_health, permit)
        self.servers[number] = server
        self.listeners[number].callback(server.close)

    def close(self, number: int) -> None:
        """Close the daemon of a vehicle."""
        del self.servers[number]
        self.listeners.pop(number).close()

    def run(self, steps: int, *, still: tuple[int, ...] = (), wakes: bool = True) -> None:
        """Run steps; daemons that stand still do not tick."""
        for _ in range(steps):
            self.at_ns += STEP_NS
            for number, server in self.servers.items():
                if number not in still:
                    self.flights[number].step = self.at_ns // STEP_NS
                    server.after_tick(ticked(self.at_ns), 0)
            if wakes:
                self.exchange.wake(self.at_ns + STEP_NS // 2)


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="uavctl-") as path:  # short: a socket's path has 107 bytes
        yield Path(path)


@pytest.fixture
def rig(folder: Path) -> Iterator[Rig]:
    rig = Rig(folder, [StandingFlight((-1.0, 0.0, -1.0)), StandingFlight((1.0, 0.0, -1.0))])
    with rig.stack:
        yield rig


def test_each_vehicle_gets_ten_cells_a_second_that_are_for_it(rig: Rig) -> None:
    rig.run(10)
    before = [len(flight.taken) for flight in rig.flights]
    rig.run(40)
    assert [len(flight.taken) for flight in rig.flights] == [count + 20 for count in before]
    for flight in rig.flights:
        cell = parse_cell(flight.taken[-1])
        assert (cell.lower_m <= flight.place_m).all() and (flight.place_m <= cell.upper_m).all()
    assert not rig.notes and not rig.exchange.problem


def test_nobody_may_take_off_before_all_have_reported(rig: Rig) -> None:
    rig.run(10, still=(1,))
    assert rig.permits[0] == 0 and not rig.cycles
    rig.run(4)
    assert min(rig.permits) > 0


@pytest.mark.parametrize(("needed_m", "is_near"), [(0.99, True), (1.01, False)])
def test_vehicles_that_stand_too_near_are_not_permitted_to_take_off(
    folder: Path, needed_m: float, is_near: bool
) -> None:
    # Columns, the distance, and the room around each plan
    apart_m = needed_m * (PARAMETERS.distance_m + 2 * (GROUND_M + PARAMETERS.margin_m))
    places = [(0.0, 0.0, 0.0), (0.3, apart_m, 0.0)]
    rig = Rig(folder, [StandingFlight(place, GROUND_M) for place in places])
    for flight in rig.flights:
        flight.conduct = Conduct.PATH
    with rig.stack:
        rig.run(20)
        assert bool(rig.exchange.problem) is is_near
        assert any(rig.permits) is not is_near
    if is_near:
        assert "v0 and v1" in rig.exchange.problem
        reports = [Report(flight._make_path(), np.zeros(3), 0, 0) for flight in rig.flights]
        ((first, second, asked_m),) = find_near_starts(reports, PARAMETERS)
        assert (first, second) == (0, 1) and asked_m > apart_m


def test_a_daemon_that_stands_still_keeps_its_cell_and_delays_no_other(rig: Rig) -> None:
    rig.run(10)
    taken = [len(flight.taken) for flight in rig.flights]
    rig.run(60, still=(0,))
    assert len(rig.flights[0].taken) <= taken[0] + 1
    # As an obstacle it may reach the other one, which then is told to land, and still hears all
    assert len(rig.flights[1].taken) >= taken[1] + 25
    assert rig.flights[1].taken[-1].land
    rig.run(20)
    assert len(rig.flights[0].taken) >= taken[0] + 5
    assert not rig.flights[0].taken[-1].land


def test_a_coordinator_that_stood_still_first_asks_for_new_reports(rig: Rig) -> None:
    rig.run(10)
    rig.run(60, wakes=False)
    cycles, taken = len(rig.cycles), [len(flight.taken) for flight in rig.flights]
    rig.run(20)
    assert len(rig.cycles) >= cycles + 8
    assert all(len(flight.taken) >= count + 6 for flight, count in zip(rig.flights, taken, strict=True))
    # No report was old in any cycle, so no vehicle was an obstacle
    assert not any(cell.land for flight in rig.flights for cell in flight.taken)
    assert rig.at_ns - 60 * STEP_NS > STALL_NS


def test_a_daemon_that_is_gone_is_reached_again(rig: Rig) -> None:
    rig.run(10)
    rig.close(1)
    rig.run(5)
    rig.open(1)
    taken = len(rig.flights[1].taken)
    rig.run(30)
    assert len(rig.flights[1].taken) >= taken + 10


def test_a_report_of_another_horizon_is_told_and_not_used(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.run(10)
    short = PlannedPath(0, np.zeros((3, 3)), np.zeros((3, 3)))
    monkeypatch.setattr(rig.flights[0], "_make_path", lambda: short)
    rig.run(10)
    assert len(rig.notes) == 1 and "v0" in rig.notes[0]


def test_a_connection_has_one_open_request_and_survives_other_programs(folder: Path) -> None:
    connection = DaemonConnection(folder / "none.sock")
    request = ControlRequest(ask="cell")
    assert not connection.send(request) and connection.receive() is None
    flight = StandingFlight((0.0, 0.0, -1.0))
    with open_listener(folder, "none") as listener:
        server = ControlServer(listener, CONFIG, flight, refuse_health)
        assert connection.send(request) and not connection.send(request)
        assert connection.receive() is None
        server.after_tick(ticked(STEP_NS), 0)
        reply = connection.receive()
        assert reply is not None and reply.report == flight.report_cell()
        assert connection.send(request)
        server.close()
        assert connection.receive() is None and not connection.is_awaited
    connection.close()
