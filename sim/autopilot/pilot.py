"""Pilot of the simulated autopilot: modes, arming, phases of flight, and whose setpoint is flown.

No bytes here: `autopilot.py` translates. There is no free fall, so disarming in the air is refused,
forced or not.
"""

from __future__ import annotations

import math
from enum import Enum

from sim.autopilot.estimator import Estimator
from sim.autopilot.profile import (
    ACCEPTED,
    FAILED,
    STOP,
    TEMPORARILY_REJECTED,
    Mode,
    Parameters,
    ParsedSetpoint,
    Role,
    SetpointKind,
    SimulatedProfile,
)
from sim.channel import earliest
from sim.vehicle.interface import SteeredPlant, Supply, Vehicle
from uavctl.records import Vec3

# Arming checks: why a vehicle will not arm, in the words of each autopilot.


# ArduCopter with external positions only: seen to be ready so long after boot, the estimator long before.
READY_NS = 24_000_000_000


def reasons(
    kind: SimulatedProfile, mode: Mode, parameters: Parameters, estimator: Estimator, battery: Supply, boot_age_ns: int
) -> tuple[str, ...]:
    """Return the reasons against arming as texts of STATUSTEXT; none if it may arm."""
    found = list(preflight(kind, parameters, estimator, battery, boot_age_ns))
    if mode.role is Role.LAND:
        found.append(
            "Arming denied: switch out of the landing mode" if kind.name == "px4" else "Arm: Land mode not armable"
        )
    return tuple(found)


def preflight(
    kind: SimulatedProfile, parameters: Parameters, estimator: Estimator, battery: Supply, boot_age_ns: int
) -> tuple[str, ...]:
    """Return the reasons against arming in any mode; without any, SYS_STATUS has its pre-arm bit set."""
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


# From a setpoint to what is asked of the craft, and where its nose points.


NOSE_MPS = 0.5  # ArduPilot: the nose follows travel from this speed on


class SetpointDispatch:
    """Passes setpoints on to the craft.

    Attributes:
        obeyed: the setpoint that is flown, None if the vehicle flies by itself.
    """

    def __init__(
        self,
        kind: SimulatedProfile,
        craft: Vehicle,
        parameters: Parameters,
        estimator: Estimator,
        obeyed: ParsedSetpoint | None,
    ) -> None:
        self._ardupilot = kind.name == "ardupilot"
        self._craft = craft
        self._parameters = parameters
        self._estimator = estimator
        self.obeyed = obeyed

    def obey(self, setpoint: ParsedSetpoint) -> None:
        """Fly a setpoint; one that asks for nothing flyable stops the vehicle."""
        self.obeyed = None if setpoint.ask is SetpointKind.STOP else setpoint
        match setpoint.ask:
            case SetpointKind.ACCELERATION:
                self._craft.accelerate(setpoint.vector)
            case SetpointKind.VELOCITY:
                self._craft.fly(setpoint.vector)
            case SetpointKind.POSITION if setpoint.velocity_mps is not None:
                self._craft.follow(setpoint.vector, setpoint.velocity_mps, setpoint.accel_mps2)
            case SetpointKind.POSITION:
                self._craft.go_to(setpoint.vector)
            case _:
                self._craft.brake()
        self._point_nose(setpoint)

    def _point_nose(self, setpoint: ParsedSetpoint) -> None:
        """Turn to the heading asked for; without one ArduPilot looks along its way, and PX4 stays as it is."""
        north, east, _ = self._estimator.velocity_mps
        if setpoint.yaw_rad is not None:
            self._craft.face(setpoint.yaw_rad)
        elif self._ardupilot and self._parameters["WP_YAW_BEHAVIOR"] != 0 and math.hypot(north, east) > NOSE_MPS:
            self._craft.face(math.atan2(east, north))


SECOND_NS = 1_000_000_000
WATCH_NS = 20_000_000  # how often height and floor are looked at
# PX4 takes OFFBOARD while the newest setpoint is younger than COM_OF_LOSS_T; its documentation asks for 2 Hz, so here
# never longer than that.
FRESH_NS = SECOND_NS // 2
NO_DOWN_NS = 5 * SECOND_NS  # length of a take-off or landing of a plant that has no vertical axis
TAKEOFF_DONE_M = 0.1
PASSING = frozenset({Role.TAKEOFF, Role.LAND})  # modes that end by themselves
LANDS = 4  # COM_OBL_RC_ACT; less leaves it to the stick
CRASHED = "CRASHED"
CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY
SWITCH_US, SWITCH_STEP_US = 1000, 120  # of the switch of modes: before it was moved, and from mode to mode
FORCED = 21196.0  # param2 of arming that skips the checks


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
        texts: (severity, text) of what is to be said, in order; the caller empties it.
        crashed: why the autopilot's program died, None while it lives.
        failsafe: whether a failsafe chose the mode.
        breaches: whether it is beyond its fence.
        radio: whether it hears a remote control.
        switch_us: where that one's switch of modes stands [µs].
        helm: knows which setpoint is flown.
        setpoint_ns: when the last setpoint that counts came [ns], None before the first.
        home_m: where it was armed last, local NED.
    """

    def __init__(
        self,
        kind: SimulatedProfile,
        craft: Vehicle,
        parameters: Parameters,
        estimator: Estimator,
        boot_ns: int,
        *,
        airborne: bool,
        radio: bool,
    ) -> None:
        self._kind = kind
        self._craft = craft
        self._steered = craft if isinstance(craft, SteeredPlant) else None
        self._parameters = parameters
        self._estimator = estimator
        self._boot_ns = boot_ns
        self.radio = radio
        self.switch_us = SWITCH_US
        self._watch_ns = craft.now_ns
        self._phase_end_ns: int | None = None  # end of a timed climb or descent, or of the wait for disarming
        self._disarm_text = kind.preflight_text
        self._takeoff_m: float | None = None  # height that was asked for; without, PX4 has its own
        self._armed_ns = craft.now_ns
        self._lift_ns: int | None = None  # when it leaves the floor, while rotors spin up
        self._stood_ns: int | None = None  # since when it stands on the floor without knowing it
        self.setpoint_ns: int | None = None
        self._returns = False  # whether setpoints that come again end the failsafe
        self.texts: list[tuple[int, str]] = []
        self.crashed: str | None = None
        self.failsafe = self.breaches = False
        self.armed = airborne
        self.phase = Phase.AIR if airborne else Phase.GROUND
        self.mode: Mode = kind.by_role(Role.EXTERNAL) if airborne else kind.mode(kind.ground)
        self._meant: Mode = self.mode  # the last one that somebody chose which is neither a take-off nor a landing
        flown = ParsedSetpoint(SetpointKind.ACCELERATION) if airborne else None
        self.helm = SetpointDispatch(kind, craft, parameters, estimator, flown)
        self.home_m: Vec3 = (0.0, 0.0, 0.0)
        if not airborne:
            craft.rest()

    @property
    def external(self) -> bool:
        """Whether setpoints are flown."""
        return self.mode.role is Role.EXTERNAL and self.armed and self.phase is Phase.AIR

    @property
    def _deadline_ns(self) -> int | None:
        """Time at which silence has lasted too long [ns]; None when it does not matter."""
        last_ns = self.setpoint_ns
        if last_ns is None or not self.external:
            return None
        if self._kind.name == "px4":
            if self._parameters["COM_OBL_RC_ACT"] < LANDS and not self.radio:  # seen to go on as if nothing were
                return None
        elif self.helm.obeyed is None or self.helm.obeyed.ask is SetpointKind.POSITION:  # a position is kept
            return None
        return last_ns + max(round(self._parameters[self._kind.timeout] * 1e9), 0)

    @property
    def next_ns(self) -> int | None:
        """Time at which it next acts by itself [ns]."""
        watch_ns = self._watch_ns if self._watches else None
        steered_ns = None if self._steered is None else self._steered.next_ns
        return earliest((self._phase_end_ns, self._deadline_ns, watch_ns, steered_ns, self._lift_ns))

    @property
    def _watches(self) -> bool:
        """Whether floor or height are watched; the linear plant may fly through the floor."""
        looks = (Phase.CLIMB, Phase.DESCENT) if self._steered is not None else (Phase.CLIMB, Phase.DESCENT, Phase.AIR)
        return self.phase in looks and self._craft.has_down

    def run(self, at_ns: int) -> None:
        """Act on everything due at `at_ns`, with the vehicle moved there."""
        if self._deadline_ns is not None and self._deadline_ns <= at_ns:
            self._on_silence(at_ns)
        if self._lift_ns is not None and self._lift_ns <= at_ns:
            self._lift(at_ns)
        if self._phase_end_ns is not None and self._phase_end_ns <= at_ns:
            self._end_phase(at_ns)
        if self._watches and self._watch_ns <= at_ns:
            self._watch(at_ns)
        steered = self._steered
        if steered is not None and steered.next_ns is not None and steered.next_ns <= at_ns:
            steered.steer()

    def setpoint(self, setpoint: ParsedSetpoint, at_ns: int) -> None:
        """Take a setpoint of a kind that counts for the stream."""
        if setpoint.ask is SetpointKind.FATAL:
            if self.external:
                self.crash("a setpoint was not a number")
            return
        self.setpoint_ns = at_ns
        if self._returns:  # as recorded: setpoints that come again end PX4's failsafe by themselves
            self._enter(self._kind.by_role(Role.EXTERNAL), at_ns)
        if self.external:
            self.helm.obey(setpoint)

    def crash(self, why: str) -> None:
        """Stop the autopilot's program: nothing is decided, said or answered from now on."""
        self.crashed = why
        self._craft.accelerate((0.0, 0.0, 0.0))

    # Commands, each giving a MAV_RESULT

    def arm(self, at_ns: int, *, forced: bool = False) -> int:
        """Arm on the floor, or (without effect) when armed already; `forced` skips the checks."""
        if self.armed:
            return ACCEPTED
        why = reasons(
            self._kind, self.mode, self._parameters, self._estimator, self._craft.battery, at_ns - self._boot_ns
        )
        if self.lacks_stream(at_ns):
            why = (*why, "Arming denied: Resolve system health failures first")
        if why and not forced:
            self.texts.extend((CRITICAL, text.replace("PreArm: ", "Arm: ")) for text in why)
            return self._kind.refused_arming
        self.armed, self._armed_ns = True, at_ns
        self.home_m = self._estimator.position_m
        self._phase_end_ns, self._disarm_text = self._self_disarm_ns(at_ns), self._kind.preflight_text
        self.texts.append((INFO, self._kind.armed_text))
        if self.mode.role is Role.TAKEOFF:
            self._climb(at_ns)
        return ACCEPTED

    def _self_disarm_ns(self, at_ns: int) -> int | None:
        wait_s = self._parameters[self._kind.preflight_timeout]
        return at_ns + round(wait_s * 1e9) if wait_s > 0.0 else None

    def disarm(self) -> int:
        """Disarm, on the floor only."""
        if self.phase is not Phase.GROUND:
            self.texts.append((CRITICAL, "Disarming denied: not landed"))
            return self._kind.refused_disarming
        self._disarm()
        return ACCEPTED

    def _disarm(self) -> None:
        if self._kind.resumes_mode and (self.failsafe or self.mode.role in PASSING):
            self.mode = self._meant
        self.armed = self.failsafe = self._returns = False
        self._phase_end_ns = self._lift_ns = None
        self._craft.rest()

    @property
    def _height_m(self) -> float:
        """Height of a take-off above the floor [m]."""
        return self._parameters["MIS_TAKEOFF_ALT"] if self._takeoff_m is None else self._takeoff_m

    def take_off(self, height_m: float | None, at_ns: int) -> int:
        """Climb to a height above the floor [m]; PX4 changes to its take-off mode, ArduPilot stays GUIDED."""
        self._takeoff_m = height_m
        if self._kind.name == "px4":
            self._enter(self._kind.by_role(Role.TAKEOFF), at_ns)
        elif self.armed and self.phase is Phase.GROUND and self.mode.role is Role.EXTERNAL:
            self._climb(at_ns)
        else:
            return FAILED
        return ACCEPTED

    def change(self, mode: Mode, at_ns: int, *, ordered: bool = False) -> int:
        """Change the mode; PX4's OFFBOARD needs a stream of setpoints before, and most modes a position.

        Args:
            ordered: by a command; else the pilot's switch moves.
        """
        if not ordered:
            self.radio, self.switch_us = True, SWITCH_US + SWITCH_STEP_US * (1 + self._kind.modes.index(mode))
        px4 = self._kind.name == "px4"
        if mode.needs_position and not self._estimator.position_ok and (self.armed or not px4):
            what = "switching to this mode is currently not available" if px4 else f"{mode.name} requires position"
            self.texts.append((WARNING, f"Mode change failed: {what}"))
            return TEMPORARILY_REJECTED if px4 else FAILED
        if mode.role is Role.EXTERNAL and self._kind.needs_stream and not self._streaming(at_ns):
            self.texts.append((CRITICAL, "Switching to Offboard is currently not available"))
            return TEMPORARILY_REJECTED
        if mode.role is Role.TAKEOFF:
            self._takeoff_m = None
        self._enter(mode, at_ns)
        return ACCEPTED

    def fail(self, mode: Mode, at_ns: int, *, returns: bool = False, shown: bool = True) -> None:
        """Change the mode by a failsafe; with `returns`, setpoints that come again end it.

        Args:
            shown: heartbeats show it.
        """
        meant = self._meant
        self._enter(mode, at_ns)
        self._meant = meant  # nobody chose this one
        self.failsafe, self._returns = shown, returns

    def recover(self, mode: Mode, at_ns: int) -> None:
        """End a failsafe and return to the mode of before; a take-off goes on."""
        self._enter(mode, at_ns)
        if mode.role is Role.TAKEOFF and self.phase is not Phase.CLIMB:
            self._climb(at_ns)

    def lacks_stream(self, at_ns: int) -> bool:
        """Return whether arming is refused because the mode is PX4's OFFBOARD and nobody sends setpoints."""
        return self.mode.role is Role.EXTERNAL and self._kind.needs_stream and not self._streaming(at_ns)

    def _streaming(self, at_ns: int) -> bool:
        limit_ns = min(FRESH_NS, round(self._parameters[self._kind.timeout] * 1e9))
        return self.setpoint_ns is not None and at_ns - self.setpoint_ns < limit_ns

    # Modes and phases

    def _enter(self, mode: Mode, at_ns: int) -> None:
        lifts = self._lift_ns is not None and (mode is self.mode or mode.role is Role.TAKEOFF)
        self.mode = mode
        if mode.role not in PASSING:
            self._meant = mode
        self.failsafe = self._returns = False
        if lifts:
            return
        if self.phase is Phase.GROUND:
            if mode.role is Role.TAKEOFF and self.armed:
                self._climb(at_ns)
            return
        lands = mode.role is Role.LAND
        if self._lift_ns is not None:  # still on the floor: its rotors slow down again
            self._lift_ns, self.phase = None, Phase.GROUND
            self._phase_end_ns, self._disarm_text = self._self_disarm_ns(at_ns), self._kind.preflight_text
            if lands:
                self._know_the_floor(at_ns)
            return
        self.phase = Phase.DESCENT if lands else Phase.AIR
        self._phase_end_ns = at_ns + NO_DOWN_NS if lands and not self._craft.has_down else None
        self._fly_itself(at_ns)

    def _climb(self, at_ns: int) -> None:
        """Take off: a quadrotor's rotors spin up first, the linear plant has none."""
        self.phase = Phase.CLIMB
        if self._takeoff_m is None and self._steered is None:
            self.texts.append((INFO, f"Using default takeoff altitude: {self._height_m:.1f} m"))
        self._phase_end_ns = None if self._craft.has_down else at_ns + NO_DOWN_NS
        if self._steered is None and self._craft.grounded:
            kind = self._kind
            self._lift_ns = max(self._armed_ns + round(kind.lifts_s * 1e9), at_ns + round(kind.ramps_s * 1e9))
        else:
            self._lift(at_ns)

    def _lift(self, at_ns: int) -> None:
        self._lift_ns = None
        if self._craft.grounded:
            self._craft.grounded = False
            if self._steered is None and self._kind.takeoff_text:
                self.texts.append((INFO, self._kind.takeoff_text))
        self._fly_itself(at_ns)

    def _end_phase(self, at_ns: int) -> None:
        self._phase_end_ns = None
        if self.phase is Phase.GROUND:
            self.texts.append((INFO, self._disarm_text))
            self._disarm()
        elif self.phase is Phase.CLIMB:
            self._climbed()
        else:
            self._touch(at_ns)

    def _watch(self, at_ns: int) -> None:
        self._watch_ns = at_ns + WATCH_NS
        if self.phase is Phase.CLIMB:
            if self._estimator.position_m[2] <= TAKEOFF_DONE_M - self._height_m:
                self._climbed()
        elif self._craft.landed:
            self._settle(at_ns)
        else:
            self._stood_ns = None

    def _climbed(self) -> None:
        """Go on to the mode that holds after a take-off by a mode of its own.

        As recorded: a PX4 that knows latitude and longitude does so; one that has only a local position hovers in
        AUTO.TAKEOFF, and tells that it takes off, until somebody chooses another mode.
        """
        if self.mode.role is Role.TAKEOFF and not self._estimator.geographic:
            return
        if self.mode.role is Role.TAKEOFF:
            self.mode = self._meant = self._kind.by_role(Role.HOLD)
        self.failsafe = self._returns = False
        self.phase = Phase.AIR  # and goes on to the height that it climbs to

    def _settle(self, at_ns: int) -> None:
        """Report the landing some time after touchdown, as the autopilot of a quadrotor does."""
        if self._stood_ns is None:
            self._stood_ns = at_ns
            if self._steered is None and self._kind.touch_text:
                self.texts.append((INFO, self._kind.touch_text))
        settles_ns = round(self._kind.settles_s * 1e9) if self._steered is None else 0
        if at_ns - self._stood_ns >= settles_ns:
            self._touch(at_ns)

    def _touch(self, at_ns: int) -> None:
        self._stood_ns = None
        if self._steered is not None:  # its plant would fall through the floor
            self._craft.rest()
        else:  # whatever it was told to fly
            self._craft.land()
        self.phase = Phase.GROUND
        self.helm.obeyed = None
        self._know_the_floor(at_ns)
        if self._kind.landed_text:
            self.texts.append((INFO, self._kind.landed_text))

    def _know_the_floor(self, at_ns: int) -> None:
        disarms_ns = round(self._kind.disarms_s * 1e9)
        self._phase_end_ns, self._disarm_text = at_ns + disarms_ns, self._kind.disarmed_text

    def _on_silence(self, at_ns: int) -> None:
        if self._kind.name == "px4":
            act = self._parameters["COM_OBL_RC_ACT"]
            name = "AUTO.LAND" if act == LANDS else "POSCTL" if act < LANDS else "AUTO.LOITER"
            self.fail(self._kind.mode(name), at_ns, returns=True)
            self.texts.append((CRITICAL, "Failsafe activated"))
        else:
            self._fly_itself(at_ns)

    def _fly_itself(self, at_ns: int) -> None:
        """Fly as the phase asks for."""
        self.helm.obeyed = None
        if self.phase is Phase.CLIMB:
            self._craft.take_off(self._height_m)
        elif self.phase is Phase.DESCENT:
            self._craft.land()
        else:
            self.helm.obey(STOP)
        if self._watches:
            self._watch(at_ns)
