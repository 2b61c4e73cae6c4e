"""A list of faults from a TOML file of its own: the same tables as `[[sim.fault]]`, headed `[[fault]]`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from uavctl.config.bounds import oversized
from uavctl.config.data_file import DataFileError, read_lines
from uavctl.config.index import key_lines
from uavctl.config.load import decode, parse_toml
from uavctl.config.problem import Problem
from uavctl.config.section import Section
from uavctl.config.sim import MOST_FAULTS, FaultConfig
from uavctl.config.sim_checks import faults
from uavctl.config.source import Source
from uavctl.config.types import Config
from uavctl.errors import ConfigError

Check = Callable[[Literal["px4", "ardupilot"], Sequence[FaultConfig], str], Iterable[Problem]]
_Faults = Annotated[
    tuple[FaultConfig, ...], Meta(max_length=MOST_FAULTS, description="what happens in the course of a flight")
]


class _FaultFile(Section, frozen=True, kw_only=True):
    """The whole file."""

    fault: _Faults


def with_faults(config: Config, path: Path, check: Check) -> Config:
    """The configuration with the faults of a file after its own.

    Args:
        config: the configuration.
        path: the file.
        check: what the simulator cannot do of a list of faults, given the kind of autopilot, the list and its key.

    Raises:
        ConfigError: With all problems found in the file, each with its line.
    """
    try:
        text = "\n".join(read_lines(path)) + "\n"
    except DataFileError as error:
        raise ConfigError(error.reasons) from error
    found: list[Problem] = []
    table = parse_toml(text, str(path))
    found.extend(oversized(table))
    script = None if found else decode(_FaultFile, table, "", found, {})
    given = script.fault if isinstance(script, _FaultFile) else ()
    found.extend(faults("fault", given, config.sim.plant))
    found.extend(check(config.sim.autopilot, given, "fault"))
    if found:
        source = Source(str(path), key_lines(text))
        raise ConfigError(tuple(source.tell(problem) for problem in found))
    sim = msgspec.structs.replace(config.sim, fault=(*config.sim.fault, *given))
    return msgspec.structs.replace(config, sim=sim)
