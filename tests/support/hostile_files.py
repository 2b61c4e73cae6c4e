"""Files that ask for far more work or memory than they have bytes, of about a given size."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO

import lz4.frame  # type: ignore[import-untyped]
from mcap.opcode import Opcode
from zstandard import ZstdCompressor

MAGIC = b"\x89MCAP0\r\n"
_CHUNK = struct.Struct("<BQQQQII")  # opcode, length, first and last time, size, checksum, length of the compression
_NO_RECORD = b"\0" * 9  # opcode 0, which means nothing, with no content
_UNPACKED_BYTES = 2**26


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(words: str | bytes) -> bytes:
    data = words.encode() if isinstance(words, str) else words
    return struct.pack("<I", len(data)) + data


def chunk(content: bytes, compression: str = "zstd", size: int | None = None) -> bytes:
    """A chunk with the right checksum; `size` is what it says that it unpacks to."""
    stored = {"zstd": ZstdCompressor().compress, "lz4": lz4.frame.compress, "": bytes}[compression](content)
    head = struct.pack("<QQQI", 0, 0, len(content) if size is None else size, zlib.crc32(content))
    return record(Opcode.CHUNK, head + text(compression) + struct.pack("<Q", len(stored)) + stored)


def schema(number: int, name: str, encoding: str, definition: str) -> bytes:
    return record(Opcode.SCHEMA, struct.pack("<H", number) + text(name) + text(encoding) + text(definition))


def channel(number: int, schema_number: int, topic: str, encoding: str) -> bytes:
    return record(Opcode.CHANNEL, struct.pack("<HH", number, schema_number) + text(topic) + text(encoding) + text(""))


def message(number: int, data: bytes, at_ns: int = 1) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, at_ns, at_ns) + data)


def make_overlapping_chunks(size: int) -> bytes:
    """Heads of chunks, each of which goes on to the end of the file."""
    head_bytes = _CHUNK.size + 8
    file = BytesIO()
    file.write(MAGIC)
    for left in range(size, head_bytes, -head_bytes):
        stored = left - head_bytes
        file.write(_CHUNK.pack(Opcode.CHUNK, left - 9, 0, 0, stored, 1, 0) + struct.pack("<Q", stored))
    return file.getvalue().ljust(len(MAGIC) + size, b"\0")


def make_overlapping_attachments(size: int) -> bytes:
    """Attachments with a wrong checksum, each of which goes on to the end of the file, and a whole chunk in each."""
    inner = chunk(b"", "")
    head = struct.pack("<QQ", 0, 0) + text("") + text("")
    step = 9 + len(head) + 8 + len(inner)
    file = BytesIO()
    file.write(MAGIC)
    for left in range(size, step + 40, -step):
        data_bytes = left - 9 - len(head) - 8 - 4
        file.write(struct.pack("<BQ", Opcode.ATTACHMENT, left - 9) + head + struct.pack("<Q", data_bytes) + inner)
    return file.getvalue().ljust(len(MAGIC) + size, b"\1")


def make_bomb(size: int, compression: str, content: bytes = _NO_RECORD) -> bytes:
    """Chunks that each unpack to 64 MB of one record, with the right checksum."""
    packed = chunk(content * (_UNPACKED_BYTES // len(content)), compression)
    return MAGIC + packed * max(1, size // len(packed))


def make_huge_claims() -> dict[str, bytes]:
    """Files of less than 200 bytes that claim 2^60 bytes at some place."""
    huge = 2**60
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", huge) + b"\1\0\0"  # of Zstandard: its size, an empty block
    head = struct.pack("<QQQI", 0, 0, huge, 0)
    return {
        "record": MAGIC + struct.pack("<BQ", Opcode.CHUNK, huge) + bytes(100),
        "unpacked": MAGIC + chunk(b"", "zstd", huge),
        "frame": MAGIC + record(Opcode.CHUNK, head + text("zstd") + struct.pack("<Q", len(frame)) + frame),
        "stored": MAGIC + record(Opcode.CHUNK, head + text("") + struct.pack("<Q", huge) + bytes(100)),
        "attachment": MAGIC
        + record(Opcode.ATTACHMENT, bytes(16) + text("") + text("") + struct.pack("<Q", huge) + bytes(100)),
        "message": MAGIC + chunk(struct.pack("<BQHIQQ", Opcode.MESSAGE, huge, 1, 0, 0, 0), ""),
        "schema": MAGIC + chunk(struct.pack("<BQHI", Opcode.SCHEMA, huge, 1, 2**32 - 1), ""),
    }


MAVLINK_FIELDS = (
    "uint8 magic\nuint8 len\nuint8 seq\nuint8 sysid\nuint8 compid\nuint32 msgid\nuint16 checksum\nuint64[] payload64\n"
)
_BORDER = "\n" + "=" * 80 + "\n"


def make_nested_definition(length: int, depth: int) -> str:
    """A ROS definition of MAVLink with lists of lists of a type that has no bytes."""
    parts = [f"pkg/T0[{length}] nothing\n{MAVLINK_FIELDS}"]
    parts += [f"MSG: pkg/T{level}\npkg/T{level + 1}[{length}] inner" for level in range(depth)]
    return _BORDER.join([*parts, f"MSG: pkg/T{depth}\n"])


def make_ros_file(size: int, definition: str) -> bytes:
    """Messages of 64 bytes, wrapped by ROS."""
    one = message(1, bytes(64))
    head = schema(1, "pkg/Top", "ros1msg", definition) + channel(1, 1, "/m", "ros1")
    return MAGIC + head + one * (size // len(one))


def make_many_channels(size: int) -> bytes:
    """One long definition, and many channels of it."""
    head = schema(1, "pkg/Top", "ros1msg", MAVLINK_FIELDS + "uint8 more\n" * (size // 22))
    channels = b"".join(channel(number, 1, "", "ros1") for number in range(min(60_000, size // 60)))
    return MAGIC + head + channels


def make_redefined(size: int) -> bytes:
    """Half a file of topics, each with its schema, and half a file of one schema that changes again and again."""
    topics = [schema(number, "a", "x", "") + channel(number, number, "", "ros1") for number in range(1, size // 120)]
    changes = [schema(1, "a", "x", str(number)) for number in range(size // 60)]
    return MAGIC + b"".join(topics + changes)


def make_definitions(size: int, kind: str) -> bytes:
    """Long schemas, or names of channels, which pack to nearly nothing."""
    make = {"schema": lambda n: schema(n, "a", "x", "x" * 2**19), "channel": lambda n: channel(n, 0, "a" * 2**19, "x")}
    packed = b"".join(chunk(make[kind](2 * n) + make[kind](2 * n + 1)) for n in range(1, 60))
    return MAGIC + packed + record(Opcode.METADATA, bytes(size))


def make_wrapped(field: str, rest: bytes) -> bytes:
    """One message of MAVLink that ROS wraps, with a further field."""
    head = schema(1, "pkg/Top", "ros1msg", MAVLINK_FIELDS + field) + channel(1, 1, "/m", "ros1")
    return MAGIC + chunk(head + message(1, bytes(15) + rest))


def _ulog_message(kind: str, payload: bytes) -> bytes:
    return struct.pack("<Hc", len(payload), kind.encode()) + payload


_ULOG_HEAD = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1) + _ulog_message("B", bytes(40))


def make_nested_ulog(size: int, length: int) -> bytes:
    """Formats of lists of lists, and topics of the outermost."""
    formats = b"".join(_ulog_message("F", f"t{i}:t{i + 1}[{length}] a;".encode()) for i in range(4))
    formats += _ulog_message("F", f"t4:uint8_t[{length}] a;".encode())
    topic = _ulog_message("A", struct.pack("<BH", 0, 1) + b"t0")
    return _ULOG_HEAD + formats + topic * (size // len(topic))


def make_subscribing_ulog(size: int) -> bytes:
    """A format of many fields, and many topics of it."""
    fields = ";".join(f"uint8_t a{i}" for i in range(3000))
    topics = (_ulog_message("A", struct.pack("<BH", 0, number % 2**16) + b"t") for number in range(size // 7))
    return _ULOG_HEAD + _ulog_message("F", f"t:uint64_t timestamp;{fields}".encode()) + b"".join(topics)
