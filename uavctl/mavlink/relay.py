"""Relay of positions to the vehicle's own estimator: selection and time stamps. Pure; time is an argument.

1. Keep back positions that are refused, old, frozen, out of order, too frequent, or whose attitude is wrong; count
   each by reason.
2. Convert the capture time to the vehicle's clock: by its TIMESYNC answers, or else by the arrival of its messages.
3. Report silence and a wrong attitude, with the reason.

PX4 also requests our time and moves the stamps that it receives by the offset that it finds
(src/lib/timesync/Timesync.cpp, `sync_stamp`). We answer with the time of its own clock, so that offset is zero. An
unknown clock never stops the positions. An estimator tolerates a small error of a stamp, but no silence.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from uavctl.config.connections import RelayConfig
from uavctl.event_codes import EventCode
from uavctl.frames import Quaternion, rotate_vector
from uavctl.mavlink.relay_attitude import TILTED, TURNED, AttitudeCheck
from uavctl.mavlink.vehicle_turn import VehicleTurn
from uavctl.records import Event, PositionSample, RelayStats, Severity, Vec3

MAX_AGE_NS = 200_000_000  # some estimators use an older position as a new one
FROZEN_POSES = 25  # identical poses in a row: 0.5 s at the usual 50 Hz; noise repeats one less than twice
_MAX_QUEUE = 64  # poses of one tick
SILENT_NS = 500_000_000  # without positions for longer, an estimator drifts by more than 0.1 m
START_NS = 3_000_000_000  # start time of cameras and vehicle
NO_POSITION, HELD_BACK = "nothing comes", "held back"
REASONS = {
    NO_POSITION: "no position arrives",
    HELD_BACK: "positions are wrong and are held back",
    "no attitude": "positions arrive without an attitude",
    "refused": "the filter refused positions",
    "old": f"positions arrive more than {MAX_AGE_NS / 1e6:.0f} ms after their capture",
    "frozen": "positions repeat to the last bit",
    "out of order": "positions arrive out of order",
    "rate": "stamps of positions do not advance",
    "no clock": "stamps of positions are older than the vehicle's start",
    TILTED: "the tilt of poses differs from the vehicle's",
    TURNED: "the turn of poses differs from the vehicle's",
}
WRONG_ATTITUDES = 5  # poses with a wrong attitude within `ATTITUDE_NS`: a fault, and no outlier
ATTITUDE_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a body as sent to the vehicle's estimator."""

    message: str  # name of the MAVLink message
    usec: int  # time of capture, in the clock that the vehicle expects [us]
    position_m: Vec3  # local NED [m]
    attitude: Quaternion  # body axes forward, right, down to NED (w, x, y, z)
    body_mps: Vec3 | None  # velocity in body axes [m/s]; None where it is not known


class Relay:
    """Passes positions on; counts those that it keeps back.

    Attributes:
        sent: poses passed on.
        last_ns: time of the tick that passed the last one on; None before.
        kept: poses that were kept back, by reason.
        silent_for: reason why the vehicle gets no position now, a key of `REASONS`; empty while it gets them.
        attitude_fault: fault of the attitude of poses now, a key of `REASONS`; empty while it is right.
    """

    def __init__(self, config: RelayConfig) -> None:
        self._config = config
        self._period_ns = round(1e9 / config.rate_hz)
        self._queue: list[tuple[PositionSample, Quaternion]] = []
        self._newest_ns: int | None = None  # capture of the last pose sent
        self._last: tuple[Vec3, Quaternion] | None = None
        self._repeat_count = 0
        self._start_ns: int | None = None  # time of the first tick
        self._kept_before: Counter[str] = Counter()  # counts of `kept` when the last pose was sent
        self._reported = ""  # report of this silence: `armed`, `ground`, or empty
        self._is_reported_on_ground = False  # any silence
        self.silent_for = ""
        self.sent = 0
        self.last_ns: int | None = None
        self.kept = dict.fromkeys(
            ("no attitude", "refused", "old", "frozen", "out of order", "rate", "no clock", TILTED, TURNED), 0
        )
        self.attitude_fault = ""
        self._attitude_check = AttitudeCheck()
        self._wrong_attitudes: deque[tuple[int, str]] = deque(maxlen=WRONG_ATTITUDES)  # last ones: time, and fault

    @property
    def is_enabled(self) -> bool:
        """Whether positions are passed on."""
        return self._config.enabled

    def add_sample(self, sample: PositionSample, attitude: Quaternion | None) -> None:
        """Queue a new sample with the body's attitude in NED; an estimator of yaw needs it."""
        if not self.is_enabled:
            return
        if attitude is None:
            self.kept["no attitude"] += 1
            return
        self._queue.append((sample, attitude))
        del self._queue[:-_MAX_QUEUE]

    def due(
        self, at_ns: int, *, offset_ns: int, refused: Sequence[PositionSample], turn: VehicleTurn, armed: bool
    ) -> tuple[Pose, ...]:
        """Return the poses for the vehicle in this tick, in order of capture.

        Args:
            offset_ns: (our time - the vehicle's), by which stamps are moved.
            refused: samples that the tick has refused.
            turn: tilt and turn of the vehicle by its own sensors.
            armed: the vehicle may be in the air.
        """
        arrived = [entry for entry in self._queue if entry[0].received_ns <= at_ns]
        self._queue = [entry for entry in self._queue if entry[0].received_ns > at_ns]
        waiting = sorted(arrived, key=lambda entry: entry[0].captured_ns)
        poses = []
        for sample, attitude in waiting:
            reason = "refused" if sample in refused else self._find_reason(sample, attitude, at_ns)
            if reason is None and sample.captured_ns - offset_ns < 1000:
                reason = "no clock"  # before the vehicle's clock began
            if reason is None:
                reason = self._find_attitude_fault(sample, attitude, at_ns, turn, armed=armed)
            if reason is not None:
                self.kept[reason] += 1
                continue
            self._newest_ns = sample.captured_ns
            poses.append(self._make_pose(sample, attitude, offset_ns))
        self.sent += len(poses)
        if poses:
            self.last_ns, self._kept_before = at_ns, Counter(self.kept)
        return tuple(poses)

    def make_event(self, at_ns: int, *, held_back: bool, armed: bool) -> Event | None:
        """Return an event if the vehicle gets no positions for `SILENT_NS`, or gets them again.

        Called in each tick after `due`. Each silence in the air is reported once. Of those on the ground only the
        first one is reported, and once more if the vehicle is armed meanwhile.

        Args:
            held_back: no position is passed on in this tick.
            armed: the vehicle may be in the air.
        """
        if not self.is_enabled:
            return None
        if self._start_ns is None:
            self._start_ns = at_ns
        since_ns = self._start_ns + START_NS if self.last_ns is None else self.last_ns
        is_silent = at_ns - since_ns >= SILENT_NS
        self.silent_for = "" if not is_silent else HELD_BACK if held_back else self._find_silence_reason()
        if not is_silent and self._reported:
            self._reported = ""
            text = "the vehicle receives positions again"
            return Event(at_ns=at_ns, severity=Severity.INFO, code=EventCode.RELAY_RESUMED, text=text)
        if (
            not is_silent
            or self._reported == "armed"
            or (not armed and (self._reported or self._is_reported_on_ground))
        ):
            return None
        self._reported = "armed" if armed else "ground"
        self._is_reported_on_ground = self._is_reported_on_ground or not armed
        since_ns = self._start_ns if self.last_ns is None else since_ns
        text = f"the vehicle has received no position for {(at_ns - since_ns) * 1e-9:.1f} s: {REASONS[self.silent_for]}"
        return Event(at_ns=at_ns, severity=Severity.WARNING, code=EventCode.RELAY_SILENT, text=text)

    def make_attitude_event(self, at_ns: int) -> Event | None:
        """Return an event if poses begin to have a wrong attitude, or have a right one again for `ATTITUDE_NS`."""
        wrong = self._wrong_attitudes
        is_over = not wrong or at_ns - wrong[-1][0] >= ATTITUDE_NS
        is_wrong = len(wrong) == WRONG_ATTITUDES and wrong[-1][0] - wrong[0][0] <= ATTITUDE_NS and not is_over
        if is_wrong and not self.attitude_fault:
            self.attitude_fault = fault = wrong[-1][1]
            text = f"{REASONS[fault]}; these poses are not passed on"
            severity, code = Severity.WARNING, EventCode.RELAY_ATTITUDE
            return Event(at_ns=at_ns, severity=severity, code=code, text=text, subject=fault)
        if is_over and self.attitude_fault and self.last_ns is not None and self.last_ns > wrong[-1][0]:
            self.attitude_fault = ""
            text = "the attitude of poses is right again; poses are passed on"
            return Event(at_ns=at_ns, severity=Severity.INFO, code=EventCode.RELAY_ATTITUDE_RIGHT, text=text)
        return None

    def stats(self, at_ns: int, *, alone: bool) -> RelayStats:
        """Return the counters since the start.

        Args:
            alone: nothing but positions is sent to the vehicle any more.
        """
        return RelayStats(
            at_ns=at_ns,
            sent=self.sent,
            kept={reason: count for reason, count in self.kept.items() if count},
            last_ns=self.last_ns,
            alone=alone,
            silent_for=self.silent_for,
            attitude_fault=self.attitude_fault,
        )

    def _find_silence_reason(self) -> str:
        counts = (Counter(self.kept) - self._kept_before).most_common(1)
        return counts[0][0] if counts else NO_POSITION

    def _find_reason(self, sample: PositionSample, attitude: Quaternion, at_ns: int) -> str | None:
        """Return the reason to keep a pose back; None if it is sent."""
        is_same = self._last == (sample.position_m, attitude)
        self._last, self._repeat_count = (sample.position_m, attitude), self._repeat_count + 1 if is_same else 0
        newest_ns = self._newest_ns
        if at_ns - sample.captured_ns > MAX_AGE_NS:
            return "old"
        if self._repeat_count >= FROZEN_POSES:
            return "frozen"
        if newest_ns is not None and sample.captured_ns <= newest_ns:
            return "out of order"
        if newest_ns is not None and sample.captured_ns - newest_ns < self._period_ns - self._period_ns // 10:
            return "rate"
        return None

    def _find_attitude_fault(
        self, sample: PositionSample, attitude: Quaternion, at_ns: int, turn: VehicleTurn, *, armed: bool
    ) -> str | None:
        fault = self._attitude_check.find_fault(sample.captured_ns, attitude, turn, armed=armed)
        if fault is not None:
            self._wrong_attitudes.append((at_ns, fault))
        return fault

    def _make_pose(self, sample: PositionSample, attitude: Quaternion, offset_ns: int) -> Pose:
        velocity_body = None
        if self._config.message == "odometry" and sample.velocity_mps is not None:
            w, x, y, z = attitude
            velocity_body = rotate_vector((w, -x, -y, -z), sample.velocity_mps)
        # A pose without a velocity goes as a position: an unknown one (NaN) is not safe to send to ArduPilot.
        message = "vision-position-estimate" if velocity_body is None else self._config.message
        return Pose(message, (sample.captured_ns - offset_ns) // 1000, sample.position_m, attitude, velocity_body)


def describe_relay(stats: RelayStats, last_setpoint_ns: int | None) -> str:
    """Describe the positions passed on in a flight that has ended.

    Args:
        last_setpoint_ns: time of the last setpoint that flew the vehicle; None without one.
    """
    if stats.last_ns is None:
        return "no position was passed on to the vehicle"
    since_last_s = (stats.at_ns - stats.last_ns) * 1e-9
    text = f"passed on {stats.sent} positions and kept {sum(stats.kept.values())} back"
    text += f", the last one {since_last_s:.1f} s before the end"
    after_setpoints_s = 0.0 if last_setpoint_ns is None else (stats.last_ns - last_setpoint_ns) * 1e-9
    return f"{text}, {after_setpoints_s:.1f} s after the last setpoint" if after_setpoints_s > 0.0 else text
