"""What was promised against what was flown: risk, link, model and clocks. Pure functions of a flight's records."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from logs.filtered import Innovations, innovations
from logs.flight_data import FlightData
from logs.statistics import LEVEL
from logs.verdict_clock import ClockVerdict, StampVerdict, judge_clocks, judge_stamps
from logs.verdict_link import LinkVerdict, judge_link
from logs.verdict_model import ModelVerdict, judge_innovations
from logs.verdict_risk import RiskVerdict, judge_risk
from uavctl.config import Config
from uavctl.config.load import parse
from uavctl.errors import ConfigError


class Verdicts(msgspec.Struct, frozen=True, kw_only=True):
    """All verdicts of one flight; each has `text`, a plain sentence, and `refuted`, where a flight can refute."""

    level: float  # of the intervals and bounds of each verdict, all of them together
    risk: RiskVerdict
    link: LinkVerdict
    model: ModelVerdict | None  # None where the configuration of the flight cannot be read any more
    clocks: tuple[ClockVerdict, ...]  # one a connection that tells of its clock
    stamps: StampVerdict | None  # stamps against the true path; None without one


@dataclass(frozen=True, eq=False)
class Judged:
    """Verdicts, and the errors of the forecast that the model's is from; None where there is none."""

    verdicts: Verdicts
    innovations: Innovations | None


def judge(flight: FlightData) -> Judged:
    """Judge a flight by its records."""
    config = flown_config(flight)
    found = None if config is None else innovations(flight, config)
    model = None if found is None else judge_innovations(found, flight.design.axes, flight.design.dt_s)
    verdicts = Verdicts(
        level=LEVEL,
        risk=judge_risk(flight, config),
        link=judge_link(flight, config),
        model=model,
        clocks=judge_clocks(flight),
        stamps=judge_stamps(flight),
    )
    return Judged(verdicts, found)


def flown_config(flight: FlightData) -> Config | None:
    """The configuration that was flown; None where this version cannot read it, or it is another plant's."""
    try:
        config = parse(flight.header.config_toml, "the recording's configuration").config
    except ConfigError:
        return None
    return config if config.plant.axes == flight.design.axes else None
