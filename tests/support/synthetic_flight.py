"""Made-up flights with the shape of real ones: a linear plant under saturated feedback over a lossy link."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from scipy.linalg import expm, logm
from synthetic_scene import Scene, box

from uavctl.arrays import Array
from uavctl.records import (
    ControlMode,
    Decision,
    Estimate,
    Event,
    Header,
    Plan,
    PositionSample,
    Record,
    Severity,
    SolveStatus,
    StepInput,
    Timing,
    Truth,
    VehicleStatus,
)

Item = tuple[str, int, Record]
CAPTURE_DELAY_S = 0.05


@dataclass
class _Pilot:
    """What the made-up controller remembers."""

    mean: Array
    age: int = 0
    plan: Plan | None = None
    index: int = 0
    fresh: int = 0
    falling: bool = False


def fly(
    scene: Scene,
    duration_s: float,
    *,
    seed: int = 0,
    blackout: tuple[float, float] | None = None,
    config_toml: str | None = None,
    start_ns: int = 5_000_000_000,
) -> Iterator[Item]:
    """Records of a flight of `duration_s`; positions are captured once a step, 30 % are lost."""
    rng = np.random.default_rng(seed)
    per_step, ticks = round(scene.dt_s / scene.tick_s), round(duration_s / scene.tick_s)
    config = config_toml or f'name = "{scene.name}"\nduration_s = {duration_s}\n\n[link]\nloss = 0.3\n'
    yield "/uavctl/header", start_ns, header(scene, config, start_ns)
    heartbeat = VehicleStatus(at_ns=0, autopilot="px4", armed=True, mode="OFFBOARD", external=True, battery_v=15.2)
    pilot, x, lost = _Pilot(scene.start.copy()), scene.start.copy(), 0
    u, w = np.zeros(len(scene.input_limit)), np.zeros(len(scene.axes))
    fine = _substep(scene, per_step)
    for tick in range(ticks):
        at_ns, step = start_ns + round(tick * scene.tick_s * 1e9), tick // per_step
        if tick % round(1.0 / scene.tick_s) == 0:
            yield "/uavctl/vehicle", at_ns, replace(heartbeat, at_ns=at_ns)
        boundary = tick % per_step == 0
        received = boundary and (step == 0 or rng.random() > 0.3)
        if blackout is not None and blackout[0] <= tick * scene.tick_s < blackout[1]:
            received = False
        lost += boundary and not received
        captured_ns = at_ns - round(CAPTURE_DELAY_S * 1e9)
        samples = (_sample(scene, x, captured_ns, at_ns, step, rng),) if received else ()
        yield "/uavctl/step_input", at_ns, StepInput(tick=tick, at_ns=at_ns, samples=samples)
        solved = boundary and _decide(pilot, scene, x, at_ns, step, received)
        if boundary:
            u = _input(pilot, scene)
            w = rng.normal(0.0, scene.noise_std)
        if solved and pilot.plan is not None:
            yield "/uavctl/plan", at_ns, pilot.plan
        yield "/sim/truth", at_ns, _truth(scene, x, u, at_ns, step + 1, lost)
        yield from _spoken(scene, pilot, u, tick, step, at_ns, boundary, received, solved)
        yield (
            "/uavctl/timing",
            at_ns,
            Timing(
                tick=tick,
                at_ns=at_ns,
                lateness_ns=int(rng.gamma(3.0, 3e4)),
                step_ns=int(rng.lognormal(15.3, 0.15)) if solved else int(rng.lognormal(11.0, 0.2)),
                send_ns=300_000,
            ),
        )
        x = fine[0] @ x + fine[1] @ u + fine[2] @ w
        pilot.mean = fine[0] @ pilot.mean + fine[1] @ u


def header(scene: Scene, config_toml: str, at_ns: int) -> Header:
    return Header(
        started_ns=at_ns,
        started_utc="2025-01-02T03:04:05Z",
        seed=7,
        command=f"uavctl loopback --config {scene.name}",
        config_toml=config_toml,
        design_id="3f1c9a",
        design=scene.design(),
        versions={"uavctl": "0.1.0", "python": "3.11.2", "numpy": "2.2.0"},
        cpu="x86_64",
    )


def _substep(scene: Scene, parts: int) -> tuple[Array, Array, Array]:
    """Linear motion over one tick, input and noise held: the n-th root of the step's affine map."""
    n, m, k = len(scene.start), len(scene.input_limit), scene.e.shape[1]
    step = np.block([[scene.a, scene.b, scene.e], [np.zeros((m + k, n)), np.eye(m + k)]])
    root = np.real(expm(logm(step) / parts))
    return root[:n, :n], root[:n, n : n + m], root[:n, n + m :]


def _decide(pilot: _Pilot, scene: Scene, x: Array, at_ns: int, step: int, received: bool) -> bool:
    """Advance the pilot by a step; True when it solved."""
    pilot.age = 0 if received else pilot.age + 1
    pilot.fresh = pilot.fresh + 1 if received else 0
    pilot.falling = pilot.age >= 12 or (pilot.falling and pilot.fresh < 3)
    pilot.index += 1
    if received:
        pilot.mean = x.copy()
    if received and not pilot.falling:
        pilot.plan, pilot.index = _plan(scene, pilot.mean, at_ns, step), 0
        return True
    return False


def _input(pilot: _Pilot, scene: Scene) -> Array:
    if pilot.falling or pilot.plan is None:
        velocity = pilot.mean[1 :: scene.per_axis]
        return np.clip(-1.5 * velocity if scene.per_axis == 3 else 0 * velocity, -scene.input_limit, scene.input_limit)
    return np.asarray(pilot.plan.inputs[min(pilot.index, 11)])


def _plan(scene: Scene, mean: Array, at_ns: int, step: int) -> Plan:
    states, inputs, cov = [mean], [], np.zeros((len(mean), len(mean)))
    c_x, _ = box(scene.lower, scene.upper)
    c_u, _ = box(-scene.input_limit, scene.input_limit)
    backoff = [np.zeros(len(c_x))]
    noise = scene.e @ np.diag(scene.noise_std**2) @ scene.e.T
    for t in range(12):
        u = np.clip(scene.gain @ (states[-1] - scene.target), -scene.input_limit, scene.input_limit)
        inputs.append(u)
        states.append(scene.a @ states[-1] + scene.b @ u)
        loop = scene.a + scene.b @ scene.gain if t >= 4 else scene.a
        cov = loop @ cov @ loop.T + noise
        backoff.append(2.4 * np.sqrt(np.einsum("ij,jk,ik->i", c_x, cov, c_x)))
    return Plan(
        seq=step,
        base_ns=at_ns,
        captured_ns=at_ns - round(CAPTURE_DELAY_S * 1e9),
        status=SolveStatus.OPTIMAL,
        method="exact",
        inputs=np.array(inputs),
        states=np.array(states),
        backoff_x=np.array(backoff),
        backoff_u=np.zeros((12, len(c_u))),
        reference=tuple(scene.target.tolist()),
        slack=0.0,
        offset=0.0,
        terminal_miss=0.0,
        cost=1.0,
        cost_lower=1.0,
        gap=0.0,
        iterations=14,
        design_id="3f1c9a",
    )


def _position(scene: Scene, x: Array) -> tuple[float, float, float]:
    p = [0.0, 0.0, 0.0]
    for axis, value in zip(scene.axes, x[:: scene.per_axis], strict=True):
        p[("north", "east", "down").index(axis)] = float(value)
    return (p[0], p[1], p[2])


def _sample(scene: Scene, x: Array, captured_ns: int, at_ns: int, seq: int, rng: np.random.Generator) -> PositionSample:
    n, e, d = _position(scene, x + rng.normal(0, 0.003, len(x)))
    return PositionSample(
        captured_ns=captured_ns,
        received_ns=at_ns - 1_000_000,
        position_m=(n, e, d),
        std_m=0.005,
        source="VISION_POSITION_ESTIMATE",
        seq=seq,
    )


def _truth(scene: Scene, x: Array, u: Array, at_ns: int, sent: int, lost: int) -> Truth:
    return Truth(
        at_ns=at_ns,
        position_m=_position(scene, x),
        velocity_mps=(0.0, 0.0, 0.0),
        state=tuple(x.tolist()),
        input=tuple(u.tolist()),
        sent=sent,
        lost=lost,
        mode="OFFBOARD",
    )


def _spoken(
    scene: Scene,
    pilot: _Pilot,
    u: Array,
    tick: int,
    step: int,
    at_ns: int,
    boundary: bool,
    received: bool,
    solved: bool,
) -> Iterator[Item]:
    """Estimate, decision and events of a tick."""
    n = len(pilot.mean)
    mode = ControlMode.BRAKE if pilot.falling else ControlMode.TRACK
    since_ns = round(((tick % round(scene.dt_s / scene.tick_s)) * scene.tick_s + CAPTURE_DELAY_S) * 1e9)
    captured_ns = at_ns - since_ns - round(pilot.age * scene.dt_s * 1e9)
    zero = tuple((0.0,) * n for _ in range(n))
    yield (
        "/uavctl/estimate",
        at_ns,
        Estimate(at_ns=at_ns, captured_ns=captured_ns, mean=tuple(pilot.mean.tolist()), cov=zero),
    )
    tracking = not pilot.falling and pilot.plan is not None
    yield (
        "/uavctl/decision",
        at_ns,
        Decision(
            tick=tick,
            at_ns=at_ns,
            step=step,
            boundary=boundary,
            mode=mode,
            age_steps=pilot.age,
            news=solved,
            plan_seq=pilot.plan.seq if tracking and pilot.plan is not None else None,
            plan_index=pilot.index if tracking else None,
            solve=SolveStatus.OPTIMAL if solved else None,
            input=tuple(u.tolist()),
            fresh=pilot.fresh,
            missed_ticks=0,
            accepted=int(received),
            rejected=0,
            reason="age reached the horizon" if pilot.falling else "plan",
        ),
    )
    if boundary and pilot.falling and pilot.age == 12:
        yield (
            "/uavctl/event",
            at_ns,
            Event(at_ns=at_ns, severity=Severity.WARNING, code="fallback", text="no position for 12 steps: braking"),
        )
    if tick % 100 == 50:
        yield (
            "/uavctl/event",
            at_ns,
            Event(at_ns=at_ns, severity=Severity.INFO, code="late", text="a sample came out of order", count=3),
        )
