"""What happens in the course of a simulated flight: by the configuration, or by a file of faults."""

from __future__ import annotations

import json
import socket
from importlib import resources
from itertools import pairwise
from pathlib import Path

import pytest
from sim_rig import SimRig, decode

from sim.faults import find_fault_problems
from sim.simulation import MOCAP, VEHICLE, Peers
from sim.vehicle.quadrotor import Quadrotor
from uavctl.cli.app import run
from uavctl.config import Config, load_config
from uavctl.config.load import add_faults
from uavctl.errors import ConfigError
from uavctl.records import Truth

S = 1_000_000_000
HEAD = ["link.loss=0", "link.jitter_s=0", "sim.camera.rate_hz=10", "sim.camera.phase_s=0"]


def config(*faults: str, plant: str = "linear", autopilot: str = "px4") -> Config:
    listed = ", ".join(f"{{{fault}}}" for fault in faults)
    return load_config(
        "room-hahn-stursberg", [*HEAD, f"sim.plant={plant}", f"sim.autopilot={autopilot}", f"sim.fault=[{listed}]"]
    )


def positions(given: Config, seconds: int = 5) -> list[int]:
    """Tenths of a second of the captures whose samples arrive."""
    due = Peers(given, 7 * S).advance((7 + seconds) * S)
    return [round((msg.usec * 1e-6 - 4000) * 10) for _, link, data in due if link == MOCAP for msg in decode(data)]


@pytest.mark.parametrize("kind", ["blackout", "occluded"])
def test_a_span_of_the_link_or_of_the_cameras_begins_and_ends_in_time(kind: str) -> None:
    without = set(positions(config()))
    missing = without - set(positions(config(f'at_s=1.05, for_s=0.9, kind="{kind}"')))
    assert sorted(missing) == list(range(11, 20))


def test_faults_are_added_to_the_spans_that_there_are_already() -> None:
    given = load_config(
        "room-hahn-stursberg",
        [*HEAD, "link.blackout=[[0.95, 1.25]]", 'sim.fault=[{at_s=3, for_s=0.2, kind="blackout"}]'],
    )
    missing = set(positions(load_config("room-hahn-stursberg", HEAD))) - set(positions(given))
    assert sorted(missing) == [10, 11, 12, 30, 31, 32]


def test_the_steady_wind_changes_at_its_time_and_carries_the_vehicle_away() -> None:
    one = SimRig(config('at_s=2, kind="wind", velocity_mps=[0.0, 4.0, 0.0]', plant="quadrotor"))
    assert isinstance(one.peers.vehicle, Quadrotor)
    one.wait(1.99)
    assert one.peers.vehicle.wind_mps == (0.0, 0.0, 0.0)
    east = one.peers.vehicle.velocity_mps[1]
    assert abs(east) < 1e-6
    one.wait(0.02)
    assert one.peers.vehicle.wind_mps == (0.0, 4.0, 0.0)
    one.stream(0.5, 0.0, 0.0, 0.0)
    assert one.peers.vehicle.velocity_mps[1] > 0.05


def test_gusts_go_on_when_the_steady_wind_changes() -> None:
    def wind(*faults: str) -> tuple[float, ...]:
        given = load_config(
            "room-hahn-stursberg",
            ["sim.plant=quadrotor", "sim.wind.gust_wind_mps=5", f"sim.fault=[{', '.join(faults)}]"],
        )
        peers = Peers(given, 0)
        peers.advance(3 * S)
        assert isinstance(peers.vehicle, Quadrotor)
        return peers.vehicle.wind_mps

    calm, blown = wind(), wind('{at_s=1, kind="wind", velocity_mps=[2.0, -1.0, 0.5]}')
    assert [b - c for b, c in zip(blown, calm, strict=True)] == pytest.approx([2.0, -1.0, 0.5])


def test_the_battery_has_the_charge_it_is_told() -> None:
    peers = Peers(config('at_s=1.0, kind="battery", charge=0.1', plant="quadrotor"), 0)
    assert isinstance(peers.vehicle, Quadrotor)
    peers.advance(S - 1)
    assert peers.vehicle.battery.remaining > 0.9
    peers.advance(S + 10_000_000)
    assert peers.vehicle.battery.remaining == pytest.approx(0.1, abs=1e-3)


def test_a_parameter_changes_at_its_time() -> None:
    peers = Peers(config('at_s=1.0, kind="parameter", name="GUID_TIMEOUT", value=0.5', autopilot="ardupilot"), 0)
    before = peers.autopilot.parameters["GUID_TIMEOUT"]
    peers.advance(S - 1)
    assert peers.autopilot.parameters["GUID_TIMEOUT"] == before != 0.5
    peers.advance(S)
    assert peers.autopilot.parameters["GUID_TIMEOUT"] == 0.5


@pytest.mark.parametrize(("autopilot", "mode"), [("px4", "POSCTL"), ("ardupilot", "LOITER")])
def test_the_pilot_takes_the_vehicle_with_the_stick(autopilot: str, mode: str) -> None:
    one = SimRig(config(f'at_s=1.0, kind="mode", name="{mode}"', autopilot=autopilot))
    external = one.peers.autopilot.mode_name
    one.stream(0.9, 0.5, 0.0, 0.0)
    assert one.peers.autopilot.mode_name == external
    one.stream(3.0, 0.5, 0.0, 0.0)  # setpoints go on, and move nothing any more
    assert one.peers.autopilot.mode_name == mode
    assert one.speed_mps < 0.2


def test_faults_happen_in_order_of_time_and_once_whatever_the_stops() -> None:
    faults = [f'at_s={at_s}, kind="parameter", name="COM_OF_LOSS_T", value={at_s}' for at_s in (3.0, 1.0, 2.0)]
    peers = Peers(config(*faults), 0)
    seen = []
    for tenth in range(45):
        peers.advance(tenth * S // 10)
        seen.append(peers.autopilot.parameters["COM_OF_LOSS_T"])
    assert seen[:10] == pytest.approx([0.7] * 10)  # as it begins
    assert seen[10:] == [1.0] * 10 + [2.0] * 10 + [3.0] * 15
    assert Peers(config(*faults), 0).advance(4 * S) is not None
    at_once = Peers(config(*faults), 0)
    at_once.receive(VEHICLE, b"", 4 * S)
    assert at_once.autopilot.parameters["COM_OF_LOSS_T"] == 3.0


def test_a_file_of_faults_comes_after_those_of_the_configuration(tmp_path: Path) -> None:
    file = tmp_path / "faults.toml"
    file.write_text(
        '[[fault]]\nat_s = 1.0\nkind = "occluded"\nfor_s = 2.5\n\n'
        '[[fault]]\nat_s = 4.0\nkind = "mode"\nname = "POSCTL"\n',
        encoding="utf-8",
    )
    given = add_faults(config('at_s=0.5, for_s=0.25, kind="frozen"'), file, find_fault_problems)
    assert [(one.at_s, one.kind, one.for_s, one.name) for one in given.sim.fault] == [
        (0.5, "frozen", 0.25, ""),
        (1.0, "occluded", 2.5, ""),
        (4.0, "mode", 0.0, "POSCTL"),
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('[[fault]]\nat_s = 1\nkind = "blackout"\n', "faults.toml:1: fault[0].for_s: is missing"),
        ('[[fault]]\nat_s = 1\nkind = "mode"\n', "faults.toml:1: fault[0].name: is missing: which mode"),
        ('[[fault]]\nat_s = 1\nkind = "wind"\n', 'faults.toml:3: fault[0].kind: plant "linear" has no wind'),
        ('[[fault]]\nat_s = 1\nkind = "windy"\n', 'fault[0].kind: "windy" is not a choice (nearest valid name "wind")'),
        ('[[fault]]\nat_s = -1\nkind = "wind"\n', "faults.toml:2: fault[0].at_s: expected a number >= 0.0"),
        ('[[fault]]\nkind = "wind"\n', "fault[0].at_s: missing key"),
        ("[[fualt]]\n", 'fualt: unknown key (nearest valid name "fault")'),
        ("fault = 3\n", "faults.toml:1: fault: "),
        ("[[fault]\n", "TOML syntax"),
        ("", "faults.toml:1: fault: missing key; add it: list of tables (entries: at most 1000)"),
        (
            '[[fault]]\nat_s = 1\nkind = "parameter"\nname = "COM_OF_LOS_T"\n',
            'faults.toml:4: fault[0].name: px4 has no parameter "COM_OF_LOS_T" (nearest valid name "COM_OF_LOSS_T")',
        ),
        (
            '[[fault]]\nat_s = 1\nkind = "parameter"\nname = "COM_OBL_RC_ACT"\nvalue = 77\n',
            "faults.toml:5: fault[0].value: 77 is not simulated for COM_OBL_RC_ACT; give 0 or 1 or 2 or 4 or 5",
        ),
        (
            '[[fault]]\nat_s = 1\nkind = "mode"\nname = "OFBOARD"\n',
            'faults.toml:4: fault[0].name: px4 has no mode "OFBOARD" (nearest valid name "OFFBOARD"); rename it',
        ),
        (
            '[[fault]]\nat_s = 1\nkind = "mode"\nname = "POSCTL"\nvalue = 3\n',
            'faults.toml:5: fault[0].value: has no effect with kind "mode"; remove it',
        ),
        (
            '[[fault]]\nat_s = 1\nkind = "blackout"\nfor_s = 1\ncharge = 0.5\n',
            'faults.toml:5: fault[0].charge: has no effect with kind "blackout"',
        ),
    ],
)
def test_what_is_wrong_in_a_file_is_told_with_its_line(tmp_path: Path, text: str, told: str) -> None:
    file = tmp_path / "faults.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        add_faults(config(), file, find_fault_problems)
    assert told in "\n".join(caught.value.problems)


def test_the_command_serves_a_file_of_faults_at_a_multiple_of_real_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "faults.toml"
    file.write_text('[[fault]]\nat_s = 1.0\nkind = "mode"\nname = "POSCTL"\n', encoding="utf-8")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.0.1", 0))
        client.settimeout(2.0)
        url = f"udpout://127.0.0.1:{client.getsockname()[1]}"
        links = ["--vehicle", url, "--mocap", url]
        assert (
            run(["sim", *links, "--duration", "4", "--speed", "10", "--airborne", "--faults", str(file), "--json"]) == 0
        )
        (told,) = json.loads(capsys.readouterr().out)["vehicles"]
        assert told == {"system_id": 1, "vehicle": url, "mocap": url}
        modes: list[int] = []
        while len(modes) < 4:
            modes += [msg.custom_mode >> 16 for msg in decode(client.recv(4096)) if msg.get_type() == "HEARTBEAT"]
    assert modes == [6, 3, 3, 3]  # OFFBOARD, then POSCTL
    assert run(["sim", *links, "--faults", str(tmp_path / "nowhere.toml")]) == 2


def test_a_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        add_faults(config(), tmp_path / "nowhere.toml", find_fault_problems)


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ('at_s=1, kind="mode", name="GUIDED"', 'px4 has no mode "GUIDED"; give one of OFFBOARD'),
        ('at_s=1, kind="parameter", name="GUID_TIMEOUT"', 'px4 has no parameter "GUID_TIMEOUT"'),
    ],
)
def test_names_that_the_autopilot_has_not_are_refused_at_the_start(fault: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        Peers(config(fault), 0)


def test_a_name_in_the_configuration_is_refused_with_its_line_by_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "flight.toml"
    text = (resources.files("uavctl") / "presets" / "room.toml").read_text(encoding="utf-8")
    text += '\n[[sim.fault]]\nat_s = 1.0\nkind = "parameter"\nname = "COM_OF_LOS_T"\n'
    file.write_text(text, encoding="utf-8")
    where = f"flight.toml:{len(text.splitlines())}: sim.fault[0].name:"
    for command in (["sim", "--duration", "0.1"], ["loopback", "--out", str(tmp_path / "flight")]):
        assert run([*command, "--config", str(file)]) == 2
        told = capsys.readouterr().err
        assert where in told and '(nearest valid name "COM_OF_LOSS_T")' in told


def test_the_recording_tells_what_is_amiss() -> None:
    told: list[Truth] = []
    given = config(
        'at_s=0.9, for_s=0.4, kind="blackout"',
        'at_s=1.1, kind="wind", velocity_mps=[1.0, 0.0, 0.0]',
        'at_s=1.5, kind="parameter", name="COM_OF_LOSS_T", value=0.5',
        'at_s=1.7, kind="battery", charge=0.5',
        'at_s=1.9, kind="mode", name="POSCTL"',
        plant="quadrotor",
    )
    peers = Peers(given, 0, on_truth=told.append)
    peers.advance(4 * S)
    seen = {round(one.at_ns / S, 1): one.faults for one in told}
    lasting = ("wind", "parameter COM_OF_LOSS_T", "battery")
    assert (seen[0.8], seen[1.0], seen[1.2], seen[1.4]) == ((), ("blackout",), ("blackout", "wind"), ("wind",))
    assert seen[1.6] == lasting[:2]
    assert seen[2.0] == seen[2.8] == (*lasting, "mode POSCTL")
    assert seen[3.0] == lasting


def test_random_occlusions_are_told_while_they_last() -> None:
    hides = ["sim.camera.occlusions_per_s=0.5", "sim.camera.occlusion_s=1.0"]
    peers = Peers(load_config("room-hahn-stursberg", [*HEAD, *hides]), 0)
    told = []
    for tenth in range(300):
        peers.advance(tenth * S // 10)
        told.append((peers.channel.counters.sent, peers.take_snapshot().faults))
    seen = [after[0] > before[0] for before, after in pairwise(told)]
    assert [faults == () for _, faults in told[1:]] == seen
    assert {faults for _, faults in told} == {(), ("occluded",)}
