"""MAVLink FTP as the autopilots answer it: an ArduPilot has one file, its packed parameters; a PX4 here has none.

Clients ask for that file first, and for the list of parameters only when it is refused; so a refusal has to come at
once. The numbers are those of MAVLink's file transfer protocol; the rules for sizes, sessions and padding ArduPilot's.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any
from urllib.parse import parse_qsl

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.autopilot.parameters import Parameters, ParameterType
from sim.autopilot.telemetry import Message

PARAMETER_FILE = "@PARAM/param.pck"
HEADER = struct.Struct("<HBBBBBxI")  # sequence, session, opcode, size, requested opcode, burst complete, offset
MAX_DATA_BYTES = 239
MAX_SESSIONS = 4
SESSION_TIMEOUT_NS = 3_000_000_000  # a session without requests for this time may be replaced
# ArduPilot's estimate of a packed parameter; the size that it reports on opening follows from it [bytes]
BYTES_PER_PARAMETER = 12


class FileOperation(IntEnum):
    """Opcode of a request or an answer."""

    NONE = 0
    TERMINATE = 1
    RESET = 2
    LIST = 3
    OPEN = 4
    READ = 5
    CREATE = 6
    WRITE = 7
    REMOVE = 8
    MAKE_DIRECTORY = 9
    REMOVE_DIRECTORY = 10
    OPEN_TO_WRITE = 11
    TRUNCATE = 12
    RENAME = 13
    CHECKSUM = 14
    BURST = 15
    ACK = 128
    NAK = 129


class FileRefusal(IntEnum):
    """Reason in a NAK."""

    FAILED = 1
    ERRNO = 2
    BAD_SIZE = 3
    NO_SESSION = 4
    NONE_FREE = 5
    END = 6
    UNKNOWN = 7
    PROTECTED = 9
    NOT_FOUND = 10


WRITES = frozenset(
    {
        FileOperation.CREATE,
        FileOperation.WRITE,
        FileOperation.REMOVE,
        FileOperation.MAKE_DIRECTORY,
        FileOperation.REMOVE_DIRECTORY,
        FileOperation.OPEN_TO_WRITE,
        FileOperation.TRUNCATE,
        FileOperation.RENAME,
    }
)


class RefusedError(Exception):
    """A request that is answered with a NAK."""

    def __init__(self, reason: FileRefusal, number: int = 0) -> None:
        super().__init__(reason.name)
        self.data = bytes((reason, number)) if reason is FileRefusal.ERRNO else bytes((reason,))


@dataclass
class OpenFile:
    """A parameter file that a client reads; its padding depends on the size of the first read."""

    parameters: Parameters
    start: int
    count: int
    defaults: bool
    used_ns: int
    size: int = 0  # of its reads [bytes], 0 before the first
    content: bytes = b""

    def read(self, offset: int, size: int) -> bytes:
        """Return bytes from an offset on.

        Raises:
            RefusedError: another size than that of the first read, or nothing is left.
        """
        if not self.size:
            self.size = size
            self.content = pack_parameters(
                self.parameters, size, start=self.start, count=self.count, defaults=self.defaults
            )
        if size != self.size:
            raise RefusedError(FileRefusal.ERRNO, errno.EINVAL)
        if offset >= len(self.content):
            raise RefusedError(FileRefusal.END)
        return self.content[offset : offset + size]


@dataclass(frozen=True)
class FileRequest:
    """A request and its sender."""

    sender: tuple[int, int]  # system and component id
    sequence: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes

    @property
    def path(self) -> str:
        """Path that the data name.

        Raises:
            RefusedError: there is none.
        """
        path = self.data.rstrip(b"\0")
        if not path or b"\0" in path:
            raise RefusedError(FileRefusal.BAD_SIZE)
        return path.decode(errors="replace")


class Files:
    """The files of one vehicle."""

    def __init__(self, parameters: Parameters, *, has_parameter_file: bool) -> None:
        self._parameters, self._has_parameter_file = parameters, has_parameter_file
        self._open: dict[tuple[int, int, int], OpenFile] = {}
        self._last: tuple[FileRequest | None, tuple[Message, ...]] = None, ()

    def answer(self, msg: Any, at_ns: int) -> tuple[Message, ...]:
        """Take a FILE_TRANSFER_PROTOCOL message; return the answers. A repeated request gets the same answers."""
        payload = bytes(msg.payload)
        sequence, session, opcode, size, _, _, offset = HEADER.unpack_from(payload)
        if opcode in (FileOperation.ACK, FileOperation.NAK):
            return ()
        sender = msg.get_srcSystem(), msg.get_srcComponent()
        data = payload[HEADER.size : HEADER.size + size]
        request = FileRequest(sender, sequence, session, opcode, size, offset, data)
        if request == self._last[0]:
            return self._last[1]
        answers = tuple(
            _make_message(request, (sequence + 1 + number) % 2**16, *answer)
            for number, answer in enumerate(self._generate_answers(request, at_ns))
        )
        self._last = request, answers
        return answers

    def _generate_answers(self, request: FileRequest, at_ns: int) -> Iterator[tuple[FileOperation, int, bytes, bool]]:
        """Yield opcode, offset, data, and whether it ends a burst, of each answer."""
        key = *request.sender, request.session
        offset = request.offset
        try:
            if request.size > MAX_DATA_BYTES:
                raise RefusedError(FileRefusal.BAD_SIZE)
            if request.opcode != FileOperation.BURST:
                yield FileOperation.ACK, offset, self._execute(request, key, at_ns), False
                return
            file, size = self._get_file(key, at_ns), request.size or MAX_DATA_BYTES
            while True:
                data = file.read(offset, size)
                yield FileOperation.ACK, offset, data, False
                offset += len(data)
        except RefusedError as refused:
            yield FileOperation.NAK, offset, refused.data, request.opcode == FileOperation.BURST

    def _execute(self, request: FileRequest, key: tuple[int, int, int], at_ns: int) -> bytes:
        match request.opcode:
            case FileOperation.NONE:
                return b""
            case FileOperation.RESET:
                self._open = {open_key: file for open_key, file in self._open.items() if open_key[:2] != request.sender}
                return b""
            case FileOperation.TERMINATE:
                if self._open.pop(key, None) is None and not self._has_parameter_file:
                    raise RefusedError(FileRefusal.NO_SESSION)  # ArduPilot closes what is not open, too
                return b""
            case FileOperation.LIST:
                raise RefusedError(FileRefusal.END if request.path == "/" else FileRefusal.NOT_FOUND)
            case FileOperation.OPEN:
                return self._open_parameter_file(request, key, at_ns)
            case FileOperation.READ:
                return self._get_file(key, at_ns).read(request.offset, request.size)
            case FileOperation.CHECKSUM:
                raise RefusedError(FileRefusal.NOT_FOUND)
            case opcode if opcode in WRITES:
                raise RefusedError(FileRefusal.PROTECTED)
            case _:
                raise RefusedError(FileRefusal.UNKNOWN)

    def _get_file(self, key: tuple[int, int, int], at_ns: int) -> OpenFile:
        file = self._open.get(key)
        if file is None:
            raise RefusedError(FileRefusal.NOT_FOUND if self._has_parameter_file else FileRefusal.NO_SESSION)
        file.used_ns = at_ns
        return file

    def _open_parameter_file(self, request: FileRequest, key: tuple[int, int, int], at_ns: int) -> bytes:
        name, _, query = request.path.partition("?")
        if not self._has_parameter_file or name != PARAMETER_FILE:
            raise RefusedError(FileRefusal.NOT_FOUND)
        query_values = dict(parse_qsl(query))
        start, count, defaults = (
            _parse_number(query_values.get(field, "0")) for field in ("start", "count", "withdefaults")
        )
        if start >= len(self._parameters.names) or defaults > 1:
            raise RefusedError(FileRefusal.ERRNO, errno.EINVAL)
        self._open = {name: file for name, file in self._open.items() if at_ns - file.used_ns < SESSION_TIMEOUT_NS}
        if key in self._open:
            raise RefusedError(FileRefusal.FAILED)
        if len(self._open) == MAX_SESSIONS:
            raise RefusedError(FileRefusal.NONE_FREE)
        self._open[key] = OpenFile(self._parameters, start, count, bool(defaults), at_ns)
        return struct.pack("<I", BYTES_PER_PARAMETER * len(self._parameters.names))


def _parse_number(text: str) -> int:
    if not (text.isascii() and text.isdigit() and int(text) < 2**16):
        raise RefusedError(FileRefusal.ERRNO, errno.EINVAL)
    return int(text)


def _make_message(
    request: FileRequest, sequence: int, opcode: FileOperation, offset: int, data: bytes, complete: bool
) -> Message:
    header = HEADER.pack(sequence, request.session, opcode, len(data), request.opcode, complete, offset)
    return mavlink.MAVLink_file_transfer_protocol_message(0, *request.sender, list((header + data).ljust(251, b"\0")))


PLAIN, WITH_DEFAULTS = 0x671B, 0x671C
PACKED_TYPES = {
    ParameterType.INT8: (1, "b"),
    ParameterType.INT16: (2, "h"),
    ParameterType.INT32: (3, "i"),
    ParameterType.REAL32: (4, "f"),
}


def pack_parameters(parameters: Parameters, read_size: int, *, start: int, count: int, defaults: bool) -> bytes:
    """Pack parameters as ArduPilot does; zeros keep a value from lying across two reads of `read_size` bytes.

    Header: magic, count, total count. Each parameter: type, number of letters in common with the name before, number of
    the other letters, these letters, value, and the default where it differs.
    """
    names = parameters.names[start:]
    names = names[:count] if count else names
    packed = bytearray(struct.pack("<HHH", WITH_DEFAULTS if defaults else PLAIN, len(names), len(parameters.names)))
    previous_name = ""
    for name in names:
        kind, form = PACKED_TYPES[parameters.get_type(name)]
        values = [parameters[name]]
        if defaults and parameters.get_default(name) != parameters[name]:
            values.append(parameters.get_default(name))
        data = b"".join(struct.pack(f"<{form}", value if form == "f" else int(value)) for value in values)
        common_letters = next(i for i, letter in enumerate(name) if previous_name[i : i + 1] != letter)
        letters, size = name[common_letters:].encode(), len(data) // len(values)
        overlap = (len(packed) + 2 + len(letters) + len(data)) % read_size
        if 0 < overlap < size:
            packed += bytes(size - overlap)
        packed += bytes((kind | (len(values) - 1) << 4, common_letters | (len(letters) - 1) << 4)) + letters + data
        previous_name = name
    return bytes(packed)
