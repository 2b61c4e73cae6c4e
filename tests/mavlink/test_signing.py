"""MAVLink 2 signing against pymavlink's own, and the rules of the specification."""

from __future__ import annotations

import pytest
from mavlink_rig import Peer
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from signing_rig import EPOCH_S, KEY, OFFSET_NS, OTHER_KEY, SECOND, STAMP, SignedPeer, make_signing, seal, sign

from uavctl.mavlink.signing import (
    MAX_LINK_SKEW,
    MAX_TIMESTAMP,
    FrameSigner,
    SignatureRefusal,
    SigningKey,
    SigningTimestamps,
    make_timestamp,
    remove_signature,
)

MINUTE = 60 * SECOND


def stamp_of(frame: bytes) -> int:
    return int.from_bytes(frame[-12:-6], "little")


def test_what_we_sign_is_what_pymavlink_signs() -> None:
    theirs = SignedPeer(link_id=7).heartbeat()
    plain = Peer().heartbeat()
    assert make_signing().sign(plain, 0) == theirs
    assert sign(plain, STAMP, link_id=7) == theirs  # the rig's own, too


def test_pymavlink_takes_what_we_sign() -> None:
    receiver = mavlink.MAVLink(None)
    receiver.signing.secret_key = KEY
    signing, peer = make_signing(), Peer(245, 25)
    for n in range(100):
        messages = receiver.parse_buffer(signing.sign(peer.heartbeat(), n * 10**9)) or []
        (message,) = messages
        assert message.get_type() == "HEARTBEAT" and message.get_signed()


def test_stamps_are_ten_microseconds_since_2015_and_always_grow() -> None:
    signing, frame = make_signing(), Peer().heartbeat()
    assert stamp_of(signing.sign(frame, 12_345)) == STAMP + 1
    assert stamp_of(signing.sign(frame, 10**9)) == STAMP + SECOND
    burst = [stamp_of(signing.sign(frame, 10**9)) for _ in range(1000)]
    assert burst == list(range(STAMP + SECOND + 1, STAMP + SECOND + 1001))
    assert stamp_of(signing.sign(frame, 0)) == burst[-1] + 1  # no clock takes them back


@pytest.mark.fault(103)
def test_103_a_frame_that_is_signed_ahead_is_new_until_that_time_and_changes_no_other_stamp() -> None:
    receiver = mavlink.MAVLink(None)
    receiver.signing.secret_key = KEY
    signing, peer = make_signing(), Peer(245, 25)
    ahead = signing.sign_ahead(peer.heartbeat(), 2 * 10**9)
    stamps = [stamp_of(signing.sign(peer.heartbeat(), n * 10**9)) for n in range(4)]
    assert [stamp - stamps[0] for stamp in stamps] == [n * SECOND for n in range(4)]
    assert stamp_of(ahead) == stamps[2]
    assert receiver.parse_buffer(ahead)


def test_stamps_never_outgrow_their_48_bits_and_never_fall_below_zero() -> None:
    frame = Peer().heartbeat()
    full = FrameSigner(SigningKey(KEY), 7, SigningTimestamps(newest=2**48 - 2), OFFSET_NS)
    assert [stamp_of(full.sign(frame, 0)) for _ in range(2)] == [2**48 - 1] * 2
    early = FrameSigner(SigningKey(KEY), 7, SigningTimestamps(), 0)  # a machine that believes it is 1970
    assert [stamp_of(early.sign(frame, 0)) for _ in range(2)] == [1, 2]


@pytest.mark.parametrize(
    ("wall_ns", "stamp"),
    [
        (0, 0),
        (EPOCH_S * 10**9 - 10_000, 0),
        (EPOCH_S * 10**9 + 9_999, 0),
        (EPOCH_S * 10**9 + 10_000, 1),
        (EPOCH_S * 2 * 10**9, EPOCH_S * SECOND),  # 2060
    ],
)
def test_a_stamp_counts_whole_units_since_2015_and_none_before(wall_ns: int, stamp: int) -> None:
    assert make_timestamp(wall_ns) == stamp


@pytest.mark.fault(37)
def test_where_nothing_was_kept_only_a_stamp_of_zero_is_old() -> None:
    early = FrameSigner(SigningKey(KEY), 7, SigningTimestamps(), 0)
    assert early.verify(sign(Peer().heartbeat(), 0), 0) is SignatureRefusal.REPLAYED
    assert early.verify(sign(Peer().heartbeat(), 1), 0) is None


@pytest.mark.parametrize("v", ["heartbeat", "vision", "odometry"])
def test_what_pymavlink_signs_is_taken_and_loses_nothing_but_its_signature(v: str) -> None:
    peer, plain = SignedPeer(), Peer()
    arguments = () if v == "heartbeat" else (5,)
    frame = getattr(peer, v)(*arguments)
    assert make_signing().verify(frame, 0) is None
    assert remove_signature(frame) == getattr(plain, v)(*arguments)


def test_other_flags_than_that_of_the_signature_stay() -> None:
    plain = Peer().heartbeat()
    bare = remove_signature(seal(plain[:2] + b"\x05" + plain[3:], STAMP))
    assert bare[:-2] == plain[:2] + b"\x04" + plain[3:-2]


@pytest.mark.fault(36)
def test_no_bit_of_a_signed_frame_can_be_changed() -> None:
    frame = SignedPeer().heartbeat()
    signing = make_signing()
    for bit in range(8 * len(frame)):
        forged = bytearray(frame)
        forged[bit // 8] ^= 1 << bit % 8
        assert signing.verify(bytes(forged), 0) is SignatureRefusal.FORGED
    assert signing.verify(frame, 0) is None


@pytest.mark.fault(36)
def test_another_key_is_no_key() -> None:
    assert make_signing().verify(SignedPeer(OTHER_KEY).heartbeat(), 0) is SignatureRefusal.FORGED


@pytest.mark.fault(37)
def test_a_frame_is_taken_once_and_an_older_one_never() -> None:
    peer, signing = SignedPeer(), make_signing()
    sent = [peer.heartbeat() for _ in range(50)]
    assert signing.verify(sent[10], 0) is None
    assert [signing.verify(frame, 0) for frame in sent[:11]] == [SignatureRefusal.REPLAYED] * 11
    assert [signing.verify(frame, 0) for frame in sent[11:]] == [None] * 39
    assert {signing.verify(frame, 0) for frame in sent} == {SignatureRefusal.REPLAYED}


@pytest.mark.fault(37)
def test_a_frame_of_another_link_is_not_taken_over_to_this_one() -> None:
    here, signing = SignedPeer(link_id=3), make_signing()
    assert signing.verify(here.heartbeat(), 0) is None
    for link_id in (2, 4):
        there = SignedPeer(link_id=link_id, stamp=STAMP + 5)
        assert signing.verify(there.heartbeat(), 0) is SignatureRefusal.LINK_ID
    assert signing.verify(here.heartbeat(), 0) is None
    camera = SignedPeer(link_id=4, system=17)  # another system has links of its own, and so has each of its parts
    gimbal = SignedPeer(link_id=5, component=154)
    assert signing.verify(camera.vision(5), 0) is None
    assert signing.verify(gimbal.heartbeat(), 0) is None


@pytest.mark.fault(37)
def test_link_ids_of_peers_can_be_given() -> None:
    signing = make_signing(peer_link_ids=(4, 5))
    verdicts = [signing.verify(SignedPeer(link_id=link, stamp=STAMP).heartbeat(), 0) for link in (3, 4, 5, 6)]
    assert verdicts == [SignatureRefusal.LINK_ID, None, None, SignatureRefusal.LINK_ID]


@pytest.mark.fault(37)
@pytest.mark.fault(51)
def test_genuine_frames_that_somebody_brings_elsewhere_first_are_not_old_here() -> None:
    stamps = SigningTimestamps()
    here, elsewhere = make_signing(stamps), make_signing(stamps)
    peer = SignedPeer()
    for _ in range(100):
        frame = peer.heartbeat()
        assert elsewhere.verify(frame, 0) is None
        assert here.verify(frame, 0) is None
        assert {one.verify(frame, 0) for one in (here, elsewhere)} == {SignatureRefusal.REPLAYED}


@pytest.mark.fault(37)
def test_old_frames_of_one_connection_are_none_of_another() -> None:
    stamps = SigningTimestamps()
    here, elsewhere = make_signing(stamps), make_signing(stamps)
    old, new = SignedPeer(), SignedPeer(stamp=STAMP + MAX_LINK_SKEW + 100)
    kept = [old.heartbeat() for _ in range(10)]
    assert here.verify(new.heartbeat(), 0) is None
    assert {elsewhere.verify(frame, 0) for frame in kept} == {SignatureRefusal.REPLAYED}
    assert elsewhere.verify(new.heartbeat(), 0) is None


@pytest.mark.fault(37)
@pytest.mark.parametrize(("behind", "refusal"), [(500_000, None), (500_001, SignatureRefusal.REPLAYED)])
def test_a_frame_may_be_five_seconds_behind_another_connection(behind: int, refusal: SignatureRefusal | None) -> None:
    stamps = SigningTimestamps()
    here, elsewhere = make_signing(stamps), make_signing(stamps)
    assert here.verify(SignedPeer().heartbeat(), 0) is None
    assert elsewhere.verify(SignedPeer(stamp=STAMP - behind).heartbeat(), 0) is refusal


@pytest.mark.fault(37)
def test_a_stream_begins_at_most_a_minute_behind() -> None:
    signing = make_signing()
    behind = STAMP - MINUTE
    assert signing.verify(SignedPeer(stamp=behind - 1).heartbeat(), 0) is SignatureRefusal.STALE
    assert signing.verify(SignedPeer(stamp=behind).heartbeat(), 0) is None
    # One that has begun may fall back as far as it likes: its own stamps have to grow, that is all.
    assert signing.verify(SignedPeer(stamp=behind + 1).heartbeat(), 3600 * 10**9) is None
    assert signing.verify(SignedPeer(stamp=behind + 2, system=2).heartbeat(), 3600 * 10**9) is SignatureRefusal.STALE


@pytest.mark.fault(37)
def test_nothing_from_before_the_start_is_taken() -> None:
    before = SigningTimestamps()
    peer, camera = SignedPeer(), SignedPeer(system=17, stamp=STAMP - SECOND)
    first = make_signing(before)
    old = [peer.heartbeat() for _ in range(20)] + [camera.vision(5)]
    assert [first.verify(frame, 0) for frame in old] == [None] * 21
    again = make_signing(SigningTimestamps(floor=before.newest, newest=before.newest))
    assert {again.verify(frame, 0) for frame in old} == {SignatureRefusal.REPLAYED}
    assert again.verify(camera.vision(6), 0) is SignatureRefusal.REPLAYED  # behind the others: it has to hear us first
    assert again.verify(peer.heartbeat(), 0) is None


def test_our_stamp_follows_the_newest_that_was_verified() -> None:
    signing, frame = make_signing(), Peer(245, 25).heartbeat()
    hour = 3600 * SECOND
    assert signing.verify(SignedPeer(OTHER_KEY, STAMP + 2 * hour).heartbeat(), 0) is SignatureRefusal.FORGED
    assert stamp_of(signing.sign(frame, 0)) == STAMP
    assert signing.verify(SignedPeer(stamp=STAMP + hour).heartbeat(), 0) is None
    assert stamp_of(signing.sign_ahead(frame, 0)) == stamp_of(signing.sign(frame, 0)) == STAMP + hour + 1
    # ... and then a new stream is measured against it.
    assert signing.verify(SignedPeer(stamp=STAMP, system=2).heartbeat(), 0) is SignatureRefusal.STALE


@pytest.mark.fault(38)
def test_a_forged_stamp_from_the_future_locks_nobody_out() -> None:
    genuine, signing = SignedPeer(), make_signing()
    forged = SignedPeer(OTHER_KEY, MAX_TIMESTAMP - 5).heartbeat()
    assert signing.verify(genuine.heartbeat(), 0) is None
    assert signing.verify(forged, 0) is SignatureRefusal.FORGED
    assert [signing.verify(genuine.heartbeat(), n * 10**6) for n in range(1000)] == [None] * 1000


@pytest.mark.fault(38)
def test_pymavlink_is_locked_out_by_it() -> None:
    """Why we verify by ourselves: should this test fail, pymavlink has turned the order round."""
    receiver = mavlink.MAVLink(None)
    receiver.signing.secret_key = KEY
    receiver.robust_parsing = True
    genuine = SignedPeer()

    def taken(frame: bytes) -> int:
        return sum(message.get_type() == "HEARTBEAT" for message in receiver.parse_buffer(frame) or [])

    assert taken(genuine.heartbeat()) == 1
    assert taken(SignedPeer(OTHER_KEY, MAX_TIMESTAMP - 5).heartbeat()) == 0
    assert sum(taken(genuine.heartbeat()) for _ in range(1000)) == 0


@pytest.mark.fault(37)
def test_streams_are_bounded_and_keep_no_later_one_out() -> None:
    stamps = SigningTimestamps()
    signing = make_signing(stamps)
    first = [SignedPeer(system=1 + n // 250, component=1 + n % 250, stamp=STAMP + n).heartbeat() for n in range(300)]
    assert {signing.verify(frame, 0) for frame in first} == {None}
    assert len(stamps.streams) == len(signing._newest) == 64
    assert {signing.verify(frame, 0) for frame in first} == {
        SignatureRefusal.REPLAYED
    }  # also of those that are not kept
    late = SignedPeer(system=1, component=1, stamp=STAMP + 1000, link_id=9)
    assert signing.verify(late.heartbeat(), 0) is None  # one that was not kept may have another link id
    assert len(signing._link_ids) <= 64


@pytest.mark.fault(37)
def test_of_all_connections_the_newest_streams_and_stamps_are_kept() -> None:
    stamps = SigningTimestamps()
    for n in range(100):
        stamps.update((1, n, 3), STAMP + n)
    assert set(stamps.streams) == {(1, n, 3) for n in range(36, 100)}
    stamps.update((1, 50, 3), STAMP + 200)
    stamps.update((1, 50, 3), STAMP + 100)  # a copy that came another way
    assert (stamps.newest, stamps.streams[1, 50, 3]) == (STAMP + 200, STAMP + 200)


def test_a_byte_of_a_key_may_be_zero() -> None:
    assert SigningKey(bytes(1) + KEY[1:]).name != SigningKey(KEY).name


@pytest.mark.parametrize("secret", [b"", KEY[:-1], KEY + b"x", bytes(32)])
def test_what_is_no_key_is_refused(secret: bytes) -> None:
    with pytest.raises(ValueError):
        SigningKey(secret)


@pytest.mark.fault(40)
def test_a_key_does_not_show_itself() -> None:
    key = SigningKey(KEY)
    shown = repr(key) + str(key) + f"{key}" + key.name
    assert KEY.hex() not in shown and KEY.hex()[:8] not in shown
    assert key.name != SigningKey(OTHER_KEY).name
    assert key.name == SigningKey(bytes(KEY)).name and len(key.name) == 16
    assert not hasattr(key, "__dict__")
