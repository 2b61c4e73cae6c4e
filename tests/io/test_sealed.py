"""Flights behind signed connections, in virtual time: strangers, floods, replays; and what the recording holds."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
from daemon_rig import DaemonRig, PeerConnection
from loopback_rig import MemorySink, make_loop
from mavlink_rig import Peer
from signing_rig import EPOCH_S, KEY, OFFSET_NS, OTHER_KEY, SECOND, STAMP, SignedPeer, frames, make_signing, sign
from transport_rig import IdleConnection

from logs.recording.replay import replay
from logs.recording.topics import encode
from uavctl.clock import Ticker
from uavctl.config import load_config
from uavctl.daemon.daemon import fly
from uavctl.errors import ConnectionSpecError, KeyFileError
from uavctl.io.base import Connection
from uavctl.io.signed_connection import SignedConnection, open_links, sign_connections
from uavctl.mavlink.signing import MAX_TIMESTAMP, FrameAuthenticator, FrameSigner, SigningKey, SigningTimestamps
from uavctl.records import ControlMode, Datagram, Decision, Event, LinkStats, Refused, Setpoint

VEHICLE_ON_HOLD = {"custom_mode": (4 << 16) | (3 << 24)}


class SignedWire(PeerConnection):
    """The simulated peers, who sign what they say; and an attacker on the same wire."""

    def __init__(self, bench: AttackBench, name: str, link_id: int) -> None:
        super().__init__(bench, name)
        self._attack, self._link_id = bench.attack, link_id
        self._stamp = STAMP
        self._their_door = FrameAuthenticator(
            FrameSigner(SigningKey(KEY), 0, SigningTimestamps(), OFFSET_NS), stream=False
        )
        self.heard: deque[bytes] = deque(maxlen=5000)
        self._signed: list[tuple[bytes, int]] = []
        self.unsigned = self.copied = 0

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        self.speaks()
        genuine, self._signed = self._signed, []
        return self._attack(self, genuine)

    def speaks(self) -> list[bytes]:
        """What is on the wire and has not been read, as it will be."""
        fresh = []
        for data, at_ns in super().receive(read_all=True):
            signed = b"".join(self._sign(frame) for frame in frames(data))
            self.heard.append(signed)
            fresh.append(signed)
            self._signed.append((signed, at_ns))
        self.copied += len(fresh)
        return fresh

    def _sign(self, frame: bytes) -> bytes:
        self._stamp += 7
        return sign(frame, self._stamp, link_id=self._link_id)

    def send(self, data: bytes) -> None:
        plain = self._their_door.verify_frames(data, self._bench.now_ns)
        if not plain:
            self.unsigned += 1
            return
        super().send(plain)


class AttackBench(DaemonRig):
    """The daemon's cycle behind doors."""

    def __init__(self) -> None:
        super().__init__()
        self.stamps = SigningTimestamps()
        wires = {name: SignedWire(self, name, link_id) for link_id, name in enumerate(("vehicle", "mocap"), 3)}
        self.wires = wires
        self.doors = {
            name: SignedConnection(wire, FrameAuthenticator(self.signing(n), stream=False), now=lambda: self.now_ns)
            for n, (name, wire) in enumerate(wires.items())
        }
        self.connections: dict[str, Any] = dict(self.doors)

    def signing(self, link_id: int) -> FrameSigner:
        return FrameSigner(SigningKey(KEY), link_id, self.stamps, OFFSET_NS)

    def attack(self, wire: SignedWire, genuine: list[tuple[bytes, int]]) -> list[tuple[bytes, int]]:
        return genuine


class Flood(AttackBench):
    """1000 datagrams a tick (20,000 a second) of one kind on the vehicle's wire, around the genuine ones."""

    def __init__(self, words: list[bytes]) -> None:
        super().__init__()
        self.words = words

    def attack(self, wire: SignedWire, genuine: list[tuple[bytes, int]]) -> list[tuple[bytes, int]]:
        if wire is not self.wires["vehicle"] or not genuine:
            return genuine
        words = self.words or list(wire.heard)[:-1]
        flood = [(words[n % len(words)], self.now_ns) for n in range(1000)] if words else []
        return [*flood[:500], *genuine, *flood[500:]]


def flown(bench: DaemonRig, duration_s: float = 2.5) -> list[Any]:
    """What was decided and sent: equal for equal flights."""
    bench.fly(duration_s=duration_s, stop_limit_s=0.0)
    return [bench.memory.of(kind) for kind in (Decision, Setpoint)]


def refused(bench: DaemonRig) -> Counter[str]:
    total: Counter[str] = Counter()
    for record in bench.memory.of(Refused):
        total.update(record.counts)
    return total


@pytest.fixture(scope="module")
def plain_flight() -> list[Any]:
    return flown(DaemonRig())


def test_a_signed_flight_is_the_same_flight(plain_flight: list[Any]) -> None:
    bench = AttackBench()
    assert flown(bench) == plain_flight
    assert not refused(bench)
    assert bench.wires["vehicle"].unsigned == bench.wires["mocap"].unsigned == 0
    assert bench.wires["vehicle"].answered and not bench.wires["mocap"].answered


_PEER = Peer()
_FORGER = SignedPeer(OTHER_KEY, MAX_TIMESTAMP - 10**6)


@pytest.mark.slow
@pytest.mark.fault(36, 37, 38, 39)
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([_PEER.heartbeat(**VEHICLE_ON_HOLD) for _ in range(100)], "unsigned"),
        ([_FORGER.heartbeat(**VEHICLE_ON_HOLD) for _ in range(100)], "forged"),
        ([b"x"], "garbage"),
        ([], "replayed"),  # whatever has been heard on the wire
    ],
)
def test_a_flood_changes_nothing_of_a_signed_flight(plain_flight: list[Any], words: list[bytes], reason: str) -> None:
    """20,000 datagrams a second: no decision and no setpoint differs, and the counters tell."""
    bench = Flood(words)
    assert flown(bench) == plain_flight
    counts = refused(bench)
    assert set(counts) == {reason}
    assert counts[reason] > 20_000
    (last, *_) = [s for s in reversed(bench.memory.of(LinkStats)) if s.link == "vehicle"]
    assert last.bad[reason] > 10_000
    told = [event for event in bench.memory.of(Event) if event.code == "dropped"]
    assert 2 <= len(told) <= 7 and reason in told[-1].text  # once a second


class Mirror(AttackBench):
    """Somebody brings what the vehicle and the cameras say to the other one's port, before it comes to its own."""

    def attack(self, wire: SignedWire, genuine: list[tuple[bytes, int]]) -> list[tuple[bytes, int]]:
        (other,) = (one for one in self.wires.values() if one is not wire)
        waiting = [(data, self.now_ns) for data in other.speaks()]
        return [*waiting, *genuine]


@pytest.mark.fault(37)
@pytest.mark.fault(51)
def test_genuine_frames_that_are_delivered_first_at_the_other_port_change_nothing(plain_flight: list[Any]) -> None:
    bench = Mirror()
    assert flown(bench) == plain_flight
    assert sum(wire.copied for wire in bench.wires.values()) > 100
    assert not refused(bench)


@pytest.mark.fault(36)
def test_who_signs_nothing_is_never_flown() -> None:
    bench = AttackBench()
    bench.connections = {
        name: SignedConnection(
            PeerConnection(bench, name), FrameAuthenticator(bench.signing(0), stream=False), now=lambda: bench.now_ns
        )
        for name in ("vehicle", "mocap")
    }
    bench.fly(duration_s=2.0, stop_limit_s=0.0)
    assert {decision.mode for decision in bench.memory.of(Decision)} == {ControlMode.WAIT}
    assert not bench.memory.of(Setpoint)
    assert refused(bench)["unsigned"] > 10


@pytest.mark.fault(40)
def test_a_recording_holds_no_key_and_no_signature_and_replays_without_them() -> None:
    bench = Flood([_FORGER.heartbeat()])
    bench.fly(duration_s=2.0, stop_limit_s=0.0)
    entries = bench.memory.entries
    raw = [record for _, _, record in entries if isinstance(record, Datagram)]
    assert len(raw) > 100 and all(record.data[2] == 0 for record in raw)
    text = b"".join(encode(record) for _, _, record in entries)
    for secret in (KEY, KEY.hex().encode(), KEY.hex().upper().encode()):
        assert secret not in text
    result = replay(entries, lambda sink: make_loop(bench.config, sink))
    assert result.identical and result.first_difference is None
    assert any(isinstance(record, Refused) for _, _, record in entries)


class Canned(IdleConnection):
    """A connection on which some datagrams have arrived."""

    send_errors, receive_errors = 3, 4

    def __init__(self, data: list[bytes]) -> None:
        super().__init__("vehicle")
        self._data = data

    def receive(self, *, read_all: bool = False) -> list[tuple[bytes, int]]:
        return [(data, n) for n, data in enumerate(self._data)]


def key_file(folder: Path) -> Path:
    path = folder / "vehicle.key"
    path.write_text(KEY.hex())
    path.chmod(0o600)
    return path


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "state" / "uavctl"


ON_FREE_PORTS = ("daemon.vehicle=udpin://127.0.0.1:0", "daemon.mocap=udpin://localhost:0")


def test_connections_get_the_doors_that_are_asked_for(tmp_path: Path, state: Path) -> None:
    config = load_config(
        "room-hahn-stursberg", (*ON_FREE_PORTS, f"security.key_file={key_file(tmp_path)}", "security.link_id=9")
    )
    with open_links(config) as connections:
        assert [type(one) for one in connections.values()] == [SignedConnection, SignedConnection]
        assert connections["vehicle"].url == config.daemon.vehicle
        assert connections["vehicle"].fileno() > 0
    assert all(connection.closed for connection in connections.values())
    (stamp,) = state.glob("*.stamp")
    now = int((time.time() - EPOCH_S) * SECOND)
    assert now - 60 * SECOND < int(stamp.read_text()) < now + 60 * SECOND
    only = msgspec.structs.replace(config.security, require=("mocap",))
    with open_links(msgspec.structs.replace(config, security=only)) as connections:
        assert [type(one) is SignedConnection for one in connections.values()] == [False, True]


def test_without_a_key_nothing_is_put_around_and_nothing_written(state: Path) -> None:
    with open_links(load_config("room-hahn-stursberg", ON_FREE_PORTS)) as connections:
        assert not any(isinstance(one, SignedConnection) for one in connections.values())
    one = ("daemon.vehicle=udpin://127.0.0.1:0", "daemon.mocap=udpin://127.0.0.1:0")
    with open_links(load_config("room-hahn-stursberg", one)) as connections:
        assert list(connections) == ["vehicle"]
    assert not state.exists()


@pytest.mark.fault(40)
def test_a_bad_key_or_url_opens_nothing(tmp_path: Path, state: Path) -> None:
    path = key_file(tmp_path)
    path.chmod(0o644)
    with (
        pytest.raises(KeyFileError, match="chmod 600"),
        open_links(load_config("room-hahn-stursberg", (*ON_FREE_PORTS, f"security.key_file={path}"))),
    ):
        raise AssertionError("opened")
    with (
        pytest.raises(ConnectionSpecError),
        open_links(load_config("room-hahn-stursberg", (ON_FREE_PORTS[0], "daemon.mocap=udpin://127.0.0.1:x"))),
    ):
        raise AssertionError("opened")
    assert not state.exists()


@pytest.mark.fault(37)
def test_what_one_run_took_the_next_one_refuses(tmp_path: Path, state: Path) -> None:
    config = load_config("room-hahn-stursberg", (f"security.key_file={key_file(tmp_path)}",))
    stamp = int((time.time() - EPOCH_S) * SECOND)
    peer = SignedPeer(stamp=stamp)
    words = [peer.heartbeat() for _ in range(10)]

    def run(data: list[bytes]) -> tuple[int, Counter[str]]:
        wire = Canned(data)
        with sign_connections({"vehicle": wire}, config.security) as doors:
            return len(doors["vehicle"].receive()), doors["vehicle"].refused

    assert run(words) == (10, Counter())
    assert run(words) == (0, Counter(replayed=10))
    later = SignedPeer(stamp=stamp + 3600 * SECOND)  # whatever the machine takes for a restart
    assert run([later.heartbeat()]) == (1, Counter())


def test_a_door_passes_on_what_concerns_the_connection_alone() -> None:
    signed = SignedPeer()
    wire = Canned([b"x", signed.heartbeat(), Peer().heartbeat(), signed.heartbeat()])
    door = SignedConnection(wire, FrameAuthenticator(make_signing(), stream=False), now=lambda: 0)
    assert (door.url, door.fileno(), door.send_errors, door.receive_errors) == ("test://vehicle", -1, 3, 4)
    wire.refused["not-listed"] = 5
    assert [at_ns for _, at_ns in door.receive()] == [1, 3]
    door.select_peer(1)
    assert wire.answered == [3]
    assert door.refused == {"not-listed": 5, "garbage": 1, "unsigned": 1}
    assert not door.closed
    door.close()
    assert wire.closed and door.closed


@pytest.mark.fault(39)
def test_a_flood_that_holds_nothing_is_taken_by_the_handful() -> None:
    """Twenty datagrams a millisecond would wake the loop a thousand times a tick."""
    config = load_config("room-hahn-stursberg")
    now_ns, looks = [1], [0]

    def wait(connections: Mapping[str, Connection], deadline_ns: int) -> list[str]:
        looks[0] += 1
        now_ns[0] = min(deadline_ns, now_ns[0] + 50_000) if connections else deadline_ns
        return list(connections)

    fly(
        make_loop(config, MemorySink()),
        {"vehicle": Canned([]), "mocap": Canned([])},
        Ticker(50_000_000, 200_000_000, lambda: now_ns[0]),
        lambda: False,
        duration_s=1.0,
        stop_limit_s=lambda: 0.0,
        wait_for=wait,
        now=lambda: now_ns[0],
    )
    assert 0 < looks[0] < 24 * 100  # two for each millisecond
