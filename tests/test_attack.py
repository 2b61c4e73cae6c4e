"""The daemon as a process under hostile datagrams, and stopped while the pilot takes over."""

from __future__ import annotations

import pytest
from attack_rig import attacks, stalls

from uavctl.build import build_design
from uavctl.config import load_config
from uavctl.library_store import library_for


@pytest.fixture(scope="module", autouse=True)
def _library() -> None:
    """The daemon finds the policy library in the cache."""
    library_for(build_design(load_config("room")))


def test_a_daemon_that_was_stopped_sends_nothing_to_a_vehicle_that_the_pilot_has() -> None:
    assert [row["setpoints"] for row in stalls(1, 3, 600.0, signed=True)] == [0]


def test_datagrams_full_of_foreign_frames_are_refused_and_the_vehicle_is_flown_on() -> None:
    (row,) = attacks(["foreign-heartbeats"], seconds=1.0, senders=16, listed=True, signed=False, per_s=500.0)
    # All of them, as none of the vehicle's or the cameras' was: what a flight cannot send is not looked into.
    assert set(row["refused"]) == {"too-much"}
    assert row["refused"]["too-much"] > 1000 and row["ticks"] > 0
