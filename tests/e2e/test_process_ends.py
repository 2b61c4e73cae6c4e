"""Ends of a flight's process: signals, a console that is closed or that nobody reads; judged on the true vehicle."""

from __future__ import annotations

import json
import os
import resource
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from operation_rig import Scene, end_process, open_scene
from patience import LIMIT_S, wait_until

from uavctl.cli.app import run

# Where the process is all that matters one of them flies; both where the vehicle has to end the flight.
AUTOPILOTS = ("px4", "ardupilot")
CLOSED = b"\x89MCAP0\r\n"


@pytest.fixture
def air(request: pytest.FixtureRequest) -> Iterator[Scene]:
    with open_scene(f'sim.autopilot="{request.param}"') as result:
        yield result


def wait_for_flight(air: Scene) -> None:
    """Until the daemon tracks."""
    wait_until(lambda: air.ctl("status")[0] == 0 and air.status()["mode"] == "track", "the daemon tracks", pause_s=0.2)


def check_end(air: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    """The vehicle lands, the recording is closed, and it replays identically."""
    wait_until(lambda: air.has_landed, "the vehicle lands")
    path = air.folder / "f" / "flight.mcap"
    assert path.read_bytes().endswith(CLOSED)
    capsys.readouterr()
    assert run(["log", "replay", str(path)]) == 0


def read_answer(output: str) -> dict[str, Any]:
    """The one document of a flight on standard output."""
    document: dict[str, Any] = json.loads(output)
    return document


@pytest.mark.slow
@pytest.mark.fault(86)
@pytest.mark.parametrize(
    ("air", "name"), [("px4", "SIGHUP"), ("ardupilot", "SIGUSR1"), ("px4", "SIGQUIT")], indirect=["air"]
)
def test_a_signal_that_would_kill_ends_the_flight_in_order(
    air: Scene, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with end_process(air.fly("f")) as process:
        wait_for_flight(air)
        process.send_signal(signal.Signals[name])
        process.send_signal(signal.SIGHUP)  # a closed terminal's comes twice, and cuts nothing short
        output, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0
    assert read_answer(output)["ending"]["as_ordered"]
    check_end(air, capsys)


@pytest.mark.slow
@pytest.mark.fault(86)
@pytest.mark.parametrize("air", ["ardupilot"], indirect=True)
def test_a_second_deliberate_signal_ends_the_process_and_the_vehicle_is_landed(air: Scene) -> None:
    with end_process(air.fly("f", "--set", "fallback.brake_s=600", "--set", "fallback.hold_s=600")) as process:
        wait_for_flight(air)
        process.send_signal(signal.SIGTERM)
        wait_until(lambda: air.status()["mode"] != "track", "the end begins")
        process.send_signal(signal.SIGQUIT)
        process.communicate(timeout=LIMIT_S)
    assert process.returncode == 128 + signal.SIGQUIT
    assert (air.folder / "f" / "flight.mcap").read_bytes().endswith(CLOSED)
    wait_until(lambda: air.has_landed, "the vehicle lands")


@pytest.mark.slow
@pytest.mark.fault(89)
@pytest.mark.parametrize("air", ["px4"], indirect=True)
def test_a_full_pipe_that_nobody_reads_holds_up_neither_flight_nor_end(
    air: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with pytest.raises(BlockingIOError):
        while True:
            os.write(writer, b"x" * 4096)
    os.set_blocking(writer, True)
    with end_process(air.fly("f", stderr=writer)) as process:
        os.close(writer)
        wait_for_flight(air)
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=LIMIT_S)
    os.close(reader)
    assert process.returncode == 0
    assert read_answer(output)["ending"]["as_ordered"]
    check_end(air, capsys)


def close_stderr() -> None:
    os.close(2)


@pytest.mark.slow
@pytest.mark.fault(90)
@pytest.mark.parametrize("air", ["ardupilot"], indirect=True)
def test_a_flight_without_standard_error_is_flown_and_answered(air: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    with end_process(air.fly("f", stderr=None, preexec_fn=close_stderr)) as process:
        wait_for_flight(air)
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0
    assert read_answer(output)["ending"]["as_ordered"]
    check_end(air, capsys)


@pytest.mark.slow
@pytest.mark.fault(90)
@pytest.mark.parametrize("air", ["px4"], indirect=True)
def test_a_summary_is_written_in_whatever_encoding(air: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    environ = {**os.environ, "PYTHONIOENCODING": "ascii"}
    with end_process(air.fly("f", environ=environ, json=False)) as process:
        wait_for_flight(air)
        process.send_signal(signal.SIGTERM)
        output, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0 and output.isascii() and output
    assert "Traceback" not in errors
    check_end(air, capsys)


@pytest.mark.slow
@pytest.mark.fault(93)
@pytest.mark.parametrize("air", ["px4"], indirect=True)
def test_a_later_file_s_name_that_somebody_takes_in_flight_loses_no_record(
    air: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    with end_process(air.fly("f", "--set", "log.segment_bytes=1048576")) as process:
        wait_for_flight(air)
        foreign = air.folder / "f" / "flight-2.mcap"
        foreign.write_text("somebody's own")
        wait_until((air.folder / "f" / "flight-3.mcap").exists, "the recording goes on under the next free name")
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0
    answer = read_answer(output)
    assert answer["ending"]["as_ordered"] and answer["recorder_dropped"] == 0
    assert foreign.read_text() == "somebody's own"
    check_end(air, capsys)


def find_free_descriptor(pid: int) -> int:
    """The number that the next opened file of a process gets."""
    taken = {int(path.name) for path in Path(f"/proc/{pid}/fd").iterdir()}
    return next(number for number in range(len(taken) + 1) if number not in taken)


@pytest.mark.slow
@pytest.mark.fault(87)
@pytest.mark.parametrize("air", ["ardupilot"], indirect=True)
def test_a_new_port_of_the_vehicle_without_a_descriptor_left_does_not_end_the_flight(
    air: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    with end_process(air.fly("f")) as process:
        wait_for_flight(air)
        _, hard = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (find_free_descriptor(process.pid), hard))
        air.tap.change_port()
        air.wait_for_flight(5.0)
        assert air.mode in ("OFFBOARD", "GUIDED")
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=LIMIT_S)
    answer = read_answer(output)
    assert answer["ending"]["as_ordered"], answer["ending"]
    check_end(air, capsys)


@pytest.mark.slow
@pytest.mark.fault(103)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("air", AUTOPILOTS, indirect=True)
def test_a_process_that_dies_or_stands_still_leaves_a_request_to_land(air: Scene, number: signal.Signals) -> None:
    with end_process(air.fly("f")) as process:
        wait_for_flight(air)
        process.send_signal(number)
        process.wait(LIMIT_S)
    assert process.returncode == -signal.SIGKILL
    wait_until(lambda: air.has_landed, "the vehicle lands")


FAILING = """
import os, select, threading
plain = select.select
def failing(*arguments):
    if threading.current_thread() is threading.main_thread() and os.path.exists({flag!r}):
        raise MemoryError
    return plain(*arguments)
select.select = failing
"""


@pytest.mark.slow
@pytest.mark.fault(88)
@pytest.mark.usefixtures("control_may_fail")
@pytest.mark.parametrize("air", AUTOPILOTS, indirect=True)
def test_a_main_loop_that_works_no_more_asks_for_landing_and_closes_the_recording(
    air: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    flag = air.folder / "fails"
    (air.folder / "sitecustomize.py").write_text(FAILING.format(flag=str(flag)))
    with end_process(air.fly("f", environ={**os.environ, "PYTHONPATH": str(air.folder)})) as process:
        wait_for_flight(air)
        flag.touch()
        _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 1 and "MemoryError" in errors
    check_end(air, capsys)
