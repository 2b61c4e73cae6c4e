"""Several control loops whose positions share one radio in virtual time: budget, ages, reports, and repetition."""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from logs.recording.fleet_replay import replay_sender
from logs.recording.reader import read_kind
from sim.simulation import FleetWorld, Seat
from uavctl.arrays import SECOND_NS
from uavctl.cli.app import run
from uavctl.clock import VIRTUAL_ZERO_UTC_NS
from uavctl.config import Config, load_config
from uavctl.errors import ConfigError
from uavctl.io.shared_sources import find_shared_sources
from uavctl.lab.lockstep import FlownFleet, fly_fleet
from uavctl.mavlink.connection import MOCAP, make_links
from uavctl.records import Decision, Outgoing, PositionSample, Received, Send, Truth
from uavctl.schedule.ages import compute_periodic_tail
from uavctl.schedule.scheduler import ScheduleName
from uavctl.wiring.controller import build_flight_design, prepare
from uavctl.wiring.radio import RadioConfig, compute_slot_ns, make_link_overrides
from uavctl.wiring.sender import PositionMessage, PositionSender, SentAnswer

FRAME_BYTES = 44
LOSSES = (0.3, 0.0, 0.0)
BYTES_PER_S = 1000.0  # 23 positions a second
PROMPT = ("link.delay_s=0", "link.jitter_s=0", "clock.latency_s=0")


def make_config(number: int, radio: RadioConfig, count: int, seconds: float, *overrides: str) -> Config:
    own = [f"sim.system_id={number + 1}", f"sim.seed={number + 31}", f"duration_s={seconds}"]
    place = f"[0.0,{1.2 * (number - 0.5 * (count - 1))},-1.2]"
    places = [f"sim.start_position_m={place}", f"target.position_m={place}"]
    cameras = [f"sim.camera.rate_hz={radio.rate_hz}"]
    return load_config("room-px4", [*make_link_overrides(radio, count), *own, *places, *cameras, *overrides])


def fly(folder: Path, count: int, radio: RadioConfig, *overrides: str, seconds: float = 4.0) -> FlownFleet:
    configs = [make_config(number, radio, count, seconds, *overrides) for number in range(count)]
    return fly_fleet([prepare(config, build_flight_design(config)) for config in configs], folder, radio=radio)


def read_sent(flight: FlownFleet) -> list[tuple[int, dict[str, object]]]:
    """Return time and content of each message in the sender's recording."""
    assert flight.sender_path is not None
    with flight.sender_path.open("rb") as file:
        messages = list(make_reader(file).iter_messages(topics=["/uavctl/sender"]))
    return [(message.log_time - VIRTUAL_ZERO_UTC_NS, json.loads(message.data)) for _, _, message in messages]


RADIO = RadioConfig(bytes_per_s=BYTES_PER_S, rate_hz=20.0, schedule="oldest-first", loss=0.3, feedback_s=0.001)


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> FlownFleet:
    """Three vehicles on a radio for about one position in three, with reports at once."""
    return fly(tmp_path_factory.mktemp("three"), 3, RADIO, *PROMPT)


def test_a_replay_of_the_sender_gives_each_message_again(three: FlownFleet) -> None:
    assert three.sender_path is not None
    result = replay_sender(three.sender_path)
    assert result.identical and not result.lacks_end
    assert result.decisions == len(read_sent(three)) > 60


def test_no_second_carries_more_than_the_budget(three: FlownFleet) -> None:
    sent = read_sent(three)
    bytes_by_second = Counter[int]()
    for at_ns, message in sent:
        bytes_by_second[at_ns // SECOND_NS] += int(str(message["bytes"]))
    # The cameras give more than the channel carries; the last message of a second may end in the next one.
    for second in (1, 2):
        assert BYTES_PER_S - FRAME_BYTES <= bytes_by_second[second] <= BYTES_PER_S + FRAME_BYTES
    assert max(bytes_by_second.values()) <= BYTES_PER_S + FRAME_BYTES
    # What goes out is what reaches the links of the vehicles.
    vehicles = Counter(message["vehicle"] for _, message in sent)
    last = {path.parent.name: list(read_kind(path, Truth))[-1] for path in three.paths}
    for name, truth in last.items():
        assert 0 <= vehicles[name] - truth.sent <= 1
        assert 0.1 < truth.lost / truth.sent < 0.5


def test_the_same_seeds_give_the_same_messages_and_flights(three: FlownFleet, tmp_path: Path) -> None:
    again = fly(tmp_path, 3, RADIO, *PROMPT)
    assert read_sent(again) == read_sent(three)
    for path, other in zip(again.paths, three.paths, strict=True):
        assert list(read_kind(path, Truth)) == list(read_kind(other, Truth))


def test_each_recording_replays_alone(three: FlownFleet) -> None:
    for path in three.paths:
        assert run(["log", "replay", str(path)]) == 0


def test_a_lone_vehicle_on_a_wide_radio_decides_as_without_a_sender(tmp_path: Path) -> None:
    radio = RadioConfig(messages_per_s=2000.0, rate_hz=50.0, loss=0.3)
    lossy = ('link.model="bernoulli"',)
    config = make_config(0, radio, 1, 4.0, *lossy)
    alone = fly_fleet([prepare(config, build_flight_design(config))], tmp_path / "alone")
    served = fly(tmp_path / "served", 1, radio, *lossy)
    (path,), (other,) = alone.paths, served.paths
    assert len(read_sent(served)) == list(read_kind(path, Truth))[-1].sent
    decisions = list(read_kind(path, Decision))
    assert len({decision.mode for decision in decisions}) > 1
    assert list(read_kind(other, Decision)) == decisions
    assert list(read_kind(other, Truth)) == list(read_kind(path, Truth))


def test_a_radio_without_a_budget_or_with_too_short_a_wait_is_refused(tmp_path: Path) -> None:
    config = make_config(0, RADIO, 1, 1.0)
    one = prepare(config, build_flight_design(config))
    for radio, message in ((RadioConfig(rate_hz=20.0), "budget"), (RADIO, "sim.system_id")):
        with pytest.raises(ConfigError, match=message):
            fly_fleet([one, one], tmp_path / message, radio=radio)
    with pytest.raises(ConfigError, match=r"radio\.max_wait_s"):
        short = RadioConfig(bytes_per_s=BYTES_PER_S, max_wait_s=0.06)
        fly_fleet([one, one], tmp_path / "short", radio=short)


class Listener:
    """Receiver of positions that never flies: it reports each newest one, and keeps the ages at the ticks."""

    def __init__(self, config: Config) -> None:
        self._link = make_links(config)[MOCAP]
        self._newest_ns = 0
        self.ages_ns: list[int] = []
        self.arrivals: list[tuple[int, int]] = []  # times of arrival and capture

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        if link != MOCAP:
            return Received((), False, False)
        result = self._link.receive(data, at_ns)
        for item in result.items:
            if isinstance(item, PositionSample):
                self.arrivals.append((at_ns, item.captured_ns))
                self._newest_ns = max(self._newest_ns, item.captured_ns)
        return Received(tuple(Outgoing(link=MOCAP, data=reply) for reply in result.replies), False, False)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        del tick, send
        self.ages_ns.append(at_ns - self._newest_ns)


class WatchedSender(PositionSender):
    """Sender that keeps its messages."""

    def __init__(self, configs: Sequence[Config], radio: RadioConfig) -> None:
        sources = find_shared_sources([f"udpin://0.0.0.0:{14600 + number}" for number in range(len(configs))])
        super().__init__(configs, sources, radio, spacing_m=0.0, start_ns=0, keeps_stamps=True)
        self.messages: list[tuple[int, PositionMessage]] = []

    def send_next(self, at_ns: int) -> PositionMessage | SentAnswer | None:
        sent = super().send_next(at_ns)
        if isinstance(sent, PositionMessage):
            self.messages.append((at_ns, sent))
        return sent


def listen(configs: Sequence[Config], sender: PositionSender | None, seconds: float) -> list[Listener]:
    listeners = [Listener(config) for config in configs]
    seats = [Seat(config, listener) for config, listener in zip(configs, listeners, strict=True)]
    FleetWorld(seats, sender=sender).run(seconds)
    return listeners


@pytest.mark.parametrize("schedule", ["round-robin", "oldest-first", "value"])
def test_with_prompt_reports_the_believed_age_is_the_true_one(schedule: ScheduleName) -> None:
    radio = RadioConfig(bytes_per_s=BYTES_PER_S, rate_hz=20.0, schedule=schedule, loss=0.3, feedback_s=0.001)
    configs = [make_config(number, radio, 3, 8.0, *PROMPT, f"link.loss={loss}") for number, loss in enumerate(LOSSES)]
    sender = WatchedSender(configs, radio)
    listeners = listen(configs, sender, 8.0)
    arrivals = [{arrival_ns for arrival_ns, _ in listener.arrivals} for listener in listeners]
    last: dict[int, tuple[int, int]] = {}  # times of sending and capture of the last message to each vehicle
    compared = 0
    for at_ns, sent in sender.messages:
        for number, (sent_ns, captured_ns) in last.items():
            # A message without a report leaves doubt; the first vehicle's messages and reports may be lost.
            if number > 0 and sent_ns in arrivals[number]:
                assert sent.ages_s[number] == pytest.approx(1e-9 * (at_ns - captured_ns))
                compared += 1
        last[sent.vehicle] = at_ns, sent.captured_ns
    assert compared > 250
    assert [len(heard) < sender.sent[number] for number, heard in enumerate(arrivals)] == [True, False, False]


def test_ages_are_those_of_the_scheduled_link() -> None:
    count, seconds, loss = 4, 14.0, 0.3
    # Cameras far quicker than the radio: a position that goes out is new, as in the chain over (slot, age).
    radio = RadioConfig(messages_per_s=20.0, rate_hz=100.0, schedule="round-robin", loss=loss)
    tick = "daemon.tick_s=0.01"
    configs = [make_config(number, radio, count, seconds, *PROMPT, tick) for number in range(count)]
    slot_ns, begin = compute_slot_ns(radio), 200  # two seconds later, earlier messages are gone
    served = listen(configs, WatchedSender(configs, radio), seconds)
    own_links = listen(configs, None, seconds)
    tail = compute_periodic_tail(range(count), 0, loss, 30)
    messages = 240
    for listeners in (served, own_links):
        ages_ns = np.array([listener.ages_ns[begin:] for listener in listeners])
        for slots in (1, 3, 5, 8, 12):
            # Between two slots the age grows with time, so the tail of continuous ages is linear there.
            expected, measured = tail[slots], float((ages_ns >= slots * slot_ns).mean())
            # Ticks have the resolution of a fifth of a slot; three standard errors of a share of all messages.
            error = 0.2 / count + 3.0 * (expected * (1.0 - expected) / messages) ** 0.5
            assert measured == pytest.approx(expected, abs=error)
