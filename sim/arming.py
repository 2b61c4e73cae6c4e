"""Arming checks: why a vehicle will not arm, in the words of each autopilot."""

from __future__ import annotations

from sim.craft import Supply
from sim.estimator import Estimator
from sim.parameters import Parameters
from sim.personality import Mode, Personality, Role

# ArduCopter with external positions only: seen to be ready so long after boot, the estimator long before.
READY_NS = 24_000_000_000


def reasons(
    kind: Personality, mode: Mode, parameters: Parameters, estimator: Estimator, battery: Supply, boot_age_ns: int
) -> tuple[str, ...]:
    """What speaks against arming, as the texts of STATUSTEXT; nothing if it may arm.

    Args:
        kind: the autopilot.
        mode: its mode.
        parameters: its parameters.
        estimator: its estimate.
        battery: its battery.
        boot_age_ns: time since it started.
    """
    found = list(preflight(kind, parameters, estimator, battery, boot_age_ns))
    if mode.role is Role.LAND:
        found.append(
            "Arming denied: switch out of the landing mode" if kind.name == "px4" else "Arm: Land mode not armable"
        )
    return tuple(found)


def preflight(
    kind: Personality, parameters: Parameters, estimator: Estimator, battery: Supply, boot_age_ns: int
) -> tuple[str, ...]:
    """What speaks against arming in any mode: the pre-arm bit of SYS_STATUS is its absence."""
    return (
        _px4(parameters, estimator, battery)
        if kind.name == "px4"
        else _ardupilot(parameters, estimator, battery, boot_age_ns)
    )


def _px4(parameters: Parameters, estimator: Estimator, battery: Supply) -> tuple[str, ...]:
    checks = (
        (estimator.steady, "Arming denied: Resolve system health failures first"),
        (estimator.position_ok, "Preflight Fail: no valid local position estimate"),
        (estimator.has_height, "Preflight Fail: height estimate not stable"),
        (estimator.has_heading, "Preflight Fail: heading estimate not stable"),
        (battery.remaining > parameters["BAT_LOW_THR"], "Preflight Fail: low battery"),
    )
    return tuple(text for good, text in checks if not good)


def _ardupilot(parameters: Parameters, estimator: Estimator, battery: Supply, boot_age_ns: int) -> tuple[str, ...]:
    external = estimator.uses_external
    checks = (
        (estimator.steady, "PreArm: Internal errors"),
        (estimator.position_ok, "PreArm: VisOdom: not healthy" if external else "PreArm: Need Position Estimate"),
        (estimator.has_height, "PreArm: EKF3 waiting for height source"),
        (estimator.has_heading, "PreArm: EKF3 yaw source not available"),
        (not external or boot_age_ns >= READY_NS, "PreArm: EKF3 still initialising"),
        (battery.voltage_v > parameters["BATT_LOW_VOLT"], "PreArm: Battery 1 low voltage failsafe"),
    )
    return tuple(text for good, text in checks if not good)
