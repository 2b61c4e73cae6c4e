"""What may happen to a recording, done to it many times.

`python tools/storage.py --scenario kill --runs 1000`: recording processes, fed faster than real time, are killed
(SIGKILL) at random moments; what they left is recovered, and compared record by record with what was put. Nothing but
the open chunk may be lost, beside what was put since the writing thread last began a round.
`python tools/storage.py --scenario flip`: each byte of a small recording, finished and torn, is flipped. It must be
refused, or recovered, and never give a wrong value, nor a recovered file whose index or statistics are wrong.
`python tools/storage.py --scenario cost --runs 5 --seconds 60`: a flight's records are put tick by tick in real time,
and the time is taken that this costs the thread that flies, beside a sink that does nothing; medians of the runs.

`python tools/storage.py --scenario cuts --runs 200`: a flight in several files is cut at a random byte.
`python tools/storage.py --scenario killed-flight --runs 40`: `uavctl fly`, on a simulated vehicle, is killed (SIGKILL)
at a random moment. What is left has to replay alike up to its end, as it is and recovered, with exit code 0; if not
even its header is whole, it has to be refused.

Exit code 1 where something was wrong.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import random
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # the process is forked, so it may have no threads
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "support"))

from cost_rig import flown_ticks, measure_cost  # the tests' own
from cut_rig import NAME, Cuts, check_cut, check_refusal
from flip_rig import FlipTest
from kill_rig import KINDS, LOG, KillResult, kill_once, truth
from operation_rig import end_process, open_scene
from report_rig import omit_pages

from uavctl.cli.app import run

FLIGHT = ("--set", "log.segment_bytes=100000")  # so that cuts and kills hit the change of files, too
LONGEST_S = 4.0  # from the beginning of a recording to the kill


def main(arguments: Sequence[str] | None = None) -> int:
    """Do it, and say whether all was well."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", choices=("kill", "flip", "cost", "cuts", "killed-flight"), default="kill")
    parser.add_argument("--runs", type=int, default=1000, help="kills, cuts, or measurements")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a measurement")
    parser.add_argument("--first", type=int, default=0, help="seed of the first kill, or of the cuts")
    parser.add_argument("--json", action="store_true", help="figures as JSON, one document")
    given = parser.parse_args(arguments)
    if given.runs < 1 or given.first < 0 or given.seconds < 1.0:
        parser.error("give at least one run of a second or more, and a first seed of 0 or more")
    begun = time.monotonic()
    if given.scenario == "flip":
        wrong, report = _flips()
    elif given.scenario == "cost":
        wrong, report = _costs(given.runs, given.seconds)
    elif given.scenario == "cuts":
        wrong, report = _cuts(given.first, given.runs)
    elif given.scenario == "killed-flight":
        wrong, report = _killed_flights(given.first, given.runs)
    else:
        wrong, report = _kills(given.first, given.runs)
    document = {**report, "wrong": wrong, "wall_s": round(time.monotonic() - begun, 1)}
    sys.stdout.write(json.dumps(document, indent=None if given.json else 2) + "\n")
    return 1 if wrong else 0


def _kills(first: int, runs: int) -> tuple[dict[str, str], dict[str, object]]:
    items = truth()
    found: list[KillResult] = []
    for seed in range(first, first + runs):
        with tempfile.TemporaryDirectory(prefix="uavctl-kill-") as folder:
            found.append(kill_once(Path(folder), KINDS[seed % len(KINDS)], seed, items))
        _tell(f"{len(found)} of {runs}")
    report = {kind: _figures([one for one in found if one.kind == kind]) for kind in KINDS}
    wrong = {str(first + number): one.wrong for number, one in enumerate(found) if one.wrong}
    return wrong, {"runs": runs, "chunk_bytes": LOG.chunk_bytes, **report}


def _figures(found: Sequence[KillResult]) -> dict[str, int]:
    """Sums and extremes of the runs of one kind."""
    return {
        "runs": len(found),
        "before_the_first_chunk": sum(not one.kept for one in found),
        "records_put": sum(one.put for one in found),
        "records_kept": sum(one.kept for one in found),
        "most_lost_bytes": max((one.lost_bytes for one in found), default=0),
        "most_since_records": max((one.since for one in found), default=0),
        "most_files": max((one.files for one in found), default=0),
    }


def _flips() -> tuple[dict[str, str], dict[str, object]]:
    wrong: dict[str, str] = {}
    report: dict[str, object] = {}
    for state in ("finished", "torn"):
        with tempfile.TemporaryDirectory(prefix="uavctl-flip-") as folder:
            flips = FlipTest(Path(folder), finished=state == "finished")
            check_refusal = 0
            for position in range(len(flips.data)):
                _tell(f"{state}: {position} of {len(flips.data)}")
                flips.flip(position, 1 << position % 8)
                try:
                    check_refusal += flips.read()
                    flips.look()
                    flips.recover()
                except AssertionError as error:
                    wrong[f"{state}, byte {position}"] = repr(error)
            report[state] = {"bytes": len(flips.data), "refused": check_refusal}
    return wrong, report


def _costs(runs: int, seconds: float) -> tuple[dict[str, str], dict[str, object]]:
    ticks = flown_ticks()
    found: list[dict[str, float]] = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory(prefix="uavctl-cost-") as folder:
            found.append(measure_cost(Path(folder), ticks, seconds))
        _tell(f"{len(found)} of {runs}")
    wrong = {str(number): "records dropped" for number, one in enumerate(found) if one["dropped"]}
    report = {key: round(statistics.median(one[key] for one in found), 2) for key in found[0]}
    return wrong, {"runs": runs, "seconds": seconds, **report}


def _cuts(seed: int, runs: int) -> tuple[dict[str, str], dict[str, object]]:
    wrong: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="uavctl-cuts-") as flown:
        words = ["loopback", *FLIGHT, "--duration", "5", "--out", flown, "--json"]
        with omit_pages(), redirect_stdout(io.StringIO()):
            run(words)
        cuts = Cuts(Path(flown) / NAME)
        for number, (file, size) in enumerate(cuts.draw_cuts(runs, seed), 1):
            with tempfile.TemporaryDirectory(prefix="uavctl-cut-") as folder:
                text = cuts.find_problem(Path(folder), file, size)
            if text:
                wrong[f"file {file + 1}, {size} bytes"] = text
            _tell(f"{number} of {runs}")
    report: dict[str, object] = {"files": len(cuts.files), "chunks": len(cuts.chunks), "straddled": cuts.straddled}
    return wrong, {"runs": runs, "alike": runs - len(wrong), **report}


def _killed_flights(first: int, runs: int) -> tuple[dict[str, str], dict[str, object]]:
    wrong: dict[str, str] = {}
    decisions = files = nothing = 0
    for seed in range(first, first + runs):
        with open_scene() as air, end_process(air.fly("f", *FLIGHT)) as process:
            assert process.stderr is not None
            while "recording to" not in process.stderr.readline():
                assert process.poll() is None, "the daemon does not start"
            time.sleep(random.Random(seed).uniform(0.0, LONGEST_S))
            process.kill()
            process.wait()
            left = [*(air.folder / "f").glob("*.mcap")]
            files = max(files, len(left))
            if any(one.stat().st_size for one in left):
                text, compared = check_cut(air.folder / "f", ended=False)
                decisions += compared
            else:
                text = check_refusal(air.folder / "f")
                nothing += 1
        if text:
            wrong[str(seed)] = text
        _tell(f"{seed - first + 1} of {runs}")
    report: dict[str, object] = {
        "decisions_compared": decisions,
        "most_files": files,
        "before_the_first_chunk": nothing,
    }
    return wrong, {"runs": runs, "alike": runs - len(wrong), **report}


def _tell(text: str) -> None:
    if sys.stderr.isatty():
        sys.stderr.write(f"\r{text} ")


if __name__ == "__main__":
    sys.exit(main())
