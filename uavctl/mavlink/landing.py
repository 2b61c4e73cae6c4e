"""Landing request that needs nothing of controller and hand-over: for a flight whose control has failed.

Its frames are made while all works. It is sent for a limited time, until the vehicle has accepted it or does not fly
for us any more.
"""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.arrays import SECOND_NS
from uavctl.config.connections import HandOverConfig
from uavctl.mavlink.codec import decode
from uavctl.mavlink.encoder import Encoder
from uavctl.mavlink.messages import CommandAck, Heartbeat, Message
from uavctl.mavlink.profile import PROFILES, describe_mode

LandingTarget = tuple[tuple[int, int], str, tuple[bytes, ...]]
"""Address (system, component) and autopilot of a vehicle, and the frames of a request."""


class LandingRequest:
    """Landing request of one vehicle.

    Attributes:
        is_pending: Whether it has begun, and is neither answered nor over.
        is_answered: Whether the vehicle has accepted it, or has left the modes in which it flies for us.

    Args:
        own_address: Our system and component.
    """

    def __init__(self, own_address: tuple[int, int], config: HandOverConfig) -> None:
        self._encoder = Encoder(*own_address)  # of its own: the numbers of all other frames stay as they are
        self._answer_ns, self._limit_ns = round(config.answer_s * SECOND_NS), round(config.land_s * SECOND_NS)
        self._address: tuple[int, int] | None = None
        self._autopilot = ""
        self._frames: tuple[bytes, ...] = ()
        self._next_ns = self._end_ns = 0
        self._has_begun = False
        self.is_pending = self.is_answered = False

    @property
    def target(self) -> LandingTarget | None:
        """Address and autopilot of the vehicle, and the frames for it; None before one is known."""
        return None if self._address is None else (self._address, self._autopilot, self._frames)

    def prepare(self, address: tuple[int, int], autopilot: str) -> None:
        """Make the frames for a vehicle, if they are not made yet."""
        if address != self._address:
            command = self._encoder.encode_command(mavlink.MAV_CMD_NAV_LAND, (), *address)
            self._frames = (self._encoder.encode_heartbeat(), command)
            self._address, self._autopilot = address, autopilot

    def begin(self, at_ns: int) -> None:
        """Begin to send; do nothing if it has begun before, or no vehicle is known."""
        if not self._has_begun and self._frames:
            self._has_begun = self.is_pending = True
            self._next_ns, self._end_ns = at_ns, at_ns + self._limit_ns

    def is_due(self, at_ns: int) -> bool:
        """Return whether frames are to be sent now."""
        self.is_pending = self.is_pending and at_ns < self._end_ns
        return self.is_pending and at_ns >= self._next_ns

    def due(self, at_ns: int) -> tuple[bytes, ...]:
        """Return the frames to send now."""
        if not self.is_due(at_ns):
            return ()
        self._next_ns = at_ns + self._answer_ns
        return self._frames

    def receive(self, data: bytes) -> None:
        """Look for the vehicle's answer in a datagram."""
        if self.is_pending and any(self._is_answer(message) for message in decode(data).messages):
            self.is_pending, self.is_answered = False, True

    def _is_answer(self, message: Message) -> bool:
        if (message.system, message.component) != self._address:
            return False
        if isinstance(message, CommandAck):
            return (message.command, message.result) == (mavlink.MAV_CMD_NAV_LAND, mavlink.MAV_RESULT_ACCEPTED)
        return isinstance(message, Heartbeat) and not self._flies_for_us(message)

    def _flies_for_us(self, heartbeat: Heartbeat) -> bool:
        """Return whether the vehicle is armed, in a mode that we have asked for; else it lands, or another has it."""
        profile = PROFILES.get(self._autopilot)
        mode, _ = describe_mode(self._autopilot, heartbeat.vehicle_type, heartbeat.custom_mode)
        is_armed = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        return is_armed and (profile is None or mode in profile.climb_modes | {profile.external_mode})
