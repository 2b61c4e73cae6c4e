"""The simulated autopilot's doubts: pre-flight checks that flicker, a position not valid, a failsafe that ends."""

from __future__ import annotations

import pytest
from sim_rig import decode
from take_off_rig import TakeOffRig

from sim.autopilot.checks import PreflightChecks
from uavctl.config import load_config
from uavctl.config.sim import ChecksConfig
from uavctl.errors import ConfigError
from uavctl.mavlink.handover_states import HandoverState

UNINIT, STANDBY, ACTIVE, CRITICAL = 0, 3, 4, 5


def statuses(flight: TakeOffRig, seconds: float) -> list[int]:
    """The system status of the vehicle's heartbeats."""
    found: list[int] = []

    def note(data: bytes) -> bool:
        found.extend(m.system_status for m in decode(data) if m.get_type() == "HEARTBEAT")
        return True

    flight.told = note
    flight.run(seconds)
    return found


@pytest.mark.fault(60)
def test_px4_stands_by_only_while_its_checks_pass_and_ardupilot_always() -> None:
    px4 = statuses(TakeOffRig("px4", "sim.checks.flicker_s=1.0"), 30.0)
    assert set(px4) == {UNINIT, STANDBY} and px4.count(UNINIT) > 4
    assert set(statuses(TakeOffRig("px4"), 5.0)) == {STANDBY}
    assert set(statuses(TakeOffRig("ardupilot", "sim.checks.flicker_s=1.0"), 30.0)) == {STANDBY}


@pytest.mark.fault(60)
@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_while_they_fail_it_does_not_arm_and_says_why(autopilot: str) -> None:
    flight = TakeOffRig(autopilot, "sim.checks.flicker_s=1.0").take_off()
    flight.run(60.0, until=HandoverState.CLIMBING)
    refused = [event for event in flight.texts if "COMPONENT_ARM_DISARM: " in event and "ACCEPTED" not in event]
    assert bool(refused) == any("system health" in text or "Internal errors" in text for text in flight.texts)


@pytest.mark.parametrize(("clears", "after"), [(True, "AUTO.TAKEOFF"), (False, "AUTO.LAND")])
def test_px4_is_back_in_its_take_off_when_its_position_is_valid_again_where_that_is_asked_for(
    clears: bool, after: str
) -> None:
    flight = TakeOffRig("px4", "sim.checks.invalid=[[0.5, 1.5]]", f"sim.checks.clears={str(clears).lower()}").take_off()
    flight.run(10.0, until=HandoverState.CLIMBING)
    said = statuses(flight, 1.4)
    assert flight.peers.autopilot.mode_name == "AUTO.LAND" and CRITICAL in said
    flight.run(0.6)
    assert flight.peers.autopilot.mode_name == after


def test_nothing_is_drawn_or_looked_at_unless_asked_for() -> None:
    autopilot = TakeOffRig("px4").peers.autopilot
    assert isinstance(autopilot._checks, PreflightChecks) and autopilot._checks.next_ns is None
    assert ChecksConfig() == load_config("room").sim.checks


@pytest.mark.parametrize(
    "override", ["sim.checks.invalid=[[2.0, 1.0]]", "sim.checks.flicker_s=-1.0", "sim.checks.clears=true"]
)
def test_what_has_no_meaning_is_refused(override: str) -> None:
    with pytest.raises(ConfigError):
        load_config("room", ["sim.autopilot=ardupilot", override])
