"""One small tree of errors; each message holds the place, the reason and the remedy."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


class UavctlError(Exception):
    """Base of all errors that are meant for a person."""

    exit_code = 1


class UsageError(UavctlError):
    """The command line asks for something that cannot be."""

    exit_code = 2


class ExtraMissingError(UsageError):
    """A request needs a package that is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        self.package = package
        self.extra = extra
        super().__init__(f"{package} is not installed; pip install 'uavctl[{extra}]'")


def need(package: str, extra: str) -> ModuleType:
    """Return an optional package, imported.

    Raises:
        ExtraMissingError: It is not installed; names the extra to install.
    """
    try:
        return import_module(package)
    except ImportError as missing:
        raise ExtraMissingError(package, extra) from missing


class PlatformError(UsageError):
    """A request needs what this operating system lacks."""


class ConfigError(UavctlError):
    """The configuration is wrong; holds every problem found, not only the first."""

    exit_code = 2

    def __init__(self, problems: tuple[str, ...]) -> None:
        self.problems = problems
        super().__init__("\n".join(problems))


class DesignError(UavctlError):
    """No controller can be designed from this configuration."""

    exit_code = 2

    def __init__(self, key: str, reason: str, hint: str) -> None:
        self.key = key
        self.reason = reason
        self.hint = hint
        super().__init__(f"{key}: {reason}; {hint}")


class ControllerError(UavctlError):
    """A controller answers with what is no input."""


class ConnectionSpecError(UsageError):
    """A connection URL cannot be understood or opened."""


class ConnectionClosedError(UavctlError):
    """The other side has closed the vehicle's connection while it was flown."""


class NotReadyError(UavctlError):
    """The vehicle must not be armed as things are; names every failed item."""


class RecordingError(UavctlError):
    """A recording cannot be read, or not without loss."""


class OutputError(UavctlError):
    """Standard output takes nothing."""


class VehicleTakenError(UavctlError):
    """Another daemon flies this vehicle, or answers under its name."""


class NotReachedError(UavctlError):
    """No daemon can be asked: none runs, several do, or the one that does gives no answer."""


class KeyFileError(UsageError):
    """A file of a signing key, or of its stamps, cannot be used."""


class EndedBySignal(SystemExit):
    """The operator's second signal: it ends the process wherever that is, also in code of another package."""


class TickOverdueError(BaseException):
    """A tick that does not end; no handler of another package's errors is meant to catch it."""


# What code of other packages may raise, where nothing that it does may end a flight or a campaign.
RAISED = (Exception, SystemExit, GeneratorExit)
LONGEST_WORDS = 500  # of an error's text [characters]


def in_words(error: BaseException, longest: int = LONGEST_WORDS) -> str:
    """Return an error of any code on one line: its type and its text, as far as there is one."""
    try:
        said = str(error)[:longest]
    except RAISED:
        said = ""
    said = "".join(c if c.isprintable() else " " for c in said).strip()
    return f"{type(error).__name__}: {said}" if said else type(error).__name__
