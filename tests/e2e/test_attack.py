"""The daemon as a process, stopped by a signal while the pilot takes over; `tools/attack.py` does it many times."""

from __future__ import annotations

import pytest
from attack_rig import stalls

from uavctl.build.controller import build_design
from uavctl.build.library import library_for
from uavctl.config import load_config


@pytest.fixture(scope="module", autouse=True)
def _library() -> None:
    """The daemon finds the policy library in the cache."""
    library_for(build_design(load_config("room-hahn-stursberg")))


@pytest.mark.slow
@pytest.mark.fault(49)
def test_a_daemon_that_was_stopped_sends_nothing_to_a_vehicle_that_the_pilot_has() -> None:
    assert [row["setpoints"] for row in stalls(1, 3, 600.0, signed=True)] == [0]
