"""All checks of the tree, two side by side, the tests last; the first that fails ends the run.

`make test` runs this, `make test-all` with `--all`, `make test-long` with `--long`; continuous integration runs the
last two. `--write-docs` only writes the generated pages.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import repeat
from pathlib import Path

from safety_core import find_missing_branches, list_own_tests

from docs import PAGES, ROOT

BIN = Path(sys.executable).parent
# One thread of each test process; and each of the processes that tests start would compile what it imports anew if no
# bytecode were kept.
_PROCESSES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": ""}
# Test processes on two cores. Quick tests that fly in real time mostly wait; with the slow ones, these need a core.
PROCESSES = {"": 3, "--all": 2, "--long": 2}
# Expressions of pytest's marks, by the option that asks for these tests.
MARKS = {"": "not slow and not long and not manual", "--all": "not long and not manual", "--long": "long"}
# Profiles of Hypothesis (tests/conftest.py).
PROFILES = {"": "quick", "--all": "patient", "--long": "patient"}

# Limits of the wheel's check on another interpreter [s]: one program, and the installation of all packages.
PROGRAM_S, INSTALL_S = 120.0, 300.0


class StageError(Exception):
    """A stage failed; holds the output for the reader."""


def say(text: str) -> None:
    """Print one line."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def run(
    command: Sequence[str | Path],
    *,
    cwd: Path = ROOT,
    extra: Mapping[str, str] | None = None,
    limit_s: float | None = None,
) -> str:
    """Run a program to its end, for `limit_s` at most; its output.

    Raises:
        StageError: If it exits with anything but 0, with all its output, or takes longer.
    """
    words = [str(word) for word in command]
    try:
        done = subprocess.run(
            words,
            cwd=cwd,
            env={**os.environ, **_PROCESSES, **(extra or {})},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=limit_s,
        )
    except subprocess.TimeoutExpired as error:
        raise StageError(f"{' '.join(words)}: not done within {limit_s:g} s") from error
    if done.returncode != 0:
        raise StageError(f"{done.stdout}\n{' '.join(words)}: exit code {done.returncode}")
    return done.stdout


def check_pages() -> str:
    """The generated pages agree with the types."""
    for page, text in PAGES.items():
        if not page.exists() or page.read_text(encoding="utf-8") != text():
            raise StageError(f"{page.relative_to(ROOT)} is not up to date; run `make docs`")
    return ""


def find_interpreters() -> dict[str, Path]:
    """Find an interpreter of each version that pyproject.toml names, except this one's, on PATH and below pyenv."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [classifier.rpartition(" ")[2] for classifier in project["classifiers"] if ":: Python ::" in classifier]
    pyenv = Path(os.environ.get("PYENV_ROOT", "~/.pyenv")).expanduser() / "versions"
    found = {}
    for version in named:
        if version == f"{sys.version_info[0]}.{sys.version_info[1]}":
            continue
        on_path = shutil.which(f"python{version}")
        candidates = [*([Path(on_path)] if on_path else []), *sorted(pyenv.glob(f"{version}.*/bin/python{version}"))]
        for candidate in candidates:
            # A name on PATH may be pyenv's own, which fails where that version is not chosen.
            with contextlib.suppress(StageError):
                run([candidate, "-c", "import venv"], limit_s=PROGRAM_S)
                found[version] = candidate
                break
    return found


def check_interpreter(python: Path, wheel: Path, folder: Path, recording: Path) -> None:
    """Install the wheel in an environment of its own; fly there, and replay another interpreter's recording.

    With the same versions of all packages a replay decides the same to the last bit.
    """
    environment, flights = folder / "environment", folder / "flights"
    folder.mkdir()
    run([python, "-m", "venv", environment], limit_s=PROGRAM_S)
    pip = (environment / "bin" / "python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    run([*pip, "-c", ROOT / "constraints.txt", wheel], cwd=folder, limit_s=INSTALL_S)
    uavctl = environment / "bin" / "uavctl"
    for words in (
        ("--version",),
        ("loopback", "--config", "room", "--duration", "5", "--out", str(flights)),
        ("log", "replay", str(recording)),
    ):
        run([uavctl, *words], cwd=folder, limit_s=PROGRAM_S)
    script = "import uavctl; print(uavctl.solve('room', [0.0] * 9).cost, uavctl.read('flights/flight.mcap').topics)"
    run([environment / "bin" / "python", "-W", "error", "-c", script], cwd=folder, limit_s=PROGRAM_S)


def check_wheel() -> str:
    """Build the wheel, install it outside the checkout for each interpreter of this machine, and fly from there."""
    with tempfile.TemporaryDirectory(prefix="uavctl-wheel-") as name:
        folder = Path(name)
        shutil.rmtree(ROOT / "build", ignore_errors=True)  # else modules that are gone would be in the wheel
        run([sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder / "dist", ROOT])
        (wheel,) = (folder / "dist").glob("*.whl")
        site = folder / "site"
        run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", site, wheel])
        # -P and PYTHONPATH: the installed package, not the checkout beside the working directory.
        flight = ("loopback", "--config", "paper", "--duration", "20", "--json", "--out", str(folder / "flights"))
        outside = {"PYTHONPATH": str(site)}
        where = run([sys.executable, "-P", "-c", "import uavctl; print(uavctl.__file__)"], cwd=folder, extra=outside)
        if not Path(where.strip()).is_relative_to(site):
            raise StageError(f"the wheel was not imported, but {where.strip()}")
        page = run([sys.executable, "-P", "-m", "uavctl", "docs", "faults"], cwd=folder, extra=outside)
        if page != (ROOT / "docs" / "faults.md").read_text(encoding="utf-8"):
            raise StageError("`uavctl docs faults` of the wheel does not show that page")
        output = run([sys.executable, "-P", "-m", "uavctl", *flight], cwd=folder, extra=outside)
        if not any((folder / "flights").glob("*.html")):
            raise StageError(f"{output}\nthe wheel made no page of its flight")
        for version, python in find_interpreters().items():
            check_interpreter(python, wheel, folder / version, folder / "flights" / "flight.mcap")
            say(f"    wheel on Python {version}")
        return output


def check_site() -> str:
    """Build the site of the manual; a page, link or heading that is missing is an error."""
    with tempfile.TemporaryDirectory(prefix="uavctl-site-") as folder:
        command: list[str | Path] = [
            BIN / "mkdocs",
            "build",
            "--strict",
            "--config-file",
            ROOT / "tools" / "mkdocs.yml",
        ]
        return run([*command, "--site-dir", folder], extra={"NO_MKDOCS_2_WARNING": "1"})


def check_core() -> str:
    """Every branch of the safety core is run by its own tests."""
    if missing := find_missing_branches():
        raise StageError(missing)
    return ""


def check_tests(failed: threading.Event, option: str) -> str:
    """The tests of an option; no test at all is a failure (exit code 5). They end early if `failed`.

    With `--all`, `check_core` runs the safety core's own tests, and they are left out here. A file's tests stay in
    one process, so that shared parts are made once; tests/conftest.py gives the order.
    """
    command = [str(BIN / "pytest"), "-n", str(PROCESSES[option]), "-m", MARKS[option]]
    command += ["--dist", "loadfile", "--no-loadscope-reorder", "--hypothesis-profile", PROFILES[option]]
    if option == "--all":
        command += [f"--ignore={test}" for test in list_own_tests()]
    with subprocess.Popen(command, cwd=ROOT, env={**os.environ, **_PROCESSES}) as process:
        while process.poll() is None:
            if failed.wait(0.2):
                process.send_signal(signal.SIGINT)
                process.wait()
                raise StageError("ended, for another check has failed")
    if process.returncode != 0:
        raise StageError(f"pytest: exit code {process.returncode}")
    return ""


def stages(failed: threading.Event, option: str) -> tuple[tuple[str, Callable[[], str]], ...]:
    """All checks of an option: the quickest first, and the types beside the tests, which take longest."""
    tests = ("pytest", lambda: check_tests(failed, option))
    if option == "--long":
        return (tests,)
    slow = (
        ("wheel, outside the checkout", check_wheel),
        ("site of the manual", check_site),
        ("branches of the safety core", check_core),
    )
    return (
        ("ruff check", lambda: run([BIN / "ruff", "check"])),
        ("ruff format", lambda: run([BIN / "ruff", "format", "--check"])),
        ("import contracts", lambda: run([BIN / "lint-imports"])),
        ("generated pages of docs/", check_pages),
        *(slow if option == "--all" else ()),
        ("mypy", lambda: run([BIN / "mypy"])),
        tests,
    )


def take(name: str, stage: Callable[[], str], failed: threading.Event) -> None:
    """Run a stage, unless another has failed, and say how it ended."""
    if failed.is_set():
        return
    start = time.monotonic()
    try:
        stage()
    except StageError as error:
        failed.set()
        say(f"{error}\nFAILED  {name}")
        return
    say(f"ok  {name} ({time.monotonic() - start:.1f} s)")


def main(arguments: Sequence[str]) -> int:
    """Run the stages, two at a time; 0 if all of them pass.

    `--all`: wheel, safety core and slow tests too; `--long`: long tests alone.
    """
    if list(arguments) == ["--write-docs"]:
        for page, text in PAGES.items():
            page.write_text(text(), encoding="utf-8")
        return 0
    option = " ".join(arguments)
    if option not in MARKS:
        say("give nothing, --all, --long or --write-docs")
        return 2
    failed = threading.Event()
    with ThreadPoolExecutor(2) as pool:
        names, checks = zip(*stages(failed, option), strict=True)
        list(pool.map(take, names, checks, repeat(failed)))  # read, so that no exception is lost
    return int(failed.is_set())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
