"""A flight with everything given that is drawn otherwise: for flying one run of a campaign again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.channel import UnderWay
from uavctl.config.types import PlantConfig

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Script:
    """What the simulated vehicle and the radio channel do, in place of the configuration's plant, link and draws.

    Attributes:
        plant: The plant that flies; the controller may believe in another one.
        start: Its state at the start (n_x,).
        disturbances: w of each step (T, n_w); zero after the last one.
        delays_ns: Delay of each position sent [ns], None for one that is lost; those after the last one are lost.
    """

    plant: PlantConfig
    start: Array
    disturbances: Array
    delays_ns: tuple[int | None, ...]


class ScriptedChannel(UnderWay):
    """One direction of a radio link that loses and delays the packets that it is told to.

    Args:
        delays_ns: Of each packet [ns], None for one that is lost; those after the last one are lost.
    """

    def __init__(self, delays_ns: tuple[int | None, ...]) -> None:
        super().__init__()
        self._delays_ns = delays_ns
        self._number = 0  # of the next packet

    def push(self, at_ns: int, data: bytes, *, certain: bool = False) -> None:
        """Send a packet at `at_ns`; a `certain` one is not lost, and not late if it was to be lost."""
        number = self._number
        self._number += 1
        self.counters.sent += 1
        delay_ns = self._delays_ns[number] if number < len(self._delays_ns) else None
        if delay_ns is None and not certain:
            self.counters.lost += 1
            return
        arrival_ns = at_ns + (delay_ns or 0)
        self._let_through(arrival_ns, arrival_ns, data)

    def pass_over(self, at_ns: int) -> None:
        """Nothing is sent where a packet was due: the next one is told what goes for the packet after."""
        del at_ns
        self._number += 1
