"""What the simulated autopilot decides: modes, arming, phases of flight, and whose acceleration is flown.

No bytes here: `autopilot.py` translates. There is no free fall, so disarming in the air is refused,
forced or not.
"""

from __future__ import annotations

from enum import Enum

from sim.personality import ACCEPTED, DENIED, FAILED, TEMPORARILY_REJECTED, Mode, Personality, Role
from sim.steering import BRAKE_MPS2, brake, climb, descend
from sim.vehicle import Vehicle
from uavctl.data import Vec3

SECOND_NS = 1_000_000_000
STEER_NS = 20_000_000  # period of the vehicle's own braking, climbing and landing
STREAM_NS = SECOND_NS // 2  # PX4: setpoints must come faster than 2 Hz before OFFBOARD
DISARM_NS = 2 * SECOND_NS  # from touching the floor to disarming
NO_DOWN_NS = 5 * SECOND_NS  # length of a take-off or landing of a plant that has no vertical axis
TAKEOFF_HEIGHT_M = 2.5  # PX4's MIS_TAKEOFF_ALT
TAKEOFF_DONE_M = 0.1
CRASHED = "CRASHED"
CRITICAL, WARNING, INFO = 2, 4, 6  # MAV_SEVERITY


class Phase(Enum):
    """Where the vehicle is; the value is EXTENDED_SYS_STATE's MAV_LANDED_STATE."""

    GROUND = 1
    AIR = 2
    CLIMB = 3
    DESCENT = 4


class Pilot:
    """State machine of one vehicle, of the kind given.

    With `airborne` it starts armed, flying and in its external mode; the setpoint timeout then counts
    from the first setpoint. Else it stands on the floor, disarmed.

    Attributes:
        texts: (severity, text) of what is to be said, in order; the caller empties it.
        crashed: why the autopilot's program died, None while it lives.
        failsafe: whether the external mode was lost to silence.
    """

    def __init__(self, kind: Personality, vehicle: Vehicle, start_ns: int, *, timeout_ns: int, airborne: bool) -> None:
        self._kind = kind
        self._vehicle = vehicle
        self._timeout_ns = timeout_ns
        self._steer_ns = start_ns
        self._phase_end_ns: int | None = None  # end of a timed climb or descent, or of the wait for disarming
        self._takeoff_m = TAKEOFF_HEIGHT_M
        self._setpoints_ns: tuple[int | None, int | None] = (None, None)  # the last but one, the last
        self._accel: Vec3 | None = (0.0, 0.0, 0.0) if airborne else None  # None: its own law
        self.texts: list[tuple[int, str]] = []
        self.crashed: str | None = None
        self.failsafe = False
        self.armed = airborne
        self.phase = Phase.AIR if airborne else Phase.GROUND
        self.mode: Mode = kind.by_role(Role.EXTERNAL) if airborne else kind.mode(kind.ground)
        if not airborne:
            vehicle.rest()

    @property
    def external(self) -> bool:
        """Whether setpoints are flown."""
        return self.mode.role is Role.EXTERNAL and self.armed and self.phase is Phase.AIR

    @property
    def _steers(self) -> bool:
        """Whether the vehicle finds its acceleration by itself."""
        return self.phase is not Phase.GROUND and not (self.external and self._accel is not None)

    @property
    def _deadline_ns(self) -> int | None:
        """When silence has lasted too long; None when it does not matter."""
        last_ns = self._setpoints_ns[1]
        matters = self.external and (self._accel is not None or self._kind.leaves_on_silence)
        return last_ns + self._timeout_ns if matters and last_ns is not None else None

    @property
    def next_ns(self) -> int | None:
        """Time of the next thing to do of itself [ns]."""
        times = [at_ns for at_ns in (self._phase_end_ns, self._deadline_ns) if at_ns is not None]
        if self._steers:
            times.append(self._steer_ns)
        return min(times, default=None)

    def run(self, at_ns: int) -> None:
        """Do what is due at `at_ns`, the vehicle being there."""
        if self._deadline_ns is not None and self._deadline_ns <= at_ns:
            self._on_silence(at_ns)
        if self._phase_end_ns is not None and self._phase_end_ns <= at_ns:
            self._end_phase(at_ns)
        if self._steers and self._steer_ns <= at_ns:
            self._steer(at_ns)

    def setpoint(self, accel: Vec3 | None, at_ns: int) -> None:
        """Take a setpoint; None is one that asks for nothing flyable, on which the vehicle stops."""
        self._setpoints_ns = (self._setpoints_ns[1], at_ns)
        if self.failsafe:  # as recorded: setpoints that come again end PX4's failsafe by themselves
            self._enter(self._kind.by_role(Role.EXTERNAL), at_ns)
        if self.external:
            self._obey(accel, at_ns)

    def crash(self, why: str) -> None:
        """The autopilot's program dies; nothing is decided, said or answered from now on."""
        self.crashed = why
        self._vehicle.accelerate((0.0, 0.0, 0.0))

    # Commands, each giving a MAV_RESULT

    def arm(self, at_ns: int) -> int:
        """Arm, on the floor or (without effect) when armed already."""
        if not self.armed:
            self.armed = True
            self._phase_end_ns = None
            self.texts.append((INFO, self._kind.armed_text))
            if self.mode.role is Role.TAKEOFF:
                self._climb(at_ns)
        return ACCEPTED

    def disarm(self) -> int:
        """Disarm, on the floor only."""
        if self.phase is not Phase.GROUND:
            self.texts.append((CRITICAL, "Disarming denied: not landed"))
            return FAILED if self._kind.name == "ardupilot" else DENIED
        self.armed = False
        self._phase_end_ns = None
        return ACCEPTED

    def take_off(self, height_m: float | None, at_ns: int) -> int:
        """Climb to a height above the floor [m]; PX4 changes to its take-off mode, ArduPilot stays GUIDED."""
        self._takeoff_m = TAKEOFF_HEIGHT_M if height_m is None else height_m
        if self._kind.name == "px4":
            self._enter(self._kind.by_role(Role.TAKEOFF), at_ns)
        elif self.armed and self.phase is Phase.GROUND and self.mode.role is Role.EXTERNAL:
            self._climb(at_ns)
        else:
            return FAILED
        return ACCEPTED

    def change(self, mode: Mode, at_ns: int) -> int:
        """Change the mode; PX4's OFFBOARD needs a stream of setpoints before."""
        if mode.role is Role.EXTERNAL and self._kind.needs_stream and not self._streaming(at_ns):
            self.texts.append((CRITICAL, "OFFBOARD refused: no setpoints above 2 Hz"))
            return TEMPORARILY_REJECTED
        self._enter(mode, at_ns)
        return ACCEPTED

    def _streaming(self, at_ns: int) -> bool:
        before_ns, last_ns = self._setpoints_ns
        if before_ns is None or last_ns is None:
            return False
        return last_ns - before_ns < STREAM_NS and at_ns - last_ns < STREAM_NS

    # Modes and phases

    def _enter(self, mode: Mode, at_ns: int) -> None:
        self.mode = mode
        self.failsafe = False
        if self.phase is Phase.GROUND:
            if mode.role is Role.TAKEOFF and self.armed:
                self._climb(at_ns)
            return
        lands = mode.role is Role.LAND
        self.phase = Phase.DESCENT if lands else Phase.AIR
        self._phase_end_ns = at_ns + NO_DOWN_NS if lands and not self._vehicle.has_down else None
        self._obey(None, at_ns)

    def _climb(self, at_ns: int) -> None:
        self._vehicle.grounded = False
        self.phase = Phase.CLIMB
        self._phase_end_ns = None if self._vehicle.has_down else at_ns + NO_DOWN_NS
        self._obey(None, at_ns)

    def _end_phase(self, at_ns: int) -> None:
        self._phase_end_ns = None
        if self.phase is Phase.GROUND:
            self.armed = False
            self.texts.append((INFO, self._kind.disarmed_text))
        elif self.phase is Phase.CLIMB:
            self._climbed(at_ns)
        else:
            self._touch(at_ns)

    def _climbed(self, at_ns: int) -> None:
        self._enter(self._kind.by_role(Role.HOLD) if self.mode.role is Role.TAKEOFF else self.mode, at_ns)

    def _touch(self, at_ns: int) -> None:
        self._vehicle.rest()
        self.phase = Phase.GROUND
        self._phase_end_ns = at_ns + DISARM_NS
        self.texts.append((INFO, "Landing detected"))

    def _on_silence(self, at_ns: int) -> None:
        if self._kind.leaves_on_silence:
            self._enter(self._kind.by_role(Role.HOLD), at_ns)
            self.failsafe = True
            self.texts.append((CRITICAL, "Failsafe activated"))
        else:
            self._obey(None, at_ns)

    # Motion

    def _obey(self, accel: Vec3 | None, at_ns: int) -> None:
        """Fly this acceleration, or with None what the vehicle finds by itself."""
        self._accel = accel
        if accel is None:
            self._steer(at_ns)
        else:
            self._vehicle.accelerate(accel)

    def _steer(self, at_ns: int) -> None:
        self._steer_ns = at_ns + STEER_NS
        where, speed = self._vehicle.position_m, self._vehicle.velocity_mps
        north, east, down = brake(speed, BRAKE_MPS2)
        if self.phase is Phase.CLIMB and self._vehicle.has_down:
            if where[2] <= TAKEOFF_DONE_M - self._takeoff_m:
                self._climbed(at_ns)
                return
            down = climb(where[2], speed[2], -self._takeoff_m)
        elif self.phase is Phase.DESCENT and self._vehicle.has_down:
            if where[2] >= 0.0:
                self._touch(at_ns)
                return
            down = descend(speed[2])
        self._vehicle.accelerate((north, east, down))
