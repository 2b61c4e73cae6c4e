"""Result of an identification: the plant, the link (rate, losses, delays), and the configuration with both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from logs.report.statistics import replace_infinite
from uavctl.arrays import Flags
from uavctl.config import Config
from uavctl.config.link import MAX_LOSS_RUN
from uavctl.errors import RecordingError
from uavctl.flight.link_estimate import compute_loss_std
from uavctl.lab.identify.fit import (
    AHEAD_S,
    MAX_TRIES,
    AxisFit,
    ChosenPlant,
    Prediction,
    choose_dead_time,
    compute_standard_errors,
    is_worse,
    predict,
)
from uavctl.lab.identify.gusts import fit_gusts
from uavctl.lab.identify.history import FlightHistory, PositionHistory, Stretch, find_stretches, thin_positions
from uavctl.lab.identify.response import (
    DRAG_LAG,
    VELOCITY_REFERENCE,
    AxisModel,
    DragLagAxis,
    ReferenceAxis,
    ramp_setpoints,
)
from uavctl.lab.identify.spread import Spread, describe_wide_spreads, make_spreads
from uavctl.smpc.plant import AXES

_QUANTILES = (0.0, 0.05, 0.5, 0.95, 0.99)
_BURST_STDS = 3.0  # standard deviations of the number of runs, below which losses come in bursts
_TIME_DIGITS = 4
# A run of losses is an outage, and no loss of the link, if it lasts a second and the distribution of the other runs
# makes such a run in less than one of a thousand flights.
_OUTAGE_S, _OUTAGE_CHANCE, _MIN_RUNS = 1.0, 1e-3, 8


@dataclass(frozen=True)
class LinkFit:
    """Losses and delays of positions."""

    rate_hz: float  # positions sent a second: received ones, and their share of the lost messages
    received: int  # received messages of the positions' sender
    lost: int  # lost messages between the first and the last, also in outages
    loss: float  # share of lost messages, without outages
    loss_std: float  # its standard error, larger for losses in bursts
    outages_s: tuple[float, ...]  # lengths of outages [s]
    runs: tuple[float, ...]  # share of the runs of 0, 1, ... losses after a received message
    burst_statistic: float  # runs missing from those of independent losses [standard deviations]
    bursts: bool  # whether losses come in bursts
    delay_s: float  # shortest delay [s]
    jitter_s: float  # from there to the delay that 99 % of positions keep [s]
    delay_quantiles_s: tuple[float, ...]  # at 0, 5, 50, 95 and 99 % [s]


def fit_link(positions: PositionHistory, missing: NDArray[np.int64]) -> LinkFit:
    """Fit the link by the messages' numbers, capture stamps and arrival times.

    Args:
        missing: Number of lost messages after each received one.
    """
    lost, received_count = int(missing.sum()), len(missing) + 1
    length_s = float(positions.times_s[-1] - positions.times_s[0])
    rate_hz = (len(positions.times_s) - 1) / length_s / (1.0 - lost / (lost + received_count))
    is_outage = _find_outages(missing, rate_hz)
    usual_losses = missing[~is_outage]
    loss = int(usual_losses.sum()) / (int(usual_losses.sum()) + received_count)
    statistic = _compute_burst_statistic(usual_losses)
    quantiles = tuple(round(float(q), _TIME_DIGITS) for q in np.quantile(positions.delays_s, _QUANTILES))
    counts = np.bincount(np.minimum(usual_losses, MAX_LOSS_RUN), minlength=1)
    return LinkFit(
        rate_hz=rate_hz,
        received=received_count,
        lost=lost,
        loss=loss,
        loss_std=compute_loss_std(usual_losses),
        outages_s=tuple(round(float(n) / rate_hz, _TIME_DIGITS) for n in missing[is_outage]),
        runs=tuple((counts / max(int(counts.sum()), 1)).tolist()),
        burst_statistic=statistic,
        bursts=statistic > _BURST_STDS,
        delay_s=max(0.0, quantiles[0]),
        jitter_s=round(max(0.0, quantiles[-1] - max(0.0, quantiles[0])), _TIME_DIGITS),
        delay_quantiles_s=quantiles,
    )


def describe_loss(link: LinkFit) -> str:
    """Describe the loss with its uncertainty, and the outages."""
    text = f"{link.loss:.1%} ± {link.loss_std:.1%}, {'in bursts' if link.bursts else 'each by itself'}"
    if not link.outages_s:
        return text
    outages = ", ".join(f"{length_s:.1f} s" for length_s in link.outages_s)
    return f"{text}; outages: {outages}"


def _find_outages(missing: NDArray[np.int64], rate_hz: float) -> Flags:
    """Return which runs of losses are longer than a geometric distribution of the others explains."""
    is_outage = np.zeros(len(missing), dtype=np.bool_)
    for index in np.argsort(missing)[::-1].tolist():
        other_runs = missing[(missing > 0) & ~is_outage]
        if len(other_runs) <= _MIN_RUNS or missing[index] < _OUTAGE_S * rate_hz:
            break
        mean = (float(other_runs.sum() - missing[index]) + 1.0) / (len(other_runs) - 1)
        if len(other_runs) * (1.0 - 1.0 / mean) ** float(missing[index] - 1) > _OUTAGE_CHANCE:
            break
        is_outage[index] = True
    return is_outage


def _compute_burst_statistic(missing: NDArray[np.int64]) -> float:
    """Return the runs test of Wald and Wolfowitz on arrivals and losses; positive if there are too few runs."""
    lost, received_count = float(missing.sum()), float(len(missing))
    if lost < 2 or received_count < 2:
        return 0.0
    total = lost + received_count
    runs = 2.0 * np.count_nonzero(missing)
    mean = 2.0 * lost * received_count / total + 1.0
    variance = (mean - 1.0) * (mean - 2.0) / (total - 1.0)
    return float((mean - runs) / np.sqrt(variance))


_MIN_INPUT_STD = 0.02  # m/s²; below it, an axis does not show its response
_DIGITS = 4
_DEFAULT_JERK_MPS3 = 5.0
_DEFAULT_GAINS = {"XY": (1.0, 2.0, 1.0), "Z": (1.0, 5.0, 1.0)}  # position, velocity, integral
_MODEL_KEYS = (
    *("a", "b", "e", "w", "position_index", "velocity_index", "accel_per_input"),
    *("gain", "position_1ps", "velocity_1ps", "integral_1ps2", "input_std_mps2", "force_drift_mps2_rts"),
    *("gust_mps2", "gust_s"),
)
_NO_GUST_S = 1.0  # time constant that is written for an axis without a gust


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


class Gust(msgspec.Struct, frozen=True, kw_only=True):
    """Gust of one axis, as far as the flight shows its colour."""

    axis: str
    gust_mps2: float  # 0 where the flight shows no colour
    gust_s: float | None  # None there
    fall: float  # of the deviance by a gust; by chance it is above 18.5 in one of a thousand flights


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
    spreads: tuple[Spread, ...]  # of each axis and time ahead
    link: dict[str, object]
    warnings: tuple[str, ...]
    gusts: tuple[Gust, ...] = ()  # of each axis, with plant `drag-lag`


@dataclass(frozen=True, eq=False)
class Identification:
    """Result of an identification, the configuration with it, and the data that it is from."""

    result: Identified
    config: Config  # the configuration with it
    link: LinkFit
    predictions: tuple[Prediction, ...]  # of each axis, for plots
    # The flight as it was fitted to: positions thinned, setpoints ramped as the autopilot does
    flown: tuple[Stretch, ...]
    fits: tuple[AxisFit, ...]  # the chosen plant of each axis


def describe_gust(gust: Gust) -> str:
    """Describe the gust of an axis, or that the flight shows none."""
    if gust.gust_s is None:
        return f"{gust.axis} shows no colour"
    return f"{gust.axis} {gust.gust_mps2:.2g} m/s² for {gust.gust_s:.2g} s"


def count_fits(history: FlightHistory, config: Config) -> int:
    """Return how often `identify` calls `on_fit`."""
    return MAX_TRIES * len(get_candidate_models(history, config))


def identify(
    history: FlightHistory, config: Config, on_fit: Callable[[], None], *, finds_gusts: bool = True
) -> Identification:
    """Identify plant and link of a flight.

    Args:
        config: Configuration that the result goes into; its kind of plant, axes and Δt are kept.
        on_fit: Called after each fit, `count_fits` times.
        finds_gusts: Whether a colour of the gusts is looked for, where the configuration's scheme takes gusts.

    Raises:
        RecordingError: The flight does not show enough.
    """
    dt_s = config.plant.dt_s
    flown = make_fitted_stretches(history, config)
    axes = [AXES.index(name) for name in config.plant.axes]
    for axis in axes:
        _check_moved(flown, axis)
    models = get_candidate_models(history, config)
    candidates = [choose_dead_time(flown, axes, axis_models, on_fit) for axis_models in models]
    chosen: ChosenPlant = candidates[0]
    gusts: tuple[Gust, ...] = ()
    if finds_gusts and chosen.name == DRAG_LAG and config.is_age_conditioned:
        chosen, gusts = _add_gusts(config, flown, axes, chosen)
    predictions = [predict(flown, axis, fit) for axis, fit in zip(axes, chosen.fits, strict=True)]
    responses = tuple(
        _make_response(name, flown, fit, prediction, dt_s)
        for name, fit, prediction in zip(config.plant.axes, chosen.fits, predictions, strict=True)
    )
    link = fit_link(history.positions, history.losses)
    ramp_s = compute_ramp_delay_s(history, config)
    identified_config = _make_config(config, chosen, ramp_s, responses, link, gusts)
    if history.latency_s is not None:
        identified_config = msgspec.structs.replace(
            identified_config,
            clock=msgspec.structs.replace(identified_config.clock, latency_s=round(history.latency_s, _DIGITS)),
        )
    flown_s = sum(stretch.length_s for stretch in flown)
    spreads = make_spreads(flown, axes, identified_config, config, ramp_s)
    drift_key = "estimator.bias_drift" if chosen.name == DRAG_LAG else "plant.force_drift_mps2_rts"
    result = Identified(
        flown_s=flown_s,
        positions=link.received,
        plant=_make_plant_section(identified_config),
        candidates=tuple(_make_candidate(response) for response in candidates),
        ramp_s=ramp_s,
        response=responses,
        residual_std=tuple(response.residual_std_m for response in responses),
        r2=tuple(response.r2 for response in responses),
        spreads=spreads,
        link=make_link_section(link),
        warnings=(
            *_describe_uncertain_axes(responses),
            *_describe_better_plants(chosen, candidates[1:]),
            *describe_wide_spreads(spreads, flown_s, drift_key),
        ),
        gusts=gusts,
    )
    return Identification(result, identified_config, link, tuple(predictions), flown, chosen.fits)


def _add_gusts(
    config: Config, flown: Sequence[Stretch], axes: Sequence[int], chosen: ChosenPlant
) -> tuple[ChosenPlant, tuple[Gust, ...]]:
    """Return the plant with a gust in each axis where the flight shows one, and the gusts of all axes."""
    found = fit_gusts(flown, axes, chosen.fits, config.plant.dt_s)
    fits = tuple(gust.fit if gust.is_shown else plain for gust, plain in zip(found, chosen.fits, strict=True))
    gusts = tuple(
        Gust(
            axis=name,
            gust_mps2=round(gust.fit.value("gust_mps2"), _DIGITS) if gust.is_shown else 0.0,
            gust_s=round(gust.fit.value("gust_s"), _DIGITS) if gust.is_shown else None,
            fall=gust.fall,
        )
        for name, gust in zip(config.plant.axes, found, strict=True)
    )
    return replace(chosen, fits=fits), gusts


def make_fitted_stretches(history: FlightHistory, config: Config) -> tuple[Stretch, ...]:
    """Return a flight as a plant is fitted to it: one position a step at most, setpoints ramped as the autopilot does.

    Raises:
        RecordingError: No stretch is long enough.
    """
    spacing_s, limits_mps3 = config.plant.dt_s * (1.0 - 1e-6), _get_jerk_limits(history, config)
    return tuple(
        ramp_setpoints(thin_positions(stretch, spacing_s), *limits_mps3)
        for stretch in find_stretches(history.setpoints, history.positions)
    )


def get_candidate_models(history: FlightHistory, config: Config) -> list[tuple[AxisModel, ...]]:
    """Return the plants to fit to each axis, the configuration's own first."""
    plant = config.plant
    is_reference = plant.model == VELOCITY_REFERENCE
    drifts = is_reference or config.estimator.bias_drift > 0.0
    models: list[tuple[AxisModel, ...]] = [tuple(DragLagAxis(drifts) for _ in plant.axes)]
    if is_reference or history.autopilot == "ardupilot":
        models.append(tuple(ReferenceAxis(*gains) for gains in _get_loop_gains(history, config)))
    return models[::-1] if is_reference else models


def _get_loop_gains(history: FlightHistory, config: Config) -> list[tuple[float, float, float]]:
    """Return the loop gains of each axis: as reported by the vehicle, else as configured, else ArduPilot's defaults.

    The plant has no loop without an integral. PSC_VELZ_I is 0 by default, and the acceleration loop integrates instead.
    """
    plant, gains = config.plant, []
    for row, name in enumerate(config.plant.axes):
        suffix = "Z" if name == "down" else "XY"
        configured = (plant.position_1ps, plant.velocity_1ps, plant.integral_1ps2)
        defaults = (
            [values[row] for values in configured] if plant.model == VELOCITY_REFERENCE else _DEFAULT_GAINS[suffix]
        )
        reported = (
            history.parameters.get(key.format(suffix), 0.0) for key in ("PSC_POS{}_P", "PSC_VEL{}_P", "PSC_VEL{}_I")
        )
        kp, kv, ki = (value if value > 0.0 else default for value, default in zip(reported, defaults, strict=True))
        gains.append((kp, kv, ki))
    return gains


def _get_jerk_limits(history: FlightHistory, config: Config) -> tuple[float, float]:
    """Return the horizontal and vertical jerk limits of an autopilot's ramps [m/s³]: as reported, else its defaults."""
    if history.autopilot != "ardupilot" and config.plant.model != VELOCITY_REFERENCE:
        return math.inf, math.inf
    reported = (history.parameters.get(f"PSC_JERK_{suffix}", 0.0) for suffix in ("XY", "Z"))
    level, down = (value if value > 0.0 else _DEFAULT_JERK_MPS3 for value in reported)
    return level, down


def compute_ramp_delay_s(history: FlightHistory, config: Config) -> float:
    """Return the mean delay of the ramp to each of the configuration's setpoints [s], which its plant lacks.

    It is that of a level setpoint with the largest allowed change; it ends with the next setpoint at the latest.
    """
    level_mps3, _ = _get_jerk_limits(history, config)
    return 0.5 * config.daemon.tick_s * min(config.limits.slew_mps3 / level_mps3, 1.0)


def _make_candidate(chosen: ChosenPlant) -> Candidate:
    return Candidate(
        model=chosen.name,
        dead_time_s=chosen.dead_time_s,
        dead_time_range_s=chosen.range_s,
        lag_s=tuple(fit.value("lag_s") for fit in chosen.fits),
        error_m=chosen.held_out.error_m,
        ahead_s=AHEAD_S,
        rms_m=tuple(tuple(row) for row in chosen.held_out.rms_m.tolist()),
        curve=chosen.curve,
    )


def _describe_better_plants(chosen: ChosenPlant, candidates: Sequence[ChosenPlant]) -> list[str]:
    return [
        f'plant.model "{candidate.name}" predicts better: error {1e3 * candidate.held_out.error_m:.1f} mm instead of '
        f"{1e3 * chosen.held_out.error_m:.1f} mm; start from a configuration that has it"
        for candidate in candidates
        if is_worse(chosen.held_out, candidate.held_out)
    ]


def _check_moved(flown: Sequence[Stretch], axis: int) -> None:
    inputs = [float(stretch.inputs_mps2[:, axis].std()) for stretch in flown]
    if max(inputs) < _MIN_INPUT_STD:
        raise RecordingError(
            f"setpoints hardly changed in {AXES[axis]} (standard deviation {max(inputs):.2g} m/s²): the flight does "
            "not show how the vehicle answers there; fly waypoints that differ in every axis"
        )


def _make_response(
    name: str, flown: Sequence[Stretch], fit: AxisFit, prediction: Prediction, dt_s: float
) -> AxisResponse:
    errors = compute_standard_errors(flown, AXES.index(name), fit)
    is_reference = isinstance(fit.model, ReferenceAxis)
    return AxisResponse(
        axis=name,
        lag_s=fit.value("lag_s"),
        drag_1ps=max(fit.value("drag_1ps"), 0.0),
        gain=None if is_reference else fit.value("gain"),
        wind_std_mps2=fit.value("wind_mps2_rts") / math.sqrt(dt_s),
        input_std_mps2=fit.value("input_mps2_rts") / math.sqrt(dt_s) if is_reference else None,
        force_drift_mps2_rts=fit.value("drift_mps2_rts") if is_reference or _is_drifting(fit.model) else None,
        position_std_m=fit.value("noise_m"),
        lag_std_s=replace_infinite(errors["lag_s"]),
        drag_std_1ps=replace_infinite(errors["drag_1ps"]),
        gain_std=replace_infinite(errors.get("gain", math.inf)),
        residual_std_m=prediction.residual_std_m,
        r2=prediction.r2,
    )


def _is_drifting(model: AxisModel) -> bool:
    return isinstance(model, DragLagAxis) and model.drifts


def _describe_uncertain_axes(responses: Sequence[AxisResponse]) -> list[str]:
    texts = []
    for response in responses:
        if response.r2 < 0.5:
            texts.append(
                f"{response.axis}: only {100 * response.r2:.0f} % of the motion of the next second is predicted"
            )
        if response.lag_std_s is None or response.lag_std_s > 0.5 * response.lag_s:
            texts.append(
                f"{response.axis}: the lag of {response.lag_s:.2f} s is uncertain; fly more changes of direction"
            )
    return texts


def _make_config(
    config: Config,
    chosen: ChosenPlant,
    ramp_s: float,
    responses: Sequence[AxisResponse],
    link: LinkFit,
    gusts: Sequence[Gust],
) -> Config:
    """Return the configuration with the identified plant and link."""
    plant = msgspec.structs.replace(
        config.plant,
        model=chosen.name,
        dead_time_s=round(chosen.dead_time_s + ramp_s, _DIGITS),
        drag_1ps=_round_values(response.drag_1ps for response in responses),
        lag_s=_round_values(response.lag_s for response in responses),
        wind_std_mps2=_round_values(response.wind_std_mps2 for response in responses),
        **{**dict.fromkeys(_MODEL_KEYS, ()), **_get_model_values(chosen, responses), **_get_gust_values(gusts)},
    )
    estimator = msgspec.structs.replace(
        config.estimator,
        position_std_m=round(max(response.position_std_m for response in responses), 6),
        bias_drift=_find_bias_drift(config, chosen, responses),
    )
    # The design uses more than one position a step only if two come in a step, and one in the rest of it after the
    # delay. Else the rate is 0: one position a step.
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
        link=msgspec.structs.replace(config.link, **make_link_section(link)),
    )


def _find_bias_drift(config: Config, chosen: ChosenPlant, responses: Sequence[AxisResponse]) -> float:
    """Return the drift of the inputs' biases: the largest fitted one, and at least the configured one.

    The fitted wind is what remains beside the drift, so the two belong together. A lower drift would thin the back-offs
    by one calm flight, and slow the filter.
    """
    configured = config.estimator.bias_drift
    if chosen.name != DRAG_LAG or not configured:
        return configured
    fitted = (
        (response.force_drift_mps2_rts or 0.0) / gain for response in responses if (gain := response.gain) is not None
    )
    return max(configured, *(round(drift, _DIGITS) for drift in fitted))


def _get_model_values(chosen: ChosenPlant, responses: Sequence[AxisResponse]) -> dict[str, tuple[float, ...]]:
    """Return the keys of `[plant]` that only one model has."""
    if chosen.name == DRAG_LAG:
        return {"gain": _round_values(response.gain or 0.0 for response in responses)}
    models = [fit.model for fit in chosen.fits if isinstance(fit.model, ReferenceAxis)]
    return {
        **{
            key: tuple(getattr(model, key) for model in models)
            for key in ("position_1ps", "velocity_1ps", "integral_1ps2")
        },
        "input_std_mps2": _round_values(response.input_std_mps2 or 0.0 for response in responses),
        "force_drift_mps2_rts": _round_values(response.force_drift_mps2_rts or 0.0 for response in responses),
    }


def _get_gust_values(gusts: Sequence[Gust]) -> dict[str, tuple[float, ...]]:
    """Return the keys of `[plant]` for gusts; none where no axis shows one."""
    if not any(gust.gust_mps2 for gust in gusts):
        return {}
    return {
        "gust_mps2": tuple(gust.gust_mps2 for gust in gusts),
        "gust_s": tuple(gust.gust_s or _NO_GUST_S for gust in gusts),
    }


def _make_plant_section(config: Config) -> dict[str, object]:
    keys = ("model", "dt_s", "axes", "dead_time_s", "drag_1ps", "lag_s", "wind_std_mps2", *_MODEL_KEYS)
    return {key: value for key in keys if (value := getattr(config.plant, key)) != ()}


def make_link_section(link: LinkFit) -> dict[str, object]:
    """Return the keys of `[link]`: independent losses if the data allow that, else runs as measured."""
    times: dict[str, object] = {"delay_s": link.delay_s, "jitter_s": link.jitter_s}
    if not link.bursts:
        return {"model": "bernoulli", "loss": round(link.loss, _DIGITS), **times}
    return {"model": "empirical", "loss": 0.0, "gaps": link.runs, **times}


def _round_values(values: Iterable[float]) -> tuple[float, ...]:
    return tuple(round(value, _DIGITS) for value in values)
