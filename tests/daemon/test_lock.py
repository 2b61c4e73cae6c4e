"""One daemon a vehicle, whatever its URL looks like."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from uavctl.daemon.lock import MAX_FLIGHT_NS, VehicleLock, identify_connection, lock_vehicle
from uavctl.errors import ConnectionSpecError, VehicleTakenError

URL = "udpin://127.0.0.1:14540"


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("udpout://localhost:14550", "udpout://127.0.0.1:14550"),
        ("tcp://[::1]:5760", "tcp://127.0.0.1:5760"),
        ("tcp://[::ffff:10.0.0.7]:5760", "tcp://10.0.0.7:5760"),
        ("tcp://0.0.0.0:5760", "tcp://127.0.0.1:5760"),
        ("udpin://[::]:14540", "udpin://0.0.0.0:14540"),
        ("serial:///dev/ttyACM0:57600", "serial:///dev/ttyACM0:921600"),
    ],
)
def test_urls_that_mean_the_same_are_one_vehicle(one: str, other: str) -> None:
    assert identify_connection(one) == identify_connection(other)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (URL, "udpin://127.0.0.1:14541"),
        (URL, "udpin://127.0.0.2:14540"),
        (URL, "udpout://127.0.0.1:14540"),  # sends there instead of listening there
        ("serial:///dev/ttyACM0:57600", "serial:///dev/ttyACM1:57600"),
    ],
)
def test_other_vehicles_are_others(one: str, other: str) -> None:
    assert identify_connection(one) != identify_connection(other)


def test_a_link_to_a_serial_device_is_the_device(tmp_path: Path) -> None:
    (tmp_path / "tty").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "tty")
    assert identify_connection(f"serial://{tmp_path}/by-id:57600") == identify_connection(
        f"serial://{tmp_path}/tty:57600"
    )


@pytest.mark.parametrize("url", ["tcp://127.0.0.1:port", "udpin://no.such.host.invalid:14540"])
def test_what_leads_nowhere_is_told(url: str) -> None:
    with pytest.raises(ConnectionSpecError, match=url):
        identify_connection(url)


@pytest.mark.fault(35)
def test_the_second_one_is_refused_with_the_first_one_s_pid(tmp_path: Path) -> None:
    taken = pytest.raises(VehicleTakenError, match=f"process {os.getpid()} already flies")
    with lock_vehicle(URL, tmp_path), taken, lock_vehicle("udpin://localhost:14540", tmp_path):
        pytest.fail("two daemons for one vehicle")
    with lock_vehicle(URL, tmp_path):  # free again
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.fault(35)
def test_two_vehicles_do_not_meet(tmp_path: Path) -> None:
    with lock_vehicle(URL, tmp_path), lock_vehicle("udpin://127.0.0.1:14541", tmp_path):
        assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.fault(31, 35)
def test_a_killed_holder_lets_go(tmp_path: Path) -> None:
    program = (
        "import sys, time; from pathlib import Path; from uavctl.daemon.lock import lock_vehicle\n"
        "with lock_vehicle(sys.argv[1], Path(sys.argv[2])): print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program, URL, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdout.readline() == b"held\n"
        with pytest.raises(VehicleTakenError, match=f"process {process.pid}"), lock_vehicle(URL, tmp_path):
            pytest.fail("two daemons for one vehicle")
        process.send_signal(signal.SIGKILL)
    with lock_vehicle(URL, tmp_path):
        pass


@pytest.mark.fault(31)
def test_the_next_holder_is_told_of_a_vehicle_that_was_left_in_flight(tmp_path: Path) -> None:
    program = (
        "import os, sys; from pathlib import Path; from uavctl.daemon.lock import lock_vehicle\n"
        "with lock_vehicle(sys.argv[1], Path(sys.argv[2])) as tenure:\n"
        "    for word in sys.argv[3:]: tenure.update({'yes': True, 'no': False, 'unheard': None}[word])\n"
        "    os.abort()"
    )

    def killed(*words: str) -> None:
        done = subprocess.run([sys.executable, "-c", program, URL, str(tmp_path), *words], check=False)
        assert done.returncode == -signal.SIGABRT

    def found() -> bool:
        with lock_vehicle(URL, tmp_path) as tenure:
            leaves = tenure.is_left_in_flight
            tenure.update(False)
        return leaves

    killed("unheard", "no")
    assert not found()
    killed("unheard", "no", "yes")
    killed("unheard")  # a daemon that heard nothing of the vehicle passes the word on
    assert found() and not found()
    killed("yes", "no")
    assert not found()
    assert not list(tmp_path.iterdir())


@pytest.mark.fault(31)
def test_a_flight_that_ends_in_the_air_is_left_too(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), lock_vehicle(URL, tmp_path) as tenure:
        tenure.update(True)
        raise ZeroDivisionError
    with lock_vehicle(URL, tmp_path) as tenure:
        assert tenure.is_left_in_flight
    with pytest.raises(VehicleTakenError, match=f"process {os.getpid()} already flies this vehicle;"):  # noqa: SIM117
        with lock_vehicle(URL, tmp_path), lock_vehicle(URL, tmp_path):
            pytest.fail("two daemons for one vehicle")


@pytest.mark.parametrize(
    ("word", "leaves"),
    [
        ("flown at {now}", True),
        ("flown at {ago}", True),
        ("flown at {long_ago}", False),
        ("flown at {to_come}", False),  # of before the machine's last start
        ("flown at -1", False),
        ("flown at", False),
        ("flown at x", False),
        ("\xff", False),
        ("", False),
    ],
)
def test_what_the_last_holder_wrote_counts_for_as_long_as_a_battery_lasts(
    tmp_path: Path, word: str, leaves: bool
) -> None:
    now = 2 * MAX_FLIGHT_NS
    times = {"now": now, "ago": now - MAX_FLIGHT_NS, "long_ago": now - MAX_FLIGHT_NS - 1, "to_come": now + 1}
    file = tmp_path / "lock"
    file.write_bytes(f"123 {URL}\n{word.format(**times)}\n".encode("latin-1"))
    with file.open("r+b") as one:
        tenure = VehicleLock([one.fileno()], URL, lambda: now)
        assert tenure.is_left_in_flight is leaves
        tenure.update(True)
        tenure.update(True)
        again = VehicleLock([one.fileno()], URL, lambda: now)
        assert again.is_left_in_flight
        again.update(False)
    assert file.read_text() == f"{os.getpid()} {URL}\n"


@pytest.mark.fault(35)
def test_a_lock_file_that_is_none_is_not_followed(tmp_path: Path) -> None:
    with lock_vehicle(URL, tmp_path):
        name = next(tmp_path.iterdir())
    target = tmp_path / "precious"
    target.write_text("kept")
    name.symlink_to(target)
    with pytest.raises(VehicleTakenError, match="check the file"), lock_vehicle(URL, tmp_path):
        pytest.fail("the link was followed")
    assert target.read_text() == "kept"


def test_without_a_folder_nothing_is_locked(tmp_path: Path) -> None:
    with pytest.raises(VehicleTakenError, match="nothing shows"), lock_vehicle(URL, tmp_path / "gone"):
        pytest.fail("locked in no folder")
