"""Ends of a flight's recording: its path and header; how the flight ended, and missing records."""

from __future__ import annotations

import platform
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from logs.recording.disk import check_file_limit, check_free_space
from logs.recording.output_files import remove_empty_folders
from logs.recording.recorder import RecorderStatus
from logs.recording.topics import HEADER
from uavctl.account import report_failed_writes, report_lost_records, report_missing_files
from uavctl.clock import VIRTUAL_ZERO_UTC_NS
from uavctl.config.load import dump_config
from uavctl.config.types import LogConfig
from uavctl.records import TEXT_VERSION, Ending, Header, Sink
from uavctl.wiring.controller import Prepared, collect_versions, make_design_record, read_cpu_model


def make_recording_path(out: Path | None, name: str) -> Path:
    """Return the path of a new recording: in `out`, or in a folder of its own below `flights/`."""
    stamp = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
    folder = out if out is not None else Path("flights") / f"{stamp}-{name}"
    return folder / "flight.mcap"


@contextmanager
def create_recording(out: Path | None, name: str, log: LogConfig) -> Iterator[Path]:
    """Yield the path of a new recording, with room checked; folders made for it are removed if they stay empty.

    Raises:
        RecordingError: as `check_free_space` and `check_file_limit` do.
    """
    path = make_recording_path(out, name)
    with remove_empty_folders([path]):
        check_file_limit(log.segment_bytes)
        check_free_space(path, log.free_bytes)
        yield path


def put_header(
    recorder: Sink,
    prepared: Prepared,
    started_ns: int,
    zero_utc_ns: int | None = VIRTUAL_ZERO_UTC_NS,
    command: str | None = None,
    *,
    moved_inputs: bool = False,
) -> None:
    """Begin a recording with its header: everything needed to decide alike in a replay.

    Args:
        started_ns: when it begins, by the flight's clock.
        zero_utc_ns: UTC of time 0 of that clock [ns since 1970]; that of virtual time unless it is given.
        command: command that made it; None: the command line of this process.
        moved_inputs: whether the recording is of a what-if.
    """
    config, design = prepared.config, prepared.design
    header = Header(
        started_ns=started_ns,
        started_utc=datetime.now(UTC).isoformat(timespec="milliseconds"),
        seed=config.sim.seed,
        command=shlex.join(["uavctl", *sys.argv[1:]]) if command is None else command,
        config_toml=dump_config(config),
        design_id=design.design_id,
        design=make_design_record(design),
        versions=collect_versions(config.smpc.controller),
        cpu=read_cpu_model(),
        zero_utc_ns=zero_utc_ns,
        platform=platform.platform(),
        moved_inputs=moved_inputs,
        text_version=TEXT_VERSION,
    )
    recorder.put(HEADER, started_ns, header)


def describe_ending(ending: Ending, status: RecorderStatus) -> Ending:
    """Return how a flight ended, with the state of its recording."""
    reason = status.reason or status.refusal or "the disk was too slow"
    if missing_files := find_missing_files(status):
        return report_missing_files(ending, missing_files)
    if not status.ok:
        return report_lost_records(ending, max(count_missing_records(status), 1), reason)
    return report_failed_writes(ending, reason) if status.failures else ending


def find_missing_files(status: RecorderStatus) -> tuple[str, ...]:
    """Return the files of the recording that are no longer where they were made."""
    return tuple(name for name in status.segments if not Path(name).exists())


def count_missing_records(status: RecorderStatus) -> int:
    """Return the number of records that are not in the recording."""
    return status.dropped + status.refused + status.waiting
