"""First active rows change the number of iterations, not the result."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_questions import draw_questions

from uavctl.config import load_config
from uavctl.smpc.answer import Answer
from uavctl.smpc.working_set import WorkingSetGuess
from uavctl.wiring.controller import build_conditioned


def requested(name: str) -> list[Answer]:
    """Answers to states from anywhere, of which most are on their way out faster than inputs can brake."""
    solver = build_conditioned(load_config(name)).solver  # a new one: what flights share has its guess already
    return [solver.solve(seq, *question) for seq, question in enumerate(draw_questions(solver, 60, 4))]


@pytest.mark.parametrize("name", ["room-px4", pytest.param("room-ardupilot", marks=pytest.mark.slow)])
def test_a_guess_saves_iterations_and_changes_no_plan(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    guessed = requested(name)
    monkeypatch.setattr(WorkingSetGuess, "is_suitable", lambda *_: False)
    without = requested(name)
    compared = 0
    for item, other in zip(guessed, without, strict=True):
        assert item.status == other.status
        if max(item.iterations, other.iterations) > 300:
            continue  # one of them may have ended its rounds early
        compared += 1
        assert item.inputs == pytest.approx(other.inputs, abs=1e-6)
        # Slacks are as exact as their size: these are states that inputs cannot brake, metres past their limits.
        assert item.slack == pytest.approx(other.slack, rel=1e-7, abs=1e-6)
    assert compared > 20
    assert sum(item.iterations for item in guessed) < 0.8 * sum(item.iterations for item in without)


def chain(steps: int, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows (H, 1, H) of a lagged sum of the inputs, and those of an input and of its change (H, 2, H)."""
    states = np.tril(1.0 - lag ** (np.arange(steps)[:, None] - np.arange(steps) + 1.0))[:, None]
    inputs = np.eye(steps)
    return states, np.stack([inputs, inputs - np.eye(steps, k=-1)], axis=1)


def make_guess() -> tuple[WorkingSetGuess, np.ndarray, np.ndarray]:
    """A guess for 6 stages, and bounds: states within 10, changes of the input within 1."""
    steps = 6
    states, inputs = chain(steps, 0.5)
    upper, lower = np.full(3 * steps, 10.0), np.full(3 * steps, -10.0)
    upper[7::2], lower[7::2] = 1.0, -1.0
    return WorkingSetGuess(states, inputs, np.zeros(3 * steps, dtype=np.int32)), upper, lower


def test_a_row_that_the_fastest_brake_leaves_is_relaxed() -> None:
    first, upper, lower = make_guess()
    assert first.guess(upper, lower) is None
    # The brake makes -0.5 and -1.75 of it; then it is two steps behind, of which the next makes up one.
    upper[:2] = -3.0
    begin = first.guess(upper, lower)
    assert begin is not None
    assert begin.tolist() == [1, 1, 0, 0, 0, 0] + [0, 3, 0, 3, 0, 1] + [0] * 6
    begin = first.guess(-lower, -upper)
    assert begin is not None
    assert begin.tolist() == [3, 3, 0, 0, 0, 0] + [0, 1, 0, 1, 0, 3] + [0] * 6


def test_a_setpoint_far_from_the_regulators_goes_there_as_fast_as_it_may() -> None:
    first, upper, lower = make_guess()
    upper[7] = -2.0  # what was sent last is two steps behind
    begin = first.guess(upper, lower)
    assert begin is not None
    assert begin.tolist() == [0] * 6 + [0, 1, 0, 1] + [0] * 8
