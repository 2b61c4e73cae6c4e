"""Common parts of commands: options, progress, and the message of a refused design.

All commands share --config, --set and --json, and the place of their output.
"""

from __future__ import annotations

import stat
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter, validators
from rich.console import RenderableType
from rich.measure import Measurement
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TaskID, TextColumn, TimeElapsedColumn

from uavctl.cli.output import make_message_console, make_output_console, print_message, write_document
from uavctl.config import LoadedConfig, describe_design_error, load
from uavctl.config.document import MAX_DURATION_S, MAX_SEED
from uavctl.errors import ConfigError, DesignError

_FILE_WIDTH, _MAX_WIDTH = 120, 10_000

Overrides = Annotated[
    tuple[str, ...],
    Parameter(
        name="--set",
        negative=(),
        show_default=False,
        metavar="KEY=VALUE",
        help="override one key, as in link.loss=0.3; may be repeated",
    ),
]


Json = Annotated[bool, Parameter(negative=(), help="one JSON document on standard output, nothing else")]
QuietJson = Annotated[Json, Parameter(show_default=False)]


@Parameter(name="*")
@dataclass(frozen=True)
class Common:
    """Options of every command that takes a configuration."""

    config: Annotated[
        str, Parameter(help="preset (paper, room, room-px4, room-ardupilot, room-hahn-stursberg) or TOML file")
    ] = "room"
    overrides: Overrides = ()
    json: QuietJson = False

    def load(self) -> LoadedConfig:
        """Load the configuration that the options ask for.

        Raises:
            ConfigError: With all problems found.
        """
        from sim.faults import check_fault_support  # a replay, which has a configuration of its own, needs no simulator

        loaded = load(self.config, self.overrides)
        check_fault_support(loaded)
        return loaded

    def with_overrides(self, extra: Sequence[str]) -> Common:
        """Return the options with further overrides, which win."""
        return replace(self, overrides=(*self.overrides, *extra))

    def show(
        self, name: str, document: Mapping[str, object] | msgspec.Struct, render: Callable[[], RenderableType]
    ) -> None:
        """Write the result to standard output, as the JSON document `name` or as a picture for people."""
        if self.json:
            write_document(name, document)
        else:
            renderable, console = render(), make_output_console()
            if not sys.stdout.isatty():
                # Files and pipes have no width; the default of 80 columns would fold tables and cut words.
                unlimited = console.options.update_width(_MAX_WIDTH)
                console.width = max(_FILE_WIDTH, Measurement.get(console, unlimited, renderable).minimum)
            console.print(renderable)


def check_readable(type_: object, path: object) -> None:
    """Refuse a path that cannot be read as a recording: reading a pipe would wait, a device has no end.

    Raises:
        ValueError: The path is a pipe or a device, or a name that the system refuses.
    """
    del type_
    for name in path if isinstance(path, tuple) else (path,):
        try:
            mode = Path(str(name)).stat().st_mode
        except FileNotFoundError:
            continue  # the reader of the file reports it
        except OSError as error:
            raise ValueError(f"{error.strerror}; give a recording") from error
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise ValueError("it is a pipe or a device; give a recording")


DEFAULTS = Common()
Flight = Annotated[Path, Parameter(help="the recording", validator=check_readable)]
System = Annotated[
    int | None,
    Parameter(
        help="with several vehicles' MAVLink: the vehicle's system id", validator=validators.Number(gte=1, lte=255)
    ),
]
SPAN_S = validators.Number(gt=0, lte=MAX_DURATION_S)
HEIGHT_M = validators.Number(gt=0, lte=1000)
SEED = validators.Number(gte=0, lte=MAX_SEED)
WORKERS = validators.Number(gte=1, lte=1024)
PORT = validators.Number(gte=1, lte=65535)
FREE_PORT = validators.Number(gte=0, lte=65535)
Mocap = Annotated[str | None, Parameter(help="URL of the positions; else daemon.mocap. May be that of the vehicle")]
TakeOff = Annotated[
    float | None, Parameter(help="climb to this height above the ground [m], then fly; needs --arm", validator=HEIGHT_M)
]


def make_key_overrides(**values_by_key: str | float | None) -> list[str]:
    """Return overrides of the keys that have a value; `__` stands for the dot in a key."""
    values = {key.replace("__", "."): value for key, value in values_by_key.items() if value is not None}
    return [f'{key}="{value}"' if isinstance(value, str) else f"{key}={value}" for key, value in values.items()]


LINE_PERIOD_S = 5.0  # between two lines of progress where no bar can be drawn


class _ProgressLines(Progress):
    """Bars in a terminal; in a file or a pipe a line every few seconds."""

    _printed_s: float | None = None

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Advance a task by so many steps."""
        super().advance(task_id, advance)
        self._print_line(task_id)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Change fields of a task, as in rich."""
        super().update(task_id, **changes)
        self._print_line(task_id)

    def _print_line(self, task_id: TaskID) -> None:
        if self.console.is_terminal:
            return
        now_s = self.get_time()
        if self._printed_s is None:
            self._printed_s = now_s
        if now_s - self._printed_s < LINE_PERIOD_S:
            return
        self._printed_s = now_s
        task = self._tasks[task_id]
        done = "" if task.total is None else f": {round(task.completed, 1):.10g} of {round(task.total, 1):.10g}"
        # Not by the bar's own console, which would draw it.
        print_message(f"{task.description or 'at work'}{done} ({task.elapsed or 0.0:.0f} s)")


def make_progress(*columns_after: ProgressColumn, auto_refresh: bool = True) -> Progress:
    """Return a progress bar on standard error, which is removed at the end.

    Without a terminal it is a line every five seconds.

    Args:
        columns_after: Columns after the bar; without any the count and the elapsed time.
        auto_refresh: A thread of its own draws.
    """
    trailing = columns_after or (MofNCompleteColumn(), TimeElapsedColumn())
    head = (TextColumn("{task.description}", markup=False), BarColumn())
    return _ProgressLines(*head, *trailing, console=make_message_console(), transient=True, auto_refresh=auto_refresh)


@contextmanager
def locate_design_errors(loaded: LoadedConfig) -> Iterator[None]:
    """Turn the error of a refused design into one with the file and line of its key.

    Raises:
        ConfigError: In place of the DesignError.
    """
    try:
        yield
    except DesignError as error:
        raise ConfigError((describe_design_error(loaded.source, error),)) from error
