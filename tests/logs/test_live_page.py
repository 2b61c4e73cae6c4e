"""The live page: what it shows of a flight, to whom, and that nobody holds anything up."""

from __future__ import annotations

import http.client
import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from view_rig import fly_view

from logs.live import HOST, MOST_PAGES, FlightScene, LiveScene, serve_live_page
from logs.recording.design_view import read_design
from uavctl.config import parse
from uavctl.errors import UsageError
from uavctl.records import Decision, Estimate, Event, Header, Plan, Record, Truth

LIMIT_S = 10.0


def scene(number: int) -> LiveScene:
    return LiveScene(title="a flight", time_s=0.1 * number, headline="track", level="good")


@contextmanager
def asked(port: int, path: str, **headers: str) -> Iterator[http.client.HTTPResponse]:
    connection = http.client.HTTPConnection(HOST, port, timeout=LIMIT_S)
    try:
        connection.request("GET", path, headers=headers)
        yield connection.getresponse()
    finally:
        connection.close()


def port_of(address: str) -> int:
    return int(address.rstrip("/").rsplit(":", 1)[1])


def states(answer: http.client.HTTPResponse, count: int) -> list[Any]:
    found: list[Any] = []
    while len(found) < count:
        line = answer.readline()
        if line.startswith(b"data: "):
            found.append(json.loads(line[len(b"data: ") :]))
    return found


def test_it_shows_what_the_records_say() -> None:
    """At each decision of a recorded flight, beside the records themselves."""
    seen, newest, shown = FlightScene(), dict[type[Record], Any](), 0
    for _, _, record in fly_view().entries:
        seen.add_record(record)
        newest[type(record)] = record
        if not isinstance(record, Decision):
            continue
        found = seen.scene()
        assert found is not None
        header, estimate, truth = newest[Header], newest.get(Estimate), newest.get(Truth)
        design = read_design(header)
        assert found.title == f"uavctl: {parse(header.config_toml, 'flight').config.name}"
        places = {body.name: body.at_m for body in found.bodies}
        assert found.time_s == pytest.approx((record.at_ns - header.started_ns) * 1e-9)
        assert found.age_s == (None if estimate is None else pytest.approx(estimate.age_s))
        assert places.get("estimate") == (None if estimate is None else design.position_of(estimate.mean))
        assert places.get("truth") == (None if truth is None else truth.position_m)
        if found.plan:
            plan = newest[Plan]
            assert plan.seq == record.plan_seq
            assert np.array_equal(found.plan, design.positions_of(np.array(plan.states)))
            assert found.box is not None and found.margins is not None
            sides = zip(found.box.lower_m, found.margins.lower_m, found.margins.upper_m, found.box.upper_m, strict=True)
            for low, tight_low, tight_high, high in sides:
                assert low is None or (tight_low is not None and low <= tight_low)
                assert high is None or (tight_high is not None and tight_high <= high)
            shown += 1
    assert shown > 10


def test_there_is_nothing_to_see_before_the_first_decision() -> None:
    seen = FlightScene()
    for _, _, record in fly_view().entries:
        if isinstance(record, Decision):
            break
        seen.add_record(record)
    assert seen.scene() is None


def test_newest_messages_come_first_and_old_ones_go() -> None:
    seen = FlightScene()
    rows = [record for _, _, record in fly_view().entries if isinstance(record, Header | Decision)]
    for record in rows[:2]:
        seen.add_record(record)
    for number in range(100):
        seen.add_record(Event(at_ns=number, severity="info", code="a", text=str(number)))  # type: ignore[arg-type]
    found = seen.scene()
    assert found is not None
    assert [one.text for one in found.events] == [str(number) for number in range(99, 99 - len(found.events), -1)]
    assert 1 < len(found.events) < 100


def test_a_browser_gets_the_page_its_script_and_one_state_after_another() -> None:
    count = iter(range(10**6))
    with serve_live_page(lambda: scene(next(count)), 0) as address:
        port = port_of(address)
        with asked(port, "/") as page:
            text = page.read().decode()
            assert page.status == 200 and 'src="/live.js"' in text and "http" not in text
        with asked(port, "/live.js") as script:
            assert script.status == 200 and b"EventSource" in script.read()
        with asked(port, "/scenes") as stream:
            times_s = [one["time_s"] for one in states(stream, 4)]
        assert times_s == sorted(set(times_s))
        with asked(port, "/etc/passwd") as other:
            assert other.status == 404


def test_a_foreign_site_s_page_gets_nothing() -> None:
    """By a name of its own that leads to this machine."""
    with serve_live_page(lambda: scene(0), 0) as address:
        for path in ("/", "/live.js", "/scenes"):
            with asked(port_of(address), path, Host=f"flights.example:{port_of(address)}") as answer:
                assert answer.status == 403
        with socket.socket() as other:
            other.settimeout(1.0)
            assert other.connect_ex(("127.0.0.2", port_of(address))) != 0


def test_more_pages_than_there_are_seats_are_refused_and_a_seat_that_is_left_is_free() -> None:
    with serve_live_page(lambda: scene(0), 0) as address:
        port = port_of(address)
        held = [asked(port, "/scenes") for _ in range(MOST_PAGES)]
        for one in held:
            states(one.__enter__(), 1)
        with asked(port, "/scenes") as more:
            assert more.status == 503
        for one in held:
            one.__exit__(None, None, None)
        for _ in range(round(LIMIT_S * 20)):
            with asked(port, "/scenes") as again:
                if again.status == 200:
                    return
            threading.Event().wait(0.05)
        pytest.fail("no seat became free")


def test_without_a_page_nothing_is_made_and_the_end_does_not_wait_for_a_page_that_has_stalled() -> None:
    made = []

    def look() -> LiveScene:
        made.append(threading.current_thread().name)
        return scene(0)

    with serve_live_page(look, 0) as address:
        with asked(port_of(address), "/") as page:
            page.read()
        assert not made
        stalled = socket.create_connection((HOST, port_of(address)))
        stalled.sendall(b"GET /scenes HTTP/1.1\r\nHost: localhost\r\n\r\n")
        while not made:
            threading.Event().wait(0.01)
    with suppress(OSError):
        stalled.close()
    assert threading.main_thread().name not in made
    with socket.socket() as other:
        assert other.connect_ex((HOST, port_of(address))) != 0


def test_a_port_that_cannot_be_had_is_told() -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=f"port {port} cannot be had"), serve_live_page(lambda: None, port):
            pass
    with pytest.raises(UsageError, match="ports are 1 to 65535"), serve_live_page(lambda: None, 65_536):
        pass
