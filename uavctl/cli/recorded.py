"""The controller of a recording: with the policy library that it carries, whatever the cache holds."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from logs.replay import recorded_library
from uavctl.build import build_controller, design_of
from uavctl.cli.common import located
from uavctl.cli.prepare import Prepared, prepare
from uavctl.config import Config, Loaded
from uavctl.errors import LibraryError, RecordingError
from uavctl.library_bytes import check_fits, decode
from uavctl.smpc.design import Design


def recorded_flyer(flight: Path, config: Config) -> Prepared:
    """What flew.

    Args:
        flight: The recording.
        config: Its configuration.

    Raises:
        RecordingError: It carries no policy library though it flew with one, or one that does not fit.
    """
    design = design_of(config)
    if not isinstance(design, Design) or not config.uses_library:
        return prepare(config, design)
    try:
        return _with_library(flight, config, design)
    except LibraryError as error:
        raise RecordingError(
            f"{flight}: {error.reason}; use the version that recorded it (`uavctl log info` tells)"
        ) from error


def changed_flyer(flight: Path, before: Config, loaded: Loaded) -> Prepared:
    """What flies with a changed configuration: the recorded policy library where that fits, else one of its own.

    Raises:
        ConfigError: The configuration leaves no design.
        RecordingError: The recording carries no policy library though it flew with one.
    """
    config = loaded.config
    with located(loaded):
        design = design_of(config)
        if isinstance(design, Design) and config.uses_library and before.uses_library:
            with suppress(LibraryError):
                return _with_library(flight, config, design)
        return prepare(config, design)


def _with_library(flight: Path, config: Config, design: Design) -> Prepared:
    library = decode(recorded_library(flight).data)
    check_fits(library.library, design)
    return Prepared(config, design, library, build_controller(config, design, library.library))
