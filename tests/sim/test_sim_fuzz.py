"""Mutated messages with a right checksum: no exception, and no change that a bad message should not make."""

from __future__ import annotations

from typing import Literal

import pytest
from fuzz_rig import MAY_CHANGE, Judge

from sim.autopilot.parameters import Parameters


@pytest.mark.long
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_twenty_thousand_mutants_each(autopilot: Literal["px4", "ardupilot"]) -> None:
    """`tools/fuzz.py` sends a million."""
    judge = Judge(autopilot, 6)
    judge.run(20_000)
    # The handlers were reached, in all their answers, and well-meant mutants did change things.
    assert {0, 2, 3, 4} <= set(judge.results)
    deaf = set() if autopilot == "ardupilot" else {"REQUEST_DATA_STREAM"}
    assert {kind for kind, _ in judge.changed} == set(MAY_CHANGE) - deaf
    assert ("CRASHED" in judge.modes) == (autopilot == "ardupilot")
    assert len(judge.modes) >= 4


def test_the_judge_finds_a_planted_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    """A handler that takes what is not a number for a value: found within a few thousand messages."""
    monkeypatch.setattr(Parameters, "set", lambda self, name, value: self.__setitem__(name, value) or True)
    with pytest.raises((AssertionError, OverflowError, ValueError)):
        Judge("ardupilot", 5).run(20_000)
