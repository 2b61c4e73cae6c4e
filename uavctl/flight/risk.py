"""Risk in flight: the record of the ages, and the loop on the risk of each step.

1. At each Δt boundary on time, the age of the information that moved the vehicle there is counted: it was one step
   younger when the step began.
2. The risk of that state, given all that is known now, is charged while the controller flies.
3. The next plan is made with the level and the spread that follow.
"""

from __future__ import annotations

import msgspec

from uavctl.event_codes import EventCode
from uavctl.flight.context import TickContext
from uavctl.flight.estimator import select_covariance
from uavctl.flight.mission import MissionState, find_limits
from uavctl.flight.risk_state import RiskGroup, RiskParameters
from uavctl.flight.supervise import Supervised
from uavctl.records import Event, Plan, RiskRecord, Severity
from uavctl.smpc.answer import CERTIFICATE_LEVEL, Preview
from uavctl.smpc.conditioned.adaptation import charge_risk, compute_outside_risk, count_age


def set_risk(preview: Preview, risk: RiskGroup, parameters: RiskParameters | None) -> Preview:
    """Set the level and the spread of a plan."""
    if parameters is None:
        return preview
    level = risk.ages.level if parameters.budgets == "observed" else CERTIFICATE_LEVEL
    if not parameters.adapts:
        return msgspec.structs.replace(preview, level=level)
    return msgspec.structs.replace(
        preview, level=level, widening=risk.loop.widening, silence_widening=risk.loop.silence_widening
    )


def update_risk(
    risk: RiskGroup, context: TickContext, supervised: Supervised, mission: MissionState | None, plan: Plan | None
) -> tuple[RiskGroup, RiskRecord | None]:
    """Count and charge the step that ends at a boundary; return the record of it.

    Args:
        mission: State of the mission, for the limits of the moment.
        plan: Plan that moved the vehicle here; None if there was none.
    """
    parameters, age_steps = context.controller.risk, supervised.view.age_steps
    if parameters is None or not context.is_boundary or context.at_ns != context.boundary_ns or age_steps is None:
        return risk, None
    before = risk.age_steps
    if before is None or not (context.was_in_control and context.is_controllable):
        return RiskGroup(risk.ages, risk.loop, age_steps), None
    age = before + 1
    ages = count_age(risk.ages, age, parameters.choice)
    # Behind the horizon no plan keeps f times the deviation: with f there, a long silence would raise f without end.
    is_behind_horizon = age_steps >= context.controller.horizon
    widening = 1.0 if is_behind_horizon else risk.loop.widening
    outside = _find_outside_risk(widening, context, supervised, parameters, mission)
    keeps_away = plan is not None and plan.offset > 0.0
    loop = charge_risk(
        risk.loop, outside, parameters.choice.allowed, keeps_away=keeps_away, is_behind_horizon=is_behind_horizon
    )
    record = RiskRecord(
        age=age,
        level=ages.level,
        contradicts=ages.contradicts,
        outside=outside,
        widening=loop.widening,
        silence_widening=loop.silence_widening,
    )
    return RiskGroup(ages, loop, age_steps), record


def report_saturation(before: RiskGroup, now: RiskGroup, context: TickContext) -> tuple[Event, ...]:
    """Report where the spread begins to be at its largest value."""
    parameters = context.controller.risk
    if parameters is None or not parameters.adapts or before.loop.is_saturated or not now.loop.is_saturated:
        return ()
    text = (
        "the vehicle was outside of its limits more often than allowed, and plans keep as far away from them as they "
        "may: the promise does not hold here"
    )
    return (Event(at_ns=context.at_ns, severity=Severity.WARNING, code=EventCode.RISK_SATURATED, text=text),)


def _find_outside_risk(
    widening: float,
    context: TickContext,
    supervised: Supervised,
    parameters: RiskParameters,
    mission: MissionState | None,
) -> float:
    """Find the probability that the vehicle is outside of the limits of the moment."""
    belief, kalman, rows = supervised.view.belief, context.controller.kalman, parameters.rows
    if belief is None:
        return 0.0
    n_x = rows.shape[1]
    cov = select_covariance(kalman, belief)[:n_x, :n_x]
    # m = b - C x̂,  σ² = diag(C P C')
    margins = find_limits(context.controller.mission, mission, context.boundary_ns) - rows @ belief.mean[:n_x]
    return compute_outside_risk(margins, ((rows @ cov) * rows).sum(axis=1), widening)
