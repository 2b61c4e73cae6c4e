"""The modules of the safety core and their own tests, which must run every branch of them.

`make test-all` asks that of each run; tools/mutation.py asks more, and takes 20 minutes of processor time.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# The monitors of the vehicle's motion work on one state, and have their tests together.
ENVELOPE = (
    "tests/flight/test_envelope_velocity.py",
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


def what_is_not_run(tests: tuple[str, ...]) -> str:
    """Run the tests of some modules alone, once; return what they printed if one fails or a branch is not run."""
    modules = ",".join(module for module, own in TARGETS.items() if own == tests)
    with tempfile.TemporaryDirectory() as folder:
        coverage = [sys.executable, "-m", "coverage"]
        data = f"--data-file={folder}/coverage"
        pytest = ["-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
        commands = (
            [*coverage, "run", data, "--branch", f"--include={modules}", *pytest],
            [*coverage, "report", data, "--show-missing", "--fail-under=100"],
        )
        for command in commands:
            done = subprocess.run(
                command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
            )
            if done.returncode != 0:
                return done.stdout
    return ""
