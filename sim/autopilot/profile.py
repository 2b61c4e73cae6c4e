"""Profiles of PX4 and ArduCopter as tables: modes, frames, answers, timing.

Mode numbers are the `custom_mode` of each autopilot's HEARTBEAT; base modes are those of recorded flights.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Literal

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4


class Role(Enum):
    """Role of a mode in the simulation."""

    EXTERNAL = auto()  # takes our setpoints
    HOLD = auto()  # brakes and waits
    TAKEOFF = auto()
    LAND = auto()


@dataclass(frozen=True)
class Mode:
    """A flight mode; `base` is its base_mode while disarmed."""

    name: str
    custom: int
    base: int
    role: Role
    needs_position: bool = True


@dataclass(frozen=True)
class SimulatedProfile:
    """Profile of one kind of autopilot: modes, parameters, timing."""

    name: Literal["px4", "ardupilot"]
    autopilot: int  # MAV_AUTOPILOT
    modes: tuple[Mode, ...]
    initial_mode: str  # mode after boot
    frames: frozenset[int]  # MAV_FRAMEs in which setpoints are taken
    needs_stream: bool  # external mode is refused without setpoints
    timeout_parameter: str  # parameter with the silence [s] after which setpoints have stopped
    preflight_timeout_parameter: (
        str  # parameter with the time [s] after which it disarms itself if it does not take off
    )
    refused_arming: int  # MAV_RESULT
    refused_disarming: int  # MAV_RESULT
    unknown_mode: int  # MAV_RESULT for an unknown mode
    set_mode_ack: int  # command number that answers SET_MODE
    armed_text: str
    disarmed_text: str
    preflight_text: str  # when it disarms itself before take-off
    landed_text: str  # empty: none
    takeoff_text: str  # at the detected take-off; empty: none
    touch_text: str  # its simulator's, at touchdown; empty: none
    liftoff_s: float  # from arming to the thrust that lifts: rotors spin up, thrust ramps
    thrust_ramp_s: float  # the same from the order, armed for long
    landing_detection_s: float  # from standing on the floor to knowing it
    disarm_delay_s: float  # from knowing it to disarming
    resumes_mode: bool  # a landing or a failsafe that ended with disarming leaves the mode of before
    good_flags: int  # ESTIMATOR_STATUS_FLAGS of a good estimate, as recorded in flight
    vtol_state: int  # of EXTENDED_SYS_STATE
    version: int  # flight_sw_version of AUTOPILOT_VERSION
    origin_deg_m: tuple[float, float, float]  # latitude, longitude, altitude of its simulated field
    has_radio: bool  # whether its simulator has a remote control, as in SYS_STATUS of the recorded flights
    greeting: tuple[bytes, ...]  # text on a TCP link, before its first packet and between that and the second

    def get_mode(self, name: str) -> Mode:
        """Return the mode of this name."""
        return next(mode for mode in self.modes if mode.name == name)

    def get_mode_by_role(self, role: Role) -> Mode:
        """Return the first mode of a role."""
        return next(mode for mode in self.modes if mode.role is role)

    def get_mode_by_number(self, custom: int) -> Mode | None:
        """Return the mode with this custom_mode; None if there is none."""
        return next((mode for mode in self.modes if mode.custom == custom), None)


def make_px4_custom_mode(main: int, sub: int) -> int:
    """Return PX4's custom_mode: main mode in bits 16-23, sub mode in bits 24-31."""
    return main << 16 | sub << 24


PX4 = SimulatedProfile(
    name="px4",
    autopilot=12,
    modes=(
        Mode("OFFBOARD", make_px4_custom_mode(6, 0), 17, Role.EXTERNAL),
        Mode("AUTO.LOITER", make_px4_custom_mode(4, 3), 29, Role.HOLD),
        Mode("AUTO.TAKEOFF", make_px4_custom_mode(4, 2), 29, Role.TAKEOFF),
        Mode("AUTO.LAND", make_px4_custom_mode(4, 6), 29, Role.LAND, needs_position=False),
        Mode("POSCTL", make_px4_custom_mode(3, 0), 81, Role.HOLD),
        Mode("AUTO.RTL", make_px4_custom_mode(4, 5), 29, Role.LAND),  # its home is below: it goes down where it is
        Mode("AUTO.DESCEND", make_px4_custom_mode(4, 20), 29, Role.LAND, needs_position=False),
    ),
    initial_mode="AUTO.LOITER",
    frames=frozenset({1, 8}),
    needs_stream=True,
    timeout_parameter="COM_OF_LOSS_T",
    preflight_timeout_parameter="COM_DISARM_PRFLT",
    refused_arming=TEMPORARILY_REJECTED,
    refused_disarming=DENIED,
    unknown_mode=DENIED,
    set_mode_ack=176,
    armed_text="Armed by external command",
    disarmed_text="Disarmed by landing",
    preflight_text="Disarmed by auto preflight disarming",
    landed_text="Landing detected",
    takeoff_text="Takeoff detected",
    touch_text="",
    liftoff_s=3.8,
    thrust_ramp_s=3.0,
    landing_detection_s=1.9,
    disarm_delay_s=2.0,
    resumes_mode=True,
    good_flags=0x37F,
    vtol_state=0,
    version=0x01080000,
    origin_deg_m=(47.397742, 8.545594, 488.0),
    has_radio=False,
    greeting=(),
)

ARDUPILOT = SimulatedProfile(
    name="ardupilot",
    autopilot=3,
    modes=(
        Mode("GUIDED", 4, 89, Role.EXTERNAL),
        Mode("LOITER", 5, 89, Role.HOLD),
        Mode("LAND", 9, 89, Role.LAND, needs_position=False),
        Mode("BRAKE", 17, 89, Role.HOLD),
        Mode("STABILIZE", 0, 81, Role.HOLD, needs_position=False),
        Mode("RTL", 6, 89, Role.LAND),  # its home is below: it goes down where it is
    ),
    initial_mode="STABILIZE",
    frames=frozenset({1, 7, 8, 9}),
    needs_stream=False,
    timeout_parameter="GUID_TIMEOUT",
    preflight_timeout_parameter="DISARM_DELAY",
    refused_arming=FAILED,
    refused_disarming=FAILED,
    unknown_mode=FAILED,
    set_mode_ack=11,
    armed_text="Arming motors",
    disarmed_text="Disarming motors",
    preflight_text="Disarming motors",
    landed_text="",
    takeoff_text="",
    touch_text="SIM Hit ground at 0.500000 m/s",
    liftoff_s=3.4,
    thrust_ramp_s=0.8,
    landing_detection_s=0.0,
    disarm_delay_s=1.65,
    resumes_mode=False,
    good_flags=0x33F,
    vtol_state=3,
    version=0x040602FF,
    origin_deg_m=(-35.363262, 149.165237, 584.0),
    has_radio=True,
    greeting=(b"\n\nInit ArduCopter V4.6.2 (simulated)\n\nFree RAM: 131072\n", b"parameters loaded\nready to fly\n"),
)

SIMULATED = {"px4": PX4, "ardupilot": ARDUPILOT}
