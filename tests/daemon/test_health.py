"""The health of a flight: what is known, what is not, once a second."""

from __future__ import annotations

import math

import msgspec
import pytest
from loopback_rig import MemorySink, shared_loop

from sim.simulation import Peers
from uavctl.cli.ctl import describe_relay
from uavctl.config import load_config
from uavctl.daemon.health import Health, HealthMonitor, RecorderHealth, RelayHealth, format_health
from uavctl.records import ControlMode, Ticked

TICK_NS = 50_000_000


class Flight:
    """A flight in virtual time with somebody who watches."""

    def __init__(self, name: str = "room-hahn-stursberg", *overrides: str) -> None:
        config = load_config(name, overrides)
        self.loop = shared_loop(config, MemorySink())
        self.peers = Peers(config, 0)
        self.lines: list[str] = []
        self.dropped = 0
        self.warning = ""
        self.watch = HealthMonitor(self.loop, config, ("one", "udpin://x:1", 7), self._recorder, self.lines.append)
        self.tick = 0
        self.ticked: Ticked | None = None  # the last one

    def _recorder(self) -> RecorderHealth:
        ok = not self.dropped
        return RecorderHealth(
            ok=ok, dropped=self.dropped, reason=self.warning if ok else "disk full", path="f.mcap", unwritten_s=0.0
        )

    def run(self, ticks: int, *, lateness_ns: int = 0, missed: int = 0) -> Health:
        for _ in range(ticks):
            at_ns = self.tick * TICK_NS
            for arrival_ns, link, data in self.peers.advance(at_ns):
                self.loop.receive(link, data, arrival_ns)
            self.ticked = self.loop.tick(self.tick, at_ns, self.peers.make_sender(at_ns), missed)
            self.watch.after_tick(self.ticked, lateness_ns)
            self.tick += 1
        return self.watch.make_health()


def test_before_the_first_tick_nothing_is_known_and_nothing_fails() -> None:
    health = Flight().watch.make_health()
    assert (health.mode, health.age_s, health.position_m, health.vehicle) == (None, None, None, None)
    assert format_health(health).startswith("-  age - s  loss - %")


@pytest.mark.slow
def test_a_flight_in_figures() -> None:
    flight = Flight("room-hahn-stursberg", "link.loss=0.0")
    health = flight.run(200, lateness_ns=700_000)
    assert health.mode is ControlMode.TRACK and health.running_s == 199 * TICK_NS * 1e-9
    assert flight.ticked is not None
    estimate, decision = flight.ticked.estimate, flight.ticked.decision
    assert estimate is not None and decision.target is not None
    # x = (position, velocity, acceleration) of north, east and down
    assert health.position_m == dict(zip(("north", "east", "down"), estimate.mean[0::3], strict=True))
    assert health.velocity_mps == dict(zip(("north", "east", "down"), estimate.mean[1::3], strict=True))
    assert health.target_m == dict(zip(("north", "east", "down"), decision.target[0::3], strict=True))
    assert health.age_s is not None and 0.0 < health.age_s < 0.5
    assert health.loss == 0.0
    assert health.vehicle is not None and health.vehicle.mode == "OFFBOARD" and health.vehicle.heard_s <= 1.0
    assert health.lateness_us == 700.0 and health.missed_ticks == 0
    assert msgspec.json.decode(msgspec.json.encode(health), type=Health) == health


@pytest.mark.slow
@pytest.mark.parametrize("latency_s", [0.0, 0.12])  # steps of 0.05 s: no position is of its own step then
def test_losses_are_those_of_the_link_whatever_the_age(latency_s: float) -> None:
    flight = Flight("room", "link.loss=0.3", "link.jitter_s=0.0", f"link.delay_s={latency_s}", "sim.seed=4")
    assert flight.run(20).loss is None  # a second is not over
    losses = []
    for _ in range(4):
        loss = flight.run(200).loss
        assert loss is not None
        losses.append(loss)
    assert sum(losses) / len(losses) == pytest.approx(0.3, abs=4.0 * math.sqrt(0.3 * 0.7 / 800))


@pytest.mark.slow
def test_without_positions_the_losses_rise_to_all() -> None:
    flight = Flight("room", "link.loss=0.0", "sim.camera.occluded=[[5.0,30.0]]")
    assert flight.run(20).loss is None and flight.run(61).loss == 0.0
    assert flight.run(100).loss == pytest.approx(4.1 / 9.0, abs=0.02)
    assert flight.run(160).loss == 1.0


def test_a_plant_of_two_axes_leaves_the_third_out() -> None:
    health = Flight("paper").run(60)
    assert health.position_m is not None and set(health.position_m) == {"north", "east"}


def test_one_line_a_second_with_the_worst_of_it() -> None:
    flight = Flight()
    flight.run(10)
    flight.run(1, lateness_ns=2_500_000, missed=3)
    flight.run(10)
    assert len(flight.lines) == 1 and "late 2.50 ms  missed 3" in flight.lines[0]
    flight.run(20)
    assert len(flight.lines) == 2 and "late 0.00 ms  missed 3" in flight.lines[1]
    flight.dropped = 12
    flight.run(20)
    assert flight.lines[-1].endswith("dropped 12 (disk full)")


def test_a_disk_that_gets_low_is_told_once_in_a_line_of_its_own() -> None:
    flight = Flight()
    flight.run(25)
    flight.warning = "900 bytes free"
    flight.run(20)
    flight.warning = "800 bytes free"
    flight.run(20)
    flight.dropped = 3
    flight.run(20)
    flight.dropped, flight.warning = 0, ""
    flight.run(20)
    assert [one for one in flight.lines if "recording" in one] == [
        "warning: recording may stop soon: 900 bytes free",
        "warning: recording fails: disk full",
        "recording works again",
    ]
    assert any(one.endswith("dropped 0 (800 bytes free)") for one in flight.lines)


def test_a_relay_that_goes_on_alone_is_told_apart() -> None:
    relay = RelayHealth(sent=90, sent_hz=30.0, kept={}, last_s=0.1, alone=False)
    health = msgspec.structs.replace(Flight().watch.make_health(), relay=relay)
    alone = msgspec.structs.replace(health, relay=msgspec.structs.replace(relay, alone=True))
    without = msgspec.structs.replace(health, relay=None)
    fields = [format_health(one).split("  ") for one in (health, alone, without)]
    assert "relay 30 /s" in fields[0] and "relay 30 /s alone" in fields[1]
    assert not any(one.startswith("relay") for one in fields[2])


def test_the_operator_is_told_a_relay_that_goes_on_alone() -> None:
    relay = RelayHealth(sent=90, sent_hz=30.0, kept={}, last_s=0.1, alone=False)
    both = describe_relay(relay)
    alone = describe_relay(msgspec.structs.replace(relay, alone=True))
    assert alone != both and alone.startswith(both)
