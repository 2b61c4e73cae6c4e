"""Admission to a connection: allowed senders, and the rate of each, before anything decodes a datagram.

1. `AllowList` tests the address of the sender.
2. Each sender has a token bucket for datagrams, frames and bytes.
3. The vehicle has a bucket of its own. Trusted senders share one more bucket, and so do all strangers.
4. Senders that sent little come first. Only they can use the last half of a shared bucket.
"""

from __future__ import annotations

import re
from collections import Counter, OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network

Address = tuple[str, int] | tuple[str, int, int, int]
NOT_LISTED = "not-listed"
TOO_MANY = "too-many"
TOO_MUCH = "too-much"
MAX_SENDERS = 64  # strangers with a bucket of their own; a new one replaces the one with the oldest message
MAX_TRUSTED = 16  # trusted senders beside the vehicle
MAX_KNOWN = 1024  # cached verdicts on addresses
SILENCE_NS = 5_000_000_000  # another sender may replace one after this silence
MAGIC = (0xFD, 0xFE)  # first byte of a frame of MAVLink 2, and of MAVLink 1
SHORTEST_FRAME, MAX_TRIES = 8, 64  # bytes; failures after which a datagram is dropped (`uavctl.mavlink.framing`)
_HEARTBEAT = re.compile(rb"\xfd.{6}\0\0\0|\xfe.{4}\0", re.DOTALL)
_HEARTBEATS = 8  # in a backlog of the vehicle; some may only look like one


@dataclass(frozen=True)
class AdmissionRules:
    """Admission rules of a UDP connection."""

    allow: tuple[str, ...] = ()  # addresses and networks; empty allows all
    max_per_s: float = 2000.0  # datagrams a second of one sender
    max_frames_per_s: float = 800.0  # frames a second of one sender
    max_bytes_per_s: float = 200_000.0  # bytes a second of one sender


class AllowList:
    """Allowed addresses.

    Args:
        allow: addresses and networks, of IP version 4 or 6; empty allows all.
    """

    def __init__(self, allow: Sequence[str]) -> None:
        self._networks: list[IPv4Network | IPv6Network] = [ip_network(text, strict=False) for text in allow]
        self._verdicts: dict[str, bool] = {}

    def allows(self, host: str) -> bool:
        """Return whether a numeric address is listed; the verdict on a known one is cached."""
        if not self._networks:
            return True
        verdict = self._verdicts.get(host)
        if verdict is None:
            if len(self._verdicts) >= MAX_KNOWN:  # forged senders must not fill the memory
                self._verdicts.clear()
            verdict = self._verdicts[host] = self._is_listed(host)
        return verdict

    def _is_listed(self, host: str) -> bool:
        address = ip_address(host.partition("%")[0])  # a link-local address has its interface behind a "%"
        if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
            address = address.ipv4_mapped
        return any(address in network for network in self._networks)


def count_frames(data: bytes) -> int:
    """Return the largest number of checksums or hashes that a datagram can cause.

    Each frame begins at a magic byte. Valid frames have a smallest length; after some failures the rest is dropped.
    """
    return max(1, min(data.count(MAGIC[0]) + data.count(MAGIC[1]), len(data) // SHORTEST_FRAME + MAX_TRIES + 1))


@dataclass(frozen=True)
class RateLimit:
    """Rate limit of a sender: datagrams, frames and bytes."""

    per_s: tuple[float, float, float]  # of each, a second
    burst: tuple[float, float, float]  # of each, at once

    @staticmethod
    def from_rules(rules: AdmissionRules, times: float, burst: tuple[float, float, float]) -> RateLimit:
        """Return the limit of one sender by the rules, multiplied by `times`."""
        return RateLimit(_scale(times, (rules.max_per_s, rules.max_frames_per_s, rules.max_bytes_per_s)), burst)


# A stalled link delivers its backlog. Little is admitted of strangers; of trusted senders the backlog of a stall.
STRANGER_BURST = (64.0, 128.0, 32_768.0)
# Before any trusted sender is known, a stranger may be the vehicle. A PX4 sends up to 420 messages a second, and only
# decoding shows which one is its first heartbeat.
FIRST_BURST = (1024.0, 2048.0, 131_072.0)
TRUSTED_BURST = (512.0, 1024.0, 131_072.0)
VEHICLE_BURST = (16_384.0, 16_384.0, 2_097_152.0)
VEHICLE_TIMES, ALL_TRUSTED_TIMES = 4.0, 2.0
FAIR_TIMES = 1.0 / 16.0  # of the rate of one sender; below it, a sender counts as fair
RESERVED = 0.5  # share of the shared bucket that only fair senders can use


def _scale(factor: float, amounts: tuple[float, float, float]) -> tuple[float, float, float]:
    return factor * amounts[0], factor * amounts[1], factor * amounts[2]


class _TokenBucket:
    """Token bucket of a sender."""

    __slots__ = ("_at_ns", "_limit", "bytes", "datagrams", "frames")

    def __init__(self, limit: RateLimit, now_ns: int) -> None:
        self._limit, self._at_ns = limit, now_ns
        self.datagrams, self.frames, self.bytes = limit.burst

    def refill(self, now_ns: int) -> None:
        """Add the tokens for the time since the last call."""
        seconds, self._at_ns = (now_ns - self._at_ns) * 1e-9, now_ns
        per_s, burst = self._limit.per_s, self._limit.burst
        self.datagrams = min(burst[0], self.datagrams + seconds * per_s[0])
        self.frames = min(burst[1], self.frames + seconds * per_s[1])
        self.bytes = min(burst[2], self.bytes + seconds * per_s[2])

    @property
    def used_share(self) -> float:
        """Largest used share of the burst, over datagrams, frames and bytes."""
        burst = self._limit.burst
        return 1.0 - min(self.datagrams / burst[0], self.frames / burst[1], self.bytes / burst[2])

    def find_refusal(self, frames: int, size: int, reserve: float = 0.0) -> str | None:
        """Return why a datagram does not fit; None if it does.

        Args:
            reserve: share of the burst that must be left.
        """
        burst = self._limit.burst
        if self.datagrams - 1.0 < reserve * burst[0]:
            return TOO_MANY
        is_short = self.frames - frames < reserve * burst[1] or self.bytes - size < reserve * burst[2]
        return TOO_MUCH if is_short else None

    def consume(self, frames: int, size: int) -> None:
        """Remove the tokens of a datagram."""
        self.datagrams -= 1.0
        self.frames -= frames
        self.bytes -= size


class _Sender:
    """Buckets of one sender; `fair_bucket` is empty once it has sent much."""

    __slots__ = ("bucket", "fair_bucket")

    def __init__(self, limit: RateLimit, now_ns: int) -> None:
        self.bucket = _TokenBucket(limit, now_ns)
        self.fair_bucket = _TokenBucket(RateLimit(_scale(FAIR_TIMES, limit.per_s), limit.burst), now_ns)

    def refill(self, now_ns: int) -> None:
        """See `_TokenBucket`."""
        self.bucket.refill(now_ns)
        self.fair_bucket.refill(now_ns)

    def admit(self, frames: int, size: int, shared_bucket: _TokenBucket | None) -> str | None:
        """Admit a datagram, or return the reason why not."""
        refusal = self.bucket.find_refusal(frames, size)
        if shared_bucket is not None and refusal is None:
            is_fair = self.fair_bucket.find_refusal(frames, size) is None
            refusal = shared_bucket.find_refusal(frames, size, 0.0 if is_fair else RESERVED)
            if refusal is None:
                shared_bucket.consume(frames, size)
                if is_fair:
                    self.fair_bucket.consume(frames, size)
        if refusal is None:
            self.bucket.consume(frames, size)
        return refusal


class RateLimiter:
    """Limits each sender, so that the others and the control loop have their time.

    The vehicle has a bucket of its own. Trusted senders have one each and a shared one, and so have strangers. Senders
    that sent least come first, and only they can use the last half of a shared bucket. So a new sender is heard beside
    any flood. Before a trusted sender is known, a stranger may be the vehicle, and the backlog of a stall is admitted.

    Args:
        rules: datagrams, frames and bytes a second of one sender (address and port).
        refused: counter of refusals by reason.
    """

    def __init__(self, rules: AdmissionRules, refused: Counter[str]) -> None:
        self._refused = refused
        self._rules = rules
        self._trusted_limit = RateLimit.from_rules(rules, 1.0, TRUSTED_BURST)
        self._vehicle_limit = RateLimit.from_rules(rules, VEHICLE_TIMES, VEHICLE_BURST)
        self._vehicle: tuple[Address, _Sender] | None = None
        # in order of the last call of `trust_sender`
        self._trusted_senders: OrderedDict[Address, _Sender] = OrderedDict()
        self._strangers: OrderedDict[Address, _Sender] = OrderedDict()  # in order of the last datagram
        self._trusted_bucket = _TokenBucket(
            RateLimit.from_rules(rules, ALL_TRUSTED_TIMES, _scale(2.0, TRUSTED_BURST)), 0
        )
        self._reset_strangers(FIRST_BURST)

    def _reset_strangers(self, burst: tuple[float, float, float]) -> None:
        """Give unknown senders buckets with this burst, and a shared one with twice that."""
        self._strangers.clear()
        self._stranger_limit = RateLimit.from_rules(self._rules, 1.0, burst)
        self._stranger_bucket = _TokenBucket(RateLimit.from_rules(self._rules, 1.0, _scale(2.0, burst)), 0)

    def _limit_strangers(self) -> None:
        """Limit strangers from now on, if this is the first known sender."""
        if self._vehicle is None and not self._trusted_senders:
            self._reset_strangers(STRANGER_BURST)

    def set_vehicle(self, sender: Address, now_ns: int) -> None:
        """Note that a sender is the flown vehicle."""
        self._limit_strangers()
        if self._vehicle is None or self._vehicle[0] != sender:
            self._vehicle = sender, _Sender(self._vehicle_limit, now_ns)

    def trust_sender(self, sender: Address, now_ns: int) -> None:
        """Trust a sender; it replaces the one that was trusted longest ago."""
        self._limit_strangers()
        sender_state = self._trusted_senders.pop(sender, None) or _Sender(self._trusted_limit, now_ns)
        if len(self._trusted_senders) >= MAX_TRUSTED:
            self._trusted_senders.popitem(last=False)
        self._trusted_senders[sender] = sender_state

    def admit(self, senders: Sequence[Address], data: Sequence[bytes], now_ns: int) -> list[bool]:
        """Return which datagrams of a batch to pass on: of each sender the newest ones within its limit.

        Args:
            senders: of the datagrams, in order of arrival.
        """
        admitted = [False] * len(data)
        queues: dict[Address, list[int]] = {}
        for index, sender in enumerate(senders):
            queues.setdefault(sender, []).append(index)
        trusted, strangers = [], []
        for sender, indices in queues.items():
            if self._vehicle is not None and sender == self._vehicle[0]:
                self._vehicle[1].refill(now_ns)
                self._admit_in_turn(
                    [(self._vehicle[1], self._put_heartbeats_last(indices, data))], None, data, admitted
                )
            elif sender in self._trusted_senders:
                trusted.append((self._trusted_senders[sender], indices))
            else:
                strangers.append((self._find_stranger(sender, now_ns), indices))
        for group, shared_bucket in ((trusted, self._trusted_bucket), (strangers, self._stranger_bucket)):
            if group:
                shared_bucket.refill(now_ns)
                for sender_state, _ in group:
                    sender_state.refill(now_ns)
                group.sort(key=lambda sender_state: sender_state[0].fair_bucket.used_share)
                self._admit_in_turn(group, shared_bucket, data, admitted)
        return admitted

    def _find_stranger(self, sender: Address, now_ns: int) -> _Sender:
        stranger = self._strangers.pop(sender, None)
        if stranger is None:
            if len(self._strangers) >= MAX_SENDERS:
                self._strangers.popitem(last=False)
            stranger = _Sender(self._stranger_limit, now_ns)
        self._strangers[sender] = stranger
        return stranger

    def _admit_in_turn(
        self,
        group: Iterable[tuple[_Sender, list[int]]],
        shared_bucket: _TokenBucket | None,
        data: Sequence[bytes],
        admitted: list[bool],
    ) -> None:
        """Admit the newest datagram of each sender in turn, within its bucket and the shared one."""
        waiting = [(sender_state, reversed(indices)) for sender_state, indices in group]
        while waiting:
            remaining = []
            for sender_state, newest in waiting:
                index = next(newest, None)
                if index is None:
                    continue
                remaining.append((sender_state, newest))
                refusal = sender_state.admit(count_frames(data[index]), len(data[index]), shared_bucket)
                if refusal is None:
                    admitted[index] = True
                else:
                    self._refused[refusal] += 1
            waiting = remaining

    @staticmethod
    def _put_heartbeats_last(indices: Sequence[int], data: Sequence[bytes]) -> list[int]:
        """Move the newest datagrams with a possible heartbeat to the end, so that they are admitted first."""
        heartbeats: list[int] = []
        for index in reversed(indices):
            if len(heartbeats) < _HEARTBEATS and _HEARTBEAT.search(data[index]):
                heartbeats.append(index)
        return [index for index in indices if index not in heartbeats] + heartbeats[::-1]
