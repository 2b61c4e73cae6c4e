"""Recording of a sender: one MCAP file with a JSON message for each position sent; its writer and its reader.

A thread of its own writes, so that a disk that hangs delays no position.
"""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import Full, Queue
from types import TracebackType
from typing import BinaryIO, Self

import msgspec
import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer
from numpy.typing import NDArray
from zstandard import ZstdError, get_frame_parameters

from logs.recording.budget import MAX_CHUNK_BYTES
from uavctl.errors import RecordingError

TOPIC = "/uavctl/sender"
_SCHEMA = {
    "title": "uavctl.SentPosition",
    "type": "object",
    "properties": {
        "vehicle": {"type": "string"},
        "captured_ns": {"type": "integer"},  # monotonic time of the capture
        "bytes": {"type": "integer"},
        # believed age of each vehicle's newest position before this message [s]
        "ages_s": {"type": "object", "additionalProperties": {"type": "number"}},
    },
}
CHUNK_BYTES = 65_536  # a killed process loses the messages of the last chunk, a few seconds
MAX_WAITING = 10_000  # messages that wait for the disk: more than a minute on a radio of 57,600 baud
CLOSE_S = 5.0  # for the messages that wait at the end
_HANGS = "the disk hangs"
_Item = tuple[int, int, int, int, tuple[float, ...]]


class SenderRecording:
    """Writes what a sender did; `log_time` is UTC.

    Attributes:
        failure: Why nothing is written any more; empty as long as it is.

    Args:
        names: Names of the vehicles.
        zero_utc_ns: UTC of time 0 of the monotonic clock [ns since 1970].

    Raises:
        RecordingError: There is such a file, or it cannot be made.
    """

    def __init__(self, path: Path, names: list[str], zero_utc_ns: int) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("xb")
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written ({error.strerror}); choose another file") from error
        self._names, self._zero_utc_ns = names, zero_utc_ns
        self.failure = ""
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="", library="uavctl")
        schema = self._writer.register_schema("uavctl.SentPosition", "jsonschema", json.dumps(_SCHEMA).encode())
        self._channel = self._writer.register_channel(TOPIC, "json", schema)
        self._waiting: Queue[_Item | None] = Queue(MAX_WAITING)  # None is the end
        self._thread = threading.Thread(target=self._write, name="recording", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with suppress(Full):
            self._waiting.put(None, timeout=CLOSE_S)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            self.failure = self.failure or _HANGS

    def add(self, at_ns: int, vehicle: int, captured_ns: int, length: int, ages_s: tuple[float, ...]) -> None:
        """Add a position that was sent at `at_ns`, monotonic time; a write error ends the recording alone."""
        try:
            self._waiting.put_nowait((at_ns, vehicle, captured_ns, length, ages_s))
        except Full:
            self.failure = self.failure or _HANGS

    def _write(self) -> None:
        """Write what comes, up to the end; nothing more after a failure."""
        while (item := self._waiting.get()) is not None:
            self._attempt(partial(self._write_message, *item))
        self._attempt(self._writer.finish)
        with suppress(OSError):
            self._file.close()

    def _attempt(self, write: Callable[[], object]) -> None:
        if self.failure:
            return
        try:
            write()
        except OSError as error:
            self.failure = error.strerror or "write error"

    def _write_message(
        self, at_ns: int, vehicle: int, captured_ns: int, length: int, ages_s: tuple[float, ...]
    ) -> None:
        message = {
            "vehicle": self._names[vehicle],
            "captured_ns": captured_ns,
            "bytes": length,
            "ages_s": dict(zip(self._names, ages_s, strict=True)),
        }
        time_ns = self._zero_utc_ns + at_ns
        self._writer.add_message(self._channel, time_ns, json.dumps(message).encode(), time_ns)


class _SentPosition(msgspec.Struct, frozen=True):
    """A message of the recording, without what the reader does not use."""

    vehicle: str
    ages_s: dict[str, float]


@dataclass(frozen=True, eq=False)
class ServedPositions:
    """Order in which a sender served its vehicles."""

    names: tuple[str, ...]  # of all its vehicles, also of those that it never served
    at_ns: NDArray[np.int64]  # (n,) UTC, ascending
    vehicles: NDArray[np.int64]  # (n,) index of the vehicle
    fault: str = ""  # why the recording is not whole; what came before is good

    def get_times_ns(self, name: str) -> NDArray[np.int64]:
        """Return the times of the messages to a vehicle."""
        return np.asarray(self.at_ns[self.vehicles == self.names.index(name)], dtype=np.int64)


_DECODER = msgspec.json.Decoder(_SentPosition)
_ERRORS = (McapError, ZstdError, msgspec.MsgspecError, ValueError, OverflowError)


def read_sender(path: Path) -> ServedPositions:
    """Read the recording of a sender up to its end, or to its first damage.

    Raises:
        RecordingError: It cannot be read, or holds no position before the damage.
    """
    times_ns: list[int] = []
    vehicles: list[int] = []
    numbers: dict[str, int] = {}
    fault = ""
    try:
        with path.open("rb") as file:
            for at_ns, position in _iterate_positions(file):
                for name in (*position.ages_s, position.vehicle):
                    numbers.setdefault(name, len(numbers))
                times_ns.append(at_ns)
                vehicles.append(numbers[position.vehicle])
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
    except (EndOfFile, struct.error):
        fault = f"{path}: the recording is torn, or still written"
    except _ERRORS as error:
        fault = f"{path}: the recording is damaged ({error or type(error).__name__})"
    if not times_ns:
        raise RecordingError(fault or f"{path}: the sender sent nothing")
    order = np.argsort(np.array(times_ns, dtype=np.int64), kind="stable")
    return ServedPositions(
        tuple(numbers), np.array(times_ns, dtype=np.int64)[order], np.array(vehicles, dtype=np.int64)[order], fault
    )


def _iterate_positions(file: BinaryIO) -> Iterator[tuple[int, _SentPosition]]:
    """Yield the UTC [ns] and content of each message on the topic."""
    channels: set[int] = set()
    for record in StreamReader(file, emit_chunks=True, record_size_limit=MAX_CHUNK_BYTES).records:
        if not isinstance(record, Chunk):
            continue
        if record.compression and get_frame_parameters(record.data).content_size != record.uncompressed_size:
            raise ValueError("a chunk unpacks to another size than it claims")
        if record.uncompressed_size > MAX_CHUNK_BYTES:
            raise ValueError("a chunk is too large")
        for item in breakup_chunk(record, validate_crc=True):
            if isinstance(item, Channel) and item.topic == TOPIC:
                channels.add(item.id)
            elif isinstance(item, Message) and item.channel_id in channels:
                yield item.log_time, _DECODER.decode(item.data)
