"""How a PX4 and an ArduCopter differ, as tables: modes, frames, answers, habits.

Mode numbers are the `custom_mode` of each autopilot's HEARTBEAT; base modes are those of recorded flights.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Literal

# MAVLink common: MAV_RESULT
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = 0, 1, 2, 3, 4


class Role(Enum):
    """What a mode means here."""

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


@dataclass(frozen=True)
class Personality:
    """One kind of autopilot."""

    name: Literal["px4", "ardupilot"]
    autopilot: int  # MAV_AUTOPILOT
    modes: tuple[Mode, ...]
    ground: str  # mode after boot
    frames: frozenset[int]  # MAV_FRAMEs in which an acceleration is taken (yaw and tilt are zero here)
    needs_stream: bool  # external mode is refused without setpoints
    leaves_on_silence: bool  # silence ends the external mode (else it brakes and stays)
    dies_of_nan: bool
    unknown_mode: int  # MAV_RESULT for a mode that it has not
    set_mode_ack: int  # command number that answers SET_MODE
    armed_text: str
    disarmed_text: str

    def mode(self, name: str) -> Mode:
        """The mode of this name."""
        return next(mode for mode in self.modes if mode.name == name)

    def by_role(self, role: Role) -> Mode:
        """The first mode of a role."""
        return next(mode for mode in self.modes if mode.role is role)

    def by_number(self, custom: int) -> Mode | None:
        """The mode with this custom_mode, None if there is none."""
        return next((mode for mode in self.modes if mode.custom == custom), None)


def px4_custom(main: int, sub: int) -> int:
    """PX4's custom_mode: main mode in bits 16-23, sub mode in bits 24-31."""
    return main << 16 | sub << 24


PX4 = Personality(
    name="px4",
    autopilot=12,
    modes=(
        Mode("OFFBOARD", px4_custom(6, 0), 17, Role.EXTERNAL),
        Mode("AUTO.LOITER", px4_custom(4, 3), 29, Role.HOLD),
        Mode("AUTO.TAKEOFF", px4_custom(4, 2), 29, Role.TAKEOFF),
        Mode("AUTO.LAND", px4_custom(4, 6), 29, Role.LAND),
        Mode("POSCTL", px4_custom(3, 0), 81, Role.HOLD),
    ),
    ground="AUTO.LOITER",
    frames=frozenset({1, 8}),
    needs_stream=True,
    leaves_on_silence=True,
    dies_of_nan=False,
    unknown_mode=DENIED,
    set_mode_ack=176,
    armed_text="Armed by external command",
    disarmed_text="Disarmed by landing",
)

ARDUPILOT = Personality(
    name="ardupilot",
    autopilot=3,
    modes=(
        Mode("GUIDED", 4, 89, Role.EXTERNAL),
        Mode("LOITER", 5, 89, Role.HOLD),
        Mode("LAND", 9, 89, Role.LAND),
        Mode("BRAKE", 17, 89, Role.HOLD),
        Mode("STABILIZE", 0, 81, Role.HOLD),
    ),
    ground="STABILIZE",
    frames=frozenset({1, 7, 8, 9}),
    needs_stream=False,
    leaves_on_silence=False,
    dies_of_nan=True,
    unknown_mode=FAILED,
    set_mode_ack=11,
    armed_text="Arming motors",
    disarmed_text="Disarming motors",
)

PERSONALITIES = {"px4": PX4, "ardupilot": ARDUPILOT}
