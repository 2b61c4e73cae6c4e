"""Simulation in lockstep: vehicle, autopilot, cameras and channel in virtual time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from sim.autopilot.autopilot import Autopilot
from sim.cameras import Cameras
from sim.channel import Channel, find_earliest_ns, is_within
from sim.faults import Faults, find_active_faults, merge_fault_spans
from sim.radio import Sender, SharedRadio
from sim.vehicle.linear import LinearVehicle, make_linear_model
from sim.vehicle.quadrotor import STEP_S, Quadrotor
from sim.wind import Wind
from sim.world import Interactions, OnCollision, WorldBody
from uavctl.config.types import Config
from uavctl.errors import ConfigError
from uavctl.records import ClosestApproach, Collision, Flyer, Received, Send, Truth, Vec3


@dataclass(frozen=True)
class VehicleSnapshot:
    """State of one vehicle at a moment, for display; positions and velocities are the true ones, local NED."""

    system_id: int  # MAVLink system id
    time_s: float  # since the start
    mode: str  # the autopilot's own name of it, or CRASHED
    armed: bool  # whether it is armed
    phase: str  # where it is: ground, air, climb, descent
    position_m: Vec3  # position
    velocity_mps: Vec3  # velocity
    battery: float  # charge left, 0 to 1
    # (system, component) id of the sender of the last setpoint, None before the first
    setpoint_source: tuple[int, int] | None
    setpoint_age_s: float | None  # time since that setpoint, None before the first
    sent: int  # positions that the cameras sent
    lost: int  # those of them that the link lost
    faults: tuple[str, ...]  # kinds of the active faults
    text: str  # the last STATUSTEXT


VEHICLE, MOCAP = "vehicle", "mocap"
COLLISION_FAULT = "collision"  # of a truth, from a collision on
Due = tuple[int, str, bytes]  # (at_ns, link, datagram)
Handler = Callable[[str, bytes, int], Received]  # of a datagram: link, bytes and time


class Peers:
    """Vehicle, autopilot, cameras and the radio channel that carries positions.

    The vehicle's link is a wire: no loss (but for `link.uplink_blackout`), no delay. Positions go through the channel.
    With `shared_link` (one URL for both) positions come on the vehicle's link, still through the channel. With a radio
    that several vehicles share (`join_radio`), positions go through its sender first.

    `on_truth` gets one `Truth` for every boundary start_ns + k Δt: the state x(k), and the input that acts
    from there on. It is therefore called when time moves *past* the boundary: what arrives at the
    boundary's own instant is already in it, what arrives later (on real sockets, a fraction of a
    millisecond) is not.
    """

    def __init__(
        self,
        config: Config,
        start_ns: int,
        *,
        airborne: bool = True,
        shared_link: bool = False,
        on_truth: Callable[[Truth], None] | None = None,
    ) -> None:
        config = self._config = merge_fault_spans(config)
        vehicle_seed, camera_seed, channel_seed, inertial_seed = _spawn_seeds(config)[:4]
        self.vehicle: LinearVehicle | Quadrotor
        if config.sim.plant == "quadrotor":
            self.vehicle = make_quadrotor(config, vehicle_seed, start_ns)
        else:
            self.vehicle = LinearVehicle(config, vehicle_seed, start_ns)
        self.autopilot = Autopilot(config, self.vehicle, start_ns, inertial_seed, airborne=airborne)
        self.channel = Channel(config.link, channel_seed, start_ns, round(config.plant.dt_s * 1e9))
        self.cameras = Cameras(config.sim.camera, config.frame, camera_seed, start_ns)
        self._faults = Faults(config, self.vehicle, self.autopilot, self.cameras, start_ns)
        self._airborne = airborne
        self._start_ns = start_ns
        self._mocap_link = VEHICLE if shared_link else MOCAP
        self._on_truth = on_truth
        self._truth_ns = start_ns  # boundary of the next truth
        self._outbox: deque[Due] = deque()  # in order of time
        self._radio: SharedRadio | None = None
        self._number = 0  # on the radio

    def join_radio(self, radio: SharedRadio, number: int) -> None:
        """Give all positions to a radio from now on, as those of its vehicle `number`."""
        self._radio, self._number = radio, number

    @property
    def now_ns(self) -> int:
        """Present time [ns]."""
        return self.vehicle.now_ns

    @property
    def next_ns(self) -> int:
        """Time of the next event [ns]: a datagram to send, a sample, or an act of the vehicle."""
        times = [self.next_action_ns, self._truth_ns + 1, self.channel.next_ns]
        if self._outbox:
            times.append(self._outbox[0][0])
        return min(at_ns for at_ns in times if at_ns is not None)

    @property
    def next_action_ns(self) -> int:
        """Time at which cameras, autopilot or a fault act next [ns]."""
        return self._find_next_action_ns(self.autopilot.next_ns, self._faults.next_ns)

    def _find_next_action_ns(self, autopilot_ns: int | None, fault_ns: int | None) -> int:
        event_ns = find_earliest_ns((autopilot_ns, fault_ns))
        return self.cameras.next_ns if event_ns is None else min(self.cameras.next_ns, event_ns)

    def advance(self, to_ns: int) -> list[Due]:
        """Move time on; return the datagrams due up to and including `to_ns`, in order of time."""
        self.run_events(to_ns)
        return self._take_due(to_ns)

    def _take_due(self, to_ns: int) -> list[Due]:
        due = [*self._outbox, *((at_ns, self._mocap_link, data) for at_ns, data in self.channel.pop_due(to_ns))]
        self._outbox.clear()
        due.sort(key=lambda datagram: datagram[0])  # stable: the vehicle first
        return due

    def exchange_next(self, to_ns: int, handle: Handler) -> int:
        """Advance to the next event, at most to `to_ns`, and pass on every datagram in order of time; return that time.

        The peers receive answers at the reached time. Time stops only at events of the peers: more stops would change
        the rounding of their motion.
        """
        at_ns = self._run_next_events(to_ns)
        for arrival_ns, link, data in self._take_due(at_ns):
            for answer in handle(link, data, arrival_ns).answers:
                self._report(answer.link, answer.data, arrival_ns)
                self.receive(answer.link, answer.data, at_ns)
        return at_ns

    @property
    def next_position_ns(self) -> int | None:
        """Time at which the channel delivers the next position [ns]; None if none is under way."""
        return self.channel.next_ns

    def deliver_positions(self, to_ns: int, handle: Handler) -> None:
        """Pass on the positions that arrive up to and including `to_ns`, without moving time on."""
        for arrival_ns, data in self.channel.pop_due(to_ns):
            for answer in handle(self._mocap_link, data, arrival_ns).answers:
                self._report(answer.link, answer.data, arrival_ns)

    def _report(self, link: str, data: bytes, at_ns: int) -> None:
        """Send what answers a position back over the radio."""
        if self._radio is not None and link == self._mocap_link:
            self._radio.add_report(self._number, at_ns, data)

    def exchange(self, to_ns: int, handle: Handler) -> None:
        """Advance time and pass on every datagram in order of time; see `exchange_next`."""
        while self.exchange_next(to_ns, handle) < to_ns:
            pass

    def receive(self, link: str, data: bytes, at_ns: int) -> None:
        """Take one datagram of the controller at `at_ns`; the cameras take none."""
        self.run_events(at_ns)
        if link == VEHICLE and not is_within(self._config.link.uplink_blackout, at_ns - self._start_ns):
            self._outbox.extend((at_ns, VEHICLE, answer) for answer in self.autopilot.receive(data, at_ns))

    def make_sender(self, at_ns: int) -> Send:
        """Return a function that takes the datagrams which the controller sends at `at_ns`."""
        return lambda outgoing: self.receive(outgoing.link, outgoing.data, at_ns)

    def read_truth(self) -> Truth:
        """Return the true state now, and the input that acts from now on."""
        return Truth(
            at_ns=self.now_ns,
            position_m=self.vehicle.position_m,
            velocity_mps=self.vehicle.velocity_mps,
            state=tuple(self.vehicle.state.tolist()),
            input=tuple(self.vehicle.input.tolist()),
            sent=self.channel.counters.sent,
            lost=self.channel.counters.lost,
            mode=self.autopilot.mode_name,
            faults=self._active_faults,
        )

    @property
    def _active_faults(self) -> tuple[str, ...]:
        """Kinds of the faults that act now; a random occlusion and a past collision are such too."""
        faults = find_active_faults(self._config, self.now_ns - self._start_ns)
        if self.vehicle.is_wrecked:
            faults = (*faults, COLLISION_FAULT)
        return (*faults, "occluded") if self.cameras.is_occluded and "occluded" not in faults else faults

    def take_snapshot(self) -> VehicleSnapshot:
        """Return a snapshot of the vehicle."""
        pilot, counters = self.autopilot.pilot, self.channel.counters
        setpoint_ns = pilot.setpoint_ns
        return VehicleSnapshot(
            system_id=self._config.sim.system_id,
            time_s=(self.now_ns - self._start_ns) * 1e-9,
            mode=self.autopilot.mode_name,
            armed=pilot.is_armed,
            phase=pilot.phase.name.lower(),
            position_m=self.vehicle.position_m,
            velocity_mps=self.vehicle.velocity_mps,
            battery=self.autopilot.vehicle.battery.remaining,
            setpoint_source=self.autopilot.setpoint_source,
            setpoint_age_s=None if setpoint_ns is None else (self.now_ns - setpoint_ns) * 1e-9,
            sent=counters.sent,
            lost=counters.lost,
            faults=self._active_faults,
            text=self.autopilot.last_text,
        )

    def flush(self) -> None:
        """Report the truth of a boundary that time has reached but not passed; for the end of a run."""
        if self._truth_ns == self.now_ns:
            self._report_truth()

    def run_events(self, to_ns: int) -> None:
        """Move time on; what is sent until then waits."""
        while self._run_next_events(to_ns) < to_ns:
            pass

    def _run_next_events(self, to_ns: int) -> int:
        """Move time on to the next event, at most to `to_ns`, and act on all that is due then; return that time."""
        autopilot_ns, fault_ns = self.autopilot.next_ns, self._faults.next_ns
        stop_ns = max(min(self._find_next_action_ns(autopilot_ns, fault_ns), to_ns), self.now_ns)
        self._advance_vehicle(stop_ns)
        has_acted = True
        while has_acted:
            has_acted = False
            if fault_ns is not None and fault_ns <= stop_ns:
                self._faults.run(stop_ns)
                has_acted = True
            if autopilot_ns is not None and autopilot_ns <= stop_ns:
                self._outbox += [(stop_ns, VEHICLE, data) for data in self.autopilot.run(stop_ns)]
                has_acted = True
            if self.cameras.next_ns <= stop_ns:
                self._capture_position(stop_ns)
                has_acted = True
            if has_acted:
                autopilot_ns, fault_ns = self.autopilot.next_ns, self._faults.next_ns
        return stop_ns

    def _capture_position(self, at_ns: int) -> None:
        vehicle = self.vehicle
        sample = self.cameras.capture(vehicle.position_m, vehicle.velocity_mps, vehicle.attitude)
        if self._radio is not None:
            if sample is not None:
                self._radio.add_position(self._number, *sample)
        elif sample is None:
            self.channel.skip_packet(at_ns)
        else:
            self.send_position(*sample)

    def send_position(self, at_ns: int, data: bytes) -> None:
        """Put a position on the channel to the controller."""
        # A flight that begins in the air begins with a known position: a(0) = 0, as in the paper.
        self.channel.push(at_ns, data, is_certain=self._airborne and not self.channel.counters.sent)

    def _advance_vehicle(self, to_ns: int) -> None:
        while self._truth_ns < to_ns:
            self.vehicle.advance(self._truth_ns)
            self._report_truth()
        self.vehicle.advance(to_ns)

    def _report_truth(self) -> None:
        self._truth_ns += self.vehicle.model.dt_ns
        if self._on_truth is not None:
            self._on_truth(self.read_truth())


def _spawn_seeds(config: Config) -> list[np.random.SeedSequence]:
    """Return the seeds of vehicle, cameras, channel of positions, inertial sensors, and channel of reports."""
    return np.random.SeedSequence(config.sim.seed).spawn(5)


def _make_shared_radio(configs: Sequence[Config], peers: Sequence[Peers], sender: Sender, start_ns: int) -> SharedRadio:
    """Make the radio of a sender, which all peers join."""
    channels = [Channel(one.link, _spawn_seeds(one)[4], start_ns, round(one.plant.dt_s * 1e9)) for one in configs]
    radio = SharedRadio(sender, channels)
    for number, one in enumerate(peers):
        one.join_radio(radio, number)
    return radio


def _remove_turns(config: Config) -> Config:
    """Return a configuration whose link has no turns (`scheduled`), since a sender takes them; its loss stays."""
    if config.link.model != "scheduled":
        return config
    return msgspec.structs.replace(config, link=msgspec.structs.replace(config.link, model="bernoulli"))


def make_quadrotor(config: Config, seed: np.random.SeedSequence, start_ns: int) -> Quadrotor:
    """Make the quadrotor of a configuration with its wind; the seed is that of the gusts."""
    sim = config.sim
    return Quadrotor(
        make_linear_model(config.plant),
        sim.autopilot,
        Wind(sim.wind.velocity_mps, sim.wind.gust_wind_mps, sim.wind.height_m, STEP_S, seed),
        start_ns,
        position_m=sim.start_position_m,
        velocity_mps=sim.start_velocity_mps,
        charge=sim.quadrotor.charge,
    )


class SharedSpace:
    """Peers of vehicles in one space: time moves on for all of them, and they act on each other as `Interactions` says.

    Their events are run in order of time, those of one time by the vehicle's number, then those of the radio that they
    share. A vehicle alone is left to itself.

    Args:
        radio: the radio that all peers have joined, which acts in `exchange`; None: positions go their own ways.

    Raises:
        ConfigError: vehicles touch at the start.
    """

    def __init__(
        self,
        configs: Sequence[Config],
        peers: Sequence[Peers],
        on_collision: OnCollision | None = None,
        radio: SharedRadio | None = None,
    ) -> None:
        self.peers = tuple(peers)
        self._radio = radio
        self._interactions = None
        if len(peers) > 1:
            bodies = [
                WorldBody(config.sim.system_id, one.vehicle, config.sim.radius_m, config.sim.downwash)
                for config, one in zip(configs, peers, strict=True)
            ]
            self._interactions = Interactions(bodies, peers[0].now_ns, on_collision)

    @property
    def collisions(self) -> tuple[Collision, ...]:
        """All collisions so far, in order of time."""
        return () if self._interactions is None else tuple(self._interactions.collisions)

    @property
    def closest_approaches(self) -> tuple[ClosestApproach, ...]:
        """Least distance of each pair so far."""
        return () if self._interactions is None else self._interactions.closest_approaches

    def exchange(self, to_ns: int, handlers: Sequence[Handler]) -> None:
        """Advance time and pass on every datagram to its vehicle's handler; see `Peers.exchange_next`."""
        self._interact(to_ns, lambda at_ns: self._exchange_events(at_ns, handlers))
        self._exchange_events(to_ns, handlers)

    def advance(self, to_ns: int) -> list[list[Due]]:
        """Move time on; return the datagrams of each vehicle due up to and including `to_ns`, in order of time."""
        self.interact(to_ns)
        return [peers.advance(to_ns) for peers in self.peers]

    def interact(self, to_ns: int) -> None:
        """Move time on to the last interaction up to and including `to_ns`; what is sent until then waits."""
        self._interact(to_ns, self._run_events)

    def _interact(self, to_ns: int, advance: Callable[[int], None]) -> None:
        interactions = self._interactions
        while interactions is not None and interactions.next_ns <= to_ns:
            advance(interactions.next_ns)
            interactions.run()

    def _run_events(self, to_ns: int) -> None:
        for peers in self.peers:
            peers.run_events(to_ns)

    def _exchange_events(self, to_ns: int, handlers: Sequence[Handler]) -> None:
        waiting = {number: peers.next_action_ns for number, peers in enumerate(self.peers)}
        while waiting:
            number = min(waiting, key=lambda each: (min(waiting[each], to_ns), each))
            self._run_radio(min(waiting[number], to_ns) - 1, handlers)
            if self.peers[number].exchange_next(to_ns, handlers[number]) >= to_ns:
                del waiting[number]
            else:
                waiting[number] = self.peers[number].next_action_ns
        self._run_radio(to_ns, handlers)

    def _run_radio(self, to_ns: int, handlers: Sequence[Handler]) -> None:
        if self._radio is not None:
            self._radio.run(
                to_ns, self.peers, lambda number, at_ns: self.peers[number].deliver_positions(at_ns, handlers[number])
            )


@dataclass(frozen=True)
class Seat:
    """A vehicle of a world in lockstep: its configuration, what flies it, and the receiver of its truth."""

    config: Config
    flyer: Flyer
    on_truth: Callable[[Truth], None] | None = None


class FleetWorld:
    """Flights of several vehicles in one space, each by its own flyer; bit-identical for their seeds.

    In each tick of the grid start_ns + n tick_s each flyer first gets every datagram that has arrived by
    then; then they decide, in order of their number, and what they send reaches their peers at the same instant. So a
    sample taken at a boundary and not delayed is known to that boundary's decision. The answer to a datagram reaches
    the vehicle at the time of that datagram, or with the peers' next event.

    Args:
        seats: the vehicles; of a configuration `sim`, `link`, `plant`, `frame` and the tick are used. All have the
            same tick and Δt.
        on_progress: gets the seconds flown so far, after every Δt.
        on_collision: gets every collision.
        sender: sends all positions over one channel; the links act on what it sends, without `scheduled` turns.
        start_ns: time of tick 0.
        airborne: whether the vehicles begin in the air, armed and in their external mode; else on the floor, disarmed.

    Raises:
        ConfigError: ticks or Δt differ, or vehicles touch at the start.
    """

    def __init__(
        self,
        seats: Sequence[Seat],
        on_progress: Callable[[float], None] | None = None,
        on_collision: OnCollision | None = None,
        *,
        sender: Sender | None = None,
        start_ns: int = 0,
        airborne: bool = True,
    ) -> None:
        configs = [seat.config if sender is None else _remove_turns(seat.config) for seat in seats]
        _check_equal_grids(configs)
        first = configs[0]
        self._flyers = tuple(seat.flyer for seat in seats)
        self._on_progress = on_progress
        self._start_ns = start_ns
        self._tick_ns = round(first.daemon.tick_s * 1e9)
        self._ticks_per_step = round(first.plant.dt_s / first.daemon.tick_s)
        self._ticks = 0
        all_peers = [
            Peers(
                config,
                start_ns,
                airborne=airborne,
                shared_link=config.daemon.vehicle == config.daemon.mocap,
                on_truth=seat.on_truth,
            )
            for config, seat in zip(configs, seats, strict=True)
        ]
        radio = None if sender is None else _make_shared_radio(configs, all_peers, sender, start_ns)
        self.space = SharedSpace(configs, all_peers, on_collision, radio)

    def run(self, duration_s: float, is_done: Callable[[], bool] = lambda: False) -> None:
        """Fly all the ticks that begin within `duration_s` from the start, or until the flyers are done."""
        for tick in range(self._ticks, round(duration_s * 1e9) // self._tick_ns):
            if is_done():
                break
            self._run_tick(tick)
            self._ticks = tick + 1
            if self._on_progress is not None and (tick + 1) % self._ticks_per_step == 0:
                self._on_progress((tick + 1) * self._tick_ns * 1e-9)
        for peers in self.space.peers:
            peers.flush()

    def _run_tick(self, tick: int) -> None:
        at_ns = self._start_ns + tick * self._tick_ns
        self.space.exchange(at_ns, [flyer.receive for flyer in self._flyers])
        for flyer, peers in zip(self._flyers, self.space.peers, strict=True):
            flyer.tick(tick, at_ns, peers.make_sender(at_ns))


def _check_equal_grids(configs: Sequence[Config]) -> None:
    for key, values in (
        ("daemon.tick_s", [config.daemon.tick_s for config in configs]),
        ("plant.dt_s", [config.plant.dt_s for config in configs]),
    ):
        if len(set(values)) > 1:
            listed = ", ".join(f"{value:g}" for value in values)
            raise ConfigError((f"{key}: vehicles of one world differ ({listed} s); give all the same",))


class World(FleetWorld):
    """Flight of one vehicle by `flyer`; see `FleetWorld`.

    Args:
        config: the whole configuration.
        on_truth: gets the `Truth` of every Δt boundary, see `Peers`.
    """

    def __init__(
        self,
        config: Config,
        flyer: Flyer,
        on_truth: Callable[[Truth], None] | None = None,
        on_progress: Callable[[float], None] | None = None,
        *,
        start_ns: int = 0,
        airborne: bool = True,
    ) -> None:
        super().__init__((Seat(config, flyer, on_truth),), on_progress, start_ns=start_ns, airborne=airborne)

    @property
    def peers(self) -> Peers:
        """The vehicle's peers; new ones take the place of the old ones, as after a restart."""
        return self.space.peers[0]

    @peers.setter
    def peers(self, peers: Peers) -> None:
        self.space = SharedSpace((), (peers,))
