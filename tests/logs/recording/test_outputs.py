"""Files that a command writes: whole or not at all, and never in the place of something that is no file."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from recording_fakes import record_flight

from logs.recording.output_files import refuse_existing_files, write_atomically
from logs.recording.recover import recover
from logs.recording.segment import Segment
from uavctl.cli.flying import LIVE_PORT, choose_live_port
from uavctl.errors import RecordingError, UsageError

# Of one file: a write beyond it fails as on a full disk, at a byte that is known.
LIMITED = """
import resource, signal, sys
from pathlib import Path
from logs.recording.output_files import write_atomically
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
write_atomically(Path(sys.argv[1]), "new" * 1000)
"""


def test_a_text_that_does_not_fit_leaves_the_one_before(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    write_atomically(page, "the page of before")
    done = subprocess.run([sys.executable, "-c", LIMITED, str(page)], capture_output=True, text=True, check=False)
    assert f"RecordingError: {page}: cannot be written (File too large); choose another place" in done.stderr
    assert page.read_text(encoding="utf-8") == "the page of before"
    assert list(tmp_path.iterdir()) == [page]


def test_a_text_goes_through_what_is_no_file(tmp_path: Path) -> None:
    script = (
        "from pathlib import Path; from logs.recording.output_files import write_atomically; "
        "write_atomically(Path('/dev/stdout'), 'a')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "a"
    with pytest.raises(RecordingError, match="cannot be written"):
        write_atomically(tmp_path, "a folder")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_atomically(tmp_path / "missing" / "page.html", "no folder")


def test_what_is_no_file_is_never_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for target in (pipe, tmp_path):
        with pytest.raises(UsageError, match="is no file"):
            refuse_existing_files([target], force=True)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_recovery_that_is_interrupted_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    source = tmp_path / "flight.mcap"
    record_flight(source, 5)
    monkeypatch.setattr(Segment, "add", interrupted)
    with pytest.raises(KeyboardInterrupt):
        recover(source, tmp_path / "restored.mcap")
    assert not (tmp_path / "restored.mcap").exists()


def test_a_port_without_a_view_is_refused() -> None:
    assert (choose_live_port(live=False, port=None), choose_live_port(live=True, port=None)) == (None, LIVE_PORT)
    assert choose_live_port(live=True, port=1234) == 1234
    with pytest.raises(UsageError, match="--live-port 1234"):
        choose_live_port(live=False, port=1234)
