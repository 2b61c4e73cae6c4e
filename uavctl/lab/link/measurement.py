"""Link between two computers: it is measured over a connection, fitted, and written as a configuration and traces."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from logs.recording.output_files import write_atomically
from uavctl.arrays import SECOND_NS
from uavctl.clock import monotonic_ns
from uavctl.config import Config
from uavctl.config.link import LinkConfig
from uavctl.config.load import dump_config
from uavctl.io.base import Connection
from uavctl.io.transport import wait
from uavctl.lab.identify.history import PositionHistory
from uavctl.lab.identify.result import LinkFit, fit_link, make_link_section
from uavctl.lab.link.probe import LinkAnswer, LinkMeasurement, LinkProbe, WayMeasurement

_QUANTILES = (0.0, 0.5, 0.95, 0.99)
_LAST_ASK_NS = 2 * SECOND_NS  # without a further question, after the last report


class WayResult(msgspec.Struct, frozen=True, kw_only=True):
    """One way of the link, as it is written."""

    packets: int
    lost: int
    loss: float  # share, without outages
    loss_std: float  # its standard error
    bursts: bool  # whether losses come in bursts
    longest_run: int  # of losses
    outages_s: tuple[float, ...]
    delay_s: float  # shortest
    jitter_s: float  # from there to the delay that 99 % keep
    config: str  # file
    trace: str  # file


class LinkBench(msgspec.Struct, frozen=True, kw_only=True):
    """Result of `uavctl bench --link` of the measuring side."""

    url: str
    there: WayResult
    back: WayResult
    round_trip_s: tuple[float, ...]  # at 0, 50, 95 and 99 %


def measure_link(connection: Connection, probe: LinkProbe, stop: Callable[[], bool]) -> LinkMeasurement:
    """Send probes and take answers until all is known, or until `stop` returns True.

    Raises:
        UavctlError: Too little has arrived.
    """
    while not (probe.is_over(now_ns := monotonic_ns()) or stop() or connection.closed):
        for datagram in probe.poll(now_ns):
            connection.send(datagram)
        if wait({"link": connection}, min(probe.next_ns, now_ns + SECOND_NS // 10)):
            for data, at_ns in connection.receive():
                probe.receive(data, at_ns)
    return probe.measure()


def answer_link(connection: Connection, limit_ns: int, stop: Callable[[], bool]) -> bool:
    """Answer one measurement; return whether it was answered to its end before `limit_ns`, or `stop`."""
    answer, asked_ns = LinkAnswer(), 0
    while (now_ns := monotonic_ns()) < limit_ns and not stop() and not connection.closed:
        if answer.is_complete and now_ns - asked_ns > _LAST_ASK_NS:
            return True
        for datagram in answer.poll(now_ns):
            connection.send(datagram)
        if not wait({"link": connection}, answer.next_ns(now_ns)):
            continue
        for index, (data, at_ns) in enumerate(connection.receive()):
            replies = answer.receive(data, at_ns)
            if replies is None:
                continue
            connection.trust_sender(index)
            connection.select_peer(index)
            for reply in replies:
                asked_ns = at_ns
                connection.send(reply)
    return answer.is_complete


def write_link(measurement: LinkMeasurement, config: Config, url: str, folder: Path) -> LinkBench:
    """Write each way as a configuration with its `[link]`, and as a trace of delays.

    Args:
        config: The rest of the configurations.
        folder: Made if need be.

    Raises:
        RecordingError: A file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return LinkBench(
        url=url,
        there=_write_way(measurement.there, config, folder / "link"),
        back=_write_way(measurement.back, config, folder / "link-back"),
        round_trip_s=tuple(np.round(np.quantile(measurement.round_trips_s, _QUANTILES), 6).tolist()),
    )


def fit_way(way: WayMeasurement) -> LinkFit:
    """Fit losses and delays of one way, as `uavctl identify` does for positions."""
    (arrived,) = np.nonzero(np.isfinite(way.delays_s))
    history = PositionHistory(way.sent_s[arrived], way.delays_s[arrived], np.zeros((len(arrived), 3)))
    return fit_link(history, np.diff(arrived) - 1)


def _write_way(way: WayMeasurement, config: Config, stem: Path) -> WayResult:
    fit = fit_way(way)
    link = msgspec.convert(make_link_section(fit), LinkConfig)
    path, trace = stem.with_suffix(".toml"), stem.with_suffix(".csv")
    write_atomically(path, dump_config(msgspec.structs.replace(config, link=link)))
    rows = ("" if math.isinf(delay_s) else f"{delay_s:.6f}" for delay_s in way.delays_s.tolist())
    write_atomically(trace, "\n".join(("delay_s", *rows)) + "\n")
    (arrived,) = np.nonzero(np.isfinite(way.delays_s))
    return WayResult(
        packets=len(way.delays_s),
        lost=len(way.delays_s) - len(arrived),
        loss=fit.loss,
        loss_std=fit.loss_std,
        bursts=fit.bursts,
        longest_run=int((np.diff(arrived) - 1).max()),
        outages_s=fit.outages_s,
        delay_s=fit.delay_s,
        jitter_s=fit.jitter_s,
        config=str(path),
        trace=str(trace),
    )
