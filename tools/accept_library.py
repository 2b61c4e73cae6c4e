"""Acceptance of a policy library: thousands of states, every answer held to the exact optimum and to all of (19).

Half of the states are uniform over the feasible box (the exact program has an optimum that ends at rest), half are
those in which plans are asked for along closed loops: packets are lost, the last plan is played out, disturbances act.
Run alone: `python tools/accept_library.py --config paper --states 10000 [--json]`; exit code 1 where a limit is missed.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uavctl.config import load_config, presets
from uavctl.smpc.answer import Answer
from uavctl.smpc.hahn_stursberg.exact import ConicSolver
from uavctl.smpc.hahn_stursberg.library import LibrarySolver

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

from full_problem import gains, margins  # the tests' own oracle
from library_rig import KEPT, Asked, Case, case, closed_loop, flown, uniform

Array = NDArray[np.float64]

GAP_ALL, GAP_MOST, MOST, CERTIFICATE = 1e-3, 1e-4, 0.99, 1e-7
_STEPS = 50  # of a closed loop
_BATCH = 500  # plans evaluated at a time


@dataclass(frozen=True)
class Report:
    """What was found.

    Attributes:
        config: Preset.
        states: Number of states.
        shares: Share of answers by method.
        gap_max: Largest certified gap.
        gap_p99: The gap that 99 % stay below.
        within: Share of answers with a gap of at most 1e-4.
        lower_over: Largest (cost_lower - exact optimum) / exact optimum.
        cost_under: Largest (exact optimum - cost) / exact optimum.
        worst_row: Least margin of any constraint of (19) but the soft ones, in its own unit.
        worst_lmi: Least eigenvalue of the terminal condition, in units of ‖Σ_ξ‖.
        worst_state: What the state rows lack beyond the slack that is told.
        slack_share: Share of answers that use slack.
        offset_share: Share of answers that do not reach the target.
        rejected: States of the box from which the exact program finds no rest.
        us: Time of a decision [µs]: p50, p99, max.
    """

    config: str
    states: int
    shares: dict[str, float]
    gap_max: float
    gap_p99: float
    within: float
    lower_over: float
    cost_under: float
    worst_row: float
    worst_lmi: float
    worst_state: float
    slack_share: float
    offset_share: float
    rejected: int
    us: dict[str, float]

    def failures(self) -> list[str]:
        """The limits that are missed."""
        found = {
            f"a certified gap above {GAP_ALL:g}": not self.gap_max <= GAP_ALL,
            f"a certified gap above {GAP_MOST:g} in more than {1.0 - MOST:.0%}": self.within < MOST,
            "a lower bound above the exact optimum": self.lower_over > CERTIFICATE,
            "a cost below the exact optimum": self.cost_under > CERTIFICATE,
            "a constraint of (19) is not kept": min(self.worst_row, self.worst_state) < -KEPT,
            "the terminal condition is not kept": self.worst_lmi < -1e-7,
        }
        return [text for text, missed in found.items() if missed]


@dataclass(frozen=True, eq=False)
class Sample:
    """States with the exact optimum, and how many of the box were rejected."""

    x: list[Array]
    lower: list[float]
    upper: list[float]
    rejected: int


def uniform_states(one: Case, exact: ConicSolver, count: int, rng: np.random.Generator) -> Sample:
    """States of the feasible box: the exact program's plan ends at rest."""
    target, found = one.design.target, Sample([], [], [], 0)
    rejected = 0
    while len(found.x) < count:
        x = uniform(one.design, rng)
        answer = exact.solve(0, x, target)
        if answer.status.value != "optimal" or answer.terminal_miss > KEPT:
            rejected += 1
            continue
        found.x.append(x)
        found.lower.append(answer.cost_lower)
        found.upper.append(answer.cost)
    return Sample(found.x, found.lower, found.upper, rejected)


def loop_states(one: Case, loss: float, exact: ConicSolver, count: int, rng: np.random.Generator) -> Sample:
    """States in which plans are asked for along closed loops from feasible states of the box."""
    found = Sample([], [], [], 0)
    while len(found.x) < count:
        (start,) = uniform_states(one, exact, 1, rng).x
        for x in closed_loop(one, start, loss, _STEPS, rng)[: count - len(found.x)]:
            answer = exact.solve(0, x, one.design.target)
            if answer.status.value == "optimal" and answer.terminal_miss <= KEPT:
                found.x.append(x)
                found.lower.append(answer.cost_lower)
                found.upper.append(answer.cost)
    return found


def decide(one: Case, states: Sequence[Array]) -> tuple[list[Answer], Array]:
    """Answers, and the time of each [µs]; one pass to warm up."""
    solver = LibrarySolver(one.design, one.library)
    target = one.design.target
    for x in states[:50]:
        solver.solve(0, x, target)
    answers, spent = [], np.zeros(len(states))
    gc.disable()
    for k, x in enumerate(states):
        begin = time.perf_counter_ns()
        answer = solver.solve(k, x, target)
        spent[k] = (time.perf_counter_ns() - begin) / 1e3
        answers.append(answer)
    gc.enable()
    return answers, spent


def kept(one: Case, states: Sequence[Array], answers: Sequence[Answer]) -> tuple[float, float, float]:
    """Least margins over all answers: hard rows, terminal condition, state rows beyond the slack told."""
    target, rows, lmi, state = one.design.target, np.inf, np.inf, np.inf
    for begin in range(0, len(states), _BATCH):
        batch = range(begin, min(begin + _BATCH, len(states)))
        thetas = [flown(one, Asked("", states[k], target), answers[k]) for k in batch]
        columns = [np.array(theta) for theta in zip(*thetas, strict=True)]
        x, inputs, reference = (
            np.array(values)
            for values in zip(*[(states[k], answers[k].inputs, answers[k].reference) for k in batch], strict=True)
        )
        found = margins(one.design, gains(one.design, columns), x, inputs, reference)
        rows = min(rows, *(float(part.min()) for part in (found.inputs, found.place, found.hold, found.rest)))
        lmi = min(lmi, float(found.lmi().min()))
        beyond = np.maximum(-found.state, 0.0).sum(axis=(1, 2)) - np.array([answers[k].slack for k in batch])
        state = min(state, float(-beyond.max()))
    return rows, lmi, state


def accept(name: str, count: int, seed: int) -> Report:
    """Draw, decide, compare.

    Args:
        name: Preset.
        count: Number of states.
        seed: Of everything drawn.
    """
    one, rng = case(name), np.random.default_rng(seed)
    exact = ConicSolver(one.design)
    box = uniform_states(one, exact, count - count // 2, rng)
    loop = loop_states(one, load_config(name).link.loss, exact, count // 2, rng)
    states = [*box.x, *loop.x]
    lower, upper = np.array([*box.lower, *loop.lower]), np.array([*box.upper, *loop.upper])
    answers, spent = decide(one, states)
    size = np.maximum(1.0, np.abs(upper))
    gaps = np.array([answer.gap for answer in answers])
    rows, lmi, state = kept(one, states, answers)
    methods = Counter(answer.method for answer in answers)
    return Report(
        config=name,
        states=count,
        shares={method: methods[method] / count for method in ("frozen", "mixture", "exact")},
        gap_max=float(gaps.max()),
        gap_p99=float(np.quantile(gaps, MOST)),
        within=float(np.mean(gaps <= GAP_MOST)),
        lower_over=float(((np.array([answer.cost_lower for answer in answers]) - upper) / size).max()),
        cost_under=float(((lower - np.array([answer.cost for answer in answers])) / size).max()),
        worst_row=rows,
        worst_lmi=lmi,
        worst_state=state,
        slack_share=float(np.mean([answer.slack > KEPT for answer in answers])),
        offset_share=float(np.mean([answer.offset > KEPT for answer in answers])),
        rejected=box.rejected,
        us={"p50": float(np.median(spent)), "p99": float(np.quantile(spent, 0.99)), "max": float(spent.max())},
    )


def table(report: Report) -> str:
    """The report for people, one figure a line."""
    lines = []
    for name, value in asdict(report).items():
        parts = value.items() if isinstance(value, dict) else [("", value)]
        for part, number in parts:
            text = f"{number:.6g}" if isinstance(number, float) else str(number)
            lines.append(f"{f'{name} {part}'.strip():<18}{text}")
    lines += [f"MISSED  {text}" for text in report.failures()]
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """Print the report; 1 if a limit is missed."""
    parser = argparse.ArgumentParser(description="Acceptance of a preset's policy library.")
    parser.add_argument("--config", choices=presets(), default="paper")
    parser.add_argument("--states", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    report = accept(given.config, given.states, given.seed)
    sys.stdout.write((json.dumps(asdict(report)) if given.json else table(report)) + "\n")
    return int(bool(report.failures()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
