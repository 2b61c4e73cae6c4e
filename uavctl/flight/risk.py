"""Risk in flight: the record of the ages, and the loop on the risk of each step.

1. At each Δt boundary on time, the age of the information that moved the vehicle there is counted: it was one step
   younger when the step began. Ages before the flight count too, as it is the same link: from SETTLING_NS after the
   first position on, and without silences that outlast the horizon, as of a source that is switched off.
2. The risk of that state, given all that is known now, is charged while the controller flies.
3. The next plan is made with the level and the deviations that follow.
"""

from __future__ import annotations

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.event_codes import EventCode
from uavctl.flight.context import TickContext
from uavctl.flight.estimator import select_covariance
from uavctl.flight.mission import MissionState, find_limits
from uavctl.flight.risk_state import RiskGroup, RiskParameters
from uavctl.flight.supervise import Supervised
from uavctl.records import Event, Plan, RiskRecord, Severity
from uavctl.smpc.answer import CONFIGURED_LEVEL, Preview
from uavctl.smpc.conditioned.adaptation import AgeRecord, LoopState, charge_risk, compute_outside_risk, count_age
from uavctl.smpc.conditioned.reference import CERTIFICATE_LEVEL

# The first positions of a source do not show its clock yet: a few round trips take two seconds, and the smallest delay
# shows itself within as much.
SETTLING_NS = 2_000_000_000


def set_risk(preview: Preview, risk: RiskGroup, parameters: RiskParameters | None, *, is_led: bool) -> Preview:
    """Set the level of a plan, and the factors of its deviations.

    Args:
        is_led: Whether one horizontal axis leads. Beside a limit the budgets of a lower level move the other one as
            well: then a frame whose axes are swapped shows nothing along the diagonal.
    """
    if parameters is None:
        return preview
    level = CONFIGURED_LEVEL if is_led else _select_level(risk.ages, parameters)
    if not parameters.adapts:
        return msgspec.structs.replace(preview, level=level)
    widening, silence_widening = risk.loop.widening, risk.loop.silence_widening
    return msgspec.structs.replace(preview, level=level, widening=widening, silence_widening=silence_widening)


def _select_level(ages: AgeRecord, parameters: RiskParameters) -> int:
    """Select the level of the budgets."""
    return ages.level if parameters.budgets == "observed" else CERTIFICATE_LEVEL


def update_risk(
    risk: RiskGroup,
    context: TickContext,
    supervised: Supervised,
    mission: MissionState | None,
    plan: Plan | None,
    spread: float,
) -> tuple[RiskGroup, RiskRecord | None]:
    """Count and charge the step that ends at a boundary; return the record of it.

    Args:
        mission: State of the mission, for the limits of the moment.
        plan: Plan that moved the vehicle here; None if there was none.
        spread: v, by which disturbances differ from the model's.
    """
    parameters, age_steps = context.controller.risk, supervised.view.age_steps
    if parameters is None or not context.is_boundary or context.at_ns != context.boundary_ns or age_steps is None:
        return risk, None
    before = risk.age_steps
    is_flown = context.was_in_control and context.is_controllable
    first_ns = context.at_ns if risk.first_ns is None else risk.first_ns
    if before is None or not (is_flown or _is_counted_before_flight(first_ns, context)):
        return RiskGroup(risk.ages, risk.loop, age_steps, first_ns, risk.renewed), None
    if not is_flown and before >= context.controller.horizon:
        return RiskGroup(risk.renewed, risk.loop, age_steps, first_ns, risk.renewed), None
    age = before + 1
    if not is_flown:
        ages = count_age(risk.ages, age, parameters.shares)
        renewed = ages if age_steps <= before else risk.renewed
        return RiskGroup(ages, risk.loop, age_steps, first_ns, renewed), _make_record(
            age, None, ages, risk.loop, parameters, spread
        )
    margins, variances = _find_margins(context, supervised, parameters, mission)
    charged, outside = charge_step(
        RiskGroup(risk.ages, risk.loop, before, first_ns, risk.renewed),
        age_steps,
        parameters,
        margins,
        variances,
        spread,
        horizon=context.controller.horizon,
        keeps_away=plan is not None and plan.offset > 0.0,
    )
    return charged, _make_record(age, outside, charged.ages, charged.loop, parameters, spread)


def charge_step(
    risk: RiskGroup,
    age_steps: int,
    parameters: RiskParameters,
    margins: Array,
    variances: Array,
    spread: float,
    *,
    horizon: int,
    keeps_away: bool,
) -> tuple[RiskGroup, float]:
    """Count and charge a step that was flown; return the risk after it, and the probability that it was outside.

    Args:
        age_steps: Age of the newest position at the end of the step.
        margins: m = b - C x̂ of the mean there (m,).
        variances: σ² = diag(C P C') (m,).
        spread: v, by which disturbances differ from the model's.
        keeps_away: Whether the plan that moved the vehicle keeps away from a limit.
    """
    assert risk.age_steps is not None, "no position came before"
    age = risk.age_steps + 1
    ages = count_age(risk.ages, age, parameters.shares)
    outside = compute_outside_risk(margins, variances, spread)
    loop = charge_risk(
        risk.loop, outside, parameters.allowed, keeps_away=keeps_away, is_behind_horizon=age_steps >= horizon
    )
    renewed = ages if age_steps <= risk.age_steps else risk.renewed
    return RiskGroup(ages, loop, age_steps, risk.first_ns, renewed), outside


def _is_counted_before_flight(first_ns: int, context: TickContext) -> bool:
    """Return whether a step counts in which the controller does not fly."""
    return context.at_ns - first_ns >= SETTLING_NS


def _make_record(
    age: int, outside: float | None, ages: AgeRecord, loop: LoopState, parameters: RiskParameters, spread: float
) -> RiskRecord:
    """Make the record of a step."""
    return RiskRecord(
        age=age,
        level=_select_level(ages, parameters),
        outside=outside,
        spread=spread,
        widening=loop.widening,
        silence_widening=loop.silence_widening,
    )


def report_saturation(before: RiskGroup, now: RiskGroup, context: TickContext) -> tuple[Event, ...]:
    """Report where the loop's factor begins to be at its largest value."""
    parameters = context.controller.risk
    if parameters is None or not parameters.adapts or before.loop.is_saturated or not now.loop.is_saturated:
        return ()
    text = (
        "The vehicle left its limits more often than allowed. Plans already keep the largest distance from them. "
        "The promised risk does not hold."
    )
    return (Event(at_ns=context.at_ns, severity=Severity.WARNING, code=EventCode.RISK_SATURATED, text=text),)


def _find_margins(
    context: TickContext, supervised: Supervised, parameters: RiskParameters, mission: MissionState | None
) -> tuple[Array, Array]:
    """Find the margins of the estimate to the limits of the moment, and the rows' variances (m,)."""
    belief, kalman, rows = supervised.view.belief, context.controller.kalman, parameters.rows
    if belief is None:
        return np.full(len(rows), np.inf), np.zeros(len(rows))
    n_x = rows.shape[1]
    cov = select_covariance(kalman, belief)[:n_x, :n_x]
    # m = b - C x̂,  σ² = diag(C P C')
    margins = find_limits(context.controller.mission, mission, context.boundary_ns) - rows @ belief.mean[:n_x]
    return margins, ((rows @ cov) * rows).sum(axis=1)
