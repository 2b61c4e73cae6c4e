"""Items of the positions themselves: do they come as the design counts on, and do they make sense."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from uavctl.check.findings import Heard, Item, ItemState, Sample, item, judged
from uavctl.config.checks import position_limits_m
from uavctl.config.connections import camera_scheme
from uavctl.config.types import Config
from uavctl.flight.link_estimate import compute_loss_std
from uavctl.records import Vec3
from uavctl.smpc.plant import AXES

_ENOUGH = 8  # samples without which nothing is said
_AGE_TOLERANCE_S = 0.005
_RATE_PART = 0.95  # of the rate that is wanted
_REGULAR, _MOSTLY = 0.15, 0.8  # of a period off a whole number of them; part of the steps that has to be so
_NOISE_FACTOR = 2.0
_STUCK_SAMPLES = 20
_UNITS = ((1000.0, "millimetres"), (100.0, "centimetres"))
# A camera system that is listened to without a bridge has its own settings for axes, and its unit is known.
CAMERA_AXES = (
    "does Motive stream Z up? Then the URL of daemon.mocap needs ?up=z, else not; see [frame] (origin_m, yaw_deg)"
)
Array = NDArray[np.float64]


def position_items(seen: Heard, config: Config, at_ns: int) -> list[Item]:
    """Items of rate, gaps, age, loss, noise and place of the positions heard up to `at_ns`."""
    if not seen.samples:
        return [_nothing(seen, config)]
    captured_s = sorted(one.captured_ns * 1e-9 for one in seen.samples)
    period_s = _period_s(captured_s)
    items = [_rate(seen.samples, period_s, config), _gaps(seen, config, at_ns), _age(seen, config)]
    items.append(_loss(captured_s, config))
    items += [_noise(seen.samples, config), _place(seen.samples, config), _stuck(seen)]
    units = sorted({unit for stats in seen.stats.values() for unit in stats.stamp_units})
    return [*items, _units(units)] if units else items


def _units(units: list[str]) -> Item:
    value = ", ".join("they do not go on" if unit == "constant" else f"in {unit}" for unit in units)
    hint = "set the source to stamp in microseconds; until then ages count from the arrival, less clock.latency_s"
    return item("position stamps", ItemState.NOTE, value, "in us, of the capture", hint)


def _nothing(seen: Heard, config: Config) -> Item:
    bad = {reason: n for stats in seen.stats.values() for reason, n in stats.bad.items()}
    told = ", ".join(f"{count} {reason}" for reason, count in sorted(bad.items())) or "nothing came"
    names = ", ".join(config.source.messages)
    hint = f"is the source running, and does it send {names} to {config.daemon.mocap}? See source.messages"
    if seen.own and config.daemon.mocap == config.daemon.vehicle:
        hint += (
            "; to fly on the vehicle's own estimate, which is heard: --set 'source.messages=[\"LOCAL_POSITION_NED\"]'"
        )
    if from_cameras(config):
        hint = f"does Motive track the body of {config.daemon.mocap}, and stream rigid bodies? See docs/sources.md"
    return item("positions", ItemState.BAD, f"none ({told})", "positions of the source", hint)


def from_cameras(config: Config) -> bool:
    """Whether a camera system is listened to directly."""
    return bool(camera_scheme(config.daemon.mocap))


def _period_s(captured_s: list[float]) -> float | None:
    """Time between two captures, if they keep one: the lower quartile of the steps, as losses make longer ones."""
    steps = sorted(b - a for a, b in pairwise(captured_s) if b > a)
    if len(steps) < _ENOUGH:
        return None
    period_s = steps[len(steps) // 4]
    regular = sum(abs(step / period_s - round(step / period_s)) < _REGULAR for step in steps)
    return period_s if regular >= _MOSTLY * len(steps) else None


def _rate(samples: list[Sample], period_s: float | None, config: Config) -> Item:
    """Judge the rate of captures, and show that of arrivals, by our clock."""
    arrivals_s = sorted(one.received_ns * 1e-9 for one in samples)
    wanted_hz = config.source.rate_hz or 1.0 / config.plant.dt_s
    least_hz, why = _RATE_PART * wanted_hz, f"{_RATE_PART:.0%} of source.rate_hz, or of one each plant.dt_s"
    if period_s is None:
        least_hz, why = least_hz * (1.0 - config.link.loss), f"{why}, less link.loss"
    want = f"at least {least_hz:.3g} Hz ({why})"
    if len(arrivals_s) <= _ENOUGH:
        value = f"only {len(arrivals_s)} positions came"
        return item("position rate", ItemState.BAD, value, want, "listen longer, or see why")
    arrived_hz = (len(arrivals_s) - 1) / max(arrivals_s[-1] - arrivals_s[0], 1e-9)
    if period_s is None:
        good, value = arrived_hz >= least_hz, "irregular captures"
    else:
        good, value = 1.0 / period_s >= least_hz, f"{1.0 / period_s:.3g} Hz captured"
    return judged(
        "position rate",
        good=good,
        value=f"{value}, {arrived_hz:.3g} Hz arrive",
        want=want,
        hint="raise the rate of the cameras, or lower source.rate_hz, and design again",
    )


def _gaps(seen: Heard, config: Config, at_ns: int) -> Item:
    arrivals = [*sorted(one.received_ns for one in seen.samples), at_ns]
    longest_s = max(b - a for a, b in pairwise(arrivals)) * 1e-9
    horizon_s = config.smpc.horizon * config.plant.dt_s
    return judged(
        "longest gap",
        good=longest_s < horizon_s,
        value=f"{longest_s:.3g} s",
        want=f"under {horizon_s:.3g} s, the horizon: then plans end and the vehicle brakes",
        hint="look for occlusions and for the radio link; a flight would fall back at once",
    )


def _age(seen: Heard, config: Config) -> Item:
    ages_s = sorted((one.received_ns - one.captured_ns) * 1e-9 for one in seen.samples)
    p95_s, limit_s = ages_s[int(0.95 * (len(ages_s) - 1))], config.link.delay_s + config.link.jitter_s
    known = any(stats.clock_source == "timesync" for stats in seen.stats.values())
    note = "" if known else "; counted from the quickest one, as the source answers no TIMESYNC"
    value = f"median {ages_s[len(ages_s) // 2] * 1e3:.1f} ms, 95 % within {p95_s * 1e3:.1f} ms{note}"
    # Ages count in steps: one within Δt is 0, whatever the link was said to take.
    planned_for = config.smpc.horizon if config.conditioned else config.schedule.late + 1
    step_s = planned_for * config.plant.dt_s
    worst_s = max(limit_s, step_s)
    want = (
        f"95 % within {(limit_s + _AGE_TOLERANCE_S) * 1e3:.1f} ms (link.delay_s + link.jitter_s, and "
        f"{_AGE_TOLERANCE_S * 1e3:g} ms), never over {worst_s * 1e3:.0f} ms"
    )
    hint = "design for the delay that is there: raise link.delay_s or link.jitter_s (then schedule.late), or the link"
    if p95_s > worst_s:
        return item("position age", ItemState.BAD, value, want, hint)
    state = ItemState.GOOD if p95_s <= limit_s + _AGE_TOLERANCE_S else ItemState.NOTE
    return item("position age", state, value, want, hint)


def _loss(captured_s: list[float], config: Config) -> Item:
    """Steps without a position, which is what the design counts on (1 - p)."""
    link, dt_s, name = config.link, config.plant.dt_s, "position loss"
    expected = link.loss ** max(1, math.floor(config.source.rate_hz * dt_s))
    want = f"at most {expected:.0%} of the steps of {dt_s:g} s without a position (link.loss)"
    # Steps are laid so that most captures are in their middle: regular ones then never count twice or not at all.
    angles = [2.0 * math.pi * at_s / dt_s for at_s in captured_s]
    middle_s = math.atan2(sum(map(math.sin, angles)), sum(map(math.cos, angles))) * dt_s / (2.0 * math.pi)
    steps = [math.floor((at_s - middle_s) / dt_s + 0.5) for at_s in captured_s]
    count = steps[-1] - steps[0] + 1
    if count < _ENOUGH:
        return item(name, ItemState.UNDETERMINED, f"only {count} steps", want, "listen longer")
    loss = 1.0 - len(set(steps)) / count
    value = f"{loss:.0%} of {count} steps"
    if link.model != "bernoulli" or link.probability:
        return item(name, ItemState.NOTE, value, f"as link.model {link.model!r} has it", "compare it with the model's")
    # Three standard deviations: a right set-up is refused once in seven hundred checks (with two, once in forty).
    # Losses in bursts vary more than that.
    alone = math.sqrt(max(expected * (1.0 - expected), 0.25 / count) / count)
    in_runs = compute_loss_std(np.diff(np.unique(steps)) - 1)
    surely = loss - 3.0 * max(alone, in_runs)
    hint = "design for the loss that is there (link.loss, link.model), or better the link"
    if surely <= expected < loss:
        value += ", which is within the chance of so few"
    return judged(name, good=surely <= expected, value=value, want=want, hint=hint)


def spread_m(samples: list[Sample]) -> Vec3:
    """Standard deviation of each axis, from the differences of successive positions: slow movement does not count."""
    ordered = np.array([one.position_m for one in sorted(samples, key=lambda one: one.captured_ns)])
    n, e, d = (np.std(np.diff(ordered, axis=0), axis=0) / math.sqrt(2.0)).tolist()
    return n, e, d


def rests(seen: Heard, move_m: float) -> bool:
    """Whether the vehicle stood still, as far as its own position, or else the cameras', show."""
    where = [place for _, place in seen.own] if len(seen.own) >= _ENOUGH else [one.position_m for one in seen.samples]
    return extent_m(np.array(where)) < move_m


def extent_m(places: Array) -> float:
    """How far places (n, 3) lie apart, the farthest of them left out [m]."""
    low, high = np.percentile(places, [5, 95], axis=0)
    return float(np.linalg.norm(high - low))


def _noise(samples: list[Sample], config: Config) -> Item:
    believed_m = config.estimator.position_std_m
    want = f"at most {_NOISE_FACTOR:g} x {believed_m * 1e3:.3g} mm (estimator.position_std_m)"
    if len(samples) < _ENOUGH:
        return item("position noise", ItemState.UNDETERMINED, "too few positions", want, "listen longer")
    worst_m = max(spread_m(samples))
    value = f"{worst_m * 1e3:.3g} mm"
    low, high = np.percentile(np.array([one.position_m for one in samples]), [5, 95], axis=0)
    if float((high - low).max()) > max(10.0 * worst_m, config.check.move_m):
        return item("position noise", ItemState.UNDETERMINED, f"{value}, but the body moved", want, "let it rest")
    hint = "see to the cameras' calibration, or raise estimator.position_std_m"
    for scale, unit in () if from_cameras(config) else _UNITS:
        if believed_m * _NOISE_FACTOR < worst_m <= believed_m * scale * _NOISE_FACTOR and worst_m > 10 * believed_m:
            hint = f"does the source send {unit}? It has to send metres; else {hint}"
            break
    return judged("position noise", good=worst_m <= _NOISE_FACTOR * believed_m, value=value, want=want, hint=hint)


def _place(samples: list[Sample], config: Config) -> Item:
    middle = np.median(np.array([one.position_m for one in samples]), axis=0)
    where = ", ".join(f"{value:.3g}" for value in middle)
    limits = position_limits_m(config)
    inside = _is_inside(middle.tolist(), limits, config.check.margin_m)
    hint = "see [frame] (axes, origin, unit), or the limits of [sets]"
    if from_cameras(config):
        hint = f"{CAMERA_AXES}, or the limits of [sets]"
    elif not inside:
        for scale, unit in _UNITS:
            if _is_inside((middle / scale).tolist(), limits, config.check.margin_m):
                hint = f"does the source send {unit}? It has to send metres; else {hint}"
                break
        flipped = [*middle.tolist()[:2], -float(middle[2])]
        if _is_inside(flipped, limits, config.check.margin_m):
            hint = f'is up negative? With cameras that point up, frame.convention = "enu"; else {hint}'
    want = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in limits.items())
    return judged("position in the room", good=inside, value=f"({where}) m", want=f"{want} m (sets)", hint=hint)


def _is_inside(where: list[float], limits: dict[str, tuple[float, float]], margin_m: float) -> bool:
    low_high = ((where[AXES.index(axis)], low, high) for axis, (low, high) in limits.items())
    return all(low - margin_m <= value <= high + margin_m for value, low, high in low_high)


def _stuck(seen: Heard) -> Item:
    ordered = [one.position_m for one in seen.samples]
    run = longest = 1
    for a, b in pairwise(ordered):
        run = run + 1 if a == b else 1
        longest = max(longest, run)
    name, want = "position stuck", f"no {_STUCK_SAMPLES} positions in a row the same to the last bit"
    if longest < _STUCK_SAMPLES:
        return item(name, ItemState.GOOD, f"at most {longest} in a row the same", want)
    hint = "cameras have noise: does the source repeat the last pose of a body that it has lost?"
    return item(name, ItemState.UNDETERMINED, f"{longest} in a row the same", want, f"{hint} Move the body to see")
