"""Orders through a live view: they reach the sockets of the daemons of `uavctl ctl`, and those of nobody else."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from live_rig import ask, make_head
from order_rig import answer, serve_orders

from logs.live.orders import MAX_ORDERS, OrderName
from logs.live.process import LiveProcess
from logs.live.request import MAX_BODY_BYTES
from uavctl.daemon.control_socket import ControlRequest


def post(live: LiveProcess, document: object, **changes: str) -> tuple[int, str]:
    """Send an order as the page does, with other headers."""
    body = document if isinstance(document, bytes) else json.dumps(document).encode()
    headers = {
        "Host": f"localhost:{live.port}",
        "Origin": f"http://localhost:{live.port}",
        "X-Uavctl-Token": live.order_token,
        "Content-Type": "application/json",
        "Content-Length": str(len(body)),
        **{name.replace("_", "-"): value for name, value in changes.items()},
    }
    status, text = ask(live.port, make_head(headers, "/orders", "POST") + body)
    return status, text.decode()


def give(live: LiveProcess, order: str, vehicles: Sequence[str], **more: object) -> Any:
    status, text = post(live, {"order": order, "vehicles": list(vehicles), **more})
    assert status == 200, text
    return json.loads(text)


def test_each_order_comes_to_its_daemon_and_its_answer_back(tmp_path: Path) -> None:
    replies = {"west": answer(ok=True, text="holding"), "east": answer(ok=False, text="the pilot flies")}
    with serve_orders(tmp_path, replies) as (live, daemons):
        assert give(live, "hold", ["west"]) == [{"vehicle": "west", "ok": True, "text": "holding"}]
        assert give(live, "engage", ["east"]) == [{"vehicle": "east", "ok": False, "text": "the pilot flies"}]
        assert give(live, "goto", ["east"], position_m=[1.0, -2.0, -1.5])[0]["vehicle"] == "east"
        assert [one["ok"] for one in give(live, "land", ["east", "west"])] == [False, True]
    position_m = (1.0, -2.0, -1.5)
    assert daemons["west"].requests == [ControlRequest(ask="hold"), ControlRequest(ask="land")]
    assert daemons["east"].requests == [
        ControlRequest(ask="engage"),
        ControlRequest(ask="goto", position_m=position_m),
        ControlRequest(ask="land"),
    ]


@pytest.mark.fault(98)
def test_98_what_is_no_order_of_the_page_reaches_no_daemon(tmp_path: Path) -> None:
    """No take-off, no cell, no unknown vehicle, and no goto to several."""
    with serve_orders(tmp_path, {name: answer(ok=True, text="") for name in ("west", "east")}) as (live, daemons):
        for document in (
            {"order": "take-off", "vehicles": ["west"]},
            {"order": "cell", "vehicles": ["west"]},
            {"order": "status", "vehicles": ["west"]},
            {"order": "hold", "vehicles": ["west"], "may_take_off": True},
            {"order": "hold", "vehicles": []},
            {"order": "hold", "vehicles": ["west", "west"]},
            {"order": "hold", "vehicles": ["../west"]},
            {"order": "hold", "vehicles": ["south"]},
            {"order": "goto", "vehicles": ["west", "east"], "position_m": [0, 0, -1]},
            {"order": "engage", "vehicles": ["west", "east"]},
            {"order": "goto", "vehicles": ["west"], "position_m": [0, 0]},
            b"hold",
            b"",
            b"\xff",
        ):
            assert post(live, document)[0] == 400, document
        assert post(live, b" " * (MAX_BODY_BYTES + 1))[0] == 413
        assert not daemons["west"].requests and not daemons["east"].requests


CURL_CASES = (
    ("", "", "200"),
    ("Host: flights.example:{port}", "Origin: http://flights.example:{port}", "403"),
    ("Origin: http://flights.example", "", "403"),
    ("Origin:", "", "403"),
    ("Sec-Fetch-Site: cross-site", "", "403"),
    ("X-Uavctl-Token: {view_token}", "", "403"),
    ("X-Uavctl-Token:", "", "403"),
    ("Content-Type: text/plain", "", "415"),
)


@pytest.mark.fault(98)
def test_98_another_client_orders_only_as_the_page_with_the_token(tmp_path: Path) -> None:
    with serve_orders(tmp_path, {"one": answer(ok=True, text="")}) as (live, daemons):

        def run_curl(*arguments: str) -> str:
            command = ["curl", "-s", "-o", "/dev/null", "-w", "%{http_code}", "--max-time", "60", *arguments]
            url = f"http://localhost:{live.port}/orders"
            return subprocess.run([*command, url], capture_output=True, text=True, check=True).stdout

        body = ("--data-binary", '{"order":"land","vehicles":["one"]}')
        own = {
            "Origin": f"http://localhost:{live.port}",
            "X-Uavctl-Token": live.order_token,
            "Content-Type": "application/json",
        }
        own_texts = {name: f"{name}: {value}" for name, value in own.items()}
        for *changes, status in CURL_CASES:
            texts = [text.format(port=live.port, view_token=live.token) for text in changes if text]
            headers = {**own_texts, **{text.partition(":")[0]: text for text in texts}}
            options = [option for text in headers.values() for option in ("-H", text)]
            assert run_curl(*options, *body) == status, texts
        for method in ("PUT", "DELETE", "OPTIONS"):
            options = [option for text in own_texts.values() for option in ("-H", text)]
            assert run_curl("-X", method, *options, *body) == "405"
        assert daemons["one"].requests == [ControlRequest(ask="land")]


@pytest.mark.fault(98)
def test_98_the_token_is_new_at_each_start_and_no_answer_has_it(tmp_path: Path) -> None:
    tokens = set()
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        with serve_orders(folder, {"one": answer(ok=True, text="")}) as (live, _):
            assert live.page_url.endswith(f"#{live.order_token}")
            tokens |= {live.order_token, live.token}
            for path in ("/", "/live.js", "/history", "/orders"):
                status, text = ask(live.port, make_head({"Host": "localhost"}, path))
                assert status == 200 and live.order_token.encode() not in text
            for token, permitted in ((live.order_token, True), (live.token, False)):
                text = ask(live.port, make_head({"Host": "localhost", "X-Uavctl-Token": token}, "/orders"))[1]
                assert json.loads(text) == {"vehicles": ["one"], "permitted": permitted}
    assert len(tokens) == 4


def test_a_daemon_that_gives_no_answer_has_not_accepted(tmp_path: Path) -> None:
    replies = {"a": b"", "b": b"no json\n", "c": b'{"ok":true}\n', "d": b"x" * 100_000}
    with serve_orders(tmp_path, replies) as (live, _):
        told = give(live, "hold", list(replies))
        assert [one["ok"] for one in told] == [False] * 4 and all(one["text"] for one in told)


def test_a_daemon_that_has_ended_does_not_keep_the_others_from_landing(tmp_path: Path) -> None:
    with serve_orders(tmp_path, {name: answer(ok=True, text="lands") for name in ("west", "east")}) as (live, daemons):
        daemons["west"].close()
        west, east = give(live, "land", ["west", "east"])
        assert (west["ok"], east["ok"]) == (False, True) and west["text"]


@pytest.mark.fault(97)
def test_97_orders_that_wait_are_limited_and_the_page_is_served_meanwhile(tmp_path: Path) -> None:
    body = json.dumps({"order": "hold", "vehicles": ["one"]}).encode()
    with serve_orders(tmp_path, {"one": answer(ok=True, text="")}) as (live, daemons), ExitStack() as stack:
        daemons["one"].may_answer.clear()
        results: list[int] = []
        threads = [threading.Thread(target=lambda: results.append(post(live, body)[0])) for _ in range(MAX_ORDERS + 2)]
        for thread in threads:
            thread.start()
            stack.callback(thread.join)
        assert ask(live.port, make_head({"Host": "localhost"}))[0] == 200
    assert results.count(503) == 2 and results.count(200) == MAX_ORDERS


def test_every_order_of_the_page_is_one_of_uavctl_ctl() -> None:
    for name in OrderName.__args__:  # type: ignore[attr-defined]
        position_m = (0.0, 0.0, -1.0) if name == "goto" else None
        assert ControlRequest(ask=name, position_m=position_m).find_problem() is None
