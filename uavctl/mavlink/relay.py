"""Positions on their way to the vehicle's own estimator: which ones go, and with what stamp. Pure; time is an argument.

A vehicle stamps by its own clock. Two ways lead there, and taking both would shift a stamp twice:

* PX4 asks us for our time (TIMESYNC) and moves the stamps of what it receives by the offset that it finds
  (src/lib/timesync/Timesync.cpp, `sync_stamp`). Whoever asks so gets stamps of our clock, which is what we answered.
* Else the stamp is moved here, by the offset that the vehicle's answers to our own requests gave.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from uavctl.config.connections import RelayConfig
from uavctl.frames import Quaternion, rotate
from uavctl.records import PositionSample, Vec3

MAX_AGE_NS = 200_000_000  # an older position would be taken for a new one by estimators that cannot look back
STUCK_AFTER = 25  # poses in a row, the same to the last bit
_WAITING = 64  # poses of one tick


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a body as sent to the vehicle's estimator."""

    message: str  # as which message
    usec: int  # time of capture, in the clock that the vehicle expects [us]
    position_m: Vec3  # local NED [m]
    attitude: Quaternion  # body axes forward, right, down to NED (w, x, y, z)
    body_mps: Vec3 | None  # velocity in body axes [m/s]; None where it is not known


class Relay:
    """Passes positions on; stale, stuck and refused ones stay here, and are counted.

    Attributes:
        sent: poses passed on.
        last_ns: time of the tick that passed the last one on; None before.
        kept: poses that were not, by reason.
    """

    def __init__(self, config: RelayConfig) -> None:
        self._config = config
        self._period_ns = round(1e9 / config.rate_hz)
        self._waiting: list[tuple[PositionSample, Quaternion]] = []
        self._newest_ns: int | None = None  # capture of the last pose sent
        self._last: tuple[Vec3, Quaternion] | None = None
        self._same = 0
        self.sent = 0
        self.last_ns: int | None = None
        self.kept = dict.fromkeys(("no attitude", "refused", "stale", "stuck", "late", "rate", "no clock"), 0)

    @property
    def enabled(self) -> bool:
        """Whether positions are passed on."""
        return self._config.enabled

    def take(self, sample: PositionSample, attitude: Quaternion | None) -> None:
        """Take a sample as it arrives, with the body's attitude in NED, which an estimator of yaw cannot do without."""
        if not self.enabled:
            return
        if attitude is None:
            self.kept["no attitude"] += 1
            return
        self._waiting.append((sample, attitude))
        del self._waiting[:-_WAITING]

    def due(
        self, at_ns: int, *, offset_ns: int | None, asks: bool, refused: Sequence[PositionSample]
    ) -> tuple[Pose, ...]:
        """Return the positions that go to the vehicle in this tick, in order of capture.

        Args:
            offset_ns: (our time - the vehicle's) from round trips; None if it does not answer.
            asks: the vehicle asks for our time, and so moves stamps itself.
            refused: samples that the tick did not believe.
        """
        arrived = [one for one in self._waiting if one[0].received_ns <= at_ns]
        self._waiting = [one for one in self._waiting if one[0].received_ns > at_ns]
        waiting = sorted(arrived, key=lambda one: one[0].captured_ns)
        if offset_ns is None and not asks:
            self.kept["no clock"] += len(waiting)
            return ()
        offset_ns = 0 if asks else offset_ns or 0
        out = []
        for sample, attitude in waiting:
            reason = "refused" if sample in refused else self._reason(sample, attitude, at_ns)
            if reason is None and sample.captured_ns - offset_ns < 1000:
                reason = "no clock"  # before the vehicle's clock began
            if reason is not None:
                self.kept[reason] += 1
                continue
            self._newest_ns = sample.captured_ns
            out.append(self._pose(sample, attitude, offset_ns))
        self.sent += len(out)
        self.last_ns = at_ns if out else self.last_ns
        return tuple(out)

    def _reason(self, sample: PositionSample, attitude: Quaternion, at_ns: int) -> str | None:
        """Return why a pose is kept back; None if it goes."""
        same = self._last == (sample.position_m, attitude)
        self._last, self._same = (sample.position_m, attitude), self._same + 1 if same else 0
        newest_ns = self._newest_ns
        if at_ns - sample.captured_ns > MAX_AGE_NS:
            return "stale"
        if self._same >= STUCK_AFTER:
            return "stuck"
        if newest_ns is not None and sample.captured_ns <= newest_ns:
            return "late"
        if newest_ns is not None and sample.captured_ns - newest_ns < self._period_ns - self._period_ns // 10:
            return "rate"
        return None

    def _pose(self, sample: PositionSample, attitude: Quaternion, offset_ns: int) -> Pose:
        body = None
        if self._config.message == "odometry" and sample.velocity_mps is not None:
            w, x, y, z = attitude
            body = rotate((w, -x, -y, -z), sample.velocity_mps)
        # A pose without a velocity goes as a position: an unknown one (NaN) is not safe to send to ArduPilot.
        message = "vision-position-estimate" if body is None else self._config.message
        return Pose(message, (sample.captured_ns - offset_ns) // 1000, sample.position_m, attitude, body)
