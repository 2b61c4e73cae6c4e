"""Arming checks: reasons against arming, as texts of each autopilot."""

from __future__ import annotations

from sim.autopilot.estimator import Estimator
from sim.autopilot.parameters import Parameters
from sim.autopilot.profile import Mode, Role, SimulatedProfile
from sim.vehicle.interface import BatteryState

READY_NS = 24_000_000_000


def find_arming_refusals(
    profile: SimulatedProfile,
    mode: Mode,
    parameters: Parameters,
    estimator: Estimator,
    battery: BatteryState,
    boot_age_ns: int,
) -> tuple[str, ...]:
    """Return the reasons against arming as texts of STATUSTEXT; none if it may arm."""
    refusals = list(check_preflight(profile, parameters, estimator, battery, boot_age_ns))
    if mode.role is Role.LAND:
        refusals.append(
            "Arming denied: switch out of the landing mode" if profile.name == "px4" else "Arm: Land mode not armable"
        )
    return tuple(refusals)


def check_preflight(
    profile: SimulatedProfile, parameters: Parameters, estimator: Estimator, battery: BatteryState, boot_age_ns: int
) -> tuple[str, ...]:
    """Return the reasons against arming in any mode; without any, SYS_STATUS has its pre-arm bit set."""
    return (
        _check_px4(parameters, estimator, battery)
        if profile.name == "px4"
        else _check_ardupilot(parameters, estimator, battery, boot_age_ns)
    )


def _check_px4(parameters: Parameters, estimator: Estimator, battery: BatteryState) -> tuple[str, ...]:
    checks = (
        (estimator.passes_checks, "Arming denied: Resolve system health failures first"),
        (estimator.is_position_valid, "Preflight Fail: no valid local position estimate"),
        (estimator.has_height, "Preflight Fail: height estimate not stable"),
        (estimator.has_heading, "Preflight Fail: heading estimate not stable"),
        (battery.remaining > parameters["BAT_LOW_THR"], "Preflight Fail: low battery"),
    )
    return tuple(text for passes, text in checks if not passes)


def _check_ardupilot(
    parameters: Parameters, estimator: Estimator, battery: BatteryState, boot_age_ns: int
) -> tuple[str, ...]:
    uses_external = estimator.uses_external
    checks = (
        (estimator.passes_checks, "PreArm: Internal errors"),
        (
            estimator.is_position_valid,
            "PreArm: VisOdom: not healthy" if uses_external else "PreArm: Need Position Estimate",
        ),
        (estimator.has_height, "PreArm: EKF3 waiting for height source"),
        (estimator.has_heading, "PreArm: EKF3 yaw source not available"),
        (not uses_external or boot_age_ns >= READY_NS, "PreArm: EKF3 still initialising"),
        (battery.voltage_v > parameters["BATT_LOW_VOLT"], "PreArm: Battery 1 low voltage failsafe"),
    )
    return tuple(text for passes, text in checks if not passes)
