"""Items of the frame: axes, unit, handedness and heading of the cameras against the vehicle's own estimate."""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np

from uavctl.arrays import Array
from uavctl.check.axis_fit import (
    Evidence,
    Mistake,
    compute_misfit,
    compute_rms,
    estimate_yaw_deg,
    explain_misfit,
    find_possible_mistakes,
)
from uavctl.check.check_data import AIDED, HORIZONTAL, CheckData
from uavctl.check.findings import Item, ItemState, make_item
from uavctl.check.positions import describe_camera_axes, estimate_noise_m, measure_extent_m, uses_camera_system
from uavctl.config.types import Config
from uavctl.frames import Quaternion, euler_from_quaternion, multiply_quaternions, quaternion_from_euler
from uavctl.records import Vec3

MIN_PAIRS = 5  # pairs
_VEHICLE_MESSAGES = ("LOCAL_POSITION_NED",)
_TILT_DEG = 25.0  # between the two attitudes
_MOVE_TOLERANCE_M, _MOVE_TOLERANCE_SHARE = 0.05, 0.15
_PROMPT_TOLERANCE_SHARE = 0.6  # of the way that a person was asked to move the body
_CONSTANT_POSITION = 128  # it assumes a constant position; PX4 sets this flag for every vehicle at rest
_PX4 = 12  # MAV_AUTOPILOT
_WANT = "the same axes, unit and handedness as the vehicle's own"
_MOVE = "move the body by half a metre up, north and east while the check listens, or use `uavctl check --move`"


def check_axes(data: CheckData, config: Config, prompted_moves: list[tuple[Vec3, Vec3]]) -> list[Item]:
    """Items of own position, axes and heading.

    Args:
        prompted_moves: (requested movement, movement measured by the cameras), local NED [m].
    """
    if config.source.messages == _VEHICLE_MESSAGES:
        return [make_item("axes", ItemState.GOOD, "the positions are the vehicle's own", _WANT)]
    if len(data.samples) < MIN_PAIRS:
        return []
    pairs = data.pair_positions() if _has_position(data) else []
    heading, heading_agrees = _check_heading(data, config)
    return [
        _check_vehicle_position(data, pairs),
        _check_axis_match(data, config, pairs, prompted_moves, heading_agrees=heading_agrees),
        heading,
    ]


def has_vehicle_position(data: CheckData) -> bool:
    """Whether there are enough positions of the vehicle to compare with the cameras'."""
    return _has_position(data) and len(data.pair_positions()) >= MIN_PAIRS


def _has_position(data: CheckData) -> bool:
    flags = data.estimator
    if flags is None:
        return True
    is_assumed = flags & _CONSTANT_POSITION and not (data.autopilot == _PX4 and (flags & AIDED or data.is_aided))
    return bool(flags & HORIZONTAL and not is_assumed)


def _check_vehicle_position(data: CheckData, pairs: list[tuple[Vec3, Vec3]]) -> Item:
    name, want = "own position", "the vehicle's own position, to compare"
    if len(pairs) >= MIN_PAIRS:
        distance_m = np.linalg.norm(np.median([np.subtract(e, v) for e, v in pairs], axis=0))
        return make_item(name, ItemState.GOOD, f"{len(pairs)} pairs, {distance_m:.2f} m from the cameras'", want)
    flags = "not reported" if data.estimator is None else f"flags 0x{data.estimator:x}"
    hint = (
        "give its estimator positions (the vehicle's parameters, [relay]); meanwhile `uavctl check --move` shows axes"
    )
    return make_item(name, ItemState.UNDETERMINED, f"none (estimator: {flags})", want, hint)


def collect_evidence(
    pairs: list[tuple[Vec3, Vec3]], prompted_moves: list[tuple[Vec3, Vec3]], config: Config
) -> tuple[list[Evidence], Evidence | None]:
    """All evidence, and that of a movement beside the vehicle's own position if the body moved."""
    evidence, moved = [], None
    if len(pairs) >= MIN_PAIRS:
        cameras_m, vehicle_m = np.array([e for e, _ in pairs]), np.array([v for _, v in pairs])
        if config.check.same_origin:
            median_m = np.median(cameras_m, axis=0, keepdims=True), np.median(vehicle_m, axis=0, keepdims=True)
            evidence.append(Evidence(median_m[1], median_m[0], config.check.offset_m))
        if max(measure_extent_m(cameras_m), measure_extent_m(vehicle_m)) >= config.check.move_m:
            offset_m = vehicle_m - vehicle_m.mean(axis=0)
            tolerance_m = _MOVE_TOLERANCE_M + _MOVE_TOLERANCE_SHARE * float(compute_rms(offset_m))
            moved = Evidence(offset_m, cameras_m - cameras_m.mean(axis=0), tolerance_m)
            evidence.append(moved)
    for expected, observed in prompted_moves:
        tolerance_m = _PROMPT_TOLERANCE_SHARE * math.hypot(*expected)
        evidence.append(Evidence(np.array([expected]), np.array([observed]), tolerance_m))
    return evidence, moved


def _check_axis_match(
    data: CheckData,
    config: Config,
    pairs: list[tuple[Vec3, Vec3]],
    prompted_moves: list[tuple[Vec3, Vec3]],
    *,
    heading_agrees: bool,
) -> Item:
    evidence, moved = collect_evidence(pairs, prompted_moves, config)
    if compute_misfit(evidence, np.eye(3)) > 1.0:
        return make_item(
            "axes",
            ItemState.BAD,
            explain_misfit(evidence) + _describe_worst_pair(evidence),
            _WANT,
            _make_hint(evidence, config),
        )
    if moved is not None and compute_rms(moved.vehicle_m[:, :2]) >= config.check.move_m / 3:
        angle_deg = estimate_yaw_deg([moved])
        if abs(angle_deg) > config.check.yaw_deg:
            hint = f"frame.yaw_deg is {angle_deg:.0f} deg too large, if the vehicle's heading is right"
            return make_item("axes", ItemState.BAD, f"turned by {angle_deg:.0f} deg about the vertical", _WANT, hint)
    # An estimate of the vehicle's that comes from these very positions shows nothing.
    independent = collect_evidence([], prompted_moves, config)[0] if config.relay.enabled else evidence
    remaining = _filter_mistakes(
        find_possible_mistakes(independent), data, config, heading_agrees=heading_agrees and not config.relay.enabled
    )
    methods = ", ".join(
        word
        for word, is_used in (("at rest", not moved and not prompted_moves), ("moved", moved or prompted_moves))
        if is_used
    )
    if remaining:
        value = f"consistent ({methods}), not excluded: " + "; ".join(mistake.name for mistake in remaining)
        return make_item("axes", ItemState.UNDETERMINED, value, _WANT, _MOVE)
    return make_item("axes", ItemState.GOOD, f"the same ({methods})", _WANT)


def _filter_mistakes(
    mistakes: list[Mistake], data: CheckData, config: Config, *, heading_agrees: bool
) -> list[Mistake]:
    """Mistakes that neither a heading nor the size of the noise excludes."""
    configured_m, noise_m = config.estimator.position_std_m, max(estimate_noise_m(data.samples))
    remaining = [mistake for mistake in mistakes if not (heading_agrees and mistake.is_yaw_only)]
    return [
        mistake
        for mistake in remaining
        if not _is_excluded_by_noise(float(mistake.matrix[0, 0]), noise_m / configured_m)
    ]


def _is_excluded_by_noise(scale: float, noise: float) -> bool:
    """Whether noise (relative to the configured one) cannot be that of another unit."""
    return (scale >= 100.0 and noise < 0.1 * scale) or (0.0 < scale <= 0.01 and noise > 0.1)


def _describe_worst_pair(evidence: list[Evidence]) -> str:
    pairs = max(evidence, key=lambda vectors: vectors.compute_misfit(np.eye(3)))
    row = int(np.argmax(np.linalg.norm(pairs.vehicle_m, axis=1) + np.linalg.norm(pairs.cameras_m, axis=1)))
    vehicle, cameras = _format_vector(pairs.vehicle_m[row]), _format_vector(pairs.cameras_m[row])
    return f": ({vehicle}) m for the vehicle, ({cameras}) m for the cameras"


def _format_vector(vector: Array) -> str:
    return ", ".join(f"{value:.2f}" for value in vector)


def _make_hint(evidence: list[Evidence], config: Config) -> str:
    hint = "see [frame] (convention, origin_m, yaw_deg), and the unit and handedness of the source's positions"
    if uses_camera_system(config):
        hint = describe_camera_axes(config)
    is_only_rest = len(evidence) == 1 and config.check.same_origin
    return hint + ("; if the vehicle has another origin, set check.same_origin = false" if is_only_rest else "")


def _check_heading(data: CheckData, config: Config) -> tuple[Item, bool]:
    """The cameras' attitude beside the vehicle's own, and whether they agree."""
    name, limit_deg = "heading", config.check.yaw_deg
    want = f"the cameras' attitude within {limit_deg:g} deg of the vehicle's own"
    rotations = _compute_relative_attitudes(data)
    if not rotations:
        value = "none, or always level and to the north"
        hint = "let the source send the body's attitude: it shows a turned frame at rest"
        if _has_attitude(data):
            value, hint = "the vehicle reports none", "let the vehicle stream ATTITUDE on this link"
        return make_item(name, ItemState.UNDETERMINED, value, want, hint), False
    yaws = [euler_from_quaternion(q)[2] for q in rotations]
    # Mean of directions: angles near 180 deg must not average to 0.
    yaw = math.degrees(math.atan2(sum(map(math.sin, yaws)), sum(map(math.cos, yaws))))
    tilt = float(
        np.median([math.degrees(math.acos(min(max(1 - 2 * (x * x + y * y), -1), 1))) for _, x, y, _ in rotations])
    )
    value = f"{yaw:.1f} deg apart about the vertical, {tilt:.1f} deg in tilt"
    if tilt > _TILT_DEG:
        hint = "the cameras' axes point up where [frame] has them down, or the body was defined in another attitude"
        return make_item(name, ItemState.BAD, value, want, hint), False
    if abs(yaw) > limit_deg:
        hint = (
            f"turn the frame (frame.yaw_deg {yaw:.0f} deg too large, or frame.convention), turn the body's own axes in "
            "the cameras' software with its nose along their first axis, or check the vehicle's compass"
        )
        return make_item(name, ItemState.BAD, value, want, hint), False
    return make_item(name, ItemState.GOOD, value, want), True


def _has_attitude(data: CheckData) -> bool:
    return data.has_attitude or data.fuses_attitude


def _compute_relative_attitudes(data: CheckData) -> list[Quaternion]:
    """Turns from the vehicle's attitude to the cameras', one for each sample that has both."""
    if not _has_attitude(data) or not data.angles_rad:
        return []
    times = [at_ns for at_ns, _ in data.angles_rad]
    rotations = []
    for sample in data.samples:
        attitude = quaternion_from_euler(
            data.angles_rad[min(bisect_left(times, sample.captured_ns), len(times) - 1)][1]
        )
        if sample.attitude is not None and attitude is not None:
            w, x, y, z = attitude
            rotations.append(multiply_quaternions(sample.attitude, (w, -x, -y, -z)))
    return rotations
