"""Mutated messages into the simulated autopilots, as many as asked for.

Run alone: `python tools/fuzz.py --messages 1000000 [--seed 0]`; exit code 1 where one of them does what it should not.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

from fuzz_rig import Judge  # the tests' own

BATCH = 5000


def main(arguments: Sequence[str] | None = None) -> int:
    """Half of the messages go to each autopilot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    start = time.monotonic()
    for name in ("px4", "ardupilot"):
        judge = Judge(name, given.seed)
        wanted = given.messages // 2
        for done in range(0, wanted, BATCH):
            try:
                judge.run(min(BATCH, wanted - done))
            except Exception as error:  # noqa: BLE001 - whatever it is, it is the finding
                sys.stderr.write(f"\n{name}, seed {given.seed}, by message {done + BATCH}: {error!r}\n")
                return 1
            sys.stderr.write(f"\r{name}: {min(done + BATCH, wanted)} of {wanted}, {time.monotonic() - start:.0f} s ")
        results = ", ".join(f"{result}: {count}" for result, count in sorted(judge.results.items()))
        sys.stdout.write(f"\n{name}: {wanted} messages; MAV_RESULT {results}; modes {', '.join(sorted(judge.modes))}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
