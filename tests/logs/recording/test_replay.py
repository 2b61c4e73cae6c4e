"""Replay finds what differs, and only that."""

from __future__ import annotations

import json
from functools import partial

import msgspec
import pytest
from loopback_rig import MemorySink, lockstep, make_loop, shared_loop
from places import DATA

from logs.recording.replay import TEXTS, replay
from logs.recording.tlog import read_tlog, replay_tlog
from logs.recording.topics import ENDED, encode, parse_raw_topic
from uavctl.account import make_ending
from uavctl.cause import Cause
from uavctl.config import load_config
from uavctl.errors import RecordingError
from uavctl.mavlink.connection import VEHICLE
from uavctl.records import Datagram, Decision, Event, Plan, Setpoint, StepInput


@pytest.fixture(scope="module")
def flown() -> MemorySink:
    return lockstep("paper", 20.0)


def test_an_untouched_recording_is_identical(flown: MemorySink) -> None:
    result = replay(flown.entries, lambda sink: make_loop(load_config("paper"), sink))
    assert result.identical and result.first_difference is None
    assert result.decisions == 200
    assert result.compared > 3 * result.decisions


def test_one_changed_bit_of_a_decision_is_found_and_shown(flown: MemorySink) -> None:
    at = next(i for i, (_, _, r) in enumerate(flown.entries) if isinstance(r, Decision) and r.tick == 57)
    topic, at_ns, record = flown.entries[at]
    assert isinstance(record, Decision) and record.input is not None
    nudged = (record.input[0] + 2.0**-50, *record.input[1:])
    changed = [*flown.entries]
    changed[at] = (topic, at_ns, msgspec.structs.replace(record, input=nudged))
    result = replay(changed, lambda sink: shared_loop(load_config("paper"), sink))
    first = result.first_difference
    assert first is not None
    assert (first.topic, first.field, first.at_ns) == ("/uavctl/decision", "input[0]", at_ns)
    assert first.recorded == repr(nudged[0]) and first.replayed == repr(record.input[0])
    close = replay(changed, lambda sink: shared_loop(load_config("paper"), sink), tolerance=1e-9)
    assert close.identical


def test_texts_of_another_version_are_not_compared_but_all_that_stands_beside_them(flown: MemorySink) -> None:
    replayed = partial(replay, make_loop=lambda sink: shared_loop(load_config("paper"), sink))
    worded = [
        (topic, at_ns, msgspec.structs.replace(record, text="in other words"))
        if isinstance(record, Event)
        else (topic, at_ns, msgspec.structs.replace(record, reason="in other words"))
        if isinstance(record, Decision)
        else (topic, at_ns, record)
        for topic, at_ns, record in flown.entries
    ]
    assert not replayed(worded).identical
    assert replayed(worded, ignored=TEXTS).identical
    at = next(i for i, (_, _, record) in enumerate(worded) if isinstance(record, Event))
    topic, at_ns, event = worded[at]
    assert isinstance(event, Event)
    for change in ({"code": "another"}, {"count": event.count + 1}, {"subject": "another"}, {"at_ns": at_ns + 1}):
        worded[at] = (topic, at_ns, msgspec.structs.replace(event, **change))
        assert not replayed(worded, ignored=TEXTS).identical


@pytest.mark.slow
def test_a_recording_is_compared_by_its_bytes_and_by_what_they_say_where_these_are_others(flown: MemorySink) -> None:
    written = [(topic, at_ns, encode(record)) for topic, at_ns, record in flown.entries]
    replayed = partial(replay, make_loop=lambda sink: shared_loop(load_config("paper"), sink))
    whole = replayed(flown.entries)
    assert whole.identical and replayed(written) == whole
    otherwise = [
        (topic, at_ns, data if parse_raw_topic(topic) else json.dumps(json.loads(data)).encode())
        for topic, at_ns, data in written
    ]
    assert otherwise != written and replayed(otherwise) == whole
    at = next(i for i, (_, _, r) in enumerate(flown.entries) if isinstance(r, Decision) and r.tick == 57)
    topic, at_ns, record = flown.entries[at]
    assert isinstance(record, Decision)
    changed = [*written]
    changed[at] = (topic, at_ns, encode(msgspec.structs.replace(record, fresh=record.fresh + 1)))
    result = replayed(changed)
    assert result.first_difference is not None and result.first_difference.field == "fresh"
    assert (result.decisions, result.compared, result.decisions_differing) == (whole.decisions, whole.compared, 1)


def test_a_topic_that_nobody_knows_is_told(flown: MemorySink) -> None:
    written = [(topic, at_ns, encode(record)) for topic, at_ns, record in flown.entries]
    with pytest.raises(RecordingError, match="topic /uavctl/later is not known to this version"):
        replay([*written, ("/uavctl/later", 7, b"{}")], lambda sink: shared_loop(load_config("paper"), sink))


def test_a_changed_controller_is_found_at_its_first_differing_plan(flown: MemorySink) -> None:
    other = load_config("paper", ["cost.input=[0.2, 0.1]", "solver.method=exact"])
    result = replay(flown.entries, lambda sink: shared_loop(other, sink))
    first = result.first_difference
    assert first is not None and first.topic == "/uavctl/plan"
    assert first.at_ns == flown.of(Plan)[0].base_ns


def test_a_lost_datagram_is_found(flown: MemorySink) -> None:
    position = next(
        i
        for i, (_, _, r) in enumerate(flown.entries)
        if isinstance(r, Datagram) and r.link == "mocap" and not r.outgoing
    )
    result = replay(
        flown.entries[:position] + flown.entries[position + 1 :], lambda sink: shared_loop(load_config("paper"), sink)
    )
    assert not result.identical


@pytest.mark.slow
def test_what_the_loop_says_beyond_the_recording_is_found(flown: MemorySink) -> None:
    for kind in (Plan, Setpoint, Event):
        poorer = [entry for entry in flown.entries if not isinstance(entry[2], kind)]
        result = replay(poorer, lambda sink: shared_loop(load_config("paper"), sink))
        assert not result.identical and result.first_difference is not None
        assert result.first_difference.recorded == "nothing"


def test_a_torn_recording_may_lack_the_end_of_its_last_tick_only(flown: MemorySink) -> None:
    last = max(i for i, (_, _, r) in enumerate(flown.entries) if isinstance(r, StepInput))
    torn = flown.entries[: last + 1]
    build = partial(make_loop, load_config("paper"))
    assert replay(torn, build, finished=False).identical
    assert not replay(torn, build).identical


@pytest.mark.fault(86)
def test_a_flight_that_a_second_signal_has_ended_may_lack_the_end_of_its_last_tick(flown: MemorySink) -> None:
    last = max(i for i, (_, _, r) in enumerate(flown.entries) if isinstance(r, StepInput))
    at_ns = flown.entries[last][1]
    for cause in (Cause.SIGNALLED, Cause.ENDED_BY_OPERATOR):
        ended = [*flown.entries[: last + 1], (ENDED, at_ns, make_ending(cause, "ended"))]
        assert replay(ended, partial(make_loop, load_config("paper"))).identical == (cause is Cause.SIGNALLED)


def test_a_recording_without_a_decision_is_not_identical(flown: MemorySink) -> None:
    result = replay(flown.entries[:1], lambda sink: shared_loop(load_config("paper"), sink))
    assert not result.identical and result.decisions == 0


def test_a_foreign_recording_goes_through_parser_clock_estimator_and_controller() -> None:
    tlog = DATA / "arducopter-vicon.tlog"
    config = load_config("room-hahn-stursberg", ["daemon.vehicle=tlog", "daemon.mocap=tlog"])
    packets = [(p.at_ns, p.data) for p in read_tlog(tlog) if not p.outgoing]
    result = replay_tlog(packets, lambda sink: make_loop(config, sink), link=VEHICLE, tick_ns=50_000_000)
    assert result.datagrams == len(packets)
    assert result.positions > 20
    assert 0.05 < result.out_of_order / result.positions < 0.5  # a fifth in the whole recording
    # Another program flew: a change of its setpoints, which the filter does not know, may look like a jump.
    assert result.accepted + result.rejected == result.positions and result.rejected <= 2
    assert result.age_ms is not None and 0.0 <= result.age_ms.min < result.age_ms.max < 150.0
