"""Phase 6 of a tick: events for people, from the states before and after.

1. The link estimate and the risk count the step that ends at a boundary.
2. Alarms that last are reported once, when they begin: the link, inertial data, the bias, a strong push, the risk.
3. Orders, a new start of the filter, a breach of the envelope, a failed controller, refused samples, missed ticks,
   the solver, relaxed limits and a change of mode have an event each, in this order.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from uavctl.constraint_names import describe_all_relaxed
from uavctl.event_codes import MISSION, EventCode
from uavctl.flight.context import TickContext
from uavctl.flight.decided import Decided
from uavctl.flight.estimator import find_newest_belief
from uavctl.flight.fallback import Fallback, FallbackReason
from uavctl.flight.link_estimate import LinkCounts, count_step, estimate_link
from uavctl.flight.measure import Measured
from uavctl.flight.monitors.acceleration import describe_push
from uavctl.flight.monitors.engaged import MonitorState
from uavctl.flight.monitors.smoothing import SmoothingTrack
from uavctl.flight.orders import Ordered
from uavctl.flight.risk import report_saturation, update_risk
from uavctl.flight.risk_state import RiskGroup
from uavctl.flight.state import AlarmGroup, ControlState
from uavctl.flight.supervise import Supervised
from uavctl.records import ControlMode, Event, LinkEstimate, Severity, Vec3

BELOW_BOUND_SHARE = (
    0.9  # share of its bound below which a bias no longer is at it: one that settles there is reported once
)
SILENT_NS = 1_000_000_000  # without inertial data
ASKED_NS = 4_000_000_000  # from the first tick on, in which they are asked for and begin

_LINK_TEXTS: dict[str, str] = {
    EventCode.LINK_BURSTS: "Positions are lost in bursts. Gaps are longer than independent losses would cause.",
    EventCode.LINK_BELOW_DESIGN: (
        "Fewer positions arrive in time than the design expects. The vehicle may exceed limits more often."
    ),
}
_REFUSED_TEXTS: dict[str, str] = {
    EventCode.SAMPLE_DUPLICATE: "received twice",
    EventCode.SAMPLE_TOO_OLD: "too old",
    EventCode.SAMPLE_INVALID: "a value is not finite, or impossibly large",
    EventCode.SAMPLE_FUTURE: "the stamp lies in the future",
    EventCode.SAMPLE_FROZEN: "the value repeats although the vehicle moves",
    EventCode.SAMPLE_JUMP: "the vehicle cannot have moved so far",
}
_INERTIAL_TEXTS: dict[str, tuple[Severity, str]] = {
    EventCode.INERTIAL_DOUBTED: (
        Severity.WARNING,
        "The IMU data contradict positions, velocity or the model. The controller ignores them.",
    ),
    EventCode.INERTIAL_SILENT: (
        Severity.WARNING,
        "No current IMU data arrive. The controller relies on the model alone.",
    ),
    EventCode.INERTIAL_USED: (Severity.INFO, "The controller uses IMU data again."),
}
_ENTERED = {
    ControlMode.WAIT: (Severity.WARNING, EventCode.DISENGAGED),
    ControlMode.TRACK: (Severity.INFO, EventCode.TRACK),
    ControlMode.BRAKE: (Severity.ERROR, EventCode.BRAKE),
    ControlMode.HOLD: (Severity.WARNING, EventCode.HOLD),
    ControlMode.LAND: (Severity.ERROR, EventCode.LAND),
    ControlMode.STOPPED: (Severity.INFO, EventCode.STOPPED),
}


class Reported(msgspec.Struct, frozen=True, eq=False):
    """Result of phase 6."""

    events: tuple[Event, ...]
    alarms: AlarmGroup
    risk: RiskGroup
    link: LinkEstimate | None  # with the risk; at boundaries that were not missed


def report_events(
    state: ControlState,
    context: TickContext,
    measured: Measured,
    supervised: Supervised,
    ordered: Ordered,
    decided: Decided,
) -> Reported:
    """Report the changes of a tick."""
    before, at_ns = state.alarms, context.at_ns
    counts, link = _count_link(before.link, context, supervised)
    spread = measured.samples.sources.spread.spread
    risk, risk_record = update_risk(state.risk, context, supervised, state.mission.progress, state.plan.flown, spread)
    if link is not None and risk_record is not None:
        link = msgspec.structs.replace(link, risk=risk_record)
    link_alarms = before.link_alarms if link is None else _find_link_alarms(link, before.link_alarms)
    bias = _find_bias(context, supervised)
    inputs_at_bound = before.inputs_at_bound
    if bias:
        inputs_at_bound = find_inputs_at_bound(bias, context.controller.kalman.bias_bounds, before.inputs_at_bound)
    inertial = _find_inertial_use(context, supervised)
    events = (
        *ordered.answers,
        *_report_faults(state, context, measured, supervised, decided),
        *_report_samples(context, measured),
        *_report_delay(state.estimator.sources.smoothing, measured.samples.sources.smoothing, at_ns),
        *_report_decision(context, ordered, decided),
        *_report_link(link_alarms, before.link_alarms, link),
        *_report_inertial(before.inertial, inertial, at_ns),
    )
    if inputs_at_bound != before.inputs_at_bound:
        push_mps2 = context.controller.plant.to_accel(np.array(bias))
        events += report_bias(push_mps2, before.inputs_at_bound, inputs_at_bound, at_ns)
    events += _report_push(state.monitors.engaged, supervised.monitors.engaged, context)
    events += report_saturation(state.risk, risk, context)
    return Reported(events, AlarmGroup(counts, link_alarms, inertial, inputs_at_bound), risk, link)


def _make_event(at_ns: int, severity: Severity, code: str, text: str, count: int = 1, subject: str = "") -> Event:
    return Event(at_ns=at_ns, severity=severity, code=code, text=text, count=count, subject=subject)


def _report_faults(
    state: ControlState, context: TickContext, measured: Measured, supervised: Supervised, decided: Decided
) -> Iterable[Event]:
    """Report a new start of the filter, a breach of the envelope, and a controller that is given up."""
    at_ns, breach = context.at_ns, supervised.breach
    if measured.restarted:
        text = "Positions jumped while the controller did not fly. The estimate starts again."
        yield _make_event(at_ns, Severity.WARNING, EventCode.POSITION_RESTART, text)
    if breach is not None and breach.cause is not None:
        yield _make_event(at_ns, Severity.ERROR, breach.cause.value, breach.text)
    if decided.fault and not state.monitors.external.fault:
        yield _make_event(at_ns, Severity.ERROR, EventCode.CONTROLLER_FAULT, decided.fault)


def _report_samples(context: TickContext, measured: Measured) -> Iterable[Event]:
    """Report samples that were refused, and ticks that were missed."""
    at_ns, refused = context.at_ns, [why for _, why in measured.samples.refused]
    for code in sorted(set(refused)):
        if code != EventCode.SAMPLE_REPEATED:  # some sources send each value twice
            count = refused.count(code)
            text = f"Ignored {count} position{'' if count == 1 else 's'}: {_REFUSED_TEXTS[code]}."
            yield _make_event(at_ns, Severity.WARNING, code, text, count)
    if context.inputs.missed_ticks:
        missed = context.inputs.missed_ticks
        text = f"The control loop ran late and skipped {missed} cycle{'' if missed == 1 else 's'}."
        yield _make_event(at_ns, Severity.WARNING, EventCode.MISSED_TICKS, text, missed)


def _report_delay(before: SmoothingTrack, now: SmoothingTrack, at_ns: int) -> Iterable[Event]:
    """Report a delay of positions where it begins to count."""
    if now.late_s and not before.late_s:
        text = f"Positions are smoothed, or {now.late_s:.2f} s older than their stamps. The controller corrects this."
        yield _make_event(at_ns, Severity.WARNING, EventCode.POSITIONS_LATE, text)


def _report_decision(context: TickContext, ordered: Ordered, decided: Decided) -> Iterable[Event]:
    """Report trouble of the solver, relaxed limits, a change of mode, and the end of the mission."""
    at_ns, plan, mode = context.at_ns, decided.new_plan, decided.mode
    if decided.solve is not None and decided.trouble:
        yield _make_event(at_ns, Severity.WARNING, EventCode(f"solve-{decided.solve.value}"), decided.trouble)
    if plan is not None and plan.gave_way:
        text = describe_all_relaxed(context.controller.names, plan.gave_way)
        yield _make_event(at_ns, Severity.WARNING, EventCode.RELAXED, text)
    is_mission_over = _is_landing_final(decided.fallback) and not _is_landing_final(ordered.fallback)
    if mode is not context.mode or is_mission_over:
        severity, code = _ENTERED[mode]
        if decided.fallback is not None and decided.fallback.reason >= FallbackReason.STOP:
            severity = Severity.INFO  # somebody wanted it
        subject = MISSION if is_mission_over else ""
        yield _make_event(at_ns, severity, code, decided.reason, subject=subject)


def _is_landing_final(fallback: Fallback | None) -> bool:
    return fallback is not None and fallback.reason is FallbackReason.LAND


def _count_link(
    counts: LinkCounts, context: TickContext, supervised: Supervised
) -> tuple[LinkCounts, LinkEstimate | None]:
    """Count the step that ends here for the link; return the counts, and the estimate if this is a boundary on time."""
    age_steps, at_ns = supervised.view.age_steps, context.at_ns
    if not context.is_boundary or age_steps is None or at_ns != context.boundary_ns:
        return counts, None
    counts = count_step(counts, age_steps == 0, context.controller.link)
    return counts, estimate_link(counts, context.controller.link, at_ns)


def _find_link_alarms(link: LinkEstimate, reported: tuple[str, ...]) -> tuple[str, ...]:
    """Find the link alarms that hold; a reported one holds on until the estimate is on the good side again."""
    alarms: tuple[str, ...] = ()
    if link.bursts or (link.burst_statistic > 0.0 and EventCode.LINK_BURSTS in reported):
        alarms = (EventCode.LINK_BURSTS,)
    if link.below_promise or (link.arrival_mean < link.promised and EventCode.LINK_BELOW_DESIGN in reported):
        alarms = (*alarms, EventCode.LINK_BELOW_DESIGN)
    return alarms


def _report_link(alarms: tuple[str, ...], reported: tuple[str, ...], link: LinkEstimate | None) -> Iterable[Event]:
    """Report each link alarm that did not hold before."""
    if link is not None:
        for code in alarms:
            if code not in reported:
                yield _make_event(link.at_ns, Severity.WARNING, code, _LINK_TEXTS[code])


def _find_inertial_use(context: TickContext, supervised: Supervised) -> str:
    """Find the use of the vehicle's inertial data as an event code; empty if none are used or we do not fly."""
    history, kalman = supervised.view.history, context.controller.kalman
    if not (kalman.n_inertial and context.was_in_control and context.is_controllable):
        return ""
    belief = find_newest_belief(kalman, history)
    if belief is None:
        return ""
    if belief.inertial.distrusted_ns is not None:
        return EventCode.INERTIAL_DOUBTED
    newest_ns = belief.inertial.used_ns or history.origin_ns + ASKED_NS
    return EventCode.INERTIAL_SILENT if context.at_ns - newest_ns > SILENT_NS else EventCode.INERTIAL_USED


def _report_inertial(before: str, now: str, at_ns: int) -> Iterable[Event]:
    """Report a change in the use of inertial data; their use only where they were not used before."""
    if now not in ("", before) and (now != EventCode.INERTIAL_USED or before):
        severity, text = _INERTIAL_TEXTS[now]
        yield _make_event(at_ns, severity, now, text)


def _find_bias(context: TickContext, supervised: Supervised) -> tuple[float, ...]:
    """Find the bias that is flown against; empty where there is none, or others fly."""
    estimate = supervised.view.estimate
    return estimate.bias if estimate is not None and context.was_in_control and context.is_controllable else ()


def find_inputs_at_bound(bias: Sequence[float], bounds: Sequence[float], reported: Sequence[int]) -> tuple[int, ...]:
    """Find the inputs whose bias is at its bound.

    Args:
        bias: estimated one, each input [input units].
        bounds: largest bias of each input that is flown against [input units].
        reported: inputs that were already reported to be at their bounds.
    """
    return tuple(
        i
        for i, (value, bound) in enumerate(zip(bias, bounds, strict=False))
        if abs(value) >= (BELOW_BOUND_SHARE * bound if i in reported else bound)
    )


def report_bias(push_mps2: Vec3, before: Sequence[int], now: Sequence[int], at_ns: int) -> tuple[Event, ...]:
    """Report if the bias of a further input is at its bound, and once none is any more.

    Args:
        push_mps2: the bias as an acceleration, local NED [m/s²].
        before: inputs that were already reported to be at their bounds.
    """
    if set(now) - set(before):
        pushes = ", ".join(f"{value:+.2f}" for value in push_mps2)
        text = (
            f"A lasting push of {pushes} m/s² (north, east, down), such as wind, has reached the largest compensation. "
            "A stronger push moves the vehicle away from its target."
        )
        return (_make_event(at_ns, Severity.WARNING, EventCode.BIAS_AT_BOUND, text),)
    if before and not now:
        text = "The lasting push is small enough again to be compensated."
        return (_make_event(at_ns, Severity.INFO, EventCode.BIAS_FREE, text),)
    return ()


def _report_push(before: MonitorState, now: MonitorState, context: TickContext) -> tuple[Event, ...]:
    """Report where a push that the vehicle's inertial data explain begins to be a strong one."""
    if before.acceleration.is_pushed or not now.acceleration.is_pushed:
        return ()
    text = describe_push(now.motion, context.inputs.motion, context.at_ns)
    return (_make_event(context.at_ns, Severity.WARNING, EventCode.STRONG_PUSH, text),)
