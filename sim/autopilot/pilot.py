"""State machine of the simulated autopilot: modes, arming, phases of flight, and setpoint source.

It handles no bytes: `autopilot.py` translates. There is no free fall, so it refuses to disarm in the air, forced or
not.
"""

from __future__ import annotations

from enum import Enum

from sim.autopilot.arming import find_arming_refusals
from sim.autopilot.dispatch import SetpointDispatch
from sim.autopilot.estimator import Estimator
from sim.autopilot.parameters import Parameters
from sim.autopilot.profile import ACCEPTED, FAILED, TEMPORARILY_REJECTED, Mode, Role, SimulatedProfile
from sim.autopilot.setpoints import STOP, ParsedSetpoint, SetpointKind
from sim.channel import find_earliest_ns
from sim.vehicle.interface import ControlledPlant, Vehicle
from uavctl.arrays import SECOND_NS
from uavctl.records import Vec3

CHECK_PERIOD_NS = 20_000_000  # of height and floor
# PX4 takes OFFBOARD while the newest setpoint is younger than COM_OF_LOSS_T; its documentation requires 2 Hz, so here
# never longer than that.
MAX_SETPOINT_AGE_NS = SECOND_NS // 2
TIMED_PHASE_NS = 5 * SECOND_NS  # length of a take-off or landing of a plant that has no vertical axis
TAKEOFF_TOLERANCE_M = 0.1
TRANSIENT_ROLES = frozenset({Role.TAKEOFF, Role.LAND})  # modes that end by themselves
LAND_ACTION = 4  # COM_OBL_RC_ACT; less leaves it to the stick
CRASHED = "CRASHED"
CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY
SWITCH_US, SWITCH_STEP_US = 1000, 120  # of the switch of modes: before it was moved, and from mode to mode
FORCE_ARM_CODE = 21196.0  # param2 of arming that skips the checks


class Phase(Enum):
    """Phase of flight; the value is EXTENDED_SYS_STATE's MAV_LANDED_STATE."""

    GROUND = 1
    AIR = 2
    CLIMB = 3
    DESCENT = 4


class Pilot:
    """State machine of one vehicle's modes and phases of flight.

    With `airborne` it starts armed, flying and in its external mode; the setpoint timeout then counts
    from the first setpoint. Else it stands on the floor, disarmed.

    Attributes:
        status_texts: (severity, text) of the STATUSTEXTs to send, in order; the caller empties it.
        crash_reason: why the autopilot's program stopped, None while it runs.
        is_failsafe: whether a failsafe chose the mode.
        is_fence_breached: whether it is beyond its fence.
        has_radio: whether it receives a remote control.
        switch_us: position of the remote control's mode switch [µs].
        dispatch: passes setpoints on to the vehicle.
        setpoint_ns: when the last setpoint that counts came [ns], None before the first.
        home_m: where it was armed last, local NED.
    """

    def __init__(
        self,
        profile: SimulatedProfile,
        vehicle: Vehicle,
        parameters: Parameters,
        estimator: Estimator,
        boot_ns: int,
        *,
        airborne: bool,
        has_radio: bool,
    ) -> None:
        self._profile = profile
        self._vehicle = vehicle
        self._linear_plant = vehicle if isinstance(vehicle, ControlledPlant) else None
        self._has_down = vehicle.has_down
        self._parameters = parameters
        self._estimator = estimator
        self._boot_ns = boot_ns
        self.has_radio = has_radio
        self.switch_us = SWITCH_US
        self._check_ns = vehicle.now_ns
        self._phase_end_ns: int | None = None  # end of a timed climb or descent, or of the wait for disarming
        self._disarm_text = profile.preflight_text
        self._takeoff_m: float | None = None  # requested height; PX4 has a default without one
        self._armed_ns = vehicle.now_ns
        self._liftoff_ns: int | None = None  # when it leaves the floor, while rotors spin up
        self._touchdown_ns: int | None = None  # since when it stands on the floor without knowing it
        self.setpoint_ns: int | None = None
        self._ends_with_setpoints = False  # whether setpoints that come again end the failsafe
        self.status_texts: list[tuple[int, str]] = []
        self.crash_reason: str | None = None
        self.is_failsafe = self.is_fence_breached = False
        self.is_armed = airborne
        self.phase = Phase.AIR if airborne else Phase.GROUND
        self.mode: Mode = (
            profile.get_mode_by_role(Role.EXTERNAL) if airborne else profile.get_mode(profile.initial_mode)
        )
        self._chosen_mode: Mode = self.mode  # last mode chosen by pilot or command, without take-off and landing
        setpoint = ParsedSetpoint(SetpointKind.ACCELERATION) if airborne else None
        self.dispatch = SetpointDispatch(profile, vehicle, parameters, estimator, setpoint)
        self.home_m: Vec3 = (0.0, 0.0, 0.0)
        if not airborne:
            vehicle.stand_on_floor()

    @property
    def is_external(self) -> bool:
        """Whether setpoints are flown."""
        return self.mode.role is Role.EXTERNAL and self.is_armed and self.phase is Phase.AIR

    @property
    def _deadline_ns(self) -> int | None:
        """Time at which silence has lasted too long [ns]; None when it does not matter."""
        last_ns = self.setpoint_ns
        if last_ns is None or not self.is_external:
            return None
        if self._profile.name == "px4":
            if self._parameters["COM_OBL_RC_ACT"] < LAND_ACTION and not self.has_radio:  # observed: it flies on
                return None
        elif (
            self.dispatch.active_setpoint is None or self.dispatch.active_setpoint.kind is SetpointKind.POSITION
        ):  # a position is kept
            return None
        return last_ns + max(round(self._parameters[self._profile.timeout_parameter] * 1e9), 0)

    @property
    def next_ns(self) -> int | None:
        """Time at which it next acts by itself [ns]."""
        check_ns = self._check_ns if self._is_checking_height else None
        plant_ns = None if self._linear_plant is None else self._linear_plant.next_ns
        return find_earliest_ns((self._phase_end_ns, self._deadline_ns, check_ns, plant_ns, self._liftoff_ns))

    @property
    def _is_checking_height(self) -> bool:
        """Whether floor or height are watched; the linear plant may fly through the floor, unless it falls."""
        phase, is_wrecked = self.phase, self._vehicle.is_wrecked
        watches_air = self._linear_plant is None or is_wrecked
        is_above_floor = phase is Phase.CLIMB or phase is Phase.DESCENT
        return (is_above_floor or (phase is Phase.AIR and watches_air)) and (self._has_down or is_wrecked)

    def run(self, at_ns: int) -> None:
        """Act on everything due at `at_ns`, with the vehicle moved there."""
        deadline_ns = self._deadline_ns
        if deadline_ns is not None and deadline_ns <= at_ns:
            self._handle_setpoint_timeout(at_ns)
        if self._liftoff_ns is not None and self._liftoff_ns <= at_ns:
            self._leave_floor(at_ns)
        if self._phase_end_ns is not None and self._phase_end_ns <= at_ns:
            self._end_phase(at_ns)
        if self._is_checking_height and self._check_ns <= at_ns:
            self._check_height(at_ns)
        plant = self._linear_plant
        if plant is not None and plant.next_ns is not None and plant.next_ns <= at_ns:
            plant.update_control()

    def receive_setpoint(self, setpoint: ParsedSetpoint, at_ns: int) -> None:
        """Take a setpoint of a kind that counts for the stream."""
        if setpoint.kind is SetpointKind.FATAL:
            if self.is_external:
                self.crash("a setpoint was not a number")
            return
        self.setpoint_ns = at_ns
        if self._ends_with_setpoints:  # as recorded: setpoints that come again end PX4's failsafe by themselves
            self._enter_mode(self._profile.get_mode_by_role(Role.EXTERNAL), at_ns)
        if self.is_external:
            self.dispatch.apply(setpoint)

    def crash(self, reasons: str) -> None:
        """Stop the autopilot's program: it decides, sends and answers nothing from now on."""
        self.crash_reason = reasons
        self._vehicle.accelerate((0.0, 0.0, 0.0))

    def arm(self, at_ns: int, *, is_forced: bool = False) -> int:
        """Arm on the floor, or (without effect) when armed already; `is_forced` skips the checks."""
        if self.is_armed:
            return ACCEPTED
        reasons = find_arming_refusals(
            self._profile, self.mode, self._parameters, self._estimator, self._vehicle.battery, at_ns - self._boot_ns
        )
        if self.lacks_stream(at_ns):
            reasons = (*reasons, "Arming denied: Resolve system health failures first")
        if reasons and not is_forced:
            self.status_texts.extend((CRITICAL, text.replace("PreArm: ", "Arm: ")) for text in reasons)
            return self._profile.refused_arming
        self.is_armed, self._armed_ns = True, at_ns
        self.home_m = self._estimator.position_m
        self._phase_end_ns, self._disarm_text = self._compute_disarm_ns(at_ns), self._profile.preflight_text
        self.status_texts.append((INFO, self._profile.armed_text))
        if self.mode.role is Role.TAKEOFF:
            self._start_climb(at_ns)
        return ACCEPTED

    def _compute_disarm_ns(self, at_ns: int) -> int | None:
        wait_s = self._parameters[self._profile.preflight_timeout_parameter]
        return at_ns + round(wait_s * 1e9) if wait_s > 0.0 else None

    def disarm(self) -> int:
        """Disarm, on the floor only."""
        if self.phase is not Phase.GROUND:
            self.status_texts.append((CRITICAL, "Disarming denied: not landed"))
            return self._profile.refused_disarming
        self._apply_disarming()
        return ACCEPTED

    def _apply_disarming(self) -> None:
        if self._profile.resumes_mode and (self.is_failsafe or self.mode.role in TRANSIENT_ROLES):
            self.mode = self._chosen_mode
        self.is_armed = self.is_failsafe = self._ends_with_setpoints = False
        self._phase_end_ns = self._liftoff_ns = None
        self._vehicle.stand_on_floor()

    @property
    def _height_m(self) -> float:
        """Height of a take-off above the floor [m]."""
        return self._parameters["MIS_TAKEOFF_ALT"] if self._takeoff_m is None else self._takeoff_m

    def take_off(self, height_m: float | None, at_ns: int) -> int:
        """Climb to a height above the floor [m]; PX4 changes to its take-off mode, ArduPilot stays GUIDED."""
        self._takeoff_m = height_m
        if self._profile.name == "px4":
            self._enter_mode(self._profile.get_mode_by_role(Role.TAKEOFF), at_ns)
        elif self.is_armed and self.phase is Phase.GROUND and self.mode.role is Role.EXTERNAL:
            self._start_climb(at_ns)
        else:
            return FAILED
        return ACCEPTED

    def change_mode(self, mode: Mode, at_ns: int, *, by_command: bool = False) -> int:
        """Change the mode; PX4's OFFBOARD needs a stream of setpoints before, and most modes a position.

        Args:
            by_command: by a command; else the pilot's switch moves.
        """
        if not by_command:
            self.has_radio, self.switch_us = True, SWITCH_US + SWITCH_STEP_US * (1 + self._profile.modes.index(mode))
        px4 = self._profile.name == "px4"
        if mode.needs_position and not self._estimator.is_position_valid and (self.is_armed or not px4):
            reason = "switching to this mode is currently not available" if px4 else f"{mode.name} requires position"
            self.status_texts.append((WARNING, f"Mode change failed: {reason}"))
            return TEMPORARILY_REJECTED if px4 else FAILED
        if mode.role is Role.EXTERNAL and self._profile.needs_stream and not self._has_stream(at_ns):
            self.status_texts.append((CRITICAL, "Switching to Offboard is currently not available"))
            return TEMPORARILY_REJECTED
        if mode.role is Role.TAKEOFF:
            self._takeoff_m = None
        self._enter_mode(mode, at_ns)
        return ACCEPTED

    def enter_failsafe(
        self, mode: Mode, at_ns: int, *, ends_with_setpoints: bool = False, is_shown: bool = True
    ) -> None:
        """Change the mode by a failsafe; with `ends_with_setpoints`, new setpoints end it.

        Args:
                is_shown: heartbeats show it.
        """
        chosen_mode = self._chosen_mode
        self._enter_mode(mode, at_ns)
        self._chosen_mode = chosen_mode  # the failsafe's mode is not a choice
        self.is_failsafe, self._ends_with_setpoints = is_shown, ends_with_setpoints

    def end_failsafe(self, mode: Mode, at_ns: int) -> None:
        """End a failsafe and return to the mode of before; a take-off goes on."""
        self._enter_mode(mode, at_ns)
        if mode.role is Role.TAKEOFF and self.phase is not Phase.CLIMB:
            self._start_climb(at_ns)

    def lacks_stream(self, at_ns: int) -> bool:
        """Return whether arming is refused: the mode is PX4's OFFBOARD, and no setpoints arrive."""
        return self.mode.role is Role.EXTERNAL and self._profile.needs_stream and not self._has_stream(at_ns)

    def _has_stream(self, at_ns: int) -> bool:
        limit_ns = min(MAX_SETPOINT_AGE_NS, round(self._parameters[self._profile.timeout_parameter] * 1e9))
        return self.setpoint_ns is not None and at_ns - self.setpoint_ns < limit_ns

    def _enter_mode(self, mode: Mode, at_ns: int) -> None:
        keeps_taking_off = self._liftoff_ns is not None and (mode is self.mode or mode.role is Role.TAKEOFF)
        self.mode = mode
        if mode.role not in TRANSIENT_ROLES:
            self._chosen_mode = mode
        self.is_failsafe = self._ends_with_setpoints = False
        if keeps_taking_off:
            return
        if self.phase is Phase.GROUND:
            if mode.role is Role.TAKEOFF and self.is_armed:
                self._start_climb(at_ns)
            return
        is_landing = mode.role is Role.LAND
        if self._liftoff_ns is not None:  # still on the floor: its rotors slow down again
            self._liftoff_ns, self.phase = None, Phase.GROUND
            self._phase_end_ns, self._disarm_text = self._compute_disarm_ns(at_ns), self._profile.preflight_text
            if is_landing:
                self._schedule_disarming(at_ns)
            return
        self.phase = Phase.DESCENT if is_landing else Phase.AIR
        self._phase_end_ns = at_ns + TIMED_PHASE_NS if is_landing and not self._has_down else None
        self._fly_phase(at_ns)

    def _start_climb(self, at_ns: int) -> None:
        """Take off: a quadrotor's rotors spin up first, the linear plant has none."""
        self.phase = Phase.CLIMB
        if self._takeoff_m is None and self._linear_plant is None:
            self.status_texts.append((INFO, f"Using default takeoff altitude: {self._height_m:.1f} m"))
        self._phase_end_ns = None if self._vehicle.has_down else at_ns + TIMED_PHASE_NS
        if self._linear_plant is None and self._vehicle.grounded:
            profile = self._profile
            self._liftoff_ns = max(
                self._armed_ns + round(profile.liftoff_s * 1e9), at_ns + round(profile.thrust_ramp_s * 1e9)
            )
        else:
            self._leave_floor(at_ns)

    def _leave_floor(self, at_ns: int) -> None:
        self._liftoff_ns = None
        if self._vehicle.grounded:
            self._vehicle.grounded = False
            if self._linear_plant is None and self._profile.takeoff_text:
                self.status_texts.append((INFO, self._profile.takeoff_text))
        self._fly_phase(at_ns)

    def _end_phase(self, at_ns: int) -> None:
        self._phase_end_ns = None
        if self.phase is Phase.GROUND:
            self.status_texts.append((INFO, self._disarm_text))
            self._apply_disarming()
        elif self.phase is Phase.CLIMB:
            self._complete_climb()
        else:
            self._complete_landing(at_ns)

    def _check_height(self, at_ns: int) -> None:
        self._check_ns = at_ns + CHECK_PERIOD_NS
        if self.phase is Phase.CLIMB:
            if self._estimator.position_m[2] <= TAKEOFF_TOLERANCE_M - self._height_m:
                self._complete_climb()
        elif self._vehicle.landed:
            self._detect_landing(at_ns)
        else:
            self._touchdown_ns = None

    def _complete_climb(self) -> None:
        """Change to the holding mode after a take-off in a take-off mode.

        As recorded: a PX4 with a global position does so. With only a local position it hovers in AUTO.TAKEOFF and
        reports a take-off until another mode is chosen.
        """
        if self.mode.role is Role.TAKEOFF and not self._estimator.has_global_position:
            return
        if self.mode.role is Role.TAKEOFF:
            self.mode = self._chosen_mode = self._profile.get_mode_by_role(Role.HOLD)
        self.is_failsafe = self._ends_with_setpoints = False
        self.phase = Phase.AIR  # and goes on to the height that it climbs to

    def _detect_landing(self, at_ns: int) -> None:
        """Report the landing some time after touchdown, as the autopilot of a quadrotor does."""
        if self._touchdown_ns is None:
            self._touchdown_ns = at_ns
            if self._linear_plant is None and self._profile.touch_text:
                self.status_texts.append((INFO, self._profile.touch_text))
        detection_ns = round(self._profile.landing_detection_s * 1e9) if self._linear_plant is None else 0
        if at_ns - self._touchdown_ns >= detection_ns:
            self._complete_landing(at_ns)

    def _complete_landing(self, at_ns: int) -> None:
        self._touchdown_ns = None
        if self._linear_plant is not None:  # its plant would fall through the floor
            self._vehicle.stand_on_floor()
        else:  # whatever the last setpoint was
            self._vehicle.land()
        self.phase = Phase.GROUND
        self.dispatch.active_setpoint = None
        self._schedule_disarming(at_ns)
        if self._profile.landed_text:
            self.status_texts.append((INFO, self._profile.landed_text))

    def _schedule_disarming(self, at_ns: int) -> None:
        delay_ns = round(self._profile.disarm_delay_s * 1e9)
        self._phase_end_ns, self._disarm_text = at_ns + delay_ns, self._profile.disarmed_text

    def _handle_setpoint_timeout(self, at_ns: int) -> None:
        if self._profile.name == "px4":
            action = self._parameters["COM_OBL_RC_ACT"]
            name = "AUTO.LAND" if action == LAND_ACTION else "POSCTL" if action < LAND_ACTION else "AUTO.LOITER"
            self.enter_failsafe(self._profile.get_mode(name), at_ns, ends_with_setpoints=True)
            self.status_texts.append((CRITICAL, "Failsafe activated"))
        else:
            self._fly_phase(at_ns)

    def _fly_phase(self, at_ns: int) -> None:
        """Fly the motion of the present phase."""
        self.dispatch.active_setpoint = None
        if self.phase is Phase.CLIMB:
            self._vehicle.take_off(self._height_m)
        elif self.phase is Phase.DESCENT:
            self._vehicle.land()
        else:
            self.dispatch.apply(STOP)
        if self._is_checking_height:
            self._check_height(at_ns)
