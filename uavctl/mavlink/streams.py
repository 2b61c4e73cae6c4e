"""What a real vehicle has to be asked for, or told, before it can be flown: its streams, and a place on the globe."""

from __future__ import annotations

from uavctl.mavlink.messages import Attitude, Battery, Inertial, Landed, Message, Origin, ParamValue, Position

SECOND_NS = 1_000_000_000
SETTLE_NS = 2 * SECOND_NS  # many vehicles stream by themselves
AGAIN_NS = 2 * SECOND_NS
TRIES = 5
ORIGIN_TRIES = 30  # once a second: its estimator may take that long to begin

LOCAL_POSITION_NED, ATTITUDE, EXTENDED_SYS_STATE, SYS_STATUS = 32, 30, 245, 1
ATTITUDE_QUATERNION, HIGHRES_IMU, RAW_IMU = 31, 105, 27
GPS_GLOBAL_ORIGIN = 49
RATES_HZ = {LOCAL_POSITION_NED: 10.0, ATTITUDE: 10.0, EXTENDED_SYS_STATE: 5.0, SYS_STATUS: 1.0}

# What turns and what shows the acceleration, as each autopilot has it.
INERTIAL_HZ = 50.0
INERTIAL = {"px4": (ATTITUDE_QUATERNION, HIGHRES_IMU), "ardupilot": (ATTITUDE, RAW_IMU)}

SOURCE_PARAMETER = "EK3_SRC1_POSXY"
EXTERNAL = 6.0  # of the source: external positions


class Streams:
    """Asks for the messages that do not come by themselves, a few times.

    Args:
        inertial: ask for the vehicle's inertial data, too.
    """

    def __init__(self, *, inertial: bool = False) -> None:
        self._inertial = inertial
        self._feels = False  # inertial data have come since they were asked for
        self._seen: set[int] = set()
        self._next_ns: int | None = None
        self._tries = 0
        self._felt_next_ns = 0
        self._felt_tries = 0

    def saw(self, message: Message) -> None:
        """Take a message of the vehicle."""
        match message:
            case Position(local_ned=True):
                self._seen.add(LOCAL_POSITION_NED)
            case Attitude(quaternion=False):
                self._seen.add(ATTITUDE)
            case Landed():
                self._seen.add(EXTENDED_SYS_STATE)
            case Battery():
                self._seen.add(SYS_STATUS)
            case Inertial():
                self._feels = self._felt_tries > 0

    def restart(self) -> None:
        """The vehicle has started anew and may have forgotten them."""
        self._seen.clear()
        self._feels = False
        self._next_ns, self._tries = None, 0
        self._felt_next_ns, self._felt_tries = 0, 0

    def due(self, at_ns: int, autopilot: str = "") -> tuple[tuple[int, float], ...]:
        """(message id, rate [1/s]) of what is to be asked for now; to be called once a vehicle is heard."""
        wanted: dict[int, float] = {}
        if self._next_ns is None:
            self._next_ns = at_ns + SETTLE_NS
        if at_ns >= self._next_ns and self._tries < TRIES:
            self._next_ns = at_ns + AGAIN_NS
            self._tries += 1
            wanted = {number: rate for number, rate in RATES_HZ.items() if number not in self._seen}
        # Not waited for: but for a PX4 on an onboard link no vehicle sends them so often, and a flight may have begun.
        kinds = INERTIAL.get(autopilot, ()) if self._inertial and not self._feels else ()
        if kinds and at_ns >= self._felt_next_ns and self._felt_tries < TRIES:
            self._felt_next_ns = at_ns + AGAIN_NS
            self._felt_tries += 1
            wanted.update(dict.fromkeys(kinds, INERTIAL_HZ))
        return tuple(wanted.items())


class Globe:
    """When to tell an ArduPilot that flies by external positions a place on the globe: without one it does not arm.

    Its source of positions is read first: with GPS a place of ours would be wrong.
    """

    def __init__(self) -> None:
        self._external = False
        self._known = False
        self._next_ns = 0
        self._tries = 0

    def saw(self, message: Message) -> None:
        """Take a message of the vehicle."""
        match message:
            case Origin():
                self._known = True
            case ParamValue(name=name, cast=cast) if name == SOURCE_PARAMETER:
                self._external = cast == EXTERNAL

    def due(self, at_ns: int) -> tuple[bool, bool]:
        """Whether to ask now (for the parameter and the origin), and whether to tell the origin.

        It is told from the second time on: by then an origin that is there has been answered with.
        """
        if self._known or at_ns < self._next_ns or self._tries >= ORIGIN_TRIES:
            return False, False
        self._next_ns = at_ns + SECOND_NS
        self._tries += 1
        return True, self._external and self._tries > 1
