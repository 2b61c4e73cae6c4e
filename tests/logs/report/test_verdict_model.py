"""The verdict on the model: a right one passes, a wrong one is found, and the filter is the flight's own."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from loopback_rig import lockstep
from verdict_rig import room, simulate_model

from logs.recording.flight import FlightData
from logs.report.innovations import FilterReplay, InnovationSamples, compute_innovations
from logs.report.verdict_model import LAGS, MIN_ERRORS, judge_innovations
from logs.report.verdicts import judge_flight
from uavctl.arrays import Array
from uavctl.config import load_config
from uavctl.flight.kalman import make_kalman
from uavctl.records import ControlMode
from uavctl.wiring.controller import build_estimator, build_plant

AXES = ("north", "east", "down")


def errors(values: Array) -> InnovationSamples:
    """Errors of one metre's deviation (n, 3), nothing ahead."""
    nothing = np.array([], dtype=np.int64)
    return InnovationSamples(np.arange(float(len(values))), values, np.ones_like(values), nothing, np.array([]))


def ar1(rng: np.random.Generator, n: int, r: float) -> Array:
    """Columns with variance 1 and correlation r from one row to the next."""
    driven = rng.standard_normal((n, 3)) * np.sqrt(1.0 - r**2)
    rows = np.zeros((n, 3))
    rows[0] = rng.standard_normal(3)
    for k in range(1, n):
        rows[k] = r * rows[k - 1] + driven[k]
    return rows


def test_white_errors_pass_in_almost_all_flights() -> None:
    rng = np.random.default_rng(0)
    refuted = sum(judge_innovations(errors(rng.standard_normal((300, 3))), AXES, 0.2).refuted for _ in range(200))
    assert refuted <= 8  # 2 are expected; more than 8 of 200 at 1 % have probability 2e-4


def test_errors_that_tell_of_the_next_are_found() -> None:
    verdict = judge_innovations(errors(ar1(np.random.default_rng(1), 1000, 0.4)), AXES, 0.2)
    assert all(axis_verdict.whiteness_refuted for axis_verdict in verdict.axes)
    assert [axis_verdict.correlation[0] for axis_verdict in verdict.axes] == pytest.approx([0.4] * 3, abs=0.1)
    assert len(verdict.axes[0].correlation) == LAGS
    assert verdict.refuted
    assert "errors are correlated" in verdict.text
    assert all(
        f"{axis_verdict.correlation[0]:.2g} {axis_verdict.axis}" in verdict.text for axis_verdict in verdict.axes
    )


@pytest.mark.parametrize(("scale", "outcome", "told"), [(1.3, "refuted", "too small"), (0.7, "cautious", "cautious")])
def test_errors_of_another_size_are_found(scale: float, outcome: str, told: str) -> None:
    values = scale * np.random.default_rng(2).standard_normal((800, 3))
    verdict = judge_innovations(errors(values), AXES, 0.2)
    assert all(axis_verdict.variance_refuted for axis_verdict in verdict.axes)
    assert [axis_verdict.variance for axis_verdict in verdict.axes] == pytest.approx([scale**2] * 3, rel=0.2)
    assert (verdict.outcome, verdict.refuted) == (outcome, outcome == "refuted")
    assert told in verdict.text


def test_errors_that_are_off_are_found() -> None:
    values = np.random.default_rng(3).standard_normal((800, 3))
    values[:, 1] += 0.3
    verdict = judge_innovations(errors(values), AXES, 0.2)
    assert [axis_verdict.mean_refuted for axis_verdict in verdict.axes] == [False, True, False]
    assert " east, in predicted deviations" in verdict.text


def test_figures_below_zero_have_a_minus_as_elsewhere() -> None:
    text = judge_innovations(errors(np.random.default_rng(3).standard_normal((400, 3)) - 0.5), AXES, 0.2).text
    assert "(−0." in text and "(-" not in text


def test_a_few_positions_are_too_few() -> None:
    verdict = judge_innovations(errors(np.ones((MIN_ERRORS - 1, 3))), AXES, 0.2)
    assert verdict.axes == ()
    assert not verdict.refuted
    assert "too few" in verdict.text


def test_ellipsoids_are_counted_by_the_time_ahead() -> None:
    lead = np.array([1] * 400 + [3] * 400)
    inside = np.concatenate([np.where(np.arange(400) < 380, 7.0, 8.0), np.where(np.arange(400) < 300, 7.0, 8.0)])
    few = np.random.default_rng(4).standard_normal((100, 3))
    found = InnovationSamples(
        np.arange(100.0), few, np.ones_like(few), lead, inside
    )  # the 95 % quantile of χ²₃ is 7.81
    near, far = judge_innovations(found, AXES, 0.2).leads
    assert (near.inside.hits, near.inside.trials, near.refuted, near.lead_s) == (380, 400, False, 0.2)
    assert (far.inside.hits, far.refuted) == (300, True)


@pytest.mark.parametrize("seed", [1, 2])  # by chance one flight in fifty is refuted
def test_a_flight_of_the_model_itself_passes(seed: int) -> None:
    config = room()
    flight = simulate_model(config, 1200, seed=seed)
    verdict = judge_flight(flight).verdicts.model
    assert verdict is not None and not verdict.refuted
    assert [axis_verdict.count for axis_verdict in verdict.axes] == [len(flight.samples) - 6] * 3
    assert [lead.lead_steps for lead in verdict.leads] == list(range(1, 13))
    assert all(lead.inside.trials > 40 for lead in verdict.leads)


def test_gusts_of_twice_the_size_are_found() -> None:
    verdict = judge_flight(simulate_model(room(), 600, seed=2, noise=lambda _, w: 2.0 * w)).verdicts.model
    assert verdict is not None
    assert all(axis_verdict.variance_refuted and axis_verdict.variance > 2.0 for axis_verdict in verdict.axes)
    assert any(lead.refuted and lead.inside.rate < 0.9 for lead in verdict.leads)


def test_gusts_that_last_are_found() -> None:
    last = np.zeros(6)

    def lasting(_step: int, w: Array) -> Array:
        nonlocal last
        last = np.asarray(0.9 * last + np.sqrt(1.0 - 0.81) * w)
        return last

    verdict = judge_flight(simulate_model(room(), 1200, seed=3, noise=lasting)).verdicts.model
    assert verdict is not None
    assert all(axis_verdict.whiteness_refuted for axis_verdict in verdict.axes)


def test_the_filter_is_the_flights_own() -> None:
    config = load_config("room-hahn-stursberg", ("solver.method=exact",))
    memory = lockstep("room-hahn-stursberg", 8.0, "solver.method=exact")
    flight = FlightData.from_records(memory.entries)
    track = FilterReplay(flight, make_kalman(build_plant(config), build_estimator(config), flight.design.dt_ns))
    known = {belief.captured_ns: belief for belief, _, _ in track.iterate_one_step_errors()}
    compared = 0
    for estimate in flight.estimates:
        belief = known.get(estimate.captured_ns)
        if belief is not None:
            mean = track.to(belief, estimate.at_ns).mean[: len(estimate.mean)]
            assert mean == pytest.approx(estimate.mean, abs=1e-9)
            compared += 1
    assert compared > 60


def test_what_is_sent_acts_after_the_dead_time() -> None:
    config = load_config("room-hahn-stursberg", ("solver.method=exact", "plant.dead_time_s=0.2"))
    right = judge_flight(simulate_model(config, 800, seed=1, dead_steps=1)).verdicts.model
    wrong = judge_flight(simulate_model(config, 800, seed=1)).verdicts.model
    assert right is not None and not right.refuted
    assert wrong is not None and all(axis.has_larger_errors for axis in wrong.axes)


def test_positions_while_others_fly_do_not_count() -> None:
    config = room()
    whole = simulate_model(config, 200, seed=5)
    half_ns = 100 * whole.design.dt_ns
    handed = tuple(
        msgspec.structs.replace(decision, mode=ControlMode.STOPPED) if decision.at_ns >= half_ns else decision
        for decision in whole.decisions
    )
    found = compute_innovations(dataclasses.replace(whole, decisions=handed), config)
    assert len(found.t_s) > 50
    assert float(found.t_s.max()) <= 1e-9 * half_ns
