"""Result of an identification: the plant, the link (rate, losses, delays), and the configuration with both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from logs.report.statistics import replace_infinite
from uavctl.config import Config
from uavctl.config.link import MAX_LOSS_RUN
from uavctl.errors import RecordingError
from uavctl.flight.link_estimate import compute_loss_std
from uavctl.lab.identify.fit import (
    AHEAD_S,
    TRIES,
    AxisFit,
    ChosenPlant,
    Prediction,
    choose_dead_time,
    is_worse,
    predict,
    standard_errors,
)
from uavctl.lab.identify.history import FlightHistory, PositionHistory, Stretch, stretches, thinned
from uavctl.lab.identify.response import DRAG_LAG, VELOCITY_REFERENCE, AxisModel, DragLagAxis, ReferenceAxis, ramped
from uavctl.smpc.plant import AXES

_QUANTILES = (0.0, 0.05, 0.5, 0.95, 0.99)
_BURSTS = 3.0  # standard deviations of the number of runs, below which losses come in bursts
_ROUND = 4
# A run of losses is an outage, not the link's own, if it lasts a second and runs like the others make none in a
# thousand such flights.
_OUTAGE_S, _OUTAGE_CHANCE, _LEAST_RUNS = 1.0, 1e-3, 8


@dataclass(frozen=True)
class LinkFit:
    """Losses and delays of positions."""

    rate_hz: float  # positions sent a second: those that came, and their share of the lost messages
    received: int  # messages of the positions' sender that came
    lost: int  # messages between the first and the last that did not, in outages too
    loss: float  # share of messages that did not come, outages apart
    loss_std: float  # its standard error: losses that come in bursts tell less than as many that are each by themselves
    outages_s: tuple[float, ...]  # how long nothing came, where that was no burst of the link's [s]
    runs: tuple[float, ...]  # share of the runs of 0, 1, ... losses after a message that came.
    burst_statistic: float  # how many standard deviations fewer runs there are than independent losses would make
    bursts: bool  # whether losses come in bursts
    delay_s: float  # shortest delay [s]
    jitter_s: float  # from there to the delay that 99 % of positions keep [s]
    delay_quantiles_s: tuple[float, ...]  # at 0, 5, 50, 95 and 99 % [s]


def fit_link(seen: PositionHistory, missing: NDArray[np.int64]) -> LinkFit:
    """Fit the link by the messages' numbers, capture stamps and arrival times.

    Args:
        missing: Messages lost after each one that came.
    """
    lost, came = int(missing.sum()), len(missing) + 1
    length_s = float(seen.times_s[-1] - seen.times_s[0])
    rate_hz = (len(seen.times_s) - 1) / length_s / (1.0 - lost / (lost + came))
    outages = _outages(missing, rate_hz)
    usual = missing[~outages]
    loss = int(usual.sum()) / (int(usual.sum()) + came)
    statistic = _burst_statistic(usual)
    quantiles = tuple(round(float(q), _ROUND) for q in np.quantile(seen.delays_s, _QUANTILES))
    counts = np.bincount(np.minimum(usual, MAX_LOSS_RUN), minlength=1)
    return LinkFit(
        rate_hz=rate_hz,
        received=came,
        lost=lost,
        loss=loss,
        loss_std=compute_loss_std(usual),
        outages_s=tuple(round(float(n) / rate_hz, _ROUND) for n in missing[outages]),
        runs=tuple((counts / max(int(counts.sum()), 1)).tolist()),
        burst_statistic=statistic,
        bursts=statistic > _BURSTS,
        delay_s=max(0.0, quantiles[0]),
        jitter_s=round(max(0.0, quantiles[-1] - max(0.0, quantiles[0])), _ROUND),
        delay_quantiles_s=quantiles,
    )


def loss_words(link: LinkFit) -> str:
    """Return the loss in words, with its uncertainty and the outages beside it."""
    text = f"{link.loss:.1%} ± {link.loss_std:.1%}, {'in bursts' if link.bursts else 'each by itself'}"
    if not link.outages_s:
        return text
    outages = ", ".join(f"{length_s:.1f} s" for length_s in link.outages_s)
    return f"{text}; outages: {outages}"


def _outages(missing: NDArray[np.int64], rate_hz: float) -> NDArray[np.bool_]:
    """Return which runs of losses are longer than a geometric distribution of the others explains."""
    found = np.zeros(len(missing), dtype=np.bool_)
    for place in np.argsort(missing)[::-1].tolist():
        others = missing[(missing > 0) & ~found]
        if len(others) <= _LEAST_RUNS or missing[place] < _OUTAGE_S * rate_hz:
            break
        mean = (float(others.sum() - missing[place]) + 1.0) / (len(others) - 1)
        if len(others) * (1.0 - 1.0 / mean) ** float(missing[place] - 1) > _OUTAGE_CHANCE:
            break
        found[place] = True
    return found


def _burst_statistic(missing: NDArray[np.int64]) -> float:
    """Return the runs test of Wald and Wolfowitz on arrivals and losses; positive if there are too few runs."""
    lost, came = float(missing.sum()), float(len(missing))
    if lost < 2 or came < 2:
        return 0.0
    total = lost + came
    runs = 2.0 * np.count_nonzero(missing)
    mean = 2.0 * lost * came / total + 1.0
    variance = (mean - 1.0) * (mean - 2.0) / (total - 1.0)
    return float((mean - runs) / np.sqrt(variance))


_LEAST_INPUT_STD = 0.02  # m/s²; an axis that was hardly steered shows nothing of how it answers
_DIGITS = 4
_JERK_AS_SHIPPED_MPS3 = 5.0
_AS_SHIPPED = {"XY": (1.0, 2.0, 1.0), "Z": (1.0, 5.0, 1.0)}  # position, velocity, integral
_OF_OTHER_MODELS = (
    *("a", "b", "e", "w", "position_index", "velocity_index", "accel_per_input"),
    *("gain", "position_1ps", "velocity_1ps", "integral_1ps2", "input_std_mps2", "force_drift_mps2_rts"),
)


class AxisResponse(msgspec.Struct, frozen=True, kw_only=True):
    """Response of one axis, with the dead time common to all; None where the plant has no such number."""

    axis: str
    lag_s: float
    drag_1ps: float
    gain: float | None
    wind_std_mps2: float
    input_std_mps2: float | None
    force_drift_mps2_rts: float | None
    position_std_m: float
    lag_std_s: float | None
    drag_std_1ps: float | None
    gain_std: float | None
    residual_std_m: float
    r2: float


class Candidate(msgspec.Struct, frozen=True, kw_only=True):
    """One kind of plant with its prediction errors on the halves that it was not fitted to."""

    model: str
    dead_time_s: float
    dead_time_range_s: tuple[float, float]
    lag_s: tuple[float, ...]
    error_m: float
    ahead_s: tuple[float, ...]
    rms_m: tuple[tuple[float, ...], ...]  # each axis, each time ahead
    curve: tuple[tuple[float, float], ...]  # dead time [s], rise of the deviance


class Identified(msgspec.Struct, frozen=True, kw_only=True):
    """Result of `uavctl identify`; the fields are the keys of `--json`."""

    flown_s: float
    positions: int
    plant: dict[str, object]
    candidates: tuple[Candidate, ...]
    ramp_s: float  # by which the configured dead time is longer than the chosen candidate's
    response: tuple[AxisResponse, ...]
    residual_std: tuple[float, ...]
    r2: tuple[float, ...]
    link: dict[str, object]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Identification:
    """Result of an identification, the configuration with it, and the data that it is from."""

    result: Identified  # what is told
    config: Config  # the configuration with it
    link: LinkFit  # what the link did
    predictions: tuple[Prediction, ...]  # what the plots show, each axis
    # The flight as it was fitted to: positions thinned, setpoints ramped as the autopilot does
    flown: tuple[Stretch, ...]
    fits: tuple[AxisFit, ...]  # the chosen plant of each axis


def fits_of(history: FlightHistory, config: Config) -> int:
    """Return how often `identify` advances."""
    return TRIES * len(kinds_of(history, config))


def identify(history: FlightHistory, config: Config, advance: Callable[[], None]) -> Identification:
    """Identify plant and link of a flight.

    Args:
        config: Configuration that the result goes into; its kind of plant, axes and Δt are kept.
        advance: Called as often as `fits_of` says.

    Raises:
        RecordingError: The flight does not show enough.
    """
    dt_s = config.plant.dt_s
    flown = flown_stretches(history, config)
    axes = [AXES.index(name) for name in config.plant.axes]
    for axis in axes:
        _check_moved(flown, axis)
    kinds = kinds_of(history, config)
    candidates = [choose_dead_time(flown, axes, kind, advance) for kind in kinds]
    chosen = candidates[0]
    predictions = [predict(flown, axis, fit) for axis, fit in zip(axes, chosen.fits, strict=True)]
    responses = tuple(
        _response(name, flown, fit, prediction, dt_s)
        for name, fit, prediction in zip(config.plant.axes, chosen.fits, predictions, strict=True)
    )
    link = fit_link(history.seen, history.gaps)
    ramp_s = ramp_of(history, config)
    made = _config(config, chosen, ramp_s, responses, link)
    if history.latency_s is not None:
        made = msgspec.structs.replace(
            made, clock=msgspec.structs.replace(made.clock, latency_s=round(history.latency_s, _DIGITS))
        )
    result = Identified(
        flown_s=sum(stretch.length_s for stretch in flown),
        positions=link.received,
        plant=_plant_section(made),
        candidates=tuple(_candidate(one) for one in candidates),
        ramp_s=ramp_s,
        response=responses,
        residual_std=tuple(one.residual_std_m for one in responses),
        r2=tuple(one.r2 for one in responses),
        link=_link_section(link),
        warnings=(*_doubts(responses), *_better(chosen, candidates[1:])),
    )
    return Identification(result, made, link, tuple(predictions), flown, chosen.fits)


def flown_stretches(history: FlightHistory, config: Config) -> tuple[Stretch, ...]:
    """Return a flight as a plant is fitted to it: one position a step at most, setpoints ramped as the autopilot does.

    Raises:
        RecordingError: No stretch is long enough.
    """
    spacing_s, limits_mps3 = config.plant.dt_s * (1.0 - 1e-6), _jerk_limits(history, config)
    return tuple(
        ramped(thinned(stretch, spacing_s), *limits_mps3) for stretch in stretches(history.asked, history.seen)
    )


def kinds_of(history: FlightHistory, config: Config) -> list[tuple[AxisModel, ...]]:
    """Return the plants to fit to each axis, the configuration's own first."""
    plant = config.plant
    own = plant.model == VELOCITY_REFERENCE
    drifts = own or config.estimator.bias_drift > 0.0
    kinds: list[tuple[AxisModel, ...]] = [tuple(DragLagAxis(drifts) for _ in plant.axes)]
    if own or history.autopilot == "ardupilot":
        kinds.append(tuple(ReferenceAxis(*gains) for gains in _gains(history, config)))
    return kinds[::-1] if own else kinds


def _gains(history: FlightHistory, config: Config) -> list[tuple[float, float, float]]:
    """Return the loop gains of each axis: as the vehicle told them, else as configured, else ArduPilot's defaults.

    The plant has no loop without an integral (PSC_VELZ_I is 0 as shipped): there the acceleration loop's does its work.
    """
    plant, found = config.plant, []
    for place, name in enumerate(config.plant.axes):
        side = "Z" if name == "down" else "XY"
        own = (plant.position_1ps, plant.velocity_1ps, plant.integral_1ps2)
        given = [one[place] for one in own] if plant.model == VELOCITY_REFERENCE else _AS_SHIPPED[side]
        told = (history.parameters.get(key.format(side), 0.0) for key in ("PSC_POS{}_P", "PSC_VEL{}_P", "PSC_VEL{}_I"))
        kp, kv, ki = (value if value > 0.0 else other for value, other in zip(told, given, strict=True))
        found.append((kp, kv, ki))
    return found


def _jerk_limits(history: FlightHistory, config: Config) -> tuple[float, float]:
    """Return the horizontal and vertical jerk limits of an autopilot's ramps [m/s³]: as told, else its defaults."""
    if history.autopilot != "ardupilot" and config.plant.model != VELOCITY_REFERENCE:
        return math.inf, math.inf
    told = (history.parameters.get(f"PSC_JERK_{side}", 0.0) for side in ("XY", "Z"))
    level, down = (value if value > 0.0 else _JERK_AS_SHIPPED_MPS3 for value in told)
    return level, down


def ramp_of(history: FlightHistory, config: Config) -> float:
    """Return the mean delay of the ramp to each of the configuration's setpoints [s], which its plant lacks.

    That of a level setpoint that changes as much as it may; it ends with the next setpoint at the latest.
    """
    level_mps3, _ = _jerk_limits(history, config)
    return 0.5 * config.daemon.tick_s * min(config.limits.slew_mps3 / level_mps3, 1.0)


def _candidate(one: ChosenPlant) -> Candidate:
    return Candidate(
        model=one.name,
        dead_time_s=one.dead_time_s,
        dead_time_range_s=one.range_s,
        lag_s=tuple(fit.value("lag_s") for fit in one.fits),
        error_m=one.judged.error_m,
        ahead_s=AHEAD_S,
        rms_m=tuple(tuple(row) for row in one.judged.rms_m.tolist()),
        curve=one.curve,
    )


def _better(chosen: ChosenPlant, others: Sequence[ChosenPlant]) -> list[str]:
    return [
        f'plant.model "{other.name}" predicts better: error {1e3 * other.judged.error_m:.1f} mm instead of '
        f"{1e3 * chosen.judged.error_m:.1f} mm; start from a configuration that has it"
        for other in others
        if is_worse(chosen.judged, other.judged)
    ]


def _check_moved(flown: Sequence[Stretch], axis: int) -> None:
    inputs = [float(stretch.inputs_mps2[:, axis].std()) for stretch in flown]
    if max(inputs) < _LEAST_INPUT_STD:
        raise RecordingError(
            f"setpoints hardly changed in {AXES[axis]} (standard deviation {max(inputs):.2g} m/s²): the flight does "
            "not show how the vehicle answers there; fly waypoints that differ in every axis"
        )


def _response(name: str, flown: Sequence[Stretch], fit: AxisFit, prediction: Prediction, dt_s: float) -> AxisResponse:
    errors = standard_errors(flown, AXES.index(name), fit)
    reference = isinstance(fit.model, ReferenceAxis)
    return AxisResponse(
        axis=name,
        lag_s=fit.value("lag_s"),
        drag_1ps=max(fit.value("drag_1ps"), 0.0),
        gain=None if reference else fit.value("gain"),
        wind_std_mps2=fit.value("wind_mps2_rts") / math.sqrt(dt_s),
        input_std_mps2=fit.value("input_mps2_rts") / math.sqrt(dt_s) if reference else None,
        force_drift_mps2_rts=fit.value("drift_mps2_rts") if reference else None,
        position_std_m=fit.value("noise_m"),
        lag_std_s=replace_infinite(errors["lag_s"]),
        drag_std_1ps=replace_infinite(errors["drag_1ps"]),
        gain_std=replace_infinite(errors.get("gain", math.inf)),
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


def _config(
    config: Config, chosen: ChosenPlant, ramp_s: float, responses: Sequence[AxisResponse], link: LinkFit
) -> Config:
    """Return the configuration with what was identified."""
    plant = msgspec.structs.replace(
        config.plant,
        model=chosen.name,
        dead_time_s=round(chosen.dead_time_s + ramp_s, _DIGITS),
        drag_1ps=_rounded(one.drag_1ps for one in responses),
        lag_s=_rounded(one.lag_s for one in responses),
        wind_std_mps2=_rounded(one.wind_std_mps2 for one in responses),
        **{**dict.fromkeys(_OF_OTHER_MODELS, ()), **_of_model(chosen, responses)},
    )
    estimator = msgspec.structs.replace(
        config.estimator, position_std_m=round(max(one.position_std_m for one in responses), 6)
    )
    # Slower cameras than two positions a step, or than one in what the delay leaves of it, are counted on for one a
    # step, which is what 0 says.
    dt_s, rate_hz = config.plant.dt_s, float(math.floor(link.rate_hz))
    if rate_hz * dt_s < 2.0 or rate_hz * (dt_s - link.delay_s - link.jitter_s) < 1.0:
        rate_hz = 0.0
    source = msgspec.structs.replace(config.source, rate_hz=rate_hz)
    return msgspec.structs.replace(
        config,
        name=f"{config.name}-identified",
        plant=plant,
        estimator=estimator,
        source=source,
        link=msgspec.structs.replace(config.link, **_link_section(link)),
    )


def _of_model(chosen: ChosenPlant, responses: Sequence[AxisResponse]) -> dict[str, tuple[float, ...]]:
    """Return the keys of `[plant]` that only one kind of plant has."""
    if chosen.name == DRAG_LAG:
        return {"gain": _rounded(one.gain or 0.0 for one in responses)}
    models = [fit.model for fit in chosen.fits if isinstance(fit.model, ReferenceAxis)]
    return {
        **{
            key: tuple(getattr(model, key) for model in models)
            for key in ("position_1ps", "velocity_1ps", "integral_1ps2")
        },
        "input_std_mps2": _rounded(one.input_std_mps2 or 0.0 for one in responses),
        "force_drift_mps2_rts": _rounded(one.force_drift_mps2_rts or 0.0 for one in responses),
    }


def _plant_section(config: Config) -> dict[str, object]:
    keys = ("model", "dt_s", "axes", "dead_time_s", "drag_1ps", "lag_s", "wind_std_mps2", *_OF_OTHER_MODELS)
    return {key: value for key in keys if (value := getattr(config.plant, key)) != ()}


def _link_section(link: LinkFit) -> dict[str, object]:
    """Return the keys of `[link]`: independent losses if the data allow that, else runs as measured."""
    times: dict[str, object] = {"delay_s": link.delay_s, "jitter_s": link.jitter_s}
    if not link.bursts:
        return {"model": "bernoulli", "loss": round(link.loss, _DIGITS), **times}
    return {"model": "empirical", "loss": 0.0, "gaps": link.runs, **times}


def _rounded(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(round(value, _DIGITS) for value in values)
