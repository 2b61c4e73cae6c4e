"""Hostile datagrams and stalls against the real daemon, over loopback, on a vehicle that streams telemetry.

`python tools/attack.py --scenario datagrams`: one flight for each number of senders, signed or not, listed or not, in
which each kind of `tests/support/attacker.py` is sent for some seconds at the rate limit of `[security]`. Told are the
processor seconds a second that it added to the daemon's, ticks that were missed, and falls back.
`python tools/attack.py --scenario stall --runs 50`: the daemon is stopped (SIGSTOP) for 0.3 to 2.5 s under 600 messages
a second, the pilot takes over in the middle, and the setpoints are counted that come after it woke.

Exit code 1 where a sender cost more than `MOST_CPU`, ticks were missed that are not without them, or a setpoint came.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

from attack_rig import run_attacks, run_stalls  # the tests' own
from attacker import BELIEVED_UNSIGNED, WORDS

MOST_CPU = 0.15  # processor seconds a second of one sender
MISSED_SHARE = 0.01  # of the ticks, beyond those that are missed without


def main(arguments: Sequence[str] | None = None) -> int:
    """Do it, and say whether all was well."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", choices=("datagrams", "stall"), default="datagrams")
    parser.add_argument("--kinds", nargs="*", choices=list(WORDS), default=list(WORDS), metavar="KIND")
    parser.add_argument("--senders", type=int, nargs="*", default=[1, 16], help="ports that are sent from")
    parser.add_argument("--listed", choices=("yes", "no", "both"), default="both", help="in security.allow")
    parser.add_argument("--signed", choices=("yes", "no", "both"), default="both", help="the daemon has a key")
    parser.add_argument("--port", choices=("vehicle", "mocap"), default="vehicle", help="which is attacked")
    parser.add_argument("--per-s", type=float, default=2000.0, help="datagrams a second of each sender")
    parser.add_argument("--seconds", type=float, default=4.0, help="length of each attack")
    parser.add_argument("--runs", type=int, default=50, help="stalls")
    parser.add_argument("--telemetry-hz", type=float, default=600.0, help="the vehicle's messages a second in a stall")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="figures as JSON, one document")
    given = parser.parse_args(arguments)
    if given.runs < 1 or given.seconds < 1.0 or min(given.senders, default=0) < 1:
        parser.error("give at least one stall, one second and one sender")
    begun = time.monotonic()
    rows, wrong = _stalls(given) if given.scenario == "stall" else _attacks(given)
    document = {"rows": rows, "wrong": wrong, "wall_s": round(time.monotonic() - begun, 1)}
    sys.stdout.write(json.dumps(document, indent=None if given.json else 1) + "\n")
    return 1 if wrong else 0


def _attacks(given: argparse.Namespace) -> tuple[list[dict[str, Any]], list[str]]:
    either = {"yes": (True,), "no": (False,), "both": (False, True)}
    rows, wrong = [], []
    for signed, listed, senders in product(either[given.signed], either[given.listed], given.senders):
        for row in run_attacks(
            # Those that end a flight come last.
            sorted(given.kinds, key=lambda kind: kind in BELIEVED_UNSIGNED),
            seconds=given.seconds,
            senders=senders,
            listed=listed,
            signed=signed,
            per_s=given.per_s,
            cameras=given.port == "mocap",
        ):
            rows.append(row)
            wrong += _wrong(row)
            _tell(row)
    return rows, wrong


def _wrong(row: dict[str, Any]) -> list[str]:
    name = f"{row['kind']}, {row['senders']} senders, signed {row['signed']}, listed {row['listed']}"
    found = []
    if row["senders"] == 1 and row["cpu_added"] > MOST_CPU:
        found.append(f"{name}: {row['cpu_added']} processor seconds a second")
    share, calm = (row[f"missed{of}"] / max(1, row[f"ticks{of}"]) for of in ("", "_calm"))
    if share > calm + MISSED_SHARE:
        found.append(f"{name}: {row['missed']} of {row['ticks']} ticks missed")
    believed = row["kind"] in BELIEVED_UNSIGNED and not row["signed"]
    if row["fallbacks"] and not believed:
        found.append(f"{name}: fell back")
    return found


def _stalls(given: argparse.Namespace) -> tuple[list[dict[str, Any]], list[str]]:
    rows, wrong = [], []
    for row in run_stalls(given.runs, given.seed, given.telemetry_hz, signed=given.signed == "yes"):
        rows.append(row)
        _tell(row)
        if row["setpoints"]:
            wrong.append(f"run {row['run']}: {row['setpoints']} setpoints after a stall of {row['stall_s']} s")
    return rows, wrong


def _tell(row: dict[str, Any]) -> None:
    sys.stderr.write(" ".join(f"{key}={value}" for key, value in row.items()) + "\n")


if __name__ == "__main__":
    sys.exit(main())
