"""What the console is told of the vehicle's own words: each once, at once, and in one piece."""

from __future__ import annotations

import pytest
from loopback_rig import MemorySink, make_loop
from mavlink_rig import Peer, events, make_link, packets

from uavctl.cli.live_line import REPEAT_NS, MessageFilter, describe_phase, describe_wait
from uavctl.config import load_config
from uavctl.mavlink.handover_states import HandoverState
from uavctl.mavlink.statustext import CHUNK_WAIT_NS, MAX_PARTIAL_TEXTS, MISSING_CHUNK
from uavctl.records import ControlMode, Event, Severity

SECOND = 1_000_000_000
NOT_NEUTRAL = "Arm: Throttle (RC3) is not neutral"


def words(at_ns: int, text: str = NOT_NEUTRAL, severity: Severity = Severity.ERROR) -> Event:
    return Event(at_ns=at_ns, severity=severity, code="vehicle-text", text=text)


@pytest.mark.fault(26)
def test_a_refusal_that_goes_on_is_said_at_once_and_again_after_a_while() -> None:
    """As observed: ArduPilot refused 26 times in 54 s."""
    message_filter = MessageFilter()
    times = [round(n * 54 / 25 * SECOND) for n in range(26)]
    shown_ns = [at_ns for at_ns in times if message_filter.format_line(words(at_ns), HandoverState.ARMING)]
    again = next(at_ns for at_ns in times if at_ns >= REPEAT_NS)
    assert shown_ns == [0, again]


def test_it_is_said_in_the_vehicle_s_words_with_what_is_waited_for() -> None:
    line = MessageFilter().format_line(words(0), HandoverState.ARMING)
    assert line is not None and NOT_NEUTRAL in line and describe_wait(HandoverState.ARMING) in line
    flying = MessageFilter().format_line(words(0), HandoverState.ENGAGED)
    assert flying is not None and "waiting" not in flying


@pytest.mark.parametrize(
    ("mode", "state", "word"),
    [
        (ControlMode.WAIT, HandoverState.CLIMBING, "climb"),
        (ControlMode.WAIT, HandoverState.WAITING, "wait"),
        (ControlMode.STOPPED, HandoverState.LANDING, "landing"),
        (ControlMode.STOPPED, HandoverState.SETTLING, "landing"),
        (ControlMode.STOPPED, HandoverState.DONE, "stopped"),
        (ControlMode.TRACK, HandoverState.ENGAGED, "track"),
    ],
)
def test_the_vehicle_s_own_climb_and_landing_are_named(mode: ControlMode, state: HandoverState, word: str) -> None:
    assert describe_phase(mode, state) == word


def test_different_words_are_each_said_and_what_is_no_refusal_is_not() -> None:
    message_filter = MessageFilter()
    assert message_filter.format_line(words(0), HandoverState.ARMING) and message_filter.format_line(
        words(0, "Arm: VisOdom: not healthy"), HandoverState.ARMING
    )
    assert message_filter.format_line(words(0, "Arming motors", Severity.INFO), HandoverState.ARMING) is None
    for n in range(10_000):
        message_filter.format_line(words(n, f"text {n}"), HandoverState.ARMING)
    assert len(message_filter._shown_ns) < 1000


@pytest.mark.fault(26)
def test_a_recorded_refusal_reaches_the_console_as_it_is_heard() -> None:
    loop = make_loop(load_config("room-hahn-stursberg"), MemorySink())
    message_filter = MessageFilter()
    lines: dict[str, float] = {}
    begun_ns = 0
    for at_ns, data in packets("arducopter-refusal.tlog"):
        begun_ns = begun_ns or at_ns
        for event in loop.receive("vehicle", data, at_ns).console_events:
            line = message_filter.format_line(event, HandoverState.ARMING)
            if line is not None:
                lines[line] = (at_ns - begun_ns) * 1e-9
    assert len(lines) == 1
    ((line, at_s),) = lines.items()
    assert "Arm: VisOdom: not healthy" in line and at_s < 2.0


# Long texts come in pieces, as these of PX4 did.
DENIED = b"Arming denied: Resolve system health failures firs", b"t\t"


def test_the_pieces_of_a_long_text_are_one_event() -> None:
    link, vehicle = make_link(), Peer(1, 1)
    link.receive(vehicle.heartbeat(), 0)
    texts = []
    for chunk, piece in enumerate(DENIED):
        texts += events(link.receive(vehicle.send("statustext", 2, piece, 7, chunk), SECOND).items)
    assert [event.text for event in texts] == ["Arming denied: Resolve system health failures first"]


def test_what_has_come_of_a_text_is_told_when_the_rest_stays_out() -> None:
    first, rest = DENIED
    link, vehicle = make_link(), Peer(1, 1)
    link.receive(vehicle.heartbeat(), 0)
    assert events(link.receive(vehicle.send("statustext", 2, first, 7, 0), SECOND).items) == []
    late = events(link.receive(vehicle.heartbeat(), SECOND + CHUNK_WAIT_NS + 1).items)
    assert [event.text for event in late] == [first.decode() + MISSING_CHUNK]
    only_rest = events(link.receive(vehicle.send("statustext", 2, rest, 8, 1), 5 * SECOND).items)
    assert [event.text for event in only_rest] == [MISSING_CHUNK + "t"]
    link.receive(vehicle.send("statustext", 2, first, 9, 0), 6 * SECOND)
    both = events(link.receive(vehicle.send("statustext", 4, b"another", 0, 0), 6 * SECOND).items)
    assert [event.text for event in both] == [first.decode() + MISSING_CHUNK, "another"]


def test_texts_that_never_end_fill_no_memory() -> None:
    link, vehicle = make_link(), Peer(1, 1)
    link.receive(vehicle.heartbeat(), 0)
    for component in range(2, 200):
        link.receive(Peer(1, component).send("statustext", 2, DENIED[0], 7, 0), SECOND)
    for n in range(1000):
        link.receive(vehicle.send("statustext", 2, DENIED[0], 7, n % 250), SECOND)
    assert len(link._text_assembler._partial_texts) <= MAX_PARTIAL_TEXTS
    assert all(len(begun.text) < 15_000 for begun in link._text_assembler._partial_texts.values())
