"""Names and numbers of modes."""

from __future__ import annotations

import pytest

from sim.autopilot.profile import SIMULATED, make_px4_custom_mode
from uavctl.mavlink.profile import PROFILES, describe_mode, find_autopilot_name


@pytest.mark.parametrize(
    ("autopilot", "kind", "custom", "name", "external"),
    [
        ("px4", 2, 6 << 16, "OFFBOARD", True),
        ("px4", 2, 4 << 16 | 3 << 24, "AUTO.LOITER", False),
        ("px4", 2, 4 << 16 | 6 << 24, "AUTO.LAND", False),
        ("px4", 2, 4 << 16 | 99 << 24, "AUTO.99", False),
        ("px4", 2, 3 << 16, "POSCTL", False),
        ("px4", 2, 77 << 16, "MODE_77", False),
        ("px4", 2, 4, "MODE_0", False),
        ("ardupilot", 2, 4, "GUIDED", True),
        ("ardupilot", 13, 4, "GUIDED", True),
        ("ardupilot", 2, 9, "LAND", False),
        ("ardupilot", 2, 5, "LOITER", False),
        ("ardupilot", 2, 0, "STABILIZE", False),
        ("ardupilot", 2, 20, "GUIDED_NOGPS", False),
        ("ardupilot", 2, 29, "MODE_29", False),
        ("ardupilot", 1, 4, "ACRO", False),  # a plane: 4 is not GUIDED there
        ("ardupilot", 1, 15, "GUIDED", False),  # and its GUIDED takes no setpoint of ours
        ("ardupilot", 21, 18, "QHOVER", False),
        ("ardupilot", 10, 4, "HOLD", False),
        ("ardupilot", 11, 12, "SMART_RTL", False),
        ("ardupilot", 12, 9, "SURFACE", False),
        ("ardupilot", 12, 4, "GUIDED", False),
        ("ardupilot", 7, 1, "MODE_1", False),
        ("ardupilot", 2, 6 << 16, "MODE_393216", False),
        ("unknown", 2, 4, "MODE_4", False),
    ],
)
def test_mode_names(autopilot: str, kind: int, custom: int, name: str, external: bool) -> None:
    assert describe_mode(autopilot, kind, custom) == (name, external)


@pytest.mark.parametrize(("number", "name"), [(12, "px4"), (3, "ardupilot"), (0, "unknown"), (8, "unknown")])
def test_autopilots(number: int, name: str) -> None:
    assert find_autopilot_name(number) == name


@pytest.mark.parametrize("autopilot", PROFILES)
def test_the_modes_that_are_asked_for_are_those_that_are_shown(autopilot: str) -> None:
    profile = PROFILES[autopilot]
    assert {profile.external_mode, profile.take_off_mode} == set(profile.mode_parameters)
    for name, (first, second) in profile.mode_parameters.items():
        custom = make_px4_custom_mode(first, second) if autopilot == "px4" else first
        assert describe_mode(autopilot, 2, custom) == (name, name == profile.external_mode)
        shown = SIMULATED[autopilot].get_mode_by_number(custom)
        assert shown is not None and shown.name == name
    assert not profile.climb_modes & profile.landing_modes
