"""Processes of this machine: whether one runs, and the child of another one by its command line."""

from __future__ import annotations

from pathlib import Path


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def child_of(parent: int, words: str) -> int:
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            above = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if above == parent and words in (folder / "cmdline").read_text():
                return int(folder.name)
        except OSError:  # it has just ended
            continue
    raise AssertionError(f"no child runs {words}")
