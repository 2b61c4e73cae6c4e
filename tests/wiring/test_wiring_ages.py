"""The ages that risk is conditioned on: against the campaign's own links, in the long run."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.errors import DesignError
from uavctl.lab.campaign.arrivals import compute_newest_captures
from uavctl.lab.campaign.draws import draw
from uavctl.wiring.controller import build_conditioned
from uavctl.wiring.link import build_ages, build_delayed_link

RUNS, STEPS, OLDEST = 20_000, 80, 12

BURSTS = ["link.model=gilbert-elliott", "link.burst_enter=0.142857", "link.burst_leave=0.333333"]
SOFT_BURSTS = [*BURSTS, "link.loss=0.1", "link.burst_loss=0.8"]
GAPS = ["link.model=empirical", "link.gaps=[0.6, 0.25, 0.05, 0.1]"]
TRACE = ["link.model=trace", "link.trace_s=[0.2, 1.4, inf, 0.1, 2.6, inf, inf, 0.7, 1.2]"]
LATE = ["link.delay_s=0.5", "link.jitter_s=2.0"]
LINKS = {
    **{f"{loss} %": [f"link.loss={loss / 100}"] for loss in (10, 30, 60, 90)},
    "1 s": ["link.loss=0.1", "link.delay_s=1.0"],
    "up to 2 s": ["link.loss=0.1", "link.jitter_s=2.0"],
    "1 s to 3 s, half lost": ["link.loss=0.5", "link.delay_s=1.0", "link.jitter_s=2.0"],
    "bursts": BURSTS,
    "bursts that let some through": SOFT_BURSTS,
    "bursts, late": [*SOFT_BURSTS, *LATE],
    "bursts of all, 1 s late": [*BURSTS, "link.delay_s=1.0"],
    "runs as measured": GAPS,
    "runs as measured, late": [*GAPS, *LATE],
    "as measured, late": [*TRACE, "link.delay_s=2.6"],
}  # fmt: skip


def make_config(*overrides: str) -> Config:
    return load_config("paper", ["smpc.scheme=age-conditioned", "smpc.horizon=60", *overrides])


@cache
def compute_chances() -> Array:
    return draw(17, 0, RUNS, STEPS, 1).link


@pytest.mark.slow
@pytest.mark.parametrize("name", LINKS)
def test_ages_are_those_of_the_campaign_s_link(name: str) -> None:
    given = make_config(*LINKS[name])
    age = STEPS - 1 - compute_newest_captures(given.link, 1.0, compute_chances())[:, -1]
    model = build_ages(given)
    for steps in range(OLDEST):
        share, expected = float(np.mean(age >= steps)), model.outage(steps)
        # Runs are independent: five standard deviations of a share, of one run at least where there is chance in it.
        spread = max(expected * (1.0 - expected), 1.0 / RUNS) if 1e-12 < expected < 1.0 - 1e-12 else 0.0
        assert abs(share - expected) <= 5.0 * np.sqrt(spread / RUNS) + 1e-9, steps
    assert build_conditioned(given, for_flight=False).solver.risk.older_probability == model.outage(60)


@pytest.mark.parametrize("loss", [0.3, 0.8])
def test_a_channel_without_memory_has_the_ages_of_independent_losses(loss: float) -> None:
    chain = ["link.model=gilbert-elliott", f"link.loss={loss}", f"link.burst_loss={loss}", "link.burst_enter=0.3"]
    first, second = (build_ages(make_config(*LATE, *given)) for given in (chain, [f"link.loss={loss}"]))
    for steps in range(OLDEST):
        assert first.outage(steps) == pytest.approx(second.outage(steps), rel=1e-12)


def test_several_positions_of_a_step_come_one_after_the_other() -> None:
    """A chain without memory at 2 Hz, by hand: each position with the time that it has had."""
    chain = ["link.model=gilbert-elliott", "link.loss=0.4", "link.burst_loss=0.4", "link.burst_enter=0.3"]
    model = build_ages(make_config(*chain, *LATE, "source.rate_hz=2"))
    had_s = np.array([[0.0, 0.5], [1.0, 1.5], [2.0, 2.5]])
    gone = (0.4 + 0.6 * np.clip((2.5 - had_s) / 2.0, 0.0, 1.0)).prod(axis=1)
    assert [model.outage(steps) for steps in range(4)] == pytest.approx([1.0, *np.cumprod(gone)])


@pytest.mark.slow
def test_losses_known_ahead_count_as_the_worst_of_them_in_every_step() -> None:
    given = make_config("link.probability=[0.4, 0.9, 0.6]")
    known = compute_newest_captures(given.link, 1.0, compute_chances())
    model = build_ages(given)
    for step in (1, 2, 5, 40):
        for steps in range(1, 6):
            assert np.mean(step - known[:, step] >= steps) <= model.outage(steps) + 5.0 * 0.5 / np.sqrt(RUNS)
    assert model.outage(2) == pytest.approx(0.6**2)


@pytest.mark.parametrize(
    ("overrides", "key", "message"),
    [
        ([*TRACE, "link.delay_s=2.6", "source.rate_hz=2"], "source.rate_hz", "2 positions a step"),
        ([*BURSTS, "link.delay_s=2.0", "source.rate_hz=0.5"], "source.rate_hz", "are not one a step"),
        (["link.model=trace", "link.trace_s=[5.0, inf]", "link.delay_s=2.0"], "link.delay_s", "quickest: 5 s"),
    ],
)
def test_what_cannot_be_counted_on_is_refused(overrides: list[str], key: str, message: str) -> None:
    with pytest.raises(DesignError, match=message) as caught:
        build_ages(make_config(*overrides))
    assert caught.value.key == key


def test_the_other_scheme_names_the_model_for_late_bursts() -> None:
    with pytest.raises(DesignError, match="age-conditioned"):
        build_delayed_link(load_config("paper", [*BURSTS, *LATE]))
