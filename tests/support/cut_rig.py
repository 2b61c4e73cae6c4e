"""A recorded flight that ends anywhere: recovered or not, its replay is identical up to there, and reports the cut."""

from __future__ import annotations

import io
import json
import random
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

from mcap import records
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader, breakup_chunk

from logs.recording.reader import find_segments
from uavctl.cli.app import run

NAME = "flight.mcap"
TICK, DECISION = "/uavctl/step_input", "/uavctl/decision"


@dataclass(frozen=True)
class Chunk:
    """What a chunk of a whole recording holds, by the format's own reader.

    Attributes:
        file: Number of its file, from 0 on.
        end: Offset of its end in the file.
        indexed: Offset of the end of its index.
        ticks: Step inputs up to here, in all files.
        decisions: Decisions up to here.
    """

    file: int
    end: int
    indexed: int
    ticks: int
    decisions: int


class Cuts:
    """A whole recording, and what its parts have to replay as.

    Args:
        flight: The first file of a recording that was closed in order.

    Attributes:
        files: All of them.
        chunks: Of all files, in order.
        straddled: Cuts so far behind a step input whose decision was not there yet.
    """

    def __init__(self, flight: Path) -> None:
        self.files = find_segments(flight)
        self.chunks = list(_chunks(self.files))
        self._sizes = [file.stat().st_size for file in self.files]
        self.straddled = 0

    def cut_points(self) -> list[tuple[int, int]]:
        """File and size of every cut beside the end of a chunk, of its index, and around what is not a chunk."""
        offsets = {(chunk.file, offset) for chunk in self.chunks for offset in (chunk.end, chunk.indexed)}
        near = {(file, offset + by) for file, offset in offsets for by in (-1, 0, 1)}
        for file, size in enumerate(self._sizes):
            last = max(chunk.indexed for chunk in self.chunks if chunk.file == file)
            others = (0, 1, 8, 9, (last + size) // 2, size - 40, size - 9, size - 8, size - 1, size)
            near |= {(file, at) for at in others}
        return sorted(near)

    def draw_cuts(self, count: int, seed: int) -> list[tuple[int, int]]:
        """File and size of so many cuts, each byte of the recording as likely as any other."""
        dice = random.Random(seed)
        files = dice.choices(range(len(self.files)), self._sizes, k=count)
        return [(file, dice.randrange(self._sizes[file])) for file in files]

    def find_problem(self, folder: Path, file: int, size: int) -> str:
        """What is wrong with the recording whose file of this number is cut to `size` bytes; nothing if all is well."""
        for whole in self.files[:file]:
            shutil.copy(whole, folder)
        (folder / self.files[file].name).write_bytes(self.files[file].read_bytes()[:size])
        whole_chunks = [chunk for chunk in self.chunks if (chunk.file, chunk.end) <= (file, size)]
        at_the_end = file == len(self.files) - 1 and size == self._sizes[file]
        if not whole_chunks:
            return check_refusal(folder)
        last = whole_chunks[-1]
        self.straddled += last.ticks > last.decisions
        text, decisions = check_cut(folder, ended=at_the_end or last == self.chunks[-1])
        return text or ("" if decisions == last.decisions else f"{decisions} of {last.decisions} decisions compared")


def check_cut(folder: Path, *, ended: bool) -> tuple[str, int]:
    """What is wrong with how a cut recording is recovered and replayed, and how many decisions are compared.

    Args:
        folder: Of its files; the recovered one comes beside them.
        ended: The recorder's last word is in it.
    """
    flight, out = folder / NAME, folder / "recovered.mcap"
    code, output, errors = _run("log", "recover", str(flight), str(out))
    if code not in (0, 3):
        return f"recover: {code}, {errors}", 0
    if (output["ended"], code) != (ended, 0 if not output["lost_bytes"] + output["messages_lost"] else 3):
        return f"recover: {code}, {output}", 0
    result = set()
    for path in (flight, out):
        code, output, errors = _run("log", "replay", str(path))
        if (code, output.get("identical")) != (0, True):
            return f"{path.name}: {code}, {output or errors}", 0
        if path == out and ("recovered from flight.mcap: " in errors and "its end is missing" in errors) is ended:
            return f"{path.name}: {errors or 'not said to be cut'}", 0
        result.add((int(output["decisions"]), int(output["compared"])))
    return "" if len(result) == 1 else f"recovered it is another recording: {result}", min(result)[0]


def check_refusal(folder: Path) -> str:
    """What is wrong with how a recording is refused that holds nothing, not even its header."""
    for arguments in (("replay",), ("recover", str(folder / "recovered.mcap"))):
        code, output, errors = _run("log", arguments[0], str(folder / NAME), *arguments[1:])
        if code != 1 or output.get("exit_code") != code or not errors.startswith("error: ") or errors.count("\n") != 1:
            return f"{arguments[0]} of nothing: {code}, {output}, {errors}"
    return f"{arguments[0]} left a file" if (folder / "recovered.mcap").exists() else ""


def _run(*arguments: str) -> tuple[int, dict[str, int | bool], str]:
    """Exit code, JSON document and standard error of a command."""
    out, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(errors):
        code = run([*arguments, "--json"])
    return code, json.loads(out.getvalue() or "{}"), _plain(errors.getvalue())


def _plain(text: str) -> str:
    """Without the colours of a terminal."""
    plain, *rest = text.split("\x1b[")
    return plain + "".join(part.partition("m")[2] for part in rest)


def _chunks(files: tuple[Path, ...]) -> Iterator[Chunk]:
    counts: Counter[str] = Counter()
    for number, path in enumerate(files):
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
            assert summary is not None, path
            file.seek(0)
            chunks = [
                record for record in StreamReader(file, emit_chunks=True).records if isinstance(record, records.Chunk)
            ]
        for index, chunk in zip(summary.chunk_indexes, chunks, strict=True):
            held = breakup_chunk(chunk, validate_crc=True)
            counts.update(
                summary.channels[record.channel_id].topic for record in held if isinstance(record, records.Message)
            )
            end = index.chunk_start_offset + index.chunk_length
            yield Chunk(number, end, end + index.message_index_length, counts[TICK], counts[DECISION])
