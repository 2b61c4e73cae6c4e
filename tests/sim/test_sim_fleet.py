"""Several simulated vehicles at once: their ids and ports, and that each heeds only what is meant for it."""

import json
import socket
import threading
from typing import Any

import numpy as np
import pytest
from patience import LIMIT_S, wait_until
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_rig import LAND, Client, SimRig, decode, make_rig

from sim.fleet import make_fleet
from sim.server import Ready, VehicleSetup, serve_all
from uavctl.cli.app import run
from uavctl.config import load_config
from uavctl.errors import ConfigError, ConnectionSpecError
from uavctl.records import Truth

ANY = "udpin://127.0.0.1:0"


def ignore(truth: Truth) -> None:
    del truth


def seats(
    count: int, vehicle: str, mocap: str = "udpout://127.0.0.1:14560", *overrides: str
) -> tuple[VehicleSetup, ...]:
    return make_fleet(load_config("room-hahn-stursberg", overrides), vehicle, mocap, count, ignore)


def test_each_has_the_id_seed_place_and_ports_after_the_one_before() -> None:
    three = seats(
        3,
        "udpout://127.0.0.1:14540,udpout://127.0.0.1:14550",
        "udpout://127.0.0.1:14560",
        "sim.system_id=7",
        "sim.seed=40",
        "sim.start_position_m=[1.0,0.5,-2.0]",
    )
    sims = [one.config.sim for one in three]
    assert [(one.system_id, one.seed) for one in sims] == [(7, 40), (8, 41), (9, 42)]
    assert [one.start_position_m for one in sims] == [(1.0, 0.5, -2.0), (1.0, 1.5, -2.0), (1.0, 2.5, -2.0)]
    assert three[2].vehicle == "udpout://127.0.0.1:14542,udpout://127.0.0.1:14552"
    assert [one.mocap for one in three] == [f"udpout://127.0.0.1:1456{i}" for i in range(3)]
    assert [one.vehicle for one in seats(3, "tcpin://127.0.0.1:5760")] == [
        f"tcpin://127.0.0.1:{5760 + 10 * i}" for i in range(3)
    ]
    assert {one.vehicle for one in seats(10, ANY, ANY)} == {ANY}  # any free port each
    assert len({one.vehicle for one in seats(10, "udpout://127.0.0.1:14540,udpout://127.0.0.1:14550")}) == 10


def starts(count: int, *overrides: str) -> list[list[float]]:
    return [list(one.config.sim.start_position_m) for one in seats(count, ANY, ANY, *overrides)]


def test_they_start_in_rows_within_the_limits_of_the_position_or_are_refused() -> None:
    rows = [[north, -1.9 + i, -0.7] for north in (-2.4, -1.4) for i in range(5)]
    assert np.array(starts(10)) == pytest.approx(np.array(rows))  # limits of the room: 3 m north, 2.5 m east
    wide = "sets.state_upper=[inf,1.5,inf,inf,1.5,inf,0.0,1.0,inf]"
    assert starts(10, wide)[-1] == pytest.approx([-2.4, 7.1, -0.7])
    with pytest.raises(ConfigError, match=r"sim\.start_position_m: .* have room for 2 of 3 vehicles from here"):
        starts(3, "sim.start_position_m=[1.9,2.0,-1.0]")
    assert len(starts(2, "sim.start_position_m=[1.9,2.0,-1.0]")) == 2
    with pytest.raises(ConfigError, match="room for 1 of 2"):
        starts(2, "sim.start_position_m=[0.0,0.0,-3.0]")  # the first is above the ceiling already


def test_an_id_that_is_the_daemon_s_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"sim\.system_id: 245 is that of the daemon too"):
        seats(3, ANY, ANY, "sim.system_id=243")
    assert seats(2, ANY, ANY, "sim.system_id=243")[1].config.sim.system_id == 244


def test_ids_that_run_out_and_ports_that_meet_are_refused() -> None:
    assert seats(2, ANY, ANY, "sim.system_id=249")[1].config.sim.system_id == 250
    with pytest.raises(ConfigError, match=r"sim\.system_id: 2 vehicles would go up to 251; set 249 or less"):
        seats(2, ANY, ANY, "sim.system_id=250")
    with pytest.raises(ConnectionSpecError, match="14541: vehicles 1 and 2 would both have it"):
        seats(2, "udpout://127.0.0.1:14540,udpout://127.0.0.1:14541")
    with pytest.raises(ConnectionSpecError, match="vehicles 1 and 2"):
        seats(2, "udpout://127.0.0.1:14559")  # the second would speak to the first one's cameras


class Station:
    """A socket of its own towards one vehicle."""

    def __init__(self, ready: Ready) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(LIMIT_S)
        self._to = ("127.0.0.1", int(ready.vehicle.rsplit(":", 1)[1]))
        self.client = Client()

    def send(self, data: bytes) -> None:
        self._socket.sendto(data, self._to)

    def hear(self, kind: str) -> Any:
        for _ in range(500):
            for msg in decode(self._socket.recv(4096)):
                if msg.get_type() == kind:
                    return msg
        raise AssertionError("waited in vain")

    def close(self) -> None:
        self._socket.close()


@pytest.mark.slow
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_two_vehicles_are_seen_with_their_ids_and_a_command_to_the_second_moves_only_it(autopilot: str) -> None:
    told: tuple[list[Truth], list[Truth]] = ([], [])
    config = load_config("room-hahn-stursberg", [f"sim.autopilot={autopilot}", "plant.wind_std_mps2=[1e-9,1e-9,1e-9]"])
    pair = [
        VehicleSetup(one.config, one.vehicle, one.mocap, told[i].append)
        for i, one in enumerate(make_fleet(config, ANY, ANY, 2, ignore))
    ]
    readies: list[Ready] = []
    opened, stop = threading.Event(), threading.Event()

    def ready(ports: Ready) -> None:
        readies.append(ports)
        if len(readies) == len(pair):
            opened.set()

    arguments = {"duration_s": None, "airborne": True, "on_ready": ready, "stop": stop.is_set}
    thread = threading.Thread(target=serve_all, args=(pair,), kwargs=arguments)
    thread.start()
    assert opened.wait(LIMIT_S)
    stations = [Station(one) for one in readies]
    try:
        wait_until(lambda: all(told), "time has begun")
        for i, one in enumerate(stations):
            one.send(one.client.timesync(1))
            assert one.hear("HEARTBEAT").get_srcSystem() == i + 1

        def obeyed() -> bool:
            for one in stations:  # both hear it
                one.send(one.client.setpoint(1.0, 0.0, 0.0, system=2))
            stations[1].hear("LOCAL_POSITION_NED")
            return told[1][-1].input[:2] == (1.0, 0.0)

        wait_until(obeyed, "the second one flies the setpoint")
        for one in stations:
            one.send(one.client.command(LAND, system=2))
        ack = stations[1].hear("COMMAND_ACK")
        assert (ack.get_srcSystem(), ack.command, ack.result) == (2, LAND, 0)
        external = told[0][0].mode
        wait_until(lambda: told[1][-1].mode != external, "the second one lands")
    finally:
        stop.set()
        thread.join(LIMIT_S)
        for one in stations:
            one.close()
    assert not thread.is_alive()
    assert {truth.input for truth in told[0]} == {(0.0, 0.0, 0.0)}
    assert {truth.mode for truth in told[0]} == {external}
    east = [truths[0].position_m[1] for truths in told]
    assert east[1] - east[0] == pytest.approx(1.0)


def second(autopilot: str) -> SimRig:
    return make_rig(autopilot, "sim.system_id=2", airborne=False)


@pytest.mark.parametrize(("autopilot", "name"), [("px4", "MAV_SYS_ID"), ("ardupilot", "SYSID_THISMAV")])
def test_the_parameter_of_the_id_tells_it(autopilot: str, name: str) -> None:
    one = second(autopilot)
    read = mavlink.MAVLink_param_request_read_message
    assert one.send(one.client.pack(read(1, 1, name.encode(), -1))) == []
    (answer,) = one.send(one.client.pack(read(2, 1, name.encode(), -1)))
    assert answer.get_srcSystem() == 2
    assert one.peers.autopilot.parameters.decode(name, answer.param_value) == 2.0


def test_an_origin_for_another_vehicle_is_not_taken() -> None:
    one = second("ardupilot")
    parameters = one.peers.autopilot.parameters
    assert parameters.set("GPS1_TYPE", 0)
    assert parameters.set("EK3_SRC1_POSXY", 6)
    for system in (1, 2):
        one.send(one.client.pack(mavlink.MAVLink_set_gps_global_origin_message(system, 473_977_000, 85_456_000, 0)))
        assert one.peers.autopilot.estimator.has_origin is (system == 2)


@pytest.mark.parametrize("url", ["udpout://:14540", "udpout://127.0.0.1", "udpout://127.0.0.1:65535", "14540"])
def test_a_url_that_is_none_is_told_as_it_was_given(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["sim", "--vehicle", url, "--mocap", ANY, "--vehicles", "2", "--duration", "0.1"]) == 2
    assert url.removesuffix("5") in capsys.readouterr().err


def test_the_daemon_s_own_id_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"sim\.system_id: 245 is that of the daemon too"):
        load_config("room-hahn-stursberg", ["sim.system_id=245"])


@pytest.mark.parametrize("number", ["0", "11", "-1", "two"])
def test_a_number_of_vehicles_that_cannot_be_is_refused(number: str) -> None:
    assert run(["sim", "--vehicles", number, "--duration", "0.1"]) == 2


def test_the_command_names_all_ports(capsys: pytest.CaptureFixture[str]) -> None:
    links = ["--vehicle", ANY, "--mocap", ANY]
    assert run(["sim", *links, "--vehicles", "3", "--duration", "0.2", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[0])["vehicles"]
    assert [one["system_id"] for one in told] == [1, 2, 3]
    assert len({one["vehicle"] for one in told}) == 3
    assert run(["sim", *links, "--vehicles", "2", "--duration", "0.2"]) == 0
    assert [line.split()[:3] for line in capsys.readouterr().out.splitlines()[:2]] == [
        ["system_id", "1", "vehicle"],
        ["system_id", "2", "vehicle"],
    ]


def read_encounters(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    links = ["--vehicle", ANY, "--mocap", ANY, "--airborne", "--json"]
    assert run(["sim", *links, *arguments]) == 0
    ports, encounters = capsys.readouterr().out.splitlines()
    assert json.loads(ports)["schema"] == "uavctl/sim/1"
    told: dict[str, Any] = json.loads(encounters)
    assert told["schema"] == "uavctl/sim_encounters/1"
    return told


def test_the_end_tells_the_closest_approach_of_each_pair(capsys: pytest.CaptureFixture[str]) -> None:
    told = read_encounters(capsys, "--vehicles", "3", "--duration", "0.2", "--set", "plant.wind_std_mps2=[0,0,0]")
    assert told["collisions"] == []
    assert [one["vehicles"] for one in told["closest"]] == [[1, 2], [1, 3], [2, 3]]
    assert all(0.0 <= one["time_s"] <= 0.2 for one in told["closest"])
    assert [one["distance_m"] for one in told["closest"]] == pytest.approx([1.0, 2.0, 1.0])


def test_the_end_tells_who_collided_when_and_how_fast(capsys: pytest.CaptureFixture[str]) -> None:
    # Wind alone moves them apart or together: spheres that almost touch meet soon.
    shaken = ["sim.radius_m=0.4999", "plant.wind_std_mps2=[3,3,0.1]", "sim.seed=4"]
    settings = [part for one in shaken for part in ("--set", one)]
    told = read_encounters(capsys, "--vehicles", "2", "--duration", "4", "--speed", "50", *settings)
    (collision,) = told["collisions"]
    (closest,) = told["closest"]
    assert collision["vehicles"] == closest["vehicles"] == [1, 2]
    assert closest["distance_m"] <= collision["distance_m"] < 2 * 0.4999
    assert 0.0 < collision["time_s"] < 4.0
    assert collision["speed_mps"] > 0.0


def test_vehicles_that_would_start_in_each_other_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--vehicles", "2", "--duration", "1", "--set", "sim.radius_m=0.6"]
    assert run(["sim", "--vehicle", ANY, "--mocap", ANY, *arguments]) == 2
    assert "vehicles 1 and 2 start 1.00 m apart" in capsys.readouterr().err
