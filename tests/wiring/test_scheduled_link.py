"""Link model `scheduled`: the bound of the ages against the simulator's channel and the campaign's arrivals."""

from __future__ import annotations

import numpy as np
import pytest

from sim.channel import Channel
from uavctl.config import Config, load
from uavctl.errors import ConfigError, DesignError
from uavctl.lab.campaign.arrivals import compute_newest_captures
from uavctl.wiring.link import build_ages, build_delayed_link

STEPS, MAX_AGE = 2000, 30


def make_config(*overrides: str) -> Config:
    return load("room", ["link.model=scheduled", *overrides]).config


def test_messages_in_time_are_counted_by_hand() -> None:
    # Δt 0.05 s; 0.07 s on the way and 0.02 s of the cameras' period: (n 0.05 - 0.09) / 0.12 whole messages
    config = make_config("link.wait_s=0.12", "link.loss=0.3", "source.rate_hz=50")
    assert [build_ages(config).outage(n) for n in (0, 1, 4, 5, 6, 7, 12)] == pytest.approx(
        [1.0, 1.0, 1.0, 0.3, 0.3, 0.3**2, 0.3**4]
    )


@pytest.mark.parametrize("wait_s", [0.02, 0.05, 0.13, 0.3])
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_ages_on_the_simulators_channel_keep_the_bound(wait_s: float, loss: float) -> None:
    config = make_config(f"link.wait_s={wait_s}", f"link.loss={loss}", "source.rate_hz=100")
    channel = Channel(config.link, np.random.SeedSequence(425), 0)
    for number in range(5 * STEPS):
        channel.push(number * 10_000_000, str(number).encode())
    ages, newest_ns = [], 0
    for step in range(1, STEPS):
        for _, data in channel.pop_due(step * 50_000_000):
            newest_ns = max(newest_ns, int(data) * 10_000_000)
        ages.append(int((step * 50_000_000 - newest_ns) // 50_000_000))
    counted = np.array([np.mean(np.array(ages) >= n) for n in range(MAX_AGE)])
    bound = np.array([build_ages(config).outage(n) for n in range(MAX_AGE)])
    assert np.all(counted <= bound + (0.03 if loss else 1.5 / STEPS))  # of 2,000 correlated steps
    assert counted[1] >= 0.3 * bound[1]  # other ages than 0 occur as far as the bound allows


@pytest.mark.parametrize("wait_s", [0.02, 0.05, 0.13])
def test_ages_in_campaigns_keep_the_bound(wait_s: float) -> None:
    config = make_config(f"link.wait_s={wait_s}", "link.loss=0.3", "link.delay_s=0", "link.jitter_s=0.01")
    draws = np.random.default_rng(426).random((200, 401, 3))
    ages = np.arange(400) - compute_newest_captures(config.link, config.plant.dt_s, draws)
    for n in range(1, MAX_AGE):
        assert np.mean(ages[:, MAX_AGE:] >= n) <= build_ages(config).outage(n) + 0.01


def test_the_papers_scheme_needs_a_message_in_each_step() -> None:
    keys = ["link.model=scheduled", "link.loss=0.2", "source.rate_hz=100"]
    link = build_delayed_link(load("room-hahn-stursberg", [*keys, "link.wait_s=0.03", "link.jitter_s=0"]).config)
    dt_s = load("room-hahn-stursberg", []).config.plant.dt_s
    count = int((dt_s - load("room-hahn-stursberg", []).config.link.delay_s - 0.01) / 0.03)
    assert count >= 1 and link.outage(2) == pytest.approx(0.2 ** (2 * count))
    with pytest.raises(DesignError, match=r"link\.wait_s"):
        build_delayed_link(load("room-hahn-stursberg", [*keys, "link.wait_s=1.0"]).config)


def test_a_schedule_without_a_wait_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"link\.wait_s"):
        make_config()
