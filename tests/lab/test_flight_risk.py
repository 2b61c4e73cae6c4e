"""Risk of a whole flight: held against closed forms, the flight's own filter, and flights of the simulator."""

from __future__ import annotations

import json

import msgspec
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import binomtest, fisher_exact

from sim.simulation import World
from uavctl.arrays import Array
from uavctl.cli.app import run
from uavctl.cli.check import make_flight_items
from uavctl.config import Config, load_config
from uavctl.flight.kalman import Belief, make_kalman, predict, update_with_inertial, update_with_position
from uavctl.flight.monitors.inertial import InertialTrust
from uavctl.lab.campaign.arrivals import select_newest_captures
from uavctl.lab.flight_risk import FlightFilter, FlightRisk, bound_probability, rehearse_flights
from uavctl.lab.trial import FlightCounts, TrackedFlyer, compute_excess_m, get_room_limits
from uavctl.loop import ControlLoop
from uavctl.records import PositionSample
from uavctl.wiring.controller import build_conditioned, build_controller, build_estimator, build_plant
from uavctl.wiring.rehearsal import make_rehearsal_start

NO_WALL = "sets.state_lower=[-inf,-1.5,-inf,-inf,-1.5,-inf,-inf,-1.0,-inf]"
ONE_WALL = "sets.state_upper=[3.0,1.5,inf,inf,1.5,inf,inf,1.0,inf]"
NO_BIAS = ("estimator.bias_drift=0", "estimator.bias_max=0")


def rehearse_config(config: Config, seed: int = 0) -> FlightRisk | None:
    design = build_conditioned(config)
    return rehearse_flights(config, design, build_controller(config, design), seed)


@pytest.mark.parametrize(("hits", "trials"), [(0, 60), (1, 60), (3, 200), (59, 60), (60, 60)])
def test_the_bound_is_that_of_clopper_and_pearson(hits: int, trials: int) -> None:
    interval = binomtest(hits, trials, alternative="less").proportion_ci(0.95, "exact")
    assert bound_probability(hits, trials) == pytest.approx(interval.high, rel=1e-9)


def make_adrift(rehearsals: int) -> Config:
    """A vehicle whose inputs do next to nothing, near the one wall of its room, in strong wind."""
    return load_config(
        "room",
        (
            *NO_BIAS,
            NO_WALL,
            ONE_WALL,
            "estimator.inertial_std_mps2=0",
            "sets.input_lower=[-1e-6,-1e-6,-1e-6]",
            "sets.input_upper=[1e-6,1e-6,1e-6]",
            "sim.start_position_m=[2.99,0,-1.2]",
            "target.position_m=[2.99,0,-1.2]",
            "duration_s=2",
            f"check.rehearsals={rehearsals}",
        ),
    )


@pytest.mark.slow
def test_a_vehicle_adrift_leaves_as_often_as_a_gaussian_path_crosses_the_wall() -> None:
    config = make_adrift(120)
    design, plant = build_conditioned(config), build_plant(config)
    start = make_rehearsal_start(config, design, build_controller(config, design).mission)
    steps = round(config.duration_s / plant.dt_s)
    # p(t) = p(0) + Σ_k [A^(t-1-k) E w(k)]_north
    shares = np.zeros((steps, steps))
    response = plant.e[:, 0] * np.sqrt(plant.w[0, 0])
    for lag in range(steps):
        shares += np.diag(np.full(steps - lag, response[0]), -lag)
        response = plant.a @ response
    # The probability of all steps at once by paths of their own: SciPy's takes minutes in so many dimensions.
    paths_m = start[0] + np.random.default_rng(7).standard_normal((50_000, steps)) @ shares.T
    inside = float((paths_m <= 3.0).all(axis=1).mean())
    risk = rehearse_config(config)
    assert risk is not None and (risk.flights, risk.steps) == (120, steps)
    assert 0.1 < inside < 0.9
    assert binomtest(risk.left, risk.flights, 1.0 - inside).pvalue > 0.01
    assert risk.beyond_m > 0.0 and risk.left <= risk.steps_outside
    assert risk.probability_max > risk.left / risk.flights


def test_flights_depend_on_the_seed_alone() -> None:
    config = load_config("room", ("duration_s=1", "check.rehearsals=2"))
    one, other = rehearse_config(config, 1), rehearse_config(config, 2)
    assert one is not None and other is not None and one.beyond_m != other.beyond_m
    assert rehearse_config(config, 1) == one


@pytest.mark.parametrize(
    "overrides", [("check.rehearsals=0",), (NO_WALL, ONE_WALL.replace("[3.0", "[inf"), "check.rehearsals=2")]
)
def test_without_flights_or_walls_there_is_no_risk(overrides: tuple[str, ...]) -> None:
    assert rehearse_config(load_config("room", ("duration_s=1", *overrides))) is None


def test_a_flight_shorter_than_a_step_is_one_step() -> None:
    risk = rehearse_config(load_config("room", ("duration_s=0.01", "check.rehearsals=2")))
    assert risk is not None and (risk.steps, risk.left) == (1, 0)


def test_the_filter_is_that_of_the_flight() -> None:
    config = load_config("room")
    design, dt_ns, rng = build_conditioned(config), 50_000_000, np.random.default_rng(5)
    plant, kalman = design.plant, make_kalman(design.plant, build_estimator(config), dt_ns)
    steps, axes = 12, 3
    known_steps = np.arange(steps)[None, :].copy()
    known_steps[0, [3, 4, 8]] = steps  # lost
    # Small ones: the flight's filter refuses readings that cannot be.
    readings, positions_m = 0.1 * rng.normal(size=(1, steps, axes)), 0.005 * rng.normal(size=(steps, axes))
    inputs = 0.1 * rng.normal(size=(1, steps, plant.n_u))
    batch = FlightFilter(plant, kalman, np.zeros(plant.n_x), design.estimate_cov, known_steps, readings)
    newest = select_newest_captures(known_steps)
    belief: Belief | None = None
    for k in range(steps):
        batch.update(k, positions_m[None, k], newest[:, k], inputs[:, :k])
        mean, cov = batch.now
        if belief is None:
            drawn = np.pad(cov[0], (0, len(kalman.drawn_rows)))
            drawn[kalman.n_x :] = kalman.drawn_rows
            belief = Belief(0, 0, np.pad(mean[0], (0, len(drawn) - kalman.n_x)), drawn, InertialTrust(used_ns=0))
            continue
        # Inertial data of a step belong to its end, before the next disturbance is drawn.
        belief = predict(kalman, 0, belief, inputs[0, k - 1], k * dt_ns - 1)
        belief = update_with_inertial(kalman, belief, readings[0, k - 1], inputs[0, k - 1])
        belief = predict(kalman, 0, belief, inputs[0, k - 1], k * dt_ns)
        if known_steps[0, k] == k:
            belief = update_with_position(kalman, belief, make_sample(positions_m[k], k * dt_ns))
        assert belief.inertial.refused == 0 and belief.inertial.distrusted_ns is None
        assert_allclose(mean[0], belief.mean[: kalman.n_x], rtol=1e-5, atol=1e-7)
        assert_allclose(cov[0], belief.cov[: kalman.n_x, : kalman.n_x], rtol=1e-4, atol=1e-8)


def make_sample(position_m: Array, at_ns: int) -> PositionSample:
    place = tuple(position_m.tolist())
    return PositionSample(captured_ns=at_ns, received_ns=at_ns, position_m=place, std_m=0.0, source="", seq=0)


@pytest.mark.long
@pytest.mark.parametrize("budgets", ["configured", "observed"])
def test_flights_of_the_simulator_leave_as_often(budgets: str) -> None:
    """At a wall, on a poor link, without inertial data: there the simulator's errors are those of the configuration.

    The budgets of the configured link are too small there. Those that follow the link keep flights away from the wall.
    """
    config = load_config(
        "room",
        (
            f"risk.budgets={budgets}",
            "target.position_m=[3.0,1.0,-1.2]",
            "plant.dead_time_s=0",  # the linear vehicle has none
            "estimator.position_std_m=0.003",  # the cameras' own
            "estimator.inertial_std_mps2=0",
            "link.loss=0.6",
            "duration_s=20",
            "check.rehearsals=100",
        ),
    )
    controller, flights, left, beyond_m = build_controller(config), 30, 0, -np.inf
    for seed in range(flights):
        tracked = TrackedFlyer(ControlLoop(config, controller, FlightCounts(), lambda: 0))
        world = World(msgspec.structs.replace(config, sim=msgspec.structs.replace(config.sim, seed=seed)), tracked)
        tracked.get_position = lambda vehicle=world.peers.vehicle: vehicle.position_m  # type: ignore[misc]
        world.run(config.duration_s)
        excess_m = compute_excess_m(np.array(tracked.positions_m), *get_room_limits(config))
        left += bool((excess_m > 0.0).any())
        beyond_m = max(beyond_m, float(excess_m.max()))
    risk = rehearse_config(config)
    assert risk is not None
    if budgets == "configured":
        assert risk.left > 0 and left > 0
    else:
        assert risk.steps_outside < 0.1 * risk.step_risk * risk.flights * risk.steps
    assert_allclose(risk.beyond_m, beyond_m, atol=0.1)
    assert fisher_exact(np.array([[left, flights - left], [risk.left, risk.flights - risk.left]])).pvalue > 0.01


def test_design_and_check_tell_it(capsys: pytest.CaptureFixture[str]) -> None:
    settings = ("duration_s=1", "check.rehearsals=5")
    assert run(["design", "--json", "--seed", "4", "--rehearsals", "5", "--set=duration_s=1"]) == 0
    told = json.loads(capsys.readouterr().out)["flight_risk"]
    expected = rehearse_config(load_config("room", settings), 4)
    assert expected is not None and told == msgspec.to_builtins(expected)
    items = {item.name: item for item in make_flight_items(load_config("room", settings), seed=4)}
    assert items["flight"].value == expected.sentence and items["flight"].ok


@pytest.mark.parametrize("command", [("check",), ("design",)])
@pytest.mark.parametrize("option", ["--rehearsals=-1", "--rehearsals=1001", "--seed=-1"])
def test_a_number_of_flights_or_a_seed_that_is_none_is_refused(
    command: tuple[str, ...], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*command, option]) == 2
    told = capsys.readouterr()
    assert all(text in told.err for text in option.split("=")) and told.err.count("\n") == 1 and not told.out


def test_flights_that_leave_are_noted_and_refuse_nothing() -> None:
    items = {item.name: item for item in make_flight_items(make_adrift(12))}
    assert (items["flight"].state, items["flight"].ok) == ("note", True)
