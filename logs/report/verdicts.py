"""Verdicts of a flight: promised against measured risk, link, model and clocks. Pure functions of its records."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from logs.recording.flight import FlightData
from logs.report.innovations import InnovationSamples, compute_innovations
from logs.report.statistics import LEVEL
from logs.report.verdict_clocks import ClockVerdict, StampVerdict, judge_clocks, judge_stamps
from logs.report.verdict_link import LinkVerdict, judge_link
from logs.report.verdict_model import ModelVerdict, judge_innovations
from logs.report.verdict_risk import RiskVerdict, judge_risk
from logs.report.verdict_room import RoomVerdict, judge_room
from uavctl.config import Config
from uavctl.config.load import parse_recorded
from uavctl.errors import ConfigError


class Verdicts(msgspec.Struct, frozen=True, kw_only=True):
    """All verdicts of one flight; each has `text`, a plain sentence, and `refuted`, where a flight can refute."""

    level: float  # of the intervals and bounds of each verdict, all of them together
    risk: RiskVerdict
    room: RoomVerdict
    link: LinkVerdict
    model: ModelVerdict | None  # None where the configuration of the flight cannot be read any more
    clocks: tuple[ClockVerdict, ...]  # one for each connection that reports its clock
    stamps: StampVerdict | None  # stamps against the true path; None without one


@dataclass(frozen=True, eq=False)
class Judgement:
    """Verdicts of a flight, and the forecast errors behind that on the model; None where there are none."""

    verdicts: Verdicts
    innovations: InnovationSamples | None


def judge_flight(flight: FlightData, promised: str | None = None) -> Judgement:
    """Judge a flight by its records.

    Args:
        promised: Result of the rehearsed flights, in words; see `judge_room`.
    """
    config = read_flown_config(flight)
    samples = None if config is None else compute_innovations(flight, config)
    model = None if samples is None else judge_innovations(samples, flight.design.axes, flight.design.dt_s)
    verdicts = Verdicts(
        level=LEVEL,
        risk=judge_risk(flight, config),
        room=judge_room(flight, promised),
        link=judge_link(flight, config),
        model=model,
        clocks=judge_clocks(flight),
        stamps=judge_stamps(flight),
    )
    return Judgement(verdicts, samples)


def read_flown_config(flight: FlightData) -> Config | None:
    """Return the configuration that was flown; None if this version cannot read it or it is another plant's."""
    try:
        config = parse_recorded(flight.header.config_toml, "the recording's configuration").config
    except ConfigError:
        return None
    return config if config.plant.axes == flight.design.axes else None
