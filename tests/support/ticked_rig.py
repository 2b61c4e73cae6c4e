"""Ticks for what is called after each one, without a loop that has run them."""

from __future__ import annotations

from uavctl.records import Command, ControlMode, Decision, Event, Ticked


def ticked(at_ns: int, *, answers: tuple[tuple[Command, Event], ...] = ()) -> Ticked:
    """Return a waiting tick; tests use only its time and its answers."""
    decision = Decision(
        tick=0, at_ns=at_ns, step=0, boundary=False, mode=ControlMode.WAIT, age_steps=None, news=False, plan_seq=None,
        plan_index=None, solve=None, input=None, fresh=0, missed_ticks=0, accepted=0, rejected=0, reason="",
    )  # fmt: skip
    return Ticked(
        decision=decision,
        estimate=None,
        link=None,
        vehicle=None,
        answers=answers,
        console_events=(),
        notices=(),
        step_ns=0,
    )
