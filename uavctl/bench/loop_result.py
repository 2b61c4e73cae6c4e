"""What `uavctl bench --loop` measures; the fields are the keys of its JSON document."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import msgspec
import numpy as np
from numpy.typing import NDArray


class Spread(msgspec.Struct, frozen=True, kw_only=True):
    """Quantiles of a time [µs]; over several runs the median of each."""

    p50: float
    p99: float
    p999: float
    max: float

    @staticmethod
    def of(times_ns: NDArray[np.int64]) -> Spread:
        """Of one run's times [ns] (n,)."""
        p50, p99, p999, worst = (np.quantile(times_ns, [0.5, 0.99, 0.999, 1.0]) * 1e-3).tolist()
        return Spread(p50=p50, p99=p99, p999=p999, max=worst)

    @staticmethod
    def middle(runs: Sequence[Spread]) -> Spread:
        """The median run, quantile by quantile."""
        return Spread(
            p50=median(run.p50 for run in runs),
            p99=median(run.p99 for run in runs),
            p999=median(run.p999 for run in runs),
            max=median(run.max for run in runs),
        )


class LoopRun(msgspec.Struct, frozen=True, kw_only=True):
    """One run, or the median of several."""

    in_to_out_us: Spread  # a position arrives in time for a tick: tick deadline -> its setpoint arrives at the vehicle
    lateness_us: Spread  # tick deadline -> start of the tick
    empty_lateness_us: Spread  # the same of an empty loop that ran at the same time
    above_empty_us: float  # p99.9 of the lateness less that of the empty loop
    step_us: Spread  # in the control core
    positions: float  # sent, one a tick
    unanswered: float  # of which no setpoint came within the tick
    missed_ticks: float
    recorded: float  # records
    dropped: float  # records that the recorder could not keep
    memory_growth_kib: float  # resident memory, from a fifth of the run to its end
    memory_mib: float  # at the end

    @staticmethod
    def middle(runs: Sequence[LoopRun]) -> LoopRun:
        """The medians over runs."""
        spreads = ("in_to_out_us", "lateness_us", "empty_lateness_us", "step_us")
        fields: dict[str, Spread | float] = {}
        for name in LoopRun.__struct_fields__:
            values = [getattr(run, name) for run in runs]
            fields[name] = Spread.middle(values) if name in spreads else float(median(values))
        return msgspec.convert(fields, LoopRun)


class LoopBench(msgspec.Struct, frozen=True, kw_only=True):
    """The control loop of `uavctl fly` on real UDP, recording, beside an empty loop: without and with `--realtime`."""

    seconds: float  # of a run
    runs: int  # of each kind, in turns
    tick_s: float
    plain: LoopRun
    realtime: LoopRun
    permitted: bool  # whether all that --realtime does was permitted
