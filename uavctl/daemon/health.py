"""Health once a second; service manager."""

from __future__ import annotations

import os
import socket
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Protocol

import msgspec

from uavctl.config import Config
from uavctl.config.checks import get_position_index
from uavctl.errors import UsageError
from uavctl.mavlink.handover_states import HandoverState
from uavctl.outcome import FlightCourse
from uavctl.records import ControlMode, RelayStats, Ticked, Vector, VehicleStatus

# State of a flight, once a second: for a person, for `uavctl ctl status`, for the service manager.


PERIOD_NS = 1_000_000_000
LOSS_PERIODS = 10  # over which losses are counted


class RecorderHealth(msgspec.Struct, frozen=True, kw_only=True):
    """Whether the recording is whole so far."""

    ok: bool
    dropped: int  # records that are not in it
    reason: str  # why it is not, or that the disk gets low; empty if all is well
    path: str
    unwritten_s: float  # since the last completed write, while something waits for the disk


class VehicleHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The vehicle, as its own messages tell."""

    autopilot: str
    mode: str
    armed: bool
    external: bool
    landed: bool | None
    battery_v: float | None
    heard_s: float  # ago


class RelayHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The positions that are passed on to the vehicle: a part of its own, which may go on when control has ended."""

    sent: int  # since the start
    sent_hz: float  # in the last second
    kept: dict[str, int]  # positions not passed on, by reason
    last_s: float | None  # since the last one; None before the first
    alone: bool  # nothing else is sent any more: control has ended, or failed
    silent_for: str = ""  # reason why the vehicle has got none for half a second; empty while it gets them


class Health(msgspec.Struct, frozen=True, kw_only=True):
    """State of the flight at one moment; SI units, local NED, axes that the plant lacks are left out."""

    name: str
    url: str
    pid: int
    running_s: float
    mode: ControlMode | None  # None before the first tick
    reason: str
    age_s: float | None  # of the newest position
    age_steps: int | None
    position_m: dict[str, float] | None
    velocity_mps: dict[str, float] | None
    target_m: dict[str, float] | None
    waypoint: int | None
    loss: float | None  # share of the positions counted on that did not come lately; None in the first second
    lateness_us: float  # largest of the last second
    missed_ticks: int  # since the start
    vehicle: VehicleHealth | None
    recorder: RecorderHealth
    who_flies: str = ""  # state of the hand-over
    ending: str = ""  # end of the flight, under way or come, in words; empty while nothing ends it
    relay: RelayHealth | None = None  # None where no positions are passed on
    let_go: str = ""  # why the envelope has let the vehicle go; empty as long as it has not
    # share of the vehicle's inertial data of the last second that are used; None where none came, or none are wanted
    inertial: float | None = None


class WatchedFlight(Protocol):
    """Control loop as far as its health is looked at."""

    course: FlightCourse

    @property
    def who_flies(self) -> HandoverState:
        """State of the hand-over."""
        ...

    @property
    def relay(self) -> RelayStats | None:
        """Counts of the positions passed on to the vehicle; None where none are passed on."""
        ...

    @property
    def inertial(self) -> tuple[int, int] | None:
        """Inertial data of the vehicle that are used, and all that came; None where none are used."""
        ...

    @property
    def let_go(self) -> str:
        """Reason why the envelope let the vehicle go: what was seen and cannot be; empty as long as nothing was."""
        ...


class HealthWatch:
    """Watches the control loop from its own thread; looks are cheap and take no lock.

    Args:
        name: of the daemon, url of its vehicle, pid of its process.
        tell: called with each second's line, from the control loop's thread: it must not wait.
    """

    def __init__(
        self,
        flight: WatchedFlight,
        config: Config,
        identity: tuple[str, str, int],
        recorder: Callable[[], RecorderHealth],
        tell: Callable[[str], None],
    ) -> None:
        self._flight, self._identity, self._recorder, self._tell = flight, identity, recorder, tell
        self._axes = tuple(zip(config.plant.axes, get_position_index(config.plant), strict=True))
        speeds = config.plant.velocity_index if config.plant.model == "matrices" else [i + 1 for _, i in self._axes]
        self._speed_axes = tuple(zip(config.plant.axes, speeds, strict=True))
        self._ticked: Ticked | None = None  # the last tick
        self._rate_hz = config.source.rate_hz or 1.0 / config.plant.dt_s
        self._came = 0  # positions, since the start
        self._came_by: deque[tuple[int, int]] = deque(maxlen=LOSS_PERIODS + 1)  # at_ns, came; once a period
        self._loss: float | None = None
        self._begun_ns: int | None = None
        self._now_ns = 0
        self._told_ns = 0
        self._missed = 0
        self._worst_ns = 0  # of this second
        self._worst_before_ns = 0  # of the last one
        self._recording = "well"  # as last told
        self._let_go = ""  # the same
        self._inertial = (0, 0)  # data used and all, by the last look of a second
        self._inertial_share: float | None = None
        self._relayed = (0, 0.0)  # positions by the last look of a second, and how many a second came in it

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """The control loop has run a tick."""
        self._ticked = ticked
        at_ns = ticked.decision.at_ns
        if self._begun_ns is None:
            self._begun_ns = self._told_ns = at_ns
            self._came_by.append((at_ns, 0))
        self._now_ns = at_ns
        self._came += ticked.decision.accepted + ticked.decision.rejected
        self._missed += ticked.decision.missed_ticks
        self._worst_ns = max(self._worst_ns, lateness_ns)
        if self._flight.let_go and not self._let_go:
            self._let_go = self._flight.let_go
            self._tell(f"error: the vehicle is let go: {self._let_go}")
        if at_ns - self._told_ns >= PERIOD_NS:
            self._told_ns = at_ns
            self._count_losses()
            self._worst_before_ns, self._worst_ns = self._worst_ns, 0
            relay = self._flight.relay
            if relay is not None:
                self._relayed = relay.sent, float(relay.sent - self._relayed[0])
            inertial = self._flight.inertial
            if inertial is not None:
                used, total = (now - before for now, before in zip(inertial, self._inertial, strict=True))
                self._inertial, self._inertial_share = inertial, used / total if total else None
            health = self.look()
            self._alarm(health.recorder)
            self._tell(line(health))

    def _count_losses(self) -> None:
        since_ns, before = self._came_by[0]
        expected = self._rate_hz * (self._now_ns - since_ns) * 1e-9
        self._loss = max(0.0, 1.0 - (self._came - before) / expected)
        self._came_by.append((self._now_ns, self._came))

    def _alarm(self, recorder: RecorderHealth) -> None:
        """Report each change of the recording's health once, in a line of its own."""
        now = "in trouble" if not recorder.ok else "may not go on for long" if recorder.reason else "well"
        if now == self._recording:
            return
        self._recording = now
        why = recorder.reason or f"{recorder.dropped} records dropped"
        self._tell("recording is well again" if now == "well" else f"warning: recording {now}: {why}")

    def look(self) -> Health:
        """The flight as it is now."""
        flight, recorder, ticked = self._flight, self._recorder(), self._ticked
        decision, estimate, vehicle = (
            (None, None, None) if ticked is None else (ticked.decision, ticked.estimate, ticked.vehicle)
        )
        mean = None if estimate is None else estimate.mean
        name, url, pid = self._identity
        return Health(
            name=name,
            url=url,
            pid=pid,
            running_s=0.0 if self._begun_ns is None else (self._now_ns - self._begun_ns) * 1e-9,
            mode=None if decision is None else decision.mode,
            reason="waiting for the first tick" if decision is None else decision.reason,
            age_s=None if estimate is None else max(0.0, (self._now_ns - estimate.captured_ns) * 1e-9),
            age_steps=None if decision is None else decision.age_steps,
            position_m=_along(self._axes, mean),
            velocity_mps=_along(self._speed_axes, mean),
            target_m=None if decision is None else _along(self._axes, decision.target),
            waypoint=None if decision is None else decision.waypoint,
            loss=self._loss,
            lateness_us=max(self._worst_ns, self._worst_before_ns) * 1e-3,
            missed_ticks=self._missed,
            vehicle=None if vehicle is None else _vehicle(vehicle, self._now_ns),
            recorder=recorder,
            who_flies=flight.who_flies.value,
            ending=flight.course.told,
            relay=self._relay(),
            let_go=flight.let_go,
            inertial=self._inertial_share,
        )

    def _relay(self) -> RelayHealth | None:
        stats = self._flight.relay
        if stats is None:
            return None
        last_s = None if stats.last_ns is None else max(0.0, (self._now_ns - stats.last_ns) * 1e-9)
        return RelayHealth(
            sent=stats.sent,
            sent_hz=self._relayed[1],
            kept=stats.kept,
            last_s=last_s,
            alone=stats.alone,
            silent_for=stats.silent_for,
        )


def line(health: Health) -> str:
    """One line for a log: the same fields in the same order, `-` for what is not known."""
    vehicle, relay = health.vehicle, health.relay
    battery = None if vehicle is None else vehicle.battery_v
    mode = "-" if vehicle is None else f"{vehicle.mode} {'armed' if vehicle.armed else 'disarmed'}"
    fields = (
        "-" if health.mode is None else health.mode.value,
        f"age {_number(health.age_s, '.2f')} s",
        f"loss {_number(None if health.loss is None else 100 * health.loss, '.0f')} %",
        f"late {health.lateness_us / 1e3:.2f} ms",
        f"missed {health.missed_ticks}",
        f"vehicle {mode}",
        f"battery {_number(battery, '.1f')} V",
        *(() if relay is None else (_relayed(relay),)),
        *(() if health.inertial is None else (f"inertial {100 * health.inertial:.0f} %",)),
        f"dropped {health.recorder.dropped}" + (f" ({health.recorder.reason})" if health.recorder.reason else ""),
    )
    return "  ".join(fields)


def _along(axes: tuple[tuple[str, int], ...], state: Vector | None) -> dict[str, float] | None:
    return None if state is None else {axis: state[i] for axis, i in axes}


def _vehicle(vehicle: VehicleStatus, now_ns: int) -> VehicleHealth:
    return VehicleHealth(
        autopilot=vehicle.autopilot,
        mode=vehicle.mode,
        armed=vehicle.armed,
        external=vehicle.external,
        landed=vehicle.landed,
        battery_v=vehicle.battery_v,
        heard_s=max(0.0, (now_ns - vehicle.at_ns) * 1e-9),
    )


def _relayed(relay: RelayHealth) -> str:
    silent = f" SILENT ({relay.silent_for})" if relay.silent_for else ""
    return f"relay {relay.sent_hz:.0f} /s{' alone' if relay.alone else ''}{silent}"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


# The service manager's notification socket (sd_notify): ready, alive, status.
#
# The sign of life comes from the control loop and from nowhere else: a loop that hangs is a daemon that hangs.


_FEEDS = 4  # signs of life in one watchdog time
_LONGEST = 2000  # characters of a status


class Notifier:
    """Tells the service manager, if there is one; never blocks, never raises once it is made.

    Args:
        environ: the environment: NOTIFY_SOCKET, WATCHDOG_USEC, WATCHDOG_PID as systemd sets them.
        pid: of this process; a watchdog that is meant for another one is not fed.

    Raises:
        UsageError: one of the variables cannot be understood.
    """

    def __init__(self, environ: Mapping[str, str] = os.environ, pid: int | None = None) -> None:
        address = environ.get("NOTIFY_SOCKET", "")
        if address and address[0] not in "/@":
            raise UsageError(f"NOTIFY_SOCKET={address}: neither a path nor an abstract name; unset it")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket: socket.socket | None = None
        if address:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
        self.watchdog_ns = _watchdog_ns(environ, os.getpid() if pid is None else pid)
        self._fed_ns: int | None = None

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """The control loop has run a tick: ready with the first one, then signs of life."""
        del lateness_ns
        at_ns = ticked.decision.at_ns
        if self._fed_ns is None:
            self._tell("READY=1")
        elif self.watchdog_ns is None or at_ns - self._fed_ns < self.watchdog_ns // _FEEDS:
            return
        self._fed_ns = at_ns
        self._tell("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        self._tell("STATUS=" + text.replace("\n", " ")[:_LONGEST])

    def close(self) -> None:
        """Say that the daemon ends, which no watchdog has to see."""
        self._tell("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, line: str) -> None:
        if self._socket is not None:
            with suppress(OSError):  # full or gone: the manager's own watchdog draws the conclusion
                self._socket.sendto(line.encode(), self._address)


def _watchdog_ns(environ: Mapping[str, str], pid: int) -> int | None:
    """Time within which the manager wants a sign of life [ns]; None if it wants none of this process."""
    usec, owner = environ.get("WATCHDOG_USEC"), environ.get("WATCHDOG_PID")
    if usec is None or (owner is not None and owner != str(pid)):
        return None
    if not usec.isdecimal() or int(usec) == 0:
        raise UsageError(f"WATCHDOG_USEC={usec}: not a number of microseconds; unset it")
    return int(usec) * 1000
