"""The vehicle's own failsafes, beside that on setpoints: position lost, battery low, ground station gone."""

from __future__ import annotations

from sim.craft import Supply
from sim.estimator import Estimator
from sim.parameters import Parameters
from sim.personality import Mode, Personality, Role
from sim.pilot import CRITICAL, WARNING, Phase, Pilot

SECOND_NS = 1_000_000_000
LOOK_NS = SECOND_NS // 10
# ArduPilot: ten bad looks at 10 Hz before its estimator's failsafe acts, as recorded.
EKF_CHECK_NS = SECOND_NS


class Failsafes:
    """Looks ten times a second while armed."""

    def __init__(
        self,
        kind: Personality,
        pilot: Pilot,
        parameters: Parameters,
        estimator: Estimator,
        battery: Supply,
        *,
        clears: bool = False,
    ) -> None:
        self._px4 = kind.name == "px4"
        self._mode = kind.by_role
        self._pilot = pilot
        self._parameters = parameters
        self._estimator = estimator
        self._battery = battery
        self._look_ns = 0
        self._lost_ns: int | None = None  # since when the position is lost
        self._low_ns: int | None = None  # since when the battery is low
        self._warned = False
        self._clears = clears
        self._meant: Mode | None = None  # what it flew before its position was lost
        self.station_ns: int | None = None  # last heartbeat of the ground station

    @property
    def next_ns(self) -> int | None:
        """When it looks next [ns]; None while disarmed."""
        return self._look_ns if self._pilot.armed else None

    def run(self, at_ns: int) -> None:
        """Look, if it is time."""
        if not self._pilot.armed:
            self._lost_ns = self._low_ns = self._meant = None
            self._warned = False
            return
        if self._look_ns > at_ns:
            return
        self._look_ns = at_ns + LOOK_NS
        if self._meant is not None:
            self._look_at_its_end(at_ns)
        if self._pilot.phase is not Phase.GROUND:
            self._look_at_position(at_ns)
            self._look_at_battery(at_ns)
            self._look_at_station(at_ns)

    def _land(self, at_ns: int, *texts: str) -> None:
        self._pilot.texts.extend((CRITICAL, text) for text in texts)
        if self._pilot.mode.role is not Role.LAND:
            self._pilot.fail(self._mode(Role.LAND), at_ns)

    def _look_at_its_end(self, at_ns: int) -> None:
        """As recorded: a failsafe for want of a position ends with its cause, if nobody has changed the mode since."""
        if not self._pilot.failsafe:
            self._meant = None
        elif self._estimator.position_ok and self._meant is not None:
            self._pilot.recover(self._meant, at_ns)
            self._meant = None

    def _look_at_position(self, at_ns: int) -> None:
        if self._estimator.position_ok:
            self._lost_ns = None
            return
        first = self._lost_ns is None
        self._lost_ns = at_ns if self._lost_ns is None else self._lost_ns
        if not self._pilot.mode.needs_position:
            return
        if self._px4:
            self._meant = self._pilot.mode if self._clears else None
            self._land(at_ns, "Failsafe activated")
        elif at_ns - self._lost_ns >= EKF_CHECK_NS and self._parameters["FS_EKF_ACTION"] == 1:
            self._land(at_ns, "EKF variance", "EKF Failsafe: changed to LAND Mode")
        elif first and self._parameters["FS_EKF_ACTION"] == 0:
            self._pilot.texts.append((CRITICAL, "EKF variance"))

    def _look_at_battery(self, at_ns: int) -> None:
        p = self._parameters
        if self._px4:
            self._look_at_charge(at_ns)
        elif not 0.0 < self._battery.voltage_v < p["BATT_LOW_VOLT"]:
            self._low_ns = None
        else:
            self._low_ns = at_ns if self._low_ns is None else self._low_ns
            if at_ns - self._low_ns >= p["BATT_LOW_TIMER"] * SECOND_NS and not self._warned:
                self._warned = True
                self._pilot.texts.append((WARNING, f"Battery 1 is low {self._battery.voltage_v:.2f}V"))
                if p["BATT_FS_LOW_ACT"] == 1:
                    self._land(at_ns, "Battery Failsafe")

    def _look_at_charge(self, at_ns: int) -> None:
        p, left = self._parameters, self._battery.remaining
        if left < p["BAT_LOW_THR"] and not self._warned:
            self._warned = True
            self._pilot.texts.append((WARNING, "Low battery level"))
        lands = left < p["BAT_CRIT_THR"] and p["COM_LOW_BAT_ACT"] == 2
        if lands and self._pilot.mode.role is not Role.LAND:
            self._land(at_ns, "Failsafe activated: critical battery, landing")

    def _look_at_station(self, at_ns: int) -> None:
        p = self._parameters
        action, wait = ("NAV_DLL_ACT", "COM_DL_LOSS_T") if self._px4 else ("FS_GCS_ENABLE", "FS_GCS_TIMEOUT")
        if p[action] == 0 or self.station_ns is None or at_ns - self.station_ns < p[wait] * SECOND_NS:
            return
        if self._px4 and p[action] == 1:
            if self._pilot.mode.role not in (Role.HOLD, Role.LAND):
                self._pilot.texts.append((CRITICAL, "Failsafe activated: no ground station"))
                self._pilot.fail(self._mode(Role.HOLD), at_ns)
        elif self._pilot.mode.role is not Role.LAND:
            self._land(at_ns, "Failsafe activated: no ground station" if self._px4 else "GCS Failsafe")
