"""Items of the parameters of PX4 and ArduPilot: good as seen to fly indoors, and each one seen to fail."""

from __future__ import annotations

import re
import tomllib
from itertools import product

import msgspec
import numpy as np
import pytest
from check_rig import CheckResult, HandMotion, run_check
from hypothesis import given
from hypothesis import strategies as st
from manual_rig import find_blocks, parse_keys
from mavlink_rig import packets, read
from places import ROOT

from sim.simulation import Peers
from uavctl.check.findings import ItemState, describe_item, find_refusals
from uavctl.check.parameters import RULES, ParameterVerdict
from uavctl.check.preflight import Preflight
from uavctl.cli.init import format_room, parse_sizes
from uavctl.config import Config, load_config, parse
from uavctl.config.checks import get_position_limits_m
from uavctl.lab.position_loop import EXTERNAL_ONLY
from uavctl.mavlink.connection import make_links

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])


def with_parameters(autopilot: str, *more: str, **values: float) -> CheckResult:
    def prepare(peers: Peers) -> None:
        for name, value in values.items():
            assert peers.autopilot.parameters.set(name, value), name

    return run_check([f"sim.autopilot={autopilot}", *more], prepare=prepare, seconds=4.0)


@BOTH
def test_parameters_that_were_seen_to_fly_indoors_are_good(autopilot: str) -> None:
    flown = {"px4": {"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 5}, "ardupilot": {"GUID_TIMEOUT": 1.0}}
    found = with_parameters(autopilot, **EXTERNAL_ONLY[autopilot], **flown[autopilot])
    names = [name for name in found.items if name.isupper()]
    assert len(names) >= 6
    assert {name: found[name].state for name in names} == dict.fromkeys(names, ItemState.GOOD)


@pytest.mark.parametrize(
    ("autopilot", "values", "name", "want"),
    [
        ("ardupilot", {"GUID_TIMEOUT": 3.0}, "GUID_TIMEOUT", ItemState.BAD),  # out of the room from its middle
        ("ardupilot", {"GUID_TIMEOUT": 1.01}, "GUID_TIMEOUT", ItemState.NOTE),
        ("ardupilot", {"GUID_TIMEOUT": 0.1}, "GUID_TIMEOUT", ItemState.BAD),
        ("ardupilot", {"EK3_SRC1_POSXY": 6, "VISO_TYPE": 0}, "EK3_SRC1_POSXY", ItemState.BAD),
        ("ardupilot", {"EK3_SRC1_POSXY": 6, "VISO_TYPE": 0}, "VISO_TYPE", ItemState.BAD),
        ("ardupilot", {"EK3_SRC1_POSXY": 6, "VISO_TYPE": 1}, "EK3_SRC1_YAW", ItemState.NOTE),
        ("ardupilot", {"EK3_SRC1_POSXY": 3}, "EK3_SRC1_POSXY", ItemState.NOTE),
        ("ardupilot", {"EK3_SRC1_YAW": 6}, "COMPASS_USE", ItemState.NOTE),
        ("ardupilot", {"FS_EKF_ACTION": 0}, "FS_EKF_ACTION", ItemState.NOTE),
        ("px4", {"COM_OBL_RC_ACT": 0}, "COM_OBL_RC_ACT", ItemState.BAD),  # there is no radio (COM_RC_IN_MODE 4)
        ("px4", {"COM_OBL_RC_ACT": 4}, "COM_OBL_RC_ACT", ItemState.GOOD),
        ("px4", {"COM_OF_LOSS_T": 5.0}, "COM_OF_LOSS_T", ItemState.BAD),
        ("px4", {"EKF2_EV_CTRL": 11}, "EKF2_GPS_CTRL", ItemState.NOTE),
        ("px4", {"EKF2_EV_CTRL": 11, "EKF2_HGT_REF": 1}, "EKF2_HGT_REF", ItemState.NOTE),
        ("px4", {"EKF2_EV_CTRL": 0}, "EKF2_EV_CTRL", ItemState.NOTE),
    ],
)
def test_parameters_that_lead_astray_are_found(
    autopilot: str, values: dict[str, float], name: str, want: ItemState
) -> None:
    assert with_parameters(autopilot, **values)[name].state is want


TIMEOUTS = {3: "GUID_TIMEOUT", 12: "COM_OF_LOSS_T"}


def judge_timeout(autopilot: int, value: float, config: Config) -> ParameterVerdict:
    rule = next(one for one in RULES[autopilot] if one.name == TIMEOUTS[autopilot])
    return rule.judge(value, lambda _: None, config)


def test_the_timeout_that_is_wanted_is_one_that_the_room_holds() -> None:
    small = load_config("room-ardupilot", ["limits.accel_mps2=[4.0,2.0,1.5]"])
    judged = {t: judge_timeout(3, t, small) for t in (0.7, 0.75, 0.77, 3.0)}
    assert judged[3.0].want.endswith("to 0.7 s")  # 4 t²/2 + (4 t)²/5 = 3 m at 0.76 s
    assert "46.8 m north" in judged[3.0].hint  # 18 + 28.8
    assert "room.accel_mps2" in judged[3.0].hint  # the other remedy
    large = load_config("room-ardupilot", ["limits.accel_mps2=[0.5,0.5,0.5]"])
    assert "accel_mps2" not in judge_timeout(3, 3.0, large).hint  # the timeout is bound by itself, not by the room
    assert [judged[t].state for t in (0.7, 0.75, 0.77)] == [
        ItemState.GOOD, ItemState.NOTE, ItemState.BAD
    ]  # fmt: skip


def stands_after_m(accel_mps2: float, timeout_s: float) -> float:
    """Fly in steps after setpoints have stopped: it accelerates, then brakes with 2.5 m/s² until it stands."""
    step_s, place_m, speed_mps = timeout_s / 2000.0, 0.0, 0.0
    for step in range(1, 2001):
        speed_mps = accel_mps2 * (step - 0.5) * step_s
        place_m += speed_mps * step_s
    step_s = (speed_mps := accel_mps2 * timeout_s) / 2.5 / 2000.0
    return place_m + sum(speed_mps - 2.5 * (step - 0.5) * step_s for step in range(1, 2001)) * step_s


@given(
    autopilot=st.sampled_from([3, 12]),
    half_m=st.tuples(*[st.floats(0.01, 20.0)] * 3),
    accel_mps2=st.tuples(*[st.floats(0.1, 12.0)] * 3),
    tick_s=st.sampled_from([0.001, 0.01, 0.02, 0.025, 0.05]),
    value=st.one_of(st.floats(0.0, 6.0), st.sampled_from([0.6, 0.7, 0.9, 1.0, 3.0])),
)
def test_the_timeout_that_the_hint_gives_passes_once_it_is_set(
    autopilot: int, half_m: tuple[float, ...], accel_mps2: tuple[float, ...], tick_s: float, value: float
) -> None:
    room = load_config("room-px4")
    sides = [list(room.sets.state_lower), list(room.sets.state_upper)]
    for axis, half in enumerate(half_m):
        sides[0][3 * axis], sides[1][3 * axis] = -half, half
    config = msgspec.structs.replace(
        room,
        sets=msgspec.structs.replace(room.sets, state_lower=tuple(sides[0]), state_upper=tuple(sides[1])),
        limits=msgspec.structs.replace(room.limits, accel_mps2=accel_mps2),
        daemon=msgspec.structs.replace(room.daemon, tick_s=tick_s),
    )

    def held(timeout_s: float) -> bool:
        return all(stands_after_m(a, timeout_s) <= half * 1.00001 for a, half in zip(accel_mps2, half_m, strict=True))

    value = float(np.float32(value))  # as a vehicle keeps it
    verdict = judge_timeout(autopilot, value, config)
    if not held(value):
        assert verdict.state is ItemState.BAD
    if verdict.state is ItemState.GOOD:
        assert held(value) and value <= 1.00001 and value >= 2.99999 * tick_s
        return
    given_s = re.search(r"Set it to ([\d.]+) s", verdict.hint)
    if given_s is None:  # nothing can be set: the shortest there may be is already too long
        assert verdict.state is ItemState.BAD
        assert not held(1.0001 * max(3.0 * tick_s, 0.1 if autopilot == 3 else 0.0))
        return
    advised_s = float(np.float32(float(given_s[1])))
    again = judge_timeout(autopilot, advised_s, config)
    assert again.state is ItemState.GOOD and held(advised_s)
    assert float(verdict.want.split()[2]) == float(given_s[1])
    if carried := re.search(r"carry it ([\d.]+) m .* allows ([\d.]+) m", verdict.hint):
        assert (float(carried[1]) > float(carried[2])) == (verdict.state is ItemState.BAD)


@pytest.mark.parametrize(("autopilot", "name"), [("px4", "EKF2_EV_CTRL"), ("ardupilot", "EK3_SRC1_POSXY")])
def test_a_relay_to_a_vehicle_that_does_not_listen_fails(autopilot: str, name: str) -> None:
    assert with_parameters(autopilot, "relay.enabled=true")[name].state is ItemState.BAD


@pytest.mark.parametrize("name", ["FS_EKF_ACTION", "FS_EKF_THRESH"])
def test_nothing_but_its_estimator_s_failsafe_ends_a_flight_whose_relay_has_stopped(name: str) -> None:
    """Recorded: GUIDED for 8.1 s after the last position, however long GUID_TIMEOUT is."""
    config = load_config("room-hahn-stursberg", ["relay.enabled=true"])
    rule = next(one for one in RULES[3] if one.name == name)
    assert rule.judge(0.0, {name: 0.0}.get, config).state is ItemState.BAD
    assert rule.judge(1.0, {name: 1.0}.get, config).state is ItemState.GOOD


def test_the_recorded_vehicle_stays_guided_for_8_s_after_its_last_position() -> None:
    modes = {4: "GUIDED", 9: "LAND"}
    told: list[tuple[str, float]] = []
    last_pose_ns = 0
    for at_ns, data in packets("arducopter-lost.tlog"):
        (message,) = read(data)
        if message.get_type() == "VISION_POSITION_ESTIMATE":
            last_pose_ns = at_ns
        elif message.get_type() == "HEARTBEAT" and message.get_srcSystem() == 1:
            told.append((modes[message.custom_mode], (at_ns - last_pose_ns) * 1e-9))
    lands_s = next(at_s for mode, at_s in told if mode == "LAND")
    assert 7.2 < lands_s < 9.5
    assert all(mode == "GUIDED" for mode, at_s in told if at_s < lands_s)


@pytest.mark.parametrize(
    ("altitude_m", "take_off_m", "want"),
    [
        (2.4, None, ItemState.GOOD),
        (2.6, None, ItemState.NOTE),  # above the room
        (1.2, 1.2, ItemState.GOOD),
        (1.2, 1.3, ItemState.NOTE),  # the climb ends below what is planned
        (2.6, 1.2, ItemState.NOTE),
    ],
)
def test_px4_s_own_climb_is_to_end_in_the_room_and_not_before_ours(
    altitude_m: float, take_off_m: float | None, want: ItemState
) -> None:
    hand = HandMotion()
    hand.flight = Preflight(hand.config, make_links, 0, take_off_m=take_off_m)
    hand.hold(2.0)
    hand.report(hand.vehicle.send("param_value", b"MIS_TAKEOFF_ALT", altitude_m, 9, 9, 3))
    found = hand.is_done()["MIS_TAKEOFF_ALT"]
    assert found.state is want
    assert "2.5 m, the room" in found.want and (take_off_m is None or f"{take_off_m:g} m, --takeoff" in found.want)


def test_parameters_that_are_never_told_do_not_forbid_a_flight() -> None:
    hand = HandMotion()
    hand.hold(7.0)
    found = hand.is_done()
    assert found["COM_OBL_RC_ACT"].state is ItemState.UNDETERMINED and not found.bad_items


def is_wanted(want: str, value: float, told: dict[str, float]) -> bool:
    """Whether a value is what the words ask for, as a person reads them."""
    if want.startswith("any value"):
        return True
    if seconds := re.fullmatch(r"([\d.]+) to ([\d.]+) s", want):
        return float(seconds[1]) <= value <= float(seconds[2])
    if climb := re.fullmatch(r"at most ([\d.]+) m, .*?(?:; at least ([\d.]+) m, .*)?", want):
        return float(climb[2] or 0.0) <= value <= float(climb[1])
    if bits := re.search(r"\(?bits (\d)(?:, (\d))? and (\d)", want):
        mask = sum(1 << int(bit) for bit in bits.groups() if bit)
        return not int(value) & mask if want.endswith("off") else int(value) & mask == mask
    if want.startswith("1, or another"):
        return value != 0
    if "with a VISO_TYPE other than 0" in want:
        return value == 6 and told["VISO_TYPE"] != 0
    if bounds := re.fullmatch(r"([\d.]+) to ([\d.]+)", want):
        return float(bounds[1]) <= value <= float(bounds[2])
    numbers = re.findall(r"(?:^|or )(\d+)", want)
    assert numbers, want
    return value in map(float, numbers)


OTHERS: dict[int, dict[str, tuple[int, ...]]] = {
    3: {"EK3_SRC1_POSXY": (3, 6), "EK3_SRC1_YAW": (1, 6), "VISO_TYPE": (0, 1)},
    12: {"EKF2_EV_CTRL": (0, 1, 2, 8, 11, 15), "COM_RC_IN_MODE": (0, 4)},
}


@pytest.mark.parametrize("autopilot", [3, 12])
@pytest.mark.parametrize("relay", ["false", "true"])
def test_a_value_is_good_just_when_it_is_what_the_words_want(autopilot: int, relay: str) -> None:
    config = load_config("room-hahn-stursberg", [f"relay.enabled={relay}"])
    judged, kinds = 0, set()
    for others in product(*OTHERS[autopilot].values()):
        told = dict(zip(OTHERS[autopilot], map(float, others), strict=True))
        for rule in RULES[autopilot]:
            for value in (0.0, 0.1, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 11.0, 15.0, 16.0, 48.0):
                values = told | {rule.name: value}
                verdict = rule.judge(value, values.get, config)
                good = verdict.state is ItemState.GOOD
                assert good == is_wanted(verdict.want, value, values), (rule.name, value, told, verdict)
                judged += 1
                kinds.add((rule.name, good))
    assert judged > 800 and kinds == {(rule.name, good) for rule in RULES[autopilot] for good in (True, False)}


DUO = tomllib.loads((ROOT / "docs/examples/duo.toml").read_text(encoding="utf-8"))["vehicle"]
FOR_ONE = {"room-px4": "px4", "room-ardupilot": "ardupilot"}  # presets of one autopilot
ROOMS: list[tuple[str, str, list[str]]] = [
    *[
        (name, autopilot, [])
        for name in ("room", "room-px4", "room-ardupilot", "room-hahn-stursberg", "paper")
        for autopilot in ("px4", "ardupilot")
        if FOR_ONE.get(name, autopilot) == autopilot
    ],
    *[(one["config"], "px4", one["set"]) for one in DUO],
    *[  # those of `uavctl init`: its default, small and large ones, and the manual's
        (room, autopilot, overrides)
        for autopilot in ("px4", "ardupilot")
        for room, overrides in (
            ("6x5x2.5", []),
            ("4.6x2.6x2.5", []),
            ("12x9x4", []),
            (
                "5x5x2.7",
                [
                    f"{table}.{key}={value}"
                    for table, key, value in parse_keys(find_blocks("docs/first-flight.md", "toml")[0])
                ],
            ),
        )
    ],
]


def loaded(name: str, autopilot: str, overrides: list[str]) -> Config:
    if name[0].isdigit():
        return parse(format_room(parse_sizes(name), autopilot, "mine.toml"), "mine.toml", overrides).config
    return load_config(name, overrides)


@pytest.mark.parametrize(("name", "autopilot", "overrides"), ROOMS)
def test_a_simulated_vehicle_passes_the_check_of_each_preset_and_of_the_manual_s_rooms(
    name: str, autopilot: str, overrides: list[str]
) -> None:
    config = loaded(name, autopilot, overrides)
    simulated = loaded(name, autopilot, [*overrides, f"sim.autopilot={autopilot}"])
    place = [(a + b) / 2.0 for a, b in get_position_limits_m(config).values()]
    simulated = msgspec.structs.replace(
        simulated, sim=msgspec.structs.replace(simulated.sim, start_position_m=(*place[:2], -0.1), seed=1)
    )
    tick_ns = round(config.daemon.tick_s * 1e9)
    peers, flight = Peers(simulated, 0, airborne=False), Preflight(config, make_links, 0, take_off_m=1.0)
    ticks = round(max(8.0, 50.0 * config.plant.dt_s) * 1e9) // tick_ns
    for tick in range(ticks):
        for arrival_ns, link, data in peers.advance(tick * tick_ns):
            flight.receive(link, data, arrival_ns)
        flight.tick(tick, tick * tick_ns, peers.make_sender(tick * tick_ns))
    found = flight.make_items(ticks * tick_ns)
    assert [describe_item(one) for one in find_refusals(found, config.check)] == []
    assert {one.name: one.state for one in found}[TIMEOUTS[3 if autopilot == "ardupilot" else 12]] is ItemState.GOOD
