"""Recording of a sender: no disk delays a position; a replay gives each choice again, and round-robin's cost."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from patience import wait_until
from sender_recordings import SLOT_NS, make_parameters, open_sender_recording

import logs.recording.recorder
from logs.recording.disk import DiskFile
from logs.recording.file_scan import RecordedMessage, scan_file
from logs.recording.fleet_replay import find_fleet_kind, replay_sender
from logs.recording.info import read_info
from logs.recording.reader import read
from logs.recording.recorder import Recorder, SyncRecorder
from logs.recording.recover import recover
from logs.recording.sender import SenderRecording, read_sender
from logs.recording.sender_choices import ScheduleComparison, compare_with_round_robin
from logs.recording.topics import SENT
from uavctl.errors import RecordingError
from uavctl.fleet_records import OfferedPosition, SentPosition
from uavctl.schedule.scheduler import ScheduleName
from uavctl.wiring.radio import PlacedSchedule, ScheduleParameters

NAMES = ("a", "b", "c")
AGES = [float(age) for age in range(100)]


def record_choices(recording: SenderRecording, parameters: ScheduleParameters, messages: int, loss: float = 0.0) -> int:
    """A position of each vehicle before each message, the second and third near to a limit; count reports."""
    schedule, rng, reports = PlacedSchedule(parameters, 0.4, 0), np.random.default_rng(3), 0
    for slot in range(1, messages + 1):
        at_ns = slot * SLOT_NS
        for number in range(len(parameters.vehicles)):
            place_m, captured_ns = (0.0, 99.95 * (number > 0), float(number)), at_ns - 1000 * (number + 1)
            if schedule.add_position(number, captured_ns, place_m):
                recording.add_position(at_ns, number, captured_ns, place_m)
        if slot % 5 == 0:
            schedule.update_placed_weights()
            recording.add_weights(at_ns, schedule.weights)
        chosen = schedule.scheduler.choose(at_ns)
        assert chosen is not None
        sent_ns = schedule.scheduler.vehicles[chosen].sent_ns
        assert sent_ns is not None
        recording.add(at_ns, chosen, sent_ns, 44, schedule.scheduler.ages_s)
        if parameters.feedback_ns and rng.random() > loss:
            reports += 1
            schedule.scheduler.add_feedback(chosen, sent_ns, at_ns + 1)
            recording.add_report(at_ns + 1, chosen, sent_ns)
    return reports


def make_unequal(schedule: ScheduleName, loss: float = 0.0, feedback_ns: int = 0) -> ScheduleParameters:
    return make_parameters([[factor * age for age in AGES] for factor in (0.1, 1.0, 5.0)], schedule, loss, feedback_ns)


def test_what_was_sent_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "sender.mcap"
    with open_sender_recording(path, ["a", "b"], 10**18, recorder=Recorder) as recording:
        for number in range(3000):
            recording.add(number, number % 2, number - 5, 44, (0.1, 0.2))
    assert recording.failure == ""
    with path.open("rb") as file:
        messages = [
            (message.log_time, json.loads(message.data)) for _, _, message in make_reader(file).iter_messages([SENT])
        ]
    assert [at_ns for at_ns, _ in messages] == [10**18 + number for number in range(3000)]
    assert [record["vehicle"] for _, record in messages] == ["a", "b"] * 1500
    assert messages[7][1] == {"vehicle": "b", "captured_ns": 2, "bytes": 44, "ages_s": {"a": 0.1, "b": 0.2}}


def test_a_disk_that_hangs_holds_up_neither_a_message_nor_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on, is_reached, write = threading.Event(), threading.Event(), DiskFile.write

    def hang(self: DiskFile, data: bytes) -> None:
        is_reached.set()
        goes_on.wait()
        write(self, data)

    monkeypatch.setattr(DiskFile, "write", hang)
    recorder = Recorder(tmp_path / "sender.mcap")
    recording = SenderRecording(recorder, ["a"], make_parameters([AGES]), spacing_m=0.4, start_ns=0, zero_utc_ns=0)
    for number in range(20_000):  # more than may wait
        recording.add(number, 0, number, 44, (0.0,))
    wait_until(is_reached.is_set, "the disk hangs")
    monkeypatch.setattr(logs.recording.recorder, "LATE_S", 0.0)
    assert recording.failure
    assert recorder.close(0.05).problem
    goes_on.set()
    wait_until(lambda: not any(thread.name == "recorder" for thread in threading.enumerate()), "the thread ends")


def test_a_write_error_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: DiskFile, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(DiskFile, "write", fail)
    with open_sender_recording(tmp_path / "sender.mcap", ["a"], recorder=Recorder) as recording:
        wait_until(lambda: "No space left on device" in recording.failure, "the failure is known")
        recording.add(1, 0, 1, 44, (0.0,))
    assert recording.failure


@pytest.mark.parametrize("schedule", ["round-robin", "oldest-first", "value"])
def test_a_replay_gives_each_choice_and_weight_again(tmp_path: Path, schedule: ScheduleName) -> None:
    path, parameters = tmp_path / "sender.mcap", make_unequal(schedule, loss=0.3, feedback_ns=2 * SLOT_NS)
    with open_sender_recording(path, NAMES, parameters=parameters) as recording:
        assert record_choices(recording, parameters, 200, loss=0.3) > 100
    result = replay_sender(path)
    assert (result.identical, result.decisions, result.compared) == (True, 200, 240)
    assert find_fleet_kind(path) == result.kind == "sender"


def test_a_replay_finds_the_first_choice_that_a_missing_position_changes(tmp_path: Path) -> None:
    path, changed, parameters = tmp_path / "sender.mcap", tmp_path / "changed.mcap", make_unequal("round-robin")
    with open_sender_recording(path, NAMES, parameters=parameters) as recording:
        record_choices(recording, parameters, 60)
    recorder, served_ns, left_out_ns = SyncRecorder(changed), dict[str, int](), 0
    for topic, at_ns, record in read(path):
        if isinstance(record, SentPosition):
            served_ns[record.vehicle] = at_ns
        is_next = min(NAMES, key=lambda name: (served_ns.get(name, 0), name)) == "b"
        if isinstance(record, OfferedPosition) and record.vehicle == "b" and at_ns > 30 * SLOT_NS:
            if not left_out_ns and is_next:
                left_out_ns = at_ns
            if at_ns == left_out_ns:
                continue
        if topic != "/uavctl/recorder":
            recorder.put(topic, at_ns, record)
    assert left_out_ns and recorder.close().ok
    difference = replay_sender(changed).first_difference
    assert difference is not None and difference.at_ns == left_out_ns and difference.topic == SENT


def test_a_recording_that_lacks_records_is_not_replayed(tmp_path: Path) -> None:
    path, parameters = tmp_path / "sender.mcap", make_unequal("value")
    with open_sender_recording(path, NAMES, parameters=parameters) as recording:
        record_choices(recording, parameters, 3000)
    data, messages = bytearray(path.read_bytes()), (one for one in scan_file(path) if isinstance(one, RecordedMessage))
    data[next(message.offset for message in messages if message.sequence == 6000) + 200] ^= 0xFF
    path.write_bytes(data)
    assert recover(path, tmp_path / "rest.mcap").messages_lost > 0
    with pytest.raises(RecordingError, match="lacks records"):
        replay_sender(tmp_path / "rest.mcap")
    assert len(read_sender(tmp_path / "rest.mcap").at_ns) > len(read_sender(path).at_ns)


def compare(path: Path, end_ns: int = 10**18) -> ScheduleComparison:
    result = compare_with_round_robin(path, 0, end_ns)
    assert result is not None
    return result


def test_round_robin_costs_what_it_costs_by_hand_and_the_same_as_itself(tmp_path: Path) -> None:
    path, parameters = tmp_path / "sender.mcap", make_unequal("round-robin")
    with open_sender_recording(path, NAMES, parameters=parameters) as recording:
        record_choices(recording, parameters, 4)  # without an update of the weights
    result = compare(path)
    # Before messages 1 to 4 no vehicle, then a, then a and b, then all have a position; else it is as old as the flight
    slots = np.array([[1, 1, 1], [1, 2, 2], [2, 1, 3], [3, 2, 1]])
    np.testing.assert_allclose(result.costs, slots.mean(axis=0) * [0.1, 1.0, 5.0])
    np.testing.assert_allclose(result.ages_s, slots.mean(axis=0) * SLOT_NS * 1e-9, atol=3e-6)
    assert result.change == 0.0
    early = compare(path, 2 * SLOT_NS)
    assert early.messages == 2
    np.testing.assert_allclose(early.costs, slots[:2].mean(axis=0) * [0.1, 1.0, 5.0])
    assert np.array_equal(result.ages_s, result.round_robin_ages_s)


def test_value_costs_less_than_round_robin_where_costs_differ_and_the_same_where_not(tmp_path: Path) -> None:
    for name, parameters in (("unequal", make_unequal("value")), ("equal", make_parameters([AGES] * 3))):
        with open_sender_recording(tmp_path / f"{name}.mcap", NAMES, parameters=parameters) as recording:
            record_choices(recording, parameters, 4 if name == "equal" else 300)
    change = compare(tmp_path / "unequal.mcap").change
    assert change is not None and change < -0.05
    assert compare(tmp_path / "equal.mcap").change == 0.0


def write_version_1(path: Path, count: int) -> None:
    """As version 1 wrote it: the positions sent alone, in chunks of which only the first names the channel."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096)
        writer.start(profile="", library="uavctl")
        schema = writer.register_schema("uavctl.SentPosition", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel(SENT, "json", schema)
        for number in range(count):
            record = SentPosition(vehicle="ab"[number % 2], captured_ns=number, bytes=44, ages_s={"a": 0.1, "b": 0.2})
            writer.add_message(channel, 10**18 + number, msgspec.json.encode(record), 10**18 + number)
        writer.finish()  # type: ignore[no-untyped-call]


def test_recordings_of_version_1_are_read_and_recovered(tmp_path: Path) -> None:
    path = tmp_path / "sender.mcap"
    write_version_1(path, 500)
    sent = read_sender(path)
    assert sent.names == ("a", "b") and sent.fault == ""
    assert sent.at_ns.tolist() == [10**18 + number for number in range(500)]
    info = read_info(path)
    assert info.messages == 500 and not info.damage and info.finished
    result = recover(path, tmp_path / "again.mcap")
    assert result.messages == 500 and result.lost_bytes == 0
    assert find_fleet_kind(path) == "sender" and compare_with_round_robin(path, 0, 2 * 10**18) is None
    with pytest.raises(RecordingError, match="earlier version"):
        replay_sender(path)
