"""`uavctl doctor`: each finding from invented readings, and the command on this computer with a port that is taken."""

from __future__ import annotations

import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from uavctl.check.findings import ItemState
from uavctl.cli.app import run
from uavctl.cli.computer_items import GROUND_STATION_URL, Library, Readings, make_computer_items, parse_requirement
from uavctl.daemon.realtime import RealtimeSetting

FIT = Readings(
    python=(3, 12, 1),
    lowest_python="3.11",
    uavctl="1.0",
    libraries=(
        Library(name="numpy", lowest="2.4", installed="2.4.0"),
        Library(name="pyarrow", lowest="17.0", installed="26.0.1", extra="parquet"),
    ),
    missing_features=(),
    realtime=(RealtimeSetting("scheduling", True, "SCHED_FIFO"),),
    governors=frozenset({"performance"}),
    ports={"udpin://0.0.0.0:14540": "", GROUND_STATION_URL: ""},
    is_clock_synchronised=True,
    sleep_late_s=(0.0001, 0.0002),
    disk_sync_s=0.01,
)
NUMPY = FIT.libraries[0]
NO_RIGHT = (RealtimeSetting("scheduling", False, "not permitted; set rtprio"),)
FINDINGS: list[tuple[str, ItemState, dict[str, Any]]] = [
    ("Python", ItemState.BAD, {"python": (3, 10, 14)}),
    ("libraries", ItemState.BAD, {"libraries": (replace(NUMPY, installed=None),)}),
    ("libraries", ItemState.BAD, {"libraries": (replace(NUMPY, installed="2.3.9"),)}),
    ("libraries", ItemState.BAD, {"libraries": (replace(NUMPY, lowest="2.10"),)}),
    ("extras", ItemState.NOTE, {"libraries": (NUMPY, replace(FIT.libraries[1], installed=None))}),
    ("system", ItemState.BAD, {"missing_features": ("fcntl.flock",)}),
    ("scheduling", ItemState.NOTE, {"realtime": NO_RIGHT}),
    ("CPU governor", ItemState.NOTE, {"governors": frozenset({"performance", "powersave"})}),
    ("CPU governor", ItemState.UNDETERMINED, {"governors": frozenset()}),
    ("port 14540", ItemState.BAD, {"ports": {"udpin://0.0.0.0:14540": "in use"}}),
    ("port 14550", ItemState.NOTE, {"ports": {GROUND_STATION_URL: "in use"}}),
    ("clock", ItemState.NOTE, {"is_clock_synchronised": False}),
    ("clock", ItemState.UNDETERMINED, {"is_clock_synchronised": None}),
    ("sleep", ItemState.NOTE, {"sleep_late_s": (0.0, 0.02)}),
    ("disk sync", ItemState.NOTE, {"disk_sync_s": 3.0}),
    ("disk sync", ItemState.BAD, {"disk_sync_s": None}),
]


def test_a_fit_computer_has_good_items_only() -> None:
    assert {item.state for item in make_computer_items(FIT)} == {ItemState.GOOD}


@pytest.mark.parametrize(("name", "state", "changed"), FINDINGS)
def test_a_finding_is_alone_and_says_what_to_do(name: str, state: ItemState, changed: dict[str, Any]) -> None:
    (item,) = (item for item in make_computer_items(replace(FIT, **changed)) if item.state is not ItemState.GOOD)
    assert (item.name, item.state, item.ok) == (name, state, state is not ItemState.BAD)
    assert item.hint


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("numpy>=2.4", ("numpy", "2.4", "")),
        ('pyarrow>=17.0; extra == "parquet"', ("pyarrow", "17.0", "parquet")),
        ("mcap-protobuf-support >= 0.5.2 ; extra == 'x'", ("mcap-protobuf-support", "0.5.2", "x")),
        ("build", ("build", "", "")),
    ],
)
def test_a_requirement_is_read(text: str, parts: tuple[str, str, str]) -> None:
    assert parse_requirement(text) == parts


def test_the_command_names_a_taken_port_and_leaves_the_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "flights"
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free,
    ):
        taken.bind(("127.0.0.1", 0))
        free.bind(("127.0.0.1", 0))
        busy, other = taken.getsockname()[1], free.getsockname()[1]
        free.close()
        urls = (f"daemon.vehicle=udpin://127.0.0.1:{busy}", f"daemon.mocap=udpin://127.0.0.1:{other}")
        arguments = [argument for url in urls for argument in ("--set", url)]
        assert run(["doctor", "--json", "--out", str(out), *arguments]) == 1
    document = json.loads(capsys.readouterr().out)
    assert [item["name"] for item in document["items"] if not item["ok"]] == [f"port {busy}"]
    assert document["ok"] is False
    assert list(tmp_path.iterdir()) == []
