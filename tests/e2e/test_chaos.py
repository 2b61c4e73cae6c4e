"""The figures of the table of faults, over a part of the ticks; `tools/soak.py` runs all of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaos import run_ticks, soak_core

from uavctl.event_codes import EventCode
from uavctl.records import ControlMode, Vec3


@pytest.mark.slow
@pytest.mark.fault(3)
def test_the_fallback_takes_over_in_the_tick_in_which_the_age_reaches_the_horizon_and_in_no_later_one() -> None:
    count = soak_core(6_000, seed=3, orders=False)
    assert count.late == 0
    assert count.ticks == 6_000
    assert count.falls > 12


@pytest.mark.slow
@pytest.mark.fault(24)
@pytest.mark.parametrize("seed", [24])
def test_every_setpoint_is_finite_bounded_and_slew_limited_with_faults_of_all_kinds(seed: int) -> None:
    count = soak_core(6_000, seed=seed)
    assert (count.unsound, count.late) == (0, 0)
    assert count.flights > 5


@pytest.mark.slow
def test_the_random_flights_see_every_mode_refusal_and_answer() -> None:
    modes, codes = set(), set()
    for _, output, _ in run_ticks(np.random.default_rng(1), 10_000, orders=True):
        modes.add(output.decision.mode)
        codes |= {event.code for event in output.events}
    assert modes == set(ControlMode)
    wanted = {"sample-jump", "sample-invalid", "sample-future", "sample-duplicate", "missed-ticks", "solve-late"}
    assert codes >= wanted | {"solve-infeasible", "solve-failed", EventCode.ORDER_ACCEPTED, EventCode.ORDER_REFUSED}


@pytest.mark.parametrize("planted", [(2.1, 0.0, 0.0), (math.nan, 0.0, 0.0), (0.0, 0.0, -1.6)])
def test_a_planted_bug_is_counted(planted: Vec3, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "uavctl.flight.act.limit_setpoint", lambda want, *_: (planted if want[0] < -1.0 else (0.0, 0.0, 0.0), ())
    )
    assert soak_core(500, seed=24, orders=False).unsound > 0
