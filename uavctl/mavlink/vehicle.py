"""State of the vehicle from its messages: status, motion and inertial samples.

1. Follow the first autopilot that sends a heartbeat. Count and ignore other vehicles.
2. Keep landed state, battery, boot clock and the evidence for a mode change between heartbeats.
3. Return a `VehicleStatus` at each heartbeat, and at once if the evidence or the boot count changes.
4. Rotate each specific force with the newest attitude: a = R f + g. Ignore old, repeated and frozen data.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.event_codes import EventCode
from uavctl.frames import Quaternion, quaternion_from_euler, rotate_vector
from uavctl.mavlink.boot_clock import BootClock
from uavctl.mavlink.clocksync import ArrivalClock
from uavctl.mavlink.codec import MODE_COMMANDS
from uavctl.mavlink.messages import (
    Attitude,
    Battery,
    CommandAck,
    FenceBreach,
    Heartbeat,
    Inertial,
    LandedState,
    Message,
    ModeCommand,
    Position,
    RadioChannels,
    StatusText,
)
from uavctl.mavlink.mode_reason import ModeReasonEvidence
from uavctl.mavlink.profile import PROFILES, describe_mode, find_autopilot_name
from uavctl.mavlink.vehicle_turn import VehicleTurn
from uavctl.records import Event, InertialSample, Severity, Vec3, VehicleMotion, VehicleStatus

# Identical readings for longer come from a frozen sensor. Whole thousandths of g repeat for 0.7 s at most in recorded
# flights of ArduCopter. Fractions have noise and never repeated.
FROZEN_RAW_US, FROZEN_US = 1_000_000, 100_000
# Less than this share of so many inertial data used: it is reported.
MIN_INERTIAL_SHARE, MIN_INERTIAL = 0.8, 250
ALONE_NS = 5_000_000_000  # silence after which another vehicle counts as gone
GONE_NS = 30_000_000_000  # silence after which another vehicle replaces a disarmed one
BOOTING_NS = 3_000_000_000  # silence before a heartbeat of booting that shows a restart
MAX_ATTITUDE_AGE_NS = 100_000_000  # at 1 rad/s the attitude is then 0.1 rad off, and the acceleration 1 m/s²
GRAVITY_MPS2 = 9.80665
MAX_DELAY_NS = 60_000_000  # later than the quickest message: a stream of 50 Hz has 20 ms between messages
MAX_VELOCITY_DELAY_NS = 1_000_000_000  # a velocity that is later says nothing of now; one of 0.7 s still helps
MAX_BACKSTEP_US = 1_000_000  # a stamp that goes back by more is of another clock
_UNREPORTED_COMMANDS = frozenset({mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE})
# PX4 is in standby only while its pre-flight checks pass, else uninitialised. That changes without a restart.
_NOT_READY_STATES = frozenset({mavlink.MAV_STATE_UNINIT, mavlink.MAV_STATE_BOOT, mavlink.MAV_STATE_CALIBRATING})
_FAILSAFE_STATES = frozenset({mavlink.MAV_STATE_CRITICAL, mavlink.MAV_STATE_EMERGENCY})
_NO_AUTOPILOT = int(mavlink.MAV_AUTOPILOT_INVALID)
_AUTOPILOT1 = int(mavlink.MAV_COMP_ID_AUTOPILOT1)
# Types of devices that are no vehicle, whatever autopilot they name.
_DEVICES = frozenset(
    int(getattr(mavlink, f"MAV_TYPE_{name}"))
    for name in (
        *("GCS", "ANTENNA_TRACKER", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB", "CAMERA", "CHARGING_STATION", "FLARM"),
        *("SERVO", "ODID", "BATTERY", "LOG", "OSD", "IMU", "GPS", "WINCH"),
    )
)


def is_vehicle(heartbeat: Heartbeat) -> bool:
    """Return whether a heartbeat is an autopilot's, not that of a ground station, companion computer or gimbal."""
    return heartbeat.autopilot != _NO_AUTOPILOT and heartbeat.vehicle_type not in _DEVICES


def is_preferred(address: tuple[int, int], other: tuple[int, int] | None) -> bool:
    """Return whether to follow the first of two vehicles instead of the second.

    In one system the autopilot component is preferred; of two systems the followed one.
    """
    if other is None:
        return True
    return address[0] == other[0] and address[1] == _AUTOPILOT1 != other[1]


class SensorStreamMonitor:
    """Checks the messages of one sensor stream by their stamps and arrival.

    A new stamp is a new measurement, because integer readings repeat. Identical readings for long come from a frozen
    sensor. The delay counts from the quickest message and follows the drift of the sender's clock.
    """

    def __init__(self) -> None:
        self._clock = ArrivalClock()
        self._checked_ns = 0  # arrival of the last checked message
        self._stamp_us = 0  # its stamp
        self._values: Vec3 | None = None
        self._since_us = 0  # stamp of the first of identical readings

    def is_current(self, stamp_us: int, values: Vec3, at_ns: int, *, frozen_us: int = 0) -> bool | None:
        """Return whether a message is a current measurement; None for a repeated one.

        Args:
            stamp_us: time of measurement by the sender's clock.
            values: the readings.
            frozen_us: identical readings for longer come from a frozen sensor; 0 if noise never repeats.
        """
        if -MAX_BACKSTEP_US <= stamp_us - self._stamp_us <= 0:
            return None
        delay_ns = self.measure_delay_ns(stamp_us, at_ns)
        is_repeated = values == self._values
        if not is_repeated:
            self._since_us = stamp_us
        self._values = values
        return delay_ns <= MAX_DELAY_NS and not (is_repeated and stamp_us - self._since_us >= frozen_us)

    def measure_delay_ns(self, stamp_us: int, at_ns: int) -> int:
        """Return the delay of a message behind the quickest one [ns]; a stamp of another clock begins a new one."""
        advance_us = stamp_us - self._stamp_us
        if advance_us < -MAX_BACKSTEP_US or advance_us > (at_ns - self._checked_ns) // 1000 + MAX_BACKSTEP_US:
            self._clock, self._since_us = ArrivalClock(), stamp_us
        self._stamp_us, self._checked_ns = stamp_us, at_ns
        return self._clock.measure_delay_ns(1000 * stamp_us, at_ns)


class VehicleMonitor:
    """Follows the first vehicle that is heard; others are counted and ignored.

    Another vehicle replaces a silent and disarmed one.

    Args:
        count_bad: counts heartbeats of other vehicles, by reason.
        own_address: our system and component id; answers to other stations are ignored.
        system: the vehicle's system id; 0 accepts any.
        component: its component id; 0 accepts any and prefers that of autopilots.
        channels: use the remote control and fence flags of SYS_STATUS.
    """

    def __init__(
        self,
        count_bad: Callable[[str], None],
        own_address: tuple[int, int],
        system: int = 0,
        component: int = 0,
        *,
        inertial: bool = False,
        channels: bool = True,
    ) -> None:
        self._count_bad = count_bad
        self._wants_inertial, self._uses_channels = inertial, channels
        self._own_address = own_address
        self._system, self._component = system, component
        self._landed: bool | None = None
        self._own_climb = False
        self._battery_v: float | None = None
        self._boot_clock = BootClock()
        self._is_ready = False  # by its last heartbeat
        self._heard_ns = 0  # any message of it
        self._evidence = ModeReasonEvidence()
        self._is_in_failsafe = False  # by its last heartbeat
        self._other_vehicle_ns: int | None = None  # last message of another vehicle
        self._status: VehicleStatus | None = None
        self._motion = VehicleMotion()
        self._sensor_streams: dict[str, SensorStreamMonitor] = {}  # by kind of message
        self._attitude: tuple[Vec3, int] | None = None  # attitude, and its time of arrival
        self.turn = VehicleTurn()  # by all attitude messages
        self.inertial_used = self.inertial_total = 0  # inertial data: used, and all
        self.boots = 0
        self.not_ready_count = 0  # times that it was no longer ready: its streams may have stopped
        self.address: tuple[int, int] | None = None  # system, component

    @property
    def autopilot(self) -> str:
        """Name of its autopilot; empty before its first heartbeat."""
        return "" if self._status is None else self._status.autopilot

    @property
    def is_armed(self) -> bool:
        """Whether the last heartbeat shows an armed vehicle."""
        return self._status is not None and self._status.armed

    def handle_message(
        self, message: Message, at_ns: int
    ) -> tuple[VehicleStatus | VehicleMotion | InertialSample | Event | CommandAck | StatusText, ...]:
        """Handle any message; only those of the vehicle count."""
        if isinstance(message, Heartbeat) and is_vehicle(message):
            return self._handle_heartbeat(message, at_ns)
        if isinstance(message, ModeCommand):
            return self._handle_mode_command(message.system, message.target_system, at_ns)
        if self.address is None or message.system != self.address[0]:
            return ()
        if message.component != self.address[1]:  # a companion computer or gimbal: only its texts
            return (_make_text_event(message, at_ns),) if isinstance(message, StatusText) else ()
        self._heard_ns = at_ns
        match message:
            case LandedState(landed=landed, own_climb=own_climb):
                return self._update_landed(landed, own_climb)
            case Battery():
                self._battery_v = self._battery_v if message.voltage_v is None else message.voltage_v
                if message.has_radio is None or not self._uses_channels:
                    return ()
                self._evidence.update_radio(heard=message.has_radio)
                self._evidence.update_fence(at_ns, within=message.is_within_fence)
                return self._update_evidence(at_ns)
            case FenceBreach(is_breached=breached):
                self._evidence.update_fence(at_ns, within=not breached)
                return self._update_evidence(at_ns)
            case RadioChannels(channels_us=channels_us):
                self._evidence.update_channels(channels_us, at_ns)
                return self._update_evidence(at_ns)
            case Position(boot_ms=True, stamp_us=int(stamp_us)):
                status = self._update_boot_clock("position", stamp_us, at_ns)
                delay_ns = self._find_stream("velocity").measure_delay_ns(stamp_us, at_ns)
                # One that repeats is passed on: that it repeats is found, and counts (`uavctl.flight.monitors`).
                is_new = message.velocity_mps != self._motion.velocity_mps
                if stamp_us and is_new and delay_ns > MAX_VELOCITY_DELAY_NS:
                    self._count_bad(EventCode.VELOCITY_STALE)
                    return status
                return (*status, *self._update_motion(at_ns, velocity=message.velocity_mps))
            case Attitude(angles_rad=angles_rad):
                if message.rates_rps is not None:
                    self.turn.add(angles_rad, message.rates_rps, message.stamp_us, at_ns)
                kind = "quaternion" if message.quaternion else "angles"
                status = self._update_boot_clock(kind, message.stamp_us, at_ns) if message.stamp_us else ()
                # Inertial data use both attitude messages. Without them, one of two streams is enough.
                if message.quaternion and not self._wants_inertial:
                    return status
                self._update_attitude(message, at_ns)
                return (*status, *self._update_motion(at_ns, attitude=angles_rad))
            case Inertial(raw=raw):
                profile = PROFILES.get(self.autopilot)
                return (
                    self._make_inertial_sample(message, at_ns) if not raw or (profile and profile.uses_raw_imu) else ()
                )
            case StatusText(text=text):
                self._evidence.add_text(text, at_ns)
                return message, _make_text_event(message, at_ns), *self._update_evidence(at_ns)
            case CommandAck() if self._is_for_us(message):
                return (
                    (message,)
                    if message.command in _UNREPORTED_COMMANDS
                    else (message, _make_ack_event(message, at_ns))
                )
            case CommandAck(command=command, result=mavlink.MAV_RESULT_ACCEPTED) if command in MODE_COMMANDS:
                return self._handle_mode_command(message.target_system, message.system, at_ns)
        return ()

    def _handle_mode_command(self, station: int, target: int, at_ns: int) -> tuple[VehicleStatus, ...]:
        """Note a mode command of another station to this vehicle."""
        if (
            self.address is None
            or target not in (0, self.address[0])
            or station in (self._own_address[0], self.address[0])
        ):
            return ()
        self._evidence.add_mode_command(station, at_ns)
        return self._update_evidence(at_ns)

    def _update_evidence(self, at_ns: int) -> tuple[VehicleStatus, ...]:
        """Return a status at once if the evidence has changed."""
        if self._status is None:
            return ()
        before, self._status = self._status, self._evidence.apply_to(self._status, at_ns, critical=self._is_in_failsafe)
        return () if self._status == before else (self._status,)

    def _is_for_us(self, ack: CommandAck) -> bool:
        system, component = self._own_address
        return ack.target_system in (0, system) and ack.target_component in (0, component)

    def uptime_s(self, at_ns: int) -> float | None:
        """Return the vehicle's uptime by its own clock [s]; None if unknown."""
        return self._boot_clock.uptime_s(at_ns)

    def attitude(self, at_ns: int) -> Quaternion | None:
        """Return the rotation of a specific force at that time into local NED (w, x, y, z); None if old or unknown."""
        if self._attitude is None or at_ns - self._attitude[1] > MAX_ATTITUDE_AGE_NS:
            return None
        return quaternion_from_euler(self._attitude[0])

    def _update_boot_clock(self, kind: str, stamp_us: int, at_ns: int) -> tuple[VehicleStatus, ...]:
        """Update the boot clock; return a status at once after a restart."""
        return self._reset_after_reboot() if self._boot_clock.update(kind, stamp_us // 1000, at_ns) else ()

    def _update_landed(self, landed: bool | None, own_climb: bool) -> tuple[VehicleStatus, ...]:
        """Update the landed state; return a status at once if the vehicle's own climb begins or ends."""
        changed = own_climb != self._own_climb
        self._landed, self._own_climb = landed, own_climb
        if self._status is None or not changed:
            return ()
        self._status = msgspec.structs.replace(self._status, landed=landed, own_climb=own_climb)
        return (self._status,)

    def _update_motion(
        self, at_ns: int, *, velocity: Vec3 | None = None, attitude: Vec3 | None = None
    ) -> tuple[VehicleMotion, ...]:
        """Update and return the vehicle's motion."""
        if velocity is not None:
            self._motion = msgspec.structs.replace(self._motion, velocity_mps=velocity, velocity_ns=at_ns)
        if attitude is not None:
            self._motion = msgspec.structs.replace(self._motion, attitude_rad=attitude, attitude_ns=at_ns)
        return (self._motion,)

    def _update_attitude(self, message: Attitude, at_ns: int) -> None:
        """Store the attitude that rotates specific forces, if it is current."""
        if not self._wants_inertial:
            return
        kind = "quaternion" if message.quaternion else "angles"
        if self._find_stream(kind).is_current(message.stamp_us, message.angles_rad, at_ns):
            self._attitude = message.angles_rad, at_ns
        else:
            self._count_bad(EventCode.INERTIAL_STALE)

    def _find_stream(self, kind: str) -> SensorStreamMonitor:
        """Return the monitor of a kind of message; one is made for the first message."""
        stream = self._sensor_streams.get(kind)
        if stream is None:
            stream = self._sensor_streams[kind] = SensorStreamMonitor()
        return stream

    def _make_inertial_sample(self, message: Inertial, at_ns: int) -> tuple[InertialSample, ...]:
        """Make a sample from a specific force and the newest attitude; nothing if either is old or unknown."""
        if not self._wants_inertial:
            return ()
        kind, frozen_us = ("raw", FROZEN_RAW_US) if message.raw else ("highres", FROZEN_US)
        is_new = self._find_stream(kind).is_current(
            message.stamp_us, message.specific_force_mps2, at_ns, frozen_us=frozen_us
        )
        self.inertial_total += is_new is not None
        if not is_new:
            self._count_bad(EventCode.INERTIAL_STALE)
            return ()
        attitude = self.attitude(at_ns)
        force_ned = None if attitude is None else rotate_vector(attitude, message.specific_force_mps2)
        if force_ned is None:
            return ()
        self.inertial_used += 1
        # a = R f + g
        north, east, down = force_ned
        return (InertialSample(at_ns=at_ns, accel_mps2=(north, east, down + GRAVITY_MPS2)),)

    def _reset_after_reboot(self) -> tuple[VehicleStatus, ...]:
        self.boots += 1
        self._sensor_streams, self._attitude = {}, None
        self._landed, self._evidence = None, ModeReasonEvidence()
        if self._status is None:
            return ()
        self._status = msgspec.structs.replace(self._status, boots=self.boots)
        return (self._status,)

    def _is_lost_on_ground(self, at_ns: int) -> bool:
        """Return whether the followed vehicle is silent and was disarmed: it cannot be in flight."""
        status = self._status
        return status is not None and not status.armed and at_ns - status.at_ns > GONE_NS

    def _follow_vehicle(self, address: tuple[int, int], at_ns: int) -> None:
        """Follow a vehicle; forget the state of another one before: nothing is armed yet."""
        if (
            self.address is not None and self.address[0] == address[0]
        ):  # the followed component was another device of it
            self._sensor_streams, self._attitude, self._battery_v, self._landed = {}, None, None, None
            self._is_ready = False
            self._boot_clock.reset()
        elif self.address is not None:
            self._reset_after_reboot()
            self._battery_v = None
            self._boot_clock.reset()
            self._other_vehicle_ns = at_ns
        self.address, self._status = address, None

    def _handle_heartbeat(self, message: Heartbeat, at_ns: int) -> tuple[VehicleStatus, ...]:
        address = (message.system, message.component)
        is_wanted = self._system in (0, message.system) and self._component in (0, message.component)
        if is_wanted and (
            is_preferred(address, self.address) or (address != self.address and self._is_lost_on_ground(at_ns))
        ):
            self._follow_vehicle(address, at_ns)
        if address != self.address:
            if self.address is None or message.system != self.address[0]:
                self._count_bad(EventCode.SECOND_VEHICLE)
                self._other_vehicle_ns = at_ns
            return ()
        is_booting = message.system_status == mavlink.MAV_STATE_BOOT and self._status is not None
        if is_booting and self._is_ready and at_ns - self._heard_ns > BOOTING_NS:
            self._reset_after_reboot()
            self._boot_clock.reset()
        self._heard_ns = at_ns
        is_ready = message.system_status not in _NOT_READY_STATES
        self.not_ready_count += self._is_ready and not is_ready
        self._is_ready = is_ready
        autopilot = find_autopilot_name(message.autopilot)
        mode, external = describe_mode(autopilot, message.vehicle_type, message.custom_mode)
        self._is_in_failsafe = message.system_status in _FAILSAFE_STATES
        status = VehicleStatus(
            at_ns=at_ns,
            autopilot=autopilot,
            armed=bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED),
            mode=mode,
            external=external,
            landed=self._landed,
            own_climb=self._own_climb,
            battery_v=self._battery_v,
            boots=self.boots,
            alone=self._other_vehicle_ns is None or at_ns - self._other_vehicle_ns > ALONE_NS,
        )
        self._evidence.add_heartbeat(at_ns)
        self._status = self._evidence.apply_to(status, at_ns, critical=self._is_in_failsafe)
        return (self._status,)


def _make_text_event(text: StatusText, at_ns: int) -> Event:
    return Event(at_ns=at_ns, severity=_convert_severity(text.severity), code=EventCode.VEHICLE_TEXT, text=text.text)


def _convert_severity(mav_severity: int) -> Severity:
    if mav_severity <= mavlink.MAV_SEVERITY_ERROR:
        return Severity.ERROR
    return Severity.WARNING if mav_severity == mavlink.MAV_SEVERITY_WARNING else Severity.INFO


def _make_ack_event(ack: CommandAck, at_ns: int) -> Event:
    is_accepted = ack.result in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
    return Event(
        at_ns=at_ns,
        severity=Severity.INFO if is_accepted else Severity.WARNING,
        code=EventCode.COMMAND_ACK,
        subject=_find_enum_name("MAV_CMD", ack.command),
        text=f"{_find_enum_name('MAV_CMD', ack.command)}: {_find_enum_name('MAV_RESULT', ack.result)}",
    )


def _find_enum_name(enum: str, value: int) -> str:
    entry = mavlink.enums[enum].get(value)
    return str(value) if entry is None else str(entry.name).removeprefix(f"{enum}_")
