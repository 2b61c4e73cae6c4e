"""Who may speak to a connection, and how much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address, ip_network

Address = tuple[str, int] | tuple[str, int, int, int]
NOT_LISTED = "not-listed"
TOO_MANY = "too-many"
BURST = 64  # datagrams that may come at once: a link that was held up delivers what it kept
MAX_SENDERS = 16  # with a share of their own; all others have one together
MAX_KNOWN = 1024  # addresses whose verdict is kept
SILENCE_NS = 5_000_000_000  # who has not been heard for so long gives its place to another


@dataclass(frozen=True)
class Rules:
    """What a UDP connection lets in.

    Attributes:
        allow: addresses and networks; none lets anybody in.
        max_per_s: datagrams a second of one sender.
    """

    allow: tuple[str, ...] = ()
    max_per_s: float = 2000.0


class AllowList:
    """Addresses that are listened to.

    Args:
        allow: addresses and networks, of IP version 4 or 6; none lets anybody in.
    """

    def __init__(self, allow: Sequence[str]) -> None:
        self._networks: list[IPv4Network | IPv6Network] = [ip_network(text, strict=False) for text in allow]
        self._known: dict[str, bool] = {}

    def lets_in(self, host: str) -> bool:
        """Whether a numeric address is listed; a look into a table for one that has been seen."""
        if not self._networks:
            return True
        verdict = self._known.get(host)
        if verdict is None:
            if len(self._known) >= MAX_KNOWN:  # forged senders must not fill the memory
                self._known.clear()
            verdict = self._known[host] = self._look_up(host)
        return verdict

    def _look_up(self, host: str) -> bool:
        address = ip_address(host.partition("%")[0])  # a link-local address has its interface behind a "%"
        if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
            address = address.ipv4_mapped
        return any(address in network for network in self._networks)


class _Budget:
    """Datagrams that a sender may still send now."""

    def __init__(self, now_ns: int) -> None:
        self.left, self.at_ns = float(BURST), now_ns


class RateCap:
    """Keeps a sender from taking the time that the others and the control loop need.

    Args:
        max_per_s: datagrams a second of one sender (address and port).
    """

    def __init__(self, max_per_s: float) -> None:
        self._per_ns = max_per_s * 1e-9
        self._budgets: dict[Address, _Budget] = {}
        self._others = _Budget(0)

    def take(self, senders: Sequence[Address], now_ns: int) -> list[bool]:
        """Which datagrams of a batch to hand on: of each sender the newest ones that its budget pays.

        Args:
            senders: of the datagrams, in the order in which they came.
            now_ns: time of the batch.
        """
        budgets = {sender: self._budget(sender, now_ns) for sender in set(senders)}
        for budget in set(budgets.values()):
            budget.left = min(float(BURST), budget.left + (now_ns - budget.at_ns) * self._per_ns)
            budget.at_ns = now_ns
        taken = []
        for sender in reversed(senders):
            budget = budgets[sender]
            taken.append(budget.left >= 1.0)
            budget.left -= taken[-1]
        taken.reverse()
        return taken

    def _budget(self, sender: Address, now_ns: int) -> _Budget:
        budget = self._budgets.get(sender)
        if budget is None and len(self._budgets) >= MAX_SENDERS:
            silent = [one for one, has in self._budgets.items() if now_ns - has.at_ns > SILENCE_NS]
            for one in silent:
                del self._budgets[one]
        if budget is None and len(self._budgets) < MAX_SENDERS:
            budget = self._budgets[sender] = _Budget(now_ns)
        return self._others if budget is None else budget
