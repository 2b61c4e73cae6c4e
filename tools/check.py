"""All checks of the tree: the quick ones side by side, then the tests; the first that fails ends the run.

`make test` runs this, `make test-all` and continuous integration with `--all`; `--write-docs` only writes the generated
pages.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from docs import PAGES, ROOT

BIN = Path(sys.executable).parent
# Two test processes on two cores; and each of the processes that tests start would compile what it imports anew if no
# bytecode were kept.
_PROCESSES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": ""}


class StageError(Exception):
    """A stage failed; holds what its person needs to see."""


def say(text: str) -> None:
    """One line to the person who waits."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def run(command: Sequence[str | Path], *, cwd: Path = ROOT, extra: Mapping[str, str] | None = None) -> str:
    """Run a program to its end; its output.

    Raises:
        StageError: If it exits with anything but 0, with all its output.
    """
    words = [str(word) for word in command]
    done = subprocess.run(
        words,
        cwd=cwd,
        env={**os.environ, **_PROCESSES, **(extra or {})},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise StageError(f"{done.stdout}\n{' '.join(words)}: exit code {done.returncode}")
    return done.stdout


def check_pages() -> str:
    """The generated pages are what the types say."""
    for page, text in PAGES.items():
        if not page.exists() or page.read_text(encoding="utf-8") != text():
            raise StageError(f"{page.relative_to(ROOT)} is not up to date; run `make docs`")
    return ""


def check_wheel(cache: str) -> str:
    """Build the wheel, install it outside the checkout, and fly from there."""
    with tempfile.TemporaryDirectory(prefix="uavctl-wheel-") as name:
        folder = Path(name)
        shutil.rmtree(ROOT / "build", ignore_errors=True)  # else modules that are gone would be in the wheel
        run([sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder / "dist", ROOT])
        (wheel,) = (folder / "dist").glob("*.whl")
        site = folder / "site"
        run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", site, wheel])
        # -P and PYTHONPATH: the installed package, not the checkout beside the working directory.
        flight = ("loopback", "--config", "paper", "--duration", "20", "--json", "--out", str(folder / "flights"))
        outside = {"PYTHONPATH": str(site), "UAVCTL_CACHE": cache}
        where = run([sys.executable, "-P", "-c", "import uavctl; print(uavctl.__file__)"], cwd=folder, extra=outside)
        if not Path(where.strip()).is_relative_to(site):
            raise StageError(f"the wheel was not what was imported, but {where.strip()}")
        return run([sys.executable, "-P", "-m", "uavctl", *flight], cwd=folder, extra=outside)


def check_tests(cache: str, *, everything: bool) -> None:
    """All tests, or those that are not slow; no test at all is a failure (exit code 5).

    A file's tests stay in one process, so that what they share is made once; tests/conftest.py gives the order.
    """
    command = [str(BIN / "pytest"), "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder"]
    command += [] if everything else ["-m", "not slow"]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, **_PROCESSES, "UAVCTL_CACHE": cache}, check=False)
    if done.returncode != 0:
        raise StageError(f"pytest: exit code {done.returncode}")


def stages(cache: str, *, everything: bool) -> tuple[tuple[str, Callable[[], str]], ...]:
    """All but the tests, what takes longest first; policy libraries are kept in `cache`."""
    wheel = (("wheel, outside the checkout", lambda: check_wheel(cache)),)
    return (
        ("mypy", lambda: run([BIN / "mypy"])),
        *(wheel if everything else ()),
        ("ruff check", lambda: run([BIN / "ruff", "check"])),
        ("ruff format", lambda: run([BIN / "ruff", "format", "--check"])),
        ("import contracts", lambda: run([BIN / "lint-imports"])),
        ("generated pages of docs/", check_pages),
    )


def passes(name: str, stage: Callable[[], str]) -> bool:
    """Run a stage and say how it ended."""
    start = time.monotonic()
    try:
        stage()
    except StageError as error:
        say(f"{error}\nFAILED  {name}")
        return False
    say(f"ok  {name} ({time.monotonic() - start:.1f} s)")
    return True


def main(arguments: Sequence[str]) -> int:
    """Run the stages, two at a time, then the tests; 0 if all of them pass. `--all`: the wheel and slow tests too."""
    if list(arguments) == ["--write-docs"]:
        for page, text in PAGES.items():
            page.write_text(text(), encoding="utf-8")
        return 0
    everything = list(arguments) == ["--all"]
    if arguments and not everything:
        say("give nothing, --all or --write-docs")
        return 2
    with tempfile.TemporaryDirectory(prefix="uavctl-check-cache-") as cache:
        with ThreadPoolExecutor(2) as pool:
            if not all(list(pool.map(lambda one: passes(*one), stages(cache, everything=everything)))):
                return 1
        say("pytest ...")
        try:
            check_tests(cache, everything=everything)
        except StageError as error:
            say(f"{error}\nFAILED  pytest")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
