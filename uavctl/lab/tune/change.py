"""Changes of a configuration by an identified flight: only the well-determined values.

1. An axis is adopted as a whole (lag, drag, gain) if the flight determines all of it, else kept as a whole. The dead
   time is common to all axes, so the lag of a kept axis changes by as much the other way: dead time + lag stays.
2. Noises, loss and delay are raised where the flight was worse than the configuration assumes, and never lowered: a
   calm minute does not predict the next day's air or radio.
3. Inputs may be quicker, down to the weight of the presets that know their autopilot, where the model predicts well.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from uavctl.config import Config
from uavctl.config.link import LinkConfig
from uavctl.errors import UsageError
from uavctl.lab.identify.response import DRAG_LAG, VELOCITY_REFERENCE
from uavctl.lab.identify.result import AxisResponse, Identification, LinkFit

MIN_R2 = 0.5  # of the motion of the next second
MAX_LAG_STD = 0.5  # of the lag itself
MAX_DRAG_STD_1PS = 0.1
MAX_GAIN_STD = 0.1
GAIN_RANGE = (0.5, 2.0)  # beyond it, limits or a hover thrust interfere, and no gain is determined
MIN_LAG_S = 0.011  # a little above the bound of the fit
CONFIDENCE_STDS = 2.0  # standard errors
QUICK_RATIO = 0.03  # input's weight over the position's, as in the presets that know their autopilot
QUICK_AHEAD_S, QUICK_ERROR_M = 0.5, 0.015  # a model that predicts so well permits quicker inputs
DELAY_TOLERANCE_S = 0.005  # positions may arrive later than assumed by this without a change
STALL_S = 0.3  # a longer delay is no radio delay but a halt of a computer, and no design should cover it
_DIGITS = 4


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """Old and new value of a key of the configuration, and the reason."""

    key: str
    old: float | str | tuple[float, ...]
    new: float | str | tuple[float, ...]
    reason: str


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


def tune_config(config: Config, identification: Identification) -> tuple[Config, tuple[Change, ...]]:
    """Return the configuration with the values that a flight shows well, and the changes with their reasons."""
    objections = [find_objection(response) for response in identification.result.response]
    tuned = msgspec.structs.replace(
        config,
        name=f"{config.name.removesuffix('-tuned')}-tuned",
        plant=msgspec.structs.replace(config.plant, **_tune_plant(config, identification, objections)),
        estimator=msgspec.structs.replace(
            config.estimator,
            position_std_m=max(config.estimator.position_std_m, identification.config.estimator.position_std_m),
            bias_drift=identification.config.estimator.bias_drift,  # at least the configured one
        ),
        link=_tune_link(config.link, identification.link),
        cost=msgspec.structs.replace(config.cost, input=_tune_inputs(config, identification)),
    )
    return tuned, tuple(_list_changes(config, tuned, objections))


def find_objection(response: AxisResponse) -> str:
    """Return why an axis is not adopted; empty if it is."""
    lag_std, drag_std, gain_std = response.lag_std_s, response.drag_std_1ps, response.gain_std
    if response.r2 < MIN_R2:
        return f"{response.axis}: only {100.0 * response.r2:.0f} % of the motion of the next second is predicted"
    if response.lag_s < MIN_LAG_S:
        return f"{response.axis}: the lag is shorter than a flight can show"
    if lag_std is None or lag_std > MAX_LAG_STD * response.lag_s:
        return f"{response.axis}: the lag is uncertain"
    if drag_std is None or drag_std > MAX_DRAG_STD_1PS:
        return f"{response.axis}: the drag is uncertain"
    if response.gain is not None and (gain_std is None or gain_std > MAX_GAIN_STD):
        return f"{response.axis}: the gain is uncertain"
    if response.gain is not None and not GAIN_RANGE[0] <= response.gain <= GAIN_RANGE[1]:
        return f"{response.axis}: a gain of {response.gain:.2g} means a limit of the vehicle, or its hover thrust"
    return ""


def _tune_plant(config: Config, identification: Identification, objections: list[str]) -> dict[str, object]:
    """Return the new values of `[plant]`."""
    old, flight, rows = config.plant, identification.config.plant, range(len(config.plant.axes))
    wind = tuple(map(max, old.wind_std_mps2, flight.wind_std_mps2))
    if all(objections):
        return {"wind_std_mps2": wind}
    later_s = flight.dead_time_s - old.dead_time_s
    values: dict[str, object] = {
        "dead_time_s": flight.dead_time_s,
        # lag = lag_old - (dead_time - dead_time_old) for a kept axis
        "lag_s": tuple(
            max(MIN_LAG_S, round(old.lag_s[row] - later_s, _DIGITS)) if objections[row] else flight.lag_s[row]
            for row in rows
        ),
        "drag_1ps": tuple((old if objections[row] else flight).drag_1ps[row] for row in rows),
        "wind_std_mps2": wind,
    }
    if old.model == DRAG_LAG:
        gains = old.gain or (1.0,) * len(old.axes)
        values["gain"] = tuple(gains[row] if objections[row] else flight.gain[row] for row in rows)
    return values


def _tune_link(old: LinkConfig, link: LinkFit) -> LinkConfig:
    """Return `[link]` with losses and delays raised; losses in bursts are adopted as measured."""
    tuned, margin = old, CONFIDENCE_STDS * link.loss_std
    latest_s = link.delay_s + link.jitter_s
    if old.model != "trace" and old.delay_s + old.jitter_s + DELAY_TOLERANCE_S < latest_s <= STALL_S:
        tuned = msgspec.structs.replace(tuned, jitter_s=round(latest_s - old.delay_s, _DIGITS))
    if old.model != "bernoulli" or old.probability:
        return tuned
    if link.bursts and link.loss >= old.loss - margin:
        return msgspec.structs.replace(tuned, model="empirical", loss=0.0, gaps=link.runs)
    if link.loss - margin > old.loss:
        return msgspec.structs.replace(tuned, loss=round(link.loss, _DIGITS))
    return tuned


def _tune_inputs(config: Config, identification: Identification) -> tuple[float, ...]:
    """Return the weights of the inputs, lower where the model predicts the motion well enough."""
    candidate, size = identification.result.candidates[0], config.plant.states_per_axis
    column = candidate.ahead_s.index(QUICK_AHEAD_S)
    return tuple(
        min(old, round(QUICK_RATIO * config.cost.state[size * row], _DIGITS))
        if candidate.rms_m[row][column] <= QUICK_ERROR_M
        else old
        for row, old in enumerate(config.cost.input)
    )


def _list_changes(config: Config, tuned: Config, objections: list[str]) -> Iterator[Change]:
    kept = "; ".join(f"kept {objection}" for objection in objections if objection)
    response = f"as the flight shows{f' ({kept})' if kept else ''}"
    worse = "the flight was worse than configured"
    quick = f"the model predicts {QUICK_AHEAD_S:g} s to {1e3 * QUICK_ERROR_M:g} mm: inputs may be quicker"
    for section, key, reason in (
        ("plant", "dead_time_s", response),
        ("plant", "lag_s", response),
        ("plant", "drag_1ps", response),
        ("plant", "gain", response),
        ("plant", "wind_std_mps2", worse),
        ("estimator", "position_std_m", worse),
        ("estimator", "bias_drift", worse),
        ("link", "model", "losses come in bursts"),
        ("link", "loss", worse),
        ("link", "jitter_s", worse),
        ("cost", "input", quick),
    ):
        old, new = getattr(getattr(config, section), key), getattr(getattr(tuned, section), key)
        if old != new:
            yield Change(key=f"{section}.{key}", old=old, new=new, reason=reason)
