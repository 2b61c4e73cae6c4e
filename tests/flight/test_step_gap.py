"""A long gap between ticks: what is sent after it, and when plans fly again."""

from __future__ import annotations

import msgspec
import pytest
from flight_rig import (
    START_NS,
    TICK_NS,
    TICKS,
    list_modes,
    make_controller,
    make_inputs,
    make_step_samples,
    run,
    vehicle,
)

from uavctl.flight.context import GAP_NS
from uavctl.flight.tick import TickOutput
from uavctl.records import ControlMode, VehicleStatus

BEGIN = 3 * TICKS
SHORT = GAP_NS // TICK_NS  # ticks from one that runs to the next
HEARD = BEGIN + SHORT + 8  # the first tick after the heartbeat
LAST = HEARD + 300

WAIT, TRACK, BRAKE, HOLD, LAND, STOPPED = ControlMode


def fly(ticks_apart: int, *, external: bool = True, stop_from: int | None = None) -> dict[int, TickOutput]:
    """Fly with one gap; heartbeats come when it ends, and again in tick `HEARD`."""
    end = BEGIN + ticks_apart

    def status(tick: int) -> VehicleStatus:
        at_ns = START_NS + (0 if tick < end else end if tick < HEARD else HEARD) * TICK_NS
        return msgspec.structs.replace(
            vehicle(external=external or tick < HEARD), at_ns=at_ns + TICK_NS // 2 if tick >= end else at_ns
        )

    ticks = [tick for tick in range(LAST) if not BEGIN < tick < end]
    outputs = run(make_controller(), make_inputs(ticks, make_step_samples(), status=status, stop_from=stop_from))
    return dict(zip(ticks, outputs, strict=True))


@pytest.mark.fault(105)
def test_after_a_long_gap_nothing_is_sent_until_a_newer_heartbeat() -> None:
    outputs = fly(SHORT + 1)
    silent = [tick for tick, output in outputs.items() if output.setpoint is None]
    assert silent == list(range(BEGIN + SHORT + 1, HEARD))
    assert not any(outputs[tick].land for tick in silent)
    assert outputs[HEARD + TICKS].decision.mode is TRACK


@pytest.mark.fault(105)
def test_a_gap_within_which_the_vehicle_waits_ends_with_a_setpoint() -> None:
    assert all(output.setpoint is not None for output in fly(SHORT).values())


@pytest.mark.fault(105)
def test_a_heartbeat_that_shows_another_mode_ends_control() -> None:
    outputs = fly(SHORT + 1, external=False)
    assert set(list_modes([output for tick, output in outputs.items() if tick > BEGIN])) == {WAIT}


@pytest.mark.fault(105)
@pytest.mark.parametrize("stop_from", [BEGIN, BEGIN + SHORT + 3])
def test_a_stop_before_or_after_the_gap_lands_once_the_vehicle_is_heard(stop_from: int) -> None:
    outputs = fly(SHORT + 1, stop_from=stop_from)
    assert next(tick for tick, output in outputs.items() if output.land) >= HEARD
    assert all(outputs[tick].setpoint is None for tick in range(BEGIN + SHORT + 1, HEARD))
    assert list_modes(list(outputs.values()))[-1] is STOPPED
