"""Files, logs and missions that the simulated autopilots have or refuse, asked for by pymavlink's own FTP client."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path
from typing import Any

import pytest
from autopilot_rig import Flight, Name
from pymavlink import mavftp
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.parameters import TABLES, ParameterType

BOTH = pytest.mark.parametrize("name", ["px4", "ardupilot"])
# Of ArduPilot's packed parameters
TYPES = {ParameterType.INT8: 1, ParameterType.INT16: 2, ParameterType.INT32: 3, ParameterType.REAL32: 4}


class FileLink:
    """What pymavlink's client takes for a connection; loses every `loses`-th answer."""

    def __init__(self, one: Flight, *, loses: int = 0) -> None:
        self.mav, self.source_system, self.source_component = self, 245, 25
        self._one, self._loses, self._heard = one, loses, 0
        self._waiting: deque[Any] = deque()
        self.asked: list[int] = []  # opcodes

    def file_transfer_protocol_send(self, network: int, system: int, component: int, payload: bytes) -> None:
        self.asked.append(payload[3])
        message = mavlink.MAVLink_file_transfer_protocol_message(network, system, component, list(payload))
        for answer in self._one.send(self._one.client.pack(message)):
            if answer.get_type() == "FILE_TRANSFER_PROTOCOL":
                self._heard += 1
                if not self._loses or self._heard % self._loses:
                    self._waiting.append(answer)

    def recv_match(self, type: list[str], timeout: float) -> Any:
        if not self._waiting:
            time.sleep(0.02)
        return self._waiting.popleft() if self._waiting else None


# Whoever asked waits for so long whether more comes, after a refusal
PATIENCE_S = {"idle_detection_time": 0.3, "read_retry_time": 0.25, "retry_time": 0.2}
USUAL = {"debug": 0, "pkt_loss_tx": 0, "pkt_loss_rx": 0, "max_backlog": 5}
SIZES = {"burst_read_size": 80, "write_size": 80, "write_qsize": 5}


def client(one: Flight, **more: int) -> mavftp.MAVFTP:
    settings = [(name, type(value), value) for name, value in {**USUAL, **SIZES, **PATIENCE_S}.items()]
    return mavftp.MAVFTP(FileLink(one, **more), 1, 1, mavftp.MAVFTPSettings(settings))


def fetched(ftp: mavftp.MAVFTP, path: str) -> tuple[mavftp.MAVFTPReturn, bytes]:
    held: list[bytes] = []
    began = ftp.cmd_get([path], callback=lambda file: held.append(file.read()) if file else None)
    return ftp.process_ftp_reply(began.operation_name, timeout=30), b"".join(held)


def test_an_ardupilot_gives_all_its_parameters_as_one_packed_file() -> None:
    one = Flight("ardupilot")
    one.set(GUID_TIMEOUT=1.5, DISARM_DELAY=7)
    result, data = fetched(client(one), "@PARAM/param.pck")
    decoded = mavftp.MAVFTP.ftp_param_decode(data)
    assert result.error_code == mavftp.FtpError.Success and decoded is not None
    table = TABLES["ardupilot"]
    assert [name.decode() for name, _, _ in decoded.params] == sorted(table)
    for name, value, kind in decoded.params:
        assert value == pytest.approx(one.autopilot.parameters[name.decode()], rel=1e-6)
        assert kind == TYPES[table[name.decode()].kind]


def test_defaults_come_along_where_they_are_asked_for(tmp_path: Path) -> None:
    one = Flight("ardupilot")
    one.set(GUID_TIMEOUT=1.5)
    ftp = client(one)
    values, defaults = tmp_path / "values", tmp_path / "defaults"
    began = ftp.cmd_getparams([str(values), str(defaults)])
    assert ftp.process_ftp_reply(began.operation_name, timeout=30).error_code == mavftp.FtpError.Success
    assert "GUID_TIMEOUT,1.5" in values.read_text().splitlines()
    told = dict(line.split(",") for line in defaults.read_text().splitlines())
    assert float(told["GUID_TIMEOUT"]) == pytest.approx(0.7)


def test_a_part_of_them_can_be_asked_for() -> None:
    names = sorted(TABLES["ardupilot"])
    _, data = fetched(client(Flight("ardupilot")), "@PARAM/param.pck?start=3&count=4")
    decoded = mavftp.MAVFTP.ftp_param_decode(data)
    assert decoded is not None and [name.decode() for name, _, _ in decoded.params] == names[3:7]


@pytest.mark.slow
def test_what_was_lost_on_the_way_is_read_again() -> None:
    one = Flight("ardupilot")
    whole = fetched(client(one), "@PARAM/param.pck")[1]
    assert fetched(client(one, loses=4), "@PARAM/param.pck")[1] == whole


@BOTH
@pytest.mark.parametrize("path", ["@SYS/uarts.txt", "/etc/extras/component_general.json.xz", "@PARAM/param.pckx"])
def test_a_file_that_is_not_there_is_refused_at_once(name: Name, path: str) -> None:
    ftp = client(Flight(name))
    assert fetched(ftp, path)[0].error_code == mavftp.FtpError.FileNotFound
    assert ftp.master.asked.count(mavftp.OP_OpenFileRO) == 1


@BOTH
def test_nothing_is_written_removed_or_listed(name: Name) -> None:
    ftp = client(Flight(name))
    assert ftp.cmd_rm(["@PARAM/param.pck"]).error_code == mavftp.FtpError.FileProtected
    assert ftp.cmd_mkdir(["/new"]).error_code == mavftp.FtpError.FileProtected
    assert ftp.cmd_list(["/"]).directory_listing == []
    assert ftp.cmd_list(["/fs/microsd"]).error_code == mavftp.FtpError.FileNotFound


def test_a_px4_has_no_file_of_parameters() -> None:
    assert fetched(client(Flight("px4")), "@PARAM/param.pck")[0].error_code == mavftp.FtpError.FileNotFound


def ask(one: Flight, opcode: int, data: bytes = b"", *, session: int = 0, seq: int = 0, size: int | None = None) -> Any:
    head = seq.to_bytes(2, "little") + bytes((session, opcode, len(data) if size is None else size, 0, 0, 0))
    payload = (head + bytes(4) + data).ljust(251, b"\0")
    return one.send(one.client.pack(mavlink.MAVLink_file_transfer_protocol_message(0, 1, 1, list(payload))))


def test_a_request_that_comes_again_has_the_same_answer_and_no_further_session() -> None:
    one = Flight("ardupilot")
    path = b"@PARAM/param.pck"
    (first,), (again,) = ask(one, 4, path, seq=8), ask(one, 4, path, seq=8)
    assert first.payload == again.payload and first.payload[3] == mavftp.OP_Ack
    (other,) = ask(one, 4, path, seq=9)
    assert (other.payload[3], other.payload[12]) == (mavftp.OP_Nack, mavftp.FtpError.Fail)


def test_sessions_are_few_and_those_left_alone_give_way() -> None:
    one = Flight("ardupilot")
    path = b"@PARAM/param.pck"
    for session in range(4):
        assert ask(one, 4, path, session=session, seq=session)[0].payload[3] == mavftp.OP_Ack
    (full,) = ask(one, 4, path, session=9, seq=20)
    assert full.payload[12] == mavftp.FtpError.NoSessionsAvailable
    one.wait(3.1)
    assert ask(one, 4, path, session=9, seq=21)[-1].payload[3] == mavftp.OP_Ack


@pytest.mark.parametrize(
    ("opcode", "data", "size", "reason"),
    [
        (77, b"", 0, mavftp.FtpError.UnknownCommand),
        (4, b"", 0, mavftp.FtpError.InvalidDataSize),
        (4, b"@PARAM/param.pck", 250, mavftp.FtpError.InvalidDataSize),
        (4, b"@PARAM/param.pck?start=x", None, mavftp.FtpError.FailErrno),
        (4, b"@PARAM/param.pck?start=900", None, mavftp.FtpError.FailErrno),
        (5, b"", 80, mavftp.FtpError.FileNotFound),
        (15, b"", 80, mavftp.FtpError.FileNotFound),
        (14, b"x", None, mavftp.FtpError.FileNotFound),
    ],
)
def test_a_request_without_sense_is_refused_with_its_reason(
    opcode: int, data: bytes, size: int | None, reason: mavftp.FtpError
) -> None:
    (answer,) = ask(Flight("ardupilot"), opcode, data, size=size)
    assert (answer.payload[3], answer.payload[5], answer.payload[12]) == (mavftp.OP_Nack, opcode, reason)


@BOTH
def test_that_there_are_no_logs_is_told_and_data_of_none_are_not_sent(name: Name) -> None:
    one = Flight(name, airborne=False)
    (entry,) = one.send(one.client.pack(mavlink.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF)))
    assert (entry.get_type(), entry.id, entry.num_logs, entry.last_log_num, entry.size) == ("LOG_ENTRY", 0, 0, 0, 0)
    assert one.send(one.client.pack(mavlink.MAVLink_log_request_data_message(1, 1, 1, 0, 90))) == []
    assert one.send(one.client.pack(mavlink.MAVLink_log_request_list_message(9, 1, 0, 0xFFFF))) == []


def test_an_armed_ardupilot_lists_no_logs() -> None:
    one = Flight("ardupilot")
    one.send(one.client.pack(mavlink.MAVLink_log_request_list_message(1, 1, 0, 0xFFFF)))
    assert one.of("LOG_ENTRY") == [] and one.texts == ["Disarm for log download"]


@BOTH
@pytest.mark.parametrize("kind", [0, 1, 2])
def test_missions_fences_and_rally_points_are_refused_with_an_answer(name: Name, kind: int) -> None:
    one = Flight(name)
    requests = [
        (mavlink.MAVLink_mission_count_message(1, 1, 3, kind), mavlink.MAV_MISSION_UNSUPPORTED),
        (mavlink.MAVLink_mission_request_int_message(1, 1, 0, kind), mavlink.MAV_MISSION_INVALID_SEQUENCE),
        (mavlink.MAVLink_mission_clear_all_message(1, 1, kind), mavlink.MAV_MISSION_ACCEPTED),
    ]
    for request, result in requests:
        (answer,) = one.send(one.client.pack(request))
        assert (answer.get_type(), answer.type, answer.mission_type) == ("MISSION_ACK", result, kind)
        assert (answer.target_system, answer.target_component) == (245, 25)
