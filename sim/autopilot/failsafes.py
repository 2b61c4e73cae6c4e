"""Failsafes of the vehicle beside the setpoint timeout: position, fence, battery, ground station."""

from __future__ import annotations

from sim.autopilot.estimator import Estimator
from sim.autopilot.parameters import Parameters
from sim.autopilot.pilot import CRITICAL, NOTICE, WARNING, Phase, Pilot
from sim.autopilot.profile import Mode, Role, SimulatedProfile
from sim.vehicle.interface import BatteryState
from uavctl.arrays import SECOND_NS

FAILSAFE_PERIOD_NS = SECOND_NS // 10
# ArduPilot: ten bad checks at 10 Hz before its estimator's failsafe acts, as recorded.
EKF_CHECK_NS = SECOND_NS
# Modes by GF_ACTION and FENCE_ACTION; the values that are not here only warn.
PX4_FENCE_MODES = {2.0: "AUTO.LOITER", 3.0: "AUTO.RTL", 5.0: "AUTO.LAND"}
ARDUPILOT_FENCE_MODES = {1.0: "RTL", 2.0: "LAND"}


class Failsafes:
    """Failsafes of the autopilot, checked ten times a second while armed."""

    def __init__(
        self,
        profile: SimulatedProfile,
        pilot: Pilot,
        parameters: Parameters,
        estimator: Estimator,
        battery: BatteryState,
        *,
        can_clear: bool = False,
    ) -> None:
        self._is_px4 = profile.name == "px4"
        self._get_mode_by_role, self._get_mode = profile.get_mode_by_role, profile.get_mode
        self._pilot = pilot
        self._parameters = parameters
        self._estimator = estimator
        self._battery = battery
        self._next_check_ns = 0
        self._lost_ns: int | None = None  # since when the position is lost
        self._low_ns: int | None = None  # since when the battery is low
        self._has_warned = False
        self._can_clear = can_clear
        self._previous_mode: Mode | None = None  # mode before its position was lost
        self.gcs_heartbeat_ns: int | None = None  # last heartbeat of the ground station

    @property
    def next_ns(self) -> int | None:
        """Time of the next check [ns]; None while disarmed."""
        return self._next_check_ns if self._pilot.is_armed else None

    def run(self, at_ns: int) -> None:
        """Check for the cause of a failsafe, if it is time."""
        if not self._pilot.is_armed:
            self._lost_ns = self._low_ns = self._previous_mode = None
            self._has_warned = self._pilot.is_fence_breached = False
            return
        if self._next_check_ns > at_ns:
            return
        self._next_check_ns = at_ns + FAILSAFE_PERIOD_NS
        if self._previous_mode is not None:
            self._check_recovery(at_ns)
        if self._pilot.phase is not Phase.GROUND:
            self._check_position(at_ns)
            self._check_fence(at_ns)
            self._check_battery(at_ns)
            self._check_gcs(at_ns)

    def _land(self, at_ns: int, *texts: str) -> None:
        self._pilot.status_texts.extend((CRITICAL, text) for text in texts)
        if self._pilot.mode.role is not Role.LAND:
            self._pilot.enter_failsafe(self._get_mode_by_role(Role.LAND), at_ns)

    def _check_recovery(self, at_ns: int) -> None:
        """End a position failsafe when the position returns, as recorded, unless the mode has changed since."""
        if not self._pilot.is_failsafe:
            self._previous_mode = None
        elif self._estimator.is_position_valid and self._previous_mode is not None:
            self._pilot.end_failsafe(self._previous_mode, at_ns)
            self._previous_mode = None

    def _check_position(self, at_ns: int) -> None:
        if self._estimator.is_position_valid:
            self._lost_ns = None
            return
        is_first = self._lost_ns is None
        self._lost_ns = at_ns if self._lost_ns is None else self._lost_ns
        mode = self._pilot.mode
        # As recorded: PX4's landing is content with a position that is not trusted. Without any it descends.
        must_descend = self._is_px4 and not self._estimator.has_position
        if not (mode.needs_position or (must_descend and mode is self._get_mode_by_role(Role.LAND))):
            return
        if self._is_px4:
            self._previous_mode = mode if self._can_clear else None
            self._pilot.status_texts.append((CRITICAL, "Failsafe activated"))
            self._pilot.enter_failsafe(
                self._get_mode("AUTO.DESCEND") if must_descend else self._get_mode_by_role(Role.LAND), at_ns
            )
        elif at_ns - self._lost_ns >= EKF_CHECK_NS and self._parameters["FS_EKF_ACTION"] == 1:
            self._land(at_ns, "EKF variance", "EKF Failsafe: changed to LAND Mode")
        elif is_first and self._parameters["FS_EKF_ACTION"] == 0:
            self._pilot.status_texts.append((CRITICAL, "EKF variance"))

    def _check_fence(self, at_ns: int) -> None:
        """Act as the vehicle first comes beyond the height of its fence; an ArduPilot's heartbeats show no failsafe."""
        p, pilot = self._parameters, self._pilot
        ceiling_m = p["GF_MAX_VER_DIST"] if self._is_px4 else p["FENCE_ALT_MAX"] * p["FENCE_ENABLE"]
        action = p["GF_ACTION"] if self._is_px4 else p["FENCE_ACTION"]
        was_breached = pilot.is_fence_breached
        pilot.is_fence_breached = 0.0 < ceiling_m < pilot.home_m[2] - self._estimator.position_m[2]
        if not self._is_px4 and was_breached and not pilot.is_fence_breached:
            pilot.status_texts.append((NOTICE, "Fence breach cleared"))
        if was_breached or not pilot.is_fence_breached or (self._is_px4 and action == 0):
            return
        if self._is_px4:
            pilot.status_texts.append((CRITICAL, "Geofence: exceeding maximum altitude above Home"))
        else:
            pilot.status_texts.append((NOTICE, "Max Alt fence breached"))
        modes = PX4_FENCE_MODES if self._is_px4 else ARDUPILOT_FENCE_MODES
        mode = self._get_mode(modes[action]) if action in modes else None
        if mode is None or pilot.mode.role is Role.LAND:
            return
        if self._is_px4:
            pilot.status_texts.append((CRITICAL, "Failsafe activated"))
        pilot.enter_failsafe(
            mode if self._estimator.is_position_valid else self._get_mode_by_role(Role.LAND),
            at_ns,
            is_shown=self._is_px4,
        )

    def _check_battery(self, at_ns: int) -> None:
        p = self._parameters
        if self._is_px4:
            self._check_charge(at_ns)
        elif not 0.0 < self._battery.voltage_v < p["BATT_LOW_VOLT"]:
            self._low_ns = None
        else:
            self._low_ns = at_ns if self._low_ns is None else self._low_ns
            if at_ns - self._low_ns >= p["BATT_LOW_TIMER"] * SECOND_NS and not self._has_warned:
                self._has_warned = True
                self._pilot.status_texts.append((WARNING, f"Battery 1 is low {self._battery.voltage_v:.2f}V"))
                if p["BATT_FS_LOW_ACT"] == 1:
                    self._land(at_ns, "Battery Failsafe")

    def _check_charge(self, at_ns: int) -> None:
        p, charge = self._parameters, self._battery.remaining
        if charge < p["BAT_LOW_THR"] and not self._has_warned:
            self._has_warned = True
            self._pilot.status_texts.append((WARNING, "Low battery level"))
        must_land = charge < p["BAT_CRIT_THR"] and p["COM_LOW_BAT_ACT"] == 2
        if must_land and self._pilot.mode.role is not Role.LAND:
            self._land(at_ns, "Failsafe activated: critical battery, landing")

    def _check_gcs(self, at_ns: int) -> None:
        p = self._parameters
        action, timeout = ("NAV_DLL_ACT", "COM_DL_LOSS_T") if self._is_px4 else ("FS_GCS_ENABLE", "FS_GCS_TIMEOUT")
        if p[action] == 0 or self.gcs_heartbeat_ns is None or at_ns - self.gcs_heartbeat_ns < p[timeout] * SECOND_NS:
            return
        if self._is_px4 and p[action] == 1:
            if self._pilot.mode.role not in (Role.HOLD, Role.LAND):
                self._pilot.status_texts.append((CRITICAL, "Failsafe activated: no ground station"))
                self._pilot.enter_failsafe(self._get_mode_by_role(Role.HOLD), at_ns)
        elif self._pilot.mode.role is not Role.LAND:
            self._land(at_ns, "Failsafe activated: no ground station" if self._is_px4 else "GCS Failsafe")
