"""Hand-over: every pair of the table, names of modes, the recorded flight."""

from __future__ import annotations

from itertools import product

import pytest
from mavlink_rig import SECOND, make_link, packets, statuses

from uavctl.data import VehicleStatus
from uavctl.mavlink.mode import (
    HEARTBEAT_TIMEOUT_NS,
    TRANSITIONS,
    HandOver,
    Seen,
    Sending,
    State,
    describe_mode,
    look,
)

NOW = 100 * SECOND


def vehicle(at_ns: int = NOW, *, armed: bool = True, external: bool = True, mode: str = "OFFBOARD") -> VehicleStatus:
    return VehicleStatus(at_ns=at_ns, autopilot="px4", armed=armed, mode=mode, external=external)


PILOT = vehicle(external=False, mode="POSCTL")


def in_state(state: State) -> HandOver:
    hand_over = HandOver()
    hand_over.state = state
    return hand_over


SEEN = {
    Seen.SILENCE: (None, False),
    Seen.PILOT: (PILOT, False),
    Seen.EXTERNAL: (vehicle(), False),
    Seen.LAND: (vehicle(), True),
}
W, R, E, X, L = State.WAITING, State.READY, State.ENGAGED, State.RELEASED, State.LANDING
NOTHING, NEUTRAL, FLY, LAND = Sending.NOTHING, Sending.NEUTRAL, Sending.SETPOINTS, Sending.LAND
WANTED = {
    #    silence        pilot          external   landing asked for
    W: ((W, NOTHING), (R, NEUTRAL), (E, FLY), (W, NOTHING)),
    R: ((W, NOTHING), (R, NEUTRAL), (E, FLY), (R, NOTHING)),
    E: ((E, NOTHING), (X, NOTHING), (E, FLY), (L, LAND)),
    X: ((X, NOTHING), (X, NOTHING), (X, NOTHING), (X, NOTHING)),
    L: ((L, NOTHING), (L, NOTHING), (L, NOTHING), (L, NOTHING)),
}


@pytest.mark.parametrize(("state", "column"), list(product(State, range(len(Seen)))))
def test_every_pair(state: State, column: int) -> None:
    seen = list(Seen)[column]
    status, land = SEEN[seen]
    hand_over = in_state(state)
    sending, events = hand_over.update(NOW, status, ready=True, land=land)
    assert (hand_over.state, sending) == WANTED[state][column]
    moved = WANTED[state][column][0] is not state
    assert ("hand-over" in {event.code for event in events}) == moved


def test_the_table_is_complete() -> None:
    assert set(TRANSITIONS) == set(product(State, Seen))


def test_only_who_is_engaged_sends_setpoints_or_asks_for_landing() -> None:
    for (before, seen), (after, sending) in TRANSITIONS.items():
        if sending is FLY:
            assert (after, seen) == (E, Seen.EXTERNAL)
        if sending is LAND:
            assert before is E


@pytest.mark.parametrize("state", [X, L])
def test_nothing_leads_out_of_released_and_landing(state: State) -> None:
    assert {TRANSITIONS[state, seen] for seen in Seen} == {(state, NOTHING)}


@pytest.mark.parametrize("status", [PILOT, vehicle(armed=False)])
def test_the_pilot_takes_over_for_good(status: VehicleStatus) -> None:
    hand_over = HandOver()
    assert hand_over.update(NOW, vehicle(), ready=True, land=False)[0] is FLY
    sending, events = hand_over.update(NOW, status, ready=True, land=False)
    assert sending is NOTHING
    assert status.mode in events[0].text
    for _ in range(3):
        assert hand_over.update(NOW, vehicle(), ready=True, land=False) == (NOTHING, ())


def test_no_neutral_stream_before_the_controller_is_ready() -> None:
    hand_over = HandOver()
    assert hand_over.update(NOW, PILOT, ready=False, land=False)[0] is NOTHING
    assert hand_over.update(NOW, PILOT, ready=True, land=False)[0] is NEUTRAL


def test_silence_while_engaged_is_told_once_and_ends() -> None:
    hand_over = HandOver()
    hand_over.update(NOW, vehicle(), ready=True, land=False)
    late = NOW + HEARTBEAT_TIMEOUT_NS
    assert hand_over.update(late, vehicle(), ready=True, land=False) == (FLY, ())
    sending, events = hand_over.update(late + 1, vehicle(), ready=True, land=False)
    assert (sending, [event.code for event in events]) == (NOTHING, ["heartbeat"])
    assert hand_over.update(late + 2, vehicle(), ready=True, land=False) == (NOTHING, ())
    sending, events = hand_over.update(late + 3, vehicle(late), ready=True, land=False)
    assert (sending, [event.code for event in events]) == (FLY, ["heartbeat"])


def test_landing_is_asked_for_in_silence_too() -> None:
    hand_over = in_state(E)
    assert hand_over.update(NOW + 10 * SECOND, vehicle(), ready=False, land=True)[0] is LAND


@pytest.mark.parametrize(
    ("status", "land", "seen"),
    [
        (None, False, Seen.SILENCE),
        (None, True, Seen.LAND),
        (vehicle(NOW - 4 * SECOND), False, Seen.SILENCE),
        (vehicle(armed=False), False, Seen.PILOT),
        (PILOT, False, Seen.PILOT),
        (vehicle(), False, Seen.EXTERNAL),
    ],
)
def test_what_a_tick_sees(status: VehicleStatus | None, land: bool, seen: Seen) -> None:
    assert look(NOW, status, land=land) is seen


@pytest.mark.parametrize(
    ("autopilot", "kind", "custom", "name", "external"),
    [
        ("px4", 2, 6 << 16, "OFFBOARD", True),
        ("px4", 2, 4 << 16 | 3 << 24, "AUTO.LOITER", False),
        ("px4", 2, 4 << 16 | 6 << 24, "AUTO.LAND", False),
        ("px4", 2, 4 << 16 | 99 << 24, "AUTO.99", False),
        ("px4", 2, 3 << 16, "POSCTL", False),
        ("px4", 2, 77 << 16, "MODE_77", False),
        ("px4", 2, 4, "MODE_0", False),
        ("ardupilot", 2, 4, "GUIDED", True),
        ("ardupilot", 13, 4, "GUIDED", True),
        ("ardupilot", 2, 9, "LAND", False),
        ("ardupilot", 2, 5, "LOITER", False),
        ("ardupilot", 2, 0, "STABILIZE", False),
        ("ardupilot", 2, 20, "GUIDED_NOGPS", False),
        ("ardupilot", 2, 29, "MODE_29", False),
        ("ardupilot", 1, 4, "MODE_4", False),  # a plane: 4 is not GUIDED there
        ("ardupilot", 2, 6 << 16, "MODE_393216", False),
        ("unknown", 2, 4, "MODE_4", False),
    ],
)
def test_mode_names(autopilot: str, kind: int, custom: int, name: str, external: bool) -> None:
    assert describe_mode(autopilot, kind, custom) == (name, external)


def test_a_recorded_flight() -> None:
    """PX4: OFFBOARD, its failsafe after the stream stops, OFFBOARD again by itself: not for us any more."""
    link, hand_over = make_link(), HandOver()
    sent: list[tuple[str, Sending]] = []
    for at_ns, data in packets("px4-offboard.tlog"):
        for status in statuses(link.receive(data, at_ns)):
            sending, _ = hand_over.update(at_ns, status, ready=True, land=False)
            if not sent or sent[-1] != (status.mode, sending):
                sent.append((status.mode, sending))
    assert sent == [
        ("AUTO.LOITER", NEUTRAL),
        ("AUTO.TAKEOFF", NEUTRAL),
        ("AUTO.LOITER", NEUTRAL),
        ("OFFBOARD", FLY),
        ("AUTO.LOITER", NOTHING),
        ("OFFBOARD", NOTHING),
        ("AUTO.LAND", NOTHING),
        ("OFFBOARD", NOTHING),  # disarmed after its landing
    ]
