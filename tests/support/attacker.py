"""Flooders, forgers and replayers in a process of their own: `python tests/support/attacker.py --help`.

Each kind is the worst datagram of its sort of at most `MAX_DATAGRAM_BYTES` bytes, or a small one by its name.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from mavlink_rig import Peer
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from signing_rig import EPOCH_S, KEY, OTHER_KEY, SECOND, SignedPeer, seal

BATCH_S = 0.001
STAMP_PERIOD_S = 0.004  # signed words are made anew so often: making them is slower than sending
MAX_DATAGRAM_BYTES = 4096
MAX_FRAMES = 500
STRANGER, COMPONENT = 99, 1

MakeDatagram = Callable[[], bytes]
"""Gives the next datagram."""


def pack_frames(arguments: Iterator[bytes]) -> bytes:
    """As many whole frames as fit into one datagram."""
    data = b""
    for argument in arguments:
        if len(data) + len(argument) > MAX_DATAGRAM_BYTES:
            break
        data += argument
    return data


def repeat_frame(pattern: bytes) -> bytes:
    return pattern * (MAX_DATAGRAM_BYTES // len(pattern))


def _cycle(make: Callable[[int], bytes]) -> MakeDatagram:
    """Made before: the attacker is to be fast."""
    return itertools.cycle([make(n) for n in range(MAX_FRAMES)]).__next__


def _full(make_packet: Callable[[int], bytes]) -> MakeDatagram:
    """Datagrams full of a frame whose number goes up."""
    number = itertools.count()
    return _cycle(lambda _: pack_frames(make_packet(next(number)) for _ in itertools.count()))


def _from(number: int) -> Peer:
    """One of many systems, none of them the vehicle or its cameras."""
    return Peer(100 + number % 100, 1 + number // 100 % 250)


def _stamp() -> int:
    return int((time.time() - EPOCH_S) * SECOND)


def _signed(make_packet: Callable[[], bytes], key: bytes, link_id: int, ahead: int) -> MakeDatagram:
    """Make datagrams full of one frame, signed again every few milliseconds with increasing stamps."""
    plain = make_packet()
    body = bytearray(plain[:-2])
    body[2] |= mavlink.MAVLINK_IFLAG_SIGNED
    (message_id,) = struct.unpack("<I", plain[7:10] + b"\0")
    crc = mavlink.x25crc(bytes(body[1:]))
    crc.accumulate(bytes((mavlink.mavlink_map[message_id].crc_extra,)))
    whole = bytes(body) + crc.crc.to_bytes(2, "little")
    stamps = itertools.count(_stamp() + ahead)
    data, made_s = b"", 0.0

    def say() -> bytes:
        nonlocal data, made_s
        now_s = time.monotonic()
        if now_s - made_s > STAMP_PERIOD_S:
            count = MAX_DATAGRAM_BYTES // (len(whole) + 13)
            data = b"".join(seal(whole, next(stamps), key, link_id) for _ in range(count))
            made_s = now_s
        return data

    return say


def _vision(number: int) -> bytes:
    return _from(number).vision(1_000_000 + 1000 * number)


def _short_vision() -> bytes:
    return Peer(STRANGER).send("vision_position_estimate", 1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _text(number: int) -> bytes:
    return Peer(1, 1).send("statustext", 6, b"x" * 50, number % 65536, number % 256)


def _ack(number: int) -> bytes:
    return Peer(1, 1).send("command_ack", 400 + number % 100, number % 5)


def _pair(_: int) -> bytes:
    """A datagram of frames within the body of broken ones: each is found by its own search."""
    inner = Peer(STRANGER).heartbeat() * 12
    return repeat_frame(bytes((0xFD, len(inner), 0, 0, 0, 9, 9, 30, 0, 0)) + inner + b"\0\0")


WORDS: dict[str, Callable[[], MakeDatagram]] = {
    # one frame, or less
    "byte": lambda: _cycle(lambda _: b"x"),
    "heartbeat": lambda: _cycle(lambda _: Peer().heartbeat(custom_mode=3 << 16)),  # the vehicle's own, unsigned
    "forged": lambda: _cycle(lambda n: SignedPeer(OTHER_KEY, 2**48 - 10**9 + n).heartbeat()),
    "foreign-heartbeat": lambda: _cycle(lambda n: _from(n).heartbeat()),
    "foreign-position": lambda: _cycle(_vision),
    "one-source": lambda: lambda: Peer(77).vision(time.time_ns() // 1000),
    "states-of-the-vehicle": lambda: _cycle(lambda _: Peer().heartbeat(base_mode=129 | 128)),
    "time-request": lambda: _cycle(lambda n: _from(n).send("timesync", 0, -n - 1)),
    "words-of-the-vehicle": lambda: _cycle(_text),
    "answers-of-the-vehicle": lambda: _cycle(_ack),
    "one-unknown": lambda: _cycle(lambda _: bytes((0xFD, 0, 0, 0, 0, 9, 9, 0x60, 0xEA, 0, 0, 0))),
    # as many as fit
    "foreign-heartbeats": lambda: _full(lambda n: _from(n).heartbeat()),
    "foreign-heartbeats-1": lambda: _full(lambda n: _from(n).send("heartbeat", 2, 12, 129, 6 << 16, 4, 3, v1=True)),
    "foreign-positions": lambda: _full(_vision),
    "time-requests": lambda: _full(lambda n: _from(n).send("timesync", 0, -n - 1)),
    "many-words-of-the-vehicle": lambda: _full(_text),
    "many-answers-of-the-vehicle": lambda: _full(_ack),
    "forged-frames": lambda: _signed(lambda: Peer(STRANGER).heartbeat(), OTHER_KEY, 3, 10**6),
    "forged-long": lambda: _signed(lambda: Peer(STRANGER).odometry(1), OTHER_KEY, 3, 10**6),
    "genuine-heartbeats": lambda: _signed(lambda: Peer(STRANGER).heartbeat(), KEY, 5, 0),
    "genuine-positions": lambda: _signed(_short_vision, KEY, 5, 0),
    # bytes that make a scanner search
    "tiny": lambda: _full(lambda n: Peer(STRANGER).send("heartbeat", 0, 0, 0, 0, 0, 0, v1=False)),
    "tiny-unknown": lambda: _cycle(lambda _: repeat_frame(bytes((0xFD, 0, 0, 0, 0, 9, 9, 0x60, 0xEA, 0, 0, 0)))),
    "tiny-unknown-1": lambda: _cycle(lambda _: repeat_frame(bytes((0xFE, 0, 0, 9, 9, 3, 0, 0)))),
    "markers": lambda: _cycle(lambda _: b"\xfd" * MAX_DATAGRAM_BYTES),
    "markers-1": lambda: _cycle(lambda _: b"\xfe" * MAX_DATAGRAM_BYTES),  # each promises 254 bytes of DEBUG
    "long-promises": lambda: _cycle(lambda _: repeat_frame(bytes((0xFD, 255, 0, 0, 0, 9, 9, 30, 0, 0)))),
    "long-promises-1": lambda: _cycle(lambda _: repeat_frame(bytes((0xFE, 255, 0, 9, 9, 30)))),
    "signed-promises": lambda: _cycle(lambda _: repeat_frame(bytes((0xFD, 255, 1, 0, 0, 9, 9, 30, 0, 0)))),
    "frames-in-frames": lambda: _cycle(_pair),
    "incomplete": lambda: _cycle(lambda _: b"\xfd\xff" + bytes(5) + b"\x1e\0\0" + bytes(200)),
    "noise": lambda: _cycle(lambda n: hashlib.shake_128(b"%d" % n).digest(MAX_DATAGRAM_BYTES)),
}


# Without a key these are what they say: the pilot's word, and positions. What a flight does then is no fault of it.
BELIEVED_UNSIGNED = frozenset({"heartbeat", "one-source"})


def flood(
    say: MakeDatagram,
    to: tuple[str, int],
    source: str,
    per_s: float,
    seconds_s: float,
    senders: int = 1,
    log: Path | None = None,
) -> int:
    """Send at a rate for a time; gives the number of datagrams that were sent.

    Args:
        say: gives the datagrams.
        to: address and port.
        source: address to send from.
        per_s: datagrams a second of each sender.
        seconds_s: how long.
        senders: number of ports to send from.
        log: file that is made when the first datagram is about to be sent.
    """
    say()
    sent = 0
    sockets = [socket.socket(type=socket.SOCK_DGRAM) for _ in range(senders)]
    for sock in sockets:
        sock.bind((source, 0))
        sock.setblocking(False)
    if log is not None:
        log.touch()
    begun_s = time.monotonic()
    while (now_s := time.monotonic() - begun_s) < seconds_s:
        due = int(now_s * per_s)
        due = min(due, sent + 20)  # a machine that was asleep sends no burst
        for _ in range(due - sent):
            data = say()
            for sock in sockets:
                try:
                    sock.sendto(data, to)
                except OSError:
                    continue
        behind = int(now_s * per_s) - due
        if behind > 0:
            begun_s += behind / per_s
        sent = due
        time.sleep(BATCH_S)
    for sock in sockets:
        sock.close()
    return sent * senders


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", choices=[*WORDS, "replay"])
    parser.add_argument("port", type=int, help="UDP port of 127.0.0.1 to attack")
    parser.add_argument("--source", default="127.0.0.1", help="address to send from; all of 127.0.0.0/8 are ours")
    parser.add_argument("--per-s", type=float, default=2_000.0, help="datagrams a second of each sender")
    parser.add_argument("--senders", type=int, default=1, help="ports to send from")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--replay", default="", help="with `replay`: a captured datagram, in hexadecimal digits")
    parser.add_argument("--log", type=Path, help="file to make when it begins")
    given = parser.parse_args()
    replayed = bytes.fromhex(given.replay)
    say = (lambda: replayed) if given.words == "replay" else WORDS[given.words]()
    to = ("127.0.0.1", given.port)
    print(flood(say, to, given.source, given.per_s, given.seconds, given.senders, given.log))  # noqa: T201


if __name__ == "__main__":
    main()
