"""Command `uavctl cameras`: send the positions of all vehicles of a fleet over one channel with a budget."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

from cyclopts import Parameter

from logs.recording.ends import make_recording_path
from logs.recording.sender import SenderRecording
from uavctl.cli.common import SPAN_S, Common, QuietJson
from uavctl.cli.fleet import Fleet, Member, read_fleet
from uavctl.cli.output import make_table, print_message
from uavctl.cli.signals import stop_on_signals
from uavctl.clock import monotonic_ns, read_zero_utc_ns
from uavctl.errors import ConfigError
from uavctl.io.base import Connection
from uavctl.io.signed_connection import make_admission_rules
from uavctl.io.sources import open_source
from uavctl.io.transport import open_connection, wait
from uavctl.mavlink.connection import MOCAP
from uavctl.wiring.sender import PositionSender

MAX_SLEEP_NS = 50_000_000  # so that a signal ends the command soon


def cameras(
    file: Annotated[Path, Parameter(help="TOML file of the fleet, with [radio] and the sources of its vehicles")],
    /,
    *,
    duration: Annotated[
        float | None, Parameter(help="end after this time [s]; else on Ctrl-C", validator=SPAN_S)
    ] = None,
    out: Annotated[Path | None, Parameter(help="folder of the recording; else a new one below flights/")] = None,
    json: QuietJson = False,
) -> int:
    """Send the positions of all vehicles of a fleet over one channel; never queues. Ctrl-C ends it.

    Exit code 1: not every vehicle was sent a position, or the recording lacks some.
    """
    fleet = read_fleet(file)
    problems = list(_find_problems(file, fleet))
    if problems:
        raise ConfigError(tuple(problems))
    start_ns = monotonic_ns()
    sender = PositionSender(
        [member.config for member in fleet.members],
        [member.cameras for member in fleet.members],
        fleet.radio,
        spacing_m=fleet.spacing_m,
        start_ns=start_ns,
    )
    names = [member.name for member in fleet.members]
    path = make_recording_path(out, file.stem).with_name("sender.mcap")
    with (
        SenderRecording(path, names, read_zero_utc_ns()) as recording,
        _open_connections(fleet) as connections,
        stop_on_signals() as stopped,
    ):
        print_message(f"sending the positions of {len(names)} vehicles, recording to {path}; Ctrl-C ends it")
        end_ns = None if duration is None else monotonic_ns() + round(duration * 1e9)
        closed: set[str] = set()
        while not stopped() and (end_ns is None or monotonic_ns() < end_ns):
            _run_once(sender, connections, recording)
            for name in {name for name, connection in connections.items() if connection.closed} - closed:
                closed.add(name)
                direction, _, number = name.partition(" ")
                side = "source" if direction == "from" else "link"
                print_message(f"{names[int(number)]}: its {side} is closed: {connections[name].url}")
    if recording.failure:
        print_message(f"{path}: the recording lacks positions ({recording.failure}); see to the disk")
    if sender.refused:
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(sender.refused.items()))
        print_message(f"not used: {reasons}")
    counts = {name: sender.sent[number] for number, name in enumerate(names)}
    document = {"out": str(path), "sent": counts, "refused": dict(sender.refused)}
    rows = [[name, str(count)] for name, count in counts.items()]
    Common(json=json).show("cameras", document, lambda: make_table("positions sent", ("vehicle", "number"), rows))
    return 0 if all(counts.values()) and not recording.failure else 1


def _run_once(sender: PositionSender, connections: dict[str, Connection], recording: SenderRecording) -> None:
    """Send what is due, then wait for data or for the channel."""
    at_ns = monotonic_ns()
    sent = sender.send_next(at_ns)
    if sent is not None:
        connections[f"to {sent.vehicle}"].send(sent.frame)
        recording.add(at_ns, sent.vehicle, sent.captured_ns, len(sent.frame), sent.ages_s)
    remaining_ns = sender.compute_remaining_ns(at_ns) or MAX_SLEEP_NS
    for name in wait(connections, at_ns + min(remaining_ns, MAX_SLEEP_NS), monotonic_ns):
        direction, _, number = name.partition(" ")
        receive = sender.receive_positions if direction == "from" else sender.receive_reports
        for data, received_ns in connections[name].receive():
            receive(int(number), data, received_ns)


def _find_problems(path: Path, fleet: Fleet) -> Iterator[str]:
    if not fleet.radio.has_budget:
        yield f"{path}: radio: is missing; give bytes_per_s or messages_per_s of the channel"
    if fleet.radio.signed:
        yield f"{path}: radio.signed: the sender does not sign; leave it out"
    for member in fleet.members:
        security = member.config.security
        if not member.cameras:
            yield f"{path}: {member.name}: cameras: is missing; give the source of its positions, as for --mocap"
        if not _find_target_url(member):
            url = member.config.daemon.mocap
            yield f"{path}: {member.name}: positions: is missing, and {url} is no UDP port; give the URL to send to"
        if security.key_file and MOCAP in security.require:
            yield f"{path}: {member.name}: security.require: the sender does not sign; leave out `mocap`"


def _find_target_url(member: Member) -> str:
    """Return the URL that a vehicle's positions are sent to; empty if it is not known."""
    if member.positions:
        return member.positions
    parts = urlsplit(member.config.daemon.mocap)
    if parts.scheme != "udpin" or not parts.port:
        return ""
    host = "127.0.0.1" if parts.hostname in (None, "0.0.0.0") else parts.hostname
    return f"udpout://{host}:{parts.port}"


@contextmanager
def _open_connections(fleet: Fleet) -> Iterator[dict[str, Connection]]:
    """Open the source of each vehicle, and the connection to its daemon."""
    with ExitStack() as stack:
        connections: dict[str, Connection] = {}
        for number, member in enumerate(fleet.members):
            rules = make_admission_rules(member.config.security)
            source = connections[f"from {number}"] = open_source(member.cameras, monotonic_ns, rules)
            stack.callback(source.close)
            target = connections[f"to {number}"] = open_connection(_find_target_url(member), monotonic_ns, rules)
            stack.callback(target.close)
        yield connections
