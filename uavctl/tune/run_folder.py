"""The folder of a tuning run: what was asked for, how far it has come, and where its files are.

Every step writes its files first and its note last, so a run that was cut off goes on after the last one that is whole.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import msgspec

from logs.outputs import write_whole
from uavctl.config import Config
from uavctl.config.load import dump_config, parse
from uavctl.errors import UsageError
from uavctl.tune.change import TunedResult
from uavctl.tune.comparison import TuneComparison

STATE, SETTINGS, TUNED, PAGE, FIT_PAGE = "tune.json", "configuration.toml", "tuned.toml", "tune.html", "identified.html"
BEFORE, AFTER = "before", "after"  # folders of the flights; later attempts have numbers
_MOST_TOLD = 5


class TuneAsked(msgspec.Struct, frozen=True, kw_only=True):
    """What a run is of; it may not change between two calls."""

    box: str  # as it was understood; empty without one
    flight: str  # the recording that is begun with; empty where one is flown
    simulated: bool
    take_off_m: float | None


class TuneProgress(msgspec.Struct, frozen=True, kw_only=True):
    """How far a run has come."""

    asked: TuneAsked
    digest: str  # of the configuration
    before: str = ""  # recording of the excitation, once it is whole; relative to the folder if inside
    tuned: TunedResult | None = None
    after: str = ""  # recording of the flight with the tuned configuration
    comparison: TuneComparison | None = None


class TuneFolder:
    """A run on disk.

    Attributes:
        path: The folder.
        progress: How far the run has come.
    """

    def __init__(self, path: Path, progress: TuneProgress) -> None:
        self.path = path
        self.progress = progress

    @classmethod
    def opened(cls, path: Path, config: Config, asked: TuneAsked) -> TuneFolder:
        """Begin a run, or go on with the one that is there.

        Raises:
            UsageError: The folder holds something else, or a run of another configuration.
        """
        text = dump_config(config)
        digest = hashlib.sha256(text.encode()).hexdigest()
        if not (path / STATE).exists():
            if path.exists() and (not path.is_dir() or any(map(_is_anothers, path.iterdir()))):
                raise UsageError(f"--folder {path}: is no run of `uavctl tune`, and not empty; choose another folder")
            path.mkdir(parents=True, exist_ok=True)
            folder = cls(path, TuneProgress(asked=asked, digest=digest))
            folder.note()
            write_whole(path / SETTINGS, text)
            return folder
        progress = _read(path / STATE)
        if progress.digest != digest:
            told = "; ".join(_differences(path / SETTINGS, text)) or "other values"
            raise UsageError(
                f"--folder {path}: is a run of another configuration ({told}). Give that one to go on, or choose "
                "another folder"
            )
        if progress.asked != asked:
            told = ", ".join(_asked_otherwise(progress.asked, asked))
            raise UsageError(
                f"--folder {path}: is a run that was begun with {told}. Go on with the same, or choose another folder"
            )
        folder = cls(path, progress)
        if not (path / SETTINGS).exists():
            write_whole(path / SETTINGS, text)
        if progress.comparison is None:
            folder.note()  # a folder that takes no more is told before anything is flown
        return folder

    def note(self, **done: object) -> None:
        """Write down that a step is done.

        Raises:
            RecordingError: It cannot be written.
        """
        self.progress = msgspec.structs.replace(self.progress, **done)
        write_whole(self.path / STATE, msgspec.json.format(msgspec.json.encode(self.progress)).decode() + "\n")

    def free(self, name: str) -> Path:
        """A folder for one more flight: the first of NAME, NAME-2, NAME-3, … that is not there yet."""
        return self._attempts(name)[1]

    def newest(self, name: str) -> Path | None:
        """The folder of the newest attempt at a flight; None before the first."""
        return self._attempts(name)[0]

    def _attempts(self, name: str) -> tuple[Path | None, Path]:
        newest, number = None, 1
        while (found := self.path / (name if number == 1 else f"{name}-{number}")).exists():
            newest, number = found, number + 1
        return newest, found

    def recording(self, noted: str) -> Path:
        """Path of a recording that the progress names."""
        return self.path / noted  # an absolute one stays what it is

    def relative(self, recording: Path) -> str:
        """How the progress names a recording: so that the folder may be moved."""
        try:
            return str(recording.relative_to(self.path))
        except ValueError:
            return str(recording.absolute())


@contextmanager
def sole_run(path: Path) -> Iterator[None]:
    """Hold the folder of a run, which is made if there is none; the kernel lets go of it when its holder ends.

    Raises:
        UsageError: Another process has it, or it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise UsageError(f"--folder {path}: no folder can be had there ({error.strerror}); choose another") from error
    try:
        _lock(descriptor, path)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, path: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UsageError(f"--folder {path}: another `uavctl tune` is at work in it; wait for it, or end it") from None


def read_tuned(path: Path) -> Config:
    """The tuned configuration, as it was written or as its owner has changed it since.

    Raises:
        UsageError: It was cut: what it lacks would be a preset's, and nobody has seen that fly.
        ConfigError: It is wrong.
    """
    text = path.read_text(encoding="utf-8")
    config = parse(text, str(path)).config
    there = dict(_dotted(tomllib.loads(text), ""))
    lacking = [key for key, _ in _dotted(tomllib.loads(dump_config(config)), "") if key not in there]
    if lacking:
        more = f" and {len(lacking) - 1} more keys" if len(lacking) > 1 else ""
        raise UsageError(
            f"{path}: is not whole, {lacking[0]}{more} are missing; put them back, or remove the file: the same "
            "command then writes it anew"
        )
    return config


def _is_anothers(path: Path) -> bool:
    """Whether a file is none of a run that was cut off while it wrote its first one."""
    return path.name != f"{STATE}.part"


def _read(path: Path) -> TuneProgress:
    try:
        return msgspec.json.decode(path.read_bytes(), type=TuneProgress)
    except (OSError, msgspec.DecodeError) as error:
        raise UsageError(f"{path}: cannot be read ({error}); choose another --folder") from error


def _differences(settings: Path, text: str) -> Iterator[str]:
    """The first keys in which two configurations differ, with both values."""
    try:
        old = dict(_dotted(tomllib.loads(settings.read_text(encoding="utf-8")), ""))
    except (OSError, tomllib.TOMLDecodeError):
        return
    new = dict(_dotted(tomllib.loads(text), ""))
    keys = [key for key in dict.fromkeys([*old, *new]) if old.get(key) != new.get(key)]
    for key in keys[:_MOST_TOLD]:
        yield f"{key} = {old.get(key)} there, {new.get(key)} here"
    if len(keys) > _MOST_TOLD:
        yield f"{len(keys) - _MOST_TOLD} more"


def _dotted(table: Mapping[str, object], path: str) -> Iterator[tuple[str, object]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def _asked_otherwise(there: TuneAsked, here: TuneAsked) -> Iterator[str]:
    if there.box != here.box:
        yield f"--box={there.box}" if there.box else "no --box"
    if there.flight != here.flight:
        yield f"--flight {there.flight}" if there.flight else "no --flight"
    if there.simulated != here.simulated:
        yield "--loopback" if there.simulated else "a real vehicle"
    if there.take_off_m != here.take_off_m:
        yield "no --arm" if there.take_off_m is None else f"--arm --takeoff {there.take_off_m:g}"
