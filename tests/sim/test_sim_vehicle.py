"""The simulated plant against recursions, closed forms and an independent integrator."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from scipy.integrate import solve_ivp

from sim.vehicle.linear import MAX_ACCEL_MPS2, LinearVehicle, make_linear_model
from uavctl.arrays import Array
from uavctl.config import Config, load_config
from uavctl.errors import DesignError
from uavctl.records import Vec3

S = 1_000_000_000
DRAGGED = [
    "plant.drag_1ps=[0.3,0.3,0.3]",
    "plant.lag_s=[0.25,0.25,0.25]",
    "plant.wind_std_mps2=[0.15,0.15,0.10]",
    "plant.dt_s=0.2",  # the wind changes at its multiples only
]


def vehicle(config: Config, seed: int = 1, start_ns: int = 0) -> LinearVehicle:
    return LinearVehicle(config, np.random.SeedSequence(seed), start_ns)


def accels(n: int) -> list[Vec3]:
    draws = np.random.default_rng(9).uniform(-2, 2, (n, 3))
    return [(float(a), float(b), float(c)) for a, b, c in draws]


def test_paper_follows_the_printed_recursion_at_the_boundaries() -> None:
    config = load_config("paper")
    flown = vehicle(config, start_ns=7 * S)
    a, b, e = (np.array(rows) for rows in (config.plant.a, config.plant.b, config.plant.e))
    rng = np.random.default_rng(np.random.SeedSequence(1))
    x = np.array([35.0, -2.0, -20.0, -4.0])
    for k, accel in enumerate(accels(50)):
        flown.accelerate(accel)
        flown.advance((8 + k) * S)
        u = np.array(accel[:2]) / 0.49429632181478
        x = a @ x + b @ u + e @ (math.sqrt(0.6) * rng.standard_normal(2))
        np.testing.assert_allclose(flown.state, x, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_stops_on_the_way_change_no_bit(name: str) -> None:
    config = load_config(name)
    straight, halting = vehicle(config), vehicle(config)
    dt_ns = straight.model.dt_ns
    for k, accel in enumerate(accels(20)):
        for one in (straight, halting):
            one.accelerate(accel)
        for part in (0.1, 0.37, 0.99):
            halting.advance(k * dt_ns + round(part * dt_ns))
            assert np.isfinite(halting.state).all()
            halting.accelerate(accel)
        for one in (straight, halting):
            one.advance((k + 1) * dt_ns)
        assert straight.state.tolist() == halting.state.tolist()


@pytest.mark.parametrize("name", ["paper", "room-hahn-stursberg"])
def test_its_acceleration_is_the_slope_of_its_velocity_wind_and_all(name: str) -> None:
    flown = vehicle(load_config(name))
    step_ns = flown.model.dt_ns // 1000
    middle_ns = flown.model.dt_ns // 2
    for k, accel in enumerate(accels(10)):
        flown.accelerate(accel)
        speeds = []
        for at_ns in (middle_ns - step_ns, middle_ns, middle_ns + step_ns):
            flown.advance(k * flown.model.dt_ns + at_ns)
            speeds.append(np.array(flown.velocity_mps))
            if at_ns == middle_ns:
                told = flown.acceleration_mps2
        assert told == pytest.approx((speeds[2] - speeds[0]) / (2e-9 * step_ns), abs=1e-5)
        flown.advance((k + 1) * flown.model.dt_ns)
    flown.stand_on_floor()
    assert flown.acceleration_mps2 == (0.0, 0.0, 0.0)


def test_paper_between_the_boundaries_is_a_first_order_lag() -> None:
    flown = vehicle(load_config("paper", ["plant.w=[[0.6,0],[0,0.6]]"]))
    w = math.sqrt(0.6) * np.random.default_rng(np.random.SeedSequence(1)).standard_normal(2)
    flown.accelerate((1.0, 0.0, 0.0))
    u = 1.0 / 0.49429632181478
    for t in (0.1, 0.25, 0.5, 0.8):
        flown.advance(round(t * S))
        decay = 0.61**t
        # v' = c (u - v) + g w with e^-c = 0.61 and, over 1 s, g (1 - 0.61) / c = 1
        want = decay * -2.0 + (1 - decay) * u + (1 - decay) / 0.39 * w[0]
        assert flown.velocity_mps[0] == pytest.approx(want, abs=1e-10)


def test_drag_lag_matches_an_integrator_with_the_input_changed_within_a_step() -> None:
    config = load_config("room-hahn-stursberg", [*DRAGGED, "sim.start_velocity_mps=[0.3,-0.2,0.1]"])
    flown = vehicle(config)
    w = np.array([0.15, 0.15, 0.10]) * np.random.default_rng(np.random.SeedSequence(1)).standard_normal(3)

    def slope(_t: float, y: Array, u: Array) -> Array:
        p_v_a = y.reshape(3, 3)
        velocity, accel = p_v_a[:, 1], p_v_a[:, 2]
        return np.column_stack([velocity, accel - 0.3 * velocity + w, (u - accel) / 0.25]).ravel()

    y = flown.state.copy()
    assert y.tolist() == [-2.4, 0.3, 0.0, -1.9, -0.2, 0.0, -0.7, 0.1, 0.0]
    before = 0.0
    for t, accel in ((0.03, (1.0, 0.0, -1.0)), (0.11, (-2.0, 0.5, 0.3)), (0.2, (0.0, 2.0, 0.0))):
        flown.accelerate(accel)
        flown.advance(round(t * S))
        y = solve_ivp(slope, (before, t), y, args=(np.array(accel),), rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(flown.state, y, rtol=0, atol=1e-9)
        before = t


def test_disturbance_has_the_covariance_asked_for() -> None:
    config = load_config("paper", ["plant.w=[[0.6,0.2],[0.2,0.5]]"])
    root = make_linear_model(config.plant).w_root
    np.testing.assert_allclose(root @ root.T, [[0.6, 0.2], [0.2, 0.5]], atol=1e-12)
    flown = vehicle(config)
    a = np.array(config.plant.a)
    draws = []
    for k in range(20_000):
        x = flown.state
        flown.advance((k + 1) * S)
        draws.append((flown.state - a @ x)[[1, 3]])  # E_v = 1, u = 0
    # 4 standard errors of a sample variance: 4 * 0.6 * sqrt(2 / 20000) = 0.024
    np.testing.assert_allclose(np.cov(np.array(draws).T), [[0.6, 0.2], [0.2, 0.5]], atol=0.024)


def test_axes_that_the_plant_has_not_stay_at_their_start() -> None:
    flown = vehicle(load_config("paper", ["sim.start_position_m=[1.0,2.0,-3.5]"]))
    flown.accelerate((0.0, 0.0, 5.0))
    flown.advance(30 * S)
    assert not flown.has_down
    assert flown.position_m[2] == -3.5
    assert flown.velocity_mps[2] == 0.0
    assert flown.input.tolist() == [0.0, 0.0]


def test_the_input_is_in_plant_units_and_limited_only_beyond_ten_g() -> None:
    flown = vehicle(load_config("paper"))
    flown.accelerate((3.9, -3.9, 0.0))
    np.testing.assert_allclose(flown.input, [3.9 / 0.49429632181478, -3.9 / 0.49429632181478], rtol=1e-15)
    flown.accelerate((3e38, -3e38, 0.0))
    np.testing.assert_allclose(flown.input * 0.49429632181478, [MAX_ACCEL_MPS2, -MAX_ACCEL_MPS2], rtol=1e-15)


def test_on_the_floor_nothing_moves_but_the_draws_go_on() -> None:
    config = load_config("room-hahn-stursberg")
    resting, flying = vehicle(config), vehicle(config)
    resting.stand_on_floor()
    for one in (resting, flying):
        one.advance(3 * S + 1)
    assert resting.position_m == (-2.4, -1.9, 0.0)
    assert resting.velocity_mps == (0.0, 0.0, 0.0)
    resting.grounded = False
    before = resting.state.copy(), flying.state.copy()
    for one in (resting, flying):
        one.advance(3 * S + S // 10)
    a = make_linear_model(config.plant).transition(S // 10 - 1)[0]
    # the same w in both: what differs is the homogeneous motion only
    np.testing.assert_allclose(resting.state - a @ before[0], flying.state - a @ before[1], rtol=0, atol=1e-12)


def test_one_seed_one_flight_another_seed_another() -> None:
    config = load_config("room-hahn-stursberg")
    first, again, other = vehicle(config, 1), vehicle(config, 1), vehicle(config, 2)
    for one in (first, again, other):
        one.advance(5 * S)
    assert first.state.tolist() == again.state.tolist() != other.state.tolist()


def test_time_cannot_go_back() -> None:
    flown = vehicle(load_config("room-hahn-stursberg"))
    flown.advance(10)
    with pytest.raises(ValueError, match="back"):
        flown.advance(9)


@pytest.mark.parametrize("a", [((0.0, 0.0), (0.0, 0.5)), ((-0.5, 0.0), (0.0, 0.5))])
def test_a_plant_without_a_real_logarithm_is_refused(a: tuple[tuple[float, ...], ...]) -> None:
    plant = replace(
        load_config("paper").plant,
        axes=("north",),
        a=a,
        b=((0.1,), (0.2,)),
        e=((0.5,), (1.0,)),
        w=((0.6,),),
        position_index=(0,),
        velocity_index=(1,),
        accel_per_input=(1.0,),
    )
    with pytest.raises(DesignError, match=r"plant\.a"):
        make_linear_model(plant)
