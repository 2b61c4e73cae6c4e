"""Preparation of a controller ready to decide, with a progress bar where that takes seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

from rich.progress import TimeElapsedColumn

from uavctl.build import controller
from uavctl.cli.common import bars, messages
from uavctl.config import Config
from uavctl.smpc.conditioned.planner import AnyDesign

if TYPE_CHECKING:
    from uavctl.build.library import StoredLibrary


def prepare(config: Config, design: AnyDesign) -> controller.Prepared:
    """Make policy library and controller of a design.

    Raises:
        DesignError: The configuration asks for what the design cannot do.
    """
    return controller.prepare(config, design, ready_library(config, design))


def ready_library(config: Config, design: AnyDesign) -> StoredLibrary | None:
    """Return the policy library of a design that asks for one: from the cache, or made under a progress bar."""
    with ExitStack() as stack:
        bar: list[Callable[[str], None]] = []  # from the first round on: there is none for what the cache holds

        def advance(name: str, count: int, worst_gap: float) -> None:
            if not bar:
                bar.append(stack.enter_context(_bar("policy library, made once for a design")))
            bar[0](f"policy library: {name}, {count} policies, worst gap {worst_gap:.0e}")

        return controller.ready_library(
            config, design, advance, lambda text: messages().print(text, style="yellow", soft_wrap=True)
        )


@contextmanager
def _bar(title: str) -> Iterator[Callable[[str], None]]:
    """Show a progress bar of unknown length; without a terminal its title, and a line now and then."""
    console = messages()
    if not console.is_terminal:
        console.print(title, soft_wrap=True)
    with bars(TimeElapsedColumn()) as progress:
        task = progress.add_task(title, total=None)
        yield lambda text: progress.update(task, description=text)
