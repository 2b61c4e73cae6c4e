"""The simulated peers and a controller in lockstep, in virtual time: no socket, no clock."""

from __future__ import annotations

from collections.abc import Callable

from sim.peers import Peers
from sim.script import Script
from uavctl.config.types import Config
from uavctl.data import Flyer, Truth


class World:
    """A flight of `flyer` against the simulated peers; bit-identical for a seed.

    In each tick of the grid start_ns + n tick_s the flyer first gets every datagram that has arrived by
    then, then decides, and what it sends reaches the peers at the same instant. So a sample taken at a boundary
    and not delayed is known to that boundary's decision. What it answers a datagram with reaches the vehicle when
    that one was sent, or with the peers' next doing.

    Args:
        config: the whole configuration; `sim`, `link`, `plant`, `frame` and the tick are used.
        flyer: the controller.
        on_truth: gets the `Truth` of every Δt boundary, see `Peers`.
        on_progress: gets the seconds flown so far, after every Δt.
        start_ns: time of tick 0.
        airborne: whether the vehicle begins in the air, armed and in its external mode; else on the floor, disarmed.
        script: plant, start, disturbances and losses of a flight that is flown again; the `Truth` at its end is told.
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
        script: Script | None = None,
    ) -> None:
        self._flyer = flyer
        self._on_progress = on_progress
        self._start_ns = start_ns
        self._tick_ns = round(config.daemon.tick_s * 1e9)
        self._ticks_per_step = round(config.plant.dt_s / config.daemon.tick_s)
        shared = config.daemon.vehicle == config.daemon.mocap
        self._again = script is not None
        self._ticks = 0
        self.peers = Peers(config, start_ns, airborne=airborne, shared_link=shared, on_truth=on_truth, script=script)

    def run(self, duration_s: float, over: Callable[[], bool] = lambda: False) -> None:
        """Fly on, all the ticks that begin within `duration_s` from the start, or until it is over."""
        for tick in range(self._ticks, round(duration_s * 1e9) // self._tick_ns):
            if over():
                break
            self._tick(tick)
            self._ticks = tick + 1
            if self._on_progress is not None and (tick + 1) % self._ticks_per_step == 0:
                self._on_progress((tick + 1) * self._tick_ns * 1e-9)
        self.peers.flush(self._start_ns + round(duration_s * 1e9) if self._again else None)

    def _tick(self, tick: int) -> None:
        at_ns = self._start_ns + tick * self._tick_ns
        self.peers.converse(at_ns, self._flyer.receive)
        for outgoing in self._flyer.tick(tick, at_ns):
            self.peers.receive(outgoing.link, outgoing.data, at_ns)
