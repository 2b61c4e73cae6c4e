"""What a flight believes of its link: an estimate at each boundary, and an event when the link is not as promised."""

from __future__ import annotations

from flight_rig import MS, TICKS, boundary_ns, make_controller, make_inputs, run, sample

from uavctl.flight.tick import TickOutput

STEPS = 120


def outputs(lost: set[int]) -> list[TickOutput]:
    """A flight with one position 10 ms before each boundary, but for those of the steps `lost`."""
    samples = [sample(boundary_ns(k) - 10 * MS, boundary_ns(k) - 5 * MS) for k in range(STEPS) if k not in lost]
    return run(make_controller(), make_inputs(range(STEPS * TICKS), samples))


def test_each_boundary_after_the_first_position_counts_once() -> None:
    found = outputs(lost={3, 4, 50})
    links = [(output.decision.step, output.link) for output in found if output.link is not None]
    assert [step for step, _ in links] == list(range(STEPS))
    assert all(output.decision.boundary for output in found if output.link is not None)
    last = links[-1][1]
    assert last is not None
    assert last.at_ns == boundary_ns(STEPS - 1)
    assert 0.9 < last.arrival_mean < 1.0  # 117 of 120, the older the less
    assert last.arrival_lower < last.arrival_mean
    assert not last.below_promise


def test_a_link_worse_than_promised_is_told_once() -> None:
    found = outputs(lost={k for k in range(STEPS) if k % 3 and k > 2})  # one in three, promised is every second
    told = [event.code for output in found for event in output.events if event.code.startswith("link-")]
    assert told.count("link-below-promise") == 1
    last = found[-TICKS].link
    assert last is not None
    assert last.below_promise


def test_losses_in_runs_are_told_as_bursts() -> None:
    found = outputs(lost={k for k in range(STEPS) if k % 20 >= 14})
    assert "link-bursts" in [event.code for output in found for event in output.events]
    even = outputs(lost={k for k in range(STEPS) if k % 20 in (3, 9, 17)})
    assert "link-bursts" not in [event.code for output in even for event in output.events]
