"""A flight carries the policy library that it was flown with, and is replayed with that one and no other."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from loopback_rig import lockstep, make_loop
from recording_fakes import HEADER, Clock, Disk, Item, flight, own, stored_chunks
from report_rig import unpaged

from logs.recording.info import info
from logs.recording.reader import RecordedMessage, read, records, walk
from logs.recording.recorder import SyncRecorder
from logs.recording.recover import recover
from logs.recording.replay import recorded_library, replay
from uavctl.build.controller import build_design
from uavctl.build.library import StoredLibrary, cache_file, decode, encode, library_for
from uavctl.build.outside import decider_id
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.config.types import LogConfig
from uavctl.errors import RecordingError
from uavctl.records import Header, Plan, PolicyLibrary
from uavctl.smpc.hahn_stursberg.library import Library

LIBRARY = PolicyLibrary(library_id="l1", design_id="d1", data=bytes(range(256)) * 20)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("flights") / "one"
    with unpaged():
        assert run(["loopback", "--config", "paper", "--duration", "12", "--seed", "3", "--out", str(out)]) == 0
    return out / "flight.mcap"


@pytest.fixture(scope="module")
def stored() -> StoredLibrary:
    return library_for(build_design(load_config("paper")))


def document(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> dict[str, Any]:
    assert run([*arguments, "--json"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def rewritten(source: Path, target: Path, change: dict[type, msgspec.Struct | None]) -> Path:
    """A copy of a recording with records of some types changed, or left out."""
    recorder = SyncRecorder(target, clock=Clock())
    for topic, at_ns, record in own(list(read(source))):
        new = change.get(type(record), record)
        if new is not None:
            recorder.put(topic, at_ns, new)  # type: ignore[arg-type]  # the records of this file
    assert recorder.close().ok
    return target


def worse(library: Library) -> Library:
    """The same design's library with the cheapest policy of each component only."""
    return replace(
        library,
        variants=tuple(
            tuple(replace(part, theta=part.theta[:1], level=part.level[:1], slope=part.slope[:1]) for part in parts)
            for parts in library.variants
        ),
    )


def test_a_flight_carries_its_library_and_says_which(
    flown: Path, stored: StoredLibrary, capsys: pytest.CaptureFixture[str]
) -> None:
    header, carried = next(records(flown, Header)), recorded_library(flown)
    assert header.library_id == carried.library_id == stored.library_id
    assert carried.design_id == header.design_id
    assert carried.data == stored.data
    assert {"daqp", "clarabel", "numpy"} <= header.versions.keys()
    assert {plan.method for plan in records(flown, Plan)} <= {"frozen", "mixture", "exact"}
    found = document(capsys, "log", "info", str(flown))
    assert found["library"] == {"library_id": stored.library_id, "bytes": len(stored.data)}
    assert found["origin"]["library_id"] == stored.library_id
    assert found["start_ns"] == 0 and found["duration_s"] == pytest.approx(11.9)
    run(["log", "info", str(flown)])
    assert f"policy library {stored.library_id}" in capsys.readouterr().out


def test_it_replays_without_a_cache(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("UAVCTL_CACHE", str(tmp_path / "none"))
    found = document(capsys, "log", "replay", str(flown))
    assert found["identical"] and found["decisions"] == 120
    assert not (tmp_path / "none").exists()  # nothing was made, either


@pytest.mark.slow
def test_it_replays_with_its_own_library_when_the_cache_has_another(
    flown: Path, stored: StoredLibrary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setenv("UAVCTL_CACHE", str(tmp_path))
    config = load_config("paper", ["sim.seed=3"])
    design = build_design(config)
    file = cache_file(design)
    file.parent.mkdir(parents=True)
    other = worse(stored.library)
    file.write_bytes(encode(other, stored.names, stored.check, 0.0))
    assert library_for(design).library_id != stored.library_id
    # The other one does decide otherwise ...
    assert not replay(read(flown), lambda sink: make_loop(config, sink)).identical
    # ... and is not asked.
    assert document(capsys, "log", "replay", str(flown))["identical"]


def test_a_library_recorded_in_the_place_of_the_one_flown_with_is_found(
    flown: Path, stored: StoredLibrary, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = encode(worse(stored.library), stored.names, stored.check, 0.0)
    changed = msgspec.structs.replace(recorded_library(flown), data=data)
    found = document(
        capsys, "log", "replay", str(rewritten(flown, tmp_path / "x.mcap", {PolicyLibrary: changed})), code=1
    )
    assert found["first_difference"]["topic"] == "/uavctl/plan"


@pytest.mark.slow
def test_a_replay_that_differs_says_which_versions_it_was_recorded_with(
    flown: Path, stored: StoredLibrary, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert document(capsys, "log", "replay", str(flown))["other_versions"] == []
    header = next(records(flown, Header))
    assert header.versions["code"] == decider_id()
    without = {name: version for name, version in header.versions.items() if name != "code"}
    others = {
        "c.mcap": ({**header.versions, "code": "0123", "numpy": "1.0"}, "code 0123", 2),
        "d.mcap": (without, "code unknown", 1),
    }
    library = msgspec.structs.replace(
        recorded_library(flown), data=encode(worse(stored.library), stored.names, stored.check, 0.0)
    )
    for name, (changed, words, count) in others.items():
        other = msgspec.structs.replace(header, versions=changed)
        path = rewritten(flown, tmp_path / name, {Header: other, PolicyLibrary: library})
        found = document(capsys, "log", "replay", str(path), code=1)
        assert len(found["other_versions"]) == count
        assert f"recorded with {words}, here is {decider_id()}" in found["other_versions"]
        assert run(["log", "replay", str(path)]) == 1
        told = capsys.readouterr()
        assert f"recorded with {words}, here is {decider_id()}: decisions may differ" in " ".join(told.err.split())
        assert f"recorded with {words}, here is {decider_id()}" in told.out


def test_a_recording_that_lacks_its_library_is_told(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rewritten(flown, tmp_path / "x.mcap", {PolicyLibrary: None})
    assert run(["log", "replay", str(path)]) == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "carries none" in told and "Traceback" not in told
    assert info(path).library is None


def test_a_recorded_library_that_does_not_fit_is_told(
    flown: Path, stored: StoredLibrary, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    foreign = encode(replace(stored.library, design_id="0123"), stored.names, stored.check, 0.0)
    for name, data, words in (("a", foreign, "of design 0123"), ("b", stored.data[:-1], "damaged")):
        changed = msgspec.structs.replace(recorded_library(flown), data=data)
        path = rewritten(flown, tmp_path / f"{name}.mcap", {PolicyLibrary: changed})
        assert run(["log", "replay", str(path)]) == 1
        told = " ".join(capsys.readouterr().err.split())
        assert words in told and "the version that recorded it" in told


@pytest.mark.usefixtures("no_page")
def test_without_the_method_no_library_is_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--config", "paper", "--duration", "4", "--set", "solver.method=exact", "--out", str(tmp_path / "f"))
    document(capsys, "loopback", *options)
    path = tmp_path / "f" / "flight.mcap"
    assert next(records(path, Header)).library_id is None and info(path).library is None
    assert document(capsys, "log", "replay", str(path))["identical"]
    with pytest.raises(RecordingError, match="carries none"):
        recorded_library(path)


def test_the_same_library_decides_alike_whether_it_was_made_or_read(stored: StoredLibrary) -> None:
    # What was made and what the cache gave are the same bytes: so are the plans of two flights.
    one, other = (lockstep("paper", 8.0, "sim.seed=4").of(Plan) for _ in range(2))
    assert one == other
    assert decode(stored.data).library_id == stored.library_id


def with_library() -> list[Item]:
    header, *rest = flight(100)
    return [header, ("/uavctl/library", 5, LIBRARY), *rest]


def test_each_later_segment_begins_with_the_library_too(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    clock = Clock()
    recorder = SyncRecorder(
        path, LogConfig(chunk_bytes=1024), open_file=Disk(lambda number: number == 9).open, clock=clock
    )
    items = with_library()
    for topic, at_ns, record in items:
        clock.now_s += 0.1
        recorder.put(topic, at_ns, record)
    status = recorder.close()
    assert (status.ok, status.failures, len(status.segments)) == (True, 1, 2)
    assert own(list(read(path))) == items  # told once
    topics = [one.definition.topic for one in walk(path) if isinstance(one, RecordedMessage)]
    assert topics.count("/uavctl/header") == topics.count("/uavctl/library") == 2
    assert info(path).missing == 0
    recover(path, tmp_path / "whole.mcap")
    assert list(read(tmp_path / "whole.mcap"))[2] == items[1]
    # The second file alone says with what was decided.
    shutil.copy(tmp_path / "flight-2.mcap", tmp_path / "alone.mcap")
    assert recorded_library(tmp_path / "alone.mcap") == LIBRARY
    assert next(records(tmp_path / "alone.mcap", Header)) == HEADER


@pytest.mark.parametrize("failing", range(1, 14))
def test_wherever_a_write_fails_the_library_is_told_once(tmp_path: Path, failing: int) -> None:
    path = tmp_path / "flight.mcap"
    clock = Clock()
    recorder = SyncRecorder(
        path, LogConfig(chunk_bytes=1024), open_file=Disk(lambda number: number == failing).open, clock=clock
    )
    items = with_library()
    for topic, at_ns, record in items:
        clock.now_s += 0.1
        recorder.put(topic, at_ns, record)
    assert recorder.close().ok
    assert own(list(read(path))) == items
    assert info(path).missing == 0


def test_a_flipped_bit_in_the_library_is_never_a_wrong_library(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    recorder = SyncRecorder(path, clock=Clock())
    for item in with_library():
        recorder.put(*item)
    recorder.close()
    data = bytearray(path.read_bytes())
    base64_begins = b"AAECAwQF"
    at, length = next((at, length) for at, length, content in stored_chunks(bytes(data)) if base64_begins in content)
    for position in np.random.default_rng(1).integers(at, at + length, 40):
        wrong = data.copy()
        wrong[position] ^= 4
        path.write_bytes(wrong)
        with pytest.raises(RecordingError):
            recorded_library(path)
