"""Standard error written by a thread: text arrives in order; a reader that is slow or gone holds up nobody."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from patience import wait_until

from uavctl.cli.error_stream import MAX_WAITING_BYTES, BackgroundStream


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        try:
            os.close(end)
        except OSError:
            continue


def test_text_arrives_in_order_with_escapes_for_what_the_encoding_lacks(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    stream = BackgroundStream(writer, "ascii")
    for number in range(100):
        print(f"{number} °", file=stream)
    stream.finish()
    os.close(writer)
    assert os.read(reader, 65536).decode() == "".join(f"{number} \\xb0\n" for number in range(100))


@pytest.mark.fault(89)
def test_text_that_nobody_reads_is_kept_up_to_a_bound_and_the_end_does_not_wait_for_it(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    stream = BackgroundStream(writer, "utf-8")
    line = "x" * 1023 + "\n"
    for _ in range(3 * MAX_WAITING_BYTES // 1024):
        stream.write(line)
    stream.finish()
    os.set_blocking(reader, False)
    read = 0

    def read_all() -> bool:
        nonlocal read
        try:
            read += len(os.read(reader, 65536))
        except BlockingIOError:
            return stream.waiting_bytes == 0
        return False

    wait_until(read_all, "all that was kept is read")
    assert MAX_WAITING_BYTES <= read < 2 * MAX_WAITING_BYTES


@pytest.mark.fault(89)
def test_a_reader_that_is_gone_raises_nothing(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    stream = BackgroundStream(writer, "utf-8")
    os.close(reader)
    stream.write("lost\n")
    wait_until(lambda: stream.waiting_bytes == 0, "the failed write is seen")
    stream.write("lost, too\n")
    assert stream.waiting_bytes == 0
    stream.finish()
