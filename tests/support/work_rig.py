"""Limits of work that are counted, never timed: bytes that a checksum runs over, calls and lines."""

from __future__ import annotations

import sys
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any
from unittest.mock import patch


class TooMuchWorkError(BaseException):
    """More work than the limit; no reader takes it for damage."""


@contextmanager
def limit_checksums(limit_bytes: int) -> Iterator[None]:
    """Fail once more bytes have gone through CRC-32; every chunk does so, packed and unpacked."""
    crc32, left_bytes = zlib.crc32, limit_bytes

    def count(data: bytes | memoryview, value: int = 0) -> int:
        nonlocal left_bytes
        left_bytes -= len(data)
        if left_bytes < 0:
            raise TooMuchWorkError(f"more than {limit_bytes} bytes looked at")
        return crc32(data, value)

    with patch("zlib.crc32", count):
        yield


@contextmanager
def limit_calls(limit: int) -> Iterator[None]:
    """Fail once more functions of Python have been called."""
    left, former = limit, sys.getprofile()

    def count(_frame: FrameType, event: str, _argument: object) -> None:
        nonlocal left
        left -= event == "call"
        if left < 0:
            sys.setprofile(former)
            raise TooMuchWorkError(f"more than {limit} calls")

    sys.setprofile(count)
    try:
        yield
    finally:
        sys.setprofile(former)


def count_lines(work: Callable[[], object]) -> int:
    """Lines of Python that run, once for each turn of a loop or comprehension."""
    lines, former = 0, sys.gettrace()

    def trace(_frame: FrameType, event: str, _argument: object) -> Any:
        nonlocal lines
        lines += event == "line"
        return trace

    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(former)
    return lines


@contextmanager
def limit_memory(limit_bytes: int) -> Iterator[None]:
    """Fail if the peak of the memory that Python allocates is higher."""
    tracemalloc.start()
    try:
        yield
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak_bytes <= limit_bytes
