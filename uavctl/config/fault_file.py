"""A list of faults from a TOML file of its own: the same tables as `[[sim.fault]]`, headed `[[fault]]`."""

from __future__ import annotations

from pathlib import Path

import msgspec

from uavctl.config.data_file import DataFileError, read_lines
from uavctl.config.index import key_lines
from uavctl.config.load import decode, parse_toml
from uavctl.config.problem import Problem
from uavctl.config.section import Section
from uavctl.config.sim import FaultConfig
from uavctl.config.sim_checks import faults
from uavctl.config.source import Source
from uavctl.config.types import Config
from uavctl.errors import ConfigError


class _FaultFile(Section, frozen=True, kw_only=True):
    """The whole file."""

    fault: tuple[FaultConfig, ...]


def with_faults(config: Config, path: Path) -> Config:
    """The configuration with the faults of a file after its own.

    Raises:
        ConfigError: With all problems found in the file, each with its line.
    """
    try:
        text = "\n".join(read_lines(path)) + "\n"
    except DataFileError as error:
        raise ConfigError(error.reasons) from error
    found: list[Problem] = []
    script = decode(_FaultFile, parse_toml(text, str(path)), "", found, {})
    given = script.fault if isinstance(script, _FaultFile) else ()
    found.extend(faults("fault", given, config.sim.plant))
    if found:
        source = Source(str(path), key_lines(text))
        raise ConfigError(tuple(source.tell(problem) for problem in found))
    sim = msgspec.structs.replace(config.sim, fault=(*config.sim.fault, *given))
    return msgspec.structs.replace(config, sim=sim)
