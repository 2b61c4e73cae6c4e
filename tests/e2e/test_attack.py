"""The daemon as a process, stopped by a signal while the pilot takes over; `tools/attack.py` does it many times."""

from __future__ import annotations

import pytest
from attack_rig import run_stalls


@pytest.mark.slow
@pytest.mark.fault(49)
def test_a_daemon_that_was_stopped_sends_nothing_to_a_vehicle_that_the_pilot_has() -> None:
    assert [row["setpoints"] for row in run_stalls(1, 3, 600.0, signed=True)] == [0]
