"""Spoilt configurations and command lines into the whole program, as many as asked for.

Run alone: `python tools/fuzz_config.py --configs 2000 --lines 1000 [--seed 0] [--only config/17]`. Every case runs in a
process of its own, which may take LIMIT_S longer than the same command takes with a good configuration, and hold
LIMIT_MB. Exit code 1 where one ends in a traceback, by a signal, too late or too large; each is told with its
number, which --only repeats.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT)]
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

from config_mutants import CONFIG, RECORDING, Case, Mutants, load_bases, toml_document  # noqa: E402 - the tests' own

LIMIT_S = 5.0
LIMIT_MB = 500
KILL_S = 90.0
_GOOD_CODES = (0, 1, 2, 3, 130)
_ADDRESS_SPACE = 8 << 30
# Commands whose good case takes long by itself.
_LONG = {"paper": 12.0, "bench": 30.0, "campaign": 6.0}
_LIBRARY_S = 15.0


@dataclass
class Outcome:
    """What became of a case."""

    code: int
    signal: int
    wall_s: float
    queued_s: float  # it could have run, and other people's processes did
    cpu_s: float
    rss_mb: float
    text: str

    @property
    def own_s(self) -> float:
        """Time that it took, without that in which it waited for a processor."""
        return self.wall_s - self.queued_s

    def wrong(self, allowed_s: float) -> str:
        """What is wrong with it, if anything."""
        if "Traceback (most recent call last)" in self.text:
            return "traceback: " + self.text.strip().splitlines()[-1][:150]
        if self.signal:
            return f"no end in {KILL_S:g} s" if self.wall_s >= KILL_S else f"signal {self.signal}"
        if self.code not in _GOOD_CODES:
            return f"exit code {self.code}"
        if self.own_s > allowed_s + LIMIT_S:
            work = f"{self.cpu_s:.1f} s of work, {self.queued_s:.1f} s without a processor"
            return f"slow: {self.wall_s:.1f} s ({work}), {allowed_s:.1f} s are usual"
        if self.rss_mb > LIMIT_MB:
            return f"large: {self.rss_mb:.0f} MB"
        if self.code == 2 and "error:" not in self.text:
            return "exit code 2 without a word"
        return ""


def run(case: Case, folder: Path, recording: str) -> Outcome:
    """Run a case in a child of this process, which has imported what it needs."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    folder.chmod(0o700)  # sockets of control go there
    for name, content in case.files.items():
        if content is None:
            os.mkfifo(folder / name)
        else:
            data = content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass")
            (folder / name).write_bytes(data)
    words = [recording if word == RECORDING else word for word in case.words]
    begun = time.monotonic()
    child = os.fork()
    if child == 0:
        _be_the_program(words, folder)
    deadline = begun + KILL_S
    while os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
            os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
            break
        time.sleep(0.005)
    wall_s = time.monotonic() - begun
    queued_s = int(Path(f"/proc/{child}/schedstat").read_text(encoding="ascii").split()[1]) * 1e-9
    _, status, used = os.wait4(child, 0)
    text = (folder / "stderr").read_text(encoding="utf-8", errors="replace")
    return Outcome(
        os.waitstatus_to_exitcode(status) if os.WIFEXITED(status) else 0,
        os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0,
        wall_s,
        queued_s,
        used.ru_utime + used.ru_stime,
        used.ru_maxrss / 1024,
        text,
    )


def _be_the_program(words: list[str], folder: Path) -> None:
    os.setpgid(0, 0)
    os.chdir(folder)
    for descriptor, name in ((1, "stdout"), (2, "stderr")):
        file = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(file, descriptor)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 30, 1 << 30))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.argv = ["uavctl", *words]
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", errors="surrogateescape", closefd=False)
    sys.stderr = os.fdopen(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False, buffering=1)
    code = 250
    try:
        from uavctl.cli import main as program

        program()
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
    except BaseException:  # noqa: BLE001 - whatever it is, it is the finding
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def allowed_s(case: Case) -> float:
    """What the command takes when all is well [s]."""
    command = next((word for word in case.words if not word.startswith("-")), "")
    usual = _LONG.get(command, 3.0)
    return usual if "solver.method=exact" in case.words or command in _LONG else usual + _LIBRARY_S


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--configs", type=int, default=2000)
    parser.add_argument("--lines", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first case of each kind")
    parser.add_argument("--only", help="one case, as in config/17 or line/3; its folder is kept")
    given = parser.parse_args(arguments)
    _import_all()
    mutants = Mutants(given.seed, load_bases())
    make = {"config": mutants.config, "line": mutants.command_line}
    top = Path(tempfile.mkdtemp(prefix="fuzz-config-"))
    recording = _record(top)
    if given.only:
        kind, _, number = given.only.partition("/")
        case = make[kind](int(number))
        found = run(case, top / "case", recording)
        sys.stdout.write(
            f"{case.note}\nuavctl {case.words}\n{found.text[-6000:]}\n{found.wrong(allowed_s(case)) or 'good'}: "
        )
        sys.stdout.write(f"code {found.code}, {found.wall_s:.2f} s, {found.rss_mb:.0f} MB, in {top / 'case'}\n")
        return 1 if found.wrong(allowed_s(case)) else 0
    bad: Counter[str] = Counter()
    codes: Counter[int] = Counter()
    slowest, largest = (-1e9, ""), (0.0, "")
    try:
        for kind, count in (("config", given.configs), ("line", given.lines)):
            for number in range(given.first, given.first + count):
                case = make[kind](number)
                found = run(case, top / "case", recording)
                name = f"{kind}/{number}"
                codes[found.code] += 1
                over_s = found.own_s - allowed_s(case)
                slowest = max(slowest, (over_s, f"{name} ({case.words[0]}, {found.wall_s:.1f} s)"))
                largest = max(largest, (found.rss_mb, name))
                wrong = found.wrong(allowed_s(case))
                if wrong:
                    bad[wrong.partition(":")[0]] += 1
                    where = [
                        line for line in re.findall(r'File "([^"]+)", line (\d+)', found.text) if "uavctl" in line[0]
                    ]
                    place = f" at {Path(where[-1][0]).name}:{where[-1][1]}" if where else ""
                    sys.stdout.write(f"{name}: {wrong}{place}; {case.words[0]}; {'; '.join(case.note)[:200]!r}\n")
                    sys.stdout.flush()
    finally:
        shutil.rmtree(top, ignore_errors=True)
    total = given.configs + given.lines
    told = ", ".join(f"{count} {what}" for what, count in bad.items()) or "none wrong"
    sys.stdout.write(
        f"{total} cases, seed {given.seed}: {told}; exit codes {dict(sorted(codes.items()))}; most over the usual time "
        f"{slowest[0]:.1f} s by {slowest[1]}; largest {largest[0]:.0f} MB by {largest[1]}\n"
    )
    return 1 if bad else 0


def _import_all() -> None:
    """Import what commands need once, before the first child."""
    import importlib

    from uavctl.cli import app

    for path, _ in app._COMMANDS.values():
        importlib.import_module(f"uavctl.cli.{path.partition(':')[0]}")
    import uavctl.cli.log_report
    import uavctl.cli.replay
    import uavctl.cli.whatif  # noqa: F401


def _record(top: Path) -> str:
    """A recording for the commands that read one."""
    files = {CONFIG: "\n".join(toml_document(load_bases()["paper"])) + "\n"}
    words = ["loopback", "--config", CONFIG, "--duration", "5", "--out", "flight"]
    found = run(Case(words, dict(files)), top / "recorded", "")
    assert found.code == 0, found.text
    return str(next((top / "recorded" / "flight").glob("*.mcap")))


if __name__ == "__main__":
    sys.exit(main())
