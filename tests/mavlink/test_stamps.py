"""Stamps on the disk: no restart takes an old frame, and no disk stops a flight."""

from __future__ import annotations

import fcntl
import stat
import threading
from pathlib import Path

import pytest
from mavlink_rig import Peer
from patience import LIMIT_S
from signing_rig import OFFSET_NS, STAMP, SignedPeer, make_signing

from uavctl.errors import KeyFileError
from uavctl.io.timestamp_file import (
    LOCK_TRIES,
    RENEW_MARGIN,
    WRITE_AHEAD,
    TimestampFile,
    find_state_folder,
    load_timestamp,
    save_timestamp,
)
from uavctl.mavlink.signing import MAX_TIMESTAMP, SignatureRefusal


@pytest.mark.parametrize(
    ("environment", "folder"),
    [
        ({"STATE_DIRECTORY": "/var/lib/uavctl:/other", "XDG_STATE_HOME": "/x"}, "/var/lib/uavctl"),
        ({"XDG_STATE_HOME": "/x"}, "/x/uavctl"),
        ({}, "~/.local/state/uavctl"),
    ],
)
def test_where_stamps_are_kept(environment: dict[str, str], folder: str) -> None:
    assert find_state_folder(environment) == Path(folder).expanduser()


def test_a_stamp_comes_back_and_never_gets_smaller(tmp_path: Path) -> None:
    path = tmp_path / "new" / "key.stamp"
    assert load_timestamp(path) == 0
    save_timestamp(path, STAMP)
    save_timestamp(path, STAMP - 1)  # another daemon with the same key was ahead
    assert load_timestamp(path) == STAMP
    save_timestamp(path, MAX_TIMESTAMP)
    assert load_timestamp(path) == MAX_TIMESTAMP


@pytest.mark.parametrize("text", ["", "x", "-1", str(2**48), "1.5", "é", "12\x00"])
def test_a_damaged_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "key.stamp"
    path.write_text(text)
    with pytest.raises(KeyFileError, match="remove the file"):
        load_timestamp(path)
    with pytest.raises(KeyFileError, match="remove the file"):
        TimestampFile(path, STAMP)


def test_a_folder_that_cannot_be_written_is_refused_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(KeyFileError, match="check the folder"):
        TimestampFile(tmp_path / "file" / "key.stamp", STAMP)


def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "key.stamp"
    save_timestamp(path, STAMP)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("uavctl.io.timestamp_file.os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_timestamp(path, STAMP + 1)
    assert load_timestamp(path) == STAMP


def test_two_writers_leave_the_larger_one(tmp_path: Path) -> None:
    path = tmp_path / "key.stamp"

    def write(first: int) -> None:
        for stamp in range(first, first + 400, 2):
            save_timestamp(path, stamp)

    threads = [threading.Thread(target=write, args=(first,)) for first in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert load_timestamp(path) == 399


@pytest.mark.fault(37)
def test_a_kill_at_any_moment_lets_no_old_frame_in_again(tmp_path: Path) -> None:
    """The file alone is taken over, as after a kill; what was taken before is refused, what comes later is taken."""
    path = tmp_path / "key.stamp"
    keeper = TimestampFile(path, STAMP)
    try:
        signing = make_signing(keeper.timestamps)
        taken: list[bytes] = []
        for second in range(20):
            keeper.renew()  # as its thread does, four times a second
            for n in range(10):
                at_ns = second * 10**9 + n * 10**8
                frame = SignedPeer(stamp=STAMP + at_ns // 10_000).heartbeat()
                assert signing.verify(frame, at_ns) is None
                taken.append(frame)
            again = TimestampFile(path, 0, write=lambda path, stamp: None)
            again.close()
            restarted = make_signing(again.timestamps)
            assert {restarted.verify(frame, at_ns) for frame in taken} == {SignatureRefusal.REPLAYED}
            later = STAMP + (at_ns + 3 * 10**9) // 10_000
            assert restarted.verify(SignedPeer(stamp=later).heartbeat(), at_ns) is None
    finally:
        keeper.close()


@pytest.mark.fault(37)
def test_a_restart_sends_no_stamp_twice_even_if_the_clock_went_back(tmp_path: Path) -> None:
    path, frame = tmp_path / "key.stamp", Peer(245, 25).heartbeat()
    keeper = TimestampFile(path, STAMP)
    sent = make_signing(keeper.timestamps).sign(frame, 0)
    keeper.renew()
    keeper.close()
    again = TimestampFile(path, STAMP)
    again.close()
    late = make_signing(again.timestamps).sign(frame, -3600 * 10**9)
    assert int.from_bytes(late[-12:-6], "little") > int.from_bytes(sent[-12:-6], "little")


def test_it_is_written_only_when_it_has_to_be(tmp_path: Path) -> None:
    writes: list[int] = []
    keeper = TimestampFile(tmp_path / "key.stamp", 0, write=lambda path, stamp: writes.append(stamp))
    keeper.close()
    assert writes == [WRITE_AHEAD]
    for stamp in range(0, 4 * RENEW_MARGIN, RENEW_MARGIN // 10):
        keeper.timestamps.newest = stamp
        keeper.renew()
    assert writes[1:] == [
        stamp + WRITE_AHEAD
        for stamp in (RENEW_MARGIN + RENEW_MARGIN // 10, 2 * RENEW_MARGIN + RENEW_MARGIN // 5, 33 * RENEW_MARGIN // 10)
    ]


@pytest.mark.fault(37)
def test_a_disk_that_fails_is_told_and_stops_nothing(tmp_path: Path) -> None:
    broken = [False]

    def write(path: Path, stamp: int) -> None:
        if broken[0]:
            raise OSError(28, "No space left on device")

    keeper = TimestampFile(tmp_path / "key.stamp", 0, write=write)
    keeper.timestamps.newest = STAMP
    broken[0] = True
    keeper.renew()
    assert "No space" in str(keeper.failure)
    broken[0] = False
    keeper.renew()
    keeper.close()
    assert keeper.failure is None


def test_its_thread_writes_by_itself(tmp_path: Path) -> None:
    written = threading.Event()

    def write(path: Path, stamp: int) -> None:
        if stamp > STAMP:
            written.set()

    keeper = TimestampFile(tmp_path / "key.stamp", 0, write=write)
    keeper.timestamps.newest = STAMP
    try:
        assert written.wait(LIMIT_S)
    finally:
        keeper.close()


def test_the_rig_s_clock_is_that_of_the_stamps() -> None:
    assert OFFSET_NS == 1_800_000_000 * 10**9


@pytest.mark.fault(56)
def test_no_other_user_can_open_the_files_and_what_one_left_half_written_is_not_in_the_way(tmp_path: Path) -> None:
    path = tmp_path / "keys" / "key.stamp"
    save_timestamp(path, STAMP)
    lock, draft = path.with_suffix(".lock"), path.with_suffix(".new")
    lock.chmod(0o644)
    draft.symlink_to(tmp_path / "precious")
    save_timestamp(path, STAMP + 1)
    assert load_timestamp(path) == STAMP + 1
    assert not draft.exists() and not (tmp_path / "precious").exists()
    assert [stat.S_IMODE(one.stat().st_mode) for one in (path.parent, path, lock)] == [0o700, 0o600, 0o600]
    lock.unlink()
    lock.symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match="symbolic links"):
        save_timestamp(path, STAMP + 2)
    assert not (tmp_path / "precious").exists()


def test_a_lock_that_somebody_holds_keeps_no_daemon_waiting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "key.stamp"
    pauses: list[float] = []
    monkeypatch.setattr("uavctl.io.timestamp_file.time.sleep", pauses.append)
    with path.with_suffix(".lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(KeyFileError, match="Resource temporarily unavailable"):
            TimestampFile(path, STAMP)
    assert len(pauses) == LOCK_TRIES
