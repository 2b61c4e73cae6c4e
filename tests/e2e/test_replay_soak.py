"""A small part of what `tools/soak.py --scenario replay` flies: recordings with everything amiss decide alike again."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from draw_flight import draw_flight
from soak_replay import replay_seed, tally_flights

from logs.recording.reader import find_segments

SEEDS = (0, 5, 13, 14, 15)  # quick ones that together have what is asked for below


@pytest.mark.long
def test_flights_with_everything_amiss_replay_bit_for_bit(tmp_path: Path) -> None:
    results = [replay_seed(seed, tmp_path) for seed in SEEDS]
    assert {flight.seed: flight.result.first_difference for flight in results if not flight.is_identical} == {}
    had = {label for flight in results for label in flight.labels}
    assert {
        "px4",
        "ardupilot",
        "preset paper",
        "preset room-hahn-stursberg",
        "simulated quadrotor",
        "solver exact",
        "orders",
        "missed ticks",
        "late ticks",
        "strangers",
        "signed",
        "reboot",
        "one connection",
    } <= had
    observed = Counter[str]()
    for flight in results:
        observed.update(flight.record_counts)
    assert {f"Decision {mode}" for mode in ("wait", "track", "brake", "hold", "land", "stopped")} <= observed.keys()
    assert max(len(find_segments(flight.path)) for flight in results) > 1
    report = tally_flights(results)
    assert (report["replayed"], report["identical"], report["wrong"]) == (len(SEEDS), len(SEEDS), {})


@pytest.mark.slow
def test_a_flight_whose_replay_differs_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = 0

    def forgetful(*given: float) -> tuple[tuple[float, float, float], tuple[str, ...]]:
        # What a cache that is not part of the recording would do.
        nonlocal memory
        memory += 1
        return (1e-9 * memory, 0.0, 0.0), ()

    monkeypatch.setattr("uavctl.flight.act.limit_setpoint", forgetful)
    result = replay_seed(SEEDS[0], tmp_path)
    assert not result.is_identical
    report = tally_flights([result])
    assert report["identical"] == 0
    wrong = report["wrong"]
    assert isinstance(wrong, dict) and wrong[str(SEEDS[0])]["topic"] == "/uavctl/decision"


def test_a_seed_draws_the_same_flight_each_time() -> None:
    assert draw_flight(15) == draw_flight(15) != draw_flight(0)
