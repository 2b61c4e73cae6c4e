"""Recording of a sender: one MCAP file with a JSON message for each position sent."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.writer import Writer

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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if not self.failure:
                self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
        except OSError as write_error:
            self.failure = write_error.strerror or "write error"

    def add(self, at_ns: int, vehicle: int, captured_ns: int, length: int, ages_s: tuple[float, ...]) -> None:
        """Add a position that was sent at `at_ns`, monotonic time; a write error ends the recording alone."""
        if self.failure:
            return
        message = {
            "vehicle": self._names[vehicle],
            "captured_ns": captured_ns,
            "bytes": length,
            "ages_s": dict(zip(self._names, ages_s, strict=True)),
        }
        time_ns = self._zero_utc_ns + at_ns
        try:
            self._writer.add_message(self._channel, time_ns, json.dumps(message).encode(), time_ns)
        except OSError as error:
            self.failure = error.strerror or "write error"
