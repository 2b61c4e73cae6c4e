"""The scene of the live page: what it shows of a flight."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from view_rig import fly_view

from logs.live.scene import FlightScene
from logs.recording.design_view import read_design
from uavctl.config import parse
from uavctl.records import Decision, Estimate, Event, Header, Plan, Record, Truth


def test_it_shows_what_the_records_say() -> None:
    """At each decision of a recorded flight, beside the records themselves."""
    seen, newest, shown = FlightScene(), dict[type[Record], Any](), 0
    (header,) = fly_view().of(Header)
    design, title = read_design(header), f"uavctl: {parse(header.config_toml, 'flight').config.name}"
    for _, _, record in fly_view().entries:
        seen.add_record(record)
        newest[type(record)] = record
        if not isinstance(record, Decision):
            continue
        found = seen.scene()
        assert found is not None
        estimate, truth = newest.get(Estimate), newest.get(Truth)
        assert found.title == title
        places = {body.name: body.at_m for body in found.bodies}
        assert found.time_s == pytest.approx((record.at_ns - header.started_ns) * 1e-9)
        assert found.age_s == (None if estimate is None else pytest.approx(estimate.age_s))
        assert places.get("estimate") == (None if estimate is None else design.position_of(estimate.mean))
        assert places.get("truth") == (None if truth is None else truth.position_m)
        if found.plan:
            plan = newest[Plan]
            assert plan.seq == record.plan_seq
            assert np.array_equal(found.plan, design.positions_of(np.array(plan.states)))
            assert found.box is not None and found.margins is not None
            sides = zip(found.box.lower_m, found.margins.lower_m, found.margins.upper_m, found.box.upper_m, strict=True)
            for low, tight_low, tight_high, high in sides:
                assert low is None or (tight_low is not None and low <= tight_low)
                assert high is None or (tight_high is not None and tight_high <= high)
            shown += 1
    assert shown > 10


def test_there_is_nothing_to_see_before_the_first_decision() -> None:
    seen = FlightScene()
    for _, _, record in fly_view().entries:
        if isinstance(record, Decision):
            break
        seen.add_record(record)
    assert seen.scene() is None


def test_newest_messages_come_first_and_old_ones_go() -> None:
    seen = FlightScene()
    rows = [record for _, _, record in fly_view().entries if isinstance(record, Header | Decision)]
    for record in rows[:2]:
        seen.add_record(record)
    for number in range(100):
        seen.add_record(Event(at_ns=number, severity="info", code="a", text=str(number)))  # type: ignore[arg-type]
    found = seen.scene()
    assert found is not None
    assert [one.text for one in found.events] == [str(number) for number in range(99, 99 - len(found.events), -1)]
    assert 1 < len(found.events) < 100
