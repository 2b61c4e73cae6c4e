"""Several vehicles in one world: downwash and collisions, by closed forms; and that far ones are as if alone."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from sim_rig import Client

from sim.simulation import VEHICLE, FleetWorld, Peers, Seat, SharedSpace
from sim.vehicle.airframe import CRAZYFLIE_2, GRAVITY_MPS2
from sim.vehicle.quadrotor import Quadrotor
from sim.world import PERIOD_NS, compute_contact_part, compute_downwash_share, compute_segment_approach
from uavctl.arrays import SECOND_NS
from uavctl.config import Config, dump_config, load_config, parse
from uavctl.errors import ConfigError
from uavctl.records import Collision, Outgoing, Received, Send, Truth, Vec3

RADIUS_M = 0.07
PLANTS = ["linear", "quadrotor"]
QUIET = ["plant.wind_std_mps2=[0.0,0.0,0.0]", "link.loss=0"]


def make_config(*overrides: str, plant: str = "quadrotor", number: int = 1, start_m: Vec3) -> Config:
    start = ",".join(str(value) for value in start_m)
    fixed = (f"sim.plant={plant}", f"sim.system_id={number}", f"sim.start_position_m=[{start}]")
    return load_config("room-px4", [*QUIET, *fixed, *overrides])


class Pushing:
    """A flyer that sends one acceleration at every tick."""

    def __init__(self, accel_mps2: Vec3) -> None:
        self.accel_mps2 = accel_mps2
        self.got: list[tuple[int, str, bytes]] = []
        self._client = Client()

    def receive(self, link: str, data: bytes, at_ns: int) -> Received:
        self.got.append((at_ns, link, data))
        return Received((), True, True)

    def tick(self, tick: int, at_ns: int, send: Send) -> None:
        send(Outgoing(link=VEHICLE, data=self._client.setpoint(*self.accel_mps2, system=0)))


def fly(
    configs: list[Config], accels_mps2: list[Vec3], seconds: float
) -> tuple[FleetWorld, list[Pushing], list[list[Truth]], list[Collision]]:
    flyers = [Pushing(accel) for accel in accels_mps2]
    told: list[list[Truth]] = [[] for _ in configs]
    collisions: list[Collision] = []
    seats = [Seat(*each) for each in zip(configs, flyers, (truths.append for truths in told), strict=True)]
    world = FleetWorld(seats, on_collision=collisions.append)
    world.run(seconds)
    return world, flyers, told, collisions


def hold(positions_m: list[Vec3], seconds: float, *overrides: str, plant: str = "quadrotor") -> SharedSpace:
    """Let vehicles hold their places by themselves."""
    configs = [make_config(*overrides, plant=plant, number=i + 1, start_m=p) for i, p in enumerate(positions_m)]
    space = SharedSpace(configs, [Peers(config, 0) for config in configs])
    for peers in space.peers:
        peers.autopilot.vehicle.go_to(peers.vehicle.position_m)
    space.advance(round(seconds * 1e9))
    return space


@pytest.mark.parametrize(("depth_m", "grams"), [(0.2, 10.0), (0.3, 8.0), (0.4, 6.0), (0.5, 4.0)])
def test_downwash_is_what_was_measured_of_a_crazyflie_of_34_g(depth_m: float, grams: float) -> None:
    share = compute_downwash_share((1.0, 2.0, -2.0), (1.0, 2.0, depth_m - 2.0), RADIUS_M)
    assert share == pytest.approx(grams / 34.0)


def test_downwash_widens_as_a_cone_and_ends() -> None:
    def share(north_m: float, depth_m: float) -> float:
        return compute_downwash_share((0.0, 0.0, -2.0), (north_m, 0.0, depth_m - 2.0), RADIUS_M)

    for depth_m in (0.2, 0.5):
        assert share(RADIUS_M + 0.1 * depth_m, depth_m) == pytest.approx(0.5 * share(0.0, depth_m))
    assert share(0.0, 0.71) == share(0.0, -0.1) == share(0.0, 0.0) == share(1.0, 0.4) == 0.0


def test_downwash_of_a_larger_vehicle_scales_with_its_radius() -> None:
    for depth_m, north_m in ((0.2, 0.0), (0.4, 0.1)):
        small = compute_downwash_share((0.0, 0.0, 0.0), (north_m, 0.0, depth_m), RADIUS_M)
        large = compute_downwash_share((0.0, 0.0, 0.0), (3 * north_m, 0.0, 3 * depth_m), 3 * RADIUS_M)
        assert large == pytest.approx(small)


def test_least_distance_and_first_contact_of_a_straight_way_are_those_of_a_fine_search() -> None:
    rng = np.random.default_rng(5)
    parts = np.linspace(0.0, 1.0, 20_001)
    for _ in range(50):
        start, end = rng.normal(size=(2, 3))
        distances = np.linalg.norm(start + parts[:, None] * (end - start), axis=1)
        distance_m, part = compute_segment_approach(tuple(start), tuple(end))
        assert distance_m == pytest.approx(distances.min(), abs=1e-4)
        assert part == pytest.approx(parts[distances.argmin()], abs=1e-4)
        contact_m = 0.5 * (distance_m + distances[0])
        if distance_m < contact_m:
            first = parts[np.argmax(distances <= contact_m)]
            assert compute_contact_part(tuple(start), tuple(end), contact_m) == pytest.approx(first, abs=1e-4)


@pytest.mark.parametrize("plant", PLANTS)
def test_vehicles_that_are_far_apart_fly_as_if_alone_bit_for_bit(plant: str) -> None:
    starts: list[Vec3] = [(-1.0, -1.0, -1.0), (1.0, 1.0, -1.2), (1.0, -1.0, -0.9)]
    noisy = ["link.loss=0.3", "plant.wind_std_mps2=[0.1,0.1,0.1]"]
    configs = [make_config(*noisy, f"sim.seed={i}", plant=plant, number=i + 1, start_m=p) for i, p in enumerate(starts)]
    accels: list[Vec3] = [(0.1, 0.0, 0.0), (0.0, 0.1, -0.1), (-0.1, 0.0, 0.1)]
    _, flyers, told, collisions = fly(configs, accels, 3.0)
    assert collisions == []
    for config, accel, flyer, truths in zip(configs, accels, flyers, told, strict=True):
        _, (lone,), (lone_truths,), _ = fly([config], [accel], 3.0)
        assert truths == lone_truths
        assert flyer.got == lone.got


@pytest.mark.parametrize("plant", PLANTS)
def test_the_same_seeds_give_the_same_flights_of_vehicles_that_meet(plant: str) -> None:
    def run() -> tuple[Any, ...]:
        starts: list[Vec3] = [(-0.6, 0.0, -1.2), (0.6, 0.0, -1.2), (-0.6, 0.0, -0.9)]
        configs = [make_config("link.loss=0.3", plant=plant, number=i + 1, start_m=p) for i, p in enumerate(starts)]
        world, flyers, told, collisions = fly(configs, [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 0.0)], 2.0)
        return collisions, told, [flyer.got for flyer in flyers], world.space.closest_approaches

    first = run()
    assert first[0]
    assert first == run()


@pytest.mark.parametrize("offset_m", [0.0, 0.1, 0.1395, 0.1405, 0.3])
def test_two_vehicles_at_4_mps_collide_exactly_if_their_paths_are_nearer_than_two_radii(offset_m: float) -> None:
    # At 0.1395 m they touch for 6 ms, between two computations.
    first = make_config("sim.start_velocity_mps=[2.0,0,0]", plant="linear", start_m=(-0.523, 0.0, -1.0))
    second = make_config("sim.start_velocity_mps=[-2.0,0,0]", plant="linear", number=2, start_m=(0.5, offset_m, -1.0))
    drag = "plant.drag_1ps=[0.0,0.0,0.0]"
    configs = [load_with(first, drag), load_with(second, drag)]
    world, _, _, collisions = fly(configs, [(0.0, 0.0, 0.0)] * 2, 0.5)
    (closest,) = world.space.closest_approaches
    if offset_m > 2 * RADIUS_M:
        assert collisions == []
        assert closest.distance_m == pytest.approx(offset_m, abs=1e-9)
        assert closest.at_ns == pytest.approx(1.023 / 4.0 * 1e9, abs=1e3)
        return
    (collision,) = collisions
    contact_s = (1.023 - math.sqrt((2 * RADIUS_M) ** 2 - offset_m**2)) / 4.0
    assert collision.vehicles == (1, 2)
    assert collision.at_ns == pytest.approx(contact_s * 1e9, abs=1e3)
    assert collision.speed_mps == pytest.approx(4.0)
    assert closest.distance_m <= collision.distance_m < 2 * RADIUS_M


def load_with(config: Config, *overrides: str) -> Config:
    return parse(dump_config(config), config.name, overrides).config


@pytest.mark.parametrize("plant", PLANTS)
def test_vehicles_that_collide_fall_to_the_floor_and_fly_no_more(plant: str) -> None:
    configs = [
        make_config(plant=plant, number=i + 1, start_m=(north_m, 0.0, -1.2)) for i, north_m in enumerate((-0.4, 0.4))
    ]
    world, _, told, (collision,) = fly(configs, [(1.0, 0.0, -1.0), (-1.0, 0.0, -1.0)], 9.0)
    for truths, peers in zip(told, world.space.peers, strict=True):
        hit = next(truth for truth in truths if truth.at_ns >= collision.at_ns)
        assert [truth.faults == ("collision",) for truth in truths] == [truth.at_ns >= hit.at_ns for truth in truths]
        # falls from h with the speed v: at least as long as √(2 h / g) without drag, and not twice as long
        free_s = math.sqrt(-2.0 * hit.position_m[2] / GRAVITY_MPS2)
        floor = next(truth for truth in truths if truth.at_ns > hit.at_ns and truth.position_m[2] == 0.0)
        assert 0.8 * free_s < (floor.at_ns - hit.at_ns) * 1e-9 < 2.0 * free_s
        assert all(truth.position_m[2] == 0.0 for truth in truths if truth.at_ns > floor.at_ns)
        assert truths[-1].velocity_mps == (0.0, 0.0, 0.0)
        assert peers.take_snapshot().phase == "ground"
        assert not peers.take_snapshot().armed
        pilot = peers.autopilot.pilot
        pilot.arm(peers.now_ns, is_forced=True)
        pilot.take_off(1.0, peers.now_ns)
        peers.advance(peers.now_ns + 5 * SECOND_NS)
        assert peers.vehicle.position_m[2] == 0.0


def test_a_linear_plant_that_collides_falls_freely() -> None:
    config = make_config("sim.start_velocity_mps=[0.5,0,-1.0]", plant="linear", start_m=(0.0, 0.0, -1.5))
    peers = Peers(config, 0)
    peers.advance(0)
    peers.vehicle.wreck()
    for at_s in (0.1, 0.333, 0.6):
        peers.advance(round(at_s * 1e9))
        height_m = 1.5 + at_s - 0.5 * GRAVITY_MPS2 * at_s**2
        assert peers.vehicle.position_m == pytest.approx((0.5 * at_s, 0.0, -height_m))
        assert peers.vehicle.velocity_mps == pytest.approx((0.5, 0.0, GRAVITY_MPS2 * at_s - 1.0))
        assert peers.vehicle.acceleration_mps2 == (0.0, 0.0, GRAVITY_MPS2)


def test_a_quadrotor_below_another_one_needs_the_thrust_of_the_closed_form_and_holds() -> None:
    space = hold([(0.0, 0.0, -1.6), (0.0, 0.0, -1.2)], 20.0)
    upper, lower = (peers.vehicle for peers in space.peers)
    assert isinstance(upper, Quadrotor)
    assert isinstance(lower, Quadrotor)

    def thrust_n(vehicle: Quadrotor) -> float:
        return sum(CRAZYFLIE_2.thrust_n_s2 * speed**2 for speed in vehicle.rotor_speeds_rps)

    # 0.4 m below: 6 g of 34 g
    assert lower.position_m == pytest.approx((0.0, 0.0, -1.2), abs=0.02)
    assert thrust_n(lower) / thrust_n(upper) == pytest.approx(1.0 + 6.0 / 34.0, abs=0.01)
    assert thrust_n(upper) == pytest.approx(CRAZYFLIE_2.weight_n, rel=1e-3)
    assert space.collisions == ()


def sink_for(seconds: float, plant: str, *overrides: str) -> float:
    """How far a vehicle sinks that starts at rest 0.3 m below another one, and whose setpoint is zero."""
    configs = [
        make_config(*overrides, plant=plant, number=i + 1, start_m=(0.0, 0.0, down_m))
        for i, down_m in enumerate((-1.5, -1.2))
    ]
    space = SharedSpace(configs, [Peers(config, 0) for config in configs])
    space.advance(round(seconds * 1e9))
    return space.peers[1].vehicle.position_m[2] + 1.2


@pytest.mark.parametrize("strength", [0.5, 1.0])
@pytest.mark.parametrize("plant", PLANTS)
def test_a_vehicle_is_pushed_down_with_the_acceleration_of_the_closed_form(plant: str, strength: float) -> None:
    # Over 0.1 s the loops have hardly begun to act: x = ½ a t², with a = strength · 8/34 · g at 0.3 m.
    pushed_m = sink_for(0.1, plant, f"sim.downwash={strength}") - sink_for(0.1, plant, "sim.downwash=0")
    assert pushed_m == pytest.approx(0.5 * strength * 8.0 / 34.0 * GRAVITY_MPS2 * 0.1**2, rel=0.1)


def test_the_upper_vehicle_feels_nothing_and_only_turning_rotors_blow() -> None:
    assert hold([(0.0, 0.0, -1.6), (0.0, 0.0, -1.2)], 1.0).peers[0].vehicle.position_m == pytest.approx(
        hold([(0.0, 0.0, -1.6)], 1.0).peers[0].vehicle.position_m, abs=0.0
    )
    space = hold([(0.0, 0.0, -1.6), (0.0, 0.0, -1.2)], 1.0)
    upper, lower = (peers.vehicle for peers in space.peers)
    before_mps2 = lower.acceleration_mps2[2]
    share = compute_downwash_share(upper.position_m, lower.position_m, RADIUS_M)
    assert share > 0.05
    upper.wreck()
    space.advance(SECOND_NS + PERIOD_NS)
    assert before_mps2 - lower.acceleration_mps2[2] == pytest.approx(share * GRAVITY_MPS2, abs=0.1)
    vehicle = hold([(0.0, 0.0, -1.6)], 0.1).peers[0].vehicle
    assert vehicle.has_downwash
    vehicle.stand_on_floor()
    assert not vehicle.has_downwash


def test_the_linear_plant_responds_to_a_force_as_its_equations_say() -> None:
    # v' = -c v + f: v = f/c (1 - e^(-c t)), x = f/c (t - (1 - e^(-c t)) / c)
    peers = hold([(0.0, 0.0, -1.2)], 0.0, plant="linear")
    model = peers.peers[0].vehicle.model
    c, t = 0.24, 0.7
    response = model.respond_to_force(round(t * 1e9))
    expected = np.zeros(9)
    expected[7] = (1.0 - math.exp(-c * t)) / c
    expected[6] = (t - expected[7]) / c
    np.testing.assert_allclose(response, expected, atol=1e-12)


def test_start_positions_nearer_than_two_radii_are_refused() -> None:
    configs = [make_config(number=i + 4, start_m=(0.0, east_m, -1.0)) for i, east_m in enumerate((0.0, 0.13, 0.5))]
    with pytest.raises(ConfigError, match=r"vehicles 4 and 5 start 0\.13 m apart") as error:
        SharedSpace(configs, [Peers(config, 0) for config in configs])
    assert "vehicles 5 and 6" not in str(error.value)


def test_vehicles_with_different_ticks_are_refused() -> None:
    configs = [
        make_config(f"daemon.tick_s={tick_s}", number=i + 1, start_m=(0.0, float(i), -1.0))
        for i, tick_s in enumerate((0.05, 0.025))
    ]
    with pytest.raises(ConfigError, match=r"daemon\.tick_s"):
        fly(configs, [(0.0, 0.0, 0.0)] * 2, 1.0)


def test_closest_approaches_are_those_of_the_truth() -> None:
    starts: list[Vec3] = [(-1.0, 0.0, -1.0), (1.0, 0.3, -1.0), (0.0, 1.5, -1.0)]
    configs = [make_config(plant="linear", number=i + 1, start_m=p) for i, p in enumerate(starts)]
    world, _, told, _ = fly(configs, [(0.8, 0.0, 0.0), (-0.8, 0.0, 0.0), (0.0, -0.2, 0.0)], 2.5)
    approaches = world.space.closest_approaches
    assert [each.vehicles for each in approaches] == [(1, 2), (1, 3), (2, 3)]
    for each, (a, b) in zip(approaches, itertools.combinations(told, 2), strict=True):
        sampled_m = min(math.dist(one.position_m, two.position_m) for one, two in zip(a, b, strict=True))
        # between two boundaries, 0.05 s at 4 m/s, it may be nearer
        assert sampled_m - 0.1 < each.distance_m <= sampled_m + 1e-9


def test_the_period_keeps_the_grid_of_the_quadrotor() -> None:
    assert PERIOD_NS % 2_500_000 == 0
