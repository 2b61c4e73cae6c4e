"""What was identified, and the configuration that it makes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import msgspec

from uavctl.config import Config
from uavctl.errors import RecordingError
from uavctl.identify.fit import AxisFit, fit_axis, scan_dead_time, standard_errors
from uavctl.identify.history import Stretch, stretches, thinned
from uavctl.identify.link_fit import LinkFit, fit_link
from uavctl.identify.prediction import Prediction, predict
from uavctl.identify.recorded import History

AXES = ("north", "east", "down")
_LEAST_INPUT_STD = 0.02  # m/s²; an axis that was hardly steered shows nothing of how it answers
_DIGITS = 4
_OF_OTHER_MODELS = (
    *("a", "b", "e", "w", "position_index", "velocity_index", "accel_per_input"),
    *("position_1ps", "velocity_1ps", "integral_1ps2", "input_std_mps2", "force_drift_mps2_rts"),
)


class AxisResponse(msgspec.Struct, frozen=True, kw_only=True):
    """Response of one axis, as the controller models it and with a dead time."""

    axis: str
    lag_s: float
    drag_1ps: float
    gain: float
    wind_std_mps2: float
    position_std_m: float
    lag_std_s: float | None
    drag_std_1ps: float | None
    gain_std: float | None
    dead_time_s: float  # of the model with a dead time, and its lag
    dead_time_lag_s: float
    residual_std_m: float
    r2: float


class Identified(msgspec.Struct, frozen=True, kw_only=True):
    """What `uavctl identify` tells."""

    flown_s: float
    positions: int
    plant: dict[str, object]
    response: tuple[AxisResponse, ...]
    residual_std: tuple[float, ...]
    r2: tuple[float, ...]
    link: dict[str, object]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Identification:
    """Result, the configuration with it, and what the plots show."""

    result: Identified
    config: Config
    link: LinkFit
    predictions: tuple[Prediction, ...]


def identify(history: History, config: Config, advance: Callable[[], None]) -> Identification:
    """Identify plant and link.

    Args:
        history: The flight.
        config: What the result is put into; its axes and Δt are kept.
        advance: Called after each fit (`fit.FITS` an axis).

    Raises:
        RecordingError: The flight does not show enough.
    """
    dt_s = config.plant.dt_s
    flown = tuple(thinned(stretch, dt_s * (1.0 - 1e-6)) for stretch in stretches(history.asked, history.seen))
    plain, delayed, predictions = [], [], []
    for name in config.plant.axes:
        axis = AXES.index(name)
        _check_moved(flown, axis)
        fit = fit_axis(flown, axis, 0.0)
        advance()
        plain.append(fit)
        delayed.append(scan_dead_time(flown, axis, fit, advance))
        predictions.append(predict(flown, axis, fit))
    responses = tuple(
        _response(name, flown, fit, late, prediction, dt_s)
        for name, fit, late, prediction in zip(config.plant.axes, plain, delayed, predictions, strict=True)
    )
    link = fit_link(history.seen, history.gaps)
    made = _config(config, responses, link)
    result = Identified(
        flown_s=sum(stretch.length_s for stretch in flown),
        positions=link.received,
        plant=_plant_section(made),
        response=responses,
        residual_std=tuple(one.residual_std_m for one in responses),
        r2=tuple(one.r2 for one in responses),
        link=_link_section(link),
        warnings=tuple(_doubts(responses)),
    )
    return Identification(result, made, link, tuple(predictions))


def _check_moved(flown: Sequence[Stretch], axis: int) -> None:
    inputs = [float(stretch.inputs_mps2[:, axis].std()) for stretch in flown]
    if max(inputs) < _LEAST_INPUT_STD:
        raise RecordingError(
            f"setpoints hardly changed in {AXES[axis]} (standard deviation {max(inputs):.2g} m/s²): the flight does "
            "not show how the vehicle answers there; fly waypoints that differ in every axis"
        )


def _response(
    name: str, flown: Sequence[Stretch], fit: AxisFit, late: AxisFit, prediction: Prediction, dt_s: float
) -> AxisResponse:
    lag_std, drag_std, gain_std = standard_errors(flown, AXES.index(name), fit)
    return AxisResponse(
        axis=name,
        lag_s=fit.lag_s,
        drag_1ps=max(fit.drag_1ps, 0.0),
        gain=fit.gain,
        wind_std_mps2=fit.wind_mps2_rts / math.sqrt(dt_s),
        position_std_m=fit.noise_m,
        lag_std_s=_finite(lag_std),
        drag_std_1ps=_finite(drag_std),
        gain_std=_finite(gain_std),
        dead_time_s=late.dead_time_s,
        dead_time_lag_s=late.lag_s,
        residual_std_m=prediction.residual_std_m,
        r2=prediction.r2,
    )


def _doubts(responses: Sequence[AxisResponse]) -> list[str]:
    found = []
    for one in responses:
        if one.r2 < 0.5:
            found.append(f"{one.axis}: only {100 * one.r2:.0f} % of the motion of the next second is predicted")
        if one.lag_std_s is None or one.lag_std_s > 0.5 * one.lag_s:
            found.append(f"{one.axis}: the lag of {one.lag_s:.2f} s is uncertain; fly more changes of direction")
    return found


def _config(config: Config, responses: Sequence[AxisResponse], link: LinkFit) -> Config:
    """The configuration with what was identified."""
    plant = msgspec.structs.replace(
        config.plant,
        model="drag-lag",
        **dict.fromkeys(_OF_OTHER_MODELS, ()),
        drag_1ps=_rounded(one.drag_1ps for one in responses),
        lag_s=_rounded(one.lag_s for one in responses),
        gain=_rounded(one.gain for one in responses),
        wind_std_mps2=_rounded(one.wind_std_mps2 for one in responses),
    )
    estimator = msgspec.structs.replace(
        config.estimator, position_std_m=round(max(one.position_std_m for one in responses), 6)
    )
    # Slower cameras than two positions a step are counted on for one, which is what 0 says.
    rate_hz = math.floor(link.rate_hz) if link.rate_hz * config.plant.dt_s >= 2.0 else 0.0
    source = msgspec.structs.replace(config.source, rate_hz=float(rate_hz))
    return msgspec.structs.replace(
        config,
        name=f"{config.name}-identified",
        plant=plant,
        estimator=estimator,
        source=source,
        link=msgspec.structs.replace(config.link, **_link_section(link)),
    )


def _plant_section(config: Config) -> dict[str, object]:
    plant = config.plant
    return {key: getattr(plant, key) for key in ("model", "dt_s", "axes", "drag_1ps", "lag_s", "gain", "wind_std_mps2")}


def _link_section(link: LinkFit) -> dict[str, object]:
    """Keys of `[link]`: independent losses where they may be, else runs as measured."""
    times: dict[str, object] = {"delay_s": link.delay_s, "jitter_s": link.jitter_s}
    if not link.bursts:
        return {"model": "bernoulli", "loss": round(link.loss, _DIGITS), **times}
    return {"model": "empirical", "loss": 0.0, "gaps": link.runs, **times}


def _rounded(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(round(value, _DIGITS) for value in values)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
