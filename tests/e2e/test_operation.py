"""The daemon in operation: orders, a second daemon, the service manager, and both of its ends."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.resources import files
from itertools import groupby

import pytest
from operation_rig import Scene, end_process, open_scene
from patience import LIMIT_S, wait_until
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import decode

from logs.recording.info import read_info
from logs.recording.reader import read_kind
from uavctl.config import load_config
from uavctl.daemon.flight_orders import compute_stop_limit_s
from uavctl.records import ControlMode, Datagram, Decision, Order, StepInput


@pytest.fixture
def air() -> Iterator[Scene]:
    with open_scene() as result:
        yield result


def wait_for_flight(air: Scene) -> None:
    """Until the daemon tracks."""
    wait_until(lambda: air.ctl("status")[0] == 0 and air.status()["mode"] == "track", "the daemon tracks")


def read_decisions(air: Scene, out: str = "f") -> list[Decision]:
    return list(read_kind(air.folder / out / "flight.mcap", Decision))


@pytest.mark.slow
@pytest.mark.fault(35)
def test_orders_are_answered_with_the_decision_and_a_second_daemon_is_refused(air: Scene) -> None:
    assert air.ctl("status")[0] == 1 and "start one with `uavctl fly`" in air.ctl("status")[2]
    with end_process(air.fly("f")) as process:
        wait_for_flight(air)

        with end_process(air.fly("second")) as second:
            _, errors = second.communicate(timeout=LIMIT_S)
        assert second.returncode == 1 and f"process {process.pid} already flies this vehicle" in errors
        assert not list((air.folder / "second").glob("*"))

        code, _, errors = air.ctl("goto", "-1,0.5,-1.4")
        assert code == 0 and errors.startswith("goto accepted")
        code, errors, _ = air.ctl("goto", "9,0,-1", "--json")
        assert code == 1 and "north 9 m is outside" in json.loads(errors)["text"]
        assert air.ctl("goto", "1,2")[0] == 2 and air.ctl("goto", "nan,0,-1")[0] == 2
        code, _, errors = air.ctl("hold", "--vehicle", "another")
        assert code == 1 and "no daemon named like 'another'" in errors
        name = air.status()["name"]
        # obeyed at the next boundary that has news: which one, the lossy link decides
        wait_until(
            lambda: air.status()["target_m"] == {"north": -1.0, "east": 0.5, "down": -1.4}, "the order is obeyed"
        )
        assert air.status()["recorder"]["ok"]
        wait_until(lambda: (air.status()["vehicle"] or {}).get("armed", False), "a vehicle in flight is shown")
        assert air.ctl("land", "--vehicle", name)[0] == 0
        wait_until(lambda: air.has_landed, "the vehicle lands")
        process.communicate(timeout=LIMIT_S)
    ordered = [c.order for i in read_kind(air.folder / "f" / "flight.mcap", StepInput) for c in i.commands]
    assert ordered == [Order.GOTO, Order.LAND]  # what was refused at the socket never reached a tick
    assert not list(air.control.iterdir())


@pytest.mark.slow
def test_ctl_takeoff_arms_a_vehicle_on_the_ground_only_with_arm_and_only_once() -> None:
    accepted = ("--set", 'check.accept=["COM_OF_LOSS_T"]')  # of the patient vehicle
    with open_scene(airborne=False) as ground, end_process(ground.fly("f", *accepted)) as process:
        wait_until(
            lambda: ground.ctl("status")[0] == 0 and ground.status()["who_flies"] == "ready", "the daemon stands by"
        )
        for wrong in (("1.2",), ("-1.2", "--arm"), ("0", "--arm"), ("nan", "--arm"), ("--arm",)):
            assert ground.ctl("takeoff", *wrong)[0] == 2
        code, _, errors = ground.ctl("takeoff", "50", "--arm")
        assert code == 1 and "sets.state_lower" in errors
        assert not ground.status()["vehicle"]["armed"]
        floor_m = -ground.truths[-1].position_m[2]
        code, _, errors = ground.ctl("takeoff", "1.2", "--arm")
        assert code == 0, errors
        wait_until(lambda: ground.status()["mode"] == "track", "the daemon flies")
        assert -ground.truths[-1].position_m[2] - floor_m > 0.3 * 1.2
        assert ground.ctl("takeoff", "1.2", "--arm")[0] == 1
        wait_until(lambda: abs(ground.truths[-1].position_m[2] - ground.status()["target_m"]["down"]) < 0.3, "the goal")
        process.send_signal(signal.SIGINT)
        summary, errors = process.communicate(timeout=LIMIT_S)
        assert process.returncode == 0, errors
        assert json.loads(summary)["ending"]["as_ordered"]
        assert abs(-ground.truths[-1].position_m[2] - floor_m) < 0.1  # the end waits until it stands


@pytest.mark.slow
@pytest.mark.fault(31)
def test_after_sigkill_without_a_landing_nothing_is_sent_and_the_vehicle_s_own_failsafe_acts(air: Scene) -> None:
    with end_process(air.fly("f", "--set", "fallback.land=false")) as process:
        wait_for_flight(air)
        # What is on the disk once stays there: the last second at most may be lost.
        wait_until(
            lambda: ControlMode.TRACK in [decision.mode for decision in read_decisions(air)],
            "the flight is on the disk",
        )
        kept = len(read_decisions(air))
        assert air.mode == "OFFBOARD"
        process.send_signal(signal.SIGKILL)
        process.wait(LIMIT_S)
    spoken = air.tap.read_frames()
    air.tap.set_parameter("COM_OF_LOSS_T", 1.0)  # PX4's own value
    wait_until(lambda: air.mode != "OFFBOARD", "the failsafe")
    air.tap.set_parameter("COM_OF_LOSS_T", 600.0)
    wait_until(lambda: max(map(abs, air.truths[-1].velocity_mps)) < 0.3, "the failsafe brings it to rest")
    air.wait_for_flight(3.0)
    assert air.tap.read_frames() == spoken
    assert len(read_decisions(air)) >= kept
    with end_process(air.fly("again")) as process:  # lock and socket of the dead one do not stand in the way
        wait_until(lambda: air.ctl("status")[0] == 0, "the next daemon answers")
        wait_until(lambda: air.status()["age_s"] is not None and bool(air.status()["vehicle"]), "it hears all it needs")
        air.wait_for_flight(1.0)
        assert air.mode != "OFFBOARD"  # to which PX4 would return by itself if setpoints came again
        assert air.ctl("engage")[0] == 0
        wait_for_flight(air)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=LIMIT_S)
    assert "left the vehicle in flight" in errors and "uavctl ctl engage" in errors
    orders = [c.order for i in read_kind(air.folder / "again" / "flight.mcap", StepInput) for c in i.commands]
    assert orders == [Order.STAND_BY, Order.ENGAGE]
    sent = [
        message.get_type()
        for datagram in read_kind(air.folder / "again" / "flight.mcap", Datagram)
        if datagram.outgoing
        for message in decode(datagram.data)
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
        or getattr(message, "command", 0) == mavlink.MAV_CMD_DO_SET_MODE
    ]
    assert sent.index("COMMAND_LONG") == 1  # the mode is asked for with the first setpoint, and no setpoint is before


@pytest.mark.slow
@pytest.mark.fault(34)
def test_sigterm_brakes_hands_over_and_closes_the_recording(air: Scene) -> None:
    with end_process(air.fly("f")) as process:
        wait_for_flight(air)
        assert air.ctl("goto", "-1,0.5,-1.4")[0] == 0  # wherever it is by now
        wait_until(
            lambda: max(map(abs, air.truths[-1].velocity_mps)) > 0.3, "it moves, so that there is something to brake"
        )
        process.send_signal(signal.SIGTERM)
        summary, _ = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0 and json.loads(summary)["recording"].endswith("flight.mcap")
    # From the last plan on: a machine that stood still may have made it brake before.
    modes = [mode for mode, _ in groupby(decision.mode for decision in read_decisions(air))]
    last = len(modes) - modes[::-1].index(ControlMode.TRACK)
    assert modes[last:][:3] == [ControlMode.BRAKE, ControlMode.HOLD, ControlMode.LAND]
    assert (air.folder / "f" / "flight.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")
    wait_until(lambda: air.has_landed, "the vehicle lands")
    spoken = air.tap.read_frames()
    air.wait_for_flight(1.0)
    assert air.tap.read_frames() == spoken


@pytest.mark.slow
def test_the_service_manager_gets_the_status_and_no_watchdog_of_a_hanging_loop(air: Scene) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(air.folder / "notify"))
        manager.settimeout(LIMIT_S)
        environ = {**os.environ, "NOTIFY_SOCKET": str(air.folder / "notify"), "WATCHDOG_USEC": "400000"}
        received: list[str] = []

        def hear(enough: Callable[[], bool]) -> None:
            def heard_enough() -> bool:
                received.append(manager.recv(4096).decode())
                return enough()

            wait_until(heard_enough, "what the manager is to be told", pause_s=0.0)

        with end_process(air.fly("f", environ=environ)) as process:
            hear(lambda: received.count("WATCHDOG=1") > 10 and any("OFFBOARD armed" in text for text in received))
            process.send_signal(signal.SIGSTOP)
            manager.settimeout(1.0)
            with pytest.raises(TimeoutError):
                for _ in range(100):  # what was on its way
                    manager.recv(4096)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("uavctl.cli.ctl.ANSWER_LIMIT_S", 0.5)
                code, _, hanging = air.ctl("hold")
            assert code == 1 and "the control loop may hang" in hanging
            process.send_signal(signal.SIGCONT)
            manager.settimeout(LIMIT_S)
            process.send_signal(signal.SIGINT)
            hear(lambda: received[-1] == "STOPPING=1")
            _, errors = process.communicate(timeout=LIMIT_S)
    assert received[0] == "READY=1"
    lines = [line.removeprefix("STATUS=") for line in received if line.startswith("STATUS=")]
    assert lines[0] in errors  # the health line of a daemon without a terminal


@pytest.mark.slow
@pytest.mark.fault(55)
def test_a_recording_that_is_deleted_while_flying_goes_on_in_another_file(air: Scene) -> None:
    folder = air.folder / "f"
    with end_process(air.fly("f")) as process:
        wait_for_flight(air)
        assert air.status()["recorder"]["ok"]
        shutil.rmtree(folder)
        wait_until((folder / "flight-2.mcap").exists, "the recording continues")
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 1
    assert "deleted or moved" in errors and "Traceback" not in errors
    rest = list(read_kind(folder / "flight.mcap", Decision))
    assert rest[-1].mode is not ControlMode.TRACK and rest[0].tick > 0  # up to its end it goes on in a new folder
    assert read_info(folder / "flight.mcap").missing > 0


HANGING = """
import os, sys, threading, time
if "logs.report.flight_page" in sys.orig_argv:
    os._exit(0)
plain = os.{call}
def hanging(*arguments):
    while threading.current_thread().name == "recorder" and os.path.exists({flag!r}):
        time.sleep(0.02)
    return plain(*arguments)
os.{call} = hanging
"""


@pytest.mark.slow
@pytest.mark.parametrize("call", ["write", "fsync"])
@pytest.mark.fault(54)
def test_a_disk_that_hangs_while_flying_is_reported_and_the_flight_goes_on(air: Scene, call: str) -> None:
    flag = air.folder / "hangs"
    (air.folder / "sitecustomize.py").write_text(HANGING.format(call=call, flag=str(flag)))
    with end_process(air.fly("f", environ={**os.environ, "PYTHONPATH": str(air.folder)})) as process:
        wait_for_flight(air)
        flag.touch()
        wait_until(lambda: not air.status()["recorder"]["ok"], "the disk's hanging is seen")
        result = air.status()
        assert result["mode"] == "track" and result["recorder"]["dropped"] == 0
        assert f"last written {result['recorder']['unwritten_s']:.1f} s ago" in result["recorder"]["reason"]
        flag.unlink()
        wait_until(lambda: bool(air.status()["recorder"]["ok"]), "all is written")
        flag.touch()
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 1 and "Traceback" not in errors
    assert re.search(r"records \(.* last written \d+\.\d s ago", errors.replace("\n", " "))


@pytest.mark.slow
def test_several_daemons_are_distinguished_by_name(air: Scene) -> None:
    with open_scene("sim.seed=3") as second:
        second.control = air.control
        with end_process(air.fly("f")) as first, end_process(second.fly("f")) as two:
            wait_until(lambda: len([*air.control.iterdir()] if air.control.exists() else []) == 2, "both listen")
            wait_until(lambda: "several daemons run" in air.ctl("status")[2], "both answer")
            names = [path.stem for path in air.control.iterdir()]
            pids = set()
            for name in names:
                wait_until(lambda name=name: air.ctl("status", "--vehicle", name)[0] == 0, name)  # type: ignore[misc]
                pids.add(json.loads(air.ctl("status", "--vehicle", name, "--json")[1])["pid"])
            assert pids == {first.pid, two.pid}


def test_a_unit_of_systemd_s_comes_with_the_package() -> None:
    unit = files("uavctl").joinpath("systemd", "uavctl@.service").read_text(encoding="utf-8")
    lines = dict(line.split("=", 1) for line in unit.splitlines() if "=" in line and not line.startswith("#"))
    assert lines["Type"] == "notify" and float(lines["WatchdogSec"]) <= 1.0
    assert lines["WatchdogSignal"] == "SIGKILL" and lines["Restart"] == "no"  # the vehicle's own failsafe has it
    assert "--realtime" in lines["ExecStart"]
    # Where its user's processes look for locks, and where a killed daemon's word stays.
    assert (lines["RuntimeDirectory"], lines["RuntimeDirectoryMode"]) == ("uavctl", "0700")
    assert lines["RuntimeDirectoryPreserve"] == "yes"
    config = load_config("room-px4", ["relay.enabled=true"])
    assert float(lines["TimeoutStopSec"]) > compute_stop_limit_s(config, takes_off=False)


def test_options_of_ctl_are_checked() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "uavctl", "ctl", "fly-away"],
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
    )
    assert done.returncode == 2
