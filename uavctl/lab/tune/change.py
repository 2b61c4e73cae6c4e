"""Changes of a configuration by a flight: values that the flight shows well, and nothing else.

Each plant is judged on the halves of the flight that it was not fitted to. Dead time, lag, drag and gain of a
configuration are pinned; noises are fitted for each, so that no filter gets noises that suit the other.

Dead time, lag, drag and gain are adopted where the flight determines them. Noise, loss and delay are raised where the
flight was worse than the configuration assumes, and never lowered: a calm minute does not predict the next day's air or
radio. Inputs may be quicker, down to the weight of the presets that know their autopilot, where the model predicts
well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from uavctl.arrays import Array
from uavctl.config import Config
from uavctl.config.link import LinkConfig
from uavctl.errors import UsageError
from uavctl.lab.identify.fit import AHEAD_S, ROUGH, AxisFit, fit_axes, halves, held_out, standard_errors
from uavctl.lab.identify.history import Stretch
from uavctl.lab.identify.response import DRAG_LAG, VELOCITY_REFERENCE, AxisModel, Free, LinearMotion
from uavctl.lab.identify.result import AxisResponse, Identification, LinkFit
from uavctl.smpc.plant import AXES


class PredictionErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Root mean square errors of the predicted motion, by axis and time ahead."""

    axes: tuple[str, ...]
    ahead_s: tuple[float, ...]  # the first is one step
    rms_m: tuple[tuple[float, ...], ...]  # each axis, each time ahead

    @property
    def overall_m(self) -> float:
        """Geometric mean over axes and the times after the first step [m]."""
        several = np.array(self.rms_m)[:, 1:]
        return float(np.exp(np.mean(np.log(np.maximum(several, 1e-9)))))


@dataclass(frozen=True)
class PinnedAxis:
    """Plant of an axis with some values given, so that only the others are fitted."""

    model: AxisModel  # the plant
    given: Mapping[str, float]  # values by name; what the model has not is passed over

    @property
    def name(self) -> str:
        """See `AxisModel`."""
        return self.model.name

    @property
    def free(self) -> tuple[Free, ...]:
        """See `AxisModel`: the parameters that are not given."""
        return tuple(one for one in self.model.free if one.name not in self.given)

    @property
    def start_std(self) -> tuple[float, ...]:
        """See `AxisModel`."""
        return self.model.start_std

    @property
    def starts(self) -> tuple[dict[str, float], ...]:
        """See `AxisModel`."""
        return self.model.starts[:1]

    def motion(self, parameters: Array) -> LinearMotion:
        """See `AxisModel`."""
        whole = np.empty((len(parameters), len(self.model.free)))
        fitted = iter(parameters.T)
        for column, one in enumerate(self.model.free):
            whole[:, column] = one.inside(self.given[one.name]) if one.name in self.given else next(fitted)
        return self.model.motion(whole)


@dataclass(frozen=True)
class Believed:
    """Response that a configuration assumes."""

    dead_time_s: float  # as a fit has it: without the ramp that the configured one holds [s]
    axes: tuple[Mapping[str, float], ...]  # lag, drag and gain of each axis by name


def believed(config: Config, ramp_s: float) -> Believed:
    """Return the response that a configuration assumes.

    Args:
        ramp_s: Part of its dead time that is the ramp of a setpoint, which the fitted inputs have already [s].
    """
    plant = config.plant
    gains = plant.gain or (1.0,) * len(plant.axes)
    return Believed(
        max(0.0, plant.dead_time_s - ramp_s),
        tuple(
            {"lag_s": lag, "drag_1ps": drag, "gain": gain}
            for lag, drag, gain in zip(plant.lag_s, plant.drag_1ps, gains, strict=True)
        ),
    )


def held_out_errors(
    flown: Sequence[Stretch],
    axes: Sequence[str],
    places: Sequence[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    dt_s: float,
) -> PredictionErrors:
    """Return errors on each half of a flight, by plants that were fitted to the other.

    Args:
        places: 0 north, 1 east, 2 down.
        models: The plant of each; what is pinned is not fitted.
        dead_time_s: Dead time as fitted [s].
        dt_s: One step [s].
    """
    times = (dt_s, *AHEAD_S)
    found = held_out(flown, halves(flown), places, models, dead_time_s, [None] * len(models), times, ROUGH)
    return PredictionErrors(axes=tuple(axes), ahead_s=times, rms_m=tuple(map(tuple, found.rms_m.tolist())))


LEAST_R2 = 0.5  # of the motion of the next second; below, nothing of an axis is taken over
MOST_LAG_STD = 0.5  # of the lag itself
MOST_DRAG_STD_1PS = 0.1
MOST_GAIN_STD = 0.1
MOST_DEAD_RANGE_S = 0.06  # a flat deviance tells dead time and lag no longer apart
GAIN_RANGE = (0.5, 2.0)  # beyond, limits or a hover thrust are in the way, and no gain is told
SHORTEST_LAG_S = 0.011  # the fit's own bound, and a little
CERTAIN = 2.0  # standard errors
QUICK_RATIO = 0.03  # input's weight over the position's, as in the presets that know their autopilot
QUICK_AHEAD_S, QUICK_ERROR_M = 0.5, 0.015  # a model that tells the motion so well may be flown with quicker inputs
LATER_S = 0.005  # by which positions may come later than believed without a change
STALL_S = 0.3  # later than this is no radio but something that stood still: a design for it would be one for nothing
_DIGITS = 4
_TOLD = "told by the flight"
_NO_BETTER = "kept: the flight is predicted no better with it"


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """One value of the configuration beside what the flight shows."""

    key: str
    axis: str = ""  # empty where it is of all
    unit: str = ""
    old: float
    flight: float | None = None  # what the flight says; None where it says nothing
    std: float | None = None  # standard error of that
    new: float  # what is written
    reason: str  # why it is changed, or kept

    @property
    def changed(self) -> bool:
        """Whether the new configuration has another value."""
        return self.new != self.old


class TunedResult(msgspec.Struct, frozen=True, kw_only=True):
    """Changes of a configuration, and the prediction errors of both models on data they were not fitted to."""

    changes: tuple[Change, ...]
    dead_time_range_s: tuple[float, float]
    old_errors: PredictionErrors
    new_errors: PredictionErrors
    link_loss: float
    link_bursts: bool
    link_delay_s: float
    link_jitter_s: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Tuned:
    """Result of a tuning, and the configuration with it."""

    result: TunedResult
    config: Config


def check_tunable(config: Config) -> None:
    """Refuse a plant that has no lag to tune.

    Raises:
        UsageError: It is such a plant.
    """
    if config.plant.model not in (DRAG_LAG, VELOCITY_REFERENCE):
        raise UsageError(
            f'plant.model = "{config.plant.model}": has neither lag nor dead time that a flight could change; begin '
            "with a preset that has: room, room-px4, room-ardupilot"
        )


def tuned(config: Config, found: Identification) -> Tuned:
    """Return the configuration with what a flight shows well.

    Args:
        found: Identification from the flight.
    """
    ramp_s, names = found.result.ramp_s, config.plant.axes
    where, dt_s = [AXES.index(name) for name in names], config.plant.dt_s
    before = believed(config, ramp_s)
    fits, dead_why = _at_a_dead_time(found, where, before.dead_time_s)
    rows = [
        list(_axis_rows(name, place, found, fit, response, answers, config.plant.model == DRAG_LAG))
        for name, place, fit, response, answers in zip(
            names, where, fits, found.result.response, before.axes, strict=True
        )
    ]
    kept = [{_name(row): row.old for row in own if row.reason != _TOLD} for own in rows]
    models = [PinnedAxis(fit.model, own) if own else fit.model for fit, own in zip(fits, kept, strict=True)]
    rows = _refitted(found, where, models, fits[0].dead_time_s, rows) if any(kept) else rows
    new_errors = held_out_errors(found.flown, names, where, models, fits[0].dead_time_s, dt_s)
    as_before = [PinnedAxis(fit.model, answers) for fit, answers in zip(fits, before.axes, strict=True)]
    old_errors = held_out_errors(found.flown, names, where, as_before, before.dead_time_s, dt_s)
    dead_s = round(fits[0].dead_time_s + ramp_s, _DIGITS)
    if new_errors.overall_m >= old_errors.overall_m:
        rows = [[msgspec.structs.replace(row, new=row.old, reason=_NO_BETTER) for row in own] for own in rows]
        dead_s, dead_why, new_errors = config.plant.dead_time_s, _NO_BETTER, old_errors
    dead = Change(
        key="plant.dead_time_s",
        unit="s",
        old=config.plant.dead_time_s,
        flight=round(found.fits[0].dead_time_s + ramp_s, _DIGITS),
        std=(found.result.candidates[0].dead_time_range_s[1] - found.result.candidates[0].dead_time_range_s[0]) / 4.0,
        new=dead_s,
        reason=dead_why,
    )
    changes = (
        dead,
        *(row for own in rows for row in own),
        *_noises(config, found),
        *_links(config, found.link),
        *_weights(config, new_errors),
    )
    result = TunedResult(
        changes=changes,
        dead_time_range_s=found.result.candidates[0].dead_time_range_s,
        old_errors=old_errors,
        new_errors=new_errors,
        link_loss=found.link.loss,
        link_bursts=found.link.bursts,
        link_delay_s=found.link.delay_s,
        link_jitter_s=found.link.jitter_s,
        warnings=found.result.warnings,
    )
    return Tuned(result, _applied(config, changes, found.link))


def _at_a_dead_time(found: Identification, where: list[int], believed_s: float) -> tuple[tuple[AxisFit, ...], str]:
    """Return the fits at the dead time that the flight shows, else at the configured one."""
    low_s, high_s = found.result.candidates[0].dead_time_range_s
    if high_s - low_s <= MOST_DEAD_RANGE_S:
        return found.fits, _TOLD
    models, starts = [fit.model for fit in found.fits], [fit.parameters for fit in found.fits]
    fits = fit_axes(found.flown, where, models, believed_s, starts)
    return fits, f"kept: not told, anything from {low_s:.2f} to {high_s:.2f} s explains the flight"


def _refitted(
    found: Identification,
    where: list[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    rows: Sequence[Sequence[Change]],
) -> list[list[Change]]:
    """Return the rows with what is shown fitted again beside what is kept, as one can stand in for the other."""
    fits = fit_axes(found.flown, where, models, dead_time_s, [None] * len(models))
    return [
        [
            msgspec.structs.replace(row, new=round(max(0.0, fit.value(_name(row))), _DIGITS))
            if row.reason == _TOLD
            else row
            for row in own
        ]
        for fit, own in zip(fits, rows, strict=True)
    ]


def _axis_rows(
    name: str,
    place: int,
    found: Identification,
    fit: AxisFit,
    response: AxisResponse,
    before: Mapping[str, float],
    has_gain: bool,
) -> Iterator[Change]:
    """Return lag, drag and gain of an axis, each with why it is changed or kept."""
    errors = standard_errors(found.flown, place, fit)
    keys = [("lag_s", "s"), ("drag_1ps", "1/s"), *([("gain", "")] if has_gain else [])]
    for key, unit in keys:
        value = max(0.0, fit.value(key))
        std = errors[key] if math.isfinite(errors[key]) else None
        why = _against(key, value, std, response.r2)
        yield Change(
            key=f"plant.{key}",
            axis=name,
            unit=unit,
            old=before[key],
            flight=round(value, _DIGITS),
            std=std,
            new=before[key] if why else round(value, _DIGITS),
            reason=f"kept: {why}" if why else _TOLD,
        )


def _against(key: str, value: float, std: float | None, r2: float) -> str:
    """Return why a fitted value is not adopted; empty if it is."""
    if r2 < LEAST_R2:
        return f"only {100.0 * r2:.0f} % of the motion of the next second is predicted"
    if key == "lag_s" and value < SHORTEST_LAG_S:
        return "shorter than a flight can tell"
    most = {"lag_s": MOST_LAG_STD * value, "drag_1ps": MOST_DRAG_STD_1PS, "gain": MOST_GAIN_STD}[key]
    if std is None or std > most:
        return f"not told (standard error {'unknown' if std is None else f'{std:.2g}'}, at most {most:.2g})"
    if key == "gain" and not GAIN_RANGE[0] <= value <= GAIN_RANGE[1]:
        return "no gain: the vehicle's limits or its hover thrust are in the way"
    return ""


def _noises(config: Config, found: Identification) -> Iterator[Change]:
    """Yield a change for each noise, raised where the flight showed more than configured."""
    made = found.config
    for row, name in enumerate(config.plant.axes):
        old, flight = config.plant.wind_std_mps2[row], made.plant.wind_std_mps2[row]
        yield _raised("plant.wind_std_mps2", name, "m/s²", old, flight)
    yield _raised("estimator.position_std_m", "", "m", config.estimator.position_std_m, made.estimator.position_std_m)


def _links(config: Config, link: LinkFit) -> Iterator[Change]:
    """Yield the changes of loss and delay, raised where the link was worse than configured."""
    sure = link.loss - CERTAIN * link.loss_std
    old = config.link.loss
    if config.link.model == "bernoulli" and not config.link.probability:
        why = _TOLD if sure > old else "kept: the flight lost no more; a day that is worse has to be reckoned with"
        yield Change(
            key="link.loss",
            old=old,
            flight=round(link.loss, _DIGITS),
            std=link.loss_std,
            new=round(link.loss, _DIGITS) if sure > old else old,
            reason=why,
        )
    latest_s = link.delay_s + link.jitter_s
    believed_s = config.link.delay_s + config.link.jitter_s
    if config.link.model != "trace":
        flight_s = round(latest_s - config.link.delay_s, _DIGITS)
        later, stalled = latest_s > believed_s + LATER_S, latest_s > STALL_S
        why = _TOLD if later else "kept: positions came no later"
        if later and stalled:
            why = f"kept: over {STALL_S:g} s late is no link's; a computer or the cameras stood still: see to that"
        yield Change(
            key="link.jitter_s",
            unit="s",
            old=config.link.jitter_s,
            flight=flight_s,
            new=flight_s if later and not stalled else config.link.jitter_s,
            reason=why,
        )


def _weights(config: Config, errors: PredictionErrors) -> Iterator[Change]:
    """Yield the changes of input weights, lower where the model predicts motion well enough for quicker inputs."""
    size = config.plant.states_per_axis
    column = errors.ahead_s.index(QUICK_AHEAD_S)
    for row, name in enumerate(config.plant.axes):
        old, wrong_m = config.cost.input[row], errors.rms_m[row][column]
        quick = round(QUICK_RATIO * config.cost.state[size * row], _DIGITS)
        told = wrong_m <= QUICK_ERROR_M
        lower = told and quick < old
        if lower:
            why = f"the next {QUICK_AHEAD_S:g} s are told to {1e3 * wrong_m:.0f} mm: inputs may be quicker"
        elif told:
            why = "kept: inputs are as quick already"
        else:
            why = f"kept: the next {QUICK_AHEAD_S:g} s are told to {1e3 * wrong_m:.0f} mm only"
        yield Change(key="cost.input", axis=name, old=old, new=quick if lower else old, reason=why)


def _raised(key: str, axis: str, unit: str, old: float, flight: float) -> Change:
    why = _TOLD if flight > old else "kept: the flight was calmer; another day is not"
    return Change(key=key, axis=axis, unit=unit, old=old, flight=flight, new=max(old, flight), reason=why)


def _name(row: Change) -> str:
    return row.key.rpartition(".")[2]


def _applied(config: Config, changes: tuple[Change, ...], link: LinkFit) -> Config:
    """Return the configuration with the new values."""

    def of(key: str) -> tuple[float, ...]:
        return tuple(row.new for row in changes if row.key == key)

    replaced = msgspec.structs.replace
    gains = {"gain": of("plant.gain")} if config.plant.model == DRAG_LAG else {}
    plant = replaced(
        config.plant,
        dead_time_s=of("plant.dead_time_s")[0],
        lag_s=of("plant.lag_s"),
        drag_1ps=of("plant.drag_1ps"),
        wind_std_mps2=of("plant.wind_std_mps2"),
        **gains,
    )
    return replaced(
        config,
        name=f"{config.name.removesuffix('-tuned')}-tuned",
        plant=plant,
        estimator=replaced(config.estimator, position_std_m=of("estimator.position_std_m")[0]),
        link=_worse(config, of("link.loss"), of("link.jitter_s"), link),
        cost=replaced(config.cost, input=of("cost.input")),
    )


def _worse(config: Config, loss: tuple[float, ...], jitter_s: tuple[float, ...], link: LinkFit) -> LinkConfig:
    """Return `[link]` with what was worse; losses in bursts are adopted as measured, if there were no fewer."""
    made = config.link
    if jitter_s:
        made = msgspec.structs.replace(made, jitter_s=jitter_s[0])
    if loss:
        made = msgspec.structs.replace(made, loss=loss[0])
        if link.bursts and link.loss >= config.link.loss - CERTAIN * link.loss_std:
            made = msgspec.structs.replace(made, model="empirical", loss=0.0, gaps=link.runs)
    return made
