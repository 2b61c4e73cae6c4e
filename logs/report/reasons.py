"""Sentences below a flight's headline: what stands behind it and is no finding of its own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from logs.recording.summary import count
from logs.report.causes import metres, seconds
from logs.report.evidence import FlightEvidence
from logs.report.excursion import GRAVE_M, Excursion, trusted
from uavctl.records import number

_FAR_M = 0.3  # between the estimate and the true place: worth telling
_GATE_SHARE = 0.15  # of the setpoints: setting out takes some
_AT_BOUND = 0.999  # of the largest bias
_NEAR_BOUND = 0.7  # of the acceleration that the envelope allows to be unexplained
_COMPASS = {"north": ("north", "south"), "east": ("east", "west"), "down": ("down", "up")}


def reasons(e: FlightEvidence, worst: Excursion | None) -> Iterator[str]:
    """Return the sentences; `worst` is the excursion that the headline tells of, None if it tells of another cause."""
    if worst is not None:
        yield from _outside(e, worst)
    yield from _gate(e)
    yield from _bias(e)
    yield from _model(e)
    yield from _solver(e)


def _outside(e: FlightEvidence, worst: Excursion) -> Iterator[str]:
    until = "to the end of the recording" if worst.back_s is None else f"until {seconds(worst.back_s)}"
    whole = f"It was beyond the {worst.wall} from {seconds(worst.left_s)} on, {until}"
    others = [
        f"{metres(one.beyond_m)} {one.passage} at {seconds(one.worst_s)}"
        for one in e.excursions[1:3]
        if one.beyond_m >= min(GRAVE_M, worst.beyond_m)
    ]
    yield f"{whole}{'; also ' + ', '.join(others) if others else ''}."
    push = e.push(worst)
    if push is not None:
        yield (
            f"From {seconds(push.begun_s)} to {seconds(push.ended_s)} it was pushed outwards by "
            f"{push.accel_mps2:.1f} m/s² beside its setpoints."
        )
    believed = _believed(e, worst)
    if believed is not None:
        yield believed


def _believed(e: FlightEvidence, worst: Excursion) -> str | None:
    """Return a sentence on where the estimate put it at the worst moment; None if about right, or not known."""
    flight, at_ns = e.flight, e.flight.origin_ns + round(worst.worst_s * 1e9)
    near = min(trusted(flight), key=lambda one: abs(one.at_ns - at_ns), default=None)
    if not flight.truths or near is None or abs(near.at_ns - at_ns) > flight.tick_ns:
        return None
    off_m = float(np.linalg.norm(np.subtract(flight.design.position_of(near.mean), worst.worst_m)))
    if not np.isfinite(off_m) or off_m < _FAR_M:
        return None
    return f"At {seconds(worst.worst_s)} the estimate put it {metres(off_m)} away from where it was."


def _gate(e: FlightEvidence) -> Iterator[str]:
    """Return a sentence on setpoints that the last gate changed, if these were more than a few."""
    share, first_s, kinds = e.limited()
    if share > _GATE_SHARE:
        names = ", ".join(f"{name} {100 * part:.0f} %" for name, part in kinds)
        yield f"The last gate limited {100 * share:.0f} % of the setpoints ({names}), first at {seconds(first_s)}."


def _bias(e: FlightEvidence) -> Iterator[str]:
    """Return a sentence for each axis whose estimated bias was at its bound."""
    t_s, biases, bounds = e.biases()
    if len(bounds) != biases.shape[1]:
        return
    for column, axis in enumerate(e.flight.design.axes):
        bound = float(bounds[column])
        at = np.abs(biases[:, column]) >= _AT_BOUND * bound
        if bound and at.any():
            side = _COMPASS[axis][int(biases[at, column].mean() < 0)]
            lasted_s = int(at.sum()) * e.flight.tick_ns * 1e-9
            unit = e.flight.design.input_unit
            yield (
                f"The estimated bias was at its bound of {number(bound, 2)} {unit} towards {side} for "
                f"{seconds(lasted_s)}, first at {seconds(float(t_s[at][0]))}."
            )


def _model(e: FlightEvidence) -> Iterator[str]:
    """Return sentences on what positions showed that nothing sent explains, and on errors of the forecast."""
    shown = [(d.unexplained_mps2, d.at_ns) for d in e.flight.decisions if d.unexplained_mps2 is not None]
    bound = None if e.config is None else e.config.envelope.unexplained_mps2
    if shown and bound:
        most, at_ns = max(shown)
        if most > _NEAR_BOUND * bound:
            yield (
                f"Positions showed {most:.1f} m/s² that no setpoint had asked for, at {seconds(e.second(at_ns))}; "
                f"{number(bound)} m/s² is what wind and the model's error may make."
            )
    model = e.judged.verdicts.model
    axes = () if model is None else model.axes
    larger, telling = [one for one in axes if one.larger], [one for one in axes if one.telling]
    if larger:
        sizes = ", ".join(f"{one.variance**0.5:.1f} times {one.axis}" for one in larger)
        yield (
            f"Errors of the forecast were larger than the model expects ({sizes}, over {larger[0].count} positions): "
            "more wind, or noisier positions, than it was made for."
        )
    elif telling:
        found = ", ".join(f"{one.correlation[0]:.1f} {one.axis}".replace("-", "−") for one in telling)
        yield (
            f"An error of the forecast says something of the next one (correlation {found}, over {telling[0].count} "
            "positions): wind that stays for a while, or a vehicle that answers otherwise."
        )


def _solver(e: FlightEvidence) -> Iterator[str]:
    failed = [d for d in e.flight.decisions if d.solve is not None and d.solve.value != "optimal"]
    if failed:
        at_s = e.second(failed[0].at_ns)
        yield f"{count(len(failed), 'plan')} of {e.summary.solves} came to no optimum, first at {seconds(at_s)}."
