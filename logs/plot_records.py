"""What people plot, as flat records; NaN where there is no number, which a plot shows as a gap."""

from __future__ import annotations

import math
from collections.abc import Sequence

from logs.design_view import DesignView, Floats
from uavctl.data import (
    Decision,
    Estimate,
    LinkEstimate,
    LinkStats,
    Matrix,
    Plan,
    Record,
    Setpoint,
    Timing,
    Truth,
    VehicleStatus,
)


class Axes(Record, frozen=True, kw_only=True):
    """One number for each axis of local NED; NaN for an axis that the plant has not."""

    north: float = math.nan
    east: float = math.nan
    down: float = math.nan


class AgePlot(Record, frozen=True, kw_only=True):
    """Age of the newest position, and what a tick made of it."""

    age_s: float  # from its capture to this tick
    age_steps: float  # as the controller counts it
    limit_steps: float  # the age at which a plan is played out (H)
    plan_index: float  # of the input that is flown
    news: bool
    mode: str
    reason: str


class InputPlot(Record, frozen=True, kw_only=True):
    """Input that a tick chose, and the limits of plans (an estimated bias may go beyond); in the plant's units."""

    chosen: Axes
    lower: Axes
    upper: Axes


class SetpointPlot(Record, frozen=True, kw_only=True):
    """Acceleration that was sent [m/s²]."""

    accel_mps2: Axes
    limited: bool  # the last gate changed it
    source: str


class StatePlot(Record, frozen=True, kw_only=True):
    """State estimate."""

    position_m: Axes
    velocity_mps: Axes
    position_std_m: Axes


class LimitsPlot(Record, frozen=True, kw_only=True):
    """Limits of position and velocity, and what the newest plan left of them at its end; infinite where open."""

    position_lower_m: Axes
    position_upper_m: Axes
    tightened_lower_m: Axes  # with the back-offs of the plan's last stage
    tightened_upper_m: Axes
    velocity_lower_mps: Axes
    velocity_upper_mps: Axes


class SolvePlot(Record, frozen=True, kw_only=True):
    """How a plan was found; how long it took is in `/plot/timing`."""

    status: str
    method: str
    iterations: int
    gap: float
    cost: float
    slack: float
    offset: float
    terminal_miss: float


class TimingPlot(Record, frozen=True, kw_only=True):
    """Run time of a tick; the ticks that solve are the long ones."""

    lateness_us: float
    step_us: float  # in the controller
    send_us: float  # from the deadline to the socket
    capture_to_send_ms: float


class LinkPlot(Record, frozen=True, kw_only=True):
    """The link that carries the positions: what is believed of it, and what the design counts on."""

    arrival_mean: float
    arrival_lower: float
    promised: float
    below_promise: bool
    bursts: bool
    burst_statistic: float


class CounterPlot(Record, frozen=True, kw_only=True):
    """Counters of one connection, and its clock."""

    link: str
    datagrams: int
    messages: int
    samples: int
    bad: int
    clock_offset_ms: float
    clock_rtt_ms: float
    clock_drift_ppm: float


class TruthPlot(Record, frozen=True, kw_only=True):
    """The simulator's own state."""

    position_m: Axes
    velocity_mps: Axes
    sent: int
    lost: int


class VehiclePlot(Record, frozen=True, kw_only=True):
    """The vehicle as it tells."""

    mode: str
    armed: bool
    external: bool
    battery_v: float


def axes_of(design: DesignView, values: Sequence[float] | Floats) -> Axes:
    """Numbers in the order of the plant's axes, by name."""
    return Axes(**dict(zip(design.axes, map(float, values), strict=True)))


def pick(values: Sequence[float] | Floats, index: Sequence[int]) -> list[float]:
    """The values at some places."""
    return [float(values[i]) for i in index]


def age_plot(design: DesignView, decision: Decision, captured_ns: int | None) -> AgePlot:
    """Age in a tick; `captured_ns` is the capture time of the newest position so far."""
    return AgePlot(
        age_s=math.nan if captured_ns is None else (decision.at_ns - captured_ns) * 1e-9,
        age_steps=_number(decision.age_steps),
        limit_steps=float(design.horizon),
        plan_index=_number(decision.plan_index),
        news=decision.news,
        mode=decision.mode.value,
        reason=decision.reason,
    )


def input_plot(design: DesignView, decision: Decision) -> InputPlot:
    """Input of a tick."""
    box = design.input_box
    chosen = Axes() if decision.input is None else axes_of(design, decision.input)
    return InputPlot(chosen=chosen, lower=axes_of(design, box.lower), upper=axes_of(design, box.upper))


def setpoint_plot(setpoint: Setpoint) -> SetpointPlot:
    """What was sent."""
    north, east, down = setpoint.accel_mps2
    accel = Axes(north=north, east=east, down=down)
    return SetpointPlot(accel_mps2=accel, limited=bool(setpoint.limited), source=setpoint.source.value)


def state_plot(design: DesignView, estimate: Estimate) -> StatePlot:
    """An estimate by axis."""
    std = [math.sqrt(max(0.0, estimate.cov[i][i])) for i in design.position_index]
    return StatePlot(
        position_m=axes_of(design, pick(estimate.mean, design.position_index)),
        velocity_mps=axes_of(design, pick(estimate.mean, design.velocity_index)),
        position_std_m=axes_of(design, std),
    )


def limits_plot(design: DesignView, plan: Plan) -> LimitsPlot:
    """Limits and the tightened ones of a plan."""
    box = design.state_box
    lower, upper = tightened(design, plan.backoff_x, -1)
    return LimitsPlot(
        position_lower_m=axes_of(design, pick(box.lower, design.position_index)),
        position_upper_m=axes_of(design, pick(box.upper, design.position_index)),
        tightened_lower_m=axes_of(design, pick(lower, design.position_index)),
        tightened_upper_m=axes_of(design, pick(upper, design.position_index)),
        velocity_lower_mps=axes_of(design, pick(box.lower, design.velocity_index)),
        velocity_upper_mps=axes_of(design, pick(box.upper, design.velocity_index)),
    )


def tightened(design: DesignView, backoff: Matrix, stage: int) -> tuple[Floats, Floats]:
    """Sides of the state box less the back-offs of a stage: lower and upper (n_x,)."""
    lower, upper, kept = design.state_box.lower.copy(), design.state_box.upper.copy(), backoff[stage]
    for side, closed in zip((lower, upper), design.closed_sides, strict=True):
        for state, row, size in closed:
            side[state] -= kept[row] / size
    return lower, upper


def solve_plot(plan: Plan) -> SolvePlot:
    """How a plan was found."""
    return SolvePlot(
        status=plan.status.value,
        method=plan.method,
        iterations=plan.iterations,
        gap=plan.gap,
        cost=plan.cost,
        slack=plan.slack,
        offset=plan.offset,
        terminal_miss=plan.terminal_miss,
    )


def timing_plot(timing: Timing) -> TimingPlot:
    """Run time of a tick."""
    return TimingPlot(
        lateness_us=timing.lateness_ns * 1e-3,
        step_us=timing.step_ns * 1e-3,
        send_us=timing.send_ns * 1e-3,
        capture_to_send_ms=_number(timing.capture_to_send_ns) * 1e-6,
    )


def link_plot(link: LinkEstimate) -> LinkPlot:
    """What is believed of the link."""
    return LinkPlot(
        arrival_mean=link.arrival_mean,
        arrival_lower=link.arrival_lower,
        promised=link.promised,
        below_promise=link.below_promise,
        bursts=link.bursts,
        burst_statistic=link.burst_statistic,
    )


def counter_plot(stats: LinkStats) -> CounterPlot:
    """Counters of a connection."""
    return CounterPlot(
        link=stats.link,
        datagrams=stats.datagrams,
        messages=stats.messages,
        samples=stats.samples,
        bad=sum(stats.bad.values()),
        clock_offset_ms=_number(stats.clock_offset_ns) * 1e-6,
        clock_rtt_ms=_number(stats.clock_rtt_ns) * 1e-6,
        clock_drift_ppm=_number(stats.clock_drift_ppm),
    )


def truth_plot(truth: Truth) -> TruthPlot:
    """The simulator's state."""
    position, velocity = (Axes(north=v[0], east=v[1], down=v[2]) for v in (truth.position_m, truth.velocity_mps))
    return TruthPlot(position_m=position, velocity_mps=velocity, sent=truth.sent, lost=truth.lost)


def vehicle_plot(status: VehicleStatus) -> VehiclePlot:
    """The vehicle as it tells."""
    return VehiclePlot(
        mode=status.mode, armed=status.armed, external=status.external, battery_v=_number(status.battery_v)
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
