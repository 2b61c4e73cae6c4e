"""Command `uavctl cameras`: send the positions of all vehicles of a fleet over one channel with a budget."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

from cyclopts import Parameter

from logs.recording.ends import make_recording_path
from logs.recording.recorder import Recorder
from logs.recording.sender import SenderRecording
from uavctl.cli.common import SPAN_S, Common, QuietJson
from uavctl.cli.fleet_file import Fleet, Member, read_fleet
from uavctl.cli.output import make_table, print_message
from uavctl.cli.signals import stop_on_signals
from uavctl.clock import monotonic_ns, read_zero_utc_ns
from uavctl.config.connections import CAMERA_SYSTEM_ID
from uavctl.config.types import Config
from uavctl.errors import ConfigError, ConnectionSpecError
from uavctl.io.admission import AdmissionRules
from uavctl.io.base import Connection
from uavctl.io.shared_sources import SharedSource, find_shared_sources, split_source_url
from uavctl.io.signed_connection import make_admission_rules, sign_sender
from uavctl.io.sources import open_bodies
from uavctl.io.transport import open_connection, wait
from uavctl.mavlink.connection import MOCAP
from uavctl.wiring.sender import PositionMessage, PositionSender

SENT_MESSAGE = "VISION_POSITION_ESTIMATE"
REPORT_NS = 200_000_000  # between two looks at what people should know
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
    names = [member.name for member in fleet.members]
    sources = find_shared_sources([member.cameras for member in fleet.members])
    configs, start_ns = [member.config for member in fleet.members], monotonic_ns()
    sender = PositionSender(configs, sources, fleet.radio, spacing_m=fleet.spacing_m, start_ns=start_ns)
    path = make_recording_path(out, file.stem).with_name("sender.mcap")
    with (
        _open_connections(file, fleet, sources) as (source_links, target_links),
        SenderRecording(
            Recorder(path),
            names,
            sender.parameters,
            spacing_m=fleet.spacing_m,
            start_ns=start_ns,
            zero_utc_ns=read_zero_utc_ns(),
        ) as recording,
        stop_on_signals() as stopped,
    ):
        sender.watch = recording
        print_message(f"sending the positions of {len(names)} vehicles, recording to {path}; Ctrl-C ends it")
        run = _Run(fleet, sender, recording, source_links, target_links)
        end_ns = None if duration is None else monotonic_ns() + round(duration * 1e9)
        while not stopped() and (end_ns is None or monotonic_ns() < end_ns):
            run.run_once()
            run.report()
    if recording.failure:
        print_message(f"{path}: the recording lacks positions ({recording.failure}); check the disk")
    if sender.refused:
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(sender.refused.items()))
        print_message(f"not used: {reasons}")
    counts = {name: sender.sent[number] for number, name in enumerate(names)}
    document = {"out": str(path), "sent": counts, "refused": dict(sender.refused)}
    rows = [[name, str(count)] for name, count in counts.items()]
    Common(json=json).show("cameras", document, lambda: make_table("positions sent", ("vehicle", "number"), rows))
    return 0 if all(counts.values()) and not recording.failure else 1


class _Run:
    """A sender at work: connections, recording, and reports for people."""

    def __init__(
        self,
        fleet: Fleet,
        sender: PositionSender,
        recording: SenderRecording,
        sources: list[Connection],
        targets: list[Connection],
    ) -> None:
        self._fleet, self._sender, self._recording = fleet, sender, recording
        self._sources, self._targets = sources, targets
        self._connections = {f"from {number}": source for number, source in enumerate(sources)}
        self._connections |= {f"to {number}": target for number, target in enumerate(targets)}
        self._reported: set[str] = set()
        self._silent: set[int] = set()
        self._reported_ns, self._has_failed = 0, False

    def run_once(self) -> None:
        """Send what is due, then wait for data or for the channel."""
        at_ns = monotonic_ns()
        sent = self._sender.send_next(at_ns)
        if sent is not None:
            self._targets[sent.vehicle].send(sent.frame)
        if isinstance(sent, PositionMessage):
            self._recording.add(at_ns, sent.vehicle, sent.captured_ns, sent.wire_bytes, sent.ages_s)
        for number, source in enumerate(self._sources):
            request = self._sender.make_time_request(number, at_ns)
            if request is not None:
                source.send(request)
        remaining_ns = self._sender.compute_remaining_ns(at_ns) or MAX_SLEEP_NS
        for name in wait(self._connections, at_ns + min(remaining_ns, MAX_SLEEP_NS), monotonic_ns):
            direction, _, number_text = name.partition(" ")
            number, connection = int(number_text), self._connections[name]
            for index, (data, received_ns) in enumerate(connection.receive()):
                if direction == "to":
                    self._sender.receive_reports(number, data, received_ns)
                elif self._sender.receive_positions(number, data, received_ns):
                    connection.trust_sender(index)

    def report(self) -> None:
        """Tell people of vehicles without positions, closed connections, ended processes and a full disk, once each."""
        at_ns, members = monotonic_ns(), self._fleet.members
        if at_ns - self._reported_ns < REPORT_NS:
            return
        self._reported_ns = at_ns
        silent = self._sender.find_silent(at_ns)
        for number in silent - self._silent:
            print_message(f"{members[number].name}: no position for 1 s from {members[number].cameras}")
        for number in self._silent - silent:
            print_message(f"{members[number].name}: positions again")
        self._silent = silent
        for name, connection in self._connections.items():
            side = "source" if name.startswith("from") else "link"
            if connection.closed:
                self._report_once(f"{side} {connection.url} is closed")
            for reason in connection.refused:
                if ": " in reason:  # with a cause
                    self._report_once(f"{side} {connection.url}: {reason}")
        failure = self._recording.failure
        if failure and not self._has_failed:
            print_message(f"the recording lacks positions ({failure}); see to the disk")
        self._has_failed |= bool(failure)

    def _report_once(self, text: str) -> None:
        if text not in self._reported:
            self._reported.add(text)
            print_message(text)


def _find_problems(path: Path, fleet: Fleet) -> Iterator[str]:
    if not fleet.radio.has_budget:
        yield f"{path}: radio: is missing; give bytes_per_s or messages_per_s of the channel"
    for member in fleet.members:
        where = f"{path}: {member.name}"
        if not member.cameras:
            yield f"{where}: cameras: is missing; give the source of its positions, as for --mocap"
        if not _find_target_url(member):
            url = member.config.daemon.mocap
            yield f"{where}: positions: is missing, and {url} is no UDP port; give the URL to send to"
        yield from (f"{where}: {text}" for text in _find_daemon_problems(member.config, signed=fleet.radio.signed))
    yield from (f"{path}: {text}" for text in _find_shared_problems(fleet))


def _find_daemon_problems(config: Config, *, signed: bool) -> Iterator[str]:
    """Yield why a vehicle's daemon would not take the sender's messages."""
    security, source = config.security, config.source
    if signed and not security.key_file:
        yield "security.key_file: is missing, and radio.signed needs it; give the vehicle's, or leave out radio.signed"
    elif signed and MOCAP not in security.require:
        yield "security.require: lacks `mocap`, so signatures are not compared; add it, or leave out radio.signed"
    elif security.key_file and MOCAP in security.require and not signed:
        yield "security.require: `mocap` must be signed; write signed = true in [radio], or leave out `mocap`"
    if SENT_MESSAGE not in source.messages:
        yield f"source.messages: leaves out {SENT_MESSAGE}, which the sender sends; add it"
    if source.system_id not in (0, CAMERA_SYSTEM_ID):
        yield (
            f"source.system_id: {source.system_id} is another system than the sender, {CAMERA_SYSTEM_ID}; give "
            f"{CAMERA_SYSTEM_ID} or 0, and the cameras' system id behind the port in `cameras`"
        )


def _find_shared_problems(fleet: Fleet) -> Iterator[str]:
    """Yield what is wrong with the sources, and where two vehicles would have the same body or receiver."""
    name_by_body: dict[tuple[object, str], str] = {}
    name_by_connection: dict[object, str] = {}  # first vehicle that names a body
    name_by_target: dict[str, str] = {}
    for member in fleet.members:
        target = _find_target_url(member)
        other = name_by_target.setdefault(target, member.name)
        if target and other != member.name:
            yield f"{member.name}: positions: {target} is that of {other} too; give each vehicle a URL of its own"
        if not member.cameras:
            continue
        try:
            connection, body = split_source_url(member.cameras)
        except ConnectionSpecError as error:
            yield f"{member.name}: cameras: {error}"
            continue
        other = name_by_body.setdefault((connection, body), member.name)
        if other != member.name:
            remedy = "another body" if body else "the body behind it, as /1 for MAVLink system 1,"
            yield f"{member.name}: cameras: {member.cameras} is that of {other} too; give {remedy} or another source"
        elif body and (connection, "") in name_by_body:
            yield f"{member.name}: cameras: {name_by_body[connection, '']} takes all of {connection}; name its body too"
        elif not body and connection in name_by_connection:
            other = name_by_connection[connection]
            yield f"{member.name}: cameras: takes all of {connection}, where {other} has a body; name its body"
        if body:
            name_by_connection.setdefault(connection, member.name)


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
def _open_connections(
    path: Path, fleet: Fleet, sources: tuple[SharedSource, ...]
) -> Iterator[tuple[list[Connection], list[Connection]]]:
    """Open the sources, and the connection to each vehicle's daemon."""
    with ExitStack() as stack:
        source_links: list[Connection] = []
        for source in sources:
            first = fleet.members[min(source.addresses)]
            rules = make_admission_rules(first.config.security)
            with _name_key(f"{path}: {first.name}: cameras"):
                source_links.append(_open_source(source, rules))
            stack.callback(source_links[-1].close)
        target_links: list[Connection] = []
        for member in fleet.members:
            security = member.config.security
            with _name_key(f"{path}: {member.name}: positions"):
                target = open_connection(_find_target_url(member), monotonic_ns, make_admission_rules(security))
            stack.callback(target.close)
            target_links.append(stack.enter_context(sign_sender(target, security)) if fleet.radio.signed else target)
        yield source_links, target_links


def _open_source(source: SharedSource, rules: AdmissionRules) -> Connection:
    count = len(source.addresses)
    # The rules are those for one vehicle.
    rules = replace(
        rules,
        max_per_s=count * rules.max_per_s,
        max_frames_per_s=count * rules.max_frames_per_s,
        max_bytes_per_s=count * rules.max_bytes_per_s,
    )
    if source.is_camera:
        return open_bodies(source.urls, monotonic_ns, rules)
    return open_connection(source.url, monotonic_ns, rules)


@contextmanager
def _name_key(key: str) -> Iterator[None]:
    """Name the file and key of a URL that cannot be opened."""
    try:
        yield
    except ConnectionSpecError as error:
        raise ConnectionSpecError(f"{key}: {error}") from error
