"""State of a flight, once a second: for a person, for `uavctl ctl status`, for the service manager."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol

import msgspec

from uavctl.account import FlightAccount
from uavctl.config import Config
from uavctl.config.checks import get_position_index
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import Conduct, ControlMode, RelayStats, Ticked, Vector, VehicleStatus

PERIOD_NS = 1_000_000_000
LOSS_PERIODS = 10  # over which losses are counted


class RecorderHealth(msgspec.Struct, frozen=True, kw_only=True):
    """State of the recording."""

    ok: bool
    dropped: int  # missing records
    reason: str  # reason of a problem, or of a low disk; empty if all is well
    path: str
    unwritten_s: float  # since the last completed write, while something waits for the disk


class VehicleHealth(msgspec.Struct, frozen=True, kw_only=True):
    """State of the vehicle from its own messages."""

    autopilot: str
    mode: str
    armed: bool
    external: bool
    landed: bool | None
    battery_v: float | None
    heard_s: float  # ago


class RelayHealth(msgspec.Struct, frozen=True, kw_only=True):
    """Relay of positions to the vehicle, which may continue after the control has ended."""

    sent: int  # since the start
    sent_hz: float  # in the last second
    kept: dict[str, int]  # positions not passed on, by reason
    last_s: float | None  # since the last one; None before the first
    alone: bool  # nothing else is sent any more: control has ended, or failed
    silent_for: str = ""  # reason why the vehicle has got none for half a second; empty while it gets them
    attitude_fault: str = ""  # error of the attitude of poses, which are held back; empty without one


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
    loss: float | None  # share of the expected positions that did not come; None in the first second
    lateness_us: float  # largest of the last second
    missed_ticks: int  # since the start
    vehicle: VehicleHealth | None
    recorder: RecorderHealth
    who_flies: str = ""  # state of the hand-over
    ending: str = ""  # text on the end of the flight, begun or done; empty before
    relay: RelayHealth | None = None  # None where no positions are passed on
    let_go: str = ""  # why the envelope has let the vehicle go; empty as long as it has not
    # share of the vehicle's inertial data of the last second that are used; None where none came, or none are wanted
    inertial: float | None = None
    cell: int | None = None  # number of the moving cell in use, 0 without one; None in a flight without any
    conduct: Conduct | None = None  # how a vehicle in moving cells moves


class MonitoredFlight(Protocol):
    """Control loop for the health monitor."""

    account: FlightAccount

    @property
    def handover_state(self) -> HandoverState:
        """State of the hand-over."""
        ...

    @property
    def relay(self) -> RelayStats | None:
        """Counts of the positions passed on to the vehicle; None where none are passed on."""
        ...

    @property
    def inertial(self) -> tuple[int, int] | None:
        """Numbers of inertial data: used, and all; None if they are not used."""
        ...

    @property
    def breach_reason(self) -> str:
        """Reason why the envelope has let the vehicle go; empty while it has not."""
        ...

    @property
    def cell_status(self) -> tuple[int, Conduct] | None:
        """Number of the moving cell in use, and conduct; None in a flight without any."""
        ...


class HealthMonitor:
    """Monitors the control loop in its own thread, without locks.

    Args:
        identity: name of the daemon, URL of its vehicle, pid of its process.
        write_line: called with the line of each second, in the control loop's thread; it must not wait.
    """

    def __init__(
        self,
        flight: MonitoredFlight,
        config: Config,
        identity: tuple[str, str, int],
        recorder: Callable[[], RecorderHealth],
        write_line: Callable[[str], None],
    ) -> None:
        self._flight, self._identity, self._recorder, self._write_line = flight, identity, recorder, write_line
        self._axes = tuple(zip(config.plant.axes, get_position_index(config.plant), strict=True))
        speed_indices = (
            config.plant.velocity_index if config.plant.model == "matrices" else [i + 1 for _, i in self._axes]
        )
        self._speed_axes = tuple(zip(config.plant.axes, speed_indices, strict=True))
        self._ticked: Ticked | None = None  # the last tick
        self._rate_hz = config.arrival_rate_hz
        self._position_count = 0  # positions, since the start
        self._count_history: deque[tuple[int, int]] = deque(maxlen=LOSS_PERIODS + 1)  # at_ns, count; once a period
        self._loss: float | None = None
        self._start_ns: int | None = None
        self._now_ns = 0
        self._reported_ns = 0
        self._missed = 0
        self._max_lateness_ns = 0  # of this second
        self._previous_max_lateness_ns = 0  # of the last one
        self._recording_state = "works"  # as last reported
        self._breach_reason = ""  # the same
        self._inertial = (0, 0)  # data used and all, at the last second
        self._inertial_share: float | None = None
        self._relay_rate = (0, 0.0)  # positions at the last second, and their rate in it

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """Update after a tick of the control loop."""
        self._ticked = ticked
        at_ns = ticked.decision.at_ns
        if self._start_ns is None:
            self._start_ns = self._reported_ns = at_ns
            self._count_history.append((at_ns, 0))
        self._now_ns = at_ns
        self._position_count += ticked.decision.accepted + ticked.decision.rejected
        self._missed += ticked.decision.missed_ticks
        self._max_lateness_ns = max(self._max_lateness_ns, lateness_ns)
        if self._flight.breach_reason and not self._breach_reason:
            self._breach_reason = self._flight.breach_reason
            self._write_line(f"error: the vehicle is let go: {self._breach_reason}")
        if at_ns - self._reported_ns >= PERIOD_NS:
            self._reported_ns = at_ns
            self._count_losses()
            self._previous_max_lateness_ns, self._max_lateness_ns = self._max_lateness_ns, 0
            relay = self._flight.relay
            if relay is not None:
                self._relay_rate = relay.sent, float(relay.sent - self._relay_rate[0])
            inertial = self._flight.inertial
            if inertial is not None:
                used, total = (count - before for count, before in zip(inertial, self._inertial, strict=True))
                self._inertial, self._inertial_share = inertial, used / total if total else None
            health = self.make_health()
            self._report_recorder(health.recorder)
            self._write_line(format_health(health))

    def _count_losses(self) -> None:
        since_ns, before = self._count_history[0]
        expected = self._rate_hz * (self._now_ns - since_ns) * 1e-9
        self._loss = max(0.0, 1.0 - (self._position_count - before) / expected)
        self._count_history.append((self._now_ns, self._position_count))

    def _report_recorder(self, recorder: RecorderHealth) -> None:
        """Report each change of the recording's health once, in a line of its own."""
        state = "fails" if not recorder.ok else "may stop soon" if recorder.reason else "works"
        if state == self._recording_state:
            return
        self._recording_state = state
        reason = recorder.reason or f"{recorder.dropped} records dropped"
        self._write_line("recording works again" if state == "works" else f"warning: recording {state}: {reason}")

    def make_health(self) -> Health:
        """Make the present state of the flight."""
        flight, recorder, ticked = self._flight, self._recorder(), self._ticked
        decision, estimate, vehicle = (
            (None, None, None) if ticked is None else (ticked.decision, ticked.estimate, ticked.vehicle)
        )
        mean = None if estimate is None else estimate.mean
        name, url, pid = self._identity
        cell, conduct = flight.cell_status or (None, None)
        return Health(
            name=name,
            url=url,
            pid=pid,
            running_s=0.0 if self._start_ns is None else (self._now_ns - self._start_ns) * 1e-9,
            mode=None if decision is None else decision.mode,
            reason="waiting for the first tick" if decision is None else decision.reason,
            age_s=None if estimate is None else max(0.0, (self._now_ns - estimate.captured_ns) * 1e-9),
            age_steps=None if decision is None else decision.age_steps,
            position_m=_select_axes(self._axes, mean),
            velocity_mps=_select_axes(self._speed_axes, mean),
            target_m=None if decision is None else _select_axes(self._axes, decision.target),
            waypoint=None if decision is None else decision.waypoint,
            loss=self._loss,
            lateness_us=max(self._max_lateness_ns, self._previous_max_lateness_ns) * 1e-3,
            missed_ticks=self._missed,
            vehicle=None if vehicle is None else _make_vehicle_health(vehicle, self._now_ns),
            recorder=recorder,
            who_flies=flight.handover_state.value,
            ending=flight.account.end_sentence,
            relay=self._make_relay_health(),
            let_go=flight.breach_reason,
            inertial=self._inertial_share,
            cell=cell,
            conduct=conduct,
        )

    def _make_relay_health(self) -> RelayHealth | None:
        stats = self._flight.relay
        if stats is None:
            return None
        last_s = None if stats.last_ns is None else max(0.0, (self._now_ns - stats.last_ns) * 1e-9)
        return RelayHealth(
            sent=stats.sent,
            sent_hz=self._relay_rate[1],
            kept=stats.kept,
            last_s=last_s,
            alone=stats.alone,
            silent_for=stats.silent_for,
            attitude_fault=stats.attitude_fault,
        )


def format_health(health: Health) -> str:
    """Format one line for a log: always the same fields, `-` for unknown ones."""
    vehicle, relay = health.vehicle, health.relay
    battery = None if vehicle is None else vehicle.battery_v
    mode = "-" if vehicle is None else f"{vehicle.mode} {'armed' if vehicle.armed else 'disarmed'}"
    fields = (
        "-" if health.mode is None else health.mode.value,
        f"age {_format_number(health.age_s, '.2f')} s",
        f"loss {_format_number(None if health.loss is None else 100 * health.loss, '.0f')} %",
        f"late {health.lateness_us / 1e3:.2f} ms",
        f"missed {health.missed_ticks}",
        f"vehicle {mode}",
        f"battery {_format_number(battery, '.1f')} V",
        *(() if relay is None else (_format_relay(relay),)),
        *(() if health.inertial is None else (f"inertial {100 * health.inertial:.0f} %",)),
        f"dropped {health.recorder.dropped}" + (f" ({health.recorder.reason})" if health.recorder.reason else ""),
    )
    return "  ".join(fields)


def _select_axes(axes: tuple[tuple[str, int], ...], state: Vector | None) -> dict[str, float] | None:
    return None if state is None else {axis: state[i] for axis, i in axes}


def _make_vehicle_health(vehicle: VehicleStatus, now_ns: int) -> VehicleHealth:
    return VehicleHealth(
        autopilot=vehicle.autopilot,
        mode=vehicle.mode,
        armed=vehicle.armed,
        external=vehicle.external,
        landed=vehicle.landed,
        battery_v=vehicle.battery_v,
        heard_s=max(0.0, (now_ns - vehicle.at_ns) * 1e-9),
    )


def _format_relay(relay: RelayHealth) -> str:
    silent = f" SILENT ({relay.silent_for})" if relay.silent_for else ""
    attitude = f" ATTITUDE ({relay.attitude_fault})" if relay.attitude_fault else ""
    return f"relay {relay.sent_hz:.0f} /s{' alone' if relay.alone else ''}{silent}{attitude}"


def _format_number(value: float | None, spec: str) -> str:
    return "-" if value is None else format(value, spec)
