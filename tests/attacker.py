"""A flooder, forger and replayer in a process of its own: `python tests/attacker.py --help`."""

from __future__ import annotations

import argparse
import socket
import time
from collections.abc import Callable

from mavlink_rig import Peer
from signing_rig import OTHER_KEY, SignedPeer

BATCH_S = 0.001


def _heartbeats() -> Callable[[], bytes]:
    """Valid, unsigned words of the vehicle itself."""
    peer = Peer()
    return lambda: peer.heartbeat(custom_mode=3 << 16)


def _forgeries() -> Callable[[], bytes]:
    """The same, signed with another key and stamps from the far future."""
    peer = SignedPeer(OTHER_KEY, 2**48 - 10**9)
    return peer.heartbeat


def _one(data: bytes) -> Callable[[], bytes]:
    return lambda: data


WORDS: dict[str, Callable[[], Callable[[], bytes]]] = {
    "byte": lambda: _one(b"x"),
    "heartbeat": _heartbeats,
    "forged": _forgeries,
}


def flood(say: Callable[[], bytes], to: tuple[str, int], source: str, per_s: float, seconds_s: float) -> int:
    """Send at a rate for a time; gives the number of datagrams that were sent."""
    words = [say() for _ in range(1000)]  # made before: the attacker is to be fast
    sent = 0
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.bind((source, 0))
        begun_s = time.monotonic()
        while (now_s := time.monotonic() - begun_s) < seconds_s:
            while sent < now_s * per_s:
                sender.sendto(words[sent % len(words)], to)
                sent += 1
            time.sleep(BATCH_S)
    return sent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", choices=[*WORDS, "replay"])
    parser.add_argument("port", type=int, help="UDP port of 127.0.0.1 to attack")
    parser.add_argument("--source", default="127.0.0.1", help="address to send from; all of 127.0.0.0/8 are ours")
    parser.add_argument("--per-s", type=float, default=20_000.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--replay", default="", help="with `replay`: a captured datagram, in hexadecimal digits")
    given = parser.parse_args()
    say = _one(bytes.fromhex(given.replay)) if given.words == "replay" else WORDS[given.words]()
    sent = flood(say, ("127.0.0.1", given.port), given.source, given.per_s, given.seconds)
    print(sent)  # noqa: T201


if __name__ == "__main__":
    main()
