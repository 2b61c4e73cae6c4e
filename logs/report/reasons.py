"""Sentences below a flight's headline: details that are not findings of their own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from logs.recording.summary import count
from logs.report.evidence import FlightEvidence
from logs.report.excursion import GRAVE_M, Excursion, select_trusted_estimates
from logs.report.findings import metres, seconds
from uavctl.number_text import format_number

_MIN_ESTIMATE_ERROR_M = 0.3  # between the estimate and the true place: worth reporting
_GATE_SHARE = 0.15  # of the setpoints: some are limited at departure
_BOUND_SHARE = 0.999  # of the largest bias
_NEAR_BOUND_SHARE = 0.7  # of the acceleration that the envelope allows to be unexplained
_DIRECTIONS = {"north": ("north", "south"), "east": ("east", "west"), "down": ("down", "up")}


def describe_reasons(e: FlightEvidence, worst: Excursion | None) -> Iterator[str]:
    """Return the sentences; `worst` is the excursion in the headline, None if the headline has another cause."""
    if worst is not None:
        yield from _describe_excursion(e, worst)
    yield from _describe_gate(e)
    yield from _describe_bias(e)
    yield from _describe_model(e)
    yield from _describe_failed_solves(e)


def _describe_excursion(e: FlightEvidence, worst: Excursion) -> Iterator[str]:
    end_text = "to the end of the recording" if worst.return_s is None else f"until {seconds(worst.return_s)}"
    text = f"The vehicle was beyond the {worst.wall} from {seconds(worst.exit_s)} on, {end_text}"
    other_excursions = [
        f"{metres(excursion.beyond_m)} {excursion.passage} at {seconds(excursion.worst_s)}"
        for excursion in e.excursions[1:3]
        if excursion.beyond_m >= min(GRAVE_M, worst.beyond_m)
    ]
    yield f"{text}{'; also ' + ', '.join(other_excursions) if other_excursions else ''}."
    push = e.estimate_push(worst)
    if push is not None:
        yield (
            f"From {seconds(push.begun_s)} to {seconds(push.ended_s)} the vehicle was pushed outwards by "
            f"{push.accel_mps2:.1f} m/s² in addition to its setpoints."
        )
    estimate_text = _describe_estimate_error(e, worst)
    if estimate_text is not None:
        yield estimate_text


def _describe_estimate_error(e: FlightEvidence, worst: Excursion) -> str | None:
    """Return a sentence on the error of the estimate at the worst moment; None if small or unknown."""
    flight, at_ns = e.flight, e.flight.origin_ns + round(worst.worst_s * 1e9)
    nearest = min(select_trusted_estimates(flight), key=lambda estimate: abs(estimate.at_ns - at_ns), default=None)
    if not flight.truths or nearest is None or abs(nearest.at_ns - at_ns) > flight.tick_ns:
        return None
    error_m = float(np.linalg.norm(np.subtract(flight.design.position_of(nearest.mean), worst.worst_m)))
    if not np.isfinite(error_m) or error_m < _MIN_ESTIMATE_ERROR_M:
        return None
    return f"At {seconds(worst.worst_s)} the estimate was {metres(error_m)} from the true position."


def _describe_gate(e: FlightEvidence) -> Iterator[str]:
    """Return a sentence on setpoints that the setpoint limiter changed, if these were more than a few."""
    share, first_s, kinds = e.count_limited()
    if share > _GATE_SHARE:
        names = ", ".join(f"{name} {100 * part:.0f} %" for name, part in kinds)
        first = seconds(first_s)
        yield f"The setpoint limiter changed {100 * share:.0f} % of the setpoints ({names}), first at {first}."


def _describe_bias(e: FlightEvidence) -> Iterator[str]:
    """Return a sentence for each axis whose estimated bias was at its bound."""
    t_s, biases, bounds = e.collect_biases()
    if len(bounds) != biases.shape[1]:
        return
    for column, axis in enumerate(e.flight.design.axes):
        bound = float(bounds[column])
        is_at_bound = np.abs(biases[:, column]) >= _BOUND_SHARE * bound
        if bound and is_at_bound.any():
            direction = _DIRECTIONS[axis][int(biases[is_at_bound, column].mean() < 0)]
            lasted_s = int(is_at_bound.sum()) * e.flight.tick_ns * 1e-9
            unit = e.flight.design.input_unit
            yield (
                f"The estimated bias was at its bound of {format_number(bound, 2)} {unit} towards {direction} for "
                f"{seconds(lasted_s)}, first at {seconds(float(t_s[is_at_bound][0]))}."
            )


def _describe_model(e: FlightEvidence) -> Iterator[str]:
    """Return sentences on unexplained acceleration and on errors of the forecast."""
    unexplained = [(d.unexplained_mps2, d.at_ns) for d in e.flight.decisions if d.unexplained_mps2 is not None]
    bound = None if e.config is None else e.config.envelope.unexplained_mps2
    if unexplained and bound:
        max_mps2, at_ns = max(unexplained)
        if max_mps2 > _NEAR_BOUND_SHARE * bound:
            yield (
                f"Positions showed {max_mps2:.1f} m/s² that no setpoint explains, at "
                f"{seconds(e.to_seconds(at_ns))}; "
                f"the envelope allows {format_number(bound)} m/s² for wind and model error."
            )
    model = e.judged.verdicts.model
    axes = () if model is None else model.axes
    large_axes, correlated_axes = (
        [verdict for verdict in axes if verdict.has_larger_errors],
        [verdict for verdict in axes if verdict.has_correlated_errors],
    )
    if large_axes:
        sizes = ", ".join(f"{verdict.variance**0.5:.1f} times {verdict.axis}" for verdict in large_axes)
        yield (
            f"Errors of the forecast were larger than the model expects ({sizes}, over {large_axes[0].count} "
            "positions): more wind or noisier positions than assumed, or a wrong model (drag, lag or gain), which "
            "`uavctl identify` measures."
        )
    elif correlated_axes:
        correlations = ", ".join(
            f"{verdict.correlation[0]:.1f} {verdict.axis}".replace("-", "−") for verdict in correlated_axes
        )
        yield (
            f"Successive errors of the forecast are correlated ({correlations}, over {correlated_axes[0].count} "
            "positions): lasting wind, or a vehicle that responds differently from the model."
        )


def _describe_failed_solves(e: FlightEvidence) -> Iterator[str]:
    failed = [d for d in e.flight.decisions if d.solve is not None and d.solve.value != "optimal"]
    if failed:
        at_s = e.to_seconds(failed[0].at_ns)
        yield f"{count(len(failed), 'plan')} of {e.summary.solves} reached no optimum, first at {seconds(at_s)}."
