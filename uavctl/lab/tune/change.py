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
from uavctl.lab.identify.fit import (
    AHEAD_S,
    ROUGH_TOLERANCE,
    AxisFit,
    compute_held_out_error,
    compute_standard_errors,
    fit_axes,
    split_halves,
)
from uavctl.lab.identify.history import Stretch
from uavctl.lab.identify.response import DRAG_LAG, VELOCITY_REFERENCE, AxisModel, FreeParameter, LinearMotion
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
        later_rms_m = np.array(self.rms_m)[:, 1:]
        return float(np.exp(np.mean(np.log(np.maximum(later_rms_m, 1e-9)))))


@dataclass(frozen=True)
class PinnedAxisModel:
    """Model of an axis with some parameters pinned; only the others are fitted."""

    model: AxisModel  # the plant
    pinned: Mapping[str, float]  # values by name; names that the model lacks are ignored

    @property
    def name(self) -> str:
        """See `AxisModel`."""
        return self.model.name

    @property
    def free(self) -> tuple[FreeParameter, ...]:
        """See `AxisModel`: the parameters that are not pinned."""
        return tuple(parameter for parameter in self.model.free if parameter.name not in self.pinned)

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
        completed = np.empty((len(parameters), len(self.model.free)))
        fitted_columns = iter(parameters.T)
        for column, parameter in enumerate(self.model.free):
            completed[:, column] = (
                parameter.to_search_scale(self.pinned[parameter.name])
                if parameter.name in self.pinned
                else next(fitted_columns)
            )
        return self.model.motion(completed)


@dataclass(frozen=True)
class AssumedResponse:
    """Response that a configuration assumes."""

    dead_time_s: float  # as fitted: without the setpoint ramp that the configured one includes [s]
    axes: tuple[Mapping[str, float], ...]  # lag, drag and gain of each axis by name


def get_assumed_response(config: Config, ramp_s: float) -> AssumedResponse:
    """Return the response that a configuration assumes.

    Args:
        ramp_s: Part of its dead time that stands for the ramp of a setpoint, which the fitted inputs include [s].
    """
    plant = config.plant
    gains = plant.gain or (1.0,) * len(plant.axes)
    return AssumedResponse(
        max(0.0, plant.dead_time_s - ramp_s),
        tuple(
            {"lag_s": lag, "drag_1ps": drag, "gain": gain}
            for lag, drag, gain in zip(plant.lag_s, plant.drag_1ps, gains, strict=True)
        ),
    )


def compute_held_out_errors(
    flown: Sequence[Stretch],
    axes: Sequence[str],
    axis_indices: Sequence[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    dt_s: float,
) -> PredictionErrors:
    """Return errors on each half of a flight, by plants that were fitted to the other.

    Args:
        axis_indices: 0 north, 1 east, 2 down.
        models: Model of each axis; pinned parameters are not fitted.
        dead_time_s: Dead time as fitted [s].
        dt_s: One step [s].
    """
    times = (dt_s, *AHEAD_S)
    errors = compute_held_out_error(
        flown, split_halves(flown), axis_indices, models, dead_time_s, [None] * len(models), times, ROUGH_TOLERANCE
    )
    return PredictionErrors(axes=tuple(axes), ahead_s=times, rms_m=tuple(map(tuple, errors.rms_m.tolist())))


MIN_R2 = 0.5  # of the motion of the next second; below it, no value of an axis is adopted
MAX_LAG_STD = 0.5  # of the lag itself
MAX_DRAG_STD_1PS = 0.1
MAX_GAIN_STD = 0.1
MAX_DEAD_TIME_RANGE_S = 0.06  # a flat deviance does not separate dead time and lag
GAIN_RANGE = (0.5, 2.0)  # beyond it, limits or a hover thrust interfere, and no gain is determined
MIN_LAG_S = 0.011  # a little above the bound of the fit
CONFIDENCE_STDS = 2.0  # standard errors
QUICK_RATIO = 0.03  # input's weight over the position's, as in the presets that know their autopilot
QUICK_AHEAD_S, QUICK_ERROR_M = 0.5, 0.015  # a model that predicts so well permits quicker inputs
DELAY_TOLERANCE_S = 0.005  # positions may arrive later than assumed by this without a change
STALL_S = 0.3  # a longer delay is no radio delay but a halt of a computer, and no design should cover it
_DIGITS = 4
_ADOPTED = "told by the flight"
_NOT_BETTER = "kept: the flight is predicted no better with it"


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """One value of the configuration beside what the flight shows."""

    key: str
    axis: str = ""  # empty where it concerns all
    unit: str = ""
    old: float
    flight: float | None = None  # fitted value; None where there is none
    std: float | None = None  # standard error of the fitted value
    new: float  # value that is written
    reason: str  # why the value is changed or kept

    @property
    def is_changed(self) -> bool:
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
class TunedConfig:
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


def tune_config(config: Config, identification: Identification) -> TunedConfig:
    """Return the configuration with the values that a flight determines well.

    Args:
        identification: Identification from the flight.
    """
    ramp_s, names = identification.result.ramp_s, config.plant.axes
    axis_indices, dt_s = [AXES.index(name) for name in names], config.plant.dt_s
    assumed = get_assumed_response(config, ramp_s)
    fits, dead_time_reason = _fit_at_dead_time(identification, axis_indices, assumed.dead_time_s)
    rows = [
        list(
            _make_axis_changes(
                name, axis_index, identification, fit, response, assumed_axis, config.plant.model == DRAG_LAG
            )
        )
        for name, axis_index, fit, response, assumed_axis in zip(
            names, axis_indices, fits, identification.result.response, assumed.axes, strict=True
        )
    ]
    kept_values = [
        {_get_parameter_name(row): row.old for row in axis_rows if row.reason != _ADOPTED} for axis_rows in rows
    ]
    models = [
        PinnedAxisModel(fit.model, pinned) if pinned else fit.model
        for fit, pinned in zip(fits, kept_values, strict=True)
    ]
    rows = _refit(identification, axis_indices, models, fits[0].dead_time_s, rows) if any(kept_values) else rows
    new_errors = compute_held_out_errors(identification.flown, names, axis_indices, models, fits[0].dead_time_s, dt_s)
    assumed_models = [
        PinnedAxisModel(fit.model, assumed_axis) for fit, assumed_axis in zip(fits, assumed.axes, strict=True)
    ]
    old_errors = compute_held_out_errors(
        identification.flown, names, axis_indices, assumed_models, assumed.dead_time_s, dt_s
    )
    new_dead_time_s = round(fits[0].dead_time_s + ramp_s, _DIGITS)
    if new_errors.overall_m >= old_errors.overall_m:
        rows = [
            [msgspec.structs.replace(row, new=row.old, reason=_NOT_BETTER) for row in axis_rows] for axis_rows in rows
        ]
        new_dead_time_s, dead_time_reason, new_errors = config.plant.dead_time_s, _NOT_BETTER, old_errors
    dead_time_change = Change(
        key="plant.dead_time_s",
        unit="s",
        old=config.plant.dead_time_s,
        flight=round(identification.fits[0].dead_time_s + ramp_s, _DIGITS),
        std=(
            identification.result.candidates[0].dead_time_range_s[1]
            - identification.result.candidates[0].dead_time_range_s[0]
        )
        / 4.0,
        new=new_dead_time_s,
        reason=dead_time_reason,
    )
    changes = (
        dead_time_change,
        *(row for axis_rows in rows for row in axis_rows),
        *_make_noise_changes(config, identification),
        *_make_link_changes(config, identification.link),
        *_make_weight_changes(config, new_errors),
    )
    result = TunedResult(
        changes=changes,
        dead_time_range_s=identification.result.candidates[0].dead_time_range_s,
        old_errors=old_errors,
        new_errors=new_errors,
        link_loss=identification.link.loss,
        link_bursts=identification.link.bursts,
        link_delay_s=identification.link.delay_s,
        link_jitter_s=identification.link.jitter_s,
        warnings=identification.result.warnings,
    )
    return TunedConfig(result, _apply_changes(config, changes, identification.link))


def _fit_at_dead_time(
    identification: Identification, axis_indices: list[int], assumed_s: float
) -> tuple[tuple[AxisFit, ...], str]:
    """Return the fits at the dead time that the flight shows, else at the configured one."""
    low_s, high_s = identification.result.candidates[0].dead_time_range_s
    if high_s - low_s <= MAX_DEAD_TIME_RANGE_S:
        return identification.fits, _ADOPTED
    models, starts = [fit.model for fit in identification.fits], [fit.parameters for fit in identification.fits]
    fits = fit_axes(identification.flown, axis_indices, models, assumed_s, starts)
    return fits, f"kept: not told, anything from {low_s:.2f} to {high_s:.2f} s explains the flight"


def _refit(
    identification: Identification,
    axis_indices: list[int],
    models: Sequence[AxisModel],
    dead_time_s: float,
    rows: Sequence[Sequence[Change]],
) -> list[list[Change]]:
    """Return the rows with adopted values fitted again beside the kept ones, as they trade off against each other."""
    fits = fit_axes(identification.flown, axis_indices, models, dead_time_s, [None] * len(models))
    return [
        [
            msgspec.structs.replace(row, new=round(max(0.0, fit.value(_get_parameter_name(row))), _DIGITS))
            if row.reason == _ADOPTED
            else row
            for row in axis_rows
        ]
        for fit, axis_rows in zip(fits, rows, strict=True)
    ]


def _make_axis_changes(
    name: str,
    axis_index: int,
    identification: Identification,
    fit: AxisFit,
    response: AxisResponse,
    assumed: Mapping[str, float],
    has_gain: bool,
) -> Iterator[Change]:
    """Yield the changes of lag, drag and gain of an axis, each with its reason."""
    errors = compute_standard_errors(identification.flown, axis_index, fit)
    keys = [("lag_s", "s"), ("drag_1ps", "1/s"), *([("gain", "")] if has_gain else [])]
    for key, unit in keys:
        value = max(0.0, fit.value(key))
        std = errors[key] if math.isfinite(errors[key]) else None
        objection = _find_objection(key, value, std, response.r2)
        yield Change(
            key=f"plant.{key}",
            axis=name,
            unit=unit,
            old=assumed[key],
            flight=round(value, _DIGITS),
            std=std,
            new=assumed[key] if objection else round(value, _DIGITS),
            reason=f"kept: {objection}" if objection else _ADOPTED,
        )


def _find_objection(key: str, value: float, std: float | None, r2: float) -> str:
    """Return why a fitted value is not adopted; empty if it is."""
    if r2 < MIN_R2:
        return f"only {100.0 * r2:.0f} % of the motion of the next second is predicted"
    if key == "lag_s" and value < MIN_LAG_S:
        return "shorter than a flight can tell"
    limit = {"lag_s": MAX_LAG_STD * value, "drag_1ps": MAX_DRAG_STD_1PS, "gain": MAX_GAIN_STD}[key]
    if std is None or std > limit:
        return f"not told (standard error {'unknown' if std is None else f'{std:.2g}'}, at most {limit:.2g})"
    if key == "gain" and not GAIN_RANGE[0] <= value <= GAIN_RANGE[1]:
        return "no gain: the vehicle's limits or its hover thrust are in the way"
    return ""


def _make_noise_changes(config: Config, identification: Identification) -> Iterator[Change]:
    """Yield a change for each noise, raised where the flight showed more than configured."""
    fitted = identification.config
    for row, name in enumerate(config.plant.axes):
        old, flight = config.plant.wind_std_mps2[row], fitted.plant.wind_std_mps2[row]
        yield _raise_noise("plant.wind_std_mps2", name, "m/s²", old, flight)
    yield _raise_noise(
        "estimator.position_std_m", "", "m", config.estimator.position_std_m, fitted.estimator.position_std_m
    )
    if config.estimator.bias_drift:
        # The fitted wind is what remains beside the drift, so one is not raised without the other.
        yield _raise_noise(
            "estimator.bias_drift", "", "m/s² / √s", config.estimator.bias_drift, fitted.estimator.bias_drift
        )


def _make_link_changes(config: Config, link: LinkFit) -> Iterator[Change]:
    """Yield the changes of loss and delay, raised where the link was worse than configured."""
    certain_loss = link.loss - CONFIDENCE_STDS * link.loss_std
    old = config.link.loss
    if config.link.model == "bernoulli" and not config.link.probability:
        reason = (
            _ADOPTED
            if certain_loss > old
            else "kept: the flight lost no more; a day that is worse has to be reckoned with"
        )
        yield Change(
            key="link.loss",
            old=old,
            flight=round(link.loss, _DIGITS),
            std=link.loss_std,
            new=round(link.loss, _DIGITS) if certain_loss > old else old,
            reason=reason,
        )
    max_delay_s = link.delay_s + link.jitter_s
    assumed_s = config.link.delay_s + config.link.jitter_s
    if config.link.model != "trace":
        flight_s = round(max_delay_s - config.link.delay_s, _DIGITS)
        is_later, is_stalled = max_delay_s > assumed_s + DELAY_TOLERANCE_S, max_delay_s > STALL_S
        reason = _ADOPTED if is_later else "kept: positions came no later"
        if is_later and is_stalled:
            reason = f"kept: over {STALL_S:g} s late is no link's; a computer or the cameras stood still: see to that"
        yield Change(
            key="link.jitter_s",
            unit="s",
            old=config.link.jitter_s,
            flight=flight_s,
            new=flight_s if is_later and not is_stalled else config.link.jitter_s,
            reason=reason,
        )


def _make_weight_changes(config: Config, errors: PredictionErrors) -> Iterator[Change]:
    """Yield the changes of input weights, lower where the model predicts motion well enough for quicker inputs."""
    size = config.plant.states_per_axis
    column = errors.ahead_s.index(QUICK_AHEAD_S)
    for row, name in enumerate(config.plant.axes):
        old, error_m = config.cost.input[row], errors.rms_m[row][column]
        quick_weight = round(QUICK_RATIO * config.cost.state[size * row], _DIGITS)
        is_predicted = error_m <= QUICK_ERROR_M
        is_lowered = is_predicted and quick_weight < old
        if is_lowered:
            reason = f"the next {QUICK_AHEAD_S:g} s are told to {1e3 * error_m:.0f} mm: inputs may be quicker"
        elif is_predicted:
            reason = "kept: inputs are as quick already"
        else:
            reason = f"kept: the next {QUICK_AHEAD_S:g} s are told to {1e3 * error_m:.0f} mm only"
        yield Change(key="cost.input", axis=name, old=old, new=quick_weight if is_lowered else old, reason=reason)


def _raise_noise(key: str, axis: str, unit: str, old: float, flight: float) -> Change:
    reason = _ADOPTED if flight > old else "kept: the flight was calmer; another day is not"
    return Change(key=key, axis=axis, unit=unit, old=old, flight=flight, new=max(old, flight), reason=reason)


def _get_parameter_name(row: Change) -> str:
    return row.key.rpartition(".")[2]


def _apply_changes(config: Config, changes: tuple[Change, ...], link: LinkFit) -> Config:
    """Return the configuration with the new values."""

    def get_values(key: str) -> tuple[float, ...]:
        return tuple(row.new for row in changes if row.key == key)

    replace = msgspec.structs.replace
    gains = {"gain": get_values("plant.gain")} if config.plant.model == DRAG_LAG else {}
    plant = replace(
        config.plant,
        dead_time_s=get_values("plant.dead_time_s")[0],
        lag_s=get_values("plant.lag_s"),
        drag_1ps=get_values("plant.drag_1ps"),
        wind_std_mps2=get_values("plant.wind_std_mps2"),
        **gains,
    )
    return replace(
        config,
        name=f"{config.name.removesuffix('-tuned')}-tuned",
        plant=plant,
        estimator=replace(
            config.estimator,
            position_std_m=get_values("estimator.position_std_m")[0],
            bias_drift=max((config.estimator.bias_drift, *get_values("estimator.bias_drift"))),
        ),
        link=_make_worse_link(config, get_values("link.loss"), get_values("link.jitter_s"), link),
        cost=replace(config.cost, input=get_values("cost.input")),
    )


def _make_worse_link(config: Config, loss: tuple[float, ...], jitter_s: tuple[float, ...], link: LinkFit) -> LinkConfig:
    """Return `[link]` with the worse values; losses in bursts are adopted as measured, unless there were fewer."""
    worse = config.link
    if jitter_s:
        worse = msgspec.structs.replace(worse, jitter_s=jitter_s[0])
    if loss:
        worse = msgspec.structs.replace(worse, loss=loss[0])
        if link.bursts and link.loss >= config.link.loss - CONFIDENCE_STDS * link.loss_std:
            worse = msgspec.structs.replace(worse, model="empirical", loss=0.0, gaps=link.runs)
    return worse
