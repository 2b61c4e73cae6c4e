"""The modules of the safety core and their own tests, which must run every branch of them.

`make test-all` asks that of each run; tools/mutation.py asks more, and takes 20 minutes of processor time.
"""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import coverage
import pytest

ROOT = Path(__file__).resolve().parent.parent
# The monitors of the vehicle's motion work on one state, and have their tests together.
ENVELOPE = (
    "tests/flight/test_envelope_velocity.py",
    "tests/flight/test_velocity_return.py",
    "tests/flight/test_envelope.py",
    "tests/flight/test_envelope_observer.py",
    "tests/flight/test_observer.py",
)
# The safety core, and the tests that must see every change of it.
TARGETS: dict[str, tuple[str, ...]] = {
    "uavctl/flight/fallback.py": ("tests/flight/test_fallback.py",),
    "uavctl/flight/limits.py": ("tests/flight/test_limits.py",),
    "uavctl/flight/monitors/acceleration.py": ENVELOPE,
    "uavctl/flight/monitors/approach.py": ("tests/flight/test_approach.py",),
    "uavctl/flight/monitors/braking.py": ENVELOPE,
    "uavctl/flight/monitors/engaged.py": ENVELOPE,
    "uavctl/flight/monitors/external.py": ("tests/flight/test_external_monitor.py",),
    "uavctl/flight/monitors/inertial.py": ("tests/flight/test_inertial_monitor.py",),
    "uavctl/flight/monitors/jumps.py": ("tests/flight/test_position_noise.py",),
    "uavctl/flight/monitors/motion.py": ENVELOPE,
    "uavctl/flight/monitors/noise.py": ("tests/flight/test_position_noise.py",),
    "uavctl/flight/monitors/observation.py": ENVELOPE,
    "uavctl/flight/monitors/observer.py": ENVELOPE,
    "uavctl/flight/monitors/outside.py": ("tests/flight/test_envelope.py", "tests/flight/test_response.py"),
    "uavctl/flight/monitors/smoothing.py": ("tests/flight/test_smoothing.py", "tests/flight/test_smoothing_rules.py"),
    "uavctl/flight/monitors/vehicle_velocity.py": ENVELOPE,
    "uavctl/flight/monitors/response.py": ("tests/flight/test_response.py",),
    "uavctl/flight/monitors/velocity.py": ENVELOPE,
    "uavctl/flight/monitors/velocity_change.py": ("tests/flight/test_velocity_change.py",),
    "uavctl/flight/monitors/verdict.py": (
        "tests/flight/test_inertial_monitor.py",
        "tests/flight/test_external_monitor.py",
    ),
    "uavctl/flight/monitors/outliers.py": ("tests/flight/test_reach_rules.py",),
    "uavctl/flight/monitors/frozen.py": ("tests/flight/test_frozen_rules.py", "tests/flight/test_samples.py"),
    "uavctl/mavlink/handover_states.py": ("tests/mavlink/test_mode.py",),
    "uavctl/mavlink/signing.py": ("tests/mavlink/test_signing.py", "tests/mavlink/test_gate.py"),
}


IMPORT = ""  # the context of what is run before the first test


def list_own_tests() -> list[str]:
    """Return the files of all own tests."""
    return list(dict.fromkeys(test for tests in TARGETS.values() for test in tests))


class FileContexts:
    """Plugin of pytest: attributes the branches that a test runs to the test's file."""

    def __init__(self, measured: coverage.Coverage) -> None:
        self._measured = measured

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Attribute all that follows to the file of a test that begins."""
        self._measured.switch_context(nodeid.partition("::")[0])


def measure_branches(data_file: str) -> int:
    """Run the own tests of all modules, each test once; write which branches each file's tests run."""
    measured = coverage.Coverage(data_file, branch=True, include=list(TARGETS))
    measured.start()
    code = pytest.main(["-q", "-n", "0", "-p", "no:cacheprovider", *list_own_tests()], plugins=[FileContexts(measured)])
    measured.stop()
    measured.save()
    return int(code)


def find_missing_branches() -> str:
    """Run the own tests in a process of its own; return its output if one fails, else what they do not run.

    A branch counts for a module only if one of the module's own tests runs it, or its import does.
    """
    with tempfile.TemporaryDirectory() as folder:
        data_file = f"{folder}/coverage"
        command = [sys.executable, __file__, data_file]
        done = subprocess.run(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
        )
        return done.stdout if done.returncode else report_missing_branches(data_file, TARGETS)


def report_missing_branches(data_file: str, targets: Mapping[str, Sequence[str]]) -> str:
    """Return the report of modules with a branch that their own tests do not run; empty if there is none."""
    reports = []
    for module, tests in targets.items():
        contexts = [f"^{re.escape(context)}$" for context in (IMPORT, *tests)]
        measured, text = coverage.Coverage(data_file), io.StringIO()
        measured.load()
        if measured.report(include=[module], contexts=contexts, show_missing=True, file=text) < 100.0:
            reports.append(text.getvalue())
    return "\n".join(reports)


if __name__ == "__main__":
    sys.exit(measure_branches(*sys.argv[1:]))
