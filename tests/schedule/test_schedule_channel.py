"""The channel's budget: lengths on the wire, and no more messages than it carries in any interval."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavctl.schedule.channel import Budget, BudgetedChannel, compute_frame_bytes


def test_the_length_of_a_position_is_that_of_pymavlinks_frame() -> None:
    message = mavlink.MAVLink_vision_position_estimate_message(2**63 + 1, 1.1, 2.2, -3.3, 0.1, 0.2, 0.3, [0.0] * 21)
    mav = mavlink.MAVLink(None, 1, 1)
    assert len(message.pack(mav)) == compute_frame_bytes(signed=False) == 44
    mav.signing.secret_key, mav.signing.sign_outgoing, mav.signing.timestamp = b"k" * 32, True, 1
    assert len(message.pack(mav)) == compute_frame_bytes(signed=True)


def test_a_radio_of_57600_baud_carries_130_positions_a_second() -> None:
    # 10 bits a byte: start, eight, stop
    slot_ns = Budget(bytes_per_s=57_600 / 10).compute_slot_ns(compute_frame_bytes(signed=False))
    assert 10**9 // slot_ns == 130
    assert Budget(messages_per_s=50.0, bytes_per_s=1e6).compute_slot_ns(44) == 20_000_000


@given(pauses_ns=st.lists(st.integers(0, 30_000_000), min_size=1, max_size=200))
def test_no_interval_has_more_messages_than_the_budget_carries(pauses_ns: list[int]) -> None:
    channel, at_ns, starts_ns = BudgetedChannel(Budget(messages_per_s=100.0)), 0, []
    for pause_ns in pauses_ns:
        at_ns += pause_ns
        if channel.is_free(at_ns):
            channel.occupy(at_ns, 44)
            starts_ns.append(at_ns)
    for first, begin_ns in enumerate(starts_ns):
        for last, end_ns in enumerate(starts_ns[first:], 1):
            assert last <= (end_ns - begin_ns) / 10_000_000 + 2


def test_a_late_process_loses_no_budget() -> None:
    channel, at_ns = BudgetedChannel(Budget(messages_per_s=100.0)), 0
    for _ in range(100):
        at_ns += channel.compute_remaining_ns(at_ns) + 900_000  # woken 0.9 ms late each time
        channel.occupy(at_ns, 44)
    assert at_ns <= 99 * 10_000_000 + 2 * 900_000


def test_an_occupied_channel_takes_nothing() -> None:
    channel = BudgetedChannel(Budget(messages_per_s=100.0))
    channel.occupy(0, 44)
    with pytest.raises(ValueError, match="is_free"):
        channel.occupy(9_999_999, 44)
    channel.occupy(10_000_000, 44)
