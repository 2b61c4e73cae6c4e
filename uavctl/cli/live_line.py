"""Live line and messages of a flight on the console."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TimeElapsedColumn
from rich.text import Text

from logs.recording.recorder import RecorderStatus
from uavctl.cli.output import label_text, make_message_console
from uavctl.loop import ControlLoop
from uavctl.mavlink.handover_states import HandoverState
from uavctl.records import ControlMode, Event, Severity, Ticked

REPEAT_NS = 30_000_000_000  # period of a repeated text


MAX_TEXTS = 256  # different texts in memory


VEHICLE_TEXT = "vehicle-text"


_AWAITED = {
    HandoverState.WAITING: "the vehicle's heartbeat",
    HandoverState.MODE: "the mode to take off in",
    HandoverState.ARMING: "arming",
    HandoverState.CLIMBING: "the end of the climb",
    HandoverState.ENGAGING: "the mode that takes setpoints",
    HandoverState.RETURNING: "the mode that takes setpoints",
    HandoverState.LANDING: "landing",
    HandoverState.SETTLING: "the ground",
}


def describe_wait(state: HandoverState) -> str:
    """Return the event that the hand-over waits for; empty if it waits for nothing of the vehicle."""
    return _AWAITED.get(state, "")


class MessageFilter:
    """Filter for messages: a text passes once, and again after `REPEAT_NS` if it is repeated."""

    def __init__(self) -> None:
        self._shown_ns: dict[str, int] = {}

    def format_line(self, event: Event, state: HandoverState) -> str | None:
        """Return the line to print for an event; None for no line."""
        if event.code == VEHICLE_TEXT and event.severity is Severity.INFO:
            return None
        shown_ns = self._shown_ns.get(event.text)
        if shown_ns is not None and event.at_ns - shown_ns < REPEAT_NS:
            return None
        if shown_ns is None and len(self._shown_ns) >= MAX_TEXTS:
            del self._shown_ns[min(self._shown_ns, key=lambda text: self._shown_ns[text])]
        self._shown_ns[event.text] = event.at_ns
        awaited = describe_wait(state)
        text = f'the vehicle reports: "{event.text}"' if event.code == VEHICLE_TEXT else event.text
        return f"{text} (waiting for {awaited})" if awaited else text


MAX_EVENTS = 64  # unshown events of the vehicle and the core


MAX_NOTICES = 100  # unshown notices


REFRESH_S = 0.25


# Longest wait of the control thread for the interpreter while another thread runs [s].
SWITCH_INTERVAL_S = 0.0005


class LiveFeed:
    """Last tick and messages of a flight to show. The thread of the control loop fills it, another thread empties it.

    Attributes:
        ticked: The last tick; None before the first.
        events: Events of the vehicle and the core, not shown yet.
        notices: Events to be shown each, not shown yet.
    """

    def __init__(self) -> None:
        self.ticked: Ticked | None = None
        self.events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self.notices: deque[Event] = deque(maxlen=MAX_NOTICES)

    def after_tick(self, ticked: Ticked, lateness_ns: int) -> None:
        """Keep a tick, and queue its messages."""
        del lateness_ns
        self.events.extend(ticked.console_events)
        self.notices.extend(ticked.notices)
        self.ticked = ticked


@contextmanager
def show_live_line(
    loop: ControlLoop, get_status: Callable[[], RecorderStatus], duration_s: float | None, tick_s: float
) -> Iterator[LiveFeed]:
    """Show the state of the loop on standard error, from a thread of its own; yield the feed of that thread."""
    previous_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    columns = (BarColumn(bar_width=20), TimeElapsedColumn(), _StateColumn())
    done, release_shown = threading.Event(), threading.Event()
    with Progress(
        *columns, console=make_message_console(), transient=True, refresh_per_second=1 / REFRESH_S
    ) as progress:
        # The bar's own console would draw it, also into a file.
        console = progress.console if progress.console.is_terminal else make_message_console()
        task = progress.add_task("waiting", total=duration_s)
        message_filter, feed = MessageFilter(), LiveFeed()

        def print_events() -> None:
            while feed.events:
                line = message_filter.format_line(feed.events.popleft(), loop.handover_state)
                if line is not None:
                    console.print(Text(line, style="yellow"), soft_wrap=True)

        def refresh() -> None:
            while not done.wait(REFRESH_S):
                with suppress(Exception):  # such as no memory: the next line tries again
                    show()

        def show() -> None:
            print_events()
            ticked = feed.ticked
            print_notices(feed.notices, console)
            if loop.breach_reason and not release_shown.is_set():
                release_shown.set()
                console.print(label_text("letting go", loop.breach_reason, "bold red"), soft_wrap=True)
            if ticked is not None:
                line = _format_state(ticked, loop.handover_state) + _format_recorder_warning(get_status())
                progress.update(task, completed=ticked.decision.tick * tick_s, line=line)

        thread = threading.Thread(target=refresh, name="live", daemon=True)
        thread.start()
        try:
            yield feed
        finally:
            done.set()
            thread.join()
            print_events()
            print_notices(feed.notices, console)
            sys.setswitchinterval(previous_s)


def print_notices(notices: deque[Event], console: Console) -> None:
    """Print and remove the notices."""
    while notices:
        event = notices.popleft()
        style = "bold red" if event.severity is Severity.ERROR else "bold yellow"
        console.print(label_text(event.code, event.text, style), soft_wrap=True)


class _StateColumn(ProgressColumn):
    """Column with the state of a flight."""

    def render(self, task: Task) -> Text:
        """Return the field `line` of the task."""
        line = task.fields.get("line")
        return line if isinstance(line, Text) else Text(task.description)


_LANDING = (HandoverState.LANDING, HandoverState.SETTLING)


def describe_phase(mode: ControlMode, state: HandoverState) -> str:
    """Return the word for the phase of a flight: the controller's mode, or the vehicle's own climb or landing."""
    if mode is ControlMode.WAIT and state is HandoverState.CLIMBING:
        return "climb"
    return "landing" if mode is ControlMode.STOPPED and state in _LANDING else mode.value


def _format_state(ticked: Ticked, handover_state: HandoverState) -> Text:
    decision, vehicle, estimate = ticked.decision, ticked.vehicle, ticked.estimate
    mode = "no vehicle" if vehicle is None else f"{vehicle.mode} {'armed' if vehicle.armed else 'disarmed'}"
    age = "-" if estimate is None else f"{max(0.0, estimate.age_s):.2f} s"
    accel = "-" if decision.input is None else " ".join(f"{u:+z.2f}" for u in decision.input)
    awaited = describe_wait(handover_state) if decision.mode is ControlMode.WAIT else ""
    mode = f"{mode}, waiting for {awaited}" if awaited else mode
    return Text.assemble(
        f"{describe_phase(decision.mode, handover_state):7} age {age:>6}  input {accel}  ", (mode, "dim")
    )


def _format_recorder_warning(status: RecorderStatus) -> Text:
    """Return a warning on the open recording; empty if there is none."""
    if status.ok:
        return Text(f"  disk gets low: {status.warning}" if status.warning else "", style="yellow")
    return Text(f"  recording fails: {status.reason or f'{status.dropped} records dropped'}", style="bold red")
