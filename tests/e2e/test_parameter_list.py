"""All parameters of the vehicle come into the recording before it is armed, over a link that loses a third."""

from __future__ import annotations

import random

import pytest
from loopback_rig import make_loop
from sim_rig import decode
from take_off_rig import TakeOffRig

from logs.recording.parameters import ParameterReader, count_parameters
from logs.recording.replay import replay
from sim.autopilot.parameters import TABLES
from uavctl.arrays import SECOND_NS
from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.messages import ParamValue
from uavctl.mavlink.stream_requests import MAX_READ_ROUNDS, MAX_TRIES, READS_PER_BATCH, ParameterDownload
from uavctl.records import Datagram

BOTH = pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])


def read_parameters(flight: TakeOffRig) -> ParameterReader:
    reader = ParameterReader()
    for datagram in flight.memory.of(Datagram):
        reader.take(datagram)
    return reader


def list_requests(data: bytes) -> bool:
    return any(m.get_type().startswith("PARAM_") for m in decode(data))


def get_value(index: int, count: int) -> ParamValue:
    return ParamValue(system=1, component=1, name=f"P{index}", cast=0.0, bytewise=0.0, index=index, count=count)


@pytest.mark.parametrize("autopilot", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_a_lossy_link_loses_none(autopilot: str) -> None:
    flight, dice = TakeOffRig(autopilot), random.Random(4)
    flight.hears = lambda data: not list_requests(data) or dice.random() > 0.3
    flight.told = lambda data: not list_requests(data) or dice.random() > 0.3
    flight.run(15.0)
    result = read_parameters(flight)
    assert TABLES[autopilot].keys() <= result.parameters().keys()
    assert result.count == count_parameters(result.parameters()) == len(TABLES[autopilot])
    assert flight.sent("PARAM_REQUEST_READ")  # some were lost
    before = len(flight.sent("PARAM_REQUEST_LIST")), len(flight.sent("PARAM_REQUEST_READ"))
    flight.run(5.0)
    assert before == (len(flight.sent("PARAM_REQUEST_LIST")), len(flight.sent("PARAM_REQUEST_READ")))
    assert replay(flight.memory.entries, lambda sink: make_loop(flight.config, sink)).identical


def test_a_vehicle_that_never_answers_is_asked_a_few_times() -> None:
    flight = TakeOffRig("px4")
    flight.hears = lambda data: not list_requests(data)
    flight.run(15.0)
    assert len(flight.sent("PARAM_REQUEST_LIST")) == MAX_TRIES and not flight.sent("PARAM_REQUEST_READ")


@BOTH
def test_nothing_is_asked_once_it_is_armed(autopilot: str) -> None:
    flight = TakeOffRig(autopilot)
    flight.told = lambda data: not list_requests(data)
    flight.take_off().run(10.0, until=HandoverState.CLIMBING)
    armed_ns = flight.now_ns
    flight.run(6.0)
    asked = [at for kind in ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ") for at, _ in flight.sent(kind)]
    # An ArduPilot is asked for the source of its positions by name, which is no part of the list.
    assert asked and max(at for at, _ in flight.sent("PARAM_REQUEST_LIST")) < armed_ns
    assert all(m.param_index < 0 for at, m in flight.sent("PARAM_REQUEST_READ") if at >= armed_ns)


def test_it_can_be_left_out() -> None:
    flight = TakeOffRig("px4", "daemon.parameters=false").run(3.0)
    assert not flight.sent("PARAM_REQUEST_LIST")


def test_the_lost_ones_are_asked_for_at_a_bounded_rate_and_not_for_ever() -> None:
    asking, asked = ParameterDownload(), []
    assert asking.due(0, armed=False) == (-1,)
    asking.handle_message(get_value(0, 1001))  # and of the others none comes, ever
    for at_ns in range(0, 400 * SECOND_NS, SECOND_NS // 20):
        asked += [(at_ns, index) for index in asking.due(at_ns, armed=False)]
    assert sorted(index for _, index in asked) == sorted(MAX_READ_ROUNDS * [*range(1, 1001)])
    for begin in range(0, 200 * SECOND_NS, SECOND_NS):
        assert sum(begin <= at < begin + SECOND_NS for at, _ in asked) <= 5 * READS_PER_BATCH


def test_the_list_is_waited_for_while_it_comes_and_armed_ends_it_for_good() -> None:
    asking = ParameterDownload()
    assert asking.due(0, armed=False) == (-1,)
    for index in range(0, 40, 2):
        asking.handle_message(get_value(index, 41))
        assert asking.due((index + 1) * SECOND_NS // 10, armed=False) == ()
    assert asking.due(5 * SECOND_NS, armed=False) == tuple(range(1, 20, 2))
    assert asking.due(6 * SECOND_NS, armed=True) == ()
    assert asking.due(7 * SECOND_NS, armed=False) == ()


def test_what_is_no_place_in_a_list_counts_for_nothing() -> None:
    asking = ParameterDownload()
    for odd in (get_value(65_535, 3), get_value(60_000, 65_535)):
        asking.handle_message(odd)
    assert asking.due(0, armed=False) == (-1,)
