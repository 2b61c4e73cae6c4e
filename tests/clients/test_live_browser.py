"""The live page in a real browser: its buttons fly the simulated vehicle, and without the token there are none."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from browser_rig import Browser
from operation_rig import Scene, end_process, open_scene
from order_rig import answer, serve_orders
from patience import wait_until

from logs.live.feed import SCENE
from logs.live.scene import LiveScene, SceneVehicle
from logs.recording.reader import read_kind
from uavctl.records import Order, StepInput, Vec3

PLACE_M: Vec3 = (1.0, -0.8, -1.4)
FAR_M: Vec3 = (-2.0, 0.8, -1.0)
# A machine that stands still sends setpoints late, and the vehicle then moves as none says.
PATIENT = ("envelope.unexplained_mps2=50", "envelope.disagreement_mps=20")
SHOWN = """[...document.querySelectorAll('#controls,#note,#all')].filter((e) => e.checkVisibility()).map((e) => e.id)"""
BEYOND = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    one = Browser(tmp_path_factory.mktemp("browser"))
    yield one
    one.close()


@contextmanager
def fly(folder: Path, *overrides: str) -> Iterator[tuple[Scene, str]]:
    """A vehicle in flight with a live page, and the page's address from the console."""
    console = folder / "console"
    with open_scene("link.loss=0", *overrides) as scene, console.open("w") as errors:
        options = ["--live", "--live-port", "0", *(text for one in PATIENT for text in ("--set", one))]
        with end_process(scene.fly("a", *options, stderr=errors.fileno())):
            addresses: list[str] = []

            def is_told() -> bool:
                addresses[:] = re.findall(r"live page: (http\S+)", console.read_text())
                return bool(addresses)

            wait_until(is_told, "the address of the page")
            wait_until(lambda: scene.ctl("status")[0] == 0 and scene.status()["mode"] == "track", "it is flown")
            yield scene, addresses[0]


def get_answer(window: Browser) -> str:
    text: str = window.evaluate("document.getElementById('answers').innerText")
    return text


def give(window: Browser, button: str) -> str:
    """Click a button; the answer of the daemon."""
    window.click(button)
    wait_until(lambda: ":" in get_answer(window), "an answer")
    return get_answer(window)


def go_to(window: Browser, place_m: Vec3) -> str:
    """Click a place of the map, write the height, and click the button."""
    wait_until(lambda: bool(window.evaluate("!!view")), "a map")
    x, y = window.evaluate(f"view.pixelsOf({list(place_m)})")
    window.click("#above", x, y)
    window.evaluate("document.getElementById('height').select()")
    window.click("#height")
    window.evaluate("document.getElementById('height').select()")
    window.call("Input.insertText", text=f"{-place_m[2]:g}")
    return give(window, "[data-order=goto]")


def is_at(scene: Scene, place_m: Vec3) -> bool:
    return math.dist(scene.truths[-1].position_m, place_m) < 0.3


def read_orders(scene: Scene) -> list[Order]:
    ticks = read_kind(scene.folder / "a" / "flight.mcap", StepInput)
    return [command.order for tick in ticks for command in tick.commands]


@pytest.mark.slow
def test_the_buttons_of_the_page_fly_the_vehicle(tmp_path: Path, window: Browser) -> None:
    with fly(tmp_path) as (scene, address):
        window.open(address.partition("#")[0], 1000)
        wait_until(lambda: window.evaluate(SHOWN) == ["note"], "without the token the page only shows")
        window.open(address, 1000)
        wait_until(lambda: window.evaluate(SHOWN) == ["controls"], "the orders")
        assert window.evaluate("location.href") == address.partition("#")[0]
        assert "accepted" in go_to(window, PLACE_M)
        wait_until(lambda: is_at(scene, PLACE_M), "it is at the place that was clicked")
        assert "accepted" in go_to(window, FAR_M)
        wait_until(lambda: math.dist(scene.truths[-1].position_m, PLACE_M) > 0.5, "it is on its way")
        assert "accepted" in give(window, "[data-order=hold]")
        scene.wait_for_flight(4.0)
        first_m = scene.truths[-1].position_m
        scene.wait_for_flight(4.0)
        assert math.dist(scene.truths[-1].position_m, first_m) < 0.5 < math.dist(first_m, FAR_M)
        assert "refused" in go_to(window, (0.0, 0.0, -9.0))
        assert not is_at(scene, FAR_M)
        assert "accepted" in give(window, "[data-order=land]")
        wait_until(lambda: scene.has_landed, "it lands")
        assert window.read_console() == ""
        wait_until(
            lambda: read_orders(scene) == [Order.GOTO, Order.GOTO, Order.HOLD, Order.LAND],
            "they are recorded as those of `uavctl ctl`; what was refused at the socket never reached a tick",
        )


@pytest.mark.slow
@pytest.mark.fault(98)
def test_98_the_pilot_s_switch_wins_over_the_page_until_it_engages(tmp_path: Path, window: Browser) -> None:
    fault = "sim.fault=[{at_s=35.0,kind='mode',name='POSCTL'}]"
    with fly(tmp_path, fault) as (scene, address):
        window.open(address, 390)
        wait_until(lambda: window.evaluate(SHOWN) == ["controls"], "the orders")
        assert window.evaluate(BEYOND) == 0
        wait_until(lambda: scene.mode == "POSCTL", "the pilot flies")
        wait_until(lambda: "refused" in give(window, "[data-order=hold]"), "the daemon has heard it", pause_s=0.5)
        assert scene.mode == "POSCTL"
        assert "accepted" in give(window, "[data-order=engage]")
        wait_until(lambda: scene.mode == "OFFBOARD", "it is flown again")


@pytest.mark.slow
def test_a_page_that_is_opened_late_shows_the_whole_flight(tmp_path: Path, window: Browser) -> None:
    with fly(tmp_path) as (scene, address):
        begun_ns = scene.truths[-1].at_ns
        scene.wait_for_flight(8.0)
        window.open(address, 1000)
        wait_until(lambda: bool(window.evaluate("samples.length && samples[0][1] < 4")), "the history")
        places_m = window.evaluate("samples.map((one) => one[3].estimate).filter((at) => at)")
        flown_m = [one.position_m for one in scene.truths if one.at_ns >= begun_ns][:20]
        assert all(min(math.dist(at_m, place_m) for place_m in places_m) < 0.4 for at_m in flown_m)
        figures = window.evaluate("document.getElementById('figures').innerText")
        for name in ("position N, E, D [m]", "age of information", "positions lost", "battery"):
            assert name in figures


def test_a_fleet_s_orders_go_to_the_vehicle_that_is_clicked_or_to_all(tmp_path: Path, window: Browser) -> None:
    places_m: dict[str, Vec3] = {"west": (0.0, -2.0, -1.2), "east": (1.0, 2.0, -0.8)}
    vehicles = tuple(SceneVehicle(name, (name,), at_m=at_m) for name, at_m in places_m.items())
    scene = LiveScene("fleet", 1.0, "2 vehicles", "good", columns=("vehicle",), vehicles=vehicles)
    with serve_orders(tmp_path, {name: answer(ok=True, text="") for name in places_m}) as (live, daemons):
        live.send(SCENE, 0, msgspec.json.encode(scene))
        window.open(live.page_url, 390)
        wait_until(lambda: window.evaluate(SHOWN) == ["controls", "all"], "the orders")
        wait_until(lambda: bool(window.evaluate("!!view")), "a map")
        assert window.evaluate(BEYOND) == 0
        chosen = "document.getElementById('vehicle').value"
        assert window.evaluate(chosen) == "west"
        window.click("#above", *window.evaluate(f"view.pixelsOf({list(places_m['east'])})"))
        assert window.evaluate(chosen) == "east"
        go_to(window, (0.5, 0.0, -1.5))
        give(window, "[data-order=hold]:not([data-all])")
        assert not daemons["west"].requests
        give(window, "[data-order=hold][data-all]")
        give(window, "[data-order=land][data-all]")
    goto, *others = daemons["east"].requests
    assert goto.ask == "goto" and goto.position_m is not None
    assert math.dist(goto.position_m, (0.5, 0.0, -1.5)) < 0.05  # a pixel has 12 mm here
    assert [request.ask for request in others] == ["hold", "hold", "land"]
    assert [request.ask for request in daemons["west"].requests] == ["hold", "land"]
