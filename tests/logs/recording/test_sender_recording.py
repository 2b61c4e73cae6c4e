"""Recording of a sender: a disk that fails or hangs delays nothing, and what was written before is whole."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from patience import wait_until

import logs.recording.sender
from logs.recording.sender import TOPIC, SenderRecording


def test_what_was_sent_is_read_back(tmp_path: Path) -> None:
    with SenderRecording(tmp_path / "new" / "sender.mcap", ["a", "b"], 10**18) as recording:
        for number in range(3000):
            recording.add(number, number % 2, number - 5, 44, (0.1, 0.2))
    assert recording.failure == ""
    with (tmp_path / "new" / "sender.mcap").open("rb") as file:
        read = [
            (message.log_time, json.loads(message.data)) for _, _, message in make_reader(file).iter_messages([TOPIC])
        ]
    assert [at_ns for at_ns, _ in read] == [10**18 + number for number in range(3000)]
    assert [record["vehicle"] for _, record in read] == ["a", "b"] * 1500
    assert read[7][1] == {"vehicle": "b", "captured_ns": 2, "bytes": 44, "ages_s": {"a": 0.1, "b": 0.2}}


def test_a_disk_that_hangs_holds_up_neither_a_message_nor_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on, write = threading.Event(), Writer.add_message

    def hang(self: Writer, *arguments: Any) -> None:
        goes_on.wait()
        write(self, *arguments)

    monkeypatch.setattr(Writer, "add_message", hang)
    monkeypatch.setattr(logs.recording.sender, "MAX_WAITING", 10)
    monkeypatch.setattr(logs.recording.sender, "CLOSE_S", 0.05)
    with SenderRecording(tmp_path / "sender.mcap", ["a"], 0) as recording:
        for number in range(20):
            recording.add(number, 0, number, 44, (0.0,))
        assert recording.failure == "the disk hangs"
    goes_on.set()
    wait_until(lambda: not any(thread.name == "recording" for thread in threading.enumerate()), "the thread ends")


def test_a_write_error_is_named_and_ends_the_recording_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Writer, *arguments: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Writer, "add_message", fail)
    with SenderRecording(tmp_path / "sender.mcap", ["a"], 0) as recording:
        recording.add(0, 0, 0, 44, (0.0,))
        wait_until(lambda: recording.failure == "No space left on device", "the failure is known")
        recording.add(1, 0, 1, 44, (0.0,))
