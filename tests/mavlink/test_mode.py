"""The table of the hand-over: every pair of what is and what is seen, against a grid written down by hand."""

from __future__ import annotations

from itertools import product

import pytest

from uavctl.mavlink.handover_states import NOT_LEFT_IN_FLIGHT, TRANSITIONS, HandoverEvent, HandoverState, SetpointMode

# W waiting, R ready, M mode, A arming, C climbing, G engaging, B returning, E engaged, V failsafe, U unclear,
# X released, L landing, S settling, D done, F failed; + neutral setpoints, * setpoints, nothing else is sent.
GRID = """
  reboot land unsafe refused silence take-off engage left disarmed failsafe unclear other granted external pending
W W      W    W      F       W       W        W      X    R+       W        W       R+    W       E*       W
R R      R    R      F       W       M+       B+     R    R+       R        R       R+    R       E*       R
M F      D    M      F       M       M        M      M    M        X        U       X     A+      M        M+
A F      L    A      F       A       A        A      A    A        V        U       X     C+      A        A+
C F      L    L      L       C       C        C      C    F        V        U       X     G+      C        C+
G F      L    L      L       G       G        G      G    F        V        U       X     E*      G        G+
B X      X    B      X       B       B        B      B    D        V        U       X     E*      B        B+
E X      L    E      E       E*      E        E      E    D        V        U       X     E       E*       E
V F      L    V      L       V       V        G+     V    D        V        U       X     C+      V        V
U X      L    U      L       U       U        B+     U    D        V        U       X     U       U        U
X X      X    X      X       X       X        B+     X    D        X        X       X     X       X        X
L L      L    L      F       L       L        L      L    D        L        X       X     S       L        L
S S      S    S      F       S       S        S      S    D        L        X       X     S       S        S
D D      D    D      D       D       D        D      D    D        D        D       D     D       D        D
F F      F    F      F       F       F        F      F    F        F        F       F     F       F        F
"""
LETTERS = dict(zip("WRMACGBEVUXLSDF", HandoverState, strict=True))
SENDING = {"": SetpointMode.NOTHING, "+": SetpointMode.NEUTRAL, "*": SetpointMode.SETPOINTS}


def wanted() -> dict[tuple[HandoverState, HandoverEvent], tuple[HandoverState, SetpointMode]]:
    head, *rows = (line.split() for line in GRID.strip().splitlines())
    return {
        (LETTERS[letter], HandoverEvent(seen)): (LETTERS[cell[0]], SENDING[cell[1:]])
        for letter, *cells in rows
        for seen, cell in zip(head, cells, strict=True)
    }


def test_every_pair_of_a_state_and_an_event_is_in_the_grid() -> None:
    assert wanted() == TRANSITIONS
    assert set(TRANSITIONS) == set(product(HandoverState, HandoverEvent))


@pytest.mark.fault(25)
def test_setpoints_are_sent_by_who_is_engaged_only() -> None:
    flying = {(after, seen) for (_, seen), (after, sending) in TRANSITIONS.items() if sending is SetpointMode.SETPOINTS}
    assert flying == {
        (HandoverState.ENGAGED, seen) for seen in (HandoverEvent.EXTERNAL, HandoverEvent.GRANTED, HandoverEvent.SILENCE)
    }
    assert TRANSITIONS[HandoverState.ENGAGED, HandoverEvent.OTHER] == (HandoverState.TAKEN_OVER, SetpointMode.NOTHING)


@pytest.mark.fault(25)
def test_only_an_order_leads_out_of_released_and_towards_arming() -> None:
    out = {
        seen for seen in HandoverEvent if TRANSITIONS[HandoverState.TAKEN_OVER, seen][0] is not HandoverState.TAKEN_OVER
    }
    assert out == {HandoverEvent.ENGAGE, HandoverEvent.DISARMED}
    assert TRANSITIONS[HandoverState.WAITING, HandoverEvent.LEFT] == (HandoverState.TAKEN_OVER, SetpointMode.NOTHING)
    towards = {seen for (before, seen), (after, _) in TRANSITIONS.items() if before is not after is HandoverState.MODE}
    assert towards == {HandoverEvent.TAKE_OFF}


def test_no_way_leads_back_from_landing_into_flight() -> None:
    reached, todo = set[HandoverState](), [HandoverState.LANDING]
    while todo:
        state = todo.pop()
        reached.add(state)
        # From released the operator may order it back: that is a flight anew.
        ways = {TRANSITIONS[state, seen][0] for seen in HandoverEvent if seen is not HandoverEvent.ENGAGE}
        todo += [one for one in ways if one not in reached]
    assert reached == {
        HandoverState.LANDING,
        HandoverState.SETTLING,
        HandoverState.TAKEN_OVER,
        HandoverState.DONE,
        HandoverState.FAILED,
    }


@pytest.mark.fault(31)
def test_what_a_daemon_that_ends_leaves_behind_has_had_setpoints_or_may_have() -> None:
    left = set(HandoverState) - NOT_LEFT_IN_FLIGHT
    assert left == {*LETTERS.values()} - {HandoverState.READY, HandoverState.SETTLING, HandoverState.DONE}
    assert {after for after, sending in TRANSITIONS.values() if sending is SetpointMode.SETPOINTS} <= left


def test_every_state_has_an_end() -> None:
    for start in HandoverState:
        reached, todo = set[HandoverState](), [start]
        while todo:
            state = todo.pop()
            reached.add(state)
            todo += [after for seen in HandoverEvent if (after := TRANSITIONS[state, seen][0]) not in reached]
        assert reached & {HandoverState.DONE, HandoverState.FAILED}
