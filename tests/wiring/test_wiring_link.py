"""The link of a configuration: its model, against counting, the simulator's channel and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.channel import Channel
from uavctl.config import Config, load_config
from uavctl.errors import ConfigError, DesignError
from uavctl.wiring.controller import build_design, build_spec
from uavctl.wiring.link import PacketCounts, build_link, compute_promised_probability, count_packets_per_step

BURSTS = ["link.model=gilbert-elliott", "link.burst_enter=0.1", "link.burst_leave=0.4", "link.burst_loss=0.8"]
RUNS = ["link.model=empirical", "link.gaps=[0.7, 0.1, 0.05, 0.15]"]
STEP_NS = 1_000_000_000


@pytest.mark.parametrize(
    ("preset", "overrides", "p"),
    [
        ("paper", [], 0.7),
        ("room-hahn-stursberg", [], 0.7),
        ("room-hahn-stursberg", ["link.loss=0"], 1.0),
        # Two of four samples in 0.2 s are sure to arrive within 0.03 + 0.04 s of delay: 1 - 0.3².
        ("room-hahn-stursberg", ["source.rate_hz=20"], 0.91),
        ("room-hahn-stursberg", ["source.rate_hz=20", "link.delay_s=0.07"], 0.7),
        ("paper", ["source.rate_hz=10"], 1.0 - 0.3**10),
        # What the simulator's cameras do is no assumption of the design.
        ("room-hahn-stursberg", ["sim.camera.rate_hz=20", "sim.camera.latency_s=0.1"], 0.7),
        # A fifth of the time in the bad state: 0.8 · 0.1 + 0.2 · 0.8 lost.
        ("paper", [*BURSTS, "link.loss=0.1"], 0.76),
        # Two packets in a row: both good 0.8 · 0.9, one of each 0.8 · 0.1 + 0.2 · 0.4, both bad 0.2 · 0.6.
        ("paper", [*BURSTS, "link.loss=0.1", "source.rate_hz=2"], 1.0 - (0.72 * 0.01 + 0.16 * 0.08 + 0.12 * 0.64)),
        ("paper", [*BURSTS, "link.burst_enter=0"], 0.7),
        # Another model's keys are without effect.
        ("paper", [*BURSTS, "link.model=bernoulli"], 0.7),
        ("paper", [*RUNS, "link.model=bernoulli"], 0.7),
        ("paper", [*BURSTS, "link.loss=0.1", "link.probability=[0.1]"], 0.76),
        # One arrives in 1 + (0.1 + 2 · 0.05 + 3 · 0.15) packets; right after one that did, with 0.7.
        ("paper", RUNS, 1.0 / 1.65),
        ("paper", ["link.probability=[0.1, 0.6, 0.9, 0.8]"], 0.6),
        ("room-hahn-stursberg", ["link.probability=[0.5]", "source.rate_hz=20"], 0.75),
    ],
)
def test_the_link_s_probability_counts_samples_that_are_in_time(preset: str, overrides: list[str], p: float) -> None:
    config = load_config(preset, overrides)
    assert compute_promised_probability(build_link(config)) == pytest.approx(p, abs=1e-12)
    assert 1.0 - build_spec(config).link.outage(1) >= compute_promised_probability(build_link(config)) - 1e-15


@pytest.mark.parametrize(
    ("overrides", "packets"),
    [
        (["source.rate_hz=0"], PacketCounts(1, 0)),
        (["source.rate_hz=20"], PacketCounts(2, 2)),
        (["source.rate_hz=20", "link.jitter_s=0", "link.delay_s=0"], PacketCounts(4, 0)),
        (["source.rate_hz=100"], PacketCounts(13, 7)),
    ],
)
def test_packets_of_a_step_that_come_too_late_are_not_counted_on(overrides: list[str], packets: PacketCounts) -> None:
    assert count_packets_per_step(load_config("room-hahn-stursberg", overrides)) == packets


def test_what_a_design_for_the_whole_flight_counts_on_is_the_least_of_what_is_ahead() -> None:
    config = load_config("paper", ["link.probability=[0.2, 0.9, 0.6, 0.8, 0.7, 0.95, 0.99]"])
    link = build_link(config)
    # p(1), p(2) …: min of the rest of the list. p(0), of the packet that is there already, is not asked for.
    assert link.arrived[:, 0, 0].tolist() == pytest.approx([0.6, 0.6, 0.7, 0.7, 0.95, 0.99])
    p = np.array(config.link.probability)
    for k in range(8):
        exact = [p[min(k + t, 6)] for t in range(1, 7)]
        assert np.all(link.arrived[:, 0, 0] <= exact)


@pytest.mark.parametrize(
    ("overrides", "key", "figures"),
    [
        (["link.delay_s=0.5"], "link.delay_s", r"0\.5 \+ 0\.04 s .* step of 0\.2 s"),
        (["link.delay_s=0.125", "link.jitter_s=0.075"], "link.delay_s", r"0\.125 \+ 0\.075 s"),
        (["link.delay_s=0.16", "source.rate_hz=50"], "link.delay_s", r"0\.16 \+ 0\.04 s"),
        (["source.rate_hz=5"], "source.rate_hz", r"5 positions a second .* 0\.13 s .* at least 7\.692"),
        (["source.rate_hz=50", "link.delay_s=0.15"], "source.rate_hz", r"50 positions .* 0\.01 s .* at least 100"),
    ],
)
def test_a_link_that_no_position_crosses_in_time_is_refused(overrides: list[str], key: str, figures: str) -> None:
    with pytest.raises(DesignError, match=figures) as caught:
        build_link(load_config("room-hahn-stursberg", overrides))
    assert caught.value.key == key


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["link.model=gilbert-elliott", "link.burst_leave=0"], r"--set .*: link\.burst_leave: expected .* > 0"),
        (["link.model=empirical"], r"paper\.toml:\d+: link\.gaps: is missing, and model \"empirical\" needs it"),
        (["link.model=empirical", "link.gaps=[0.7, 0.2]"], r"--set link\.gaps.*: link\.gaps: .* add up to 0\.9,"),
        (["link.model=empirical", "link.gaps=[1.2, -0.2]"], r"link\.gaps\[0\]: expected .* <= 1"),
        (["link.model=empirical", "link.gaps=[nan]"], r"link\.gaps"),
        (["link.probability=[0.5, 1.5]"], r"link\.probability\[1\]: expected .* <= 1"),
        (["link.probability=[0.5, 0.0]"], r"link\.probability: ends in 0"),
        (["link.probability=0.5"], r"link\.probability: expected a list"),
        (["link.model=markov"], r"link\.model: \"markov\" is not a choice"),
        (["link.gap=[1.0]"], r"link\.gap: unknown key \(nearest valid name \"gaps\"\)"),
    ],
)
def test_an_impossible_link_is_reported_with_its_key(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_config("paper", overrides)


def test_rounded_shares_are_taken_as_they_are_meant() -> None:
    config = load_config("paper", ["link.model=empirical", "link.gaps=[0.333333, 0.333333, 0.333333]"])
    assert build_link(config).outage(1) == pytest.approx(0.5)


def simulate_arrivals(config: Config, packets: int, seed: int) -> NDArray[np.bool_]:
    """Which packets the simulated channel lets through, one each second."""
    channel = Channel(config.link, np.random.SeedSequence(seed), 0, STEP_NS)
    for n in range(packets):
        channel.push(n * STEP_NS, n.to_bytes(8, "little"))
    through = np.zeros(packets, dtype=np.bool_)
    through[[int.from_bytes(data, "little") for _, data in channel.pop_due(2 * packets * STEP_NS)]] = True
    return through


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        ["link.loss=0.3"],
        [*BURSTS, "link.loss=0.1"],
        ["link.model=gilbert-elliott", "link.loss=0", "link.burst_enter=0.05", "link.burst_leave=0.25"],
        RUNS,
    ],
)
@pytest.mark.parametrize("rate_hz", [0, 3])
def test_the_model_counts_on_what_the_simulated_channel_does(overrides: list[str], rate_hz: int) -> None:
    config = load_config("paper", [*overrides, f"source.rate_hz={rate_hz}"])
    link, packets = build_link(config), max(1, rate_hz)
    steps = np.asarray(simulate_arrivals(config, 60_000, seed=3).reshape(-1, packets).any(axis=1), dtype=np.bool_)
    base = np.flatnonzero(steps[:-8])
    count = len(base)
    for lost in range(1, 6):
        # After a step with news: none of the next `lost` brings any.
        share = np.mean([not steps[b + 1 : b + 1 + lost].any() for b in base])
        expected = link.age(lost)[lost, lost]
        assert abs(share - expected) < 5.0 * np.sqrt(expected * (1.0 - expected) / count) + 1e-12
    # The long run: bursts make steps depend on each other, which at most trebles the deviation here.
    for lost in (1, 3):
        gone = np.asarray(np.lib.stride_tricks.sliding_window_view(~steps, lost).all(axis=1), dtype=np.float64)
        expected = link.outage(lost)
        assert abs(gone.mean() - expected) <= 15.0 * np.sqrt(expected * (1.0 - expected) / len(gone))


def test_the_simulated_channel_follows_the_probabilities_step_by_step() -> None:
    config = load_config("paper", ["link.probability=[0.0, 1.0, 0.25, 0.75]"])
    through = np.mean([simulate_arrivals(config, 6, seed) for seed in range(2000)], axis=0)
    expected = np.array([0.0, 1.0, 0.25, 0.75, 0.75, 0.75])
    assert np.all(np.abs(through - expected) <= 5.0 * np.sqrt(expected * (1.0 - expected) / 2000))


@pytest.mark.parametrize(
    ("overrides", "key", "message"),
    [
        # 22.9 % are lost in the mean. One by one, the preset's delays of 5 steps make nothing of it; in bursts of
        # 3.3 packets, more than 3 % of all positions are more than four steps old.
        (["link.loss=0.1", "link.burst_enter=0.05", "link.burst_leave=0.3"], "smpc.delta_x", r"0\.95 is out of reach"),
        # The likelihoods would do with 11.8 % lost, but P(a <= τ = 4) is 0.9984.
        (
            ["link.loss=0.1", "link.burst_enter=0.01", "link.burst_leave=0.5", "smpc.delta_tau=0.9995"],
            "smpc.delta_tau",
            r"Assumption 4\.1",
        ),
    ],
)
def test_bursts_that_the_mean_loss_hides_are_refused(overrides: list[str], key: str, message: str) -> None:
    config = load_config("room-hahn-stursberg", ["link.model=gilbert-elliott", *overrides])
    with pytest.raises(DesignError, match=message) as caught:
        build_design(config)
    assert caught.value.key == key


def test_a_design_for_bursts_has_wider_back_offs_than_one_for_their_mean_loss() -> None:
    few = ["link.loss=0.05", "link.burst_enter=0.02", "link.burst_leave=0.5"]
    bursts = build_design(load_config("room-hahn-stursberg", ["link.model=gilbert-elliott", *few]))
    mean = build_design(load_config("room-hahn-stursberg", [f"link.loss={0.05 * 25 / 26 + 1 / 26}"]))
    assert bursts.schedule.alpha.min() < mean.schedule.alpha.min() < 1.0
    assert np.all(bursts.kappa_x >= mean.kappa_x)
    assert bursts.assumptions[0].value < mean.assumptions[0].value
