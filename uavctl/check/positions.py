"""Items of the positions: rate, gaps, age, loss, noise, room and repeats against the design."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from uavctl.arrays import Array
from uavctl.check.check_data import CheckData, Sample
from uavctl.check.findings import Item, ItemState, judge_item, make_item
from uavctl.config.checks import get_position_limits_m
from uavctl.config.connections import parse_camera_scheme
from uavctl.config.types import Config
from uavctl.flight.link_estimate import compute_loss_std
from uavctl.records import Vec3
from uavctl.smpc.plant import AXES

_MIN_SAMPLES = 8  # fewest samples for a statement
_AGE_TOLERANCE_S = 0.005
_MIN_RATE_SHARE = 0.95  # of the rate that is wanted
_MAX_STEP_DEVIATION, _MIN_REGULAR_SHARE = (
    0.15,
    0.8,
)  # of a period off a whole number of them; part of the steps that has to be so
_NOISE_FACTOR = 2.0
_FROZEN_SAMPLES = 20  # in a row: noise repeats one less than twice, a lost body repeats for as long as it is lost
_UNITS = ((1000.0, "millimetres"), (100.0, "centimetres"))
# A camera system that is listened to without a bridge has its own settings for axes, and its unit is known.
_CAMERA_AXES = (
    "does Motive stream Z up? Then the URL of daemon.mocap needs ?up=z, else not; see [frame] (origin_m, yaw_deg)"
)
_ROS2_AXES = (
    "does the driver publish metres, in axes east, north, up? See docs/ros2.md, and [frame] (origin_m, yaw_deg)"
)


def check_positions(data: CheckData, config: Config, at_ns: int) -> list[Item]:
    """Return items of rate, gaps, age, loss, noise and place of the positions received up to `at_ns`."""
    if not data.samples:
        return [_report_no_positions(data, config)]
    captured_s = sorted(sample.captured_ns * 1e-9 for sample in data.samples)
    period_s = _estimate_period_s(captured_s)
    items = [_check_rate(data.samples, period_s, config), _check_gaps(data, config, at_ns), _check_age(data, config)]
    items.append(_check_loss(captured_s, config))
    items += [_check_noise(data.samples, config), _check_room(data.samples, config), _check_frozen(data)]
    units = sorted({unit for stats in data.stats.values() for unit in stats.stamp_units})
    return [*items, _describe_units(units)] if units else items


def _describe_units(units: list[str]) -> Item:
    value = ", ".join("they do not advance" if unit == "constant" else f"in {unit}" for unit in units)
    hint = "set the source to stamp in microseconds; until then ages count from the arrival, less clock.latency_s"
    return make_item("position stamps", ItemState.NOTE, value, "in us, of the capture", hint)


def _report_no_positions(data: CheckData, config: Config) -> Item:
    rejected = {reason: n for stats in data.stats.values() for reason, n in stats.bad.items()}
    counts = ", ".join(f"{count} {reason}" for reason, count in sorted(rejected.items())) or "nothing came"
    names = ", ".join(config.source.messages)
    hint = f"is the source running, and does it send {names} to {config.daemon.mocap}? See source.messages"
    if data.vehicle_positions and config.daemon.mocap == config.daemon.vehicle:
        hint += (
            "; to fly on the vehicle's own estimate, which is heard: --set 'source.messages=[\"LOCAL_POSITION_NED\"]'"
        )
    if uses_camera_system(config):
        hint = f"do the cameras track the body of {config.daemon.mocap}, and stream it? See docs/sources.md"
    return make_item("positions", ItemState.BAD, f"none ({counts})", "positions of the source", hint)


def uses_camera_system(config: Config) -> bool:
    """Return whether the positions come from a camera system without a bridge."""
    return bool(parse_camera_scheme(config.daemon.mocap))


def _uses_ros2(config: Config) -> bool:
    """Return whether the positions come from a topic, whose unit and axes are its driver's."""
    return parse_camera_scheme(config.daemon.mocap) == "ros2"


def describe_camera_axes(config: Config) -> str:
    """Return a hint on the axes of positions that come without a bridge."""
    return _ROS2_AXES if _uses_ros2(config) else _CAMERA_AXES


def _estimate_period_s(captured_s: list[float]) -> float | None:
    """Time between two captures, if they keep one: the lower quartile of the steps, as losses make longer ones."""
    steps = sorted(b - a for a, b in pairwise(captured_s) if b > a)
    if len(steps) < _MIN_SAMPLES:
        return None
    period_s = steps[len(steps) // 4]
    regular_steps = sum(abs(step / period_s - round(step / period_s)) < _MAX_STEP_DEVIATION for step in steps)
    return period_s if regular_steps >= _MIN_REGULAR_SHARE * len(steps) else None


def _check_rate(samples: list[Sample], period_s: float | None, config: Config) -> Item:
    """Judge the rate of captures, and show that of arrivals, by our clock."""
    arrivals_s = sorted(sample.received_ns * 1e-9 for sample in samples)
    span_s = max(arrivals_s[-1] - arrivals_s[0], 1e-9)
    required_hz, loss = config.arrival_rate_hz, config.link.loss
    source = "link.wait_s" if config.link.model == "scheduled" else "source.rate_hz, or of one each plant.dt_s"
    min_hz, reason = _MIN_RATE_SHARE * required_hz, f"{_MIN_RATE_SHARE:.0%} of {source}"
    if period_s is None:
        # Of n positions n (1 - p) arrive, with the variance n p (1 - p): a right link is refused once in 700 checks
        mean, std = required_hz * (1.0 - loss), math.sqrt(required_hz * loss * (1.0 - loss) / span_s)
        min_hz, reason = min(min_hz * (1.0 - loss), mean - 3.0 * std), f"{reason}, less link.loss"
    want = f"at least {min_hz:.3g} Hz ({reason})"
    if len(arrivals_s) <= _MIN_SAMPLES:
        value = f"only {len(arrivals_s)} positions came"
        return make_item("position rate", ItemState.BAD, value, want, "listen longer, or check the source")
    arrival_hz = (len(arrivals_s) - 1) / span_s
    if period_s is None:
        is_good, value = arrival_hz >= min_hz, "irregular captures"
    else:
        is_good, value = 1.0 / period_s >= min_hz, f"{1.0 / period_s:.3g} Hz captured"
    return judge_item(
        "position rate",
        is_good=is_good,
        value=f"{value}, {arrival_hz:.3g} Hz arrive",
        want=want,
        hint="raise the rate of the cameras, or lower source.rate_hz, and design again",
    )


def _check_gaps(data: CheckData, config: Config, at_ns: int) -> Item:
    arrivals = [*sorted(sample.received_ns for sample in data.samples), at_ns]
    max_gap_s = max(b - a for a, b in pairwise(arrivals)) * 1e-9
    horizon_s = config.smpc.horizon * config.plant.dt_s
    return judge_item(
        "longest gap",
        is_good=max_gap_s < horizon_s,
        value=f"{max_gap_s:.3g} s",
        want=f"under {horizon_s:.3g} s, the horizon: then plans end and the vehicle brakes",
        hint="check occlusions and the radio link; a flight would brake at once",
    )


def _check_age(data: CheckData, config: Config) -> Item:
    ages_s = sorted((sample.received_ns - sample.captured_ns) * 1e-9 for sample in data.samples)
    p95_s, limit_s = ages_s[int(0.95 * (len(ages_s) - 1))], config.link.delay_s + config.link.jitter_s
    if config.link.model == "scheduled":  # the newest position waits for its turn, up to the next one
        limit_s += 1.0 / config.source.rate_hz if config.source.rate_hz else config.plant.dt_s
    has_timesync = any(stats.clock_source == "timesync" for stats in data.stats.values())
    note = "" if has_timesync else "; counted from the quickest one, as the source answers no TIMESYNC"
    value = f"median {ages_s[len(ages_s) // 2] * 1e3:.1f} ms, 95 % within {p95_s * 1e3:.1f} ms{note}"
    # Ages count in steps: one within Δt is 0, whatever delay the link has.
    planned_steps = config.smpc.horizon if config.is_age_conditioned else config.schedule.late + 1
    step_s = planned_steps * config.plant.dt_s
    max_age_s = max(limit_s, step_s)
    want = (
        f"95 % within {(limit_s + _AGE_TOLERANCE_S) * 1e3:.1f} ms (link.delay_s + link.jitter_s, and "
        f"{_AGE_TOLERANCE_S * 1e3:g} ms), never over {max_age_s * 1e3:.0f} ms"
    )
    hint = "raise link.delay_s or link.jitter_s (then schedule.late) to this delay, or improve the link"
    if p95_s > max_age_s:
        return make_item("position age", ItemState.BAD, value, want, hint)
    state = ItemState.GOOD if p95_s <= limit_s + _AGE_TOLERANCE_S else ItemState.NOTE
    return make_item("position age", state, value, want, hint)


def _check_loss(captured_s: list[float], config: Config) -> Item:
    """Judge the share of steps without a position against the design's (1 - p)."""
    link, dt_s, name = config.link, config.plant.dt_s, "position loss"
    expected = link.loss ** max(1, math.floor(config.source.rate_hz * dt_s))
    want = f"at most {expected:.0%} of the steps of {dt_s:g} s without a position (link.loss)"
    # Steps are laid so that most captures are in their middle: regular ones then never count twice or not at all.
    angles = [2.0 * math.pi * at_s / dt_s for at_s in captured_s]
    middle_s = math.atan2(sum(map(math.sin, angles)), sum(map(math.cos, angles))) * dt_s / (2.0 * math.pi)
    steps = [math.floor((at_s - middle_s) / dt_s + 0.5) for at_s in captured_s]
    count = steps[-1] - steps[0] + 1
    if count < _MIN_SAMPLES:
        return make_item(name, ItemState.UNDETERMINED, f"only {count} steps", want, "listen longer")
    loss = 1.0 - len(set(steps)) / count
    value = f"{loss:.0%} of {count} steps"
    if link.model != "bernoulli" or link.probability:
        return make_item(
            name, ItemState.NOTE, value, f"as link.model {link.model!r} has it", "compare it with the model's"
        )
    # Three standard deviations: a right set-up is refused once in seven hundred checks (with two, once in forty).
    # Losses in bursts vary more than that.
    bernoulli_std = math.sqrt(max(expected * (1.0 - expected), 0.25 / count) / count)
    run_std = compute_loss_std(np.diff(np.unique(steps)) - 1)
    lower_bound = loss - 3.0 * max(bernoulli_std, run_std)
    hint = "set link.loss and link.model to this loss, or improve the link"
    if lower_bound <= expected < loss:
        value += ", within chance for so few steps"
    return judge_item(name, is_good=lower_bound <= expected, value=value, want=want, hint=hint)


def estimate_noise_m(samples: list[Sample]) -> Vec3:
    """Standard deviation of each axis, from the differences of successive positions: slow movement does not count."""
    ordered = np.array([sample.position_m for sample in sorted(samples, key=lambda sample: sample.captured_ns)])
    n, e, d = (np.std(np.diff(ordered, axis=0), axis=0) / math.sqrt(2.0)).tolist()
    return n, e, d


def is_at_rest(data: CheckData, move_m: float) -> bool:
    """Return whether the vehicle stood still, by its own position, or else by the cameras'."""
    positions = (
        [position for _, position in data.vehicle_positions]
        if len(data.vehicle_positions) >= _MIN_SAMPLES
        else [sample.position_m for sample in data.samples]
    )
    return measure_extent_m(np.array(positions)) < move_m


def measure_extent_m(positions: Array) -> float:
    """Return the extent of positions (n, 3) without the outermost [m]."""
    low, high = np.percentile(positions, [5, 95], axis=0)
    return float(np.linalg.norm(high - low))


def _check_noise(samples: list[Sample], config: Config) -> Item:
    configured_m = config.estimator.position_std_m
    want = f"at most {_NOISE_FACTOR:g} x {configured_m * 1e3:.3g} mm (estimator.position_std_m)"
    if len(samples) < _MIN_SAMPLES:
        return make_item("position noise", ItemState.UNDETERMINED, "too few positions", want, "listen longer")
    noise_m = max(estimate_noise_m(samples))
    value = f"{noise_m * 1e3:.3g} mm"
    low, high = np.percentile(np.array([sample.position_m for sample in samples]), [5, 95], axis=0)
    if float((high - low).max()) > max(10.0 * noise_m, config.check.move_m):
        return make_item(
            "position noise", ItemState.UNDETERMINED, f"{value}, but the body moved", want, "leave the body at rest"
        )
    hint = "check the cameras' calibration, or raise estimator.position_std_m"
    for scale, unit in () if uses_camera_system(config) and not _uses_ros2(config) else _UNITS:
        if (
            configured_m * _NOISE_FACTOR < noise_m <= configured_m * scale * _NOISE_FACTOR
            and noise_m > 10 * configured_m
        ):
            hint = f"does the source send {unit}? It has to send metres; else {hint}"
            break
    return judge_item(
        "position noise", is_good=noise_m <= _NOISE_FACTOR * configured_m, value=value, want=want, hint=hint
    )


def _check_room(samples: list[Sample], config: Config) -> Item:
    middle = np.median(np.array([sample.position_m for sample in samples]), axis=0)
    text = ", ".join(f"{value:.3g}" for value in middle)
    limits = get_position_limits_m(config)
    is_inside = _is_inside(middle.tolist(), limits, config.check.margin_m)
    hint = "see [frame] (axes, origin, unit), or the limits of [sets]"
    if uses_camera_system(config):
        hint = f"{describe_camera_axes(config)}, or the limits of [sets]"
    elif not is_inside:
        for scale, unit in _UNITS if _is_far_outside(middle.tolist(), limits) else ():
            if _is_inside((middle / scale).tolist(), limits, config.check.margin_m):
                hint = f"does the source send {unit}? It has to send metres; else {hint}"
                break
        flipped = [*middle.tolist()[:2], -float(middle[2])]
        if _is_inside(flipped, limits, config.check.margin_m):
            hint = f'is up negative? With cameras that point up, frame.convention = "enu"; else {hint}'
    want = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in limits.items())
    return judge_item(
        "position in the room", is_good=is_inside, value=f"({text}) m", want=f"{want} m (sets)", hint=hint
    )


def _is_far_outside(position: list[float], limits: dict[str, tuple[float, float]]) -> bool:
    """Return whether a position is twice as far from the origin as the limits, so that its unit is in doubt."""
    sides_m = [abs(side) for limit in limits.values() for side in limit if math.isfinite(side)]
    return max(map(abs, position)) > 2.0 * max(sides_m, default=0.0)


def _is_inside(position: list[float], limits: dict[str, tuple[float, float]], margin_m: float) -> bool:
    sides = ((position[AXES.index(axis)], low, high) for axis, (low, high) in limits.items())
    return all(low - margin_m <= value <= high + margin_m for value, low, high in sides)


def _check_frozen(data: CheckData) -> Item:
    positions = [sample.position_m for sample in data.samples]
    run = longest = 1
    for a, b in pairwise(positions):
        run = run + 1 if a == b else 1
        longest = max(longest, run)
    name, want = "position frozen", f"no {_FROZEN_SAMPLES} positions in a row the same to the last bit"
    if longest < _FROZEN_SAMPLES:
        return make_item(name, ItemState.GOOD, f"at most {longest} in a row the same", want)
    hint = "cameras have noise: does the source repeat the last pose of a body that it has lost?"
    return make_item(name, ItemState.UNDETERMINED, f"{longest} in a row the same", want, f"{hint} Move the body to see")
