"""The door of a signed connection: what comes through, and what is counted."""

from __future__ import annotations

import pytest
from mavlink_rig import SECOND, Peer, make_link, read, samples, statuses
from signing_rig import KEY, OTHER_KEY, STAMP, SignedPeer, make_gate, seal, unknown

from uavctl.mavlink.codec import MAX_DATAGRAM_BYTES, StreamDecoder
from uavctl.mavlink.framing import MAX_FAILED
from uavctl.mavlink.signing import MAX_TIMESTAMP, FrameSigner, SignatureRefusal

UNKNOWN = unknown()


def test_several_frames_of_a_datagram_come_through() -> None:
    signed, plain = SignedPeer(), Peer()
    gate = make_gate()
    assert gate.verify_frames(signed.heartbeat() + signed.vision(5), 0) == plain.heartbeat() + plain.vision(5)
    assert not gate.refused


@pytest.mark.fault(36)
@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (Peer().heartbeat(), "unsigned"),
        (Peer().vision(5, v1=True), "unsigned"),
        (SignedPeer(OTHER_KEY).heartbeat(), "forged"),
        (UNKNOWN[:2] + b"\x00" + UNKNOWN[3:], "unsigned"),  # an unknown id, unsigned
        (seal(UNKNOWN, STAMP, OTHER_KEY), "forged"),  # an unknown id of another key
        (seal(UNKNOWN, STAMP), "unknown-message"),  # ours, and of no use
        (SignedPeer().heartbeat()[:-1], "truncated"),
        (b"\xfd\x09\x03" + bytes(40), "garbage"),
        (b"hello", "garbage"),
        (bytes(5000), "oversize"),
    ],
)
def test_what_is_not_signed_with_our_key_stays_outside(data: bytes, reason: str) -> None:
    gate, genuine = make_gate(), SignedPeer(stamp=STAMP + 1)
    assert gate.verify_frames(data, 0) == b""
    assert gate.refused == {reason: 1}
    assert gate.verify_frames(genuine.heartbeat(), 0) == Peer().heartbeat()


def test_a_datagram_of_the_largest_size_is_looked_at() -> None:
    gate, peer = make_gate(), SignedPeer()
    frames = b"".join(peer.vision(5) for _ in range(MAX_DATAGRAM_BYTES // len(SignedPeer().vision(5))))
    data = frames + bytes(MAX_DATAGRAM_BYTES - len(frames))
    assert gate.verify_frames(data, 0) and "oversize" not in gate.refused


@pytest.mark.fault(36, 38)
def test_a_forged_frame_of_an_unknown_id_moves_no_stamp() -> None:
    gate, genuine = make_gate(), SignedPeer()
    assert gate.verify_frames(seal(UNKNOWN, MAX_TIMESTAMP, OTHER_KEY), 0) == b""
    assert sum(bool(gate.verify_frames(genuine.heartbeat(), 0)) for _ in range(1000)) == 1000


@pytest.mark.fault(37)
def test_a_verified_frame_of_an_unknown_id_cannot_be_replayed_either() -> None:
    gate = make_gate()
    frame = seal(UNKNOWN, STAMP)
    gate.verify_frames(frame, 0)
    gate.verify_frames(frame, 0)
    assert gate.refused == {"unknown-message": 1, "replayed": 1}


@pytest.mark.fault(36)
def test_one_bad_frame_spoils_no_other_of_its_datagram() -> None:
    signed, gate = SignedPeer(), make_gate()
    bad = (Peer().heartbeat(), SignedPeer(OTHER_KEY).heartbeat(), seal(UNKNOWN, STAMP, OTHER_KEY))
    data = b"".join(signed.heartbeat() + one for one in bad) + signed.heartbeat()
    assert len(read(gate.verify_frames(data, 0))) == 4
    assert gate.refused == {"unsigned": 1, "forged": 2}


def test_a_hostile_datagram_costs_a_bounded_number_of_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    gate = make_gate()
    hashes: list[bytes] = []

    def verify(signing: FrameSigner, frame: bytes, at_ns: int) -> SignatureRefusal:
        hashes.append(frame)
        return SignatureRefusal.FORGED

    monkeypatch.setattr(FrameSigner, "verify", verify)
    gate.verify_frames(bytes((0xFD, 0, 1)) * 1300, 0)
    assert len(hashes) <= MAX_FAILED + 1


@pytest.mark.parametrize("size", [64, 4096])
def test_a_hostile_stream_costs_a_bounded_number_of_checksums(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    looks = 0

    def fits(frame: bytes, shape: object) -> bool:
        nonlocal looks
        looks += 1
        return False

    decoder, data = StreamDecoder(), b"\xfe" * 65_536
    with monkeypatch.context() as patch:
        patch.setattr("uavctl.mavlink.framing._is_checksum_right", fits)
        for at in range(0, len(data), size):
            decoder.push(data[at : at + size])
    assert looks <= (MAX_FAILED + 1) * len(data) // size
    for _ in range(20):
        found = decoder.push(Peer().heartbeat())
    assert len(found.messages) == 1  # in step again


def test_a_stream_is_cut_anywhere() -> None:
    signed = SignedPeer()
    data = b"".join(signed.vision(n) for n in range(20))
    for size in (1, 7, 64, 1000):
        gate = make_gate(stream=True)
        got = b"".join(gate.verify_frames(data[at : at + size], 0) for at in range(0, len(data), size))
        assert len(read(got)) == 20
        assert not gate.refused


@pytest.mark.fault(36)
def test_each_unsigned_frame_of_a_stream_is_counted() -> None:
    gate, signed, plain = make_gate(stream=True), SignedPeer(), Peer()
    for _ in range(50):
        assert gate.verify_frames(plain.heartbeat(), 0) == b""
    assert gate.verify_frames(signed.heartbeat(), 0)
    assert gate.refused == {"unsigned": 50}


def test_a_stream_finds_its_way_after_garbage() -> None:
    gate, signed = make_gate(stream=True), SignedPeer()
    gate.verify_frames(b"garbage\xfd\xff", 0)  # a length that promises more than will come
    got = b"".join(gate.verify_frames(signed.heartbeat(), 0) for _ in range(20))
    assert len(read(got)) == 20
    assert gate.refused == {"garbage": 1}


def test_what_we_send_is_signed() -> None:
    ours, theirs = make_gate(), SignedPeer()
    peer = Peer(245, 25)
    for frame in (ours.sign_frame(peer.heartbeat(), SECOND), ours.sign_ahead(peer.heartbeat(), 2 * SECOND)):
        (message,) = theirs.mav.parse_buffer(frame) or []
        assert message.get_signed()


@pytest.mark.fault(36)
def test_nothing_unsigned_reaches_the_state_behind_the_door() -> None:
    """The same messages with and without signatures: the link behind sees the signed ones only."""
    gate, link = make_gate(), make_link()
    plain, signed = Peer(), SignedPeer()
    for n, data in enumerate((plain.heartbeat(), plain.vision(5), SignedPeer(OTHER_KEY).heartbeat())):
        assert gate.verify_frames(data, n) == b""
    items = link.receive(gate.verify_frames(signed.heartbeat() + signed.vision(6), 9), 9).items
    assert (len(statuses(items)), len(samples(items))) == (1, 1)
    assert KEY not in gate.verify_frames(signed.heartbeat(), 10)
