"""Rotors, their mixer and the battery against closed forms; the fitted constants against the published table."""

import itertools
import math

import numpy as np
import pytest

from sim.vehicle.airframe import CRAZYFLIE_2, GRAVITY_MPS2
from sim.vehicle.battery import BatteryModel
from sim.vehicle.rotors import STOPPED, Rotors
from uavctl.arrays import Array
from uavctl.records import Vec3

H = 0.0025
FAST = 3000.0
MOST_N = CRAZYFLIE_2.thrust_n_s2 * FAST**2
LEAST_N = CRAZYFLIE_2.thrust_n_s2 * CRAZYFLIE_2.idle_rps**2
SIDE_M = CRAZYFLIE_2.arm_m / math.sqrt(2.0)
# Places (front, right) and senses of turning (+1: reaction torque to the right), written down anew.
PLACES = ((1, 1, 1), (-1, 1, -1), (-1, -1, 1), (1, -1, -1))

# Current [A], thrust [g], voltage [V], duty [%], speed [1/min]: Bitcraze's measurement of a Crazyflie 2.0.
TABLE = """
0.24 0.0 4.01 0 0
0.37 1.6 3.98 6.25 4485
0.56 4.8 3.95 12.5 7570
0.75 7.9 3.92 18.75 9374
0.94 10.9 3.88 25 10885
1.15 13.9 3.84 31.25 12277
1.37 17.3 3.80 37.5 13522
1.59 21.0 3.76 43.25 14691
1.83 24.4 3.71 50 15924
2.11 28.6 3.67 56.25 17174
2.39 32.8 3.65 62.5 18179
2.71 37.3 3.62 68.75 19397
3.06 41.7 3.56 75 20539
3.46 46.0 3.48 81.25 21692
3.88 51.9 3.40 87.5 22598
4.44 57.9 3.30 93.75 23882
"""


def columns() -> tuple[Array, Array, Array, Array, Array]:
    rows = np.array([[float(number) for number in line.split()] for line in TABLE.split("\n") if line])
    current, thrust, voltage, duty, speed = rows.T
    return current, thrust * 1e-3 * GRAVITY_MPS2, voltage, duty / 100.0, speed * 2.0 * math.pi / 60.0


def rotors() -> Rotors:
    return Rotors(CRAZYFLIE_2, H)


def by_hand(speeds: tuple[float, ...]) -> tuple[float, Vec3]:
    forces = [CRAZYFLIE_2.thrust_n_s2 * speed**2 for speed in speeds]
    roll = sum(-SIDE_M * right * f for (_, right, _), f in zip(PLACES, forces, strict=True))
    pitch = sum(SIDE_M * front * f for (front, _, _), f in zip(PLACES, forces, strict=True))
    yaw = sum(CRAZYFLIE_2.torque_m * sense * f for (_, _, sense), f in zip(PLACES, forces, strict=True))
    return sum(forces), (roll, pitch, yaw)


def test_the_constants_are_the_least_squares_of_the_published_table() -> None:
    current, thrust, voltage, duty, speed = columns()
    squares = speed**2
    assert CRAZYFLIE_2.thrust_n_s2 == pytest.approx(thrust @ squares / (squares @ squares) / 4.0, rel=1e-4)
    slope, power = np.polyfit(thrust, current * voltage, 1)
    assert CRAZYFLIE_2.power_per_thrust_wpn == pytest.approx(slope, rel=1e-3)
    assert CRAZYFLIE_2.electronics_w == pytest.approx(power, rel=1e-3)
    driven = duty >= 0.25
    slope, offset = np.polyfit((duty * voltage)[driven], speed[driven], 1)
    assert CRAZYFLIE_2.speed_per_v_rps == pytest.approx(slope, rel=1e-3)
    assert CRAZYFLIE_2.speed_at_0v_rps == pytest.approx(offset, rel=1e-3)
    assert CRAZYFLIE_2.idle_rps == pytest.approx(speed[1], rel=1e-3)


def test_a_speed_follows_its_command_as_a_first_order_lag() -> None:
    one = rotors()
    one.commands_rps = (1000.0, 2000.0, 0.0, 500.0)
    for k in range(1, 200):
        start, middle, end = one.step()
        risen = -math.expm1(-k * H / CRAZYFLIE_2.motor_lag_s)
        np.testing.assert_allclose(one.speeds_rps, np.array(one.commands_rps) * risen, rtol=1e-12)
        assert end == one.compute_wrench(one.speeds_rps)
        between = -math.expm1(-(k - 0.5) * H / CRAZYFLIE_2.motor_lag_s)
        assert middle.speeds_rps == pytest.approx(3500.0 * between, rel=1e-12)
        assert start.speeds_rps < middle.speeds_rps < end.speeds_rps


def test_four_rotors_at_the_hover_speed_carry_the_weight_and_turn_nothing() -> None:
    wrench = rotors().compute_wrench((CRAZYFLIE_2.hover_rps,) * 4)
    assert wrench.thrust_n == pytest.approx(CRAZYFLIE_2.mass_kg * GRAVITY_MPS2, rel=1e-12)
    assert wrench.torque_nm == (0.0, 0.0, 0.0)
    assert CRAZYFLIE_2.hover_rps * 60.0 / (2.0 * math.pi) == pytest.approx(16800.0, rel=0.01)


@pytest.mark.parametrize("speeds", [(1500.0, 1600.0, 1700.0, 1900.0), (2000.0, 900.0, 1000.0, 800.0)])
def test_the_wrench_is_that_of_forces_on_levers(speeds: tuple[float, float, float, float]) -> None:
    thrust, torque = by_hand(speeds)
    wrench = rotors().compute_wrench(speeds)
    assert wrench.thrust_n == pytest.approx(thrust, rel=1e-12)
    np.testing.assert_allclose(wrench.torque_nm, torque, rtol=1e-9, atol=1e-12)
    assert wrench.speeds_rps == sum(speeds)


def test_what_the_rotors_can_do_is_commanded_exactly() -> None:
    one = rotors()
    for roll, pitch, yaw in itertools.product((-1e-3, 0.0, 2e-3), (-2e-3, 0.0, 1e-3), (-1e-4, 0.0, 1e-4)):
        one.command(0.3, (roll, pitch, yaw), FAST)
        assert not (one.is_thrust_limited or one.is_torque_limited)
        thrust, torque = by_hand(one.commands_rps)
        assert thrust == pytest.approx(0.3, rel=1e-12)
        np.testing.assert_allclose(torque, (roll, pitch, yaw), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("wanted_n", [0.0, 0.5, 4.0])
def test_roll_and_pitch_come_before_thrust_and_thrust_before_yaw(wanted_n: float) -> None:
    one = rotors()
    roll, pitch = 1.5e-3, -1e-3
    one.command(wanted_n, (roll, pitch, 0.1), FAST)
    thrust, torque = by_hand(one.commands_rps)
    np.testing.assert_allclose(torque[:2], (roll, pitch), rtol=1e-9)
    reach = (roll - pitch) / (4.0 * SIDE_M)
    assert thrust == pytest.approx(min(max(wanted_n, 4.0 * (LEAST_N + reach)), 4.0 * (MOST_N - reach)), rel=1e-9)
    room = max(min(MOST_N - reach - 0.25 * thrust, 0.25 * thrust - reach - LEAST_N), 0.0)
    assert torque[2] == pytest.approx(4.0 * CRAZYFLIE_2.torque_m * room, rel=1e-6, abs=1e-12)


def test_commands_stay_between_idling_and_what_the_voltage_allows() -> None:
    rng = np.random.default_rng(5)
    one = rotors()
    for _ in range(2000):
        thrust, *torque = rng.normal(size=4) * (1.0, 1e-2, 1e-2, 1e-3)
        one.command(float(thrust), (float(torque[0]), float(torque[1]), float(torque[2])), FAST)
        assert min(one.commands_rps) >= CRAZYFLIE_2.idle_rps * (1.0 - 1e-9)
        assert max(one.commands_rps) <= FAST * (1.0 + 1e-9)
        given, turning = by_hand(one.commands_rps)
        assert one.is_thrust_limited == (abs(given - thrust) > 1e-9)
        assert one.is_torque_limited == (np.abs(np.array(turning) - torque).max() > 1e-12)
    one.stop()
    assert one.commands_rps == STOPPED


def test_the_battery_gives_the_power_asked_for_through_its_resistance() -> None:
    battery = BatteryModel(CRAZYFLIE_2)
    for thrust in (0.0, 0.1, CRAZYFLIE_2.weight_n, 0.6):
        source = battery.open_circuit_v
        battery.drain(thrust, 1e-6)
        power = CRAZYFLIE_2.electronics_w + CRAZYFLIE_2.power_per_thrust_wpn * thrust
        assert battery.voltage_v * battery.current_a == pytest.approx(power, rel=1e-9)
        assert battery.voltage_v == pytest.approx(source - CRAZYFLIE_2.resistance_ohm * battery.current_a, rel=1e-9)


def test_a_shorted_battery_gives_what_it_can() -> None:
    battery = BatteryModel(CRAZYFLIE_2)
    battery.drain(100.0, H)
    assert battery.voltage_v == pytest.approx(0.5 * 4.2)


def test_an_empty_battery_gives_nothing_until_it_has_charge_again() -> None:
    battery = BatteryModel(CRAZYFLIE_2, charge=1e-6)
    while not battery.is_empty:
        battery.drain(CRAZYFLIE_2.weight_n, H)
    used_c = battery.used_c
    battery.drain(CRAZYFLIE_2.weight_n, 1.0)
    assert (battery.voltage_v, battery.current_a, battery.remaining, battery.used_c) == (0.0, 0.0, 0.0, used_c)
    battery.set_charge(0.5)
    battery.drain(CRAZYFLIE_2.weight_n, H)
    assert battery.voltage_v > 3.0


def test_charge_is_the_integral_of_the_current_and_hovering_lasts_as_long_as_its_maker_says() -> None:
    battery = BatteryModel(CRAZYFLIE_2)
    flown_s = used_c = 0.0
    while battery.voltage_v > 3.0:  # where the Crazyflie's firmware counts it as empty
        battery.drain(CRAZYFLIE_2.weight_n, 0.1)
        flown_s += 0.1
        used_c += 0.1 * battery.current_a
    assert battery.used_c == pytest.approx(used_c, rel=1e-9)
    assert flown_s / 60.0 == pytest.approx(7.0, rel=0.1)  # "up to 7 minutes"
    assert 0.0 < battery.remaining < 0.1


def test_the_voltage_falls_with_the_charge_and_takes_rotor_speed_along() -> None:
    last = BatteryModel(CRAZYFLIE_2)
    assert last.open_circuit_v == pytest.approx(4.2)
    assert BatteryModel(CRAZYFLIE_2, charge=0.55).open_circuit_v == pytest.approx(0.5 * (3.92 + 3.96))
    for charge in np.arange(0.99, -0.01, -0.01):
        battery = BatteryModel(CRAZYFLIE_2, charge=float(charge))
        assert battery.open_circuit_v < last.open_circuit_v
        assert battery.max_rps < last.max_rps
        last = battery
    assert BatteryModel(CRAZYFLIE_2, charge=-1.0).open_circuit_v == 3.0
