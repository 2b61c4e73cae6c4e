"""Requests that a vehicle needs before a flight: message streams, parameters and a global origin.

1. `StreamRequests` waits, because many vehicles stream by themselves. Then it requests the missing messages.
2. `ParameterDownload` requests the whole list once, then each missing parameter by its index.
3. `GlobalOriginSetup` sends an origin to an ArduPilot that flies on external positions and has no origin.

Each class sees all messages of the vehicle and returns the requests that are due. Each stops after a few tries.
"""

from __future__ import annotations

from uavctl.arrays import SECOND_NS
from uavctl.mavlink.messages import (
    Attitude,
    Battery,
    GlobalOrigin,
    Inertial,
    LandedState,
    Message,
    ParamValue,
    Position,
    RadioChannels,
)
from uavctl.mavlink.profile import PROFILES

STREAM_SETTLE_NS = 2 * SECOND_NS  # many vehicles stream by themselves
RETRY_NS = 2 * SECOND_NS
MAX_TRIES = 5
MAX_ORIGIN_TRIES = 30  # once a second: the vehicle's estimator may take that long to start
LOCAL_POSITION_NED, ATTITUDE, EXTENDED_SYS_STATE, SYS_STATUS = 32, 30, 245, 1
RC_CHANNELS = 65
ATTITUDE_QUATERNION, HIGHRES_IMU, RAW_IMU = 31, 105, 27
GPS_GLOBAL_ORIGIN = 49
RATES_HZ = {LOCAL_POSITION_NED: 10.0, ATTITUDE: 10.0, EXTENDED_SYS_STATE: 5.0, SYS_STATUS: 1.0, RC_CHANNELS: 5.0}
INERTIAL_HZ = 50.0  # of attitude and acceleration messages
# Limits of the download. A telemetry radio can carry 50 parameters a second.
MAX_PARAMETERS, MAX_READ_ROUNDS = 5000, 10
READS_PER_BATCH, BATCH_NS = 10, SECOND_NS // 5
LIST_END_NS = SECOND_NS // 2  # without a parameter: the list has ended
SOURCE_PARAMETER = "EK3_SRC1_POSXY"
EXTERNAL_SOURCE = 6.0  # value of this parameter for external positions


class StreamRequests:
    """Requests missing messages, a few times.

    Args:
        inertial: also request inertial data.
        channels: also request the channels of the remote control.
    """

    def __init__(self, *, inertial: bool = False, channels: bool = True) -> None:
        self._wants_inertial = inertial
        self._rates_hz = {number: hz for number, hz in RATES_HZ.items() if channels or number != RC_CHANNELS}
        self._has_inertial = False  # inertial data have come since the request
        self._received: set[int] = set()
        self._next_ns: int | None = None
        self._tries = 0
        self._inertial_next_ns = 0
        self._inertial_tries = 0

    def handle_message(self, message: Message) -> None:
        """Handle a message of the vehicle."""
        match message:
            case Position(local_ned=True):
                self._received.add(LOCAL_POSITION_NED)
            case Attitude(quaternion=False):
                self._received.add(ATTITUDE)
            case LandedState():
                self._received.add(EXTENDED_SYS_STATE)
            case Battery():
                self._received.add(SYS_STATUS)
            case RadioChannels() if self._tries:  # always requested at our rate: it shows a pilot's stick
                self._received.add(RC_CHANNELS)
            case Inertial():
                self._has_inertial = self._inertial_tries > 0

    def restart(self) -> None:
        """Repeat all requests: the vehicle has restarted and may have forgotten them."""
        self._received.clear()
        self._has_inertial = False
        self._next_ns, self._tries = None, 0
        self._inertial_next_ns, self._inertial_tries = 0, 0

    def due(self, at_ns: int, autopilot: str = "") -> tuple[tuple[int, float], ...]:
        """Return the requests that are due now: (message id, rate [1/s]). Called once a vehicle is heard."""
        rates_hz: dict[int, float] = {}
        if self._next_ns is None:
            self._next_ns = at_ns + STREAM_SETTLE_NS
        if at_ns >= self._next_ns and self._tries < MAX_TRIES:
            self._next_ns = at_ns + RETRY_NS
            self._tries += 1
            rates_hz = {number: rate for number, rate in self._rates_hz.items() if number not in self._received}
        # Requested at once: only a PX4 on an onboard link sends them at this rate by itself.
        profile = PROFILES.get(autopilot) if self._wants_inertial and not self._has_inertial else None
        kinds = () if profile is None else profile.inertial_messages
        if kinds and at_ns >= self._inertial_next_ns and self._inertial_tries < MAX_TRIES:
            self._inertial_next_ns = at_ns + RETRY_NS
            self._inertial_tries += 1
            rates_hz.update(dict.fromkeys(kinds, INERTIAL_HZ))
        return tuple(rates_hz.items())


class ParameterDownload:
    """Download of all parameters before the first arming: the list, then the missing ones."""

    def __init__(self) -> None:
        self._missing: set[int] | None = None  # missing indices; None before the number of parameters is known
        self._has_new_value = False  # a parameter has come since the last call
        self._next_ns = 0
        self._list_requests = self._read_rounds = 0
        self._round_indices: list[int] = []  # indices of this round that are not requested yet
        self._is_finished = False

    def handle_message(self, message: Message) -> None:
        """Handle a message of the vehicle."""
        if isinstance(message, ParamValue) and message.index < message.count <= MAX_PARAMETERS:
            if self._missing is None:
                self._missing = set(range(message.count))
            self._missing.discard(message.index)
            self._has_new_value = True

    def due(self, at_ns: int, *, armed: bool) -> tuple[int, ...]:
        """Return the indices to request now, -1 for the whole list; none once the vehicle was armed."""
        self._is_finished = self._is_finished or armed or self._missing == set()
        if self._is_finished:
            return ()
        if self._has_new_value and not self._read_rounds:  # the list is being sent
            self._has_new_value, self._next_ns = False, at_ns + LIST_END_NS
        if at_ns < self._next_ns:
            return ()
        if self._missing is None:
            self._list_requests += 1
            self._next_ns = at_ns + RETRY_NS
            self._is_finished = self._list_requests > MAX_TRIES
            return () if self._is_finished else (-1,)
        self._next_ns = at_ns + BATCH_NS
        if not self._round_indices:
            self._read_rounds += 1
            self._is_finished = self._read_rounds > MAX_READ_ROUNDS
            self._round_indices = [] if self._is_finished else sorted(self._missing, reverse=True)
        indices = self._round_indices[-READS_PER_BATCH:][::-1]
        del self._round_indices[-READS_PER_BATCH:]
        if not self._round_indices:  # wait for the last answers of a round
            self._next_ns = at_ns + LIST_END_NS
        return tuple(index for index in indices if index in self._missing)


class GlobalOriginSetup:
    """Sends a global origin to an ArduPilot on external positions, which does not arm without one.

    The parameter of its position source is read first: with GPS our origin would be wrong.
    """

    def __init__(self) -> None:
        self._has_external_source = False
        self._is_origin_known = False
        self._next_ns = 0
        self._tries = 0

    def handle_message(self, message: Message) -> None:
        """Handle a message of the vehicle."""
        match message:
            case GlobalOrigin():
                self._is_origin_known = True
            case ParamValue(name=name, cast=cast) if name == SOURCE_PARAMETER:
                self._has_external_source = cast == EXTERNAL_SOURCE

    def due(self, at_ns: int) -> tuple[bool, bool]:
        """Return whether to request the parameter and the origin now, and whether to send our origin.

        The origin is sent from the second time on: by then a vehicle with an origin has answered.
        """
        if self._is_origin_known or at_ns < self._next_ns or self._tries >= MAX_ORIGIN_TRIES:
            return False, False
        self._next_ns = at_ns + SECOND_NS
        self._tries += 1
        return True, self._has_external_source and self._tries > 1
