"""The user's own runtime folders, with other users about: whose a lock is, and what they can do to it."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from user_rig import OTHER, run_as_other_user, shared_folder

from uavctl.daemon import runtime_folder
from uavctl.daemon.lock import find_lock_paths, lock_vehicle
from uavctl.daemon.runtime_folder import find_runtime_folders, is_private_folder
from uavctl.errors import UsageError, VehicleTakenError

URL = "udpin://127.0.0.1:14540"
ME = os.geteuid()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A machine's /run and /tmp, with no session of anybody."""
    with shared_folder() as folder:
        (folder / "run" / "user").mkdir(parents=True)
        (folder / "tmp").mkdir()
        (folder / "tmp").chmod(0o1777)
        monkeypatch.setattr(runtime_folder, "RUN", folder / "run")
        monkeypatch.setattr(runtime_folder, "TEMPORARY", folder / "tmp")
        monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
        yield folder


def session(machine: Path) -> Path:
    """The folder of this user's login session."""
    folder = machine / "run" / "user" / str(ME)
    folder.mkdir(mode=0o700)
    return folder


def test_the_session_s_folder_is_preferred_and_the_one_of_all_processes_is_used_too(machine: Path) -> None:
    everywhere = machine / "tmp" / f"uavctl-{ME}"
    assert find_runtime_folders({}) == (everywhere,)
    folder = session(machine)
    assert (
        find_runtime_folders({})
        == find_runtime_folders({"XDG_RUNTIME_DIR": str(folder)})
        == (folder / "uavctl", everywhere)
    )
    own = machine / "own"
    own.mkdir(mode=0o700)
    assert find_runtime_folders({"XDG_RUNTIME_DIR": str(own)}) == (own / "uavctl", folder / "uavctl", everywhere)
    (machine / "run" / "uavctl").mkdir(mode=0o700)  # as a service has it
    assert find_runtime_folders({})[1] == machine / "run" / "uavctl"
    for one in find_runtime_folders({}):
        assert stat.S_IMODE(one.stat().st_mode) == 0o700


@pytest.mark.parametrize("given", ["", "relative", "/no/such/folder"])
def test_a_session_s_folder_that_is_none_is_passed_over(machine: Path, given: str) -> None:
    assert find_runtime_folders({"XDG_RUNTIME_DIR": given}) == (machine / "tmp" / f"uavctl-{ME}",)


def open_to_others(folder: Path) -> None:
    folder.mkdir()
    folder.chmod(0o711)


def link(folder: Path) -> None:
    own = folder.with_name("elsewhere")
    own.mkdir(mode=0o700)
    folder.symlink_to(own)


def of_somebody_else(folder: Path) -> None:
    folder.mkdir(mode=0o700)
    if ME == 0:
        os.chown(folder, OTHER, OTHER)
    else:  # what belongs to another user and cannot be entered: to none can a file be given away
        folder.chmod(0)
        folder.rmdir()
        folder.symlink_to("/root")


def a_file(folder: Path) -> None:
    folder.write_text("")


HARMS = [open_to_others, link, of_somebody_else, a_file]


@pytest.mark.parametrize("harm", HARMS)
@pytest.mark.fault(56)
def test_what_is_not_one_s_own_is_not_used(machine: Path, harm: Callable[[Path], None]) -> None:
    given = machine / "given"
    harm(given)
    assert not is_private_folder(given)
    assert find_runtime_folders({"XDG_RUNTIME_DIR": str(given)}) == (machine / "tmp" / f"uavctl-{ME}",)
    folder = session(machine)
    harm(folder / "uavctl")  # as a root's process may have left it
    assert find_runtime_folders({}) == (machine / "tmp" / f"uavctl-{ME}",)


@pytest.mark.parametrize("harm", HARMS)
def test_a_place_that_is_taken_is_told_in_a_line_and_does_not_matter_beside_a_session(
    machine: Path, harm: Callable[[Path], None]
) -> None:
    harm(machine / "tmp" / f"uavctl-{ME}")
    with pytest.raises(UsageError, match=r"not a folder of this user alone.*sudo rm -r .*chmod 700 [^\n]*$"):
        find_runtime_folders({})
    folder = session(machine)
    assert find_runtime_folders({}) == (folder / "uavctl",)
    with lock_vehicle(URL):
        assert [path.parent for path in find_lock_paths(URL)] == [folder / "uavctl"]


@pytest.mark.fault(57)
def test_processes_of_one_user_meet_whatever_their_environment_says(
    machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with lock_vehicle(URL):  # a service, before anybody has logged in
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(session(machine)))
        with pytest.raises(VehicleTakenError, match=f"process {os.getpid()} already flies"), lock_vehicle(URL):
            pytest.fail("two daemons for one vehicle")
    with lock_vehicle(URL) as tenure:
        tenure.update(True)
        (machine / "run" / "user" / str(ME) / "uavctl").rename(machine / "gone")  # the session ends
        monkeypatch.delenv("XDG_RUNTIME_DIR")
        with pytest.raises(VehicleTakenError, match=f"process {os.getpid()} already flies"), lock_vehicle(URL):
            pytest.fail("two daemons for one vehicle")
    with lock_vehicle(URL) as tenure:
        assert tenure.is_left_in_flight  # whatever folder the next one finds, the word is there
        tenure.update(False)
    assert not any(path.exists() for path in find_lock_paths(URL))


@pytest.mark.fault(56)
def test_another_user_can_neither_rewrite_nor_hold_a_lock(machine: Path) -> None:
    def does() -> str:
        found = []
        for path in paths:
            try:
                with path.open("r+") as file:
                    file.write("x")
                found.append("written")
            except PermissionError:
                found.append("refused")
        return " ".join(found)

    def flies() -> str:
        with lock_vehicle(URL):
            return "flies, too"

    with lock_vehicle(URL):
        paths = find_lock_paths(URL)
        assert [stat.S_IMODE(path.stat().st_mode) for path in paths] == [0o600]
        second = run_as_other_user(flies)
        if OTHER == ME:  # the same user: there is one daemon
            assert second.startswith(f"VehicleTakenError: {URL}: process {os.getpid()} already flies this vehicle")
        else:  # who it is cannot be kept out by a lock, and cannot keep us out
            assert second == "flies, too" and run_as_other_user(does) == "refused"
    with lock_vehicle(URL):
        assert not is_private_folder(machine / "tmp")


@pytest.mark.fault(56)
def test_what_root_left_behind_is_told_in_a_line(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path,) = find_lock_paths(URL)
    path.touch(mode=0o666)
    if OTHER == ME:
        path.chmod(0)  # a file that this user cannot open; no other user's can be made
    else:
        os.chown(path, OTHER, OTHER)
    told = rf"^{path}: belongs to another user .*, so nothing shows that {URL} is free.*run: sudo rm {path}$"
    with pytest.raises(VehicleTakenError, match=told), lock_vehicle(URL):
        pytest.fail("the lock of another user was taken")
    path.unlink()
    with lock_vehicle(URL):
        pass

    def full(descriptor: int, data: bytes, offset: int) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    with pytest.raises(VehicleTakenError, match="No space left on device"), lock_vehicle(URL):
        pytest.fail("a lock without its word")
    assert not path.exists()
