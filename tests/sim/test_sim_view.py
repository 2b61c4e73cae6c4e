"""`uavctl sim --view`: what is shown, with a terminal and without one."""

import io
import threading
from dataclasses import replace

import pytest
from patience import LIMIT_S
from rich.console import Console
from sim_rig import make_rig

from sim.server import VehicleSetup, serve_all
from sim.simulation import VehicleSnapshot
from uavctl.cli.app import run
from uavctl.cli.sim_view import HEADINGS, PHASE_TEXTS, format_line, make_scene, render_view, show_view
from uavctl.config import load_config

ROOM = load_config("room", ("sets.state_upper=[3, 1.5, inf, 2.5, 1.5, inf, inf, 1, inf]",))
ANY = "udpin://127.0.0.1:0"
ONE = VehicleSnapshot(
    system_id=3,
    time_s=12.34,
    mode="OFFBOARD",
    armed=True,
    phase="air",
    position_m=(1.0, -2.5, -1.5),
    velocity_mps=(0.25, 0.0, -0.125),
    battery=0.87,
    setpoint_source=(245, 25),
    setpoint_age_s=0.05,
    sent=600,
    lost=17,
    faults=("blackout", "wind"),
    text="[red]Failsafe activated[/]",
)
TOLD = ("3", "OFFBOARD", "in the air", "+1.00 -2.50 -1.50", "87%", "245/25, 0.05 s ago", "600", "17", "blackout, wind")


def drawn(*looks: VehicleSnapshot, width: int = 250) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(render_view(looks))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_table_has_a_row_for_each_vehicle_and_takes_no_text_for_markup() -> None:
    other = replace(ONE, system_id=4, mode="CRASHED", setpoint_source=None, setpoint_age_s=None, faults=(), text="")
    text = drawn(ONE, other)
    rows = [row for row in text.splitlines() if row.startswith("│")]
    assert len(rows) == 2
    for told in (*TOLD, "[red]Failsafe activated[/]", "yes"):
        assert told in rows[0]
    assert [cell.strip() for cell in rows[1].split("│")][1:-1][-1] == "-"
    assert "CRASHED" in rows[1]
    assert "simulated time 12.3 s" in text
    assert "position NED [m]" in text
    narrow = drawn(ONE, other, width=80)
    assert max(map(len, narrow.splitlines())) <= 80
    for told in (*TOLD, "[red]Failsafe activated[/]"):  # below each other, and none of it cut
        assert told in narrow


def test_the_live_page_tells_the_same() -> None:
    found = make_scene((ONE, replace(ONE, system_id=2, faults=())), ROOM)
    assert [body.at_m for body in found.bodies] == [ONE.position_m] * 2
    assert found.box is not None  # what is open is drawn open
    assert (found.box.lower_m, found.box.upper_m) == ((-3.0, -2.5, -2.5), (3.0, 2.5, None))
    told = " ".join(f"{one.name} {one.value}" for one in found.figures)
    for name in HEADINGS[4:-1]:
        assert f"{ONE.system_id}: {name}" in told and f"2: {name}" in told
    assert {one.level for one in found.figures} == {"plain", "warn"} and bool(ONE.faults)
    assert [event.text for event in found.events] == [f"{ONE.system_id}: {ONE.text}", f"2: {ONE.text}"]
    alone = make_scene((ONE,), ROOM).headline
    assert ONE.mode in alone and PHASE_TEXTS[ONE.phase] in alone


def test_what_is_as_good_as_zero_has_no_minus() -> None:
    rests = replace(ONE, position_m=(-1e-9, -0.004, -0.0), velocity_mps=(-1e-4, 0.0, -0.004))
    assert "-0.00" not in format_line(rests) and format_line(rests).count("+0.00 +0.00 +0.00") == 2


def test_the_line_tells_the_same() -> None:
    text = format_line(ONE)
    assert "\n" not in text
    for told in (*TOLD, "12.3 s", "[red]Failsafe activated[/]"):
        assert told in text


def test_a_look_tells_what_the_vehicle_does() -> None:
    one = make_rig(
        "px4",
        "sim.camera.phase_s=0",
        "link.loss=0",
        "sim.fault=["
        '{at_s=1.0,kind="blackout",for_s=1.0},{at_s=1.5,kind="parameter",name="COM_OF_LOSS_T",value=2.0},'
        '{at_s=5.0,kind="occluded",for_s=1.0}]',
    )
    before = one.peers.take_snapshot()
    assert (before.setpoint_source, before.setpoint_age_s, before.faults, before.text) == (None, None, (), "")
    assert (before.armed, PHASE_TEXTS[before.phase], before.battery, before.system_id) == (True, "in the air", 1.0, 1)
    one.stream(1.6, 1.0, 0.0, 0.0)
    now = one.peers.take_snapshot()
    assert now.time_s == pytest.approx(1.6)
    assert now.setpoint_source == (245, 25)
    assert now.setpoint_age_s == pytest.approx(0.1)
    assert now.velocity_mps == one.peers.vehicle.velocity_mps and now.velocity_mps[0] > 0.5
    assert now.faults == ("blackout", "parameter COM_OF_LOSS_T")
    assert (now.sent, now.lost) == (9, 4)  # each 0.2 s from 0 to 1.6 s; the blackout begins with that at 1 s
    one.wait(3.0)
    later = one.peers.take_snapshot()
    assert (later.mode, later.text) == ("AUTO.LOITER", "Failsafe activated")
    assert later.faults == ("parameter COM_OF_LOSS_T",)
    one.wait(0.5)
    assert "occluded" in one.peers.take_snapshot().faults


def test_without_a_terminal_it_is_said_and_told_line_by_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["sim", "--vehicle", ANY, "--mocap", ANY, "--vehicles", "2", "--view", "--duration", "0.3"]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 3  # a vehicle each, and their closest approach
    first, *lines = err.splitlines()
    assert "no terminal" in first
    assert [text.split("  ")[1] for text in lines[-2:]] == ["vehicle 1", "vehicle 2"]


def test_in_a_terminal_the_table_is_drawn_to_the_end() -> None:
    console = Console(file=io.StringIO(), width=250, force_terminal=True)
    with show_view(console, ROOM) as tell:
        tell((ONE,))
        tell((replace(ONE, mode="AUTO.LAND"),))
    assert isinstance(console.file, io.StringIO)
    assert "AUTO.LAND" in console.file.getvalue()


class Stuck(io.StringIO):
    """A terminal that takes nothing until it is let."""

    def __init__(self) -> None:
        super().__init__()
        self.tried, self.let = threading.Event(), threading.Event()

    def write(self, text: str) -> int:
        self.tried.set()
        self.let.wait(30.0)
        return len(text)


def test_a_terminal_that_has_stopped_does_not_hold_up_the_simulation() -> None:
    stuck = Stuck()
    told: list[int] = []
    seat = VehicleSetup(load_config("room-hahn-stursberg"), ANY, ANY, lambda truth: told.append(truth.at_ns))
    with show_view(Console(file=stuck, force_terminal=True), ROOM) as tell:
        tell((ONE,))
        assert stuck.tried.wait(LIMIT_S)
        serve_all(
            (seat,),
            duration_s=2.0,
            airborne=True,
            on_ready=lambda _: None,
            stop=lambda: False,
            speed=4.0,
            on_snapshot=tell,
        )
        assert not stuck.let.is_set()
    assert len(told) == 10  # each Δt boundary of the 2 s
    stuck.let.set()


def test_looks_come_with_the_run_and_at_its_end() -> None:
    looks: list[tuple[VehicleSnapshot, ...]] = []
    seat = VehicleSetup(load_config("room-hahn-stursberg"), ANY, ANY, lambda _: None)
    serve_all(
        (seat,), duration_s=1.0, airborne=True, on_ready=lambda _: None, stop=lambda: False, on_snapshot=looks.append
    )
    times = [one.time_s for (one,) in looks]
    assert times == sorted(times)
    assert 3 <= len(times) <= 6 + 2  # at most four a second (the wait for the grid too), one at the end
    assert times[-1] == pytest.approx(1.0, abs=0.21)
