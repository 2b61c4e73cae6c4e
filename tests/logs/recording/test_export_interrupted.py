"""An export that does not come to its end leaves nothing that was not there before, and takes nothing that was."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
from recording_fakes import record_flight

from logs.recording.export import TableFormat, Watch, export_tables
from logs.recording.file_scan import RecordedMessage
from logs.recording.output_files import remove_on_error
from logs.recording.reader import read_messages
from logs.recording.tlog import export_tlog
from uavctl.errors import RecordingError

Export = Callable[[Path, Path, Watch], object]


def tables(kind: TableFormat) -> Export:
    return lambda flight, out, watch: export_tables(flight, out, kind, watch=watch)


def tlog(flight: Path, out: Path, watch: Watch) -> object:
    return export_tlog(flight, out / "flight.tlog", watch=watch)


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    path = tmp_path / "flight.mcap"
    record_flight(path, 50)
    return path


def stopping(error: type[BaseException]) -> Watch:
    """Stops the writing half way: Ctrl-C, or a value that is refused."""

    def watch(messages: Iterable[RecordedMessage], _total: int | None, what: str) -> Iterator[RecordedMessage]:
        for place, message in enumerate(messages):
            if what == "writing" and place == 20:
                raise error
            yield message

    return watch


def below(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


@pytest.mark.parametrize("error", [KeyboardInterrupt, RecordingError])
@pytest.mark.parametrize("export", [tables(TableFormat.CSV), tables(TableFormat.PARQUET), tlog])
def test_no_folder_is_left(export: Export, error: type[BaseException], flight: Path, tmp_path: Path) -> None:
    with pytest.raises(error):
        export(flight, tmp_path / "new" / "deep", stopping(error))
    assert below(tmp_path) == {flight}


@pytest.mark.parametrize("export", [tables(TableFormat.CSV), tlog])
def test_what_was_there_stays(export: Export, flight: Path, tmp_path: Path) -> None:
    out, empty, notes = tmp_path / "mine", tmp_path / "mine" / "empty", tmp_path / "mine" / "notes.txt"
    empty.mkdir(parents=True)
    notes.write_text("mine")
    with pytest.raises(KeyboardInterrupt):
        export(flight, out, stopping(KeyboardInterrupt))
    assert below(tmp_path) == {flight, out, empty, notes}
    assert notes.read_text() == "mine"


def test_an_interruption_between_two_names_leaves_no_half_of_the_tables(
    flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace, renamed = Path.replace, list[Path]()

    def interrupted(part: Path, target: Path) -> Path:
        if renamed:
            raise KeyboardInterrupt
        renamed.append(target)
        return replace(part, target)

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        export_tables(flight, tmp_path / "csv", TableFormat.CSV)
    assert renamed
    assert below(tmp_path) == {flight}


def test_after_it_the_same_export_goes_through(flight: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        export_tables(flight, tmp_path / "csv", TableFormat.CSV, watch=stopping(KeyboardInterrupt))
    exported = export_tables(flight, tmp_path / "csv", TableFormat.CSV)
    rows = 0
    for one in exported.tables:
        with Path(one.file).open(newline="", encoding="utf-8") as file:
            rows += sum(1 for _ in csv.reader(file)) - 1
    assert rows == sum(one.rows for one in exported.tables) >= len(list(read_messages(flight))) - 1


def test_an_old_file_outlives_a_new_one(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "below" / "new"
    old.write_text("old")
    with pytest.raises(KeyboardInterrupt), remove_on_error([old, new]):
        new.parent.mkdir()
        new.write_text("new")
        raise KeyboardInterrupt
    assert below(tmp_path) == {old}
