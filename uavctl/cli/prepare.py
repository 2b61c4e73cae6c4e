"""From a configuration to a controller that is ready to decide, with a progress bar where that takes seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from uavctl.build import build_controller
from uavctl.cli.common import messages
from uavctl.config import Config
from uavctl.flight.controller import Controller
from uavctl.library_bytes import StoredLibrary
from uavctl.library_store import library_for
from uavctl.smpc.conditioned_design import AnyDesign
from uavctl.smpc.design import Design


@dataclass(frozen=True, eq=False)
class Prepared:
    """What flies.

    Attributes:
        config: The configuration.
        design: Its design.
        library: The design's policy library; None where scheme or `solver.method` ask for none.
        controller: The controller.
    """

    config: Config
    design: AnyDesign
    library: StoredLibrary | None
    controller: Controller


def prepare(config: Config, design: AnyDesign) -> Prepared:
    """Make policy library and controller of a design.

    Raises:
        DesignError: The configuration asks for what the design cannot do.
    """
    library = ready_library(config, design)
    controller = build_controller(config, design, None if library is None else library.library)
    return Prepared(config, design, library, controller)


def ready_library(config: Config, design: AnyDesign) -> StoredLibrary | None:
    """The policy library of a design that asks for one: from the cache, or made under a progress bar."""
    if not isinstance(design, Design) or not config.uses_library:
        return None
    with ExitStack() as stack:
        bar: list[Callable[[str], None]] = []  # from the first round on: there is none for what the cache holds

        def advance(name: str, count: int, worst_gap: float) -> None:
            if not bar:
                bar.append(stack.enter_context(_bar("policy library, made once for a design")))
            bar[0](f"policy library: {name}, {count} policies, worst gap {worst_gap:.0e}")

        return library_for(design, advance, lambda text: messages().print(escape(text), style="yellow", soft_wrap=True))


def _silent(text: str) -> None:
    del text


@contextmanager
def _bar(title: str) -> Iterator[Callable[[str], None]]:
    """A bar of unknown length; where standard error is no terminal, its title alone."""
    console = messages()
    if not console.is_terminal:
        console.print(escape(title), soft_wrap=True)
        yield _silent
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(escape(title), total=None)
        yield lambda text: progress.update(task, description=escape(text))
