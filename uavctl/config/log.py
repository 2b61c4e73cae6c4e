"""`[log]`: the recording and the room that it needs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from msgspec import Meta

from uavctl.config.problem import Problem
from uavctl.config.section import Section


class LogConfig(Section, frozen=True, kw_only=True):
    """Recording."""

    chunk_bytes: Annotated[int, Meta(ge=1024, le=16384, description="largest chunk of the recording [bytes]")] = 16384
    segment_bytes: Annotated[
        int,
        Meta(ge=100_000, le=10**12, description="after about so much the recording goes on in another file [bytes]"),
    ] = 50_000_000
    queue: Annotated[
        int, Meta(ge=16, le=100_000, description="records that may wait for the disk; more are dropped and counted")
    ] = 8192
    free_bytes: Annotated[
        int, Meta(ge=0, le=10**15, description="a flight is refused with less free space than this [bytes]")
    ] = 50_000_000
    low_bytes: Annotated[
        int, Meta(ge=0, le=10**15, description="less free space than this in flight is a warning [bytes]")
    ] = 30_000_000
    stop_bytes: Annotated[
        int,
        Meta(
            ge=0,
            le=10**15,
            description="recording rests with less free space than this, until there is low_bytes [bytes]",
        ),
    ] = 10_000_000


def check(log: LogConfig) -> Iterator[Problem]:
    """What does not fit together."""
    if log.stop_bytes > log.low_bytes:
        yield Problem(
            "log.stop_bytes",
            f"{log.stop_bytes} is more than log.low_bytes = {log.low_bytes}: there would be no warning",
            "lower it",
        )
