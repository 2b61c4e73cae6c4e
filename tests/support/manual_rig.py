"""Commands of the manual, and a shell to run them: in a scratch folder, with ports of its own."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from patience import wait_until
from places import ROOT

from uavctl.daemon.runtime_folder import TEMPORARY

PAGES = ("README.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")))
_BLOCK = re.compile(r"^( *)```(\w+)\n(.*?)^ *```$", re.M | re.S)
_TABLE = re.compile(r"^\[(\w+)\]\n((?:(?!^\[).*\n?)*)", re.M)
LIMIT_S = 300.0  # for what is stuck


def find_blocks(page: str, language: str, section: str = "") -> list[str]:
    """Return the blocks of a page in a language, or those of a section, by the begin of its heading."""
    text = (ROOT / page).read_text(encoding="utf-8")
    if section:
        (text,) = re.findall(rf"^#+ {re.escape(section)}.*?(?=^#+ |\Z)", text, re.M | re.S)
    return [
        re.sub(rf"^{indent}", "", body, flags=re.M) for indent, kind, body in _BLOCK.findall(text) if kind == language
    ]


def find_commands(page: str, section: str = "") -> list[str]:
    """Return the commands of a page in order, without comments; continued lines are one command."""
    lines = "\n".join(find_blocks(page, "sh", section)).replace("\\\n", " ").splitlines()
    return [command for line in lines if (command := re.sub(r"\s+# .*", "", line).strip())]


def parse_keys(block: str) -> list[tuple[str, str, str]]:
    """Return table, key and value of each line of a TOML block."""
    results = []
    for table, body in _TABLE.findall(block):
        parts = (line.partition("=") for line in body.splitlines() if "=" in line)
        results += [(table, key.strip(), value.strip()) for key, _, value in parts]
    return results


def apply_block(text: str, block: str) -> str:
    """Apply the keys of a block to a configuration; add a table that is missing."""
    for table, key, value in parse_keys(block):
        line, result = f"{key} = {value}\n", re.search(rf"^\[{table}\]\n(?:(?!^\[).*\n?)*", text, re.M)
        if result is None:
            text += f"\n[{table}]\n{line}"
            continue
        old = re.compile(rf"^{key} = (\[\n(?:.*\n)*?\]|.*)\n", re.M)
        new, count = old.subn(line.replace("\\", r"\\"), result[0], count=1)
        new = new if count else result[0].replace(f"[{table}]\n", f"[{table}]\n{line}", 1)
        text = text[: result.start()] + new + text[result.end() :]
    return text


@dataclass
class ManualShell:
    """Shell in a folder like a checkout, with a network of its own; without the right to one it locks the ports."""

    folder: Path
    prefix: tuple[str, ...]
    environment: dict[str, str]
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def start(self, command: str) -> subprocess.Popen[bytes]:
        """Start a command."""
        log = (self.folder / f"log-{len(self.processes)}").open("wb")
        process = subprocess.Popen(
            [*self.prefix, "sh", "-c", f"exec {command}" if command.startswith("uavctl ") else command],
            cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
        )  # fmt: skip
        log.close()
        self.processes.append(process)
        return process

    def read_output(self, process: subprocess.Popen[bytes]) -> str:
        """Read the output of a command."""
        return (self.folder / f"log-{self.processes.index(process)}").read_text(errors="replace")

    def wait_for_end(self, process: subprocess.Popen[bytes], command: str, code: int = 0) -> str:
        """Wait for the end of a command; return its output."""
        result = process.wait(LIMIT_S)
        assert result == code, f"{command}: exit code {result}, not {code}\n{self.read_output(process)}"
        return self.read_output(process)

    def run(self, command: str, code: int = 0) -> str:
        """Run a command to its end; return its output."""
        return self.wait_for_end(self.start(command), command, code)

    def wait_for_text(self, process: subprocess.Popen[bytes], text: str) -> None:
        """Wait until a command has written a text."""

        def read_output() -> bool:
            assert process.poll() is None or text in self.read_output(process), self.read_output(process)
            return text in self.read_output(process)

        wait_until(read_output, f"it says {text!r}")

    def wait_for_success(self, command: str) -> None:
        """Repeat a command until it succeeds."""
        wait_until(lambda: self.start(command).wait(LIMIT_S) == 0, command, pause_s=0.5)

    def stop(self, process: subprocess.Popen[bytes]) -> None:
        """Stop a command by Ctrl-C."""
        process.send_signal(signal.SIGINT)
        process.wait(LIMIT_S)


# Two vehicles at one port of two networks are two vehicles, so the lock files below /tmp are separate, too.
_SEPARATE = """
ip link set lo up && mkdir -p -m 700 "$0" && mount -t tmpfs -o mode=700 none "$0" && echo up && exec sleep infinity
"""


@contextmanager
def _network(folder: Path) -> Iterator[tuple[str, ...]]:
    """Yield a command prefix for a network and vehicle locks of its own; without the right, lock the default ports."""
    locks = TEMPORARY / f"uavctl-{os.geteuid()}"
    holder = subprocess.Popen(
        ["unshare", "-n", "-m", "sh", "-c", _SEPARATE, str(locks)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        text=True,
    )  # fmt: skip
    try:
        assert holder.stdout is not None
        if holder.stdout.readline() == "up\n":
            spaces = [f"--{kind}=/proc/{holder.pid}/ns/{file}" for kind, file in (("net", "net"), ("mount", "mnt"))]
            yield ("nsenter", *spaces, f"--wdns={folder}")
            return
        with (Path(tempfile.gettempdir()) / "uavctl-default-ports.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield ()
    finally:
        holder.kill()
        holder.wait()
        if holder.stdout is not None:
            holder.stdout.close()


@contextmanager
def open_shell(folder: Path) -> Iterator[ManualShell]:
    """Open a shell in a folder with the parts of a checkout; end running commands at the end."""
    for name in ("uavctl", "docs", "tools", "sim", "logs"):
        (folder / name).symlink_to(ROOT / name)
    for example in ("duo.toml", "radio.toml", "cross.toml"):
        (folder / example).write_bytes((ROOT / "docs/examples" / example).read_bytes())
    with tempfile.TemporaryDirectory(prefix="uavctl-") as short, _network(folder) as network:  # short for sockets
        (Path(short) / "bin").mkdir()
        (Path(short) / "bin/uavctl").write_text(f'#!/bin/sh\nexec {sys.executable} -m uavctl "$@"\n')
        (Path(short) / "bin/uavctl").chmod(0o755)
        (Path(short) / "bin/python").symlink_to(sys.executable)
        environment = {
            **os.environ, "PATH": f"{short}/bin:{os.environ['PATH']}", "HOME": short, "XDG_RUNTIME_DIR": short,
            "PYTHONPATH": str(ROOT), "PYTHONSAFEPATH": "1", "COLUMNS": "80",
        }  # fmt: skip
        (folder / ".venv").mkdir()
        shutil.copytree(Path(short) / "bin", folder / ".venv/bin", symlinks=True)
        shell = ManualShell(folder, network, environment)
        try:
            yield shell
        finally:
            for process in shell.processes:
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
            for process in shell.processes:
                try:
                    process.wait(20.0)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
