"""Another link for the positions of a recording: those that came, and those that were lost on the recorded one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from sim.channel import Channel
from uavctl.config.link import LinkConfig
from uavctl.data import Datagram, Vec3
from uavctl.errors import RecordingError
from uavctl.whatif.departure import Departure
from uavctl.whatif.history import LEAST_POSITIONS, History
from uavctl.whatif.rewrite import Axes, Seen

Array = NDArray[np.float64]
_USUAL_SHARE = 0.2  # of the spacings: those of positions with none lost between them


@dataclass(frozen=True)
class Capture:
    """One position, as its source sent it or would have.

    Attributes:
        at_ns: Time of capture, which counts as that of sending [ns].
        seen: Its frame, or that of the last one before it.
        by_m: Where it was, from the position in the frame [m].
        by_mps: The same of the velocity [m/s].
        stamp_us: Its stamp; None: that of the frame.
    """

    at_ns: int
    seen: Seen
    by_m: Vec3 = (0.0, 0.0, 0.0)
    by_mps: Vec3 = (0.0, 0.0, 0.0)
    stamp_us: int | None = None


class Relinked:
    """Positions of a recording over a simulated link; implements `OtherLink`.

    Args:
        history: The recorded flight.
        link: The link.
        seed: Of what it loses, and of the noise of positions that the recording lacks.
        noise_m: Standard deviation of that noise, each axis [m].

    Raises:
        RecordingError: Too few positions carry a stamp.
    """

    def __init__(self, history: History, link: LinkConfig, seed: int, noise_m: float) -> None:
        # As the simulator spawns them: a simulated flight meets the losses that it would have met.
        _, for_cameras, for_channel = np.random.SeedSequence(seed).spawn(3)
        self._axes = Axes(history.config.frame)
        noise = np.random.default_rng(for_cameras)
        self._captures = deque(captures(history, lambda: noise_m * noise.standard_normal(3)))
        origin_ns = history.flight.truths[0].at_ns if history.flight.truths else history.flight.origin_ns
        self._channel = Channel(link, for_channel, origin_ns, round(history.config.plant.dt_s * 1e9))

    @property
    def counts(self) -> tuple[int, int]:
        """Positions sent so far, and how many of them were lost."""
        return self._channel.counters.sent, self._channel.counters.lost

    def due(self, to_ns: int, departure: Departure) -> list[tuple[int, bytes]]:
        """See `OtherLink`."""
        while self._captures and self._captures[0].at_ns <= to_ns:
            one = self._captures.popleft()
            by_m = _plus(one.by_m, departure.position_m(one.at_ns))
            by_mps = _plus(one.by_mps, departure.velocity_mps(one.at_ns))
            data = self._axes.moved(one.seen, by_m, by_mps, stamp_us=one.stamp_us)
            # A recorded flight begins with a known position.
            self._channel.push(one.at_ns, data, certain=not self._channel.counters.sent)
        return self._channel.pop_due(to_ns)


def captures(history: History, noise: Callable[[], Array]) -> list[Capture]:
    """All positions of a recording in the order of capture, those that were lost put back in where they were.

    Raises:
        RecordingError: Too few of them carry a stamp.
    """
    came = _came(history)
    if len(came) < LEAST_POSITIONS:
        raise RecordingError(
            f"only {len(came)} positions of the recording carry a stamp, so nobody knows which were lost; "
            "fly them over the recorded link"
        )
    path = _Path(history, came)
    usual_us = _usual_spacing(history, came)
    found = [came[0]]
    for one in came[1:]:
        found.extend(_lost(found[-1], one, usual_us, path, noise))
        found.append(one)
    return found


def _came(history: History) -> list[Capture]:
    """Those that came, each capture once."""
    axes = Axes(history.config.frame)
    found: dict[int, Capture] = {}
    for _, at_ns, record in history.entries:
        if isinstance(record, Datagram) and not record.outgoing:
            for seen in axes.seen(record.data):
                captured_ns = history.captured_ns(seen, at_ns)
                if captured_ns is not None and seen.position.stamp_us:
                    found.setdefault(seen.position.stamp_us, Capture(captured_ns, seen))
    return [found[stamp_us] for stamp_us in sorted(found)]


def _usual_spacing(history: History, came: list[Capture]) -> float:
    """Time between two positions with none lost between them [µs]."""
    if history.flight.truths:
        return 1e6 / history.config.sim.camera.rate_hz
    spacings = np.diff([_stamp(one) for one in came])
    return float(np.median(spacings[spacings <= 1.5 * np.quantile(spacings, _USUAL_SHARE)]))


def _lost(before: Capture, after: Capture, usual_us: float, path: _Path, noise: Callable[[], Array]) -> list[Capture]:
    """Those between two that came, evenly spread."""
    missing = round((_stamp(after) - _stamp(before)) / usual_us) - 1
    numbered = (after.seen.frame.data[_number(after)] - before.seen.frame.data[_number(before)] - 1) % 256
    if missing < 1 or not numbered:  # the source numbers what it sends: nothing was sent between these
        return []
    found = []
    for i in range(1, missing + 1):
        share = i / (missing + 1)
        at_ns = before.at_ns + round(share * (after.at_ns - before.at_ns))
        stamp_us = _stamp(before) + round(share * (_stamp(after) - _stamp(before)))
        where, how_fast = path.at(at_ns)
        by_m = where + noise() - before.seen.position_m
        by_mps = how_fast - path.at(before.at_ns)[1]
        found.append(Capture(at_ns, before.seen, _vec3(by_m), _vec3(by_mps), stamp_us))
    return found


class _Path:
    """Where the vehicle was: through the true states where they are known, else through the positions that came."""

    def __init__(self, history: History, came: list[Capture]) -> None:
        truths = history.flight.truths
        self._origin_ns = came[0].at_ns
        if len(truths) >= LEAST_POSITIONS:
            times, where = self._s([one.at_ns for one in truths]), np.array([one.position_m for one in truths])
            self._spline = CubicHermiteSpline(times, where, np.array([one.velocity_mps for one in truths]))
        else:
            by_time = {one.at_ns: one.seen.position_m for one in came}
            at_ns = sorted(by_time)
            self._spline = CubicSpline(self._s(at_ns), np.array([by_time[at] for at in at_ns]))
        self._slope = self._spline.derivative()

    def at(self, at_ns: int) -> tuple[Array, Array]:
        """Position (3,) [m] and velocity (3,) [m/s], local NED."""
        time_s = float(self._s([at_ns])[0])
        return np.asarray(self._spline(time_s)), np.asarray(self._slope(time_s))

    def _s(self, at_ns: list[int]) -> Array:
        return np.array([(at - self._origin_ns) * 1e-9 for at in at_ns])


def _stamp(capture: Capture) -> int:
    stamp_us = capture.seen.position.stamp_us
    assert stamp_us is not None  # only those with one are kept
    return stamp_us


def _number(capture: Capture) -> int:
    """Place of the running number in the head of a frame."""
    return 4 if capture.seen.frame.data[0] == 0xFD else 2


def _vec3(values: Array) -> Vec3:
    return float(values[0]), float(values[1]), float(values[2])


def _plus(a: Vec3, b: Vec3) -> Vec3:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]
