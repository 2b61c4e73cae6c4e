"""One thing that was looked at: what was found, what is wanted, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import msgspec

from uavctl.config.preflight import CheckConfig


class State(StrEnum):
    """How it stands with an item."""

    GOOD = "good"
    NOTE = "note"  # flyable, and worth knowing
    UNDETERMINED = "undetermined"  # nothing speaks against it, nothing shows it
    BAD = "bad"


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One line of a check.

    Attributes:
        name: what was looked at; `check.accept` takes it.
        ok: nothing speaks against flying; false only for a `bad` state.
        value: what was found.
        want: what is wanted.
        hint: what to do; empty if nothing is to be done.
        state: the whole answer: `good`, `note`, `undetermined` or `bad`.
    """

    name: str
    ok: bool
    value: str
    want: str
    hint: str
    state: State


def item(name: str, state: State, value: str, want: str, hint: str = "") -> Item:
    """An item; a good one needs no hint."""
    return Item(
        name=name,
        ok=state is not State.BAD,
        value=value,
        want=want,
        hint="" if state is State.GOOD else hint,
        state=state,
    )


def judged(name: str, *, good: bool, value: str, want: str, hint: str) -> Item:
    """An item that is good or bad."""
    return item(name, State.GOOD if good else State.BAD, value, want, hint)


def refusals(items: Iterable[Item], config: CheckConfig) -> tuple[Item, ...]:
    """The items that forbid arming: the bad ones, but for those that `check.accept` names."""
    return tuple(one for one in items if one.state is State.BAD and one.name not in config.accept)
