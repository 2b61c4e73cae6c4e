"""Bounds of reading a recording: work and memory in proportion to the bytes of its file.

A file of a stranger may claim any length, nest its records in each other so that each byte is looked at again and
again, or unpack to far more than a computer holds. Each claim is compared with what is left before any work begins.
"""

from __future__ import annotations

from pathlib import Path

from uavctl.errors import RecordingError

# Times that a byte may be looked at: a whole chunk is checked once in its place; after damage once more, when it is
# found. Two more are left for records in which a recording lies as an attachment.
MAX_LOOKS = 4
# Bytes that a byte may unpack to, on average over the file. LZ4 packs no closer than that whatever it is given; flights
# of ours come to 4.
MAX_RATIO = 255
# Bytes that a file may unpack to, however short it is: pictures that stand still pack to a ten-thousandth, and ten
# minutes of 30 a second are as much. A computer passes over them in some seconds.
FREE_BYTES = 2**34
MAX_CHUNK_BYTES = 2**28  # of one chunk, unpacked: all of it is in memory; recorders begin a new one at a few million
# Bytes of a file for each record in its chunks: number and time of a message change, so that it packs to no less.
MIN_RECORD_BYTES = 2
FREE_RECORDS = 2**16
# Bytes that may be kept in memory for a byte of the file. A frame changes in number and checksum: with its place in
# memory it packs to a thirtieth if it has the greatest length and its values stand still; twice that to be safe.
MAX_KEPT_RATIO = 64
FREE_KEPT_BYTES = 2**25  # may be kept, however short the file is: definitions of topics pack well, too
# Of a file that is read as a whole. A fast link brings a megabyte a second, which makes 3.6 GB in an hour.
MAX_WHOLE_BYTES = 2**32


class ExcessError(Exception):
    """A record asks for more than the rest of the budget; names it."""


class ReadBudget:
    """Rest of the budget for reading one file once.

    Args:
        file_bytes: Size of the file.
    """

    def __init__(self, file_bytes: int) -> None:
        self.offset = 0  # of the record that is being read, for an error
        self._looks_left_bytes = MAX_LOOKS * file_bytes
        self._unpacked_left_bytes = FREE_BYTES + MAX_RATIO * file_bytes
        self._kept_left_bytes = FREE_KEPT_BYTES + MAX_KEPT_RATIO * file_bytes
        self._records_left = FREE_RECORDS + file_bytes // MIN_RECORD_BYTES

    def look(self, length: int) -> None:
        """Take the bytes of a record that is about to be looked at.

        Raises:
            ExcessError: They were looked at too often.
        """
        if length > self._looks_left_bytes:
            raise ExcessError("overlaps others, as in no recording")
        self._looks_left_bytes -= length

    def unpack(self, length: int) -> None:
        """Take the bytes that are about to be unpacked.

        Raises:
            ExcessError: They are too many, in one chunk or in the file.
        """
        if length > MAX_CHUNK_BYTES:
            raise ExcessError(f"claims {length} bytes, more than {MAX_CHUNK_BYTES}, the most that is read at once")
        if length > self._unpacked_left_bytes:
            raise ExcessError(f"makes the file unpack to more than {MAX_RATIO} times its size, as no recording does")
        self._unpacked_left_bytes -= length

    def take_record(self) -> None:
        """Take a record in a chunk.

        Raises:
            ExcessError: There were too many.
        """
        if self._records_left <= 0:
            raise ExcessError(f"brings more records than one for every {MIN_RECORD_BYTES} bytes of the file")
        self._records_left -= 1

    def keep(self, length: int) -> None:
        """Take the bytes that are about to be kept in memory.

        Raises:
            ExcessError: They are too many.
        """
        if length > self._kept_left_bytes:
            raise ExcessError(f"makes the bytes in memory more than {MAX_KEPT_RATIO} times as long as the file")
        self._kept_left_bytes -= length


def read_whole(path: Path, max_bytes: int = MAX_WHOLE_BYTES) -> bytearray:
    """Return the bytes of a file.

    Raises:
        RecordingError: It cannot be read, is no file (a pipe would be waited for, a device has no end), or is too long.
    """
    try:
        size = path.stat().st_size
        if not path.is_file() and not path.is_dir():
            raise RecordingError(f"{path}: is a pipe or a device; give a file")
        if size > max_bytes:
            raise RecordingError(f"{path}: has {size} bytes, more than {max_bytes}; give a shorter one, or a part")
        with path.open("rb") as file:
            data = bytearray(size)
            return data[: file.readinto(data)]
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}") from error
