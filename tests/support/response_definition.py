"""The evidence of a wrong response by its definition, and states of vehicles that answer so."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from envelope_rig import vec3
from flight_rig import MS, START_NS

from uavctl.flight.monitors.response import ResponseState
from uavctl.records import Vec3

TICK_NS = 50 * MS

# Each hypothesis: R for setpoints now, so late [ns], and the cost of one near to a right one.
RIGHT = [(gain, late_ns) for late_ns in (0, 150 * MS) for gain in (1.0, 0.7, 1.5)]


def turn(degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, -s], [s, c]])


WRONG_HORIZONTAL: dict[str, tuple[np.ndarray, int, float]] = {
    "too late": (np.eye(2), 300 * MS, 0.0),
    "turned by 90°": (turn(90.0), 0, 0.0),
    "turned by 180°": (turn(180.0), 0, 0.0),
    "turned by 270°": (turn(270.0), 0, 0.0),
    "mirrored in north": (np.diag([-1.0, 1.0]), 0, 0.0),
    "mirrored in east": (np.diag([1.0, -1.0]), 0, 0.0),
    "not at all": (np.zeros((2, 2)), 0, 0.0),
    "turned by 45°": (turn(45.0), 0, 1.0),
    "turned by 315°": (turn(315.0), 0, 1.0),
    "2.5 times as much": (2.5 * np.eye(2), 0, 1.0),
}
WRONG_VERTICAL: dict[str, tuple[np.ndarray, int, float]] = {
    "too late": (np.eye(1), 300 * MS, 0.0),
    "mirrored in down": (-np.eye(1), 0, 0.0),
    "not at all in down": (np.zeros((1, 1)), 0, 0.0),
}


def find_least(cost: Callable[[float], float]) -> float:
    """Find the least value of a parabola over a drag within 0 to 1.2 1/s."""
    low, middle, high = (cost(drag_1ps) for drag_1ps in (0.0, 0.6, 1.2))
    bend = low - 2.0 * middle + high
    return min(low, high, cost(min(max(0.6 + 0.3 * (low - high) / bend, 0.0), 1.2)) if bend > 0.0 else low)


def find_request(state: ResponseState, at_ns: int) -> Vec3:
    """Find what setpoints gave at a time; before all, what they gave first."""
    return next((u for ns, u in reversed(state.requested) if ns <= at_ns), state.requested[0][1])


def compute_evidence_slowly(
    state: ResponseState, unexplained_mps2: float, lag_s: Vec3 | None = None
) -> tuple[float, str]:
    """Compute the evidence by its definition, one hypothesis and one sample after the other.

    Args:
        lag_s: The vehicle's lag, where the response has been wrong for 0.35 s; None where for long.
    """
    newest_ns, before = state.samples[-1][0], np.array(state.baseline) / state.baseline[0]
    ages_s = [(newest_ns - at_ns) * 1e-9 for at_ns, _ in state.samples]
    kept = [math.exp(-age_s / 0.4) if lag_s is None else float(age_s < 0.35) for age_s in ages_s]
    weights = np.array([one[0] * part for part, (_, one) in zip(kept, state.samples, strict=True)])
    count, weights = float(weights.sum()), weights / weights.sum()
    fades = np.zeros((len(ages_s), 3))
    if lag_s is not None:
        began = find_request(state, newest_ns - 350 * MS)
        for row, age_s in enumerate(ages_s):
            fades[row] = [
                u * math.exp(-max(0.35 - age_s, 0.0) / max(lag, 1e-3)) for u, lag in zip(began, lag_s, strict=True)
            ]
    best = 0.0, ""
    for axes, wrong in (((0, 1), WRONG_HORIZONTAL), ((2,), WRONG_VERTICAL)):
        one, chosen = np.eye(len(axes)), list(axes)

        def compute_cost(
            r: np.ndarray, late_ns: int, dragged: bool = True, is_wrong: bool = False, chosen: list[int] = chosen
        ) -> float:
            accel, now, velocity = (
                np.array([row[k : k + 3] for _, row in state.samples])[:, chosen] for k in (1, 4, 7)
            )
            asked = [find_request(state, at_ns - late_ns) for at_ns, _ in state.samples]
            u = np.array(asked)[:, chosen] if late_ns else now

            fading = fades[:, chosen] @ (np.eye(len(chosen)) - r).T if is_wrong and not late_ns else np.zeros_like(u)

            def left(drag_1ps: float) -> np.ndarray:
                return np.asarray(accel - u @ r.T - fading + drag_1ps * velocity)

            def vary(drag_1ps: float) -> float:
                e = left(drag_1ps)
                return float(weights @ ((e - weights @ e) ** 2).sum(axis=1))

            def jump(drag_1ps: float) -> float:
                e_before = before[1:4][chosen] + drag_1ps * before[4:7][chosen]
                return float(((weights @ left(drag_1ps) - e_before) ** 2).sum())

            variance, jumped = (find_least(f) if dragged else f(0.0) for f in (vary, jump))
            noise, jumps = 0.2 * unexplained_mps2, 0.65 * unexplained_mps2
            return 0.5 * count * math.log(1.0 + variance / noise**2) + 0.5 * jumped / jumps**2

        if compute_cost(one, 0, dragged=False) <= (5.0 if lag_s is None else 1.5 * 1.4):
            continue
        right = min(compute_cost(gain * one, late_ns) for gain, late_ns in RIGHT)
        least, kind = min(
            (compute_cost(r, late_ns, is_wrong=True) + cost, kind) for kind, (r, late_ns, cost) in wrong.items()
        )
        best = max(best, (right - least, kind))
    return best


def make_state(
    rng: np.random.Generator, answers: tuple[np.ndarray, np.ndarray], late_ns: int, drag_1ps: float
) -> ResponseState:
    """Make the state after two seconds in which the vehicle answered so, with noise, drag and wind."""
    rates, phases = rng.uniform(2.0, 4.0, 3), rng.uniform(0.0, 6.0, 3)
    requested: list[tuple[int, Vec3]] = [
        (START_NS + k * TICK_NS, vec3(2.0 * np.sin(rates * 0.05 * k + phases))) for k in range(41)
    ]
    r, wind, samples, recent = np.zeros((3, 3)), rng.normal(0.0, 0.5, 3), [], np.zeros(7)
    r[:2, :2], r[2:, 2:] = answers
    for k in range(1, 41, 2):  # the first ones from before the setpoints that are known
        velocity, asked = rng.normal(0.0, 1.5, 3), np.array(requested[max(k - late_ns // TICK_NS, 0)][1])
        accel = r @ asked - drag_1ps * velocity + wind + rng.normal(0.0, 0.1, 3)
        weight, (at_ns, now) = float(rng.uniform(1.0, 2.0)), requested[k]
        e = accel - now
        recent += weight * math.exp(0.05 * (k - 39) / 0.4) * np.array([1.0, *e, *(e * e)])
        samples.append((at_ns, tuple(map(float, (weight, *accel, *now, *velocity)))))
    baseline = 30.0 * np.array([1.0, *rng.normal(0.0, 0.7, 6)])
    return ResponseState(
        requested=tuple(requested),
        samples=tuple(samples),
        recent=tuple(recent.tolist()),
        baseline=tuple(baseline.tolist()),
    )
