"""What `uavctl fly --arm` looks at before the vehicle is asked for anything."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from rich.markup import escape

from uavctl.check.item import Item, State, refusals
from uavctl.cli.common import messages
from uavctl.config import Config
from uavctl.data import Checked, Sink
from uavctl.errors import NotReadyError
from uavctl.preflight import run_preflight
from uavctl.transport import Connection


def checked_before_arming(
    config: Config, connections: Mapping[str, Connection], stop: Callable[[], bool], take_off_m: float
) -> tuple[Item, ...]:
    """Check vehicle and cameras for `check.seconds`, before a climb of `take_off_m`; tells what is not good.

    Returns:
        All items; none of them forbids arming.

    Raises:
        NotReadyError: an item forbids arming.
    """
    messages().print(f"checking for {config.check.seconds:g} s before arming", soft_wrap=True)
    items = run_preflight(config, connections, config.check.seconds, take_off_m=take_off_m, stop=stop)
    against = refusals(items, config.check)
    if against:
        lines = (f"{one.name}: {one.value} (wanted: {one.want}); {one.hint}" for one in against)
        raise NotReadyError("\n".join(("not armed, as the check before it failed:", *lines)))
    for one in _worth_telling(items):
        messages().print(f"[yellow]check:[/] {escape(f'{one.name}: {one.value}; {one.hint}')}", soft_wrap=True)
    return items


def record_items(sink: Sink, items: Iterable[Item], at_ns: int) -> None:
    """Put what was found into the recording."""
    for one in items:
        found = Checked(at_ns=at_ns, name=one.name, state=str(one.state), value=one.value, want=one.want, hint=one.hint)
        sink.put("/uavctl/check", at_ns, found)


def _worth_telling(items: Iterable[Item]) -> list[Item]:
    return [one for one in items if one.state is not State.GOOD]
