"""Campaigns in which positions alone are measured: the filter against the flight's own, the promise against chance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import campaign_rig as rig
import msgspec
import numpy as np
import pytest
from scipy.stats import binom

from logs.report.run_statistics import max_step_rate
from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.flight.estimator import absorb_samples, begin_history, estimate_at, note_input
from uavctl.flight.kalman import make_kalman
from uavctl.lab.campaign.arrivals import compute_known_steps, select_newest_captures
from uavctl.lab.campaign.controllers import draw_conditions, make_filter_belief
from uavctl.lab.campaign.draws import Stream, draw, draw_normal
from uavctl.lab.campaign.pool import Columns
from uavctl.lab.campaign.position_filter import PositionFilter
from uavctl.lab.campaign.tasks import Cell, fly_task, make_tasks
from uavctl.records import PositionSample
from uavctl.smpc.baselines import Governor, MeanQp
from uavctl.smpc.batch import Counts, Information, predict, predict_covariance
from uavctl.smpc.estimate import innovation_form
from uavctl.smpc.nominal import propagate_covariance
from uavctl.wiring.controller import build_estimator, build_plant, build_problem

S = 1_000_000_000
RUNS, STEPS = 4, 25
LINKS = {
    "losses": ["link.loss=0.4"],
    "late, some overtaken": ["link.loss=0.2", "link.delay_s=0.3", "link.jitter_s=3.4"],
}
NOISY = 'set = ["sim.camera.noise_std_m=0.3", "estimator.position_std_m=0.3"'
FLIGHTS = {
    "paper": ["estimator.position_std_m=0.3", "estimator.initial_std=2.0"],
    "room": [
        f"estimator.{key}" for key in ("bias_drift=0.0", "bias_max=0.0", "inertial_std_mps2=0.0", "window_s=20.0")
    ],
}


def arrived(config: Config, overrides: list[str], seed: int) -> Counts:
    link = load_config("paper", overrides).link  # whose delays are of whole seconds
    return compute_known_steps(link, 1.0, draw(seed, 0, RUNS, STEPS, 1).link)


def filter_positions(
    config: Config, first_known: Counts, positions: Array, inputs: Array
) -> tuple[list[Array], list[Array]]:
    """What the campaign's filter says at the begin of each step, of all runs."""
    looked = PositionFilter(make_filter_belief(config), first_known)
    newest = select_newest_captures(first_known)
    pairs = [looked.update(k, positions[:, k], newest[:, k], inputs[:, :k]) for k in range(STEPS)]
    return [mean for mean, _ in pairs], [cov for _, cov in pairs]


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("preset", FLIGHTS)
def test_estimates_are_those_of_the_flight_s_filter(preset: str, link: str) -> None:
    config = load_config(preset, FLIGHTS[preset])
    plant, first_known, rng = build_plant(config), arrived(config, LINKS[link], 11), np.random.default_rng(3)
    axes = len(plant.axes)
    positions, inputs = 3.0 * rng.normal(size=(RUNS, STEPS, axes)), rng.normal(size=(RUNS, STEPS, plant.n_u))
    means, covs = filter_positions(config, first_known, positions, inputs)
    newest = select_newest_captures(first_known)
    dt_ns = round(config.plant.dt_s * 1e9)
    overtaken = 0
    for run in range(RUNS):
        kalman = make_kalman(plant, build_estimator(config), dt_ns)
        history = begin_history(kalman, 0, 0)
        for k in range(STEPS):
            come = [c for c in range(k + 1) if first_known[run, c] == k]
            overtaken += sum(c < newest[run, k] for c in come)
            samples = [sample(plant.axes, positions[run, c], c * dt_ns, k * dt_ns) for c in come]
            history, _, refused = absorb_samples(kalman, history, k * dt_ns, samples)
            assert not refused
            reported = estimate_at(kalman, history, int(newest[run, k]) * dt_ns)
            assert reported is not None
            assert means[k][run] == pytest.approx(reported.mean, abs=1e-8)
            assert covs[k][run] == pytest.approx(np.array(reported.cov), rel=1e-7, abs=1e-10)
            history = note_input(history, k * dt_ns, inputs[run, k])
    assert (overtaken > 0) == (link != "losses")


def sample(axes: tuple[str, ...], position: Array, captured_ns: int, received_ns: int) -> PositionSample:
    named = dict(zip(axes, position.tolist(), strict=True))
    return PositionSample(
        source="camera",
        seq=0,
        captured_ns=captured_ns,
        received_ns=received_ns,
        position_m=(named.get("north", 0.0), named.get("east", 0.0), named.get("down", 0.0)),
        std_m=0.0,
    )


def test_errors_and_prediction_errors_have_the_covariance_of_the_filter() -> None:
    """e'P⁻¹e of a Gaussian has the mean n; each run's steps are correlated, so runs are counted."""
    config = load_config("paper", FLIGHTS["paper"])
    plant, runs, steps = build_plant(config), 3000, 12
    chances = draw(2, 0, runs, steps, plant.n_w)
    first_known = compute_known_steps(load_config("paper", LINKS["losses"]).link, 1.0, chances.link)
    newest, looked = select_newest_captures(first_known), PositionFilter(make_filter_belief(config), first_known)
    rng = np.random.default_rng(1)
    index = list(plant.position_index)
    state = np.zeros((runs, steps + 1, plant.n_x))
    state[:, 0] = 2.0 * rng.normal(size=(runs, plant.n_x))
    noise = 0.3 * draw_normal(Stream.POSITION_NOISE, 2, 0, runs, (steps, 2))
    inputs = rng.normal(size=(runs, steps, plant.n_u))
    pushes = chances.normal @ np.linalg.cholesky(plant.w).T
    for k in range(steps):
        mean, cov = looked.update(k, state[:, k, index] + noise[:, k], newest[:, k], inputs[:, :k])
        measurement = Information(k, newest[:, k], mean, inputs[:, :k], cov)
        state[:, k + 1] = state[:, k] @ plant.a.T + inputs[:, k] @ plant.b.T + pushes[:, k] @ plant.e.T
        spread = predict_covariance(plant, measurement)
        assert spread is not None
        for reported, error in (
            (cov, state[np.arange(runs), newest[:, k]] - mean),
            (spread, state[:, k] - predict(plant, measurement)),
        ):
            squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(reported), error)
            # The variance of a χ² with n degrees is 2n; five standard deviations of the mean over runs.
            assert squared.mean() == pytest.approx(plant.n_x, abs=5.0 * np.sqrt(2.0 * plant.n_x / runs))


def test_an_exact_state_s_prediction_has_no_covariance_of_its_own() -> None:
    plant = build_plant(load_config("paper"))
    assert (
        predict_covariance(plant, Information(0, np.zeros(1, dtype=np.intp), np.zeros((1, 4)), np.zeros((1, 0, 2))))
        is None
    )


def test_noise_is_independent_of_other_draws_and_longer_runs_begin_alike() -> None:
    noise, single = (
        draw_normal(Stream.POSITION_NOISE, 7, first, runs, (steps, 2))
        for first, runs, steps in ((10, 5, 20), (13, 1, 30))
    )
    assert np.array_equal(noise[3], single[0, :20])
    assert abs(np.corrcoef(noise.ravel(), draw(7, 10, 5, 20, 2).normal.ravel())[0, 1]) < 0.3


def test_simple_margins_begin_with_the_filter_s_covariance() -> None:
    problem = build_problem(load_config("paper", ["target.position_m=[0, 19.5, 0]"]))
    plant = problem.plant
    cov = innovation_form(plant, 0.3, 0.0, 0).estimate_cov
    # What the filter leaves is what it ends at where every position comes.
    looked = PositionFilter(
        make_filter_belief(load_config("paper", ["estimator.position_std_m=0.3"])), np.arange(80, dtype=np.intp)[None]
    )
    for k in range(80):
        _, last = looked.update(k, np.zeros((1, 2)), np.array([k]), np.zeros((1, k, 2)))
    assert last[0] == pytest.approx(cov, abs=1e-9)
    assert propagate_covariance(plant, 1, cov)[1] == pytest.approx(
        plant.a @ cov @ plant.a.T + propagate_covariance(plant, 1)[1]
    )
    toward = Information(0, np.zeros(1, dtype=np.intp), np.array([[0.0, 0.0, 18.9, 0.3]]), np.zeros((1, 0, 2)))
    for kind in (Governor, MeanQp):
        wary, bold = kind(problem, 1.5, cov), kind(problem, 1.5)
        for single in (wary, bold):
            single.begin(1)
        assert wary.act(toward)[0, 1] < bold.act(toward)[0, 1] - 0.1


def cell(tmp_path: Path, *more: str, overrides: str = "", master: int = 0) -> Cell:
    """A target one metre from a wall at 30 % loss, under the age-conditioned scheme on noisy positions."""
    (campaign_cell,) = rig.cells(
        tmp_path,
        f'{NOISY}, "target.position_m=[0, 19, 0]", "link.loss=0.3"]\n',
        f"runs = 400\nsteps = 40\nmaster = {master}\nstart = [0, 0, 15, 0]\n" + "".join(more),
        rig.controller("smpc", f'set = ["smpc.scheme=age-conditioned"{overrides}]'),
    )
    return campaign_cell


def rows(campaign_cell: Cell) -> Columns:
    (task,) = make_tasks([campaign_cell])
    return task.fly()


@pytest.mark.long
def test_the_promise_is_kept_on_positions_alone_and_only_with_the_filter_s_covariance(tmp_path: Path) -> None:
    """The worst step's interval begins below the 5 % that are allowed, and without P in the margins it does not."""
    columns = rows(cell(tmp_path, 'measured = "position"\n'))
    assert not any(columns["error"])
    hits = np.asarray(columns["outside"], dtype=np.int64).sum(axis=0)
    worst, (low, _) = max_step_rate(hits, 400, 40)
    assert low <= 0.05 and worst > 0.01
    assert columns["slack_used"].sum() <= 0.05 * columns["decisions"].sum()
    # The same scheme told that what it knows is exact: steps of the second half, 8000 of them.
    believed = rows(cell(tmp_path, 'measured = "position"\n', overrides=', "estimator.position_std_m=1e-5"'))
    rate = float(np.asarray(believed["outside"])[:, 20:].mean())
    assert rate > 2.0 * float(np.asarray(columns["outside"])[:, 20:].mean())
    assert binom.sf(round(rate * 400), 400, 0.05) < 1e-3


def test_measured_states_fly_without_a_filter(tmp_path: Path) -> None:
    by_default, exact = cell(tmp_path), cell(tmp_path, 'measured = "state"\n')
    first, second = (rows(of_runs(campaign_cell, 20)) for campaign_cell in (by_default, exact))
    assert all(np.array_equal(first[name], second[name], equal_nan=name not in ("error",)) for name in first)
    assert draw_conditions(by_default.setting, 0, 3).noise is None


def of_runs(campaign_cell: Cell, runs: int) -> Cell:
    """A cell with so many runs."""
    return replace(
        campaign_cell,
        setting=replace(campaign_cell.setting, spec=msgspec.structs.replace(campaign_cell.setting.spec, runs=runs)),
    )


def test_every_kind_flies_on_positions_and_runs_do_not_depend_on_each_other(tmp_path: Path) -> None:
    kinds = ("lqg", "mean-qp", "governor", "packetised", "hold-last", "worst-case-delay")
    campaign_cell = rig.cells(
        tmp_path,
        f'{NOISY}]\nmeasured = "position"\nruns = 6\nsteps = 15\n',
        *(rig.controller(kind) for kind in kinds),
        rig.table("link", "late", 'set = ["link.loss=0.2", "link.delay_s=1.0", "link.jitter_s=1.0"]'),
    )
    for task in make_tasks(campaign_cell):
        all_runs, _ = fly_task(task, 0, 6)
        single_run, _ = fly_task(task, 4, 1)
        assert not all_runs.failed.any()
        assert all_runs.states[4] == pytest.approx(single_run.states[0], abs=1e-9)
