"""The TIMESYNC exchange of a recorded client: what tells a vehicle's clock though nobody asks any more."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.mavlink.framing import scan

_OPEN = 64  # requests whose answers are still taken
Address = tuple[int, int]


class RoundTrip(NamedTuple):
    """An answer to a client's request: who gave it, when the request went [ns], what the answer tells [ns]."""

    address: Address
    sent_ns: int
    remote_ns: int


class Exchange:
    """Pairs requests with their answers by the client's own stamp that both carry.

    Times are the recorder's, so those of the client's clock do not matter.
    """

    def __init__(self) -> None:
        self._sent: OrderedDict[int, int] = OrderedDict()  # by the client's stamp
        self._parser = mavlink.MAVLink(None)

    def take(self, data: bytes, at_ns: int, *, outgoing: bool) -> Iterator[RoundTrip]:
        """Read a packet; gives the round trip that it ends, if any."""
        for frame in scan(data, final=True).frames:
            if frame.message_id != mavlink.MAVLINK_MSG_ID_TIMESYNC:
                continue
            message = self._parser.decode(bytearray(frame.data))
            if outgoing and message.tc1 == 0:
                self._sent[message.ts1] = at_ns
                if len(self._sent) > _OPEN:
                    self._sent.popitem(last=False)
            elif not outgoing and message.tc1 != 0 and message.ts1 in self._sent:
                address = message.get_srcSystem(), message.get_srcComponent()
                yield RoundTrip(address, self._sent[message.ts1], message.tc1)
