"""Items of a check: state, value, wanted value, and hint."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

import msgspec

from uavctl.config.connections import CheckConfig


class ItemState(StrEnum):
    """Verdict on an item of the check."""

    GOOD = "good"
    NOTE = "note"  # flyable, and worth knowing
    UNDETERMINED = "undetermined"  # neither confirmed nor contradicted
    BAD = "bad"


class Item(msgspec.Struct, frozen=True, kw_only=True):
    """One line of a check."""

    name: str  # name of the item, as `check.accept` takes it
    ok: bool  # whether a flight may begin; false only for a `bad` state
    value: str  # observed value
    want: str  # value that is wanted
    hint: str  # remedy; empty if none is needed
    state: ItemState  # the whole answer: `good`, `note`, `undetermined` or `bad`


def make_item(name: str, state: ItemState, value: str, want: str, hint: str = "") -> Item:
    """An item; a good one needs no hint."""
    return Item(
        name=name,
        ok=state is not ItemState.BAD,
        value=value,
        want=want,
        hint="" if state is ItemState.GOOD else hint,
        state=state,
    )


def judge_item(name: str, *, is_good: bool, value: str, want: str, hint: str) -> Item:
    """An item that is good or bad."""
    return make_item(name, ItemState.GOOD if is_good else ItemState.BAD, value, want, hint)


def find_refusals(items: Iterable[Item], config: CheckConfig) -> tuple[Item, ...]:
    """The items that forbid arming: the bad ones, but for those that `check.accept` names."""
    return tuple(item for item in items if item.state is ItemState.BAD and item.name not in config.accept)


def describe_item(item: Item) -> str:
    """Describe an item in sentences: value, wanted value, remedy."""
    return " ".join(
        (f"{item.name}: {item.value}.", f"Wanted: {item.want}.", *([_format_sentence(item.hint)] if item.hint else ()))
    )


def _format_sentence(hint: str) -> str:
    """Begin a hint with a capital letter and end it with a stop; a name stays as it is."""
    word = hint.split(" ", 1)[0]
    sentence = hint[:1].upper() + hint[1:] if word.isalpha() else hint
    return sentence if sentence.endswith((".", "?")) else f"{sentence}."
