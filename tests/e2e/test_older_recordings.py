"""Recordings made by versions before: what flies now decides as it did, bit for bit.

Those of scheme `age-conditioned` are of version 0.1. Those of scheme `hahn-stursberg` are later: before, it flew with a
policy library.
"""

from __future__ import annotations

import json
import lzma
from pathlib import Path

import pytest
from places import DATA

from uavctl.cli.app import run

FOLDER = DATA / "recordings"
# Least number of records compared, so that an empty comparison is no agreement.
RECORDINGS = {"paper": 2000, "room": 700, "room-ardupilot": 500, "room-hahn-stursberg": 1500, "room-px4": 2500}


def test_every_recording_is_replayed() -> None:
    assert {path.name.removesuffix(".mcap.xz") for path in FOLDER.iterdir()} == set(RECORDINGS)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_of_before_replays_identically(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(lzma.decompress((FOLDER / f"{name}.mcap.xz").read_bytes()))
    assert run(["log", "replay", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["identical"] and document["decisions_differing"] == 0
    assert not document["texts_compared"]  # they were written before the first version of texts
    assert document["compared"] > RECORDINGS[name]
